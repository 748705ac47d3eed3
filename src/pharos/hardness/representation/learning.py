"""Representation of an MDP's states by a network: which look alike, and how learning at one changes another.

Products with its kernel use the kernel itself, the identity, or landmarks and a diagonal (Nyström).
`IdealisedLearner` is Q-learning of a network in expectation, on which `kernel_regret` builds.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.visitation import Propagation, drawn_indices, standard_occupancy
from pharos.mdp import TabularMDP, mdp_within, states_within, uniform_choice, whole_number
from pharos.regret import regret_scale
from pharos.solvers import Solution, chain, evaluate_policy, uniform_value, value_iteration

MOST_WITHOUT_LANDMARKS = 4096
"""Different observations up to which a kernel is used as it is; beyond, by landmarks."""
DEFAULT_LANDMARKS = 600


@dataclass(frozen=True)
class OutputLayer:
    """A network's output layer beside the layers beneath it, for learners that step as its optimizer does.

    Attributes:
        kernel: as of `Representation`, of the parameters of one output alone: h(x) . h(y) + 1, h the last hidden units.
            Without the 1 if there is no bias.
        weights: expected sum of the squared weights of an output before training, bias aside.
        parameters: numbers of parameters: of one output, and of all layers beneath.
        evenness: of the output layer and of the layers beneath: the mean size of a parameter's gradient as a share of
            its root mean square. Adam moves each parameter alike, so that 1 is where all have the same gradient. For
            named networks the closed form is of one observation. For a network of one's own, sizes are root mean
            squares over up to 64 different observations.
        largest: of h(x) . h(x) + 1. Infinite for ReLUs.
        has_bias: whether an output has a bias.
        bias: variance of an output's bias before training as a share of that of a weight: 0 where biases begin at 0.
    """

    kernel: Callable[[np.ndarray, np.ndarray], np.ndarray]
    weights: float
    parameters: tuple[int, int]
    evenness: tuple[float, float]
    largest: float = math.inf
    has_bias: bool = True
    bias: float = 1.0


@dataclass(frozen=True, eq=False)
class Representation:
    """An observation and a network, as measures see them. `pharos.observations.representation` makes one.

    Attributes:
        kernel: (rows (N,), columns (M,)) of states -> (N, M) float32, the network's tangent kernel. Positive
            semidefinite, and symmetric if rows are columns.
        classes: (S,) the number of each state's observation, from 0: states of one number look alike.
        time_limit: steps of an episode that the agent sees, if the MDP has no horizon, or None.
        landmarks: of the approximation beyond MOST_WITHOUT_LANDMARKS different observations. 0 means none, whatever it
            takes. 2 or more are used for all sizes.
        conventions: what it is, JSON-able.
        covariance: as `kernel`, the covariance of an output of the network before training. None if it is not known.
        output_layer: the network in two groups of parameters. None if they are not known apart.
    """

    kernel: Callable[[np.ndarray, np.ndarray], np.ndarray]
    classes: np.ndarray
    time_limit: int | None = None
    landmarks: int | None = None
    conventions: Mapping[str, Any] = field(default_factory=dict)
    covariance: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    output_layer: OutputLayer | None = None

    def __post_init__(self) -> None:
        if self.landmarks == 1:
            raise ParameterError("landmarks is 1; expected at least 2, as half of them tell the error, or 0 for none")

    @staticmethod
    def of_matrix(kernel: ArrayLike, classes: ArrayLike | None = None, **options: Any) -> "Representation":
        """Make a representation of a kernel (S, S) and numbers of observations (S,). Default: every state looks
        different.

        Raises:
            ParameterError: it is not square, symmetric and finite, there is not one number for each state, or there
                is one landmark.
        """
        matrix = np.asarray(kernel, np.float32)
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.isfinite(matrix).all():
            raise ParameterError(f"kernel has shape {matrix.shape}; expected finite numbers of shape (S, S)")
        if not np.allclose(matrix, matrix.T, rtol=1e-4, atol=1e-6 * np.abs(matrix).max()):
            raise ParameterError("kernel is not symmetric; expected K(x, y) = K(y, x)")
        numbers = np.arange(len(matrix)) if classes is None else np.asarray(classes)
        if numbers.shape != (len(matrix),):
            raise ParameterError(f"classes have shape {numbers.shape}; expected ({len(matrix)},), one for each state")
        return Representation(lambda rows, columns: matrix[np.ix_(rows, columns)], numbers, **options)

    def episode(self, mdp: TabularMDP, horizon: int | None, measure: str) -> int:
        """Steps of an episode: the horizon, else the MDP's, else the time limit.

        Raises:
            UndefinedMeasure: there is none. ParameterError: the MDP has another number of states.
        """
        if len(self.classes) != mdp.num_states:
            raise ParameterError(
                f"the representation is of {len(self.classes)} states; expected {mdp.num_states}, those of the MDP"
            )
        steps = next((each for each in (horizon, mdp.horizon, self.time_limit) if each is not None), None)
        if steps is None:
            raise UndefinedMeasure(f"{measure} is defined for episodes of T steps: give a horizon")
        return int(steps)


class Grouped:
    """The different observations of some states.

    Attributes:
        representatives: (C,) one state of each observation.
        groups: (N,) the observation of each of the states, 0 .. C - 1.
        sets: (C, A) bool, the available actions. None: all are.
    Raises:
        UndefinedMeasure: states that look alike do not have the same actions.
    """

    def __init__(self, classes: np.ndarray, states: np.ndarray, available: np.ndarray | None = None):
        """available: (S, A) bool, the available actions of the states. None: all are."""
        _, first, groups = np.unique(classes[states], return_index=True, return_inverse=True)
        self.representatives, self.groups = states[first], groups.ravel()
        self.sets = None if available is None else available[self.representatives]
        if available is not None and self.sets is not None:
            differs = (available[states] != self.sets[self.groups]).any(axis=1)
            if differs.any():
                state = int(states[np.argmax(differs)])
                other = int(self.representatives[self.groups[np.argmax(differs)]])
                raise UndefinedMeasure(
                    f"states {other} and {state} look alike, and other actions are available in them: measures of a "
                    "representation are defined where what is seen says which are"
                )

    def masked(self, values: np.ndarray, otherwise: float = -np.inf) -> np.ndarray:
        """Values (C, A), with another number for actions that are not available."""
        return values if self.sets is None else np.where(self.sets, values, otherwise)

    def __len__(self) -> int:
        return len(self.representatives)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """(C, ...) sums of values (N, ...) over the states of each observation."""
        if values.ndim == 1:
            return np.bincount(self.groups, values, minlength=len(self))
        return np.stack([self.sums(column) for column in values.T], axis=1)


# Products with a kernel -----------------------------------------------------------------------------------------------


MOST_LANCZOS = 60
ELSEWHERE = 0.1  # of a first vector: the last phase's eigenvector may be one still, and no longer the largest
FEW_COLUMNS = 8  # columns up to which half of a symmetric matrix is read sooner than BLAS has packed all of it

Kernel = Callable[[np.ndarray, np.ndarray], np.ndarray]


class KernelOperator:
    """A positive semidefinite kernel K of C observations. z is (C, A) float64."""

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """K z."""
        raise NotImplementedError

    def largest_eigenvalue(self, weights: np.ndarray, vector: np.ndarray) -> float:
        """The largest eigenvalue of K diag(weights), weights (C, 1), to 0.1 %, by Lanczos' method from `vector` (C, 1).

        Returns it with the residual added, so that it is not too small. `vector` becomes the eigenvector found.
        """
        root = np.sqrt(weights)
        vector *= 1.0 if vector.sum() >= 0 else -1.0
        begin = vector / np.linalg.norm(vector) + ELSEWHERE / math.sqrt(len(vector))
        basis = [begin / np.linalg.norm(begin)]
        diagonal: list[float] = []
        beside: list[float] = []
        while True:
            after = root * self(root * basis[-1])
            diagonal.append(float((basis[-1] * after).sum()))
            rows = np.concatenate(basis, axis=1)
            after = after - rows @ (rows.T @ after)
            after = after - rows @ (rows.T @ after)  # twice is enough (Parlett, 1998)
            length = float(np.linalg.norm(after))
            small = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
            values, vectors = np.linalg.eigh(small)
            residual = length * abs(float(vectors[-1, -1]))
            if residual <= 1e-3 * values[-1] or len(basis) == min(MOST_LANCZOS, len(vector)):
                vector[:] = rows @ vectors[:, -1:]
                return max(float(values[-1]), 0.0) + residual
            basis.append(after / length)
            beside.append(length)

    def preconditioned(self, weights: np.ndarray) -> None:
        """Become W^-1/2 (W^1/2 K W^1/2)^1/2 W^-1/2, the kernel of full-matrix Adam, where W are the weights (C,) of
        observations.

        Its second moments of gradients are J' W J for errors of one size, J the network's Jacobian, K = J J'. Dividing
        gradients by their square root leaves each eigenvalue of K under W as its square root. Weights are positive.
        Source: Duchi, Hazan and Singer (2011) for full matrices; Kingma and Ba (2015) keep the diagonal alone.
        """
        raise NotImplementedError

    def parts(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(K (C, C), F (C, 0), diagonal (0,)), or K = F F' + diag as ((0, 0), F (C, m), (C,)), all float32."""
        raise NotImplementedError

    def descended(self, weights: np.ndarray, error: np.ndarray, rate: float, steps: int) -> np.ndarray:
        """Change of Q by `steps` steps of gradient descent, Q += rate K (weights (target - Q)); error = target - Q.

        It is K times rate weights times the sum of the errors on the way, a polynomial of degree steps - 1 in
        rate K diag(weights), whose eigenvalues lie in [0, 1]: a Chebyshev series of about 3.5 sqrt(steps) terms has it
        to float32's accuracy, in each eigenvector for itself. weights, error: (C, A) float64.
        """
        return rate * self(weights * self.summed(weights, error, rate, _sum_of_powers(steps)))

    def summed(self, weights: np.ndarray, error: np.ndarray, rate: float, series: np.ndarray) -> np.ndarray:
        """The sum of the terms of a Chebyshev series in 1 - 2 rate K diag(weights), applied to error."""
        past, now = error, error - 2 * rate * self(weights * error)
        total = series[0] * past
        if len(series) > 1:
            total = total + series[1] * now
        for coefficient in series[2:]:
            past, now = now, 2 * now - 4 * rate * self(weights * now) - past
            total += coefficient * now
        return total


class Identity(KernelOperator):
    """The identity: no generalisation between observations, as in a table."""

    def __call__(self, z: np.ndarray) -> np.ndarray:
        return z

    def largest_eigenvalue(self, weights: np.ndarray, vector: np.ndarray) -> float:
        return float(weights.max())

    def parts(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.empty((0, 0), np.float32), np.empty((count, 0), np.float32), np.ones(count, np.float32)


class Exact(KernelOperator):
    """The kernel itself, 4 C^2 bytes."""

    def __init__(self, kernel: Kernel, states: np.ndarray):
        self.matrix = np.ascontiguousarray(kernel(states, states), np.float32)

    def __call__(self, z: np.ndarray) -> np.ndarray:
        from pharos.kernels import linear_algebra

        if z.shape[1] > FEW_COLUMNS:
            return self.matrix @ z
        rows = np.ascontiguousarray(z.T, np.float64)
        out = np.empty_like(rows)
        linear_algebra.product(self.matrix, rows, out)
        return out.T

    def parts(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.matrix, np.empty((count, 0), np.float32), np.empty(0, np.float32)

    def preconditioned(self, weights: np.ndarray) -> None:
        root = np.sqrt(weights)[:, None]
        values, vectors = np.linalg.eigh(root * self.matrix * root.T)
        vectors *= np.maximum(values, 0.0) ** 0.25
        self.matrix = np.ascontiguousarray((vectors @ vectors.T) / root / root.T, np.float32)


class Landmarks(KernelOperator):
    """K ~ F F' + a diagonal, F = K(., L) K(L, L)^-1/2: exact between landmarks L and others, and on the diagonal.

    The diagonal keeps what an observation learns for itself alone (Snelson and Ghahramani, 2006, for regression).
    Source: Williams and Seeger (2001).
    """

    def __init__(self, kernel: Kernel, states: np.ndarray, landmarks: np.ndarray, block: int = 4096):
        values, vectors = np.linalg.eigh(kernel(landmarks, landmarks).astype(np.float64))
        is_large = values > 1e-6 * values[-1]
        root = (vectors[:, is_large] / np.sqrt(values[is_large])).astype(np.float32)
        self.features = np.empty((len(states), int(is_large.sum())), np.float32)
        self.diagonal = np.empty((len(states), 1), np.float32)
        for start in range(0, len(states), block):
            rows = states[start : start + block]
            part = kernel(rows, landmarks) @ root
            self.features[start : start + block] = part
            own = np.concatenate([np.diag(kernel(each, each)) for each in np.array_split(rows, len(rows) // 64 + 1)])
            self.diagonal[start : start + block, 0] = np.maximum(own - np.einsum("nm,nm->n", part, part), 0.0)

    def __call__(self, z: np.ndarray) -> np.ndarray:
        z = z.astype(np.float32)
        return self.features @ (self.features.T @ z) + self.diagonal * z

    def parts(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.empty((0, 0), np.float32), self.features, np.ascontiguousarray(self.diagonal[:, 0])

    def preconditioned(self, weights: np.ndarray) -> None:
        """Precondition the features and the diagonal separately."""
        column = weights.astype(np.float32)[:, None]
        values, vectors = np.linalg.eigh((self.features.T @ (column * self.features)).astype(np.float64))
        is_large = values > 1e-7 * values[-1]
        self.features = np.ascontiguousarray(
            self.features @ (vectors[:, is_large] * values[is_large] ** -0.25).astype(np.float32)
        )
        self.diagonal = np.sqrt(self.diagonal / column)

    def summed(self, weights: np.ndarray, error: np.ndarray, rate: float, series: np.ndarray) -> np.ndarray:
        """The sum of the series, with one pass over the features a term in place of two."""
        from pharos.kernels import linear_algebra

        if len(series) < 3:
            return super().summed(weights, error, rate, series)
        weights, error = weights.astype(np.float32), error.astype(np.float32)
        past, now = error.copy(), error - np.float32(2 * rate) * self(weights * error)
        total = np.float32(series[0]) * past + np.float32(series[1]) * now
        projected = np.empty((error.shape[1], self.features.shape[1]))
        linear_algebra.project(self.features, weights * now, projected)
        for coefficient in series[2:]:
            across = projected.astype(np.float32)
            linear_algebra.step(self.features, self.diagonal, weights, np.float32(rate), across, now, past, projected)
            past, now = now, past
            total += np.float32(coefficient) * now
        return total


@lru_cache(maxsize=16)
def _sum_of_powers(steps: int) -> np.ndarray:
    """Chebyshev coefficients in u = 1 - 2 x of the sum of (1 - x)^t, t < steps, on [0, 1]."""
    degree = min(steps - 1, math.ceil(3.5 * math.sqrt(steps)))

    def total(u: np.ndarray) -> np.ndarray:
        x = (1 - u) / 2
        return np.where(x > 1e-9, -np.expm1(steps * np.log1p(-np.minimum(x, 1 - 1e-16))) / np.maximum(x, 1e-9), steps)

    return np.polynomial.chebyshev.chebinterpolate(total, degree)


# Learning in expectation ----------------------------------------------------------------------------------------------


TIES = 1e-6  # of the largest value of a state: actions that close are chosen alike
STEP_MARGIN = 1.05  # of the largest eigenvalue, which is known to 0.1 %
SHARE_OF_SPREAD = 1e-5  # of values, as a share of what is between optimal and uniform play
WORST_GREEDY, WORST_PLAYED = 1.5, 3.0  # a policy's regret counts no more than this


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Schedule of the idealised learner: steps, target network, exploration, discount, optimizer.

    Attributes:
        steps: of the environment.
        period: steps between copies of the target network. They are a phase.
        gradient_steps: in a phase.
        learning_starts: steps before the first gradient step.
        exploration_initial_eps, exploration_final_eps, exploration_fraction: epsilon falls linearly from one to the
            other over this share of the steps. Before `learning_starts` it is 1.
        gamma: the learner's own discount. Values have the MDP's.
        optimizer: "gradient", descent with the largest step that does not overshoot, or "adam", the same with gradients
            rescaled as by full-matrix Adam at the standard occupancy, see `KernelOperator.preconditioned`.
    """

    steps: int = 30_000
    period: int = 250
    gradient_steps: int = 62
    learning_starts: int = 1000
    exploration_initial_eps: float = 1.0
    exploration_final_eps: float = 0.05
    exploration_fraction: float = 0.3
    gamma: float = 0.95
    optimizer: str = "gradient"

    def __post_init__(self) -> None:
        for name in ("steps", "period", "gradient_steps"):
            whole_number(getattr(self, name), f"schedule: {name}")
        if not self.learning_starts >= 0:
            raise ParameterError(f"schedule: learning_starts is {self.learning_starts!r}; expected at least 0")
        for name in ("exploration_initial_eps", "exploration_final_eps", "exploration_fraction", "gamma"):
            if not 0 <= getattr(self, name) <= 1:
                raise ParameterError(f"schedule: {name} is {getattr(self, name)!r}; expected a number in [0, 1]")

        if self.optimizer not in ("gradient", "adam"):
            raise ParameterError(f"schedule: optimizer is {self.optimizer!r}; expected gradient or adam")

    def epsilon(self, step: int) -> float:
        """The share of uniform actions at a step."""
        first, last = self.exploration_initial_eps, self.exploration_final_eps
        if step < self.learning_starts:
            return 1.0
        share = min(step / (self.exploration_fraction * self.steps), 1.0) if self.exploration_fraction else 1.0
        return first + (last - first) * share


@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """Rollouts and gradient steps of the idealised actor-critic.

    Attributes:
        steps: of the environment in a rollout, after which policy and values learn.
        gradient_steps: that they learn by.
        gae_lambda: weight of longer returns, in returns and advantages.
        clip_range: PPO's: how far the probability of an action moves, as a share of itself, before it is no longer
            pushed further. None: no clipping.
        environments, epochs, entropy_weight, value_weight: of `network_policy_regret` alone: environments that a
            rollout is divided among, passes over it, and the weights of the entropy bonus and of the squared errors of
            values. None: 8, 4, 0.01 and 0.5.
    """

    steps: int = 512
    gradient_steps: int = 16
    gae_lambda: float = 0.95
    clip_range: float | None = None
    environments: int | None = None
    epochs: int | None = None
    entropy_weight: float | None = None
    value_weight: float | None = None

    def __post_init__(self) -> None:
        for name in ("steps", "gradient_steps"):
            whole_number(getattr(self, name), f"rollouts: {name}")
        if not 0 <= self.gae_lambda <= 1:
            raise ParameterError(f"rollouts: gae_lambda is {self.gae_lambda!r}; expected a number in [0, 1]")
        if self.clip_range is not None and not self.clip_range > 0:
            raise ParameterError(f"rollouts: clip_range is {self.clip_range!r}; expected a number above 0, or None")
        for name in ("environments", "epochs"):
            if getattr(self, name) is not None:
                whole_number(getattr(self, name), f"rollouts: {name}")
        if self.environments is not None and self.steps % self.environments:
            raise ParameterError(f"rollouts: {self.steps} steps are not divided by {self.environments} environments")
        for name in ("entropy_weight", "value_weight"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise ParameterError(f"rollouts: {name} is {value!r}; expected at least 0")

    def to_dict(self) -> dict[str, Any]:
        """JSON-able. Without what is None, as it was before there could be more."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class Adam:
    """The optimizer of the learners that step as an agent does (Kingma and Ba, 2015).

    Attributes:
        learning_rate: of every step.
        max_grad_norm: length to which gradients are clipped.
        epsilon: added to the root mean square of a gradient.
        decay, decay_of_squares: of the means of gradients and of their squares.
    """

    learning_rate: float = 0.001
    max_grad_norm: float = 10.0
    epsilon: float = 1e-8
    decay: float = 0.9
    decay_of_squares: float = 0.999

    def __post_init__(self) -> None:
        for name in ("learning_rate", "max_grad_norm", "epsilon"):
            if not 0 < getattr(self, name) < math.inf:
                raise ParameterError(f"adam: {name} is {getattr(self, name)!r}; expected a number above 0")
        for name in ("decay", "decay_of_squares"):
            if not 0 <= getattr(self, name) < 1:
                raise ParameterError(f"adam: {name} is {getattr(self, name)!r}; expected a number in [0, 1)")


@dataclass(frozen=True, eq=False)
class LearningCurve:
    """Regret of the idealised learner in each of its J phases, normalised: 0 optimal, 1 uniform play.

    Attributes:
        steps: (J,) at the beginning of a phase.
        greedy: (J,) regret of the greedy policy.
        played: (J,) regret of what is played, exploration included.
        episodes: (J,) expected episodes in a phase.
    """

    steps: np.ndarray
    greedy: np.ndarray
    played: np.ndarray
    episodes: np.ndarray

    @property
    def mean_greedy(self) -> float:
        """Mean over phases. A policy counts at most WORST_GREEDY."""
        return float(np.minimum(self.greedy, WORST_GREEDY).mean())

    @property
    def mean_played(self) -> float:
        """Mean over episodes. A policy counts at most WORST_PLAYED."""
        return float(np.average(np.minimum(self.played, WORST_PLAYED), weights=self.episodes))

    @property
    def mean_evaluated(self) -> float:
        """Mean over phases of what is played, as evaluations at equal distances see it, at most WORST_GREEDY each."""
        return float(np.minimum(self.played, WORST_GREEDY).mean())

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {name: np.round(values, 6).tolist() for name, values in vars(self).items()}


class IdealisedLearner:
    """Idealised Q-learning on an MDP, and the base of other idealised learners.

    Attributes:
        measure: its name in errors and notes.
        step_weights: how d weighs the kernel in the step size, in words.
        whole: the MDP as given. mdp: without states that its horizon keeps out of reach.
        states: (N,) those that an episode can reach and that are not terminal. numbers: (N,) in the MDP as given.
        episode: its steps.
        observations: the states by what the agent sees. table: each for itself.
    Raises:
        UndefinedMeasure: uniform play is optimal, so that regret has no scale.
    """

    measure = "kernel_regret"
    step_weights = "max_a d"

    def __init__(
        self,
        mdp: TabularMDP,
        representation: Representation,
        schedule: Schedule | None = None,
        horizon: int | None = None,
        solution: Solution | None = None,
        progress: Callable[[str], object] | None = None,
    ):
        """progress: called with a line for each phase. An exception that it raises ends the learning."""
        self.report = progress or str
        self.episode = episode = representation.episode(mdp, horizon, self.measure)
        self.schedule, self.representation = schedule or Schedule(), representation
        solution = solution or value_iteration(mdp, progress=self._report_sweep)
        uniform = uniform_value(mdp, progress=self._report_sweep)
        self.optimal = solution.value_at_start
        error = max(solution.error_bound, uniform.error_bound)
        self.spread = regret_scale(self.optimal, uniform.value_at_start, error)
        if math.isnan(self.spread):
            raise UndefinedMeasure(f"{self.measure}: uniform play is optimal, so that there is no regret to speak of")
        self.whole = self.mdp = mdp
        is_reachable = states_within(mdp, episode)
        is_reachable[mdp.start_states] = True
        if mdp.horizon is not None and mdp.horizon == episode and not is_reachable.all():
            self.mdp, numbers = mdp_within(mdp, episode), np.flatnonzero(is_reachable)
            self.states = np.flatnonzero(~np.asarray(self.mdp.terminal))
            self.numbers = numbers[self.states]
        else:
            self.states = self.numbers = np.flatnonzero(is_reachable & ~np.asarray(mdp.terminal))
        self.observations = Grouped(representation.classes, self.numbers, mdp.available)
        self.table = Grouped(np.arange(mdp.num_states), self.numbers, mdp.available)
        self.uniform = uniform_choice(self.mdp)
        self.visits = OfPolicies(lambda policy: visits_of(self.mdp, self.everywhere(policy), self.episode))
        self.value = OfPolicies(self._value)

    def curve(self, observations: Grouped, apply: KernelOperator) -> LearningCurve:
        """Learn from observations, the groups of states that look alike, with a kernel over them."""
        schedule, actions = self.schedule, self.mdp.num_actions
        uniform = self.uniform[self.states]
        values = np.zeros((len(observations), actions))
        memory = Memory(self.mdp, self.states)
        vector = np.full((len(observations), 1), len(observations) ** -0.5)
        rows = []
        for step in range(0, schedule.steps, schedule.period):
            self.report(f"step {step:,} of {schedule.steps:,}")
            period, epsilon = min(schedule.period, schedule.steps - step), schedule.epsilon(step)
            greedy = greedy_policy(values, observations.sets)[observations.groups]
            policy = (1 - epsilon) * greedy + (epsilon / actions if observations.sets is None else epsilon * uniform)
            played, length = memory.play(self.visits(policy), policy, period)
            played = played if self.is_return else self.value(policy)
            rows.append((step, self.regret(self.value(greedy)), self.regret(played), period / length))
            if step < schedule.learning_starts:
                continue
            q = observations.masked(values)[observations.groups]
            target, visits = memory.targets(q.max(axis=1), schedule.gamma)
            weights = observations.sums(visits / visits.sum())
            total = observations.sums(visits / visits.sum() * target)
            error = np.divide(total, weights, out=values.copy(), where=weights > 0) - values
            values += descent(apply, weights, error, vector, schedule.gradient_steps)
        return LearningCurve(*(np.array(column) for column in zip(*rows, strict=True)))

    @cached_property
    def weights(self) -> np.ndarray:
        """(C,) weights of observations at the standard occupancy."""
        standard = standard_occupancy(self.whole, self.schedule.gamma, self.episode, self.report)
        return self.observations.sums(standard.states[self.numbers])

    def operators(self) -> tuple[Iterable[KernelOperator], int | None]:
        """([the kernel over observations], None). If they are too many, ([the kernel by landmarks, by half of them],
        number of landmarks), drawn by `weights`."""
        kernel, observed = self.representation.kernel, self.observations.representatives
        landmarks = self.representation.landmarks
        if landmarks is None and len(observed) > MOST_WITHOUT_LANDMARKS:
            landmarks = DEFAULT_LANDMARKS
        if not landmarks or landmarks >= len(observed):
            return [Exact(kernel, observed)], None
        sample = observed[drawn_indices(self.weights, landmarks)]
        parts = (sample, sample[: landmarks // 2])
        return (Landmarks(kernel, observed, some) for some in parts), landmarks  # one at a time

    def conventions(self, settings: Mapping[str, Any], clipped: Mapping[str, float]) -> dict[str, Any]:
        """Conventions of a regret, JSON-able. settings: of the learner."""
        return {
            **settings,
            "episode": self.episode,
            "gamma": float(self.whole.gamma),
            "horizon": self.whole.horizon,
            "step_size": f"1 / ({STEP_MARGIN} largest eigenvalue of K diag({self.step_weights}))",
            "clipped": clipped,
            **self.representation.conventions,
        }

    @property
    def is_return(self) -> bool:
        """Whether a value is the expected return of an episode, so that walks estimate it."""
        return self.mdp.gamma == 1.0 and self.mdp.horizon == self.episode

    def regret(self, value: float) -> float:
        """Normalised regret of a policy's value."""
        return (self.optimal - value) / self.spread

    def _value(self, policy: np.ndarray) -> float:
        """Start value of a policy (N, A)."""
        is_pure = policy.max(axis=1).min() == 1.0
        actions = self.uniform.argmax(axis=1)
        actions[self.states] = policy.argmax(axis=1)
        if self.is_return and is_pure and self.mdp.is_deterministic:
            return return_on_graph(self.mdp, actions, self.episode)
        if self.is_return:
            return float((self.visits(policy).executed * self.mdp.rewards).sum())
        table = actions if is_pure else self.everywhere(policy)
        return evaluate_policy(
            self.mdp, table, SHARE_OF_SPREAD * self.spread, progress=self._report_sweep
        ).value_at_start

    def _report_sweep(self, sweeps: int, bound: float) -> None:
        self.report(f"sweep {sweeps} of values, error at most {bound:.2g}")

    def everywhere(self, policy: np.ndarray) -> np.ndarray:
        """(S, A) probabilities of a policy (N, A), uniform in states outside `states`."""
        table = self.uniform.copy()
        table[self.states] = policy
        return table


def return_on_graph(mdp: TabularMDP, actions: np.ndarray, steps: int) -> float:
    """The expected return of an episode of `steps` steps of actions (S,) on a deterministic MDP: S log2(steps) time.

    Doubling: the return and the end of 2 k steps from each state follow from k steps, twice.
    """
    successor, reward = chain(mdp, actions)
    is_last = np.asarray(mdp.terminal)
    jump = np.append(np.where(is_last | (successor < 0), mdp.num_states, successor), mdp.num_states)
    earned = np.append(np.where(is_last, 0.0, reward), 0.0)
    index, total = mdp.start_states.astype(np.int64), np.zeros(len(mdp.start_states))
    while steps:
        if steps % 2:
            total += earned[index]
            index = jump[index]
        earned, jump, steps = earned + earned[jump], jump[jump], steps // 2
    return float(mdp.start_probabilities @ total)


def descent(
    apply: KernelOperator, weights: np.ndarray, error: np.ndarray, vector: np.ndarray, steps: int
) -> np.ndarray:
    """(C, A): what `steps` gradient steps, the largest that do not overshoot, add to values whose error is (C, A).

    Args:
        weights: (C, A), of the squared errors. vector: (C, 1), the last phase's eigenvector, which is replaced.
    """
    largest = apply.largest_eigenvalue(weights.max(axis=1, keepdims=True), vector)
    before = float((weights * error**2).sum())
    while largest > 0 and before > 0:
        with np.errstate(over="ignore", invalid="ignore"):  # if the eigenvalue was far too small
            added = apply.descended(weights, error, 1 / (STEP_MARGIN * largest), steps)
            after = float((weights * (error - added) ** 2).sum())
        if after <= 1.001 * before:  # no step of a stable size makes it larger
            return added
        largest *= 1.1
    return np.zeros_like(error)


class Memory:
    """Expected visits so far, by state, previously executed action and chosen action: the replay buffer."""

    def __init__(self, mdp: TabularMDP, states: np.ndarray):
        self.mdp, self.states = mdp, states
        shape = (len(states), mdp.num_actions)
        self.first = np.zeros(shape)  # the first steps of episodes
        self.later = np.zeros((shape[0], mdp.width, shape[1]))
        self.rewards = np.asarray(mdp.reward_table.rows(states), np.float64)

    def play(self, visits: "ExpectedVisits", policy: np.ndarray, period: int) -> tuple[float, float]:
        """Add `period` steps of a policy (N, A), by its visits. Returns (expected return, expected steps) of an
        episode."""
        length = float(visits.executed.sum())
        scale, later = period / length, visits.later[self.states]
        if self.mdp.is_sticky:
            self.first += scale * visits.first[self.states, None] * policy
        else:
            later[:, 0] += visits.first[self.states]
        self.later += scale * later[:, :, None] * policy[:, None]
        return float((visits.executed[self.states] * self.rewards).sum()), length

    def targets(self, v: np.ndarray, gamma: float) -> tuple[np.ndarray, np.ndarray]:
        """((N, A), (N, A)): the mean target of each choice, by the values v (N,) of states, and its visits."""
        chance, x = self.mdp.chance.at(self.states), np.zeros(self.mdp.num_states + 1)
        x[self.states] = v
        q = self.rewards + gamma * self.mdp.dynamics.expected(x, self.states)
        if not self.mdp.is_sticky:
            return chance.chosen_values(q), self.later.sum(axis=1)
        first, repeating = self.first, self.later
        if chance.available is not None:  # a previous action that is not available counts as none
            can_be = chance.available[:, :, None]
            first, repeating = first + np.where(can_be, 0.0, repeating).sum(axis=1), np.where(can_be, repeating, 0.0)
        later = repeating.sum(axis=1)
        mean, visits = chance.mean(q), first + later
        choice = chance.first_chosen * first + chance.chosen * later
        uniform = chance.first_uniform * first + chance.uniform * later
        total = choice * q + uniform * mean + chance.previous * np.einsum("sba,sb->sa", repeating, q)
        return np.divide(total, visits, out=q.copy(), where=visits > 0), visits


class ExpectedVisits(NamedTuple):
    """Expected visits in an episode: first (S,), of the first step, later (S, W), by the previously executed action:
    executed (S, A), of all steps by what is executed."""

    first: np.ndarray
    later: np.ndarray
    executed: np.ndarray


Answer = TypeVar("Answer")


class OfPolicies(Generic[Answer]):
    """A function of policies with its last results cached, as policies repeat once learning has settled."""

    def __init__(self, function: Callable[[np.ndarray], Answer], last: int = 4):
        self.function, self.known = function, deque[tuple[np.ndarray, Answer]](maxlen=last)

    def __call__(self, policy: np.ndarray) -> Answer:
        index = next((i for i, (other, _) in enumerate(self.known) if np.array_equal(other, policy)), None)
        answer = self.function(policy) if index is None else self.known[index][1]
        if index is not None:
            del self.known[index]
        self.known.append((policy, answer))
        return answer


def visits_of(mdp: TabularMDP, policy: np.ndarray, episode: int) -> ExpectedVisits:
    """The visits of a policy (S, A) in an episode of some steps, without terminal states."""
    walk = Propagation(mdp, policy, episode)
    first, later = np.zeros(mdp.num_states), np.zeros((mdp.num_states, mdp.width))
    for mass, is_first, alive in walk.distributions():
        if alive <= 1e-12:
            break
        if is_first:
            first += mass[:, 0]
        else:
            later += mass
    first[~walk.live] = later[~walk.live] = 0.0
    return ExpectedVisits(first, later, walk.executed(first, later))


def greedy_policy(values: np.ndarray, sets: np.ndarray | None = None) -> np.ndarray:
    """(C, A) probabilities: the best action of the sets (C, A), or all that are as good up to rounding alike."""
    possible: Any = True if sets is None else sets
    largest = np.abs(values).max(axis=1, where=possible, initial=0.0)
    most = values.max(axis=1, where=possible, initial=-np.inf)
    best = (values >= (most - TIES * largest)[:, None]) & possible
    return best / best.sum(axis=1, keepdims=True)
