"""Studies: grids of runs, their execution, and models, figures and tables of hardness and regret."""

from typing import TYPE_CHECKING

from pharos.study.analysis import (
    Models,
    PaperComparison,
    agreement,
    compare,
    intervals,
    mean_curve,
    models,
    paper_agreement,
    paper_regressions,
    paper_returns,
)
from pharos.study.archive import pack, unpack
from pharos.study.batches import has_regret
from pharos.study.blocks import Run, Specification
from pharos.study.clusters import run_on_ray, submit
from pharos.study.execution import Status, opened, run, status
from pharos.study.findings import findings
from pharos.study.logs import LOGGERS, RunLog, log
from pharos.study.regression import Fit, aggregate_r_squared, fit, fit_models, leave_one_class_out_r_squared
from pharos.study.report import StudyReport, report
from pharos.study.specification import presets, specification
from pharos.study.tables import cells, curves, hardness_table, paper_instance, predict, table
from pharos.system import lazy
from pharos.training import run_id

if TYPE_CHECKING:  # loaded when they are asked for
    from pharos.study.cross_validation import class_predictions
    from pharos.study.leave_one_class_out import OUTCOMES, Cells, outcomes
    from pharos.study.leave_one_class_out import unseen_classes as validation
    from pharos.study.predictions import PredictedCells, Predictions, read_predictions, write_predictions

__all__ = [
    "Models",
    "Run",
    "Specification",
    "StudyReport",
    "agreement",
    "cells",
    "compare",
    "curves",
    "findings",
    "fit",
    "hardness_table",
    "log",
    "models",
    "outcomes",
    "pack",
    "predict",
    "presets",
    "report",
    "run",
    "specification",
    "status",
    "submit",
    "table",
    "unpack",
    "validation",
]

__getattr__ = lazy.attributes(__name__)
