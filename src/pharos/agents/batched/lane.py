"""A lane: a fixed number of runs that advance together; the common part of DQN and PPO.

It has four parts: the runs with their hyperparameters, what their networks are given (inputs.py), the networks with
their optimizer, and the episodes. The episodes of W runs walk the tables of their own MDPs; runs of one MDP are
advanced by one compiled call.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from pharos.agents.batched.arithmetic import CompiledArithmetic, CudaGraph, PinnedBuffer, TensorArithmetic, wait
from pharos.agents.batched.inputs import MASKED, ActionSets, NetworkInputs
from pharos.agents.batched.networks import PIXEL_MASK, BatchedNetwork, Values, pad, parameter_names
from pharos.agents.batched.runs import BatchRun, resolved
from pharos.kernels import batched as kernels

Net = TypeVar("Net", bound=BatchedNetwork)
POLICY_BLOCKS = (16, 64, 256)  # rows of the blocks in which a policy is asked


class RunGroup:
    """The runs of a lane. If there are fewer than its width, the last rows are idle: they repeat the first run.

    Attributes:
        runs: of all W rows. number: of runs that are not idle.
        keys: (W,) uint64. is_idle: (W,) bool.
        shared: hyperparameters of all of them; own: name -> (W,) those that are numbers.
        total: steps of the whole training. copies: of the environment of each run.
    """

    def __init__(self, agent: str, runs: Sequence[BatchRun], width: int):
        self.number, self.width = len(runs), width
        self.runs = [*runs, *[runs[0]] * (width - len(runs))]
        self.keys = np.array([run.key % 2**64 for run in self.runs], np.uint64)
        self.is_idle = np.arange(width) >= len(runs)
        every = [resolved(agent, run.hyperparameters) for run in self.runs]
        self.shared = every[0]
        numbers = [name for name, value in every[0].items() if isinstance(value, int | float)]
        self.own = {name: np.array([options[name] for options in every], np.float64) for name in numbers}
        self.total, self.copies = runs[0].steps, int(self.shared["n_envs"])
        self.num_actions = runs[0].mdp.num_actions


class LaneNetworks(Generic[Net]):
    """The networks of a lane, with their gradients and Adam.

    Args:
        network_for: from the shape of an observation to a network.
    Attributes:
        network: for observations of the table's shape.
        parameters, gradients, means, squares: (W, P). updates: (W,) of each run so far.
        values, gradient_views: views of parameters and gradients by name.
        loss: (W,) of the last minibatch.
    """

    def __init__(
        self, network_for: Callable[[tuple[int, ...]], Net], group: RunGroup, inputs: NetworkInputs, device: str
    ):
        self._group, self._seen, shape = group, inputs.table, inputs.table.shape
        self.network = network_for(shape)
        for layer in self.network.layers:
            layer.number = group.number
        self._own_networks = [
            self.network if view.shape == shape else network_for(view.shape) for view in self._seen.views
        ]
        self.parameters = torch.from_numpy(self._initial()).to(device)
        self.gradients = torch.zeros_like(self.parameters)
        self.means, self.squares = torch.zeros_like(self.parameters), torch.zeros_like(self.parameters)
        self.updates = np.zeros(group.width, np.int64)
        self.loss = PinnedBuffer((group.width,), torch.float64, device)
        self.values: Values = self.views(self.parameters)
        self.gradient_views = self.network.parameters.views(self.gradients)
        self.arithmetic = (CompiledArithmetic if device == "cpu" else TensorArithmetic)(device, group.width)

    def views(self, rows: torch.Tensor) -> Values:
        """name -> (W, ...) view of parameters (W, P), with the mask of observations if there is one."""
        views = self.network.parameters.views(rows)
        return views if self._seen.mask is None else {**views, PIXEL_MASK: self._seen.mask}

    def scores(self, x: torch.Tensor, values: Values | None = None) -> torch.Tensor:
        """(W, B, A) scores of actions for observations x, by the current networks or others with these values."""
        return self.network.scores(self.values if values is None else values, x)

    def plan(self, is_active: np.ndarray) -> None:
        """Set the active runs (W,) of the next `adam`."""
        rates, max_norms = self._group.own["learning_rate"], self._group.own["max_grad_norm"]
        self.arithmetic.plan(self.updates, is_active, rates, max_norms, self.network.eps)

    def adam(self) -> None:
        """Adam step set by `plan`, with clipped gradients."""
        self.arithmetic.adam((self.parameters, self.gradients, self.means, self.squares))

    def _initial(self) -> np.ndarray:
        """(W, P) initial parameters; each run draws the parameters of its own network."""
        keys = self._group.keys
        if all(network is self.network for network in self._own_networks):
            return self.network.initial(partial(self._draws, keys))
        rows = np.zeros((len(keys), self.network.parameters.length), np.float32)
        for i, network in enumerate(self._own_networks):
            runs = np.flatnonzero(self._seen.which == i)
            drawn = network.initial(partial(self._draws, keys[runs]))
            rows[runs] = pad(network.parameters, drawn, self.network.parameters)
        return rows

    @staticmethod
    def _draws(keys: np.ndarray, number: int) -> np.ndarray:
        """(N, number) uniform numbers in (0, 1) for keys (N,), for the initial parameters."""
        words = np.empty((len(keys), -(-number // 4), 4), np.uint32)
        kernels.words(keys, kernels.WEIGHTS, 0, words)
        return (words.reshape(len(keys), -1)[:, :number] + 0.5) * 2.0**-32

    def as_stored(self, views: Values, i: int) -> dict[str, np.ndarray]:
        """name -> one run's part of some views of parameters or gradients, in Stable-Baselines3's shapes."""
        shapes = self._own_networks[self._seen.which[i]].parameters.shapes
        arrays = {}
        for shape in shapes:
            part = views[shape.name][i].cpu().numpy()[tuple(slice(n) for n in shape.shape)]
            arrays[shape.name] = np.array(shape.stored(part), order="C")
        return {name: value for own_name, value in arrays.items() for name in parameter_names(own_name)}

    def restore_run(self, i: int, parameters: Mapping[str, np.ndarray]) -> None:
        """Restore parameters of run i that `as_stored` returned, in a lane of observations of one shape."""
        for shape in self.network.parameters.shapes:
            own = shape.own(parameters[parameter_names(shape.name)[0]])
            self.values[shape.name][i] = torch.from_numpy(np.ascontiguousarray(own)).view(shape.shape)


class Lane(Generic[Net]):
    """W runs of one group that advance together.

    Results of a run are bitwise independent of the other runs: no buffer or product is shared.

    Attributes:
        group: the runs, their keys and hyperparameters. inputs: what their networks are given.
        networks: of the runs, with their optimizer. worlds: their episodes.
        actions: (W, E) int64, executed next.
        steps: of each run so far; calls: of all copies together; collected: calls of the rollout that goes on.
        is_due: whether an update waits.
    """

    agent: str

    def __init__(self, runs: Sequence[BatchRun], width: int, device: str = "cpu"):
        self.device, self.group = device, RunGroup(self.agent, runs, width)
        self.inputs = NetworkInputs(self.group.runs, device)
        self.networks: LaneNetworks[Net] = LaneNetworks(self.network_for, self.group, self.inputs, device)
        frames, shape = runs[0].observe.frames, (width, self.group.copies)
        self.worlds = BatchedEpisodes(self.group.runs, self.group.keys, self.group.copies, frames, self.inputs.sets)
        self.actions = np.zeros(shape, np.int64)
        self._queries = PinnedBuffer((*shape, *self.inputs.depth), torch.int64, device)
        self._scores = PinnedBuffer((*shape, self.group.num_actions), torch.float32, device)
        self._answer = CudaGraph(self.answer, device)
        self.steps = self.calls = self.collected = 0
        self.is_due = False

    # Interface of an agent ------------------------------------------------------------------------------------------

    def network_for(self, shape: tuple[int, ...]) -> Net:
        """The network for observations of a shape. Called when `group` and `inputs` are there."""
        raise NotImplementedError

    def evaluate(self, x: torch.Tensor) -> torch.Tensor:
        """(W, E, A) scores of actions for observations x, by the current networks."""
        return self.networks.scores(x)

    def step(self) -> None:
        """Step each copy once; sets `is_due` at the end of a rollout."""
        raise NotImplementedError

    def update(self) -> None:
        """Learn from the collected transitions."""
        raise NotImplementedError

    def tensors(self) -> dict[str, torch.Tensor]:
        """Tensors of the training state by name."""
        networks = self.networks
        return {"parameters": networks.parameters, "means": networks.means, "squares": networks.squares}

    def own_arrays(self) -> dict[str, np.ndarray]:
        """State of the agent besides `tensors` and what all lanes have, by name."""
        raise NotImplementedError

    def probabilities(self, scores: np.ndarray) -> np.ndarray:
        """(M, A) float64: the policy, from scores (M, A)."""
        raise NotImplementedError

    # Learning -------------------------------------------------------------------------------------------------------

    def advance(self, point: int) -> None:
        """Train until `point` steps. An update due at `point` waits for the next call, unless it is the last."""
        is_last = point >= self.group.total
        while self.steps < point or (is_last and self.collected):
            self._learn_what_is_due()
            self.step()
        if is_last:
            self._learn_what_is_due()

    def _learn_what_is_due(self) -> None:
        if self.is_due:
            self.update()
            self.is_due = False

    def answer(self) -> None:
        """Write the scores of the requested states; a GPU records this."""
        self._queries.send()
        scores = self.evaluate(self.inputs.observed(self._queries))
        self._scores.tensor.copy_(self.inputs.masked(scores, self._queries))
        self._scores.fetch()

    def scores_of(self, states: np.ndarray) -> np.ndarray:
        """(W, E, A) scores of states (W, E, *depth), in a buffer that the next call reuses."""
        wait(self.device)
        self._queries.array[:] = states
        self._answer()
        wait(self.device)
        return self._scores.array

    def best_actions(self, states: np.ndarray) -> np.ndarray:
        """(number,) the action with the highest score of each run, in states (number, *depth)."""
        rows, number = np.zeros_like(self._queries.array), self.group.number
        rows[:number, 0] = states
        best: np.ndarray = self.scores_of(rows)[:number, 0].argmax(axis=1)
        return best

    def execute_actions(self) -> None:
        """Execute `actions`; episodes that end after the last step of the training are not counted."""
        counts = self.steps + self.group.copies <= self.group.total
        self.worlds.step(self.calls, self.actions, counts=counts)

    @property
    def losses(self) -> np.ndarray:
        """(W,) the losses of the last minibatch."""
        wait(self.device)
        return self.networks.loss.array

    # Training state -------------------------------------------------------------------------------------------------

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays of the training state by name; arrays of more than one number are changed in place."""
        arrays = {name: tensor.cpu().numpy() for name, tensor in self.tensors().items()}
        counters = np.array([self.steps, self.calls, self.collected, self.is_due], np.int64)
        own = {"updates": self.networks.updates, "counters": counters}
        return {**arrays, **own, **self.worlds.arrays(), **self.own_arrays()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore a state that `arrays` returned."""
        self.steps, self.calls, self.collected, is_due = map(int, arrays["counters"])
        self.is_due = bool(is_due)
        for name, array in self.arrays().items():
            array[...] = arrays[name]
        for name, tensor in self.tensors().items():
            tensor.copy_(torch.from_numpy(arrays[name]))

    def stored(self, i: int) -> dict[str, np.ndarray]:
        """The parameters of run i under Stable-Baselines3's names."""
        return self.networks.as_stored(self.networks.values, i)


class RunPolicy:
    """The current policy of one run of a lane.

    Attributes:
        masked: whether some actions are not available in some states, so that it is asked with masks.
    """

    def __init__(self, lane: Lane, i: int):
        self.lane, self.i, self.masked = lane, i, lane.group.runs[i].mdp.available is not None
        self.values = {
            name: view[i : i + 1] for name, view in lane.networks.values.items()
        }  # which change as it learns

    def action_probabilities(self, observations: np.ndarray, masks: np.ndarray | None = None) -> np.ndarray:
        """(M, A) float64 for observations (M, ...) as the environment gives them; masks (M, A) bool: available ones."""
        lane = self.lane
        wait(lane.device)
        answers, first = [], 0
        while first < len(observations):
            size = next((size for size in POLICY_BLOCKS if size >= len(observations) - first), POLICY_BLOCKS[-1])
            rows = lane.inputs.table.encoded(observations[first : first + size], self.i)
            block = torch.zeros((1, size, lane.inputs.table.size), device=lane.device)
            block[0, : len(rows)] = rows  # of one of two sizes, as layers keep room for each size
            scores = lane.networks.scores(block, self.values)[0, : len(rows)].cpu().numpy()
            if masks is not None:
                scores = np.where(masks[first : first + len(rows)], scores, np.float32(MASKED))
            answers.append(lane.probabilities(scores))
            first += size
        return np.concatenate(answers)


# Batched episodes -----------------------------------------------------------------------------------------------------


class World:
    """One MDP, and the runs on it."""

    def __init__(self, run: BatchRun, runs: Sequence[int]):
        mdp, dynamics = run.mdp, run.mdp.dynamics
        self.runs = np.array(runs, np.int64)
        rewards: tuple[Any, ...] = mdp.reward_table.for_kernels
        if run.outcome_rewards is not None and not dynamics.is_deterministic:
            rewards = dynamics.for_kernels_with(run.outcome_rewards)  # type: ignore[attr-defined]
        staying = np.zeros((0, 0)) if run.staying is None else np.asarray(run.staying, np.float64)
        self.starts = (np.asarray(mdp.start_states, np.int64), np.cumsum(mdp.start_probabilities))
        terminal = np.asarray(mdp.terminal, np.bool_)
        self.for_kernels = (dynamics.for_steps, rewards, staying, terminal, *self.starts, self.runs)


class BatchedEpisodes:
    """The running episodes of W runs with E copies of their environment each.

    Attributes:
        state: (W, E) int64, the state of each copy.
        depth: () if an agent sees the state alone, (k,) if it sees the last k states of the episode.
        history: (W, E, k), those states, the oldest first; the first one of an episode stands for those before it.
        episodes, returns: (W,) finished episodes, and the sums of their returns.
        next_state, reward, flags: (W, E) of the last step; the reward is what was paid, late or with noise.
        next_history: (W, E, k), what is seen after the last step, before a new episode begins.
    """

    def __init__(
        self,
        runs: Sequence[BatchRun],
        keys: np.ndarray,
        copies: int,
        frames: int = 1,
        sets: ActionSets | None = None,
    ):
        width = len(runs)
        by_table: dict[Any, list[int]] = {}
        for i, run in enumerate(runs):
            parts = (run.mdp.dynamics, run.mdp.reward_table, run.mdp.terminal, run.mdp.start_states)
            by_table.setdefault((*map(id, parts), id(run.outcome_rewards), id(run.staying)), []).append(i)
        self.worlds = [World(runs[indices[0]], indices) for indices in by_table.values()]
        self.keys = keys
        self._chances = np.array([(*run.mdp.chance.triple, run.mdp.chance.first_chosen) for run in runs], np.float64)
        # what is executed is drawn by the sets then, not in the kernel of all
        self._sets = None if all(run.mdp.chance.is_none for run in runs) else sets
        self._none = np.tile([1.0, 0.0, 0.0, 1.0], (width, 1))
        self._limits = np.array([run.time_limit for run in runs], np.int64)
        self._gammas = np.array([run.gamma for run in runs], np.float64)
        chances = [run.chance for run in runs]
        knobs = [(each.lazy, each.reward_noise, each.reward_delay, each.reward_scale) for each in chances]
        self._knobs = np.array(knobs, np.float64)
        self.pending = np.zeros((width, copies, max(each.reward_delay for each in chances)))
        self.state = np.zeros((width, copies), np.int64)
        self.previous = np.full((width, copies), -1, np.int64)
        self.elapsed = np.zeros((width, copies), np.int64)
        self.running, self.discount = np.zeros((width, copies)), np.ones((width, copies))
        self.episodes, self.returns = np.zeros(width, np.int64), np.zeros(width)
        self.next_state = np.zeros((width, copies), np.int64)
        self.reward, self.flags = np.zeros((width, copies)), np.zeros((width, copies), np.uint8)
        for world in self.worlds:
            kernels.start(keys, world.runs, *world.starts, self.state)
        self.depth = (frames,) if frames > 1 else ()
        self.history = np.repeat(self.state[..., None], frames, axis=2)
        self.next_history = self.history.copy()

    @property
    def seen(self) -> np.ndarray:
        """(W, E, *depth): numbers of the states that agents see now."""
        return self.history if self.depth else self.state

    @property
    def next_seen(self) -> np.ndarray:
        """(W, E, *depth): numbers of the states that the last step led to, before a new episode begins."""
        return self.next_history if self.depth else self.next_state

    def step(self, step: int, actions: np.ndarray, *, counts: bool) -> None:
        """Execute actions (W, E); finished episodes are added up if `counts` is true."""
        chances = self._chances
        if self._sets is not None:
            choices, actions, chances = actions, np.empty_like(actions), self._none
            sets = self._sets.of_episodes(self.state)
            kernels.execute_runs_in_sets(self.keys, step, self._chances, sets, self.previous, choices, actions)
        setting = (self.keys, step, chances, self._limits, self._gammas, self._knobs)
        running = (self.state, self.previous, self.elapsed, self.running, self.discount)
        episodes = (*running, self.episodes, self.returns, self.pending)
        transition = (self.next_state, self.reward, self.flags)
        for world in self.worlds:
            kernels.advance(world.for_kernels, setting, actions, episodes, transition, counts)
        if self.depth:
            self.next_history[..., :-1], self.next_history[..., -1] = self.history[..., 1:], self.next_state
            ended = (self.flags & kernels.ENDED) > 0
            self.history[:] = np.where(ended[..., None], self.state[..., None], self.next_history)

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays of the state of all episodes."""
        names = ["state", "previous", "elapsed", "running", "discount", "episodes", "returns"]
        more = [*(["pending"] if self.pending.size else []), *(["history"] if self.depth else [])]
        return {name: getattr(self, name) for name in [*names, *more]}
