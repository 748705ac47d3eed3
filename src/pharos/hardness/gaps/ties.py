"""Proofs that actions of equal computed value are tied.

1. Two actions that pay the same and have the same outcomes are tied, whatever the MDP.

2. Deterministic dynamics, with or without sticky actions. Let x be the computed values, and let every action that is
not among the best computed ones be surely worse (its gap exceeds the error). Call two pairs (state, previous action)
alike where x is the same to the last bit. If all pairs that are alike, and each of the best actions there, pay the same
and lead to pairs that are alike, then what the best actions collect is the same sequence of rewards for ever, so their
values are the same number: any choice among them solves the same equations, one for each class of pairs. Under sticky
actions the action that is repeated must lead on alike as well. A map from values to rewards and next values
(`kernels.ties`) finds out in one pass.
"""

from collections.abc import Iterator

import numpy as np

from pharos.hardness.gaps.gap_blocks import GapBlock
from pharos.kernels import gaps
from pharos.mdp import TabularMDP

# Different values up to which the map is kept; beyond, it would take more than 200 MB, and nothing is proven.
MOST = 1 << 21
# Places of the map in the beginning.
_FIRST = 1 << 12


class TieProof:
    """The second proof, of one block of states after the other.

    Attributes:
        holds: whether it holds for all that was looked at.
    """

    def __init__(self, mdp: TabularMDP):
        self.holds = mdp.dynamics.is_deterministic and not mdp.is_random
        self._step = -1

    def look_at(
        self,
        step: int,
        own: np.ndarray,
        rewards: np.ndarray,
        following: np.ndarray,
        gap: np.ndarray,
        counted: np.ndarray,
    ) -> None:
        """Take up a block of N states.

        Args:
            step: values of different steps are different; blocks of one step come together.
            own: (N, W), the computed values of the states.
            rewards, following: (N, A), what executing an action pays, and the computed value of what follows.
            gap: (N, A), 0 for the best computed actions.
            counted: (N,), 0 for states that do not matter.
        """
        if not self.holds:
            return
        if step != self._step:
            self._step, self._filled = step, 0
            self._map = _empty_map(_FIRST, own.shape[1])
            ended = np.zeros((1, own.shape[1])), np.zeros_like(rewards[:1]), np.zeros_like(rewards[:1])
            self._extend(*ended, np.zeros_like(gap[:1]), np.ones(1, np.int64))  # worth 0 for ever
        self._extend(own, rewards, following, gap, counted)

    def _extend(
        self, own: np.ndarray, rewards: np.ndarray, following: np.ndarray, gap: np.ndarray, counted: np.ndarray
    ) -> None:
        own, rewards, following = (np.ascontiguousarray(each).view(np.int64) for each in (own, rewards, following))
        begin = 0
        while self.holds and begin < len(gap):
            begin, self._filled = gaps.extend(own, rewards, following, gap, counted, begin, self._map, self._filled)
            if begin < 0 or self._filled > MOST:
                self.holds = False
            elif begin < len(gap):
                larger = _empty_map(4 * len(self._map), own.shape[1])
                gaps.refill(self._map, larger)
                self._map = larger


def _empty_map(size: int, width: int) -> np.ndarray:
    return np.full((size, 3 if width == 1 else 5), gaps.FREE, np.int64)


def same_outcomes(
    mdp: TabularMDP, states: np.ndarray, rewards: np.ndarray, action: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """(K,) bool: the first proof, whether two actions pay the same and have the same outcomes; rewards (K, A) of the
    states (K,)."""
    rows = np.arange(len(states))
    same = rewards[rows, action] == rewards[rows, other]
    one, two = (mdp.dynamics.outcomes(states, each) for each in (action, other))
    counts = [np.bincount(each.which, minlength=len(states)) for each in (one, two)]
    same &= counts[0] == counts[1]
    firsts = [np.cumsum(each) - each for each in counts]
    for k in range(int(counts[0].max(initial=0))):
        some = np.flatnonzero(same & (counts[0] > k))
        here, there = firsts[0][some] + k, firsts[1][some] + k
        same[some] = (one.states[here] == two.states[there]) & (one.probabilities[here] == two.probabilities[there])
    return same


class UnresolvedTies:
    """Counts the ties that are not proven to be ties.

    Attributes:
        small: gaps that are computed as larger than 0, and no larger than the tolerance; of a tolerance that is part of
            what is asked for, gaps that are within their error of it.
        equal: gaps that are computed as 0, beyond the first of a state.
    """

    def __init__(self, mdp: TabularMDP, tolerance: float, error: float, is_definition: bool):
        self.mdp, self.tolerance, self.error, self.is_definition = mdp, tolerance, error, is_definition
        self.small = self.equal = 0
        self.proof = TieProof(mdp)

    def look_at(self, part: GapBlock, small: int, equal: int) -> None:
        """Take up the ties of a block: how many are small, and how many equal."""
        if part.scale == 0.0:
            return  # nothing can be chosen: every action is worth the same
        if self.is_definition:
            near = np.abs(part.gap - self.tolerance) <= self.error
            self.small += int((near.sum(axis=1) * part.counted).sum())
            return
        self.small += small
        self.equal += equal
        if not self.small and self.proof.holds:
            own = part.step.own[part.states[0] : part.states[-1] + 1] if part.is_whole else part.step.own[part.states]
            self.proof.look_at(part.number, own, part.rewards, part.following, part.gap, part.counted)

    def unresolved(self, parts: Iterator[GapBlock]) -> int:
        """How many are not proven; `parts` once more, where that is to be seen one by one."""
        if self.is_definition or (not self.small and self.proof.holds):
            return self.small
        if self.small or not self.equal:
            return self.small + self.equal
        return self.equal - sum(self._alike(part) for part in parts)

    def _alike(self, part: GapBlock) -> int:
        """Equal gaps of a block between actions that have the same outcomes."""
        if part.scale == 0.0:
            return 0
        zero = (part.gap == 0.0) & (part.counted > 0)[:, None]
        several = np.flatnonzero(zero.sum(axis=1) > 1)
        zero = zero[several]
        best = zero.argmax(axis=1)
        zero[np.arange(several.size), best] = False
        row, action = np.nonzero(zero)
        rows = several[row]
        likely = part.following[rows, best[row]] == part.following[rows, action]
        row, action, rows = row[likely], action[likely], rows[likely]
        same = same_outcomes(self.mdp, part.states[rows], part.rewards[rows], best[row], action)
        return int(part.counted[rows[same]].sum())
