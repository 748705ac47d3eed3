"""The journal of a search: Optuna's record, a JSON object a line, whose last line a full disk may have cut."""

import contextlib
import json
import time
from pathlib import Path

from pharos.errors import FileFormatError, FolderLocked
from pharos.system.storage import check_regular, lock

WAIT_SECONDS = 0.005


class JournalLock:
    """A lock for Optuna's journal, in the place of its own: a process that is killed holds nothing.

    Optuna's is a file that stays when its process is killed; the next one waits 30 seconds for it.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.held = contextlib.ExitStack()

    def acquire(self) -> bool:
        """Wait until no other process holds the folder, and hold it."""
        while True:
            try:
                self.held.enter_context(lock(self.folder, FolderLocked, "tuning"))
                return True
            except FolderLocked:
                time.sleep(WAIT_SECONDS)

    def release(self) -> None:
        """Let the folder go."""
        self.held.close()


def mend_journal(path: Path) -> None:
    """Cut off a last line that is not whole; what it said is done again.

    Raises:
        FileFormatError: another line is no JSON.
    """
    try:
        check_regular(path)
        data = path.read_bytes()
    except FileNotFoundError:
        return
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror}; delete the folder and search again") from None
    lines = data.splitlines(keepends=True)
    for number, line in enumerate(lines, start=1):
        if _is_whole(line):
            continue
        if number < len(lines):
            raise FileFormatError(f"{path}:{number}: is no JSON; delete the folder and search again")
        with open(path, "r+b") as file:
            file.truncate(len(data) - len(line))


def _is_whole(line: bytes) -> bool:
    try:
        return line.endswith(b"\n") and isinstance(json.loads(line), dict)
    except (ValueError, RecursionError):
        return False
