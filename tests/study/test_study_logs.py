"""Curves of a study for TensorBoard and Weights & Biases: what is finished, once, with its exact values."""

import sys
import types

import pytest

import command_line
import fake_training
from pharos import study
from pharos.errors import MissingExtra, UnknownName

SPECIFICATION = {
    "name": "logged",
    "steps": 40,
    "evaluations": 4,
    "seeds": 2,
    "blocks": [{"environments": ["frozen_lake/4x4"], "agents": ["q_learning"], "chance": ["plain", {"sticky": 0.25}]}],
}


@pytest.fixture
def opened(tmp_path):
    """A study of four runs, of which three are finished."""
    spec = study.specification(SPECIFICATION)
    for run in spec.runs[:3]:
        fake_training.attempt(run, tmp_path)
    return spec, tmp_path


def test_tensorboard_gets_each_finished_run_once(opened):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    spec, folder = opened
    assert study.log(spec, folder, to="tensorboard") == 3
    assert study.log(spec, folder, to="tensorboard") == 0
    fake_training.attempt(spec.runs[3], folder)
    assert study.log(spec, folder, to="tensorboard") == 1
    files = sorted(folder.glob("tensorboard/*/*/*/*/events*"))
    agent = "frozen_lake_4x4/{}/tabular_Q_learning/seed-{}"
    names = [agent.format(chance, seed) for chance in ("plain", "sticky_0_25") for seed in (0, 1)]
    assert [str(file.parent.relative_to(folder / "tensorboard")) for file in files] == names
    events = EventAccumulator(str(files[0].parent)).Reload()
    curve = study.curves(spec, folder).query("seed == 0 and chance == 'plain'")
    for name in ("value", "expected_regret", "cumulative_expected_regret", "normalized_regret", "episodes"):
        scalars = events.Scalars(f"pharos/{name}")
        assert [scalar.step for scalar in scalars] == [10, 20, 30, 40]
        assert [scalar.value for scalar in scalars] == pytest.approx(curve[name].tolist())
    assert "_hparams_/session_start_info" in events.summary_metadata


class StandIn(types.ModuleType):
    """Weights & Biases as far as it is called, and what it was told."""

    def __init__(self):
        super().__init__("wandb")
        self.runs = []
        self.Settings = dict

    def init(self, **options):
        run = types.SimpleNamespace(options=options, points=[], summary={}, finished=False)
        run.log = lambda values, step: run.points.append((step, values))
        run.finish = lambda: setattr(run, "finished", True)
        self.runs.append(run)
        return run


def test_weights_and_biases_gets_each_finished_run_once_offline_too(opened, monkeypatch):
    spec, folder = opened
    wandb = StandIn()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    assert study.log(spec, folder, to="wandb", project="lakes", offline=True) == 3
    assert study.log(spec, folder, to="wandb", project="lakes", offline=True) == 0
    first = wandb.runs[0]
    assert all(run.finished for run in wandb.runs) and len(wandb.runs) == 3
    said = {name: first.options[name] for name in ("project", "id", "mode", "dir", "group")}
    group = "frozen_lake_4x4/plain/tabular_Q_learning"
    assert said == {"project": "lakes", "id": spec.runs[0].id, "mode": "offline", "dir": str(folder), "group": group}
    assert first.options["config"]["environment"] == "frozen_lake" and first.options["config"]["seed"] == 0
    curve = study.curves(spec, folder).query("seed == 0 and chance == 'plain'")
    assert [step for step, _ in first.points] == curve["step"].tolist()
    assert [values["pharos/value"] for _, values in first.points] == pytest.approx(curve["value"].tolist())
    assert first.summary["final_regret"] == pytest.approx(curve["expected_regret"].iloc[-1])


def test_online_the_mode_is_left_to_the_package(opened, monkeypatch):
    spec, folder = opened
    monkeypatch.setitem(sys.modules, "wandb", wandb := StandIn())
    study.log(spec, folder, to="wandb")
    assert (wandb.runs[0].options["mode"], wandb.runs[0].options["project"]) == (None, "logged")


def test_runs_that_differ_in_more_than_their_names_are_told_apart(tmp_path):
    from pharos.study.logs import named_runs

    blocks = [SPECIFICATION["blocks"][0] | {"steps": steps} for steps in (40, 80)]
    names = [name for _, name in named_runs(study.specification(SPECIFICATION | {"blocks": blocks}))]
    assert len(set(names)) == len(names) == 8


def test_mistakes_in_where_to_log_are_one_line(opened, monkeypatch):
    spec, folder = opened
    with pytest.raises(UnknownName, match="'tensorbord'; did you mean 'tensorboard'"):
        study.log(spec, folder, to="tensorbord")
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingExtra, match=r"pip install 'pharos-rl\[wandb\]'"):
        study.log(spec, folder, to="wandb")
    done = command_line.run("study", "log", "quick", "--to", "tensorboard", "--offline")
    assert done.exit_code == 2 and "expected them with --to wandb" in done.stderr
