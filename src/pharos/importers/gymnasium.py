"""MDPs from Gymnasium's `P` tables and from matrices."""

import copy
import itertools
from collections import Counter
from typing import Any

import numpy as np

from pharos.errors import FileFormatError
from pharos.importers.folder import Outcomes
from pharos.mdp import TabularMDP

SAMPLED_STEPS = 10_000
"""Steps of the environment that are held against its table; an episode of them ends after SAMPLED_EPISODE."""

SAMPLED_EPISODE = 200


NATIVE = {"Blackjack": "blackjack", "CliffWalking": "cliff_walking", "FrozenLake": "frozen_lake", "Taxi": "taxi"}
"""Environments of Gymnasium -> the classes of pharos with the same rules."""

LEAST_PROBABILITY = 1e-6
"""A table is refused where outcomes as rare as those sampled were less likely than this, all comparisons together."""


def gymnasium(env: object, *, gamma: float = 0.99, horizon: int | None = None, check: bool = True) -> TabularMDP:
    """Return the MDP of an environment with a `P` table, such as FrozenLake, Taxi or CliffWalking.

    Args:
        env: a Gymnasium environment, wrapped or not, or a table P[s][a] = [(probability, next state, reward,
            terminated), ...]. The start distribution is `initial_state_distrib` where there is one, else state 0.
        gamma, horizon: of the MDP; Gymnasium's time limit is not taken over.
        check: whether an environment is stepped SAMPLED_STEPS times, as a copy where it can be copied, and compared
            with its table: some have chance that is not in it, such as Taxi with `fickle_passenger=True`. Outcomes that
            the table does not hold are refused, and frequencies that it makes too unlikely (chi-square tests).
    Returns:
        A table of next states where every action has one outcome, else a general MDP. A transition that terminates ends
        the episode after its reward, wherever it leads.
    Raises:
        FileFormatError: there is no table, states or actions are missing, probabilities do not sum to 1, or the
        environment does what its table does not say.
    """
    inner, rows = _rows(env)
    states, actions = len(rows), len(rows[0])
    next_states = np.full((states, actions), -1, np.int64)
    rewards = np.zeros((states, actions))
    single = True
    entries: list[tuple[int, int, float]] = []
    for s in range(states):
        for a in range(actions):
            outcomes = _checked(env, s, a, rows[s][a], states)
            single &= len(outcomes) == 1
            for (following, ended), (p, paid) in outcomes.items():
                rewards[s, a] += paid
                if not ended:
                    entries.append((s * actions + a, following, p))
                    next_states[s, a] = following
    start = _start(env, inner, states)
    if check and hasattr(inner, "step") and hasattr(inner, "reset"):
        _compare_with_steps(env, inner, rows)
    initial: Any = int(start.argmax()) if start.max() == 1 else start / start.sum()
    if single:
        return TabularMDP.from_arrays(next_states, rewards, gamma=gamma, initial=initial, horizon=horizon)
    from scipy import sparse

    row, column, data = (np.array(part) for part in zip(*entries, strict=True)) if entries else ([], [], [])
    matrix = sparse.csr_matrix((data, (row, column)), shape=(states * actions, states))
    return TabularMDP.from_matrices(matrix, rewards, gamma=gamma, initial=initial, horizon=horizon)


def gymnasium_outcomes(env: object) -> Outcomes | None:
    """Return the outcomes of the same table with the reward of each, for `importers.save(..., outcomes=)`.

    None where no action pays different rewards, so that the MDP says it all.

    Raises:
        FileFormatError: as `gymnasium`.
    """
    _, rows = _rows(env)
    entries = [
        [(-1 if ended else int(following), p, float(reward)) for p, following, reward, ended in row if p > 0]
        for state in rows
        for row in state
    ]
    if all(len({reward for _, _, reward in row}) == 1 for row in entries):
        return None
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in entries])])
    next_states, probabilities, rewards = (
        np.array(each) for each in zip(*itertools.chain.from_iterable(entries), strict=True)
    )
    return Outcomes(offsets, next_states.astype(np.int64), probabilities, rewards)


def _rows(env: Any) -> tuple[Any, list[list[list]]]:
    """(the environment without wrappers, rows[s][a] of its table); FileFormatError where it has none."""
    inner = getattr(env, "unwrapped", env)
    table = getattr(inner, "P", inner)
    try:
        states, actions = len(table), len(table[0])
        return inner, [[list(table[s][a]) for a in range(actions)] for s in range(states)]
    except (TypeError, KeyError, IndexError) as error:
        if inner is env or not hasattr(inner, "P"):
            raise FileFormatError(f"{env}: has no table P[s][a] of its transitions{_native(inner)}") from None
        raise FileFormatError(
            f"{env}: has no table P[s][a] with states 0, 1, ... and the same actions everywhere "
            f"({type(error).__name__}: {error})"
        ) from None


def _checked(env: object, s: int, a: int, outcomes: list, states: int) -> dict[tuple[int, bool], tuple[float, float]]:
    """{(next state, terminated): (probability, probability x reward)}, equal outcomes added up."""
    merged: dict[tuple[int, bool], tuple[float, float]] = {}
    total = 0.0
    for outcome in outcomes:
        p, following, reward, ended = outcome
        if not 0 <= following < states or not np.isfinite(reward) or not 0 <= p <= 1:
            raise FileFormatError(
                f"{env}: P[{s}][{a}] has {outcome}; expected a probability, a state below {states}, a finite reward"
            )
        total += p
        if p > 0:
            key = (-1, True) if ended else (int(following), False)
            before = merged.get(key, (0.0, 0.0))
            merged[key] = (before[0] + p, before[1] + p * reward)
    if abs(total - 1) > 1e-6:
        raise FileFormatError(f"{env}: the probabilities of P[{s}][{a}] sum to {total}; expected 1")
    return merged


def _start(env: object, inner: object, states: int) -> np.ndarray:
    """(S,) the start distribution: `initial_state_distrib`, or state 0."""
    try:
        start = np.asarray(getattr(inner, "initial_state_distrib", np.eye(states)[0]), np.float64)
    except (TypeError, ValueError) as error:
        raise FileFormatError(f"{env}: initial_state_distrib is no distribution: {error}") from None
    if start.shape != (states,) or not np.isfinite(start).all() or (start < 0).any() or abs(start.sum() - 1) > 1e-6:
        raise FileFormatError(f"{env}: initial_state_distrib is no distribution over the {states} states of P")
    return start


def _compare_with_steps(env: object, inner: object, rows: list[list[list]]) -> None:
    """FileFormatError where the environment, stepped, does what its table does not say.

    Each state's actions are tried in turn, so that few steps try many of them.
    """
    stepped = _copy(inner)
    likely = [[_likely(options) for options in row] for row in rows]
    met: dict[tuple[int, int], Counter] = {}
    tries = np.zeros((len(rows), len(rows[0])), np.int64)
    rng = np.random.default_rng(0)
    state = None
    for step in range(SAMPLED_STEPS):
        if state is None or step % SAMPLED_EPISODE == 0:
            state = _state_number(stepped.reset(seed=0 if step == 0 else None)[0], len(rows))
        if state is None:  # what is observed is no number of a state: nothing to compare
            return
        least = np.flatnonzero(tries[state] == tries[state].min())
        action = int(least[rng.integers(len(least))])
        tries[state, action] += 1
        observation, reward, ended, _, _ = stepped.step(action)
        following = _state_number(observation, len(rows))
        outcome = (following, float(reward), bool(ended))
        if outcome not in likely[state][action]:
            raise FileFormatError(
                f"{env}: in state {state}, action {action} led to state {following} with reward {reward}, which its "
                f"table P[{state}][{action}] does not hold; its chance is not in the table (as that of Taxi with "
                f"fickle_passenger=True), so the table is another MDP: switch that chance off{_native(inner)}"
            )
        met.setdefault((state, action), Counter())[outcome] += 1
        state = None if ended else following
    _compare_frequencies(env, inner, likely, met)


def _likely(options: list) -> dict[tuple[int, float, bool], float]:
    """Outcome (next state, reward, terminated) -> probability, of the possible ones."""
    likely: dict[tuple[int, float, bool], float] = {}
    for p, following, reward, ended in options:
        if p > 0:
            outcome = (int(following), float(reward), bool(ended))
            likely[outcome] = likely.get(outcome, 0.0) + float(p)
    return likely


def _compare_frequencies(env: object, inner: object, likely: list, met: dict[tuple[int, int], Counter]) -> None:
    """FileFormatError where the sampled frequencies of a state and action, or of all with the same probabilities in the
    table, are too unlikely.

    Pearson's chi-square test where each outcome is expected five times; the first test that fails is named.
    """
    from scipy.special import chdtrc

    groups: dict[tuple[float, ...], np.ndarray] = {}
    named: dict[tuple[float, ...], tuple[int, int]] = {}
    tests: list[tuple[int, int, tuple[float, ...], np.ndarray]] = []
    for (state, action), counts in met.items():
        expected = likely[state][action]
        if len(expected) == 1:
            continue
        shares = tuple(expected.values())
        sampled = np.array([counts[outcome] for outcome in expected])
        tests.append((state, action, shares, sampled))
        groups[shares] = groups.get(shares, 0) + sampled
        named.setdefault(shares, (state, action))
    tests += [(*named[shares], shares, sampled) for shares, sampled in groups.items()]
    tests = [each for each in tests if each[3].sum() * min(each[2]) >= 5]
    for state, action, shares, sampled in tests:
        expected = sampled.sum() * np.array(shares) / sum(shares)
        chance = float(chdtrc(len(shares) - 1, ((sampled - expected) ** 2 / expected).sum()))
        if chance < LEAST_PROBABILITY / len(tests):
            raise FileFormatError(
                f"{env}: in state {state}, action {action} (and those with the same probabilities) had its outcomes "
                f"{', '.join(map(str, sampled))} times in {sampled.sum()} steps, but its table P[{state}][{action}] "
                f"gives them {', '.join(f'{p:.3g}' for p in shares)}: that is as likely as {chance:.1g}, so the table "
                f"is another MDP{_native(inner)}"
            )


def _native(inner: object) -> str:
    """What pharos has in place of an environment, for the end of a message."""
    name = type(inner).__name__.removesuffix("Env")
    if name not in NATIVE:
        return ""
    option = " fickle=true" if getattr(inner, "fickle_passenger", False) else ""
    return f"; pharos has it as `{NATIVE[name]}{option}`"


def _copy(inner: object) -> Any:
    try:
        return copy.deepcopy(inner)
    except Exception:  # a window, a generator of its own: whatever cannot be copied is stepped itself
        return inner


def _state_number(observation: Any, states: int) -> int | None:
    try:
        number = int(observation)
    except (TypeError, ValueError):
        return None
    return number if 0 <= number < states and number == observation else None


def matrices(
    P: object, R: object, *, gamma: float = 0.99, initial: object = 0, horizon: int | None = None
) -> TabularMDP:
    """Return the MDP of transition probabilities P and rewards R; as `TabularMDP.from_matrices`."""
    return TabularMDP.from_matrices(P, R, gamma=gamma, initial=initial, horizon=horizon)
