"""MDPs from Gymnasium's `P` tables and from matrices, and the real MiniGrid, enumerated by playing it.

Source of MiniGrid: Chevalier-Boisvert et al. (2023), "Minigrid & Miniworld".
"""

import contextlib
import copy
import io
import itertools
import operator
import pickle  # noqa: TID251  (to copy an environment of the caller)
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from types import FunctionType
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

from pharos.errors import FileFormatError, MissingExtra, ParameterError, RuleError
from pharos.importers.files import MINIGRID_STEPS
from pharos.importers.folder import ImportedOutcomes
from pharos.importers.search import Arrival, BreadthFirst, ExpansionsHere
from pharos.importers.wrappers import Layers, as_integer, check_wrappers, first_number, reset, step_parts
from pharos.mdp import Names, Residual, Rewards, TabularMDP, normalized_rows, rounding_of_mean
from pharos.system.wording import capped

SAMPLED_STEPS = 10_000
"""Steps of the environment that are held against its table; an episode of them ends after SAMPLED_EPISODE."""

SAMPLED_EPISODE = 200


NATIVE = {"Blackjack": "blackjack", "CliffWalking": "cliff_walking", "FrozenLake": "frozen_lake", "Taxi": "taxi"}
"""Environments of Gymnasium -> the classes of pharos with the same rules."""

LEAST_PROBABILITY = 1e-6
"""A table is refused where outcomes as rare as those sampled were less likely than this, all comparisons together."""

STARTS = ("initial_state_distrib", "isd")
"""Attributes in which environments say their start distribution, (S,) probabilities: Gymnasium's and old gym's."""

SAMPLED_RESETS = (1_000, 20_000)
"""Resets that are held against the start distribution, 20 for each start state: at least and at most."""

OutcomeRewards: TypeAlias = npt.ArrayLike | Callable[[int, int, int, float], float]


def gymnasium(
    env: object,
    *,
    gamma: float = 0.99,
    horizon: int | None = None,
    check: bool = True,
    initial: npt.ArrayLike | None = None,
    rewards: OutcomeRewards | None = None,
) -> TabularMDP:
    """Return the MDP of an environment with a `P` table, such as FrozenLake, Taxi or CliffWalking.

    Args:
        env: a Gymnasium environment, or a table P[s][a] = [(probability, next state, reward, terminated), ...]. An
            action that the dictionary of a state leaves out, or whose list is empty, is not available there. Wrappers
            must change nothing of the MDP: time limits, recorders and wrappers of observations pass; any other is
            stepped beside the environment below it, in every outcome of the table, and refused if they differ.
        gamma, horizon: of the MDP; Gymnasium's time limit is not taken over.
        check: whether an environment is stepped SAMPLED_STEPS times, as a copy if it can be copied, and compared
            with its table. Some have chance that is not in it, such as Taxi with `fickle_passenger=True`. Outcomes that
            the table does not hold are refused, and frequencies that it makes too unlikely (exact binomial tests).
        initial: a start state, a sequence of equally likely ones (fewer than S), or (S,) probabilities. None: what the
            environment says in `initial_state_distrib` or `isd`, compared with its resets; if it says nothing, the
            state in which all resets start; of a table, state 0.
        rewards: in place of the table's, (S, A) numbers, or a function (state, action, next state, reward of the table)
            -> reward.
    Returns:
        A table of next states if every action has one outcome, else a general MDP. A transition that terminates ends
        the episode after its reward, in whichever state it ends. States have the numbers of the table.
        The probabilities of a row that sum to 1 within 1e-6 are divided by their sum, which error bounds of values
        count (`TabularMDP.residual`).
    Raises:
        FileFormatError: there is no table, states are missing, a state has no action or an action no state, lists of
            actions have different lengths, probabilities do not sum to 1, the environment does what its table does not
            say, or its resets start elsewhere.
        ParameterError: a wrapper changes the MDP, which is named with the way that works; or rewards do not fit.
    """
    inner, rows = _rows(env)
    states = len(rows)
    is_stepped = check and hasattr(inner, "step") and hasattr(inner, "reset")
    sets = np.array([[bool(row) for row in options] for options in rows])
    next_states, means, ends, probabilities, residual = _table(env, _filled(_with_rewards(env, rows, rewards)))
    _check_wrappers(env, rows, SAMPLED_STEPS if check else 0)
    if is_stepped:
        _compare_with_steps(env, inner, rows)
    if initial is None:
        start = _start(env, inner, states, is_stepped)
        initial = int(start.argmax()) if start.max() == 1 else start / start.sum()
    setting: dict[str, Any] = {"gamma": gamma, "initial": initial, "horizon": horizon, "available": sets}
    if probabilities is None:
        mdp = TabularMDP.from_arrays(next_states, means.array, **setting)
    else:
        mdp = TabularMDP.from_matrices(probabilities, means.array, ends=ends, **setting)
    return replace(mdp, residual=residual, reward_table=means, names=_names_of(inner, *means.shape))


TOY_ACTIONS = {
    "FrozenLakeEnv": ("left", "down", "right", "up"),
    "CliffWalkingEnv": ("up", "right", "down", "left"),
    "TaxiEnv": ("south", "north", "east", "west", "pickup", "dropoff"),
    "BlackjackEnv": ("stick", "hit"),
}
"""Names of the actions of Gymnasium's toy text, from its documentation, by class."""
TAXI = ("row", "column", "passenger", "destination")


def _names_of(inner: object, num_states: int, num_actions: int) -> Names | None:
    """Names of the actions and variables of Gymnasium's own toy text; None: another environment, or a table."""
    cls = type(inner)
    actions = TOY_ACTIONS.get(cls.__name__) if cls.__module__.startswith("gymnasium.envs.toy_text") else None
    if actions is None or len(actions) != num_actions:
        return None
    numbers = np.arange(num_states)
    width = getattr(inner, "ncol", None) or (getattr(inner, "shape", None) or (0, 0))[1]
    if cls.__name__ == "TaxiEnv" and num_states == 500:
        variables = dict(zip(TAXI, np.unravel_index(numbers, (5, 5, 5, 4)), strict=True))
    elif width and num_states % width == 0:
        variables = {"row": numbers // width, "column": numbers % width}
    else:
        variables = {}
    return Names(variables=variables, actions=actions)


def gymnasium_outcomes(env: object, *, rewards: OutcomeRewards | None = None) -> ImportedOutcomes | None:
    """Return the outcomes of the same table with the reward of each, for `importers.save(..., outcomes=)`.

    None if no action pays different rewards: the MDP then says it all.

    Args:
        rewards: as for `gymnasium`.
    Raises:
        FileFormatError, ParameterError: as `gymnasium`.
    """
    _, rows = _rows(env)
    _check_rows(env, rows)
    _check_wrappers(env, rows, 0)
    rows = _filled(_with_rewards(env, rows, rewards))
    entries = [
        [(-1 if ended else int(next_state), p, float(reward)) for p, next_state, reward, ended in row if p > 0]
        for state in rows
        for row in state
    ]
    refuse = partial(_wrong_sum, env, len(rows[0]))
    if all(len({reward for _, _, reward in row}) == 1 for row in entries):
        return None
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in entries])])
    next_states, probabilities, rewards = (
        np.array(each) for each in zip(*itertools.chain.from_iterable(entries), strict=True)
    )
    of = np.repeat(np.arange(len(entries)), np.diff(offsets))
    probabilities, _ = normalized_rows(probabilities, of, len(entries), refuse)
    return ImportedOutcomes(offsets, next_states.astype(np.int64), probabilities, rewards)


def _table(env: object, rows: list[list[list]]) -> tuple[np.ndarray, Rewards, np.ndarray, Any, Residual]:
    """(next states (S, A), -1 for the end; rewards; chance of an end (S, A); (S A, S) sparse probabilities, None
    if each action has one outcome; residual) of the rows of a table."""
    states, actions = len(rows), len(rows[0])
    shape, count = (states, actions), states * actions
    merged = [_checked(env, s, a, rows[s][a], states) for s in range(states) for a in range(actions)]
    of = np.repeat(np.arange(count), [len(outcomes) for outcomes in merged])
    successors = np.array([key[0] for outcomes in merged for key in outcomes], np.int64)
    p, shares, largest = np.array([each for outcomes in merged for each in outcomes.values()]).reshape(-1, 3).T
    p, residuals = normalized_rows(p, of, count, partial(_wrong_sum, env, actions))
    # Rewards of rows that were divided are divided as well
    sums = np.where(residuals > 0, np.bincount(of, [x[0] for each in merged for x in each.values()], count), 1.0)
    most = np.zeros(count)
    np.maximum.at(most, of, largest)
    terms = max(map(len, itertools.chain.from_iterable(rows)))
    is_exact = terms == 1 and bool((p == 1).all())
    rounding = 0.0 if is_exact else rounding_of_mean(2 * terms, float(most.max()))  # of products, sums and quotients
    rewards = Rewards.from_array((np.bincount(of, shares, count) / sums).reshape(shape), rounding)
    residual = Residual.of(residuals, most)
    next_states, ended = np.full(count, -1, np.int64), successors < 0
    next_states[of] = successors
    ends = np.bincount(of[ended], p[ended], count).reshape(shape)
    if len(of) == count:
        return next_states.reshape(shape), rewards, ends, None, residual
    from scipy import sparse

    matrix = sparse.csr_matrix((p[~ended], (of[~ended], successors[~ended])), shape=(count, states))
    return next_states.reshape(shape), rewards, ends, matrix, residual


def _wrong_sum(env: object, actions: int, row: int, total: float) -> FileFormatError:
    s, a = divmod(row, actions)
    return FileFormatError(f"{name_of(env)}: the probabilities of P[{s}][{a}] sum to {total:.9g}; expected 1")


_TERMINAL = "expected one at least: a terminal state has [(1.0, {}, 0.0, True)] for each action"


def name_of(env: object) -> str:
    """A short name of an environment or a table, for messages."""
    return "table" if isinstance(env, Mapping | list | tuple) else capped(env)


def _rows(env: object) -> tuple[Any, list[list[list]]]:
    """(the environment without wrappers, rows[s][a] of its table); FileFormatError if it has none."""
    inner = getattr(env, "unwrapped", env)
    table = getattr(inner, "P", inner)
    if isinstance(table, str | bytes) or not isinstance(table, _Numbered):
        raise FileFormatError(f"{name_of(env)}: has no table P[s][a] of its transitions{_native(inner)}")
    return inner, _listed(name_of(env), _of_json(table))


_NUMBER = re.compile("0|[1-9][0-9]{0,17}")  # written in one way only, so that no two keys are one


def _of_json(table: object) -> Any:
    """The table with numbers in the place of texts among the keys, which JSON has."""
    if not isinstance(table, Mapping) or not all(isinstance(key, str) and _NUMBER.fullmatch(key) for key in table):
        return table
    return {int(key): _of_json(row) for key, row in table.items()}


@runtime_checkable
class _Numbered(Protocol):
    """A list or a dictionary whose keys are numbers."""

    def __len__(self) -> int: ...

    def __getitem__(self, number: int, /) -> object: ...


def _listed(name: str, table: _Numbered) -> list[list[list]]:
    """rows[s][a] of a table, [] for an action that is not available; FileFormatError names the first row that is wrong.

    A dictionary says by its keys which actions a state has; of a list that is shorter than others nobody knows.
    """
    states: list[dict[int, list]] = []
    lengths: dict[int, int] = {}  # of lists, by state
    for s in range(len(table)):
        row = _entry(table, s)
        if not isinstance(row, _Numbered):
            raise FileFormatError(f"{name}: has no P[{s}] with actions; expected states 0 to {len(table) - 1}")
        if not isinstance(row, Mapping):
            lengths[s] = len(row)
        states.append({})
        for a in row if isinstance(row, Mapping) else range(len(row)):
            if isinstance(a, bool) or not isinstance(a, int | np.integer) or a < 0:
                raise FileFormatError(f"{name}: P[{s}] has the action {capped(a)}; expected numbers from 0 on")
            if not isinstance(entry := _entry(row, int(a)), Iterable):
                raise FileFormatError(f"{name}: has no P[{s}][{a}] with outcomes; expected a list of them")
            states[-1][int(a)] = list(entry)
        if not any(states[-1].values()):
            raise FileFormatError(f"{name}: P[{s}] has no actions; {_TERMINAL.format(s)}")
    if not states:
        raise FileFormatError(f"{name}: its table P has no states")
    everywhere = {a for actions in states for a, row in actions.items() if row}
    count = 1 + max(max(actions) for actions in states)
    for s, length in lengths.items():
        if length != count:
            raise FileFormatError(
                f"{name}: P[{s}] is a list of {length} actions, and there are {count}; expected a list of all, or a "
                f"dictionary of those that are available"
            )
    if len(everywhere) < count:
        a = next(a for a in itertools.count() if a not in everywhere)
        raise FileFormatError(f"{name}: has no state with the action {a}; expected actions 0 to {count - 1}")
    return [[actions.get(a, []) for a in range(count)] for actions in states]


def _filled(rows: list[list[list]]) -> list[list[list]]:
    """Rows in which an action that is not available has the outcomes of the first one that is."""
    return [[row or next(filter(None, options)) for row in options] for options in rows]


def _entry(table: _Numbered, number: int) -> object:
    """table[number]; None if there is none."""
    try:
        return table[number]
    except (KeyError, IndexError, TypeError):
        return None


def _checked(
    env: object, s: int, a: int, outcomes: list, states: int
) -> dict[tuple[int, bool], tuple[float, float, float]]:
    """{(next state, terminated): (probability, probability x reward, largest |reward|)}, equal outcomes added up."""
    merged: dict[tuple[int, bool], tuple[float, float, float]] = {}
    for outcome in outcomes:
        try:
            p, next_state, reward, ended = outcome
            next_state, reward = operator.index(next_state), float(reward)
        except (TypeError, ValueError):
            raise FileFormatError(
                f"{name_of(env)}: P[{s}][{a}] has {capped(outcome)}; expected (probability, next state, reward, "
                f"terminated), with the number of a state and a number as reward"
            ) from None
        if not 0 <= next_state < states or not np.isfinite(reward) or not 0 <= p <= 1:
            raise FileFormatError(
                f"{name_of(env)}: P[{s}][{a}] has {capped(outcome)}; expected a probability, a state below {states}, a "
                f"finite reward"
            )
        if p > 0:
            key = (-1, True) if ended else (int(next_state), False)
            before = merged.get(key, (0.0, 0.0, 0.0))
            merged[key] = (before[0] + p, before[1] + p * reward, max(before[2], abs(reward)))
    if not merged:
        raise FileFormatError(f"{name_of(env)}: P[{s}][{a}] has no outcomes; {_TERMINAL.format(s)}")
    return merged


def _check_rows(env: object, rows: list[list[list]]) -> None:
    """FileFormatError if an outcome is none."""
    for s, options in enumerate(rows):
        for a, row in enumerate(options):
            if row:
                _checked(env, s, a, row, len(rows))


def _with_rewards(env: object, rows: list[list[list]], rewards: OutcomeRewards | None) -> list[list[list]]:
    """Rows of a table with other rewards; ParameterError if these are no function and no numbers of its shape."""
    if rewards is None:
        return rows
    table = np.empty(0)
    if not callable(rewards):
        with contextlib.suppress(TypeError, ValueError):
            table = np.asarray(rewards, np.float64)
        if table.shape != (len(rows), len(rows[0])):
            raise ParameterError(
                f"rewards have shape {table.shape}; expected ({len(rows)}, {len(rows[0])}) numbers, or a function "
                f"(state, action, next state, reward) -> reward"
            )
    pays: Callable[..., Any] = rewards if callable(rewards) else lambda s, a, *_: table[s, a]

    def rewarded(s: int, a: int, outcome: tuple) -> tuple:
        p, next_state, reward, ended = outcome
        value = pays(s, a, int(next_state), float(reward))
        number = np.nan
        with contextlib.suppress(TypeError, ValueError):
            number = float(value)
        if not np.isfinite(number):
            raise ParameterError(
                f"rewards: {capped(value)} in state {s}, action {a}, to {next_state}; expected a finite number"
            )
        return p, next_state, number, ended

    _check_rows(env, rows)
    return [
        [[rewarded(s, a, outcome) for outcome in row] for a, row in enumerate(options)]
        for s, options in enumerate(rows)
    ]


def _check_wrappers(env: object, rows: list[list[list]], steps: int) -> None:
    """ParameterError if a wrapper changes an outcome of the table."""
    outcomes = (
        (s, a, int(next_state), float(reward), bool(ended))
        for s, options in enumerate(rows)
        for a, row in enumerate(options)
        for p, next_state, reward, ended in row
        if p > 0
    )
    check_wrappers(env, steps, outcomes, sum(len(row) for options in rows for row in options))


def _start(env: object, inner: object, states: int, is_stepped: bool) -> np.ndarray:
    """(S,) the start distribution that an environment says, compared with resets; else the state of all resets."""
    name = next((name for name in STARTS if getattr(inner, name, None) is not None), None)
    start = None if name is None else _distribution(env, name, getattr(inner, name), states)
    if not is_stepped:
        return np.eye(states)[0] if start is None else start
    least, most = SAMPLED_RESETS
    count = least if start is None else min(most, max(least, 20 * int((start > 0).sum())))
    layers, counts = Layers(env), np.zeros(states, np.int64)
    for i in range(count):
        layers.reset(0 if i == 0 else None)
        state = _state_number(layers.bottom.observation, states, first_number(inner, "observation"))
        if state is not None:
            counts[state] += 1
    starts = np.flatnonzero(counts)
    if start is None and len(starts) == 1 and counts.sum() == count:
        return np.eye(states)[starts[0]]
    if start is not None and (not len(starts) or (not counts[start == 0].any() and not is_unlikely(counts, start))):
        return start
    listed = ", ".join([*map(str, starts[:5]), *(["..."] if len(starts) > 5 else [])]) or "no state's number"
    says = "it has no initial_state_distrib" if start is None else f"its {name} says otherwise"
    raise FileFormatError(
        f"{name_of(env)}: its resets start in {listed}, and {says}; give initial=, the states that are equally likely "
        f"(--initial 0,3) or (S,) probabilities"
    )


def _distribution(env: object, name: str, value: object, states: int) -> np.ndarray:
    """(S,) probabilities; FileFormatError if the value is no such thing."""
    try:
        start = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise FileFormatError(f"{name_of(env)}: {name} is no distribution: {error}") from None
    if start.shape != (states,) or not np.isfinite(start).all() or (start < 0).any() or abs(start.sum() - 1) > 1e-6:
        raise FileFormatError(f"{name_of(env)}: {name} is no distribution over the {states} states of P")
    return start


def is_unlikely(counts: np.ndarray, probabilities: np.ndarray, comparisons: int = 1) -> bool:
    """Whether such counts are less likely than LEAST_PROBABILITY, of several comparisons together."""
    return _probability_of(counts, probabilities) < LEAST_PROBABILITY / comparisons


def _probability_of(counts: np.ndarray, probabilities: np.ndarray) -> float:
    """Upper bound on the probability that some count lies as far out as these, in its binomial distribution."""
    from scipy.special import bdtr, bdtrc

    total, p = int(counts.sum()), np.minimum(probabilities / probabilities.sum(), 1.0)
    at_most = bdtr(counts, total, p)
    at_least = np.where(counts > 0, bdtrc(np.maximum(counts - 1, 0), total, p), 1.0)
    return min(1.0, 2 * len(counts) * float(np.minimum(at_most, at_least).min()))


def _compare_with_steps(env: object, inner: object, rows: list[list[list]]) -> None:
    """Step the environment; raise FileFormatError if a transition is not in its table.

    Each state's available actions are tried in turn, so that few steps try many of them.
    """
    stepped = _copy(inner)
    probabilities = [[_probabilities(options) for options in row] for row in rows]
    samples: dict[tuple[int, int], Counter] = {}
    never = np.iinfo(np.int64).max
    tries = np.array([[0 if row else never for row in options] for options in rows])
    rng = np.random.default_rng(0)
    state = None
    first_state, first_action = first_number(inner, "observation"), first_number(inner, "action")
    for step in range(SAMPLED_STEPS):
        if state is None or step % SAMPLED_EPISODE == 0:
            state = _state_number(reset(stepped, 0 if step == 0 else None), len(rows), first_state)
        if state is None:  # what is observed is no number of a state: nothing to compare
            return
        least = np.flatnonzero(tries[state] == tries[state].min())
        action = int(least[rng.integers(len(least))])
        tries[state, action] += 1
        observation, reward, ended, _ = step_parts(stepped.step(action + first_action))
        next_state = _state_number(observation, len(rows), first_state)
        outcome = (next_state, float(reward), bool(ended))
        if outcome not in probabilities[state][action]:
            raise FileFormatError(
                f"{name_of(env)}: in state {state}, action {action} led to state {next_state} with reward {reward}, "
                f"which its table P[{state}][{action}] does not hold; {_reason(outcome, probabilities[state][action])}"
                f"{_native(inner)}"
            )
        samples.setdefault((state, action), Counter())[outcome] += 1
        state = None if ended else next_state
    _compare_frequencies(env, inner, probabilities, samples)


def _reason(outcome: tuple, expected: Mapping[tuple, float]) -> str:
    """Why an outcome that was seen is likely not in the table."""
    next_state, reward, ended = outcome
    rewards = [other[1] for other in expected if (other[0], other[2]) == (next_state, ended)]
    if rewards:
        return f"its reward differs from that of the table, {rewards[0]}, so the table is another MDP"
    if any(other[:2] == (next_state, reward) for other in expected):
        return f"the episode {'ended' if ended else 'went on'}, unlike in the table, so the table is another MDP"
    return (
        "its chance is not in the table (as that of Taxi with fickle_passenger=True), so the table is another MDP: "
        "switch that chance off"
    )


def _probabilities(options: list) -> dict[tuple[int, float, bool], float]:
    """Outcome (next state, reward, terminated) -> probability, of the possible ones."""
    probabilities: dict[tuple[int, float, bool], float] = {}
    for p, next_state, reward, ended in options:
        if p > 0:
            outcome = (int(next_state), float(reward), bool(ended))
            probabilities[outcome] = probabilities.get(outcome, 0.0) + float(p)
    return probabilities


def _compare_frequencies(env: object, inner: object, table: list, samples: dict[tuple[int, int], Counter]) -> None:
    """FileFormatError if the sampled frequencies of a state and action, or of all with the same probabilities in the
    table, are too unlikely; the first test that fails is named."""
    groups: dict[tuple[float, ...], np.ndarray] = {}
    named: dict[tuple[float, ...], tuple[int, int]] = {}
    tests: list[tuple[int, int, tuple[float, ...], np.ndarray]] = []
    for (state, action), counts in samples.items():
        expected = table[state][action]
        if len(expected) == 1:
            continue
        shares = tuple(expected.values())
        sampled = np.array([counts[outcome] for outcome in expected])
        tests.append((state, action, shares, sampled))
        groups[shares] = groups.get(shares, 0) + sampled
        named.setdefault(shares, (state, action))
    tests += [(*named[shares], shares, sampled) for shares, sampled in groups.items()]
    for state, action, shares, sampled in tests:
        if is_unlikely(sampled, np.array(shares), len(tests)):
            chance = _probability_of(sampled, np.array(shares))
            raise FileFormatError(
                f"{name_of(env)}: in state {state}, action {action} (and those with the same probabilities) had its "
                f"outcomes {', '.join(map(str, sampled))} times in {sampled.sum()} steps, but its table "
                f"P[{state}][{action}] gives them {', '.join(f'{p:.3g}' for p in shares)}: that is as likely as "
                f"{chance:.1g}, so the table is another MDP{_native(inner)}"
            )


def _native(inner: object) -> str:
    """Hint at pharos' own version of an environment, for the end of a message; empty if there is none."""
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


def _state_number(observation: object, states: int, first: int = 0) -> int | None:
    number = as_integer(observation)
    return number - first if isinstance(number, int) and 0 <= number - first < states else None


def matrices(
    P: object,
    R: npt.ArrayLike,
    *,
    gamma: float = 0.99,
    initial: npt.ArrayLike = 0,
    horizon: int | None = None,
    axes: str | None = None,
    ends: npt.ArrayLike = False,
) -> TabularMDP:
    """Return the MDP of transition probabilities P and rewards R; as `TabularMDP.from_matrices`."""
    return TabularMDP.from_matrices(P, R, gamma=gamma, initial=initial, horizon=horizon, axes=axes, ends=ends)


# MiniGrid -------------------------------------------------------------------------------------------------------------


MOST_MINIGRID_STATES = 1_000_000
NO_OP = 6  # the action that most tasks ignore
_NOT_STATE = frozenset(
    [
        "step_count",
        "max_steps",
        "gen_obs",
        "_np_random",
        "_np_random_seed",
        "action_space",
        "observation_space",
        "actions",
        "window",
        "clock",
        "render_size",
        "render_mode",
        "screen_size",
        "spec",
        "metadata",
    ]
)


def minigrid(
    env: object,
    *,
    seed: int = 0,
    actions: Sequence[int] | None = None,
    gamma: float = 1.0,
    horizon: int | None = MINIGRID_STEPS,
    max_states: int = MOST_MINIGRID_STATES,
    remember_carried: bool = False,
) -> TabularMDP:
    """Return the MDP of a MiniGrid environment, by stepping the environment from every state that can be reached.

    A state is all that the environment keeps, without the number of steps: grid, objects and what they contain,
    position, direction, what is carried, and which object is which. A transition pays what the class pays, but for the
    package's own 1 - 0.9 steps / max_steps, which shrinks with time: it pays 1, as in BRIDGE. A transition that
    terminates the episode is -1. State 0 is the start, and states are numbered in the order of their discovery.

    Args:
        env: an environment or its name, such as "MiniGrid-KeyCorridorS3R1-v0". An environment given is reset and left
            somewhere. Wrappers of observations pass, and MiniGrid's NoDeath is taken over; any other must change
            nothing in any state.
        seed: of the reset that draws the layout.
        actions: actions of the MDP, in their order; None: all of the environment, without `done` if it never does
            anything.
        gamma, horizon: of the MDP; BRIDGE has 100 steps. The environment's time limit is not taken over.
        max_states: more are an error.
        remember_carried: each object knows whether it has ever been carried, as in BRIDGE, which needs that for rewards
            of progress. So a key that is put back into its cell gives another state, although nothing that can happen
            from there is different.
    Raises:
        MissingExtra: the package minigrid is not installed.
        ParameterError: there is no such environment, it is none of MiniGrid, an action is none of its own, or a wrapper
            changes what a step does.
        RuleError: a step draws random numbers, or touches what cannot be kept; or the payment, or the outcome, of a
            class of one's own depends on the number of steps in another way than the package's.
        StateSpaceTooLarge: there are more than `max_states` states.
    Cost: 0.1 to 1 ms a transition, by the size of the grid; 1 to 20 kB a state of the frontier.
    """
    driver = _Driver(env, seed, remember_carried, actions)
    return driver.explore(max_states, gamma=gamma, horizon=horizon)[0]


def minigrid_recording(
    env: object, *, seed: int = 0, horizon: int | None = MINIGRID_STEPS, remember_carried: bool = False
) -> tuple[TabularMDP, np.ndarray, tuple[str, ...]]:
    """Return the MDP of `minigrid`, an observation of each state, and the names of the actions.

    Args, errors and cost: as of `minigrid`, with all actions.
    Returns:
        (MDP, (S, width, height, 3) uint8, names). What one sees is the whole grid as MiniGrid encodes it (type, colour,
        condition), with the agent where it stands, its direction as condition: the image of MiniGrid's FullyObsWrapper.
        What is carried is not to be seen.
    """
    driver = _Driver(env, seed, remember_carried, is_shown=True)
    mdp, grids = driver.explore(MOST_MINIGRID_STATES, horizon=horizon)
    return mdp, grids, driver.action_names[: mdp.num_actions]


def minigrid_grids(
    env: object,
    *,
    seed: int = 0,
    actions: Sequence[int] | None = None,
    max_states: int = MOST_MINIGRID_STATES,
    remember_carried: bool = False,
) -> np.ndarray:
    """Return the observation of each state of `minigrid` with the same arguments, as in `minigrid_recording`.

    Args, errors and cost: as of `minigrid`.
    """
    return _Driver(env, seed, remember_carried, actions, is_shown=True).explore(max_states)[1]


class _Driver:
    """An environment of MiniGrid that can be restored to any state it has visited: a source of states for `search`.

    Args:
        selection: its actions; None: all. is_shown: whether the grid of each state is wanted.
    """

    def __init__(
        self,
        env: Any,
        seed: int,
        remember_carried: bool,
        selection: Sequence[int] | None = None,
        *,
        is_shown: bool = False,
    ):
        try:
            import minigrid as package  # registers its environments
            from minigrid.core.world_object import Wall
            from minigrid.minigrid_env import MiniGridEnv
        except ImportError:
            raise MissingExtra("importing MiniGrid", "minigrid", "minigrid") from None
        import gymnasium

        if isinstance(env, str):
            try:
                instance = gymnasium.make(env, disable_env_checker=True)
            except gymnasium.error.Error as error:
                raise ParameterError(f"{env!r}: Gymnasium cannot make it: {' '.join(str(error).split())}") from None
        else:
            instance = env
        self.env: Any = getattr(instance, "unwrapped", instance)
        if not isinstance(self.env, MiniGridEnv):
            raise ParameterError(f"{name_of(env)}: is no environment of MiniGrid {package.__version__}")
        self.name = name_of(env)
        self.is_shown, self._state, self._sent = is_shown, -1, set[bytes]()
        space: Any = self.env.action_space
        names, count = [action.name for action in self.env.actions], int(space.n)
        self.drops_done = selection is None and count == NO_OP + 1  # if it does nothing in any state
        self.actions = list(range(count)) if selection is None else [int(action) for action in selection]
        if not self.actions or not set(self.actions) <= set(range(count)) or len(set(self.actions)) < len(self.actions):
            raise ParameterError(f"actions are {self.actions}; expected different ones from 0 to {count - 1}")
        self.num_actions = len(self.actions)
        self.action_names = tuple(names[action] for action in self.actions)
        self.wall = Wall
        self.remember_carried = remember_carried
        self.fixed_types = (gymnasium.spaces.Space, np.random.Generator, FunctionType)
        self.fixed: list[Any] = []
        self.layers = Layers(instance, copied=False)
        instance.reset(seed=seed)
        self.layers.reset(seed)
        if not self.layers.suspects:  # partial views cost most of a step, and nothing else looks at them
            vars(self.env)["gen_obs"] = dict

    def explore(
        self, max_states: int, *, gamma: float = 1.0, horizon: int | None = None
    ) -> tuple[TabularMDP, np.ndarray]:
        """(the MDP, the grid of each state if it is wanted)."""
        text = f"{self.name}: has more than max_states={max_states}; raise it or choose a smaller one"
        search = BreadthFirst(self, max_states=max_states, too_large=lambda _: text)
        try:
            states, frontier = search.begin()
            search.run(states, frontier, ExpansionsHere(self.expanded))
        finally:
            vars(self.env).pop("gen_obs", None)
        outcomes = states.outcomes()
        table, rewards = (each.reshape(states.num_states, -1) for each in (outcomes.next_states, outcomes.rewards))
        names = self.action_names
        if self.drops_done and (table[:, NO_OP] == np.arange(len(table))).all() and (rewards[:, NO_OP] == 0).all():
            table, rewards, names = table[:, :NO_OP], rewards[:, :NO_OP], names[:NO_OP]
        mdp = TabularMDP.from_arrays(table, rewards, gamma=gamma, horizon=horizon).with_names(actions=list(names))
        return mdp, np.array([each for each in states.observations if each is not None])

    def starts(self) -> list[Arrival]:
        """The state after the reset."""
        return [self._arrival(0.0, False)]

    def expanded(self, states: Sequence[bytes]) -> list[list[list[Arrival]]]:
        """The outcome of each action in each of some saved states."""
        rows = []
        for saved in states:
            self._state += 1
            rows.append([[self._arrival(*self.step(action, saved))] for action in self.actions])
        return rows

    def _arrival(self, reward: float, ended: bool) -> Arrival:
        key = None if ended else self.key()
        if key is None or key in self._sent:
            return Arrival(1.0, reward, key)
        self._sent.add(key)
        return Arrival(1.0, reward, key, self.save(), self.image() if self.is_shown else None)

    def step(self, action: int, saved: bytes) -> tuple[float, bool]:
        """(reward without its discount by time, whether the episode ends)."""
        self.restore(saved)
        late = None
        if not self._is_paid_by_package:
            steps = max(int(self.env.max_steps) - 2, 1)
            late = (*self._stepped(action, steps), self.key())
            self.restore(saved)
        payment, terminated = self._stepped(action, 0)
        if late is not None and late != (payment, terminated, self.key()):
            if late[0] != payment:
                what = f"pays {payment:g} at first and {late[0]:g} after {steps:,} steps"
            else:
                what = f"leads elsewhere after {steps:,} steps than at first"
            raise RuleError(
                f"{self.name}: {what} by action {action} in state {self._state}; expected what does not depend on the "
                f"number of steps, or the package's own payment of 1 - 0.9 steps / max_steps"
            )
        return payment, terminated

    @cached_property
    def _is_paid_by_package(self) -> bool:
        """Whether the rewards come from the package, and no class or wrapper adds to them."""
        functions = (getattr(self.env, name) for name in ("step", "_reward"))
        is_bare = self.layers.top is self.layers.bottom
        return is_bare and all(str(getattr(each, "__module__", "")).startswith("minigrid.") for each in functions)

    def _stepped(self, action: int, steps: int) -> tuple[float, bool]:
        """`step` after so many others; payments equal to the package's are 1."""
        rng = self.env.np_random
        before = rng.bit_generator.state
        self.env.step_count = steps
        _, reward, terminated, _ = self.layers.step(action)
        if self.remember_carried and self.env.carrying is not None:
            self.env.carrying.has_been_carried = True
        if rng.bit_generator.state != before:
            raise RuleError(
                f"{self.name}: draws random numbers in state {self._state} by action {action}; "
                f"expected one outcome of each action"
            )
        if not np.isfinite(reward):
            raise RuleError(
                f"{self.name}: pays {reward} in state {self._state} by action {action}; expected a finite number"
            )
        own = 1 - 0.9 * ((steps + 1) / self.env.max_steps)
        return (1.0 if abs(reward - own) <= 1e-12 else float(reward)), bool(terminated)

    def save(self) -> bytes:
        """Snapshot of the state, for `restore`."""
        stored = io.BytesIO()
        pickler = pickle.Pickler(stored, protocol=5)
        pickler.persistent_id = self._number_of_fixed  # type: ignore[method-assign]
        try:
            pickler.dump(dict(self._attributes()))
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise RuleError(f"{self.name}: keeps what cannot be copied: {capped(error)}") from None
        return stored.getvalue()

    def restore(self, snapshot: bytes) -> None:
        """Put a state back that `save` returned: a copy in memory, never a file."""
        reader = pickle.Unpickler(io.BytesIO(snapshot))
        reader.persistent_load = self.fixed.__getitem__  # type: ignore[method-assign,assignment]
        attributes = reader.load()
        for name in [name for name, _ in self._attributes() if name not in attributes]:
            delattr(self.env, name)
        vars(self.env).update(attributes)

    def _number_of_fixed(self, value: object) -> int | None:
        """Number of a value outside the state (the environment, its spaces, generator, functions); None for others."""
        if value is not self.env and not isinstance(value, self.fixed_types):
            return None
        for number, constant in enumerate(self.fixed):
            if constant is value:
                return number
        self.fixed.append(value)
        return len(self.fixed) - 1

    def image(self) -> np.ndarray:
        """(width, height, 3), the grid with the agent in it."""
        from minigrid.core.constants import COLOR_TO_IDX, OBJECT_TO_IDX

        image = np.array(self.env.grid.encode())
        column, row = self.env.agent_pos
        image[int(column), int(row)] = (OBJECT_TO_IDX["agent"], COLOR_TO_IDX["red"], self.env.agent_dir)
        return image

    def key(self) -> bytes:
        """Key of the state: equal for equal states, and for no others."""
        flat: list[Any] = []
        indices: dict[int, int] = {}
        for name, value in self._attributes():
            flat.append(name)
            self._flatten(value, flat, indices)
        return repr(flat).encode()

    def _attributes(self) -> Iterator[tuple[str, Any]]:
        """Yield the attributes that make up the state; the grid first, so that objects are numbered by position."""
        attributes = vars(self.env)
        for name in sorted(attributes, key=lambda name: (name != "grid", name)):
            if name not in _NOT_STATE:
                yield name, attributes[name]

    def _flatten(self, value: object, flat: list[Any], indices: dict[int, int]) -> None:
        if isinstance(value, np.ndarray | np.generic):
            value = value.tolist()
        if value is None or isinstance(value, bool | int | float | str):
            flat.append(value)
        elif type(value) is self.wall:  # most cells, and nothing moves them
            flat.append(value.color)
        elif isinstance(value, tuple | list):  # MiniGrid writes positions as either
            flat.append(("list", len(value)))
            for item in value:
                self._flatten(item, flat, indices)
        elif isinstance(value, dict):
            flat.append(("dict", len(value)))
            for name, item in value.items():
                self._flatten(name, flat, indices)
                self._flatten(item, flat, indices)
        elif value is self.env or callable(value) or isinstance(value, self.fixed_types):
            flat.append(type(value).__name__)
        elif id(value) in indices:
            flat.append(("again", indices[id(value)]))
        elif hasattr(value, "__dict__"):  # grids, rooms, doors, keys, ...
            indices[id(value)] = len(indices)
            flat.append(type(value).__name__)
            self._flatten(vars(value), flat, indices)
        else:
            raise RuleError(f"{self.name}: keeps a {type(value).__name__}, which cannot be told apart from others")
