"""Wrapped environments and models trained elsewhere: they arrive whole, or are refused in one line.

Chains of wrappers are drawn of pieces that change nothing and of pieces that change the MDP, however rarely; models of
the observation that they were trained on and the one that they get, with a VecNormalize or masks or without.
"""

from collections import Counter
from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers

import pharos
from pharos import importers, solvers
from pharos.errors import ParameterError
from refusals import refusal

pytestmark = pytest.mark.long

CHAINS, MODELS = 240, 160


class Piece(gymnasium.Wrapper):
    """A wrapper that changes something in one state alone, `place`."""

    def __init__(self, env, place, rng):
        super().__init__(env)
        self.place, self.rng = place, rng


class PaysElsewhere(Piece):
    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        return observation, reward + 0.5 * (self.unwrapped.s == self.place), *rest


class EndsElsewhere(Piece):
    def step(self, action):
        observation, reward, terminated, *rest = self.env.step(action)
        return observation, reward, terminated != (self.unwrapped.s == self.place), *rest


class CutsOff(Piece):
    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated or self.unwrapped.s == self.place, info


class ActsElsewhere(Piece):
    def step(self, action):
        return self.env.step((action + 1) % self.action_space.n if self.unwrapped.s == self.place else action)


class Jumps(Piece):
    def step(self, action):
        before = self.unwrapped.s
        answer = self.env.step(action)
        if before == self.place:
            self.unwrapped.s = (self.unwrapped.s + 1) % len(self.unwrapped.P)
        return answer


class StartsAnywhere(Piece):
    def reset(self, **options):
        _, info = self.env.reset(**options)
        self.unwrapped.s = int(self.rng.integers(len(self.unwrapped.P)))
        return self.unwrapped.s, info


class OftenRepeats(Piece):
    """Sticky actions by another name."""

    last = None

    def reset(self, **options):
        self.last = None
        return self.env.reset(**options)

    def step(self, action):
        if self.last is not None and self.rng.random() < 0.1:
            action = self.last
        self.last = action
        return self.env.step(action)


class OwnObservation(gymnasium.ObservationWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(0, 1000, (1,), np.float64)

    def observation(self, observation):
        return np.array([float(observation)])


class Mute(gymnasium.Wrapper):
    def step(self, action):
        observation, reward, terminated, truncated, _ = self.env.step(int(action))
        return observation, float(reward), terminated, truncated, {}


def monitor(env):
    from stable_baselines3.common.monitor import Monitor

    return Monitor(env)


HARMLESS = {
    "limit": lambda env, place, rng: wrappers.TimeLimit(env, int(rng.integers(1, 50))),
    "monitor": lambda env, place, rng: monitor(env),
    "statistics": lambda env, place, rng: wrappers.RecordEpisodeStatistics(env),
    "mute": lambda env, place, rng: Mute(env),
    "wide clip": lambda env, place, rng: wrappers.ClipReward(env, -1000, 1000),
    "same reward": lambda env, place, rng: wrappers.TransformReward(env, float),
    "same action": lambda env, place, rng: wrappers.TransformAction(env, int, env.action_space),
    "sticky 0": lambda env, place, rng: wrappers.StickyAction(env, 0.0),
}
HARMFUL = {
    "PaysElsewhere": PaysElsewhere,
    "EndsElsewhere": EndsElsewhere,
    "CutsOff": CutsOff,
    "ActsElsewhere": ActsElsewhere,
    "Jumps": Jumps,
    "StartsAnywhere": StartsAnywhere,
    "OftenRepeats": OftenRepeats,
    "StickyAction": lambda env, place, rng: wrappers.StickyAction(env, float(rng.uniform(1e-6, 0.9))),
    "RepeatAction": lambda env, place, rng: wrappers.RepeatAction(env, 2),
    "TransformReward": lambda env, place, rng: wrappers.TransformReward(env, lambda r: 2 * r),
    "NormalizeReward": lambda env, place, rng: wrappers.NormalizeReward(env),
    "TransformAction": lambda env, place, rng: wrappers.TransformAction(
        env, lambda a: (a + 1) % env.action_space.n, env.action_space
    ),
}


def bases(rng):
    """An environment of toy text, each time another one."""
    from gymnasium.envs.toy_text.frozen_lake import generate_random_map

    if rng.random() < 0.2:
        return gymnasium.make("CliffWalking-v1", is_slippery=bool(rng.integers(2)))
    text = generate_random_map(size=int(rng.integers(3, 6)), seed=int(rng.integers(1000)))
    return gymnasium.make("FrozenLake-v1", desc=text, is_slippery=bool(rng.integers(2)))


def places(env):
    """States that an action leads into without an end, so that what happens there shows."""
    table = env.unwrapped.P
    return sorted({t for s in table for a in table[s] for p, t, _, end in table[s][a] if p and not end and t != s})


def test_chains_of_wrappers_arrive_whole_or_are_refused(count):
    rng, tally = np.random.default_rng(0), Counter()
    for _ in range(CHAINS):
        env = bases(rng)
        expected = importers.gymnasium(env.unwrapped, check=False)
        names, harmful = [], []
        for _ in range(int(rng.integers(1, 5))):
            pieces = HARMFUL if rng.random() < 0.2 else HARMLESS
            name = str(rng.choice([piece for piece in pieces if piece not in names]))  # two may not go together
            env = pieces[name](env, int(rng.choice(places(env))), np.random.default_rng(int(rng.integers(99))))
            names.append(name)
            harmful += [name] * (pieces is HARMFUL)
        if rng.random() < 0.3:
            env = OwnObservation(env)
        if not harmful:
            mdp = importers.gymnasium(env)
            assert (mdp.rewards == expected.rewards).all(), names
            assert pharos.value_iteration(mdp).value_at_start == pharos.value_iteration(expected).value_at_start
            tally["taken over"] += 1
            continue
        said = refusal(ParameterError, importers.gymnasium, env)
        assert said.partition(":")[0] in harmful, (names, said)
        assert len(said) < 300 and ("import env.unwrapped" in said or "not among what pharos has" in said), said
        tally["refused"] += 1
    assert min(tally["taken over"], tally["refused"]) > CHAINS // 5
    count(f"{CHAINS} chains of wrappers: {tally['taken over']} taken over, {tally['refused']} refused by name")


# Models --------------------------------------------------------------------------------------------------------------


OBSERVATIONS = ("vector", "one_hot", "hash", "mixed", "index", "number", "simple_image")
WORLDS = ("frozen_lake/4x4", "cliff_walking/4x12")


@dataclass
class Brought:
    """A model with what is true of it.

    Attributes:
        seen: observation that it was trained on. is_lost: whether its VecNormalize, or its environment, is.
        answer: function from observations to (N, A) probabilities.
    """

    model: object
    seen: str
    is_lost: bool
    answer: object
    masks: np.ndarray | None = None


def brought(world, mdp, rng, folder):
    import sb3_contrib
    import stable_baselines3 as sb3
    import torch
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    seen = str(rng.choice(OBSERVATIONS))
    kind = [sb3.PPO, sb3.A2C, sb3.DQN, sb3_contrib.MaskablePPO][rng.integers(4)]
    env = DummyVecEnv([lambda: pharos.GymEnv(world, observation=seen)])
    normalizer = None
    if seen in ("vector", "mixed") and rng.random() < 0.5:
        env = normalizer = VecNormalize(env)
        shape = env.observation_space.shape
        env.obs_rms.mean, env.obs_rms.var = rng.normal(size=shape), rng.uniform(0.1, 2, shape)
    sizes = {"buffer_size": 10} if kind is sb3.DQN else {"n_steps": 8}
    sizes |= {} if kind in (sb3.DQN, sb3.A2C) else {"batch_size": 8}
    kwargs = {"normalize_images": False} if seen == "simple_image" else {}
    model = kind("MlpPolicy", env, seed=int(rng.integers(99)), device="cpu", policy_kwargs=kwargs, **sizes)
    model._setup_learn(1)  # what the first step of `learn` leaves, so that files of the model have it
    is_lost = False
    if rng.random() < 0.4:
        model.save(folder / "model.zip")
        is_lost = bool(rng.integers(2)) and (normalizer is not None or seen == "index")
        alone = {} if is_lost or (normalizer is None and seen != "index") else {"env": env}
        model = kind.load(folder / "model.zip", device="cpu", **alone)
    masks = None
    if kind is sb3_contrib.MaskablePPO:
        masks = rng.random((mdp.num_states, mdp.num_actions)) < 0.6
        masks[np.arange(len(masks)), rng.integers(mdp.num_actions, size=len(masks))] = True

    def answer(observations):
        if normalizer is not None:
            rms = normalizer.obs_rms
            observations = np.clip((observations - rms.mean) / np.sqrt(rms.var + normalizer.epsilon), -10, 10)
        with torch.no_grad():
            tensor, _ = model.policy.obs_to_tensor(observations)
            if kind is sb3.DQN:
                return np.eye(mdp.num_actions)[model.policy.q_net(tensor.float()).argmax(dim=1).numpy()]
            found = model.policy.get_distribution(tensor).distribution.probs.numpy().astype(float)
        found = found if masks is None else found * masks
        return found / found.sum(axis=1, keepdims=True)

    return Brought(model, seen, is_lost, answer, masks)


def test_models_arrive_whole_or_are_refused(count, tmp_path):
    pytest.importorskip("sb3_contrib")
    rng, tally = np.random.default_rng(1), Counter()
    spaces = {world: pharos.build(world, progress=False) for world in WORLDS}
    for i in range(MODELS):
        world = WORLDS[rng.integers(len(WORLDS))]
        space = spaces[world]
        mdp = space.mdp(gamma=1.0).with_horizon(30)
        each = brought(world, mdp, rng, tmp_path)
        name = each.seen if rng.random() < 0.5 else str(rng.choice(OBSERVATIONS))
        options = {} if each.masks is None or rng.random() < 0.3 else {"masks": each.masks}
        if name != each.seen or each.is_lost or (each.masks is not None and not options):
            said = refusal(ParameterError, pharos.evaluate_policy, mdp, each.model, observation=name, **options)
            assert len(said) < 400, said
            tally["refused"] += 1
            continue
        states = space.states(np.arange(space.num_states))
        seen = pharos.observe(space.environment, name, state_space=space)(states)
        expected = solvers.evaluate_policy(mdp, each.answer(seen)).value_at_start
        found = pharos.evaluate_policy(mdp, each.model, observation=name, **options).value_at_start
        assert found == pytest.approx(expected, abs=2e-4), (i, name)
        tally["evaluated"] += 1
    assert min(tally.values()) > MODELS // 5
    count(f"{MODELS} models trained elsewhere: {tally['evaluated']} evaluated exactly, {tally['refused']} refused")
