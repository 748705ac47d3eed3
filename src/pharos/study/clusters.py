"""The same runs on more than one machine: shards as a Slurm array through submitit, or runs and batches on Ray.

Runs do not depend on the engine: every one of these executes what is missing in a folder that all machines share, and
may be killed, repeated, or followed by another.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pharos.errors import MissingExtra, ParameterError
from pharos.study import worker as _worker
from pharos.study.blocks import Run, part_of
from pharos.study.execution import Status, StudyExecution, opened, run, shard_of, train_run, write_specification
from pharos.study.specification import Source, specification
from pharos.system.records import takes
from pharos.system.wording import in_one_line
from pharos.system.workers import Workers
from pharos.training import GROUP_ATTEMPTS, ExecutionOptions


@takes(ExecutionOptions, workers=1)
def submit(
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    shards: int,
    cluster: str = "slurm",
    parameters: Mapping[str, Any] | None = None,
    runner: _worker.Runner = train_run,
    **options: Any,
) -> list[Any]:
    """Submit a study as an array of jobs, each of which executes one of `shards` parts with `workers` processes.

    Args:
        folder: of the results, on a disk that all machines share.
        cluster: "slurm", or "local" for all jobs at once on this machine, to try it.
        parameters: of submitit's executor, such as {"timeout_min": 600, "slurm_partition": "cpu",
            "slurm_array_parallelism": 50}.
        options: of `pharos.training.ExecutionOptions`, as for `run`, by default with one worker. Each job has a shard
            of its own.
    Returns:
        submitit's jobs, one for each part in which runs are missing: `job.job_id`, `job.result()` waits. Their logs
        are in the folder `jobs`.
    Raises:
        MissingExtra: submitit is not installed. ParameterError: there is no such cluster, or an option is wrong.
    """
    try:
        import submitit
    except ImportError as error:
        raise MissingExtra("running on Slurm", "submitit", "cluster") from error
    if cluster not in ("slurm", "local"):
        raise ParameterError(f"cluster is {cluster!r}; expected slurm or local")
    if shards < 1:
        raise ParameterError(f"shards is {shards}; expected at least 1")
    how = replace(ExecutionOptions(**options), shard=None, workers=options.get("workers") or 1)
    study, directory = opened(source, folder)
    directory = directory.absolute()
    write_specification(study, directory)
    try:
        executor = submitit.AutoExecutor(folder=str(directory / "jobs"), cluster=cluster)
    except RuntimeError as error:  # there is no sbatch here
        raise ParameterError(f"cannot submit to {cluster}: {error}") from error
    usual = {"cpus_per_task": how.workers, "timeout_min": 24 * 60, "name": f"pharos-{study.name}"}
    executor.update_parameters(**{**usual, **(parameters or {})})
    parts = [f"{part}/{shards}" for part in range(1, shards + 1)]
    runs = tuple(part_of(study, how.block, how.agent, how.observation))
    parts = [part for part in parts if _has_work(shard_of(runs, part), directory, how.retry_failed)]
    if not parts:
        return []
    with executor.batch():
        return [
            executor.submit(run_shard, str(directory), {**vars(how), "shard": part, "runner": runner}) for part in parts
        ]


def _has_work(runs: Iterable[Run], directory: Path, retry_failed: bool) -> bool:
    over = ("finished",) if retry_failed else ("finished", "failed")
    return any(_worker.read_status(directory / "runs" / run.id) not in over for run in runs)


def run_shard(folder: str, options: dict[str, Any]) -> dict[str, Any]:
    """Execute a job's part of the study whose specification stands in the folder. Return the Status as a dictionary."""
    return run(specification(folder, trust=True), folder, **options).to_dict()


@takes(ExecutionOptions)
def run_on_ray(
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    address: str | None = None,
    progress: Callable[[Status], None] | None = None,
    runner: _worker.Runner = train_run,
    batch_runner: _worker.BatchRunner | None = None,
    **options: Any,
) -> Status:
    """Execute the runs of a study that are not over on a Ray cluster, one processor a run, or a batch of runs.

    Args:
        batch_runner: of the runs that the study says are batched, as for `run`.
        folder: of the results, on a disk that all nodes share.
        address: of the cluster. Default: the cluster of this machine or of RAY_ADDRESS, or else a new local one.
        options: as for `run`. Ray decides how many runs are executed at once, and has no timeout.
    Raises:
        MissingExtra: Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise MissingExtra("running on Ray", "ray", "ray") from error
    study, directory = opened(source, folder)
    own = replace(ExecutionOptions(**options), workers=None)
    pool = RayTasks(ray, address)
    return StudyExecution(study, directory.absolute(), own, runner, batch_runner, progress, pool).run()


class RayTasks(Workers):
    """A pool of tasks on a Ray cluster, one processor each, which Ray begins again when their processes die."""

    def __init__(self, ray: Any, address: str | None):
        self.ray, self.address = ray, address
        self.is_ours = not ray.is_initialized()
        self.tasks: dict[Any, str] = {}

    def __enter__(self) -> "RayTasks":
        if self.is_ours:
            dashboard = None if self.address else False
            self.ray.init(address=self.address, log_to_driver=False, include_dashboard=dashboard)
        return self

    def __exit__(self, *_: object) -> None:
        if self.is_ours:
            self.ray.shutdown()

    def start(
        self, key: str, function: Callable[..., object], arguments: Sequence[Any], definitions: Sequence[object] = ()
    ) -> None:
        remote = self.ray.remote(num_cpus=1, max_retries=GROUP_ATTEMPTS - 1)(_attempt)
        self.tasks[remote.remote(*arguments)] = key

    def events(self, seconds: float | None = None) -> Iterator[tuple[str, Any]]:
        """Yield what tasks have sent, and how they ended: an exit code, or the error of Ray."""
        for reference in self.ray.wait(list(self.tasks), num_returns=1, timeout=seconds)[0]:
            key = self.tasks.pop(reference)
            try:
                *messages, code = self.ray.get(reference)
            except Exception as error:  # of Ray: `attempt` keeps errors of the run itself
                messages, code = [], in_one_line(error)
            for event in (*messages, code):
                yield key, event

    def kill(self, key: str) -> None:
        """Ray has no timeout."""


def _attempt(*job: Any) -> list[Any]:
    """Execute one run or a batch. Return what `worker.main` sends, and its exit code."""
    sent: list[Any] = []
    try:
        _worker.main(*(*job, sent.append))
    except SystemExit as end:
        return [*sent, end.code]
    return [*sent, 0]
