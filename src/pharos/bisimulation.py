"""The public name of `pharos.mdp.bisimulation`."""

from pharos.mdp.bisimulation import Minimization, minimize

__all__ = ["Minimization", "minimize"]
