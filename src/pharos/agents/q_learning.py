"""Tabular Q-learning. Source: Watkins (1989); Watkins and Dayan (1992)."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pharos.agents.agent import LearningRun, TableBasedAgent
from pharos.agents.idealised import Idealised
from pharos.errors import ParameterError, UnknownName
from pharos.mdp import TabularMDP
from pharos.system.arrays import read_only

Q_LEARNING_DEFAULTS: dict[str, Any] = {
    "learning_rate": 0.1,
    "visits_exponent": 0.0,
    "gamma": 0.99,
    "exploration_initial_eps": 1.0,
    "exploration_final_eps": 0.02,
    "exploration_fraction": 0.5,
    "exploration_schedule": "linear",
    "initial_q": 0.0,
    "sees_previous_action": False,
}


class QLearning:
    """Watkins' Q-learning with epsilon-greedy exploration on the table of an MDP.

        Q(s, a) += alpha (r + gamma max_b Q(s', b) - Q(s, a))

    There is no next value if the episode ended in a terminal state.

    An episode that the time limit cuts off is not an end of that kind: the next value is used. Under chance the update
    belongs to the chosen action, as the agent does not know which one was executed.

    Args:
        mdp: the MDP, with chance. Its horizon is the time limit of episodes.
        total_steps: over which exploration is scheduled.
        seed: of all random numbers. The same seed gives the same table, whatever the pieces that `learn` is called in.
        reward_noise, reward_delay: how r is paid, as `pharos.interaction.Interaction` has it. Returns are of what is
            earned.
        learning_rate: alpha, in (0, 1]. With visits_exponent w > 0, alpha = max(learning_rate, n^-w) at the n-th update
            of a pair.
        gamma: discount of the agent.
        exploration_initial_eps, exploration_final_eps, exploration_fraction: epsilon goes from the first to the second
            over this share of total_steps, then stays. exploration_schedule: "linear" or "exponential".
        initial_q: every entry at the start. It is optimistic if it is larger than any value.
        sees_previous_action: a row for each (state, previously executed action) instead of for each state.
    Raises:
        ParameterError: an option is unknown or out of range.
    Cost: 15 to 60 ns a step. Memory 16 bytes for each state and action.
    """

    def __init__(
        self,
        mdp: TabularMDP,
        *,
        total_steps: int,
        seed: int = 0,
        time_limit: int | None = None,
        reward_noise: float = 0.0,
        reward_delay: int = 0,
        **options: object,
    ):
        self._transitions = mdp.dynamics.for_steps
        self.mdp, self.options, self.seed = mdp, checked_options(options), int(seed)
        self.total_steps = int(total_steps)
        self.limit = time_limit or mdp.horizon or 2**62
        rows = mdp.num_states * ((mdp.num_actions + 1) if self.options["sees_previous_action"] else 1)
        self.q = np.full((rows, mdp.num_actions), float(self.options["initial_q"]))
        self.visits = np.zeros((rows, mdp.num_actions), np.int64)
        self.cursor = np.array([-1, 0, 0, 0, 0], np.int64)
        self.sums = np.array([0.0, 1.0, 0.0])
        self.word = np.array([np.random.SeedSequence(self.seed).generate_state(1, np.uint64)[0]], np.uint64)
        self.reward_noise, self.pending = float(reward_noise), np.zeros(int(reward_delay))
        self.noise_word = np.random.SeedSequence(self.seed, spawn_key=(1,)).generate_state(1, np.uint64)

    @property
    def steps(self) -> int:
        """Steps so far."""
        return int(self.cursor[3])

    @property
    def episodes(self) -> int:
        """Number of finished episodes so far."""
        return int(self.cursor[4])

    @property
    def sum_of_returns(self) -> float:
        """Sum of the returns of finished episodes, with the discount of the MDP."""
        return float(self.sums[2])

    def learn(self, steps: int) -> "QLearning":
        """Learn for so many more steps."""
        from pharos.kernels.stepping import Episodes, q_learning

        mdp, options = self.mdp, self.options
        cumulative = np.cumsum(mdp.start_probabilities)
        cumulative[-1] = 1.0
        sets = () if mdp.available is None else (read_only(mdp.available),)
        schedule = (
            float(options["learning_rate"]),
            float(options["visits_exponent"]),
            float(options["gamma"]),
            float(options["exploration_initial_eps"]),
            float(options["exploration_final_eps"]),
            float(options["exploration_fraction"]) * self.total_steps,
            float(options["exploration_schedule"] == "exponential"),
            float(mdp.gamma),
        )
        chance = (*mdp.chance.triple, float(mdp.chance.first_chosen), *sets)
        episodes = Episodes(np.asarray(mdp.terminal, np.bool_), mdp.start_states, cumulative, chance, int(self.limit))
        learner = (self.q, self.visits, self.cursor, self.sums, self.word)
        noise = (self.reward_noise, self.pending, self.noise_word)
        q_learning(self._transitions, mdp.reward_table.for_kernels, episodes, schedule, learner, noise, int(steps))
        return self

    def policy_table(self) -> np.ndarray:
        """The greedy policy: (S,) actions, the first among equals.

        (S, A + 1, A) probabilities if previous actions are seen.

        In the second form [s, b] is the policy after executing b, b = A standing for no previous action.
        """
        q, sets = self.q, self.mdp.available
        if sets is not None:
            q = np.where(np.repeat(sets, len(q) // len(sets), axis=0), q, -np.inf)
        greedy = q.argmax(axis=1)
        if not self.options["sees_previous_action"]:
            return greedy
        num_actions = self.mdp.num_actions
        return np.eye(num_actions)[greedy].reshape(self.mdp.num_states, num_actions + 1, num_actions)

    def state(self) -> dict[str, np.ndarray]:
        """State of the learner for `restore`, as plain arrays."""
        arrays = {"q": self.q, "visits": self.visits, "place": self.cursor, "sums": self.sums, "word": self.word}
        if len(self.pending):
            arrays["pending"] = self.pending
        return arrays | ({"noise_word": self.noise_word} if self.reward_noise else {})

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore a state that `state` returned."""
        for name, array in self.state().items():
            if state[name].shape != array.shape or state[name].dtype != array.dtype:
                raise ParameterError(
                    f"q_learning: stored {name} has shape {state[name].shape} and type {state[name].dtype}; expected "
                    f"{array.shape} and {array.dtype}: it belongs to another MDP or other hyperparameters"
                )
            array[:] = state[name]


def checked_options(changes: Mapping[str, Any]) -> dict[str, Any]:
    """Q_LEARNING_DEFAULTS with changes. UnknownName, ParameterError: one is unknown or out of range."""
    unknown = set(changes) - set(Q_LEARNING_DEFAULTS)
    if unknown:
        raise UnknownName("hyperparameter of q_learning", sorted(unknown)[0], Q_LEARNING_DEFAULTS)
    options = {**Q_LEARNING_DEFAULTS, **changes}
    ranges = {
        "learning_rate": (0.0, 1.0),
        "visits_exponent": (0.0, 1.0),
        "gamma": (0.0, 1.0),
        "exploration_initial_eps": (0.0, 1.0),
        "exploration_final_eps": (0.0, 1.0),
        "exploration_fraction": (0.0, 1.0),
    }
    for name, (low, high) in ranges.items():
        value = options[name]
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise ParameterError(f"q_learning: {name} is {value!r}; expected a number from {low:g} to {high:g}")
    if options["learning_rate"] == 0 and options["visits_exponent"] == 0:
        raise ParameterError(
            "q_learning: learning_rate is 0, so nothing is learnt; expected more, or a visits_exponent"
        )
    if options["exploration_schedule"] not in ("linear", "exponential"):
        raise ParameterError(
            f"q_learning: exploration_schedule is {options['exploration_schedule']!r}; expected 'linear' or "
            "'exponential'"
        )
    if options["exploration_schedule"] == "exponential" and not (
        options["exploration_initial_eps"] > 0 and options["exploration_final_eps"] > 0
    ):
        raise ParameterError("q_learning: an exponential schedule needs both epsilons above 0")
    if not isinstance(options["sees_previous_action"], bool):
        wrong = options["sees_previous_action"]
        raise ParameterError(f"q_learning: sees_previous_action is {wrong!r}; expected true or false")
    initial = options["initial_q"]
    if isinstance(initial, bool) or not isinstance(initial, int | float) or not math.isfinite(initial):
        raise ParameterError(f"q_learning: initial_q is {initial!r}; expected a finite number")
    return options


class QLearningAgent(TableBasedAgent):
    """Q-learning as an agent that has a name."""

    def library_default(self, name: str) -> object:
        return Q_LEARNING_DEFAULTS.get(name)

    def check(self, hyperparameters: Mapping[str, Any], engine: str) -> None:
        checked_options(hyperparameters)

    def table(self, run: LearningRun) -> QLearning:
        task, chance = run.task, run.task.scaled_chance
        # In another unit of rewards a table learns the same policies, from values and with noise in that unit
        scale, options = chance.reward_scale, checked_options(run.hyperparameters)
        if options["sees_previous_action"] and not chance.sticky:
            raise ParameterError(
                "q_learning: sees_previous_action is for sticky actions, and there are none; leave it out, or add them"
            )
        initial = {"initial_q": scale * options["initial_q"]}
        return QLearning(
            task.mdp,
            total_steps=run.config.steps,
            seed=run.config.seed,
            time_limit=task.time_limit,
            reward_noise=chance.reward_noise * scale,
            reward_delay=chance.reward_delay,
            **{**run.hyperparameters, **initial},
        )


Q_LEARNING = QLearningAgent(
    name="q_learning",
    title="tabular Q-learning",
    defaults={
        "learning_rate": 0.02,
        "visits_exponent": 0.6,
        "gamma": 0.99,
        "initial_q": 1.0,  # optimistic: the largest return of grids and lakes
        "exploration_initial_eps": 1.0,
        "exploration_final_eps": 0.02,
        "exploration_fraction": 0.3,
    },
    space={
        "learning_rate": ("log", 0.01, 1.0),
        "visits_exponent": ("one of", 0.0, 0.6, 0.8),
        "gamma": ("one of", 0.95, 0.99, 0.999),
        "initial_q": ("one of", 0.0, 0.5, 1.0, 2.0),
        "exploration_final_eps": ("linear", 0.0, 0.1),
        "exploration_fraction": ("linear", 0.01, 0.5),
    },
    idealised=Idealised(kind="table"),
)
