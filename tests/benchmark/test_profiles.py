"""Likeness to known faults, symptoms, and the page of `pharos diagnose`."""

import json

import numpy as np
import pytest

from command_line import answer, run
from pharos.benchmark import diagnose, faults
from pharos.benchmark.examination import NAMES
from pharos.benchmark.faults import FAULTS, HEALTHY
from pharos.benchmark.profiles import (
    HEALTHY_ONES,
    SYMPTOMS,
    Profile,
    accuracy,
    failed,
    kind_of,
    likeness,
    meanings,
    shipped,
)
from refusals import failing


def library(rng, spread=0.1, agents=4, readings=6):
    """Four faults with means that are unit vectors apart, and the healthy one at 0."""
    means = {"none": np.zeros(readings)} | {f"fault-{k}": np.eye(readings)[k] for k in range(4)}
    return [
        Profile("dqn", fault, {f"x{k}": float(x) for k, x in enumerate(mean + spread * rng.standard_normal(readings))})
        for fault, mean in means.items()
        for _ in range(agents)
    ], means


def test_an_agent_is_most_like_those_that_it_was_drawn_with():
    rng = np.random.default_rng(0)
    known, means = library(rng)
    for fault, mean in means.items():
        numbers = {f"x{k}": float(x) for k, x in enumerate(mean + 0.1 * rng.standard_normal(6))}
        shares = likeness(numbers, known)
        assert next(iter(shares)) == fault
        assert sum(shares.values()) == pytest.approx(1) and list(shares.values()) == sorted(shares.values())[::-1]
        numbers["x9"] = 100.0  # which the library lacks
        assert likeness(numbers, known) == shares


def test_likeness_is_the_ratio_of_gaussian_densities_where_readings_are_independent():
    rng = np.random.default_rng(1)
    known, means = library(rng, agents=2000, readings=4, spread=1.0)
    x = np.array([0.3, -0.2, 0.5, 0.1])
    shares = likeness({f"x{k}": value for k, value in enumerate(x)}, known)
    densities = {fault: np.exp(-0.5 * ((x - mean) ** 2).sum()) for fault, mean in means.items()}
    densities[HEALTHY] *= HEALTHY_ONES
    total = sum(densities.values())
    for fault, density in densities.items():
        assert shares[fault] == pytest.approx(density / total, abs=0.03)


def test_only_what_no_healthy_agent_shows_is_a_symptom():
    for kind in FAULTS:
        known = [each for each in shipped() if each.kind == kind]
        healthy = [each for each in known if each.fault == HEALTHY]
        assert healthy and not any(failed(each.readings, known) for each in healthy)
        for symptom in SYMPTOMS:
            values = [each.readings[symptom.reading] for each in healthy if symptom.reading in each.readings]
            if not values or symptom.kind not in ("", kind):
                continue
            sign = 1 if symptom.is_high else -1
            edge = sign * max(*(sign * value + symptom.margin for value in values), sign * symptom.beyond)
            numbers = dict(healthy[0].readings)
            for step, is_wrong in ((-0.01, False), (0.01, True)):
                numbers[symptom.reading] = edge + sign * step
                assert (symptom in _symptoms(failed(numbers, known))) == is_wrong


def _symptoms(findings):
    return [
        each
        for finding in findings
        for each in SYMPTOMS
        if each.reading == finding.reading and each.advice == finding.advice
    ]


def test_the_table_has_every_fault_and_tells_most_of_them_apart():
    table = shipped()
    for kind, words in FAULTS.items():
        assert {each.fault for each in table if each.kind == kind} == {HEALTHY, *words}
        right = accuracy(kind)
        assert right.agents > 20 and right.first > 0.6 and right.three > 0.75 and right.healthy > 0.75
    assert {kind_of(each.readings) == each.kind for each in table} == {True}
    assert {name for each in SYMPTOMS for name in each.faults} <= meanings("").keys()
    assert all(f"regret_{name}" in each.readings for each in table for name in NAMES)


def test_symptoms_of_the_plainest_faults_are_there():
    plain = {"last_feature_lost": "deaf_last", "rewards_clipped": "signs", "seeds_ignored": "equal_seeds"}
    plain |= {"action_off_by_one": "overlap_shifted", "terminal_bootstrapped": "through_ends", "gamma_half": "gamma"}
    known = [each for each in shipped() if each.kind == "dqn"]
    for fault, reading in plain.items():
        agents = [each for each in known if each.fault == fault]
        assert agents and all(reading in {one.reading for one in failed(each.readings, known)} for each in agents), (
            fault
        )


def test_an_agent_without_values_is_held_against_both_kinds():
    numbers = {name: 0.5 for name in shipped()[0].readings if name.startswith(("regret_", "overlap", "random"))}
    assert kind_of(numbers) == ""
    assert set(likeness(numbers, shipped())) == {each.fault for each in shipped()}


@pytest.mark.long
def test_a_lost_feature_is_said_in_words_and_in_json(tmp_path):
    (tmp_path / "mine.py").write_text(
        "from pharos.benchmark.faults import dqn\n"
        "def learn(env, steps, seed, *, fault='last_feature_lost'):\n"
        "    yield from dqn(env, steps, seed, fault=fault)\n"
    )
    name, page = f"{tmp_path / 'mine.py'}:learn", tmp_path / "page.md"
    said = answer("diagnose", name, "--steps", 400, "--out", page)
    assert not said["healthy"] and "deaf_last" in {each["reading"] for each in said["findings"]}
    assert set(said["scores"]) == set(NAMES) and sum(said["likeness"].values()) == pytest.approx(1)
    text = page.read_text(encoding="utf-8")
    assert "the last number of the observation changes nothing" in text and said["verdict"] in text
    assert json.dumps(said)
    done = run("diagnose", name, "--steps", 400, "--seeds", 1)
    assert done.exit_code == 0 and "Nearest known agents" in done.stdout
    assert run("diagnose", "q_learning").exit_code == 2


def test_a_page_that_cannot_be_written_is_refused_before_anything_is_trained(tmp_path, monkeypatch):
    monkeypatch.setattr("pharos.benchmark.diagnose", failing(AssertionError("it was trained")))
    done = run("diagnose", "pharos.benchmark.faults:dqn", "--out", tmp_path / "nowhere" / "page.md")
    assert done.exit_code == 1 and done.stderr == f"pharos: {tmp_path}/nowhere/page.md: No such file or directory\n"


@pytest.mark.parametrize(
    ("body", "line"),
    [("sys.exit(0)", "SystemExit: 0"), ("raise RuntimeError('boo' + chr(10) + 'hoo')", "RuntimeError: boo hoo")],
)
def test_what_the_code_of_an_agent_raises_is_one_line(tmp_path, body, line):
    file = tmp_path / "mine.py"
    file.write_text(f"import sys\ndef learn(env, steps, seed):\n    {body}\n    yield\n")
    done = run("diagnose", f"{file}:learn")
    assert done.exit_code == 1 and done.stderr == f"pharos: agent {file}:learn raised {line} (mine.py, line 3)\n"


def test_an_older_page_stays_if_the_agent_fails_and_a_link_is_followed(tmp_path):
    page, link = tmp_path / "page.md", tmp_path / "link.md"
    page.write_text("older")
    link.symlink_to(page)
    assert run("diagnose", "nope.py:learn", "--out", link).exit_code == 2
    assert page.read_text() == "older" and [each.name for each in tmp_path.glob("*")].count("page.md") == 1
    assert link.is_symlink() and len(list(tmp_path.iterdir())) == 2


@pytest.mark.long
def test_a_function_of_python_is_diagnosed_and_only_in_some_worlds():
    diagnosis = diagnose(faults.make("ppo", "gamma_half"), worlds=["still", "umbrella"], steps=1500)
    assert diagnosis.kind == "ppo" and set(diagnosis.scores) == {"still", "umbrella"}
    assert diagnosis.readings["gamma"] < 0.7
    assert str(diagnosis).startswith("# Diagnosis of ")
