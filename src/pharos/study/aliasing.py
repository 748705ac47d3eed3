"""How many states of an environment look alike: an observation that some states share does not tell the agent the
state."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import TABULAR_OBSERVATION
from pharos.errors import FileFormatError, PharosError
from pharos.storage import digest_of_json, is_intact, read_json, replace_json, sealed

if TYPE_CHECKING:
    import pandas as pd

    from pharos.observations import Observation
    from pharos.state_space import StateSpace
    from pharos.study.specification import Specification

BLOCK = 4096
# Instances with more states are not counted for a report
MOST_STATES = 100_000


@dataclass(frozen=True)
class Aliasing:
    """How many of the reachable states share their observation with another state.

    Attributes:
        num_states: reachable states, terminal ones included.
        num_observations: different observations among them.
        num_sharing: states whose observation another state has as well.
    """

    num_states: int
    num_observations: int
    num_sharing: int

    @property
    def share(self) -> float:
        """The part of the states that share their observation; 0 where the observation tells the state."""
        return self.num_sharing / self.num_states


def aliasing(space: "StateSpace", observation: "Observation") -> Aliasing:
    """Count the states of a state space that an observation does not tell apart.

    Cost: one observation and 16 bytes for each state.
    """
    import xxhash

    digests = np.empty(space.num_states, "V16")
    for start in range(0, space.num_states, BLOCK):
        observations = observation(space.states(slice(start, start + BLOCK)))
        rows = np.ascontiguousarray(observations).reshape(len(observations), -1).view(np.uint8)
        digests[start : start + len(rows)] = [xxhash.xxh3_128_digest(row.data) for row in rows]
    _, counts = np.unique(digests.view(np.uint64).reshape(-1, 2), axis=0, return_counts=True)
    return Aliasing(space.num_states, len(counts), int(counts[counts > 1].sum()))


def aliasing_table(
    study: "Specification",
    folder: Path,
    num_states: Mapping[str, float],
    progress: Callable[[str], None] | None = None,
) -> "pd.DataFrame":
    """Aliasing of every instance and observation of a study with at most MOST_STATES states; kept in the folder
    `aliasing`.

    Args:
        num_states: of the instances that are to be looked at, by name.
    Returns:
        Columns `environment`, `instance`, `observation`, `states`, `observations`, `share`.
    """
    import pandas as pd

    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for run in study.runs:
        key = (run.instance, run.config["observation"])
        known = num_states.get(run.instance, np.inf)
        if key in rows or key[1] == TABULAR_OBSERVATION or not known <= MOST_STATES:
            continue
        if progress is not None:
            progress(f"states that share an observation: {', '.join(key)}")
        try:
            count = _counted(folder, run.config)
        except PharosError:
            continue
        rows[key] = {"environment": run.config["environment"], "instance": key[0], "observation": key[1]}
        rows[key] |= {"states": count.num_states, "observations": count.num_observations, "share": count.share}
    columns = ["environment", "instance", "observation", "states", "observations", "share"]
    return pd.DataFrame(list(rows.values()), columns=columns)


def _counted(folder: Path, config: Mapping[str, Any]) -> Aliasing:
    from pharos.observations import observe
    from pharos.state_space import build
    from pharos.study.values import task_of

    asked = {name: config[name] for name in ("environment", "parameters", "observation", "observation_options")}
    task = task_of(config)
    asked = json.loads(json.dumps({**asked, "version": task.env.version}))
    file = folder / "aliasing" / f"{digest_of_json(asked)[:16]}.json"
    try:
        stored = read_json(file)
        if is_intact(stored) and stored["asked"] == asked:
            return Aliasing(**stored["counts"])
    except (FileNotFoundError, FileFormatError, KeyError, TypeError, AttributeError):
        pass
    space = build(task.env, progress=False)
    counts = aliasing(space, observe(task.env, task.observation, **dict(task.observation_options)))
    file.parent.mkdir(parents=True, exist_ok=True)
    replace_json(file, sealed({"asked": asked, "counts": asdict(counts)}))
    return counts
