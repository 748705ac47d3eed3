"""The page of a leaderboard: every entry of a folder verified, and ranked by the computed regret, not the claimed one.

The page loads nothing and executes nothing but its own few lines, which sort tables; its policy of contents says so to
the browser. Whatever comes from entries is escaped.
"""

import base64
import hashlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from pharos.environments import instance_name
from pharos.errors import ParameterError
from pharos.leaderboard.entry import SUFFIX, Entry
from pharos.leaderboard.limits import Limits
from pharos.leaderboard.verification import Verdict, task_key, verify
from pharos.observations import title as observation_title
from pharos.system import storage
from pharos.system.records import takes
from pharos.system.wording import in_one_line, in_words, templates
from pharos.training import TaskValues

if TYPE_CHECKING:
    from jinja2 import Template

T = TypeVar("T")
LONGEST_REASON = 400

BoardCallback = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Cell:
    """A cell of a table: its text, and its sort key."""

    text: str
    key: str = ""
    hint: str = ""


@dataclass(frozen=True)
class Ranking:
    """The verified entries of one task, best first."""

    title: str
    setting: str
    rows: Sequence[Sequence[Cell]]


@dataclass
class Board(Generic[T]):
    """Verdicts on a set of files, and the page that shows them.

    Attributes:
        file: the page.
        verified: verdicts on those whose claim holds.
        refused: name of each other file -> why.
    """

    file: Path
    verified: Sequence[T] = ()
    refused: dict[str, str] = field(default_factory=dict)

    def judge(
        self,
        files: Sequence[tuple[str, Path]],
        judged: Callable[[Path], tuple[T, str]],
        progress: BoardCallback | None,
    ) -> None:
        """Verify files, by name and path.

        Args:
            judged: gives the verdict on a file, and why it does not hold; "" where it does.
        """
        for k, (name, path) in enumerate(files):
            if progress is not None:
                progress(k, len(files), name)
            try:
                verdict, objection = judged(path)
            except Exception as error:  # whatever is wrong with it, and whatever pharos lacks for it: one row of many
                self.refused[name] = reason(error).removeprefix(f"{path}: ")
                continue
            if objection:
                self.refused[name] = objection
            else:
                self.verified = (*self.verified, verdict)


COLUMNS = (
    ("rank", "n"),
    ("entry", "s"),
    ("author", "s"),
    ("agent", "s"),
    ("observation", "s"),
    ("steps", "n"),
    ("value", "n"),
    ("regret", "n"),
    ("normalised", "n"),
    ("certainty", "s"),
    ("while learning, claimed", "n"),
    ("run", "s"),
)


@takes(Limits)
def board(
    folder: str | os.PathLike,
    out: str | os.PathLike,
    *,
    title: str = "Leaderboard",
    trust: bool = False,
    progress: BoardCallback | None = None,
    **options: Any,
) -> Board[Verdict]:
    """Verify every entry in a folder, and write a page that ranks them; entries of one task share its solution.

    Args:
        folder: entries, *.safetensors, in it and below.
        out: the page, one self-contained file of HTML.
        title: of the page.
        progress: called with how many entries are done, how many there are, and the next one.
        trust, options: as for `verify`, for each entry.
    Returns:
        What holds and what was refused; those refused stand at the end of the page, with the reason.
    Raises:
        ParameterError: there is no such folder, or no entry in it. MissingExtra: Jinja2 is not installed.
    """
    place = Path(folder)
    files = sorted(path for path in place.rglob(f"*{SUFFIX}") if path.is_file())
    if not files:
        raise ParameterError(f"{place}: expected a folder with entries, *{SUFFIX}; `pharos submit RUN` makes one")
    _template()  # or what is missing for it is told before anything is verified
    results, values = Board[Verdict](Path(out)), dict[str, TaskValues]()

    def judged(path: Path) -> tuple[Verdict, str]:
        verdict = verify(path, trust=trust, values=values, **options)
        return verdict, "" if verdict.holds else why_not(verdict)

    results.judge([(path.relative_to(place).as_posix(), path) for path in files], judged, progress)
    write_page(results.file, title, _rankings(results.verified), COLUMNS, results.refused, len(results.verified))
    return results


def write_page(
    file: str | os.PathLike,
    title: str,
    rankings: Sequence[Ranking],
    columns: Sequence[tuple[str, str]],
    refused: Mapping[str, str],
    verified: int,
    introduction: str = "",
) -> None:
    """Write the page of a board; `introduction` replaces the default one."""
    import pharos

    script = (Path(__file__).parent / "templates" / "sort.js.j2").read_text(encoding="utf-8")
    text = _template().render(
        title=title,
        rankings=rankings,
        columns=columns,
        refused=refused,
        verified=verified,
        introduction=introduction,
        version=pharos.__version__,
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )
    Path(file).parent.mkdir(parents=True, exist_ok=True)
    storage.replace_file(file, text.encode(errors="replace"), follow=True)  # names of files may be no text


def _template() -> "Template":
    return templates("pharos.leaderboard", "the page of a leaderboard").get_template("board.html.j2")


def reason(error: Exception) -> str:
    """Message of an error as one line of at most LONGEST_REASON letters."""
    return in_one_line(error)[:LONGEST_REASON].removesuffix(": ") or type(error).__name__


def why_not(verdict: Verdict) -> str:
    """The reason why a claim does not hold, in one line."""
    wrong = [
        f"{in_words(check.name)} is {check.found:.8g}, the entry claims {check.claimed:.8g}"
        for check in verdict.checks
        if not check.holds
    ]
    if verdict.claims_too_much:
        wrong.append(f"the value is claimed to be exact, and is an estimate here (± {verdict.error_bound:.2g})")
    return "; ".join((*wrong, *verdict.objections))


def _rankings(verdicts: Sequence[Verdict]) -> list[Ranking]:
    """A table for each task, by name; the least regret first, and of equal ones the fewest steps."""
    groups: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        groups.setdefault(task_key(verdict.entry.config), []).append(verdict)
    rankings = []
    for group in groups.values():
        group.sort(key=lambda each: (max(0.0, round(each.regret, 9)), each.entry.config.steps, each.entry.id))
        first = group[0]
        config = first.entry.config
        horizon = "no horizon" if config.horizon is None else f"horizon {config.horizon}"
        setting = (
            f"Chance added: {str(config.chance) if config.chance else 'none'}. Discount {config.gamma:g}, {horizon}. "
            f"V* = {first.value_optimal:.6g}, V of acting at random = {first.value_uniform:.6g}."
        )
        rows = [_row(rank, verdict, _copies(verdict.entry, group)) for rank, verdict in enumerate(group, 1)]
        name = instance_name(config.environment, config.parameters)
        rankings.append(Ranking(f"{name}{'' if not config.chance else f', {config.chance}'}", setting, rows))
    return sorted(rankings, key=lambda ranking: (ranking.title, ranking.setting))


def _copies(entry: Entry, group: Sequence[Verdict]) -> str:
    """Other entries of the same run with bitwise equal arrays; their author cannot be determined."""
    same = [
        f"{other.name} by {other.author or 'nobody'}"
        for other in (verdict.entry for verdict in group)
        if other is not entry
        and other.id == entry.id
        and other.arrays.keys() == entry.arrays.keys()
        and all(np.array_equal(other.arrays[name], array) for name, array in entry.arrays.items())
    ]
    return f" (the same run as {', '.join(same)})" if same else ""


def _row(rank: int, verdict: Verdict, copies: str) -> list[Cell]:
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
