"""`hardness.json`: results of measures beside the state space, each sealed by a digest and tied to what it depends
on."""

import contextlib
import json
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xxhash

from pharos.hardness.interval import Budget, Certificate
from pharos.hardness.registry import Measure
from pharos.mdp import TabularMDP
from pharos.system import storage

FILE = "hardness.json"
FORMAT = 2

# Conventions that the results of a measure depend on, by its `depends`; else all, but for these where it is "all".
_OF_REPRESENTATIONS = ("representation", "schedule", "rollouts")
_DEPENDS = {
    "structure": ("chance", "restart"),
    "values": ("chance", "gamma", "horizon_of_values", "tolerance"),
    "episodes": ("chance", "horizon"),
}


class ResultsFile:
    """Results in `hardness.json` of the state space's folder.

    The key of a result is the name and version of the measure, and a digest of all that it depends on: the manifest of
    the folder, conventions, the start, rewards. An entry holds its key and is sealed, so that one that was edited, cut
    short or brought from another space is measured anew, with a warning.
    """

    def __init__(self, mdp: TabularMDP, conventions: Mapping[str, Any]):
        self.path = None if mdp.folder is None else Path(mdp.folder) / FILE
        self.mdp, self.conventions = mdp, dict(conventions)
        self.error_bound: float | None = None  # the largest of the values behind the results that were read
        self._has_warned = False

    def get(self, measure: Measure, budget: Budget) -> dict[str, Any] | None:
        """Value, text, seconds and certificate; None where there is no result, or one that a larger budget could
        improve on."""
        if self.path is None or measure.version is None:
            return None
        key = self._key(measure)
        entry = self._read().get(key)
        if entry is None:
            return None
        try:
            if entry["key"] != key or storage.DIGEST not in entry or not storage.is_intact(entry):
                raise ValueError("digest")
            content = json.loads(entry["content"])
            if "error_bound" not in content:  # of an older pharos, which did not keep it
                return None
            certificate = Certificate(**content["certificate"])
            if not certificate.is_exact and budget.exceeds(Budget(**content["budget"])):
                return None
            _check(content["value"])
            text, seconds = str(content["text"]), float(content["seconds"])
            bound = None if content["error_bound"] is None else float(content["error_bound"])
        except (KeyError, TypeError, ValueError):
            self._warn(f"the result of {measure.name} is not as pharos wrote it")
            return None
        if bound is not None:
            self.error_bound = max(bound, self.error_bound or 0.0)
        return {"value": content["value"], "text": text, "seconds": seconds, "certificate": certificate}

    def put(
        self,
        measure: Measure,
        value: Any,
        text: str,
        certificate: Certificate,
        seconds: float,
        budget: Budget,
        error_bound: float | None = None,
    ) -> None:
        """Keep a result, and how wrong the optimal values behind it may be. A folder that cannot be written to
        (another's, or a full disk) keeps nothing."""
        if self.path is None or measure.version is None:
            return
        content = {
            "value": value,
            "text": text,
            "seconds": seconds,
            "certificate": vars(certificate),
            "budget": {"seconds": budget.seconds, "searches": budget.searches},
            "error_bound": None if measure.depends == "structure" else error_bound,
        }
        try:  # as text: JSON proper has no infinity
            entry = storage.sealed({"key": self._key(measure), "content": json.dumps(content)})
        except TypeError:  # a user's measure that JSON cannot hold
            return
        with contextlib.suppress(OSError):
            results = {**self._read(), entry["key"]: entry}
            storage.replace_json(self.path, {"format": FORMAT, "results": results}, durable=False)

    def _key(self, measure: Measure) -> str:
        everything = tuple(sorted(self.conventions))
        if measure.depends != "representation":
            everything = tuple(key for key in everything if key not in _OF_REPRESENTATIONS)
        keys = _DEPENDS.get(measure.depends, everything)
        conventions = json.dumps({key: self.conventions[key] for key in keys}, sort_keys=True)
        return f"{measure.name}/{measure.version}/{self._digest(conventions, measure.depends != 'structure')}"

    def _digest(self, conventions: str, with_rewards: bool) -> str:
        assert self.path is not None
        digest = xxhash.xxh3_128(conventions.encode())
        with contextlib.suppress(OSError):  # transitions do not change without the manifest, which has their digests
            digest.update(storage.digest_of_file(self.path.with_name("manifest.json")).encode())
        table = self.mdp.reward_table
        arrays = [self.mdp.start_states, self.mdp.start_probabilities]
        for array in [*arrays, *([table.table, table.palette] if with_rewards else [])]:
            digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()

    def _read(self) -> dict[str, Any]:
        """Entries by key; none where the file is missing, of another format, or damaged."""
        assert self.path is not None
        try:
            storage.check_regular(self.path)
            text = self.path.read_bytes()
        except OSError:
            return {}
        try:
            stored = json.loads(text)
            if stored["format"] < FORMAT:  # of an older pharos, without digests
                return {}
            if stored["format"] == FORMAT and all(isinstance(each, dict) for each in stored["results"].values()):
                return dict(stored["results"])
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            pass
        self._warn("the file is not as pharos wrote it")
        return {}

    def _warn(self, what: str) -> None:
        """Once for each report."""
        if not self._has_warned:
            self._has_warned = True
            warnings.warn(f"{self.path}: {what}; it is measured anew", stacklevel=2)


def _check(value: Any) -> None:
    """ValueError where a value cannot be one: an interval whose ends are the wrong way round, or NaN."""
    if isinstance(value, Mapping):
        lower, upper = value.get("lower"), value.get("upper")
        if lower is not None and upper is not None and not lower <= upper:
            raise ValueError("interval")
    if isinstance(value, float) and math.isnan(value):
        raise ValueError("NaN")
