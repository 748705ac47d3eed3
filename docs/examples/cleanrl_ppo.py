"""PPO in CleanRL's style on the Pharos Benchmark: one file, PyTorch, four environments that share the budget.

    pharos benchmark run --agent docs/examples/cleanrl_ppo.py:learn --out results/cleanrl_ppo

Written for pharos after the structure of a single-file PPO: rollouts, generalised advantage estimation, clipped
updates. What the benchmark asks for are the lines that end in `# pharos`.
"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Categorical


@dataclass
class Args:
    num_envs: int = 4
    num_steps: int = 128  # of each environment in a rollout
    learning_rate: float = 1e-3  # annealed to 0
    gamma: float = 0.99
    gae_lambda: float = 0.95
    num_minibatches: int = 4
    update_epochs: int = 4
    clip_coef: float = 0.2
    ent_coef: float = 0.01
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5


def layer(width, height, gain=2**0.5):
    linear = nn.Linear(width, height)
    nn.init.orthogonal_(linear.weight, gain)
    nn.init.zeros_(linear.bias)
    return linear


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        space = envs.single_observation_space
        width, actions = int(np.prod(space.shape)), int(envs.single_action_space.n)
        self.high = 255 if space.dtype == np.uint8 else 1  # pharos: some tasks show images
        self.actor = nn.Sequential(layer(width, 64), nn.Tanh(), layer(64, 64), nn.Tanh(), layer(64, actions, 0.01))
        self.critic = nn.Sequential(layer(width, 64), nn.Tanh(), layer(64, 64), nn.Tanh(), layer(64, 1, 1.0))

    def forward(self, observations):
        x = torch.as_tensor(np.asarray(observations), dtype=torch.float32).flatten(1) / self.high
        return Categorical(logits=self.actor(x)), self.critic(x)[:, 0]


def advantages_of(rewards, values, dones, next_value, args):
    advantages, last = torch.zeros_like(rewards), torch.zeros(args.num_envs)
    for t in reversed(range(args.num_steps)):
        after = next_value if t == args.num_steps - 1 else values[t + 1]
        delta = rewards[t] + args.gamma * after * (1 - dones[t]) - values[t]
        advantages[t] = last = delta + args.gamma * args.gae_lambda * (1 - dones[t]) * last
    return advantages


def learn(env, steps, seed):  # pharos: in place of a script
    args = Args()
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    envs = gym.vector.SyncVectorEnv(
        [env.copy] * args.num_envs,  # pharos: copies count against the same budget; `lambda: env` four times is one
        autoreset_mode=gym.vector.AutoresetMode.SAME_STEP,
    )
    agent = Agent(envs)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)
    batch = args.num_envs * args.num_steps
    shape = (args.num_steps, args.num_envs)

    @torch.no_grad()
    def policy(observations):  # pharos: probabilities of all states at once
        return agent(observations)[0].probs.numpy()

    observation, _ = envs.reset(seed=seed)
    updates = steps // batch
    for update in range(updates + 1):  # pharos: the last one is ended by the budget
        optimizer.param_groups[0]["lr"] = args.learning_rate * max(0.0, 1 - update / updates)
        observations, actions, logprobs = [], torch.zeros(shape, dtype=torch.long), torch.zeros(shape)
        rewards, dones, values = torch.zeros(shape), torch.zeros(shape), torch.zeros(shape)
        for t in range(args.num_steps):
            observations.append(observation)
            with torch.no_grad():
                distribution, values[t] = agent(observation)
                actions[t] = distribution.sample()
                logprobs[t] = distribution.log_prob(actions[t])
            observation, reward, terminated, truncated, info = envs.step(actions[t].numpy())
            ended = terminated | truncated
            rewards[t], dones[t] = torch.as_tensor(reward), torch.as_tensor(ended)
            if truncated.any():  # the episode would have gone on: its last state has a value
                with torch.no_grad():
                    final = np.stack([info["final_obs"][k] if ended[k] else observation[k] for k in range(len(ended))])
                    rewards[t] += args.gamma * agent(final)[1] * torch.as_tensor(truncated & ~terminated)
        with torch.no_grad():
            next_value = agent(observation)[1]
        advantages = advantages_of(rewards, values, dones, next_value, args)
        returns = (advantages + values).flatten()
        advantages, seen = advantages.flatten(), np.concatenate(observations)
        old_actions, old_logprobs = actions.flatten(), logprobs.flatten()
        for _ in range(args.update_epochs):
            for rows in np.split(rng.permutation(batch), args.num_minibatches):
                distribution, value = agent(seen[rows])
                ratio = (distribution.log_prob(old_actions[rows]) - old_logprobs[rows]).exp()
                advantage = (advantages[rows] - advantages[rows].mean()) / (advantages[rows].std() + 1e-8)
                clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
                policy_loss = -torch.min(ratio * advantage, clipped * advantage).mean()
                value_loss = 0.5 * (value - returns[rows]).pow(2).mean()
                loss = policy_loss + args.vf_coef * value_loss - args.ent_coef * distribution.entropy().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()
        yield policy  # pharos
