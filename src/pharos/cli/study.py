"""pharos study: a grid of training runs from a YAML file: show it, run it, see how far it is, report on it."""

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, complain, console, print_table, progress_bar, progress_line, termination
from pharos.cli.command import Commands
from pharos.cli.options import Count, Trust
from pharos.errors import AllRunsFailed, ParameterError, UnknownName
from pharos.observations import title
from pharos.system.wording import pluralize
from pharos.training import ExecutionOptions

if TYPE_CHECKING:
    from pharos.study import RunLog, Specification, Status

app = Commands(help="Run a grid of training runs, and make the paper's figures and tables of it.")

LINE_SECONDS = 30.0
MOST_TASKS = 500  # whose values are looked up


@dataclass(frozen=True)
class Study:
    """The study that a command works on.

    Attributes:
        spec: A YAML file, a study's folder, or a preset: quick, small, classes, paper, hardness-dev, hardness-sealed.
        out: folder of the results (default: studies/NAME).
        environments: YAML file with a list of environments, for studies that have none.
    """

    spec: Annotated[str, typer.Argument(metavar="SPEC")]
    out: Annotated[Path | None, "DIR"] = None
    environments: Annotated[Path | None, "FILE"] = None
    trust: Trust = False

    def opened(self) -> "tuple[Specification, Path]":
        """The specification of the study, and the folder of its results."""
        from pharos import study

        return study.opened(self.spec, self.out, trust=self.trust or None, environments=self.environments)


Inputs = Annotated[Study, "spec environments trust"]
Results = Annotated[Study, "spec out trust"]


@app.command("show")
def show(source: Inputs) -> Answer:
    """Print the grid: which instances, chances, observations and agents, and how many runs."""
    from pharos.study import specification

    study = specification(source.spec, trust=source.trust or None, environments=source.environments)
    rows = [{"id": run.id, "instance": run.instance, "config": run.config} for run in study.runs]
    answer = {"name": study.name, "num_runs": len(rows), "steps": _steps(study), "runs": rows}
    return Answer(answer, lambda: _print(study))


def _print(study: "Specification") -> None:
    from pharos.study import has_regret

    runs = study.runs
    groups: dict[tuple, dict[str, dict]] = {}
    tasks = {(run.instance, run.chance): run for run in runs}
    chances = {task: run.chance_in_words for task, run in tasks.items()}
    for run in runs:
        config = run.config
        group = groups.setdefault((run.instance, config["steps"]), {"chance": {}, "agent": {}, "observation": {}})
        group["chance"][chances[run.instance, run.chance]] = None
        group["agent"][config["agent"]] = None
        group["observation"][title(config["observation"], config["observation_options"])] = None
    counts = Counter((run.instance, run.config["steps"]) for run in runs)
    rows = [
        (instance, *(", ".join(values) for values in group.values()), f"{steps:,}", str(counts[instance, steps]))
        for (instance, steps), group in groups.items()
    ]
    notes = [
        f"{instance}, chance {run.chance}: V* is that of uniform play, so regret has no scale"
        for (instance, _), run in tasks.items()
        if len(tasks) <= MOST_TASKS and not has_regret(run.config)
    ]
    print_table(
        f"{study.name}  {study.description}",
        ("instance", "chance", "agents", "observations", ">steps", ">runs"),
        rows,
        notes=[*notes, f"{pluralize(len(runs), 'run')}, {pluralize(_steps(study), 'step')}"],
    )


@app.command("run")
def run(
    source: Study,
    *,
    execution: ExecutionOptions,
    on: Annotated[str, "local|slurm|ray"] = "local",
    shards: Count | None = None,
    slurm: Mapping[str, Any],
    address: str | None = None,
    log: Annotated[str | None, "tensorboard|wandb"] = None,
) -> Answer:
    """Execute the runs that are missing. Interrupt it at any time: the same command goes on from there.

    Args:
        on: Execute the runs here, on slurm or on ray.
        shards: With --on slurm: jobs of the array. Default: 8.
        slurm: With --on slurm: timeout_min=600, slurm_partition=cpu, ...
        address: With --on ray: address of the cluster. Default: start one.
        log: Write curves as runs finish, see `study log`.
    """
    from pharos import study

    if on not in ("local", "slurm", "ray"):
        raise UnknownName("place to run on", on, ("local", "slurm", "ray"))
    if log is not None and on == "slurm":
        raise ParameterError("--log goes with --on local or ray; write those of a cluster by `pharos study log`")
    opened, directory = source.opened()
    options = vars(execution)
    if on == "slurm":
        jobs = study.submit(opened, directory, shards=shards or 8, parameters=slurm, **options)
        names = [str(job.job_id) for job in jobs]
        submitted = f"submitted {len(jobs)} jobs: {', '.join(names)}; `pharos study status` says how far they are"
        return Answer(
            {"jobs": names}, submitted if jobs else "nothing is missing; `pharos study report` shows the results"
        )
    logs = None if log is None else study.RunLog(opened, directory, log)
    with _progress(logs) as report, termination():
        if on == "ray":
            end = study.run_on_ray(opened, directory, address=address, progress=report, **options)
        else:
            try:
                end = study.run(opened, directory, on_forecast=_print_forecast, progress=report, **options)
            except AllRunsFailed as error:  # the answer says of each why
                end = error.outcome
    if logs is not None:
        logs.update()
    return _answer(end, failed=bool(end.failed))


def _print_forecast(forecast: object) -> None:
    """Print the forecast of the duration on standard error."""
    console(stderr=True).print(str(forecast), soft_wrap=True)


@app.command("status")
def status(source: Study) -> Answer:
    """Count the runs that are finished, running, missing and failed, with the reasons."""
    from pharos import study

    return _answer(study.status(*source.opened()))


@app.command("report")
def report(
    source: Study,
    *,
    to: Annotated[Path | None, "DIR"] = None,
    predictions: Annotated[list[Path] | None, "FILE"] = None,
) -> Answer:
    """Make the figures and tables of the finished runs: one HTML file, PNG, PDF, CSV and LaTeX.

    Args:
        to: Write to this folder. Default: DIR/report of the study.
        predictions: Compare with this file of `pharos study predict`. Repeatable, for a study predicted in parts.
    """
    from pharos import study

    predicted = [study.read_predictions(each) for each in predictions or ()]
    with progress_line("report") as report:
        opened, directory = source.opened()
        written = study.report(opened, directory, out=to, progress=report, predictions=predicted)

    def text() -> None:
        for note in written.notes:
            complain(note)
        print(written.html)

    files = {"figures": list(map(str, written.figures)), "tables": list(map(str, written.tables))}
    return Answer({"html": str(written.html), **files, "notes": written.notes}, text)


@app.command("log")
def log(
    source: Results,
    *,
    to: Annotated[str, "tensorboard|wandb"],
    project: str | None = None,
    offline: bool = False,
) -> Answer:
    """Write the curves of finished runs, exact values and regret, for TensorBoard or Weights & Biases.

    Args:
        to: Program that shows the curves.
        project: Project of Weights & Biases. Default: the name of the study.
        offline: Write files for `wandb sync`, and send nothing to Weights & Biases.
    """
    from pharos import study

    if to == "tensorboard" and (project is not None or offline):
        raise ParameterError("--project and --offline are of Weights & Biases; expected them with --to wandb")
    with progress_line("log") as report:
        opened, directory = source.opened()
        number = study.RunLog(opened, directory, to, project=project, offline=offline).update(report)
    how = (
        f"tensorboard --logdir {directory / to}"
        if to == "tensorboard"
        else f"wandb sync {directory / to}/offline-run-*"
    )
    remedy = f"; `{how}` {'shows' if to == 'tensorboard' else 'sends'} them" if to == "tensorboard" or offline else ""
    answer = {"to": to, "folder": str(directory / to), "added": number}
    return Answer(answer, f"{directory / to}: {pluralize(number, 'run')} added{remedy}")


@app.command("predict")
def predict(
    source: Inputs,
    *,
    out: Annotated[Path, "FILE"],
    block: list[int] | None = None,
    agent: list[str] | None = None,
    observation: list[str] | None = None,
    primary: bool = False,
) -> Answer:
    """Predict the regret of each cell from what its network makes of its states, before any run, hashed and dated.

    Args:
        out: Write to this Parquet file.
        block: Predict only this block, counted from 1. Repeatable.
        agent: Predict only this agent. Repeatable.
        observation: Predict only this observation. Repeatable.
        primary: Compute only the predictor that stands for each agent, in a small part of the time.
    """
    from pharos import study
    from pharos.agents import primary_predictors

    opened, directory = source.opened()
    with progress_line("predicting", logged=True) as report:
        predictions = study.predict(
            opened,
            directory,
            blocks=block or None,
            agents=agent or None,
            observations=observation or None,
            primary=primary,
            progress=report,
        )
    record = study.write_predictions(opened, predictions, out)
    columns = predictions.columns.intersection(["kernel_regret", *primary_predictors().values()])
    absent = predictions[columns].isna().all(axis=1)
    missing = int(absent.sum())

    def text() -> None:
        print(f"{out}: {pluralize(len(predictions), 'cell')}, {record['date']}, sha256 {record['sha256']}")
        if missing:
            reason = predictions.loc[absent, "notes"].iloc[0]
            complain(f"{pluralize(missing, 'cell')} without a prediction, such as: {reason}")

    return Answer({"file": str(out), "cells": len(predictions), "missing": missing, **record}, text)


@app.command("pack")
def pack(source: Results, *, to: Annotated[Path, "FILE"]) -> Answer:
    """Put the finished runs into one Parquet file, to keep, publish or carry, without what the agents learnt.

    Args:
        to: Write to this Parquet file.
    """
    from pharos import study

    number = study.pack(*source.opened(), file=to)
    return Answer({"file": str(to), "runs": number}, f"{to}: {pluralize(number, 'run')}, {to.stat().st_size:,} bytes")


@app.command("unpack")
def unpack(
    file: Annotated[Path, "FILE"],
    *,
    into: Annotated[str | None, "SPEC"] = None,
    out: Annotated[Path | None, "DIR"] = None,
    trust: Trust = False,
) -> Answer:
    """Put packed runs into a study's folder. `pharos study run FOLDER` goes on with those that are missing.

    Args:
        file: File from `pharos study pack`.
        into: Put the runs that another study has as well into that study.
        out: Folder of the results. Default: studies/NAME.
    """
    from pharos import study

    folder, number = study.unpack(file, out, into=into, trust=trust)
    text = f"{folder}: {pluralize(number, 'run')} added; `pharos study report {folder}` reports on them"
    return Answer({"folder": str(folder), "added": number}, text)


def _answer(status: "Status", failed: bool = False) -> Answer:
    def text() -> None:
        print(status)
        if status.missing:
            print(f"{pluralize(status.missing, 'run')} missing; `pharos study run` goes on from there")
        for error, count in Counter(status.errors.values()).most_common(5):
            complain(f"{count} x {error}")
        for problem in list(status.damaged.values())[:5]:
            complain(problem)
        if status.damaged:
            complain(f"{len(status.damaged)} damaged, counted as missing; `pharos study run` executes them again")
        if status.errors:
            complain(f"logs: {status.folder}/runs/{next(iter(status.errors))}/log.txt; repeat with --retry-failed")

    return Answer(status.to_dict(), text, failed)


@contextlib.contextmanager
def _progress(logs: "RunLog | None") -> "Iterator[Callable[[Status], None]]":
    """A bar on a terminal, elsewhere a line on standard error every LINE_SECONDS. As often curves are written."""
    with progress_bar("runs", 1) as show:
        latest = time.monotonic()

        def report(status: "Status") -> None:
            nonlocal latest
            show(status.finished + status.failed, str(status), status.total)
            if time.monotonic() - latest > LINE_SECONDS:
                if not sys.stderr.isatty():
                    complain(status)
                if logs is not None:
                    logs.update()
                latest = time.monotonic()

        yield report


def _steps(study: "Specification") -> int:
    return sum(run.config["steps"] for run in study.runs)
