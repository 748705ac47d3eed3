"""Imported MDPs kept in folders: plain .npy arrays, and a manifest with checksums and a digest that is written last."""

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pharos.environments import Environment, make
from pharos.errors import FileFormatError, FolderLocked, ParameterError
from pharos.mdp import Names, OutcomeTable, Residual, TabularMDP, checked_sets, lacking, whole_number, with_sets
from pharos.system import distinct_rows, mdp_files, storage
from pharos.system.distinct_rows import DistinctRows
from pharos.system.mdp_files import (
    COMMON_ARRAYS,
    MATRIX,
    MDP_FORMAT,
    MDP_MANIFEST,
    OUTCOME_ARRAYS,
    PAID,
    REIMPORT,
    SHOWN_NAME,
    TABLE,
    is_folder,
)


class ImportedOutcomes(NamedTuple):
    """Outcomes of each state and action: next state, probability and reward.

    Attributes:
        offsets: (S A + 1,) index of the first outcome of row s A + a. next_states: (N,), -1 for the end of the episode.
        probabilities, rewards: (N,).
    """

    offsets: np.ndarray
    next_states: np.ndarray
    probabilities: np.ndarray
    rewards: np.ndarray


IMAGE_OBSERVATION, GRID_OBSERVATION, VECTOR_OBSERVATION = "image", "grid", "vector"
BUILDING = ".building"
"""Folder, within that of an MDP, of what an import that is not finished has so far."""
OBSERVED = {IMAGE_OBSERVATION: 4, GRID_OBSERVATION: 4, VECTOR_OBSERVATION: 2}
"""Kinds of observations that a source may show -> dimensions of their array."""
FOREIGN = ": is not empty and holds no imported MDP; choose another folder"


def save(
    mdp: TabularMDP,
    folder: str | os.PathLike,
    *,
    source: str = "",
    actions: Sequence[str] | None = None,
    time_limit: int | None = None,
    observations: np.ndarray | DistinctRows | None = None,
    observed: str | None = None,
    outcomes: ImportedOutcomes | None = None,
) -> Path:
    """Write an MDP without chance into a folder.

    Args:
        folder: made if it does not exist. An MDP in it is replaced, file by file and the manifest last. If another
            process is writing it, `save` warns and waits for that process.
        source: origin of the MDP, for people.
        actions: names of the actions; None: those of `mdp.names`, else their numbers. Labels, variables and names of
            choices of `mdp.names` are kept as well.
        time_limit: steps after which training cuts an episode off if the MDP has no horizon; None: 1,000.
        observations: what the source shows of each state, which agents may see as the observation "recorded". Equal
            ones are stored once, and all are deflated.
        observed: what they are: "image", (S, H, W, 3) uint8; "grid", (S, columns, rows, C) uint8 codes of things;
            "vector", (S, N) numbers; None: "image" if they are (S, H, W, 3), else "vector".
        outcomes: of all states and actions, with the reward of each, which episodes are paid then; None: they are paid
            the mean reward.
    Raises:
        ParameterError: the folder holds something else, or the MDP has sticky, random or lazy actions (add them after
            loading); or names, limit, observations or outcomes do not fit it.
    """
    if actions is None and mdp.names is not None:
        actions = mdp.names.actions
    shown = observations if isinstance(observations, DistinctRows | None) else np.asarray(observations)
    description = _description(mdp, actions, time_limit, shown, observed)
    outcome_arrays = {} if outcomes is None else _checked_outcomes(mdp, outcomes)
    folder = Path(folder)
    _check_without_chance(mdp)
    check_free(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows = distinct_rows.collect_rows(shown) if isinstance(shown, np.ndarray) else shown
    arrays = _arrays_of(mdp) | outcome_arrays | ({} if rows is None else {mdp_files.INDEX: _narrow(rows.index)})
    version = mdp_files.PAID_VERSION if outcome_arrays else mdp_files.VERSION
    version = version if mdp.available is None else mdp_files.SETS_VERSION
    version = version if rows is None else mdp_files.CHUNKS_VERSION
    with storage.waiting_lock(folder, FolderLocked, "importing", _warn):
        if _is_foreign(folder):
            raise ParameterError(f"{folder}{FOREIGN}")
        if not is_folder(folder):  # a mark, so that a killed import is repeated there
            storage.replace_json(folder / MDP_MANIFEST, {"format": MDP_FORMAT, "format_version": "unfinished"})
        checksums = _written(folder, arrays)
        stored = {} if rows is None else {mdp_files.ROWS_NAME: mdp_files.write_rows(folder, rows)}
        names, name_arrays = _names_of(mdp)
        if names:
            description[mdp_files.NAMES_NAME] = {**names, "arrays": _written(folder, name_arrays)}
        manifest = {
            "format": MDP_FORMAT,
            "format_version": version,
            "source": source,
            "num_states": mdp.num_states,
            "num_actions": mdp.num_actions,
            "gamma": mdp.gamma,
            "horizon": None if mdp.horizon is None else int(mdp.horizon),
            "arrays": checksums,
            **description,
            **stored,
            **({mdp_files.RESIDUAL_NAME: list(mdp.residual)} if any(mdp.residual) else {}),
            **({mdp_files.ROUNDING_NAME: mdp.reward_table.rounding} if mdp.reward_table.rounding else {}),
        }
        storage.replace_json(folder / MDP_MANIFEST, storage.sealed(manifest))
        (folder / storage.LOCK).unlink()  # whoever waits for it replaces what is whole
    return folder


def check_free(folder: Path) -> None:
    """ParameterError if an MDP cannot be saved in a folder, as it holds something else."""
    # Asked again, as another process may have begun there, or ended, in between
    if _is_foreign(folder) and not (folder / storage.LOCK).exists() and _is_foreign(folder):
        raise ParameterError(f"{folder}{FOREIGN}")


def _written(folder: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, str]:
    """Write arrays into a folder; the checksum of each file."""
    checksums = {}
    for name, array in arrays.items():
        path = folder / f"{name}.npy"
        storage.replace_array(path, array)
        checksums[name] = storage.digest_of_file(path)
    return checksums


def _names_of(mdp: TabularMDP) -> tuple[dict[str, list[str]], dict[str, np.ndarray]]:
    """(lists of names, arrays) of the labels, variables and choices of an MDP; empty if it has none."""
    names = mdp.names
    if names is None or not (names.labels or names.variables or names.choice_names):
        return {}, {}
    columns = {name: np.asarray(column) for name, column in names.variables.items()}
    arrays = {}
    if names.labels:
        arrays[mdp_files.LABELS] = np.stack([np.asarray(mask, np.bool_) for mask in names.labels.values()], axis=1)
    if columns:
        arrays[mdp_files.VARIABLES] = _narrow(
            np.stack([column.astype(np.int64) for column in columns.values()], axis=1)
        )
    if names.choices is not None and names.choice_names:
        arrays[mdp_files.CHOICES] = _narrow(np.asarray(names.choices))
    lists = {
        "labels": list(names.labels),
        "variables": list(columns),
        "booleans": [name for name, column in columns.items() if column.dtype == np.bool_],
        "choices": list(names.choice_names),
    }
    return lists, arrays


def _narrow(numbers: np.ndarray) -> np.ndarray:
    """Integers in the narrowest signed type that holds them."""
    least, most = int(numbers.min(initial=0)), int(numbers.max(initial=0))
    return numbers.astype(next(t for t in (np.int8, np.int16, np.int32, np.int64) if _holds(t, least, most)))


def _holds(dtype: type, least: int, most: int) -> bool:
    return bool(np.iinfo(dtype).min <= least and most <= np.iinfo(dtype).max)


def _read_names(folder: Path, manifest: Mapping[str, Any]) -> Names | None:
    """The names that a folder holds; None: neither labels, variables nor names of actions."""
    stored, actions = mdp_files.read_names(folder, manifest), manifest.get("actions")
    if stored is None:
        return None if actions is None else Names(actions=tuple(actions))
    values = stored[mdp_files.VARIABLES] if stored["variables"] else np.empty((0, 0))
    return Names(
        labels={name: stored[mdp_files.LABELS][:, i] for i, name in enumerate(stored["labels"])},
        variables={
            name: values[:, i].astype(np.bool_) if name in stored["booleans"] else values[:, i].astype(np.int64)
            for i, name in enumerate(stored["variables"])
        },
        actions=None if actions is None else tuple(actions),
        choices=stored.get(mdp_files.CHOICES),
        choice_names=tuple(stored["choices"]),
    )


def _is_foreign(folder: Path) -> bool:
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    others = {name for name in names - {storage.LOCK, storage.CLAIM, BUILDING} if not storage.is_temporary(name)}
    return bool(others) and not is_folder(folder)


def _warn(text: str) -> None:
    warnings.warn(text, RuntimeWarning, stacklevel=4)


def _checked_outcomes(mdp: TabularMDP, outcomes: ImportedOutcomes) -> dict[str, np.ndarray]:
    """Arrays of the outcomes by name; ParameterError if they do not belong to the MDP."""
    offsets, successors, probabilities, rewards = (np.asarray(each) for each in outcomes)
    pairs = mdp.num_states * mdp.num_actions
    fits = offsets.shape == (pairs + 1,) and offsets[0] == 0 and offsets[-1] == len(successors)
    if not (fits and (np.diff(offsets) > 0).all() and successors.shape == probabilities.shape == rewards.shape):
        raise ParameterError(f"outcomes are {len(successors)}; expected one or more of each of {pairs} rows s A + a")
    means = np.add.reduceat(probabilities * rewards, offsets[:-1])
    size = np.maximum(1.0, np.maximum.reduceat(np.abs(rewards), offsets[:-1]))
    if not (np.abs(means - np.asarray(mdp.rewards).ravel()) <= 1e-6 * size).all():
        raise ParameterError("rewards of outcomes do not have the rewards of the MDP as their means")
    return dict(zip(PAID, (offsets, successors, probabilities, rewards), strict=True))


def _description(
    mdp: TabularMDP,
    actions: Sequence[str] | None,
    time_limit: int | None,
    shown: np.ndarray | DistinctRows | None,
    observed: str | None,
) -> dict[str, Any]:
    """Entries of the manifest on actions, time limit and observations; ParameterError if they do not fit the MDP."""
    description: dict[str, Any] = {}
    if actions is not None:
        if len(actions) != mdp.num_actions or not all(isinstance(name, str) and name for name in actions):
            raise ParameterError(f"actions are {actions!r}; expected {mdp.num_actions} names")
        description["actions"] = list(actions)
    if time_limit is not None:
        description["time_limit"] = whole_number(time_limit, "time_limit", "a number of steps of at least 1")
    if shown is not None:
        kind = observed or (IMAGE_OBSERVATION if shown.ndim == 4 else VECTOR_OBSERVATION)
        fits = kind in OBSERVED and shown.ndim == OBSERVED[kind] and len(shown) == mdp.num_states and all(shown.shape)
        if not fits or (shown.dtype.kind not in "biuf" if kind == VECTOR_OBSERVATION else shown.dtype != np.uint8):
            raise ParameterError(
                f"observations have shape {shown.shape} and type {shown.dtype}; expected {mdp.num_states} images "
                f"(S, H, W, 3) uint8, grids (S, columns, rows, C) uint8, or vectors (S, N)"
            )
        description[SHOWN_NAME] = kind
    return description


def environment(mdp: TabularMDP | str | os.PathLike) -> Environment:
    """Return the environment whose rules are the table of an imported MDP: to train on, to step and to draw.

    Args:
        mdp: a folder that `save` wrote; or an MDP without sticky, random or lazy actions, which is stored in the user's
            cache if it has no such folder. Its discount is left to the task.
    Raises:
        FileFormatError: the folder holds none, or was changed. ParameterError: the MDP has sticky, random or lazy
            actions.
    """
    if not isinstance(mdp, TabularMDP):
        return make("imported", folder=os.fspath(mdp))
    _check_without_chance(mdp)
    if mdp.folder is not None and is_folder(mdp.folder):
        return make("imported", folder=os.fspath(mdp.folder))
    imported = storage.cache_directory() / "imported"
    parts = {name: storage.digest_of_bytes(np.ascontiguousarray(each).data) for name, each in _arrays_of(mdp).items()}
    shape = [mdp.num_states, mdp.num_actions, mdp.gamma, mdp.horizon]
    contents: list[Any] = [*shape, str(mdp.chance), sorted(parts.items())]
    names, name_arrays = _names_of(mdp)
    if mdp.names is not None:
        digests = [storage.digest_of_bytes(np.ascontiguousarray(each).data) for each in name_arrays.values()]
        contents += [names, digests, mdp.names.actions]
    contents += [*mdp.residual] if any(mdp.residual) else []
    contents += [mdp_files.ROUNDING_NAME, mdp.reward_table.rounding] if mdp.reward_table.rounding else []
    folder = imported / storage.digest_of_json(contents)
    return make("imported", folder=os.fspath(folder if is_folder(folder) else save(mdp, folder)))


def _check_without_chance(mdp: TabularMDP) -> None:
    if not mdp.chance.is_none or mdp.laziness:
        raise ParameterError(
            "an MDP is kept without sticky or random actions, and without lazy ones; add them when it is loaded"
        )


def _arrays_of(mdp: TabularMDP) -> dict[str, np.ndarray]:
    return {
        "rewards": mdp.rewards,
        "terminal": np.asarray(mdp.terminal),
        "start_states": mdp.start_states,
        "start_probabilities": mdp.start_probabilities,
        **({} if mdp.available is None else {mdp_files.AVAILABLE: mdp.available}),
        **mdp.dynamics.arrays(),
    }


def load(folder: str | os.PathLike) -> TabularMDP:
    """Return the MDP that `save` wrote.

    Raises:
        FileFormatError: there is none, or a file is missing, damaged or changed.
    """
    folder = Path(folder)
    manifest = mdp_files.read_mdp_manifest(folder)
    try:
        mdp = _mdp(manifest, mdp_files.read_arrays(folder, manifest))
        residual = mdp.residual.plus(Residual(*mdp_files.residual_of(manifest)))
        rewards = replace(mdp.reward_table, rounding=mdp_files.rounding_of(manifest))
        names = _read_names(folder, manifest)
    except FileFormatError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, MemoryError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise FileFormatError(f"{folder}: the imported MDP is damaged: {reason}; {REIMPORT}") from None
    return replace(mdp, folder=folder, residual=residual, reward_table=rewards, names=names)


def _mdp(manifest: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> TabularMDP:
    """The MDP of arrays read from a folder; ValueError if they do not fit each other."""
    mdp = _filled_mdp(manifest, arrays)
    if mdp_files.AVAILABLE not in arrays:
        return mdp
    return with_sets(mdp, checked_sets(arrays[mdp_files.AVAILABLE], mdp.reward_table.shape))


def _filled_mdp(manifest: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> TabularMDP:
    """The MDP of the arrays as if all actions were available: the others are filled."""
    rewards = arrays["rewards"]
    if rewards.shape != (manifest["num_states"], manifest["num_actions"]):
        raise ValueError(
            f"rewards have shape {rewards.shape}; expected ({manifest['num_states']}, {manifest['num_actions']})"
        )
    initial = _initial(arrays["start_states"], arrays["start_probabilities"], len(rewards))
    options = {"gamma": manifest["gamma"], "horizon": manifest["horizon"], "initial": initial}
    if TABLE[0] in arrays:
        return TabularMDP.from_arrays(arrays[TABLE[0]], rewards, terminal=arrays["terminal"], **options)
    if OUTCOME_ARRAYS[0] in arrays:
        others = (*COMMON_ARRAYS, *PAID, mdp_files.AVAILABLE)
        parts = {name: array for name, array in arrays.items() if name not in others}
        dynamics = OutcomeTable(num_actions=rewards.shape[1], **parts)
        dynamics.check()
        return TabularMDP.from_outcome_table(dynamics, rewards, terminal=arrays["terminal"], **options)
    from scipy import sparse

    matrix = sparse.csr_matrix(tuple(arrays[name] for name in MATRIX), shape=(rewards.size, len(rewards)))
    matrix.check_format(full_check=True)
    return TabularMDP.from_matrices(matrix, rewards, ends=lacking(matrix), **options)


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
