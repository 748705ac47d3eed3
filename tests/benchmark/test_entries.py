"""Runs of one task in a file: what is verified, what is refused in one line, and what the page says."""

import dataclasses
import json
import shutil
import signal
import struct

import numpy as np
import pytest

import command_line
import pharos
from patience import PATIENCE
from pharos import benchmark
from pharos.benchmark import verification
from pharos.benchmark.entry_policy import task_key
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted, UntrustedCode
from pharos.system import storage
from pharos.training import read_record, run_id
from refusals import refusal

OWN = """
from dataclasses import dataclass
from pathlib import Path
from pharos import Environment
Path(__file__).with_name("executed").touch()

@dataclass(frozen=True, kw_only=True)
class Two(Environment):
    "Two cells."
    name = "two_cells"
    actions = ("stay", "go")
    max_episode_steps = 3
    def variables(self):
        return {"cell": range(2)}
    def initial_state(self):
        return (0,)
    def transition(self, state, action, out):
        out[0] = action
    def is_terminal(self, state):
        return state[0] == 1
    def reward(self, state, action, next_state):
        return 1.0 * next_state[0]
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of Q-learning on 9 cells with random actions."""
    folder = tmp_path_factory.mktemp("runs") / "grid"
    pharos.train("q_learning", "simple_grid", height=3, width=3, steps=2000, random=0.1, out=folder)
    return folder


@pytest.fixture(scope="module")
def entry(run):
    """What it submits."""
    return benchmark.read(benchmark.submit(run, run.parent / "grid.safetensors", author="A. Turing"))


@pytest.fixture
def file(entry, tmp_path):
    """The file of the entry, one for each test."""
    entry.write(tmp_path / "grid.safetensors")
    return tmp_path / "grid.safetensors"


def changed(entry, file, **changes):
    """The file with another entry, with digests that fit."""
    dataclasses.replace(entry, **changes).write(file)
    return file


def test_what_a_table_claims_is_computed_again(run, file):
    result, verdict = json.loads((run / "run.json").read_text())["result"], benchmark.verify(file)
    assert verdict.holds and verdict.exact and verdict.states == 9
    assert abs(verdict.value - result["final_value"]) <= verdict.error_bound + 1e-9
    assert abs(verdict.regret - result["final_regret"]) <= 1e-6
    assert [check.name for check in verdict.checks] == ["value", "regret", "value_optimal", "value_uniform"]


def test_a_run_whose_rewards_are_divided_by_their_range_is_computed_again(tmp_path):
    options = {"steps": 500, "scale_rewards": "range", "reward_noise": 0.5}
    pharos.train("q_learning", "simple_grid", height=3, width=3, out=tmp_path / "run", **options)
    assert benchmark.verify(benchmark.submit(tmp_path / "run", tmp_path / "e.safetensors")).holds


def test_the_same_run_gives_the_same_bytes(run, tmp_path):
    one, two = (benchmark.submit(run, tmp_path / f"{k}.safetensors", note="x") for k in range(2))
    assert one.read_bytes() == two.read_bytes()
    assert benchmark.read(one).arrays["policy"].dtype == np.uint8


def test_an_entry_is_a_file_of_safetensors(file):
    length = struct.unpack("<Q", file.read_bytes()[:8])[0]
    header = json.loads(file.read_bytes()[8 : 8 + length])
    assert header["policy"] == {"dtype": "U8", "shape": [9], "data_offsets": [0, 9]}
    assert all(isinstance(text, str) for text in header["__metadata__"].values())


@pytest.mark.parametrize("name", ["value", "regret", "value_optimal", "value_uniform"])
def test_a_claim_that_is_not_true_does_not_hold(entry, file, name):
    claim = dataclasses.replace(entry.claim, **{name: getattr(entry.claim, name) + 1e-4, "error_bound": 1.0})
    verdict = benchmark.verify(changed(entry, file, claim=claim))
    assert not verdict.holds
    assert [check.name for check in verdict.checks if not check.holds] == [name]


def test_another_policy_than_the_one_of_the_claim_does_not_hold(entry, file):
    verdict = benchmark.verify(changed(entry, file, arrays={"policy": np.zeros(9, np.uint8)}))
    assert not verdict.holds and verdict.regret > 0.1


def test_every_byte_that_is_cut_off_or_changed_is_told_in_one_line(file):
    whole = file.read_bytes()
    places = [*range(0, len(whole), 97), len(whole) - 1]
    damaged = [whole[:k] for k in places] + [whole[:k] + bytes([whole[k] ^ 1]) + whole[k + 1 :] for k in places]
    for data in [*damaged, whole + b"\0"]:
        file.write_bytes(data)
        assert "grid.safetensors: " in refusal(FileFormatError, benchmark.read, file)


@pytest.mark.parametrize(
    "place",
    [
        {"dtype": "F64", "shape": [1 << 40], "data_offsets": [0, 9]},
        {"dtype": "F64", "shape": [1 << 62, 1 << 62], "data_offsets": [0, 1 << 127]},
        {"dtype": "U8", "shape": [-9], "data_offsets": [0, 9]},
        {"dtype": "object", "shape": [9], "data_offsets": [0, 9]},
        {"dtype": "U8", "shape": [4], "data_offsets": [5, 9]},
        {"dtype": "U8", "shape": "9", "data_offsets": [0, 9]},
    ],
)
def test_sizes_are_held_against_the_file_before_anything_is_allocated(file, place):
    data = file.read_bytes()
    length = struct.unpack("<Q", data[:8])[0]
    header = {**json.loads(data[8 : 8 + length]), "policy": place}
    text = json.dumps(header).encode()
    file.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + length :])
    assert "cut short or changed" in refusal(ResultCorrupted, benchmark.read, file)
    file.write_bytes(struct.pack("<Q", 1 << 60) + data[8:])
    assert "its header would have" in refusal(FileFormatError, benchmark.read, file)


@pytest.mark.parametrize("text", ["\x1b[2J", "left\u202eright", "\ud800", "x" * 3000])
def test_texts_that_would_not_be_shown_as_they_are_are_refused(entry, run, file, text):
    with pytest.raises(FileFormatError, match=r"its author|its record is damaged"):
        benchmark.read(changed(entry, file, author=text))
    with pytest.raises(ParameterError):
        benchmark.submit(run, file, author=text)
    assert not file.exists()


def test_tables_that_are_none_of_the_task_are_refused(entry, file):
    for table in (np.full(9, 7, np.uint8), np.zeros(8, np.uint8), np.zeros((9, 2))):
        with pytest.raises((FileFormatError, pharos.errors.StateSpaceTooLarge), match=r"grid\.safetensors: "):
            benchmark.verify(changed(entry, file, arrays={"policy": table}))


@pytest.mark.parametrize("name", ["parameters", "observation_options", "hyperparameters", "environment", "chance"])
def test_a_configuration_of_other_types_is_refused_in_one_line(entry, file, name):
    for odd in (None, 0, "x", [1], ""):
        config = dataclasses.replace(entry.config)
        stated = {**entry.config.to_dict(), name: odd}
        if stated[name] == "x" and name == "environment":
            continue
        object.__setattr__(config, "to_dict", lambda stated=stated: stated)
        with pytest.raises((FileFormatError, UntrustedCode)) as told:
            benchmark.verify(changed(entry, file, config=config))
        assert "\n" not in str(told.value) and "grid.safetensors: " in str(told.value)


def test_another_version_of_the_rules_is_another_mdp(entry, file):
    with pytest.raises(FileFormatError, match="version 99 of the rules of simple_grid"):
        benchmark.verify(changed(entry, file, rules_version=99))


@pytest.mark.parametrize(
    ("part", "name"),
    [("environment", "evil.py:Two"), ("observation", "evil.py:see"), ("agent", "stable_baselines3.common.utils:os")],
)
def test_names_of_code_are_refused_without_trust(entry, file, part, name):
    config = dataclasses.replace(entry.config, **{part: name})
    assert "--trust" in refusal(UntrustedCode, benchmark.verify, changed(entry, file, config=config))


def test_the_version_of_the_rules_is_that_of_the_run_though_its_class_is_not_loaded(run, entry, tmp_path):
    folder, record = shutil.copytree(run, tmp_path / "run"), read_record(run)
    record["config"]["environment"] = "elsewhere.py:Two"
    record["id"] = run_id(record["config"])
    storage.replace_json(folder / "run.json", storage.sealed(record))
    packed = benchmark.read(benchmark.submit(folder, tmp_path / "again.safetensors"))
    assert packed.rules_version == entry.rules_version == pharos.make("simple_grid").version
    del record["rules_version"]  # of an older run
    storage.replace_json(folder / "run.json", storage.sealed(record))
    with pytest.raises(ParameterError, match="does not say the version of the rules of 'elsewhere"):
        benchmark.submit(folder, tmp_path / "older.safetensors")


@pytest.mark.long
def test_a_world_of_ones_own_is_executed_only_where_it_is_trusted(tmp_path, monkeypatch):
    (tmp_path / "two.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    pharos.train("q_learning", "two.py:Two", steps=200, out="run")
    file = benchmark.submit("run", "two.safetensors")
    (tmp_path / "executed").unlink()
    pharos.system.sources._MODULES.clear()
    pharos.system.sources._LOADED.clear()
    with pytest.raises(UntrustedCode, match=r"two\.py:Two.*--trust"):
        benchmark.verify(file)
    assert not (tmp_path / "executed").exists()
    assert benchmark.verify(file, trust=True).holds
    assert (tmp_path / "executed").exists()


def test_an_estimate_says_that_it_is_one_and_holds_within_its_interval(entry, file):
    exact = benchmark.verify(file)
    claim = dataclasses.replace(entry.claim, exact=False, error_bound=0.2)
    verdict = benchmark.verify(changed(entry, file, claim=claim), max_reached=1)
    assert verdict.holds and not verdict.exact and verdict.episodes == 2000
    assert abs(verdict.value - exact.value) <= verdict.error_bound
    assert "estimated from 2,000 episodes" in command_line.run("benchmark", "verify", file, "--max-reached", 1).stdout
    overstated = benchmark.verify(changed(entry, file, claim=entry.claim), max_reached=1)
    assert "is an estimate here" in overstated.refused["exact"] and not overstated.holds


def test_the_command_line_packs_verifies_and_tells(run, entry, file, tmp_path):
    out = tmp_path / "mine.safetensors"
    answer = json.loads(command_line.run("benchmark", "submit", run, "--out", out, "--name", "mine", "--json").stdout)
    assert answer["id"] == entry.id and answer["bytes"] == out.stat().st_size
    done = command_line.run("benchmark", "verify", out)
    assert done.exit_code == 0 and "the claim holds" in done.stdout and "exact: evaluated in 9 states" in done.stdout
    changed(entry, file, claim=dataclasses.replace(entry.claim, value=2.0))
    failed = command_line.run("benchmark", "verify", file, "--json")
    assert failed.exit_code == 1 and not json.loads(failed.stdout)["checks"]["value"]["holds"]
    out.write_bytes(out.read_bytes()[:-1])
    both = command_line.run("benchmark", "verify", out, file)
    assert both.exit_code == 1 and "FAILS" in both.stdout
    cut = command_line.run("benchmark", "verify", out)
    assert cut.exit_code == 1 and len(cut.stderr.splitlines()) == 1 and "cut short" in cut.stderr
    assert command_line.run("benchmark", "verify", tmp_path / "none.safetensors").exit_code == 2


def test_the_page_ranks_what_was_computed_and_escapes_what_it_shows(entry, tmp_path):
    folder = tmp_path / "entries"
    folder.mkdir()
    evil = "<img src=x onerror=alert(1)>"
    changed(entry, folder / "good.safetensors", name=evil, author='"><script>', note='" onmouseover="x')
    changed(entry, folder / "liar.safetensors", claim=dataclasses.replace(entry.claim, value=9.0, regret=-8.0))
    (folder / "cut<b>.safetensors").write_bytes(b"abc")
    made = benchmark.board(folder, tmp_path / "board.html", title="<i>")
    page = made.file.read_text()
    assert len(made.verified) == 1 and set(made.refused) == {"liar.safetensors", "cut<b>.safetensors"}
    assert "value: " in made.refused["liar.safetensors"] and "9 claimed" in made.refused["liar.safetensors"]
    for wrong in (evil, '"><script>', '" onmouseover="x', "<i>", "cut<b>", "http"):
        assert wrong not in page.replace("http-equiv", "")
    assert page.count("<script>") == 1 and "&lt;img src=x" in page and "A. Turing" not in page
    assert "script-src 'sha256-" in page
    identity = made.verified[0].entry.id  # the whole of it would be cut off at the edge of the card
    assert f'title="{identity}, seed 0,' in page and f">{identity[:8]}</td>" in page and f">{identity}<" not in page
    (tmp_path / "empty").mkdir()
    with pytest.raises(ParameterError, match="a board has no files"):
        benchmark.board(tmp_path / "empty", tmp_path / "board.html")


def reworded(file, edit):
    """The file with another record, with digests that fit, as whoever forges one would write it."""
    data = file.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    record = json.loads(header["__metadata__"]["pharos"])
    edit(record)
    record["id"] = run_id(record["config"])
    header["__metadata__"]["pharos"] = json.dumps(storage.sealed(record), sort_keys=True)
    head = json.dumps(header).encode()
    file.write_bytes(struct.pack("<Q", len(head)) + head + data[8 + length :])
    return file


def endless(*_):
    signal.setitimer(signal.ITIMER_REAL, 1e-3, 1.0)  # the limit comes earlier than it was set for
    while True:
        pass


def test_one_hostile_entry_costs_its_own_row(entry, tmp_path, monkeypatch):
    folder = tmp_path / "entries"
    folder.mkdir()
    huge = 10**400
    edits = {
        "value": lambda record: record["claim"].update(value=huge),
        "bound": lambda record: record["claim"].update(error_bound=huge),
        "gamma": lambda record: record["config"].update(gamma=huge),
        "learning": lambda record: record["training"].update(normalized_regret=huge),
        "horizon": lambda record: record["config"].update(horizon=10**9),
        "chance": lambda record: record["config"]["chance"].update(sticky=1e-300),
        "bug": lambda record: record.update(name="bug"),
        "slow": lambda record: record.update(name="slow"),
    }
    for name, edit in edits.items():
        entry.write(folder / f"{name}.safetensors")
        reworded(folder / f"{name}.safetensors", edit)
    entry.write(folder / "good.safetensors")
    usual = verification.policy_of

    def policy_of(entry, *given, **options):
        if entry.name == "q_learning":
            return usual(entry, *given, **options)
        return {"bug": dict.pop, "slow": endless}[entry.name]({}, "it is not there")

    monkeypatch.setattr(verification, "policy_of", policy_of)
    made = benchmark.board(folder, tmp_path / "board.html", max_seconds=PATIENCE)
    assert [verdict.file.name for verdict in made.verified] == ["good.safetensors"]
    said = {name.split(".")[0]: text for name, text in made.refused.items()}
    assert said.keys() == edits.keys() and not any("\n" in text for text in said.values())
    for name in ("value", "bound", "gamma", "learning"):
        assert "expected a finite number" in said[name], said[name]
    assert "expected at most 100,000" in said["horizon"] and "at least 1e-12" in said["chance"]
    assert said["bug"] == "KeyError: 'it is not there'" and said["slow"] == f"takes more than {PATIENCE:g} s"
    several = command_line.run("benchmark", "verify", folder / "bug.safetensors", folder / "good.safetensors")
    assert several.exit_code == 1 and "the claim holds" in several.output and "KeyError" in several.output


def test_one_task_in_several_spellings_is_one_task(entry, tmp_path):
    folder = tmp_path / "entries"
    folder.mkdir()
    for k, change in enumerate(({}, {"gamma": 1}, {"chance": {"sticky": -0.0, "random": 0.1}})):
        entry.write(folder / f"{k}.safetensors")
        reworded(folder / f"{k}.safetensors", lambda record, change=change: record["config"].update(change))
    made = benchmark.board(folder, tmp_path / "board.html")
    assert not made.refused
    assert len({task_key(verdict.entry.config) for verdict in made.verified}) == 1
    assert made.file.read_text().count("<table") == 1


def test_a_copy_under_another_author_is_told_beside_both(entry, tmp_path):
    folder = tmp_path / "entries"
    folder.mkdir()
    for author in ("A. Turing", "A. Copyist"):
        dataclasses.replace(entry, author=author).write(folder / f"{author[3:]}.safetensors")
    other = dataclasses.replace(entry.config, seed=entry.config.seed + 1)  # the same table of another run is no copy
    dataclasses.replace(entry, author="A. Church", config=other).write(folder / "other.safetensors")
    page = benchmark.board(folder, tmp_path / "board.html").file.read_text()
    assert page.count("the same run as") == 2
    assert "A. Turing (the same run as q_learning by A. Copyist)" in page


def test_claims_that_cannot_be_true_do_not_hold(entry, file):
    wide = dataclasses.replace(entry.claim, value=1000.0, regret=-999.0, exact=False, error_bound=1e9)
    verdict = benchmark.verify(changed(entry, file, claim=wide))
    assert all(check.holds for check in verdict.checks) and not verdict.holds
    assert "is larger than the values of policies are apart" in verdict.refused["error_bound"]
    said = command_line.run("benchmark", "verify", file)
    assert said.exit_code == 1 and "is larger than" in said.output and "does not hold" in said.output
    best, slack = entry.claim.value_optimal, 1e-4
    above = dataclasses.replace(entry.claim, value=best + slack, regret=-slack, exact=False, error_bound=slack / 2)
    verdict = benchmark.verify(changed(entry, file, claim=above))
    assert "is above that of the optimal policy" in verdict.refused["value"] and not verdict.holds
    reaches = dataclasses.replace(above, error_bound=2 * slack)
    assert not benchmark.verify(changed(entry, file, claim=reaches)).refused


@pytest.mark.parametrize("text", ["\u3164", "A\u2800", "A\u034f", "\ufe0f", " ", "a" + "\u0301" * 9])
def test_authors_whom_nobody_would_see_are_refused(entry, file, text):
    with pytest.raises(FileFormatError, match=r"printed as nothing|more than 4 accents"):
        benchmark.read(changed(entry, file, author=text))
    assert benchmark.read(changed(entry, file, author="Ngô Bảo Châu")).author


@pytest.mark.parametrize("text", ["\u0410. Turing", "Al\u03bfnzo"])
def test_authors_who_look_like_others_are_refused(entry, file, text):
    with pytest.raises(FileFormatError, match=r"mixes Latin letters with ones that look like them: (CYRILLIC|GREEK)"):
        benchmark.read(changed(entry, file, author=text))
    for fine in ("\u0410\u043b\u0430\u043d", "DQN \u03b1", "A. Turing"):
        assert benchmark.read(changed(entry, file, author=fine)).author == fine


def test_names_are_shown_as_they_are(entry, file):
    changed(entry, file, name="evil:x: on")
    assert "evil:x: on" in command_line.run("benchmark", "verify", file).output


@pytest.mark.long
def test_what_a_network_claims_is_computed_again(tmp_path):
    pytest.importorskip("stable_baselines3")
    options = {"net_arch": [16, 8], "buffer_size": 500}
    pharos.train("dqn", "simple_grid", height=3, width=3, steps=300, hyperparameters=options, out=tmp_path / "run")
    file = benchmark.submit(tmp_path / "run", tmp_path / "dqn.safetensors")
    entry = benchmark.read(file)
    assert not any("optimizer" in name for name in entry.arrays)
    assert benchmark.verify(file).holds
    for given in ({"net_arch": [1 << 20, 1 << 20]}, {"net_arch": [16, 16]}, {"policy_kwargs": {"activation_fn": "x"}}):
        with pytest.raises(FileFormatError, match=r"dqn\.safetensors: its (hyperparameters|policy_kwargs)"):
            benchmark.verify(changed(entry, file, hyperparameters={**entry.hyperparameters, **given}))
    for given in ({"features_extractor_kwargs": {"features_dim": [1]}}, {"net_arch": [-4]}):
        with pytest.raises(FileFormatError, match=r"its features_dim is|its net_arch is"):
            benchmark.verify(changed(entry, file, hyperparameters={**entry.hyperparameters, "policy_kwargs": given}))
    wide = {**entry.arrays, "q_net.q_net.0.bias": np.zeros(1 << 22, np.uint8)}  # 4 MB; the network would take 2 GB
    with pytest.raises(FileFormatError, match=r"ask for layers \[\(8, 4194304\)"):
        benchmark.verify(changed(entry, file, arrays=wide, hyperparameters={"net_arch": [1 << 22, 8]}))
    name = next(iter(entry.arrays))
    missing = {**entry.arrays, name: np.full_like(entry.arrays[name], np.nan)}
    assert "are not finite" in refusal(FileFormatError, benchmark.verify, changed(entry, file, arrays=missing))
    few = dict(list(entry.arrays.items())[1:])
    with pytest.raises(FileFormatError, match=r"its network is none of dqn|does not have"):
        benchmark.verify(changed(entry, file, arrays=few))
