"""Bounds on all eccentricities in a folder, so that a diameter whose searches take minutes goes on where it was killed.

Searches only ever raise lower bounds and lower upper ones, so that a file that was left in the middle of an update
holds bounds all the same. What counts is that they are of the same graph, of which a digest is kept beside them.
"""

from pathlib import Path

import numpy as np
import xxhash

from pharos.errors import FileFormatError, ParameterError
from pharos.hardness.distances.transition_graph import Graph
from pharos.system import storage
from pharos.system.kept_arrays import kept_array

_FILE, _RECORD = "bounds.npy", "bounds.json"
_FORMAT = 1
# Rows of a table that a digest reads in one go.
_BLOCK = 1 << 20


class KeptBounds:
    """The bounds of one graph in a folder: `bounds.npy` (4, N), and `bounds.json`, which says of which graph.

    Attributes:
        dtype: of the bounds that are there, or None: there are none yet.
    """

    def __init__(self, folder: Path, graph: Graph):
        """
        Raises:
            FileFormatError: the folder holds the bounds of another graph.
        """
        self._folder, self._graph = folder, digest_of(graph)
        self._size = graph.num_nodes
        self.dtype: np.dtype | None = None
        path = folder / _RECORD
        if not path.exists():
            return
        record = storage.read_json(path)
        if not isinstance(record, dict) or record.get("format") != _FORMAT or record.get("graph") != self._graph:
            raise FileFormatError(
                f"{path}: is of another graph, or of another pharos; choose another folder, or delete {_FILE} and "
                f"{_RECORD} there"
            )
        self.dtype = np.dtype(np.int16 if record.get("bytes") == 2 else np.int32)

    def arrays(self, dtype: np.dtype) -> np.ndarray:
        """(4, N): lower bounds on out(v) and in(v), then upper ones; what is there, or 0 and the largest number.

        The record is written once these are on the disk: after a power failure a file may hold what it held before.
        """
        path, record = self._folder / _FILE, self._folder / _RECORD
        try:
            if self.dtype != dtype:
                record.unlink(missing_ok=True)
                path.unlink(missing_ok=True)
            bounds = kept_array(path, (4, self._size), dtype, "bounds")
            if self.dtype != dtype or not record.exists():
                bounds[:2] = 0
                bounds[2:] = np.iinfo(dtype).max
                storage.sync(path)
                storage.replace_json(record, {"format": _FORMAT, "graph": self._graph, "bytes": dtype.itemsize})
                self.dtype = dtype
        except OSError as error:
            raise ParameterError(f"{path}: cannot be used for bounds: {error.strerror}; choose another one") from error
        return bounds

    def remove(self) -> None:
        """The diameter is known: the files are not needed any more."""
        for name in (_RECORD, _FILE):
            (self._folder / name).unlink(missing_ok=True)


def digest_of(graph: Graph) -> str:
    """What distances depend on: the table, which states end, and where these lead."""
    digest = xxhash.xxh3_128(f"{graph.next_states.shape} {graph.start} {graph.has_end}".encode())
    for rows in (graph.next_states, graph.ends):
        for start in range(0, len(rows), _BLOCK):
            digest.update(np.ascontiguousarray(rows[start : start + _BLOCK]).data)
    return digest.hexdigest()
