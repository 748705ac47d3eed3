"""Agents: tabular Q-learning, and algorithms of Stable-Baselines3, one by one or batched. `pharos.training.train`
trains them on a task.
"""

from pharos.agents import batched
from pharos.agents.agent import (
    AGENT_LIBRARIES,
    NETWORK,
    POLICY,
    TABULAR_OBSERVATION,
    WORLD,
    Learner,
    RunShape,
    agents,
    is_known,
    joined_states,
    learner_state,
    read_policy_table,
)
from pharos.agents.idealised import (
    HUBER_PREDICTORS,
    LAYER_OPTIONS,
    NETWORK_CURVE,
    NETWORK_POLICY_PREDICTORS,
    NETWORK_PREDICTORS,
    POLICY_CURVES,
    POLICY_PREDICTORS,
    SAMPLED_PREDICTORS,
    Idealised,
    curve_points,
)
from pharos.agents.q_learning import QLearning
from pharos.agents.registry import (
    CLASS,
    COMPILED,
    GENERATOR,
    agent_called,
    agent_name,
    agent_source,
    check_keywords,
    form_of,
    generator_of,
    hyperparameters,
    primary_predictors,
    register_form,
)
from pharos.agents.sb3 import (
    algorithm,
    check_hyperparameters,
    check_ranges,
    extractor_class,
    make_model,
)

__all__ = [
    "QLearning",
    "hyperparameters",
]
