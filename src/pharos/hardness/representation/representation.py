"""What a network makes of the states of an MDP: which look alike, and how much learning at one changes another."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import ParameterError, UndefinedMeasure

MOST_EXACT = 4096
"""Different observations up to which a kernel is used as it is; beyond, by landmarks."""
LANDMARKS = 600


@dataclass(frozen=True, eq=False)
class Representation:
    """An observation and a network, as measures see them; `pharos.observations.representation` makes one.

    Attributes:
        kernel: (rows (N,), columns (M,)) of states -> (N, M) float32, the network's tangent kernel; positive
            semidefinite, and symmetric where rows are columns.
        classes: (S,) the number of each state's observation, from 0: states of one number look alike.
        time_limit: steps of an episode that the agent sees, where the MDP has no horizon; or None.
        landmarks: of the approximation beyond MOST_EXACT different observations; 0: none, whatever it takes; 2 or more:
            for all sizes.
        conventions: what it is, JSON-able.
    """

    kernel: Callable[[np.ndarray, np.ndarray], np.ndarray]
    classes: np.ndarray
    time_limit: int | None = None
    landmarks: int | None = None
    conventions: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.landmarks == 1:
            raise ParameterError("landmarks is 1; expected at least 2, as half of them tell the error, or 0 for none")

    @staticmethod
    def of_matrix(kernel: Any, classes: Any = None, **options: Any) -> "Representation":
        """From a kernel (S, S), and numbers of observations (S,); None: every state looks different.

        Raises:
            ParameterError: it is not square, symmetric and finite, there is not one number for each state, or there
                is one landmark.
        """
        matrix = np.asarray(kernel, np.float32)
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.isfinite(matrix).all():
            raise ParameterError(f"kernel has shape {matrix.shape}; expected finite numbers of shape (S, S)")
        if not np.allclose(matrix, matrix.T, rtol=1e-4, atol=1e-6 * np.abs(matrix).max()):
            raise ParameterError("kernel is not symmetric; expected K(x, y) = K(y, x)")
        numbers = np.arange(len(matrix)) if classes is None else np.asarray(classes)
        if numbers.shape != (len(matrix),):
            raise ParameterError(f"classes have shape {numbers.shape}; expected ({len(matrix)},), one for each state")
        return Representation(lambda rows, columns: matrix[np.ix_(rows, columns)], numbers, **options)

    def check(self, num_states: int) -> None:
        """ParameterError unless it is of as many states."""
        if len(self.classes) != num_states:
            raise ParameterError(
                f"the representation is of {len(self.classes)} states; expected {num_states}, those of the MDP"
            )

    def episode(self, horizon: int | None, measure: str) -> int:
        """Steps of an episode: the horizon, else the time limit; UndefinedMeasure where there is neither."""
        steps = self.time_limit if horizon is None else horizon
        if steps is None:
            raise UndefinedMeasure(f"{measure} is defined for episodes of T steps: give a horizon")
        return int(steps)


class Grouped:
    """The different observations of some states.

    Attributes:
        representatives: (C,) one state of each observation.
        groups: (N,) the observation of each of the states, 0 .. C - 1.
    """

    def __init__(self, classes: np.ndarray, states: np.ndarray):
        _, first, groups = np.unique(classes[states], return_index=True, return_inverse=True)
        self.representatives, self.groups = states[first], groups.ravel()

    def __len__(self) -> int:
        return len(self.representatives)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """(C, ...), of values (N, ...) of the states."""
        if values.ndim == 1:
            return np.bincount(self.groups, values, minlength=len(self))
        return np.stack([self.sums(column) for column in values.T], axis=1)
