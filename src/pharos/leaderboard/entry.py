"""Entries: numbers and JSON in a file of safetensors, read without executing anything; made of the folder of a run.

    8 bytes      length N of the header, little-endian
    N bytes      JSON: name of each array -> dtype, shape, data_offsets; "__metadata__": {"pharos": the record, as JSON}
    the rest     the arrays one after another, little-endian, in the order of the header, without gaps

The record says what was trained and what is claimed; its `digest` is that of all it says, and its `arrays` has the
digest of each array. Digests find what was damaged, not who lies: what is claimed has to be computed again (`verify`).

Source of the layout: the format of safetensors, https://github.com/huggingface/safetensors.
"""

import json
import os
import sys
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from pharos.agents import agent_called
from pharos.environments import class_called
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted
from pharos.system import records, storage
from pharos.training import RunConfig, check_agent, read_record, read_rows, run_id

FORMAT = 1
SUFFIX = ".safetensors"
POLICY = "policy"
"""The array of a tabular agent; a network has arrays by the names of its parameters."""
LARGEST_HEADER = 1 << 22
LARGEST_FILE = 1 << 30
LONGEST_TEXT = 2000
DEEPEST = 50
SHOWN = ("name", "author", "note")
INVISIBLE = "\u034f\u115f\u1160\u17b4\u17b5\u180b\u180c\u180d\u180f\u2800\u3164\uffa0"
"""Printable, and nothing to see: joiners, selectors, fillers of Hangul and the empty pattern of Braille."""
LOOKALIKES = "АВЕЅІЈКМНОРСТУХаеорсухѕіјΑΒΕΖΗΙΚΜΝΟΡΤΥΧοερν"
"""Cyrillic and Greek letters that look like Latin ones: refused in names and authors that have Latin letters too."""
MOST_MARKS = 4
_RECORD, _ARRAYS = "pharos", "arrays"
ENTRY = "entry of a leaderboard"
T = TypeVar("T")
_AGAIN = "fetch it again, or ask for it again"


@dataclass(frozen=True)
class Claim:
    """Claimed value and regret of the policy of an entry, in the setting of its configuration.

    Attributes:
        value: expected return of an episode.
        regret: V* - value.
        value_optimal, value_uniform: V*, and the value of acting uniformly at random.
        exact: whether the value was computed, not estimated.
        error_bound: how far the value may be off; of an estimate half the width of a 99 % interval.
    """

    value: float
    regret: float
    value_optimal: float
    value_uniform: float
    exact: bool
    error_bound: float


@dataclass(frozen=True, eq=False)
class Entry:
    """Contents of an entry: configuration, claim, and the arrays that were learnt.

    Attributes:
        name, author, note: as whoever submitted it wrote them.
        config: of the run.
        hyperparameters: all of the agent.
        versions: of what the run depended on.
        rules_version: of the environment's rules.
        claim: of the policy.
        training: what the run says of its learning (cumulative regret, episodes ...), which only training again could
            verify.
        arrays: what was learnt.
    """

    name: str
    config: RunConfig
    hyperparameters: Mapping[str, Any]
    versions: Mapping[str, str]
    rules_version: int
    claim: Claim
    training: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    author: str = ""
    note: str = ""

    @property
    def id(self) -> str:
        """The name of the run: a digest of its configuration."""
        return self.config.id


def write(entry: Entry, file: str | os.PathLike) -> None:
    """Write an entry to a file, replacing it atomically; the same entry gives the same bytes."""
    body = {name: value for name, value in vars(entry).items() if name != _ARRAYS}
    record = {**body, "format": FORMAT, "id": entry.id, "config": entry.config.to_dict(), "claim": asdict(entry.claim)}
    write_sealed(file, record, entry.arrays, follow=True)


def write_sealed(
    file: str | os.PathLike,
    record: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    what: str = ENTRY,
    *,
    follow: bool = False,
) -> None:
    """Write a record and arrays, with their digests, to a file, replacing it atomically; same input, same bytes.

    Args:
        follow: whether the user named the file, see `storage.replacing`.
    """
    checked = {name: _checked(name, array) for name, array in arrays.items()}
    digests = {name: _digest(array) for name, array in checked.items()}
    text = json.dumps(storage.sealed({**record, _ARRAYS: digests}), sort_keys=True, allow_nan=False)
    data = save(checked, {_RECORD: text})
    if len(data) > LARGEST_FILE:
        raise ParameterError(f"{file}: the {what} would have {len(data):,} bytes; expected at most {LARGEST_FILE:,}")
    storage.replace_file(file, data, follow=follow)


def read(file: str | os.PathLike) -> Entry:
    """Read an entry; nothing is allocated before the sizes in the file were held against the size of the file.

    Raises:
        ParameterError: there is no such file. FileFormatError: it is no entry, or of another format.
        ResultCorrupted: it was cut short, or changed after it was written.
    """
    path = Path(file)
    record, arrays = read_sealed(path)
    return in_file(path, lambda: _entry(record, arrays))


def in_file(path: Path, make: Callable[[], T]) -> T:
    """Call `make` on the record of a file; its errors become FileFormatError, one line that names the file."""
    try:
        return make()
    except (FileFormatError, ParameterError) as error:
        raise FileFormatError(f"{path}: {str(error)[:LONGEST_TEXT]}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileFormatError(f"{path}: its record is damaged: {_reason(error)}; {_AGAIN}") from None


def read_sealed(path: Path, what: str = ENTRY) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The record and the arrays that `write_sealed` wrote, whose digests are right; raises as `read`."""
    if not path.is_file():
        raise ParameterError(f"{path}: no such file")
    try:
        _check_sizes(path)
        with safe_open(path, "numpy") as stored:
            record = json.loads(stored.metadata()[_RECORD])
            arrays = {name: _checked(name, stored.get_tensor(name)) for name in stored.keys()}  # noqa: SIM118
        if not isinstance(record, dict):
            raise TypeError("its record is no object")
        is_intact = storage.DIGEST in record and storage.is_intact(record)
    except SafetensorError as error:
        raise ResultCorrupted(
            f"{path}: is no {what}, or was cut short or changed: {_reason(error)}; {_AGAIN}"
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, ParameterError) as error:
        raise FileFormatError(f"{path}: is no {what}: {_reason(error)}; {_AGAIN}") from None
    if not is_intact:
        raise ResultCorrupted(f"{path}: what it says was changed after it was written; {_AGAIN}")
    if record.get("format") != FORMAT:
        raise FileFormatError(f"{path}: is in format {record.get('format')!r}; this version of pharos reads {FORMAT}")
    if record.get(_ARRAYS) != {name: _digest(array) for name, array in arrays.items()}:
        raise ResultCorrupted(f"{path}: its arrays were changed after it was written; {_AGAIN}")
    return record, arrays


def _check_sizes(path: Path) -> None:
    """ValueError where the file or its header is too large to be read."""
    total = path.stat().st_size
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
    if not 8 < total <= LARGEST_FILE:
        raise ValueError(f"it has {total:,} bytes; expected at most {LARGEST_FILE:,}")
    if length > min(LARGEST_HEADER, total - 8):
        raise ValueError(f"its header would have {length:,} bytes, of {total:,} in the file")


def _entry(record: Mapping[str, Any], arrays: dict[str, np.ndarray]) -> Entry:
    check_values(record)
    fields = {name: value for name, value in record.items() if name not in ("format", "id", storage.DIGEST)}
    entry = records.read(Entry, {**fields, _ARRAYS: arrays}, "its record")
    if record["id"] != run_id(record["config"]):
        raise ValueError("its configuration is not that of its run")
    if entry.claim.error_bound < 0:
        raise ValueError(f"its error_bound is {entry.claim.error_bound}; expected at least 0")
    return entry


def check_values(value: object, name: str = "record", depth: int = 0) -> None:
    """Refuse texts with unprintable or invisible characters, and numbers that are not finite."""
    if depth > DEEPEST:
        raise ValueError(f"its {name} is nested deeper than {DEEPEST} times")
    if isinstance(value, Mapping):
        for key, item in value.items():
            check_values(key, name)
            check_values(item, key, depth + 1)
    elif isinstance(value, list):
        for item in value:
            check_values(item, name, depth + 1)
    elif isinstance(value, str):
        if not all(character.isprintable() or character == "\n" for character in value):
            raise ValueError(f"a text of its {name} has characters that cannot be printed")
        if name in SHOWN:
            _check_shown(value, name)
    elif isinstance(value, int | float) and not abs(value) <= sys.float_info.max:
        raise ValueError(f"its {name} is {str(value)[:20]}; expected a finite number")


def _check_shown(text: str, name: str) -> None:
    """Refuse text that a page would show as nothing, or as a heap of accents."""
    if len(text) > LONGEST_TEXT:
        raise ValueError(f"its {name} has {len(text):,} characters; expected at most {LONGEST_TEXT:,}")
    kinds = [unicodedata.category(character)[0] for character in unicodedata.normalize("NFC", text)]
    if any(character in INVISIBLE for character in text) or (kinds and not set(kinds) & set("LNPS")):
        raise ValueError(f"its {name} has characters that are printed as nothing")
    if "M" * (MOST_MARKS + 1) in "".join(kinds):
        raise ValueError(f"its {name} has more than {MOST_MARKS} accents on one character")
    foreign = sorted(set(text) & set(LOOKALIKES)) if name != "note" else []
    if foreign and any(unicodedata.name(character, "").startswith("LATIN") for character in text):
        raise ValueError(
            f"its {name} mixes Latin letters with ones that look like them: {unicodedata.name(foreign[0])}"
        )


def _checked(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
        raise ParameterError(f"the array {name!r} holds {array.dtype}; expected integers or floats of at most 64 bits")
    return np.asarray(array, array.dtype.newbyteorder("<"), order="C")


def _digest(array: np.ndarray) -> str:
    data = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    return storage.digest_of_json([array.dtype.str, list(array.shape), storage.digest_of_bytes(data.data)])


def _reason(error: BaseException) -> str:
    if isinstance(error, KeyError):
        return f"it lacks {error}"
    return (" ".join(str(error).split()) or type(error).__name__)[:200]


# Submission -----------------------------------------------------------------------------------------------------------


TRAINING = (
    "episodes",
    "cumulative_regret",
    "normalized_regret",
    "cumulative_realised_regret",
    "normalized_realised_regret",
    "mean_return",
)
"""Of the result of a run, what only training again could verify."""


def submit(
    run: str | os.PathLike,
    file: str | os.PathLike | None = None,
    *,
    name: str = "",
    author: str = "",
    note: str = "",
) -> Path:
    """Pack what a finished run has learnt and what it claims into one file, which `verify` reads; return the file.

    Nothing is trained, evaluated or executed: the value and the regret are those of the run's last evaluation. The same
    run and texts give the same bytes.

    Args:
        run: folder of a finished run.
        file: ends in .safetensors; None: ID.safetensors in the current directory, ID that of the run.
        name: of the entry; that of the agent when not given.
        author, note: texts to show beside it.
    Raises:
        FileFormatError: the folder holds no finished run. ResultCorrupted: its files were cut short or changed.
        ParameterError: the environment is an imported MDP, which others do not have; or a text cannot be printed.
        MissingExtra: the run is of a network, and PyTorch is not installed.
    """
    run = Path(run)
    record = read_record(run)
    if record.get("status") != "finished":
        raise FileFormatError(f"{run}: the run is {record.get('status')}; the same command that began it finishes it")
    check_agent(run)
    config = RunConfig.from_dict(record["config"])
    if config.environment == "imported":
        raise ParameterError(
            f"{run}: was trained on an imported MDP, which others do not have; "
            f"expected an environment of pharos, or of a class that others can import"
        )
    result, last = record["result"], read_rows(run)[-1]
    claim = Claim(
        last["value"],
        last["expected_regret"],
        result["value_optimal"],
        result["value_uniform"],
        bool(last["exact"]),
        last["error_bound"],
    )
    entry = Entry(
        name=name or config.agent,
        author=author,
        note=note,
        config=config,
        hyperparameters=record["hyperparameters"],
        versions=record.get("versions", {}),
        rules_version=_rules_version(run, record, config),
        claim=claim,
        training={key: result.get(key) for key in TRAINING} | {"seconds": record.get("seconds")},
        arrays={POLICY: stored_table(run)} if agent_called(config.agent).has_table else _network(run),
    )
    target = check_ending(Path(f"{config.id}{SUFFIX}" if file is None else file))
    write_checked(target, lambda: write(entry, target), lambda: read(target))
    return target


def check_ending(target: Path) -> Path:
    """Return the file if its name ends in SUFFIX; else ParameterError."""
    if target.suffix.lower() != SUFFIX:
        raise ParameterError(f"{target}: expected a file name that ends in {SUFFIX}")
    return target


def write_checked(target: Path, write: Callable[[], None], read: Callable[[], T]) -> T:
    """Write a file, read it back and return the result; if `read` refuses it, delete it and raise ParameterError."""
    target.parent.mkdir(parents=True, exist_ok=True)
    write()
    try:
        return read()
    except FileFormatError as error:
        target.unlink()
        raise ParameterError(str(error)) from None


def _rules_version(run: Path, record: dict[str, Any], config: RunConfig) -> int:
    """Version of the rules that the run recorded; for older runs, without one, the version of the class here."""
    stored = record.get("rules_version")
    if isinstance(stored, int) and not isinstance(stored, bool):
        return stored
    rules = class_called(config.environment)
    if rules is None:
        raise ParameterError(
            f"{run}: does not say the version of the rules of {config.environment!r}, which is not loaded here; "
            "train it again into another folder"
        )
    return rules.version


def stored_table(run: Path) -> np.ndarray:
    """The policy of a run that kept a table; actions in the smallest integer type that holds them.

    Raises:
        ResultCorrupted: policy.npy cannot be read.
    """
    try:
        storage.check_regular(run / "policy.npy")
        table = np.load(run / "policy.npy", allow_pickle=False)
    except Exception as error:  # the header is read as Python
        raise ResultCorrupted(f"{run / 'policy.npy'}: cannot be read: {error}") from None
    whole = table.astype(np.int64)
    return whole.astype(np.min_scalar_type(int(whole.max(initial=0)))) if (whole == table).all() else table


def _network(run: Path) -> dict[str, np.ndarray]:
    """The parameters of the policy by name, without optimiser state."""
    from pharos.errors import MissingExtra

    try:
        import torch
    except ImportError as error:
        raise MissingExtra("reading what a network has learnt", "torch", "agents") from error
    file = run / "agent" / "parameters.pt"
    try:
        stored: dict[str, Any] = torch.load(file, weights_only=True, map_location="cpu")["policy"]  # noqa: TID251
        return {name: tensor.numpy() for name, tensor in sorted(stored.items())}
    except Exception as error:  # torch has many
        raise ResultCorrupted(f"{file}: cannot be read: {' '.join(str(error).split())[:200]}") from None
