"""pharos render: a picture of a state, or of a played episode."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import Answer, complain, console, describe
from pharos.cli.options import Discount, Seed, file_ending, parse_value
from pharos.cli.target import Target
from pharos.errors import ParameterError, PharosError, UnknownName

if TYPE_CHECKING:
    from pharos.environments import Environment, State

POLICIES = ("auto", "optimal", "uniform")
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
    """Draw a state (PNG) or an episode (GIF, or the state after --steps as PNG); in the terminal without --out.

    Args:
        observation: How to draw: human, text, simple_image, complex_image, or your own.
        option: Option of the observation, such as size=natural.
        out: FILE.png, FILE.gif or FILE.txt; the terminal when not given.
        state: Number of a state, or its values 2,3,1; the start when not given.
        steps: Play this many steps from the state.
        policy: optimal, uniform, or auto: optimal where that is quick to find.
        gamma: Discount of the optimal policy.
        seed: Of the uniform policy, and of chance in the rules.
        fps: Frames a second of a GIF.
    """
    from pharos import drawing, observations
    from pharos.system import storage

    suffix = out.suffix.lower() if out else ""
    if observation != "text" and observation not in (renderers := observations.renderers()):
        raise UnknownName("observation to render", observation, [*renderers, "text"])
    if policy not in POLICIES:
        raise UnknownName("policy", policy, POLICIES)
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
        storage.replace_file(out, "\n\n".join(frames) + "\n")
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


# Shared with `play` and `evaluate` ----------------------------------------------------------------------------------


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
