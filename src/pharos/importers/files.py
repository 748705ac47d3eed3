"""Files of the BRIDGE dataset (Laidlaw, Russell and Dragan 2023): `consolidated.npz` and the like."""

import os
import re
import zipfile
from pathlib import Path

import numpy as np

from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import TabularMDP, whole_number
from pharos.system import storage

SUFFIXES = (".prism", ".nm", ".pm", ".sm", ".jani", ".drn")
"""Of models that `pharos import prism` takes."""
MINIGRID_STEPS = 100
LARGEST_HORIZON = 100_000
"""In the name of a file: those of BRIDGE say 8 to 200, and values take time for each step."""


def bridge(path: str | os.PathLike, horizon: int | None = None) -> TabularMDP:
    """Return the MDP of a BRIDGE file: undiscounted, T steps, starting in row 0, -1 ending the episode.

    Args:
        path: npz with `transitions` (S, A) integers and `rewards` (S, A); other members are not read.
        horizon: T; None: what the name says: `<rom>_<T>_fs<k>` for Atari and Procgen, 100 for MiniGrid.
    Raises:
        FileFormatError: no npz, a member is missing, pickled, of the wrong shape, or holds an index or reward out of
            range.
        ParameterError: no horizon can be told, or the one given contradicts the name.
    Source: BRIDGE, https://doi.org/10.5281/zenodo.10966777, its data card. The horizon matters: states that are first
        met at depth T are coded as terminal.
    """
    path = Path(path)
    arrays = _members(path, ("transitions", "rewards"))
    transitions, rewards = arrays["transitions"], arrays["rewards"]
    if transitions.ndim != 2 or transitions.dtype.kind not in "iu" or not transitions.size:
        raise FileFormatError(
            f"{path}: transitions have shape {transitions.shape} and type {transitions.dtype}; "
            f"expected integers (states, actions)"
        )
    if rewards.shape != transitions.shape or rewards.dtype.kind not in "iuf":
        raise FileFormatError(
            f"{path}: rewards have shape {rewards.shape} and type {rewards.dtype}; "
            f"expected numbers of shape {transitions.shape}"
        )
    steps = _horizon(path, horizon)
    try:
        return TabularMDP.from_arrays(transitions, rewards.astype(np.float64), gamma=1.0, horizon=steps)
    except ParameterError as error:
        raise FileFormatError(f"{path}: {error}") from None


def bridge_screens(path: str | os.PathLike) -> np.ndarray:
    """Return the screen of each state, (S, H, W, 3) uint8, if the file has screens.

    Raises:
        FileFormatError: it has none, or they do not fit.
    """
    path = Path(path)
    arrays = _members(path, ("transitions", "screens", "screen_mapping"))
    screens, mapping = arrays["screens"], arrays["screen_mapping"]
    if screens.ndim != 4 or screens.dtype != np.uint8 or mapping.shape != (len(arrays["transitions"]),):
        raise FileFormatError(
            f"{path}: screens have shape {screens.shape}, screen_mapping {mapping.shape}; "
            f"expected (screens, height, width, 3) uint8 and one number a state"
        )
    if mapping.dtype.kind not in "iu" or (mapping < 0).any() or (mapping >= len(screens)).any():
        raise FileFormatError(
            f"{path}: screen_mapping names a screen that is not there; expected 0 to {len(screens) - 1}"
        )
    return screens[mapping]


def has_screens(path: str | os.PathLike) -> bool:
    """Whether a file of BRIDGE has the screens of its states; only the list of its members is read."""
    try:
        storage.check_regular(path)
        with zipfile.ZipFile(path) as file:
            return {"screens.npy", "screen_mapping.npy"} <= set(file.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def how_to_import(path: Path) -> str:
    """The command that brings a file into a folder; or which files can be. FileFormatError: it is code."""
    if path.suffix == ".py":
        classes = re.findall(r"^class (\w+)", path.read_text(encoding="utf-8", errors="replace"), re.MULTILINE)
        raise FileFormatError(f"{path} is code; name a class in it, such as {path}:{(classes or ['MyClass'])[0]}")
    kind = "prism" if path.suffix in SUFFIXES else "bridge" if path.suffix == ".npz" else ""
    if kind:
        return f"`pharos import {kind} {path} --out FOLDER`"
    return (
        f"`pharos import` takes {', '.join(SUFFIXES)} and BRIDGE's .npz; matrices of other files go to "
        f"importers.matrices(P, R) and importers.save in Python"
    )


def _members(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    try:
        storage.check_regular(path)
        if path.exists() and not zipfile.is_zipfile(path):
            advice = "" if path.suffix == ".npz" else f"; {how_to_import(path)}"
            raise FileFormatError(f"{path}: cannot be read as npz: it is no zip archive{advice}")
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            missing = [name for name in names if name not in stored.files]
            if missing:
                raise FileFormatError(
                    f"{path}: lacks {', '.join(missing)}; found {', '.join(stored.files) or 'nothing'}: "
                    f"expected a file of BRIDGE"
                )
            return {name: stored[name] for name in names}
    except FileNotFoundError:
        raise ParameterError(f"{path}: no such file") from None
    except FileFormatError:
        raise
    except (
        Exception
    ) as error:  # of zipfile, zlib, lzma, struct, NumPy and the parser of array headers: each has its own
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise FileFormatError(f"{path}: cannot be read as npz without unpickling: {reason}") from None


def _horizon(path: Path, horizon: int | None) -> int:
    named = horizon_of_name(path)
    if horizon is not None:
        whole_number(horizon, "horizon", "a whole number of steps, at least 1")
    if named is None and horizon is None:
        raise ParameterError(
            f"{path}: its name does not tell the horizon; give one (`--horizon T`), as its values depend on it"
        )
    if named is not None and horizon is not None and named != horizon:
        raise ParameterError(f"{path}: horizon {horizon} contradicts its name, which says {named}; leave it out")
    if horizon is None and named is not None and named > LARGEST_HORIZON:
        raise ParameterError(
            f"{path}: its name says {named} steps; expected at most {LARGEST_HORIZON}: "
            f"give a horizon (`--horizon T`) and another name"
        )
    return int(named if horizon is None else horizon)  # type: ignore[arg-type]


def horizon_of_name(path: Path) -> int | None:
    """T from the name of a file or its folder: `freeway_10_fs30`, or MiniGrid."""
    for name in (path.stem, path.resolve().parent.name):
        match = re.search(r"_(\d+)_fs\d+", name)
        if match:
            return int(match[1])
        if "minigrid" in name.lower():
            return MINIGRID_STEPS
    return None
