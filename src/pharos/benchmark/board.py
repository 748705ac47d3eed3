"""The page of a benchmark, with two lists: audited submissions, and submissions that are only claimed.

A submission is verified anew, and stands among the audited ones where the keeper of the board has the record of an
audit for this very file, beside it: FILE.audit.json. Scores are computed from the curves, which are claims in both
lists; in the first, three of them were repeated.
"""

import os
from collections.abc import Sequence
from pathlib import Path

from pharos.benchmark.repetition import SUFFIX, Audit
from pharos.benchmark.scores import score
from pharos.benchmark.submission import Submission, SubmissionVerdict, Tell, verify
from pharos.benchmark.suite import Suite
from pharos.errors import ParameterError
from pharos.leaderboard import Board, Cell, Ranking, write_page

COLUMNS = (
    *(("rank", "n"), ("agent", "s"), ("author", "s"), ("form", "s"), ("core", "n"), ("interval", "s"), ("final", "n")),
    *(("seeds", "n"), ("tasks", "n"), ("policies", "s"), ("committed before the seed", "s"), ("file", "s")),
)
INTRODUCTION = (
    "Scores are 1 minus normalised regret, exact in every evaluation, mean over the core. Final values were computed "
    "again from the policies of each submission. How they were learnt cannot be seen from policies: of audited "
    "submissions three runs, drawn by the digest of the file, were trained again from the source and repeated their "
    "curves; claimed ones are as their authors say."
)
AUDITED, CLAIMED = "Audited", "Claimed"

Judged = tuple[SubmissionVerdict, Audit | None, Suite]


def benchmark_board(
    files: Sequence[str | os.PathLike],
    out: str | os.PathLike,
    suites: Sequence[Suite],
    *,
    title: str = "Benchmark",
    progress: Tell | None = None,
) -> Board[SubmissionVerdict]:
    """Verify submissions, and write a page with two lists of each suite: audited, and claimed.

    Args:
        files: submissions; the audit of FILE lies in FILE.audit.json.
        out: the page, one self-contained file of HTML.
        suites: that they may be of.
        progress: called with files done, files in all, and the next one.
    Returns:
        What holds, and what was refused, with the reason.
    Raises:
        ParameterError: there are no files. MissingExtra: Jinja2 is not installed.
    """
    if not files:
        raise ParameterError("a board has no files; expected submissions of `pharos benchmark submit`")
    by_digest = {suite.digest: suite for suite in suites}
    board = Board[Judged](Path(out))

    def judged(file: Path) -> tuple[Judged, str]:
        verdict, suite = _verified(file, by_digest)
        audit = audit_of(verdict)
        score(verdict.submission.results, suite)  # or why there is none
        wrong = [f"{each.name}: regret {each.found:.6g}, claimed {each.claimed:.6g}" for each in verdict.wrong]
        reasons = "; ".join((*(f"{name}: {why}" for name, why in verdict.refused.items()), *wrong))[:400]
        return (verdict, audit, suite), reasons

    board.judge([(Path(file).name, Path(file)) for file in files], judged, progress)
    rankings = [
        Ranking(
            f"{suite.name}: {kind.lower()}", f"Digest of the suite: {suite.digest}", _rows(board.verified, suite, kind)
        )
        for suite in suites
        for kind in (AUDITED, CLAIMED)
    ]
    write_page(out, title, rankings, COLUMNS, board.refused, len(board.verified), introduction=INTRODUCTION)
    return Board(board.file, tuple(verdict for verdict, _, _ in board.verified), board.refused)


def audit_of(verdict: SubmissionVerdict) -> Audit | None:
    """The audit beside a submission if it is of this very file, else None; raises as `Audit.read`."""
    file = verdict.file.with_name(verdict.file.name + SUFFIX)
    audit = Audit.read(file) if file.is_file() else None
    return audit if audit is not None and audit.submission == verdict.sha256 else None


def _verified(file: Path, suites: dict[str, Suite]) -> tuple[SubmissionVerdict, Suite]:
    results = Submission.read(file).results
    if results.digest not in suites:
        raise ParameterError(f"is of suite {results.suite}, {results.digest[:16]}..., which the board does not have")
    return verify(file, suites[results.digest]), suites[results.digest]


def _rows(verdicts: Sequence[Judged], suite: Suite, kind: str) -> list[list[Cell]]:
    """Submissions of a suite in one list, the best core score first."""
    listed = [
        (score(verdict.submission.results, suite), verdict, audit)
        for verdict, audit, its in verdicts
        if its is suite and (audit is not None and audit.holds) == (kind == AUDITED)
    ]
    listed.sort(key=lambda each: (each[0].rank, each[1].sha256))
    rows = []
    for rank, (scores, verdict, audit) in enumerate(listed, 1):
        results, submission = verdict.submission.results, verdict.submission
        core = scores.core
        failed = audit is not None and not audit.holds
        committed = "yes" if audit is not None and audit.is_committed else "no"
        rows.append(
            [
                Cell(str(rank), str(rank)),
                Cell(results.agent, results.agent, submission.note),
                Cell(submission.author, submission.author),
                Cell(str(results.record.get("form")), str(results.record.get("form"))),
                Cell(f"{core.value:.3f}", repr(core.value)),
                Cell(f"{core.low:.3f} to {core.high:.3f}"),
                Cell(f"{scores.final.value:.3f}", repr(scores.final.value)),
                Cell(str(len(results.seeds)), str(len(results.seeds))),
                Cell(f"{len(results.curves)} of {len(suite.tasks)}", str(len(results.curves))),
                Cell(f"{len(verdict.checks)} verified" + f", {len(verdict.missing)} missing" * bool(verdict.missing)),
                Cell("audit failed" if failed else committed),
                Cell(verdict.sha256[:8], verdict.sha256, str(verdict.file.name)),
            ]
        )
    return rows
