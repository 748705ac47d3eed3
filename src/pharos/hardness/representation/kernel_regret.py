"""Regret of learning in the kernel of an agent's network, in expectation: nothing is sampled, no network trained.

`kernel_regret`, Q-learning: an idealised DQN. Its network is replaced by its tangent kernel, its replay buffer by the
exact expected visits of its own behaviour, its targets by exact expectations. With the identity in the place of the
kernel it is tabular Q-learning, the same learner without a representation. So is hardness defined by GORP (Laidlaw et
al., 2023) and SQIRL (2024), as the cost of an idealised algorithm. Here the algorithm's function class is the agent's,
and its cost is not sampled.

`kernel_policy_regret`, an actor-critic: an idealised PPO. Policy and values are functions in the space of the network's
tangent kernel, rollouts are exact expected visits, and so are the returns towards which values learn and the advantages
by which the policy does. With the identity in the place of the kernel it is tabular softmax policy gradient (Agarwal et
al., 2021) with a learnt baseline.

`kernel_learning_time`, `kernel_sample_complexity`, `aliasing_floor`: how the optimal values align with the spectrum of
the kernel, without a learner.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from pharos.errors import UndefinedMeasure
from pharos.hardness.representation.learning import (
    STEP_MARGIN,
    WORST_GREEDY,
    WORST_PLAYED,
    Grouped,
    IdealisedLearner,
    Identity,
    KernelOperator,
    LearningCurve,
    Memory,
    Representation,
    Rollouts,
    Schedule,
    descent,
    greedy_policy,
)
from pharos.hardness.visitation import StandardOccupancy, standard_occupancy
from pharos.mdp import TabularMDP, require_mdp
from pharos.solvers import Solution

RAREST = 1e-9  # of the largest weight: observations are taken to be at least as frequent if gradients are rescaled


@dataclass(frozen=True, eq=False)
class KernelRegret:
    """Regret of the idealised learner, with the kernel and without it.

    Attributes:
        curve: with the kernel. tabular: with the identity in its place, on the states themselves.
        observations: different ones that it learns from. states: that can be met and are not terminal.
        landmarks: of the approximation. None: the kernel is exact.
        estimated_error, estimated_error_played: half of the landmarks change the regret of the greedy policies, and
            what is played, by that much: estimates, not bounds. 0 if exact.
        conventions: schedule, episode, observation and network.
        name: of the measure.
    """

    curve: LearningCurve
    tabular: LearningCurve
    observations: int
    states: int
    landmarks: int | None
    estimated_error: float
    conventions: Mapping[str, Any] = field(default_factory=dict)
    name: str = "kernel_regret"
    estimated_error_played: float = 0.0

    @property
    def value(self) -> float:
        """Mean regret of the greedy policies."""
        return self.curve.mean_greedy

    @property
    def note(self) -> str:
        """Landmarks and the error that they are estimated to cause. Empty if the kernel is exact."""
        if self.landmarks is None:
            return ""
        return (
            f"{self.name}: by {self.landmarks} landmarks of {self.observations:,} observations; half of them change "
            f"it by {self.estimated_error:.2g} ({self.estimated_error_played:.2g} as played), which are estimates of "
            "the error and no bounds"
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "value": self.value,
            "played": self.curve.mean_played,
            "evaluated": self.curve.mean_evaluated,
            "tabular": self.tabular.mean_greedy,
            "tabular_played": self.tabular.mean_played,
            "observations": self.observations,
            "states": self.states,
            "landmarks": self.landmarks,
            "estimated_error": self.estimated_error,
            "estimated_error_played": self.estimated_error_played,
            "conventions": dict(self.conventions),
            "curve": self.curve.to_dict(),
            "tabular_curve": self.tabular.to_dict(),
        }

    def __str__(self) -> str:
        return (
            f"{self.value:.3g} (as played {self.curve.mean_played:.3g}); with a table {self.tabular.mean_greedy:.3g} "
            f"({self.tabular.mean_played:.3g})"
        )


@require_mdp
def kernel_regret(
    mdp: TabularMDP,
    representation: Representation,
    *,
    schedule: Schedule | None = None,
    solution: Solution | None = None,
    horizon: int | None = None,
    progress: Callable[[str], object] | None = None,
) -> KernelRegret:
    """Return the expected regret of Q-learning in the tangent kernel of a network.

    With Q = 0 and D = 0, for each phase of c steps, g gradient steps and the learner's discount:

        pi = epsilon-greedy in Q;   D += c times the occupancy of pi;   y = r + gamma E max_a Q(s', a)
        g times:   Q(., a) += eta K diag(d(., a)) (y(., a) - Q(., a)),   d = D / sum of D

    eta is 1 / (1.05 times the largest eigenvalue of K diag(max_a d)), the largest step that does not overshoot, half of
    the largest stable one: no learning rate.
    The value is the mean over phases of (V* - V of the greedy policy) / (V* - V of uniform play).

    Args:
        representation: the kernel, see `pharos.observations.representation`.
        schedule: None: the default of `Schedule`.
        solution: the optimal values of `mdp`, if they are known.
        horizon: steps of an episode that the learner sees. Default: the MDP's, else the time limit.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Returns:
        A KernelRegret. Actions whose values are within 1e-6 of the state's largest one are chosen alike. Values are in
        the MDP's setting (gamma, horizon). What agents see is the state, not the previous action: under sticky actions
        a target is the mean over previous actions, weighted by visits. Rewards are expected ones: their noise is drawn
        by `sampled_regret` alone.
    Raises:
        UndefinedMeasure: there is neither a horizon nor a time limit, or uniform play is optimal.
        ParameterError: the representation is of other states, or its kernel does not fit into memory.
    Cost: for each phase about 4 sqrt(g) products of the kernel with A columns, walks of T steps and two values. The
        kernel is 4 C^2 bytes of C different observations, with landmarks beyond 4,096 of them.
    Source: pharos; Sirignano and Spiliopoulos (2019), Cai et al. (2019) for the limit of wide networks.
    """
    learner = IdealisedLearner(mdp, representation, schedule, horizon, solution, progress)
    return regret_in_kernel(learner, {"schedule": asdict(learner.schedule)})


def regret_in_kernel(learner: IdealisedLearner, settings: Mapping[str, Any]) -> KernelRegret:
    """The regret of a learner with a kernel, by landmarks if there are too many observations, and with a table.

    Args:
        settings: of the learner, the first of the conventions.
    """

    def learnt(operator: KernelOperator) -> LearningCurve:
        if learner.schedule.optimizer == "adam":
            operator.preconditioned(np.maximum(learner.weights, RAREST * learner.weights.max()))
        return learner.curve(learner.observations, operator)

    operators, landmarks = learner.operators()  # what does not fit is said at once
    tabular = learner.curve(learner.table, Identity())
    curve, *half = map(learnt, operators)
    return KernelRegret(
        curve=curve,
        tabular=tabular,
        observations=len(learner.observations),
        states=len(learner.states),
        landmarks=landmarks,
        estimated_error=sum((abs(curve.mean_greedy - each.mean_greedy) for each in half), 0.0),
        estimated_error_played=sum((abs(curve.mean_played - each.mean_played) for each in half), 0.0),
        conventions=learner.conventions(settings, {"greedy": WORST_GREEDY, "played": WORST_PLAYED}),
        name=learner.measure,
    )


# Policy gradients -----------------------------------------------------------------------------------------------------


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
    progress: Callable[[str], object] | None = None,
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
    The value is the mean over rollouts of (V* - V of the most probable actions) / (V* - V of uniform play). As played,
    the same of pi, weighted by episodes. As evaluated, the same of pi with all rollouts alike, which is what
    evaluations of the distribution over actions see.

    Args:
        representation: the kernel, of an actor-critic `initialisation="sb3"`.
        schedule: for its steps, discount and optimizer. Default: the default of `Schedule`.
        rollouts: None: the defaults of `Rollouts`.
        solution: the optimal values of `mdp`, if they are known.
        horizon: steps of an episode that the learner sees. Default: the MDP's, else the time limit.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Returns:
        A KernelRegret, in which a phase is a rollout. Actions whose logits are within 1e-6 of the state's largest one
        are chosen alike by the greedy policy. Values are in the MDP's setting (gamma, horizon). Under sticky actions
        returns are means over previous actions, weighted by visits.
    Raises:
        UndefinedMeasure: there is neither a horizon nor a time limit, or uniform play is optimal.
        ParameterError: the representation is of other states, or its kernel does not fit into memory.
    Cost: for each rollout g products of the kernel with A columns, and 4 sqrt(g) with one, a walk of T steps, two
        values, and up to 14 / (1 - gamma lambda) backups. Landmarks as in `kernel_regret`.
    Source: pharos; Sutton et al. (2000) for the gradient, Schulman et al. (2016) for G, Schulman et al. (2017) for the
        objective, Agarwal et al. (2021) for tables.
    """
    learner = PolicyLearner(mdp, representation, schedule, horizon, solution, progress)
    learner.rollouts = rollouts or Rollouts()
    of_schedule = {name: getattr(learner.schedule, name) for name in ("steps", "gamma", "optimizer")}
    return regret_in_kernel(learner, {"schedule": of_schedule, "rollouts": learner.rollouts.to_dict()})


class PolicyLearner(IdealisedLearner):
    """Idealised actor-critics on an MDP."""

    measure = "kernel_policy_regret"
    step_weights = "d"
    rollouts: Rollouts

    def curve(self, observations: Grouped, apply: KernelOperator) -> LearningCurve:
        logits, values = np.zeros((len(observations), self.mdp.num_actions)), np.zeros((len(observations), 1))
        of_actor, of_critic = (np.full((len(observations), 1), len(observations) ** -0.5) for _ in range(2))
        returns = np.zeros((len(self.states), self.mdp.num_actions))
        rows, steps = [], self.rollouts.gradient_steps
        for step in range(0, self.schedule.steps, self.rollouts.steps):
            self.report(f"step {step:,} of {self.schedule.steps:,}")
            behaviour = softmax(observations.masked(logits))
            policy, memory = behaviour[observations.groups], Memory(self.mdp, self.states)
            played, length = memory.play(self.visits(policy), policy, 1)
            played = played if self.is_return else self.value(policy)
            greedy = self.value(greedy_policy(logits, observations.sets)[observations.groups])
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
            gain = visits * standardised(returns - v[:, None], visits)
            if largest > 0:
                pull, up = observations.sums(gain), observations.sums(np.maximum(gain, 0.0))
                rate = 1 / (STEP_MARGIN * largest)
                logits = ascended(observations.masked(logits), pull, up, apply, rate, self.rollouts)
        return LearningCurve(*(np.array(column) for column in zip(*rows, strict=True)))

    def _returns(
        self, memory: Memory, policy: np.ndarray, v: np.ndarray, begin: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """((N, A), (N, A)): expected returns G of each choice, from values v (N,), and its visits."""
        share, returns = self.rollouts.gae_lambda, begin
        for _ in range(MOST_BACKUPS):
            after = (1 - share) * v + share * (policy * returns).sum(axis=1)
            before, (returns, visits) = returns, memory.targets(after, self.schedule.gamma)
            if np.abs(returns - before).max() <= RETURNS * np.abs(returns).max():
                break
        return returns, visits


def ascended(
    logits: np.ndarray, pull: np.ndarray, up: np.ndarray, apply: KernelOperator, rate: float, rollouts: Rollouts
) -> np.ndarray:
    """Logits (C, A) after gradient steps up the sum of pull(., a) p(a) / pi(a), pi their policy before the first.

    Args:
        pull: (C, A) weighted advantages, summed over the states of an observation. up: the positive ones alone.
        rollouts: how many steps. If p / pi is `clip_range` above 1 the positive ones count no more, if it is as
            far below the negative ones. Logits of actions that are not available are -inf.
    """
    behaviour = np.maximum(softmax(logits), 1e-30)
    far = np.inf if rollouts.clip_range is None else rollouts.clip_range
    for _ in range(rollouts.gradient_steps):
        policy = softmax(logits)
        ratio = policy / behaviour
        counted = np.where(ratio > 1 + far, pull - up, np.where(ratio < 1 - far, up, pull))
        of_action = counted * policy / behaviour
        logits = logits + rate * apply(of_action - policy * of_action.sum(axis=1, keepdims=True))
        shifted = logits - logits.max(axis=1, keepdims=True)
        logits = np.where(shifted > -np.inf, np.maximum(shifted, -SPAN), -np.inf)  # logits of no action stay so
    return logits


def softmax(logits: np.ndarray) -> np.ndarray:
    """(C, A) probabilities."""
    grown = np.exp(logits - logits.max(axis=1, keepdims=True))
    return grown / grown.sum(axis=1, keepdims=True)


def standardised(advantages: np.ndarray, visits: np.ndarray) -> np.ndarray:
    """(N, A) of mean 0 and variance 1 under visits of sum 1, or 0 if they are all the same."""
    centred = advantages - (visits * advantages).sum()
    spread = float(np.sqrt((visits * centred**2).sum()))
    return centred / spread if spread > 1e-12 else np.zeros_like(centred)


# Spectra --------------------------------------------------------------------------------------------------------------


MOST_EIGENVALUES = 2000  # observations whose kernel is decomposed; of more, as many are drawn
ENERGY_LEFT = 0.1  # the share of energy, or of variance, that may be left
MOST_LEARNING_TIME = 1e14  # gradient-flow time that is looked at
RIDGE = 1e-6  # of the trace, in regressions
LEAST_EIGENVALUE = 1e-9  # of the largest eigenvalue: what float32 kernels tell of an eigenvalue


@dataclass(frozen=True, eq=False)
class Spectral:
    """A number that follows from a kernel's spectrum.

    Attributes:
        value: the number, at least 1. Infinite if it is beyond what was looked at.
        observations: different ones that were decomposed. of: out of how many.
        estimated_error: with half of the observations drawn the natural logarithm differs by that much: an estimate of
            the error, not a bound. 0 if all were decomposed.
        conventions: what it refers to.
    """

    name: str
    value: float
    observations: int
    of: int
    estimated_error: float
    conventions: Mapping[str, Any] = field(default_factory=dict)

    @property
    def note(self) -> str:
        """Sampled observations and the error that they are estimated to cause. Empty if all were decomposed."""
        if self.observations == self.of:
            return ""
        return (
            f"{self.name}: of {self.observations:,} observations drawn by visits from {self.of:,}; half of them change "
            f"its logarithm by {self.estimated_error:.2g}, which is an estimate of its error and no bound"
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        result = {name: value for name, value in vars(self).items() if name != "name"}
        return {**result, "log": float(np.log(self.value)), "conventions": dict(self.conventions)}

    def __str__(self) -> str:
        return f"{self.value:.6g}"


@require_mdp
def kernel_learning_time(
    mdp: TabularMDP,
    representation: Representation,
    *,
    schedule: Schedule | None = None,
    horizon: int | None = None,
    progress: Callable[[str], object] | None = None,
) -> Spectral:
    """Return the time that kernel gradient flow takes to learn the optimal advantages.

        the t with   sum_i exp(-2 lambda_i t) v_i = 0.1 sum_i v_i

    lambda_i: eigenvalues of W^1/2 K W^1/2, which sum to 1, W the diagonal of the visits of half uniform and half
    optimal play; v_i: the energy of A* = Q* - V* (all actions) on its eigenvectors.

    Args:
        schedule: for its discount, which Q* has. Default: the default of `Schedule`.
        horizon: steps of an episode, for visits. Default: the MDP's, else the time limit.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Raises:
        UndefinedMeasure: there are no episodes, or every action is optimal everywhere.
        ParameterError: the representation is of other states.
    Cost: C^3 for C different observations, at most 2,000, drawn by visits if there are more.
    Source: pharos; Jacot et al. (2018), section 5, for gradient flow in a kernel.
    """

    def time(kernel: np.ndarray, weights: np.ndarray, q: np.ndarray) -> float:
        best = q.max(axis=1, keepdims=True, where=np.isfinite(q), initial=-np.inf)
        advantage = np.where(np.isfinite(q), q - best, 0.0)
        eigenvalues, energy = _spectrum(kernel, advantage, weights)
        return _learning_time(eigenvalues / eigenvalues.sum(), energy)

    return _spectral("kernel_learning_time", mdp, representation, schedule, horizon, time, progress or str)


@require_mdp
def kernel_sample_complexity(
    mdp: TabularMDP,
    representation: Representation,
    *,
    schedule: Schedule | None = None,
    horizon: int | None = None,
    progress: Callable[[str], object] | None = None,
) -> Spectral:
    """Return how many samples kernel regression takes to know the optimal action values but for a tenth of their
    variance.

    The least n with expected test error E(n) <= 0.1 Var Q*, by the eigenframework: kappa solves
    sum_i lambda_i / (lambda_i + kappa) + ridge / kappa = n, L_i = lambda_i / (lambda_i + kappa),
    E(n) = n / (n - sum L_i^2) sum_i (1 - L_i)^2 v_i; lambda_i, v_i as for `kernel_learning_time`, of the centred kernel
    and centred Q*; ridge 1e-6 of the trace.

    Args, raises, cost: as for `kernel_learning_time`.
    Source: Simon, Dickens, Karkada and DeWeese (2023), equations 5 to 8; Bordelon, Canatar and Pehlevan (2020).
    """

    def samples(kernel: np.ndarray, weights: np.ndarray, q: np.ndarray) -> float:
        mean = kernel @ weights
        centred = kernel - mean[:, None] - mean[None] + weights @ mean
        return _samples(*_spectrum(centred, _centred(q, weights), weights))

    return _spectral("kernel_sample_complexity", mdp, representation, schedule, horizon, samples, progress or str)


@require_mdp
def aliasing_floor(
    mdp: TabularMDP,
    representation: Representation,
    *,
    schedule: Schedule | None = None,
    horizon: int | None = None,
    progress: Callable[[str], object] | None = None,
) -> float:
    """Return the share of the variance of Q* that no function of the observation explains: E Var(Q* | o) / Var Q*.

    Visits and arguments as for `kernel_learning_time`, summed over actions. 0 if the observation tells the state.

    Raises:
        UndefinedMeasure: there are no episodes, or Q* is the same everywhere.
    Cost: values and two occupancies.
    Source: pharos, by the law of total variance.
    """
    setting = _setting(mdp, representation, schedule, horizon, "aliasing_floor", progress or str)
    states = np.flatnonzero(setting.states > 0)
    weights, q = setting.states[states], setting.q[states]
    observations = Grouped(representation.classes, states, mdp.available)
    if len(observations) == len(states):
        return 0.0
    centred = _centred(q, weights)
    total = float(weights @ (centred**2).sum(axis=1))
    if total <= 1e-24:
        raise UndefinedMeasure("aliasing_floor: the optimal values are the same everywhere")
    mean = observations.sums(weights[:, None] * centred) / observations.sums(weights)[:, None]
    return float(weights @ ((centred - mean[observations.groups]) ** 2).sum(axis=1)) / total


def _setting(
    mdp: TabularMDP,
    representation: Representation,
    schedule: Schedule | None,
    horizon: int | None,
    name: str,
    report: Callable[[str], object],
) -> StandardOccupancy:
    episode = representation.episode(mdp, horizon, name)
    return standard_occupancy(mdp, (schedule or Schedule()).gamma, episode, report)


def _centred(q: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Values q (N, A) less the mean of their action under weights (N,). 0 for actions that are not available (-inf)."""
    if np.isfinite(q).all():
        return np.asarray(q - weights @ q)
    is_available = np.isfinite(q)
    values = np.where(is_available, q, 0.0)
    share = weights @ is_available
    mean = np.divide(weights @ values, share, out=np.zeros_like(share), where=share > 0)
    return np.where(is_available, values - mean, 0.0)


def _spectral(
    name: str,
    mdp: TabularMDP,
    representation: Representation,
    schedule: Schedule | None,
    horizon: int | None,
    function: Callable[[np.ndarray, np.ndarray, np.ndarray], float],
    report: Callable[[str], object],
) -> Spectral:
    """Spectral result of a function of (kernel (C, C), weights (C,), mean values (C, A)) of the observations. Values of
    actions that are not available are -inf."""
    setting = _setting(mdp, representation, schedule, horizon, name, report)
    states = np.flatnonzero(setting.states > 0)
    observations = Grouped(representation.classes, states, mdp.available)
    weights = observations.sums(setting.states[states])
    q = observations.sums(setting.states[states, None] * setting.q[states]) / weights[:, None]

    def of(count: int) -> float:
        report(f"the spectrum of {min(count, len(observations)):,} observations")
        indices, share = _sampled_indices(weights, count)
        rows = observations.representatives[indices]
        return function(representation.kernel(rows, rows).astype(np.float64), share, q[indices])

    value = of(MOST_EIGENVALUES)
    count = min(MOST_EIGENVALUES, len(observations))
    error = 0.0 if count == len(observations) else abs(float(np.log(value / of(count // 2))))
    conventions = {"left": ENERGY_LEFT, "gamma": (schedule or Schedule()).gamma, **representation.conventions}
    return Spectral(name, value, count, len(observations), error, conventions)


def _sampled_indices(weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(indices, their weights): all if there are at most `count`, else drawn evenly along the sum of weights."""
    if len(weights) <= count:
        return np.arange(len(weights)), weights / weights.sum()
    order = np.random.default_rng(0).permutation(len(weights))
    edges = np.cumsum(weights[order]) / weights.sum()
    hits = np.minimum(np.searchsorted(edges, (np.arange(count) + 0.5) / count), len(weights) - 1)
    indices, counts = np.unique(order[hits], return_counts=True)
    return indices, counts / count


def _spectrum(kernel: np.ndarray, values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(eigenvalues, energy of values (C, A) on eigenvectors) of a kernel (C, C) under weights (C,)."""
    root = np.sqrt(weights)
    eigenvalues, vectors = np.linalg.eigh(root[:, None] * kernel * root)
    energy = ((vectors.T @ (root[:, None] * values)) ** 2).sum(axis=1)
    return np.maximum(eigenvalues, LEAST_EIGENVALUE * eigenvalues[-1]), energy


def _learning_time(eigenvalues: np.ndarray, energy: np.ndarray) -> float:
    total = energy.sum()
    if total <= 1e-24:
        raise UndefinedMeasure("kernel_learning_time: every action is optimal everywhere")
    low, high = 0.0, 1.0

    def left(time: float) -> float:
        return float(np.exp(-2 * eigenvalues * time) @ energy) / total

    while left(high) > ENERGY_LEFT:
        low, high = high, 2 * high
        if high > MOST_LEARNING_TIME:
            return float("inf")
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if left(middle) > ENERGY_LEFT else (low, middle)
    return high


def _samples(eigenvalues: np.ndarray, energy: np.ndarray) -> float:
    total, trace = energy.sum(), eigenvalues.sum()
    if total <= 1e-24:
        raise UndefinedMeasure("kernel_sample_complexity: the optimal values are the same everywhere")

    def at(log_kappa: float) -> tuple[float, float]:
        """(samples, share of variance that is left): kappa falls as samples rise."""
        kappa = trace * np.exp(log_kappa)
        learnt = eigenvalues / (eigenvalues + kappa)
        samples = learnt.sum() + RIDGE * trace / kappa
        return samples, samples / (samples - (learnt**2).sum()) * float((1 - learnt) ** 2 @ energy) / total

    grid = np.linspace(np.log(10.0), np.log(1e-14), 400)  # the error may rise again before it falls for good
    first = next((i for i, log_kappa in enumerate(grid) if at(log_kappa)[1] <= ENERGY_LEFT), None)
    if first is None:
        return float("inf")
    enough, few = grid[first], grid[max(first - 1, 0)]
    while few - enough > 1e-12:
        middle = (enough + few) / 2
        enough, few = (middle, few) if at(middle)[1] <= ENERGY_LEFT else (enough, middle)
    return max(1.0, float(at(enough)[0]))
