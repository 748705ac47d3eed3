"""Damage to files, and what becomes of whoever reads them: a refusal in one line, a warning, or the same answer.

An attack is a folder made once, the files in it, and a function that reads a copy of the folder. Every kind of damage
is done to every file of every copy; whatever else happens (another answer, another exception, a traceback, no end,
code that is executed) is a failure, and says how to repeat it.
"""

import contextlib
import io
import itertools
import json
import os
import pickle
import resource
import shutil
import signal
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from command_line import run
from patience import PATIENCE
from pharos.errors import PharosError

SECONDS = 30  # of the processor
MORE_MEMORY = 6 << 30  # address space that a case may take beyond what the process has

NUMBERS = (-1, 2**31, 2**63, 10**400, 1e300, -0.5, float("nan"), float("inf"), True)
OTHERS = (None, "", "x", [], {}, [[0, 1]], {"a": {}}, "\ud800", "0" * 5000)


class Endless(BaseException):
    """A case took too long; nothing catches it on the way."""


class Refused(Exception):
    """A command ended with an exit code and one line."""


class Payload:
    """What leaves a file behind where somebody unpickles it."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (str(self.mark),))


# Damage --------------------------------------------------------------------------------------------------------------


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """One to eight bits changed."""
    changed = bytearray(data)
    for bit in rng.integers(8 * len(data), size=rng.choice([1, 2, 8])):
        changed[bit // 8] ^= 1 << int(bit % 8)
    return bytes(changed)


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut short, or by its last byte."""
    return data[: rng.choice([len(data) - 1, rng.integers(len(data))])]


def emptied(data: bytes, rng: np.random.Generator) -> bytes:
    """Of no bytes."""
    return b""


def doubled(data: bytes, rng: np.random.Generator) -> bytes:
    """Twice after itself."""
    return data + data


def digit_changed(data: bytes, rng: np.random.Generator) -> bytes:
    """One digit of a text is another one."""
    place = rng.choice([k for k, byte in enumerate(data) if 48 <= byte < 58])
    return data[:place] + bytes([48 + (data[place] - 48 + rng.integers(1, 10)) % 10]) + data[place + 1 :]


def entry_changed(data: bytes, rng: np.random.Generator) -> bytes:
    """Any entry of a JSON or YAML is something else: a huge number, NaN, another type."""
    is_json = data.startswith(b"{")
    root = [json.loads(data) if is_json else yaml.safe_load(data)]
    owner, key = root, 0
    while isinstance(owner[key], dict | list) and owner[key] and rng.random() < 0.8:
        owner = owner[key]
        key = rng.choice(sorted(owner)) if isinstance(owner, dict) else int(rng.integers(len(owner)))
    values = [*NUMBERS, *OTHERS]
    owner[key] = values[rng.integers(len(values))]
    return json.dumps(root[0]).encode() if is_json else yaml.safe_dump(root[0]).encode()


def entry_removed(data: bytes, rng: np.random.Generator) -> bytes:
    """A JSON lacks a name, or an entry of a list is missing."""
    root = json.loads(data)
    owner = root
    while True:
        inner = [
            each for each in (owner.values() if isinstance(owner, dict) else owner) if isinstance(each, dict | list)
        ]
        inner = [each for each in inner if each]
        if not inner or rng.random() < 0.4:
            break
        owner = inner[rng.integers(len(inner))]
    del owner[rng.choice(sorted(owner)) if isinstance(owner, dict) else int(rng.integers(len(owner)))]
    return json.dumps(root).encode()


def nested(data: bytes, rng: np.random.Generator) -> bytes:
    """Brackets within brackets, 100,000 of them."""
    return b"[" * 100_000 + b"]" * 100_000


BYTES = (flipped, cut, emptied, doubled)
TEXT = (*BYTES, digit_changed, nested)
JSON = (*TEXT, entry_changed, entry_removed)
REPEATED = {flipped: 4, cut: 2, digit_changed: 4, entry_changed: 6, entry_removed: 2}
"""How often a damage is done to a file, each time elsewhere; the others once."""


def missing(path: Path) -> None:
    """No file."""


def pipe(path: Path) -> None:
    """A pipe that nobody writes to."""
    os.mkfifo(path)


def endless(path: Path) -> None:
    """A link to zeros without end."""
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    """A folder."""
    path.mkdir()


def loop(path: Path) -> None:
    """A link to itself."""
    path.symlink_to(path.name)


def pickled(path: Path) -> None:
    """Objects that execute code where they are unpickled."""
    path.write_bytes(pickle.dumps(Payload(path.with_name("executed"))))


PLACES = (missing, pipe, endless, folder, loop, pickled)


def damages(name: str) -> tuple[Callable[..., Any], ...]:
    """Those that a file of this name gets, beside those of its place."""
    suffix = Path(name).suffix
    return {".json": JSON, ".yaml": (*TEXT, entry_changed), ".log": TEXT}.get(suffix, BYTES)


# Cases ---------------------------------------------------------------------------------------------------------------


@dataclass
class Tally:
    """How many damaged copies were read, and what became of them."""

    counts: Counter = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        """All of them."""
        return sum(self.counts.values())

    def note(self, name: str, what: str, text: str) -> None:
        """Another one; see `outcome`."""
        self.counts[what] += 1
        if what == "failed":
            self.failures.append(f"{name}: {text}")

    def check(self) -> None:
        """Raise where one was neither refused nor answered right."""
        assert not self.failures, "\n".join([f"{len(self.failures)} of {self.total} failed:", *self.failures])

    def __str__(self) -> str:
        counts = self.counts
        return f"{counts['refused']} refused, {counts['warned']} warned, {counts['unchanged']} unchanged"


@dataclass(frozen=True)
class Attack:
    """A folder made once, and what reads it.

    Attributes:
        source: the folder. names: of the files to damage.
        read: of a copy -> what is to be the same, compared by its `repr`.
        answers: what it may be as well.
        others: folders of the same form, from which files are brought.
        fewer: a divisor of how often a damage is repeated, for what takes long to read.
    """

    source: Path
    names: tuple[str, ...]
    read: Callable[[Path], Any]
    answers: tuple[Any, ...] = ()
    others: tuple[Path, ...] = ()
    fewer: int = 1

    def cases(self) -> Iterator[tuple[str, str, Callable[[Path], None]]]:
        """(file, name of the damage, what does it to a copy of the folder)."""
        for name in self.names:
            data = (self.source / name).read_bytes()
            for damage in damages(name):
                for k in range(-(-REPEATED.get(damage, 1) // self.fewer)):
                    if not data and damage in (flipped, cut, digit_changed):
                        continue
                    rng = np.random.default_rng([zlib.crc32(f"{name} {damage.__name__}".encode()), k])
                    changed = damage(data, rng)
                    if changed != data:
                        yield name, f"{damage.__name__} {k}", lambda copy, n=name, c=changed: put(copy / n, c)
            for place in PLACES:
                yield name, place.__name__, lambda copy, n=name, p=place: (remove(copy / n), p(copy / n))
            for k, other in enumerate(self.others):
                if (other / name).exists() and (other / name).read_bytes() != data:
                    brought = (other / name).read_bytes()
                    yield name, f"of another folder {k}", lambda copy, n=name, b=brought: put(copy / n, b)
        for one, two in itertools.combinations(self.names, 2):
            if Path(one).suffix == Path(two).suffix:
                yield one, f"swapped with {two}", lambda copy, a=one, b=two: swap(copy / a, copy / b)

    def run(self, place: Path) -> Tally:
        """Read every damaged copy; raise where one is neither refused nor answered right."""
        tally, numbers = Tally(), itertools.count()

        def copied() -> Path:
            return Path(shutil.copytree(self.source, place / f"copy{next(numbers)}", symlinks=True))

        expected = {*map(repr, self.answers), repr(self.read(copied()))}
        for name, damage, apply in self.cases():
            copy = copied()
            apply(copy)
            what, text = outcome(lambda copy=copy: self.read(copy), expected)
            if (place / "executed").exists() or any(copy.rglob("executed")):
                what, text = "failed", "code was executed"
            tally.note(f"{name}, {damage}", what, text)
            shutil.rmtree(copy)
        tally.check()
        return tally


def outcome(read: Callable[[], Any], expected: Collection[str]) -> tuple[str, str]:
    """("refused", its line), ("warned", the warnings), ("unchanged", "") or ("failed", why)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            with limited():
                answer = repr(read())
        except (PharosError, Refused) as error:
            text = str(error)
            lines = [text, *(str(each.message) for each in caught)]
            is_line = text.strip() and all("\n" not in line and len(line) < 3000 for line in lines)
            return ("refused" if is_line else "failed"), text
        except Endless:
            return "failed", f"takes more than {SECONDS} s of the processor, or never ends"
        except IsADirectoryError as error:  # of a file that was to be written, which commands say in a line
            return ("refused" if error.filename else "failed"), str(error)
        except Exception as error:
            return "failed", f"{type(error).__name__}: {error}"[:1000]
    if answer not in expected:
        return "failed", f"another answer: {answer[:200]}; expected {min(expected)[:200]}"
    said = [str(each.message) for each in caught]
    return ("warned" if said else "unchanged"), "; ".join(said)


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """A limit of processor time, which other work on the machine does not use up, of patience, and of memory."""

    def stop(*_: Any) -> None:
        raise Endless

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else None
    before = {each: signal.signal(each, stop) for each in (signal.SIGPROF, signal.SIGALRM)}
    if pages is not None:
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MORE_MEMORY, hard))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        for each, handler in before.items():
            signal.signal(each, handler)


def command(*words: Any) -> dict[str, Any]:
    """What a command of pharos answers with --json; Refused where it fails as commands may."""
    with contextlib.redirect_stderr(io.StringIO()):
        done = run(*words, "--json")
    if done.exit_code == 0:
        return json.loads(done.stdout)
    if not isinstance(done.exception, SystemExit):
        raise done.exception or AssertionError("no exception")
    lines = [line for line in done.stderr.splitlines() if not line.startswith("warning: ")]
    assert done.exit_code in (1, 2) and len(lines) == 1, (done.exit_code, done.stderr[-500:])
    raise Refused(lines[0])


def put(path: Path, data: bytes) -> None:
    """Other bytes in the place of a file."""
    remove(path)
    path.write_bytes(data)


def remove(path: Path) -> None:
    """Nothing in the place of a file."""
    path.unlink()


def swap(one: Path, two: Path) -> None:
    """Two files, each under the name of the other."""
    first, second = one.read_bytes(), two.read_bytes()
    one.write_bytes(second)
    two.write_bytes(first)
