"""`pharos.predict`: the measure that it names, an interval that holds what it promises, and the order in words."""

import csv
import itertools
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import pharos
from command_line import run
from pharos import hardness, importers
from pharos.agents import agent_called, primary_predictors
from pharos.errors import ParameterError, UndefinedMeasure, UnknownName
from pharos.hardness.representation import network_regret as network_regret_module
from pharos.observations import representation
from pharos.prediction import Published, prediction, published
from pharos.prediction.calibration import COMMON, OrderCounts
from pharos.prediction.prediction import PairOrder
from refusals import refusal

CHOICES = Path(__file__).parents[2] / "docs" / "studies" / "choices"

SHORT = {"learning_starts": 100, "target_update_interval": 100, "batch_size": 8}
OPTIONS = {"steps": 1000, "hyperparameters": SHORT}


def cells(predicted, observed, classes, mdps=None):
    predicted, observed = np.array(predicted, float), np.array(observed, float)
    mdps = np.array([str(n) for n in range(len(predicted))] if mdps is None else mdps)
    return Published(np.array(classes), mdps, predicted, observed, *np.ones((3, len(predicted))))


def naive_half_width(known, level, but=None):
    """The smallest error such that classes, each weighing the same, have enough of their cells within it."""
    names = [name for name in sorted(set(known.classes)) if name != but]
    errors = {name: np.abs(known.observed - known.predicted)[known.classes == name] for name in names}
    aim = min(1.0, level * (len(names) + 1) / len(names))
    for width in sorted(np.concatenate([*errors.values()])):
        if np.mean([np.mean(errors[name] <= width) for name in names]) >= aim - 1e-12:
            return width
    raise AssertionError


@pytest.mark.parametrize("seed", range(20))
def test_half_widths_are_those_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    classes = rng.choice(list("abcdefgh"), 40)
    known = cells(rng.random(40), rng.random(40), classes)
    for level in (0.5, 0.8, 0.95):
        assert known.half_width(level) == naive_half_width(known, level)
        assert known.half_width(level, classes[0]) == naive_half_width(known, level, classes[0])
    inside = [
        np.mean(np.abs(known.observed - known.predicted)[classes == name] <= naive_half_width(known, 0.8, name))
        for name in sorted(set(classes))
    ]
    assert known.coverage(0.8) == pytest.approx(np.mean(inside), abs=1e-12)
    for near, low, high in ((-0.3, -np.inf, 0.1), (0.1, 0.1, 0.2), (0.39, 0.2, 0.4), (0.5, 0.4, 0.8), (3.0, 0.8, 9.0)):
        some = [
            (name, error <= naive_half_width(known, 0.8, name))
            for name, predicted, error in zip(
                classes, known.predicted, np.abs(known.observed - known.predicted), strict=True
            )
            if low <= predicted < high
        ]
        shares = [np.mean([is_in for other, is_in in some if other == name]) for name in {name for name, _ in some}]
        assert known.is_near(near).sum() == len(some)
        assert known.coverage(0.8, near) == pytest.approx(np.mean(shares) if some else np.nan, abs=1e-12, nan_ok=True)


def test_a_prediction_as_no_published_one_was_has_no_share():
    assert np.isnan(cells([0.5, 0.6], [0.5, 0.6], ["a", "b"]).coverage(near=0.05))


def test_a_class_that_is_drawn_as_the_others_is_covered():
    covered = []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        spread = rng.gamma(2.0, 0.1, 21)  # of each class its own
        classes = np.repeat(np.arange(21), 5).astype(str)
        known = cells(np.zeros(105), rng.normal(0, np.repeat(spread, 5)), classes)
        width = known.half_width(0.8, "20")
        covered.append(np.mean(np.abs(known.observed)[classes == "20"] <= width))
    assert 0.79 <= np.mean(covered) <= 0.86  # 400 classes: a standard error of 0.015


def test_orders_are_counted_among_all_pairs_of_one_mdp_ties_included():
    known = cells([0.1, 0.25, 0.9, 0.1, 0.24], [0.1, 0.3, 0.05, 0.1, 0.1], list("aaabb"), list("xxxyy"))
    both = OrderCounts(pairs=2, right=1, clear_pairs=1, clear_right=1)  # 0.1 and 0.25 differ by 0.2; those of y tie
    assert known.ordered(0.15) == known.ordered(-0.15) == both
    far = OrderCounts(pairs=2, right=0, clear_pairs=1, clear_right=0)  # 0.25 and 0.9, 0.1 and 0.9: by 0.25 and 0.05
    assert known.ordered(0.7) == far
    assert known.ordered(0.01) == OrderCounts(pairs=0, right=0, clear_pairs=0, clear_right=0)


@pytest.mark.parametrize("agent", primary_predictors())
def test_counts_are_those_of_plain_loops_over_pairs(agent):
    known = published(agent)
    counts = dict.fromkeys(("pairs", "right", "clear_pairs", "clear_right"), 0)
    for mdp in sorted(set(known.mdps)):
        rows = list(zip(known.predicted[known.mdps == mdp], known.observed[known.mdps == mdp], strict=True))
        for (x, y), (other_x, other_y) in itertools.combinations(rows, 2):
            if 0.1 <= abs(x - other_x) < 0.2:
                is_right, is_clear = (
                    (x > other_x and y > other_y) or (x < other_x and y < other_y),
                    abs(y - other_y) > 0.05,
                )
                counts["pairs"] += 1
                counts["right"] += is_right
                counts["clear_pairs"] += is_clear
                counts["clear_right"] += is_right and is_clear
    assert known.ordered(0.15) == OrderCounts(**counts) and counts["pairs"] > 60


@pytest.mark.parametrize("agent", primary_predictors())
def test_published_cells_are_of_many_classes_and_sets(agent):
    known = published(agent)
    assert len(set(known.classes)) == 54
    assert len(known.predicted) >= 550
    assert np.isfinite([known.predicted, known.observed, known.states, known.steps, known.spreads]).all()
    assert 0.74 <= known.coverage() <= 0.88
    counts = known.ordered(1.0)
    assert counts.right / counts.pairs > 0.8  # what the words rest on


def test_the_common_hyperparameters_are_those_of_the_presets():
    yaml = pytest.importorskip("yaml")
    for name in ("hardness-dev", "hardness-sealed"):
        text = (Path(pharos.study.__file__).parent / "presets" / f"{name}.yaml").read_text(encoding="utf-8")
        sets = yaml.safe_load(text)["hyperparameters"]
        assert {agent: sets[f"common_{agent}"] for agent in ("dqn", "ppo")} == COMMON


@pytest.mark.slow
def test_the_published_hyperparameters_are_a_choice_and_others_are_named(tmp_path):
    world = {"length": 5, "agent": "ppo", "steps": 2048}
    own, common = (pharos.predict("river_swim", **world, common=common) for common in (False, True))
    assert any("gamma" in line and "--hyperparameters common" in line for line in own.warnings)
    assert not any("--hyperparameters" in line for line in common.warnings)
    assert {name: common.hyperparameters[name] for name in COMMON["ppo"]} == COMMON["ppo"]
    words = ["predict", "river_swim", "length=5", "--agent", "ppo", "--steps", "2048", "--hyperparameters"]
    said = run(*words, "common", "--json")
    assert json.loads(said.stdout)["cells"][0]["value"] == pytest.approx(common.cells[0].value)
    assert "mine.yaml" in (other := run(*words, "mine.yaml").output) and "common" in other


def test_what_nobody_declares_is_not_named_as_another_hyperparameter():
    declared = {name: value for name, value in COMMON["dqn"].items() if name not in ("n_envs", "n_steps")}
    for changed, named in (({}, ""), ({"n_steps": 3}, "n_steps: "), ({"gamma": 0.9}, "gamma: ")):
        said = pharos.predict("river_swim", length=5, steps=1500, agent="dqn", hyperparameters={**declared, **changed})
        lines = [line for line in said.warnings if "--hyperparameters" in line]
        assert len(lines) == bool(named) and all(line.startswith(named) for line in lines)


def test_hyperparameters_that_the_agent_lacks_are_refused_and_those_without_effect_named():
    with pytest.raises(UnknownName, match="did you mean 'learning_rate'"):
        pharos.predict("river_swim", length=5, hyperparameters={"learning_rat": 0.1})
    said = pharos.predict("river_swim", length=5, steps=1500, hyperparameters={"tau": 0.5}).warnings
    assert any(line.startswith("tau: no part of the idealised learner") for line in said)
    assert len(pharos.predict("river_swim", ["vector", "vector"], length=5, steps=1500).cells) == 1
    coins = pharos.predict("river_swim", ["vector", ("vector", {"irrelevant": 2})], length=5, steps=1500).warnings
    assert sum("irrelevant entries are 0 in kernels" in line for line in coins) == 1
    assert any(line.startswith("tau, n_steps: no part of") for line in unused_by({"tau": 0.5, "n_steps": 5}))
    assert not any("no part of" in line for line in unused_by({"n_steps": 1, "policy_kwargs": {"net_arch": [128]}}))


def unused_by(hyperparameters):
    return pharos.predict("river_swim", length=5, steps=1500, common=True, hyperparameters=hyperparameters).warnings


def test_steps_between_updates_are_read_in_both_forms():
    of_list, of_number, of_array, other = (
        pharos.predict("deep_sea", size=5, steps=3000, common=True, hyperparameters={**early, "train_freq": each})
        for early in [{"learning_starts": 100}]
        for each in ([10, "step"], 10, np.int64(10), 4)
    )
    assert of_list.cells[0].value == of_number.cells[0].value == of_array.cells[0].value != other.cells[0].value


@pytest.mark.parametrize(
    ("agent", "hyperparameters", "reason"),
    [
        ("dqn", {"train_freq": (1, "episode")}, "train_freq is (1, 'episode'); expected a number"),
        ("dqn", {"train_freq": 0}, "expected an integer of at least 1"),
        ("dqn", {"batch_size": 2.5}, "expected an integer of at least 1"),
        ("dqn", {"n_envs": 0}, "expected an integer of at least 1"),
        ("dqn", {"gamma": None}, "gamma is None; expected a number"),
        ("dqn", {"policy_kwargs": "dict(net_arch=[8])"}, "expected a mapping"),
        ("dqn", {"net_arch": 64}, "expected a list of units"),
        ("ppo", {"net_arch": "small"}, "expected a list of units"),
        ("ppo", {"clip_range": "lin_0.2"}, "expected a number above 0"),
        ("ppo", {"n_epochs": 2.7}, "expected an integer of at least 1"),
    ],
)
def test_values_that_no_idealised_learner_has_are_refused(agent, hyperparameters, reason):
    predicted = partial(pharos.predict, "river_swim", agent=agent, length=5, steps=1500, common=True)
    assert reason in refusal(ParameterError, predicted, hyperparameters=hyperparameters)


def test_a_unit_outside_of_what_was_tested_is_named():
    known = published("dqn")
    low, high = known.spreads.min(), known.spreads.max()
    none = pharos.mdp.ChanceSetting()
    for spread, is_outside in ((low, False), (high, False), (low / 2, True), (high * 2, True)):
        lines = list(prediction._warnings(known, 100, 30_000, spread, none))
        assert len(lines) == is_outside and all("is V* less the value of uniform play" in line for line in lines)


@pytest.mark.slow
def test_a_dqn_is_predicted_in_the_unit_that_it_is_paid_in():
    world = {"length": 5, "steps": 3000, "common": True}
    plain, by_number, by_range = (
        pharos.predict("river_swim", **world, scale_rewards=scale).cells[0].value for scale in ("", 250.0, "range")
    )
    spread = pharos.training.Task.of("river_swim", {"length": 5}).reference.spread()
    assert by_range == pharos.predict("river_swim", **world, scale_rewards=spread).cells[0].value
    assert len({plain, by_number, by_range}) == 3


@pytest.mark.slow
def test_another_measure_stands_in_for_unknown_networks_and_many_observations(monkeypatch):
    world = {"length": 5, "steps": 3000, "common": True}
    assert not any("predicted by" in line for line in pharos.predict("river_swim", **world).warnings)
    for agent, name, landmarks in (
        *(("dqn", "huber_regret", 2), ("ppo", "kernel_policy_regret", 2)),
        *(("dqn", "huber_regret", None), ("ppo", "kernel_policy_regret", None)),
    ):
        if landmarks is None:
            monkeypatch.setattr(network_regret_module, "MOST_OBSERVATIONS", 4)
        answer = pharos.predict("river_swim", agent=agent, landmarks=landmarks, **world)
        assert answer.cells[0].measure == name != answer.predictor == primary_predictors()[agent]
        (line,) = (line for line in answer.warnings if "predicted by" in line)
        assert f"predicted by {name}, as {answer.predictor} is for at most" in line


def test_agents_without_published_runs_are_refused():
    with pytest.raises(ParameterError, match="agent 'a2c': no published runs to calibrate on; expected one of"):
        pharos.predict("river_swim", agent="a2c")


@pytest.mark.long
def test_a_dqn_is_predicted_by_the_learner_with_its_loss_and_schedule():
    answer = pharos.predict("river_swim", ["vector", ("hash", {"bits": 8})], length=5, sticky=0.1, **OPTIONS)
    space = pharos.build(pharos.make("river_swim", length=5))
    schedule = hardness.Schedule(
        steps=1000, learning_starts=100, period=100, gradient_steps=25, gamma=0.99, exploration_fraction=0.5
    )
    rate = agent_called("dqn").defaults["learning_rate"]
    for cell, options in zip(
        answer.cells, ({"observation": "vector"}, {"observation": "hash", "bits": 8}), strict=True
    ):
        mdp = pharos.sticky_actions(space.mdp(gamma=1.0).with_horizon(space.environment.max_episode_steps), 0.1)
        expected = hardness.network_regret(
            mdp,
            representation(space, **options),
            schedule=schedule,
            sampling=hardness.Sampling(walks=hardness.NETWORK_WALKS, batch_size=8, buffer_size=50_000),
            adam=hardness.Adam(learning_rate=rate, max_grad_norm=10.0),
        )
        assert cell.value == expected.value
        assert cell.tabular == expected.tabular
        assert cell.measure == "network_regret"
        assert (cell.low, cell.high) == (max(0.0, cell.value - answer.half_width), cell.value + answer.half_width)
        entry = cell.to_dict()
        assert (cell.lower, cell.upper) == (cell.low, cell.high) == (entry["lower"], entry["upper"])
        assert (entry["low"], entry["high"]) == (entry["lower"], entry["upper"])
        assert (cell.local_coverage, cell.local_cells) == (entry["local_coverage"], entry["local_cells"])
        assert cell.local_coverage == published("dqn").coverage(near=cell.value) and cell.local_cells > 70
    assert answer.half_width == published("dqn").half_width()
    assert [cell.observation for cell in answer.cells] == ["vector", "hash(bits=8)"]
    assert answer.predictor == "network_regret" and answer.states == 5
    assert any("sticky" in warning for warning in answer.warnings)
    assert any("1,000 steps" in warning for warning in answer.warnings)
    assert any("learning_starts, batch_size" in warning for warning in answer.warnings)


@pytest.mark.long
def test_a_ppo_is_predicted_with_its_rollouts_and_steps():
    answer = pharos.predict("river_swim", agent="ppo", steps=2048, length=5, hyperparameters={"n_epochs": 3})
    space = pharos.build(pharos.make("river_swim", length=5))
    settings = pharos.agents.hyperparameters("ppo", "river_swim", "vector", {"n_epochs": 3})
    expected = hardness.network_policy_regret(
        space.mdp(gamma=1.0).with_horizon(space.environment.max_episode_steps),
        representation(space, "vector", "mlp128x2+tanh", initialisation="sb3"),
        schedule=hardness.Schedule(steps=2048, gamma=0.99),
        rollouts=hardness.Rollouts(
            steps=512, gradient_steps=12, clip_range=0.2, environments=8, epochs=3, entropy_weight=0.01
        ),
        adam=hardness.Adam(learning_rate=settings["learning_rate"], max_grad_norm=0.5, epsilon=1e-5),
    )
    assert answer.cells[0].value == expected.value
    assert answer.cells[0].tabular == expected.tabular
    assert answer.cells[0].network == "mlp128x2+tanh"
    assert answer.cells[0].deviation == expected.curve.deviation


@pytest.mark.slow
@pytest.mark.parametrize("agent", primary_predictors())
def test_the_learning_rate_and_the_unit_of_rewards_are_known(agent):
    world = {"agent": agent, "length": 5, "steps": 2048}
    values = [
        pharos.predict("river_swim", **world, **options).cells[0].value
        for options in ({}, {"hyperparameters": {"learning_rate": 1e-7}}, {"scale_rewards": "range"})
    ]
    assert len({*values}) == 3


@pytest.mark.slow
def test_a_shortlist_is_of_the_same_predictions():
    worlds = [pharos.make("simple_grid", height=3, width=side) for side in (3, 4)]
    own = pharos.agents.hyperparameters("ppo", "simple_grid", "vector") | {"gamma": 0.9}
    predicted = prediction.regret_predictor("ppo", worlds, steps=4000, chances=[{}, {"random": 0.1}])
    cells = [
        pharos.predict(world, agent="ppo", steps=4000, hyperparameters=own, random=random).cells[0].value
        for world in worlds
        for random in (0.0, 0.1)
    ]
    assert predicted(own) == pytest.approx(np.mean(cells), abs=1e-12)


@pytest.mark.long
def test_noise_of_rewards_makes_it_harder_to_learn():
    quiet, loud = (
        pharos.predict("deep_sea", size=4, steps=3000, hyperparameters=SHORT, reward_noise=noise).cells[0].tabular
        for noise in (0.0, 50.0)
    )
    assert loud > quiet + 0.2


@pytest.mark.long
def test_imported_tables_are_predicted(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    mdp = pharos.TabularMDP.from_arrays([[1, 0], [1, 0]], [[0.0, 0.1], [1.0, 0.0]], gamma=0.9, horizon=20)
    table = pharos.predict(importers.environment(mdp), "one_hot", **OPTIONS)
    assert table.states == 2 and 0 <= table.cells[0].value <= 2


@pytest.mark.long
def test_networks_of_ones_own_are_predicted():
    import torch

    own = pharos.predict(
        "river_swim", length=5, networks=["mlp8", lambda shape: torch.nn.Linear(int(np.prod(shape)), 1)], **OPTIONS
    )
    assert len(own.cells) == 2 and own.cells[0].network == "mlp8" != own.cells[1].network


@pytest.mark.parametrize(
    ("difference", "counts", "words"),
    [
        (0.3, (20, 19, 17, 17), "vector is easier than hash: so in 19 of 20 such pairs, by more than 0.05 in 17"),
        (
            *(0.02, (40, 32, 10, 9)),
            "vector is easier than hash if their regrets differ by more than 0.05: so in 9 of 10 that did; 30 of 40 "
            "such pairs do not",
        ),
        (
            *(0.3, (10, 6, 8, 5)),
            "vector or hash: too close to call; 2 of 10 such pairs do not differ by more than 0.05, and vector was "
            "easier in 5 of 8 that did",
        ),
    ],
)
def test_orders_are_told_in_words(difference, counts, words):
    names = ("pairs", "right", "clear_pairs", "clear_right")
    assert str(PairOrder("vector", "hash", difference, OrderCounts(**dict(zip(names, counts, strict=True))))) == words


def test_nothing_is_called_without_pairs():
    order = PairOrder("vector", "hash", 0.3, OrderCounts(pairs=0, right=0, clear_pairs=0, clear_right=0))
    assert not order.is_called and "too close to call" in str(order)


@pytest.mark.slow
def test_the_order_of_networks_is_not_called():
    answer = pharos.predict("simple_grid", networks=["mlp8x2", "mlp128x2"], steps=6000, height=3, width=3)
    (order,) = answer.orders
    assert order.of_networks and not order.is_called and "predictions ordered networks rightly in 5 of 16" in str(order)
    texts = [(CHOICES / f"{name}.csv").read_text().splitlines() for name in ("predictions-network", "runs")]
    cells = [{tuple(r.values())[:6]: r for r in csv.DictReader(lines) if r["kind"] == "network"} for lines in texts]
    right = []
    for a, b in itertools.combinations(cells[0], 2):
        if a[1:5] == b[1:5]:
            said, seen = (
                float(c[a][n]) - float(c[b][n]) for c, n in zip(cells, ("predicted", "observed"), strict=True)
            )
            if abs(seen) > 0.05:
                right.append(said * seen > 0)
    counts = prediction.NETWORKS_IN_ORDER
    assert (sum(right), len(right)) == (counts.right, counts.pairs) == (counts.clear_right, counts.clear_pairs)


def test_what_cannot_be_predicted_is_one_line(monkeypatch):
    with pytest.raises(ParameterError, match="steps is 500, but learning begins after 1,000 steps; expected at least"):
        pharos.predict("river_swim", steps=500)
    with pytest.raises(ParameterError, match="steps is 500, but the first rollout ends after 511 steps"):
        pharos.predict("river_swim", steps=500, agent="ppo")
    with pytest.raises(ParameterError, match=r"learning_rate is 'lin_0\.1'; expected a number above 0"):
        pharos.predict("river_swim", length=5, hyperparameters={"learning_rate": "lin_0.1"})
    with pytest.raises(ParameterError, match="no observation to predict for"):
        pharos.predict("river_swim", [])
    with pytest.raises(ParameterError, match="of episodes of some number of steps; found horizon none"):
        pharos.predict("river_swim", horizon=None)
    monkeypatch.setattr(prediction, "MOST_STATES", 4)
    with pytest.raises(ParameterError, match="has 5 states; predictions are made for at most 4: choose a smaller"):
        pharos.predict("river_swim", length=5)


@pytest.mark.long
def test_a_world_where_nothing_can_be_learnt_has_no_prediction(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    mdp = pharos.TabularMDP.from_arrays([[1, 1], [0, 0]], [[1.0, 1.0], [0.0, 0.0]], gamma=0.9, horizon=20)
    with pytest.raises(UndefinedMeasure, match="uniform"):
        pharos.predict(importers.environment(mdp), "one_hot", **OPTIONS)


@pytest.mark.slow
def test_the_command_answers_in_json_and_in_words_and_draws(tmp_path):
    words = ["predict", "river_swim", "length=5", "--observation", "vector", "--observation", "hash,bits=8"]
    words += ["--steps", "1000", *(f"--set={name}={value}" for name, value in SHORT.items())]
    answer = json.loads(run(*words, "--json", "--plot", str(tmp_path / "bars.svg")).stdout)
    assert [cell["observation"] for cell in answer["cells"]] == ["vector", "hash(bits=8)"]
    assert answer["orders"][0]["text"] and answer["level"] == 0.8
    assert "hash(bits=8)" in (tmp_path / "bars.svg").read_text() or (tmp_path / "bars.svg").stat().st_size > 1000
    said = run(*words)
    assert said.exit_code == 0
    assert "0 is optimal, 1 is uniform play" in said.stdout and "80 % interval" in said.stdout
    first = answer["cells"][0]
    assert f"{first['local_coverage']:.2f} of {first['local_cells']}" in said.stdout
    assert any(word in said.stdout for word in ("is easier than", "too close to call"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--observation", "hash,bits"], "expected NAME or NAME,OPTION=VALUE"),
        (["--agent", "sarsa"], "agent 'sarsa': no published runs"),
        (["--network", "mlp0"], "mlp0"),
        (["--plot", "bars.txt"], "--plot"),
    ],
)
def test_wrong_options_are_named(words, message):
    done = run("predict", "river_swim", "length=5", "--steps", "1000", "--set", "learning_starts=100", *words)
    assert isinstance(done.exception, ParameterError) or done.exit_code == 2
    assert message in str(done.exception) + done.output
