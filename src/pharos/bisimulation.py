"""The public name of what merges states: `pharos.bisimulation.minimize(mdp)`."""

from pharos.mdp import Minimization, minimize

__all__ = ["Minimization", "minimize"]
