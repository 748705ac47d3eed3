"""A task: an environment with chance, an observation, and the setting in which values and returns are measured."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from pharos.environments import Environment, make
from pharos.errors import ParameterError
from pharos.mdp import ChanceSetting, TabularMDP
from pharos.observations import OwnObservation
from pharos.policies import ReachableRows, Sight, reachable_rows
from pharos.solvers import ReferenceValues, Solution, uniform_value, value_iteration, worst_value
from pharos.state_space import StateSpace, build
from pharos.system.records import flat
from pharos.training.options import Horizon

TAIL = 1e-9  # part of a discounted return that is not looked at


@dataclass(frozen=True)
class TaskValues:
    """Values at the start of a task, which are expensive to compute and the same for every run on it.

    Attributes:
        reference: of the optimal, the uniform and the worst policy.
        return_range: the lowest and the highest return that an episode can have.
    """

    reference: ReferenceValues
    return_range: tuple[float, float]

    @staticmethod
    def from_dict(entry: Mapping[str, Any]) -> "TaskValues":
        """Read what `to_dict` gave."""
        low, high = entry["return_range"]
        return TaskValues(ReferenceValues(**entry["reference"]), (low, high))

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {"reference": asdict(self.reference), "return_range": list(self.return_range)}


@flat
@dataclass(frozen=True, eq=False)
class Task:
    """What an agent learns, and what its policies are measured against.

    Value and return are always in the same setting: undiscounted returns (gamma = 1) of episodes of at most `horizon`
    steps, the time limit of the environment, unless told otherwise. With `horizon=None` values are discounted without a
    limit, while the episodes that an agent sees still end at the environment's time limit.

    Attributes:
        env: the environment.
        chance: of acting, and in how agents are paid; its fields are keywords too, `Task(env, sticky=0.1)`. Values and
            regret are those of the rewards without noise and delay.
        observation, observation_options: what the agent sees, as `pharos.observe` takes it.
        previous_action: whether the agent also sees the previously executed action.
        gamma: discount of values and returns.
        horizon: number of steps of an episode in values and returns, as `Horizon.of` reads it; "default": the
            environment's time limit.
        values: at the start, where they are known already; None: solved for when they are needed.
    """

    env: Environment
    chance: ChanceSetting = ChanceSetting()
    observation: OwnObservation | str = "vector"
    observation_options: Mapping[str, Any] = field(default_factory=dict)
    previous_action: bool = False
    gamma: float = 1.0
    horizon: Horizon | int | str | None = "default"
    values: TaskValues | None = None

    def __post_init__(self) -> None:
        if isinstance(self.env, str):
            raise ParameterError(f"env is {self.env!r}; expected an Environment: use Task.of")
        if isinstance(self.env, TabularMDP):
            raise ParameterError(
                f"env is {self.env!r}, a table; expected an Environment: pharos.importers.environment(mdp) makes one "
                f"of a table without sticky or random actions"
            )
        if not isinstance(self.env, Environment):
            raise ParameterError(f"env is {self.env!r}; expected an Environment, or its name")
        object.__setattr__(self, "horizon", Horizon.of(self.horizon).steps(self.env))
        if self.horizon is None and self.gamma >= 1:
            raise ParameterError(
                "gamma is 1 without a horizon, so a value may be infinite; give a horizon, or gamma < 1"
            )

    @staticmethod
    def of(environment: Environment | str, parameters: Mapping[str, Any] | None = None, **options: Any) -> "Task":
        """A task from the name and the parameters of an environment, or an environment."""
        if isinstance(environment, str):
            return Task(make(environment, **(parameters or {})), **options)
        if parameters:
            raise ParameterError(f"{environment} has its parameters already; found {', '.join(parameters)}")
        return Task(environment, **options)

    @property
    def horizon_steps(self) -> int | None:
        """Steps of an episode in values and returns; None for discounted values without a horizon."""
        return self.horizon  # type: ignore[return-value]  # __post_init__ has resolved it

    @property
    def time_limit(self) -> int:
        """Steps after which the episodes that an agent sees end."""
        return int(self.env.max_episode_steps) if self.horizon_steps is None else self.horizon_steps

    @property
    def conventions(self) -> dict[str, Any]:
        """The setting of values and returns, JSON-able."""
        return {"gamma": self.gamma, "horizon": self.horizon, "time_limit": self.time_limit}

    @property
    def interaction(self) -> dict[str, Any]:
        """Options of `pharos.GymEnv` and of vector environments."""
        options: dict[str, Any] = {
            "observation": self.observation,
            "observation_options": dict(self.observation_options) or None,
            "chance": self.chance,
            "previous_action": self.previous_action,
            "time_limit": self.time_limit,
        }
        return {**options, "space": self.space} if self.observation == "index" else options

    @cached_property
    def space(self) -> StateSpace:
        """The state space, built or from the cache."""
        return build(self.env)

    @cached_property
    def sight(self) -> Sight:
        """What a policy sees of the states."""
        return Sight(
            self.space,
            self.env,
            self.observation,
            dict(self.observation_options),
            self.previous_action,
            self.time_limit,
        )

    @cached_property
    def mdp(self) -> TabularMDP:
        """The tabular MDP, with chance, gamma and horizon."""
        return self.chance.of(self._mdp_without_chance)

    @cached_property
    def _reaches(self) -> dict[tuple[int, int], ReachableRows]:
        return {}

    def reach(self, max_rows: int, steps: int) -> ReachableRows:
        """Rows that policies of positive probability reach, remembered; see `pharos.policies.reachable_rows`."""
        key = max_rows, steps
        if key not in self._reaches:
            self._reaches[key] = reachable_rows(self.mdp, *key, sees_previous_action=self.previous_action)
        return self._reaches[key]

    @property
    def _mdp_without_chance(self) -> TabularMDP:
        return self.space.mdp(gamma=self.gamma).with_horizon(self.horizon_steps)

    @cached_property
    def optimal(self) -> Solution:
        """Optimal values."""
        return value_iteration(self.mdp)

    @cached_property
    def uniform(self) -> Solution:
        """Values of the uniformly random policy."""
        return uniform_value(self.mdp)

    @cached_property
    def worst(self) -> Solution:
        """Values of the worst policy."""
        return worst_value(self.mdp)

    @property
    def reference(self) -> ReferenceValues:
        """What regret is measured against: values at the start of the optimal, the uniform and the worst policy."""
        return self._solved_reference if self.values is None else self.values.reference

    @cached_property
    def _solved_reference(self) -> ReferenceValues:
        mdp = self._episodes(self.mdp)
        solutions = [solve(mdp) for solve in (value_iteration, uniform_value, worst_value)]
        error = max(solution.error_bound for solution in solutions)
        optimal, uniform, worst = (float(solution.value_at_start) for solution in solutions)
        return ReferenceValues(optimal, uniform, worst, error)

    @property
    def return_range(self) -> tuple[float, float]:
        """The lowest and the highest return that an episode can have, whatever is executed."""
        return self._solved_return_range if self.values is None else self.values.return_range

    @cached_property
    def _solved_return_range(self) -> tuple[float, float]:
        plain = self._episodes(self._mdp_without_chance)
        if not plain.dynamics.is_deterministic:
            return _range_of_returns(plain)
        if not self.chance.changes_mdp and len(self.mdp.start_states) == 1:
            reference = self.reference
            return reference.worst - reference.error_bound, reference.optimal + reference.error_bound
        low, high = worst_value(plain), value_iteration(plain)
        starts = plain.start_states
        return float(low.v[starts].min() - low.error_bound), float(high.v[starts].max() + high.error_bound)

    def _episodes(self, mdp: TabularMDP) -> TabularMDP:
        """The states that an episode can meet: of a Freeway of a million, some thousand."""
        return mdp if self.horizon_steps is None else mdp.within(self.horizon_steps)


def _range_of_returns(mdp: TabularMDP) -> tuple[float, float]:
    """The lowest and the highest return of an episode, whichever outcomes are drawn; each pays what its action pays on
    average, as episodes on a table do.
    """
    largest = max(abs(mdp.reward_table.lowest), abs(mdp.reward_table.highest))
    steps, rest = mdp.horizon, 0.0
    if steps is None:  # what is left out of a discounted return is less than rest
        steps = max(1, math.ceil(math.log(TAIL) / math.log(mdp.gamma))) if mdp.gamma > 0 else 1
        rest = largest * mdp.gamma**steps / (1 - mdp.gamma)
    rest += 1e-12 * largest * steps  # rounding
    ends, rewards, terminal = [], mdp.rewards, np.asarray(mdp.terminal)
    for extreme, best in ((mdp.dynamics.smallest, np.min), (mdp.dynamics.largest, np.max)):
        x = np.zeros(mdp.num_states + 1)
        for _ in range(steps):
            before = x.copy()
            x[:-1] = best(rewards + mdp.gamma * extreme(x), axis=1)
            x[:-1][terminal] = 0.0
            if (x == before).all():
                break
        ends.append(float(best(x[mdp.start_states])))
    return ends[0] - rest, ends[1] + rest
