"""What a state space needs to know of an environment."""

import json
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pharos.environments import Environment, State, start_distribution
from pharos.rules import Layout, fingerprint_of_rules, layout_of
from pharos.state_space.manifest import FORMAT_VERSION, OUTCOMES_VERSION


@dataclass(frozen=True)
class Plan:
    """What a state space needs to know of an environment, each computed once.

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
        env, layout = self.env, self.layout
        return {
            "environment": env.name,
            "class": f"{_module_of(type(env))}:{type(env).__qualname__}",
            "rules_version": env.version,
            "parameters": json.loads(json.dumps(env.parameters)),
            "actions": list(env.actions),
            **({"outcomes": int(env.outcomes)} if env.has_chance else {}),
            "layout": {
                "names": list(env.components.names),
                "low": env.components.low.tolist(),
                "size": env.components.size.tolist(),
                "bits": [int(mask).bit_length() for mask in layout.mask],
                "word": layout.word.tolist(),
                "shift": layout.shift.tolist(),
                "num_words": layout.num_words,
            },
            "start": [[list(state), float(p)] for state, p in zip(*self.starts, strict=True)],
        }

    @cached_property
    def branches(self) -> int:
        """How many successors a state may have: the number of actions, times that of outcomes."""
        return self.env.num_actions * int(self.env.outcomes)

    @property
    def format_version(self) -> int:
        """Of the folder."""
        return OUTCOMES_VERSION if self.env.has_chance else FORMAT_VERSION

    @cached_property
    def fingerprint(self) -> str:
        chance = ("probability",) * self.env.has_chance
        return fingerprint_of_rules(self.env, ("transition", "is_terminal", *chance))


def _module_of(cls: type) -> str:
    """The module of a class, as manifests name it: built-in classes without the folder of their file."""
    return re.sub(r"^(pharos\.environments)\.(worlds|mini_grid)\b", r"\1", cls.__module__)
