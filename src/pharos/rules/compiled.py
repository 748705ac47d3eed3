"""The compiled engine: rules run by Numba, inside the kernels that search, step and draw.

Each class compiles its kernels in its constructor, by calling them with no work to do, and raises Numba's error if
that fails.
"""

import time
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import RuleError
from pharos.kernels.kernel_cache import is_on_disk
from pharos.rules.compiler import Function, compiler_of, numeric_attributes, type_text
from pharos.rules.layout import Layout
from pharos.system import compiling
from pharos.system.arrays import Indices, PackedIndices

if TYPE_CHECKING:
    from pharos.rules.exploration import ExpansionKernels
    from pharos.rules.interaction import InteractionKernels

Rows = np.ndarray | tuple[np.ndarray, np.ndarray]  # terminal, or (terminal, probabilities)
NO_RANKS = np.empty(0, np.int64)
"""No ranks of outcomes: those of a state and action are all its possible ones, in their order."""

explored: set[type[Environment]] = set()
"""Classes by whose rules this process explores compiled."""

ALONE_SECONDS = 2.0
"""Seconds of the processor after which threads are worth their kernels, which take 0.9 s to compile."""

_SUSPECTS = 16  # states of which a kernel cannot say in which one a rule failed


# Makers of kernels are imported by the functions that call them: a script that steps loads no kernels that search.
@cache
def exploration_kernels(
    cls: type[Environment], names: tuple[str, ...], num_words: int, num_actions: int, outcomes: int = 1
) -> "ExpansionKernels":
    """The kernels of `exploration.py` for the rules of a class that mention the attributes `names`."""
    from pharos.rules.exploration import exploration

    compiler, rules, parameters = compiler_of(cls, names, outcomes, num_words, num_actions)
    return exploration(compiler, rules, parameters, num_words, num_actions, outcomes, cls.pays_by_outcome())


@cache
def interaction_kernels(
    cls: type[Environment], names: tuple[str, ...], num_actions: int, outcomes: int = 1, motion: bool = False
) -> "InteractionKernels":
    """The kernels of `interaction.py`. With motion they draw the planes of `draw_motion` behind the planes of
    `draw`."""
    from pharos.rules.interaction import interaction

    layers = len(cls.layers) if motion else 0
    compiler, rules, parameters = compiler_of(cls, names, outcomes, 0, num_actions, *((layers,) if motion else ()))
    return interaction(compiler, rules, parameters, num_actions, outcomes, layers)


class _Compiled:
    """Parameters and exploration kernels of one environment."""

    def __init__(self, env: Environment, layout: Layout):
        names, self.parameters = numeric_attributes(env)
        self.env, self.layout = env, layout
        self.outcomes = int(env.outcomes)
        self.kernels = exploration_kernels(_class_of(env), names, layout.num_words, env.num_actions, self.outcomes)


def is_kept(env: Environment, layout: Layout) -> bool:
    """Whether exploration by the rules of the class was compiled before, and is on disk."""
    return is_on_disk(_Compiled(env, layout).kernels.explore)


class CompiledExpansion(_Compiled):
    """`rules.Expansion`, compiled. Threads may share the work: the kernels release Python's lock."""

    is_compiled = True

    def __init__(self, env: Environment, layout: Layout):
        super().__init__(env, layout)
        explored.add(_class_of(env))
        self._is_plain = self.outcomes == 1 and not env.has_age
        branches = env.num_actions * self.outcomes
        states = np.empty((1, layout.num_words), np.uint64)
        rows = (np.empty((1, branches), np.int32), np.empty(1, np.uint8), np.empty((1, branches)))
        self.explore(states, *rows, np.full(1 << 16, -1, np.int32), 0, 0, 0, np.zeros(5, np.int64))
        self._began = time.process_time()

    def threads(self, workers: int) -> int:
        return workers if self._is_worth_sharing() else 1

    def _is_worth_sharing(self) -> bool:
        """Whether threads are worth the compiling of their kernels, if those are not on disk: after a while."""
        if compiling.SMALL_STATES == 0 or time.process_time() - self._began >= ALONE_SECONDS:
            return True
        kernel: Any = self.kernels.expand_and_find
        return bool(kernel.signatures) or is_on_disk(kernel)

    def explore(self, states, successors, terminal, probabilities, table, base, last, room, progress) -> None:
        rows = self._rows(terminal, probabilities)
        failure: Exception | None = None
        try:
            self.kernels.explore(
                self.parameters, self.layout.tables, states, successors, rows, table, base, last, room, progress
            )
        except Exception as error:  # of the rules, such as a division by zero
            failure = error
        self._check(states, None, progress, failure)

    def expand_and_find(self, states, start, stop, base, keys, indices, terminal, probabilities, table) -> None:
        progress = np.zeros(5, np.int64)
        failure: Exception | None = None
        try:
            self._expand(states, start, stop, base, keys, indices, self._rows(terminal, probabilities), table, progress)
        except Exception as error:
            failure = error
        self._check(states, stop, progress, failure)

    def _check(self, states, stop: int | None, progress, failure: Exception | None) -> None:
        """Raise a RuleError if a rule failed or left the ranges in a state before `stop`. None: in any of them."""
        from pharos.kernels.hash_table import COUNT, FAULT, FIRST  # which stepping does without

        if failure or progress[FAULT]:
            from pharos.rules.interpreted import blame

            first, stop = int(progress[FIRST]), int(progress[COUNT]) if stop is None else stop
            blame(self.env, self.layout, states[first : min(first + _SUSPECTS, stop)], failure)

    def _rows(self, terminal, probabilities) -> Rows:
        """Arrays that kernels write beside the successors: terminal, and with chance or an age probabilities as
        well."""
        return terminal if self._is_plain else (terminal, probabilities)

    def _expand(self, *arrays: object) -> None:
        self.kernels.expand_and_find(self.parameters, self.layout.tables, *arrays)

    def component_at_fault(self, states, i: int, keys, terminal, probabilities) -> int | None:
        """Expand state i alone, its successors to its rows of keys. Returns the component that it leaves, or None.

        The number of components stands for one that does not exist, the next one for a probability or an age.
        """
        from pharos.kernels.hash_table import FAULT

        progress, indices = np.zeros(5, np.int64), np.empty(len(keys), np.int64)
        rows = self._rows(terminal, probabilities)
        self._expand(states, i, i + 1, 0, keys, indices, rows, np.full(64, -1, np.int32), progress)
        fault = int(progress[FAULT])
        return fault - 1 if fault else None

    def close(self) -> None:
        """Nothing to end."""


class CompiledRewards(_Compiled):
    """`rules.TransitionRewards`, compiled."""

    def __init__(self, env: Environment, layout: Layout):
        super().__init__(env, layout)
        states = np.empty((1, layout.num_words), np.uint64)
        terminal = np.empty(1, np.bool_)
        if self.outcomes == 1:
            self._rewards_of(states, np.empty((1, env.num_actions), np.int32), terminal, 0, 0)
        else:
            nothing = np.empty(0, np.int64)
            self._expected_rewards_of(states, (nothing, nothing, np.empty(0)), terminal, 0, 0, NO_RANKS, None)

    def threads(self, workers: int) -> int:
        return workers

    def block(self, states, successors, terminal, start: int, stop: int) -> np.ndarray:
        return self._rewards_or_error("block", self._rewards_of, states, successors, terminal, start, stop)

    def expected_block(self, states, outcomes, terminal, start, stop, ranks=NO_RANKS, largest=None) -> np.ndarray:
        return self._rewards_or_error(
            "expected_block", self._expected_rewards_of, states, outcomes, terminal, start, stop, ranks, largest
        )

    def _rewards_or_error(self, name: str, compiled: Callable[..., np.ndarray], *arguments: object) -> np.ndarray:
        try:
            return compiled(*arguments)
        except Exception as error:  # of the rule, such as a division by zero: name the state
            from pharos.rules.interpreted import InterpretedRewards

            out = getattr(InterpretedRewards(self.env, self.layout), name)(*arguments)
            if np.isfinite(out).all():
                raise RuleError(f"{self.env}: compiled, reward raises {error!r}; interpreted it does not") from error
            return out

    def _rewards_of(self, states, successors, terminal, start: int, stop: int) -> np.ndarray:
        out = np.empty((stop - start, self.env.num_actions))
        states, successors, terminal = (_read_only(array) for array in (states, successors, terminal))
        self.kernels.rewards_of(self.parameters, self.layout.tables, states, successors, terminal, start, stop, out)
        return out

    def _expected_rewards_of(self, states, outcomes, terminal, start: int, stop: int, ranks, largest) -> np.ndarray:
        out = np.zeros((stop - start, self.env.num_actions))
        arrays = (_read_only(array) for array in (states, *outcomes, ranks, terminal))
        largest = np.zeros(1) if largest is None else largest
        self.kernels.rewards_of(self.parameters, self.layout.tables, *arrays, start, out, largest)
        return out


class CompiledAges(_Compiled):
    """`rules.Ages`, compiled."""

    def __init__(self, env: Environment, layout: Layout):
        super().__init__(env, layout)
        states = np.empty((1, layout.num_words), np.uint64)
        states.flags.writeable = False
        self.block(states, 0, 0)

    def block(self, states, start: int, stop: int) -> np.ndarray:
        out = np.empty(stop - start, np.int64)
        self.kernels.ages_of(self.parameters, self.layout.tables, states, start, stop, out)
        return out


def _read_only(array: Indices) -> Indices:
    """A read-only view, as arrays of a StateSpace are: the kernel is compiled for these alone."""
    if isinstance(array, PackedIndices):  # which kernels never write to
        return array
    view = array.view()
    view.flags.writeable = False
    return view


class CompiledStepping:
    """`rules.Stepping`, compiled: the kernels of interaction.py for one environment."""

    is_compiled = True

    def __init__(self, env: Environment, layout: Layout | None = None):
        names, self.parameters = numeric_attributes(env)
        self.env = env
        kernels = interaction_kernels(_class_of(env), names, env.num_actions, int(env.outcomes))
        self.step_one, self.step_many = kernels.step_one, kernels.step_many
        self.outcome_one, self.is_terminal_one = kernels.outcome_one, kernels.is_terminal_one
        self._step_and_draw_one, self._mark_available = kernels.step_and_draw_one, kernels.mark_available
        state = np.array(env.initial_states()[0][0], np.int64)
        ranges = np.stack([env.components.low, env.components.high])
        outcome = 0
        if env.has_chance:
            outcome, _ = self.outcome_one(self.parameters, state, 0, 0.0)
        self.step_one(self.parameters, ranges, np.zeros(0), state, outcome, state.copy(), np.empty(0, np.float32))

    def __reduce__(self):
        return CompiledStepping, (self.env,)

    def mark_available(self, states: np.ndarray, out: np.ndarray) -> None:
        """out[n, a] = whether action a is available in states[n]."""
        assert self._mark_available is not None
        self._mark_available(self.parameters, states, out)

    def step_and_draw_one(self, *arguments: object) -> Function | None:
        """The kernel that steps and draws, compiled for these arguments, or None if `draw` does not compile."""
        try:
            self._step_and_draw_one(self.parameters, *arguments)
        except Exception:  # Numba raises its own errors, and others from inside of it
            return None
        return self._step_and_draw_one


class CompiledDrawing:
    """A kernel that draws states, with the parameters of one environment, see `rules.Rules.drawing`.

    Args:
        kernel: its name in interaction.py. arguments: of the first call, for no states.
    """

    is_compiled, motion = True, False

    def __init__(self, env: Environment, kernel: str, *arguments: object):
        names, self.parameters = numeric_attributes(env)
        kernels = interaction_kernels(_class_of(env), names, env.num_actions, int(env.outcomes), self.motion)
        self._kernel = getattr(kernels, kernel)
        self(*arguments)

    def __call__(self, *arguments: object) -> None:
        self._kernel(self.parameters, *arguments)


class CompiledMotion(CompiledDrawing):
    """A kernel that draws states with the planes of `draw_motion` behind the planes of `draw`."""

    motion = True


def signature_of(env: Environment) -> tuple:
    """Key of an instance: equal keys share one compilation, and the reason why there is none."""
    _, parameters = numeric_attributes(env)
    return (type(env), env.num_actions, env.outcomes, tuple(map(type_text, parameters)))


def _class_of(env: Environment) -> type:
    """The class of `env`, which type checkers take for a key of `cache` even if they do not know its `__hash__`."""
    return type(env)
