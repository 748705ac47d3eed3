"""pharos cache: what pharos keeps so that it need not be made again, and throwing it away.

pharos warm: compile beforehand what the other commands would compile as they go.
"""

import contextlib
import re
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, bytes_of, print_table, progress_line, size_text
from pharos.cli.command import Commands
from pharos.cli.options import Target, complete_target
from pharos.errors import PharosError, StateSpaceLocked, StateSpaceTooLarge, UnknownName
from pharos.mdp import ChanceSetting
from pharos.system import compiling
from pharos.system.compiling import Stopwatch
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from pharos.environments import Environment


SPACE = re.compile(r".+-[0-9a-f]{16}")
"""Names of folders in the cache: of the environment, and a digest of its rules."""

app = Commands(help="List or clear the cached state spaces.", no_args_is_help=False)


@app.command("list")
def list_() -> Answer:
    """Show the cached state spaces and how much room they take."""
    from pharos.system import storage

    directory = storage.cache_directory()
    spaces = _spaces(directory)
    compiled = sum(map(bytes_of, _compiled(directory)))
    total = compiled + sum(space["bytes"] for space in spaces)
    answer = {"directory": directory, "spaces": spaces, "compiled_bytes": compiled, "total_bytes": total}
    return Answer(answer, lambda: _print(directory, spaces, compiled, total))


@app.command("clear")
def clear(environments: Annotated[list[str] | None, "[ENVIRONMENT]..."] = None) -> Answer:
    """Delete cached state spaces (and, when no name is given, compiled code). They are made again when needed.

    Args:
        environments: Clear only these: names of environments or of cached folders.
    """
    from pharos.system import storage

    directory = storage.cache_directory()
    spaces = _spaces(directory)
    names = {space["environment"] for space in spaces} | {space["name"] for space in spaces}
    for name in environments or ():
        if name not in names:
            raise UnknownName("environment in the cache", name, names)
    removed, freed = [], 0
    for space in spaces:
        if not environments or space["environment"] in environments or space["name"] in environments:
            folder = Path(space["folder"])
            with storage.lock(folder, StateSpaceLocked, "building"):
                shutil.rmtree(folder)
            removed.append(space["folder"])
            freed += space["bytes"]
    for folder in _compiled(directory) if not environments else ():
        freed += bytes_of(folder)
        shutil.rmtree(folder)
    answer = {"removed": removed, "bytes_freed": freed, "directory": directory}
    return Answer(answer, f"{pluralize(len(removed), 'state space')} deleted, {size_text(freed)} freed in {directory}")


def _compiled(directory: Path) -> list[Path]:
    from pharos.system import storage

    return [folder for folder in storage.compiled_folders(directory) if folder.is_dir() and not folder.is_symlink()]


def _spaces(directory: Path) -> list[dict[str, Any]]:
    """Every cached state space, the largest first."""
    from pharos.state_space import is_of_state_space, read_manifest

    listed = []
    for folder in sorted((directory / "spaces").glob("*")):
        if folder.is_symlink() or not SPACE.fullmatch(folder.name) or not is_of_state_space(folder):
            continue
        manifest: dict[str, Any] | None = None
        with contextlib.suppress(PharosError):
            manifest = read_manifest(folder)
        state = "damaged" if manifest is None else "complete" if manifest["complete"] else "unfinished"
        manifest = manifest or {}
        listed.append(
            {
                "name": folder.name,
                "environment": manifest.get("environment", folder.name.rpartition("-")[0]),
                "parameters": manifest.get("parameters", {}),
                "num_states": manifest.get("num_states", 0),
                "state": state,
                "bytes": bytes_of(folder),
                "folder": str(folder),
            }
        )
    return sorted(listed, key=lambda space: -space["bytes"])


def _print(directory: Path, spaces: list[dict[str, Any]], compiled: int, total: int) -> None:
    rows = []
    for space in spaces:
        parameters = " ".join(f"{name}={value}" for name, value in space["parameters"].items() if value is not None)
        note = "" if space["state"] == "complete" else space["state"]
        rows.append((space["environment"], parameters, f"{space['num_states']:,}", size_text(space["bytes"]), note))
    if rows:
        print_table("", ("environment", "parameters", ">states", ">size", ""), rows)
    print(
        f"{pluralize(len(spaces), 'state space')} and {size_text(compiled)} of compiled code: "
        f"{size_text(total)} in {directory}"
    )


# Warm -----------------------------------------------------------------------------------------------------------------


# Small instances of the classes of the paper: all instances of a class share what is compiled.
USUAL: tuple[tuple[str, dict[str, int]], ...] = (
    ("simple_grid/4x4-plain", {}),
    ("frozen_lake/4x4", {}),
    ("freeway", {"num_cars": 2, "lane_length": 3}),
    ("breakout", {"height": 8, "columns": 5}),
)
WARM_STEPS = 50
LARGEST_WARMED = 5_000_000


def warm(
    targets: Annotated[
        list[str] | None,
        typer.Argument(metavar="[ENVIRONMENT]...", autocompletion=complete_target, show_default=False),
    ] = None,
    *,
    chance: Annotated[ChanceSetting, "sticky random"],
) -> Answer:
    """Compile what building, solving, measuring, playing and Q-learning need, and keep it for later processes.

    Args:
        targets: Environments or named instances. Default: small ones of the paper's four classes.
    """
    environments = [Target(name).found_environment() for name in targets or ()]
    if not targets:
        from pharos.environments import make

        environments = [make(name, **parameters) for name, parameters in USUAL]
    seconds: dict[str, float] = {}
    watch = Stopwatch()
    compiling.SMALL_STATES = 0  # as if all of it were large
    with progress_line("compiling") as report:
        for env in environments:
            report(str(env))
            before = watch.compiling
            _use(env, chance)
            seconds[str(env)] = watch.compiling - before
    answer = {"environments": seconds, "seconds": watch.seconds, "compiling_seconds": watch.compiling}
    facts = [(name, f"{spent:.1f} s") for name, spent in seconds.items()]
    return Answer(answer, (f"compiled for {pluralize(len(facts), 'environment')}, and kept", facts))


def _use(env: "Environment", chance: ChanceSetting) -> None:
    """Do a little of everything with an environment. A space beyond LARGEST states is stepped through alone."""
    from pharos import hardness, solvers, state_space
    from pharos.interaction import GymEnv, VectorEnv
    from pharos.kernels import outcomes
    from pharos.training import train

    for observation in ("vector", "simple_image"):
        one = GymEnv(env, observation=observation, chance=chance)
        one.reset(seed=0)
        one.step(0)
        two = VectorEnv(env, 2, observation=observation, chance=chance)
        two.reset(seed=0)
        two.step([0, 0])
    with tempfile.TemporaryDirectory() as folder:
        try:
            space = state_space.build(env, f"{folder}/space", max_states=LARGEST_WARMED, progress=False)
        except StateSpaceTooLarge:
            return
        mdp = chance.of(space.mdp(gamma=0.99))
        solvers.value_iteration(mdp)
        solvers.uniform_value(mdp)
        few, outcomes.UNROLLED_FROM = outcomes.UNROLLED_FROM, 0  # sweeps of many states are other kernels
        try:
            large = chance.of(space.mdp(gamma=0.99))
            solvers.value_iteration(large)
            solvers.uniform_value(large)
        finally:
            outcomes.UNROLLED_FROM = few
        hardness.report(mdp, budget=10.0, keep=False)
    train(
        "q_learning",
        env,
        steps=WARM_STEPS,
        gamma=0.99,
        horizon=None,
        evaluation_interval=WARM_STEPS,
        chance=chance,
    )
