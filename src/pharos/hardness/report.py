"""All measures of an MDP in one table, with definitions and sources; kept beside the state space."""

import contextlib
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.interval import Budget
from pharos.hardness.registry import Measure, Problem, chosen
from pharos.mdp import TabularMDP

KEPT = "hardness.json"


@dataclass(frozen=True)
class Result:
    """One measure of one MDP.

    Attributes:
        name, definition, source, complexity: of the measure.
        value: a number, or what the measure's result says of itself as a dictionary; None where it is undefined.
        text: the value for people.
        exact: False for an interval that is not the exact value.
        undefined: why there is no value, and what would define it; empty where there is one.
        seconds: time that it took, when it was computed.
        kept: whether it was found beside the state space, not computed now.
    """

    name: str
    definition: str
    source: str
    complexity: str
    value: Any
    text: str
    exact: bool
    undefined: str
    seconds: float
    kept: bool = False


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
        """JSON-able: `measures`, `conventions`, `seconds`, and under `undefined` why some measures are None."""
        return {
            "measures": {name: _finite(result.value) for name, result in self.results.items()},
            "conventions": dict(self.conventions),
            "undefined": {name: result.undefined for name, result in self.results.items() if result.undefined},
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
            lines.append(f"{_escape(result.name.replace('_', ' '))} & {_escape(value)} \\\\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])

    def __str__(self) -> str:
        width = max(map(len, self.results), default=0)
        return "\n".join(
            f"{result.name:{width}}  {result.undefined or result.text}" for result in self.results.values()
        )


def report(
    mdp: TabularMDP,
    measures: str | Iterable[str] | None = None,
    *,
    horizon: int | None = None,
    tolerance: float = 1e-9,
    restart: bool = True,
    budget: Budget | float | None = None,
    keep: bool = True,
    progress: Callable[[str, str], None] | None = None,
) -> Report:
    """Measure how hard an MDP is.

    Args:
        measures: names, as a sequence or with commas; None: all that are registered but for those that are slow and come on
            request; "all": these as well.
        horizon: number of steps T for measures of episodes; None: that of the MDP, if any. Values and gaps have the gamma and
            the horizon of the MDP itself.
        tolerance: largest error of the optimal values, in units of return.
        restart: convention of the diameter: terminal states lead back to the start.
        budget: what each measure may spend (seconds, or a `Budget`; 300 s by default) before it returns a proven interval.
        keep: use results kept beside the state space, and keep new ones there. Nothing is kept where there is no folder.
        progress: called with the name of the running measure and a line on how far it is.
    Returns:
        A Report. A measure that does not exist for this MDP says why; the others are there.
    Raises:
        UnknownName: no such measure. ParameterError: an option is out of range.
    Cost: see each measure.
    """
    began = time.perf_counter()
    horizon = mdp.horizon if horizon is None else horizon
    if horizon is not None and (isinstance(horizon, bool) or not isinstance(horizon, int | np.integer) or horizon < 1):
        raise ParameterError(f"horizon is {horizon!r}; expected a whole number of steps, at least 1, or None")
    wanted = chosen(measures)
    problem = Problem(mdp, horizon, tolerance, restart, Budget.of(budget), progress)
    conventions = _conventions(problem)
    store = _Kept(mdp, conventions) if keep else None
    results = {measure.name: _measured(measure, problem, store) for measure in wanted}
    if "solution" in vars(problem):
        conventions["error_bound"] = problem.solution.error_bound
    return Report(results, conventions, time.perf_counter() - began)


def _measured(measure: Measure, problem: Problem, store: "_Kept | None") -> Result:
    if store is not None and (kept := store.get(measure, problem.budget)) is not None:
        return kept
    began = time.perf_counter()
    problem.report(measure.name, "")
    value: Any = None
    exact, text, undefined = True, "", ""
    try:
        outcome = measure.function(problem)
        value, text = _plain(outcome), _text(outcome)
        exact = bool(getattr(outcome, "exact", True))
    except UndefinedMeasure as error:
        undefined = str(error)
    result = Result(
        measure.name,
        measure.definition,
        measure.source,
        measure.complexity,
        value,
        text,
        exact,
        undefined,
        time.perf_counter() - began,
    )
    if store is not None and not undefined:
        store.put(measure, result, problem.budget)
    return result


def _plain(value: Any) -> Any:
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if hasattr(value, "tolist"):
        return value.tolist()
    return value


def _text(value: Any) -> str:
    if isinstance(value, float | np.floating):
        return f"{value:.10g}"
    return str(value)


def _infinite(value: Any) -> bool:
    if isinstance(value, Mapping):
        return bool(value.get("infinite", False))
    return isinstance(value, float) and math.isinf(value)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _escape(text: str) -> str:
    return text.replace("\\", r"\textbackslash{}").replace("_", r"\_").replace("%", r"\%").replace("&", r"\&")


def _conventions(problem: Problem) -> dict[str, Any]:
    mdp, chance = problem.mdp, problem.mdp.chance
    starts = [[int(s), float(p)] for s, p in zip(mdp.start_states[:100], mdp.start_probabilities, strict=False)]
    return {
        "gamma": float(mdp.gamma),
        "horizon": None if problem.horizon is None else int(problem.horizon),
        "horizon_of_values": mdp.horizon,
        "chance": {
            "chosen": chance.chosen,
            "previous": chance.previous,
            "uniform": chance.uniform,
            "first_chosen": chance.first_chosen,
        },
        "restart": problem.restart,
        "tolerance": problem.tolerance,
        "start_states": len(mdp.start_states),
        "start_distribution": starts,
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
    }


# Keeping results beside the state space ---------------------------------------------------------------------------------


_DEPENDS = {
    "structure": ("chance", "restart"),
    "values": ("chance", "gamma", "horizon_of_values", "tolerance"),
    "episodes": ("chance", "horizon"),
}


class _Kept:
    """Results in `hardness.json` of the state space's folder, each under a digest of all that it depends on."""

    def __init__(self, mdp: TabularMDP, conventions: Mapping[str, Any]):
        self.path = None if mdp.folder is None else Path(mdp.folder) / KEPT
        self.mdp, self.conventions = mdp, dict(conventions)

    def get(self, measure: Measure, budget: Budget) -> Result | None:
        """The kept result; None where there is none, or one that a larger budget could improve on."""
        found = None if self.path is None or measure.version is None else self._read().get(self._key(measure))
        try:
            if found is None or (not found["exact"] and budget.exceeds(Budget(**found["budget"]))):
                return None
            told = (found["value"], str(found["text"]), bool(found["exact"]), "", float(found["seconds"]))
        except (KeyError, TypeError, ValueError):  # not written by pharos
            return None
        return Result(measure.name, measure.definition, measure.source, measure.complexity, *told, kept=True)

    def put(self, measure: Measure, result: Result, budget: Budget) -> None:
        """Keep a result. A folder that cannot be written to (another's, or a full disk) keeps nothing."""
        if self.path is None or measure.version is None:
            return
        entry = {
            "measure": measure.name,
            "value": result.value,
            "text": result.text,
            "exact": result.exact,
            "seconds": result.seconds,
            "budget": {"seconds": budget.seconds, "searches": budget.searches},
        }
        try:
            text = json.dumps({"format": 1, "results": {**self._read(), self._key(measure): entry}}, indent=1)
        except TypeError:  # a user's measure that JSON cannot hold
            return
        partial = self.path.with_name(f"{KEPT}.{os.getpid()}")
        with contextlib.suppress(OSError):
            partial.write_text(text)
            os.replace(partial, self.path)

    def _key(self, measure: Measure) -> str:
        """Name, version, and a digest of conventions and rewards; transitions do not change within a folder."""
        keys = _DEPENDS.get(measure.depends, tuple(sorted(self.conventions)))
        conventions = json.dumps({key: self.conventions[key] for key in keys}, sort_keys=True)
        return f"{measure.name}/{measure.version}/{self._digest_of(conventions, measure.depends != 'structure')}"

    def _digest_of(self, conventions: str, with_rewards: bool) -> str:
        import xxhash

        mdp = self.mdp
        digest = xxhash.xxh3_128(conventions.encode())
        arrays = [mdp.start_states, mdp.start_probabilities]
        for array in [*arrays, *([mdp.reward_table.table, mdp.reward_table.palette] if with_rewards else [])]:
            digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()

    def _read(self) -> dict[str, Any]:
        if self.path is None:
            return {}
        try:
            stored = json.loads(self.path.read_text())
            return dict(stored["results"]) if stored["format"] == 1 else {}
        except (OSError, ValueError, KeyError, TypeError):
            return {}
