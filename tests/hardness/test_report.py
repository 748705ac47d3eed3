"""The report: names, conventions, what is kept and when it is computed anew; and `pharos hardness`."""

import contextlib
import json
from dataclasses import dataclass

import numpy as np
import pytest

import command_line
import pharos
from pharos import Environment, hardness
from pharos.cli import hardness as command
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


@pytest.mark.parametrize(
    ("outcome", "said"),
    [
        ((1.0, 2.0, 3.0, True), "a measure is 1.0, outside of its interval"),
        ((2.5, 2.0, 3.0, True), "calls the interval [2.0, 3.0] exact"),
    ],
)
def test_exact_is_not_printed_of_a_users_measure_that_is_not(outcome, said):
    hardness.register("mine", lambda problem: hardness.Certified(*outcome), definition="mine")
    assert said in refusal(ParameterError, hardness.report, corridor(), "mine")
    hardness.register("fine", lambda problem: hardness.Certified(2.5, 2.0, 3.0, False), definition="mine")
    assert hardness.report(corridor(), "fine")["fine"].certificate.kind == "interval"


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


@pytest.mark.parametrize(
    "learner", [{"sampling": hardness.Sampling(seed=7)}, {"rollouts": hardness.Rollouts()}, {"adam": hardness.Adam()}]
)
def test_what_is_measured_of_the_world_alone_is_kept_whatever_learns(learner):
    mdp, name = grid().with_horizon(20), "stationary_effective_horizon"
    hardness.report(mdp, name)
    seen = hardness.Representation.of_matrix(np.eye(mdp.num_states))
    assert hardness.report(mdp, name, representation=seen, **learner)[name].kept


def test_an_interval_is_computed_anew_with_a_larger_budget():
    mdp, squeezed = grid(), lambda problem: hardness.Interval(0.0, 100 / problem.budget.seconds, exact=False)
    hardness.register("squeezed", squeezed, definition="", version=1)
    assert hardness.report(mdp, "squeezed", budget=10)["squeezed"].value["upper"] == 10
    assert hardness.report(mdp, "squeezed", budget=5)["squeezed"].kept
    assert hardness.report(mdp, "squeezed", budget=20)["squeezed"].value["upper"] == 5


# Budgets --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Lift(Environment):
    """A lift between floors: on each one person may wait for another floor, and the car has one button for each."""

    floors: int = 4
    arrivals: float = 0.3

    name = "people_lift"
    actions = ("down", "up", "doors")

    @property
    def outcomes(self):
        return 1 + self.floors * (self.floors - 1)

    def variables(self):
        waiting, buttons = [range(self.floors)] * self.floors, [range(2)] * self.floors
        return {"floor": range(self.floors), "waiting": waiting, "button": buttons}

    def initial_state(self):
        return (0, *[0] * (2 * self.floors))

    def probability(self, state, action, outcome):
        return 1.0 - self.arrivals if outcome == 0 else self.arrivals / (self.floors * (self.floors - 1))

    def transition(self, state, action, outcome, out):
        floor = state[0]
        if action < 2:
            out[0] = min(max(floor + 2 * action - 1, 0), self.floors - 1)
        else:
            out[1 + self.floors + floor] = 0
            if state[1 + floor] > 0:
                out[1 + floor] = 0
                out[1 + self.floors + (floor + state[1 + floor]) % self.floors] = 1
        if outcome > 0:
            where = (outcome - 1) // (self.floors - 1)
            if out[1 + where] == 0:
                out[1 + where] = 1 + (outcome - 1) % (self.floors - 1)

    def is_terminal(self, state):
        return False

    def reward(self, state, action, next_state):
        waiting = 0
        for floor in range(self.floors):
            if next_state[1 + floor] > 0:
                waiting += 1
        has_arrived = action == 2 and state[1 + self.floors + state[0]] == 1
        return (1 if has_arrived else 0) - 0.1 * waiting


INTERVALS = {"diameter", "start_eccentricity"}


def spent(mdp, names="all", **options):
    """A report whose budget is spent when a measure begins."""
    return hardness.report(mdp, names, budget=0, keep=False, **options)


OF_ONE_PASS: set[str] = set()  # measures that take no time: a budget does not end them


def check_that_all_end(endless):
    endless = endless - OF_ONE_PASS
    assert not endless, (
        f"pass progress=problem.reporter(name) to {endless}; if it takes no time, name it in OF_ONE_PASS"
    )


@pytest.mark.long
def test_a_spent_budget_ends_every_measure_of_a_world_with_chance():
    space = pharos.build(Lift(floors=3), progress=False)
    assert space.num_states == 567
    seen = pharos.observations.representation(space, "vector")
    report = spent(space.mdp(gamma=0.99), horizon=50, representation=seen)
    open_ends = {name for name, result in report.results.items() if result.is_out_of_budget}
    bounded = {name for name, result in report.results.items() if result.certificate.kind == "interval"}
    # what a deterministic MDP alone has says so before any work
    check_that_all_end(set(report.results) - open_ends - bounded - {"tight_effective_horizon"})
    assert "tight_effective_horizon" not in open_ends | bounded
    assert bounded == INTERVALS
    assert all("--budget" in report[name].undefined for name in open_ends)
    assert all("--budget" in report[name].certificate.note for name in bounded)
    diameter = report["diameter"].value
    closer = hardness.diameter(space.mdp(gamma=0.99), budget=hardness.interval.Budget(searches=3))
    assert diameter["lower"] < closer.lower < closer.upper < diameter["upper"]


def test_a_spent_budget_ends_every_measure_of_a_world_without_chance():
    report = spent(grid(), horizon=6, representation=pharos.observations.representation(grid_space(), "vector"))
    ended = {name for name, result in report.results.items() if result.is_out_of_budget}
    certain = {"diameter", "start_eccentricity", "environmental_value_norm"}  # one search; 0 without chance
    check_that_all_end(set(report.results) - ended - certain - {"mixing_time"})
    assert "tight_effective_horizon" in ended and "covering" in ended and "kernel_regret" in ended


def grid_space():
    return pharos.build(pharos.make("simple_grid", height=3, width=4))


def test_values_that_a_budget_has_ended_are_not_tried_again_by_the_next_measure(monkeypatch):
    calls = []

    def counted(*arguments, **options):
        calls.append(1)
        return pharos.value_iteration(*arguments, **options)

    monkeypatch.setattr(_registry, "value_iteration", counted)
    report = spent(corridor(), f"{SUM},minimal_gap,environmental_value_norm")
    assert len(calls) == 1
    assert "optimal values" in report["minimal_gap"].undefined
    assert "error_bound" not in report.conventions


def test_the_budget_is_of_each_measure(monkeypatch):
    clock = [0.0]

    class Watch:
        compiling = 0.0

        def __init__(self):
            self.began = clock[0]

        @property
        def seconds(self):
            return clock[0] - self.began

    def slow(seconds):
        def measure(problem):
            for step in range(seconds):
                clock[0] += 1
                problem.report("slow", f"step {step}")
            return 1.0

        return measure

    monkeypatch.setattr("pharos.hardness.interval.Stopwatch", Watch)
    for name, seconds in (("first", 3), ("second", 5), ("third", 4)):
        hardness.register(name, slow(seconds), definition="")
    report = hardness.report(corridor(), "first,second,third", budget=4.5)
    assert [report[name].value for name in ("first", "second", "third")] == [1.0, None, 1.0]
    assert report["second"].undefined == (
        "not available: the budget of 4.5 s ended at step 4; give a larger one (--budget)"
    )
    assert hardness.report(corridor(), "second")["second"].value == 1.0  # without a budget no loop is ended


def test_each_result_is_told_as_soon_as_it_is_there():
    events = []
    for name in ("first", "second"):
        hardness.register(name, lambda problem, name=name: events.append(name) or 1.0, definition="")
    hardness.report(corridor(), "first,second", on_result=lambda result: events.append(f"row {result.name}"))
    assert events == ["first", "row first", "second", "row second"]


def test_rows_are_printed_as_they_come(monkeypatch):
    printed = []
    monkeypatch.setattr(command._Table, "add", lambda table, result: printed.append(result.name))
    hardness.register("last", lambda problem: float(len(printed)), definition="")
    answer = command_line.run("hardness", "frozen_lake/4x4", "--measures", "diameter,minimal_gap,last")
    assert answer.exit_code == 0 and printed == ["diameter", "minimal_gap", "last"]
    assert command_line.answer("hardness", "frozen_lake/4x4", "--measures", "last")["measures"]["last"] == 3
    assert printed == ["diameter", "minimal_gap", "last"]  # JSON is one object, at the end


def test_the_command_gives_each_measure_thirty_seconds(monkeypatch):
    budgets = []
    hardness.register("asked", lambda problem: budgets.append(problem.budget.seconds) or 1.0, definition="")
    for words in ([], ["--budget", 5]):
        assert command_line.run("hardness", "frozen_lake/4x4", "--measures", "asked", *words).exit_code == 0
    assert budgets == [hardness.interval.COMMAND_SECONDS, 5] == [30, 5]


def test_the_table_has_no_undefined_row_unless_it_was_asked_for():
    rows = command_line.run("hardness", "frozen_lake/4x4").stdout
    assert "undefined" not in rows and "\ncovering" not in rows and "\neffective_horizon " not in rows
    assert "\nstationary_effective_horizon" in rows
    assert "effective_horizon, covering: defined for episodes" in rows
    with_horizon = command_line.run("hardness", "frozen_lake/4x4", "--horizon", 20).stdout
    assert "\neffective_horizon " in with_horizon and "\ncovering" in with_horizon
    assert "stationary" not in with_horizon
    assert "undefined" in command_line.run("hardness", "frozen_lake/4x4", "--measures", "covering").stdout
    answer = command_line.answer("hardness", "frozen_lake/4x4")
    assert answer["measures"]["covering"] is answer["measures"]["effective_horizon"] is None
    assert "give a horizon" in answer["undefined"]["covering"]


def test_the_table_says_what_a_budget_has_ended():
    told = command_line.run("hardness", "frozen_lake/4x4", "--budget", 0, "--fresh").stdout
    assert "not available" in told and "sum_of_reciprocal_gaps, " in told and "--budget" in told


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
    return command_line.run("hardness", *words, "--budget", "inf", env={"COLUMNS": "160"})


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
    lines = run("simple_grid", "--measures", "effective_horizon,diameter").stdout.splitlines()
    row = next(line for line in lines if line.startswith("effective_horizon"))
    assert row.split()[1] == "undefined" and "give a horizon" not in row
    assert "effective_horizon: defined for episodes of T steps: give a horizon" in lines


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
