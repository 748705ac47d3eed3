"""Bounds on the probability that a sequence of actions has the best mean return."""

import math
from typing import TYPE_CHECKING

import numpy as np

from pharos.hardness.planning.steps import TIE

if TYPE_CHECKING:
    from pharos.hardness.planning.gorp import Search

MOST_SEQUENCES = 100  # of which `bernstein` and `berry_esseen` compare each with each
MOST_BINOMIAL = 10**6


def sequences_of(num_actions: int, k: int) -> np.ndarray:
    """(A^k, k): all sequences of k actions, in order."""
    return np.stack(np.meshgrid(*[np.arange(num_actions)] * k, indexing="ij"), axis=-1).reshape(-1, k)


def knapsack(lower: np.ndarray, upper: np.ndarray, f: np.ndarray) -> np.ndarray:
    """(n,): the largest sum of p f with lower <= p <= upper and sum of p = 1."""
    lacking = np.maximum(0, 1 - upper.sum(axis=1, keepdims=True))
    upper = np.minimum(1, upper + lacking)
    order = np.argsort(-f, axis=1, kind="stable")
    lower, upper, f = (np.take_along_axis(each, order, axis=1) for each in (lower, upper, f))
    room = np.maximum(0, 1 - lower.sum(axis=1))
    before = np.cumsum(upper - lower, axis=1) - (upper - lower)
    more = np.clip(room[:, None] - before, 0, upper - lower)
    return np.minimum(((lower + more) * f).sum(axis=1), f.max(axis=1))


class Tails:
    """Bounds (lower, upper), each (n, A^k), on the probability that a sequence has the best mean return, at some nodes.

    Each method takes m and which nodes to answer for, and returns None where it does not apply.
    """

    def __init__(self, search: "Search", nodes: np.ndarray, t: int, k: int):
        tree = search.tree
        assert tree.table is not None
        self.search, self.k, num_actions = search, k, tree.num_actions
        sequences = sequences_of(num_actions, k)
        paid, at = np.zeros((len(nodes), len(sequences))), np.repeat(nodes[:, None], len(sequences), axis=1)
        last = min(k, tree.steps - t)
        for i in range(last - 1):
            paid += tree.rewards[at, sequences[:, i]]
            at = tree.table[at, sequences[:, i]]
        final = sequences[:, last - 1]
        self.mean, self.best, self.worst = (
            paid + values[t + last - 1, at, final] for values in (tree.explored, tree.best, tree.worst)
        )
        self.variance = self.third = np.zeros_like(self.mean)
        if search.moments is not None and t + last < tree.steps:
            following = tree.table[at, final]
            self.variance, self.third = (values[t + last][following] for values in search.moments)

    def bennett(self, m: int, todo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The best sequence stays above the middle between the two largest means, and the others below."""
        mean, best, worst = self.mean[todo], self.best[todo], self.worst[todo]
        top = mean.max(axis=1, keepdims=True)
        second = np.where(mean < top - TIE, mean, -math.inf).max(axis=1, keepdims=True)
        middle = (top + second) / 2
        width = best - worst
        fall = np.where(mean == top, _bennett(m, width, (mean - worst) * width, mean - middle), 1.0)
        rise = _bennett(m, width, (mean - worst) * (best - mean), middle - mean)
        upper = 1 - (1 - rise) * (1 - fall.prod(axis=1, keepdims=True))
        return np.zeros_like(upper), np.where(np.isinf(second), 1.0, upper)

    def bernstein(self, m: int, todo: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        from pharos.kernels import tails

        if self.mean.shape[1] > MOST_SEQUENCES:
            return None
        mean, best, worst = self.mean[todo], self.best[todo], self.worst[todo]
        lower, upper = np.empty_like(mean), np.maximum(0, (best - mean) * (mean - worst))
        tails.bernstein(mean, best - worst, float(m), lower, upper)
        return lower, upper

    def berry_esseen(self, m: int, todo: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        from scipy.special import ndtri

        from pharos.kernels import tails

        if self.mean.shape[1] > MOST_SEQUENCES:
            return None
        mean, variance, third = self.mean[todo], self.variance[todo], self.third[todo]
        cube = variance**1.5
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = np.minimum(0.33554 * (third + 0.415 * cube), 0.3328 * (third + 0.429 * cube))
            error = np.where(variance > 0, factor / (cube * math.sqrt(m)), 0.0)
        deviation = np.sqrt(variance / float(m))
        parts = np.arange(1, tails.PARTS + 1) / tails.PARTS
        with np.errstate(invalid="ignore"):
            high = mean[..., None] + deviation[..., None] * ndtri(np.minimum(1, parts + error[..., None]))
            low = mean[..., None] + deviation[..., None] * ndtri(np.maximum(0, parts - 0.01 - error[..., None]))
        certain = np.broadcast_to((deviation == 0)[..., None], high.shape)
        centre = np.broadcast_to(mean[..., None], high.shape)
        lower, upper = np.empty_like(mean), np.empty_like(mean)
        tails.berry_esseen(
            *(mean, deviation, error, np.where(certain, centre, low), np.where(certain, centre, high), lower, upper)
        )
        return lower, upper

    def binomial(self, m: int, todo: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Cells between quantiles, as BRIDGE cuts them: by the normal distribution from m = 30, without outcome 0."""
        from scipy.special import bdtr, ndtri

        if self.k > 1 or m > MOST_BINOMIAL or not self.search.two_valued:
            return None
        p = (self.mean[todo] / self.search.scale).clip(0, 1)
        levels = np.arange(101) / 100
        if m >= 30:
            deviation = np.sqrt(m * p * (1 - p))[..., None]
            with np.errstate(invalid="ignore"):
                edges = np.where(deviation > 0, m * p[..., None] + deviation * ndtri(levels), m * p[..., None])
            edges = np.floor(edges.clip(0, m))
        else:
            distribution = bdtr(np.arange(m + 1.0), m, p[..., None])
            edges = (distribution[..., None, :] < levels[:, None]).sum(axis=-1).clip(0, m).astype(float)
        rows, n = p.shape
        is_cell = np.ones(edges.shape, np.bool_)
        is_cell[..., 1:] = edges[..., 1:] > edges[..., :-1]  # cells that are not empty
        where, own, _ = np.nonzero(is_cell)
        first = np.flatnonzero(np.concatenate([[True], (np.diff(where) != 0) | (np.diff(own) != 0)]))
        # the distribution function is what costs: once for sequences with the same mean, the first of which leads
        leader = (p[:, :, None] == p[:, None, :]).argmax(axis=2)
        leads, begin = leader == np.arange(n), first.reshape(rows, n)
        if leads.all():
            cdf = bdtr(edges[is_cell][:, None], m, p[where])
        else:
            is_leading = leads[where] & leads[where, own][:, None]
            cdf = np.zeros(is_leading.shape)
            cdf[is_leading] = bdtr(
                np.broadcast_to(edges[is_cell][:, None], is_leading.shape)[is_leading], m, p[where][is_leading]
            )
            led = np.arange(len(own)) - begin[where, own] + begin[where, leader[where, own]]
            cdf = np.take_along_axis(cdf[led], leader[where], axis=1)
        lows = np.roll(cdf, 1, axis=0)
        cells = (cdf - lows)[np.arange(len(own)), own]
        cells[first] = 0.0
        result = []
        for others in (lows, cdf):
            others = others.copy()
            others[np.arange(len(own)), own] = 1.0
            result.append(np.add.reduceat(cells * others.prod(axis=1), first).reshape(rows, n))
        return result[0], result[1]

    def exact(self, m: int, todo: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """A sequence wins with x successes if those before it have less, and those after it no more."""
        from scipy.special import bdtr

        if m > MOST_BINOMIAL or not self.search.two_valued:
            return None
        p = (self.mean[todo] / self.search.scale).clip(0, 1)
        deviation = np.sqrt(m * p * (1 - p))
        low = np.floor((m * p - 9 * deviation - 9).max(axis=1)).clip(0, m)
        high = np.ceil((m * p + 9 * deviation + 9).max(axis=1)).clip(0, m)
        lower, upper = np.empty_like(p), np.empty_like(p)
        for row in range(len(p)):
            x = np.arange(low[row] - 1, high[row] + 1)
            cdf = np.where(x[:, None] < 0, 0.0, bdtr(np.maximum(x, 0)[:, None], m, p[row]))  # (X, n)
            no_more, less = cdf[1:], cdf[:-1]
            before, behind = np.ones_like(less), np.ones_like(less)
            np.cumprod(less[:, :-1], axis=1, out=before[:, 1:])
            behind[:, :-1] = np.cumprod(no_more[:, :0:-1], axis=1)[:, ::-1]
            lower[row] = ((no_more - less) * before * behind).sum(axis=0)
            upper[row] = lower[row] + cdf[0].prod() + (1 - cdf[-1]).sum()
        return lower, upper


def _bennett(m: int, width: np.ndarray, variance: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """P(mean >= expectation + distance) is at most this."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        u = width * distance / variance
        tail = np.exp(-float(m) * variance / width**2 * ((1 + u) * np.log1p(u) - u))
    return np.where(distance <= 0, 1.0, np.where(variance <= 0, 0.0, tail))
