"""Submissions of single runs, forged from honest ones: none is believed that is not true, none stops the others.

A forgery changes one thing of an honest entry, with digests that fit. Where its claim is said to hold, a slow twin
computes from the rules what is true: values by backward induction over explicit matrices.
"""

import contextlib
import copy
import io
import itertools
import json
import os
import pickle
import struct
import sys
import tarfile
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pharos
from attacks.damage import Payload, Tally, outcome
from naive.mdp import augmented
from pharos import benchmark
from pharos.system import storage
from pharos.training import run_id

pytest.importorskip("stable_baselines3")  # imported before anything has a limit of time
pytestmark = pytest.mark.long

LIMITS = {"max_seconds": 3.0, "max_states": 20_000, "max_horizon": 5_000}
HUGE = 10**400
NUMBERS = (float("nan"), float("inf"), -1, -0.5, 2**31, 2**63, 1e300, HUGE)
ODD = (None, True, "", "x", "1", [], [1.0], {}, {"a": 1}, *NUMBERS)
ELSEWHERE = ("evil.py:Two", "os:system", "../x", "/etc/passwd", "imported")
TEXTS = {
    "right to left": "left\u202eright",
    "isolate": "a\u2066b",
    "emoji": "\U0001f600",
    "joined emoji": "\U0001f468\u200d\U0001f469",
    "flag": "\U0001f1e9\U0001f1ea",
    "accents": "a" + "\u0301" * 50,
    "alone accent": "\u0301",
    "variation": "\ufe0f",
    "filler": "\u3164",
    "braille": "\u2800",
    "zero width": "a\u200bb",
    "byte order": "\ufeffx",
    "escape": "\x1b[2J",
    "carriage return": "good\rbad",
    "null": "a\0b",
    "surrogate": "\ud800",
    "markup": "[bold red]x[/]",
    "wrong markup": "[/nothing]",
    "shortcode": ":x: :smile:",
    "script": "</td><script>document.title = 1</script>",
    "attribute": '" onmouseover="x',
    "template": "{{ 7 * 7 }}{% raw %}",
    "long": "x" * 3000,
    "lines": "\n" * 500,
    "private": "\ue000",
    "tag": "a\U000e0041",
}


# What is honest -------------------------------------------------------------------------------------------------------


def grid(folder):
    """Q-learning on 9 cells with random actions: a table of actions."""
    return pharos.train("q_learning", "simple_grid", height=3, width=3, steps=2000, random=0.1, out=folder)


def river(folder):
    """Q-learning that sees the previous action: a table of probabilities, whose rows could sum to more than 1."""
    seen = {"sees_previous_action": True}
    setting = {"steps": 400, "evaluation_interval": 100, "sticky": 0.1, "horizon": 200}
    return pharos.train("q_learning", "river_swim", hyperparameters=seen, out=folder, **setting)


def network(folder):
    """PPO on 9 cells: a network."""
    small = {"n_steps": 16, "n_envs": 2, "batch_size": 16, "net_arch": [8]}
    setting = {"steps": 64, "evaluation_interval": 32, "engine": "batched", "hyperparameters": small}
    return pharos.train("ppo", "simple_grid", height=3, width=3, out=folder, **setting)


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """kind -> file of an honest entry."""
    place, files = tmp_path_factory.mktemp("honest"), {}
    for kind in (grid, river, network):
        kind(place / kind.__name__)
        files[kind.__name__] = benchmark.submit(place / kind.__name__, place / f"{kind.__name__}.safetensors")
    return files


# Forgery --------------------------------------------------------------------------------------------------------------


@dataclass
class Content:
    """What a file of an entry says: its record, and its arrays."""

    record: dict[str, Any]
    arrays: dict[str, np.ndarray]
    kept: tuple[str, ...] = ()  # entries of the record that are not made to fit

    @staticmethod
    def of(file: Path) -> "Content":
        data = file.read_bytes()
        (length,) = struct.unpack("<Q", data[:8])
        header = json.loads(data[8 : 8 + length])
        record, arrays = json.loads(header.pop("__metadata__")["pharos"]), {}
        for name, place in header.items():
            first, last = place["data_offsets"]
            name_of = place["dtype"]
            dtype = "?" if name_of == "BOOL" else f"<{name_of[0].lower()}{int(name_of[1:]) // 8}"
            arrays[name] = np.frombuffer(data[8 + length :][first:last], dtype).reshape(place["shape"])
        return Content(record, arrays)

    def data(self, **places: Any) -> bytes:
        """The bytes of a file, with digests that fit; `places`: what the header says of arrays that is not true."""
        header: dict[str, Any] = {}
        parts, end, digests = [], 0, {}
        for name, array in self.arrays.items():
            data = np.ascontiguousarray(array).tobytes()
            said = "BOOL" if array.dtype == bool else f"{array.dtype.kind.upper()}{8 * array.itemsize}"
            header[name] = {"dtype": said, "shape": list(array.shape), "data_offsets": [end, end + len(data)]}
            header[name] |= places.get(name, {})
            content = [array.dtype.str, list(array.shape), storage.digest_of_bytes(data)]
            digests[name] = storage.digest_of_json(content)
            parts, end = [*parts, data], end + len(data)
        fitting = {"arrays": digests, "id": run_id(self.record["config"])}
        record = {**self.record, **{name: fit for name, fit in fitting.items() if name not in self.kept}}
        with deep_recursion():
            text = json.dumps(storage.sealed(record), sort_keys=True)
        head = json.dumps({"__metadata__": {"pharos": text}, **header}).encode()
        return struct.pack("<Q", len(head)) + head + b"".join(parts)


@contextlib.contextmanager
def deep_recursion() -> Iterator[None]:
    """Python follows what is nested deeper than usual."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(10_000)
    try:
        yield
    finally:
        sys.setrecursionlimit(before)


def edited(content: Content, path: tuple[str, ...], value: Any) -> bytes:
    """The file with another value at a place of its record."""
    changed = Content(copy.deepcopy(content.record), content.arrays, path[:1])
    owner = changed.record
    for name in path[:-1]:
        owner = owner[name]
    owner[path[-1]] = value
    return changed.data()


Forgery = tuple[str, bytes | Callable[[Path], Any]]


def claims(content: Content) -> Iterator[Forgery]:
    """Other numbers, alone and in company."""
    claim = content.record["claim"]
    best, uniform = claim["value_optimal"], claim["value_uniform"]
    for name in ("value", "regret", "value_optimal", "value_uniform", "error_bound"):
        near = (claim[name] + 1e-4, claim[name] - 1e-4, 2 * best, best + 0.01, 0.0)
        for value in (*near, *ODD):
            yield f"{name} {str(value)[:20]}", edited(content, ("claim", name), value)
    for value, is_exact, bound in itertools.product((best, best + 0.01, 2 * best), (True, False), (0, 1e-3, 0.4, 1e9)):
        numbers = {"value": value, "regret": best - value, "exact": is_exact, "error_bound": bound}
        yield f"{numbers}", edited(content, ("claim",), {**claim, **numbers})
    shifted = {**claim, "value": best + 1, "regret": 0.0, "value_optimal": best + 1, "value_uniform": uniform + 1}
    yield "all shifted", edited(content, ("claim",), shifted)
    for value in (None, 1, "yes", [], [True]):
        yield f"exact {value}", edited(content, ("claim", "exact"), value)
    for value in ({}, [], None, 7, {**claim, "more": 1}, {"value": best}):
        yield f"claim {str(value)[:40]}", edited(content, ("claim",), value)


def settings(content: Content) -> Iterator[Forgery]:
    """Another task, or the same in another spelling."""
    config = content.record["config"]
    spellings = {
        "gamma": (1, 1.0 + 1e-12, 1 - 1e-9, 0.5, 1e-300, 0, -0.0),
        "horizon": (0, 1, 5.0, 4_999, 5_001, 10**9, 10**30, config["horizon"]),
        "steps": (0, 1, 2**62, 10**30, 5.0),
        "seed": (7, 2**70, -5),
        "environment": ("frozen_lake", "simple_grid/3x3", *ELSEWHERE),
        "agent": ("dqn", "sarsa", "stable_baselines3:DQN", "stable_baselines3.common.utils:os", *ELSEWHERE),
        "observation": ("index", "vector", "recorded", "evil.py:see", "os:listdir", "simple_image"),
        "engine": ("batched", "sb3", "x"),
        "evaluation_interval": (0, 10**30),
        "chance": (
            {"sticky": -0.0, **config["chance"]},
            *({"sticky": p} for p in (1e-300, 1e-13, 0.5, 1, 2, -1, "0.1", True, HUGE, float("nan"))),
            *({"random": p} for p in (1, 1.5, -1e-9, None)),
            {"lazy": 1.0},
            {"lazy": 1 - 1e-9},
            {"reward_noise": 1e300},
            {"reward_delay": 10**18},
            {"reward_delay": HUGE},
            *({"scale_rewards": unit} for unit in ("range", "Range", "range" * 1000, 0.0, -1, 1e-300, HUGE, True)),
            {"scale_rewards": "range", "random": 1.0},
            {"sticky": "range"},
            {"luck": 1.0},
        ),
        "parameters": (
            *({**config["parameters"], "height": size} for size in (10**9, 10**5, 3.0, 3.5, "3", True, -3, None)),
            {**config["parameters"], "more": 1},
            {"folder": "/etc"},
            {name: [value] * 1000 for name, value in config["parameters"].items()},
        ),
        "observation_options": ({"size": 10**9}, {"frames": 10**6}, {"hide": ["row"] * 1000}, {"x": HUGE}),
        "hyperparameters": ({"net_arch": [10**6] * 2}, {"policy_kwargs": {"activation_fn": "os:system"}}, {"x": "y"}),
    }
    for name, values in spellings.items():
        odd = ODD if name in ("gamma", "horizon", "steps", "chance", "parameters") else ODD[:8]
        for k, value in enumerate((*values, *odd)):
            yield f"{name} {k} {str(value)[:40]}", edited(content, ("config", name), value)
    sources = {"environment": {"name": "evil.py:Two", "file": "evil.py", "checksum": "0"}}
    yield "sources", edited(content, ("config", "sources"), sources)
    yield "more", edited(content, ("config", "more"), 1)
    for name in config:
        changed = Content(copy.deepcopy(content.record), content.arrays)
        del changed.record["config"][name]
        yield f"without {name}", changed.data()


def descriptions(content: Content) -> Iterator[Forgery]:
    """What is shown beside the numbers, and what describes the file."""
    for (kind, text), name in itertools.product(TEXTS.items(), ("name", "author", "note")):
        yield f"{name} {kind}", edited(content, (name,), text)
    described = ("rules_version", "format", "id", "hyperparameters", "arrays")
    for name in ("name", "author", "versions", "training", *described):
        for value in (*ODD[:8], HUGE):
            yield f"{name} {str(value)[:20]}", edited(content, (name,), value)
    for kind, text in TEXTS.items():
        yield f"version {kind}", edited(content, ("versions",), {"pharos": text})
        yield f"training {kind}", edited(content, ("training",), {text: text})
    for value in ODD:
        yield f"learning {str(value)[:20]}", edited(content, ("training", "normalized_regret"), value)
    for place, depth in itertools.product(("training", "hyperparameters", "versions"), (50, 300, 900, 980)):
        deep: Any = 1
        for _ in range(depth):
            deep = {"a": deep}
        yield f"{place} {depth} deep", edited(content, (place,), deep)
        lists: Any = 1
        for _ in range(depth):
            lists = [lists]
        yield f"{place} {depth} lists deep", edited(content, (place,), {"a": lists})


def arrays(content: Content) -> Iterator[Forgery]:
    """Other arrays in place of the policy."""

    def changed(**others: np.ndarray) -> bytes:
        return Content(content.record, {**content.arrays, **others}).data()

    for name, array in list(content.arrays.items())[:3]:
        for dtype in ("?", "u1", "u2", "u4", "i1", "i2", "i4", "i8", "f2", "f4", "f8"):
            if np.dtype(dtype) != array.dtype:
                yield f"{name} as {dtype}", changed(**{name: array.astype(dtype)})
        shapes = ((-1, 1), (1, -1), (1, 1, 1, -1), (-1,), array.shape[::-1])
        for k, shape in enumerate(shapes):
            yield f"{name} in shape {k}", changed(**{name: array.reshape(shape)})
        yield f"{name} empty", changed(**{name: array[:0]})
        yield f"{name} shorter", changed(**{name: array[:-1]})
        yield f"{name} longer", changed(**{name: np.concatenate([array, array[:1]])})
        yield f"{name} reversed", changed(**{name: array[::-1]})
        yield f"{name} of ones", changed(**{name: np.ones_like(array)})
        yield f"{name} beyond the file", Content(content.record, content.arrays).data(**{name: {"shape": [1 << 40]}})
        yield f"{name} of objects", Content(content.record, content.arrays).data(**{name: {"dtype": "O"}})
        if array.dtype.kind == "u":
            yield f"{name} of other actions", changed(**{name: array + 4})
            yield f"{name} below 0", changed(**{name: array.astype("i8") - 1})
            yield f"{name} without end", changed(**{name: np.full(array.shape, 2**63 - 1)})
            continue
        for factor in (1 + 9.9e-7, 1 - 9.9e-7, 1 + 2e-6, 2.0, 0.0, -1.0, 1e300, float("nan"), float("inf")):
            with np.errstate(all="ignore"):
                yield f"{name} times {factor}", changed(**{name: (array * factor).astype(array.dtype)})
        first = array.copy()
        first.flat[0] = np.nan
        yield f"{name} with one NaN", changed(**{name: first})
        largest = np.full(array.shape, np.finfo(array.dtype).max, array.dtype)
        yield f"{name} of the largest numbers", changed(**{name: largest})
        yield f"{name} of huge numbers", changed(**{name: (array * 1e30).astype(array.dtype)})
        shifted = array.copy()
        shifted[..., 0] += 5e-7
        yield f"{name} with a little more", changed(**{name: shifted})
        shifted[..., 0] += 3
        shifted[..., 1 % array.shape[-1]] -= 3
        yield f"{name} with less than nothing", changed(**{name: shifted})
    yield "no arrays", Content(content.record, {}).data()
    yield "one more", changed(more=np.zeros(3))
    yield "another name", Content(content.record, {f"{name}.x": each for name, each in content.arrays.items()}).data()


def objects_saved(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.array([Payload(path.with_name("executed"))]))


def containers(content: Content) -> Iterator[Forgery]:
    """No entry at all, or one whose bytes lie about their sizes."""
    data, code = content.data(), b"import os\nos.mkdir('executed')\n"
    packed, tape = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("policy.py", code)
        archive.writestr("mine.safetensors", data)
    with tarfile.open(fileobj=tape, mode="w:gz") as archive:
        link = tarfile.TarInfo("../../executed")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc"
        archive.addfile(link)
    arrays = io.BytesIO()
    np.savez(arrays, policy=np.zeros(9))
    yield "zip", packed.getvalue()
    yield "tar", tape.getvalue()
    yield "npz", arrays.getvalue()
    yield "compressed", zlib.compress(data)
    yield "code", code
    yield "after code", code + data
    yield "code behind", data + code
    yield "empty", b""
    yield "twice", data + data
    yield "pickle", lambda path: path.write_bytes(pickle.dumps(Payload(path.with_name("executed"))))
    yield "pickle of objects", objects_saved
    for length in (0, 1, len(data), 2**31, 2**63, 2**64 - 1):
        yield f"header of {length} bytes", struct.pack("<Q", length) + data[8:]
    for k, text in enumerate(
        (b"[" * 100_000, b"{}", b"[]", b"null", b"NaN", b'{"__metadata__": 1}', b"\xff\xfe{}", b"1" * 9000)
    ):
        yield f"header {k}", struct.pack("<Q", len(text)) + text + data[8:]
        inner = json.dumps({"__metadata__": {"pharos": text.decode("latin1")}}).encode()
        yield f"record {k}", struct.pack("<Q", len(inner)) + inner
    (length,) = struct.unpack("<Q", data[:8])
    head = data[8 : 8 + length]
    again = head[:-1] + b', "__metadata__": {"pharos": "{}"}}'
    yield "two records", struct.pack("<Q", len(again)) + again + data[8 + length :]
    yield "pipe", lambda path: os.mkfifo(path)
    yield "link to zeros", lambda path: path.symlink_to("/dev/zero")
    yield "link to itself", lambda path: path.symlink_to(path.name)
    yield "link to nothing", lambda path: path.symlink_to("nothing")
    yield "link to a file", lambda path: path.symlink_to("/etc/passwd")
    yield "folder", lambda path: path.mkdir()
    yield "hole", lambda path: (path.write_bytes(data), os.truncate(path, 1 << 34))


FAMILIES = {
    "grid": (claims, settings, descriptions, arrays, containers),
    "river": (claims, arrays),
    "network": (claims, arrays),
}


# What is true ---------------------------------------------------------------------------------------------------------


def true_values(file: Path) -> tuple[float, float, float]:
    """The value of the policy in a file, V* and U at the start, from the rules and by explicit matrices."""
    content = Content.of(file)
    config, table = content.record["config"], content.arrays["policy"]
    env = pharos.make(config["environment"], **config["parameters"])
    mdp = pharos.build(env, progress=False).mdp(gamma=float(config["gamma"]))
    chance = {name: config["chance"].get(name, 0) for name in ("sticky", "random")}
    mdp = pharos.random_actions(pharos.sticky_actions(mdp, chance["sticky"]), chance["random"])
    P, R, start = augmented(mdp)
    states, actions = mdp.num_states, mdp.num_actions
    if table.ndim == 1:
        table = np.repeat(np.eye(actions)[table.astype(int)][:, None], actions + 1, axis=1)
    policies = np.concatenate([table.reshape(states * (actions + 1), actions), np.eye(actions)[:1]]).astype(float)
    policies /= policies.sum(axis=1, keepdims=True)
    uniform, best = np.full_like(policies, 1 / actions), None
    found = []
    for policy in (policies, best, uniform):
        v = np.zeros(len(P))
        for _ in range(config["horizon"]):
            q = R + mdp.gamma * P @ v
            v = q.max(axis=1) if policy is None else (policy * q).sum(axis=1)
        found.append(float(start @ v))
    return tuple(found)


def is_true(claim: dict[str, Any], value: float, best: float, uniform: float) -> bool:
    """Whether a claim is true, but for rounding."""
    rounding = 1e-5 * max(1.0, abs(best))
    within = rounding if claim["exact"] else claim["error_bound"] + rounding
    return (
        abs(claim["value"] - value) <= within
        and abs(claim["regret"] - (best - value)) <= within + rounding
        and abs(claim["value_optimal"] - best) <= rounding
        and abs(claim["value_uniform"] - uniform) <= rounding
        and claim["value"] - within <= best + rounding
        and claim["error_bound"] <= best - uniform + rounding
    )


def judgement(file: Path, kind: str, honest: benchmark.EntryVerdict) -> str:
    """What `verify` says of an entry, and whether that is true."""
    verdict = benchmark.verify(file, **LIMITS)
    if not verdict.holds:
        return "does not hold"
    claim = vars(verdict.entry.claim)
    if kind == "network":
        truth = (honest.value, honest.value_optimal, honest.value_uniform)
        if verdict.entry.config.gamma != 1 or verdict.entry.config.horizon != honest.entry.config.horizon:
            truth = (verdict.value, verdict.value_optimal, verdict.value_uniform)
    else:
        truth = true_values(file)
    is_right = is_true(claim, *truth) and abs(verdict.value - truth[0]) <= 1e-5 * max(1.0, abs(truth[1]))
    return "true" if is_right else f"holds, and is false: {claim}, in truth {truth}"


@pytest.fixture(params=FAMILIES)
def forgeries(request, honest, tmp_path):
    """Kind of the honest entry, and name of each forged file -> what it is."""
    kind, folder = request.param, tmp_path / "entries"
    folder.mkdir()
    content, names = Content.of(honest[kind]), {}
    for family in FAMILIES[kind]:
        for what, forged in family(content):
            name = f"{len(names):04d}.safetensors"
            names[name] = f"{family.__name__}: {what}"
            (folder / name).write_bytes(forged) if isinstance(forged, bytes) else forged(folder / name)
    return kind, folder, names


def test_no_forged_entry_is_believed_or_stops_another(forgeries, honest, tmp_path, count, monkeypatch):
    monkeypatch.setattr("attacks.damage.MORE_MEMORY", 2 << 30)
    kind, folder, names = forgeries
    verdict, tally, said = benchmark.verify(honest[kind]), Tally(), Counter()

    def judge(file):
        answer = judgement(file, kind, verdict)
        said[answer] += 1
        return answer

    assert judgement(honest[kind], kind, verdict) == "true"
    for name, what in names.items():
        ended, text = outcome(lambda name=name: judge(folder / name), ("'true'", "'does not hold'"))
        tally.note(f"{name} {what}", ended, text)
    assert not list(tmp_path.rglob("executed")), "code was executed"
    tally.check()

    (folder / "honest.safetensors").write_bytes(honest[kind].read_bytes())
    made = benchmark.board(folder, tmp_path / "board.html", **LIMITS)
    listed = {path.name for path in folder.iterdir() if path.is_file()}
    verified = {each.file.name for each in made.verified}
    assert "honest.safetensors" in verified and listed == {*verified, *made.refused}
    assert all(text.strip() and "\n" not in text and len(text) < 1000 for text in made.refused.values())
    page = made.file.read_text()
    assert page.count("<script>") == 1 and ' onmouseover="' not in page
    count(
        f"{tally.total} entries forged from {kind}: {tally.counts['refused']} refused, {said['does not hold']} do not "
        f"hold, {said['true']} claim what is true"
    )
