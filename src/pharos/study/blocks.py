"""Parts of the YAML file of a study, as pydantic models, and the runs that they stand for."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from pharos.agents import agent_called, agent_source, hyperparameters
from pharos.environments import Environment, as_tuples, class_source, import_class, make
from pharos.errors import MissingExtra, ParameterError, UnknownName
from pharos.observations import OwnObservation, check_options, names, own_observation, title
from pharos.study.regression import MODEL_MEASURES
from pharos.system.sources import is_reference
from pharos.system.storage import check_name
from pharos.training import ENGINES, ChanceSetting, Horizon, RunConfig

try:
    import yaml
    from pydantic import (
        AfterValidator,
        BaseModel,
        BeforeValidator,
        ConfigDict,
        Field,
        PlainSerializer,
        PlainValidator,
        PrivateAttr,
        ValidationInfo,
        field_validator,
    )
except ImportError as error:
    raise MissingExtra("a study", str(error.name).replace("yaml", "pyyaml"), "study") from error

# Limit that reports a mistake in a number of seeds at once
MOST_RUNS = 1_000_000
NAME = r"^([A-Za-z0-9][A-Za-z0-9 ._-]*)?$"


@dataclass(frozen=True)
class Run:
    """One training run of a study.

    Attributes:
        configuration: what determines its result.
        instance: name of the environment as the specification gives it, such as "frozen_lake/4x4".
        engine: "batched" if it is trained together with others. A table is, too, though its configuration does not say
            so.
        family: what it counts as when classes are compared: the class of its environment, unless the study says else.
        setting: name that distinguishes its cell from other blocks, if the study has one: "tuned".
        observation: the name of its observation in tables.
    """

    configuration: RunConfig
    instance: str
    engine: str = "sb3"
    family: str = ""
    setting: str = ""
    observation: str = ""

    def __post_init__(self) -> None:
        if not self.observation:
            object.__setattr__(self, "observation", self._title())

    def _title(self, *, whole: bool = False) -> str:
        config = self.configuration
        return title(config.observation, config.observation_options, whole=whole)

    @cached_property
    def config(self) -> Mapping[str, Any]:
        """The configuration with the keys of the file run.json."""
        return self.configuration.to_dict()

    @cached_property
    def id(self) -> str:
        """Name of the run's folder: a hash of the config."""
        return self.configuration.id

    @property
    def cell(self) -> dict[str, str]:
        """The cell of the grid that the run is a seed of, by the columns of tables."""
        config = self.configuration
        return {
            "environment": self.family or config.environment,
            "instance": self.instance,
            "chance": self.chance,
            "agent": f"{config.agent} {self.setting}".rstrip(),
            "observation": self.observation,
        }

    @property
    def chance(self) -> str:
        """The kind of chance: `plain`, or such as `sticky 0.25`."""
        return str(self.configuration.chance)

    @property
    def chance_in_words(self) -> str:
        """The kind of chance as cells name it, and "(and of the world)" if the rules have chance."""
        return self.chance + " (and of the world)" * self.configuration.task(trust=True).env.has_chance

    @property
    def kind(self) -> tuple[str, str, str, str]:
        """Class of environment, agent, observation, engine: runs of a kind take about as long for each step."""
        config = self.configuration
        return (config.environment, config.agent, config.observation, config.engine)


def _entry(value: object) -> object:
    return {"name": value} if isinstance(value, str) else value


def _chance(value: object) -> ChanceSetting:
    if isinstance(value, Mapping):
        return ChanceSetting.from_dict({name: float(p) if type(p) is int else p for name, p in value.items()})
    if value not in ("plain", None):
        raise UnknownName("chance", value, ("plain", "{sticky: 0.25}", "{random: 0.1}"))
    return ChanceSetting()


def _seeds(value: object) -> object:
    if isinstance(value, list):
        return value
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ParameterError(f"seeds: found {value!r}; expected how many, at least 1, or a list of seeds")
    if value > MOST_RUNS:
        raise ParameterError(f"seeds: found {value}; a study has at most {MOST_RUNS:,} runs")
    return list(range(value))


def _number(value: object) -> object:
    if isinstance(value, bool):  # which pydantic, as Python, counts as 0 or 1
        raise ParameterError(f"found {value!r}; expected a number")
    return value


Gamma = Annotated[float, BeforeValidator(_number), Field(ge=0, le=1)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Named(_Part):
    """An entry with a name. A name of the user's own code is looked for in a folder."""

    name: str
    _folder: Path | None = PrivateAttr(None)

    def model_post_init(self, context: dict[str, Any] | None) -> None:
        self._folder = (context or {}).get("folder") if is_reference(self.name) else None


class ObservationEntry(_Named):
    """An observation and its options."""

    options: dict[str, Any] = {}

    @field_validator("name")
    @classmethod
    def _known(cls, name: str, info: ValidationInfo) -> str:
        if is_reference(name):
            own_observation(name, (info.context or {}).get("folder"))
        elif name not in names():
            raise UnknownName("observation", name, names())
        return name

    @field_validator("options")
    @classmethod
    def _are_known(cls, options: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        if name := info.data.get("name"):  # else the name is wrong, and told
            check_options(own_observation(name, (info.context or {}).get("folder")) or name, options)
        return options

    @cached_property
    def own(self) -> OwnObservation | None:
        """The user's own observation of that name, or None for one of pharos."""
        return own_observation(self.name, self._folder)


class EnvironmentEntry(_Named):
    """An environment: a name that `pharos.make` knows, and parameters. Also the class it counts as, if not its own, and
    what is seen of it, if not what its block says."""

    parameters: dict[str, Any] = {}
    family: str = Field("", pattern=NAME)
    observations: list[Annotated[ObservationEntry, BeforeValidator(_entry)]] | None = Field(None, min_length=1)

    @cached_property
    def instance(self) -> Environment:
        name = import_class(self.name, self._folder).name if is_reference(self.name) else self.name
        return make(name, **{name: as_tuples(value) for name, value in self.parameters.items()})

    @property
    def is_imported(self) -> bool:
        """Whether it is the folder of an imported MDP."""
        return bool(self.instance.name == "imported")

    @property
    def counts_as(self) -> str:
        """Its family. For an imported MDP without one, its label. Empty if the class of the environment counts."""
        return self.family or (self.label if self.is_imported else "")

    @cached_property
    def label(self) -> str:
        name = Path(self.name).name if is_reference(self.name) or self.is_imported else self.name
        if not self.parameters:
            return name
        return f"{name}({', '.join(f'{name}={value}' for name, value in self.parameters.items())})"


class Hardness(_Part):
    """Measures of hardness that are computed, their discount, and the seconds that each may take for one instance."""

    gamma: Gamma = 0.99
    measures: list[str] = Field(default_factory=lambda: [name for name in MODEL_MEASURES if name in registered_names()])
    budget: Annotated[float, BeforeValidator(_number)] = Field(default=60.0, gt=0)

    @field_validator("measures")
    @classmethod
    def _known(cls, measures: list[str]) -> list[str]:
        for measure in measures:
            if measure not in registered_names():
                raise UnknownName("measure of hardness", measure, registered_names())
        return measures

    @property
    def predictors(self) -> list[str]:
        """Measures that explain regret in the linear models: the paper's three, or all if none of them is taken.

        The stationary effective horizon stands for the effective horizon if that is not taken.
        """
        stand_in = {"effective_horizon": "stationary_effective_horizon"}
        names = [name if name in self.measures else stand_in.get(name) for name in MODEL_MEASURES]
        return [name for name in names if name in self.measures] or list(self.measures)


def _engines(value: object) -> object:
    for engine in value.values() if isinstance(value, dict) else [value]:
        if engine not in ENGINES:
            raise UnknownName("engine", engine, ENGINES)
    return value


def _horizon(value: Horizon | int | str | None) -> int | str:
    return Horizon.of(value).value


Seeds = Annotated[
    list[Annotated[int, BeforeValidator(_number), Field(ge=0)]], BeforeValidator(_seeds), Field(min_length=1)
]
StepCount = Annotated[int, BeforeValidator(_number), Field(ge=1)]
ChanceEntry = Annotated[
    ChanceSetting, PlainValidator(_chance), PlainSerializer(lambda chance: {k: p for k, p in vars(chance).items() if p})
]
EngineEntry = Annotated[str | dict[str, str], BeforeValidator(_engines)]
HorizonEntry = Annotated[Any, BeforeValidator(_horizon)]


class Block(_Part):
    """A product of environments, kinds of chance, observations, agents and seeds."""

    environments: list[Annotated[EnvironmentEntry, BeforeValidator(_entry)]] = Field(min_length=1)
    chance: list[ChanceEntry] = Field([ChanceSetting()], min_length=1)
    observations: list[Annotated[ObservationEntry, BeforeValidator(_entry)]] = Field(
        [ObservationEntry(name="vector")], min_length=1
    )
    agents: list[str] = Field(min_length=1)
    setting: str = Field("", pattern=NAME)
    seeds: Seeds | None = None
    steps: StepCount | None = None
    evaluations: StepCount | None = None
    gamma: Gamma | None = None
    horizon: HorizonEntry | None = None
    hyperparameters: dict[str, str | dict[str, Any]] = {}
    engine: EngineEntry | None = None


class Specification(_Part):
    """Specification of a study: its blocks, and the settings of those that have none of their own."""

    name: Annotated[str, AfterValidator(check_name)]
    description: str = ""
    folder: str | None = None
    blocks: list[Block] = Field(min_length=1)
    seeds: Seeds = list(range(5))
    steps: StepCount = 50_000
    evaluations: StepCount = 100
    gamma: Gamma = 1.0
    horizon: HorizonEntry = "limit"
    hyperparameters: dict[str, dict[str, Any]] = {}
    defaults: dict[str, dict[str, dict[str, dict[str, Any]]]] = {}
    engine: EngineEntry = "sb3"
    hardness: Hardness = Field(default_factory=Hardness)

    @cached_property
    def runs(self) -> tuple[Run, ...]:
        """Every run, each once, in the order of the blocks."""
        runs: dict[str, Run] = {}
        for block in self.blocks:
            for run in self.runs_of(block):
                runs.setdefault(run.id, run)
        options: dict[str, set[str]] = {}  # of the observations that share a title
        for run in runs.values():
            options.setdefault(run.observation, set()).add(str(run.configuration.observation_options))
        shared = {name for name, all_options in options.items() if len(all_options) > 1}
        return tuple(
            replace(run, observation=run._title(whole=True)) if run.observation in shared else run
            for run in runs.values()
        )

    def to_yaml(self, **changes: object) -> str:
        """Text of a YAML file with these entries. `changes` replace some of them."""
        entries = self.model_dump(mode="json", exclude_unset=True)
        entries |= {name: value for name, value in changes.items() if name in entries}
        return yaml.safe_dump(entries, sort_keys=False, width=120)

    def runs_of(self, block: Block) -> Iterator[Run]:
        """The runs of one block."""
        names = ("steps", "evaluations", "gamma", "horizon", "seeds")
        steps, evaluations, gamma, horizon, seeds = (self.option_of(block, name) for name in names)
        for environment, chance, agent in product(block.environments, block.chance, block.agents):
            instance, agent_from = environment.instance, agent_source(agent, self.folder, check=False)
            observations: Sequence[ObservationEntry] = environment.observations or block.observations
            # Tabular agents see the state itself, whatever the block says
            if (fixed := agent_called(agent).fixed_observation) is not None:
                observations = [ObservationEntry(name=fixed)]
            # A run for each observation and seed
            for observation, seed in product(observations, seeds):
                sources = {
                    "environment": class_source(type(instance)),
                    "observation": None if observation.own is None else observation.own.source,
                    "agent": agent_from,
                }
                observation_name, engine = str(observation.own or observation.name), self.engine_of(block, agent)
                config = RunConfig(
                    environment=instance.name,
                    parameters=_jsonable(instance.parameters),
                    chance=chance,
                    observation=observation_name,
                    observation_options=dict(observation.options),
                    agent=agent if agent_from is None else agent_from.name,
                    hyperparameters=self._hyperparameters(block, agent, instance.name, observation_name),
                    steps=steps,
                    seed=seed,
                    gamma=gamma,
                    horizon=Horizon.of(horizon).steps(instance),
                    evaluation_interval=max(1, steps // evaluations),
                    engine=engine,
                    sources={part: source for part, source in sources.items() if source is not None},
                )
                yield Run(config, environment.label, engine, environment.counts_as, block.setting)

    def option_of(self, block: Block, name: str) -> Any:
        """The option of a block, or else of the study: steps, evaluations, gamma, horizon, seeds or engine."""
        own = getattr(block, name)
        return getattr(self, name) if own is None else own

    def engine_of(self, block: Block, agent: str) -> str:
        """The engine that trains an agent of a block: "sb3" or "batched"."""
        engine = self.option_of(block, "engine")
        return engine if isinstance(engine, str) else engine.get(agent, "sb3")

    def _hyperparameters(self, block: Block, agent: str, environment: str, observation: str) -> dict[str, Any]:
        """Every hyperparameter, with defaults of the study, else of the library: with others these are other runs."""
        entry = block.hyperparameters.get(agent, {})
        own = self.hyperparameters[entry] if isinstance(entry, str) else entry
        usual = self.defaults.get(agent, {}).get(environment, {}).get(observation)
        if usual is not None:
            return {**usual, **own}
        return hyperparameters(agent, environment, observation, own)


def registered_names() -> list[str]:
    """The names of the measures of hardness."""
    from pharos.hardness import measures

    return list(measures())


def _jsonable(value: Mapping[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(value))


def part_of(
    study: Specification,
    blocks: Sequence[int] | None,
    agents: Sequence[str] | None,
    observations: Sequence[str] | None,
) -> Iterator[Run]:
    """Runs of some blocks, counted from 1, agents and observations. None: of all.

    Raises:
        ParameterError: one of these is not in the study.
    """
    runs = study.runs
    if blocks is not None:
        wrong = [block for block in blocks if not 1 <= block <= len(study.blocks)]
        if wrong:
            raise ParameterError(f"block {wrong[0]}: study {study.name!r} has blocks 1 to {len(study.blocks)}")
        ids = {run.id for block in blocks for run in study.runs_of(study.blocks[block - 1])}
        runs = tuple(run for run in runs if run.id in ids)
    for what, some, name_of in (
        ("agent", agents, lambda run: run.configuration.agent),
        ("observation", observations, lambda run: run.configuration.observation),
    ):
        unknown = {*(some or ())} - {name_of(run) for run in runs}
        if unknown:
            raise UnknownName(f"{what} of study {study.name!r}", min(unknown), sorted({name_of(run) for run in runs}))
    for run in runs:
        if agents is not None and run.configuration.agent not in agents:
            continue
        if observations is None or run.configuration.observation in observations:
            yield run
