"""The distribution of the return of a policy over an episode of T steps, without discount."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import UndefinedMeasure
from pharos.hardness.planning.steps import MEMORY, steps_of
from pharos.mdp import PolicyTable, TabularMDP, require_mdp

SAME = 1e-9  # returns closer than this are one return


@dataclass(frozen=True, eq=False)
class ReturnDistribution:
    """The returns of a policy from the start, and how probable they are.

    Attributes:
        returns: (K,) float64, ascending.
        probabilities: (K,) float64 > 0, sum 1.
        conventions: horizon, gamma (1), policy.
    """

    returns: np.ndarray
    probabilities: np.ndarray
    conventions: dict[str, Any] = field(default_factory=dict)

    @property
    def mean(self) -> float:
        return float(self.returns @ self.probabilities)

    @property
    def variance(self) -> float:
        return float((self.returns - self.mean) ** 2 @ self.probabilities)

    def quantile(self, level: float) -> float:
        """The smallest return that is exceeded with probability 1 - level at most."""
        reached = np.flatnonzero(np.cumsum(self.probabilities) >= level - 1e-12)
        return float(self.returns[reached[0] if len(reached) else -1])

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "returns": self.returns.tolist(),
            "probabilities": self.probabilities.tolist(),
            "mean": self.mean,
            "variance": self.variance,
            **self.conventions,
        }

    def __str__(self) -> str:
        return f"mean {self.mean:.6g}, deviation {self.variance**0.5:.6g}, {len(self.returns)} returns"


@require_mdp
def return_distribution(mdp: TabularMDP, policy: Any = None, *, horizon: int | None = None) -> ReturnDistribution:
    """Return the distribution of r_1 + ... + r_T under a policy, from the start, under every kind of chance.

    Args:
        policy: as for `evaluate_policy`; None: uniform.
        horizon: T; None: that of the MDP.
    Raises:
        UndefinedMeasure: there is no horizon, or there are so many different returns that a table of states by returns
            does not fit into 8 GiB.
        ParameterError: the policy or the horizon is wrong.
    Exactness: exact; returns within 1e-9 of each other count as one. Of general MDPs the reward r(s, a) is paid as it
        is, even where it is an expectation.
    Cost: T passes over S A K, where K returns are possible; two tables of S A K.
    Source: Bellemare, Dabney and Rowland (2023), "Distributional reinforcement learning", chapter 2.
    """
    steps = steps_of("return_distribution", mdp, horizon)
    for support, values, first in _backward(mdp, policy, steps):
        returns, last = support, first if first is not None else values
    mass = np.zeros(len(returns))
    for state, probability in zip(mdp.start_states, mdp.start_probabilities, strict=True):
        mass += probability * last[state, 0]
    is_possible = mass > 0
    conventions = {"horizon": steps, "gamma": 1.0, "policy": "uniform" if policy is None else "given"}
    return ReturnDistribution(returns[is_possible], mass[is_possible], conventions)


def _backward(mdp: TabularMDP, policy: Any, steps: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
    """For t = T - 1, ..., 0: the possible returns (K,), and their probabilities.

    These are (S + 1, W, K), from t on, W being A previous actions or 1.

    Under sticky actions also (S + 1, 1, K), as if no action had been executed before, for the last of them.
    """
    states, num_actions, chance = mdp.num_states, mdp.num_actions, mdp.chance
    table = PolicyTable.of(mdp, policy)
    rewards = np.where(np.asarray(mdp.terminal)[:, None], 0.0, mdp.rewards)
    paid, which = np.unique(rewards, return_inverse=True)
    which = which.reshape(rewards.shape)
    width = mdp.width
    support, values = np.zeros(1), np.ones((states + 1, width, 1))
    for t in range(steps - 1, -1, -1):
        sums = np.sort(np.append((paid[:, None] + support).ravel(), 0.0))  # what has ended has return 0
        following = sums[np.concatenate([[True], np.diff(sums) > SAME])]
        if 8 * states * num_actions * len(following) * 3 > MEMORY:
            raise UndefinedMeasure(
                f"return_distribution: {len(following)} returns are possible in {steps - t} steps from {states} "
                f"states, more than {MEMORY / 2**30:.0f} GiB hold; a smaller horizon or instance would define it"
            )
        executed = np.zeros((states, num_actions, len(following)))
        after = mdp.dynamics.expected(values)
        for i, reward in enumerate(paid):
            s, a = np.nonzero(which == i)
            place = np.searchsorted(following, reward + support + SAME / 2) - 1
            block = np.zeros((len(s), len(following)))
            block[:, np.maximum(place, 0)] = after[s, a]
            executed[s, a] = block
        now = np.zeros((states + 1, width, len(following)))
        origin = int(np.abs(following).argmin())
        now[states, :, origin] = 1.0
        now[:states] = chance.choice(executed, table.value(executed))
        first = None
        if mdp.is_sticky and t == 0:
            first = np.zeros((states + 1, 1, len(following)))
            first[:states] = chance.first.choice(executed, table.first_value(executed))
            first[states, 0, origin] = 1.0
        live = (now > 0).any(axis=(0, 1)) | (False if first is None else (first > 0).any(axis=(0, 1)))
        support, values = following[live], now[..., live]
        yield support, values, None if first is None else first[..., live]
