"""pharos hardness: all measures of one instance in a table, with exactness and sources."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import compiling_fact, console, describe_chance, print_json, progress_line
from pharos.cli.options import (
    Json,
    Lazy,
    MaxStates,
    Memory,
    Parameters,
    Random,
    Sticky,
    TargetArgument,
    Workers,
    build_options,
    parse_parameters,
)
from pharos.cli.target import parse_target
from pharos.errors import ParameterError
from pharos.system import compiling
from pharos.system.wording import many

if TYPE_CHECKING:
    from pharos.cli.target import Target
    from pharos.hardness import Representation
    from pharos.mdp import TabularMDP

# What the column "exact" says of each kind of certificate.
PROVEN = {"exact": "yes", "interval": "interval", "float64": "float64"}
IDEALISED = ("kernel_regret", "kernel_policy_regret", "sampled_regret")


def hardness(
    target: TargetArgument,
    parameters: Parameters = None,
    measures: Annotated[
        str | None,
        typer.Option(
            "--measures", metavar="A,B", help="Names of measures, or all; those that are quick when not given."
        ),
    ] = None,
    gamma: Annotated[
        float | None,
        typer.Option(
            "--gamma",
            min=0,
            max=1,
            help="Discount of values and gaps; 0.99 when not given, or what an imported file says.",
            show_default=False,
        ),
    ] = None,
    horizon: Annotated[
        int | None, typer.Option("--horizon", min=1, help="Steps of an episode, for measures of episodes.")
    ] = None,
    sticky: Sticky = 0.0,
    random: Random = 0.0,
    lazy: Lazy = 0.0,
    tolerance: Annotated[
        float, typer.Option("--tolerance", help="Largest error of the optimal values, in units of return.")
    ] = 1e-9,
    restart: Annotated[
        bool, typer.Option("--restart/--no-restart", help="Whether terminal states lead back to the start.")
    ] = True,
    budget: Annotated[
        float, typer.Option("--budget", min=0, help="Seconds a measure may take before it gives a proven interval.")
    ] = 300.0,
    observation: Annotated[
        str | None,
        typer.Option(
            "--observation", help="What the agent sees, as of train: adds measures of what its network makes of it."
        ),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="NAME=VALUE", help="Option of the observation, such as hide=row."),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            "--network",
            help="mlp128, mlp128x2, cnn16, nature; that of the agents when not given. Or file.py:function, your own.",
        ),
    ] = None,
    initialisation: Annotated[
        str | None,
        typer.Option(
            "--initialisation", help="Of the network: pytorch (as DQN has; when not given), or sb3 (as PPO and A2C)."
        ),
    ] = None,
    optimizer: Annotated[
        str | None,
        typer.Option(
            "--optimizer",
            help="Of the idealised learner: gradient (when not given), or adam, which rescales gradients.",
        ),
    ] = None,
    landmarks: Annotated[
        int | None,
        typer.Option(
            "--landmarks", min=0, help="Approximate the kernel by so many; 0: never; beyond 4,096 when not given."
        ),
    ] = None,
    definitions: Annotated[bool, typer.Option("--definitions", help="Show definitions and sources.")] = False,
    latex: Annotated[bool, typer.Option("--latex", help="Print a LaTeX table.")] = False,
    values: Annotated[
        Path | None,
        typer.Option(
            "--values",
            help="Folder for values and bounds while they are computed, in place of memory; what was killed goes on.",
        ),
    ] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Compute anew what is kept beside the state space.")] = False,
    memory: Memory = None,
    workers: Workers = None,
    max_states: MaxStates = None,
    json: Json = False,
) -> None:
    """Measure how hard an instance is: visitation, estimation and planning complexity."""
    building = build_options(memory, workers, max_states)
    needs_rewards = True
    if measures is not None:
        from pharos.hardness import chosen

        wanted = chosen(measures)  # an unknown name is told before anything is built
        needs_rewards = any(each.depends != "structure" for each in wanted)
    of_observations: dict[str, object] = {"option": option, "network": network, "initialisation": initialisation}
    of_observations |= {"optimizer": optimizer, "landmarks": landmarks}
    useless = [f"--{name}" for name, value in of_observations.items() if value not in (None, [])]
    if observation is None and useless:
        raise ParameterError(f"{useless[0]} goes with --observation NAME, what the agent sees")
    goal = parse_target(target, parameters)
    own = goal.is_imported  # an imported MDP has a discount and a horizon of its own
    mdp = goal.mdp(
        gamma=0.99 if gamma is None and not own else gamma,
        horizon=horizon if gamma == 1 or own else None,
        sticky=sticky,
        random=random,
        lazy=lazy,
        by_range=not needs_rewards,
        **building,
    )
    representation = None
    if observation is not None:
        words = parse_parameters(option)
        named = {"network": network, "initialisation": initialisation or "pytorch", "landmarks": landmarks}
        mdp, representation = _represented(goal, mdp, observation, building, {**words, **named})
    from pharos.hardness import Schedule
    from pharos.hardness import report as measure

    with progress_line("measuring") as tell:
        report = measure(
            mdp,
            measures,
            horizon=horizon,
            tolerance=tolerance,
            restart=restart,
            budget=budget,
            keep=not fresh,
            progress=lambda what, line: tell(f"{what}  {line}"),
            representation=representation,
            schedule=None if representation is None else Schedule(optimizer=optimizer or "gradient"),
            folder=values,
        )
    if json:
        print_json({**report.to_dict(), "compiling_seconds": compiling.seconds()})
    elif latex:
        print(report.to_latex())
    else:
        chance = describe_chance(sticky, random, mdp.dynamics.has_chance, lazy)
        _print(" ".join((target, *(parameters or ()))), report, chance, definitions)


def _represented(
    goal: "Target", mdp: "TabularMDP", observation: str, building: dict[str, Any], options: dict[str, Any]
) -> "tuple[TabularMDP, Representation]":
    """The MDP with its states numbered as in the state space, and what is seen of them."""
    from pharos.observations import representation

    space = goal.space(**building)
    if goal.is_imported:  # its table has an order of its own
        from dataclasses import replace

        from pharos.mdp import lazy_actions

        own = lazy_actions(space.mdp(gamma=mdp.gamma).with_horizon(mdp.horizon), mdp.laziness)
        mdp = replace(own, chance=mdp.chance)
    with progress_line("observing"):
        return mdp, representation(space, observation, **options)


def _print(title: str, report: Any, chance: str, definitions: bool) -> None:
    from rich.markup import escape
    from rich.table import Table

    conventions = report.conventions
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("measure", style="cyan", no_wrap=True)
    table.add_column("value", overflow="fold")
    table.add_column("exact")
    table.add_column("seconds", justify="right")
    if definitions:
        table.add_column("definition", overflow="fold")
        table.add_column("source", overflow="fold", style="dim")
    notes = []
    for result in report.results.values():
        value = "[dim]undefined[/dim]" if result.undefined else escape(result.text)
        exact = "" if result.undefined else PROVEN[result.certificate.kind]
        if exact and result.name in IDEALISED:
            exact = "prediction"
        row = [result.name, value, exact, "kept" if result.kept else f"{result.seconds:.2f}"]
        table.add_row(*row, *((escape(result.definition), escape(result.source)) if definitions else ()))
        if note := result.undefined or result.certificate.note:
            notes.append(note if note.startswith(result.name) else f"{result.name}: {note}")
    to = console()
    to.print(f"[bold]{escape(title)}[/bold]", soft_wrap=True)
    horizon = "none" if conventions["horizon"] is None else conventions["horizon"]
    to.print(
        f"{many(conventions['num_states'], 'state')} x {many(conventions['num_actions'], 'action')}, "
        f"discount {conventions['gamma']:g}, horizon {horizon}, chance: {chance}",
        style="dim",
        soft_wrap=True,
    )
    to.print(table)
    error = conventions.get("error_bound")
    if error is not None and math.isfinite(error):
        to.print(f"values are within {error:.2g} of the optimal ones (proven)", style="dim", soft_wrap=True)
    for ties in _ties(report):
        to.print(ties, style="dim", soft_wrap=True)
    for _, how_long in compiling_fact():
        to.print(f"compiling: {how_long}", style="dim", soft_wrap=True)
    for note in notes:
        to.print(escape(note), style="dim", soft_wrap=True)
    if not {*IDEALISED}.isdisjoint(report.results):
        to.print(
            "prediction: regret of an idealised learner, 0 is optimal, 1 is uniform play; kernel_regret has "
            "expectations in the place of draws. `pharos predict` has the form that agrees best "
            "with runs, and an interval",
            style="dim",
            soft_wrap=True,
        )


def _ties(report: Any) -> list[str]:
    """How many gaps count as ties, and at which tolerance, where a measure of gaps is among them."""
    for result in report.results.values():
        details = {} if result.undefined else result.certificate.details
        if "ties" in details:
            ties, tolerance = details["ties"], details["tie_tolerance"]
            return [
                f"{many(ties, 'tie')} at a tolerance of {tolerance:.2g}, {ties - details['unresolved_ties']:,} proven"
            ]
    return []
