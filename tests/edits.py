"""Files that somebody has edited, or that a disk has damaged."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def edited_json(file: Path) -> Iterator[Any]:
    """What a file of JSON holds, which is written back as it was changed."""
    content = json.loads(file.read_text())
    yield content
    file.write_text(json.dumps(content))


def flip(file: Path, place: int, mask: int = 1) -> None:
    """Turn the bits of a mask in one byte of a file."""
    data = bytearray(file.read_bytes())
    data[place] ^= mask
    file.write_bytes(data)
