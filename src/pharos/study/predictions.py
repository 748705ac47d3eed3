"""Regret of each cell of a study, predicted before its runs by measures of representations."""

import os
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from pharos.agents import agent_kind
from pharos.errors import ParameterError, UnknownName
from pharos.study.blocks import Run, Specification
from pharos.study.specification import Source
from pharos.study.status import opened

if TYPE_CHECKING:
    import pandas as pd


def predict(
    source: Source,
    folder: str | os.PathLike | None = None,
    *,
    blocks: Sequence[int] | None = None,
    agents: Sequence[str] | None = None,
    observations: Sequence[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> "pd.DataFrame":
    """Return what is predicted of each cell of a study whose agent learns from observations: a row each.

    Args:
        source, folder: as for `run`; no run is looked at.
        blocks, agents, observations: a part of the study: numbers of blocks from 1, names of agents, and of
            observations without their options; None: all.
        progress: called with what is being done.
    Returns:
        Columns `environment`, `instance`, `chance`, `agent`, `observation`; PREDICTORS; `network`; `estimated_error`,
        that of `kernel_regret` where landmarks stand for the kernel; `curve` and `adam_curve`, the learner's steps and
        greedy regrets as JSON; `notes`, why a number is missing. The idealised learner has the steps of the run, and of
        a DQN its discount, exploration and target network; of actor-critics, with the rollouts, steps and discount of
        the agent, POLICY_PREDICTORS, `policy_curve` and `clipped_curve`, that of the distribution over actions with
        PPO's clipping, NaN and "" in rows of others.
    Raises:
        ParameterError: the study has no such cell.
    Cost: measures of hardness are kept beside the state spaces, so that a second call is quick.
    """
    import pandas as pd

    from pharos.validation import POLICY_CURVES, predicted

    study, _ = opened(source, folder)
    rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for run in _part_of(study, blocks, agents, observations):
        if agent_kind(run.configuration.agent).is_tabular:
            continue
        key = tuple(run.cell.values())
        if key in rows:
            continue
        if progress is not None:
            progress(f"cell {len(rows) + 1}: {', '.join(key[1:])}")
        rows[key] = run.cell | predicted(run.config)
    if not rows:
        raise ParameterError(f"study {study.name!r}: no agent learns from observations, so there is nothing to predict")
    frame = pd.DataFrame(list(rows.values()))
    return frame.fillna({name: "" for name in POLICY_CURVES if name in frame})


def _part_of(
    study: Specification,
    blocks: Sequence[int] | None,
    agents: Sequence[str] | None,
    observations: Sequence[str] | None,
) -> Iterator[Run]:
    """Runs of some blocks, agents and observations.

    Raises:
        ParameterError: one of these is not in the study.
    """
    runs = study.runs
    if blocks is not None:
        wrong = [block for block in blocks if not 1 <= block <= len(study.blocks)]
        if wrong:
            raise ParameterError(f"block {wrong[0]}: study {study.name!r} has blocks 1 to {len(study.blocks)}")
        part = study.model_copy(update={"blocks": [study.blocks[block - 1] for block in blocks]})
        ids = {run.id for run in part.runs}
        runs = tuple(run for run in runs if run.id in ids)
    for what, names, name_of in (
        ("agent", agents, lambda run: run.configuration.agent),
        ("observation", observations, lambda run: run.configuration.observation),
    ):
        unknown = {*(names or ())} - {name_of(run) for run in runs}
        if unknown:
            raise UnknownName(f"{what} of study {study.name!r}", min(unknown), sorted({name_of(run) for run in runs}))
    for run in runs:
        if agents is not None and run.configuration.agent not in agents:
            continue
        if observations is None or run.configuration.observation in observations:
            yield run
