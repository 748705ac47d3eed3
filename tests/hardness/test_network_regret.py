"""DQN and PPO in an idealised network: against slow twins, explicit networks, and networks of PyTorch."""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import strategies as st
from test_kernel_measures import chain, kernel_of, random_mdp
from test_sampled_regret import WORLDS, plain_walk

import pharos
from naive import networks as naive
from pharos import hardness
from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness import (
    Adam,
    Network,
    OutputLayer,
    Representation,
    Rollouts,
    Sampling,
    Schedule,
    network_policy_regret,
    network_regret,
)
from pharos.hardness.representation.network_regret import (
    POLICY_WEIGHTS,
    IdealisedNetwork,
    NetworkPolicyLearner,
    NetworkQLearner,
)
from pharos.observations import network_inputs, observe, representation
from strategies import examples

SHORT = Schedule(steps=700, period=50, gradient_steps=13, learning_starts=60, gamma=0.9)
ONCE = Sampling(walks=1, batch_size=8, buffer_size=150)
FAST = Adam(learning_rate=0.01)


def seen_by(num_states, classes=None, *, largest=math.inf, bias=1.0):
    """A representation of random features, whose output layer has 16 units."""
    numbers = np.arange(num_states) if classes is None else classes
    hidden = np.random.default_rng(5).random((num_states, 16))[numbers]
    last, whole = hidden @ hidden.T + 1, np.asarray(kernel_of(num_states), np.float64)[np.ix_(numbers, numbers)]
    layer = OutputLayer(lambda x, y: last[np.ix_(x, y)], 0.5, (17, 64), (0.6, 0.4), largest, bias=bias)
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
    _, learner, (network,), (twin,) = recorded(NetworkQLearner, mdp, seen, SHORT, adam, sampling)
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


# Networks of PyTorch --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    env = pharos.make("simple_grid", height=3, width=4)
    return pharos.build(env, tmp_path_factory.mktemp("space") / "grid", progress=False)


def module(torch, name, shape):
    """A network of that name in plain PyTorch, of one output: orthogonal if it has hyperbolic tangents."""
    nn, layers = torch.nn, []
    if name.startswith("cnn4"):
        layers = [nn.Conv2d(shape[0], 4, 3, padding=1), nn.ReLU(), nn.Flatten(), nn.Linear(4 * shape[1] * shape[2], 32)]
        layers += [nn.ReLU(), nn.Linear(32, 1)]
    else:
        units = 512 if "512" in name else 64
        layers = [nn.Linear(shape[0], units), nn.ReLU(), nn.Linear(units, units)]
        layers += [nn.Tanh() if "tanh" in name else nn.ReLU(), nn.Linear(units, 1)]
    if "tanh" in name:
        for layer in layers[::2]:
            nn.init.orthogonal_(layer.weight, 1.0 if layer is layers[-1] else math.sqrt(2))
            nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


@pytest.mark.parametrize(
    ("observation", "name", "initialisation"),
    [("vector", "mlp64x2", "pytorch"), ("vector", "mlp64x2+tanh", "sb3"), ("simple_image", "cnn4-32", "pytorch")],
)
def test_an_output_layer_is_the_mean_over_random_networks(grid, observation, name, initialisation):
    """Its kernel, the squared weights of its outputs, and the numbers of parameters."""
    torch = pytest.importorskip("torch")
    states = np.array([0, 3, 5, 8])
    x = network_inputs(observe(grid.environment, observation), grid.states(states))
    layer = representation(grid, observation, name, initialisation=initialisation).output_layer
    products, weights = [], []
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        for _ in range(400):
            made = module(torch, name, x.shape[1:])
            hidden = made[:-1](torch.as_tensor(x)).numpy()
            products.append(hidden @ hidden.T + 1)
            weights.append(float((made[-1].weight ** 2).sum()))
    size = [sum(each.numel() for each in part.parameters()) for part in (made[-1], made[:-1])]
    assert layer.parameters == tuple(size) == Network.of(name, initialisation).parameters(x.shape[1:])
    deviation = np.std(products, axis=0) / math.sqrt(len(products))
    kernel = layer.kernel(states, states)
    assert (np.abs(kernel - np.mean(products, axis=0)) <= 4 * deviation + 0.01 * kernel).all()
    assert layer.weights == pytest.approx(np.mean(weights), rel=0.02)
    assert layer.bias == (0.0 if "tanh" in name else 1.0)
    assert layer.largest == (65.0 if "tanh" in name else math.inf)


@pytest.mark.parametrize("name", ["mlp512x2", "mlp512x2+tanh"])
def test_evenness_is_how_even_gradients_of_one_observation_are(name):
    """A mean over 20 networks, of which one deviates by 1 %. At 512 units the closed form is 2 % off."""
    torch = pytest.importorskip("torch")
    x, found = torch.linspace(0.1, 1.0, 5)[None], []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for _ in range(20):
            made = module(torch, name, (5,))
            made(x).sum().backward()
            gradients = [made[i].weight.grad.abs() for i in (-1, 2)]
            found.append([float(each.mean() / (each**2).mean().sqrt()) for each in gradients])
    expected = Network.of(name, "sb3" if "tanh" in name else "pytorch").evenness
    np.testing.assert_allclose(np.mean(found, axis=0), expected, rtol=0.03)


# Limits ---------------------------------------------------------------------------------------------------------------


BOTH = pytest.mark.parametrize("measure", [network_regret, network_policy_regret])
FEW = {"schedule": SHORT, "sampling": Sampling(walks=2, batch_size=8)}


@BOTH
def test_without_a_learning_rate_policies_stay_as_they_are(measure):
    if measure is network_policy_regret:
        measure = partial(measure, rollouts=Rollouts(steps=64, clip_range=0.2))
    still, learnt = (
        measure(random_mdp(7, 2), seen_by(7), adam=Adam(learning_rate=rate), **FEW) for rate in (1e-12, 0.01)
    )
    np.testing.assert_allclose(still.curve.greedy - still.curve.greedy[:, :1], 0.0, atol=1e-6)
    np.testing.assert_allclose(learnt.curve.greedy[:, 0], still.curve.greedy[:, 0], atol=1e-6)
    assert learnt.value < still.value - 0.1


@pytest.mark.parametrize("bias", [0.0, 1.0])
def test_a_network_starts_from_the_covariance_of_its_outputs_each_for_itself(bias):
    learner = recorded(NetworkQLearner, random_mdp(7, 3), seen_by(7, bias=bias), Schedule(steps=1), FAST, ONCE)[1]
    starts = np.array([learner.network(seed, share=0.25).before for seed in range(3000)])
    expected = 0.25 * 0.5 / 16 * (learner.last - 1 + bias)
    for a in range(3):
        for b in range(3):
            found = np.einsum("nx,ny->xy", starts[:, a], starts[:, b]) / len(starts)
            np.testing.assert_allclose(found, expected * (a == b), atol=0.1 * expected.max())


def test_outputs_of_zeros_without_biases_start_at_zero_and_say_nothing_of_weights(grid):
    seen, mdp = (
        representation(grid, "vector", "mlp64x2+tanh", initialisation="sb3"),
        grid.mdp(gamma=1.0).with_horizon(20),
    )
    schedule = Schedule(steps=1)
    _, learner, *_ = recorded(NetworkPolicyLearner, mdp, seen, schedule, FAST, ONCE, Rollouts(steps=8))
    network, zeros = learner.network(3), learner.observations.groups[learner.numbers == grid.index((0, 0))]
    np.testing.assert_allclose(network.before[:, zeros], 0.0, atol=1e-7)
    network.settle()
    np.testing.assert_allclose(network.net.gram, learner.layer.weights * np.eye(4), atol=1e-12)


@BOTH
def test_a_seed_gives_its_number_and_another_another(measure):
    first, again = (measure(random_mdp(7, 2), seen_by(7), adam=FAST, **FEW) for _ in range(2))
    assert first.to_dict() == again.to_dict()
    sampling = replace(FEW["sampling"], seed=1, walks=1)
    second = measure(random_mdp(7, 2), seen_by(7), adam=FAST, schedule=SHORT, sampling=sampling)
    np.testing.assert_array_equal(second.curve.greedy[0], first.curve.greedy[1])
    assert (second.curve.greedy[0] != first.curve.greedy[0]).any()
    assert math.isnan(second.curve.deviation) and "deviation" not in second.to_dict()
    assert (
        first.note.startswith(f"{first.name}: a mean over 2 walks") and second.note == f"{first.name}: of a single walk"
    )
    assert first.value == pytest.approx(first.curve.greedy.mean()) and first.to_dict()["diverged"] == 0


@BOTH
def test_eight_walks_are_taken_and_three_of_them_with_a_table(measure):
    taken = measure(random_mdp(7, 2), seen_by(7), adam=FAST, schedule=SHORT)
    three = measure(random_mdp(7, 2), seen_by(7), adam=FAST, schedule=SHORT, sampling=Sampling(walks=3))
    assert len(taken.curve.greedy) == hardness.NETWORK_WALKS == 8
    np.testing.assert_array_equal(taken.curve.greedy[:3], three.curve.greedy)
    assert taken.tabular == three.tabular


@BOTH
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_a_scale_of_rewards_is_another_unit_of_them(measure, noise):
    mdp, sampling = random_mdp(7, 2), replace(FEW["sampling"], reward_noise=noise)
    options = {"schedule": SHORT, "adam": FAST}
    scaled = measure(mdp, seen_by(7), sampling=replace(sampling, reward_scale=8.0), **options)
    smaller = measure(mdp.with_rewards(mdp.rewards / 8), seen_by(7), sampling=sampling, **options)
    np.testing.assert_array_equal(scaled.curve.greedy, smaller.curve.greedy)
    assert (scaled.curve.greedy != measure(mdp, seen_by(7), sampling=sampling, **options).curve.greedy).any()


def test_a_report_has_both_and_keeps_them(grid):
    names, mdp = ["network_regret", "network_policy_regret"], grid.mdp(gamma=1.0).with_horizon(20)
    seen = representation(grid, "vector", "mlp16x2")
    options = {"representation": seen, "schedule": SHORT, "sampling": FEW["sampling"], "adam": FAST}
    first, again, other = (
        hardness.report(mdp, names, **{**options, **more}) for more in ({}, {}, {"adam": Adam(learning_rate=0.02)})
    )
    for name in names:
        direct = getattr(hardness, name)(mdp, **{**options, "representation": seen})
        assert first[name].value == direct.to_dict() and first[name].certificate.note == direct.note
        assert again[name].kept and again[name].value == json.loads(json.dumps(first[name].value))
        assert not other[name].kept and other[name].value["curve"] != first[name].value["curve"]
        assert first[name].value["conventions"]["adam"]["learning_rate"] == 0.01


# What is refused, and what becomes infinite ---------------------------------------------------------------------------


@BOTH
def test_what_it_is_not_defined_for_is_said(measure, monkeypatch):
    name = measure.__name__
    with pytest.raises(UndefinedMeasure, match=f"{name} needs a network whose output layer is known"):
        measure(random_mdp(7, 2), Representation.of_matrix(kernel_of(7)), **FEW)
    with pytest.raises(UndefinedMeasure, match=f"{name}: uniform play is optimal"):
        measure(chain().with_rewards(np.zeros((4, 2))), seen_by(4), **FEW)
    with pytest.raises(UndefinedMeasure, match=f"{name} is defined for episodes"):
        measure(chain(horizon=None, gamma=0.9), seen_by(4), **FEW)
    with pytest.raises(UndefinedMeasure, match=f"{name} takes no landmarks"):
        measure(random_mdp(7, 2), replace(seen_by(7), landmarks=3), **FEW)
    monkeypatch.setattr("pharos.hardness.representation.network_regret.MOST_OBSERVATIONS", 5)
    with pytest.raises(UndefinedMeasure, match=f"{name}: 6 different observations; it is for at most 5"):
        measure(random_mdp(7, 2), seen_by(7), **FEW)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (lambda: Adam(learning_rate=0.0), r"adam: learning_rate is 0.0; expected a number above 0"),
        (lambda: Adam(max_grad_norm=math.inf), r"adam: max_grad_norm is inf; expected a number above 0"),
        (lambda: Adam(epsilon=-1.0), r"adam: epsilon is -1.0; expected a number above 0"),
        (lambda: Adam(decay=1.0), r"adam: decay is 1.0; expected a number in \[0, 1\)"),
        (lambda: Adam(decay_of_squares=math.nan), r"adam: decay_of_squares is nan; expected a number in \[0, 1\)"),
        (lambda: Rollouts(environments=0), r"rollouts: environments is 0"),
        (lambda: Rollouts(epochs=1.5), r"rollouts: epochs is 1.5"),
        (lambda: Rollouts(steps=100, environments=8), r"rollouts: 100 steps are not divided by 8 environments"),
        (lambda: Rollouts(entropy_weight=-0.1), r"rollouts: entropy_weight is -0.1; expected at least 0"),
        (lambda: Rollouts(value_weight=math.inf), r"rollouts: value_weight is inf; expected at least 0"),
    ],
)
def test_options_that_are_none_are_refused(options, message):
    with pytest.raises(ParameterError, match=message):
        options()


def test_rollouts_that_their_environments_do_not_divide_are_refused():
    with pytest.raises(ParameterError, match="rollouts: 100 steps are not divided by 8 environments"):
        network_policy_regret(random_mdp(7, 2), seen_by(7), rollouts=Rollouts(steps=100), **FEW)


@BOTH
@pytest.mark.parametrize("rate", [1e3, 1e10, 1e15, 1e19, 1e30, 1e160, 1e307])
@pytest.mark.parametrize("largest", [math.inf, 9.0])
def test_values_that_become_infinite_are_taken_back_and_counted(measure, rate, largest):
    found = measure(random_mdp(7, 2), seen_by(7, largest=largest), adam=Adam(learning_rate=rate), **FEW)
    assert np.isfinite(found.curve.greedy).all() and math.isfinite(found.value)
    assert found.diverged == 2 or rate < 1e30
    text = f"values of {found.diverged} of 2 walks became infinite"
    assert (text in found.note) == (found.diverged > 0) and found.to_dict()["diverged"] == found.diverged
