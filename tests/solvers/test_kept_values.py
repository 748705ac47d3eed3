"""Values in files: the same as in memory, to the last bit, with bounds that hold from whatever a file holds."""

import dataclasses
import errno
import importlib
import inspect
import io
import itertools
import os
import signal
import sys
import tempfile
from functools import partial

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from children import exit_code
from naive import exact as naive_exact
from pharos import hardness, solvers
from pharos.errors import FileFormatError, FolderLocked, ParameterError, PrecisionError
from pharos.mdp import TabularMDP
from pharos.solvers import Solving, uniform_value, value_iteration, worst_value
from pharos.system import memory
from refusals import failing, refusal
from strategies import examples, small_mdps

values = importlib.import_module("pharos.solvers.values")


def ring(size: int = 400, gamma: float = 0.99) -> TabularMDP:
    """On by one or by two; the last state pays 1 and leads to the first: a sweep carries values once around."""
    state = np.arange(size)
    table = np.stack([(state + 1) % size, (state + 2) % size], axis=1)
    rewards = np.zeros((size, 2))
    rewards[-1, 0] = 1.0
    return TabularMDP.from_arrays(table, rewards, gamma=gamma)


@pytest.fixture
def no_memory(monkeypatch):
    """Whatever is large is in a mapped file, and nothing is small."""
    monkeypatch.setattr(memory, "SMALL_BYTES", 0)
    monkeypatch.setattr(memory, "available_memory", lambda: 0)


def test_large_zeros_are_a_file_without_a_name_where_memory_has_no_room(tmp_path, monkeypatch, no_memory):
    monkeypatch.setenv("PHAROS_CACHE_DIR", str(tmp_path / "cache"))
    array = memory.large_zeros((3, 5), np.float64)
    assert array.shape == (3, 5) and not array.any() and not array.flags.owndata
    array[:] = np.arange(15).reshape(3, 5)
    assert array.sum() == 105 and list((tmp_path / "cache").iterdir()) == []


class RecordingFile(io.BytesIO):
    """A file in memory that keeps the sizes of what is written."""

    def __init__(self):
        super().__init__()
        self.sizes = []

    def write(self, data):
        self.sizes.append(len(data))
        return super().write(data)


def test_zeros_are_written_in_blocks_where_the_system_cannot_take_their_room(monkeypatch):
    monkeypatch.delattr(os, "posix_fallocate", raising=False)
    monkeypatch.setattr(memory, "_BYTES_AT_ONCE", 64)
    file = RecordingFile()
    file.write(b"header")
    memory.append_zeros(file, 150)
    assert file.getvalue() == b"header" + bytes(150) and file.sizes == [6, 64, 64, 22]


def test_values_in_files_are_those_in_memory_to_the_last_bit(tmp_path, monkeypatch):
    mdp = ring()
    expected = value_iteration(mdp)
    kept = value_iteration(mdp, values=tmp_path / "values.npy")
    assert (kept.x == expected.x).all() and kept.sweeps == expected.sweeps and kept.error_bound == expected.error_bound
    assert (np.load(tmp_path / "values.npy", mmap_mode="r") == expected.x).all()
    monkeypatch.setattr(memory, "SMALL_BYTES", 0)
    monkeypatch.setattr(memory, "available_memory", lambda: 0)
    assert (value_iteration(mdp).x == expected.x).all()


def test_large_values_are_swept_in_memory_and_end_in_their_file(tmp_path, monkeypatch):
    mdp, path = ring(), tmp_path / "values.npy"
    whole = value_iteration(mdp)
    monkeypatch.setattr(memory, "SMALL_BYTES", 0)

    def look(sweeps, _):
        assert not np.load(path).any()  # what is swept is elsewhere
        if sweeps == whole.sweeps - 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        value_iteration(mdp, values=path, progress=look)
    resumed = value_iteration(mdp, values=path)
    assert resumed.sweeps <= 2 and (resumed.x == whole.x).all() and (np.load(path) == whole.x).all()
    monkeypatch.setattr(values, "_SECONDS", 0.0)  # what is swept is copied between sweeps
    seen = []
    value_iteration(
        mdp, values=tmp_path / "again.npy", progress=lambda *_: seen.append(np.load(tmp_path / "again.npy"))
    )
    assert seen[0].any()


def test_transitions_that_memory_has_no_room_for_are_read_by_pieces(tmp_path, monkeypatch):
    space = pharos.build(pharos.make("breakout", height=6, columns=2), tmp_path / "space", progress=False)
    mdp = space.mdp(gamma=0.99)
    expected, reads = value_iteration(mdp), []
    monkeypatch.setattr(memory, "PIECE", 7)
    monkeypatch.setattr(memory, "available_memory", lambda: 100 * mdp.num_actions * 4)
    whole = memory._UncachedFile.read
    monkeypatch.setattr(memory._UncachedFile, "read", lambda *words: reads.append(words[1:3]) or whole(*words))
    again = value_iteration(mdp)
    assert (again.x == expected.x).all()
    assert (again.sweeps, again.error_bound) == (expected.sweeps, expected.error_bound)
    assert max(stop for _, stop in reads) == mdp.num_states and min(reads)[0] == 100 * 3 // 4 - 4 * 7


@pytest.mark.parametrize("size", [7, 1000, 5000])
def test_pieces_make_up_all_rows_once(tmp_path, monkeypatch, size):
    rows = np.arange(30_000, dtype=np.int32).reshape(-1, 3)
    rows.tofile(tmp_path / "rows.bin")
    mapped = np.memmap(tmp_path / "rows.bin", np.int32, "r", shape=rows.shape)[50:]
    monkeypatch.setattr(memory, "PIECE", size)
    monkeypatch.setattr(memory, "available_memory", lambda: 1)
    advice = []
    monkeypatch.setattr(memory, "_advise", lambda *words: advice.append(words[-1]))
    for kept in (0, 123, 9000, 9950):
        stops = [9950]
        for array, start, stop in memory.pieces_from_the_end(mapped, 100, 9950, kept):
            assert stop == stops[-1] and array.shape == mapped.shape and array.dtype == mapped.dtype
            assert (array[start:stop] == rows[50 + start : 50 + stop]).all() and not array.flags.writeable
            stops.append(start)
        assert stops[-1] == 100
    assert memory._COLD not in advice  # rows that have room are wanted in the next sweep
    (tmp_path / "rows.bin").unlink()
    assert [place[1:] for place in memory.pieces_from_the_end(mapped, 100, 9950, 123)] == [(100, 9950)]
    assert sys.platform != "linux" or memory._COLD in advice


@pytest.mark.long
def test_gaps_with_values_in_files_are_those_in_memory_to_the_last_bit(tmp_path, monkeypatch):
    mdp = ring()
    expected = hardness.gaps(mdp)
    monkeypatch.setattr(memory, "SMALL_BYTES", 0)
    monkeypatch.setattr(memory, "available_memory", lambda: 0)
    assert hardness.gaps(mdp).to_dict() == expected.to_dict()
    names = ["sum_of_reciprocal_gaps", "minimal_gap"]
    kept = hardness.report(mdp, names, folder=tmp_path)
    assert kept[names[0]].value == expected.sum_of_reciprocals and kept[names[1]].value == expected.minimal
    assert kept[names[0]].certificate.lower == expected.lower and kept[names[0]].certificate.upper == expected.upper


@pytest.mark.long
@examples(40, small_mdps())
def test_values_settled_in_their_file_have_the_gaps_of_a_copy(tmp_path_factory, mdp):
    names = ["sum_of_reciprocal_gaps", "sum_of_reciprocal_gaps_regularized", "minimal_gap"]
    alone, folder = hardness.report(mdp, names), tmp_path_factory.mktemp("values")
    kept = hardness.report(mdp, names, folder=folder)
    again = hardness.report(mdp, names, folder=folder)  # from values that are settled
    for name in names:
        assert kept[name].value == alone[name].value and kept[name].certificate == alone[name].certificate
        for ours, other in itertools.permutations((alone[name].certificate, again[name].certificate)):
            assert ours.lower is None or other.upper is None or ours.lower <= other.upper


def test_a_solve_goes_on_from_the_values_of_one_that_stopped(tmp_path):
    mdp, path = ring(), tmp_path / "values.npy"
    whole = value_iteration(mdp)
    with pytest.raises(KeyboardInterrupt):
        value_iteration(
            mdp, values=path, progress=lambda sweeps, bound: _stop() if sweeps == whole.sweeps - 2 else None
        )
    resumed = value_iteration(mdp, values=path)
    assert resumed.sweeps <= 2 and resumed.error_bound <= 1e-6 and (resumed.x == whole.x).all()
    del resumed
    assert value_iteration(mdp, values=path).sweeps == 1  # what is solved is solved


def _stop():
    raise KeyboardInterrupt


@pytest.mark.long
@examples(60, small_mdps(), st.integers(0, 2**32))
def test_bounds_hold_from_whatever_a_file_holds(tmp_path_factory, mdp, seed):
    path = tmp_path_factory.mktemp("any") / "values.npy"
    rng = np.random.default_rng(seed)
    anything = rng.choice([0.0, 1.0, -3.5, 1e6, np.nan, np.inf, 1e-300], (mdp.num_states + 1, mdp.width))
    np.save(path, anything)
    solution = value_iteration(mdp, values=path)
    assert naive_exact.largest_error(solution.v, naive_exact.extreme_values(mdp)) <= solution.error_bound <= 1e-6


@pytest.mark.long
def test_a_killed_solve_leaves_values_to_go_on_from(tmp_path):
    mdp, path = ring(20_000, 0.9999), tmp_path / "values.npy"
    uniform_value(mdp, values=tmp_path / "compiled.npy", tolerance=1e3)  # compiles, before the child is forked
    assert exit_code(_killed_in_sweep, mdp, path, 5) == -signal.SIGKILL
    left = np.load(path)
    assert np.isfinite(left).all() and left.any()
    fresh = uniform_value(mdp, tolerance=1e-10)
    resumed = uniform_value(mdp, tolerance=1e-10, values=path)
    assert resumed.sweeps < fresh.sweeps
    assert (abs(resumed.v - fresh.v) <= resumed.error_bound + fresh.error_bound).all()


def _killed_in_sweep(mdp, path, last):
    uniform_value(
        mdp, 1e-10, values=path, progress=lambda n, _: os.kill(os.getpid(), signal.SIGKILL) if n == last else None
    )


@pytest.mark.parametrize("answer", [None, errno.ENOLCK, errno.ENOSYS])
def test_a_file_of_values_is_for_one_solve_of_one_mdp_at_a_time(tmp_path, monkeypatch, answer):
    """Where the file system has no locks, too: a claim stands for one, and goes with the values."""
    if answer is not None:
        monkeypatch.setattr(memory.fcntl, "flock", failing(answer))
    path = tmp_path / "values.npy"
    solution = value_iteration(ring(), values=path)
    with pytest.raises(FolderLocked, match=r"in use|is using values there"):
        value_iteration(ring(), values=path)
    assert solution.v[-1] > 0
    assert (tmp_path / "values.npy.claim").exists() == (answer is not None)
    del solution
    assert [file.name for file in tmp_path.iterdir()] == ["values.npy"]
    with pytest.raises(
        FileFormatError, match=r"holds float64 of shape \(401, 1\); expected float64 of shape \(11, 1\)"
    ):
        value_iteration(ring(10), values=path)
    path.write_bytes(b"something else")
    assert "is no file of values" in refusal(FileFormatError, value_iteration, ring(), values=path)
    with pytest.raises(ParameterError, match="without a horizon"):
        value_iteration(ring(), values=tmp_path / "other.npy", horizon=3)
    assert "cannot be used for values" in refusal(ParameterError, value_iteration, ring(), values=tmp_path)


@pytest.mark.parametrize("threads", (2, 3))
def test_threads_share_a_sweep_and_the_bound_holds(threads):
    mdp = ring()
    alone, shared = value_iteration(mdp), value_iteration(mdp, threads=threads)
    assert shared.error_bound <= 1e-6
    assert (abs(shared.v - alone.v) <= shared.error_bound + alone.error_bound).all()


@pytest.mark.long
@examples(60, small_mdps(), st.integers(2, 9))
def test_bounds_hold_whatever_the_threads(mdp, threads):
    solution = value_iteration(mdp, threads=threads)
    assert naive_exact.largest_error(solution.v, naive_exact.extreme_values(mdp)) <= solution.error_bound <= 1e-6


@pytest.mark.long
@examples(100, small_mdps(), st.sampled_from((1.0, -3e4, 1e-12, 0.1)), st.booleans())
def test_bounds_of_values_of_32_bits_count_what_is_lost(mdp, scale, is_kept):
    mdp = mdp.with_rewards(mdp.rewards * scale)
    tolerance = 4e-7 * abs(scale) / (1 - mdp.gamma) ** 2 + 1e-40
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "values.npy") if is_kept else None
        solution = value_iteration(mdp, tolerance, values=path, dtype="float32")
        assert solution.x.dtype == np.float32
        truth = naive_exact.extreme_values(mdp)
        assert naive_exact.largest_error(solution.v, truth) <= solution.error_bound <= tolerance
        del solution


@pytest.mark.long
def test_values_of_32_bits_take_half_of_the_file_and_refuse_what_they_cannot_reach(tmp_path):
    mdp, path = ring(), tmp_path / "values.npy"
    double = value_iteration(mdp)
    single = value_iteration(mdp, 1e-3, values=path, dtype="float32")
    assert np.abs(single.v - double.v).max() <= single.error_bound + double.error_bound
    assert path.stat().st_size - 128 == single.x.nbytes == double.x.nbytes // 2 and single.q.dtype == np.float64
    del single
    with pytest.raises(PrecisionError, match=r"32-bit floats reach a bound of .*use float64"):
        value_iteration(mdp, 1e-9, dtype="float32")
    assert "holds float32 of shape" in refusal(FileFormatError, value_iteration, mdp, values=path)


def test_values_of_32_bits_are_for_one_process_and_no_horizon():
    mdp = ring()
    for wrong in ({"horizon": 3}, {"processes": "mpi"}):
        assert "one process and no horizon" in refusal(ParameterError, value_iteration, mdp, dtype="float32", **wrong)
    assert "expected 'float64' or 'float32'" in refusal(ParameterError, value_iteration, mdp, dtype="float16")


@pytest.mark.long
@examples(150, small_mdps(), st.sampled_from(("float64", "float32")), st.integers(1, 3))
def test_bounds_hold_whatever_the_options(mdp, dtype, threads):
    tolerance = 1e-6 if dtype == "float64" else 1e-6 / (1 - mdp.gamma) ** 2
    solution = value_iteration(mdp, Solving(tolerance=tolerance, dtype=dtype, threads=threads))
    truth = naive_exact.extreme_values(mdp)
    assert naive_exact.largest_error(solution.v, truth) <= solution.error_bound <= tolerance


def test_one_object_of_options_is_the_same_as_keywords(tmp_path):
    mdp, solving = ring(), Solving(tolerance=1e-3)
    for solver in (value_iteration, worst_value, uniform_value, partial(pharos.evaluate_policy, policy=[0] * 400)):
        one, other = solver(mdp, tolerance=solving), solver(mdp, tolerance=1e-3)
        assert (one.x == other.x).all() and one.error_bound == other.error_bound
    assert value_iteration(mdp, solving, horizon=4).horizon == 4
    stored = solvers.evaluate_policy(mdp, [0] * 400, solving, values=tmp_path / "values.npy", dtype="float32")
    assert stored.x.dtype == np.float32 and stored.error_bound <= 1e-3
    expected = solvers.evaluate_policy(mdp, [0] * 400)
    assert np.abs(stored.v - expected.v).max() <= stored.error_bound + expected.error_bound


def test_fields_and_keywords_of_solving_are_the_same():
    fields = {each.name for each in dataclasses.fields(Solving)}
    assert fields == {"tolerance", *solvers.SolvingOptions.__annotations__}
    assert fields <= {*inspect.signature(value_iteration).parameters}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0.0}, "expected a positive number"),
        ({"horizon": 3, "values": "x.npy"}, "a file keeps values without a horizon; found 3 steps"),
        ({"processes": "mpi", "values": "x.npy"}, "several processes keep theirs in a folder"),
        ({"processes": "mpi", "keep_all": True}, "several processes keep the last step alone"),
        ({"dtype": "float32", "horizon": 3}, "one process and no horizon"),
    ],
)
def test_options_that_do_not_go_together_are_refused_before_any_mdp(options, message):
    assert message in refusal(ParameterError, Solving, **options)


def test_true_is_no_number_of_processes():
    for evaluate in (pharos.evaluate_policy, solvers.evaluate_policy):
        assert "processes" in refusal(ParameterError, evaluate, ring(), [0] * 400, processes=True)


def test_a_file_of_values_is_refused_if_the_mdp_has_a_horizon(tmp_path):
    message = refusal(ParameterError, value_iteration, ring().with_horizon(5), values=tmp_path / "x.npy")
    assert "found 5 steps" in message and not (tmp_path / "x.npy").exists()


def test_rows_that_fill_memory_are_all_swept_and_stay_what_they_are(tmp_path, monkeypatch, no_memory):
    monkeypatch.setattr(memory, "RANGE_ROWS", 1000)
    rows = np.arange(30_000, dtype=np.int32).reshape(-1, 3)
    rows.tofile(tmp_path / "rows.bin")
    mapped = np.memmap(tmp_path / "rows.bin", np.int32, "r", shape=rows.shape)
    ranges = list(memory.ranges_from_the_end(mapped, 100, len(rows)))
    assert ranges[0] == (9000, 10_000) and ranges[-1] == (100, 1000)
    assert all(start == stop for (start, _), (_, stop) in itertools.pairwise(ranges)) and (mapped == rows).all()
