"""Q-learning in a kernel from drawn transitions: the loop of `hardness.sampled_regret`, compiled.

Q(c, a) of observation c is q[a, c] where the kernel is a matrix K, else F[c] . W[a] + q[a, c] for features F and a
diagonal. Random numbers: the stream of stepping.py.
"""

import numpy as np
from numba import njit

from pharos.kernels.stepping import integer_below, normal_number, redrawn_action, start_by_number, uniform_number


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
