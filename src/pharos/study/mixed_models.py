"""Mixed models of an outcome: a slope for the predictor, random intercepts for classes and for the MDPs within them."""

import warnings
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class MixedFit:
    """y = intercept + slope z + class + MDP + residual, by restricted maximum likelihood.

    Attributes:
        slope: of the standardised predictor z, in units of the outcome; error: its standard error.
        p_value: two-sided, of slope / error under Student's t with two degrees of freedom fewer than classes: a
            predictor can differ between classes alone, and the normal distribution would trust few classes too much.
        class_variance, mdp_variance, residual_variance: of the random parts and of what is left.
    """

    slope: float
    error: float
    p_value: float
    class_variance: float
    mdp_variance: float
    residual_variance: float


def mixed_fit(x: np.ndarray, y: np.ndarray, classes: np.ndarray, mdps: np.ndarray) -> MixedFit | None:
    """Fit the model to cells: x, y (N,), classes and mdps (N,) integers; MDPs of different classes are different.

    Returns:
        None where there are fewer than three classes, x is constant, or the likelihood has no maximum that is found.
    Source: statsmodels' MixedLM; Laird and Ware (1982).
    """
    import pandas as pd
    import statsmodels.formula.api as smf
    from scipy import stats

    count = len(np.unique(classes))
    if count < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    data = pd.DataFrame({"y": y, "z": (x - x.mean()) / x.std(), "family": classes, "mdp": mdps})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # variances at 0 are told as warnings
        try:
            model = smf.mixedlm("y ~ z", data, groups="family", re_formula="1", vc_formula={"mdp": "0 + C(mdp)"})
            fit = model.fit(reml=True, method=["lbfgs", "powell"])
            slope, error = float(fit.fe_params["z"]), float(fit.bse_fe["z"])  # of a perfect line: a root of about -0
        except (np.linalg.LinAlgError, ValueError):
            return None
    if not np.isfinite(slope) or not error > 0:
        return None
    p = float(2 * stats.t.sf(abs(slope / error), count - 2))
    return MixedFit(slope, error, p, float(fit.cov_re.iloc[0, 0]), float(fit.vcomp[0]), float(fit.scale))
