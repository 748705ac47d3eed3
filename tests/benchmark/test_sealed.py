"""Sealed copies are the public tasks under other names: what is measured of them is the same to 1e-9."""

import itertools
import tempfile

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from pharos import hardness
from pharos.benchmark.sealed import frozen, permuted_actions, sealed_copies, sealed_instances, season_seed, write_suite
from pharos.benchmark.suite import BenchmarkTask, Protocol, Suite, load_suite
from pharos.errors import ParameterError
from pharos.observations import representation
from refusals import refusal
from strategies import examples

PROTOCOL = Protocol(steps=1500)
TASKS = {
    "catch": BenchmarkTask("catch", "catch/10x5", {}, "one_hot"),
    "sticky": BenchmarkTask("sticky", "umbrella_chain", {}, "vector", chance={"sticky": 0.25}),
    "sea": BenchmarkTask("sea", "deep_sea", {"size": 6, "mapping_seed": 1}, "hash", chance={"random": 0.1}),
    "lake": BenchmarkTask("lake", "frozen_lake", {"size": 4, "seed": 3, "slippery": True}, "vector"),
    "paid": BenchmarkTask("paid", "taxi/5x5-rainy", {}, "one_hot"),
    "starts": BenchmarkTask("starts", "mini_grid/empty-random-5x5", {}, "one_hot"),
    "image": BenchmarkTask("image", "catch/10x5", {}, "simple_image", {"motion": True}),
}


def suite_of(*names: str) -> Suite:
    return Suite("small", PROTOCOL, tuple(frozen(TASKS[name], PROTOCOL) for name in names), (), "")


def measures(task: BenchmarkTask) -> dict[str, float]:
    learnt = task.training_task(PROTOCOL)
    mdp, reference = learnt.mdp, learnt.reference
    seen = representation(learnt.space, learnt.observation, **learnt.observation_options)
    discounted = mdp.with_gamma(0.95).with_horizon(None)
    solution = pharos.value_iteration(discounted)
    return {
        "optimal": reference.optimal,
        "uniform": reference.uniform,
        "worst": reference.worst,
        "diameter": hardness.diameter(mdp).upper,
        "gaps": float((solution.v[:, None] - solution.q).sum()),
        "smallest gap": hardness.minimal_gap(discounted, solution),
        "kernel regret": hardness.kernel_regret(mdp, seen, solution=learnt.optimal).value,
        "policy regret": hardness.kernel_policy_regret(mdp, seen, solution=learnt.optimal).value,
    }


@pytest.mark.long
@pytest.mark.parametrize("name", ["catch", "sticky", "sea", "lake"])
def test_measures_of_copies_are_those_of_the_public_task(name):
    public = suite_of(name)
    expected = measures(public.core[0])

    @examples(3, st.text("0123456789abcdef", min_size=4))
    def check(beacon):
        with tempfile.TemporaryDirectory() as folder:
            copy = sealed_copies(public, season_seed("s1", beacon), folder).core[0]
            assert measures(copy) == pytest.approx(expected, rel=0, abs=1e-9)
            assert copy.digest != public.core[0].digest
            copy.check(PROTOCOL)

    check()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paid", "starts"])
def test_chance_and_several_starts_are_copied(name, tmp_path):
    public = suite_of(name)
    copy = sealed_copies(public, "1", tmp_path).core[0].training_task(PROTOCOL)
    task = public.core[0].training_task(PROTOCOL)
    values = ((each.reference.optimal, each.reference.uniform) for each in (copy, task))
    assert next(values) == pytest.approx(next(values), rel=1e-12)
    assert copy.return_range == pytest.approx(task.return_range)  # the largest reward of an outcome, not of the mean
    assert copy.time_limit == task.time_limit


def test_a_copy_has_the_tables_of_the_public_task_with_permuted_columns(tmp_path):
    public = suite_of("catch")
    copy = sealed_copies(public, "1", tmp_path).core[0].training_task(PROTOCOL).env
    space = public.core[0].training_task(PROTOCOL).space
    rewards, shown = space.mdp().rewards, pharos.observe(space.environment, "one_hot")(space.states())
    fitting = [
        order
        for order in map(list, itertools.permutations(range(3)))
        if (copy.successors[..., 0] == np.asarray(space.successors)[:, order]).all()
        and (copy.rewards == rewards[:, order]).all()
    ]
    assert len(fitting) == 1
    columns, expected = (sorted(map(tuple, each.T.tolist())) for each in (copy.recorded, shown))
    assert columns == expected and (copy.recorded != shown).any()


def test_another_lot_gives_other_copies_and_the_same_lot_the_same_wherever_they_lie(tmp_path):
    public = suite_of("catch")
    digests = [
        sealed_copies(public, season_seed("s1", beacon), tmp_path / str(i)).digest
        for i, beacon in enumerate(("abc", " ABC\n", "abd"))
    ]
    assert digests[0] == digests[1] != digests[2]


def test_a_sealed_suite_is_read_as_it_was_written(tmp_path):
    pytest.importorskip("yaml")
    copies = sealed_copies(suite_of("catch", "sea"), "1", tmp_path / "copies")
    write_suite(copies, tmp_path / "copies.yaml")
    read = load_suite(tmp_path / "copies.yaml")
    assert read.digest == copies.digest and [task.name for task in read.core] == ["catch", "sea"]
    read.check()


def test_images_are_not_permuted_and_lots_must_be_given(tmp_path):
    assert "no task can be sealed" in refusal(ParameterError, sealed_copies, suite_of("image"), "1", tmp_path)
    assert "expected a name and the output" in refusal(ParameterError, season_seed, "s1", " ")


def test_instances_are_drawn_anew_and_stay_as_hard_to_plan():
    public = suite_of("sea", "lake")
    sea, lake = sealed_instances(public, "1").core
    assert sea.parameters["mapping_seed"] != 1 and lake.parameters["seed"] != 3
    assert sea.observation_options["seed"] > 0
    assert sea.value_optimal == pytest.approx(public.core[0].value_optimal, abs=1e-12)
    first, again, second = (sealed_instances(public, lot).digest for lot in ("1", "1", "2"))
    assert first == again != second


def test_actions_are_permuted_where_each_has_several_outcomes():
    mdp = pharos.build("river_swim", progress=False).mdp()
    backwards, outcomes = permuted_actions(mdp, np.array([1, 0]))
    again, _ = permuted_actions(backwards, np.array([1, 0]))
    assert outcomes is not None and len(outcomes.rewards) == outcomes.offsets[-1]
    assert (again.rewards == mdp.rewards).all() and (backwards.rewards == mdp.rewards[:, ::-1]).all()
    assert abs(again.dynamics.matrix() - mdp.dynamics.matrix()).max() < 1e-15
