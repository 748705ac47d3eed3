"""The curve of a run as it learns: the exact value of its policy at each evaluation, and the regret of the episodes."""

import math
from dataclasses import dataclass, field
from typing import Any

from pharos.training.evaluation import Evaluation, evaluate_agent
from pharos.training.task import Task


@dataclass
class Curve:
    """The rows so far, and the regret of the episodes between evaluations."""

    task: Task
    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self, step: int, episodes: int, returns: float, agent: Any, evaluation: Evaluation | None = None
    ) -> dict[str, Any]:
        """Evaluate the policy after `step` steps and `episodes` finished episodes, whose returns sum to `returns`;
        unless its `evaluation` is there.
        """
        evaluation = evaluation or evaluate_agent(agent, self.task, again=True)
        reference = self.task.reference
        best = reference.optimal
        last = self.rows[-1] if self.rows else None
        finished = episodes - (last["episodes"] if last else 0)
        gained = returns - (last["returns"] if last else 0.0)
        mean = gained / finished if finished else math.nan
        regret = best - evaluation.value
        row = {
            "step": step,
            "episodes": episodes,
            "value": evaluation.value,
            "expected_regret": regret,
            "cumulative_expected_regret": (
                last["cumulative_expected_regret"] + finished * last["expected_regret"] if last else 0.0
            ),
            "normalized_regret": regret / reference.spread(),
            "mean_return": mean,
            "realised_regret": best - mean,
            "cumulative_realised_regret": episodes * best - returns,
            "exact": evaluation.exact,
            "error_bound": evaluation.error_bound,
            "returns": returns,
        }
        self.rows.append(row)
        return row

    def result(self) -> dict[str, Any]:
        """The summary of a finished run."""
        task, last = self.task, self.rows[-1]
        scale = last["episodes"] * task.reference.spread() or math.nan
        return {
            "value_optimal": task.reference.optimal,
            "value_uniform": task.reference.uniform,
            "value_worst": task.reference.worst,
            "final_value": last["value"],
            "final_regret": last["expected_regret"],
            "cumulative_regret": last["cumulative_expected_regret"],
            "normalized_regret": last["cumulative_expected_regret"] / scale,
            "cumulative_realised_regret": last["cumulative_realised_regret"],
            "normalized_realised_regret": last["cumulative_realised_regret"] / scale,
            "mean_return": last["returns"] / last["episodes"] if last["episodes"] else math.nan,
            "episodes": last["episodes"],
            "exact": all(row["exact"] for row in self.rows),
            "conventions": task.conventions,
        }
