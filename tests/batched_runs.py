"""Runs of the batched engine: made of a task, learnt to their end, and what they leave."""

import numpy as np

from pharos.agents.batched import BatchRun, ObservationSource, make_batch
from pharos.kernels import batched

RUN = 1  # the one of a lane that is looked at


def runs_of(task, hyperparameters, number=3, steps=120, first_key=2**40, apart=977):
    source = ObservationSource.of(task.space, task.observer.observe)
    keys = [first_key + apart * i for i in range(number)]
    return [BatchRun(task.mdp, source, task.time_limit, hyperparameters, steps, i, key) for i, key in enumerate(keys)]


def learned(agent, runs, points=(60, 120), **options):
    batch = make_batch(agent, runs, **options)
    batch.learn(points, lambda point: None)
    return batch


def outcome(batch, i):
    """All that a run leaves behind, as bytes."""
    parts = [value.tobytes() for value in batch.parameters(i).values()]
    return b"".join([*parts, batch.episodes[i].tobytes(), batch.returns[i].tobytes()])


def difference(one, other):
    """The largest difference between parameters of two runs, by name."""
    return max(np.abs(one[name] - other[name]).max() for name in one)


def updates_of(lane, names, monkeypatch):
    """A list that gets, at each update of a lane, these arrays of its run."""
    kept, update = [], lane.update

    def keep():
        update()
        kept.append({name: getattr(lane, name)[RUN].copy() for name in names})

    monkeypatch.setattr(lane, "update", keep)
    return kept


def drawn_rows(lane, size, rows):
    """(rows of the memory, copies of the environment) that a minibatch draws, with the numbers of step 7."""
    words = np.zeros((lane.group.width, size, 4), np.uint32)
    batched.words(lane.group.keys, batched.SAMPLE, 7, words)
    return tuple(
        ((words[RUN, :, k].astype(np.uint64) * n) >> 32).astype(np.int64)
        for k, n in ((0, rows), (1, lane.group.copies))
    )


def assert_same_rollouts(ours, theirs, tolerance):
    """Rewards, values and advantages of a lane are those of a rollout buffer."""
    for name, counterpart in (("rewards", "rewards"), ("values", "kept_values"), ("advantages", "advantages")):
        assert np.abs(theirs[name] - ours[counterpart]).max() <= tolerance, name


class Killed(BaseException):
    """What ends a training in its middle."""


def kill_at(steps):
    def progress(now):
        if now.done >= steps:
            raise Killed

    return progress


def bytes_of(folder):
    return [(folder / name).read_bytes() for name in ("curve.csv", "agent/parameters.pt", "agent/model.json")]
