"""Wrappers around an environment that is imported: whether they change its MDP.

Importers read the environment below all wrappers: its table, its states. So each wrapper has to change nothing of what
they read. Some are known not to, by their name. The others are stepped between two recorders, one above and one below:
whatever passes one and not the other is refused in one line, with the wrapper and with the way that works.
"""

import copy
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from pharos.errors import ParameterError, PharosError

Stepped: TypeAlias = Any
"""An environment or wrapper with Gymnasium's interface, or old gym's."""
Returned: TypeAlias = Any
"""Answer of one: an observation, alone or with what comes with it."""

WRAPPER_LIBRARIES = ("gymnasium", "minigrid", "stable_baselines3")
SILENT = frozenset(["Autoreset", "HumanRendering", "Monitor", "RecordVideo", "RenderCollection"])
"""Wrappers that change nothing, and reset, write files or open windows: copies of environments are stepped without."""
UNCHANGING = SILENT | frozenset(
    [
        "AddRenderObservation",
        "AddWhiteNoise",
        "DelayObservation",
        "DirectionObsWrapper",
        "FrameStackObservation",
        "NormalizeObservation",
        "ObstructView",
        "OrderEnforcing",
        "PassiveEnvChecker",
        "RecordEpisodeStatistics",
        "TimeAwareObservation",
        "TimeLimit",
    ]
)
"""Wrappers of WRAPPER_LIBRARIES that change nothing of an MDP; its time limit is given as a horizon."""
WITHOUT_MEMORY = ("minigrid.wrappers:NoDeath",)
"""Wrappers whose rewards and ends are functions of state and action: stepping in every state takes them over."""
EPISODE = 200
MOST_STEP_OUTCOMES = 100_000
UNWRAP = "import env.unwrapped"


class Call(NamedTuple):
    """A call that passed a recorder.

    Attributes:
        action: None for a reset.
        before, after: number of the state in the environment below all wrappers; None if it keeps none.
    """

    action: object
    before: int | None
    after: int | None
    reward: float = 0.0
    ended: bool = False
    truncated: bool = False


class Recorder:
    """An environment or wrapper that records what it was asked and what it answered.

    Attributes:
        calls: since the list was last cleared.
        observation: the last one.
        script: (state before, next state, reward, ended) of the next step, in place of what the environment does.
    """

    def __init__(self, env: Stepped):
        vars(self).update(env=env, calls=[], observation=None, script=None)

    def reset(self, *, seed: int | None = None, options: object = None) -> Returned:
        answer = answer_of_reset(self.env, seed, options)
        self.observation = first_of(answer)
        self.calls.append(Call(None, None, table_state(self.env)))
        return answer

    def step(self, action: object) -> Returned:
        if self.script is not None and table_state(self.env) is not None:
            self.env.unwrapped.s = self.script[0]
        before = table_state(self.env)
        answer = self.env.step(action)
        if self.script is not None:
            _, next_state, reward, ended = self.script
            if before is not None:
                self.env.unwrapped.s = next_state
            answer = (next_state + first_number(self.env, "observation"), reward, ended, *answer[3:])
        self.observation, reward, ended, truncated = step_parts(answer)
        self.calls.append(Call(as_integer(action), before, table_state(self.env), float(reward), ended, truncated))
        return answer

    def __getattr__(self, name: str) -> Returned:
        return getattr(vars(self)["env"], name)

    def __setattr__(self, name: str, value: object) -> None:
        if name in vars(self):
            vars(self)[name] = value
        else:
            setattr(self.env, name, value)


def as_integer(value: Returned) -> Returned:
    """A number or an array of one number as an int if it is whole; anything else as it is."""
    try:
        return int(value) if int(value) == value else value
    except (TypeError, ValueError, OverflowError):
        return value


def first_number(env: Stepped, kind: str) -> int:
    """The number of the first action, or observation, of an environment: of a space Discrete(n, start=k), k."""
    number = as_integer(getattr(getattr(env, f"{kind}_space", None), "start", 0))
    return number if isinstance(number, int) else 0


def table_state(env: Stepped) -> int | None:
    """Number of the state that an environment with a table keeps in `s`; None if there is none."""
    value = as_integer(getattr(getattr(env, "unwrapped", env), "s", None))
    return value if isinstance(value, int) else None


def reset(env: Stepped, seed: int | None = None) -> Returned:
    """The first observation of an episode, of environments with Gymnasium's interface or old gym's."""
    return first_of(answer_of_reset(env, seed))


def tells_masks(env: Stepped, answer: Returned) -> bool:
    """Whether an environment says which actions are allowed: by `action_masks`, or in what a reset returned."""
    has_information = first_of(answer) is not answer
    in_reset = has_information and not {"action_mask", "action_masks"}.isdisjoint(answer[1])
    return in_reset or any(
        callable(getattr(each, "action_masks", None)) for each in (env, getattr(env, "unwrapped", env))
    )


def answer_of_reset(env: Stepped, seed: int | None, options: object = None) -> Returned:
    """Answer of `reset`, with or without information beside the observation."""
    try:
        return env.reset(seed=seed, **({} if options is None else {"options": options}))
    except TypeError:  # old gym's takes nothing
        return env.reset()


def first_of(answer: Returned) -> Returned:
    """Observation in what `reset` returned, with information beside it or alone (old gym's)."""
    return answer[0] if isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[1], dict) else answer


def step_parts(answer: Sequence[Returned]) -> tuple[Returned, float, bool, bool]:
    """(observation, reward, terminated, truncated) of what `step` returned, with four parts (old gym's) or five."""
    observation, reward, ended, *rest = answer
    return observation, reward, bool(ended), bool(rest[0]) if len(rest) > 1 else False


def wrappers_of(env: Stepped) -> list[Stepped]:
    """The wrappers of an environment, the outermost first.

    Raises:
        ParameterError: they cannot be walked.
    """
    inner, chain = getattr(env, "unwrapped", env), list[Stepped]()
    while env is not inner:
        below = getattr(env, "env", None)
        if below is None or len(chain) > 100:
            raise ParameterError(f"{wrapper_name(env)}: has no attribute env, the environment that it wraps; {UNWRAP}")
        chain.append(env)
        env = below
    return chain


def wrapper_name(env: object) -> str:
    """Name of the class of an environment or wrapper."""
    return type(env).__name__


def changes_nothing(wrapper: Stepped) -> bool:
    """Whether a wrapper is known to leave the MDP as it is: by its name, or as it transforms observations alone."""
    from gymnasium import ObservationWrapper

    kind = type(wrapper)
    if kind.__module__.split(".")[0] in WRAPPER_LIBRARIES and kind.__name__ in UNCHANGING:
        return True
    own = ObservationWrapper
    return issubclass(kind, own) and (kind.step, kind.reset) == (own.step, own.reset)


class Layers:
    """Copies of the wrappers of an environment, with recorders around those that may change the MDP.

    Args:
        env: the environment as it was given.
        copied: whether the environment below is copied as well, if it can be. Otherwise wrappers that are known to
            change nothing are left out.
    Attributes:
        top: the outermost one that may change something, to be stepped in place of `env`.
        bottom: a recorder above the environment below all wrappers.
        suspects: (wrapper, recorder above it, recorder below it), the innermost first.
    Raises:
        ParameterError: a wrapper is known to change the MDP, or has other actions.
    """

    def __init__(self, env: Stepped, *, copied: bool = True):
        self.suspects: list[tuple[Stepped, Recorder, Recorder]] = []
        chain = wrappers_of(env)
        inner = chain[-1].env if chain else env
        while chain and changes_nothing(chain[0]):  # a time limit would hide what happens later
            del chain[0]
        if copied:
            loud = [wrapper for wrapper in chain if wrapper_name(wrapper) not in SILENT or not changes_nothing(wrapper)]
            chain, inner = _copied(loud, inner)
        else:
            chain = [copy.copy(wrapper) for wrapper in chain if not changes_nothing(wrapper)]
        self.top = self.bottom = Recorder(inner)
        for wrapper in reversed(chain):
            if changes_nothing(wrapper) or _path(wrapper) in WITHOUT_MEMORY:
                wrapper.env = self.top
                self.top = wrapper
                continue
            _refuse_known(wrapper)
            below = Recorder(self.top)
            wrapper.env = below
            self.top = Recorder(wrapper)
            self.suspects.append((wrapper, self.top, below))
            own, others = (getattr(getattr(each, "action_space", None), "n", None) for each in (wrapper, below))
            if own != others:
                raise ParameterError(f"{wrapper_name(wrapper)}: has {own} actions, the environment {others}; {UNWRAP}")

    def reset(self, seed: int | None = None) -> Returned:
        """First observation of an episode; ParameterError if a wrapper changes how it begins."""
        return self._checked(lambda: reset(self.top, seed))

    def step(self, action: int) -> tuple[Returned, float, bool, bool]:
        """(observation, reward, terminated, truncated); ParameterError if a wrapper changes any but the observation."""
        return self._checked(lambda: step_parts(self.top.step(action)))

    def _checked(self, call: Callable[[], Returned]) -> Returned:
        for _, above, below in self.suspects:
            above.calls.clear()
            below.calls.clear()
        self.bottom.calls.clear()
        if not self.suspects:
            return call()
        try:
            answer = call()
        except PharosError:
            raise
        except Exception as error:  # of code of the caller's
            names = ", ".join(wrapper_name(wrapper) for wrapper, *_ in self.suspects)
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise ParameterError(
                f"{names}: cannot be compared with the environment below: {reason}; {UNWRAP}"
            ) from error
        for wrapper, above, below in self.suspects:
            _compare(wrapper, above.calls, below.calls)
        return answer


def check_wrappers(env: Stepped, steps: int, outcomes: Iterable[tuple[int, int, int, float, bool]], count: int) -> None:
    """Step an environment as it was given, and each outcome of its table; ParameterError if a wrapper changes one.

    Args:
        steps: of a walk at random.
        outcomes: (state, action, next state, reward, terminated) of the table.
        count: number of outcomes; beyond MOST_OUTCOMES a share of them is tried.
    """
    layers = Layers(env)
    if not layers.suspects:
        return
    rng = np.random.default_rng(0)
    first, actions, is_over = first_number(layers.top, "action"), int(layers.top.action_space.n), True
    for step in range(steps):
        if is_over or step % EPISODE == 0:
            layers.reset(0 if step == 0 else None)
        is_over = layers.step(first + int(rng.integers(actions)))[2]
    share, is_over = MOST_STEP_OUTCOMES / max(count, 1), True
    for number, (state, action, next_state, reward, ended) in enumerate(outcomes):
        if share < 1 and rng.random() >= share:
            continue
        if is_over or number % EPISODE == 0:
            layers.bottom.script = None
            layers.reset()
        layers.bottom.script = state, next_state, reward, ended
        is_over = layers.step(first + action)[2]


def _copied(chain: list[Stepped], inner: Stepped) -> tuple[list[Stepped], Stepped]:
    """Copies of wrappers and of the environment below; of the wrappers alone if it cannot be copied."""
    linked = chain
    if any(above.env is not below for above, below in zip(chain, [*chain, inner][1:], strict=True)):
        linked = [copy.copy(wrapper) for wrapper in chain]
        for above, below in zip(linked, [*linked, inner][1:], strict=True):
            above.env = below
    try:
        return copy.deepcopy((linked, inner))
    except Exception:  # a window, a generator of its own: whatever cannot be copied is stepped itself
        return [copy.copy(wrapper) for wrapper in chain], inner


def _path(wrapper: object) -> str:
    return f"{type(wrapper).__module__}:{wrapper_name(wrapper)}"


def _refuse_known(wrapper: Stepped) -> None:
    """ParameterError for wrappers whose chance a walk might miss."""
    path = _path(wrapper)
    if path == "gymnasium.wrappers.stateful_action:StickyAction":
        p = wrapper.repeat_action_probability
        if p > 0:
            several = set(np.atleast_1d(getattr(wrapper, "repeat_action_duration_range", 1)).tolist()) != {1}
            way = (
                "repeating an action several times is not among what pharos has"
                if several
                else (f"{UNWRAP}, and add pharos.sticky_actions(mdp, {p:g}), or --sticky {p:g}")
            )
            raise ParameterError(f"StickyAction: repeats actions, which the table below it does not; {way}")
    elif path == "minigrid.wrappers:StochasticActionWrapper" and wrapper.prob < 1:
        p, count = 1 - wrapper.prob, wrapper.env.action_space.n
        way = (
            "a fixed action at random is not among what pharos has"
            if wrapper.random_action is not None
            else (f"{UNWRAP} with actions=range({count}), and add pharos.random_actions(mdp, {p:g}), or --random {p:g}")
        )
        raise ParameterError(f"StochasticActionWrapper: executes other actions at random; {way}")


ACTING_WRAPPER = (
    f"{UNWRAP}; chance of acting is added by pharos.sticky_actions or random_actions (--sticky P, --random P)"
)
PAYING = f"{UNWRAP}, and give what it pays: rewards= of importers.gymnasium, StateSpace.mdp or TabularMDP.from_arrays"
STARTING = f"{UNWRAP}, and give initial= of importers.gymnasium"
ENDING = f"{UNWRAP}, and give a time limit as horizon=; other ends need a table P of their own"


def _compare(wrapper: object, above: list[Call], below: list[Call]) -> None:
    """ParameterError if calls above a wrapper are not those below it."""
    name = wrapper_name(wrapper)
    if [call.action is None for call in above] != [call.action is None for call in below]:
        what = "reset" if above and above[0].action is None else "step"
        raise ParameterError(f"{name}: makes {len(below)} calls of the environment in one {what}; {UNWRAP}")
    for ours, theirs in zip(above, below, strict=True):
        if ours == theirs:
            continue
        where = "" if ours.before is None else f" in state {ours.before}"
        where += "" if ours.action is None else f", action {ours.action}," if where else f" for action {ours.action}"
        if ours.action is None:
            text = f"starts episodes in state {ours.after} in place of {theirs.after}; {STARTING}"
        elif ours.action != theirs.action:
            text = f"executes action {theirs.action} in place of {ours.action}; {ACTING_WRAPPER}"
        elif not np.array_equal(ours.reward, theirs.reward, equal_nan=True):
            text = f"pays {ours.reward:g}{where} in place of {theirs.reward:g}; {PAYING}"
        elif ours.ended != theirs.ended:
            text = (
                f"{'ends' if ours.ended else 'does not end'} the episode{where} as the environment does not; {ENDING}"
            )
        elif ours.truncated != theirs.truncated:
            text = f"cuts the episode off{where}; {ENDING}" if ours.truncated else f"undoes a time limit; {UNWRAP}"
        elif ours[1:3] != theirs[1:3]:
            text = f"moves the environment{where} to state {ours.after} in place of {theirs.after}; {UNWRAP}"
        else:
            continue
        raise ParameterError(f"{name}: {text}")
