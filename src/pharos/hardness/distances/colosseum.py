"""The diameter as Colosseum defines it for episodes of a fixed length. Source: Conserva and Rauber (2022)."""

from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import ExpandedMDP, TabularMDP, require_mdp

_BLOCK = 256  # targets at a time


@require_mdp
def colosseum_diameter(mdp: TabularMDP, *, horizon: int | None = None) -> float:
    """Return Colosseum's episodic diameter: 1 + the largest, over states e, of the least expected time to e.

        ET_e(h, e) = 0;  ET_e(h, s) = 1 + min_a E[ET_e(h + 1, s')] for h < H - 1;  ET_e(H - 1, s) = 1 + E[ET_e(0, s0)]

    That time is E[ET_e(0, s0)], from the start; after H steps an episode starts again, in a state s0 of the start
    distribution. Colosseum says it differently: the largest over e and s of the least positive ET_e(h, s), over
    h = H - 1 and all h at which s can be reached. At h = H - 1 it makes no exception of s = e, so e itself has
    1 + E[ET_e(0, s0)], and no state has more. Terminal states last until the episode starts again.

    Args:
        horizon: H, steps; that of the MDP by default.
    Returns:
        Steps; infinite where some state cannot be reached within an episode with positive probability.
    Raises:
        ParameterError: there is no horizon, or it is below 1.
    Cost: a few backward passes of H steps for each state; O(H S^2 A) time for each pass with sparse rows.
    Source: Conserva and Rauber (2022), "Hardness in Markov decision processes: theory and practice", and its code.
    """
    horizon = mdp.horizon if horizon is None else horizon
    if isinstance(horizon, bool) or not isinstance(horizon, int | np.integer) or horizon < 1:
        raise ParameterError(f"horizon is {horizon!r}; expected an integer of at least 1, here or in the MDP")
    choices = ExpandedMDP.of(mdp, False)
    size, num_actions = len(choices.underlying), choices.num_actions
    rho = np.zeros(size)
    for node, probability in choices.starts:
        rho[node] += probability
    largest = 0.0
    for low in range(0, choices.num_targets, _BLOCK):
        targets = np.arange(low, min(low + _BLOCK, choices.num_targets))
        goal = choices.underlying[:, None] == targets
        around = _Episodes(choices.matrix, num_actions, goal, rho, int(horizon))
        largest = max(largest, 1 + float(around.times_from_start().max()))
    return largest


class _Episodes:
    """Least expected times to each of several targets, through episodes of H steps.

    With x = E[ET(0, s0)], every policy of an episode gives x -> c + q x: c its expected steps, q the probability that
    it misses the target. The least of these lines crosses the diagonal at x; it is found from above by Newton's method,
    each step of which takes the best policy for the last x. It starts with the policy that is least likely to miss.
    """

    def __init__(self, matrix: Any, num_actions: int, goal: np.ndarray, rho: np.ndarray, horizon: int):
        self.matrix, self.num_actions, self.goal, self.rho, self.horizon = matrix, num_actions, goal, rho, horizon

    def _pass(self, x: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """c and q of the episode that is best for x at `step` a step."""
        steps, misses = np.where(self.goal, 0.0, 1.0), np.where(self.goal, 0.0, 1.0)
        shape = (len(self.goal), self.num_actions, self.goal.shape[1])
        for _ in range(self.horizon - 1):
            c, q = (self.matrix @ steps).reshape(shape), (self.matrix @ misses).reshape(shape)
            best = (step * c + q * x).argmin(axis=1)[:, None]
            steps = np.where(self.goal, 0.0, 1 + np.take_along_axis(c, best, axis=1)[:, 0])
            misses = np.where(self.goal, 0.0, np.take_along_axis(q, best, axis=1)[:, 0])
        return self.rho @ steps, self.rho @ misses

    def times_from_start(self) -> np.ndarray:
        """(targets,), E[ET(0, s0)]; infinite where every episode from the start misses the target."""
        c, q = self._pass(np.ones(self.goal.shape[1]), 0.0)
        lost = q >= 1 - 1e-12
        x = np.where(lost, 0.0, c / np.where(lost, 1.0, 1 - q))
        while True:
            c, q = self._pass(x, 1.0)
            better = np.where(lost | (q >= 1), x, c / np.where(q >= 1, 1.0, 1 - q))
            done = (x - better <= 1e-12 * np.maximum(1, x)).all()
            x = np.minimum(x, better)
            if done:
                return np.where(lost, np.inf, x)
