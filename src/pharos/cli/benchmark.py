"""pharos benchmark: agents on frozen tasks whose every state is known, and scores with units."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, complain, console, progress_bar, termination
from pharos.cli.command import Commands
from pharos.cli.options import Count, parse_seeds
from pharos.errors import AllRunsFailed
from pharos.system.wording import many

if TYPE_CHECKING:
    from pharos.benchmark import BenchmarkTask, Suite

app = Commands(no_args_is_help=True, help="Run agents on a frozen suite of solved tasks, and compare them.")

SuiteName = Annotated[str, typer.Argument(metavar="[SUITE]", help="Name of a suite, or FILE.yaml.")]


@app.command("show")
def show(suite: SuiteName = "v1") -> Answer:
    """Show the tasks of a suite, what is predicted of them, and how long baselines take."""
    from pharos.benchmark import load_suite

    loaded = load_suite(suite)
    ladders: list[dict[str, Any]] = [
        {
            "axis": each.axis,
            "unit": each.unit,
            "quantity": each.quantity,
            "tasks": [_entry(task) for task in each.tasks],
        }
        for each in loaded.ladders
    ]
    answer: dict[str, Any] = {"name": loaded.name, "digest": loaded.digest, "protocol": vars(loaded.protocol)}
    answer |= {"core": [_entry(task) for task in loaded.core], "ladders": ladders, "minutes": _minutes(loaded)}
    return Answer(answer, lambda: _print(loaded))


@app.command("run")
def run(
    *,
    agent: str,
    out: Path,
    suite: Annotated[str, typer.Option(metavar="NAME|FILE")] = "v1",
    hyperparameters: Mapping[str, Any] | None = None,
    seeds: Annotated[str, typer.Option(metavar="N|A:B|S,...")] = "10",
    quick: bool = False,
    tasks: Annotated[list[str] | None, typer.Option(metavar="core|AXIS|NAME")] = None,
    name: str | None = None,
    workers: Count | None = None,
) -> Answer:
    """Run an agent on the tasks of a suite. The same command resumes; what is finished stays.

    Args:
        agent: A name (dqn, ppo, q_learning, a2c, oracle, random), module:Class or file.py:Class, or file.py:learn.
        out: Folder for the runs and their results, of one agent with one setting.
        suite: Which tasks.
        hyperparameters: A hyperparameter, of all tasks.
        seeds: How many, from 0 on; or which, such as 1000:1003.
        quick: The first three seeds of the core alone; results are preliminary.
        tasks: The core, an axis or a task, and no other; several times for more.
        name: Label in tables; the agent's own when not given.
        workers: Processes; as many as processors when not given.
    """
    from pharos import benchmark

    numbers = list(range(int(seeds))) if seeds.isdigit() else parse_seeds(seeds)
    loaded = benchmark.load_suite(suite)
    with progress_bar("runs", 1000, "checking tasks, loading, compiling") as show, termination():
        try:
            outcome = benchmark.run(
                agent,
                loaded,
                out=out,
                seeds=numbers,
                quick=quick,
                tasks=tasks,
                name=name,
                hyperparameters=hyperparameters,
                workers=workers,
                progress=(lambda done, text: show(int(1000 * done), text)) if show else None,
            )
        except AllRunsFailed as all_failed:  # the answer says of each why
            outcome = all_failed.outcome
    results, missing = outcome.results, outcome.missing
    for reason, count in Counter(missing.values()).most_common():
        complain(f"{count} x {reason}")
    facts = [
        ("runs", f"{many(len(results.seeds), 'seed')} of {many(len(results.curves), 'task')}"),
        ("missing", "; ".join(missing) or "none"),
        ("regret", f"{results.mean():.4g} of uniform play, mean of all runs" if results.curves else "none"),
        ("results", out),
    ]
    answer = {
        "agent": results.agent,
        "suite": results.suite,
        "digest": results.digest,
        "seeds": results.seeds,
        "normalized_regret": {task: curve.mean() for task, curve in results.curves.items()},
        "failed": missing,
        "folder": out,
    }
    return Answer(answer, (f"{results.agent} on {results.suite}", facts), bool(missing))


def _entry(task: "BenchmarkTask") -> dict[str, Any]:
    return {name: value for name, value in vars(task).items() if name != "axis"}


def _minutes(suite: "Suite") -> dict[str, float]:
    """Minutes of one processor that all seeds of all tasks take, by baseline; tasks without a time are left out."""
    agents = dict.fromkeys(agent for task in suite.tasks for agent in task.seconds)
    seeds = suite.protocol.seeds
    return {agent: sum(task.seconds.get(agent, 0.0) for task in suite.tasks) * seeds / 60 for agent in agents}


def _print(suite: "Suite") -> None:
    from rich.markup import escape
    from rich.table import Table

    protocol, screen = suite.protocol, console()
    tasks = many(len(suite.tasks), "task")
    screen.print(f"[bold]{escape(suite.name)}[/bold], {tasks}: {suite.digest}", soft_wrap=True)
    screen.print(
        f"{protocol.steps:,} steps, {many(protocol.evaluations, 'evaluation')}, {many(protocol.seeds, 'seed')}, "
        f"gamma {protocol.gamma:g}, horizon {protocol.horizon}"
    )
    screen.print()
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("axis", "task", "level"):
        table.add_column(name)
    for name in ("DQN", "PPO", "table"):
        table.add_column(name, justify="right")
    axis = ""
    for ladder in [None, *suite.ladders]:
        for task in suite.core if ladder is None else ladder.tasks:
            level = "" if task.level is None or ladder is None else f"{task.level:.3g} {ladder.unit}"
            numbers = (task.predicted.get(name) for name in ("dqn", "ppo", "table"))
            cells = ("" if value is None else f"{value:.2f}" for value in numbers)
            table.add_row("" if task.axis == axis else escape(task.axis), escape(task.name), escape(level), *cells)
            axis = task.axis
    screen.print(table)
    text = "Regret as predicted before any run: 0 is optimal, 1 is uniform play."
    if minutes := _minutes(suite):
        times = ", ".join(f"{agent.upper()} {value:.0f}" for agent, value in minutes.items())
        text += f" Minutes of one processor for all seeds: {times}"
    screen.print(f"[dim]{text}[/dim]", soft_wrap=True)
