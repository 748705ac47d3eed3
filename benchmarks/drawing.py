"""Hyperparameters drawn at random from a search space, as Optuna's trials would suggest them."""

import numpy as np

from pharos.training.tuning import suggested_value


class Drawn:
    """Draws what Optuna's trial would suggest, real numbers rounded to some significant digits."""

    def __init__(self, rng, digits):
        self.rng, self.digits = rng, digits

    def suggest_categorical(self, _name, values):
        return values[int(self.rng.integers(len(values)))]

    def suggest_float(self, _name, low, high, log=False):
        if log:
            low, high = np.log(low), np.log(high)
        number = self.rng.uniform(low, high)
        return float(f"{np.exp(number) if log else number:.{self.digits}g}")


def drawn_set(rng, space, digits):
    """A value for each hyperparameter of a space: name -> (kind, *values)."""
    return {name: suggested_value(Drawn(rng, digits), name, choices) for name, choices in space.items()}
