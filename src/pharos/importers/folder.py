"""Imported MDPs kept in folders: plain .npy arrays, and a manifest with checksums that is written last."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import TabularMDP

FORMAT, VERSION, MANIFEST = "pharos mdp", 1, "manifest.json"


def save(mdp: TabularMDP, folder: str | os.PathLike, *, source: str = "") -> Path:
    """Write an MDP without chance into a folder.

    Args:
        folder: made where it is not there; an MDP that lies there is replaced.
        source: where the MDP comes from, for people.
    Raises:
        ParameterError: the folder holds something else, or the MDP has sticky or random actions (add them after loading).
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
    entries = {}
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array, allow_pickle=False)
        entries[name] = xxhash.xxh3_128((folder / f"{name}.npy").read_bytes()).hexdigest()
    manifest = {
        "format": FORMAT,
        "format_version": VERSION,
        "source": source,
        "num_states": mdp.num_states,
        "num_actions": mdp.num_actions,
        "gamma": mdp.gamma,
        "horizon": None if mdp.horizon is None else int(mdp.horizon),
        "arrays": entries,
    }
    partial = folder / f"{MANIFEST}.{os.getpid()}"
    partial.write_text(json.dumps(manifest, indent=1) + "\n")
    os.replace(partial, folder / MANIFEST)
    return folder


def is_folder(folder: Path) -> bool:
    """Whether an imported MDP lies there."""
    try:
        return json.loads((folder / MANIFEST).read_text()).get("format") == FORMAT
    except (OSError, ValueError, AttributeError):
        return False


def load(folder: str | os.PathLike) -> TabularMDP:
    """Return the MDP that `save` wrote.

    Raises:
        FileFormatError: there is none, or a file is missing, damaged or changed.
    """
    folder = Path(folder)
    try:
        manifest: dict[str, Any] = json.loads((folder / MANIFEST).read_text())
        if manifest["format"] != FORMAT or manifest["format_version"] != VERSION:
            raise ValueError(
                f"format {manifest['format']!r} {manifest['format_version']}; expected {FORMAT!r} {VERSION}"
            )
        arrays = {name: _array(folder / f"{name}.npy", digest) for name, digest in manifest["arrays"].items()}
        start = np.zeros(manifest["num_states"])
        start[arrays["start_states"]] = arrays["start_probabilities"]
        initial: Any = int(arrays["start_states"][0]) if len(arrays["start_states"]) == 1 else start
        options = {"gamma": manifest["gamma"], "horizon": manifest["horizon"], "initial": initial}
        if "next_states" in arrays:
            mdp = TabularMDP.from_arrays(
                arrays["next_states"], arrays["rewards"], terminal=arrays["terminal"], **options
            )
        else:
            from scipy import sparse

            parts = (arrays["transitions_data"], arrays["transitions_indices"], arrays["transitions_indptr"])
            shape = (arrays["rewards"].size, len(arrays["rewards"]))
            mdp = TabularMDP.from_matrices(sparse.csr_matrix(parts, shape=shape), arrays["rewards"], **options)
    except FileNotFoundError as error:
        raise FileFormatError(f"{error.filename}: no such file; expected a folder that `pharos import` wrote") from None
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise FileFormatError(f"{folder}: is no imported MDP, or damaged: {error}") from None
    return replace(mdp, folder=folder)


def _array(path: Path, digest: str) -> np.ndarray:
    if xxhash.xxh3_128(path.read_bytes()).hexdigest() != digest:
        raise ValueError(f"{path.name} was changed after it was written")
    return np.load(path, allow_pickle=False)
