"""Hyperparameters for every agent, class of environments and observation, in RL Zoo's convention.

Each agent has defaults (`Agent.defaults`); a class of environments declares what suits it better
(`Environment.hyperparameters`). A table of one's own, in YAML, has both.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pharos.agents.registry import agent_called
from pharos.environments import class_called
from pharos.errors import ParameterError


def hyperparameters(
    agent: str, environment: str, observation: str, given: Mapping[str, Any] | None = None, *, table: Path | None = None
) -> dict[str, Any]:
    """Return the hyperparameters of an agent for a class of environments and an observation.

    Args:
        given: go before all others.
        table: a YAML that says all of it (agent, then "default" or the class, then "default" or the observation), such
            as one that `pharos tune` wrote; None for what pharos and the class declare.
    Raises:
        ParameterError: the table has another form. MissingExtra: a table is given, and PyYAML is not installed.
    """
    by_observation: Mapping[str, Any]
    if table is None:
        declaring = class_called(environment)
        default: Mapping[str, Any] | None = agent_called(agent).defaults
        by_observation = declaring.hyperparameters.get(agent, {}) if declaring else {}
    else:
        entries = _read(table).get(agent) or {}
        default, by_observation = entries.get("default"), entries.get(environment) or {}
    result: dict[str, Any] = {}
    for part in (default, by_observation.get("default"), by_observation.get(observation), given):
        result.update(part or {})
    return result


def _read(path: Path) -> dict[str, Any]:
    from pharos.system.yaml_files import read_yaml  # which needs PyYAML

    table = read_yaml(path)
    if not isinstance(table, dict) or not _is_table(table, 4):
        raise ParameterError(f"{path}: expected agent, then class, then observation, each with names and values")
    return table


def _is_table(entry: object, levels: int) -> bool:
    """Whether an entry is a dictionary nested to this depth; a default has one level, and None stands for no entry."""
    if not isinstance(entry, dict) or not all(isinstance(name, str) for name in entry):
        return False
    below = entry.items() if levels > 1 else ()
    return all(part is None or _is_table(part, 1 if name == "default" else levels - 1) for name, part in below)
