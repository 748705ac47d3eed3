"""Values in a file, which is mapped while they are swept: they need no memory of their own, and outlive the process.

What a solve needs of them is nothing: its bound holds from any values on (see fixed_point.py). So a file that was left
in the middle of a sweep is as good as any, and the next solve goes on from there.
"""

import os
from typing import Any

import numpy as np

from pharos.system.kept_arrays import kept_array

# Rows that are read in one go.
_BLOCK = 1 << 22


def kept_values(path: str | os.PathLike, shape: tuple[int, int], dtype: Any = np.float64) -> np.ndarray:
    """(S + 1, W) mapped from a file of NumPy (.npy): what is there, or zeros in a new one.

    Values that are not finite count as 0, and so does the last row, which is the end.

    Raises:
        FileFormatError: the file holds something else. FolderLocked: its values are in use. ParameterError:
        the file cannot be made.
    """
    x = kept_array(path, shape, dtype)
    for start in range(0, len(x), _BLOCK):
        block = x[start : start + _BLOCK]
        if not np.isfinite(block).all():
            block[~np.isfinite(block)] = 0.0
    x[-1] = 0.0
    return x
