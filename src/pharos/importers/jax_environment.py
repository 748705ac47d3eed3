"""Pure functions of JAX as a source of states. The frontier is stepped as one program, mapped over states,
actions and outcomes of the draws (`jax_chance`).
"""

import hashlib
import math
import random as python_random
from collections import Counter
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pharos.errors import ParameterError, PharosError, RuleError, UnknownName
from pharos.importers.chance import placed
from pharos.importers.fresh_play import FreshPlay
from pharos.importers.gymnasium import SAMPLED_EPISODE, SAMPLED_STEPS
from pharos.importers.jax_chance import Traced, TracedFunction, refusal_behind
from pharos.importers.jax_stepping import JaxFunctions
from pharos.importers.search import END, Arrival, ExpansionsHere, SteppedStates
from pharos.importers.side_effects import SideEffects
from pharos.importers.step_spaces import SpaceRecorder
from pharos.importers.stepped_environment import (
    CHECKED_PAIRS,
    WALK_STEPS,
    ConstantChanged,
    SteppingOptions,
    difference,
    line_of_error,
    payment_of,
)
from pharos.system.wording import capped

OUTCOMES_AT_ONCE = 4_096
"""Outcomes that one call of the program computes, about."""
MOST_AT_ONCE = 512
WALKERS = 64
"""Episodes that are played side by side in the end."""


class StateField(NamedTuple):
    """An array of a state.

    Attributes:
        names: of its place, such as ("board", "0"). is_key: whether it is a key of jax.random, which is no state.
    """

    names: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype
    is_key: bool

    @property
    def num_bytes(self) -> int:
        """Size within one state."""
        return 0 if self.is_key else math.prod(self.shape) * self.dtype.itemsize


class StateLayout:
    """States as rows of bytes: first what tells states apart, then what is ignored.

    Args:
        state: shapes and dtypes of a state. ignore: names of fields.
    """

    def __init__(self, state: Traced, ignore: frozenset[str]):
        leaves, self._tree = jax.tree_util.tree_flatten_with_path(state)
        self.fields = []
        for path, leaf in leaves:
            is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
            kind = np.dtype(np.uint32) if is_key else np.dtype(leaf.dtype)
            self.fields.append(StateField(tuple(map(_name_of, path)), tuple(leaf.shape), kind, bool(is_key)))
        self.ignored = [bool(ignore & set(field.names)) for field in self.fields]
        self.order = sorted(range(len(self.fields)), key=lambda i: self.ignored[i])
        self.num_key_bytes = sum(
            field.num_bytes for field, ignored in zip(self.fields, self.ignored, strict=True) if not ignored
        )

    def packed(self, states: Traced, count: int) -> list[bytes]:
        """The first `count` of a batch of states."""
        leaves = jax.tree.leaves(states)
        parts = [np.empty((count, 0), np.uint8)]
        for i in self.order:
            if not self.fields[i].is_key:
                array = np.ascontiguousarray(np.asarray(leaves[i])[:count]).reshape(count, -1)
                parts.append(array.view(np.uint8).reshape(count, -1))
        return [row.tobytes() for row in np.concatenate(parts, axis=1)]

    def unpacked(self, rows: Sequence[bytes]) -> Traced:
        """A batch of states."""
        data = np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), -1)
        leaves: list[Any] = [None] * len(self.fields)
        start = 0
        for i in self.order:
            field = self.fields[i]
            stop = start + field.num_bytes
            if field.is_key:
                leaves[i] = jnp.broadcast_to(jax.random.key(0), (len(rows), *field.shape))
            else:
                part = np.ascontiguousarray(data[:, start:stop])
                leaves[i] = part.view(field.dtype).reshape(len(rows), *field.shape)
            start = stop
        return jax.tree.unflatten(self._tree, leaves)

    def key_of(self, row: bytes) -> bytes:
        """Key of a state."""
        return hashlib.blake2b(row[: self.num_key_bytes], digest_size=16).digest()

    def integers(self, row: bytes) -> dict[str, int]:
        """Whole numbers among the fields that tell states apart."""
        values = jax.tree.leaves(self.unpacked([row]))
        return {
            field.names[-1]: int(value[0])
            for field, ignored, value in zip(self.fields, self.ignored, values, strict=True)
            if field.names and not ignored and not field.is_key and not field.shape and field.dtype.kind in "iu"
        }


def _name_of(part: Traced) -> str:
    """The name of a step on the way to a field: an attribute, a key of a dictionary, a place in a list."""
    return str(next(getattr(part, name) for name in ("name", "key", "idx") if hasattr(part, name)))


class SteppedOutcome(NamedTuple):
    """An outcome of an action: probability, reward, state (None at the end), observation, number of its tape."""

    probability: Fraction | float
    reward: float
    row: bytes | None
    observation: Traced
    tape: int


class JaxEnvironment:
    """Pure functions as a source of states for `search`.

    Args:
        factory: makes the functions. options: of `stepping`, without a key.
    Attributes:
        name, time_limit, action_names, observer, effects: as of `SteppedEnvironment`.
    """

    def __init__(self, factory: Callable[[], JaxFunctions], options: SteppingOptions):
        self.effects = SideEffects()
        with self.effects.watched():
            self.functions = functions = factory()
            self.name, self.time_limit = functions.name, functions.time_limit
            if options.key is not None:
                raise ParameterError(f"{self.name}: a key is for environments in Python; name fields to ignore")
            self.options, self.action_names = options, functions.action_names
            actions = functions.actions
            self.actions = np.arange(actions) if isinstance(actions, int) else np.stack(list(actions))
            self._sent: set[bytes] = set()
            self._first: dict[bytes, bytes] = {}
            self._pairs: list[tuple[bytes, bytes]] = []
            self._num_pairs = 0
            self._prepare()

    @property
    def num_actions(self) -> int:
        """Number of actions, the same in all states."""
        return len(self.actions)

    def _prepare(self) -> None:
        """Trace the functions, and lay out their states."""
        most = self.options.max_outcomes
        if self.options.seed is None:
            self._reset = self._traced("reset()", self.functions.reset, (), most)
            shown, state = self._reset.result[:2]
        else:
            key = jax.random.key(self.options.seed)
            self._start = self._calling("reset()", lambda: jax.tree.map(jnp.asarray, self.functions.reset(key)))[:2]
            shown, state = jax.eval_shape(lambda: self._start)
        action = jax.ShapeDtypeStruct(self.actions.shape[1:], jnp.asarray(self.actions).dtype)
        for attempt in range(2):
            self._step = self._traced("step()", self._four, (state, action), most)
            after, before = self._step.result[1], state
            if jax.tree.map(_form, after) == jax.tree.map(_form, before):
                break
            state = after  # numbers of Python in the start become arrays
            if attempt or jax.tree.structure(after) != jax.tree.structure(before):
                raise RuleError(
                    f"{self.name}: step() returns states of another form than it takes: {capped(after, 200)}"
                )
        self.state = state
        self.counters = sorted(set(self.functions.counters) - self.options.ignore - self.options.copied)
        ignore = self.options.ignore.union(self.counters)
        self.layout = StateLayout(state, ignore)
        names = {name for field in self.layout.fields for name in field.names}
        for name in sorted(self.options.ignore - names):
            raise UnknownName(f"field of the states of {self.name}", name, names)
        tapes, actions = jnp.asarray(self._step.tapes), jnp.asarray(self.actions)
        each = len(tapes) * len(actions)
        self.at_once = min(max(OUTCOMES_AT_ONCE // each, 4), MOST_AT_ONCE)
        mapped = jax.vmap(jax.vmap(jax.vmap(self._step.run, (0, None, None)), (None, None, 0)), (None, 0, None))
        self._program = jax.jit(lambda states: mapped(tapes, states, actions))
        self._single = jax.jit(self._step.run)
        self.observer = SpaceRecorder(_space(shown), self.name)

    def _four(self, key: Traced, state: Traced, action: Traced) -> Traced:
        answer = self.functions.step(key, state, action)
        if not isinstance(answer, tuple) or len(answer) < 4:
            raise RuleError(
                f"{self.name}: step() returned {capped(answer)}; expected (observation, state, reward, ended)"
            )
        return answer[:4]

    def _traced(self, what: str, function: Callable[..., Any], arguments: tuple, most: int) -> TracedFunction:
        return self._calling(what, lambda: TracedFunction(what, function, arguments, most))

    def _calling(self, what: str, function: Callable[[], Any]) -> Traced:
        try:
            return function()
        except Exception as error:
            refusal = refusal_behind(error)
            if refusal is not None:
                text = str(refusal)
                raise RuleError(f"{self.name}: {text if text.startswith(what) else f'{what} {text}'}") from None
            if isinstance(error, PharosError):
                raise
            text = capped(" ".join(str(error).split()), 200)
            raise RuleError(
                f"{self.name}: {what} raised {placed(f'{type(error).__name__}: {text}', line_of_error(error))}"
            ) from error

    # What search asks -------------------------------------------------------------------------------------------------

    def starts(self) -> list[Arrival]:
        """The states in which episodes start, with their probabilities."""
        if self.options.seed is not None:
            return [self._arrival(Fraction(1), 0.0, *self._started(self._start), ())]
        run = jax.jit(jax.vmap(self._reset.run))
        (shown, states, *_), shares = run(jnp.asarray(self._reset.tapes))
        rows = self.layout.packed(self._as_states(states), len(self._reset.tapes))
        observations = _flat(shown, len(rows))
        weights = _probabilities(self._reset.weights, [np.asarray(share, float) for share in shares], len(rows))
        return [
            self._arrival(weight, 0.0, row, observations[i], (i,))
            for i, (weight, row) in enumerate(zip(weights, rows, strict=True))
            if weight > 0
        ]

    def _as_states(self, states: Traced) -> Traced:
        """A batch with the dtypes of the states that `step` returns."""
        return jax.tree.map(lambda leaf, form: jnp.asarray(leaf).astype(form.dtype), states, self.state)

    def _started(self, start: Traced) -> tuple[bytes, np.ndarray]:
        """(row, observation) of one start."""
        shown, state = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], start)
        return self.layout.packed(self._as_states(state), 1)[0], _flat(shown, 1)[0]

    def outcomes(self, rows: Sequence[bytes]) -> list[list[list[SteppedOutcome]]]:
        """The outcomes of each action in each of some states."""
        answers: list[list[list[SteppedOutcome]]] = []
        for first in range(0, len(rows), self.at_once):
            answers += self._outcomes(rows[first : first + self.at_once])
        return answers

    def _outcomes(self, rows: Sequence[bytes]) -> list[list[list[SteppedOutcome]]]:
        padded = [*rows, *[rows[0]] * (self.at_once - len(rows))]
        (shown, states, rewards, ended), shares = self._program(self.layout.unpacked(padded))
        num_actions, num_tapes = self.num_actions, len(self._step.tapes)
        count = len(rows) * num_actions * num_tapes

        def flat(leaf: Traced) -> Traced:
            return leaf.reshape(-1, *leaf.shape[3:])

        after = self.layout.packed(jax.tree.map(flat, states), count)
        observations = _flat(jax.tree.map(flat, shown), count)
        payments = self._payments(np.asarray(flat(rewards))[:count])
        over = np.asarray(flat(ended)).reshape(-1)[:count].astype(bool).tolist()
        weights = _probabilities(
            self._step.weights, [np.asarray(flat(share), float)[:count] for share in shares], count
        )
        i = 0
        answers: list[list[list[SteppedOutcome]]] = []
        for _ in rows:
            answers.append([[] for _ in range(num_actions)])
            for action in range(num_actions):
                for tape in range(num_tapes):
                    if weights[i] > 0:
                        row = None if over[i] else after[i]
                        answers[-1][action].append(SteppedOutcome(weights[i], payments[i], row, observations[i], tape))
                    i += 1
        return answers

    def _payments(self, rewards: np.ndarray) -> list[float]:
        own = self.options.reward
        if own is None and rewards.ndim == 1 and np.isfinite(rewards).all():
            return rewards.astype(float).tolist()
        return [payment_of(reward, own, self.name) for reward in rewards]

    def expanded(self, saved: Sequence[bytes]) -> list[list[list[Arrival]]]:
        """The outcomes of each action in each of some states, for `search`."""
        with self.effects.watched():
            return [
                [
                    [
                        self._arrival(each.probability, each.reward, each.row, each.observation, (each.tape,))
                        for each in outcomes
                    ]
                    for outcomes in rows
                ]
                for rows in self.outcomes(saved)
            ]

    def _arrival(
        self,
        probability: Fraction | float,
        reward: float,
        row: bytes | None,
        observations: Traced,
        script: tuple[int, ...],
    ) -> Arrival:
        if row is None:
            return Arrival(probability, reward, None, script=script)
        key = self.layout.key_of(row)
        if key not in self._sent:
            self._sent.add(key)
            if any(self.layout.ignored):
                self._first[key] = row
            return Arrival(probability, reward, key, row, self.observer.shown(observations), script)
        if self._first.get(key, row) != row and self._num_pairs < min(CHECKED_PAIRS, 4 * self.at_once):
            self._num_pairs += 1
            self._pairs.append((self._first[key], row))
            if len(self._pairs) == self.at_once:
                self.check_rest()
        return Arrival(probability, reward, key, script=script)

    def arrive(self, saved: bytes | None, action: int, script: Sequence[int]) -> Arrival:
        """Repeat an earlier step with this tape, from a saved state or from the reset (None)."""
        if saved is None:
            return next(each for each in self._all_starts() if each.script == tuple(script))
        state = jax.tree.map(lambda leaf: leaf[0], self.layout.unpacked([saved]))
        tape = jnp.asarray(self._step.tapes[script[0]])
        (shown, after, _, _), _ = self._single(tape, state, jnp.asarray(self.actions)[action])
        row, observations = self._started((shown, after))
        return Arrival(1.0, 0.0, self.layout.key_of(row), row, self.observer.shown(observations), tuple(script))

    def _all_starts(self) -> list[Arrival]:
        self._sent.clear()
        return self.starts()

    def skip(self, keys: Sequence[bytes]) -> None:
        """Hand over no saved states of these keys."""
        self._sent.update(keys)

    def integers(self, saved: bytes) -> dict[str, int]:
        """Whole numbers that a state holds, by the names of their fields."""
        return self.layout.integers(saved)

    def expansions(self, workers: int) -> ExpansionsHere:
        """States of the frontier, stepped together."""
        if workers > 1:
            raise ParameterError(f"{self.name}: workers are {workers}; JAX steps states side by side, in one process")
        return ExpansionsHere(self.expanded, self.at_once)

    # Checks -----------------------------------------------------------------------------------------------------------

    def check_rest(self) -> None:
        """RuleError if two states that differ in what is ignored only behave differently, along a walk."""
        pairs, self._pairs = self._pairs, []
        rng = python_random.Random(self._num_pairs)
        for step in range(1 + WALK_STEPS):
            if not pairs:
                return
            next_pairs = []
            sides = [self.outcomes([pair[side] for pair in pairs]) for side in range(2)]
            for rows in zip(*sides, strict=True):
                for action, both in enumerate(zip(*rows, strict=True)):
                    one, other = (Counter(self._shares(outcomes)) for outcomes in both)
                    if one != other and self.counters:  # one of them matters, and nobody said that they do not
                        raise ConstantChanged(self.counters[0])
                    if one != other:
                        after = f"action {action}" + f", after {step} others" * bool(step)
                        raise RuleError(
                            f"{self.name}: two states with the same key behave differently ({after}: "
                            f"{difference(one, other)}): --ignore leaves out something that matters"
                        )
                action = rng.randrange(self.num_actions)
                tape = rng.choice([each.tape for each in rows[0][action]])
                after_both = [next((each.row for each in row[action] if each.tape == tape), None) for row in rows]
                if after_both[0] is not None and after_both[1] is not None:
                    next_pairs.append((after_both[0], after_both[1]))
            pairs = next_pairs

    def _shares(self, outcomes: Sequence[SteppedOutcome]) -> dict[tuple, Fraction | float]:
        """(key, reward) -> probability."""
        shares: dict[tuple, Fraction | float] = {}
        for each in outcomes:
            to = None if each.row is None else self.layout.key_of(each.row), each.reward
            shares[to] = shares.get(to, 0) + each.probability
        return shares

    def compare(self, states: SteppedStates, horizon: int | None) -> None:
        """RuleError if the functions, with JAX' own chance, do what the states say to be impossible or too unlikely."""
        JaxPlay(self, states, horizon).compare()

    def play_starts(self, seed: int) -> list[bytes]:
        """States after resets with JAX' own chance."""
        keys = jax.random.split(jax.random.key(seed), WALKERS)
        if self.options.seed is not None:
            return [self._started(self._start)[0]] * WALKERS
        states = jax.jit(jax.vmap(lambda key: self.functions.reset(key)[1]))(keys)
        return self.layout.packed(self._as_states(states), WALKERS)

    def player(self) -> Callable[[int, Sequence[bytes], np.ndarray], tuple[list[bytes], list[float], list[bool]]]:
        """Function (seed, states, actions) -> (next states, rewards, whether episodes ended), with JAX' own chance."""
        program = jax.jit(jax.vmap(self._four))

        def play(seed: int, rows: Sequence[bytes], actions: np.ndarray) -> tuple[list[bytes], list[float], list[bool]]:
            keys = jax.random.split(jax.random.key(seed), len(rows))
            states, moves = self.layout.unpacked(rows), jnp.asarray(self.actions[actions])
            _, after, rewards, ended = program(keys, states, moves)
            return (
                self.layout.packed(self._as_states(after), len(rows)),
                self._payments(np.asarray(rewards)),
                np.asarray(ended).reshape(-1).astype(bool).tolist(),
            )

        return play


def _form(leaf: Traced) -> tuple[tuple[int, ...], str]:
    return tuple(leaf.shape), str(leaf.dtype)


def _flat(shown: Traced, count: int) -> np.ndarray:
    """The first `count` of a batch of observations as one array: a single array as it is, several one after another."""
    leaves = [np.asarray(leaf)[:count] for leaf in jax.tree.leaves(shown)]
    if len(leaves) == 1:
        return leaves[0]
    return np.concatenate([leaf.reshape(count, -1).astype(np.float32) for leaf in leaves], axis=1)


def _space(shown: Traced) -> Traced:
    """A space of Gymnasium for observations of these shapes."""
    from gymnasium.spaces import Box

    leaves = jax.tree.leaves(shown)
    if len(leaves) > 1:
        return Box(-np.inf, np.inf, (sum(math.prod(leaf.shape) for leaf in leaves),), np.float32)
    kind = np.dtype(leaves[0].dtype)
    if kind.kind in "iu":
        return Box(np.iinfo(kind).min, np.iinfo(kind).max, leaves[0].shape, kind.type)
    return Box(-np.inf, np.inf, leaves[0].shape, np.float32)


def _probabilities(weights: list[Fraction], shares: list[np.ndarray], count: int) -> list[Any]:
    """Probability of each outcome: exact fractions, or floats if some depend on the state."""
    repeated = weights * (count // len(weights))
    if not shares:
        return repeated
    return (np.array([float(weight) for weight in repeated]) * np.prod(shares, axis=0)).tolist()


class JaxPlay(FreshPlay):
    """Episodes side by side, with JAX' own chance, compared with the states that stepping found."""

    tolerance = 1e-6  # programs of other shapes may round otherwise

    def compare(self) -> None:
        """RuleError if an episode does what the states say to be impossible, or with other frequencies."""
        source = self.source
        left, seed = min(SAMPLED_STEPS, 1_000 + 20 * self.states.num_states * self.states.num_actions), 0
        with source.effects.watched():
            play = source.player()
            while left > 0:
                rows = source.play_starts(seed)
                numbers = [self.states.numbers.get(source.layout.key_of(row)) for row in rows]
                if any(number not in self.states.starts for number in numbers):
                    raise self.unknown_start()
                for _ in range(SAMPLED_EPISODE):
                    seed += 1
                    actions = self.rng.integers(self.states.num_actions, size=len(rows))
                    rows, rewards, ended = play(seed, rows, actions)
                    for i, number in enumerate(numbers):
                        if number is not None and number != END:
                            left -= 1
                            self.tries[number, int(actions[i])] += 1
                            to = END if ended[i] else self.states.numbers.get(source.layout.key_of(rows[i]))
                            self.check_outcome(number, int(actions[i]), to, rewards[i])
                            numbers[i] = to
                    if left <= 0 or all(number is None or number == END for number in numbers):
                        break
        self.check_frequencies()
