"""rejax' DQN on the benchmark: all seeds of a task are one program.

pip install 'pharos-rl[jax]' rejax
pharos benchmark run --agent docs/examples/rejax_agent.py:learn --tasks core --out results/rejax-dqn
"""

from rejax import get_algo


def learn(env, params, steps, key):
    """The network after each fifteenth of the steps."""
    agent = get_algo("dqn").create(
        env=env.joined_ends(),  # rejax 0.1 wants one `done`
        env_params=params,
        total_timesteps=steps,
        eval_freq=steps // 15,
        skip_initial_evaluation=True,
        num_envs=1,
        buffer_size=20_000,
        fill_buffer=1_000,
        batch_size=64,
        learning_rate=0.0005,
        gamma=0.99,
        target_update_freq=500,
        polyak=0.0,
        exploration_fraction=0.1,
    )
    agent = agent.replace(eval_callback=lambda agent, state, key: state.q_ts.params)
    _, snapshots = agent.train(key)
    return lambda parameters, observations: agent.agent.apply(parameters, observations).argmax(axis=1), snapshots
