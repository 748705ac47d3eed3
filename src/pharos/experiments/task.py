"""A task: an environment with chance, an observation, and the setting in which values and returns are measured."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from pharos.environments import Environment, make
from pharos.errors import ParameterError

if TYPE_CHECKING:
    from pharos.experiments.regret import ReferenceValues
    from pharos.mdp import TabularMDP
    from pharos.solvers import Solution
    from pharos.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class Task:
    """What an agent learns, and what its policies are measured against.

    Value and return are always in the same setting: undiscounted returns (gamma = 1) of episodes of at most `horizon` steps,
    the time limit of the environment, unless told otherwise. With `horizon=None` values are discounted without a limit, while
    the episodes that an agent sees still end at the environment's time limit.

    Attributes:
        env: the environment.
        sticky, random: chance, as in `pharos.sticky_actions` and `pharos.random_actions`; both: random ones come first.
        observation, observation_options: what the agent sees.
        previous_action: whether the agent also sees the previously executed action.
        gamma: discount of values and returns.
        horizon: number of steps of an episode in values and returns; "default": the environment's time limit.
    """

    env: Environment
    sticky: float = 0.0
    random: float = 0.0
    observation: Any = "vector"
    observation_options: Mapping[str, Any] = field(default_factory=dict)
    previous_action: bool = False
    gamma: float = 1.0
    horizon: int | str | None = "default"

    def __post_init__(self) -> None:
        if isinstance(self.env, str):
            raise ParameterError(f"env is {self.env!r}; expected an Environment: use Task.of")
        if self.horizon == "default":
            object.__setattr__(self, "horizon", int(self.env.max_episode_steps))
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
    def time_limit(self) -> int:
        """Steps after which the episodes that an agent sees end."""
        return int(self.horizon) if self.horizon is not None else int(self.env.max_episode_steps)

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
            "sticky": self.sticky,
            "random": self.random,
            "previous_action": self.previous_action,
            "time_limit": self.time_limit,
        }
        return {**options, "space": self.space} if self.observation == "index" else options

    @cached_property
    def space(self) -> "StateSpace":
        """The state space, built or from the cache."""
        from pharos.state_space import build

        return build(self.env)

    @cached_property
    def mdp(self) -> "TabularMDP":
        """The tabular MDP, with chance, gamma and horizon."""
        from pharos.mdp import random_actions, sticky_actions

        mdp = self.space.mdp(gamma=self.gamma).with_horizon(self.horizon)  # type: ignore[arg-type]
        if self.sticky:
            mdp = sticky_actions(mdp, self.sticky)
        return random_actions(mdp, self.random) if self.random else mdp

    @cached_property
    def optimal(self) -> "Solution":
        """Optimal values."""
        from pharos.solvers import value_iteration

        return value_iteration(self.mdp)

    @cached_property
    def uniform(self) -> "Solution":
        """Values of the uniformly random policy."""
        from pharos.solvers import uniform_value

        return uniform_value(self.mdp)

    @cached_property
    def worst(self) -> "Solution":
        """Values of the worst policy."""
        from pharos.solvers import worst_value

        return worst_value(self.mdp)

    @cached_property
    def reference(self) -> "ReferenceValues":
        """What regret is measured against: the values at the start of the optimal, the uniform and the worst policy."""
        from pharos.experiments.regret import ReferenceValues
        from pharos.solvers import uniform_value, value_iteration, worst_value

        mdp = self._episodes(self.mdp)
        found = [solve(mdp) for solve in (value_iteration, uniform_value, worst_value)]
        error = max(solution.error_bound for solution in found)
        optimal, uniform, worst = (float(solution.value_at_start) for solution in found)
        return ReferenceValues(optimal, uniform, worst, error)

    @cached_property
    def return_range(self) -> tuple[float, float]:
        """The lowest and the highest return that an episode can have, whatever is executed."""
        from pharos.solvers import value_iteration, worst_value

        if not self.sticky and not self.random and len(self.mdp.start_states) == 1:
            known = self.reference
            return known.worst - known.error_bound, known.optimal + known.error_bound
        plain = self._episodes(self.space.mdp(gamma=self.gamma).with_horizon(self.horizon))  # type: ignore[arg-type]
        low, high = worst_value(plain), value_iteration(plain)
        starts = plain.start_states
        return float(low.v[starts].min() - low.error_bound), float(high.v[starts].max() + high.error_bound)

    def _episodes(self, mdp: "TabularMDP") -> "TabularMDP":
        """Those states that an episode can meet: of a Freeway of a million, some thousand."""
        return mdp if self.horizon is None else mdp.within(int(self.horizon))
