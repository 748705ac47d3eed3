"""Options that travel together: read flat, documented once. Records: JSON held against fields, and kept as it is."""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

import pharos
from pharos import study
from pharos.errors import FileFormatError, ParameterError
from pharos.interaction import Interaction
from pharos.mdp import ChanceSetting
from pharos.system.records import docstring_entries, flat, parse_record, split_options, takes


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
    trip, rest = split_options(Trip, {"length": 3, "random": 0.1, "height": 12})
    assert trip.chance.random == 0.1 and rest == {"height": 12}
    with pytest.raises(ParameterError, match="random=2; expected a finite number from 0 to 1"):
        split_options(Interaction, {"random": 2})


def test_what_an_option_means_stands_in_the_docstring():
    assert docstring_entries(Trip) == {
        "length": "of the way, in metres.",
        "width": "of the way, in metres.",
        "chance": "on the way.",
    }
    assert set(docstring_entries(ChanceSetting)) == set(ChanceSetting.__dataclass_fields__)


def test_the_signature_of_a_function_shows_the_options_that_it_takes():
    @takes(Trip, width=5)
    def walk(name, *, seed=0, **options):
        return name, seed, options

    shown = inspect.signature(walk).parameters
    assert [*shown][:5] == ["name", "seed", "length", "width", "sticky"] and [*shown][-1] == "options"
    assert (shown["width"].default, shown["length"].default, shown["sticky"].default) == (5, None, 0.0)
    assert "random" in inspect.signature(pharos.train).parameters
    assert inspect.signature(pharos.train_many).parameters["engine"].default == "batched"
    for function, workers in ((study.run, None), (study.submit, 1), (study.run_on_ray, None)):
        shown = inspect.signature(function).parameters
        assert {"shard", "retry_failed", "resume", "timeout", "device"} <= {*shown}
        assert shown["workers"].default == workers


# Test records ---------------------------------------------------------------------------------------------------------


@dataclass
class Place:
    row: int


@dataclass
class Record:
    name: str
    share: float
    horizon: int | None
    exact: bool
    place: Place
    versions: Mapping[str, str]
    places: Mapping[str, Place] = field(default_factory=dict)
    more: Any = None


ENTRY = {
    "name": "a",
    "share": 1,
    "horizon": None,
    "exact": True,
    "place": {"row": 2},
    "versions": {"numpy": "2"},
    "places": {"start": {"row": 3}},
    "more": [1],
}


def test_a_record_has_the_values_of_its_entries():
    expected = Record("a", 1, None, True, Place(2), {"numpy": "2"}, {"start": Place(3)}, [1])
    record = parse_record(Record, ENTRY, "a record")
    assert record == expected and type(record.share) is int
    few = {name: value for name, value in ENTRY.items() if name != "places"}
    assert parse_record(Record, few, "a record", optional=("places",)).places == {}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": 3}, "a record: name is 3; expected str"),
        ({"share": True}, "a record: share is True; expected float"),
        ({"share": "1"}, "a record: share is '1'; expected float"),
        ({"horizon": 1.5}, r"a record: horizon is 1.5; expected int \| None"),
        ({"exact": 1}, "a record: exact is 1; expected bool"),
        ({"place": 7}, "a record: place is 7; expected Place"),
        ({"place": {"row": "x"}}, "a record: place: row is 'x'; expected int"),
        ({"place": {}}, "a record: place lacks row; expected row"),
        ({"versions": []}, r"a record: versions is \[\]; expected an object"),
        ({"versions": {"numpy": 2}}, "a record: versions: numpy is 2; expected str"),
        ({"places": {"start": None}}, "a record: places: start is None; expected Place"),
        ({"width": 3}, "a record has the unknown entry 'width'; expected name, share"),
    ],
)
def test_an_entry_of_another_type_is_named_with_what_was_expected(change, message):
    with pytest.raises(FileFormatError, match=f"^{message}"):
        parse_record(Record, {**ENTRY, **change}, "a record")


def test_what_lacks_entries_or_is_no_object_is_refused():
    with pytest.raises(FileFormatError, match=r"^a record lacks name; expected name, share, horizon"):
        parse_record(Record, {name: value for name, value in ENTRY.items() if name != "name"}, "a record")
    with pytest.raises(FileFormatError, match=r"^a record is \[\]; expected name, share"):
        parse_record(Record, [], "a record")
