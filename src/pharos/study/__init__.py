"""From hardness and regret to the paper's models, figures and tables."""

import importlib
from typing import Any

from pharos.study.analysis import (
    Comparison,
    Models,
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
from pharos.study.statistics import Estimate, interquartile_mean, stratified_interval
from pharos.study.tables import cells, curves, hardness_table, paper_instance, predict, table
from pharos.training import run_id

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
_shared = """
    Comparison Estimate Fit LOGGERS RunLog Status aggregate_r_squared fit_models has_regret interquartile_mean intervals
    leave_one_class_out_r_squared mean_curve opened paper_agreement paper_instance paper_regressions paper_returns
    read_predictions run_id run_on_ray stratified_interval write_predictions
"""
# Functions of pharos.validation, under the names that they have in studies.
_VALIDATION = {
    "outcomes": "outcomes",
    "read_predictions": "read_predictions",
    "validation": "unseen_classes",
    "write_predictions": "write_predictions",
}


def __getattr__(name: str) -> Any:
    if name not in _VALIDATION:
        raise AttributeError(f"module 'pharos.study' has no attribute {name!r}")
    return getattr(importlib.import_module("pharos.validation"), _VALIDATION[name])
