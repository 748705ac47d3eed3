"""Any environment with Gymnasium's interface as an exact tabular MDP, by stepping it from every state.

A state is all that the environment holds, saved in memory (`snapshots`); chance is enumerated exactly (`chance`). Four
nets catch hidden chance: generators that are met while a state is saved, global generators before and after each step,
repeated runs with the same draws, and in the end the environment itself, played with its own generators.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pharos.importers import side_effects
from pharos.importers.chance import MOST_DRAW_OUTCOMES
from pharos.importers.folder import ImportedOutcomes
from pharos.importers.search import BreadthFirst, SteppedStates, mdp_of
from pharos.importers.step_checkpoint import StepCheckpoint
from pharos.importers.stepped_environment import (
    ClockSearch,
    ConstantChanged,
    Factory,
    Payment,
    SteppedEnvironment,
    SteppedSource,
    SteppingOptions,
)
from pharos.importers.wrappers import Stepped
from pharos.mdp import TabularMDP, whole_number
from pharos.system.wording import pluralize
from pharos.system.workers import usable_workers

MOST_STEPPED_STATES = 100_000


class StepRecording(NamedTuple):
    """Observations, names and notes beside the MDP of `stepping`; `arguments()` are arguments of `importers.save`.

    Attributes:
        observations: what the environment shows of each state: images (S, H, W, 3) uint8, or vectors (S, N) as
            Gymnasium flattens its space; None if it cannot be flattened.
        observed: "image", "vector" or None.
        outcomes: each outcome with its reward; None if the MDP says it all.
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
    max_states: int = MOST_STEPPED_STATES,
    max_outcomes: int = MOST_DRAW_OUTCOMES,
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
        source_of: makes the source of states of a factory.
    """

    factory: Factory
    options: SteppingOptions
    horizon: int | None = None
    max_states: int = MOST_STEPPED_STATES
    check: bool = True
    checkpoint: StepCheckpoint | None = None
    workers: int = 1
    source_of: Callable[[Any, SteppingOptions], SteppedSource] = SteppedEnvironment

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
            source = self.source_of(self.factory, self.options)
            try:
                states, clocks = self._states(source, progress)
            except ConstantChanged as change:
                if self.checkpoint is not None:
                    self.checkpoint.discard()
                copied = self.options.copied | {str(change)}
                return replace(self, options=replace(self.options, copied=copied)).finish(gamma, progress)
            if self.check:
                source.compare(states, self.horizon)
        gamma = gamma if gamma is not None else 0.99 if self.horizon is None else 1.0
        mdp, outcomes = mdp_of(states, gamma=gamma, horizon=self.horizon)
        observations, observed = source.observer.stacked(states.observations)
        clocks = clocks.hold_against(states)
        notes = (*clocks.lines(), *source.observer.notes, *(f"{source.name}: {line}" for line in source.effects.lines))
        limit, depths = source.time_limit, np.array(states.depths)
        return mdp, StepRecording(observations, observed, outcomes, source.action_names, limit, depths, notes)

    def _states(
        self, source: SteppedSource, progress: Callable[[SteppedStates, float, bool], None] | None
    ) -> tuple[SteppedStates, ClockSearch]:
        clocks = ClockSearch(source)
        search = BreadthFirst(
            source,
            horizon=self.horizon,
            max_states=self.max_states,
            too_large=lambda states: _too_large(source.name, states, clocks.hold_against(states).lines()),
            on_state=clocks.look,
        )
        if progress is not None:
            search.report = progress
        if self.checkpoint is not None:
            search.checkpoint = self.checkpoint.save
        states, frontier = (self.checkpoint.resume if self.checkpoint else BreadthFirst.begin)(search)
        pool = source.expansions(self.workers)
        try:
            search.run(states, frontier, pool)
        finally:
            pool.close()
            if self.checkpoint is not None:
                self.checkpoint.write(states)
        source.check_rest()
        return states, clocks


def _too_large(name: str, states: SteppedStates, clocks: Sequence[str]) -> str:
    depth, left = int(states.depths[states.num_expanded]), states.num_states - states.num_expanded
    text = f"{name}: more than {states.num_states:,} states after {pluralize(depth, 'step')}, {left:,} to expand; "
    total = sum(states.layers[: depth + 1])
    text += f"raise it (--max-states), --horizon {depth + 1} has {total:,}" if depth else "raise it (--max-states)"
    return f"{text}, or leave out fields that do not matter (--ignore FIELD)" + "".join(f"; {line}" for line in clocks)
