"""Dynamics that kernels read: the methods that are compiled, without temporary arrays."""

import math
from abc import abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from pharos.kernels import bellman, graph, occupancy, outcomes
from pharos.mdp.dynamics import BellmanEquation, Components, Dynamics, Order, PolicyStep
from pharos.mdp.runs import count_of, shares_of
from pharos.mdp.selection import Extreme, PolicyTable, Selection
from pharos.system.large_arrays import ranges_from_the_end


class CompiledDynamics(Dynamics):
    """Transitions in arrays that kernels/outcomes.py knows how to read: each loop is written once for all of them."""

    sweeps_ranges = True

    @property
    @abstractmethod
    def for_kernels(self) -> Any:
        """The argument `transitions` of kernels."""

    @property
    def for_sweeps(self) -> Any:
        """The same for the loops in which solvers spend their time: what the compiler knows more of."""
        return self.for_kernels

    def lazy(self, p: float) -> Dynamics:
        from pharos.mdp.lazy import Lazy  # which derives from this class

        return Lazy(self, p)

    def backup(self, equation: BellmanEquation, x: np.ndarray, out: np.ndarray, runs: np.ndarray | None = None) -> None:
        rewards, gamma, chance, select = equation
        choice = _choice(select)
        if choice is None:
            return super().backup(equation, x, out, runs)
        tables = (self.for_sweeps, rewards.table, rewards.palette, gamma)
        actions = bellman.actions_of(self.num_actions)
        kernel, weights, x_, out_ = (
            (bellman.sticky_backup, chance.triple, x, out)
            if chance.is_sticky
            else (bellman.optimal_backup, chance.uniform, x[:, 0], out[:, 0])
        )
        out[-1] = 0.0
        arrays = (*tables, weights, choice, x_, out_, actions)
        whole = np.array([[0, self.num_states]])
        _shared(lambda part: kernel(*arrays, part), self, whole if runs is None else runs)

    def sweep(
        self, equation: BellmanEquation, x: np.ndarray, threads: int = 1, part: tuple[int, int] | None = None
    ) -> float:
        """part: the states [start, stop) alone."""
        return swept(self.for_sweeps, self.num_actions, equation, x, None, threads, part)

    def settle_components(
        self, equation: BellmanEquation, x: np.ndarray, parts: Components, target: float, settled: float, most: float
    ) -> None:
        choice, before = _choice(equation.select), float(max(x.max(), -x.min()))
        if choice is not None and not equation.chance.is_sticky:
            from pharos.kernels import components

            tables = (self.for_sweeps, equation.rewards.table, equation.rewards.palette, equation.gamma)
            actions, chance = bellman.actions_of(self.num_actions), equation.chance.uniform
            groups = (parts.order, parts.starts, parts.has_cycle)
            components.settle(*tables, chance, choice, x[:, 0], actions, *groups, target, settled, most, before)
            return
        for group in range(len(parts.has_cycle) - 1, -1, -1):
            start, stop = int(parts.starts[group]), int(parts.starts[group + 1])
            change, largest = math.inf, before
            while change > max(target, settled * largest):
                change = swept(self.for_sweeps, self.num_actions, equation, x, parts.order, part=(start, stop))
                largest += change
                most -= stop - start
                if most < 0 or not parts.has_cycle[group]:
                    break

    def components(self, live: np.ndarray, least: int) -> Components:
        from pharos.kernels import components  # which few need

        dtype = np.int32 if self.num_states < 2**31 else np.int64
        number, path, waiting = (np.empty(self.num_states, dtype) for _ in range(3))
        count = components.number_components(self.for_kernels, live, number, path, waiting)
        first, is_cyclic = np.zeros(count + 1, np.int64), np.zeros(count, np.bool_)
        order = np.empty(self.num_states, np.int64)
        components.component_order(self.for_kernels, live, number, first, is_cyclic, order)
        largest = int(np.diff(first).max(initial=0, where=is_cyclic))
        starts, has_cycle = components.joined(first, is_cyclic, least)
        return Components(order, starts, has_cycle, count, largest)

    def sweep_once(self, equation: BellmanEquation, x: np.ndarray, order: Order) -> None:
        swept(self.for_sweeps, self.num_actions, equation, x, order.states)

    def move(self, play: PolicyStep, now: np.ndarray, after: np.ndarray) -> float:
        if now.shape[1] != after.shape[1]:  # the first step of sticky actions
            return super().move(play, now, after)
        return occupancy.push(self.for_kernels, play.live, play.policy, play.chance.triple, now, after)

    def pushed(self, mass: np.ndarray, width: int = 1) -> np.ndarray:
        after = np.zeros((self.num_states, width))
        outcomes.pushed(self.for_kernels, np.ascontiguousarray(mass, np.float64), after)
        return after

    def settle(self, play: PolicyStep, gamma: float, least: float, waiting: np.ndarray, visits: np.ndarray) -> float:
        weights = play.chance.triple
        return occupancy.settle(self.for_kernels, play.live, play.policy, weights, gamma, least, waiting, visits)

    def support(self, play: PolicyStep, reached: np.ndarray) -> None:
        occupancy.support(self.for_kernels, play.live, play.policy, play.chance.triple, reached)

    def reachable(self, starts: np.ndarray, steps: int | None = None) -> np.ndarray:
        is_reached = np.zeros(self.num_states, np.bool_)
        frontier = np.unique(starts)
        is_reached[frontier] = True
        small = np.int32 if self.num_states < 2**31 else np.int64
        now, following = (np.empty(self.num_states, small) for _ in range(2))
        count, level = len(frontier), 0
        now[:count] = frontier
        while count and (steps is None or level < steps):
            count = graph.onwards(self.for_kernels, now, count, following, is_reached)
            now, following = following, now
            level += 1
        return is_reached

    def _edges(self, live: np.ndarray) -> Any:
        return self.for_kernels


def swept(
    transitions: Any,
    num_actions: int,
    equation: BellmanEquation,
    x: np.ndarray,
    order: np.ndarray | None,
    threads: int = 1,
    part: tuple[int, int] | None = None,
) -> float:
    """Replace each entry of x by its backup, from the last state of an order to the first; the largest change.

    Args:
        threads: each has a part of the states, where that is possible.
        part: the places [start, stop) of the order that are swept; None: all.
    """
    rewards, gamma, chance, select = equation
    tables = (transitions, rewards.table, rewards.palette, gamma)
    actions, scratch = bellman.actions_of(num_actions), np.empty(num_actions)
    choice, places = _choice(select), part or (0, rewards.shape[0])
    if choice is None:
        assert isinstance(select, PolicyTable)
        if chance.is_sticky:
            return bellman.sticky_policy_sweep(*tables, chance.triple, select.later, x, scratch, order, *places)
        weights = (float(chance.chosen), float(chance.uniform))
        return bellman.policy_sweep(*tables, *weights, select.later[:, 0], x[:, 0], order, *places)
    if chance.is_sticky:
        return bellman.sticky_sweep(*tables, chance.triple, choice, x, actions, scratch, order, *places)
    v = x[:, 0]

    def change_of(low: int, high: int) -> float:
        change = 0.0
        for start, stop in ranges_from_the_end(transitions, low, high):
            largest = bellman.optimal_sweep(*tables, chance.uniform, choice, v, actions, order, start, stop)
            change = float(np.maximum(change, largest))
        return change

    low, high = places
    cuts = [low + (high - low) * i // threads for i in range(threads + 1)]
    if threads == 1:
        return change_of(*cuts)
    with ThreadPoolExecutor(threads) as pool:
        return float(np.max([*pool.map(change_of, cuts[:-1], cuts[1:])]))


def _choice(select: Selection) -> "float | np.ndarray | None":
    """The argument `choice` of kernels; None for policies that draw actions, or look back."""
    if isinstance(select, Extreme):
        return select.sign
    assert isinstance(select, PolicyTable)
    return None if select.actions is None else np.ascontiguousarray(select.actions, np.int64)


def _shared(block: Callable[[np.ndarray], None], dynamics: CompiledDynamics, runs: np.ndarray) -> None:
    """block(part) over the states of runs (R, 2), on all processors where there are enough states to share."""
    from pharos.system.workers import usable_workers

    workers = usable_workers(dynamics.workers) if count_of(runs) >= 1 << 16 else 1
    if workers == 1:
        return block(runs)
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(block, shares_of(runs, workers)))
