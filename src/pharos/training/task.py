"""The task of an agent, and the configuration of a run.

A `Task` is an environment with chance, an observation, and the setting in which values and returns are measured.

`RunConfig` is everything that determines the result of a run, as run.json keeps it: what `train`, `tune`, studies and
the command line make of `TrainingOptions`, and what a stored run is read back into. Its `id` names the run: the same
configuration has the same id on every machine.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from pharos.agents import agent_called, agent_source, is_known
from pharos.environments import Environment, as_tuples, class_called, class_of, class_source, make
from pharos.errors import DivergenceError, FileFormatError, ParameterError, UnknownName
from pharos.mdp import (
    ChanceSetting,
    TabularMDP,
    mdp_within,
)
from pharos.observations import OwnObservation, observation_of, registered
from pharos.policies import Observer, ReachableRows, endless_value, reachable_rows
from pharos.regret import ReferenceValues
from pharos.solvers import GainInterval, Solution, average_reward, uniform_value, value_iteration, worst_value
from pharos.state_space import StateSpace, build
from pharos.system.records import flat, parse_record
from pharos.system.sources import Source, is_reference, resolve, untrusted_code
from pharos.training.options import ENGINES, OBJECTIVES, TrainingOptions

RETURN_TAIL = 1e-9  # part of a discounted return that is not looked at
HELD_OUT = 2.0**-1000
"""Probability of start states in which no episode begins, as no random number is so small: they are held out. If a task
has some, values and regret are those of episodes that begin there, each state as likely."""


@dataclass(frozen=True)
class Horizon:
    """The number of steps of an episode in values and returns: a number, the environment's time limit, or none.

    Attributes:
        value: a number of steps, "limit" for the time limit of the environment, or "none" for discounted values without
            a horizon, or total rewards with gamma 1.
    """

    value: int | str = "limit"

    @staticmethod
    def of(setting: "Horizon | int | str | None") -> "Horizon":
        """Read a setting: a number of steps, "limit" (also "default"), or "none" (also None).

        Raises:
            ParameterError: none of these.
        """
        if isinstance(setting, Horizon):
            return setting
        if setting in ("limit", "default"):
            return Horizon("limit")
        if setting is None or setting == "none":
            return Horizon("none")
        if isinstance(setting, int) and not isinstance(setting, bool) and 1 <= setting < 2**31:
            return Horizon(setting)
        raise ParameterError(
            f"horizon: found {setting!r}; expected a number of steps, limit (the environment's), or none"
            + (" (a number below 2^31)" if isinstance(setting, int) and setting >= 2**31 else "")
        )

    def steps(self, env: Environment) -> int | None:
        """The number of steps in an environment, or None for discounted values without a horizon."""
        if self.value == "none":
            return None
        return int(env.max_episode_steps if self.value == "limit" else self.value)


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
        """Read the entries that `to_dict` returns."""
        low, high = entry["return_range"]
        return TaskValues(ReferenceValues(**entry["reference"]), (low, high))

    def to_dict(self) -> dict[str, Any]:
        """The attributes, JSON-able."""
        return {"reference": asdict(self.reference), "return_range": list(self.return_range)}


@flat
@dataclass(frozen=True, eq=False)
class Task:
    """An environment with chance and an observation, and the setting in which policies on it are measured.

    Value and return are always in the same setting: undiscounted returns (gamma = 1) of episodes of at most `horizon`
    steps, the time limit of the environment, unless told otherwise. With `horizon=None` values are discounted without a
    limit, or total rewards with gamma 1, while the episodes that an agent sees still end at the environment's time
    limit.

    Attributes:
        env: the environment.
        chance: of acting, and in how agents are paid. Its fields are keywords too, `Task(env, sticky=0.1)`. Values and
            regret count the rewards without noise and delay.
        observation, observation_options: what the agent sees, as `pharos.observe` takes it.
        previous_action: whether the agent also sees the previously executed action.
        gamma: discount of values and returns.
        horizon: number of steps of an episode in values and returns, as `Horizon.of` reads it. "default": the
            environment's time limit.
        objective: "average": policies are also measured by what a step earns in the long run. "total" stands for
            gamma 1 without a horizon, and None for values alone.
        values: at the start, if they are known already. None: solved for when they are needed.
    """

    env: Environment
    chance: ChanceSetting = ChanceSetting()
    observation: OwnObservation | str = "vector"
    observation_options: Mapping[str, Any] = field(default_factory=dict)
    previous_action: bool = False
    gamma: float = 1.0
    horizon: Horizon | int | str | None = "default"
    objective: str | None = None
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
        if self.objective not in (None, *OBJECTIVES):
            raise UnknownName("objective", self.objective, OBJECTIVES)
        horizon = Horizon.of(self.horizon)
        if self.objective == "total":
            if self.gamma != 1.0 or isinstance(horizon.value, int):
                raise ParameterError(
                    f"the objective total has gamma 1 and no horizon; found gamma {self.gamma:g}, horizon "
                    f"{horizon.value}"
                )
            horizon = Horizon("none")
            object.__setattr__(self, "objective", None)
        object.__setattr__(self, "horizon", horizon.steps(self.env))

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
        """Steps of an episode in values and returns. None for discounted values or total rewards without a horizon."""
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
            "chance": self.scaled_chance,
            "previous_action": self.previous_action,
            "time_limit": self.time_limit,
        }
        return {**options, "space": self.space} if self.observation == "index" else options

    @cached_property
    def space(self) -> StateSpace:
        """The state space, built or from the cache."""
        return build(self.env)

    @cached_property
    def observer(self) -> Observer:
        """Observations of the states, as a policy sees them."""
        return Observer(
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
    def measured(self) -> TabularMDP:
        """The tabular MDP with the start states that values are of: those that are held out, where there are any."""
        is_held_out = self.mdp.start_probabilities <= HELD_OUT
        if not is_held_out.any():
            return self.mdp
        starts = self.mdp.start_states[is_held_out]
        return replace(self.mdp, start_states=starts, start_probabilities=np.full(len(starts), 1.0 / len(starts)))

    @cached_property
    def _reaches(self) -> dict[tuple[int, int], ReachableRows]:
        return {}

    def reach(self, max_rows: int, steps: int) -> ReachableRows:
        """Rows that policies of positive probability reach, remembered, see `pharos.policies.reachable_rows`."""
        key = max_rows, steps
        if key not in self._reaches:
            self._reaches[key] = reachable_rows(self.measured, *key, sees_previous_action=self.previous_action)
        return self._reaches[key]

    @property
    def _mdp_without_chance(self) -> TabularMDP:
        return self.space.mdp(gamma=self.gamma).with_horizon(self.horizon_steps)

    @cached_property
    def optimal(self) -> Solution:
        """Optimal values."""
        return value_iteration(self.measured)

    @cached_property
    def uniform(self) -> Solution:
        """Values of the uniformly random policy."""
        return uniform_value(self.measured)

    @cached_property
    def worst(self) -> Solution:
        """Values of the worst policy."""
        return worst_value(self.measured)

    @property
    def reference(self) -> ReferenceValues:
        """Reference values of regret: those at the start of the optimal, the uniform and the worst policy."""
        return self._solved_reference if self.values is None else self.values.reference

    @cached_property
    def _solved_reference(self) -> ReferenceValues:
        mdp = self._episodes(self.measured)
        best = value_iteration(mdp)
        values, error = [float(best.value_at_start)], best.error_bound
        for solve in (uniform_value, worst_value):
            try:
                solution = solve(mdp)
                values.append(float(solution.value_at_start))
                error = max(error, solution.error_bound)
            except DivergenceError:  # of total rewards: the policy may go on for ever while something is paid
                values.append(-math.inf if solve is worst_value else endless_value(mdp, "uniform"))
        optimal, uniform, worst = values
        return ReferenceValues(optimal, uniform, worst, error)

    @cached_property
    def gains(self) -> dict[str, GainInterval]:
        """Average rewards a step in the long run, from the start, of the optimal, the uniform and the worst policy."""
        return {name: average_reward(self.mdp, name).gain_at_start for name in ("optimal", "uniform", "worst")}

    @cached_property
    def scaled_chance(self) -> ChanceSetting:
        """The chance, with a number in the place of `scale_rewards="range"`.

        Raises:
            ParameterError: no policy beats uniform play, or V* - U is infinite, so that there is no such number.
        """
        if self.chance.scale_rewards != "range":
            return self.chance
        spread = self.reference.spread()
        if not math.isfinite(spread):
            reason = "no policy beats uniform play" if math.isnan(spread) else "uniform play has no finite value"
            raise ParameterError(f"scale_rewards is range, but {reason}; expected a number")
        return replace(self.chance, scale_rewards=repr(spread))

    @property
    def return_range(self) -> tuple[float, float]:
        """The lowest and the highest return that an episode can have, whatever is executed."""
        return self._solved_return_range if self.values is None else self.values.return_range

    @cached_property
    def _solved_return_range(self) -> tuple[float, float]:
        if self.horizon is None and self.gamma == 1.0:
            return -math.inf, math.inf
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
        """The MDP of the states that an episode can visit: of a Freeway of a million states, some thousand."""
        return mdp if self.horizon_steps is None else mdp_within(mdp, self.horizon_steps)


def _range_of_returns(mdp: TabularMDP) -> tuple[float, float]:
    """The lowest and the highest return of an episode, whichever outcomes are drawn. Each pays what its action pays on
    average, as episodes on a table do.
    """
    largest = max(abs(mdp.reward_table.lowest), abs(mdp.reward_table.highest))
    steps, rest = mdp.horizon, 0.0
    if steps is None:  # what is left out of a discounted return is less than rest
        steps = max(1, math.ceil(math.log(RETURN_TAIL) / math.log(mdp.gamma))) if mdp.gamma > 0 else 1
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


# The configuration of a run -------------------------------------------------------------------------------------------


CELL = ["environment", "instance", "chance", "agent", "observation"]  # columns that tell the cells of a study
# In the order of run.json
CONFIG_KEYS = (
    *("environment", "parameters", "chance", "observation", "observation_options", "agent", "hyperparameters", "steps"),
    *("seed", "gamma", "horizon", "objective", "evaluation_interval", "engine", "sources"),
)


@flat
@dataclass(frozen=True, kw_only=True)
class RunConfig(TrainingOptions):
    """Configuration that determines the result of a run: options of training, an environment, and a seed.

    Attributes:
        environment: name of the class of environments.
        parameters: all parameters of the environment, JSON-able.
        seed: of everything random.
        horizon: number of steps of an episode in values and returns. None: discounted values without a horizon, or
            total rewards if gamma is 1.
        objective: "average", of runs that also measure what a step earns in the long run. Otherwise None, and not in
            `id` and `to_dict`.
        evaluation_interval: steps between evaluations of the policy.
        hyperparameters: of the agent, which go before its defaults.
        engine: what trains networks, one of ENGINES. Tables are the same with each, so theirs is always "sb3". `id` and
            `to_dict` have it only if it is another.
        sources: the origin of a class, observation or agent of the user's own, under "environment", "observation"
            and "agent". Their names belong to the `id`, files and checksums do not.
    """

    environment: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    horizon: int | None = field()
    evaluation_interval: int = field()
    sources: Mapping[str, Source] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.engine not in ENGINES:
            raise UnknownName("engine", self.engine, ENGINES)
        if self.objective not in (None, "average"):
            raise ParameterError(f"the objective of a run is {self.objective!r}; expected average, or none")
        object.__setattr__(self, "engine", agent_called(self.agent).engine(self.engine))
        for name in ("steps", "evaluation_interval"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value < 2**63:
                raise ParameterError(f"{name} is {value!r}; expected a whole number of at least 1, and of 64 bits")

    @staticmethod
    def of_task(
        task: "Task",
        agent: str,
        *,
        steps: int,
        seed: int = 0,
        evaluation_interval: int | None = None,
        hyperparameters: Mapping[str, Any] | None = None,
        engine: str = "sb3",
    ) -> "RunConfig":
        """The configuration of a run on a task. It is evaluated every hundredth of `steps` by default.

        Args:
            agent: `module:Name` and `file.py:Name` are looked for in the current directory.
        """
        observation = task.observation
        sources = {
            "environment": class_source(type(task.env)),
            "observation": observation.source if isinstance(observation, OwnObservation) else None,
            "agent": agent_source(agent),
        }
        if sources["agent"] is not None:
            agent = sources["agent"].name
        return RunConfig(
            environment=task.env.name,
            parameters=json.loads(json.dumps(task.env.parameters)),
            chance=task.chance,
            observation=str(observation),
            observation_options=dict(task.observation_options),
            agent=agent,
            hyperparameters=dict(hyperparameters or {}),
            steps=steps,
            seed=seed,
            gamma=task.gamma,
            horizon=task.horizon_steps,
            objective=task.objective,
            evaluation_interval=evaluation_interval or (max(1, steps // 100) if isinstance(steps, int) else 1),
            engine=engine,
            sources={part: source for part, source in sources.items() if source is not None},
        )

    @staticmethod
    def from_dict(entry: Mapping[str, Any]) -> "RunConfig":
        """Read the `config` of a run.json.

        Raises:
            FileFormatError: an entry is missing, unknown or of another type.
        """
        try:
            return parse_record(
                RunConfig, entry, "the configuration of a run", optional=("engine", "sources", "objective")
            )
        except ParameterError as error:
            raise FileFormatError(f"the configuration of a run is damaged: {error}") from error

    def to_dict(self) -> dict[str, Any]:
        """The `config` of a run.json, JSON-able."""
        sources = {part: source.to_dict() for part, source in self.sources.items()}
        entry = {**vars(self), "chance": self.chance.to_dict(), "sources": sources}
        if self.engine == "sb3":
            del entry["engine"]
        if not sources:
            del entry["sources"]
        if self.objective is None:
            del entry["objective"]
        ordered = {name: entry[name] for name in CONFIG_KEYS if name in entry}
        return {name: dict(value) if isinstance(value, Mapping) else value for name, value in ordered.items()}

    @property
    def id(self) -> str:
        """The name of the run: a digest of the configuration, the same on every machine."""
        return run_id(self.to_dict())

    def make_environment(self, *, trust: bool = False, strict: bool = False) -> Environment:
        """The environment of the run.

        Args:
            trust: whether code of the user's own may be imported. What was imported before needs no trust.
            strict: whether a file that has changed since is an error instead of a warning.
        Raises:
            UnknownName, ParameterError: it does not exist, or not with these parameters. UntrustedCode: see `trust`.
        """
        parameters = {name: as_tuples(value) for name, value in self.parameters.items()}
        if "environment" in self.sources:
            name = class_of(self.sources["environment"], trust=trust, strict=strict).name
            return make(name, **parameters)
        self._check_trust("environment", trust)
        return make(self.environment, **parameters)

    def task(self, values: "TaskValues | None" = None, *, trust: bool = False, strict: bool = False) -> "Task":
        """The task of the run.

        Args:
            values: at the start, which are not computed again if they are given.
            trust, strict: as for `make_environment`.
        """
        observation: str | OwnObservation = self.observation
        if "observation" in self.sources:
            observation = observation_of(self.sources["observation"], trust=trust, strict=strict)
        else:
            self._check_trust("observation", trust)
        return Task(
            self.make_environment(trust=trust, strict=strict),
            chance=self.chance,
            observation=observation,
            observation_options=dict(self.observation_options),
            gamma=self.gamma,
            horizon=self.horizon,
            objective=self.objective,
            values=values,
        )

    @property
    def definitions(self) -> tuple[Any, ...]:
        """The registered class of the environment, and the registration of the observation, if there are any."""
        return (class_called(self.environment), *(registered(self.observation) or ()))

    def algorithm(self, *, trust: bool = False, strict: bool = False) -> "str | Callable[..., Any]":
        """The agent of the run: its name, or the class or function of the user's own.

        Raises:
            UntrustedCode: see `make_environment`.
        """
        if "agent" in self.sources:
            return resolve(self.sources["agent"], trust=trust, strict=strict)
        if not is_known(self.agent):
            self._check_trust("agent", trust)
        return self.agent

    def _check_trust(self, part: str, trust: bool) -> None:
        name = getattr(self, part)
        if is_reference(name) and not trust:
            raise untrusted_code(f"the {part} {name!r}")


def run_id(config: Mapping[str, Any]) -> str:
    """The digest of a run's `config`: XXH3 with 64 bits of its sorted JSON, 16 hexadecimal digits.

    Of code of the user's own its name counts, not its folder, so that the id is the same on every machine.
    """
    import xxhash

    sources = config.get("sources")
    if isinstance(sources, Mapping):
        names = {
            part: source.get("name") if isinstance(source, Mapping) else source for part, source in sources.items()
        }
        config = {**config, "sources": names}
    return xxhash.xxh3_64_hexdigest(json.dumps(config, sort_keys=True, separators=(",", ":")).encode())
