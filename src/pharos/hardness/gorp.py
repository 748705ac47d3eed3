"""Greedy over random policy (GORP), and how many samples it needs.

Source: Laidlaw, Russell and Dragan (2023), appendix C.

In round t, GORP plays each sequence of k actions m times, goes on at random to the end of the episode, and takes the
first action of the sequence with the best mean return. H_k = k + log_A m, where m makes it fail with probability at
most 1/2.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness.interval import fields_of
from pharos.hardness.steps import OPTIMAL_TIE, FiniteHorizonValues, check_returns, steps_of
from pharos.mdp import TabularMDP, drawn_actions, require_mdp, whole_number
from pharos.system.wording import pluralize

METHODS = ("binomial", "bernstein", "exact")
MOST_SAMPLES, MOST_BINOMIAL = 10**100, 10**6
MOST_SEQUENCES = 100  # of which `bernstein` compares each with each
DISTRIBUTION_PARTS = 100  # of equal probability, into which BRIDGE cuts distributions


@dataclass(frozen=True)
class GorpBound:
    """Bound on the samples that GORP needs, for each k.

    Attributes:
        value: the effective horizon by this bound, the smallest H_k, infinite if no number of samples is proven to do.
        ks, ms, values: k, the samples m for each sequence, and H_k = k + log_A m. m is None if H_k is infinite.
        failure_probabilities: the bound on the probability of failure at m, at most 1/2.
        proven: whether every method is proven. `binomial` is not, if all returns of a node may be 0 at once.
        conventions: horizon, methods, precision of m, tie tolerance.
    """

    value: float
    ks: list[int]
    ms: list[int | None]
    values: list[float]
    failure_probabilities: list[float]
    proven: bool
    conventions: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, with None for infinite values."""
        return {**fields_of(self, "conventions"), **self.conventions}

    def __str__(self) -> str:
        return f"{self.value:.6g} (m = {', '.join('infinite' if m is None else f'{m:,}' for m in self.ms)})"


@require_mdp
def gorp_bound(
    mdp: TabularMDP,
    *,
    horizon: int | None = None,
    max_k: int = 1,
    methods: Sequence[str] = METHODS[:2],
    progress: Callable[[str], object] | None = None,
) -> GorpBound:
    """Return a bound on the samples that GORP needs to act optimally through an episode with probability 1/2.

        F_t(s) = max over p of sum_sequences p(sequence) f(first action),  low <= p <= high,  sum p = 1
        f(a) = 1 if a is not optimal in (t, s), else F_{t+1}(next state),  F_T of an optimal action 0

    [low, high] encloses the probability that a sequence has the best mean of m samples. Of all methods the smallest F
    counts, node by node. The maximum is a fractional knapsack: the largest f first. m is found by bisection, to 1 %.
    If some actions are not available, sequences contain available actions only, random play takes what is
    available, and A is the largest number of available actions in a state.

    Args:
        horizon: T. Default: the MDP's.
        max_k: k = 1, ..., max_k are tried.
        methods: of `binomial` (as BRIDGE has it: k = 1, returns 0 or R, m up to 10^6, 100 cells by quantiles, without
            the outcome that all samples are 0, which is given to every sequence only in so far as the bounds do not add
            up to 1), `bernstein` (up to 100 sequences) and `exact` (returns 0 or R, any k, m up to 10^6: the
            probabilities themselves). The first two are the default, and give the effective horizons that BRIDGE
            published. With `exact` instead of `binomial` the bound is proven, and far smaller.
        progress: called with a line now and then. An exception that it raises ends the computation.
    Raises:
        UndefinedMeasure: the MDP has chance or several outcomes: GORP's sequences of actions then lead nowhere in
            particular.
        ParameterError: an option is wrong. PrecisionError: returns may pass 1e150.
    Cost: for each of about 15 values of m a pass over the nodes that optimal play can meet, A^2k 100 tails for each.
        KeyCorridor (168 states, T = 100, k = 1) takes 20 s.
    Source: Laidlaw, Russell and Dragan (2023), "Bridging RL theory and practice with the effective horizon", appendix
        C.
    """
    steps, names = steps_of("gorp_bound", mdp, horizon), (methods,) if isinstance(methods, str) else tuple(methods)
    check_returns("gorp_bound", mdp, steps)
    ks = list(range(1, whole_number(max_k, "max_k") + 1))
    for name in names:
        if name not in METHODS:
            raise ParameterError(f"unknown method {name!r}; expected some of {', '.join(METHODS)}")
    if not names:
        raise ParameterError(f"no methods given; expected some of {', '.join(METHODS)}")
    _needs_one_outcome("gorp_bound", mdp)
    search = GorpSearch(mdp, steps, names, progress or str)
    ms, failures = (list(each) for each in zip(*map(search.samples, ks), strict=True))
    log_actions = math.log(search.tree.most_actions) if search.tree.most_actions > 1 else math.inf
    values = [math.inf if m is None else k + math.log(m) / log_actions for k, m in zip(ks, ms, strict=True)]
    return GorpBound(
        min(values),
        ks,
        ms,
        values,
        failures,
        proven="binomial" not in names or not search.two_valued,
        conventions={"horizon": steps, "methods": list(names), "precision": 0.01, "tie_tolerance": OPTIMAL_TIE},
    )


@dataclass(frozen=True, eq=False)
class GorpRuns:
    """Returns and actions that runs of GORP found.

    Attributes:
        returns: (runs,) float64, the return of the sequence of actions that was found (its expectation under chance).
        actions: (runs, T) int64.
        optimal_return: of the MDP, from its start.
        timesteps: steps that one run simulates at most: T^2 A^k m.
    """

    returns: np.ndarray
    actions: np.ndarray
    optimal_return: float
    timesteps: int

    @property
    def success_rate(self) -> float:
        """The fraction of runs that found an optimal sequence."""
        return float((self.returns >= self.optimal_return - OPTIMAL_TIE).mean())

    def to_dict(self) -> dict[str, Any]:
        """A summary, JSON-able."""
        return {
            "runs": len(self.returns),
            "mean_return": float(self.returns.mean()),
            "optimal_return": self.optimal_return,
            "success_rate": self.success_rate,
            "timesteps": self.timesteps,
        }

    def __str__(self) -> str:
        num_runs, steps = pluralize(len(self.returns), "run"), pluralize(self.timesteps, "step")
        return f"{self.success_rate:.3g} of {num_runs} optimal, {steps} each"


@require_mdp
def run_gorp(
    mdp: TabularMDP, *, k: int = 1, m: int = 1, horizon: int | None = None, runs: int = 1, seed: int = 0
) -> GorpRuns:
    """Run GORP: find a sequence of T actions, one a round, by m random completions of each sequence of k actions.

    Only sequences that can be executed are tried, if some actions are not available in some states.

    Ties between means go to the first sequence, in the order of its actions.

    Args:
        k: actions that are tried before play becomes random.
        m: samples of each of the A^k sequences.
        horizon: T. Default: the MDP's.
        runs: repetitions, each with random numbers of its own.
        seed: of the random numbers.
    Raises:
        UndefinedMeasure: the MDP has chance, several outcomes or several start states.
        ParameterError: an option is wrong.
    Cost: T^2 / 2 vector operations over A^k m completions for each run: KeyCorridor (T = 100) with m = 50 takes 0.1 s.
    Source: Laidlaw, Russell and Dragan (2023), algorithm 1.
    """
    steps = steps_of("run_gorp", mdp, horizon)
    for name, value in (("k", k), ("m", m), ("runs", runs)):
        whole_number(value, name)
    _needs_one_outcome("run_gorp", mdp)
    tree = FiniteHorizonValues(mdp, steps)
    if len(tree.starts) != 1:
        raise UndefinedMeasure(f"run_gorp: there are {len(tree.starts)} start states; GORP plans from one")
    assert tree.table is not None
    start = tree.starts[0][0]
    sequences = sequences_of(mdp.num_actions, int(k))
    actions = np.empty((int(runs), steps), np.int64)
    returns = np.zeros(int(runs))
    for run, generator in enumerate(np.random.default_rng(seed).spawn(int(runs))):
        node = start
        for t in range(steps):
            possible = _possible(tree, np.array([node]), t, sequences)
            tried = sequences if possible is None else sequences[possible[0]]
            total = _completions(tree, node, t, tried, int(m), generator)
            best = tried[int(total.reshape(len(tried), int(m)).mean(axis=1).argmax()), 0]
            actions[run, t] = best
            returns[run] += tree.rewards[node, best]
            node = tree.table[node, best]
    optimal = tree.at_start(tree.best.max(axis=2)[0])
    return GorpRuns(returns, actions, optimal, steps**2 * len(sequences) * int(m))


def _completions(
    tree: FiniteHorizonValues, node: int, t: int, sequences: np.ndarray, m: int, generator: np.random.Generator
) -> np.ndarray:
    """(A^k m,): the returns from step t of each sequence m times, continued at random."""
    assert tree.table is not None
    nodes = np.full(len(sequences) * m, node)
    total = np.zeros(len(nodes))
    for i in range(tree.steps - t):
        if i < sequences.shape[1]:
            actions = np.repeat(sequences[:, i], m)
        elif tree.sets is not None:
            actions = drawn_actions(tree.sets[nodes], generator)
        else:
            actions = generator.integers(tree.num_actions, size=len(nodes))
        total += tree.rewards[nodes, actions]
        nodes = tree.table[nodes, actions]
    return total


def _possible(tree: FiniteHorizonValues, nodes: np.ndarray, t: int, sequences: np.ndarray) -> np.ndarray | None:
    """(n, L) bool: the sequences of actions (L, k) that can be executed from nodes (n,) at step t. None: all can."""
    if tree.sets is None:
        return None
    assert tree.table is not None
    at = np.repeat(nodes[:, None], len(sequences), axis=1)
    possible = np.ones(at.shape, np.bool_)
    for i in range(min(sequences.shape[1], tree.steps - t)):
        possible &= tree.sets[at, sequences[:, i]]
        at = tree.table[at, sequences[:, i]]
    return possible


def _needs_one_outcome(name: str, mdp: TabularMDP) -> None:
    if not mdp.is_deterministic:
        raise UndefinedMeasure(f"{name} is defined for deterministic MDPs: {mdp} has chance; take the MDP without it")


class GorpSearch:
    """The smallest m, to 1 %, that is proven to make GORP fail with probability 1/2 at most."""

    def __init__(self, mdp: TabularMDP, steps: int, methods: tuple[str, ...], report: Callable[[str], object] = str):
        self.tree, self.methods, self.report = FiniteHorizonValues(mdp, steps, report), methods, report
        assert self.tree.table is not None
        self.nodes_at = [self.tree.first]
        for t in range(steps - 1):
            self.nodes_at.append(self.tree.successors(self.nodes_at[-1], self.tree.optimal[t]))
        most = float(self.tree.best.max())
        rewards = self.tree.rewards
        self.two_valued = most > 0 and bool(((rewards == 0) | (rewards == most)).all())
        self.scale = most if self.two_valued else 1.0

    def samples(self, k: int) -> tuple[int | None, float]:
        if (self.tree.num_actions**k) > 10**6:
            raise ParameterError(f"there are {self.tree.num_actions}^{k} sequences; take a smaller max_k")
        most, least, failure = MOST_SAMPLES, 0, self.failure(MOST_SAMPLES, k)
        if failure > 0.5:
            return None, failure
        while most > least + 1 and (most - least) > 0.01 * most:
            m = math.isqrt(most * (least + 1))
            if (now := self.failure(m, k)) <= 0.5:
                most, failure = m, now
            else:
                least = m
        return most, failure

    def failure(self, m: int, k: int) -> float:
        """The bound on the probability that GORP with m samples takes an action that is not optimal."""
        tree = self.tree
        assert tree.table is not None
        after = np.zeros(tree.num_nodes)
        for t in range(tree.steps - 1, -1, -1):
            nodes = np.flatnonzero(self.nodes_at[t])
            f = np.where(tree.optimal[t, nodes], after[tree.table[nodes]], 1.0)
            now = np.zeros(tree.num_nodes)
            now[nodes] = f.max(axis=1)
            open_ = np.flatnonzero(f.max(axis=1) > f.min(axis=1))
            for block in np.array_split(open_, max(1, len(open_) * tree.num_actions ** (2 * k) // 10**6)):
                if len(block):
                    self.report(f"k = {k}, m = {m:.4g}, step {t} of {tree.steps}")
                    now[nodes[block]] = self._worst_case(nodes[block], t, f[block], m, k)
            after = now
        return tree.at_start(after)

    def _worst_case(self, nodes: np.ndarray, t: int, f: np.ndarray, m: int, k: int) -> np.ndarray:
        """(n,): F_t of nodes, the smallest over all methods."""
        returns = self._returns(nodes, t, k)
        each = np.repeat(f, returns[0].shape[1] // f.shape[1], axis=1)
        possible = _possible(self.tree, nodes, t, sequences_of(self.tree.num_actions, k))
        if possible is None:
            return self._bounded(*returns, each, m, k)
        # Nodes with the same sequences at once
        result = np.empty(len(nodes))
        patterns, group = np.unique(possible, axis=0, return_inverse=True)
        for i, columns in enumerate(patterns):
            rows = np.flatnonzero(group.reshape(-1) == i)
            part = np.ix_(rows, np.flatnonzero(columns))
            mean, best, worst = (x[part] for x in returns)
            result[rows] = self._bounded(mean, best, worst, each[part], m, k)
        return result

    def _bounded(
        self, mean: np.ndarray, best: np.ndarray, worst: np.ndarray, each: np.ndarray, m: int, k: int
    ) -> np.ndarray:
        """(n,): the same by mean, largest and smallest return, and f of the first action, of each sequence (n, L)."""
        is_counted = self.two_valued and m <= MOST_BINOMIAL
        applies = {"binomial": is_counted and k == 1, "exact": is_counted, "bernstein": mean.shape[1] <= MOST_SEQUENCES}
        least, result = each.min(axis=1), each.max(axis=1)
        for name in sorted(name for name in self.methods if applies[name]):  # bernstein may spare the others
            todo = result - least > 1e-9
            if not todo.any():
                break
            if name == "bernstein":
                bounds = _bernstein(m, mean[todo], best[todo], worst[todo])
            else:
                rows = (mean[todo] / self.scale).clip(0, 1)
                bounds = _by_rows(_binomial if name == "binomial" else _exact, m, rows)
            result[todo] = np.minimum(result[todo], knapsack(*bounds, each[todo]))
        return result

    def _returns(self, nodes: np.ndarray, t: int, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean, largest and smallest return of each sequence, (n, A^k), continued at random, optimally, as badly as
        possible."""
        tree = self.tree
        assert tree.table is not None
        sequences = sequences_of(tree.num_actions, k)
        rewards, at = np.zeros((len(nodes), len(sequences))), np.repeat(nodes[:, None], len(sequences), axis=1)
        last = min(k, tree.steps - t)
        for i in range(last - 1):
            rewards += tree.rewards[at, sequences[:, i]]
            at = tree.table[at, sequences[:, i]]
        final, then = sequences[:, last - 1], t + last - 1
        return (
            rewards + tree.explored[then, at, final],
            rewards + tree.best[then, at, final],
            rewards + tree.worst[then, at, final],
        )


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


# Bounds (lower, upper), each (n, A^k), on the probability that a sequence has the best mean return of m samples -------


def _bernstein(m: int, mean: np.ndarray, best: np.ndarray, worst: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from pharos.kernels import horizon as kernels

    lower, upper = np.empty_like(mean), np.maximum(0, (best - mean) * (mean - worst))
    kernels.bernstein(mean, best - worst, float(m), lower, upper)
    return lower, upper


def _by_rows(
    bounds: Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray]], m: int, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds from the probabilities p (n, A^k) that one sample is R and not 0, once for rows that are the same."""
    rows, index = np.unique(p, axis=0, return_inverse=True)
    lower, upper = (np.array(each) for each in zip(*(bounds(m, row) for row in rows), strict=True))
    return lower[index.ravel()], upper[index.ravel()]


def _binomial(m: int, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells between quantiles, as BRIDGE cuts them: by the normal distribution from m = 30, without outcome 0."""
    from scipy.special import bdtr, ndtri

    levels = np.arange(DISTRIBUTION_PARTS + 1) / DISTRIBUTION_PARTS
    lower, upper = np.empty_like(p), np.empty_like(p)
    for own in np.unique(p):
        if m < 30:
            edges = (bdtr(np.arange(m + 1.0), m, own) < levels[:, None]).sum(axis=1).clip(0, m).astype(float)
        else:
            deviation = math.sqrt(m * own * (1 - own))
            edges = np.floor((m * own + deviation * ndtri(levels) if deviation > 0 else np.full(1, m * own)).clip(0, m))
        distribution = bdtr(np.unique(edges)[:, None], m, p)  # (cells, A^k): each ends at its count
        same = p == own
        mass = np.diff(distribution[:, same.argmax()])
        distribution[:, same.argmax()] = 1.0
        others = distribution.prod(axis=1)
        lower[same], upper[same] = mass @ others[:-1], mass @ others[1:]
    return lower, upper


def _exact(m: int, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A sequence wins with x successes if those before it have less, and those after it no more."""
    from scipy.special import bdtr

    deviation = np.sqrt(m * p * (1 - p))
    low = np.floor((m * p - 9 * deviation - 9).max()).clip(0, m)
    high = np.ceil((m * p + 9 * deviation + 9).max()).clip(0, m)
    x = np.arange(low - 1, high + 1)
    cdf = np.where(x[:, None] < 0, 0.0, bdtr(np.maximum(x, 0)[:, None], m, p))  # (X, A^k)
    no_more, less = cdf[1:], cdf[:-1]
    before, behind = np.ones_like(less), np.ones_like(less)
    np.cumprod(less[:, :-1], axis=1, out=before[:, 1:])
    behind[:, :-1] = np.cumprod(no_more[:, :0:-1], axis=1)[:, ::-1]
    lower = ((no_more - less) * before * behind).sum(axis=0)
    return lower, lower + cdf[0].prod() + (1 - cdf[-1]).sum()
