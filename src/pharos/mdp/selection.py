"""What is chosen in each state: the best action, the worst one, or what a policy says.

The one thing in which the Bellman equations of optimal values, worst values and values of a policy differ.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pharos.errors import ParameterError

if TYPE_CHECKING:
    from pharos.mdp.tabular import TabularMDP


States = slice | np.ndarray
"""Which states: a range, or their numbers (N,)."""


class Selection(Protocol):
    """What is chosen, given the values of executing each action.

    Attributes:
        kind: of a solution: "optimal", "worst" or "policy".
        mass: the largest sum of the probabilities of choosing, at least 1.
        operations: rounding operations, at most, of a value of what is chosen.
    """

    @property
    def kind(self) -> str: ...

    @property
    def mass(self) -> float: ...

    def operations(self, num_actions: int) -> int: ...

    def value(self, q: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, 1, ...), or (N, A, ...) where it depends on the previous action: from q (N, A, ...) of some states."""

    def first_value(self, q: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, 1, ...): without a previous action."""

    def policy(self, q: np.ndarray) -> "PolicyTable":
        """What is chosen as a policy: the first of the best or worst actions, or the policy itself."""


@dataclass(frozen=True)
class Extreme:
    """The best action (sign 1), or the worst one (sign -1)."""

    sign: float
    kind: str
    mass = 1.0

    def operations(self, num_actions: int) -> int:
        return 0

    def value(self, q: np.ndarray, states: States = slice(None)) -> np.ndarray:
        return q.max(axis=1, keepdims=True) if self.sign > 0 else q.min(axis=1, keepdims=True)

    first_value = value

    def policy(self, q: np.ndarray) -> "PolicyTable":
        actions = q.argmax(axis=1) if self.sign > 0 else q.argmin(axis=1)
        return PolicyTable(q.shape[1], actions=actions)


BEST = Extreme(1.0, "optimal")
WORST = Extreme(-1.0, "worst")


class PolicyTable:
    """What a policy chooses.

    Attributes:
        num_actions: A.
        actions: (S,) the actions of a policy that is deterministic and looks at states alone; else None.
        probabilities: (S, B, A): B is 1, or A + 1 for each previously executed action and, last, for none.
    """

    kind = "policy"

    def __init__(self, num_actions: int, probabilities: np.ndarray | None = None, actions: np.ndarray | None = None):
        self.num_actions, self.actions = num_actions, actions
        if probabilities is not None:
            self.probabilities = probabilities

    @cached_property
    def probabilities(self) -> np.ndarray:
        return np.eye(self.num_actions)[self.actions][:, None]

    @staticmethod
    def of(mdp: "TabularMDP", policy: object = None) -> "PolicyTable":
        """From what users write.

        Args:
            policy: (S,) integers, an action for each state; or (S, A) probabilities. Under sticky actions also (S, A +
                1) integers or (S, A + 1, A) probabilities, for each previously executed action and, last, for none; or
                a function from an array of state indices to any of these; None: uniform.
        Rows are divided by their sums in float64, as those of a float32 softmax sum to 1 within 1e-7 only, and what is
        lacking or too much would add up over the steps of an episode; `operations` counts the rounding of that.
        Raises:
            ParameterError: the shape is wrong, or rows are not probabilities that sum to 1 within 1e-6.
        """
        num_states, num_actions = mdp.num_states, mdp.num_actions
        if policy is None:
            return PolicyTable(num_actions, np.full((num_states, 1, num_actions), 1 / num_actions))
        table = np.asarray(policy(np.arange(num_states)) if callable(policy) else policy)
        if table.dtype.kind in "iu":
            _check_actions(mdp, table)
            if table.ndim == 1:
                return PolicyTable(num_actions, actions=table)
            return PolicyTable(num_actions, np.eye(num_actions)[table])
        table = _normalized(mdp, table)
        return PolicyTable(num_actions, table if table.ndim == 3 else table[:, None])

    @property
    def table(self) -> np.ndarray:
        """As users write it: (S,) actions, or (S, A) or (S, A + 1, A) probabilities."""
        if self.actions is not None:
            return self.actions
        return self.probabilities if self.looks_back else self.probabilities[:, 0]

    @property
    def looks_back(self) -> bool:
        """Whether what is chosen depends on the previously executed action."""
        return self.actions is None and self.probabilities.shape[1] > 1

    @cached_property
    def later(self) -> np.ndarray:
        """(S, B, A) after the first step: B is A, or 1 where the previous action does not matter."""
        return np.ascontiguousarray(self.probabilities[:, :-1] if self.looks_back else self.probabilities)

    @cached_property
    def first(self) -> np.ndarray:
        """(S, 1, A) on the first step."""
        return np.ascontiguousarray(self.probabilities[:, -1:])

    @cached_property
    def mass(self) -> float:
        if self.actions is not None:
            return 1.0
        largest = float(self.probabilities.sum(axis=2).max(initial=0.0))
        return mass_of(largest, self.num_actions)

    def operations(self, num_actions: int) -> int:
        return (num_actions + 1) * (1 if self.actions is not None else 2)  # the sum of a row and a division by it

    def value(self, q: np.ndarray, states: States = slice(None)) -> np.ndarray:
        return np.einsum("sba,sa...->sb...", self.later[states], q)

    def first_value(self, q: np.ndarray, states: States = slice(None)) -> np.ndarray:
        return np.einsum("sba,sa...->sb...", self.first[states], q)

    def of_states(self, states: slice) -> "PolicyTable":
        """What it chooses in some states alone."""
        if self.actions is not None:
            return PolicyTable(self.num_actions, actions=np.ascontiguousarray(self.actions[states]))
        return PolicyTable(self.num_actions, np.ascontiguousarray(self.probabilities[states]))

    def chosen(self, mass: np.ndarray) -> np.ndarray:
        """(S, A): how mass (S, W) after the first step chooses actions; the adjoint of `value`."""
        return chosen_mass(self.later, mass)

    def policy(self, q: np.ndarray) -> "PolicyTable":
        return self


def mass_of(largest: float, num_actions: int) -> float:
    """A bound on the sums of probabilities of choosing, from the largest one as floats add it up; at least 1."""
    return max(1.0, largest * (1 + num_actions * 2.0**-53))


def chosen_mass(policy: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """(S, A): how mass (S, W) chooses actions by policy (S, B, A), B = W or 1."""
    if policy.shape[1] == 1:
        return policy[:, 0] * mass.sum(axis=1, keepdims=True)
    return np.einsum("sba,sb->sa", policy, mass)


def _check_actions(mdp: "TabularMDP", actions: np.ndarray) -> None:
    num_states, num_actions = mdp.num_states, mdp.num_actions
    if actions.ndim > 2 or (actions.ndim == 2 and not (mdp.is_sticky and actions.shape[1] == num_actions + 1)):
        raise ParameterError(
            f"the policy has shape {actions.shape}; expected ({num_states},) actions"
            + (f" or ({num_states}, {num_actions + 1}) for each previous action and none" if mdp.is_sticky else "")
        )
    if len(actions) != num_states:
        raise ParameterError(f"the policy has {len(actions)} rows; expected {num_states}, one for each state of {mdp}")
    wrong = np.argwhere((actions < 0) | (actions >= num_actions))
    if len(wrong):
        where = tuple(map(int, wrong[0]))
        raise ParameterError(f"the policy chooses action {actions[where]} at {where}; expected 0 to {num_actions - 1}")


def _normalized(mdp: "TabularMDP", table: np.ndarray) -> np.ndarray:
    """Rows divided by their sums, in float64; those that sum to 1 as they are stay so to the bit."""
    num_states, num_actions = mdp.num_states, mdp.num_actions
    shapes = [(num_states, num_actions)] + ([(num_states, num_actions + 1, num_actions)] if mdp.is_sticky else [])
    if table.shape not in shapes:
        raise ParameterError(
            f"the policy has shape {table.shape}; expected {' or '.join(map(str, shapes))} probabilities"
        )
    table = table.astype(np.float64)
    sums = table.sum(axis=-1)
    if not (np.isfinite(table).all() and (table >= 0).all() and (np.abs(sums - 1) < 1e-6).all()):
        row = np.unravel_index(int(np.argmax(np.where(np.isfinite(sums), np.abs(sums - 1), np.inf))), sums.shape)
        raise ParameterError(
            f"the policy's row {tuple(map(int, row))} is {table[row]}; expected probabilities that sum to 1"
        )
    return table if (sums == 1).all() else table / sums[..., None]
