"""Tangent kernels of agents' networks: their closed form against gradients of random networks."""

import subprocess
import sys

import numpy as np
import pytest
from gymnasium import spaces

import pharos
from pharos.errors import ParameterError, UndefinedMeasure, UnknownName
from pharos.hardness import (
    Network,
    OutputLayer,
    Schedule,
    default_network,
    empirical_ntk,
    kernel_of_module,
    network_policy_regret,
    network_regret,
    tangent_kernel,
)
from pharos.hardness.representation.network_regret import IdealisedNetwork
from pharos.observations import network_inputs, ntk, observe, representation
from refusals import refusal

RNG = np.random.default_rng(0)
VECTORS = RNG.random((6, 5), np.float32)
IMAGES = (RNG.random((6, 3, 5, 6)) < 0.3).astype(np.float32)
LARGE = (RNG.random((3, 1, 36, 40)) < 0.2).astype(np.float32)


def agents_network(space, net_arch, policy):
    """What `make_model` builds for one output: the features of pharos, then what Stable-Baselines3 adds."""
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.torch_layers import create_mlp
    from torch import nn

    from pharos.agents.sb3 import extractor_class

    if policy == "pytorch":
        features = extractor_class(space)(space)
        return nn.Sequential(features, *create_mlp(features.features_dim, 1, net_arch))
    made = ActorCriticPolicy(
        space,
        spaces.Discrete(2),
        lambda _: 1e-3,
        net_arch=net_arch,
        features_extractor_class=extractor_class(space),
        activation_fn=nn.Tanh if policy == "tanh" else nn.ReLU,
    )
    return nn.Sequential(made.features_extractor, made.mlp_extractor.value_net, made.value_net)


BOX, IMAGE, FRAME = (
    spaces.Box(0.0, 1.0, (5,), np.float32),
    spaces.Box(0, 255, IMAGES.shape[1:], np.uint8),
    spaces.Box(0, 255, LARGE.shape[1:], np.uint8),
)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "space", "x", "net_arch", "policy", "networks"),
    [
        ("mlp128", BOX, VECTORS, [], "pytorch", 400),
        ("mlp128x2", BOX, VECTORS, [128], "pytorch", 400),
        ("mlp128-64-32", BOX, VECTORS, [64, 32], "pytorch", 600),
        ("cnn16", IMAGE, IMAGES, [128], "pytorch", 400),
        ("nature", FRAME, LARGE, [128], "pytorch", 60),
        ("mlp128x2", BOX, VECTORS, [128], "sb3", 400),
        ("mlp128x2+tanh", BOX, VECTORS, [128], "tanh", 400),
        ("cnn16+tanh", IMAGE, IMAGES, [128], "tanh", 300),
    ],
)
def test_the_closed_form_is_the_mean_over_random_networks(name, space, x, net_arch, policy, networks):
    found = tangent_kernel(Network.of(name, "pytorch" if policy == "pytorch" else "sb3"), x)
    expected = empirical_ntk(lambda: agents_network(space, net_arch, policy), x, networks=networks)
    error = np.abs(found / expected - 1)
    # 16 orthogonal filters differ so much from one network to the next that single entries take thousands of networks
    assert (error.mean() if name == "cnn16+tanh" else error.max()) <= 0.02


@pytest.mark.parametrize(("name", "space", "x"), [("mlp128x2", BOX, VECTORS), ("cnn16", IMAGE, IMAGES)])
def test_the_covariance_of_outputs_is_the_mean_over_random_networks(name, space, x):
    """In closed form, and of the 20 networks of a function as PyTorch draws them."""
    import torch

    def make(_shape):
        return agents_network(space, [128], "pytorch")

    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        outputs = np.array([make(x.shape[1:])(torch.as_tensor(x))[:, 0].numpy() for _ in range(1000)])
    products = outputs[:, :, None] * outputs[:, None]
    closed = tangent_kernel(Network.of(name), x, of_outputs=True)
    deviation = products.std(axis=0) / np.sqrt(len(products))
    assert (np.abs(closed - products.mean(axis=0)) <= 4 * deviation + 0.02 * closed).all()
    kernel, _ = kernel_of_module(make, x.shape[1:])
    np.testing.assert_allclose(kernel(x, of_outputs=True), products[:20].mean(axis=0), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(
        kernel(x, x[:2], of_outputs=True), products[:20].mean(axis=0)[:, :2], rtol=1e-4, atol=1e-7
    )


def test_one_pair_is_what_the_recursion_says():
    """Two hidden layers of 64, as the formulas read, in plain Python."""
    x, y = VECTORS[:2].astype(float)

    def arc(xy, xx, yy):
        scale = np.sqrt(xx * yy)
        angle = np.pi - np.arccos(xy / scale)
        return scale * (np.sin(angle) - angle * np.cos(angle)) / (2 * np.pi), angle / (2 * np.pi)

    def entry(x, y):
        q = [(a @ b + 1) / 15 for a, b in ((x, y), (x, x), (y, y))]
        kernel = x @ y + 1
        for _ in range(2):
            value, slope = arc(*q)
            kernel = 64 * value + 1 + slope / 3 * kernel
            q = [value / 3 + 1 / 192, q[1] / 6 + 1 / 192, q[2] / 6 + 1 / 192]
        return kernel

    found = tangent_kernel(Network.of("mlp64x2"), VECTORS)
    assert found[0, 1] == pytest.approx(entry(x, y), rel=1e-6)


def test_zeros_pass_a_slope_of_one_through_hyperbolic_tangents():
    """Without biases: of zeros the ReLUs have no slope, the tangents 1, so that their biases and the output's count."""
    y = VECTORS[:1]
    x = np.concatenate([np.zeros_like(y), y])
    z, weights = np.polynomial.hermite_e.hermegauss(100)
    deviation = np.sqrt(2 / 16 * (y.astype(float) ** 2).sum())  # of both hidden layers, with a gain of sqrt(2)
    slope = (weights / weights.sum()) @ (1 - np.tanh(deviation * z) ** 2)
    found = tangent_kernel(Network.of("mlp16x2+tanh", "sb3"), x)
    np.testing.assert_allclose(found[0], [2, 1 + slope], rtol=1e-6)
    assert tangent_kernel(Network.of("mlp16x3+tanh", "sb3"), x)[0, 0] == pytest.approx(4, rel=1e-6)


@pytest.mark.parametrize("name", ["mlp128x2", "mlp64+tanh", "cnn16", "cnn4-32"])
def test_blocks_give_the_same_kernel_as_one_by_one(name, monkeypatch):
    network, x = Network.of(name), IMAGES
    whole = tangent_kernel(network, x)
    assert (whole == whole.T).all()
    np.testing.assert_allclose(tangent_kernel(network, x[:2], x[2:]), whole[:2, 2:], rtol=1e-6)
    monkeypatch.setattr("pharos.hardness.representation.networks.PAIR_BLOCK", 4)
    np.testing.assert_allclose(tangent_kernel(network, x), whole, rtol=1e-6)
    assert np.linalg.eigvalsh(whole.astype(float)).min() > 0


def test_rotated_vectors_have_the_same_kernel():
    rotation = np.linalg.qr(RNG.normal(size=(5, 5)))[0]
    network = Network.of("mlp128x2")
    turned = tangent_kernel(network, VECTORS @ rotation.astype(np.float32))
    np.testing.assert_allclose(turned, tangent_kernel(network, VECTORS), rtol=1e-5)


def test_a_convolution_at_one_position_is_a_dense_layer():
    """A picture of one pixel has one position: a dense layer of what lies around it, which is padding."""
    pixels = RNG.random((4, 3, 1, 1)).astype(np.float32)
    centre = np.zeros((4, 27), np.float32)
    centre[:, 4::9] = pixels[:, :, 0, 0]
    found = tangent_kernel(Network.of("cnn16-128"), pixels)
    np.testing.assert_allclose(found, tangent_kernel(Network.of("mlp16-128"), centre), rtol=1e-5)


@pytest.fixture(scope="module")
def grid():
    return pharos.build(pharos.make("simple_grid", height=3, width=4), progress=False)


def test_an_environment_has_the_kernel_of_its_agents_network(grid):
    for observation, network in (("vector", "mlp128x2"), ("simple_image", "cnn16"), ("index", "mlp128x2")):
        seen = observe(grid.environment, observation, state_space=grid)
        assert default_network(seen.space) == network
        kernel = ntk(grid, observation)
        assert kernel.shape == (grid.num_states,) * 2
        assert kernel.dtype == np.float32
        inputs = network_inputs(seen, grid.states())
        np.testing.assert_array_equal(kernel, tangent_kernel(Network.of(network), inputs))
    part = ntk(grid.environment, "simple_image", "cnn16", states=grid.states()[:3], others=grid.states())
    np.testing.assert_allclose(part, ntk(grid, "simple_image")[:3], rtol=1e-6)
    assert network_inputs(observe(grid.environment, "simple_image"), grid.states()).max() == 1.0


def test_inputs_are_those_of_stable_baselines(grid):
    import torch
    from stable_baselines3.common.preprocessing import preprocess_obs

    frames = [observe(grid.environment, name) for name in ("vector", "one_hot", "simple_image", "complex_image")]
    for seen in (*frames, observe(grid.environment, "index", state_space=grid)):
        space, values = seen.space, np.asarray(seen(grid.states()))
        if seen.name == "complex_image":  # what VecTransposeImage does
            values = values.transpose(0, 3, 1, 2)
            space = spaces.Box(0, 255, values.shape[1:], np.uint8)
        expected = preprocess_obs(torch.as_tensor(values), space).numpy()
        np.testing.assert_array_equal(network_inputs(seen, grid.states()), expected)


def layers_of_64(shape, *after, bias=True):
    """`mlp64x2` with four outputs, as PyTorch initialises it."""
    from torch import nn

    hidden = nn.Linear(shape[0], 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU()
    return nn.Sequential(*hidden, nn.Linear(64, 4, bias=bias), *after)


def random_networks(make, shape):
    """The 20 networks that the kernel of a function is a mean over."""
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return [make(shape) for _ in range(20)]


@pytest.mark.parametrize("bias", [True, False])
def test_the_output_layer_of_a_function_is_the_mean_over_its_networks(bias):
    """By hidden units and gradients of each input alone, of the same networks."""
    import torch

    def make(shape):
        return layers_of_64(shape, bias=bias)

    layer = kernel_of_module(make, (5,))[0].output_layer(VECTORS)
    products, weights, evenness = [], [], []
    for network in random_networks(make, (5,)):
        hidden = network[:-1](torch.as_tensor(VECTORS)).detach().numpy()
        products.append(hidden @ hidden.T + bias)
        weights.append(float((network[-1].weight[0].detach() ** 2).sum()))
        gradients = []
        for x in torch.as_tensor(VECTORS):
            network.zero_grad()
            network(x[None])[0, 0].backward()
            output = [each.grad[0].flatten() for each in network[-1].parameters()]
            beneath = [each.grad.flatten() for each in network[:-1].parameters()]
            gradients.append([torch.cat(output).numpy(), torch.cat(beneath).numpy()])
        sizes = [np.sqrt((np.stack(group) ** 2).mean(axis=0)) for group in zip(*gradients, strict=True)]
        evenness.append([size.mean() / np.sqrt((size**2).mean()) for size in sizes])
    np.testing.assert_allclose(layer.kernel(VECTORS, VECTORS), np.mean(products, axis=0), rtol=1e-5)
    np.testing.assert_allclose(layer.kernel(VECTORS[:2], VECTORS[2:]), np.mean(products, axis=0)[:2, 2:], rtol=1e-5)
    assert layer.weights == pytest.approx(np.mean(weights), rel=1e-6)
    assert layer.evenness == pytest.approx(np.mean(evenness, axis=0), rel=1e-5)
    assert (layer.parameters, layer.has_bias) == ((64 + bias, 64 * 6 + 64 * 65), bias)


def test_the_output_layer_of_a_function_is_near_the_closed_form(grid):
    own, named = (representation(grid, "vector", network) for network in (layers_of_64, "mlp64x2"))
    states = np.arange(grid.num_states)
    found, expected = (each.output_layer.kernel(states, states) for each in (own, named))
    np.testing.assert_allclose(found, expected, rtol=0.1)
    assert own.output_layer.parameters == named.output_layer.parameters
    assert own.output_layer.weights == pytest.approx(named.output_layer.weights, rel=0.1)


def test_a_network_that_ends_otherwise_has_no_output_layer():
    from torch import nn

    class Dueling(nn.Module):
        def __init__(self):
            super().__init__()
            self.hidden, self.value, self.advantages = nn.Linear(5, 16), nn.Linear(16, 1), nn.Linear(16, 4)

        def forward(self, x):
            hidden = self.hidden(x).relu()
            advantages = self.advantages(hidden)
            return self.value(hidden) + advantages - advantages.mean(dim=1, keepdim=True)

    def output_layer(make):
        return kernel_of_module(make, (5,))[0].output_layer(VECTORS)

    assert output_layer(lambda shape: layers_of_64(shape, nn.Tanh())) is None
    assert output_layer(lambda shape: layers_of_64(shape, nn.LayerNorm(4))) is None
    assert output_layer(lambda _: Dueling()) is None
    assert output_layer(lambda shape: layers_of_64(shape, nn.Flatten())).parameters == (65, 64 * 6 + 64 * 65)


def test_errors_of_an_output_layer_name_the_network():
    from torch import nn

    def large(shape):
        made = layers_of_64(shape)
        nn.init.constant_(made[0].weight, 1e25)  # whose square is infinite
        return made

    for make, words in (
        (large, "large' on inputs of shape (5,): gradients of the network are not finite"),
        (lambda _: nn.Linear(4, 2), "on inputs of shape (5,): RuntimeError: "),
        (lambda _: 3, "on inputs of shape (5,): make returned 3; expected a torch.nn.Module"),
    ):
        assert words in refusal(ParameterError, kernel_of_module(make, (5,))[0].output_layer, VECTORS)


def test_regret_in_a_network_of_a_function_is_near_the_regret_of_its_name(grid):
    """Means over 8 walks, one of which deviates by about 0.25 (DQN) and 0.01 (PPO)."""
    seen = [representation(grid, "vector", network) for network in (layers_of_64, "mlp64x2")]
    for measure, tolerance in ((network_regret, 0.4), (network_policy_regret, 0.05)):
        own, named = (measure(grid.mdp(), each, schedule=Schedule(steps=4000)) for each in seen)
        assert own.diverged == named.diverged == 0
        assert own.value == pytest.approx(named.value, abs=tolerance)


def test_regret_in_a_network_that_ends_otherwise_is_undefined(grid):
    from torch import nn

    seen = representation(grid, "vector", lambda shape: layers_of_64(shape, nn.Tanh()))
    assert seen.output_layer is None
    assert "let it end with a torch.nn.Linear" in refusal(UndefinedMeasure, network_regret, grid.mdp(), seen)


def test_a_linear_network_has_a_regret(grid):
    from torch import nn

    seen = representation(grid, "one_hot", lambda shape: nn.Linear(shape[0], 4))
    assert seen.output_layer.parameters == (grid.environment.height + grid.environment.width + 1, 0)
    found = network_policy_regret(grid.mdp(), seen, schedule=Schedule(steps=4000))
    assert found.diverged == 0
    assert found.curve.greedy.min() < 0.9  # it learns


@pytest.mark.parametrize("has_bias", [True, False])
def test_a_settled_network_has_the_products_of_its_weights(has_bias):
    """Output weights that moved along features, with and without a bias."""
    rng = np.random.default_rng(0)
    features, weights, moved = 0.2 * rng.normal(size=(3, 8)), rng.normal(size=(2, 8)), rng.normal(size=(2, 3))
    last = (features @ features.T + has_bias).astype(np.float32)
    layer = OutputLayer(lambda x, y: last, 1.0, (8 + has_bias, 0), (1.0, 0.0), has_bias=has_bias)
    network = IdealisedNetwork(last.copy(), np.zeros_like(last), 1.0, weights @ features.T, None, layer)
    network.net.gram[:] = weights @ weights.T
    network.net.weights[:] = moved
    network.net.outputs[:] += moved @ last
    network.settle()
    after = weights + moved @ features
    np.testing.assert_allclose(network.net.gram, after @ after.T, rtol=1e-4)
    np.testing.assert_allclose(network.net.last, last, rtol=1e-6)  # features smaller than a bias, too
    np.testing.assert_allclose(network.net.outputs - network.bias, after @ features.T, rtol=1e-4, atol=1e-5)


def test_what_has_no_kernel_says_so_in_a_line(grid, monkeypatch):
    for name, words in (
        ("resnet18", "no closed form"),
        ("mlp", "no closed form"),
        ("mlp0", "no closed form"),
        ("cnn0", "no filters"),
        ("cnn16", "has convolutions"),
    ):
        assert words in refusal(ParameterError, ntk, grid, "vector", name)
    assert "larger images than 6 x 8" in refusal(ParameterError, ntk, grid, "simple_image", "nature")
    assert "expected one of pytorch, sb3" in refusal(ParameterError, ntk, grid, "vector", initialisation="he")
    assert "vector" in refusal(UnknownName, ntk, grid, "vectr")
    monkeypatch.setattr("pharos.system.memory.available_memory", lambda: 800)
    assert "10 states fit into memory" in refusal(ParameterError, ntk, grid, "vector")


@pytest.mark.long
def test_kernels_need_no_torch():
    code = "import sys; from pharos.observations import ntk; ntk('simple_grid', 'vector', 'mlp8'); "
    code += "assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
