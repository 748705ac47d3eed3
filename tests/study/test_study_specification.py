"""A specification: what it expands to, and what it says of mistakes."""

import json
import re
import subprocess
import sys
import time

import pytest
import xxhash

from pharos import study
from pharos.environments import FrozenLake, catalog
from pharos.errors import ParameterError, UnknownName, UntrustedCode
from pharos.study import Specification, presets, run_id, specification
from pharos.study.specification import parse
from pharos.system import sources
from refusals import refusal

LAKES = """\
name: lakes
steps: 1000
evaluations: 10
seeds: 2
hyperparameters:
  patient: {learning_rate: 1e-4}
blocks:
  - environments: [frozen_lake/4x4, {name: frozen_lake, parameters: {size: 6, seed: 1}}]
    chance: [plain, {sticky: 0.25}, {random: 0.1}]
    observations: [vector, {name: simple_image, options: {grey: true}}]
    agents: [dqn, ppo, q_learning]
    hyperparameters: {dqn: patient, ppo: {n_steps: 256}}
"""


def test_a_block_is_the_product_of_its_lists_and_tabular_agents_run_once_whatever_the_observations():
    runs = parse(LAKES).runs
    deep = [run for run in runs if run.config["agent"] != "q_learning"]
    tabular = [run for run in runs if run.config["agent"] == "q_learning"]
    assert len(deep) == 2 * 3 * 2 * 2 * 2
    assert len(tabular) == 2 * 3 * 2
    assert {run.config["observation"] for run in tabular} == {"index"}
    assert len({run.id for run in runs}) == len(runs)
    assert {run.chance for run in runs} == {"plain", "sticky 0.25", "random 0.1"}
    assert {run.instance for run in runs} == {"frozen_lake/4x4", "frozen_lake(size=6, seed=1)"}


def test_hyperparameters_come_by_reference_or_in_place_and_scientific_notation_is_a_number():
    by_agent = {run.config["agent"]: run.config["hyperparameters"] for run in parse(LAKES).runs}
    assert by_agent["dqn"]["learning_rate"] == 0.0001
    assert by_agent["ppo"]["n_steps"] == 256


def test_a_config_holds_every_hyperparameter_so_that_other_defaults_are_other_runs():
    from pharos.agents.registry import hyperparameters

    for run in parse(LAKES).runs:
        usual = hyperparameters(run.config["agent"], run.config["environment"], run.config["observation"])
        assert usual.keys() <= run.config["hyperparameters"].keys()
        if run.config["agent"] == "q_learning":
            assert run.config["hyperparameters"] == usual


def test_the_id_of_a_run_is_the_xxh3_hash_of_its_sorted_json():
    run = parse(LAKES).runs[0]
    text = json.dumps(run.config, sort_keys=True, separators=(",", ":"))
    assert run.id == xxhash.xxh3_64(text.encode()).hexdigest()
    assert run_id(dict(reversed(run.config.items()))) == run.id


@pytest.mark.long
def test_ids_are_the_same_in_another_process_with_another_hash_seed():
    code = "from pharos.study import specification; print(*[run.id for run in specification('quick').runs])"
    options = {"env": {"PYTHONHASHSEED": "7"}, "capture_output": True, "text": True, "check": True}
    found = subprocess.run([sys.executable, "-c", code], **options)
    assert found.stdout.split() == [run.id for run in specification("quick").runs]


def test_the_same_run_in_two_blocks_or_under_two_names_is_one_run():
    twice = parse(
        "name: twice\nseeds: [3]\nblocks:\n"
        "  - {environments: [frozen_lake/4x4], agents: [dqn]}\n"
        "  - {environments: [{name: frozen_lake, parameters: {size: 4}}], agents: [dqn, ppo]}\n"
    )
    assert [run.config["agent"] for run in twice.runs] == ["dqn", "ppo"]


def test_a_block_may_say_otherwise_than_the_whole():
    study = parse(
        "name: a\nsteps: 100\ngamma: 0.9\nblocks:\n"
        "  - "
        "{environments: [frozen_lake], agents: [dqn], seeds: [7, 9], steps: 60, evaluations: 3, gamma: 1, horizon: 5}\n"
        "  - {environments: [frozen_lake], agents: [dqn], seeds: 1}\n"
    )
    first, second, third = (run.config for run in study.runs)
    assert (first["seed"], second["seed"], third["seed"]) == (7, 9, 0)
    assert (first["steps"], first["evaluation_interval"], first["gamma"], first["horizon"]) == (60, 20, 1, 5)
    assert (third["steps"], third["evaluation_interval"], third["gamma"], third["horizon"]) == (100, 1, 0.9, 100)


def test_defaults_of_a_study_go_before_those_of_the_library_and_below_those_of_a_block():
    block = {"environments": ["frozen_lake"], "agents": ["dqn", "ppo"], "hyperparameters": {"dqn": {"gamma": 0.5}}}
    defaults = {"dqn": {"frozen_lake": {"vector": {"gamma": 0.9, "n_steps": 3}}}}
    dqn, ppo = specification({"name": "a", "seeds": 1, "defaults": defaults, "blocks": [block]}).runs
    assert dqn.config["hyperparameters"] == {"gamma": 0.5, "n_steps": 3}
    assert ppo.config["hyperparameters"]["n_epochs"] == 4


@pytest.mark.parametrize(
    ("line", "wrong", "expected"),
    [
        (2, "stepz: 1000", "specification:2: unknown key 'stepz'; did you mean 'steps'?"),
        (2, "steps: many", "specification:2: steps: found 'many'; expected: a valid integer"),
        (2, "steps: true", "specification:2: found True; expected a number"),
        (3, "evaluations: true", "specification:3: found True; expected a number"),
        (3, "gamma: true", "specification:3: found True; expected a number"),
        (4, "seeds: [true]", "specification:4: found True; expected a number"),
        (3, "hardness: {budget: true}", "specification:3: found True; expected a number"),
        (4, "seeds: 0", "specification:4: seeds: found 0; expected how many, at least 1, or a list of seeds"),
        (8, "  - environments: [frozen_lake/5x5]", "unknown environment 'frozen_lake/5x5'; did you mean 'frozen_lake/"),
        (8, "  - environments: [{name: frozen_lake, parameters: {sise: 8}}]", "specification:8: unknown parameter of frozen_lake 'sise'; did you mean 'size'?"),  # noqa: E501
        (3, "gamma: 2", "specification:3: gamma: found 2; expected: less than or equal to 1"),
        (3, "horizon: 0", "specification:3: horizon: found 0; expected a number of steps, limit (the environment's), or none"),  # noqa: E501
        (3, "horizon: none", "specification:8: gamma is 1 and horizon is none, so values may be infinite"),
        (3, "hardness: {measures: [diametr]}", "unknown measure of hardness 'diametr'; did you mean 'diameter'?"),
        (9, "    chance: [plain, {stiky: 0.25}]", "specification:9: unknown kind of chance 'stiky'; did you mean"),
        (9, "    chance: [plian]", "specification:9: unknown chance 'plian'; did you mean 'plain'?"),
        (9, "    chance: [{random: 1.5}]", "specification:9: ChanceSetting: random=1.5; expected a finite number"),
        (10, "    observations: [vectr]", "specification:10: unknown observation 'vectr'; did you mean 'vector'?"),
        (10, "    observations: [{name: simple_image, options: {gray: true}}]", "specification:10: unknown option of observation 'simple_image' 'gray'; did you mean 'grey'?"),  # noqa: E501
        (11, "    agents: [dqn, ppo, qlearning]", "specification:11: unknown agent 'qlearning'; did you mean 'q_learning'?"),  # noqa: E501
        (11, "    agents: []", "specification:11: agents: found []"),
        (12, "    hyperparameters: {dqn: patent}", "specification:12: unknown set of hyperparameters 'patent'; did you mean 'patient'?"),  # noqa: E501
        (12, "    hyperparameters: {a2c: patient}", "specification:12: unknown agent of this block 'a2c'"),
        (12, "    hyperparameters: {dqn: {learnin_rate: 0.1}}", "specification:12: unknown hyperparameter of dqn 'learnin_rate'; did you mean 'learning_rate'?"),  # noqa: E501
        (12, "    hyperparameters: {dqn: {learning_rate: a}}", "specification:12: agent 'dqn': learning_rate is 'a'; expected a number above 0"),  # noqa: E501
        (12, "    agents: [dqn]", "specification:12: the key 'agents' stands there twice (line 11)"),
        (12, "    hyperparameters: [", "specification:13"),
        (2, "defaults: {dqm: {frozen_lake: {}}}", "specification:2: unknown agent 'dqm'; did you mean 'dqn'?"),
        (2, "defaults: {dqn: {frozen_lke: {}}}", "specification:2: unknown class of environments 'frozen_lke'; did you mean 'frozen_lake'?"),  # noqa: E501
        (2, "defaults: {dqn: {default: {}}}", "specification:2: unknown class of environments 'default'"),
        (2, "defaults: {dqn: {frozen_lake: {vectr: {}}}}", "specification:2: unknown observation 'vectr'; did you mean 'vector'?"),  # noqa: E501
        (2, "defaults: {dqn: {frozen_lake: {vector: {learnin_rate: 1}}}}", "specification:2: unknown hyperparameter of dqn 'learnin_rate'"),  # noqa: E501
        (2, "defaults: {dqn: {frozen_lake: {vector: {learning_rate: -1}}}}", "specification:2: agent 'dqn': learning_rate is -1"),  # noqa: E501
        (1, "blocks: 3\nname: a", "specification:8: the key 'blocks' stands there twice (line 1)"),
    ],
)  # fmt: skip
def test_a_mistake_is_told_with_its_line_and_the_nearest_name(line, wrong, expected):
    lines = LAKES.splitlines()
    lines[line - 1] = wrong
    assert expected in refusal(ParameterError, parse, "\n".join(lines) + "\n")


def test_a_wrong_agent_is_told_alone():
    said = refusal(ParameterError, parse, LAKES.replace("[dqn, ppo, q_learning]", "[dqm, ppo, q_learning]"))
    assert "unknown agent 'dqm'; did you mean 'dqn'?" in said and "of this block" not in said


@pytest.mark.parametrize("text", ["", "- a\n", "name: a\n", "blocks: []\nname: a\n", "a"])
def test_what_is_no_study_is_refused(text):
    assert "specification" in refusal(ParameterError, parse, text)


def test_a_mapping_is_read_as_well_and_a_missing_file_suggests_a_preset():
    study = specification({"name": "a", "blocks": [{"environments": ["frozen_lake"], "agents": ["dqn"]}]})
    assert isinstance(study, Specification) and len(study.runs) == 5
    with pytest.raises(ParameterError, match=r"specification\.blocks\.0\.agents\.0: unknown agent"):
        specification({"name": "a", "blocks": [{"environments": ["frozen_lake"], "agents": ["dqm"]}]})
    assert "did you mean 'quick'" in refusal(UnknownName, specification, "quik")


def test_the_presets_are_those_of_the_paper():
    assert presets() == ["classes", "hardness-dev", "hardness-sealed", "paper", "quick", "small"]
    assert len(specification("small").runs) == 8 * 3 * 5 * (2 * 2 + 1)
    paper = specification("paper").runs
    assert len(paper) == 28 * 3 * 5 * (2 * 2 + 1)
    assert {run.config["steps"] for run in paper if run.config["environment"] in ("freeway", "breakout")} == {600_000}
    assert {run.config["steps"] for run in paper if run.config["environment"] == "frozen_lake"} == {50_000}
    assert len({run.instance for run in paper}) == 28


def test_all_classes_in_an_afternoon_contain_the_small_study_and_every_instance_of_the_paper():
    classes, small, paper = (specification(name) for name in ("classes", "small", "paper"))
    assert {run.id for run in small.runs} < {run.id for run in classes.runs}
    assert {run.instance for run in classes.runs} == {run.instance for run in paper.runs}
    large = [run.config for run in classes.runs if run.config["environment"] in ("freeway", "breakout")]
    assert len(large) == 20 * (2 * 2 + 1) and {config["steps"] for config in large} == {100_000}


def test_the_predictors_of_the_models_are_the_papers_three_as_far_as_they_are_measured():
    def predictors(*measures):
        block = {"environments": ["frozen_lake"], "agents": ["dqn"]}
        return specification({"name": "a", "hardness": {"measures": measures}, "blocks": [block]}).hardness.predictors

    three = ["effective_horizon", "sum_of_reciprocal_gaps", "diameter"]
    assert specification("small").hardness.predictors == three
    assert predictors("environmental_value_norm", "diameter", "effective_horizon") == ["effective_horizon", "diameter"]
    assert predictors(*three, "stationary_effective_horizon") == three
    assert specification("paper").hardness.predictors == ["stationary_effective_horizon", *three[1:]]
    assert predictors("environmental_value_norm") == ["environmental_value_norm"]


LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)
HOSTILE = {
    b"name: a\n? [x, y] : 1\n": "study.yaml:2: a key is a list or a mapping; expected a word",
    b"name: a\n? {x: y}\n: 1\n": "study.yaml:2: a key is a list or a mapping; expected a word",
    b"name: \xff\xfe\n": "study.yaml: byte 6 is not UTF-8",
    b"name: a\nblocks: &a [*a]\n": "study.yaml:2: an alias stands within what it names",
    b"name: a\nblocks: " + b"[" * 5000 + b"]" * 5000 + b"\n": "study.yaml: is nested too deeply",
    LAUGHS.encode(): "entries, aliases written out",
    b"name: a\nseeds: 1000000000\nblocks: []\n": "study.yaml:2: seeds: found 1000000000; a study has at most 1,000,000 runs",  # noqa: E501
    b"name: a\nsteps: " + b"9" * 5000 + b"\n": "study.yaml: Exceeds the limit",
    b"name: 2001-99-99\n": "study.yaml: month must be in 1..12",
    b"name: a\n1: 2\nblocks: []\n": "study.yaml:",
    b"name: a\n\x00\n": "study.yaml: ",
}


@pytest.mark.slow
@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: repr(text[:20]))
def test_a_hostile_file_is_one_line_at_once(tmp_path, text):
    (tmp_path / "study.yaml").write_bytes(text)
    began = time.process_time()
    with pytest.raises(ParameterError) as caught:
        study.specification(tmp_path)
    assert time.process_time() - began < 5
    assert HOSTILE[text] in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_a_million_runs_of_a_product_are_refused_before_they_are_listed():
    block = {"environments": ["frozen_lake/4x4"] * 1000, "agents": ["q_learning"], "seeds": 2000}
    with pytest.raises(ParameterError, match="2,000,000 runs up to here; a study has at most 1,000,000"):
        study.specification({"name": "a", "blocks": [block]})


def test_environments_named_again_are_made_once_each_and_run_once(monkeypatch):
    """5,000 equal ones took half a minute."""
    usual, calls = FrozenLake.validate, []
    monkeypatch.setattr(FrozenLake, "validate", lambda self: calls.append(1) or usual(self))
    block = {"environments": ["frozen_lake/4x4"] * 300, "agents": ["q_learning"]}
    spec = specification({"name": "own", "steps": 100, "seeds": 2, "blocks": [block]})
    assert len(spec.runs) == 2 and len(calls) <= 300


def test_aliases_that_share_a_node_are_no_mistake():
    text = "name: a\nblocks:\n  - &b {environments: [frozen_lake/4x4], agents: &g [q_learning]}\n  - *b\n"
    assert len(parse(text).runs) == 5


def test_environments_of_a_file_take_the_place_of_those_that_are_given(tmp_path):
    """Imported MDPs among them: a folder beside the file, a class of its own, with the observations that it has."""
    import numpy as np

    from pharos import importers
    from pharos.mdp import TabularMDP

    mdp = TabularMDP.from_outcomes(np.array([[[1], [0]], [[1], [1]]]), np.ones((2, 2, 1)), np.array([[1.0, 0], [0, 0]]))
    importers.save(mdp, tmp_path / "tiny", observations=np.array([[0.0], [1.0]]))
    file = tmp_path / "sealed.yaml"
    file.write_text("- taxi/5x5\n- {name: tiny, observations: [recorded, hash]}\n")
    found = specification("hardness-sealed", environments=file)
    cells = [run.cell for run in found.runs]
    assert {cell["environment"] for cell in cells} == {"taxi", "tiny"}
    assert {cell["observation"] for cell in cells if cell["environment"] == "tiny"} == {"recorded", "hash"}
    assert {cell["agent"] for cell in cells} == {"dqn", "dqn 100k", "dqn tuned", "ppo", "ppo 100k", "ppo tuned"}
    assert len(found.runs) == (5 + 2) * 2 * 5 * (2 + 2 + 1)  # agents, seeds; chance, but for tuned ones
    again = specification(found.model_dump(mode="json", exclude_unset=True))
    assert [run.id for run in again.runs] == [run.id for run in found.runs]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("taxi/5x5", "expected a list of environments"),
        ("- [taxi]", "expected a list of environments"),
        ("- my.py:Maze", "is code"),
        ("- taxy/5x5", r"list.yaml: unknown environment 'taxy/5x5'; did you mean 'taxi/5x5'\?$"),
        ("- {name: taxi, sise: 3}", "unknown key 'sise'"),
        ("- {name: taxi", "expected ',' or '}'"),
    ],
)
def test_a_wrong_list_of_environments_is_a_line(tmp_path, text, message):
    file = tmp_path / "list.yaml"
    file.write_text(text)
    assert re.search(message, refusal(ParameterError, specification, "hardness-sealed", environments=file))


def test_classes_of_ones_own_in_a_list_need_trust_and_lie_beside_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(catalog, "_REGISTERED", {})
    monkeypatch.setattr(sources, "_LOADED", {})
    monkeypatch.setattr(sources, "_MODULES", {})
    (tmp_path / "sealed").mkdir()
    code = "from pharos.environments import SimpleGrid\nclass Yard(SimpleGrid):\n    name = 'yard'\n"
    (tmp_path / "sealed" / "yard_of_a_list.py").write_text(code)
    file = tmp_path / "sealed" / "list.yaml"
    file.write_text("- {name: 'yard_of_a_list.py:Yard', parameters: {height: 3, width: 3}}\n")
    assert "add --trust" in refusal(UntrustedCode, specification, "hardness-sealed", environments=file)
    found = specification("hardness-sealed", environments=file, trust=True)
    assert {run.cell["environment"] for run in found.runs} == {"yard"}
    again = specification(found.model_dump(mode="json", exclude_unset=True), trust=True)
    assert [run.id for run in again.runs] == [run.id for run in found.runs]


def test_environments_are_given_to_studies_that_ask_for_them_alone(tmp_path):
    assert "--environments FILE" in refusal(ParameterError, specification, "hardness-sealed")
    (tmp_path / "list.yaml").write_text("- taxi/5x5")
    with pytest.raises(ParameterError, match="has environments of its own"):
        specification("quick", environments=tmp_path / "list.yaml")
    with pytest.raises(ParameterError, match="cannot be read"):
        specification("hardness-sealed", environments=tmp_path / "nothing.yaml")


def test_observations_that_differ_in_an_option_are_cells_of_their_own():
    """Where one name would stand for two of them; else names are the usual ones, which published tables have."""
    codes = [{"name": "hash", "options": {"bits": bits}} for bits in (8, 64)]
    block = {"environments": ["frozen_lake/4x4"], "agents": ["dqn"], "observations": ["vector", *codes]}
    cells = [run.cell["observation"] for run in study.specification({"name": "a", "seeds": 1, "blocks": [block]}).runs]
    assert cells == ["vector", "hash(bits=8)", "hash(bits=64)"]
    block["observations"] = codes[:1]
    assert study.specification({"name": "a", "seeds": 1, "blocks": [block]}).runs[0].cell["observation"] == "hash"
