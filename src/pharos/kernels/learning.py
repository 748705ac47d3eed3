"""Tabular Q-learning on the transitions of an MDP: the loop that agents/q_learning.py describes, compiled.

Random numbers: the stream of stepping.py, whose whole state is one 64-bit word that can be stored and restored.
"""

import numpy as np
from numba import njit
from numba.extending import overload

from pharos.kernels.bellman import reward_at
from pharos.kernels.outcomes import drawn, is_table, size_of
from pharos.kernels.stepping import (
    integer_below,
    normal_number,
    paid_late,
    redrawn_action,
    start_by_number,
    uniform_number,
)


def _next_state(transitions, s, a, word):
    """A next state of (s, a), -1 for the end; draws a number only where there are several outcomes."""


@overload(_next_state)
def _next_state_of(transitions, s, a, word):
    if is_table(transitions):
        return lambda transitions, s, a, word: np.int64(transitions[s, a])
    return lambda transitions, s, a, word: drawn(transitions, s, a, uniform_number(word, 0))


@njit(cache=True, nogil=True)
def q_learning(
    transitions,
    table,
    palette,
    terminal,
    starts,
    cumulative,
    chance,
    limit,
    schedule,
    q,
    visits,
    place,
    sums,
    word,
    noise,
    pending,
    noise_word,
    steps,
):
    """`steps` steps of Watkins' Q-learning; everything that changes is in the arrays, so that it goes on from them.

    transitions: see kernels/outcomes.py; table, palette: rewards; starts (K,), cumulative (K,): start states and their
    cumulated probabilities;
    chance: (chosen, previous, uniform, first_chosen); limit: steps of an episode; q, visits (R, A): values and number
    of updates, R = S, or S (A + 1) with rows s (A + 1) + b where the previous action b (A: none) is seen.
    schedule: (learning rate, exponent of visits or 0, gamma, first epsilon, last epsilon, steps of exploration,
        exponential?).
    place: int64 (state or -1, previous action, steps in the episode, steps in all, episodes); sums: float64 (return of
    this episode, its discount, sum of finished returns); word: uint64 (1,).
    noise: standard deviation of the noise of what is paid; pending: float64 (steps by which it is late,) what is due;
    noise_word: uint64 (1,). Returns are of what is earned.
    """
    num_states, num_actions = size_of(transitions)
    rate, exponent, gamma, first_epsilon, last_epsilon, exploration, exponential, measure_gamma = schedule
    sees_previous = len(q) > num_states
    for _ in range(steps):
        if place[0] < 0:
            place[0] = starts[start_by_number(cumulative, uniform_number(word, 0))]
            place[1] = num_actions
            place[2] = 0
            sums[0] = 0.0
            sums[1] = 1.0
        s, b = place[0], place[1]
        row = s * (num_actions + 1) + b if sees_previous else s
        share = min(1.0, place[3] / exploration) if exploration > 0 else 1.0
        if exponential > 0.0:
            epsilon = first_epsilon * (last_epsilon / first_epsilon) ** share
        else:
            epsilon = first_epsilon + share * (last_epsilon - first_epsilon)
        if uniform_number(word, 0) < epsilon:
            action = integer_below(word, 0, num_actions)
        else:  # greedy, ties at random
            best, ties, action = q[row, 0], 1, 0
            for a in range(1, num_actions):
                if q[row, a] > best:
                    best, ties, action = q[row, a], 1, a
                elif q[row, a] == best:
                    ties += 1
                    if uniform_number(word, 0) * ties < 1.0:
                        action = a
        executed = redrawn_action(action, b if b < num_actions else -1, chance, num_actions, word)
        reward = reward_at(table, palette, s, executed)
        t = _next_state(transitions, s, executed, word)
        ended = t < 0 or terminal[t]
        value = 0.0
        if not ended:
            after = t * (num_actions + 1) + executed if sees_previous else t
            value = q[after, 0]
            for a in range(1, num_actions):
                value = max(value, q[after, a])
        paid = reward
        if len(pending) > 0:
            paid = paid_late(pending, place[2], reward, ended or place[2] + 1 >= limit)
        if noise > 0.0:
            paid += noise * normal_number(noise_word, 0)
        visits[row, action] += 1
        alpha = rate if exponent == 0.0 else max(rate, visits[row, action] ** -exponent)
        q[row, action] += alpha * (paid + gamma * value - q[row, action])
        sums[0] += sums[1] * reward
        sums[1] *= measure_gamma
        place[0] = t
        place[1] = executed
        place[2] += 1
        place[3] += 1
        if ended or place[2] >= limit:
            sums[2] += sums[0]
            place[4] += 1
            place[0] = -1
