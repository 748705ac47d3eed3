"""Build a state space: enumerate the reachable states of an environment onto disk (Algorithm 1 of the paper, compiled).

Breadth-first search: the array of states, in the order of discovery, is the queue. A table of indices keyed by hash is
the only other memory (table.py). The search (search.py) expands states and numbers new ones. The journal (journal.py)
appends both to files and commits them.
"""

import contextlib
import hashlib
import json
import math
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pharos.environments import Environment, make
from pharos.errors import ParameterError, PharosError, RuleError, StateSpaceLocked, StateSpaceMismatch
from pharos.state_space.guarded_rules import FirstLook
from pharos.state_space.manifest import ARRAYS, MANIFEST, PART_NAMES, Plan, lock_build, read_manifest
from pharos.state_space.progress import BuildCallback, reporter
from pharos.state_space.store import StateSpace, load
from pharos.state_space.stored import SHARDS, check_files
from pharos.system import memory as machine
from pharos.system import storage
from pharos.system.workers import check_processes

if TYPE_CHECKING:
    from pharos.ranks import Rank
    from pharos.state_space.search import Options

OUR_FILES = (*ARRAYS, *PART_NAMES.values(), SHARDS, MANIFEST + ".tmp", storage.LOCK, storage.CLAIM)
BUILD_CHECKPOINT_SECONDS = 15.0
LOOKED_AT = 100, 5000
"""States, and outcomes of actions in them, of a class of the user's own that are looked at before its space is built:
interpreted, a tenth of a second."""
Hold = Callable[[Path], contextlib.AbstractContextManager[object]]  # of a folder, for one builder


def build(
    env: Environment | str,
    folder: str | os.PathLike | None = None,
    *,
    max_states: int | None = None,
    memory: int | None = None,
    workers: int | None = None,
    processes: int | str = 1,
    progress: BuildCallback | bool | None = None,
    checkpoint_seconds: float = BUILD_CHECKPOINT_SECONDS,
    wait: bool | None = None,
) -> StateSpace:
    """Enumerate the states of `env` that can be reached from its start states, and their transitions.

    Args:
        env: the environment, or its name, such as "frozen_lake/4x4".
        folder: to write to. Default: the user's cache, keyed by environment, parameters and rules. A folder that holds
            the finished state space is loaded. One that holds part of it is resumed, with the same result.
        max_states: StateSpaceTooLarge when there are more.

        Cost only (the files are the same, byte for byte):
        memory: bytes that states and table may take. Default: as much as there is. Beyond them the table is on disk, in
            a file without a name in `folder` of 23 to 46 bytes a state (11 to 23 more for each further word), which is
            gone in the end.
        workers: threads, or processes if rules are interpreted. Default: all processors.
        processes: 1, or "mpi" for the processes that `mpiexec` has started, all of which make this call with a folder
            that all of them see, and share the work and the table of states, which has to fit in memory then (`memory`
            is for each).
        progress: None for a bar on a terminal, False for silence, or a function that gets a BuildProgress now and then.
        checkpoint_seconds: at most this much work is lost when the process is killed.
        wait: if another process is building in the folder, wait for it, with a warning. Default: only in the user's
            cache, which nobody has named.
    Returns:
        The StateSpace, whose files are in `folder`.
    Raises:
        StateSpaceTooLarge, DiskFull: what was found is kept, and the same command resumes.
        StateSpaceMismatch: the folder holds another environment, or other rules. StateSpaceLocked: somebody else is
        building there, and is not waited for. StateSpaceCorrupted: files were changed. RuleError: a rule failed or left
        the declared ranges, in the state that is named. ParameterError: the folder cannot be used.
    Cost: 40 to 110 ns a state, 8 W + 8 to 16 bytes of memory a state (W words of 64 bits);
        docs/evidence/performance.md.
    Source: the pharos paper, appendix A, Algorithm 1 (whose successors are stored under the wrong index there).
    """
    from pharos.state_space.ranked_table import rank_of_build  # loads Numba
    from pharos.state_space.search import Options

    if isinstance(env, str):
        env = make(env)
    if not isinstance(env, Environment):
        raise ParameterError(
            f"build: found {env!r}; expected an Environment: write pharos.make(name, **parameters), or a name"
        )
    if max_states is not None and max_states < 1:
        raise ParameterError(f"max_states is {max_states}; expected at least 1")
    if memory is not None and memory < machine.LEAST_MEMORY:
        raise ParameterError(f"memory is {memory} bytes; expected at least 16 MiB")
    check_processes(processes)
    options = Options(max_states, memory, workers, checkpoint_seconds)
    plan = Plan(env)
    try:
        path = Path(folder) if folder is not None else folder_of(plan)
        _ = plan.identity
    except PharosError:
        raise
    except Exception:  # of declarations of the user's own
        from pharos.state_space.conformance import check_declarations

        check_declarations(env)
        raise
    with rank_of_build(plan, memory) if processes == "mpi" else contextlib.nullcontext() as rank:
        hold = _waiting if (folder is None if wait is None else wait) else lock_build
        was_there = (rank is None or rank.rank == 0) and _build(plan, path, rank, options, progress, hold)
    return load(path, verify=was_there, environment=env)


def _build(
    plan: Plan,
    path: Path,
    rank: "Rank | None",
    options: "Options",
    progress: BuildCallback | bool | None,
    hold: Hold,
) -> bool:
    """Complete the state space in the folder. Returns whether it was complete before."""
    from pharos.state_space.journal import remove_parts
    from pharos.state_space.ranked_table import RankedSearch
    from pharos.state_space.search import Search, check_max_states, journal_of

    manifest = _manifest_of(plan, path)
    if manifest is not None and manifest["complete"]:
        check_max_states(plan.env, manifest["num_states"], 0, options.max_states)
        if plan.env.has_chance:
            remove_parts(path)
        return True
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f"{path}: cannot be made a folder: {error.strerror}; choose another one") from error
    with hold(path), reporter(progress, plan.env) as report:
        manifest = _manifest_of(plan, path)  # it may have grown while we waited
        if manifest is None and not type(plan.env).__module__.startswith("pharos."):
            _look_at(plan.env)
        if manifest is None or not manifest["complete"]:
            search = plan, journal_of(path, plan), options, report
            (Search(*search) if rank is None else RankedSearch(*search, rank)).run(manifest)
    return False


def _look_at(env: Environment) -> None:
    """RuleError if a class of the user's own has what a build would take in changed."""
    steps: object = env.max_episode_steps
    if isinstance(steps, str) or (isinstance(steps, float) and math.isfinite(steps) and not steps.is_integer()):
        raise RuleError(f"{env}: max_episode_steps is {steps!r}; expected an integer of at least 1")
    if not env.num_actions:
        raise RuleError(f"{env}: actions is {env.actions!r}; expected a tuple of different names, at least one")
    FirstLook(env).states(*LOOKED_AT)


def _waiting(path: Path) -> contextlib.ExitStack:
    """The lock of a folder, after waiting, with a warning, for another process that builds there."""

    def warn(text: str) -> None:
        warnings.warn(text, RuntimeWarning, stacklevel=4)

    return storage.waiting_lock(path, StateSpaceLocked, "building", warn)


def cached_folder(env: Environment) -> Path:
    """The folder of the state space of `env` in the user's cache: named by content, so edited rules get another one."""
    return folder_of(Plan(env))


def folder_of(plan: Plan) -> Path:
    """The folder of a plan's state space in the user's cache."""
    content = json.dumps([plan.identity, plan.fingerprint, plan.format_version], sort_keys=True)
    digest = hashlib.sha256(content.encode()).hexdigest()[:16]
    return storage.cache_directory() / "spaces" / f"{plan.env.name}-{digest}"


def _manifest_of(plan: Plan, path: Path) -> dict[str, Any] | None:
    """The manifest of a folder for this state space, or None if there is none yet."""
    manifest = read_manifest(path)
    if manifest is None:
        if path.is_dir() and any(not _is_ours(item.name) for item in path.iterdir()):
            if read_manifest(path) is not None:  # another process has just begun there
                return _manifest_of(plan, path)
            raise ParameterError(f"{path}: is not empty and holds no state space; choose another folder")
        return None
    # the folder must be of the same environment
    for key, expected in plan.identity.items():
        if key != "class" and manifest.get(key) != expected:
            raise StateSpaceMismatch(
                f"{path}: holds {manifest['environment']} with {key} = {_short(manifest.get(key))}; "
                f"expected {_short(expected)} for {plan.env}; choose another folder, or delete this one"
            )
    check_files(path, manifest)
    return manifest


def is_of_state_space(folder: Path) -> bool:
    """Whether a folder holds a state space, complete, unfinished or damaged, as far as the names of its files tell."""
    if not folder.is_dir():
        return False
    return (folder / MANIFEST).is_file() or all(_is_ours(item.name) for item in folder.iterdir())


def _is_ours(name: str) -> bool:
    return name in OUR_FILES or storage.is_temporary(name)


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 120 else text[:117] + "..."
