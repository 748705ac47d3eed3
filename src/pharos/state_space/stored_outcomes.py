"""The outcomes of a finished state space, as its files hold them, and what a reader checks of them."""

from pathlib import Path
from typing import Any

import numpy as np

from pharos.environments import Environment
from pharos.errors import StateSpaceCorrupted, StateSpaceMismatch
from pharos.rules import Layout, unpack
from pharos.state_space.manifest import AGAIN, CODES, OFFSETS, PALETTE, PROBABILITIES, TERMINAL, successors_name
from pharos.state_space.shards import mapped, parts_of
from pharos.system.outcome_rows import SUM_TOLERANCE, OutcomeCheck, OutcomeRows, OutcomesOfState, WrongOutcomes
from pharos.system.packed_indices import dtype_of, from_stored

_BLOCK_ENTRIES = 1 << 17


def stored_outcomes(folder: Path, manifest: dict[str, Any]) -> OutcomeRows:
    """The arrays of a folder, memory maps; nothing is read yet."""
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
        name: mapped(parts_of(folder, manifest, name), dtype_of(arrays[name]["dtype"])).reshape(shape)
        for name, shape in shapes.items()
        if name in arrays
    }
    others = {name.removesuffix(".bin"): array for name, array in maps.items() if name != successors}
    return OutcomeRows(from_stored(maps[successors]), **others)


def check_outcomes(folder: Path, manifest: dict[str, Any], stored: OutcomeRows, terminal_bits: np.ndarray) -> None:
    """StateSpaceCorrupted where the arrays are not those of a state space.

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
    return StateSpaceCorrupted(f"{folder / names.get(error.name, f'{error.name}.bin')}: {error}; {AGAIN}")


def outcomes_to_check(
    folder: Path, manifest: dict[str, Any], stored: OutcomeRows, states: np.ndarray
) -> dict[int, OutcomesOfState]:
    """The outcomes of some states, of arrays that nobody has looked at yet; StateSpaceCorrupted where they are none."""
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
    """StateSpaceMismatch where the rules of `env` disagree with the stored outcomes of some states.

    Args:
        states: (S, W), packed. bits: which ones are terminal.
        outcomes: those of the states that are looked at.
    """
    for i, of_actions in outcomes.items():
        state = tuple(unpack(layout, states[i : i + 1])[0].tolist())
        try:
            ended = bool(env.is_terminal(state))
            expected = [_outcomes_of(env, state, a, ended) for a in range(env.num_actions)]
        except Exception as error:
            raise StateSpaceMismatch(
                f"{folder}: was built with other rules: those of this {env.name} fail in state {state}: {error!r}; "
                f"build in another folder"
            ) from error
        for action, (successors, probabilities) in enumerate(of_actions):
            following = [tuple(row) for row in unpack(layout, states[successors]).tolist()]
            wanted, likely = expected[action]
            agree = following == wanted and np.abs(probabilities - likely).max() <= SUM_TOLERANCE
            if not agree or ended != bool(bits[i // 8] >> (i % 8) & 1):
                raise StateSpaceMismatch(
                    f"{folder}: was built with other rules: from state {state} action {env.actions[action]!r} leads to "
                    f"{_text(following, probabilities)}, by the rules of this {env.name} to {_text(wanted, likely)}; "
                    f"build in another folder, and raise `version` when you change rules"
                )


def _outcomes_of(env: Environment, state: tuple, action: int, ended: bool) -> tuple[list[tuple], np.ndarray]:
    """Next states and their probabilities, possible outcomes alone."""
    if ended:
        return [state], np.ones(1)
    likely = [float(env.probability(state, action, outcome)) for outcome in range(env.outcomes)]
    possible = [outcome for outcome, probability in enumerate(likely) if probability > 0]
    return [env.next_state(state, action, outcome) for outcome in possible], np.array(likely)[possible]


def _text(states: list[tuple], probabilities: np.ndarray) -> str:
    return ", ".join(f"{state} ({p:.6g})" for state, p in zip(states, probabilities.tolist(), strict=True))
