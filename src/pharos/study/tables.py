"""The results of a study as tables: a row for each run, a row for each point of a curve, a row for each cell of the
grid.

A cell is one agent on one instance under one kind of chance with one observation: its row is the mean over seeds.
"""

import json
import os
import warnings
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos import training
from pharos.agents import agent_called
from pharos.environments import classes, make
from pharos.errors import FileFormatError, ParameterError, UnknownName
from pharos.regret import regret_scale
from pharos.study import worker as _worker
from pharos.study.blocks import Run, Specification, part_of
from pharos.study.specification import Source
from pharos.study.status import opened
from pharos.system.storage import ResultCache
from pharos.system.wording import in_one_line, pluralize
from pharos.training import CELL, ChanceSetting

if TYPE_CHECKING:
    import pandas as pd

    from pharos.mdp import TabularMDP


NO_CHANCE = {"sticky": 0.0, "random": 0.0}
# A proven interval enters as one number if its upper end is at most so many times its lower end
WIDEST_FACTOR = 2
# Part of the evaluations at the end over which the return is averaged
LAST_SHARE = 0.1
RUN_NUMBERS = ("cumulative_regret", "normalized_regret", "final_value", "value_optimal", "value_uniform")
"""Entries that the result of every run has, numbers or null."""
POINTS = ("step", "episodes", "value", "cumulative_expected_regret", "normalized_regret", "mean_return")
DATE = "%Y-%m-%dT%H:%M:%SZ"
# Numbers beyond this are no results, and no figure can hold them
LARGEST_VALUE = 1e100


@dataclass(frozen=True)
class FinishedRuns:
    """Finished runs of a study, as tables.

    Attributes:
        runs: a row for each run, see `table`.
        points: a row for each evaluation, see `curves`.
        damaged: what is wrong with results that cannot be read, by id.
    """

    runs: "pd.DataFrame"
    points: "pd.DataFrame"
    damaged: Mapping[str, str]


def finished_runs(study: Specification, directory: Path) -> FinishedRuns:
    """Read every finished run of a study once. A run that cannot be read is named and left out.

    Raises:
        ParameterError: no run is finished.
    """
    import pandas as pd

    rows, points, damaged = [], [], {}
    for run in study.runs:
        try:
            record = _worker.run_record(directory / "runs" / run.id)
            if record is None or record["status"] != _worker.FINISHED:
                continue
            curve = run_curve(directory, run.id)
            row = {"id": run.id} | row_of(run, record, curve, directory / "runs" / run.id)
        except FileFormatError as error:
            damaged[run.id] = str(error)
            continue
        rows.append(row)
        points.append(curve.assign(id=run.id, **described(run)))
    if not rows:
        raise ParameterError(
            f"{directory}: no run of {study.name!r} is finished; execute `pharos study run` first"
            + (f" ({len(damaged)} damaged: {next(iter(damaged.values()))})" if damaged else "")
        )
    return FinishedRuns(pd.DataFrame(rows), pd.concat(points, ignore_index=True), damaged)


def table(source: Source, folder: str | os.PathLike | None = None) -> "pd.DataFrame":
    """Table of the finished runs, a row each. Runs with damaged files are left out, with a warning that names them.

    Returns:
        A row has the columns

        - `id`, `environment` (class), `instance`, `chance`, `agent`, `observation`, `seed`, `steps`, `seconds`
        - `began`: date, or "" if the record does not say
        - the result of the run: `cumulative_regret`, `normalized_regret`, `value_optimal`, ...
        - `return`: mean undiscounted return of the training episodes in the last tenth of the run
        - `exact`: whether every value behind the regret is computed
        - `half_width`: by how much `normalized_regret` may at worst be wrong if some are estimated, 0 if none is
    Raises:
        ParameterError: no run is finished.
    """
    return _warned(finished_runs(*opened(source, folder))).runs


def curves(source: Source, folder: str | os.PathLike | None = None) -> "pd.DataFrame":
    """Table of the evaluations of finished runs, a row each: columns of curve.csv, and of the run."""
    return _warned(finished_runs(*opened(source, folder))).points


def row_of(run: Run, record: Mapping[str, Any], curve: "pd.DataFrame", folder: Path) -> dict[str, Any]:
    """The columns of `table` for one finished run, without its id. `folder` is named in errors."""
    row = {**described(run), "seconds": float(record["seconds"]), "began": _began(record)}
    row |= _result_of(record, folder) | {"return": _last_return(curve)}
    row["exact"], row["half_width"] = _exactness(curve, row)
    return row


def _warned(runs: FinishedRuns) -> FinishedRuns:
    if runs.damaged:
        first = next(iter(runs.damaged.values()))
        warnings.warn(
            f"{pluralize(len(runs.damaged), 'run')} left out, {', '.join(runs.damaged)}: {first}; "
            f"`pharos study run` makes them again",
            RuntimeWarning,
            stacklevel=3,
        )
    return runs


def _result_of(record: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The entries of a result that are one number or text each, NaN for null."""
    result = {name: value for name, value in record["result"].items() if not isinstance(value, dict | list)}
    for name in RUN_NUMBERS:
        value = result.get(name, "nothing")
        if isinstance(value, bool) or not isinstance(value, int | float | None) or abs(value or 0) > LARGEST_VALUE:
            raise FileFormatError(f"{folder / 'run.json'}: {name} is {str(value)[:30]}; expected a number below 1e100")
    return {name: float("nan") if value is None else value for name, value in result.items()}


def _began(record: Mapping[str, Any]) -> str:
    """Date at which a run began: its record's date less the seconds of its program, or "" if the record lacks it."""
    try:
        seconds = float(record.get("batch", {}).get("seconds") or record["seconds"])
        began = datetime.strptime(record["written"], DATE).replace(tzinfo=UTC) - timedelta(seconds=seconds)
        return began.strftime(DATE)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return ""


def _exactness(curve: "pd.DataFrame", row: Mapping[str, Any]) -> tuple[bool, float]:
    """(whether a curve has no estimate, the error of its normalised regret if all estimates err in one direction)."""
    if "exact" not in curve or bool(curve["exact"].all()) or "error_bound" not in curve:
        return bool("exact" not in curve or curve["exact"].all()), 0.0
    episodes = curve["episodes"].to_numpy(float)
    bound = curve["error_bound"].where(~curve["exact"].astype(bool), 0.0).to_numpy(float)
    scale = episodes[-1] * regret_scale(row["value_optimal"], row["value_uniform"]) or float("nan")
    return False, float((np.diff(episodes) * bound[:-1]).sum() / scale)


def cells(rows: "pd.DataFrame", measures: "pd.DataFrame | None" = None) -> "pd.DataFrame":
    """The means over seeds, a row for each cell, joined with hardness if `measures` (of `hardness_table`) is given.

    Returns:
        A row has the columns

        - of the cell
        - `seeds`, and `steps` (the most, if runs differ)
        - means of `cumulative_regret`, `normalized_regret`, `final_value`, `value_optimal`, `return`, `half_width`
        - `return_deviation` over seeds: population, as 0.00 is printed for equal runs, NaN for one seed
        - `exact`: whether all runs are
        - the measures
    """
    values = ["cumulative_regret", "normalized_regret", "final_value", "value_optimal", "return"]
    groups = rows.groupby(CELL, sort=False)
    means = groups[values].mean()
    means.insert(0, "seeds", groups.size())
    means.insert(1, "steps", groups["steps"].max())
    means["return_deviation"] = groups["return"].std(ddof=0).where(groups.size() > 1)
    if {"exact", "half_width"} <= {*rows}:
        means["exact"], means["half_width"] = groups["exact"].all(), groups["half_width"].mean()
    means = means.reset_index()
    if measures is None:
        return means
    return means.merge(measures, on=["environment", "instance", "chance"], how="left")


def run_curve(folder: Path, id: str) -> "pd.DataFrame":
    """The curve of one run.

    Raises:
        FileFormatError: it cannot be read, does not match its record, or has no evaluation.
    """
    curve = training.read_curve(folder / "runs" / id, columns=POINTS)
    if len(curve) == 0 or any(curve[name].dtype.kind not in "iufb" for name in POINTS):
        raise FileFormatError(f"{folder / 'runs' / id}: its curve has no evaluation, or words in place of numbers")
    return curve


def _last_return(curve: "pd.DataFrame") -> float:
    """Mean return of training episodes over the last tenth of the evaluations that saw an episode end."""
    ended = np.diff(curve["episodes"].to_numpy(), prepend=0)
    returns = curve["mean_return"].to_numpy(float)
    is_defined = np.isfinite(returns) & (ended > 0)
    last = max(1, int(len(returns) * LAST_SHARE))
    is_defined[: len(returns) - last] &= not is_defined[-last:].any()
    return float(np.average(returns[is_defined], weights=ended[is_defined])) if is_defined.any() else float("nan")


def described(run: Run) -> dict[str, Any]:
    """Columns of tables that describe a run: its cell, seed and steps."""
    return {**run.cell, "seed": run.config["seed"], "steps": run.config["steps"]}


# Hardness -------------------------------------------------------------------------------------------------------------


def hardness_table(
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    progress: Callable[[str], None] | None = None,
    tasks: Container[tuple[str, str]] | None = None,
) -> "pd.DataFrame":
    """The measures of every instance under every kind of chance, computed once, and kept in the folder `hardness`.

    Args:
        tasks: (instance, chance) of the tasks that you want. Default: all.
    Returns:
        Columns `environment`, `instance`, `chance`, each measure as a number, `num_states`, and `notes`, which name a
        measure if

        - it is undefined or unknown,
        - it is the geometric mean of a proven interval (whose ends differ by a factor of at most two),
        - it belongs to the instance without chance, because the measure does not exist, or cannot be computed within
          the budget, under this chance.
    Cost: a state space and a report of hardness for each row, each measure at most the budget of the specification;
        `hardness_cost` tells beforehand.
    """
    import pandas as pd

    study, directory = opened(source, folder)
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for run in study.runs:
        key = (run.instance, run.chance)
        if key in rows or (tasks is not None and key not in tasks):
            continue
        if progress is not None:
            progress(f"hardness of {run.instance}, {run.chance}")
        plain = {**run.config, "chance": NO_CHANCE}
        own = _measured(study, directory, run.config)
        without = _measured(study, directory, plain) if run.chance != "plain" else own
        rows[key] = {"environment": run.cell["environment"], "instance": run.instance, "chance": run.chance}
        rows[key] |= _row_of_measures(study.hardness.measures, own, without)
    return pd.DataFrame(list(rows.values()))


def hardness_cost(study: Specification, directory: Path, tasks: Container[tuple[str, str]]) -> tuple[int, float]:
    """(number of tasks that `hardness_table` has to measure, the seconds that this takes at most).

    Building the state spaces comes on top.
    """
    missing: dict[Path, int] = {}
    for run in study.runs:
        if (run.instance, run.chance) in tasks:
            for config in (run.config, {**run.config, "chance": NO_CHANCE}):
                cache, dependencies = ResultCache(directory / "hardness"), _dependencies(study, config)
                stored = (cache.get(dependencies) or {"measures": {}})["measures"]
                missing[cache.file(dependencies)] = sum(name not in stored for name in study.hardness.measures)
    return sum(number > 0 for number in missing.values()), sum(missing.values()) * study.hardness.budget


def _row_of_measures(names: Sequence[str], own: Mapping[str, Any], plain: Mapping[str, Any]) -> dict[str, Any]:
    """The measures of a task as columns: with chance if that is known, else without, which `notes` say."""
    row: dict[str, Any] = {"num_states": own.get("num_states") or plain.get("num_states")}
    notes = []
    for name in names:
        mine, other = (_usable(report["measures"].get(name, {})) for report in (own, plain))
        used = mine if mine.get("value") is not None else other
        row[name] = float("nan") if used.get("value") is None else used["value"]
        if used is not mine and used.get("value") is not None:
            notes.append(f"{name}: without chance, because {mine.get('why') or 'there is none with it'}")
        if used.get("value") is None:
            notes.append(f"{name}: none, because {used.get('why') or 'it is undefined'}")
        elif not used.get("exact", True) and used["lower"] < used["upper"]:
            notes.append(f"{name}: geometric mean of the proven interval {used['lower']:g} to {used['upper']:g}")
    return {**row, "notes": "; ".join(notes)}


def _usable(measure: dict[str, Any]) -> dict[str, Any]:
    """The measure, or the reason against it: a proven interval that is too wide to be one number."""
    if (
        measure.get("value") is None
        or measure.get("exact", True)
        or measure["upper"] <= WIDEST_FACTOR * measure["lower"]
    ):
        return measure
    return {"value": None, "why": f"only {measure['lower']:g} to {measure['upper']:g} is proven within the budget"}


def _dependencies(study: Specification, config: Mapping[str, Any]) -> dict[str, Any]:
    """Key of stored measures: what the measures of a run's task depend on."""
    dependencies = {name: config[name] for name in ("environment", "parameters", "chance", "horizon")}
    dependencies["gamma"] = study.hardness.gamma
    if "environment" in config.get("sources", {}):  # a class of the user's own, which may change
        dependencies["code"] = config["sources"]["environment"]["checksum"]
    return dependencies


def _measured(study: Specification, directory: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    cache, dependencies = ResultCache(directory / "hardness"), _dependencies(study, config)
    stored = cache.get(dependencies) or {"measures": {}, "num_states": None}
    missing = [name for name in study.hardness.measures if name not in stored["measures"]]
    if missing:
        stored, all_measures = _measure(study, config, missing, stored)
        cache.put(dependencies, **stored)
        return all_measures
    return stored


def _measure(
    study: Specification, config: Mapping[str, Any], names: Sequence[str], stored: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """(stored measures with new ones added, the same with those that failed): value, lower, upper and exact of each, or
    why there is none."""
    from pharos.hardness import report

    environment = make(config["environment"], **config["parameters"])
    mdp = build_mdp(config["environment"], config["parameters"], config["chance"], study.hardness.gamma)
    steps = config["horizon"] or environment.max_episode_steps
    measures, failed = dict(stored["measures"]), {}
    for name in names:
        try:
            result = report(mdp, [name], horizon=steps, budget=study.hardness.budget)[name]
            measures[name] = {"why": result.undefined} if result.undefined else _number(result.value, result.exact)
        except UnknownName as error:
            raise ParameterError(f"study {study.name!r}: {error}") from error
        except Exception as error:  # whatever it is, a report without this measure is better than none
            failed[name] = {"why": in_one_line(error)}
    stored = {**stored, "measures": measures, "num_states": mdp.num_states}
    return stored, {**stored, "measures": {**measures, **failed}}


def build_mdp(
    environment: str, parameters: Mapping[str, Any], chance: Mapping[str, float], gamma: float
) -> "TabularMDP":
    """The tabular MDP of a run. Its state space is built, or taken from the cache."""
    from pharos.state_space import build

    mdp = build(make(environment, **parameters), progress=False).mdp(gamma=gamma)
    return ChanceSetting.from_dict(chance).of(mdp)


def _number(value: Mapping[str, Any] | float | None, exact: bool) -> dict[str, Any]:
    """A measure as one positive number: itself, or the geometric mean of an interval with a finite upper end."""
    entry = value if isinstance(value, Mapping) else {"value": value}
    exact = bool(entry.get("exact", exact))
    lower, upper, number = entry.get("lower"), entry.get("upper"), entry.get("value")
    why = "it is infinite or undefined"
    if lower is None or (upper is None and exact):
        lower = upper = number = None if number is None else float(number)
    elif entry.get("exact"):
        number = lower
    elif upper is not None and np.isfinite(upper):
        number = float(np.sqrt(lower * upper))
    else:
        number, why = None, f"only a lower bound of {lower:g} is proven within the budget"
    if number is not None and not np.isfinite(number):
        return {"value": None, "why": "it is infinite"}
    return {"value": number, "lower": lower, "upper": upper, "exact": exact} | (
        {} if number is not None else {"why": why}
    )


# The paper's instances ------------------------------------------------------------------------------------------------


@cache
def _paper_instances() -> dict[tuple[str, str], tuple[str, int]]:
    """(class, parameters as JSON) -> (class, number of its block in the paper's table)."""
    return {
        (environment, _key(make(f"{environment}/{name}").parameters)): (environment, number)
        for environment, cls in classes().items()
        for number, name in enumerate(cls.paper_instances, start=1)
    }


def _key(parameters: Mapping[str, Any]) -> str:
    return json.dumps(parameters, sort_keys=True)


def paper_instance(environment: str, parameters: Mapping[str, Any]) -> int | None:
    """The number of the instance among the blocks of its class in the paper's appendix C, counted from 1. None if not
    there."""
    entry = _paper_instances().get((environment, _key(parameters)))
    return None if entry is None else entry[1]


# Regret of each cell, predicted before its runs by measures of representations ----------------------------------------


def predict(
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    blocks: Sequence[int] | None = None,
    agents: Sequence[str] | None = None,
    observations: Sequence[str] | None = None,
    primary: bool = False,
    progress: Callable[[str], None] | None = None,
) -> "pd.DataFrame":
    """Return predictions for each cell of a study whose agent learns from observations: a row each.

    Args:
        source, folder: as for `run`. No run is looked at.
        blocks, agents, observations: a part of the study: numbers of blocks from 1, names of agents, and of
            observations without their options. Default: all.
        primary: only the predictor that stands for each agent (`pharos.agents.Idealised`) with its table. Other columns
            are NaN, and `estimated_error` belongs to this predictor. A small part of the time.
        progress: called with what is being done.
    Returns:
        A row has the columns

        - `environment`, `instance`, `chance`, `agent`, `observation`, PREDICTORS, `network`
        - `estimated_error`: the error of `kernel_regret` if landmarks stand for the kernel
        - `curve` and `adam_curve`: the learner's steps and greedy regrets as JSON
        - of the predictor that stands for the agent NETWORK_PREDICTORS or NETWORK_POLICY_PREDICTORS, and
          `network_curve`
        - of actor-critics POLICY_PREDICTORS, `policy_curve`, and `clipped_curve`, the curve of the distribution over
          actions with PPO's clipping. NaN and "" in rows of others
        - `notes`: why a number is missing

        The idealised learner has the steps of the run, and of a DQN its discount, exploration and target network, of
        an actor-critic its rollouts, steps and discount.
    Raises:
        ParameterError: the study has no such cell.
    Cost: measures of hardness are kept beside the state spaces, so that a second call is quick.
    """
    import pandas as pd

    from pharos.agents import NETWORK_CURVE, POLICY_CURVES
    from pharos.prediction import predicted

    study, _ = opened(source, folder)
    rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for run in part_of(study, blocks, agents, observations):
        if agent_called(run.configuration.agent).has_table:
            continue
        key = tuple(run.cell.values())
        if key in rows:
            continue
        if progress is not None:
            progress(f"cell {len(rows) + 1}: {', '.join(key[1:])}")
        rows[key] = run.cell | predicted(run.config, primary=primary)
    if not rows:
        raise ParameterError(f"study {study.name!r}: no agent learns from observations, so there is nothing to predict")
    frame = pd.DataFrame(list(rows.values()))
    return frame.fillna({name: "" for name in (*POLICY_CURVES, NETWORK_CURVE) if name in frame})
