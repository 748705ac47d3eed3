"""pharos observations: what an agent sees, which states it cannot tell apart, and what that costs."""

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

from pharos.cli.answers import Answer, print_table, progress_bar, progress_line
from pharos.cli.options import Building, Gamma, Seconds, Target, discount
from pharos.errors import ParameterError
from pharos.mdp import ChanceSetting
from pharos.system.wording import pluralize

if TYPE_CHECKING:
    import numpy as np

    from pharos.mdp import TabularMDP
    from pharos.solvers import Solution
    from pharos.state_space import StateSpace

# States of the largest space that is solved to say what an observation costs
MOST_SOLVED = 5_000_000

# What is counted when nothing is asked for
COUNTED_OBSERVATIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("vector", {}),
    ("one_hot", {}),
    ("index", {}),
    ("simple_image", {}),
    ("complex_image", {}),
    ("simple_image", {"motion": True}),
    ("complex_image", {"motion": True}),
)


def observations(
    target: Target,
    *,
    observation: list[str] | None = None,
    option: Mapping[str, Any],
    gamma: Gamma = None,
    chance: Annotated[ChanceSetting, "random"],
    budget: Seconds = 10.0,
    building: Building,
) -> Answer:
    """Count the states that share their observation with another state, and bound what that costs.

    Args:
        observation: Count only for this observation, or for your own. Repeatable.
        option: Option of the observations that you name.
        budget: Seconds to bound what one observation costs. With 0 it is left out.
    """
    if option and not observation:
        raise ParameterError("--option goes with --observation NAME")
    choices = tuple((name, dict(option)) for name in observation) if observation else COUNTED_OBSERVATIONS
    space = target.space(building)
    env = space.environment
    if env is None:
        raise ParameterError(
            f"{target.target}: pharos does not know the class of this environment; name it as module:Class"
        )
    if not observation and not env.has_motion:
        choices = tuple((name, options) for name, options in choices if "motion" not in options)
    if not observation and env.recorded is not None:
        choices += (("recorded", {}),)
    price = _Price(space, discount(gamma, None), chance, budget)
    entries = [_entry(space, name, options, price, strict=bool(observation)) for name, options in choices]
    answer = {
        "environment": env.name,
        "parameters": env.parameters,
        "num_states": space.num_states,
        "num_terminal_states": int(space.terminal.sum()),
        "gamma": price.gamma,
        "random": chance.random,
        "observations": entries,
    }
    return Answer(answer, lambda: _print(target.title, space, entries, price))


class _Price:
    """Cost of observations for an agent without memory. The space is solved once, at the first query."""

    def __init__(self, space: "StateSpace", gamma: float, chance: ChanceSetting, budget: float):
        self.space, self.gamma, self.chance, self.budget = space, gamma, chance, budget

    def of(self, classes: "np.ndarray | None", num_confused: int) -> dict[str, Any] | None:
        """Bounds of the loss. None if not requested, if the space is too large, or with several frames."""
        if num_confused == 0:
            return {"lower": 0.0, "upper": 0.0, "exact": True}
        if classes is None or self.budget <= 0 or self.gamma >= 1 or self.space.num_states > MOST_SOLVED:
            return None
        from pharos.hardness import memoryless_loss

        with progress_line("bounding what it costs"):
            mdp, optimal = self._solved
            loss = memoryless_loss(mdp, classes, optimal=optimal, budget=self.budget)
        return {"lower": loss.lower, "upper": loss.upper, "exact": loss.exact}

    @cached_property
    def _solved(self) -> tuple["TabularMDP", "Solution"]:
        from pharos.solvers import value_iteration

        mdp = self.chance.of(self.space.mdp(gamma=self.gamma))
        return mdp, value_iteration(mdp, 1e-7)


def _entry(space: "StateSpace", name: str, options: dict[str, Any], price: _Price, *, strict: bool) -> dict[str, Any]:
    """Counts and cost of one observation.

    Args:
        strict: whether an observation that the environment does not have is an error. Otherwise it is said in the
            entry.
    """
    import numpy as np

    from pharos.hardness import aliasing_of_classes
    from pharos.observations import history_aliasing, observation_classes, observe

    entry: dict[str, Any] = {"observation": name, "options": options}
    env: Any = space.environment
    try:
        observer = observe(env, name, state_space=space, **options)
    except ParameterError as error:
        if strict:
            raise
        return entry | {"unavailable": str(error)}
    with progress_bar("observing", space.num_states, name) as progress:
        if observer.frames > 1:
            classes, counts = None, history_aliasing(space, observer, progress=progress)
        else:
            classes = observation_classes(space, observer, progress=progress)
            counts = aliasing_of_classes(classes, np.asarray(space.terminal))
    return entry | {
        "shape": list(observer.space.shape or ()),
        "dtype": str(observer.space.dtype),
        "num_observations": counts.num_observations,
        "num_sharing": counts.num_sharing,
        "share": counts.share,
        "num_confused": counts.num_confused,
        "loss": price.of(classes, counts.num_confused),
    }


def _print(title: str, space: "StateSpace", entries: list[dict[str, Any]], price: _Price) -> None:
    rows = []
    for entry in entries:
        if "unavailable" in entry:
            continue
        words = " ".join((entry["observation"], *(f"{name}={value}" for name, value in entry["options"].items())))
        shape = " x ".join(map(str, entry["shape"])) or "1"
        counts = (f"{entry[key]:,}" for key in ("num_observations", "num_sharing"))
        share, confused = f"{100 * entry['share']:.1f} %", f"{entry['num_confused']:,}"
        rows.append((words, shape, entry["dtype"], *counts, share, confused, _loss_text(entry["loss"])))
    frames = (
        "frames: different are stacks of frames; a state shares one where some history that ends in it looks as one "
        "that ends in another state"
    )
    print_table(
        title,
        (
            *("observation", "shape", "type", ">different", ">states that share one", ">share"),
            *(">where one acts", ">loses"),
        ),
        rows,
        before=[f"{pluralize(space.num_states, 'state')}, {int(space.terminal.sum()):,} of them terminal"],
        notes=[
            *(f"{entry['observation']}: {entry['unavailable']}" for entry in entries if "unavailable" in entry),
            *([frames] if any(entry["options"].get("frames", 1) != 1 for entry in entries) else []),
            "states that share one: terminal states count like others; where one acts: those that share one with "
            "another state, neither of them terminal",
            f"loses: optimal value at the start less that of the best deterministic policy without memory, discount "
            f"{price.gamma:g}, chance: {price.chance.in_words(space.has_chance)}",
        ],
    )


def _loss_text(loss: dict[str, Any] | None) -> str:
    """Exact to six digits, or an interval."""
    if loss is None:
        return "not bounded"
    lower, upper = (f"{loss[end]:.6g}" if loss[end] >= 1e-6 else "0" for end in ("lower", "upper"))
    return upper if loss["exact"] else f"{lower} to {upper}"
