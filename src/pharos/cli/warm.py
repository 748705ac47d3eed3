"""pharos warm: compile beforehand what the other commands would compile as they go."""

import tempfile
from typing import TYPE_CHECKING, Annotated

import typer

from pharos.cli.answers import Answer, progress_line
from pharos.cli.options import complete_target
from pharos.cli.target import Target
from pharos.errors import StateSpaceTooLarge
from pharos.mdp import ChanceSetting
from pharos.system import compiling
from pharos.system.compiling import Stopwatch
from pharos.system.wording import many

if TYPE_CHECKING:
    from pharos.environments import Environment

# Small instances of the classes of the paper: all instances of a class share what is compiled.
USUAL: tuple[tuple[str, dict[str, int]], ...] = (
    ("simple_grid/4x4-plain", {}),
    ("frozen_lake/4x4", {}),
    ("freeway", {"num_cars": 2, "lane_length": 3}),
    ("breakout", {"height": 8, "columns": 5}),
)
STEPS = 50
LARGEST = 5_000_000


def warm(
    targets: Annotated[
        list[str] | None,
        typer.Argument(metavar="[ENVIRONMENT]...", autocompletion=complete_target, show_default=False),
    ] = None,
    *,
    chance: Annotated[ChanceSetting, "sticky random"],
) -> Answer:
    """Compile what building, solving, measuring, playing and Q-learning need, and keep it for later processes.

    Args:
        targets: Environments or named instances; small ones of the paper's four classes when not given.
    """
    environments = [Target(name).found_environment() for name in targets or ()]
    if not targets:
        from pharos.environments import make

        environments = [make(name, **parameters) for name, parameters in USUAL]
    seconds: dict[str, float] = {}
    watch = Stopwatch()
    compiling.SMALL = 0  # as if all of it were large
    with progress_line("compiling") as tell:
        for env in environments:
            tell(str(env))
            before = watch.compiling
            _use(env, chance)
            seconds[str(env)] = watch.compiling - before
    answer = {"environments": seconds, "seconds": watch.seconds, "compiling_seconds": watch.compiling}
    facts = [(name, f"{spent:.1f} s") for name, spent in seconds.items()]
    return Answer(answer, (f"compiled for {many(len(facts), 'environment')}, and kept", facts))


def _use(env: "Environment", chance: ChanceSetting) -> None:
    """Do a little of everything with an environment; a space beyond LARGEST states is stepped through alone."""
    from pharos import hardness, solvers, state_space
    from pharos.interaction import GymEnv, VectorEnv
    from pharos.training import train

    for observation in ("vector", "simple_image"):
        one = GymEnv(env, observation=observation, chance=chance)
        one.reset(seed=0)
        one.step(0)
        two = VectorEnv(env, 2, observation=observation, chance=chance)
        two.reset(seed=0)
        two.step([0, 0])
    with tempfile.TemporaryDirectory() as folder:
        try:
            space = state_space.build(env, f"{folder}/space", max_states=LARGEST, progress=False)
        except StateSpaceTooLarge:
            return
        mdp = chance.of(space.mdp(gamma=0.99))
        solvers.value_iteration(mdp)
        solvers.uniform_value(mdp)
        hardness.report(mdp, budget=10.0, keep=False)
    train("q_learning", env, steps=STEPS, gamma=0.99, horizon=None, evaluation_interval=STEPS, chance=chance)
