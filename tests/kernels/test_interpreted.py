"""Little work is done in Python: the answers are those of compiled code to the bit, and nothing is compiled for it."""

import hashlib
import importlib
import json
import math
import os
import pickle
import pkgutil
import subprocess
import sys
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

import pharos
from pharos import hardness, kernels, solvers
from pharos.rules.compiled import CompiledExpansion
from pharos.rules.interpreted import InterpretedExpansion
from pharos.rules.layout import layout_of
from pharos.system import compiling

TESTS = Path(__file__).parents[1]
INSTANCES = (
    ("frozen_lake/4x4", {}),
    ("frozen_lake/4x4", {"slippery": True}),
    ("freeway", {"num_cars": 2, "lane_length": 3}),
    ("breakout", {"height": 6, "columns": 2}),
)


def answers(folder):
    """Files, values and hardness of small instances, with all kinds of chance: digests and texts."""
    found = {}
    for i, (name, parameters) in enumerate(INSTANCES):
        space = pharos.build(pharos.make(name, **parameters), folder / str(i), progress=False)
        files = sorted(path for path in space.folder.iterdir() if path.suffix == ".npy" or path.suffix == ".bin")
        found[i, "files"] = {path.name: digest(path.read_bytes()) for path in files}
        plain = space.mdp(gamma=0.9)
        mdps = plain, pharos.random_actions(plain, 0.2), pharos.sticky_actions(plain, 0.25), plain.with_horizon(6)
        for j, mdp in enumerate(mdps):
            solution = pharos.value_iteration(mdp, tolerance=1e-4)
            uniform = solvers.uniform_value(mdp, tolerance=1e-4)
            found[i, j, "values"] = [digest(each.tobytes()) for each in (solution.v, solution.q, uniform.v)]
            found[i, j, "bounds"] = solution.error_bound, uniform.error_bound
            measures = "sum_of_reciprocal_gaps,minimal_gap" + (",diameter" if mdp is plain else "")
            results = hardness.report(mdp, measures, keep=False, tolerance=1e-4).results.values()
            found[i, j, "hardness"] = [(each.text, each.undefined, each.certificate.kind) for each in results]
    return found


def digest(data):
    return hashlib.sha256(data).hexdigest()


def compiled_kernels():
    """Those that may be interpreted, and are compiled for some types."""
    modules = [
        importlib.import_module(f"pharos.kernels.{each.name}") for each in pkgutil.iter_modules(kernels.__path__)
    ]
    found = {name: value for module in modules for name, value in vars(module).items()}
    return [
        name
        for name, each in found.items()
        if isinstance(each, CPUDispatcher)
        and "_compile_for_args" in vars(each)
        and each.signatures
        and not each.targetoptions.get("no_cpython_wrapper")  # what kernels alone call
    ]


def in_another_process(*words, **environment):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(TESTS / "kernels")]), **environment}
    return subprocess.run([sys.executable, *words], env=environment, stdout=subprocess.PIPE, check=True).stdout


@pytest.mark.long
def test_interpreted_kernels_give_the_bits_of_compiled_ones(tmp_path):
    code = f"""
import pickle, sys
from pathlib import Path
from types import SimpleNamespace
from pharos.rules.compiled import CompiledExpansion
from pharos.rules.interpreted import InterpretedExpansion
from pharos.rules.layout import layout_of
from pharos.system import compiling
compiling.SMALL_STATES = 1 << 24
import test_interpreted
found = test_interpreted.answers(Path({str(tmp_path / "interpreted")!r}))
sys.stdout.buffer.write(pickle.dumps((found, test_interpreted.compiled_kernels())))
"""
    interpreted, compiled = pickle.loads(in_another_process("-c", code))
    assert compiled == []
    assert interpreted == answers(tmp_path / "compiled")
    assert "optimal_sweep" in compiled_kernels()


@pytest.mark.long
def test_the_hardness_of_a_lake_compiles_nothing(tmp_path):
    caches = {"PHAROS_CACHE_DIR": str(tmp_path), "NUMBA_CACHE_DIR": ""}
    answer = json.loads(in_another_process("-m", "pharos", "hardness", "frozen_lake/8x8", "--json", **caches))
    assert answer["compiling_seconds"] == 0
    assert not any(tmp_path.rglob("*.nbc"))
    assert answer["measures"]["diameter"]["upper"] == 15


def test_much_work_is_compiled(monkeypatch):
    from numba import njit

    from pharos.kernels.interpreted import interpreted_first

    @interpreted_first()
    @njit
    def total(x):
        result = 0.0
        for i in range(len(x)):
            result += x[i]
        return result

    monkeypatch.setattr(compiling, "SMALL_STATES", 100)
    x = np.full(30, 0.1)
    assert [(total(x), bool(total.signatures)) for _ in range(7)] == [(sum(x), False)] * 6 + [(sum(x), True)]


def test_rules_that_are_compiled_already_are_hardly_interpreted_again(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "SMALL_STATES", 1 << 14)
    env = pharos.make("breakout", height=7, columns=5, brick_rows=1)
    pharos.build(env, tmp_path / "first", progress=False)
    asked = []
    expand = InterpretedExpansion.expand_and_find

    def counted(self, states, start, stop, *rest):
        asked.append(stop - start)
        expand(self, states, start, stop, *rest)

    monkeypatch.setattr(InterpretedExpansion, "expand_and_find", counted)
    pharos.build(env, tmp_path / "second", progress=False)
    assert not asked
    monkeypatch.setattr("pharos.rules.rules.explored", set())  # as in another process, which finds them on disk
    space = pharos.build(env, tmp_path / "third", progress=False)
    assert 0 < sum(asked) < compiling.SMALL_STATES // 16 // space.num_actions < space.num_states


def test_threads_wait_for_work_that_is_worth_their_kernel_unless_that_is_compiled(monkeypatch):
    env = pharos.make("frozen_lake/4x4")
    expansion = CompiledExpansion(env, layout_of(env.components))
    assert expansion.threads(2) == 2  # nothing is interpreted in this process
    monkeypatch.setattr(compiling, "SMALL_STATES", 100)
    monkeypatch.setattr("pharos.rules.compiled.is_on_disk", lambda kernel: kernel.is_on_disk)
    for signatures, is_on_disk, began in product(([], [1]), (False, True), (-math.inf, math.inf)):
        kernel = SimpleNamespace(signatures=signatures, is_on_disk=is_on_disk)
        expansion.kernels, expansion._began = SimpleNamespace(expand_and_find=kernel), began
        assert expansion.threads(2) == (2 if signatures or is_on_disk or began < 0 else 1)
