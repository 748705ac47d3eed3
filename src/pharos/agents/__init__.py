"""Agents: tabular Q-learning, and algorithms of Stable-Baselines3, one by one or batched. `pharos.training.train`
trains them on a task.
"""

from pharos.agents import batched
from pharos.agents.agent import (
    NETWORK,
    POLICY,
    TABULAR_OBSERVATION,
    WORLD,
    Learner,
    RunShape,
    agents,
    joined_states,
    learner_state,
)
from pharos.agents.hyperparameters import hyperparameters
from pharos.agents.idealised import (
    POLICY_CURVES,
    POLICY_PREDICTORS,
    SAMPLED_PREDICTORS,
    Idealised,
    curve_points,
)
from pharos.agents.own import (
    CLASS,
    COMPILED,
    GENERATOR,
    agent_name,
    agent_source,
    check_keywords,
    form_of,
    generator_of,
    register_form,
)
from pharos.agents.q_learning import QLearning
from pharos.agents.registry import agent_called, primary_predictors
from pharos.agents.sb3 import (
    AGENT_LIBRARIES,
    algorithm,
    check_hyperparameters,
    extractor_class,
    is_known,
    make_model,
)

__all__ = [
    "QLearning",
    "hyperparameters",
]
