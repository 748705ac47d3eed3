"""Learning of W runs at once: minibatches of a replay memory, losses with their gradients, Adam with clipping.

Sources: Mnih et al. (2015); van Hasselt et al. (2016), double; Kingma and Ba (2015). Each function does for every run
what Stable-Baselines3 does for one; docs/agents.md says where the arithmetic differs.
"""

import numpy as np
from numba import float32, njit, uint64

from pharos.kernels.batched_worlds import DONE, SAMPLE, TIMEOUT
from pharos.kernels.philox import below, philox


@njit(cache=True, nogil=True)
def sample(keys, step, draw, place, filled, gammas, num_steps, memory, batch):
    """Draw a minibatch of each run from its replay memory, uniformly, with returns of `num_steps` steps.

    place: the row that is written next; filled: the number of rows that are; gammas (W,).
    memory: (state, next state (W, R, E), action (W, R, E), reward (W, R, E) float32, flags (W, R, E)).
    batch: (state, next state (W, B), action (W, B), reward (W, B) float32, discount (W, B) float32), written here:
    discount is what the value of the next state is multiplied by: gamma^n, 0 where the episode ended there. A return
    stops at the end of an episode, at a time limit, and at the newest transition.
    """
    state, following, action, reward, flags = memory
    states, nexts, actions, rewards, discounts = batch
    size, copies = state.shape[1], state.shape[2]
    last = (place - 1) % size
    for i in range(states.shape[0]):
        for b in range(states.shape[1]):
            w = philox(b, draw, step, SAMPLE, keys[i])
            row, e = below(w[0], filled), below(w[1], copies)
            at, rewards[i, b], discounts[i, b] = _steps_from(i, row, e, last, gammas[i], num_steps, reward, flags)
            states[i, b], actions[i, b], nexts[i, b] = state[i, row, e], action[i, row, e], following[i, at, e]


@njit(cache=True, nogil=True)
def sample_histories(keys, step, draw, place, filled, gammas, num_steps, memory, batch):
    """`sample` of the `filled` newest rows, with states and next states (W, B, k): the last k of the episode.

    They are read from the rows before; the first state of an episode stands for those before it. Rows that were never
    written have the flag DONE.
    """
    state, following, action, reward, flags = memory
    states, nexts, actions, rewards, discounts = batch
    size, copies, frames = state.shape[1], state.shape[2], states.shape[2]
    first, last = (place - filled) % size, (place - 1) % size
    for i in range(states.shape[0]):
        for b in range(states.shape[1]):
            w = philox(b, draw, step, SAMPLE, keys[i])
            row, e = (first + below(w[0], filled)) % size, below(w[1], copies)
            at, rewards[i, b], discounts[i, b] = _steps_from(i, row, e, last, gammas[i], num_steps, reward, flags)
            actions[i, b] = action[i, row, e]
            _last_states(i, row, e, state, flags, states[i, b])
            _last_states(i, at, e, state, flags, nexts[i, b])
            for f in range(1, frames):
                nexts[i, b, f - 1] = nexts[i, b, f]
            nexts[i, b, frames - 1] = following[i, at, e]


@njit(cache=True, nogil=True)
def _steps_from(i, row, e, last, gamma, num_steps, reward, flags):
    """(the row where they end, return, discount of what follows) of at most `num_steps` steps from a row."""
    size = reward.shape[1]
    total, factor, at = 0.0, 1.0, row
    for n in range(num_steps):
        at = (row + n) % size
        total += factor * reward[i, at, e]
        factor *= gamma
        if flags[i, at, e] & DONE or at == last:
            break
    ended = flags[i, at, e] & DONE and not flags[i, at, e] & TIMEOUT
    return at, float32(total), float32(0.0) if ended else float32(factor)


@njit(cache=True, nogil=True)
def _last_states(i, row, e, state, flags, out):
    """out (k,) = the state of a row and those of the k - 1 before it, the oldest first."""
    size = state.shape[1]
    for f in range(len(out) - 1, -1, -1):
        out[f] = state[i, row, e]
        before = row - 1 if row > 0 else size - 1
        if not flags[i, before, e] & DONE:
            row = before


@njit(cache=True, nogil=True)
def huber(q, q_next, q_choice, actions, rewards, discounts, dq, loss):
    """The smooth L1 loss of DQN, (W,), and its gradient dq (W, B, A).

    q: (W, B, A) of the states; q_next: of the next states, by the target network; q_choice: what the next action is
    the best of: q_next itself, or by the online network (double).
    """
    num_rows, num_actions = q.shape[1], q.shape[2]
    share = float32(1.0) / float32(num_rows)
    for i in range(q.shape[0]):
        total = 0.0
        for b in range(num_rows):
            best = 0
            for a in range(num_actions):
                dq[i, b, a] = 0.0
                if q_choice[i, b, a] > q_choice[i, b, best]:
                    best = a
            target = rewards[i, b] + discounts[i, b] * q_next[i, b, best]
            difference = q[i, b, actions[i, b]] - target
            size = abs(difference)
            total += 0.5 * size * size if size < 1.0 else size - 0.5
            dq[i, b, actions[i, b]] = share * min(max(difference, float32(-1.0)), float32(1.0))
        loss[i] = total / num_rows


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _squares(x):
    total = float32(0.0)
    for j in range(len(x)):
        total += x[j] * x[j]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _adam(parameters, gradient, mean, square, scale, step, eps):
    first, second, keep = float32(0.1), float32(0.001), float32(0.999)
    for j in range(len(parameters)):
        g = scale * gradient[j]
        m = mean[j] + first * (g - mean[j])
        v = keep * square[j] + second * g * g
        mean[j], square[j] = m, v
        parameters[j] -= step * m / (np.sqrt(v) + eps)


@njit(cache=True, nogil=True)
def adam(parameters, gradients, means, squares, counts, is_active, rates, max_norms, eps):
    """A step of Adam (betas 0.9 and 0.999) for the runs that are active, by gradients clipped to a norm.

    parameters, gradients, means, squares: (W, P) float32; counts (W,): steps so far; rates, max_norms (W,).
    """
    for i in range(len(parameters)):
        if is_active[i]:
            counts[i] += 1
            norm = np.sqrt(np.float64(_squares(gradients[i])))
            scale = float32(min(1.0, max_norms[i] / (norm + 1e-6)))
            root = np.sqrt(1.0 - 0.999 ** counts[i])  # what divides the root of the squares multiplies the rest
            step = float32(rates[i] / (1.0 - 0.9 ** counts[i]) * root)
            _adam(parameters[i], gradients[i], means[i], squares[i], scale, step, float32(eps * root))


@njit(cache=True, nogil=True, fastmath={"contract"})
def linear_row(parameters, weight, bias, x, is_relu, y):
    """y (W, out) = x (W, in) w + b, at least 0 where `is_relu`; the weights of inputs that are 0 are not read.

    parameters (W, P) float32: w begins at `weight`, in rows of `out`, and b at `bias`.
    """
    outputs = y.shape[1]
    total = np.empty(outputs, np.float32)
    for i in range(len(parameters)):
        row = parameters[i]
        for j in range(outputs):
            total[j] = row[uint64(bias + j)]
        for k in range(x.shape[1]):
            factor = x[i, k]
            if factor != 0.0:
                first = uint64(weight + k * outputs)
                for j in range(outputs):
                    total[j] += factor * row[first + uint64(j)]
        for j in range(outputs):
            y[i, j] = max(total[j], float32(0.0)) if is_relu else total[j]
