"""CleanRL's DQN on the Pharos Benchmark: ten lines differ, those that end in `# pharos`.

    pharos benchmark run --agent docs/examples/cleanrl_dqn.py:learn --out results/cleanrl_dqn

After the structure of cleanrl/dqn.py (https://github.com/vwxyzjn/cleanrl, MIT licence, Copyright (c) 2019 CleanRL
developers), without logs, videos, command line and GPU. What was a script is a generator here: the environment is
given, counts its steps, and ends the training by an exception; each policy that is yielded is asked about all states.
"""

import random
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import torch.nn.functional as F
from stable_baselines3.common.buffers import ReplayBuffer
from torch import nn, optim


@dataclass
class Args:
    seed: int = 1
    torch_deterministic: bool = True
    total_timesteps: int = 500000
    learning_rate: float = 1e-3  # pharos: CleanRL's 2.5e-4 is for half a million steps
    num_envs: int = 1
    buffer_size: int = 10000
    gamma: float = 0.99
    tau: float = 1.0
    target_network_frequency: int = 500
    batch_size: int = 128
    start_e: float = 1.0
    end_e: float = 0.05
    exploration_fraction: float = 0.5
    learning_starts: int = 1000  # pharos: 10,000 there, a third of the steps here
    train_frequency: int = 10


class QNetwork(nn.Module):
    def __init__(self, env):
        super().__init__()
        self.high = 255 if env.single_observation_space.dtype == np.uint8 else 1  # pharos: some tasks show images
        self.network = nn.Sequential(
            nn.Linear(int(np.prod(env.single_observation_space.shape)), 120),
            nn.ReLU(),
            nn.Linear(120, 84),
            nn.ReLU(),
            nn.Linear(84, env.single_action_space.n),
        )

    def forward(self, x):
        return self.network(x.flatten(1).float() / self.high)  # pharos


def linear_schedule(start_e, end_e, duration, t):
    return max((end_e - start_e) / duration * t + start_e, end_e)


def learn(env, steps, seed):  # pharos: in place of `if __name__ == "__main__"`
    args = Args(seed=seed, total_timesteps=steps)  # pharos: in place of tyro.cli(Args)

    random.seed(args.seed)
    np.random.seed(args.seed)
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    device = torch.device("cpu")

    envs = gym.vector.SyncVectorEnv([lambda: env], autoreset_mode=gym.vector.AutoresetMode.SAME_STEP)  # pharos

    q_network = QNetwork(envs).to(device)
    optimizer = optim.Adam(q_network.parameters(), lr=args.learning_rate)
    target_network = QNetwork(envs).to(device)
    target_network.load_state_dict(q_network.state_dict())

    spaces = envs.single_observation_space, envs.single_action_space
    rb = ReplayBuffer(args.buffer_size, *spaces, device, handle_timeout_termination=False)

    obs, _ = envs.reset(seed=args.seed)
    for global_step in range(args.total_timesteps):
        epsilon = linear_schedule(
            args.start_e, args.end_e, args.exploration_fraction * args.total_timesteps, global_step
        )
        if random.random() < epsilon:
            actions = np.array([envs.single_action_space.sample() for _ in range(envs.num_envs)])
        else:
            actions = torch.argmax(q_network(torch.Tensor(obs).to(device)), dim=1).cpu().numpy()

        next_obs, rewards, terminations, truncations, infos = envs.step(actions)
        real_next_obs = next_obs.copy()
        for idx, trunc in enumerate(truncations):
            if trunc:
                real_next_obs[idx] = infos["final_obs"][idx]  # pharos: Gymnasium's name of final_observation since 1.1
        rb.add(obs, real_next_obs, actions, rewards, terminations, infos)
        obs = next_obs

        if global_step > args.learning_starts and global_step % args.train_frequency == 0:
            data = rb.sample(args.batch_size)
            with torch.no_grad():
                target_max, _ = target_network(data.next_observations).max(dim=1)
                td_target = data.rewards.flatten() + args.gamma * target_max * (1 - data.dones.flatten())
            old_val = q_network(data.observations).gather(1, data.actions).squeeze()
            loss = F.mse_loss(td_target, old_val)

            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

        if global_step > args.learning_starts and global_step % args.target_network_frequency == 0:
            for target_param, param in zip(target_network.parameters(), q_network.parameters(), strict=True):
                target_param.data.copy_(args.tau * param.data + (1.0 - args.tau) * target_param.data)

        if (global_step + 1) % (args.total_timesteps // 15) == 0:  # pharos: as often as it is evaluated
            yield lambda seen: q_network(torch.Tensor(seen)).argmax(dim=1).numpy()  # pharos
