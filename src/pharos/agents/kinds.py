"""What each agent is: tabular or a network, and how figures call it."""

from dataclasses import dataclass
from pathlib import Path

from pharos.errors import ParameterError
from pharos.system.sources import Source, find, is_reference, load

TABULAR_OBSERVATION = "index"
"""What tabular agents see."""


@dataclass(frozen=True)
class AgentKind:
    """What the rest of pharos needs to know of an agent before it exists.

    Attributes:
        name: as `train` takes it.
        title: as figures and tables write it.
        is_tabular: whether it learns a table over the states, whose index it sees; else a network over observations.
    """

    name: str
    title: str
    is_tabular: bool = False

    def observation(self, requested: str) -> str:
        """The observation that it gets where `requested` was asked for: tables see the index of the state."""
        return TABULAR_OBSERVATION if self.is_tabular else requested


AGENTS = {
    kind.name: kind
    for kind in (
        AgentKind("q_learning", "tabular Q-learning", is_tabular=True),
        AgentKind("dqn", "DQN"),
        AgentKind("ppo", "PPO"),
        AgentKind("a2c", "A2C"),
    )
}
"""The agents that have a name. Any other algorithm for Stable-Baselines3 is named by its class, `module:Class`."""


BATCHED = ("dqn", "ppo")
"""The networks that the batched engine trains, many runs as one program."""


def agent_kind(name: str) -> AgentKind:
    """What the agent called `name` is; a class of an algorithm for Stable-Baselines3 is a network."""
    return AGENTS.get(name) or AgentKind(name, name.rpartition(":")[2])


LIBRARIES = ("stable_baselines3", "sb3_contrib")
"""Their algorithms are known by name: they need no trust, and no source in the configuration of a run."""


def is_known(name: str) -> bool:
    """Whether an agent comes with pharos or with one of LIBRARIES, so that it is not code of the user's own."""
    return not is_reference(name) or name.partition(":")[0].split(".")[0] in LIBRARIES


def agent_source(name: str, folder: str | Path | None = None, *, check: bool = True) -> Source | None:
    """Where an agent of the user's own is; None for all others.

    Args:
        folder: relative files and modules are looked for there first; None: in the current directory.
        check: whether it is imported, to see that it is a class.
    Raises:
        ParameterError: it cannot be imported, or is no class.
    """
    if is_known(name):
        return None
    source = find(name, folder)
    if check and not isinstance(load(source), type):
        raise ParameterError(
            f"{name!r}: found {load(source)!r}; expected the class of an algorithm for Stable-Baselines3"
        )
    return source
