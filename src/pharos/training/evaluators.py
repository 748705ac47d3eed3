"""Evaluation beside learning: processes evaluate the policies of a program while it goes on learning.

If a GPU trains many runs at once, their exact evaluation would take most of the time of the process that learns. So it
hands over the parameters of all networks at each point, learns on, and has the values at the next one. They are those
that it would have computed on the processor itself, to the last bit.
"""

import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any, Protocol, runtime_checkable

import numpy as np

from pharos.agents import Learner, agent_called
from pharos.errors import PharosError
from pharos.policies import Evaluation
from pharos.system.wording import in_one_line
from pharos.system.workers import Workers, is_in_main, one_thread, usable_workers
from pharos.training.curve import evaluate_agent, joint_values
from pharos.training.schedule import PreparedRun, TaskCache, lanes
from pharos.training.task import RunConfig

FEWEST = 8
"""Runs whose evaluations take longer than processes take to begin."""
Parameters = Mapping[str, np.ndarray]


@runtime_checkable
class NetworkLearner(Learner, Protocol):
    """A learner whose policies depend on the parameters of networks alone."""

    def parameters(self, i: int) -> Parameters:
        """The network of run i."""

    def set_parameters(self, i: int, parameters: Parameters) -> None:
        """Replace the network of run i, so that `policy` is the one of `parameters`."""


def evaluates_apart(device: str, runs: Sequence[PreparedRun]) -> bool:
    """Whether the policies of runs that learn joint are evaluated in processes of their own.

    Never if these would have to import the user's script, which may have no guard.
    """
    return device != "cpu" and len(runs) >= FEWEST and not is_in_main(*runs[0].config.definitions)


class Evaluators:
    """Processes that share the evaluations of a program, each of some runs.

    Attributes:
        workers: to be entered and left.
    """

    def __init__(self, learner: NetworkLearner, runs: Sequence[PreparedRun]):
        self.learner = learner
        number = min(len(runs), max(1, usable_workers(None) - 1))
        self.parts = [part.tolist() for part in np.array_split(np.arange(len(runs)), number)]
        self.workers, self.senders = Workers(), []
        for key, part in enumerate(self.parts):
            receiver, sender = multiprocessing.Pipe(duplex=False)
            configs = [runs[i].config.to_dict() for i in part]
            with one_thread():
                self.workers.start(str(key), _evaluate, (configs, receiver), runs[0].config.definitions)
            receiver.close()
            self.senders.append(sender)

    def begin(self) -> None:
        """Begin to evaluate the present policies. The values of earlier ones have been fetched."""
        for part, sender in zip(self.parts, self.senders, strict=True):
            with contextlib.suppress(BrokenPipeError):  # `values` finds that the process has ended
                sender.send([self.learner.parameters(i) for i in part])

    def values(self) -> dict[int, Evaluation | PharosError]:
        """Values of the policies by run, or why they have none. Waits for them. PharosError: a process has ended."""
        values: dict[int, Evaluation | PharosError] = {}
        while len(values) < sum(map(len, self.parts)):
            for key, event in self.workers.events():
                if not isinstance(event, list):
                    raise PharosError(
                        f"a process that evaluates ended with exit code {event}; was there memory enough?"
                    )
                values.update(zip(self.parts[int(key)], event, strict=True))
        return values


def _evaluate(configs: Sequence[dict[str, Any]], receiver: Connection, send: Callable[[list], None]) -> None:
    """Body of a process: for each list of parameters that comes, send the values of these policies."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    tasks = TaskCache(trust=True)  # of code that the process which started this one has imported
    runs = [PreparedRun(None, RunConfig.from_dict(config), None, tasks) for config in configs]
    for run in runs:
        run.prepare()
    groups = lanes([run.key for run in runs], [len(runs)] * len(runs))
    learners = [_learner([runs[i] for i in group]) for group in groups]
    values: dict[int, Evaluation | PharosError] = {}
    with contextlib.suppress(EOFError):  # nothing more comes
        while parameters := receiver.recv():
            for group, learner in zip(groups, learners, strict=True):
                for i, index in enumerate(group):
                    learner.set_parameters(i, parameters[index])
                joint = joint_values(learner, [runs[index] for index in group])
                for i, index in enumerate(group):
                    try:
                        values[index] = joint.get(i) or evaluate_agent(learner.policy(i), runs[index].task, again=True)
                    except Exception as error:
                        values[index] = PharosError(in_one_line(error))
            send([values[i] for i in range(len(runs))])


def _learner(runs: Sequence[PreparedRun]) -> NetworkLearner:
    learner = agent_called(runs[0].config.agent).learner(runs, "cpu")
    assert isinstance(learner, NetworkLearner)
    return learner
