"""Values that the quantitative verification benchmark set publishes, beside proven intervals of pharos.

    python benchmarks/qcomp.py CHECKOUT [--states 3000] [--out docs/evidence/goals.md]

CHECKOUT is one of https://github.com/ahartmanns/qcomp, whose models stay there. Each exact result of an MDP or a Markov
chain with at most so many states is asked for by its name, as `pharos import prism FILE --property NAME` does, at
gamma 1 without a horizon. Needs stormpy, which builds the models; the values are those of pharos. An interval is right
if it holds the published rational number, and tight if it is less than 1e-6 wide, or 1e-6 of the number beyond 1.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import pharos
from pharos import importers
from pharos.errors import PharosError

KINDS = ("mdp", "dtmc")
TOLERANCE = 1e-6


class Case(NamedTuple):
    """A published result: its file, constants, and property."""

    family: str
    file: Path
    constants: str
    name: str
    value: Fraction | float
    states: int


class Row(NamedTuple):
    """A case with the proven interval, or with what went wrong."""

    case: Case
    lower: float
    upper: float
    states: int
    seconds: float
    problem: str = ""
    difference: str = ""

    @property
    def holds(self) -> bool:
        value = self.case.value
        if isinstance(value, float):  # infinite
            return self.lower == self.upper == value
        return not self.problem and Fraction(self.lower) <= value <= Fraction(self.upper)

    @property
    def is_tight(self) -> bool:
        return self.lower == self.upper or self.upper - self.lower <= 2 * TOLERANCE * max(1.0, abs(self.upper))


def cases(checkout: Path, most: int) -> Iterator[Case]:
    """Exact results of the instances with at most so many states."""
    sys.set_int_max_str_digits(0)  # some rationals have thousands of digits
    for index in sorted(path for kind in KINDS for path in checkout.glob(f"benchmarks/{kind}/*/index.json")):
        model = json.loads(index.read_text())
        for file in model["files"]:
            for setting in file.get("open-parameter-values", []):
                sizes = [each["number"] for each in setting.get("states", []) if isinstance(each.get("number"), int)]
                if not sizes or min(sizes) > most:
                    continue
                values = {each["name"]: each["value"] for each in setting.get("values", [])}
                constants = ",".join(f"{name}={str(value).lower()}" for name, value in values.items())
                for result in setting.get("results", []):
                    value = number(result["value"])
                    if value is not None and "exact" in str(result.get("note")):
                        path = index.parent / file["file"]
                        yield Case(model["short"], path, constants, result["property"], value, min(sizes))


def number(value: Any) -> Fraction | float | None:
    """A published value as a rational number, or infinity; None: no number."""
    if isinstance(value, dict) and "num" in value:
        return Fraction(int(value["num"]), int(value["den"]))
    if isinstance(value, bool):
        return None
    if isinstance(value, int | float):
        return math.inf if math.isinf(value) else Fraction(value)
    return math.inf if value in ("inf", "infinity", "Infinity") else None


def solved(case: Case) -> Row:
    """The interval of a case, by the way of the command line."""
    began = time.perf_counter()
    try:
        mdp, _, question = importers.storm_import(case.file, constants=case.constants, property=case.name)
        assert question is not None
        if question.reach is None:
            raise PharosError(f"asks for {question.answer}")
        bounds = getattr(pharos.reach(mdp, question.reach, tolerance=TOLERANCE), question.answer)
    except PharosError as error:
        return Row(case, math.nan, math.nan, 0, time.perf_counter() - began, str(error))
    lower, upper = bounds.lower[mdp.starts], bounds.upper[mdp.starts]
    pick = {"max": max, "min": min}.get(question.of_starts, lambda values: sum(values) / len(values))
    row = Row(case, float(pick(lower)), float(pick(upper)), mdp.num_states, time.perf_counter() - began)
    return row if row.holds else row._replace(difference=f"Storm's own solver: {by_storm(case)}")


def by_storm(case: Case) -> str:
    """The value that the solver of the installed Storm gives: it may read a file otherwise than the one of then."""
    import stormpy

    program, properties = stormpy.parse_jani_model(str(case.file))
    if case.constants:
        program, properties = stormpy.instantiate_constants(program, case.constants, properties)
    query = next(each for each in properties if each.get_name() == case.name)
    model = stormpy.build_model(program, options=stormpy.BuilderOptions([query.get_raw_formula()]))
    return f"{stormpy.model_checking(model, query)[model.initial_states[0]].value:.6g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("--states", type=int, default=3000)
    parser.add_argument("--family", default="")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for case in cases(options.checkout, options.states):
        if options.family in ("", case.family) and case.file.exists():  # the largest ones are compressed
            rows.append(solved(case))
            row = rows[-1]
            verdict = row.problem or ("right" if row.holds else f"WRONG, {row.difference}") + (
                "" if row.is_tight else ", wide"
            )
            print(f"{case.file.name} {case.constants} {case.name}: [{row.lower!r}, {row.upper!r}], {row.states} states,"
                  f" {row.seconds:.1f} s: {verdict}", flush=True)  # fmt: skip
    right = [row for row in rows if row.holds]
    print(f"{len(rows)} results, {len(right)} right, of these {sum(row.is_tight for row in right)} tight")
    if options.out is not None:
        options.out.write_text(page(rows, options.states))


def page(rows: list[Row], most: int) -> str:
    """The page of what was measured: a line a family, and a line for each result of its smallest instance."""
    right = [row for row in rows if row.holds]
    unanswered = [row for row in rows if row.problem]
    families = list(dict.fromkeys(row.case.family for row in rows))
    lines = [
        "# Published values of goals",
        "",
        "The [quantitative verification benchmark set](https://qcomp.org/benchmarks) publishes exact results, which",
        "Storm computed, of models in PRISM's language, Modest, PPDDL and JANI. All of MDPs and Markov chains with at",
        f"most {most:,} states were asked for by their names, as `pharos import prism FILE --property NAME` does, and",
        "answered by `pharos.reach` at gamma 1 without a horizon, in 64-bit floats.",
        "",
        f"**{len(right)} of {len(rows) - len(unanswered)} proven intervals hold the published number.** Of these, "
        f"{sum(row.is_tight for row in right)} are within 1e-6, or 1e-6 of the",
        f"number if it is above 1. {len(unanswered)} more results are of properties with bounds on steps or rewards, "
        "which pharos does not answer.",
        "",
        "```",
        "python benchmarks/qcomp.py CHECKOUT --states 30000 --out docs/evidence/goals.md",
        "```",
        "",
        "| family | results | right | not answered | states, up to | widest, of numbers above 1 relative |",
        "|---|---|---|---|---|---|",
    ]
    for family in families:
        own = [row for row in rows if row.case.family == family]
        good = [row for row in own if row.holds]
        widths = [(row.upper - row.lower) / max(1.0, row.upper) for row in good if math.isfinite(row.upper)]
        lines.append(
            f"| {family} | {len(own)} | {len(good)} | {sum(bool(row.problem) for row in own)} | "
            f"{max(row.states for row in own):,} | {max(widths, default=0.0) / 2:.1e} |"
        )
    lines += [
        "",
        "The smallest instance of each family:",
        "",
        "| model | property | states | published | proven, middle | within |",
        "|---|---|---|---|---|---|",
    ]
    for family in families:
        answered = [row for row in rows if row.case.family == family and not row.problem]
        least = min((row.case.states for row in answered), default=0)
        first = next((row.case for row in answered if row.case.states == least), None)
        lines += [line(row) for row in answered if first and row.case[1:3] == first[1:3]]
    return "\n".join(lines) + "\n"


def line(row: Row) -> str:
    """A result as a line of a table."""
    case = row.case
    model = " ".join(filter(None, (case.file.name.rpartition(".")[0], case.constants.replace(",", ", "))))
    if not row.holds:
        return f"| {model} | {case.name} | {row.states:,} | {text_of(case.value)} | differs; {row.difference} | - |"
    middle = "infinite" if math.isinf(row.upper) else f"{(row.lower + row.upper) / 2:.12g}"
    width = "-" if math.isinf(row.upper) else f"{(row.upper - row.lower) / 2:.1e}"
    return f"| {model} | {case.name} | {row.states:,} | {text_of(case.value)} | {middle} | {width} |"


def text_of(value: Fraction | float) -> str:
    """A rational number if it is short, else its decimal."""
    if isinstance(value, float):
        return "infinite"
    text = str(value)
    return text if len(text) <= 24 else f"{float(value):.12g}"


if __name__ == "__main__":
    main()
