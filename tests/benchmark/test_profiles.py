"""Likeness to known faults, symptoms, and the page of `pharos diagnose`."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import answer, run
from pharos.benchmark import diagnose, faults
from pharos.benchmark.agent_diagnosis import diagnosis_of_results, findings_of, meanings
from pharos.benchmark.contents import contents_of
from pharos.benchmark.diagnosis_page import profile_rows
from pharos.benchmark.examination import NAMES, solved, value_functions
from pharos.benchmark.faults import ALIKE, ALIKE_BY_SCORES, FAMILIES, FAULTS, HEALTHY, alike, batch_of
from pharos.benchmark.page import page
from pharos.benchmark.play import LEARNT_REGRET, RANDOM_REGRET, baseline_play, late_play, late_regret
from pharos.benchmark.profiles import (
    HEALTHY_ONES,
    IMAGE_TASK,
    SCORED_TASKS,
    SCORES,
    SYMPTOMS,
    Profile,
    accuracy,
    failed,
    families,
    has_no_memory,
    is_on_policy,
    judged,
    kind_of,
    likeness,
    run_readings,
    shipped,
    strangeness,
)
from pharos.benchmark.results import AgentResults
from pharos.benchmark.suite import load_suite
from pharos.errors import ParameterError, TimeLimit
from pharos.system.wording import pluralize
from pharos.training import PolicyRecorder
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
                numbers |= {symptom.also: sign * 9.0} if symptom.also else {}
                assert (symptom in _symptoms(failed(numbers, known))) == is_wrong


def test_a_symptom_of_values_that_lag_is_one_in_lately_visited_states_alone():
    for kind in FAULTS:
        known = [each for each in shipped() if each.kind == kind]
        healthy = next(each.readings for each in known if each.fault == HEALTHY)
        for symptom in (each for each in SYMPTOMS if each.also):
            far = 9.0 if symptom.is_high else -9.0
            for also, is_wrong in ((far, True), (0.0, False), (None, False)):
                numbers = {**healthy, symptom.reading: far, symptom.also: also}
                numbers = {name: value for name, value in numbers.items() if value is not None}
                assert (symptom in _symptoms(failed(numbers, known))) == is_wrong, (kind, symptom.reading, also)


def test_a_learner_is_on_policy_if_the_largest_next_value_explains_less_than_what_was_played():
    known = [each for each in shipped() if each.kind == "dqn"]
    limit = max(max(each.readings["consistency"] for each in known if each.fault == HEALTHY) + 0.1, -0.4)
    for largest, played, is_so in ((0.01, -0.01, True), (-0.01, -0.3, False), (0.3, 0.01, False)):
        assert is_on_policy({"consistency": limit + largest, "on_policy": limit + played}, known) == is_so
    assert not is_on_policy({"consistency": 0.0}, known) and not is_on_policy({}, known)


def test_a_learner_without_a_memory_is_far_from_both_backups_and_of_late_nearer_to_what_it_played():
    known = [each for each in shipped() if each.kind == "dqn"]
    limit = max(max(each.readings["consistency"] for each in known if each.fault == HEALTHY) + 0.1, -0.4)
    for largest, played, gap, is_so in ((0.1, 0.1, -0.04, True), (0.1, 0.1, -0.02, False), (-0.1, 0.1, -0.04, False)):
        numbers = {"consistency": limit + largest, "on_policy": limit + played, "on_policy_gap": gap}
        assert has_no_memory(numbers, known) == is_so
    assert not has_no_memory({"consistency": 0.0}, known) and not has_no_memory({}, known)


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
    assert run("diagnose", "nope").exit_code == 2


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
    diagnosis = diagnose(faults.faulty_agent("ppo", "gamma_half"), worlds=["still", "umbrella"], steps=1500)
    assert diagnosis.kind == "ppo" and set(diagnosis.scores) == {"still", "umbrella"}
    assert diagnosis.readings["gamma"] < 0.7
    assert str(diagnosis).startswith("# Diagnosis of ")


def test_an_agent_far_from_all_others_is_like_none_of_them():
    rng = np.random.default_rng(2)
    known, means = library(rng)
    for fault, mean in means.items():
        assert not judged({f"x{k}": float(x) for k, x in enumerate(mean)}, known).is_strange, fault
    far = {f"x{k}": -1.0 for k in range(6)}
    # by hand: the nearest mean, in deviations within faults, at most 4 each
    rows = {fault: np.array([[*each.readings.values()] for each in known if each.fault == fault]) for fault in means}
    within = np.concatenate([own - own.mean(axis=0) for own in rows.values()])
    units = np.sqrt((within**2).sum(axis=0) / 15) + 0.05 * np.concatenate([*rows.values()]).std(axis=0) + 1e-3
    squares = [np.mean(np.minimum(np.abs((own.mean(axis=0) + 1) / units), 4) ** 2) for own in rows.values()]
    assert strangeness(far, known) == pytest.approx(min(squares) * 4 / 5)
    answer = judged(far, known)
    assert answer.is_strange and answer.fault is None


def test_each_fault_has_one_family_and_families_share_what_is_not_health():
    names = [fault for _, faults in FAMILIES.values() for fault in faults]
    assert sorted(names) == sorted(set(meanings("")))
    shares = likeness(shipped()[0].readings, [each for each in shipped() if each.kind == "dqn"])
    assert sum(families(shares).values()) == pytest.approx(1 - shares[HEALTHY])


def test_signs_of_the_fault_that_is_said_come_first():
    """A wrong discount moves values at the time limit as well; its own sign is what is told."""
    known = [each for each in shipped() if each.kind == "dqn"]
    for each in (each for each in known if each.fault == "gamma_half"):
        answer = judged(each.readings, [other for other in known if other is not each])
        assert answer.fault == "gamma_half" and answer.findings[0].reading == "gamma"


def test_of_faults_that_the_table_lacks_seven_in_ten_are_unknown_or_of_the_right_family():
    right = [accuracy(kind) for kind in FAULTS]
    assert sum(each.unknown for each in right) / 2 > 0.7 and min(each.unknown for each in right) > 0.65


def test_a_wrong_reshape_mixes_observations_of_a_batch_and_leaves_one_alone():
    rows = np.arange(12.0).reshape(4, 3)
    mixed = batch_of(rows, "frames_reshaped")
    assert sorted(mixed.ravel()) == sorted(rows.ravel()) and (mixed[0] == [0, 3, 6]).all()
    assert (batch_of(rows[:1], "frames_reshaped") == rows[:1]).all() and batch_of(rows, HEALTHY) is rows


def test_an_agent_that_loops_without_a_step_is_ended(tmp_path):
    file = tmp_path / "mine.py"
    body = "    while True:\n        try:\n            pass\n        except Exception:\n            pass\n    yield\n"
    file.write_text(f"def learn(env, steps, seed):\n{body}")
    done = run("diagnose", f"{file}:learn", "--timeout", 0.2)
    assert done.exit_code == 1 and done.stderr == (
        f"pharos: agent {file}:learn on lake, seed 0: took longer than 0.2 s; it was ended: raise the timeout, or look "
        f"for a loop without an end\n"
    )
    with pytest.raises(TimeLimit):
        diagnose(f"{file}:learn", timeout=0.2)


# Finished runs --------------------------------------------------------------------------------------------------------


def worse(names, by=0.5, **more):
    """The shipped DQN with seeds of its own, and more regret on some tasks."""
    rng, shipped_dqn = np.random.default_rng(3), AgentResults.read("dqn")
    curves = {
        name: np.clip(curve + rng.normal(0, 0.01, (len(curve), 1)) + by * (name in names), 0, 1)
        for name, curve in shipped_dqn.curves.items()
    }
    return AgentResults("my dqn", "v1", shipped_dqn.digest, shipped_dqn.seeds, curves, more)


def test_regret_of_play_is_that_of_plain_python():
    rng = np.random.default_rng(6)
    for evaluations in (1, 2, 10, 15):
        returns = [rng.normal(0.5, 1, rng.integers(1, 9)) for _ in range(evaluations)]
        episodes = np.cumsum([0, *map(len, returns)])
        lost = np.cumsum([0, *(sum(0.9 - each) for each in returns)])
        rows = [
            {"episodes": n, "cumulative_realised_regret": x}
            for n, x in zip(episodes.tolist(), lost.tolist(), strict=True)
        ]
        found = late_play(rows, {"value_optimal": 0.9, "value_uniform": 0.4})
        last = returns[evaluations - round(evaluations / 3) :]
        if not last:
            assert found == {}
            continue
        flat = [float(x) for each in last for x in each]
        assert found["episodes"] == len(flat)
        assert found["regret"] == pytest.approx((0.9 - sum(flat) / len(flat)) / 0.5)
        assert late_play(rows, {"value_optimal": 0.4, "value_uniform": 0.4}) == {}
        assert late_play([{**row, "episodes": 3} for row in rows], {"value_optimal": 1.0, "value_uniform": 0.0}) == {}
        assert late_play(rows, {"value_optimal": None, "value_uniform": 0.0}) == {}


def readings_of(results):
    return [each.reading for each in findings_of(contents_of(results))]


def test_a_run_of_a_shipped_agent_shows_no_symptom():
    for name in ("dqn", "ppo"):
        whole = AgentResults.read(name)
        half = {task: curve[:5] for task, curve in whole.curves.items()}
        results = AgentResults(f"my {name}", "v1", whole.digest, whole.seeds[:5], half)
        assert readings_of(results) == []
        said = diagnosis_of_results(contents_of(results))
        assert said.kind == name and said.from_results and set(said.scores) == set(half)
        assert said.is_healthy and said.verdict == "Nothing is wrong that these results and checks can see."


PAGE = (Path(__file__).parents[2] / "docs" / "diagnose.md").read_text(encoding="utf-8")
WORDS = " ".join(PAGE.replace(" %", "%").split())


def as_known(profile, agent):
    """A run of the shipped DQN with the readings of a known agent on the tasks of the table: its last third, and the
    rest so that the mean is right. What is worse than uniform play is so on one task that it fails at the end."""
    whole, numbers = AgentResults.read("dqn"), profile.readings
    curves = {name: np.full(curve.shape, 0.5) for name, curve in whole.curves.items()}
    worse_at = next((name for name in SCORED_TASKS if numbers[f"late_{name}"] == 0), None)
    for name in (*SCORED_TASKS, IMAGE_TASK):
        late = 1 - numbers[f"late_{name}"] + 4 * numbers["worse"] * (name == worse_at)
        early = (15 * (1 - numbers[f"score_{name}"]) - 5 * late) / 10
        curves[name][:] = [early] * 10 + [late] * 5
    facts = {fact: numbers[fact] for fact in ("one_action", "deterministic")}
    record = {"source": {"name": "mine.py:learn"}, "policies": dict.fromkeys(SCORED_TASKS, facts)}
    record["play"] = {
        name: {"regret": 1 - numbers[f"played_{name}"], "episodes": 400.0} for name in (*SCORED_TASKS, IMAGE_TASK)
    }
    return AgentResults(agent, "v1", whole.digest, whole.seeds, curves, record)


def plain_readings(curves, policies, play):
    """`run_readings` in plain Python."""
    numbers, worse_by = {}, []
    for name in curves:
        runs = curves[name].tolist()
        numbers[f"score_{name}"] = sum(1 - min(1, max(0, sum(run) / 15)) for run in runs) / len(runs)
        last = [sum(run[10:]) / 5 for run in runs]
        numbers[f"late_{name}"] = sum(1 - min(1, max(0, each)) for each in last) / len(runs)
        if name in play:
            numbers[f"played_{name}"] = 1 - min(1, max(0, play[name]))
        if name in SCORED_TASKS:
            worse_by.append(sum(min(1, max(0, each - 1)) for each in last) / len(runs))
    numbers["worse"] = sum(worse_by) / 4
    return numbers | {
        fact: sum(policies[name][fact] for name in SCORED_TASKS) / 4 for fact in policies[SCORED_TASKS[0]]
    }


def test_readings_of_a_finished_run_are_those_of_plain_python():
    rng = np.random.default_rng(5)
    for _ in range(20):
        names = (*SCORED_TASKS, IMAGE_TASK)[: rng.integers(4, 6)]
        curves = {name: rng.uniform(-0.2, 1.8, (3, 15)) for name in names}
        policies = {name: {"one_action": rng.uniform(), "deterministic": rng.uniform()} for name in SCORED_TASKS}
        play = {name: rng.uniform(-0.2, 1.8) for name in names[rng.integers(0, 4) :]}
        for own in (play, {}):
            assert run_readings(curves, policies, own) == pytest.approx(plain_readings(curves, policies, own))
        assert run_readings(curves, policies) == run_readings(curves, policies, {"another task": 1.0})
        part = {name: policies[name] for name in SCORED_TASKS[1:]}
        assert (
            run_readings(curves, part).keys() == run_readings(curves, {}).keys() < run_readings(curves, policies).keys()
        )
    assert run_readings({}, {}) == {}


def test_a_finished_run_is_like_the_known_agents_with_its_readings():
    table = shipped(SCORES)
    for each in table[::7]:
        results = as_known(each, f"my {each.kind}")
        said = diagnosis_of_results(contents_of(results))
        for name, number in said.readings.items():
            assert number == pytest.approx(each.readings[name], abs=0.15 if name == "worse" else 0.01), name
        # by hand: probabilities of the same table, times those of the signs that were seen
        of_kind = [other for other in table if other.kind == each.kind]
        signs = {fault for finding in said.findings for fault in finding.faults}
        weights = {f: x * (3 if f in signs else 1) for f, x in likeness(said.readings, of_kind).items()}
        assert said.likeness == pytest.approx({f: x / sum(weights.values()) for f, x in weights.items()})
        assert [*said.likeness.values()] == sorted(said.likeness.values(), reverse=True)
        names = frozenset(each.readings)
        assert said.accuracy == accuracy(each.kind, SCORES, names) == accuracy(each.kind, SCORES)
        assert said.how_often.startswith("By what was learnt and played on 5 tasks alone.")
        group = alike(each.kind, next(iter(said.likeness)))
        share = sum(said.likeness[fault] for fault in group)
        assert (f"apart, so read them as one ({share:.2f})" in said.how_often) == (len(group) > 1)
    for kind, words in FAULTS.items():
        assert {each.fault for each in table if each.kind == kind} == {HEALTHY, *words} - {"seeds_ignored"}
        whole = frozenset(table[0].readings)
        play = {name for name in whole if name.startswith("played_")}
        image = {name for name in whole if IMAGE_TASK in name}
        facts = {"one_action", "deterministic"}
        for names, more in (
            (None, ""),
            (whole - facts, ", no facts on policies"),
            (whole - image, ", no image"),
            (whole - play, ", no play"),
            (whole - play - image, ", no play, no image"),
        ):
            right = accuracy(kind, SCORES, names)
            assert right.three > 3 / len(words)  # better than a guess
            shares = right.first, right.three, right.healthy, right.unknown
            row = f"| {kind.upper()}, {len(words) - (kind == 'dqn')} faults{more} | {right.agents} | "
            assert row + " | ".join(f"{100 * share:.0f} %" for share in shares) + " |" in PAGE
            assert right.group >= right.first
    groups = [accuracy(kind, SCORES).group for kind in FAULTS]
    assert f"likeliest for {groups[0]:.0%} of DQNs with a fault, and for {groups[1]:.0%} of PPOs" in WORDS


def test_groups_of_faults_that_look_alike_are_of_the_table_and_apart():
    for by_scores, table in ((False, ALIKE), (True, ALIKE_BY_SCORES)):
        for kind, groups in table.items():
            names = [fault for group in groups for fault in group]
            assert len(set(names)) == len(names) and {*names} <= {HEALTHY, *FAULTS[kind]}
            assert all(alike(kind, fault, by_scores=by_scores) == group for group in groups for fault in group)
    assert alike("dqn", "mean_backup", by_scores=True) == ("mean_backup",) and alike("", HEALTHY) == (HEALTHY,)
    # what was played tells an agent that plays at random from a healthy one, scores do not
    assert alike("dqn", "epsilon_stuck") == ("epsilon_stuck",)
    assert HEALTHY in alike("dqn", "epsilon_stuck", by_scores=True)


def test_a_likeness_of_scores_says_a_fault_only_beside_a_sign_of_it():
    each = next(each for each in shipped(SCORES) if each.fault == "rewards_clipped")
    whole = as_known(each, "my dqn")
    assert next(iter(diagnosis_of_results(contents_of(whole)).likeness)) == "rewards_clipped"
    for said in map(diagnosis_of_results, map(contents_of, (whole, as_known(each, "my ppo")))):
        assert said.fault in (None, *(fault for finding in said.findings for fault in finding.faults))
    everywhere = replace(as_known(each, "my dqn"), curves=worse([task.name for task in load_suite("v1").tasks]).curves)
    lost = next(each for each in shipped(SCORES) if each.fault == "next_is_observation")
    curves = {**everywhere.curves, **{name: as_known(lost, "").curves[name] for name in (*SCORED_TASKS, IMAGE_TASK)}}
    said = diagnosis_of_results(contents_of(replace(everywhere, curves=curves, record=as_known(lost, "").record)))
    assert said.fault == "next_is_observation" and "a run hardly tells target_never_copied, next_is_" in said.verdict


def test_a_run_without_the_tasks_of_the_table_names_the_command_that_has_the_likeness():
    whole = as_known(shipped(SCORES)[0], "my dqn")
    curves = {name: curve for name, curve in whole.curves.items() if name != SCORED_TASKS[0]}
    said = diagnosis_of_results(contents_of(replace(whole, curves=curves)))
    assert said.likeness == {} and said.fault is None and said.lacks in str(said)
    assert said.lacks == (
        f"Known faults are not compared: the run lacks {SCORED_TASKS[0]} of the suite v1; `pharos diagnose "
        f"mine.py:learn` compares them, in some minutes."
    )
    assert said.lacks in said.to_html().replace("&#x27;", "'")


def test_a_run_of_another_protocol_or_with_impossible_regret_is_refused():
    whole = as_known(shipped(SCORES)[0], "my dqn")
    short = {name: curve[:, :3] for name, curve in whole.curves.items()}
    with pytest.raises(ParameterError, match="has 3 evaluations; expected the 15 of suite v1"):
        diagnosis_of_results(contents_of(replace(whole, curves=short)))
    for wrong in (-1e300, -1.0, 1e300):
        with pytest.raises(ParameterError, match=r"has normalised regret of .*; expected 0, optimal, to 1e\+06"):
            curves = {**whole.curves, SCORED_TASKS[0]: whole.curves[SCORED_TASKS[0]] * 0 + wrong}
            diagnosis_of_results(contents_of(replace(whole, curves=curves)))


def test_groups_of_tasks_that_lose_alone_are_named():
    suite = load_suite("v1")
    vectors = [task.name for task in suite.core if task.observation == "vector"]
    assert readings_of(worse(vectors)) == ["vector"]
    assert readings_of(worse(vectors, by=1.0)) == ["vector"]  # of which one ends by time alone
    assert readings_of(worse([task.name for task in suite.core])) == ["core"]  # no group is spared
    # tasks that share no group, as those that a missing done mask loses
    lost = ["breakout-5-3-1-hash", "frozen_lake-5-0-vector-random-0.1", "game_2048-2x2-to-32-one_hot"]
    (line,) = findings_of(contents_of(worse(lost, by=1.0)))
    assert line.reading == "core" and "terminal_bootstrapped" in line.faults
    assert all(name in line.wrong for name in lost) and line.wrong.endswith("beside +0.01 on the others")
    ladder = next(ladder for ladder in suite.ladders if ladder.axis == "credit")
    assert readings_of(worse([task.name for task in ladder.tasks])) == ["credit"]
    for names, start in (
        (ladder.tasks[1:], "It may be healthy, but weaker: it"),
        (ladder.tasks, "Something is wrong: it"),
    ):
        said = diagnosis_of_results(contents_of(worse([task.name for task in names], by=1.0))).verdict
        assert said.startswith(start) and "on the axis of credit" in said
    # who fails on the lowest rung already, where rewards are small costs, say, lacks something else
    for names, signs in ((ladder.tasks, ()), (ladder.tasks[1:], ("gamma_half",))):
        (line,) = findings_of(contents_of(worse([task.name for task in names], by=1.0)))
        assert line.reading == "credit" and line.faults == signs
        assert ("fails already (0.00, DQN 1.00): not a matter of credit" in line.wrong) == (not signs)
    assert readings_of(worse([task.name for task in suite.tasks])) == ["everywhere"]


def test_what_policies_are_like_is_a_symptom():
    core = [task.name for task in load_suite("v1").core]
    scores = {name: 1 - AgentResults.read("dqn").curves[name].mean() for name in core}
    noisy_one = next(name for name, score in scores.items() if score < 0.6)
    fixed = {name: {"one_action": 0.95, "deterministic": 1.0} for name in core}
    assert readings_of(worse((), policies=fixed)) == ["one_action"]
    noisy = {noisy_one: {"one_action": 0.5, "deterministic": 0.0, "greedy_score": scores[noisy_one] + 0.3}}
    assert readings_of(worse((), policies=noisy)) == ["noise"]


def learnt_tasks():
    """Tasks that the shipped DQN has learnt at the end, and plays better than at random."""
    whole = AgentResults.read("dqn")
    play, late = baseline_play(whole), late_regret(whole)
    return [name for name in play if play[name] <= LEARNT_REGRET and late[name] <= 0.3]


def played(regret, tasks, results=None):
    """The shipped DQN, or other results, with the same regret of play on some tasks."""
    results = results or worse(())
    record = {**results.record, "play": {name: {"regret": regret, "episodes": 400.0} for name in tasks}}
    return replace(results, record=record)


def test_random_play_at_the_end_is_a_symptom_of_who_has_learnt_something_else():
    tasks = learnt_tasks()
    assert len(tasks) > 10
    for regret, is_wrong in ((1.0, True), (RANDOM_REGRET, True), (RANDOM_REGRET - 0.01, False), (0.2, False)):
        assert readings_of(played(regret, tasks)) == ["random_play"] * is_wrong
    said = diagnosis_of_results(contents_of(played(1.0, tasks)))
    count = pluralize(len(tasks), "task")
    assert said.verdict.startswith(
        f"Something is wrong: it still plays at random at the end of training, on {count[:2]}"
    )
    assert f"of {count} that its policy has learnt, as DQN does not" in said.verdict
    (line,) = findings_of(contents_of(played(1.0, tasks)))
    assert line.faults == ("epsilon_stuck",) and "epsilon falls" in line.advice and line.value == 1.0
    # a page says the same
    text = "".join(page(contents_of(played(1.0, tasks))).split("What the policies are like")[1:])
    assert "It still plays at random at the end of training" in text


def test_random_play_at_the_end_is_no_symptom_if_nothing_is_learnt_or_the_baseline_plays_so_too():
    tasks = learnt_tasks()
    play = baseline_play(AgentResults.read("dqn"))
    # half of the tasks is not most, two are too few
    half = played(1.0, tasks[: len(tasks) // 2])
    rest = {name: {"regret": 0.1, "episodes": 400.0} for name in tasks[len(tasks) // 2 :]}
    half = replace(half, record={"play": {**half.record["play"], **rest}})
    assert readings_of(half) == readings_of(played(1.0, tasks[:2])) == []
    # its policies are as bad as its play: it has not learnt
    failed_all = played(1.0, tasks, worse(tasks, by=1.0))
    assert readings_of(failed_all) == ["everywhere"]
    # the baseline plays these at random, too
    hard = [name for name, regret in play.items() if regret > LEARNT_REGRET]
    easy = worse(())
    solved_all = replace(easy, curves={name: curve * 0 for name, curve in easy.curves.items()})
    assert len(hard) >= 3 and readings_of(played(1.0, hard, solved_all)) == []


def test_play_that_is_better_than_the_policy_that_is_judged_is_a_symptom():
    tasks = learnt_tasks()
    lost = worse(tasks, by=1.0)
    gain = np.median([min(late_regret(lost)[name], 1.5) - 0.1 for name in tasks])
    (line,) = [each for each in findings_of(contents_of(played(0.1, tasks, lost))) if each.reading == "played_better"]
    assert line.value == pytest.approx(gain) and line.faults == ("action_off_by_one", "plays_at_random")
    assert f"by {gain:.2f} of regret on the median of {len(tasks)} tasks" in line.wrong
    assert "played_better" not in readings_of(played(0.9, tasks, lost))
    assert "played_better" not in readings_of(played(0.1, tasks[:2], lost))
    assert readings_of(played(0.0, tasks)) == []


@pytest.mark.parametrize(
    "play", [None, [], {"a": 1}, {"deep_sea-8-one_hot": 1}, {"deep_sea-8-one_hot": {"regret": "x"}}]
)
def test_results_without_play_are_diagnosed_as_before(play):
    before, after = worse(()), worse((), play=play)
    own, other = (diagnosis_of_results(contents_of(each)).to_dict() for each in (before, after))
    assert own == other and not any(name.startswith("played_") for name in own["readings"])


def test_what_a_finished_run_lacks_is_no_part_of_its_likeness():
    table = [each for each in shipped(SCORES) if each.kind == "dqn"]
    more = {name for name in table[0].readings if name.startswith("played_") or IMAGE_TASK in name}
    assert len(more) == 7  # play on five tasks, and two scores of the image
    for each in table[::5]:
        numbers = {name: value for name, value in each.readings.items() if name not in more}
        rest = [
            replace(other, readings={name: value for name, value in other.readings.items() if name not in more})
            for other in table
        ]
        assert likeness(numbers, table) == likeness(numbers, rest)


def test_a_finished_run_is_diagnosed_without_training(tmp_path, monkeypatch):
    monkeypatch.setattr("pharos.benchmark.examination.generate", failing(AssertionError("it was trained")))
    vectors = [task.name for task in load_suite("v1").core if task.observation == "vector"]
    worse(vectors, notes={"same seed": {"lake, seed 0": "3 resets had one seed"}}).write(tmp_path / "run.safetensors")
    page = tmp_path / "page.html"
    said = answer("diagnose", "--results", tmp_path / "run.safetensors", "--out", page)
    assert [each["reading"] for each in said["findings"]] == ["warning", "vector"] and not said["healthy"]
    assert "3 resets had one seed" in said["verdict"] and "seen as vector" in page.read_text(encoding="utf-8")
    assert run("diagnose", "--results", tmp_path / "run.safetensors").exit_code == 0
    for words in ((), ("dqn", "--results", "dqn"), ("--results", tmp_path)):
        assert run("diagnose", *words).exit_code == 2


def test_the_plot_has_the_readings_that_differ_most():
    known, means = library(np.random.default_rng(4))
    numbers = {f"x{k}": float(x) for k, x in enumerate(means["fault-2"])}
    names, rows = profile_rows(numbers, known, ["fault-2"])
    assert names[0] == "x2" and sorted(names) == sorted(numbers)
    for name, (own, other) in zip(names, rows, strict=True):
        healthy, faulty = (np.mean([x.readings[name] for x in known if x.fault == f]) for f in (HEALTHY, "fault-2"))
        assert (own - other) * (numbers[name] - faulty) >= 0
        if abs(faulty - healthy) > 1e-9:
            assert own / other == pytest.approx((numbers[name] - healthy) / (faulty - healthy))


class Rows:
    """A table by observations, (size,) each, of zeros where there is none."""

    def __init__(self, rows, size):
        self.table, self.size = {key: row.copy() for key, row in rows.items()}, size

    def rows(self, observations):
        return np.array([self.table.get(each.tobytes(), np.zeros(self.size)) for each in np.array(observations)])


class ByValues(Rows):
    """Greedy policy of values of actions."""

    def q_values(self, observations):
        return self.rows(observations)

    def __call__(self, observations):
        return self.rows(observations).argmax(axis=1)


class ByPreferences(Rows):
    """Policy of preferences; last in each row is the value of the state."""

    def values(self, observations):
        return self.rows(observations)[:, -1]

    def __call__(self, observations):
        return faults.action_probabilities(self.rows(observations)[:, :-1])


def sarsa(env, steps, seed, *, gamma=0.97, ends_at_limit=False):
    """SARSA (Sutton and Barto, 2018, section 6.4) with a table; epsilon falls from 1 to 0.5."""
    rng, num_actions, q = np.random.default_rng(seed), int(env.action_space.n), {}

    def begin(observation, step):
        row = q.setdefault(observation.tobytes(), np.zeros(num_actions))
        explores = rng.random() < max(0.5, 1 - step / (0.5 * steps))
        return row, int(rng.integers(num_actions) if explores else rng.choice(np.flatnonzero(row == row.max())))

    row, action = begin(env.reset(seed=seed)[0], 0)
    for step in range(steps):
        observation, reward, terminated, truncated, _ = env.step(action)
        after, next_action = begin(observation, step)
        ended = terminated or (truncated and ends_at_limit)
        row[action] += 0.2 * (reward + (0 if ended else gamma * after[next_action]) - row[action])
        row, action = begin(env.reset()[0], step) if terminated or truncated else (after, next_action)
        if (step + 1) % (steps // 10) == 0:
            yield ByValues(q, num_actions)


@pytest.mark.long
def test_sarsa_is_healthy_and_its_faults_are_seen():
    worlds = ["cliff-vector", "road", "still"]
    healthy = diagnose(sarsa, worlds=worlds)
    assert healthy.is_healthy and healthy.on_policy and healthy.to_dict()["on_policy"]
    assert healthy.verdict.startswith("Nothing is wrong") and "as of SARSA" in healthy.verdict
    for setting, reading in (({"gamma": 0.5}, "gamma"), ({"ends_at_limit": True}, "cut_share")):
        wrong = diagnose(sarsa, worlds=worlds, hyperparameters=setting)
        assert reading in {each.reading for each in wrong.findings}, (setting, wrong.verdict)


def critic(env, steps, seed, *, ends_at_limit=False):
    """Actor and critic of one step with a table (section 13.5); where it no longer is, values are of older policies."""
    rng, size, table = np.random.default_rng(seed), int(env.action_space.n) + 1, {}

    def row_of(observation):
        return table.setdefault(observation.tobytes(), np.zeros(size))

    row = row_of(env.reset(seed=seed)[0])
    for step in range(steps):
        chances = faults.action_probabilities(row[None, :-1])[0]
        action = int(rng.choice(size - 1, p=chances))
        observation, reward, terminated, truncated, _ = env.step(action)
        ended = terminated or (truncated and ends_at_limit)
        error = reward + (0 if ended else 0.97 * row_of(observation)[-1]) - row[-1]
        row[-1] += 0.2 * error
        surprise = np.log(chances + 1e-12)
        pull = np.eye(size - 1)[action] - chances
        pull = error * pull - 0.01 * chances * (surprise - chances @ surprise)
        row[:-1] = np.clip(row[:-1] + 0.3 * pull, -50, 50)
        row = row_of(env.reset()[0]) if terminated or truncated else row_of(observation)
        if (step + 1) % (steps // 10) == 0:
            yield ByPreferences(table, size)


@pytest.mark.long
def test_values_that_lag_are_told_from_an_end_at_the_time_limit():
    worlds = ["cliff-vector", "road", "still"]
    healthy, wrong = (diagnose(critic, worlds=worlds, hyperparameters={"ends_at_limit": x}) for x in (False, True))
    assert healthy.is_healthy and not healthy.on_policy and healthy.readings["cut_share"] > 0.7
    assert "cut_share" in {each.reading for each in wrong.findings}


@pytest.mark.long
def test_the_table_of_pharos_is_diagnosed_and_its_discount_read_from_its_values():
    assert diagnose("q_learning").is_healthy
    short = diagnose("q_learning", hyperparameters={"gamma": 0.5}, worlds=["lake", "umbrella", "road"])
    assert short.findings[0].reading == "gamma" and 0.4 < 1 - 10 ** -short.readings["gamma"] < 0.6


@pytest.mark.long
@pytest.mark.parametrize("name", ["DQN", "PPO"])
def test_values_of_models_of_stable_baselines3_are_those_of_their_networks(name):
    import stable_baselines3
    import torch

    task, _, observations = solved("lake")
    env = PolicyRecorder(task, steps=64, interval=64, seed=0).env
    model = getattr(stable_baselines3, name)("MlpPolicy", env, seed=0, device="cpu")
    q_values, values = value_functions(model)
    tensor = torch.as_tensor(observations).float()
    with torch.no_grad():
        if name == "DQN":
            assert values is None and np.allclose(q_values(observations), model.q_net(tensor).numpy())
        else:
            assert q_values is None and np.allclose(
                values(observations), model.policy.predict_values(tensor).numpy()[:, 0]
            )
