"""pharos check: whether a class keeps the contract, and whether there is anything to learn in an instance of it."""

import math
from typing import TYPE_CHECKING, Annotated

import typer

from pharos.cli.answers import compiling_fact, print_json
from pharos.cli.options import Json, Parameters, TargetArgument
from pharos.cli.target import parse_target
from pharos.errors import PharosError
from pharos.system import compiling

if TYPE_CHECKING:
    from pharos.environments import Environment


def check(
    target: TargetArgument,
    parameters: Parameters = None,
    max_states: Annotated[
        int, typer.Option("--max-states", min=1, help="States that are looked at; more for a larger sample.")
    ] = 1000,
    json: Json = False,
) -> None:
    """Check an environment against the contract, state by state, and whether any policy beats uniform play."""
    env = parse_target(target, parameters).found_environment()
    from pharos import check_environment

    conformance = check_environment(env, max_states=max_states)
    values, sentence = _values(env) if conformance.complete else (None, "not solved: not all states were looked at")
    if json:
        notes = [*conformance.notes, sentence]
        print_json({**vars(conformance), "notes": notes, "values": values, "compiling_seconds": compiling.seconds()})
        return
    print(conformance)
    print(f"  {sentence}")
    for name, value in compiling_fact():
        print(f"  {name}: {value}")


def _values(env: "Environment") -> tuple[dict[str, float] | None, str]:
    """Optimal, uniform and worst value of an episode, and a sentence about them."""
    from pharos.training import Task

    try:
        values = Task(env).reference
    except PharosError as error:
        return None, f"not solved: {error}"
    numbers = {"optimal": values.optimal, "uniform": values.uniform, "worst": values.worst}
    said = f"an episode is worth {values.optimal:.6g} at best, {values.uniform:.6g} by uniform play"
    if math.isnan(values.spread()):
        return numbers, f"{said}: no policy beats uniform play, so there is nothing to learn"
    return numbers, f"{said}, {values.worst:.6g} at worst"
