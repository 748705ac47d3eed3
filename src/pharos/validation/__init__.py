"""Regret of agents predicted before they train, and its accuracy on published runs and on unseen classes."""

from pharos.validation.cross_validation import class_predictions
from pharos.validation.learners import PREDICTORS, predicted
from pharos.validation.leave_one_class_out import OUTCOMES, Cells, outcomes, unseen_classes
from pharos.validation.prediction import (
    PredictedCells,
    PredictedRegret,
    Prediction,
    Predictions,
    Published,
    predict,
    published,
    read_predictions,
    regret_predictor,
    write_predictions,
)

__all__ = [
    "Prediction",
    "Published",
    "outcomes",
    "predict",
    "published",
    "regret_predictor",
    "unseen_classes",
]
