"""A policy that one can read: the states in which it acts, and its actions, by their names."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pharos.cli.answers import Answer, print_facts
from pharos.system.wording import capped, pluralize

if TYPE_CHECKING:
    import numpy as np

    from pharos.mdp import TabularMDP


@dataclass(frozen=True)
class PolicyRows:
    """The first rows of a policy, in the order in which the policy gets to the states.

    Attributes:
        rows: of each `state` its number, `variables`, `labels`, `previous` action under sticky actions, `action` and
            its `name`.
        left_out: states, under sticky actions pairs of a state and the previous action, beyond the first rows.
        title: of which policy they are.
    """

    rows: list[dict[str, Any]]
    left_out: int
    title: str

    @property
    def keys(self) -> dict[str, Any]:
        """Entries of the JSON object."""
        return {"policy_rows": self.rows, "policy_left_out": self.left_out}

    def lines(self) -> list[str]:
        """One line a state, and one about what is left out."""
        texts = [
            " ".join(filter(None, (f"{row['state']}", _after(row), _state(row), f"-> {row['name']}")))
            for row in self.rows
        ]
        rest = f"{pluralize(self.left_out, 'more state')} left out; --policy-rows N prints more"
        return [self.title, *(f"  {text}" for text in texts), *([f"  {rest}"] if self.left_out else [])]


def _after(row: dict[str, Any]) -> str:
    return f"after {row['previous']}" if row.get("previous") is not None else ""


def _state(row: dict[str, Any]) -> str:
    words = " ".join(f"{name}={str(value).lower()}" for name, value in row["variables"].items())
    return capped(" ".join(filter(None, (words, f"[{', '.join(row['labels'])}]" if row["labels"] else ""))), 160)


def readable_policy(mdp: "TabularMDP", policy: "np.ndarray", most: int, title: str = "policy") -> PolicyRows:
    """The actions of a policy in states that it may reach, without terminal states, at most so many rows.

    Args:
        policy: (S,) actions, or (S, A + 1) by the previous action. With a horizon, it is the policy of the first step,
            and rows are states that any actions may reach.
    """
    import numpy as np

    from pharos.mdp import names_of

    nodes = _visited(mdp, policy)
    states, previous = nodes[:most, 0], nodes[:most, 1]
    names = names_of(mdp)
    part = names.of(states)
    actions = policy[states] if policy.ndim == 1 else policy[states, previous]
    rows = []
    for i, (state, action) in enumerate(zip(states.tolist(), actions.tolist(), strict=True)):
        row: dict[str, Any] = {
            "state": state,
            "variables": {name: np.asarray(column)[i].item() for name, column in part.variables.items()},
            "labels": part.labels_of(i),
            "action": action,
            "name": part.action(i, action),
        }
        if mdp.is_sticky:
            before = int(previous[i])
            row["previous"] = None if before == mdp.num_actions else _name_of_previous(names.actions, before)
        rows.append(row)
    title = title if mdp.horizon is None else f"{title}, of the first of {mdp.horizon:,} steps"
    return PolicyRows(rows, len(nodes) - len(rows), title)


def _name_of_previous(actions: tuple[str, ...] | None, action: int) -> str:
    return str(action) if actions is None else actions[action]


def _visited(mdp: "TabularMDP", policy: "np.ndarray") -> "np.ndarray":
    """(N, 2) pairs of a state and the previous action (A: none, or it does not matter), breadth first."""
    import numpy as np

    none, width = mdp.num_actions, mdp.num_actions + 1
    terminal = np.append(np.asarray(mdp.terminal), True)
    is_new = np.ones((mdp.num_states + 1) * (width if mdp.is_sticky else 1), np.bool_)

    def index_of(states: "np.ndarray", previous: "np.ndarray") -> "np.ndarray":
        return states * width + previous if mdp.is_sticky else states

    frontier = np.stack([mdp.starts, np.full(len(mdp.starts), none)], axis=1)
    levels = []
    while True:
        frontier = frontier[~terminal[frontier[:, 0]]]
        indices = index_of(frontier[:, 0], frontier[:, 1])
        _, first = np.unique(indices, return_index=True)
        first = np.sort(first[is_new[indices[first]]])
        frontier = frontier[first]
        if not len(frontier):
            break
        is_new[indices[first]] = False
        levels.append(frontier)
        states, previous = frontier.T
        actions = policy[states] if policy.ndim == 1 else policy[states, previous]
        choices = np.eye(none)[actions]
        if mdp.horizon is not None:
            choices = np.ones_like(choices) if mdp.available is None else mdp.available[states].astype(np.float64)
        node, action = np.nonzero(mdp.chance.at(states).weights(choices, previous))
        outcomes = mdp.dynamics.outcomes(states[node], action)
        possible = outcomes.probabilities > 0
        after = action[outcomes.which[possible]] if mdp.is_sticky else np.full(int(possible.sum()), none)
        frontier = np.stack([outcomes.states[possible], after], axis=1)
    return np.concatenate(levels) if levels else np.empty((0, 2), np.int64)


def with_policy(answer: Answer, rows: PolicyRows) -> Answer:
    """The answer with a policy below its table, and in its JSON object."""
    facts: Any = answer.text

    def say() -> None:
        print_facts(*facts)
        print("\n".join(rows.lines()))

    return Answer({**answer.json, **rows.keys}, say)
