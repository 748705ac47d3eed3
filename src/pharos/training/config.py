"""The configuration of a run: everything that determines its result, as run.json keeps it.

`RunConfig` is what `train`, `tune`, studies and the command line make of `TrainingOptions`, and what a stored run is
read back into. Its `id` names the run: the same configuration has the same id on every machine.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pharos.agents import BATCHED, agent_kind, agent_source, is_known
from pharos.environments import Environment, as_tuples, class_called, class_of, make, source_of
from pharos.errors import FileFormatError, ParameterError, UnknownName, UntrustedCode
from pharos.observations import OwnObservation, observation_of, registered
from pharos.system.records import flat, read
from pharos.system.sources import Source, is_reference, resolve
from pharos.training.options import ENGINES, TrainingOptions

if TYPE_CHECKING:
    from pharos.training.task import Task, TaskValues

CELL = ["environment", "instance", "chance", "agent", "observation"]  # columns that tell the cells of a study
# In the order of run.json
KEYS = (
    *("environment", "parameters", "chance", "observation", "observation_options", "agent", "hyperparameters", "steps"),
    *("seed", "gamma", "horizon", "evaluation_interval", "engine", "sources"),
)


@flat
@dataclass(frozen=True, kw_only=True)
class RunConfig(TrainingOptions):
    """What determines the result of a training run: the options of training, on an environment, with a seed.

    Attributes:
        environment: name of the class of environments.
        parameters: all parameters of the environment, JSON-able.
        seed: of everything random.
        horizon: number of steps of an episode in values and returns; None: discounted values without a horizon.
        evaluation_interval: steps between evaluations of the policy.
        hyperparameters: of the agent, which go before those of agents/hyperparameters.py.
        engine: what trains networks, one of ENGINES. Tables are the same with each, so theirs is always "sb3"; `id` and
            `to_dict` have it only where it is another.
        sources: where a class, observation or agent of the user's own comes from, under "environment", "observation"
            and "agent". Their names belong to the `id`; files and checksums do not.
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
        if self.is_tabular:
            object.__setattr__(self, "engine", "sb3")
        elif self.engine == "batched" and self.agent not in BATCHED:
            raise ParameterError(
                f"agent {self.agent!r}: the batched engine has {', '.join(BATCHED)} and q_learning; "
                f"the engine sb3 has {self.agent!r}"
            )
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
        """The configuration of a run on a task; it is evaluated every hundredth of `steps` unless told otherwise.

        Args:
            agent: `module:Class` and `file.py:Class` are looked for in the current directory.
        """
        observation = task.observation
        sources = {
            "environment": source_of(type(task.env)),
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
            return read(RunConfig, entry, "the configuration of a run", optional=("engine", "sources"))
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
        ordered = {name: entry[name] for name in KEYS if name in entry}
        return {name: dict(value) if isinstance(value, Mapping) else value for name, value in ordered.items()}

    @property
    def id(self) -> str:
        """The name of the run: a digest of the configuration, the same on every machine."""
        return run_id(self.to_dict())

    @property
    def is_tabular(self) -> bool:
        """Whether the agent learns a table over the states."""
        return agent_kind(self.agent).is_tabular

    def make_environment(self, *, trust: bool = False, strict: bool = False) -> Environment:
        """The environment.

        Args:
            trust: whether code of the user's own may be imported; what was imported before needs no trust.
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
        """What the agent learns.

        Args:
            values: at the start, which are not computed again where they are given.
            trust, strict: as for `make_environment`.
        """
        from pharos.training.task import Task

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
            values=values,
        )

    @property
    def definitions(self) -> tuple[Any, ...]:
        """The registered class of its environment, and what its observation was registered with, where they are."""
        return (class_called(self.environment), *(registered(self.observation) or ()))

    def algorithm(self, *, trust: bool = False, strict: bool = False) -> "str | type":
        """The agent: its name, or the class of the user's own.

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
            raise UntrustedCode(
                f"the {part} {name!r} is code, which is executed only if you trust it: "
                f"add --trust (in Python: trust=True)"
            )


def run_id(config: Mapping[str, Any]) -> str:
    """The digest of a run's `config`: XXH3 with 64 bits of its sorted JSON, 16 hexadecimal digits.

    Of code of the user's own its name counts, not where it lies, so that the id is the same on every machine.
    """
    import xxhash

    sources = config.get("sources")
    if isinstance(sources, Mapping):
        names = {
            part: source.get("name") if isinstance(source, Mapping) else source for part, source in sources.items()
        }
        config = {**config, "sources": names}
    return xxhash.xxh3_64_hexdigest(json.dumps(config, sort_keys=True, separators=(",", ":")).encode())
