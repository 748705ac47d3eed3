"""All measures of an MDP in one table, with definitions and sources, kept beside the state space.

`hardness.json` has the results beside the state space, each sealed by a digest and tied to what it depends on.
"""

import contextlib
import json
import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from pharos.errors import MeasureUnfinished, PrecisionError, UndefinedMeasure
from pharos.hardness.interval import Budget, Certificate, Certified, certificate_of, finite
from pharos.hardness.registry import Measure, Problem, selected_measures
from pharos.hardness.representation.learning import Adam, Representation, Rollouts, Schedule
from pharos.hardness.representation.sampled_regret import Sampling
from pharos.mdp import TabularMDP, check_horizon, require_mdp
from pharos.system import storage
from pharos.system.compiling import Stopwatch
from pharos.system.wording import latex_text


@dataclass(frozen=True)
class Result:
    """One measure of one MDP.

    Attributes:
        name, definition, source, complexity: of the measure.
        value: a number, or the measure's result as a dictionary, or None if it is undefined.
        text: the value for people.
        undefined: why there is no value, and what would define it. Empty if there is one.
        is_out_of_budget: whether there is no value because the budget ended.
        seconds: time that it took, when it was computed.
        kept: whether it stood beside the state space, and was not computed now.
        certificate: what is proven of it.
    """

    name: str
    definition: str
    source: str
    complexity: str
    value: Any = None
    text: str = ""
    undefined: str = ""
    is_out_of_budget: bool = False
    seconds: float = 0.0
    kept: bool = False
    certificate: Certificate = field(default_factory=lambda: Certificate("float64"))

    @property
    def exact(self) -> bool:
        """Whether the value is proven, see `certificate`."""
        return self.certificate.is_exact


@dataclass(frozen=True)
class Report:
    """The measures of an MDP: `report["diameter"].value`.

    Attributes:
        results: by name.
        conventions: what the values refer to, JSON-able.
        seconds: time that the report took.
    """

    results: Mapping[str, Result]
    conventions: Mapping[str, Any]
    seconds: float

    def __getitem__(self, name: str) -> Result:
        return self.results[name]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: `measures`, `conventions`, `seconds`. What is proven of each stands under `certificates`, and why
        some are None under `undefined`."""
        return {
            "measures": {name: finite(result.value) for name, result in self.results.items()},
            "conventions": dict(self.conventions),
            "undefined": {name: result.undefined for name, result in self.results.items() if result.undefined},
            "certificates": {
                name: result.certificate.to_dict() for name, result in self.results.items() if not result.undefined
            },
            "infinite": [name for name, result in self.results.items() if _infinite(result.value)],
            "details": {
                name: {
                    "exact": result.exact,
                    "definition": result.definition,
                    "source": result.source,
                    "complexity": result.complexity,
                    "seconds": result.seconds,
                    "kept": result.kept,
                }
                for name, result in self.results.items()
            },
            "seconds": self.seconds,
        }

    def to_latex(self) -> str:
        """A LaTeX table (booktabs) of measures and values."""
        lines = [r"\begin{tabular}{lr}", r"\toprule", r"measure & value \\", r"\midrule"]
        for result in self.results.values():
            value = result.text if not result.undefined else "--"
            lines.append(f"{latex_text(result.name.replace('_', ' '))} & {latex_text(value)} \\\\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])

    def __str__(self) -> str:
        width = max(map(len, self.results), default=0)
        return "\n".join(
            f"{result.name:{width}}  {result.undefined or result.text}" for result in self.results.values()
        )


@require_mdp
def report(  # noqa: PLR0913
    mdp: TabularMDP,
    measures: str | Iterable[str] | None = None,
    *,
    horizon: int | None = None,
    tolerance: float = 1e-9,
    restart: bool = True,
    budget: Budget | float | None = None,
    keep: bool = True,
    progress: Callable[[str, str], None] | None = None,
    on_result: Callable[[Result], None] | None = None,
    representation: Representation | None = None,
    schedule: Schedule | None = None,
    rollouts: Rollouts | None = None,
    sampling: Sampling | None = None,
    adam: Adam | None = None,
    folder: str | os.PathLike | None = None,
) -> Report:
    """Measure how hard an MDP is.

    Args:
        measures: names, as a sequence or with commas. Default: all that are registered, without the slow ones that come
            on request. "all": these as well.
        horizon: number of steps T for measures of episodes. Default: the MDP's, if any. Values and gaps have the
            gamma and the horizon of the MDP itself.
        tolerance: largest error of the optimal values, in units of return.
        restart: convention of the diameter: terminal states lead back to the start.
        budget: what each measure may spend, in seconds, or a `Budget`: one that it ends has a proven interval, or no
            value yet (`Result.is_out_of_budget`). None: 300 s for measures that have intervals, no limit for others.
        keep: use results kept beside the state space, and keep new ones there. Nothing is kept if there is no
            folder.
        progress: called with the name of the running measure and a line on how far it is.
        on_result: called with each `Result` as soon as it is there.
        representation: what the agent's network makes of the states, `pharos.observations.representation`. With one,
            measures of it are part of the report.
        schedule: of the idealised learner that these have. rollouts: of the actor-critic. sampling: of the learners
            that draw. adam: of those that step as an agent does.
        folder: for optimal values (`optimal.npy`, which `value_iteration(..., values=)` knows as well) and for the
            bounds of a diameter while they are computed, in place of memory: the same call goes on from them after one
            was killed, or a budget spent. None: memory, or, if that has little room, files without a name.
    Returns:
        A Report. A measure that does not exist for this MDP says why. The others are there.
    Raises:
        UnknownName: no such measure. ParameterError: an option is out of range.
    Cost: see each measure.
    """
    watch = Stopwatch()
    horizon = mdp.horizon if horizon is None else horizon
    check_horizon(horizon)
    wanted = selected_measures(measures, representation is not None)
    schedule = schedule or Schedule()
    options = (representation, schedule, rollouts, sampling, adam, None if folder is None else Path(folder))
    is_strict = budget is not None
    problem = Problem(mdp, horizon, tolerance, restart, Budget.of(budget), progress, *options, is_strict)
    conventions = _problem_conventions(problem)
    file = ResultsFile(mdp, conventions) if keep else None
    results = {}
    for measure in wanted:
        results[measure.name] = _measured(measure, problem, file)
        if on_result is not None:
            on_result(results[measure.name])
    bounds = (problem.error_bound, None if file is None else file.error_bound)
    if numbers := [bound for bound in bounds if bound is not None]:
        conventions["error_bound"] = max(numbers)
    return Report(results, conventions, watch.seconds)


def _measured(measure: Measure, problem: Problem, file: "ResultsFile | None") -> Result:
    empty = Result(measure.name, measure.definition, measure.source, measure.complexity)
    entry = None if file is None else file.get(measure, problem.budget)
    # what is kept of a budget that was spent may go on from what the folder holds
    if entry is not None and (problem.folder is None or entry["certificate"].kind != "interval"):
        return replace(empty, **entry, kept=True)
    watch = Stopwatch()
    problem.clock.restart()
    if problem.progress is not None:
        problem.progress(measure.name, "")
    try:
        outcome = measure.function(problem)
    except (UndefinedMeasure, PrecisionError) as error:
        is_over = isinstance(error, MeasureUnfinished)
        return replace(empty, undefined=str(error), is_out_of_budget=is_over, seconds=watch.seconds)
    certificate, seconds = certificate_of(outcome), watch.seconds
    result = replace(
        empty, value=_plain(outcome), text=_text_of_value(outcome), certificate=certificate, seconds=seconds
    )
    if file is not None:
        file.put(measure, result, problem.budget, problem.error_bound)
    return result


def _plain(value: object) -> object:
    if isinstance(value, Certified):
        return value.value
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if hasattr(value, "tolist"):
        return value.tolist()
    return value


def _text_of_value(value: object) -> str:
    if isinstance(value, float | np.floating):
        return f"{value:.10g}"
    return str(value)


def _infinite(value: object) -> bool:
    if isinstance(value, Mapping):
        return bool(value.get("infinite", False))
    return isinstance(value, float) and math.isinf(value)


def _problem_conventions(problem: Problem) -> dict[str, Any]:
    mdp = problem.mdp
    starts = [[int(s), float(p)] for s, p in zip(mdp.start_states[:100], mdp.start_probabilities, strict=False)]
    representation = problem.representation
    represented = (
        {}
        if representation is None
        else {"representation": dict(representation.conventions), "schedule": asdict(problem.schedule)}
    )
    if representation is not None and problem.rollouts is not None:
        represented["rollouts"] = problem.rollouts.to_dict()
    if representation is not None and problem.sampling is not None:
        represented["sampling"] = problem.sampling.to_dict()
    if representation is not None and problem.adam is not None:
        represented["adam"] = asdict(problem.adam)
    return {
        **represented,
        "gamma": float(mdp.gamma),
        "horizon": None if problem.horizon is None else int(problem.horizon),
        "horizon_of_values": mdp.horizon,
        "chance": {**mdp.chance.to_dict(), **({"lazy": mdp.laziness} if mdp.laziness else {})},
        "restart": problem.restart,
        "tolerance": problem.tolerance,
        "start_states": len(mdp.start_states),
        "start_distribution": starts,
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
    }


# hardness.json --------------------------------------------------------------------------------------------------------


REPORT_FILE = "hardness.json"
REPORT_FORMAT = 2

# Conventions that the results of a measure depend on, by its `depends`; else all, but for these if it is "all".
_OF_REPRESENTATIONS = ("representation", "schedule", "rollouts", "sampling", "adam")
_DEPENDS = {
    "structure": ("chance", "restart"),
    "values": ("chance", "gamma", "horizon_of_values", "tolerance"),
    "episodes": ("chance", "horizon"),
}


class ResultsFile:
    """Results in `hardness.json` of the state space's folder.

    The key of a result is the name and version of the measure, and a digest of all that it depends on: the manifest of
    the folder, conventions, the start, rewards. An entry holds its key and is sealed, so that one that was edited, cut
    short or brought from another space is measured anew, with a warning.
    """

    def __init__(self, mdp: TabularMDP, conventions: Mapping[str, Any]):
        self.path = None if mdp.folder is None else Path(mdp.folder) / REPORT_FILE
        self.mdp, self.conventions = mdp, dict(conventions)
        self.error_bound: float | None = None  # the largest of the values behind the results that were read
        self._has_warned = False

    def get(self, measure: Measure, budget: Budget) -> dict[str, Any] | None:
        """Value, text, seconds and certificate. None if there is no result, or one that a larger budget could improve
        on."""
        if self.path is None or measure.version is None:
            return None
        key = self._key(measure)
        entry = self._read().get(key)
        if entry is None:
            return None
        try:
            if entry["key"] != key or storage.DIGEST not in entry or not storage.is_intact(entry):
                raise ValueError("digest")
            content = json.loads(entry["content"])
            if "error_bound" not in content:  # of an older pharos, which did not keep it
                return None
            certificate = Certificate(**content["certificate"])
            if not certificate.is_exact and budget.exceeds(Budget(**content["budget"])):
                return None
            _check_value(content["value"])
            text, seconds = str(content["text"]), float(content["seconds"])
            bound = None if content["error_bound"] is None else float(content["error_bound"])
        except (KeyError, TypeError, ValueError):
            self._warn(f"the result of {measure.name} is not as pharos wrote it")
            return None
        if bound is not None:
            self.error_bound = max(bound, self.error_bound or 0.0)
        return {"value": content["value"], "text": text, "seconds": seconds, "certificate": certificate}

    def put(self, measure: Measure, result: Result, budget: Budget, error_bound: float | None) -> None:
        """Keep a result, and the error bound of the optimal values behind it.

        Nothing is kept if the folder cannot be written to (another's, or a full disk).
        """
        if self.path is None or measure.version is None:
            return
        content = {
            "value": result.value,
            "text": result.text,
            "seconds": result.seconds,
            "certificate": vars(result.certificate),
            "budget": vars(budget),
            "error_bound": None if measure.depends == "structure" else error_bound,
        }
        try:  # as text: JSON proper has no infinity
            entry = storage.sealed({"key": self._key(measure), "content": json.dumps(content)})
        except TypeError:  # a user's measure that JSON cannot hold
            return
        with contextlib.suppress(OSError):
            results = {**self._read(), entry["key"]: entry}
            storage.replace_json(self.path, {"format": REPORT_FORMAT, "results": results}, durable=False)

    def _key(self, measure: Measure) -> str:
        everything = tuple(sorted(self.conventions))
        if measure.depends != "representation":
            everything = tuple(key for key in everything if key not in _OF_REPRESENTATIONS)
        keys = _DEPENDS.get(measure.depends, everything)
        conventions = json.dumps({key: self.conventions[key] for key in keys}, sort_keys=True)
        return f"{measure.name}/{measure.version}/{self._digest(conventions, measure.depends != 'structure')}"

    def _digest(self, conventions: str, with_rewards: bool) -> str:
        assert self.path is not None
        digest = xxhash.xxh3_128(conventions.encode())
        with contextlib.suppress(OSError):  # transitions do not change without the manifest, which has their digests
            digest.update(storage.digest_of_file(self.path.with_name("manifest.json")).encode())
        table = self.mdp.reward_table
        arrays = [self.mdp.start_states, self.mdp.start_probabilities]
        for array in [*arrays, *([table.table, table.palette] if with_rewards else [])]:
            digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()

    def _read(self) -> dict[str, Any]:
        """Entries by key. None if the file is missing, of another format, or damaged."""
        assert self.path is not None
        try:
            storage.check_regular(self.path)
            text = self.path.read_bytes()
        except OSError:
            return {}
        try:
            stored = json.loads(text)
            if stored["format"] < REPORT_FORMAT:  # of an older pharos, without digests
                return {}
            if stored["format"] == REPORT_FORMAT and all(isinstance(each, dict) for each in stored["results"].values()):
                return dict(stored["results"])
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            pass
        self._warn("the file is not as pharos wrote it")
        return {}

    def _warn(self, what: str) -> None:
        """Warn about the file, once for each report."""
        if not self._has_warned:
            self._has_warned = True
            warnings.warn(f"{self.path}: {what}; it is measured anew", stacklevel=2)


def _check_value(value: object) -> None:
    """ValueError if a value cannot be one: an interval whose ends are the wrong way round, or NaN."""
    if isinstance(value, Mapping):
        lower, upper = value.get("lower"), value.get("upper")
        if lower is not None and upper is not None and not lower <= upper:
            raise ValueError("interval")
    if isinstance(value, float) and math.isnan(value):
        raise ValueError("NaN")
