"""The regret of a DQN and of a PPO in an idealised network, which Adam moves by the agent's own steps.

The learner of `sampled_regret` draws what an agent draws, but takes the largest steps that are stable, in a kernel that
stays as it is. This one takes the agent's, by its learning rate; and its network has two groups of parameters, each of
which makes the other learn faster as it grows (kernels/idealised_network.py).
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.representation.kernel_regret import PolicyLearner, softmax
from pharos.hardness.representation.learning import (
    Adam,
    Identity,
    OutputLayer,
    Representation,
    Rollouts,
    Schedule,
)
from pharos.hardness.representation.sampled_regret import LOOKS, SampledCurve, SampledLearner, Sampling
from pharos.mdp import TabularMDP, require_mdp
from pharos.solvers import Solution

if TYPE_CHECKING:
    from pharos.kernels.actor_critic import Rollout

NETWORK_WALKS = 8
"""Walks of which the mean is taken. More help little (docs/evidence/network-regret.md)."""
TABLE_WALKS = 3
"""Those of them that are walked with a table in the place of the network, too."""
MOST_OBSERVATIONS = 4096
"""Different observations of an idealised network: its kernels are matrices."""
POLICY_WEIGHTS = 0.01**2
"""Squared weights of a policy's outputs before training, as a share of those of its values (Stable-Baselines3)."""


@dataclass(frozen=True, eq=False)
class NetworkRegret:
    """Regret of an agent in an idealised network.

    Attributes:
        curve: of each walk, at evaluations at equal distances.
        tabular: the mean regret of the same agent with a table. A DQN's is of TABLE_WALKS walks at most.
        diverged: walks in which values or logits became infinite. They keep their last policy before that.
        observations: different ones that it learns from. states: that can be met and are not terminal.
        conventions: schedule, sampling, optimizer, episode, observation and network.
        name: of the measure.
    """

    curve: SampledCurve
    tabular: float
    diverged: int
    observations: int
    states: int
    conventions: Mapping[str, Any] = field(default_factory=dict)
    name: str = "network_regret"

    @property
    def value(self) -> float:
        """Mean over evaluations and walks."""
        return self.curve.mean

    @property
    def note(self) -> str:
        """Deviation between walks, as text, and how many diverged."""
        count = len(self.curve.greedy)
        text = f"{self.name}: a mean over {count} walks, one of which deviates by {self.curve.deviation:.2g}"
        if count == 1:
            text = f"{self.name}: of a single walk"
        return text if not self.diverged else f"{text}; values of {self.diverged} of {count} walks became infinite"

    def to_dict(self) -> dict[str, Any]:
        """JSON-able. Without the deviation if there is a single walk. The curve is a mean over walks."""
        deviation = {} if math.isnan(self.curve.deviation) else {"deviation": self.curve.deviation}
        return {
            "value": self.value,
            **deviation,
            "tabular": self.tabular,
            "diverged": self.diverged,
            "observations": self.observations,
            "states": self.states,
            "landmarks": None,
            "estimated_error": 0.0,
            "conventions": dict(self.conventions),
            "curve": self.curve.to_dict(),
        }

    def __str__(self) -> str:
        return f"{self.value:.3g}; with a table {self.tabular:.3g}"


@require_mdp
def network_regret(
    mdp: TabularMDP,
    representation: Representation,
    *,
    schedule: Schedule | None = None,
    sampling: Sampling | None = None,
    adam: Adam | None = None,
    solution: Solution | None = None,
    horizon: int | None = None,
    progress: Callable[[str], object] | None = None,
) -> NetworkRegret:
    """Return the regret of a DQN in an idealised network, learnt from drawn transitions by Adam's steps.

    The walk, the memory, the minibatches B and the target Q' are those of `sampled_regret`, the Huber loss and the
    start those of `huber_regret`. A gradient step has the error e_a(x) = 1 / |B| sum_i [a_i = a, s_i = x] min(max(y_i -
    Q(x, a), -1), 1), and

        Q_a += eta_1 m(H e_a) + eta_2 sum_b M_ab m(B e_b),   eta_j = rho_j rate / (sqrt(v_j / P_j) + epsilon)

    m and v_j: Adam's means of what stands in brackets and of the squared gradient of either group of parameters, the
    output layer (e' H e) and the layers beneath (sum_ab M_ab e_a' B e_b), clipped alike; P_j: parameters of the group,
    rho_j: how even their gradients are (`OutputLayer`). H: the kernel of the output layer, M: the products of the
    outputs' weights, B: the kernel of the layers beneath, for weights of length 1: (K - H) / n v. At each copy of the
    target H and M become what has been learnt by then, with A and G the sums of eta_1 m(e) and eta_2 m(B e) since:

        M += A f' + f A' + A H A',    H += G' f + f' G + G' M G,    f = Q at the copy before

    (without the bias). The value of a walk is the mean over 31 evaluations at equal distances of (V* - V of the greedy
    policy) / (V* - V of uniform play), uncut as that of runs.

    Args:
        representation: with `output_layer` and `covariance`, see `pharos.observations.representation`.
        schedule: Default: the default of `Schedule`. sampling: None: the default of `Sampling`, with NETWORK_WALKS
            walks. adam: None: the default of `Adam`.
        solution: the optimal values of `mdp`, if they are known.
        horizon: steps of an episode that the learner sees. Default: the MDP's, else the time limit.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Returns:
        A NetworkRegret. The same seed gives the same number. The unit of rewards matters, as it does to a DQN.
    Raises:
        UndefinedMeasure: the representation's output layer is not known, it has landmarks or more than
            MOST_OBSERVATIONS different observations, there is neither a horizon nor a time limit, or uniform play is
            optimal.
        ParameterError: the representation is of other states, or its kernel does not fit into memory.
    Cost: 8 C^2 bytes of C different observations and 4 C^2 a walk. A gradient step takes O((|B| + A^2) C), a copy of
        the target O(A C^2). 0.04 s a walk of 30 thousand steps for 16 observations, 0.4 s for 1,000.
    Source: pharos; Mnih et al. (2015), Kingma and Ba (2015), and Jacot et al. (2018) for the kernels.
    """
    learner = NetworkQLearner(mdp, representation, schedule, horizon, solution, progress)
    learner.sampling, learner.adam = sampling or Sampling(walks=NETWORK_WALKS), adam or Adam()
    return learner.measured_in_network({"schedule": learner.schedule_settings()})


@require_mdp
def network_policy_regret(
    mdp: TabularMDP,
    representation: Representation,
    *,
    schedule: Schedule | None = None,
    rollouts: Rollouts | None = None,
    sampling: Sampling | None = None,
    adam: Adam | None = None,
    solution: Solution | None = None,
    horizon: int | None = None,
    progress: Callable[[str], object] | None = None,
) -> NetworkRegret:
    """Return the regret of a PPO in two idealised networks, of its policy and of its values, by Adam's steps.

    Rollouts are drawn, of several environments in turn. Advantages are generalised ones (lambda), standardised in each
    minibatch, ratios are clipped, there is an entropy bonus, and the gradient of both networks is clipped as one.
    Logits and values learn as Q does in `network_regret`. The policy's outputs begin with 0.01 of the weights of the
    values', as in Stable-Baselines3. Networks are settled after each rollout. No hyperbolic tangent grows beyond 1.
    The value of a walk is the mean over about 31 rollouts at equal distances of (V* - V of the policy) / (V* - V of
    uniform play): of the distribution over actions, which evaluations see.

    Args:
        representation: as for `network_regret`, of an actor-critic `initialisation="sb3"`.
        schedule: for its steps and discount. rollouts: None: the defaults of `Rollouts`, with clip_range 0.2.
        sampling: for its walks (None: NETWORK_WALKS), seed, and noise and scale of rewards.
        adam, solution, horizon, progress: as for `network_regret`.
    Returns, raises, cost: as for `network_regret`.
    Source: pharos; Schulman et al. (2016, 2017), Kingma and Ba (2015).
    """
    learner = NetworkPolicyLearner(mdp, representation, schedule, horizon, solution, progress)
    learner.sampling, learner.adam = sampling or Sampling(walks=NETWORK_WALKS), adam or Adam()
    learner.rollouts = rollouts or Rollouts(clip_range=0.2)
    of_schedule = {name: getattr(learner.schedule, name) for name in ("steps", "gamma")}
    return learner.measured_in_network({"schedule": of_schedule, "rollouts": learner.rollouts.to_dict()})


def is_for_networks(representation: Representation) -> bool:
    """Whether `network_regret` takes a representation, as far as that shows before the states of episodes are known."""
    numbers = int(representation.classes.max(initial=-1)) + 1
    return representation.output_layer is not None and numbers <= MOST_OBSERVATIONS and not representation.landmarks


class NetworkQLearner(SampledLearner):
    """A DQN in an idealised network. Base class of that of a PPO."""

    measure = "network_regret"
    largest_error = 1.0
    worst = math.inf
    adam: Adam
    layer: OutputLayer
    last: np.ndarray
    beneath: np.ndarray
    diverged = 0

    def measured_in_network(self, settings: Mapping[str, Any]) -> NetworkRegret:
        """The measure. settings: of the learner, the first of the conventions."""
        layer, count = self.representation.output_layer, len(self.observations)
        if layer is None:
            raise UndefinedMeasure(
                f"{self.measure} needs a network whose output layer is known: take a representation of "
                "pharos.observations, and if the network is a function's, let it end with a torch.nn.Linear"
            )
        if self.representation.landmarks:
            raise UndefinedMeasure(f"{self.measure} takes no landmarks: leave them out, or give 0")
        if count > MOST_OBSERVATIONS:
            raise UndefinedMeasure(
                f"{self.measure}: {count:,} different observations; it is for at most {MOST_OBSERVATIONS:,}, as its "
                "kernels are matrices"
            )
        self.layer = layer
        observed = self.observations.representatives
        self.last = np.asarray(layer.kernel(observed, observed), np.float32)
        whole = np.asarray(self.representation.kernel(observed, observed), np.float32)
        self.beneath = (whole - self.last) / np.float32(layer.weights)
        walks = [list(self.regrets(seed)) for seed in self.seeds]
        conventions = self.conventions({**settings, "sampling": self.sampling.to_dict(), "adam": asdict(self.adam)}, {})
        return NetworkRegret(
            curve=SampledCurve(self.steps(), np.array(walks), self.worst),
            tabular=self.with_a_table(),
            diverged=self.diverged,
            observations=count,
            states=len(self.states),
            conventions={**conventions, "step_size": "Adam's, by its learning rate"},
            name=self.measure,
        )

    def with_a_table(self) -> float:
        """Mean regret with a table in the place of the network."""
        return self.curve_of_walks(self.table, Identity(), self.seeds[:TABLE_WALKS]).mean

    def regrets(self, seed: int) -> Iterator[float]:
        """Yield the regret of a walk at each of `steps`."""
        observations, looks = self.observations, self.steps()
        walk, network = self.first_walk(len(observations), seed), self.network(seed)
        for step, run in self.stretches(observations, looks, walk):
            if self.is_copied(step) or not np.isfinite(network.net.outputs).all():
                network.settle()
            if step in looks:
                yield self._regret_of(network.net.outputs.T, observations)
            if network.is_finite:
                run((network.constants, network.net, network.before), 0.0)
        self.diverged += not network.is_finite

    def network(self, seed: int, outputs: int | None = None, stream: int = 4, share: float = 1.0) -> "IdealisedNetwork":
        """A network before training, whose outputs are a draw. share: of the squared weights of the outputs."""
        size = self.whole.num_actions if outputs is None else outputs
        weights, adam, layer = share * self.layer.weights, self.adam, self.layer
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))
        start = np.sqrt(weights / max(layer.parameters[0] - layer.has_bias, 1)) * (
            rng.standard_normal((size, len(self.root))) @ self.root
        )
        beneath = max(layer.parameters[1], 1)  # a linear network has none
        numbers = (float(layer.parameters[0] * size), float(beneath), *map(float, layer.evenness))
        optimizer = (adam.learning_rate, adam.epsilon, adam.decay, adam.decay_of_squares, *numbers)
        return IdealisedNetwork(self.last.copy(), self.beneath, weights, start, (optimizer, adam.max_grad_norm), layer)

    @cached_property
    def root(self) -> np.ndarray:
        """(C, C): R of R' R = the covariance of outputs before training, in units of a weight's variance."""
        values, vectors = np.linalg.eigh(self.last.astype(np.float64) - (1.0 - self.layer.bias))
        return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


class IdealisedNetwork:
    """A network as its outputs and two kernels, and what Adam does with it.

    Attributes:
        net: its arrays, see `pharos.kernels.idealised_network`. before: (A, C) its outputs when it was settled last.
        constants: of Adam, and the length to which gradients are clipped.
        is_finite: whether its outputs are.
    """

    def __init__(
        self,
        last: np.ndarray,
        beneath: np.ndarray,
        weights: float,
        outputs: np.ndarray,
        constants: tuple[tuple[float, ...], float],
        layer: OutputLayer,
    ):
        from pharos.kernels.idealised_network import Net

        size, count = outputs.shape

        def zeros() -> np.ndarray:
            return np.zeros((size, count))

        self.net = Net(
            last=last,
            beneath=beneath,
            gram=weights * np.eye(size),
            outputs=np.ascontiguousarray(outputs),
            by_last=zeros(),
            by_beneath=zeros(),
            by_error=zeros(),
            weights=zeros(),
            grown=zeros(),
            squares=np.zeros(3),
            error=zeros(),
            first=zeros(),
            second=zeros(),
            live=np.zeros(count + 1, np.int64),
            is_live=np.zeros(count, np.bool_),
        )
        self.before, self.bias, self.largest = self.net.outputs.copy(), np.zeros((size, 1)), layer.largest
        self.constants, self.has_bias, self.is_finite = constants, layer.has_bias, True

    def settle(self) -> None:
        """Make of H and M what has been learnt since they were settled last. Infinite numbers are taken back.

        Outputs do not follow the Gram matrices exactly, so that these are held to what products can be: |f_a(x)|^2 <=
        M_aa (H(x, x) - 1), H(x, y)^2 <= H(x, x) H(y, y), H(x, x) >= 1 with biases, M positive semidefinite. Features
        that saturate (hyperbolic tangents) shrink H as a whole.
        """
        from pharos.kernels.idealised_network import move_kernel

        net = self.net
        f, moved, grown = self.before - self.bias, net.weights, net.grown
        with np.errstate(over="ignore", invalid="ignore"):
            total = self.has_bias * moved.sum(axis=1, keepdims=True)  # of the biases
            product = moved @ f.T
            gram = net.gram + product + product.T - total @ total.T
            gram += moved @ (net.last @ moved.T.astype(np.float32))
            left, right = (each.astype(np.float32) for each in (grown, f + net.gram @ grown / 2))
            largest = 2 * len(left) * np.abs(left).max(initial=0) * np.abs(right).max(initial=0)  # that H moves by
        if not (self.is_finite and all(np.isfinite(each).all() for each in (net.outputs, gram, largest))):
            self.is_finite = False
            net.outputs[:] = self.before
            return
        self.bias += total
        lengths = np.diag(net.last) + 2 * (left * right).sum(axis=0)
        square = np.minimum(np.maximum(lengths, self.has_bias), self.largest).astype(np.float32)
        shrunk = np.sqrt(np.divide(square, lengths, out=np.ones_like(square), where=lengths > square))
        move_kernel(net.last, left, right, shrunk, np.sqrt(square), np.float32(self.has_bias))
        values, vectors = np.linalg.eigh((gram + gram.T) / 2)
        net.gram[:] = (vectors * np.maximum(values, 0.0)) @ vectors.T
        least = ((net.outputs - self.bias) ** 2 / np.maximum(square - self.has_bias, 1e-3)).max(axis=1)
        net.gram[np.diag_indices_from(gram)] = np.maximum(np.diag(net.gram), least)
        net.weights[:] = net.grown[:] = 0.0
        self.before[:] = net.outputs


class NetworkPolicyLearner(NetworkQLearner, PolicyLearner):
    """A PPO in two idealised networks."""

    measure = "network_policy_regret"
    rollouts: Rollouts

    def steps(self) -> np.ndarray:
        """(J,) at which rollouts begin before which the policy is evaluated, and the end."""
        size = self.rollouts.steps
        begin = np.append(np.arange(0, self.schedule.steps, size), self.schedule.steps)
        return begin[np.unique(np.round(np.linspace(0, len(begin) - 1, LOOKS + 1)).astype(np.int64))]

    def with_a_table(self) -> float:
        return self.curve(self.table, Identity()).mean_evaluated

    def regrets(self, seed: int) -> Iterator[float]:
        from pharos.kernels import actor_critic as kernels

        rollouts, observations, looks = self.rollouts, self.observations, self.steps()
        actor = self.network(seed, share=POLICY_WEIGHTS)
        critic, rollout = self.network(seed, 1, stream=5), self.first_rollout(seed)
        group, episodes = self.course(observations)
        epochs = rollouts.epochs or 4
        size = math.ceil(rollouts.steps * epochs / rollouts.gradient_steps)
        weights = [
            default if value is None else value
            for value, default in ((rollouts.entropy_weight, 0.01), (rollouts.value_weight, 0.5))
        ]
        far = math.inf if rollouts.clip_range is None else rollouts.clip_range
        settings = (epochs, size, far, *weights, self.adam.max_grad_norm)
        discounts = float(self.schedule.gamma), float(rollouts.gae_lambda)
        end = self.schedule.steps
        for step in [*range(0, end, rollouts.steps), end]:
            self.report(f"step {step:,} of {end:,} of a walk")
            actor.settle()
            critic.settle()
            is_finite = actor.is_finite and critic.is_finite
            if step in looks:
                policy = softmax(observations.masked(actor.net.outputs.T))[observations.groups]
                yield self.regret(self.value(policy))
            if step < end and is_finite:
                kernels.play(self.outcomes, group, episodes, actor.net, critic.net, rollout, discounts)
                kernels.learn_from_rollout(
                    episodes.chance, actor.net, critic.net, rollout, settings, actor.constants[0], critic.constants[0]
                )
        self.diverged += not is_finite

    def first_rollout(self, seed: int) -> "Rollout":
        """Environments before their first step."""
        from pharos.kernels.actor_critic import Rollout

        count = self.rollouts.environments or 8
        size, words = self.rollouts.steps, self.words(seed)
        if size % count:
            raise ParameterError(f"rollouts: {size} steps are not divided by {count} environments")
        length = size // count + 1
        states = np.full(count, -1, np.int64), np.full(count, -1, np.int64), np.zeros(count, np.int64)
        noise = float(self.sampling.reward_noise), words[1:].copy()
        steps = *(np.zeros(size, np.int64) for _ in range(2)), *(np.zeros(size) for _ in range(3))
        room = np.zeros(size, np.int64), *(np.zeros(length) for _ in range(3))
        return Rollout(*states, words[:1].copy(), noise, *steps, *room)
