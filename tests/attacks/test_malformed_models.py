"""Models as users write them, spoilt at random: refused in one line, or read as what they say."""

import copy
from collections import Counter
from fractions import Fraction

import numpy as np
import pytest
from scipy import sparse

import pharos
from naive import exact
from pharos import importers
from pharos.errors import PharosError
from pharos.mdp import TabularMDP

pytestmark = pytest.mark.long

try:
    import stormpy
except ImportError:
    stormpy = None

GAMMA, STATES, ACTIONS = 0.9, 4, 3
WRONG = (0.0, -0.25, 1.5, 1 + 3e-6, float("nan"), float("inf"), 1 - 1e-7, 1 - 2e-6, 0.5, 1.0)
"""Factors of a probability."""


def probabilities(rng):
    """(S, A, S), some of them 0, that sum to 1 up to rounding."""
    weights = rng.integers(0, 4, (STATES, ACTIONS, STATES)).astype(float)
    weights[..., 0] += weights.sum(axis=2) == 0
    return weights / weights.sum(axis=2, keepdims=True)


def optimal(P, R, ends, has_sets=False):
    """Optimal values in fractions, of rows divided by what they and their ends sum to; None if they are no MDP.

    The rule in plain Python: a row may differ from 1 by a millionth, and may lack more where `ends` says that rows end.
    has_sets: whether an empty row that does not end is an action that is not available.
    """
    rows = [[[Fraction(p) for p in row] if np.isfinite(row).all() else None for row in rows] for rows in P.tolist()]
    available = [list(range(ACTIONS)) for _ in range(STATES)]
    if has_sets and not ends:
        available = [[a for a in range(ACTIONS) if rows[s][a] is None or any(rows[s][a])] for s in range(STATES)]
        if not all(available):
            return None
    for row in (rows[s][a] for s in range(STATES) for a in available[s]):
        if row is None or min(row) < 0 or sum(row) > 1 + Fraction(1, 10**6) + Fraction(1, 10**12):
            return None
        if sum(row) < 1 - Fraction(1, 10**6) - Fraction(1, 10**12):
            if not ends:
                return None
            continue
        row[:] = [p / sum(row) for p in row]
    policy = [actions[0] for actions in available]
    while True:
        system = [
            [Fraction(s == t) - Fraction(GAMMA) * rows[s][policy[s]][t] for t in range(STATES)]
            + [Fraction(R[s, policy[s]])]
            for s in range(STATES)
        ]
        v = exact.solved(system)
        q = [
            [
                Fraction(R[s, a]) + Fraction(GAMMA) * sum(p * x for p, x in zip(rows[s][a], v, strict=True))
                for a in range(ACTIONS)
            ]
            for s in range(STATES)
        ]
        better = [max(actions, key=row.__getitem__) for actions, row in zip(available, q, strict=True)]
        if all(q[s][better[s]] == q[s][policy[s]] for s in range(STATES)):
            return v
        policy = better


def made(kind, P, R, ends):
    """The MDP of an array in some form of it."""
    by_action = [P[:, a] for a in range(ACTIONS)]
    if kind == "array":
        return importers.matrices(P, R, gamma=GAMMA, ends=ends)
    if kind == "list":
        return importers.matrices(by_action, R, gamma=GAMMA, ends=ends)
    if kind == "sparse":
        return importers.matrices([sparse.csr_matrix(each) for each in by_action], R, gamma=GAMMA, ends=ends)
    if kind == "axes":
        return importers.matrices(np.stack(by_action), R, gamma=GAMMA, ends=ends, axes="ASS")
    successors = np.broadcast_to(np.arange(STATES), P.shape)
    if kind == "outcomes":
        return TabularMDP.from_outcomes(successors, P, R, gamma=GAMMA)
    table = [
        [[(p, t, R[s, a], False) for t, p in enumerate(P[s, a].tolist())] for a in range(ACTIONS)]
        for s in range(STATES)
    ]
    return importers.gymnasium(table, gamma=GAMMA)


def tried(make):
    """(MDP, None), or (None, the line that refuses it)."""
    try:
        return make(), None
    except PharosError as error:
        line = str(error)
        assert "\n" not in line and 20 < len(line) <= 2000, line
        return None, line


@pytest.mark.parametrize("kind", ["array", "list", "sparse", "axes", "outcomes", "table"])
def test_matrices(kind, count):
    rng, tally = np.random.default_rng(0), Counter()
    for _ in range(300):
        P, R = probabilities(rng), rng.integers(-2, 3, (STATES, ACTIONS)).astype(float)
        ends = bool(rng.integers(2)) and kind not in ("outcomes", "table")
        for _ in range(int(rng.integers(0, 3))):
            s, a = rng.integers(STATES), rng.integers(ACTIONS)
            P[s, a, rng.choice(np.flatnonzero(P[s, a] > 0)) if (P[s, a] > 0).any() else 0] *= rng.choice(WRONG)
        mdp, _ = tried(lambda P=P, R=R, ends=ends: made(kind, P, R, ends))
        truth = optimal(P, R, ends, has_sets=kind not in ("outcomes", "table"))
        assert (mdp is None) == (truth is None), (P, ends)
        if mdp is not None:
            solution = pharos.value_iteration(mdp)
            assert exact.largest_error(solution.v, np.array(truth)) <= Fraction(1, 10**6)
        tally["refused" if mdp is None else "divided" if any(mdp.residual) else "read"] += 1
    assert min(tally["refused"], tally["divided"], tally["read"]) >= 15, tally
    count(f"{tally.total()} malformed models as {kind}: {dict(tally)}")


ENTRIES = (
    None,
    (),
    (1.0,),
    (1.0, 0, 0.0),
    (1.0, "0", 0.0, False),
    (1.0, 0, "x", False),
    (2.0, 0, 0.0, False),
    "text",
    3,
)


def test_tables(count):
    """Rows, entries and outcomes of a table that are dropped or replaced: refused, or an action not available."""
    rng, tally = np.random.default_rng(1), Counter()
    plain = [[[(1.0, (s + a) % STATES, float(a), False)] for a in range(ACTIONS)] for s in range(STATES)]
    whole = {s: dict(enumerate(row)) for s, row in enumerate(plain)}
    for _ in range(400):
        table = copy.deepcopy(whole)
        s, a, what = int(rng.integers(STATES)), int(rng.integers(ACTIONS)), int(rng.integers(5))
        if what == 0:
            del table[s]
        elif what == 1:
            del table[s][a]
        elif what == 2:
            table[s] = [{}, [], None, 3][int(rng.integers(4))]
        elif what == 3:
            table[s][a] = [[], None, 3, [()]][int(rng.integers(4))]
        else:
            table[s][a] = [ENTRIES[int(rng.integers(len(ENTRIES)))]]
        mdp, line = tried(lambda table=table: importers.gymnasium(table))
        if what == 1 or (what == 3 and table[s][a] == []):
            assert mdp is not None and np.argwhere(~mdp.available).tolist() == [[s, a]], table
        else:
            assert mdp is None and line.startswith("table: "), table
        tally["refused" if mdp is None else "read as not available"] += 1
    count(f"400 malformed tables: {dict(tally)}")


TARGET = '(x=3 | y>-1 & !goal) & x+2*y <= 4 & !"goal"'


def test_targets(count):
    """A character of an expression replaced, left out or doubled: refused in one line, or states where it holds."""
    table = np.minimum(np.arange(6) + 1, 5)[:, None]
    mdp = TabularMDP.from_arrays(table, np.zeros((6, 1)), terminal=np.arange(6) == 5)
    mdp = mdp.with_names(labels={"goal": [5]}, variables={"x": np.arange(6), "y": np.arange(6) - 2})
    rng, tally = np.random.default_rng(4), Counter()
    for k in range(600):
        at, letter = int(rng.integers(len(TARGET))), chr(int(rng.integers(32, 127)))
        text = TARGET[:at] + (letter, "", 2 * TARGET[at])[k % 3] + TARGET[at + 1 :]
        reached, _ = tried(lambda text=text: pharos.reach(mdp, text))
        assert reached is None or (reached.target.shape, reached.target.dtype) == ((6,), bool)
        tally["refused" if reached is None else "read"] += 1
    assert min(tally["refused"], tally["read"]) >= 60, tally
    count(f"{tally.total()} malformed targets: {dict(tally)}")


MODEL = """mdp
module m
  s : [0..3] init 0;
  [a] s=0 -> 0.5:(s'=1) + 0.5:(s'=2);
  [b] s=0 -> 1:(s'=1);
  [] s=1 | s=2 -> 0.25:(s'=3) + 0.75:(s'=2);
  [] s=3 -> true;
endmodule
rewards "cost"  s=1 : -10;  s=2 : -4;  endrewards
label "end" = s=3;
"""


@pytest.mark.skipif(stormpy is None, reason="stormpy is not installed")
def test_commands(tmp_path, count, capfd):
    """A character of a model replaced: refused, or Storm builds it with its checks and all rows sum to 1."""
    rng, tally = np.random.default_rng(2), Counter()
    numbers = [at for at, letter in enumerate(MODEL) if letter in "0123456789"]
    for k in range(250):
        at = int(rng.choice(numbers)) if k % 2 else int(rng.integers(len(MODEL)))
        letter = str(rng.integers(10)) if k % 2 else chr(int(rng.integers(32, 127)))
        file = tmp_path / "model.prism"
        file.write_text(MODEL[:at] + letter + MODEL[at + 1 :])
        mdp, _ = tried(lambda file=file: importers.storm(file, reward="cost", target="end", horizon=10))
        if mdp is not None:
            sums = np.asarray(mdp.transitions.sum(axis=1)).ravel()
            assert (np.isclose(sums, 1) | np.repeat(mdp.terminal, mdp.num_actions)).all()
            program = stormpy.parse_prism_program(str(file))
            options = stormpy.BuilderOptions(build_full=True)
            options.set_exploration_checks(True)
            assert stormpy.build_model(program, options=options).nr_states == mdp.num_states
        tally["refused" if mdp is None else "read"] += 1
        captured = capfd.readouterr()
        assert mdp is None or captured.out == ""
    assert min(tally["refused"], tally["read"]) >= 15, tally
    count(f"{tally.total()} malformed PRISM models: {dict(tally)}")
