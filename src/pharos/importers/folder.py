"""Imported MDPs kept in folders: plain .npy arrays, and a manifest with checksums and a digest that is written last."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pharos import storage
from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import OutcomeTable, TabularMDP

FORMAT, VERSION, MANIFEST = "pharos mdp", 1, "manifest.json"
COMMON = ("rewards", "terminal", "start_states", "start_probabilities")
TABLE = ("next_states",)
MATRIX = ("transitions_data", "transitions_indices", "transitions_indptr")
OUTCOMES = ("successors",)  # and, where they are: offsets; probabilities, or codes and palette
AGAIN = "import it again"


def save(mdp: TabularMDP, folder: str | os.PathLike, *, source: str = "") -> Path:
    """Write an MDP without chance into a folder.

    Args:
        folder: made where it is not there; an MDP that lies there is replaced, file by file and the manifest last.
        source: where the MDP comes from, for people.
    Raises:
        ParameterError: the folder holds something else, or the MDP has sticky or random actions (add them after
            loading).
    """
    folder = Path(folder)
    if mdp.is_sticky or mdp.is_random:
        raise ParameterError("an MDP is kept without sticky or random actions; add them when it is loaded")
    if folder.is_dir() and any(folder.iterdir()) and not is_folder(folder):
        raise ParameterError(f"{folder}: is not empty and holds no imported MDP; choose another folder")
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {
        "rewards": mdp.rewards,
        "terminal": np.asarray(mdp.terminal),
        "start_states": mdp.start_states,
        "start_probabilities": mdp.start_probabilities,
        **mdp.dynamics.arrays(),
    }
    checksums = {}
    for name, array in arrays.items():
        path = folder / f"{name}.npy"
        storage.replace_array(path, array)
        checksums[name] = storage.digest_of_file(path)
    manifest = {
        "format": FORMAT,
        "format_version": VERSION,
        "source": source,
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
        "gamma": mdp.gamma,
        "horizon": None if mdp.horizon is None else int(mdp.horizon),
        "arrays": checksums,
    }
    storage.replace_json(folder / MANIFEST, storage.sealed(manifest))
    return folder


def is_folder(folder: str | os.PathLike) -> bool:
    """Whether an imported MDP lies there."""
    try:
        manifest = storage.read_json(Path(folder) / MANIFEST)
    except (OSError, FileFormatError):
        return False
    return isinstance(manifest, dict) and manifest.get("format") == FORMAT


def load(folder: str | os.PathLike) -> TabularMDP:
    """Return the MDP that `save` wrote.

    Raises:
        FileFormatError: there is none, or a file is missing, damaged or changed.
    """
    folder = Path(folder)
    manifest = _manifest(folder)
    try:
        mdp = _mdp(manifest, _arrays(folder, manifest["arrays"]))
    except FileFormatError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, MemoryError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise FileFormatError(f"{folder}: the imported MDP is damaged: {reason}; {AGAIN}") from None
    return replace(mdp, folder=folder)


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    try:
        manifest = storage.read_json(path, FileFormatError, AGAIN)
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file; expected a folder that `pharos import` wrote") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise FileFormatError(f"{folder}: is no imported MDP; expected a folder that `pharos import` wrote")
    if manifest.get("format_version") != VERSION:
        raise FileFormatError(
            f"{folder}: format version {manifest.get('format_version')!r}; this pharos reads version {VERSION}; {AGAIN}"
        )
    if not storage.is_intact(manifest):
        raise FileFormatError(f"{path}: was changed after it was written; {AGAIN}")
    if not isinstance(manifest.get("arrays"), dict):
        raise FileFormatError(
            f"{path}: arrays is {manifest.get('arrays')!r}; expected a checksum for each array; {AGAIN}"
        )
    return manifest


def _arrays(folder: Path, checksums: Mapping[str, Any]) -> dict[str, np.ndarray]:
    kind = TABLE if TABLE[0] in checksums else MATRIX
    if OUTCOMES[0] in checksums:
        offsets = ("offsets",) if "offsets" in checksums else ()
        kind = (*OUTCOMES, *offsets, *(("probabilities",) if "probabilities" in checksums else ("codes", "palette")))
    names = (*COMMON, *kind)
    if set(checksums) != set(names):
        raise ValueError(f"its arrays are {', '.join(checksums)}; expected {', '.join(names)}")
    return {name: _array(folder / f"{name}.npy", checksums[name]) for name in names}


def _array(path: Path, checksum: Any) -> np.ndarray:
    try:
        digest = storage.digest_of_file(path)
    except OSError as error:
        wrong = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror}"
        raise FileFormatError(f"{path}: {wrong}; {AGAIN}") from None
    if digest != checksum:
        raise FileFormatError(f"{path} was changed after it was written; {AGAIN}")
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:  # headers are read as Python literals: whatever that may raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise FileFormatError(f"{path}: cannot be read as plain numbers: {reason}; {AGAIN}") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise FileFormatError(f"{path}: holds no plain numbers; {AGAIN}")
    return array


def _mdp(manifest: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> TabularMDP:
    """The MDP of these arrays, whoever wrote them; ValueError where they do not fit."""
    rewards = arrays["rewards"]
    if rewards.shape != (manifest["num_states"], manifest["num_actions"]):
        raise ValueError(
            f"rewards have shape {rewards.shape}; expected ({manifest['num_states']}, {manifest['num_actions']})"
        )
    initial = _initial(arrays["start_states"], arrays["start_probabilities"], len(rewards))
    options = {"gamma": manifest["gamma"], "horizon": manifest["horizon"], "initial": initial}
    if TABLE[0] in arrays:
        return TabularMDP.from_arrays(arrays[TABLE[0]], rewards, terminal=arrays["terminal"], **options)
    if OUTCOMES[0] in arrays:
        parts = {name: array for name, array in arrays.items() if name not in COMMON}
        dynamics = OutcomeTable(num_actions=rewards.shape[1], **parts)
        dynamics.check()
        return TabularMDP.from_outcome_table(dynamics, rewards, terminal=arrays["terminal"], **options)
    from scipy import sparse

    matrix = sparse.csr_matrix(tuple(arrays[name] for name in MATRIX), shape=(rewards.size, len(rewards)))
    matrix.check_format(full_check=True)
    return TabularMDP.from_matrices(matrix, rewards, **options)


def _initial(states: np.ndarray, probabilities: np.ndarray, num_states: int) -> int | np.ndarray:
    if states.ndim != 1 or states.dtype.kind not in "iu" or not len(states) or states.shape != probabilities.shape:
        raise ValueError(f"start states have shape {states.shape}, their probabilities {probabilities.shape}")
    if states.min() < 0 or states.max() >= num_states or len(np.unique(states)) < len(states):
        raise ValueError(f"start states are {states[:5]} ...; expected different ones from 0 to {num_states - 1}")
    if not np.isfinite(probabilities).all() or (probabilities < 0).any() or abs(probabilities.sum() - 1) > 1e-6:
        raise ValueError(f"start probabilities are {probabilities[:5]} ...; expected numbers from 0 on that sum to 1")
    if len(states) == 1:
        return int(states[0])
    initial = np.zeros(num_states)
    initial[states] = probabilities
    return initial
