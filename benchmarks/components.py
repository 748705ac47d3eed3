"""Values component by component beside sweeps over all states, in one run.

    python benchmarks/components.py

Processor time to the tolerance, sweeps over all states, and the bound that is proven; `both` is what `value_iteration`
does. Instances in which states cannot come back: doors of rooms, each a slippery lake; a chain whose states have random
numbers.
"""

import time

import numpy as np

import pharos
from pharos.mdp import TabularMDP
from pharos.solvers.fixed_point import ComponentSolver
from pharos.solvers.policy_iteration import PolicyIteration

SLIP = np.array([0.8, 0.1, 0.1])


def rooms(count: int, size: int, gamma: float) -> TabularMDP:
    """Slippery rooms of size x size cells in a row; a door leads from the last cell of each to the first of the next,
    and not back. Entering the last room's last cell pays 1 and ends; each step costs 0.001."""
    cells = np.arange(count * size * size).reshape(count, size, size)
    shifted = []
    for axis, step in ((1, 1), (1, -1), (2, 1), (2, -1)):
        place = np.clip(np.arange(size) + step, 0, size - 1)
        shifted.append(np.take(cells, place, axis).ravel())
    door = cells[:-1, -1, -1]
    for moved in shifted:
        moved[door] = cells[1:, 0, 0]
    goal = cells[-1, -1, -1]
    sides = ((0, 2, 3), (1, 2, 3), (2, 0, 1), (3, 0, 1))  # of an action: ahead, and to either side
    successors = np.stack([np.stack([shifted[k] for k in side], axis=1) for side in sides], axis=1)
    successors[goal] = goal
    rewards = np.full((cells.size, 4), -0.001)
    for action in range(4):
        rewards[:, action] += (SLIP * (successors[:, action] == goal)).sum(axis=1)
    rewards[goal] = 0
    probabilities = np.broadcast_to(SLIP, successors.shape).copy()
    return TabularMDP.from_outcomes(successors, probabilities, rewards, gamma=gamma)


def chain(number: np.ndarray, gamma: float) -> TabularMDP:
    """Forward succeeds half of the time, and each attempt costs 0.01; number[n] is the state after n steps forward."""
    length = len(number)
    following = np.empty(length, np.int64)
    following[number[:-1]], following[number[-1]] = number[1:], number[-1]
    successors = np.stack([following, np.arange(length)], axis=1)[:, None]
    rewards = np.full((length, 1), -0.01)
    rewards[number[-1]] = 0.0
    return TabularMDP.from_outcomes(successors, np.full(successors.shape, 0.5), rewards, gamma=gamma)


CASES = {
    "20 slippery rooms of 50 x 50": lambda gamma: rooms(20, 50, gamma),
    "a chain of 50,000 states in no order": lambda gamma: chain(np.random.default_rng(0).permutation(50_000), gamma),
}


# whether components and policy iteration are tried
WAYS = {
    "sweeps alone": (False, False),
    "components": (True, False),
    "policy iteration": (False, True),
    "both": (True, True),
}


def line(mdp: TabularMDP, tolerance: float) -> str:
    began = time.process_time()
    solution = pharos.value_iteration(mdp, tolerance)
    seconds = time.process_time() - began
    return f"{seconds:8.2f} s, {solution.sweeps:6} sweeps, bound {solution.error_bound:.1e}, v(0) {solution.v[0]:.9f}"


def main() -> None:
    solvers = (ComponentSolver, PolicyIteration)
    worth = [solver.is_worth_it for solver in solvers]
    line(rooms(40, 20, 0.9999), 1e-6)  # compile
    for name, make in CASES.items():
        for gamma in (0.999, 0.9999):
            mdp = make(gamma)
            found = mdp.dynamics.components(~np.asarray(mdp.terminal), 1)
            sizes = f"{mdp.num_states:,} states, {found.total:,} components, the largest of {found.largest:,}"
            print(f"{name}: {sizes}; gamma {gamma}")
            for way, used in WAYS.items():
                for solver, known, is_used in zip(solvers, worth, used, strict=True):
                    solver.is_worth_it = known if is_used else lambda *_: False
                print(f"  {way:18} {line(mdp, 1e-6)}", flush=True)
    for solver, known in zip(solvers, worth, strict=True):
        solver.is_worth_it = known


if __name__ == "__main__":
    main()
