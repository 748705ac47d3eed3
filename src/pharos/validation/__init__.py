"""What is predicted of agents before they train, and how far that has been right on published runs."""

from pharos.validation.cross_validation import class_predictions
from pharos.validation.learners import (
    POLICY_CURVES,
    POLICY_PREDICTORS,
    PREDICTORS,
    PRIMARY,
    SAMPLED_PREDICTORS,
    predicted,
)
from pharos.validation.leave_one_class_out import OUTCOMES, Cells, outcomes, unseen_classes
from pharos.validation.prediction import PredictedRegret, Prediction, Published, predict, published
from pharos.validation.prediction_files import PredictedCells, Predictions, read_predictions, write_predictions

__all__ = [
    "PRIMARY",
    "PredictedRegret",
    "Prediction",
    "Published",
    "outcomes",
    "predict",
    "published",
    "unseen_classes",
]
_shared = """
    Cells OUTCOMES POLICY_CURVES POLICY_PREDICTORS PREDICTORS PredictedCells Predictions SAMPLED_PREDICTORS
    class_predictions predicted read_predictions write_predictions
"""
