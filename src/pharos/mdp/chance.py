"""Chance that is added to a world: sticky, random and lazy actions. An MDP in, an MDP out.

Nothing is copied. Which action is executed: an MDP carries three weights, and `Chance` says what they do to values
(`choice`), to distributions (`executed`), to the weights of each action (`weights`) and to single steps (`draw`).
Whether the executed action has an effect: its dynamics carry one probability more, see compiled.py.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.environments import declared_parameters, parameter
from pharos.errors import ParameterError, UnknownName
from pharos.mdp.arguments import require_mdp

if TYPE_CHECKING:
    import numpy.typing as npt

    from pharos.mdp.tabular import TabularMDP


@dataclass(frozen=True)
class Chance:
    """Which action is executed: the chosen one, the previously executed one, or any one; the weights sum to 1.

    On the first step there is no previous action: the chosen one is executed with probability `first_chosen`, else a
    uniform one. (Only where random actions come before sticky ones does this differ from `chosen + previous`.)
    """

    chosen: float = 1.0
    previous: float = 0.0
    uniform: float = 0.0
    first_chosen: float = 1.0

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
        return Chance((1 - p) * self.chosen, self.previous, p * self.chosen + self.uniform, (1 - p) * self.first_chosen)

    def with_sticky(self, p: float) -> "Chance":
        """Sticky actions with probability p, before this chance."""
        _check_probability("sticky_actions", p)
        return Chance((1 - p) * self.chosen, p * self.chosen + self.previous, self.uniform, self.first_chosen)

    # What it is -------------------------------------------------------------------------------------------------------

    @property
    def first_uniform(self) -> float:
        """Probability that a uniform action is executed on the first step."""
        return 1 - self.first_chosen

    @property
    def first(self) -> "Chance":
        """The chance of the first step, which has no previous action."""
        return Chance(self.first_chosen, 0.0, self.first_uniform, self.first_chosen)

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

        False where every step repeats the first.
        """
        return self.chosen > 0 or self.uniform > 0

    @property
    def triple(self) -> tuple[float, float, float]:
        """(chosen, previous, uniform), what kernels take."""
        return float(self.chosen), float(self.previous), float(self.uniform)

    def width(self, num_actions: int) -> int:
        """W: the previous actions that values and distributions distinguish, A under sticky actions, else 1."""
        return num_actions if self.is_sticky else 1

    # What it does -----------------------------------------------------------------------------------------------------

    def choice(self, q: np.ndarray, value: np.ndarray) -> np.ndarray:
        """(N, W, ...): the value of what is executed, given the value of what is chosen; W previous actions.

            V(s, b) = chosen value(s, b) + previous q(s, b) + uniform mean_x q(s, x)

        Args:
            q: (N, A, ...), the values of executing each action.
            value: (N, 1, ...), the value of the chosen action; (N, A, ...) where the choice depends on the previous
                action.
        """
        result = self.chosen * value
        if self.uniform:
            result = result + self.uniform * q.mean(axis=1, keepdims=True)
        return result + self.previous * q if self.previous else result

    def chosen_values(
        self, q: np.ndarray, previous: np.ndarray | None = None, mean: np.ndarray | None = None
    ) -> np.ndarray:
        """(N, A): the values of choosing each action, from those of executing it.

        Args:
            q: (N, A), the values of executing each action.
            previous: (N,) previously executed actions, A where there is none; it matters under sticky actions alone.
            mean: (N, 1), the mean of q over actions, where it was added up already.
        """
        mean = q.mean(axis=1, keepdims=True) if mean is None else mean
        later = self.chosen * q + self.uniform * mean if self.is_random else self.chosen * q
        if previous is None or not self.is_sticky:
            return later
        is_first = (previous == q.shape[1])[:, None]
        repeated = q[np.arange(len(q)), np.minimum(previous, q.shape[1] - 1)][:, None]
        later = self.chosen * q + self.previous * repeated + self.uniform * mean
        return np.where(is_first, self.first_chosen * q + self.first_uniform * mean, later)

    def executed(self, mass: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """(N, A): how the mass of states executes the actions; the adjoint of `choice`.

        Args:
            mass: (N, W), of states, by the previously executed action where that matters.
            chosen: (N, A), the mass that chooses each action.
        """
        result = self.chosen * chosen
        if self.uniform:
            result = result + self.uniform * mass.sum(axis=1, keepdims=True) / chosen.shape[1]
        return result + self.previous * mass if self.previous else result

    def weights(self, chosen: np.ndarray, previous: np.ndarray | None = None) -> np.ndarray:
        """(N, A): the probability that each action is executed.

        Args:
            chosen: (N, A), the probabilities of choosing each action.
            previous: (N,) previously executed actions, A where there is none; it matters under sticky actions alone.
        """
        num_actions = chosen.shape[1]
        later = self.chosen * chosen + self.uniform / num_actions
        if previous is None or not self.is_sticky:
            return later
        later = later + self.previous * (np.asarray(previous)[:, None] == np.arange(num_actions))
        is_first = (np.asarray(previous) == num_actions)[:, None]
        return np.where(is_first, self.first_chosen * chosen + self.first_uniform / num_actions, later)

    def draw(self, chosen: np.ndarray, previous: np.ndarray, num_actions: int, rng: np.random.Generator) -> np.ndarray:
        """(N,): executed actions at random. previous (N,), A where there is none. Draws 2 N numbers of `rng`."""
        u, is_first = rng.random(len(chosen)), previous == num_actions
        uniform = np.where(is_first, u >= self.first_chosen, u >= self.chosen + self.previous)
        sticks = ~is_first & ~uniform & (u >= self.chosen)
        anything = rng.integers(num_actions, size=len(chosen))
        return np.where(sticks, previous, np.where(uniform, anything, chosen))

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return dict(vars(self))


@dataclass(frozen=True)
class ChanceSetting:
    """What is added to an environment: chance of acting, which changes the MDP, and how rewards are paid, which does
    not: values and regret are those of the rewards as they are earned.

    Attributes:
        sticky: probability that the previous action is executed again.
        random: probability that a uniformly random action is executed. With both the choice is replaced first, and then
            may stick: `random_actions(sticky_actions(mdp, sticky), random)`.
        lazy: probability that the action has no effect. The state stays what it is, and what the rules pay for that is
            paid, as `lazy_actions` has it.
        reward_noise: standard deviation of noise in what is paid; 0 on average.
        reward_delay: steps by which rewards are paid late, the last at the end.
    Raises:
        ParameterError: one of them is out of range.
    """

    sticky: float = parameter(0.0, low=0, high=1)
    random: float = parameter(0.0, low=0, high=1)
    lazy: float = parameter(0.0, low=0, high=1)
    reward_noise: float = parameter(0.0, low=0)
    reward_delay: int = parameter(0, low=0)

    def __post_init__(self) -> None:
        for name, declared in declared_parameters(ChanceSetting).items():
            value = getattr(self, name)
            number = declared.checked(self, name, value)
            if not isinstance(value, int | float):  # a number of NumPy
                object.__setattr__(self, name, number)
        if self.lazy == 1:
            raise ParameterError("ChanceSetting: lazy=1, so nothing ever happens; expected a number below 1")

    @staticmethod
    def from_dict(entry: Mapping[str, float]) -> "ChanceSetting":
        """Read `{"sticky": .., "random": ..}`; what is left out is 0.

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
        """`{"sticky": .., "random": ..}`, and the others where they are not 0."""
        return {name: value for name, value in vars(self).items() if value or name in ("sticky", "random")}

    @property
    def modifies_rewards(self) -> bool:
        """Whether rewards are paid late or with noise."""
        return bool(self.reward_noise or self.reward_delay)

    @property
    def changes_mdp(self) -> bool:
        """Whether there is chance of acting."""
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
        return ", ".join(parts) or "none"

    def __bool__(self) -> bool:
        return any(vars(self).values())

    def __str__(self) -> str:
        """`plain`, `sticky 0.25`, `random 0.1`, or several of them."""
        return ", ".join(f"{name} {value:g}" for name, value in vars(self).items() if value) or "plain"


@require_mdp
def random_actions(mdp: "TabularMDP", p: float) -> "TabularMDP":
    """The MDP in which, with probability p, the executed action is uniform over all A actions.

    Q(s, a) = (1 - p) q(s, a) + p mean_b q(s, b), where q(s, x) = r(s, x) + gamma V(next(s, x)).
    Combined with sticky actions: this chance comes before that of `mdp`, so `random_actions(sticky_actions(mdp, p), r)`
    replaces the choice of the agent, and then the previous action may be executed instead.

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
    Gymnasium's StickyAction). Combined with random actions: this chance comes before that of `mdp`.

    Raises:
        ParameterError: p is not in [0, 1].
    Source: Machado et al. (2018), section 5; the pharos paper, appendix A.
    """
    return replace(mdp, chance=mdp.chance.with_sticky(p))


@require_mdp
def lazy_actions(mdp: "TabularMDP", p: float, *, staying: "npt.ArrayLike | None" = None) -> "TabularMDP":
    """The MDP in which, with probability p, the executed action has no effect: the state stays what it is.

        q(s, a) = (1 - p) [r(s, a) + gamma E V(next)] + p [r(s, a, s) + gamma V(s)]

    Its chance comes after that of sticky and random actions, in whatever order they are added: first it is drawn which
    action is executed, then whether it has an effect. An action without effect is the previous one of the next step.
    Colosseum's `p_lazy`; its `p_rand` is `random_actions`.

    Args:
        p: in [0, 1).
        staying: (S, A) what staying pays. None: what the rules pay for going from s to s by a, where the MDP is of a
            state space; else r(s, a), as the rewards of a table belong to state and action alone.
    Returns:
        An MDP without ages: a state can be met twice.
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
