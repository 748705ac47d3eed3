"""Steps per second beside EnvPool, MinAtar and gymnax, in one process and one run; those installed.

    pip install envpool minatar gymnax; python benchmarks/peers.py [--seconds S]

Vector environments have 1,024 copies and random actions drawn beforehand. gymnax runs on the CPU, once called for each
step as the others are, and once for 64 steps inside one compiled loop, with actions drawn inside, its fastest use.
Images are of cells with a channel for each kind of thing, in pharos ("simple_image"), MinAtar and gymnax alike. The
peers' boards have 10 x 10 cells.
"""

import argparse
import importlib.util

import gymnasium
import numpy as np

import pharos
from pharos.interaction import make_vec
from stepping import NUM_ENVS, _rate, steps_per_second_of_one, steps_per_second_of_vector

GAMES = {"breakout": {"height": 10, "columns": 10, "brick_rows": 3}, "freeway": {"num_cars": 8, "lane_length": 10}}


def envpool_frozen_lake(seconds):
    import envpool

    env = envpool.make_gymnasium("FrozenLake-v1", num_envs=NUM_ENVS, num_threads=2)
    actions = np.random.default_rng(0).integers(4, size=(64, NUM_ENVS)).astype(np.int32)
    env.reset()
    env.step(actions[0])
    return _rate(lambda k: env.step(actions[k % 64]), seconds) * NUM_ENVS


def minatar(game, seconds):
    from minatar import Environment

    env = Environment(game, sticky_action_prob=0.25)
    actions = np.random.default_rng(0).integers(env.num_actions(), size=4096).tolist()
    env.reset()

    def step(k):
        _, ended = env.act(actions[k % 4096])
        env.state()
        if ended:
            env.reset()

    return _rate(step, seconds)


def minatar_by_gymnasium(game, seconds):
    from minatar.gym import register_envs

    name = f"MinAtar/{game.capitalize()}-v1"
    if name not in gymnasium.registry:
        register_envs()
    return steps_per_second_of_one(gymnasium.make(name, sticky_action_prob=0.25), seconds)


def gymnax(game, seconds, scanned):
    import gymnax
    import jax

    env, params = gymnax.make(f"{game.capitalize()}-MinAtar")
    keys = jax.random.split(jax.random.key(0), NUM_ENVS)
    _, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    num_actions = env.action_space(params).n
    stepped = jax.vmap(env.step, in_axes=(0, 0, 0, None))
    if not scanned:
        step = jax.jit(stepped)
        actions = jax.random.randint(jax.random.key(1), (64, NUM_ENVS), 0, num_actions)
        keys = [jax.random.split(jax.random.key(i), NUM_ENVS) for i in range(64)]
        now = [state]

        def one(k):
            observation, now[0], *_ = step(keys[k % 64], now[0], actions[k % 64], params)
            observation.block_until_ready()

        one(0)
        return _rate(one, seconds) * NUM_ENVS

    @jax.jit
    def many(key, state):
        def body(carry, _):
            key, state, total = carry
            key, first, second = jax.random.split(key, 3)
            actions = jax.random.randint(first, (NUM_ENVS,), 0, num_actions)
            observation, state, *_ = stepped(jax.random.split(second, NUM_ENVS), state, actions, params)
            return (key, state, total + observation.sum()), None

        return jax.lax.scan(body, (key, state, 0.0), None, length=64)[0]

    now = [(jax.random.key(2), state)]

    def round_(_):
        key, state, total = many(*now[0])
        total.block_until_ready()
        now[0] = (key, state)

    round_(0)
    return _rate(round_, seconds) * NUM_ENVS * 64


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0, help="measured for each row")
    seconds = parser.parse_args().seconds
    there = {name: importlib.util.find_spec(name) is not None for name in ("envpool", "minatar", "gymnax")}
    print("left out, as not installed: " + (", ".join(name for name, found in there.items() if not found) or "none"))
    lake = pharos.make("frozen_lake")
    rows = [
        ("frozen_lake, rules", steps_per_second_of_vector(make_vec(lake, NUM_ENVS), seconds)),
        (
            "frozen_lake, its table, index",
            steps_per_second_of_vector(
                make_vec(lake, NUM_ENVS, space=pharos.build(lake), observation="index"), seconds
            ),
        ),
    ]
    peers = [("EnvPool's FrozenLake, 2 threads", envpool_frozen_lake(seconds))] if there["envpool"] else []
    show(f"FrozenLake, {NUM_ENVS} environments", rows, peers)
    for game, parameters in GAMES.items():
        vec = make_vec(game, NUM_ENVS, observation="simple_image", sticky=0.25, **parameters)
        rows = [(f"{game}, simple_image", steps_per_second_of_vector(vec, seconds))]
        peers = []
        if there["gymnax"]:
            peers = [
                ("gymnax, called for each step", gymnax(game, seconds, False)),
                ("gymnax, 64 steps in one call", gymnax(game, seconds, True)),
            ]
        show(f"{game} with images, {NUM_ENVS} environments", rows, peers)
        one = gymnasium.make(f"pharos/{game.capitalize()}-v0", observation="simple_image", sticky=0.25, **parameters)
        rows = [(f"{game}, simple_image", steps_per_second_of_one(one, seconds))]
        rows.append((f"{game}, without Gymnasium's wrappers", steps_per_second_of_one(one.unwrapped, seconds)))
        peers = []
        if there["minatar"]:
            peers = [
                ("MinAtar by gymnasium.make", minatar_by_gymnasium(game, seconds)),
                ("MinAtar without Gymnasium", minatar(game, seconds)),
            ]
        show(f"{game} with images, one environment", rows, peers)


def show(title, rows, peers):
    print(title)
    for label, rate in rows:
        ratios = ", ".join(f"{rate / other:.1f} x {name}" for name, other in peers)
        print(f"  {label:32} {rate / 1e3:10.1f} k steps/s   {ratios}")
    for label, rate in peers:
        print(f"  {label:32} {rate / 1e3:10.1f} k steps/s")


if __name__ == "__main__":
    main()
