"""The agent that a finished run has trained, read back for evaluation and for drawing."""

import os
from pathlib import Path
from typing import Any

from pharos.errors import FileFormatError, UntrustedCode
from pharos.system.storage import check_regular
from pharos.training import results as _results
from pharos.training.config import RunConfig
from pharos.training.task import Task


def load_agent(folder: str | os.PathLike, *, trust: bool = False) -> tuple[Task, Any]:
    """The task of a finished run, and what it learnt, as `evaluate_agent` and `pharos.evaluate_policy` take it.

    Args:
        trust: whether code that the run names may be imported: an environment, observation or agent of its own. What
            this process has imported already, such as the environment that a command names, needs no trust.
    Returns:
        The task, and (S,) actions of tabular agents, else the policy of the model.
    Raises:
        FileFormatError: the folder holds no finished run. ResultCorrupted: its files were cut short or changed.
        UntrustedCode: the run names code, and is not trusted.
        MissingExtra: Stable-Baselines3 is not installed.
    """
    import numpy as np

    folder = Path(folder)
    record = _results.read_record(folder)
    if record.get("status") != "finished":
        raise FileFormatError(
            f"{folder}: the run is {record.get('status')}; the same command that began it finishes it"
        )
    _results.check_agent(folder)
    try:
        config = RunConfig.from_dict(record["config"])
        task = config.task(trust=trust)
        agent = config.algorithm(trust=trust)
    except UntrustedCode as error:
        raise UntrustedCode(f"{folder / 'run.json'}: {error}") from error
    except FileFormatError as error:
        raise FileFormatError(f"{folder / 'run.json'}: {error}") from error
    if config.is_tabular:
        try:
            check_regular(folder / "policy.npy")
            return task, np.load(folder / "policy.npy", allow_pickle=False)
        except Exception as error:  # the header is read as Python
            raise FileFormatError(f"{folder / 'policy.npy'}: cannot be read: {error}") from error
    from pharos.training.learners import Deep

    learner = Deep(agent, task, record["hyperparameters"], config.steps, config.seed, None)
    learner.load(folder / "agent")
    return task, learner.agent
