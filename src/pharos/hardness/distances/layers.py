"""Layers of a graph that contains a clock: every edge leads from one layer of nodes to the next, and round again."""

from typing import Any, NamedTuple

import numpy as np

# Nodes of a layer beyond which layers are not narrow: a set of them no longer fits into a core's cache.
WIDE = 1024


class Layers(NamedTuple):
    """The nodes of a graph by layer.

    Attributes:
        order: (N,) nodes by layer. first: (P + 1,) where each layer begins in it.
        position: (N,) int32, the place of a node in its layer.
    """

    order: np.ndarray
    first: np.ndarray
    position: np.ndarray

    @staticmethod
    def of(layer: np.ndarray, widths: np.ndarray, dtype: Any) -> "Layers":
        """
        Args:
            layer: (N,) that of each node. widths: (P,) how many nodes each has. dtype: of nodes.
        """
        first = np.concatenate([[0], np.cumsum(widths)])
        order = np.argsort(layer, kind="stable").astype(dtype)
        position = np.empty(len(layer), np.int32)
        position[order] = np.arange(len(layer)) - np.repeat(first[:-1], widths)
        return Layers(order, first, position)

    @property
    def number(self) -> int:
        """P."""
        return len(self.first) - 1

    @property
    def widest(self) -> int:
        """Nodes of the largest layer."""
        return int(np.diff(self.first).max())
