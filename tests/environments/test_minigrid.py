"""MiniGrid: enumerated states against the environments as others play them, and against the MDP that BRIDGE
published."""

import json
import sys
from collections import deque
from pathlib import Path

import gymnasium
import minigrid  # noqa: F401  (registers its environments)
import numpy as np
import pytest
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.minigrid_env import MiniGridEnv
from minigrid.wrappers import FullyObsWrapper

import pharos
from command_line import run
from pharos import hardness, importers
from pharos.errors import MissingExtra, ParameterError, RuleError, StateSpaceTooLarge
from pharos.importers import minigrid_recording
from pharos.mdp.bisimulation import minimize
from refusals import refusal

CORRIDOR = "MiniGrid-KeyCorridorS3R1-v0"
PUBLISHED = Path(__file__).parents[1] / "data" / "bridge" / "key-corridor-s3r1.npz"

# Keys, doors, lava, a task that needs `done`, one in which objects are put down, one whose rules remember, one of
# BabyAI.
SMALL = (
    "MiniGrid-Empty-5x5-v0",
    "MiniGrid-DoorKey-5x5-v0",
    "MiniGrid-LavaGapS5-v0",
    "MiniGrid-GoToDoor-5x5-v0",
    "MiniGrid-PutNear-6x6-N2-v0",
    "MiniGrid-RedBlueDoors-6x6-v0",
    "MiniGrid-MemoryS7-v0",
    "BabyAI-GoToObjS4-v0",
)


def isomorphic(one, other):
    """Whether a bijection of the states reached from the start keeps every transition and reward."""
    names = {int(one.start_states[0]): int(other.start_states[0])}
    queue = deque(names)
    while queue:
        s = queue.popleft()
        if (one.rewards[s] != other.rewards[names[s]]).any():
            return False
        for following, expected in zip(one.next_states[s].tolist(), other.next_states[names[s]].tolist(), strict=True):
            if following >= 0 and following not in names:
                names[following] = expected
                queue.append(following)
            if (names[following] if following >= 0 else -1) != expected:
                return False
    return len(names) == len(set(names.values())) == one.num_states == other.num_states


@pytest.mark.long
def test_key_corridor_is_what_bridge_published():
    """Its 168 states, transition by transition: those that differ only in whether the key was ever carried are told
    apart."""
    published = importers.bridge(PUBLISHED, horizon=100)
    mdp = importers.minigrid(CORRIDOR, seed=0, remember_carried=True)
    assert (mdp.num_states, mdp.num_actions, mdp.gamma, mdp.horizon) == (168, 6, 1.0, 100)
    assert isomorphic(mdp, published)
    assert not isomorphic(importers.minigrid(CORRIDOR, seed=2, remember_carried=True), published)


@pytest.mark.slow
def test_key_corridor_with_equal_states_merged():
    """What the key went through changes nothing that can happen: 156 classes."""
    published = importers.bridge(PUBLISHED, horizon=100)
    mdp = importers.minigrid(CORRIDOR, seed=0)
    assert mdp.num_states == minimize(mdp).num_classes == minimize(published).num_classes == 156
    assert isomorphic(minimize(published).mdp, mdp)


@pytest.mark.long
@pytest.mark.parametrize("remember", [False, True])
def test_key_corridor_has_its_published_values(remember):
    mdp = importers.minigrid(CORRIDOR, remember_carried=remember)
    assert pharos.value_iteration(mdp).value_at_start == 1.0
    assert pharos.solvers.uniform_value(mdp).value_at_start == pytest.approx(0.0032357130, abs=5e-11)
    found = hardness.effective_horizon(mdp)
    assert (found.k_min, found.value) == (1, 16.0)


@pytest.mark.long
@pytest.mark.parametrize("name", SMALL)
def test_the_table_and_the_environment_agree_at_every_step_of_walks(name):
    env = FullyObsWrapper(gymnasium.make(name, disable_env_checker=True, max_steps=10**6))
    mdp, grids, _ = minigrid_recording(name, seed=3)
    assert (importers.minigrid_grids(name, seed=3) == grids).all()
    assert len(grids) == mdp.num_states
    best = pharos.value_iteration(mdp.with_gamma(0.9).with_horizon(None)).policy
    rng = np.random.default_rng(0)
    observation, _ = env.reset(seed=3)
    state, ends = 0, 0
    for _ in range(1500):
        assert (observation["image"] == grids[state]).all()
        action = int(rng.integers(mdp.num_actions)) if rng.random() < 0.6 else int(best[state])
        observation, reward, terminated, _, _ = env.step(action)
        following = mdp.next_states[state, action]
        assert (following == -1) == terminated
        assert mdp.rewards[state, action] == (reward > 0)
        if terminated:
            observation, _ = env.reset(seed=3)
            following, ends = 0, ends + 1
        state = following
    assert ends > 0


def test_done_is_an_action_only_where_it_does_something():
    assert importers.minigrid("MiniGrid-GoToDoor-5x5-v0").num_actions == 7
    assert importers.minigrid("MiniGrid-Empty-5x5-v0").num_actions == 6
    all_of_them = importers.minigrid("MiniGrid-Empty-5x5-v0", actions=range(7))
    assert (all_of_them.next_states[:, 6] == np.arange(all_of_them.num_states)).all()
    turning = importers.minigrid("MiniGrid-Empty-5x5-v0", actions=[0, 1])
    assert (turning.num_states, turning.num_actions) == (4, 2)


@pytest.mark.long
def test_an_environment_that_was_made_is_taken_as_it_is():
    env = gymnasium.make(CORRIDOR, disable_env_checker=True)
    assert isomorphic(importers.minigrid(env, seed=2), importers.minigrid(CORRIDOR, seed=2))
    observation, _ = env.reset(seed=0)
    assert "image" in observation


def test_what_cannot_be_imported_is_refused_in_one_line():
    with pytest.raises(RuleError, match="draws random numbers in state 0"):
        importers.minigrid("MiniGrid-Dynamic-Obstacles-5x5-v0")
    assert "max_states=20" in refusal(StateSpaceTooLarge, importers.minigrid, CORRIDOR, max_states=20)
    assert "cannot make it" in refusal(ParameterError, importers.minigrid, "MiniGrid-KeyCorridorS3R9-v0")
    assert "is no environment of MiniGrid" in refusal(ParameterError, importers.minigrid, "FrozenLake-v1")
    for actions in ([], [0, 0], [7], [-1]):
        with pytest.raises(ParameterError, match="expected different ones from 0 to 6"):
            importers.minigrid(CORRIDOR, actions=actions)


class Corridor(MiniGridEnv):
    """Six cells: 0.2 at the left end, beside which the agent stands and which it faces, 5 at the right end."""

    def __init__(self, pay=lambda own, place, steps: {1: 0.2, 6: 5.0}.get(place, 0.0), start=2, ends=(1, 6)):
        self.pay, self.start, self.ends = pay, start, ends
        super().__init__(MissionSpace(lambda: "go"), width=8, height=3, max_steps=50)

    def _gen_grid(self, width, height):
        self.grid = Grid(width, height)
        self.grid.wall_rect(0, 0, width, height)
        self.agent_pos, self.agent_dir, self.mission = (self.start, 1), 2, "go"

    def step(self, action):
        *_, truncated, info = super().step(action)
        place = int(self.agent_pos[0])
        return {}, self.pay(self._reward(), place, self.step_count), place in self.ends, truncated, info


def test_a_task_of_ones_own_pays_what_its_class_pays():
    mdp = importers.minigrid(Corridor(), gamma=0.9, horizon=None)
    assert sorted(set(mdp.rewards.ravel())) == [0.0, 0.2, 5.0]
    solution = pharos.value_iteration(mdp)  # turn round twice and go four cells: 0.9^5 * 5, not one step and 0.2
    assert solution.value_at_start == pytest.approx(0.9**5 * 5) and solution.policy[0] in (0, 1)
    costly = importers.minigrid(Corridor(lambda own, place, steps: 0.9 if place == 6 else -0.05))
    assert sorted(set(costly.rewards.ravel())) == [-0.05, 0.9]


def test_the_packages_own_payment_is_1_also_in_a_task_of_ones_own():
    mdp = importers.minigrid(Corridor(lambda own, place, steps: own if place == 6 else -0.5 * (place == 1)))
    assert sorted(set(mdp.rewards.ravel())) == [-0.5, 0.0, 1.0]


@pytest.mark.parametrize(
    ("pay", "message"),
    [
        (lambda own, place, steps: 0.5 * own * (place == 6), "pays 0.491 at first and 0.059 after 48 steps"),
        (lambda own, place, steps: float(steps > 10), "pays 0 at first and 1 after 48 steps by action 0 in state 0"),
        (lambda own, place, steps: float("nan"), "pays nan in state 0"),
    ],
)
def test_payments_that_depend_on_time_otherwise_are_refused(pay, message):
    said = refusal(RuleError, importers.minigrid, Corridor(pay))
    assert message in said


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "minigrid", None)
    assert "pharos-rl[minigrid]" in refusal(MissingExtra, importers.minigrid, CORRIDOR)


@pytest.mark.long
def test_the_command_line_keeps_an_environment_in_a_folder(tmp_path):
    words = ["import", "minigrid", CORRIDOR, "--out", str(tmp_path / "kept"), "--json"]
    answer = json.loads(run(*words).stdout)
    assert (answer["num_states"], answer["horizon"]) == (156, 100)
    assert isomorphic(importers.load(tmp_path / "kept"), importers.minigrid(CORRIDOR))
