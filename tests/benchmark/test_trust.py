"""What a submission claims, and what is computed again of it; nothing that was received is executed."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

import pharos
from command_line import answer, usage_error
from command_line import run as command
from pharos.benchmark import board
from pharos.benchmark.execution import run
from pharos.benchmark.page import report
from pharos.benchmark.scores import score
from pharos.benchmark.submission import ENTRY_KIND, Submission, submit
from pharos.benchmark.suite import BenchmarkTask, Protocol, Suite, digest_of_suite, frozen, write_suite
from pharos.benchmark.verification import verify
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted, TimeLimit
from pharos.system.sealed import read_sealed, write_sealed
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

LAZY = """
import numpy as np

def learn(env, steps, seed):
    env.reset()
    for step in range(steps):
        if any(env.step(env.action_space.sample())[2:4]):
            env.reset()
        if step % 500 == 499:
            yield lambda batch: np.full((len(batch), env.action_space.n), 1 / env.action_space.n)
"""


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
    """(folder, file) of an honest generator's submission."""
    folder = tmp_path_factory.mktemp("honest")
    run(source, suite, out=folder / "runs", seeds=SEEDS, workers=1)
    submit(folder / "runs", folder / "it.safetensors", suite, author="A. Uthor")
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
    assert verdict.submission.author == "A. Uthor"
    assert verdict.final == pytest.approx(score(verdict.submission.results, suite).final.value, abs=1e-6)


def test_the_same_submission_has_the_same_bytes(suite, honest, tmp_path):
    submit(honest[0], tmp_path / "again.safetensors", suite, author="A. Uthor")
    assert (tmp_path / "again.safetensors").read_bytes() == honest[1].read_bytes()


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


def test_a_task_of_a_suite_has_a_limit_of_time(suite, honest):
    assert "it.safetensors: task catch takes more than" in refusal(
        TimeLimit, verify, honest[1], suite, max_seconds=1e-6
    )


def test_another_suite_is_refused(suite, honest):
    assert "name its suite" in refusal(ParameterError, verify, honest[1], replace(suite, name="other", digest="0" * 64))


@pytest.mark.long
@pytest.mark.parametrize("agent", ["q_learning", "dqn"])
def test_tables_and_networks_of_pharos_hold(suite, tmp_path, agent):
    if agent == "dqn":
        pytest.importorskip("torch")
    small = replace(suite, hyperparameters={"dqn": {"learning_starts": 100}})
    run(agent, small, out=tmp_path / "runs", seeds=range(2), workers=1)
    submit(tmp_path / "runs", tmp_path / "it.safetensors", small)
    verdict = verify(tmp_path / "it.safetensors", small)
    assert verdict.holds and len(verdict.checks) == 6


def test_a_run_without_a_policy_counts_as_random_play(suite, cheat, tmp_path):
    read = Submission.read(cheat)
    few = {run: policy for run, policy in read.policies.items() if run[0] == "sea" or run == ("catch", 3)}
    replace(read, policies=few).write(tmp_path / "few.safetensors")
    verdict = verify(tmp_path / "few.safetensors", suite)
    assert verdict.holds and len(verdict.missing) == 9
    assert verdict.final == pytest.approx((5 + 1) / 15)  # of three tasks with five runs


class Tables(HTMLParser):
    """The tables of a page: a list of rows for each, the headings first."""

    def __init__(self, page: str):
        super().__init__()
        self.tables: list[list[list[str]]] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("th", "td"):
            self.tables[-1][-1].append("")

    def handle_data(self, data):
        if self.tables and self.tables[-1] and self.tables[-1][-1]:
            self.tables[-1][-1][-1] += data.strip()


@pytest.fixture(scope="module")
def random_player(suite, tmp_path_factory):
    """The submission of an agent that yields uniform play alone, as `benchmark submit` packs it."""
    folder = tmp_path_factory.mktemp("random")
    (folder / "lazy.py").write_text(LAZY)
    run(f"{folder / 'lazy.py'}:learn", suite, out=folder / "runs", seeds=SEEDS, workers=1)
    return Submission.read(submit(folder / "runs", folder / "it.safetensors", suite))


FORGED = {  # curves of an agent whose every point is 1, but for the last
    "one absurd seed": [[0.0], [0.0], [0.0], [0.0], [1000.0]],
    "two groups of seeds": [[0.067], [0.645], [0.067], [0.645], [0.067]],
    "nothing to see": [[0.0]] * 5,
}


@pytest.mark.parametrize("forged", FORGED)
def test_what_a_random_agent_forges_is_called_claimed_but_for_its_final_policies(
    suite, random_player, cheat, tmp_path, forged
):
    pytest.importorskip("jinja2")
    results = random_player.results
    curves = {name: np.hstack([np.tile(FORGED[forged], 2), curve[:, -1:]]) for name, curve in results.curves.items()}
    made = replace(random_player, results=replace(results, curves=curves), note="v7")
    made.write(tmp_path / "forged.safetensors")
    (tmp_path / "forged.safetensors.audit.json").write_text('{"holds": true}')  # the name of a record of an audit
    (tmp_path / "solved.safetensors").write_bytes(cheat.read_bytes())
    write_suite(suite, tmp_path / "small.yaml")
    claimed = score(made.results, suite).core.value
    assert claimed > 0.45

    files = [tmp_path / f"{name}.safetensors" for name in ("forged", "solved")]
    said = answer("benchmark", "verify", files[0], "--suite", tmp_path / "small.yaml")
    assert said["holds"] and said["final_score"] == pytest.approx(0.0, abs=1e-9)
    assert {"curves while learning", "core scores and intervals"} <= {*said["claimed"]}
    out = tmp_path / "board.html"
    said = answer("benchmark", "board", *files, "--suite", tmp_path / "small.yaml", "--out", out)
    assert said["final_scores"] == pytest.approx({"forged.safetensors": 0.0, "solved.safetensors": 1.0}, abs=1e-9)

    page = out.read_text()
    assert "audit" not in page.lower()
    ((heads, first, second),) = Tables(page).tables
    assert (first[heads.index("final score")], second[heads.index("final score")]) == ("1.000", "0.000")
    assert second[heads.index("policies")] == "15 of 15"
    shown = [head for head, cell in zip(heads, second, strict=True) if cell.startswith(f"{claimed:.3f}")]
    assert "core score, claimed" in shown and all("claimed" in head for head in shown)
    report(made.results, out, beside=[], suite=suite)
    proven, *rest = re.findall("<li>(.*?)</li>", out.read_text().partition("What is proven, and what is claimed")[2])
    assert proven.startswith("Proven: V* and the value of uniform play") and len(rest) == 2
    assert all(each.startswith("Claimed") for each in rest)


def test_a_page_of_submissions_has_those_of_its_suites_and_says_why_not(suite, honest, cheat, tmp_path):
    pytest.importorskip("jinja2")
    files = [tmp_path / name for name in ("honest.safetensors", "cheat.safetensors", "broken.safetensors")]
    for file, data in zip(files, (honest[1].read_bytes(), cheat.read_bytes(), b"x" * 40), strict=True):
        file.write_bytes(data)
    none = board(files[:1], tmp_path / "none.html", [replace(suite, digest="0" * 64)])
    assert not none.verified and "name its suite" in none.refused["honest.safetensors"]
    made = board(files, tmp_path / "board.html", [suite])
    assert len(made.verified) == 2 and [*made.refused] == ["broken.safetensors"]
    (heads, first, _), refused = Tables((tmp_path / "board.html").read_text()).tables
    assert first[heads.index("file")] == verify(files[1], suite).sha256[:8] and len(refused) == 2


def test_one_verifier_and_one_board_take_a_run_of_one_task_and_runs_of_a_suite(suite, honest, tmp_path):
    pytest.importorskip("jinja2")
    pharos.train("q_learning", "simple_grid", height=3, width=3, steps=500, out=tmp_path / "run")
    files, page = tmp_path / "files", tmp_path / "board.html"
    write_suite(suite, tmp_path / "small.yaml")
    made = answer("benchmark", "submit", tmp_path / "run", "--out", files / "run.safetensors", "--name", "mine")
    assert (made["runs"], made["policies"], {*made["claim"]} >= {"value", "regret"}) == (1, 1, True)
    (files / "suite.safetensors").write_bytes(honest[1].read_bytes())
    said = answer("benchmark", "verify", *sorted(files.iterdir()), "--suite", tmp_path / "small.yaml")
    assert said["holds"] and [each["verified"] for each in said["entries"]] == [4, 15]
    assert all({"sha256", "final_score", "claimed", "limits"} <= {*each} for each in said["entries"])
    assert {*said["entries"][0]["checks"]} == {"value", "regret", "value_optimal", "value_uniform"}
    said = answer("benchmark", "board", files, "--suite", tmp_path / "small.yaml", "--out", page)
    assert said["verified"] == 2 and {*said["final_scores"]} == {"run.safetensors", "suite.safetensors"}
    of_suite, of_task = Tables(page.read_text()).tables
    assert "final score" in of_suite[0] and of_task[1][of_task[0].index("entry")] == "mine"
    (tmp_path / "run.safetensors").write_bytes(b"another file of the same name")
    made = board([tmp_path / "run.safetensors", files], page, [suite])
    assert [*made.refused] == [str(tmp_path / "run.safetensors")] and len(made.final_scores) == 2


def test_a_label_of_a_suite_is_the_one_that_was_submitted(suite, honest, tmp_path):
    file = submit(honest[0], tmp_path / "it.safetensors", suite, name="mine")
    assert Submission.read(file).results.agent == "mine"


def test_a_submission_with_a_commitment_is_read_as_one_without(suite, honest, tmp_path):
    record, arrays = read_sealed(honest[1], ENTRY_KIND, lambda *content: content)
    kept = {name: value for name, value in record.items() if name not in ("arrays", "digest")}
    write_sealed(
        tmp_path / "older.safetensors", {**kept, "commitment": {"agent": "x", "date": "2026-01-01"}}, arrays, ENTRY_KIND
    )
    assert verify(tmp_path / "older.safetensors", suite).holds
    Submission.read(tmp_path / "older.safetensors").write(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == honest[1].read_bytes()


@pytest.mark.parametrize(
    ("words", "instead"),
    [
        ("audit x --source y", "`pharos benchmark verify FILE` computes them again"),
        ("commit dqn", "only final policies can be proven"),
        ("seal d --season s --beacon b", "write_suite makes a suite of your own"),
    ],
)
def test_commands_that_are_gone_say_what_to_use(words, instead):
    line, name = usage_error("benchmark", *words.split()), words.split()[0]
    assert f"{name} is gone: " in line and instead in line
    assert name not in command("benchmark", "--help").stdout


@pytest.mark.parametrize("name", ["submit", "verify", "board"])
def test_commands_for_one_run_are_those_of_the_benchmark(name):
    assert f"{name} is gone: `pharos benchmark {name}` does it" in usage_error(name, "x")
    assert f" {name} " in command("benchmark", "--help").stdout


def test_an_option_that_is_gone_says_so():
    assert "--commitment is gone" in usage_error("benchmark", "submit", "x", "--commitment", "c.json")


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
