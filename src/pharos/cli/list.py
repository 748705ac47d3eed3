"""pharos list: the environments, their parameters and named instances."""

import dataclasses
from typing import Any

from pharos.cli.common import Json, console, print_json


def list_(json: Json = False) -> None:
    """Show the environments, their parameters with defaults, and the named instances."""
    from pharos.environments import classes, named_instances

    instances = named_instances()
    found = [
        {
            "name": name,
            "description": _first_line(cls),
            "actions": list(cls.actions),
            "parameters": {field.name: _default(field) for field in dataclasses.fields(cls)},  # type: ignore[arg-type]
            "instances": {
                instance: dict(parameters) for instance, (owner, parameters) in instances.items() if owner == name
            },
        }
        for name, cls in classes().items()
    ]
    if json:
        print_json({"environments": found})
        return
    _print(found)


def _first_line(cls: type) -> str:
    return " ".join((cls.__doc__ or "").strip().split("\n\n")[0].split()).replace("`", "")


def _default(field: dataclasses.Field) -> Any:
    if field.default is not dataclasses.MISSING:
        return field.default
    return field.default_factory() if field.default_factory is not dataclasses.MISSING else None


def _print(found: list[dict[str, Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 2, 1, 0), header_style="bold")
    table.add_column("environment", style="bold cyan", no_wrap=True)
    table.add_column("parameters and defaults", max_width=34)
    table.add_column("named instances", overflow="fold", style="dim")
    for each in found:
        parameters = "\n".join(
            f"{name}={'none' if value is None else value}" for name, value in each["parameters"].items()
        )
        names = "  ".join(name.partition("/")[2] for name in each["instances"])
        about = escape(each["description"]) + (f"\n[dim]{each['name']}/[/dim] {names}" if names else "")
        table.add_row(each["name"], escape(parameters), about)
    table.columns[2].header = "what it is, and its named instances"
    table.columns[2].style = ""
    to = console()
    to.print(table)
    to.print(
        "Build one: [cyan]pharos build breakout height=12 columns=8[/cyan]    "
        "or by name: [cyan]pharos build breakout/12x8x1[/cyan]"
    )
