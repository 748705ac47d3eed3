"""Environment + observation + chance -> gymnasium.Env.

`import pharos` registers every built-in class with Gymnasium, such as pharos/FrozenLake-v0 and pharos/Breakout-v0:
`gymnasium.make("pharos/Breakout-v0", height=12, observation="simple_image", sticky=0.25)`. No state space
needs to be built.
"""

import operator
from collections.abc import Callable
from dataclasses import dataclass
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


@dataclass
class Episode:
    """The episode that is played.

    Attributes:
        spare: (D,) room for the next state. state: (D,), None before the first episode. index: of the state, if a state
            space was given.
        previous: the last executed action. elapsed: steps so far. terminated: whether the state is terminal.
    """

    spare: np.ndarray
    state: np.ndarray | None = None
    index: int = -1
    previous: int = NO_ACTION
    elapsed: int = 0
    terminated: bool = False


class CompiledStep:
    """The compiled step of the rules, which writes the observation, too, if that is a vector or a simple image.

    Attributes:
        writes: whether it does. starts: then the observations of the start states, if these are few.
        step_one, draws: see `rules.stepping`. draws: None unless a simple image is written.
    """

    def __init__(self, simulator: Simulator):
        self._simulator, context = simulator, simulator.context
        self._parameters, self._ranges = simulator.rules.parameters, simulator.ranges
        self._compile()
        vector, observation = context.vector if context.is_plain else None, context.observation
        self.writes = vector is not None or self.draws is not None
        few = self.writes and len(simulator.start_states) <= 4096
        self.starts: np.ndarray | None = observation(simulator.start_states) if few else None
        self._blank: np.ndarray = np.zeros(0 if vector is None else len(simulator.env.components), np.float32)
        self._numbers = np.zeros(0) if vector is None else vector.scale  # or shades of an image
        if self.draws is not None:
            self._blank, self._numbers = np.zeros(observation.space.shape or (), np.uint8), observation.shades

    def step(self, state: np.ndarray, branch: int, next_state: np.ndarray) -> tuple[float, int, np.ndarray]:
        """(reward, code, observation): code 1 is a terminal state, above 1 a fault. Writes `next_state`."""
        written = self._blank.copy()
        if self.draws is None:
            reward, code = self.step_one(
                self._parameters, self._ranges, self._numbers, state, branch, next_state, written
            )
        else:
            reward, code = self.draws(self._parameters, self._ranges, state, branch, next_state, self._numbers, written)
        return reward, code, written

    def _compile(self) -> None:
        self.step_one, self.draws = self._simulator.rules.step_one, _step_and_draw(self._simulator)

    def __getstate__(self) -> dict[str, Any]:
        """State without compiled functions: the process of the copy takes them from the cache, without compiling."""
        return {**self.__dict__, "step_one": None, "draws": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._compile()


class StepChance:
    """Draws of a step: the executed action, whether it has an effect, and an outcome of the rules.

    Attributes:
        is_none: whether nothing is drawn.
        stream: of random numbers, if the rules have chance. None: of the environment.
    """

    def __init__(self, simulator: Simulator):
        self._simulator, self._parameters = simulator, simulator.rules.parameters
        self._has_chance, self._has_one_branch = simulator.has_chance, not (simulator.lazy or simulator.has_outcomes)
        self._stays, self._lazy, self._has_sets = simulator.chance[0], simulator.lazy, simulator.has_sets
        self._num_outcomes, self.outcome_one = int(simulator.env.outcomes), simulator.rules.outcome_one
        self.is_none = self._has_one_branch and not self._has_chance
        self.stream: Stream | None = None

    def drawn(
        self, numbers: np.random.Generator | Stream, state: np.ndarray, action: int, previous: int
    ) -> tuple[int, int, float]:
        """(executed action, branch of the rules, probability of the outcome). A negative branch is a lazy step."""
        executed = action
        if self._has_chance:
            u, mask = numbers.random(), self._simulator.action_masks(state[None])[0] if self._has_sets else None
            if u >= self._stays or mask is not None:
                executed = self._simulator.executed(action, previous, u, mask)
        if self._has_one_branch:
            return executed, executed, 1.0
        if self._lazy and numbers.random() < self._lazy:
            return executed, -1 - executed, self._lazy
        if self.stream is None:
            return executed, executed, 1.0
        outcome, probability = self.outcome_one(self._parameters, state, executed, numbers.random())
        return executed, executed * self._num_outcomes + outcome, probability * (1.0 - self._lazy)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "outcome_one": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.outcome_one = self._simulator.rules.outcome_one


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
        self._episode = Episode(simulator.start_states[0].copy())
        self._compiled, self._chance = CompiledStep(simulator), StepChance(simulator)
        self._num_actions = simulator.env.num_actions
        self._limit = simulator.limit if simulator.limit is not None else 1 << 62
        self._is_index = simulator.context.is_plain and isinstance(simulator.context.observation, Index)
        self._frame_stack = FrameStack(simulator, 1) if simulator.context.has_more else None
        self._last: Seen | None = None  # the observation, if it is more than a function of the state
        self._reward_channel = RewardChannel(interaction.chance, 1) if simulator.modifies_rewards else None
        space = simulator.state_space
        self._successors = None if space is None or simulator.has_outcomes else space.successors

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
        simulator, episode, chance = self.simulator, self._episode, self._chance
        if self._reward_channel is not None:
            self._reward_channel.seed([seed])
            self._reward_channel.restart(_ONE)
        if self._frame_stack is not None:
            self._frame_stack.seed([seed])
        if simulator.has_outcomes and (seed is not None or chance.stream is None):
            chance.stream = Stream(int(self.np_random.integers(1 << 63)) if seed is None else seed)
        if options is not None and options.get("state") is not None:
            state = simulator.checked_state(options["state"])
            episode.terminated = simulator.rules.is_terminal_one(simulator.rules.parameters, state)
            observation = None
        else:
            start = simulator.drawn_start(chance.stream or self.np_random)
            state, episode.terminated = simulator.start_states[start].copy(), False
            observation = None if self._compiled.starts is None else self._compiled.starts[start].copy()
        episode.state, episode.previous, episode.elapsed = state, simulator.first_previous, 0
        if simulator.state_space is not None:
            episode.index = self._index_of(state)
        if self._window is not None:
            self.render()
        if observation is None or self._frame_stack is not None:
            observation = self._observation(begins=True)
        return observation, self._info(state)

    def step(self, action: SupportsIndex) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Choose an action. After a terminal state nothing changes and the reward is 0."""
        executed, simulator, episode = operator.index(action), self.simulator, self._episode
        if not 0 <= executed < self._num_actions:
            raise ParameterError(f"{self.environment}: action {action!r}; expected 0 to {self._num_actions - 1}")
        state = episode.state
        if state is None or episode.terminated:
            return self._step_after_the_end()
        branch, probability = executed, 1.0
        if not self._chance.is_none:
            numbers = self._chance.stream or self.np_random
            executed, branch, probability = self._chance.drawn(numbers, state, executed, episode.previous)
        next_state = episode.spare
        reward, code, written = self._compiled.step(state, branch, next_state)
        if code:
            if code > 1:
                simulator.raise_fault(state, executed, code - 2)
            episode.terminated = True
        episode.state, episode.spare, episode.previous = next_state, state, executed
        episode.elapsed += 1
        # Infos, and delay and noise of the reward
        info: dict[str, Any] = {"state": next_state.copy(), "executed_action": executed}
        if simulator.has_sets:
            info["action_mask"] = self.action_masks().astype(np.int8)
        if self._successors is not None:
            if branch >= 0:
                episode.index = int(self._successors[episode.index, executed])
            info["index"] = episode.index
        if simulator.has_outcomes:
            info["prob"] = probability
            if simulator.state_space is not None:
                info["index"] = episode.index = self._index_of(next_state)
        observation = written if self._compiled.writes else self._observation()
        if self._window is not None:
            self.render()
        is_truncated = episode.elapsed >= self._limit
        if self._reward_channel is not None:
            info["earned_reward"] = reward
            ended = np.array([episode.terminated or is_truncated])
            reward = float(self._reward_channel.pay(np.array([reward]), _ONE, ended)[0])
        return observation, reward, episode.terminated, is_truncated, info

    def _step_after_the_end(self) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        state = self._started()
        self._episode.elapsed += 1
        info = self._info(state)
        observation = self._observation() if self._last is None else self._last
        return observation, 0.0, True, self._episode.elapsed >= self._limit, info

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
        if self.simulator.has_sets:
            info["action_mask"] = self.action_masks().astype(np.int8)
        if self.simulator.state_space is not None:
            info["index"] = self._episode.index
        if self.simulator.has_outcomes:
            info["prob"] = 1.0
        if self._reward_channel is not None:
            info["earned_reward"] = 0.0
        return info

    def _index_of(self, state: np.ndarray) -> int:
        assert self.simulator.state_space is not None
        return int(self.simulator.state_space.indices(state[None])[0])

    def _started(self) -> np.ndarray:
        if self._episode.state is None:
            raise gymnasium.error.ResetNeeded(f"{self.environment}: call reset() before step() or render()")
        return self._episode.state

    def _observation(self, *, begins: bool = False) -> Seen | np.integer:
        if self._is_index:
            return np.int64(self._episode.index)
        previous, elapsed = self._episode.previous, self._episode.elapsed
        if self._frame_stack is not None:
            states, context = self._started()[None], (np.array([previous]), np.array([elapsed]))
            self._frame_stack.push(states, _ONE, np.array([begins]))
            batch = self._frame_stack.current(states, *context)
            self._last = {k: v[0] for k, v in batch.items()} if isinstance(batch, dict) else batch[0]
            return self._last
        return self.simulator.context.one(self._started(), previous, elapsed)


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
