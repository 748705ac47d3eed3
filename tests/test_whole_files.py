"""Exports, images and policies are replaced in one step: on a full disk the older file of the name is still there."""

import multiprocessing
import os
import resource
import signal
import warnings

import numpy as np
import pytest

import pharos
from pharos import drawing, exporters
from pharos.cli.solve import save
from pharos.mdp import TabularMDP
from pharos.plots import save as save_figure
from pharos.system.storage import replace_file

fork = multiprocessing.get_context("fork")


def mdp():
    rng = np.random.default_rng(0)
    return TabularMDP.from_arrays(rng.integers(0, 400, (400, 4)), rng.random((400, 4)))


def noise():
    return np.random.default_rng(0).integers(0, 255, (80, 80, 3), np.uint8)


def figure():
    from matplotlib.figure import Figure

    made = Figure()
    made.subplots().plot(np.random.default_rng(0).random(300))
    return made


WRITERS = {
    "x.npz": lambda path: exporters.bridge(mdp(), path),
    "x.drn": lambda path: exporters.drn(mdp(), path),
    "x.png": lambda path: drawing.save_png(path, noise()),
    "x.gif": lambda path: drawing.save_gif(path, [noise(), noise()[::-1]]),
    "plot.png": lambda path: save_figure(figure(), path),
    "plot.svg": lambda path: save_figure(figure(), path),
    "plot.pdf": lambda path: save_figure(figure(), path),
    "policy.npz": lambda path: save(path, pharos.value_iteration(mdp())),
    "policy.npy": lambda path: save(path, pharos.value_iteration(mdp())),
    "x.txt": lambda path: replace_file(path, "#" * 5000),
}


def _write_with_little_disk(name, folder):
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
    try:
        WRITERS[name](folder / name)
    except OSError as error:
        os._exit(7 if error.filename == str(folder / name) else 1)
    os._exit(0)


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_older_file(name, tmp_path):
    WRITERS[name](tmp_path / name)
    assert (tmp_path / name).stat().st_size > 1000
    (tmp_path / name).write_text("older")
    process = fork.Process(target=_write_with_little_disk, args=(name, tmp_path))
    process.start()
    process.join()
    assert process.exitcode == 7
    assert (tmp_path / name).read_text() == "older"
    assert [path.name for path in tmp_path.iterdir()] == [name]
