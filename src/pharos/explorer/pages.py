"""The page: template, style and script in one text, which loads nothing; with the data of a small space inside."""

import base64
import hashlib
import html
import json
import os
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from pharos.errors import ParameterError
from pharos.explorer.exploration import Exploration
from pharos.explorer.maps import quantities, quantity
from pharos.mdp import TabularMDP
from pharos.system import storage

MOST_POSITIONS = 10_000  # states, under sticky actions times previous ones, that a page of its own holds
MOST_BYTES = 64 << 20  # of such a page
SCRIPTS = ("source.js", "drawing.js", "maps.js", "panels.js", "main.js")
DIGITS = 12  # significant ones of a number in a page of its own


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


def page(world: Exploration, data: dict[str, Any] | None = None) -> str:
    """The page as HTML. `data`: what it holds of its own; None: it asks the server that it came from."""
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
    check_size(mdp, world.title)
    states = np.arange(mdp.num_states)
    before: list[int | None] = [None, *range(mdp.policy_width - 1)]
    positions = {
        _place(state, previous): world.position(state, previous)
        for state in range(mdp.num_states)
        for previous in before
    }
    fields = {name: [_plain(value) for value in quantity(world, name, states)] for name in quantities(world)}
    wrong = {name: world.wrong(name) for name in world.policies}
    return _shortened({"about": world.about(), "positions": positions, "fields": fields, "wrong": wrong})


def check_size(mdp: TabularMDP, title: str) -> None:
    """ParameterError where a page of its own does not hold all positions of an MDP."""
    width = mdp.policy_width
    if mdp.num_states * width > MOST_POSITIONS:
        raise ParameterError(
            f"{title}: has {mdp.num_states * width:,} "
            f"{'pairs of a state and a previous action' if width > 1 else 'states'}; a page of its own holds at most "
            f"{MOST_POSITIONS:,}: choose a smaller instance, or leave out --out (out= in Python) for a local server"
        )


def write(world: Exploration, path: str | os.PathLike) -> Path:
    """Write the page with all its data into one file, which needs no server.

    Raises:
        ParameterError: the space is too large for that.
    """
    text = page(world, contents(world))
    if len(text) > MOST_BYTES:
        raise ParameterError(
            f"{world.title}: its page would have {len(text) >> 20} MiB; expected at most {MOST_BYTES >> 20}: choose a "
            f"smaller instance, or leave out --out (out= in Python) for a local server"
        )
    path = Path(path)
    storage.replace_file(path, text)
    return path


def _place(state: int, previous: int | None) -> str:
    return f"{state}" if previous is None else f"{state},{previous}"


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _shortened(data: object) -> Any:
    """The same with numbers of DIGITS significant digits."""
    if isinstance(data, dict):
        return {name: _shortened(value) for name, value in data.items()}
    if isinstance(data, list | tuple):
        return [_shortened(value) for value in data]
    return float(f"{data:.{DIGITS}g}") if isinstance(data, float) else data
