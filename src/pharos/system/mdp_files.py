"""The files of imported MDPs: a manifest with checksums and a digest, and plain .npy arrays. Knows nothing of MDPs.

FOLDER/manifest.json     what is there, written last
FOLDER/NAME.npy          an array of COMMON, or of one of the forms below
FOLDER/outcome_*.npy     in format version 3: outcomes, with the reward of each
FOLDER/label_states.npy, variable_values.npy, choice_names.npy   optional: names of states and actions, in any version
FOLDER/available.npy     in format version 5: the actions that exist in each state; other files as in version 1 or 3
FOLDER/observations.bin  in format version 6: what the source shows, distinct rows in deflated chunks, and
FOLDER/observation_index.npy  the row of each state; other files as in version 1, 3 or 5
FOLDER/observations.npy  in format version 2, 3 or 5 of an earlier pharos: what the source shows, a row a state
"""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import FileFormatError
from pharos.system import storage
from pharos.system.distinct_rows import DistinctRows
from pharos.system.wording import capped

MDP_FORMAT, VERSION, MDP_MANIFEST = "pharos mdp", 1, "manifest.json"
OBSERVED_VERSION = 2
"""Of folders of an earlier pharos with observations, one row a state."""
PAID_VERSION = 3
"""Of folders that know the reward of each outcome, with observations or without."""
SETS_VERSION = 5
"""Of folders in which some actions are not available in some states. 4 is another extension of 3."""
CHUNKS_VERSION = 6
"""Of folders with observations: distinct rows in chunks, and the row of each state."""
VERSIONS = (VERSION, OBSERVED_VERSION, PAID_VERSION, SETS_VERSION, CHUNKS_VERSION)

COMMON_ARRAYS = ("rewards", "terminal", "start_states", "start_probabilities")
TABLE = ("next_states",)
MATRIX = ("transitions_data", "transitions_indices", "transitions_indptr")
OUTCOME_ARRAYS = ("successors",)  # and, if there are any: offsets; probabilities, or codes and palette
SHOWN_NAME = "observations"
INDEX, CHUNKS, ROWS_NAME = "observation_index", "observations.bin", "observation_rows"
"""The row of each state, an array; the chunks of distinct rows, a file; what is in them, an entry of the manifest."""
PAID = ("outcome_offsets", "outcome_states", "outcome_probabilities", "outcome_rewards")
AVAILABLE = "available"
RESIDUAL_NAME = "residual"
"""Entry of the manifest: what the sums of given rows leave open, in probability and in reward; absent where nothing."""
ROUNDING_NAME = "rounding"
"""Entry of the manifest: a bound on the error of rewards that are means; absent if rewards are exact."""
NAMES_NAME = "names"
"""Entry of the manifest: names of labels, variables and choices, and the checksums of their arrays."""
LABELS, VARIABLES, CHOICES = "label_states", "variable_values", "choice_names"
MOST_INFLATED = 1100
"""Bytes that a byte of a deflated chunk stands for, at most: 1,032 (RFC 1951)."""
REIMPORT = "import it again"


def is_folder(folder: str | os.PathLike) -> bool:
    """Whether an imported MDP lies there."""
    try:
        manifest = storage.read_json(Path(folder) / MDP_MANIFEST)
    except (OSError, FileFormatError):
        return False
    return isinstance(manifest, dict) and manifest.get("format") == MDP_FORMAT


def read_mdp_manifest(folder: str | os.PathLike) -> dict[str, Any]:
    """Return the manifest of a folder.

    Raises:
        FileFormatError: there is none, it was changed, or it is of another version.
    """
    path = Path(folder) / MDP_MANIFEST
    try:
        manifest = storage.read_json(path, FileFormatError, REIMPORT)
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file; expected a folder that `pharos import` wrote") from None
    if not isinstance(manifest, dict) or manifest.get("format") != MDP_FORMAT:
        raise FileFormatError(f"{folder}: is no imported MDP; expected a folder that `pharos import` wrote")
    if manifest.get("format_version") not in VERSIONS:
        raise FileFormatError(
            f"{folder}: format version {manifest.get('format_version')!r}; this pharos reads versions "
            f"{', '.join(map(str, VERSIONS))}; {REIMPORT}"
        )
    if not storage.is_intact(manifest):
        raise FileFormatError(f"{path}: was changed after it was written; {REIMPORT}")
    if not isinstance(manifest.get("arrays"), dict):
        raise FileFormatError(
            f"{path}: arrays is {manifest.get('arrays')!r}; expected a checksum for each array; {REIMPORT}"
        )
    return manifest


def read_arrays(folder: str | os.PathLike, manifest: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays of the MDP by their names, compared with their checksums.

    Raises:
        FileFormatError: one is missing, damaged or changed. ValueError: they make no MDP.
    """
    checksums = manifest["arrays"]
    kind = TABLE if TABLE[0] in checksums else MATRIX
    if OUTCOME_ARRAYS[0] in checksums:
        offsets = ("offsets",) if "offsets" in checksums else ()
        kind = (
            *OUTCOME_ARRAYS,
            *offsets,
            *(("probabilities",) if "probabilities" in checksums else ("codes", "palette")),
        )
    names = (*COMMON_ARRAYS, *kind)
    version = manifest["format_version"]
    has_shown = version == OBSERVED_VERSION or (version in (PAID_VERSION, SETS_VERSION) and SHOWN_NAME in checksums)
    shown = (SHOWN_NAME,) * has_shown + (INDEX,) * (version == CHUNKS_VERSION)
    has_paid = version == PAID_VERSION or (version in (SETS_VERSION, CHUNKS_VERSION) and PAID[0] in checksums)
    has_sets = version == SETS_VERSION or (version == CHUNKS_VERSION and AVAILABLE in checksums)
    outcomes = PAID * has_paid
    names = (*names, *(AVAILABLE,) * has_sets)
    if set(checksums) != {*names, *shown, *outcomes}:
        raise ValueError(f"its arrays are {', '.join(checksums)}; expected {', '.join((*names, *shown, *outcomes))}")
    return {name: read_array(folder, manifest, name) for name in (*names, *outcomes)}


def write_rows(folder: Path, rows: DistinctRows) -> dict[str, Any]:
    """Write the chunks of observations, one after another. Returns what the manifest says of them."""
    lengths, checksums = [], []
    with storage.replacing(folder / CHUNKS) as file:
        for number in range(rows.num_chunks):
            chunk = rows.chunk(number)
            file.write(chunk)
            lengths.append(len(chunk))
            checksums.append(storage.digest_of_bytes(chunk))
    return {
        "rows": rows.num_distinct,
        "rows_in_chunk": rows.rows_in_chunk,
        "shape": list(rows.shape[1:]),
        "dtype": rows.dtype.str,
        "bytes": lengths,
        "checksums": checksums,
    }


def read_observations(folder: str | os.PathLike, manifest: Mapping[str, Any]) -> np.ndarray | DistinctRows | None:
    """Return the observations of the states, or None if there are none. Chunks are read and checked when they are used.

    Raises:
        FileFormatError: they are missing, damaged or changed, also when a chunk is read.
    """
    if manifest["format_version"] != CHUNKS_VERSION:
        return read_array(folder, manifest, SHOWN_NAME) if SHOWN_NAME in manifest["arrays"] else None
    path, index = Path(folder) / CHUNKS, read_array(folder, manifest, INDEX)
    try:
        entry = manifest[ROWS_NAME]
        count, in_chunk, shape, lengths, checksums = (
            entry[key] for key in ("rows", "rows_in_chunk", "shape", "bytes", "checksums")
        )
        dtype = np.dtype(str(entry["dtype"]))
        whole = [count, in_chunk, *shape, *lengths]
        if not all(type(each) is int and each >= 1 for each in whole) or dtype.kind not in "biuf":
            raise ValueError(f"{ROWS_NAME} is {capped(entry)}")
        if not len(lengths) == len(checksums) == -(-count // in_chunk):
            raise ValueError(f"there are {len(lengths)} chunks of {in_chunk} rows; expected {count} rows")
        largest = MOST_INFLATED * (lengths[0] + 1)
        if math.prod(shape) * dtype.itemsize * min(count, in_chunk) > largest:
            raise ValueError(f"a row of shape {capped(shape)} is larger than its chunk can hold")
        if index.ndim != 1 or index.dtype.kind not in "iu" or not len(index) or index.min() < 0 or index.max() >= count:
            raise ValueError(f"{INDEX} has shape {index.shape}; expected one row from 0 to {count - 1} a state")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise FileFormatError(f"{folder}: its observations are damaged: {reason}; {REIMPORT}") from None
    try:
        storage.check_regular(path)
        if path.stat().st_size != sum(lengths):
            raise FileFormatError(f"{path} was changed after it was written; {REIMPORT}")
    except OSError as error:
        wrong = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror}"
        raise FileFormatError(f"{path}: {wrong}; {REIMPORT}") from None
    ends = np.cumsum(lengths, dtype=np.int64).tolist()

    def chunk(number: int) -> bytes:
        try:
            with open(path, "rb") as file:
                file.seek(ends[number] - lengths[number])
                data = file.read(lengths[number])
        except OSError as error:
            wrong = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror}"
            raise FileFormatError(f"{path}: {wrong}; {REIMPORT}") from None
        if storage.digest_of_bytes(data) != checksums[number]:
            raise FileFormatError(f"{path} was changed after it was written; {REIMPORT}")
        return data

    return DistinctRows(index, shape, dtype, count, in_chunk, chunk, str(path))


def residual_of(manifest: Mapping[str, Any]) -> tuple[float, float]:
    """(in probability, in reward): distances that the sums of the imported rows leave open.

    Raises:
        ValueError: the entry is something else.
    """
    pair = manifest.get(RESIDUAL_NAME, [0.0, 0.0])
    is_pair = isinstance(pair, list) and len(pair) == 2 and all(type(each) in (int, float) for each in pair)
    if not is_pair or not all(0 <= each < math.inf for each in pair):
        raise ValueError(f"{RESIDUAL_NAME} is {pair!r}; expected two numbers from 0 on")
    return float(pair[0]), float(pair[1])


def rounding_of(manifest: Mapping[str, Any]) -> float:
    """A bound on the rounding error of each reward.

    Raises:
        ValueError: the entry is no number from 0 on.
    """
    rounding = manifest.get(ROUNDING_NAME, 0.0)
    if type(rounding) not in (int, float) or not 0 <= rounding < math.inf:
        raise ValueError(f"{ROUNDING_NAME} is {rounding!r}; expected a number from 0 on")
    return float(rounding)


def read_array(folder: str | os.PathLike, manifest: Mapping[str, Any], name: str) -> np.ndarray:
    """Return one array.

    Raises:
        FileFormatError: it is missing, damaged or changed.
    """
    path = Path(folder) / f"{name}.npy"
    return _checked_array(path, manifest["arrays"][name])


def read_names(folder: str | os.PathLike, manifest: Mapping[str, Any]) -> dict[str, Any] | None:
    """The names that a folder holds, or None.

    Returns:
        `labels`, `variables`, `booleans` (of the variables), `choices`: lists of names. And under LABELS (S, labels)
        bool, VARIABLES (S, variables) integers and CHOICES (S, A) integers, if there are names of this kind.
    Raises:
        FileFormatError: an array is missing, damaged, changed, or does not fit.
    """
    entry = manifest.get(NAMES_NAME)
    if entry is None:
        return None
    kinds = {"labels": LABELS, "variables": VARIABLES, "choices": CHOICES}
    lists = [entry.get(kind) for kind in (*kinds, "booleans")] if isinstance(entry, dict) else [None]
    sums = entry.get("arrays") if isinstance(entry, dict) else None
    if not all(isinstance(each, list) and all(isinstance(name, str) for name in each) for each in lists) or (
        not isinstance(sums, dict) or set(sums) != {array for kind, array in kinds.items() if entry[kind]}
    ):
        raise FileFormatError(f"{folder}: its names are damaged; {REIMPORT}")
    arrays = {name: _checked_array(Path(folder) / f"{name}.npy", checksum) for name, checksum in sums.items()}
    states, actions = manifest["num_states"], manifest["num_actions"]
    shapes = {
        LABELS: (states, len(entry["labels"])),
        VARIABLES: (states, len(entry["variables"])),
        CHOICES: (states, actions),
    }
    for name, array in arrays.items():
        fits = array.shape == shapes[name] and array.dtype.kind in ("b" if name == LABELS else "iu")
        if not fits or (
            name == CHOICES and array.size and not -1 <= array.min() <= array.max() < len(entry["choices"])
        ):
            raise FileFormatError(f"{folder}: {name} has shape {array.shape}; expected {shapes[name]}; {REIMPORT}")
    return {**entry, **arrays}


def _checked_array(path: Path, checksum: object) -> np.ndarray:
    try:
        digest = storage.digest_of_file(path)
    except OSError as error:
        wrong = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror}"
        raise FileFormatError(f"{path}: {wrong}; {REIMPORT}") from None
    if digest != checksum:
        raise FileFormatError(f"{path} was changed after it was written; {REIMPORT}")
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # headers are read as Python literals: whatever that may raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise FileFormatError(f"{path}: cannot be read as plain numbers: {reason}; {REIMPORT}") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise FileFormatError(f"{path}: holds no plain numbers; {REIMPORT}")
    return array
