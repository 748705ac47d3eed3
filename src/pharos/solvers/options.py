"""Options of solving, declared once: for keywords of Python and flags of the command line."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import DTypeLike

from pharos.errors import ParameterError
from pharos.mdp import STEPS_EXPECTED, whole_number

if TYPE_CHECKING:
    from pharos.mdp import TabularMDP


@dataclass(frozen=True, kw_only=True)
class Solving:
    """Options of solving that go together.

    Attributes:
        tolerance: largest error of a value, in units of return. It is proven.
        horizon: number of steps to go, instead of the MDP's own; backward induction then, without keeping the steps.
        keep_all: with a horizon, keep the values of every step as `all_steps`, (T + 1, S), under sticky actions (T + 1,
            S, A): row t has t steps to go.
        progress: called after each sweep with its number and the bound so far, and as often while equations are solved.
        values: a file (.npy) that holds the values while they are computed, in place of memory, and afterwards; what
            it holds already is what the sweeps begin with, so that a solve that was killed goes on. Large ones that
            memory has room for are swept there, and copied to the file every ten minutes and in the end, whatever ends
            it. None: memory, or, if that has little room, a file without a name.
        processes: 1; or "mpi": those that `mpiexec` has started, all of which make this call, and sweep a range of the
            states each; the first gets the Solution, the others None. Values depend on it within the tolerance; those
            of a horizon do not.
        checkpoint: a folder for the values so far, once a minute, so that the same call goes on after one was killed,
            with any number of processes.
        threads: threads of a sweep. Beyond one, last digits may differ, within the error. They share the states if
            no action is sticky and transitions are in arrays.
        dtype: type of the stored values: float64; or float32, half the memory, and a bound that counts it. So a
            tolerance below 1.2e-7 max |V| / (1 - gamma) is out of reach. For one process, and no horizon.
    Raises:
        ParameterError: an option is out of range; or float32 with a horizon or several processes, a file of values with
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
        """The options of solving an MDP: an object, with changes; or of a tolerance. The horizon is the MDP's own if
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
