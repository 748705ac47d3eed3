"""Exports, images and policies are replaced in one step: on a full disk the older file of the name is still there."""

import os
import resource
import signal
import warnings

import numpy as np
import pytest

import pharos
from children import exit_code
from patience import PATIENCE
from pharos import drawing, exporters, hardness, importers
from pharos.cli.evaluate import save
from pharos.errors import FileFormatError
from pharos.mdp import TabularMDP
from pharos.plots import save as save_figure
from pharos.system.storage import replace_file
from pharos.training import load_agent, read_rows


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
    assert exit_code(_write_with_little_disk, name, tmp_path) == 7
    assert (tmp_path / name).read_text() == "older"
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.fixture
def with_patience():
    """A reader that waits for a pipe is ended."""

    def stop(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(int(PATIENCE))
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def be_a_pipe(path):
    path.unlink()
    os.mkfifo(path)


def be_endless(path):
    path.unlink()
    path.symlink_to("/dev/zero")


@pytest.mark.long
@pytest.mark.parametrize("become", [be_a_pipe, be_endless])
@pytest.mark.parametrize("name", ["run.json", "curve.csv", "policy.npy"])
def test_pipes_and_devices_in_the_folder_of_a_run_are_refused(name, become, tmp_path, with_patience):
    pharos.train("q_learning", "frozen_lake/4x4", steps=50, out=tmp_path / "run")
    become(tmp_path / "run" / name)
    with pytest.raises(FileFormatError, match=rf"{name}: cannot be read.* it is no regular file"):
        read_rows(tmp_path / "run") if name == "curve.csv" else load_agent(tmp_path / "run")


@pytest.mark.long
@pytest.mark.parametrize("become", [be_a_pipe, be_endless])
def test_pipes_and_devices_among_the_files_of_mdps_are_refused(become, tmp_path, with_patience):
    importers.save(mdp(), tmp_path / "mdp")
    for file in sorted((tmp_path / "mdp").glob("*.npy")):
        whole = file.read_bytes()
        become(file)
        with pytest.raises(FileFormatError, match=rf"{file.name}: cannot be read: it is no regular file"):
            importers.load(tmp_path / "mdp")
        file.unlink()
        file.write_bytes(whole)
    exporters.bridge(mdp(), tmp_path / "x.npz")
    become(tmp_path / "x.npz")
    with pytest.raises(FileFormatError, match=r"x\.npz: cannot be read .*no regular file"):
        importers.bridge(tmp_path / "x.npz")
    hardness.report(pharos.build("simple_grid", tmp_path / "grid", progress=False).mdp(), ["diameter"])
    become(tmp_path / "grid" / "hardness.json")
    assert hardness.report(pharos.load(tmp_path / "grid").mdp(), ["diameter"])["diameter"].value is not None
