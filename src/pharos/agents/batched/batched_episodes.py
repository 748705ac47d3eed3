"""The episodes of W runs: each walks the table of its own MDP; runs of one MDP are advanced by one compiled call."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pharos.agents.batched.runs import BatchRun
from pharos.errors import ParameterError
from pharos.kernels import batched_worlds as kernels


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
        self.staying = np.zeros((0, 0)) if run.staying is None else np.asarray(run.staying, np.float64)
        self.terminal = np.asarray(mdp.terminal, np.bool_)
        self.starts = np.asarray(mdp.start_states, np.int64)
        self.cumulative = np.cumsum(mdp.start_probabilities)


class BatchedEpisodes:
    """The running episodes of W runs with E copies of their environment each.

    Attributes:
        state: (W, E) int64, where each is.
        depth: () where an agent sees the state alone, (k,) where it sees the last k states of the episode.
        history: (W, E, k), those states, the oldest first; the first one of an episode stands for those before it.
        episodes, returns: (W,) finished episodes, and the sums of their returns.
        next_state, reward, flags: (W, E) of the last step; the reward is what was paid, late or with noise.
        next_history: (W, E, k), what is seen after the last step, before a new episode begins.
    """

    def __init__(self, runs: Sequence[BatchRun], keys: np.ndarray, copies: int, frames: int = 1):
        width = len(runs)
        by_table: dict[Any, list[int]] = {}
        for i, run in enumerate(runs):
            parts = (run.mdp.dynamics, run.mdp.reward_table, run.mdp.terminal, run.mdp.start_states)
            by_table.setdefault((*map(id, parts), id(run.outcome_rewards), id(run.staying)), []).append(i)
        self.worlds = [World(runs[members[0]], members) for members in by_table.values()]
        self.keys = keys
        self._chances = np.array([(*run.mdp.chance.triple, run.mdp.chance.first_chosen) for run in runs], np.float64)
        self._limits = np.array([run.time_limit for run in runs], np.int64)
        self._gammas = np.array([run.gamma for run in runs], np.float64)
        self._knobs = np.array([(run.laziness, run.reward_noise, run.reward_delay) for run in runs], np.float64)
        self.pending = np.zeros((width, copies, max(run.reward_delay for run in runs)))
        self.state = np.zeros((width, copies), np.int64)
        self.previous = np.full((width, copies), -1, np.int64)
        self.elapsed = np.zeros((width, copies), np.int64)
        self.running, self.discount = np.zeros((width, copies)), np.ones((width, copies))
        self.episodes, self.returns = np.zeros(width, np.int64), np.zeros(width)
        self.next_state = np.zeros((width, copies), np.int64)
        self.reward, self.flags = np.zeros((width, copies)), np.zeros((width, copies), np.uint8)
        for world in self.worlds:
            kernels.start(keys, world.members, world.starts, world.cumulative, self.state)
        self.depth = (frames,) if frames > 1 else ()
        self.history = np.repeat(self.state[..., None], frames, axis=2)
        self.next_history = self.history.copy()

    @property
    def seen(self) -> np.ndarray:
        """(W, E, *depth): the numbers of the states that agents see now."""
        return self.history if self.depth else self.state

    @property
    def next_seen(self) -> np.ndarray:
        """(W, E, *depth): of those that the last step led to, before a new episode begins."""
        return self.next_history if self.depth else self.next_state

    def step(self, step: int, actions: np.ndarray, *, counts: bool) -> None:
        """Execute actions (W, E); finished episodes are added up where `counts` is true."""
        setting = (self.keys, step, self._chances, self._limits, self._gammas)
        episodes = (self.state, self.previous, self.elapsed, self.running, self.discount, self.episodes, self.returns)
        transition = (self.next_state, self.reward, self.flags)
        for world in self.worlds:
            kernels.advance(
                world.transitions, world.rewards, world.staying, world.terminal, world.starts, world.cumulative,
                world.members, setting, self._knobs, actions, episodes, self.pending, transition, counts,
            )  # fmt: skip
        if self.depth:
            self.next_history[..., :-1], self.next_history[..., -1] = self.history[..., 1:], self.next_state
            ended = (self.flags & kernels.DONE) > 0
            self.history[:] = np.where(ended[..., None], self.state[..., None], self.next_history)

    def arrays(self) -> dict[str, np.ndarray]:
        """All that changes."""
        names = ["state", "previous", "elapsed", "running", "discount", "episodes", "returns"]
        more = [*(["pending"] if self.pending.size else []), *(["history"] if self.depth else [])]
        return {name: getattr(self, name) for name in [*names, *more]}
