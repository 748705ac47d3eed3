"""What the files of a state space must hold: states and successors in their ranges, and what the rules say."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import StateSpaceCorrupted, StateSpaceMismatch
from pharos.rules import Layout, unpack
from pharos.state_space.manifest import AGAIN, STATES, SUCCESSORS, TERMINAL
from pharos.system.packed_indices import Indices

_BLOCK_ENTRIES = 1 << 17


def check_environment(folder: Path, env: Environment, manifest: dict[str, Any]) -> None:
    """StateSpaceMismatch where the actions or the components of a state are not those of the environment."""
    theirs = {"actions": list(env.actions), "names": list(env.components.names), "outcomes": int(env.outcomes)}
    stored = {
        "actions": manifest["actions"],
        "names": manifest["layout"]["names"],
        "outcomes": manifest.get("outcomes", 1),
    }
    sizes = env.components.low.tolist(), env.components.size.tolist()
    if theirs != stored or sizes != (manifest["layout"]["low"], manifest["layout"]["size"]):
        raise StateSpaceMismatch(
            f"{folder}: holds {manifest['environment']} with the actions {stored['actions']} of at most "
            f"{stored['outcomes']} outcomes and states of {stored['names']}, which are not those of {env}; choose "
            f"another folder"
        )


def states_to_check(num_states: int) -> np.ndarray:
    """Numbers of 64 states, spread over all of them, in which rules are compared with what is stored."""
    return np.unique(np.linspace(0, num_states - 1, 64).astype(np.int64))


def check_rules(
    folder: Path, env: Environment, layout: Layout, states: np.ndarray, successors: Indices, bits: np.ndarray
) -> None:
    """StateSpaceMismatch where the rules of `env` disagree with the stored transitions of 64 states."""
    chosen = states_to_check(len(successors))
    _check_range(folder / SUCCESSORS, successors[chosen], len(states), chosen)
    following = unpack(layout, states[successors[chosen].ravel()]).tolist()
    check_states(folder / STATES, layout, states[chosen])
    check_states(folder / STATES, layout, states[successors[chosen].ravel()])
    for n, (i, row) in enumerate(zip(chosen.tolist(), unpack(layout, states[chosen]).tolist(), strict=True)):
        state = tuple(row)
        stored = [tuple(row) for row in following[n * env.num_actions : (n + 1) * env.num_actions]]
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
    """StateSpaceCorrupted where an index is no state, or a terminal state does not lead to itself.

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
                f"{path}: terminal state {start + int(ended[leaving.argmax()])} leads to another state; {AGAIN}"
            )
    if terminal != num_terminal:
        raise StateSpaceCorrupted(
            f"{path.with_name(TERMINAL)}: marks {terminal} terminal states; expected {num_terminal}; {AGAIN}"
        )


def _check_range(path: Path, block: np.ndarray, num_states: int, numbers: Sequence[int] | np.ndarray) -> None:
    """StateSpaceCorrupted where an index is no state; the rows are those of the states with these numbers."""
    if block.min() < 0 or block.max() >= num_states:
        row, action = map(int, np.argwhere((block < 0) | (block >= num_states))[0])
        raise StateSpaceCorrupted(
            f"{path}: action {action} leads from state {numbers[row]} to state {block[row, action]}; "
            f"expected 0 to {num_states - 1}; {AGAIN}"
        )


def check_states(path: Path, layout: Layout, states: np.ndarray) -> None:
    """StateSpaceCorrupted where a component of a packed state is out of its range."""
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
                    f"expected less than {int(layout.size[i])}; {AGAIN}"
                )
