"""States of an environment of the user, saved and restored in memory, and a digest of all that an environment holds.

A snapshot is a pickle in which everything that is no state is an object outside: random generators (which come back as
ones that branch), modules, classes, spaces, surfaces of pygame, and large constant tables. It is never written to disk
and never read from there.
"""

import contextlib
import enum
import functools
import hashlib
import io
import pickle  # noqa: TID251  (to copy an environment of the caller, in memory)
import random as python_random
import sys
import types
from collections import deque
from collections.abc import Callable, Collection, Iterator
from typing import Any, cast

import numpy as np

from pharos.errors import RuleError
from pharos.importers.chance import (
    BranchingGenerator,
    BranchingPythonGenerator,
    DrawError,
    DrawTree,
    RandomNumber,
)
from pharos.importers.wrappers import SILENT, WRAPPER_LIBRARIES, Stepped, wrapper_name
from pharos.system.wording import capped

GENERATORS = (np.random.Generator, np.random.RandomState, np.random.BitGenerator, python_random.Random)
OWNED = frozenset(
    [
        *("_np_random_seed", "spec", "_cached_spec", "metadata", "_metadata", "render_mode", "reward_range"),
        *("action_space", "_action_space", "observation_space", "_observation_space", "_saved_kwargs", "_reward_range"),
    ]
)
"""Attributes that Gymnasium gives to each environment, and that are no state."""
DROPPED = SILENT | {"OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "TimeLimit"}
"""Wrappers of WRAPPER_LIBRARIES that are left out. They count steps, check, print or record alone."""
LIMITS = ("_max_episode_steps", "max_episode_steps")
OUTSIDE = ("pygame", "pyglet", "matplotlib", "weakref", "threading", "logging", "_thread")
"""Libraries whose objects are no state: windows, figures, locks."""
PLAIN_TYPES = frozenset([int, float, bool, str, bytes, type(None), complex])
CONTAINERS = frozenset([dict, list, set, frozenset, np.ndarray])
HEAP_TYPE = 1 << 9
"""Flag of classes that are written in Python."""
LEAST_SHARED_BYTES = 200
PROBING_STEPS = 300


def bare(env: Stepped) -> tuple[Stepped, int | None]:
    """(the environment without the wrappers that only watch it, the smallest time limit among them)."""
    limits: list[int] = []
    top, above = env, None
    current, inner = env, getattr(env, "unwrapped", env)
    while current is not inner and hasattr(current, "env"):
        kind = type(current)
        if kind.__module__.split(".")[0] in WRAPPER_LIBRARIES and kind.__name__ in DROPPED:
            if kind.__name__ == "TimeLimit":
                limits += [int(vars(current)[name]) for name in LIMITS if vars(current).get(name) is not None]
            if above is None:
                top = current.env
            else:
                above.env = current.env
        else:
            above = current
        current = current.env
    return top, min(limits, default=None)


def chain_of(env: Stepped) -> list[Stepped]:
    """The wrappers of an environment, the outermost first, and the environment itself."""
    chain = [env]
    while isinstance(getattr(chain[-1], "__dict__", None), dict) and "env" in vars(chain[-1]) and len(chain) < 100:
        chain.append(vars(chain[-1])["env"])
    return chain


def _blank(kind: type) -> object:
    return kind.__new__(kind)  # type: ignore[call-overload]


def _set_fields(value: object, fields: dict[str, Any]) -> None:
    vars(value).update(fields)


def _view(base: np.ndarray, offset: int, shape: tuple, strides: tuple, kind: str) -> np.ndarray:
    return np.ndarray(shape, kind, buffer=base, offset=offset, strides=strides)


def _without_pickle_methods(value: object) -> bool:
    """Whether an object would be made anew of its arguments when it is copied: Gymnasium's EzPickle, and its copies."""
    return "_ezpickle_args" in getattr(value, "__dict__", ())


class _Template:
    """A function that is made again with copies of what it holds, such as the environment that a lambda renders."""

    def __init__(self, function: types.FunctionType):
        self.function = function


def _function(template: _Template) -> types.FunctionType:
    like = template.function
    cells = tuple(types.CellType() for _ in like.__closure__ or ())
    made = types.FunctionType(like.__code__, like.__globals__, like.__name__, like.__defaults__, cells)
    made.__kwdefaults__, made.__qualname__, made.__module__ = like.__kwdefaults__, like.__qualname__, like.__module__
    return made


def _fill_cells(function: types.FunctionType, contents: list[Any]) -> None:
    for cell, value in zip(function.__closure__ or (), contents, strict=True):
        cell.cell_contents = value


def _holds_environment(value: object) -> bool:
    """Whether a function was made within an environment that it holds."""
    if not isinstance(value, types.FunctionType):
        return False
    contents = map(_contents, value.__closure__ or ())
    return any(hasattr(each, "step") and hasattr(each, "reset") and not isinstance(each, type) for each in contents)


class _Pickler(pickle.Pickler):
    """A pickler that keeps the fields of EzPickle's heirs, arrays that are views, and functions within environments.

    Attributes:
        template: function -> its stand-in outside of the snapshot.
    """

    template: Callable[[types.FunctionType], _Template] = _Template

    def reducer_override(self, value: Any) -> Any:
        if _holds_environment(value):
            contents = [_contents(cell) for cell in value.__closure__]
            return _function, (self.template(value),), contents, None, None, _fill_cells
        if isinstance(value, np.ndarray) and type(value) is np.ndarray:
            return _reduced_view(value)
        if _without_pickle_methods(value):
            return _blank, (type(value),), vars(value), None, None, _set_fields
        return NotImplemented


def _reduced_view(value: np.ndarray) -> object:
    """The parts of a view of another array; NotImplemented for any other array."""
    base = value.base
    while isinstance(base, np.ndarray) and isinstance(base.base, np.ndarray):
        base = base.base
    if type(base) is not np.ndarray or base.dtype.hasobject or value.dtype.hasobject:
        return NotImplemented
    if not base.flags.c_contiguous or not base.flags.writeable:
        return NotImplemented
    offset = value.__array_interface__["data"][0] - base.__array_interface__["data"][0]
    return _view, (base, offset, value.shape, value.strides, value.dtype.str)


class EnvironmentSnapshots:
    """Copies of an environment in memory.

    Args:
        branches: of the generators that copies get.
        ignore: names of fields, of whatever object, that are no part of a state's key.
    Attributes:
        is_strict: whether a generator of NumPy or Python that is met is an error: it was made after the first copy, and
            its draws are not seen.
        is_closed: whether other processes restore the snapshots, so that no object outside may be new.
        constants: (position among `chain_of`, field) -> the bytes of a table that all copies share.
    """

    def __init__(self, branches: DrawTree, ignore: frozenset[str] = frozenset()):
        self.numpy, self.python = BranchingGenerator(branches), BranchingPythonGenerator(branches)
        self.ignore = ignore
        self.is_strict = self.is_closed = False
        self.constants: dict[tuple[int, str], bytes] = {}
        self._outside: list[Any] = []
        self._indices: dict[tuple[int, str], int] = {}
        self._adopted: list[Any] = []
        self._numbers: dict[int, int] = {}
        self._templates: dict[types.CodeType, _Template] = {}

    @contextlib.contextmanager
    def drawing_from(self, branches: DrawTree) -> Iterator[None]:
        """Let generators that are restored within draw from another tree."""
        before = self.numpy, self.python
        self.numpy, self.python = BranchingGenerator(branches), BranchingPythonGenerator(branches)
        try:
            yield
        finally:
            self.numpy, self.python = before

    # Saving -----------------------------------------------------------------------------------------------------------

    def save(self, value: object) -> bytes:
        """A snapshot of an environment, or of a part of it."""
        stored = io.BytesIO()
        pickler = self._pickler(stored)
        try:
            pickler.dump(value)
        except RuleError:
            raise
        except (pickle.PicklingError, TypeError, AttributeError, ValueError, RecursionError) as error:
            raise RuleError(f"keeps what cannot be copied: {self._culprit(value)}{capped(error)}") from None
        return stored.getvalue()

    def _pickler(self, stored: io.BytesIO) -> _Pickler:
        pickler = _Pickler(stored, protocol=5)
        pickler.persistent_id, pickler.template = self._reference, self._template  # type: ignore[method-assign]
        return pickler

    def _template(self, function: types.FunctionType) -> _Template:
        """Stand-in for the functions of one line of code."""
        return self._templates.setdefault(function.__code__, _Template(function))

    def restore(self, snapshot: bytes) -> Stepped:
        """A copy of what `save` was given."""
        reader = pickle.Unpickler(io.BytesIO(snapshot))
        reader.persistent_load = self._referred  # type: ignore[method-assign,assignment]
        return reader.load()

    def _culprit(self, env: object) -> str:
        """The field of an environment that cannot be copied, for a message."""
        for each in chain_of(env):
            for name, value in sorted(getattr(each, "__dict__", {}).items()):
                if name == "env":
                    continue
                try:
                    self._pickler(io.BytesIO()).dump(value)
                except Exception:
                    return f"field {name} of {wrapper_name(each)} ({type(value).__name__}): "
        return ""

    def _reference(self, value: object) -> object:
        """Name of an object that is outside a snapshot; None for the others."""
        kind = type(value)
        if kind in PLAIN_TYPES:
            return None
        number = self._numbers.get(id(value))
        if number is not None:
            return number
        if not _is_outside(kind) or _holds_environment(value):
            return None
        if isinstance(value, types.ModuleType):
            return ("module", value.__name__)
        if isinstance(value, (BranchingGenerator, *GENERATORS)):
            return self._generator(value)
        return None if _is_importable(value) else self._add_outside(value)

    def _generator(self, value: object) -> str:
        if self.is_strict and not isinstance(value, BranchingGenerator):
            raise DrawError(
                f"made a generator of its own ({type(value).__module__}.{type(value).__name__}), whose draws are not "
                f"seen; make it once, before the first episode, or use self.np_random"
            )
        return "python" if isinstance(value, python_random.Random | BranchingPythonGenerator) else "numpy"

    def _add_outside(self, value: object) -> int:
        if self.is_closed:
            raise RuleError(
                f"made a {type(value).__name__} in a step, which other processes do not have; try one worker"
            )
        self._numbers[id(value)] = len(self._outside)
        self._outside.append(value)
        _tame(value, self.numpy)
        return len(self._outside) - 1

    def _referred(self, name: int | str | tuple[str, str]) -> object:
        if isinstance(name, int):
            return self._outside[name]
        if name == "numpy":
            return self.numpy
        if name == "python":
            return self.python
        return sys.modules[name[1]]

    # Constants --------------------------------------------------------------------------------------------------------

    def share_constants(self, env: Stepped, play: Callable[[Stepped, int], None], copied: frozenset[str]) -> None:
        """Let snapshots share large tables of numbers that PROBING_STEPS random steps leave as they are.

        Args:
            play: steps a copy of the environment so often.
            copied: fields that are not to be shared.
        """
        twin = self.restore(self.save(env))
        before = dict(self._tables(twin))
        play(twin, PROBING_STEPS)
        after = dict(self._tables(twin))
        chain = chain_of(env)
        for (index, name), data in before.items():
            value = vars(chain[index]).get(name)
            if name in copied or after.get((index, name)) != data or not _is_plain(value):
                continue
            if id(value) not in self._numbers and self.save(value) == data:
                self._indices[index, name] = self._add_outside(value)
                self.constants[index, name] = data

    def _tables(self, env: Stepped) -> Iterator[tuple[tuple[int, str], bytes]]:
        """Yield the large fields of an environment: (position, name), bytes."""
        for index, each in enumerate(chain_of(env)):
            for name, value in vars(each).items():
                if isinstance(value, dict | list | tuple | np.ndarray) and _is_plain(value):
                    data = self.save(value)
                    if len(data) > LEAST_SHARED_BYTES:
                        yield (index, name), data

    def changed_constant(self, env: Stepped) -> str | None:
        """The field of a shared table that a step has changed; None if there is none."""
        chain = chain_of(env)
        plain = EnvironmentSnapshots(DrawTree())
        for (index, name), data in self.constants.items():
            if plain.save(vars(chain[index]).get(name)) != data:
                return name
        return None

    # Digests ----------------------------------------------------------------------------------------------------------

    def digest(self, env: Stepped, *, complete: bool = False) -> bytes:
        """Digest of all fields of an environment, without those that are ignored.

        Args:
            complete: whether ignored fields count as well.
        """
        hasher = hashlib.blake2b(digest_size=16)
        feeder = _Feeder(hasher.update, frozenset() if complete else self.ignore)
        chain = chain_of(env)
        for index, each in enumerate(chain):
            feeder.indices[id(each)] = (index, each)
        for index, each in enumerate(chain):
            hasher.update(type(each).__qualname__.encode())
            for name, value in sorted(_fields_of(each).items()):
                if name in OWNED or name == "env" or name in feeder.ignore:
                    continue
                hasher.update(name.encode())
                if (index, name) in self.constants and id(value) in self._numbers:
                    continue
                feeder.feed(value)
        return hasher.digest()

    def outside_digest(self) -> bytes:
        """Digest of the objects outside: two processes with the same can restore each other's snapshots."""
        names = [(type(each).__qualname__, getattr(each, "__qualname__", "")) for each in self._outside]
        return snapshot_digest([*names, *(data for data in self.constants.values())])

    def adopt(self, env: Stepped) -> str | None:
        """Take the tables of another environment for those that are shared; the name of one that differs, if any."""
        chain = chain_of(env)
        for index, name in self.constants:
            value = vars(chain[index]).get(name) if index < len(chain) else None
            shared = self._outside[self._indices[index, name]]
            if snapshot_digest(value) != snapshot_digest(shared):
                return name
            self._numbers[id(value)] = self._indices[index, name]
            self._adopted.append(value)  # so that no other object gets its number
        return None


def field_names(env: Stepped) -> set[str]:
    """Names of the fields of an environment and of all objects in it."""
    names, feeder = set[str](), _Feeder(lambda _: None, frozenset())
    for each in chain_of(env):
        names |= set(_fields_of(each))
        feeder.feed(each)
    return names.union(*(_fields_of(value) for _, value in feeder.indices.values()))


def snapshot_digest(value: object) -> bytes:
    """Digest of any value, as of the field of an environment."""
    hasher = hashlib.blake2b(digest_size=16)
    _Feeder(hasher.update, frozenset()).feed(value)
    return hasher.digest()


class _Feeder:
    """Writes values canonically: equal bytes for equal values, shared objects by their first position."""

    def __init__(self, put: Callable[[bytes], object], ignore: frozenset[str]):
        self.put, self.ignore = put, ignore
        self.indices: dict[int, tuple[int, Any]] = {}

    def feed(self, value: object) -> None:
        """Write a value."""
        kind = type(value)
        if kind in PLAIN_TYPES:
            self.put(f"{kind.__name__}{value!r};".encode())
        elif kind is tuple:
            self._feed_items("(", value)
        elif isinstance(value, np.generic):
            self.put(f"{kind.__name__}{value.item()!r};".encode())
        elif (kind not in CONTAINERS and not self._is_fed_as_name(value)) or kind in CONTAINERS:
            self._feed_once(value)

    def _feed_once(self, value: object) -> None:
        entry = self.indices.get(id(value))
        if entry is not None:
            self.put(f"@{entry[0]};".encode())
            return
        self.indices[id(value)] = (len(self.indices), value)
        self._feed_object(value)

    def _is_fed_as_name(self, value: object) -> bool:
        """Write what is told apart by its name, such as functions; whether the value was such a thing."""
        kind = type(value)
        if isinstance(value, RandomNumber):
            float(value)  # which refuses
        elif isinstance(value, enum.Enum):
            self.put(f"{kind.__qualname__}.{value.name};".encode())
        elif isinstance(value, (BranchingGenerator, *GENERATORS)):
            self.put(b"~")
        elif isinstance(value, tuple):
            self._feed_items(f"({kind.__qualname__}", value)
            if getattr(value, "__dict__", None):
                self._feed_fields(value)
        elif isinstance(value, types.FunctionType):
            self._feed_function(value)
        elif _is_outside(kind):
            self.put(f"~{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', kind.__name__)};".encode())
        else:
            return False
        return True

    def _feed_items(self, head: str, items: Any) -> None:
        self.put(f"{head}{len(items)}:".encode())
        if set(map(type, items)) <= PLAIN_TYPES:
            self.put(repr(list(items)).encode())
            return
        for item in items:
            self.feed(item)

    def _feed_function(self, value: types.FunctionType) -> None:
        """Name of a function, and what it holds in its closure and defaults."""
        self.put(f"~{value.__module__}.{value.__qualname__};".encode())
        for cell in value.__closure__ or ():
            contents = _contents(cell)
            if not callable(contents):
                self.feed(contents)

    def _feed_object(self, value: object) -> None:
        if isinstance(value, np.ndarray):
            self._feed_array(value)
        elif isinstance(value, dict):
            self.put(f"{{{type(value).__name__}{len(value)}:".encode())
            if {*map(type, value), *map(type, value.values())} <= PLAIN_TYPES:
                self.put(repr(list(value.items())).encode())
                return
            for name, item in value.items():
                self.feed(name)
                self.feed(item)
        elif isinstance(value, set | frozenset):
            self._feed_set(value)
        elif isinstance(value, list | deque):
            self._feed_items(f"[{type(value).__name__}", value)
        elif isinstance(value, bytearray):
            self.put(bytes(value))
        elif isinstance(value, types.MethodType):
            self.put(value.__func__.__qualname__.encode())
            self.feed(value.__self__)
            return
        else:
            self._feed_fields(value)
            return
        if getattr(value, "__dict__", None):
            self._feed_fields(value)

    def _feed_array(self, value: np.ndarray) -> None:
        self.put(f"a{value.dtype.str}{value.shape}".encode())
        if value.dtype.hasobject:
            for item in value.ravel():
                self.feed(item)
        else:
            self.put(value.tobytes())

    def _feed_set(self, value: Collection[object]) -> None:
        digests = []
        for item in value:
            hasher = hashlib.blake2b(digest_size=16)
            inner = _Feeder(hasher.update, self.ignore)
            inner.indices = self.indices  # whatever hashes is rarely shared
            inner.feed(item)
            digests.append(hasher.digest())
        self.put(f"s{len(digests)}:".encode() + b"".join(sorted(digests)))

    def _feed_fields(self, value: object) -> None:
        """Fields of an object of any class."""
        kind = type(value)
        self.put(f"<{kind.__module__}.{kind.__qualname__}".encode())
        fields = _fields_of(value)
        for name, item in sorted(fields.items()):
            if name not in self.ignore:
                self.put(name.encode())
                self.feed(item)
        is_hidden = _has_hidden_state(kind) and not _without_pickle_methods(value)
        if is_hidden or not (fields or hasattr(value, "__dict__") or hasattr(kind, "__slots__")):
            self._feed_reduced(value)

    def _feed_reduced(self, value: object) -> None:
        """The parts of which an object of a class in C is made again."""
        parts = value.__reduce_ex__(4)
        if isinstance(parts, str):
            self.put(parts.encode())
            return
        _, arguments, *rest = parts
        self.feed(arguments)
        for part in rest[:1]:
            self.feed(part)
        for part in rest[1:]:
            for item in part or ():
                self.feed(item)


def _holds_hidden_state(kind: type) -> bool:
    """Whether objects of a class hold what is not in their fields: by methods for pickle, or a base class in C."""
    has_methods = kind.__reduce__ is not object.__reduce__ or kind.__reduce_ex__ is not object.__reduce_ex__
    return has_methods or any(not base.__flags__ & HEAP_TYPE for base in kind.__mro__[:-1])


_has_hidden_state = cast(Callable[[Any], bool], functools.cache(_holds_hidden_state))


def _contents(cell: types.CellType) -> object:
    try:
        return cell.cell_contents
    except ValueError:  # empty
        return None


def _fields_of(value: object) -> dict[str, Any]:
    """Attributes of an object, from its dictionary and its slots."""
    fields = dict(getattr(value, "__dict__", ()))
    for kind in type(value).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                fields[name] = getattr(value, name)
    return fields


def _holds_no_state(kind: type) -> bool:
    """Whether objects of a class are no state, or are generators."""
    functions = (types.ModuleType, types.FunctionType, type, _Template)
    if issubclass(kind, (*functions, BranchingGenerator, *GENERATORS)):
        return True
    if kind.__module__.split(".")[0] in OUTSIDE:
        return True
    names = [f"{each.__module__}.{each.__qualname__}" for each in kind.__mro__]
    return any(name.startswith(("gymnasium.spaces.", "gym.spaces.")) or name.endswith(".EnvSpec") for name in names)


_is_outside = cast(Callable[[Any], bool], functools.cache(_holds_no_state))


def _is_importable(value: object) -> bool:
    """Whether a class or function is found under its name."""
    if not isinstance(value, type | types.FunctionType):
        return False
    target: object = sys.modules.get(value.__module__)
    for part in value.__qualname__.split("."):
        target = getattr(target, part, None)
    return target is value


def _tame(value: object, generator: BranchingGenerator) -> None:
    """Let a space, and those in it, draw from a generator that branches."""
    if ".spaces." not in f"{type(value).__module__}.":
        return
    fields = getattr(value, "__dict__", {})
    if "_np_random" in fields:
        fields["_np_random"] = generator
    for each in fields.values():
        inner = each.values() if isinstance(each, dict) else each if isinstance(each, tuple | list) else (each,)
        for one in inner:
            if one is not value and ".spaces." in f"{type(one).__module__}.":
                _tame(one, generator)


def _is_plain(value: Any) -> bool:
    """Whether a value holds nothing but numbers, texts and containers of them, so that a copy is as good as itself."""
    if type(value) in PLAIN_TYPES or isinstance(value, np.generic):
        return True
    if type(value) is np.ndarray:
        return not value.dtype.hasobject and not isinstance(value.base, np.ndarray)
    if type(value) is dict:
        return all(_is_plain(name) and _is_plain(item) for name, item in value.items())
    return type(value) in (list, tuple, set, frozenset) and all(map(_is_plain, value))


def integers_of(env: Stepped, ignore: frozenset[str]) -> dict[str, int]:
    """Whole numbers that an environment and its parts hold, by the names of their fields; ambiguous names are left out.

    Args:
        ignore: names that are left out.
    """
    values: dict[str, int] = {}
    repeated: set[str] = set(ignore) | OWNED
    visited: set[int] = set()

    def visit(value: object, depth: int) -> None:
        for name, item in getattr(value, "__dict__", {}).items():
            if isinstance(item, int | np.integer) and not isinstance(item, bool):
                repeated.update([name] if name in values else ())
                values[name] = int(item)
            elif depth < 3 and id(item) not in visited and hasattr(item, "__dict__") and not _is_outside(type(item)):
                visited.add(id(item))
                visit(item, depth + 1)

    for each in chain_of(env):
        visited.add(id(each))
    for each in chain_of(env):
        visit(each, 0)
    return {name: value for name, value in values.items() if name not in repeated}
