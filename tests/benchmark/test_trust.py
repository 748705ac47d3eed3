"""What a submission claims, what is verified of it, and what an audit finds; nothing that was received is executed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edits import edited_json, flip
from pharos.benchmark.board import benchmark_board
from pharos.benchmark.commitment import Commitment, make_commitment
from pharos.benchmark.execution import run
from pharos.benchmark.repetition import Audit, drawn_runs, make_audit, prediction_interval
from pharos.benchmark.sealed import frozen
from pharos.benchmark.submission import Submission, submit, verify
from pharos.benchmark.suite import BenchmarkTask, Protocol, Suite, digest_of_suite
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted
from refusals import refusal

PROTOCOL = Protocol(steps=1500, evaluations=3, seeds=5)
SEEDS = range(5)
HONEST = '''
import numpy as np

def learn(env, steps, seed):
    """Plays at random, and then a table of what paid; needs no library."""
    generator = np.random.default_rng(seed)
    paid = {}
    seen, _ = env.reset(seed=seed)
    for step in range(steps):
        key, action = seen.tobytes(), int(generator.integers(env.action_space.n))
        seen, reward, ended, cut, _ = env.step(action)
        paid.setdefault(key, np.zeros(env.action_space.n))[action] += reward
        if ended or cut:
            seen, _ = env.reset()
        if step % 500 == 499:
            none = np.zeros(env.action_space.n)
            yield lambda batch: np.array([int(np.argmax(paid.get(one.tobytes(), none))) for one in batch])
'''


@pytest.fixture(scope="module")
def suite():
    tasks = [
        BenchmarkTask("sea", "deep_sea", {"size": 4, "mapping_seed": 1}, "one_hot"),
        BenchmarkTask("catch", "catch", {"rows": 5, "columns": 3}, "one_hot"),
        BenchmarkTask("chain", "umbrella_chain", {"chain_length": 4}, "vector", chance={"random": 0.1}),
    ]
    made = Suite("small", PROTOCOL, tuple(frozen(task, PROTOCOL) for task in tasks), (), "")
    return replace(made, digest=digest_of_suite(made))


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    file = tmp_path_factory.mktemp("source") / "honest.py"
    file.write_text(HONEST)
    return f"{file}:learn"


@pytest.fixture(scope="module")
def honest(suite, source, tmp_path_factory):
    """(folder, file) of an honest generator's submission, with its commitment."""
    folder = tmp_path_factory.mktemp("honest")
    run(source, suite, out=folder / "runs", seeds=SEEDS, workers=1)
    commitment = make_commitment(source, suite, date="2026-01-01")
    submit(folder / "runs", folder / "it.safetensors", suite, author="A. Uthor", commitment=commitment)
    return folder / "runs", folder / "it.safetensors"


@pytest.fixture(scope="module")
def cheat(suite, honest, tmp_path_factory):
    """The file of a submission with optimal policies and a curve that nobody ran."""
    file = tmp_path_factory.mktemp("cheat") / "cheat.safetensors"
    read = Submission.read(honest[1])
    best = {task.name: task.training_task(PROTOCOL).optimal.policy for task in suite.tasks}
    curves = {name: np.tile([0.5, 0.1, 0.0], (len(curve), 1)) for name, curve in read.results.curves.items()}
    policies = {run: np.asarray(best[run[0]]) for run in read.policies}
    replace(read, results=replace(read.results, curves=curves), policies=policies).write(file)
    return file


def test_an_honest_submission_holds_with_all_its_policies(suite, honest):
    verdict = verify(honest[1], suite)
    assert verdict.holds and not verdict.missing and len(verdict.checks) == 15
    assert verdict.submission.author == "A. Uthor" and verdict.submission.fits()


def test_the_same_submission_has_the_same_bytes(suite, honest, tmp_path):
    submit(honest[0], tmp_path / "again.safetensors", suite, author="A. Uthor",
           commitment=Submission.read(honest[1]).commitment)  # fmt: skip
    assert (tmp_path / "again.safetensors").read_bytes() == honest[1].read_bytes()


def test_one_altered_digit_is_refused(suite, honest, tmp_path):
    data = honest[1].read_bytes()
    for place in (len(data) - 1, len(data) - 700, data.index(b"A. Uthor"), data.index(b"sha256") + 14):
        file = tmp_path / f"{place}.safetensors"
        file.write_bytes(data)
        flip(file, place)
        with pytest.raises((ResultCorrupted, FileFormatError)):
            verify(file, suite)


def test_a_better_last_point_with_new_digests_does_not_hold(suite, honest, tmp_path):
    read = Submission.read(honest[1])
    curves = {name: curve - [0, 0, 1e-4] * (curve[:, -1:] > 0.01) for name, curve in read.results.curves.items()}
    replace(read, results=replace(read.results, curves=curves)).write(tmp_path / "better.safetensors")
    verdict = verify(tmp_path / "better.safetensors", suite)
    wrong = [check for check in verdict.checks if not check.holds]
    assert wrong and not verdict.holds
    assert all(check.found - check.claimed == pytest.approx(1e-4) for check in wrong)


def test_what_is_better_than_optimal_and_what_is_no_policy_is_refused(suite, honest, tmp_path):
    read = Submission.read(honest[1])
    curves = {**read.results.curves, "sea": read.results.curves["sea"] - [2.0, 0, 0]}
    policies = {**read.policies, ("catch", 0): np.full(5, 1), ("catch", 1): np.full((39, 3), 0.5)}
    policies["catch", 2] = np.full_like(read.policies["catch", 2], 7)
    replace(read, results=replace(read.results, curves=curves), policies=policies).write(tmp_path / "no.safetensors")
    verdict = verify(tmp_path / "no.safetensors", suite)
    assert not verdict.holds and {*verdict.refused} >= {"sea", "catch/0", "catch/1", "catch/2"}


def test_another_suite_is_refused(suite, honest):
    assert "name its suite" in refusal(ParameterError, verify, honest[1], replace(suite, name="other", digest="0" * 64))


def test_an_audit_of_an_honest_generator_holds(suite, honest, source, tmp_path):
    dates = {"date": "2026-02-01", "published": "2026-01-02", "round": "2026-01-15"}
    found = make_audit(honest[1], source, suite, **dates, workers=1)
    assert found.holds and found.is_source and found.is_committed
    assert len(found.repeats) == 3 and all(repeat.equal for repeat in found.repeats)
    found.write(tmp_path / "a.json")
    assert Audit.read(tmp_path / "a.json") == found
    with edited_json(tmp_path / "a.json") as entry:
        entry["repeats"][0]["equal"] = False
    assert "changed" in refusal(ResultCorrupted, Audit.read, tmp_path / "a.json")


def test_a_cheat_with_the_policies_of_value_iteration_is_claimed_and_fails_the_audit(suite, cheat, source):
    assert verify(cheat, suite).holds  # nobody can see from policies how they were learnt
    found = make_audit(cheat, source, suite, date="2026-02-01", workers=1)
    assert found.is_source and not found.holds
    assert not any(repeat.equal for repeat in found.repeats)


def test_another_source_is_not_run(suite, honest, source, tmp_path):
    mark = tmp_path / "mark"
    other = tmp_path / "honest.py"
    other.write_text(HONEST + f"\ndef learn(env, steps, seed):\n    open({str(mark)!r}, 'w')\n    yield from ()\n")
    found = make_audit(honest[1], f"{other}:learn", suite, date="2026-02-01", workers=1)
    assert not found.is_source and not found.holds and not found.repeats and not mark.exists()


@pytest.mark.slow
def test_an_honest_table_repeats_to_the_bit(suite, tmp_path):
    run("q_learning", suite, out=tmp_path / "runs", seeds=SEEDS, workers=1)
    submit(tmp_path / "runs", tmp_path / "it.safetensors", suite)
    assert verify(tmp_path / "it.safetensors", suite).holds
    found = make_audit(tmp_path / "it.safetensors", "q_learning", suite, date="2026-02-01", workers=1)
    assert found.holds and all(repeat.equal and repeat.low == repeat.high for repeat in found.repeats)
    assert not found.is_committed


@pytest.mark.slow
def test_an_honest_network_of_the_engine_repeats_to_the_bit(suite, tmp_path):
    pytest.importorskip("torch")
    small = replace(suite, hyperparameters={"dqn": {"learning_starts": 100}})
    run("dqn", small, out=tmp_path / "runs", seeds=range(2), workers=1)
    submit(tmp_path / "runs", tmp_path / "it.safetensors", small)
    verdict = verify(tmp_path / "it.safetensors", small)
    assert verdict.holds and len(verdict.checks) == 6
    found = make_audit(tmp_path / "it.safetensors", "dqn", small, date="2026-02-01", workers=1)
    assert found.holds and all(repeat.equal for repeat in found.repeats)


def test_runs_are_drawn_from_the_digest(honest):
    read = Submission.read(honest[1])
    pairs = {drawn_runs(f"{number:064x}", read) for number in range(40)}
    assert len(pairs) > 20 and all(len({task for task, _ in each}) == 3 for each in pairs)


def test_the_interval_of_a_further_run_covers_99_percent():
    draw = np.random.default_rng(0)
    runs = draw.normal(0.4, 0.1, (4000, 10))
    inside = [low <= x[0] <= high for x in runs for low, high in [prediction_interval(x[1:])]]
    assert np.mean(inside) == pytest.approx(0.99, abs=0.005)
    assert prediction_interval(np.full(9, 0.3)) == pytest.approx((0.28, 0.32))
    low, high = prediction_interval(np.full(3, 0.3))
    assert low > high


def test_commitments_bind(suite, source, tmp_path):
    made = make_commitment(source, suite, date="2026-01-01")
    made.write(tmp_path / "c.json")
    assert Commitment.read(tmp_path / "c.json") == made
    one, other = (make_commitment("dqn", suite, given, date="x") for given in ({"learning_rate": 0.001}, {}))
    assert one.digest != other.digest
    Path(source.rpartition(":")[0]).write_text(HONEST + "\n")
    try:
        assert make_commitment(source, suite, date="2026-01-01").source != made.source
    finally:
        Path(source.rpartition(":")[0]).write_text(HONEST)
    with edited_json(tmp_path / "c.json") as entry:
        entry["date"] = "2025-01-01"
    assert "changed" in refusal(ResultCorrupted, Commitment.read, tmp_path / "c.json")


def test_a_submission_of_another_agent_than_committed_is_refused(suite, honest, tmp_path):
    other = make_commitment("q_learning", suite, date="2026-01-01")
    with pytest.raises(ParameterError, match="another source or other hyperparameters"):
        submit(honest[0], tmp_path / "it.safetensors", suite, commitment=other)


def test_a_board_has_two_lists_and_believes_the_audit_of_this_very_file_alone(suite, honest, cheat, source, tmp_path):
    pytest.importorskip("jinja2")
    files = [tmp_path / name for name in ("honest.safetensors", "cheat.safetensors", "broken.safetensors")]
    for file, data in zip(files, (honest[1].read_bytes(), cheat.read_bytes(), b"x" * 40), strict=True):
        file.write_bytes(data)
    found = make_audit(files[0], source, suite, date="2026-02-01", workers=1)
    for file in files[:2]:  # that of the honest one, laid beside the cheat too
        found.write(file.with_name(f"{file.name}.audit.json"))
    assert benchmark_board(files[:1], tmp_path / "none.html", [replace(suite, digest="0" * 64)]).verified == ()
    made = benchmark_board(files, tmp_path / "board.html", [suite])
    assert len(made.verified) == 2 and [*made.refused] == ["broken.safetensors"]
    audited, claimed = (tmp_path / "board.html").read_text().split("small: claimed")
    digests = [verify(file, suite).sha256[:8] for file in files[:2]]
    assert digests[0] in audited and digests[1] in claimed
    assert digests[0] not in claimed and digests[1] not in audited


@pytest.mark.parametrize("attack", ["pickle", "header", "outside", "escape"])
def test_a_received_file_runs_and_writes_nothing(attack, suite, honest, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "received.safetensors"
    mark = tmp_path / "mark"
    if attack == "pickle":
        file.write_bytes(b"cposix\nsystem\n(S'touch mark'\ntR.")
    elif attack == "header":
        file.write_bytes((1 << 62).to_bytes(8, "little") + b"{}" * 50)
    else:
        read = Submission.read(honest[1])
        name = "../../mark" if attack == "outside" else "a\x1b[2Jb"
        curves = {**read.results.curves, name: read.results.curves["sea"]}
        record = {**read.results.record, "note": name}
        replace(read, results=replace(read.results, curves=curves, record=record)).write(file)
    with pytest.raises((FileFormatError, ResultCorrupted, ParameterError)):
        verify(file, suite)
    assert not mark.exists() and sorted(path.name for path in tmp_path.iterdir()) == ["received.safetensors"]
