"""What a study runs: a YAML file of blocks, checked key by key, and the list of runs that it stands for.

    name: lakes
    steps: 50000                       # of every block that does not say otherwise; so do evaluations, seeds, gamma,
        horizon
    hyperparameters:
      patient: {learning_rate: 1e-4}
    blocks:
      - environments: [frozen_lake/4x4, {name: frozen_lake, parameters: {size: 6, seed: 1}}]
        chance: [plain, {sticky: 0.25}, {random: 0.1}]
        observations: [vector, {name: simple_image, options: {size: 84}}]
        agents: [dqn, ppo, q_learning]
        hyperparameters: {dqn: patient, ppo: {n_steps: 256}}

A block is the product of its lists. Tabular agents see the index of the state whatever the block's observations are.
Environments, observations and agents of one's own are named as module:Name or file.py:Name, and looked for in
`folder`: that of the YAML file when not given. Such code is imported where the user names the YAML file. It is never
imported where the user names a folder, for the study.yaml beside results, or for a packed study, which somebody else
may have written, unless it is trusted.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from pharos.agents import AGENTS, TABULAR_OBSERVATION, agent_kind, agent_source, hyperparameters, is_known
from pharos.environments import as_tuples, imported, source_of
from pharos.errors import MissingExtra, ParameterError, UnknownName, UntrustedCode
from pharos.experiments import ChanceSetting, Horizon, RunConfig
from pharos.observations import OwnObservation, own_observation
from pharos.sources import is_reference
from pharos.study.regression import MEASURES

try:
    import yaml
    from pydantic import (
        BaseModel,
        BeforeValidator,
        ConfigDict,
        Field,
        PrivateAttr,
        ValidationError,
        ValidationInfo,
        field_validator,
    )
except ImportError as error:
    raise MissingExtra("a study", str(error.name), "study") from error

STUDIES = "studies"
STUDY_FILE = "study.yaml"
# Bounds on a specification, so that every mistake is told at once
MOST_RUNS = 1_000_000
MOST_NODES = 1_000_000
Loc = tuple[int | str, ...]


@dataclass(frozen=True)
class Run:
    """One training run of a study.

    Attributes:
        configuration: what determines its result.
        instance: name of the environment as the specification gives it, such as "frozen_lake/4x4".
    """

    configuration: RunConfig
    instance: str

    @cached_property
    def config(self) -> Mapping[str, Any]:
        """The configuration with the keys of the file run.json."""
        return self.configuration.to_dict()

    @cached_property
    def id(self) -> str:
        """Name of the run's folder: a hash of the config."""
        return self.configuration.id

    @property
    def chance(self) -> str:
        """`plain`, or such as `sticky 0.25`."""
        return str(self.configuration.chance)

    @property
    def kind(self) -> tuple[str, str, str]:
        """Class of environment, agent and observation: runs of a kind take about as long for each step."""
        return (self.configuration.environment, self.configuration.agent, self.configuration.observation)


# The file ------------------------------------------------------------------------------------------------------------


def _entry(value: Any) -> Any:
    return {"name": value} if isinstance(value, str) else value


def _chance(value: Any) -> Any:
    if value == "plain" or value is None:
        return {}
    if isinstance(value, str):
        raise UnknownName("chance", value, ("plain", "{sticky: 0.25}", "{random: 0.1}"))
    return value


def _seeds(value: Any) -> Any:
    if isinstance(value, list):
        return value
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ParameterError(f"seeds: found {value!r}; expected how many, at least 1, or a list of seeds")
    if value > MOST_RUNS:
        raise ParameterError(f"seeds: found {value}; a study has at most {MOST_RUNS:,} runs")
    return list(range(value))


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class EnvironmentEntry(_Part):
    """An environment: a name that `pharos.make` knows, and parameters."""

    name: str
    parameters: dict[str, Any] = {}
    _folder: Path | None = PrivateAttr(None)

    def model_post_init(self, context: Any) -> None:
        self._folder = (context or {}).get("folder") if is_reference(self.name) else None

    @cached_property
    def instance(self) -> Any:
        from pharos.environments import make

        name = imported(self.name, self._folder).name if is_reference(self.name) else self.name
        return make(name, **{name: as_tuples(value) for name, value in self.parameters.items()})

    @cached_property
    def label(self) -> str:
        name = Path(self.name).name if is_reference(self.name) else self.name
        if not self.parameters:
            return name
        return f"{name}({', '.join(f'{name}={value}' for name, value in self.parameters.items())})"


class ChanceEntry(_Part):
    """Probabilities that the previous action, or a uniformly random one, is executed instead of the chosen one."""

    sticky: float = Field(default=0.0, ge=0, le=1)
    random: float = Field(default=0.0, ge=0, le=1)

    @property
    def setting(self) -> ChanceSetting:
        """The same for a run."""
        return ChanceSetting(self.sticky, self.random)


class ObservationEntry(_Part):
    """An observation and its options."""

    name: str
    options: dict[str, Any] = {}
    _folder: Path | None = PrivateAttr(None)

    def model_post_init(self, context: Any) -> None:
        self._folder = (context or {}).get("folder") if is_reference(self.name) else None

    @field_validator("name")
    @classmethod
    def _known(cls, name: str, info: ValidationInfo) -> str:
        from pharos.observations import names

        if is_reference(name):
            own_observation(name, (info.context or {}).get("folder"))
        elif name not in names():
            raise UnknownName("observation", name, names())
        return name

    @cached_property
    def own(self) -> OwnObservation | None:
        """The observation of one's own that is meant; None for one of pharos."""
        return own_observation(self.name, self._folder)


class Hardness(_Part):
    """Which measures of hardness are taken, with which discount, and how many seconds each may take for one
    instance."""

    gamma: float = Field(default=0.99, ge=0, le=1)
    measures: list[str] = Field(default_factory=lambda: [name for name in MEASURES if name in registered()])
    budget: float = Field(default=60.0, gt=0)

    @field_validator("measures")
    @classmethod
    def _known(cls, measures: list[str]) -> list[str]:
        for measure in measures:
            if measure not in registered():
                raise UnknownName("measure of hardness", measure, registered())
        return measures

    @property
    def predictors(self) -> list[str]:
        """Those measures that explain regret in the linear models: the paper's three, or all where none of them is
        taken.

        The stationary effective horizon stands for the effective horizon where that is not taken.
        """
        stand_in = {"effective_horizon": "stationary_effective_horizon"}
        taken = [name if name in self.measures else stand_in.get(name) for name in MEASURES]
        return [name for name in taken if name in self.measures] or list(self.measures)


def _horizon(value: Any) -> Any:
    return Horizon.of(value).value


Seeds = Annotated[list[Annotated[int, Field(ge=0)]], BeforeValidator(_seeds), Field(min_length=1)]
Steps = Annotated[int, Field(ge=1)]
Gamma = Annotated[float, Field(ge=0, le=1)]
HorizonEntry = Annotated[Any, BeforeValidator(_horizon)]


class Block(_Part):
    """A product of environments, kinds of chance, observations, agents and seeds."""

    environments: list[Annotated[EnvironmentEntry, BeforeValidator(_entry)]] = Field(min_length=1)
    chance: list[Annotated[ChanceEntry, BeforeValidator(_chance)]] = Field([ChanceEntry()], min_length=1)
    observations: list[Annotated[ObservationEntry, BeforeValidator(_entry)]] = Field(
        [ObservationEntry(name="vector")], min_length=1
    )
    agents: list[str] = Field(min_length=1)
    seeds: Seeds | None = None
    steps: Steps | None = None
    evaluations: Steps | None = None
    gamma: Gamma | None = None
    horizon: HorizonEntry | None = None
    hyperparameters: dict[str, str | dict[str, Any]] = {}


class Specification(_Part):
    """A study: its blocks, and what holds for every block that does not say otherwise."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    description: str = ""
    folder: str | None = None
    blocks: list[Block] = Field(min_length=1)
    seeds: Seeds = list(range(5))
    steps: Steps = 50_000
    evaluations: Steps = 100
    gamma: Gamma = 1.0
    horizon: HorizonEntry = "limit"
    hyperparameters: dict[str, dict[str, Any]] = {}
    hardness: Hardness = Field(default_factory=Hardness)

    @cached_property
    def runs(self) -> tuple[Run, ...]:
        """Every run, each once, in the order of the blocks."""
        found: dict[str, Run] = {}
        for block in self.blocks:
            for run in self._runs_of(block):
                found.setdefault(run.id, run)
        return tuple(found.values())

    def _runs_of(self, block: Block) -> Iterator[Run]:
        steps = block.steps or self.steps
        evaluations = block.evaluations or self.evaluations
        gamma = self.gamma if block.gamma is None else block.gamma
        horizon = self.horizon if block.horizon is None else block.horizon
        for environment in block.environments:
            for chance in block.chance:
                for agent in block.agents:
                    agent_from = agent_source(agent, self.folder, check=False)
                    observations: Sequence[ObservationEntry] = block.observations
                    if agent_kind(agent).is_tabular:
                        observations = [ObservationEntry(name=TABULAR_OBSERVATION)]
                    for observation in observations:
                        sources = {
                            "environment": source_of(type(environment.instance)),
                            "observation": None if observation.own is None else observation.own.source,
                            "agent": agent_from,
                        }
                        seen = str(observation.own or observation.name)
                        for seed in block.seeds or self.seeds:
                            yield Run(
                                RunConfig(
                                    environment=environment.instance.name,
                                    parameters=_jsonable(environment.instance.parameters),
                                    chance=chance.setting,
                                    observation=seen,
                                    observation_options=dict(observation.options),
                                    agent=agent if agent_from is None else agent_from.name,
                                    hyperparameters=self._hyperparameters(
                                        block, agent, environment.instance.name, seen
                                    ),
                                    steps=steps,
                                    seed=seed,
                                    gamma=gamma,
                                    horizon=Horizon.of(horizon).steps(environment.instance),
                                    evaluation_interval=max(1, steps // evaluations),
                                    sources={part: source for part, source in sources.items() if source is not None},
                                ),
                                environment.label,
                            )

    def _hyperparameters(self, block: Block, agent: str, environment: str, observation: str) -> dict[str, Any]:
        """All of them, those of the library's table included: when that changes, these are other runs."""
        given = block.hyperparameters.get(agent, {})
        own = self.hyperparameters[given] if isinstance(given, str) else given
        return hyperparameters(agent, environment, observation, own)


_PARTS: dict[Loc, type[BaseModel]] = {
    (): Specification,
    ("hardness",): Hardness,
    ("blocks",): Block,
    ("blocks", "environments"): EnvironmentEntry,
    ("blocks", "chance"): ChanceEntry,
    ("blocks", "observations"): ObservationEntry,
}


def registered() -> list[str]:
    """The names of the measures of hardness."""
    from pharos.hardness import measures

    return list(measures())


# Reading -------------------------------------------------------------------------------------------------------------


def presets() -> list[str]:
    """The names of the studies that come with pharos."""
    folder = resources.files("pharos.study").joinpath("presets")
    return sorted(Path(file.name).stem for file in folder.iterdir() if file.name.endswith(".yaml"))


Source = str | Path | Mapping[str, Any] | Specification
"""What is taken for a study: a YAML file, a preset's name, a mapping, a Specification, or the folder of a study."""


def specification(source: Source, *, trust: bool | None = None) -> Specification:
    """The specification in a YAML file or a study's folder, of a preset or a study in `studies` by its name, or from a
    mapping.

    Args:
        trust: whether code that it names may be imported; None: where `source` is a YAML file, but for the study.yaml
            beside results.
    Raises:
        UnknownName: no such file or preset. ParameterError: something in it is wrong; the message names file, line and
            key.
        UntrustedCode: it names code, and is not trusted.
    """
    if isinstance(source, Specification):
        return source
    if isinstance(source, Mapping):
        return _validated(source, "specification", None, Path.cwd(), trust is not False)
    if str(source) in presets():
        file = resources.files("pharos.study").joinpath("presets", f"{source}.yaml")
        return parse(file.read_text(encoding="utf-8"), f"preset {source}")
    path = Path(source)
    if path.is_dir():
        path = path / STUDY_FILE
    if not path.is_file() and (named := study_folder(source)) is not None:
        path = named / STUDY_FILE
    if not path.is_file():
        raise UnknownName("study (no such file, and no such preset)", source, [*presets(), *_studies_here()])
    trusted = path == Path(source) and not _is_of_results(path) if trust is None else trust
    return parse(_text_of(path), str(path), folder=path.absolute().parent, trust=trusted)


def study_folder(source: str | Path) -> Path | None:
    """The folder of a study that is named by its folder, or by its name as one of the folder `studies` here."""
    if Path(source, STUDY_FILE).is_file():
        return Path(source)
    if Path(source).is_file() or str(source) in presets() or not Path(STUDIES, source, STUDY_FILE).is_file():
        return None
    return Path(STUDIES, source)


def _studies_here() -> list[str]:
    return [file.parent.name for file in Path(STUDIES).glob(f"*/{STUDY_FILE}")]


def study_name(file: Path) -> str | None:
    """The name in a YAML file of a study, which is not looked at otherwise; None where there is none."""
    try:
        data = yaml.load(_text_of(file), _Loader)
    except (yaml.YAMLError, ParameterError, ValueError, RecursionError, OverflowError):
        return None
    name = data.get("name") if isinstance(data, dict) else None
    return name if isinstance(name, str) else None


def _is_of_results(path: Path) -> bool:
    """Whether a YAML file is what a runner wrote beside its results, which may come from somebody else."""
    return path.name == STUDY_FILE and any((path.parent / name).exists() for name in ("runs", "partial", "status.json"))


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ParameterError(f"{path}: byte {error.start} is not UTF-8; expected a text file in YAML") from error
    except OSError as error:
        raise ParameterError(f"{path}: cannot be read ({error.strerror}); expected a YAML file") from error


def parse(text: str, name: str = "specification", *, folder: Path | None = None, trust: bool = False) -> Specification:
    """The specification in a text of YAML.

    Args:
        name: stands before the line number in messages.
        folder: where modules and files that it names are looked for; None: in the current directory.
        trust: whether they may be imported.
    """
    try:
        root = yaml.compose(text, _Loader)
        if root is None:
            raise ParameterError(f"{name}: is empty; expected a mapping with name and blocks")
        _check_nodes(root, name)
        data = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{name}:{mark.line + 1}" if mark is not None else name
        problem = getattr(error, "problem", None) or "this is no YAML"
        raise ParameterError(f"{where}: {problem}") from error
    except RecursionError:
        raise ParameterError(f"{name}: is nested too deeply; expected a mapping with name and blocks") from None
    except ParameterError:
        raise
    except (ValueError, OverflowError) as error:  # numbers and dates that Python cannot hold
        raise ParameterError(f"{name}: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise ParameterError(f"{name}:1: found {type(data).__name__}; expected a mapping with name and blocks")
    return _validated(data, name, root, folder or Path.cwd(), trust)


class _Loader(yaml.SafeLoader):
    """Safe YAML in which 1e-4 is a number, not a text."""


_Loader.yaml_implicit_resolvers = {k: list(v) for k, v in yaml.SafeLoader.yaml_implicit_resolvers.items()}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+0123456789.")
)


def _validated(data: Mapping[str, Any], name: str, root: Any, folder: Path, trust: bool) -> Specification:
    references = [*_references(data)]
    if references and not trust:
        loc, reference = references[0]
        raise UntrustedCode(
            f"{_where(name, root, loc)}: {reference!r} is code, which is executed only if you trust it: add --trust "
            f"(in Python: trust=True), or name your own YAML file"
        )
    if references:
        written = data.get("folder")
        folder = (folder / written if isinstance(written, str) else folder).resolve()
        data = {**data, "folder": str(folder)}
    try:
        found = Specification.model_validate(data, context={"folder": folder})
    except ValidationError as error:
        raise ParameterError(_messages(error, name, root)) from error
    wrong = [*_wrong(found)]
    if wrong:
        raise ParameterError("; ".join(f"{_where(name, root, loc)}: {message}" for loc, message in wrong))
    return found


def _references(data: Mapping[str, Any]) -> Iterator[tuple[Loc, str]]:
    """(where, name) of environments, observations and agents of one's own in data that may be anything."""
    blocks = data.get("blocks")
    for i, block in enumerate(blocks if isinstance(blocks, list) else ()):
        for part in ("environments", "observations", "agents"):
            entries = block.get(part) if isinstance(block, Mapping) else None
            for j, entry in enumerate(entries if isinstance(entries, list) else ()):
                name = entry.get("name") if isinstance(entry, Mapping) else entry
                if isinstance(name, str) and is_reference(name) and not (part == "agents" and is_known(name)):
                    yield ("blocks", i, part, j), name


def _wrong(found: Specification) -> Iterator[tuple[Loc, str]]:
    """What only the whole specification shows: names of agents and of hyperparameters, environments that cannot be
    made."""
    number = 0
    for i, block in enumerate(found.blocks):
        kinds = len(block.environments) * len(block.chance) * len(block.agents) * len(block.observations)
        number += kinds * len(block.seeds or found.seeds)
        if number > MOST_RUNS:
            yield ("blocks", i), f"{number:,} runs up to here; a study has at most {MOST_RUNS:,}"
            return
        for j, entry in enumerate(block.environments):
            try:
                _ = entry.instance
            except ParameterError as error:
                yield ("blocks", i, "environments", j), str(error)
        gamma = found.gamma if block.gamma is None else block.gamma
        if (block.horizon or found.horizon) == "none" and gamma == 1:
            yield ("blocks", i), "gamma is 1 and horizon is none, so values may be infinite; expected a gamma below 1"
        for j, agent in enumerate(block.agents):
            try:
                if agent not in AGENTS and not is_reference(agent):
                    raise UnknownName("agent", agent, AGENTS)
                agent_source(agent, found.folder, check=False)
            except ParameterError as error:
                yield ("blocks", i, "agents", j), str(error)
        for agent, given in block.hyperparameters.items():
            loc = ("blocks", i, "hyperparameters", agent)
            if agent not in block.agents:
                yield loc, str(UnknownName("agent of this block", agent, block.agents))
            elif isinstance(given, str) and given not in found.hyperparameters:
                yield loc, str(UnknownName("set of hyperparameters", given, found.hyperparameters))


def _messages(error: ValidationError, name: str, root: Any) -> str:
    said: dict[str, None] = {}
    for problem in error.errors():
        loc = problem["loc"]
        if "hyperparameters" in loc and loc[-1] in ("str", "dict[str,any]"):
            loc = loc[:-1]
        key = str(loc[-1]) if loc else ""
        if problem["type"] == "extra_forbidden":
            part = _PARTS.get(tuple(part for part in loc[:-1] if isinstance(part, str)))
            message = str(UnknownName("key", key, part.model_fields if part else ()))
        elif problem["type"] == "missing":
            message = f"the key {key!r} is missing"
            loc = loc[:-1]
        elif problem["type"] == "value_error":
            message = str(problem["ctx"]["error"])
        else:
            expected = problem["msg"][0].lower() + problem["msg"][1:]
            message = f"{key}: found {problem['input']!r}; expected: {expected.removeprefix('input should be ')}"
        said[f"{_where(name, root, loc)}: {message}"] = None
    return "; ".join(said)


def _where(name: str, root: Any, loc: Loc) -> str:
    """`file:line`, the line of the innermost node on the path that exists; the path itself where there is no file."""
    if root is None:
        return ".".join(map(str, (name, *loc)))
    node, line = root, root.start_mark.line
    for part in loc:
        if isinstance(node, yaml.MappingNode):
            pair = next(((key, value) for key, value in node.value if key.value == str(part)), None)
            if pair is None:
                break
            line, node = pair[0].start_mark.line, pair[1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
            line = node.start_mark.line
        else:
            break
    return f"{name}:{line + 1}"


def _check_nodes(root: Any, name: str) -> None:
    """Refuse what no specification needs: keys that are no words or repeated, nodes within themselves, millions by
    aliases.

    A node that aliases share is looked at once; its size counts wherever it stands.
    """
    sizes: dict[int, int] = {}

    def size(node: Any) -> int:
        """How many nodes stand below this one, aliases written out."""
        if id(node) in sizes:
            if not sizes[id(node)]:
                raise ParameterError(f"{name}:{node.start_mark.line + 1}: an alias stands within what it names")
            return sizes[id(node)]
        sizes[id(node)] = 0  # until all below it are counted
        children: list[Any] = []
        if isinstance(node, yaml.MappingNode):
            _check_keys(node, name)
            children = [value for _, value in node.value]
        elif isinstance(node, yaml.SequenceNode):
            children = node.value
        total = 1 + sum(map(size, children))
        if total > MOST_NODES:
            line = node.start_mark.line + 1
            raise ParameterError(f"{name}:{line}: stands for more than {MOST_NODES:,} entries, aliases written out")
        sizes[id(node)] = total
        return total

    size(root)


def _check_keys(node: Any, name: str) -> None:
    lines: dict[str, int] = {}
    for key, _ in node.value:
        line = key.start_mark.line + 1
        if not isinstance(key, yaml.ScalarNode):
            raise ParameterError(f"{name}:{line}: a key is a list or a mapping; expected a word")
        if key.value in lines:
            raise ParameterError(f"{name}:{line}: the key {key.value!r} stands there twice (line {lines[key.value]})")
        lines[key.value] = line


def _jsonable(value: Any) -> Any:
    return json.loads(json.dumps(value))
