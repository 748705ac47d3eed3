"""Charts of the report as SVG inside its page: a few shapes, no library. Texts are escaped by the tree that holds them.

Colours and text are classes of the page's style (`STYLE`), so that charts follow light and dark pages. Agent k has the
colour, the dash and the marker of its place, so that no line is told by its colour alone.
"""

from collections.abc import Mapping, Sequence
from xml.etree.ElementTree import Element, tostring

import numpy as np

from pharos.benchmark.scores import ConfidenceInterval

CONTENT_SECURITY_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
WIDTH = 340
MARKERS = ("M-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0z", "M-4 -4h8v8h-8z", "M0 -5l5 9h-10z", "M0 -5.5l5 5.5l-5 5.5l-5 -5.5z")
CIVIDIS = ((0, 34, 78), (60, 78, 109), (124, 123, 120), (187, 174, 107), (254, 232, 56))  # Nunez et al. (2018)
STYLE = """
:root { color-scheme: light dark; --ink: #23262d; --soft: #5c6370; --ground: #f6f7f9; --paper: #ffffff; --line: #dfe2e8;
  --c0: #0072b2; --c1: #d55e00; --c2: #00805d; --c3: #b5548c; --c4: #8a6d00; --c5: #5c6370; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #d8dbe2; --soft: #a0a7b4; --ground: #121419; --paper: #1b1e24; --line: #3a3f4a;
    --c0: #6fb4e8; --c1: #ff9248; --c2: #3cc79b; --c3: #e79ac5; --c4: #e6c34a; --c5: #a0a7b4; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
header, main { max-width: 1180px; margin: 0 auto; padding: 0 16px; }
header { padding-top: 24px; }
h1 { font-size: 26px; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 0 0 6px; }
p, li { max-width: 90ch; overflow-wrap: anywhere; }
p { margin: 6px 0 10px; }
.lead { font-size: 18px; }
.soft { color: var(--soft); font-size: 14px; }
.warning { border-left: 4px solid var(--c1); padding-left: 10px; }
section { background: var(--paper); border: 1px solid var(--line); border-radius: 10px; padding: 16px 18px;
  margin-bottom: 16px; }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 300px), 1fr)); gap: 14px 22px; }
figure { margin: 0; max-width: 480px; }
figcaption { font-weight: 600; }
figcaption .soft { font-weight: 400; display: block; }
svg { display: block; width: 100%; height: auto; overflow: visible; }
svg text { fill: var(--ink); font: 12px system-ui, sans-serif; }
svg .faint { fill: var(--soft); }
.grid { stroke: var(--line); fill: none; }
.edge { stroke: var(--soft); fill: none; }
.theory { stroke: var(--ink); stroke-width: 1.6; stroke-dasharray: 2 4; stroke-linecap: round; fill: none; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 14px; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 10px 3px 0; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
td.n, th.n { text-align: right; white-space: nowrap; }
.bar { width: 22%; }
.bar svg { height: 16px; min-width: 90px; }
.bar path { vector-effect: non-scaling-stroke; }
@media (max-width: 640px) {
  .bar { display: none; }
  td.n, th.n { white-space: normal; }
  td, th { padding-right: 6px; }
  td:first-child { overflow-wrap: anywhere; min-width: 100px; } }
.words td, .words th { overflow-wrap: anywhere; }
.words td:first-child { overflow-wrap: normal; min-width: 0; }
summary { cursor: pointer; color: var(--soft); }
.wide { max-width: 760px; }
.legend { display: flex; flex-wrap: wrap; gap: 2px 18px; list-style: none; margin: 0 0 10px; padding: 0; }
.legend li { display: flex; align-items: center; gap: 6px; }
.legend svg { width: 34px; flex: none; }
""" + "".join(
    f".l{k} {{ stroke: var(--c{k}); fill: none; stroke-width: {1.5 if k else 2.6}; }}\n.f{k} {{ fill: var(--c{k}); }}\n"
    for k in range(6)
)

Child = Element | str


def element(tag: str, *children: Child, **attributes: object) -> Element:
    """An element of HTML or SVG; `class_` is `class`, and other underscores are hyphens."""
    node = Element(tag, {name.rstrip("_").replace("_", "-"): _text(value) for name, value in attributes.items()})
    for child in children:
        if not isinstance(child, str):
            node.append(child)
        elif len(node):
            node[-1].tail = (node[-1].tail or "") + child
        else:
            node.text = (node.text or "") + child
    return node


def document(title: str, lead: Sequence[Element], sections: Sequence[Element]) -> str:
    """A page of HTML with its style, that loads and runs nothing."""
    meta = (
        {"charset": "utf-8"},
        {"name": "viewport", "content": "width=device-width, initial-scale=1"},
        {"http_equiv": "Content-Security-Policy", "content": CONTENT_SECURITY_POLICY},
    )
    head = element(
        "head", *(element("meta", **each) for each in meta), element("title", title), element("style", STYLE)
    )
    body = element("body", element("header", element("h1", title), *lead), element("main", *sections))
    return "<!doctype html>\n" + tostring(element("html", head, body, lang="en"), encoding="unicode", method="html")


def section(title: str, text: str, *parts: Element) -> Element:
    """A part of a page with a heading, and a soft text below it."""
    soft = [element("p", text, class_="soft")] if text else []
    return element("section", element("h2", title), *soft, *parts)


def captioned(caption: str, *parts: Element, text: str = "", class_: str = "") -> Element:
    """A figure with its caption."""
    soft = [element("span", text, class_="soft")] if text else []
    captions = [element("figcaption", caption, *soft)] if caption else []
    return element("figure", *captions, *parts, class_=class_)


def bullets(texts: Sequence[str]) -> Element:
    """A list of texts."""
    return element("ul", *(element("li", text) for text in texts))


def html_table(heads: Sequence[str], rows: Sequence[Sequence[Child]], numeric: Sequence[int] = ()) -> Element:
    """A table that scrolls if it is wide. Numbers of the columns `numeric` stand at the right."""

    def kind(k: int, cell: Child) -> str:
        return "n" if k in numeric else "bar" if not isinstance(cell, str) and cell.tag == "svg" else ""

    head = element("tr", *(element("th", name, class_=kind(k, rows[0][k])) for k, name in enumerate(heads)))
    body = [element("tr", *(element("td", cell, class_=kind(k, cell)) for k, cell in enumerate(row))) for row in rows]
    return element("div", element("table", element("thead", head), element("tbody", *body)), class_="scroll")


def _text(value: object) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def drawing(width: int, height: int, title: str, *shapes: Element) -> Element:
    """An SVG with a title for screen readers. Without a title it is hidden from them, as nearby text says the same."""
    name = {"role": "img", "aria_label": title} if title else {"aria_hidden": "true"}
    return element("svg", *shapes, viewBox=f"0 0 {width} {height}", **name)


def line(x1: float, y1: float, x2: float, y2: float, class_: str) -> Element:
    """A straight line."""
    return element("path", d=f"M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}", class_=class_)


def curve(points: Sequence[tuple[float, float]], class_: str) -> Element:
    """A line through points."""
    return element("path", d=path(points), class_=class_)


def path(points: Sequence[tuple[float, float]]) -> str:
    """A path of straight lines through points."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


def marker(x: float, y: float, agent: int, title: str = "") -> Element:
    """The marker of an agent, with a tooltip."""
    tip = [element("title", title)] if title else []
    shape, transform = MARKERS[agent % len(MARKERS)], f"translate({x:.1f} {y:.1f})"
    return element("path", *tip, d=shape, class_=f"f{agent % 6}", transform=transform)


def label(x: float, y: float, text: str, anchor: str = "start", class_: str = "") -> Element:
    """A text."""
    return element("text", text, x=float(x), y=float(y), text_anchor=anchor, class_=class_)


def legend(names: Sequence[str], theory: str | None = None) -> Element:
    """A list of agents with the marks of each. `theory` names the dashed line."""
    marks = [
        (name, drawing(34, 12, "", line(1, 6, 33, 6, f"l{k % 6}"), marker(17, 6, k))) for k, name in enumerate(names)
    ]
    if theory:
        marks.append((theory, drawing(34, 12, "", line(2, 6, 33, 6, "theory"))))
    return element("ul", *(element("li", mark, name) for name, mark in marks), class_="legend")


def bars(rows: Mapping[int, tuple[str, ConfidenceInterval]], title: str) -> Element:
    """Horizontal bars of scores in [0, 1] with their intervals: place of an agent -> its name and score."""
    left, wide, step = 122, 160, 24
    height = step * len(rows) + 18
    shapes = [line(left + wide * x, 0, left + wide * x, height - 16, "grid") for x in (0, 0.5, 1)]
    shapes += [label(left + wide * x, height - 3, f"{x:g}", "middle", "faint") for x in (0, 0.5, 1)]
    for row, (k, (name, score)) in enumerate(rows.items()):
        y = row * step + 4
        low, high = ends(score)
        shapes += [
            label(left - 6, y + 13, shortened(name, 18), "end"),
            element("rect", x=left, y=y, width=max(0.5, wide * score.value), height=16, class_=f"f{k % 6}"),
            line(left + wide * low, y + 8, left + wide * high, y + 8, "edge"),
            label(left + wide * high + 5, y + 13, f"{score.value:.2f}"),
        ]
    return drawing(WIDTH, height, title, *shapes)


def radar(axes: Sequence[str], scores: Sequence[Mapping[str, float]], title: str) -> Element:
    """Scores in [0, 1] along rays, one for each axis, with an outline for each agent."""
    size, middle, radius = 360, 180, 120
    angles = 2 * np.pi * np.arange(len(axes)) / len(axes) - np.pi / 2
    rays = np.column_stack([np.cos(angles), np.sin(angles)])

    def outline(lengths: Sequence[float]) -> list[tuple[float, float]]:
        points = middle + radius * rays * np.asarray(lengths)[:, None]
        return [(float(x), float(y)) for x, y in (*points, points[0])]

    shapes = [curve(outline([share] * len(axes)), "grid") for share in (0.5, 1.0)]
    shapes += [curve(outline([each.get(axis, 0.0) for axis in axes]), f"l{k % 6}") for k, each in enumerate(scores)]
    for axis, (x, y) in zip(axes, rays, strict=True):
        anchor = "middle" if abs(x) < 0.1 else "start" if x > 0 else "end"
        shapes.append(label(middle + 1.1 * radius * x, middle + 1.12 * radius * y + 4, axis, anchor))
    return drawing(size, size, title, *shapes)


def ladder_panel(
    levels: Sequence[float],
    lines: Sequence[Sequence[ConfidenceInterval | None]],
    theory: Sequence[float | None],
    frontier: ConfidenceInterval,
    unit: str,
    title: str,
) -> Element:
    """Normalised regret along the rungs of a ladder: the first line with whiskers and its frontier.

    Args:
        levels: of the rungs, which stand equally far apart. Between them the frontier is interpolated.
        lines: for each agent its normalised regret on each rung, None if it did not run.
        theory: of the idealised learner, None if it was not predicted.
        frontier: of the first agent, in units of `levels`.
        unit: label of the horizontal axis.
    """
    left, right, top, bottom = 54, WIDTH - 12, 24, 178
    height = (bottom - top) / 1.05

    def across(level: float) -> float:
        share = np.interp(level, levels, np.arange(len(levels))) / max(1, len(levels) - 1)
        return float(left + 10 + (right - left - 20) * share)

    def down(regret: float) -> float:
        return bottom - height * min(max(regret, 0.0), 1.05)

    shapes = regret_axis(left, right, down(1), bottom)
    shapes += [label(across(level), bottom + 15, f"{level:.3g}", "middle", "faint") for level in levels]
    shapes.append(label((left + right) / 2, bottom + 32, unit, "middle"))
    if np.isnan(frontier.value):
        shapes.append(label(left, top - 10, frontier_text(frontier)))
    else:
        low, high = map(across, ends(frontier))
        band = {"x": low, "y": top, "width": max(1.0, high - low), "height": bottom - top}
        shapes.append(element("rect", **band, class_="f0", opacity="0.16"))
        if not frontier.censored:
            shapes.append(line(across(frontier.value), top, across(frontier.value), bottom, "l0"))
        shapes.append(label(left, top - 10, f"frontier {frontier_text(frontier)}"))
    points = [(across(level), down(y)) for level, y in zip(levels, theory, strict=True) if y is not None]
    if points:
        shapes.append(curve(points, "theory"))
    for k, values in reversed(list(enumerate(lines))):
        rungs = [(across(level), each, level) for level, each in zip(levels, values, strict=True) if each is not None]
        if rungs:
            shapes.append(curve([(x, down(each.value)) for x, each, _ in rungs], f"l{k % 6}"))
        for x, each, level in rungs:
            if not k:
                shapes.append(line(x, down(ends(each)[0]), x, down(ends(each)[1]), "l0"))
            shapes.append(marker(x, down(each.value), k, f"{level:.4g}: regret {each.value:.2f}"))
    return drawing(WIDTH, bottom + 38, title, *shapes)


def difference_bar(difference: ConfidenceInterval) -> Element:
    """A difference of scores as a bar from the middle, with its interval."""
    value, low, high = (65 + 64 * max(-1.0, min(1.0, end)) for end in (difference.value, *ends(difference)))
    bar = {"x": min(65.0, value), "y": 4, "width": abs(value - 65), "height": 8, "class_": "f0" if value > 65 else "f1"}
    shapes = line(65, 0, 65, 16, "edge"), element("rect", **bar), line(low, 8, high, 8, "edge")
    picture = drawing(130, 16, "", *shapes)
    picture.set("preserveAspectRatio", "none")  # as wide as its column
    return picture


def learning_panel(steps: int, lines: Sequence[Sequence[ConfidenceInterval]], title: str) -> Element:
    """Normalised regret at evaluations, equally far apart up to `steps`: a line for each agent, the first with a band.

    Args:
        lines: for each agent its regret at each evaluation. An agent without any has an empty one, and keeps its
            colour.
    """
    left, right, top, bottom = 54, 540, 12, 220
    shapes = regret_axis(left, right, top, bottom)

    def at(share: float, regret: float) -> tuple[float, float]:
        return left + (right - left) * share, bottom - (bottom - top) * regret

    for k in range(4):
        shapes.append(label(at(k / 3, 0)[0], bottom + 15, f"{steps * k / 3:,.0f}", "middle", "faint"))
    shapes.append(label((left + right) / 2, bottom + 32, "steps", "middle"))
    for k, own in reversed([(k, own) for k, own in enumerate(lines) if own]):
        shares = [rank / len(own) for rank in range(1, len(own) + 1)]
        if not k:
            low, high = ([at(x, ends(each)[end]) for x, each in zip(shares, own, strict=True)] for end in (0, 1))
            shapes.append(element("path", d=path([*low, *reversed(high)]) + "Z", class_="f0", opacity="0.16"))
        points = [at(x, each.value) for x, each in zip(shares, own, strict=True)]
        shapes.append(curve(points, f"l{k % 6}"))
        for point, x, each in zip(points, shares, own, strict=True):
            shapes.append(marker(*point, k, f"{steps * x:,.0f} steps: regret {each.value:.2f}"))
    return drawing(560, bottom + 38, title, *shapes)


def regret_axis(left: float, right: float, top: float, bottom: float) -> list[Element]:
    """Lines of the optimal policy (below), of half and of random play (above), with their names."""
    heights = {"optimal": bottom, "0.5": (top + bottom) / 2, "random": top}
    shapes = [line(left, y, right, y, "grid" if name == "0.5" else "edge") for name, y in heights.items()]
    return shapes + [label(left - 5, y + 4, name, "end", "faint") for name, y in heights.items()]


def scatter(
    points: Sequence[tuple[str, float, float, float]], below: str, beside: Sequence[str], title: str
) -> Element:
    """Tasks as dots: (name, x, y, regret in [0, 1]), the darker the less regret, in a scale for all eyes.

    Args:
        below, beside: labels of the axes, the vertical one's in one line or two.
    """
    wide, left, right, top, bottom = 560, 52 + 16 * len(beside), 470, 12, 300
    xs, ys = (np.array([point[k] for point in points]) for k in (1, 2))
    (x0, x1), (y0, y1) = _range(xs), _range(ys)

    def at(x: float, y: float) -> tuple[float, float]:
        return left + (right - left) * (x - x0) / (x1 - x0), bottom - (bottom - top) * (y - y0) / (y1 - y0)

    shapes = []
    for x in _ticks(x0, x1):
        across, _ = at(x, y0)
        shapes += [line(across, top, across, bottom, "grid"), label(across, bottom + 16, f"{x:.2g}", "middle", "faint")]
    for y in _ticks(y0, y1):
        _, down = at(x0, y)
        shapes += [line(left, down, right, down, "grid"), label(left - 6, down + 4, f"{y:.2g}", "end", "faint")]
    shapes += [label((left + right) / 2, bottom + 36, below, "middle")]
    for x, text in zip((12, 28), beside, strict=False):
        turn = f"translate({x} {(top + bottom) / 2}) rotate(-90)"
        shapes.append(element("text", text, text_anchor="middle", transform=turn))
    for name, x, y, regret in points:
        (across, down), tip = at(x, y), element("title", f"{name}; regret {regret:.2f}")
        style = {"class_": "edge", "style": f"fill: {shade(regret)}"}
        shapes.append(element("circle", tip, cx=across, cy=down, r=7, **style))
    for k in range(40):
        shapes.append(
            element("rect", x=490, y=float(bottom - 60 - 4 * k - 4), width=14, height=4.2, fill=shade(k / 39))
        )
    shapes += [label(510, bottom - 58 - 160 * y, f"{y:g}", class_="faint") for y in (0, 0.5, 1)]
    shapes.append(label(490, bottom - 60 - 172, "regret"))
    return drawing(wide, bottom + 42, title, *shapes)


def shade(share: float) -> str:
    """Colour of a number in [0, 1] in the scale cividis, readable with colour vision deficiencies."""
    shares = np.linspace(0, 1, len(CIVIDIS))
    red, green, blue = (round(float(np.interp(share, shares, [color[k] for color in CIVIDIS]))) for k in range(3))
    return f"#{red:02x}{green:02x}{blue:02x}"


def _range(values: np.ndarray) -> tuple[float, float]:
    """Limits of an axis: of the values, with some room, at least a tenth wide."""
    room = max(0.05, 0.08 * float(np.ptp(values)))
    return float(values.min()) - room, float(values.max()) + room


def _ticks(low: float, high: float) -> list[float]:
    """Multiples of a quarter, or of a twentieth, between two numbers."""
    step = 0.25 if high - low > 0.5 else 0.05
    return [k * step for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def shortened(text: str, letters: int) -> str:
    """The text, shortened to a maximum number of letters."""
    return text if len(text) <= letters else text[: letters - 1] + "…"


def ends(interval: ConfidenceInterval) -> tuple[float, float]:
    """The ends of an interval, for drawing: both at the value if one seed leaves none."""
    return (interval.value, interval.value) if np.isnan(interval.low) else (interval.low, interval.high)


def frontier_text(frontier: ConfidenceInterval, unit: str = "", interval: bool = True) -> str:
    """A frontier in words: `9.4 bits (8.3 to 10.8)`, `beyond 24 bits (19 or more)`, `below 4 bits`."""
    if np.isnan(frontier.value):
        return "no frontier"
    side = {"above": "beyond ", "below": "below ", "": ""}[frontier.censored]
    text = f"{side}{frontier.value:.3g}{' ' if unit else ''}{unit}"
    low, high = ends(frontier)
    if not interval or low == high:
        return text
    if frontier.censored == "above":
        return text if low == frontier.value else f"{text} ({_level(low)} or more)"
    if frontier.censored == "below":
        return text if high == frontier.value else f"{text} ({_level(high)} or less)"
    return f"{text} ({_level(low)} to {_level(high)})"


def _level(level: float) -> str:
    return f"{level:.3g}" if np.isfinite(level) else "beyond the ladder" if level > 0 else "below the ladder"
