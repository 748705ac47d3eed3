"""Q-learning, compiled: in a table (agents/q_learning.py), and in a kernel from drawn transitions (hardness).

Random numbers: the stream of stepping.py, whose whole state is one 64-bit word that can be stored and restored.

The loop of `hardness.sampled_regret`: Q(c, a) of observation c is q[a, c] where the kernel is a matrix K, else F[c] .
W[a] + q[a, c] for features F and a diagonal.
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


@njit(forceinline=True)
def _value(kernel, learnt, c, a):
    """Q(c, a)."""
    _, features, _ = kernel
    q, weights = learnt
    total = q[a, c]
    for i in range(features.shape[1]):
        total += features[c, i] * weights[a, i]
    return total


@njit(forceinline=True)
def _likeness(kernel, c, d):
    """K(c, d)."""
    matrix, features, diagonal = kernel
    if len(matrix) > 0:
        return np.float64(matrix[c, d])
    total = np.float64(diagonal[c]) if c == d else 0.0
    for i in range(features.shape[1]):
        total += features[c, i] * features[d, i]
    return total


@njit(forceinline=True)
def _add(kernel, learnt, c, a, step):
    """Q(., a) += step K(., c)."""
    matrix, features, diagonal = kernel
    q, weights = learnt
    if len(matrix) > 0:
        for i in range(q.shape[1]):
            q[a, i] += step * matrix[c, i]
    else:
        q[a, c] += step * diagonal[c]
        for i in range(features.shape[1]):
            weights[a, i] += step * features[c, i]


@njit(cache=True, nogil=True)
def values(kernel, learnt, out):
    """out (C, A) = Q."""
    for c in range(out.shape[0]):
        for a in range(out.shape[1]):
            out[c, a] = _value(kernel, learnt, c, a)


@njit(cache=True, nogil=True)
def learn(
    outcomes, terminal, group, starts, cumulative, chance, limit, kernel, learnt, target, memory, visits, place, word,
    noise, schedule, largest_step, steps,
):  # fmt: skip
    """`steps` steps of an epsilon-greedy walk, with gradient steps on minibatches of what it has met.

    outcomes: (offsets (S A + 1,), states (N,), -1 for the end; rewards (N,); cumulative probabilities of a row (N,)).
    terminal: (S,); group: (S,) the observation of each state; starts, cumulative (K,): of episodes; chance: (chosen,
    previous, uniform, first_chosen); limit: steps of an episode.
    kernel: (K (C, C) or (0, 0), F (C, m), diagonal (C,)); learnt, target: each (q (A, C), weights (A, m)), of which
    target stays as it is. memory: (observations (M,), actions (M,), next observations (M,), -1 for an end, rewards
    (M,)), a ring; visits: (C, A) numbers of choices.
    place: int64 (state or -1, previous action or -1, steps in the episode, steps in all); word, noise_word: uint64 (1,)
    noise: (standard deviation of what is paid, its random word); schedule: (gamma, first epsilon, last epsilon, steps
    of exploration, first step of learning, gradient steps in so many steps: two numbers, size of a minibatch).
    largest_step: the largest stable step; a minibatch takes that, or the largest that it bears itself.
    """
    offsets, next_states, pay, likely = outcomes
    met, acted, after, paid = memory
    deviation, noise_word = noise
    gamma, first_epsilon, last_epsilon, exploration, begin, gradient_steps, period, size = schedule
    num_actions, capacity = visits.shape[1], len(met)
    batch, errors = np.zeros(size, np.int64), np.zeros(size)
    for _ in range(steps):
        if place[0] < 0:
            place[0] = starts[start_by_number(cumulative, uniform_number(word, 0))]
            place[1] = -1
            place[2] = 0
        s, t = place[0], place[3]
        c = group[s]
        share = min(1.0, t / exploration) if exploration > 0 else 1.0
        epsilon = first_epsilon + share * (last_epsilon - first_epsilon) if t >= begin else 1.0
        action = 0
        if uniform_number(word, 0) < epsilon:
            action = integer_below(word, 0, num_actions)
        else:  # greedy, ties at random
            best, ties = _value(kernel, learnt, c, 0), 1
            for a in range(1, num_actions):
                q = _value(kernel, learnt, c, a)
                if q > best:
                    best, ties, action = q, 1, a
                elif q == best:
                    ties += 1
                    if uniform_number(word, 0) * ties < 1.0:
                        action = a
        executed = redrawn_action(action, place[1], chance, num_actions, word)
        row = s * num_actions + executed
        k, last = offsets[row], offsets[row + 1] - 1
        if k < last:
            u = uniform_number(word, 0)
            while k < last and u >= likely[k]:
                k += 1
        new = next_states[k]
        ended = new < 0 or terminal[new]
        slot = t % capacity
        met[slot], acted[slot], after[slot] = c, action, -1 if ended else group[new]
        paid[slot] = pay[k]
        if deviation > 0.0:
            paid[slot] += deviation * normal_number(noise_word, 0)
        visits[c, action] += 1
        place[0], place[1] = new, executed
        place[2] += 1
        place[3] += 1
        if ended or place[2] >= limit:
            place[0] = -1
        if t < begin:
            continue
        held = min(t + 1, capacity)
        due = (t + 1 - begin) * gradient_steps // period - (t - begin) * gradient_steps // period
        for _ in range(due):
            for i in range(size):
                j = integer_below(word, 0, held)
                batch[i] = j
                y = paid[j]
                if after[j] >= 0:
                    best = _value(kernel, target, after[j], 0)
                    for a in range(1, num_actions):
                        best = max(best, _value(kernel, target, after[j], a))
                    y += gamma * best
                errors[i] = y - _value(kernel, learnt, met[j], acted[j])
            bound = 0.0
            for i in range(size):
                total = 0.0
                for j in range(size):
                    if acted[batch[i]] == acted[batch[j]]:
                        total += abs(_likeness(kernel, met[batch[i]], met[batch[j]]))
                bound = max(bound, total / size)
            if bound <= 0.0:
                continue
            step = min(largest_step, 1.0 / bound) / size
            for i in range(size):
                _add(kernel, learnt, met[batch[i]], acted[batch[i]], step * errors[i])
