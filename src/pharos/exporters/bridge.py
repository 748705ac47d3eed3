"""The form of the BRIDGE dataset: transitions and rewards, row 0 the start, -1 the end."""

import os
from pathlib import Path

import numpy as np

from pharos.errors import ParameterError
from pharos.mdp import TabularMDP, require_mdp
from pharos.system import storage


@require_mdp
def bridge(mdp: TabularMDP, path: str | os.PathLike) -> Path:
    """Write an MDP as BRIDGE does: npz with `transitions` int64 (S, A) and `rewards` float32 (S, A).

    States keep their numbers, unless the start is not 0: it then changes places with 0. Transitions into terminal
    states become -1.

    Raises:
        ParameterError: the MDP has chance or several start states, which the form cannot say; or the name does not end
            in .npz.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise ParameterError(f"{path}: expected a name that ends in .npz")
    if not mdp.is_deterministic or len(mdp.start_states) != 1:
        raise ParameterError(f"{mdp}: BRIDGE's files hold deterministic MDPs with one start state; expected such a one")
    table = np.array(mdp.dynamics.deterministic_table(), np.int64)
    inside = table >= 0
    table[inside & np.asarray(mdp.terminal)[table]] = -1
    order = np.arange(len(table))
    start = int(mdp.start_states[0])
    order[[0, start]] = order[[start, 0]]
    table = np.where(table[order] >= 0, order[table[order]], -1)
    rewards = mdp.rewards[order].astype(np.float32)
    with storage.replacing(path) as file:
        np.savez_compressed(file, transitions=np.asfortranarray(table), rewards=rewards)
    return path
