"""Environment + observation + chance -> gymnasium.Env.

`import pharos` registers pharos/SimpleGrid-v0, pharos/FrozenLake-v0, pharos/Freeway-v0 and pharos/Breakout-v0 with Gymnasium:
`gymnasium.make("pharos/Breakout-v0", height=12, observation="simple_image", sticky=0.25)`. No state space needs to be built.
"""

import operator
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from pharos.drawing import Window, human, text_drawing
from pharos.environments import Environment, make, start_distribution
from pharos.errors import ParameterError, RuleError
from pharos.observations import Index, SimpleImage, observe
from pharos.observations.context import NO_ACTION, ObservationInContext
from pharos.rules import stepping_rules

if TYPE_CHECKING:
    from pharos.state_space import StateSpace


@dataclass(frozen=True, kw_only=True)
class Interaction:
    """The options of interaction, which single and vector environments share.

    Attributes:
        observation: a name (`pharos.observations.names()`), a pair (function, Gymnasium space), or an Observation.
        observation_options: of the named observation, such as {"grey": True}.
        sticky: probability that the previously executed action is executed again.
        random: probability that the action is replaced by one uniform over all; with both, the choice is replaced first and
            then may stick: the chance of `random_actions(sticky_actions(mdp, sticky), random)`.
        initial_previous_action: what sticks on the first step. None: nothing, the chosen action is executed (as in Gymnasium's
            StickyAction); the Arcade Learning Environment starts with its action "noop".
        previous_action: whether the agent sees the previously executed action.
        remaining_time: whether the agent sees the share of the time limit that is left.
        time_limit: steps after which an episode is truncated; "default" for that of the class, None for no limit.
        space: the built state space of the environment, or its folder; adds "index" to info and allows observation="index".
    """

    observation: Any = "vector"
    observation_options: Mapping[str, Any] | None = None
    sticky: float = 0.0
    random: float = 0.0
    initial_previous_action: int | None = None
    previous_action: bool = False
    remaining_time: bool = False
    time_limit: int | str | None = "default"
    space: Any = None


class Simulator:
    """An environment made ready for interaction: rules as compiled functions, observation, chance, time limit.

    Attributes:
        env, state_space, context, limit: as the options say; `context` maps states to what the agent gets.
        chance: (chosen, previous, uniform), weights of the executed action; they sum to 1.
        has_chance: whether another than the chosen action may be executed.
        start_states (K, D), start_cumulative (K,): start states and the cumulative sum of their probabilities.
        ranges: (2, D) int64, lowest and highest value of each component.
    """

    def __init__(self, environment: Environment | str, options: Interaction, parameters: Mapping[str, Any]):
        self.env = _environment(environment, parameters)
        self.state_space = _state_space(options.space, self.env)
        self.limit = _time_limit(options.time_limit, self.env)
        observation = observe(
            self.env, options.observation, state_space=self.state_space, **(options.observation_options or {})
        )
        self.context = ObservationInContext(
            observation,
            previous_action=options.previous_action,
            remaining_time=options.remaining_time,
            limit=self.limit,
        )
        self.chance = chance_weights(options.sticky, options.random)
        self.has_chance = self.chance != (1.0, 0.0, 0.0)
        self.first_previous = _first_previous(options.initial_previous_action, self.env)
        states, probabilities = start_distribution(self.env)
        self.start_states = np.array(states, np.int64)
        self.start_cumulative = np.cumsum(probabilities)
        self.start_cumulative[-1] = 1.0
        components = self.env.components
        self.ranges = np.stack([components.low, components.high])
        self.rules = stepping_rules(self.env, self.start_states[0])

    def drawn_start(self, rng: np.random.Generator) -> int:
        """Which of the start states; draws one number where there are several."""
        if len(self.start_states) == 1:
            return 0
        return int(np.searchsorted(self.start_cumulative, rng.random(), side="right"))

    def executed(self, chosen: int, previous: int, u: float) -> int:
        """The executed action, by one uniform number u in [0, 1): chosen, then previous, then uniform."""
        stay, stick, uniform = self.chance
        if u < stay or (u < stay + stick and previous == NO_ACTION):
            return chosen
        if u < stay + stick:
            return previous
        return min(int((u - stay - stick) / uniform * self.env.num_actions), self.env.num_actions - 1)

    def checked_state(self, state: Any) -> np.ndarray:
        """(D,) int64 from what a user gave; ParameterError unless every component is in its range."""
        values = np.asarray(state)
        if values.shape != (len(self.env.components),) or values.dtype.kind not in "iub":
            raise ParameterError(
                f"{self.env}: state {state!r}; expected {len(self.env.components)} integers: "
                f"{', '.join(self.env.components.names[:8])}{' ...' if len(self.env.components) > 8 else ''}"
            )
        values = values.astype(np.int64)
        outside = np.flatnonzero((values < self.ranges[0]) | (values > self.ranges[1]))
        if outside.size:
            i = int(outside[0])
            raise ParameterError(
                f"{self.env}: state has {self.env.components.names[i]} = {values[i]}; "
                f"expected {self.ranges[0, i]} to {self.ranges[1, i]}"
            )
        return values

    def raise_fault(self, state: np.ndarray, action: int, component: int) -> None:
        """RuleError: the rules left the declared range of a component."""
        raise RuleError(
            f"{self.env}: action {self.env.actions[action]!r} in state {tuple(state.tolist())} takes "
            f"{self.env.components.names[component]} out of its range {self.ranges[0, component]} to "
            f"{self.ranges[1, component]}; declare a wider range in variables(), or mend transition()"
        )


class GymEnv(gymnasium.Env):
    """An environment of pharos as a Gymnasium environment.

    Actions are 0 .. A-1, named by `action_names`. `info` has "state" (D,) int64, "executed_action" (-1 after reset), and
    "index" where a state space was given. `reset(options={"state": ...})` starts in any state. Chance draws one number from
    `np_random` a step.

    Args:
        environment: a name that `pharos.make` knows, or an Environment.
        render_mode: None; "ansi", text; "rgb_array", the picture for people, (H, W, 3) uint8; or "human", a window with that picture,
            drawn anew at each step, 15 a second at most (needs `pip install 'pharos[play]'`).
        options: see `Interaction`, and the parameters of the environment, such as `height=12`.
    Raises:
        ParameterError: an option or parameter is wrong. MissingExtra: render_mode is "human" and pygame is not installed.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "ansi"], "render_fps": 15}

    def __init__(self, environment: Environment | str, *, render_mode: str | None = None, **options: Any):
        interaction, parameters = split_options(options)
        self.simulator = simulator = Simulator(environment, interaction, parameters)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ParameterError(
                f"render_mode is {render_mode!r}; expected None or one of {', '.join(self.metadata['render_modes'])}"
            )
        self.render_mode = render_mode
        self._window: Window | None = None
        if render_mode == "human":
            self._window = Window(str(simulator.env), self.metadata["render_fps"])
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
        observation: Any = simulator.context.observation
        is_vector = simulator.context.is_vector and simulator.context.is_plain
        self._spare = simulator.start_states[0].copy()  # room for the next state
        self._blank: np.ndarray = np.zeros(len(simulator.env.components) if is_vector else 0, np.float32)
        self._scale = observation.scale if is_vector else np.zeros(0)
        self._step_and_draw = _step_and_draw(simulator)
        self._is_written = is_vector or self._step_and_draw is not None  # whether a step writes the observation itself
        few = self._is_written and len(simulator.start_states) <= 4096
        self._start_observations = observation(simulator.start_states) if few else None
        if self._step_and_draw is not None:
            self._shades, self._blank = observation.shades, np.zeros(observation.space.shape, np.uint8)
        self._has_chance, self._stays = simulator.has_chance, simulator.chance[0]
        self._is_index = simulator.context.is_plain and isinstance(observation, Index)
        self._successors = simulator.state_space.successors if simulator.state_space is not None else None

    @property
    def environment(self) -> Environment:
        """The environment without chance, time limit and observation."""
        return self.simulator.env

    @property
    def state(self) -> tuple[int, ...]:
        """The current state, a tuple of D integers."""
        return tuple(self._started().tolist())

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; `options={"state": ...}` says where (D integers)."""
        super().reset(seed=seed)
        simulator = self.simulator
        if options is not None and options.get("state") is not None:
            self._state = simulator.checked_state(options["state"])
            self._terminated = simulator.rules.is_terminal_one(self._parameters, self._state)
            observation = None
        else:
            start = simulator.drawn_start(self.np_random)
            self._state = simulator.start_states[start].copy()
            self._terminated = False
            observation = None if self._start_observations is None else self._start_observations[start].copy()
        self._previous = simulator.first_previous
        self._elapsed = 0
        if simulator.state_space is not None:
            self._index = int(simulator.state_space.indices(self._state[None])[0])
        if self._window is not None:
            self.render()
        return self._observation() if observation is None else observation, self._info(self._state)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Choose an action. After a terminal state nothing changes and nothing is paid."""
        chosen = operator.index(action)
        if not 0 <= chosen < self._num_actions:
            raise ParameterError(f"{self.environment}: action {action!r}; expected 0 to {self._num_actions - 1}")
        state = self._state
        if state is None or self._terminated:
            return self._step_after_the_end()
        if self._has_chance and (u := self.np_random.random()) >= self._stays:
            chosen = self.simulator.executed(chosen, self._previous, u)
        following = self._spare
        observation: Any = self._blank.copy()
        if self._step_and_draw is not None:
            reward, code = self._step_and_draw(
                self._parameters, self._ranges, state, chosen, following, self._shades, observation
            )
        else:
            reward, code = self._step_one(
                self._parameters, self._ranges, self._scale, state, chosen, following, observation
            )
        if code:
            if code > 1:
                self.simulator.raise_fault(state, chosen, code - 2)
            self._terminated = True
        self._state, self._spare = following, state
        self._previous = chosen
        self._elapsed += 1
        info = {"state": following.copy(), "executed_action": chosen}
        if self._successors is not None:
            info["index"] = self._index = int(self._successors[self._index, chosen])
        if not self._is_written:
            observation = self._observation()
        if self._window is not None:
            self.render()
        return observation, reward, self._terminated, self._elapsed >= self._limit, info

    def _step_after_the_end(self) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        state = self._started()
        self._elapsed += 1
        info = self._info(state)
        return self._observation(), 0.0, True, self._elapsed >= self._limit, info

    def render(self) -> Any:
        """The current state in the render mode: text, a picture, or None where there is a window."""
        if self.render_mode is None:
            return None
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
        if self._successors is not None:
            info["index"] = self._index
        return info

    def _started(self) -> np.ndarray:
        if self._state is None:
            raise gymnasium.error.ResetNeeded(f"{self.environment}: call reset() before step() or render()")
        return self._state

    def _observation(self) -> Any:
        if self._is_index:
            return np.int64(self._index)
        return self.simulator.context.one(self._started(), self._previous, self._elapsed)


def _step_and_draw(simulator: Simulator) -> Any:
    """The compiled step that draws as well, for simple images with a pixel for each cell; else None."""
    observation = simulator.context.observation
    if not simulator.context.is_plain or not isinstance(observation, SimpleImage) or not observation.is_flat:
        return None
    kernel = simulator.rules.step_and_draw_one
    if kernel is None:
        return None
    state, image = simulator.start_states[0], observation.one(simulator.start_states[0])
    try:
        kernel(simulator.rules.parameters, simulator.ranges, state, 0, state.copy(), observation.shades, image)
    except Exception:  # draw() does not compile: the observation says so, when it is asked for
        return None
    return kernel


# Options -----------------------------------------------------------------------------------------------------------------


def chance_weights(sticky: float, random: float) -> tuple[float, float, float]:
    """(chosen, previous, uniform), the chance of `random_actions(sticky_actions(mdp, sticky), random)`.

    Raises:
        ParameterError: a probability is not in [0, 1].
    """
    for name, p in (("sticky", sticky), ("random", random)):
        if isinstance(p, bool) or not isinstance(p, int | float) or not 0 <= p <= 1:
            raise ParameterError(f"{name} is {p!r}; expected a probability in [0, 1]")
    return (1 - random) * (1 - sticky), float(sticky), random * (1 - sticky)


def split_options(options: Mapping[str, Any]) -> tuple[Interaction, dict[str, Any]]:
    """The options of interaction, and the rest: parameters of the environment."""
    known = Interaction.__dataclass_fields__
    interaction = Interaction(**{name: value for name, value in options.items() if name in known})
    return interaction, {name: value for name, value in options.items() if name not in known}


def _environment(environment: Environment | str, parameters: Mapping[str, Any]) -> Environment:
    if isinstance(environment, str):
        env = make(environment, **parameters)
    elif isinstance(environment, Environment):
        if parameters:
            raise ParameterError(
                f"{environment}: unknown options {', '.join(parameters)}; its parameters are set already"
            )
        env = environment
    else:
        raise ParameterError(f"environment is {environment!r}; expected a name or a pharos Environment")
    clashes = sorted(set(env.parameters) & set(Interaction.__dataclass_fields__))
    if clashes:
        raise ParameterError(
            f"{env}: parameter {clashes[0]!r} is also an option of the Gymnasium environment; rename it"
        )
    return env


def _state_space(space: Any, env: Environment) -> "StateSpace | None":
    if space is None:
        return None
    from pharos.state_space import StateSpace, load

    found = space if isinstance(space, StateSpace) else load(space)
    if found.environment != env:
        raise ParameterError(f"space holds the states of {found.environment}; expected those of {env}")
    return found


def _time_limit(limit: int | str | None, env: Environment) -> int | None:
    chosen = env.max_episode_steps if limit == "default" else limit
    if chosen is None:
        return None
    if isinstance(chosen, bool) or not isinstance(chosen, int | np.integer) or chosen < 1:
        raise ParameterError(f"time_limit is {limit!r}; expected a number of steps of at least 1, None or 'default'")
    return int(chosen)


def _first_previous(action: int | None, env: Environment) -> int:
    if action is None:
        return NO_ACTION
    if isinstance(action, bool) or not isinstance(action, int | np.integer) or not 0 <= action < env.num_actions:
        raise ParameterError(
            f"initial_previous_action is {action!r}; expected None or an action from 0 to {env.num_actions - 1}"
        )
    return int(action)
