"""pharos submit, verify, board: entries of a leaderboard, and what is true of them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import (
    Answer,
    complain,
    counted_bar,
    print_facts,
    print_json,
    print_table,
    progress_line,
    size_text,
)
from pharos.cli.options import Trust
from pharos.errors import ParameterError
from pharos.leaderboard import Limits
from pharos.system.wording import in_words, pluralize

if TYPE_CHECKING:
    from pharos.leaderboard import Verdict


def submit(
    run: Annotated[Path, "RUN"],
    *,
    out: Path | None = None,
    name: str = "",
    author: str = "",
    note: str = "",
) -> Answer:
    """Pack what a run has learnt and claims into one file that anybody can verify.

    Args:
        run: Folder of a finished run.
        out: FILE.safetensors; ID.safetensors when not given.
        name: Of the entry; the agent's when not given.
        author: Who submits it.
        note: Shown beside it.
    """
    from pharos import leaderboard

    file = leaderboard.submit(run, out, name=name, author=author, note=note)
    entry, size = leaderboard.read(file), file.stat().st_size
    claim, config = entry.claim, entry.config
    kind = "exact" if claim.exact else f"estimated, ± {claim.error_bound:.2g}"
    facts = [
        ("entry", f"{entry.name}: {config.agent} on {config.environment}, {config.steps:,} steps"),
        ("value", f"{claim.value:.8g} ({kind})"),
        ("regret", f"{claim.regret:.8g}"),
        ("size", size_text(size)),
    ]
    if config.sources:
        facts.append(("code", "others verify it with --trust alone: it names code of your own"))
    return Answer({"file": file, "bytes": size, "id": entry.id, "claim": claim}, (str(file), facts))


def verify(
    files: Annotated[list[Path], "FILE..."],
    *,
    limits: Limits,
    trust: Trust = False,
    json: bool = False,
) -> None:
    """Compute value and regret of entries again, and compare them with what they claim; exit code 1 where one fails.

    Args:
        files: Entries that `pharos submit` wrote.
    """
    from pharos import leaderboard

    answers, holds = [], True
    for file in files:
        try:
            with progress_line(f"verifying {file}"):
                verdict = leaderboard.verify(file, trust=trust, **vars(limits))
        except Exception as error:
            if len(files) == 1:
                raise
            reason_text = leaderboard.reason(error)
            complain(reason_text if str(file) in reason_text else f"{file}: {reason_text}")
            answers.append({"file": file, "holds": False, "error": reason_text})
            holds = False
            continue
        holds = holds and verdict.holds
        answers.append(_answer(verdict))
        if not json:
            _print(verdict)
    if json:
        print_json(answers[0] if len(files) == 1 else {"entries": answers, "holds": holds})
    if not holds:
        raise typer.Exit(1)


def _answer(verdict: "Verdict") -> dict[str, Any]:
    names = ("value", "regret", "normalized_regret", "value_optimal", "value_uniform", "exact", "error_bound")
    return {
        "file": verdict.file,
        "holds": verdict.holds,
        "id": verdict.entry.id,
        **{name: getattr(verdict, name) for name in (*names, "states", "episodes")},
        "checks": {
            check.name: {"claimed": check.claimed, "found": check.found, "within": check.within, "holds": check.holds}
            for check in verdict.checks
        },
        "objections": list(verdict.objections),
        "seconds": verdict.seconds,
        "limits": dict(verdict.limits),
    }


def _print(verdict: "Verdict") -> None:
    if verdict.exact:
        how = f"exact: evaluated in {pluralize(verdict.states, 'state')}, error at most {verdict.error_bound:.1e}"
    else:
        how = (
            f"estimated from {verdict.episodes:,} episodes: {verdict.value:.6g} ± {verdict.error_bound:.2g} (99 %); "
            f"the policy reaches more than {verdict.states:,} states (--max-reached)"
        )
    entry, config = verdict.entry, verdict.entry.config
    print_table(
        f"{verdict.file}  {entry.name}: {config.agent} on {config.environment}, {config.steps:,} steps",
        ("", ">claimed", ">computed", ">may differ by", ""),
        (
            (
                in_words(check.name),
                *(f"{number:.8g}" for number in (check.claimed, check.found)),
                f"{check.within:.1e}",
                "holds" if check.holds else "FAILS",
            )
            for check in verdict.checks
        ),
        notes=[
            how,
            *(["the entry claims an exact value, which is an estimate here"] if verdict.claims_too_much else []),
            *verdict.objections,
        ],
    )
    print("the claim holds" if verdict.holds else "the claim does not hold")


def board(
    folder: Annotated[Path, "FOLDER"],
    *,
    out: Path = Path("board.html"),
    title: str = "Leaderboard",
    limits: Limits,
    trust: Trust = False,
) -> Answer:
    """Verify the entries in a folder, and write a page that ranks them by what was computed.

    Args:
        folder: With entries, in it and below.
        out: FILE.html.
        title: Of the page.
    """
    from pharos import leaderboard

    if out.suffix.lower() not in (".html", ".htm"):
        raise ParameterError(f"--out {out}; expected a file name that ends in .html")
    with counted_bar("verifying") as tell:
        page = leaderboard.board(folder, out, title=title, trust=trust, progress=tell, **vars(limits))

    def text() -> None:
        for name, reason in page.refused.items():
            complain(f"{name}: {reason}")
        print_facts(str(page.file), [("verified", f"{len(page.verified):,}"), ("refused", f"{len(page.refused):,}")])

    return Answer({"file": page.file, "verified": len(page.verified), "refused": page.refused}, text)
