"""pharos build: enumerate a state space."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    ranks_of,
)
from pharos.cli.target import parse_environment
from pharos.system.compiling import Stopwatch

if TYPE_CHECKING:
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
