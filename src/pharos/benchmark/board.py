"""The page of a benchmark: submissions of each suite, ranked by what was computed again from their final policies.

All else that a submission says is claimed, and stands in columns that say so: curves while learning cannot be seen from
policies, so core scores and their intervals are as the authors say.
"""

import os
from collections.abc import Sequence
from pathlib import Path

from pharos.benchmark.scores import score
from pharos.benchmark.submission import Submission, SubmissionVerdict, Tell, verify
from pharos.benchmark.suite import Suite
from pharos.errors import ParameterError
from pharos.leaderboard import Board, Cell, Ranking, write_page

COLUMNS = (
    *(("rank", "n"), ("agent", "s"), ("author", "s"), ("final score", "n"), ("policies", "s")),
    *(("core score, claimed", "n"), ("interval, claimed", "s"), ("seeds, claimed", "n"), ("tasks, claimed", "n")),
    *(("form, claimed", "s"), ("file", "s")),
)
INTRODUCTION = (
    "Final scores were computed again from the policies in each file: 1 minus normalised regret, mean over the core; a "
    "run without a policy counts as random play, 0. All else is claimed: the curves while learning, so core scores and "
    "their intervals; names, steps, seeds and settings; and that the policies were learnt, since who solves a task has "
    "its best policy without learning."
)


def benchmark_board(
    files: Sequence[str | os.PathLike],
    out: str | os.PathLike,
    suites: Sequence[Suite],
    *,
    title: str = "Benchmark",
    progress: Tell | None = None,
) -> Board[SubmissionVerdict]:
    """Verify submissions, and write a page that ranks those of each suite by their final policies.

    Args:
        files: submissions.
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
    board = Board[SubmissionVerdict](Path(out))

    def judged(file: Path) -> tuple[SubmissionVerdict, str]:
        results = Submission.read(file).results
        if results.digest not in by_digest:
            raise ParameterError(
                f"is of suite {results.suite}, {results.digest[:16]}..., which the board does not have"
            )
        verdict = verify(file, by_digest[results.digest])
        score(results, by_digest[results.digest])  # or why there is none
        wrong = [f"{each.name}: regret {each.found:.6g}, claimed {each.claimed:.6g}" for each in verdict.wrong]
        reasons = "; ".join((*(f"{name}: {why}" for name, why in verdict.refused.items()), *wrong))[:400]
        return verdict, reasons

    board.judge([(Path(file).name, Path(file)) for file in files], judged, progress)
    rankings = [
        Ranking(suite.name, f"Digest of the suite: {suite.digest}", _rows(board.verified, suite)) for suite in suites
    ]
    write_page(out, title, rankings, COLUMNS, board.refused, len(board.verified), introduction=INTRODUCTION)
    return board


def _rows(verdicts: Sequence[SubmissionVerdict], suite: Suite) -> list[list[Cell]]:
    """Submissions of a suite, the best final policies first."""
    listed = [each for each in verdicts if each.submission.results.digest == suite.digest]
    listed.sort(key=lambda each: (-each.final, each.sha256))
    rows = []
    for rank, verdict in enumerate(listed, 1):
        results, submission = verdict.submission.results, verdict.submission
        core = score(results, suite).core
        runs = len(verdict.checks) + len(verdict.missing)
        rows.append(
            [
                Cell(str(rank), str(rank)),
                Cell(results.agent, results.agent, submission.note),
                Cell(submission.author, submission.author),
                Cell(f"{verdict.final:.3f}", repr(verdict.final)),
                Cell(f"{len(verdict.checks)} of {runs}", str(len(verdict.checks))),
                Cell(f"{core.value:.3f}", repr(core.value)),
                Cell(f"{core.low:.3f} to {core.high:.3f}"),
                Cell(str(len(results.seeds)), str(len(results.seeds))),
                Cell(f"{len(results.curves)} of {len(suite.tasks)}", str(len(results.curves))),
                Cell(str(results.record.get("form")), str(results.record.get("form"))),
                Cell(verdict.sha256[:8], verdict.sha256, str(verdict.file.name)),
            ]
        )
    return rows
