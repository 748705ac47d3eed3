"""Products with a kernel: the kernel itself, the identity, or landmarks and a diagonal (Nyström)."""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

MOST_LANCZOS = 60
ELSEWHERE = 0.1  # of a first vector: the last phase's eigenvector may be one still, and no longer the largest
FEW = 8  # columns up to which half of a symmetric matrix is read sooner than BLAS has packed all of it

Kernel = Callable[[np.ndarray, np.ndarray], np.ndarray]


class KernelOperator:
    """A positive semidefinite kernel K of C observations; z is (C, A) float64."""

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """K z."""
        raise NotImplementedError

    def largest_eigenvalue(self, weights: np.ndarray, vector: np.ndarray) -> float:
        """The largest eigenvalue of K diag(weights), weights (C, 1), to 0.1 %, by Lanczos' method from `vector` (C, 1).

        Returns it with the residual added, so that it is not too small; `vector` becomes the eigenvector found.
        """
        root = np.sqrt(weights)
        vector *= 1.0 if vector.sum() >= 0 else -1.0
        begin = vector / np.linalg.norm(vector) + ELSEWHERE / math.sqrt(len(vector))
        basis = [begin / np.linalg.norm(begin)]
        diagonal: list[float] = []
        beside: list[float] = []
        while True:
            after = root * self(root * basis[-1])
            diagonal.append(float((basis[-1] * after).sum()))
            rows = np.concatenate(basis, axis=1)
            after = after - rows @ (rows.T @ after)
            after = after - rows @ (rows.T @ after)  # twice is enough (Parlett, 1998)
            length = float(np.linalg.norm(after))
            small = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
            values, vectors = np.linalg.eigh(small)
            residual = length * abs(float(vectors[-1, -1]))
            if residual <= 1e-3 * values[-1] or len(basis) == min(MOST_LANCZOS, len(vector)):
                vector[:] = rows @ vectors[:, -1:]
                return max(float(values[-1]), 0.0) + residual
            basis.append(after / length)
            beside.append(length)

    def preconditioned(self, weights: np.ndarray) -> None:
        """Become W^-1/2 (W^1/2 K W^1/2)^1/2 W^-1/2, the kernel of full-matrix Adam; W the weights (C,) of observations.

        Its second moments of gradients are J' W J for errors of one size, J the network's Jacobian, K = J J'; dividing
        gradients by their square root leaves each eigenvalue of K under W as its square root. Weights are positive.
        Source: Duchi, Hazan and Singer (2011) for full matrices; Kingma and Ba (2015) keep the diagonal alone.
        """
        raise NotImplementedError

    def parts(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(K (C, C), F (C, 0), diagonal (0,)), or K = F F' + diag as ((0, 0), F (C, m), (C,)); all float32."""
        raise NotImplementedError

    def descended(self, weights: np.ndarray, error: np.ndarray, rate: float, steps: int) -> np.ndarray:
        """What gradient descent adds to Q in `steps` steps Q += rate K (weights (target - Q)), from error = target - Q.

        It is K times rate weights times the sum of the errors on the way, a polynomial of degree steps - 1 in
        rate K diag(weights), whose eigenvalues lie in [0, 1]: a Chebyshev series of about 3.5 sqrt(steps) terms has it
        to float32's accuracy, in each eigenvector for itself. weights, error: (C, A) float64.
        """
        return rate * self(weights * self.summed(weights, error, rate, _sum_of_powers(steps)))

    def summed(self, weights: np.ndarray, error: np.ndarray, rate: float, series: np.ndarray) -> np.ndarray:
        """The sum of the terms of a Chebyshev series in 1 - 2 rate K diag(weights), applied to error."""
        past, now = error, error - 2 * rate * self(weights * error)
        total = series[0] * past
        if len(series) > 1:
            total = total + series[1] * now
        for coefficient in series[2:]:
            past, now = now, 2 * now - 4 * rate * self(weights * now) - past
            total += coefficient * now
        return total


class Identity(KernelOperator):
    """No likeness between observations: a table."""

    def __call__(self, z: np.ndarray) -> np.ndarray:
        return z

    def largest_eigenvalue(self, weights: np.ndarray, vector: np.ndarray) -> float:
        return float(weights.max())

    def parts(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.empty((0, 0), np.float32), np.empty((count, 0), np.float32), np.ones(count, np.float32)


class Exact(KernelOperator):
    """The kernel itself, 4 C^2 bytes."""

    def __init__(self, kernel: Kernel, states: np.ndarray):
        self.matrix = np.ascontiguousarray(kernel(states, states), np.float32)

    def __call__(self, z: np.ndarray) -> np.ndarray:
        from pharos.kernels import linear_algebra

        if z.shape[1] > FEW:
            return self.matrix @ z
        rows = np.ascontiguousarray(z.T, np.float64)
        out = np.empty_like(rows)
        linear_algebra.product(self.matrix, rows, out)
        return out.T

    def parts(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.matrix, np.empty((count, 0), np.float32), np.empty(0, np.float32)

    def preconditioned(self, weights: np.ndarray) -> None:
        root = np.sqrt(weights)[:, None]
        values, vectors = np.linalg.eigh(root * self.matrix * root.T)
        vectors *= np.maximum(values, 0.0) ** 0.25
        self.matrix = np.ascontiguousarray((vectors @ vectors.T) / root / root.T, np.float32)


class Landmarks(KernelOperator):
    """K ~ F F' + a diagonal, F = K(., L) K(L, L)^-1/2: exact between landmarks L and others, and on the diagonal.

    The diagonal keeps what an observation learns for itself alone (Snelson and Ghahramani, 2006, for regression).
    Source: Williams and Seeger (2001).
    """

    def __init__(self, kernel: Kernel, states: np.ndarray, landmarks: np.ndarray, block: int = 4096):
        values, vectors = np.linalg.eigh(kernel(landmarks, landmarks).astype(np.float64))
        is_large = values > 1e-6 * values[-1]
        root = (vectors[:, is_large] / np.sqrt(values[is_large])).astype(np.float32)
        self.features = np.empty((len(states), int(is_large.sum())), np.float32)
        self.diagonal = np.empty((len(states), 1), np.float32)
        for start in range(0, len(states), block):
            rows = states[start : start + block]
            part = kernel(rows, landmarks) @ root
            self.features[start : start + block] = part
            own = np.concatenate([np.diag(kernel(each, each)) for each in np.array_split(rows, len(rows) // 64 + 1)])
            self.diagonal[start : start + block, 0] = np.maximum(own - np.einsum("nm,nm->n", part, part), 0.0)

    def __call__(self, z: np.ndarray) -> np.ndarray:
        z = z.astype(np.float32)
        return self.features @ (self.features.T @ z) + self.diagonal * z

    def parts(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return np.empty((0, 0), np.float32), self.features, np.ascontiguousarray(self.diagonal[:, 0])

    def preconditioned(self, weights: np.ndarray) -> None:
        """Of the features and of the diagonal, each for itself."""
        column = weights.astype(np.float32)[:, None]
        values, vectors = np.linalg.eigh((self.features.T @ (column * self.features)).astype(np.float64))
        is_large = values > 1e-7 * values[-1]
        self.features = np.ascontiguousarray(
            self.features @ (vectors[:, is_large] * values[is_large] ** -0.25).astype(np.float32)
        )
        self.diagonal = np.sqrt(self.diagonal / column)

    def summed(self, weights: np.ndarray, error: np.ndarray, rate: float, series: np.ndarray) -> np.ndarray:
        """As for others, with one pass over the features a term in place of two."""
        from pharos.kernels import linear_algebra

        if len(series) < 3:
            return super().summed(weights, error, rate, series)
        weights, error = weights.astype(np.float32), error.astype(np.float32)
        past, now = error.copy(), error - np.float32(2 * rate) * self(weights * error)
        total = np.float32(series[0]) * past + np.float32(series[1]) * now
        projected = np.empty((error.shape[1], self.features.shape[1]))
        linear_algebra.project(self.features, weights * now, projected)
        for coefficient in series[2:]:
            across = projected.astype(np.float32)
            linear_algebra.step(self.features, self.diagonal, weights, np.float32(rate), across, now, past, projected)
            past, now = now, past
            total += np.float32(coefficient) * now
        return total


@lru_cache(maxsize=16)
def _sum_of_powers(steps: int) -> np.ndarray:
    """Chebyshev coefficients in u = 1 - 2 x of the sum of (1 - x)^t, t < steps, on [0, 1]."""
    degree = min(steps - 1, math.ceil(3.5 * math.sqrt(steps)))

    def total(u: Any) -> Any:
        x = (1 - u) / 2
        return np.where(x > 1e-9, -np.expm1(steps * np.log1p(-np.minimum(x, 1 - 1e-16))) / np.maximum(x, 1e-9), steps)

    return np.polynomial.chebyshev.chebinterpolate(total, degree)
