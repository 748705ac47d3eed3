"""The command line: what it answers, in JSON and for people, and how it fails."""

import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import threading

import numpy as np
import pytest
from rich.console import Console

import command_line
from patience import PATIENCE, wait_for
from pharos import TabularMDP, build, hardness, importers
from pharos.cli import answers
from pharos.cli.options import parse_parameters, parse_size, parse_value
from pharos.cli.render import Game
from pharos.environments import classes, make, named_instances
from pharos.errors import ParameterError
from refusals import failing
from worlds import Corridor, Row, code_of

ENTRIES = ["State", "Start", "Actions", "Chance", "Reward", "Ends", "Limit", "Ours", "Source"]
BUILD_KEYS = {
    *("environment", "parameters", "num_states", "num_actions", "num_terminal_states", "depth"),
    *("seconds", "states_per_second", "peak_memory_bytes", "bytes_on_disk", "folder"),
}
GRID = ("build", "simple_grid", "height=3", "width=5")


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """One cache for all tests here, so that rules are compiled once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def pharos(cache, monkeypatch):
    """Run the command line in this process."""
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(cache))
    return command_line.run


@pytest.fixture
def answer(pharos):
    """Run a command with --json and return the object it prints."""
    return command_line.answer


@pytest.fixture
def failure(pharos):
    """Run a command that fails and return its exit code and the one line that it says."""

    def run(*words):
        result = pharos(*words)
        assert result.stdout == ""
        assert result.stderr.count("\n") == 1
        assert result.stderr.startswith("pharos: ")
        return result.exit_code, result.stderr

    return run


# Parameters ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("12", 12),
        ("-3", -3),
        ("0.25", 0.25),
        ("1e-3", 0.001),
        ("true", True),
        ("False", False),
        ("none", None),
        ("null", None),
        ("1,2,3", (1, 2, 3)),
        ("(3,3)", (3, 3)),
        ("[[[1,1],-1]]", (((1, 1), -1),)),
        ("SFFF/FHFG", "SFFF/FHFG"),
        ("2,2:0.1; 0,3:0.5", "2,2:0.1; 0,3:0.5"),
        ('"12"', "12"),
        ("", ""),
    ],
)
def test_values_are_read_as_python_or_json_writes_them(text, value):
    read = parse_value(text)
    assert read == value
    assert type(read) is type(value)


def test_parameters_are_names_and_values():
    assert parse_parameters(["height=12", "map=S=G"]) == {"height": 12, "map": "S=G"}


@pytest.mark.parametrize("words", [["height"], ["=3"], ["a b=3"], ["height=3", "height=4"]])
def test_what_is_no_parameter_is_refused(words):
    with pytest.raises(ParameterError):
        parse_parameters(words)


@pytest.mark.parametrize(
    ("text", "size"),
    [("2GiB", 2**31), ("500MB", 5 * 10**8), ("1.5g", 15 * 10**8), ("64 KiB", 65536), ("4096", 4096), ("1TiB", 2**40)],
)
def test_sizes_are_read_with_their_units(text, size):
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "GiB", "2XB", "-1GB", "1..5G", "2GiBs"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(ParameterError, match="expected a size"):
        parse_size(text)


# list, build, cache --------------------------------------------------------------------------------------------------


def test_list_names_every_environment_with_its_parameters(answer, pharos):
    found = {each["name"]: each for each in answer("list")["environments"]}
    assert set(found) >= {"simple_grid", "frozen_lake", "freeway", "breakout"}
    assert found["breakout"]["parameters"]["height"] == 12
    assert found["breakout"]["instances"]["breakout/12x10x1"]["columns"] == 10
    shown = pharos("list").stdout
    assert "breakout" in shown and "brick_rows=2" in shown and "24x10x3" in shown


@pytest.mark.parametrize("name", sorted(classes()))
def test_list_describes_one_class_parameter_by_parameter(answer, pharos, name):
    described = answer("list", name)
    assert described["name"] == name and "Actions" in described["rules"]
    for each in described["parameters"].values():
        assert each["meaning"] and each["values"] and "default" in each
    shown = pharos("list", name).stdout
    assert "values" in shown and all(parameter in shown for parameter in described["parameters"])


@pytest.mark.parametrize("name", sorted(named_instances()))
def test_what_names_an_environment_in_an_answer_is_how_the_command_line_is_given_it(name):
    env = make(name)
    called, *words = shlex.split(answers.describe(env))
    assert make(called, **parse_parameters(words)) == env
    assert not any(word.endswith(("=None", "=null", "=True")) for word in words)


def test_list_folds_rules_at_the_width_of_the_terminal(pharos, monkeypatch):
    monkeypatch.setenv("COLUMNS", "72")
    lines = [line.rstrip() for line in pharos("list", "game_2048").stdout.splitlines()]
    rules = lines[: lines.index(next(line for line in lines if line.startswith("parameter ")))]
    assert max(map(len, rules)) <= 72
    entries = [line for line in rules[3:-3] if line]
    assert all(line[:9].strip() in ("", *ENTRIES) and line[9] != " " for line in entries)
    assert [line[:9].strip() for line in entries if line[0] != " "] == ENTRIES
    assert rules[-3:] == [
        "Every move adds what appears to the sum of the tiles, the age of a",
        "state: so no state is visited twice.",
        "",
    ]


def test_list_says_type_range_default_and_meaning(answer):
    lake = answer("list", "frozen_lake/8x8")["parameters"]
    assert lake["seed"]["values"] == "integer >= 0"
    assert lake["frozen_probability"] == {
        "default": 0.8,
        "values": "number in [0, 1]",
        "meaning": "of each tile of a random map to be ice, in (0, 1], as in Gymnasium 0.8.",
    }
    assert answer("list", "freeway")["parameters"]["directions"]["values"] == "integers, each 1 (right) or -1 (left)"


def test_a_list_in_a_pipe_has_no_trailing_blanks(pharos):
    lines = pharos("list").stdout.splitlines()
    assert len(lines) > 20 and [line for line in lines if line != line.rstrip()] == []


@pytest.mark.long
def test_help_is_a_verb_and_shows_no_type_beside_flags(pharos):
    for words in (["help"], ["help", "train"], ["study", "run", "-h"], []):
        shown = pharos(*words)
        assert shown.exit_code == 0 and "<bool>" not in shown.stdout
    assert "pharos train" in pharos("help", "train").stdout
    assert pharos("help", "nothing").exit_code == 2


def test_an_unknown_environment_gets_the_classes_and_the_verb_that_lists_them(pharos):
    done = pharos("build", "QbertNoFrameskip-v4")
    assert (done.exit_code, done.stdout) == (2, "")
    known = ", ".join(sorted(classes()))
    assert done.stderr.endswith(f"known: {known}; `pharos list` shows their parameters and named instances\n")
    assert "did you mean 'breakout'" in pharos("list", "brekout").stderr


def test_slippery_ice_is_found_where_it_is(pharos):
    done = pharos("solve", "frozen_lake", "is_slippery=true")
    assert done.exit_code == 2
    assert "unknown parameter 'is_slippery' of frozen_lake: it is called slippery here" in done.stderr


@pytest.mark.long
@pytest.mark.parametrize(("words", "expected"), [("pharos sol", "solve"), ("pharos solve --hor", "--horizon")])
def test_the_shell_completes_verbs_and_options(monkeypatch, words, expected):
    monkeypatch.setenv("_PHAROS_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    assert command_line.process().stdout.split() == [expected]


def test_a_progress_bar_says_what_happens_before_anything_is_counted(monkeypatch):
    screen = Console(file=io.StringIO(), force_terminal=True, width=120)
    monkeypatch.setattr(answers, "console", lambda stderr=False: screen)
    with answers.progress_bar("training", 20_000, "loading, building, compiling, first evaluation"):
        pass
    assert "0/20000" in screen.file.getvalue() and "first evaluation" in screen.file.getvalue()


def test_slow_work_is_told_after_ten_seconds_and_ever_more_seldom(monkeypatch, capsys):
    monkeypatch.setattr(answers, "SLOW_AFTER", 10.0)
    now = [0.0]
    work = answers.SlowWork("measuring", clock=lambda: now[0])
    work.text = "diameter  between 3 and 9"
    lines = []
    for now[0] in map(float, range(300)):
        work.report_if_due()
        if line := capsys.readouterr().err:
            lines.append((now[0], line))
    assert [seconds for seconds, _ in lines] == [10, 20, 40, 80, 140, 200, 260]
    assert lines[1][1] == "pharos: measuring: diameter between 3 and 9, 20 s so far\n"


def test_work_outside_a_terminal_is_watched_while_it_lasts(monkeypatch, capsys):
    told = threading.Event()
    monkeypatch.setattr(answers, "SLOW_AFTER", 0.0)
    monkeypatch.setattr(answers, "complain", lambda line: told.set() if "far along" in line else None)
    with answers.progress_line("measuring") as tell:
        tell("far along")
        assert told.wait(PATIENCE)
    assert capsys.readouterr() == ("", "")


def test_a_growing_table_prints_each_row_at_once_and_keeps_its_columns(capsys):
    table = answers.GrowingTable({"measure": 8, "value": 10, ">seconds": 7})
    table.add(["diameter", "7", "0.25"])
    first = capsys.readouterr().out
    table.add(["gap", "between 1 and 2", "10.00"])
    assert first.splitlines() == ["measure   value       seconds", "diameter  7              0.25"]
    assert capsys.readouterr().out.splitlines() == ["gap       between 1     10.00", "          and 2"]


@pytest.mark.slow
def test_build_answers_with_the_keys_of_its_contract(answer, tmp_path):
    built = answer(*GRID, "--out", tmp_path / "grid", "--memory", "1GiB", "--workers", 1)
    assert set(built) >= BUILD_KEYS
    assert (built["num_states"], built["num_actions"], built["num_terminal_states"], built["depth"]) == (15, 4, 1, 6)
    assert built["parameters"]["width"] == 5
    assert built["folder"] == str(tmp_path / "grid")
    assert built["bytes_on_disk"] == sum(file.stat().st_size for file in (tmp_path / "grid").iterdir())
    again = answer(*GRID, "--out", tmp_path / "grid")
    assert (built["found"], again["found"]) == (False, True)


def test_a_built_folder_is_a_target(answer, tmp_path):
    built = answer("build", "simple_grid", "penalties=[[[1,1],-1]]", "--out", tmp_path / "grid")
    again = answer("build", tmp_path / "grid", "--out", tmp_path / "copy")
    assert again["parameters"] == built["parameters"]
    assert again["parameters"]["penalties"] == [[[1, 1], -1.0]]


@pytest.mark.long
def test_a_users_own_class_is_a_target(answer, tmp_path, monkeypatch):
    (tmp_path / "corridor_of_mine.py").write_text(code_of(Row, Corridor))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    built = answer("build", "corridor_of_mine:Corridor", "length=9")
    assert (built["num_states"], built["depth"]) == (9, 8)


def test_the_cache_is_listed_and_cleared(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    assert command_line.answer("cache", "list")["spaces"] == []
    for words in (["simple_grid"], ["simple_grid", "height=5"]):
        assert command_line.run("build", *words).exit_code == 0
    (tmp_path / "compiled").mkdir(exist_ok=True)
    (tmp_path / "compiled" / "rules.py").write_text("pass")
    listed = command_line.answer("cache", "list")
    assert sorted(space["num_states"] for space in listed["spaces"]) == [16, 20]
    assert listed["total_bytes"] == sum(file.stat().st_size for file in tmp_path.rglob("*") if file.is_file())
    assert len(command_line.answer("cache", "clear", "simple_grid")["removed"]) == 2
    assert list((tmp_path / "spaces").iterdir()) == []
    assert (tmp_path / "compiled").is_dir()
    assert command_line.run("cache", "clear").exit_code == 0
    assert not (tmp_path / "compiled").exists()


def test_only_state_spaces_are_cleared(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    spaces, elsewhere = tmp_path / "spaces", tmp_path / "elsewhere"
    assert command_line.run("build", "simple_grid").exit_code == 0
    (own,) = spaces.iterdir()
    (spaces / "photos").mkdir()
    (spaces / "photos" / "a.jpg").touch()
    shutil.copytree(spaces / "photos", spaces / f"photos-{'0' * 16}")
    shutil.copytree(own, elsewhere)
    (spaces / f"linked-{'0' * 16}").symlink_to(elsewhere)
    before = set(spaces.iterdir())
    assert command_line.answer("cache", "clear")["removed"] == [str(own)]
    assert set(spaces.iterdir()) == before - {own} and (elsewhere / "manifest.json").exists()


def test_compiled_rules_in_the_folder_of_ones_own_are_listed_and_cleared(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path))
    mine, anothers = tmp_path / f"compiled-{os.getuid()}", tmp_path / f"compiled-{os.getuid() + 1}"
    for folder in (mine, anothers):
        folder.mkdir()
        (folder / "kernel").write_bytes(bytes(1000))
    assert command_line.answer("cache", "list")["compiled_bytes"] == 1000
    assert command_line.answer("cache", "clear")["bytes_freed"] == 1000
    assert not mine.exists() and anothers.exists()


# solve ---------------------------------------------------------------------------------------------------------------

SOLVE_KEYS = {"value_at_start", "uniform_value_at_start", "error_bound", "sweeps", "seconds", "gamma", "horizon"}


def test_solve_answers_with_the_keys_of_its_contract(answer):
    solved = answer("solve", "simple_grid")
    assert set(solved) >= SOLVE_KEYS
    assert abs(solved["value_at_start"] - 0.99**5) <= solved["error_bound"] <= 1e-6  # six steps, the last one pays
    assert 0 < solved["uniform_value_at_start"] < solved["value_at_start"]
    assert (solved["gamma"], solved["horizon"]) == (0.99, None)


def test_with_a_horizon_values_are_undiscounted_unless_told_otherwise(answer):
    solved = answer("solve", "simple_grid", "--horizon", 6)
    assert (solved["gamma"], solved["horizon"], solved["value_at_start"]) == (1.0, 6, 1.0)
    assert answer("solve", "simple_grid", "--horizon", 5)["value_at_start"] == 0.0
    assert answer("solve", "simple_grid", "--horizon", 6, "--gamma", 0.5)["value_at_start"] == 0.5**5


@pytest.mark.long
def test_solving_until_the_end_and_reaching(answer):
    lake = ("frozen_lake/4x4", "slippery=true")
    solved = answer("solve", *lake, "--objective", "total")
    assert solved["value_at_start"] == pytest.approx(14 / 17, abs=1e-9)
    assert (solved["gamma"], solved["horizon"]) == (1.0, None)
    reached = answer("solve", *lake, "--reach", "15")["reach"]
    assert reached["maximum"]["lower"] <= 14 / 17 <= reached["maximum"]["upper"]
    assert reached["least_cost"] == {"lower": None, "upper": None, "infinite": True}
    assert "no horizon; found --gamma 0.9" in command_line.usage_error(
        "solve", *lake, "--objective", "total", "--gamma", "0.9"
    )
    assert "unknown label or variable 'somewhere'; there are terminal; variables row" in command_line.usage_error(
        "solve", *lake, "--reach", "somewhere"
    )
    assert "no upper limit" in command_line.usage_error(
        "solve", "breakout", "height=7", "columns=3", "--objective", "total"
    )


@pytest.mark.long
def test_the_long_run(answer, tmp_path):
    solved = answer("solve", "endless_sea", "size=4", "--objective", "average", "--out", tmp_path / "sea.npz")
    assert solved["gain_at_start"]["lower"] <= 0.25 <= solved["gain_at_start"]["upper"] < 0.25 + 1e-6
    assert solved["uniform_gain_at_start"]["upper"] < 0.25 and "gamma" not in solved
    with np.load(tmp_path / "sea.npz") as arrays:
        assert arrays["gain_lower"].shape == arrays["bias_upper"].shape == (10,)
        np.save(tmp_path / "sea.npy", arrays["policy"])
    evaluated = answer("evaluate", "endless_sea", "size=4", "--objective", "average", "--policy", tmp_path / "sea.npy")
    assert evaluated["average_regret"]["lower"] == 0 <= evaluated["average_regret"]["upper"] < 1e-6
    assert evaluated["optimal_gain_at_start"] == solved["gain_at_start"]
    assert abs(evaluated["normalized_average_regret"]) < 1e-6
    for command in ("solve", "evaluate"):
        assert "neither a discount nor a horizon" in command_line.usage_error(
            command, "endless_sea", "--objective", "average", "--gamma", "0.9"
        )


@pytest.mark.long
def test_solving_a_folder_is_solving_its_environment(answer, tmp_path):
    answer("build", "breakout", "height=7", "columns=3", "--out", tmp_path / "court")
    options = ("--sticky", 0.25, "--random", 0.1)
    targets = (["breakout", "height=7", "columns=3"], [tmp_path / "court"])
    solved = [answer("solve", *target, *options) for target in targets]
    for key in SOLVE_KEYS - {"seconds"}:
        assert solved[0][key] == solved[1][key]
    assert solved[0]["value_at_start"] < answer("solve", tmp_path / "court")["value_at_start"]


def test_solve_keeps_values_in_a_folder_and_goes_on_from_them(answer, tmp_path):
    words = ("solve", "frozen_lake/4x4", "--values", str(tmp_path / "values"))
    assert answer(*words)["sweeps"] > 1
    assert {path.name for path in (tmp_path / "values").glob("*.npy")} == {"optimal.npy", "uniform.npy"}
    assert answer(*words)["sweeps"] == 1


def test_solve_writes_values_and_policy(answer, tmp_path):
    import numpy as np

    solved = answer("solve", "simple_grid", "--out", tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["v"][0] == solved["value_at_start"]
        assert arrays["policy"].shape == (16,)


def test_solve_speaks_to_people(pharos):
    assert "optimal value at the start" in pharos("solve", "simple_grid").stdout


# render --------------------------------------------------------------------------------------------------------------


def test_render_writes_pictures_and_episodes(answer, tmp_path):
    from PIL import Image

    words = ("--state", "5,1,0,1,3,1,1,1,1,1,1,1,1,0,1,1,1,1,1,1,1", "--out", tmp_path / "a.png")
    state = answer("render", "breakout", "height=8", *words)
    assert state["state"][:5] == [5, 1, 0, 1, 3]
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.format == "PNG" and min(picture.size) > 200
    played = answer("render", "freeway/16x7-speed1", "--out", tmp_path / "a.gif", "--steps", 12, "--policy", "uniform")
    assert played["steps"] == 12
    with Image.open(tmp_path / "a.gif") as episode:
        assert episode.format == "GIF" and episode.n_frames > 2
    assert answer("render", "frozen_lake", "--out", tmp_path / "a.txt")["bytes"] == 20


def test_render_draws_in_the_terminal(pharos):
    shown = pharos("render", "frozen_lake").stdout
    assert [line.split() for line in shown.splitlines()] == [list("A..."), list(".O.O"), list("...O"), list("O..G")]


# Failures ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["build", "brekout"], "did you mean 'breakout'?"),
        (["build", "breakout", "hight=3"], "did you mean 'height'?"),
        (["build", "breakout", "height"], "expected a parameter name=value"),
        (["build", "breakout", "height=two"], "expected an integer of at least"),
        (["build", "breakout", "--memory", "much"], "expected a size"),
        (["build", "breakout", "--workers", "0"], "--workers"),
        (["build", "no_such_module_at_all:World"], "No module named"),
        (["build", "pharos.environments:Breakuot"], "AttributeError"),
        (["build", "./nowhere"], "no such folder or file"),
        (["build"], "Missing argument"),
        (["bild", "breakout"], "No such command 'bild'"),
        (["build", "breakout", "--fast"], "No such option"),
        (["study", "run", "--out"], "requires an argument. (see `pharos study run --help`)"),
        (["build", "breakout", "--shards", "/disk"], "--shards is gone: files stay in one folder"),
        (["solve", "breakout", "--jacobi"], "--jacobi is gone: values of any --processes are within --tolerance"),
        (["render", "breakout", "--observation", "humane"], "did you mean 'human'?"),
        (["render", "breakout", "--out", "a.jpg"], "expected a file name that ends in"),
        (["render", "breakout", "--out", "nowhere/a.png"], "there is no folder"),
        (["render", "breakout", "--state", "1,2"], "expected 21"),
        (["solve", "breakout", "--gamma", "1.5"], "--gamma"),
        (["solve", "simple_grid", "--objective", "total", "--gamma", "0.9"], "no horizon; found --gamma 0.9"),
        (["solve", "nofolder/"], "no such folder"),
        (["solve", "simple_grid", "--tolerance", "0"], "expected a positive number"),
        (["solve", "simple_grid", "--out", "values.txt"], "ends in .npz or .npy"),
        (["cache", "clear", "nothing_like_it"], "unknown environment in the cache"),
    ],
)
def test_bad_usage_is_one_line_and_exit_code_2(failure, words, said):
    code, line = failure(*words)
    assert code == 2
    assert said in line


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["build", "simple_grid", "height=4000000000", "width=4000000000"], 1, "too large: array is too big"),
        (["build", "freeway", f"num_cars={10**30}"], 1, "a number is too large"),
        (["build", "simple_grid", f"penalties=0,1:-{10**400}"], 2, "expected ((row, column), value)"),
        (["train", "frozen_lake/4x4", "--agent", "q_learning", "--steps", 10**24], 2, "of 64 bits"),
    ],
)
def test_numbers_beyond_all_machines_are_one_line(failure, words, code, said):
    found, line = failure(*words)
    assert found == code
    assert said in line


def test_what_fails_is_one_line_and_exit_code_1(failure, tmp_path):
    code, line = failure("build", "simple_grid", "--max-states", 3, "--out", tmp_path / "small")
    assert code == 1
    assert "max_states=3" in line
    (tmp_path / "empty").mkdir()
    code, line = failure("build", tmp_path / "empty")
    assert code == 1
    assert "no state space there" in line


@pytest.mark.parametrize(
    ("raised", "code", "said"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (EOFError("Ran out of input"), 1, "a file ended too early (Ran out of input); if it is compiled code, delete "),
    ],
)
def test_what_ends_a_build_is_one_line_with_its_exit_code(failure, monkeypatch, raised, code, said):
    monkeypatch.setattr("pharos.state_space.build", failing(raised))
    found, line = failure("build", "simple_grid")
    assert found == code and said in line


def test_a_full_or_forbidden_disk_is_one_line(failure, monkeypatch):
    error = PermissionError(13, "Permission denied", "/somewhere")
    monkeypatch.setattr("pharos.state_space.build", failing(error))
    assert failure("build", "simple_grid") == (1, "pharos: /somewhere: Permission denied; choose another place\n")


@pytest.mark.parametrize(
    "command",
    [
        ("train", "river_swim", "--agent", "q_learning", "--steps", "500"),
        ("benchmark", "run", "--agent", "q_learning", "--quick"),
        ("study", "run", "quick"),
    ],
)
def test_a_file_in_the_place_of_a_folder_says_what_to_try(failure, tmp_path, command):
    path = tmp_path / "taken"
    path.write_text("mine", encoding="utf-8")
    code, line = failure(*command, "--out", path)
    assert code == 1 and line == f"pharos: {path}: File exists; expected a folder; choose another name\n"
    assert path.read_text(encoding="utf-8") == "mine"


# As a process --------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_pipe_gets_one_json_object_and_silence_beside_it(cache, tmp_path):
    done = command_line.process(
        "build", "simple_grid", "--out", tmp_path / "grid", "--json", environment={"PHAROS_CACHE_DIR": cache}
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert set(json.loads(done.stdout)) >= BUILD_KEYS


@pytest.mark.slow
def test_exit_codes_reach_the_shell(cache):
    for words, code in ((["build", "brekout"], 2), ([], 0), (["--help"], 0), (["--version"], 0)):
        done = command_line.process(*words, environment={"PHAROS_CACHE_DIR": cache})
        assert done.returncode == code
        assert "Traceback" not in done.stderr


@pytest.mark.long
def test_a_solve_that_is_terminated_says_that_the_same_command_goes_on(cache, tmp_path):
    code = "import time; from pharos import solvers; from pharos.cli import main; import sys; "
    code += f"solvers.value_iteration = lambda *_, **__: (open('began', 'w'), time.sleep({PATIENCE})); "
    code += "sys.argv = ['pharos', 'solve', 'simple_grid']; main()"
    place = {"cwd": tmp_path, "env": {**os.environ, "PHAROS_CACHE_DIR": str(cache)}}
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, **place)
    wait_for((tmp_path / "began").exists, process)
    process.terminate()
    _, said = process.communicate(timeout=PATIENCE)
    assert (process.returncode, said) == (
        143,
        "pharos: interrupted; finished work is kept, and the same command goes on from there\n",
    )


@pytest.mark.long
def test_what_the_environment_lacks_or_forbids_is_a_line(cache):
    for name, value in (("NUMBA_DISABLE_JIT", 1), ("NUMBA_NUM_THREADS", 0)):
        done = command_line.process("solve", "frozen_lake/4x4", environment={"PHAROS_CACHE_DIR": cache, name: value})
        assert done.returncode == 2 and done.stderr.count("\n") == 1 and "NUMBA_" in done.stderr, done.stderr
    for words, code, said in (("list >&-", 0, ""), ("play frozen_lake/4x4 <&-", 1, "pharos: play needs a terminal")):
        line = f"{sys.executable} -m pharos {words}"
        done = subprocess.run(line, shell=True, stderr=subprocess.PIPE, text=True, timeout=PATIENCE, check=False)
        assert done.returncode == done.stderr.count("\n") == code and done.stderr.startswith(said)


@pytest.mark.long
@pytest.mark.parametrize("words", [["list"], ["--help"], ["list", "--json"]])
def test_help_and_list_load_nothing_heavy(words):
    heavy = ("numba", "scipy.stats", "pandas", "matplotlib", "torch")
    code = f"import atexit, os, sys; from pharos.cli import app; heavy = {heavy!r}; "
    code += f"atexit.register(lambda: os._exit(9) if {{*heavy}} & {{*sys.modules}} else None); app({words!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_a_build_with_chance_says_how_many_outcomes_there_are(pharos, tmp_path):
    words = ("build", "frozen_lake", "slippery=true", "--out", tmp_path / "space")
    assert "outcomes     at most 3 of an action, 152 in all" in pharos(*words).stdout
    assert command_line.answer(*words)["num_transitions"] == 152 == 11 * 4 * 3 + 5 * 4


def test_a_game_that_is_played_draws_the_outcomes_of_chance_in_the_rules(monkeypatch):
    game = Game(make("cliff_walking/4x12-slippery"), (3, 0))
    for u, state in ((0.2, (3, 0)), (0.5, (2, 0)), (0.9, (2, 1))):  # up: slips to the left, goes up, slips to the right
        monkeypatch.setattr(game.rng, "random", lambda u=u: u)
        game.press("w")
        assert game.state == state


@pytest.mark.long
@pytest.mark.parametrize("verb", ["solve", "hardness"])
def test_a_world_with_chance_is_not_said_to_have_none(pharos, verb):
    words = [verb, "frozen_lake/4x4", *(["--measures", "minimal_gap"] if verb == "hardness" else [])]
    plain, own, both = (
        " ".join(pharos(*words, *more).stdout.split())
        for more in ([], ["slippery=true"], ["slippery=true", "--random", 0.1])
    )
    assert re.search("chance:? none", plain)
    assert re.search("chance:? of the world", own)
    assert re.search("chance:? of the world, random actions 0.1", both)


def test_hardness_tells_how_many_gaps_are_ties_and_at_which_tolerance(pharos):
    told = pharos("hardness", "frozen_lake/4x4", "--measures", "minimal_gap").stdout
    gaps = hardness.gaps(build(make("frozen_lake/4x4"), progress=False).mdp(gamma=0.99))
    proven = gaps.ties - gaps.unresolved
    assert f"{gaps.ties} ties at a tolerance of {gaps.tie_tolerance:.2g}, {proven} proven" in told


@pytest.mark.long
def test_check_says_whether_there_is_anything_to_learn(tmp_path, monkeypatch):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path / "cache"))
    said = command_line.run("check", "river_swim", "length=5")
    assert said.exit_code == 0
    assert "keeps the contract in all 5 states" in said.stdout and "by uniform play" in said.stdout
    flat = TabularMDP.from_arrays([[1, 1], [0, 0]], [[1.0, 1.0], [0.0, 0.0]], gamma=0.9, horizon=4)
    answer = command_line.answer("check", importers.save(flat, tmp_path / "flat"))
    assert answer["complete"] and answer["values"]["optimal"] == answer["values"]["uniform"]
    assert any("no policy beats uniform play" in note for note in answer["notes"])
    sample = command_line.answer("check", "river_swim", "--max-states", 3)
    assert sample["values"] is None and not sample["complete"]
