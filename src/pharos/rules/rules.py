"""The rules of one environment, behind one interface: `rules_of(env)`.

Two engines run them, the first that can:

    compiled     by Numba, inside the loops that search, step and draw (compiled.py)
    interpreted  in Python, state by state, while building in as many processes as there are workers (interpreted.py,
                 stepping.py)

If Numba cannot compile a rule, this file gives one warning for each class of environments and use, and takes the
other engine. In both engines, a rule that fails is a RuleError that names the state and the action.
"""

import contextlib
import warnings
from collections.abc import Callable
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np

from pharos.environments import Environment
from pharos.kernels.stepping import EnvironmentBatch, Setting
from pharos.rules.compiled import (
    NO_RANKS,
    CompiledAges,
    CompiledDrawing,
    CompiledExpansion,
    CompiledMotion,
    CompiledRewards,
    CompiledStepping,
    explored,
    is_kept,
    signature_of,
)
from pharos.rules.compiler import reason_of
from pharos.rules.layout import Layout, layout_of
from pharos.system import compiling
from pharos.system.arrays import Indices

Engine = TypeVar("Engine")
Reasons = dict[tuple[object, ...] | None, str]  # signature of the instances -> why Numba does not compile them


class Expansion(Protocol):
    """Successors of packed states, looked up in a table of states (kernels/hash_table.py).

    See exploration.py for the arrays. A state has B branches: one for each of A actions, or, with chance, branch a K +
    k for outcome k of action a, of which impossible ones lead to the state itself. `probabilities` (rows, B) gets the
    probabilities of the branches. It has no rows without chance.

    Raises:
        RuleError: a rule failed, or left the declared ranges.
    """

    is_compiled: bool

    def threads(self, workers: int) -> int:
        """Number of threads that may call `expand_and_find` at a time, of `workers`."""

    def explore(
        self,
        states: np.ndarray,
        successors: np.ndarray,
        terminal: np.ndarray,
        probabilities: np.ndarray,
        table: np.ndarray,
        base: int,
        last: int,
        room: int,
        progress: np.ndarray,
    ) -> None:
        """Breadth-first search: expand and number states until `last`, until `room` is used up, or for a while."""

    def expand_and_find(
        self,
        states: np.ndarray,
        start: int,
        stop: int,
        base: int,
        keys: np.ndarray,
        indices: np.ndarray,
        terminal: np.ndarray,
        probabilities: np.ndarray,
        table: np.ndarray,
    ) -> None:
        """Write successors of states [start, stop) to keys, and to indices their indices, or -1 - slot if missing."""

    def close(self) -> None:
        """End the processes that run rules, if there are any."""


class TransitionRewards(Protocol):
    """Rewards of stored transitions of packed states."""

    def threads(self, workers: int) -> int:
        """Number of threads that may call `block` at a time, of `workers`."""

    def block(self, states: np.ndarray, successors: Indices, terminal: np.ndarray, start: int, stop: int) -> np.ndarray:
        """Rewards (stop - start, A) float64 of states [start, stop), 0 in terminal states.

        Raises:
            RuleError: the rule raised an exception.
        """

    def expected_block(
        self,
        states: np.ndarray,
        outcomes: tuple[np.ndarray, Indices, np.ndarray],
        terminal: np.ndarray,
        start: int,
        stop: int,
        ranks: np.ndarray = NO_RANKS,
        largest: np.ndarray | None = None,
    ) -> np.ndarray:
        """Expected rewards (stop - start, A) of states [start, stop), with chance.

        Args:
            outcomes: three arrays: which (N,) int64, ascending, (s - start) A + a of each outcome, successors (N,)
                int64, its next state, and probabilities (N,).
            ranks: (N,) int64, which one of the possible outcomes of its state and action each is, -1 for an action
                without effect. Without entries they are all, in their order.
            largest: (1,) float64, raised to the largest absolute reward that was averaged with a different one.
        """


class Ages(Protocol):
    """Ages of packed states, of a class that has them."""

    def block(self, states: np.ndarray, start: int, stop: int) -> np.ndarray:
        """Ages (stop - start,) int64 of states [start, stop)."""


class Stepping(Protocol):
    """Steps of one environment and of many. States are rows of int64. See interaction.py for the arrays.

    Attributes:
        parameters: the first argument of each function.
    """

    is_compiled: bool
    parameters: tuple[object, ...]

    def outcome_one(
        self, parameters: tuple[object, ...], state: np.ndarray, action: int, u: float, /
    ) -> tuple[int, float]:
        """(outcome, its probability) of an action, drawn by a number u in [0, 1)."""

    def step_one(
        self,
        parameters: tuple[object, ...],
        ranges: np.ndarray,
        scale: np.ndarray,
        state: np.ndarray,
        branch: int,
        next_state: np.ndarray,
        vector: np.ndarray,
        /,
    ) -> tuple[float, int]:
        """(reward, code) of one step. next_state gets the next state, vector its vector.

        branch: an action, or a K + k for outcome k of K of action a, or -1 - a for action a without effect.
        """

    def step_many(
        self, parameters: tuple[object, ...], setting: Setting, batch: EnvironmentBatch, first: int, last: int, /
    ) -> int:
        """One step of many environments. Returns -1, or i D + c if component c of environment i left its range."""

    def is_terminal_one(self, parameters: tuple[object, ...], state: np.ndarray, /) -> bool:
        """Whether a state is terminal."""

    def mark_available(self, states: np.ndarray, out: np.ndarray) -> None:
        """out[n, a] = whether action a is available in states[n], (N, D). All are in terminal states."""

    def step_and_draw_one(self, *arguments: object) -> Callable[..., tuple[float, int]] | None:
        """The function that steps and draws, for these arguments after the parameters. None if there is none."""


class Rules:
    """The rules of one environment, each use by the fastest engine that can. Nothing is compiled before it is used.

    Attributes:
        env: the environment. layout: of its components in packed states.
        exploration: for building state spaces.
        rewards: for the rewards of built ones. ages: for their ages, if the class has some.
        stepping: for interaction.
    """

    def __init__(self, env: Environment, workers: int = 1):
        self.env, self._workers = env, workers
        self.layout: Layout = layout_of(env.components)

    @cached_property
    def exploration(self) -> Expansion:
        compiled = compiled_or_none(CompiledExpansion, self.env, self.layout)
        if compiled is not None:
            return compiled
        from pharos.rules.interpreted import InterpretedExpansion  # which few need

        return InterpretedExpansion(self.env, self.layout, self._workers)

    @cached_property
    def first_exploration(self) -> Expansion:
        """The interpreted engine, for the first states, which are all of a small space."""
        from pharos.rules.interpreted import InterpretedExpansion

        return InterpretedExpansion(self.env, self.layout)

    @property
    def is_ready(self) -> bool:
        """Whether this process has compiled rules of the class, and explores by them."""
        return type(self.env) in explored

    @cached_property
    def is_kept(self) -> bool:
        """Whether compiled exploration is loaded sooner than many states are interpreted: it is on disk."""
        try:
            return is_kept(self.env, self.layout)
        except Exception:  # the warning comes when it is compiled
            return False

    def rewards_of(self, num_states: int) -> TransitionRewards:
        """Rewards of the transitions of `num_states` states in all. Few are interpreted."""
        from pharos.rules.interpreted import InterpretedRewards

        is_small = num_states * self.env.num_actions * self.env.outcomes < compiling.SMALL_STATES // 4
        return InterpretedRewards(self.env, self.layout) if is_small else self.rewards

    @cached_property
    def rewards(self) -> TransitionRewards:
        compiled = compiled_or_none(CompiledRewards, self.env, self.layout)
        if compiled is not None:
            return compiled
        from pharos.rules.interpreted import InterpretedRewards

        return InterpretedRewards(self.env, self.layout)

    @cached_property
    def ages(self) -> Ages:
        compiled = compiled_or_none(CompiledAges, self.env, self.layout)
        if compiled is not None:
            return compiled
        from pharos.rules.interpreted import InterpretedAges

        return InterpretedAges(self.env, self.layout)

    def available(self, states: np.ndarray) -> np.ndarray | None:
        """(N, A) bool, the actions that exist in each of the states (N, D). None if every action exists everywhere."""
        if not self.env.has_sets:
            return None
        out = np.empty((len(states), self.env.num_actions), np.bool_)
        is_small = out.size < compiling.SMALL_STATES // 4
        if is_small and "stepping" not in vars(self):
            from pharos.rules.stepping import InterpretedStepping

            InterpretedStepping(self.env).mark_available(states, out)
        else:
            self.stepping.mark_available(np.ascontiguousarray(states, np.int64), out)
        return out

    @cached_property
    def stepping(self) -> Stepping:
        compiled = compiled_or_none(CompiledStepping, self.env)
        if compiled is not None:
            return compiled
        from pharos.rules.stepping import InterpretedStepping

        return InterpretedStepping(self.env)

    def drawing(
        self, kernel: str, interpreted: Callable[..., None], *arguments: object, motion: bool = False
    ) -> Callable[..., None]:
        """A function that draws states, compiled if Numba can.

        Args:
            kernel: its name in interaction.py.
            interpreted: the function that draws if Numba cannot compile it.
            arguments: of a first call, for no states, which compiles it.
            motion: whether the planes of `draw_motion` follow the planes of `draw`.
        """
        engine = CompiledMotion if motion else CompiledDrawing
        compiled = compiled_or_none(engine, self.env, kernel, *arguments)
        return interpreted if compiled is None else compiled

    def reason_not_compiled(self) -> str:
        """The reason why Numba does not compile exploration and rewards, or "" if it does. Does not warn."""
        return "".join(_reason(engine, self.env, self.layout)[1] for engine in (CompiledExpansion, CompiledRewards))


def rules_of(env: Environment, *, workers: int = 1) -> Rules:
    """The rules of `env`.

    Args:
        workers: processes that share the work of rules that Numba cannot compile (cost only).
    Raises:
        RuleError: the class declares its outcomes otherwise than the contract says.
    """
    _ = env.has_chance
    return Rules(env, workers)


# by (engine, class)
_reasons: dict[tuple[object, type], Reasons] = {}
_warned: set[tuple[type, object]] = set()


def compiled_or_none(engine: Callable[..., Engine], env: Environment, *arguments: object) -> Engine | None:
    """The compiled engine. None, after one warning for each class, if Numba cannot compile it."""
    compiled, reason = _reason(engine, env, *arguments)
    if reason and (type(env), engine) not in _warned:
        _warned.add((type(env), engine))
        warnings.warn(f"{type(env).__name__}: {not_compiled(reason)}", RuntimeWarning, stacklevel=5)
    return compiled


def not_compiled(reason: str) -> str:
    """The sentence that says why rules are interpreted."""
    how = "interpreted, by all workers of a build, up to 100 times slower"
    return f"Numba cannot compile its rules, so they run {how}: {reason}"


def _reason(engine: Callable[..., Engine], env: Environment, *arguments: object) -> tuple[Engine | None, str]:
    """(engine, ""), or (None, the reason why there is none). A class that failed to compile once is not tried again."""
    failed = _reasons.setdefault((engine, type(env)), {})
    try:
        key = (signature_of(env), *(each for each in arguments if isinstance(each, str))) if failed else None
        if key not in failed:
            return engine(env, *arguments), ""
    except Exception as error:  # Numba raises its own errors, and others from inside of it
        return None, _record_failure(failed, env, arguments, reason_of(error))
    return None, failed[key]


def _record_failure(failed: Reasons, env: Environment, arguments: tuple, reason: str) -> str:
    """Store why instances like `env` do not compile. Returns the reason."""
    with contextlib.suppress(Exception):  # of a parameter that cannot be read: the class is tried again
        failed[signature_of(env), *(each for each in arguments if isinstance(each, str))] = reason
    return reason
