"""pharos train: answers, files, and what bad input gets."""

import json

import pytest

import command_line
from pharos.training import read_record


def run(*words):
    return command_line.run("train", *words)


@pytest.mark.slow
def test_train_answers_in_json_and_writes_a_plot(tmp_path):
    out = tmp_path / "run"
    words = ("--steps", 3000, "--out", out, "--set", "initial_q=2.0", "--sticky", 0.1)
    answer = command_line.answer("train", "simple_grid", "height=3", *words)
    assert answer["config"]["agent"] == "q_learning"
    assert answer["config"]["hyperparameters"] == {"initial_q": 2.0}
    assert answer["value_optimal"] >= answer["final_value"]
    assert answer["conventions"]["gamma"] == 1.0
    assert (out / "regret.png").stat().st_size > 5000
    assert read_record(out)["status"] == "finished"


def test_train_prints_a_table_for_people():
    done = run("frozen_lake/4x4", "--steps", 2000, "--no-horizon")
    assert done.exit_code == 0
    assert "final regret" in done.stdout
    assert "q_learning on frozen_lake/4x4" in done.stdout


@pytest.mark.long
def test_wrong_words_are_usage_errors(tmp_path):
    for words in (("--agent", "dqm"), ("--set", "learning_rate"), ("--steps", 0)):
        assert run("simple_grid", *words).exit_code == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--no-horizon", "--horizon", 5), "--no-horizon and --horizon 5 contradict each other"),
        (("--option", "hide=column"), "q_learning sees index whatever is asked for; leave out hide"),
        (("--observation", "one_hot"), "q_learning sees index whatever is asked for; leave out observation one_hot"),
        (("--device", "cuda"), "--device cuda goes with --seeds"),
        (("--set", "initial_q=abc"), "initial_q is 'abc'; expected a finite number"),
        (("--set", "sees_previous_action=no"), "sees_previous_action is 'no'; expected true or false"),
        (("--set", "sees_previous_action=true"), "is for sticky actions, and there are none"),
    ],
)
def test_what_would_be_left_out_is_refused(words, said):
    done = run("simple_grid", "--steps", 100, *words)
    assert done.exit_code == 2 and said in done.output


def test_many_seeds_leave_a_folder_each_and_one_table(tmp_path):
    words = ("simple_grid/4x4-plain", "--steps", 2000, "--interval", 1000, "--out", tmp_path)
    done = run(*words, "--seeds", "0:2,7", "--engine", "batched")
    assert done.exit_code == 0, done.output
    assert "q_learning on simple_grid/4x4-plain, 3 seeds" in done.stdout and "final regret" in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["seed-0", "seed-1", "seed-7"]
    answer = json.loads(run(*words, "--seeds", "0,7", "--json").stdout)
    assert [each["seed"] for each in answer["runs"]] == [0, 7] and answer["failed"] == {}
    low, middle, high = answer["quartiles"]["final_regret"]
    assert low <= middle <= high


def test_wrong_seeds_and_engines_are_usage_errors():
    for words in (("--seeds", "0:0"), ("--seeds", "1,1"), ("--seeds", "a"), ("--seeds", "0:2", "--seed", 3)):
        assert run("simple_grid", *words).exit_code == 2
    refused = run("simple_grid", "--agent", "a2c", "--engine", "batched")
    assert refused.exit_code == 2 and "sb3" in refused.output
