"""Style of all figures, also in studies: colours, panels, legends, files."""

import functools
import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from pharos.agents import TABULAR_OBSERVATION, agent_called
from pharos.errors import MissingExtra, ParameterError
from pharos.system.storage import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

P = ParamSpec("P")
T = TypeVar("T")

# Okabe and Ito's colours, which people distinguish whatever their sight; the colours of classes are in their `look`
LINE_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MORE_COLORS = ("#CC79A7", "#E69F00", "#F0E442", "#999999")
OBSERVATION_COLORS = {TABULAR_OBSERVATION: "#009E73", "vector": "#0072B2", "simple_image": "#D55E00"}
INK_COLOR, GRID_COLOR, DIAGONAL = "#23262d", "#e3e5e8", "#888888"
DPI, PAGE_DPI = 160, 120
DATES: dict[str, Any] = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}


def style(dark: bool = False) -> dict[Any, Any]:
    """Matplotlib settings of a figure on light or dark ground."""
    ink, ground, grid = ("#d8dbe2", "#1b1e24", "#3a3f4a") if dark else (INK_COLOR, "#ffffff", GRID_COLOR)
    return {
        "figure.facecolor": ground, "axes.facecolor": ground, "savefig.facecolor": ground,
        "text.color": ink, "axes.labelcolor": ink, "axes.edgecolor": ink, "xtick.color": ink, "ytick.color": ink,
        "axes.grid": True, "grid.color": grid, "grid.linewidth": 0.8, "axes.axisbelow": True,
        "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False, "legend.fontsize": 8,
        "axes.titleweight": "bold", "axes.titlelocation": "left", "font.size": 9, "axes.titlesize": 10,
        "lines.linewidth": 1.8, "figure.constrained_layout.use": True, "pdf.fonttype": 42,
    }  # fmt: skip


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """A function that draws in the style of pharos, whatever matplotlib is set to."""

    @functools.wraps(draw)
    def drawing(*arguments: P.args, **options: P.kwargs) -> T:
        try:
            import matplotlib as mpl
        except ImportError as error:
            raise MissingExtra("plotting", "matplotlib", "study") from error
        with mpl.rc_context(style()):
            return draw(*arguments, **options)

    return drawing


def panels(count: int, width: float, height: float) -> tuple["Figure", list[Any]]:
    """A figure without a window, and so many axes, each of that width and height in inches."""
    from matplotlib.figure import Figure

    columns = min(count, 4) if count <= 4 or count % 3 else 3
    lines = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * lines), layout="constrained")
    axes = np.atleast_1d(figure.subplots(lines, columns, squeeze=False)).ravel().tolist()
    for axis in axes[count:]:
        axis.set_visible(False)
    return figure, axes[:count]


def single(axes: Any, size: tuple[float, float]) -> tuple["Figure", "Axes"]:
    """The figure and the axes to draw on: those given, or new ones of `size` inches."""
    if axes is not None:
        return axes.figure, axes
    figure, (axis,) = panels(1, *size)
    return figure, axis


def legend_below(figure: "Figure", axes: Sequence[Any], columns: int = 5) -> None:
    """One legend below all panels."""
    handles: dict[str, Any] = {}
    for axis in axes:
        for handle, name in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(name, handle)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(columns, len(handles)))


def label_edges(axes: Sequence[Any], below: str, beside: str) -> None:
    """Label the lowest panel of each column, and the first of each row."""
    columns = axes[0].get_subplotspec().get_gridspec().ncols
    for i, axis in enumerate(axes):
        axis.set(xlabel=below if i + columns >= len(axes) else "", ylabel="" if i % columns else beside)


def agent_label(agent: str) -> str:
    """`DQN`. For an algorithm from a module or a file, the name of its class."""
    return agent_called(agent).title


def slug(name: str) -> str:
    """A name as part of a file's name."""
    return "".join(c if c.isalnum() else "_" for c in name)


def observation_color(name: str, names: Sequence[str]) -> str:
    """The colour of an observation among `names`: its own, or one of MORE_COLORS."""
    return color_among(name, names, OBSERVATION_COLORS)


def color_among(name: str, names: Sequence[str], colors: Mapping[str, str]) -> str:
    """The colour of `name`: by the table `colors`, else one of MORE_COLORS by its place among names that it lacks."""
    others = [other for other in names if other not in colors]
    return colors.get(name) or MORE_COLORS[others.index(name) % len(MORE_COLORS)]


def save(figure: "Figure", path: str | os.PathLike, *, follow: bool = True) -> Path:
    """Write a figure as PNG, PDF or SVG, by the ending of the name.

    Args:
        follow: whether a symbolic link there is followed, not replaced, as in a folder of results.
    Raises:
        ParameterError: another ending, or no such folder.
    """
    path = Path(path)
    kind = path.suffix.lower()[1:]
    if kind not in DATES:
        raise ParameterError(f"{path}: expected a name that ends in .png, .pdf or .svg")
    if not path.parent.is_dir():
        raise ParameterError(f"{path.parent}: no such folder")
    replace_file(path, file_of(figure, kind), follow=follow)
    return path


def save_for_page(draw: Callable[[], "Figure | None"], path: Path) -> dict[str, bytes] | None:
    """Draw a figure into FILE.png and FILE.pdf. Return its PNG for light and for dark pages, None without a figure.

    Args:
        draw: called under the style of either page.
    """
    import matplotlib as mpl

    images = {}
    for theme in ("light", "dark"):
        with mpl.rc_context(style(theme == "dark")):
            if (figure := draw()) is None:
                return None
            images[theme] = file_of(figure, "png", PAGE_DPI)
            if theme == "light":
                path.parent.mkdir(parents=True, exist_ok=True)
                replace_file(path.with_suffix(".png"), images[theme])
                replace_file(path.with_suffix(".pdf"), file_of(figure, "pdf"))
    return images


def file_of(figure: "Figure", kind: str, dpi: int = DPI) -> bytes:
    """The file of a figure, "png", "pdf" or "svg": the same bytes at any time."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi, bbox_inches="tight", metadata=DATES[kind])
    return buffer.getvalue()


def thousands(value: float, _: object = None) -> str:
    """12000 -> 12k, 3000000 -> 3M: for axes of steps."""
    if abs(value) >= 1e9:
        return f"{value:.0e}".replace("e+0", "e").replace("e+", "e")
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def plain_log(side: "Axis") -> None:
    """Ticks of a logarithmic axis as numbers, with 2 and 5 between powers of ten if there are few of these."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = side.get_view_interval()
    side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 200 * low else (1.0,)))
    side.set_major_formatter(FuncFormatter(thousands))
    side.set_minor_formatter(NullFormatter())
