"""Suites: frozen lists of tasks in a file, with a digest of each solved task.

    name: v1
    digest: ...                 of all the rest
    protocol: {steps: 30000, evaluations: 15, seeds: 10, gamma: 1.0, horizon: limit}
    hyperparameters: {dqn: {...}, ppo: {...}}
    core: [tasks]
    quick: {tasks: [names], seeds: 3}      of a quick look; left out: the core, three seeds
    ladders: [{axis, unit, quantity, measure, tasks: [tasks, the easiest first]}]

A task is an entry with the fields of `BenchmarkTask`, but its axis. Empty ones are left out. Names say little about a
world: two libraries had a deep_sea whose actions meant other things. So a task is known by its arrays.
"""

import hashlib
import json
import os
from collections.abc import Container, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pharos.benchmark import levels
from pharos.errors import FileFormatError, MissingExtra, ParameterError, UnknownName
from pharos.mdp import ChanceSetting, TabularMDP
from pharos.system import storage
from pharos.system.records import parse_record
from pharos.system.sources import is_reference, untrusted_code
from pharos.system.storage import check_name
from pharos.training import ReferenceValues, Task, TaskValues

FOLDER = Path(__file__).parent / "suites"
V1 = "50d45f848f991081acf6b8ce6a5c532614ebc2139ea50d148094ea50894b1086"
EARLIER = {"3a1d2bb3986015bb807c596528212e8ea9f8c6579252bc3f53c70a8e596665fe": V1}
"""Digest of protocol and tasks alone, which results of earlier checkouts name -> digest of the suite that has them."""
CORE = "core"
PAIRS = "pairs"
"""Measure of an axis of pairs: one world in two ways, and how much worse an agent is at the second."""
MANTISSA_BITS = 40
"""Of a mantissa that enter a digest, 12 digits: what compilers and processors may round differently is beyond."""
SAMPLED = 4096
"""States of a large task whose rewards and observations enter its digest."""
STORED = ("states", "worst", "lowest", "highest", "error_bound")
HUGE = 1e300  # stored values are less
QUICK, MOST_QUICK = 3, 1000  # seeds
TOLERANCE = 1e-6
"""Of values, relative to V* less that of uniform play: solvers may sum in another order."""


@dataclass(frozen=True)
class Protocol:
    """Training and evaluation protocol of a suite: steps, evaluations, seeds, discount and horizon.

    Attributes:
        steps: of an agent, on each task. evaluations: points of the curve, equally far apart, the last one at the end.
        seeds: runs of each task that a score which is not preliminary has: 0 to seeds - 1.
        gamma, horizon: of values, as `pharos.training.Task` takes them.
    """

    steps: int = 30_000
    evaluations: int = 15
    seeds: int = 10
    gamma: float = 1.0
    horizon: int | str | None = "limit"

    @property
    def evaluation_interval(self) -> int:
        """Steps between evaluations."""
        return self.steps // self.evaluations


@dataclass(frozen=True)
class BenchmarkTask:
    """One task of a suite: an environment, an observation, and facts known before any run (values, predictions).

    Attributes:
        name: unique in its suite, and fit for a file name (`check_name`), since runs are written below it.
        environment, parameters: as `pharos.make` takes them, or "levels", with the parameters of `levels_of`.
        observation, observation_options: as `pharos.observe`.
        chance: the kinds of `ChanceSetting` that are not 0.
        axis: "core", or the axis of its ladder.
        level: on a ladder the measured quantity, in the ladder's unit. None in the core.
        predicted: by `pharos.predict`, normalised regret, 0 optimal and 1 uniform play: "dqn", "ppo", and "table",
            for the DQN with a table. Some may be missing.
        value_optimal, value_uniform: at the start, of the optimal policy and of uniform play.
        digest: SHA-256 of the task as it was frozen, see `digest_of_task`.
        seconds: processor time of one run of a baseline that was measured, by its name. A guide, no limit.
        stored: of a large task, which is not solved before each run: its number of `states`, value of the `worst`
            policy, `lowest` and `highest` return of an episode, and `error_bound` of all its values. Empty: it is
            solved.
    Raises:
        ParameterError: the name is not fit for a file name, or entries of `stored` are missing.
    """

    name: str
    environment: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    observation: str = "vector"
    observation_options: Mapping[str, Any] = field(default_factory=dict)
    chance: Mapping[str, float] = field(default_factory=dict)
    axis: str = CORE
    level: float | None = None
    predicted: Mapping[str, float] = field(default_factory=dict)
    value_optimal: float = float("nan")
    value_uniform: float = float("nan")
    digest: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict)
    stored: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_name(self.name, "the name of a task")
        if self.stored and {*self.stored} != {*STORED}:
            raise ParameterError(f"task {self.name}: stored has {', '.join(self.stored)}; expected {', '.join(STORED)}")
        if not all(abs(value) < HUGE for value in self.stored.values()):
            raise ParameterError(f"task {self.name}: stored is {str(self.stored)[:120]}; expected finite numbers")

    @property
    def stored_values(self) -> TaskValues | None:
        """Values at the start of a large task, as they were frozen, or None if they are to be solved for."""
        if not (own := self.stored):
            return None
        reference = ReferenceValues(self.value_optimal, self.value_uniform, own["worst"], own["error_bound"])
        return TaskValues(reference, (own["lowest"], own["highest"]))

    def training_task(self, protocol: Protocol) -> Task:
        """The task as agents are trained on it. Nothing is built before it is needed."""
        if protocol.gamma == 1.0 and protocol.horizon in (None, "none"):
            raise ParameterError(
                f"task {self.name}: gamma is 1 without a horizon, so regret may be infinite, and no score a mean of "
                f"it; give a horizon, or gamma < 1"
            )
        if self.environment == levels.ENVIRONMENT_NAME:
            world: tuple[Any, ...] = (levels.levels_of(**self.parameters),)
        else:
            world = self.environment, self.parameters
        return Task.of(
            *world,
            observation=self.observation,
            observation_options=dict(self.observation_options),
            chance=ChanceSetting.from_dict(self.chance),
            gamma=protocol.gamma,
            horizon=protocol.horizon,
            values=self.stored_values,
        )

    def check(self, protocol: Protocol) -> Task:
        """The task as agents are trained on it. ParameterError if it is another task on this installation.

        Cost: its states are built, and solved unless it is large.
        """
        task = self.training_task(protocol)
        digest = digest_of_large_task(task) if self.stored else digest_of_task(task)
        if digest != self.digest:
            raise ParameterError(
                f"task {self.name}: its digest is {digest[:16]}... on this installation; expected "
                f"{self.digest[:16]}...: rules, rewards, chance or observations differ; install the version of pharos "
                f"that the suite is of"
            )
        reference = task.reference
        for name in ("optimal", "uniform"):
            value, expected = getattr(reference, name), getattr(self, f"value_{name}")
            if not abs(value - expected) <= TOLERANCE * (self.value_optimal - self.value_uniform):
                raise ParameterError(
                    f"task {self.name}: the value of {name} play is {value!r} on this installation; expected "
                    f"{expected!r}; install the version of pharos that the suite is of"
                )
        return task


@dataclass(frozen=True)
class Ladder:
    """One world that gets harder along one quantity, or pairs of tasks.

    Attributes:
        axis: such as "exploration". unit: of the levels, such as "bits". quantity: what a level is, in words.
        tasks: with increasing levels. Of pairs first and second in turn, with levels 0 and 1.
        measure: by which `benchmarks/benchmark_select.py` finds the levels, or "pairs" if tasks are pairs.
    """

    axis: str
    unit: str
    quantity: str
    tasks: tuple[BenchmarkTask, ...]
    measure: str = ""

    @property
    def pairs(self) -> tuple[tuple[BenchmarkTask, BenchmarkTask], ...]:
        """Pairs of tasks, of which the second is the first made harder. None for a ladder that gets harder."""
        return tuple(zip(self.tasks[::2], self.tasks[1::2], strict=True)) if self.measure == PAIRS else ()

    def weights(self, names: Container[str]) -> dict[str, float]:
        """Weight in the score of the axis of each task that is in `names`.

        Of rungs equal ones, whose sum is 1. Of pairs 1 / n and -1 / n, of the second and the first task of each of n
        whole pairs, whose sum is 0.
        """
        if self.measure != PAIRS:
            run = [task.name for task in self.tasks if task.name in names]
            return {name: 1.0 / len(run) for name in run}
        whole = [pair for pair in self.pairs if all(task.name in names for task in pair)]
        return {task.name: sign / len(whole) for pair in whole for task, sign in zip(pair, (-1.0, 1.0), strict=True)}


@dataclass(frozen=True)
class Suite:
    """A frozen list of tasks, and the protocol of runs on them.

    Attributes:
        name: such as "v1". protocol: of all tasks.
        core: tasks that a score is the mean of. ladders: one for each axis.
        digest: SHA-256 of all the rest, see `digest_of_suite`.
        hyperparameters: of baselines by name, one setting for all tasks.
        quick: of a quick look, the names of its `tasks` and how many `seeds`. Empty: the core, three seeds.
    """

    name: str
    protocol: Protocol
    core: tuple[BenchmarkTask, ...]
    ladders: tuple[Ladder, ...]
    digest: str = ""
    hyperparameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    quick: Mapping[str, Any] = field(default_factory=dict)

    @property
    def quick_tasks(self) -> tuple[str, ...]:
        """Names of tasks and axes of a quick look."""
        return tuple(self.quick.get("tasks", (CORE,)))

    @property
    def quick_seeds(self) -> int:
        """Number of seeds of a quick look."""
        return int(self.quick.get("seeds", QUICK))

    @property
    def tasks(self) -> tuple[BenchmarkTask, ...]:
        """All tasks: the core, then ladder after ladder."""
        return (*self.core, *(task for ladder in self.ladders for task in ladder.tasks))

    @cached_property
    def _by_name(self) -> dict[str, BenchmarkTask]:
        return {task.name: task for task in self.tasks}

    def task(self, name: str) -> BenchmarkTask:
        """The task of this name. UnknownName if there is none."""
        if name not in self._by_name:
            raise UnknownName(f"task of suite {self.name}", name, self._by_name)
        return self._by_name[name]

    def check(self) -> None:
        """Raise ParameterError for the first task that is another one on this installation. Cost: seconds."""
        for task in self.tasks:
            task.check(self.protocol)


def shipped_suites() -> list[str]:
    """Names of pharos' own suites."""
    return sorted(each.stem for each in FOLDER.glob("*.yaml"))


def load_suite(name_or_file: str | Path = "v1", *, trust: bool = False) -> Suite:
    """Read a suite: one of pharos' own by its name, or a file of the same form. Nothing that it names is imported.

    Args:
        trust: whether its tasks may name code, `module:Name` or `file.py:Name`, which is executed when they are made.
    Raises:
        UnknownName: no such suite. FileFormatError: the file is no suite, or not what its digest says.
        UntrustedCode: a task names code, and is not trusted.
        MissingExtra: PyYAML is not installed.
    """
    from pharos.system.yaml_files import read_yaml  # which needs PyYAML

    path = Path(name_or_file)
    if path.suffix not in (".yaml", ".yml"):
        path = FOLDER / f"{name_or_file}.yaml"
        if str(name_or_file) not in shipped_suites():
            raise UnknownName("suite", str(name_or_file), shipped_suites())
    suite = suite_of(read_yaml(path, FileFormatError), str(path))
    for task in suite.tasks:
        named = [name for name in (task.environment, task.observation) if is_reference(name)]
        if named and not trust:
            raise untrusted_code(f"{path}: task {task.name}: {named[0]!r}")
    return suite


def suite_of(entry: object, source: str) -> Suite:
    """A suite from the entries of its file, checked to be complete and to have the digest that it names.

    Raises:
        FileFormatError: an entry is missing, unknown, of another type or damaged. `source` names the file.
    """
    keys = [each.name for each in fields(Suite)]
    if not isinstance(entry, dict) or {*entry, "quick"} != {*keys}:
        raise FileFormatError(f"{source}: is no suite; expected the entries {', '.join(keys)}")
    ladders: list[Ladder] = []
    for each in _list(entry["ladders"], f"{source}: ladders"):
        of = f"{source}: ladder {each.get('axis')}"
        tasks = _tasks(each.get("tasks"), str(each.get("axis")), of)
        ladders.append(replace(parse_record(Ladder, {**each, "tasks": ()}, of, ("measure",)), tasks=tasks))
        if ladders[-1].measure == PAIRS and len(tasks) % 2:
            raise FileFormatError(f"{of}: has {len(tasks)} tasks; expected pairs")
        _check_levels(ladders[-1], of)
    settings = entry["hyperparameters"]
    if not isinstance(settings, dict) or not all(isinstance(each, dict) for each in settings.values()):
        raise FileFormatError(f"{source}: hyperparameters are {str(settings)[:60]}; expected some of each baseline")
    quick = entry.get("quick", {})
    if not isinstance(quick, dict) or not {*quick} <= {"tasks", "seeds"}:
        raise FileFormatError(f"{source}: quick is {str(quick)[:60]}; expected tasks and seeds")
    suite = Suite(
        str(entry["name"]),
        parse_record(Protocol, entry["protocol"], f"{source}: protocol"),
        _tasks(entry["core"], CORE, f"{source}: core"),
        tuple(ladders),
        str(entry["digest"]),
        settings,
        quick,
    )
    if len(suite._by_name) < len(suite.tasks):
        raise FileFormatError(f"{source}: two tasks have the same name; expected a name of its own for each")
    names = {CORE, *suite._by_name, *(ladder.axis for ladder in ladders)}
    tasks, seeds = quick.get("tasks", [CORE]), quick.get("seeds", QUICK)
    if not isinstance(tasks, list) or not tasks or not all(isinstance(each, str) and each in names for each in tasks):
        raise FileFormatError(f"{source}: quick has the tasks {str(tasks)[:60]}; expected names of its tasks and axes")
    if type(seeds) is not int or not 1 <= seeds <= MOST_QUICK:
        raise FileFormatError(f"{source}: quick has {str(seeds)[:20]} seeds; expected 1 to {MOST_QUICK:,}")
    try:
        digest = digest_of_suite(suite)
    except (TypeError, ValueError, RecursionError):
        raise FileFormatError(f"{source}: is no suite; expected entries that JSON has: text, numbers, lists") from None
    if digest != suite.digest:
        raise FileFormatError(
            f"{source}: what it says has the digest {digest[:16]}...; it names {suite.digest[:16]}...: it was changed; "
            f"take the file as it was published"
        )
    return suite


def _check_levels(ladder: Ladder, source: str) -> None:
    """Raise FileFormatError if levels are not finite and increasing, or, of pairs, 0 and 1 in turn."""
    levels = [task.level for task in ladder.tasks]
    numbers = [level for level in levels if level is not None and abs(level) < HUGE]
    is_pairs = ladder.measure == PAIRS
    is_right = levels == [0, 1] * (len(levels) // 2) if is_pairs else all(x < y for x, y in pairwise(numbers))
    if not levels or len(numbers) < len(levels) or not is_right:
        expected = "0 and 1 in turn" if is_pairs else "increasing numbers"
        raise FileFormatError(f"{source}: has the levels {str(levels)[:60]}; expected {expected}")


def _list(value: object, source: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
        raise FileFormatError(f"{source}: expected a list of objects")
    return value


def _tasks(entries: object, axis: str, source: str) -> tuple[BenchmarkTask, ...]:
    optional = [each.name for each in fields(BenchmarkTask) if each.name not in ("name", "environment", "digest")]
    try:
        tasks = tuple(
            parse_record(
                BenchmarkTask, {**each, "axis": axis}, f"{source}: task {str(each.get('name'))[:60]}", optional
            )
            for each in _list(entries, source)
        )
    except ParameterError as error:  # of a name
        raise FileFormatError(f"{source}: {error}") from None
    for task in tasks:
        _check_values(task, source)
    return tasks


def _check_values(task: BenchmarkTask, source: str) -> None:
    """Raise FileFormatError for values that are huge, or, of a large task, which nobody solves again, contradictory."""
    own, uniform, optimal = task.stored, task.value_uniform, task.value_optimal
    if abs(uniform) >= HUGE or abs(optimal) >= HUGE:
        raise FileFormatError(
            f"{source}: task {task.name}: values are {str(uniform)[:20]}, {str(optimal)[:20]}; expected finite numbers"
        )
    if not own:
        return
    bound, slack = own["error_bound"], own["error_bound"] + TOLERANCE * abs(own["worst"])
    is_right = own["lowest"] <= own["highest"] and own["states"] >= 1 and own["states"] % 1 == 0
    if not (is_right and own["worst"] <= uniform + slack and 0 <= bound < optimal - uniform):
        raise FileFormatError(
            f"{source}: task {task.name}: stored is {str(own)[:120]}, uniform play {uniform}, optimal play {optimal}; "
            f"expected states, worst <= uniform < optimal, lowest <= highest, and 0 <= error_bound < optimal - uniform"
        )


def digest_of_suite(suite: Suite) -> str:
    """SHA-256 of all that a suite says but its digest, as canonical JSON.

    So of name and protocol, of hyperparameters of baselines, of each ladder with its unit, quantity and measure, and of
    each task with its parameters, predictions, values, seconds and digest. Optional parts count where they are there.
    """
    entry = _entries(suite)
    del entry["digest"]
    return hashlib.sha256(_canonical(entry)).hexdigest()


def _entries(suite: Suite) -> dict[str, Any]:
    """Entries of the file of a suite, JSON-able. Empty `quick` and `stored` are left out, as v1 has neither."""
    entry = storage.plain(asdict(suite))
    tasks = [*entry["core"], *(task for ladder in entry["ladders"] for task in ladder["tasks"])]
    for each, name in [(entry, "quick"), *((task, "stored") for task in tasks)]:
        if not each[name]:
            del each[name]
    return entry


def frozen(task: BenchmarkTask, protocol: Protocol) -> BenchmarkTask:
    """A copy of the task with its digest and values. Cost: as solving it. A large task has its values already."""
    solved = task.training_task(protocol)
    if task.stored:
        return replace(task, digest=digest_of_large_task(solved))
    optimal, uniform = solved.reference.optimal, solved.reference.uniform
    return replace(task, value_optimal=optimal, value_uniform=uniform, digest=digest_of_task(solved))


def write_suite(suite: Suite, file: str | os.PathLike) -> None:
    """Replace a file by a suite, as `load_suite` reads it, with its digest.

    Raises:
        MissingExtra: PyYAML is not installed.
    """
    try:
        import yaml
    except ImportError as error:
        raise MissingExtra("writing a suite", "pyyaml", "study") from error
    entry = _entries(replace(suite, digest=digest_of_suite(suite)))
    for each in (*entry["core"], *(task for ladder in entry["ladders"] for task in ladder["tasks"])):
        del each["axis"]
    storage.replace_file(file, yaml.safe_dump(entry, sort_keys=False, allow_unicode=True).encode())


def digest_of_task(task: Task) -> str:
    """SHA-256 of a task as it is solved: its components by name, and its arrays.

    The names: environment, all its parameters (of an imported MDP none: it is its arrays), version of its rules,
    observation with its options, chance, gamma and time limit. The arrays, little-endian: of each state and action the
    possible next states, -1 for the end, in increasing order, and their probabilities; rewards (S, A), the probability
    that an episode begins in each state, which states are terminal, and the observation of each state. States are in
    the order in which they are found from the start, which is the same everywhere. Numbers count by their first 40
    bits.
    """
    space, mdp = task.space, task.space.mdp(gamma=task.gamma)
    return _digest(task, [*_arrays(mdp), task.observer.observe.observation(space.states())])


def digest_of_large_task(task: Task) -> str:
    """SHA-256 of a task with too many states for their observations in memory, as it is frozen.

    Of its components by name, as `digest_of_task` has them; of the checksums of all states and transitions in the files
    of its state space, which are the same everywhere; and of rewards and observations of SAMPLED states, equally far
    apart in the order in which they are found, the first and the last among them.

    Cost: as building the states.
    """
    space = task.space
    states = np.unique(np.linspace(0, space.num_states - 1, SAMPLED).astype(np.int64))
    rewards = np.asarray(space.mdp(gamma=task.gamma).reward_table.rows(states), np.float64)
    files = {name: entry["checksums"] for name, entry in sorted(space.manifest["arrays"].items())}
    world = {"states": space.num_states, "initial": space.manifest["initial"], "files": files}
    return _digest(task, [rewards, task.observer.observe.observation(space.states(states))], world)


def _digest(task: Task, arrays: Iterable[np.ndarray], world: object = None) -> str:
    """SHA-256 of the components of a task by name, what else is said of its world, and arrays."""
    env = task.env
    description = {
        "environment": env.name,
        "parameters": {} if env.name == "imported" else env.parameters,  # whose folder may lie anywhere
        "rules_version": env.version,
        "observation": str(task.observation),
        "observation_options": dict(task.observation_options),
        "chance": {name: float(value) for name, value in task.chance.to_dict().items()},
        **task.conventions,
        **({} if world is None else {"world": world}),
    }
    digest = hashlib.sha256(_canonical(description))
    for array in arrays:
        kind = "<f8" if array.dtype.kind == "f" else "<i8"
        values = (rounded(array) if kind == "<f8" else array).astype(kind)
        digest.update(_canonical([kind, list(array.shape)]))
        digest.update(values.tobytes())
    return digest.hexdigest()


def _arrays(mdp: TabularMDP) -> Iterable[np.ndarray]:
    """Yield the arrays of an MDP: rows s A + a, next states, probabilities of outcomes; rewards, start, terminal."""
    num_states, num_actions = mdp.num_states, mdp.num_actions
    pairs = np.arange(num_states * num_actions)
    which, next_states, probabilities = mdp.dynamics.entries(pairs // num_actions, pairs % num_actions)
    keys, inverse = np.unique(which * (num_states + 1) + next_states + 1, return_inverse=True)
    yield keys // (num_states + 1)
    yield keys % (num_states + 1) - 1
    yield np.bincount(inverse, probabilities, len(keys))
    start = np.zeros(num_states)
    start[mdp.start_states] = mdp.start_probabilities
    yield from (np.asarray(mdp.rewards, np.float64), start, np.asarray(mdp.terminal, bool))


def rounded(values: np.ndarray) -> np.ndarray:
    """Numbers with mantissas of MANTISSA_BITS bits. Zero has no sign."""
    mantissa, exponent = np.frexp(np.asarray(values, np.float64))
    return np.ldexp(np.round(np.ldexp(mantissa, MANTISSA_BITS)), exponent - MANTISSA_BITS) + 0.0


def _canonical(value: object) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
