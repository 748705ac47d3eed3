"""pharos play: play an environment in the terminal."""

import contextlib
import os
import random
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

from pharos.cli.answers import Answer, console
from pharos.cli.options import Seed
from pharos.cli.render import find_state
from pharos.cli.target import Target
from pharos.errors import PharosError
from pharos.explorer import keys_of
from pharos.system.wording import many

if TYPE_CHECKING:
    from rich.console import RenderableType

    from pharos.environments import Environment, State

ESCAPES = {"[A": "up", "[B": "down", "[C": "right", "[D": "left", "OA": "up", "OB": "down", "OC": "right", "OD": "left"}
SIGNS = {"up": "↑", "left": "←", "down": "↓", "right": "→", "space": "space"}
QUIT, AGAIN, BACK = "q", "r", "u"


def play(target: Target, *, state: str | None = None, seed: Seed | None = None) -> Answer:
    """Play with the keyboard, in the terminal; one key is one step.

    Args:
        state: Number of a state, or its values 2,3,1; the start when not given.
        seed: Of chance in the rules; another game each time without it.
    """
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise PharosError("play needs a terminal for the keyboard and the picture; it cannot run in a pipe")
    env = target.found_environment()
    game = Game(env, find_state(target, env, state), seed)
    with _screen() as show, _keys() as next_key:
        while True:
            show(_picture(game))
            key = next_key()
            if key in (QUIT, "\x03", "\x04", "escape", ""):
                break
            game.press(key)
    answer = {"environment": env.name, "parameters": env.parameters, "steps": game.steps, "return": game.total}
    return Answer(
        {**answer, "state": game.state, "terminal": game.over},
        f"{env.name}: {many(game.steps, 'step')}, return {game.total:g}{', ended' if game.over else ''}",
    )


class Game:
    """A game being played: what has happened, and which key does what."""

    def __init__(self, env: "Environment", start: "State", seed: int | None = None):
        self.env, self.rng = env, random.Random(seed)
        self.keys = keys_of(env.actions)
        self.history: list[tuple[State, int, float]] = []
        self.start = self.state = start

    @property
    def steps(self) -> int:
        """Steps so far."""
        return len(self.history)

    @property
    def total(self) -> float:
        """Sum of rewards so far."""
        return sum(reward for _, _, reward in self.history)

    @property
    def over(self) -> bool:
        """Whether the episode has ended."""
        return bool(self.env.is_terminal(self.state))

    def press(self, key: str) -> None:
        """Do what a key says: an action, AGAIN from the start, BACK one step; nothing for any other key."""
        if key == AGAIN:
            self.state, self.history = self.start, []
        elif key == BACK and self.history:
            self.state = self.history.pop()[0]
        elif key in self.keys and not self.over:
            action = self.keys[key]
            outcome = self.env.drawn_outcome(self.state, action, self.rng.random()) if self.env.has_chance else 0
            following = self.env.next_state(self.state, action, outcome)
            paid = float(self.env.reward_of(self.state, action, following, outcome))
            self.history.append((self.state, action, paid))
            self.state = following


def _picture(game: Game) -> "RenderableType":
    from rich.console import Group
    from rich.text import Text

    from pharos.drawing import colored_text

    last = game.history[-1] if game.history else None
    line = Text.assemble((game.env.name, "bold cyan"), f"   step {game.steps}   return {game.total:g}")
    if last is not None:
        line.append(f"   {game.env.actions[last[1]]}", style="dim")
        if last[2]:
            line.append(f"  {last[2]:+g}", style="bold green" if last[2] > 0 else "bold red")
    if game.over:
        line.append("   the episode has ended", style="bold yellow")
    names: dict[int, list[str]] = {}
    for key, action in game.keys.items():
        names.setdefault(action, []).append(SIGNS.get(key, key))
    does = [f"{'/'.join(sorted(shown, key=len))} {game.env.actions[action]}" for action, shown in names.items()]
    help_line = Text("   ".join([*does, f"{BACK} undo", f"{AGAIN} restart", f"{QUIT} quit"]), style="dim")
    return Group(line, Text(), colored_text(game.env, game.state), Text(), help_line)


@contextlib.contextmanager
def _screen() -> Iterator:
    """A function that shows something on the other screen of the terminal, which is left as it was."""
    to = console(stderr=True)
    with to.screen(hide_cursor=True) as screen:
        yield screen.update


@contextlib.contextmanager
def _keys() -> Iterator:
    """A function that waits for a key and names it; the terminal is given back as it was, whatever happens."""
    import termios
    import tty

    stdin = sys.stdin.fileno()
    before = termios.tcgetattr(stdin)
    try:
        tty.setcbreak(stdin)
        yield lambda: _key_named(os.read(stdin, 8).decode(errors="replace"))
    finally:
        termios.tcsetattr(stdin, termios.TCSADRAIN, before)


def _key_named(typed: str) -> str:
    """The name of a key from what the terminal sends for it."""
    if typed == "\x1b":
        return "escape"
    if typed.startswith("\x1b"):
        return ESCAPES.get(typed[1:3], "unknown")
    return "space" if typed == " " else typed[:1].lower()
