"""The result of a run on disk: run.json and curve.parquet, each written whole or not at all; nothing is pickled."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pharos.errors import FileFormatError, MissingExtra
from pharos.experiments.config import run_id

if TYPE_CHECKING:
    import pandas as pd

FORMAT = 1
COLUMNS = {
    "step": "int64",
    "episodes": "int64",
    "value": "float64",
    "expected_regret": "float64",
    "cumulative_expected_regret": "float64",
    "normalized_regret": "float64",
    "mean_return": "float64",
    "realised_regret": "float64",
    "cumulative_realised_regret": "float64",
    "exact": "bool",
    "error_bound": "float64",
}
"""Columns of curve.parquet, a row for each evaluation. docs/agents.md defines them."""


def identifier(config: Mapping[str, Any]) -> str:
    """The name of a run: a digest of its configuration, the same on every machine."""
    return run_id(config)


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    import platform
    from importlib import metadata

    import pharos

    found = {"pharos": pharos.__version__, "python": platform.python_version()}
    for name in ("numpy", "numba", "gymnasium", "stable-baselines3", "torch"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def write_record(folder: Path, record: Mapping[str, Any]) -> None:
    """run.json, replaced in one step; numbers that JSON cannot say are null."""
    replace_file(folder / "run.json", (as_json(record) + "\n").encode())


def write_curve(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """curve.parquet, replaced in one step; the same rows give the same bytes."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingExtra("writing results", "pyarrow", "agents") from error
    schema = pa.schema([(name, pa.type_for_alias(dtype)) for name, dtype in COLUMNS.items()])
    columns = [pa.array([row[name] for row in rows], schema.field(name).type) for name in COLUMNS]
    sink = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_arrays(columns, schema=schema), sink, compression="zstd")
    replace_file(folder / "curve.parquet", sink.getvalue().to_pybytes())


def read_record(folder: str | os.PathLike) -> dict[str, Any]:
    """What run.json says.

    Raises:
        FileFormatError: there is none, or it is not of a run.
    """
    path = Path(folder) / "run.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file; expected the folder of a run") from None
    except ValueError as error:
        raise FileFormatError(f"{path}: is no JSON: {error}") from None
    if not isinstance(record, dict) or record.get("format") != FORMAT or "config" not in record:
        raise FileFormatError(f"{path}: is not the record of a run in format {FORMAT}")
    return record


def read_curve(folder: str | os.PathLike) -> "pd.DataFrame":
    """The evaluations of a run, a row each.

    Raises:
        FileFormatError: there are none, or columns are missing.
    """
    import pandas as pd

    path = Path(folder) / "curve.parquet"
    try:
        curve = pd.read_parquet(path)
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file; expected the folder of a finished run") from None
    except Exception as error:  # pyarrow has many
        raise FileFormatError(f"{path}: cannot be read: {error}") from None
    missing = [name for name in COLUMNS if name not in curve]
    if missing:
        raise FileFormatError(f"{path}: lacks the columns {', '.join(missing)}")
    return curve


def as_json(record: Mapping[str, Any]) -> str:
    """Text in JSON; numbers that it cannot say are null."""
    return json.dumps(_finite(record), indent=1, allow_nan=False)


def replace_file(path: Path, data: bytes) -> None:
    """Write a file whole, on disk before it has its name."""
    partial = path.with_name(f"{path.name}.{os.getpid()}")
    with open(partial, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if hasattr(value, "tolist"):
        return _finite(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_policy(folder: Path, policy: Any) -> None:
    """policy.npy: what a tabular agent has learnt, as `pharos evaluate --policy` takes it."""
    import io

    import numpy as np

    sink = io.BytesIO()
    np.save(sink, policy, allow_pickle=False)
    replace_file(folder / "policy.npy", sink.getvalue())
