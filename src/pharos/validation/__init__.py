"""What is predicted of agents before they train, and how far that has been right on published runs."""

from pharos.validation.learners import (
    POLICY_CURVES,
    POLICY_PREDICTORS,
    PREDICTORS,
    PRIMARY,
    SAMPLED_PREDICTORS,
    predicted,
)
from pharos.validation.prediction import PredictedRegret, Prediction, Published, predict, published

__all__ = ["PRIMARY", "PredictedRegret", "Prediction", "Published", "predict", "published"]
_shared = """
    POLICY_CURVES POLICY_PREDICTORS PREDICTORS SAMPLED_PREDICTORS predicted
"""
