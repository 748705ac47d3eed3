"""Predicted regrets as bars with their intervals."""

from typing import TYPE_CHECKING, Any

from pharos.plots.style import COLORS, GRID, INK, single, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pharos.validation import Prediction


@styled
def predictions(prediction: "Prediction", *, axes: Any = None) -> "Figure":
    """Draw a bar for each observation and network, from 0 (optimal) towards 1 (uniform play), with its interval.

    Args:
        axes: where to draw; None for a new figure.
    """
    cells = prediction.cells
    drawn, axis = single(axes, (6.4, 1.1 + 0.42 * len(cells)))
    rows = range(len(cells))
    same_network = len({cell.network for cell in cells}) == 1
    axis.barh(rows, [cell.value for cell in cells], color=COLORS[0], height=0.55)
    ends = [[cell.value - cell.low for cell in cells], [cell.high - cell.value for cell in cells]]
    axis.errorbar([cell.value for cell in cells], rows, xerr=ends, fmt="none", ecolor=INK, capsize=3, linewidth=1.2)
    axis.axvline(1.0, color=INK, linewidth=1, linestyle=(0, (4, 3)))
    right = max(1.15, *(cell.high + 0.05 for cell in cells))
    axis.set(
        yticks=list(rows),
        yticklabels=[cell.observation if same_network else cell.label for cell in cells],
        xlim=(0, right),
        xlabel=f"predicted regret of {prediction.agent.upper()} after {prediction.steps:,} steps"
        "  (0: optimal, 1: uniform play)",
        title=f"{prediction.environment}, {prediction.chance}",
    )
    axis.grid(axis="y", visible=False)
    axis.grid(axis="x", color=GRID)
    axis.invert_yaxis()
    return drawn
