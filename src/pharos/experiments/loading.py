"""The agent that a finished run has trained, read back for evaluation and for drawing."""

import os
from pathlib import Path
from typing import Any

from pharos.errors import FileFormatError
from pharos.experiments import results as _results
from pharos.experiments.config import RunConfig
from pharos.experiments.task import Task


def load_agent(folder: str | os.PathLike) -> tuple[Task, Any]:
    """The task of a finished run, and what it learnt, as `evaluate_agent` and `pharos.evaluate_policy` take it.

    Returns:
        The task, and (S,) actions of tabular agents, else the policy of the model.
    Raises:
        FileFormatError: the folder holds no finished run. ResultCorrupted: its files were cut short or changed.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    import numpy as np

    folder = Path(folder)
    record = _results.read_record(folder)
    config = RunConfig.from_dict(record["config"])
    if record.get("status") != "finished":
        raise FileFormatError(
            f"{folder}: the run is {record.get('status')}; the same command that began it finishes it"
        )
    _results.check_agent(folder)
    task = config.task()
    if config.is_tabular:
        try:
            return task, np.load(folder / "policy.npy", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FileFormatError(f"{folder / 'policy.npy'}: cannot be read: {error}") from error
    from pharos.experiments.learners import Deep

    learner = Deep(config.agent, task, record["hyperparameters"], config.steps, config.seed, None)
    learner.load(folder / "agent")
    return task, learner.agent
