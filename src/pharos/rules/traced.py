"""The traced engine: rules in Python, called once for each way through them.

A rule is a pure function of the state, and most rules look at a few components of it. So a call is traced: what it
read, in which order and with which values, and what it wrote. The traces of a rule are a tree (decisions.py), and a
state that comes to a leaf of it need not be asked about again: a Breakout of 224,617 states and three actions has 4,860
leaves. Where hardly any call is saved, as in a Freeway, whose rules read every car, tracing ends and every state is
asked.

A rule sees the state through stand-ins that note each access; whatever they do not offer raises an exception, upon
which tracing ends as well. Each traced call is repeated with a tuple and a list, and must give the same.
"""

import operator
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from pharos.environments import Environment
from pharos.rules import decisions
from pharos.rules.interpreted import InterpretedExploration, InterpretedRewards
from pharos.rules.interpreted_branches import SUM_TOLERANCE, Branches
from pharos.rules.layout import Layout, unpack

WORTH_TRACING = 64  # states at a time
MOST_VALUES = 1 << 16  # of a component that a tree branches on
MOST_CHILDREN = 1 << 26
ASKED = 64  # calls before the rest is tried again
FAIR_TRIAL = 20_000  # calls before tracing may be found useless
WORTH = 3  # transitions for each call


class TracedExploration(InterpretedExploration):
    """See `rules.Exploration`: trees answer where they can, the interpreted rules elsewhere."""

    def __init__(self, env: Environment, layout: Layout, workers: int = 1):
        super().__init__(env, layout, workers)
        self._traced = TracedRules(env)

    def _branches(self, states: np.ndarray) -> Branches:
        answer = self._traced.branches(states) if len(states) >= WORTH_TRACING else None
        return super()._branches(states) if answer is None else answer


class TracedRewards(InterpretedRewards):
    """See `rules.Rewards`: trees answer where they can, the interpreted rule elsewhere."""

    def __init__(self, env: Environment, layout: Layout):
        super().__init__(env, layout)
        self._traced = TracedReward(env)

    def block(self, states, successors, terminal, start: int, stop: int) -> np.ndarray:
        answer = None
        if self._traced.is_on and stop - start >= WORTH_TRACING:
            led = np.asarray(successors[start:stop])
            following = unpack(self.layout, states[led.ravel()]).reshape(*led.shape, -1)
            going = np.flatnonzero(~np.asarray(terminal[start:stop]))
            answer = self._traced.rewards(unpack(self.layout, states[start:stop]), following, going)
        return super().block(states, successors, terminal, start, stop) if answer is None else answer


class _Untraceable(Exception):
    """The rule, or this state, is not for tracing."""


class _Traced:
    """Rules that are called where they are new, and answered by trees where they are not.

    Attributes:
        is_on: False once tracing has failed, or has not been worth it.
        asked: calls. answered: transitions that were asked for.
    """

    def __init__(self, env: Environment, roots: int, copies: int = 1):
        self._kernels: Any = decisions
        components = env.components
        self.env, self.num_actions = env, env.num_actions
        self.low, self.size = (np.tile(each, copies).astype(np.int64) for each in (components.low, components.size))
        self.asked = self.answered = 0
        self.is_on = True
        self._trees = _Trees(roots)

    def _learn(self, missing: np.ndarray, values: Callable[[int, int], np.ndarray]) -> bool:
        """Call rules for some of the (row, root) that trees do not know, `values` of which they see.

        Returns whether to go on.
        """
        try:
            for row, root in missing[:: max(1, len(missing) // ASKED)][:ASKED].tolist():
                inputs = values(row, root)
                if not self._trees.knows(self.low, root, inputs):
                    self.asked += 1
                    self._ask(tuple(inputs.tolist()), root)
        except Exception:  # of the rule, too: the caller asks every state, and finds out whose it is
            self.is_on = False
        if self.asked >= FAIR_TRIAL and self.asked * WORTH > self.answered:
            self.is_on = False
        return self.is_on

    def _ask(self, values: tuple[int, ...], root: int) -> None:
        """Call a rule, and add its trace to the tree."""
        raise NotImplementedError

    def _add(
        self, root: int, values: tuple[int, ...], read: Iterable[int], written: dict[int, int], says: float
    ) -> None:
        self._trees.add(root, [(c, values[c] - int(self.low[c]), int(self.size[c])) for c in read], written, says)


class TracedRules(_Traced):
    """Successors of states. Root b is that of branch b (an action, or an outcome of one), root B that of `is_terminal`.

    What a branch returns is how likely it is. Classes with an age are not traced: an age may look at everything.
    """

    def __init__(self, env: Environment):
        self.branches_of_a_state = env.num_actions * env.outcomes
        super().__init__(env, self.branches_of_a_state + 1)
        self.is_on = not env.has_age

    def branches(self, states: np.ndarray) -> Branches | None:
        """As `interpreted_branches` of states (N, D) int64; None where tracing does not work, or is not worth it."""
        if not self.is_on:
            return None
        env, branches = self.env, self.branches_of_a_state
        out = np.empty((len(states) * branches, states.shape[1]), np.int64)
        ended = np.zeros(len(states), np.bool_)
        likely = np.zeros((len(states) if env.has_chance else 0, branches))
        rows, missing = np.arange(len(states)), np.empty((len(states), 2), np.int64)
        self.answered += len(out)
        while True:
            arrays = self.low, states, rows, branches, out, ended, likely, missing
            count = self._kernels.follow(*self._trees.arrays, *arrays)
            if not count:
                break
            if not self._learn(missing[:count], lambda row, root: states[row]):
                return None
            rows = missing[:count, 0].copy()
        if not env.has_chance:
            return Branches(out, ended)
        likely[ended, :: env.outcomes] = 1.0
        if (abs(likely.reshape(-1, env.outcomes).sum(axis=1) - 1) > SUM_TOLERANCE / 2).any():
            return None  # the caller asks every state, and finds out whose they are
        return Branches(out, ended, likely)

    def _ask(self, values: tuple[int, ...], root: int) -> None:
        state = _State(values)
        written: dict[int, int] = {}
        says = 0.0
        if root == self.branches_of_a_state:
            says = bool(self.env.is_terminal(state))
            same = says == bool(self.env.is_terminal(values))
        else:
            out, plain = _Out(state), list(values)
            says, written = self._branch(state, root, out), out.written
            same = says == self._branch(values, root, plain)
            same = same and plain == [written.get(i, value) for i, value in enumerate(values)]
        if not same or not 0 <= says <= 1:
            raise _Untraceable
        for component, value in written.items():
            if not self.low[component] <= value < self.low[component] + self.size[component]:
                raise _Untraceable
        self._add(root, values, state.read, written, says)

    def _branch(self, state: Any, branch: int, out: Any) -> float:
        """Call the rules of a branch that writes to `out`; how likely it is."""
        env: Any = self.env
        action, outcome = divmod(branch, env.outcomes)
        if not env.takes_outcomes():
            env.transition(state, action, out)
            return 1.0
        likely = float(env.probability(state, action, outcome)) + 0.0 if env.has_chance else 1.0  # never -0.0
        if likely != 0:
            env.transition(state, action, outcome, out)
        return likely


class TracedReward(_Traced):
    """Rewards of transitions, whose trees look at the state and, D components on, at the next one."""

    def __init__(self, env: Environment):
        super().__init__(env, env.num_actions, copies=2)

    def rewards(self, states: np.ndarray, following: np.ndarray, rows: np.ndarray) -> np.ndarray | None:
        """(N, A) of states (N, D) and their successors (N, A, D), 0 but in `rows`; None as above."""
        if not self.is_on:
            return None
        out = np.zeros(following.shape[:2])
        missing = np.empty((len(rows), 2), np.int64)
        self.answered += len(rows) * self.num_actions
        while True:
            count = self._kernels.say(*self._trees.arrays, self.low, states, following, rows, out, missing)
            if not count:
                return out
            if not self._learn(missing[:count], lambda row, a: np.concatenate([states[row], following[row, a]])):
                return None
            rows = missing[:count, 0].copy()

    def _ask(self, values: tuple[int, ...], root: int) -> None:
        half = len(values) // 2
        state = _State(values[:half])
        after = _State(values[half:], half, state.read)
        says = float(self.env.reward_of(state, root, after))
        plain = float(self.env.reward_of(values[:half], root, values[half:]))
        if says != plain:
            raise _Untraceable
        self._add(root, values, state.read, {}, says)


class _Trees:
    """The arrays of decisions.py, which grow."""

    def __init__(self, roots: int):
        self._component, self._first_child = (np.full(1 << 10, -1, np.int64) for _ in range(2))
        self._children = np.full(1 << 12, -1, np.int64)
        self._first_write, self._written = np.zeros(1 << 10, np.int64), np.zeros((1 << 12, 2), np.int64)
        self._says = np.zeros(1 << 10)
        self._nodes, self._num_children, self._leaves = roots, 0, 0

    @property
    def arrays(self) -> Any:
        """component, first_child, children, first_write, written, says."""
        return self._component, self._first_child, self._children, self._first_write, self._written, self._says

    def knows(self, low: np.ndarray, root: int, state: np.ndarray) -> bool:
        """Whether a state comes to a leaf."""
        return decisions.leaf_of(self._component, self._first_child, self._children, low, root, state) >= 0

    def add(self, node: int, read: list[tuple[int, int, int]], written: dict[int, int], says: float) -> None:
        """A leaf below `node`, on the way of what was read: (component, which of its values, how many it has)."""
        for component, value, size in read:
            if self._component[node] == decisions.UNKNOWN:
                self._component[node], self._first_child[node] = component, self._num_children
                self._num_children += size
                if size > MOST_VALUES or self._num_children > MOST_CHILDREN:
                    raise _Untraceable
                self._children = _grown(self._children, self._num_children, -1)
            if self._component[node] != component:
                raise _Untraceable  # the same values, and it reads on elsewhere: no pure function
            child = self._first_child[node] + value
            if self._children[child] < 0:
                self._children[child] = self._nodes
                self._nodes += 1
                self._component = _grown(self._component, self._nodes, -1)
                self._first_child = _grown(self._first_child, self._nodes, -1)
            node = int(self._children[child])
        if self._component[node] != decisions.UNKNOWN:
            raise _Untraceable
        leaf = self._leaves
        self._leaves += 1
        self._component[node] = decisions.LEAF - leaf
        self._says, self._first_write = _grown(self._says, self._leaves, 0), _grown(self._first_write, leaf + 2, 0)
        first = int(self._first_write[leaf])
        self._first_write[leaf + 1] = first + len(written)
        self._written = _grown(self._written, first + len(written), 0)
        if written:
            self._written[first : first + len(written)] = list(written.items())
        self._says[leaf] = says


def _grown(array: np.ndarray, needed: int, fill: int) -> np.ndarray:
    """The array, twice as long or more where fewer than `needed` entries fit."""
    if needed <= len(array):
        return array
    larger = np.full((max(needed, 2 * len(array)), *array.shape[1:]), fill, array.dtype)
    larger[: len(array)] = array
    return larger


class _StandIn:
    """What a tuple and a list have in common.

    Nothing of a state is told without being noted, or else an exception is raised.
    """

    def __len__(self) -> int:
        raise NotImplementedError

    def __getitem__(self, index: Any) -> Any:
        raise NotImplementedError

    def __iter__(self) -> Iterator[int]:
        return (self[i] for i in range(len(self)))

    def __eq__(self, other: object) -> bool:
        return self._plain() == (other._plain() if isinstance(other, _StandIn) else other)

    def __repr__(self) -> str:
        return repr(self._plain())

    def __format__(self, how: str) -> str:
        return format(self._plain(), how)

    def __reduce_ex__(self, protocol: Any) -> Any:
        raise _Untraceable  # a copy would be read without notice

    def _plain(self) -> Any:
        """What it stands for."""
        raise NotImplementedError


class _State(_StandIn):
    """Stands in for the tuple of a state, and notes what is read."""

    def __init__(self, values: tuple[int, ...], first: int = 0, read: dict[int, None] | None = None):
        self._values, self._first = values, first
        self.read: dict[int, None] = {} if read is None else read

    __class__ = tuple  # type: ignore[assignment]  # for isinstance

    def __getitem__(self, index: Any) -> Any:
        places = range(len(self._values))[index]
        for place in places if isinstance(places, range) else (places,):
            self.read[self._first + place] = None
        return self._values[index]

    def __len__(self) -> int:
        return len(self._values)

    def __hash__(self) -> int:
        return hash(self._plain())

    def _plain(self) -> tuple[int, ...]:
        return tuple(iter(self))


class _Out(_StandIn):
    """Stands in for the list `out`, which begins as a copy of the state."""

    def __init__(self, state: _State):
        self._state = state
        self.written: dict[int, int] = {}

    __class__ = list  # type: ignore[assignment]

    def __getitem__(self, index: Any) -> Any:
        places = range(len(self._state))[index]
        if isinstance(places, range):
            return [self[i] for i in places]
        return self.written[places] if places in self.written else self._state[places]

    def __setitem__(self, index: Any, value: Any) -> None:
        places = range(len(self._state))[index]
        if not isinstance(places, range):
            self.written[places] = operator.index(value)
            return
        values = list(value)
        if len(values) != len(places):
            raise _Untraceable
        for place, each in zip(places, values, strict=True):
            self.written[place] = operator.index(each)

    def __len__(self) -> int:
        return len(self._state)

    __hash__ = None  # type: ignore[assignment]

    def _plain(self) -> list[int]:
        return list(iter(self))
