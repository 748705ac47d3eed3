"""Idealised learners: what `pharos.predict` computes in the place of an agent, from the configuration of a run.

Each says which network stands for the agent's, what it draws, and which columns a prediction has.
"""

import json
import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.errors import ParameterError

if TYPE_CHECKING:
    from pharos.hardness import Adam, Result, Rollouts, Schedule
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
NETWORK_PREDICTORS = ("network_regret", "network_deviation", "network_tabular_regret")
"""The same of a DQN in an idealised network: `network_regret`, one walk's deviation, a table's."""
NETWORK_POLICY_PREDICTORS = tuple(name.replace("network", "network_policy") for name in NETWORK_PREDICTORS)
"""The same of a PPO: `network_policy_regret`."""
POLICY_CURVES = ("policy_curve", "clipped_curve")
NETWORK_CURVE = "network_curve"
CURVE_POINTS = 40

LAYER_OPTIONS = ("net_arch", "policy_kwargs")

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
        earlier: columns of earlier predictors, NaN where the predictor alone is computed.
        fallback: the measure in its place for a network whose output layer is not known, and for more different
            observations than it is for.
        reads: the agent's hyperparameters that it learns by, numbers. `LAYER_OPTIONS` are read with the network.
    """

    kind: str = "both"
    predictor: str = ""
    initialisation: str = "sb3"
    suffix: str = "+tanh"
    fallback: str = ""
    earlier: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()

    def check(self, hyperparameters: Mapping[str, Any]) -> None:
        """ParameterError: a hyperparameter that it reads is no number, such as a schedule. None is no clipping."""
        for name in self.reads:
            value = hyperparameters.get(name, 0)
            if not isinstance(value, numbers.Real) and (name, value) != ("clip_range", None):
                raise ParameterError(f"{name} is {value!r}; expected a number, as predictions are of one that stays")

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
        """The result that `predictor` is a number of, or its fallback."""
        from pharos.hardness import is_for_networks

        is_known = is_for_networks(options["representation"])
        return self.result(self.predictor if is_known else self.fallback, config, mdp, options)

    def result(self, measure: str, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> "Result":
        """The result of a measure of the idealised learner."""
        raise NotImplementedError

    def primary_columns(self, measure: str, value: Mapping[str, Any] | None) -> dict[str, Any]:
        """Columns of the value of a measure of `primary`, NaN if there is none."""
        return {}

    def regret(self, value: Mapping[str, Any]) -> float:
        """Normalised regret of the learnt policies, from the value of `primary`."""
        return float(value["value"])


@dataclass(frozen=True, kw_only=True)
class IdealisedDQN(Idealised):
    """A DQN in an idealised network: `network_regret`."""

    kind: str = "dqn"
    predictor: str = "network_regret"
    fallback: str = "huber_regret"
    earlier: tuple[str, ...] = HUBER_PREDICTORS
    initialisation: str = "pytorch"
    suffix: str = ""
    reads: tuple[str, ...] = (
        *("learning_rate", "max_grad_norm", "gamma", "batch_size", "buffer_size", "learning_starts", "train_freq"),
        *("gradient_steps", "target_update_interval"),
        *("exploration_initial_eps", "exploration_final_eps", "exploration_fraction"),
    )

    def check(self, hyperparameters: Mapping[str, Any]) -> None:
        super().check({**hyperparameters, "train_freq": _steps_between(hyperparameters.get("train_freq", 4))})

    def schedule(self, config: Configuration) -> "Schedule":
        from pharos.hardness import Schedule

        hyperparameters = config["hyperparameters"]
        same = ("learning_starts", "exploration_initial_eps", "exploration_final_eps", "exploration_fraction", "gamma")
        options = {name: hyperparameters[name] for name in same if name in hyperparameters}
        period = int(hyperparameters.get("target_update_interval", 250))
        every = _steps_between(hyperparameters.get("train_freq", 4))
        copies = int(hyperparameters.get("gradient_steps", 1))
        steps = max(1, round(period * (copies / every if copies > 0 else 1.0)))
        return Schedule(steps=config["steps"], period=period, gradient_steps=steps, **options)

    def min_steps(self, config: Configuration) -> tuple[int, str]:
        return int(config["hyperparameters"].get("learning_starts", 0)) + 1, "learning begins"

    def columns(self, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> dict[str, Any]:
        sampled = self.result("sampled_regret", config, mdp, options).value
        row = _parts(SAMPLED_PREDICTORS, sampled)
        results = [self.primary(config, mdp, options)]
        if results[0].name != self.fallback:
            results.append(self.result(self.fallback, config, mdp, options))
        for result in results:
            row |= self.primary_columns(result.name, result.value)
        return row

    def result(self, measure: str, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> "Result":
        from pharos.hardness import NETWORK_WALKS, Sampling, report

        hyperparameters, chance = config["hyperparameters"], config["chance"]
        sizes = {name: int(hyperparameters[name]) for name in ("batch_size", "buffer_size") if name in hyperparameters}
        drawn: dict[str, Any] = {"sampling": Sampling(**_paid(chance), **sizes)}
        if measure == self.predictor:
            drawn["sampling"] = replace(drawn["sampling"], walks=NETWORK_WALKS)
            drawn["adam"] = _adam(hyperparameters, max_grad_norm=10.0)
        return report(mdp, [measure], schedule=self.schedule(config), **drawn, **options)[measure]

    def primary_columns(self, measure: str, value: Mapping[str, Any] | None) -> dict[str, Any]:
        if measure == self.fallback:
            return _parts(HUBER_PREDICTORS, value)
        return _network_columns(NETWORK_PREDICTORS, value)


@dataclass(frozen=True, kw_only=True)
class IdealisedActorCritic(Idealised):
    """The idealised actor-critic: `kernel_policy_regret`.

    Attributes:
        gae_lambda, clip_range: of the agent if its hyperparameters do not say. Without clip_range it has no clipping.
    """

    kind: str = "ppo"
    earlier: tuple[str, ...] = POLICY_PREDICTORS
    reads: tuple[str, ...] = (
        *("learning_rate", "max_grad_norm", "gamma", "gae_lambda", "n_steps", "n_envs", "batch_size", "n_epochs"),
        *("clip_range", "ent_coef", "vf_coef"),
    )
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
        regret = self._kernel_result(config, mdp, replace(rollouts, clip_range=None), options).value
        row: dict[str, Any] = {**dict.fromkeys(POLICY_PREDICTORS, math.nan), **dict.fromkeys(POLICY_CURVES, "")}
        if regret is not None:
            numbers = (regret["value"], regret["played"], regret["tabular"], self.regret(regret))
            row |= {**dict(zip(POLICY_PREDICTORS, numbers, strict=False)), "policy_curve": curve_points(regret)}
        if rollouts.clip_range is not None:
            row |= self._clipped_columns(self._kernel_result(config, mdp, rollouts, options).value)
        if self.predictor:
            result = self.primary(config, mdp, options)
            row |= self.primary_columns(result.name, result.value) if result.name == self.predictor else {}
        return row

    def result(self, measure: str, config: Configuration, mdp: "TabularMDP", options: Mapping[str, Any]) -> "Result":
        from pharos.hardness import NETWORK_WALKS, Sampling, report

        rollouts, hyperparameters = self.rollouts(config), config["hyperparameters"]
        if measure != self.predictor:
            return self._kernel_result(config, mdp, rollouts, options)
        rollouts = replace(
            rollouts,
            environments=int(hyperparameters.get("n_envs", 1)),
            epochs=int(hyperparameters.get("n_epochs", 1)),
            entropy_weight=float(hyperparameters.get("ent_coef", 0.0)),
            value_weight=float(hyperparameters.get("vf_coef", 0.5)),
        )
        adam = _adam(hyperparameters, max_grad_norm=0.5, epsilon=1e-5)
        sampling = Sampling(walks=NETWORK_WALKS, **_paid(config["chance"]))
        drawn: dict[str, Any] = {"rollouts": rollouts, "sampling": sampling, "adam": adam}
        return report(mdp, [measure], schedule=self._steps(config), **drawn, **options)[measure]

    def _steps(self, config: Configuration) -> "Schedule":
        """The schedule with the agent's steps and discount."""
        from pharos.hardness import Schedule

        return Schedule(steps=config["steps"], gamma=config["hyperparameters"].get("gamma", Schedule.gamma))

    def _kernel_result(
        self, config: Configuration, mdp: "TabularMDP", rollouts: "Rollouts", options: Mapping[str, Any]
    ) -> "Result":
        from pharos.hardness import report

        name = "kernel_policy_regret"
        return report(mdp, [name], schedule=self._steps(config), rollouts=rollouts, **options)[name]

    def primary_columns(self, measure: str, value: Mapping[str, Any] | None) -> dict[str, Any]:
        if measure == self.predictor:
            return _network_columns(NETWORK_POLICY_PREDICTORS, value)
        return self._clipped_columns(value)

    def _clipped_columns(self, regret: Mapping[str, Any] | None) -> dict[str, Any]:
        if regret is None:
            return {}
        numbers = {"clipped_regret": regret["value"], "clipped_regret_evaluated": self.regret(regret)}
        return numbers | {
            "clipped_tabular_regret": regret["tabular"],
            "clipped_curve": curve_points(regret, "played"),
        }

    def regret(self, value: Mapping[str, Any]) -> float:
        """Mean regret as evaluated; of the kernel's learner computed anew from its curve, as older results lack it."""
        from pharos.hardness import LearningCurve

        if "played" not in value["curve"]:
            return float(value["value"])
        return LearningCurve(**{name: np.asarray(values) for name, values in value["curve"].items()}).mean_evaluated


def _steps_between(train_freq: object) -> int:
    """Steps from one update to the next: 4 of 4 and of [4, "step"], as Stable-Baselines3 writes it too.

    Raises:
        ParameterError: it is something else, such as episodes.
    """
    is_pair = isinstance(train_freq, list | tuple) and len(train_freq) == 2 and train_freq[1] == "step"
    steps = train_freq[0] if is_pair else train_freq  # type: ignore[index]
    if not isinstance(steps, numbers.Integral):
        raise ParameterError(f"train_freq is {train_freq!r}; expected a number of steps, as predictions are of steps")
    return int(steps)


def _adam(hyperparameters: Mapping[str, Any], **defaults: float) -> "Adam":
    """Adam of an agent. defaults: of Stable-Baselines3, if its hyperparameters do not say."""
    from pharos.hardness import Adam

    own = {name: hyperparameters[name] for name in ("learning_rate", "max_grad_norm") if name in hyperparameters}
    return Adam(**{**defaults, **{name: float(value) for name, value in own.items()}})


def _paid(chance: Mapping[str, Any]) -> dict[str, Any]:
    """Noise and scale of the rewards that are paid, as `Sampling` has them."""
    noise, scale = float(chance.get("reward_noise", 0.0)), float(chance.get("scale_rewards") or 1.0)
    return {"reward_noise": noise, "reward_scale": scale}


def _network_columns(names: Sequence[str], value: Mapping[str, Any] | None) -> dict[str, Any]:
    """Columns of the value of an idealised network: the mean, one walk's deviation, a table's; and its curve."""
    numbers: dict[str, Any] = dict.fromkeys(names, math.nan) | {NETWORK_CURVE: ""}
    if value is None:
        return numbers
    of_value = (value["value"], value.get("deviation", math.nan), value["tabular"])
    return {**dict(zip(names, of_value, strict=True)), NETWORK_CURVE: curve_points(value)}


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
