"""Measures of what a network makes of an MDP's states: against tables, closed forms, and learners written plainly."""

import importlib
import json

import numpy as np
import pytest
from hypothesis import strategies as st

import pharos
from command_line import run, usage_error
from naive.mdp import executed, matrix_of
from pharos import hardness
from pharos.errors import ParameterError, UndefinedMeasure
from pharos.hardness import Network, Representation, Schedule, kernel_regret, tangent_kernel
from pharos.hardness.representation.learning import return_on_graph
from pharos.mdp import TabularMDP, lazy_actions, random_actions, sticky_actions
from pharos.observations import representation
from refusals import failing, refusal
from strategies import FEW, deterministic_mdps, examples, outcome_mdps, with_chance

SHORT = Schedule(steps=3000, learning_starts=500)
RNG = np.random.default_rng(1)


def chain(length=4, **options):
    """Action 1 goes on, action 0 back to the start; the last step pays 1 and ends."""
    table = np.stack([np.zeros(length, int), np.arange(1, length + 1)], axis=1)
    table[-1, 1] = -1
    rewards = np.zeros((length, 2))
    rewards[-1, 1] = 1.0
    return TabularMDP.from_arrays(table, rewards, **{"gamma": 1.0, "horizon": 12, **options})


def random_mdp(states=7, seed=0, *, lacks=False):
    """Two outcomes an action, two start states, an end, rewards that differ. lacks: one action of three is not
    available, the same one in states 2 i and 2 i + 1."""
    rng = np.random.default_rng(seed)
    successors = rng.integers(0, states, (states, 3, 2))
    probabilities = rng.dirichlet([1, 1], (states, 3))
    rewards = rng.random((states, 3))
    successors[-1], probabilities[-1], rewards[-1] = states - 1, [1.0, 0.0], 0.0
    if lacks:
        rewards[np.arange(states - 1), np.arange(states - 1) // 2 % 3] = -np.inf
    options = {"horizon": 9, "initial": [0, 1], "terminal": np.arange(states) == states - 1}
    return TabularMDP.from_outcomes(successors, probabilities, rewards, gamma=1.0, **options)


def kernel_of(states, seed=0):
    features = np.random.default_rng(seed).random((states, 3)).astype(np.float32)
    return tangent_kernel(Network.of("mlp16"), features)


def walk(mdp, policy):
    """(visits (S, A + 1, A) of what is chosen where, expected return) of an episode."""
    S, A, P = mdp.num_states, mdp.num_actions, matrix_of(mdp)
    mass, visits, value = np.zeros((S, A + 1)), np.zeros((S, A + 1, A)), 0.0
    np.add.at(mass[:, A], mdp.start_states, mdp.start_probabilities)
    for _ in range(mdp.horizon):
        after = np.zeros((S, A + 1))
        for s in np.flatnonzero(~np.asarray(mdp.terminal)):
            for b in range(A + 1):
                visits[s, b] += mass[s, b] * policy[s]
                for x, p in enumerate(mass[s, b] * policy[s] @ executed(mdp, b)):
                    value += p * mdp.rewards[s, x]
                    after[:, x] += p * P[s, x]
        mass = after
    return visits, value


def plain_regret(mdp, kernel, schedule):
    """The definition, step by step: (greedy, played)."""

    def learn(q, d, y, eta):
        for _ in range(schedule.gradient_steps):
            q = q + eta * kernel @ (d * (y - q))
        return q

    greedy, played, episodes = plain_curve(mdp, kernel, schedule, learn)
    return np.minimum(greedy, 1.5).mean(), np.average(np.minimum(played, 3), weights=episodes)


def plain_curve(mdp, kernel, schedule, learn):
    """On pairs (state, previous action; A: none), q learnt by `learn`: (greedy, played, episodes) of each phase."""
    S, A, P, live = mdp.num_states, mdp.num_actions, matrix_of(mdp), ~np.asarray(mdp.terminal)

    def value_of(policy):
        return walk(mdp, policy)[1]

    optimal = pharos.value_iteration(mdp).value_at_start
    uniform = value_of(np.full((S, A), 1 / A))
    q, memory, greedy_regrets, played_regrets, episodes = np.zeros((S, A)), np.zeros((S, A + 1, A)), [], [], []
    for step in range(0, schedule.steps, schedule.period):
        scale = np.abs(q).max(axis=1, keepdims=True)
        greedy = (q >= q.max(axis=1, keepdims=True) - 1e-6 * scale).astype(float)
        greedy /= greedy.sum(axis=1, keepdims=True)
        epsilon = schedule.epsilon(step)
        played = epsilon / A + (1 - epsilon) * greedy
        visits, value = walk(mdp, played)
        greedy_regrets.append((optimal - value_of(greedy)) / (optimal - uniform))
        played_regrets.append((optimal - value) / (optimal - uniform))
        episodes.append(schedule.period / visits.sum())
        memory += visits * episodes[-1]
        if step < schedule.learning_starts:
            continue
        base = mdp.rewards + schedule.gamma * P @ np.where(live, q.max(axis=1), 0)
        targets = np.stack([base @ executed(mdp, b).T for b in range(A + 1)], axis=1)
        d = memory.sum(axis=1)
        y = np.divide((memory * targets).sum(axis=1), d, out=q.copy(), where=d > 0)
        d = d / d.sum()
        q = learn(q, d, y, 1 / (1.05 * np.abs(np.linalg.eigvals(kernel * d.max(axis=1))).max()))
    return np.array(greedy_regrets), np.array(played_regrets), np.array(episodes)


@pytest.mark.long
@pytest.mark.parametrize("sticky", [0.0, 0.3])
@pytest.mark.parametrize("random", [0.0, 0.2])
def test_the_measure_is_what_its_definition_says(sticky, random):
    """With outcomes in the rules, two start states, sticky, random and lazy actions."""
    mdp = lazy_actions(pharos.random_actions(pharos.sticky_actions(random_mdp(), sticky), random), random)
    schedule = Schedule(steps=2000, period=200, gradient_steps=20, learning_starts=400, gamma=0.9)
    for kernel in (kernel_of(7), np.eye(7)):
        found = kernel_regret(mdp, Representation.of_matrix(kernel), schedule=schedule)
        expected = plain_regret(mdp, np.asarray(kernel, float), schedule)
        assert (found.value, found.curve.mean_played) == pytest.approx(expected, abs=1e-3)
    assert (found.tabular.mean_greedy, found.tabular.mean_played) == pytest.approx(expected, abs=1e-3)


def test_the_identity_is_expected_tabular_q_learning():
    """A phase of a table in closed form: what is left of an error is (1 - d / max d / 1.05)^g of it."""
    schedule = Schedule(steps=500, period=250, gradient_steps=7, learning_starts=0, exploration_final_eps=1.0)
    mdp = chain(2, horizon=5)
    found = kernel_regret(mdp, Representation.of_matrix(np.eye(2)), schedule=schedule)
    # uniform play: only (1, 1) pays; after one phase it has a value and all others none, so state 0 is still a tie
    assert found.curve.greedy[0] == pytest.approx(1.0)
    values = np.array([[0.0, 0.0], [0.0, 1.0]])
    policy = np.where(values == values.max(axis=1, keepdims=True), 1.0, 0.0)
    policy /= policy.sum(axis=1, keepdims=True)
    lost = 1.0 - pharos.evaluate_policy(mdp, policy).value_at_start
    assert found.curve.greedy[1] == pytest.approx(lost / (1 - pharos.solvers.uniform_value(mdp).value_at_start))


def test_with_uniform_play_and_enough_steps_a_phase_is_a_backup():
    """Of a table: after k phases the greedy policy is that of k Bellman backups from 0."""
    uniform_play = {"exploration_final_eps": 1.0, "exploration_fraction": 0}
    schedule = Schedule(steps=1250, learning_starts=0, gradient_steps=100_000, gamma=0.9, **uniform_play)
    mdp = random_mdp(seed=2)
    found = kernel_regret(mdp, Representation.of_matrix(np.eye(7)), schedule=schedule).curve.greedy
    solve = (pharos.value_iteration, pharos.solvers.uniform_value)
    optimal, uniform = (each(mdp).value_at_start for each in solve)
    q, expected = np.zeros((7, 3)), [1.0]
    for _ in range(4):
        q = mdp.rewards + 0.9 * matrix_of(mdp) @ np.where(mdp.terminal, 0.0, q.max(axis=1))
        value = pharos.evaluate_policy(mdp, q.argmax(axis=1)).value_at_start
        expected.append((optimal - value) / (optimal - uniform))
    assert len(set(np.round(expected, 6))) > 2
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.slow
@examples(10, with_chance(outcome_mdps(FEW[:1])), st.sampled_from([None, 1, 2, 6]), st.integers(0, 3))
def test_learners_on_any_mdp_begin_as_uniform_play_and_know_no_scale(mdp, horizon, seed):
    """Outcomes in the rules, any chance, several starts, with a horizon or a time limit beside a discount."""
    mdp = mdp.with_gamma(1.0).with_horizon(horizon) if horizon else mdp
    kernel, schedule = kernel_of(mdp.num_states, seed), Schedule(steps=1000, learning_starts=250)
    try:
        found, scaled, table = (
            kernel_regret(mdp, Representation.of_matrix(each, time_limit=5), schedule=schedule)
            for each in (kernel, 4 * kernel, np.eye(mdp.num_states))
        )
    except UndefinedMeasure as error:
        assert "uniform play is optimal" in str(error)
        return
    assert found.curve.greedy[:2] == pytest.approx(1.0, abs=2e-5)
    assert found.curve.played[:2] == pytest.approx(1.0, abs=2e-5)
    assert min(found.curve.greedy.min(), found.curve.played.min()) > -2e-5
    np.testing.assert_array_equal(found.curve.greedy, scaled.curve.greedy)
    np.testing.assert_allclose(table.curve.greedy, table.tabular.greedy, atol=2e-5)


@examples(50, deterministic_mdps(), st.integers(1, 40), st.integers(0, 3))
def test_a_walk_in_doubled_strides_is_the_walk_step_by_step(mdp, steps, seed):
    mdp = mdp.with_gamma(1.0).with_horizon(steps)
    actions = np.random.default_rng(seed).integers(0, mdp.num_actions, mdp.num_states)
    by_walking = walk(mdp, np.eye(mdp.num_actions)[actions])[1]
    value = return_on_graph(mdp, actions, steps)
    assert value == pytest.approx(by_walking, rel=1e-12, abs=1e-12 * steps * np.abs(mdp.rewards).max())
    assert value == pytest.approx(pharos.evaluate_policy(mdp, actions, 1e-9).value_at_start, rel=1e-12, abs=1e-9)


def test_an_identity_kernel_of_any_scale_is_the_table():
    found = kernel_regret(chain(6), Representation.of_matrix(37 * np.eye(6)), schedule=SHORT)
    np.testing.assert_allclose(found.curve.greedy, found.tabular.greedy, atol=1e-4)
    np.testing.assert_allclose(found.curve.played, found.tabular.played, atol=1e-4)


def test_the_order_of_states_does_not_matter():
    mdp, kernel, order = random_mdp(), kernel_of(7), np.array([3, 0, 6, 1, 5, 2, 4])
    place = np.argsort(order)
    P = matrix_of(mdp)[order][:, :, order]
    turned = TabularMDP.from_matrices(
        P * ~(order == 6)[:, None, None],
        mdp.rewards[order],
        gamma=1.0,
        horizon=9,
        initial=place[[0, 1]].tolist(),
        ends=True,
    )
    plain = hardness.report(mdp, MEASURES, representation=Representation.of_matrix(kernel), schedule=SHORT)
    other = hardness.report(
        turned, MEASURES, representation=Representation.of_matrix(kernel[np.ix_(order, order)]), schedule=SHORT
    )
    for name in MEASURES:
        assert number(other[name].value) == pytest.approx(number(plain[name].value), abs=2e-3, rel=1e-4), name


MEASURES = ["kernel_regret", "kernel_learning_time", "kernel_sample_complexity", "aliasing_floor"]


def number(value):
    return value["value"] if isinstance(value, dict) else value


def test_a_random_code_tends_to_an_isotropic_kernel():
    words = RNG.integers(0, 2, (30, 20_000)).astype(np.float32)
    kernel = tangent_kernel(Network.of("mlp64"), words)
    outside = kernel[~np.eye(30, dtype=bool)]
    assert outside.std() / kernel.diagonal().mean() < 0.01
    assert kernel.diagonal().std() / kernel.diagonal().mean() < 0.01


def test_states_that_look_alike_are_one_observation():
    """A kernel of rank one for two states is as good as one observation for both."""
    mdp = chain(5)
    kernel, classes = kernel_of(5), np.array([0, 1, 2, 1, 3])
    alike = kernel[np.ix_([0, 1, 2, 1, 4], [0, 1, 2, 1, 4])]
    merged = kernel_regret(mdp, Representation.of_matrix(alike, classes), schedule=SHORT)
    apart = kernel_regret(mdp, Representation.of_matrix(alike), schedule=SHORT)
    assert merged.observations == 4
    np.testing.assert_allclose(merged.curve.greedy, apart.curve.greedy, atol=1e-3)
    seen = Representation.of_matrix(alike, classes)
    floor = hardness.aliasing_floor(mdp, seen)
    assert 0 < floor < 1
    assert hardness.aliasing_floor(mdp, Representation.of_matrix(kernel)) == 0.0
    everything = Representation.of_matrix(np.ones((5, 5)), np.zeros(5, int))
    assert hardness.aliasing_floor(mdp, everything) == pytest.approx(1.0)


@pytest.mark.long
def test_landmarks_are_exact_where_there_are_enough_of_them_and_say_so_where_not():
    mdp, kernel = chain(12, horizon=40), kernel_of(12)
    exact = kernel_regret(mdp, Representation.of_matrix(kernel), schedule=SHORT)
    all_but_one = kernel_regret(mdp, Representation.of_matrix(kernel, landmarks=11), schedule=SHORT)
    assert exact.landmarks is None
    assert exact.note == ""
    assert all_but_one.landmarks == 11
    assert "no bounds" in all_but_one.note
    half = kernel_regret(mdp, Representation.of_matrix(kernel, landmarks=5), schedule=SHORT)
    changed = [
        abs(getattr(all_but_one.curve, each) - getattr(half.curve, each)) for each in ("mean_greedy", "mean_played")
    ]
    assert [all_but_one.estimated_error, all_but_one.estimated_error_played] == pytest.approx(changed)
    assert all_but_one.value == pytest.approx(exact.value, abs=0.05)
    identity = kernel_regret(mdp, Representation.of_matrix(np.eye(12), landmarks=4), schedule=SHORT)
    np.testing.assert_allclose(identity.curve.greedy, identity.tabular.greedy, atol=1e-3)


@pytest.mark.long
def test_gradient_steps_in_a_series_are_those_made_one_by_one():
    """Of all three operators, with 300 observations and rows of more than one block."""
    from pharos.hardness.representation.learning import Exact, Identity, Landmarks

    rng = np.random.default_rng(2)
    kernel, states = kernel_of(300), np.arange(300)
    weights = rng.dirichlet(np.ones(900)).reshape(300, 3).astype(np.float32)
    error = rng.normal(size=(300, 3)).astype(np.float32)

    def block(rows, columns):
        return kernel[np.ix_(rows, columns)]

    for operator in (Identity(), Exact(block, states), Landmarks(block, states, states[:40])):
        dense = operator(np.eye(300, dtype=np.float32)).astype(float)
        vector = np.full((300, 1), 300**-0.5)
        largest = operator.largest_eigenvalue(weights.max(axis=1, keepdims=True), vector)
        expected = np.abs(np.linalg.eigvals(dense * weights.max(axis=1))).max()
        assert largest == pytest.approx(expected, rel=3e-3)
        for steps in (1, 2, 5, 62):
            found = operator.descended(weights, error, 1 / (1.05 * largest), steps)
            left = error.astype(float)
            for _ in range(steps):
                left = left - dense @ (weights * left) / (1.05 * largest)
            np.testing.assert_allclose(found, error - left, atol=2e-5 * np.abs(error - left).max())


def test_adams_kernel_has_the_square_roots_of_eigenvalues():
    """Under the weights; by landmarks that are all observations as exactly."""
    from pharos.hardness.representation.learning import Exact, Landmarks

    kernel, states, weights = kernel_of(9), np.arange(9), np.random.default_rng(1).dirichlet(np.ones(9))

    def block(rows, columns):
        return kernel[np.ix_(rows, columns)]

    root = np.sqrt(weights)
    before = np.linalg.eigvalsh(root[:, None] * kernel.astype(float) * root)
    for operator in (Exact(block, states), Landmarks(block, states, states)):
        operator.preconditioned(weights)
        after = np.linalg.eigvalsh(root[:, None] * operator(np.eye(9, dtype=np.float32)).astype(float) * root)
        large = before > 1e-4 * before[-1]
        np.testing.assert_allclose(after[large], np.sqrt(before[large]), rtol=0.02)
    mdp = chain(6)
    schedule = Schedule(steps=3000, learning_starts=500, optimizer="adam")
    found = kernel_regret(mdp, Representation.of_matrix(np.eye(6)), schedule=schedule)
    assert found.conventions["schedule"]["optimizer"] == "adam"
    assert 0 < found.value < 1.5
    assert "expected gradient or adam" in refusal(ParameterError, Schedule, optimizer="lion")


@pytest.mark.long
def test_a_wide_network_trained_on_expectations_has_the_curve():
    """Q-learning of one network of 16,384 units by gradient descent, its own policy and its own target network."""
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    mdp, schedule = random_mdp(), Schedule(steps=3000, learning_starts=500, gradient_steps=20, gamma=0.9)
    x = np.random.default_rng(3).random((7, 3)).astype(np.float32)
    kernel = tangent_kernel(Network.of("mlp16384"), x)
    inputs = torch.as_tensor(x)
    net = torch.nn.Sequential(torch.nn.Linear(3, 16384), torch.nn.ReLU(), torch.nn.Linear(16384, 3))
    with torch.no_grad():
        before = net(inputs)

    def learn(q, d, y, eta):
        optimizer = torch.optim.SGD(net.parameters(), lr=float(eta))
        weights, targets = (torch.as_tensor(each, dtype=torch.float32) for each in (d, y))
        for _ in range(schedule.gradient_steps):
            loss = (weights * (targets - (net(inputs) - before)) ** 2).sum() / 2
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        with torch.no_grad():
            return (net(inputs) - before).numpy().astype(float)

    greedy, played, _ = plain_curve(mdp, kernel.astype(float), schedule, learn)
    found = kernel_regret(mdp, Representation.of_matrix(kernel), schedule=schedule).curve
    assert np.ptp(found.greedy) > 0.5
    np.testing.assert_allclose(found.greedy, greedy, atol=1e-3)
    np.testing.assert_allclose(found.played, played, atol=1e-3)


def test_learning_time_of_one_eigenvalue_is_a_logarithm():
    """Isotropic kernels learn all at the rate weight / sum: with equal weights ln(10) N / 2."""
    table = np.array([[1, -1], [0, -1]])
    mdp = TabularMDP.from_arrays(table, [[0.0, 1.0], [0.0, 1.0]], gamma=1.0, horizon=6, initial=[0.5, 0.5])
    found = hardness.kernel_learning_time(mdp, Representation.of_matrix(5 * np.eye(2)))
    assert found.value == pytest.approx(np.log(10) * 2 / 2, rel=1e-6)
    assert found.note == ""


def test_sample_complexity_is_that_of_regression_by_simulation():
    """Kernel regression of a fixed function on random samples: the predicted number leaves about a tenth."""
    spectra = importlib.import_module("pharos.hardness.representation.kernel_regret")

    rng = np.random.default_rng(0)
    features = rng.normal(size=(400, 60)) * np.arange(1, 61) ** -1.0
    kernel, y = features @ features.T, features[:, :20] @ rng.normal(size=20)
    y = y - y.mean()
    centred = kernel - kernel.mean(0) - kernel.mean(1)[:, None] + kernel.mean()
    weights = np.full(400, 1 / 400)
    eigenvalues, energy = spectra._spectrum(centred, y[:, None], weights)
    n = round(spectra._samples(eigenvalues, energy))
    left = []
    for _ in range(200):
        rows = rng.integers(0, 400, n)
        ridge = spectra.RIDGE * np.trace(centred) / 400 * np.eye(n)
        fit = centred[:, rows] @ np.linalg.lstsq(centred[np.ix_(rows, rows)] + ridge, y[rows], rcond=None)[0]
        left.append(((fit - y) ** 2).mean() / (y**2).mean())
    assert 0.07 < np.mean(left) < 0.14


@pytest.mark.parametrize(("sticky", "random"), [(0.0, 0.0), (0.25, 0.0), (0.0, 0.2), (0.25, 0.2)])
def test_exploration_time_is_that_of_a_linear_system(sticky, random):
    """Expected steps to the first reward of a chain, episodes after episodes, from explicit nodes (t, s, previous)."""
    mdp = pharos.random_actions(pharos.sticky_actions(chain(3, horizon=5), sticky), random)
    T, A, chance = 5, 2, mdp.chance
    table, rewards = np.asarray(mdp.next_states), mdp.rewards
    number = {(0, 0, A): 0}
    nodes, rows = [(0, 0, A)], []
    for t, s, b in nodes:
        weights = chance.weights(np.full((1, A), 0.5), np.array([b]))[0]
        row = {}
        for a, p in enumerate(weights):
            if rewards[s, a] > 0.5 or p == 0:
                continue
            ended = table[s, a] < 0 or t + 1 == T
            after = (0, 0, A) if ended else (t + 1, int(table[s, a]), a if mdp.is_sticky else A - 1)
            if after not in number:
                number[after] = len(nodes)
                nodes.append(after)
            row[after] = row.get(after, 0) + p
        rows.append(row)
    matrix = np.eye(len(nodes))
    for i, row in enumerate(rows):
        for after, p in row.items():
            matrix[i, number[after]] -= p
    expected = np.linalg.solve(matrix, np.ones(len(nodes)))[0]
    found = hardness.exploration_time(mdp)
    assert found.steps == pytest.approx(expected, rel=1e-9)
    assert found.episodes == pytest.approx(1 / found.probability)


def test_where_rewards_are_costs_alone_the_smaller_ones_are_large():
    """Less a constant, rewards of 0 and 1 are costs, and the same actions are met: terminal states have no say."""
    mdp = chain(3, horizon=5)
    gains = (mdp.rewards > 0.5).astype(float)
    found, shifted = (hardness.exploration_time(mdp.with_rewards(rewards)) for rewards in (gains, gains - 2.0))
    assert (shifted.steps, shifted.probability) == (found.steps, found.probability) and shifted.threshold == -1.5


def test_an_episode_has_met_a_large_reward_once_though_it_would_go_on():
    always = TabularMDP.from_arrays([[0, 0]], [[1.0, 1.0]], gamma=1.0, horizon=5)
    found = hardness.exploration_time(always)
    assert (found.steps, found.episodes, found.probability) == (1.0, 1.0, 1.0)


def test_what_does_not_exist_says_so():
    endless = chain(horizon=None, gamma=0.9)
    seen = Representation.of_matrix(np.eye(4))
    for name in ("kernel_regret", "kernel_learning_time", "aliasing_floor"):
        with pytest.raises(UndefinedMeasure, match=f"{name} is defined for episodes"):
            getattr(hardness, name)(endless, seen)
    assert "episodes" in refusal(UndefinedMeasure, hardness.exploration_time, endless)
    for cost in (0.0, -1.0):
        with pytest.raises(UndefinedMeasure, match=f"all rewards are {cost:g}, so none is large"):
            hardness.exploration_time(chain().with_rewards(np.full((4, 2), cost)))
    for name in ("kernel_regret", "kernel_policy_regret"):
        with pytest.raises(UndefinedMeasure, match=f"{name}: uniform play is optimal"):
            getattr(hardness, name)(chain().with_rewards(np.zeros((4, 2))), seen)
    assert "of 4 states; expected 5" in refusal(ParameterError, kernel_regret, chain(5), seen)
    assert "not symmetric" in refusal(ParameterError, Representation.of_matrix, [[1.0, 2.0], [0.0, 1.0]])
    assert "period is 0" in refusal(ParameterError, Schedule, period=0)
    missing = hardness.report(chain(), MEASURES)
    assert all("give an observation and a network" in missing[name].undefined for name in MEASURES)


def test_a_kernel_that_does_not_fit_is_told_before_anything_is_learnt(grid, monkeypatch):
    monkeypatch.setattr(
        "pharos.hardness.representation.learning.IdealisedLearner.curve", failing(AssertionError("learnt first"))
    )
    with pytest.raises(ParameterError, match="landmarks is 1; expected at least 2"):
        representation(grid, "vector", "mlp16", landmarks=1)
    with pytest.raises(ParameterError, match="landmarks is 1; expected at least 2"):
        Representation.of_matrix(np.eye(4), landmarks=1)
    seen = representation(grid, "vector", "mlp16", landmarks=0)
    monkeypatch.setattr("pharos.system.memory.available_memory", lambda: 800)
    with pytest.raises(ParameterError, match=r"10 states fit into memory.*landmarks"):
        kernel_regret(grid.mdp(), seen)


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    env = pharos.make("simple_grid", height=3, width=4)
    return pharos.build(env, tmp_path_factory.mktemp("space") / "grid", progress=False)


def test_a_report_has_them_where_there_is_a_representation_and_keeps_them(grid):
    mdp, seen = grid.mdp(), representation(grid, "vector", "mlp16")
    chosen = [*MEASURES, "minimal_gap"]
    first = hardness.report(mdp, chosen, representation=seen, schedule=SHORT)
    again = hardness.report(mdp, chosen, representation=representation(grid, "vector", "mlp16"), schedule=SHORT)
    assert all(again[name].kept for name in chosen)
    assert again["kernel_regret"].value == json.loads(json.dumps(first["kernel_regret"].value))
    other = hardness.report(mdp, chosen, representation=representation(grid, "one_hot", "mlp16"), schedule=SHORT)
    assert [name for name in chosen if other[name].kept] == ["minimal_gap"]
    assert {"kernel_regret", "aliasing_floor"} <= {measure.name for measure in hardness.selected_measures(None, True)}
    assert "kernel_regret" not in {measure.name for measure in hardness.selected_measures(None)}
    assert (
        hardness.report(mdp, "minimal_gap").to_dict()["conventions"].keys().isdisjoint({"representation", "schedule"})
    )


@pytest.mark.long
def test_the_command_line_has_them(grid):
    measured = ["--measures", ",".join(MEASURES), "--budget", "inf"]  # however busy the machine is
    target = ["hardness", "simple_grid", "height=3", "width=4", *measured]
    answer = json.loads(run(*target, "--observation", "simple_image", "--network", "cnn16", "--json").stdout)
    assert 0 < answer["measures"]["kernel_regret"]["value"] < 1
    assert answer["conventions"]["representation"]["network"] == "cnn16"
    assert answer["measures"]["aliasing_floor"] == 0
    done = run(*target, "--observation", "vector", "--network", "mlp128", "--landmarks", "4")
    assert "no bound" in " ".join(done.stdout.split())
    for words, line in (
        (["--network", "mlp128"], "--network goes with --observation NAME"),
        (["--initialisation", "sb3"], "--initialisation goes with --observation NAME"),
        (["--optimizer", "adam"], "--optimizer goes with --observation NAME"),
        (["--observation", "vector", "--network", "mlp-1"], "no closed form"),
        (["--observation", "vector", "--network", "lstm"], "no closed form"),
        (["--observation", "vector", "--network", "cnn16"], "has convolutions"),
        (["--observation", "vectors"], "did you mean 'vector'?"),
    ):
        assert line in usage_error(*target, *words)


OWN = """
from torch import nn

def small(shape):
    return nn.Sequential(nn.Flatten(), nn.Linear(shape[0], 16), nn.SiLU(), nn.Linear(16, 1))

def conv(shape):
    return nn.Conv3d(1, 1, 9)

def flat(shape):
    return nn.Sequential(nn.Flatten(), nn.Linear(shape[0], 1), nn.Flatten(0))

def endless(shape):
    layers = nn.Sequential(nn.Linear(shape[0], 4), nn.ReLU(), nn.Linear(4, 1))
    nn.init.constant_(layers[2].weight, float("nan"))
    return layers

def none(shape):
    return 3

count = 3
"""
OWN_ERRORS = {
    "conv": "network 'own.py:conv' on inputs of shape",
    "flat": "network 'own.py:flat' on inputs of shape (7,): outputs of one input have shape (1,); expected (1, A)",
    "endless": "network 'own.py:endless' on inputs of shape (7,): gradients of the network are not finite",
    "none": "network 'own.py:none' on inputs of shape (7,): make returned 3; expected a torch.nn.Module",
    "count": "found 3; expected a function",
    "absent": "network 'own.py:absent': there is no such name",
}


@pytest.mark.long
def test_a_network_of_ones_own_has_its_empirical_kernel(grid, tmp_path):
    """By the name of a function; what landmarks ask for is part of the same kernel."""
    pytest.importorskip("torch")
    file = tmp_path / "own.py"
    file.write_text(OWN)
    target = ["hardness", "simple_grid", "height=3", "width=4", "--measures", "kernel_regret,kernel_learning_time"]
    words = [*target, "--observation", "one_hot", "--network", f"{file}:small", "--fresh", "--json"]
    answer = json.loads(run(*words).stdout)
    assert 0 < answer["measures"]["kernel_regret"]["value"] < 1.5
    said = answer["conventions"]["representation"]
    assert (said["network"], said["networks"], said["initialisation"]) == ("own.py:small", 20, "its own")
    seen, states = representation(grid, "one_hot", f"{file}:small"), np.arange(8)
    whole = seen.kernel(states, states)
    assert (whole == whole.T).all()
    np.testing.assert_allclose(seen.kernel(states[:5], states[3:]), whole[:5, 3:], rtol=1e-4)
    for name, line in OWN_ERRORS.items():
        assert line in usage_error(*words[:-3], f"{file}:{name}")


OF_KERNELS = (
    kernel_regret,
    hardness.kernel_policy_regret,
    hardness.kernel_learning_time,
    hardness.kernel_sample_complexity,
    hardness.sampled_regret,
)


# Action sets ----------------------------------------------------------------------------------------------------------


def with_a_column(mdp, at):
    """The same outcome table with one more action, at a place of its own, that is available nowhere."""
    successors, probabilities, rewards = mdp
    places = [*range(at), 0, *range(at, successors.shape[1])]
    more = np.where(np.arange(len(places)) == at, -np.inf, rewards[:, places])
    return successors[:, places], probabilities[:, places], more


@pytest.mark.long
@pytest.mark.parametrize(("sticky", "random"), [(0.0, 0.0), (0.3, 0.0), (0.3, 0.25)])
@pytest.mark.parametrize("at", [0, 2])
def test_an_action_that_is_nowhere_available_changes_no_measure(sticky, random, at):
    rng = np.random.default_rng(3)
    table = rng.integers(0, 7, (7, 2, 2)), rng.dirichlet([1, 1], (7, 2)), rng.random((7, 2))
    options = {"gamma": 1.0, "horizon": 9, "initial": [0, 1]}
    some, more = (
        random_actions(sticky_actions(TabularMDP.from_outcomes(*each, **options), sticky), random)
        for each in (table, with_a_column(table, at))
    )
    assert more.available.sum() == 14
    look_alike = Representation.of_matrix(kernel_of(7), [0, 1, 2, 3, 4, 5, 0])
    for kernel in (Representation.of_matrix(kernel_of(7)), look_alike):
        for measure in OF_KERNELS:
            one, other = (measure(mdp, kernel, schedule=SHORT) for mdp in (some, more))
            assert one.value == pytest.approx(other.value, rel=1e-9)
        floors = [hardness.aliasing_floor(mdp, kernel, schedule=SHORT) for mdp in (some, more)]
        assert floors[0] == pytest.approx(floors[1], abs=1e-12)


@pytest.mark.long
def test_names_of_actions_that_differ_between_states_change_nothing_for_a_table():
    """Two of three actions in each state, others in each: the table's curve is that of the two."""
    rng = np.random.default_rng(4)
    successors, probabilities, rewards = (
        rng.integers(0, 6, (6, 2, 2)),
        rng.dirichlet([1, 1], (6, 2)),
        rng.random((6, 2)),
    )
    lacks = rng.integers(0, 3, 6)
    places = np.array([[0 if a == lack else a - (a > lack) for a in range(3)] for lack in lacks])
    rows = np.arange(6)[:, None]
    paid = np.where(np.arange(3) == lacks[:, None], -np.inf, rewards[rows, places])
    options = {"gamma": 1.0, "horizon": 9, "initial": [0, 1]}
    two = TabularMDP.from_outcomes(successors, probabilities, rewards, **options)
    three = TabularMDP.from_outcomes(successors[rows, places], probabilities[rows, places], paid, **options)
    for measure in OF_KERNELS[:2]:
        one, other = (measure(mdp, Representation.of_matrix(np.eye(6)), schedule=SHORT) for mdp in (two, three))
        np.testing.assert_allclose(one.tabular.greedy, other.tabular.greedy, atol=1e-12)
        np.testing.assert_allclose(one.curve.played, other.curve.played, atol=1e-12)
        assert np.ptp(one.tabular.greedy) > 0
    with pytest.raises(UndefinedMeasure, match="look alike, and other actions are available"):
        kernel_regret(three, Representation.of_matrix(np.eye(6), np.zeros(6, int)), schedule=SHORT)
