"""Simple and complex images: compiled frames against their interpreted twins, spaces, layers that show, options,
errors.
"""

import copy
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import pharos
from pharos.errors import ParameterError
from pharos.interaction import GymEnv
from pharos.observations import observe
from pharos.observations.images import _area_weights, _scaled
from refusals import refusal
from worlds import random_states

SMALL = {
    "simple_grid": {"height": 4, "width": 5, "rewards": (((1, 1), 0.1),), "penalties": (((0, 2), -0.5),)},
    "frozen_lake": {"size": 4},
    "freeway": {"num_cars": 6, "lane_length": 8, "player_speed": 2},
    "breakout": {"height": 9, "columns": 6},
}
OPTIONS = [
    ("simple_image", {}),
    ("simple_image", {"scale": 5}),
    ("simple_image", {"grey": True}),
    ("simple_image", {"motion": True}),
    ("complex_image", {}),
    ("complex_image", {"size": "natural"}),
    ("complex_image", {"size": (61, 97), "channels_first": True}),
    ("complex_image", {"grey": True}),
]


@pytest.fixture(params=SMALL, scope="module")
def env(request):
    return pharos.make(request.param, **SMALL[request.param])


@pytest.mark.long
@pytest.mark.parametrize(("name", "options"), OPTIONS)
def test_compiled_frames_are_the_interpreted_ones(env, name, options):
    states = random_states(env, 150)
    compiled, interpreted = observe(env, name, **options), observe(env, name, **options)
    interpreted._drawing._compiled = interpreted._drawing._interpret
    found = compiled(states)
    np.testing.assert_array_equal(found, interpreted(states))
    np.testing.assert_array_equal(compiled.one(states[9]), found[9])
    assert found.dtype == compiled.space.dtype == np.uint8
    assert found.shape == (150, *compiled.space.shape)
    assert all(compiled.space.contains(frame) for frame in found)


@pytest.mark.parametrize(
    "shape",
    [(64, 64, 4, 21, 16), (12, 20, 4, 10, 11), (96, 160, 3, 84, 84), (5, 7, 4, 9, 3), (1, 1, 4, 3, 3), (8, 8, 1, 8, 8)],
)
def test_pictures_are_scaled_as_the_formula_says_to_the_last_bit(shape):
    height, width, channels, new_height, new_width = shape
    values = 255 * np.random.default_rng(0).random((height, width, channels))
    rows, columns = _area_weights(height, new_height), _area_weights(width, new_width)
    expected = np.einsum("yh,hwc,xw->yxc", rows, values, columns)
    np.testing.assert_array_equal(_scaled(values, new_height, new_width), expected)


def test_a_simple_image_has_a_plane_for_each_layer(env):
    image = (
        observe(env, "simple_image", scale=1) if min(env.grid()) >= len(env.layers) else observe(env, "simple_image")
    )
    scale = image.space.shape[1] // env.grid()[0]
    assert image.space.shape == (len(env.layers), *(scale * n for n in env.grid()))
    for state in random_states(env, 40):
        planes = np.zeros((len(env.layers), *env.grid()), np.uint8)
        env.draw(tuple(state.tolist()), planes)
        np.testing.assert_array_equal(image.one(state)[:, ::scale, ::scale] > 0, planes > 0)


@pytest.mark.long
def test_channels_come_first_or_last_and_colour_becomes_luminance(env):
    states = random_states(env, 20)
    last, first = observe(env, "complex_image"), observe(env, "complex_image", channels_first=True)
    grey = observe(env, "complex_image", grey=True)
    assert (last.space.shape, first.space.shape, grey.space.shape) == ((84, 84, 3), (3, 84, 84), (84, 84, 1))
    np.testing.assert_array_equal(last(states).transpose(0, 3, 1, 2), first(states))
    luminance = last(states).astype(float) @ [0.299, 0.587, 0.114]
    assert np.abs(luminance - grey(states)[..., 0]).max() <= 2 * len(env.layers)


@pytest.mark.long
@pytest.mark.parametrize("name", ["simple_image", "complex_image"])
def test_different_pictures_for_different_drawings(env, name):
    states = random_states(env, 60, seed=3)
    drawings = np.zeros((60, len(env.layers), *env.grid()), np.uint8)
    for state, planes in zip(states, drawings, strict=True):
        env.draw(tuple(state.tolist()), planes)
    frames = observe(env, name, **({"size": "natural"} if name == "complex_image" else {}))(states)
    visible = [i for i, layer in enumerate(env.layers) if (name, layer) != ("complex_image", "kerb")]
    covered = drawings[:, visible]
    for i in range(1, 60):
        if (frames[i] == frames[0]).all():
            top = [shown(d) for d in (covered[i], covered[0])]
            np.testing.assert_array_equal(*top)


def shown(planes):
    """What covers each cell: the number of the uppermost layer and its value."""
    out = np.zeros(planes.shape[1:], int)
    for layer, plane in enumerate(planes):
        out[plane > 0] = 1000 * (layer + 1) + plane[plane > 0].astype(int)
    return out


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("name", "options"), OPTIONS[:4])
def test_the_checkers_of_gymnasium_and_stable_baselines_pass(env, name, options):
    from stable_baselines3.common.env_checker import check_env as sb3_check

    check_env(GymEnv(env, observation=name, observation_options=options), skip_render_check=True)
    if name == "complex_image":  # smaller ones are for other networks than NatureCNN, which Stable-Baselines3 warns of
        sb3_check(GymEnv(env, observation=name, observation_options=options))


@pytest.mark.parametrize("observation", ["vector", "one_hot"])
def test_stable_baselines_accepts_what_is_no_image(env, observation):
    from stable_baselines3.common.env_checker import check_env as sb3_check

    sb3_check(GymEnv(env, observation=observation))


@pytest.mark.slow
def test_stable_baselines_only_says_that_simple_images_are_small_for_its_own_network(env):
    from stable_baselines3.common.env_checker import check_env as sb3_check

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        sb3_check(GymEnv(env, observation="simple_image"))
    assert [str(warning.message) for warning in told if "minimal resolution" not in str(warning.message)] == []


def test_stable_baselines_accepts_indices(tmp_path):
    from stable_baselines3.common.env_checker import check_env as sb3_check

    space = pharos.build(pharos.make("frozen_lake/4x4"), tmp_path / "lake")
    sb3_check(GymEnv("frozen_lake/4x4", observation="index", space=space))


def test_wrong_options_are_refused_in_one_line(env):
    with pytest.raises(ParameterError, match="scale is 0; expected an integer of at least 1"):
        observe(env, "simple_image", scale=0)
    assert "size is 84; expected 'natural' or" in refusal(ParameterError, observe, env, "complex_image", size=84)
    assert "leave less than one" in refusal(ParameterError, observe, env, "complex_image", size=(2, 2))


@pytest.mark.slow
@pytest.mark.parametrize("name", ("simple_image", "complex_image"))
@pytest.mark.parametrize(
    "copied", (lambda env: pickle.loads(pickle.dumps(env)), copy.deepcopy), ids=("pickle", "deepcopy")
)
def test_an_environment_with_images_is_copied_as_it_stands(name, copied):
    env = GymEnv("freeway", num_cars=6, lane_length=5, observation=name)
    env.reset(seed=0)
    for action in (0, 1, 0):
        env.step(action)
    other = copied(env)
    for action in (0, 0, 2, 1):
        mine, theirs = env.step(action), other.step(action)
        np.testing.assert_array_equal(mine[0], theirs[0])
        assert mine[1:4] == theirs[1:4]
    np.testing.assert_array_equal(env.reset(seed=1)[0], other.reset(seed=1)[0])


@pytest.mark.long
def test_a_copy_in_another_process_compiles_nothing_anew(tmp_path):
    env = GymEnv("freeway", num_cars=6, lane_length=5, observation="simple_image")
    env.reset(seed=0)
    env.step(0)
    (tmp_path / "env").write_bytes(pickle.dumps(env))
    code = (
        "import pickle, sys\n"
        f"env = pickle.load(open({str(tmp_path / 'env')!r}, 'rb'))\n"
        "env.step(0)\n"
        "kernels = env._compiled.step_one, env._compiled.draws\n"
        "print(sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "0\n"), done.stderr
