"""A class of environments in one file has everything: looks, named instances, Gymnasium ids, hyperparameters."""

import dataclasses
import importlib
import itertools
import sys
import textwrap

import gymnasium
import numpy as np
import pytest

import pharos
from pharos import environments
from pharos.agents import hyperparameters
from pharos.drawing import human, scenery_of, text_drawing
from pharos.environments import BuiltIn, Scenery, catalog
from pharos.errors import ParameterError, RuleError, UnknownName
from pharos.observations import render
from pharos.plots.style import MORE_COLORS

figures = importlib.import_module("pharos.study.figures")
registration = importlib.import_module("pharos.interaction.registration")

CORRIDOR = '''
from dataclasses import dataclass

from pharos import Environment, Layer
from pharos.environments import Look, Scenery, parameter


def stripes(picture, cell, margin):
    """Grey, with a light column at the left of each cell."""
    picture[:] = 90
    picture[:, margin[3] :: cell[1]] = 200


def cross(color, cell, glyph):
    """The main diagonal of the cell."""
    tile = [[(*color, float(x == y)) for x in range(cell)] for y in range(cell)]
    import numpy as np

    return np.array(tile)


@dataclass(frozen=True, kw_only=True)
class Corridor(Environment):
    """Walk to the right end of a corridor."""

    length: int = parameter(5, low=2, high=50)
    toll: float = parameter(0.0, low=0.0)

    name = "corridor"
    actions = ("left", "right")
    version = 3
    first_version = 2
    layers = {"goal": Layer("G", (9, 9, 9)), "walker": Layer("W", (10, 20, 30), shape=cross)}
    look = Look(ground=stripes, color="#123456", scenery=Scenery((6, 4), (1, 2, 3, 4), stripes, {"goal": ("#", "#")}))
    instances = {"short": {"length": 3}, "long": {"length": 40}}
    paper_instances = ("long",)
    hyperparameters = {"dqn": {"default": {"gamma": 0.5}, "vector": {"batch_size": 7}}}

    def variables(self):
        return {"place": range(self.length)}

    def initial_state(self):
        return (0,)

    def transition(self, state, action, out):
        out[0] = min(max(state[0] + 2 * action - 1, 0), self.length - 1)

    def is_terminal(self, state):
        return state[0] == self.length - 1

    def reward(self, state, action, next_state):
        return 1.0 if next_state[0] == self.length - 1 else -self.toll

    def grid(self):
        return 1, self.length

    def draw(self, state, planes):
        planes[0, 0, self.length - 1] = 1
        planes[1, 0, state[0]] = 1
'''


@pytest.fixture
def corridor(tmp_path, monkeypatch):
    file = tmp_path / "corridor.py"
    file.write_text(textwrap.dedent(CORRIDOR))
    monkeypatch.setattr(catalog, "_REGISTERED", {})
    before = dict(gymnasium.registry)
    yield pharos.make(f"{file}:Corridor")
    for name in set(gymnasium.registry) - set(before):
        del gymnasium.registry[name]
    sys.modules.pop("pharos_user_corridor", None)


def test_its_named_instances_are_made_by_name(corridor):
    assert pharos.make("corridor/short") == type(corridor)(length=3)
    names = [name for name in pharos.list_environments() if name.startswith("corridor")]
    assert names == ["corridor", "corridor/short", "corridor/long"]


@pytest.mark.long
def test_its_gymnasium_ids_follow_its_name_its_instances_and_the_version_of_its_rules(corridor):
    for name, length in (("Corridor", 5), ("Corridor-short", 3), ("Corridor-long", 40)):
        env = gymnasium.make(f"pharos/{name}-v1")
        assert env.unwrapped.environment == type(corridor)(length=length)
    assert gymnasium.make("pharos/Corridor-v1", length=9).unwrapped.environment.length == 9
    assert gymnasium.make_vec("pharos/Corridor-short-v1", num_envs=2).reset()[0].shape == (2, 1)


@pytest.mark.slow
def test_a_class_does_not_take_the_id_of_another(corridor):
    breakout = pharos.make("breakout")
    pharos.environments.register(type("Breakout", (type(corridor),), {"name": "my_breakout", "version": 2}))
    assert gymnasium.make("pharos/Breakout-v0").unwrapped.environment == breakout


@pytest.mark.long
def test_all_its_looks_are_drawn(corridor):
    assert text_drawing(corridor, (1,)) == ".W..G"
    picture = human(corridor, (1,), cell=8)
    assert (picture[6, 4:36:8] == 200).all() and (picture[:4, :4] == 90).all()  # its ground
    cell = picture[4:12, 12:20]
    diagonal = (cell == (10, 20, 30)).all(axis=2)
    np.testing.assert_array_equal(diagonal, np.eye(8, dtype=bool))  # its shape
    natural = render(corridor, (1,), "complex_image", size="natural")
    assert natural.shape == (1 + 6 + 3, 4 + 5 * 4 + 2, 3)
    assert (natural[1:7, 4 + 4 * 4 : 4 + 5 * 4] == 9).all()  # the sprite of its scenery
    assert render(corridor, (1,), "simple_image").shape[2] == 3
    assert scenery_of(corridor) is type(corridor).look.scenery


def test_it_brings_its_hyperparameters_and_its_colour(corridor):
    usual = hyperparameters("dqn", "nobody", "vector")
    assert hyperparameters("dqn", "corridor", "vector") == {**usual, "gamma": 0.5, "batch_size": 7}
    assert hyperparameters("dqn", "corridor", "simple_image", {"gamma": 0.1}) == {**usual, "gamma": 0.1}
    assert figures.class_color("corridor", ["corridor", "another"]) == "#123456"
    assert figures.class_color("another", ["corridor", "another"]) == MORE_COLORS[0]


def test_its_parameters_are_checked_by_what_it_declares(corridor):
    with pytest.raises(ParameterError, match="Corridor: length=1; expected an integer from 2 to 50"):
        pharos.make("corridor", length=1)
    with pytest.raises(ParameterError, match="Corridor: toll=-1; expected a finite number from 0 to inf"):
        pharos.make("corridor", toll=-1)
    assert pharos.make("corridor", toll=1).toll == 1.0


@pytest.mark.slow
def test_it_keeps_the_contract(corridor):
    report = pharos.check_environment(corridor)
    assert report.complete and report.compiled


def test_a_ground_or_shape_that_nobody_paints_is_named(corridor):
    cls = type(corridor)
    lost = dataclasses.replace(cls.look, ground="rood")
    with pytest.raises(UnknownName, match="unknown ground 'rood'; did you mean 'road'"):
        human(type("Lost", (cls,), {"look": lost})(), (0,))
    layers = {**cls.layers, "goal": dataclasses.replace(cls.layers["goal"], shape="bal")}
    with pytest.raises(UnknownName, match="unknown shape 'bal'; did you mean 'ball'"):
        human(type("Lost", (cls,), {"layers": layers})(), (0,))


def test_the_list_says_what_the_classes_say():
    for entry in environments.BUILT_IN:
        cls = getattr(environments, entry.class_name)
        version = max(0, cls.version - cls.first_version)
        assert entry == BuiltIn(cls.name, cls.__name__, " ".join(cls.instances), version)


def test_the_conformance_kit_names_a_ground_or_shape_that_nobody_paints(corridor):
    cls = type(corridor)

    def lost(**attributes):
        return dataclasses.dataclass(frozen=True, kw_only=True)(type("Lost", (cls,), attributes))()

    with pytest.raises(RuleError, match=r"Lost\.look\.ground: unknown ground 'rood'; did you mean 'road'"):
        pharos.check_environment(lost(look=dataclasses.replace(cls.look, ground="rood")))
    scenery = Scenery(cell=(8, 8), margin=(0, 0, 0, 0), ground="watr")
    with pytest.raises(RuleError, match=r"Lost\.look\.scenery\.ground: unknown ground 'watr'"):
        pharos.check_environment(lost(look=dataclasses.replace(cls.look, scenery=scenery)))
    layers = {**cls.layers, "goal": dataclasses.replace(cls.layers["goal"], shape="bal")}
    with pytest.raises(RuleError, match=r"Lost\.layers\['goal'\]\.shape: unknown shape 'bal'; did you mean 'ball'"):
        pharos.check_environment(lost(layers=layers))


def test_every_class_of_the_list_has_ids_a_colour_and_instances_that_can_be_made():
    built_in = [getattr(environments, entry.class_name) for entry in environments.BUILT_IN]
    assert [entry.class_name for entry in environments.BUILT_IN] == [cls.__name__ for cls in built_in]
    colors = [cls.look.color for cls in built_in]
    assert len(set(colors)) == len(colors)
    for cls in built_in:
        assert set(cls.paper_instances) <= set(cls.instances)
        for gymnasium_id, name in registration.ids_of(cls).items():
            assert gymnasium.spec(gymnasium_id).kwargs == {"environment": name}


def test_the_first_ids_are_still_there():
    names = ("SimpleGrid", "FrozenLake", "Freeway", "Breakout", "Environment", "Breakout-12x8x1")
    for name, ending in itertools.product(names, ("-v0",)):
        assert gymnasium.spec(f"pharos/{name}{ending}").version == 0
