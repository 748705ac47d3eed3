"""Training: an agent trained on a task, its policies evaluated exactly, and the result written down."""

from pharos.training.batch import train_configs
from pharos.training.bootstrap import bootstrap_interval
from pharos.training.config import ENGINES, ChanceSetting, Horizon, RunConfig, run_id
from pharos.training.evaluation import Evaluation, evaluate_agent
from pharos.training.loading import load_agent
from pharos.training.many_seeds import train_many
from pharos.training.pace import steps_in_seconds
from pharos.training.regret import ReferenceValues, RegretCurve, cumulative_expected_regret, regret
from pharos.training.results import (
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
from pharos.training.run_folder import TrainingResult
from pharos.training.search_space import SPACES
from pharos.training.task import Task, TaskValues
from pharos.training.task_cache import FailedRun, TaskCache
from pharos.training.train import train, train_config
from pharos.training.training_jobs import Progress
from pharos.training.tuning import TuningResult, tune

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
