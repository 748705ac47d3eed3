"""Values at the start of each task, solved once for all runs of a study, and kept in the user's cache.

A run needs the values of the optimal, the uniform and the worst policy only where episodes start; solving a large instance again
for each run would take longer than some training.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pharos.study.worker import write_atomically

if TYPE_CHECKING:
    from pharos.experiments import Task


def task_of(config: Mapping[str, Any]) -> "Task":
    """The task of a run."""
    from pharos.environments import make
    from pharos.experiments import Task

    return Task(
        make(config["environment"], **{name: tuple_of(value) for name, value in config["parameters"].items()}),
        sticky=config["chance"]["sticky"],
        random=config["chance"]["random"],
        observation=config["observation"],
        observation_options=dict(config["observation_options"]),
        gamma=config["gamma"],
        horizon=config["horizon"],
    )


def solve(config: Mapping[str, Any]) -> dict[str, Any]:
    """What a task knows of its values, `reference` and `return_range`; solved now unless they are kept."""
    known = kept(config)
    if known is None:
        task = task_of(config)
        known = {"reference": asdict(task.reference), "return_range": list(task.return_range)}
        file = _file(config)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, json.dumps({"task": _key(config), "values": known}, indent=1) + "\n")
    return known


def kept(config: Mapping[str, Any]) -> dict[str, Any] | None:
    """What `solve` found before for these rules."""
    try:
        said = json.loads(_file(config).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return said["values"] if said.get("task") == _key(config) else None


def with_values(task: "Task", values: Mapping[str, Any]) -> "Task":
    """The task, which now knows these values instead of solving for them."""
    from pharos.experiments import ReferenceValues

    task.__dict__["reference"] = ReferenceValues(**values["reference"])
    task.__dict__["return_range"] = tuple(values["return_range"])
    return task


def tuple_of(value: Any) -> Any:
    """Lists as tuples, all the way down."""
    return tuple(tuple_of(item) for item in value) if isinstance(value, list) else value


def _file(config: Mapping[str, Any]) -> Path:
    import xxhash

    from pharos.paths import cache_directory

    name = xxhash.xxh3_64_hexdigest(json.dumps(_key(config), sort_keys=True).encode())
    return cache_directory() / "values" / f"{name}.json"


def _key(config: Mapping[str, Any]) -> dict[str, Any]:
    """What the values depend on: parameters, rules by their code, start states, chance and setting."""
    from pharos.environments import start_distribution
    from pharos.rules.fingerprint import fingerprint_of_rules

    env = task_of(config).env
    states, probabilities = start_distribution(env)
    setting = {name: config[name] for name in ("environment", "parameters", "chance", "gamma", "horizon")}
    return json.loads(
        json.dumps(
            {
                **setting,
                "format": 2,
                "version": env.version,
                "rules": fingerprint_of_rules(env, ("transition", "is_terminal", "reward")),
                "start": [[list(map(int, state)) for state in states], probabilities.tolist()],
            }
        )
    )
