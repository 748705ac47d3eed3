"""Pictures in groups by their patches: the same answers and gradients as torch's convolution by itself."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pharos.agents.batched.networks import FEATURES, Parameters, PictureLayers, aligned_zeros
from pharos.kernels.patches import COLOURS, patch_keys

UNIT = 2.0**-24  # rounding of single precision


def pictures_of(rng, shape, number, colours):
    """(number, C, H, W) of few colours, most of them the first."""
    palette = rng.integers(0, 256, (colours, shape[0]))
    palette[0] = rng.choice([0, 7])
    which = np.where(rng.random((number, *shape[1:])) < 0.7, 0, rng.integers(0, colours, (number, *shape[1:])))
    return np.moveaxis(palette[which], -1, 1).astype(np.float32)


def by_torch(layer, values, pictures, dy):
    """(outputs, gradients by name) by automatic differentiation, in double precision; dy: before the last ReLU."""
    own = {name: torch.from_numpy(each).double().requires_grad_() for name, each in values.items()}
    (kernel, of_kernel, weight, bias), x = own.values(), torch.from_numpy(pictures).double() / 255
    hidden = torch.nn.functional.conv2d(x, kernel, of_kernel, padding=1).relu()
    z = hidden.flatten(1) @ weight.T + bias
    (z * torch.from_numpy(dy).double()).sum().backward()
    return z.detach().relu().numpy(), {name: each.grad.numpy() for name, each in own.items()}


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 4), st.integers(1, 6), st.integers(1, 6)),
    number=st.integers(1, 20),
    colours=st.sampled_from([1, 2, 5, 60, 2 * COLOURS]),
)
def test_answers_and_gradients_are_those_of_a_convolution(seed, shape, number, colours):
    rng, parameters = np.random.default_rng(seed), Parameters()
    layer = PictureLayers(parameters, "net", shape)
    # odd multiples of 2^-7 for biases, multiples of 2^-6 else: no hidden unit is so near 0 that rounding decides
    rows = torch.from_numpy(rng.integers(-64, 65, (2, parameters.length)).astype(np.float32) / 64)
    parameters.views(rows)["net.layers.0.0.bias"].add_(2.0**-7)
    values, gradients = parameters.views(rows), parameters.views(torch.full_like(rows, torch.nan))
    pictures = np.stack([pictures_of(rng, shape, number, colours) for _ in range(2)])
    dy = rng.standard_normal((2, number, FEATURES)).astype(np.float32)
    x = aligned_zeros(2, number, layer.inputs)
    x.copy_(torch.from_numpy(pictures.reshape(2, number, -1)))
    y = layer.forward(values, x).clone().numpy()
    layer.backward(values, gradients, x, torch.from_numpy(dy.copy()), onward=False)
    for i in range(2):
        own = {each.name: np.array(each.stored(values[each.name][i].numpy())) for each in parameters.shapes}
        expected, of_torch = by_torch(layer, own, pictures[i], dy[i] * (y[i] > 0))
        terms = shape[1] * shape[2] * 16 + shape[0] * 9
        assert np.abs(y[i] - expected).max() <= 4 * terms * UNIT * max(1.0, np.abs(expected).max())
        for each in parameters.shapes:
            found, wanted = each.stored(gradients[each.name][i].numpy()), of_torch[each.name]
            assert np.abs(found - wanted).max() <= 4 * terms * number * UNIT * max(1.0, np.abs(wanted).max())
    # what a picture is answered does not depend on those beside it
    one = aligned_zeros(2, 1, layer.inputs)
    one.copy_(x[:, -1:])
    assert np.array_equal(layer.forward(values, one).numpy()[:, 0], y[:, -1])


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 3), st.integers(1, 5), st.integers(1, 5)),
    colours=st.sampled_from([1, 2, 4, 30]),
)
def test_keys_are_equal_where_patches_are(seed, shape, colours):
    pictures = pictures_of(np.random.default_rng(seed), shape, 6, colours)
    keys = np.empty((shape[1] * shape[2], 6), np.int64)
    palette = np.full((COLOURS + 1, shape[0]), np.nan, np.float32)
    count = patch_keys(pictures.reshape(6, -1), shape, keys, palette)
    padded = np.pad(pictures, ((0, 0), (0, 0), (1, 1), (1, 1)), constant_values=-1)  # outside is no colour
    names = {}
    for p in range(len(keys)):
        y, x = divmod(p, shape[2])
        for b in range(6):
            names.setdefault(padded[b, :, y : y + 3, x : x + 3].tobytes(), set()).add(keys[p, b])
    assert all(len(found) == 1 for found in names.values())
    assert len(set.union(*names.values())) == len(names)
    # a key names the nine colours: from left to right, from top to bottom, 0 outside
    assert count == len(np.unique(np.moveaxis(pictures, 1, -1).reshape(-1, shape[0]), axis=0))
    padded = np.pad(pictures, ((0, 0), (0, 0), (1, 1), (1, 1)))
    for p in range(len(keys)):
        y, x = divmod(p, shape[2])
        patches = padded[:, :, y : y + 3, x : x + 3].reshape(6, shape[0], 9)
        for place in range(9):
            assert np.array_equal(palette[keys[p] >> 7 * place & 127], patches[:, :, place])


def test_where_colours_are_too_many_no_two_patches_are_one_group():
    noise = np.arange(2 * (COLOURS + 1), dtype=np.float32).reshape(2, -1)
    noise[1, :] = noise[0, :]
    keys, palette = np.empty((COLOURS + 1, 2), np.int64), np.empty((COLOURS + 1, 1), np.float32)
    assert patch_keys(noise, (1, 1, COLOURS + 1), keys, palette) == -1
    assert len(np.unique(keys)) == keys.size
    assert patch_keys(noise[:, :COLOURS].copy(), (1, 1, COLOURS), keys[:COLOURS], palette) == COLOURS
    assert np.array_equal(keys[:COLOURS, 0], keys[:COLOURS, 1])


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), channels=st.integers(1, 4))
def test_a_picture_beside_too_many_colours_is_answered_by_the_same_bits(seed, channels):
    rng, parameters, shape = np.random.default_rng(seed), Parameters(), (channels, 6, 6)
    layer = PictureLayers(parameters, "net", shape)
    values = parameters.views(torch.from_numpy(rng.standard_normal((1, parameters.length)).astype(np.float32)))
    many, one = aligned_zeros(1, 8, layer.inputs), aligned_zeros(1, 1, layer.inputs)
    many[0] = torch.from_numpy(rng.integers(0, 256, (8, layer.inputs)).astype(np.float32))
    one[0, 0] = many[0, 0] = torch.from_numpy(pictures_of(rng, shape, 1, 5).reshape(-1))
    keys, palette = np.empty((36, 8), np.int64), np.empty((COLOURS + 1, channels), np.float32)
    assert patch_keys(many[0].numpy(), shape, keys, palette) == -1
    assert np.array_equal(layer.forward(values, many).numpy()[0, 0], layer.forward(values, one).numpy()[0, 0])
