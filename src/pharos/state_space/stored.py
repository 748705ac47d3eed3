"""The files of a finished state space: mapped, and checked for consistent content.

States and successors must be in their ranges, and agree with the rules, and so must the outcomes of an environment with
chance.

Shards: the files of a state space as ranges in several folders, which an earlier pharos wrote. They can still be read.
The folder of the space has its manifest and `shards.json`, a list of folders. Each of these has a range of every file,
under the file's own name, and `shard.json`: the digest of the manifest, the shard's number and the count. Ranges begin
at multiples of 1 MiB, so that they can be mapped side by side as the one array that they are.
"""

import ctypes
import mmap
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import ParameterError, StateSpaceCorrupted, StateSpaceError, StateSpaceMismatch
from pharos.rules import Layout, unpack_states
from pharos.state_space.manifest import (
    BUILD_AGAIN,
    CODES,
    OFFSETS,
    PALETTE,
    PROBABILITIES,
    STATES,
    SUCCESSORS,
    TERMINAL,
    check_lengths,
    successors_name,
)
from pharos.system import storage
from pharos.system.arrays import (
    SUM_TOLERANCE,
    Indices,
    OutcomeCheck,
    OutcomeRows,
    OutcomesOfState,
    WrongOutcomes,
    dtype_of,
    from_stored,
)

SHARDS, SHARD = "shards.json", "shard.json"
_FIXED, _SHARED, _READ = 0x10, 0x01, 0x01  # MAP_FIXED, MAP_SHARED, PROT_READ


def check_files(folder: Path, manifest: dict[str, Any]) -> None:
    """Raise StateSpaceCorrupted if a file is missing, or shorter than committed. For shards see `file_parts`."""
    if not (folder / SHARDS).exists():
        return check_lengths(folder, manifest)
    for name in manifest["arrays"]:
        file_parts(folder, manifest, name)


def file_parts(folder: Path, manifest: dict[str, Any], name: str) -> list[Path]:
    """Paths of the files that make up a file of a state space, in order: itself, or its ranges in shards.

    Raises:
        StateSpaceError: a shard is missing. StateSpaceMismatch: one is of another build. StateSpaceCorrupted: the list
        of shards, or a range, is not as it was written.
    """
    listed = folder / SHARDS
    if (folder / name).exists() or not listed.exists():
        return [folder / name]
    record = storage.read_json(listed, StateSpaceCorrupted)
    names = record.get("folders") if isinstance(record, dict) else None
    if not isinstance(names, list) or not names or not all(isinstance(each, str) for each in names):
        raise StateSpaceCorrupted(f"{listed}: expected a list of folders under `folders`")
    shards = [folder / each for each in names]
    # each shard must be there, and belong to this build
    for number, shard in enumerate(shards):
        which = f"{shard}: shard {number} of {len(shards)} of {folder}"
        if not (shard / SHARD).exists():
            raise StateSpaceError(
                f"{which} is missing (no {SHARD}); mount its disk, or write where it is into {listed}"
            )
        record = storage.read_json(shard / SHARD, StateSpaceCorrupted)
        expected = {"digest": manifest["digest"], "number": number, "count": len(shards)}
        if not isinstance(record, dict) or expected.items() - record.items():
            raise StateSpaceMismatch(f"{which} is another one, or of another build, says its {SHARD}; mount its disk")
    # the ranges of the file, which must have its length together
    parts = [shard / name for shard in shards]
    sizes = [part.stat().st_size if part.exists() else 0 for part in parts]
    if sum(sizes) != manifest["arrays"][name]["bytes"]:
        raise StateSpaceCorrupted(
            f"{folder}: {name} has {sum(sizes)} bytes in its shards; expected {manifest['arrays'][name]['bytes']}: "
            "one was truncated or replaced"
        )
    return [part for part, size in zip(parts, sizes, strict=True) if size] or [folder / name]


def mapped(parts: Sequence[Path], dtype: str | np.dtype) -> np.ndarray:
    """The numbers (N,) in files, mapped one behind the other, read-only.

    Raises:
        ParameterError: there are several files, and this system cannot map them so.
    """
    if len(parts) == 1:
        return np.memmap(parts[0], dtype, "r")
    if sys.platform not in ("linux", "darwin"):
        raise ParameterError(
            f"{parts[0]}: shards are read on Linux and macOS; put the files together: cat shard-*/NAME > NAME"
        )
    sizes = [part.stat().st_size for part in parts]
    memory = mmap.mmap(-1, sum(sizes), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=mmap.PROT_READ)
    array = np.frombuffer(memory, np.uint8)
    library = ctypes.CDLL(None, use_errno=True)
    library.mmap.restype = ctypes.c_void_p
    library.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_longlong]
    address = array.ctypes.data
    for part, size in zip(parts, sizes, strict=True):  # in the place of what was reserved; goes when `memory` goes
        with open(part, "rb") as file:
            if library.mmap(address, size, _READ, _SHARED | _FIXED, file.fileno(), 0) != address:
                error = ctypes.get_errno()
                raise OSError(error, os.strerror(error), str(part))
        address += size
    return array.view(dtype)


def byte_blocks(parts: Sequence[Path], size: int) -> Iterator[bytes]:
    """The bytes of files in blocks of `size`, which may begin in one and end in another."""
    left = bytearray()
    for part in parts:
        with open(part, "rb") as file:
            while data := file.read(size - len(left)):
                left += data
                if len(left) == size:
                    yield bytes(left)
                    left.clear()
    if left:
        yield bytes(left)


# States and successors ------------------------------------------------------------------------------------------------

_BLOCK_ENTRIES = 1 << 17


def check_components(folder: Path, env: Environment, manifest: dict[str, Any]) -> None:
    """Raise StateSpaceMismatch if actions or components of a state differ from the environment's."""
    expected = {"actions": list(env.actions), "names": list(env.components.names), "outcomes": int(env.outcomes)}
    stored = {
        "actions": manifest["actions"],
        "names": manifest["layout"]["names"],
        "outcomes": manifest.get("outcomes", 1),
    }
    sizes = env.components.low.tolist(), env.components.size.tolist()
    if expected != stored or sizes != (manifest["layout"]["low"], manifest["layout"]["size"]):
        raise StateSpaceMismatch(
            f"{folder}: holds {manifest['environment']} with the actions {stored['actions']} of at most "
            f"{stored['outcomes']} outcomes and states of {stored['names']}, which are not those of {env}; choose "
            f"another folder"
        )


def states_to_check(num_states: int) -> np.ndarray:
    """Numbers of 64 states, spread over all of them, in which rules are compared with stored transitions."""
    return np.unique(np.linspace(0, num_states - 1, 64).astype(np.int64))


def check_rules(
    folder: Path, env: Environment, layout: Layout, states: np.ndarray, successors: Indices, bits: np.ndarray
) -> None:
    """Raise StateSpaceMismatch if the rules of `env` disagree with the stored transitions of 64 states."""
    indices = states_to_check(len(successors))
    _check_range(folder / SUCCESSORS, successors[indices], len(states), indices)
    next_states = unpack_states(layout, states[successors[indices].ravel()]).tolist()
    check_states(folder / STATES, layout, states[indices])
    check_states(folder / STATES, layout, states[successors[indices].ravel()])
    for n, (i, row) in enumerate(zip(indices.tolist(), unpack_states(layout, states[indices]).tolist(), strict=True)):
        state = tuple(row)
        stored = [tuple(row) for row in next_states[n * env.num_actions : (n + 1) * env.num_actions]]
        try:
            ended = bool(env.is_terminal(state))
            outcomes = [state if ended else env.next_state(state, action) for action in range(env.num_actions)]
        except Exception as error:
            raise StateSpaceMismatch(
                f"{folder}: was built with other rules: those of this {env.name} fail in state {state}: {error!r}; "
                f"build in another folder"
            ) from error
        if stored != outcomes or ended != bool(bits[i // 8] >> (i % 8) & 1):
            raise StateSpaceMismatch(
                f"{folder}: was built with other rules: from state {state} they lead to {stored}, those of this "
                f"{env.name} to {outcomes}; build in another folder, and raise `version` when you change rules"
            )


def check_successors(path: Path, successors: Indices, terminal_bits: np.ndarray, num_terminal: int) -> None:
    """Raise StateSpaceCorrupted if an index is no state, or a terminal state does not lead to itself.

    Cost: one pass over the successors, in blocks that fit into a processor's cache.
    """
    rows = max(8, _BLOCK_ENTRIES // successors.shape[1] // 8 * 8)
    terminal = 0
    for start in range(0, len(successors), rows):
        block = np.asarray(successors[start : start + rows])
        _check_range(path, block, len(successors), range(start, start + len(block)))
        bits = terminal_bits[start // 8 : (start + rows) // 8]
        if not bits.any():
            continue
        ended = np.flatnonzero(np.unpackbits(bits, count=len(block), bitorder="little"))
        terminal += len(ended)
        leaving = (block[ended] != start + ended[:, None]).any(axis=1)
        if leaving.any():
            raise StateSpaceCorrupted(
                f"{path}: terminal state {start + int(ended[leaving.argmax()])} leads to another state; {BUILD_AGAIN}"
            )
    if terminal != num_terminal:
        raise StateSpaceCorrupted(
            f"{path.with_name(TERMINAL)}: marks {terminal} terminal states; expected {num_terminal}; {BUILD_AGAIN}"
        )


def _check_range(path: Path, block: np.ndarray, num_states: int, numbers: Sequence[int] | np.ndarray) -> None:
    """Raise StateSpaceCorrupted if an index is no state. `numbers`: the states whose rows are in the block."""
    if block.min() < 0 or block.max() >= num_states:
        row, action = map(int, np.argwhere((block < 0) | (block >= num_states))[0])
        raise StateSpaceCorrupted(
            f"{path}: action {action} leads from state {numbers[row]} to state {block[row, action]}; "
            f"expected 0 to {num_states - 1}; {BUILD_AGAIN}"
        )


def check_states(path: Path, layout: Layout, states: np.ndarray) -> None:
    """Raise StateSpaceCorrupted if a component of a packed state is out of its range."""
    mask = layout.mask.astype(np.uint64)
    narrow = [i for i in range(len(mask)) if int(mask[i]) + 1 != int(layout.size[i])]  # the others cannot be
    if not narrow:
        return
    rows = max(1, _BLOCK_ENTRIES // 8)
    for start in range(0, len(states), rows):
        block = np.asarray(states[start : start + rows])
        for i in narrow:
            field = (block[:, int(layout.word[i])] >> layout.shift[i]) & mask[i]
            if int(field.max()) >= int(layout.size[i]):
                raise StateSpaceCorrupted(
                    f"{path}: component {i} of state {start + int(field.argmax())} is {int(field.max())}; "
                    f"expected less than {int(layout.size[i])}; {BUILD_AGAIN}"
                )


# Outcomes -------------------------------------------------------------------------------------------------------------


def stored_outcomes(folder: Path, manifest: dict[str, Any]) -> OutcomeRows:
    """The arrays of outcomes of a folder, as memory maps. Nothing is read yet."""
    arrays, successors = manifest["arrays"], successors_name(manifest["arrays"])
    pairs = manifest["num_states"], manifest["num_actions"]
    of_outcomes = (manifest["num_transitions"],) if OFFSETS in arrays else (*pairs, manifest["num_outcomes"])
    shapes = {
        successors: of_outcomes,
        OFFSETS: (pairs[0] * pairs[1] + 1,),
        CODES: pairs,
        PALETTE: (-1, manifest["num_outcomes"]),
        PROBABILITIES: of_outcomes,
    }
    maps = {
        name: mapped(file_parts(folder, manifest, name), dtype_of(arrays[name]["dtype"])).reshape(shape)
        for name, shape in shapes.items()
        if name in arrays
    }
    others = {name.removesuffix(".bin"): array for name, array in maps.items() if name != successors}
    return OutcomeRows(from_stored(maps[successors]), **others)


def check_outcomes(folder: Path, manifest: dict[str, Any], stored: OutcomeRows, terminal_bits: np.ndarray) -> None:
    """Raise StateSpaceCorrupted if the arrays are not outcomes of a state space.

    Cost: one pass over them, in blocks that fit into a processor's cache.
    """
    num_states, num_actions, most = (manifest[name] for name in ("num_states", "num_actions", "num_outcomes"))
    step = max(8, _BLOCK_ENTRIES // (num_actions * most) // 8 * 8)
    terminals = transitions = 0
    try:
        check = OutcomeCheck(stored, (num_states, num_actions), most, 0)
        for start in range(0, num_states, step):
            stop = min(start + step, num_states)
            counts, first = check.block(start, stop)
            bits = terminal_bits[start // 8 : (start + step) // 8]
            ended = np.flatnonzero(np.unpackbits(bits, count=stop - start, bitorder="little"))
            terminals += len(ended)
            transitions += int(counts.sum())
            leaving = first.reshape(-1, num_actions)[ended] != (start + ended)[:, None]
            leaving |= counts.reshape(-1, num_actions)[ended] != 1
            if leaving.any():
                state = start + int(ended[leaving.any(axis=1).argmax()])
                raise WrongOutcomes("successors", f"terminal state {state} leads to another state")
        if terminals != manifest["num_terminal_states"]:
            expected = manifest["num_terminal_states"]
            raise WrongOutcomes("terminal", f"marks {terminals} terminal states; expected {expected}")
        if transitions != manifest["num_transitions"]:
            expected = manifest["num_transitions"]
            raise WrongOutcomes("successors", f"has {transitions} transitions; expected {expected}")
    except WrongOutcomes as error:
        raise _corrupted(folder, manifest, error) from None


def _corrupted(folder: Path, manifest: dict[str, Any], error: WrongOutcomes) -> StateSpaceCorrupted:
    names = {"successors": successors_name(manifest["arrays"]), "terminal": TERMINAL}
    return StateSpaceCorrupted(f"{folder / names.get(error.name, f'{error.name}.bin')}: {error}; {BUILD_AGAIN}")


def outcomes_to_check(
    folder: Path, manifest: dict[str, Any], stored: OutcomeRows, states: np.ndarray
) -> dict[int, OutcomesOfState]:
    """Outcomes of some states, from arrays that are not checked yet. StateSpaceCorrupted if they are none."""
    shape = manifest["num_states"], manifest["num_actions"]
    try:
        check = OutcomeCheck(stored, shape, manifest["num_outcomes"], 0)
        for s in states.tolist():
            check.block(s, s + 1)
    except WrongOutcomes as error:
        raise _corrupted(folder, manifest, error) from None
    return stored.of_states(states, manifest["num_actions"])


def check_outcome_rules(
    folder: Path,
    env: Environment,
    layout: Layout,
    states: np.ndarray,
    outcomes: dict[int, OutcomesOfState],
    bits: np.ndarray,
) -> None:
    """Raise StateSpaceMismatch if the rules of `env` disagree with the stored outcomes of some states.

    Args:
        states: (S, W), packed. bits: which ones are terminal.
        outcomes: of the states that are compared.
    """
    for i, of_actions in outcomes.items():
        state = tuple(unpack_states(layout, states[i : i + 1])[0].tolist())
        try:
            ended = bool(env.is_terminal(state))
            expected = [_outcomes_by_rules(env, state, a, ended) for a in range(env.num_actions)]
        except Exception as error:
            raise StateSpaceMismatch(
                f"{folder}: was built with other rules: those of this {env.name} fail in state {state}: {error!r}; "
                f"build in another folder"
            ) from error
        for action, (successors, probabilities) in enumerate(of_actions):
            next_states = [tuple(row) for row in unpack_states(layout, states[successors]).tolist()]
            wanted, p = expected[action]
            agree = next_states == wanted and np.abs(probabilities - p).max() <= SUM_TOLERANCE
            if not agree or ended != bool(bits[i // 8] >> (i % 8) & 1):
                raise StateSpaceMismatch(
                    f"{folder}: was built with other rules: from state {state} action {env.actions[action]!r} leads to "
                    f"{_text_of_outcomes(next_states, probabilities)}, by the rules of this {env.name} "
                    f"to {_text_of_outcomes(wanted, p)}; "
                    f"build in another folder, and raise `version` when you change rules"
                )


def _outcomes_by_rules(env: Environment, state: tuple, action: int, ended: bool) -> tuple[list[tuple], np.ndarray]:
    """(next states, probabilities) of the possible outcomes of an action, by the rules."""
    if ended:
        return [state], np.ones(1)
    probabilities = [float(env.probability(state, action, outcome)) for outcome in range(env.outcomes)]
    possible = [outcome for outcome, probability in enumerate(probabilities) if probability > 0]
    return [env.next_state(state, action, outcome) for outcome in possible], np.array(probabilities)[possible]


def _text_of_outcomes(states: list[tuple], probabilities: np.ndarray) -> str:
    return ", ".join(f"{state} ({p:.6g})" for state, p in zip(states, probabilities.tolist(), strict=True))
