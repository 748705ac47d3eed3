"""Many environments in one: a native Gymnasium vector environment, whose N states advance by one compiled call.

`make_vec("breakout", 1024, observation="vector", sticky=0.25)`, or
`gymnasium.make_vec("pharos/Breakout-v0", num_envs=1024)`. Chance is drawn inside the loop, from one stream of random
numbers for each environment: the start, if there are several. Then for each step the executed action under sticky or
random actions, whether it has an effect under lazy ones, and the outcome, if the rules have chance. If there is but one
possibility, nothing is drawn.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.interaction.simulator import (
    FrameStack,
    Interaction,
    RewardChannel,
    SimulatedEnv,
    Simulator,
    seed_streams,
)
from pharos.kernels import stepping
from pharos.kernels.stepping import DISABLED, SAME_STEP, EnvironmentBatch, first_outside
from pharos.mdp import OutcomeTable, rewards_of_outcomes, rewards_of_staying, whole_number
from pharos.observations import NO_ACTION, Index, Seen
from pharos.system.arrays import as_index_array
from pharos.system.records import split_options
from pharos.system.threads import in_blocks

if TYPE_CHECKING:
    from pharos.state_space import StateSpace

THREAD_STEPS = 4096  # steps that are worth a thread's while
TABLE_BYTES = 1 << 28  # bytes of observations that are computed beforehand
_NO_VECTORS = np.empty((0, 0), np.float32)


class Stepper(ABC):
    """Current states of N environments, and the step that advances them.

    Kernels get Setting and Batch as plain tuples: named ones cost Numba a microsecond a call more.

    Attributes:
        name: of a position in `info`: "state" or "index".
        current, final: the positions (N, ...), states or their indices: now, and at the ends of episodes that a step
            ended.
        final_elapsed: (N,) steps of the episode after the last step.
    """

    name: str
    starts: np.ndarray

    def __init__(self, simulator: Simulator, current: np.ndarray):
        self.simulator, self.current, self.final = simulator, current, np.zeros_like(current)
        self.final_elapsed = np.zeros(len(current), np.int64)

    def restart(self, mask: np.ndarray, rng: np.ndarray, state: object) -> None:
        """Begin episodes in the environments of mask (N,): in `state`, or in drawn start states."""
        if state is not None:
            self.current[mask] = self.positions(_states_of(self.simulator, state, len(mask))[mask])
            return
        numbers = np.zeros(len(mask), np.int64)
        stepping.draw_starts(self.simulator.start_cumulative, rng, mask, numbers)
        self.current[mask] = self.starts[numbers[mask]]

    @abstractmethod
    def positions(self, states: np.ndarray) -> np.ndarray:
        """Positions of states (N, D)."""

    @abstractmethod
    def states(self, positions: np.ndarray) -> np.ndarray:
        """States (n, D) of positions (n, ...)."""

    def vectors(self) -> np.ndarray:
        """Buffer for vector observations of the next step, empty if the compiled step does not write them."""
        return _NO_VECTORS

    @abstractmethod
    def step(self, batch: EnvironmentBatch) -> None:
        """Advance every environment."""

    def seen(self, positions: np.ndarray, previous: np.ndarray, elapsed: np.ndarray) -> Seen:
        """Observations of positions (n, ...)."""
        return self.simulator.context(self.states(positions), previous, elapsed)

    def observations(self, previous: np.ndarray, elapsed: np.ndarray) -> Seen:
        """Observations of the current positions."""
        return self.seen(self.current, previous, elapsed)


class RulesStepper(Stepper):
    """States (N, D), advanced by the rules."""

    name = "state"

    def __init__(self, simulator: Simulator, num_envs: int, mode: int):
        length = len(simulator.env.components)
        super().__init__(simulator, np.zeros((num_envs, length), np.int64))
        self.starts = simulator.start_states
        context = simulator.context
        vector = context.vector if context.is_plain else None  # the compiled step writes vectors as well
        self._is_fused = vector is not None
        self._vector = np.empty((0, length), np.float32)
        self._step_many: Callable[..., int] = simulator.rules.step_many
        scale = np.zeros(length) if vector is None else vector.scale
        self._setting = tuple(simulator.setting(mode, simulator.ranges, scale, self.starts))

    def __getstate__(self) -> dict[str, Any]:
        """Without compiled functions, as in GymEnv."""
        return {**self.__dict__, "_step_many": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._step_many = self.simulator.rules.step_many

    def positions(self, states: np.ndarray) -> np.ndarray:
        return states

    def states(self, positions: np.ndarray) -> np.ndarray:
        return positions

    def restart(self, mask: np.ndarray, rng: np.ndarray, state: object) -> None:
        self._vector = self._vector[:0]
        super().restart(mask, rng, state)

    def vectors(self) -> np.ndarray:
        if self._is_fused:
            self._vector = np.empty(self.current.shape, np.float32)
        return self._vector

    def step(self, batch: EnvironmentBatch) -> None:
        self.final_elapsed[:] = batch.elapsed + 1
        parameters, setting, arrays = self.simulator.rules.parameters, self._setting, tuple(batch)
        faults: list[int] = []

        def run(first: int, last: int) -> None:
            fault = self._step_many(parameters, setting, arrays, first, last)
            if fault >= 0:
                faults.append(fault)

        in_blocks(run, len(self.current), THREAD_STEPS)
        if faults:
            i, component = divmod(min(faults), self.current.shape[1])
            self.simulator.raise_fault(self.current[i], int(batch.executed[i]), component)

    def observations(self, previous: np.ndarray, elapsed: np.ndarray) -> Seen:
        return self._vector if len(self._vector) else super().observations(previous, elapsed)


class TableStepper(Stepper):
    """Indices (N,) of a built state space, advanced by looking successors up."""

    name = "index"

    def __init__(self, simulator: Simulator, space: "StateSpace", num_envs: int, mode: int):
        super().__init__(simulator, np.zeros(num_envs, np.int64))
        self.space = space
        self.starts = self.positions(simulator.start_states)
        self._transitions, self._rewards = _tables(space)
        self._staying = rewards_of_staying(space).array if simulator.lazy else np.empty((0, 0))
        self._setting = tuple(simulator.setting(mode, np.zeros((2, 0), np.int64), np.zeros(0), self.starts))
        context = simulator.context
        self._is_index = context.is_plain and isinstance(context.observation, Index)
        self._table: np.ndarray | None = None
        one = np.prod(context.observation.space.shape or ()) * np.dtype(context.observation.space.dtype).itemsize
        if context.is_plain and not self._is_index and one * space.num_states <= TABLE_BYTES:
            self._table = context.observation(space.states())

    def positions(self, states: np.ndarray) -> np.ndarray:
        return self.space.indices(states)

    def states(self, positions: np.ndarray) -> np.ndarray:
        return self.space.states(positions)

    def step(self, batch: EnvironmentBatch) -> None:
        self.final_elapsed[:] = batch.elapsed + 1
        walk_table: Callable[..., None] = stepping.walk_table
        terminal, setting, arrays = self.space.terminal, self._setting, tuple(batch)

        def run(first: int, last: int) -> None:
            walk_table(self._transitions, self._rewards, self._staying, terminal, setting, arrays, first, last)

        in_blocks(run, len(self.current), THREAD_STEPS)

    def seen(self, positions: np.ndarray, previous: np.ndarray, elapsed: np.ndarray) -> Seen:
        if self._is_index:
            return positions.copy()
        if self._table is not None:
            return self._table.take(positions, axis=0)
        return super().seen(positions, previous, elapsed)


def _tables(space: "StateSpace") -> tuple[object, object]:
    """(successors, rewards) of executed actions, as `stepping.walk_table` takes them."""
    if not space.has_chance:
        return as_index_array(space.successors), np.ascontiguousarray(space.mdp().rewards, np.float64)
    dynamics = space.dynamics
    assert isinstance(dynamics, OutcomeTable)
    return dynamics.for_kernels, dynamics.for_kernels_with(rewards_of_outcomes(space))


def _states_of(simulator: Simulator, state: object, num_envs: int) -> np.ndarray:
    """(N, D) from one state or N of them, checked."""
    rows = np.asarray(state)
    if rows.ndim == 1:
        return np.tile(simulator.checked_state(rows), (num_envs, 1))
    if len(rows) != num_envs:
        raise ParameterError(f"{simulator.env}: {len(rows)} states; expected one, or {num_envs}")
    return np.stack([simulator.checked_state(row) for row in rows])


_MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)


class VectorEnv(SimulatedEnv, gymnasium.vector.VectorEnv):
    """`num_envs` copies of one environment as a Gymnasium vector environment.

    With `space` the built state space is walked as a table, and the rules are not run. `info` has

    - "state" (N, D), or "index" (N,) with `space`,
    - "executed_action" (N,), -1 after a reset,
    - "prob" (N,), if the rules have chance: the probability of the outcome that was drawn, 1 after a reset,
    - "action_mask" (N, A) int8, if some actions are not available in some states: the available ones in the new state,
    - "earned_reward" (N,), if rewards are paid late or with noise: what the rules pay for the step.

    Arrays are fresh at every step.

    Args:
        environment: a name that `pharos.make` knows, or an Environment.
        num_envs: N.
        autoreset_mode: of Gymnasium. NEXT_STEP: the step after the end of an episode resets and ignores its action.
            SAME_STEP: the last step resets too, and the last observation is in info["final_obs"]. DISABLED: the caller
            resets with `options={"reset_mask": mask}`.
        seed: of the first reset, if that is given none.
        max_episode_steps: another name of `time_limit`, as `gymnasium.make_vec` calls it.
        render_mode: None, or "rgb_array": `render()` returns a picture of each environment.
        options: see `Interaction`, and the parameters of the environment, such as `height=12`.
    Raises:
        ParameterError: an option or parameter is wrong.
    """

    metadata: dict[str, Any]

    def __init__(
        self,
        environment: Environment | str,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        seed: int | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ):
        if max_episode_steps is not None:
            options["time_limit"] = None if max_episode_steps == -1 else max_episode_steps
        interaction, parameters = split_options(Interaction, options)
        self.num_envs = whole_number(num_envs, "num_envs", "an integer of at least 1")
        self._mode = _MODES.index(_checked_mode(autoreset_mode))
        self.simulator = simulator = Simulator(environment, interaction, parameters)
        self.metadata = {"autoreset_mode": _MODES[self._mode], "render_modes": ["rgb_array"], "render_fps": 15}
        if render_mode not in (None, "rgb_array"):
            raise ParameterError(f"render_mode is {render_mode!r}; expected None or 'rgb_array'")
        self.render_mode = render_mode
        self.single_observation_space = simulator.context.space
        self.single_action_space = gymnasium.spaces.Discrete(simulator.env.num_actions)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.action_names = simulator.env.actions
        self._seed = seed
        self._rng: np.ndarray | None = None
        n = self.num_envs
        self._previous = np.full(n, NO_ACTION, np.int64)
        self._elapsed = np.zeros(n, np.int64)
        self._ended = np.zeros(n, np.bool_)
        self._frame_stack = FrameStack(simulator, n) if simulator.context.has_more else None
        self._reward_channel = RewardChannel(interaction.chance, n) if simulator.modifies_rewards else None
        self._num_drawn = n if simulator.has_outcomes else 0  # outcomes that are drawn in a step
        space = simulator.state_space
        self._stepper: Stepper = (
            RulesStepper(simulator, n, self._mode) if space is None else TableStepper(simulator, space, n, self._mode)
        )

    @property
    def states(self) -> np.ndarray:
        """(N, D) int64, the current states."""
        return self._stepper.states(self._stepper.current).copy()

    def action_masks(self) -> np.ndarray:
        """(N, A) bool, the actions that are available in the current states."""
        return self.simulator.action_masks(self.states)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The picture for people of each environment, (H, W, 3) uint8, if render_mode is "rgb_array", else None."""
        if self.render_mode is None:
            return None
        if self._rng is None:
            raise gymnasium.error.ResetNeeded(f"{self.environment}: call reset() before render()")
        from pharos.drawing import human

        return tuple(human(self.environment, state.tolist()) for state in self.states)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: environment i is seeded with seed + i, or with seed[i].
            options: {"reset_mask": (N,) bool} resets these environments alone. {"state": (D,) or (N, D)} is where
                they start.
        """
        options = options or {}
        mask = self._checked_mask(options.get("reset_mask"))
        self._stepper.restart(mask, self._seeded(seed), options.get("state"))
        self._previous[mask] = self.simulator.first_previous
        self._elapsed[mask] = 0
        self._ended[mask] = False
        if self._reward_channel is not None:
            self._reward_channel.restart(mask)
        executed = np.full(self.num_envs, NO_ACTION, np.int64)
        info = self._info(executed, np.ones(self._num_drawn))
        return self._observations(mask, mask), info

    def step(self, actions: npt.ArrayLike) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Choose an action (N,) for every environment."""
        if self._rng is None:
            raise gymnasium.error.ResetNeeded(f"{self.environment}: call reset() before step()")
        actions = self._checked_actions(actions)
        if self._mode == DISABLED and self._ended.any():
            raise gymnasium.error.ResetNeeded(
                f"{self.environment}: episodes of environments {np.flatnonzero(self._ended)[:8].tolist()} have ended; "
                f"call reset(options={{'reset_mask': terminated | truncated}}), or choose another autoreset_mode"
            )
        if self.simulator.has_sets and self.simulator.has_chance:
            masks = self.action_masks()
            actions = self.simulator.executed_in_sets(self._rng, actions, self._previous, self._ended, masks)
        n = self.num_envs
        rewards, executed, probabilities = np.empty(n), np.empty(n, np.int64), np.empty(self._num_drawn)
        terminated, truncated = np.empty(n, np.bool_), np.empty(n, np.bool_)
        stepper = self._stepper
        stepper.step(
            EnvironmentBatch(
                self._rng, actions, stepper.current, self._previous, self._elapsed, self._ended,
                rewards, terminated, truncated, executed, stepper.final, stepper.vectors(), probabilities,
            )
        )  # fmt: skip
        info = self._info(executed, probabilities)
        done = terminated | truncated
        if self._reward_channel is not None:
            rewards = self._reward_channel.pay(rewards, executed != NO_ACTION, done)
            info["earned_reward"] = self._reward_channel.earned
        if self._mode == SAME_STEP and done.any():
            self._add_final(info, done)
        begins = done if self._mode == SAME_STEP else executed == NO_ACTION
        return self._observations(np.ones_like(done), begins), rewards, terminated, truncated, info

    def _observations(self, moves: np.ndarray, begins: np.ndarray) -> Seen:
        """Observations of the current states. `moves`, `begins` (N,) bool: after a step, at the start of an episode."""
        if self._frame_stack is None:
            return self._stepper.observations(self._previous, self._elapsed)
        states = self._stepper.states(self._stepper.current)
        self._frame_stack.push(states, moves, begins)
        return self._frame_stack.current(states, self._previous, self._elapsed)

    def _info(self, executed: np.ndarray, probabilities: np.ndarray) -> dict[str, Any]:
        everywhere = np.ones(self.num_envs, np.bool_)
        name = self._stepper.name
        info = {
            name: self._stepper.current.copy(),
            f"_{name}": everywhere,
            "executed_action": executed,
            "_executed_action": everywhere,
        }
        if self.simulator.has_sets:
            info["action_mask"], info["_action_mask"] = self.action_masks().astype(np.int8), everywhere
        if len(probabilities):
            info["prob"], info["_prob"] = probabilities, everywhere
        if self._reward_channel is not None:
            info["earned_reward"], info["_earned_reward"] = np.zeros(self.num_envs), everywhere
        return info

    def _add_final(self, info: dict[str, Any], done: np.ndarray) -> None:
        """Add terminal observations and infos, as Gymnasium's own vector environments do."""
        rows, executed = np.flatnonzero(done), info["executed_action"]
        context, positions = (executed[rows], self._stepper.final_elapsed[rows]), self._stepper.final[rows]
        if self._frame_stack is None:
            last = self._stepper.seen(positions, *context)
        else:
            last = self._frame_stack.terminal(rows, self._stepper.states(positions), *context)
        final = np.full(self.num_envs, None, object)
        for row, observation in zip(rows, _rows_of(last, len(rows)), strict=True):
            final[row] = observation
        name = self._stepper.name
        state = np.zeros_like(self._stepper.final)
        state[rows] = positions
        info["final_obs"], info["_final_obs"] = final, done
        info["final_info"] = {
            name: state,
            f"_{name}": done,
            "executed_action": np.where(done, executed, 0),
            "_executed_action": done,
        }
        info["_final_info"] = done
        info["executed_action"] = np.where(done, NO_ACTION, executed)
        if "prob" in info:
            info["final_info"].update(prob=np.where(done, info["prob"], 0.0), _prob=done)
            info["prob"] = np.where(done, 1.0, info["prob"])

    def _seeded(self, seed: int | Sequence[int | None] | None) -> np.ndarray:
        """Streams of random numbers (N,) uint64. Environments with a seed are seeded anew."""
        n = self.num_envs
        if seed is None and self._rng is not None:
            return self._rng
        seed = self._seed if seed is None else seed
        seed = [None] * n if seed is None else seed
        seeds: list[int | None] = [seed + i for i in range(n)] if isinstance(seed, int | np.integer) else list(seed)
        if len(seeds) != n:
            raise ParameterError(f"seed has {len(seeds)} entries; expected one integer, or {n}")
        if self._rng is None:
            self._rng = np.random.SeedSequence().generate_state(n, np.uint64)
        for streams in (self._reward_channel, self._frame_stack):
            if streams is not None:
                streams.seed(seeds)
        seed_streams(self._rng, seeds)
        return self._rng

    def _checked_mask(self, mask: npt.ArrayLike | None) -> np.ndarray:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ParameterError(
                f"reset_mask has shape {mask.shape} and dtype {mask.dtype}; expected ({self.num_envs},) of bool"
            )
        if self._rng is None and not mask.all():
            raise gymnasium.error.ResetNeeded(f"{self.environment}: reset all environments first")
        return mask

    def _checked_actions(self, actions: npt.ArrayLike) -> np.ndarray:
        indices = np.asarray(actions)
        if indices.shape != (self.num_envs,) or indices.dtype.kind not in "iu":
            raise ParameterError(
                f"{self.environment}: actions have shape {indices.shape} and dtype {indices.dtype}; "
                f"expected ({self.num_envs},) integers"
            )
        indices = np.ascontiguousarray(indices, np.int64)
        i = first_outside(indices, len(self.action_names))
        if i >= 0:
            raise ParameterError(
                f"{self.environment}: action {indices[i]} of environment {i}; "
                f"expected 0 to {len(self.action_names) - 1}"
            )
        return indices


def make_vec(name_or_env: Environment | str, num_envs: int = 1, **options: Any) -> VectorEnv:
    """Return `num_envs` copies of an environment as a Gymnasium vector environment, see `VectorEnv` for the options."""
    return VectorEnv(name_or_env, num_envs, **options)


def _rows_of(batch: Seen, number: int) -> list[Seen]:
    if isinstance(batch, dict):
        return [{name: values[i] for name, values in batch.items()} for i in range(number)]
    return list(batch)


def _checked_mode(mode: AutoresetMode | str) -> AutoresetMode:
    for each in _MODES:
        if mode in (each, each.value, each.name):
            return each
    raise ParameterError(f"autoreset_mode is {mode!r}; expected one of {', '.join(each.name for each in _MODES)}")
