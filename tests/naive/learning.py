"""Q-learning in plain Python, drawing the same random numbers as the compiled loop: its slow twin."""

import math

import numpy as np

from naive import mdp as naive_mdp
from pharos.mdp import paid_outcomes

MASK = (1 << 64) - 1


class SplitMix64:
    """Steele, Lea and Flood (2014)."""

    def __init__(self, word):
        self.word = int(word)

    def random(self):
        self.word = (self.word + 0x9E3779B97F4A7C15) & MASK
        z = self.word
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
        return ((z ^ (z >> 31)) >> 11) * 2.0**-53

    def below(self, n):
        return min(int(self.random() * n), n - 1)


def drawn(mdp, s, x, rng):
    """A next state, -1 for the end; draws a number only where the MDP is not a table of next states."""
    outcomes = naive_mdp.outcomes(mdp, s, x)
    if mdp.dynamics.deterministic_table() is not None:
        return outcomes[0][0]
    u, passed = rng.random() * sum(p for _, p in outcomes), 0.0
    for t, p in outcomes:
        passed += p
        if passed > u:
            return t
    return outcomes[-1][0]


class Episodes:
    """Episodes of at most `limit` steps, one after another, by the numbers of the compiled walks of learners.

    Attributes:
        state: None before an episode. choices: (S) lists of available actions.
    """

    def __init__(self, mdp, rng, limit):
        self.mdp, self.rng, self.limit, self.state = mdp, rng, limit, None
        available = np.ones((mdp.num_states, mdp.num_actions), bool) if mdp.available is None else mdp.available
        self.choices = [np.flatnonzero(row).tolist() for row in available]
        self.rows = [[] for _ in range(mdp.num_states * mdp.num_actions)]
        for row, t, r, p in zip(*(column.tolist() for column in paid_outcomes(mdp)), strict=True):
            self.rows[row].append((t, r, p))

    def begin(self):
        """Start an episode if none is under way."""
        if self.state is None:
            cumulative = np.cumsum(self.mdp.start_probabilities)
            cumulative[-1] = 1.0
            self.state = int(self.mdp.start_states[np.searchsorted(cumulative, self.rng.random(), side="right")])
            self.previous, self.elapsed = None, 0

    def uniform(self):
        """A uniform one of the available actions."""
        return self.choices[self.state][self.rng.below(len(self.choices[self.state]))]

    def step(self, action):
        """(reward, next state, whether the episode ended there, whether its limit cut it)."""
        mdp, chance, previous = self.mdp, self.mdp.chance, self.previous
        executed, u = action, self.rng.random()
        if previous is None or previous not in self.choices[self.state]:
            executed = action if u < chance.first_chosen else self.uniform()
        elif u >= chance.chosen:
            executed = previous if u < chance.chosen + chance.previous else self.uniform()
        outcomes = self.rows[self.state * mdp.num_actions + executed]
        new, reward, _ = outcomes[0]
        if len(outcomes) > 1:
            u, total, passed = self.rng.random(), sum(p for *_, p in outcomes), 0.0
            for new, reward, p in outcomes:  # noqa: B007
                passed += p
                if u < passed / total:
                    break
        ended = new == mdp.num_states or bool(mdp.terminal[new])
        self.previous, self.elapsed = executed, self.elapsed + 1
        is_cut = not ended and self.elapsed >= self.limit
        self.state = None if ended or is_cut else new
        return reward, new, ended, is_cut


def normal(rng):
    """A standard normal number (Box and Muller 1958)."""
    return math.sqrt(-2 * math.log(1 - rng.random())) * math.cos(2 * math.pi * rng.random())


def paid(earned, delay, ended):
    """What the last step pays, given what the steps of an episode earned, that one included."""
    if ended:
        return sum(earned[-1 - delay :])
    return earned[-1 - delay] if len(earned) > delay else 0.0


def q_learning(mdp, word, steps, total_steps, options, limit, noise=0.0, delay=0, noise_word=0):
    """(Q, sum of returns, episodes) after `steps` steps."""
    noises = SplitMix64(noise_word)
    rng, chance = SplitMix64(word), mdp.chance
    num_actions, sees = mdp.num_actions, options["sees_previous_action"]
    rewards, cumulative = mdp.rewards, np.cumsum(mdp.start_probabilities)
    cumulative[-1] = 1.0
    q, visits = {}, {}
    total, episodes, state = 0.0, 0, None

    def value(key, a):
        return q.get((key, a), options["initial_q"])

    for step in range(steps):
        if state is None:
            state = int(mdp.start_states[np.searchsorted(cumulative, rng.random(), side="right")])
            previous, age, gained, discount, earned = num_actions, 0, 0.0, 1.0, []
        key = (state, previous) if sees else state
        exploration = options["exploration_fraction"] * total_steps
        share = min(1.0, step / exploration) if exploration > 0 else 1.0
        first, last = options["exploration_initial_eps"], options["exploration_final_eps"]
        linear = options["exploration_schedule"] == "linear"
        epsilon = first + share * (last - first) if linear else first * (last / first) ** share
        if rng.random() < epsilon:
            action = rng.below(num_actions)
        else:
            best, ties, action = value(key, 0), 1, 0
            for a in range(1, num_actions):
                if value(key, a) > best:
                    best, ties, action = value(key, a), 1, a
                elif value(key, a) == best:
                    ties += 1
                    if rng.random() * ties < 1.0:
                        action = a
        u, executed = rng.random(), action
        if previous == num_actions:
            if u >= chance.first_chosen:
                executed = rng.below(num_actions)
        elif u >= chance.chosen:
            executed = previous if u < chance.chosen + chance.previous else rng.below(num_actions)
        reward, after = rewards[state, executed], drawn(mdp, state, executed, rng)
        ended = after < 0 or bool(mdp.terminal[after])
        following = (after, executed) if sees else after
        earned.append(reward)
        pay = paid(earned, delay, ended or age + 1 >= limit) + (noise * normal(noises) if noise else 0.0)
        target = pay + (0.0 if ended else options["gamma"] * max(value(following, a) for a in range(num_actions)))
        visits[key, action] = visits.get((key, action), 0) + 1
        w = options["visits_exponent"]
        alpha = max(options["learning_rate"], visits[key, action] ** -w) if w else options["learning_rate"]
        q[key, action] = value(key, action) + alpha * (target - value(key, action))
        gained += discount * reward
        discount *= mdp.gamma
        age += 1
        state, previous = after, executed
        if ended or age >= limit:
            total, episodes, state = total + gained, episodes + 1, None
    return q, total, episodes
