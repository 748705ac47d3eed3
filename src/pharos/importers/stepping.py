"""Any environment with Gymnasium's interface as an exact tabular MDP, by stepping it from every state.

A state is all that the environment holds, saved in memory (`snapshots`); chance is enumerated exactly (`chance`). Four
nets catch hidden chance: generators that are met while a state is saved, global generators before and after each step,
repeated runs with the same draws, and in the end the environment itself, played with its own generators.
"""

import itertools
import random as python_random
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from pharos.errors import ParameterError, PharosError, RuleError, UnknownName
from pharos.importers import side_effects
from pharos.importers.chance import MOST_OUTCOMES, DrawError, DrawTree, line_of_code, placed
from pharos.importers.folder import IMAGE, VECTOR, ImportedOutcomes
from pharos.importers.gymnasium import SAMPLED_EPISODE, SAMPLED_STEPS, is_unlikely
from pharos.importers.search import (
    END,
    Arrival,
    BreadthFirst,
    Expansions,
    ExpansionsHere,
    SteppedStates,
    mdp_of,
)
from pharos.importers.side_effects import SideEffects
from pharos.importers.snapshots import EnvironmentSnapshots, bare, chain_of, digest_of, field_names, integers_of
from pharos.importers.step_checkpoint import StepCheckpoint
from pharos.importers.step_workers import ExpansionsElsewhere
from pharos.importers.wrappers import Stepped, as_integer, reset
from pharos.mdp import TabularMDP, whole_number
from pharos.system.wording import capped, pluralize
from pharos.system.workers import usable_workers

MOST_STATES = 100_000
CHECKED_COPIES = 50
CHECKED_PAIRS = 200
"""Pairs of different states with one key that are compared: the first 100, and then each tenth."""
WALK_STEPS = 20
"""Steps of a walk from each such pair, as long as nothing is drawn."""
REPEATED = 100
"""Each so many states, and the first 20, are expanded twice."""
MOST_NAMED = 1_024
"""Values of a discrete observation that are shown as a vector of zeros and a one; more are shown as a number."""
PLAIN_ACTIONS = 4_096

Factory: TypeAlias = Callable[[], Stepped]
Visit: TypeAlias = Callable[[Stepped, Any, float, bool], None]
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
        actions: in place of those of a discrete action space.
        max_outcomes: in which the draws of one step may come out.
        copied: fields that are never shared between copies, though they seem constant.
    """

    seed: int | None = None
    ignore: frozenset[str] = frozenset()
    key: Callable[[Stepped], Hashable] | None = None
    reward: Payment | None = None
    actions: tuple[Any, ...] | None = None
    max_outcomes: int = MOST_OUTCOMES
    copied: frozenset[str] = frozenset()


class StepRecording(NamedTuple):
    """Observations, names and notes beside the MDP of `stepping`; `arguments()` are those of `importers.save`.

    Attributes:
        observations: what the environment shows of each state: images (S, H, W, 3) uint8, or vectors (S, N) as
            Gymnasium flattens its space; None where it cannot be flattened.
        observed: "image", "vector" or None.
        outcomes: each outcome with its reward; None where the MDP says it all.
        actions: names of the actions; None: numbers.
        time_limit: of the environment's TimeLimit, in steps; None: it has none.
        depths: (S,) the least number of steps to each state.
        notes: lines for people: clocks among the fields, what was printed.
    """

    observations: np.ndarray | None
    observed: str | None
    outcomes: ImportedOutcomes | None
    actions: tuple[str, ...] | None
    time_limit: int | None
    depths: np.ndarray
    notes: tuple[str, ...]

    def arguments(self) -> dict[str, Any]:
        """Arguments for `importers.save(mdp, folder, **arguments)`."""
        return {name: getattr(self, name) for name in ("observations", "observed", "outcomes", "actions", "time_limit")}


class ConstantChanged(Exception):
    """A table that all copies shared was changed by a step."""


def stepping(  # noqa: PLR0913  (options of one import)
    factory: Factory,
    *,
    seed: int | None = None,
    key: Callable[[Stepped], Hashable] | None = None,
    ignore: Sequence[str] = (),
    reward: Payment | None = None,
    actions: Sequence[Any] | None = None,
    gamma: float | None = None,
    horizon: int | None = None,
    max_states: int = MOST_STATES,
    max_outcomes: int = MOST_OUTCOMES,
    workers: int = 1,
    check: bool = True,
    progress: Callable[[SteppedStates, float, bool], None] | None = None,
) -> tuple[TabularMDP, StepRecording]:
    """Return the exact MDP of any Gymnasium environment, by stepping it from every state that can be reached.

    A state is all that the environment holds: the fields of its objects, wrappers included. Chance is enumerated, by
    generators that branch in place of its own, with exact probabilities: a comparison `random() < p` has probability p.
    States that differ only in what never matters stay apart; `bisimulation.minimize` merges them.

    Args:
        factory: makes the environment; called several times, it must make the same one. Wrappers count: what the
            wrapped environment does is imported. Time limits, recorders and checkers around it are left out.
        seed: of the reset, whose own chance then is not enumerated: one start. None: all starts that it can draw.
        key: (environment) -> what is equal for equal states. Pairs of different states with equal keys are
            compared: each action, and a walk.
        ignore: names of fields that are no part of the state, such as counters of steps; checked in the same way.
            Truncations by the environment itself then do not end an episode; without, they do.
        reward: (reward) -> number, or weights of a vector of rewards.
        actions: what `step` takes; None: all of a discrete space, or of a product of such.
        gamma: discount; None: 1 with a horizon, else 0.99.
        horizon: steps of an episode; states that are first met after so many are not made. None: all states.
        max_states, max_outcomes: of the MDP, and of one step; more are an error.
        workers: processes that share the work, with the same result; the factory must be one that they can import.
        check: whether a new environment is played with its own generators and compared with the MDP.
        progress: called now and then with (states so far, seconds, whether it is finished).
    Returns:
        (MDP, recording). Transitions that end an episode have no next state.
    Raises:
        RuleError: a draw has no finite list of outcomes, chance comes from outside, a state cannot be copied, a key
            merges what behaves differently; the line of the environment's code is named.
        StateSpaceTooLarge: there are more than `max_states` states.
        ParameterError: the environment has no list of actions, or an argument is wrong.
    Cost: 0.05 to 1 ms for each outcome of each state and action; 0.5 to 6 kB for each state of the frontier.
    """
    options = SteppingOptions(
        seed=seed,
        key=key,
        ignore=frozenset([ignore] if isinstance(ignore, str) else ignore),
        reward=reward,
        actions=None if actions is None else tuple(actions),
        max_outcomes=whole_number(max_outcomes, "max_outcomes", "a number of at least 1"),
    )
    run = SteppingRun(factory, options, horizon=horizon, max_states=max_states, check=check, workers=workers)
    return run.finish(gamma, progress)


@dataclass
class SteppingRun:
    """One import of an environment, from its first reset to the MDP.

    Args:
        factory, options: of `stepping`. horizon, max_states, check: as there.
        checkpoint: keeps what is finished in a folder; None: nothing is kept.
        workers: processes that expand states; 1: this one does.
    """

    factory: Factory
    options: SteppingOptions
    horizon: int | None = None
    max_states: int = MOST_STATES
    check: bool = True
    checkpoint: StepCheckpoint | None = None
    workers: int = 1

    def __post_init__(self) -> None:
        if self.horizon is not None:
            self.horizon = whole_number(self.horizon, "horizon", "a number of steps of at least 1")
        self.workers = usable_workers(self.workers)
        self.max_states = whole_number(self.max_states, "max_states", "a number of at least 1")

    def finish(
        self, gamma: float | None, progress: Callable[[SteppedStates, float, bool], None] | None = None
    ) -> tuple[TabularMDP, StepRecording]:
        """The MDP and the recording."""
        with side_effects.undone():
            source = SteppedEnvironment(self.factory, self.options)
            try:
                states, clocks = self._states(source, progress)
            except ConstantChanged as change:
                if self.checkpoint is not None:
                    self.checkpoint.discard()
                copied = self.options.copied | {str(change)}
                return replace(self, options=replace(self.options, copied=copied)).finish(gamma, progress)
            if self.check:
                FreshPlay(source, states, self.horizon).compare()
        gamma = gamma if gamma is not None else 0.99 if self.horizon is None else 1.0
        mdp, outcomes = mdp_of(states, gamma=gamma, horizon=self.horizon)
        observations, observed = source.observer.stacked(states.observations)
        notes = (*clocks.lines(), *source.observer.notes, *(f"{source.name}: {line}" for line in source.effects.lines))
        limit, depths = source.time_limit, np.array(states.depths)
        return mdp, StepRecording(observations, observed, outcomes, source.action_names, limit, depths, notes)

    def _states(
        self, source: "SteppedEnvironment", progress: Callable[[SteppedStates, float, bool], None] | None
    ) -> tuple[SteppedStates, "ClockSearch"]:
        clocks = ClockSearch(source)
        search = BreadthFirst(
            source,
            horizon=self.horizon,
            max_states=self.max_states,
            too_large=lambda states: _too_large(source.name, states, clocks.lines()),
            on_state=clocks.look,
        )
        if progress is not None:
            search.report = progress
        if self.checkpoint is not None:
            search.checkpoint = self.checkpoint.save
        states, frontier = (self.checkpoint.resume if self.checkpoint else BreadthFirst.begin)(search)
        pool: Expansions
        pool = ExpansionsHere(source) if self.workers == 1 else ExpansionsElsewhere(source, self.workers)
        try:
            search.run(states, frontier, pool)
        finally:
            pool.close()
            if self.checkpoint is not None:
                self.checkpoint.write(states)
        source.check_constants()
        return states, clocks


def _too_large(name: str, states: SteppedStates, clocks: Sequence[str]) -> str:
    depth, left = int(states.depths[states.num_expanded]), states.num_states - states.num_expanded
    text = f"{name}: more than {states.num_states:,} states after {pluralize(depth, 'step')}, {left:,} to expand; "
    total = sum(states.layers[: depth + 1])
    text += f"raise it (--max-states), --horizon {depth + 1} has {total:,}" if depth else "raise it (--max-states)"
    return f"{text}, or leave out fields that do not matter (--ignore FIELD)" + "".join(f"; {line}" for line in clocks)


# Stepping -------------------------------------------------------------------------------------------------------------


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
            self.actions, self.action_names = _actions_of(self._env, options.actions, self.name)
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
        return bare(env)

    def key_of(self, env: Stepped) -> bytes:
        """Key of the state that an environment is in."""
        if self.options.key is None:
            return self.snapshots.digest(env)
        value = self._calling("the key", partial(self.options.key, env))
        return digest_of(value)

    def starts(self) -> list[Arrival]:
        """The states in which episodes start, with their probabilities."""
        return self._guarded({"reset()": self._reset_runs}, is_repeated=True)[0]

    def expand(self, saved: bytes) -> list[list[Arrival]]:
        """The outcomes of each action in a saved state."""
        self._num_expanded += 1
        is_repeated = self._num_expanded <= 20 or self._num_expanded % REPEATED == 0
        runs = {f"step({action})": partial(self._step_runs, saved, action) for action in self.actions}
        rows = self._guarded(runs, is_repeated=is_repeated)
        if self._num_expanded <= CHECKED_COPIES or self._num_expanded % REPEATED == 0:
            self.check_constants()
        return rows

    def arrive(self, saved: bytes | None, action: int, script: Sequence[int]) -> Arrival:
        """Go where a step with these draws went before: from a saved state, or from the reset (None)."""
        with self.effects.watched():
            self.draws.replay(script)
            env = self.snapshots.restore(self._blank if saved is None else saved)
            if saved is None:
                is_seeded, payment, ended = self.options.seed is not None, 0.0, False
                observation = self._observation if is_seeded else self._reset(env)
            else:
                observation, payment, ended = self._step(env, self.actions[action])
            key = None if ended else self.key_of(env)
            self._sent.update(() if key is None else [key])
            return self._arrival(env, key, observation, payment)

    def skip(self, keys: Sequence[bytes]) -> None:
        """Hand over no saved states of these keys, which others have."""
        self._sent.update(keys)

    def check_constants(self) -> None:
        """Raise ConstantChanged if a table that copies share was changed."""
        name = self.snapshots.changed_constant(self._env)
        if name is not None:
            raise ConstantChanged(name)

    # Runs -------------------------------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Reset once, so that generators are there that are made when they are first used; and share large tables."""
        observation = self._reset(self._env, 0 if self.options.seed is None else self.options.seed)
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
                    self._reset(env)
                is_over = self._step(env, rng.choice(self.actions))[2]
        finally:
            self.draws.sampler = None

    def _reset(self, env: Stepped, seed: int | None = None) -> Any:
        return self._calling("reset()", lambda: reset(env, seed))

    def _step(self, env: Stepped, action: Any) -> tuple[Any, float, bool]:
        """(observation, reward, whether the episode ends)."""
        what = f"step({action})"
        answer = self._calling(what, lambda: env.step(action))
        if not isinstance(answer, tuple) or len(answer) not in (4, 5):
            raise RuleError(f"{self.name}: {what} returned {capped(answer)}; expected (observation, reward, ...)")
        observation, payment, ended, *rest = answer
        truncated = len(rest) > 1 and bool(rest[0]) and not self.options.ignore
        return observation, self._calling(what, lambda: self._paid(payment)), bool(ended) or truncated

    def _paid(self, payment: Any) -> float:
        """The reward as a number."""
        own = self.options.reward
        if callable(own):
            payment = own(payment)
        elif own is not None:
            payment = float(np.dot(np.asarray(payment, float), np.asarray(own, float)))
        if np.ndim(payment) and np.size(payment) != 1:
            raise ParameterError(
                f"{self.name}: pays a vector of {np.size(payment)} rewards; give weights, such as "
                f"reward=({', '.join(['1.0'] * np.size(payment))}) (--weights 1,...), or a function of it"
            )
        number = float(np.asarray(payment).item() if np.ndim(payment) else payment)
        if not np.isfinite(number):
            raise RuleError(f"{self.name}: pays {number}; expected a finite number")
        return number

    def _calling(self, what: str, function: Callable[[], Any]) -> Any:
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
            reason = placed(f"{type(error).__name__}: {capped(' '.join(str(error).split()))}", _line_of(error))
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

    def _step_runs(self, saved: bytes, action: Any, visit: Visit) -> None:
        """Visit each outcome of a step."""
        for _ in self._enumerated(f"step({action})"):
            env = self.snapshots.restore(saved)
            visit(env, *self._step(env, action))

    def _enumerated(self, what: str) -> Iterator[None]:
        try:
            yield from self.draws.runs()
        except DrawError as error:
            raise DrawError(f"{self.name}: {what}: {error}") from None

    # Nets -------------------------------------------------------------------------------------------------------------

    def _guarded(self, runs: Mapping[str, Run], *, is_repeated: bool) -> list[list[Arrival]]:
        """The outcomes of a reset or of each step; errors if they depend on anything but the state and the draws."""
        rows: list[list[Arrival]] = []

        def visit(env: Stepped, observation: Any, payment: float, ended: bool) -> None:
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

        def visit(env: Stepped, _: Any, payment: float, ended: bool) -> None:
            signatures.append((self.draws.probability, None if ended else self.key_of(env), payment))

        run(visit)
        return signatures

    def _check_repetition(self, what: str, run: Run, before: list[tuple]) -> None:
        """RuleError if the same draws lead elsewhere the second time."""
        if self._signatures(run) != before:
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

    def _new_arrival(self, env: Stepped, key: bytes | None, observation: Any, payment: float) -> Arrival:
        """The outcome that was just stepped to; with the state where this is the first time."""
        probability, script = self.draws.probability, self.draws.script
        if key is not None and key not in self._sent:
            self._sent.add(key)
            return self._arrival(env, key, observation, payment)
        if key is not None and (self.options.key is not None or self.options.ignore):
            self._check_pair(env, key)
        return Arrival(probability, payment, key, script=script)

    def _arrival(self, env: Stepped, key: bytes | None, observation: Any, payment: float) -> Arrival:
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
                    raise self._refused_merge(f"action {number}", _difference(one, other))
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
                _, payment, ended = self._step(env, self.actions[number])
                steps.append(Counter({(None if ended else self.key_of(env), payment): 1}))
                if self.draws.script:
                    return
            if steps[0] != steps[1]:
                names = ", ".join(map(str, actions[:count]))
                raise self._refused_merge(f"actions {names}", _difference(steps[0], steps[1]))
            if ended:
                return

    def _refused_merge(self, after: str, difference: str) -> RuleError:
        left = "the key leaves" if self.options.key is not None else "--ignore leaves"
        return RuleError(
            f"{self.name}: two states with the same key behave differently ({after}: {difference}): {left} out "
            f"something that matters"
        )

    def _shares(self, saved: bytes, action: Any) -> dict[tuple, Fraction]:
        """(key, reward) -> probability."""
        shares: dict[tuple, Fraction] = {}
        for probability, key, payment in self._signatures(partial(self._step_runs, saved, action)):
            shares[key, payment] = shares.get((key, payment), Fraction(0)) + probability
        return shares


def _signature(arrival: Arrival) -> tuple:
    return arrival.probability, arrival.key, arrival.reward


def _difference(one: Counter, other: Counter) -> str:
    """Words on two distributions over (key, reward) that differ."""
    rewards = [sorted({payment for _, payment in each}) for each in (one, other)]
    if rewards[0] != rewards[1]:
        first, second = (", ".join(f"{payment:g}" for payment in each[:3]) for each in rewards)
        return f"reward {first} and {second}"
    ends = [sum(p for (key, _), p in each.items() if key is None) for each in (one, other)]
    if ends[0] != ends[1]:
        return f"it ends with probability {float(ends[0]):g} and {float(ends[1]):g}"
    return "they lead to different states, or with different probabilities"


def _line_of(error: BaseException) -> str:
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


# Actions and observations ---------------------------------------------------------------------------------------------


def _actions_of(
    env: Stepped, actions: tuple[Any, ...] | None, name: str
) -> tuple[tuple[Any, ...], tuple[str, ...] | None]:
    """(what `step` takes, names of the actions or None)."""
    if actions is not None:
        if not actions:
            raise ParameterError(f"{name}: actions are empty; expected one or more")
        return actions, None
    space = getattr(env, "action_space", None)
    listed = _listed_actions(space)
    if listed is None:
        raise ParameterError(
            f"{name}: its actions are {capped(space)}; expected a discrete space or a product of such, or actions=, a "
            f"list of what step takes"
        )
    return listed, _action_names(getattr(env, "unwrapped", env), listed)


def _listed_actions(space: Any) -> tuple[Any, ...] | None:
    """All actions of a space; None where they are not finitely many, or no product of numbers."""
    kind = type(space).__name__
    if kind == "Discrete":
        start = int(getattr(space, "start", 0))
        return tuple(range(start, start + int(space.n)))
    if kind in ("MultiDiscrete", "MultiBinary"):
        sizes = np.ravel(space.nvec) if kind == "MultiDiscrete" else np.full(space.shape, 2).ravel()
        starts = np.ravel(getattr(space, "start", np.zeros(len(sizes), int)))
        if np.prod(sizes.astype(float)) > PLAIN_ACTIONS:
            return None
        ranges = [range(int(low), int(low) + int(n)) for low, n in zip(starts, sizes, strict=True)]
        return tuple(np.array(each, space.dtype).reshape(space.shape) for each in itertools.product(*ranges))
    if kind == "Tuple":
        parts = [_listed_actions(each) for each in space.spaces]
        whole = [each for each in parts if each is not None]
        return tuple(itertools.product(*whole)) if len(whole) == len(parts) else None
    return None


def _action_names(env: Stepped, actions: tuple[Any, ...]) -> tuple[str, ...] | None:
    """Names that an environment gives to its actions; None where it gives none."""
    names: list[str] = []
    if hasattr(env, "get_action_meanings"):
        names = [str(each) for each in env.get_action_meanings()]
    elif hasattr(getattr(env, "actions", None), "__members__"):
        names = list(env.actions.__members__)
    is_fitting = len(names) == len(actions) and len(set(names)) == len(names) and all(names)
    if not is_fitting and actions and isinstance(actions[0], np.ndarray | tuple):
        return tuple(",".join(map(str, np.ravel(action))) for action in actions)
    return tuple(names) if is_fitting else None


class SpaceRecorder:
    """Observations of an environment as images or vectors.

    Attributes:
        notes: lines on what is not recorded.
    """

    def __init__(self, space: Any, name: str):
        self.notes: list[str] = []
        self._parts: list[str] | None = None
        self._space = space
        shape, dtype = getattr(space, "shape", None), getattr(space, "dtype", None)
        self._is_image = type(space).__name__ == "Box" and dtype == np.uint8 and shape is not None and shape[2:] == (3,)
        self._is_shown = self._is_image or self._can_flatten(space)
        if not self._is_shown and type(space).__name__ == "Dict":
            from gymnasium.spaces import Dict

            parts = {part: each for part, each in space.spaces.items() if self._can_flatten(each)}
            others = sorted(set(space.spaces) - set(parts))
            self._parts, self._space, self._is_shown = list(parts), Dict(parts), bool(parts)
            self.notes.append(f"{name}: of its observation, {', '.join(others)} cannot be flattened, and is left out")
        elif not self._is_shown:
            self.notes.append(f"{name}: its observations, {capped(space, 80)}, cannot be flattened; none are recorded")

    @staticmethod
    def _can_flatten(space: Any) -> bool:
        from gymnasium import spaces

        try:
            return isinstance(space, spaces.Space) and space.is_np_flattenable and spaces.flatdim(space) > 0
        except (NotImplementedError, ValueError):
            return False

    def shown(self, observation: Any) -> np.ndarray | None:
        """An observation as an array; None where none are recorded."""
        if not self._is_shown:
            return None
        if self._is_image:
            return np.array(observation, np.uint8)
        if self._parts is not None:
            observation = {part: observation[part] for part in self._parts}
        if type(self._space).__name__ == "Discrete" and self._space.n > MOST_NAMED:
            return np.array([as_integer(observation)])
        from gymnasium.spaces import flatten

        return np.asarray(flatten(self._space, observation)).ravel()

    def stacked(self, observations: Sequence[np.ndarray | None]) -> tuple[np.ndarray | None, str | None]:
        """(the observations of all states, their kind)."""
        rows = [row for row in observations if row is not None]
        if not self._is_shown or len(rows) < len(observations):
            return None, None
        array = np.stack(rows)
        if array.dtype.kind in "iu" and array.size and array.min() >= 0 and array.max() <= 255:
            array = array.astype(np.uint8)
        return array, IMAGE if self._is_image else VECTOR


@dataclass
class ClockSearch:
    """Fields that count steps: their value is that of the first state plus the depth, in each state that is looked at.

    Attributes:
        fields: names -> value at depth 0, those that did so far.
    """

    source: SteppedEnvironment
    fields: dict[str, int] | None = None
    num_depths: int = 0
    _looks: Counter = field(default_factory=Counter)

    def look(self, depth: int, saved: bytes) -> None:
        """Look at a state; the first three of each depth count."""
        if self._looks[depth] >= 3 or self.fields == {}:
            return
        self._looks[depth] += 1
        self.num_depths = len(self._looks)
        values = integers_of(self.source.snapshots.restore(saved), self.source.options.ignore)
        if self.fields is None:
            self.fields = {name: value - depth for name, value in values.items()}
        self.fields = {name: at for name, at in self.fields.items() if values.get(name) == at + depth}

    def lines(self) -> list[str]:
        """A line for each clock."""
        names = sorted(self.fields or ()) if self.num_depths > 2 else []
        return [
            f"{name} equals the number of steps in every state: --ignore {name}, if nothing but a time limit reads it"
            for name in names
        ]


# The environment itself beside the MDP --------------------------------------------------------------------------------


class FreshPlay:
    """A new environment with its own generators, played and compared with the states that stepping found.

    Args:
        horizon: of the exploration, whose last states were not made.
    """

    def __init__(self, source: SteppedEnvironment, states: SteppedStates, horizon: int | None):
        self.source, self.states, self.horizon = source, states, horizon
        self.rng = np.random.default_rng(0)
        self.tries = Counter[tuple[int, int]]()
        self.samples: dict[int, Counter] = {}

    def compare(self) -> None:
        """RuleError if the environment does what the table says to be impossible, or with other frequencies."""
        num_pairs = self.states.num_states * self.states.num_actions
        left, episode = min(SAMPLED_STEPS, 1_000 + 20 * num_pairs), 0
        with self.source.effects.watched():
            env = self._made()
            while left > 0:
                env, state = self._start(env, episode)
                left -= self._episode(env, state)
                episode += 1
        self._check_frequencies()

    def _made(self) -> Stepped:
        """A new environment; RuleError if its tables are others."""
        source = self.source
        env, _ = source.made()
        reset(env, 0 if source.options.seed is None else source.options.seed)
        name = source.snapshots.adopt(env)
        if name is not None:
            raise RuleError(
                f"{source.name}: {name} differs between two environments that the factory made; give the factory a "
                f"seed, so that it makes the same one each time"
            )
        return env

    def _start(self, env: Stepped, episode: int) -> tuple[Stepped, int]:
        """(the environment at the start of an episode, the number of its state); a new environment where needed."""
        for attempt in range(2):
            if attempt:
                env = self._made()
            if self.source.options.seed is None:
                reset(env, episode)
                reset(env)
            else:
                reset(env, self.source.options.seed)
                _reseed(env, episode)
            number = self.states.numbers.get(self.source.key_of(env))
            if number is not None and number in self.states.starts:
                return env, number
        raise RuleError(
            f"{self.source.name}: a reset of a new environment leads to a state that stepping did not find among its "
            f"starts: the factory makes different environments, or chance comes from outside"
        )

    def _episode(self, env: Stepped, state: int) -> int:
        """Number of steps that were compared."""
        for step in range(SAMPLED_EPISODE):
            counts = [self.tries[state, action] for action in range(self.states.num_actions)]
            is_any = self.rng.random() < 0.5
            options = np.flatnonzero(np.array(counts) <= (max(counts) if is_any else min(counts)))
            action = int(options[self.rng.integers(len(options))])
            self.tries[state, action] += 1
            _, payment, ended = self.source._step(env, self.source.actions[action])
            next_state = END if ended else self.states.numbers.get(self.source.key_of(env))
            self._check_outcome(state, action, next_state, payment)
            if next_state is None or next_state == END:
                return step + 1
            state = next_state
        return SAMPLED_EPISODE

    def _check_outcome(self, state: int, action: int, next_state: int | None, payment: float) -> None:
        row = state * self.states.num_actions + action
        start, stop = self.states.offsets[row], self.states.offsets[row + 1]
        is_last = self.horizon is not None and self.states.depths[state] + 1 >= self.horizon
        to = END if next_state is None and is_last else next_state
        for outcome in range(start, stop):
            if self.states.next_states[outcome] == to and self.states.rewards[outcome] == payment:
                self.samples.setdefault(row, Counter())[outcome - start] += 1
                return
        raise RuleError(
            f"{self.source.name}: played with its own generators, action {action} in state {state} had an outcome that "
            f"stepping did not find (reward {payment:g}): {self._reason()}"
        )

    def _reason(self) -> str:
        if self.source.options.key is not None or self.source.options.ignore:
            return "the key, or what is ignored, leaves out something that matters"
        return "its chance comes from elsewhere (time, files, threads, C++), or a copy shares what a step changes"

    def _check_frequencies(self) -> None:
        for row, counts in self.samples.items():
            start, stop = self.states.offsets[row], self.states.offsets[row + 1]
            shares = np.array(self.states.probabilities[start:stop])
            sampled = np.array([counts[outcome] for outcome in range(stop - start)])
            if len(shares) > 1 and is_unlikely(sampled, shares, len(self.samples)):
                state, action = divmod(row, self.states.num_actions)
                raise RuleError(
                    f"{self.source.name}: played with its own generators, action {action} in state {state} had its "
                    f"outcomes {', '.join(map(str, sampled[:5]))} times, which stepping gives the probabilities "
                    f"{', '.join(f'{p:.3g}' for p in shares[:5])}: its chance comes from elsewhere"
                )


def _reseed(env: Stepped, seed: int) -> None:
    """Put the generators among an environment's fields into another state."""
    for each in chain_of(env):
        for value in vars(each).values():
            if isinstance(value, np.random.Generator):
                value.bit_generator.state = type(value.bit_generator)(seed).state
            elif isinstance(value, np.random.RandomState):
                value.set_state(np.random.RandomState(seed).get_state())
            elif isinstance(value, python_random.Random):
                value.seed(seed)
