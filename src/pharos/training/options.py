"""Options of training, declared once: for keywords of Python, flags of the command line, and configurations of runs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from pharos.environments import parameter
from pharos.mdp import ChanceSetting
from pharos.system.records import flat

ENGINES = ("sb3", "batched")
"""Engines that train networks: Stable-Baselines3, one run in a process; or many runs as one program."""


OBJECTIVES = ("total", "average")
"""Objectives beside values with a discount or a horizon: total reward, and the average reward of a step."""


@flat
@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options of training: the agent, its task, and the setting in which its policies are measured.

    Attributes:
        agent: q_learning, dqn, ppo, a2c, module:Class for Stable-Baselines3, or module:learn. Files of one's own are
            `file.py:Class` and `file.py:learn`.
        observation: vector, simple_image, complex_image, one_hot, index, number, hash, recorded, or your own. That is
            `module:name` or `file.py:name`. Tables see the index of the state.
        observation_options: option of the observation, such as size=natural.
        chance: of acting, and in how rewards are paid. Values, returns and regret are of what is earned.
        hyperparameters: hyperparameter of the agent, such as learning_rate=0.001. These go before what
            the agent and the class of environments declare. `train` also takes a YAML file of the same form, such as
            one that `tune` wrote.
        steps: steps to learn from.
        gamma: discount of values and returns. The agent's own discount is a hyperparameter.
        horizon: steps of an episode in values and returns, as `Horizon.of` reads it.
        objective: total: values and regret of the total reward, gamma 1 without a horizon. average: the curve also has
            the average reward of a step in the long run, and its regret.
        evaluation_interval: steps between evaluations. Default: a hundredth of the steps.
        engine: sb3 (Stable-Baselines3), or batched: many seeds as one program. The latter is pharos' own DQN and PPO.
    """

    agent: str = "q_learning"
    observation: str = "vector"
    observation_options: Mapping[str, Any] = field(default_factory=dict)
    chance: ChanceSetting = ChanceSetting()
    hyperparameters: Mapping[str, Any] | None = None
    steps: int = parameter(50_000, low=1)
    gamma: float = parameter(1.0, low=0, high=1)
    horizon: int | str | None = "limit"
    objective: str | None = None
    evaluation_interval: int | None = parameter(None, kind=int, low=1)
    engine: str = "sb3"


@dataclass(frozen=True, kw_only=True)
class ExecutionOptions:
    """Options of executing the runs of a study.

    Attributes:
        shard: only the I-th of N parts, such as 1/8. So N machines share a folder.
        retry_failed: execute failed runs again.
        resume: killed runs go on from their last checkpoint. Their results may then differ. That is for long runs on
            machines that come and go: a deep agent then ends elsewhere than without the interruption. Else killed runs
            start anew, and results never depend on it.
        timeout: seconds after which a run is ended, and failed. A batch gets as many for each of its runs.
        workers: processes. Default: as many as processors, one on a GPU, whose memory they would share.
        device: of batches: cpu or cuda. As torch names it.
        block: of this block alone, from 1. Again for another one.
        agent: of this agent alone. Again for another one.
        observation: of this observation alone. Again for another one.
    """

    shard: Annotated[str | None, "I/N"] = None
    retry_failed: bool = False
    resume: bool = False
    timeout: float | None = parameter(None, kind=float, low=0)
    workers: int | None = parameter(None, kind=int, low=1)
    device: str = "cpu"
    block: list[int] | None = None
    agent: list[str] | None = None
    observation: list[str] | None = None
