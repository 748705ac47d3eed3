"""Files of predictions of a study: rows with their hash and date, and which runs had begun before."""

import hashlib
import itertools
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias

from pharos import training
from pharos.agents import NETWORK_CURVE, POLICY_CURVES
from pharos.errors import FileFormatError, ParameterError, PharosError, ResultCorrupted
from pharos.prediction import PREDICTORS
from pharos.system.storage import plain
from pharos.system.wording import pluralize
from pharos.training import CELL

if TYPE_CHECKING:
    import pandas as pd

_KEY = b"pharos.predictions"
_SAID = ("study", "sha256", "date", "version")

Predictions: TypeAlias = "tuple[pd.DataFrame, Mapping[str, str]]"
"""Rows, and the description in their file: study, hash, date and version."""


class NamedStudy(Protocol):
    """A study by its name, which files of predictions keep."""

    @property
    def name(self) -> str: ...


def write_predictions(study: "NamedStudy", predictions: "pd.DataFrame", file: str | os.PathLike) -> dict[str, str]:
    """Write predictions into a Parquet file with their SHA-256, the date and the version, and return these.

    The hash is of the rows alone: the same predictions have the same hash on any day. No prediction is lost.
    If the file holds the same ones, it stays, and its date is returned. If it holds others, it is kept beside, with its
    date in its name.

    Raises:
        OSError: the file cannot be written. An older one then stays as it was.
    """
    import pyarrow as pa

    from pharos import __version__

    about = {
        "study": study.name,
        "sha256": _hash(predictions),
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "version": __version__,
    }
    older = _description(Path(file))
    if older is not None and older["sha256"] == about["sha256"]:
        return older
    table = pa.Table.from_pandas(predictions, preserve_index=False)
    table = table.replace_schema_metadata({_KEY: json.dumps(about).encode()})
    Path(file).parent.mkdir(parents=True, exist_ok=True)
    if older is None:
        training.write_table(Path(file), table, follow=True)
        return about
    older_file = _place_beside(Path(file), older["date"])
    os.replace(file, older_file)
    try:
        training.write_table(Path(file), table, follow=True)
    except BaseException:
        os.replace(older_file, file)
        raise
    return about


def _description(file: Path) -> dict[str, str] | None:
    """Study, hash, date and version of a file of predictions, or None if there is no such file."""
    try:
        return read_predictions(file)[1]
    except PharosError:
        return None


def _place_beside(file: Path, date: str) -> Path:
    """`predictions.2026-11-23T034702Z.parquet`, or with a number if that is taken."""
    name = f"{file.stem}.{date.replace(':', '')}"
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(path for each in names if not (path := file.with_name(each + file.suffix)).exists())


def read_predictions(file: str | os.PathLike) -> "tuple[pd.DataFrame, dict[str, str]]":
    """Read a file of `write_predictions`: the rows, and study, hash, date and version.

    Raises:
        FileFormatError: it is no file of predictions. ResultCorrupted: it was changed after it was written.
    """
    remedy = "write them with `pharos study predict SPEC --out FILE`"
    if not Path(file).is_file():
        raise FileFormatError(f"{file}: no such file; expected predictions: {remedy}")
    table = training.read_table(Path(file), "write it again")
    text = (table.schema.metadata or {}).get(_KEY)
    if text is None or not {*PREDICTORS, *CELL} <= {*table.column_names}:
        raise FileFormatError(f"{file}: holds no predictions; {remedy}")
    try:
        about = json.loads(text)
    except ValueError:
        about = None
    if not isinstance(about, dict) or not all(isinstance(about.get(name), str) for name in _SAID):
        raise ResultCorrupted(f"{file}: what it says of itself is damaged; expected {', '.join(_SAID)}")
    frame = table.to_pandas()
    if about["sha256"] != _hash(frame):
        raise ResultCorrupted(f"{file}: its rows are not those whose hash it has; it was changed after it was written")
    return frame, about


def _hash(frame: "pd.DataFrame") -> str:
    columns = {name: frame[name].tolist() for name in sorted(frame.columns)}
    text = json.dumps(plain(columns), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class PredictedCells:
    """Predictions for the cells of a study, in one file or several.

    Attributes:
        parts: as `read_predictions` returns them, of different cells.
        cells: the rows of all.
    Raises:
        ParameterError: a cell is predicted in two parts.
    """

    parts: "Sequence[Predictions]"
    cells: "pd.DataFrame" = field(init=False)

    def __post_init__(self) -> None:
        import pandas as pd

        cells = pd.concat([frame for frame, _ in self.parts], ignore_index=True)
        twice = cells[cells.duplicated(CELL)][CELL]
        if len(twice):
            raise ParameterError(
                f"{pluralize(len(twice), 'cell')} predicted twice, such as {', '.join(twice.iloc[0])}; "
                "expected files of different cells"
            )
        object.__setattr__(
            self, "cells", cells.fillna({name: "" for name in (*POLICY_CURVES, NETWORK_CURVE) if name in cells})
        )

    @staticmethod
    def of(predictions: "Predictions | Sequence[Predictions] | None") -> "PredictedCells | None":
        """Predictions of one file or of several, or None if there are none."""
        parts = [predictions] if isinstance(predictions, tuple) else list(predictions or ())
        return PredictedCells(parts) if parts else None

    def late(self, runs: "pd.DataFrame") -> tuple[int, int]:
        """Numbers of (runs that had begun when the predictions were written, runs that do not say when they began).

        If there are several parts, each is compared with the runs that it predicts.
        """
        if len(self.parts) == 1:
            return late(runs, self.parts[0][1])
        each = [late(runs.merge(frame[CELL], on=CELL), about) for frame, about in self.parts]
        return sum(before for before, _ in each), sum(unknown for _, unknown in each)


def late(runs: "pd.DataFrame", about: Mapping[str, str]) -> tuple[int, int]:
    """Numbers of (runs that had begun when predictions were written, runs that do not say when they began)."""
    began = runs["began"] if "began" in runs else runs["id"].map(lambda _: "")
    return int(((began != "") & (began <= about["date"])).sum()), int((began == "").sum())
