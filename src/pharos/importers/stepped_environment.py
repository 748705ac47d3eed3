"""An environment as a source of states: saved, restored, and stepped through all outcomes of its draws.

Four nets catch hidden chance: generators that are met while a state is saved, global generators before and after each
step, and repeated runs with the same draws; the fourth is `fresh_play`.
"""

import random as python_random
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from typing import Any, Protocol, TypeAlias, TypeVar

import numpy as np

from pharos.errors import ParameterError, PharosError, RuleError, UnknownName
from pharos.importers import side_effects
from pharos.importers.chance import MOST_DRAW_OUTCOMES, DrawError, DrawTree, line_of_code, placed
from pharos.importers.fresh_play import FreshPlay
from pharos.importers.search import Arrival, Expansions, ExpansionsHere, Steppable, SteppedStates
from pharos.importers.side_effects import SideEffects
from pharos.importers.snapshots import EnvironmentSnapshots, bare, chain_of, field_names, integers_of, snapshot_digest
from pharos.importers.step_spaces import SpaceRecorder, listed_actions_of
from pharos.importers.step_workers import ExpansionsElsewhere
from pharos.importers.wrappers import Stepped, answer_of_reset, first_of, reset, tells_masks
from pharos.system.wording import capped

CHECKED_COPIES = 50
CHECKED_PAIRS = 1_000
"""Pairs of different states with one key that are compared: the first half, and then each tenth."""
WALK_STEPS = 20
"""Steps of a walk from each such pair, as long as nothing is drawn."""
REPEATED = 100
"""Each so many states are expanded twice, and the first 20 four times."""

T = TypeVar("T")
Factory: TypeAlias = Callable[[], Stepped]
Visit: TypeAlias = Callable[[Stepped, object, float, bool], None]
"""Takes (environment after a step, observation, reward, whether the episode ended)."""
Run: TypeAlias = Callable[[Visit], None]
"""Visits each outcome of a reset or a step."""
Payment: TypeAlias = Callable[[Any], float] | Sequence[float]


@dataclass(frozen=True, kw_only=True)
class SteppingOptions:
    """Options that decide which MDP an environment becomes.

    Attributes:
        seed: of the reset; None: all starts that a reset can draw.
        ignore: names of fields that are no part of the state.
        key: (environment) -> anything hashable, equal for equal states; None: a digest of all its fields.
        reward: (reward of the environment) -> number, or weights of a vector of rewards.
        actions: in place of the actions of a discrete action space.
        max_outcomes: in which the draws of one step may come out.
        copied: fields that are never shared between copies, though they seem constant, nor left out as counters.
    """

    seed: int | None = None
    ignore: frozenset[str] = frozenset()
    key: Callable[[Stepped], Hashable] | None = None
    reward: Payment | None = None
    actions: tuple[Any, ...] | None = None
    max_outcomes: int = MOST_DRAW_OUTCOMES
    copied: frozenset[str] = frozenset()


class ConstantChanged(Exception):
    """A table that all copies shared was changed by a step, or a counter that was left out matters."""


class SteppedSource(Steppable, Protocol):
    """A source that `stepping` imports: an environment of Gymnasium, or functions of JAX.

    Attributes:
        action_names, time_limit: of the environment. observer: what it shows. effects: what it did to the process.
    """

    action_names: tuple[str, ...] | None
    time_limit: int | None
    observer: SpaceRecorder
    effects: SideEffects

    def expansions(self, workers: int) -> Expansions:
        """States to be expanded, here or by other processes."""

    def arrive(self, saved: bytes | None, action: int, script: Sequence[int]) -> Arrival:
        """Repeat an earlier step with these draws, from a saved state or from the reset (None)."""

    def skip(self, keys: Sequence[bytes]) -> None:
        """Hand over no saved states of these keys, which others have."""

    def integers(self, saved: bytes) -> dict[str, int]:
        """Whole numbers that a state holds, by the names of their fields."""

    def compare(self, states: SteppedStates, horizon: int | None) -> None:
        """RuleError if a new environment, with its own chance, does what the states say to be impossible."""

    def check_rest(self) -> None:
        """Checks when all states were expanded."""


class SteppedEnvironment:
    """An environment as a source of states for `search`.

    Args:
        factory, options: of `stepping`.
    Attributes:
        name: for messages. num_actions, action_names, time_limit: of the environment.
        observer: what it shows. effects: what it did to the process.
    """

    def __init__(self, factory: Factory, options: SteppingOptions):
        self.factory, self.options = factory, options
        self.effects = SideEffects()
        self.draws = DrawTree(options.max_outcomes)
        self.snapshots = EnvironmentSnapshots(self.draws, options.ignore)
        self.name = getattr(factory, "__name__", type(factory).__name__)
        self._sent: set[bytes] = set()
        self._first: dict[bytes, tuple[bytes, bytes]] = {}
        self._num_expanded = self._num_twins = self._num_pairs = self._num_copies = 0
        with self.effects.watched():
            self._env, self.time_limit = self.made()
            self.name = _name_of(self._env)
            self.actions, self.action_names = listed_actions_of(self._env, options.actions, self.name)
            self.observer = SpaceRecorder(getattr(self._env, "observation_space", None), self.name)
            self._prepare()

    @property
    def num_actions(self) -> int:
        """Number of actions, the same in all states."""
        return len(self.actions)

    def made(self) -> tuple[Stepped, int | None]:
        """(a new environment without the wrappers that only watch, its time limit)."""
        env = self._calling("the factory", self.factory)
        if not (hasattr(env, "reset") and hasattr(env, "step")):
            raise ParameterError(f"{self.name}: made a {capped(env)}; expected an environment with reset and step")
        for each in chain_of(env):
            if vars(each).get("render_mode") == "human":  # which waits for the next frame at each step
                each.render_mode = None
                self.effects.note_window()
        return bare(env)

    def key_of(self, env: Stepped) -> bytes:
        """Key of the state that an environment is in."""
        if self.options.key is None:
            return self.snapshots.digest(env)
        value = self._calling("the key", partial(self.options.key, env))
        return snapshot_digest(value)

    def starts(self) -> list[Arrival]:
        """The states in which episodes start, with their probabilities."""
        return self._guarded({"reset()": self._reset_runs}, is_repeated=True)[0]

    def expanded(self, states: Sequence[bytes]) -> list[list[list[Arrival]]]:
        """The outcomes of each action in each of some saved states."""
        return [self._expanded(saved) for saved in states]

    def _expanded(self, saved: bytes) -> list[list[Arrival]]:
        self._num_expanded += 1
        is_repeated = self._num_expanded <= 20 or self._num_expanded % REPEATED == 0
        runs = {f"step({action})": partial(self._step_runs, saved, action) for action in self.actions}
        rows = self._guarded(runs, is_repeated=is_repeated)
        if self._num_expanded <= CHECKED_COPIES or self._num_expanded % REPEATED == 0:
            self.check_constants()
        return rows

    def arrive(self, saved: bytes | None, action: int, script: Sequence[int]) -> Arrival:
        """Repeat an earlier step with these draws, from a saved state or from the reset (None)."""
        with self.effects.watched():
            self.draws.replay(script)
            env = self.snapshots.restore(self._blank if saved is None else saved)
            if saved is None:
                is_seeded, payment, ended = self.options.seed is not None, 0.0, False
                observation = self._observation if is_seeded else self._reset(env)
            else:
                observation, payment, ended = self.step(env, self.actions[action])
            key = None if ended else self.key_of(env)
            self._sent.update(() if key is None else [key])
            return self._arrival(env, key, observation, payment)

    def skip(self, keys: Sequence[bytes]) -> None:
        """Hand over no saved states of these keys, which others have."""
        self._sent.update(keys)

    def integers(self, saved: bytes) -> dict[str, int]:
        """Whole numbers that a state holds, by the names of their fields."""
        return integers_of(self.snapshots.restore(saved), self.options.ignore)

    def expansions(self, workers: int) -> Expansions:
        """States that are expanded in this process, or by others."""
        return ExpansionsHere(self.expanded) if workers == 1 else ExpansionsElsewhere(self, workers)

    def compare(self, states: SteppedStates, horizon: int | None) -> None:
        """RuleError if a new environment, with its own generators, does what the states say to be impossible."""
        FreshPlay(self, states, horizon).compare()

    def check_rest(self) -> None:
        """Checks when all states were expanded."""
        self.check_constants()

    def check_constants(self) -> None:
        """Raise ConstantChanged if a table that copies share was changed."""
        name = self.snapshots.changed_constant(self._env)
        if name is not None:
            raise ConstantChanged(name)

    # Runs -------------------------------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Reset once, so that generators are there that are made when they are first used; and share large tables."""
        seed = 0 if self.options.seed is None else self.options.seed
        answer = self._calling("reset()", lambda: answer_of_reset(self._env, seed))
        observation = first_of(answer)
        if tells_masks(self._env, answer):
            self.observer.notes.append(
                f"{self.name}: its action masks are not read: every action is taken in every state, and does what step "
                f"does with it"
            )
        names = field_names(self._env) if self.options.ignore else set[str]()
        for name in sorted(self.options.ignore - names):
            raise UnknownName(f"field of {self.name}", name, names)
        self.snapshots.share_constants(self._env, self._play, self.options.copied)
        self._observation = observation
        self._blank = self.snapshots.save(self._env)
        self.snapshots.is_strict = True

    def _play(self, env: Stepped, steps: int) -> None:
        """Step at random."""
        rng = self.draws.sampler = python_random.Random(0)
        try:
            is_over = False
            for _ in range(steps):
                if is_over:
                    self._reset(env, self.options.seed)
                is_over = self.step(env, rng.choice(self.actions))[2]
        finally:
            self.draws.sampler = None

    def _reset(self, env: Stepped, seed: int | None = None) -> object:
        return self._calling("reset()", lambda: reset(env, seed))

    def step(self, env: Stepped, action: object) -> tuple[object, float, bool]:
        """(observation, reward, whether the episode ends)."""
        what = f"step({action})"
        answer = self._calling(what, lambda: env.step(action))
        if not isinstance(answer, tuple) or len(answer) not in (4, 5):
            raise RuleError(f"{self.name}: {what} returned {capped(answer)}; expected (observation, reward, ...)")
        observation, payment, ended, *rest = answer
        truncated = len(rest) > 1 and bool(rest[0]) and not self.options.ignore
        return (
            observation,
            self._calling(what, lambda: payment_of(payment, self.options.reward, self.name)),
            bool(ended) or truncated,
        )

    def _calling(self, what: str, function: Callable[[], T]) -> T:
        """Answer of a function of the environment; its errors become one line that names the line of its code."""
        try:
            answer = function()
            self.draws.check()
            return answer
        except DrawError as error:
            self.draws.refusal = None
            text = str(error)
            raise DrawError(text if text.startswith(f"{self.name}: ") else f"{self.name}: {what} {text}") from None
        except PharosError:
            raise
        except (Exception, SystemExit) as error:
            self.draws.check()
            reason = placed(f"{type(error).__name__}: {capped(' '.join(str(error).split()))}", line_of_error(error))
            raise RuleError(f"{self.name}: {what} raised {reason}") from error

    def _reset_runs(self, visit: Visit) -> None:
        """Visit each outcome of a reset."""
        if self.options.seed is not None:
            self.draws.replay(())
            visit(self.snapshots.restore(self._blank), self._observation, 0.0, False)
            return
        for _ in self._enumerated("reset()"):
            env = self.snapshots.restore(self._blank)
            visit(env, self._reset(env), 0.0, False)

    def _step_runs(self, saved: bytes, action: object, visit: Visit) -> None:
        """Visit each outcome of a step."""
        for _ in self._enumerated(f"step({action})"):
            env = self.snapshots.restore(saved)
            visit(env, *self.step(env, action))

    def _enumerated(self, what: str) -> Iterator[None]:
        try:
            yield from self.draws.runs()
        except DrawError as error:
            raise DrawError(f"{self.name}: {what}: {error}") from None

    # Nets -------------------------------------------------------------------------------------------------------------

    def _guarded(self, runs: Mapping[str, Run], *, is_repeated: bool) -> list[list[Arrival]]:
        """The outcomes of a reset or of each step; errors if they depend on anything but the state and the draws."""
        rows: list[list[Arrival]] = []

        def visit(env: Stepped, observation: object, payment: float, ended: bool) -> None:
            key = None if ended else self.key_of(env)
            rows[-1].append(self._new_arrival(env, key, observation, payment))

        with self.effects.watched():
            before = side_effects.global_generators()
            for run in runs.values():
                rows.append([])
                run(visit)
            if side_effects.global_generators() != before:
                self._check_seeding(runs)
            for (what, run), row in zip(runs.items(), rows, strict=True):
                if is_repeated:
                    self._check_repetition(what, run, [_signature(arrival) for arrival in row])
        if self.effects.has_new_threads():
            names = ", ".join(runs)
            raise RuleError(f"{self.name}: {names}: started a thread, whose work is not seen; expected none")
        return rows

    def _signatures(self, run: Run) -> list[tuple]:
        """(probability, key, reward) of each outcome."""
        signatures: list[tuple] = []

        def visit(env: Stepped, _: object, payment: float, ended: bool) -> None:
            signatures.append((self.draws.probability, None if ended else self.key_of(env), payment))

        run(visit)
        return signatures

    def _check_repetition(self, what: str, run: Run, before: list[tuple]) -> None:
        """RuleError if the same draws lead elsewhere the second time."""
        times = 3 if self._num_expanded <= 20 else 1
        if any(self._signatures(run) != before for _ in range(times)):
            line = side_effects.line_that_asks(lambda: self._signatures(run))
            raise RuleError(
                placed(f"{self.name}: {what} with the same draws ended in different states", line)
                + ": its chance comes from elsewhere (time, files, os.urandom, a thread, C++, a generator made in the "
                "step); draw from self.np_random, which reset() seeds"
            )

    def _check_seeding(self, runs: Mapping[str, Run]) -> None:
        """RuleError if a step draws from global generators; to seed them, and draw then, is no chance."""
        for what, run in runs.items():
            answers = []
            for _ in range(2):
                side_effects.move_global_generators()
                before, signatures = side_effects.global_generators(), self._signatures(run)
                after = zip(before, side_effects.global_generators(), strict=True)
                answers.append((signatures, [None if new == old else new for old, new in after]))
            if answers[0] != answers[1]:
                line = side_effects.line_that_changes(partial(self._signatures, run), side_effects.global_generators)
                raise RuleError(
                    placed(f"{self.name}: {what} drew from a global generator of NumPy or Python", line)
                    + ", which every program shares; draw from self.np_random, which reset() seeds"
                )
        self.effects.note_seeding()

    # Arrivals ---------------------------------------------------------------------------------------------------------

    def _new_arrival(self, env: Stepped, key: bytes | None, observation: object, payment: float) -> Arrival:
        """The outcome that was just stepped to; with the state if this is the first time."""
        probability, script = self.draws.probability, self.draws.script
        if key is not None and key not in self._sent:
            self._sent.add(key)
            return self._arrival(env, key, observation, payment)
        if key is not None and (self.options.key is not None or self.options.ignore):
            self._check_pair(env, key)
        return Arrival(probability, payment, key, script=script)

    def _arrival(self, env: Stepped, key: bytes | None, observation: object, payment: float) -> Arrival:
        if key is None:
            return Arrival(self.draws.probability, payment, None, script=self.draws.script)
        saved = self.snapshots.save(env)
        self._num_copies += 1
        if self._num_copies <= CHECKED_COPIES or self._num_copies % REPEATED == 0:
            self._check_copy(env, saved)
        if (self.options.key is not None or self.options.ignore) and len(self._first) < 10 * CHECKED_PAIRS:
            self._first[key] = saved, self.snapshots.digest(env, complete=True)
        shown = self.observer.shown(observation)
        return Arrival(self.draws.probability, payment, key, saved, shown, self.draws.script)

    def _check_copy(self, env: Stepped, saved: bytes) -> None:
        """RuleError if a copy is in another state."""
        copy = self.snapshots.restore(saved)
        if self.snapshots.digest(copy, complete=True) != self.snapshots.digest(env, complete=True):
            raise RuleError(
                f"{self.name}: a copy is not in the state of the original: an object in it has __reduce__, "
                f"__getstate__ or __setstate__ that lose it, or holds what Python does not see (C++)"
            )

    def _check_pair(self, env: Stepped, key: bytes) -> None:
        """RuleError if a state does not behave as the first one with the same key."""
        if key not in self._first or self._num_pairs >= CHECKED_PAIRS:
            return
        saved, digest = self._first[key]
        if self.snapshots.digest(env, complete=True) == digest:
            return
        self._num_twins += 1
        if self._num_twins > CHECKED_PAIRS // 2 and self._num_twins % 10:
            return
        self._num_pairs += 1
        draws, self.draws = self.draws, DrawTree(self.options.max_outcomes)
        try:
            self._compare_behaviour(saved, self.snapshots.save(env))
        finally:
            self.draws = draws

    def _compare_behaviour(self, first: bytes, second: bytes) -> None:
        """RuleError if an action, or a walk, has other outcomes in one of two states than in the other."""
        with self.snapshots.drawing_from(self.draws):
            for number, action in enumerate(self.actions):
                one, other = (Counter(self._shares(saved, action)) for saved in (first, second))
                if one != other:
                    raise self._refused_merge(f"action {number}", difference(one, other))
            rng = python_random.Random(self._num_pairs)
            for _ in range(8 if self._num_pairs <= 5 else 1):
                self._compare_walk(first, second, [rng.randrange(self.num_actions) for _ in range(WALK_STEPS)])

    def _compare_walk(self, first: bytes, second: bytes, actions: Sequence[int]) -> None:
        """RuleError if the same actions lead elsewhere; up to the first draw, as draws may be made in any order."""
        pair = [self.snapshots.restore(saved) for saved in (first, second)]
        for count, number in enumerate(actions, 1):
            steps = []
            for env in pair:
                self.draws.replay(())
                _, payment, ended = self.step(env, self.actions[number])
                steps.append(Counter({(None if ended else self.key_of(env), payment): 1}))
                if self.draws.script:
                    return
            if steps[0] != steps[1]:
                names = ", ".join(map(str, actions[:count]))
                raise self._refused_merge(f"actions {names}", difference(steps[0], steps[1]))
            if ended:
                return

    def _refused_merge(self, after: str, difference: str) -> RuleError:
        left = "the key leaves" if self.options.key is not None else "--ignore leaves"
        return RuleError(
            f"{self.name}: two states with the same key behave differently ({after}: {difference}): {left} out "
            f"something that matters"
        )

    def _shares(self, saved: bytes, action: object) -> dict[tuple, Fraction]:
        """(key, reward) -> probability."""
        shares: dict[tuple, Fraction] = {}
        for probability, key, payment in self._signatures(partial(self._step_runs, saved, action)):
            shares[key, payment] = shares.get((key, payment), Fraction(0)) + probability
        return shares


def payment_of(payment: Any, own: Payment | None, name: str) -> float:
    """A reward as a number; `own` is a function of it, or weights of a vector; `name` is for messages."""
    if callable(own):
        payment = own(payment)
    elif own is not None:
        payment = float(np.dot(np.asarray(payment, float), np.asarray(own, float)))
    if np.ndim(payment) and np.size(payment) != 1:
        raise ParameterError(
            f"{name}: pays a vector of {np.size(payment)} rewards; give weights, such as "
            f"reward=({', '.join(['1.0'] * np.size(payment))}) (--weights 1,...), or a function of it"
        )
    number = float(np.asarray(payment).item() if np.ndim(payment) else payment)
    if not np.isfinite(number):
        raise RuleError(f"{name}: pays {number}; expected a finite number")
    return number


def _signature(arrival: Arrival) -> tuple:
    return arrival.probability, arrival.key, arrival.reward


def difference(one: Counter, other: Counter) -> str:
    """Words on two distributions over (key, reward) that differ."""
    rewards = [sorted({payment for _, payment in each}) for each in (one, other)]
    if rewards[0] != rewards[1]:
        first, second = (", ".join(f"{payment:g}" for payment in each[:3]) for each in rewards)
        return f"reward {first} and {second}"
    ends = [sum(p for (key, _), p in each.items() if key is None) for each in (one, other)]
    if ends[0] != ends[1]:
        return f"it ends with probability {float(ends[0]):g} and {float(ends[1]):g}"
    return "they lead to different states, or with different probabilities"


def line_of_error(error: BaseException) -> str:
    """The line of the environment's code that raised an error."""
    trace, line = error.__traceback__, ""
    while trace is not None:
        path = trace.tb_frame.f_code.co_filename.replace("\\", "/")
        if "pharos/importers/" not in path and line_of_code(trace.tb_frame).startswith(path.rpartition("/")[2]):
            line = f"{path.rpartition('/')[2]}, line {trace.tb_lineno}"
        trace = trace.tb_next
    return line


def _name_of(env: Stepped) -> str:
    spec = getattr(env, "spec", None)
    return str(getattr(spec, "id", None) or type(getattr(env, "unwrapped", env)).__name__)


@dataclass
class ClockSearch:
    """Fields that count steps: in each state that is looked at, their value is the first state's value plus the depth.

    Attributes:
        fields: names -> value at depth 0, of the fields that have counted steps so far.
    """

    source: SteppedSource
    fields: dict[str, int] | None = None
    num_depths: int = 0
    _looks: Counter = field(default_factory=Counter)

    def look(self, depth: int, saved: bytes) -> None:
        """Look at a state; the first three of each depth count."""
        if self._looks[depth] >= 3 or self.fields == {}:
            return
        self._looks[depth] += 1
        self.num_depths = len(self._looks)
        values = self.source.integers(saved)
        if self.fields is None:
            self.fields = {name: value - depth for name, value in values.items()}
        self.fields = {name: at for name, at in self.fields.items() if values.get(name) == at + depth}

    def hold_against(self, states: SteppedStates) -> "ClockSearch":
        """Itself, without any field if a step leads to a state that is not one step farther from the start."""
        outcomes, depths = states.outcomes(), np.array(states.depths)
        rows = np.repeat(np.arange(len(outcomes.offsets) - 1), np.diff(outcomes.offsets))
        goes_on = outcomes.next_states >= 0
        if (depths[outcomes.next_states[goes_on]] != depths[rows[goes_on] // states.num_actions] + 1).any():
            self.fields = {}
        return self

    def lines(self) -> list[str]:
        """A line for each clock."""
        names = sorted(self.fields or ()) if self.num_depths > 2 else []
        return [
            f"{name} equals the number of steps in every state: --ignore {name}, if nothing but a time limit reads it"
            for name in names
        ]
