"""DQN and PPO in an idealised network: against slow twins, explicit networks, and networks of PyTorch."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import strategies as st
from test_kernel_measures import kernel_of
from test_sampled_regret import WORLDS, plain_walk

from naive import networks as naive
from pharos.hardness import (
    Adam,
    OutputLayer,
    Representation,
    Rollouts,
    Sampling,
    Schedule,
)
from pharos.hardness.representation.network_regret import (
    POLICY_WEIGHTS,
    IdealisedNetwork,
    NetworkLearner,
    NetworkPolicyLearner,
)
from strategies import examples

SHORT = Schedule(steps=700, period=50, gradient_steps=13, learning_starts=60, gamma=0.9)
ONCE = Sampling(walks=1, batch_size=8, buffer_size=150)
FAST = Adam(learning_rate=0.01)


def seen_by(num_states, classes=None, *, largest=math.inf):
    """A representation of random features, whose output layer has 16 units."""
    numbers = np.arange(num_states) if classes is None else classes
    hidden = np.random.default_rng(5).random((num_states, 16))[numbers]
    last, whole = hidden @ hidden.T + 1, np.asarray(kernel_of(num_states), np.float64)[np.ix_(numbers, numbers)]
    layer = OutputLayer(lambda x, y: last[np.ix_(x, y)], 0.5, (17, 64), (0.6, 0.4), largest)
    return Representation.of_matrix(whole + last, numbers, output_layer=layer)


def recorded(of, mdp, seen, schedule, adam, sampling, rollouts=None):
    """(measure, learner, its networks after the first walk, their slow twins before it)."""
    networks, twins = [], []

    class Recorded(of):
        def network(self, *arguments, **options):
            networks.append(super().network(*arguments, **options))
            twins.append(naive.Network(networks[-1].net, adam, self.layer))
            return networks[-1]

    learner = Recorded(mdp, seen, schedule, 7)
    learner.sampling, learner.adam, learner.rollouts = sampling, adam, rollouts
    return learner.measured_in_network({}), learner, networks, twins


def numbers_of(learner):
    """(S,) the observation of each state, -1 of those that are not seen."""
    number = np.full(learner.whole.num_states, -1)
    number[learner.numbers] = learner.observations.groups
    return number.tolist()


def assert_same(network, twin):
    for found, expected in (
        (network.net.outputs, twin.outputs),
        (network.net.last, twin.H),
        (network.net.gram, twin.M),
        (network.bias, twin.bias),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())


DRAWS = {
    "as it is": (ONCE, FAST, False),
    "look alike": (ONCE, FAST, True),
    "noisy": (replace(ONCE, reward_noise=0.7, reward_scale=0.25), FAST, False),
    "clipped": (replace(ONCE, reward_scale=0.1), replace(FAST, max_grad_norm=2.0, decay=0.5, epsilon=0.01), False),
}


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("draws", DRAWS)
def test_a_walk_of_a_dqn_is_the_definition(name, draws):
    (sampling, adam, is_aliased), mdp = DRAWS[draws], WORLDS[name]()
    seen = seen_by(mdp.num_states, np.arange(mdp.num_states) // 2 if is_aliased else None)
    _, learner, (network,), (twin,) = recorded(NetworkLearner, mdp, seen, SHORT, adam, sampling)
    start, classes = twin.outputs.T.copy(), numbers_of(learner)
    plain_walk(mdp, np.eye(len(start)), classes, SHORT, sampling, 7, SHORT.steps, start, 1.0, twin)
    twin.settle()  # as the target is copied at the last step, too
    assert np.abs(twin.outputs.T - start).max() > 0.1
    assert_same(network, twin)


# PPO ------------------------------------------------------------------------------------------------------------------


def derivatives_by_torch(mdp, classes, rollouts):
    """Derivatives of Stable-Baselines3's loss of a PPO by logits and values, by automatic differentiation."""
    torch = pytest.importorskip("torch")
    sets = np.ones((max(classes) + 1, mdp.num_actions), bool)
    if mdp.available is not None:
        for s in np.flatnonzero(np.array(classes) >= 0):
            sets[classes[s]] = mdp.available[s]

    def derivatives(logits, values, observations, actions, log_probabilities, advantages, returns):
        z, v = (torch.tensor(each, requires_grad=True) for each in (logits, values))
        some, before, gain, goal = (torch.as_tensor(each) for each in (sets, log_probabilities, advantages, returns))
        if len(gain) > 1:
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
        masked = z.T.masked_fill(~some, -math.inf)[observations]
        logs = torch.log_softmax(masked, dim=1)
        ratio = torch.exp(logs[torch.arange(len(gain)), torch.as_tensor(actions)] - before)
        far = rollouts.clip_range or math.inf
        surrogate = torch.min(gain * ratio, gain * torch.clamp(ratio, 1 - far, 1 + far)).mean()
        finite = logs.masked_fill(~some[observations], 0.0)
        entropy = -(torch.softmax(masked, dim=1) * finite).sum(dim=1).mean()
        errors = torch.nn.functional.mse_loss(v[observations], goal)
        (surrogate + rollouts.entropy_weight * entropy - rollouts.value_weight * errors).backward()
        return z.grad.numpy(), v.grad.numpy()

    return derivatives


ROLLOUTS = Rollouts(
    steps=60,
    gradient_steps=13,
    gae_lambda=0.8,
    clip_range=0.1,
    environments=3,
    epochs=3,
    entropy_weight=0.2,
    value_weight=0.7,
)
PLAYS = {
    "as it is": (ROLLOUTS, ONCE, False, 10.0),
    "look alike": (ROLLOUTS, ONCE, True, 10.0),
    "noisy": (replace(ROLLOUTS, clip_range=None), replace(ONCE, reward_noise=0.7, reward_scale=0.25), False, 0.5),
    "a minibatch of one step": (replace(ROLLOUTS, epochs=1, gradient_steps=60, clip_range=0.3), ONCE, False, 0.5),
}


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("play", PLAYS)
def test_a_walk_of_a_ppo_is_the_definition(name, play):
    """Three rollouts, and an evaluation before each; hidden units saturate."""
    (rollouts, sampling, is_aliased, most), mdp = PLAYS[play], WORLDS[name]()
    seen = seen_by(mdp.num_states, np.arange(mdp.num_states) // 2 if is_aliased else None, largest=9.0)
    schedule, adam = Schedule(steps=180, gamma=0.9), Adam(learning_rate=0.003, max_grad_norm=most)
    _, learner, networks, twins = recorded(NetworkPolicyLearner, mdp, seen, schedule, adam, sampling, rollouts)
    assert np.trace(twins[0].M) == pytest.approx(mdp.num_actions * POLICY_WEIGHTS * np.trace(twins[1].M))
    start, classes = [each.outputs.copy() for each in twins], numbers_of(learner)
    options = schedule, rollouts, sampling, 7, most
    cut, ended = naive.ppo(mdp, classes, *twins, options, derivatives_by_torch(mdp, classes, rollouts))
    assert ended > 0 and (cut > 0 or name == "one outcome")
    for network, twin, before in zip(networks, twins, start, strict=True):
        twin.settle()
        assert np.abs(twin.outputs - before).max() > 0.02
        assert_same(network, twin)


# H and M --------------------------------------------------------------------------------------------------------------


def network_of(W, h, bias, largest=math.inf):
    """The idealised network of outputs W h + bias, W (A, n), h (n, C), bias (A, 1)."""
    layer, last = OutputLayer(None, 1.0, (1, 1), (1.0, 1.0), largest), np.asarray(h.T @ h + 1, np.float32)
    network = IdealisedNetwork(last, np.eye(len(last), dtype=np.float32), 1.0, W @ h + bias, None, layer)
    network.net.gram[:], network.bias = W @ W.T, bias.copy()
    return network


sizes = st.tuples(st.integers(1, 4), st.integers(2, 6), st.integers(1, 5))


@examples(100, sizes, st.floats(0.3, 3.0), st.floats(0.01, 1.0), st.integers(0, 99))
def test_kernels_are_those_of_a_network_that_is_linear_in_weights_and_in_features(size, scale, move, seed):
    """Both move at once, twice: W by errors at features, h by gradients through the weights of before."""
    (A, n, C), rng = size, np.random.default_rng(seed)
    W, h, bias = rng.normal(size=(A, n)), scale * rng.normal(size=(n, C)), rng.normal(size=(A, 1))
    network = network_of(W, h, bias)
    for _ in range(2):
        moved, grown = move * rng.normal(size=(2, A, C))
        W, h, bias = W + moved @ h.T, h + W.T @ grown, bias + moved.sum(axis=1, keepdims=True)
        network.net.weights[:], network.net.grown[:], network.net.outputs[:] = moved, grown, W @ h + bias
        network.settle()
        np.testing.assert_allclose(network.net.last, h.T @ h + 1, rtol=0, atol=1e-4 * np.abs(h.T @ h + 1).max())
        np.testing.assert_allclose(network.net.gram, W @ W.T, rtol=0, atol=1e-3 * np.abs(W @ W.T).max())
        np.testing.assert_allclose(network.bias, bias, rtol=1e-9, atol=1e-9)
        assert not network.net.weights.any() and not network.net.grown.any() and network.is_finite


@examples(200, sizes, st.floats(0.1, 3.0), st.floats(0.01, 30.0), st.sampled_from([5.0, math.inf]), st.integers(0, 99))
def test_kernels_are_products_of_some_vectors_whatever_the_outputs_are(size, scale, move, largest, seed):
    (A, n, C), rng = size, np.random.default_rng(seed)
    W, h = rng.normal(size=(A, n)), scale * rng.normal(size=(n, C))
    network = network_of(W, h, np.zeros((A, 1)), largest)
    net = network.net
    for _ in range(3):
        net.weights[:], net.grown[:], net.outputs[:] = move * rng.normal(size=(3, A, C))
        network.settle()
        squares, M = np.diag(net.last).astype(float), net.gram
        assert network.is_finite and squares.min() >= 1 and squares.max() <= largest * (1 + 1e-6)
        assert (net.last.astype(float) ** 2 <= np.outer(squares, squares) * (1 + 1e-5)).all()
        np.testing.assert_array_equal(net.last, net.last.T)
        np.testing.assert_allclose(M, M.T, rtol=0, atol=1e-12 * np.abs(M).max())
        assert np.linalg.eigvalsh(M).min() >= -1e-9 * np.abs(M).max()
        most = np.diag(M)[:, None] * np.maximum(squares - 1, 1e-3)
        assert ((net.outputs - network.bias) ** 2 <= most * (1 + 1e-4)).all()
