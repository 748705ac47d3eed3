"""Options that travel together: read flat, documented once."""

import inspect
from dataclasses import dataclass, replace

import pytest

import pharos
from pharos.errors import ParameterError
from pharos.interaction import Interaction
from pharos.mdp import ChanceSetting
from pharos.system.options import flat, meanings, split, takes


@flat
@dataclass(frozen=True, kw_only=True)
class Trip:
    """A trip.

    Attributes:
        length, width: of the way, in
            metres.
        chance: on the way.
    """

    length: int
    width: int = 2
    chance: ChanceSetting = ChanceSetting()


def test_fields_of_a_part_are_keywords_and_attributes():
    trip = Trip(length=3, sticky=0.25)
    assert trip == Trip(length=3, chance=ChanceSetting(sticky=0.25)) and trip.sticky == 0.25
    assert replace(trip, lazy=0.5).chance == ChanceSetting(sticky=0.25, lazy=0.5)


def test_options_are_split_by_whose_they_are():
    trip, rest = split(Trip, {"length": 3, "random": 0.1, "height": 12})
    assert trip.chance.random == 0.1 and rest == {"height": 12}
    with pytest.raises(ParameterError, match="random=2; expected a finite number from 0 to 1"):
        split(Interaction, {"random": 2})


def test_what_an_option_means_stands_in_the_docstring():
    assert meanings(Trip) == {
        "length": "of the way, in metres.",
        "width": "of the way, in metres.",
        "chance": "on the way.",
    }
    assert set(meanings(ChanceSetting)) == set(ChanceSetting.__dataclass_fields__)


def test_the_signature_of_a_function_shows_the_options_that_it_takes():
    @takes(Trip, width=5)
    def walk(name, *, seed=0, **options):
        return name, seed, options

    shown = inspect.signature(walk).parameters
    assert [*shown][:5] == ["name", "seed", "length", "width", "sticky"] and [*shown][-1] == "options"
    assert (shown["width"].default, shown["length"].default, shown["sticky"].default) == (5, None, 0.0)
    assert "random" in inspect.signature(pharos.train).parameters
    assert inspect.signature(pharos.train_many).parameters["engine"].default == "batched"
