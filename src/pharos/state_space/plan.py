"""What a build needs to know of an environment."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pharos.environments import Environment, State, start_distribution
from pharos.rules import Layout, fingerprint_of_rules, layout_of
from pharos.state_space.manifest import identity_of


@dataclass(frozen=True)
class Plan:
    """What a build needs to know of an environment, each computed once.

    Attributes:
        env: the environment.
        layout: where its components sit in packed states.
        starts: its start states and their probabilities.
        identity: what makes a state space its state space: kept in the manifest and hashed into the cache's folder
            names.
        fingerprint: of its rules.
    """

    env: Environment

    @cached_property
    def layout(self) -> Layout:
        return layout_of(self.env.components)

    @cached_property
    def starts(self) -> tuple[list[State], np.ndarray]:
        return start_distribution(self.env)

    @cached_property
    def identity(self) -> dict[str, Any]:
        return identity_of(self.env, self.layout, self.starts)

    @cached_property
    def fingerprint(self) -> str:
        return fingerprint_of_rules(self.env, ("transition", "is_terminal"))
