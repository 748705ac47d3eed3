"""Names of states and actions: expressions beside plain Python, refusals, folders, and readable policies."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from command_line import run
from pharos import bisimulation, importers
from pharos.errors import FileFormatError, ParameterError, UnknownName
from pharos.mdp import Names, TabularMDP, names_of
from refusals import refusal
from strategies import examples

X, Y, OPEN = [0, 1, 2, 3, -4, 2], [5, 5, -1, 0, 2, 2], [True, False, True, True, False, False]
GOAL = [False, False, True, False, True, False]
NAMES = Names({"goal": np.array(GOAL)}, {"x": np.array(X), "y": np.array(Y), "open": np.array(OPEN)})
STATES = [dict(zip(("x", "y", "open", '"goal"'), each, strict=True)) for each in zip(X, Y, OPEN, GOAL, strict=True)]

# Trees of (text, value in a state), by their own precedence: 0 | 1 & 2 ! 3 comparison 4 sum 5 product 6 atom


def atom(text, value):
    return text, 6, value


def wrapped(node, least):
    return node[0] if node[1] >= least else f"({node[0]})"


def numbers():
    leaves = st.one_of(
        st.integers(0, 9).map(lambda n: atom(str(n), lambda state: n)),
        st.sampled_from(["x", "y"]).map(lambda name: atom(name, lambda state: state[name])),
    )

    def larger(inner):
        def joined(parts):
            (a, sign, b) = parts
            level = 5 if sign == "*" else 4
            compute = {"+": lambda p, q: p + q, "-": lambda p, q: p - q, "*": lambda p, q: p * q}[sign]
            text = f"{wrapped(a, level)} {sign} {wrapped(b, level + 1)}"
            return text, level, lambda state: compute(a[2](state), b[2](state))

        negated = inner.map(lambda a: (f"-{wrapped(a, 6)}", 5, lambda state: -a[2](state)))
        return st.one_of(st.tuples(inner, st.sampled_from("+-*"), inner).map(joined), negated)

    return st.recursive(leaves, larger, max_leaves=4)


def conditions():
    def compared(parts):
        a, sign, b = parts
        compare = {"=": "__eq__", "!=": "__ne__", "<": "__lt__", "<=": "__le__", ">": "__gt__", ">=": "__ge__"}[sign]
        text = f"{wrapped(a, 4)}{sign}{wrapped(b, 4)}"
        return text, 3, lambda state: getattr(int(a[2](state)), compare)(int(b[2](state)))

    comparisons = st.tuples(numbers(), st.sampled_from(["=", "!=", "<", "<=", ">", ">="]), numbers()).map(compared)
    leaves = st.one_of(
        comparisons,
        st.sampled_from(["open", '"goal"']).map(lambda name: atom(name, lambda state: state[name])),
        st.booleans().map(lambda b: atom(str(b).lower(), lambda state: b)),
    )

    def larger(inner):
        def joined(parts):
            a, sign, b = parts
            level = 1 if sign == "&" else 0
            join = (lambda p, q: p and q) if sign == "&" else (lambda p, q: p or q)
            return f"{wrapped(a, level)}{sign}{wrapped(b, level)}", level, lambda s: join(a[2](s), b[2](s))

        denied = inner.map(lambda a: (f"!{wrapped(a, 2)}", 2, lambda state: not a[2](state)))
        return st.one_of(st.tuples(inner, st.sampled_from("&|"), inner).map(joined), denied)

    return st.recursive(leaves, larger, max_leaves=6)


@pytest.mark.long
@examples(400, conditions())
def test_expressions_are_those_of_plain_python_with_the_precedence_of_prism(tree):
    text, _, value = tree
    assert NAMES.states_where(text, len(X)).tolist() == [bool(value(state)) for state in STATES]


def test_a_label_a_variable_and_a_number_of_two_values():
    where = {
        "goal": [2, 4],
        '"goal" & x>0': [2],
        "!x=2": [0, 1, 3, 4],  # of PRISM: !(x=2)
        "open = false": [1, 4, 5],
        "x-y-2=-3 - 2*2": [0],
        "true": list(range(6)),
    }
    for text, states in where.items():
        assert np.flatnonzero(NAMES.states_where(text, 6)).tolist() == states, text
    both = Names({"x": np.array([True, False])}, {"x": np.array([0, 1])})  # a label and a variable
    assert both.states_where("x", 2).tolist() == [True, False]
    assert both.states_where("!x & true", 2).tolist() == [True, False]  # in an expression the variable
    assert both.states_where('!"x" & true', 2).tolist() == [False, True]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x", "found 'x', which is a number; expected a condition, such as x=3"),
        ("x=", "found its end; expected a variable, a label, a number or a parenthesis"),
        ("", "found its end"),
        ("(x=1", "expected a closing parenthesis"),
        ("x=1 y=2", "found 'y' after 'x=1'; expected & or |"),
        ("x==1", "found '='"),
        ("open<true", "whose sides are true or false; expected = or !="),
        ("x+open=1", "'open', which is true or false; expected a number"),
        ("x=1;import os", "found ';'"),
        ("__import__('os')", 'found "\'"'),
        ("9" * 40 + "=x", "expected numbers of at most 4.61e+18"),
        ("x*999999999999*999999999=1", "expected at most 4.61e+18"),
        ("(" * 50, "41 parentheses within each other"),
        ("-" * 50 + "x=1", "found '-'"),
        ("x" * 20_000, "expression of 20,000 characters"),
    ],
)
def test_what_is_no_expression_is_refused_in_one_line(text, words):
    said = refusal(ParameterError, NAMES.states_where, text, 6)
    assert words in said and len(said) < 500


def test_what_is_unknown_is_refused_with_all_that_there_is():
    said = refusal(UnknownName, NAMES.states_where, "z=3", 6)
    assert said == (
        "unknown label or variable 'z'; there are terminal; labels goal; variables x (-4 to 3), y (-1 to 5), "
        "open (true, false)"
    )
    assert "unknown label 'done'" in refusal(UnknownName, NAMES.states_where, '"done"', 6)


def corridor():
    """Six states in a row; action 0 goes left, action 1 right; the last one is terminal, and 3 may slip back."""
    mdp = TabularMDP.from_outcomes(
        [*([[max(s - 1, 0)] * 2, [s + 1, max(s - 1, 0)]] for s in range(5)), [[5, 5]] * 2],
        [[[1.0, 0.0], [0.75, 0.25] if s == 3 else [1.0, 0.0]] for s in range(6)],
        [[-1.0, -1.0]] * 5 + [[0.0, 0.0]],
        terminal=[False] * 5 + [True],
        gamma=1.0,
        initial=2,
    )
    names = {"x": np.arange(6) - 300, "open": np.arange(6) >= 3}
    named = mdp.with_names(labels={"end": [5], "none": []}, variables=names, actions=["left", "right"])
    return replace(
        named,
        names=replace(
            named.names, choices=np.array([[-1, -1]] * 3 + [[0, 1]] * 2 + [[-1, -1]]), choice_names=("back", "on")
        ),
    )


def test_names_survive_a_folder(tmp_path):
    mdp = corridor()
    folder = importers.save(mdp, tmp_path / "corridor")
    names = importers.load(folder).names
    for own, kept in ((mdp.names.labels, names.labels), (mdp.names.variables, names.variables)):
        assert list(own) == list(kept)
        assert all((own[name] == kept[name]).all() and own[name].dtype == kept[name].dtype for name in own)
    assert (names.actions, names.choice_names) == (("left", "right"), ("back", "on"))
    assert (names.choices == mdp.names.choices).all()
    assert (names.state(3), names.labels_of(5)) == ("x=-297 open=true", ["end"])
    assert [names.action(*pair) for pair in ((0, 1), (3, 1))] == ["right", "on"]
    assert json.loads((folder / "manifest.json").read_text())["format_version"] == 1
    assert pharos.make(str(folder)).actions == ("left", "right")
    assert (np.load(folder / "variable_values.npy").dtype, np.load(folder / "label_states.npy").shape) == (
        np.int16,
        (6, 2),
    )
    # an environment of other names is another one
    assert importers.environment(mdp).folder != importers.environment(mdp.with_names(actions=["a", "b"])).folder
    assert importers.environment(mdp.with_names(actions=["a", "b"])).actions == ("a", "b")


def test_names_of_a_folder_that_was_changed_are_refused(tmp_path):
    folder = importers.save(corridor(), tmp_path / "corridor")
    for name, message in (("label_states", "was changed"), ("choice_names", "was changed")):
        kept = (folder / f"{name}.npy").read_bytes()
        np.save(folder / f"{name}.npy", np.zeros((6, 2), np.int8))
        assert message in refusal(FileFormatError, importers.load, folder)
        (folder / f"{name}.npy").write_bytes(kept)
    (folder / "variable_values.npy").unlink()
    assert "no such file" in refusal(FileFormatError, importers.load, folder)


@pytest.mark.long
def test_names_belong_to_the_states_that_are_left():
    part = pharos.mdp.mdp_within(corridor().with_initial(4), 1)
    assert names_of(part).variables["x"].tolist() == [-297, -296, -295]
    assert names_of(part).labels["end"].tolist() == [False, False, True]
    assert bisimulation.minimize(corridor()).mdp.names is None


def test_names_that_do_not_fit_are_refused():
    mdp = corridor()
    assert "label end" in refusal(ParameterError, mdp.with_names, labels={"end": [6]})
    assert "variable x" in refusal(ParameterError, mdp.with_names, variables={"x": [0.5] * 6})
    assert "expected 2 names" in refusal(ParameterError, mdp.with_names, actions=["left"])


@pytest.mark.long
def test_own_environments_are_asked_by_their_variables():
    lake = pharos.build(pharos.make("frozen_lake", slippery=True)).mdp()
    assert names_of(lake).in_words == "terminal; variables row (0 to 3), column (0 to 3)"
    goal = pharos.reach(lake, "row=3 & column=3")
    assert goal.maximum.lower[0] <= 14 / 17 <= goal.maximum.upper[0]
    # what attains a number, valued by itself
    paid = np.where(goal.stopped.terminal[:, None], 0.0, lake.dynamics.expected(np.append(goal.target, False) * 1.0))
    worth = pharos.evaluate_policy(goal.stopped.with_rewards(paid), goal.maximum.policy)
    assert worth.v[0] == pytest.approx(14 / 17, abs=1e-9)


@pytest.mark.long
def test_the_policies_of_costs_attain_them():
    result = pharos.reach(corridor(), "x=-295")
    for bounds in (result.least_cost, result.maximum, result.minimum):
        assert bounds.policy.shape == (6,)
    cost = pharos.evaluate_policy(corridor(), result.least_cost.policy)
    inside = np.abs(-cost.v - result.least_cost.upper)
    assert inside.max() <= cost.error_bound + 1e-6
    assert result.least_cost.policy[:5].tolist() == [1] * 5


def rows_of(*words):
    done = run(*words, "--print-policy", "--json")
    assert done.exit_code == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.long
def test_a_printed_policy_names_states_and_actions(tmp_path):
    folder = importers.save(corridor(), tmp_path / "corridor")
    answer = rows_of("solve", folder)
    rows = answer["policy_rows"]
    assert [(row["state"], row["name"]) for row in rows] == [(2, "right"), (3, "on"), (4, "on")]  # 0 and 1 never
    assert rows[0] == {"state": 2, "variables": {"x": -298, "open": False}, "labels": [], "action": 1, "name": "right"}
    assert answer["policy_left_out"] == 0
    text = run("solve", folder, "--print-policy", "--policy-rows", "2").stdout.splitlines()
    assert text[-4:] == [
        "policy",
        "  2 x=-298 open=false -> right",
        "  3 x=-297 open=true -> on",
        "  1 more state left out; --policy-rows N prints more",
    ]
    answer = rows_of("solve", folder, "--reach", "end")
    assert [row["state"] for row in answer["policy_rows"]] == [2, 3, 4]


def test_a_printed_policy_gets_where_its_chance_leads(tmp_path):
    folder = importers.save(corridor(), tmp_path / "corridor")
    states = {row["state"] for row in rows_of("solve", folder, "--random", "0.5")["policy_rows"]}
    assert states == {0, 1, 2, 3, 4}
    rows = rows_of("solve", folder, "--sticky", "0.25")["policy_rows"]
    assert [(row["state"], row["previous"]) for row in rows] == [(2, None), (3, "right"), (2, "right"), (4, "right")]
    assert all(a != b for a, b in pairwise(rows))
    first = run("solve", folder, "--horizon", "3", "--print-policy").stdout.splitlines()
    assert (
        "policy, of the first of 3 steps" in first and len(first) - first.index("policy, of the first of 3 steps") == 6
    )


def test_the_command_line_takes_expressions_and_lists_what_there_is(tmp_path):
    folder = importers.save(corridor(), tmp_path / "corridor")
    answer = json.loads(run("solve", folder, "--reach", "x>-297 & open", "--json").stdout)["reach"]
    assert (answer["states"], answer["maximum"]["lower"] > 0.999) == (2, True)
    done = run("solve", folder, "--reach", "exit")
    assert done.exit_code == 2
    assert done.stderr.strip() == (
        "pharos: unknown label or variable 'exit'; there are terminal; labels end, none; variables x (-300 to -295), "
        "open (true, false)"
    )


def test_a_page_shows_variables_labels_and_names_of_choices(tmp_path):
    from pharos.explorer import exploration_of

    mdp = corridor()
    world = exploration_of(mdp, env=importers.environment(mdp), gamma=0.9)
    assert world.about()["variables"] == [{"name": "x", "low": -300, "size": 6}, {"name": "open", "low": 0, "size": 2}]
    position = world.position(3)
    assert (position["values"], position["labels"]) == ([-297, 1], [])
    assert [action["name"] for action in position["actions"]] == ["back", "on"]
    assert [each[:1] + each[2:3] for each in position["actions"][1]["outcomes"]] == [[4, 0.75], [2, 0.25]]
    assert world.position(5)["labels"] == ["end"]
    assert world.find("-299, 0") == {"state": 1}
    with pytest.raises(ParameterError, match="no state has the values"):
        world.find("-299, 1")
