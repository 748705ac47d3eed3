"""The scale of normalised regret: one rule, wherever regret is divided by that of a reference policy."""

from typing import Any

import numpy as np

SMALLEST_SCALE = 1e-12  # in discounted return: below it a ratio is one of rounding errors


def regret_scale(optimal: Any, reference: Any, error_bound: float = 0.0) -> Any:
    """Return V* - V of a reference policy: divided by it, the regret of the optimum is 0, of the reference policy 1.

    Args:
        optimal, reference: numbers or arrays; values from the start, in return.
        error_bound: of each of the two.
    Returns:
        A float or an array, in return. NaN where it is not above max(1e-12, 2 `error_bound`): there the reference
        policy is itself optimal, as far as the values can tell, and regret has no scale.
    Source: 1 - regret / scale is the normalised score of Mnih et al. (2015), with the exact optimum in the place of a
        human. The threshold is ours.
    """
    scale = np.asarray(np.asarray(optimal, np.float64) - np.asarray(reference, np.float64))
    scale = np.where(scale > max(SMALLEST_SCALE, 2 * error_bound), scale, np.nan)
    return scale if scale.ndim else float(scale)
