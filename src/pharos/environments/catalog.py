"""The catalogue of environments that `pharos.make` knows: classes by name, and their named instances.

The built-in classes are listed in built_in.py, and a class is loaded when it is first asked for. A user's own class
joins the catalogue with `register`.
"""

import contextlib
import dataclasses
import importlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pharos.environments.base import Environment, as_tuples
from pharos.environments.built_in import BUILT_IN, notify
from pharos.errors import ParameterError, UnknownName
from pharos.system import mdp_files, sources
from pharos.system.sources import Source

_CLASS_NAMES = {entry.name: entry.class_name for entry in BUILT_IN}
_FILES_BY_NAME = {entry.name: entry.file for entry in BUILT_IN}
_IMPORTED = {"imported": "ImportedWorld"}  # named by its folder, so it stands in no list
_OWN = _CLASS_NAMES | _IMPORTED
_REGISTERED: dict[str, type[Environment]] = {}


def make(name: str, **parameters: object) -> Environment:
    """Return the environment called `name`, with `parameters` for its class.

    Args:
        name: a class (`"breakout"`), a named instance (`"breakout/12x10x1"`, see `list_environments`), a folder with an
            imported MDP, or where your own class is (`"my_module:MyClass"`, `"folder/my_file.py:MyClass"`), which
            registers it.
        parameters: of the class. They override the parameters of a named instance.
    Raises:
        UnknownName: no such environment or parameter. The nearest name is suggested.
        ParameterError: a parameter is out of range, there is no such module or class, or `name` is no text.
    """
    if not isinstance(name, str):
        written = f"{name.__name__}()" if isinstance(name, type) else "it as it is"
        raise ParameterError(f"make: found {name!r:.60}; expected a name, such as 'frozen_lake/4x4': write {written}")
    class_name, slash, instance = name.partition("/")
    cls = class_called(class_name)
    if (cls is None or (slash and instance not in cls.instances)) and mdp_files.is_folder(Path(name).expanduser()):
        parameters, name, slash = {"folder": name, **parameters}, "imported", ""
        class_name, cls = name, class_called(name)
    if cls is None or (slash and instance not in cls.instances):
        if not sources.is_reference(name):
            if name.startswith((".", "/", "~")):
                reason = "no imported MDP is in that folder" if Path(name).expanduser().is_dir() else "no such folder"
                raise UnknownName("environment", name, (), f"{reason}; expected what `pharos import` writes")
            shown = f"known: {', '.join(sorted(classes()))}; `pharos list` shows their parameters and named instances"
            raise UnknownName("environment", name, list_environments(), shown)
        cls, slash = import_class(name), ""
        class_name = cls.name
    defaults: Mapping[str, Any] = cls.instances[instance] if slash else {}
    if not dataclasses.is_dataclass(cls):
        raise ParameterError(f"{cls.__name__} is no dataclass; expected @dataclass(frozen=True, kw_only=True) above it")
    names = {field.name for field in dataclasses.fields(cls)}
    for parameter in parameters:
        if parameter in cls.foreign_parameters:
            raise ParameterError(
                f"unknown parameter {parameter!r} of {class_name}: {cls.foreign_parameters[parameter]}"
            )
        if parameter not in names:
            raise UnknownName(f"parameter of {class_name}", parameter, names)
    return cls(**{**defaults, **{name: as_tuples(value) for name, value in parameters.items()}})


def list_environments() -> list[str]:
    """The names that `make` knows: every class, then every named instance."""
    return [*classes(), *named_instances()]


def class_called(name: str) -> type[Environment] | None:
    """The class with this name, or None if there is none."""
    return _built_in(name) if name in _OWN else _REGISTERED.get(name)


def classes() -> dict[str, type[Environment]]:
    """Name -> class of every environment, the registered ones last. Loads all of them."""
    return {**{name: _built_in(name) for name in _CLASS_NAMES}, **_REGISTERED}


def _built_in(name: str) -> type[Environment]:
    return getattr(importlib.import_module(f"pharos.environments.{_FILES_BY_NAME.get(name, name)}"), _OWN[name])


def named_instances() -> dict[str, tuple[str, Mapping[str, Any]]]:
    """Name, such as "breakout/12x8x1" -> (name of the class, parameters): the `instances` of every class."""
    return {
        f"{name}/{instance}": (name, parameters)
        for name, cls in classes().items()
        for instance, parameters in cls.instances.items()
    }


def instance_name(environment: str, parameters: Mapping[str, object]) -> str:
    """Name of an instance with these parameters, such as `frozen_lake/8x8`. If there is none, the class and parameters
    that differ from its defaults (if the class is not loaded or has no defaults: all that are neither None nor empty).
    """
    cls, setting = class_called(environment), {name: as_tuples(value) for name, value in parameters.items()}
    usual: Mapping[str, object] = {name: value for name, value in setting.items() if value in (None, ())}
    if cls is not None:
        for name in cls.instances:
            if make(f"{environment}/{name}").parameters == setting:
                return f"{environment}/{name}"
        with contextlib.suppress(TypeError):  # a parameter has no default
            usual = cls().parameters
    return " ".join([environment, *(f"{name}={value}" for name, value in setting.items() if value != usual.get(name))])


def import_class(path: str, folder: str | os.PathLike | None = None) -> type[Environment]:
    """Import a user's class from "module:Class" or "file.py:Class", register it and return it.

    Args:
        folder: relative files and modules are looked for there first. Default: the current directory.
    Raises:
        ParameterError: no such module, file or class, or one that `register` refuses.
    """
    source = sources.find_source(path, None if folder is None else Path(folder))
    return _known_class(source, sources.load_source(source))


def class_of(source: Source, *, trust: bool = False, strict: bool = False) -> type[Environment]:
    """The class that a stored configuration names, registered, so that `make` knows it.

    Args:
        trust, strict: as for `pharos.system.sources.resolve`.
    Raises:
        UntrustedCode: it was not imported before, and is not trusted. ParameterError: it cannot be imported.
    """
    return _known_class(source, sources.resolve(source, trust=trust, strict=strict))


def class_source(cls: type[Environment]) -> Source | None:
    """Module or file of a user's class. None for built-in classes, and for those that no other process can import."""
    return None if _is_built_in(cls) else sources.source_of(cls)


def _known_class(source: Source, cls: object) -> type[Environment]:
    if cls is None:
        raise ParameterError(
            f"{source.name!r}: AttributeError: there is no {source.attribute!r}; expected 'module:Class' or "
            f"'file.py:Class'"
        )
    if not isinstance(cls, type) or not issubclass(cls, Environment):
        raise ParameterError(
            f"{source.name!r}: found {cls!r}; expected 'module:Class' or 'file.py:Class' of a subclass of "
            "pharos.Environment"
        )
    return cls if _is_built_in(cls) else register(cls)


def register(cls: type[Environment]) -> type[Environment]:
    """Make a user's class known to `pharos.make` under `cls.name`, and return it: usable as a decorator.

    Registering a name again replaces the class, so that a notebook cell can be run twice.

    Raises:
        ParameterError: `cls` is no subclass of Environment, has no name, or the name of a built-in class.
    """
    if not (isinstance(cls, type) and issubclass(cls, Environment)):
        raise ParameterError(f"register: found {cls!r}; expected a subclass of pharos.Environment")
    name = getattr(cls, "name", None)
    if not isinstance(name, str) or not name or "/" in name or ":" in name:
        words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()
        raise ParameterError(
            f"register: {cls.__name__}.name is {name!r}; expected a text without '/' and ':', such as name = {words!r} "
            "in the class"
        )
    if name in _OWN:
        raise ParameterError(f"register: {name!r} is the name of a built-in class; choose another name")
    _REGISTERED[name] = cls
    notify(cls)
    return cls


def _is_built_in(cls: type[Environment]) -> bool:
    return getattr(cls, "name", None) in _OWN and cls is class_called(cls.name)
