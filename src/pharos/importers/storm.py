"""PRISM and JANI models and Storm's explicit DRN files, built by Storm: https://www.stormchecker.org

Source: Hensel, Junges, Katoen, Quatmann and Volk (2022), "The probabilistic model checker Storm"; Kwiatkowska, Norman
and Parker (2011), "PRISM 4.0".
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import FileFormatError, MissingExtra, ParameterError, UnknownName
from pharos.mdp import TabularMDP

SUFFIXES = (".prism", ".nm", ".pm", ".sm", ".jani", ".drn")


def storm(
    path: str | os.PathLike,
    *,
    constants: str = "",
    reward: str | None = None,
    target: str | None = None,
    gamma: float = 1.0,
    horizon: int | None = None,
) -> TabularMDP:
    """Return the MDP of a model of discrete time: MDPs, and Markov chains, which have one action.

    A state with fewer choices than others does its first one by the actions beyond them: the best and the worst value
    stay what they are, that of the uniform policy counts the first choice more often. State s of the MDP is state s of
    Storm.

    Args:
        path: a model in PRISM's language (.prism, .nm, .pm), in JANI (.jani), or an explicit one (.drn).
        constants: values of its undefined constants, such as "N=3,K=2".
        reward: name of a reward structure; None: the only one, where there is no target. State rewards are paid with
            every action there.
        target: a label whose states end the episode; without a reward structure, reaching one pays 1, so that the
            optimal value at gamma 1 is the maximal probability of reaching it.
        gamma, horizon: of the MDP.
    Raises:
        MissingExtra: stormpy is not installed.
        ParameterError: no such file; UnknownName: no such reward structure or label.
        FileFormatError: Storm cannot read it, constants are missing, or it is of another kind (continuous time, partial
            observability, parameters).
    """
    model = _model(Path(path), constants)
    labels = sorted(model.labeling.get_labels())
    if target is not None and target not in labels:
        raise UnknownName(f"label of {path}", target, labels)
    names = list(model.reward_models)
    if reward is None and target is None and len(names) == 1:
        reward = names[0]
    if reward is not None and reward not in names:
        raise UnknownName(f"reward structure of {path}", reward, names)
    if reward is None and target is None:
        raise ParameterError(
            f"{path}: nothing says what is paid; give a reward structure ({', '.join(names) or 'it has none'}) or a "
            f"target label ({', '.join(labels)})"
        )
    ended = np.zeros(model.nr_states, np.bool_)
    if target is not None:
        ended[list(model.labeling.get_states(target))] = True
    return _mdp(model, ended, None if reward is None else model.reward_models[reward], gamma, horizon)


def _mdp(model: Any, ended: np.ndarray, paid: Any, gamma: float, horizon: int | None) -> TabularMDP:
    from scipy import sparse

    matrix, states = model.transition_matrix, model.nr_states
    first = [matrix.get_row_group_start(s) for s in range(states)]
    last = [matrix.get_row_group_end(s) for s in range(states)]
    actions = max(stop - start for start, stop in zip(first, last, strict=True))
    rewards = np.zeros((states, actions))
    rows: list[int] = []
    columns: list[int] = []
    likely: list[float] = []
    for s in range(states):
        if ended[s]:
            continue
        for a in range(actions):
            choice = first[s] + a if first[s] + a < last[s] else first[s]
            reached = 0.0
            for entry in matrix.get_row(choice):
                rows.append(s * actions + a)
                columns.append(entry.column)
                likely.append(float(entry.value))
                reached += likely[-1] * ended[entry.column]
            rewards[s, a] = reached if paid is None else _reward(paid, s, choice, matrix)
    table = sparse.csr_matrix((likely, (rows, columns)), shape=(states * actions, states))
    starts = list(model.initial_states)
    initial = starts[0] if len(starts) == 1 else starts
    return TabularMDP.from_matrices(table, rewards, gamma=gamma, initial=initial, horizon=horizon)


def _reward(paid: Any, state: int, choice: int, matrix: Any) -> float:
    """What a choice pays on average: for the state, for the choice, and for its transitions."""
    reward = 0.0
    if paid.has_state_rewards:
        reward += float(paid.get_state_reward(state))
    if paid.has_state_action_rewards:
        reward += float(paid.get_state_action_reward(choice))
    if paid.has_transition_rewards:
        of = {entry.column: float(entry.value) for entry in paid.transition_rewards.get_row(choice)}
        reward += sum(float(entry.value) * of.get(entry.column, 0.0) for entry in matrix.get_row(choice))
    return reward


def _model(path: Path, constants: str) -> Any:
    try:
        import stormpy
    except ImportError:
        raise MissingExtra("importing PRISM, JANI and DRN models", "stormpy", "storm") from None
    if path.suffix not in SUFFIXES:
        raise ParameterError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise ParameterError(f"{path}: no such file")
    try:
        if path.suffix == ".drn":
            model = stormpy.build_model_from_drn(str(path))
        else:
            jani = path.suffix == ".jani"
            program = stormpy.parse_jani_model(str(path))[0] if jani else stormpy.parse_prism_program(str(path))
            if constants:
                program = stormpy.instantiate_constants(program, constants)[0]
            model = stormpy.build_model(program)
    except Exception as error:  # of Storm, which has many, and of the bindings
        raise FileFormatError(f"{path}: Storm cannot build it: {' '.join(str(error).split())}") from None
    kind = str(model.model_type).rpartition(".")[2]
    if kind not in ("DTMC", "MDP"):
        raise FileFormatError(f"{path}: is a model of type {kind}; expected an MDP or a DTMC")
    return model
