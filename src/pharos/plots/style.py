"""How the plots look, and how they are written."""

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from pharos.errors import MissingExtra, ParameterError
from pharos.system import storage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec("P")
T = TypeVar("T")

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
INK, GRID = "#3b4048", "#e3e5e8"
RULES: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 160,
}


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """A function that draws in the style of pharos, whatever matplotlib is set to."""

    @functools.wraps(draw)
    def drawing(*arguments: P.args, **options: P.kwargs) -> T:
        try:
            import matplotlib as mpl
        except ImportError as error:
            raise MissingExtra("plotting", "matplotlib", "study") from error
        with mpl.rc_context(RULES):
            return draw(*arguments, **options)

    return drawing


def figure(rows: int = 1, columns: int = 1, size: tuple[float, float] = (5.0, 3.4)) -> tuple["Figure", Any]:
    """A figure without a window, and its axes (rows, columns), each of `size` inches."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    return made, made.subplots(rows, columns, squeeze=False)


def single(axes: Any, size: tuple[float, float]) -> tuple["Figure", Any]:
    """The figure and the axes to draw on: those given, or new ones of `size` inches."""
    if axes is not None:
        return axes.figure, axes
    made, several = figure(1, 1, size)
    return made, several[0, 0]


def save(figure: "Figure", path: str | os.PathLike) -> Path:
    """Write a figure as PNG, PDF or SVG, by the ending of the name.

    Raises:
        ParameterError: another ending, or no such folder.
    """
    path = Path(path)
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ParameterError(f"{path}: expected a name that ends in .png, .pdf or .svg")
    if not path.parent.is_dir():
        raise ParameterError(f"{path.parent}: no such folder")
    with storage.replacing(path) as file:
        figure.savefig(file, dpi=160, format=path.suffix.lower()[1:])
    return path


def thousands(value: float, _: Any = None) -> str:
    """12000 -> 12k, 3000000 -> 3M: for axes of steps."""
    if abs(value) >= 1e9:
        return f"{value:.0e}".replace("e+0", "e").replace("e+", "e")
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}"
    return f"{value:g}"


def plain_log(side: Any) -> None:
    """Ticks of a logarithmic axis as numbers, with 2 and 5 between powers of ten where there are few of these."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = side.get_view_interval()
    side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 200 * low else (1.0,)))
    side.set_major_formatter(FuncFormatter(thousands))
    side.set_minor_formatter(NullFormatter())
