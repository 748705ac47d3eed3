"""The manifest of a state space, and the files that it describes.

A manifest is read, and checked before anything is made of it. `Plan` has the facts of an environment that it needs.
Files grow by appending, with a checksum for every block, and one builder at a time.
"""

import contextlib
import hashlib
import json
import math
import os
import re
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from pharos.environments import Environment, State, start_distribution
from pharos.errors import DiskFull, StateSpaceCorrupted, StateSpaceError, StateSpaceLocked, StateSpaceMismatch
from pharos.rules import Layout, fingerprint_of_rules, layout_of
from pharos.system import storage
from pharos.system.arrays import INT40

SPACE_FORMAT, FORMAT_VERSION = "pharos state space", 1
OUTCOMES_VERSION = 2
"""Format version of folders of environments with chance."""

INT40_VERSION = 3
"""Format version of folders whose successors have 40 bits, with chance and without."""

IMPORTED_FORMAT = "pharos mdp"
"""The format in a manifest that `pharos import` writes."""

MANIFEST = "manifest.json"
STATES, SUCCESSORS, TERMINAL = "states.bin", "successors.bin", "terminal.bin"
SUCCESSORS40, SUCCESSORS64 = "successors40.bin", "successors64.bin"
"""Files in place of successors.bin beyond 2^31 states; of 64 bits only in folders that an earlier pharos began."""

INDEX_TYPES = {SUCCESSORS: "<i4", SUCCESSORS40: INT40, SUCCESSORS64: "<i8"}
"""The type of the indices in each of these files."""

OFFSETS, CODES, PALETTE, PROBABILITIES = "offsets.bin", "codes.bin", "palette.bin", "probabilities.bin"
"""Files that exist only with chance."""

ARRAYS = (STATES, *INDEX_TYPES, TERMINAL, OFFSETS, CODES, PALETTE, PROBABILITIES)
"""The files of arrays that a folder may hold."""

PART_NAMES = {name: f"building-{name}" for name in (*INDEX_TYPES, OFFSETS, CODES, PALETTE, PROBABILITIES)}
"""With chance: the file that a build writes in place of each of these until it ends."""

MOST_CODES = 1 << 16
"""Vectors of probabilities that a palette may have."""

CHECKSUM_BYTES = 1 << 24
"""A checksum covers this many bytes of a file."""

BUILD_AGAIN = "delete the folder and build again"


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a folder, or None if there is none.

    Raises:
        StateSpaceCorrupted: it is nonsense. StateSpaceMismatch: it is of another version of the format.
        StateSpaceError: it belongs to something else, such as an imported MDP.
    """
    path = folder / MANIFEST
    try:
        manifest = storage.read_json(path, StateSpaceCorrupted, BUILD_AGAIN)
    except FileNotFoundError:
        return None
    if isinstance(manifest, dict) and manifest.get("format") == IMPORTED_FORMAT:
        raise StateSpaceError(
            f"{folder}: holds an imported MDP, no built state space; it is an environment by its folder "
            f"(`pharos solve|hardness|train|render {folder}`, pharos.make({str(folder)!r})), and "
            f"pharos.importers.load reads it"
        )
    try:
        if not isinstance(manifest, dict) or manifest.get("format") != SPACE_FORMAT:
            raise ValueError("it is not the manifest of a pharos state space")
        if manifest["format_version"] not in (FORMAT_VERSION, OUTCOMES_VERSION, INT40_VERSION):
            raise StateSpaceMismatch(
                f"{folder}: format version {manifest['format_version']}; this pharos reads versions {FORMAT_VERSION} "
                f"to {INT40_VERSION}: build again"
            )
        if manifest_digest(manifest) != manifest["digest"]:
            raise ValueError("it was changed after it was written")
        _check_space(manifest)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise StateSpaceCorrupted(f"{path}: {reason}; {BUILD_AGAIN}") from None
    return manifest


def successors_name(arrays: dict[str, Any], parts: dict[str, str] | None = None) -> str:
    """Name of the file of successors, which depends on the width of the indices.

    Args:
        parts: PART_NAMES, if the arrays belong to an unfinished build with chance.
    """
    names = parts or {name: name for name in INDEX_TYPES}
    return next((name for name in (SUCCESSORS40, SUCCESSORS64) if names[name] in arrays), SUCCESSORS)


def has_chance(manifest: dict[str, Any]) -> bool:
    """Whether actions have several outcomes."""
    version = manifest["format_version"]
    return version == OUTCOMES_VERSION or (version == INT40_VERSION and "outcomes" in manifest)


def manifest_digest(manifest: dict[str, Any]) -> str:
    """SHA-256 of a manifest without its own digest."""
    content = {key: value for key, value in manifest.items() if key != "digest"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def check_lengths(folder: Path, manifest: dict[str, Any]) -> None:
    """Raise StateSpaceCorrupted if a file is missing or shorter than its committed length."""
    for name, entry in manifest["arrays"].items():
        path = folder / name
        length = path.stat().st_size if path.is_file() else None
        if length is None or length < entry["bytes"] or (manifest["complete"] and length != entry["bytes"]):
            raise StateSpaceCorrupted(
                f"{path}: expected {entry['bytes']} bytes, found {'no such file' if length is None else length}: "
                f"the file was truncated or replaced; {BUILD_AGAIN}"
            )


# Checks of a manifest -------------------------------------------------------------------------------------------------


def _check_space(manifest: dict[str, Any]) -> None:
    """Raise a ValueError if a manifest, whoever wrote it, describes no possible state space."""
    for name in ("num_states", "num_actions"):
        _whole(manifest[name], name, 1)
    for name in ("num_terminal_states", "num_expanded", "level_end"):
        _whole(manifest[name], name, 0)
    _whole(manifest["depth"], "depth", 0 if manifest["complete"] is True else -1)  # -1: no level is finished yet
    if not isinstance(manifest["complete"], bool) or not isinstance(manifest["environment"], str):
        raise ValueError("complete or environment are of another type than they should be")
    if not isinstance(manifest["parameters"], dict):
        raise ValueError("parameters are no mapping")
    if not isinstance(manifest["actions"], list) or len(manifest["actions"]) != manifest["num_actions"]:
        raise ValueError("actions do not name each action")
    _check_layout(manifest["layout"])
    _check_start(manifest)
    _check_arrays(manifest)


def _check_layout(layout: dict[str, Any]) -> None:
    """Raise a ValueError if components do not fit into the words of a state."""
    words = _whole(layout["num_words"], "num_words", 1)
    columns = [layout[name] for name in ("names", "low", "size", "bits", "word", "shift")]
    if not all(isinstance(column, list) and len(column) == len(columns[0]) for column in columns):
        raise ValueError("layout does not describe each component")
    for name, low, size, bits, word, shift in zip(*columns, strict=True):
        for number in (low, size, bits, word, shift):
            _whole(number, f"layout of {name}", -(2**63))
        if not (1 <= size <= 2**63 and low + size - 1 < 2**63 and bits == (size - 1).bit_length()):
            raise ValueError(f"layout of {name}: {size} values from {low} on do not fit into {bits} bits")
        if not (0 <= word < words and shift >= 0 and shift + bits <= 64):
            raise ValueError(f"layout of {name}: lies outside of the words of a state")


def _check_start(manifest: dict[str, Any]) -> None:
    """Raise a ValueError unless start states are the first ones, in their order, with probabilities that sum to 1."""
    probabilities = []
    for number, ((vector, probability), (index, again)) in enumerate(
        zip(manifest["start"], manifest["initial"], strict=True)
    ):
        for value in (probability, again):
            if not isinstance(value, float) or not 0 <= value <= 1:
                raise ValueError(f"start state {number} has the probability {value!r}; expected a number from 0 to 1")
        if index != number or probability != again or not isinstance(vector, list):
            raise ValueError(f"initial: start state {number} has index {index!r}; expected start states first")
        probabilities.append(probability)
    if not probabilities or len(probabilities) > manifest["num_states"]:
        raise ValueError(f"{len(probabilities)} start states among {manifest['num_states']}")
    if abs(math.fsum(probabilities) - 1) > 1e-6:
        raise ValueError(f"the start probabilities sum to {math.fsum(probabilities)}; expected 1")


def _check_arrays(manifest: dict[str, Any]) -> None:
    """Raise a ValueError unless types and lengths of arrays follow from the numbers of states, actions and outcomes."""
    arrays, states = manifest["arrays"], manifest["num_states"]
    has_40_bits = bool({SUCCESSORS40, PART_NAMES[SUCCESSORS40]} & set(arrays))
    if has_40_bits != (manifest["format_version"] == INT40_VERSION):
        raise ValueError(f"arrays are {', '.join(arrays)}, which are not those of version {manifest['format_version']}")
    if has_chance(manifest):
        _whole(manifest["outcomes"], "outcomes", 1)
        if not manifest["complete"]:
            _check_parts(arrays)
            return
        expected = _expected_outcomes(manifest)
    else:
        name = successors_name(arrays)
        expected = {name: (INDEX_TYPES[name], _width(INDEX_TYPES[name]) * states * manifest["num_actions"])}
    expected = {
        STATES: ("<u8", 8 * states * manifest["layout"]["num_words"]),
        **expected,
        TERMINAL: ("|u1", -(-states // 8)),
    }
    if set(arrays) != set(expected):
        raise ValueError(f"arrays are {', '.join(arrays)}; expected {', '.join(expected)}")
    for name, (dtype, length) in expected.items():
        entry = arrays[name]
        size = _checked_size(name, entry)
        if entry["dtype"] != dtype or (manifest["complete"] and size != length):
            raise ValueError(
                f"{name}: {size} bytes of type {entry['dtype']}; expected {length} of type {dtype} for {states} states"
            )


def _expected_outcomes(manifest: dict[str, Any]) -> dict[str, tuple[str, int]]:
    """(type, length) of the arrays of outcomes of a finished build, by name."""
    arrays = manifest["arrays"]
    most = _whole(manifest["num_outcomes"], "num_outcomes", 1)
    rows = manifest["num_states"] * manifest["num_actions"]
    transitions = _whole(manifest["num_transitions"], "num_transitions", rows)
    if most > manifest["outcomes"] or transitions > rows * most:
        raise ValueError(f"{transitions} transitions of at most {most} outcomes, for {manifest['outcomes']} declared")
    name = successors_name(arrays)
    stored = transitions if OFFSETS in arrays else rows * most
    expected = {name: (INDEX_TYPES[name], _width(INDEX_TYPES[name]) * stored)}
    if OFFSETS in arrays:
        expected[OFFSETS] = ("<i8", 8 * (rows + 1))
    if PROBABILITIES in arrays:
        return expected | {PROBABILITIES: ("<f8", 8 * stored)}
    vectors = arrays[PALETTE]["bytes"] // (8 * most)
    if not 1 <= vectors <= MOST_CODES:
        raise ValueError(f"{PALETTE} has {vectors} vectors; expected 1 to {MOST_CODES}")
    codes = ("|u1", rows) if vectors <= 256 else ("<u2", 2 * rows)
    return expected | {CODES: codes, PALETTE: ("<f8", 8 * most * vectors)}


def _check_parts(arrays: dict[str, Any]) -> None:
    """Raise a ValueError unless the arrays are the files of an unfinished build with chance."""
    names = set(arrays) - {STATES, TERMINAL}
    successors = PART_NAMES[successors_name(arrays, PART_NAMES)]
    spelled_out = {PART_NAMES[OFFSETS], PART_NAMES[PROBABILITIES]}
    if {STATES, TERMINAL} - set(arrays) or names - {successors} not in (
        {PART_NAMES[CODES], PART_NAMES[PALETTE]},
        spelled_out,
    ):
        raise ValueError(f"arrays are {', '.join(arrays)}, which are not those of a build that goes on")
    dtypes = {STATES: "<u8", TERMINAL: "|u1", **{PART_NAMES[name]: dtype for name, dtype in INDEX_TYPES.items()}}
    dtypes |= {
        PART_NAMES[OFFSETS]: "<i8",
        PART_NAMES[CODES]: "<u2",
        PART_NAMES[PALETTE]: "<f8",
        PART_NAMES[PROBABILITIES]: "<f8",
    }
    for name, entry in arrays.items():
        size = _checked_size(name, entry)
        if entry["dtype"] != dtypes[name] or size % _width(dtypes[name]):
            raise ValueError(f"{name}: {size} bytes of type {entry['dtype']}; expected whole numbers of {dtypes[name]}")


def _width(dtype: str) -> int:
    """Bytes of a number of this type."""
    return int(dtype[-1])


def _checked_size(name: str, entry: dict[str, Any]) -> int:
    """Bytes of a file. ValueError unless each block of it has a checksum."""
    size = _whole(entry["bytes"], f"bytes of {name}", 0)
    if len(entry["checksums"]) != -(-size // CHECKSUM_BYTES):
        raise ValueError(f"{name}: {len(entry['checksums'])} checksums for {size} bytes")
    return size


def _whole(value: object, name: str, least: int) -> int:
    """The value. ValueError unless it is a whole number from `least` to 2^63."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= 2**63:
        raise ValueError(f"{name} is {repr(value)[:200]}; expected a whole number of at least {least}")
    return value


@dataclass(frozen=True)
class Plan:
    """The facts of an environment that a state space needs, each computed once.

    Attributes:
        env: the environment.
        layout: positions of its components in packed states.
        starts: its start states and their probabilities.
        identity: the entries of the manifest by which state spaces differ. They are hashed into the cache's folder
            names.
        fingerprint: of its rules.
    """

    env: Environment

    @cached_property
    def layout(self) -> Layout:
        return layout_of(self.env.components)

    @cached_property
    def starts(self) -> tuple[list[State], np.ndarray]:
        return start_distribution(self.env)

    @cached_property
    def identity(self) -> dict[str, Any]:
        env, layout = self.env, self.layout
        return {
            "environment": env.name,
            "class": f"{_module_of(type(env))}:{type(env).__qualname__}",
            "rules_version": env.version,
            "parameters": json.loads(json.dumps(env.parameters)),
            "actions": list(env.actions),
            **({"outcomes": int(env.outcomes)} if env.has_chance else {}),
            "layout": {
                "names": list(env.components.names),
                "low": env.components.low.tolist(),
                "size": env.components.size.tolist(),
                "bits": [int(mask).bit_length() for mask in layout.mask],
                "word": layout.word.tolist(),
                "shift": layout.shift.tolist(),
                "num_words": layout.num_words,
            },
            "start": [[list(state), float(p)] for state, p in zip(*self.starts, strict=True)],
        }

    @cached_property
    def branches(self) -> int:
        """Number of branches of a state: the number of actions, times the number of outcomes."""
        return self.env.num_actions * int(self.env.outcomes)

    @property
    def format_version(self) -> int:
        """Format version of the folder, for indices of 32 bits."""
        return OUTCOMES_VERSION if self.env.has_chance else FORMAT_VERSION

    @cached_property
    def fingerprint(self) -> str:
        chance = ("probability",) * self.env.has_chance
        return fingerprint_of_rules(self.env, ("transition", "is_terminal", *chance))


def _module_of(cls: type) -> str:
    """Module of a class, as manifests name it: built-in classes without the folder of their file."""
    return re.sub(r"^(pharos\.environments)\.(worlds|mini_grid)\b", r"\1", cls.__module__)


# Files that grow ------------------------------------------------------------------------------------------------------


# Appended bytes that the system is asked to write to the disk together, while the search goes on.
SENT_BYTES = 1 << 20


class GrowingFile:
    """A file that grows by appending, with its length and a checksum for every CHECKSUM_BYTES of it."""

    def __init__(self, path: Path, committed: dict[str, Any] | None = None):
        self.path = path
        self.bytes = 0
        self.checksums: list[str] = []
        self._partial = xxhash.xxh3_128()
        self._partial_bytes = 0
        self._failure: DiskFull | None = None
        self._unsynced: DiskFull | None = None
        self._sent = 0  # bytes that the system was asked to write out
        try:
            self._file = open(  # noqa: SIM115
                path, "r+b" if committed else "w+b", buffering=0, opener=storage.own_file
            )
        except OSError as error:
            raise cannot_write(path, error) from error
        if committed:
            try:
                self._take_over(committed)
            except BaseException:
                self.close()
                raise

    def _take_over(self, committed: dict[str, Any]) -> None:
        """Truncate the file to the last checkpoint, and verify its checksums."""
        self._file.truncate(committed["bytes"])
        self._file.seek(0)
        while block := self._file.read(CHECKSUM_BYTES):
            self._add_to_checksums(memoryview(block))
        self._sent = self.bytes
        if self.entry()["checksums"] != committed["checksums"] or self.bytes != committed["bytes"]:
            raise StateSpaceCorrupted(
                f"{self.path}: does not match the checksums of its last checkpoint: it was changed; {BUILD_AGAIN}"
            )

    def append(self, rows: np.ndarray) -> None:
        """Append the bytes of an array. DiskFull if the disk has no room, and ever after: a file has no gaps."""
        if self._failure:
            raise self._failure
        data = np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data
        written = 0
        try:
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:
            self._failure = cannot_write(self.path, error)
            raise self._failure from error
        self._add_to_checksums(data)
        if self.bytes - self._sent >= SENT_BYTES:
            storage.write_out(self._file.fileno(), self._sent, self.bytes - self._sent)
            self._sent = self.bytes

    def _add_to_checksums(self, data: memoryview) -> None:
        """Count appended bytes, and add them to the checksum of their block."""
        self.bytes += len(data)
        while len(data):
            size = min(len(data), CHECKSUM_BYTES - self._partial_bytes)
            self._partial.update(data[:size])
            self._partial_bytes += size
            data = data[size:]
            if self._partial_bytes == CHECKSUM_BYTES:
                self.checksums.append(self._partial.hexdigest())
                self._partial, self._partial_bytes = xxhash.xxh3_128(), 0

    def entry(self) -> dict[str, Any]:
        """Entry of the file in the manifest: its length and checksums."""
        partial = [self._partial.hexdigest()] if self._partial_bytes else []
        return {"bytes": self.bytes, "checksums": self.checksums + partial}

    def sync(self) -> None:
        """Wait until appended data are on the disk. After a failure it always raises: a second try may lie."""
        if self._unsynced:
            raise self._unsynced
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            self._unsynced = cannot_write(self.path, error)
            raise self._unsynced from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def cannot_write(path: Path, error: OSError) -> DiskFull:
    """The error for a write that failed."""
    free = shutil.disk_usage(path.parent).free
    return DiskFull(
        f"{path}: cannot write ({error.strerror}; {free / 2**20:.0f} MiB free); what was committed is kept: "
        f"free room on the disk, or build in another folder, and the same command resumes"
    )


def lock_build(folder: Path) -> contextlib.AbstractContextManager[None]:
    """Hold the folder for this process. StateSpaceLocked if another one builds there. See `storage.lock`."""
    return storage.lock(folder, StateSpaceLocked, "building")


def write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    """Replace the manifest in one step: it is the commit point of everything else in the folder."""
    manifest = {**manifest, "digest": manifest_digest(json.loads(json.dumps(manifest)))}
    path = folder / MANIFEST
    try:
        storage.replace_file(path, json.dumps(manifest, indent=1))
        (folder / (MANIFEST + ".tmp")).unlink(missing_ok=True)  # of an older pharos that was killed
    except OSError as error:
        raise cannot_write(path, error) from error
