"""Train rejax' DQN on a table of pharos in JAX, many seeds at once, and evaluate each policy exactly.

pip install 'pharos-rl[jax]' rejax
python docs/examples/rejax_dqn.py
"""

import jax
import numpy as np
from rejax import get_algo

import pharos

INSTANCE, SEEDS, STEPS = "frozen_lake/4x4", 4, 50_000

space = pharos.build(INSTANCE, progress=False)
mdp = space.mdp(gamma=1.0).with_horizon(space.environment.max_episode_steps)
env = pharos.to_gymnax(mdp, "one_hot", joined_ends=True)  # rejax 0.1 wants one `done`
agent = get_algo("dqn").create(
    env=env,
    env_params=env.default_params,
    total_timesteps=STEPS,
    eval_freq=STEPS,
    skip_initial_evaluation=True,
    num_envs=4,
    buffer_size=20_000,
    fill_buffer=1_000,
    batch_size=64,
    learning_rate=0.001,
    gamma=0.95,
    target_update_freq=500,
    polyak=0.0,
    exploration_fraction=0.5,
)
agent = agent.replace(eval_callback=lambda *_: ())  # pharos evaluates, exactly
states, _ = jax.jit(jax.vmap(agent.train))(jax.random.split(jax.random.PRNGKey(0), SEEDS))

best, uniform = pharos.value_iteration(mdp).value_at_start, pharos.solvers.uniform_value(mdp).value_at_start
everything = env.default_params.observations[:-1]
for seed in range(SEEDS):
    parameters = jax.tree.map(lambda leaf, seed=seed: leaf[seed], states.q_ts.params)
    policy = np.asarray(agent.agent.apply(parameters, everything).argmax(axis=1))
    value = pharos.evaluate_policy(mdp, policy).value_at_start
    print(f"seed {seed}: V = {value:.4f}, V* = {best:.4f}, normalised regret {(best - value) / (best - uniform):.4f}")
