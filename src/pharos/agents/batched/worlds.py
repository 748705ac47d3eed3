"""The episodes of W runs: each walks the table of its own MDP; runs of one MDP are advanced by one compiled call."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from pharos.agents.batched.runs import BLOCK, BatchRun
from pharos.errors import ParameterError
from pharos.kernels import batched_worlds as kernels

LARGEST_TABLES = 1 << 30  # bytes of observations that are kept


class World:
    """One MDP, and the runs that walk it."""

    def __init__(self, run: BatchRun, members: Sequence[int]):
        mdp, dynamics = run.mdp, run.mdp.dynamics
        self.members = np.array(members, np.int64)
        table = dynamics.deterministic_table()
        self.transitions = dynamics.for_kernels if table is None else table
        if self.transitions is None:
            raise ParameterError(
                f"the batched engine: {mdp} has no table of next states; expected one next state a pair, or a table "
                "of outcomes (TabularMDP.from_outcomes)"
            )
        self.rewards: tuple[Any, ...] = (mdp.reward_table.table, mdp.reward_table.palette)
        if run.outcome_rewards is not None and table is None:
            self.rewards = dynamics.for_kernels_with(run.outcome_rewards)  # type: ignore[attr-defined]
        self.terminal = np.asarray(mdp.terminal, np.bool_)
        self.starts = np.asarray(mdp.start_states, np.int64)
        self.cumulative = np.cumsum(mdp.start_probabilities)


class Worlds:
    """The running episodes of W runs with E copies of their environment each.

    Attributes:
        state: (W, E) int64, where each is.
        episodes, returns: (W,) finished episodes, and the sums of their returns.
        next_state, reward, flags: (W, E) of the last step.
    """

    def __init__(self, runs: Sequence[BatchRun], keys: np.ndarray, copies: int):
        width = len(runs)
        by_table: dict[Any, list[int]] = {}
        for i, run in enumerate(runs):
            parts = (run.mdp.dynamics, run.mdp.reward_table, run.mdp.terminal, run.mdp.start_states)
            by_table.setdefault((*map(id, parts), id(run.outcome_rewards)), []).append(i)
        self.worlds = [World(runs[members[0]], members) for members in by_table.values()]
        self.keys = keys
        self._chances = np.array([(*run.mdp.chance.triple, run.mdp.chance.first_chosen) for run in runs], np.float64)
        self._limits = np.array([run.time_limit for run in runs], np.int64)
        self._gammas = np.array([run.gamma for run in runs], np.float64)
        self.state = np.zeros((width, copies), np.int64)
        self.previous = np.full((width, copies), -1, np.int64)
        self.elapsed = np.zeros((width, copies), np.int64)
        self.running, self.discount = np.zeros((width, copies)), np.ones((width, copies))
        self.episodes, self.returns = np.zeros(width, np.int64), np.zeros(width)
        self.next_state = np.zeros((width, copies), np.int64)
        self.reward, self.flags = np.zeros((width, copies)), np.zeros((width, copies), np.uint8)
        for world in self.worlds:
            kernels.start(keys, world.members, world.starts, world.cumulative, self.state)

    def step(self, step: int, actions: np.ndarray, *, counts: bool) -> None:
        """Execute actions (W, E); finished episodes are added up where `counts` is true."""
        setting = (self.keys, step, self._chances, self._limits, self._gammas)
        episodes = (self.state, self.previous, self.elapsed, self.running, self.discount, self.episodes, self.returns)
        transition = (self.next_state, self.reward, self.flags)
        for world in self.worlds:
            kernels.advance(
                world.transitions, world.rewards, world.terminal, world.starts, world.cumulative, world.members,
                setting, actions, episodes, transition, counts,
            )  # fmt: skip

    def arrays(self) -> dict[str, np.ndarray]:
        """All that changes."""
        names = ("state", "previous", "elapsed", "running", "discount", "episodes", "returns")
        return {name: getattr(self, name) for name in names}


class Seen:
    """The observations of the states of W runs, as tensors: gathered from one table, or drawn for those who ask.

    Args:
        shape: of one observation as the network takes it; images have their channels first.
        moves: whether images are (H, W, C) and have to be turned.
    """

    def __init__(self, runs: Sequence[BatchRun], shape: tuple[int, ...], *, moves: bool):
        self.shape, self.moves, self.is_image = shape, moves, runs[0].observe.is_image
        sources = list({id(run.observe): run.observe for run in runs}.values())
        self.sources, place = sources, {id(source): i for i, source in enumerate(sources)}
        self.which = np.array([place[id(run.observe)] for run in runs])
        first = np.cumsum([0, *(source.num_states for source in sources)])
        self.first = torch.from_numpy(first[self.which])[:, None]
        self.table: torch.Tensor | None = None
        kind = torch.uint8 if self.is_image else torch.float32
        size = int(np.prod(shape))
        if first[-1] * size * kind.itemsize <= LARGEST_TABLES:
            table = torch.empty((int(first[-1]), size), dtype=kind)
            for source, begin in zip(sources, first, strict=False):
                for row in range(0, source.num_states, BLOCK):
                    rows = np.arange(row, min(row + BLOCK, source.num_states))
                    table[begin + row : begin + row + len(rows)] = self._drawn(source, rows)
            self.table = table

    def at(self, states: np.ndarray, out: torch.Tensor) -> torch.Tensor:
        """Write the observations of states (W, B) into out (W, B, size) float32, images from 0 to 1."""
        if self.table is not None:
            rows = (torch.from_numpy(states) + self.first).view(-1)
            seen = self.table.index_select(0, rows).view(out.shape)
            torch.div(seen, 255.0, out=out) if self.is_image else out.copy_(seen)
            return out
        for i, source in enumerate(self.sources):
            members = np.flatnonzero(self.which == i)
            drawn = self._drawn(source, states[members].ravel()).view(len(members), states.shape[1], -1)
            out[torch.from_numpy(members)] = drawn.float().div_(255.0) if self.is_image else drawn.float()
        return out

    def _drawn(self, source: Any, rows: np.ndarray) -> torch.Tensor:
        """(N, size) observations of one source."""
        seen = source.at(rows)
        if self.moves:
            seen = np.ascontiguousarray(np.moveaxis(seen, -1, 1))
        return torch.from_numpy(seen.reshape(len(rows), -1))


def as_networks_see(run: BatchRun) -> tuple[tuple[int, ...], bool]:
    """(shape of an observation as the network takes it, whether it is turned): images have their channels first.

    Stable-Baselines3 takes the smallest side of an image for its channels, and turns it unless that comes first.
    """
    shape = tuple(run.observe.shape)
    if not run.observe.is_image or int(np.argmin(shape)) == 0:
        return shape, False
    return (shape[2], *shape[:2]), True
