"""Data of a page about an MDP: states with their values, gaps and successors, paths, layers, maps.

Answers are plain dictionaries, ready for JSON. Numbers that JSON cannot say are None. A position is a state and, under
sticky actions, the action executed before. There is none before the first step.

How often policies are in states, and what they lose there.

The drawing of a state for a page: what is in which cell, and once for all how each thing looks.

A page composes the drawing itself, so a state costs some numbers, not a picture. It looks as `drawing.human` draws it.
"""

import base64
import io
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from pharos.drawing import empty_grid, fitting_cell, image, planes_of, tile
from pharos.environments import Environment, State
from pharos.errors import ParameterError
from pharos.explorer.keys import keys_of
from pharos.explorer.states import (
    LEARNT,
    OPTIMAL,
    UNIFORM,
    Learnt,
    NamedStates,
    NumberedStates,
    SpaceStates,
    StateLayers,
    States,
    probabilities,
)
from pharos.hardness import ERRORS_PER_TIE, discounted_visits, occupancy
from pharos.mdp import TabularMDP, names_of, uniform_choice
from pharos.observations import num_values
from pharos.policies import state_losses
from pharos.solvers import Solution, uniform_value, value_iteration
from pharos.state_space import StateSpace


class DiscountedVisits:
    """Discounted visits of states by policies, from the start: d(s) = sum over t of gamma^t P(s_t = s)."""

    def __init__(self, exploration: "Exploration"):
        self.exploration, self._known = exploration, dict[str, np.ndarray]()

    def pairs(self, policy: str) -> np.ndarray:
        """(S, A) visits of a state in which the policy chooses an action."""
        mdp = self.exploration.mdp
        table = self._table(policy)
        if mdp.is_sticky:
            return occupancy(mdp, table).visits
        visits = self.of(policy)
        if table is None:
            return visits[:, None] * uniform_choice(mdp)
        return visits[:, None] * (np.eye(mdp.num_actions)[table] if table.ndim == 1 else table)

    def of(self, policy: str) -> np.ndarray:
        """(S,) visits of states, kept for the next time."""
        if policy not in self._known:
            self._known[policy] = discounted_visits(self.exploration.mdp, self._table(policy))[0]
        return self._known[policy]

    def losses(self, policy: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(S,) each: loss in each state (`policies.state_losses`), discounted visits, action chosen most often."""
        world, pairs, first = self.exploration, self.pairs(policy), None
        if world.mdp.is_sticky:
            starts = world.mdp.start_states
            first = world.chances(policy, starts, world.chosen_values(OPTIMAL, starts))
        return state_losses(world.solutions[OPTIMAL], pairs, first), pairs.sum(axis=1), pairs.argmax(axis=1)

    def _table(self, policy: str) -> np.ndarray | None:
        """The policy as solvers take it, or None for the uniform one. Uniform in states in which it was not asked."""
        if policy == UNIFORM:
            return None
        table = np.asarray(self.exploration.solutions[policy].policy)
        if table.dtype.kind != "f" or not np.isnan(table).any():
            return table
        return np.where(np.isnan(table), uniform_choice(self.exploration.mdp), table)


LONGEST_PATH = 2_000  # steps that are shown
MOST_LISTED_STARTS = 100  # start states that are listed
LISTED = 48  # states of a layer that are listed at a time
MOST_WORST_STATES = 24  # states that are listed where a policy goes wrong


class Exploration:
    """A solved MDP without a horizon, and the meaning of its states.

    Args:
        mdp: with its chance. A horizon is left out: values are discounted.
        env: draws the states and names the actions, if it is known.
        space: gives the values of their variables, if there is one.
        learnt: a policy to set beside the optimal and the uniform one.
        title: for people.
        progress: called with what is done next.
    Raises:
        DivergenceError: gamma is 1, and the value is infinite. ParameterError: what was learnt does not fit.
    """

    def __init__(
        self,
        mdp: TabularMDP,
        *,
        env: Environment | None = None,
        space: StateSpace | None = None,
        learnt: Learnt | None = None,
        title: str = "",
        chance: str = "",
        progress: Callable[[str], object] = lambda text: None,
    ):
        self.mdp = mdp = mdp.with_horizon(None)
        self.env, self.space, self.learnt, self.chance = env, space, learnt, chance
        self.title = title or (env.name if env is not None else "MDP")
        self.names = names_of(mdp)
        self.actions = env.actions if env is not None else self.names.actions or tuple(map(str, range(mdp.num_actions)))
        self.states: States = _states_of(mdp, space)
        progress("optimal values")
        self.solutions: dict[str, Solution] = {OPTIMAL: value_iteration(mdp)}
        if learnt is not None:
            progress("values of what was learnt")
            self.solutions[LEARNT] = learnt.solution(mdp, space)
        progress("values of the uniform policy")
        self.solutions[UNIFORM] = uniform_value(mdp)
        self.tie_tolerance = max(1e-9, ERRORS_PER_TIE * self.solutions[OPTIMAL].error_bound)
        starts = mdp.starts
        self.pictures = Pictures(env, self._rules_state(int(starts[0])) if env is not None else None)

    @property
    def policies(self) -> list[str]:
        """The names of the policies that are compared."""
        return list(self.solutions)

    # Of all states --------------------------------------------------------------------------------------------------

    @cached_property
    def layers(self) -> StateLayers:
        """The breadth-first layers."""
        return StateLayers(self.mdp, is_numbered=self.space is not None)

    def values(self, name: str, states: np.ndarray) -> np.ndarray:
        """(N,) values of a policy in states without a previous action."""
        solution = self.solutions[name]
        if not self.mdp.is_sticky:
            return np.asarray(solution.x[states, 0])
        q = self.chosen_values(name, states)
        return (self.chances(name, states, q) * q).sum(axis=1) * ~self.mdp.terminal[states]

    def chosen_values(self, name: str, states: np.ndarray, previous: int | None = None) -> np.ndarray:
        """(N, A) values of choosing each action, and following a policy afterwards."""
        executed = self.solutions[name].q_of(states)
        return self.mdp.chance.at(states).chosen_values(executed, self._before(states, previous))

    def chances(self, name: str, states: np.ndarray, q: np.ndarray, previous: int | None = None) -> np.ndarray:
        """(N, A) how often a policy chooses each action. `q`: optimal values of choosing, for the optimal one."""
        if name == UNIFORM:
            return uniform_choice(self.mdp)[states]
        if name == LEARNT:
            return probabilities(self.solutions[LEARNT], states, self._before(states, previous))
        return np.eye(self.mdp.num_actions)[self.best_actions(q, states)]

    def best_actions(self, q: np.ndarray, states: np.ndarray) -> np.ndarray:
        """(N,) the first of the actions whose values (N, A) are within the tie tolerance of the best."""
        is_best = q >= q.max(axis=1, keepdims=True) - self.tie_tolerance
        return (is_best & self.available(states)).argmax(axis=1)

    def available(self, states: np.ndarray) -> np.ndarray:
        """(N, A) bool, the actions that are available in states."""
        sets = self.mdp.available
        return np.ones((len(states), self.mdp.num_actions), np.bool_) if sets is None else sets[states]

    def _before(self, states: np.ndarray, previous: int | None) -> np.ndarray:
        return np.full(len(states), self.mdp.num_actions if previous is None else previous)

    @cached_property
    def visits(self) -> DiscountedVisits:
        """Visits of states by policies."""
        return DiscountedVisits(self)

    # Of one state ---------------------------------------------------------------------------------------------------

    def position(self, state: int, previous: int | None = None) -> dict[str, Any]:
        """Data of one state.

        Args:
            state: its number.
            previous: the action executed before, under sticky actions. None: there was none.
        Returns:
            Entries of the position:

            - state, previous, values (of its variables), labels, terminal, layer
            - start: probability that an episode starts there
            - v: policy -> value
            - the drawing, as `Pictures.of` has it

            Of each action:

            - `name`: if actions have other names in other states, else None
            - `q` and `gap`: of choosing it
            - `available`: whether it is. `best`: whether the gap is a tie
            - `policies`: how often each policy chooses it
            - `q_of`: the value of choosing it, and following the policy afterwards, of each policy
            - `reward`: expected
            - `outcomes`: a list of state (None for the end), previous action, probability, reward
        Raises:
            ParameterError: there is no such state or action.
        """
        state, previous = self._checked(state, previous)
        variables = self._variables_of(state)
        here = np.array([state])
        is_over = bool(self.mdp.terminal[state])
        answer: dict[str, Any] = {
            "state": state,
            "previous": previous,
            "values": list(variables),
            "terminal": is_over,
            "layer": int(self.layers.of(here)[0]),
            "start": float(self.mdp.start_probabilities[self.mdp.start_states == state].sum()),
            "labels": self.names.labels_of(state),
            **self.pictures.of(self._rules_state(state)),
            "v": dict.fromkeys(self.solutions, 0.0),
            "actions": [],
        }
        if is_over:
            return answer
        q = {name: self.chosen_values(name, here, previous) for name in self.solutions}
        chances = {name: self.chances(name, here, q[OPTIMAL], previous)[0] for name in self.solutions}
        best = float(q[OPTIMAL].max())
        answer["v"] = {
            name: best if name == OPTIMAL else float_or_none(chances[name] @ q[name][0]) for name in self.solutions
        }
        sets = self.available(here)[0]
        for action, executed in enumerate(self._executed(state, previous)):
            gap = best - float(q[OPTIMAL][0, action])
            outcomes = self._outcomes(state, executed)
            answer["actions"].append(
                {
                    "q": best - gap,
                    "gap": gap,
                    "name": self.names.action(state, action) if self.names.choices is not None else None,
                    "available": bool(sets[action]),
                    "best": gap <= self.tie_tolerance and bool(sets[action]),
                    "policies": {name: float_or_none(chances[name][action]) for name in self.solutions},
                    "q_of": {name: float_or_none(q[name][0, action]) for name in self.solutions},
                    "reward": sum(probability * reward for _, _, probability, reward in outcomes),
                    "outcomes": outcomes,
                }
            )
        return answer

    def _executed(self, state: int, previous: int | None) -> np.ndarray:
        """(A, A) the probability that each action is executed in a state, of choosing each."""
        choices, here = np.eye(self.mdp.num_actions), np.full(self.mdp.num_actions, state)
        return self.mdp.chance.at(here).weights(choices, self._before(choices, previous))

    def _outcomes(self, state: int, executed: np.ndarray) -> list[list[Any]]:
        """(state, previous, probability, reward) of possible outcomes, likeliest first. executed: (A,) chances."""
        merged: dict[tuple[int | None, int | None, float], float] = {}
        for action in np.flatnonzero(executed).tolist():
            for after, probability, reward in self._of_executing(state, action):
                key = (after, action if self.mdp.is_sticky else None, reward)
                merged[key] = merged.get(key, 0.0) + float(executed[action]) * probability
        listed = [[after, previous, probability, reward] for (after, previous, reward), probability in merged.items()]
        return sorted(listed, key=lambda each: (-each[2], -1 if each[0] is None else each[0]))

    def _of_executing(self, state: int, action: int) -> list[tuple[int | None, float, float]]:
        """(state, probability, reward) of possible outcomes of executing an action.

        Each outcome has its reward if the rules are known. Otherwise, and with lazy actions, it has the mean.
        """
        env, mdp = self.env, self.mdp
        if env is not None and env.has_chance and not mdp.laziness:
            before, listed = self._rules_state(state), []
            for outcome in range(env.outcomes):
                if (probability := float(env.probability(before, action, outcome))) > 0:
                    next_state = env.next_state(before, action, outcome)
                    reward = float(env.reward_of(before, action, next_state, outcome))
                    after = self._number_of(next_state)
                    listed.append((after, probability, reward))
            return listed
        mean = float(mdp.reward_table.rows(np.array([state]))[0, action])
        outcomes = mdp.dynamics.outcomes(np.array([state]), np.array([action]))
        ends = mdp.num_states
        return [
            (None if after == ends else int(after), float(p), mean)
            for after, p in zip(outcomes.states, outcomes.probabilities, strict=True)
        ]

    def _variables_of(self, state: int) -> tuple[int, ...]:
        return tuple(self.states.values(np.array([state]))[0].tolist())

    def _rules_state(self, state: int) -> State:
        """A state as the rules of the environment take it."""
        return self._variables_of(state) if self.space is not None else (state,)

    def _number_of(self, state: State) -> int | None:
        """The number of a state of the environment. None: the end."""
        if self.space is not None:
            return self.states.number(state)
        return int(state[0]) if state[0] < self.mdp.num_states else None

    def _checked(self, state: int, previous: int | None) -> tuple[int, int | None]:
        if not 0 <= state < self.mdp.num_states:
            raise ParameterError(f"there is no state {state}; expected 0 to {self.mdp.num_states - 1:,}")
        if previous is not None and not 0 <= previous < self.mdp.num_actions:
            raise ParameterError(f"there is no action {previous}; expected 0 to {self.mdp.num_actions - 1}")
        return int(state), None if previous is None or not self.mdp.is_sticky else int(previous)

    def find(self, text: str) -> dict[str, Any]:
        """The number of the state that a text names, by it or by the values of its variables: "12", or "2,3,1"."""
        try:
            numbers = [int(word) for word in text.replace(",", " ").split()]
        except ValueError:
            numbers = []
        if len(numbers) == 1:
            return {"state": self._checked(numbers[0], None)[0]}
        if not numbers:
            raise ParameterError(f"found {text!r}; expected the number of a state, or its values such as 2,3,1")
        return {"state": self.states.number(numbers)}

    # Paths ----------------------------------------------------------------------------------------------------------

    def path(self, policy: str, state: int, previous: int | None = None) -> dict[str, Any]:
        """A likely way of a policy from a position: its likeliest actions, and the likeliest outcomes that are new on
        the way, until the end, or until nothing new is left.

        Returns:
            - `steps`: a list of state, previous, action, probability (of the outcome), reward, gap (of the action)
            - `stops`: the last state and previous
            - `why`: "end", "circle", "limit", or "unknown" (the policy was not asked there)
        Raises:
            ParameterError: there is no such policy or position.
        """
        self._check_policy(policy)
        at: tuple[int | None, int | None] = self._checked(state, previous)
        steps: list[list[Any]] = []
        pairs: set[tuple[int | None, int | None]] = set()
        why = "limit"
        while len(steps) < LONGEST_PATH:
            if at[0] is None or self.mdp.terminal[at[0]]:
                why = "end"
                break
            pairs.add(at)
            here = np.array([at[0]])
            q = self.chosen_values(OPTIMAL, here, at[1])
            chances = self.chances(policy, here, q, at[1])
            if np.isnan(chances).any():
                why = "unknown"
                break
            action = int(chances[0].argmax())
            outcomes = self._outcomes(at[0], self._executed(at[0], at[1])[action])
            new = next((each for each in outcomes if (each[0], each[1]) not in pairs), None)
            if new is None:
                why = "circle"
                break
            steps.append([*at, action, *new[2:], float(q.max() - q[0, action])])
            at = new[0], new[1]
        return {"steps": steps, "stops": list(at), "why": why}

    def _check_policy(self, policy: str) -> None:
        if policy not in self.solutions:
            raise ParameterError(f"there is no policy {policy!r}; expected {', '.join(self.solutions)}")

    # Layers ---------------------------------------------------------------------------------------------------------

    def layer(self, layer: int, first: int = 0) -> dict[str, Any]:
        """Some states of a breadth-first layer, from position `first` on.

        Returns:
            `layer`, `first`, `count` of all, and `states`: a list of state, optimal value, terminal.
        Raises:
            ParameterError: there is no such layer.
        """
        if not 0 <= layer < len(self.layers.counts):
            raise ParameterError(f"there is no layer {layer}; expected 0 to {len(self.layers.counts) - 1:,}")
        states = self.layers.states(layer)[max(0, first) : max(0, first) + LISTED]
        values = self.values(OPTIMAL, states)
        listed = zip(states.tolist(), values.tolist(), self.mdp.terminal[states].tolist(), strict=True)
        return {
            "layer": layer,
            "first": first,
            "count": int(self.layers.counts[layer]),
            "states": [list(each) for each in listed],
        }

    # Where a policy goes wrong --------------------------------------------------------------------------------------

    def wrong(self, policy: str = LEARNT) -> dict[str, Any]:
        """Losses of a policy: along its most probable path, and in all states.

        Returns:
            - `regret`: V* minus its value at the start
            - `lost`: the sum of what it loses in all states
            - `first`: the first step of its likeliest way whose gap is no tie, as `path` has it, with its `number`, or
              None
            - `worst`: the states that lose most: state, loss, visits, action chosen most
        Raises:
            ParameterError: there is no such policy.
        """
        self._check_policy(policy)
        start = int(self.mdp.start_states[self.mdp.start_probabilities.argmax()])
        steps = self.path(policy, start)["steps"]
        number_of = next((i for i, step in enumerate(steps) if step[-1] > self.tie_tolerance), None)
        lost, visits, actions = self.visits.losses(policy)
        worst = np.argsort(-lost, kind="stable")[:MOST_WORST_STATES]
        worst = worst[lost[worst] > self.tie_tolerance * 1e-3]
        best, value = (self.solutions[name].value_at_start for name in (OPTIMAL, policy))
        return {
            "regret": float_or_none(best - value),
            "lost": float(lost.sum()),
            "first": None if number_of is None else {"number": number_of, "step": steps[number_of]},
            "worst": [[int(s), float(lost[s]), float(visits[s]), int(actions[s])] for s in worst],
        }

    # The page as a whole --------------------------------------------------------------------------------------------

    def about(self) -> dict[str, Any]:
        """Page metadata: title, sizes, policies, map axes."""
        from pharos.explorer.pages import about_maps

        mdp, starts = self.mdp, np.argsort(-self.mdp.start_probabilities, kind="stable")[:MOST_LISTED_STARTS]
        return {
            "title": self.title,
            "num_states": mdp.num_states,
            "num_actions": mdp.num_actions,
            "num_terminal": int(np.count_nonzero(mdp.terminal)),
            "actions": list(self.actions),
            "keys": keys_of(self.actions),
            "gamma": mdp.gamma,
            "chance": self.chance,
            "is_sticky": mdp.is_sticky,
            "starts": [[int(mdp.start_states[i]), float(mdp.start_probabilities[i])] for i in starts],
            "policies": self.policies,
            "value_at_start": {name: float_or_none(each.value_at_start) for name, each in self.solutions.items()},
            "error_bound": max(float(each.error_bound) for each in self.solutions.values()),
            "tie_tolerance": self.tie_tolerance,
            "learnt": None if self.learnt is None else {"name": self.learnt.name, "facts": dict(self.learnt.facts)},
            "variables": [
                {"name": name, "low": int(low), "size": int(size)}
                for name, low, size in zip(self.states.names, self.states.low, self.states.size, strict=True)
            ],
            "drawing": self.pictures.kit,
            "fault": self.pictures.fault,
            "layers": self.layers.bars(),
            "num_layers": len(self.layers.counts),
            **about_maps(self),
        }


def float_or_none(value: float | np.floating) -> float | None:
    """A float, or None if it is not a number."""
    return float(value) if np.isfinite(value) else None


# Picture --------------------------------------------------------------------------------------------------------------


LONGEST_SIDE = 720  # pixels of the longer side of a drawing, if cells are not the smallest for it


def _states_of(mdp: TabularMDP, space: StateSpace | None) -> States:
    if space is not None:
        return SpaceStates(space)
    if mdp.names is not None and mdp.names.variables:
        return NamedStates(mdp.names.variables)
    return NumberedStates(mdp.num_states)


class Pictures:
    """Draws the states of an environment. If that is not possible, `fault` is the reason, in one line.

    Attributes:
        kit: what all drawings are composed of, for the page. None if the states cannot be drawn.
        fault: why they cannot, or "" if they can.
    """

    def __init__(self, env: Environment | None, start: State | None):
        self.env, self.kit, self.fault = env, None, ""
        if env is None or start is None:
            self.fault = "There is no drawing: the MDP came without an environment."
            return
        try:
            self.kit = kit_of(env) if env.picture(start) is None else {}
            if not self.kit:
                return
            planes_of(env, start)
        except Exception as error:  # whatever a class of one's own does when it is to be drawn
            self.kit, self.fault = None, f"There is no drawing: {' '.join(str(error).split()) or type(error).__name__}"

    def of(self, state: State) -> dict[str, Any]:
        """`cells`, a list of (layer, row, column, value), or `picture`, the URL of one that the class has of its own,
        or `fault`."""
        if self.env is None or self.kit is None:
            return {"fault": self.fault}
        try:
            if (own := self.env.picture(state)) is not None:
                return {"picture": url_of(own)}
            planes = planes_of(self.env, state)
            layers, rows, columns = np.nonzero(planes)
            return {"cells": np.stack([layers, rows, columns, planes[layers, rows, columns]], axis=1).tolist()}
        except Exception as error:  # as above
            return {"fault": f"This state cannot be drawn: {' '.join(str(error).split()) or type(error).__name__}"}


def kit_of(env: Environment) -> dict[str, Any]:
    """Parts that the drawings of an environment are composed of.

    Returns:
        `rows`, `columns`, `cell` (pixels) and `margin` (pixels) of the drawing; `ground`, the URL of what lies below
        all things; `tiles`, of each layer the URLs of what its values 1, 2, ... look like, the last for higher ones;
        `layers`, their names.
    """
    rows, columns = env.grid()
    cell = fitting_cell(rows, columns, LONGEST_SIDE, LONGEST_SIDE)
    tiles = [
        [url_of(tile(name, layer, value + 1, cell) * (1, 1, 1, 255)) for value in range(num_values(layer))]
        for name, layer in env.layers.items()
    ]
    return {
        "rows": rows,
        "columns": columns,
        "cell": cell,
        "margin": cell // 2,
        "ground": url_of(empty_grid(env, cell)),
        "tiles": tiles,
        "layers": list(env.layers),
    }


def url_of(picture: np.ndarray) -> str:
    """A picture (H, W, 3 or 4), 0 to 255, as the URL of a PNG that holds it."""
    written = io.BytesIO()
    image(np.rint(picture).astype(np.uint8)).save(written, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(written.getvalue()).decode()
