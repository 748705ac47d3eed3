"""pharos render: a picture of a state, or of a played episode."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pharos.cli.answers import complain, describe, print_json
from pharos.cli.options import Json, Parameters, TargetArgument, check_format, parse_parameters, parse_value
from pharos.cli.target import Target, parse_target
from pharos.errors import ParameterError, PharosError, UnknownName

if TYPE_CHECKING:
    from pharos.environments import Environment, State

POLICIES = ("auto", "optimal", "uniform")
AUTOMATIC_STATES = 20_000_000  # "auto" solves what is not larger


def render(
    target: TargetArgument,
    parameters: Parameters = None,
    observation: Annotated[
        str, typer.Option("--observation", help="How to draw: human, text, simple_image, complex_image, or your own.")
    ] = "human",
    option: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="NAME=VALUE", help="Option of the observation, such as size=natural."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="FILE.png, FILE.gif or FILE.txt; the terminal when not given.")
    ] = None,
    state: Annotated[
        str | None, typer.Option("--state", help="Number of a state, or its values 2,3,1; the start when not given.")
    ] = None,
    steps: Annotated[int | None, typer.Option("--steps", min=0, help="Play this many steps from the state.")] = None,
    policy: Annotated[
        str, typer.Option("--policy", help="optimal, uniform, or auto: optimal where that is quick to find.")
    ] = "auto",
    gamma: Annotated[float, typer.Option("--gamma", min=0, max=1, help="Discount of the optimal policy.")] = 0.99,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the uniform policy, and of chance in the rules.")] = 0,
    fps: Annotated[float, typer.Option("--fps", min=0.1, max=50, help="Frames a second of a GIF.")] = 10.0,
    json: Json = False,
) -> None:
    """Draw a state (PNG) or an episode (GIF, or the state after --steps as PNG); in the terminal without --out."""
    from pharos import drawing, observations
    from pharos.system import storage

    goal = parse_target(target, parameters)
    suffix = check_format(out, (".png", ".gif", ".txt")) if out else ""
    options = parse_parameters(option)
    if observation != "text" and observation not in (renderers := observations.renderers()):
        raise UnknownName("observation to render", observation, [*renderers, "text"])
    if policy not in POLICIES:
        raise UnknownName("policy", policy, POLICIES)
    env = environment_of(goal)
    start = find_state(goal, env, state)
    if steps is None:
        steps = min(env.max_episode_steps, 200) if suffix == ".gif" else 0
    used, choose = (policy, None) if steps == 0 else find_policy(goal, env, policy, gamma, seed)
    played = drawing.episode(env, choose or (lambda _: 0), start, steps=steps, seed=seed)

    returned = sum(reward for _, _, reward in played)
    last = played[-1][0]
    if out is None and not json:
        print_in_color(env, last)
    elif out is not None and suffix == ".txt":
        frames = [drawing.text_drawing(env, each) for each, _, _ in played]
        storage.replace_file(out, "\n\n".join(frames) + "\n")
    elif out is not None and suffix == ".gif":
        shown = played if len(played) > 1 else [played[0]]
        pictures = [observations.render(env, each, observation, **options) for each, _, _ in shown]
        captions = _captions(env, shown) if observation == "human" else ()
        drawing.save_gif(out, pictures, captions=captions, frames_per_second=fps, at_least=_at_least(observation))
    elif out is not None:
        drawing.save_png(out, observations.render(env, last, observation, **options), at_least=_at_least(observation))
    if json:
        print_json(
            {
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
        )
    elif out is not None:
        after = f" after {len(played) - 1} steps of the {used} policy, return {returned:g}" if steps else ""
        print(f"{describe(env)}{after}: {out}")


def _at_least(observation: str) -> int:
    return 0 if observation == "human" else 400


def _captions(env: "Environment", played: Sequence[tuple]) -> list[str]:
    lines, total = [], 0.0
    for step, (_, action, reward) in enumerate(played):
        does = env.actions[action] if action >= 0 else ""
        lines.append(f"step {step}   return {total:g}   {does}")
        total += reward
    return lines


# Shared with `play` and `evaluate` ----------------------------------------------------------------------------------


def environment_of(target: Target) -> "Environment":
    """The environment of a target; ParameterError where there is none to draw."""
    return target.found_environment()


def find_state(target: Target, env: "Environment", text: str | None) -> "State":
    """The state that `--state` names: its number in the state space, or its values; the start state when not given."""
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
    """The name and the function of a policy; "auto" is optimal where the state space is small, else uniform."""
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


def print_in_color(env: "Environment", state: Sequence[int]) -> None:
    """The text drawing, in the colours of the layers where the terminal has them."""
    from pharos.cli.answers import console
    from pharos.drawing import colored_text

    console().print(colored_text(env, state))
