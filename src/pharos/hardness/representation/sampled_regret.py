"""The regret of Q-learning in the kernel of an agent's network that draws what the agent draws.

The learner of `kernel_regret` with a walk in the place of expected visits, a replay memory and minibatches in the place
of expected targets, and rewards as they are paid: what a DQN loses by luck, this one loses, too.
"""

import copy
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.representation.learning import (
    DEFAULT_LANDMARKS,
    MOST_WITHOUT_LANDMARKS,
    STEP_MARGIN,
    WORST_GREEDY,
    Grouped,
    IdealisedLearner,
    Identity,
    KernelOperator,
    Landmarks,
    Representation,
    Schedule,
    greedy_policy,
)
from pharos.hardness.visitation import drawn_indices
from pharos.mdp import TabularMDP, paid_outcomes, require_mdp, whole_number
from pharos.solvers import Solution

if TYPE_CHECKING:
    from pharos.kernels.stepping import Episodes, Walk

LOOKS = 30
"""Evaluations at equal distances, beside the one before the first step."""


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Draws of the sampled learner: walks, minibatches, replay memory, noise.

    Attributes:
        walks: independent ones, of which the mean is taken.
        batch_size: transitions of a gradient step.
        buffer_size: transitions that are remembered.
        reward_noise: standard deviation of normal noise on what is paid. The regret is of what is earned.
        reward_scale: what is earned is divided by it before it is paid. Without noise `sampled_regret` does not
            depend on it.
        seed: of the first walk. The others have the next ones.
    """

    walks: int = 3
    batch_size: int = 32
    buffer_size: int = 1_000_000
    reward_noise: float = 0.0
    reward_scale: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("walks", "batch_size", "buffer_size"):
            whole_number(getattr(self, name), f"sampling: {name}")
        if not (math.isfinite(self.reward_noise) and self.reward_noise >= 0):
            raise ParameterError(f"sampling: reward_noise is {self.reward_noise!r}; expected at least 0")
        if not 0 < self.reward_scale < math.inf:
            raise ParameterError(f"sampling: reward_scale is {self.reward_scale!r}; expected a number above 0")
        whole_number(self.seed, "sampling: seed", "a whole number, at least 0", least=0)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able. Without `reward_scale` if it is 1, as it was before there was one."""
        return {name: value for name, value in asdict(self).items() if name != "reward_scale" or value != 1.0}


@dataclass(frozen=True, eq=False)
class SampledCurve:
    """Normalised regret of the greedy policies of several walks: 0 optimal, 1 uniform play.

    Attributes:
        steps: (J,) at which walks were evaluated.
        greedy: (walks, J).
        worst: a policy's regret counts no more than this.
    """

    steps: np.ndarray
    greedy: np.ndarray
    worst: float = WORST_GREEDY

    @property
    def walks(self) -> np.ndarray:
        """(walks,) the mean over evaluations of each. A policy counts at most `worst`."""
        return np.minimum(self.greedy, self.worst).mean(axis=1)

    @property
    def mean(self) -> float:
        """Mean over walks."""
        return float(self.walks.mean())

    @property
    def deviation(self) -> float:
        """Standard deviation of one walk, or NaN if there is a single one."""
        return float(self.walks.std(ddof=1)) if len(self.greedy) > 1 else math.nan

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: steps, and mean over walks."""
        return {"steps": self.steps.tolist(), "greedy": np.round(self.greedy.mean(axis=0), 6).tolist()}


@dataclass(frozen=True, eq=False)
class SampledRegret:
    """Regret of the sampled learner by plain descent, by rescaled gradients, and without a kernel.

    Attributes:
        descent: gradients as they are. adam: gradients rescaled as by full-matrix Adam if all observations are
            equally frequent. tabular: with the identity in the place of the kernel, on the states themselves.
        observations: different ones that it learns from. states: that can be met and are not terminal.
        landmarks: of the approximation. None: the kernel is exact.
        estimated_error: half of the landmarks change the value by that much: an estimate, not a bound. 0 if exact.
        conventions: schedule, sampling, episode, observation and network.
        name: of the measure.
    """

    descent: SampledCurve
    adam: SampledCurve
    tabular: SampledCurve
    observations: int
    states: int
    landmarks: int | None = None
    estimated_error: float = 0.0
    conventions: Mapping[str, Any] = field(default_factory=dict)
    name: str = "sampled_regret"

    @property
    def value(self) -> float:
        """Mean of both forms of descent and of all walks."""
        return (self.descent.mean + self.adam.mean) / 2

    @property
    def deviation(self) -> float:
        """Standard deviation of a walk's value, both forms from the same seed. NaN of a single walk."""
        values = (self.descent.walks + self.adam.walks) / 2
        return float(values.std(ddof=1)) if len(values) > 1 else math.nan

    @property
    def note(self) -> str:
        """Deviation between walks, and the landmarks with their estimated error, as text."""
        count = len(self.descent.greedy)
        text = f"{self.name}: a mean over {count} walks, one of which deviates by {self.deviation:.2g}"
        if count == 1:
            text = f"{self.name}: of a single walk"
        if self.landmarks is None:
            return text
        return (
            f"{text}; by {self.landmarks} landmarks of {self.observations:,} observations; half of them change it by "
            f"{self.estimated_error:.2g}, which is an estimate of the error and no bound"
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-able. Without the deviation if there is a single walk."""
        deviation = {} if math.isnan(self.deviation) else {"deviation": self.deviation}
        return {
            "value": self.value,
            **deviation,
            "descent": self.descent.mean,
            "adam": self.adam.mean,
            "tabular": self.tabular.mean,
            "observations": self.observations,
            "states": self.states,
            "landmarks": self.landmarks,
            "estimated_error": self.estimated_error,
            "conventions": dict(self.conventions),
            "curve": self.descent.to_dict(),
            "adam_curve": self.adam.to_dict(),
            "tabular_curve": self.tabular.to_dict(),
        }

    def __str__(self) -> str:
        return f"{self.value:.3g}; with a table {self.tabular.mean:.3g}"


@require_mdp
def sampled_regret(
    mdp: TabularMDP,
    representation: Representation,
    *,
    schedule: Schedule | None = None,
    sampling: Sampling | None = None,
    solution: Solution | None = None,
    horizon: int | None = None,
    progress: Callable[[str], object] | None = None,
) -> SampledRegret:
    """Return the regret of Q-learning in the tangent kernel of a network, learnt from drawn transitions.

    A walk is epsilon-greedy in Q, from Q = 0, over episodes of T steps. After `schedule.learning_starts` steps it takes
    `schedule.gradient_steps` gradient steps in each `schedule.period` steps, each on a minibatch B of what it
    remembers, drawn with replacement:

        y_i = r_i + gamma max_a Q'(s'_i, a), without the second term if the episode ended;   Q' of the period's start
        Q(., a) += eta / |B| sum_i [a_i = a] (y_i - Q(s_i, a_i)) K(., s_i)

    eta is the largest step that does not overshoot in expectation (`kernel_regret`, with the visits so far), or the
    largest that the minibatch bears, 1 / max_i mean_j [a_i = a_j] |K(s_i, s_j)|, if that is smaller: no learning rate.
    The value of a walk is the mean over 31 evaluations at equal distances of (V* - V of the greedy policy) / (V* - V of
    uniform play). The measure is the mean over walks and over two kernels: K, and the root of K, which is what
    full-matrix Adam makes of K if all observations are equally frequent.

    Args:
        representation: the kernel, see `pharos.observations.representation`.
        schedule: Default: the default of `Schedule`. Its optimizer does not count, as both forms are computed.
        sampling: None: the default of `Sampling`.
        solution: the optimal values of `mdp`, if they are known.
        horizon: steps of an episode that the learner sees. Default: the MDP's, else the time limit.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Returns:
        A SampledRegret. With the identity for a kernel it is tabular Q-learning with a replay memory. Rewards belong to
        drawn outcomes if the MDP is of an environment, else they are expected ones. The same seed gives the same
        number.
    Raises:
        UndefinedMeasure: there is neither a horizon nor a time limit, or uniform play is optimal.
        ParameterError: the representation is of other states, or its kernel does not fit into memory.
    Cost: a walk takes O(steps |B| C / 4) for C different observations, and 31 values, and C^3 once for the root of K.
        Beyond MOST_EXACT observations landmarks, whose walks take no longer for more of them. 24 bytes a step.
    Source: pharos, with what is drawn as in Mnih et al. (2015).
    """
    learner = SampledLearner(mdp, representation, schedule, horizon, solution, progress)
    return learner.measured(sampling or Sampling())


class SampledLearner(IdealisedLearner):
    """Q-learning in a kernel, from drawn transitions of an MDP.

    Attributes:
        largest_error: where temporal differences are cut.
        worst: a policy's regret counts no more than this.
    """

    measure = "sampled_regret"
    sampling: Sampling
    largest_error = math.inf
    worst = WORST_GREEDY

    @cached_property
    def outcomes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(offsets of the outcomes of each pair, next states with -1 for the end, rewards, cumulative
        probabilities)."""
        pairs = self.whole.num_states * self.whole.num_actions
        which, states, rewards, probabilities = paid_outcomes(self.whole)
        offsets = np.searchsorted(which, np.arange(pairs + 1))
        cumulative = np.cumsum(probabilities)
        begin = np.append(0.0, cumulative)[offsets[:-1]]
        levels = (cumulative - begin[which]) / np.add.reduceat(probabilities, offsets[:-1])[which]
        ends = np.where(states == self.whole.num_states, -1, states)
        return offsets, ends, np.asarray(rewards, np.float64) / self.sampling.reward_scale, levels

    def measured(self, sampling: Sampling) -> SampledRegret:
        """The measure: both kernels and a table."""
        self.sampling = sampling
        operators, landmarks = self.operators()
        (descent, adam), *half = map(self.both, operators)
        error = sum((abs(descent.mean + adam.mean - one.mean - other.mean) / 2 for one, other in half), 0.0)
        settings = {"schedule": self.schedule_settings(), "sampling": sampling.to_dict()}
        conventions = self.conventions(settings, {"greedy": self.worst} if math.isfinite(self.worst) else {})
        conventions["step_size"] += ", at most what a minibatch bears"
        return SampledRegret(
            descent=descent,
            adam=adam,
            tabular=self.curve_of_walks(self.table, Identity()),
            observations=len(self.observations),
            states=len(self.states),
            landmarks=landmarks,
            estimated_error=error,
            conventions=conventions,
            name=self.measure,
        )

    def both(self, operator: KernelOperator) -> tuple[SampledCurve, SampledCurve]:
        """(regret with a kernel, regret with its root)."""
        observations = self.observations
        root = copy.copy(operator)  # whose arrays are replaced, not changed
        root.preconditioned(np.full(len(observations), 1 / len(observations)))
        return self.curve_of_walks(observations, operator), self.curve_of_walks(observations, root)

    def steps(self) -> np.ndarray:
        """(J,) at which walks are evaluated."""
        return np.unique(np.round(np.linspace(0, self.schedule.steps, LOOKS + 1)).astype(np.int64))

    @property
    def seeds(self) -> range:
        """Seeds of the walks."""
        return range(self.sampling.seed, self.sampling.seed + self.sampling.walks)

    def schedule_settings(self) -> dict[str, Any]:
        """The schedule, JSON-able. Its optimizer does not count."""
        return {name: value for name, value in asdict(self.schedule).items() if name != "optimizer"}

    def curve_of_walks(
        self, observations: Grouped, operator: KernelOperator, seeds: range | None = None
    ) -> SampledCurve:
        """The regret of walks of some seeds, or of all, with a kernel over the observations."""
        steps = self.steps()
        walks = (self.walk(observations, operator, steps, seed) for seed in seeds or self.seeds)
        regrets = np.array([[self._regret_of(q, observations) for q in walk] for walk in walks])
        return SampledCurve(steps, regrets, self.worst)

    def start(self, observations: Grouped, seed: int) -> np.ndarray:
        """Q (A, C) of a walk before its first step."""
        return np.zeros((self.whole.num_actions, len(observations)))

    def _regret_of(self, q: np.ndarray, observations: Grouped) -> float:
        """Regret of the policy that is greedy in values (C, A)."""
        return self.regret(self.value(greedy_policy(q, observations.sets)[observations.groups]))

    def walk(
        self, observations: Grouped, operator: KernelOperator, looks: np.ndarray, seed: int
    ) -> Iterator[np.ndarray]:
        """Yield the learnt values (C, A) of one walk at each of the steps `looks`, ascending."""
        from pharos.kernels import stepping as kernels

        count, num_actions = len(observations), self.whole.num_actions
        kernel = operator.parts(count)
        learnt = self.start(observations, seed), np.zeros((num_actions, kernel[1].shape[1]))
        target = tuple(each.copy() for each in learnt)
        walk, vector, largest_step = self.first_walk(count, seed), np.full((count, 1), count**-0.5), 0.0
        for step, run in self.stretches(observations, looks, walk):
            if step in looks:
                values = np.empty((count, num_actions))
                kernels.kernel_values(kernel, learnt, values)
                yield values
            if self.is_copied(step):
                for old, new in zip(target, learnt, strict=True):
                    old[:] = new
                weights = walk.visits.max(axis=1, keepdims=True) / max(step, 1)
                largest = operator.largest_eigenvalue(weights, vector) if step else 0.0
                largest_step = 1 / (STEP_MARGIN * largest) if largest > 0 else math.inf
            run((kernel, learnt, target), largest_step)

    def is_copied(self, step: int) -> bool:
        """Whether the target network is copied at a step, of those between which the walk runs."""
        period = self.schedule.period
        return step % period == 0 and step + period > self.schedule.learning_starts

    def first_walk(self, count: int, seed: int) -> "Walk":
        """A walk before its first step, over so many observations."""
        from pharos.kernels.stepping import Walk

        sampling = self.sampling
        size = min(sampling.buffer_size, self.schedule.steps)
        memory = *(np.zeros(size, np.int64) for _ in range(3)), np.zeros(size)
        minibatch = np.zeros(sampling.batch_size, np.int64), np.zeros(sampling.batch_size)
        visits, cursor = np.zeros((count, self.whole.num_actions)), np.array([-1, -1, 0, 0], np.int64)
        words = self.words(seed)
        noise = float(sampling.reward_noise), words[1:].copy()
        return Walk(memory, visits, cursor, words[:1].copy(), noise, minibatch)

    def words(self, seed: int) -> np.ndarray:
        """(2,) uint64: the streams of a walk, and of the noise of its rewards."""
        return np.random.SeedSequence(seed, spawn_key=(2,)).generate_state(2, np.uint64)

    def course(self, observations: Grouped) -> tuple[np.ndarray, "Episodes"]:
        """((S,) observations of states, -1 where there is none; start, course and end of the episodes)."""
        from pharos.kernels.stepping import Episodes

        mdp = self.whole
        group = np.full(mdp.num_states, -1, np.int64)
        group[self.numbers] = observations.groups
        chance = (*mdp.chance.triple[:2], 0.0, float(mdp.chance.first_chosen))
        sets = () if observations.sets is None else (np.ascontiguousarray(observations.sets),)
        cumulative = np.append(np.cumsum(mdp.start_probabilities[:-1]), 1.0)
        starts, terminal = np.asarray(mdp.start_states, np.int64), np.asarray(mdp.terminal, np.bool_)
        return group, Episodes(terminal, starts, cumulative, (*chance, *sets), self.episode)

    def stretches(
        self, observations: Grouped, looks: np.ndarray, walk: "Walk"
    ) -> Iterator[tuple[int, Callable[[tuple[object, ...], float], None]]]:
        """Yield (step, a function that walks from it to the next) of all steps at which there is something to do.

        The function takes (kernel, learnt, target) as `kernels.stepping.learn` does, and the largest step of descent.
        """
        from pharos.kernels import stepping as kernels

        schedule = self.schedule
        group, episodes = self.course(observations)
        numbers = (
            *(schedule.gamma, schedule.exploration_initial_eps, schedule.exploration_final_eps),
            schedule.exploration_fraction * schedule.steps,
            *(int(schedule.learning_starts), int(schedule.gradient_steps), int(schedule.period)),
        )
        stops = np.unique([*looks, *range(0, schedule.steps, schedule.period)])
        for step, next_stop in zip(stops, [*stops[1:], schedule.steps], strict=True):
            self.report(f"step {step:,} of {schedule.steps:,} of a walk")

            def run(values: tuple[object, ...], largest_step: float, steps: int = int(next_stop - step)) -> None:
                settings = (*numbers, largest_step, self.largest_error)
                kernels.learn(self.outcomes, group, episodes, values, walk, settings, steps)

            yield int(step), run


# With the agent's loss, from a random network -------------------------------------------------------------------------


@require_mdp
def huber_regret(
    mdp: TabularMDP,
    representation: Representation,
    *,
    schedule: Schedule | None = None,
    sampling: Sampling | None = None,
    solution: Solution | None = None,
    horizon: int | None = None,
    progress: Callable[[str], object] | None = None,
) -> SampledRegret:
    """Return the regret of Q-learning in a network's tangent kernel with the Huber loss, from a random network.

    This is `sampled_regret` with two parts of a DQN that it leaves out:

        Q(., a) += eta / |B| sum_i [a_i = a] min(max(y_i - Q(s_i, a_i), -1), 1) K(., s_i)
        Q(., a) before the first step is a draw from the Gaussian process of the network's outputs, for each action anew

    So the unit of rewards matters: the larger they are, the more steps it takes to learn their values. The regret of a
    policy is not cut, as that of runs is not. A table begins at zeros.

    Args:
        representation: as for `sampled_regret`, with the covariance of the network's outputs.
        schedule, sampling, solution, horizon, progress: as for `sampled_regret`.
    Returns:
        A SampledRegret.
    Raises:
        UndefinedMeasure: the representation does not have that covariance, or as for `sampled_regret`.
        ParameterError: the covariance is no finite matrix, or a variance is below 0, or as for `sampled_regret`.
    Cost: as for `sampled_regret`, and C^3 once more for the draw.
    Source: pharos, with the loss as in Huber (1964) and Mnih et al. (2015), and the process as in Lee et al. (2018).
    """
    learner = HuberLearner(mdp, representation, schedule, horizon, solution, progress)
    return learner.measured(sampling or Sampling())


class HuberLearner(SampledLearner):
    """The sampled learner with the Huber loss, from a random network."""

    measure = "huber_regret"
    largest_error = 1.0
    worst = math.inf

    @cached_property
    def outputs(self) -> Landmarks:
        """The covariance of the random network's outputs over observations, as features and a diagonal."""
        observed, covariance = self.observations.representatives, self.representation.covariance
        if covariance is None:
            raise UndefinedMeasure(
                f"{self.measure} needs the covariance of the network's outputs, which this representation does not "
                "have: give it as `covariance`, or take a representation of pharos.observations"
            )

        def checked(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
            block = np.asarray(covariance(rows, columns))
            is_matrix = block.shape == (len(rows), len(columns)) and bool(np.isfinite(block).all())
            if not is_matrix or (rows is columns and bool((np.diag(block) < 0).any())):
                raise ParameterError(
                    f"covariance has shape {block.shape}; expected finite numbers of shape {len(rows), len(columns)}, "
                    "and none below 0 of an observation with itself"
                )
            return block

        if len(observed) <= MOST_WITHOUT_LANDMARKS:
            return Landmarks(checked, observed, observed)
        return Landmarks(checked, observed, observed[drawn_indices(self.weights, DEFAULT_LANDMARKS)])

    def start(self, observations: Grouped, seed: int) -> np.ndarray:
        """A draw of the process. A table begins at zeros."""
        if observations is self.table:
            return super().start(observations, seed)
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(3,)))
        features, diagonal, actions = self.outputs.features, self.outputs.diagonal, self.whole.num_actions
        of_features = rng.standard_normal((features.shape[1], actions))
        of_each = rng.standard_normal((len(features), actions))
        return np.ascontiguousarray((features @ of_features + np.sqrt(diagonal) * of_each).T)
