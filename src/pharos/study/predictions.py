"""Regret predicted before any run: what measures of representations say of each cell of a study, hashed and dated."""

import hashlib
import itertools
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from pharos import training
from pharos.agents import agent_kind
from pharos.errors import FileFormatError, ParameterError, PharosError, ResultCorrupted
from pharos.study.blocks import Run, Specification
from pharos.study.specification import Source
from pharos.study.status import opened
from pharos.study.tables import CELL
from pharos.study.values import task_of
from pharos.system.storage import plain
from pharos.system.wording import many

if TYPE_CHECKING:
    import pandas as pd

    from pharos.hardness import Rollouts, Schedule
    from pharos.mdp import TabularMDP

MEASURES = ("kernel_regret", "kernel_learning_time", "kernel_sample_complexity", "aliasing_floor", "exploration_time")
PREDICTORS = (
    *("kernel_regret", "kernel_regret_played", "adam_regret", "adam_regret_played"),
    *("tabular_regret", "tabular_regret_played"),
    *("kernel_learning_time", "kernel_sample_complexity", "aliasing_floor", "exploration_time", "num_states"),
)
"""Columns of predictions, numbers; the larger, the harder. `adam_regret` is kernel regret with `optimizer="adam"`."""
POLICY_PREDICTORS = (
    *("policy_regret", "policy_regret_played", "policy_tabular_regret"),
    *("policy_regret_evaluated", "clipped_regret", "clipped_regret_evaluated"),
)
"""Columns beside them where an agent is an actor-critic: `kernel_policy_regret`, as played, of a table, as evaluated;
and of PPO with its clipping, of the most probable actions and as evaluated."""
POLICY_CURVES = ("policy_curve", "clipped_curve")
ACTOR_CRITICS: Mapping[str, Mapping[str, Any]] = {
    "ppo": {"gae_lambda": 0.95, "clip_range": 0.2},
    "a2c": {"gae_lambda": 1.0, "clip_range": None},
}
"""Agents that learn as actor-critics, and what their hyperparameters are where they are not said."""
CURVE_POINTS = 40
_KEY = b"pharos.predictions"
_SAID = ("study", "sha256", "date", "version")

Predictions: TypeAlias = "tuple[pd.DataFrame, Mapping[str, str]]"
"""Rows, and what their file says of itself."""


def predict(
    source: Source, folder: str | os.PathLike | None = None, *, progress: Callable[[str], None] | None = None
) -> "pd.DataFrame":
    """Return what is predicted of each cell of a study whose agent learns from observations: a row each.

    Args:
        source, folder: as for `run`; no run is looked at.
        progress: called with what is being done.
    Returns:
        Columns `environment`, `instance`, `chance`, `agent`, `observation`; PREDICTORS; `network`; `estimated_error`,
        that of `kernel_regret` where landmarks stand for the kernel; `curve` and `adam_curve`, the learner's steps and
        greedy regrets as JSON; `notes`, why a number is missing. The idealised learner has the steps of the run, and of
        a DQN its discount, exploration and target network; of actor-critics, with the rollouts, steps and discount of
        the agent, POLICY_PREDICTORS, `policy_curve` and `clipped_curve`, that of the distribution over actions with
        PPO's clipping, NaN and "" in rows of others.
    Raises:
        ParameterError: the study has no such cell.
    Cost: measures of hardness are kept beside the state spaces, so that a second call is quick.
    """
    import pandas as pd

    study, _ = opened(source, folder)
    rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for run in study.runs:
        if agent_kind(run.configuration.agent).is_tabular:
            continue
        key = tuple(run.cell.values())
        if key in rows:
            continue
        if progress is not None:
            progress(f"predicting {', '.join(key[1:])}")
        rows[key] = run.cell | _predicted(run)
    if not rows:
        raise ParameterError(f"study {study.name!r}: no agent learns from observations, so there is nothing to predict")
    frame = pd.DataFrame(list(rows.values()))
    return frame.fillna({name: "" for name in POLICY_CURVES if name in frame})


def _predicted(run: Run) -> dict[str, Any]:
    from pharos.hardness import report
    from pharos.observations import representation

    numbers: dict[str, Any] = dict.fromkeys(PREDICTORS, math.nan)
    row = {**numbers, "network": "", "estimated_error": math.nan, "curve": "", "adam_curve": "", "notes": ""}
    try:
        task = task_of(run.config)
        name, initialisation = _network(run.config, task)
        features = representation(
            task.space, task.observation, name, initialisation=initialisation, **dict(task.observation_options)
        )
        options: dict[str, Any] = {"horizon": task.time_limit, "representation": features}
        schedule = _schedule(run.config)
        measures = report(task.mdp, MEASURES, schedule=schedule, **options)
        rescaled = report(task.mdp, ["kernel_regret"], schedule=replace(schedule, optimizer="adam"), **options)
        if run.config["agent"] in ACTOR_CRITICS:
            row |= _of_policy(run.config, task.mdp, options)
    except PharosError as error:
        return {**row, "notes": str(error)}
    row |= {"num_states": float(task.mdp.num_states), "network": f"{name}, {initialisation}"}
    regret = measures["kernel_regret"].value
    if regret is not None:
        row |= {"kernel_regret": regret["value"], "kernel_regret_played": regret["played"]}
        row |= {"tabular_regret": regret["tabular"], "tabular_regret_played": regret["tabular_played"]}
        row |= {"estimated_error": regret["estimated_error"], "curve": _curve(regret)}
    regret = rescaled["kernel_regret"].value
    if regret is not None:
        row |= {"adam_regret": regret["value"], "adam_regret_played": regret["played"], "adam_curve": _curve(regret)}
    for measure in MEASURES[1:]:
        value = measures[measure].value
        if value is not None:
            row[measure] = float(value["value"] if isinstance(value, Mapping) else value)
    notes = (result.undefined or result.certificate.note for result in measures.results.values())
    return {**row, "notes": "; ".join(note for note in notes if note)}


def _of_policy(config: Mapping[str, Any], mdp: "TabularMDP", options: Mapping[str, Any]) -> dict[str, Any]:
    """POLICY_PREDICTORS and POLICY_CURVES, of the idealised actor-critic with the rollouts and steps of the agent."""
    from pharos.hardness import Schedule, report

    name, (rollouts, clip_range) = "kernel_policy_regret", _rollouts(config)
    schedule = Schedule(steps=config["steps"], gamma=config["hyperparameters"].get("gamma", Schedule.gamma))

    def learnt(rollouts: "Rollouts") -> Any:
        return report(mdp, [name], schedule=schedule, rollouts=rollouts, **options)[name].value

    regret = learnt(rollouts)
    clipped = None if clip_range is None else learnt(replace(rollouts, clip_range=clip_range))
    row = {**dict.fromkeys(POLICY_PREDICTORS, math.nan), **dict.fromkeys(POLICY_CURVES, "")}
    if regret is not None:
        numbers = (regret["value"], regret["played"], regret["tabular"], _evaluated(regret))
        row |= {**dict(zip(POLICY_PREDICTORS, numbers, strict=False)), "policy_curve": _curve(regret)}
    if clipped is not None:
        row |= {"clipped_regret": clipped["value"], "clipped_regret_evaluated": _evaluated(clipped)}
        row["clipped_curve"] = _curve(clipped, "played")
    return row


def _rollouts(config: Mapping[str, Any]) -> tuple["Rollouts", float | None]:
    """Those of an actor-critic, without clipping; and how far its agent clips."""
    from pharos.hardness import Rollouts

    own = {**ACTOR_CRITICS[config["agent"]], **config["hyperparameters"]}
    steps = int(own["n_steps"]) * int(own.get("n_envs", 1))
    minibatches = math.ceil(steps / int(own["batch_size"])) if own.get("batch_size") else 1
    gradient_steps = minibatches * int(own.get("n_epochs", 1))
    return Rollouts(steps=steps, gradient_steps=gradient_steps, gae_lambda=own["gae_lambda"]), own["clip_range"]


def _evaluated(regret: Mapping[str, Any]) -> float:
    """`LearningCurve.mean_evaluated`, which results that were kept before it was there do not have."""
    from pharos.hardness import LearningCurve

    return LearningCurve(**{name: np.asarray(values) for name, values in regret["curve"].items()}).mean_evaluated


def _curve(regret: Mapping[str, Any], of: str = "greedy") -> str:
    """Steps and regret of the idealised learner, of at most CURVE_POINTS of its phases, as JSON."""
    steps, regrets = regret["curve"]["steps"], regret["curve"][of]
    every = max(1, math.ceil(len(steps) / CURVE_POINTS))
    return json.dumps(
        [[int(step), round(value, 4)] for step, value in zip(steps[::every], regrets[::every], strict=True)]
    )


def _network(config: Mapping[str, Any], task: Any) -> tuple[str, str]:
    """The name and the initialisation of the network of an agent of pharos."""
    from pharos.observations import default_network, observe

    observation = observe(task.env, task.observation, state_space=task.space, **dict(task.observation_options))
    name, hidden = default_network(observation.space), _hidden_layers(config["hyperparameters"])
    if hidden != [128]:
        name = "-".join([name.removesuffix("x2"), *(["128"] if "mlp" not in name else []), *map(str, hidden)])
    return (name, "pytorch") if config["agent"] == "dqn" else (f"{name}+tanh", "sb3")


def _hidden_layers(hyperparameters: Mapping[str, Any]) -> list[int]:
    """Units of the layers after the features, the same for policy and value.

    Raises:
        ParameterError: they differ, or the network is not of the kind that has a closed form.
    """
    own = dict(hyperparameters.get("policy_kwargs") or {})
    layers = own.pop("net_arch", hyperparameters.get("net_arch", [128]))
    if own:
        raise ParameterError(f"policy_kwargs has {min(own)!r}; only net_arch may differ for predictions")
    if isinstance(layers, Mapping):
        if layers.get("pi") != layers.get("vf"):
            raise ParameterError(f"net_arch is {dict(layers)}; predictions need the same layers for policy and value")
        layers = layers.get("pi") or []
    return list(layers)


def _schedule(config: Mapping[str, Any]) -> "Schedule":
    """That of a DQN by its hyperparameters; of others the steps alone."""
    from pharos.hardness import Schedule

    hyperparameters = config["hyperparameters"]
    if config["agent"] != "dqn":
        return Schedule(steps=config["steps"])
    same = ("learning_starts", "exploration_initial_eps", "exploration_final_eps", "exploration_fraction", "gamma")
    options = {name: hyperparameters[name] for name in same if name in hyperparameters}
    period, every = int(hyperparameters.get("target_update_interval", 250)), hyperparameters.get("train_freq", 4)
    every = every if isinstance(every, int) else 4
    copies = int(hyperparameters.get("gradient_steps", 1))
    steps = max(1, round(period * (copies / every if copies > 0 else 1.0)))
    return Schedule(steps=config["steps"], period=period, gradient_steps=steps, **options)


def write_predictions(study: Specification, predictions: "pd.DataFrame", file: str | os.PathLike) -> dict[str, str]:
    """Write predictions into a Parquet file with their SHA-256, the date and the version; return these.

    The hash is of the rows alone: the same predictions have the same hash on any day. No prediction is lost: where the
    file holds the same ones it stays, with the date that it has, which is returned; where it holds others it is kept
    beside, with its date in its name.

    Raises:
        OSError: the file cannot be written; an older one then stays as it was.
    """
    import pyarrow as pa

    from pharos import __version__

    said = {
        "study": study.name,
        "sha256": _hash(predictions),
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "version": __version__,
    }
    older = _description(Path(file))
    if older is not None and older["sha256"] == said["sha256"]:
        return older
    table = pa.Table.from_pandas(predictions, preserve_index=False)
    table = table.replace_schema_metadata({_KEY: json.dumps(said).encode()})
    Path(file).parent.mkdir(parents=True, exist_ok=True)
    if older is None:
        training.write_table(Path(file), table)
        return said
    beside = _place_beside(Path(file), older["date"])
    os.replace(file, beside)
    try:
        training.write_table(Path(file), table)
    except BaseException:
        os.replace(beside, file)
        raise
    return said


def _description(file: Path) -> dict[str, str] | None:
    """What a file of predictions says of itself; None where there is none, or it is no such file."""
    try:
        return read_predictions(file)[1]
    except PharosError:
        return None


def _place_beside(file: Path, date: str) -> Path:
    """`predictions.2026-11-23T034702Z.parquet`, or with a number where that is taken."""
    name = f"{file.stem}.{date.replace(':', '')}"
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(place for each in names if not (place := file.with_name(each + file.suffix)).exists())


def read_predictions(file: str | os.PathLike) -> "tuple[pd.DataFrame, dict[str, str]]":
    """Read what `write_predictions` wrote: the rows; study, hash, date and version.

    Raises:
        FileFormatError: it is no file of predictions. ResultCorrupted: it was changed after it was written.
    """
    remedy = "write them with `pharos study predict SPEC --out FILE`"
    if not Path(file).is_file():
        raise FileFormatError(f"{file}: no such file; expected predictions: {remedy}")
    table = training.read_table(Path(file), "write it again")
    said = (table.schema.metadata or {}).get(_KEY)
    if said is None or not {*PREDICTORS, *CELL} <= {*table.column_names}:
        raise FileFormatError(f"{file}: holds no predictions; {remedy}")
    try:
        about = json.loads(said)
    except ValueError:
        about = None
    if not isinstance(about, dict) or not all(isinstance(about.get(name), str) for name in _SAID):
        raise ResultCorrupted(f"{file}: what it says of itself is damaged; expected {', '.join(_SAID)}")
    frame = table.to_pandas()
    if about["sha256"] != _hash(frame):
        raise ResultCorrupted(f"{file}: its rows are not those whose hash it has; it was changed after it was written")
    return frame, about


def _hash(frame: "pd.DataFrame") -> str:
    columns = {name: frame[name].tolist() for name in sorted(frame.columns)}
    text = json.dumps(plain(columns), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class Foretold:
    """What was predicted of the cells of a study, at once or in parts.

    Attributes:
        parts: as `read_predictions` returns them, of different cells.
        cells: the rows of all.
    Raises:
        ParameterError: a cell is predicted in two parts.
    """

    parts: "Sequence[Predictions]"
    cells: "pd.DataFrame" = field(init=False)

    def __post_init__(self) -> None:
        import pandas as pd

        cells = pd.concat([frame for frame, _ in self.parts], ignore_index=True)
        twice = cells[cells.duplicated(CELL)][CELL]
        if len(twice):
            raise ParameterError(
                f"{many(len(twice), 'cell')} predicted twice, such as {', '.join(twice.iloc[0])}; "
                "expected files of different cells"
            )
        object.__setattr__(self, "cells", cells.fillna({name: "" for name in POLICY_CURVES if name in cells}))

    @staticmethod
    def of(predictions: "Predictions | Sequence[Predictions] | None") -> "Foretold | None":
        """Of one file, of several, or of none."""
        parts = [predictions] if isinstance(predictions, tuple) else list(predictions or ())
        return Foretold(parts) if parts else None

    def late(self, runs: "pd.DataFrame") -> tuple[int, int]:
        """(runs that had begun when the predictions were written, runs that do not say when they began): numbers.

        Where there are several parts, of the runs that they are about, each.
        """
        if len(self.parts) == 1:
            return late(runs, self.parts[0][1])
        each = [late(runs.merge(frame[CELL], on=CELL), about) for frame, about in self.parts]
        return sum(before for before, _ in each), sum(unknown for _, unknown in each)


def late(runs: "pd.DataFrame", about: Mapping[str, str]) -> tuple[int, int]:
    """(runs that had begun when predictions were written, runs that do not say when they began): numbers."""
    began = runs["began"] if "began" in runs else runs["id"].map(lambda _: "")
    return int(((began != "") & (began <= about["date"])).sum()), int((began == "").sum())
