"""pharos build: enumerate a state space.

pharos count: how many states there are, in one line.
"""

import math
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import (
    bytes_of,
    compiling_fact,
    describe,
    peak_memory_bytes,
    print_facts,
    print_json,
    size_text,
)
from pharos.cli.options import (
    Json,
    MaxStates,
    Memory,
    Parameters,
    Processes,
    TargetArgument,
    Workers,
    memory_of,
    parse_size,
    ranks_of,
)
from pharos.cli.target import Target, parse_environment, parse_target
from pharos.errors import ParameterError, StateSpaceTooLarge
from pharos.system.compiling import Stopwatch
from pharos.system.wording import many

if TYPE_CHECKING:
    from pharos.mdp import TabularMDP
    from pharos.state_space import StateSpace


def build(
    environment: TargetArgument,
    parameters: Parameters = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write; the cache when not given.")] = None,
    memory: Memory = None,
    workers: Workers = None,
    processes: Processes = "1",
    max_states: MaxStates = None,
    json: Json = False,
) -> None:
    """Enumerate every state that can be reached, and its transitions, onto disk. The same command resumes."""
    from pharos import state_space
    from pharos.state_space import cached_folder

    ranks = ranks_of(processes)
    env = parse_environment(environment, parameters)
    limit = memory_of(memory, processes)
    was_there = _is_there(out or cached_folder(env))
    watch = Stopwatch()
    space = state_space.build(
        env,
        out,
        memory=limit,
        workers=workers,
        processes=ranks,
        max_states=max_states,
    )
    seconds = watch.seconds
    rate, peak, bytes_on_disk = space.num_states / seconds, peak_memory_bytes(), bytes_of(space.folder)
    answer = {
        "environment": env.name,
        "parameters": space.parameters,
        "num_states": space.num_states,
        "num_actions": space.num_actions,
        **({"num_transitions": space.manifest["num_transitions"]} if space.has_chance else {}),
        "num_terminal_states": space.num_terminal_states,
        "depth": space.depth,
        "seconds": seconds,
        "compiling_seconds": watch.compiling,
        "states_per_second": rate,
        "peak_memory_bytes": peak,
        "bytes_on_disk": bytes_on_disk,
        "folder": str(space.folder),
        "found": was_there,
    }
    if json:
        print_json(answer)
        return
    print_facts(
        describe(env),
        [
            ("states", f"{space.num_states:,} ({space.num_terminal_states:,} terminal)"),
            ("actions", f"{space.num_actions} ({', '.join(env.actions)})"),
            *_outcomes(space),
            ("depth", f"{space.depth:,}"),
            (
                "seconds",
                f"{seconds:.2f} (it was there already)" if was_there else f"{seconds:.2f} ({rate:,.0f} states/s)",
            ),
            *compiling_fact(),
            ("peak memory", size_text(peak)),
            ("on disk", size_text(bytes_on_disk)),
            ("folder", space.folder),
        ],
    )


def _outcomes(space: "StateSpace") -> list[tuple[str, str]]:
    """How many outcomes actions have, where the rules have chance."""
    if not space.has_chance:
        return []
    manifest = space.manifest
    return [("outcomes", f"at most {manifest['num_outcomes']} of an action, {manifest['num_transitions']:,} in all")]


def _is_there(folder: Path) -> bool:
    """Whether the finished state space lies there already."""
    from pharos.state_space import read_manifest

    manifest = read_manifest(folder)
    return manifest is not None and bool(manifest["complete"])


# Count ----------------------------------------------------------------------------------------------------------------


SMALL = 10_000  # states, so that solving takes no time


def count(
    target: TargetArgument,
    parameters: Parameters = None,
    memory: Memory = None,
    workers: Workers = None,
    max_states: MaxStates = None,
    json: Json = False,
) -> None:
    """Count the states that can be reached, their transitions and the depth, and keep nothing."""
    watch = Stopwatch()
    goal = parse_target(target, parameters)
    if goal.is_imported:
        counted = counts_of_table(_table_of(goal))
        if max_states is not None and counted["num_states"] > max_states:
            raise StateSpaceTooLarge(f"{target}: has {counted['num_states']:,} states; expected at most {max_states:,}")
    else:
        counted = _counts_of_space(goal, memory=parse_size(memory), workers=workers, max_states=max_states)
    has_regret = counted.pop("has_regret", True)
    answer: dict[str, Any] = {
        "target": target,
        **counted,
        "seconds": watch.seconds,
        "compiling_seconds": watch.compiling,
    }
    if json:
        print_json(answer)
        return
    apart = answer["num_states"] - answer["num_reachable_states"]
    extra = f", {apart:,} never reached" if apart else ""
    print(
        f"{' '.join((target, *(parameters or ())))}: {many(answer['num_states'], 'state')} "
        f"({answer['num_terminal_states']:,} terminal{extra}), {many(answer['num_actions'], 'action')}, "
        f"{many(answer['num_transitions'], 'transition')}, depth {answer['depth']:,}, {answer['seconds']:.2f} s"
        + ("" if has_regret else ", no policy beats uniform play")
        + "".join(f", compiling {how_long}" for _, how_long in compiling_fact())
    )


def _table_of(goal: Target) -> "TabularMDP":
    """The imported table; the horizon, which a file of BRIDGE may not tell, does not matter here."""
    try:
        return goal.mdp()
    except ParameterError:
        return goal.mdp(horizon=1)


def _counts_of_space(goal: Target, **options: Any) -> dict[str, int]:
    """Counts of a folder, or of the cache where the space is there; else it is built beside the cache and removed."""
    from pharos.state_space import cached_folder, load, read_manifest
    from pharos.system import paths

    if goal.environment is None:
        assert goal.path is not None
        return counts_of(load(goal.path, verify=False))
    manifest = read_manifest(cached_folder(goal.environment))
    if manifest is not None and manifest["complete"]:
        return counts_of(goal.space(**options))
    place = paths.cache_directory()
    place.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix="count-", dir=place))
    try:
        return counts_of(goal.space(out=temporary, **options))
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def counts_of(space: "StateSpace") -> dict[str, int]:
    """Of a built state space: all of its states can be reached."""
    rows = space.manifest["num_transitions"] if space.has_chance else space.num_states * space.num_actions
    return {
        "num_states": space.num_states,
        "num_reachable_states": space.num_states,
        "num_terminal_states": space.num_terminal_states,
        "num_actions": space.num_actions,
        "num_transitions": rows - space.num_terminal_states * space.num_actions,
        "depth": space.depth,
        "has_regret": space.num_states > SMALL or _has_regret(space.mdp(gamma=0.99)),
    }


def _has_regret(mdp: "TabularMDP") -> bool:
    """Whether some policy is better than uniform play."""
    from pharos.solvers import regret_scale, uniform_value, value_iteration

    optimal, uniform = value_iteration(mdp), uniform_value(mdp)
    error = max(optimal.error_bound, uniform.error_bound)
    return not math.isnan(regret_scale(optimal.value_at_start, uniform.value_at_start, error))


def counts_of_table(mdp: "TabularMDP") -> dict[str, int]:
    """Of a table: transitions are possible outcomes in states that are not terminal, the end of an episode included."""
    import numpy as np

    terminal = np.asarray(mdp.terminal)
    reached, transitions, depth = np.zeros(mdp.num_states + 1, np.bool_), 0, -1
    reached[-1] = True
    frontier = mdp.starts
    while frontier.size:
        depth += 1
        reached[frontier] = True
        live = frontier[~terminal[frontier]]
        actions = np.tile(np.arange(mdp.num_actions), len(live))
        outcomes = mdp.dynamics.outcomes(np.repeat(live, mdp.num_actions), actions)
        transitions += int((outcomes.probabilities > 0).sum())
        frontier = np.unique(outcomes.states[(outcomes.probabilities > 0) & ~reached[outcomes.states]])
    return {
        "num_states": mdp.num_states,
        "num_reachable_states": int(reached[:-1].sum()),
        "num_terminal_states": int(terminal.sum()),
        "num_actions": mdp.num_actions,
        "num_transitions": transitions,
        "depth": depth,
    }
