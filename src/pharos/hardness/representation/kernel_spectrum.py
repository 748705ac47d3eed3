"""How the optimal values lie to the spectrum of a network's kernel: a priori measures, without a learner."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import UndefinedMeasure
from pharos.hardness.representation.mean_field import Schedule
from pharos.hardness.representation.representation import Grouped, Representation
from pharos.hardness.visitation.occupancy import StandardOccupancy, standard_occupancy
from pharos.mdp import TabularMDP, require_mdp

MOST_EIGENVALUES = 2000  # observations whose kernel is decomposed; of more, as many are drawn
LEFT = 0.1  # the share of energy, or of variance, that may be left
LONGEST = 1e14  # gradient-flow time that is looked at
RIDGE = 1e-6  # of the trace, in regressions
FLOOR = 1e-9  # of the largest eigenvalue: what float32 kernels tell of an eigenvalue


@dataclass(frozen=True, eq=False)
class Spectral:
    """A number that follows from a kernel's spectrum.

    Attributes:
        value: the number, at least 1; infinite where it is beyond what was looked at.
        observations: different ones that were decomposed; of how many: `of`.
        estimated_error: with half of the observations drawn the natural logarithm differs by that much: an estimate of
            the error, not a bound; 0 where all were decomposed.
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
        """What is approximate."""
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
    mdp: TabularMDP, representation: Representation, *, schedule: Schedule | None = None, horizon: int | None = None
) -> Spectral:
    """Return the time that kernel gradient flow takes to learn the optimal advantages.

        the t with   sum_i exp(-2 lambda_i t) v_i = 0.1 sum_i v_i

    lambda_i: eigenvalues of W^1/2 K W^1/2, which sum to 1, W the diagonal of the visits of half uniform and half
    optimal play; v_i: the energy of A* = Q* - V* (all actions) on its eigenvectors.

    Args:
        schedule: for its discount, that of Q*; None: that of `Schedule`.
        horizon: steps of an episode, for visits; None: the MDP's, else the time limit.
    Raises:
        UndefinedMeasure: there are no episodes, or every action is optimal everywhere.
        ParameterError: the representation is of other states.
    Cost: C^3 for C different observations, at most 2,000, drawn by visits where there are more.
    Source: pharos; Jacot et al. (2018), section 5, for gradient flow in a kernel.
    """

    def time(kernel: np.ndarray, weights: np.ndarray, q: np.ndarray) -> float:
        advantage = q - q.max(axis=1, keepdims=True)
        eigenvalues, energy = _spectrum(kernel, advantage, weights)
        return _time(eigenvalues / eigenvalues.sum(), energy)

    return _spectral("kernel_learning_time", mdp, representation, schedule, horizon, time)


@require_mdp
def kernel_sample_complexity(
    mdp: TabularMDP, representation: Representation, *, schedule: Schedule | None = None, horizon: int | None = None
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
        return _samples(*_spectrum(centred, q - weights @ q, weights))

    return _spectral("kernel_sample_complexity", mdp, representation, schedule, horizon, samples)


@require_mdp
def aliasing_floor(
    mdp: TabularMDP, representation: Representation, *, schedule: Schedule | None = None, horizon: int | None = None
) -> float:
    """Return the share of the variance of Q* that no function of the observation explains: E Var(Q* | o) / Var Q*.

    Visits as for `kernel_learning_time`; summed over actions. 0 where the observation tells the state.

    Raises:
        UndefinedMeasure: there are no episodes, or Q* is the same everywhere.
    Cost: values and two occupancies.
    Source: pharos; the law of total variance.
    """
    setting = _setting(mdp, representation, schedule, horizon, "aliasing_floor")
    states = np.flatnonzero(setting.states > 0)
    weights, q, observations = setting.states[states], setting.q[states], Grouped(representation.classes, states)
    if len(observations) == len(states):
        return 0.0
    centred = q - weights @ q
    total = float(weights @ (centred**2).sum(axis=1))
    if total <= 1e-24:
        raise UndefinedMeasure("aliasing_floor: the optimal values are the same everywhere")
    mean = observations.sums(weights[:, None] * centred) / observations.sums(weights)[:, None]
    return float(weights @ ((centred - mean[observations.groups]) ** 2).sum(axis=1)) / total


def _setting(
    mdp: TabularMDP, representation: Representation, schedule: Schedule | None, horizon: int | None, name: str
) -> StandardOccupancy:
    representation.check(mdp.num_states)
    episode = representation.episode(mdp.horizon if horizon is None else horizon, name)
    return standard_occupancy(mdp, (schedule or Schedule()).gamma, episode)


def _spectral(
    name: str,
    mdp: TabularMDP,
    representation: Representation,
    schedule: Schedule | None,
    horizon: int | None,
    function: Callable[[np.ndarray, np.ndarray, np.ndarray], float],
) -> Spectral:
    """A function of (kernel (C, C), weights (C,), mean values (C, A)) of the different observations."""
    setting = _setting(mdp, representation, schedule, horizon, name)
    states = np.flatnonzero(setting.states > 0)
    observations = Grouped(representation.classes, states)
    weights = observations.sums(setting.states[states])
    q = observations.sums(setting.states[states, None] * setting.q[states]) / weights[:, None]

    def of(count: int) -> float:
        places, share = _drawn(weights, count)
        rows = observations.representatives[places]
        return function(representation.kernel(rows, rows).astype(np.float64), share, q[places])

    value = of(MOST_EIGENVALUES)
    count = min(MOST_EIGENVALUES, len(observations))
    error = 0.0 if count == len(observations) else abs(float(np.log(value / of(count // 2))))
    conventions = {"left": LEFT, "gamma": (schedule or Schedule()).gamma, **representation.conventions}
    return Spectral(name, value, count, len(observations), error, conventions)


def _drawn(weights: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(places, their weights): all where there are at most `count`, else drawn evenly along the sum of weights."""
    if len(weights) <= count:
        return np.arange(len(weights)), weights / weights.sum()
    order = np.random.default_rng(0).permutation(len(weights))
    edges = np.cumsum(weights[order]) / weights.sum()
    hits = np.minimum(np.searchsorted(edges, (np.arange(count) + 0.5) / count), len(weights) - 1)
    places, counts = np.unique(order[hits], return_counts=True)
    return places, counts / count


def _spectrum(kernel: np.ndarray, values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(eigenvalues, energy of values (C, A) on eigenvectors) of a kernel (C, C) under weights (C,)."""
    root = np.sqrt(weights)
    eigenvalues, vectors = np.linalg.eigh(root[:, None] * kernel * root)
    energy = ((vectors.T @ (root[:, None] * values)) ** 2).sum(axis=1)
    return np.maximum(eigenvalues, FLOOR * eigenvalues[-1]), energy


def _time(eigenvalues: np.ndarray, energy: np.ndarray) -> float:
    total = energy.sum()
    if total <= 1e-24:
        raise UndefinedMeasure("kernel_learning_time: every action is optimal everywhere")
    low, high = 0.0, 1.0

    def left(time: float) -> float:
        return float(np.exp(-2 * eigenvalues * time) @ energy) / total

    while left(high) > LEFT:
        low, high = high, 2 * high
        if high > LONGEST:
            return float("inf")
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if left(middle) > LEFT else (low, middle)
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
    first = next((i for i, log_kappa in enumerate(grid) if at(log_kappa)[1] <= LEFT), None)
    if first is None:
        return float("inf")
    enough, few = grid[first], grid[max(first - 1, 0)]
    while few - enough > 1e-12:
        middle = (enough + few) / 2
        enough, few = (middle, few) if at(middle)[1] <= LEFT else (enough, middle)
    return max(1.0, float(at(enough)[0]))
