"""A part of an MDP: a contiguous range of its states, and the states outside of it that it needs the values of.

Numbers of breadth-first search are local, so a range leads to few states outside of it, its *halo*: with 16 ranges 9 %
of a range's rows on a Breakout of 2.4 million states, 0.03 % on a Freeway. Ranges are what several processes sweep
together (solvers/ranked.py).

Inside a part its own states have the numbers 0 .. n - 1, in order, and those of the halo n .. n + H - 1, ascending; -1
is the end. Arrays of values have n + H + 1 rows, so the compiled sweeps run over parts as they are.
"""

from dataclasses import dataclass

import numpy as np

from pharos.mdp.chance import Chance
from pharos.mdp.dynamics import Dynamics
from pharos.mdp.rewards import Rewards
from pharos.mdp.selection import PolicyTable, Selection
from pharos.mdp.tabular import TabularMDP


@dataclass(frozen=True, eq=False)
class Part:
    """The states [start, stop) of an MDP.

    Attributes:
        halo: (H,) int64, ascending: the states outside that these may lead to.
        dynamics: of n states, whose next states may be in the halo. reward_table: (n, A).
        gamma, chance: of the MDP.
    """

    start: int
    stop: int
    halo: np.ndarray
    dynamics: Dynamics
    reward_table: Rewards
    gamma: float
    chance: Chance

    @staticmethod
    def of(mdp: TabularMDP, start: int, stop: int) -> "Part":
        """The states [start, stop) of an MDP. Copies their next states, renumbered."""
        dynamics, halo = mdp.dynamics.part(start, stop)
        rewards = mdp.reward_table.of(slice(start, stop))
        return Part(start, stop, halo, dynamics, rewards, mdp.gamma, mdp.chance)

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def num_states(self) -> int:
        """n."""
        return len(self)

    @property
    def num_actions(self) -> int:
        """A."""
        return self.dynamics.num_actions

    @property
    def width(self) -> int:
        """W: A previous actions under sticky actions, else 1."""
        return self.chance.width(self.num_actions)

    def zeros(self) -> np.ndarray:
        """(n + H + 1, W) values: of its states, of the halo, of the end."""
        return np.zeros((len(self) + len(self.halo) + 1, self.width))

    def selection(self, select: Selection) -> Selection:
        """What is chosen in these states, of what is chosen in those of the whole MDP."""
        return select.of_states(slice(self.start, self.stop)) if isinstance(select, PolicyTable) else select
