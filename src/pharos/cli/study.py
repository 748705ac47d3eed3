"""pharos study: a grid of training runs from a YAML file: show it, run it, see how far it is, report on it."""

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from pharos.cli.answers import complain, console, print_json, progress_line, termination
from pharos.cli.options import Json, Trust, parse_parameters
from pharos.errors import AllRunsFailed, ParameterError, UnknownName
from pharos.observations import title
from pharos.system.wording import many

app = typer.Typer(help="Run a grid of training runs, and make the paper's figures and tables of it.")

SpecArgument = Annotated[
    str,
    typer.Argument(
        metavar="SPEC",
        help="A YAML file, a study's folder, or a preset: quick, small, classes, paper, hardness-dev, hardness-sealed.",
    ),
]
Out = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Where results are; studies/NAME when not given.")
]
Environments = Annotated[
    Path | None,
    typer.Option(
        "--environments", metavar="FILE", help="YAML: a list of environments, for studies that have none of their own."
    ),
]
EXIT_FAILED = 1
LINE_SECONDS = 30.0
MOST_TASKS = 500  # whose values are looked up


@app.command("show")
def show(spec: SpecArgument, environments: Environments = None, trust: Trust = False, json: Json = False) -> None:
    """Print the grid: which instances, chances, observations and agents, and how many runs."""
    from pharos.study import has_regret, specification

    study = specification(spec, trust=trust or None, environments=environments)
    runs = study.runs
    if json:
        rows = [{"id": run.id, "instance": run.instance, "config": run.config} for run in runs]
        print_json({"name": study.name, "num_runs": len(runs), "steps": sum(_steps(runs)), "runs": rows})
        return
    from rich.markup import escape
    from rich.table import Table

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
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("instance", "chance", "agents", "observations"):
        table.add_column(name, overflow="fold", style="cyan" if name == "instance" else "")
    table.add_column("steps", justify="right")
    table.add_column("runs", justify="right")
    for key, group in groups.items():
        lists = (", ".join(values) for values in group.values())
        table.add_row(escape(key[0]), *map(escape, lists), f"{key[1]:,}", str(counts[key]))
    to = console()
    to.print(f"[bold]{escape(study.name)}[/bold]  {escape(study.description)}", soft_wrap=True)
    to.print(table)
    for (instance, _), run in tasks.items():
        if len(tasks) <= MOST_TASKS and not has_regret(run.config):
            to.print(escape(f"{instance}, chance {run.chance}: V* is that of uniform play, so regret has no scale"))
    to.print(f"{many(len(runs), 'run')}, {many(sum(_steps(runs)), 'step')}", style="dim")


@app.command("run")
def run(
    spec: SpecArgument,
    out: Out = None,
    shard: Annotated[
        str | None, typer.Option("--shard", metavar="I/N", help="Only the I-th of N parts, such as 1/8.")
    ] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Execute failed runs again.")] = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Killed runs go on from their last checkpoint; their results may then differ."),
    ] = False,
    timeout: Annotated[
        float | None, typer.Option("--timeout", min=0, help="Seconds after which a run is ended, and failed.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Processes; as many as processors when not given.")
    ] = None,
    device: Annotated[str, typer.Option("--device", help="Of batches: cpu or cuda.")] = "cpu",
    on: Annotated[str, typer.Option("--on", metavar="local|slurm|ray", help="Where the runs are executed.")] = "local",
    shards: Annotated[
        int | None, typer.Option("--shards", min=1, help="With --on slurm: jobs of the array; 8 when not given.")
    ] = None,
    slurm: Annotated[
        list[str] | None,
        typer.Option(
            "--slurm", metavar="NAME=VALUE", help="With --on slurm: timeout_min=600, slurm_partition=cpu, ..."
        ),
    ] = None,
    address: Annotated[
        str | None, typer.Option("--address", help="With --on ray: of the cluster; one is started when not given.")
    ] = None,
    to: Annotated[
        str | None,
        typer.Option("--log", metavar="tensorboard|wandb", help="Write curves there as runs finish; see `study log`."),
    ] = None,
    environments: Environments = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Execute the runs that are missing. Interrupt it at any time: the same command goes on from there."""
    from pharos import study

    if on not in ("local", "slurm", "ray"):
        raise UnknownName("place to run on", on, ("local", "slurm", "ray"))
    opened, place = study.opened(spec, out, trust=trust or None, environments=environments)
    if on == "slurm":
        jobs = study.submit(
            opened,
            place,
            shards=shards or 8,
            parameters=parse_parameters(slurm),
            retry_failed=retry_failed,
            resume=resume,
            timeout=timeout,
            workers=workers or 1,
        )
        _print_jobs([str(job.job_id) for job in jobs], json)
        return
    if to is not None and on == "slurm":
        raise ParameterError("--log goes with --on local or ray; write those of a cluster by `pharos study log`")
    logs = None if to is None else study.RunLog(opened, place, to)
    with _progress() as shown, termination():
        progress = shown if logs is None else _logging(logs, shown)
        if on == "ray":
            end = study.run_on_ray(
                opened,
                place,
                address=address,
                shard=shard,
                retry_failed=retry_failed,
                resume=resume,
                progress=progress,
            )
        else:
            try:
                end = study.run(
                    opened,
                    place,
                    shard=shard,
                    retry_failed=retry_failed,
                    resume=resume,
                    timeout=timeout,
                    workers=workers,
                    progress=progress,
                    foretold=_say,
                    device=device,
                )
            except AllRunsFailed as error:  # the answer says of each why
                end = error.outcome
    if logs is not None:
        logs.update()
    _answer(end, json)
    if end.failed:
        raise typer.Exit(EXIT_FAILED)


def _logging(logs: Any, progress: Callable[[Any], None]) -> Callable[[Any], None]:
    """Progress that also writes the curves of runs that have finished, every LINE_SECONDS at most."""
    written = time.monotonic()

    def tell(status: Any) -> None:
        nonlocal written
        progress(status)
        if time.monotonic() - written > LINE_SECONDS:
            logs.update()
            written = time.monotonic()

    return tell


def _say(forecast: Any) -> None:
    """How long it will take, on standard error."""
    console(stderr=True).print(str(forecast), soft_wrap=True)


def _print_jobs(jobs: list[str], json: bool) -> None:
    if json:
        print_json({"jobs": jobs})
    elif not jobs:
        print("nothing is missing; `pharos study report` shows the results")
    else:
        print(f"submitted {len(jobs)} jobs: {', '.join(jobs)}; `pharos study status` says how far they are")


@app.command("status")
def status(
    spec: SpecArgument,
    out: Out = None,
    environments: Environments = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """How many runs are finished, running, missing and failed, and why."""
    from pharos import study

    _answer(study.status(*study.opened(spec, out, trust=trust or None, environments=environments)), json)


@app.command("report")
def report(
    spec: SpecArgument,
    out: Out = None,
    to: Annotated[
        Path | None, typer.Option("--to", metavar="DIR", help="Where to write; DIR/report of the study when not given.")
    ] = None,
    predictions: Annotated[
        list[Path] | None,
        typer.Option(
            "--predictions",
            metavar="FILE",
            help="Of `pharos study predict`: what came true of them; again for a study predicted in parts.",
        ),
    ] = None,
    environments: Environments = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Make the figures and tables of the finished runs: one HTML file, PNG, PDF, CSV and LaTeX."""
    from pharos import study

    foretold = [study.read_predictions(each) for each in predictions or ()]
    with progress_line("report") as tell:
        opened, place = study.opened(spec, out, trust=trust or None, environments=environments)
        written = study.report(opened, place, out=to, progress=tell, predictions=foretold)
    if json:
        files = {"figures": list(map(str, written.figures)), "tables": list(map(str, written.tables))}
        print_json({"html": str(written.html), **files, "notes": written.notes})
        return
    for note in written.notes:
        complain(note)
    print(written.html)


@app.command("log")
def log(
    spec: SpecArgument,
    to: Annotated[str, typer.Option("--to", metavar="tensorboard|wandb", help="Where the curves are looked at.")],
    out: Out = None,
    project: Annotated[
        str | None, typer.Option("--project", help="Of Weights & Biases; the name of the study when not given.")
    ] = None,
    offline: Annotated[
        bool, typer.Option("--offline", help="Weights & Biases writes files for `wandb sync`, and sends nothing.")
    ] = False,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Write the curves of finished runs, exact values and regret, for TensorBoard or Weights & Biases."""
    from pharos import study

    if to == "tensorboard" and (project is not None or offline):
        raise ParameterError("--project and --offline are of Weights & Biases; expected them with --to wandb")
    with progress_line("log") as tell:
        opened, place = study.opened(spec, out, trust=trust or None)
        number = study.RunLog(opened, place, to, project=project, offline=offline).update(tell)
    if json:
        print_json({"to": to, "folder": str(place / to), "added": number})
        return
    how = f"tensorboard --logdir {place / to}" if to == "tensorboard" else f"wandb sync {place / to}/offline-run-*"
    remedy = f"; `{how}` {'shows' if to == 'tensorboard' else 'sends'} them" if to == "tensorboard" or offline else ""
    print(f"{place / to}: {many(number, 'run')} added{remedy}")


@app.command("predict")
def predict(
    spec: SpecArgument,
    to: Annotated[Path, typer.Option("--out", metavar="FILE", help="The Parquet file to write.")],
    block: Annotated[
        list[int] | None, typer.Option("--block", help="Of these blocks alone, from 1; again for another one.")
    ] = None,
    agent: Annotated[list[str] | None, typer.Option("--agent", help="Of this agent alone; again for another.")] = None,
    observation: Annotated[
        list[str] | None, typer.Option("--observation", help="Of this observation alone; again for another one.")
    ] = None,
    environments: Environments = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Predict the regret of each cell from what its network makes of its states, before any run; hashed and dated."""
    from pharos import study

    opened, place = study.opened(spec, None, trust=trust or None, environments=environments)
    with progress_line("predicting", logged=True) as tell:
        predictions = study.predict(
            opened, place, blocks=block or None, agents=agent or None, observations=observation or None, progress=tell
        )
    said = study.write_predictions(opened, predictions, to)
    missing = int(predictions["kernel_regret"].isna().sum())
    if json:
        print_json({"file": str(to), "cells": len(predictions), "missing": missing, **said})
        return
    print(f"{to}: {many(len(predictions), 'cell')}, {said['date']}, sha256 {said['sha256']}")
    if missing:
        notes = predictions.loc[predictions["kernel_regret"].isna(), "notes"]
        complain(f"{many(missing, 'cell')} without a prediction, such as: {notes.iloc[0]}")


@app.command("pack")
def pack(
    spec: SpecArgument,
    to: Annotated[Path, typer.Option("--to", metavar="FILE", help="The Parquet file to write.")],
    out: Out = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Put the finished runs into one Parquet file, to keep, publish or carry; without what the agents learnt."""
    from pharos import study

    number = study.pack(*study.opened(spec, out, trust=trust or None), file=to)
    if json:
        print_json({"file": str(to), "runs": number})
        return
    print(f"{to}: {many(number, 'run')}, {to.stat().st_size:,} bytes")


@app.command("unpack")
def unpack(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Written by `pharos study pack`.")],
    into: Annotated[
        str | None,
        typer.Option(metavar="SPEC", help="Another study, which gets those of the runs that it has as well."),
    ] = None,
    out: Out = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Put packed runs into a study's folder; `pharos study run FOLDER` goes on with those that are missing."""
    from pharos import study

    folder, number = study.unpack(file, out, into=into, trust=trust)
    if json:
        print_json({"folder": str(folder), "added": number})
        return
    print(f"{folder}: {many(number, 'run')} added; `pharos study report {folder}` reports on them")


def _answer(status: Any, json: bool) -> None:
    if json:
        print_json(status.to_dict())
        return
    print(status)
    if status.missing:
        print(f"{many(status.missing, 'run')} missing; `pharos study run` goes on from there")
    for error, count in Counter(status.errors.values()).most_common(5):
        complain(f"{count} x {error}")
    for problem in list(status.damaged.values())[:5]:
        complain(problem)
    if status.damaged:
        complain(f"{len(status.damaged)} damaged, counted as missing; `pharos study run` executes them again")
    if status.errors:
        complain(f"logs: {status.folder}/runs/{next(iter(status.errors))}/log.txt; repeat with --retry-failed")


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[Any], None]]:
    """A bar on a terminal; elsewhere a line on standard error now and then."""
    if not sys.stderr.isatty():
        last_line = time.monotonic()

        def say(status: Any) -> None:
            nonlocal last_line
            if time.monotonic() - last_line > LINE_SECONDS:
                last_line = time.monotonic()
                complain(status)

        yield say
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    with Progress(
        BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), console=console(stderr=True)
    ) as bar:
        task = bar.add_task("", total=None)

        def show(status: Any) -> None:
            bar.update(task, total=status.total, completed=status.finished + status.failed, description=str(status))

        yield show


def _steps(runs) -> list[int]:
    return [run.config["steps"] for run in runs]
