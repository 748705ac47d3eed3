"""Specification of a study: a YAML file of blocks, checked key by key, and the list of runs that it stands for.

    name: lakes
    steps: 50000                       # of every block that does not say otherwise; so do evaluations, seeds, gamma,
        horizon
    hyperparameters:
      patient: {learning_rate: 1e-4}
    blocks:
      - environments: [frozen_lake/4x4, {name: frozen_lake, parameters: {size: 6, seed: 1}}]
        chance: [plain, {sticky: 0.25}, {random: 0.1}]
        observations: [vector, {name: simple_image, options: {grey: true}}]
        agents: [dqn, ppo, q_learning]
        hyperparameters: {dqn: patient, ppo: {n_steps: 256}}
        engine: {dqn: batched}         # or a word for all agents; of the study if a block does not say

A block is the product of its lists. Tabular agents see the index of the state whatever the block's observations are.
Environments, observations and agents of one's own are named as module:Name or file.py:Name, and looked for in
`folder`, by default the folder of the YAML file. Such code is imported if the user names the YAML file. It is never
imported if the user names a folder, for the study.yaml beside results, or for a packed study, which somebody else
may have written, unless it is trusted.

Messages name the line of the node of the YAML file that they are about.
"""

import os
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from pharos.agents import agent_called, agent_source, agents, is_known
from pharos.environments import class_called, classes
from pharos.errors import ParameterError, UnknownName
from pharos.observations import names
from pharos.study.blocks import (
    MOST_RUNS,
    Block,
    EnvironmentEntry,
    Hardness,
    ObservationEntry,
    Specification,
)
from pharos.system import mdp_files
from pharos.system.sources import is_reference, untrusted_code
from pharos.system.yaml_files import nodes_and_data, read_text

Loc = tuple[int | str, ...]


def where(name: str, root: "yaml.Node | None", loc: Loc) -> str:
    """`file:line`, the line of the innermost node on the path that exists, or the path itself if there is no file."""
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


STUDIES = "studies"
GIVEN = "given"
STUDY_FILE = "study.yaml"


_SPECIFICATION_PARTS: dict[Loc, type[BaseModel]] = {
    (): Specification,
    ("hardness",): Hardness,
    ("blocks",): Block,
    ("blocks", "environments"): EnvironmentEntry,
    ("blocks", "observations"): ObservationEntry,
}


def presets() -> list[str]:
    """The names of the studies that come with pharos."""
    folder = resources.files("pharos.study").joinpath("presets")
    return sorted(Path(file.name).stem for file in folder.iterdir() if file.name.endswith(".yaml"))


Source = str | Path | Mapping[str, Any] | Specification
"""What is taken for a study: a YAML file, a preset's name, a mapping, a Specification, or the folder of a study."""


def specification(
    source: Source, *, trust: bool | None = None, environments: str | os.PathLike | None = None
) -> Specification:
    """The specification in a YAML file or a study's folder, of a preset or a study in `studies` by its name, or from a
    mapping.

    Args:
        environments: a YAML file with a list of environments, for blocks that say `environments: given`, see
            `given_environments`.
        trust: whether code that it names may be imported. Default: if `source` is a YAML file, but for the study.yaml
            beside results.
    Raises:
        UnknownName: no such file or preset. ParameterError: something in it is wrong. The message names file, line and
        key.
        UntrustedCode: it names code, and is not trusted.
    """
    if isinstance(source, Specification):
        return source
    entries = None if environments is None else given_environments(environments, trust=bool(trust))
    if isinstance(source, Mapping):
        return _validated(source, "specification", None, Path.cwd(), trust is not False, entries)
    if str(source) in presets():
        file = resources.files("pharos.study").joinpath("presets", f"{source}.yaml")
        folder = None if environments is None else Path(environments).absolute().parent
        text = file.read_text(encoding="utf-8")
        return parse(text, f"preset {source}", folder=folder, trust=bool(trust), entries=entries)
    path = Path(source)
    if path.is_dir():
        path = path / STUDY_FILE
    if not path.is_file() and (named := study_folder(source)) is not None:
        path = named / STUDY_FILE
    if not path.is_file():
        raise UnknownName("study (no such file, and no such preset)", source, [*presets(), *_studies_here()])
    trusted = path == Path(source) and not _is_of_results(path) if trust is None else trust
    return parse(read_text(path), str(path), folder=path.absolute().parent, trust=trusted, entries=entries)


def given_environments(file: str | os.PathLike, *, trust: bool = False) -> list[Any]:
    """The list in a YAML file: entries as under `environments:` of a block. Folders are looked for beside the file.

        - taxi/5x5
        - {name: taxi, parameters: {size: 7}}
        - {name: folders/lava, family: lava, observations: [recorded, one_hot]}     # an imported MDP, and what it shows
        - {name: "games.py:Snake", parameters: {rows: 2}}                           # a class of one's own

    Args:
        trust: whether your own classes may be imported. A preset looks for their files beside the list, a study's
            own YAML file beside itself.
    Raises:
        ParameterError: it is no such list. UntrustedCode: it names code, and is not trusted.
    """
    path = Path(file)
    _, entries = nodes_and_data(read_text(path), str(path))
    if not isinstance(entries, list) or not entries or not all(isinstance(each, str | dict) for each in entries):
        raise ParameterError(
            f"{path}: expected a list of environments, such as `- taxi/5x5` and `- {{name: taxi, ...}}`"
        )
    result = []
    for entry in entries:
        entry = {"name": entry} if isinstance(entry, str) else entry
        name = entry.get("name")
        if isinstance(name, str) and mdp_files.is_folder(path.parent / name):
            entry = {**entry, "name": str((path.parent / name).absolute())}
        elif isinstance(name, str) and is_reference(name) and not trust:
            raise untrusted_code(f"{path}: {name!r}")
        try:
            context = {"folder": path.absolute().parent}
            _ = EnvironmentEntry.model_validate(entry, context=context).instance
        except ValidationError as error:
            raise ParameterError(_messages(error, str(path), None)) from error
        except ParameterError as error:
            raise ParameterError(f"{path}: {error}") from error
        result.append(entry)
    return result


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
    """The name in a YAML file of a study, which is not looked at otherwise. None if there is none."""
    try:
        _, data = nodes_and_data(read_text(file), str(file))
    except ParameterError:
        return None
    name = data.get("name") if isinstance(data, dict) else None
    return name if isinstance(name, str) else None


def _is_of_results(path: Path) -> bool:
    """Whether a YAML file is what a runner wrote beside its results, which may come from somebody else."""
    return path.name == STUDY_FILE and any((path.parent / name).exists() for name in ("runs", "partial", "status.json"))


def parse(
    text: str,
    name: str = "specification",
    *,
    folder: Path | None = None,
    trust: bool = False,
    entries: list[Any] | None = None,
) -> Specification:
    """The specification in a text of YAML.

    Args:
        name: stands before the line number in messages.
        folder: of the modules and files that it names. Default: the current directory.
        trust: whether they may be imported.
        entries: the environments of blocks that say `environments: given`.
    """
    root, data = nodes_and_data(text, name)
    if root is None:
        raise ParameterError(f"{name}: is empty; expected a mapping with name and blocks")
    if not isinstance(data, dict):
        raise ParameterError(f"{name}:1: found {type(data).__name__}; expected a mapping with name and blocks")
    return _validated(data, name, root, folder or Path.cwd(), trust, entries)


def _validated(
    data: Mapping[str, Any], name: str, root: object, folder: Path, trust: bool, entries: list[Any] | None = None
) -> Specification:
    data = _with_environments(data, name, entries)
    references = [*_references(data)]
    if references and not trust:
        loc, reference = references[0]
        alternative = f", or name your own YAML file, which is no {STUDY_FILE} beside results"
        raise untrusted_code(f"{where(name, root, loc)}: {reference!r}", alternative)
    if references:
        written = data.get("folder")
        folder = (folder / written if isinstance(written, str) else folder).resolve()
        data = {**data, "folder": str(folder)}
    try:
        specification = Specification.model_validate(data, context={"folder": folder})
    except ValidationError as error:
        raise ParameterError(_messages(error, name, root)) from error
    wrong = [*_wrong(specification)]
    if wrong:
        raise ParameterError("; ".join(f"{where(name, root, loc)}: {message}" for loc, message in wrong))
    return specification


def _with_environments(data: Mapping[str, Any], name: str, entries: list[Any] | None) -> Mapping[str, Any]:
    """The data with the given environments in blocks that ask for them.

    Raises:
        ParameterError: some ask and none are given, or none asks.
    """
    blocks = data.get("blocks")
    listed = blocks if isinstance(blocks, list) else []
    are_open = [isinstance(block, Mapping) and block.get("environments") == GIVEN for block in listed]
    if any(are_open) and entries is None:
        raise ParameterError(
            f"{name}: has no environments of its own; give a list of them, --environments FILE, or the folder of a "
            f"study that was run with one"
        )
    if entries is None:
        return data
    if not any(are_open):
        raise ParameterError(
            f"{name}: has environments of its own; --environments is for blocks with `environments: given`"
        )
    pairs = zip(listed, are_open, strict=True)
    return {**data, "blocks": [{**block, "environments": entries} if is_open else block for block, is_open in pairs]}


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


def _wrong(specification: Specification) -> Iterator[tuple[Loc, str]]:
    """Yield (path, message) for mistakes that only the whole specification shows: names of agents and of
    hyperparameters, environments that cannot be made."""
    number = 0
    yield from _wrong_defaults(specification)
    for i, block in enumerate(specification.blocks):
        kinds = len(block.environments) * len(block.chance) * len(block.agents) * len(block.observations)
        number += kinds * len(specification.option_of(block, "seeds"))
        if number > MOST_RUNS:
            yield ("blocks", i), f"{number:,} runs up to here; a study has at most {MOST_RUNS:,}"
            return
        # Environments and the setting
        for j, entry in enumerate(block.environments):
            try:
                _ = entry.instance
            except ParameterError as error:
                yield ("blocks", i, "environments", j), str(error)
        if (specification.option_of(block, "horizon"), specification.option_of(block, "gamma")) == ("none", 1):
            yield (
                ("blocks", i),
                "gamma is 1 and horizon is none, so values may be infinite, and means over runs; give a horizon, or a "
                "gamma below 1 (pharos train --objective total measures single runs)",
            )
        # Agents and their engines
        engine = specification.option_of(block, "engine")
        for agent in engine if isinstance(engine, dict) else ():
            if not _is_agent(agent):
                where: Loc = ("engine",) if block.engine is None else ("blocks", i, "engine")
                yield where, str(UnknownName("agent", agent, agents()))
        for j, agent in enumerate(block.agents):
            try:
                if not _is_agent(agent):
                    raise UnknownName("agent", agent, agents())
                agent_source(agent, specification.folder, check=False)
            except ParameterError as error:
                yield ("blocks", i, "agents", j), str(error)
                continue
            try:
                agent_called(agent).engine(specification.engine_of(block, agent))
            except ParameterError as error:
                yield ("blocks", i, "agents", j), f"{error}; write engine: {{dqn: batched}} for some agents only"
        # Hyperparameters
        for agent, own in block.hyperparameters.items():
            loc = ("blocks", i, "hyperparameters", agent)
            if agent not in block.agents and all(map(_is_agent, block.agents)):
                yield loc, str(UnknownName("agent of this block", agent, block.agents))
            elif isinstance(own, str) and own not in specification.hyperparameters:
                yield loc, str(UnknownName("set of hyperparameters", own, specification.hyperparameters))
            elif _is_agent(agent):
                values = specification.hyperparameters[own] if isinstance(own, str) else own
                try:
                    agent_called(agent).check_before(values, specification.engine_of(block, agent))
                except ParameterError as error:
                    yield loc, str(error)


def _wrong_defaults(specification: Specification) -> Iterator[tuple[Loc, str]]:
    """The same of `defaults`: agents, classes and observations that neither pharos nor the study has, and values."""
    if not specification.defaults:
        return
    entries = [entry for block in specification.blocks for entry in block.environments]
    own_classes = {name for entry in entries if (name := _class_of(entry)) is not None}
    views = [view for block in specification.blocks for view in block.observations]
    views += [view for entry in entries for view in entry.observations or ()]
    known_observations = [*names(), *(str(view.own) for view in views if view.own is not None)]
    for agent, of_agent in specification.defaults.items():
        if not _is_agent(agent):
            yield ("defaults", agent), str(UnknownName("agent", agent, agents()))
            continue
        engines = [specification.engine_of(block, agent) for block in specification.blocks if agent in block.agents]
        for name, of_class in of_agent.items():
            if name not in own_classes and class_called(name) is None:
                yield ("defaults", agent, name), str(UnknownName("class of environments", name, classes()))
            for observation, values in of_class.items():
                loc: Loc = ("defaults", agent, name, observation)
                if observation not in known_observations:
                    yield loc, str(UnknownName("observation", observation, known_observations))
                try:
                    agent_called(agent).check_before(values, (*engines, "sb3")[0])
                except ParameterError as error:
                    yield loc, str(error)


def _class_of(entry: EnvironmentEntry) -> str | None:
    try:
        return entry.instance.name
    except ParameterError:  # which the entry itself tells
        return None


def _is_agent(name: str) -> bool:
    return name in agents() or is_reference(name)


def _messages(error: ValidationError, name: str, root: object) -> str:
    messages: dict[str, None] = {}  # in order, each once
    for problem in error.errors():
        loc = problem["loc"]
        if "hyperparameters" in loc and loc[-1] in ("str", "dict[str,any]"):
            loc = loc[:-1]
        key = str(loc[-1]) if loc else ""
        if problem["type"] == "extra_forbidden":
            part = _SPECIFICATION_PARTS.get(tuple(part for part in loc[:-1] if isinstance(part, str)))
            message = str(UnknownName("key", key, part.model_fields if part else ()))
        elif problem["type"] == "missing":
            message = f"the key {key!r} is missing"
            loc = loc[:-1]
        elif problem["type"] == "value_error":
            message = str(problem["ctx"]["error"])
        else:
            expected = problem["msg"][0].lower() + problem["msg"][1:]
            message = f"{key}: found {problem['input']!r}; expected: {expected.removeprefix('input should be ')}"
        messages[f"{where(name, root, loc)}: {message}"] = None
    return "; ".join(messages)
