"""Many runs' episodes at once: W runs with E copies of their environment each, on the tables of their MDPs.

Every draw is named by its counter (philox.py): the run is the key, and a step of a copy has one block of four words:
a random action; what is executed; which outcome; where the next episode starts. Where actions may have no effect or
pay is noisy there is another block: whether there is an effect; two for the noise. Whether a run explores in a step is
a block of its own, as one draw holds for all copies of a run.
"""

import numpy as np
from numba import njit, uint64
from numba.extending import overload

from pharos.kernels.bellman import reward_at
from pharos.kernels.outcomes import drawn_outcome, outcome, size_of
from pharos.kernels.philox import below, philox, unit
from pharos.kernels.stepping import executed_by_number, normal_by_numbers, paid_late, start_by_number

STEP, EXPLORE, SAMPLE, SHUFFLE, WEIGHTS, ACT = range(6)  # streams of random numbers
DONE, TIMEOUT = 1, 2  # bits of a transition's flags


@njit(cache=True, nogil=True)
def exploring(keys, step, epsilon, is_warming, out):
    """out[i] = whether run i acts at random in a step: while it warms up, and with probability epsilon[i]."""
    for i in range(len(keys)):
        out[i] = is_warming[i] or unit(philox(0, 0, step, EXPLORE, keys[i])[0]) < epsilon[i]


@njit(cache=True, nogil=True)
def anneal(first, last, share, passed, out):
    """out (W,) = what goes from first to last, (W,), over a share (W,) of the training, of which `passed` is over."""
    for i in range(len(out)):
        if passed > share[i]:
            out[i] = last[i]
        else:
            out[i] = first[i] + passed * (last[i] - first[i]) / share[i] if share[i] > 0.0 else first[i]


@njit(cache=True, nogil=True)
def look_up(table, begins, states, out):
    """out (W, pitch): the rows of a table (R, size), one after another, of the states (W, B) of each run.

    begins (W,): the row of each run's first state.
    """
    size = table.shape[1]
    for i in range(states.shape[0]):
        for b in range(states.shape[1]):
            row, target = table[begins[i] + states[i, b]], out[i, b * size : (b + 1) * size]
            for j in range(size):
                target[j] = row[j]


@njit(cache=True, nogil=True)
def look_up_frames(table, begins, histories, piece, out):
    """out (W, pitch): `piece` entries of each frame in turn, the oldest first, of the histories (W, B, k) of each run.

    table (R, length): a row for each frame, of which `piece` is a part; begins (W,): the row of each run's first state.
    """
    length, frames, piece = uint64(table.shape[1]), uint64(histories.shape[2]), uint64(piece)
    for i in range(histories.shape[0]):
        target = out[i]
        for b in range(histories.shape[1]):
            for f in range(frames):
                row = table[begins[i] + histories[i, b, f]]
                at, first = uint64(b) * length * frames + f * piece, uint64(0)
                while first < length:
                    for j in range(piece):
                        target[at + j] = row[first + j]
                    first += piece
                    at += frames * piece


@njit(cache=True, nogil=True)
def write_drawn(raw, places, members, out):
    """out (W, pitch): the entries `places` (size,) of observations, B of each of the runs `members`, one run after
    another in raw (len(members) B, M).
    """
    size, number = len(places), len(raw) // len(members)
    for k in range(len(members)):
        for b in range(number):
            row, target = raw[k * number + b], out[members[k], b * size : (b + 1) * size]
            for j in range(size):
                target[j] = row[places[j]]


@njit(cache=True, nogil=True)
def choose(keys, step, explores, q, actions):
    """actions (W, E): random ones where a run explores, else the first of the best of q (W, E, A)."""
    for i in range(actions.shape[0]):
        for e in range(actions.shape[1]):
            if explores[i]:
                actions[i, e] = below(philox(0, e, step, STEP, keys[i])[0], q.shape[2])
            else:
                best = 0
                for a in range(1, q.shape[2]):
                    if q[i, e, a] > q[i, e, best]:
                        best = a
                actions[i, e] = best


def paid(rewards, s, a, k):
    """The reward of outcome k of (s, a): of the outcome itself, or expected where only that is known."""


@overload(paid)
def _paid(rewards, s, a, k):
    if len(rewards) == 2:  # (table, palette) of expected rewards
        return lambda rewards, s, a, k: reward_at(rewards[0], rewards[1], s, a)
    return lambda rewards, s, a, k: outcome(rewards, s, a, k)[0]


@njit(cache=True, nogil=True)
def start(keys, members, starts, cumulative, state):
    """state (W, E) of the first episodes of the runs `members`."""
    for i in members:
        for e in range(state.shape[1]):
            state[i, e] = starts[start_by_number(cumulative, unit(philox(1, e, 0, STEP, keys[i])[3]))]


@njit(cache=True, nogil=True)
def advance(
    transitions, rewards, staying, terminal, starts, cumulative, members, setting, knobs, actions, episodes, pending,
    transition, counts,
):  # fmt: skip
    """One step of every copy of the runs `members`, which share an MDP; what has ended starts anew.

    transitions: see kernels/outcomes.py; rewards: see `paid`; staying (S, A): what an action without effect pays,
    (0, 0) where all have one; terminal (S,); starts, cumulative: start states and their cumulated probabilities.
    setting: (keys (W,) uint64, step, chances (W, 4), limits (W,), gammas (W,)), as in `stepping.Setting`.
    knobs (W, 3): the probability that an action has no effect, the deviation of the noise of pay, its delay in steps.
    pending (W, E, D): what was earned and is due; see `paid_late`.
    episodes: (state, previous, elapsed (W, E) int64, return, discount (W, E) float64) of the running episodes, and
    (number, sum of returns (W,)) of the finished ones, which this step adds to where `counts` is true.
    transition: (next state (W, E) int64, reward (W, E) float64, flags (W, E) uint8) of this step, written here; the
    reward is what is paid, returns are of what is earned. A transition that ends an episode without a next state has
    the state itself there.
    """
    keys, step, chances, limits, gammas = setting
    state, previous, elapsed, running, discount, finished, returns = episodes
    following, reward, flags = transition
    num_actions = size_of(transitions)[1]
    for i in members:
        chance = (chances[i, 0], chances[i, 1], chances[i, 2], chances[i, 3])
        for e in range(state.shape[1]):
            w = philox(0, e, step, STEP, keys[i])
            s, action = state[i, e], actions[i, e]
            if chance[0] < 1.0 or chance[3] < 1.0:
                action = executed_by_number(action, previous[i, e], chance, num_actions, unit(w[1]))
            lazy, noise, delay = knobs[i, 0], knobs[i, 1], np.int64(knobs[i, 2])
            more = philox(2, e, step, STEP, keys[i]) if lazy > 0.0 or noise > 0.0 else w
            if lazy > 0.0 and unit(more[0]) < lazy:
                t, earned = s, np.float64(staying[s, action])
            else:
                k = drawn_outcome(transitions, s, action, unit(w[2]))[0]
                t = np.int64(outcome(transitions, s, action, k)[0])
                earned = np.float64(paid(rewards, s, action, k))
            ended = t < 0 or terminal[t]
            elapsed[i, e] += 1
            timeout = not ended and elapsed[i, e] >= limits[i]
            following[i, e] = s if t < 0 else t
            flags[i, e] = (DONE if ended or timeout else 0) | (TIMEOUT if timeout else 0)
            reward[i, e] = earned
            if delay > 0:
                reward[i, e] = paid_late(pending[i, e, :delay], elapsed[i, e] - 1, earned, ended or timeout)
            if noise > 0.0:
                reward[i, e] += noise * normal_by_numbers(unit(more[1]), unit(more[2]))
            running[i, e] += discount[i, e] * earned
            discount[i, e] *= gammas[i]
            state[i, e], previous[i, e] = following[i, e], action
            if ended or timeout:
                if counts:
                    finished[i] += 1
                    returns[i] += running[i, e]
                running[i, e], discount[i, e] = 0.0, 1.0
                state[i, e] = starts[start_by_number(cumulative, unit(w[3]))]
                previous[i, e], elapsed[i, e] = -1, 0


@njit(cache=True, nogil=True)
def act(keys, step, scores, actions, log_probabilities):
    """Draw actions (W, E) from the softmax of scores (W, E, A), and the logarithms of their probabilities, float32."""
    num_actions = scores.shape[2]
    for i in range(actions.shape[0]):
        for e in range(actions.shape[1]):
            best = scores[i, e].max()
            total = 0.0
            for a in range(num_actions):
                total += np.exp(np.float64(scores[i, e, a] - best))
            u = unit(philox(0, e, step, STEP, keys[i])[0]) * total
            passed, chosen = 0.0, num_actions - 1
            for a in range(num_actions):
                passed += np.exp(np.float64(scores[i, e, a] - best))
                if u < passed:
                    chosen = a
                    break
            actions[i, e] = chosen
            log_probabilities[i, e] = np.float64(scores[i, e, chosen] - best) - np.log(total)
