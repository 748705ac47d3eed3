"""The page: template, style and script in one text, which loads nothing, with the data of a small space inside.

Heat maps: a quantity over two variables, the others at chosen values or at any. The states of a large space are gone
through in blocks, so that no more than some megabytes are needed beside it.
"""

import base64
import contextlib
import hashlib
import html
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from pharos.environments import Environment, make
from pharos.errors import ParameterError, PharosError, UnknownName
from pharos.explorer.exploration import Exploration, float_or_none
from pharos.explorer.states import OPTIMAL, Axis, axes_of
from pharos.mdp import TabularMDP
from pharos.state_space import build
from pharos.system import storage

STATES_AT_ONCE = 1 << 18  # states that are looked at in one go
MEAN, LEAST_VALUE, MOST_VALUE, SUM = "mean", "least", "most", "sum"
HOW = (MEAN, LEAST_VALUE, MOST_VALUE, SUM)
GROUPS = {"column", "x"}, {"row", "y"}  # words in the names of variables that are drawn first, across and down


def quantities(world: Exploration) -> dict[str, str]:
    """Name -> description, of all quantities of a state."""
    names = {"value": "optimal value V*"}
    names |= {f"value_{name}": f"value of the {name} policy" for name in world.policies if name != OPTIMAL}
    names |= {f"regret_{name}": f"regret of the {name} policy, V* - V" for name in world.policies if name != OPTIMAL}
    names |= {
        "smallest_gap": "smallest gap that is no tie",
        "largest_gap": "largest gap",
        "best_action": "optimal action, the first among equals",
        "layer": "breadth-first layer (depth)",
    }
    return names | {f"visits_{name}": f"occupancy of the {name} policy" for name in world.policies}


def quantity(world: Exploration, name: str, states: np.ndarray) -> np.ndarray:
    """(N,) a quantity of states, one of `quantities`, NaN if it has none, as most have in terminal states."""
    kind, _, policy = name.partition("_")
    if name == "layer":
        layers = world.layers.of(states).astype(np.float64)
        return np.where(layers < 0, np.nan, layers)
    if kind == "visits":
        result = world.visits.of(policy)[states]
    elif kind == "value":
        result = world.values(policy or OPTIMAL, states)
    elif kind == "regret":
        result = world.values(OPTIMAL, states) - world.values(policy, states)
    else:
        q = world.chosen_values(OPTIMAL, states)
        gaps = q.max(axis=1, keepdims=True) - q
        if name == "best_action":
            result = world.best_actions(q, states).astype(np.float64)
        elif name == "largest_gap":
            result = gaps.max(axis=1)
        else:
            result = np.where(gaps > world.tie_tolerance, gaps, np.inf).min(axis=1)
            result[np.isinf(result)] = np.nan
    return np.where(world.mdp.terminal[states], np.nan, result)


def heat_map(
    world: Exploration, x: str, y: str, what: str = "value", *, fixed: Mapping[str, int] | None = None, how: str = MEAN
) -> dict[str, Any]:
    """A quantity over two axes.

    Args:
        x, y: names of axes, across and down.
        what: a quantity, see `quantities`.
        fixed: variable -> value, of the states that count. Other variables may have any value.
        how: what a cell of several states shows: "mean", "least", "most" or "sum". Of actions: the action if all
            states have the same, else -1.
    Returns:
        - `x`, `y`: the axes
        - `cells`: rows of values, None if there are none
        - `count`: rows of numbers of states
        - `state`: rows of the first state of each cell, -1 if there is none
        - `terminal`: rows of how many are terminal
        - `low`, `high`: of all cells
        - `states`: how many count
    Raises:
        UnknownName: an axis, a variable or a quantity does not exist. ParameterError: `how` is none of these, or the
            axes are the same.
    Cost: one read of the packed states, and of what the quantity is made of.
    """
    axes, names, fixed = axes_of(world.states), world.states.names, fixed or {}
    questions = [("axis", x, axes), ("axis", y, axes), ("summary", how, HOW), ("quantity", what, quantities(world))]
    for kind, name, choices in [*questions, *(("variable", name, names) for name in fixed)]:
        if name not in choices:
            raise UnknownName(kind, name, choices)
    if x == y:
        raise ParameterError(f"both axes are {x!r}; expected two of {', '.join(axes)}")
    across, down = axes[x], axes[y]
    slices = {names.index(name): value for name, value in fixed.items()}
    cells = _Cells(down.count, across.count)
    for start in range(0, world.mdp.num_states, STATES_AT_ONCE):
        block = slice(start, min(start + STATES_AT_ONCE, world.mdp.num_states))
        states = np.flatnonzero(world.states.matching(slices, block))
        if not states.size:
            continue
        indices = [axis.indices(world.states.column(axis.variable, block)[states]) for axis in (down, across)]
        here = start + states
        terminal = world.mdp.terminal[here]
        cells.add(indices[0] * across.count + indices[1], here, quantity(world, what, here), terminal)
    return {"x": asdict(across), "y": asdict(down), "what": what, "how": how} | cells.answer(what, how)


class _Cells:
    """Values met in each cell so far."""

    def __init__(self, rows: int, columns: int):
        self.shape, size = (rows, columns), rows * columns
        self.count, self.terminal, self.known = (np.zeros(size, np.int64) for _ in range(3))
        self.sum, self.least, self.most = np.zeros(size), np.full(size, np.inf), np.full(size, -np.inf)
        self.first = np.full(size, np.iinfo(np.int64).max)

    def add(self, indices: np.ndarray, states: np.ndarray, values: np.ndarray, terminal: np.ndarray) -> None:
        size = len(self.count)
        self.count += np.bincount(indices, minlength=size)
        self.terminal += np.bincount(indices[terminal], minlength=size)
        np.minimum.at(self.first, indices, states)
        is_known = ~np.isnan(values)
        indices, values = indices[is_known], values[is_known]
        self.known += np.bincount(indices, minlength=size)
        self.sum += np.bincount(indices, values, minlength=size)
        np.minimum.at(self.least, indices, values)
        np.maximum.at(self.most, indices, values)

    def answer(self, what: str, how: str) -> dict[str, Any]:
        is_known = self.known > 0
        if what == "best_action":
            shown = np.where(self.least == self.most, self.least, -1.0)
        else:
            means = self.sum / np.maximum(self.known, 1)
            shown = {MEAN: means, LEAST_VALUE: self.least, MOST_VALUE: self.most, SUM: self.sum}[how]
        listed = [float_or_none(value) if there else None for value, there in zip(shown, is_known, strict=True)]
        numbers = shown[is_known]
        return {
            "cells": self._rows(listed),
            "count": self._rows(self.count.tolist()),
            "terminal": self._rows(self.terminal.tolist()),
            "state": self._rows(np.where(self.count > 0, self.first, -1).tolist()),
            "low": float_or_none(numbers.min()) if numbers.size else None,
            "high": float_or_none(numbers.max()) if numbers.size else None,
            "states": int(self.count.sum()),
        }

    def _rows(self, values: list[Any]) -> list[list[Any]]:
        rows, columns = self.shape
        return [values[row * columns : (row + 1) * columns] for row in range(rows)]


def about_maps(world: Exploration) -> dict[str, Any]:
    """Choices of the page: `axes`, `quantities`, and which are drawn first, `first`: x, y."""
    axes = axes_of(world.states)
    return {
        "axes": [asdict(axis) for axis in axes.values()],
        "quantities": quantities(world),
        "first": _first_axes(axes),
    }


def _first_axes(axes: Mapping[str, Axis]) -> list[str]:
    """Default axes x, y: variables named column and row, else the longest remaining ones."""
    words = {name: set(name.lower().replace("[", "_").split("_")) for name in axes}
    column, row = (next((name for name in axes if words[name] & group), None) for group in GROUPS)
    longest = sorted(axes, key=lambda name: -axes[name].count)
    x = column or next(name for name in longest if name != row)
    return [x, row or next(name for name in longest if name != x)]


# Pages ----------------------------------------------------------------------------------------------------------------


MOST_POSITIONS = 10_000  # states, under sticky actions times previous ones, that a page of its own holds
MOST_BYTES = 64 << 20  # of such a page
MOST_INSTANCES = 6  # named instances that are built to find one that fits
SCRIPTS = ("source.js", "drawing.js", "maps.js", "panels.js", "main.js")
SIGNIFICANT_DIGITS = 12  # significant ones of a number in a page of its own


@cache
def _read(name: str) -> str:
    return (resources.files("pharos.explorer") / "templates" / name).read_text(encoding="utf-8")


@cache
def script() -> str:
    """All of the page's script."""
    return '"use strict";\n' + "\n".join(map(_read, SCRIPTS))


@cache
def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _policy(connect: str) -> str:
    """Content security policy of the page: execute this very script, show pictures that it holds, ask `connect`."""
    code, look = _digest(script()), _digest(_read("page.css"))
    return (
        f"default-src 'none'; script-src 'sha256-{code}'; style-src 'sha256-{look}'; "
        f"img-src data:; connect-src {connect}; base-uri 'none'; form-action 'none'"
    )


POLICY_OF_SERVER = _policy("'self'") + "; frame-ancestors 'none'"


def explorer_page(world: Exploration, data: dict[str, Any] | None = None) -> str:
    """The page as HTML. `data`: what it holds of its own. None: it asks the server that it came from."""
    parts = {
        "TITLE": html.escape(world.title),
        "POLICY": html.escape(_policy("'self'" if data is None else "'none'")),
        "STYLE": _read("page.css"),
        "SCRIPT": script(),
        "DATA": "null" if data is None else json.dumps(data, allow_nan=False, separators=(",", ":")),
    }
    parts["DATA"] = parts["DATA"].replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
    pieces = _read("page.html").split("%%")
    return "".join(parts[piece] if i % 2 else piece for i, piece in enumerate(pieces))


def contents(world: Exploration) -> dict[str, Any]:
    """Data of a page in one file: all positions, and all quantities of all states.

    Raises:
        ParameterError: there are more than MOST_POSITIONS.
    """
    mdp = world.mdp
    check_page_size(mdp, world.title, world.env)
    states = np.arange(mdp.num_states)
    before: list[int | None] = [None, *range(mdp.policy_width - 1)]
    positions = {
        _state_key(state, previous): world.position(state, previous)
        for state in range(mdp.num_states)
        for previous in before
    }
    fields = {name: [float_or_none(value) for value in quantity(world, name, states)] for name in quantities(world)}
    wrong = {name: world.wrong(name) for name in world.policies}
    return _shortened({"about": world.about(), "positions": positions, "fields": fields, "wrong": wrong})


def check_page_size(mdp: TabularMDP, title: str, env: Environment | None = None) -> None:
    """ParameterError if a page of its own does not hold all positions of an MDP. It names a smaller one of `env`."""
    width = mdp.policy_width
    if mdp.num_states * width > MOST_POSITIONS:
        smaller = smaller_instance(env, MOST_POSITIONS // width) if env is not None else ""
        raise ParameterError(
            f"{title}: has {mdp.num_states * width:,} "
            f"{'pairs of a state and a previous action' if width > 1 else 'states'}; a page of its own holds at most "
            f"{MOST_POSITIONS:,}: choose a smaller instance{smaller and f' ({smaller})'}, or leave out --out (out= in "
            "Python) for a local server"
        )


def smaller_instance(env: Environment, most: int) -> str:
    """Instance of the same class with at most `most` states, in words: `frozen_lake/8x8 has 64`. Empty without one.

    The largest of the first MOST_INSTANCES named instances, else the same environment with one whole-number parameter
    as much smaller as needed, by bisection. Cost: builds of at most `most` states.
    """
    named = [f"{env.name}/{name}" for name in type(env).instances][:MOST_INSTANCES]
    sizes = {name: size for name in named if (size := _num_states(partial(make, name), most))}
    if sizes:
        name = max(sizes, key=sizes.__getitem__)
        return f"{name} has {sizes[name]:,}"
    for name, value in env.parameters.items():
        text, low, high = "", 0, value if type(value) is int else 0
        while high - low > 1:
            middle = (low + high) // 2
            if size := _num_states(partial(type(env), **{**env.parameters, name: middle}), most):
                text, low = f"{name}={middle} has {size:,}", middle
            else:
                high = middle
        if text:
            return text
    return ""


def _num_states(make_env: Callable[[], Environment], most: int) -> int:
    """Number of states of an environment. 0 if there is none with these parameters, or it has more than `most`."""
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(PharosError, ValueError):
        return build(make_env(), Path(folder) / "states", max_states=most, progress=False).num_states
    return 0


def write(world: Exploration, path: str | os.PathLike) -> Path:
    """Write the page with all its data into one file, which needs no server.

    Raises:
        ParameterError: the space is too large for that.
    """
    text = explorer_page(world, contents(world))
    if len(text) > MOST_BYTES:
        raise ParameterError(
            f"{world.title}: its page would have {len(text) >> 20} MiB; expected at most {MOST_BYTES >> 20}: choose a "
            f"smaller instance, or leave out --out (out= in Python) for a local server"
        )
    path = Path(path)
    storage.replace_file(path, text, follow=True)
    return path


def _state_key(state: int, previous: int | None) -> str:
    return f"{state}" if previous is None else f"{state},{previous}"


def _shortened(data: object) -> Any:
    """The value with its numbers rounded to DIGITS significant digits."""
    if isinstance(data, dict):
        return {name: _shortened(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [_shortened(value) for value in data]
    return float(f"{data:.{SIGNIFICANT_DIGITS}g}") if isinstance(data, float) else data
