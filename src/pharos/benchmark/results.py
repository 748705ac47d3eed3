"""Results of an agent in a benchmark: a curve of normalised regret for each task and seed, in one small file.

The layout follows `system/sealed.py`: the record as JSON, and under the name of each task a float64 array (seeds,
evaluations), with digests of all. The same results give the same bytes.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pharos.benchmark.suite import EARLIER
from pharos.errors import FileFormatError, ParameterError
from pharos.system.sealed import check_values, read_sealed, write_sealed

RESULTS_FILE = "results.safetensors"
RESULTS_KIND = "result of a benchmark"
BASELINES = Path(__file__).parent / "baselines"


@dataclass(frozen=True, eq=False)
class AgentResults:
    """Learning curves of one agent, with one setting, on the tasks of a suite.

    Attributes:
        agent: label of the agent.
        suite, digest: name and digest of the suite. An earlier digest of the same tasks becomes today's.
        seeds: of the runs, in the order of the rows.
        curves: name of a task -> (seeds, evaluations) normalised regret (V* - V) / (V* - U) of the policy after each
            equal part of the steps: 0 is optimal, 1 is uniform play, not clipped. Tasks that were not run, or of which
            a run failed, are left out.
        record: JSON-able: form, source, hyperparameters and versions, as in agent.json, and `exact` by task.
    Raises:
        ParameterError: a curve has another shape, or a number is not finite.
    """

    agent: str
    suite: str
    digest: str
    seeds: tuple[int, ...]
    curves: Mapping[str, np.ndarray]
    record: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        curves = {name: np.asarray(self.curves[name], np.float64) for name in sorted(self.curves)}
        object.__setattr__(self, "curves", curves)
        object.__setattr__(self, "digest", EARLIER.get(self.digest, self.digest))
        object.__setattr__(self, "seeds", tuple(int(seed) for seed in self.seeds))
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise ParameterError(f"seeds of {self.agent} are {self.seeds}; expected at least one, each once")
        widths = {curve.shape[1:] for curve in curves.values()}
        for name, curve in curves.items():
            if curve.ndim != 2 or len(curve) != len(self.seeds) or not curve.shape[1] or len(widths) != 1:
                raise ParameterError(
                    f"curves of {self.agent} on {name} have shape {curve.shape}; expected ({len(self.seeds)} seeds, "
                    f"evaluations), as many evaluations on each task"
                )
            if not np.isfinite(curve).all():
                raise ParameterError(f"curves of {self.agent} on {name} hold NaN or infinity; expected finite numbers")

    def mean(self) -> float:
        """Normalised regret, the mean of all tasks, seeds and evaluations."""
        return float(np.mean([curve.mean() for curve in self.curves.values()]))

    @staticmethod
    def read(source: str | os.PathLike) -> "AgentResults":
        """Results of the folder of a run, of a file, or of a shipped baseline, by name (`dqn`, of v1, or `v1/dqn`).

        Nothing is executed, and nothing is allocated before sizes in the file were held against the size of the file.

        Raises:
            ParameterError: there are none. FileFormatError: it is another file. ResultCorrupted: it was cut short or
                changed after it was written.
        """
        path = Path(source)
        suite, _, label = (f"v1/{source}" if "/" not in str(source) else str(source)).rpartition("/")
        if path.is_dir():
            path = path / RESULTS_FILE
            if not path.is_file():
                finished = len(list(Path(source).glob("runs/*/*/curve.*")))
                raise ParameterError(
                    f"{path}: no such file; {finished} runs have finished, some are missing: run the same command "
                    f"again, or score these alone with --seeds or --tasks"
                )
        elif not path.exists() and "/" not in suite and label in baselines(suite):
            path = BASELINES / suite / f"{label}.safetensors"
        elif not path.is_file():
            raise ParameterError(
                f"{source}: no results; expected the folder of a run, its {RESULTS_FILE}, or a baseline: "
                f"{', '.join(baselines(suite) or baselines())}"
            )
        return read_sealed(path, RESULTS_KIND, _results)

    def write(self, file: str | os.PathLike) -> None:
        """Replace a file by these results, in one step. The same results give the same bytes."""
        own = {"agent": self.agent, "suite": self.suite, "suite_digest": self.digest, "seeds": list(self.seeds)}
        write_sealed(file, {**own, "record": dict(self.record)}, self.curves, RESULTS_KIND)


def baselines(suite: str = "v1") -> tuple[str, ...]:
    """Names of the results that are shipped for a suite. Each is the results file of a run, and says its seeds."""
    return tuple(sorted(file.stem for file in (BASELINES / suite).glob("*.safetensors")))


def _results(record: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> AgentResults:
    kinds = {"agent": str, "suite": str, "suite_digest": str, "seeds": list, "record": dict}
    agent, suite, digest, seeds, more = entries_of(record, kinds, RESULTS_KIND)
    return AgentResults(agent, suite, digest, tuple(seeds), arrays, more)


def entries_of(record: Mapping[str, Any], kinds: Mapping[str, type], what: str) -> tuple[Any, ...]:
    """Entries of the record of a file, in the order of `kinds`. FileFormatError if one is missing or of another
    type."""
    check_values(record)
    wrong = [name for name, kind in kinds.items() if not isinstance(record.get(name), kind)]
    if wrong or not all(type(seed) is int for seed in record["seeds"]):
        raise FileFormatError(f"is no {what}: its {', '.join(wrong) or 'seeds'} are missing or of another type")
    return tuple(record[name] for name in kinds)


read_results = AgentResults.read
