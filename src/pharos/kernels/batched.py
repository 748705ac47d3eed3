"""W runs at once: their random numbers, episodes on the tables of their MDPs, and minibatches of DQN and PPO.

Random numbers are counted: Philox4x32-10 (Salmon, Moraes, Dror and Shaw, SC 2011), four words of 32 bits a call. The
same counter and key give the same words, in whatever order they are drawn. A key names a run, a counter names a draw:
(draw, copy, step, stream).

Each run has E copies of its environment. Every draw is named by its counter: the run is the key, and a step of a copy
has one block of four words: a random action, the executed action, the outcome, the start of the next episode. If
actions may have no effect or rewards are noisy there is another block: whether there is an effect, and two words for
the noise. Whether a run explores in a step is a block of its own, as one draw holds for all copies of a run.

DQN: minibatches of a replay memory, losses with their gradients, Adam with clipping. Sources: Mnih et al. (2015); van
Hasselt et al. (2016), double; Kingma and Ba (2015).

PPO: advantages, minibatches, the clipped loss with its gradients. Sources: Schulman et al. (2016), generalised
advantages; Schulman et al. (2017). Each function does for every run what Stable-Baselines3 does for one. docs/agents.md
lists the differences in arithmetic.
"""

import numpy as np
from numba import float32, uint32, uint64
from numba.extending import overload

from pharos.kernels.bellman import reward_at
from pharos.kernels.kernel_cache import inlined, kernel
from pharos.kernels.outcomes import drawn_outcome, outcome, size_of
from pharos.kernels.stepping import (
    delayed_reward,
    executed_by_number,
    executed_of_set,
    normal_by_numbers,
    start_by_number,
)

# Random numbers -------------------------------------------------------------------------------------------------------


MULTIPLIER_0, MULTIPLIER_1 = 0xD2511F53, 0xCD9E8D57
WEYL_0, WEYL_1 = 0x9E3779B9, 0xBB67AE85
CIPHER_ROUNDS = 10
MASK = 0xFFFFFFFF
UINT32_UNIT = 2.0**-32


@inlined
def philox(c0, c1, c2, c3, key):
    """Four words (uint64 below 2^32) of the counter (c0, c1, c2, c3) and a key of 64 bits, its low word first."""
    c0, c1, c2, c3 = uint64(c0), uint64(c1), uint64(c2), uint64(c3)
    k0, k1 = uint64(key) & uint64(MASK), uint64(key) >> uint64(32)
    for _ in range(CIPHER_ROUNDS):
        low, high = uint64(MULTIPLIER_0) * c0, uint64(MULTIPLIER_1) * c2
        c0, c1, c2, c3 = (
            (high >> uint64(32)) ^ c1 ^ k0,
            high & uint64(MASK),
            (low >> uint64(32)) ^ c3 ^ k1,
            low & uint64(MASK),
        )
        k0, k1 = (k0 + uint64(WEYL_0)) & uint64(MASK), (k1 + uint64(WEYL_1)) & uint64(MASK)
    return c0, c1, c2, c3


@inlined
def unit(word):
    """A word as a number in (0, 1): the middle of its interval of length 2^-32."""
    return (np.float64(word) + 0.5) * UINT32_UNIT


@inlined
def below(word, n):
    """A word as an integer in [0, n), n < 2^32."""
    return np.int64((uint64(word) * uint64(n)) >> uint64(32))


@kernel
def words(keys, stream, step, out):
    """out[i, j] = the four words of draw j of copy 0 at a step, in a stream, for key i. keys (N,), out (N, M, 4)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            w = philox(j, 0, step, stream, keys[i])
            for k in range(4):
                out[i, j, k] = uint32(w[k])


STEP, EXPLORE, SAMPLE, SHUFFLE, WEIGHTS, ACT = range(6)  # streams of random numbers
ENDED, TIMEOUT = 1, 2  # bits of a transition's flags


@kernel
def exploring(keys, step, epsilon, is_warming, out):
    """out[i] = whether run i acts at random in a step: while it warms up, and with probability epsilon[i]."""
    for i in range(len(keys)):
        out[i] = is_warming[i] or unit(philox(0, 0, step, EXPLORE, keys[i])[0]) < epsilon[i]


@kernel
def anneal(first, last, share, elapsed, out):
    """out (W,) = linear schedules from first to last (W,) over a share (W,) of the training, at `elapsed`."""
    for i in range(len(out)):
        if elapsed > share[i]:
            out[i] = last[i]
        else:
            out[i] = first[i] + elapsed * (last[i] - first[i]) / share[i] if share[i] > 0.0 else first[i]


@kernel
def look_up_rows(table, begins, states, out):
    """out (W, pitch): the rows of a table (R, size), one after another, of the states (W, B) of each run.

    begins (W,): the row of each run's first state.
    """
    size = table.shape[1]
    for i in range(states.shape[0]):
        for b in range(states.shape[1]):
            row, target = table[begins[i] + states[i, b]], out[i, b * size : (b + 1) * size]
            for j in range(size):
                target[j] = row[j]


@kernel
def choose(keys, step, explores, q, actions):
    """Epsilon-greedy actions (W, E): random ones if a run explores, else the first of the best of q (W, E, A)."""
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


@kernel
def choose_of_sets(keys, step, explores, q, sets, actions):
    """`choose` among actions that are available, sets (W, E, A) bool. Others have a q below all of them."""
    for i in range(actions.shape[0]):
        for e in range(actions.shape[1]):
            best, left = -1, -1
            if explores[i]:
                left = below(philox(0, e, step, STEP, keys[i])[0], sets[i, e].sum())
            for a in range(q.shape[2]):
                if not sets[i, e, a]:
                    continue
                if explores[i]:
                    if left == 0:
                        best = a
                    left -= 1
                elif best < 0 or q[i, e, a] > q[i, e, best]:
                    best = a
            actions[i, e] = best


def outcome_reward(rewards, s, a, k):
    """The reward of outcome k of (s, a), or the expected reward of (s, a) if only that is known."""


@overload(outcome_reward)
def _outcome_reward(rewards, s, a, k):
    if len(rewards) == 2:  # (table, palette) of expected rewards
        return lambda rewards, s, a, k: reward_at(rewards[0], rewards[1], s, a)
    return lambda rewards, s, a, k: outcome(rewards, s, a, k)[0]


@kernel
def start(keys, runs, starts, cumulative, state):
    """Write the start states of the first episodes of `runs` to state (W, E)."""
    for i in runs:
        for e in range(state.shape[1]):
            state[i, e] = starts[start_by_number(cumulative, unit(philox(1, e, 0, STEP, keys[i])[3]))]


@kernel
def execute_runs_in_sets(keys, step, chances, sets, previous, actions, executed):
    """executed (W, E): what is executed of chosen actions, in states with the sets (W, E, A) bool.

    Draws what `advance` would draw. chances (W, 4): as in `stepping.Setting`. previous (W, E): -1 if there is none.
    """
    for i in range(actions.shape[0]):
        chance = (chances[i, 0], chances[i, 1], chances[i, 2], chances[i, 3])
        for e in range(actions.shape[1]):
            executed[i, e] = actions[i, e]
            if chance[0] < 1.0 or chance[3] < 1.0:
                u = unit(philox(0, e, step, STEP, keys[i])[1])
                executed[i, e] = executed_of_set(actions[i, e], previous[i, e], chance, sets[i, e], u)


@kernel(makes_arrays=False)
def advance(world, setting, actions, episodes, transition, counts):
    """One step of every copy of `runs`, which share an MDP. Episodes that have ended start anew.

    world: (transitions, rewards, staying, terminal, starts, cumulative, runs). See kernels/outcomes.py for transitions
    and `outcome_reward` for rewards. staying (S, A): the reward of an action without effect, (0, 0) if all have one.
    terminal: (S,). starts, cumulative: start states and their cumulated probabilities.
    setting: (keys (W,) uint64, step, chances (W, 4), limits (W,), gammas (W,), knobs), the first five as in
    `stepping.Setting`. knobs (W, 4): the probability that an action has no effect, the deviation of the noise of
    rewards, their delay in steps, and what they are divided by.
    episodes: (state, previous, elapsed (W, E) int64, return, discount (W, E) float64) of the running episodes,
    (number, sum of returns (W,)) of the finished ones, which this step adds to if `counts` is true, and pending
    (W, E, D), rewards earned and not paid yet, see `delayed_reward`.
    transition: (next state (W, E) int64, reward (W, E) float64, flags (W, E) uint8) of this step, written here. The
    reward is the paid one, returns are of earned rewards. A transition that ends an episode without a next state has
    the state itself there.
    """
    transitions, rewards, staying, terminal, starts, cumulative, runs = world
    keys, step, chances, limits, gammas, knobs = setting
    state, previous, elapsed, running, discount, finished, returns, pending = episodes
    next_states, reward, flags = transition
    num_actions = size_of(transitions)[1]
    for i in runs:
        chance = (chances[i, 0], chances[i, 1], chances[i, 2], chances[i, 3])
        for e in range(state.shape[1]):
            # executed action, by the chances of the run
            words_of_step = philox(0, e, step, STEP, keys[i])
            s, action = state[i, e], actions[i, e]
            if chance[0] < 1.0 or chance[3] < 1.0:
                action = executed_by_number(action, previous[i, e], chance, num_actions, unit(words_of_step[1]))
            lazy, noise, delay = knobs[i, 0], knobs[i, 1], np.int64(knobs[i, 2])
            effect_words = philox(2, e, step, STEP, keys[i]) if lazy > 0.0 or noise > 0.0 else words_of_step
            # next state and earned reward: no effect, or an outcome
            if lazy > 0.0 and unit(effect_words[0]) < lazy:
                t, earned = s, np.float64(staying[s, action])
            else:
                k = drawn_outcome(transitions, s, action, unit(words_of_step[2]))[0]
                t = np.int64(outcome(transitions, s, action, k)[0])
                earned = np.float64(outcome_reward(rewards, s, action, k))
            # the transition, with the paid reward
            ended = t < 0 or terminal[t]
            elapsed[i, e] += 1
            timeout = not ended and elapsed[i, e] >= limits[i]
            next_states[i, e] = s if t < 0 else t
            flags[i, e] = (ENDED if ended or timeout else 0) | (TIMEOUT if timeout else 0)
            reward[i, e] = earned / knobs[i, 3]
            if delay > 0:
                reward[i, e] = delayed_reward(pending[i, e, :delay], elapsed[i, e] - 1, reward[i, e], ended or timeout)
            if noise > 0.0:
                reward[i, e] += noise * normal_by_numbers(unit(effect_words[1]), unit(effect_words[2]))
            # the running episode; at its end count it and start another
            running[i, e] += discount[i, e] * earned
            discount[i, e] *= gammas[i]
            state[i, e], previous[i, e] = next_states[i, e], action
            if ended or timeout:
                if counts:
                    finished[i] += 1
                    returns[i] += running[i, e]
                running[i, e], discount[i, e] = 0.0, 1.0
                state[i, e] = starts[start_by_number(cumulative, unit(words_of_step[3]))]
                previous[i, e], elapsed[i, e] = -1, 0


@kernel
def act(keys, step, scores, actions, log_probabilities):
    """Draw actions (W, E) from the softmax of scores (W, E, A). log_probabilities: their logarithms, float32."""
    num_actions = scores.shape[2]
    for i in range(actions.shape[0]):
        for e in range(actions.shape[1]):
            # mass of the softmax, up to a factor; subtracting the best score avoids overflow
            best = scores[i, e].max()
            total, last = 0.0, 0
            for a in range(num_actions):
                mass = np.exp(np.float64(scores[i, e, a] - best))
                total += mass
                last = a if mass > 0.0 else last
            # the first action whose cumulative mass exceeds a uniform share of it
            u = unit(philox(0, e, step, STEP, keys[i])[0]) * total
            cumulative, action = 0.0, last
            for a in range(num_actions):
                cumulative += np.exp(np.float64(scores[i, e, a] - best))
                if u < cumulative:
                    action = a
                    break
            actions[i, e] = action
            log_probabilities[i, e] = np.float64(scores[i, e, action] - best) - np.log(total)


@kernel(makes_arrays=False)
def sample(keys, draw, rows, gammas, num_steps, memory, batch):
    """Draw a minibatch of each run from its replay memory, uniformly, with returns of `num_steps` steps.

    draw: (step, number of the draw in it). rows: (the one that is written next, how many are written). gammas: (W,).
    memory: (state, next state (W, R, E), action (W, R, E), reward (W, R, E) float32, flags (W, R, E)).
    batch: (state, next state (W, B), action (W, B), reward (W, B) float32, discount (W, B) float32), written here:
    discount is the factor of the value of the next state: gamma^n, 0 if the episode ended there. A return stops at
    the end of an episode, at a time limit, and at the newest transition.
    """
    state, next_state, action, _, _ = memory
    states, next_states, actions, rewards, discounts = batch
    size, copies = state.shape[1], state.shape[2]
    next_row, filled = rows
    last = (next_row - 1) % size
    for i in range(states.shape[0]):
        for b in range(states.shape[1]):
            w = philox(b, draw[1], draw[0], SAMPLE, keys[i])
            row, e = below(w[0], filled), below(w[1], copies)
            at, rewards[i, b], discounts[i, b] = _steps_from(i, row, e, last, gammas[i], num_steps, memory)
            states[i, b], actions[i, b], next_states[i, b] = state[i, row, e], action[i, row, e], next_state[i, at, e]


@kernel(makes_arrays=False)
def sample_histories(keys, draw, rows, gammas, num_steps, memory, batch):
    """`sample` from the newest rows, with states and next states (W, B, k): the last k of the episode.

    They are read from the rows before. The first state of an episode stands for those before it. Rows that were never
    written have the flag ENDED.
    """
    state, next_state, action, _, flags = memory
    states, next_states, actions, rewards, discounts = batch
    size, copies, frames = state.shape[1], state.shape[2], states.shape[2]
    next_row, filled = rows
    first, last = (next_row - filled) % size, (next_row - 1) % size
    for i in range(states.shape[0]):
        for b in range(states.shape[1]):
            w = philox(b, draw[1], draw[0], SAMPLE, keys[i])
            row, e = (first + below(w[0], filled)) % size, below(w[1], copies)
            at, rewards[i, b], discounts[i, b] = _steps_from(i, row, e, last, gammas[i], num_steps, memory)
            actions[i, b] = action[i, row, e]
            # the next history is the history of the last row, moved on by its next state
            _last_states(i, row, e, state, flags, states[i, b])
            _last_states(i, at, e, state, flags, next_states[i, b])
            for f in range(1, frames):
                next_states[i, b, f - 1] = next_states[i, b, f]
            next_states[i, b, frames - 1] = next_state[i, at, e]


@kernel(makes_arrays=False)
def _steps_from(i, row, e, last, gamma, num_steps, memory):
    """(last row, return, discount of the value after it) of at most `num_steps` steps from a row."""
    _, _, _, reward, flags = memory
    size = reward.shape[1]
    total, factor, at = 0.0, 1.0, row
    for n in range(num_steps):
        at = (row + n) % size
        total += factor * reward[i, at, e]
        factor *= gamma
        if flags[i, at, e] & ENDED or at == last:
            break
    ended = flags[i, at, e] & ENDED and not flags[i, at, e] & TIMEOUT
    return at, float32(total), float32(0.0) if ended else float32(factor)


@kernel(makes_arrays=False)
def _last_states(i, row, e, state, flags, out):
    """out (k,) = the state of a row and of up to k - 1 rows before it in its episode, the oldest first."""
    size = state.shape[1]
    for f in range(len(out) - 1, -1, -1):
        out[f] = state[i, row, e]
        before = row - 1 if row > 0 else size - 1
        if not flags[i, before, e] & ENDED:
            row = before


@kernel(makes_arrays=False)
def huber(q, q_next, q_choice, minibatch, dq, loss):
    """The smooth L1 loss of DQN, (W,), and its gradient dq (W, B, A).

    q: (W, B, A) of the states. q_next: of the next states, by the target network. q_choice: what the next action is
    the best of: q_next itself, or by the online network (double). minibatch: (actions, rewards, discounts), (W, B).
    """
    actions, rewards, discounts = minibatch
    num_rows, num_actions = q.shape[1], q.shape[2]
    share = float32(1.0) / float32(num_rows)
    for i in range(q.shape[0]):
        total = 0.0
        for b in range(num_rows):
            # temporal difference: q of the action less reward + discount * best next q
            best = 0
            for a in range(num_actions):
                dq[i, b, a] = 0.0
                if q_choice[i, b, a] > q_choice[i, b, best]:
                    best = a
            target = rewards[i, b] + discounts[i, b] * q_next[i, b, best]
            difference = q[i, b, actions[i, b]] - target
            # smooth L1 loss, and its gradient at the action of the transition
            size = abs(difference)
            total += 0.5 * size * size if size < 1.0 else size - 0.5
            dq[i, b, actions[i, b]] = share * min(max(difference, float32(-1.0)), float32(1.0))
        loss[i] = total / num_rows


@kernel(fastmath={"reassoc", "contract"})
def _squares(x):
    """Sum of squares of x (P,) float32."""
    total = float32(0.0)
    for j in range(len(x)):
        total += x[j] * x[j]
    return total


@kernel(error_model="numpy")
def _adam(parameters, gradient, mean, square, scale, step, eps):
    """One step of Adam for one run, in place. `scale` clips the gradient, `step` and `eps` include bias corrections."""
    first, second, keep = float32(0.1), float32(0.001), float32(0.999)
    for j in range(len(parameters)):
        g = scale * gradient[j]
        m = mean[j] + first * (g - mean[j])
        v = keep * square[j] + second * g * g
        mean[j], square[j] = m, v
        parameters[j] -= step * m / (np.sqrt(v) + eps)


@kernel(makes_arrays=False)
def adam(state, counts, is_active, rates, max_norms, eps):
    """One step of Adam (betas 0.9 and 0.999) for the active runs, by gradients clipped to a norm.

    state: (parameters, gradients, means, squares), (W, P) float32. counts (W,): steps so far. rates, max_norms: (W,).
    """
    parameters, gradients, means, squares = state
    for i in range(len(parameters)):
        if is_active[i]:
            counts[i] += 1
            norm = np.sqrt(np.float64(_squares(gradients[i])))
            scale = float32(min(1.0, max_norms[i] / (norm + 1e-6)))
            root = np.sqrt(1.0 - 0.999 ** counts[i])  # bias correction of the squares, moved to step and eps
            step = float32(rates[i] / (1.0 - 0.9 ** counts[i]) * root)
            _adam(parameters[i], gradients[i], means[i], squares[i], scale, step, float32(eps * root))


@kernel(fastmath={"contract"})
def linear_row(parameters, weight, bias, x, is_relu, y):
    """y (W, out) = x (W, in) w + b, at least 0 if `is_relu`. The weights of inputs that are 0 are not read.

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


@kernel(makes_arrays=False)
def advantages(rollout, last_values, ends, gammas, lambdas, out):
    """out (W, T, E) = generalised advantages of rollouts of T steps.

    rollout: (rewards, values, begins), (W, T, E) float32: begins is 1 if a step is the first of an episode.
    last_values (W, E): of the states after the rollout. ends (W, E): whether the last step ended an episode.
    gammas, lambdas: (W,).
    """
    rewards, values, begins = rollout
    num_steps, copies = rewards.shape[1], rewards.shape[2]
    for i in range(rewards.shape[0]):
        gamma, both = float32(gammas[i]), float32(gammas[i] * lambdas[i])
        for e in range(copies):
            advantage = float32(0.0)
            goes_on, next_value = float32(0.0 if ends[i, e] else 1.0), last_values[i, e]
            # backwards: temporal difference of each step, plus the discounted advantage after it
            for t in range(num_steps - 1, -1, -1):
                delta = rewards[i, t, e] + gamma * next_value * goes_on - values[i, t, e]
                advantage = delta + both * goes_on * advantage
                out[i, t, e] = advantage
                goes_on, next_value = float32(1.0) - begins[i, t, e], values[i, t, e]


@kernel
def shuffle(keys, step, draw, order):
    """order (W, M) = a random permutation of 0 .. M-1 for each run (Fisher and Yates)."""
    number = order.shape[1]
    for i in range(order.shape[0]):
        for j in range(number):
            order[i, j] = j
        for j in range(number - 1, 0, -1):
            other = below(philox(j, draw, step, SHUFFLE, keys[i])[0], j + 1)
            order[i, j], order[i, other] = order[i, other], order[i, j]


@kernel
def gather(order, first, sources, targets):
    """targets (W, B) of five arrays = the entries order[:, first : first + B] of sources (W, M).

    The arrays: states, or histories with one more axis, actions, logarithms of probabilities, advantages, returns.
    """
    for i in range(targets[0].shape[0]):
        for b in range(targets[0].shape[1]):
            at = order[i, first + b]
            targets[0][i, b] = sources[0][i, at]
            targets[1][i, b] = sources[1][i, at]
            targets[2][i, b] = sources[2][i, at]
            targets[3][i, b] = sources[3][i, at]
            targets[4][i, b] = sources[4][i, at]


@kernel
def normalize_advantages(advantages):
    """Normalise advantages (W, B) in place: less the mean of each run, by its standard deviation + 1e-8, for B >= 2."""
    number = advantages.shape[1]
    for i in range(advantages.shape[0]):
        mean, squares = 0.0, 0.0
        for b in range(number):
            mean += advantages[i, b]
        mean /= number
        for b in range(number):
            squares += (advantages[i, b] - mean) ** 2
        scale = np.sqrt(squares / (number - 1)) + 1e-8
        for b in range(number):
            advantages[i, b] = (advantages[i, b] - mean) / scale


@kernel
def clipped_loss(scores, values, minibatch, weights, gradients, loss, kl):
    """The loss of PPO (W,), its gradients, and the approximate divergence from the old policy (W,).

    scores (W, B, A), values (W, B, 1) float32. gradients: of both, of the same shapes.
    minibatch: (actions, old logarithms of probabilities, advantages, returns), (W, B) each.
    weights: (clip range, of the entropy, of the value), (W,) each.
    """
    clip_ranges, entropy_weights, value_weights = weights
    dscores, dvalues = gradients
    actions, old, advantage, returns = minibatch
    number, num_actions = scores.shape[1], scores.shape[2]
    log_p = np.empty(num_actions)
    for i in range(scores.shape[0]):
        total, divergence = 0.0, 0.0
        low, high = 1.0 - clip_ranges[i], 1.0 + clip_ranges[i]
        for b in range(number):
            # log-softmax of the scores, and its entropy
            best, mass = scores[i, b].max(), 0.0
            for a in range(num_actions):
                log_p[a] = scores[i, b, a] - best
                mass += np.exp(log_p[a])
            mass, entropy = np.log(mass), 0.0
            for a in range(num_actions):
                log_p[a] -= mass
                entropy -= np.exp(log_p[a]) * log_p[a]
            # ratio to the old policy, clipped objective, error of the value
            gained = log_p[actions[i, b]] - old[i, b]
            ratio = np.exp(gained)
            divergence += (ratio - 1.0) - gained
            free = advantage[i, b] * ratio
            bound = advantage[i, b] * min(max(ratio, low), high)
            error = values[i, b, 0] - returns[i, b]
            total += -min(free, bound) - entropy_weights[i] * entropy + value_weights[i] * error * error
            # gradients by value and scores; none through the ratio if clipping is active
            of_log_p = -free / number if free <= bound else 0.0
            dvalues[i, b, 0] = value_weights[i] * 2.0 * error / number
            for a in range(num_actions):
                p = np.exp(log_p[a])
                of_entropy = entropy_weights[i] * p * (log_p[a] + entropy) / number
                dscores[i, b, a] = of_log_p * ((1.0 if a == actions[i, b] else 0.0) - p) + of_entropy
        loss[i], kl[i] = total / number, divergence / number
