"""Commitment: a digest of what will be submitted, published before the tasks are drawn.

A commitment names SHA-256 digests of an agent's source and of its hyperparameters. Whoever publishes it before a round
of the beacon cannot have chosen them by the tasks of that round. It needs no salt: a salt hides what could be guessed,
and here nothing has to stay hidden, since source and hyperparameters are published after the round; what binds is that
nobody finds another source with the same digest. Its date is only said by its author: what counts is where it was
published, and when.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pharos.benchmark.agents import agent_form
from pharos.benchmark.suite import Suite, sha256_of_json
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted
from pharos.system import records, storage

FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class Commitment:
    """An agent and its hyperparameters, to which an author commits before the tasks are drawn.

    Attributes:
        agent: its label, such as "my_file.py:learn" or "dqn".
        source: SHA-256 of the file or module that the agent names; empty for agents of pharos.
        hyperparameters: SHA-256 of all of them, as JSON with sorted keys.
        suite: SHA-256 of the public suite.
        date: on which it was made, by its author's clock: YYYY-MM-DD.
    """

    agent: str
    source: str
    hyperparameters: str
    suite: str
    date: str

    @property
    def digest(self) -> str:
        """SHA-256 of the commitment: the line to publish."""
        return sha256_of_json(asdict(self))

    def write(self, file: str | os.PathLike) -> None:
        """Write the commitment to a file, replacing it atomically."""
        storage.replace_json(file, {"format": FORMAT, **asdict(self), "sha256": self.digest})

    @staticmethod
    def read(file: str | os.PathLike) -> "Commitment":
        """Read a commitment that `write` wrote.

        Raises:
            ParameterError: there is no such file. FileFormatError: it is no commitment.
            ResultCorrupted: it was changed.
        """
        entry = read_object(file, "commitment", "commit", "ask for it again")
        fields = {name: value for name, value in entry.items() if name not in ("format", "sha256")}
        commitment = records.read(Commitment, fields, f"{file}: the commitment")
        if commitment.digest != entry.get("sha256"):
            raise ResultCorrupted(f"{file}: what it says was changed after it was written; ask for it again")
        return commitment


def read_object(file: str | os.PathLike, what: str, command: str, advice: str) -> dict[str, Any]:
    """The entries of a file that `pharos benchmark COMMAND` wrote.

    Raises:
        ParameterError: there is no such file. FileFormatError: it is another one; `advice` says what to do.
    """
    try:
        entry = storage.read_json(Path(file), FileFormatError, advice)
    except FileNotFoundError:
        raise ParameterError(f"{file}: no such file; `pharos benchmark {command}` writes it") from None
    if not isinstance(entry, dict) or entry.get("format") != FORMAT:
        raise FileFormatError(f"{file}: is no {what}; expected a file of `pharos benchmark {command}`")
    return entry


def make_commitment(
    agent: str | Callable[..., Any], suite: Suite, hyperparameters: Mapping[str, Any] | None = None, *, date: str
) -> Commitment:
    """The commitment to an agent and its hyperparameters.

    Args:
        agent, hyperparameters: as `benchmark.run` takes them; its code is imported.
        suite: the public one.
    Raises:
        UnknownName, ParameterError: there is no such agent, file or hyperparameter.
    """
    form = agent_form(agent, suite, hyperparameters)
    settings = sha256_of_json(storage.plain(form.hyperparameters))
    return Commitment(agent=form.label, source=form.checksum, hyperparameters=settings, suite=suite.digest, date=date)
