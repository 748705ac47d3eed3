"""The built-in worlds: a file for each class, with its rules, its look and its named instances.

Hyperparameters that suit several classes are here. Hyperparameters of a single class are in its file.
"""

from typing import Any

# Games of millions of states and runs of 600 thousand steps.
ARCADE: dict[str, dict[str, dict[str, Any]]] = {
    "q_learning": {"default": {"initial_q": 0.0}},
    "dqn": {
        "default": {
            "buffer_size": 100000,
            "learning_rate": 0.00025,
            "learning_starts": 5000,
            "target_update_interval": 1000,
            "exploration_fraction": 0.1,
            "exploration_final_eps": 0.02,
            "batch_size": 32,
        },
        "complex_image": {"buffer_size": 20000},
    },
}
