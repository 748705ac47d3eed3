"""Searching hyperparameters: what a score is, what is written, that a search goes on, and what bad input gets."""

import json
import signal
import subprocess
import sys

import optuna
import pytest
import yaml
from optuna.storages.journal import JournalFileBackend

from command_line import run
from patience import PATIENCE, wait_for
from pharos.agents import agents, hyperparameters
from pharos.errors import FileFormatError, ParameterError
from pharos.training import read_record, run_id, train, tune

LAKE = "frozen_lake/4x4"
ONE = {"learning_rate": ("log", 0.001, 1.0)}


def search(trials, out=None, **options):
    return tune("q_learning", LAKE, steps=2000, trials=trials, seeds=[7, 8], out=out, **options)


def test_the_score_is_the_mean_normalized_regret_of_runs_that_anyone_can_repeat():
    result = search(1)
    assert result.score == result.first_score == pytest.approx(mean_regret([{}]))
    assert result.hyperparameters == hyperparameters("q_learning", "frozen_lake", "index")


def mean_regret(chances):
    """The mean normalised regret of the same runs, one by one."""
    options = {"steps": 2000, "evaluation_interval": 100}
    runs = [train("q_learning", LAKE, seed=seed, **options, **chance) for chance in chances for seed in (7, 8)]
    rows = [row["normalized_regret"] for run in runs for row in run.curve[1:]]
    return sum(rows) / len(rows)


@pytest.mark.long
def test_several_kinds_of_chance_count_alike():
    chances = [{}, {"random": 0.1}, {"sticky": 0.25, "random": 0.1}]
    assert search(1, chances=chances).score == pytest.approx(mean_regret(chances))


@pytest.mark.long
def test_the_best_is_never_worse_than_what_the_table_said():
    result = search(8, space=ONE)
    scores = [trial["score"] for trial in result.trials if trial["status"] == "finished"]
    assert result.score == min(scores) <= result.first_score
    assert 0.001 <= result.hyperparameters["learning_rate"] <= 1.0
    assert search(8, space=ONE).hyperparameters == result.hyperparameters  # the same search seed
    assert search(8, space=ONE, search_seed=5).trials[1] != result.trials[1]


@pytest.mark.long
def test_a_search_goes_on_and_writes_what_train_reads(tmp_path):
    search(2, tmp_path / "found")
    result = search(4, tmp_path / "found")
    assert len(result.trials) == 4
    record = json.loads((tmp_path / "found" / "tuning.json").read_text())
    assert record["best"]["hyperparameters"] == result.hyperparameters
    assert [trial["number"] for trial in record["trials"]] == [0, 1, 2, 3]
    table = tmp_path / "found" / "hyperparameters.yaml"
    assert yaml.safe_load(table.read_text()) == {"q_learning": {"frozen_lake": {"index": result.hyperparameters}}}
    run = train("q_learning", LAKE, steps=100, hyperparameters=table)
    assert run.config["hyperparameters"] == result.hyperparameters
    with pytest.raises(ParameterError, match="holds a search with another steps"):
        tune("q_learning", LAKE, steps=3000, trials=4, seeds=[7, 8], out=tmp_path / "found")


@pytest.mark.long
def test_of_a_shortlist_what_is_predicted_best_is_tried(tmp_path):
    asked = []

    def predicted(proposal):
        asked.append(proposal["learning_rate"])
        return abs(proposal["learning_rate"] - 0.1)

    whole = search(4, tmp_path / "whole", space=ONE, shortlist=5, predicted=predicted)
    assert len(asked) == 3 * 5 and len(set(asked)) == 15  # the first trial is the table's
    tried = [trial["hyperparameters"]["learning_rate"] for trial in whole.trials[1:]]
    assert tried == [min(asked[5 * k : 5 * k + 5], key=lambda rate: abs(rate - 0.1)) for k in range(3)]
    search(2, tmp_path / "parts", space=ONE, shortlist=5, predicted=predicted)
    assert told(search(4, tmp_path / "parts", space=ONE, shortlist=5, predicted=predicted)) == told(whole)
    with pytest.raises(ParameterError, match="holds a search with another shortlist"):
        search(4, tmp_path / "whole", space=ONE)
    with pytest.raises(ParameterError, match="shortlist is 5; expected at least 1, and `predicted`"):
        search(4, space=ONE, shortlist=5)


@pytest.mark.long
def test_the_command_shortlists_by_prediction():
    words = ("tune", "simple_grid/4x4-plain", "--agent", "ppo", "--engine", "batched", "--steps", "2048", "--trials=2")
    space = ("--search", "gamma=0.5,0.9,0.99", "--seeds", "3", "--shortlist-by-prediction", "2", "--json")
    done = run(*words, *space)
    assert done.exit_code == 0, done.output
    assert len(json.loads(done.stdout)["trials"]) == 2
    done = run(*words[:3], "q_learning", *words[4:], *space[2:])
    assert done.exit_code == 2 and "no published runs to calibrate on" in done.output


def test_algorithms_of_stable_baselines3_are_searched_too():
    few = {"learning_rate": ("log", 1e-4, 1e-3), "batch_size": ("one of", 16, 32)}
    result = tune("dqn", "simple_grid/4x4-plain", steps=200, trials=2, seeds=[3], space=few)
    assert result.trials[1]["hyperparameters"]["batch_size"] in (16, 32)


def test_the_first_trial_takes_from_the_agent_what_the_table_leaves_out():
    few = {"stats_window_size": ("one of", 50, 100), "tau": ("linear", 0.1, 1.0), "learning_rate": ("log", 1e-4, 1e-2)}
    result = tune("dqn", "simple_grid/4x4-plain", steps=100, trials=1, seeds=[3], space=few)
    table = hyperparameters("dqn", "simple_grid", "vector")
    of_the_agent = {"stats_window_size": 100, "tau": 1.0}
    assert not of_the_agent.keys() & table.keys()
    assert result.trials[0]["hyperparameters"] == {**of_the_agent, "learning_rate": table["learning_rate"]}
    few = {"exploration_schedule": ("one of", "exponential", "linear")}
    result = tune("q_learning", LAKE, steps=100, trials=1, seeds=[3], space=few)
    assert result.trials[0]["hyperparameters"] == {"exploration_schedule": "linear"}


@pytest.mark.parametrize("agent", agents())
def test_every_space_holds_hyperparameters_that_the_agent_has(agent):
    from pharos.agents.q_learning import Q_LEARNING_DEFAULTS
    from pharos.agents.sb3 import algorithm

    if agent == "q_learning":
        assert set(agents()[agent].space) <= set(Q_LEARNING_DEFAULTS)
    else:
        assert set(agents()[agent].space) <= set(algorithm(agent).__init__.__annotations__)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"agent": "stable_baselines3:TD3"}, "has no space to search"),
        ({"environments": ["simple_grid/4x4-plain", LAKE]}, "of the classes frozen_lake, simple_grid"),
        ({"space": {"gamma": ("linear", 1.0, 0.5)}}, "gamma is .* expected"),
        ({"space": {"learning_rate": ("log", 0.0, 0.5)}}, "learning_rate is .* expected"),
        ({"seeds": []}, "0 seeds"),
        ({"trials": 0}, "0 trials"),
        ({"chances": []}, "expected one or the other"),
        ({"chances": [{}], "random": 0.1}, "expected one or the other"),
        ({"chances": [{"stiky": 0.1}]}, "unknown kind of chance 'stiky'; did you mean 'sticky'"),
    ],
)
def test_a_search_that_cannot_be_done_is_refused(change, message):
    options = {"agent": "q_learning", "environments": LAKE, "steps": 100, "trials": 1, **change}
    with pytest.raises(ParameterError, match=message):
        tune(options.pop("agent"), options.pop("environments"), **options)


@pytest.mark.long
def test_the_command_answers_in_json_and_train_takes_its_file(tmp_path):
    options = ("--agent", "q_learning", "--steps", 1000, "--trials", 2, "--seeds", 4)
    options += ("--search", "learning_rate=0.5,0.7")
    done = run("tune", LAKE, "frozen_lake/8x8", *options, "--out", tmp_path / "t", "--json")
    answer = json.loads(done.stdout)
    assert answer["hyperparameters"]["learning_rate"] in (0.5, 0.7)
    table = ("--hyperparameters", tmp_path / "t" / "hyperparameters.yaml", "--set", "gamma=0.9")
    assert run("train", LAKE, "--steps", 100, "--out", tmp_path / "r", *table).exit_code == 0
    used = read_record(tmp_path / "r")["hyperparameters"]
    assert used == {**answer["hyperparameters"], "gamma": 0.9}


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("q_learning: {default: {learning_rate: 0.3}}", {"learning_rate": 0.3}),
        (
            "q_learning: {default: {default: {learning_rate: 0.3}, index: {gamma: 0.9}}}",
            {"learning_rate": 0.3, "gamma": 0.9},
        ),
        (
            "q_learning: {default: {gamma: 0.8}, frozen_lake: {index: {gamma: 0.9}, other: {gamma: 0.7}}}",
            {"gamma": 0.9},
        ),
        ("dqn: {default: {policy_kwargs: {net_arch: [8]}}}", {"policy_kwargs": {"net_arch": [8]}}),
        ("q_lerning: {default: {gamma: 0.9}}", None),
        ("q_learning: {frozen_lakee: {default: {gamma: 0.9}}}", None),
    ],
)
def test_a_table_is_by_agent_class_and_observation_or_refused(tmp_path, table, expected):
    file = tmp_path / "t.yaml"
    file.write_text(table, encoding="utf-8")
    agent = table.partition(":")[0].replace("lern", "learn")
    if expected is None:
        with pytest.raises(ParameterError, match="says nothing of q_learning in frozen_lake"):
            hyperparameters(agent, "frozen_lake", "index", table=file)
    else:
        assert hyperparameters(agent, "frozen_lake", "index", table=file) == expected


def test_the_command_prints_a_table_and_refuses_wrong_words():
    options = ("--agent", "q_learning", "--steps", 500)
    assert "mean normalised regret" in run("tune", LAKE, *options, "--trials", 1).stdout
    assert run("tune", LAKE, *options, "--seeds", "one").exit_code == 2
    assert run("tune", LAKE, *options, "--search", "gamma").exit_code == 2
    assert run("tune", LAKE, *options, "--chance", "often").exit_code == 2


def test_the_command_takes_several_kinds_of_chance(tmp_path):
    options = ("--agent", "q_learning", "--steps", 500, "--trials", 1, "--seeds", 4, "--out", tmp_path / "t")
    chances = ("--chance", "plain", "--chance", "sticky=0.25,random=0.1")
    assert run("tune", LAKE, *options, *chances).exit_code == 0
    kept = json.loads((tmp_path / "t" / "tuning.json").read_text())["config"]["chance"]
    assert kept == [{"sticky": 0.0, "random": 0.0}, {"sticky": 0.25, "random": 0.1}]


TOLD = ("number", "hyperparameters", "score", "status")


def told(result):
    return [[trial[name] for name in TOLD] for trial in result.trials]


@pytest.mark.long
def test_a_search_that_was_killed_goes_on_as_it_would_have(tmp_path):
    options = {"steps": 200, "seeds": [0], "search_seed": 5}
    once = tune("q_learning", LAKE, trials=20, out=tmp_path / "once", **options)

    def stop(done, *_):
        if done == 9:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune("q_learning", LAKE, trials=20, out=tmp_path / "twice", progress=stop, **options)
    twice = tune("q_learning", LAKE, trials=20, out=tmp_path / "twice", **options)
    assert told(twice) == told(once)
    assert {trial["status"] for trial in once.trials} == {"finished", "given up"}
    assert len({str(trial["hyperparameters"]) for trial in once.trials}) == 20


@pytest.fixture
def journal(tmp_path):
    """Folder of a search of an earlier pharos, killed in its fourth trial and in the middle of a line of its journal;
    trials that it had done."""
    result = tune("q_learning", LAKE, steps=200, trials=3, seeds=[0], out=tmp_path / "now")
    record = json.loads((tmp_path / "now" / "tuning.json").read_text())
    for trial in [record, *record["trials"]]:
        trial.pop("reports", None), trial.pop("digest", None)
    old = tmp_path / "old"
    old.mkdir()
    (old / "tuning.json").write_text(json.dumps(record))
    storage = optuna.storages.JournalStorage(JournalFileBackend(str(old / "journal.log")))
    study = optuna.create_study(study_name=run_id(record["config"]), storage=storage)
    space = {
        "one of": lambda values: optuna.distributions.CategoricalDistribution(values),
        "linear": lambda values: optuna.distributions.FloatDistribution(*values),
        "log": lambda values: optuna.distributions.FloatDistribution(*values, log=True),
    }
    distributions = {name: space[kind](values) for name, (kind, *values) in record["config"]["space"].items()}
    for trial in result.trials:
        reports = {int(step): mean for step, mean in trial["reports"].items()}
        stated = {"params": trial["hyperparameters"], "distributions": distributions, "intermediate_values": reports}
        study.add_trial(optuna.trial.create_trial(value=trial["score"], **stated))
    study.ask()
    with open(old / "journal.log", "ab") as file:
        file.write(b'{"op_code": 5')
    return old, result


@pytest.mark.long
def test_a_journal_of_an_earlier_pharos_is_read_on(journal):
    folder, result = journal
    again = tune("q_learning", LAKE, steps=200, trials=3, seeds=[0], out=folder)
    assert told(again) == told(result)
    assert [trial["reports"] for trial in again.trials] == [trial["reports"] for trial in result.trials]
    assert not (folder / "journal.log").exists()
    more = tune("q_learning", LAKE, steps=200, trials=5, seeds=[0], out=folder)
    assert told(more) == told(tune("q_learning", LAKE, steps=200, trials=5, seeds=[0]))


@pytest.mark.parametrize("name", ["journal.log", "tuning.json"])
def test_damaged_files_of_a_search_are_one_line(journal, name):
    file = journal[0] / name
    file.write_bytes(file.read_bytes()[:1] + b"?" + file.read_bytes()[1:])
    with pytest.raises(FileFormatError, match=rf"{name}: is no.*delete the folder and search again"):
        tune("q_learning", LAKE, steps=200, trials=4, seeds=[0], out=journal[0])


def test_a_record_that_was_changed_is_one_line(tmp_path):
    tune("q_learning", LAKE, steps=200, trials=2, seeds=[0], out=tmp_path)
    file = tmp_path / "tuning.json"
    file.write_text(file.read_text().replace('"score": 0.', '"score": 0.1'))
    with pytest.raises(FileFormatError, match=r"tuning\.json: was changed after it was written; delete the folder"):
        tune("q_learning", LAKE, steps=200, trials=3, seeds=[0], out=tmp_path)


@pytest.mark.long
def test_an_interrupted_search_says_one_line(tmp_path):
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); from pharos.cli import main; "
    code += f"sys.argv = 'pharos tune {LAKE} --agent q_learning --steps 200000 --trials 99 --out out'.split(); main()"
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    wait_for((tmp_path / "out" / "lock").exists, process)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130 and errors.startswith("pharos: interrupted") and errors.count("\n") == 1, errors
