"""Images with motion tell every state; what an agent is not to see, it does not see."""

from itertools import product

import numpy as np
import pytest

import pharos
from pharos.environments.built_in import BUILT_IN
from pharos.errors import ParameterError, RuleError
from pharos.observations import observe
from refusals import refusal

pytestmark = pytest.mark.long  # with each class compiled

# Name of an instance -> parameters: small ones
SMALL = {
    "simple_grid/4x4-decoy": {},
    "frozen_lake/4x4": {},
    "cliff_walking/4x12-slippery": {},
    "sliding_tiles/2x3": {},
    "sokoban/corridor": {},
    "mini_grid/door-key-5x5": {},
    "mini_grid_empty/8x8": {},
    "mini_grid_rooms/4x3": {},
    "taxi/5x5-rainy-fickle": {"size": 3},
    "blackjack/natural": {},
    "breakout": {"height": 6, "columns": 3, "brick_rows": 1},
    "breakout/12x8x3": {"height": 7, "columns": 3, "brick_rows": 1, "respawn": False},
    "freeway": {"num_cars": 2, "lane_length": 2, "player_speed": 2, "car_speeds": (3, 4)},
    "freeway/16x7-speed1": {"num_cars": 2, "lane_length": 3, "car_speeds": (11, 2)},
}
ALIASED = {"taxi/5x5-rainy-fickle", "breakout", "breakout/12x8x3", "freeway", "freeway/16x7-speed1"}  # without motion

# Classes that are not among them: some states of their first instance
MORE = [
    f"{entry.name}/{entry.instance_names[0]}"
    for entry in BUILT_IN
    if entry.name not in {name.split("/")[0] for name in SMALL} and entry.instance_names
]
MOST_STATES = 2000


def interpreted(env, name="simple_image", **options):
    """An observation without its compiled kernel, which would take seconds to make."""
    made = observe(env, name, **options)
    made._drawing._compiled = made._drawing._interpret
    return made


def reached(env):
    """All states, by the rules in Python; some where there are very many."""
    states = {tuple(map(int, state)): None for state, _ in env.initial_states()}
    for state in (queue := list(states)):
        if env.is_terminal(state) or len(states) > MOST_STATES:
            continue
        for action, outcome in product(range(env.num_actions), range(env.outcomes)):
            if env.probability(state, action, outcome) > 0:
                following = env.next_state(state, action, outcome)
                if following not in states:
                    states[following] = None
                    queue.append(following)
    return np.array(list(states), np.int64)


def different(images):
    return len(np.unique(images.reshape(len(images), -1), axis=0))


@pytest.mark.parametrize("name", [*SMALL, *MORE])
def test_with_motion_no_two_states_look_alike(name):
    env = pharos.make(name, **SMALL.get(name, {}))
    if not env.layers:
        pytest.skip("it is not drawn")
    states = reached(env)
    assert different(interpreted(env, motion=True)(states)) == len(states)
    assert name in MORE or len(states) <= MOST_STATES


LARGE = ("breakout", "freeway", "game_2048", "mini_grid", "pocket_cube", "sliding_tiles", "sokoban")


@pytest.mark.parametrize(
    "name", [name for name in pharos.list_environments() if "/" in name and name.split("/")[0] not in LARGE]
)
def test_with_motion_complex_images_of_all_small_instances_differ(name):
    """Those of LARGE are looked at cell by cell in tests/observations/test_decoded_images.py."""
    env = pharos.make(name)
    states = reached(env)
    size = (84, max(84, 4 * env.grid()[1] * (env.grid()[1] > 84)))  # chains of 101 places have no room in 84 pixels
    assert len(states) <= MOST_STATES
    assert different(interpreted(env, "complex_image", motion=True, size=size)(states)) == len(states)


@pytest.mark.parametrize("name", SMALL)
def test_without_motion_some_do(name):
    env = pharos.make(name, **SMALL[name])
    states = reached(env)
    assert (different(interpreted(env)(states)) < len(states)) == (name in ALIASED)


def test_a_ball_leaves_a_trail_behind_it():
    env = pharos.make("breakout", height=9, columns=6)
    state = np.array([env.initial_state()])
    row, column, right, down = state[0, :4]
    (image,) = interpreted(env, motion=True)(state)
    assert (right, down) == (1, 1)
    assert np.argwhere(image[3]).tolist() == [[row - 1, column - 1]]
    np.testing.assert_array_equal(image[:3], interpreted(env)(state)[0])


def test_timers_are_shades():
    env = pharos.make("freeway", num_cars=3, lane_length=4, player_speed=2)
    state = np.array(env.initial_state())
    state[[1, -3, -2, -1]] = 1, 0, 1, 2
    (image,) = interpreted(env, motion=True, scale=2)(state[None])
    cars, player = image[3, ::2, ::2], image[4, ::2, ::2]
    assert cars[1:4, 0].tolist() == [255, 192, 128]
    assert np.argwhere(player).tolist() == [[4, 2]]
    assert player[4, 2] == 128
    long = pharos.make("freeway", num_cars=1, lane_length=2, car_speeds=(255,))
    states = np.array([(2, 0, 0, timer) for timer in range(255)])
    assert different(interpreted(long, motion=True)(states)) == 255


def test_a_class_without_motion_has_the_same_image_with_it():
    env = pharos.make("frozen_lake")
    states = reached(env)
    np.testing.assert_array_equal(interpreted(env, motion=True)(states), interpreted(env)(states))
    assert observe(env, "simple_image", motion=True).is_flat
    with pytest.raises(ParameterError, match="motion is 'maybe'; expected True or False"):
        observe(env, "simple_image", motion="maybe")


@pytest.mark.parametrize("name", ["simple_image", "complex_image"])
def test_hidden_layers_are_not_seen(name):
    env = pharos.make("breakout", height=9, columns=6)
    states = np.array([env.initial_state()] * 2)
    states[1, :4] = 3, 4, 0, 0
    for options in ({"hide": "ball"}, {"motion": True, "hide": ["ball", "ball_trail"]}):
        hidden = interpreted(env, name, **options)
        images = hidden(states)
        assert (images[0] == images[1]).all()
        assert images.shape[1:] == interpreted(env, name, motion="motion" in options).space.shape
        assert different(interpreted(env, name, hide="paddle")(states)) == 2
    with pytest.raises(ParameterError, match=r"_image of breakout: there is no 'bal' to hide; .* paddle, ball$"):
        observe(env, name, hide="bal")
    assert "there is no 'ball_trail' to hide" in refusal(ParameterError, observe, env, name, hide="ball_trail")


def test_hidden_variables_are_always_0():
    env = pharos.make("breakout", height=9, columns=6)
    rng = np.random.default_rng(0)
    states = env.components.low + rng.integers(0, env.components.size, (50, len(env.components)))
    whole = observe(env, "vector")
    hidden = observe(env, "vector", hide=("ball_goes_right", "bricks[1,2]"))
    places = [2, whole.names.index("bricks[1,2]")]
    expected = whole(states)
    expected[:, places] = 0
    np.testing.assert_array_equal(hidden(states), expected)
    assert hidden.space == whole.space
    assert (observe(env, "vector", hide="ball_row, bricks")(states)[:, [0, *range(5, 17)]] == 0).all()
    with pytest.raises(
        ParameterError, match="vector of breakout: there is no 'ball' to hide; expected some of ball_row"
    ):
        observe(env, "vector", hide="ball")
    assert "hide is 3; expected a name, or -1 to -17" in refusal(ParameterError, observe, env, "vector", hide=3)


def test_steps_show_what_observations_show():
    """Single and vector environments, compiled."""
    env = pharos.make("breakout", height=7, columns=4, brick_rows=1)
    options = {"observation": "vector", "observation_options": {"hide": ["ball_goes_down"]}}
    seen = observe(env, "vector", hide="ball_goes_down")
    one, many = pharos.GymEnv(env, **options), pharos.make_vec(env, 2, **options)
    first, info = one.reset(seed=0)
    np.testing.assert_array_equal(first, seen.one(info["state"]))
    many.reset(seed=0)
    for action in (0, 2, 1):
        found, _, _, _, info = one.step(action)
        np.testing.assert_array_equal(found, seen.one(info["state"]))
        found, _, _, _, info = many.step(np.array([action, 1]))
        np.testing.assert_array_equal(found, seen(info["state"]))


def test_a_class_says_how_its_motion_looks():
    from dataclasses import dataclass

    from pharos.environments import Breakout

    @dataclass(frozen=True, kw_only=True)
    class Silent(Breakout):
        """A trail, and no layer for it."""

        motion_layers = {}

    with pytest.raises(RuleError, match=r"Silent\.motion_layers is {}; expected a dict of name -> Layer"):
        pharos.check_environment(Silent(height=7, columns=4, brick_rows=1), max_states=1)


def test_a_study_has_images_without_and_with_motion():
    from pharos import study
    from pharos.observations import title

    entries = ["simple_image", {"name": "simple_image", "options": {"motion": True}}]
    block = {"environments": ["frozen_lake/4x4"], "observations": entries, "agents": ["dqn"], "seeds": 1}
    plain, moving = study.specification({"name": "both", "blocks": [block]}).runs
    assert plain.id != moving.id
    names = [title(run.config["observation"], run.config["observation_options"]) for run in (plain, moving)]
    assert names == ["simple_image", "simple_image(motion=True)"]
    assert title("vector", {"hide": ["row", "column"]}) == "vector(hide=row+column)"
    assert title("complex_image", {"size": (84, 84), "grey": True, "motion": False}) == "complex_image"
