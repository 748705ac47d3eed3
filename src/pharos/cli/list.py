"""pharos list: the environments, their parameters and named instances, or one of them, parameter by parameter."""

import dataclasses
import inspect
import itertools
import re
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, console, print_table
from pharos.cli.options import complete_target
from pharos.environments import class_called, classes, declared_parameters, import_class, named_instances
from pharos.errors import UnknownName
from pharos.system.records import docstring_entries

if TYPE_CHECKING:
    from pharos.environments import Environment


def list_(
    name: Annotated[
        str | None, typer.Argument(metavar="[ENVIRONMENT]", show_default=False, autocompletion=complete_target)
    ] = None,
) -> Answer:
    """Show the environments with their parameters and instances, or the rules and parameters of one in full.

    Args:
        name: Show the rules and parameters of this class, or of file.py:Class.
    """
    if name is None:
        described = [_overview(name, cls) for name, cls in classes().items()]
        return Answer({"environments": described}, lambda: _print_all(described))
    cls = _class_called(name)
    answer = {**_overview(cls.name, cls), "rules": inspect.getdoc(cls), "parameters": _parameters(cls)}
    return Answer(answer, lambda: _print_one(cls))


def _class_called(name: str) -> type["Environment"]:
    """The class of a name, of a named instance, or of module:Class."""
    cls = class_called(name)
    if cls is not None:
        return cls
    if name in named_instances():
        return classes()[named_instances()[name][0]]
    if ":" in name:
        return import_class(name)
    raise UnknownName("environment", name, classes())


def _overview(name: str, cls: type["Environment"]) -> dict[str, Any]:
    return {
        "name": name,
        "description": _first_line(cls),
        "actions": list(cls.actions if isinstance(cls.actions, tuple) else cls().actions),
        "parameters": {field.name: _default(field) for field in dataclasses.fields(cls)},  # type: ignore[arg-type]
        "instances": {f"{name}/{instance}": dict(parameters) for instance, parameters in cls.instances.items()},
    }


def _parameters(cls: type["Environment"]) -> dict[str, dict[str, Any]]:
    """Name -> default, range and meaning of a parameter: the line under *Attributes* in the docstring of the class."""
    declared, texts = declared_parameters(cls), docstring_entries(cls)
    return {
        field.name: {
            "default": _default(field),
            "values": declared[field.name].text if field.name in declared else _annotation(field.type),
            "meaning": texts.get(field.name, ""),
        }
        for field in dataclasses.fields(cls)  # type: ignore[arg-type]
    }


def rules_of(cls: type["Environment"]) -> list[tuple[str, str]]:
    """(title, text) of each part of the docstring of a class before its attributes. A plain paragraph has no title.

    An entry has its title in the first nine columns, `State    (row, column)`, and goes on in lines that are indented.
    """
    blocks: list[tuple[str, str]] = []
    goes_on = False
    for line in (inspect.getdoc(cls) or "").partition("Attributes:\n")[0].splitlines():
        entry = re.match(r"([A-Z][a-z]+) +(?<=^.{9})(\S.*)", line)
        if entry:
            blocks.append((entry[1], entry[2]))
        elif goes_on:
            blocks[-1] = (blocks[-1][0], f"{blocks[-1][1]} {line.strip()}".rstrip())
        elif line.strip():
            blocks.append(("", line.strip()))
        goes_on = bool(line.strip())
    return blocks


def _annotation(annotation: object) -> str:
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))
    words = {"int": "integer", "float": "number", "bool": "true or false", "str": "text"}
    return words.get(text.removesuffix(" | None"), text)


def _first_line(cls: type) -> str:
    return " ".join((cls.__doc__ or "").strip().split("\n\n")[0].split()).replace("`", "")


def _default(field: dataclasses.Field) -> object:
    if field.default is not dataclasses.MISSING:
        return field.default
    return field.default_factory() if field.default_factory is not dataclasses.MISSING else None


def _text(value: object) -> str:
    return "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _print_one(cls: type["Environment"]) -> None:
    from rich.markup import escape
    from rich.table import Table

    to = console()
    (_, first), *blocks = rules_of(cls) or [("", "")]
    to.print(f"[bold cyan]{cls.name}[/bold cyan]  {escape(first)}\n", highlight=False)
    for titled, group in itertools.groupby(blocks, lambda block: bool(block[0])):
        rules = Table.grid(padding=(0, 2, 0, 0))
        for block in group:
            rules.add_row(*(escape(text) for text in (block if titled else block[1:])))
        to.print(rules, "")
    parameters = _parameters(cls).items()
    rows = ((name, _text(each["default"]), each["values"], each["meaning"]) for name, each in parameters)
    print_table("", ("parameter", "default", "values", "meaning"), rows)
    if cls.instances:
        to.print(
            "\nnamed instances  " + "  ".join(f"{cls.name}/{instance}" for instance in cls.instances), highlight=False
        )


def _print_all(described: list[dict[str, Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 2, 1, 0), header_style="bold")
    table.add_column("environment", style="bold cyan", no_wrap=True)
    table.add_column("parameters and defaults", max_width=34)
    table.add_column("what it is, and its named instances", overflow="fold")
    for each in described:
        parameters = "\n".join(f"{name}={_text(value)}" for name, value in each["parameters"].items())
        names = "  ".join(name.partition("/")[2] for name in each["instances"])
        about = escape(each["description"]) + (f"\n[dim]{each['name']}/[/dim] {names}" if names else "")
        table.add_row(each["name"], escape(parameters), about)
    to = console()
    to.print(table)
    to.print(
        "One of them, parameter by parameter: [cyan]pharos list breakout[/cyan]\n"
        "Build one: [cyan]pharos build breakout height=12 columns=8[/cyan]    "
        "or by name: [cyan]pharos build breakout/12x8x1[/cyan]"
    )
