"""Entries: what one run has learnt and what it claims, as a submission of one task that names itself.

The record has the configuration of the run and the claim. The arrays are the policy: a table or a network. The file
has the layout of `system/sealed.py`. Claims have to be computed again (`verify`).
"""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pharos.agents import agent_called
from pharos.environments import class_called
from pharos.errors import FileFormatError, MissingExtra, ParameterError, ResultCorrupted
from pharos.system import records, storage
from pharos.system.sealed import check_values, write_sealed
from pharos.training import RunConfig, check_agent_files, read_record, read_rows, run_id

POLICY_ARRAY = "policy"
"""The array of a tabular agent; a network has arrays by the names of its parameters."""
_ARRAYS_KEY = "arrays"
TRAINING = (
    "episodes",
    "cumulative_regret",
    "normalized_regret",
    "cumulative_realised_regret",
    "normalized_realised_regret",
    "mean_return",
)
"""Of the result of a run, what only training again could verify."""
ENTRY_KIND = "submission to a benchmark"


@dataclass(frozen=True)
class Claim:
    """Claimed value and regret of the policy of an entry, in the setting of its configuration.

    Attributes:
        value: expected return of an episode.
        regret: V* - value.
        value_optimal, value_uniform: V*, and the value of acting uniformly at random.
        exact: whether the value was computed, not estimated.
        error_bound: how far the value may be off. For an estimate, half the width of a 99 % interval.
    """

    value: float
    regret: float
    value_optimal: float
    value_uniform: float
    exact: bool
    error_bound: float


@dataclass(frozen=True, eq=False)
class Entry:
    """Contents of an entry: configuration, claim, and the arrays that were learnt.

    Attributes:
        name, author, note: as whoever submitted it wrote them.
        config: of the run.
        hyperparameters: all of the agent.
        versions: of what the run depended on.
        rules_version: of the environment's rules.
        claim: of the policy.
        training: what the run says of its learning (cumulative regret, episodes ...), which only training again could
            verify.
        arrays: what was learnt.
    """

    name: str
    config: RunConfig
    hyperparameters: Mapping[str, Any]
    versions: Mapping[str, str]
    rules_version: int
    claim: Claim
    training: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    author: str = ""
    note: str = ""

    @property
    def id(self) -> str:
        """The name of the run: a digest of its configuration."""
        return self.config.id

    def write(self, file: str | os.PathLike) -> None:
        """Write the entry to a file, replacing it atomically. The same entry gives the same bytes."""
        body = {name: value for name, value in vars(self).items() if name != _ARRAYS_KEY}
        record = {**body, "id": self.id, "config": self.config.to_dict(), "claim": asdict(self.claim)}
        write_sealed(file, record, self.arrays, ENTRY_KIND, follow=True)

    @staticmethod
    def of_record(record: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Entry":
        """Entry of the record and the arrays of a file. FileFormatError or ValueError if they are damaged."""
        check_values(record)
        fields = {name: value for name, value in record.items() if name not in ("format", "id", storage.DIGEST)}
        entry = records.parse_record(Entry, {**fields, _ARRAYS_KEY: arrays}, "its record")
        if record["id"] != run_id(record["config"]):
            raise ValueError("its configuration is not that of its run")
        if entry.claim.error_bound < 0:
            raise ValueError(f"its error_bound is {entry.claim.error_bound}; expected at least 0")
        return entry

    @staticmethod
    def of_run(run: Path, *, name: str = "", author: str = "", note: str = "") -> "Entry":
        """Entry of the folder of a finished run, with the value and the regret of its last evaluation.

        Raises:
            FileFormatError: the folder holds no finished run. ResultCorrupted: its files were cut short or changed.
            ParameterError: the environment is an imported MDP, which others do not have.
            MissingExtra: the run is of a network, and PyTorch is not installed.
        """
        record = read_record(run)
        if record.get("status") != "finished":
            raise FileFormatError(
                f"{run}: the run is {record.get('status')}; the same command that began it finishes it"
            )
        check_agent_files(run)
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
        return Entry(
            name=name or config.agent,
            author=author,
            note=note,
            config=config,
            hyperparameters=record["hyperparameters"],
            versions=record.get("versions", {}),
            rules_version=_rules_version(run, record, config),
            claim=claim,
            training={key: result.get(key) for key in TRAINING} | {"seconds": record.get("seconds")},
            arrays={POLICY_ARRAY: stored_table(run)} if agent_called(config.agent).has_table else _network(run),
        )


def _rules_version(run: Path, record: dict[str, Any], config: RunConfig) -> int:
    """Version of the rules that the run recorded. For older runs without one, the version of the class here."""
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
    """The policy of a run that kept a table, with actions in the smallest integer type that holds them.

    Raises:
        ResultCorrupted: policy.npy cannot be read.
    """
    try:
        storage.check_regular(run / "policy.npy")
        table = np.load(run / "policy.npy", allow_pickle=False)
    except Exception as error:  # the header is read as Python
        raise ResultCorrupted(f"{run / 'policy.npy'}: cannot be read: {error}") from None
    whole = table.astype(np.int64)
    return whole.astype(np.min_scalar_type(int(whole.max(initial=0)))) if (whole == table).all() else table


def _network(run: Path) -> dict[str, np.ndarray]:
    """The parameters of the policy by name, without optimiser state."""
    try:
        import torch
    except ImportError as error:
        raise MissingExtra("reading what a network has learnt", "torch", "agents") from error
    file = run / "agent" / "parameters.pt"
    if not file.exists():
        raise ParameterError(
            f"{run}: its agent is a function; expected a table or a network: run it by `pharos benchmark run`, whose "
            f"folder can be submitted"
        )
    try:
        stored: dict[str, Any] = torch.load(file, weights_only=True, map_location="cpu")["policy"]  # noqa: TID251
        return {name: tensor.numpy() for name, tensor in sorted(stored.items())}
    except Exception as error:  # torch has many
        raise ResultCorrupted(f"{file}: cannot be read: {' '.join(str(error).split())[:200]}") from None
