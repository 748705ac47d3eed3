"""What is brought to the benchmark and to folders of results: hostile suites, links that lead out, uncounted copies.

Suites decide about no code and no file outside; links in folders of results about no file elsewhere; and each step of
whatever copy of a benchmark's environment is counted, by a witness within the environment.
"""

import concurrent.futures
import copy
import io
import itertools
import json
import multiprocessing
import pickle
import shutil
import threading
import warnings
from contextlib import redirect_stderr, suppress
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml

import pharos
from attacks.damage import NUMBERS, OTHERS, Attack, Refused, Tally, command, outcome
from pharos import benchmark, importers, study
from pharos.benchmark import AgentResults, BenchmarkTask, BudgetSpent, Protocol, Suite, load_suite, write_suite
from pharos.benchmark.execution import selected
from pharos.benchmark.levels import levels_of
from pharos.benchmark.scores import score
from pharos.benchmark.suite import Ladder, digest_of_suite, digest_of_task, frozen
from pharos.errors import ParameterError, PharosError
from pharos.interaction import GymEnv
from pharos.mdp import TabularMDP
from pharos.training import Task
from pharos.training.budget import generated_curve

pytestmark = pytest.mark.long

PROTOCOL = Protocol(steps=120, evaluations=3, seeds=2)
SEA = BenchmarkTask("sea", "deep_sea", {"size": 4, "mapping_seed": 1}, "one_hot")
LAKE = BenchmarkTask("lake", "frozen_lake", {"size": 4}, "vector", chance={"sticky": 0.25})
CANARY = """
import pathlib
from pharos.environments import DeepSea

pathlib.Path(__file__).with_name("executed").mkdir(exist_ok=True)

class Evil(DeepSea):
    name, instances = "evil_sea", {}  # none is listed in this process
"""


@pytest.fixture(scope="module")
def suite():
    made = Suite("mini", PROTOCOL, tuple(frozen(task, PROTOCOL) for task in (SEA, LAKE)), (), "", {"dqn": {}})
    return replace(made, digest=digest_of_suite(made))


# Suites ---------------------------------------------------------------------------------------------------------------


def test_damaged_suites(suite, tmp_path, count):
    """What is read has its tasks, or is refused: its digest says so."""
    (tmp_path / "suites").mkdir()
    write_suite(suite, tmp_path / "suites" / "mini.yaml")

    def read(folder):
        loaded = load_suite(folder / "mini.yaml")
        return loaded.digest, [(task.name, task.digest) for task in loaded.tasks], loaded.protocol

    (tmp_path / "copies").mkdir()
    tally = Attack(tmp_path / "suites", ("mini.yaml",), read).run(tmp_path / "copies")
    count(f"{tally.total} damaged suites: {tally}")
    assert tally.total >= 25 and tally.counts["refused"] >= 15


def test_suites_with_the_right_digest_that_say_nonsense(tmp_path, monkeypatch, count):
    """What is read of a quick look, stored values, levels and pairs can be used; all else is refused."""
    stored = {"states": 10, "worst": 0.0, "lowest": 0.0, "highest": 3.0, "error_bound": 1e-9}
    large = BenchmarkTask("large", "frozen_lake", value_optimal=3.0, value_uniform=1.0, stored=stored)
    sea = replace(SEA, value_optimal=1.0, value_uniform=0.0)
    rungs = tuple(replace(sea, name=f"rung-{k}", axis="size", level=float(k)) for k in range(2))
    pairs = tuple(replace(sea, name=f"pair-{k}", axis="eyes", level=float(k)) for k in range(2))
    ladders = Ladder("size", "bits", "of states", rungs), Ladder("eyes", "loss", "of eyes", pairs, "pairs")
    write_suite(
        Suite("mini", PROTOCOL, (large,), ladders, "", {}, {"tasks": ["size"], "seeds": 2}), tmp_path / "s.yaml"
    )
    entry = yaml.safe_load((tmp_path / "s.yaml").read_text())
    monkeypatch.setattr("pharos.benchmark.suite.digest_of_suite", lambda suite: suite.digest)  # as a forger has it
    values = [value for value in (*NUMBERS, *OTHERS)]
    changes = {
        "quick": values,
        "quick tasks": [*values, ["nobody"], "core"],
        "quick seeds": values,
        "quick weights": [1],
    }
    changes |= {f"core 0 stored {name}": values for name in ("states", "worst", "lowest", "highest", "error_bound")}
    changes |= {"core 0 stored": values, "core 0 value_optimal": values, "core 0 value_uniform": values}
    for k in range(2):
        changes |= {f"ladders {k} {name}": values for name in ("measure", "tasks", "axis", "tasks 0 level")}
        changes |= {f"ladders {k} weights": [{"pair-0": 1e300}, [1, 2]], f"ladders {k} tasks 1 level": values}
        changes |= {
            f"ladders {k} pairs": [[["pair-0", "pair-0"]]],
            f"ladders {k} tasks 1": [entry["ladders"][k]["tasks"][0]],
        }
    tally = Tally()

    def read():
        suite = load_suite(tmp_path / "s.yaml")
        assert 1 <= suite.quick_seeds <= 1000 and all(selected(suite, [name]) for name in suite.quick_tasks)
        for ladder in suite.ladders:
            names = [task.name for task in ladder.tasks]
            assert abs(sum(ladder.weights(names).values()) - (0 if ladder.pairs else bool(names))) < 1e-9
            regret = AgentResults("a", suite.name, suite.digest, (0, 1), {name: np.full((2, 3), 0.5) for name in names})
            json.dumps(score(regret, suite).axes[ladder.axis].to_dict())
        for task in suite.core:
            own = task.stored_values
            assert own is None or 0 < own.reference.spread() < 1e299
        return True

    assert read()
    for place, options in changes.items():
        for value in options:
            forged_entry = copy.deepcopy(entry)
            *way, last = (int(word) if word.isdigit() else word for word in place.split())
            owner = forged_entry
            for word in way:
                owner = owner[word]
            owner[last] = value
            (tmp_path / "s.yaml").write_text(yaml.safe_dump(forged_entry))
            tally.note(f"{place} {str(value)[:20]}", *outcome(read, ("True",)))
    count(f"{tally.total} suites with the right digest: {tally}")
    tally.check()
    assert tally.total >= 250 and tally.counts["refused"] >= 150


def test_levels_in_the_cache(tmp_path, monkeypatch, count):
    """Levels that are damaged are written anew, or refused."""

    def read(folder):
        monkeypatch.setenv("PHAROS_CACHE_DIR", str(folder))
        return digest_of_task(Task(levels_of("frozen_lake", {"size": 4}, train=1, held_out=1), observation="recorded"))

    read(tmp_path / "cache")
    files = [path.relative_to(tmp_path / "cache") for path in (tmp_path / "cache" / "levels").rglob("*")]
    names = tuple(sorted(str(name) for name in files if (tmp_path / "cache" / name).is_file() and name.name != "lock"))
    (tmp_path / "copies").mkdir()
    tally = Attack(tmp_path / "cache", names, read, fewer=2).run(tmp_path / "copies")
    count(f"{tally.total} damaged files of levels in the cache: {tally}")
    assert tally.total >= 60 and tally.counts["unchanged"] >= 30


NAMES = ("../x", "../../x", "/tmp/x", ".", "..", "", "a/b", "a\\b", "a\nb", "a\0b", "a b", ".hidden", "-rf", "x" * 300)
CODE = ("evil.py:Evil", "evil:Evil", "./evil.py:Evil", "evil.py:", ":Evil", "os:system", "frozen_lake/4x4:x")
COMMANDS = (
    ("run", "--agent", "random", "--out", "deep/deep/out"),
    ("verify", "it.safetensors"),
    ("submit", "runs"),
    ("board", "it.safetensors", "--out", "board.html"),
)


def forged(suite, text, **changes):
    """The text of a suite whose first task was changed, with the digest that fits."""
    entry = yaml.safe_load(text)
    entry["core"][0] |= changes
    task = object.__new__(BenchmarkTask)  # which no name can be given that is refused
    task.__dict__.update({**vars(suite.core[0]), **changes})
    entry["digest"] = digest_of_suite(replace(suite, core=(task, *suite.core[1:])))
    return yaml.safe_dump(entry)


def test_hostile_suites_execute_and_write_nothing(suite, tmp_path, monkeypatch, count):
    place = tmp_path / "here"
    place.mkdir()
    monkeypatch.chdir(place)
    (place / "evil.py").write_text(CANARY)
    benchmark.run("random", suite, out="runs", seeds=range(2))
    benchmark.submit("runs", "it.safetensors", suite)
    write_suite(suite, "mini.yaml")
    text_of_suite = (place / "mini.yaml").read_text()
    cases = [{"name": name} for name in NAMES]
    cases += [{name: code} for name in ("environment", "observation") for code in CODE]
    options = [{"parameters": {"size": 4, "map": code}} for code in CODE]
    options += [{"observation_options": {"function": code}} for code in CODE]
    before, tally = _contents(tmp_path), Tally()
    for change, words in [*itertools.product(cases, COMMANDS), *itertools.product(options, COMMANDS[:2])]:
        (place / "received.yaml").write_text(forged(suite, text_of_suite, **change))
        what, text = outcome(lambda words=words: command("benchmark", *words, "--suite", "received.yaml"), ("",))
        (place / "received.yaml").unlink()
        if _contents(tmp_path) != before:
            what, text = "failed", f"wrote {_contents(tmp_path).keys() ^ before.keys()}"
        tally.note(f"{change} by {words[0]}", what, text)
    count(f"{tally.total} hostile suites: {tally}")
    tally.check()
    assert tally.counts["refused"] == tally.total >= 140


def _contents(folder):
    """Path -> bytes of all files below a folder, None of folders and links."""
    return {
        path: path.read_bytes() if path.is_file() and not path.is_symlink() else None
        for path in sorted(folder.rglob("*"))
        if "__pycache__" not in path.parts
    }


# Links ----------------------------------------------------------------------------------------------------------------


BLOCK = {"environments": ["frozen_lake/4x4"], "agents": ["q_learning"], "seeds": [0]}
STUDY = {"name": "mine", "steps": 64, "evaluations": 4, "blocks": [BLOCK]}
SMALL = {"n_steps": 16, "n_envs": 2, "batch_size": 16, "net_arch": [8]}
BREAKOUT = {"height": 7, "columns": 4, "brick_rows": 1}


def learn(env, steps, seed):
    """An agent that plays one action."""
    env.reset()
    try:
        while True:
            if any(env.step(0)[2:4]):
                env.reset()
    except BudgetSpent:
        yield lambda seen: np.zeros(len(seen), int)


def trained(agent, **options):
    def train(folder, _):
        setting = {"steps": 64, "evaluation_interval": 32, "out": folder, **options}
        return pharos.train(agent, "frozen_lake/4x4", **setting)

    return train


def built(folder, _):
    env = pharos.make("breakout", **BREAKOUT)
    return pharos.build(env, folder, progress=False)


def half_built(folder, _):
    with pytest.raises(pharos.errors.StateSpaceTooLarge):
        pharos.build(pharos.make("breakout", **BREAKOUT), folder, max_states=900, progress=False)


def imported(folder, _):
    rng = np.random.default_rng(0)
    mdp = TabularMDP.from_arrays(rng.integers(-1, 40, (40, 3)), rng.random((40, 3)))
    return importers.save(mdp, folder, observations=np.eye(40, dtype=np.float32))


def searched(folder, _):
    options = ["frozen_lake/4x4", "--steps", 60, "--seeds", 0]
    return command("tune", *options, "--trials", 2, "--out", folder)


# What makes a folder, what writes into it again, and files without which it does
DOORS = {
    "a table": (trained("q_learning"), trained("q_learning"), ["run.json"]),
    "a network": (*[trained("ppo", engine="batched", hyperparameters=SMALL)] * 2, ["run.json"]),
    "a benchmark's tables": (
        *[lambda folder, suite: benchmark.run("q_learning", suite, out=folder, seeds=[0], tasks="sea", workers=1)] * 2,
        ["runs/*/*/run.json"],
    ),
    "a benchmark's generator": (
        *[lambda folder, suite: benchmark.run(learn, suite, out=folder, seeds=[0], tasks="sea")] * 2,
        ["runs/*/*/run.json"],
    ),
    "a study": (*[lambda folder, _: study.run(STUDY, folder, workers=1)] * 2, ["runs/*/run.json"]),
    "states": (half_built, built, []),
    "an import": (imported, imported, []),
    "a search": (searched, searched, ["tuning.json"]),
}


def places(folder):
    """Files and folders below a folder, and a lock in each folder."""
    found = [path.relative_to(folder) for path in folder.rglob("*")]
    return sorted({*found, Path("lock"), *(path / "lock" for path in found if (folder / path).is_dir())})


@pytest.mark.parametrize("name", DOORS)
def test_links_in_folders_of_results(name, suite, tmp_path, count, monkeypatch):
    """Each file and folder in turn is a link to its copy elsewhere, to nothing or to a device: none is written to."""
    monkeypatch.setattr("attacks.damage.SECONDS", 120)  # each is a run of its own
    make, again, forgotten = DOORS[name]
    whole = tmp_path / "whole"
    with redirect_stderr(io.StringIO()):
        make(whole, suite)
    tally = Tally()
    for number, (place, leads_to) in enumerate(itertools.product(places(whole), ("its copy", "nothing", "/dev/full"))):
        if number % 3 and number // 3 % 3 != number % 3:  # a third of the places, for each of the other two
            continue
        copied, elsewhere = tmp_path / f"{number}" / "results", tmp_path / f"{number}" / "elsewhere"
        shutil.copytree(whole, copied, symlinks=True)
        for pattern in forgotten:
            for path in copied.glob(pattern):
                path.unlink()
        shutil.copytree(copied, elsewhere)
        link, target = copied / place, elsewhere / place
        if target.name == "lock" and not target.exists():
            target.write_text("precious")
        if leads_to == "nothing" and target.exists():
            shutil.rmtree(target) if target.is_dir() else target.unlink()
        if link.exists():
            shutil.rmtree(link) if link.is_dir() else link.unlink()
        link.symlink_to(leads_to if leads_to.startswith("/dev") else target)
        before = _contents(elsewhere)
        what, text = outcome(lambda folder=copied: _done(again, folder, suite), ("None",))
        if _contents(elsewhere) != before:
            what, text = "failed", "another file was written"
        tally.note(f"{place} leads to {leads_to}", what, text)
        shutil.rmtree(tmp_path / f"{number}")
    count(f"{tally.total} links in the folder of {name}: {tally}")
    tally.check()
    assert tally.total >= max(5, len(places(whole))) and tally.counts["unchanged"] >= 1  # every place, and more


def _done(again, folder, suite):
    """Write into a folder again; what the system says of a file is one line of a command."""
    try:
        with redirect_stderr(io.StringIO()):
            again(folder, suite)
    except OSError as error:
        if isinstance(error, PharosError) or not error.filename:
            raise
        raise Refused(f"{error.filename}: {error.strerror}") from error


# Copies ---------------------------------------------------------------------------------------------------------------


class Witness:
    """The number of steps that environments of pharos take in this process and in all that are forked from it."""

    def __init__(self, monkeypatch):
        self.steps = multiprocessing.get_context("fork").Value("q", 0)
        step = GymEnv.step

        def seen(env, action):
            result = step(env, action)
            with self.steps.get_lock():
                self.steps.value += 1
            return result

        monkeypatch.setattr(GymEnv, "step", seen)


def play(env, steps=60):
    """Play with an environment, which was reset or was not."""
    env.reset()
    for _ in range(steps):
        if any(env.step(0)[2:4]):
            env.reset()


def play_vector(envs, steps=60):
    """Play with a vector environment of Gymnasium."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium logs the traceback of a worker
            envs.reset()
            for _ in range(steps):
                envs.step(np.zeros(envs.num_envs, int))
    finally:
        envs.close(**({"terminate": True} if isinstance(envs, gymnasium.vector.AsyncVectorEnv) else {}))


def play_sb3(envs, steps=60):
    """Play with a vector environment of Stable-Baselines3."""
    try:
        envs.reset()
        for _ in range(steps):
            envs.step(np.zeros(envs.num_envs, int))
    finally:
        if type(envs).__name__ != "SubprocVecEnv":
            envs.close()


def fork(work):
    """Work in a fork; its error is this process' error."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def child():
        try:
            work()
            sender.send(None)
        except ParameterError as error:
            sender.send(str(error))

    process = context.Process(target=child)
    process.start()
    error = receiver.recv()
    process.join()
    if error is not None:
        raise ParameterError(error)


def threads(env):
    """Play in threads."""
    started = [threading.Thread(target=_quietly, args=(env.copy(),)) for _ in range(4)]
    for each in started:
        each.start()
    for each in started:
        each.join()


def _quietly(env):
    with suppress(BudgetSpent):
        play(env)


def in_pool(env, kind):
    """Play in a process of a pool."""
    with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context(kind)) as pool:
        pool.submit(play, env).result()


class Holder:
    """An object that has an environment somewhere."""

    def __init__(self, env):
        self.parts = {"env": [env]}


def _async(env, kind):
    play_vector(gymnasium.vector.AsyncVectorEnv([env.copy] * 2, context=kind))


def _subprocesses(env, kind):
    from stable_baselines3.common.vec_env import SubprocVecEnv

    play_sb3(SubprocVecEnv([env.copy] * 2, start_method=kind))


def _dummy(env):
    from stable_baselines3.common.vec_env import DummyVecEnv

    play_sb3(copy.deepcopy(DummyVecEnv([env.copy] * 4)))


def _unpickled(env, protocol):
    play(pickle.loads(pickle.dumps(env, protocol)))


def _cloudpickled(env):
    import cloudpickle

    play(pickle.loads(cloudpickle.dumps(lambda: env))())


MEANS = {
    "itself": lambda env: [play(env) for _ in range(4)],
    "env.copy": lambda env: [play(env.copy()) for _ in range(4)],
    "copies of copies": lambda env: [play(env.copy().copy().copy()) for _ in range(4)],
    "copy.copy": lambda env: [play(copy.copy(env)) for _ in range(4)],
    "copy.deepcopy": lambda env: [play(copy.deepcopy(env)) for _ in range(4)],
    "copy.replace": lambda env: [play(type(env)(env._task, env.budget, k)) for k in range(4)],
    "a list": lambda env: [play(each) for each in copy.deepcopy([env] * 4)],
    "a holder": lambda env: [play(copy.deepcopy(Holder(env)).parts["env"][0]) for _ in range(4)],
    "a wrapper": lambda env: [play(copy.deepcopy(gymnasium.wrappers.OrderEnforcing(env))) for _ in range(4)],
    "a method": lambda env: [play(copy.deepcopy(env.reset).__self__) for _ in range(4)],
    "a vector": lambda env: play_vector(copy.deepcopy(gymnasium.vector.SyncVectorEnv([env.copy] * 4))),
    "a vector of deep copies": lambda env: play_vector(
        gymnasium.vector.SyncVectorEnv([lambda: copy.deepcopy(env) for _ in range(4)])
    ),
    "Stable-Baselines3": _dummy,
    "threads": threads,
    "a fork": lambda env: fork(lambda: play(env)),
    "a copy in a fork": lambda env: fork(lambda: play(env.copy())),
    "a deep copy in a fork": lambda env: fork(lambda: play(copy.deepcopy(env))),
    "a fork of a copy": lambda env: (lambda twin: fork(lambda: play(twin)))(copy.deepcopy(env)),
    "cloudpickle": _cloudpickled,
    **{f"pickle {k}": lambda env, k=k: _unpickled(env, k) for k in range(pickle.HIGHEST_PROTOCOL + 1)},
    **{f"a pool by {kind}": lambda env, kind=kind: in_pool(env, kind) for kind in ("spawn", "fork", "forkserver")},
    **{f"asynchronous by {kind}": lambda env, kind=kind: _async(env, kind) for kind in ("fork", "spawn", "forkserver")},
    **{f"processes by {kind}": lambda env, kind=kind: _subprocesses(env, kind) for kind in ("spawn", "forkserver")},
}
COUNTED = 14
"""Of MEANS, the first ones, which are an honest way; the others are refused."""


@pytest.mark.filterwarnings("ignore")
def test_copies_of_the_environment(monkeypatch, count):
    pytest.importorskip("stable_baselines3")
    witness, tally = Witness(monkeypatch), Tally()
    for (number, (name, means)), task, begins, wants in itertools.product(
        enumerate(MEANS.items()), (SEA, LAKE), (False, True), (60, 2000)
    ):
        if number >= COUNTED and wants > 60:
            continue
        solved, before = task.training_task(PROTOCOL), witness.steps.value

        def learn(env, steps, seed, means=means, begins=begins, wants=wants):
            if begins:
                play(env, 7)
            for _ in range(wants // 60):
                means(env)
            yield lambda seen: np.zeros(len(seen), int)

        what, text = outcome(lambda learn=learn, solved=solved: _counted(learn, solved), ("",))
        taken = witness.steps.value - before
        if what == "failed" and text.startswith("another answer: "):
            counted = int(text.removeprefix("another answer: ").partition(";")[0])
            honest = counted == taken <= PROTOCOL.steps and number < COUNTED
            what, text = ("unchanged", "") if honest else ("failed", f"{counted} counted of {taken}")
        elif what == "refused" and (number < COUNTED or taken > 7 or "env.copy" not in text):
            what = "failed"
        tally.note(f"{name} of {task.name}", what, text)
    count(f"{tally.total} copies of a benchmark's environment: {tally}")
    tally.check()
    assert tally.total >= 160 and tally.counts["refused"] >= 40


def _counted(learn, task):
    with redirect_stderr(io.StringIO()):
        return generated_curve(learn, task, steps=PROTOCOL.steps, evaluations=3, seed=0).counted_steps
