"""PPO in idealised networks (kernels/idealised_network.py): rollouts of several environments, and learning from them.

Schulman et al. (2017), as Stable-Baselines3 has it: generalised advantages, minibatches of shuffled steps, advantages
standardised in each, clipped ratios, an entropy bonus, one clipping of the gradient of actor and critic together.
"""

from typing import Any, NamedTuple

import numpy as np

from pharos.kernels.bellman import set_has
from pharos.kernels.idealised_network import adam_step, add_error, squared_gradients
from pharos.kernels.kernel_cache import inlined, kernel
from pharos.kernels.stepping import (
    integer_below,
    normal_number,
    outcome_of_row,
    redrawn_action,
    start_by_number,
    uniform_number,
)


class Rollout(NamedTuple):
    """Walks of E environments, which go on from one rollout of T steps to the next, and what the last one met.

    Attributes:
        states, previous, elapsed: (E,) int64: state or -1 before an episode, executed action or -1, steps of it.
        word, noise: uint64 (1,); (standard deviation of the noise of rewards, its random word uint64 (1,)).
        observations, actions: (E T,) int64, environment by environment. log_probabilities, advantages, returns: (E T,).
        order: (E T,) int64, room for a permutation.
        values, continues, rewards: (T + 1,), room for one environment.
    """

    states: np.ndarray
    previous: np.ndarray
    elapsed: np.ndarray
    word: np.ndarray
    noise: tuple[Any, ...]
    observations: np.ndarray
    actions: np.ndarray
    log_probabilities: np.ndarray
    advantages: np.ndarray
    returns: np.ndarray
    order: np.ndarray
    values: np.ndarray
    continues: np.ndarray
    rewards: np.ndarray


@inlined
def _log_sum(logits, chance, c):
    """The logarithm of the sum of exp(logits[a, c]) over the available actions of observation c."""
    largest, total = -np.inf, 0.0
    for a in range(len(logits)):
        if set_has(chance, c, a):
            largest = max(largest, logits[a, c])
    for a in range(len(logits)):
        if set_has(chance, c, a):
            total += np.exp(logits[a, c] - largest)
    return largest + np.log(total)


@kernel(makes_arrays=False)
def play(outcomes, group, episodes, actor, critic, rollout, discounts):
    """T steps of each environment, and their advantages. Arguments as for `stepping.learn`.

    actor: of A outputs, logits; critic: of one. discounts: (gamma, lambda). An episode that its limit cuts short pays
    the value of its last state, too.
    """
    offsets, next_states, outcome_rewards, cumulative_probabilities = outcomes
    terminal, starts, cumulative, chance, limit = episodes
    gamma, share = discounts
    logits, value_of = actor.outputs, critic.outputs[0]
    word, (deviation, noise_word) = rollout.word, rollout.noise
    num_actions, count = len(logits), len(rollout.states)
    length = len(rollout.observations) // count
    values, continues, rewards = rollout.values, rollout.continues, rollout.rewards
    for e in range(count):
        for t in range(length):
            if rollout.states[e] < 0:
                rollout.states[e] = starts[start_by_number(cumulative, uniform_number(word, 0))]
                rollout.previous[e], rollout.elapsed[e] = -1, 0
            s = rollout.states[e]
            c = group[s]
            # draw an action of the policy
            normaliser, u, action, passed = _log_sum(logits, chance, c), uniform_number(word, 0), -1, 0.0
            for a in range(num_actions):
                if set_has(chance, c, a) and (action < 0 or passed <= u):
                    action = a
                    passed += np.exp(logits[a, c] - normaliser)
            i = e * length + t
            rollout.observations[i], rollout.actions[i] = c, action
            rollout.log_probabilities[i], values[t] = logits[action, c] - normaliser, value_of[c]
            # step
            executed = redrawn_action(action, rollout.previous[e], chance, num_actions, word, c)
            k = outcome_of_row(offsets, cumulative_probabilities, s * num_actions + executed, word)
            state = next_states[k]
            rewards[t] = outcome_rewards[k] + (deviation * normal_number(noise_word, 0) if deviation > 0.0 else 0.0)
            rollout.elapsed[e] += 1
            ended = state < 0 or terminal[state]
            is_cut = not ended and rollout.elapsed[e] >= limit
            if is_cut:
                rewards[t] += gamma * value_of[group[state]]
            continues[t] = 0.0 if ended or is_cut else 1.0
            rollout.states[e], rollout.previous[e] = -1 if ended or is_cut else state, executed
        # advantages, from the last step on
        values[length] = value_of[group[rollout.states[e]]] if rollout.states[e] >= 0 else 0.0
        advantage = 0.0
        for t in range(length - 1, -1, -1):
            error = rewards[t] + gamma * continues[t] * values[t + 1] - values[t]
            advantage = error + gamma * share * continues[t] * advantage
            rollout.advantages[e * length + t] = advantage
            rollout.returns[e * length + t] = advantage + values[t]


@kernel(makes_arrays=False)
def learn_from_rollout(chance, actor, critic, rollout, settings, of_actor, of_critic):
    """Learn from a rollout. chance: as for `play`.

    settings: (epochs, size of a minibatch, clip range, weight of the entropy, of the values' loss, length to which the
    gradient of both networks is clipped). of_actor, of_critic: constants of `adam_step`.
    """
    epochs, size, clip_range, entropy_weight, value_weight, most = settings
    count, order = len(rollout.observations), rollout.order
    for _ in range(epochs):
        for i in range(count):
            order[i] = i
        for i in range(count - 1, 0, -1):
            j = integer_below(rollout.word, 0, i + 1)
            order[i], order[j] = order[j], order[i]
        for begin in range(0, count, size):
            end = min(begin + size, count)
            _errors(chance, actor, critic, rollout, (begin, end), (clip_range, entropy_weight, value_weight))
            actor_last, actor_beneath = squared_gradients(actor)
            critic_last, critic_beneath = squared_gradients(critic)
            length = np.sqrt(actor_last + actor_beneath + critic_last + critic_beneath)
            share = min(1.0, most / (length + 1e-6))
            adam_step(actor, actor_last, actor_beneath, share, of_actor)
            adam_step(critic, critic_last, critic_beneath, share, of_critic)


@kernel(makes_arrays=False, forceinline=True)
def _errors(chance, actor, critic, rollout, span, weights):
    """Derivatives of PPO's objective on a minibatch by logits and values."""
    (begin, end), (clip_range, entropy_weight, value_weight) = span, weights
    n, logits = end - begin, actor.outputs
    # mean and deviation of advantages, which a single one keeps
    mean, deviation = 0.0, 1.0
    if n > 1:
        square = 0.0
        for i in range(begin, end):
            mean += rollout.advantages[rollout.order[i]] / n
        for i in range(begin, end):
            square += (rollout.advantages[rollout.order[i]] - mean) ** 2
        deviation = np.sqrt(square / (n - 1)) + 1e-8
    for i in range(begin, end):
        k = rollout.order[i]
        c, action = rollout.observations[k], rollout.actions[k]
        add_error(critic, 0, c, 2 * value_weight * (rollout.returns[k] - critic.outputs[0, c]) / n)
        normaliser, entropy = _log_sum(logits, chance, c), 0.0
        for a in range(len(logits)):
            if set_has(chance, c, a):
                log_probability = logits[a, c] - normaliser
                entropy -= np.exp(log_probability) * log_probability
        advantage = (rollout.advantages[k] - mean) / deviation
        ratio = np.exp(logits[action, c] - normaliser - rollout.log_probabilities[k])
        is_clipped = ratio > 1 + clip_range if advantage > 0 else ratio < 1 - clip_range
        for a in range(len(logits)):
            if set_has(chance, c, a):
                log_probability = logits[a, c] - normaliser
                probability = np.exp(log_probability)
                value = -entropy_weight * probability * (log_probability + entropy)
                if not is_clipped:
                    value += advantage * ratio * ((1.0 if a == action else 0.0) - probability)
                add_error(actor, a, c, value / n)
