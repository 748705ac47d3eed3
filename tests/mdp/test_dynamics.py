"""What executing actions does: every question has one answer, however the transitions are stored."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy import sparse

from naive import mdp as naive_mdp
from pharos.kernels import bellman, outcomes
from pharos.kernels.stepping import execute_choices
from pharos.mdp import (
    BEST,
    WORST,
    BellmanEquation,
    Chance,
    Dynamics,
    Matrices,
    PolicyStep,
    PolicyTable,
    Table,
    TabularMDP,
    lazy_actions,
    pairs_within,
    random_actions,
    runs_of,
    sticky_actions,
)
from pharos.mdp.dynamics import TopologicalOrder
from pharos.mdp.reachability import restricted_to
from pharos.solvers import evaluate_policy, uniform_value, value_iteration, worst_value
from strategies import (
    LAYOUTS,
    as_outcome_tables,
    deterministic_mdps,
    examples,
    general_mdps,
    lazy_mdps,
    outcome_mdps,
    outcome_table,
    probabilities,
    small_mdps,
    with_chance,
)


class Listed(Dynamics):
    """A third representation, written in a test: lists of outcomes, and nothing but what `Dynamics` asks for."""

    def __init__(self, lists, num_states, num_actions):
        self.lists, self.num_states, self.num_actions = lists, num_states, num_actions
        self.operations, self.mass = 10, 1.0 + 1e-12
        self.is_deterministic = False
        self.has_ends = any(t < 0 for row in lists for t, _ in row)

    @classmethod
    def of(cls, mdp):
        pairs = np.ndindex(mdp.num_states, mdp.num_actions)
        lists = [[(t, p) for t, p in naive_mdp.outcomes(mdp, s, a) if p > 1e-12] for s, a in pairs]
        return cls(lists, mdp.num_states, mdp.num_actions)

    @property
    def for_kernels(self):
        counts = list(map(len, self.lists))
        successors, likely = zip(*(outcome for row in self.lists for outcome in row), strict=True)
        arrays = np.array(successors, np.int32), np.append(0, np.cumsum(counts)), None, np.array(likely)
        return *arrays, (self.num_states, self.num_actions), max(counts)

    def expected(self, x, states=slice(None)):
        x = x[:, None] if x.ndim == 1 else x
        rows = np.arange(self.num_states)[states]
        result = np.zeros((len(rows), self.num_actions, *x.shape[2:]))
        for i, s in enumerate(rows):
            for a in range(self.num_actions):
                for t, p in self.lists[s * self.num_actions + a]:
                    result[i, a] += p * x[t, a if x.shape[1] > 1 else 0]
        return result

    def pushed(self, mass, width=1):
        after = np.zeros((self.num_states + 1, width))
        for i, row in enumerate(self.lists):
            s, a = divmod(i, self.num_actions)
            for t, p in row:
                after[t, a if width > 1 else 0] += p * mass[s, a]
        return after[:-1]

    def entries(self, states, actions):
        rows = [
            (i, t, p)
            for i, (s, a) in enumerate(zip(states, actions, strict=True))
            for t, p in self.lists[s * self.num_actions + a]
        ]
        which, following, weights = zip(*rows, strict=True) if rows else ((), (), ())
        return np.array(which, int), np.array(following, int), np.array(weights, float)

    def no_such_method(self, *_):
        raise NotImplementedError

    sample = part = _restricted_to = merged = arrays = no_such_method


def backed_up(dynamics, equation, x):
    """T x, as the formula has it."""
    q = equation.rewards.rows(slice(None)) + equation.gamma * dynamics.expected(x)
    return np.vstack([np.broadcast_to(equation.value(q), x[:-1].shape), np.zeros_like(x[:1])])


def moved(dynamics, play, now, width):
    """The mass one step later, as the formula has it."""
    mass = np.where(play.live[:, None], now, 0.0)
    return dynamics.push_forward(play.chance.executed(mass, play.policy), width)


def as_matrices(mdp):
    """The same MDP, stored as a matrix."""
    return Matrices(sparse.csr_matrix(naive_mdp.matrix_of(mdp).reshape(-1, mdp.num_states)), mdp.num_actions)


def representations(mdp):
    return [mdp.dynamics, as_matrices(mdp), Listed.of(mdp), *as_outcome_tables(mdp)]


def same(answers):
    for answer in answers[1:]:
        np.testing.assert_allclose(answer, answers[0], atol=1e-12)


@pytest.mark.slow
@examples(80, st.one_of(small_mdps(), outcome_mdps(), lazy_mdps()), st.integers(0, 2**32))
def test_every_representation_gives_the_same_answers(mdp, seed):
    rng = np.random.default_rng(seed)
    size, num_actions = mdp.num_states, mdp.num_actions
    all_of_them = representations(mdp)
    values, by_action = rng.normal(size=size + 1), rng.normal(size=(size + 1, num_actions))
    several = rng.normal(size=(size + 1, num_actions, 3))
    states = np.flatnonzero(rng.random(size) < 0.7)
    mass = rng.random((size, num_actions)) * (rng.random((size, num_actions)) < 0.5)
    for x in (values, by_action, several):
        same([each.expected(x) for each in all_of_them])
        same([each.expected(x, states) for each in all_of_them])
    same([each.largest(values) for each in all_of_them])
    same([each.smallest(values, states) for each in all_of_them])
    same([each.push_forward(mass) for each in all_of_them])
    same([each.push_forward(mass, num_actions) for each in all_of_them])
    same([each.arrivals(states) for each in all_of_them])
    same([each.matrix().toarray() for each in all_of_them])
    same([each.leads_to(0) for each in all_of_them])
    assert len({tuple(each.successors_of(states).tolist()) for each in all_of_them}) == 1
    assert len({each.has_ends for each in all_of_them}) == 1
    live = rng.random(size) < 0.6
    assert len({getattr(each.order(live), "longest", None) for each in all_of_them}) == 1
    for steps in (None, 0, 1, 3):
        same([each.reachable(mdp.starts, steps) for each in all_of_them])
    adjoint = (mass * mdp.dynamics.expected(np.append(values[:-1], 0.0))).sum()
    assert (mdp.dynamics.push_forward(mass)[:, 0] * values[:-1]).sum() == pytest.approx(adjoint)


@pytest.mark.slow
@examples(40, st.one_of(small_mdps(), outcome_mdps(), lazy_mdps()), st.integers(0, 2**32))
def test_every_representation_is_cut_merged_and_drawn_alike(mdp, seed):
    rng = np.random.default_rng(seed)
    size, num_actions = mdp.num_states, mdp.num_actions
    all_of_them = [each for each in representations(mdp) if not isinstance(each, Listed)]
    states = np.flatnonzero(rng.random(size) < 0.7)
    classes = np.unique(rng.integers(0, size, size), return_inverse=True)[1]
    representatives = np.array([np.flatnonzero(classes == c)[0] for c in range(classes.max() + 1)])
    start, stop = sorted(rng.integers(0, size + 1, 2))
    if len(states):
        same([each.restricted_to(states).matrix().toarray() for each in all_of_them])
    same([each.merged(classes, representatives).matrix().toarray() for each in all_of_them])
    if start < stop:
        values = rng.normal(size=size + 1)
        parts = [each.part(start, stop) for each in all_of_them]
        same([halo for _, halo in parts])
        same([part.expected(np.append(values[start:stop], values[[*halo, -1]])) for part, halo in parts])
    pairs = rng.integers(0, size, 30), rng.integers(0, num_actions, 30)
    probabilities = mdp.dynamics.matrix().toarray()[pairs[0] * num_actions + pairs[1]]
    for each in all_of_them:
        drawn = each.sample(*pairs, rng)  # -1 for the end, which is the last column
        assert (probabilities[np.arange(30), drawn] > 1e-12).all()


@pytest.mark.long
@examples(80, st.one_of(small_mdps(), with_chance(outcome_mdps()), lazy_mdps()), st.integers(0, 2**32))
def test_compiled_backups_and_moves_are_those_of_the_formulas(mdp, seed):
    rng = np.random.default_rng(seed)
    looks_back = mdp.is_sticky and seed % 2 == 0
    shape = (mdp.num_states, mdp.num_actions + 1) if looks_back else (mdp.num_states,)
    policy = PolicyTable.of(mdp, rng.dirichlet(np.ones(mdp.num_actions), shape))
    x = rng.normal(size=(mdp.num_states + 1, mdp.width))
    x[-1] = 0
    for select in (BEST, WORST, policy):
        equation = BellmanEquation(mdp.reward_table, mdp.gamma, mdp.chance, select)
        fast = np.empty_like(x)
        mdp.dynamics.backup(equation, x, fast)
        slow = backed_up(Listed.of(mdp), equation, x)
        np.testing.assert_allclose(fast, slow, atol=1e-12)
        some = np.append(rng.random(mdp.num_states) < 0.5, True)
        part = np.full_like(x, 7.0)
        mdp.dynamics.backup(equation, x, part, runs_of(some[:-1]))
        assert (part == np.where(some[:, None], fast, 7.0)).all()
    live = ~np.asarray(mdp.terminal)
    for play, width in (
        (PolicyStep(live, policy.later, mdp.chance), mdp.width),
        (PolicyStep(live, policy.first, mdp.chance.first), 1),
    ):
        now = rng.random((mdp.num_states, width))
        fast, slow = np.empty((mdp.num_states, mdp.width)), moved(Listed.of(mdp), play, now, mdp.width)
        assert mdp.dynamics.step_distribution(play, now, fast) == pytest.approx(slow[live].sum())
        np.testing.assert_allclose(fast, slow, atol=1e-12)
    play = PolicyStep(live, policy.later, mdp.chance)
    fast, slow = (np.zeros((mdp.num_states, mdp.width)) for _ in range(2))
    fast[mdp.starts] = slow[mdp.starts] = 1.0
    fast[~live] = slow[~live] = 0.0
    mdp.dynamics.support(play, fast)
    for _ in range(slow.size):
        slow[moved(Listed.of(mdp), play, slow, mdp.width) > 0] = 1.0
    assert ((fast > 0) == (slow > 0))[live].all()


@pytest.mark.long
@pytest.mark.parametrize(
    "layout", ["table", *(pytest.param(layout, marks=pytest.mark.long) for layout in ("lazy", *LAYOUTS))]
)
def test_backups_compiled_for_many_states_and_for_few_have_the_same_bits(layout, monkeypatch):
    """Each number of actions and outcomes by itself, with rewards as codes; and one form for all, with float64."""
    answers = []
    for first in (0, 41):
        monkeypatch.setattr(outcomes, "UNROLLED_FROM", first)
        mdp = _drawn_mdp(layout)
        answers.append(_backed_up(mdp))
        is_tuple = isinstance(bellman.actions_of(mdp.num_actions, mdp.dynamics.is_unrolled), tuple)
        assert (mdp.reward_table.for_kernels[0].dtype, is_tuple) == ((np.uint8, True) if first == 0 else (float, False))
    assert answers[0] == answers[1] and len(answers[0]) == 27


@pytest.mark.parametrize("layout", ["table", "lazy", *LAYOUTS])
def test_sweeps_of_some_states_are_compiled_as_those_of_all(layout, monkeypatch):
    mdp = _drawn_mdp(layout)
    for first, dtype in ((40, np.uint8), (41, np.float64)):
        monkeypatch.setattr(outcomes, "UNROLLED_FROM", first)
        part = restricted_to(replace(mdp), np.arange(30))
        assert part.dynamics.is_unrolled == (first == 40) and part.reward_table.for_kernels[0].dtype == dtype


def _drawn_mdp(layout):
    """40 states of 3 actions, many of which are visited again, with 5 rewards."""
    rng = np.random.default_rng(7)
    paid = rng.choice([-1.0, 0.0, 0.1, 1 / 3, 2.0], (40, 3))
    mdp = TabularMDP.from_arrays(rng.integers(-1, 40, (40, 3), dtype=np.int32), paid, gamma=0.9)
    if layout in LAYOUTS:
        ragged, palette, width = LAYOUTS[layout]
        vectors = [[1.0], [0.5, 0.5], [1 / 3, 2 / 3], [0.7, 0.2, 0.1]][: width + 1]
        drawn = [vectors[i] for i in rng.integers(len(vectors), size=120)]
        lists = [[(int(rng.integers(-1, 40)), p) for p in vector] for vector in drawn]
        return replace(mdp, dynamics=outcome_table(lists, 3, ragged, palette, width))
    return lazy_actions(mdp, 0.3) if layout == "lazy" else mdp


def _backed_up(mdp):
    """Bytes of a backup and two sweeps, the second one in some order, with all kinds of chance and choice."""
    rng, found = np.random.default_rng(1), []
    order = TopologicalOrder(rng.permutation(40), 40)
    for chance in (Chance(), Chance.of(random=0.2), Chance.of(sticky=0.25)):
        for policy in (None, rng.integers(3, size=40), rng.dirichlet(np.ones(3), 40)):
            select = BEST if policy is None else PolicyTable.of(replace(mdp, chance=chance), policy)
            equation = BellmanEquation(mdp.reward_table, 0.9, chance, select)
            x = rng.random((41, 3 if chance.is_sticky else 1))
            x[-1] = 0.0
            out = np.empty_like(x)
            mdp.dynamics.backup(equation, x, out)
            change, after = mdp.dynamics.sweep(equation, x), x.tobytes()
            mdp.dynamics.sweep_once(equation, x, order)
            found += [out.tobytes(), (change, after), x.tobytes()]
    return found


@pytest.mark.long
@examples(80, st.one_of(small_mdps(), lazy_mdps()))
def test_solvers_take_any_representation(mdp):
    other = replace(mdp, dynamics=Listed.of(mdp))
    evaluate = lambda m: evaluate_policy(m, np.zeros(m.num_states, int))  # noqa: E731
    for solve in (value_iteration, worst_value, uniform_value, evaluate):
        one, two = solve(mdp), solve(other)
        assert np.abs(one.v - two.v).max() <= one.error_bound + two.error_bound


@examples(80, deterministic_mdps())
def test_a_matrix_with_one_outcome_each_is_deterministic(mdp):
    dynamics = as_matrices(mdp)
    assert dynamics.is_deterministic
    assert (dynamics.deterministic_table() == mdp.next_states).all()


def test_a_matrix_with_several_outcomes_is_not_deterministic():
    mdp = TabularMDP.from_matrices(np.full((2, 1, 2), 0.5), np.ones((2, 1)))
    assert not mdp.is_deterministic
    assert mdp.dynamics.deterministic_table() is None


@examples(80, general_mdps(), st.integers(0, 2**32))
def test_sampled_next_states_are_possible_ones_and_about_as_frequent(mdp, seed):
    states = np.zeros(2000, int)
    actions = np.full(2000, mdp.num_actions - 1)
    found = mdp.dynamics.sample(states, actions, np.random.default_rng(seed))
    expected = dict(naive_mdp.outcomes(mdp, 0, mdp.num_actions - 1))
    for state, p in expected.items():
        assert abs((found == state).mean() - p) < 0.08
    assert set(found.tolist()) <= set(expected)


@pytest.mark.slow
@examples(80, st.one_of(small_mdps(), lazy_mdps()))
def test_pairs_that_can_be_met_are_those_of_the_explicit_matrices(mdp):
    (P, _, start), ended = naive_mdp.augmented(mdp), naive_mdp.is_over(mdp)
    reached, later = start > 0, np.zeros(len(start), bool)
    for _ in range(len(start)):
        following = (P[reached & ~ended] > 1e-12).any(axis=(0, 1)) if (reached & ~ended).any() else later & False
        later |= following
        reached = reached | following
    expected = later[:-1].reshape(mdp.num_states, mdp.num_actions + 1)[:, :-1]
    assert (pairs_within(mdp) == expected).all()


def test_where_every_action_is_repeated_only_first_actions_go_on():
    mdp = sticky_actions(TabularMDP.from_arrays([[1, 2], [2, 0], [0, 1]], np.zeros((3, 2))), 1.0)
    assert pairs_within(mdp).all()


@pytest.mark.parametrize(
    ("sticky", "steps", "pairs"),
    [
        (1.0, None, [[0, 0], [1, 0], [1, 0], [0, 1]]),
        (1.0, 1, [[0, 0], [1, 0], [0, 0], [0, 1]]),
        (0.5, None, [[0, 1], [1, 0], [1, 1], [1, 1]]),
        (0.5, 0, [[0, 0], [0, 0], [0, 0], [0, 0]]),
        (0.5, 1, [[0, 0], [1, 0], [0, 0], [0, 1]]),
        (0.5, 2, [[0, 1], [1, 0], [1, 0], [1, 1]]),
        (0.5, 3, [[0, 1], [1, 0], [1, 1], [1, 1]]),
    ],
)
def test_pairs_within_some_steps_end_with_those_of_the_last_step(sticky, steps, pairs):
    one_way = TabularMDP.from_arrays([[1, 3], [2, 0], [2, 2], [3, 3]], np.zeros((4, 2)))
    assert pairs_within(sticky_actions(one_way, sticky), steps).tolist() == pairs


@pytest.mark.long
@examples(80, probabilities, probabilities, st.integers(0, 2**32))
def test_weights_executed_choices_and_adjoints_of_chance_agree(sticky, random, seed):
    rng = np.random.default_rng(seed)
    chance, num_actions = Chance.of(sticky, random), 3
    mdp = random_actions(sticky_actions(TabularMDP.from_arrays([[0, 0, 0]], np.zeros((1, 3))), sticky), random)
    assert mdp.chance == chance
    previous = np.array([0, 1, 2, num_actions])
    chosen = rng.dirichlet(np.ones(num_actions), 4)
    weights = chance.weights(chosen, previous)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    q = rng.normal(size=(4, num_actions))
    np.testing.assert_allclose((chance.chosen_values(q, previous) * chosen).sum(axis=1), (weights * q).sum(axis=1))
    for b in range(4):
        executed, returns, alive = np.full(6000, previous[b]), np.zeros(6000), np.arange(6000)
        numbers = rng.random(6000), rng.random(6000), rng.integers(num_actions, size=6000)
        rewards, setting = np.array([[1.0, 20.0, 300.0]]), (*chance.triple, float(chance.first_chosen))
        where = np.full(6000, b), numbers, setting, rewards, np.empty(0), np.zeros(6000, np.int64)
        execute_choices(chosen, *where, 0.5, alive[::2], executed, returns)
        np.testing.assert_allclose(np.bincount(executed[::2], minlength=3) / 3000, weights[b], atol=0.06)
        assert (returns[::2] == 0.5 * rewards[0, executed[::2]]).all()
        assert (executed[1::2] == previous[b]).all() and not returns[1::2].any()  # not among the episodes alive
        always = where[0], numbers, (1.0, 0.0, 0.0, 1.0), *where[3:]
        execute_choices(chosen, *always, 0.5, alive, executed, returns)
        choices = np.searchsorted(chosen[b].cumsum(), numbers[0])
        assert (executed == choices.clip(max=num_actions - 1)).all()
    if chance.is_sticky:
        mass, later = rng.random((2, num_actions)), rng.dirichlet(np.ones(num_actions), 2)
        values = rng.normal(size=(2, num_actions))
        executed = chance.executed(mass, later[:, None])
        of_choice = chance.choice(values, (later * values).sum(axis=1, keepdims=True))
        assert (executed * values).sum() == pytest.approx((mass * of_choice).sum())


@examples(30, small_mdps())
def test_an_action_leads_to_a_state_where_its_probability_is_not_zero(mdp):
    P = naive_mdp.matrix_of(mdp)
    possible = np.concatenate([P, 1 - P.sum(axis=2, keepdims=True)], axis=2) > 1e-12
    for state in range(mdp.num_states + 1):
        assert (mdp.dynamics.leads_to(state) == possible[:, :, state]).all()


def test_what_a_row_lacks_to_1_by_rounding_leads_nowhere():
    dynamics = TabularMDP.from_matrices(np.full((1, 1, 1), 1 - 2.0**-53), [[0.0]]).dynamics
    assert not dynamics.has_ends
    assert (dynamics.leads_to(0).tolist(), dynamics.leads_to(1).tolist()) == ([[True]], [[False]])


def test_an_end_beyond_rounding_is_an_outcome():
    dynamics = TabularMDP.from_matrices(np.full((1, 1, 1), 1 - 1e-12), [[0.0]], ends=[[1e-12]]).dynamics
    assert dynamics.has_ends and dynamics.leads_to(1).tolist() == [[True]]
    outcomes = dynamics.outcomes(np.array([0]), np.array([0]))
    assert outcomes.states.tolist() == [0, 1] and outcomes.probabilities[1] == pytest.approx(1e-12, rel=1e-3)


def test_a_table_keeps_the_index_type_of_what_is_left():
    table = Table(np.array([[1, 2], [2, -1], [0, 0]], np.int32))
    assert table.restricted_to(np.array([0, 1])).next_states.tolist() == [[1, 0], [1, -1]]
    assert table.merged(np.array([0, 0, 1]), np.array([0, 2])).next_states.tolist() == [[0, 1], [0, 0]]
    assert table.restricted_to(np.array([0, 1])).next_states.dtype == np.int32
