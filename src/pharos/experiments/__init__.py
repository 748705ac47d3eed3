"""Experiments: an agent trained on a task, its policies evaluated exactly, and the result written down."""

from pharos.experiments.batch import train_configs
from pharos.experiments.bootstrap import bootstrap_interval
from pharos.experiments.config import ENGINES, ChanceSetting, Horizon, RunConfig, run_id
from pharos.experiments.evaluation import Evaluation, evaluate_agent
from pharos.experiments.loading import load_agent
from pharos.experiments.many_seeds import train_many
from pharos.experiments.pace import steps_in_seconds
from pharos.experiments.regret import ReferenceValues, RegretCurve, cumulative_expected_regret, regret
from pharos.experiments.results import (
    check_agent,
    digest_of_curve,
    read_curve,
    read_curve_table,
    read_record,
    read_rows,
    read_table,
    write_record,
    write_table,
)
from pharos.experiments.run_folder import TrainingResult
from pharos.experiments.search_space import SPACES
from pharos.experiments.task import Task, TaskValues
from pharos.experiments.task_cache import FailedRun, TaskCache
from pharos.experiments.train import train, train_config
from pharos.experiments.training_jobs import Progress
from pharos.experiments.tuning import TuningResult, tune

__all__ = [
    "ENGINES",
    "SPACES",
    "ChanceSetting",
    "Evaluation",
    "FailedRun",
    "Horizon",
    "Progress",
    "ReferenceValues",
    "RegretCurve",
    "RunConfig",
    "Task",
    "TaskCache",
    "TaskValues",
    "TrainingResult",
    "TuningResult",
    "bootstrap_interval",
    "check_agent",
    "cumulative_expected_regret",
    "digest_of_curve",
    "evaluate_agent",
    "load_agent",
    "read_curve",
    "read_curve_table",
    "read_record",
    "read_rows",
    "read_table",
    "regret",
    "run_id",
    "steps_in_seconds",
    "train",
    "train_config",
    "train_configs",
    "train_many",
    "tune",
    "write_record",
    "write_table",
]
