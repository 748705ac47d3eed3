"""Records: what JSON says is held against the fields of a dataclass, and kept as it is."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest

from pharos.errors import FileFormatError
from pharos.system.records import read


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
    record = read(Record, ENTRY, "a record")
    assert record == expected and type(record.share) is int
    few = {name: value for name, value in ENTRY.items() if name != "places"}
    assert read(Record, few, "a record", optional=("places",)).places == {}


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
        read(Record, {**ENTRY, **change}, "a record")


def test_what_lacks_entries_or_is_no_object_is_refused():
    with pytest.raises(FileFormatError, match=r"^a record lacks name; expected name, share, horizon"):
        read(Record, {name: value for name, value in ENTRY.items() if name != "name"}, "a record")
    with pytest.raises(FileFormatError, match=r"^a record is \[\]; expected name, share"):
        read(Record, [], "a record")
