"""Frozen dataclasses made of keywords or read from JSON.

Options that travel together are declared once, and documented under *Attributes* of the class; Python's keywords, the
command line and YAML files are read into them. Records are JSON of unknown origin: names and types of entries must be
the names and types of the fields.
"""

import functools
import inspect
import operator
import re
import types
from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass, replace
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from pharos.errors import FileFormatError

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])
SHOWN_LETTERS = 60  # letters of a wrong entry, in errors


def docstring_entries(documented: object) -> dict[str, str]:
    """Texts by name, of entries such as `height, width: of the grid` in the section Attributes or Args of a docstring,
    also of the classes that a class extends.
    """
    texts: dict[str, str] = {}
    for each in reversed(getattr(documented, "__mro__", [documented])):
        sections = re.findall(
            r"^(?:Attributes|Args):\n((?:(?: .*)?(?:\n|$))+)", inspect.getdoc(each) or "", re.MULTILINE
        )
        names: list[str] = []
        for line in "\n".join(sections).splitlines():
            entry = re.match(r"    (\w+(?:, \w+)*): (.*)", line)
            if entry:
                names = entry[1].split(", ")
                texts |= dict.fromkeys(names, entry[2])
            elif not line.startswith("     "):
                names = []
            for name in () if entry else names:
                texts[name] += " " + line.strip()
    return texts


def first_sentence(text: str) -> str:
    """The first sentence of a text, with a capital letter, but for names such as `dqn, ppo`."""
    sentence = re.split(r"(?<=\.) (?=[A-Z])", text)[0]
    return sentence[:1].upper() + sentence[1:] if re.match(r"[a-z]+[ ;:]", sentence) else sentence


def _fields(cls: type) -> tuple[Field, ...]:
    """Fields of a dataclass, or TypeError."""
    return fields(cls)  # type: ignore[arg-type]


@functools.cache
def parts(cls: type) -> dict[str, type]:
    """Field -> its class, of the fields that are dataclasses themselves."""
    hints = get_type_hints(cls)
    return {each.name: hints[each.name] for each in _fields(cls) if is_dataclass(hints[each.name])}


def option_names(cls: type) -> set[str]:
    """Names of the fields of a dataclass, and of the fields of its parts."""
    return {each.name for owner in (cls, *parts(cls).values()) for each in _fields(owner)}


def nested_options(cls: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a dataclass, with fields of its parts given by their own names: `sticky=0.1` as `chance=...`."""
    own = dict(options)
    for name, part in parts(cls).items():
        inside = {each.name: own.pop(each.name) for each in _fields(part) if each.name in own}
        if inside:
            own[name] = replace(own.get(name, part()), **inside)
    return own


def flat(cls: type[T]) -> type[T]:
    """Class decorator: a dataclass that takes the fields of its parts as keywords, too, and has them as attributes."""
    init = cls.__init__

    @functools.wraps(init)
    def flat_init(self: T, *args: object, **options: object) -> None:
        init(self, *args, **nested_options(cls, options))

    cls.__init__ = flat_init  # type: ignore[method-assign, assignment]
    for name, part in parts(cls).items():  # type: ignore[arg-type]
        for each in _fields(part):
            setattr(cls, each.name, property(operator.attrgetter(f"{name}.{each.name}")))
    return cls


def takes(cls: type, **defaults: object) -> Callable[[F], F]:
    """Decorator: the signature of a function shows the options of a dataclass and its parts before `**options`."""
    own = [each for each in _fields(cls) if each.name not in parts(cls)]
    leaves = [*own, *(each for part in parts(cls).values() for each in _fields(part))]

    def shown(function: F) -> F:
        signature = inspect.signature(function)
        *before, rest = signature.parameters.values()
        names = {each.name for each in before}
        values = {each.name: None if each.default is MISSING else each.default for each in leaves} | defaults
        keywords = [
            inspect.Parameter(each.name, rest.KEYWORD_ONLY, default=values[each.name], annotation=each.type)
            for each in leaves
            if each.name not in names
        ]
        function.__signature__ = signature.replace(parameters=[*before, *keywords, rest])  # type: ignore[attr-defined]
        return function

    return shown


def split_options(cls: type[T], options: Mapping[str, Any]) -> tuple[T, dict[str, Any]]:
    """An object of the options that are fields of a dataclass or of its parts, and the other options."""
    names = option_names(cls)
    own = {name: value for name, value in options.items() if name in names}
    return cls(**nested_options(cls, own)), {name: value for name, value in options.items() if name not in names}


# Records --------------------------------------------------------------------------------------------------------------


def parse_record(cls: type[T], entry: object, source: str, optional: Collection[str] = ()) -> T:
    """An object of a dataclass from its entries. Dataclasses among fields are made by their `from_dict`, or likewise.

    A whole number is a number. No value is converted, so that digests of the entries stay what they are.

    Args:
        source: what the entries belong to, for errors.
        optional: fields that may be left out.
    Raises:
        FileFormatError: an entry is missing, unknown or of another type.
    """
    names = [each.name for each in _fields(cls)]
    if not isinstance(entry, Mapping):
        raise FileFormatError(f"{source} is {repr(entry)[:SHOWN_LETTERS]}; expected {', '.join(names)}")
    missing = [name for name in names if name not in entry and name not in optional]
    unknown = [name for name in entry if name not in names]
    if missing or unknown:
        wrong = (
            f"lacks {', '.join(missing)}" if missing else f"has the unknown entry {str(unknown[0])[:SHOWN_LETTERS]!r}"
        )
        raise FileFormatError(f"{source} {wrong}; expected {', '.join(names)}")
    hints = get_type_hints(cls)
    return cls(**{name: _checked(value, hints[name], f"{source}: {name}") for name, value in entry.items()})


def _checked(value: object, hint: object, source: str) -> object:
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if is_dataclass(hint) and isinstance(hint, type) and isinstance(value, Mapping):
        return getattr(hint, "from_dict", lambda entry: parse_record(hint, entry, source))(value)
    kinds = inner if kind is types.UnionType else (int, float) if kind is float else (kind,)
    is_number = isinstance(value, bool) and bool not in kinds  # Python counts truths as numbers
    if kind is not Any and (is_number or not isinstance(value, kinds)):
        expected = getattr(hint, "__name__", hint) if not inner or kind is types.UnionType else "an object"
        raise FileFormatError(f"{source} is {repr(value)[:SHOWN_LETTERS]}; expected {expected}")
    if isinstance(value, Mapping) and kind is Mapping and inner[1] is not Any:
        return {name: _checked(each, inner[1], f"{source}: {name}") for name, each in value.items()}
    return value
