"""The suite `large`: tasks whose values are stored, not solved for; its digests, its quick look and its baselines."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pharos import benchmark
from pharos.benchmark import BenchmarkTask, Protocol, Suite, baselines, frozen, load_suite, read_results, score
from pharos.benchmark.contents import contents_of
from pharos.benchmark.page import page
from pharos.benchmark.suite import digest_of_large_task, digest_of_suite
from pharos.environments import make
from pharos.errors import FileFormatError, ParameterError
from pharos.training import Task

PROTOCOL = Protocol(steps=300, evaluations=3, seeds=2)
STORED = {"states": 10, "worst": 0.0, "lowest": 0.0, "highest": 1.0, "error_bound": 1e-9}
LAKE = BenchmarkTask("lake", "frozen_lake", value_optimal=3.0, value_uniform=1.0, stored=STORED)
FILES = [Path(__file__).parents[2] / f"docs/studies/paper/{name}.parquet" for name in ("runs", "later-runs")]


@pytest.fixture(scope="module")
def suite():
    """Two large tasks with values that are not theirs, so that it shows if they are solved."""
    tasks = (frozen(LAKE, PROTOCOL), frozen(replace(LAKE, name="other", chance={"random": 0.1}), PROTOCOL))
    whole = Suite("small", PROTOCOL, tasks, (), quick={"tasks": ["other"], "seeds": 1})
    return replace(whole, digest=digest_of_suite(whole))


@pytest.mark.parametrize("workers", (1, 2))
def test_regret_is_that_of_the_stored_values(suite, tmp_path, workers):
    outcome = benchmark.run("q_learning", suite, out=tmp_path, workers=workers)
    assert outcome.results.seeds == (0, 1) and not outcome.missing and not outcome.scores.preliminary
    rows = (tmp_path / "runs/lake/seed-0/run.json").read_text()
    result = json.loads(rows)["result"]
    assert (result["value_optimal"], result["value_uniform"], result["value_worst"]) == (3.0, 1.0, 0.0)
    expected = (3.0 - result["final_value"]) / (3.0 - 1.0)
    assert outcome.results.curves["lake"][0, -1] == pytest.approx(expected)


def always(env, steps, seed):
    env.reset(seed=seed)
    env.step(0)
    yield lambda seen: np.zeros(len(seen), int)


def test_a_function_and_both_references_have_stored_values_too(suite, tmp_path):
    regrets = {}
    for agent in (always, "oracle", "random"):
        outcome = benchmark.run(agent, suite, out=tmp_path / str(agent)[:6], seeds=[0], tasks=["lake"])
        regrets[str(agent)[:6]] = outcome.results.curves["lake"][0, -1]
    *own, oracle, random = regrets.values()
    assert (oracle, random) == (0.0, 1.0)
    assert own == [pytest.approx((3.0 - 0.0) / 2.0)]  # who walks to the left for ever earns nothing


def test_a_quick_look_is_that_of_the_suite(suite, tmp_path):
    outcome = benchmark.run("oracle", suite, out=tmp_path, quick=True)
    assert outcome.results.seeds == (0,) and list(outcome.results.curves) == ["other"]
    assert outcome.scores.preliminary
    text = page(contents_of(outcome.results, beside=[], suite=suite))
    assert "The ladders were not run" not in text and "worse than theory says" not in text


def test_policies_of_millions_of_states_are_not_submitted(suite, tmp_path):
    benchmark.run("oracle", suite, out=tmp_path / "runs", seeds=[0])
    with pytest.raises(ParameterError, match="lake has 10 states, so its policies fit in no file; expected"):
        benchmark.submit(tmp_path / "runs", tmp_path / "file.safetensors", suite)


@pytest.mark.parametrize(
    "other",
    (
        {"environment": "frozen_lake/8x8"},
        {"parameters": {"size": 5, "seed": 0}},
        {"observation": "one_hot"},
        {"chance": {"sticky": 0.1}},
    ),
)
def test_another_world_observation_or_chance_is_another_task(suite, other):
    task = suite.tasks[0]
    assert task.check(PROTOCOL).reference.optimal == 3.0
    with pytest.raises(ParameterError, match=r"^task lake: its digest is"):
        replace(task, **other).check(PROTOCOL)


def test_rewards_and_transitions_enter_the_digest(tmp_path):
    def digest(**parameters):
        task = Task.of("simple_grid", {"height": 3, "width": 3, **parameters}, horizon="limit")
        with pytest.MonkeyPatch.context() as patch:  # the same names
            patch.setattr(type(task.env), "parameters", {})
            return digest_of_large_task(task)

    digests = [digest(), digest(height=4), digest(penalties=(((0, 1), -0.5),))]
    assert len(set(digests)) == 3 and digest() == digests[0]


def test_files_say_what_is_stored_and_what_is_quick(suite, tmp_path):
    file = tmp_path / "small.yaml"
    benchmark.write_suite(suite, file)
    assert load_suite(file) == suite
    text = file.read_text()
    file.write_text(text.replace("    worst: 0.0\n", "", 1))
    with pytest.raises(FileFormatError, match=r"task lake: stored has .*; expected states, worst"):
        load_suite(file)
    file.write_text(text.replace("seeds: 1\n", "runs: 1\n"))
    with pytest.raises(FileFormatError, match=r"quick is .*; expected tasks and seeds"):
        load_suite(file)
    for was, now, words in (
        ("    worst: 0.0\n", "    worst: .nan\n", "stored is .*; expected finite numbers"),
        ("    states: 10\n", f"    states: {10**400}\n", "stored is .*; expected finite numbers"),
        ("seeds: 1\n", "seeds: 0\n", "quick has 0 seeds; expected 1 to 1,000"),
        ("seeds: 1\n", "seeds: true\n", "quick has True seeds; expected 1 to 1,000"),
        ("  - other\n", "  - nobody\n", r"quick has the tasks \['nobody'\]; expected names of its tasks and axes"),
        ("  - other\n", "  - 1\n", r"quick has the tasks \[1\]; expected names of its tasks and axes"),
    ):
        assert was in text
        file.write_text(text.replace(was, now, 1))
        with pytest.raises(FileFormatError, match=words):
            load_suite(file)
    assert "stored" not in (Path(benchmark.__file__).parent / "suites/v1.yaml").read_text()


# As it is shipped -----------------------------------------------------------------------------------------------------


def test_large_has_the_papers_instances_seen_in_two_ways():
    suite = load_suite("large")
    assert (suite.protocol.steps, suite.protocol.evaluations, suite.protocol.seeds) == (600_000, 20, 5)
    assert len(suite.tasks) == 80 == 20 * 2 * 2 and not suite.ladders
    worlds = {make(task.environment).name for task in suite.tasks}
    assert worlds == {"freeway", "breakout"} and len({task.environment for task in suite.tasks}) == 20
    assert {task.observation for task in suite.tasks} == {"vector", "simple_image"}
    assert max(task.stored["states"] for task in suite.tasks) == 21_082_729
    quick = [suite.task(name) for name in suite.quick_tasks]
    assert len({task.environment for task in quick}) == 6 and not any(task.chance for task in quick)
    assert suite.quick_seeds == 2
    for task in suite.tasks:
        assert task.value_uniform < task.value_optimal <= task.stored["highest"], task.name
        assert task.stored["lowest"] <= task.stored["worst"] <= task.value_uniform, task.name


def test_its_baselines_are_of_it_and_whole():
    suite = load_suite("large")
    for name in baselines("large"):
        results = read_results(f"large/{name}")
        assert results.digest == suite.digest and results.seeds == (0, 1, 2, 3, 4)
        assert not score(results, suite).missing and len(results.curves) == 80
    assert contents_of("large/dqn").beside[0].name == "PPO"


@pytest.mark.long
def test_its_curves_and_values_are_those_of_stored_runs():
    """Each fifth row of runs that are found by the name of the task, not by the configuration that a script made."""
    import pandas as pd

    suite, results = load_suite("large"), {name: read_results(f"large/{name}") for name in baselines("large")}
    columns, seen = ["record", "normalized_regret"], set()
    frame = pd.concat([pd.read_parquet(file, columns=columns) for file in FILES])
    worlds = {task.name: json.loads(json.dumps(make(task.environment).parameters)) for task in suite.tasks}
    for text, regrets in zip(frame["record"], frame["normalized_regret"], strict=True):
        record = json.loads(text)
        config = record["config"]
        if config["steps"] != 600_000 or config["chance"]["sticky"]:
            continue
        for task in suite.tasks:
            same = worlds[task.name] == config["parameters"]
            sees = config["observation"] in (task.observation, "index")
            if same and sees and task.chance.get("random", 0.0) == config["chance"]["random"]:
                curve = results[config["agent"]].curves[task.name][config["seed"]]
                np.testing.assert_array_equal(curve, regrets[5::5])
                assert record["result"]["value_optimal"] == pytest.approx(task.value_optimal, rel=1e-9)
                assert record["result"]["value_uniform"] == pytest.approx(task.value_uniform, rel=1e-9)
                seen.add((config["agent"], task.name, config["seed"]))
    assert len(seen) == sum(curve.shape[0] for each in results.values() for curve in each.curves.values())


@pytest.mark.slow
def test_the_smallest_instance_is_what_it_was_and_its_values_are_solved_again():
    suite = load_suite("large")
    for name in ("freeway-20x5-speed2-vector", "freeway-20x5-speed2-simple_image-random-0.1"):
        task = suite.task(name)
        solved = replace(task.check(suite.protocol), values=None)
        for each in ("optimal", "uniform", "worst"):
            assert getattr(solved.reference, each) == pytest.approx(
                getattr(task.stored_values.reference, each), abs=task.stored["error_bound"]
            )
        assert solved.return_range == pytest.approx(task.stored_values.return_range, abs=1e-6)
