"""Idealised learners: what `pharos.predict` computes in the place of an agent, from the configuration of a run.

Each says which network stands for the agent's, what it draws, and which columns a prediction has.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pharos.hardness import Result, Rollouts, Schedule
    from pharos.mdp import TabularMDP

POLICY_PREDICTORS = (
    *("policy_regret", "policy_regret_played", "policy_tabular_regret"),
    *("policy_regret_evaluated", "clipped_regret", "clipped_regret_evaluated", "clipped_tabular_regret"),
)
"""Columns of predictions of an actor-critic: `kernel_policy_regret`, as played, of a table, as evaluated; and of PPO
with its clipping, of the most probable actions, as evaluated, and of a table."""
SAMPLED_PREDICTORS = ("sampled_regret", "sampled_deviation", "sampled_descent", "sampled_adam", "sampled_tabular")
"""Columns of predictions of a DQN: the sampled learner, one walk's deviation, its two kernels, and a table's."""
HUBER_PREDICTORS = ("huber_regret", "huber_deviation", "huber_descent", "huber_adam", "huber_tabular")
"""The same of the sampled learner with the Huber loss that begins at a random network."""
POLICY_CURVES = ("policy_curve", "clipped_curve")
CURVE_POINTS = 40

Configuration = Mapping[str, Any]
"""The configuration of a run with all hyperparameters, as run.json keeps it."""


@dataclass(frozen=True, kw_only=True)
class Idealised:
    """The idealised learner of an agent without one of its own: the kernel of an actor-critic's network. Base class.

    Attributes:
        kind: "dqn", "ppo", "table" or "both", the one that the benchmark compares the agent with.
        predictor: the column that stands for the agent, named before the runs of a sealed test. Empty if there is none.
        initialisation: of the network, see `pharos.observations.representation`.
        suffix: of the network's name.
        large_unit, large_unit_miss: V* - U from which on the agent was worse than predicted on published cells, and by
            how much regret in the mean. The prediction does not depend on the unit of rewards.
    """

    kind: str = "both"
    predictor: str = ""
    initialisation: str = "sb3"
    suffix: str = "+tanh"
    large_unit: float = math.inf
    large_unit_miss: float = 0.0

    def schedule(self, config: Configuration) -> "Schedule":
        """The schedule of the agent."""
        from pharos.hardness import Schedule

        return Schedule(steps=config["steps"])

    def min_steps(self, config: Configuration) -> tuple[int, str]:
        """(steps before which nothing is learnt, what happens after them)."""
        return 1, "learning begins"

    def columns(self, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> dict[str, Any]:
        """Columns of a prediction beside the kernel's.

        Args:
            options: of `pharos.hardness.report`, with the representation.
        """
        return {}

    def primary(self, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> "Result":
        """The result that `predictor` is a number of."""
        raise NotImplementedError

    def primary_columns(self, value: Mapping[str, Any] | None) -> dict[str, Any]:
        """Columns of the value of `primary`, NaN if there is none."""
        return {}

    def regret(self, value: Mapping[str, Any]) -> float:
        """Normalised regret of the learnt policies, from the value of `primary`."""
        return float(value["value"])


@dataclass(frozen=True, kw_only=True)
class IdealisedDQN(Idealised):
    """The learner that draws what a DQN draws, with its loss and its start: `huber_regret`."""

    kind: str = "dqn"
    predictor: str = "huber_regret"
    initialisation: str = "pytorch"
    suffix: str = ""

    def schedule(self, config: Configuration) -> "Schedule":
        from pharos.hardness import Schedule

        hyperparameters = config["hyperparameters"]
        same = ("learning_starts", "exploration_initial_eps", "exploration_final_eps", "exploration_fraction", "gamma")
        options = {name: hyperparameters[name] for name in same if name in hyperparameters}
        period, every = int(hyperparameters.get("target_update_interval", 250)), hyperparameters.get("train_freq", 4)
        every = every if isinstance(every, int) else 4
        copies = int(hyperparameters.get("gradient_steps", 1))
        steps = max(1, round(period * (copies / every if copies > 0 else 1.0)))
        return Schedule(steps=config["steps"], period=period, gradient_steps=steps, **options)

    def min_steps(self, config: Configuration) -> tuple[int, str]:
        return int(config["hyperparameters"].get("learning_starts", 0)) + 1, "learning begins"

    def columns(self, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> dict[str, Any]:
        sampled = self._result("sampled_regret", config, mdp, options).value
        return {**_parts(SAMPLED_PREDICTORS, sampled), **self.primary_columns(self.primary(config, mdp, options).value)}

    def primary(self, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> "Result":
        return self._result(self.predictor, config, mdp, options)

    def _result(self, measure: str, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> "Result":
        from pharos.hardness import Sampling, report

        hyperparameters, chance = config["hyperparameters"], config["chance"]
        sizes = {name: int(hyperparameters[name]) for name in ("batch_size", "buffer_size") if name in hyperparameters}
        noise, scale = float(chance.get("reward_noise", 0.0)), float(chance.get("scale_rewards") or 1.0)
        sampling = Sampling(reward_noise=noise, reward_scale=scale, **sizes)
        return report(mdp, [measure], schedule=self.schedule(config), sampling=sampling, **options)[measure]

    def primary_columns(self, value: Mapping[str, Any] | None) -> dict[str, Any]:
        return _parts(HUBER_PREDICTORS, value)


@dataclass(frozen=True, kw_only=True)
class IdealisedActorCritic(Idealised):
    """The idealised actor-critic: `kernel_policy_regret`.

    Attributes:
        gae_lambda, clip_range: of the agent if its hyperparameters do not say. Without clip_range it has no clipping.
    """

    kind: str = "ppo"
    gae_lambda: float = 0.95
    clip_range: float | None = None

    def rollouts(self, config: Configuration) -> "Rollouts":
        """Rollouts of the agent, with its clipping."""
        from pharos.hardness import Rollouts

        own = {"gae_lambda": self.gae_lambda, "clip_range": self.clip_range}
        hyperparameters = {**own, **config["hyperparameters"]}
        steps = int(hyperparameters["n_steps"]) * int(hyperparameters.get("n_envs", 1))
        minibatches = math.ceil(steps / int(hyperparameters["batch_size"])) if hyperparameters.get("batch_size") else 1
        gradient_steps = minibatches * int(hyperparameters.get("n_epochs", 1))
        return Rollouts(steps=steps, gradient_steps=gradient_steps, **{name: hyperparameters[name] for name in own})

    def min_steps(self, config: Configuration) -> tuple[int, str]:
        return self.rollouts(config).steps, "the first rollout ends"

    def columns(self, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> dict[str, Any]:
        rollouts = self.rollouts(config)
        regret = self._result(config, mdp, replace(rollouts, clip_range=None), options).value
        clipped = None if rollouts.clip_range is None else self.primary(config, mdp, options).value
        row = self.primary_columns(None)
        if regret is not None:
            numbers = (regret["value"], regret["played"], regret["tabular"], self.regret(regret))
            row |= {**dict(zip(POLICY_PREDICTORS, numbers, strict=False)), "policy_curve": curve_points(regret)}
        return row | ({} if clipped is None else self._clipped_columns(clipped))

    def primary(self, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> "Result":
        return self._result(config, mdp, self.rollouts(config), options)

    def _result(
        self, config: Configuration, mdp: "TabularMDP", rollouts: "Rollouts", options: Mapping[str, Any]
    ) -> "Result":
        from pharos.hardness import Schedule, report

        name = "kernel_policy_regret"
        schedule = Schedule(steps=config["steps"], gamma=config["hyperparameters"].get("gamma", Schedule.gamma))
        return report(mdp, [name], schedule=schedule, rollouts=rollouts, **options)[name]

    def primary_columns(self, value: Mapping[str, Any] | None) -> dict[str, Any]:
        row = {**dict.fromkeys(POLICY_PREDICTORS, math.nan), **dict.fromkeys(POLICY_CURVES, "")}
        return row if value is None else row | self._clipped_columns(value)

    def _clipped_columns(self, regret: Mapping[str, Any]) -> dict[str, Any]:
        numbers = {"clipped_regret": regret["value"], "clipped_regret_evaluated": self.regret(regret)}
        return numbers | {
            "clipped_tabular_regret": regret["tabular"],
            "clipped_curve": curve_points(regret, "played"),
        }

    def regret(self, value: Mapping[str, Any]) -> float:
        """Mean regret as evaluated, `LearningCurve.mean_evaluated`, computed anew: older results lack it."""
        from pharos.hardness import LearningCurve

        return LearningCurve(**{name: np.asarray(values) for name, values in value["curve"].items()}).mean_evaluated


def _parts(names: Sequence[str], value: Mapping[str, Any] | None) -> dict[str, float]:
    """Columns of a sampled learner's value: the mean, one walk's deviation, both kernels, a table. NaN if None."""
    parts = ("value", "deviation", "descent", "adam", "tabular")
    numbers = dict.fromkeys(parts, math.nan) | dict(value or {})
    return {name: numbers[part] for name, part in zip(names, parts, strict=True)}


def curve_points(regret: Mapping[str, Any], of: str = "greedy") -> str:
    """Steps and regret of an idealised learner, of at most CURVE_POINTS of its phases, as JSON."""
    steps, regrets = regret["curve"]["steps"], regret["curve"][of]
    every = max(1, math.ceil(len(steps) / CURVE_POINTS))
    return json.dumps(
        [[int(step), round(value, 4)] for step, value in zip(steps[::every], regrets[::every], strict=True)]
    )
