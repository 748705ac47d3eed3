"""The board: files verified, and ranked by what was computed again, not by what they claim.

A table for each suite ranks by final policies, and a table for each task that entries name ranks by regret. All else
that a file says is claimed, and stands in columns that say so: curves while learning cannot be seen from policies.

The page loads nothing and executes nothing but its own few lines, which sort tables. Its policy of contents says so to
the browser. All text of files is escaped.
"""

import base64
import hashlib
import math
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pharos.benchmark.entry import Entry
from pharos.benchmark.entry_policy import task_key
from pharos.benchmark.limits import Limits
from pharos.benchmark.scores import score
from pharos.benchmark.submission import ProgressCallback
from pharos.benchmark.suite import Suite
from pharos.benchmark.verification import EntryVerdict, SubmissionVerdict, verify
from pharos.environments import instance_name
from pharos.errors import ParameterError
from pharos.observations import title as observation_title
from pharos.system import storage
from pharos.system.records import takes
from pharos.system.sealed import SUFFIX
from pharos.system.wording import in_one_line, templates
from pharos.training import TaskValues

if TYPE_CHECKING:
    from jinja2 import Template

LONGEST_REASON = 400
SUITE_COLUMNS = (
    *(("rank", "n"), ("agent", "s"), ("author", "s"), ("final score", "n"), ("policies", "s")),
    *(("core score, claimed", "n"), ("interval, claimed", "s"), ("seeds, claimed", "n"), ("tasks, claimed", "n")),
    *(("form, claimed", "s"), ("file", "s")),
)
TASK_COLUMNS = (
    *(("rank", "n"), ("entry", "s"), ("author", "s"), ("agent", "s"), ("observation", "s"), ("steps", "n")),
    *(("value", "n"), ("regret", "n"), ("normalised", "n"), ("certainty", "s"), ("while learning, claimed", "n")),
    ("run", "s"),
)


@dataclass(frozen=True)
class Cell:
    """A cell of a table: its text, and its sort key."""

    text: str
    key: str = ""
    hint: str = ""


@dataclass(frozen=True)
class Ranking:
    """The verified files of one suite or task, best first.

    Attributes:
        columns: their names, and "n" for numbers or "s" for text.
    """

    title: str
    setting: str
    columns: Sequence[tuple[str, str]]
    rows: Sequence[Sequence[Cell]]


@dataclass
class Board:
    """Verdicts on a set of files, and the page that shows them.

    Attributes:
        file: the page.
        verified: verdicts on the files that hold.
        final_scores: name of each of them -> its final score.
        refused: name of each other file -> why.
    """

    file: Path
    verified: list[EntryVerdict | SubmissionVerdict] = field(default_factory=list)
    final_scores: dict[str, float] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)


@takes(Limits)
def board(
    files: str | os.PathLike | Sequence[str | os.PathLike],
    out: str | os.PathLike,
    suites: Sequence[Suite] = (),
    *,
    title: str = "Benchmark",
    trust: bool = False,
    progress: ProgressCallback | None = None,
    **options: Any,
) -> Board:
    """Verify submissions, and write a page that ranks them. Entries of one task share its solution.

    Args:
        files: submissions, and folders with *.safetensors in them and below.
        out: the page, one self-contained file of HTML.
        suites: that they may be of. Default: v1.
        title: of the page.
        progress: called with files done, files in all, and the next one.
        trust, options: as for `verify`, for each file.
    Returns:
        What holds and what was refused. Refused files stand at the end of the page, with the reason.
    Raises:
        ParameterError: there are no files. MissingExtra: Jinja2 is not installed.
    """
    listed = [*_listed([files] if isinstance(files, str | os.PathLike) else files)]
    if not listed:
        raise ParameterError(f"a board has no files; expected *{SUFFIX}, which `pharos benchmark submit` makes")
    _template()  # MissingExtra before anything is verified
    result, values = Board(Path(out)), dict[str, TaskValues]()
    for done, (name, path) in enumerate(listed):
        if progress is not None:
            progress(done, len(listed), name)
        try:
            verdict = verify(path, suites, trust=trust, values=values, **options)
            if isinstance(verdict, SubmissionVerdict):
                score(verdict.submission.results, verdict.suite)  # or why there is none
        except Exception as error:  # whatever is wrong with it, and whatever pharos lacks for it: one row of many
            result.refused[name] = reason(error).removeprefix(f"{path}: ")
            continue
        if verdict.holds:
            result.verified.append(verdict)
            result.final_scores[name] = verdict.final
        else:
            result.refused[name] = verdict.reasons[:LONGEST_REASON]
    _write_page(result, title)
    return result


def _listed(files: Sequence[str | os.PathLike]) -> Iterator[tuple[str, Path]]:
    """Yield name on the page and path of each file. For a folder, of the files in it and below."""
    paths = []
    for each in map(Path, files):
        inside = sorted(path for path in each.rglob(f"*{SUFFIX}") if path.is_file())
        paths += (
            [(path.relative_to(each).as_posix(), path) for path in inside] if each.is_dir() else [(each.name, each)]
        )
    counts = Counter(name for name, _ in paths)
    yield from ((name if counts[name] == 1 else str(path), path) for name, path in paths)


def _write_page(result: Board, title: str) -> None:
    import pharos

    script = (Path(__file__).parent / "templates" / "sort.js.j2").read_text(encoding="utf-8")
    text = _template().render(
        title=title,
        rankings=_rankings(result.verified),
        refused=result.refused,
        verified=len(result.verified),
        version=pharos.__version__,
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )
    result.file.parent.mkdir(parents=True, exist_ok=True)
    storage.replace_file(result.file, text.encode(errors="replace"), follow=True)  # names of files may be no text


def _template() -> "Template":
    return templates("pharos.benchmark", "the page of a board").get_template("board.html.j2")


def reason(error: Exception) -> str:
    """Message of an error as one line of at most LONGEST_REASON letters."""
    return in_one_line(error)[:LONGEST_REASON].removesuffix(": ") or type(error).__name__


def _rankings(verdicts: Sequence[EntryVerdict | SubmissionVerdict]) -> list[Ranking]:
    """A table for each suite, by name, then one for each task of entries."""
    groups: dict[tuple[int, str], list[Any]] = {}
    for each in verdicts:
        key = (0, each.suite.digest) if isinstance(each, SubmissionVerdict) else (1, task_key(each.entry.config))
        groups.setdefault(key, []).append(each)
    rankings = [(kind, (_ranking_of_task if kind else _ranking_of_suite)(group)) for (kind, _), group in groups.items()]
    return [ranking for _, ranking in sorted(rankings, key=lambda each: (each[0], each[1].title, each[1].setting))]


# Suites ---------------------------------------------------------------------------------------------------------------


def _ranking_of_suite(group: list[SubmissionVerdict]) -> Ranking:
    """The best final policies first."""
    group.sort(key=lambda each: (-each.final, each.sha256))
    rows, suite = [_row_of_suite(rank, verdict) for rank, verdict in enumerate(group, 1)], group[0].suite
    return Ranking(suite.name, f"Digest of the suite: {suite.digest}", SUITE_COLUMNS, rows)


def _row_of_suite(rank: int, verdict: SubmissionVerdict) -> list[Cell]:
    results, submission = verdict.submission.results, verdict.submission
    core = score(results, verdict.suite).core
    runs, form = len(verdict.checks) + len(verdict.missing), str(results.record.get("form"))
    return [
        _number(rank, "d"),
        Cell(results.agent, results.agent, submission.note),
        Cell(submission.author, submission.author),
        _number(verdict.final, ".3f"),
        Cell(f"{len(verdict.checks)} of {runs}", str(len(verdict.checks))),
        _number(core.value, ".3f"),
        Cell(f"{core.low:.3f} to {core.high:.3f}"),
        _number(len(results.seeds), "d"),
        Cell(f"{len(results.curves)} of {len(verdict.suite.tasks)}", str(len(results.curves))),
        Cell(form, form),
        Cell(verdict.sha256[:8], verdict.sha256, str(verdict.file.name)),
    ]


# Single tasks ---------------------------------------------------------------------------------------------------------


def _ranking_of_task(group: list[EntryVerdict]) -> Ranking:
    """The least regret first, and of equal ones the fewest steps."""
    group.sort(key=lambda each: (max(0.0, round(each.regret, 9)), each.entry.config.steps, each.entry.id))
    first = group[0]
    config = first.entry.config
    horizon = "no horizon" if config.horizon is None else f"horizon {config.horizon}"
    setting = (
        f"Chance added: {str(config.chance) if config.chance else 'none'}. Discount {config.gamma:g}, {horizon}. "
        f"V* = {first.value_optimal:.6g}, V of acting at random = {first.value_uniform:.6g}."
    )
    rows = [_row_of_task(rank, verdict, _copies(verdict.entry, group)) for rank, verdict in enumerate(group, 1)]
    title = f"{instance_name(config.environment, config.parameters)}{f', {config.chance}' if config.chance else ''}"
    return Ranking(title, setting, TASK_COLUMNS, rows)


def _copies(entry: Entry, group: Sequence[EntryVerdict]) -> str:
    """Other entries of the same run with bitwise equal arrays. Their author cannot be determined."""
    same = [
        f"{other.name} by {other.author or 'nobody'}"
        for other in (verdict.entry for verdict in group)
        if other is not entry
        and other.id == entry.id
        and other.arrays.keys() == entry.arrays.keys()
        and all(np.array_equal(other.arrays[name], array) for name, array in entry.arrays.items())
    ]
    return f" (the same run as {', '.join(same)})" if same else ""


def _row_of_task(rank: int, verdict: EntryVerdict, copies: str) -> list[Cell]:
    entry, config = verdict.entry, verdict.entry.config
    learning = entry.training.get("normalized_regret")
    learning = learning if isinstance(learning, int | float) and math.isfinite(learning) else math.nan
    observation = observation_title(config.observation, config.observation_options)
    origin = f"{entry.id}, seed {config.seed}, pharos {entry.versions.get('pharos', 'unknown')}"
    certainty = "exact" if verdict.exact else f"estimated ± {verdict.error_bound:.2g}"
    return [
        _number(rank, "d"),
        Cell(entry.name, entry.name, entry.note),
        Cell(entry.author + copies, entry.author),
        Cell(config.agent, config.agent),
        Cell(observation, observation),
        _number(config.steps, ",d"),
        _number(verdict.value, ".6g"),
        _number(verdict.regret if abs(verdict.regret) > 1e-9 else 0.0, ".6g"),
        _number(verdict.normalized_regret if abs(verdict.normalized_regret) > 1e-9 else 0.0, ".4g")
        if math.isfinite(verdict.normalized_regret)
        else Cell("–"),
        Cell(certainty, certainty),
        _number(learning, ".4g") if math.isfinite(learning) else Cell("–"),
        Cell(entry.id[:8], entry.id, origin),
    ]


def _number(value: object, style: str) -> Cell:
    return Cell(format(value, style), repr(value))
