"""Selection of the action that is chosen, and chance that decides which one is executed.

Chosen (`Selection`): the best action, the worst one, or the action of a policy. The Bellman equations of optimal
values, worst values and values of a policy differ in nothing else.

Executed (`Chance`): sticky, random and lazy actions are added to a world, an MDP in, an MDP out, and nothing is copied:
an MDP carries three weights, and `Chance` applies them to values (`choice`), to distributions (`executed`), to the
weights of each action (`weights`) and to single steps (`draw`). Lazy actions, which may have no effect, are one more
probability of the dynamics, see table.py.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from pharos.environments import declared_parameters, parameter
from pharos.errors import ParameterError, UnknownName
from pharos.mdp.action_sets import check_choices, uniform_choice
from pharos.mdp.arguments import require_mdp
from pharos.system.arrays import read_only

if TYPE_CHECKING:
    import numpy.typing as npt

    from pharos.mdp.tabular import TabularMDP


States = slice | np.ndarray
"""Some states: a range, or their numbers (N,)."""


class Selection(Protocol):
    """Choice of an action, given the values of executing each one.

    Attributes:
        kind: of a solution: "optimal", "worst" or "policy".
        mass: the largest sum of the probabilities of choosing, at least 1.
        operations: rounding operations, at most, of the value of the choice.
    """

    @property
    def kind(self) -> str: ...

    @property
    def mass(self) -> float: ...

    def operations(self, num_actions: int) -> int: ...

    def value(self, q: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, 1, ...) value of the choice, from q (N, A, ...) of some states, or (N, A, ...) by the previous action."""

    def first_value(self, q: np.ndarray, states: States = slice(None)) -> np.ndarray:
        """(N, 1, ...) value of the choice on the first step, without a previous action."""

    def policy(self, q: np.ndarray) -> "PolicyTable":
        """The choice as a policy: the first of the best or worst actions, or the policy itself."""


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
    """Policy over states, as a table of actions or of probabilities.

    Attributes:
        num_actions: A.
        actions: (S,) the actions of a policy that is deterministic and looks at states alone, else None.
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
        """Make the table of a policy in any form that users write.

        Args:
            policy: (S,) integers, an action for each state, or (S, A) probabilities. Under sticky actions also (S, A +
                1) integers or (S, A + 1, A) probabilities, for each previously executed action and, last, for none. Or
                a function from an array of state indices to any of these. Default: uniform.
        Rows are divided by their sums in float64: rows of a float32 softmax sum to 1 within 1e-7 only, and the
        difference would add up over the steps of an episode. `operations` counts the rounding of the division.
        Raises:
            ParameterError: the shape is wrong, or rows are not probabilities that sum to 1 within 1e-6, or have an
                action that is not available.
        """
        num_states, num_actions = mdp.num_states, mdp.num_actions
        if policy is None:
            return PolicyTable(num_actions, uniform_choice(mdp)[:, None])
        table = np.asarray(policy(np.arange(num_states)) if callable(policy) else policy)
        if table.dtype.kind in "iu":
            _check_actions(mdp, table)
            if table.ndim == 1:
                return PolicyTable(num_actions, actions=table)
            return PolicyTable(num_actions, np.eye(num_actions)[table])
        table = _rows_of_sum_one(mdp, table)
        check_choices(table, mdp.available)
        return PolicyTable(num_actions, table if table.ndim == 3 else table[:, None])

    @property
    def table(self) -> np.ndarray:
        """The policy as users write it: (S,) actions, or (S, A) or (S, A + 1, A) probabilities."""
        if self.actions is not None:
            return self.actions
        return self.probabilities if self.looks_back else self.probabilities[:, 0]

    @property
    def looks_back(self) -> bool:
        """Whether the choice depends on the previously executed action."""
        return self.actions is None and self.probabilities.shape[1] > 1

    @cached_property
    def later(self) -> np.ndarray:
        """(S, B, A) probabilities after the first step: B is A, or 1 if the previous action does not matter."""
        return np.ascontiguousarray(self.probabilities[:, :-1] if self.looks_back else self.probabilities)

    @cached_property
    def first(self) -> np.ndarray:
        """(S, 1, A) probabilities on the first step."""
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
        """The policy of some states alone."""
        if self.actions is not None:
            return PolicyTable(self.num_actions, actions=np.ascontiguousarray(self.actions[states]))
        return PolicyTable(self.num_actions, np.ascontiguousarray(self.probabilities[states]))

    def policy(self, q: np.ndarray) -> "PolicyTable":
        return self


def mass_of(largest: float, num_actions: int) -> float:
    """A bound on the sums of probabilities of choosing, from the largest one as floats add it up, at least 1."""
    return max(1.0, largest * (1 + num_actions * 2.0**-53))


def chosen_mass(policy: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """(S, A) mass that chooses each action, of the mass of states (S, W), by a policy (S, B, A), B = W or 1."""
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
    if mdp.available is not None:
        check_choices(np.eye(num_actions, dtype=bool)[actions], mdp.available)


def _rows_of_sum_one(mdp: "TabularMDP", table: np.ndarray) -> np.ndarray:
    """Rows divided by their sums, in float64. Rows that sum to 1 as they are stay so to the bit."""
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


# Chance that is added -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Chance:
    """Weights of executing the chosen action, the previously executed one, or a uniform one. They sum to 1.

    On the first step there is no previous action: the chosen one is executed with probability `first_chosen`, else a
    uniform one. (Only if random actions come before sticky ones, this differs from `chosen + previous`.)

    If some actions are not available, the uniform action is one of the available ones. A previous one that is not
    available counts as none, as in the first step.

    Attributes:
        available: (N, A) bool, the sets of the states that values and distributions are of, see `at`. None: all.
    """

    chosen: float = 1.0
    previous: float = 0.0
    uniform: float = 0.0
    first_chosen: float = 1.0
    available: np.ndarray | None = field(default=None, compare=False, repr=False)

    @staticmethod
    def of(sticky: float = 0.0, random: float = 0.0) -> "Chance":
        """The chance of `random_actions(sticky_actions(mdp, sticky), random)`.

        Raises:
            ParameterError: a probability is not in [0, 1].
        """
        return Chance().with_sticky(sticky).with_random(random)

    def with_random(self, p: float) -> "Chance":
        """Random actions with probability p, before this chance."""
        _check_probability("random_actions", p)
        chosen, uniform = (1 - p) * self.chosen, p * self.chosen + self.uniform
        return replace(self, chosen=chosen, uniform=uniform, first_chosen=(1 - p) * self.first_chosen)

    def with_sticky(self, p: float) -> "Chance":
        """Sticky actions with probability p, before this chance."""
        _check_probability("sticky_actions", p)
        return replace(self, chosen=(1 - p) * self.chosen, previous=p * self.chosen + self.previous)

    # What it is -------------------------------------------------------------------------------------------------------

    @property
    def first_uniform(self) -> float:
        """Probability that a uniform action is executed on the first step."""
        return 1 - self.first_chosen

    @property
    def first(self) -> "Chance":
        """The chance of the first step, which has no previous action."""
        return replace(self, chosen=self.first_chosen, previous=0.0, uniform=self.first_uniform)

    @property
    def is_none(self) -> bool:
        """Whether the chosen action is always executed."""
        return not (self.is_sticky or self.is_random)

    @property
    def is_sticky(self) -> bool:
        """Whether values and distributions belong to pairs (state, previously executed action)."""
        return self.previous > 0

    @property
    def is_random(self) -> bool:
        """Whether a uniform action is executed now and then."""
        return self.uniform > 0

    @property
    def executes_any(self) -> bool:
        """Whether any action can be executed after any other, by some choice.

        False if every step repeats the first.
        """
        return self.chosen > 0 or self.uniform > 0

    @property
    def triple(self) -> tuple[float, float, float]:
        """(chosen, previous, uniform)."""
        return float(self.chosen), float(self.previous), float(self.uniform)

    @property
    def for_kernels(self) -> tuple[Any, ...]:
        """The argument `weights` of kernels: `triple`, with `first_chosen` and the sets if chance depends on them."""
        if self.available is None or self.is_none:
            return self.triple
        return (*self.triple, float(self.first_chosen), read_only(self.available))

    @property
    def uniform_for_kernels(self) -> "float | tuple[float, np.ndarray]":
        """The argument `uniform` of kernels: the weight, with the sets if it depends on them."""
        if self.available is None or not self.is_random:
            return self.uniform
        return float(self.uniform), read_only(self.available)

    def at(self, states: States) -> "Chance":
        """The chance in some states, of which the methods below take rows. The same if all actions are available."""
        return self if self.available is None else replace(self, available=self.available[states])

    def width(self, num_actions: int) -> int:
        """W: the previous actions that values and distributions distinguish, A under sticky actions, else 1."""
        return num_actions if self.is_sticky else 1

    # What it does -----------------------------------------------------------------------------------------------------

    def choice(self, q: np.ndarray, value: np.ndarray) -> np.ndarray:
        """(N, W, ...): the value of the executed action, from the value of the chosen one, for W previous actions.

            V(s, b) = chosen value(s, b) + previous q(s, b) + uniform mean_x q(s, x)

        Args:
            q: (N, A, ...), the values of executing each action.
            value: (N, 1, ...), the value of the chosen action. (N, A, ...) if the choice depends on the previous
                action.
        """
        result = self.chosen * value
        if self.uniform:
            result = result + self.uniform * self.mean(q)
        if self.available is not None and self.previous:
            is_repeated = self.available.reshape(self.available.shape + (1,) * (q.ndim - 2))
            as_first = self.first_chosen * value + self.first_uniform * self.mean(q)
            return np.where(is_repeated, result + self.previous * q, as_first)
        return result + self.previous * q if self.previous else result

    def mean(self, q: np.ndarray) -> np.ndarray:
        """(N, 1, ...): the mean of q (N, A, ...) over the actions that are available."""
        if self.available is None:
            return q.mean(axis=1, keepdims=True)
        shape = self.available.shape + (1,) * (q.ndim - 2)
        total = np.where(self.available.reshape(shape), q, 0.0).sum(axis=1, keepdims=True)
        return np.asarray(total / self.available.sum(axis=1).reshape((-1, 1) + (1,) * (q.ndim - 2)))

    def shares(self, num_actions: int) -> "float | np.ndarray":
        """The probability of each action when a uniform one is executed: 1 / A, or (N, A) if sets decide it."""
        if self.available is None:
            return 1 / num_actions
        return np.asarray(self.available / self.available.sum(axis=1, keepdims=True))

    def chosen_values(
        self, q: np.ndarray, previous: np.ndarray | None = None, mean: np.ndarray | None = None
    ) -> np.ndarray:
        """(N, A): the values of choosing each action, from the values of executing it.

        Args:
            q: (N, A), the values of executing each action.
            previous: (N,) previously executed actions, A if there is none. It matters under sticky actions alone.
            mean: (N, 1), the mean of q over actions, if it was added up already.
        """
        mean = self.mean(q) if mean is None or self.available is not None else mean
        later = self.chosen * q + self.uniform * mean if self.is_random else self.chosen * q
        if previous is None or not self.is_sticky:
            return later
        is_first = self._is_first(previous, q.shape[1])
        repeated = q[np.arange(len(q)), np.minimum(previous, q.shape[1] - 1)][:, None]
        later = self.chosen * q + self.previous * repeated + self.uniform * mean
        return np.where(is_first, self.first_chosen * q + self.first_uniform * mean, later)

    def executed(self, mass: np.ndarray, policy: np.ndarray) -> np.ndarray:
        """(N, A): the mass that executes each action, the adjoint of `choice`.

        Args:
            mass: (N, W), of states, by the previously executed action if that matters.
            policy: (N, B, A) probabilities of choosing, B = W or 1.
        """
        if self.available is not None and self.previous:  # what cannot be repeated is as on the first step
            can_be = np.where(self.available, mass, 0.0)
            others = np.where(self.available, 0.0, mass)
            uniform = self.first_uniform * others.sum(axis=1, keepdims=True) * self.shares(policy.shape[2])
            return self._executed(can_be, policy) + self.first_chosen * chosen_mass(policy, others) + uniform
        return self._executed(mass, policy)

    def _executed(self, mass: np.ndarray, policy: np.ndarray) -> np.ndarray:
        result = self.chosen * chosen_mass(policy, mass)
        if self.uniform:
            uniform = self.uniform * mass.sum(axis=1, keepdims=True)
            shares = self.shares(policy.shape[2])
            result = result + (uniform / policy.shape[2] if self.available is None else uniform * shares)
        return result + self.previous * mass if self.previous else result

    def _is_first(self, previous: np.ndarray, num_actions: int) -> np.ndarray:
        """(N, 1) bool: whether there is no previous action (N,) that can be repeated."""
        previous = np.asarray(previous)
        if self.available is None:
            return np.asarray((previous == num_actions)[:, None])
        repeated = self.available[np.arange(len(previous)), np.minimum(previous, num_actions - 1)]
        return np.asarray(~((previous < num_actions) & repeated)[:, None])

    def weights(self, policy: np.ndarray, previous: np.ndarray | None = None) -> np.ndarray:
        """(N, A): the probability that each action is executed.

        Args:
            policy: (N, A), the probabilities of choosing each action.
            previous: (N,) previously executed actions, A if there is none. It matters under sticky actions alone.
        """
        num_actions = policy.shape[1]
        if self.available is None:
            uniform, first_uniform = self.uniform / num_actions, self.first_uniform / num_actions
        else:
            uniform, first_uniform = (each * self.shares(num_actions) for each in (self.uniform, self.first_uniform))
        later = self.chosen * policy + uniform
        if previous is None or not self.is_sticky:
            return later
        later = later + self.previous * (np.asarray(previous)[:, None] == np.arange(num_actions))
        is_first = self._is_first(previous, num_actions)
        return np.where(is_first, self.first_chosen * policy + first_uniform, later)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {name: value for name, value in vars(self).items() if name != "available"}


RANGE = "range"
"""V* - U, as a number by which rewards are divided."""


@dataclass(frozen=True)
class ChanceSetting:
    """Chance added to an environment: of acting, which changes the MDP, and noise and delay of rewards, which do not.

    Values and regret count the rewards as they are earned.

    Attributes:
        sticky: probability that the previous action is executed again.
        random: probability that a uniformly random action is executed. With both the choice is replaced first, and then
            may stick: `random_actions(sticky_actions(mdp, sticky), random)`.
        lazy: probability that the action has no effect. The state stays what it is, and what the rules pay for that is
            paid, as `lazy_actions` has it.
        reward_noise: standard deviation of noise in what is paid, 0 on average.
        reward_delay: steps by which rewards are paid late, the last at the end.
        scale_rewards: what is earned is divided by this number before noise and delay. `range` stands for V* - U, the
            value of optimal less the value of uniform play.
    Raises:
        ParameterError: one of them is out of range.
    """

    sticky: float = parameter(0.0, low=0, high=1)
    random: float = parameter(0.0, low=0, high=1)
    lazy: float = parameter(0.0, low=0, high=1)
    reward_noise: float = parameter(0.0, low=0)
    reward_delay: int = parameter(0, low=0)
    scale_rewards: str = ""

    def __post_init__(self) -> None:
        if self.scale_rewards not in ("", RANGE):
            try:
                divisor = float(self.scale_rewards)
            except (TypeError, ValueError):
                divisor = math.nan
            if not 0 < divisor < math.inf:
                raise ParameterError(
                    f"ChanceSetting: scale_rewards is {self.scale_rewards!r}; expected a number above 0, or {RANGE}"
                )
            object.__setattr__(self, "scale_rewards", repr(divisor))
        for name, declared in declared_parameters(ChanceSetting).items():
            value = getattr(self, name)
            number = declared.checked(self, name, value)
            if not isinstance(value, int | float):  # a number of NumPy
                object.__setattr__(self, name, number)
        if self.lazy == 1:
            raise ParameterError("ChanceSetting: lazy=1, so nothing ever happens; expected a number below 1")

    @staticmethod
    def from_dict(entry: Mapping[str, float]) -> "ChanceSetting":
        """Read `{"sticky": .., "random": ..}`. What is left out is 0.

        Raises:
            UnknownName: another kind of chance. ParameterError: one is out of range.
        """
        for name in entry:
            if name not in ChanceSetting.__dataclass_fields__:
                raise UnknownName("kind of chance", name, ChanceSetting.__dataclass_fields__)
        delay = entry.get("reward_delay", 0)
        whole = int(delay) if isinstance(delay, float) and delay.is_integer() else delay  # as `--chance` reads it
        return ChanceSetting(**{**entry, "reward_delay": whole})  # type: ignore[arg-type]

    def to_dict(self) -> dict[str, float]:
        """`{"sticky": .., "random": ..}`, and the others if they are not 0."""
        entry = {name: value for name, value in vars(self).items() if value or name in ("sticky", "random")}
        is_number = self.scale_rewards not in ("", RANGE)
        return {**entry, "scale_rewards": float(self.scale_rewards)} if is_number else entry

    @property
    def modifies_rewards(self) -> bool:
        """Whether rewards are paid late, with noise, or in another unit."""
        return bool(self.reward_noise or self.reward_delay or self.scale_rewards)

    @property
    def reward_scale(self) -> float:
        """The number by which rewards are divided, 1 if by none.

        Raises:
            ParameterError: it is `range`, which takes a task (`pharos.training.Task.scaled_chance`).
        """
        if self.scale_rewards == RANGE:
            raise ParameterError(f"scale_rewards is {RANGE}, which training knows; expected a number here")
        return float(self.scale_rewards or 1.0)

    @property
    def changes_mdp(self) -> bool:
        """Whether there is chance of acting, which changes the MDP."""
        return bool(self.sticky or self.random or self.lazy)

    def of(self, mdp: "TabularMDP") -> "TabularMDP":
        """The MDP with this chance added."""
        mdp = lazy_actions(mdp, self.lazy) if self.lazy else mdp
        mdp = sticky_actions(mdp, self.sticky) if self.sticky else mdp
        return random_actions(mdp, self.random) if self.random else mdp

    def in_words(self, of_the_world: bool = False) -> str:
        """`sticky actions 0.25, reward noise 0.5`, or "none".

        Args:
            of_the_world: whether executing an action may have several outcomes itself.
        """
        parts = ["of the world"] * of_the_world
        parts += [f"{name} actions {p:g}" for name in ("sticky", "random", "lazy") if (p := getattr(self, name))]
        parts += [f"reward noise {self.reward_noise:g}"] * bool(self.reward_noise)
        parts += [f"rewards {self.reward_delay} steps late"] * bool(self.reward_delay)
        parts += [f"rewards divided by {self.to_dict().get('scale_rewards')}"] * bool(self.scale_rewards)
        return ", ".join(parts) or "none"

    def __bool__(self) -> bool:
        return any(vars(self).values())

    def __str__(self) -> str:
        """`plain`, `sticky 0.25`, `random 0.1`, or several of them."""
        named = {name: value for name, value in self.to_dict().items() if value}
        texts = (f"{name} {value if isinstance(value, str) else f'{value:g}'}" for name, value in named.items())
        return ", ".join(texts) or "plain"


@require_mdp
def random_actions(mdp: "TabularMDP", p: float) -> "TabularMDP":
    """The MDP in which, with probability p, the executed action is uniform over all that are available.

    Q(s, a) = (1 - p) q(s, a) + p mean_b q(s, b), where q(s, x) = r(s, x) + gamma V(next(s, x)).
    Combined with sticky actions: this chance comes before the chance of `mdp`. So with
    `random_actions(sticky_actions(mdp, p), r)` the choice of the agent is replaced first, and then the previous action
    may be executed instead.

    Raises:
        ParameterError: p is not in [0, 1].
    Source: the pharos paper, section 3.3 and appendix A; Conserva and Rauber (2022).
    """
    return replace(mdp, chance=mdp.chance.with_random(p))


@require_mdp
def sticky_actions(mdp: "TabularMDP", p: float) -> "TabularMDP":
    """The MDP in which, with probability p, the previously executed action is executed again.

    V(s, b) = (1 - p) max_a q(s, a) + p q(s, b), where b is the previously executed action and q(s, x) the value of
    executing x. On the first step of an episode there is no previous action: the chosen one is executed (as in
    Gymnasium's StickyAction). A previous action b that is not available counts as none: V(s, b) = max_a q(s, a).
    Combined with random actions: this chance comes before the chance of `mdp`.

    Raises:
        ParameterError: p is not in [0, 1].
    Source: Machado et al. (2018), section 5; the pharos paper, appendix A.
    """
    return replace(mdp, chance=mdp.chance.with_sticky(p))


@require_mdp
def lazy_actions(mdp: "TabularMDP", p: float, *, staying: "npt.ArrayLike | None" = None) -> "TabularMDP":
    """The MDP in which, with probability p, the executed action has no effect: the state stays what it is.

        q(s, a) = (1 - p) [r(s, a) + gamma E V(next)] + p [r(s, a, s) + gamma V(s)]

    Its chance comes after the chance of sticky and random actions, in whatever order they are added: first it is drawn
    which action is executed, then whether it has an effect. An action without effect is the previous one of the next
    step. It is Colosseum's `p_lazy`. Its `p_rand` is `random_actions`.

    The mean of both rewards is exact if they are equal. Otherwise the bound of values counts its rounding.

    Args:
        p: in [0, 1).
        staying: (S, A) what staying pays. None: what the rules pay for going from s to s by a, if the MDP is of a state
            space, else r(s, a), as the rewards of a table belong to state and action alone.
    Returns:
        An MDP without ages: a state can be visited twice.
    Raises:
        ParameterError: p is not in [0, 1), or `staying` has another shape.
    Cost: an array of rewards. One more term in each expectation.
    Source: Conserva and Rauber (2022), "Hardness in Markov decision processes: theory and practice", appendix.
    """
    _check_probability("lazy_actions", p)
    if p == 1:
        raise ParameterError("lazy_actions: probability is 1, so nothing ever happens; expected a number in [0, 1)")
    return mdp.lazy(float(p), staying) if p else mdp


def _check_probability(name: str, p: float) -> None:
    if not (isinstance(p, int | float) and math.isfinite(p) and 0 <= p <= 1):
        raise ParameterError(f"{name}: probability is {p!r}; expected a number in [0, 1]")
