"""Aliasing: states that share an observation with other states, so that the agent cannot tell them apart."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Aliasing:
    """Number of reachable states that share their observation with another state.

    Attributes:
        num_states: reachable states, terminal ones included.
        num_observations: different observations among them.
        num_sharing: states whose observation another state has as well. Terminal states count like others.
        num_confused: states in which the agent acts, that is, not terminal, whose observation another such state has as
            well. 0: for one who acts the observation tells the state, so it is Markov.
    """

    num_states: int
    num_observations: int
    num_sharing: int
    num_confused: int

    @property
    def share(self) -> float:
        """The share of states that have their observation in common with others. 0 if the observation tells the
        state."""
        return self.num_sharing / self.num_states


def aliasing_of_classes(classes: np.ndarray, terminal: np.ndarray) -> Aliasing:
    """Count the states that share an observation, from numbers of observations (S,). terminal: (S,) bool."""
    counts = np.bincount(classes)
    alive = np.bincount(classes[~terminal])
    return Aliasing(len(classes), len(counts), int(counts[counts > 1].sum()), int(alive[alive > 1].sum()))
