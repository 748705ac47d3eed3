"""Code of the user's own: a class or a function that is named as `module:Name` or `file.py:Name`.

A name in a command or a script of the user is trusted: `load_source(find_source(name))` imports it. A name in a file
that somebody else may have written (a run.json, a study's folder, a packed study) is not: `resolve` returns what this
process has already imported under that name, and imports nothing by itself unless it is told to trust the file.
"""

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeGuard

from pharos.errors import FileFormatError, ParameterError, UntrustedCode
from pharos.system.records import parse_record

# Modules loaded from files, by their path: (digest of the file, module).
_MODULES: dict[str, tuple[str, ModuleType]] = {}
# What this process has imported, by its name: where from, and the object.
_LOADED: dict[str, tuple["Source", Any]] = {}


@dataclass(frozen=True)
class Source:
    """Origin of a class or function of the user's own: its name, its file, and the checksum of that.

    Attributes:
        name: "module:Name" or "file.py:Name", without a folder: the same on every machine.
        file: the file, or the file of the module: an absolute path.
        checksum: digest of the file.
    """

    name: str
    file: str
    checksum: str

    @staticmethod
    def from_dict(entry: Mapping[str, Any]) -> "Source":
        """Read the entries that `to_dict` returns.

        Raises:
            FileFormatError: it is damaged.
        """
        source = parse_record(Source, entry, "the source of a class")
        if ":" not in source.name:
            raise FileFormatError(f"the source of a class: name is {source.name!r}; expected module:Name")
        return source

    def to_dict(self) -> dict[str, str]:
        """The attributes, JSON-able."""
        return asdict(self)

    @property
    def attribute(self) -> str:
        """The name of the class or function in its file."""
        return self.name.rpartition(":")[2]

    @property
    def module(self) -> str | None:
        """The name of the module, or None for a file."""
        where = self.name.rpartition(":")[0]
        return None if where.endswith(".py") else where

    def __str__(self) -> str:
        return f"{self.name} ({self.file})"


def is_reference(name: object) -> TypeGuard[str]:
    """Whether a name means the user's own code, `module:Name` or `file.py:Name`."""
    return isinstance(name, str) and ":" in name


def find_source(name: str, folder: str | Path | None = None) -> Source:
    """The source of `module:Name` or `file.py:Name`. Nothing but the parents of the module is imported.

    Args:
        folder: relative files and modules are looked for there first. Default: the current directory.
    Raises:
        ParameterError: there is no such file or module.
    """
    where, _, attribute = name.rpartition(":")
    base = Path.cwd() if folder is None else Path(folder).absolute()
    if where.endswith(".py"):
        path = base / Path(where).expanduser()
        if not path.is_file():
            raise ParameterError(f"{name!r}: there is no file {path}; {_EXPECTED_REFERENCE}")
        return Source(f"{path.name}:{attribute}", str(path.resolve()), _checksum(path))
    inside = base.joinpath(*where.split("."))
    for candidate in (inside.with_suffix(".py"), inside / "__init__.py"):
        if where and candidate.is_file():
            return Source(name, str(candidate.resolve()), _checksum(candidate))
    try:
        spec = importlib.util.find_spec(where)
    except Exception as error:  # of the module's parents
        raise ParameterError(f"{name!r}: {_in_a_line(error)}; {_EXPECTED_REFERENCE}") from error
    if spec is None:
        raise ParameterError(f"{name!r}: No module named {where!r}; {_EXPECTED_REFERENCE}")
    origin = spec.origin if spec.has_location and spec.origin else ""
    return Source(name, origin, _checksum(origin))


def load_source(source: Source) -> Any:
    """Import what a source names. None if it has no such name. A file is executed again only if it has changed.

    Raises:
        ParameterError: it cannot be imported.
    """
    if announced(source.name) is not None:
        return _LOADED[source.name][1]
    try:
        module = _module_of_file(source) if source.module is None else _module_called(source)
        target = getattr(module, source.attribute, None) if source.attribute else None
    except (Exception, SystemExit) as error:  # a script may end while it is loaded
        raise ParameterError(f"{source.name!r}: {_in_a_line(error)}; {_EXPECTED_REFERENCE}") from error
    _LOADED[source.name] = (source, target)
    return target


def untrusted_code(what: str, alternative: str = "") -> UntrustedCode:
    """The error for code that something received names.

    Args:
        what: what names it, and its name. alternative: what else to try.
    """
    return UntrustedCode(
        f"{what} is code, which is executed only if you trust it: add --trust (in Python: trust=True){alternative}"
    )


def resolve(source: Source, *, trust: bool = False, strict: bool = False) -> Any:
    """The class or function that the source in a stored configuration names.

    Args:
        trust: whether it may be imported. Else what this process has imported already under that name is returned.
        strict: whether a file that has changed is an error instead of a warning.
    Raises:
        UntrustedCode: nothing of that name was imported, and it is not trusted.
        ParameterError: the file is gone, or has changed and must not.
    """
    loaded = _LOADED.get(source.name)
    if loaded is not None and (not trust or loaded[0].checksum == source.checksum):
        if loaded[0].checksum != source.checksum:
            _tell_change(source, loaded[0], strict)
        return loaded[1]
    if not trust:
        raise untrusted_code(str(source), ", or name it yourself")
    now = source
    if not Path(source.file).is_file():
        if source.module is None:
            raise ParameterError(f"{source.name!r}: there is no file {source.file}; {_EXPECTED_REFERENCE}")
        now = find_source(source.name, folder=Path(sys.prefix))  # installed here, elsewhere than there
    now = Source(source.name, now.file, _checksum(now.file))
    if now.checksum != source.checksum:
        _tell_change(source, now, strict)
    return load_source(now)


def source_of(value: object, attribute: str | None = None) -> Source | None:
    """The source by which others can import a class or function. None if they cannot, as in a notebook.

    Args:
        attribute: the name in its module. Default: its own.
    """
    name = getattr(value, "__module__", None)
    attribute = attribute or str(getattr(value, "__qualname__", "<none>"))
    for file, (checksum, module) in _MODULES.items():
        if module.__name__ == name:
            return Source(f"{Path(file).name}:{attribute}", file, checksum)
    path = getattr(sys.modules.get(name or ""), "__file__", None)
    if name in (None, "__main__") or path is None or "<" in attribute or "." in attribute:
        return None
    return Source(f"{name}:{attribute}", str(Path(path).resolve()), _checksum(path))


def register_source(value: object) -> Source:
    """The source of a class or function that this process has, which `resolve` then finds here.

    One of a notebook, of the script itself, or within a function has a name and no file: other processes lack it.
    """
    name = f"{getattr(value, '__module__', '')}:{getattr(value, '__qualname__', type(value).__name__)}"
    source = source_of(value) or Source(name, "", "")
    _LOADED[source.name] = source, value
    return source


def announced(name: str) -> Source | None:
    """The source of an object without a file that was announced under this name."""
    source, _ = _LOADED.get(name, (None, None))
    return source if source is not None and not source.file else None


_EXPECTED_REFERENCE = "expected 'module:Name' or 'file.py:Name'"


def _tell_change(source: Source, now: Source, strict: bool) -> None:
    text = (
        f"{now.file} has changed since {source.name} was written down "
        f"(checksum then {source.checksum}, now {now.checksum or 'none'})"
    )
    if strict:
        raise ParameterError(f"{text}; start again, or bring back the file of then")
    warnings.warn(text, stacklevel=4)


def _module_of_file(source: Source) -> ModuleType:
    stored = _MODULES.get(source.file)
    if stored is not None and stored[0] == source.checksum:
        return stored[1]
    file = Path(source.file)
    name = f"pharos_user_{file.stem}"
    if any(other != source.file and module.__name__ == name for other, (_, module) in _MODULES.items()):
        name = f"{name}_{len(_MODULES)}"  # of the same name in another folder
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ImportError(f"cannot read {file}")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up there
    before = list(sys.path)
    sys.path.append(str(file.parent))  # files beside it, after all else
    try:
        spec.loader.exec_module(module)
    finally:
        if sys.path[-1] == str(file.parent) and sys.path[:-1] == before:
            sys.path.pop()
    _MODULES[source.file] = (source.checksum, module)
    return module


def _module_called(source: Source) -> ModuleType:
    """The module. Its folder is searched first while it is imported."""
    name = source.module or ""
    module = sys.modules.get(name)
    if module is not None:
        file = getattr(module, "__file__", None)
        if file and source.file and Path(file).resolve() != Path(source.file):
            raise ImportError(
                f"the module {name} of {file} is loaded already; name the file: {source.file}:{source.attribute}"
            )
        return module
    root = Path(source.file).parent
    for _ in range(name.count(".") + (Path(source.file).name == "__init__.py")):
        root = root.parent
    entry = str(root)
    if not source.file:
        return importlib.import_module(name)
    sys.path.insert(0, entry)
    try:
        importlib.invalidate_caches()
        return importlib.import_module(name)
    finally:
        sys.path.remove(entry)


def _checksum(file: str | Path) -> str:
    """The digest of a file, or empty if there is none."""
    from pharos.system.storage import digest_of_file  # which built-in classes do without

    return digest_of_file(file) if file and Path(file).is_file() else ""


def _in_a_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
