"""Options of solving, for keywords of Python and flags of the command line; and solutions: values with error bounds."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import DTypeLike

from pharos.errors import ParameterError
from pharos.mdp import STEPS_EXPECTED, available_choices, whole_number

if TYPE_CHECKING:
    from pharos.mdp import Selection, TabularMDP

_GREEDY_BLOCK = 1 << 20  # states whose greedy actions are worked out in one go


@dataclass(frozen=True, kw_only=True)
class Solving:
    """Options of solving that go together.

    Attributes:
        tolerance: largest error of a value, in units of return. It is proven.
        horizon: number of steps to go, instead of the MDP's own. It means backward induction, without keeping the
            steps.
        keep_all: with a horizon, keep the values of every step as `all_steps`, (T + 1, S), under sticky actions (T + 1,
            S, A): row t has t steps to go.
        progress: called after each sweep with its number and the bound so far, and as often while equations are solved.
        values: a file (.npy) that holds the values while they are computed, in place of memory, and afterwards. Sweeps
            begin with what it holds already, so that a solve that was killed goes on. Large ones that memory has room
            for are swept there, and copied to the file every ten minutes and in the end, whatever ends it. None:
            memory, or, if that has little room, a file without a name.
        processes: 1, or "mpi" for the processes that `mpiexec` has started, all of which make this call, and sweep a
            range of the states each. The first gets the Solution, the others None. Values depend on it within the
            tolerance, except with a horizon.
        checkpoint: a folder for the values so far, once a minute, so that the same call goes on after one was killed,
            with any number of processes.
        threads: threads of a sweep. Beyond one, last digits may differ, within the error. They share the states if
            no action is sticky and transitions are in arrays.
        dtype: type of the stored values: float64, or float32, half the memory, and a bound that counts it. So a
            tolerance below 1.2e-7 max |V| / (1 - gamma) is out of reach. For one process, and no horizon.
    Raises:
        ParameterError: an option is out of range. Or float32 with a horizon or several processes, a file of values with
            a horizon or several processes, all steps with several processes.
    """

    tolerance: float = 1e-6
    horizon: int | None = None
    keep_all: bool = False
    progress: Callable[[int, float], None] | None = None
    values: str | os.PathLike | None = None
    processes: int | str = 1
    checkpoint: str | os.PathLike | None = None
    threads: int = 1
    dtype: str = "float64"

    def __post_init__(self) -> None:
        tolerance = self.tolerance
        if not (isinstance(tolerance, int | float | np.floating) and np.isfinite(tolerance) and tolerance > 0):
            raise ParameterError(f"tolerance is {tolerance!r}; expected a positive number, in units of return")
        if self.horizon is not None:
            object.__setattr__(self, "horizon", whole_number(self.horizon, "horizon", STEPS_EXPECTED))
        object.__setattr__(self, "dtype", _dtype_name(self.dtype))
        whole_number(self.threads, "threads")
        if self.dtype == "float32" and (self.horizon is not None or self.is_distributed):
            raise ParameterError("dtype='float32' is for one process and no horizon; expected 'float64' here")
        if self.is_distributed and self.keep_all:
            raise ParameterError("keep_all: several processes keep the last step alone; expected processes=1")
        if self.is_distributed and self.values is not None:
            raise ParameterError("values: several processes keep theirs in a folder; expected checkpoint=FOLDER")
        if self.horizon is not None and self.values is not None:
            raise ParameterError(
                f"values={str(self.values)!r}: a file keeps values without a horizon; found {self.horizon} steps"
            )

    @staticmethod
    def of(mdp: "TabularMDP", tolerance: "float | Solving", options: Mapping[str, Any]) -> "Solving":
        """The options of solving an MDP: an object, with changes, or of a tolerance. The horizon is the MDP's own if
        none is given."""
        options = dict(options) if isinstance(tolerance, Solving) else {"tolerance": tolerance, **options}
        solving = replace(tolerance if isinstance(tolerance, Solving) else Solving(), **options)
        return solving if solving.horizon is not None else replace(solving, horizon=mdp.horizon)

    @property
    def is_distributed(self) -> bool:
        """Whether several processes or a checkpoint are requested (`True` is no number of processes)."""
        return self.processes != 1 or self.processes is True or self.checkpoint is not None


def _dtype_name(dtype: DTypeLike) -> str:
    try:
        name = np.dtype(dtype).name
    except TypeError:
        name = ""
    if name not in ("float64", "float32"):
        raise ParameterError(f"dtype is {dtype!r}; expected 'float64' or 'float32'")
    return name


class SolvingOptions(TypedDict, total=False):
    """Keywords of the fields of `Solving`, but for the tolerance, for editors and type checkers."""

    horizon: int | None
    keep_all: bool
    progress: Callable[[int, float], None] | None
    values: str | os.PathLike | None
    processes: int | str
    checkpoint: str | os.PathLike | None
    threads: int
    dtype: DTypeLike


@dataclass(frozen=True, eq=False)
class Solution:
    """Values of the optimal policy, or of a given one.

    Attributes:
        mdp: what was solved.
        error_bound: every entry of `v` and `q` is within this of the true value (proven, in units of return). If the
            probabilities of the MDP were rounded, also of the true value of each MDP within its `residual`. That part
            may exceed the tolerance.
        sweeps, seconds: cost of the solve. Compiling is not among the seconds.
        horizon: number of steps to go of the values, or None.
        select: which action is chosen: the best one, the worst one, or the action of a policy.
        x: (S + 1, W) float64, or float32 if it was asked for: values of (state, previously executed action), W = A
            under sticky actions, else 1. Row S, the end, is 0.
        next_x: the values of next states: x, or with a horizon those with one step less to go.
        proper: of total rewards, the policy: (S,) actions, or (S, A + 1) if it must look at the previous action. Greedy
            ones may go round in a circle, as every state of it has the same value.
        all_steps: with a horizon, if they were kept: (T + 1, S), or (T + 1, S, A), row t with t steps to go.

    Under sticky actions values belong to pairs: `v` is (S, A), the value of (state, previously executed action), and
    `q` is (S, A), the value of executing an action. Otherwise `v` is (S,), and `q` (S, A) is the value of choosing an
    action.
    """

    mdp: "TabularMDP"
    error_bound: float
    sweeps: int
    seconds: float
    horizon: int | None
    select: "Selection"
    x: np.ndarray
    next_x: np.ndarray
    all_steps: np.ndarray | None = None
    proper: np.ndarray | None = None

    @property
    def gamma(self) -> float:
        """The discount of the values."""
        return self.mdp.gamma

    @property
    def kind(self) -> str:
        """ "optimal", "worst" or "policy"."""
        return self.select.kind

    @property
    def v(self) -> np.ndarray:
        """(S,) values, (S, A) under sticky actions."""
        return self.mdp.without_width(self.x[:-1])

    @property
    def q(self) -> np.ndarray:
        """(S, A) action values: of choosing, or of executing under sticky actions. Computed anew by each call.

        Of actions that are not available -inf (inf in the solution of the worst policy), which no choice takes.
        """
        executed = self.q_of(slice(None))
        values = executed if self.mdp.is_sticky else self.mdp.chance.choice(executed, executed)
        if self.mdp.available is None:
            return values
        return np.where(self.mdp.available, values, np.inf if self.kind == "worst" else -np.inf)

    def q_of(self, states: np.ndarray | slice) -> np.ndarray:
        """(N, A), the values of executing each action in some states (indices or a slice).

        An action that is not available has the value of the first one that is, as which it acts.
        """
        next_values = self.mdp.dynamics.expected(self.next_x, states).astype(np.float64, copy=False)
        next_values = self.mdp.acting(next_values, states)
        return self.mdp.reward_table.rows(states) + self.mdp.gamma * next_values

    @cached_property
    def policy(self) -> np.ndarray:
        """The policy: for "optimal" and "worst" (S,) greedy actions, the first among equals. Otherwise the policy that
        was passed.

        Of total rewards (gamma 1, no horizon) it ends almost surely, unless it stays in a component in which nothing is
        paid. Under sticky actions that may take (S, A + 1) actions, by the previous action.
        """
        if self.proper is not None:
            return self.proper
        policy_table = self.given_policy
        if policy_table is not None:
            return policy_table
        actions = np.empty(self.mdp.num_states, np.int64)
        for start in range(0, self.mdp.num_states, _GREEDY_BLOCK):
            block = slice(start, min(start + _GREEDY_BLOCK, self.mdp.num_states))
            greedy = self.select.policy(self.q_of(block)).table
            sets = None if self.mdp.available is None else self.mdp.available[block]
            actions[block] = available_choices(greedy, sets)
        return actions

    @property
    def given_policy(self) -> np.ndarray | None:
        """The policy that was evaluated: (S,) actions, (S, A) or (S, A + 1, A) probabilities. Otherwise None."""
        return getattr(self.select, "table", None)

    def optimal_actions(self, tie_tolerance: float = 1e-6) -> np.ndarray:
        """(S, A) bool: actions whose value is within `tie_tolerance` of the best."""
        q = self.q
        return q >= q.max(axis=1, keepdims=True) - tie_tolerance

    @property
    def value_at_start(self) -> float:
        """The expected value of an episode's first state."""
        return self.value_from(self.mdp.start_states, self.mdp.start_probabilities)

    def value_from(self, starts: np.ndarray, probabilities: np.ndarray) -> float:
        """The expected value of an episode's first state, drawn from other states or probabilities (N,)."""
        if not self.mdp.is_sticky:
            return float(probabilities @ self.v[starts])
        q = self.q_of(starts)
        chance = self.mdp.chance.first.at(starts)
        return float(probabilities @ chance.choice(q, self.select.first_value(q, starts))[:, 0])

    def conventions(self) -> dict[str, Any]:
        """Discount, horizon, kind and error bound of the values, JSON-able."""
        return {"gamma": self.gamma, "horizon": self.horizon, "kind": self.kind, "error_bound": self.error_bound}

    def __repr__(self) -> str:
        return (
            f"Solution({self.kind}, value_at_start={self.value_at_start:.6g}, error_bound={self.error_bound:.2g}, "
            f"sweeps={self.sweeps}, seconds={self.seconds:.2f})"
        )
