"""PRISM and JANI models and Storm's explicit DRN files, built by Storm: https://www.stormchecker.org

Source: Hensel, Junges, Katoen, Quatmann and Volk (2022), "The probabilistic model checker Storm"; Kwiatkowska, Norman
and Parker (2011), "PRISM 4.0".
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import FileFormatError, MissingExtra, ParameterError, UnknownName
from pharos.importers.folder import Outcomes
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
            every action there; the MDP pays rewards of transitions on average.
        target: a label whose states end the episode; without a reward structure, reaching one pays 1, so that the
            optimal value at gamma 1 is the maximal probability of reaching it.
        gamma, horizon: of the MDP.
    Raises:
        MissingExtra: stormpy is not installed.
        ParameterError: no such file; UnknownName: no such reward structure or label.
        FileFormatError: Storm cannot read it, constants are missing, or it is of another kind (continuous time, partial
            observability, parameters).
    """
    return storm_recording(path, constants=constants, reward=reward, target=target, gamma=gamma, horizon=horizon)[0]


def storm_recording(
    path: str | os.PathLike,
    *,
    constants: str = "",
    reward: str | None = None,
    target: str | None = None,
    gamma: float = 1.0,
    horizon: int | None = None,
) -> tuple[TabularMDP, Outcomes | None]:
    """Return the MDP of `storm`, and its outcomes with the reward of each, for `importers.save(..., outcomes=)`.

    The outcomes are None where no choice pays different rewards, so that the MDP says it all.

    Raises:
        As `storm`.
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
    outcomes = _outcomes(model, ended, None if reward is None else model.reward_models[reward])
    return _mdp(model, outcomes, gamma, horizon), outcomes if _differ(outcomes) else None


def _outcomes(model: Any, ended: np.ndarray, paid: Any) -> Outcomes:
    """What every state and action may lead to and what that pays; of states that end the episode, its end."""
    matrix, states = model.transition_matrix, model.nr_states
    first = [matrix.get_row_group_start(s) for s in range(states)]
    last = [matrix.get_row_group_end(s) for s in range(states)]
    actions = max(stop - start for start, stop in zip(first, last, strict=True))
    offsets: list[int] = [0]
    successors: list[int] = []
    likely: list[float] = []
    rewards: list[float] = []
    for s in range(states):
        for a in range(actions):
            choice = first[s] + a if first[s] + a < last[s] else first[s]
            row = [] if ended[s] else [(int(entry.column), float(entry.value)) for entry in matrix.get_row(choice)]
            row = row or [(-1, 1.0)]
            successors += [following for following, _ in row]
            likely += [p for _, p in row]
            rewards += [0.0] if ended[s] else _rewards(paid, s, choice, successors[offsets[-1] :], ended)
            offsets.append(len(successors))
    return Outcomes(np.array(offsets), np.array(successors, np.int64), np.array(likely), np.array(rewards, np.float64))


def _rewards(paid: Any, state: int, choice: int, successors: list[int], ended: np.ndarray) -> list[float]:
    """What a choice pays with each of its successors: for the state, for the choice, and for the transition."""
    if paid is None:
        return [float(following >= 0 and ended[following]) for following in successors]
    always = 0.0
    if paid.has_state_rewards:
        always += float(paid.get_state_reward(state))
    if paid.has_state_action_rewards:
        always += float(paid.get_state_action_reward(choice))
    if not paid.has_transition_rewards:
        return [always] * len(successors)
    of = {entry.column: float(entry.value) for entry in paid.transition_rewards.get_row(choice)}
    return [always + of.get(following, 0.0) for following in successors]


def _differ(outcomes: Outcomes) -> bool:
    """Whether some state and action pays different rewards."""
    begin = outcomes.offsets[:-1]
    return bool((np.minimum.reduceat(outcomes.rewards, begin) < np.maximum.reduceat(outcomes.rewards, begin)).any())


def _mdp(model: Any, outcomes: Outcomes, gamma: float, horizon: int | None) -> TabularMDP:
    from scipy import sparse

    begin, counts, states = outcomes.offsets[:-1], np.diff(outcomes.offsets), model.nr_states
    rows = np.repeat(np.arange(len(counts)), counts)
    goes_on = outcomes.next_states >= 0
    table = sparse.csr_matrix(
        (outcomes.probabilities[goes_on], (rows[goes_on], outcomes.next_states[goes_on])), shape=(len(counts), states)
    )
    means = np.add.reduceat(outcomes.probabilities * outcomes.rewards, begin)
    alike = np.minimum.reduceat(outcomes.rewards, begin) == np.maximum.reduceat(outcomes.rewards, begin)
    rewards = np.where(alike, outcomes.rewards[begin], means).reshape(states, -1)
    starts = list(model.initial_states)
    initial = starts[0] if len(starts) == 1 else starts
    return TabularMDP.from_matrices(table, rewards, gamma=gamma, initial=initial, horizon=horizon)


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
