"""Several processes at once in one folder, as the jobs of an array: what waits, what is refused, and what is left."""

import multiprocessing
import os
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest

from patience import PATIENCE
from pharos import importers
from pharos.mdp import TabularMDP

NUMBER = 3
fork = multiprocessing.get_context("fork")


def at_once(words, folder, **variables):
    """(exit code, standard output, standard error) of NUMBER equal commands begun together."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "cwd": folder}
    command, there = [sys.executable, "-m", "pharos", *words.split()], os.environ | variables
    running = [subprocess.Popen(command, env=there, **options) for _ in range(NUMBER)]
    texts = [process.communicate() for process in running]
    return [(process.returncode, *text) for process, text in zip(running, texts, strict=True)]


@pytest.mark.long
def test_one_of_several_trains_in_a_folder_and_the_others_say_so_in_a_line(tmp_path):
    command = "train simple_grid/4x4-plain --steps 3000 --interval 100 --out"
    done = at_once(f"{command} run", tmp_path)
    assert any(code == 0 for code, *_ in done)
    for code, _, said in done:
        assert code in (0, 1) and "Traceback" not in said, said
        assert code == 0 or re.fullmatch(r"pharos: run: another process .*is training there; wait for it, .*\n", said)
    subprocess.run([sys.executable, "-m", "pharos", *command.split(), "alone"], cwd=tmp_path, check=True)
    for name in ("curve.csv", "policy.npy"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    names = [sorted(path.name for path in (tmp_path / name).iterdir()) for name in ("run", "alone")]
    assert names[0] == names[1]


@pytest.mark.long
def test_a_cold_cache_fails_nobody(tmp_path):
    """One builds, the others wait for it."""
    done = at_once("solve frozen_lake/8x8", tmp_path, PHAROS_CACHE_DIR=str(tmp_path / "cache"))
    assert [code for code, *_ in done] == [0] * NUMBER, done
    assert len({output.partition("sweeps")[0] for _, output, _ in done}) == 1
    waits = r"(pharos: warning: .*another process is building there; .*\n)?"
    assert all(re.fullmatch(waits, said) for *_, said in done)


def _import(mdp, folders, barrier):
    warnings.simplefilter("ignore")  # it is said who is waited for
    for folder in folders:
        barrier.wait()
        importers.save(mdp, folder)


def test_importers_of_one_folder_wait_for_each_other(tmp_path):
    mdps = [TabularMDP.from_arrays(np.zeros((k, 2), int), np.ones((k, 2))) for k in range(1, NUMBER + 1)]
    folders, barrier = [tmp_path / str(k) for k in range(4)], fork.Barrier(NUMBER)
    running = [fork.Process(target=_import, args=(mdp, folders, barrier), daemon=True) for mdp in mdps]
    for process in running:
        process.start()
    for process in running:
        process.join(PATIENCE)
    assert [process.exitcode for process in running] == [0] * NUMBER
    for folder in folders:
        assert 1 <= importers.load(folder).num_states <= NUMBER  # its digests are those of one of them
