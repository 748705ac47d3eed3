"""Suite v2: its digest, its worlds by rules in plain Python, its theorems, and scores of pairs."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from pharos import benchmark
from pharos.benchmark import AgentResults, BenchmarkTask, Ladder, Protocol, Suite, load_suite
from pharos.benchmark.contents import contents_of
from pharos.benchmark.diagnosis import fall_everywhere
from pharos.benchmark.page import page
from pharos.benchmark.scores import axis_score, score
from pharos.benchmark.suite import PAIRS, suite_of, write_suite
from pharos.errors import FileFormatError
from strategies import examples, small_mdps

DIGESTS = {
    "v1": "50d45f848f991081acf6b8ce6a5c532614ebc2139ea50d148094ea50894b1086",
    "v2": "9cd57e21c411a27e01067759e9dec8b8370293dc53163a538b4f545edb1e53ef",
}


@pytest.mark.parametrize("name", DIGESTS)
def test_suites_stay_what_they_are(name):
    assert load_suite(name).digest == DIGESTS[name]
    assert load_suite().name == "v1"


def test_ladders_of_v2_rise_and_pairs_are_one_world_in_two_ways():
    suite = load_suite("v2")
    for ladder in suite.ladders:
        levels = [task.level for task in ladder.tasks]
        if not ladder.pairs:
            assert levels == sorted(set(levels)), ladder.axis
        for first, second in ladder.pairs:
            assert (first.environment, first.parameters) == (second.environment, second.parameters)
            assert (first.value_optimal, first.value_uniform) == (second.value_optimal, second.value_uniform)
            assert first.digest != second.digest and (first.level, second.level) == (0, 1)
    assert {ladder.axis for ladder in suite.ladders if ladder.pairs} == {"representation", "hidden"}


def test_levels_are_what_the_parameters_say():
    """Measured before any run, and known without measuring: 2^size dives, lag, copies, powers of 10."""
    told = {
        "sea": lambda task: task.parameters["size"],
        "lag": lambda task: task.parameters["lag"],
        "copies": lambda task: task.parameters["irrelevant_bits"],
        "large": lambda task: -math.log10(task.chance.get("scale_rewards", 1.0)),
        "small": lambda task: math.log10(task.chance.get("scale_rewards", 1.0)),
    }
    rungs = [task for ladder in load_suite("v2").ladders if not ladder.pairs for task in ladder.tasks]
    counted = [task for task in rungs if task.name.partition("-")[0] in told]
    assert len(counted) == 31
    for task in counted:
        assert task.level == pytest.approx(told[task.name.partition("-")[0]](task), abs=1e-9), task.name


# Worlds by their rules ----------------------------------------------------------------------------------------------


def choice(world):
    """Starts, number of actions and step of delayed_choice, of which cue and bits never count."""
    length, num_actions, cues = world["length"], world.get("num_actions", 2), world.get("cues", 2)
    starts = [(0, right, False) for right in range(num_actions)[-cues:]]

    def step(state, action):
        time, right, is_right = state
        is_right = is_right or (time == length - 1 - world.get("lag", 0) and action == right)
        ended = time + 1 == length
        return (time + 1, right, is_right), float(ended and is_right), ended

    return starts, num_actions, step


def sea(world):
    """The same of deep_sea."""
    size = world["size"]
    right = np.random.RandomState(world["mapping_seed"]).binomial(1, 0.5, [size, size])

    def step(state, action):
        row, column = state
        if action != right[row, column]:
            return (row + 1, max(column - 1, 0)), 0.0, row + 1 == size
        paid = float(column == size - 1) - world["move_cost"] / size
        return (row + 1, min(column + 1, size - 1)), paid, row + 1 == size

    return [(0, 0)], 2, step


def chain(world):
    """The same of discounting_chain."""
    delays, best = world["delays"], world["mapping_seed"]

    def step(state, action):
        time, which = state[0] + 1, action if state[0] == 0 else state[1]
        paid = (1.0 + world["bonus"] * (which == best)) * (time == delays[which])
        return (time, which), paid, time == max(delays)

    return [(0, 0)], len(delays), step


def values(starts, num_actions, step):
    """Mean over starts of the optimal value and of that of uniform play, by recursion over states."""

    @cache
    def both(state):
        best, uniform = [], []
        for action in range(num_actions):
            following, paid, ended = step(state, action)
            after = (0.0, 0.0) if ended else both(following)
            best.append(paid + after[0])
            uniform.append(paid + after[1])
        return max(best), sum(uniform) / num_actions

    return tuple(sum(each) / len(starts) for each in zip(*map(both, starts), strict=True))


TWINS = {"delayed_choice": choice, "deep_sea": sea, "discounting_chain": chain}
RULED = [task for task in load_suite("v2").tasks if task.environment in TWINS]


@pytest.mark.parametrize("task", RULED, ids=[task.name for task in RULED])
def test_values_of_v2_are_those_of_its_rules_in_plain_python(task):
    twin = values(*TWINS[task.environment](task.parameters))
    assert (task.value_optimal, task.value_uniform) == pytest.approx(twin, abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("name", ["basic-three-steps", "sea-costly-6", "lag-15", "copies-6", "velocity-hidden"])
def test_tasks_of_v2_are_the_same_here(name):
    suite = load_suite("v2")
    suite.task(name).check(suite.protocol)


# Theorems -----------------------------------------------------------------------------------------------------------


def solved(**world):
    space = pharos.build(pharos.make("delayed_choice", **world), progress=False)
    mdp = space.mdp(gamma=0.9)
    return mdp, pharos.value_iteration(mdp)


@pytest.mark.long
@examples(12, st.integers(1, 5), st.integers(0, 4), st.integers(2, 4), st.integers(1, 4), st.integers(1, 4))
def test_copies_have_the_values_of_one_and_are_merged_into_it(length, lag, num_actions, cues, bits):
    world = {"length": length, "lag": min(lag, length - 1), "num_actions": num_actions, "cues": min(cues, num_actions)}
    mdp, one = solved(**world)
    copied, many = solved(**world, irrelevant_bits=bits)
    assert copied.num_states == mdp.num_states * 2**bits
    assert many.value_at_start == pytest.approx(one.value_at_start, abs=1e-12)
    assert sorted(many.v) == pytest.approx(sorted(np.repeat(one.v, 2**bits)), abs=1e-12)
    smallest, smaller = (pharos.bisimulation.minimize(each) for each in (mdp, copied))
    assert smallest.num_classes == smaller.num_classes


@pytest.mark.long
@examples(25, small_mdps(), st.sampled_from([1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3]), st.randoms(use_true_random=False))
def test_normalised_regret_does_not_know_the_unit_of_rewards(mdp, unit, draw):
    policy = np.array([[draw.random() + 0.1 for _ in range(mdp.num_actions)] for _ in range(mdp.num_states)])
    policy /= policy.sum(axis=1, keepdims=True)

    def values(unit):
        in_unit = mdp.with_rewards(np.asarray(mdp.rewards) * unit)
        uniform = np.full(policy.shape, 1 / mdp.num_actions)
        own = [pharos.evaluate_policy(in_unit, each, 1e-9 * unit).value_at_start for each in (policy, uniform)]
        return np.array([pharos.value_iteration(in_unit, 1e-9 * unit).value_at_start, *own]) / unit

    (optimal, own, uniform), in_unit = values(1.0), values(unit)
    assert in_unit == pytest.approx([optimal, own, uniform], abs=1e-7)
    if optimal - uniform > 1e-2:
        regret = (in_unit[0] - in_unit[1]) / (in_unit[0] - in_unit[2])
        assert regret == pytest.approx((optimal - own) / (optimal - uniform), abs=1e-4)


@pytest.mark.long
def test_rungs_of_the_unit_of_rewards_have_one_mdp_and_other_pay():
    suite = load_suite("v2")
    for axis, base in (("large_rewards", 10.0), ("small_rewards", 0.1)):
        rungs = next(ladder.tasks for ladder in suite.ladders if ladder.axis == axis)
        assert len({(task.value_optimal, task.value_uniform) for task in rungs}) == 1
        for power, task in enumerate(rungs):
            env = pharos.GymEnv("discounting_chain", **task.parameters, **task.chance)
            env.reset(seed=0)
            paid = [env.step(1)[1] for _ in range(5)]
            assert paid == pytest.approx([0, 4 * base**power, 0, 0, 0], rel=1e-12)


# Pairs --------------------------------------------------------------------------------------------------------------


def paired(pairs=2):
    names = [f"{each}-{way}" for each in range(pairs) for way in ("first", "second")]
    tasks = tuple(BenchmarkTask(name, "", level=float(k % 2)) for k, name in enumerate(names))
    ladder = Ladder("sight", "second", "one world in two ways", tasks, PAIRS)
    rung = tuple(BenchmarkTask(f"rung-{k}", "", level=float(k)) for k in range(2))
    core = (BenchmarkTask("core", ""),)
    return Suite("small", Protocol(), core, (ladder, Ladder("noise", "sd", "of rewards", rung)), "ab" * 32)


def agent(curves, name="agent"):
    arrays = {each: np.repeat(np.asarray(own, float)[:, None], 3, 1) for each, own in curves.items()}
    return AgentResults(name, "small", "ab" * 32, tuple(range(len(next(iter(arrays.values()))))), arrays)


FIRST = {
    "0-first": [0.1, 0.2, 0.3],
    "0-second": [0.5, 0.4, 0.9],
    "1-first": [0.0, 0.1, 0.0],
    "1-second": [0.2, 0.1, 0.1],
}
OTHER = {"core": [0.1, 0.2, 0.1], "rung-0": [0.1, 0.2, 0.1], "rung-1": [0.4, 0.3, 0.3]}


def test_the_score_of_pairs_is_one_less_what_the_second_costs():
    suite = paired()
    own = score(agent(FIRST), suite).axes["sight"]
    lost = [np.mean(FIRST[f"{each}-second"]) - np.mean(FIRST[f"{each}-first"]) for each in range(2)]
    assert own.score.value == pytest.approx(1 - np.mean(lost), abs=1e-12)
    assert own.score.low < own.score.value < own.score.high
    assert np.isnan(own.frontier.value) and np.isnan(own.fall.value)


def test_half_a_pair_has_no_score():
    suite = paired()
    runs = {name: 1 - np.array(own) for name, own in FIRST.items() if name != "1-second"}
    lost = np.mean(FIRST["0-second"]) - np.mean(FIRST["0-first"])
    assert axis_score(suite.ladders[0], runs).score.value == pytest.approx(1 - lost, abs=1e-12)
    assert axis_score(suite.ladders[0], {"1-first": runs["1-first"]}) is None
    assert suite.ladders[0].weights({"1-first"}) == {}


def test_compare_says_the_scores_of_pairs_and_not_that_of_their_tasks():
    suite = paired()
    weak = {name: [each + 0.1 for each in own] for name, own in FIRST.items()}  # in both ways
    blind = {name: [each + 0.5 * ("second" in name) for each in own] for name, own in FIRST.items()}
    own, other = agent({**FIRST, **OTHER}), agent({**weak, **OTHER}, "weak")
    same = benchmark.compare(own, other, suite=suite).axes["sight"]
    scores = [score(each, suite).axes["sight"].score.value for each in (own, other)]
    assert [same.score.ours, same.score.theirs] == pytest.approx(scores, abs=1e-12)
    assert same.score.interval.value == pytest.approx(0, abs=1e-12)
    worse = benchmark.compare(agent({**FIRST, **OTHER}), agent({**blind, **OTHER}, "blind"), suite=suite).axes["sight"]
    assert worse.score.interval.value > 0.3 and worse.score.improvement.value > 0.9


def test_the_power_of_pairs_is_that_of_their_difference():
    suite = paired()
    own = benchmark.power(agent({**FIRST, **OTHER}), suite=suite)["sight"]
    variances = [np.var(each, ddof=1) / 3 for each in FIRST.values()]
    assert own.standard_error == pytest.approx(np.sqrt(sum(variances)) / 2, abs=1e-12)


def test_the_page_shows_pairs_beside_ladders_and_they_do_not_hide_a_broken_agent():
    suite = paired()
    broken = {name: [1.0, 0.99, 1.0] for name in (*FIRST, *OTHER)}
    contents = contents_of(agent({**broken}, "broken"), beside=[agent({**FIRST, **OTHER}, "whole")], suite=suite)
    text = page(contents)
    assert "<h2>Pairs</h2>" in text and "0-first" in text and "nan" not in text.lower().replace("nano", "")
    assert contents.agent.score.axes["sight"].score.value == pytest.approx(1.0, abs=0.01)  # it loses nothing more
    lone = Suite("small", Protocol(), suite.core, suite.ladders[1:], "ab" * 32)
    assert fall_everywhere(contents) == fall_everywhere(
        contents_of(agent({n: broken[n] for n in OTHER}, "broken"), beside=[agent(OTHER, "whole")], suite=lone)
    )


def test_an_odd_number_of_tasks_is_no_list_of_pairs(tmp_path):
    import yaml

    tasks = tuple(replace(task, value_optimal=1.0, value_uniform=0.0) for task in paired().ladders[0].tasks[:3])
    odd = Suite("small", Protocol(), (), (Ladder("sight", "", "", tasks, PAIRS),))
    write_suite(odd, tmp_path / "odd.yaml")
    with pytest.raises(FileFormatError, match=r"^odd: ladder sight: has 3 tasks; expected pairs"):
        suite_of(yaml.safe_load((tmp_path / "odd.yaml").read_text()), "odd")
