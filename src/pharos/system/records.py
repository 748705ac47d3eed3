"""Dataclasses that are read from JSON of unknown origin: names and types of entries are those of the fields."""

import types
from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from pharos.errors import FileFormatError

T = TypeVar("T")
SHOWN = 60


def read(cls: type[T], entry: object, whose: str, optional: Collection[str] = ()) -> T:
    """An object of a dataclass from its entries; dataclasses among fields by their `from_dict`, or likewise.

    A whole number is a number; no value is converted, so that digests of the entries stay what they are.

    Args:
        whose: the entries are, for errors.
        optional: fields that may be left out.
    Raises:
        FileFormatError: an entry is missing, unknown or of another type.
    """
    names = [each.name for each in fields(cls)]  # type: ignore[arg-type]
    if not isinstance(entry, Mapping):
        raise FileFormatError(f"{whose} is {repr(entry)[:SHOWN]}; expected {', '.join(names)}")
    missing = [name for name in names if name not in entry and name not in optional]
    unknown = [name for name in entry if name not in names]
    if missing or unknown:
        wrong = f"lacks {', '.join(missing)}" if missing else f"has the unknown entry {str(unknown[0])[:SHOWN]!r}"
        raise FileFormatError(f"{whose} {wrong}; expected {', '.join(names)}")
    hints = get_type_hints(cls)
    return cls(**{name: _checked(value, hints[name], f"{whose}: {name}") for name, value in entry.items()})


def _checked(value: Any, hint: Any, whose: str) -> Any:
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if is_dataclass(hint) and isinstance(hint, type) and isinstance(value, Mapping):
        return getattr(hint, "from_dict", lambda entry: read(hint, entry, whose))(value)
    kinds = inner if kind is types.UnionType else (int, float) if kind is float else (kind,)
    is_number = isinstance(value, bool) and bool not in kinds  # Python counts truths as numbers
    if kind is not Any and (is_number or not isinstance(value, kinds)):
        expected = getattr(hint, "__name__", hint) if not inner or kind is types.UnionType else "an object"
        raise FileFormatError(f"{whose} is {repr(value)[:SHOWN]}; expected {expected}")
    if kind is Mapping and inner[1] is not Any:
        return {name: _checked(each, inner[1], f"{whose}: {name}") for name, each in value.items()}
    return value
