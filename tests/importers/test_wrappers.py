"""Wrappers around an environment that is imported: they change nothing of its MDP, or are refused; and its starts."""

import copy
import math
import re

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers

import pharos
from pharos import importers
from pharos.errors import FileFormatError, ParameterError, RuleError
from pharos.importers.gymnasium import is_unlikely
from refusals import refusal

VALUE = pytest.approx(0.9**5)  # of the dry lake


def lake(**options):
    return gymnasium.make("FrozenLake-v1", **{"is_slippery": False, **options})


def value(env, **options):
    return pharos.value_iteration(importers.gymnasium(env, gamma=0.9, **options)).value_at_start


class Same(gymnasium.Wrapper):
    """Does nothing."""


class Remap(gymnasium.ActionWrapper):
    def action(self, action):
        return (action + 1) % 4


class Cost(gymnasium.RewardWrapper):
    def reward(self, reward):
        return reward - 0.01


class Twice(gymnasium.Wrapper):
    def step(self, action):
        self.env.step(action)
        return self.env.step(action)


class Elsewhere(gymnasium.Wrapper):
    """Starts in another state."""

    def reset(self, **options):
        _, info = self.env.reset(**options)
        self.unwrapped.s = 4
        return 4, info


class Teleport(gymnasium.Wrapper):
    """Leads from state 2 to the goal, whatever is done."""

    def step(self, action):
        if self.unwrapped.s == 2:
            self.unwrapped.s = 14
            action = 2
        return self.env.step(action)


class Softly(gymnasium.Wrapper):
    """Goes on after falling into a hole."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated and reward > 0, truncated, info


class Impatient(gymnasium.Wrapper):
    """Cuts an episode off in state 8."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated or observation == 8, info


class Hesitant(gymnasium.Wrapper):
    """Repeats the action before, so that nothing happens in the first step of an episode."""

    last = None

    def reset(self, **options):
        self.last = None
        return self.env.reset(**options)

    def step(self, action):
        before, self.last = self.last, action
        return self.env.step(action if before is None else before)


class FewerActions(gymnasium.ActionWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.action_space = gymnasium.spaces.Discrete(2)

    def action(self, action):
        return action + 1


class Unlucky(gymnasium.ActionWrapper):
    def action(self, action):
        raise KeyError("luck")


def monitored(env):
    from stable_baselines3.common.monitor import Monitor

    return Monitor(env)


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: env,
        lambda env: env.unwrapped,
        Same,
        monitored,
        wrappers.RecordEpisodeStatistics,
        wrappers.Autoreset,
        wrappers.FlattenObservation,
        wrappers.TimeAwareObservation,
        lambda env: wrappers.TimeLimit(Same(env), 7),
        lambda env: wrappers.ClipReward(env, -1, 1),  # it changes nothing of these rewards
        lambda env: wrappers.TransformReward(wrappers.FlattenObservation(env), float),
        lambda env: wrappers.StickyAction(env, 0.0),
    ],
)
def test_wrappers_that_change_nothing_pass(wrap):
    assert value(wrap(lake())) == VALUE


@pytest.mark.parametrize(
    ("wrap", "name", "way"),
    [
        (
            lambda env: wrappers.TransformReward(env, lambda r: 10 * r),
            "TransformReward",
            "pays 10 in state 14, .*rewards=",
        ),
        (Cost, "Cost", r"pays -0\.01 .*in place of 0; .*rewards="),
        (lambda env: monitored(Same(Cost(monitored(env)))), "Cost", "rewards="),
        (lambda env: wrappers.NormalizeReward(env), "NormalizeReward", "rewards="),
        (lambda env: wrappers.StickyAction(env, 0.5), "StickyAction", r"sticky_actions\(mdp, 0\.5\), or --sticky 0\.5"),
        (lambda env: wrappers.StickyAction(env, 1e-9), "StickyAction", "--sticky 1e-09"),
        (lambda env: wrappers.StickyAction(env, 0.5, (2, 3)), "StickyAction", "not among what pharos has"),
        (lambda env: wrappers.RepeatAction(env, 2), "RepeatAction", "makes 2 calls of the environment in one step"),
        (Remap, "Remap", "executes action . in place of .; import env.unwrapped"),
        (Twice, "Twice", "makes 2 calls"),
        (Elsewhere, "Elsewhere", "starts episodes in state 4 in place of 0; .*initial="),
        (Teleport, "Teleport", "in place of|moves the environment"),
        (Softly, "Softly", "does not end the episode in state"),
        (Impatient, "Impatient", "cuts the episode off in state"),
        (lambda env: wrappers.TimeLimit(Hesitant(env), 1), "Hesitant", "executes action . in place of .;"),
        (FewerActions, "FewerActions", "has 2 actions, the environment 4"),
        (Unlucky, "Unlucky", "cannot be compared .*KeyError"),
    ],
)
def test_wrappers_that_change_the_mdp_are_refused_by_name_with_the_way_that_works(wrap, name, way):
    said = refusal(ParameterError, importers.gymnasium, wrap(lake()))
    assert said.startswith(name + ":")
    assert re.search(way, said), said
    assert importers.gymnasium_outcomes(lake()) is None
    refusal(ParameterError, importers.gymnasium_outcomes, wrap(lake()))


def test_a_reward_that_no_walk_meets_is_compared_all_the_same():
    """On the large slippery lake one episode in some hundreds meets the goal."""
    env = wrappers.TransformReward(lake(map_name="8x8", is_slippery=True), lambda r: 10 * r)
    assert "TransformReward: pays 10 in state" in refusal(ParameterError, importers.gymnasium, env)
    assert "TransformReward" in refusal(ParameterError, importers.gymnasium, env, check=False)


@pytest.mark.long
def test_the_ways_that_refusals_name_give_the_values_of_the_wrapped_environment():
    def steps_to_goal(env):  # the shortest way, of deterministic rewards: six steps, the last one pays
        env.reset(seed=0)
        return sum(0.9**t * env.step(action)[1] for t, action in enumerate((1, 1, 2, 1, 2, 2)))

    ten, cost = wrappers.TransformReward(lake(), lambda r: 10 * r), Cost(lake())
    assert value(ten.unwrapped, rewards=lambda s, a, t, r: ten.func(r)) == pytest.approx(steps_to_goal(ten))
    assert value(cost.unwrapped, rewards=lambda s, a, t, r: r - 0.01) == pytest.approx(steps_to_goal(cost))
    assert steps_to_goal(cost) == pytest.approx(0.543634, abs=1e-6)
    sticky = pharos.sticky_actions(importers.gymnasium(lake().unwrapped, gamma=0.9), 0.5)
    assert pharos.value_iteration(sticky).value_at_start == pytest.approx(0.421836, abs=1e-6)
    moved = importers.gymnasium(Elsewhere(lake()).unwrapped, gamma=0.9, initial=4)
    assert pharos.value_iteration(moved).value_at_start == pytest.approx(0.9**4)


def test_rewards_of_outcomes_are_exchanged_with_their_means(tmp_path):
    env = lake(is_slippery=True)
    table = np.arange(64.0).reshape(16, 4)
    np.testing.assert_allclose(importers.gymnasium(env, rewards=table).rewards, table)

    def by_arrival(s, a, t, r):
        return float(t)

    mdp = importers.gymnasium(env, rewards=by_arrival)
    means = [[sum(p * t for p, t, _, _ in env.unwrapped.P[s][a]) for a in range(4)] for s in range(16)]
    np.testing.assert_allclose(mdp.rewards, means)
    importers.save(mdp, tmp_path / "kept", outcomes=importers.gymnasium_outcomes(env, rewards=by_arrival))
    assert "rewards have shape (3,); expected (16, 4)" in refusal(
        ParameterError, importers.gymnasium, env, rewards=[1, 2, 3]
    )


def test_rewards_in_place_of_the_table_count_in_what_the_sums_of_rows_leave_open():
    """A row of one state lacks 1e-7 and pays 8 in place of 1: apart by at most 8e-7, and divided by its sum."""
    short = {0: {0: [(0.5, 0, 1.0, False), (0.5 - 1e-7, 0, 1.0, True)]}}
    mdp = importers.gymnasium(short, gamma=0.9, rewards=lambda s, a, t, r: 8 * r)
    assert mdp.rewards == pytest.approx(8.0, abs=1e-12)
    assert mdp.residual == pytest.approx((1e-7, 8e-7), rel=1e-6)
    assert mdp.residual.rewards == pytest.approx(8 * importers.gymnasium(short).residual.rewards)
    outcomes = importers.gymnasium_outcomes(short, rewards=lambda s, a, t, r: 8.0 if a else r)
    assert outcomes is None  # all of the row pay the same


@pytest.mark.parametrize(
    ("rewards", "text"),
    [
        (lambda s, a, t, r: math.nan, "rewards: nan in state 0, action 0, to 0; expected a finite number"),
        (lambda s, a, t, r: None, "rewards: None in state 0, action 0, to 0; expected a finite number"),
        ([[math.inf]], "rewards: inf in state 0, action 0, to 0; expected a finite number"),
    ],
)
def test_rewards_that_are_no_finite_numbers_are_refused(rewards, text):
    table = {0: {0: [(1.0, 0, 1.0, False)]}}
    for importer in (importers.gymnasium, importers.gymnasium_outcomes):
        assert refusal(ParameterError, importer, table, rewards=rewards) == text
        wrong = {0: {0: [(1.0, "0", 1.0, False)]}}  # the table is looked at first
        assert "P[0][0] has (1.0, '0', 1.0, False)" in refusal(FileFormatError, importer, wrong, rewards=rewards)


class FromTwo(gymnasium.Env):
    """A ring of three states that shows them from 1 on, and has actions from 2 on."""

    P = {s: {a: [(1.0, (s + 1 + a) % 3, float(s), False)] for a in range(2)} for s in range(3)}
    observation_space, action_space = gymnasium.spaces.Discrete(3, start=1), gymnasium.spaces.Discrete(2, start=2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 1
        return 2, {}

    def step(self, action):
        assert self.action_space.contains(action)
        _, self.s, reward, ended = self.P[self.s][int(action) - 2][0]
        return self.s + 1, reward, ended, False, {}


class Checking(gymnasium.Wrapper):
    """Looks at what passes."""

    def step(self, action):
        assert self.action_space.contains(action)
        observation, *rest = self.env.step(action)
        assert self.observation_space.contains(observation)
        return observation, *rest


def test_wrappers_and_starts_of_spaces_that_do_not_begin_with_0():
    for env in (FromTwo(), Checking(FromTwo())):
        mdp = importers.gymnasium(env, gamma=0.9)
        assert mdp.next_states.tolist() == [[1, 2], [2, 0], [0, 1]]
        assert mdp.start_states.tolist() == [1]
    said = refusal(ParameterError, importers.gymnasium, Cost(FromTwo()))
    assert re.match(r"Cost: pays \S+ in state [012], action [23], in place of [012]; import env.unwrapped", said)


def test_what_is_stepped_for_comparison_is_a_copy_and_writes_nothing(tmp_path):
    from stable_baselines3.common.monitor import Monitor

    log = tmp_path / "log.monitor.csv"
    env = wrappers.TransformReward(Monitor(lake(), str(log)), lambda r: r)
    env.reset(seed=3)
    env.step(1)
    text, rng = log.read_text(), env.unwrapped.np_random.bit_generator.state
    assert value(env) == VALUE
    assert log.read_text() == text and env.unwrapped.s == 4
    assert env.unwrapped.np_random.bit_generator.state == rng
    env.step(1)  # the episode goes on
    env.close()


# Start distributions -------------------------------------------------------------------------------------------------


class Grid:
    """4 x 4 cells, ends in two corners, -1 a step; with old gym's interface."""

    def __init__(self, starts=range(16), **told):
        def outcome(s, row, column):
            t = 4 * min(max(s // 4 + row, 0), 3) + min(max(s % 4 + column, 0), 3)
            return [(1.0, s, 0.0, True)] if s in (0, 15) else [(1.0, t, -1.0, t in (0, 15))]

        moves = ((-1, 0), (0, 1), (1, 0), (0, -1))
        self.P = {s: {a: outcome(s, *move) for a, move in enumerate(moves)} for s in range(16)}
        self.starts, self.rng = list(starts), np.random.default_rng(0)
        vars(self).update(told)

    def reset(self):
        self.s = int(self.rng.choice(self.starts))
        return self.s

    def step(self, action):
        _, self.s, reward, ended = self.P[self.s][action][0]
        return self.s, reward, ended, {}


UNIFORM = np.ones(16) / 16


def by_hand(starts):
    """Mean value of the grid: -1 for each step to the nearer corner, discounted."""
    steps = [min(s // 4 + s % 4, 6 - s // 4 - s % 4) for s in starts]
    return np.mean([-(1 - 0.9**n) / 0.1 for n in steps])


@pytest.mark.parametrize("name", ["initial_state_distrib", "isd"])
def test_a_start_distribution_is_read_and_compared_with_resets(name):
    assert value(Grid(**{name: UNIFORM})) == pytest.approx(by_hand(range(16))) == pytest.approx(-1.64, abs=0.005)
    for starts in ([3], [1, 2], [*range(16), *[5] * 4]):  # the last one: all states, one of them too often
        said = refusal(FileFormatError, importers.gymnasium, Grid(starts, **{name: UNIFORM}))
        assert f"its {name} says otherwise; give initial=" in said
        assert f"its resets start in {', '.join(map(str, sorted(set(starts))[:5]))}" in said
    assert value(Grid([3], **{name: UNIFORM}), check=False) == pytest.approx(by_hand(range(16)))


def test_a_start_that_is_only_drawn_in_reset_is_taken_if_it_is_one_state():
    assert value(Grid([6])) == pytest.approx(by_hand([6]))
    said = refusal(FileFormatError, importers.gymnasium, Grid([3, 7, 9]))
    assert "its resets start in 3, 7, 9, and it has no initial_state_distrib; give initial=" in said
    assert value(Grid([3, 7, 9]), initial=[3, 7, 9]) == pytest.approx(by_hand([3, 7, 9]))
    assert value(Grid(), initial=UNIFORM) == pytest.approx(by_hand(range(16)))
    assert value(Grid().P, initial=UNIFORM) == pytest.approx(by_hand(range(16)))
    assert value(Grid().P) == 0.0  # a table alone starts in state 0


@pytest.mark.parametrize("p", [0.5, 0.1, 0.001, 1e-6])
def test_counts_that_are_refused_are_less_likely_than_one_in_a_million(p):
    """Exact: the probabilities of all counts of 2,000 draws that are refused are summed."""
    n = 2000
    probability, refused, distribution = 0.0, 0, np.array([p, 1 - p])
    for k in range(n + 1):
        if is_unlikely(np.array([k, n - k]), distribution):
            refused += 1
            log = math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
            probability += math.exp(log + k * math.log(p) + (n - k) * math.log1p(-p))
    assert refused > n / 2 and probability <= 1e-6


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["FrozenLake-v1", "FrozenLake8x8-v1", "Taxi-v4", "CliffWalking-v1", "CliffWalkingSlippery-v1"]
)
def test_environments_as_gymnasium_makes_them_are_never_refused(name):
    env = gymnasium.make(name)
    assert importers.gymnasium(env).num_states == env.observation_space.n
    assert importers.gymnasium(Same(env)).num_states == env.observation_space.n


# MiniGrid ------------------------------------------------------------------------------------------------------------


def lava():
    minigrid = pytest.importorskip("minigrid")
    return gymnasium.make("MiniGrid-LavaGapS5-v0"), minigrid.wrappers


@pytest.mark.slow
def test_no_death_of_minigrid_is_taken_over():
    """Beside a breadth-first search of its own, over copies of the wrapped environment."""
    env, package = lava()
    wrapped = package.NoDeath(package.FullyObsWrapper(env), ("lava",), death_cost=-1.0)
    mdp = importers.minigrid(wrapped, gamma=0.9, horizon=None)
    assert set(np.unique(mdp.rewards)) == {-1.0, 0.0, 1.0}
    wrapped.reset(seed=0)

    def key(each):
        return (*map(int, each.unwrapped.agent_pos), int(each.unwrapped.agent_dir))

    found, queue, rows = {key(wrapped): 0}, [copy.deepcopy(wrapped)], []
    while len(rows) < len(queue):
        row = []
        for action in range(3):
            stepped = copy.deepcopy(queue[len(rows)])
            stepped.unwrapped.step_count = 0
            _, reward, ended, _, _ = stepped.step(action)
            if not ended and key(stepped) not in found:
                found[key(stepped)] = len(found)
                queue.append(stepped)
            row.append((None if ended else found[key(stepped)], 1.0 if reward > 0 else reward))
        rows.append(row)
    v = np.zeros(len(rows))
    for _ in range(400):  # turns, steps, and what does nothing: uniform play
        v = np.array(
            [
                (sum(r + 0.9 * (0 if t is None else v[t]) for t, r in row) + 3 * 0.9 * v[s]) / 6
                for s, row in enumerate(rows)
            ]
        )
    assert mdp.num_states == len(rows)
    assert pharos.solvers.uniform_value(mdp, 1e-9).value_at_start == pytest.approx(v[0], abs=1e-8)
    plain = importers.minigrid(env, gamma=0.9, horizon=None)
    assert pharos.solvers.uniform_value(plain).value_at_start > 0 > v[0]


@pytest.mark.slow
def test_a_payment_of_no_death_that_shrinks_with_time_is_refused():
    env, package = lava()
    wrapped = package.NoDeath(env, ("lava",), death_cost=-0.5)
    wrapped.no_death_types = ("goal",)
    said = refusal(RuleError, importers.minigrid, wrapped)
    assert "expected what does not depend on the number of steps" in said and "pays 0.49" in said


@pytest.mark.slow
def test_other_wrappers_of_minigrid_change_nothing_or_are_refused():
    env, package = lava()
    expected = importers.minigrid(env)
    for wrapped in (package.FullyObsWrapper(env), package.ImgObsWrapper(env), Same(env)):
        assert (importers.minigrid(wrapped).next_states == expected.next_states).all()
    with pytest.warns(UserWarning, match="seed"):
        again = importers.minigrid(package.ReseedWrapper(env, seeds=[0]))
    assert (again.next_states == expected.next_states).all()
    for wrapped, way in (
        (
            package.StochasticActionWrapper(env, prob=0.5),
            r"actions=range\(7\), and add pharos.random_actions\(mdp, 0\.5\)",
        ),
        (package.StochasticActionWrapper(env, prob=0.9, random_action=1), "not among what pharos has"),
        (package.ActionBonus(env), "pays 1 for action 0 in place of 0"),
        (package.PositionBonus(env), "pays 1 for action 0 in place of 0"),
        (Cost(env), "pays -0.01"),
    ):
        with pytest.raises(ParameterError, match=f"^{type(wrapped).__name__}: .*{way}") as caught:
            importers.minigrid(wrapped)
        assert "\n" not in str(caught.value)
