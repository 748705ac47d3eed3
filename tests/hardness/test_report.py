"""The report: names, conventions, what is kept and when it is computed anew; and `pharos hardness`."""

import contextlib
import json

import numpy as np
import pytest

import command_line
import pharos
from pharos import hardness
from pharos.errors import ParameterError, UndefinedMeasure, UnknownName
from pharos.hardness import registry as _registry
from pharos.mdp import TabularMDP
from pharos.system import storage
from refusals import failing, refusal

SUM = "sum_of_reciprocal_gaps"
MEASURES = {"diameter", "start_eccentricity", SUM, f"{SUM}_regularized", "minimal_gap"}


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(_registry, "_MEASURES", dict(_registry._MEASURES))


def corridor(length=5):
    """Right pays at the end; left goes back."""
    states = np.arange(length)
    return TabularMDP.from_arrays(
        np.stack([np.maximum(states - 1, 0), np.append(states[1:], -1)], axis=1),
        np.stack([np.zeros(length), (states == length - 1) * 1.0], axis=1),
        gamma=0.9,
    )


def grid():
    return pharos.build(pharos.make("simple_grid", height=3, width=4)).mdp()


def values(report):
    return {name: result.value for name, result in report.results.items()}


def test_a_report_holds_the_values_of_the_functions():
    mdp = corridor()
    report = hardness.report(mdp)
    solution = pharos.value_iteration(mdp, 1e-9)
    assert set(report.results) >= MEASURES
    assert report["diameter"].value["upper"] == hardness.diameter(mdp).upper == 5
    assert report["start_eccentricity"].value == 5
    assert report["sum_of_reciprocal_gaps"].value == hardness.sum_of_reciprocal_gaps(mdp, solution)
    assert report["minimal_gap"].value == hardness.minimal_gap(mdp, solution)
    assert report.conventions["gamma"] == 0.9
    assert report.conventions["error_bound"] <= 1e-9
    assert all(name in str(report) for name in MEASURES)


def test_a_report_is_plain_json_even_where_a_value_is_infinite():
    stuck = TabularMDP.from_arrays([[0, 1], [1, 1]], [[0.0, 0.0], [0.0, 0.0]])
    report = hardness.report(stuck)
    answer = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert set(answer["infinite"]) >= {"diameter", "minimal_gap"}
    assert answer["measures"]["minimal_gap"] is None
    assert answer["measures"]["diameter"]["unreachable_pairs"] == 1


def test_measures_are_chosen_by_name():
    assert list(hardness.report(corridor(), "minimal_gap, diameter").results) == ["minimal_gap", "diameter"]
    assert list(hardness.report(corridor(), ["diameter"]).results) == ["diameter"]
    assert "did you mean 'diameter'" in refusal(UnknownName, hardness.report, corridor(), "diametre")
    assert "at least one" in refusal(ParameterError, hardness.report, corridor(), [])


def test_a_users_measure_is_one_line():
    hardness.register("density", lambda p: float((p.mdp.rewards != 0).mean()), definition="share of paying transitions")
    report = hardness.report(corridor())
    assert report["density"].value == 0.1
    assert report["density"].definition == "share of paying transitions"
    with pytest.raises(ParameterError, match="measure of pharos"):
        hardness.register("diameter", lambda p: 0.0, definition="mine")
    with pytest.raises(ParameterError, match="letters, digits"):
        hardness.register("my measure", lambda p: 0.0, definition="mine")


def test_an_undefined_measure_says_why_and_the_others_are_there():
    why = "never is defined for nothing: give up"
    hardness.register("never", failing(UndefinedMeasure(why)), definition="nothing")
    report = hardness.report(corridor(), "never,diameter")
    assert report["never"].value is None
    assert report.to_dict()["undefined"] == {"never": why}
    assert report["diameter"].value["exact"]
    assert "--" in report.to_latex()


def test_results_are_kept_beside_the_space_with_what_they_depend_on():
    mdp = grid()
    first = hardness.report(mdp)
    assert not any(result.kept for result in first.results.values())
    again = hardness.report(grid())
    assert {name for name, result in again.results.items() if result.kept} >= MEASURES
    kept = {name for name, result in again.results.items() if result.kept}
    assert all(values(again)[name] == values(first)[name] for name in kept)
    other = hardness.report(mdp.with_gamma(0.5))
    assert other["diameter"].kept
    assert not other["minimal_gap"].kept
    for each in (mdp.with_rewards(mdp.rewards * 2), pharos.sticky_actions(mdp, 0.25)):
        assert not hardness.report(each, "minimal_gap")["minimal_gap"].kept
    assert not hardness.report(mdp, "diameter", restart=False)["diameter"].kept
    assert not hardness.report(mdp, "diameter", keep=False)["diameter"].kept


def test_an_interval_is_computed_anew_with_a_larger_budget():
    mdp, squeezed = grid(), lambda problem: hardness.Interval(0.0, 100 / problem.budget.seconds, exact=False)
    hardness.register("squeezed", squeezed, definition="", version=1)
    assert hardness.report(mdp, "squeezed", budget=10)["squeezed"].value["upper"] == 10
    assert hardness.report(mdp, "squeezed", budget=5)["squeezed"].kept
    assert hardness.report(mdp, "squeezed", budget=20)["squeezed"].value["upper"] == 5


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 1, "results": 3}', '{"format": 2}'])
def test_a_spoilt_file_of_kept_results_is_replaced(text):
    mdp = grid()
    kept = mdp.folder / "hardness.json"
    expected = hardness.report(mdp)["minimal_gap"].value
    kept.write_text(text)
    is_older = '"format": 1' in text  # of a pharos that wrote no digests
    warned = "hardness.json: the file is not as pharos wrote it; it is measured anew"
    with contextlib.nullcontext() if is_older else pytest.warns(UserWarning, match=warned):
        assert hardness.report(mdp)["minimal_gap"].value == expected
    assert hardness.report(mdp)["minimal_gap"].kept


def test_a_horizon_must_be_a_number_of_steps():
    for horizon in (0, -1, 2.5, True, 2**31):
        assert "whole number of steps" in refusal(ParameterError, hardness.report, corridor(), horizon=horizon)


def run(*words):
    return command_line.run("hardness", *words, env={"COLUMNS": "160"})


def test_the_command_answers_with_the_keys_of_its_contract():
    answer = json.loads(run("simple_grid", "height=3", "width=4", "--json").stdout)
    assert {"measures", "conventions", "seconds"} <= set(answer)
    assert set(answer["measures"]) >= MEASURES
    assert {"lower", "upper", "exact"} <= set(answer["measures"]["diameter"])
    mdp = grid()
    assert answer["measures"]["minimal_gap"] == pytest.approx(hardness.minimal_gap(mdp))
    assert answer["conventions"]["gamma"] == 0.99


def test_the_command_prints_a_table_with_sources_or_latex():
    table = run("simple_grid", "--definitions")
    assert table.exit_code == 0
    assert "Simchowitz" in table.stdout
    assert "16 states x 4 actions" in table.stdout
    latex = run("simple_grid", "--latex").stdout
    assert latex.startswith(r"\begin{tabular}")
    assert "start eccentricity & 6" in latex


def test_the_command_refuses_unknown_measures_before_it_builds():
    command_line.usage_error("hardness", "breakout", "--measures", "diametr")


# What is proven -------------------------------------------------------------------------------------------------------


def test_every_measure_says_what_is_proven_of_it():
    answer = hardness.report(corridor(), horizon=10).to_dict()
    certificates = answer["certificates"]
    assert set(certificates) == set(answer["measures"]) - set(answer["undefined"])
    for name in MEASURES - {"diameter"}:
        assert certificates[name]["kind"] == "exact" and answer["details"][name]["exact"]
        assert certificates[name]["lower"] <= answer["measures"][name] <= certificates[name]["upper"]
    assert certificates["effective_horizon"]["kind"] == "float64"
    assert not answer["details"]["effective_horizon"]["exact"]
    assert certificates["minimal_gap"]["unresolved_ties"] == 0
    assert 0 < certificates["minimal_gap"]["tie_tolerance"] < 1e-6


def test_a_number_of_a_users_measure_is_not_called_exact():
    hardness.register("third", lambda p: 1 / 3, definition="")
    hardness.register("half", lambda p: hardness.Certified(0.5, 0.5, 0.5, True), definition="")
    report = hardness.report(corridor(), "third,half")
    assert (report["third"].certificate.kind, report["half"].certificate.kind) == ("float64", "exact")
    assert report["half"].value == 0.5
    table = run("simple_grid", "--measures", "third,half").stdout
    assert "float64" in table and "yes" in table


def test_ties_that_are_not_resolved_are_printed():
    """Under random actions the ways round an empty grid have equal values, which rounding tells apart."""
    answer = json.loads(run("simple_grid", "--random", "0.3", "--measures", "minimal_gap", "--json").stdout)
    certificate = answer["certificates"]["minimal_gap"]
    assert certificate["unresolved_ties"] > 0 and certificate["kind"] == "interval"
    table = run("simple_grid", "--random", "0.3", "--measures", "sum_of_reciprocal_gaps,minimal_gap").stdout
    assert "at least" in table and "are not resolved" in table


def test_values_that_floats_cannot_hold_leave_the_other_measures():
    mdp = TabularMDP.from_arrays([[0, 1], [1, 0]], [[1.5e308, 0.0], [0.0, 1.5e308]], gamma=0.5)
    report = hardness.report(mdp, "minimal_gap,diameter")
    assert "64-bit floats" in report["minimal_gap"].undefined
    assert report["diameter"].value["upper"] == 1


def test_reasons_stand_below_the_table():
    lines = run("simple_grid").stdout.splitlines()
    row = next(line for line in lines if line.startswith("effective_horizon"))
    assert row.split()[1] == "undefined" and "give a horizon" not in row
    assert any("effective_horizon is defined for episodes of T steps: give a horizon" in line for line in lines)


# Kept results ---------------------------------------------------------------------------------------------------------


def edited(path, change):
    kept = json.loads(path.read_text())
    change(kept["results"])
    path.write_text(json.dumps(kept))


@pytest.mark.parametrize("digit", range(10))
def test_a_digit_that_was_edited_is_measured_anew(digit):
    mdp = grid()
    expected = hardness.report(mdp, "diameter")["diameter"].value
    path = mdp.folder / "hardness.json"

    def change(results):
        for entry in results.values():
            entry["content"] = entry["content"].replace(str(int(expected["upper"])), str(digit))

    edited(path, change)
    if digit == expected["upper"]:
        assert hardness.report(mdp, "diameter")["diameter"].kept
        return
    with pytest.warns(UserWarning, match="the result of diameter is not as pharos wrote it; it is measured anew"):
        again = hardness.report(mdp, "diameter")["diameter"]
    assert again.value == expected and not again.kept
    assert hardness.report(mdp, "diameter")["diameter"].kept


def test_kept_results_say_how_wrong_their_values_may_be():
    mdp = grid()
    first = hardness.report(mdp)
    again = hardness.report(mdp)
    assert again["minimal_gap"].kept
    assert again.conventions["error_bound"] == first.conventions["error_bound"] > 0
    assert "error_bound" not in hardness.report(mdp, "diameter").conventions


def test_results_of_an_older_pharos_without_an_error_bound_are_measured_anew():
    mdp = grid()
    first = hardness.report(mdp)

    def older(results):
        for key, entry in results.items():
            content = json.loads(entry["content"])
            del content["error_bound"]
            results[key] = storage.sealed({"key": key, "content": json.dumps(content)})

    edited(mdp.folder / "hardness.json", older)
    again = hardness.report(mdp)
    assert not again["minimal_gap"].kept
    assert again.conventions["error_bound"] == first.conventions["error_bound"]
    assert hardness.report(mdp)["minimal_gap"].kept


def test_results_of_another_space_are_not_taken():
    """The same chance, start and restart: without the manifest, the diameter of one would be that of the other."""
    small, large = grid(), pharos.build(pharos.make("simple_grid", height=5, width=5)).mdp()
    hardness.report(small, "diameter")
    (large.folder / "hardness.json").write_bytes((small.folder / "hardness.json").read_bytes())
    found = hardness.report(large, "diameter")["diameter"]
    assert found.value["upper"] == hardness.diameter(large).upper != hardness.diameter(small).upper


def test_entries_that_were_swapped_are_measured_anew():
    mdp = grid()
    names = "start_eccentricity,sum_of_reciprocal_gaps"
    first = hardness.report(mdp, names)

    def swap(results):
        (one, a), (other, b) = results.items()
        results[one], results[other] = b, a

    edited(mdp.folder / "hardness.json", swap)
    with pytest.warns(UserWarning, match="not as pharos wrote it"):
        again = hardness.report(mdp, names)
    assert values(again) == values(first)


def test_a_file_that_was_cut_short_is_measured_anew_with_one_line():
    mdp = grid()
    expected = values(hardness.report(mdp))
    path = mdp.folder / "hardness.json"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.warns(UserWarning, match="it is measured anew") as caught:
        again = hardness.report(mdp)
    assert len(caught) == 1
    assert values(again) == expected


def test_an_interval_with_its_ends_the_wrong_way_round_is_never_made():
    assert "must not exceed" in refusal(ValueError, hardness.Interval, 2147483647.0, 176.0, exact=True)
