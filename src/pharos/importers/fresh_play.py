"""The environment itself, played with its own generators, beside the MDP that stepping made of it."""

import random as python_random
from collections import Counter
from typing import Any

import numpy as np

from pharos.errors import RuleError
from pharos.importers.gymnasium import SAMPLED_EPISODE, SAMPLED_STEPS, is_unlikely
from pharos.importers.search import END, SteppedStates
from pharos.importers.snapshots import chain_of
from pharos.importers.wrappers import Stepped, reset


class FreshPlay:
    """A new environment with its own generators, played and compared with the states that stepping found.

    Args:
        horizon: of the exploration, whose last states were not made.
    Attributes:
        tolerance: of rewards, relative if they exceed 1.
    """

    tolerance = 0.0

    def __init__(self, source: Any, states: SteppedStates, horizon: int | None):
        self.source, self.states, self.horizon = source, states, horizon
        self.rng = np.random.default_rng(0)
        self.tries = Counter[tuple[int, int]]()
        self.samples: dict[int, Counter] = {}

    def compare(self) -> None:
        """RuleError if the environment does what the table says to be impossible, or with other frequencies."""
        num_pairs = self.states.num_states * self.states.num_actions
        left, episode = min(SAMPLED_STEPS, 1_000 + 20 * num_pairs), 0
        with self.source.effects.watched():
            env = self._made()
            while left > 0:
                env, state = self._start(env, episode)
                left -= self._episode(env, state)
                episode += 1
        self.check_frequencies()

    def _made(self) -> Stepped:
        """A new environment; RuleError if its tables are others."""
        source = self.source
        env, _ = source.made()
        reset(env, 0 if source.options.seed is None else source.options.seed)
        name = source.snapshots.adopt(env)
        if name is not None:
            raise RuleError(
                f"{source.name}: {name} differs between two environments that the factory made; give the factory a "
                f"seed, so that it makes the same one each time"
            )
        return env

    def _start(self, env: Stepped, episode: int) -> tuple[Stepped, int]:
        """(the environment at the start of an episode, the number of its state); a new environment if needed."""
        for attempt in range(2):
            if attempt:
                env = self._made()
            if self.source.options.seed is None:
                reset(env, episode)
                reset(env)
            else:
                reset(env, self.source.options.seed)
                _reseed(env, episode)
            number = self.states.numbers.get(self.source.key_of(env))
            if number is not None and number in self.states.starts:
                return env, number
        raise self.unknown_start()

    def unknown_start(self) -> RuleError:
        """An error: an episode began in a state that is no start."""
        return RuleError(
            f"{self.source.name}: a reset of a new environment leads to a state that stepping did not find among its "
            f"starts: the factory makes different environments, or chance comes from outside"
        )

    def _episode(self, env: Stepped, state: int) -> int:
        """Number of steps that were compared."""
        for step in range(SAMPLED_EPISODE):
            counts = [self.tries[state, action] for action in range(self.states.num_actions)]
            is_any = self.rng.random() < 0.5
            options = np.flatnonzero(np.array(counts) <= (max(counts) if is_any else min(counts)))
            action = int(options[self.rng.integers(len(options))])
            self.tries[state, action] += 1
            _, payment, ended = self.source.step(env, self.source.actions[action])
            next_state = END if ended else self.states.numbers.get(self.source.key_of(env))
            self.check_outcome(state, action, next_state, payment)
            if next_state is None or next_state == END:
                return step + 1
            state = next_state
        return SAMPLED_EPISODE

    def check_outcome(self, state: int, action: int, next_state: int | None, payment: float) -> None:
        """RuleError if a step has no such outcome."""
        row = state * self.states.num_actions + action
        start, stop = self.states.offsets[row], self.states.offsets[row + 1]
        is_last = self.horizon is not None and self.states.depths[state] + 1 >= self.horizon
        to = END if next_state is None and is_last else next_state
        for outcome in range(start, stop):
            away = abs(self.states.rewards[outcome] - payment)
            if self.states.next_states[outcome] == to and away <= self.tolerance * max(1.0, abs(payment)):
                self.samples.setdefault(row, Counter())[outcome - start] += 1
                return
        raise RuleError(
            f"{self.source.name}: played with its own generators, action {action} in state {state} had an outcome that "
            f"stepping did not find (reward {payment:g}): {self._reason()}"
        )

    def _reason(self) -> str:
        if self.source.options.key is not None or self.source.options.ignore:
            return "the key, or what is ignored, leaves out something that matters"
        return "its chance comes from elsewhere (time, files, threads, C++), or a copy shares what a step changes"

    def check_frequencies(self) -> None:
        """RuleError if outcomes came far more or less often than they should."""
        for row, counts in self.samples.items():
            start, stop = self.states.offsets[row], self.states.offsets[row + 1]
            shares = np.array(self.states.probabilities[start:stop])
            sampled = np.array([counts[outcome] for outcome in range(stop - start)])
            if len(shares) > 1 and is_unlikely(sampled, shares, len(self.samples)):
                state, action = divmod(row, self.states.num_actions)
                raise RuleError(
                    f"{self.source.name}: played with its own generators, action {action} in state {state} had its "
                    f"outcomes {', '.join(map(str, sampled[:5]))} times, which stepping gives the probabilities "
                    f"{', '.join(f'{p:.3g}' for p in shares[:5])}: its chance comes from elsewhere"
                )


def _reseed(env: Stepped, seed: int) -> None:
    """Put the generators among an environment's fields into another state."""
    for each in chain_of(env):
        for value in vars(each).values():
            if isinstance(value, np.random.Generator):
                value.bit_generator.state = type(value.bit_generator)(seed).state
            elif isinstance(value, np.random.RandomState):
                value.set_state(np.random.RandomState(seed).get_state())
            elif isinstance(value, python_random.Random):
                value.seed(seed)
