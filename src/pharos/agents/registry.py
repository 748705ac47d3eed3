"""The agents that have a name: a line for each. Any other is named by its code, `module:Name`."""

from pharos.agents.a2c import A2C
from pharos.agents.agent import Agent, agents, register
from pharos.agents.dqn import DQN
from pharos.agents.own import OwnAgent
from pharos.agents.ppo import PPO
from pharos.agents.q_learning import Q_LEARNING
from pharos.agents.sb3 import DeepAgent, is_known

register(Q_LEARNING)
register(DQN)
register(PPO)
register(A2C)


def agent_called(name: str) -> Agent:
    """The agent of a name; any other name belongs to a class or function, of a library or the user's own."""
    kind = DeepAgent if is_known(name) else OwnAgent
    return agents().get(name) or kind(name=name, title=name.rpartition(":")[2], path=name)


def primary_predictors() -> dict[str, str]:
    """Name of each agent that can be predicted -> the column that stands for it in predictions."""
    return {name: each.idealised.predictor for name, each in agents().items() if each.idealised.predictor}
