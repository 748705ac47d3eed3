"""The HTML page: its sections, data as the templates want them, and the rendering. Templates escape what they print.

The page runs one script, its own (templates/page.js.j2), named by its digest: a browser runs no other and loads
nothing.
"""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pharos.system.wording import in_words, templates

if TYPE_CHECKING:
    import pandas as pd

Figures = Mapping[str, Mapping[str, bytes] | None]
# A column of texts up to this long is not broken over lines
SHORT_TEXT = 30


class Section:
    """A section of the page: its title, and the context for `template`.html.j2, which prints it."""

    def __init__(self, title: str, template: str, **context: object):
        self.title, self.template, self.context = title, f"{template}.html.j2", context

    @property
    def anchor(self) -> str:
        """The anchor of the section, which links lead to."""
        return self.title.lower().replace(" ", "-")

    def __getitem__(self, name: str) -> object:
        return self.context[name]


# Tables and figures ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Column:
    """A column of a table: its title, and its kind: n of numbers, s of short texts, t of texts."""

    title: str
    kind: str


@dataclass(frozen=True)
class ReportTable:
    """A table whose cells are texts."""

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Image:
    """A figure for light and for dark pages, as data URLs. Its name is the name of its file.

    `curves` has the numbers of its lines, as JSON: the page draws them anew, to be pointed at. Empty for other figures.
    """

    name: str
    caption: str
    light: str
    dark: str
    curves: str = ""


def render_page(title: str, description: str, sections: Sequence[Section]) -> str:
    """The HTML of the page."""
    page = templates("pharos.study.report", "the report of a study")
    script = page.get_template("page.js.j2").render()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return page.get_template("page.html.j2").render(
        title=title, description=description, sections=sections, script=script, digest=digest
    )


def figure_image(figures: Figures, name: str, caption: str) -> Image | None:
    """A figure with its caption, or None if it was not drawn."""
    images = figures.get(name)
    if not images:
        return None
    curves = images.get("curves", b"").decode()
    return Image(name, caption, data_url(images["light"]), data_url(images["dark"]), curves)


def data_url(png: bytes) -> str:
    """A picture as a URL that holds it."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def data_table(data: "pd.DataFrame", caption: str = "", *, digits: int = 3) -> ReportTable:
    """A frame as a table: numbers short and to the right, whole ones without digits. Empty columns are left out."""
    data = data[[name for name in data.columns if len(data) == 0 or not (data[name] == "").all()]]
    columns, digits_of = [], []
    for name in data.columns:
        is_number = data[name].dtype.kind in "fiu"
        longest = data[name].astype(str).str.len().max() if len(data) else 0
        kind = "n" if is_number else "s" if longest <= SHORT_TEXT else "t"
        columns.append(Column(in_words(str(name)), kind))
        digits_of.append(0 if is_number and _is_whole(data[name].to_numpy(float)) else digits)
    rows = [
        [_cell(value, digits) for value, digits in zip(line, digits_of, strict=True)]
        for line in data.itertuples(index=False)
    ]
    return ReportTable(caption, columns, rows)


def _is_whole(values: np.ndarray) -> bool:
    finite = values[np.isfinite(values)]
    return bool((finite == np.round(finite)).all())


def _cell(value: object, digits: int) -> str:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return number_text(float(value), digits)
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    return str(value)


def number_text(value: float, digits: int = 3) -> str:
    """A number for people: digits after the point, thousands separated, small and huge ones with a power of ten."""
    if digits > 0 and value != 0 and not 10.0**-digits <= abs(value) < 1e7:
        return f"{value:.{max(1, digits - 1)}e}"
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.{digits}f}"
