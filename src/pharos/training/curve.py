"""Curves: what a run writes down as it learns, what is read back of one, and intervals over several.

A row has the exact value of the policy at an evaluation, and the regret of the episodes before it.
"""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.solvers import ReferenceValues, cumulative_expected_regret, regret
from pharos.training import results as _results
from pharos.training.evaluation import Evaluation, evaluate_agent
from pharos.training.task import Task

RESAMPLED = 1 << 22  # numbers that one batch of resamples may hold


@dataclass
class Curve:
    """The rows so far, and the regret of the episodes between evaluations.

    Attributes:
        table: the policy of the last row, where it is a table.
    """

    task: Task
    rows: list[dict[str, Any]] = field(default_factory=list)
    table: np.ndarray | None = None

    def add(
        self, step: int, episodes: int, returns: float, agent: Any, evaluation: Evaluation | None = None
    ) -> dict[str, Any]:
        """Evaluate the policy after `step` steps and `episodes` finished episodes, whose returns sum to `returns`;
        unless its `evaluation` is there.
        """
        evaluation = evaluation or evaluate_agent(agent, self.task, again=True)
        reference = self.task.reference
        last = self.rows[-1] if self.rows else None
        finished = episodes - (last["episodes"] if last else 0)
        gained = returns - (last["returns"] if last else 0.0)
        mean = gained / finished if finished else math.nan
        row = {
            "step": step,
            "episodes": episodes,
            "value": evaluation.value,
            "expected_regret": regret(evaluation.value, reference),
            "cumulative_expected_regret": (
                last["cumulative_expected_regret"] + finished * last["expected_regret"] if last else 0.0
            ),
            "normalized_regret": regret(evaluation.value, reference, normalized_by="uniform"),
            "mean_return": mean,
            "realised_regret": regret(mean, reference),
            "cumulative_realised_regret": episodes * reference.optimal - returns,
            "exact": evaluation.exact,
            "error_bound": evaluation.error_bound,
            "returns": returns,
        }
        self.rows.append(row)
        self.table = agent if isinstance(agent, np.ndarray) else None
        return row

    def result(self) -> dict[str, Any]:
        """The summary of a finished run."""
        values, last = self.task.reference, self.rows[-1]
        scale = last["episodes"] * values.spread() or math.nan
        return {
            "value_optimal": values.optimal,
            "value_uniform": values.uniform,
            "value_worst": values.worst,
            "value_error_bound": values.error_bound,
            "final_value": last["value"],
            "final_regret": last["expected_regret"],
            "cumulative_regret": last["cumulative_expected_regret"],
            "normalized_regret": last["cumulative_expected_regret"] / scale,
            "cumulative_realised_regret": last["cumulative_realised_regret"],
            "normalized_realised_regret": last["cumulative_realised_regret"] / scale,
            "mean_return": last["returns"] / last["episodes"] if last["episodes"] else math.nan,
            "episodes": last["episodes"],
            "exact": all(row["exact"] for row in self.rows),
            "conventions": self.task.conventions,
        }


@dataclass(frozen=True, eq=False)
class RegretCurve:
    """The regret of one run, at its N evaluations.

    Attributes:
        steps, episodes: (N,) environment steps and finished episodes before each evaluation.
        policy_values: (N,) value of the policy from the start.
        returns: (N,) sum of the returns of all episodes finished so far.
        values: of the task's reference policies.
    """

    steps: np.ndarray
    episodes: np.ndarray
    policy_values: np.ndarray
    returns: np.ndarray
    values: ReferenceValues

    @staticmethod
    def read(folder: str | os.PathLike) -> "RegretCurve":
        """That of a finished run.

        Raises:
            FileFormatError: the folder holds no finished run.
        """
        curve, result = _results.read_curve(folder), _results.read_record(folder)["result"]
        episodes = curve["episodes"].to_numpy(np.int64)
        entries = {name: result.get(f"value_{name}", 0.0) for name in ("optimal", "uniform", "worst", "error_bound")}
        values = ReferenceValues(**{name: math.nan if value is None else value for name, value in entries.items()})
        returns = episodes * values.optimal - curve["cumulative_realised_regret"].to_numpy(np.float64)
        return RegretCurve(curve["step"].to_numpy(np.int64), episodes, curve["value"].to_numpy(float), returns, values)

    @property
    def expected(self) -> np.ndarray:
        """(N,) expected regret of the policy at each evaluation."""
        return regret(self.policy_values, self.values)

    @property
    def cumulative_expected(self) -> np.ndarray:
        """(N,) expected regret summed over episodes, see `cumulative_expected_regret`."""
        return cumulative_expected_regret(self.episodes, self.expected)

    @property
    def cumulative_realised(self) -> np.ndarray:
        """(N,) episodes V*(s0) - sum of returns."""
        return self.episodes * self.values.optimal - self.returns

    def normalized(self, cumulative: np.ndarray, reference: str = "uniform") -> np.ndarray:
        """A cumulative regret of this run divided by what the reference policy loses in as many episodes.

        NaN before the first episode is finished, and where the reference policy is optimal.
        """
        lost = self.episodes * self.values.spread(reference)
        return np.divide(cumulative, lost, out=np.full(len(lost), math.nan), where=lost > 0)


def bootstrap_interval(
    samples: Sequence[Any],
    statistic: Callable[..., np.ndarray],
    *,
    confidence: float = 0.95,
    resamples: int = 1000,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of the percentile bootstrap interval of a statistic of several samples.

    Each sample is resampled with replacement by itself: a stratified bootstrap, in which a sample of one observation
    stays as it is.

    Args:
        samples: arrays (..., N), N observations each; N may differ. The other axes are drawn together, such as all
            points of a curve, and are alike in all samples.
        statistic: `statistic(*samples, axis=-1)`, vectorised over all other axes.
        confidence, resamples, seed: of the bootstrap.
    Returns:
        lower, upper: of the shape of the statistic.
    Raises:
        ParameterError: there is no sample, or one is empty or has an entry that is not finite.
    Cost: `resamples` times the statistic, in batches.
    Source: Efron and Tibshirani (1993), An introduction to the bootstrap, section 13.3; computed by
        scipy.stats.bootstrap.
    """
    from scipy import stats

    arrays = [np.asarray(sample, np.float64) for sample in samples]
    if not arrays or any(array.ndim == 0 or array.shape[-1] == 0 for array in arrays):
        raise ParameterError(
            f"a bootstrap needs at least one run of each task; found {[array.size for array in arrays]}"
        )
    if not all(np.isfinite(array).all() for array in arrays):
        raise ParameterError("a bootstrap needs finite results; found NaN or infinity")
    varying = [array for array in arrays if array.shape[-1] > 1]
    if not varying:
        value = np.asarray(statistic(*arrays, axis=-1))
        return value, value

    def of_all(*drawn: np.ndarray, axis: int) -> np.ndarray:
        """The statistic of the drawn samples and of those that have nothing to draw from."""
        parts, batch = iter(drawn), drawn[0].shape[:-1]
        single = (
            next(parts) if array.shape[-1] > 1 else np.broadcast_to(_beside(array, len(batch)), (*batch, 1))
            for array in arrays
        )
        return statistic(*single, axis=axis)

    result = stats.bootstrap(
        varying,
        of_all,
        n_resamples=resamples,
        batch=max(1, RESAMPLED // sum(array.size for array in arrays)),
        vectorized=True,
        axis=-1,
        confidence_level=confidence,
        method="percentile",
        random_state=np.random.default_rng(seed),
    )
    return np.asarray(result.confidence_interval.low), np.asarray(result.confidence_interval.high)


def _beside(array: np.ndarray, axes: int) -> np.ndarray:
    """A sample (..., 1) with an axis for the resamples before its last, where the batch has one."""
    return array if array.ndim == axes + 1 else np.expand_dims(array, -2)
