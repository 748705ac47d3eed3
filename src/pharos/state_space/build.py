"""build: enumerate the reachable states of an environment, onto disk. Algorithm 1 of the paper, compiled.

Breadth-first search: the array of states, in the order of discovery, is the queue; a table of indices keyed by hash is the
only other memory. Where both do not fit, the table goes to disk (_disk_table.py), and states stay in their file. Successors and terminal bits are appended to files as the states are expanded. While the frontier is
wide, threads compute successors and look up those already known, a piece ahead of the one thread that numbers the new
ones in order: so states are numbered as one thread would number them. While it is narrow (Freeway: 148 thousand levels of
9 states) one thread does everything. docs/decisions has the measurements.
"""

import contextlib
import hashlib
import json
import mmap
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from pharos import paths, storage
from pharos.environments import Environment, start_distribution
from pharos.errors import DiskFull, ParameterError, RuleError, StateSpaceMismatch, StateSpaceTooLarge
from pharos.rules.fingerprint import fingerprint_of_rules
from pharos.rules.interpreted import Interpreters, interpreted_successors
from pharos.rules.layout import layout_of, pack, unpack
from pharos.state_space.files import GrowingFile, lock, write_manifest
from pharos.state_space.memory import available_memory
from pharos.state_space.store import (
    FORMAT_VERSION,
    MANIFEST,
    STATES,
    SUCCESSORS,
    TERMINAL,
    WIDE_SUCCESSORS,
    StateSpace,
    check_lengths,
    check_rules,
    identity_of,
    load,
    read_manifest,
    successors_name,
)

OUR_FILES = (STATES, SUCCESSORS, WIDE_SUCCESSORS, TERMINAL, MANIFEST + ".tmp", storage.LOCK, storage.CLAIM)
CHUNK = (
    1 << 16
)  # states expanded between two looks at the clock; a multiple of 8, so that terminal bits fill whole bytes
PIECES = 4  # of a chunk: threads expand one while the one before is numbered
WIDE = 1 << 13  # a frontier of this many states is worth sharing between threads
CHECKPOINT_SECONDS = 15.0
PARALLEL_FILL = 1 << 16  # states that are worth sharing between threads when the table grows
LEFT_OVER = 1 << 12  # states that may pass the end of a part of the table, which are a handful
INTERPRETED = 4096  # states whose successors are Python objects at a time
LEAST_MEMORY = 1 << 24  # bytes
LOAD = 0.5  # the table grows beyond this share of used slots
INT32_STATES = 2**31 - 1
_NOTHING = np.full(1 << 16, -1, np.int32)  # a table that holds nothing, where the slot of a state is its bucket


@dataclass(frozen=True)
class BuildProgress:
    """What a progress callback receives: states found and expanded so far, levels finished, seconds, where the table is."""

    num_states: int
    num_expanded: int
    depth: int
    seconds: float
    finished: bool = False
    on_disk: bool = False


Progress = Callable[[BuildProgress], None]


def build(
    env: Environment,
    folder: str | os.PathLike | None = None,
    *,
    max_states: int | None = None,
    memory: int | None = None,
    workers: int | None = None,
    progress: Progress | bool | None = None,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
) -> StateSpace:
    """Enumerate the states of `env` that can be reached from its start states, and their transitions.

    Args:
        env: the environment.
        folder: where to write; None for the user's cache, keyed by environment, parameters and rules. A folder that holds
            the finished state space is loaded; one that holds part of it is resumed, with the same result.
        max_states: StateSpaceTooLarge when there are more.

        Cost only (the files are the same, byte for byte):
        memory: bytes that states and table may take; None for as much as there is. Beyond them the table is on disk, in a file
            without a name in `folder` of 23 to 46 bytes a state (11 to 23 more for each further word), which is gone in the end.
        workers: threads, or processes where rules are interpreted; None for all processors.
        progress: None for a bar on a terminal; False for silence; or a function that gets a BuildProgress now and then.
        checkpoint_seconds: at most this much work is lost when the process is killed.
    Returns:
        The StateSpace, whose files are in `folder`.
    Raises:
        StateSpaceTooLarge, DiskFull: what was found is kept; the same command resumes.
        StateSpaceMismatch: the folder holds another environment, or other rules. StateSpaceLocked: somebody else is
        building there. StateSpaceCorrupted: files were changed. RuleError: a rule failed or left the declared ranges, in the
        state that is named. ParameterError: the folder cannot be used.
    Cost: see docs/performance.md; 40 to 110 ns a state, 8 W + 8 to 16 bytes of memory a state (W words of 64 bits).
    Source: the pharos paper, appendix A, Algorithm 1 (whose successors are stored under the wrong index there).
    """
    if max_states is not None and max_states < 1:
        raise ParameterError(f"max_states is {max_states}; expected at least 1")
    if memory is not None and memory < LEAST_MEMORY:
        raise ParameterError(f"memory is {memory} bytes; expected at least 16 MiB")
    identity = identity_of(env)
    path = Path(folder) if folder is not None else cached_folder(env)
    manifest = _manifest_of(env, path, identity)
    if manifest is not None and manifest["complete"]:
        _check_size(env, manifest["num_states"], 0, max_states)
        return load(path, environment=env)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ParameterError(f"{path}: cannot be made a folder: {error.strerror}; choose another one") from error
    with lock(path), _reporter(progress, env) as report:
        manifest = _manifest_of(env, path, identity)  # it may have grown while we waited
        if manifest is None or not manifest["complete"]:
            _Builder(env, path, identity, max_states, memory, workers, report, checkpoint_seconds).run(manifest)
    return load(path, verify=False, environment=env)


def cached_folder(env: Environment) -> Path:
    """The folder of the state space of `env` in the user's cache: named by content, so edited rules get another one."""
    rules = fingerprint_of_rules(env, ("transition", "is_terminal"))
    content = json.dumps([identity_of(env), rules, FORMAT_VERSION], sort_keys=True)
    digest = hashlib.sha256(content.encode()).hexdigest()[:16]
    return paths.cache_directory() / "spaces" / f"{env.name}-{digest}"


def _manifest_of(env: Environment, path: Path, identity: dict[str, Any]) -> dict[str, Any] | None:
    manifest = read_manifest(path)
    if manifest is None:
        if path.is_dir() and any(not _is_ours(item.name) for item in path.iterdir()):
            raise ParameterError(f"{path}: is not empty and holds no state space; choose another folder")
        return None
    for key, expected in identity.items():
        if key != "class" and manifest.get(key) != expected:
            raise StateSpaceMismatch(
                f"{path}: holds {manifest['environment']} with {key} = {_short(manifest.get(key))}; expected {_short(expected)} "
                f"for {env}; choose another folder, or delete this one"
            )
    check_lengths(path, manifest)
    return manifest


def _is_ours(name: str) -> bool:
    return name in OUR_FILES or storage.is_temporary(name)


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 120 else text[:117] + "..."


def _check_size(env: Environment, count: int, left: int, max_states: int | None) -> None:
    if max_states is not None and count > max_states:
        if left == 0:
            raise StateSpaceTooLarge(
                f"{env} has {count} states, more than max_states={max_states}; raise it or choose a smaller instance"
            )
        raise StateSpaceTooLarge(
            f"{env} passed max_states={max_states}, {left} left to expand; raise it or choose a smaller instance"
        )


class _Piece:
    """A piece of a wide frontier: what threads write, for the one that numbers the states."""

    def __init__(self, num_actions: int, num_words: int):
        rows = -(-CHUNK // PIECES)
        self.keys = np.empty((rows * num_actions, num_words), np.uint64)
        self.found = np.empty(rows * num_actions, np.int64)
        self.terminal = np.empty(rows, np.uint8)
        self.first = self.stop = 0
        self.faults: list[np.ndarray] = []
        self.futures: list[Future] = []


class _Spilled:
    """The table on disk, and memory for a chunk of the frontier.

    Attributes:
        rows: of a chunk: as many as half of the memory holds; the table takes a quarter at a time.
        states: what the chunk found and is not in the file yet. terminal: of its rows. keys, found, order, slots: of its candidates.
    """

    def __init__(self, path: Path, num_words: int, num_actions: int, memory: int, count: int):
        from pharos.state_space.disk_table import DiskTable

        candidate = 2 * 8 * num_words + 8 + 8 + 8 + 4  # words here and as a state, found, slots, a successor, order
        bytes_of_a_row = num_actions * candidate + 8 * num_words + 1
        self.rows = min(
            max(memory // 2 // bytes_of_a_row // 1024, 1) * 1024, INT32_STATES // num_actions // 1024 * 1024
        )
        candidates = self.rows * num_actions
        self.states, self.keys = (np.empty((candidates, num_words), np.uint64) for _ in range(2))
        self.found, self.slots = np.empty(candidates, np.int64), np.empty(candidates, np.int64)
        self.order = np.empty(candidates, np.int32)
        self.terminal = np.empty(self.rows, np.uint8)
        self._successors = np.empty((0, num_actions), np.int32)
        self.table = DiskTable(path, num_words, memory // 4, 2 * count)

    def successors(self, dtype: np.dtype) -> np.ndarray:
        """(rows, A), of the chunk."""
        if len(self._successors) != self.rows or self._successors.dtype != dtype:
            self._successors = np.empty((self.rows, self._successors.shape[1]), dtype)
        return self._successors


class _Builder:
    """One run of the build: memory, files and the loop."""

    def __init__(self, env, path, identity, max_states, memory, workers, report, checkpoint_seconds):
        from pharos.rules.compiled import compiled_rules
        from pharos.workers import usable_workers

        self.env, self.path, self.identity = env, path, identity
        self.max_states, self.memory, self.report = max_states, memory, report
        self.checkpoint_seconds = checkpoint_seconds
        self.layout = layout_of(env.components)
        self.rules: Any = compiled_rules(env, self.layout.num_words, ["explore"])
        self.workers = usable_workers(workers)
        self.start_states, self.start_probabilities = start_distribution(env)
        self.first = 0  # states expanded
        self.count = 0  # states found
        self.level_end = 0  # states up to the end of the current level
        self.depth = -1  # levels finished, the start states' own level not counted
        self.terminals = 0
        self.index_dtype: np.dtype = np.dtype("<i4")
        self.ahead: _Piece | None = None  # expanded by threads, not numbered yet
        self.spare: list[_Piece] = []
        self.blocks: list[tuple[np.ndarray, np.ndarray]] = []  # rows of successors and terminal bits, used in turn
        self.margin = 32 * env.num_actions + len(self.start_states)
        self.disk: _Spilled | None = None  # the table on disk, where memory is not enough

    def run(self, manifest: dict[str, Any] | None) -> None:
        self.began = self.last_checkpoint = time.perf_counter()
        self.states = _reserved_states(self.layout.num_words)
        self.table = np.empty(0, self.index_dtype)
        self.table_space = _reserved_table()
        self.files: dict[str, GrowingFile] = {}
        self.writes: list[Future] = []
        self.written: dict[str, Any] | None = None
        self.interpreters = Interpreters(self.env, self.workers if self.rules is None else 1)
        try:
            self._open(manifest)
            with ThreadPoolExecutor(self.workers) as pool, ThreadPoolExecutor(1) as self.writer:
                if self.disk is None:
                    self._grow_table(pool, self.count)
                while self.first < self.count:
                    if self.disk is None:
                        self._expand_chunk(pool)
                    else:
                        self._expand_chunk_on_disk(pool, self.disk)
                    if time.perf_counter() - self.last_checkpoint >= self.checkpoint_seconds:
                        self._checkpoint(complete=False)
                self._checkpoint(complete=True)
        except BaseException:  # whatever it is, what is in the files is kept; the same command resumes
            with contextlib.suppress(DiskFull):
                wait(self.writes)
                self._commit(complete=False)
            raise
        finally:
            for file in self.files.values():
                file.close()
            self.interpreters.close()
            self.disk = None
            del self.states, self.table, self.table_space  # also where a traceback keeps this builder alive
        self.report(self._progress(finished=True))

    def _open(self, manifest: dict[str, Any] | None) -> None:
        """Start afresh, or from the last checkpoint."""
        arrays = manifest["arrays"] if manifest else {}
        self.successors_name = successors_name(arrays)
        if manifest:
            self.index_dtype = np.dtype(arrays[self.successors_name]["dtype"])
        names = (STATES, self.successors_name, TERMINAL)
        for name in {STATES, SUCCESSORS, WIDE_SUCCESSORS, TERMINAL} - set(names):
            (self.path / name).unlink(missing_ok=True)  # left by a process killed while it widened the indices
        for name in names:
            self.files[name] = GrowingFile(self.path / name, arrays.get(name))
        if manifest is None:
            self.count = self.level_end = len(self.start_states)
            self.states[: self.count] = pack(self.layout, np.array(self.start_states, np.int64))
            self.files[STATES].append(self.states[: self.count])
        else:
            self.first, self.count = manifest["num_expanded"], manifest["num_states"]
            self.level_end, self.depth = manifest["level_end"], manifest["depth"]
            self.terminals = manifest["num_terminal_states"]
            stored = np.memmap(self.path / STATES, "<u8", "r", shape=(self.count, self.layout.num_words))
            if self._fits(self.count):
                self.states[: self.count] = stored
            else:
                self._spill(stored)
            if self.first:
                shape = (self.first, self.env.num_actions)
                successors = np.memmap(self.path / self.successors_name, self.index_dtype, "r", shape=shape)
                bits = np.memmap(self.path / TERMINAL, "|u1", "r")
                check_rules(self.path, self.env, self.layout, stored, successors, bits)
        self.appended = self.count  # states handed over to the files
        self.written = self._written(self._counts())

    def _counts(self) -> dict[str, int]:
        """Where the search stands."""
        return {
            "num_states": self.count,
            "num_expanded": self.first,
            "num_terminal_states": self.terminals,
            "depth": self.depth,
            "level_end": self.level_end,
        }

    def _written(self, counts: dict[str, int]) -> dict[str, Any]:
        """What a checkpoint commits: counts and files that belong together."""
        dtypes = {STATES: "<u8", self.successors_name: self.index_dtype.str, TERMINAL: "|u1"}
        return {**counts, "arrays": {name: {"dtype": dtypes[name], **self.files[name].entry()} for name in dtypes}}

    # Expanding -----------------------------------------------------------------------------------------------------------

    def _expand_chunk(self, pool: ThreadPoolExecutor) -> None:
        """Expand up to CHUNK states, then append their rows to the files."""
        if self.index_dtype.itemsize == 4 and self.count + CHUNK * self.env.num_actions + self.margin > INT32_STATES:
            self._widen_indices(pool)
            if self.disk:
                return
        base = self.first
        last = base + CHUNK
        successors, terminal = self._block()
        while self.first < min(last, self.count):
            if self.ahead is None and self.count + self.margin > self._room():
                self._grow_table(pool, self.count)
                if self.disk:
                    self.first -= (self.first - base) % 8  # what is appended has whole bytes of terminal bits
                    break
            if self.rules is None:
                self._expand_interpreted(successors, terminal, base, min(last, self.count))
            elif self.ahead or (self.workers > 1 and min(last, self.count) - self.first >= WIDE):
                self._expand_wide(pool, successors, terminal, base)
            else:
                self._expand_narrow(successors, terminal, base, last)
            _check_size(self.env, self.count, self.count - self.first, self.max_states)
        rows = self.first - base
        self.terminals += int(terminal[:rows].sum())
        self._append(self.states[self.appended : self.count], successors[:rows], terminal[:rows])
        self.report(self._progress())

    def _expand_chunk_on_disk(self, pool: ThreadPoolExecutor, disk: "_Spilled") -> None:
        """The same with the table on disk: successors are looked up in order of the table, many at once, and then numbered."""
        from pharos.kernels.disk_table import number

        num_actions = self.env.num_actions
        if self.index_dtype.itemsize == 4 and self.count + disk.rows * num_actions > INT32_STATES:
            self._widen_indices(pool)
        self._finish_writes()
        if len(self.states):
            self.states, self.table, self.table_space = (
                self.states[:0].copy(),
                self.table[:0].copy(),
                self.table_space[:0].copy(),
            )
            self.blocks, self.spare = [], []
        base, last = self.first, self.first + disk.rows
        successors, terminal = disk.successors(self.index_dtype), disk.terminal
        while self.first < min(last, self.count):
            first, rows = self.first, min(last, self.count) - self.first
            size = rows * num_actions
            keys, found = disk.keys[:size], disk.found[:size]
            part = slice(first - base, first - base + rows)
            self._expand_rows(pool, self._rows(first, first + rows), keys, found, terminal[part])
            disk.table.grow(self.count + size)
            looked_up = disk.table.look_up(keys, found, first, disk.order, disk.slots)
            progress = np.zeros(5, np.int64)
            number(
                keys,
                found,
                successors[part],
                disk.states,
                first,
                self.count,
                self.appended,
                self.level_end,
                self.depth,
                progress,
            )
            disk.table.settle(looked_up, found, disk.order, disk.slots)
            self._take(progress)
            _check_size(self.env, self.count, self.count - self.first, self.max_states)
        rows = self.first - base
        self.terminals += int(terminal[:rows].sum())
        self._append(disk.states[: self.count - self.appended], successors[:rows], terminal[:rows])
        self.report(self._progress())

    def _expand_rows(self, pool, states: np.ndarray, keys: np.ndarray, found: np.ndarray, terminal: np.ndarray) -> None:
        """Successors of states to keys; to found -1 - bucket, or in terminal states their own row."""
        rows = len(states)
        if self.rules is None:
            for start in range(0, rows, INTERPRETED):
                stop = min(start + INTERPRETED, rows)
                part = slice(start * self.env.num_actions, stop * self.env.num_actions)
                self._interpret(states[start:stop], keys[part], terminal[start:stop])
            found[:] = -1 - _slots_of(keys, len(_NOTHING))
            return
        threads = self.workers if rows >= WIDE else 1
        cuts = [rows * i // threads for i in range(threads + 1)]
        faults = [np.zeros(5, np.int64) for _ in range(threads)]

        def expand(i: int) -> None:
            self.rules.kernels.expand_and_find(
                self.rules.parameters,
                self.layout.tables,
                states,
                cuts[i],
                cuts[i + 1],
                0,
                keys,
                found,
                terminal,
                _NOTHING,
                faults[i],
            )

        for i, future in enumerate([pool.submit(expand, i) for i in range(threads)]):
            failure = future.exception()
            if failure or faults[i][4]:
                at = int(faults[i][0])
                self._blame_rules(self.first + at, self.first + min(at + 16, rows), failure)

    def _rows(self, start: int, stop: int) -> np.ndarray:
        """States [start, stop): in memory, or from their file and what is not in it yet."""
        if self.disk is None:
            return self.states[start:stop]
        words, held = self.layout.num_words, self.appended
        states = np.empty((stop - start, words), np.uint64)
        in_file = max(0, min(stop, held) - start)
        if in_file:
            states[:in_file] = np.fromfile(
                self.path / STATES, "<u8", in_file * words, offset=8 * words * start
            ).reshape(-1, words)
        states[in_file:] = self.disk.states[start + in_file - held : stop - held]
        return states

    def _block(self) -> tuple[np.ndarray, np.ndarray]:
        """Room for the rows of a chunk; _append lets two chunks wait, so the third one back is written."""
        if len(self.blocks) == 3 and self.blocks[0][0].dtype == self.index_dtype:
            self.blocks.append(self.blocks.pop(0))
        else:
            rows = np.empty((CHUNK, self.env.num_actions), self.index_dtype)
            self.blocks = [*self.blocks, (rows, np.empty(CHUNK, np.uint8))][-3:]
        return self.blocks[-1]

    def _expand_narrow(self, successors, terminal, base, last) -> None:
        progress = np.array([self.first, self.count, self.level_end, self.depth, 0], np.int64)
        # look at the width and the limit again after a while
        stop = min(last, max(self.first + 2048, self.count)) if self.workers > 1 else last
        failure: Exception | None = None
        try:
            self.rules.kernels.explore(
                self.rules.parameters,
                self.layout.tables,
                self.states,
                successors,
                terminal,
                self.table,
                base,
                stop,
                self._room(),
                progress,
            )
        except Exception as error:  # of the rules, such as a division by zero
            failure = error
        if failure or progress[4]:
            first, count = int(progress[0]), int(progress[1])
            self._blame_rules(first, min(first + 16, count), failure)
        self._take(progress)

    def _expand_wide(self, pool, successors, terminal, base) -> None:
        """Number the successors of the piece that threads have expanded, while they expand the next one."""
        from pharos.kernels.hash_table import insert_missing

        piece = self.ahead or self._expand_ahead(pool, self.first, self.first - base)
        assert piece is not None
        self.ahead = None
        wait(piece.futures)
        for future, fault in zip(piece.futures, piece.faults, strict=True):
            failure = future.exception()
            if failure or fault[4]:
                self._blame_rules(int(fault[0]), min(int(fault[0]) + 16, piece.stop), failure)
        rows, num_actions = piece.stop - piece.first, self.env.num_actions
        row = piece.first - base
        reserved = rows * num_actions
        if self.count - piece.stop >= WIDE:
            self.ahead = self._expand_ahead(pool, piece.stop, (row + rows) % CHUNK, reserved)
        progress = np.zeros(5, np.int64)
        insert_missing(
            self.table,
            self.states,
            piece.keys,
            piece.found,
            successors[row : row + rows],
            piece.first,
            self.count,
            self.level_end,
            self.depth,
            progress,
        )
        terminal[row : row + rows] = piece.terminal[:rows]
        self.spare.append(piece)
        self._take(progress)

    def _expand_ahead(self, pool, first: int, row: int, reserved: int = 0) -> "_Piece | None":
        """Let threads expand a piece of the frontier, from state `first`, in row `row` of its chunk.

        None where the table has no room left beside `reserved` other states: it grows while nobody reads it.
        """
        room = (self._room() - self.count - reserved) // self.env.num_actions
        rows = min(-(-CHUNK // PIECES), CHUNK - row, self.count - first, room)
        if rows < 1:
            return None
        piece = self.spare.pop() if self.spare else _Piece(self.env.num_actions, self.layout.num_words)
        cuts = [first + rows * i // self.workers for i in range(self.workers + 1)]
        piece.first, piece.stop = first, first + rows
        piece.faults = [np.zeros(5, np.int64) for _ in range(self.workers)]
        piece.futures = [
            pool.submit(
                self.rules.kernels.expand_and_find,
                self.rules.parameters,
                self.layout.tables,
                self.states,
                cuts[i],
                cuts[i + 1],
                first,
                piece.keys,
                piece.found,
                piece.terminal,
                self.table,
                piece.faults[i],
            )
            for i in range(self.workers)
        ]
        return piece

    def _expand_interpreted(self, successors, terminal, base, stop) -> None:
        """The same with rules that Numba cannot compile: Python calls them, arrays do the rest."""
        from pharos.kernels.hash_table import find, insert_missing

        num_actions = self.env.num_actions
        stop = min(stop, self.first + min(INTERPRETED, (self._room() - self.count) // num_actions))
        keys = np.empty(((stop - self.first) * num_actions, self.layout.num_words), np.uint64)
        self._interpret(self.states[self.first : stop], keys, terminal[self.first - base : stop - base])
        found = np.empty(len(keys), np.int64)
        find(self.table, self.states, keys, found)
        slots = np.flatnonzero(found < 0)
        found[slots] = -1 - _slots_of(keys[slots], len(self.table))
        progress = np.zeros(5, np.int64)
        part = successors[self.first - base : stop - base]
        insert_missing(
            self.table, self.states, keys, found, part, self.first, self.count, self.level_end, self.depth, progress
        )
        self._take(progress)

    def _interpret(self, states: np.ndarray, keys: np.ndarray, terminal: np.ndarray) -> None:
        """Successors of packed states to keys, packed, by rules in Python; terminal ones lead to themselves."""
        from pharos.rules.packing_kernels import pack_rows, unpack_rows

        layout = self.layout
        unpacked = np.empty((len(states), len(layout.word)), np.int64)
        unpack_rows(layout.word, layout.shift, layout.mask, layout.low, states, unpacked)
        following, terminal[:] = self.interpreters.successors(unpacked)
        keys[:] = 0
        pack_rows(layout.word, layout.shift, layout.low, following, keys)

    def _take(self, progress: np.ndarray) -> None:
        self.first, self.count, self.level_end, self.depth = (int(value) for value in progress[:4])

    def _blame_rules(self, start: int, stop: int, failure: BaseException | None = None) -> NoReturn:
        """Compiled rules failed or left the declared ranges in [start, stop): name the first state where they do interpreted."""
        rows = unpack(self.layout, self._rows(start, stop)).tolist()
        interpreted_successors(self.env, rows)
        raise RuleError(
            f"{self.env}: compiled rules {f'raise {failure!r}' if failure else 'read or write outside of the declared ranges'} "
            f"in one of the states from {tuple(rows[0])} to {tuple(rows[-1])}, interpreted they do not; "
            f"run pharos.check_environment to find out why"
        ) from failure

    # Room ----------------------------------------------------------------------------------------------------------------

    def _room(self) -> int:
        """States that table and array of states can hold."""
        return min(int(len(self.table) * LOAD), len(self.states))

    def _slots_for(self, count: int) -> int:
        """Slots of a table in memory with room for about twice as many states."""
        slots = 1 << 16
        while slots * LOAD < 1.4 * count + self.margin:
            slots *= 2
        return slots

    def _fits(self, count: int) -> bool:
        """Whether memory holds a table with room for about twice as many states, and the states."""
        if count + self.margin > len(self.states):
            return False
        slots = self._slots_for(count)
        needed = slots * self.index_dtype.itemsize + int(slots * LOAD) * self.layout.num_words * 8
        return needed <= (self.memory if self.memory is not None else available_memory())

    def _grow_table(self, pool: ThreadPoolExecutor, count: int) -> None:
        """A table with room for about twice as many states, filled from the array of states; on disk where memory is not enough."""
        from pharos.kernels.hash_table import fill, fill_more, fill_range

        if not self._fits(count):
            self._spill()
            return
        slots = self._slots_for(count)
        self.table = np.empty(0, self.index_dtype)  # free the old one first, where it cannot grow in its place
        if self.table_space.nbytes < slots * self.index_dtype.itemsize:
            self.table_space = _huge_pages(slots, self.index_dtype)
        self.table = self.table_space.view(self.index_dtype)[:slots]
        if self.workers == 1 or count < PARALLEL_FILL:
            self.table.fill(-1)
            fill(self.table, self.states, count)
            return
        cuts = [slots * i // self.workers for i in range(self.workers + 1)]
        left_over = np.empty((self.workers, LEFT_OVER), np.int64)

        def fill_part(i: int) -> int:
            self.table[cuts[i] : cuts[i + 1]].fill(-1)
            return fill_range(self.table, self.states, count, cuts[i], cuts[i + 1], left_over[i])

        left = [*pool.map(fill_part, range(self.workers))]
        if max(left) > left_over.shape[1]:  # only where a bad hash crowds the end of a part
            self.table.fill(-1)
            fill(self.table, self.states, count)
            return
        for i, over in enumerate(left):
            fill_more(self.table, self.states, left_over[i, :over])

    def _spill(self, stored: np.ndarray | None = None) -> None:
        """Go on with the table on disk, filled from the one in memory, or from the states of the last checkpoint."""
        memory = self.memory
        if memory is None:
            memory = max(LEAST_MEMORY, available_memory() // 2)
        disk = _Spilled(self.path, self.layout.num_words, self.env.num_actions, memory, self.count)
        if stored is not None:
            for start in range(0, self.count, disk.rows):
                disk.table.fill(np.array(stored[start : start + disk.rows], np.uint64), start)
        elif len(self.table):
            disk.table.take_over(self.table, self.states)
        else:
            disk.table.fill(self.states[: self.count], 0)
        self.disk = disk

    # Files ---------------------------------------------------------------------------------------------------------------

    def _widen_indices(self, pool: ThreadPoolExecutor) -> None:
        """From int32 to int64 indices: a new file of successors and a new table; the old file goes once this is committed."""
        self._finish_writes()
        if self.ahead:  # its slots are those of the old table: it is expanded again
            wait(self.ahead.futures)
            self.ahead = None
        old = self.files[self.successors_name]
        wide = GrowingFile(self.path / WIDE_SUCCESSORS)
        for start in range(0, self.first, CHUNK):
            shape = (min(CHUNK, self.first - start), self.env.num_actions)
            rows = np.memmap(old.path, "<i4", "r", offset=4 * start * self.env.num_actions, shape=shape)
            wide.append(rows.astype("<i8"))
        self.files[WIDE_SUCCESSORS] = wide
        self.successors_name, self.index_dtype = WIDE_SUCCESSORS, np.dtype("<i8")
        self.written = self._written(self._counts())
        self._commit(complete=False)
        del self.files[SUCCESSORS]
        old.close()
        old.path.unlink()
        if self.disk is None:
            self._grow_table(pool, self.count)

    def _append(self, states: np.ndarray, successors: np.ndarray, terminal: np.ndarray) -> None:
        """Append in the background, while the next chunk is expanded; at most two chunks wait.

        Counts and checksums are noted by the thread that writes, once a chunk is in all files: whatever interrupts the
        main thread, and wherever, a checkpoint finds counts and files that belong together.
        """
        files, name, counts = self.files, self.successors_name, self._counts()

        def write() -> None:
            files[STATES].append(states)
            files[name].append(successors)
            files[TERMINAL].append(np.packbits(terminal, bitorder="little"))
            self.written = self._written(counts)

        while len(self.writes) > 1:
            self.writes.pop(0).result()
        self.writes.append(self.writer.submit(write))
        self.appended = self.count

    def _finish_writes(self) -> None:
        while self.writes:
            self.writes.pop(0).result()

    def _checkpoint(self, *, complete: bool) -> None:
        """Commit everything found so far."""
        self._finish_writes()
        self._commit(complete=complete)

    def _commit(self, *, complete: bool) -> None:
        """Commit what was written: data first, then the manifest that speaks of it."""
        if self.written is None:
            return
        written = self.written
        for file in self.files.values():
            file.sync()
        manifest = {
            "format": "pharos state space",
            "format_version": FORMAT_VERSION,
            "complete": complete,
            **self.identity,
            "num_actions": self.env.num_actions,
            "initial": [[i, float(p)] for i, p in enumerate(self.start_probabilities)],
            **written,
        }
        write_manifest(self.path, manifest)
        self.last_checkpoint = time.perf_counter()

    def _progress(self, finished: bool = False) -> BuildProgress:
        seconds = time.perf_counter() - self.began
        return BuildProgress(self.count, self.first, self.depth, seconds, finished, self.disk is not None)


def _slots_of(keys: np.ndarray, capacity: int) -> np.ndarray:
    from pharos.kernels.hash_table import slots_of

    out = np.empty(len(keys), np.int64)
    slots_of(keys, capacity, out)
    return out


def _reserved_states(num_words: int) -> np.ndarray:
    """(rows, W) uint64 of address space: memory is taken as it is written, in huge pages, and never copied to grow."""
    for rows in (1 << 32, 1 << 30, 1 << 28, 1 << 26):
        try:
            return _huge_pages(rows * num_words, np.dtype("<u8")).reshape(-1, num_words)
        except (OSError, ValueError):
            continue
    raise MemoryError("no address space for 2^26 states; set a larger ulimit -v")


def _reserved_table() -> np.ndarray:
    """Address space in which the table grows; an empty array where there is none."""
    for size in (1 << 35, 1 << 33, 1 << 31):
        with contextlib.suppress(OSError, ValueError):
            return _huge_pages(size, np.dtype("|u1"))
    return np.empty(0, np.uint8)


def _huge_pages(length: int, dtype: np.dtype) -> np.ndarray:
    """An array of zeros in huge pages, where the system has them."""
    if not hasattr(mmap, "MAP_PRIVATE"):
        return np.zeros(min(length, 1 << 28), dtype)
    no_reserve = 0x4000 if sys.platform == "linux" else 0  # MAP_NORESERVE, which Python names from 3.13 on
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | no_reserve
    memory = mmap.mmap(-1, length * dtype.itemsize, flags=flags)
    if hasattr(mmap, "MADV_HUGEPAGE"):
        with contextlib.suppress(OSError):
            memory.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(memory, dtype)


@contextlib.contextmanager
def _reporter(progress: Progress | bool | None, env: Environment):
    """The function that gets each BuildProgress: the caller's, a bar on a terminal, or nothing."""
    if callable(progress):
        yield progress
    elif progress is False or not sys.stderr.isatty():
        yield lambda _: None
    else:
        from rich.console import Console
        from rich.progress import Progress as Bar
        from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}"),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
        )
        with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(f"building {env.name}", text="", total=None)

            def show(done: BuildProgress) -> None:
                left = done.num_states - done.num_expanded
                rate = done.num_states / max(done.seconds, 1e-9)
                bar.update(
                    task,
                    text=f"{done.num_states:,} states, {left:,} to expand, level {done.depth}, {rate:,.0f} states/s"
                    f"{', table on disk' if done.on_disk else ''}",
                )

            yield show
