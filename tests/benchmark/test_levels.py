"""Worlds of many levels: learnt on some, measured on others."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pharos
from pharos import benchmark
from pharos.benchmark import BenchmarkTask, Ladder, Protocol, Suite, baselines, frozen, load_suite, read_results, score
from pharos.benchmark.contents import contents_of
from pharos.benchmark.levels import ENVIRONMENT_NAME, FIRST_HELD_OUT, levels_of, overlap, twins
from pharos.benchmark.page import page
from pharos.benchmark.suite import digest_of_suite
from pharos.interaction import GymEnv
from pharos.training import Task, evaluate_agent

PROTOCOL = Protocol(steps=2000, evaluations=2, seeds=2)
OPTIONS = {"size": 4}
EVIDENCE = (Path(__file__).parents[2] / "docs" / "evidence" / "benchmark.md").read_text()


@pytest.fixture(scope="module")
def suite():
    seen = BenchmarkTask(
        "seen", ENVIRONMENT_NAME, {"world": "frozen_lake", "options": OPTIONS, "train": 2, "held_out": 0}, "recorded"
    )
    held_out = replace(seen, name="held-out", parameters={**seen.parameters, "held_out": 3}, axis="lake", level=1.0)
    seen, held_out = frozen(seen, PROTOCOL), frozen(held_out, PROTOCOL)
    whole = Suite("small", PROTOCOL, (seen,), (Ladder("lake", "halvings", "levels", (held_out,)),))
    return replace(whole, digest=digest_of_suite(whole))


def lakes(first, number):
    return [pharos.make("frozen_lake", **OPTIONS, seed=seed) for seed in range(first, first + number)]


def test_levels_that_are_damaged_in_the_cache_are_written_anew(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    whole = levels_of("frozen_lake", OPTIONS, train=2)
    folder = Path(whole.parameters["folder"])
    rewards = np.load(folder / "rewards.npy")
    for name in ("rewards.npy", "next_states.npy", "manifest.json"):
        (folder / name).write_bytes((folder / name).read_bytes()[:40])
        again = levels_of("frozen_lake", OPTIONS, train=2)
        assert again.parameters == whole.parameters
        assert (np.load(folder / "rewards.npy") == rewards).all() and Task(again).reference.optimal > 0


def test_values_are_means_over_the_levels_that_are_measured(suite):
    """Levels one by one, each solved as a world of its own."""
    for task, worlds in zip(suite.tasks, (lakes(0, 2), lakes(FIRST_HELD_OUT, 3)), strict=True):
        references = [Task(env).reference for env in worlds]
        assert task.value_optimal == pytest.approx(np.mean([each.optimal for each in references]))
        assert task.value_uniform == pytest.approx(np.mean([each.uniform for each in references]))


def test_episodes_begin_in_training_levels_alone_and_show_the_level(suite):
    task = suite.task("held-out").training_task(PROTOCOL)
    shown = {pharos.observe(env, "simple_image")(np.array([env.initial_state()]))[0].tobytes() for env in lakes(0, 2)}
    env = GymEnv(task.env, **task.interaction)
    seen = {env.reset(seed=seed)[0].transpose(2, 1, 0).tobytes() for seed in range(50)}
    assert seen == shown and env.observation_space.dtype == np.uint8


def test_whoever_knows_the_training_levels_by_heart_has_no_regret_there_alone(suite):
    """Optimal actions in the states of training levels, found by discounting, and to the left for ever elsewhere."""
    task = suite.task("held-out").training_task(PROTOCOL)
    plain = task.space.mdp(gamma=0.9)
    actions = np.asarray(pharos.value_iteration(plain).policy)
    is_own, frontier = np.zeros(plain.num_states, bool), plain.start_states[plain.start_probabilities > 0.1]
    while len(frontier):
        is_own[frontier] = True
        following = np.unique(np.asarray(task.space.successors)[frontier])
        frontier = following[~is_own[following]]
    assert 0 < is_own.sum() < len(is_own)
    by_heart = np.where(is_own, actions, 0)
    assert evaluate_agent(actions, task).value == pytest.approx(task.reference.optimal)
    assert evaluate_agent(by_heart, task).value == 0.0
    assert pharos.evaluate_policy(task.mdp, by_heart).value_at_start == pytest.approx(1.0)


def test_overlap_is_the_share_of_what_held_out_levels_show():
    """Counted by hand: pictures of all states of each level that are not terminal."""

    def pictures(envs):
        out = set()
        for env in envs:
            space = pharos.build(env)
            rows = pharos.observe(env, "simple_image")(space.states()[~np.asarray(space.mdp().terminal, bool)])
            out |= {row.tobytes() for row in rows}
        return out

    own, theirs = pictures(lakes(0, 2)), pictures(lakes(FIRST_HELD_OUT, 3))
    assert overlap(levels_of("frozen_lake", OPTIONS, train=2, held_out=3)) == len(own & theirs) / len(theirs)


def test_a_run_has_both_scores_and_the_page_their_gap(suite, tmp_path):
    assert [(seen.name, other.name) for seen, other in twins(suite)] == [("seen", "held-out")]
    outcome = benchmark.run("q_learning", suite, out=tmp_path)
    assert not outcome.missing
    text = page(contents_of(outcome.results, beside=[], suite=suite))
    scores = {name: 1 - curve.mean(axis=1) for name, curve in outcome.results.curves.items()}
    gap = np.mean(np.clip(scores["seen"], 0, 1) - np.clip(scores["held-out"], 0, 1))
    assert "Levels seen and held out" in text and f"{gap:+.2f}" in text


def test_levels_is_four_generators_with_three_numbers_of_levels():
    suite = load_suite("levels")
    assert [ladder.axis for ladder in suite.ladders] == ["lake", "door_key", "rooms", "sokoban"]
    for ladder in suite.ladders:
        assert [task.parameters["train"] for task in ladder.tasks] == [512, 64, 8]
        assert [task.level for task in ladder.tasks] == [0.0, 3.0, 6.0]
        assert {task.parameters["held_out"] for task in ladder.tasks} == {100}
    assert len(twins(suite)) == len(suite.core) == 12


def test_its_baselines_are_of_it_and_score_as_the_evidence_says():
    suite = load_suite("levels")
    titles = {"q_learning": "Q-learning", "dqn": "DQN", "ppo": "PPO"}
    assert set(baselines("levels")) == set(titles)
    for name, title in titles.items():
        results = read_results(f"levels/{name}")
        scores = score(results, suite).tasks
        assert results.digest == suite.digest and results.record["agent"] == name
        rows = re.findall(
            rf"^\| {title} \({len(results.seeds)} seeds\), (\d+) (\S+) \| (.*) \|$", EVIDENCE, re.MULTILINE
        )
        assert len(rows) == 6
        for number, half, cells in rows:
            for ladder, cell in zip(suite.ladders, cells.split(" | "), strict=True):
                task = f"{ladder.axis}-{number}-{half}"
                assert cell == (f"{scores[task].value:.2f}" if task in scores else "")


@pytest.mark.long
def test_the_shipped_table_plays_its_first_action_on_held_out_lakes_and_learns_the_others_again(tmp_path):
    """Held out: the value of constant play, lake by lake. Seen: one seed trained again."""
    suite, curves = load_suite("levels"), read_results("levels/q_learning").curves
    values = []
    for env in [pharos.make("frozen_lake", size=6, seed=FIRST_HELD_OUT + index) for index in range(100)]:
        task = Task(env)
        constant = np.zeros(task.space.num_states, int)
        uniform, optimal = task.reference.uniform, task.reference.optimal
        values.append((evaluate_agent(constant, task).value, uniform, optimal))
    own, uniform, optimal = np.mean(values, axis=0)
    for number in (8, 64, 512):
        assert curves[f"lake-{number}-held-out"] == pytest.approx((optimal - own) / (optimal - uniform), abs=1e-9)
    again = benchmark.run("q_learning", suite, out=tmp_path, seeds=[0], tasks=["lake-8-seen"])
    np.testing.assert_allclose(again.results.curves["lake-8-seen"][0], curves["lake-8-seen"][0], atol=1e-9)
