"""The regret of Q-learning in the kernel of an agent's network, in expectation: nothing is sampled, no network trained.

An idealised DQN. Its network is replaced by its tangent kernel, its replay buffer by the exact expected visits of its
own behaviour, its targets by exact expectations. With the identity in the place of the kernel it is tabular Q-learning,
the same learner without a representation. So is hardness defined by GORP (Laidlaw et al., 2023) and SQIRL (2024), as
the cost of an idealised algorithm; here the algorithm's function class is the agent's, and its cost is not sampled.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from pharos.hardness.representation.kernel_operator import Exact, Identity, KernelOperator, Landmarks
from pharos.hardness.representation.mean_field import (
    MARGIN,
    WORST_GREEDY,
    WORST_PLAYED,
    Learner,
    LearningCurve,
    Schedule,
)
from pharos.hardness.representation.representation import LANDMARKS, MOST_EXACT, Grouped, Representation
from pharos.hardness.visitation.occupancy import drawn, standard_occupancy
from pharos.mdp import TabularMDP, require_mdp
from pharos.solvers import Solution

RAREST = 1e-9  # of the largest weight: observations are taken to be at least as frequent where gradients are rescaled


@dataclass(frozen=True, eq=False)
class KernelRegret:
    """Regret of the idealised learner, with the kernel and without it.

    Attributes:
        curve: with the kernel; tabular: with the identity in its place, on the states themselves.
        observations: different ones that it learns from; states: that can be met and are not terminal.
        landmarks: of the approximation; None: the kernel is exact.
        estimated_error, estimated_error_played: half of the landmarks change the regret of the greedy policies, and
            what is played, by that much: estimates, not bounds; 0 where exact.
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
        """What is approximate."""
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
    progress: Callable[[str], None] | None = None,  # noqa: ARG001  (learners of a report have one signature)
) -> KernelRegret:
    """Return the expected regret of Q-learning in the tangent kernel of a network.

    With Q = 0 and D = 0, for each phase of c steps, g gradient steps and the learner's discount:

        pi = epsilon-greedy in Q;   D += c times the occupancy of pi;   y = r + gamma E max_a Q(s', a)
        g times:   Q(., a) += eta K diag(d(., a)) (y(., a) - Q(., a)),   d = D / sum of D

    eta is 1 / (1.05 times the largest eigenvalue of K diag(max_a d)), the largest stable step: no learning rate.
    The value is the mean over phases of (V* - V of the greedy policy) / (V* - V of uniform play).

    Args:
        representation: the kernel; see `pharos.observations.representation`.
        schedule: None: that of `Schedule`.
        solution: the optimal values of `mdp`, where they are known.
        horizon: steps of an episode that the learner sees; None: the MDP's, else the time limit.
    Returns:
        A KernelRegret. Actions whose values are within 1e-6 of the state's largest one are chosen alike. Values are in
        the MDP's setting (gamma, horizon). What agents see is the state, not the previous action: under sticky actions
        a target is the mean over previous actions, weighted by visits. Rewards are expected ones: their noise is drawn
        by `sampled_regret` alone.
    Raises:
        UndefinedMeasure: there is neither a horizon nor a time limit; or uniform play is optimal.
        ParameterError: the representation is of other states, or its kernel does not fit into memory.
    Cost: for each phase about 4 sqrt(g) products of the kernel with A columns, walks of T steps and two values. The
        kernel is 4 C^2 bytes of C different observations; beyond MOST_EXACT of them, landmarks.
    Source: pharos; Sirignano and Spiliopoulos (2019), Cai et al. (2019) for the limit of wide networks.
    """
    representation.check(mdp.num_states)
    episode = representation.episode(mdp.horizon if horizon is None else horizon, "kernel_regret")
    schedule = schedule or Schedule()
    learner = Learner(mdp, schedule, episode, solution)
    return regret_in_kernel(mdp, learner, representation, {"schedule": asdict(schedule)}, "max_a d")


def regret_in_kernel(
    mdp: TabularMDP,
    learner: Learner,
    representation: Representation,
    settings: Mapping[str, Any],
    weights_of_steps: str,
) -> KernelRegret:
    """The regret of a learner with a kernel, by landmarks where there are too many observations, and with a table.

    Args:
        mdp: all of it, also where the learner has the states alone that an episode can meet.
        settings: of the learner, the first of the conventions.
        weights_of_steps: how d weighs the kernel in the step size.
    """
    everything = learner.numbers[learner.states]
    observations = Grouped(representation.classes, everything)
    landmarks, errors = representation.landmarks, (0.0, 0.0)
    if landmarks is None and len(observations) > MOST_EXACT:
        landmarks = LANDMARKS
    observed, is_adam = observations.representatives, learner.schedule.optimizer == "adam"
    is_exact = not landmarks or landmarks >= len(observations)
    operator = Exact(representation.kernel, observed) if is_exact else None  # what does not fit is said at once
    tabular = learner.curve(Grouped(np.arange(mdp.num_states), everything), Identity())
    if not is_exact or is_adam:
        standard = standard_occupancy(mdp, learner.schedule.gamma, learner.episode)
        weights = observations.sums(standard.states[everything])

    def learnt(operator: KernelOperator) -> LearningCurve:
        if is_adam:
            operator.preconditioned(np.maximum(weights, RAREST * weights.max()))
        return learner.curve(observations, operator)

    if operator is not None:
        landmarks, curve = None, learnt(operator)
    else:
        assert landmarks is not None
        chosen = observed[drawn(weights, landmarks)]
        curve, half = (
            learnt(Landmarks(representation.kernel, observed, some)) for some in (chosen, chosen[: landmarks // 2])
        )
        errors = (abs(curve.mean_greedy - half.mean_greedy), abs(curve.mean_played - half.mean_played))
    conventions = {
        **settings,
        "episode": learner.episode,
        "gamma": float(mdp.gamma),
        "horizon": mdp.horizon,
        "step_size": f"1 / ({MARGIN} largest eigenvalue of K diag({weights_of_steps}))",
        "clipped": {"greedy": WORST_GREEDY, "played": WORST_PLAYED},
        **representation.conventions,
    }
    return KernelRegret(
        curve=curve,
        tabular=tabular,
        observations=len(observations),
        states=len(everything),
        landmarks=landmarks,
        estimated_error=errors[0],
        estimated_error_played=errors[1],
        conventions=conventions,
        name=learner.measure,
    )
