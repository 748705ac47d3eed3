"""The configuration of a run: everything that determines its result, as run.json keeps it.

`RunConfig` is what `train`, `tune`, studies and the command line make of their options, and what a stored run is read back
into. Its `id` names the run: the same configuration has the same id on every machine. Beside it stand the two settings that
a run shares with values and measures of hardness: `ChanceSetting` and `Horizon`.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from pharos.agents import agent_kind
from pharos.environments import Environment, as_tuples, make
from pharos.errors import FileFormatError, ParameterError, UnknownName

if TYPE_CHECKING:
    from pharos.experiments.task import Task, TaskValues
    from pharos.mdp import TabularMDP


@dataclass(frozen=True)
class ChanceSetting:
    """Chance that is added to a deterministic environment; `pharos.mdp.Chance` is what it does to an MDP.

    Attributes:
        sticky: probability that the previous action is executed again.
        random: probability that a uniformly random action is executed. Where both are given, random ones come first.
    """

    sticky: float = 0.0
    random: float = 0.0

    @staticmethod
    def from_dict(entry: Mapping[str, float]) -> "ChanceSetting":
        """Read `{"sticky": .., "random": ..}`; what is left out is 0.

        Raises:
            UnknownName: another kind of chance.
        """
        for name in entry:
            if name not in ("sticky", "random"):
                raise UnknownName("kind of chance", name, ("sticky", "random"))
        return ChanceSetting(entry.get("sticky", 0.0), entry.get("random", 0.0))

    def to_dict(self) -> dict[str, float]:
        """`{"sticky": .., "random": ..}`."""
        return {"sticky": self.sticky, "random": self.random}

    def of(self, mdp: "TabularMDP") -> "TabularMDP":
        """The MDP with this chance added.

        Raises:
            ParameterError: a probability is not between 0 and 1.
        """
        from pharos.mdp import random_actions, sticky_actions

        if self.sticky:
            mdp = sticky_actions(mdp, self.sticky)
        return random_actions(mdp, self.random) if self.random else mdp

    def __bool__(self) -> bool:
        return bool(self.sticky or self.random)

    def __str__(self) -> str:
        """`plain`, `sticky 0.25`, `random 0.1`, or both."""
        parts = [f"{name} {value:g}" for name, value in self.to_dict().items() if value]
        return ", ".join(parts) or "plain"


@dataclass(frozen=True)
class Horizon:
    """The number of steps of an episode in values and returns: a number, the environment's time limit, or none.

    Attributes:
        value: a number of steps; "limit": the time limit of the environment; "none": discounted values without a horizon.
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
        if isinstance(setting, int) and not isinstance(setting, bool) and setting >= 1:
            return Horizon(setting)
        raise ParameterError(
            f"horizon: found {setting!r}; expected a number of steps, limit (the environment's), or none"
        )

    def steps(self, env: Environment) -> int | None:
        """The number of steps in an environment; None for discounted values without a horizon."""
        if self.value == "none":
            return None
        return int(env.max_episode_steps if self.value == "limit" else self.value)


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """What determines the result of a training run.

    Attributes:
        environment: name of the class of environments.
        parameters: all parameters of the environment, JSON-able.
        chance: added to the environment.
        observation: name of what the agent sees; "index" for tabular agents.
        observation_options: options of the observation.
        agent: "q_learning", "dqn", "ppo", "a2c", or "module:Class" of an algorithm for Stable-Baselines3.
        hyperparameters: of the agent, which go before those of agents/hyperparameters.yaml.
        steps: number of environment steps to learn from.
        seed: of everything random.
        gamma: discount of values and returns; the agent's own discount is a hyperparameter.
        horizon: number of steps of an episode in values and returns; None: discounted values without a horizon.
        evaluation_interval: steps between evaluations of the policy.
    """

    environment: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    chance: ChanceSetting = ChanceSetting()
    observation: str = "vector"
    observation_options: Mapping[str, Any] = field(default_factory=dict)
    agent: str = "q_learning"
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    steps: int
    seed: int = 0
    gamma: float = 1.0
    horizon: int | None
    evaluation_interval: int

    def __post_init__(self) -> None:
        for name in ("steps", "evaluation_interval"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ParameterError(f"{name} is {value!r}; expected a whole number of at least 1")

    @staticmethod
    def of_task(
        task: "Task",
        agent: str,
        *,
        steps: int,
        seed: int = 0,
        evaluation_interval: int | None = None,
        hyperparameters: Mapping[str, Any] | None = None,
    ) -> "RunConfig":
        """The configuration of a run on a task; it is evaluated every hundredth of `steps` unless told otherwise."""
        return RunConfig(
            environment=task.env.name,
            parameters=json.loads(json.dumps(task.env.parameters)),
            chance=task.chance,
            observation=task.observation,
            observation_options=dict(task.observation_options),
            agent=agent,
            hyperparameters=dict(hyperparameters or {}),
            steps=steps,
            seed=seed,
            gamma=task.gamma,
            horizon=task.horizon_steps,
            evaluation_interval=evaluation_interval or (max(1, steps // 100) if isinstance(steps, int) else 1),
        )

    @staticmethod
    def from_dict(entry: Mapping[str, Any]) -> "RunConfig":
        """Read the `config` of a run.json.

        Raises:
            FileFormatError: an entry is missing, unknown or of another type.
        """
        known = [each.name for each in fields(RunConfig)]
        missing = [name for name in known if name not in entry]
        unknown = [name for name in entry if name not in known]
        if missing or unknown:
            wrong = f"lacks {', '.join(missing)}" if missing else f"has the unknown entry {unknown[0]!r}"
            raise FileFormatError(f"the configuration of a run {wrong}; expected {', '.join(known)}")
        try:
            return RunConfig(**{**entry, "chance": ChanceSetting.from_dict(entry["chance"])})
        except (ParameterError, AttributeError, TypeError) as error:
            raise FileFormatError(f"the configuration of a run is damaged: {error}") from error

    def to_dict(self) -> dict[str, Any]:
        """The `config` of a run.json, JSON-able."""
        return {
            "environment": self.environment,
            "parameters": dict(self.parameters),
            "chance": self.chance.to_dict(),
            "observation": self.observation,
            "observation_options": dict(self.observation_options),
            "agent": self.agent,
            "hyperparameters": dict(self.hyperparameters),
            "steps": self.steps,
            "seed": self.seed,
            "gamma": self.gamma,
            "horizon": self.horizon,
            "evaluation_interval": self.evaluation_interval,
        }

    @property
    def id(self) -> str:
        """The name of the run: a digest of the configuration, the same on every machine."""
        return run_id(self.to_dict())

    @property
    def is_tabular(self) -> bool:
        """Whether the agent learns a table over the states."""
        return agent_kind(self.agent).is_tabular

    def make_environment(self) -> Environment:
        """The environment.

        Raises:
            UnknownName, ParameterError: it does not exist, or not with these parameters.
        """
        return make(self.environment, **{name: as_tuples(value) for name, value in self.parameters.items()})

    def task(self, values: "TaskValues | None" = None) -> "Task":
        """What the agent learns; `values` at its start are not computed again where they are given."""
        from pharos.experiments.task import Task

        return Task(
            self.make_environment(),
            sticky=self.chance.sticky,
            random=self.chance.random,
            observation=self.observation,
            observation_options=dict(self.observation_options),
            gamma=self.gamma,
            horizon=self.horizon,
            values=values,
        )


def run_id(config: Mapping[str, Any]) -> str:
    """The digest of a run's `config`: XXH3 with 64 bits of its sorted JSON, 16 hexadecimal digits."""
    import xxhash

    return xxhash.xxh3_64_hexdigest(json.dumps(config, sort_keys=True, separators=(",", ":")).encode())
