"""Agents: one object for each has all that pharos knows about it, and what a learner of several runs can do.

A new agent is a file with its object and a line in registry.py. Everything else asks the object: `train`, `tune`,
studies, `predict`, the benchmark, figures and the command line.
"""

import contextlib
import shutil
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from pharos.agents.idealised import Idealised
from pharos.errors import FileFormatError, ParameterError
from pharos.mdp import ChanceSetting, TabularMDP
from pharos.policies import Observer, PolicyLike, is_small_table
from pharos.system import storage
from pharos.system.sources import is_reference

if TYPE_CHECKING:
    from pharos.environments import Environment
    from pharos.state_space import StateSpace

T = TypeVar("T")
POLICY, NETWORK = "policy.npy", "agent"
"""What was learnt, in the folder of a run: a table, or a folder with a network."""
AGENT_LIBRARIES = ("stable_baselines3", "sb3_contrib")
"""Their algorithms are known by name: they need no trust, and no source in the configuration of a run."""
TABULAR_OBSERVATION = "index"
"""What tabular agents see."""
TABLES_AT_ONCE = 16  # runs of one program that learn tables
# Entries of a configuration that decide about rewards and states, and about observations
WORLD = ("environment", "parameters", "gamma", "sources")
OBSERVATIONS = ("environment", "parameters", "observation", "observation_options", "sources")


# What an agent is asked about -----------------------------------------------------------------------------------------


class LearningTask(Protocol):
    """The task of a run, a `pharos.training.Task`."""

    @property
    def env(self) -> "Environment": ...

    @property
    def gamma(self) -> float: ...

    @property
    def chance(self) -> ChanceSetting: ...

    @property
    def scaled_chance(self) -> ChanceSetting: ...

    @property
    def time_limit(self) -> int: ...

    @property
    def space(self) -> "StateSpace": ...

    @property
    def mdp(self) -> TabularMDP: ...

    @property
    def observer(self) -> Observer: ...

    @property
    def interaction(self) -> dict[str, Any]: ...


class LearningRun(Protocol):
    """A run that is going to be trained, see `pharos.training`.

    Attributes:
        config: its `pharos.training.RunConfig`.
        task: its task, which is made when it is first used.
        algorithm: name of the agent, or a class or function of the user's own.
        hyperparameters: all that are known, the configuration's first.
        world_mdp: states and rewards without chance and horizon.
    """

    @property
    def config(self) -> Any: ...

    @property
    def task(self) -> LearningTask: ...

    @property
    def algorithm(self) -> str | Callable[..., Any]: ...

    @property
    def hyperparameters(self) -> dict[str, Any]: ...

    @property
    def world_mdp(self) -> TabularMDP: ...

    def shared(self, what: str, names: Sequence[str], make: Callable[[], T]) -> T:
        """Return what `make` returns, made once for all runs whose configurations have the same entries `names`."""


@dataclass(frozen=True)
class RunShape:
    """Sizes of a run that decide which runs can share a program.

    Attributes:
        shape, dtype: of one observation.
        is_image: whether it is an image: (C, H, W) or (H, W, C) uint8 from 0 to 255.
        frames: k, how many states it shows.
        num_actions: A.
        num_states: S, or an upper bound if the states are not built.
    """

    shape: tuple[int, ...]
    dtype: str
    is_image: bool
    frames: int
    num_actions: int
    num_states: float


class SizedRun(Protocol):
    """A run of which the sizes are known."""

    @property
    def hyperparameters(self) -> Mapping[str, Any]: ...

    @property
    def steps(self) -> int: ...

    @property
    def shape(self) -> RunShape: ...


class PlannedRun(SizedRun, Protocol):
    """A run whose states need not be built, see `pharos.training.Shapes`."""

    @property
    def config(self) -> Any: ...


AtPoint = Callable[[int], Mapping[str, Any] | None]
"""at_point(steps) -> row of the curve of the first run, which TensorBoard shows."""


class Learner(Protocol):
    """Learner of N runs. One without `save` begins anew after it was killed.

    Attributes:
        episodes: (N,) int64, finished ones. returns: (N,) float64, the sums of their returns.
    """

    @property
    def episodes(self) -> np.ndarray: ...

    @property
    def returns(self) -> np.ndarray: ...

    def learn(self, points: Sequence[int], at_point: AtPoint) -> None:
        """Train until the last of `points`, and call `at_point` at each."""

    def policy(self, i: int) -> PolicyLike:
        """The policy of run i, as `evaluate_agent` takes it, or its value, if the learner knows that."""

    def greedy_actions(self, indices: Sequence[int]) -> dict[int, np.ndarray] | None:
        """(S,) greedy actions by run, or None if no policy is a table of states."""

    def save(self, folder: Path) -> None:
        """Write the state that `load` goes on from."""

    def load(self, folder: Path) -> None:
        """Go on from what `save` wrote. FileFormatError: it cannot be read."""

    def publish(self, i: int, folder: Path) -> None:
        """Write the policy of run i into its folder, as `Agent.load` reads it."""


# Agents ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Agent:
    """An agent: its names, hyperparameters, learner and idealised form. Base class of all.

    Attributes:
        name: as `train` takes it.
        title: as figures and tables write it.
        engines: that can be asked for. The last trains most runs a second.
        defaults: hyperparameters, under the names of Stable-Baselines3 or of the learner, `n_envs` beside them. A class
            of environments declares what suits it better.
        space: that `tune` searches: of each hyperparameter ("log", low, high), ("linear", low, high), or ("one of",
            value, ...).
        benchmark_defaults: values of those that only some classes declare. The benchmark has one setting for all tasks.
        idealised: the learner that `predict` computes in its place.
        relatives: words in names of algorithms that are of its kind.
        fixed_observation: what it always sees. None: what is asked for.
        is_greedy: whether its policies are one action in each observation.
        has_table: whether it learns a table over the states, stored as POLICY. Otherwise a network, stored in NETWORK.
    """

    name: str
    title: str
    engines: tuple[str, ...] = ("sb3",)
    defaults: Mapping[str, Any] = field(default_factory=dict)
    space: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    benchmark_defaults: Mapping[str, Any] = field(default_factory=dict)
    idealised: Idealised = field(default_factory=Idealised)
    relatives: tuple[str, ...] = ()
    fixed_observation: str | None = None
    is_greedy: bool = False
    has_table: bool = False

    def observation(self, requested: str) -> str:
        """The observation that the agent gets if `requested` is asked for.

        Raises:
            ParameterError: it sees another one. A vector, the default, counts as not asked for.
        """
        if self.fixed_observation is not None and requested not in (self.fixed_observation, "vector"):
            raise ParameterError(
                f"{self.name} sees {self.fixed_observation} whatever is asked for; leave out observation {requested}"
            )
        return self.fixed_observation or requested

    def engine(self, requested: str) -> str:
        """The engine that trains the agent if `requested` is asked for. ParameterError: there is none."""
        if requested not in self.engines:
            *others, last = sorted(name for name, agent in agents().items() if requested in agent.engines)
            raise ParameterError(
                f"agent {self.name!r}: the {requested} engine has {', '.join(others)} and {last}; "
                f"the engine {self.engines[0]} has {self.name!r}"
            )
        return requested

    def resumes_exactly(self, engine: str) -> bool:
        """Whether a run that goes on from a checkpoint has the bytes of one that was not interrupted."""
        return True

    def has_tensorboard(self, engine: str) -> bool:
        """Whether TensorBoard's logs can be written."""
        return False

    def library_default(self, name: str) -> object:
        """The learner's own default of a hyperparameter, or None if it has none."""
        return None

    def check(self, hyperparameters: Mapping[str, Any], engine: str) -> None:
        """Raise ParameterError or UnknownName for hyperparameters that the agent lacks, or whose values are wrong."""

    def check_before(self, hyperparameters: Mapping[str, Any], engine: str) -> None:
        """Check before anything runs: no library is imported for names that are known, or has to be there."""
        self.check(hyperparameters, engine)

    def group_key(self, run: PlannedRun, device: str) -> Hashable | None:
        """Key of a run before its states are built: only runs with equal keys may train together. None: it is alone."""
        return None

    def width(self, run: PlannedRun, device: str) -> int:
        """Most runs that one program trains at full pace."""
        return 1

    def prepare(self, run: LearningRun, device: str, *, is_single: bool) -> Hashable | None:
        """Return the exact group key of a run: runs with equal keys train under one learner. None: it is alone.

        Args:
            is_single: whether the run is the only one of its call, or has a checkpoint of its own.
        Raises:
            ParameterError: the run cannot begin.
        """
        return None

    def learner(self, runs: Sequence[LearningRun], device: str, logs: Path | None = None) -> Learner:
        """The learner of runs with equal group keys.

        Args:
            device: of networks of the batched engine.
            logs: folder for TensorBoard's.
        """
        raise NotImplementedError

    def load(self, folder: Path, run: LearningRun) -> PolicyLike:
        """The policy that `Learner.publish` wrote into the folder of a run."""
        raise NotImplementedError


_AGENTS: dict[str, Agent] = {}


def agents() -> Mapping[str, Agent]:
    """The agents that have a name, by name, in the order in which they are listed."""
    return _AGENTS


def register(agent: Agent) -> None:
    """Add an agent to those that have a name."""
    _AGENTS[agent.name] = agent


def is_known(name: str) -> bool:
    """Whether an agent comes with pharos or with one of AGENT_LIBRARIES, so that it is not code of the user's own."""
    return not is_reference(name) or name.partition(":")[0].split(".")[0] in AGENT_LIBRARIES


# Tables ---------------------------------------------------------------------------------------------------------------


class TableLearner(Protocol):
    """Learner of one run, whose policy is a table of the states."""

    @property
    def steps(self) -> int: ...

    @property
    def episodes(self) -> int: ...

    @property
    def sum_of_returns(self) -> float: ...

    def learn(self, steps: int) -> object:
        """Learn for so many more steps."""

    def policy_table(self) -> np.ndarray:
        """(S,) actions, or (S, A + 1, A) probabilities by state and previous action."""

    def state(self) -> dict[str, np.ndarray]:
        """State of the learner for `restore`."""

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore a state that `state` returned."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TableBasedAgent(Agent):
    """An agent that learns a table over the states, whose index it sees. Runs on few states train together.

    Tables are the same with each engine, so theirs is always "sb3".
    """

    engines: tuple[str, ...] = ("sb3", "batched")
    fixed_observation: str | None = TABULAR_OBSERVATION
    has_table: bool = True

    def table(self, run: LearningRun) -> TableLearner:
        """The learner of one run. ParameterError: a hyperparameter is wrong."""
        raise NotImplementedError

    def engine(self, requested: str) -> str:
        return "sb3"

    def group_key(self, run: PlannedRun, device: str) -> Hashable | None:
        return self.name, run.config.environment

    def width(self, run: PlannedRun, device: str) -> int:
        return TABLES_AT_ONCE

    def prepare(self, run: LearningRun, device: str, *, is_single: bool) -> Hashable | None:
        if is_single or not is_small_table(run.task.mdp):
            return None
        self.table(run)  # an error is raised before others are concerned
        return "tables"

    def learner(self, runs: Sequence[LearningRun], device: str, logs: Path | None = None) -> "Tables":
        return Tables(self.name, [self.table(run) for run in runs])

    def load(self, folder: Path, run: LearningRun) -> np.ndarray:
        return read_policy_table(folder)


class ArrayLearner:
    """A learner whose `state` is a dictionary of arrays."""

    file = "batch.npz"

    def state(self) -> dict[str, np.ndarray]:
        """State of the learner for `restore`."""
        raise NotImplementedError

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore a state that `state` returned."""
        raise NotImplementedError

    def save(self, folder: Path) -> None:
        np.savez(folder / self.file, **self.state())  # type: ignore[arg-type]

    def load(self, folder: Path) -> None:
        with reading_checkpoint(folder), np.load(folder / self.file, allow_pickle=False) as stored:
            self.restore({name: stored[name] for name in stored.files})


class Tables(ArrayLearner):
    """Tables of one agent, whose learners advance one after the other."""

    def __init__(self, name: str, tables: Sequence[TableLearner]):
        self.tables = tables
        if len(tables) == 1:
            self.file = f"{name}.npz"

    @property
    def episodes(self) -> np.ndarray:
        return np.array([table.episodes for table in self.tables], np.int64)

    @property
    def returns(self) -> np.ndarray:
        return np.array([table.sum_of_returns for table in self.tables])

    def learn(self, points: Sequence[int], at_point: AtPoint) -> None:
        for point in points:
            for table in self.tables:
                table.learn(point - table.steps)
            at_point(point)

    def policy(self, i: int) -> PolicyLike:
        return self.tables[i]

    def greedy_actions(self, indices: Sequence[int]) -> dict[int, np.ndarray]:
        """(S,) greedy actions by index of the run. Runs whose policy depends on the previous action are left out."""
        tables = {i: self.tables[i].policy_table() for i in indices}
        return {i: table for i, table in tables.items() if table.ndim == 1}

    def state(self) -> dict[str, np.ndarray]:
        if len(self.tables) == 1:
            return self.tables[0].state()
        return joined_states(table.state() for table in self.tables)

    def restore(self, state: dict[str, np.ndarray]) -> None:
        if len(self.tables) == 1:
            self.tables[0].restore(state)
            return
        for i, table in enumerate(self.tables):
            table.restore(learner_state(state, i))

    def publish(self, i: int, folder: Path) -> None:
        """Write the greedy policy, as POLICY."""
        storage.replace_array(folder / POLICY, self.tables[i].policy_table())


# Files of learners ----------------------------------------------------------------------------------------------------


def joined_states(states: Iterable[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """One dictionary of arrays of several learners, as checkpoints keep them: "3/q" is `q` of learner 3."""
    return {f"{i}/{name}": array for i, state in enumerate(states) for name, array in state.items()}


def learner_state(joined: Mapping[str, np.ndarray], i: int) -> dict[str, np.ndarray]:
    """State of learner i."""
    prefix = f"{i}/"
    return {name[len(prefix) :]: array for name, array in joined.items() if name.startswith(prefix)}


@contextlib.contextmanager
def reading_checkpoint(folder: Path) -> Iterator[None]:
    """Raise FileFormatError, one line that names the folder, for any error in reading a checkpoint."""
    try:
        for file in folder.iterdir():
            storage.check_regular(file)
        yield
    except Exception as error:  # torch and NumPy have many
        first = str(error).split(". ")[0].splitlines()  # torch goes on with advice that is not ours
        raise FileFormatError(
            f"{folder}: cannot be resumed from: {first[0] if first else type(error).__name__}; "
            f"delete the folder to start anew"
        ) from error


def read_policy_table(folder: Path) -> np.ndarray:
    """The table that a run has left as POLICY. FileFormatError: it cannot be read."""
    file = folder / POLICY
    try:
        storage.check_regular(file)
        return np.load(file, allow_pickle=False)
    except Exception as error:  # the header is read as Python
        raise FileFormatError(f"{file}: cannot be read: {error}") from error


def new_agent(folder: Path) -> Path:
    """The empty folder NETWORK of a run. An older one is removed, so that no link in it is written through."""
    target = storage.inside(folder, NETWORK)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    return target
