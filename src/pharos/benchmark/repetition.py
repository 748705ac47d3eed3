"""Audit: a few runs of a submission, drawn by its own digest, are trained again from the source.

Whoever hands in cannot know which runs these are before the submission is whole, since its SHA-256 draws them, and a
change of one digit draws others. Curves of the engine, of tables and of exact agents must be equal to the last bit; for
other agents, whose libraries differ between processors, the score of the run must lie in the 99 % prediction interval
of the other seeds of its task.

The source is code, and is executed: in a container without network, see docs/benchmark-rules.md. It must be read too:
a source that solves the task instead of learning it repeats its curves to the last bit.
"""

import os
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pharos.agents import BATCHED
from pharos.benchmark.agents import agent_form, sha256
from pharos.benchmark.commitment import FORMAT, read_object
from pharos.benchmark.execution import run
from pharos.benchmark.results import AgentResults
from pharos.benchmark.scores import check_suite
from pharos.benchmark.submission import Submission, Tell, sha256_of_source
from pharos.benchmark.suite import Suite
from pharos.errors import FileFormatError, PharosError, ResultCorrupted
from pharos.system import records, storage
from pharos.system.wording import in_one_line

SUFFIX = ".audit.json"
PAIRS = 3
CONFIDENCE = 0.99
FLOOR = 0.02
"""Of a score: half the width of an interval is at least this, where other seeds do not differ at all."""
FEWEST = 4
"""Other seeds of a task that tell how far its runs are apart."""


@dataclass(frozen=True, kw_only=True)
class Repeat:
    """One run, trained again.

    Attributes:
        task, seed: of the run. claimed, again: mean normalised regret over its evaluations.
        equal: whether the curves are equal to the last bit.
        low, high: between which `again` is taken for a run of the same agent.
        holds: whether it is.
        error: why it could not be trained; else empty.
    """

    task: str
    seed: int
    claimed: float
    again: float | None
    equal: bool
    low: float
    high: float
    holds: bool
    error: str = ""


@dataclass(frozen=True, kw_only=True)
class Audit:
    """Result of an audit; a board shows the audits that its keeper has on record.

    Attributes:
        submission: SHA-256 of the file. suite: SHA-256 of the suite.
        source: SHA-256 of the source that was run; empty for agents of pharos.
        is_source: whether it is the one that the submission names.
        repeats: of the drawn runs.
        published: when the commitment was seen published, YYYY-MM-DD, as the auditor says; empty: not seen.
        round: of the beacon, when the sealed tasks became known; empty for the public suite.
        is_committed: whether source and hyperparameters are those of a commitment that was published before the round.
        date, pharos: when, and with which version.
    """

    submission: str
    suite: str
    source: str
    is_source: bool
    repeats: tuple[Repeat, ...]
    published: str
    round: str
    is_committed: bool
    date: str
    pharos: str

    @property
    def holds(self) -> bool:
        """Whether the source is the one named and all runs repeat."""
        return self.is_source and bool(self.repeats) and all(each.holds for each in self.repeats)

    def write(self, file: str | os.PathLike) -> None:
        """Write the audit to a file, replacing it atomically."""
        storage.replace_json(file, storage.sealed({"format": FORMAT, **asdict(self), "holds": self.holds}))

    @staticmethod
    def read(file: str | os.PathLike) -> "Audit":
        """Read an audit that `write` wrote.

        Raises:
            ParameterError: there is no such file. FileFormatError: it is no audit. ResultCorrupted: it was changed.
        """
        entry = read_object(file, "audit", "audit", "audit again")
        if storage.DIGEST not in entry or not storage.is_intact(entry):
            raise ResultCorrupted(f"{file}: what it says was changed after it was written; audit again")
        fields = {name: entry[name] for name in entry if name not in ("format", "holds", storage.DIGEST)}
        repeats = fields.get("repeats")
        if not isinstance(repeats, list):
            raise FileFormatError(f"{file}: its repeats are {repeats!r}; expected a list; audit again")
        audit = records.read(Audit, {**fields, "repeats": ()}, f"{file}: the audit")
        return replace(audit, repeats=tuple(records.read(Repeat, each, f"{file}: a repeat") for each in repeats))


def drawn_runs(digest: str, submission: Submission, number: int = PAIRS) -> tuple[tuple[str, int], ...]:
    """The (task, seed) that an audit repeats: drawn from the SHA-256 of a submission, hexadecimal; no task twice."""
    results, draw = submission.results, np.random.default_rng(int(digest, 16))
    tasks = sorted(results.curves)
    places = draw.permutation(len(tasks))[:number]
    return tuple((tasks[i], results.seeds[int(draw.integers(len(results.seeds)))]) for i in places)


def make_audit(
    file: str | os.PathLike,
    agent: str | Callable[..., Any],
    suite: Suite,
    *,
    date: str,
    published: str = "",
    round: str = "",
    elsewhere: bool = False,
    workers: int | None = None,
    progress: Tell | None = None,
) -> Audit:
    """Train three runs of a submission again, and compare their curves.

    Args:
        file: that `submit` wrote. agent: its code, as `benchmark.run` takes it: imported and executed.
        suite: that the submission is of. date: of today, YYYY-MM-DD.
        published, round: see `Audit`.
        elsewhere: whether the runs were trained on another kind of processor than this, where networks of the engine
            do not repeat to the last bit: they are compared as those of other agents.
        workers: processes. progress: called with runs done, runs in all, and a text.
    Raises:
        ParameterError: there is no such file or agent, or it is of another suite.
        FileFormatError: it is no submission. ResultCorrupted: it was cut short or changed.
    Cost: as three runs.
    """
    import pharos

    submission, digest = Submission.read(file), sha256(file)
    results = submission.results
    check_suite(results, suite, str(file))
    form = agent_form(agent, suite)
    is_source = form.checksum == sha256_of_source(results) and form.kind == results.record.get("form")
    settings = results.record.get("hyperparameters") if form.kind in ("engine", "class") else None

    def train(**options: Any) -> AgentResults:
        return run(agent, suite, hyperparameters=settings, workers=workers, **options).results

    to_the_bit = form.kind == "exact" or form.label == "q_learning" or (form.label in BATCHED and not elsewhere)
    repeats: list[Repeat] = []
    pairs = drawn_runs(digest, submission)
    for place, (task, seed) in enumerate(pairs if is_source else ()):
        if progress is not None:
            progress(place, len(pairs), f"{task}, seed {seed}")
        repeats.append(_repeat(results, task, seed, to_the_bit, train))
    return Audit(
        submission=digest,
        suite=suite.digest,
        source=form.checksum,
        is_source=is_source,
        repeats=tuple(repeats),
        published=published,
        round=round,
        is_committed=bool(published and round) and published < round and submission.fits(),
        date=date,
        pharos=pharos.__version__,
    )


def _repeat(
    results: AgentResults, task: str, seed: int, to_the_bit: bool, train: Callable[..., AgentResults]
) -> Repeat:
    """Comparison of a repeated run with the submitted curve; `train` has the options of `run`."""
    row, scores = results.seeds.index(seed), results.curves[task].mean(axis=1)
    claimed, others = float(scores[row]), np.delete(scores, row)
    low, high = (claimed, claimed) if to_the_bit else prediction_interval(others)
    repeat = Repeat(task=task, seed=seed, claimed=claimed, again=None, equal=False, low=low, high=high, holds=False)
    try:
        with tempfile.TemporaryDirectory() as folder:
            curve = train(out=folder, seeds=[seed], tasks=[task]).curves[task][0]
    except PharosError as error:
        return replace(repeat, error=in_one_line(error))
    equal, again = bool(np.array_equal(curve, results.curves[task][row])), float(curve.mean())
    return replace(repeat, again=again, equal=equal, holds=equal or (not to_the_bit and low <= again <= high))


def prediction_interval(scores: np.ndarray) -> tuple[float, float]:
    """Prediction interval (0.99) of one more run after n normal ones: mean -+ t s sqrt(1 + 1/n), half width >= FLOOR.

    Args:
        scores: (n,) of the other seeds.
    Returns:
        (low, high); (1, 0), in which nothing lies, where there are fewer than FEWEST scores.
    Source: Student's t with n - 1 degrees of freedom; Hahn and Meeker (1991), Statistical Intervals.
    """
    from scipy import stats

    number = len(scores)
    if number < FEWEST:
        return 1.0, 0.0
    t = float(stats.t.ppf(0.5 + CONFIDENCE / 2, number - 1))
    half = max(FLOOR, t * float(scores.std(ddof=1)) * float(np.sqrt(1 + 1 / number)))
    return float(scores.mean()) - half, float(scores.mean()) + half
