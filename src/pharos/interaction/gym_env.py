"""Environment + observation + chance -> gymnasium.Env.

`import pharos` registers every built-in class with Gymnasium, such as pharos/FrozenLake-v0 and pharos/Breakout-v0:
`gymnasium.make("pharos/Breakout-v0", height=12, observation="simple_image", sticky=0.25)`. No state space
needs to be built.
"""

import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, SupportsIndex

import gymnasium
import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError
from pharos.interaction.simulator import FrameStack, Interaction, RewardChannel, SimulatedEnv, Simulator, Stream
from pharos.observations import NO_ACTION, Index, Seen
from pharos.system.records import split_options

if TYPE_CHECKING:
    from pharos.drawing import Window


_ONE = np.ones(1, np.bool_)


class GymEnv(SimulatedEnv, gymnasium.Env):
    """An environment of pharos as a Gymnasium environment.

    Actions are 0 .. A-1, named by `action_names`. `info` has "state" (D,) int64, "executed_action" (-1 after reset),
    and "index" if a state space was given. `reset(options={"state": ...})` starts in any state. Sticky and random
    actions draw one number from `np_random` a step, then lazy ones another.

    If the rules have chance, an outcome of the executed action is drawn and its reward paid. `info["prob"]` is the
    probability of that outcome, 1.0 after reset, as in Gymnasium's toy text. All numbers, for the start, for sticky and
    random actions, for lazy ones and, after these, for the outcome, then come from the stream that environment 0 of a
    `VectorEnv` has with the same seed: one seed, the same episodes in both. Without a seed, `np_random` seeds that
    stream. If rewards are paid late or with noise, `info["earned_reward"]` is what the rules pay for the step.

    Args:
        environment: a name that `pharos.make` knows, or an Environment.
        render_mode: None, "ansi" (text), "rgb_array" (the picture for people, (H, W, 3) uint8), or "human", a window
            with that picture, drawn anew at each step, 15 a second at most (needs `pip install 'pharos-rl[play]'`).
        options: see `Interaction`, and the parameters of the environment, such as `height=12`.
    Raises:
        ParameterError: an option or parameter is wrong. MissingExtra: render_mode is "human" and pygame is not
            installed.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "ansi"], "render_fps": 15}

    def __init__(self, environment: Environment | str, *, render_mode: str | None = None, **options: Any):
        interaction, parameters = split_options(Interaction, options)
        self.simulator = simulator = Simulator(environment, interaction, parameters)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ParameterError(
                f"render_mode is {render_mode!r}; expected None or one of {', '.join(self.metadata['render_modes'])}"
            )
        self.render_mode = render_mode
        self._window = _window(simulator, self.metadata["render_fps"]) if render_mode == "human" else None
        self.observation_space = simulator.context.space
        self.action_space = gymnasium.spaces.Discrete(simulator.env.num_actions)
        self.action_names = simulator.env.actions
        self._state: np.ndarray | None = None
        self._index = -1
        self._previous = NO_ACTION
        self._elapsed = 0
        self._terminated = False
        # What a step needs, without a chain of attributes
        self._step_one, self._parameters = simulator.rules.step_one, simulator.rules.parameters
        self._ranges, self._num_actions = simulator.ranges, simulator.env.num_actions
        self._limit = simulator.limit if simulator.limit is not None else 1 << 62
        observation = simulator.context.observation
        vector = simulator.context.vector if simulator.context.is_plain else None
        is_vector = vector is not None
        self._spare = simulator.start_states[0].copy()  # room for the next state
        self._blank: np.ndarray = np.zeros(len(simulator.env.components) if is_vector else 0, np.float32)
        self._scale = np.zeros(0) if vector is None else vector.scale
        self._step_and_draw = _step_and_draw(simulator)
        self._is_written = is_vector or self._step_and_draw is not None  # whether a step writes the observation itself
        few = self._is_written and len(simulator.start_states) <= 4096
        self._start_observations = observation(simulator.start_states) if few else None
        if self._step_and_draw is not None:
            self._shades, self._blank = observation.shades, np.zeros(observation.space.shape or (), np.uint8)
        self._has_chance, self._stays, self._lazy = simulator.has_chance, simulator.chance[0], simulator.lazy
        self._has_outcomes, self._num_outcomes = simulator.has_outcomes, int(simulator.env.outcomes)
        self._outcome_one, self._has_sets = simulator.rules.outcome_one, simulator.has_sets
        self._stream: Stream | None = None  # of random numbers, if the rules have chance
        self._is_index = simulator.context.is_plain and isinstance(observation, Index)
        self._frame_stack = FrameStack(simulator, 1) if simulator.context.has_more else None
        self._last: Seen | None = None  # the observation, if it is more than a function of the state
        self._reward_channel = RewardChannel(interaction.chance, 1) if simulator.modifies_rewards else None
        space = simulator.state_space
        self._successors = None if space is None or self._has_outcomes else space.successors

    def __getstate__(self) -> dict[str, Any]:
        """State without compiled functions: the process of the copy takes them from the cache, without compiling."""
        return {**self.__dict__, "_step_one": None, "_outcome_one": None, "_step_and_draw": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        rules = self.simulator.rules
        self._step_one, self._outcome_one = rules.step_one, rules.outcome_one
        self._step_and_draw = _step_and_draw(self.simulator)

    @property
    def state(self) -> tuple[int, ...]:
        """The current state, a tuple of D integers."""
        return tuple(self._started().tolist())

    def action_masks(self) -> np.ndarray:
        """(A,) bool, the actions that are available in the current state, as sb3-contrib asks for them."""
        return np.asarray(self.simulator.action_masks(self._started()[None])[0])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode. `options={"state": ...}` is the start state (D integers)."""
        super().reset(seed=seed)
        simulator = self.simulator
        if self._reward_channel is not None:
            self._reward_channel.seed([seed])
            self._reward_channel.restart(_ONE)
        if self._frame_stack is not None:
            self._frame_stack.seed([seed])
        if self._has_outcomes and (seed is not None or self._stream is None):
            self._stream = Stream(int(self.np_random.integers(1 << 63)) if seed is None else seed)
        if options is not None and options.get("state") is not None:
            self._state = simulator.checked_state(options["state"])
            self._terminated = simulator.rules.is_terminal_one(self._parameters, self._state)
            observation = None
        else:
            start = simulator.drawn_start(self._stream or self.np_random)
            self._state = simulator.start_states[start].copy()
            self._terminated = False
            observation = None if self._start_observations is None else self._start_observations[start].copy()
        self._previous = simulator.first_previous
        self._elapsed = 0
        if simulator.state_space is not None:
            self._index = self._index_of(self._state)
        if self._window is not None:
            self.render()
        if observation is None or self._frame_stack is not None:
            observation = self._observation(begins=True)
        return observation, self._info(self._state)

    def step(self, action: SupportsIndex) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Choose an action. After a terminal state nothing changes and the reward is 0."""
        executed = operator.index(action)
        if not 0 <= executed < self._num_actions:
            raise ParameterError(f"{self.environment}: action {action!r}; expected 0 to {self._num_actions - 1}")
        state = self._state
        if state is None or self._terminated:
            return self._step_after_the_end()
        # Executed action: sticky and random actions
        if self._has_chance:
            u, mask = (self._stream or self.np_random).random(), self.action_masks() if self._has_sets else None
            if u >= self._stays or mask is not None:
                executed = self.simulator.executed(executed, self._previous, u, mask)
        # Outcome of the executed action; a negative branch is a lazy step
        branch, probability = executed, 1.0
        if self._lazy and (self._stream or self.np_random).random() < self._lazy:
            branch, probability = -1 - executed, self._lazy
        elif self._stream is not None:
            outcome, probability = self._outcome_one(self._parameters, state, executed, self._stream.random())
            branch, probability = executed * self._num_outcomes + outcome, probability * (1.0 - self._lazy)
        # Next state, reward and observation in one compiled call; code 1 is a terminal state, above 1 a fault
        next_state = self._spare
        written = self._blank.copy()
        if self._step_and_draw is not None:
            reward, code = self._step_and_draw(
                self._parameters, self._ranges, state, branch, next_state, self._shades, written
            )
        else:
            reward, code = self._step_one(
                self._parameters, self._ranges, self._scale, state, branch, next_state, written
            )
        if code:
            if code > 1:
                self.simulator.raise_fault(state, executed, code - 2)
            self._terminated = True
        self._state, self._spare = next_state, state
        self._previous = executed
        self._elapsed += 1
        # Infos, and delay and noise of the reward
        info: dict[str, Any] = {"state": next_state.copy(), "executed_action": executed}
        if self._has_sets:
            info["action_mask"] = self.action_masks().astype(np.int8)
        if self._successors is not None:
            if branch >= 0:
                self._index = int(self._successors[self._index, executed])
            info["index"] = self._index
        if self._has_outcomes:
            info["prob"] = probability
            if self.simulator.state_space is not None:
                info["index"] = self._index = self._index_of(next_state)
        observation = written if self._is_written else self._observation()
        if self._window is not None:
            self.render()
        is_truncated = self._elapsed >= self._limit
        if self._reward_channel is not None:
            info["earned_reward"] = reward
            ended = np.array([self._terminated or is_truncated])
            reward = float(self._reward_channel.pay(np.array([reward]), _ONE, ended)[0])
        return observation, reward, self._terminated, is_truncated, info

    def _step_after_the_end(self) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        state = self._started()
        self._elapsed += 1
        info = self._info(state)
        observation = self._observation() if self._last is None else self._last
        return observation, 0.0, True, self._elapsed >= self._limit, info

    def render(self) -> str | np.ndarray | None:
        """The current state in the render mode: text, a picture, or None if there is a window."""
        if self.render_mode is None:
            return None
        from pharos.drawing import human, text_drawing  # which an environment without pictures does not load

        if self.render_mode == "ansi":
            return text_drawing(self.environment, self.state)
        picture = human(self.environment, self.state)
        if self._window is None:
            return picture
        self._window.show(picture)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _info(self, state: np.ndarray) -> dict[str, Any]:
        info: dict[str, Any] = {"state": state.copy(), "executed_action": NO_ACTION}
        if self._has_sets:
            info["action_mask"] = self.action_masks().astype(np.int8)
        if self.simulator.state_space is not None:
            info["index"] = self._index
        if self._has_outcomes:
            info["prob"] = 1.0
        if self._reward_channel is not None:
            info["earned_reward"] = 0.0
        return info

    def _index_of(self, state: np.ndarray) -> int:
        assert self.simulator.state_space is not None
        return int(self.simulator.state_space.indices(state[None])[0])

    def _started(self) -> np.ndarray:
        if self._state is None:
            raise gymnasium.error.ResetNeeded(f"{self.environment}: call reset() before step() or render()")
        return self._state

    def _observation(self, *, begins: bool = False) -> Seen | np.integer:
        if self._is_index:
            return np.int64(self._index)
        if self._frame_stack is not None:
            states, context = self._started()[None], (np.array([self._previous]), np.array([self._elapsed]))
            self._frame_stack.push(states, _ONE, np.array([begins]))
            batch = self._frame_stack.current(states, *context)
            self._last = {k: v[0] for k, v in batch.items()} if isinstance(batch, dict) else batch[0]
            return self._last
        return self.simulator.context.one(self._started(), self._previous, self._elapsed)


def _window(simulator: Simulator, fps: int) -> "Window":
    from pharos.drawing import Window

    return Window(str(simulator.env), fps)


def _step_and_draw(simulator: Simulator) -> Callable[..., tuple[float, int]] | None:
    """The compiled step that draws as well, for simple images with a pixel for each cell, else None."""
    observation = simulator.context.observation
    if not simulator.context.is_plain or not observation.is_flat:
        return None
    state, image = simulator.start_states[0], observation.one(simulator.start_states[0])
    return simulator.rules.step_and_draw_one(simulator.ranges, state, 0, state.copy(), observation.shades, image)
