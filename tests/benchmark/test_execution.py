"""Runs of agents on a small suite: forms, budget, misuse, and folders that go on."""

import json
import math
import random
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from command_line import answer, process
from edits import edited_json
from patience import PATIENCE, wait_for
from pharos import benchmark, evaluate_policy
from pharos.benchmark import BenchmarkTask, BudgetSpent, Ladder, Protocol, Suite, write_suite
from pharos.benchmark.suite import EARLIER, digest_of_suite, frozen
from pharos.errors import AllRunsFailed, ParameterError, UnknownName
from pharos.system.sources import find_source, load_source
from pharos.training import generated_curve, write_curve
from refusals import refusal

PROTOCOL = Protocol(steps=300, evaluations=3, seeds=2)
SEA = {"size": 4, "mapping_seed": 1}
TASKS = (
    BenchmarkTask("sea", "deep_sea", SEA, "one_hot"),
    BenchmarkTask("lake", "frozen_lake", {}, "vector", chance={"sticky": 0.25}),
    BenchmarkTask("sea-5", "deep_sea", {**SEA, "size": 5}, "one_hot", axis="exploration", level=5.0),
)
LEARN = """
import numpy as np

def learn(env, steps, seed):
    draw = np.random.default_rng(seed)
    env.reset(seed=seed)
    wins = np.zeros(env.action_space.n)
    while True:
        action = int(draw.integers(len(wins)))
        _, reward, terminated, truncated, _ = env.step(action)
        wins[action] += reward
        if terminated or truncated:
            env.reset()
            yield lambda observations: np.full(len(observations), wins.argmax())
"""


@pytest.fixture(scope="module")
def suite():
    made = [frozen(task, PROTOCOL) for task in TASKS]
    ladder = Ladder("exploration", "bits", "size", (made[2],))
    whole = Suite("small", PROTOCOL, tuple(made[:2]), (ladder,), "", {})
    return replace(whole, digest=digest_of_suite(whole))


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(LEARN)
    return path


def always(action):
    return lambda observations: np.full(len(observations), action)


def curve_of(learn, task=TASKS[0], seed=0, **changes):
    protocol = replace(PROTOCOL, **changes)
    solved = task.training_task(protocol)
    return solved, generated_curve(learn, solved, steps=protocol.steps, evaluations=protocol.evaluations, seed=seed)


# Reference policies ---------------------------------------------------------------------------------------------------


def test_the_oracle_has_no_regret_and_random_play_all_of_it(suite, tmp_path):
    for name, expected in (("oracle", 0.0), ("random", 1.0)):
        found = benchmark.run(name, suite, out=tmp_path / name, seeds=range(2))
        assert list(found.results.curves) == ["lake", "sea", "sea-5"]
        for curve in found.results.curves.values():
            assert curve.shape == (2, 3)
            np.testing.assert_allclose(curve, expected, atol=1e-6)
        assert all(found.results.record["exact"].values()) and not found.missing
        assert abs(found.score.value - (1 - expected)) < 1e-6
        assert np.isnan(found.axes["exploration"].frontier.value)  # of a single rung
        said = json.loads((tmp_path / name / "score.json").read_text())
        assert said["core"]["value"] == found.score.value and said["agent"] == name


def test_results_have_the_regret_of_returns_of_the_last_third(suite, tmp_path):
    """Of an agent that writes down its returns, and whose policy is another one than what it plays."""
    (tmp_path / "noted.py").write_text(
        "def learn(env, steps, seed):\n"
        "    observation, _ = env.reset(seed=seed)\n"
        "    total, returns = 0.0, []\n"
        "    for step in range(steps):\n"
        "        _, reward, terminated, truncated, _ = env.step(1)\n"
        "        total += reward\n"
        "        if terminated or truncated:\n"
        "            returns += [total] * (step >= 200)\n"
        "            total = 0.0\n"
        "            env.reset()\n"
        f"    with open(f'{tmp_path}/returns-{{observation.size}}-{{seed}}', 'w') as file:\n"
        "        file.write(repr(returns))\n"
        "    yield lambda seen: [0] * len(seen)\n"
    )
    found = benchmark.run(f"{tmp_path / 'noted.py'}:learn", suite, out=tmp_path / "runs", seeds=range(2))
    play = found.results.record["play"]
    assert set(play) == {task.name for task in suite.tasks}
    for task, size in zip(suite.tasks, (9, 2, 11), strict=True):
        values = task.training_task(suite.protocol).reference
        returns = [json.loads((tmp_path / f"returns-{size}-{seed}").read_text()) for seed in range(2)]
        lost = [(values.optimal - sum(each) / len(each)) / (values.optimal - values.uniform) for each in returns]
        assert play[task.name]["regret"] == pytest.approx(sum(lost) / 2)
        assert play[task.name]["episodes"] == sum(map(len, returns)) / 2


def test_of_what_solves_and_does_not_play_there_is_no_play(suite, tmp_path):
    assert "play" not in benchmark.run("oracle", suite, out=tmp_path, seeds=range(2)).results.record


@pytest.mark.long
def test_a_run_answers_with_scores_intervals_and_the_steps_that_were_used(suite, tmp_path):
    """Of 300 steps an agent that stops after 20 uses 20; Q-learning uses all."""
    write_suite(suite, tmp_path / "small.yaml")
    code = "\n    for _ in range(20):\n        if any(env.step(0)[2:4]):\n            env.reset()\n"
    (tmp_path / "brief.py").write_text(
        f"def learn(env, steps, seed):\n    env.reset(){code}    yield lambda seen: [0] * len(seen)\n"
    )
    options = ("--suite", tmp_path / "small.yaml", "--seeds", 2)
    for agent, steps in ((f"{tmp_path / 'brief.py'}:learn", 20), ("q_learning", 300), ("oracle", 0)):
        folder = tmp_path / f"runs-{steps}"
        said = answer("benchmark", "run", "--agent", agent, *options, "--out", folder)
        stored = json.loads((folder / "score.json").read_text())
        assert said["steps_used"] == 3 * 2 * steps
        assert said["score"] == {
            "value": stored["core"]["value"],
            "lower": stored["core"]["low"],
            "upper": stored["core"]["high"],
        }
        scores = {each["name"]: each["score"] for each in said["tasks"]}
        assert {name: each["value"] for name, each in scores.items()} == {
            name: each["value"] for name, each in stored["tasks"].items()
        }
        axis = said["axes"]["exploration"]
        assert axis["score"]["value"] == scores["sea-5"]["value"] and axis["frontier"]["unit"] == "bits"
        assert axis["frontier"]["censored"] in ("above", "below", "") and set(axis["frontier"]) >= {"lower", "upper"}
    said = answer("benchmark", "run", "--agent", "oracle", *options, "--tasks", "sea-5", "--out", tmp_path / "ladder")
    assert said["score"] is None and [each["name"] for each in said["tasks"]] == ["sea-5"]


# Generators -----------------------------------------------------------------------------------------------------------


def test_the_last_snapshot_counts_as_it_was_when_it_was_yielded():
    """Points are at 100, 200 and 300 steps: nothing yet, then action 1; what is yielded at a point counts there."""
    choice = [1]

    def learn(env, steps, seed):
        env.reset()
        for step in range(1, steps + 1):
            _, _, terminated, truncated, _ = env.step(0)
            if terminated or truncated:
                env.reset()
            if step == 150:
                yield lambda observations: np.full(len(observations), choice[0])
                choice[0] = 0  # the policy that was yielded is another one from here on
            if step == 300:
                yield always(0)

    solved, curve = curve_of(learn)
    states = solved.mdp.num_states
    values = [evaluate_policy(solved.mdp, np.full(states, action)).value_at_start for action in (0, 1)]
    uniform = solved.reference.uniform
    assert values[0] != values[1]
    np.testing.assert_allclose([row["value"] for row in curve.rows], [uniform, uniform, values[1], values[0]])
    assert [row["step"] for row in curve.rows] == [0, 100, 200, 300]
    assert curve.rows[-1]["episodes"] == 300 // 4 and all(row["exact"] for row in curve.rows)


def test_the_budget_ends_what_would_go_on_for_ever():
    taken = []

    def learn(env, steps, seed):
        env.reset()
        try:
            while True:
                _, _, terminated, truncated, _ = env.step(0)
                taken.append(1)
                if terminated or truncated:
                    env.reset()
                yield always(0)
        except BudgetSpent:
            taken.append("spent")
            raise

    curve_of(learn)
    assert taken.count(1) == 300 and taken[-1] == "spent"


def test_a_policy_with_a_memory_counts_as_it_was_when_it_was_yielded():
    """It plays `moves[t]` at step t, which the agent overwrites after each snapshot."""

    class Moves:
        moves = np.zeros(5, np.int64)

        def initial_state(self, n):
            return np.zeros(n, np.int64)

        def __call__(self, observations, state, starts):
            return self.moves[state], state + 1

    policy = Moves()

    def learn(env, steps, seed):
        for part in range(3):
            env.reset()
            for _ in range(100):
                _, _, terminated, truncated, _ = env.step(0)
                if terminated or truncated:
                    env.reset()
            policy.moves = np.full(5, part % 2)
            yield policy
        policy.moves = np.full(5, 7)

    solved, curve = curve_of(learn, replace(TASKS[0], chance={"sticky": 0.25}))
    values = [evaluate_policy(solved.mdp, np.full(solved.mdp.num_states, a)).value_at_start for a in (0, 1, 0)]
    assert [row["value"] for row in curve.rows[1:]] == pytest.approx(values, abs=1e-12)


def test_an_agent_that_ends_early_keeps_its_last_policy():
    def learn(env, steps, seed):
        env.reset()
        env.step(0)
        yield always(1)

    _, curve = curve_of(learn)
    values = [row["value"] for row in curve.rows]
    assert values[1] == values[2] == values[3] and curve.rows[-1]["episodes"] == 0
    assert curve.counted_steps == curve.result()["counted_steps"] == 1


def test_copies_share_the_budget_and_have_other_random_numbers():
    import gymnasium

    seen = {}

    def learn(env, steps, seed):
        envs = gymnasium.vector.SyncVectorEnv([env.copy] * 4)
        envs.reset()
        states = []
        while True:
            envs.step(np.full(4, len(states) % 4))
            states.append([tuple(each.unwrapped.state) for each in envs.envs])
            seen["steps"], seen["states"] = env.budget.steps, states
            yield always(0)

    curve_of(learn, TASKS[1])
    assert 290 <= seen["steps"] <= 300
    assert any(len(set(row)) > 1 for row in seen["states"])


def test_the_action_space_is_that_of_the_seed():
    drawn = []

    def learn(env, steps, seed):
        drawn.append([env.action_space.sample() for _ in range(40)])
        yield from ()

    for seed in (0, 0, 1):
        curve_of(learn, seed=seed)
    assert drawn[0] == drawn[1] != drawn[2]


def test_tables_probabilities_and_networks_in_a_wrapper_are_policies():
    def yielding(policy):
        def learn(env, steps, seed):
            env.reset()
            env.step(0)
            yield policy

        return curve_of(learn, TASKS[1])

    solved, curve = yielding(lambda seen: np.full((len(seen), 4), 0.25))
    np.testing.assert_allclose(curve.rows[-1]["normalized_regret"], 1.0)
    _, same = yielding(np.full((solved.mdp.num_states, 4), 0.25))
    assert same.rows[-1]["value"] == pytest.approx(curve.rows[-1]["value"])


@pytest.mark.parametrize(
    ("policy", "said"),
    [
        (lambda seen: np.full((len(seen), 2), np.nan), "NaN"),
        (lambda seen: np.zeros((len(seen), 3)), r"shape \(\d+, 3\)"),
        (lambda seen: np.full((len(seen), 2), 0.3), "sum to 0.6"),
        (lambda seen: np.full(len(seen), 7), "action 7"),
        (lambda seen: np.zeros(1), "shape"),
        (lambda seen: np.zeros(len(seen)), r"shape \(\d+,\) of float64 for .*actions, which are integers"),
        (lambda seen: np.zeros(len(seen), bool), r"shape \(\d+,\) of bool for .*actions, which are integers"),
        (3, "expected a policy"),
    ],
)
def test_answers_that_are_no_policy_are_said(suite, tmp_path, policy, said):
    def learn(env, steps, seed):
        yield policy

    with pytest.raises(AllRunsFailed, match=said) as error:
        benchmark.run(learn, suite, out=tmp_path, seeds=[5], tasks="sea")
    assert "on sea, seed 5" in str(error.value)


def test_a_run_that_fails_stops_no_other(suite, tmp_path):
    def learn(env, steps, seed):
        if env.action_space.n == 4 and seed == 1:
            raise RuntimeError("no idea")
        env.reset()
        env.step(0)
        yield always(0)

    found = benchmark.run(learn, suite, out=tmp_path, seeds=range(2))
    assert list(found.results.curves) == ["sea", "sea-5"]
    assert list(found.missing) == ["lake, seed 1"] and "RuntimeError: no idea" in found.missing["lake, seed 1"]


def test_what_is_no_generator_is_refused(suite, tmp_path):
    with pytest.raises(ParameterError, match="learn"):
        benchmark.run(lambda env: None, suite, out=tmp_path)
    with pytest.raises(AllRunsFailed, match="expected a generator"):
        benchmark.run(lambda env, steps, seed: None, suite, out=tmp_path, seeds=[0])


@pytest.mark.parametrize("timeout", [-1, 0, math.nan, True, "60"])
def test_a_timeout_that_is_no_time_is_refused_before_anything_runs(timeout, suite, tmp_path):
    for call in (partial(benchmark.run, suite=suite, out=tmp_path / "out"), benchmark.check_agent, benchmark.diagnose):
        assert "expected a number of seconds above 0" in refusal(ParameterError, call, "q_learning", timeout=timeout)
    assert not (tmp_path / "out").exists()


# Folders --------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_file_runs_in_processes_to_the_same_bytes(suite, file, tmp_path):
    found = [
        benchmark.run(f"{file}:learn", suite, out=tmp_path / str(workers), seeds=range(2), workers=workers)
        for workers in (1, 2)
    ]
    first, second = ((tmp_path / str(workers) / "results.safetensors").read_bytes() for workers in (1, 2))
    assert first == second and not found[0].missing
    agent = json.loads((tmp_path / "1" / "agent.json").read_text())
    assert agent["form"] == "generator" and agent["agent"] == "mine.py:learn"
    assert agent["source"]["sha256"] == benchmark.agents.sha256(file)


@pytest.mark.long
def test_a_full_disk_is_said_by_the_runs_of_a_generator(suite, tmp_path, monkeypatch):
    monkeypatch.setattr("pharos.benchmark.agents.write_curve", write_curve)  # is set back: this process loads it too
    full = "raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), '/results/curve.csv')"
    text = f"import errno, os\nfrom pharos.benchmark import agents\n\ndef write(*_):\n    {full}\n\n"
    text += "agents.write_curve = write\n"
    (tmp_path / "mine.py").write_text(text + LEARN)
    with pytest.raises(AllRunsFailed) as error:
        benchmark.run(f"{tmp_path / 'mine.py'}:learn", suite, out=tmp_path / "out", seeds=range(2), tasks="sea")
    assert {*error.value.outcome.missing.values()} == {"No space left on device; the same command goes on"}


DEATHS = {
    "os._exit(3)": "its process ended with exit code 3",
    "os._exit(78)": "its process ended with exit code 78",  # with which pharos' own workers say something else
    "os.kill(os.getpid(), signal.SIGSEGV)": "its process ended by SIGSEGV",
    "os.kill(os.getpid(), signal.SIGKILL)": "its process ended by SIGKILL; was there memory enough?",
    "sys.exit('no data')": "SystemExit: no data (mine.py, line 7)",
    "raise KeyboardInterrupt": "KeyboardInterrupt (mine.py, line 7)",
    "raise MemoryError": "MemoryError (mine.py, line 7)",
    "raise ValueError('a\\nb\\x1b')": "ValueError: a b\\x1b (mine.py, line 7)",
}


@pytest.mark.long
@pytest.mark.parametrize("death", DEATHS)
def test_a_run_that_dies_says_why_stops_no_other_and_is_the_only_one_that_is_repeated(suite, tmp_path, death):
    write_suite(suite, tmp_path / "small.yaml")
    code = LEARN.replace("import numpy as np\n", "import os, signal, sys, time\nimport numpy as np\n")
    code = code.replace(
        "    draw =", f"    if seed == 1 and not os.path.exists('mended'):\n        {death}\n    draw =", 1
    )
    assert code.splitlines()[6].strip() == death
    (tmp_path / "mine.py").write_text(code)
    line = "benchmark run --agent mine.py:learn --suite small.yaml --seeds 3 --tasks sea --workers 1 --out out --json"
    done = process(*line.split(), cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    said = json.loads(done.stdout)["failed"]
    assert list(said) == ["sea, seed 1"] and said["sea, seed 1"].startswith(
        f"mine.py:learn on sea, seed 1: {DEATHS[death]}"
    )
    assert len([line for line in done.stderr.splitlines() if "seed 1" in line]) == 1
    runs = {path.parent.name: path for path in (tmp_path / "out").glob("runs/sea/*/run.json")}
    records = {name: json.loads(path.read_text()) for name, path in runs.items()}
    assert {name: record["status"] for name, record in records.items()} == {
        "seed-0": "finished",
        "seed-1": "failed",
        "seed-2": "finished",
    }
    assert records["seed-1"]["error"] == said["sea, seed 1"]
    (tmp_path / "mended").touch()
    done = process(*line.split(), cwd=tmp_path)
    assert done.returncode == 0 and json.loads(done.stdout)["failed"] == {}, done.stderr
    after = {name: json.loads(path.read_text()) for name, path in runs.items()}
    assert {name for name in after if after[name] != records[name]} == {"seed-1"}


STATEFUL = """
import os, random, sys, threading
import numpy as np

memory, times = [], np.zeros(1)
os.environ["OF_THIS_AGENT"] = os.environ.get("OF_THIS_AGENT", "") + "x"


class Agent:
    runs = 0


def learn(env, steps, seed):
    import fractions

    traces = [len(memory), Agent.runs, times[0], hasattr(fractions, "trace"), threading.active_count() > 2]
    traces += [len(os.environ["OF_THIS_AGENT"]) > 2, os.getcwd().endswith("elsewhere"), np.geterr()["divide"]]
    memory.append(seed)
    Agent.runs += 1
    times[0] += 1
    fractions.trace = True
    os.environ["OF_THIS_AGENT"] = "xxx"
    os.makedirs("elsewhere", exist_ok=True)
    os.chdir("elsewhere")
    np.seterr(divide="ignore")
    threading.Thread(target=threading.Event().wait, daemon=True).start()
    print("traces", traces, random.random() + np.random.rand(), file=sys.stderr)
    env.reset()
    for _ in range(steps):
        if any(env.step(0)[2:4]):
            env.reset()
    yield lambda seen: np.zeros(len(seen), int)
"""


@pytest.mark.long
def test_nothing_of_a_run_reaches_another(suite, tmp_path):
    """Globals, class attributes, arrays, modules of others, threads, variables, working directory, global settings."""
    (tmp_path / "mine.py").write_text(STATEFUL)
    write_suite(suite, tmp_path / "small.yaml")
    line = "benchmark run --agent mine.py:learn --suite small.yaml --seeds 2 --workers 1 --out out"
    done = process(*line.split(), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = [line.rpartition(" ") for line in done.stderr.splitlines() if line.startswith("traces")]
    assert [line[0] for line in lines] == ["traces [0, 0, np.float64(0.0), False, False, False, False, 'warn']"] * 6
    numbers = [line[2] for line in lines]
    assert len(set(numbers)) == 2  # global random numbers are those of the seed
    assert len([*(tmp_path / "out").glob("runs/*/*/run.json")]) == 6


@pytest.mark.slow
def test_what_no_other_process_can_import_has_processes_too(suite, tmp_path):
    memory = []

    def learn(env, steps, seed):
        memory.append(seed)
        env.reset()
        env.step(0)
        yield always(len(memory) - 1)  # the same action in each run

    outcome = benchmark.run(learn, suite, out=tmp_path / "out", seeds=range(2), tasks="sea")
    assert not memory and not outcome.missing
    assert (outcome.results.curves["sea"][0] == outcome.results.curves["sea"][1]).all()

    lock = threading.Lock()

    def locked(env, steps, seed):
        yield lock

    with pytest.raises(ParameterError, match=r"locked.*cannot be sent to the process of a run.*file\.py:learn"):
        benchmark.run(locked, suite, out=tmp_path / "locked", seeds=[0], tasks="sea")


@pytest.mark.slow
def test_a_file_imports_files_beside_it_at_the_top_and_in_functions(suite, tmp_path):
    for name in ("beside_at_the_top", "beside_in_a_function"):
        (tmp_path / f"{name}.py").write_text("import numpy as np\n\ndef act(n):\n    return np.zeros(n, int)\n")
    text = LEARN.replace("import numpy", "from beside_at_the_top import act\nimport numpy", 1)
    lines = "    from beside_in_a_function import act as same\n    assert same(3).sum() == act(3).sum()\n    draw ="
    text = text.replace("    draw =", lines)
    (tmp_path / "mine.py").write_text(text)
    path = list(sys.path)
    assert not benchmark.run(
        f"{tmp_path / 'mine.py'}:learn", suite, out=tmp_path / "out", seeds=[0], tasks="sea"
    ).missing
    assert sys.path == path
    sys.modules.pop("beside_at_the_top")


@pytest.mark.slow
def test_keywords_of_a_function_are_its_hyperparameters(suite, file, tmp_path):
    file.write_text(LEARN.replace("seed):", "seed, *, best=0):").replace("wins.argmax()", "best"))
    words = "benchmark", "run", "--agent", f"{file}:learn", "--tasks", "sea", "--seeds", "1", "--out", tmp_path / "out"
    write_suite(suite, tmp_path / "small.yaml")
    answer(*words, "--suite", tmp_path / "small.yaml", "--set", "best=1")
    assert (np.load(tmp_path / "out/runs/sea/seed-0/policy.npy").argmax(axis=1) == 1).all()
    assert json.loads((tmp_path / "out/agent.json").read_text())["hyperparameters"] == {"best": 1}
    with pytest.raises(ParameterError, match="holds runs with another hyperparameters"):
        benchmark.run(f"{file}:learn", suite, out=tmp_path / "out")
    with pytest.raises(UnknownName, match="did you mean 'best'"):
        benchmark.run(f"{file}:learn", suite, out=tmp_path / "out", hyperparameters={"bset": 1})


@pytest.mark.slow
def test_a_run_that_has_ended_may_leave_threads_behind(suite, file, tmp_path, monkeypatch):
    monkeypatch.setattr("pharos.benchmark.agents.LINGER_SECONDS", 0.5)
    text = "    import threading\n    threading.Thread(target=threading.Event().wait).start()\n    draw ="
    file.write_text(LEARN.replace("    draw =", text, 1))
    assert not benchmark.run(f"{file}:learn", suite, out=tmp_path / "out", seeds=range(2), tasks="sea").missing


@pytest.mark.long
def test_a_class_for_stable_baselines3_has_a_process_for_each_run(suite, tmp_path):
    pytest.importorskip("stable_baselines3")
    text = "import os\nfrom stable_baselines3 import DQN\n\nmade = []\n\n\nclass Mine(DQN):\n"
    text += "    def __init__(self, *args, seed=None, **options):\n        assert not made\n        made.append(seed)\n"
    text += (
        "        if seed == 1:\n            os._exit(9)\n        if seed == 2:\n            raise SystemExit('no')\n"
    )
    text += "        super().__init__(*args, seed=seed, **options)\n"
    (tmp_path / "own.py").write_text(text)
    with pytest.raises(AllRunsFailed) as error:
        benchmark.run(
            f"{tmp_path / 'own.py'}:Mine", suite, out=tmp_path / "out", seeds=range(4), tasks="sea", workers=2
        )
    said = error.value.outcome.missing
    assert list(said) == ["sea, seed 1", "sea, seed 2"]
    assert "exit code 9" in said["sea, seed 1"] and "SystemExit: no (own.py, line " in said["sea, seed 2"]
    records = [json.loads((tmp_path / "out/runs/sea" / f"seed-{k}" / "run.json").read_text()) for k in range(4)]
    assert [record["status"] for record in records] == ["finished", "failed", "failed", "finished"]
    assert records[1]["error"] == said["sea, seed 1"]


@pytest.mark.long
def test_streams_may_be_closed_and_a_folder_need_not_be_of_utf8(suite, file, tmp_path):
    """As a job scheduler begins it; processes of the generator have closed streams as well."""
    write_suite(suite, tmp_path / "small.yaml")
    words = "--agent mine.py:learn --suite small.yaml --seeds 1 --tasks sea --workers 1 --out bad\udcff"
    command = f"exec {sys.executable} -m pharos benchmark run {words} <&- >&- 2>&-"
    for _ in range(2):  # whole, and read again
        assert subprocess.run(command, shell=True, cwd=tmp_path, timeout=PATIENCE, check=False).returncode == 0
    found = benchmark.read_results(tmp_path / "bad\udcff")
    assert found.curves["sea"].shape == (1, 3)
    record = json.loads((tmp_path / "bad\udcff" / "runs" / "sea" / "seed-0" / "run.json").read_text())
    assert record["status"] == "finished" and record["result"]["counted_steps"] == 300


def test_a_folder_holds_one_agent_with_one_setting_of_one_suite(suite, file, tmp_path, monkeypatch):
    out = tmp_path / "out"
    benchmark.run("oracle", suite, out=out, seeds=[0], tasks="sea")
    benchmark.run("oracle", suite, out=out, seeds=range(3))  # more of the same
    with pytest.raises(ParameterError, match=r"holds runs with another agent: oracle, now random"):
        benchmark.run("random", suite, out=out, seeds=[0])
    with edited_json(out / "suite.json") as entry:
        entry["suite_digest"] = "0" * 64
    monkeypatch.setitem(EARLIER, "0" * 64, suite.digest)
    assert benchmark.run("oracle", suite, out=out, seeds=[0], tasks="sea").results.digest == suite.digest
    other = replace(suite, core=suite.core[:1])
    with pytest.raises(ParameterError, match="another suite_digest"):
        benchmark.run("oracle", replace(other, digest=digest_of_suite(other)), out=out, seeds=[0])
    out = tmp_path / "mine"
    benchmark.run(f"{file}:learn", suite, out=out, seeds=[0], tasks="sea", workers=1)
    file.write_text(LEARN + "# changed\n")
    with pytest.raises(ParameterError, match="another source"):
        benchmark.run(f"{file}:learn", suite, out=out, seeds=[0], tasks="sea")


def test_what_is_wrong_is_said_before_anything_runs(suite, file, tmp_path):
    for options, error, said in (
        ({"agent": "dqm"}, UnknownName, "did you mean 'dqn'"),
        ({"agent": f"{file}:nothing"}, ParameterError, "mine.py has no 'nothing'"),
        ({"agent": str(file)}, ParameterError, "mine.py:learn"),
        ({"agent": "dqn", "hyperparameters": {"learning_rat": 1}}, ParameterError, "learning_rat"),
        ({"agent": "oracle", "hyperparameters": {"a": 1}}, ParameterError, "no hyperparameters"),
        ({"agent": f"{file}:learn", "hyperparameters": {"a": 1}}, ParameterError, "in its code"),
        ({"seeds": [1, 1]}, ParameterError, "each once"),
        ({"tasks": "explorations"}, UnknownName, "did you mean 'exploration'"),
    ):
        with pytest.raises(error, match=said):
            benchmark.run(**{"agent": "oracle", "suite": suite, "out": tmp_path / "out", **options})
    assert not (tmp_path / "out").exists()


def test_a_task_that_is_another_one_here_is_refused_by_name(suite, tmp_path):
    other = replace(suite, core=(replace(suite.core[0], digest="0" * 64), *suite.core[1:]))
    with pytest.raises(ParameterError, match="task sea"):
        benchmark.run("oracle", other, out=tmp_path)


def test_quick_is_three_seeds_of_the_core(suite, tmp_path):
    found = benchmark.run("oracle", suite, out=tmp_path, quick=True)
    assert found.results.seeds == (0, 1, 2) and list(found.results.curves) == ["lake", "sea"]


# What pharos trains ---------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_q_learning_leaves_run_folders_of_training(suite, tmp_path):
    found = benchmark.run("q_learning", suite, out=tmp_path, seeds=range(2), workers=1)
    assert (found.results.curves["sea"][:, -1] < 1).all()
    record = json.loads((tmp_path / "runs" / "sea" / "seed-1" / "run.json").read_text())
    assert record["status"] == "finished" and record["config"]["seed"] == 1
    before = (tmp_path / "results.safetensors").read_bytes()
    benchmark.run("q_learning", suite, out=tmp_path, seeds=range(2), workers=2)
    assert (tmp_path / "results.safetensors").read_bytes() == before


@pytest.mark.long
def test_named_agents_have_one_setting_whatever_classes_declare(suite, tmp_path):
    pytest.importorskip("torch")
    setting = {"learning_starts": 50, "double": True}
    found = benchmark.run("dqn", suite, out=tmp_path, seeds=range(2), hyperparameters=setting)
    settings = {
        json.dumps(json.loads(file.read_text())["hyperparameters"], sort_keys=True)
        for file in tmp_path.glob("runs/*/*/run.json")
    }
    assert len(settings) == 1 and json.loads(settings.pop()) == found.results.record["hyperparameters"]


@pytest.mark.long
@pytest.mark.parametrize("agent", ["mine.py:learn", "q_learning", "dqn"])
def test_killed_at_random_and_repeated_it_gives_the_same_bytes(suite, file, tmp_path, agent):
    """Signals come when the first run has begun, while it goes on; results are those of what was left alone."""
    pytest.importorskip("torch")
    protocol, draw = replace(PROTOCOL, steps=6000), random.Random(agent)
    tasks = [{name: value for name, value in vars(task).items() if name != "axis"} for task in suite.core]
    entry = {"name": "small", "protocol": vars(protocol), "core": tasks, "ladders": [], "hyperparameters": {}}
    digest = digest_of_suite(replace(suite, protocol=protocol, ladders=()))
    (tmp_path / "small.yaml").write_text(json.dumps({**entry, "digest": digest}))
    command = f"-m pharos benchmark run --suite small.yaml --agent {agent} --seeds 6 --out".split()

    def start(out):
        with open(tmp_path / "errors", "w") as errors:
            return subprocess.Popen([sys.executable, *command, out], cwd=tmp_path, stderr=errors)

    whole = start("whole")
    assert whole.wait(PATIENCE) == 0, (tmp_path / "errors").read_text()
    kills = 0
    for _ in range(6):
        process = start("killed")
        wait_for(lambda: process.poll() is not None or [*tmp_path.glob("killed/runs/*/*/run.json")])  # noqa: B023
        time.sleep(draw.uniform(0.0, 1.0) * (1 + kills))
        if process.poll() is not None:
            break
        process.send_signal(draw.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT]))
        process.wait(PATIENCE)
        kills += 1
    last = start("killed")
    assert last.wait(PATIENCE) == 0 and kills, (tmp_path / "errors").read_text()
    for name in ("results.safetensors", "agent.json", "suite.json"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.long
def test_the_dqn_of_cleanrl_learns_with_ten_other_lines(tmp_path):
    pytest.importorskip("stable_baselines3")
    example = Path(__file__).parents[2] / "docs" / "examples" / "cleanrl_dqn.py"
    assert example.read_text().count("  # pharos") == 10
    for task, steps in ((TASKS[0], 4500), (replace(TASKS[0], observation="simple_image"), 1500)):
        _, curve = curve_of(load_source(find_source(f"{example}:learn")), task, steps=steps)
        assert [row["step"] for row in curve.rows] == [0, steps // 3, 2 * steps // 3, steps]
        assert steps < 4500 or curve.rows[-1]["normalized_regret"] < 0.1


@pytest.mark.long
def test_the_ppo_of_the_page_learns_with_four_environments_that_share_the_budget(tmp_path):
    pytest.importorskip("torch")
    example = Path(__file__).parents[2] / "docs" / "examples" / "cleanrl_ppo.py"
    assert "[env.copy] * args.num_envs" in example.read_text() and example.read_text().count("  # pharos") == 6
    for task, steps in ((TASKS[0], 9000), (replace(TASKS[0], observation="simple_image"), 1500)):
        _, curve = curve_of(load_source(find_source(f"{example}:learn")), task, steps=steps)
        assert curve.counted_steps == steps and len(curve.rows) == 4
        assert steps < 9000 or curve.rows[-1]["normalized_regret"] < 0.2


def test_a_class_with_act_observe_and_policy_is_run_in_processes_of_its_own(suite, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    methods = "def __init__(self, **given): self.num_actions = given['action_space'].n"
    for signature, body in (
        ("act(self, observations)", "[self.num_actions - 1] * len(observations)"),
        ("observe(self, *step)", "None"),
        ("policy(self, observations)", "[0] * len(observations)"),
    ):
        methods += f"\n    def {signature}: return {body}"
    Path("stepped.py").write_text(f"class Right:\n    {methods}\n")
    outcome = benchmark.run("stepped.py:Right", suite, out="results", seeds=[0])
    assert not outcome.missing
    for curves in outcome.results.curves.values():
        assert np.ptp(curves) == 0  # one policy, at all evaluations
