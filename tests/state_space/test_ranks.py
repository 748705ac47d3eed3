"""Builds by several ranks: the bytes of one process, whatever their number, the blocks, and where they are killed."""

import contextlib
import functools
import itertools
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st
from test_resuming import build, files_of

import pharos
from patience import PATIENCE
from pharos import ranks
from pharos.errors import MissingExtra, ParameterError, RuleError, StateSpaceError, StateSpaceTooLarge
from pharos.kernels import hash_table
from pharos.ranks import Halo, RankFailed, cuts_of, run_spmd
from pharos.state_space import ranked_table, search
from pharos.state_space.manifest import Plan, lock_build
from pharos.state_space.progress import reporter
from pharos.state_space.search import Options, journal_of
from rank_threads import Killed, fails_at, loop
from refusals import failing
from strategies import examples
from worlds import ChanceWorld

WORLDS = {
    "lake": pharos.make("frozen_lake/8x8"),
    "freeway": pharos.make("freeway", num_cars=3, lane_length=5, car_speeds=(1, 2, 3), directions=(1, -1, 1)),
    "breakout": pharos.make("breakout", height=7, columns=5, brick_rows=1),
    "chance": ChanceWorld(num_positions=700, seed=1, vectors=0, possible_share=0.4, end_share=0.05, num_starts=5),
}


@functools.cache
def expected(world):
    """The files of one process."""
    with tempfile.TemporaryDirectory() as folder:
        return files_of(build(WORLDS[world], Path(folder) / "space", workers=1).folder)


def build_by_threads(env, folder, size, *, wide=0, rows=64, disturb=lambda rank: None, max_states=None):
    """What `build` does with several processes, by threads of this one, in small blocks."""
    plan = Plan(env)
    folder.mkdir(exist_ok=True)
    options = Options(max_states, None, 1, 0.0)

    def answer(rank):
        disturb(rank)
        ranked_table.answer(plan, rank, None)

    with pytest.MonkeyPatch.context() as patch, lock_build(folder), reporter(False, env) as report:
        patch.setattr(ranked_table, "SUPERSTEP_ROWS", rows)
        patch.setattr(search, "CHUNK", 8 * rows)
        manifest = pharos.state_space.read_manifest(folder)
        with loop(size, answer) as rank:
            disturb(rank)
            ranked_table.RankedSearch(plan, journal_of(folder, plan), options, report, rank, wide).run(manifest)
            ranked_table.end(rank)
    return folder


@pytest.mark.long
@pytest.mark.parametrize("world", ["breakout", pytest.param("chance", marks=pytest.mark.long)])
def test_three_ranks_write_the_files_of_one_process(world, tmp_path):
    assert files_of(build_by_threads(WORLDS[world], tmp_path / "space", 3, wide=30)) == expected(world)


@pytest.mark.long
@examples(
    60,
    world=st.sampled_from(sorted(WORLDS)),
    size=st.integers(1, 6),
    rows=st.sampled_from([8, 24, 64, 1000]),
    wide=st.sampled_from([0, 5, 100, 10_000]),
)
def test_files_do_not_depend_on_ranks_or_blocks(world, size, rows, wide):
    with tempfile.TemporaryDirectory() as folder:
        path = build_by_threads(WORLDS[world], Path(folder) / "space", size, rows=rows, wide=wide)
        assert files_of(path) == expected(world)


@pytest.mark.long
@examples(
    60,
    world=st.sampled_from(["breakout", "chance"]),
    size=st.integers(2, 5),
    who=st.integers(0, 4),
    number=st.integers(0, 120),
    then=st.integers(1, 5),
)
def test_a_build_goes_on_whoever_failed_and_however_many_go_on(world, size, who, number, then):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "space"
        with contextlib.suppress(Killed, RankFailed):
            build_by_threads(WORLDS[world], path, size, disturb=fails_at(who % size, number))
        if then == 1:
            build(WORLDS[world], path, workers=1)
        else:
            build_by_threads(WORLDS[world], path, then)
        assert files_of(path) == expected(world)


@pytest.mark.long
def test_a_failure_of_another_rank_is_told_by_the_first(tmp_path):
    with pytest.raises(RankFailed, match="rank 2: Killed: at exchange 7"):
        build_by_threads(WORLDS["breakout"], tmp_path / "space", 3, disturb=fails_at(2, 7))


@pytest.mark.slow
def test_limits_end_in_the_same_line(tmp_path):
    with pytest.raises(StateSpaceTooLarge) as alone:
        build(WORLDS["breakout"], tmp_path / "alone", max_states=500)
    with pytest.raises(StateSpaceTooLarge) as shared:
        build_by_threads(WORLDS["breakout"], tmp_path / "space", 3, max_states=500)
    assert str(shared.value).partition(",")[0] == str(alone.value).partition(",")[0]
    assert files_of(build_by_threads(WORLDS["breakout"], tmp_path / "space", 2)) == expected("breakout")


@pytest.mark.long
def test_indices_widen_while_ranks_search(tmp_path, monkeypatch):
    monkeypatch.setattr(search, "INT32_STATES", 2000)
    build(WORLDS["breakout"], tmp_path / "alone", workers=1)
    assert "successors40.bin" in files_of(tmp_path / "alone")
    build_by_threads(WORLDS["breakout"], tmp_path / "space", 3)
    assert files_of(tmp_path / "space") == files_of(tmp_path / "alone")


@pytest.mark.slow
def test_a_table_that_does_not_fit_is_one_line_and_one_process_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr("pharos.state_space.table.MemoryTable.fits", lambda *_: False)
    with pytest.raises(StateSpaceError, match=r"does not fit in the memory of 2 processes; expected .* --processes 1"):
        build_by_threads(WORLDS["breakout"], tmp_path / "space", 2)
    monkeypatch.undo()
    assert files_of(build(WORLDS["breakout"], tmp_path / "space").folder) == expected("breakout")


# Owners ---------------------------------------------------------------------------------------------------------------


@examples(30, seed=st.integers(0, 2**32 - 1), words=st.integers(1, 3))
def test_owners_keep_the_first_place_whatever_the_order_of_arrival(seed, words):
    rng = np.random.default_rng(seed)
    asked = rng.integers(0, 6, (60, words)).astype(np.uint64)
    places = rng.permutation(1000)[:60]
    known = asked[:3]
    first = {tuple(state): int(places[(asked == state).all(axis=1)].min()) for state in asked}
    for order in (np.arange(60), rng.permutation(60)):
        table = np.full(1 << 16, -1, np.int32)
        keys, numbers, entries = np.empty((200, words), np.uint64), np.empty(200, np.int64), np.empty(60, np.int64)
        count = hash_table.claim_entries(table, keys, numbers, 0, known, np.zeros(3, np.int64), np.empty(3, np.int64))
        numbers[:count] = np.arange(count)  # these have their numbers already
        count = hash_table.claim_entries(table, keys, numbers, count, asked[order], places[order], entries)
        assert (keys[entries] == asked[order]).all()
        assert count == len(first)
        for entry in range(count):
            state = tuple(keys[entry])
            is_known = any(state == tuple(each) for each in known)
            assert numbers[entry] == (entry if is_known else -1 - first[state])


@examples(30, seed=st.integers(0, 2**32 - 1), size=st.integers(1, 9))
def test_candidates_go_to_one_owner_each_in_their_order(seed, size):
    rng = np.random.default_rng(seed)
    keys = rng.integers(0, 50, (100, 2)).astype(np.uint64)
    indices = rng.integers(-5, 3, 100)
    order, counts = np.empty(100, np.int64), np.empty(size, np.int64)
    hash_table.route(keys, indices, size, order, counts)
    parts = np.split(order[: counts.sum()], np.cumsum(counts)[:-1])
    assert sorted(np.concatenate(parts)) == [*np.flatnonzero(indices < 0)]
    assert all((np.diff(part) > 0).all() for part in parts)
    owners = [{tuple(keys[j]) for j in part} for part in parts]
    assert sum(map(len, owners)) == len(set().union(*owners))


# Exchanges ------------------------------------------------------------------------------------------------------------


def echo(rank):
    """Answer a few exchanges; see `talk`."""
    for turn in range(40):
        parts = [np.full((turn * rank.rank % 5, 2), 10 * rank.rank + to, np.float32) for to in range(rank.size)]
        received = rank.exchange(parts)
        assert [len(part) for part in received] == [turn * each % 5 for each in range(rank.size)]
        assert all((part == 10 * each + rank.rank).all() for each, part in enumerate(received))
    assert rank.broadcast(np.array([7]) if rank.rank == 0 else None, np.zeros(1, np.int64)).tolist() == [7]
    every = [np.array([rank.rank])] * rank.size
    assert rank.scatter(every if rank.rank == 0 else None, every[0]).tolist() == [0]
    assert [part.tolist() for part in rank.allgather(np.array([rank.rank]))] == [[each] for each in range(rank.size)]
    gathered = [part.tolist() for part in rank.gather(np.array([rank.rank]))]
    assert gathered == [[each] if rank.rank == 0 else [] for each in range(rank.size)]


def tell(rank):
    """Messages to some of the others, in rounds; the sizes say who sends how much to whom."""
    for turn in range(40):
        rng = np.random.default_rng(turn)
        sizes = rng.integers(0, 4, (rank.size, rank.size, 2))
        places = {
            (q, i): np.full((n, 2), -1.0) for q in range(rank.size) for i, n in enumerate(sizes[q, rank.rank]) if n
        }
        for (source, _), into in places.items():
            rank.receive(source, into)
        for i, to in itertools.product(range(2), rng.permutation(rank.size)):
            if sizes[rank.rank, to, i]:
                rank.send(int(to), np.full((sizes[rank.rank, to, i], 2), 100.0 * turn + 10 * rank.rank + i))
                rank.progress()
        rank.finish()
        for (source, i), into in places.items():
            assert (into == 100 * turn + 10 * source + i).all()
        if turn % 3 == 0:
            assert rank.allgather_numbers(turn, rank.rank).tolist() == [[turn, each] for each in range(rank.size)]


@pytest.mark.parametrize("size", [1, 3])
def test_what_is_sent_arrives(size):
    with loop(size, echo) as rank:
        echo(rank)


@pytest.mark.parametrize("size", [1, 3])
def test_messages_arrive_in_their_order(size):
    with loop(size, tell) as rank:
        tell(rank)


def test_one_process_needs_no_mpi():
    run_spmd(1, echo)
    with pytest.raises(RuleError, match=r"^a rule failed$"):
        run_spmd(1, lambda rank: fail_on_purpose(rank, 0))


def fail_while_others_wait(rank):
    into = np.zeros(1)
    rank.receive((rank.rank + 1) % rank.size, into)
    if rank.rank == 1:
        raise RuleError("a rule failed")
    rank.send((rank.rank - 1) % rank.size, np.ones(1))
    rank.finish()
    rank.allgather_numbers(1.0)


def test_who_waits_for_a_message_is_told_of_a_failure():
    with pytest.raises(RuleError, match=r"^a rule failed$"), loop(3, fail_while_others_wait) as rank:
        fail_while_others_wait(rank)


# Each rank writes a file of its own: mpiexec joins what ranks print wherever it reads, in the middle of lines too.
PROGRAM = """
import os, pathlib, sys
from pharos.ranks import run_spmd
from test_ranks import echo, fail_on_purpose, fail_while_others_wait, tell
program = {"echo": echo, "tell": tell, "fail": fail_while_others_wait, "give up": fail_on_purpose}[sys.argv[1]]
try:
    run_spmd("mpi", program)
    line = "told"
except Exception as error:
    line = f"{type(error).__name__}: {error}"
pathlib.Path(sys.argv[2], str(os.getpid())).write_text(line)
"""


@pytest.mark.long
@pytest.mark.parametrize(
    "what, line",
    [("echo", "told"), ("tell", "told"), ("fail", "RuleError: a rule failed"), ("give up", "RuleError: a rule failed")],
)
@pytest.mark.skipif(shutil.which("mpiexec", path=Path(sys.executable).parent) is None, reason="needs the extra mpi")
def test_ranks_of_mpi_send_messages(what, line, tmp_path):
    command = [Path(sys.executable).parent / "mpiexec", "-n", "3", sys.executable, "-c", PROGRAM, what, tmp_path]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(Path(__file__).parents[1])])}
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=environment)
    assert [said.read_text() for said in tmp_path.iterdir()] == [line] * 3, done.stderr


def fail_on_purpose(rank, who=1):
    rank.exchange([np.zeros(1)] * rank.size)
    if rank.rank == who:
        raise RuleError("a rule failed")
    rank.exchange([np.zeros(1)] * rank.size)


def test_the_first_raises_the_error_of_another():
    with pytest.raises(RuleError, match=r"^a rule failed$"), loop(3, fail_on_purpose) as rank:
        fail_on_purpose(rank)


# Processes and MPI ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, -1, 2.5, True, "many", 8])
def test_numbers_of_processes_that_mean_nothing_are_refused(size, tmp_path):
    with pytest.raises(ParameterError, match=r"expected 1, or 'mpi' in a program that `mpiexec -n 8 python PROGRAM`"):
        pharos.build("frozen_lake/4x4", tmp_path / "space", processes=size)


def test_a_command_that_cannot_be_started_by_mpiexec_is_one_line(monkeypatch):
    monkeypatch.setenv("PHAROS_STARTED", "3")
    monkeypatch.setattr(ranks.shutil, "which", lambda *_, **__: "mpiexec")
    monkeypatch.setattr(ranks.importlib.util, "find_spec", lambda name: name)
    with pytest.raises(ParameterError, match=r"write mpiexec -n 3 pharos \.\.\., with --processes mpi"):
        ranks.start_under_mpiexec(3)
    monkeypatch.setattr(ranks.shutil, "which", lambda *_, **__: None)
    with pytest.raises(MissingExtra, match=r"--processes 3 needs mpi4py .*pharos-rl\[mpi\]"):
        ranks.start_under_mpiexec(3)


BANNER = f"""
{"=" * 83}
=   BAD TERMINATION OF ONE OF YOUR APPLICATION PROCESSES
=   EXIT CODE: 9
{"=" * 83}
YOUR APPLICATION TERMINATED WITH THE EXIT STRING: Killed (signal 9)
"""


@pytest.mark.parametrize(("said", "code"), [("", 0), ("{}\n", 0), ("a\nb\n", 2), (BANNER, 9), (f"row{BANNER}", 9)])
def test_what_the_launcher_says_of_a_killed_rank_is_an_error_of_ours(said, code, tmp_path, monkeypatch, capfd):
    launcher = tmp_path / "mpiexec"
    (tmp_path / "said").write_text(said)
    launcher.write_text(f"#!/bin/sh\ncat {tmp_path / 'said'}\nexit {code}\n")
    launcher.chmod(0o755)
    monkeypatch.setattr(ranks.shutil, "which", lambda *_, **__: str(launcher))
    monkeypatch.setattr(ranks.importlib.util, "find_spec", lambda name: name)
    monkeypatch.setenv("PHAROS_STARTED", "")
    monkeypatch.delenv("PHAROS_STARTED")
    if BANNER in said:
        with pytest.raises(ranks.RankFailed, match=r"one of the 3 processes .* was killed \(exit code 9\)"):
            ranks.start_under_mpiexec(3)
    else:
        with pytest.raises(SystemExit) as end:
            ranks.start_under_mpiexec(3)
        assert end.value.code == code
    assert capfd.readouterr().out == said.removesuffix(BANNER)
    monkeypatch.delenv("PHAROS_STARTED")


def test_a_rank_of_mpi_that_fails_tells_the_others(monkeypatch):
    class Second:
        rank, size, told = 1, 2, None

        def fail(self, error):
            self.told = error

    second = Second()
    monkeypatch.setattr(ranked_table, "mpi_rank", lambda: second)
    monkeypatch.setattr(ranked_table, "answer", failing(RuleError("a rule failed")))
    with pytest.raises(RuleError), ranked_table.rank_of_build(None, None):
        pass
    assert str(second.told) == "a rule failed"


@pytest.mark.long
@pytest.mark.skipif(shutil.which("mpiexec", path=Path(sys.executable).parent) is None, reason="needs the extra mpi")
def test_ranks_of_mpi_write_the_same_files_and_go_on_after_a_kill(tmp_path):
    world = ["breakout", "height=7", "columns=5", "brick_rows=1", "--out", tmp_path / "space", "--processes", "3"]

    def run(*more, last=0):
        command = [sys.executable, "-c", BUILD, "build", *world, *more]
        environment = {**os.environ, "LAST_EXCHANGE": str(last)}
        return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=environment)

    stopped = run("--max-states", "1000")
    assert stopped.returncode == 1
    lines = [each for each in stopped.stderr.splitlines() if each.startswith("pharos:") and "compiling" not in each]
    assert [line.count("max_states") for line in lines] == [1]
    killed = run(last=40)
    assert (killed.returncode, killed.stdout) == (1, "")
    assert [line for line in killed.stderr.splitlines() if "was killed (exit code 9)" in line]
    assert not pharos.state_space.read_manifest(tmp_path / "space")["complete"]
    finished = run()
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.count("states/s") == 1
    assert files_of(tmp_path / "space") == expected("breakout")


# Ranks build in small blocks from the first state on; the third kills itself at an exchange.
BUILD = """
import os, signal
from pharos.cli import main
from pharos import ranks
from pharos.state_space import ranked_table
ranked_table.RankedSearch.__init__.__defaults__, ranked_table.SUPERSTEP_ROWS = (0,), 64
exchange, exchanges = ranks._Mpi.exchange, []
def dies(rank, parts):
    exchanges.append(0)
    if rank.rank == 2 and len(exchanges) == int(os.environ["LAST_EXCHANGE"]):
        os.kill(os.getpid(), signal.SIGKILL)
    return exchange(rank, parts)
ranks._Mpi.exchange = dies
main()
"""


def test_each_rank_knows_which_of_its_rows_the_others_read():
    cuts = cuts_of(20, 3)
    assert cuts.tolist() == [0, 6, 13, 20]
    rows = [np.array([6, 7, 19]), np.array([0, 13]), np.array([5])]  # outside of each range
    halos = {}

    def make(rank):
        halos[rank.rank] = Halo(rank, rows[rank.rank], cuts)

    with loop(3, make) as rank:
        make(rank)
    for reader, owner in np.ndindex(3, 3):
        read = rows[reader][halos[reader].of_rank[owner]]
        assert ((cuts[owner] <= read) & (read < cuts[owner + 1])).all()
        assert (halos[owner].wanted[reader] + cuts[owner]).tolist() == read.tolist()
