"""The former name of `pharos.prediction`, and of what judges predictions in `pharos.study`."""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.prediction import Prediction, Published, predict, published, regret_predictor
    from pharos.study import outcomes
    from pharos.study import validation as unseen_classes

__all__ = ["Prediction", "Published", "outcomes", "predict", "published", "regret_predictor", "unseen_classes"]

__getattr__ = lazy.attributes(__name__)
