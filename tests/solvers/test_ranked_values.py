"""Values by several processes: those of one process, whatever the number, and going on after a kill."""

import contextlib
import errno
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from patience import PATIENCE
from pharos.errors import ParameterError, PrecisionError
from pharos.mdp import BEST, WORST, PolicyTable, TabularMDP
from pharos.ranks import RankFailed
from pharos.solvers import Solving, evaluate_policy, ranked, uniform_value, value_iteration
from pharos.solvers.ranked import shared_solution
from rank_threads import Killed, fails_at, out_of_order, threads
from refusals import failing, refusal
from strategies import FEW, deterministic_mdps, examples, hard_mdps, lazy_mdps, outcome_mdps, small_mdps

MPIEXEC = shutil.which("mpiexec", path=Path(sys.executable).parent)
MANY = st.one_of(small_mdps(), hard_mdps(), lazy_mdps())


def chain(num_states=300, gamma=0.9):
    """Walk right for a reward at the end, or jump to the start; the halo of each range is small."""
    states = np.arange(num_states)
    following = np.stack([np.minimum(states + 1, num_states - 1), states // 7], axis=1)
    rewards = np.zeros((num_states, 2))
    rewards[-2, 0], rewards[::5, 1] = 1.0, 0.01
    following[-1], rewards[-1] = num_states - 1, 0.0
    return TabularMDP.from_arrays(following, rewards, gamma=gamma)


def solved(mdp, size, *, select=BEST, tolerance=1e-6, horizon=None, disturb=lambda rank: None, cuts=None, **options):
    seconds = {name: options.pop(name) for name in ("checkpoint_seconds",) if name in options}
    solving = Solving(**{"tolerance": tolerance, "horizon": horizon, "processes": "mpi"} | options)
    with threads(ranked, size, disturb), pytest.MonkeyPatch.context() as patch:
        if cuts is not None:
            patch.setattr(ranked, "cuts_of", lambda num_rows, ranks: np.array(cuts))
        return shared_solution(mdp, select, solving, **seconds)


# The same values ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_three_ranks_find_the_values_of_one():
    mdp = chain()
    alone, shared = value_iteration(mdp), solved(mdp, 3)
    assert shared.error_bound <= 1e-6
    assert np.abs(shared.x - alone.x).max() <= alone.error_bound + shared.error_bound


@pytest.mark.long
@examples(40, mdp=MANY, size=st.integers(1, 5), select=st.sampled_from([BEST, WORST, None]), seed=st.integers(0, 99))
def test_values_by_ranks_are_within_the_bounds(mdp, size, select, seed):
    mdp = mdp.with_gamma(min(mdp.gamma, 0.8)).with_horizon(None)
    tolerance = 1e-7 * max(1.0, np.abs(mdp.rewards).max())
    if select is None:
        rng = np.random.default_rng(seed)
        select = PolicyTable.of(mdp, rng.dirichlet(np.ones(mdp.num_actions), mdp.num_states))
    size = min(size, mdp.num_states)
    alone, shared = (solved(mdp, ranks, select=select, tolerance=tolerance) for ranks in (1, size))
    assert np.abs(shared.x - alone.x).max() <= alone.error_bound + shared.error_bound


@pytest.mark.long
@examples(30, mdp=MANY, size=st.integers(2, 5), horizon=st.integers(1, 9))
def test_values_of_a_horizon_are_the_same_bits(mdp, size, horizon):
    alone = value_iteration(mdp, horizon=horizon)
    shared = solved(mdp, min(size, mdp.num_states), horizon=horizon)
    assert (shared.x == alone.x).all()
    assert (shared.next_x == alone.next_x).all()
    assert shared.error_bound == alone.error_bound


@pytest.mark.long
def test_evaluation_and_the_uniform_policy_are_shared(monkeypatch):
    mdp, policy = chain(), np.arange(300) % 2
    for function in (lambda **more: evaluate_policy(mdp, policy, **more), lambda **more: uniform_value(mdp, **more)):
        alone = function()
        with threads(ranked, 3):
            shared = function(processes="mpi")
        assert np.abs(shared.v - alone.v).max() <= alone.error_bound + shared.error_bound


@pytest.mark.long
@pytest.mark.parametrize("sticky", [0.0, 0.25])
def test_ranks_compute_the_rewards_of_their_ranges(sticky, tmp_path):
    space = pharos.build(pharos.make("breakout", height=7, columns=5, brick_rows=1), tmp_path, progress=False)
    mdp = pharos.sticky_actions(space.mdp(0.5), sticky)
    ranged = pharos.sticky_actions(space.mdp(0.5, by_range=True), sticky)
    shared = solved(ranged, 3, horizon=30)
    assert ranged.reward_table.whole is None
    alone = solved(mdp, 1, horizon=30)
    assert (shared.x == alone.x).all()
    assert shared.value_at_start == alone.value_at_start
    assert (ranged.rewards == mdp.rewards).all()


# Messages that travel while ranks sweep -------------------------------------------------------------------------------


CHAINS = [chain(40), pharos.sticky_actions(chain(40), 0.25), pharos.lazy_actions(chain(40), 0.1)]


@st.composite
def ranges(draw, num_states):
    """(P + 1,) where up to five ranges begin and end, uneven."""
    inner = draw(st.sets(st.integers(1, num_states - 1), max_size=4)) if num_states > 1 else ()
    return [0, *sorted(inner), num_states]


@pytest.mark.long
@examples(
    60,
    mdp=st.one_of(deterministic_mdps(9), outcome_mdps(FEW), st.sampled_from(CHAINS)),
    seed=st.integers(0, 2**32),
    draws=st.booleans(),
    gap=st.sampled_from([1, 2, 64]),
    data=st.data(),
)
def test_neither_ranges_nor_the_order_of_arrival_change_a_bit(mdp, seed, draws, gap, data):
    cuts, late = data.draw(ranges(mdp.num_states)), out_of_order(seed)
    size, select = len(cuts) - 1, PolicyTable.of(mdp) if draws else BEST
    mdp = mdp.with_gamma(min(mdp.gamma, 0.8)).with_horizon(None)
    options = {"select": select, "tolerance": 1e-6 * max(1.0, np.abs(mdp.rewards).max())}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ranked, "_GAP", gap)
        alone = solved(mdp, 1, horizon=7, **options)
        shared = solved(mdp, size, cuts=cuts, disturb=late, horizon=7, **options)
        assert (shared.x == alone.x).all() and (shared.next_x == alone.next_x).all()
        assert (shared.error_bound, shared.sweeps) == (alone.error_bound, alone.sweeps)
        soon, shared = (solved(mdp, size, cuts=cuts, disturb=each, **options) for each in (lambda rank: None, late))
        assert (shared.x == soon.x).all() and shared.sweeps == soon.sweeps


def swept_by_ranges(mdp, cuts, sweeps):
    """(S,) values after sweeps in place of each range, with what the others were before: written down from the text."""
    table, x = mdp.dynamics.deterministic_table(), np.zeros(mdp.num_states + 1)
    for _ in range(sweeps):
        after = x.copy()
        for start, stop in itertools.pairwise(cuts):
            seen = x.copy()
            for s in reversed(range(start, stop)):
                seen[s] = max(mdp.rewards[s, a] + mdp.gamma * seen[table[s, a]] for a in range(mdp.num_actions))
            after[start:stop] = seen[start:stop]
        x = after
    return x[:-1]


@pytest.mark.long
@examples(
    40, mdp=st.one_of(deterministic_mdps(max_states=9), st.just(chain(40))), seed=st.integers(0, 2**32), data=st.data()
)
def test_sweeps_in_place_keep_the_order_of_the_states(mdp, seed, data):
    mdp = mdp.with_gamma(min(mdp.gamma, 0.8))
    cuts = data.draw(ranges(mdp.num_states))
    shared = solved(mdp, len(cuts) - 1, cuts=cuts, disturb=out_of_order(seed))
    assert (shared.x[:-1, 0] == swept_by_ranges(mdp, cuts, shared.sweeps)).all()


# What is refused ------------------------------------------------------------------------------------------------------


def test_what_processes_cannot_do_is_said():
    mdp = chain(5)
    assert "6 processes for 5 states; expected at most one for each state" in refusal(ParameterError, solved, mdp, 6)
    for wrong in (0, 2, True, "many"):
        with pytest.raises(ParameterError, match="expected 1, or 'mpi' in a program that `mpiexec"):
            value_iteration(mdp, processes=wrong)
    assert "expected processes=1, a horizon, or gamma < 1" in refusal(ParameterError, solved, mdp.with_gamma(1.0), 2)
    with pytest.raises(ParameterError, match="keep the last step alone"):
        value_iteration(mdp, processes="mpi", horizon=3, keep_all=True)
    assert "raise the tolerance or lower gamma" in refusal(PrecisionError, solved, mdp, 2, tolerance=1e-17)


@pytest.mark.long
def test_sweeps_that_gain_nothing_end(monkeypatch):
    monkeypatch.setattr(ranked.RankedBackup, "sweep", lambda _: 1e-9)  # rounding errors that are moved about
    assert "64-bit floats reach a bound of 9e-09" in refusal(PrecisionError, solved, chain(10), 2, tolerance=1e-9)


# Checkpoints ----------------------------------------------------------------------------------------------------------


@pytest.mark.long
@examples(
    30,
    size=st.integers(1, 5),
    who=st.integers(0, 4),
    number=st.integers(0, 120),
    then=st.integers(1, 5),
    horizon=st.sampled_from([None, 20]),
    mdp=st.sampled_from(CHAINS),
    seed=st.integers(0, 2**32),
)
def test_solving_goes_on_whoever_failed_and_however_many_go_on(size, who, number, then, horizon, mdp, seed):
    whole = solved(mdp, 1, horizon=horizon)
    with tempfile.TemporaryDirectory() as folder:
        options = {"horizon": horizon, "checkpoint": folder, "checkpoint_seconds": -1.0}
        with contextlib.suppress(Killed, RankFailed), pytest.MonkeyPatch.context() as patch:
            patch.setattr(ranked, "_WRITING_SHARE", 0)
            late, fails = out_of_order(seed), fails_at(who % size, number)
            solved(mdp, size, disturb=lambda rank: (fails(rank), late(rank)), **options)
        result = solved(mdp, then, **options)
        assert not list(Path(folder).iterdir())
    assert np.abs(result.x - whole.x).max() <= result.error_bound + whole.error_bound
    if horizon is not None:
        assert (result.x == whole.x).all() and (result.next_x == whole.next_x).all()
        assert (result.error_bound, result.sweeps) == (whole.error_bound, whole.sweeps)


@pytest.mark.long
def test_a_checkpoint_is_of_one_question(tmp_path, monkeypatch):
    monkeypatch.setattr(ranked, "_WRITING_SHARE", 0)
    options = {"checkpoint": tmp_path, "checkpoint_seconds": -1.0}
    with pytest.raises(Killed):
        solved(chain(), 2, disturb=fails_at(0, 20), **options)
    (file,) = tmp_path.iterdir()
    first = []
    paid = np.ones((300, 2)) * (np.arange(300) < 299)[:, None]
    for mdp in (chain(), chain(gamma=0.8), chain().with_rewards(paid)):
        done = []
        with threads(ranked, 3):
            report = lambda sweeps, _, done=done: done.append(sweeps)  # noqa: E731
            value_iteration(mdp, processes="mpi", checkpoint=tmp_path, progress=report)
        first.append(done[0])
        if len(first) == 1:
            assert not file.exists()  # it was answered
    assert first[0] > 1
    assert first[1:] == [1, 1]


@pytest.mark.long
@pytest.mark.parametrize("harm", ["cut", "changed", "empty"])
def test_a_checkpoint_that_is_not_whole_is_no_checkpoint(harm, tmp_path, monkeypatch):
    monkeypatch.setattr(ranked, "_WRITING_SHARE", 0)
    options = {"horizon": 60, "checkpoint": tmp_path, "checkpoint_seconds": -1.0}
    with pytest.raises(Killed):
        solved(chain(), 2, disturb=fails_at(0, 25), **options)
    (file,) = tmp_path.iterdir()
    data = bytearray(file.read_bytes())
    data[-20] ^= 1
    file.write_bytes({"cut": data[:-8], "changed": data, "empty": b""}[harm])
    assert (solved(chain(), 3, **options).x == value_iteration(chain(), horizon=60).x).all()


@pytest.mark.long
def test_a_full_disk_ends_no_solving(tmp_path, monkeypatch):
    monkeypatch.setattr(ranked, "_WRITING_SHARE", 0)
    monkeypatch.setattr(ranked.storage, "replacing", failing(errno.ENOSPC))
    with pytest.warns(UserWarning, match=r"No space left on device; values are not kept any more, solving goes on"):
        result = solved(chain(), 2, checkpoint=tmp_path, checkpoint_seconds=-1.0)
    assert result.error_bound <= 1e-6


# Processes and MPI ----------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.skipif(MPIEXEC is None, reason="needs the extra mpi")
def test_three_ranks_solve_and_go_on_after_a_kill(tmp_path):
    alone = solved(chain(20_000), 1, horizon=80)
    stopped = ranks_of_mpi(3, SOLVE, tmp_path, "40")
    assert stopped.returncode != 0 and len(list(tmp_path.glob("values/*.values"))) == 1
    finished = ranks_of_mpi(2, SOLVE, tmp_path, "0")
    assert finished.returncode == 0, finished.stderr
    assert int((tmp_path / "first.txt").read_text()) > 10
    assert (np.load(tmp_path / "x.npy") == alone.x).all()


# The third rank kills itself in a sweep; the first writes the values, and how many sweeps it began with.
SOLVE = """
import os, pathlib, signal, sys
import numpy as np
from pharos.mdp import BEST
from pharos.solvers import Solving, ranked
from test_ranked_values import chain
folder, last, sweeps, first = pathlib.Path(sys.argv[1]), int(sys.argv[2]), [], []
sweep, ranked._WRITING_SHARE = ranked.RankedBackup.plain_sweep, 0
def dies(backup):
    sweeps.append(0)
    if backup.rank.rank == 2 and len(sweeps) == last:
        os.kill(os.getpid(), signal.SIGKILL)
    return sweep(backup)
ranked.RankedBackup.plain_sweep = dies
solving = Solving(
    horizon=80, processes="mpi", checkpoint=folder / "values", progress=lambda sweeps, _: first.append(sweeps)
)
solution = ranked.shared_solution(chain(20_000), BEST, solving, -1.0)
if solution is not None:
    np.save(folder / "x.npy", solution.x)
    (folder / "first.txt").write_text(str(first[0]))
"""


def ranks_of_mpi(size, program, *arguments):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [MPIEXEC, "-n", str(size), sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=environment)


WORLD = ["breakout", "height=7", "columns=5", "brick_rows=1", "--gamma", "0.5"]


def run(tmp_path, *arguments, ranks_of_mpi=0):
    launcher = [MPIEXEC, "-n", str(ranks_of_mpi)] if ranks_of_mpi else []
    command = [*launcher, sys.executable, "-m", "pharos", "solve", *arguments]
    environment = {**os.environ, "PHAROS_CACHE_DIR": str(tmp_path / "cache")}
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, env=environment)


@pytest.mark.long
@pytest.mark.parametrize("chance", [[], ["--sticky", "0.25"], ["--random", "0.1", "--horizon", "30"]])
@pytest.mark.parametrize("launcher", ["processes", "mpi"])
@pytest.mark.skipif(MPIEXEC is None, reason="needs the extra mpi")
def test_the_command_writes_the_same_values(launcher, chance, tmp_path):
    more = {"ranks_of_mpi": 3} if launcher == "mpi" else {}
    many = ["--processes", "3"] if launcher == "processes" else []
    alone = run(tmp_path, *WORLD, *chance, "--out", tmp_path / "alone.npz", "--json")
    shared = run(tmp_path, *WORLD, *chance, *many, "--out", tmp_path / "shared.npz", "--json", **more)
    assert shared.returncode == 0, shared.stderr
    answers = [json.loads(each.stdout) for each in (alone, shared)]
    assert answers[1]["processes"] == (3 if launcher == "processes" else "mpi")
    error = 0.0 if "--horizon" in chance else sum(answer["error_bound"] for answer in answers)
    for key in ("value_at_start", "uniform_value_at_start"):
        assert abs(answers[0][key] - answers[1][key]) <= error
    with np.load(tmp_path / "alone.npz") as one, np.load(tmp_path / "shared.npz") as other:
        assert set(one) == set(other)
        assert np.abs(one["v"] - other["v"]).max() <= error


@pytest.mark.long
@pytest.mark.skipif(MPIEXEC is None, reason="needs the extra mpi")
def test_an_error_of_ranks_is_one_line(tmp_path):
    refused = run(tmp_path, *WORLD[:-1], "1", ranks_of_mpi=3)
    assert refused.returncode == 2
    lines = [line for line in refused.stderr.splitlines() if line.startswith("pharos:")]
    lines = [line for line in lines if not line.startswith("pharos: compiling ")]
    assert len(lines) == 1
    assert "gamma is 1 and there is no horizon" in lines[0]
