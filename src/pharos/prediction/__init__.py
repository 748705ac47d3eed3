"""Regret of agents predicted before they train, with intervals from published runs."""

from pharos.prediction.calibration import Published, published
from pharos.prediction.learners import PREDICTORS, predicted
from pharos.prediction.pairs import Pairs
from pharos.prediction.prediction import PredictedRegret, Prediction, predict, regret_predictor

__all__ = [
    "Prediction",
    "Published",
    "predict",
    "published",
    "regret_predictor",
]
