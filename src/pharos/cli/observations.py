"""pharos observations: what an agent sees, and which states it cannot tell apart."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.common import (
    Json,
    MaxStates,
    Memory,
    Parameters,
    TargetArgument,
    Workers,
    build_options,
    console,
    parse_parameters,
    parse_target,
    print_json,
    progress_bar,
)
from pharos.errors import ParameterError
from pharos.wording import many

if TYPE_CHECKING:
    from pharos.state_space import StateSpace

# What is counted when nothing is asked for
COUNTED: tuple[tuple[str, dict[str, Any]], ...] = (
    ("vector", {}),
    ("one_hot", {}),
    ("index", {}),
    ("simple_image", {}),
    ("complex_image", {}),
)


def observations(
    target: TargetArgument,
    parameters: Parameters = None,
    observation: Annotated[
        list[str] | None,
        typer.Option("--observation", help="This one alone, or your own; may be given several times."),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="NAME=VALUE", help="Option of the observations that were named."),
    ] = None,
    memory: Memory = None,
    workers: Workers = None,
    max_states: MaxStates = None,
    json: Json = False,
) -> None:
    """Count the states that share their observation with another state."""
    options = parse_parameters(option)
    if options and not observation:
        raise ParameterError("--option goes with --observation NAME")
    asked = tuple((name, options) for name in observation) if observation else COUNTED
    space = parse_target(target, parameters).space(**build_options(memory, workers, max_states))
    if space.environment is None:
        raise ParameterError(f"{target}: pharos does not know the class of this environment; name it as module:Class")
    entries = [_entry(space, name, options, strict=bool(observation)) for name, options in asked]
    if json:
        answer = {"environment": space.environment.name, "parameters": space.environment.parameters}
        print_json({**answer, "num_states": space.num_states, "observations": entries})
        return
    _print(" ".join((target, *(parameters or ()))), space, entries)


def _entry(space: "StateSpace", name: str, options: dict[str, Any], *, strict: bool) -> dict[str, Any]:
    """What is said of one observation.

    Args:
        strict: whether an observation that the environment does not have is an error; else it is said in the entry.
    """
    from pharos.observations import aliasing, observe

    entry: dict[str, Any] = {"observation": name, "options": options}
    env: Any = space.environment
    try:
        seen = observe(env, name, state_space=space, **options)
    except ParameterError as error:
        if strict:
            raise
        return entry | {"unavailable": str(error)}
    with progress_bar("observing", space.num_states, name) as progress:
        counts = aliasing(space, seen, progress=progress)
    return entry | {
        "shape": list(seen.space.shape or ()),
        "dtype": str(seen.space.dtype),
        "num_observations": counts.num_observations,
        "num_sharing": counts.num_sharing,
        "share": counts.share,
        "num_confused": counts.num_confused,
    }


def _print(title: str, space: "StateSpace", entries: list[dict[str, Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("observation", style="cyan", no_wrap=True)
    for heading in ("shape", "type"):
        table.add_column(heading)
    for heading in ("different", "states that share one", "share", "where one acts"):
        table.add_column(heading, justify="right")
    for entry in entries:
        words = " ".join((entry["observation"], *(f"{name}={value}" for name, value in entry["options"].items())))
        if "unavailable" in entry:
            continue
        shape = " x ".join(map(str, entry["shape"])) or "1"
        counts = (f"{entry[key]:,}" for key in ("num_observations", "num_sharing"))
        share = f"{100 * entry['share']:.1f} %"
        table.add_row(escape(words), shape, entry["dtype"], *counts, share, f"{entry['num_confused']:,}")
    to = console()
    to.print(f"[bold]{escape(title)}[/bold]", soft_wrap=True)
    terminal = int(space.terminal.sum())
    to.print(f"{many(space.num_states, 'state')}, {terminal:,} of them terminal", style="dim", soft_wrap=True)
    to.print(table)
    for entry in entries:
        if "unavailable" in entry:
            to.print(escape(f"{entry['observation']}: {entry['unavailable']}"), style="dim", soft_wrap=True)
    to.print("states that share one: terminal states count like others; where one acts: neither is", style="dim")
