"""Words of the report: page and `compare` never contradict each other, and mistakes are called by their names."""

import re
from dataclasses import replace

import numpy as np
import pytest

from naive import benchmark as naive
from pharos import benchmark
from pharos.benchmark import AgentResults, compare, power
from pharos.benchmark.agent_diagnosis import diagnosis_of_results
from pharos.benchmark.comparison import compare_groups
from pharos.benchmark.contents import contents_of, residual_tasks, sentence
from pharos.benchmark.diagnosis import fall_everywhere, falls, groups_of, strengths, suspicion, without_verdict
from pharos.benchmark.page import page
from pharos.benchmark.properties import known_properties, properties_of, purpose_of
from pharos.benchmark.suite import BenchmarkTask, Ladder, Protocol, Suite
from pharos.errors import ParameterError

AXES = ("exploration", "credit", "scale")
CORE = tuple(BenchmarkTask(name, "", digest=name) for name in "abc")
LADDERS = tuple(
    Ladder(
        axis,
        "bits",
        "of something",
        tuple(BenchmarkTask(f"{axis}-{k}", "", axis=axis, level=float(k), digest=axis) for k in (1, 2, 4)),
    )
    for axis in AXES
)
SUITE = Suite("small", Protocol(steps=900, evaluations=3), CORE, LADDERS, "d1")
TITLES = {"Worse": "worse", "Better": "better", "Less than 0.02 apart": "less than 0.02 apart"}
TITLES["Not shown to differ"] = "not shown to differ"


def results(agent, curves, suite=SUITE):
    seeds = len(next(iter(curves.values())))
    return AgentResults(agent, suite.name, suite.digest, tuple(range(seeds)), curves)


def drawn(rng, agent):
    """Results of any level, spread, slope and number of seeds."""
    level, spread, slope = rng.uniform(0, 0.8), rng.choice([0.001, 0.02, 0.2]), rng.uniform(0, 0.4)
    seeds = int(rng.choice([1, 3, 5, 10]))
    return results(
        agent,
        {
            task.name: level + slope * np.log2(task.level or 1.0) + rng.normal(0, spread, (seeds, 3))
            for task in SUITE.tasks
        },
    )


def text_of(html):
    return re.sub(r"<[^>]+>", "\n", html.split("</style>")[1])


def said(html):
    """Axis -> the verdict that the section in words has on it."""
    section = html.split("<h2>Strengths and weaknesses in words</h2>")[1].split("</section>")[0]
    groups = re.findall(r"<h3>([^<]+)</h3><ul>(.*?)</ul>", section)
    return {item.split(": ")[0]: TITLES[title] for title, items in groups for item in re.findall(r"<li>([^<]+)", items)}


@pytest.mark.long
def test_page_and_compare_never_contradict_each_other():
    rng, counts = np.random.default_rng(0), dict.fromkeys(("page", "one seed", "broken", *TITLES.values()), 0)
    for draw in range(2000):
        mine, other = drawn(rng, "mine"), drawn(rng, "dqn")
        contents = contents_of(mine, beside=[other], suite=SUITE)
        own = compare(mine, other, suite=SUITE) if draw % 20 == 0 else contents.comparisons[0]
        verdicts = {axis: each.score.verdict for axis, each in own.axes.items()}
        lines = [(text.split(": ")[0], verdict) for verdict, texts in strengths(contents).items() for text in texts]
        assert sorted(lines) == sorted(pair for pair in verdicts.items() if pair[1] != "one seed")
        assert bool(without_verdict(contents)) == ("one seed" in verdicts.values())
        assert bool(fall_everywhere(contents)) == ({own.core.verdict, *verdicts.values()} == {"worse"})
        for verdict in verdicts.values():
            counts[verdict] += 1
        counts["broken"] += bool(fall_everywhere(contents))
        if draw % 20 == 0 and not fall_everywhere(contents):
            counts["page"] += 1
            assert said(page(contents)) == {axis: each for axis, each in verdicts.items() if each != "one seed"}
    assert min(counts.values()) > 10, counts


@pytest.mark.long
def test_a_short_horizon_is_credit_on_the_page_as_in_compare():
    """Regrets of an agent with discount 0.5 on the umbrellas, whose last rung opened the interval of its frontier."""
    regrets = [
        [0.03, 0.07, 0.03],
        [0.8, 0.77, 0.9],
        [1, 1, 0.67],
        [1, 0.53, 1],
        [0.8, 0.8, 0.6],
        [1, 1, 1],
        [1, 1, 0.7],
    ]
    suite = benchmark.load_suite("v1")
    ladder = next(each for each in suite.ladders if each.axis == "credit")
    curves = {
        task.name: np.repeat(np.array(each)[:, None], 15, 1) for task, each in zip(ladder.tasks, regrets, strict=True)
    }
    mine = results("mine.py:learn", curves, suite)
    own = compare(mine, "dqn").axes["credit"]
    assert own.score.verdict == "worse" and own.score.adjusted < 1e-4 and own.frontier.high < 0
    lines = strengths(contents_of(mine))
    assert any(line.startswith("credit: 11.7 steps (10.9 to 12.9); DQN 137, score -0.4") for line in lines["worse"])
    assert not any("DQN" in line for verdict, texts in lines.items() if verdict != "worse" for line in texts)


def constant(agent, core, axes, seeds=5):
    """Results whose runs vary by 0.01: regret of the core, and of the rungs of each axis."""
    noise = 0.01 * np.linspace(-1, 1, seeds)[:, None] * np.ones(3)
    curves = {task.name: core + noise for task in CORE}
    for ladder, regrets in zip(LADDERS, axes, strict=True):
        curves |= {task.name: each + noise for task, each in zip(ladder.tasks, regrets, strict=True)}
    return results(agent, curves)


HEALTHY = constant("dqn", 0.2, [(0.0, 0.2, 0.6)] * 3)


def test_an_agent_that_is_worse_everywhere_is_told_to_look_for_a_bug_and_nothing_else():
    broken = constant("mine.py:DQN", 0.6, [(0.5, 0.8, 0.9)] * 3)
    text = text_of(page(contents_of(broken, beside=[HEALTHY], suite=SUITE)))
    assert text.count("Falls everywhere: the core and all 3 axes are below DQN's. Look for a bug first") == 2
    assert "Worse" not in text and "On no axis" not in text
    weak = constant("mine.py:DQN", 0.6, [(0.5, 0.8, 0.9)] * 2 + [(0.0, 0.2, 0.6)])
    text = text_of(page(contents_of(weak, beside=[HEALTHY], suite=SUITE)))
    assert "Falls everywhere" not in text and "Worse" in text and "exploration: 1 bits" in text


def test_who_fails_on_the_lowest_rung_is_told_that_it_is_no_matter_of_the_axis():
    own = contents_of(
        constant("mine", 0.2, [(0.8, 0.9, 1.0), (0.1, 0.9, 1.0), (0.0, 0.2, 0.6)]), beside=[HEALTHY], suite=SUITE
    )
    text = text_of(page(own))
    assert (
        "Fails on the lowest rung of exploration already, with a score of 0.20 (0.19 to 0.21) (DQN 1.00): not a" in text
    )
    assert "lowest rung of credit" not in text and "lowest rung of scale" not in text
    assert sentence(own).startswith(
        "mine fails on the lowest rung of exploration already (0.20 and DQN 1.00), assigns "
    )
    rows = {row[0]: row[1:] for row in falls(own)}
    assert [float(rows[axis][1].split()[0]) for axis in AXES] == pytest.approx([0.15, 0.85, 0.4], abs=0.011)
    assert rows["credit"][2] == "1.00, 0.40"


def test_the_fall_of_an_axis_has_the_interval_of_a_bootstrap_of_seeds():
    rng = np.random.default_rng(3)
    regrets = {task.name: rng.uniform(0.2, 0.2 + 0.1 * (task.level or 1), (40, 1)) for task in SUITE.tasks}
    own = benchmark.score(results("mine", regrets), SUITE).axes["credit"]
    rungs = [1 - regrets[f"credit-{k}"][:, 0] for k in (1, 2, 4)]
    assert own.fall.value == pytest.approx(rungs[0].mean() - (rungs[1].mean() + rungs[2].mean()) / 2)
    draws = [[rng.choice(each, 40).mean() for each in rungs] for _ in range(4000)]
    low, high = np.percentile([one - (two + three) / 2 for one, two, three in draws], (2.5, 97.5))
    assert (own.fall.low, own.fall.high) == (pytest.approx(low, abs=0.005), pytest.approx(high, abs=0.005))


def test_one_rung_has_no_frontier():
    curves = {name: curve for name, curve in HEALTHY.curves.items() if name in ("a", "b", "c", "credit-2")}
    own = contents_of(replace(HEALTHY, curves=curves), beside=[HEALTHY], suite=SUITE)
    assert np.isnan(own.agent.score.axes["credit"].frontier.value)
    text = text_of(page(own))
    assert "no frontier" in text and "nan" not in text.lower() and "beyond" not in text.split("What is proven")[0]
    alone = {"credit-2": HEALTHY.curves["credit-2"]}
    assert "One rung of a ladder has no frontier." in page(
        contents_of(replace(HEALTHY, curves=alone), suite=SUITE, beside=[])
    )


def test_what_is_below_two_hundredths_has_no_verdict():
    near, far = (
        constant("mine", 0.2 + shift, [(0.0 + shift, 0.2 + shift, 0.6 + shift)] * 3, 10) for shift in (0.019, 0.03)
    )
    near, far = (compare(each, constant("dqn", 0.2, [(0.0, 0.2, 0.6)] * 3, 10), suite=SUITE) for each in (near, far))
    assert near.core.adjusted < 0.05 and near.core.verdict == "less than 0.02 apart" and far.core.verdict == "worse"


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_one_run_ten_times_has_neither_intervals_nor_verdicts(seed):
    """One seed of the shipped DQN as ten, which was better and worse than DQN with p < 0.0001."""
    real = AgentResults.read("dqn")
    equal = replace(
        real, agent="mine", curves={name: np.repeat(own[seed : seed + 1], 10, 0) for name, own in real.curves.items()}
    )
    own = compare(equal, "dqn")
    verdicts = {own.core.verdict, *(each.score.verdict for each in own.axes.values())}
    assert verdicts == {each.verdict for each in own.tasks.values()} == {"equal seeds"}
    assert np.isnan(own.core.interval.low) and np.isnan(own.core.p_value)
    scores = benchmark.score(equal, benchmark.load_suite("v1"))
    assert np.isnan(scores.core.low) and np.isnan(scores.axes["credit"].frontier.low)
    one = replace(real, seeds=(0,), curves={name: own[seed : seed + 1] for name, own in real.curves.items()})
    assert scores.core.value == pytest.approx(benchmark.score(one, benchmark.load_suite("v1")).core.value)
    with pytest.raises(ParameterError, match=r"all seeds have the same curve on .* expected runs that differ"):
        power(equal)
    text = text_of(page(contents_of(equal)))
    header = text.split("Core score")[0]
    assert "mine: all seeds have the same curve on" in header and "Equal seeds: no verdict beside DQN, PPO" in text
    assert not re.search(r"\b(Worse|Better|Not shown to differ)\b", text.split("in words")[1].split("Residuals")[0])


def test_one_task_with_equal_curves_of_many_is_honest():
    curves = {**HEALTHY.curves, "a": np.array([[1.0, 0.7, 0.7]] * 5)}
    own = compare(replace(HEALTHY, curves=curves), HEALTHY, suite=SUITE)
    assert own.axes["credit"].score.verdict == "not shown to differ" and "seeds" not in own.tasks["a"].verdict


# Groups of tasks ------------------------------------------------------------------------------------------------------


def lesioned(tasks, by=0.6):
    """The shipped DQN, whose regret is raised on some core tasks."""
    real = AgentResults.read("dqn")
    curves = {name: np.minimum(own + by * (name in tasks), 1.0) for name, own in real.curves.items()}
    return replace(real, agent="mine.py:DQN", curves=curves)


@pytest.mark.long
@pytest.mark.parametrize(
    ("group", "number"),
    [("vector", 6), ("rewards of several sizes", 6), ("ended by time alone", 2)],
)
def test_a_fault_of_one_group_of_tasks_has_its_name(group, number):
    """Groups as they part a dropped feature, clipped rewards, and ends of time, of 24 tasks."""
    contents = contents_of("dqn")
    groups = {name: tasks for each in groups_of(contents) for name, tasks in each.items()}
    assert len(groups[group]) == number
    broken = lesioned(groups[group])
    for family in groups_of(contents):
        found = compare_groups(broken, AgentResults.read("dqn"), family)
        worst = min(found, key=lambda name: found[name].interval.value)
        assert worst == group or group not in family
        assert group not in family or found[group].verdict == "worse"
    section = page(contents_of(broken)).split("Core tasks in groups, beside DQN")[1].split("</section>")[0]
    assert f"The largest loss is on {group}, " in section


@pytest.mark.long
@pytest.mark.parametrize(("group", "table"), [("vector", "by property"), ("ended by time alone", "by what is seen")])
def test_a_loss_of_tasks_that_two_groups_share_is_told_of_the_group_that_loses_without_the_other(group, table):
    """A dropped feature costs a world that time ends, too, and a wrong time limit one that is seen as a vector."""
    groups = {name: tasks for each in groups_of(contents_of("dqn")) for name, tasks in each.items()}
    broken = lesioned(groups[group], by=1.0)
    section = page(contents_of(broken)).split("Core tasks in groups, beside DQN")[1].split("</section>")[0]
    said = re.search(rf"It is a loss on {group}: tasks of ([^<]+) without these have ([-+.0-9]+)\.", section)
    assert said is not None and f"a loss on {said[1]}" not in section and table in section.split(said[0])[0]
    {*groups[said[1]]} - {*groups[group]}
    assert {*groups[said[1]]} & {*groups[group]} and abs(float(said[2])) < 0.02  # nothing was done to these


@pytest.mark.long
def test_a_loss_that_few_seeds_do_not_show_is_called_suspicious_and_an_equal_agent_is_not():
    real = AgentResults.read("dqn")
    groups = {name: tasks for each in groups_of(contents_of("dqn")) for name, tasks in each.items()}
    raised = dict(zip(groups["ended by time alone"], ([0.6, 0.4, 0.2], [0.3, 0.5, 0.4]), strict=True))
    few = {name: curve[:3] for name, curve in real.curves.items()}
    broken = {name: np.minimum(few[name] + np.array(more)[:, None], 1) for name, more in raised.items()}
    mine = replace(real, agent="my dqn", seeds=(0, 1, 2), curves={**few, **broken})
    text = suspicion(mine, real, groups)
    loss = compare_groups(mine, real, groups)["ended by time alone"]
    assert loss.verdict == "not shown to differ" and loss.p_value < 0.05
    assert text.startswith(f"Not shown, but suspicious: ended by time alone, {loss.interval.value:+.2f}, beside ")
    assert text in page(contents_of(mine)) and diagnosis_of_results(contents_of(mine)).verdict.endswith(text)
    assert suspicion(replace(mine, curves=few), real, groups) == ""
    shown = {name: np.ones_like(few[name]) for name in groups["rewards of several sizes"]}
    assert suspicion(replace(mine, curves={**few, **broken, **shown}), real, groups) == ""


@pytest.mark.long
def test_groups_have_the_difference_of_plain_python_and_holm_of_their_table():
    ours, theirs = AgentResults.read("dqn"), AgentResults.read("ppo")
    groups = groups_of(contents_of("dqn"))[0]
    found = compare_groups(ours, theirs, groups)
    for name, tasks in groups.items():
        x, y = (
            [[naive.run_score(run) for run in each.curves[task].tolist()] for task in tasks] for each in (ours, theirs)
        )
        value = naive.mean(map(naive.mean, x)) - naive.mean(map(naive.mean, y))
        assert found[name].interval.value == pytest.approx(value)
    order = [*found]
    expected = naive.holm([found[name].p_value for name in order])
    assert [found[name].adjusted for name in order] == pytest.approx(expected)


@pytest.mark.long
def test_properties_of_tasks_are_those_of_their_worlds():
    suite = benchmark.load_suite("v1")
    names = ("frozen_lake-5-0-vector-random-0.1", "mini_grid_rooms-4x3-vector", "cliff_walking-3-9-hash-random-0.1")
    for name in (*names, "deep_sea-6", "catch-noise-1"):
        task = suite.task(name)
        assert known_properties()[task.digest] == properties_of(task, suite.protocol)
    assert {*known_properties()} == {task.digest for task in suite.tasks}
    for name, own in ((task.name, known_properties()[task.digest]) for task in suite.tasks):
        assert 0 <= own.constant < 5, name


def test_constant_play_stands_beside_each_core_task():
    text = text_of(page(contents_of("dqn"))).split("Core tasks beside")[1]
    row = text.split("\ndiscounting_chain-bonus-1-one_hot\n")[1].split("\n")
    assert "one action" in text and "1.00" in row[:8]  # its best chain is the same action all along


# Residuals, and mistakes ----------------------------------------------------------------------------------------------


def residual_section(html):
    return html.split("<h2>Residuals: worse than theory says</h2>")[1].split("</section>")[0]


@pytest.mark.long
def test_residuals_of_the_shipped_agent_are_those_of_theory_and_those_of_a_fault_its_own():
    text = residual_section(page(contents_of("ppo")))
    assert "Theory is too hopeful: PPO of pharos fares alike." in text and "look for a bug here" not in text
    real = AgentResults.read("ppo")
    curves = {name: own + (name == "umbrella_chain-8") for name, own in real.curves.items()}
    text = residual_section(page(contents_of(replace(real, agent="mine.py:PPO", curves=curves))))
    own, theirs = text.split("Theory is too hopeful")
    assert "look for a bug here" in own and ">umbrella_chain-8<" in own and own.count("<tr>") == 2
    assert theirs.count("<tr>") == 1 + len(residual_tasks(contents_of("ppo")))


@pytest.mark.long
def test_the_kind_is_asked_for_where_the_name_does_not_say_it():
    results = replace(AgentResults.read("dqn"), agent="mine.py:learn", record={})
    counts = {each: len(residual_tasks(contents_of(results, predictor=each))) for each in ("dqn", "ppo", "table")}
    text = residual_section(page(contents_of(results)))
    assert "does not say its kind" in text and "--predictor dqn, ppo, table or none" in text
    others = f"Others would list {counts['dqn']} beside the idealised DQN, {counts['ppo']} beside the idealised PPO and"
    assert others in text
    for predictor, name in (("dqn", "mine.py:learn"), (None, "mine.py:DQN")):
        text = residual_section(page(contents_of(replace(results, agent=name), predictor=predictor)))
        assert "does not say its kind" not in text and f"{counts['ppo']} beside the idealised PPO" in text


def test_runs_without_a_policy_and_with_one_at_the_end_are_told():
    names = [task.name for task in SUITE.tasks]
    late = np.ones((5, 3)) - np.array([0.0, 0.0, 0.4])
    for curve, text in (
        (np.ones((5, 3)), "In 40 of 60 runs all 3 evaluations are random play: was no policy yielded?"),
        (
            late,
            "In 40 of 60 runs 2 of 3 evaluations are random play, the first policy counts at the end: yield earlier.",
        ),
    ):
        results_of_most = replace(HEALTHY, curves=HEALTHY.curves | dict.fromkeys(names[:8], curve))
        assert text in text_of(page(contents_of(results_of_most, beside=[], suite=SUITE)))
        results_of_few = replace(HEALTHY, curves=HEALTHY.curves | dict.fromkeys(names[:2], curve))
        assert "evaluations are random" not in text_of(page(contents_of(results_of_few, beside=[], suite=SUITE)))


def with_policies(curves, policies, agent="agent"):
    own = results(agent, curves)
    return replace(own, record={"policies": policies})


def test_a_policy_of_one_action_and_noise_in_play_are_told():
    """Three core tasks with scores 0.5, 0.7 and 0.9; played greedily the first one has 0.8."""
    curves = {name: np.full((2, 3), regret) for name, regret in zip("abc", (0.5, 0.3, 0.1), strict=True)}
    facts = {
        "a": {"one_action": 0.95, "deterministic": 0.0, "greedy_score": 0.8},
        "b": {"one_action": 0.5, "deterministic": 1.0},
        "c": {"one_action": 0.4, "deterministic": 1.0},
    }
    html = page(contents_of(with_policies(curves, facts), beside=(), suite=SUITE))
    words = " ".join(text_of(html).split())
    assert "on 1 of 3 core tasks the final policy prefers the same action nearly everywhere (a)" in words
    assert "Deterministic on 2 of 3 core tasks" in words
    assert "score 0.80 instead of 0.70 on 3 core tasks: of 0.30 below optimal, 0.10 is noise in play" in words
    for record in (
        {},
        {"a": 3},
        {"a": {"one_action": "much", "deterministic": 1}},
        [1],
    ):  # earlier files, and forged ones
        assert "What the policies are like" not in page(
            contents_of(with_policies(curves, record), beside=(), suite=SUITE)
        )


def test_each_task_of_the_suite_says_what_it_asks_and_what_failing_means():
    suite = benchmark.load_suite("v1")
    purposes = {task.name: purpose_of(task) for task in suite.tasks}
    assert all(each.asks and each.failing for each in purposes.values())
    assert "key" in purposes["mini_grid-door_key-6-0-hash"].asks
    assert "rooms" in purposes["mini_grid-multi-room-n2-s4-vector-sticky-0.25"].asks
    assert purpose_of(BenchmarkTask("own", "mine.py:World")) is None
    assert len({*purposes.values()}) == 17  # no row of the table is unused
