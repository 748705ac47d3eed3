"""Training: an agent trained on a task, its policies evaluated exactly, and the result written down.

A file is loaded when something in it is first used: the command line needs `TrainingOptions` alone to show its help.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.mdp import ChanceSetting
    from pharos.regret import ReferenceValues, cumulative_expected_regret, regret
    from pharos.training.batch import train_group
    from pharos.training.budget import (
        MOST_ERROR_LETTERS,
        BudgetSpent,
        CountedEnv,
        Learn,
        PolicyRecorder,
        Snapshots,
        StepBudget,
        end_process,
        errors_in_one_line,
        generate,
        generated_curve,
    )
    from pharos.training.curve import GAIN_TOLERANCE, Curve, Evaluation, RegretCurve, evaluate_agent
    from pharos.training.execution import (
        GROUP_ATTEMPTS,
        Execution,
        TrainingProgress,
        Work,
        check_device,
        stored_batches,
        train_configs,
    )
    from pharos.training.functions import LearnCompiled, compiled_curves
    from pharos.training.options import ENGINES, ExecutionOptions, TrainingOptions
    from pharos.training.results import (
        TrainingResult,
        check_agent_files,
        clear_run,
        digest_of_curve,
        load_agent,
        read_curve,
        read_curve_table,
        read_record,
        read_rows,
        read_table,
        versions,
        write_curve,
        write_policy,
        write_record,
        write_table,
    )
    from pharos.training.runs import train, train_config, train_many
    from pharos.training.schedule import FailedRun, PreparedRun, Shapes, TaskCache, dealt, halves, lanes, plan
    from pharos.training.task import CELL, HELD_OUT, Horizon, RunConfig, Task, TaskValues, run_id
    from pharos.training.tuning import TuningResult, tune

__all__ = [
    "ChanceSetting",
    "Evaluation",
    "ReferenceValues",
    "RegretCurve",
    "RunConfig",
    "Task",
    "TrainingOptions",
    "TrainingResult",
    "cumulative_expected_regret",
    "evaluate_agent",
    "load_agent",
    "regret",
    "train",
    "train_config",
    "train_configs",
    "train_many",
    "tune",
]

__getattr__ = lazy.attributes(__name__)
