"""The regret of an actor-critic in the kernel of an agent's network, in expectation: the twin of `kernel_regret`.

An idealised PPO. Policy and values are functions in the space of the network's tangent kernel, rollouts are exact
expected visits, and so are the returns towards which values learn and the advantages by which the policy does. With the
identity in the place of the kernel it is tabular softmax policy gradient (Agarwal et al., 2021) with a learnt baseline.
"""

from dataclasses import asdict

import numpy as np

from pharos.hardness.representation.kernel_operator import KernelOperator
from pharos.hardness.representation.kernel_regret import KernelRegret, regret_in_kernel
from pharos.hardness.representation.mean_field import (
    MARGIN,
    Learner,
    LearningCurve,
    Memory,
    Rollouts,
    Schedule,
    descent,
    greedy_policy,
)
from pharos.hardness.representation.representation import Grouped, Representation
from pharos.mdp import TabularMDP, require_mdp
from pharos.solvers import Solution

SPAN = 30.0  # logits differ by no more
RETURNS = 1e-6  # relative change at which expected returns are known
MOST_BACKUPS = 2000


@require_mdp
def kernel_policy_regret(
    mdp: TabularMDP,
    representation: Representation,
    *,
    schedule: Schedule | None = None,
    rollouts: Rollouts | None = None,
    solution: Solution | None = None,
    horizon: int | None = None,
) -> KernelRegret:
    """Return the expected regret of an actor-critic whose policy and values learn in the tangent kernel of a network.

    With logits z = 0 and values V = 0, for each rollout, g gradient steps and the learner's discount:

        pi = softmax(z);   d = the occupancy of pi, of sum 1;   G = r + gamma E[(1 - lambda) V(s') + lambda pi G(s')]
        A = G - V, less its mean under d, divided by its standard deviation under d
        g times:   V += eta K diag(d) (sum_a pi G - V)
        g times:   z(., a) += eta K diag(d) p(a) (A(., a) - sum_b p(b) A(., b)),   p = softmax(z) at the step

    which goes up PPO's objective E[p / pi A]. With `rollouts.clip_range` it is clipped: an action of a state whose p /
    pi is above 1 + clip_range is no longer pushed up, one below 1 - clip_range no longer down. eta is 1 / (1.05 times
    the largest eigenvalue of K diag(d)), d of states: no learning rate, and what K learns slowly stays slow.
    The value is the mean over rollouts of (V* - V of the most probable actions) / (V* - V of uniform play); as played,
    that of pi, weighted by episodes; as evaluated, that of pi with all rollouts alike, which is what evaluations of the
    distribution over actions see.

    Args:
        representation: the kernel; of an actor-critic `initialisation="sb3"`.
        schedule: for its steps, discount and optimizer; None: that of `Schedule`.
        rollouts: None: those of `Rollouts`.
        solution: the optimal values of `mdp`, where they are known.
        horizon: steps of an episode that the learner sees; None: the MDP's, else the time limit.
    Returns:
        A KernelRegret; a phase is a rollout. Actions whose logits are within 1e-6 of the state's largest one are
        chosen alike by the greedy policy. Values are in the MDP's setting (gamma, horizon). Under sticky actions
        returns are means over previous actions, weighted by visits.
    Raises:
        UndefinedMeasure: there is neither a horizon nor a time limit; or uniform play is optimal.
        ParameterError: the representation is of other states, or its kernel does not fit into memory.
    Cost: for each rollout g products of the kernel with A columns, and 4 sqrt(g) with one; a walk of T steps, two
        values, and up to 14 / (1 - gamma lambda) backups. Landmarks as in `kernel_regret`.
    Source: pharos; Sutton et al. (2000) for the gradient, Schulman et al. (2016) for G, Schulman et al. (2017) for the
        objective, Agarwal et al. (2021) for tables.
    """
    representation.check(mdp.num_states)
    episode = representation.episode(mdp.horizon if horizon is None else horizon, "kernel_policy_regret")
    schedule, rollouts = schedule or Schedule(), rollouts or Rollouts()
    learner = PolicyLearner(mdp, schedule, episode, solution, rollouts)
    of_schedule = {name: asdict(schedule)[name] for name in ("steps", "gamma", "optimizer")}
    settings = {"schedule": of_schedule, "rollouts": rollouts.to_dict()}
    return regret_in_kernel(mdp, learner, representation, settings, "d")


class PolicyLearner(Learner):
    """An MDP, and actor-critics on it."""

    measure = "kernel_policy_regret"

    def __init__(
        self, mdp: TabularMDP, schedule: Schedule, episode: int, solution: Solution | None, rollouts: Rollouts
    ):
        super().__init__(mdp, schedule, episode, solution)
        self.rollouts = rollouts

    def curve(self, observations: Grouped, apply: KernelOperator) -> LearningCurve:
        logits, values = np.zeros((len(observations), self.mdp.num_actions)), np.zeros((len(observations), 1))
        of_actor, of_critic = (np.full((len(observations), 1), len(observations) ** -0.5) for _ in range(2))
        returns = np.zeros((len(self.states), self.mdp.num_actions))
        rows, steps = [], self.rollouts.gradient_steps
        for step in range(0, self.schedule.steps, self.rollouts.steps):
            behaviour = softmax(logits)
            policy, memory = behaviour[observations.groups], Memory(self.mdp, self.states)
            played, length = memory.play(self.visits(policy), policy, 1)
            played = played if self.is_return else self.value(policy)
            greedy = self.value(greedy_policy(logits)[observations.groups])
            count = min(self.rollouts.steps, self.schedule.steps - step) / length
            rows.append((step, self.regret(greedy), self.regret(played), count))
            v = values[observations.groups, 0]
            returns, visits = self._returns(memory, policy, v, returns)
            visits = visits / visits.sum()
            weights = observations.sums(visits.sum(axis=1))[:, None]
            goal = observations.sums((visits * (policy * returns).sum(axis=1, keepdims=True)).sum(axis=1))[:, None]
            error = np.divide(goal, weights, out=values.copy(), where=weights > 0) - values
            values = values + descent(apply, weights, error, of_critic, steps)
            largest = apply.largest_eigenvalue(weights, of_actor)
            gain = visits * self.advantages(memory, policy, v, returns, visits)
            if largest > 0:
                pull, up = observations.sums(gain), observations.sums(np.maximum(gain, 0.0))
                logits = self.ascended(logits, pull, up, apply, 1 / (MARGIN * largest))
        return LearningCurve(*(np.array(column) for column in zip(*rows, strict=True)))

    def _returns(
        self, memory: Memory, policy: np.ndarray, v: np.ndarray, begin: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """((N, A), (N, A)): expected returns G of each choice, from values v (N,); and its visits."""
        share, returns = self.rollouts.gae_lambda, begin
        for _ in range(MOST_BACKUPS):
            after = (1 - share) * v + share * (policy * returns).sum(axis=1)
            before, (returns, visits) = returns, memory.targets(after, self.schedule.gamma)
            if np.abs(returns - before).max() <= RETURNS * np.abs(returns).max():
                break
        return returns, visits

    def advantages(
        self, memory: Memory, policy: np.ndarray, v: np.ndarray, returns: np.ndarray, visits: np.ndarray
    ) -> np.ndarray:
        """(N, A) by which the policy learns, from returns (N, A) of choices and values v (N,), at visits of sum 1."""
        return standardised(returns - v[:, None], visits)

    def ascended(
        self, logits: np.ndarray, pull: np.ndarray, up: np.ndarray, apply: KernelOperator, rate: float
    ) -> np.ndarray:
        """(C, A) logits after the gradient steps of a rollout."""
        return ascended(logits, pull, up, apply, rate, self.rollouts.gradient_steps, self.rollouts.clip_range)


def ascended(
    logits: np.ndarray,
    pull: np.ndarray,
    up: np.ndarray,
    apply: KernelOperator,
    rate: float,
    steps: int,
    clip_range: float | None = None,
) -> np.ndarray:
    """Logits (C, A) after gradient steps up the sum of pull(., a) p(a) / pi(a), pi their policy before the first.

    Args:
        pull: (C, A) weighted advantages, summed over the states of an observation; up: the positive ones alone.
        clip_range: where p / pi is that far above 1 the positive ones count no more, that far below the negative ones.
    """
    behaviour, far = np.maximum(softmax(logits), 1e-30), np.inf if clip_range is None else clip_range
    for _ in range(steps):
        policy = softmax(logits)
        ratio = policy / behaviour
        counted = np.where(ratio > 1 + far, pull - up, np.where(ratio < 1 - far, up, pull))
        of_action = counted * policy / behaviour
        logits = logits + rate * apply(of_action - policy * of_action.sum(axis=1, keepdims=True))
        logits = np.maximum(logits - logits.max(axis=1, keepdims=True), -SPAN)
    return logits


def softmax(logits: np.ndarray) -> np.ndarray:
    """(C, A) probabilities."""
    grown = np.exp(logits - logits.max(axis=1, keepdims=True))
    return grown / grown.sum(axis=1, keepdims=True)


def standardised(advantages: np.ndarray, visits: np.ndarray, noise: float = 0.0) -> np.ndarray:
    """(N, A) of mean 0 and variance 1 under visits of sum 1, `noise` added to it; 0 where they are all the same."""
    centred = advantages - (visits * advantages).sum()
    spread = float(np.sqrt((visits * centred**2).sum() + noise))
    return centred / spread if spread > 1e-12 else np.zeros_like(centred)
