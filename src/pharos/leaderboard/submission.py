"""From the folder of a finished run to an entry."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from pharos.environments import class_called
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted
from pharos.leaderboard.entry import POLICY, SUFFIX, Claim, Entry, read, write
from pharos.training import RunConfig, check_agent, read_record, read_rows

TRAINING = (
    "episodes",
    "cumulative_regret",
    "normalized_regret",
    "cumulative_realised_regret",
    "normalized_realised_regret",
    "mean_return",
)
"""Of the result of a run, what only training again could verify."""


def submit(
    run: str | os.PathLike,
    file: str | os.PathLike | None = None,
    *,
    name: str = "",
    author: str = "",
    note: str = "",
) -> Path:
    """Pack what a finished run has learnt and what it claims into one file, which `verify` reads; return the file.

    Nothing is trained, evaluated or executed: the value and the regret are those of the run's last evaluation. The same
    run and texts give the same bytes.

    Args:
        run: folder of a finished run.
        file: ends in .safetensors; None: ID.safetensors in the current directory, ID that of the run.
        name: of the entry; that of the agent when not given.
        author, note: texts to show beside it.
    Raises:
        FileFormatError: the folder holds no finished run. ResultCorrupted: its files were cut short or changed.
        ParameterError: the environment is an imported MDP, which others do not have; or a text cannot be printed.
        MissingExtra: the run is of a network, and PyTorch is not installed.
    """
    run = Path(run)
    record = read_record(run)
    if record.get("status") != "finished":
        raise FileFormatError(f"{run}: the run is {record.get('status')}; the same command that began it finishes it")
    check_agent(run)
    config = RunConfig.from_dict(record["config"])
    if config.environment == "imported":
        raise ParameterError(
            f"{run}: was trained on an imported MDP, which others do not have; "
            f"expected an environment of pharos, or of a class that others can import"
        )
    result, last = record["result"], read_rows(run)[-1]
    claim = Claim(
        last["value"],
        last["expected_regret"],
        result["value_optimal"],
        result["value_uniform"],
        bool(last["exact"]),
        last["error_bound"],
    )
    entry = Entry(
        name=name or config.agent,
        author=author,
        note=note,
        config=config,
        hyperparameters=record["hyperparameters"],
        versions=record.get("versions", {}),
        rules_version=_rules_version(run, record, config),
        claim=claim,
        training={key: result.get(key) for key in TRAINING} | {"seconds": record.get("seconds")},
        arrays={POLICY: stored_table(run)} if config.is_tabular else _network(run),
    )
    target = Path(f"{config.id}{SUFFIX}" if file is None else file)
    if target.suffix.lower() != SUFFIX:
        raise ParameterError(f"{target}: expected a file name that ends in {SUFFIX}")
    target.parent.mkdir(parents=True, exist_ok=True)
    write(entry, target)
    try:
        read(target)
    except FileFormatError as error:
        target.unlink()
        raise ParameterError(str(error)) from None
    return target


def _rules_version(run: Path, record: dict[str, Any], config: RunConfig) -> int:
    """The version of the rules that the run says; of older runs, which say none, that of the class here."""
    stored = record.get("rules_version")
    if isinstance(stored, int) and not isinstance(stored, bool):
        return stored
    rules = class_called(config.environment)
    if rules is None:
        raise ParameterError(
            f"{run}: does not say the version of the rules of {config.environment!r}, which is not loaded here; "
            "train it again into another folder"
        )
    return rules.version


def stored_table(run: Path) -> np.ndarray:
    """The policy of a run that kept a table, actions in as few bytes as they take.

    Raises:
        ResultCorrupted: policy.npy cannot be read.
    """
    try:
        table = np.load(run / "policy.npy", allow_pickle=False)
    except Exception as error:  # the header is read as Python
        raise ResultCorrupted(f"{run / 'policy.npy'}: cannot be read: {error}") from None
    whole = table.astype(np.int64)
    return whole.astype(np.min_scalar_type(int(whole.max(initial=0)))) if (whole == table).all() else table


def _network(run: Path) -> dict[str, np.ndarray]:
    """The parameters of the policy, by name; optimisers stay behind."""
    from pharos.errors import MissingExtra

    try:
        import torch
    except ImportError as error:
        raise MissingExtra("reading what a network has learnt", "torch", "agents") from error
    file = run / "agent" / "parameters.pt"
    try:
        stored: dict[str, Any] = torch.load(file, weights_only=True, map_location="cpu")["policy"]  # noqa: TID251
        return {name: tensor.numpy() for name, tensor in sorted(stored.items())}
    except Exception as error:  # torch has many
        raise ResultCorrupted(f"{file}: cannot be read: {' '.join(str(error).split())[:200]}") from None
