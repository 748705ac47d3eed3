"""Chance that derives from a deterministic transition function: sticky and random actions. An MDP in, an MDP out.

Nothing is copied: an MDP carries three weights, and solvers and measures use them implicitly.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pharos.errors import ParameterError

if TYPE_CHECKING:
    from pharos.mdp.tabular import TabularMDP


@dataclass(frozen=True)
class Chance:
    """Which action is executed: the chosen one, the previously executed one, or any one; the weights sum to 1.

    On the first step there is no previous action: the chosen one is executed with probability `first_chosen`, else a uniform
    one. (Only where random actions come before sticky ones does this differ from `chosen + previous`.)
    """

    chosen: float = 1.0
    previous: float = 0.0
    uniform: float = 0.0
    first_chosen: float = 1.0

    @property
    def first_uniform(self) -> float:
        """Probability that a uniform action is executed on the first step."""
        return 1 - self.first_chosen


def random_actions(mdp: "TabularMDP", p: float) -> "TabularMDP":
    """The MDP in which, with probability p, the executed action is uniform over all A actions.

    Q(s, a) = (1 - p) q(s, a) + p mean_b q(s, b), where q(s, x) = r(s, x) + gamma V(next(s, x)).
    Combined with sticky actions: this chance comes before that of `mdp`, so `random_actions(sticky_actions(mdp, p), r)`
    replaces the choice of the agent, and then the previous action may be executed instead.

    Raises:
        ParameterError: p is not in [0, 1].
    Source: the pharos paper, section 3.3 and appendix A; Conserva and Rauber (2022).
    """
    _check_probability("random_actions", p)
    old = mdp.chance
    chance = Chance((1 - p) * old.chosen, old.previous, p * old.chosen + old.uniform, (1 - p) * old.first_chosen)
    return replace(mdp, chance=chance)


def sticky_actions(mdp: "TabularMDP", p: float) -> "TabularMDP":
    """The MDP in which, with probability p, the previously executed action is executed again.

    V(s, b) = (1 - p) max_a q(s, a) + p q(s, b), where b is the previously executed action and q(s, x) the value of executing
    x. On the first step of an episode there is no previous action: the chosen one is executed (as in Gymnasium's
    StickyAction). Combined with random actions: this chance comes before that of `mdp`.

    Raises:
        ParameterError: p is not in [0, 1].
    Source: Machado et al. (2018), section 5; the pharos paper, appendix A.
    """
    _check_probability("sticky_actions", p)
    old = mdp.chance
    chance = Chance((1 - p) * old.chosen, p * old.chosen + old.previous, old.uniform, old.first_chosen)
    return replace(mdp, chance=chance)


def _check_probability(name: str, p: float) -> None:
    if not (isinstance(p, int | float) and math.isfinite(p) and 0 <= p <= 1):
        raise ParameterError(f"{name}: probability is {p!r}; expected a number in [0, 1]")
