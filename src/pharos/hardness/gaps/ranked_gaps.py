"""Gaps by several processes: each adds up those of a contiguous range of the states.

The first rank has the values, and knows which states can be reached. It sends each rank both for the states of its
range; values of its halo come from the ranks that have them. A gap is computed by one rank, from the same numbers in
the same order as by one process, so gaps, counts and histogram do not depend on the number of ranks. Sums of floats
do, by their rounding: each rank's is off by two units, and so is that of one process.

A range proves its ties where two actions pay the same and lead to the same states. What equal values of different
ranges say about each other is seen by the first rank alone.
"""

from typing import NamedTuple

import numpy as np

from pharos.hardness.gaps.gap_blocks import Step, gaps_of_step, steps_of
from pharos.hardness.gaps.gap_sums import GapSums
from pharos.hardness.gaps.ties import UnresolvedTies
from pharos.mdp import Part, TabularMDP
from pharos.ranks import Halo, Rank, check_ranks, cuts_of
from pharos.solvers import Solution
from pharos.system.workers import usable_workers


class TieRule(NamedTuple):
    """What counts as a tie: gaps up to the tolerance, each known up to the error; `gaps` says what a definition is."""

    tolerance: float
    error: float
    is_definition: bool


class Totals(NamedTuple):
    """Of all states: sums, and how many ties are small, equal, and equal and proven."""

    sums: GapSums
    small: int
    equal: int
    alike: int


class RankedGaps:
    """One rank's range of the states. The first calls `totals` as often as it likes, then `end`; others `follow`."""

    def __init__(self, mdp: TabularMDP, rank: Rank):
        check_ranks(mdp.num_states, rank.size)
        self.mdp, self.rank = mdp, rank
        self._cuts = cuts_of(mdp.num_states, rank.size)
        self._part = Part.of(mdp, *map(int, self._cuts[rank.rank : rank.rank + 2]))
        self._part.dynamics.workers = max(1, usable_workers(None) // rank.neighbors)
        self._halo = Halo(rank, self._part.halo, self._cuts)

    def totals(self, solution: Solution, rule: TieRule) -> Totals:
        """What the gaps of a solution add up to, at the first rank."""
        self.rank.broadcast(np.array(rule, np.float64), np.zeros(0))
        parts = self._added_up(next(steps_of(self.mdp, solution)), rule)
        ties = np.sum([numbers[:3] for numbers in parts], axis=0).tolist()
        return Totals(GapSums.of_all(GapSums.of_numbers(numbers[3:]) for numbers in parts), *ties)

    def end(self) -> None:
        """Tell the others that there is no more to do."""
        self.rank.broadcast(np.zeros(0), np.zeros(0))

    def follow(self) -> None:
        """Take part until the end."""
        while len(numbers := self.rank.broadcast(None, np.zeros(0))):
            tolerance, error, is_definition = numbers.tolist()
            self._added_up(None, TieRule(tolerance, error, bool(is_definition)))

    def _added_up(self, step: Step | None, rule: TieRule) -> list[np.ndarray]:
        """What each rank's range adds up to, at the first, which has the step: (small, equal, alike), then sums."""
        part, sums = self._part, GapSums()
        ties = UnresolvedTies(self.mdp, *rule, is_part=True)
        alike = 0
        for block in gaps_of_step(
            part, self.mdp.terminal[part.start : part.stop], self._scattered(step), 0, part.start
        ):
            ties.look_at(block, *sums.add(block, rule.tolerance, rule.error))
            if not rule.is_definition and not ties.small:
                alike += ties.alike(block)
        return self.rank.gather(np.concatenate([[ties.small, ties.equal, alike], sums.to_numbers()]))

    def _scattered(self, step: Step | None) -> Step:
        """The step of this rank's range; its values (n + H + 1, W) are those of its halo, too."""
        part, rank = self._part, self.rank
        x = part.zeros()
        times = np.zeros((len(part), 2), np.min_scalar_type(part.num_actions))  # how often states count; as starts
        rank.scatter_rows(None if step is None else step.next_x, self._cuts, x)
        rank.scatter_rows(None if step is None else _times(step, times.dtype), self._cuts, times)
        self._halo.receive(x)
        self._halo.send(x[: len(part)])
        self._halo.finish(x[len(part) : -1])
        return Step(x, x, times[:, 0], times[:, 1] > 0)


def _times(step: Step, dtype: np.dtype) -> np.ndarray:
    """(S, 2)."""
    return np.stack([step.later.astype(dtype), step.first.astype(dtype)], axis=1)


def capacity_of(mdp: TabularMDP, ranks: int) -> int:
    """Bytes that a rank sends in an exchange, at most: a range of values to each, or the histogram."""
    return ((mdp.num_states // ranks + 1) * mdp.width * 8 + 256) * ranks + GapSums().to_numbers().nbytes + 64


def warm(mdp: TabularMDP) -> None:
    """Compile what ranks run, once, before they are forked."""
    part = Part.of(mdp, 0, min(mdp.num_states, 2))
    x, never = part.zeros(), np.zeros(len(part), np.bool_)
    for block in gaps_of_step(part, never, Step(x, x, never, never)):
        GapSums().add(block, 1.0, 0.0)
