"""MDPs for other programs: BRIDGE's npz, Gymnasium's `P` table, Storm's explicit DRN format.

DRN: https://www.stormchecker.org/documentation/background/drn.html. The form of the BRIDGE dataset: transitions and
rewards, row 0 the start, -1 the end.
"""

import io
import os
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP, paid_outcomes, require_mdp
from pharos.system import distinct_rows, mdp_files, storage

__all__ = ["bridge", "drn", "gym_p"]


@require_mdp
def drn(mdp: TabularMDP, path: str | os.PathLike) -> Path:
    """Write an MDP for Storm, with a reward model "reward" on actions and labels "init" and "terminal".

    A horizon is not written: the file is of the MDP without one. Discounting is written out: with gamma < 1 every step
    ends the episode with probability 1 - gamma, so that Storm's expected total reward `Rmax=? [F "terminal"]` is the
    discounted value. Several start states become choices of one more, first state.

    Raises:
        ParameterError: sticky actions (see `gym_p`), or the name does not end in .drn.
    Cost: a line for each transition, so for small MDPs.
    """
    path = Path(path)
    if path.suffix != ".drn":
        raise ParameterError(f"{path}: expected a name that ends in .drn")
    table = gym_p(mdp)
    end = mdp.num_states
    table.setdefault(end, {a: [(1.0, end, 0.0, True)] for a in range(mdp.num_actions)})
    absorbing = {s for s in range(end) if mdp.terminal[s]} | {end}
    file = io.StringIO()
    several = len(mdp.start_states) > 1
    file.write("@type: MDP\n@parameters\n\n@reward_models\nreward\n")
    choices = sum(map(len, table.values())) + several
    file.write(f"@nr_states\n{end + 1 + several}\n@nr_choices\n{choices}\n@model\n")
    if several:
        file.write("state 0 [0] init\n\taction start [0]\n")
        for s, p in zip(mdp.start_states, mdp.start_probabilities, strict=True):
            file.write(f"\t\t{int(s) + 1} : {float(p)!r}\n")
    for s in range(end + 1):
        init = " init" if not several and s == int(mdp.start_states[0]) else ""
        file.write(f"state {s + several} [0]{init}{' terminal' if s in absorbing else ''}\n")
        for a in table[s]:
            _choice(file, table[s][a], a, s in absorbing, mdp.gamma, s, end, several)
    storage.replace_file(path, file.getvalue(), follow=True)
    return path


def _choice(
    file: TextIO, outcomes: list, action: int, absorbing: bool, gamma: float, s: int, end: int, shift: int
) -> None:
    """Write one action: its expected reward, then next states in increasing order with their probabilities."""
    if absorbing:
        file.write(f"\taction {action} [0]\n\t\t{s + shift} : 1\n")
        return
    reward = float(np.sum([p * r for p, _, r, _ in outcomes]))
    probabilities: dict[int, float] = {}
    for p, t, _, ended in outcomes:
        weight = p if ended else gamma * p
        probabilities[t] = probabilities.get(t, 0.0) + weight
        if weight < p:
            probabilities[end] = probabilities.get(end, 0.0) + p - weight
    file.write(f"\taction {action} [{reward!r}]\n")
    for t in sorted(probabilities):
        if probabilities[t] > 0:
            file.write(f"\t\t{t + shift} : {probabilities[t]!r}\n")


# Gymnasium ------------------------------------------------------------------------------------------------------------


Outcome = tuple[float, int, float, bool]


@require_mdp
def gym_p(mdp: TabularMDP) -> dict[int, dict[int, list[Outcome]]]:
    """Return P[s][a] = [(probability, next state, reward, terminated), ...], as Gymnasium's toy texts have it.

    Discount and horizon are not part of it.

    A state has the actions that are available there. The implicit end becomes one more state S, if there is one.
    Random actions are written out as outcomes. Each outcome has its own reward if the MDP is of an environment and has
    its rewards, otherwise the expected reward of what is executed.

    Raises:
        ParameterError: under sticky actions the state is a pair, which this table has no room for.
    Cost: Python objects for each transition, so for small MDPs.
    """
    if mdp.is_sticky:
        raise ParameterError(
            "P tables have one row a state; under sticky actions the next state depends on the previous action"
        )
    end, num_actions, terminal = mdp.num_states, mdp.num_actions, np.asarray(mdp.terminal)
    chosen, _, uniform = mdp.chance.triple
    rows: list[list[Outcome]] = [[] for _ in range(mdp.num_states * num_actions)]
    for row, t, r, p in zip(*(column.tolist() for column in paid_outcomes(mdp)), strict=True):
        rows[row].append((p, t, r, t == end or bool(terminal[t])))
    table: dict[int, dict[int, list[Outcome]]] = {}
    for s in range(mdp.num_states):
        if terminal[s]:
            table[s] = {a: [(1.0, s, 0.0, True)] for a in range(num_actions)}
            continue
        executed = rows[s * num_actions : (s + 1) * num_actions]
        actions = range(num_actions) if mdp.available is None else np.flatnonzero(mdp.available[s]).tolist()
        shares = [(uniform / len(actions) * p, t, r, e) for a in actions for p, t, r, e in executed[a]]
        mixed = shares if uniform else []
        table[s] = {
            a: ([(chosen * p, t, r, e) for p, t, r, e in executed[a]] if chosen else []) + mixed for a in actions
        }
    if mdp.has_ends:
        table[end] = {a: [(1.0, end, 0.0, True)] for a in range(num_actions)}
    return table


# Bridge ---------------------------------------------------------------------------------------------------------------


@require_mdp
def bridge(mdp: TabularMDP, path: str | os.PathLike) -> Path:
    """Write an MDP as BRIDGE does: npz with `transitions` int64 (S, A) and `rewards` float32 (S, A).

    Discount and horizon are not part of it.

    States keep their numbers, unless the start is not 0: it then changes places with 0. Transitions into terminal
    states become -1. If all actions of a terminal state end the episode in the table itself, as in BRIDGE's files, it
    stays a state with -1 in each column. Images that the MDP's folder has recorded become `screens` (D, H, W, 3) and
    `screen_mapping` (S,).

    Raises:
        ParameterError: the MDP has chance, several start states, or actions that are not available in some states,
            which the form cannot say, or the name does not end in .npz.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise ParameterError(f"{path}: expected a name that ends in .npz")
    if mdp.available is not None:
        raise ParameterError(
            f"{path}: BRIDGE's files have a next state for each action in each state, and some of {mdp} are not "
            f"available in some states; expected an MDP in which all are (drn and gym write these)"
        )
    if not mdp.is_deterministic or len(mdp.start_states) != 1:
        raise ParameterError(f"{mdp}: BRIDGE's files hold deterministic MDPs with one start state; expected such a one")
    table = np.array(mdp.dynamics.deterministic_table(), np.int64)
    inside = table >= 0
    ends = np.asarray(mdp.terminal) & inside.any(axis=1)
    table[inside & ends[table]] = -1
    order = np.arange(len(table))
    start = int(mdp.start_states[0])
    order[[0, start]] = order[[start, 0]]
    table = np.where(table[order] >= 0, order[table[order]], -1)
    with np.errstate(over="ignore"):
        rewards = mdp.rewards[order].astype(np.float32)
    if not np.isfinite(rewards).all():
        raise ParameterError(f"{path}: BRIDGE's rewards are float32, and some of {mdp} are larger than 3.4e38")
    arrays: dict[str, Any] = {"transitions": np.asfortranarray(table), "rewards": rewards, **_screens(mdp, order)}
    with storage.replacing(path, follow=True) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    return path


def _screens(mdp: TabularMDP, order: np.ndarray) -> dict[str, np.ndarray]:
    """Distinct images of a folder and the image of each state, or nothing if there are none."""
    if mdp.folder is None or not mdp_files.is_folder(mdp.folder):
        return {}
    manifest = mdp_files.read_mdp_manifest(mdp.folder)
    if manifest.get(mdp_files.SHOWN_NAME) != "image":
        return {}
    shown = mdp_files.read_observations(mdp.folder, manifest)
    assert shown is not None
    rows = shown if isinstance(shown, distinct_rows.DistinctRows) else distinct_rows.collect_rows(shown)
    return {
        "screens": rows.distinct(np.arange(rows.num_distinct)),
        "screen_mapping": rows.index[order].astype(np.int64),
    }
