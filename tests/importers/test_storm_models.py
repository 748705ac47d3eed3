"""PRISM, JANI and DRN models through Storm: published numbers of states and values. Needs the extra `storm`."""

import importlib
import json
import os
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

import pharos
from command_line import run
from pharos import exporters, importers
from pharos.errors import FileFormatError, MissingExtra, ParameterError, UnknownName
from refusals import refusal

try:
    import stormpy.examples.files as models
except ImportError:
    models = None

storm = importlib.import_module("pharos.importers.models")
needs_storm = pytest.mark.skipif(models is None, reason="stormpy is not installed")


@pytest.mark.skipif(models is not None, reason="stormpy is installed")
def test_without_storm_the_extra_is_named(tmp_path):
    assert "pip install 'pharos-rl[storm]'" in refusal(MissingExtra, importers.storm, tmp_path / "model.nm")
    done = run("import", "prism", tmp_path / "model.nm", "--out", tmp_path / "out")
    assert done.exit_code == 1 and len(done.stderr.strip().splitlines()) == 1


class Rows:
    """A sparse matrix as stormpy shows it: rows of {column: value}, and where the choices of each state begin."""

    def __init__(self, rows, first=()):
        self.rows, self.first = rows, first

    def get_row(self, row):
        return [SimpleNamespace(column=column, value=value) for column, value in self.rows[row].items()]

    def get_row_group_start(self, state):
        return self.first[state]

    def get_row_group_end(self, state):
        return [*self.first[1:], len(self.rows)][state]


class Valuations:
    """Values of variables as stormpy shows them; `late` has none in state 0."""

    def __init__(self, columns):
        self.columns = columns

    def get_all_variables(self):
        kinds = {name: isinstance(column[0], bool) for name, column in self.columns.items()}
        return [
            SimpleNamespace(name=name, index=-i, has_boolean_type=lambda b=b: b, has_integer_type=lambda b=b: not b)
            for i, (name, b) in enumerate([*kinds.items(), ("late", False)])
        ]

    def entity_has_variable(self, state, variable):
        return variable.name != "late" or state > 0

    def get_value(self, state, variable):
        return self.columns[variable.name][state]

    def get_int64_values(self, variable):
        return self.columns[variable.name]


def bet(rewards):
    """A model as stormpy gives it. State 0 bets, once carefully and once boldly, state 1 has won, state 2 lost and only
    waits for one of the others."""
    paid = SimpleNamespace(
        has_state_rewards=True,
        get_state_reward=[-1.0, 0.0, -2.0].__getitem__,
        has_state_action_rewards=True,
        get_state_action_reward=[0.0, 0.5, 0.0, 0.0].__getitem__,
        has_transition_rewards=True,
        transition_rewards=Rows([{}, {1: 8.0}, {}, {0: 3.0, 1: 3.0}]),
    )
    labels = {"won": [1], "init": [0]}
    return SimpleNamespace(
        has_state_valuations=lambda: True,
        state_valuations=Valuations({"money": [1, 2, 0], "open": [True, False, True], "_loc_m": [0, 0, 0]}),
        has_choice_labeling=lambda: True,
        choice_labeling=SimpleNamespace(get_labels_of_choice=[{"careful"}, {"bold"}, set(), {"wait"}].__getitem__),
        nr_states=3,
        initial_states=[0],
        labeling=SimpleNamespace(get_labels=lambda: set(labels), get_states=labels.__getitem__),
        reward_models={name: paid for name in rewards},
        transition_matrix=Rows([{1: 0.25, 2: 0.75}, {0: 0.5, 1: 0.5}, {1: 1.0}, {0: 0.5, 1: 0.5}], [0, 2, 3]),
    )


def built(monkeypatch, rewards=()):
    monkeypatch.setattr(storm, "_model", lambda *_: storm.Built(bet(rewards), "", None))


def test_labels_variables_and_names_of_choices_are_kept(monkeypatch, tmp_path):
    built(monkeypatch)
    done = run("import", "prism", "bet.nm", "--target", "won", "--out", tmp_path / "bet")
    assert (done.exit_code, done.stderr) == (0, "")
    mdp = importers.load(tmp_path / "bet")
    names = mdp.names
    assert {name: mask.tolist() for name, mask in names.labels.items()} == {
        "init": [True, False, False],
        "won": [False, True, False],
    }
    # in the order of Storm's numbers; without what has no value in some state, and places of which there is one
    assert {name: column.tolist() for name, column in names.variables.items()} == {
        "open": [True, False, True],
        "money": [1, 2, 0],
    }
    assert (names.state(0), names.labels_of(1)) == ("open=true money=1", ["won"])
    assert [names.action(s, a) for s, a in ((0, 0), (0, 1), (1, 0), (2, 0))] == ["careful", "bold", "0", "wait"]
    for target, states in (("won", [1]), ("money>=1 & !won", [0]), ('!"won" & open', [0, 2])):
        assert np.flatnonzero(pharos.reach(mdp, target).target).tolist() == states
    answer = json.loads(run("solve", tmp_path / "bet", "--gamma", "0.5", "--print-policy", "--json").stdout)
    row = {"state": 0, "variables": {"open": True, "money": 1}, "labels": ["init"], "action": 1, "name": "bold"}
    assert (answer["policy_rows"], answer["policy_left_out"]) == ([row], 0)  # which never gets to state 2


def law(outcomes, row):
    part = slice(outcomes.offsets[row], outcomes.offsets[row + 1])
    return [each[part].tolist() for each in (outcomes.next_states, outcomes.probabilities, outcomes.rewards)]


def test_rewards_of_transitions_are_kept_by_outcome_and_their_means_by_the_mdp(monkeypatch, tmp_path):
    built(monkeypatch, ["money"])
    mdp, outcomes = importers.storm_recording("bet.nm", target="won", reward="money")
    assert mdp.rewards.tolist() == [[-1.0, 3.5], [0.0, 0.0], [1.0, 1.0]]
    assert mdp.terminal.tolist() == [False, True, False]
    assert law(outcomes, 0) == [[1, 2], [0.25, 0.75], [-1.0, -1.0]]
    assert law(outcomes, 1) == [[0, 1], [0.5, 0.5], [-0.5, 7.5]]  # only winning boldly pays its 8
    assert law(outcomes, 2) == law(outcomes, 3) == [[-1], [1.0], [0.0]]
    assert law(outcomes, 4) == law(outcomes, 5) == [[0, 1], [0.5, 0.5], [1.0, 1.0]]  # the first choice by both actions
    done = run("import", "prism", "bet.nm", "--target", "won", "--reward", "money", "--out", tmp_path / "bet")
    assert (done.exit_code, done.stderr) == (0, "")
    env, back = pharos.make(str(tmp_path / "bet")), importers.load(tmp_path / "bet")
    np.testing.assert_array_equal(back.rewards, mdp.rewards)
    drawn = {
        env.next_state((0,), 1, k)[0]: float(env.reward_of((0,), 1, env.next_state((0,), 1, k), k)) for k in (0, 1)
    }
    assert drawn == {0: -0.5, 1: 7.5}


def test_reaching_a_target_pays_one_when_it_is_reached(monkeypatch):
    built(monkeypatch)
    mdp, outcomes = importers.storm_recording("bet.nm", target="won")
    assert mdp.rewards.tolist() == [[0.25, 0.5], [0.0, 0.0], [0.5, 0.5]]
    assert law(outcomes, 0) == [[1, 2], [0.25, 0.75], [1.0, 0.0]]
    np.testing.assert_array_equal(importers.storm("bet.nm", target="won").rewards, mdp.rewards)


def test_where_no_transition_pays_otherwise_the_mdp_says_it_all(monkeypatch):
    model = bet(["money"])
    model.reward_models["money"].has_transition_rewards = False
    monkeypatch.setattr(storm, "_model", lambda *_: storm.Built(model, "", None))
    mdp, outcomes = importers.storm_recording("bet.nm", target="won", reward="money")
    assert outcomes is None
    assert mdp.rewards.tolist() == [[-1.0, -0.5], [0.0, 0.0], [-2.0, -2.0]]


@needs_storm
def test_models_have_their_published_numbers_of_states():
    """The dice of Knuth and Yao, the shared coin of two processes (K = 2), bounded retransmission (N = 16, MAX = 2)."""
    for file, states in (
        (models.prism_dtmc_die, 13),
        (models.jani_dtmc_die, 13),
        (models.prism_mdp_coin_2_2, 272),
        (models.prism_dtmc_brp, 677),
    ):
        assert importers.storm(file, target="deadlock").num_states == states
    die = importers.storm(models.prism_dtmc_die, target="six", horizon=100)
    assert pharos.value_iteration(die, 1e-10).value_at_start == pytest.approx(1 / 6, abs=1e-9)


@needs_storm
def test_constants_rewards_and_states_with_fewer_choices(tmp_path):
    text = """mdp
const int N;
module walk
  s : [0..N] init 0;
  [] s<N -> 0.5:(s'=s+1) + 0.5:(s'=s);
  [] s=0 -> (s'=N);
endmodule
rewards "steps"
  s<N : 1;
  [] s=0 : 0.25;
endrewards
label "there" = s=N;
"""
    (tmp_path / "walk.nm").write_text(text)
    mdp = importers.storm(tmp_path / "walk.nm", constants="N=3", reward="steps", target="there", horizon=500)
    assert (mdp.num_states, mdp.num_actions) == (4, 2)
    assert sorted(mdp.rewards.tolist()) == [[0.0, 0.0], [1.0, 1.0], [1.0, 1.0], [1.25, 1.25]]
    assert pharos.value_iteration(mdp, 1e-9).value_at_start == pytest.approx(6.5, abs=1e-8)
    assert pharos.solvers.worst_value(mdp, 1e-9).value_at_start == pytest.approx(1.25, abs=1e-8)


@needs_storm
def test_a_model_pays_what_its_transitions_pay(tmp_path):
    text = """mdp
module walk
  s : [0..2] init 0;
  [go] s<2 -> 0.25:(s'=0) + 0.75:(s'=s+1);
endmodule
rewards "money"
  s=1 : 1;
  [go] s=0 : -2;
endrewards
label "there" = s=2;
"""
    (tmp_path / "walk.nm").write_text(text)
    mdp, outcomes = importers.storm_recording(tmp_path / "walk.nm", reward="money", target="there")
    assert outcomes is None and sorted(mdp.rewards.tolist()) == [[-2.0], [0.0], [1.0]]
    mdp, outcomes = importers.storm_recording(tmp_path / "walk.nm", target="there")
    assert sorted(mdp.rewards.tolist()) == [[0.0], [0.0], [0.75]]
    assert sorted(zip(outcomes.probabilities.tolist(), outcomes.rewards.tolist(), strict=True)) == [
        (0.25, 0.0), (0.25, 0.0), (0.75, 0.0), (0.75, 1.0), (1.0, 0.0)]  # fmt: skip


@needs_storm
def test_the_shared_coin_takes_48_to_75_steps():
    mdp = importers.storm(models.prism_mdp_coin_2_2, reward="steps", target="finished", horizon=4000)
    assert pharos.value_iteration(mdp, 1e-8).value_at_start == pytest.approx(75, abs=2e-6)
    assert pharos.solvers.worst_value(mdp, 1e-8).value_at_start == pytest.approx(48, abs=2e-6)


@needs_storm
def test_what_pharos_exports_comes_back(tmp_path):
    mdp = pharos.build(pharos.make("simple_grid")).mdp(gamma=0.9)
    back = importers.storm(exporters.drn(mdp, tmp_path / "grid.drn"), reward="reward", target="terminal", horizon=1000)
    expected = pharos.value_iteration(mdp, 1e-9).value_at_start
    assert pharos.value_iteration(back, 1e-9).value_at_start == pytest.approx(expected, abs=1e-8)


@needs_storm
def test_what_cannot_be_imported_is_one_line(tmp_path):
    assert "undefined constants" in refusal(FileFormatError, importers.storm, models.prism_mdp_firewire, target="done")
    assert "label" in refusal(UnknownName, importers.storm, models.prism_dtmc_die, target="dome")
    assert "nothing says what is paid" in refusal(ParameterError, importers.storm, models.jani_dtmc_die, constants="")
    with pytest.raises(FileFormatError, match="expected an MDP or a DTMC"):
        importers.storm(models.prism_pomdp_maze, target="goal")
    assert "No such file" in refusal(ParameterError, importers.storm, tmp_path / "nothing.nm")
    os.mkfifo(tmp_path / "pipe.prism")
    assert "pipe.prism: it is no regular file" in refusal(ParameterError, importers.storm, tmp_path / "pipe.prism")
    words = (models.prism_mdp_coin_2_2, "--target", "finished", "--reward", "steps", "--out", tmp_path / "coin")
    assert json.loads(run("import", "prism", *words, "--json").stdout)["num_states"] == 272
    assert pharos.make(str(tmp_path / "coin")).has_chance


SUMS = """mdp
module m
  s : [0..3] init 0;
  [a] s=0 -> 0.3:(s'=1) + 0.5:(s'=2);
  [b] s=0 -> 1:(s'=1);
  [] s=1 | s=2 -> 1:(s'=3);
  [] s=3 -> true;
endmodule
rewards "cost"  s=1 : -10;  s=2 : -4;  endrewards
label "end" = s=3;
"""


@needs_storm
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("", ""), "the probabilities of state 0, choice 0 sum to 0.8; expected 1; Storm: Probabilities do not sum to "
         "one for command '[a] (s = 0)"),
        (("0.3:", "0.6:"), "the probabilities of state 0, choice 0 sum to 1.1; expected 1"),
        (("0.3:", "1.5:"), "Probability expression in update '3/2 : (s' = 1) evaluates to value 1.5 >1"),
        (("0.3:", "0.499998:"), "the probabilities of state 0, choice 0 sum to 0.999998; expected 1"),
        (("0.3:(s'=1)", "0.5:(s'=5)"), "leads to an out-of-bounds value (5) for the variable 's'"),
        (("0.3:(s'=1) + 0.5:(s'=2);\n", "0.4999999:(s'=1) + 0.5:(s'=2);\n[] s=1 -> (s'=5);"),
         "some update leaves the range of its variable"),
        (("s : [0..3]", "ma : [0..3]"), "'ma' is a reserved keyword and cannot be used as an identifier"),
        (("s : [0..3]", "floor : [0..3]"), "'floor' is a reserved keyword"),
    ],
)  # fmt: skip
def test_a_malformed_model_is_refused_by_what_storm_says_of_it(change, message, tmp_path, capfd):
    file = tmp_path / "sums.prism"
    file.write_text(SUMS.replace(*change) if any(change) else SUMS)
    said = refusal(FileFormatError, importers.storm, file, reward="cost", target="end", horizon=100)
    assert message in said
    captured = capfd.readouterr()
    assert (captured.out, captured.err) == ("", "")  # Storm prints past Python
    done = run("import", "prism", file, "--reward", "cost", "--target", "end", "--out", tmp_path / "out")
    assert done.exit_code == 1 and len(done.stderr.strip().splitlines()) == 1


@needs_storm
def test_a_model_with_rounded_probabilities_has_them_divided_by_their_sums(tmp_path, capfd):
    file = tmp_path / "thirds.prism"
    thirds = " + ".join(f"0.3333333:(s'={s})" for s in (1, 2, 3))
    file.write_text(SUMS.replace("0.3:(s'=1) + 0.5:(s'=2)", thirds))
    mdp = importers.storm(file, reward="cost", target="end", horizon=100)
    assert mdp.residual.probabilities == pytest.approx(1e-7, rel=1e-6)
    solution = pharos.value_iteration(mdp)
    assert solution.value_at_start == pytest.approx(-14 / 3, abs=1e-12)
    assert 14 / 3 * 1e-7 < solution.error_bound < 1e-3
    assert capfd.readouterr().out == ""


@needs_storm
def test_rounded_probabilities_of_commands_that_go_together_are_divided_as_well(tmp_path):
    """Storm refuses them with other words than those of a single command."""
    parts = [
        f"module m{i}\n x{i} : [0..2];\n [go] x{i}<2 -> 0.3333333:(x{i}'=0) + 0.6666666:(x{i}'=x{i}+1);\nendmodule\n"
        for i in (1, 2)
    ]
    file = tmp_path / "both.prism"
    file.write_text("mdp\n" + "".join(parts) + 'label "end" = x1=2 & x2=2;\n')
    mdp = importers.storm(file, target="end", horizon=1)
    assert mdp.residual.probabilities == pytest.approx(2e-7, rel=1e-3)
    assert sorted(mdp.rewards.ravel())[-1] == pytest.approx(4 / 9)


@needs_storm
def test_an_explicit_model_keeps_the_same_rule(tmp_path):
    text = exporters.drn(pharos.build(pharos.make("frozen_lake")).mdp(gamma=1.0), tmp_path / "lake.drn").read_text()
    assert importers.storm(tmp_path / "lake.drn", target="terminal", horizon=10).residual.probabilities < 1e-12
    (tmp_path / "bad.drn").write_text(text.replace("1 : 1.0", "1 : 0.2", 1))
    message = refusal(FileFormatError, importers.storm, tmp_path / "bad.drn", target="terminal", horizon=10)
    assert "the probabilities of state 0, choice 1 sum to 0.2; expected 1" in message


CHOICES = """
mdp
module m
  s : [0..4] init 0;
  [long] s=0 -> 1:(s'=1);   [short] s=0 -> 1:(s'=2);
  [x] s=1 -> 1:(s'=3);
  [a] s=2 -> 1:(s'=3);  [b] s=2 -> 1:(s'=4);
  [c] s=2 -> 0.5:(s'=3) + 0.5:(s'=4);  [d] s=2 -> 0.25:(s'=3) + 0.75:(s'=4);
  [] s=3 -> (s'=4);  [] s=4 -> true;
endmodule
rewards "r"  [long] true : 1;  [short] true : 1.5;  s=3 : 1;  endrewards
label "end" = s=4;
"""


@needs_storm
def test_measures_count_the_choices_that_a_model_has(tmp_path):
    """A model of nine commands, of which states have one to four; gaps and uniform play by hand."""
    path = tmp_path / "choices.prism"
    path.write_text(CHOICES)
    mdp = importers.storm(path, reward="r", target="end", gamma=0.9)
    assert mdp.available.sum(axis=1).tolist() == [2, 1, 4, 1, 4]
    v3, v1, v2 = 1.0, 0.9, 0.9
    gaps = [(1.5 + 0.9 * v2) - (1 + 0.9 * v1), 0.9 * v3, 0.9 - 0.45, 0.9 - 0.225]
    assert pharos.hardness.sum_of_reciprocal_gaps(mdp) == pytest.approx(sum(1 / gap for gap in gaps))
    assert pharos.hardness.sum_of_reciprocal_gaps(mdp) == pytest.approx(6.814815, abs=1e-6)
    uniform = 0.5 * (1 + 0.9 * v1) + 0.5 * (1.5 + 0.9 * (0.9 + 0.45 + 0.225) / 4)
    assert pharos.solvers.uniform_value(mdp).value_at_start == pytest.approx(uniform)


# Properties -----------------------------------------------------------------------------------------------------------

ASKED = {  # of the shared coin with K = 2: the published values of 2-2
    'Rmax{"steps"}=? [F "finished"]': ("finished", "largest_cost", 75),
    'R{"steps"}min=? [F "finished"]': ("finished", "least_cost", 48),
    'Rmin=? [F "finished"]': ("finished", "least_cost", 48),
    'Pmax=? [F "finished" & !"agree"]': ("target", "maximum", 13 / 120),
    'Pmin=? [F "finished" & "all_coins_equal_1"]': ("target", "minimum", 49 / 128),
    'Pmax=? [F pc1=3 & pc2=3 & !coin1=coin2]': ("target", "maximum", 13 / 120),
    'Pmin=? [true U "finished"]': ("finished", "minimum", 1),
    'Pmax=? [F false]': ("target", "maximum", 0),
}  # fmt: skip


@needs_storm
@pytest.mark.parametrize("text", ASKED)
def test_a_property_is_answered_with_a_proven_interval(text, tmp_path):
    label, name, value = ASKED[text]
    words = (models.prism_mdp_coin_2_2, "--property", text, "--out", tmp_path / "coin", "--json")
    done = run("import", "prism", *words)
    assert done.exit_code == 0, done.stderr
    answer = json.loads(done.stdout)["property"]
    assert (answer["reach"], answer["answer"], answer["infinite"]) == (label, name, False)
    assert answer["lower"] <= value <= answer["upper"] < answer["lower"] + 1e-6
    again = json.loads(run("solve", tmp_path / "coin", "--reach", label, "--json").stdout)["reach"][name]
    assert (again["lower"], again["upper"]) == pytest.approx((answer["lower"], answer["upper"]), abs=1e-6)


@needs_storm
def test_properties_of_jani_files_are_asked_by_name(tmp_path):
    for name, value in (("Probability to throw a six", 1 / 6), ("Expected number of coin flips", 11 / 3)):
        words = (models.jani_dtmc_die, "--property", name, "--out", tmp_path / "die", "--json")
        answer = json.loads(run("import", "prism", *words).stdout)["property"]
        assert answer["lower"] - 1e-15 <= value <= answer["upper"] + 1e-15 and answer["upper"] - answer["lower"] < 1e-6
    message = refusal(ParameterError, importers.storm, models.jani_dtmc_die, property="seven")
    assert "properties of the file: Probability to throw a six, Expected number of coin flips" in message


JANI = {
    "jani-version": 1, "name": "walk", "type": "dtmc", "features": [],
    "constants": [{"name": "N", "type": "int"}],
    "variables": [{"name": "x", "type": {"kind": "bounded", "base": "int", "lower-bound": 0, "upper-bound": 9},
                   "initial-value": 0}],
    "automata": [{"name": "m", "locations": [{"name": "l"}], "initial-locations": ["l"], "edges": [
        {"location": "l", "guard": {"exp": {"op": "<", "left": "x", "right": 9}}, "destinations": [
            {"location": "l", "probability": {"exp": 0.5},
             "assignments": [{"ref": "x", "value": {"op": "+", "left": "x", "right": 1}}]},
            {"location": "l", "probability": {"exp": 0.5}, "assignments": [{"ref": "x", "value": 9}]}]}]}],
    "system": {"elements": [{"automaton": "m"}]},
    "properties": [{"name": "there", "expression": {
        "op": "filter", "fun": "max", "states": {"op": "initial"},
        "values": {"op": "Pmax", "exp": {"op": "F", "exp": {"op": "=", "left": "x", "right": "N"}}}}}],
}  # fmt: skip


@needs_storm
def test_constants_of_a_jani_file_are_those_of_its_properties(tmp_path):
    """Storm gives a constant in a property, where it is not said, any value, and says nothing."""
    (tmp_path / "walk.jani").write_text(json.dumps(JANI))
    for n in (1, 2, 5):
        mdp, _, question = importers.storm_import(tmp_path / "walk.jani", constants=f"N={n}", property="there")
        bounds = pharos.reach(mdp, question.reach).maximum
        start = int(mdp.starts[0])
        assert bounds.lower[start] <= 0.5**n <= bounds.upper[start] < 0.5**n + 1e-9
        assert mdp.names.labels[question.reach].sum() == 1
    assert question.of_starts == "max"


STEPS = """mdp
module m
  x : [0..3] init 0;
  open : bool init false;
  [walk] x<3 -> 0.5:(x'=x+1) + 0.5:(x'=x)&(open'=true);
  [jump] x=0 -> (x'=3)&(open'=true);
  [wait] x=3 -> true;
endmodule
rewards "cost"  [walk] true : 1;  [jump] true : 9;  endrewards
rewards "fuel"  [walk] true : 2;  endrewards
label "target" = x=1;
"""


@needs_storm
def test_what_must_hold_until_then_and_labels_of_the_same_name(tmp_path):
    (tmp_path / "steps.prism").write_text(STEPS)
    mdp, _, question = importers.storm_import(tmp_path / "steps.prism", property="Pmax=? [!open U x=2]")
    assert (question.reach, question.answer) == ("target_", "maximum")  # the model has a label "target"
    assert list(mdp.names.labels) == ["deadlock", "init", "target", "target_"]
    bounds = pharos.reach(mdp, question.reach).maximum
    assert bounds.lower[mdp.starts[0]] <= 0.25 <= bounds.upper[mdp.starts[0]]  # two steps without opening
    assert pharos.value_iteration(mdp).value_at_start == pytest.approx(0.25)
    names = mdp.names
    start = int(mdp.starts[0])
    assert sorted(names.action(start, a) for a in (0, 1)) == ["jump", "walk"]
    assert set(names.variables) == {"x", "open"} and names.labels_of(start) == ["init"]
    mdp, _, question = importers.storm_import(tmp_path / "steps.prism", property='Rmin{"cost"}=? [F x=3]')
    cost = pharos.reach(mdp, question.reach).least_cost
    assert cost.lower[start] <= 6 <= cost.upper[start]


@needs_storm
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"property": "P=? [F x=3]"}, "says neither max nor min"),
        ({"property": "Pmax>=0.5 [F x=3]"}, "is not answered; expected P, Pmax or Pmin=? [F target]"),
        ({"property": "Pmax=? [F<=5 x=3]"}, "steps are --target with --horizon"),
        ({"property": "Pmax=? [F y=3]"}, "Storm cannot read it"),
        ({"property": 'Rmax{"gold"}=? [F x=3]'}, "unknown reward structure"),
        ({"property": "Rmax=? [F x=3]"}, "unknown reward structure"),  # there are two
        ({"property": "Pmax=? [F x=3]", "target": "target"}, "leave out --reward and --target"),
        ({"target": "x=3 &"}, "is no label (deadlock, init, target), and as an expression Storm cannot read it"),
        ({"target": "exit"}, "unknown label"),
    ],
)
def test_properties_that_are_not_answered_are_refused_in_one_line(options, words, tmp_path):
    (tmp_path / "steps.prism").write_text(STEPS)
    assert words in refusal(ParameterError, importers.storm, tmp_path / "steps.prism", **options)


@needs_storm
def test_a_target_may_be_an_expression(tmp_path):
    (tmp_path / "steps.prism").write_text(STEPS)
    for text, states in (("!x=3 & open", 3), ("target | x>=2", 6), ('"target" & !open', 1)):
        mdp = importers.storm(tmp_path / "steps.prism", target=text, reward="cost")
        assert mdp.terminal.sum() == mdp.names.labels["target_"].sum() == states, text


# Another solver -------------------------------------------------------------------------------------------------------

PARTS = [("1",), ("1/2", "1/2"), ("1/4", "3/4"), ("1/8", "3/8", "1/2"), ("1/64", "63/64")]
"""Exact in floats, so that Storm's rational numbers are those of the same MDP."""


def random_model(rng):
    """A small MDP in PRISM's language: cycles, components without a way out, choices that pay nothing."""
    states = int(rng.integers(3, 9))
    commands, rewards = [], []
    for s in range(states):
        if s == states - 2:  # no way out, for nothing
            commands.append(f"[] s={s} -> true")
            continue
        for a in range(int(rng.integers(1, 4))):
            parts = PARTS[rng.integers(len(PARTS))]
            commands.append(f"[a{s}_{a}] s={s} -> " + " + ".join(f"{p}:(s'={rng.integers(states)})" for p in parts))
            rewards.append(f"[a{s}_{a}] true : {rng.choice([0, 0, 1, 3])};")
    module = "".join(f"  {command};\n" for command in commands)
    paid = "\n".join(rewards)
    return f"""mdp
module m
  s : [0..{states - 1}] init 0;
{module}endmodule
rewards "cost"
{paid}
endrewards
label "goal" = s={states - 1};
"""


@needs_storm
@pytest.mark.long
def test_random_mdps_as_storm_solves_them_soundly_and_in_rational_numbers(tmp_path):
    """300 MDPs: the exact value lies in the proven interval, and the interval of Storm's sound methods meets it."""
    import stormpy

    rng, path = np.random.default_rng(0), tmp_path / "model.prism"
    queries = {
        'Pmax=? [F "goal"]': "maximum",
        'Pmin=? [F "goal"]': "minimum",
        'R{"cost"}min=? [F "goal"]': "least_cost",
        'R{"cost"}max=? [F "goal"]': "largest_cost",
    }
    infinite = between = 0
    for number in range(300):
        path.write_text(random_model(rng))
        mdp = importers.storm(path, reward="cost", target="goal")
        result = pharos.reach(mdp, "goal")
        program = stormpy.parse_prism_program(str(path))
        sound, exact = stormpy.build_model(program), stormpy.build_model[stormpy.Rational](program)
        start = int(mdp.starts[0])
        for text, name in queries.items():
            query = stormpy.parse_properties(text, program)[0]
            bounds = getattr(result, name)
            lower, upper = bounds.lower[start], bounds.upper[start]
            value = stormpy.model_checking(exact, query)[exact.initial_states[0]].value
            if str(value) == "inf":
                assert lower == upper == np.inf, (number, text)
                infinite += 1
                continue
            value = Fraction(str(value))
            assert Fraction(lower) <= value <= Fraction(upper), (number, text)
            assert upper - lower <= 2e-6
            by_storm = float(stormpy.model_checking(sound, query)[sound.initial_states[0]].value)
            assert lower - 1e-5 * max(1, lower) <= by_storm <= upper + 1e-5 * max(1, upper), (number, text)
            between += 0 < value < 1
    assert infinite > 100 and between > 100
