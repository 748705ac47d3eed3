"""Knobs of interaction, for every loop that steps: executed action, laziness, outcome, start, late and noisy pay.

Each knob takes its random numbers as arguments, or from a stream rng[i]: of vector environments (here and in
rules/interaction.py), of Q-learning (learning.py), of the batched engine (batched.py). The table walk of
vector environments.
"""

from typing import NamedTuple

import numpy as np
from numba import float64, njit, uint64
from numba.extending import overload

from pharos.kernels.outcomes import drawn_outcome, is_table, outcome, size_of

NEXT_STEP, SAME_STEP, DISABLED = range(3)  # when an environment that has ended is reset


class Setting(NamedTuple):
    """Constants of a walk.

    Attributes:
        ranges: (2, D) int64, lowest and highest value of each component; (2, 0) on a table.
        scale: (D,) float64, of the vectors that `step_many` writes.
        chance: (chosen, previous, uniform, first_chosen, lazy), weights of the executed action, the fourth that of the
            chosen one where there is no previous action; and the probability that it has no effect.
        limit: steps after which an episode is truncated.
        mode: NEXT_STEP, SAME_STEP or DISABLED.
        first_previous: the previous action on the first step of an episode, -1 for none.
        starts, cumulative: (K, D) or (K,), the start states or their indices; (K,) cumulative sum of their
            probabilities.
    """

    ranges: np.ndarray
    scale: np.ndarray
    chance: tuple[float, ...]
    limit: int
    mode: int
    first_previous: int
    starts: np.ndarray
    cumulative: np.ndarray


class Batch(NamedTuple):
    """The arrays of N environments that a step reads and writes.

    Attributes:
        rng: (N,) uint64, a stream of random numbers each.
        actions: (N,) int64, chosen.
        states: (N, D) int64, or (N,) indices on a table.
        previous, elapsed, ended: (N,) the previous action, steps of the episode so far, whether it is over.
        rewards, terminated, truncated, executed: (N,) of this step; executed is -1 after a reset.
        final: as states; the last state of an episode that was over and reset in the same step.
        vector: (N, D) float32, the states as vectors; (0, D) where they are not wanted.
        probabilities: (N,) float64, of the outcomes that were drawn, 1 after a reset; (0,) where the rules have no
            chance.
    """

    rng: np.ndarray
    actions: np.ndarray
    states: np.ndarray
    previous: np.ndarray
    elapsed: np.ndarray
    ended: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    executed: np.ndarray
    final: np.ndarray
    vector: np.ndarray
    probabilities: np.ndarray


@njit(forceinline=True)
def uniform_number(rng, i):
    """A number in [0, 1) of stream i: SplitMix64 (Steele, Lea and Flood 2014) on the counter rng[i]."""
    rng[i] += uint64(0x9E3779B97F4A7C15)
    z = rng[i]
    z = (z ^ (z >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> uint64(27))) * uint64(0x94D049BB133111EB)
    z ^= z >> uint64(31)
    return float64(z >> uint64(11)) * 2.0**-53


@njit(cache=True, nogil=True)
def next_number(rng):
    """The next number of the only stream of rng (1,)."""
    return uniform_number(rng, 0)


@njit(forceinline=True)
def integer_below(rng, i, n):
    """An integer in [0, n) of stream i."""
    return min(int(uniform_number(rng, i) * n), n - 1)


@njit(forceinline=True)
def normal_by_numbers(u, v):
    """A standard normal number of two uniform ones, u > 0 (Box and Muller 1958)."""
    return np.sqrt(-2.0 * np.log(u)) * np.cos(2.0 * np.pi * v)


@njit(forceinline=True)
def normal_number(rng, i):
    """A standard normal number of stream i."""
    return normal_by_numbers(1.0 - uniform_number(rng, i), uniform_number(rng, i))


@njit(forceinline=True)
def paid_late(pending, elapsed, earned, is_last):
    """Pay of a step where rewards come D steps late, and at the end of an episode at once.

    pending (D,): what the last steps earned; elapsed: steps of the episode before this one.
    """
    place = elapsed % len(pending)
    late = pending[place]
    pending[place] = earned
    if is_last:
        for k in range(len(pending)):
            late += pending[k]
            pending[k] = 0.0
    return late


@njit(cache=True, nogil=True)
def pay(rng, deviation, pending, elapsed, is_step, ended, out):
    """Replace what environments (N,) earned by what they are paid, late (pending (N, D)) and with noise of streams rng.

    elapsed (N,): steps of their episodes so far; those that are reset and not stepped are paid nothing.
    """
    for i in range(len(out)):
        if is_step[i]:
            if pending.shape[1] > 0:
                out[i] = paid_late(pending[i], elapsed[i], out[i], ended[i])
                elapsed[i] = 0 if ended[i] else elapsed[i] + 1
            if deviation > 0.0:
                out[i] += deviation * normal_number(rng, i)


@njit(cache=True, nogil=True)
def throw(rng, out):
    """out[i, j] = 0 or 1, a fair coin of stream i for each j."""
    for i in range(len(out)):
        for j in range(out.shape[1]):
            out[i, j] = 1.0 if uniform_number(rng, i) < 0.5 else 0.0


@njit(forceinline=True)
def executed_by_number(chosen, previous, chance, num_actions, u):
    """The executed action, by one uniform number u in [0, 1): chosen, then previous, then uniform.

    chance: as in `Setting`; previous: -1 where there is none, and the chosen action has the weight of the first step.
    """
    if previous < 0:
        if u < chance[3]:
            return chosen
        return min(int((u - chance[3]) / (1.0 - chance[3]) * num_actions), num_actions - 1)
    if u < chance[0]:
        return chosen
    if u < chance[0] + chance[1]:
        return previous
    return min(int((u - chance[0] - chance[1]) / chance[2] * num_actions), num_actions - 1)


@njit(forceinline=True)
def redrawn_action(chosen, previous, chance, num_actions, rng):
    """The executed action as `executed_by_number`, where a uniform one takes a second number of the stream rng (1,)."""
    u = uniform_number(rng, 0)
    if previous < 0:
        return chosen if u < chance[3] else integer_below(rng, 0, num_actions)
    if u < chance[0]:
        return chosen
    return previous if u < chance[0] + chance[1] else integer_below(rng, 0, num_actions)


@njit(forceinline=True)
def executed_action(chosen, previous, chance, num_actions, rng, i):
    """The executed action of stream i; nothing is drawn where the chosen action is always executed."""
    if chance[0] >= 1.0:
        return chosen
    return executed_by_number(chosen, previous, chance, num_actions, uniform_number(rng, i))


@njit(forceinline=True)
def has_no_effect(chance, rng, i):
    """Whether the executed action of stream i changes nothing; nothing is drawn where each has an effect."""
    return chance[4] > 0.0 and uniform_number(rng, i) < chance[4]


@njit(forceinline=True)
def start_by_number(cumulative, u):
    """The number of a start state, by one uniform number u in [0, 1)."""
    k = 0
    while k < len(cumulative) - 1 and u >= cumulative[k]:
        k += 1
    return k


@njit(forceinline=True)
def drawn_start(cumulative, rng, i):
    """The number of a start state; nothing is drawn where there is one."""
    return start_by_number(cumulative, uniform_number(rng, i)) if len(cumulative) > 1 else 0


@njit(cache=True, nogil=True)
def draw_starts(cumulative, rng, mask, out):
    """out[i] = number of a start state, for every i in `mask`."""
    for i in range(len(out)):
        if mask[i]:
            out[i] = drawn_start(cumulative, rng, i)


@njit(cache=True, nogil=True)
def first_outside(actions, num_actions):
    """The first i whose action is none, or -1."""
    for i in range(len(actions)):
        if actions[i] < 0 or actions[i] >= num_actions:
            return i
    return -1


def outcome_on_table(transitions, rewards, s, a, rng, i):
    """(next state, reward, probability) of the outcome of (s, a) that stream i draws; nothing is drawn where there is
    one.
    """


@overload(outcome_on_table)
def _outcome_on_table(transitions, rewards, s, a, rng, i):
    if is_table(transitions):
        return lambda transitions, rewards, s, a, rng, i: (transitions[s, a], rewards[s, a], 1.0)

    def drawn(transitions, rewards, s, a, rng, i):
        k, probability = drawn_outcome(transitions, s, a, uniform_number(rng, i))
        return outcome(transitions, s, a, k)[0], outcome(rewards, s, a, k)[0], probability

    return drawn


@njit(cache=True, nogil=True)
def walk_table(transitions, table_rewards, staying, is_terminal, setting, batch, first, last):
    """One step of environments first .. last - 1 on a tabulated state space; as `step_many`, with indices for
    states.

    transitions: see kernels/outcomes.py; table_rewards: what they pay, (S, A), or with chance as `transitions`, with
    rewards in the place of the successors; staying: (S, A), what an action without effect pays; (0, 0) where all have
    one.
    """
    _, _, chance, limit, mode, first_previous, starts, cumulative = setting
    rng, actions, index, previous, elapsed, ended, rewards, terminated, truncated, executed, final = batch[:11]
    probabilities = batch[12]
    num_actions = size_of(transitions)[1]
    for i in range(first, last):
        rewards[i], terminated[i], truncated[i], executed[i] = 0.0, False, False, -1
        if len(probabilities) > 0:
            probabilities[i] = 1.0
        if ended[i]:
            index[i] = starts[drawn_start(cumulative, rng, i)]
            previous[i], elapsed[i], ended[i] = first_previous, 0, False
            continue
        action = executed_action(actions[i], previous[i], chance, num_actions, rng, i)
        if has_no_effect(chance, rng, i):
            rewards[i], p = staying[index[i], action], chance[4]
        else:
            index[i], rewards[i], p = outcome_on_table(transitions, table_rewards, index[i], action, rng, i)
            p *= 1.0 - chance[4]
        if len(probabilities) > 0:
            probabilities[i] = p
        previous[i] = executed[i] = action
        elapsed[i] += 1
        terminated[i] = is_terminal[index[i]]
        truncated[i] = elapsed[i] >= limit
        ended[i] = terminated[i] or truncated[i]
        if mode == SAME_STEP and ended[i]:
            final[i] = index[i]
            index[i] = starts[drawn_start(cumulative, rng, i)]
            previous[i], elapsed[i], ended[i] = first_previous, 0, False
