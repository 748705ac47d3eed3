"""Predicted regret of an agent behind an observation, before anything is trained: value, interval, order."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.agents import LAYER_OPTIONS, agent_called, check_hyperparameters, check_ranges, primary_predictors
from pharos.environments import Environment
from pharos.errors import MissingExtra, ParameterError, UnknownName
from pharos.prediction.calibration import COMMON, LEVEL, OrderCounts, Published, published
from pharos.prediction.learners import PrimaryRegret, primary_regret
from pharos.prediction.pilot import pilot_regret, plane
from pharos.system.storage import plain

if TYPE_CHECKING:
    from pharos.training import ChanceSetting


TAKEN = {
    "chance",
    "sticky",
    "random",
    "lazy",
    "reward_noise",
    "scale_rewards",
    "horizon",
    "hyperparameters",
}  # of TrainingOptions
NETWORKS_IN_ORDER = OrderCounts(pairs=16, right=5, clear_pairs=16, clear_right=5)
"""Pairs of a DQN's networks, three widths and depths behind each of ten observations, whose regrets differ:
benchmarks/prediction_choices.py.
"""
LEAST_RIGHT = 0.75
"""Share of published pairs below which an order is not called."""
MOST_STATES = 100_000
"""States beyond which a prediction is refused: its walks evaluate a policy of all states 31 times each."""


@dataclass(frozen=True, kw_only=True)
class PredictedRegret(PrimaryRegret):
    """Predicted regret of an agent with one network behind one observation.

    Attributes:
        observation: what the agent sees, with its options.
        low, high: ends of the interval that covered LEVEL of the published cells, at least 0. Also `lower` and `upper`.
        pilot: mean regret of a pilot so far, NaN without one. `value` is then what it and the idealised learner say.
        local_coverage, local_cells: share of the published cells predicted about as much (`REGRET_BINS`) that such
            intervals held where their class was left out, and the number of these cells.
    """

    observation: str
    low: float
    high: float
    pilot: float = math.nan
    local_coverage: float = math.nan
    local_cells: int = 0

    @property
    def lower(self) -> float:
        """Lower end of the interval."""
        return self.low

    @property
    def upper(self) -> float:
        """Upper end of the interval."""
        return self.high

    @property
    def label(self) -> str:
        """Observation and network."""
        return f"{self.observation}, {self.network}"

    def to_dict(self) -> dict[str, Any]:
        """The attributes, JSON-able."""
        return plain({**vars(self), "lower": self.lower, "upper": self.upper})


@dataclass(frozen=True)
class PairOrder:
    """Predicted order of two cells, and how often such an order was right.

    Attributes:
        easier, harder: labels. difference: of the predicted regrets.
        counts: of the published pairs whose predictions differ about as much. For networks, of all their pairs.
        of_networks: whether the cells differ in their networks.
    """

    easier: str
    harder: str
    difference: float
    counts: OrderCounts
    of_networks: bool = False

    @property
    def is_called(self) -> bool:
        """Whether the easier one had less regret often enough, in all published pairs of that difference."""
        return self.difference >= 0.05 and self.counts.right >= LEAST_RIGHT * max(self.counts.pairs, 1)

    @property
    def is_called_if_clear(self) -> bool:
        """Whether it had less regret often enough in those pairs whose regrets differ by more than 0.05."""
        return self.counts.clear_right >= LEAST_RIGHT * max(self.counts.clear_pairs, 1)

    def __str__(self) -> str:
        counts, (easier, harder) = self.counts, (self.easier, self.harder)
        if self.of_networks:
            return (
                f"{easier} or {harder}: not to be called, as predictions ordered networks rightly in "
                f"{counts.clear_right} of {counts.clear_pairs} pairs"
            )
        if self.is_called:
            return (
                f"{easier} is easier than {harder}: so in {counts.right} of {counts.pairs} such pairs, by more than "
                f"0.05 in {counts.clear_right}"
            )
        ties = f"{counts.pairs - counts.clear_pairs} of {counts.pairs} such pairs do not"
        if self.is_called_if_clear:
            return (
                f"{easier} is easier than {harder} if their regrets differ by more than 0.05: so in "
                f"{counts.clear_right} of {counts.clear_pairs} that did; {ties}"
            )
        return (
            f"{easier} or {harder}: too close to call; {ties} differ by more than 0.05, and {easier} was easier in "
            f"{counts.clear_right} of {counts.clear_pairs} that did"
        )

    def to_dict(self) -> dict[str, Any]:
        """The attributes, whether the order is called, and its text, JSON-able."""
        entry = {name: value for name, value in vars(self).items() if name != "counts"}
        return {**entry, **vars(self.counts), "called": self.is_called, "text": str(self)}


@dataclass(frozen=True)
class Prediction:
    """Predicted regrets of one instance.

    Attributes:
        environment, chance, agent, steps: what they are about. states: number of states.
        predictor: name of the measure that stands for the agent.
        cells: one for each observation and network, in the order in which they were asked for.
        half_width: half of the interval that covered LEVEL of the published cells. coverage: the share that such
            intervals covered of classes left out. published_cells, published_classes: numbers of both.
        warnings: ways in which the instance lies outside of what was tested.
        hyperparameters: of the agent.
    """

    environment: str
    chance: str
    agent: str
    steps: int
    states: int
    predictor: str
    cells: Sequence[PredictedRegret]
    half_width: float
    coverage: float
    published_cells: int
    published_classes: int
    warnings: Sequence[str] = ()
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)

    @property
    def orders(self) -> list[PairOrder]:
        """Orders of the easiest cell and each other one. The easiest is named first. None with pilots, as nobody has
        counted how often those are right.
        """
        if not math.isnan(self.cells[0].pilot):
            return []
        calibration, ranked = published(self.agent), sorted(self.cells, key=lambda cell: cell.value)
        easiest, orders = ranked[0], []
        for cell in ranked[1:]:
            difference, (easier, harder) = cell.value - easiest.value, self._names(easiest, cell)
            of_networks = easiest.network != cell.network and easiest.observation == cell.observation
            counts = NETWORKS_IN_ORDER if of_networks else calibration.ordered(difference)
            orders.append(PairOrder(easier, harder, difference, counts, of_networks))
        return orders

    def _names(self, first: PredictedRegret, second: PredictedRegret) -> tuple[str, str]:
        """Shortest names that tell two cells apart."""
        if first.observation == second.observation:
            return first.network, second.network
        is_named_by_both = len(self.cells) > len({cell.observation for cell in self.cells})
        return (first.label, second.label) if is_named_by_both else (first.observation, second.observation)

    def to_dict(self) -> dict[str, Any]:
        """The attributes, the orders and the level, JSON-able."""
        return {
            **vars(self),
            "cells": [cell.to_dict() for cell in self.cells],
            "orders": [order.to_dict() for order in self.orders],
            "level": LEVEL,
            "warnings": list(self.warnings),
            "hyperparameters": dict(self.hyperparameters),
        }

    def __str__(self) -> str:
        lines = [f"{cell.label}: {cell.value:.2f} ({cell.low:.2f} to {cell.high:.2f})" for cell in self.cells]
        return "\n".join([*lines, *map(str, self.orders), *self.warnings])


def predict(
    environment: Environment | str,
    observations: "str | Iterable[str | tuple[str, Mapping[str, Any]]]" = "vector",
    *,
    agent: str = "dqn",
    networks: "str | Callable[..., Any] | Iterable[Any] | None" = None,
    steps: int = 30_000,
    landmarks: int | None = None,
    common: bool = False,
    pilot: float | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Prediction:
    """Predict the regret of an agent behind each of some observations, before anything is trained.

    The agent's network is replaced by an idealised one, made of two kernels, in which the agent's own algorithm learns:
    `network_regret` for a DQN, `network_policy_regret` for a PPO. How far that agrees with runs: docs/prediction.md.

    Args:
        environment: a name, with its parameters as keywords, or an Environment, such as one's own or
            `pharos.importers.environment(mdp)`.
        observations: names as for `pharos.observe`, alone or with their options: ("hash", {"bits": 64}).
        agent: "dqn" or "ppo".
        networks: as for `pharos.observations.representation`, such as "mlp64x2" or a function of an input's shape that
            returns a torch.nn.Module. With several, each is used with each observation. Default: the agent's own.
        steps: of training.
        landmarks: as for `representation`. With some, the measures of before stand in for the predictors.
        common: use the hyperparameters of the published cells, in place of the class's.
        pilot: train one seed of the real agent for this share of the steps (0.1, 0.25 or 0.5), too. Values and
            intervals are then of the pilot and the idealised learner together.
        progress: called with what is being done.
        options: sticky, random, lazy, reward_noise, scale_rewards, horizon and hyperparameters, as for `pharos.train`,
            and parameters of the environment.
    Returns:
        A Prediction, whose cells have a value and an interval, and whose orders say which is easier.
    Raises:
        ParameterError: no such agent, observation or network, or more than MOST_STATES states.
        UndefinedMeasure: no policy beats uniform play, so that regret has no scale.
    Cost: seconds for each cell of a thousand states, see `network_regret`. Measures are kept beside the state space.
    """
    from pharos.agents import hyperparameters as hyperparameters_of
    from pharos.training import RunConfig, Task, TrainingOptions

    if pilot is not None and networks is not None:
        raise ParameterError("a pilot is of the agent's own network; expected no networks")
    calibration, joint = published(agent), None if pilot is None else plane(agent, pilot)
    covering = calibration if joint is None else joint.calibration
    training = TrainingOptions(**{name: value for name, value in options.items() if name in TAKEN})
    if training.horizon in (None, "none"):
        raise ParameterError("predictions are of episodes of some number of steps; found horizon none; give a number")
    parameters = {name: value for name, value in options.items() if name not in TAKEN}
    env, chance = Task.of(environment, parameters).env, training.chance
    unused = _unused_hyperparameters(agent, training.hyperparameters or {})
    overrides = {**(COMMON[agent] if common else {}), **(training.hyperparameters or {})}
    width, cells, states, spread = covering.half_width(), [], 0, math.nan
    # A cell for each observation and network
    views = [*_observations(observations)]
    for name, view in views:
        task = Task.of(env, chance=chance, observation=name, observation_options=view, horizon=training.horizon)
        states = _checked_states(task.space.num_states, env)
        settings = hyperparameters_of(agent, env.name, str(task.observation), overrides)
        config = RunConfig.of_task(task, agent, steps=steps, hyperparameters=settings).to_dict()
        _check_steps(config)
        for network in _several(networks):
            title = f"{name}({', '.join(f'{key}={value}' for key, value in view.items())})" if view else name
            if progress is not None:
                progress(f"predicting {agent} behind {title}")
            regret = primary_regret(config, task, network, landmarks)
            so_far = math.nan
            if joint is not None and pilot is not None:
                so_far = pilot_regret(agent, task, steps, settings, pilot)
                regret = replace(regret, value=joint.value(so_far, regret.value))
            low, high = max(0.0, regret.value - width), regret.value + width
            cells.append(
                PredictedRegret(
                    observation=title,
                    low=low,
                    high=high,
                    pilot=so_far,
                    local_coverage=covering.coverage(near=regret.value),
                    local_cells=int(covering.is_near(regret.value).sum()),
                    **vars(regret),
                )
            )
        if math.isnan(spread):  # in the unit that is paid
            spread = task.reference.spread() / task.scaled_chance.reward_scale
    if not cells:
        raise ParameterError("no observation to predict for; give at least one, such as 'vector'")
    return Prediction(
        environment=str(env),
        chance=str(chance),
        agent=agent,
        steps=steps,
        states=states,
        predictor=primary_predictors()[agent] + (f" and a pilot of {pilot * steps:,.0f} steps" if pilot else ""),
        cells=tuple(cells),
        half_width=width,
        coverage=covering.coverage(),
        published_cells=len(covering.predicted),
        published_classes=len(set(covering.classes)),
        warnings=(
            *_warnings(calibration, states, steps, spread, chance),
            *_stand_ins(agent, cells),
            *_other_hyperparameters(agent, settings),
            *unused,
            *[COINS] * any(view.get("irrelevant") for _, view in views),
        ),
        hyperparameters=settings,
    )


def regret_predictor(
    agent: str,
    environments: Iterable[Environment],
    *,
    steps: int,
    observation: str = "vector",
    chances: Iterable[Mapping[str, float]] = ({},),
) -> Callable[[Mapping[str, Any]], float]:
    """Return the function of hyperparameters that gives the predicted regret, a mean over environments and chances.

    For `pharos.training.tune(predicted=...)`: what the idealised learner knows is the learning rate, the discount, the
    exploration, the minibatches, the target network and the layers of a DQN, and the learning rate, the discount, the
    rollouts, epochs, minibatches, lambda, clipping, weights of losses and layers of a PPO.

    Args:
        agent: "dqn" or "ppo". environments, observation, steps: of the runs. chances: as for `tune`.
    Raises:
        ParameterError: another agent, or an environment of more than MOST_STATES states.
    Cost: as `predict`, for each environment and chance.
    """
    from pharos.training import ChanceSetting, RunConfig, Task

    published(agent)
    kinds = [ChanceSetting.from_dict(chance) for chance in chances]
    tasks = [Task(env, chance=kind, observation=observation) for env in environments for kind in kinds]
    for task in tasks:
        _checked_states(task.space.num_states, task.env)

    def predicted(hyperparameters: Mapping[str, Any]) -> float:
        def regret(task: Task) -> float:
            config = RunConfig.of_task(task, agent, steps=steps, hyperparameters=dict(hyperparameters))
            return primary_regret(config.to_dict(), task).value

        return float(np.mean([regret(task) for task in tasks]))

    return predicted


def _observations(observations: Any) -> list[tuple[str, dict[str, Any]]]:
    """(name, options) of each observation."""
    is_pair = isinstance(observations, tuple) and len(observations) == 2 and isinstance(observations[1], Mapping)
    if isinstance(observations, str) or is_pair:
        observations = [observations]
    return _each_once((each, {}) if isinstance(each, str) else (each[0], dict(each[1])) for each in observations)


def _several(networks: "str | Callable[..., Any] | Iterable[Any] | None") -> list[Any]:
    if networks is None or isinstance(networks, str) or callable(networks):
        return [networks]
    return _each_once(networks)


def _each_once(values: Iterable[Any]) -> list[Any]:
    every = list(values)
    return [value for i, value in enumerate(every) if value not in every[:i]]


def _checked_states(states: int, env: Environment) -> int:
    if states > MOST_STATES:
        raise ParameterError(
            f"{env} has {states:,} states; predictions are made for at most {MOST_STATES:,}: choose a smaller instance "
            f"of the class, whose representation is as hard"
        )
    return states


def _check_steps(config: Mapping[str, Any]) -> None:
    """Refuse a training that ends before anything is learnt."""
    steps, idealised = config["steps"], agent_called(config["agent"]).idealised
    idealised.check(config["hyperparameters"])
    min_steps, what = idealised.min_steps(config)
    if steps < min_steps:
        raise ParameterError(
            f"steps is {steps}, but {what} after {min_steps - 1:,} steps; expected at least {min_steps:,}"
        )


def _warnings(calibration: Published, states: int, steps: int, spread: float, chance: "ChanceSetting") -> Iterable[str]:
    """Warnings that the instance lies outside of the published cells."""
    for what, number, tested in (
        ("states", states, calibration.states),
        ("steps", steps, calibration.steps),
        ("is V* less the value of uniform play", spread, calibration.spreads),
    ):
        low, high = float(tested.min()), float(tested.max())
        if not low <= number <= high:
            words = f"only {low:,.6g} was tested" if low == high else f"tested were {low:,.6g} to {high:,.6g}"
            yield f"{number:,.6g} {what}: {words}, so the interval is not calibrated here"
    untested = [name for name in ("sticky", "lazy", "reward_noise") if getattr(chance, name)]
    if chance.random > 0.1:
        untested.append("random above 0.1")
    if untested:
        yield f"{', '.join(untested)}: not among the tested cells, so the interval is not calibrated here"


def _stand_ins(agent: str, cells: Iterable[PredictedRegret]) -> Iterable[str]:
    """A line if another measure stands in for the predictor."""
    predictor = primary_predictors()[agent]
    for measure in dict.fromkeys(cell.measure for cell in cells if cell.measure != predictor):
        labels = ", ".join(cell.label for cell in cells if cell.measure == measure)
        yield (
            f"{labels}: predicted by {measure}, as {predictor} is for at most 4,096 different observations without "
            "landmarks, and networks whose output layer is known; the interval is not calibrated here"
        )


COINS = "irrelevant entries are 0 in kernels, so what they do to an agent is not predicted"


def _unused_hyperparameters(agent: str, overrides: Mapping[str, Any]) -> list[str]:
    """A line if hyperparameters are no part of the idealised learner.

    Raises:
        UnknownName: nor has the agent one of them. ParameterError: a value is out of range.
    """
    from pharos.agents.batched import OWN_OPTIONS

    check_ranges(agent, overrides)
    own = agent_called(agent)
    names = {*COMMON[agent], *own.defaults, *own.space, *own.idealised.reads, *LAYER_OPTIONS}
    further = [name for name in overrides if name not in names]
    try:
        if further:
            check_hyperparameters(agent, {name: overrides[name] for name in further}, OWN_OPTIONS)
    except MissingExtra:
        raise UnknownName(f"hyperparameter of {agent}", further[0], sorted(names)) from None
    common = {**own.benchmark_defaults, **COMMON[agent]}
    read = (*own.idealised.reads, *LAYER_OPTIONS)
    unused = [name for name, value in overrides.items() if name not in read and common.get(name) != value]
    return [f"{', '.join(unused)}: no part of the idealised learner, which learns the same without"] if unused else []


def _other_hyperparameters(agent: str, settings: Mapping[str, Any]) -> Iterable[str]:
    """A line if hyperparameters differ from the published cells. What a class does not declare is the agent's."""
    own = {**agent_called(agent).benchmark_defaults, **settings}
    other = [name for name, value in COMMON[agent].items() if own.get(name) != value]
    if other:
        yield (
            f"{', '.join(other)}: not as in the published cells, for which the interval is calibrated; "
            "--hyperparameters common (in Python: common=True) predicts an agent with theirs"
        )
