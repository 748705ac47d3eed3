"""Environments, observations and agents of one's own, as a user has them: files in a folder, fresh processes."""

import json
import os
import shutil
import subprocess
import sys

import gymnasium
import pytest

import fake_training
import pharos
from command_line import answer, process, run, usage_error
from patience import PATIENCE
from pharos import study
from pharos.agents import check_hyperparameters
from pharos.environments import catalog
from pharos.errors import AllRunsFailed, FileFormatError, ParameterError, UntrustedCode
from pharos.observations import observation
from pharos.study import tables
from pharos.system import sources
from pharos.system.sources import Source
from pharos.training import RunConfig, load_agent, read_record, run_id, train
from refusals import refusal
from worlds import Corridor, Row, code_of

TAXI = """
from dataclasses import dataclass
from pharos.environments import SimpleGrid

@dataclass(frozen=True, kw_only=True)
class Taxi(SimpleGrid):
    name = "cab"
"""
CORNER = """
import numpy as np
from gymnasium import spaces
from pharos.observations import register

def corner(env, states):
    return (states[:, :2] == 0).astype(np.float32)

register("corner", corner, spaces.Box(0, 1, (2,), np.float32))
pair = (corner, spaces.Box(0, 1, (2,), np.float32))
"""
LEARNER = """
from stable_baselines3 import A2C

class Learner(A2C):
    pass
"""
STUDY = """
name: own
steps: 60
evaluations: 2
seeds: 1
blocks:
  - environments: ["code/taxi_of_mine.py:Taxi"]
    agents: [q_learning]
  - environments: [{name: "taxi_module:Taxi", parameters: {height: 3}}]
    observations: ["corners:corner", "code/corners_file.py:pair"]
    agents: ["learner_module:Learner"]
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A folder with code, a study that names it, and where two workers have run that from yet another folder."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "code").mkdir()
    (folder / "elsewhere").mkdir()
    (folder / "code" / "taxi_of_mine.py").write_text(TAXI)
    (folder / "taxi_module.py").write_text(TAXI.replace('"cab"', '"cab_of_module"'))
    (folder / "corners.py").write_text(CORNER)
    (folder / "code" / "corners_file.py").write_text(CORNER.replace("register(", "# register("))
    (folder / "learner_module.py").write_text(LEARNER)
    (folder / "own.yaml").write_text(STUDY)
    done = process("study", "run", "../own.yaml", "--out", "results", "--workers", 2, cwd=folder / "elsewhere")
    assert (done.returncode, done.stdout) == (0, "own: 3 of 3 runs finished\n"), done.stderr
    return folder


@pytest.fixture(autouse=True)
def nothing_is_left(monkeypatch):
    """What one test registers, no other test finds."""
    forget(monkeypatch)
    before = dict(gymnasium.registry)
    yield
    for name in set(gymnasium.registry) - set(before):
        del gymnasium.registry[name]


def forget(monkeypatch):
    """The process knows no code of anybody's own."""
    monkeypatch.setattr(catalog, "_REGISTERED", {})
    monkeypatch.setattr(sources, "_LOADED", {})
    monkeypatch.setattr(sources, "_MODULES", {})
    monkeypatch.setattr(observation, "_registered", {})


def runs_of(lab):
    records = [read_record(folder) for folder in (lab / "elsewhere" / "results" / "runs").iterdir()]
    return {record["config"]["observation"]: record for record in records}


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("corridor.py:Kinds", "flag=no"), "Kinds: flag='no'; expected true or false"),
        (("corridor.py:Kinds", "count=4.5"), "Kinds: count=4.5; expected an integer"),
        (("corridor.py:Kinds", "share=abc"), "Kinds: share='abc'; expected a number"),
        (("corridor.py",), "corridor.py is code; name a class in it, such as corridor.py:Kinds"),
    ],
)
def test_parameters_of_ones_own_class_are_of_the_kind_that_it_says(tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    fields = "    flag: bool = True\n    count: int = 4\n    share: float = 0.5\n    free: object = None\n"
    text = "from dataclasses import dataclass\nfrom pharos.environments import SimpleGrid\n\n"
    text += f'@dataclass(frozen=True, kw_only=True)\nclass Kinds(SimpleGrid):\n    name = "kinds"\n{fields}'
    (tmp_path / "corridor.py").write_text(text, encoding="utf-8")
    assert said in run("build", *words, "--out", tmp_path / "space").output
    assert (
        run("build", "corridor.py:Kinds", "flag=0", "free=no", "count=4.0", "--out", tmp_path / "space").exit_code == 0
    )


def test_a_study_keeps_where_its_code_comes_from(lab):
    records = runs_of(lab)
    assert set(records) == {"index", "corner", "pair"}
    found = {part: Source.from_dict(entry) for part, entry in records["pair"]["config"]["sources"].items()}
    assert {part: source.name for part, source in found.items()} == {
        "environment": "taxi_module:Taxi",
        "observation": "corners_file.py:pair",
        "agent": "learner_module:Learner",
    }
    assert found["observation"].file == str((lab / "code" / "corners_file.py").resolve())
    assert records["index"]["config"]["environment"] == "cab"


@pytest.mark.long
def test_a_shard_of_one_worker_finds_nothing_missing(lab):
    words = ("--out", lab / "elsewhere" / "results", "--shard", "1/2", "--workers", 1)
    done = process("study", "run", "own.yaml", *words, cwd=lab)
    assert (done.returncode, done.stdout) == (0, "own: 2 of 2 runs finished\n"), done.stderr


@pytest.mark.long
@pytest.mark.parametrize("observation", ["index", "pair"])
def test_what_was_learnt_on_ones_own_environment_is_evaluated(lab, observation):
    record = runs_of(lab)[observation]
    run = lab / "elsewhere" / "results" / "runs" / record["id"]
    target = ["code/taxi_of_mine.py:Taxi"] if observation == "index" else ["taxi_module:Taxi", "height=3", "--trust"]
    done = process("evaluate", *target, "--policy", run, "--horizon", record["config"]["horizon"], "--json", cwd=lab)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["value_at_start"] == pytest.approx(record["result"]["final_value"], abs=1e-6)


@pytest.mark.long
def test_what_was_learnt_is_drawn_where_it_is_trusted(lab):
    run = lab / "elsewhere" / "results" / "runs" / runs_of(lab)["corner"]["id"]
    refused = process("plot", "policies", run, "--out", "a.gif", cwd=lab)
    assert refused.returncode == 2 and "add --trust" in refused.stderr and not (lab / "a.gif").exists()
    done = process("plot", "policies", run, "--out", "a.gif", "--steps", 3, "--trust", cwd=lab)
    assert done.returncode == 0 and (lab / "a.gif").stat().st_size > 0, done.stderr


@pytest.mark.long
def test_a_run_can_be_read_in_python(lab, monkeypatch):
    monkeypatch.setattr(catalog, "_REGISTERED", {})
    record = runs_of(lab)["index"]
    run = lab / "elsewhere" / "results" / "runs" / record["id"]
    task, agent = load_agent(run, trust=True)
    assert (task.env.name, len(agent)) == ("cab", task.space.num_states)
    again, _ = load_agent(run)  # it was imported, so it needs no trust
    assert again.env == task.env


@pytest.mark.slow
def test_changed_code_is_told(lab, tmp_path):
    copy = tmp_path / "lab"
    shutil.copytree(lab, copy)
    results = copy / "elsewhere" / "results"
    (copy / "code" / "taxi_of_mine.py").write_text(TAXI + "\n# changed\n")
    (copy / "own.yaml").write_text(STUDY[: STUDY.index("  - environments: [{")])
    with pytest.warns(UserWarning, match=r"taxi_of_mine.py has changed since 1 runs in .* were trained with it"):
        assert study.status(copy / "own.yaml", results).finished == 1
    run = results / "runs" / runs_of(lab)["index"]["id"]
    with pytest.warns(UserWarning, match=r"taxi_of_mine.py has changed since taxi_of_mine.py:Taxi was written down"):
        load_agent(run)  # the changed file is imported already


def test_a_file_that_changes_between_the_study_and_its_worker_fails_the_run(tmp_path):
    (tmp_path / "shifting.py").write_text(TAXI)
    config = config_of(tmp_path / "shifting.py")
    (tmp_path / "shifting.py").write_text(TAXI.replace('"cab"', '"cab" ""'))
    sources._LOADED.clear()
    with pytest.raises(ParameterError, match=r"shifting\.py has changed since"):
        RunConfig.from_dict(config).task(trust=True, strict=True)


def config_of(file, **options):
    """The configuration of a run on the class in a file."""
    task = pharos.training.Task.of(f"{file}:Taxi", observation="index")
    return json.loads(json.dumps(RunConfig.of_task(task, "q_learning", steps=10, **options).to_dict()))


def test_the_id_of_a_run_depends_on_the_name_of_its_code_not_on_where_it_is(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "placed.py").write_text(TAXI)
    one, other = (config_of(tmp_path / name / "placed.py") for name in ("a", "b"))
    assert one != other and run_id(one) == run_id(other)
    renamed = {"environment": {**one["sources"]["environment"], "name": "c.py:Taxi"}}
    assert run_id(one) != run_id({**one, "sources": renamed})
    assert run_id(one) == RunConfig.from_dict(one).id


def test_a_changed_file_is_another_run_for_its_folder(tmp_path):
    file = tmp_path / "edited.py"
    file.write_text(TAXI)
    train("q_learning", f"{file}:Taxi", steps=20, out=tmp_path / "run")
    assert train("q_learning", f"{file}:Taxi", steps=20, out=tmp_path / "run").agent is None
    file.write_text(TAXI + "\n# changed\n")
    with pytest.raises(ParameterError, match=r"holds a run from before .*edited.py was changed"):
        train("q_learning", f"{file}:Taxi", steps=20, out=tmp_path / "run")


def test_hardness_of_changed_code_is_measured_anew(tmp_path):
    spec = fake_training.specification()
    file = tmp_path / "measured.py"
    file.write_text(TAXI)
    before, again = (tables._dependencies(spec, config_of(file)) for _ in range(2))
    file.write_text(TAXI + "\n# changed\n")
    assert before == again != tables._dependencies(spec, config_of(file))
    assert "code" not in tables._dependencies(spec, spec.runs[0].config)


@pytest.mark.parametrize("reference", ["corners:corner", "corners.py:corner", "corners.py:pair"])
def test_an_observation_of_ones_own_has_a_path(tmp_path, monkeypatch, reference):
    (tmp_path / "corners.py").write_text(CORNER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "corners", raising=False)
    env = pharos.make("frozen_lake/4x4")
    assert pharos.observe(env, reference)(pharos.build(env).states()[:1]).tolist() == [[1.0, 1.0]]
    result = train("q_learning", env, steps=10)
    assert "sources" not in result.config
    assert "unknown option" in refusal(ParameterError, pharos.observe, env, reference, grey=True)
    monkeypatch.delitem(sys.modules, "corners", raising=False)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nothing.py:corner", "there is no file"),
        ("no_such_module:corner", "No module named"),
        ("corners.py:edge", "expected the name of a pair"),
        ("corners.py:vector", "built-in observation"),
    ],
)
def test_a_path_that_leads_to_no_observation_is_refused_in_one_line(tmp_path, monkeypatch, name, message):
    (tmp_path / "corners.py").write_text(CORNER)
    monkeypatch.chdir(tmp_path)
    assert message in refusal(ParameterError, pharos.observe, pharos.make("frozen_lake/4x4"), name)


# Received files ------------------------------------------------------------------------------------------------------

CANARY = "from pathlib import Path\nPath(__file__).with_suffix('.executed').touch()\n"


@pytest.fixture(scope="module")
def sent(tmp_path_factory):
    """A folder with a finished run, a study's folder and a packed study; each names code that leaves a mark where it
    is executed. Beside it, as it was sent: `pristine`."""
    folder = tmp_path_factory.mktemp("sent") / "folder"
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        forget(patch)
        patch.chdir(folder)
        spec = folder / "sent.yaml"
        spec.write_text(
            'name: sent\nsteps: 20\nevaluations: 1\nseeds: 1\nblocks:\n  - {environments: ["canary.py:Taxi"], agents: [q_learning]}\n'  # noqa: E501
        )
        (folder / "canary.py").write_text(TAXI)
        study.run(spec, folder / "got", workers=1)
        study.pack(spec, folder / "got", file=folder / "got.parquet")
    for name in ("canary", "canary_module"):
        (folder / f"{name}.py").write_text(CANARY + TAXI)
    shutil.copytree(folder, folder.with_name("pristine"))
    return folder


@pytest.fixture
def received(sent, monkeypatch):
    """The run in the folder, which nobody has touched, and where the process is."""
    shutil.rmtree(sent)
    shutil.copytree(sent.with_name("pristine"), sent)
    monkeypatch.chdir(sent)
    yield next((sent / "got" / "runs").iterdir())
    assert "canary_module" not in sys.modules


def executed(folder):
    return sorted(path.name for path in folder.glob("*.executed"))


COMMANDS = [
    ("study", "show", "got"),
    ("study", "status", "got"),
    ("study", "report", "got"),
    ("study", "run", "got"),
    ("study", "pack", "got", "--to", "again.parquet"),
    ("study", "status", "got/study.yaml"),
    ("study", "run", "got/study.yaml"),
    ("study", "unpack", "got.parquet", "--out", "new"),
    ("evaluate", "frozen_lake/4x4", "--policy", "RUN"),
    ("plot", "value", "frozen_lake/4x4", "--policy", "RUN", "--out", "value.png"),
    ("plot", "policies", "RUN", "--out", "policies.gif"),
]


@pytest.mark.slow
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_received_files_execute_nothing(received, sent, words):
    said = usage_error(*(received if word == "RUN" else word for word in words))
    assert "executed only if you trust it: add --trust" in said
    assert executed(sent) == []


@pytest.mark.parametrize("verb", ["show", "status", "report", "run", "pack"])
@pytest.mark.parametrize("source", ["empty", "named"])
def test_a_folder_executes_nothing_though_it_has_no_runs(received, sent, verb, source):
    for folder in (sent / "empty", sent / "studies" / "named"):
        folder.mkdir(parents=True)
        (folder / "study.yaml").write_text((sent / "sent.yaml").read_text())
        (folder / "canary.py").write_text(CANARY + TAXI)
    said = usage_error("study", verb, source, *(("--to", "again.parquet") if verb == "pack" else ()))
    assert "executed only if you trust it: add --trust" in said
    assert not list(sent.rglob("*.executed"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*has changed since")
@pytest.mark.parametrize(
    "words", [("study", "status", "got"), ("plot", "policies", "RUN", "--steps", "2", "--out", "policies.gif")]
)
def test_what_is_trusted_is_executed(received, sent, words):
    done = run(*(received if word == "RUN" else word for word in words), "--trust")
    assert done.exit_code == 0, done.output
    assert executed(sent) == ["canary.executed"]


@pytest.mark.slow
def test_regret_is_drawn_without_any_code(received, sent):
    assert run("plot", "regret", received, "--out", "regret.png").exit_code == 0
    assert executed(sent) == []


@pytest.mark.parametrize(
    "change",
    [
        {"environment": "canary.py:Taxi", "sources": {}},
        {"environment": "canary_module:Taxi", "sources": {}},
        {"observation": "canary_module:Taxi", "sources": {}},
        {"agent": "canary_module:Taxi", "sources": {}},
        {"sources": {"environment": {"name": "canary_module:Taxi", "file": "canary_module.py", "checksum": ""}}},
        {"sources": {"observation": {"name": "canary.py:Taxi", "file": "canary.py", "checksum": ""}}},
        {"sources": {"agent": {"name": "canary.py:Taxi", "file": "canary.py", "checksum": ""}}},
    ],
)
def test_the_configuration_of_a_received_run_executes_nothing(received, sent, change):
    config = {**read_record(received)["config"], "environment": "frozen_lake", "parameters": {"size": 4}, **change}
    with pytest.raises(UntrustedCode, match="add --trust"):
        found = RunConfig.from_dict(config)
        found.task()
        found.algorithm()
    assert executed(sent) == []


@pytest.mark.parametrize("entry", [{"name": "canary.py:Taxi"}, 3, {"name": "canary", "file": "", "checksum": ""}, [1]])
def test_a_damaged_source_is_no_source(received, entry):
    config = {**read_record(received)["config"], "sources": {"environment": entry}}
    with pytest.raises(FileFormatError, match=r"source of a class|environment is .*; expected Source"):
        RunConfig.from_dict(config)


@pytest.mark.filterwarnings("ignore:.*has changed since")
def test_the_target_that_a_command_names_is_trusted(received, sent):
    done = run("evaluate", "canary.py:Taxi", "--policy", received, "--horizon", 5, "--json")
    assert done.exit_code == 0, done.output
    assert executed(sent) == ["canary.executed"]


def test_a_study_is_unpacked_into_ones_own_without_trust(received, sent):
    assert answer("study", "unpack", "got.parquet", "--into", "sent.yaml", "--out", "new")["added"] == 1


def test_algorithms_of_known_libraries_need_no_trust():
    setting = {"environment": "frozen_lake", "steps": 1, "horizon": 1, "evaluation_interval": 1}
    config = RunConfig(agent="stable_baselines3:SAC", **setting)
    assert config.algorithm() == "stable_baselines3:SAC"


@pytest.mark.parametrize(
    "agent",
    [
        "stable_baselines3.common.utils:os",
        "stable_baselines3.common.save_util:pickle",
        "stable_baselines3.common.utils:set_random_seed",
        "stable_baselines3.common.buffers:ReplayBuffer",
        "stable_baselines3:__loader__",
        "stable_baselines3:__path__",
    ],
)
def test_of_known_libraries_classes_of_algorithms_are_taken_and_nothing_else(agent):
    pytest.importorskip("stable_baselines3")
    said = refusal(ParameterError, check_hyperparameters, agent, {})
    assert "expected the class of an algorithm" in said and agent in said
    assert agent in usage_error("train", "frozen_lake/4x4", "--agent", agent, "--steps", 4)


SCRIPT = """
import pharos
from pharos import study

lakes = {
    "name": "lakes",
    "steps": 200,
    "evaluations": 2,
    "seeds": 2,
    "blocks": [{"environments": ["frozen_lake/4x4"], "agents": ["q_learning"]}],
}
done = study.run(lakes, "results", workers=2)
print(done.finished, len(study.table("results")))
options = {"steps": 40, "evaluation_interval": 40, "out": "many", "workers": 2}
runs = pharos.train_many("dqn", "frozen_lake/4x4", seeds=range(40), **options)
print(len(runs), {run.result["exact"] for run in runs})
"""


@pytest.mark.long
def test_a_script_needs_no_guard_for_workers(tmp_path):
    """Workers do not import the script again: what it prints, it prints once."""
    (tmp_path / "script.py").write_text(SCRIPT)
    line = [sys.executable, "script.py"]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, env=dict(os.environ))
    assert (done.returncode, done.stdout) == (0, "2 2\n40 {True}\n"), done.stderr
    assert "Traceback" not in done.stderr


def fails(config, folder):
    raise RuntimeError("no luck")


def test_where_all_runs_fail_it_is_raised(tmp_path):
    with pytest.raises(AllRunsFailed, match=r"all 5 runs failed; the first, .*no luck") as caught:
        study.run(fake_training.specification(steps=20), tmp_path / "results", workers=1, runner=fails)
    assert caught.value.outcome.failed == 5
    with pytest.raises(AllRunsFailed, match="seed 3"):
        pharos.train_many("dqn", "frozen_lake/4x4", seeds=[3], steps=10, hyperparameters={"net_arch": [-1]})


@pytest.mark.long
def test_a_packed_study_says_nothing_of_the_machine_and_is_unpacked_beside_its_code(lab, tmp_path):
    import pyarrow.parquet as pq

    words = ("own.yaml", "--out", "elsewhere/results", "--to", tmp_path / "own.parquet")
    assert process("study", "pack", *words, cwd=lab).returncode == 0
    table = pq.read_table(tmp_path / "own.parquet")
    told = str(table.schema.metadata) + str(table["record"].to_pylist())
    assert str(lab) not in told and str(lab.parent) not in told
    files = {json.loads(record)["config"]["sources"]["environment"]["file"] for record in table["record"].to_pylist()}
    assert files == {"code/taxi_of_mine.py", "taxi_module.py"}
    for name in ("code", "taxi_module.py", "corners.py", "learner_module.py"):
        (shutil.copytree if (lab / name).is_dir() else shutil.copy)(lab / name, tmp_path / name)
    done = process("study", "unpack", "own.parquet", "--out", "got", "--trust", "--json", cwd=tmp_path)
    assert (done.returncode, json.loads(done.stdout)["added"]) == (0, 3), done.stderr
    done = process("study", "status", "got", "--trust", "--json", cwd=tmp_path)
    assert json.loads(done.stdout)["finished"] == 3, done.stderr


WALK = f"""
{code_of(Row, Corridor)}
import pharos
from pharos import study

@dataclass(frozen=True, kw_only=True)
class Walk(Corridor):
    name = "walk_of_a_script"
    max_episode_steps = 20

pharos.register(Walk)
block = {{"environments": ["walk_of_a_script"], "agents": ["q_learning"]}}
whole = {{"name": "own", "steps": 200, "evaluations": 2, "seeds": 2, "blocks": [block]}}
if GUARD:
    try:
        print(study.run(whole, "out").finished)
    except pharos.errors.ParameterError as error:
        print(error)
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("guard", "said"), [('__name__ == "__main__"', "2\n"), ("True", "workers import this script, since it defines")]
)
def test_a_script_that_defines_a_class_needs_a_guard_and_says_so(guard, said, tmp_path):
    (tmp_path / "script.py").write_text(WALK.replace("GUARD", guard))
    line = [sys.executable, "script.py"]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, env=dict(os.environ))
    assert done.returncode == 0 and done.stdout.startswith(said) and "Traceback" not in done.stderr, done.stderr
    assert done.stdout.count("\n") == 1


ONCE = """
from dataclasses import dataclass
from pharos import Environment

@dataclass(frozen=True, kw_only=True)
class Once(Environment):
    name, actions, version, max_episode_steps = "once", ("left", "right"), 1, 10
    def variables(self): return {"over": range(2)}
    def initial_state(self): return (0,)
    def transition(self, state, action, out): out[0] = 1
    def is_terminal(self, state): return state[0] == 1
    def reward(self, state, action, next_state): return 1.0
"""


@pytest.mark.long
def test_count_and_show_tell_where_no_policy_beats_uniform_play(tmp_path, monkeypatch):
    """All actions of the one state end the episode and pay the same."""
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("COLUMNS", "160")
    for code, is_noted in ((ONCE.replace("return 1.0", "return float(action)"), False), (ONCE, True)):
        (tmp_path / "mine.py").write_text(code)
        said = process("count", "mine.py:Once", cwd=tmp_path).stdout
        assert said.startswith("mine.py:Once: 2 states") and (", no policy beats uniform play" in said) == is_noted
        assert is_noted or "uniform play" not in said
    block = {"environments": ["mine.py:Once", "cliff_walking/4x12-slippery"], "agents": ["q_learning"]}
    spec = {"name": "own", "steps": 100, "seeds": 1, "blocks": [{**block, "chance": ["plain", {"random": 0.1}]}]}
    (tmp_path / "own.yaml").write_text(json.dumps(spec))
    before = process("study", "show", "own.yaml", cwd=tmp_path).stdout
    assert (
        "plain (and of the world), random 0.1 (and of the world)  q_learning" in before
        and "plain, random 0.1 " in before
    )
    assert "no scale" not in before  # nothing is solved in order to show a grid
    assert process("study", "run", "own.yaml", "--workers", 1, cwd=tmp_path).returncode == 0
    after = process("study", "show", "own.yaml", cwd=tmp_path).stdout.splitlines()
    assert [line for line in after if "no scale" in line] == [
        f"mine.py:Once, chance {chance}: V* is that of uniform play, so regret has no scale"
        for chance in ("plain", "random 0.1")
    ]


@pytest.mark.long
def test_a_class_that_is_no_dataclass_is_a_line(tmp_path):
    (tmp_path / "mine.py").write_text(ONCE.replace("@dataclass(frozen=True, kw_only=True)\n", ""))
    done = process("count", "mine.py:Once", cwd=tmp_path)
    said = "pharos: Once is no dataclass; expected @dataclass(frozen=True, kw_only=True) above it\n"
    assert (done.returncode, done.stderr) == (2, said)
