"""An idealised network in dense matrices, and a PPO in two of them: slow twins of the compiled ones."""

import numpy as np

from naive import learning


class Network:
    """Outputs f (A, C), kernels H and B (C, C), products M (A, A) of the outputs' weights, and Adam's means."""

    def __init__(self, net, adam, layer):
        """net: arrays before training, which are copied."""
        self.H, self.B, self.M, self.outputs = (
            np.array(each, np.float64) for each in (net.last, net.beneath, net.gram, net.outputs)
        )
        self.adam, self.layer, self.steps = adam, layer, 0
        self.of_last = self.of_beneath = self.of_error = np.zeros_like(self.outputs)
        self.squares = np.zeros(2)
        self.before, self.bias = self.outputs.copy(), np.zeros((len(self.outputs), 1))
        self.moved = self.grown = np.zeros_like(self.outputs)

    def squared_gradients(self, e):
        """Squared lengths: sum_a e_a' H e_a, and sum_ab M_ab e_a' B e_b."""
        return np.array([np.trace(e @ self.H @ e.T), np.trace(self.M @ e @ self.B @ e.T)])

    def step(self, e, share):
        """A step of Adam up the error e (A, C), clipped to a share of it."""
        adam, A = self.adam, len(e)
        squares, e = self.squared_gradients(share * e), share * e
        self.steps += 1
        self.squares = adam.decay_of_squares * self.squares + (1 - adam.decay_of_squares) * squares
        self.of_last = adam.decay * self.of_last + (1 - adam.decay) * e @ self.H
        self.of_beneath = adam.decay * self.of_beneath + (1 - adam.decay) * e @ self.B
        self.of_error = adam.decay * self.of_error + (1 - adam.decay) * e
        parameters = np.array([A * self.layer.parameters[0], self.layer.parameters[1]])
        v = self.squares / (1 - adam.decay_of_squares**self.steps)
        eta = adam.learning_rate * np.array(self.layer.evenness) / (np.sqrt(v / parameters) + adam.epsilon)
        eta = eta / (1 - adam.decay**self.steps)
        self.outputs = self.outputs + eta[0] * self.of_last + eta[1] * self.M @ self.of_beneath
        self.moved = self.moved + eta[0] * self.of_error
        self.grown = self.grown + eta[1] * self.of_beneath

    def learn(self, pairs, errors):
        """A step on the errors of a minibatch of pairs (observation, action)."""
        e = np.zeros_like(self.outputs)
        for (x, a), error in zip(pairs, errors, strict=True):
            e[a, x] += error / len(pairs)
        self.step(e, min(1.0, self.adam.max_grad_norm / (np.sqrt(self.squared_gradients(e).sum()) + 1e-6)))

    def settle(self):
        """H and M after what has been learnt, held to what products of features and of weights can be."""
        f, A, G = self.before - self.bias, self.moved, self.grown
        features = self.H - 1 + G.T @ f + f.T @ G + G.T @ self.M @ G
        weights = self.M + A @ f.T + f @ A.T + A @ (self.H - 1) @ A.T
        self.bias = self.bias + A.sum(axis=1, keepdims=True)
        lengths = np.clip(np.diag(features) + 1, 1.0, self.layer.largest)
        if np.isfinite(self.layer.largest):
            root = np.sqrt(lengths / np.maximum(np.diag(features) + 1, lengths))
            features = (features + 1) * np.outer(root, root) - 1
        most = np.sqrt(np.outer(lengths, lengths))
        self.H = np.maximum(np.minimum(features + 1, most), -most)
        np.fill_diagonal(self.H, lengths)
        values, vectors = np.linalg.eigh(weights)
        self.M = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
        for a, each in enumerate(self.outputs - self.bias):
            self.M[a, a] = max(self.M[a, a], (each**2 / np.maximum(lengths - 1, 1e-3)).max())
        self.before, self.moved, self.grown = self.outputs.copy(), 0 * A, 0 * G


def ppo(mdp, classes, actor, critic, options, derivatives):
    """Learn by rollouts, with the random numbers of the compiled PPO. Returns how often (episodes were cut, ended).

    options: (schedule, rollouts, sampling, steps of an episode, length to which gradients are clipped).
    derivatives: of PPO's objective on a minibatch by logits (A, C) and values (C,), a function of (logits, values,
        observations, actions, log-probabilities when they were drawn, advantages, returns).
    """
    schedule, rollouts, sampling, episode, most = options
    words = np.random.SeedSequence(sampling.seed, spawn_key=(2,)).generate_state(2, np.uint64)
    rng, noises = learning.SplitMix64(words[0]), learning.SplitMix64(words[1])
    courses = [learning.Episodes(mdp, rng, episode) for _ in range(rollouts.environments)]
    discount, counts = schedule.gamma, np.zeros(2, int)
    for _ in range(0, schedule.steps, rollouts.steps):
        actor.settle()
        critic.settle()
        V, steps = critic.outputs[0], []
        for course in courses:
            rows = []
            for _ in range(rollouts.steps // len(courses)):
                course.begin()
                c, choices = classes[course.state], course.choices[course.state]
                p = np.exp(actor.outputs[choices, c] - actor.outputs[choices, c].max())
                p /= p.sum()
                place = min(np.searchsorted(np.cumsum(p), rng.random(), side="right"), len(p) - 1)
                reward, new, ended, is_cut = course.step(choices[place])
                noise = sampling.reward_noise * learning.normal(noises) if sampling.reward_noise else 0.0
                following = 0.0 if ended else V[classes[new]]
                error = reward / sampling.reward_scale + noise + discount * following - V[c]
                rows.append((c, choices[place], np.log(p[place]), error, ended or is_cut))
                counts += is_cut, ended
            for t, (c, action, log_probability, *_) in enumerate(rows):
                advantage, weight = 0.0, 1.0
                for *_, error, is_last in rows[t:]:
                    advantage += weight * error
                    weight *= 0.0 if is_last else discount * rollouts.gae_lambda
                steps.append((c, action, log_probability, advantage, advantage + V[c]))
        size = -(-rollouts.steps * rollouts.epochs // rollouts.gradient_steps)
        for _ in range(rollouts.epochs):
            order = list(range(len(steps)))
            for i in range(len(steps) - 1, 0, -1):
                j = rng.below(i + 1)
                order[i], order[j] = order[j], order[i]
            for begin in range(0, len(steps), size):
                batch = [steps[i] for i in order[begin : begin + size]]
                columns = (np.array(column) for column in zip(*batch, strict=True))
                of_logits, of_values = derivatives(actor.outputs, critic.outputs[0], *columns)
                squares = actor.squared_gradients(of_logits).sum() + critic.squared_gradients(of_values[None]).sum()
                share = min(1.0, most / (np.sqrt(squares) + 1e-6))
                actor.step(of_logits, share)
                critic.step(of_values[None], share)
    return counts
