"""Predictions of a study: written before its runs, hashed and dated; and what is said of them afterwards."""

import errno
import json
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from command_line import run
from pharos import hardness, study
from pharos.agents import (
    NETWORK_CURVE,
    NETWORK_POLICY_PREDICTORS,
    NETWORK_PREDICTORS,
    POLICY_PREDICTORS,
    agent_called,
    hyperparameters,
)
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted
from pharos.hardness import registry
from pharos.prediction import PREDICTORS, learners
from pharos.study import predictions, read_predictions, specification, validation, write_predictions
from pharos.study.report.model_sections import winners
from refusals import failing, refusal

SPEC = {
    "name": "tiny",
    "steps": 3000,
    "seeds": 1,
    "blocks": [
        {
            "environments": [{"name": "simple_grid", "parameters": {"height": 3, "width": 3}}],
            "observations": ["vector", {"name": "vector", "options": {"hide": "row"}}],
            "agents": ["dqn", "ppo", "q_learning"],
        }
    ],
}


@pytest.fixture(scope="module")
def predicted(tmp_path_factory):
    return study.predict(SPEC, tmp_path_factory.mktemp("study"))


def test_every_cell_that_sees_observations_is_predicted(predicted):
    assert predicted["agent"].tolist() == ["dqn", "dqn", "ppo", "ppo"]
    assert predicted["network"].tolist() == ["mlp128x2, pytorch"] * 2 + ["mlp128x2+tanh, sb3"] * 2
    assert predicted[list(PREDICTORS)].notna().all().all()
    of_policies = predicted[list(POLICY_PREDICTORS)].notna()
    assert of_policies.all(axis=1).tolist() == of_policies.any(axis=1).tolist() == [False, False, True, True]
    assert json.loads(predicted.iloc[2]["clipped_curve"])[0] == [0, 1.0]  # it begins as uniform play
    assert predicted.iloc[0][["policy_curve", "clipped_curve"]].tolist() == ["", ""]
    is_ppo = predicted["agent"] == "ppo"
    assert (predicted.loc[is_ppo, "clipped_regret_evaluated"] != predicted.loc[is_ppo, "policy_regret_evaluated"]).all()
    plain, hidden = predicted.iloc[0], predicted.iloc[1]
    assert plain["aliasing_floor"] == 0 < hidden["aliasing_floor"]
    assert plain["kernel_regret"] <= hidden["kernel_regret"]
    assert plain["tabular_regret"] == hidden["tabular_regret"]


def test_the_primary_predictor_alone_is_what_it_is_beside_the_others(predicted, tmp_path):
    alone = study.predict(SPEC, tmp_path, primary=True)
    is_ppo = predicted["agent"] == "ppo"
    for rows, names in ((is_ppo, [*NETWORK_POLICY_PREDICTORS, NETWORK_CURVE]), (~is_ppo, [*NETWORK_PREDICTORS])):
        both = ["instance", "agent", "observation", "network", "num_states", *names]
        pd.testing.assert_frame_equal(alone.loc[rows, both], predicted.loc[rows, both])
        assert alone.loc[rows, names].notna().all().all()
    assert alone[[*PREDICTORS[:-1], "policy_regret", "huber_regret", "clipped_regret_evaluated"]].isna().all().all()
    assert alone["estimated_error"].tolist() == [0.0] * 4  # small kernels are exact
    assert alone["notes"].str.contains("^network_regret: a mean over 8 walks").tolist() == [True, True, False, False]
    assert alone["notes"].str.contains("^network_policy_regret: a mean over 8").tolist() == [False, False, True, True]


def test_the_primary_predictor_of_an_agent_that_has_none_is_a_note(tmp_path):
    block = {**SPEC["blocks"][0], "agents": ["a2c"]}
    told = study.predict({**SPEC, "blocks": [block]}, tmp_path, primary=True)
    assert told["notes"].str.contains("agent a2c has no primary predictor; expected one of dqn, ppo").all()


def test_only_the_blocks_that_are_asked_for_are_predicted(tmp_path, monkeypatch):
    monkeypatch.setattr("pharos.prediction.predicted", lambda _, primary: {})
    block = {"environments": ["frozen_lake/4x4"], "agents": ["dqn"]}
    two = study.specification({"name": "two", "blocks": [block, {**block, "environments": ["frozen_lake/8x8"]}]})
    assert study.predict(two, tmp_path, blocks=[2])["instance"].tolist() == ["frozen_lake/8x8"]
    with pytest.raises(ParameterError, match="block 3: study 'two' has blocks 1 to 2"):
        study.predict(two, tmp_path, blocks=[3])


def test_an_actor_critic_is_idealised_with_the_rollouts_and_the_lambda_of_its_agent(monkeypatch):
    rollouts = []

    def report(mdp, names, **options):
        rollouts.append(options["rollouts"])
        return {names[0]: SimpleNamespace(name=names[0], value=None)}

    monkeypatch.setattr(hardness, "report", report)
    for agent in ("ppo", "a2c"):  # A2C of Stable-Baselines3 has a lambda of 1
        own = hyperparameters(agent, "simple_grid", "vector")
        config = {"agent": agent, "steps": 1000, "hyperparameters": own}
        seen = {"representation": hardness.Representation.of_matrix([[1.0]])}  # of no known output layer
        agent_called(agent).idealised.columns(config, None, seen)
    assert rollouts == [
        hardness.Rollouts(steps=512, gradient_steps=16, gae_lambda=0.95),
        *[hardness.Rollouts(steps=512, gradient_steps=16, gae_lambda=0.95, clip_range=0.2)] * 2,  # as A2C has not
        hardness.Rollouts(steps=40, gradient_steps=1, gae_lambda=1.0),
    ]


def test_the_layers_of_a_network_are_those_of_its_hyperparameters():
    """Wherever Stable-Baselines3 takes them from; another network has no prediction instead of that of the default."""
    layers = learners._hidden_layers
    assert layers({}) == [128]
    assert layers({"net_arch": [64, 32]}) == layers({"policy_kwargs": {"net_arch": [64, 32]}}) == [64, 32]
    assert layers({"net_arch": {"pi": [64], "vf": [64]}}) == [64]
    assert "same layers for policy and value" in refusal(ParameterError, layers, {"net_arch": {"pi": [64], "vf": [32]}})
    assert "'activation_fn'" in refusal(ParameterError, layers, {"policy_kwargs": {"activation_fn": "relu"}})


def test_a_file_of_predictions_has_its_hash_and_its_date(predicted, tmp_path):
    said = write_predictions(specification(SPEC), predicted, tmp_path / "p.parquet")
    frame, about = read_predictions(tmp_path / "p.parquet")
    pd.testing.assert_frame_equal(frame, predicted)
    assert about == said
    assert set(about) == {"study", "sha256", "date", "version"}
    again = write_predictions(specification(SPEC), predicted, tmp_path / "again.parquet")
    assert again["sha256"] == said["sha256"]
    changed = predicted.assign(kernel_regret=predicted["kernel_regret"] + 1e-9)
    other = write_predictions(specification(SPEC), changed, tmp_path / "q.parquet")
    assert other["sha256"] != said["sha256"]
    import pyarrow.parquet as pq

    swapped = pq.read_table(tmp_path / "q.parquet")
    swapped = swapped.replace_schema_metadata(pq.read_table(tmp_path / "p.parquet").schema.metadata)
    pq.write_table(swapped, tmp_path / "q.parquet", write_page_checksum=True)
    assert "changed after it was written" in refusal(ResultCorrupted, read_predictions, tmp_path / "q.parquet")
    pq.write_table(swapped.replace_schema_metadata({}), tmp_path / "q.parquet", write_page_checksum=True)
    assert "holds no predictions" in refusal(FileFormatError, read_predictions, tmp_path / "q.parquet")
    for words in ('{"study": "tiny', "[1]", "{}"):
        pq.write_table(swapped.replace_schema_metadata({b"pharos.predictions": words}), tmp_path / "q.parquet")
        assert "what it says of itself is damaged" in refusal(ResultCorrupted, read_predictions, tmp_path / "q.parquet")
    with pytest.raises(FileFormatError, match="no such file; expected predictions"):
        read_predictions(tmp_path / "absent.parquet")


def test_no_predictions_are_lost_where_others_are_written(predicted, tmp_path):
    file, spec = tmp_path / "p.parquet", specification(SPEC)
    first = write_predictions(spec, predicted, file)
    before = file.read_bytes()
    assert write_predictions(spec, predicted, file) == first, "with the date that they had"
    assert file.read_bytes() == before
    for i in range(1, 4):
        write_predictions(spec, predicted.assign(kernel_regret=float(i)), file)
    kept = sorted(path for path in tmp_path.iterdir() if path != file)
    assert len(kept) == 3 and all(path.name.startswith("p.20") and path.suffix == ".parquet" for path in kept)
    regrets = sorted(read_predictions(path)[0]["kernel_regret"].iloc[0] for path in (file, *kept))
    assert regrets == sorted([predicted["kernel_regret"].iloc[0], 1.0, 2.0, 3.0])
    file.write_bytes(b"no predictions")
    write_predictions(spec, predicted, file)
    assert read_predictions(file)[1]["sha256"] == first["sha256"]


def test_predictions_stay_where_others_cannot_be_written(predicted, tmp_path, monkeypatch):
    file, spec = tmp_path / "p.parquet", specification(SPEC)
    write_predictions(spec, predicted, file)
    before = file.read_bytes()
    monkeypatch.setattr(predictions.training, "write_table", failing(errno.ENOSPC))
    assert "No space left" in refusal(OSError, write_predictions, spec, predicted.assign(kernel_regret=1.0), file)
    assert file.read_bytes() == before and list(tmp_path.iterdir()) == [file]


def made_up(noise, classes=8, instances=3, slope=1.0, seed=0):
    """Cells whose regret is a line in kernel_regret; all else is noise."""
    rng = np.random.default_rng(seed)
    rows = [
        {"environment": f"c{c}", "instance": f"c{c}/{i}", "chance": "plain", "agent": "dqn", "observation": seen}
        for c in range(classes)
        for i in range(instances)
        for seen in ("vector", "image", "hash")
    ]
    frame = pd.DataFrame(rows)
    for name in PREDICTORS:
        frame[name] = rng.random(len(frame)) + 0.1
    cells = frame[["environment", "instance", "chance", "agent", "observation"]].copy()
    cells["greedy"] = slope * frame["kernel_regret"] + noise * rng.normal(size=len(frame))
    cells["played"] = np.nan
    return frame, cells


@pytest.mark.long
def test_a_line_without_noise_is_predicted_on_unseen_classes():
    judged = validation(*made_up(0.0), permutations=19).set_index("predictor")
    best = judged.loc["kernel_regret"]
    assert best["r_squared"] == pytest.approx(1.0)
    assert best["rho"] == pytest.approx(1.0)
    assert best["agreement"] == 1.0
    assert (best["cells"], best["classes"]) == (72, 8)
    others = judged.drop("kernel_regret")
    assert (others["r_squared"] < 0.2).all()
    assert (others["r_squared_lower"] < others["r_squared_upper"]).all()
    assert set(judged["outcome"]) == {"greedy"}


def test_held_out_classes_are_predicted_by_the_others_alone():
    """One by one with NumPy's least squares."""
    frame, cells = made_up(0.2, seed=1)
    found = validation(frame, cells, predictors=["kernel_regret"], permutations=19).iloc[0]
    x, y, c = frame["kernel_regret"].to_numpy(), cells["greedy"].to_numpy(), frame["environment"].to_numpy()
    predicted = np.empty(len(x))
    for each in np.unique(c):
        predicted[c == each] = np.polyval(np.polyfit(x[c != each], y[c != each], 1), x[c == each])
    expected = 1 - ((y - predicted) ** 2).sum() / ((y - y.mean()) ** 2).sum()
    assert found["r_squared"] == pytest.approx(expected)
    assert found["r_squared_lower"] < expected < found["r_squared_upper"]


def test_a_wrong_sign_within_mdps_is_seen():
    frame, cells = made_up(0.0, slope=-1.0)
    judged = validation(frame, cells, predictors=["kernel_regret"], permutations=99).iloc[0]
    assert judged["p_agreement"] > 0.9
    assert judged["agreement"] == 0.0
    assert judged["rho_within"] == pytest.approx(-1.0)


def test_too_few_classes_are_a_line():
    assert "at least three classes" in refusal(ParameterError, validation, *made_up(0.0, classes=2))
    frame, cells = made_up(0.0)
    assert "no cell of the predictions" in refusal(ParameterError, validation, frame, cells.assign(agent="ppo"))


@pytest.mark.long
def test_the_command_line_predicts_and_reports(tmp_path):
    import yaml

    worlds = [("simple_grid", {"height": 3, "width": 3}), ("river_swim", {"length": 4}), ("deep_sea", {"size": 3})]
    spec = {**SPEC, "steps": 200, "evaluations": 4, "hardness": {"measures": ["minimal_gap"]}}
    blocks = [{"environments": [{"name": name, "parameters": given}], "agents": ["dqn"]} for name, given in worlds]
    file = tmp_path / "tiny.yaml"
    file.write_text(yaml.safe_dump({**spec, "blocks": blocks}))
    predictions = tmp_path / "predictions.parquet"
    done = run("study", "predict", str(file), "--out", str(predictions), "--json")
    assert json.loads(done.stdout)["cells"] == 3
    assert done.stderr.count("pharos: cell ") == 3  # no terminal: a line each, as it takes minutes
    where = ["--out", str(tmp_path / "results")]
    assert run("study", "run", str(file), *where).exit_code == 0
    done = run("study", "report", str(file), *where, "--predictions", str(predictions))
    assert done.exit_code == 0, done.output
    assert "sha256" in (tmp_path / "results" / "report" / "report.html").read_text()
    assert (tmp_path / "results" / "report" / "tables" / "predictions.csv").exists()
    first = tmp_path / "first.yaml"  # the same in two parts
    first.write_text(yaml.safe_dump({**spec, "blocks": blocks[:1]}))
    rest = tmp_path / "rest.yaml"
    rest.write_text(yaml.safe_dump({**spec, "blocks": blocks[1:]}))
    for part in (first, rest):
        assert run("study", "predict", str(part), "--out", f"{part}.parquet").exit_code == 0
    both = [word for part in (first, rest) for word in ("--predictions", f"{part}.parquet")]
    together = run("study", "report", str(file), *where, "--to", str(tmp_path / "both"), *both)
    assert together.exit_code == 0, together.output
    assert "3 of 3 runs had begun" in together.stderr
    name = "report/tables/predictions.csv"
    assert (tmp_path / "both" / "tables" / "predictions.csv").read_text() == (tmp_path / "results" / name).read_text()
    twice = run("study", "report", str(file), *where, *both, "--predictions", f"{first}.parquet")
    assert twice.exit_code == 2 and "1 cell predicted twice" in twice.stderr


@pytest.mark.slow
def test_parts_of_a_study_are_predicted_alone_and_wrong_parts_named(tmp_path):
    part = study.predict(SPEC, tmp_path, blocks=[1], agents=["dqn"], observations=["vector"])
    assert part["agent"].tolist() == ["dqn", "dqn"]
    with pytest.raises(ParameterError, match="block 2: study 'tiny' has blocks 1 to 1"):
        study.predict(SPEC, tmp_path, blocks=[2])
    with pytest.raises(ParameterError, match="unknown agent of study 'tiny' 'sarsa'"):
        study.predict(SPEC, tmp_path, agents=["sarsa"])
    with pytest.raises(ParameterError, match="unknown observation of study 'tiny' 'one_hot'"):
        study.predict(SPEC, tmp_path, observations=["one_hot"])


@pytest.mark.long
def test_a_measure_of_the_users_own_is_a_predictor_beside_ours(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_MEASURES", dict(registry._MEASURES))
    hardness.register("rows", lambda problem: float(problem.mdp.num_states), definition="number of rows")
    told = study.predict(SPEC, tmp_path, agents=["dqn"])
    assert told["rows"].tolist() == told["num_states"].tolist()

    frame, cells = made_up(0.1)
    frame["rows"] = frame.pop("kernel_regret")  # the user's is the one that is right
    judged = validation(frame, cells, permutations=19)
    assert judged.set_index("predictor").loc["rows", "r_squared"] > 0.8
    assert "on classes left out rows (R² " in winners(judged)[0]
    assert "of the baselines" in winners(judged)[0]
