"""Sealed files: numbers and JSON in a file of safetensors, read without executing anything.

    8 bytes      length N of the header, little-endian
    N bytes      JSON: name of each array -> dtype, shape, data_offsets; "__metadata__": {"pharos": the record, as JSON}
    the rest     the arrays one after another, little-endian, in the order of the header, without gaps

The record's `digest` covers all other entries, and its `arrays` has the digest of each array. Digests find damage, not
lies: what a record claims has to be computed again.

Source of the layout: the format of safetensors, https://github.com/huggingface/safetensors.
"""

import json
import os
import sys
import unicodedata
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from pharos.errors import FileFormatError, ParameterError, ResultCorrupted
from pharos.system import storage

SEALED_FORMAT = 1
SUFFIX = ".safetensors"
LARGEST_HEADER = 1 << 22
LARGEST_SEALED_FILE = 1 << 30
LONGEST_TEXT = 2000
DEEPEST_JSON = 50
SHOWN_TEXTS = ("name", "author", "note")
INVISIBLE = "\u034f\u115f\u1160\u17b4\u17b5\u180b\u180c\u180d\u180f\u2800\u3164\uffa0"
"""Printable, and nothing to see: joiners, selectors, fillers of Hangul and the empty pattern of Braille."""
LOOKALIKES = "АВЕЅІЈКМНОРСТУХаеорсухѕіјΑΒΕΖΗΙΚΜΝΟΡΤΥΧοερν"
"""Cyrillic and Greek letters that look like Latin ones: refused in names and authors that have Latin letters too."""
MOST_MARKS = 4
_RECORD, _ARRAYS = "pharos", "arrays"
T = TypeVar("T")
_ASK_AGAIN = "fetch it again, or ask for it again"


def write_sealed(
    file: str | os.PathLike,
    record: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    what: str,
    *,
    follow: bool = False,
) -> None:
    """Write a record and arrays, with their digests, to a file, replacing it atomically. The same input gives the same
    bytes.

    Args:
        what: noun of the content, for errors.
        follow: whether the user named the file, see `storage.replacing`.
    """
    checked = {name: _checked(name, array) for name, array in arrays.items()}
    digests = {name: _digest(array) for name, array in checked.items()}
    text = json.dumps(
        storage.sealed({**record, "format": SEALED_FORMAT, _ARRAYS: digests}), sort_keys=True, allow_nan=False
    )
    data = save(checked, {_RECORD: text})
    if len(data) > LARGEST_SEALED_FILE:
        raise ParameterError(
            f"{file}: the {what} would have {len(data):,} bytes; expected at most {LARGEST_SEALED_FILE:,}"
        )
    storage.replace_file(file, data, follow=follow)


def read_sealed(file: str | os.PathLike, what: str, make: Callable[[dict[str, Any], dict[str, np.ndarray]], T]) -> T:
    """Object that `make` returns of the record and the arrays that `write_sealed` wrote.

    Nothing is executed, and nothing is allocated before sizes in the file were compared with the size of the file.

    Args:
        what: noun of the content, for errors.
    Raises:
        ParameterError: there is no such file. FileFormatError: it is of another kind or format, or `make` refuses it.
        ResultCorrupted: it was cut short, or changed after it was written.
    """
    path = Path(file)
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
            f"{path}: is no {what}, or was cut short or changed: {_reason(error)}; {_ASK_AGAIN}"
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, ParameterError) as error:
        raise FileFormatError(f"{path}: is no {what}: {_reason(error)}; {_ASK_AGAIN}") from None
    if not is_intact:
        raise ResultCorrupted(f"{path}: what it says was changed after it was written; {_ASK_AGAIN}")
    if record.get("format") != SEALED_FORMAT:
        raise FileFormatError(
            f"{path}: is in format {record.get('format')!r}; this version of pharos reads {SEALED_FORMAT}"
        )
    if record.get(_ARRAYS) != {name: _digest(array) for name, array in arrays.items()}:
        raise ResultCorrupted(f"{path}: its arrays were changed after it was written; {_ASK_AGAIN}")
    try:
        return make(record, arrays)
    except (FileFormatError, ParameterError) as error:
        raise FileFormatError(f"{path}: {str(error)[:LONGEST_TEXT]}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileFormatError(f"{path}: its record is damaged: {_reason(error)}; {_ASK_AGAIN}") from None


def _check_sizes(path: Path) -> None:
    """ValueError if the file or its header is too large to be read."""
    total = path.stat().st_size
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
    if not 8 < total <= LARGEST_SEALED_FILE:
        raise ValueError(f"it has {total:,} bytes; expected at most {LARGEST_SEALED_FILE:,}")
    if length > min(LARGEST_HEADER, total - 8):
        raise ValueError(f"its header would have {length:,} bytes, of {total:,} in the file")


def check_values(value: object, name: str = "record", depth: int = 0) -> None:
    """Refuse texts with unprintable or invisible characters, and numbers that are not finite."""
    if depth > DEEPEST_JSON:
        raise ValueError(f"its {name} is nested deeper than {DEEPEST_JSON} times")
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
        if name in SHOWN_TEXTS:
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
