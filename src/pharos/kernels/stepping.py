"""Interaction with an MDP in every loop that steps: executed action, laziness, outcome, start, late or noisy reward.

Each option of interaction takes its random numbers as arguments, or from a stream rng[i]: of vector environments (here
and in rules/interaction.py), of Q-learning (below), of the batched engine (batched.py). `walk_table` steps vector
environments on a table. A stream's whole state is one 64-bit word that can be stored and restored.

Q-learning, compiled: in a table (agents/q_learning.py), and in a kernel from drawn transitions, which is the loop of
`hardness.sampled_regret`: Q(c, a) of observation c is q[a, c] if the kernel is a matrix K, else F[c] .
W[a] + q[a, c] for features F and a diagonal.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import float64, types, uint64
from numba.extending import overload

from pharos.kernels.bellman import reward_at, set_has
from pharos.kernels.idealised_network import adam_step, add_error, squared_gradients
from pharos.kernels.kernel_cache import inlined, kernel
from pharos.kernels.outcomes import drawn, drawn_outcome, is_table, outcome, size_of

NEXT_STEP, SAME_STEP, DISABLED = range(3)  # when an environment that has ended is reset


class Setting(NamedTuple):
    """Constants of the interaction of a batch of environments.

    Attributes:
        ranges: (2, D) int64, lowest and highest value of each component; (2, 0) on a table.
        scale: (D,) float64, of the vectors that `step_many` writes.
        chance: (chosen, previous, uniform, first_chosen, lazy), weights of the executed action, the fourth that of the
            chosen one if there is no previous action; and the probability that it has no effect.
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


class EnvironmentBatch(NamedTuple):
    """The arrays of N environments that a step reads and writes.

    Attributes:
        rng: (N,) uint64, a stream of random numbers each.
        actions: (N,) int64, chosen.
        states: (N, D) int64, or (N,) indices on a table.
        previous, elapsed, ended: (N,) the previous action, steps of the episode so far, whether it is over.
        rewards, terminated, truncated, executed: (N,) of this step; executed is -1 after a reset.
        final: as states; the last state of an episode that was over and reset in the same step.
        vector: (N, D) float32, the states as vectors; (0, D) if they are not wanted.
        probabilities: (N,) float64, of the outcomes that were drawn, 1 after a reset; (0,) if the rules have no
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


@inlined
def uniform_number(rng, i):
    """A uniform number in [0, 1) of stream i: SplitMix64 (Steele, Lea and Flood 2014) on the counter rng[i]."""
    rng[i] += uint64(0x9E3779B97F4A7C15)
    z = rng[i]
    z = (z ^ (z >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> uint64(27))) * uint64(0x94D049BB133111EB)
    z ^= z >> uint64(31)
    return float64(z >> uint64(11)) * 2.0**-53


@kernel
def next_number(rng):
    """The next number of the only stream of rng (1,)."""
    return uniform_number(rng, 0)


@inlined
def integer_below(rng, i, n):
    """A uniform integer in [0, n) of stream i."""
    return min(int(uniform_number(rng, i) * n), n - 1)


@inlined
def normal_by_numbers(u, v):
    """A standard normal number from two uniform ones, u > 0 (Box and Muller 1958)."""
    return np.sqrt(-2.0 * np.log(u)) * np.cos(2.0 * np.pi * v)


@inlined
def normal_number(rng, i):
    """A standard normal number of stream i."""
    return normal_by_numbers(1.0 - uniform_number(rng, i), uniform_number(rng, i))


@inlined
def delayed_reward(pending, elapsed, earned, is_last):
    """Reward paid at a step if rewards come D steps late, and all at once at the end of an episode.

    pending (D,): rewards of the last steps, not paid yet; elapsed: steps of the episode before this one; earned: the
    reward of this step.
    """
    # a ring: the reward of D steps ago leaves, the reward of this step comes in
    slot = elapsed % len(pending)
    total = pending[slot]
    pending[slot] = earned
    if is_last:
        for k in range(len(pending)):
            total += pending[k]
            pending[k] = 0.0
    return total


@kernel
def modify_rewards(rng, deviation, pending, elapsed, is_step, ended, rewards):
    """Replace the earned rewards (N,) of environments by the paid ones: late (pending (N, D)), and with noise.

    elapsed (N,): steps of their episodes so far; those that are reset and not stepped are paid nothing.
    """
    for i in range(len(rewards)):
        if is_step[i]:
            if pending.shape[1] > 0:
                rewards[i] = delayed_reward(pending[i], elapsed[i], rewards[i], ended[i])
                elapsed[i] = 0 if ended[i] else elapsed[i] + 1
            if deviation > 0.0:
                rewards[i] += deviation * normal_number(rng, i)


@kernel
def flip_coins(rng, out):
    """out[i, j] = 0 or 1, a fair coin of stream i for each j."""
    for i in range(len(out)):
        for j in range(out.shape[1]):
            out[i, j] = 1.0 if uniform_number(rng, i) < 0.5 else 0.0


@inlined
def executed_by_number(choice, previous, chance, num_actions, u):
    """The executed action, by one uniform number u in [0, 1): the choice, then the previous action, then a uniform one.

    chance: as in `Setting`; previous: -1 if there is none, and the choice has the weight of the first step.
    """
    if previous < 0:
        if u < chance[3]:
            return choice
        return min(int((u - chance[3]) / (1.0 - chance[3]) * num_actions), num_actions - 1)
    if u < chance[0]:
        return choice
    if u < chance[0] + chance[1]:
        return previous
    return min(int((u - chance[0] - chance[1]) / chance[2] * num_actions), num_actions - 1)


@inlined
def executed_of_set(choice, previous, chance, is_available, u):
    """`executed_by_number` in a state with some actions only, is_available (A,) bool.

    A choice that does not exist acts as the first action that does; a previous action that does not counts as none.
    """
    number, first = 0, -1
    for a in range(len(is_available)):
        if is_available[a]:
            number += 1
            first = a if first < 0 else first
    action = choice if is_available[choice] else first
    if previous < 0 or not is_available[previous]:
        if u < chance[3]:
            return action
        share = (u - chance[3]) / (1.0 - chance[3])
    else:
        if u < chance[0]:
            return action
        if u < chance[0] + chance[1]:
            return previous
        share = (u - chance[0] - chance[1]) / chance[2]
    left = min(int(share * number), number - 1)
    for a in range(len(is_available)):
        if is_available[a]:
            if left == 0:
                return a
            left -= 1
    return action


@kernel
def execute_in_sets(rng, choices, previous, ended, chance, sets, executed):
    """executed[i] = the executed action of stream i, for choices (N,) in states with the sets (N, A) bool.

    Nothing is drawn for an episode that has ended: its step only starts another.
    """
    for i in range(len(choices)):
        executed[i] = choices[i]
        if not ended[i]:
            executed[i] = executed_of_set(choices[i], previous[i], chance, sets[i], uniform_number(rng, i))


@inlined
def redrawn_action(choice, previous, chance, num_actions, rng, s):
    """The executed action in state s, by numbers of the stream rng (1,): a uniform action takes a second one.

    Otherwise as `executed_by_number`; behind `chance` there may be sets, as in kernels/bellman.py.
    """
    u = uniform_number(rng, 0)
    if previous < 0 or not set_has(chance, s, previous):
        return choice if u < chance[3] else action_of_set(chance, num_actions, rng, s)
    if u < chance[0]:
        return choice
    return previous if u < chance[0] + chance[1] else action_of_set(chance, num_actions, rng, s)


def action_of_set(chance, num_actions, rng, s):
    """A uniform one of the actions that are available in state s, by the stream rng (1,)."""


@overload(action_of_set, jit_options={"forceinline": True})
def _action_of_set(chance, num_actions, rng, s):
    if isinstance(chance, types.UniTuple):
        return lambda chance, num_actions, rng, s: integer_below(rng, 0, num_actions)

    last = len(chance) - 1

    def drawn_of_set(chance, num_actions, rng, s):
        sets = chance[last]
        left, action = integer_below(rng, 0, sets[s].sum()), 0
        while left > 0 or not sets[s, action]:
            left -= sets[s, action]
            action += 1
        return action

    return drawn_of_set


@inlined
def executed_action(choice, previous, chance, num_actions, rng, i):
    """The executed action of stream i; nothing is drawn if the choice is always executed."""
    if chance[0] >= 1.0:
        return choice
    return executed_by_number(choice, previous, chance, num_actions, uniform_number(rng, i))


@inlined
def has_no_effect(chance, rng, i):
    """Whether the executed action of stream i changes nothing; nothing is drawn if every action has an effect."""
    return chance[4] > 0.0 and uniform_number(rng, i) < chance[4]


@inlined
def start_by_number(cumulative, u):
    """The number of a start state, by one uniform number u in [0, 1) and the cumulated probabilities."""
    k = 0
    while k < len(cumulative) - 1 and u >= cumulative[k]:
        k += 1
    return k


@inlined
def drawn_start(cumulative, rng, i):
    """The number of a start state; nothing is drawn if there is one."""
    return start_by_number(cumulative, uniform_number(rng, i)) if len(cumulative) > 1 else 0


@kernel
def draw_starts(cumulative, rng, mask, out):
    """out[i] = number of a start state, for every i in `mask`."""
    for i in range(len(out)):
        if mask[i]:
            out[i] = drawn_start(cumulative, rng, i)


@kernel
def first_outside(actions, num_actions):
    """The first i whose action is not in [0, num_actions), or -1."""
    for i in range(len(actions)):
        if actions[i] < 0 or actions[i] >= num_actions:
            return i
    return -1


@kernel
def execute_choices(policy, indices, numbers, chance, rewards, discount, episodes):
    """One step of the episodes `alive` (N,): the executed actions become their `previous`, what these pay is added up.

    policy: (M, A), probabilities; indices: (N,), rows of the episodes there; numbers: (u, v, w), (N,) each: u chooses,
    v decides between the choice, the previous action and w, a uniform one; chance: (chosen, previous, uniform,
    first_chosen); rewards: (table, palette); episodes: (alive; states, previous (A if there is none), returns: of all).
    """
    u, v, w = numbers
    table, palette = rewards
    alive, states, previous, returns = episodes
    num_actions = policy.shape[1]
    for k in range(len(alive)):
        i, choice, sum_of = alive[k], 0, policy[indices[k], 0]
        while sum_of < u[k] and choice < num_actions - 1:
            choice += 1
            sum_of += policy[indices[k], choice]
        b = previous[i]
        if v[k] < (chance[3] if b == num_actions else chance[0]):
            action = choice
        else:
            action = b if b < num_actions and v[k] < chance[0] + chance[1] else w[k]
        returns[i] += discount * reward_at(table, palette, states[i], action)
        previous[i] = action


def outcome_on_table(transitions, rewards, s, a, rng, i):
    """(next state, reward, probability) of the outcome of (s, a) that stream i draws; nothing is drawn if there is
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


@kernel
def walk_table(transitions, table_rewards, staying, is_terminal, setting, batch, first, last):
    """One step of environments first .. last - 1 on a tabulated state space: `step_many`, with indices for states.

    transitions: see kernels/outcomes.py; table_rewards: their rewards, (S, A), or with chance as `transitions`, with
    rewards in the place of the successors; staying: (S, A), the reward of an action without effect; (0, 0) if all
    have one.
    """
    _, _, chance, limit, mode, first_previous, starts, cumulative = setting
    rng, actions, index, previous, elapsed, ended, rewards, terminated, truncated, executed, final = batch[:11]
    probabilities = batch[12]
    num_actions = size_of(transitions)[1]
    for i in range(first, last):
        rewards[i], terminated[i], truncated[i], executed[i] = 0.0, False, False, -1
        if len(probabilities) > 0:
            probabilities[i] = 1.0
        # the episode ended on the last step: this one only starts another
        if ended[i]:
            index[i] = starts[drawn_start(cumulative, rng, i)]
            previous[i], elapsed[i], ended[i] = first_previous, 0, False
            continue
        # executed action, outcome and reward
        action = executed_action(actions[i], previous[i], chance, num_actions, rng, i)
        if has_no_effect(chance, rng, i):
            rewards[i], p = staying[index[i], action], chance[4]
        else:
            index[i], rewards[i], p = outcome_on_table(transitions, table_rewards, index[i], action, rng, i)
            p *= 1.0 - chance[4]
        if len(probabilities) > 0:
            probabilities[i] = p
        # bookkeeping of the episode; both ways to end it
        previous[i] = executed[i] = action
        elapsed[i] += 1
        terminated[i] = is_terminal[index[i]]
        truncated[i] = elapsed[i] >= limit
        ended[i] = terminated[i] or truncated[i]
        # reset in the same step; `final` keeps the last state
        if mode == SAME_STEP and ended[i]:
            final[i] = index[i]
            index[i] = starts[drawn_start(cumulative, rng, i)]
            previous[i], elapsed[i], ended[i] = first_previous, 0, False


# Q-learning -----------------------------------------------------------------------------------------------------------


def _next_state(transitions, s, a, word):
    """A next state of (s, a), -1 for the end; draws a number only if there are several outcomes."""


@overload(_next_state)
def _next_state_of(transitions, s, a, word):
    if is_table(transitions):
        return lambda transitions, s, a, word: np.int64(transitions[s, a])
    return lambda transitions, s, a, word: drawn(transitions, s, a, uniform_number(word, 0))


class Episodes(NamedTuple):
    """Start, course and end of the episodes of an MDP.

    Attributes:
        terminal: (S,) bool.
        starts, cumulative: (K,), start states and their cumulated probabilities.
        chance: (chosen, previous, uniform, first_chosen), with sets behind if some actions are not available.
        limit: steps of an episode.
    """

    terminal: np.ndarray
    starts: np.ndarray
    cumulative: np.ndarray
    chance: tuple[Any, ...]
    limit: int


@kernel(makes_arrays=False)
def q_learning(transitions, rewards, episodes, schedule, learner, noise, steps):
    """`steps` steps of Watkins' Q-learning; everything that changes is in the arrays, so that it goes on from them.

    transitions: see kernels/outcomes.py; rewards: (table, palette); episodes: see `Episodes`, with sets of states.
    schedule: (learning rate, exponent of visits or 0, gamma, first epsilon, last epsilon, steps of exploration,
        exponential?, gamma of returns).
    learner: (q, visits (R, A): values and number of updates, R = S, or S (A + 1) with rows s (A + 1) + b if the agent
    observes the previous action b (A: none); cursor: int64 (state or -1, previous action, steps in the episode, steps
    in all, episodes); sums: float64 (return of this episode, its discount, sum of finished returns); word: uint64
    (1,)).
    noise: (standard deviation of the noise of paid rewards; pending: float64 (steps by which they are late,), what
    is due; word of the noise: uint64 (1,)). Returns are of earned rewards.
    """
    table, palette = rewards
    terminal, starts, cumulative, chance, limit = episodes
    q, visits, cursor, sums, word = learner
    deviation, pending, noise_word = noise
    num_states, num_actions = size_of(transitions)
    rate, exponent, gamma, first_epsilon, last_epsilon, exploration, exponential, measure_gamma = schedule
    observes_previous = len(q) > num_states
    for _ in range(steps):
        # start an episode
        if cursor[0] < 0:
            cursor[0] = starts[start_by_number(cumulative, uniform_number(word, 0))]
            cursor[1] = num_actions
            cursor[2] = 0
            sums[0] = 0.0
            sums[1] = 1.0
        s, b = cursor[0], cursor[1]
        row = s * (num_actions + 1) + b if observes_previous else s
        # epsilon of this step: linear or exponential from first to last
        share = min(1.0, cursor[3] / exploration) if exploration > 0 else 1.0
        if exponential > 0.0:
            epsilon = first_epsilon * (last_epsilon / first_epsilon) ** share
        else:
            epsilon = first_epsilon + share * (last_epsilon - first_epsilon)
        # epsilon-greedy action
        if uniform_number(word, 0) < epsilon:
            action = action_of_set(chance, num_actions, word, s)
        else:  # greedy, ties at random
            best, ties, action = -np.inf, 1, 0
            for a in range(num_actions):
                if not set_has(chance, s, a):
                    continue
                if a == 0 or q[row, a] > best:
                    best, ties, action = q[row, a], 1, a
                elif q[row, a] == best:
                    ties += 1
                    if uniform_number(word, 0) * ties < 1.0:
                        action = a
        # one step of the MDP
        executed = redrawn_action(action, b if b < num_actions else -1, chance, num_actions, word, s)
        reward = reward_at(table, palette, s, executed)
        t = _next_state(transitions, s, executed, word)
        ended = t < 0 or terminal[t]
        # greedy value of the next state, 0 at an end
        value = 0.0
        if not ended:
            next_row = t * (num_actions + 1) + executed if observes_previous else t
            value = -np.inf
            for a in range(num_actions):
                if set_has(chance, t, a):
                    value = max(value, q[next_row, a]) if a else q[next_row, a]
        # the reward that the agent gets, late and noisy
        paid_reward = reward
        if len(pending) > 0:
            paid_reward = delayed_reward(pending, cursor[2], reward, ended or cursor[2] + 1 >= limit)
        if deviation > 0.0:
            paid_reward += deviation * normal_number(noise_word, 0)
        # update Q of the chosen action, which may not be the executed one
        visits[row, action] += 1
        alpha = rate if exponent == 0.0 else max(rate, visits[row, action] ** -exponent)
        q[row, action] += alpha * (paid_reward + gamma * value - q[row, action])
        # returns of earned rewards, and the cursor of the walk
        sums[0] += sums[1] * reward
        sums[1] *= measure_gamma
        cursor[0] = t
        cursor[1] = executed
        cursor[2] += 1
        cursor[3] += 1
        if ended or cursor[2] >= limit:
            sums[2] += sums[0]
            cursor[4] += 1
            cursor[0] = -1


@kernel(fastmath={"reassoc", "contract"})
def _product(x, y):
    """x . y, summed in the order of the machine's vectors."""
    total = 0.0
    for i in range(len(x)):
        total += x[i] * y[i]
    return total


def _q_value(kernel, learned, c, a):
    """Q(c, a), of the tabular part and the features; of a network or its target: of the array of its outputs."""


@overload(_q_value, jit_options={"forceinline": True})
def _q_value_of(kernel, learned, c, a):
    if isinstance(learned, types.Array):
        return lambda kernel, learned, c, a: learned[a, c]
    if isinstance(learned, types.NamedTuple):
        return lambda kernel, learned, c, a: learned.outputs[a, c]

    def of_kernel(kernel, learned, c, a):
        _, features, _ = kernel
        q, weights = learned
        return q[a, c] + _product(features[c], weights[a]) if features.shape[1] > 0 else q[a, c]

    return of_kernel


@inlined
def _likeness(kernel, c, d):
    """K(c, d), the kernel of two observations."""
    matrix, features, diagonal = kernel
    if len(matrix) > 0:
        return np.float64(matrix[c, d])
    own = np.float64(diagonal[c]) if c == d else 0.0
    return own + _product(features[c], features[d])


@inlined
def _gradient_step(kernel, learned, c, a, step):
    """Q(., a) += step K(., c): a gradient step on Q(c, a)."""
    matrix, features, diagonal = kernel
    q, weights = learned
    if len(matrix) > 0:
        for i in range(q.shape[1]):
            q[a, i] += step * matrix[c, i]
    else:
        q[a, c] += step * diagonal[c]
        for i in range(features.shape[1]):
            weights[a, i] += step * features[c, i]


@kernel
def kernel_values(kernel, learned, out):
    """out (C, A) = Q of all observations and actions."""
    for c in range(out.shape[0]):
        for a in range(out.shape[1]):
            out[c, a] = _q_value(kernel, learned, c, a)


class Walk(NamedTuple):
    """The walk of a learner, which goes on from these arrays.

    Attributes:
        memory: (observations (M,), actions (M,), next observations (M,), -1 for an end, rewards (M,)), a ring.
        visits: (C, A) numbers of choices.
        cursor: int64 (state or -1, previous action or -1, steps in the episode, steps in all).
        word: uint64 (1,).
        noise: (standard deviation of the noise of rewards, its random word uint64 (1,)).
        minibatch: (int64 (B,), float64 (B,)), room for the places in the ring of a minibatch and its errors.
    """

    memory: tuple[np.ndarray, ...]
    visits: np.ndarray
    cursor: np.ndarray
    word: np.ndarray
    noise: tuple[Any, ...]
    minibatch: tuple[np.ndarray, ...]


@inlined
def outcome_of_row(offsets, cumulative, row, word):
    """The number of an outcome of a row, drawn from the stream word (1,); nothing is drawn if there is one."""
    k, last = offsets[row], offsets[row + 1] - 1
    if k < last:
        u = uniform_number(word, 0)
        while k < last and u >= cumulative[k]:
            k += 1
    return k


@kernel(makes_arrays=False)
def learn(outcomes, group, episodes, values, walk, schedule, steps):
    """`steps` steps of an epsilon-greedy walk, with gradient steps on minibatches of its transitions.

    outcomes: (offsets (S A + 1,), states (N,), -1 for the end; rewards (N,); cumulative probabilities of a row (N,)).
    group: (S,) the observation of each state; episodes: see `Episodes`, with sets of observations (C, A).
    values: (kernel, learnt, target). kernel: (K (C, C) or (0, 0), F (C, m), diagonal (C,)); learnt, target: each
    (q (A, C), weights (A, m)), of which target stays as it is. Or of a network: (constants of Adam as for
    `idealised_network.adam_step` and the length to which gradients are clipped; the network; target outputs (A, C)).
    walk: see `Walk`.
    schedule: (gamma, first epsilon, last epsilon, steps of exploration, first step of learning, gradient steps in so
    many steps: two numbers, largest step that does not overshoot; a minibatch takes that, or the largest that it bears
    itself; temporal differences are cut at the last number: 1 for the Huber loss, infinity for the squared one).
    """
    offsets, next_states, outcome_rewards, cumulative_probabilities = outcomes
    terminal, starts, cumulative, chance, limit = episodes
    kernel, learned, _ = values
    memory, visits, cursor, word, noise, _ = walk
    num_actions = visits.shape[1]
    gamma, first_epsilon, last_epsilon, exploration, begin, gradient_steps, period, largest_step, largest_error = (
        schedule
    )
    for _ in range(steps):
        # start an episode
        if cursor[0] < 0:
            cursor[0] = starts[start_by_number(cumulative, uniform_number(word, 0))]
            cursor[1] = -1
            cursor[2] = 0
        s, t = cursor[0], cursor[3]
        c = group[s]
        # act, epsilon-greedy; before learning begins, at random
        share = min(1.0, t / exploration) if exploration > 0 else 1.0
        epsilon = first_epsilon + share * (last_epsilon - first_epsilon) if t >= begin else 1.0
        action = _act(kernel, learned, chance, c, epsilon, word, num_actions)
        visits[c, action] += 1
        executed = redrawn_action(action, cursor[1], chance, num_actions, word, c)
        k = outcome_of_row(offsets, cumulative_probabilities, s * num_actions + executed, word)
        next_state = next_states[k]
        ended = next_state < 0 or terminal[next_state]
        # remember the transition, and go on
        _remember(memory, noise, t, (c, action, -1 if ended else group[next_state], outcome_rewards[k]))
        cursor[0], cursor[1] = next_state, executed
        cursor[2] += 1
        cursor[3] += 1
        if ended or cursor[2] >= limit:
            cursor[0] = -1
        if t < begin:
            continue
        # learn: the gradient steps that fall due between this step and the next
        num_gradient_steps = (t + 1 - begin) * gradient_steps // period - (t - begin) * gradient_steps // period
        for _ in range(num_gradient_steps):
            _learn_minibatch(values, walk, chance, (gamma, largest_step, largest_error), min(t + 1, len(memory[0])))


@kernel(makes_arrays=False, forceinline=True)
def _act(kernel, learned, chance, c, epsilon, word, num_actions):
    """An epsilon-greedy action for observation c, ties at random."""
    if uniform_number(word, 0) < epsilon:
        return action_of_set(chance, num_actions, word, c)
    best, ties, action = -np.inf, 1, 0
    for a in range(num_actions):
        if not set_has(chance, c, a):
            continue
        q = _q_value(kernel, learned, c, a)
        if a == 0 or q > best:
            best, ties, action = q, 1, a
        elif q == best:
            ties += 1
            if uniform_number(word, 0) * ties < 1.0:
                action = a
    return action


@kernel(makes_arrays=False, forceinline=True)
def _remember(memory, noise, t, transition):
    """Store the transition of step t in the ring, with a noisy reward."""
    observations, actions, next_observations, rewards = memory
    deviation, noise_word = noise
    slot = t % len(observations)
    observations[slot], actions[slot], next_observations[slot], rewards[slot] = transition
    if deviation > 0.0:
        rewards[slot] += deviation * normal_number(noise_word, 0)


@kernel(makes_arrays=False, forceinline=True)
def _learn_minibatch(values, walk, chance, limits, num_stored):
    """A gradient step on drawn transitions of the ring, the largest that they bear.

    limits: (gamma, the largest step, where temporal differences are cut).
    """
    gamma, largest_step, largest_error = limits
    kernel, learned, target = values
    memory, visits, _, word, _, (batch, errors) = walk
    observations, actions, next_observations, rewards = memory
    num_actions, size = visits.shape[1], len(batch)
    # draw a minibatch; its temporal differences by the target
    for i in range(size):
        j = integer_below(word, 0, num_stored)
        batch[i] = j
        y = rewards[j]
        if next_observations[j] >= 0:
            d, best = next_observations[j], -np.inf
            for a in range(num_actions):
                if set_has(chance, d, a):
                    q = _q_value(kernel, target, d, a)
                    best = max(best, q) if a else q
            y += gamma * best
        error = y - _q_value(kernel, learned, observations[j], actions[j])
        errors[i] = min(max(error, -largest_error), largest_error)
    _step(kernel, learned, (observations, actions, batch, errors), largest_step)


def _step(kernel, learned, drawn_errors, largest_step):
    """A gradient step on the errors of a minibatch: in a kernel the largest that it bears, at most `largest_step`; of a
    network the next one of Adam, whose constants are in the place of the kernel.

    drawn_errors: (observations, actions, places of the minibatch in both, its temporal differences).
    """


@overload(_step)
def _step_of(kernel, learned, drawn_errors, largest_step):
    if isinstance(learned, types.NamedTuple):

        def of_network(kernel, learned, drawn_errors, largest_step):
            observations, actions, batch, errors = drawn_errors
            for i in range(len(batch)):
                add_error(learned, actions[batch[i]], observations[batch[i]], errors[i] / len(batch))
            of_last, of_beneath = squared_gradients(learned)
            optimizer, most = kernel
            share = min(1.0, most / (np.sqrt(of_last + of_beneath) + 1e-6))
            adam_step(learned, of_last, of_beneath, share, optimizer)

        return of_network

    def of_kernel(kernel, learned, drawn_errors, largest_step):
        observations, actions, batch, errors = drawn_errors
        size = len(batch)
        # largest step of this minibatch that does not overshoot, by the row sums of its kernel (Gershgorin)
        bound = 0.0
        for i in range(size):
            total = 0.0
            for j in range(size):
                if actions[batch[i]] == actions[batch[j]]:
                    total += abs(_likeness(kernel, observations[batch[i]], observations[batch[j]]))
            bound = max(bound, total / size)
        if bound <= 0.0:
            return
        # move Q along the kernel of each transition
        step = min(largest_step, 1.0 / bound) / size
        for i in range(size):
            _gradient_step(kernel, learned, observations[batch[i]], actions[batch[i]], step * errors[i])

    return of_kernel
