"""From hardness and regret to the paper's models, figures and tables."""

from pharos.study._execution import Status, run, status
from pharos.study._paper import paper_regressions, paper_returns
from pharos.study._regression import Fit, aggregate_r_squared, fit, fit_models, leave_one_class_out_r_squared
from pharos.study._specification import Run, Specification, presets, run_id, specification
from pharos.study._statistics import Estimate, interquartile_mean, stratified_interval

__all__ = [
    "Estimate",
    "Fit",
    "Run",
    "Specification",
    "Status",
    "aggregate_r_squared",
    "fit",
    "fit_models",
    "interquartile_mean",
    "leave_one_class_out_r_squared",
    "paper_regressions",
    "paper_returns",
    "presets",
    "run",
    "run_id",
    "specification",
    "status",
    "stratified_interval",
]
