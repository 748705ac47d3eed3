"""pharos render: a picture of a state, or of a played episode.

pharos play: play an environment in the terminal.
"""

import contextlib
import os
import random
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, complain, console, describe
from pharos.cli.options import Discount, Seed, Target, file_ending, parse_value
from pharos.errors import ParameterError, PharosError, UnknownName
from pharos.explorer import keys_of
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    from rich.console import RenderableType

    from pharos.environments import Environment, State


PLAYED_POLICIES = ("auto", "optimal", "uniform")
AUTOMATIC_STATES = 20_000_000  # "auto" solves what is not larger


def render(
    target: Target,
    *,
    observation: str = "human",
    option: Mapping[str, Any],
    out: Annotated[Path | None, file_ending(".png", ".gif", ".txt")] = None,
    state: str | None = None,
    steps: Annotated[int | None, typer.Option(min=0)] = None,
    policy: str = "auto",
    gamma: Discount = 0.99,
    seed: Seed = 0,
    fps: Annotated[float, typer.Option(min=0.1, max=50)] = 10.0,
    json: bool = False,
) -> Answer | None:
    """Draw a state (PNG) or an episode (GIF, or the state after --steps as PNG), or in the terminal without --out.

    Args:
        observation: How to draw: human, text, simple_image, complex_image, or your own.
        option: Option of the observation, such as size=natural.
        out: Write to FILE.png, FILE.gif or FILE.txt. Default: draw in the terminal.
        state: Number of a state, or its values 2,3,1. Default: the start.
        steps: Play this many steps from the state.
        policy: optimal, uniform, or auto: optimal if that is quick to find.
        gamma: Discount of the optimal policy.
        seed: Seed of the uniform policy, and of chance in the rules.
        fps: Frames per second of a GIF.
    """
    from pharos import drawing, observations
    from pharos.system import storage

    suffix = out.suffix.lower() if out else ""
    if observation != "text" and observation not in (renderers := observations.renderers()):
        raise UnknownName("observation to render", observation, [*renderers, "text"])
    if policy not in PLAYED_POLICIES:
        raise UnknownName("policy", policy, PLAYED_POLICIES)
    env = target.found_environment()
    start = find_state(target, env, state)
    if steps is None:
        steps = min(env.max_episode_steps, 200) if suffix == ".gif" else 0
    used, choose = (policy, None) if steps == 0 else find_policy(target, env, policy, gamma, seed)
    played = drawing.episode(env, choose or (lambda _: 0), start, steps=steps, seed=seed)

    returned = sum(reward for _, _, reward in played)
    last = played[-1][0]
    at_least = 0 if observation == "human" else 400
    if out is None and not json:
        console().print(drawing.colored_text(env, last))
    elif out is not None and suffix == ".txt":
        frames = [drawing.text_drawing(env, each) for each, _, _ in played]
        storage.replace_file(out, "\n\n".join(frames) + "\n", follow=True)
    elif out is not None and suffix == ".gif":
        shown = played if len(played) > 1 else [played[0]]
        pictures = [observations.render(env, each, observation, **option) for each, _, _ in shown]
        captions = _captions(env, shown) if observation == "human" else ()
        drawing.save_gif(out, pictures, captions=captions, frames_per_second=fps, at_least=at_least)
    elif out is not None:
        drawing.save_png(out, observations.render(env, last, observation, **option), at_least=at_least)
    if out is None and not json:
        return None
    answer = {
        "environment": env.name,
        "parameters": env.parameters,
        "observation": observation,
        "policy": used if steps else None,
        "steps": len(played) - 1,
        "return": returned,
        "state": last,
        "file": out,
        "bytes": out.stat().st_size if out else 0,
    }
    after = f" after {len(played) - 1} steps of the {used} policy, return {returned:g}" if steps else ""
    return Answer(answer, f"{describe(env)}{after}: {out}")


def _captions(env: "Environment", played: Sequence[tuple]) -> list[str]:
    lines, total = [], 0.0
    for step, (_, action, reward) in enumerate(played):
        does = env.actions[action] if action >= 0 else ""
        lines.append(f"step {step}   return {total:g}   {does}")
        total += reward
    return lines


# Shared with `play` and `evaluate` ------------------------------------------------------------------------------------


def find_state(target: Target, env: "Environment", text: str | None) -> "State":
    """The state that `--state` names: its number in the state space, or its values. By default the start state."""
    from pharos.drawing import check_state

    if text is None:
        return tuple(int(value) for value in env.initial_states()[0][0])
    value = parse_value(text)
    if isinstance(value, int) and not isinstance(value, bool) and len(env.components) != 1:
        return target.space().state(value)
    values = value if isinstance(value, tuple) else (value,)
    if not all(isinstance(part, int) for part in values):
        raise ParameterError(f"--state {text!r}; expected the number of a state, or its values such as 2,3,1")
    check_state(env, values)
    return values


def find_policy(
    target: Target, env: "Environment", name: str, gamma: float, seed: int
) -> tuple[str, Callable[["State"], int]]:
    """The name and the function of a policy. "auto" is optimal if the state space is small, else uniform."""
    if name == "auto":
        try:
            return "optimal", _optimal(target, gamma, AUTOMATIC_STATES)
        except PharosError as error:
            complain(f"playing at random: {error}")
            name = "uniform"
    if name == "optimal":
        return name, _optimal(target, gamma, None)
    import numpy as np

    rng = np.random.default_rng(seed)
    return name, lambda _: int(rng.integers(env.num_actions))


def _optimal(target: Target, gamma: float, max_states: int | None) -> Callable[["State"], int]:
    from pharos.solvers import value_iteration

    space = target.space(max_states=max_states)
    policy = value_iteration(space.mdp(gamma=gamma)).policy
    return lambda state: int(policy[space.index(state)])


# Play -----------------------------------------------------------------------------------------------------------------


ESCAPES = {"[A": "up", "[B": "down", "[C": "right", "[D": "left", "OA": "up", "OB": "down", "OC": "right", "OD": "left"}
KEY_SIGNS = {"up": "↑", "left": "←", "down": "↓", "right": "→", "space": "space"}
QUIT, NEW_GAME, UNDO = "q", "r", "u"


def play(target: Target, *, state: str | None = None, seed: Seed | None = None) -> Answer:
    """Play with the keyboard, in the terminal. One key is one step.

    Args:
        state: Number of a state, or its values 2,3,1. Default: the start.
        seed: Seed of chance in the rules. Default: another game each time.
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
        f"{env.name}: {pluralize(game.steps, 'step')}, return {game.total:g}{', ended' if game.over else ''}",
    )


class Game:
    """A game in progress: its history, and the keys for actions."""

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
        """Execute the command of a key: an action, AGAIN (restart), BACK (undo one step). Other keys do nothing."""
        if key == NEW_GAME:
            self.state, self.history = self.start, []
        elif key == UNDO and self.history:
            self.state = self.history.pop()[0]
        elif key in self.keys and not self.over:
            action = self.keys[key]
            outcome = self.env.drawn_outcome(self.state, action, self.rng.random()) if self.env.has_chance else 0
            next_state = self.env.next_state(self.state, action, outcome)
            reward = float(self.env.reward_of(self.state, action, next_state, outcome))
            self.history.append((self.state, action, reward))
            self.state = next_state


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
        names.setdefault(action, []).append(KEY_SIGNS.get(key, key))
    does = [f"{'/'.join(sorted(shown, key=len))} {game.env.actions[action]}" for action, shown in names.items()]
    help_line = Text("   ".join([*does, f"{UNDO} undo", f"{NEW_GAME} restart", f"{QUIT} quit"]), style="dim")
    return Group(line, Text(), colored_text(game.env, game.state), Text(), help_line)


@contextlib.contextmanager
def _screen() -> Iterator:
    """Yield a function that draws on the alternate screen of the terminal. The main screen is restored at the end."""
    to = console(stderr=True)
    with to.screen(hide_cursor=True) as screen:
        yield screen.update


@contextlib.contextmanager
def _keys() -> Iterator:
    """Yield a function that waits for a key and returns its name. The terminal is restored in any case."""
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
    """The name of a key from the characters that the terminal sends."""
    if typed == "\x1b":
        return "escape"
    if typed.startswith("\x1b"):
        return ESCAPES.get(typed[1:3], "unknown")
    return "space" if typed == " " else typed[:1].lower()
