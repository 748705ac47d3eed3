"""An environment prepared for interaction: the part that single and vector environments share.

Their options (`Interaction`), rules and chance (`Simulator`), observations beyond the current state (`FrameStack`: the
frames before, irrelevant coins), and how rewards are paid (`RewardChannel`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from pharos.environments import Environment, make, start_distribution
from pharos.errors import ParameterError, RuleError, StateSpaceTooLarge
from pharos.kernels import stepping
from pharos.kernels.stepping import Setting
from pharos.mdp import Chance, ChanceSetting, whole_number
from pharos.observations import NO_ACTION, ObservationInContext, Seen, observe
from pharos.rules import rules_of
from pharos.system.records import flat, option_names

if TYPE_CHECKING:
    from pharos.state_space import StateSpace

Rows = slice | np.ndarray  # which environments of a batch

# States that are built on the way if the observation "index" is asked for without `space`.
LARGEST_INDEX = 20_000_000


@flat
@dataclass(frozen=True, kw_only=True)
class Interaction:
    """The options of interaction, which single and vector environments share, chance by its own names, `sticky=0.1`.

    Attributes:
        observation: a name (`pharos.observations.names()`), a pair (function, Gymnasium space), or an Observation.
        observation_options: of the named observation, such as {"grey": True}.
        chance: of acting, and in how rewards are paid, see `pharos.training.ChanceSetting` and `RewardChannel`.
        initial_previous_action: what sticks on the first step. None: nothing, the chosen action is executed (as in
            Gymnasium's StickyAction). The Arcade Learning Environment starts with its action "noop".
        previous_action: whether the agent sees the previously executed action.
        remaining_time: whether the agent sees the share of the time limit that is left.
        time_limit: steps after which an episode is truncated: "default" for the limit of the class, None for no limit.
        space: the built state space of the environment, or its folder. It adds "index" to info. The observation "index"
            needs it: if none is given, it is taken from the user's cache, or built.
    """

    observation: object = "vector"
    observation_options: Mapping[str, Any] | None = None
    chance: ChanceSetting = ChanceSetting()
    initial_previous_action: int | None = None
    previous_action: bool = False
    remaining_time: bool = False
    time_limit: int | str | None = "default"
    space: Any = None


class Simulator:
    """An environment prepared for interaction: rules as compiled functions, observation, chance, time limit.

    Attributes:
        env, state_space, context, limit: as the options say. `context` maps states to what the agent gets.
        chance: (chosen, previous, uniform), weights of the executed action. They sum to 1.
        first_chosen: the weight of the chosen action if there is no previous one. The rest is uniform.
        lazy: the probability that the executed action has no effect.
        modifies_rewards: whether rewards are paid late or with noise.
        has_chance: whether another than the chosen action may be executed.
        has_sets: whether some actions may not be available in some states.
        has_outcomes: whether the rules have chance, so that an outcome is drawn after the action.
        start_states (K, D), start_cumulative (K,): start states and the cumulative sum of their probabilities.
        ranges: (2, D) int64, lowest and highest value of each component.
    """

    def __init__(self, environment: Environment | str, options: Interaction, parameters: Mapping[str, Any]):
        self.env = _environment(environment, parameters)
        self.state_space = _state_space(options, self.env)
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
        chance = Chance.of(options.chance.sticky, options.chance.random)
        self.chance, self.first_chosen = chance.triple, float(chance.first_chosen)
        self.lazy = float(options.chance.lazy)
        self._weights = (*self.chance, self.first_chosen, self.lazy)
        self._weights_of_kernels = self._weights
        self.modifies_rewards = options.chance.modifies_rewards
        self.has_chance = self.chance != (1.0, 0.0, 0.0)
        self.has_outcomes = self.env.has_chance
        self.has_sets = self.env.has_sets
        if self.has_sets and self.has_chance:  # see `executed_in_sets`
            self._weights_of_kernels = (1.0, 0.0, 0.0, 1.0, self.lazy)
        self.first_previous = _first_previous(options.initial_previous_action, self.env)
        states, probabilities = start_distribution(self.env)
        self.start_states = np.array(states, np.int64)
        self.start_cumulative = np.cumsum(probabilities)
        self.start_cumulative[-1] = 1.0
        components = self.env.components
        self.ranges = np.stack([components.low, components.high])
        rules = rules_of(self.env)
        self.rules, self._available = rules.stepping, rules.available

    def action_masks(self, states: np.ndarray) -> np.ndarray:
        """(N, A) bool, the actions that are available in states (N, D)."""
        sets = self._available(states)
        return np.ones((len(states), self.env.num_actions), np.bool_) if sets is None else sets

    def setting(self, mode: int, ranges: np.ndarray, scale: np.ndarray, starts: np.ndarray) -> Setting:
        """Arguments of the kernels of many environments. `starts` are states, or their indices in a state space."""
        limit = self.limit if self.limit is not None else 1 << 62
        return Setting(
            ranges, scale, self._weights_of_kernels, limit, mode, self.first_previous, starts, self.start_cumulative
        )

    def drawn_start(self, rng: "np.random.Generator | Stream") -> int:
        """Index of a drawn start state. Draws a random number only if there are several."""
        if len(self.start_states) == 1:
            return 0
        return int(np.searchsorted(self.start_cumulative, rng.random(), side="right"))

    def executed(self, action: int, previous: int, u: float, mask: np.ndarray | None = None) -> int:
        """The executed action, by one uniform number u in [0, 1): `action`, then `previous`, then a uniform one.

        mask (A,) bool: the available actions. None: all are.
        """
        if mask is None:
            return stepping.executed_by_number.py_func(action, previous, self._weights, self.env.num_actions, u)
        return stepping.executed_of_set.py_func(action, previous, self._weights, mask, u)

    def executed_in_sets(
        self, rng: np.ndarray, actions: np.ndarray, previous: np.ndarray, ended: np.ndarray, sets: np.ndarray
    ) -> np.ndarray:
        """(N,) executed actions of environments in states with sets (N, A) bool, whose kernels then draw none."""
        executed = np.empty_like(actions)
        stepping.execute_in_sets(rng, actions, previous, ended, self._weights, sets, executed)
        return executed

    def checked_state(self, state: object) -> np.ndarray:
        """(D,) int64 from a user's state. ParameterError unless every component is in its range."""
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


class Stream:
    """Random numbers of one environment, drawn as a vector environment draws them for each of its environments.

    Attributes:
        words: (1,) uint64, its state.
    """

    def __init__(self, seed: int):
        self.words = stream_of(seed)

    def random(self) -> float:
        """The next number, uniform in [0, 1)."""
        return stepping.next_number(self.words)


def stream_of(seed: int | None, *purpose: int) -> np.ndarray:
    """(1,) uint64, the stream of random numbers of an environment that is seeded with `seed`, another one for each
    purpose: none for steps, 1 for the noise of rewards, 2 for coins of observations.
    """
    return np.random.SeedSequence(seed, spawn_key=purpose).generate_state(1, np.uint64)


def seed_streams(streams: np.ndarray, seeds: Sequence[int | None], *purpose: int) -> None:
    """Seed the streams (N,) of environments for a purpose. None leaves one as it is."""
    for i, seed in enumerate(seeds):
        if seed is not None:
            streams[i] = stream_of(seed, *purpose)[0]


class SimulatedEnv:
    """Base of single and vector environments: properties of their `simulator`."""

    simulator: Simulator
    action_names: tuple[str, ...]
    _spec: EnvSpec | None = None

    @property
    def environment(self) -> Environment:
        """The environment without chance, time limit and observation."""
        return self.simulator.env

    def get_action_meanings(self) -> list[str]:
        """The names of the actions, as the Arcade Learning Environment gives them."""
        return list(self.action_names)

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's specification, with the limit of this instance. None unless it was made by an id.

        The registry says that there is no limit, because it depends on the arguments of `gymnasium.make`: with a number
        there, Gymnasium would wrap the environment in a second TimeLimit that knows nothing of `height=20` or
        `time_limit=None`.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = None if spec is None else replace(spec, max_episode_steps=self.simulator.limit)


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
        from pharos.mdp import TabularMDP  # which loads its kernels

        advice = ": pharos.importers.environment(mdp) makes one" if isinstance(environment, TabularMDP) else ""
        raise ParameterError(f"environment is {environment!r}; expected a name or a pharos Environment{advice}")
    clashes = sorted(set(env.parameters) & option_names(Interaction))
    if clashes:
        raise ParameterError(
            f"{env}: parameter {clashes[0]!r} is also an option of the Gymnasium environment; rename it"
        )
    return env


def _state_space(options: Interaction, env: Environment) -> "StateSpace | None":
    if options.space is None:
        return _indexed(env) if options.observation == "index" else None
    from pharos.state_space import StateSpace, load  # which most environments do without

    space = options.space if isinstance(options.space, StateSpace) else load(options.space)
    if space.environment != env:
        raise ParameterError(f"space holds the states of {space.environment}; expected those of {env}")
    return space


def _indexed(env: Environment) -> "StateSpace":
    """The state space of `env`, from the user's cache or built, for the observation "index"."""
    from pharos.state_space import build

    try:
        return build(env, max_states=LARGEST_INDEX)
    except StateSpaceTooLarge as error:
        raise ParameterError(
            f"{env}: observation 'index' without space= builds at most {LARGEST_INDEX:,} states; "
            f"build it yourself and give space=pharos.build(env), or its folder"
        ) from error


def _time_limit(limit: int | str | None, env: Environment) -> int | None:
    steps = env.max_episode_steps if limit == "default" else limit
    if steps is None:
        return None
    return whole_number(steps, "time_limit", "a number of steps of at least 1, None or 'default'")


def _first_previous(action: int | None, env: Environment) -> int:
    if action is None:
        return NO_ACTION
    last = env.num_actions - 1
    return whole_number(action, "initial_previous_action", f"None or an action from 0 to {last}", 0, last)


class FrameStack:
    """The observations of N environments whose observation has `frames` or is in part `irrelevant`.

    Frames are kept as pictures: a step draws one. Coins are thrown for each observation, from streams of their own, so
    that steps stay what they are without.
    """

    def __init__(self, simulator: Simulator, num_envs: int):
        self.context, self.observation = simulator.context, simulator.context.observation
        self._rng = np.random.SeedSequence().generate_state(num_envs, np.uint64)
        self._frames = np.empty((num_envs, 0))
        if self.observation.frames > 1:
            one = self.observation.frame(simulator.start_states[:1])
            self._frames = np.zeros((num_envs, self.observation.frames, *one.shape[1:]), one.dtype)

    def seed(self, seeds: Sequence[int | None]) -> None:
        """Seed the random stream of irrelevant entries of each environment. None leaves a stream as it is."""
        seed_streams(self._rng, seeds, 2)

    def push(self, states: np.ndarray, moves: np.ndarray, begins: np.ndarray) -> None:
        """Add frames of states (N, D). (N,) bool: `moves` after a step, `begins` at the start of an episode."""
        if self.observation.frames > 1:
            frames = self.observation.frame(states)
            self._frames[moves, :-1] = self._frames[moves, 1:]
            self._frames[moves, -1] = frames[moves]
            self._frames[begins] = frames[begins, None]

    def current(self, states: np.ndarray, previous: np.ndarray, elapsed: np.ndarray) -> Seen:
        """Observations of the N current states. Called after `push`."""
        return self._in_context(self._frames, slice(None), states, previous, elapsed)

    def terminal(self, rows: np.ndarray, states: np.ndarray, previous: np.ndarray, elapsed: np.ndarray) -> Seen:
        """Terminal observations of environments `rows`, in states (len(rows), D). `push` never sees these states."""
        frames = self._frames[rows]
        if self.observation.frames > 1:
            frames = np.concatenate([frames[:, 1:], self.observation.frame(states)[:, None]], axis=1)
        return self._in_context(frames, rows, states, previous, elapsed)

    def _in_context(
        self, frames: np.ndarray, rows: Rows, states: np.ndarray, previous: np.ndarray, elapsed: np.ndarray
    ) -> Seen:
        stack = self.observation.stacked(frames) if self.observation.frames > 1 else None
        coins = None
        if self.observation.irrelevant:
            rng = self._rng[rows]
            coins = np.empty((len(states), self.observation.irrelevant), np.float32)
            stepping.flip_coins(rng, coins)
            self._rng[rows] = rng
        return self.context(states, previous, elapsed, seen=stack, coins=coins)


class RewardChannel:
    """Delayed, noisy and scaled rewards of N environments. Values and regret are of the rewards that are earned.

    At step t of an episode of n steps, t = 1 .. n, r_t being what is earned, divided by `scale_rewards`:

        paid_t = r_(t - delay) + noise z_t for t < n, with r_0 = r_-1 = ... = 0
        paid_n = r_(n - delay) + ... + r_n + noise z_n

    z are independent standard normal numbers. So the sum of what is paid in an episode has the mean of what was earned,
    however the episode ended. If it is broken off by a reset, what was not paid yet is lost.

    Noise is drawn from separate streams, seeded as the streams of the steps, so that noise does not change the steps.

    Attributes:
        earned: (N,) of the last step.
    Source: the reward delay and reward noise of MDP Playground (Rajan et al. 2023).
    """

    def __init__(self, chance: ChanceSetting, num_envs: int):
        self.noise, self.delay, self.scale = float(chance.reward_noise), int(chance.reward_delay), chance.reward_scale
        self.earned = np.zeros(num_envs)
        self._pending = np.zeros((num_envs, self.delay))
        self._steps = np.zeros(num_envs, np.int64)
        self._rng = np.random.SeedSequence().generate_state(num_envs, np.uint64)

    def seed(self, seeds: Sequence[int | None]) -> None:
        """Seed the noise of each environment. None leaves a stream as it is."""
        seed_streams(self._rng, seeds, 1)

    def restart(self, mask: np.ndarray) -> None:
        """Drop the pending rewards of the environments of mask (N,) bool, whose episodes begin."""
        self._pending[mask] = 0.0
        self._steps[mask] = 0

    def pay(self, earned: np.ndarray, is_step: np.ndarray, ended: np.ndarray) -> np.ndarray:
        """Return the rewards (N,) that agents get in a step.

        Args:
            earned: (N,), 0 if nothing is played.
            is_step: (N,) bool, whether an environment was stepped, not reset.
            ended: (N,) bool, whether its episode is over, so that everything is due.
        """
        self.earned = earned
        amounts = earned / self.scale
        stepping.modify_rewards(self._rng, self.noise, self._pending, self._steps, is_step, ended, amounts)
        return amounts
