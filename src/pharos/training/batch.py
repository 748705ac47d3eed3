"""Many runs at once: configurations that fit together are trained as one program by the batched engine.

    FOLDER/                      of each run, as `train` leaves it: run.json, curve.parquet, agent/
    CHECKPOINTS/BATCH/           while a batch is trained: arrays of all its runs, their configurations and curves

A run does not depend on who else is in its batch, so nothing does on how runs are grouped, and a batch that was killed
goes on from its last checkpoint to the bytes that it gives undisturbed. What is finished is not trained again; a run
that fails is said to have failed, and the others go on.
"""

from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pharos.errors import FileFormatError, ParameterError, PharosError
from pharos.policies import is_small_table
from pharos.system.storage import read_json
from pharos.training.batch_run import Batch
from pharos.training.config import RunConfig
from pharos.training.run_folder import TrainingResult, finished_result
from pharos.training.task_cache import FailedRun, Member, TaskCache
from pharos.training.training_jobs import CallbackError, Tell, TrainingJobs


def train_configs(
    configs: Sequence[RunConfig | Mapping[str, Any]],
    folders: Sequence[Path] | None = None,
    *,
    checkpoints: Path | None = None,
    progress: Tell | None = None,
    members: TaskCache | None = None,
    device: str | None = None,
    lane: int | None = None,
) -> list[TrainingResult | FailedRun]:
    """Train as each configuration says; those of the batched engine that fit together as one program.

    Args:
        folders: of the runs, one for each; None: nothing is written. Finished runs there are returned.
        checkpoints: folder for those of whole batches; None: none are written. A batch that was killed goes on from
            there with the runs that it had.
        progress: called after each evaluation; what it raises ends the training and is raised here.
        members: makes tasks, with values that are known already, and code of the user's own where it is trusted; None:
            from scratch, trusting none.
        device: "cpu" or "cuda"; None: that of the members, and "cpu" where there are none.
        lane: the most runs in a batch; None: all that fit together. Changes no result.
    Returns:
        The result of each run, or why it has none.
    Raises:
        FileFormatError: not the configuration of a run. ParameterError: there is no such device, or the members are
            for another one.
        MissingExtra: PyTorch is not installed.
    """
    members = TaskCache(device=device or "cpu") if members is None else members
    if device not in (None, members.device):
        raise ParameterError(f"device is {device!r}, and the members are for {members.device!r}; expected one device")
    _check_device(members.device)
    made = [config if isinstance(config, RunConfig) else RunConfig.from_dict(config) for config in configs]
    work = _Work(made, folders, checkpoints, progress, members, lane)
    work.run()
    return [work.results[place] for place in range(len(made))]


def _check_device(device: str) -> None:
    if device == "cpu":
        return
    import torch

    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # torch has a type for each of its builds
        reason = (str(error).splitlines() or [""])[0]
        raise ParameterError(f"device is {device!r}, which torch does not have here: {reason}; try cpu") from None


class _Work(TrainingJobs):
    """The runs of one call: which train alone, which together, one batch after the other."""

    def run(self) -> None:
        """Everything."""
        alone, waiting = [], {}
        for place, config in enumerate(self.configs):
            if self._is_finished(place, config):
                self.done += config.steps
            elif config.engine == "batched" or self._is_table(place, config):
                waiting[place] = config
            else:
                alone.append(place)
        for place in alone:
            self._alone(place)
        if waiting:
            for group in self._groups(waiting):
                Batch(self, group).train()
            if self.checkpoints is not None and self.checkpoints.is_dir() and not any(self.checkpoints.iterdir()):
                self.checkpoints.rmdir()

    def _is_table(self, place: int, config: RunConfig) -> bool:
        """Whether it learns a table that is evaluated with others: of few states, and not half learnt alone."""
        if not config.is_tabular or len(self.configs) == 1:
            return False
        folder = self.folder(place)
        try:
            return is_small_table(self.members.task(config).mdp) and not (folder and (folder / "checkpoint").exists())
        except Exception:  # what is wrong with it, it is told alone
            return False

    def _is_finished(self, place: int, config: RunConfig) -> bool:
        folder = self.folder(place)
        try:
            done = None if folder is None else finished_result(folder, config)
        except (ParameterError, FileFormatError) as error:
            self.results[place] = FailedRun(config.to_dict(), folder, error)
            return True
        if done is not None:
            self.results[place] = done
        return done is not None

    def _alone(self, place: int) -> None:
        """A run that has no batch: a table, or a model of Stable-Baselines3."""
        from pharos.training.train import train_task

        config, folder, before = self.configs[place], self.folder(place), self.done

        def progress(done: int, _steps: int, row: Mapping[str, Any]) -> None:
            self.report({place: row}, before + done)

        try:
            algorithm = config.algorithm(trust=self.members.trust, strict=self.members.strict)
            self.results[place] = train_task(
                config, self.members.task(config), folder, progress=progress, algorithm=algorithm
            )
        except CallbackError as stop:
            raise stop.args[0] from None
        except Exception as error:
            self.fail(place, error)
        self.done = before + config.steps

    # Groups ----------------------------------------------------------------------------------------------------------

    def _groups(self, waiting: dict[int, RunConfig]) -> Iterator[list[Member]]:
        """Those of checkpoints as they were, then the rest, by what fits together."""
        by_id = {config.id: place for place, config in waiting.items()}
        for ids, configs in self._stored_batches():
            if not any(id in by_id for id in ids):
                continue
            try:
                group = [
                    self.members.member(by_id.get(id), config, self._folder_of(by_id.get(id)))
                    for id, config in zip(ids, configs, strict=True)
                ]
            except Exception:  # what is wrong with a run is found below, where it fails alone
                continue
            for id in ids:
                if id in by_id:
                    del waiting[by_id.pop(id)]
            yield group
        groups: dict[Hashable, list[Member]] = defaultdict(list)
        for place, config in waiting.items():
            try:
                member = self.members.member(place, config, self.folder(place))
            except Exception as error:
                self.fail(place, error)
                self.done += config.steps
                continue
            groups[member.key].append(member)
        for group in groups.values():
            width = self.lane or len(group)
            for first in range(0, len(group), width):
                yield group[first : first + width]

    def _folder_of(self, place: int | None) -> Path | None:
        return None if place is None else self.folder(place)

    def _stored_batches(self) -> Iterator[tuple[list[str], list[RunConfig]]]:
        if self.checkpoints is None:
            return
        for folder in sorted(self.checkpoints.glob("*")):
            try:
                stored = read_json(folder / "batch.json")
                configs = [RunConfig.from_dict(entry) for entry in stored["configs"]]
            except (OSError, ValueError, KeyError, TypeError, PharosError):
                continue
            yield [config.id for config in configs], configs
