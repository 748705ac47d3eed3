"""pharos submit, verify, board: entries of a leaderboard, and what is true of them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pharos.cli.answers import complain, console, print_facts, print_json, progress_bar, progress_line, size_text
from pharos.cli.options import Json, Trust
from pharos.errors import ParameterError
from pharos.system.wording import in_words, many

if TYPE_CHECKING:
    from pharos.leaderboard import Verdict

Within = Annotated[
    float,
    typer.Option("--tolerance", min=0, help="How far an exact number may be from the claimed one, relative to V*."),
]
MaxStates = Annotated[int, typer.Option("--max-states", min=1, help="Refuse state spaces larger than this.")]
MaxReached = Annotated[
    int, typer.Option("--max-reached", min=1, help="Values of policies that reach more states are estimated.")
]
MaxHorizon = Annotated[int, typer.Option("--max-horizon", min=1, help="Refuse entries with more steps than this.")]
MaxSeconds = Annotated[float, typer.Option("--max-seconds", min=1, help="Refuse entries that take longer, each.")]


def submit(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="FILE.safetensors; ID.safetensors when not given.", show_default=False),
    ] = None,
    name: Annotated[str, typer.Option("--name", help="Of the entry; the agent's when not given.")] = "",
    author: Annotated[str, typer.Option("--author", help="Who submits it.")] = "",
    note: Annotated[str, typer.Option("--note", help="Shown beside it.")] = "",
    json: Json = False,
) -> None:
    """Pack what a run has learnt and claims into one file that anybody can verify."""
    from pharos import leaderboard

    file = leaderboard.submit(run, out, name=name, author=author, note=note)
    entry = leaderboard.read(file)
    claim = entry.claim
    if json:
        print_json({"file": file, "bytes": file.stat().st_size, "id": entry.id, "claim": claim})
        return
    kind = "exact" if claim.exact else f"estimated, ± {claim.error_bound:.2g}"
    print_facts(
        str(file),
        [
            (
                "entry",
                f"{entry.name}: {entry.config.agent} on {entry.config.environment}, {entry.config.steps:,} steps",
            ),
            ("value", f"{claim.value:.8g} ({kind})"),
            ("regret", f"{claim.regret:.8g}"),
            ("size", size_text(file.stat().st_size)),
            *(
                [("code", "others verify it with --trust alone: it names code of your own")]
                if entry.config.sources
                else []
            ),
        ],
    )


def verify(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Entries that `pharos submit` wrote.")],
    tolerance: Within = 1e-6,
    max_states: MaxStates = 10_000_000,
    max_reached: MaxReached = 100_000,
    max_horizon: MaxHorizon = 100_000,
    max_seconds: MaxSeconds = 600.0,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Compute value and regret of entries again, and compare them with what they claim; exit code 1 where one fails."""
    from pharos import leaderboard

    answers, holds = [], True
    for file in files:
        try:
            with progress_line(f"verifying {file}"):
                verdict = leaderboard.verify(
                    file,
                    trust=trust,
                    tolerance=tolerance,
                    max_states=max_states,
                    max_reached=max_reached,
                    max_horizon=max_horizon,
                    max_seconds=max_seconds,
                )
        except Exception as error:
            if len(files) == 1:
                raise
            said = leaderboard.reason(error)
            complain(said if str(file) in said else f"{file}: {said}")
            answers.append({"file": file, "holds": False, "error": said})
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
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for title in ("", "claimed", "computed", "may differ by", ""):
        table.add_column(title, justify="left" if not title else "right")
    for check in verdict.checks:
        numbers = (f"{number:.8g}" for number in (check.claimed, check.found))
        table.add_row(in_words(check.name), *numbers, f"{check.within:.1e}", "holds" if check.holds else "FAILS")
    entry, to = verdict.entry, console()
    to.print(
        f"[bold]{escape(str(verdict.file))}[/bold]  {escape(entry.name)}: {escape(entry.config.agent)} on "
        f"{escape(entry.config.environment)}, {entry.config.steps:,} steps",
        soft_wrap=True,
    )
    to.print(table)
    if verdict.exact:
        to.print(f"exact: evaluated in {many(verdict.states, 'state')}, error at most {verdict.error_bound:.1e}")
    else:
        to.print(
            f"estimated from {verdict.episodes:,} episodes: {verdict.value:.6g} ± {verdict.error_bound:.2g} (99 %); "
            f"the policy reaches more than {verdict.states:,} states (--max-reached)",
            soft_wrap=True,
        )
    if verdict.claims_too_much:
        to.print("the entry claims an exact value, which is an estimate here")
    for objection in verdict.objections:
        to.print(objection, soft_wrap=True)
    to.print("the claim holds" if verdict.holds else "[bold]the claim does not hold[/bold]")


def board(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="With entries, in it and below.")],
    out: Annotated[Path, typer.Option("--out", help="FILE.html.")] = Path("board.html"),
    title: Annotated[str, typer.Option("--title", help="Of the page.")] = "Leaderboard",
    tolerance: Within = 1e-6,
    max_states: MaxStates = 10_000_000,
    max_reached: MaxReached = 100_000,
    max_horizon: MaxHorizon = 100_000,
    max_seconds: MaxSeconds = 600.0,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Verify the entries in a folder, and write a page that ranks them by what was computed."""
    from pharos import leaderboard

    if out.suffix.lower() not in (".html", ".htm"):
        raise ParameterError(f"--out {out}; expected a file name that ends in .html")
    with progress_bar("verifying", 1) as tell:

        def show(done: int, total: int, name: str) -> None:
            if tell is not None:
                tell(done, f"{done} of {total}: {name}")

        made = leaderboard.board(
            folder,
            out,
            title=title,
            trust=trust,
            tolerance=tolerance,
            max_states=max_states,
            max_reached=max_reached,
            max_horizon=max_horizon,
            max_seconds=max_seconds,
            progress=show,
        )
    if json:
        print_json({"file": made.file, "verified": len(made.verified), "refused": made.refused})
        return
    for name, reason in made.refused.items():
        complain(f"{name}: {reason}")
    print_facts(str(made.file), [("verified", f"{len(made.verified):,}"), ("refused", f"{len(made.refused):,}")])
