"""pharos check: whether a class keeps the contract, and whether there is anything to learn in an instance of it."""

import math
from typing import TYPE_CHECKING

from pharos.cli.answers import Answer, compiling_fact
from pharos.cli.options import Count
from pharos.cli.target import Target
from pharos.errors import PharosError
from pharos.system import compiling

if TYPE_CHECKING:
    from pharos.environments import Environment


def check(target: Target, *, max_states: Count = 1000) -> Answer:
    """Check an environment against the contract, state by state, and whether any policy beats uniform play.

    Args:
        max_states: States that are looked at; more for a larger sample.
    """
    env = target.found_environment()
    from pharos import check_environment

    conformance = check_environment(env, max_states=max_states)
    values, sentence = _values(env) if conformance.complete else (None, "not solved: not all states were looked at")
    notes = {"notes": [*conformance.notes, sentence], "values": values, "compiling_seconds": compiling.seconds()}
    lines = [sentence, *(f"{name}: {value}" for name, value in compiling_fact())]
    return Answer({**vars(conformance), **notes}, "\n  ".join([str(conformance), *lines]))


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
