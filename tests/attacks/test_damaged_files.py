"""Every kind of file that pharos reads, damaged in every way: refused in one line, or read right."""

import hashlib
import itertools
import json
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import xxhash
import yaml

import pharos
from attacks.damage import NUMBERS, OTHERS, Attack, Tally, command, entry_changed, flipped, outcome
from pharos import benchmark, exporters, hardness, importers, study
from pharos.benchmark.profiles import SCORED_TASKS, SCORES
from pharos.benchmark.results import RESULTS_FILE, RESULTS_KIND
from pharos.benchmark.suite import FOLDER
from pharos.mdp import TabularMDP
from pharos.system.sealed import write_sealed

pytestmark = pytest.mark.long

BREAKOUT = {"height": 7, "columns": 4, "brick_rows": 1}  # 1,658 states


class Stopped(RuntimeError):
    """What ends a run half way."""


def files_of(folder):
    """Names of all files of a folder."""
    return tuple(sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()))


@pytest.fixture
def attack(tmp_path, count, request):
    """Run an attack, and count."""

    def run(what, least, *arguments, **options):
        (tmp_path / "copies").mkdir()
        tally = Attack(*arguments, **options).run(tmp_path / "copies")
        count(f"{tally.total} damaged files of {what}: {tally}")
        assert tally.total >= least, tally
        return tally

    return run


# State spaces and imported MDPs --------------------------------------------------------------------------------------


def space_and_values(folder):
    """All that a state space says."""
    space = pharos.load(folder)
    solution = pharos.value_iteration(space.mdp(gamma=0.9), 1e-9)
    return space.states().tolist()[-5:], space.terminal.sum(), solution.v.tobytes()


@pytest.mark.parametrize("name", ["breakout", "frozen_lake"])
def test_state_spaces(name, attack, tmp_path):
    options = {"breakout": [BREAKOUT, BREAKOUT | {"height": 6}], "frozen_lake": [{"size": 4}, {"size": 5, "seed": 3}]}
    folders = [tmp_path / f"{name}{k}" for k in range(2)]
    for folder, parameters in zip(folders, options[name], strict=True):
        pharos.build(pharos.make(name, **parameters), folder, progress=False)
    attack(f"state spaces ({name})", 80, folders[0], files_of(folders[0]), space_and_values, others=tuple(folders[1:]))


def test_builds_that_go_on(attack, tmp_path):
    env = pharos.make("breakout", **BREAKOUT)
    with pytest.raises(pharos.errors.StateSpaceTooLarge):
        pharos.build(env, tmp_path / "space", max_states=900, progress=False)

    def read(folder):
        pharos.build(env, folder, progress=False)
        return space_and_values(folder)

    attack("unfinished builds", 60, tmp_path / "space", files_of(tmp_path / "space"), read)


def test_results_of_measures(attack, tmp_path):
    measures = ["diameter", "sum_of_reciprocal_gaps", "environmental_value_norm"]

    def read(folder):
        report = hardness.report(pharos.load(folder).mdp(gamma=0.9), measures)
        return [report[name].value for name in measures]

    for k, parameters in enumerate(({"size": 4}, {"size": 5, "seed": 3})):
        pharos.build(pharos.make("frozen_lake", **parameters), tmp_path / f"{k}", progress=False)
        read(tmp_path / f"{k}")
    attack("hardness caches", 20, tmp_path / "0", ("hardness.json",), read, others=(tmp_path / "1",))


def imported(kind, seed):
    """An MDP to import, in one of the forms that folders have."""
    rng = np.random.default_rng(seed)
    if kind == "table":
        return TabularMDP.from_arrays(rng.integers(-1, 40, (40, 3)), rng.random((40, 3)))
    if kind == "matrices":
        matrices = rng.random((20, 2, 20)) * (rng.random((20, 2, 20)) < 0.2)
        matrices /= np.maximum(matrices.sum(2, keepdims=True), 1)
        return TabularMDP.from_matrices(matrices, rng.random((20, 2)), ends=True)
    successors, probabilities = rng.integers(-1, 20, (20, 2, 3)), rng.dirichlet([1, 1, 1], (20, 2))
    return TabularMDP.from_outcomes(successors, probabilities, rng.random((20, 2)))


@pytest.mark.parametrize("kind", ["table", "matrices", "outcomes"])
def test_imported_mdps(kind, attack, tmp_path):
    for k in range(2):
        mdp = imported(kind, k)
        importers.save(mdp, tmp_path / f"{k}", observations=np.eye(mdp.num_states, dtype=np.float32))

    def read(folder):
        mdp = importers.load(folder)
        env = pharos.make("imported", folder=str(folder))
        shown = pharos.observe(env, "recorded") if hasattr(env, "recorded") else env.actions
        return pharos.value_iteration(mdp.with_gamma(0.5)).v.tobytes(), str(shown)

    attack(f"imported MDPs ({kind})", 125, tmp_path / "0", files_of(tmp_path / "0"), read, others=(tmp_path / "1",))


def test_files_of_bridge(attack, tmp_path):
    for k in range(2):
        (tmp_path / f"{k}").mkdir()
        exporters.bridge(imported("table", k), tmp_path / f"{k}" / "game_20_fs1.npz")

    def read(folder):
        return pharos.value_iteration(importers.bridge(folder / "game_20_fs1.npz")).v.tobytes()

    attack("BRIDGE", 12, tmp_path / "0", ("game_20_fs1.npz",), lambda folder: read(folder))


def test_files_of_values(attack, tmp_path):
    mdp = imported("table", 0).with_gamma(0.9)
    exact = pharos.value_iteration(mdp, 1e-12).v
    (tmp_path / "values").mkdir()
    pharos.value_iteration(mdp, 1e-9, values=tmp_path / "values" / "optimal.npy")

    def read(folder):
        solution = pharos.value_iteration(mdp, 1e-9, values=folder / "optimal.npy")
        return bool((abs(solution.v - exact) <= solution.error_bound + 1e-12).all()), solution.error_bound <= 1e-9

    attack("files of values", 12, tmp_path / "values", ("optimal.npy",), read)


# Files whose checksums were made right again --------------------------------------------------------------------------


def change_and_seal(folder, rng):
    """Change one thing of a state space, and make checksums and digest right, as somebody would who means harm."""
    manifest = json.loads((folder / "manifest.json").read_text())
    kind = rng.integers(4)
    if kind == 3:
        manifest = json.loads(entry_changed(json.dumps(manifest).encode(), rng))
    else:
        name = ("states.bin", "successors.bin", "terminal.bin")[kind]
        data = bytearray(flipped((folder / name).read_bytes(), rng))
        if kind == 1 and rng.random() < 0.5:
            place = 4 * int(rng.integers(len(data) // 4))
            data[place : place + 4] = rng.integers(-(2**31), 2**31, dtype=np.int32).tobytes()
        (folder / name).write_bytes(data)
        manifest["arrays"][name]["checksums"] = [xxhash.xxh3_128_hexdigest(bytes(data))]
    if isinstance(manifest, dict):
        content = {key: value for key, value in manifest.items() if key != "digest"}
        manifest["digest"] = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))


def naive_value(folder, rewards, gamma):
    """The value at the start, from the files alone."""
    successors = np.fromfile(folder / "successors.bin", "<i4").reshape(rewards.shape)
    v = np.zeros(len(rewards))
    for _ in range(400):
        v = (rewards + gamma * v[successors]).max(axis=1)
    return v[0]


def value_of_space(folder):
    """Whether the value is that of the files."""
    space = pharos.load(folder)
    mdp = space.mdp(gamma=0.9)
    solution = pharos.value_iteration(mdp, 1e-9)
    space.indices(space.states(slice(0, 50)))
    return bool(abs(solution.value_at_start - naive_value(folder, mdp.rewards, 0.9)) <= solution.error_bound + 1e-12)


def change_and_seal_import(folder, rng):
    """The same with an array of an imported MDP, whose header changes now and then."""
    names = sorted(path.stem for path in folder.glob("*.npy"))
    name = names[rng.integers(len(names))]
    data = bytearray((folder / f"{name}.npy").read_bytes())
    for _ in range(rng.integers(1, 4)):
        data[rng.integers(0 if rng.random() < 0.2 else 128, len(data))] ^= 1 << int(rng.integers(8))
    (folder / f"{name}.npy").write_bytes(data)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest.pop("digest")
    manifest["arrays"][name] = xxhash.xxh3_128_hexdigest(bytes(data))
    (folder / "manifest.json").write_text(json.dumps(manifest))


def value_of_import(folder):
    """Whether there are values and a bound."""
    solution = pharos.value_iteration(importers.load(folder).with_gamma(0.5))
    return bool(np.isfinite(solution.v).all() and solution.error_bound < np.inf)


@pytest.mark.parametrize("kind", ["space", "table", "matrices", "outcomes"])
def test_changes_with_right_checksums(kind, tmp_path, count):
    source, tally, rng = tmp_path / "source", Tally(), np.random.default_rng(7)
    change, read = (change_and_seal, value_of_space) if kind == "space" else (change_and_seal_import, value_of_import)
    if kind == "space":
        pharos.build(pharos.make("breakout", **BREAKOUT), source, progress=False)
    else:
        importers.save(imported(kind, 3), source)
    for number in range(400 if kind == "space" else 200):
        copy = Path(shutil.copytree(source, tmp_path / f"{number}"))
        change(copy, rng)
        tally.note(f"change {number}", *outcome(lambda copy=copy: read(copy), ("True",)))
        shutil.rmtree(copy)
    count(f"{tally.total} changed files with right checksums ({kind}): {tally}")
    tally.check()
    assert tally.counts["unchanged"] > 10 and tally.counts["refused"] > 50


# Runs ----------------------------------------------------------------------------------------------------------------

SMALL = {"n_steps": 16, "n_envs": 2, "batch_size": 16, "net_arch": [8]}
AGENTS = {
    "q_learning": {"agent": "q_learning"},
    "dqn": {"agent": "dqn", "hyperparameters": {"learning_starts": 20, "buffer_size": 200, "net_arch": [8]}},
    "ppo": {"agent": "ppo", "engine": "batched", "hyperparameters": SMALL},
}


def train(name, folder, seed=0, **options):
    """A short run."""
    options |= {"steps": 128, "evaluation_interval": 32, "seed": seed, "out": folder}
    return pharos.train(environment="frozen_lake/4x4", **AGENTS[name], **options)


@pytest.mark.parametrize("name", AGENTS)
def test_runs(name, attack, tmp_path):
    for seed in range(2):
        train(name, tmp_path / f"{seed}", seed)

    def read(folder):
        answer = command("evaluate", "frozen_lake/4x4", "--policy", folder)
        again = train(name, folder)
        return answer["value_at_start"], again.result, [str(row) for row in again.curve]

    attack(f"runs of {name}", 40, tmp_path / "0", files_of(tmp_path / "0"), read, others=(tmp_path / "1",), fewer=2)


@pytest.mark.parametrize("name", AGENTS)
def test_checkpoints(name, attack, tmp_path, monkeypatch):
    monkeypatch.setattr("pharos.training.results.RUN_CHECKPOINT_SECONDS", 0.0)

    def stop(done, *_):
        if done >= 64:
            raise Stopped

    for seed in range(2):
        with pytest.raises((Stopped, RuntimeError)):
            train(name, tmp_path / f"{seed}", seed, progress=stop)

    def read(folder):
        end = train(name, folder)
        return end.result, [str(row) for row in end.curve]

    folder, anew = tmp_path / "0", read(tmp_path / "anew")
    attack(f"checkpoints of {name}", 50, folder, files_of(folder), read, (anew,), (tmp_path / "1",), fewer=2)


def test_policies_in_files(attack, tmp_path):
    (tmp_path / "p").mkdir()
    np.save(tmp_path / "p" / "policy.npy", np.zeros(16, np.uint8))

    def read(folder):
        value = command("evaluate", "frozen_lake/4x4", "--policy", folder / "policy.npy")["value_at_start"]
        return value >= 0

    attack("policies", 12, tmp_path / "p", ("policy.npy",), read)


# Studies -------------------------------------------------------------------------------------------------------------

BLOCK = {"environments": ["frozen_lake/4x4"], "agents": ["q_learning"], "chance": ["plain", {"sticky": 0.25}]}
SPEC = {"name": "mine", "steps": 64, "evaluations": 4, "blocks": [BLOCK]}


@pytest.fixture(scope="module")
def studies(tmp_path_factory):
    """Two finished studies, with other seeds."""
    place = tmp_path_factory.mktemp("studies")
    for k in range(2):
        study.run(SPEC | {"blocks": [BLOCK | {"seeds": [2 * k, 2 * k + 1]}]}, place / f"{k}", workers=1)
        for log in (place / f"{k}").rglob("log.txt"):
            log.unlink()
    return place


def tables(folder):
    """All that a study says of its runs."""
    return study.table(folder).to_csv(), study.curves(folder).to_csv()


def test_packed_studies(studies, attack, tmp_path):
    for k in range(2):
        (tmp_path / f"{k}").mkdir()
        study.pack(studies / f"{k}", file=tmp_path / f"{k}" / "mine.parquet")

    def read(folder):
        return tables(study.unpack(folder / "mine.parquet", folder / "there")[0])

    attack("packed studies", 12, tmp_path / "0", ("mine.parquet",), read)


def test_folders_of_studies(studies, attack):
    source = studies / "0"
    runs = sorted(path.name for path in (source / "runs").iterdir())[:2]
    files = [f"runs/{run}/{file}" for run in runs for file in ("run.json", "curve.csv")]
    whole = study.table(source).set_index("id")

    def read(folder):
        """Whether each run is in the table as it was, or named as damaged or missing."""
        now, rows = study.status(folder), study.table(folder).set_index("id")
        assert now.total == len(whole) and now.finished + now.missing == now.total and now.finished == len(rows)
        assert not set(now.damaged) & set(rows.index)
        return rows.equals(whole.loc[rows.index])

    attack("folders of studies", 100, source, ("study.yaml", "status.json", *files), read, answers=(True,))


def test_specifications_of_studies(attack, tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "mine.yaml").write_text(yaml.safe_dump(SPEC))

    def read(folder):
        said = study.specification(folder / "mine.yaml")
        stated = yaml.safe_load((folder / "mine.yaml").read_text())
        return said.name == stated["name"] and said.steps == stated["steps"]

    attack("specifications", 20, tmp_path / "s", ("mine.yaml",), read)


def test_tables_of_hyperparameters(attack, tmp_path):
    (tmp_path / "h").mkdir()
    stated = {"q_learning": {"frozen_lake": {"index": {"learning_rate": 0.25, "gamma": 0.9}}}}
    (tmp_path / "h" / "mine.yaml").write_text(yaml.safe_dump(stated))

    def read(folder):
        file = folder / "mine.yaml"
        end = pharos.train("q_learning", "frozen_lake/4x4", steps=4, evaluation_interval=2, hyperparameters=file)
        mine = yaml.safe_load(file.read_text()).get("q_learning", {}).get("frozen_lake", {}).get("index") or {}
        return end.config["hyperparameters"] == mine

    attack("hyperparameters", 20, tmp_path / "h", ("mine.yaml",), read)


def test_searches(attack, tmp_path):
    options = ["frozen_lake/4x4", "--steps", 60, "--seeds", 0]
    command("tune", *options, "--trials", 3, "--out", tmp_path / "search")

    def read(folder):
        """A search goes on from its trials."""
        return len(command("tune", *options, "--trials", 4, "--out", folder)["trials"]) >= 4

    names = ("tuning.json", "hyperparameters.yaml")
    attack("searches", 30, tmp_path / "search", names, read, fewer=2)


# Finished runs of a benchmark for a diagnosis ------------------------------------------------------------------------

RECORD = {"form": "generator", "source": {"name": "mine.py:learn", "sha256": "ab"}, "notes": {"x": {"a": "b"}}}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of results of three seeds, and what they say and have."""
    whole = benchmark.AgentResults.read("v1/dqn")
    names = [*SCORED_TASKS, "umbrella_chain-8", "umbrella_chain-16"]
    facts = {name: {"one_action": 0.5, "deterministic": 0.0, "greedy_score": 0.5} for name in names}
    record = {"agent": "mine", "suite": "v1", "suite_digest": whole.digest, "seeds": [0, 1, 2]}
    play = {name: {"regret": 0.1, "episodes": 400.0} for name in names}
    record |= {"record": {**RECORD, "policies": facts, "play": play, "failed": {"a": "why"}}}
    curves = {name: whole.curves[name][:3] for name in names}
    folder = tmp_path_factory.mktemp("finished")
    write_sealed(folder / RESULTS_FILE, record, curves, RESULTS_KIND)
    return folder, record, curves


def diagnosed(folder):
    """What `diagnose --results` says; all of it can be written as JSON."""
    said = command("diagnose", "--results", folder)
    json.dumps(said, allow_nan=False)
    assert "\n" not in said["verdict"] and len(said["verdict"]) < 1000
    return {name: value for name, value in said.items() if name != "seconds"}


def test_results_that_are_diagnosed(finished, attack):
    folder, _, _ = finished
    attack("results that are diagnosed", 12, folder, (RESULTS_FILE,), diagnosed)


def test_results_that_are_diagnosed_and_are_others(finished, tmp_path, count):
    """Each is refused in a line, or, if it says the same of scores and likeness, answered the same."""
    folder, record, curves = finished
    whole, tally = diagnosed(folder), Tally()
    (tmp_path / "r").mkdir()

    def read():
        said = diagnosed(tmp_path / "r")
        return [said[name] == whole[name] for name in ("scores", "likeness", "readings")]

    def sealed(**changes):
        write_sealed(
            tmp_path / "r" / RESULTS_FILE,
            {**record, **changes.get("record", {})},
            changes.get("curves", curves),
            RESULTS_KIND,
        )

    foreign = {
        "a suite": (FOLDER / "v1.yaml").read_bytes(),
        "a table": SCORES.read_bytes(),
        "numbers alone": safetensors.numpy.save(dict(curves)),
        "JSON": b"{}",
        "half written": (folder / RESULTS_FILE).read_bytes()[: (folder / RESULTS_FILE).stat().st_size // 2],
        "of a later version": (folder / RESULTS_FILE).read_bytes().replace(b'\\"format\\": 1', b'\\"format\\": 9'),
    }
    for name, data in foreign.items():
        (tmp_path / "r" / RESULTS_FILE).write_bytes(data)
        tally.note(name, *outcome(read, ("refused alone",)))
    for name, suite in itertools.product(("suite", "suite_digest"), ("v2", "large", "../v1", "", "x" * 64)):
        sealed(record={name: suite})
        tally.note(f"{name} {suite}", *outcome(read, ("refused alone",)))
    one = SCORED_TASKS[0]
    for what, values in {
        "huge": {**curves, one: curves[one] + 1e300},
        "less than none": {**curves, one: curves[one] - 1e300},
        "below optimal": {**curves, one: curves[one] - 5.0},
        "one cell": {**curves, one: np.where(np.arange(15) == 3, 1e9, curves[one])},
        "NaN": {**curves, one: curves[one] * np.nan},
        "of three evaluations": {name: curve[:, :3] for name, curve in curves.items()},
        "of no evaluation": {name: curve[:, :0] for name, curve in curves.items()},
        "of another task": {**curves, "nobody": curves[one]},
        "of nothing": {},
    }.items():
        sealed(curves=values)
        tally.note(f"curves {what}", *outcome(read, ("refused alone",)))
    assert tally.counts["refused"] == tally.total, tally.failures
    values = [value for value in (*NUMBERS, *OTHERS) if value == value and value not in (np.inf, "\ud800")]
    same = repr([True, True, True])
    without, whole_said = {}, whole
    for name in ("policies", "play"):  # facts on policies, and what was played, are none if they cannot be read
        sealed(record={"record": {**record["record"], name: {}}})
        without[name] = diagnosed(tmp_path / "r")
        assert without[name]["scores"] == whole["scores"]
        assert without[name]["readings"].items() < whole["readings"].items()
    for name, value in itertools.product(record["record"], values[::2]):
        whole = without.get(name, whole_said)
        with suppress(ValueError):  # no file has such a number
            sealed(record={"record": {**record["record"], name: value}})
            tally.note(f"{name} {str(value)[:20]}", *outcome(read, (same,)))
    whole = whole_said
    for name, value in itertools.product(("one_action", "deterministic", "greedy_score"), (-1, 1e300, "x", None, 2)):
        facts = {each: {**own, name: value} for each, own in record["record"]["policies"].items()}
        sealed(record={"record": {**record["record"], "policies": facts}})
        tally.note(
            f"{name} {value}", *outcome(lambda: diagnosed(tmp_path / "r")["findings"], (repr(whole["findings"]),))
        )
    for value in ("x", None, [], True):
        play = {each: {"regret": value, "episodes": 400.0} for each in record["record"]["play"]}
        whole = without["play"]
        sealed(record={"record": {**record["record"], "play": play}})
        tally.note(f"regret {value}", *outcome(read, (same,)))
    for value in (-1e300, -1, 2, 1e300):  # no run has these, and they say no more than the ends of what one may have
        play = {each: {"regret": value, "episodes": 400.0} for each in record["record"]["play"]}
        sealed(record={"record": {**record["record"], "play": play}})
        numbers = diagnosed(tmp_path / "r")["readings"]
        assert {x for each, x in numbers.items() if each.startswith("played_")} == {float(value < 1)}
    count(f"{tally.total} other results that are diagnosed: {tally}")
    tally.check()
    assert tally.total >= 60


# Submissions of single runs -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["q_learning", "ppo"])
def test_entries(name, attack, tmp_path):
    for seed in range(2):
        train(name, tmp_path / f"run{seed}", seed)
        (tmp_path / f"{seed}").mkdir()
        benchmark.submit(tmp_path / f"run{seed}", tmp_path / f"{seed}" / "mine.safetensors")

    def read(folder):
        verdict = benchmark.verify(folder / "mine.safetensors")
        return verdict.holds, verdict.value, verdict.entry.claim

    attack(f"entries ({name})", 12, tmp_path / "0", ("mine.safetensors",), read)
