"""A lane: a fixed number of runs that advance together; the common part of DQN and PPO.

Observations of W runs are tensors: gathered from one table if it fits, else drawn for those who ask.

The episodes of W runs: each walks the table of its own MDP; runs of one MDP are advanced by one compiled call.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from pharos.agents.batched.arithmetic import CompiledArithmetic, CudaGraph, PinnedBuffer, TensorArithmetic, is_gpu, wait
from pharos.agents.batched.networks import (
    PIXEL_MASK,
    BatchedNetwork,
    Values,
    aligned_zeros,
    flat_view,
    input_indices,
    pad,
    parameter_names,
)
from pharos.agents.batched.runs import (
    OBSERVED_AT_ONCE,
    BatchRun,
    ObservationSource,
    as_networks_see,
    is_small,
    resolved,
)
from pharos.kernels import batched as kernels

OBSERVED_BYTES = 1 << 28  # bytes of observations as networks take them, on the processor
SHARE_OF_DEVICE = 0.5  # of a GPU's free memory that a table may take


class NetworkView:
    """Observations of one source as a network sees them.

    An observation is one frame, or k frames one after another along the channels.

    Attributes:
        frames: k.
        shape: of an observation as Stable-Baselines3's networks take it, images with their channels first.
        length: numbers of one frame.
    """

    def __init__(self, source: ObservationSource):
        self.source, self.frames = source, source.frames
        self.shape, self._turns = as_networks_see(tuple(source.shape), source.is_image)
        self.length = math.prod(self.shape) // self.frames

    def rows(self, observations: np.ndarray) -> np.ndarray:
        """(N, M) of observations as the environment gives them, or of single frames: channels first."""
        turned = np.moveaxis(observations, -1, 1) if self._turns else observations
        return turned.reshape(len(turned), -1)

    def in_blocks(self) -> Iterator[tuple[int, np.ndarray]]:
        """Yield (first state, single frames) of all states in blocks."""
        look = self.source.at if self.frames == 1 else self.source.frame
        for first in range(0, self.source.num_states, OBSERVED_AT_ONCE):
            yield first, look(np.arange(first, min(first + OBSERVED_AT_ONCE, self.source.num_states)))


class ObservationTable:
    """Observations of runs whose observations have the same shape.

    Images are kept as bytes. If they do not fit, minibatches are drawn: 0.3 us an image of a small Breakout. If
    several frames are seen single ones are kept, and put together for those who ask.

    Attributes:
        views: of the distinct sources; which: (W,) the index in `views` of each run's.
        frames: k, how many states are seen at once.
        shape: of an observation as the lane's network takes it.
        size: numbers that its first layer takes.
        is_image: whether it is one.
        mask: None, as all have the same shape.
    """

    mask: torch.Tensor | None = None

    def __init__(self, runs: Sequence[BatchRun], device: str = "cpu"):
        self.device, self.is_image = device, runs[0].observe.is_image
        sources = list({id(run.observe): run.observe for run in runs}.values())
        index = {id(source): i for i, source in enumerate(sources)}
        self.views = [NetworkView(source) for source in sources]
        self.which = np.array([index[id(run.observe)] for run in runs])
        self._ends = np.cumsum([0, *(source.num_states for source in sources)])
        self._begins = self._ends[self.which]
        self.shape, self.frames = self.views[0].shape, self.views[0].frames
        self.size = math.prod(self.shape)
        self._allocate_table()

    def _allocate_table(self) -> None:
        kind = torch.uint8 if self.is_image else torch.float32
        self._table: torch.Tensor | None = None
        length = self.size // self.frames
        if self._ends[-1] * length * kind.itemsize > OBSERVED_BYTES:
            return
        self._table = torch.empty((int(self._ends[-1]), length), dtype=kind)
        for view, begin in zip(self.views, self._ends, strict=False):
            for first, block in view.in_blocks():
                rows = np.ascontiguousarray(view.rows(block))
                self._table[begin + first : begin + first + len(block)] = torch.from_numpy(rows)

    def at(self, states: PinnedBuffer, out: torch.Tensor) -> torch.Tensor:
        """Write the observations of states (W, B) into out (W, B, size) float32; images from 0 to 255.

        If k frames are seen states are (W, B, k), the last ones of the episode, the oldest first.
        """
        target = flat_view(out).numpy()
        if self._table is not None:
            kernels.look_up_rows(self._table.numpy(), self._begins, states.array.reshape(len(target), -1), target)
        else:
            for i, view in enumerate(self.views):
                runs = np.flatnonzero(self.which == i)
                drawn = view.rows(view.source.at(states.array[runs].reshape(-1, *states.array.shape[2:])))
                target[runs, : states.array.shape[1] * self.size] = drawn.reshape(len(runs), -1)
        return out

    def encoded(self, observations: np.ndarray, i: int) -> torch.Tensor:
        """(N, size) float32 of observations (N, ...) as the environment of run i gives them."""
        rows = self.views[self.which[i]].rows(observations)
        return torch.from_numpy(np.ascontiguousarray(rows, np.float32))


class DeviceObservationTable(ObservationTable):
    """Observations on a device other than the processor, for runs whose observations may differ in size.

    A table of all observations lies there. Smaller observations are filled up with zeros, and a mask says which pixels
    of the small convolution there are.

    Raises:
        MemoryError: the table takes more than its share of the device's memory.
    """

    def __init__(self, runs: Sequence[BatchRun], device: str = "cpu"):
        super().__init__(runs, device)
        if len({view.shape for view in self.views}) == 1:
            return
        pixels = np.array([math.prod(view.shape[1:]) for view in self.views])[self.which]
        self.shape = (self.shape[0], 1, int(pixels.max())) if self.is_image else (self.size,)
        if self.is_image:
            is_there = np.arange(pixels.max()) < pixels[:, None]
            self.mask = torch.from_numpy(is_there.astype(np.float32)).to(device)

    def _allocate_table(self) -> None:
        kind, total = torch.uint8 if self.is_image else torch.float32, int(self._ends[-1])
        length = max(view.length for view in self.views) + 1
        needed = total * length * kind.itemsize
        if is_gpu(self.device) and needed > SHARE_OF_DEVICE * torch.cuda.mem_get_info()[0]:
            raise MemoryError(
                f"out of memory: observations of {total:,} states take {needed >> 20:,} MiB on {self.device}, "
                f"more than {SHARE_OF_DEVICE:.0%} of what is free; a run alone that is too large trains on cpu"
            )
        table = torch.zeros((total, length), dtype=kind)
        of_views = [input_indices(view.shape, is_small(view.shape, self.is_image)) for view in self.views]
        self.size = max(map(len, of_views))
        indices = np.full((len(self.views), self.size), length - 1)
        for view, own, row, begin in zip(self.views, of_views, indices, self._ends, strict=False):
            frame, inside = np.divmod(own, view.length)
            row[: len(own)] = np.where(frame < view.frames, frame * length + inside, length - 1)
            for first, block in view.in_blocks():
                rows = np.ascontiguousarray(view.rows(block))
                table[begin + first : begin + first + len(rows), : rows.shape[1]] = torch.from_numpy(rows)
        self._table = table.to(self.device)
        offsets = self._begins[:, None] if self.frames == 1 else self._begins[:, None, None]
        self._offsets = torch.from_numpy(offsets).to(self.device)
        self._indices = torch.from_numpy(indices[self.which][:, None]).to(self.device)
        self._in_an_observation = [torch.from_numpy(own).to(self.device) for own in of_views]

    def at(self, states: PinnedBuffer, out: torch.Tensor) -> torch.Tensor:
        """See `ObservationTable`; a GPU can record it."""
        assert self._table is not None
        rows = (states.tensor + self._offsets).view(-1)
        raw = self._table.index_select(0, rows).view(*states.tensor.shape[:2], -1)
        return out.copy_(raw.gather(2, self._indices.expand(-1, raw.shape[1], -1)))

    def encoded(self, observations: np.ndarray, i: int) -> torch.Tensor:
        """See `ObservationTable`; what travels is a 36th of the neighbours of pixels as float32."""
        which = self.which[i]
        raw = torch.from_numpy(np.ascontiguousarray(self.views[which].rows(observations))).to(self.device)
        rows = torch.nn.functional.pad(raw, (0, 1)).index_select(1, self._in_an_observation[which]).float()
        return torch.nn.functional.pad(rows, (0, self.size - rows.shape[1]))


class ActionSets:
    """The actions that are available in the states of the runs of a lane.

    Attributes:
        table: (N, A) bool, of the states of all MDPs, one after the other. begins: (W, 1) the row of each run's state
        0.
    """

    def __init__(self, runs: Sequence[BatchRun], device: str):
        tables = {id(run.mdp.terminal): run.mdp for run in runs}
        sets = [
            np.ones((mdp.num_states, mdp.num_actions), np.bool_) if mdp.available is None else mdp.available
            for mdp in tables.values()
        ]
        begins = dict(zip(tables, np.cumsum([0, *map(len, sets)]).tolist(), strict=False))
        self._table = np.concatenate(sets)
        self._begins = np.array([[begins[id(run.mdp.terminal)]] for run in runs])
        self.table, self.begins = (torch.from_numpy(each).to(device) for each in (self._table, self._begins))

    @staticmethod
    def of(runs: Sequence[BatchRun], device: str) -> "ActionSets | None":
        """The sets of runs; None if all actions are available to all of them."""
        return None if all(run.mdp.available is None for run in runs) else ActionSets(runs, device)

    def of_states(self, states: torch.Tensor) -> torch.Tensor:
        """(W, B, A) bool, of states (W, B)."""
        return self.table[states + self.begins]

    def of_episodes(self, states: np.ndarray) -> np.ndarray:
        """(W, E, A) bool, of states (W, E) in main memory."""
        return np.asarray(self._table[states + self._begins])


MASKED = -1e8
"""The score of an action that is not available: its probability is 0, and its logarithm times that, too."""


# Lane -----------------------------------------------------------------------------------------------------------------


Net = TypeVar("Net", bound=BatchedNetwork)
POLICY_BLOCKS = (16, 64, 256)  # rows of the blocks in which a policy is asked


class Lane(Generic[Net]):
    """W runs of one group. If there are fewer, the last rows are idle: they repeat the first run.

    Results of a run are bitwise independent of the other runs: no buffer or product is shared.

    Attributes:
        number: of runs that are not idle.
        shared: hyperparameters of all of them; own: name -> (W,) those that are numbers.
        steps: of each run so far; calls: of all copies together; collected: calls of the rollout that goes on.
        total: steps of the whole training.
        depth: (k,) if k frames are seen, so that what is seen is k numbers of states; else ().
        is_due: whether an update waits.
    """

    agent: str
    tensors: tuple[str, ...] = ("parameters", "means", "squares")  # those that have to be remembered

    def __init__(self, runs: Sequence[BatchRun], width: int, device: str = "cpu"):
        self.number, self.width, self.device = len(runs), width, device
        self.arithmetic = (CompiledArithmetic if device == "cpu" else TensorArithmetic)(device, width)
        self.runs = [*runs, *[runs[0]] * (width - len(runs))]
        every = [resolved(self.agent, run.hyperparameters) for run in self.runs]
        self.shared = every[0]
        numbers = [name for name, value in every[0].items() if isinstance(value, int | float)]
        self.own = {name: np.array([options[name] for options in every], np.float64) for name in numbers}
        self.total, self.copies = runs[0].steps, int(self.shared["n_envs"])
        self.num_actions = runs[0].mdp.num_actions
        self.keys = np.array([run.key % 2**64 for run in self.runs], np.uint64)
        self.is_idle = np.arange(width) >= len(runs)
        self.sets = ActionSets.of(self.runs, device)
        self.worlds = BatchedEpisodes(self.runs, self.keys, self.copies, runs[0].observe.frames, self.sets)
        self.depth = self.worlds.depth
        self.actions = np.zeros((width, self.copies), np.int64)
        self.seen = (ObservationTable if device == "cpu" else DeviceObservationTable)(self.runs, device)
        self._buffers: dict[int, torch.Tensor] = {}
        self.network = self.network_for(self.seen.shape)
        for layer in self.network.layers:
            layer.number = self.number
        self._own_networks = [
            self.network if view.shape == self.seen.shape else self.network_for(view.shape) for view in self.seen.views
        ]
        self.parameters = torch.from_numpy(self._initial()).to(device)
        self.gradients = torch.zeros_like(self.parameters)
        self.means, self.squares = torch.zeros_like(self.parameters), torch.zeros_like(self.parameters)
        self.updates = np.zeros(width, np.int64)
        self.loss = PinnedBuffer((width,), torch.float64, device)
        self.values: Values = self.views(self.parameters)
        self.gradient_views = self.network.parameters.views(self.gradients)
        self._queries = PinnedBuffer((width, self.copies, *self.depth), torch.int64, device)
        self._scores = PinnedBuffer((width, self.copies, self.num_actions), torch.float32, device)
        self._answer = CudaGraph(self.answer, device)
        self.steps = self.calls = self.collected = 0
        self.is_due = False

    # Interface of an agent ------------------------------------------------------------------------------------------

    def network_for(self, shape: tuple[int, ...]) -> Net:
        """The network for observations of a shape."""
        raise NotImplementedError

    def evaluate(self, x: torch.Tensor) -> torch.Tensor:
        """(W, E, A) scores of actions for observations x, by the current networks."""
        return self.network.scores(self.values, x)

    def step(self) -> None:
        """Step each copy once; sets `is_due` at the end of a rollout."""
        raise NotImplementedError

    def update(self) -> None:
        """Learn from the collected transitions."""
        raise NotImplementedError

    def own_arrays(self) -> dict[str, np.ndarray]:
        """State of the agent besides `arrays`, by name."""
        raise NotImplementedError

    def probabilities(self, scores: np.ndarray) -> np.ndarray:
        """(M, A) float64: the policy, from scores (M, A)."""
        raise NotImplementedError

    # Learning -------------------------------------------------------------------------------------------------------

    def advance(self, point: int) -> None:
        """Train until `point` steps. An update due at `point` waits for the next call, unless it is the last."""
        is_last = point >= self.total
        while self.steps < point or (is_last and self.collected):
            self._learn_what_is_due()
            self.step()
        if is_last:
            self._learn_what_is_due()

    def _learn_what_is_due(self) -> None:
        if self.is_due:
            self.update()
            self.is_due = False

    def views(self, rows: torch.Tensor) -> Values:
        """name -> (W, ...) view of parameters (W, P), with the mask of observations if there is one."""
        views = self.network.parameters.views(rows)
        return views if self.seen.mask is None else {**views, PIXEL_MASK: self.seen.mask}

    def observed(self, states: PinnedBuffer) -> torch.Tensor:
        """(W, B, size) float32 observations of states (W, B, *depth), in a buffer reused for this B."""
        number = states.array.shape[1]
        if number not in self._buffers:
            self._buffers[number] = aligned_zeros(self.width, number, self.seen.size, device=self.device)
        return self.seen.at(states, self._buffers[number])

    def answer(self) -> None:
        """Write the scores of the requested states; a GPU records this."""
        self._queries.send()
        self._scores.tensor.copy_(self.masked(self.evaluate(self.observed(self._queries)), self._queries))
        self._scores.fetch()

    def masked(self, scores: torch.Tensor, states: PinnedBuffer) -> torch.Tensor:
        """Scores (W, B, A) of states (W, B, *depth), in place: MASKED for actions that are not available there."""
        if self.sets is None:
            return scores
        numbers = states.tensor[..., -1] if self.depth else states.tensor
        return scores.masked_fill_(~self.sets.of_states(numbers), MASKED)

    def scores_of(self, states: np.ndarray) -> np.ndarray:
        """(W, E, A) scores of states (W, E, *depth), in a buffer that the next call reuses."""
        wait(self.device)
        self._queries.array[:] = states
        self._answer()
        wait(self.device)
        return self._scores.array

    def best_actions(self, states: np.ndarray) -> np.ndarray:
        """(number,) the action with the highest score of each run, in states (number, *depth)."""
        rows = np.zeros((self.width, self.copies, *self.depth), np.int64)
        rows[: self.number, 0] = states
        best: np.ndarray = self.scores_of(rows)[: self.number, 0].argmax(axis=1)
        return best

    def execute_actions(self) -> None:
        """Execute `actions`; episodes that end after the last step of the training are not counted."""
        self.worlds.step(self.calls, self.actions, counts=self.steps + self.copies <= self.total)

    @property
    def losses(self) -> np.ndarray:
        """(W,) the losses of the last minibatch."""
        wait(self.device)
        return self.loss.array

    def plan(self, is_active: np.ndarray) -> None:
        """Set the active runs (W,) of the next `adam`."""
        rates, max_norms = self.own["learning_rate"], self.own["max_grad_norm"]
        self.arithmetic.plan(self.updates, is_active, rates, max_norms, self.network.eps)

    def adam(self) -> None:
        """Adam step set by `plan`, with clipped gradients."""
        self.arithmetic.adam((self.parameters, self.gradients, self.means, self.squares))

    def _initial(self) -> np.ndarray:
        """(W, P) initial parameters; each run draws the parameters of its own network."""
        if all(network is self.network for network in self._own_networks):
            return self.network.initial(partial(self._draws, self.keys))
        rows = np.zeros((self.width, self.network.parameters.length), np.float32)
        for i, network in enumerate(self._own_networks):
            runs = np.flatnonzero(self.seen.which == i)
            keys = self.keys[runs]
            drawn = network.initial(partial(self._draws, keys))
            rows[runs] = pad(network.parameters, drawn, self.network.parameters)
        return rows

    @staticmethod
    def _draws(keys: np.ndarray, number: int) -> np.ndarray:
        """(N, number) uniform numbers in (0, 1) for keys (N,), for the initial parameters."""
        words = np.empty((len(keys), -(-number // 4), 4), np.uint32)
        kernels.words(keys, kernels.WEIGHTS, 0, words)
        return (words.reshape(len(keys), -1)[:, :number] + 0.5) * 2.0**-32

    # Training state -------------------------------------------------------------------------------------------------

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays of the training state by name; arrays of more than one number are changed in place."""
        tensors = {name: getattr(self, name).cpu().numpy() for name in self.tensors}
        counters = np.array([self.steps, self.calls, self.collected, self.is_due], np.int64)
        return {**tensors, "updates": self.updates, "counters": counters, **self.worlds.arrays(), **self.own_arrays()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Restore a state that `arrays` returned."""
        self.steps, self.calls, self.collected, is_due = map(int, arrays["counters"])
        self.is_due = bool(is_due)
        for name, array in self.arrays().items():
            array[...] = arrays[name]
        for name in self.tensors:
            getattr(self, name).copy_(torch.from_numpy(arrays[name]))

    def stored(self, i: int) -> dict[str, np.ndarray]:
        """The parameters of run i under Stable-Baselines3's names."""
        return self.as_stored(self.values, i)

    def restore_network(self, i: int, parameters: Mapping[str, np.ndarray]) -> None:
        """Restore parameters of run i that `stored` returned, in a lane of observations of one shape."""
        for shape in self.network.parameters.shapes:
            own = shape.own(parameters[parameter_names(shape.name)[0]])
            self.values[shape.name][i] = torch.from_numpy(np.ascontiguousarray(own)).view(shape.shape)

    def as_stored(self, views: Values, i: int) -> dict[str, np.ndarray]:
        """name -> one run's part of some views of parameters or gradients, in Stable-Baselines3's shapes."""
        shapes = self._own_networks[self.seen.which[i]].parameters.shapes
        arrays = {}
        for shape in shapes:
            part = views[shape.name][i].cpu().numpy()[tuple(slice(n) for n in shape.shape)]
            arrays[shape.name] = np.array(shape.stored(part), order="C")
        return {name: value for own_name, value in arrays.items() for name in parameter_names(own_name)}


class RunPolicy:
    """The current policy of one run of a lane.

    Attributes:
        masked: whether some actions are not available in some states, so that it is asked with masks.
    """

    def __init__(self, lane: Lane, i: int):
        self.lane, self.i, self.masked = lane, i, lane.runs[i].mdp.available is not None
        self.values = {name: view[i : i + 1] for name, view in lane.values.items()}  # which change as it learns

    def action_probabilities(self, observations: np.ndarray, masks: np.ndarray | None = None) -> np.ndarray:
        """(M, A) float64 for observations (M, ...) as the environment gives them; masks (M, A) bool: available ones."""
        lane = self.lane
        wait(lane.device)
        answers, first = [], 0
        while first < len(observations):
            size = next((size for size in POLICY_BLOCKS if size >= len(observations) - first), POLICY_BLOCKS[-1])
            rows = lane.seen.encoded(observations[first : first + size], self.i)
            block = torch.zeros((1, size, lane.seen.size), device=lane.device)
            block[0, : len(rows)] = rows  # of one of two sizes, as layers keep room for each size
            scores = lane.network.scores(self.values, block)[0, : len(rows)].cpu().numpy()
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
