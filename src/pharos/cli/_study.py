"""pharos study: a grid of training runs from a YAML file: show it, run it, see how far it is, report on it."""

from collections import Counter
from typing import Annotated

import typer

from pharos.cli.common import Json, console, print_json

app = typer.Typer(help="Run a grid of training runs, and make the paper's figures and tables of it.")

SpecArgument = Annotated[str, typer.Argument(metavar="SPEC", help="A YAML file, or a preset: quick, small, paper.")]


@app.command("show")
def show(spec: SpecArgument, json: Json = False) -> None:
    """Print the grid: which instances, chances, observations and agents, and how many runs."""
    from pharos.study import specification

    study = specification(spec)
    runs = study.runs
    if json:
        rows = [{"id": run.id, "instance": run.instance, "config": run.config} for run in runs]
        print_json({"name": study.name, "num_runs": len(runs), "steps": sum(_steps(runs)), "runs": rows})
        return
    from rich.markup import escape
    from rich.table import Table

    groups: dict[tuple, dict[str, dict]] = {}
    for run in runs:
        config = run.config
        group = groups.setdefault((run.instance, config["steps"]), {"chance": {}, "agent": {}, "observation": {}})
        group["chance"][run.chance] = None
        group["agent"][config["agent"]] = None
        group["observation"][config["observation"]] = None
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
    to.print(f"{len(runs):,} runs, {sum(_steps(runs)):,} steps", style="dim")


def _steps(runs) -> list[int]:
    return [run.config["steps"] for run in runs]
