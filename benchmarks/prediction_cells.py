"""The published cells that `pharos predict` is calibrated on: predicted anew, beside the regret of their runs.

    python benchmarks/prediction_cells.py compute --out cells.csv [--block NAME ...]
    python benchmarks/prediction_cells.py judge [--cells cells.csv] [--resamples 1000]
    python benchmarks/prediction_cells.py orders [--cells cells.csv]
    python benchmarks/prediction_cells.py held [--cells cells.csv]
    python benchmarks/prediction_cells.py sealed [--resamples 1000]
    python benchmarks/prediction_cells.py collect
    python benchmarks/prediction_cells.py third [--cells cells.csv] [--resamples 1000]
    python benchmarks/prediction_cells.py pilots [--cells cells.csv] [--write]
    python benchmarks/prediction_cells.py draw [--cells cells.csv] [--picture docs/images/sealed.png]
    python benchmarks/prediction_cells.py other [--picture docs/images/other-classes.png]
    python benchmarks/prediction_cells.py ablations [--cells ablations.csv]
    python benchmarks/prediction_cells.py walks [--cells cells.csv] [--block NAME ...]
    python benchmarks/prediction_cells.py units [--cells cells.csv]
    python benchmarks/prediction_cells.py cost

`compute` reads the packed runs of docs/studies (twelve development classes: hardness-dev; fourteen sealed ones:
sealed-1; twice fourteen others: sealed-2 and sealed-3, blocks a to c) and computes the primary predictor of each cell,
and the one of before, `huber_regret` or `clipped_regret_evaluated`. A row that is there already is not computed again.
`judge` prints how well predictions agree with runs, by set and agent, of both: number of cells, R2 of classes left out
after a line, Spearman's rank correlation, the share of pairs of observations that are ordered rightly, R2 without a
fit, half the width of the 80 % interval and the share of classes left out that it covers; in brackets 95 % intervals
over classes drawn anew. Classes weigh alike. `orders` prints the pairs of observations by predicted difference. `held`
prints by predicted regret what the interval held, and how wide one of these cells alone would be, and of each sealed
set what such widths hold. `sealed` prints the same of the second sealed test, by block and predictor, and what the
interval of before it held. `collect` puts predictions and packed runs of the third one into its table of cells. `third`
prints its result, `huber_regret` beside `sampled_regret`, and what is missed by the unit of rewards. `other` prints the
result of the ten classes of other-classes, and draws it. `ablations` computes the primary predictors with one part left
out, on vectors and hashes of the second and third sealed set, and judges them. `walks` judges means of fewer and of
more walks of the idealised networks, which takes an hour. `pilots` prints how well a seed that is
cut after a share of its steps predicts others in both last sets, with the measure and without. `draw` draws predicted
against observed regret of the third sealed set. `cost` prints the seconds of a cell and the memory that it adds, each
in a process of its own that has compiled, by states of a grid, agent and observation.
"""

import argparse
import contextlib
import csv
import functools
import itertools
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from pharos import hardness, study
from pharos.agents import agent_called, primary_predictors
from pharos.prediction import Published
from pharos.prediction.calibration import BINS, CELLS_FILE, NUMBER_COLUMNS, REGRET_BINS
from pharos.prediction.learners import primary_regret
from pharos.prediction.pilot import PILOT_SHARES as PILOTS
from pharos.prediction.pilot import PILOTS_FILE
from pharos.statistics import spearman
from pharos.study.cross_validation import held_out
from pharos.study.tables import CELL
from pharos.training import RunConfig

STUDIES = Path(__file__).parents[1] / "docs" / "studies"
DEV = STUDIES / "hardness-dev"
# name -> (specification, packed runs, predictions that hold the primary predictor of a PPO)
BLOCKS = {
    "sealed-1": (STUDIES / "sealed-1" / "report.yaml", None, None),
    "sealed-2": (STUDIES / "sealed-2" / "report.yaml", None, None),
    "sealed-3": (STUDIES / "sealed-3" / "study.yaml", None, None),
    "dev-main": (DEV / "main-dqn.yaml", DEV / "main-dqn-runs.parquet", None),
    "dev-random": (DEV / "random-dqn.yaml", DEV / "random-dqn-runs.parquet", None),
    "dev-long": (DEV / "long-dqn.yaml", DEV / "long-dqn-runs.parquet", None),
    "dev-long-ppo": (
        DEV / "long-ppo.yaml", DEV / "long-ppo-runs.parquet", DEV / "long-ppo-clipped-predictions.parquet",
    ),
    "dev-long-random-ppo": (
        DEV / "long-random-ppo.yaml", DEV / "long-random-ppo-runs.parquet", DEV / "long-random-ppo-predictions.parquet",
    ),
}  # fmt: skip
SEEDS = 4
UNITS = 0.0, 0.5, 1.0, 3.0, 10.0, 20.0, 50.0, np.inf
COLUMNS = ("study", *CELL, "steps", "states", "spread", "predicted", "before", "observed", "seeds")
BEFORE = {"dqn": "huber_regret", "ppo": "clipped_regret_evaluated"}
"""Predictors until the third sealed test: columns of predictions."""


def cells_of(specification, runs):
    """Cells of packed runs: mean greedy regret, seeds, V* - U of the runs that are finished."""
    with tempfile.TemporaryDirectory() as folder:
        study.unpack(runs, Path(folder) / "runs", into=specification)
        table = study.table(specification, Path(folder) / "runs")
        cells = study.outcomes(table, study.curves(specification, Path(folder) / "runs"))
    table["spread"] = table["value_optimal"] - table["value_uniform"]
    return cells.merge(table.groupby(CELL).agg(seeds=("id", "size"), spread=("spread", "mean")), on=CELL)


def collect(name):
    """Write the cells of a sealed set: its predictions, beside the regret of its packed runs of four seeds."""
    source, frames = STUDIES / name, []
    for file in sorted(source.glob("predictions-*.parquet")):
        frame, record = study.read_predictions(file)
        frame = frame.assign(part=file.stem.removeprefix("predictions-"), predicted_at=record["date"])
        frames.append(frame.drop(columns=[each for each in frame if "curve" in each]))
    observed = pd.concat([cells_of(source / "study.yaml", runs) for runs in sorted(source.glob("runs-*.parquet"))])
    cells = pd.concat(frames).merge(observed[[*CELL, "greedy", "greedy_noise", "seeds", "spread"]], on=CELL)
    cells[cells["seeds"] == SEEDS].to_csv(source / "cells.csv", index=False, lineterminator="\n")
    print(f"{(cells['seeds'] == SEEDS).sum()} of {len(cells)} cells have {SEEDS} seeds")


def observed_of(block, specification, runs):
    """CELL -> (mean greedy regret, seeds, V* - U) of the runs that are finished."""
    if runs is None:  # of a sealed set, whose table of cells is kept
        cells = pd.read_csv(STUDIES / block / "cells.csv")
        if "part" in cells:  # plain, with the common hyperparameters: its primary test
            cells = cells[cells["part"].str[0].isin(["a", "b", "c"])]
    else:
        cells = cells_of(specification, runs)
    return {
        tuple(row[name] for name in CELL): row for row in cells.to_dict("records") if row["greedy"] == row["greedy"]
    }


def compute(out, blocks):
    done = set()
    if out.exists():
        with out.open(newline="") as file:
            done = {tuple(row[name] for name in ("study", *CELL)) for row in csv.DictReader(file)}
    with out.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if not done:
            writer.writeheader()
        for block in blocks:
            specification, runs, predictions = BLOCKS[block]
            cells = observed_of(block, specification, runs)
            told = {}
            if predictions is not None:
                frame, _ = study.read_predictions(predictions)
                told = {tuple(row[name] for name in CELL): row for row in frame.to_dict("records")}
            for run in study.specification(specification, trust=True).runs:
                key = tuple(run.cell.values())
                cell = {**run.cell, "agent": run.config["agent"]}  # without the name of its hyperparameters
                name = (block, *cell.values())
                if key not in cells or name in done:
                    continue
                done.add(name)
                known = {**cells[key], **told.get(key, {})}
                value, states = regret_of(run, known, primary_predictors()[run.config["agent"]])
                before, _ = regret_of(run, known, BEFORE[run.config["agent"]])
                if value == value:
                    row = {"steps": run.config["steps"], "states": int(states), "predicted": round(value, 6)}
                    row |= {"before": round(before, 6)}
                    row |= {"spread": float(f"{cells[key]['spread']:.6g}")}
                    row |= {"observed": round(cells[key]["greedy"], 6), "seeds": int(cells[key]["seeds"])}
                    writer.writerow({"study": block, **cell, **row})
                    file.flush()


def regret_of(run, known, name):
    """A predictor of a cell, from known columns or computed, and its number of states."""
    if name in known:
        return float(known[name]), known["num_states"]
    task = RunConfig.from_dict(run.config).task(trust=True, strict=True)
    measure = agent_called(run.config["agent"]).idealised.fallback if name in BEFORE.values() else None
    return primary_regret(run.config, task, measure=measure).value, task.mdp.num_states


def before(file):
    """Cells with what the predictors of before said of them."""
    frame = pd.read_csv(file)
    return frame.assign(predicted=frame["before"])


def judge(frame, resamples):
    one, two, three = (frame["study"] == name for name in ("sealed-1", "sealed-2", "sealed-3"))
    for agent in primary_predictors():
        for name, chosen in (
            ("twelve of development", ~one & ~two & ~three),
            ("the first fourteen sealed", one),
            ("the second fourteen sealed", two),
            ("the third fourteen sealed", three),
            ("all 54", one | ~one),
        ):
            cells = frame[(frame["agent"] == agent) & chosen]
            if len(cells):
                print(f"| {name} | {agent.upper()} | {len(cells)} | {said_of(cells, resamples)} |")


def orders(file):
    """Pairs of observations by predicted difference: all, those of the said sign, those that differ and are right."""
    frame = pd.read_csv(file)
    for agent in primary_predictors():
        known = of(frame[frame["agent"] == agent])
        counts = [known.ordered(low) for low in BINS]
        for words, values in (
            ("pairs", [each.pairs for each in counts]),
            ("less regret, however little", [each.right for each in counts]),
            ("less by more than 0.05", [f"{each.clear_right} of {each.clear_pairs}" for each in counts]),
        ):
            print(f"| {agent.upper()} | {words} | {' | '.join(map(str, values))} |")


HALF_WIDTHS = {"dqn": 0.138714, "ppo": 0.20712}
"""Of the intervals that `pharos predict` had when the second set was run: of the cells of before."""
PREDICTORS = {
    "dqn": ("sampled_regret", "kernel_regret", "sampled_descent", "sampled_adam", "sampled_tabular"),
    "ppo": ("clipped_regret_evaluated", "policy_regret_evaluated", "kernel_regret", "clipped_tabular_regret"),
}


def held(file):
    """By predicted regret: cells, the share that the interval held, and the half-width that would hold 0.8 of them."""
    frame = pd.read_csv(file)
    for agent in primary_predictors():
        known = of(frame[frame["agent"] == agent])
        near = [known.is_near(regret) for regret in REGRET_BINS]
        shares = [known.coverage(near=regret) for regret in REGRET_BINS]
        widths = [of(frame[frame["agent"] == agent][use]).half_width() for use in near]
        for words, texts in (
            ("cells", [f"{use.sum()}" for use in near]),
            (f"held by ± {known.half_width():.2f}", [f"{share:.2f}" for share in shares]),
            ("would have to be", [f"± {width:.2f}" for width in widths]),
        ):
            print(f"| {agent.upper()} | {words} | {' | '.join(texts)} |")


def widths_by_prediction(file):
    """Of each sealed set: what intervals of the other sets' cells hold, whose width follows the prediction or not."""
    frame = pd.read_csv(file)
    for name in ("sealed-1", "sealed-2", "sealed-3"):
        for agent in primary_predictors():
            cells = frame[frame["agent"] == agent]
            is_new = cells["study"] == name
            known, new, width = of(cells[~is_new]), of(cells[is_new]), np.zeros(is_new.sum())
            for regret in REGRET_BINS:
                width[new.is_near(regret)] = of(cells[~is_new][known.is_near(regret)]).half_width()
            table = pd.DataFrame({"class": new.classes, "width": width, "error": np.abs(new.observed - new.predicted)})
            table["follows"], table["one"] = table["error"] <= width, table["error"] <= known.half_width()
            of_all = table.groupby("class")[["follows", "one", "width"]].mean().mean()
            ratio = of_all["width"] / known.half_width()
            print(f"{name} {agent}: held {of_all['follows']:.2f} for {of_all['one']:.2f}, width {ratio:.2f} of it")


def sealed(resamples):
    """The second sealed test: blocks a to c by predictor, then d and e, then what the interval of before held."""
    frame = pd.read_csv(STUDIES / "sealed-2" / "cells.csv")
    for agent, predictors in PREDICTORS.items():
        mine = frame[frame["agent"].str.split().str[0] == agent]
        width = HALF_WIDTHS[agent]
        for blocks, names in (("abc", predictors), ("d", predictors[:1]), ("e", predictors[:1])):
            part = mine[mine["part"].str[0].isin([*blocks])]
            for name in names:
                print(row_of(part, blocks, name, width, resamples))


# The third sealed test: predictors, and half of the intervals that were named before it.
NAMED = {
    "dqn": {"huber_regret": 0.17, "sampled_regret": 0.18, "huber_descent": 0.17, "huber_adam": 0.17},
    "ppo": {"clipped_regret_evaluated": 0.19},
}


ASKED = {"dqn": (0.75, 0.5, 0.85, 0.82), "ppo": (0.6, 0.4, 0.8, 0.75)}
SHARE_HELD = 0.72, 0.88
MOST_MISSED = {"dqn": ("search",), "ppo": ("reservoir", "crafting", "jugs")}  # post hoc


def criteria(resamples):
    """Rows of the criteria of the third sealed test: (agent, criterion, asked for, found, whether it held)."""
    frame = pd.read_csv(STUDIES / "sealed-3" / "cells.csv")
    tested, rows = frame[frame["part"].str[0].isin([*"abc"])], []
    for agent, (least, end, rank, share) in ASKED.items():
        name, width = next(iter(NAMED[agent].items()))
        asked = least, end, rank, share
        found = verdicts(tested[tested["agent"] == agent], name, "greedy", width, asked, resamples)
        rows += [(agent, *row) for row in found]
    return rows


def verdicts(cells, name, observed, width, asked, resamples):
    """Rows of the criteria of a test: (criterion, asked for, found, whether it held)."""
    fields = row_of(cells.rename(columns={observed: "greedy"}), "abc", name, width, resamples)
    fields = fields.strip("| ").split(" | ")
    r_squared, low = (float(each) for each in re.findall(r"-?[0-9.]+", fields[4])[:2])
    classes = np.unique(cells["environment"], return_inverse=True)[1]
    once = np.ones((1, classes.max() + 1), int)
    held_rank = float(held_out(cells[[name]].to_numpy(), cells[observed].to_numpy(), classes, once)[1][0])
    pairs, inside = float(fields[6].split()[0]), float(fields[8].split()[0])
    found = r_squared, low, round(held_rank, 2), pairs
    words = "R²", "its lower end", "rank correlation of held-out predictions", "pairs of observations in order"
    rows = [(word, f"> {limit}", value, value > limit) for word, limit, value in zip(words, asked, found, strict=True)]
    span = f"{SHARE_HELD[0]} to {SHARE_HELD[1]}"
    return [*rows, (f"the interval of ± {width} holds", span, inside, SHARE_HELD[0] <= inside <= SHARE_HELD[1])]


def third(resamples):
    """The third sealed test: criteria, by predictor blocks a to c and d, the units, and the classes missed most."""
    for agent, words, asked, found, held in criteria(resamples):
        print(f"| {agent.upper()} | {words} | {asked} | {found:.2f} | {'held' if held else 'failed'} |")
    frame = pd.read_csv(STUDIES / "sealed-3" / "cells.csv")
    for agent, widths in NAMED.items():
        mine = frame[frame["agent"] == agent]
        for blocks in ("abc", "d"):
            part = mine[mine["part"].str[0].isin([*blocks])]
            for name, width in widths.items():
                if len(part):
                    print(row_of(part, blocks, name, width, resamples))
    for agent, widths in NAMED.items():
        tested = frame[(frame["agent"] == agent) & frame["part"].str[0].isin([*"abc"])]
        groups = {"V\\* - U above 20": tested["spread"] > 20, "V\\* - U below 0.5": tested["spread"] < 0.5}
        for words, chosen in groups.items():
            for name in [*widths][:2]:
                error, classes = (tested["greedy"] - tested[name])[chosen], tested["environment"][chosen]
                mean, size = (each.groupby(classes).mean().mean() for each in (error, error.abs()))
                print(f"| {words} | {agent.upper()} | `{name}` | {len(error)} | {mean:+.2f} | {size:.2f} |")
        for name in [*widths][:2]:
            misses = (tested["greedy"] - tested[name]).groupby(tested["environment"]).mean().sort_values()
            print(f"| {agent.upper()} | `{name}` | {', '.join(f'{key} {miss:+.2f}' for key, miss in misses.items())} |")
            fewer = tested[~tested["environment"].isin(MOST_MISSED[agent])]
            without = row_of(fewer, "abc", name, widths[name], resamples)
            print(without.replace("| a, b, c |", f"| {', '.join(MOST_MISSED[agent])} |"))


def beside(file, resamples):
    """DQN's predictor beside `sampled_regret`: R2 of classes left out of both, and the difference."""
    frame, key = before(file), ["study", *CELL, "steps"]
    frame = frame.merge(pd.read_csv(STUDIES / "sealed-3" / "sampled.csv"), on=key)
    is_sealed = frame["study"].str.startswith("sealed")
    rng = np.random.default_rng(0)
    for words, chosen in (
        ("the third sealed set", frame["study"] == "sealed-3"),
        ("the second and third", frame["study"].isin(["sealed-2", "sealed-3"])),
        ("all three sealed sets", is_sealed),
        ("twelve of development", ~is_sealed),
        ("all", is_sealed | ~is_sealed),
    ):
        cells = frame[chosen]
        both = of(cells), of(cells.assign(predicted=cells["sampled_regret"]))
        number = len(np.unique(both[0].classes))
        drawn = [np.bincount(rng.choice(number, number), minlength=number) for _ in range(resamples)]
        one, other = (statistics(each, np.array([np.ones(number, int), *drawn]))[0] for each in both)
        low, high = np.quantile((one - other)[1:], [0.025, 0.975])
        difference = f"{one[0] - other[0]:+.2f} ({low:+.2f} to {high:+.2f})"
        print(f"| {len(cells)}, {words} | {number} | {one[0]:.2f} | {other[0]:.2f} | {difference} |")


OTHER = STUDIES / "other-classes"
OTHER_WIDTHS = {"dqn": 0.14, "ppo": 0.08}
"""Half-widths of the intervals that its design names."""
OTHER_ASKED = 0.75, 0.5, 0.85, 0.82


def other_cells():
    """Cells of the ten other classes: what was predicted, and the regret of the packed runs."""
    frame, _ = study.read_predictions(OTHER / "predictions.parquet")
    runs = sorted(OTHER.glob("runs-*.parquet"))
    observed = pd.concat([cells_of(OTHER / "study.yaml", each) for each in runs]).rename(columns={"greedy": "observed"})
    cells = frame.merge(observed[[*CELL, "observed", "seeds", "spread"]], on=CELL).rename(
        columns={"num_states": "states"}
    )
    cells = cells.assign(study="other-classes", steps=30_000, predicted=primary_columns(cells))
    return cells.merge(pd.read_csv(OTHER / "before.csv"), on=CELL)


def primary_columns(cells):
    """The primary predictor of each cell's agent."""
    return sum(cells[name].where(cells["agent"] == agent, 0.0) for agent, name in primary_predictors().items())


def before_of_other():
    """Write what the predictors of before say of the ten other classes, computed after the runs."""
    rows = []
    for run in study.specification(OTHER / "study.yaml").runs:
        if run.config["seed"] == 0:
            value, _ = regret_of(run, {}, BEFORE[run.config["agent"]])
            rows.append({**run.cell, "before": round(value, 6)})
    pd.DataFrame(rows).to_csv(OTHER / "before.csv", index=False, lineterminator="\n")


def other(resamples):
    """The test on ten other classes: criteria and verdicts, then the row of each agent, then the misses."""
    frame = other_cells()
    for agent, width in OTHER_WIDTHS.items():
        cells = frame[frame["agent"] == agent]
        for words, limit, found, held in verdicts(cells, "predicted", "observed", width, OTHER_ASKED, resamples):
            print(f"| {agent.upper()} | {words} | {limit} | {found:.2f} | {'held' if held else 'failed'} |")
    for agent in OTHER_WIDTHS:
        cells = frame[frame["agent"] == agent]
        print(f"| {agent.upper()} | `{primary_predictors()[agent]}` | {len(cells)} | {said_of(cells, resamples)} |")
        earlier = cells.assign(predicted=cells["before"])
        print(f"| {agent.upper()} | `{BEFORE[agent]}` | {len(cells)} | {said_of(earlier, resamples)} |")
    later, _ = study.read_predictions(OTHER / "predictions-later.parquet")
    cells = frame.merge(later.assign(later=primary_columns(later))[[*CELL, "later"]], on=CELL)
    for agent, words in (("dqn", "eight walks"), ("ppo", "eight walks, mended")):
        of_agent = cells[cells["agent"] == agent]
        change = (of_agent["later"] - of_agent["predicted"]).abs()
        said = said_of(of_agent.assign(predicted=of_agent["later"]), resamples)
        words = f"{words}: by {change.mean():.3f} in the mean, {change.max():.2f} at most"
        print(f"| {agent.upper()} | {words} | {len(of_agent)} | {said} |")
    for agent in OTHER_WIDTHS:
        cells = frame[frame["agent"] == agent]
        misses = (cells["observed"] - cells["predicted"]).groupby(cells["environment"]).mean().sort_values()
        print(f"| {agent.upper()} | {', '.join(f'{key} {miss:+.2f}' for key, miss in misses.items())} |")


PARTS = {
    "all parts": {},
    "kernels that stay as they are": {"grows": False},
    "every parameter's gradient alike": {"even": True},
    "neither": {"grows": False, "even": True},
    "gradients that are not averaged": {"averages": False},
}
MISSED = "dosing", "lander", "tides", "machines", "network", "workshop"
"""Classes of the second sealed set that predictors of a DQN missed: three where chance decides, three by the unit."""


def ablations(file, resamples):
    """Primary predictors without one of their parts, on the vectors and hashes of two sealed sets."""
    done = pd.read_csv(file) if file != CELLS_FILE and file.exists() else None
    if done is None:
        rows = []
        for block in ("sealed-2", "sealed-3"):
            cells = observed_of(block, BLOCKS[block][0], None)
            for run in study.specification(BLOCKS[block][0], trust=True).runs:
                key = tuple(run.cell.values())
                if key not in cells or run.config["seed"] or run.config["observation"] not in ("vector", "hash"):
                    continue
                task = RunConfig.from_dict(run.config).task(trust=True, strict=True)
                row = {"study": block, **run.cell, "agent": run.config["agent"], "steps": run.config["steps"]}
                row |= {"states": task.mdp.num_states, "spread": cells[key]["spread"], "observed": cells[key]["greedy"]}
                for words, left_out in PARTS.items():
                    with without(**left_out):
                        row[words] = primary_regret(run.config, task).value
                rows.append(row)
                print(len(rows), *run.cell.values(), *(f"{row[words]:.2f}" for words in PARTS), flush=True)
        done = pd.DataFrame(rows)
        if file != CELLS_FILE:
            done.to_csv(file, index=False, lineterminator="\n")
    for agent in primary_predictors():
        for words in PARTS:
            cells = done[done["agent"] == agent]
            said = said_of(cells.assign(predicted=cells[words]), resamples)
            print(f"| {agent.upper()} | {words} | {len(cells)} | {said} |")
    of_dqn = done[done["agent"] == "dqn"]
    misses = of_dqn[[*PARTS]].rsub(of_dqn["observed"], axis=0).groupby(of_dqn["environment"]).mean()
    for name in MISSED:
        print(f"| {name} | {' | '.join(f'{misses.loc[name, words]:+.2f}' for words in PARTS)} |")


@contextlib.contextmanager
def without(grows=True, even=False, averages=True):
    """Idealised networks whose kernels stay as they are, or whose gradients are alike or not averaged over steps.

    Nothing is kept.
    """
    from pharos.hardness.representation import learning, network_regret

    settle, report, made = network_regret.IdealisedNetwork.settle, hardness.report, learning.OutputLayer.__init__

    def stay(network):
        last, gram = network.net.last.copy(), network.net.gram.copy()
        settle(network)
        network.net.last[:], network.net.gram[:] = last, gram

    def alike(layer, kernel, weights, parameters, evenness, *more, **named):
        made(layer, kernel, weights, parameters, (1.0, 1.0), *more, **named)

    def measure(*arguments, adam=None, **named):
        if not averages and adam is not None:
            adam = replace(adam, decay=0.0)
        return report(*arguments, adam=adam, **{**named, "keep": False})

    try:
        hardness.report = measure
        network_regret.IdealisedNetwork.settle = settle if grows else stay
        learning.OutputLayer.__init__ = alike if even else made
        yield
    finally:
        network_regret.IdealisedNetwork.settle, hardness.report = settle, report
        learning.OutputLayer.__init__ = made


NUMBERS_OF_WALKS = 1, 2, 3, 4, 6, 8, 12


def walks(file, blocks, resamples):
    """Primary predictors as the mean of fewer and of more walks, the first ones of each cell."""
    frame, of_cells = pd.read_csv(file), {}
    with each_walk(max(NUMBERS_OF_WALKS)) as values:
        for block in blocks:
            published = {tuple(row) for row in frame.loc[frame["study"] == block, CELL].to_numpy()}
            for run in study.specification(BLOCKS[block][0], trust=True).runs:
                key = tuple({**run.cell, "agent": run.config["agent"]}.values())
                if key in published and (block, *key) not in of_cells:
                    primary_regret(run.config, RunConfig.from_dict(run.config).task(trust=True, strict=True))
                    of_cells[block, *key] = values.pop()
                    print(len(of_cells), *key, *np.round(of_cells[block, *key], 2), flush=True)
    frame = frame[frame["study"].isin(blocks)]
    columns = np.array([of_cells[tuple(row)] for row in frame[["study", *CELL]].to_numpy()]).T
    for agent in primary_predictors():
        is_of_agent = frame["agent"] == agent
        for number in NUMBERS_OF_WALKS:
            cells = frame.assign(predicted=columns[:number].mean(axis=0))[is_of_agent]
            if len(cells):
                luck = columns[:, is_of_agent].var(axis=0, ddof=1).mean() / number
                share = luck / ((cells["observed"] - cells["predicted"]) ** 2).mean()
                print(f"| {agent.upper()} | {number} | {len(cells)} | {said_of(cells, resamples)} | {share:.2f} |")


@contextlib.contextmanager
def each_walk(number):
    """A list to which measures of idealised networks append the values of so many walks; nothing is kept."""
    from pharos.hardness.representation.network_regret import NetworkQLearner

    measured, report, few, values = NetworkQLearner.measured_in_network, hardness.report, hardness.NETWORK_WALKS, []

    def told(learner, settings):
        result = measured(learner, settings)
        values.append(result.curve.walks)
        return result

    try:
        hardness.report, hardness.NETWORK_WALKS = functools.partial(report, keep=False), number
        NetworkQLearner.measured_in_network = told
        yield values
    finally:
        hardness.report, hardness.NETWORK_WALKS, NetworkQLearner.measured_in_network = report, few, measured


def units(frame):
    """Mean of observed less predicted regret by V* - U, classes weighing alike."""
    frame["miss"] = frame["observed"] - frame["predicted"]
    for low, high in itertools.pairwise(UNITS):
        part = frame[(frame["spread"] >= low) & (frame["spread"] < high)]
        words = f"{low:g} to {high:g}" if high < np.inf else f"{low:g} and more"
        texts = [f"{part['environment'].nunique()}"]
        for agent in primary_predictors():
            of_agent = part[part["agent"] == agent]
            texts.append(f"{of_agent.groupby('environment')['miss'].mean().mean() + 0.0:+.2f}")
        print(f"| {words} | {' | '.join(texts)} |")


def misses_of_second(frame):
    """Mean of observed less predicted regret of a DQN in classes of the second sealed set that any predictor missed."""
    told = pd.read_csv(STUDIES / "sealed-2" / "cells.csv")[[*CELL, "sampled_regret"]]
    cells = frame[(frame["study"] == "sealed-2") & (frame["agent"] == "dqn")].merge(told, on=CELL)
    columns = "predicted", "before", "sampled_regret"
    misses = cells[[*columns]].rsub(cells["observed"], axis=0).groupby(cells["environment"]).mean()
    for name, row in misses[misses.abs().max(axis=1) > 0.1].iterrows():
        print(f"| {name} | {' | '.join(f'{row[column]:+.2f}' for column in columns)} |")


def row_of(part, blocks, name, width, resamples):
    """A row of the table of a sealed test: of cells and a predictor, with the share that lies within `width`."""
    cells = part.rename(columns={name: "predicted", "greedy": "observed", "num_states": "states"})
    cells = cells.assign(study="sealed", steps=30_000)
    inside = (cells["predicted"] - cells["observed"]).abs() <= width
    held = inside.groupby(cells["environment"]).mean().mean()
    title = f"{', '.join(blocks)} | {part['agent'].iloc[0].split()[0].upper()} | `{name}` | {len(cells)}"
    r_squared, rho, pairs, unfitted, *_ = said_of(cells, resamples).split(" | ")
    return f"| {title} | {r_squared} | {rho} | {pairs} | {unfitted} | {held:.2f} of ± {width:.2f} |"


def said_of(cells, resamples):
    """The columns of a row of the table: of the cells, with intervals over classes drawn anew."""
    rng, known = np.random.default_rng(0), of(cells)
    number = len(np.unique(known.classes))
    drawn = [np.bincount(rng.choice(number, number), minlength=number) for _ in range(resamples)]
    values = statistics(known, np.array([np.ones(number, int), *drawn]))
    r_squared, rho, unfitted, pairs = (
        "{:.2f} ({:.2f} to {:.2f})".format(*(round(end, 2) + 0.0 for end in (each[0], low, high)))
        for each in values for low, high in [np.nanquantile(each[1:], [0.025, 0.975])]
    )  # fmt: skip
    width = f"± {known.half_width():.2f} | {known.coverage():.2f}"
    return f"{r_squared} | {rho} | {pairs} of {len(known.pairs.first)} | {unfitted} | {width}"


SHARES = (0.05, 0.1, 0.25, 0.5, 1.0)


def regrets_of(name):
    """(a row for each run of blocks a to c of a sealed set, (runs, evaluations) normalised regret)."""
    source = STUDIES / name
    if name == "sealed-2":
        curves = pd.read_parquet(source / "curves.parquet")
        curves = curves[curves["part"].str[0].isin(["a", "b", "c"])]
        spread = (curves["value_optimal"] - curves["value_uniform"]).to_numpy()[:, None]
        return curves[[*CELL, "seed"]], (
            curves["value_optimal"].to_numpy()[:, None] - np.stack(curves["value"])
        ) / spread
    frames = []
    for runs in sorted(source.glob("runs-*.parquet")):
        with tempfile.TemporaryDirectory() as folder:
            study.unpack(runs, Path(folder) / "runs", into=source / "study.yaml")
            frames.append(study.curves(source / "study.yaml", Path(folder) / "runs"))
    curves = pd.concat(frames)
    wide = curves[curves["chance"] == "plain"].pivot(index=[*CELL, "seed"], columns="step", values="normalized_regret")
    return wide.index.to_frame(index=False), wide.to_numpy()


def pilot_cells(file):
    """Cells of two sealed sets: the prediction, one seed's regret so far by share, and that of the others."""
    frame, parts = pd.read_csv(file), []
    for name in ("sealed-2", "sealed-3"):
        runs, regret = regrets_of(name)
        share = np.linspace(0, 1, regret.shape[1])
        so_far = {f"{part:.0%}": regret[:, share <= part + 1e-9].mean(axis=1) for part in SHARES}
        cells = runs.assign(**so_far)
        others = cells[cells["seed"] > 0].groupby(CELL)["100%"].mean().rename("others").reset_index()
        parts.append(cells[cells["seed"] == 0].merge(others, on=CELL).merge(frame[frame["study"] == name], on=CELL))
    return pd.concat(parts)


def r_squared_of_pilots(file):
    """Yield (agent, words, R2 of classes left out): pilots, pilots with the measure, and the measure alone.

    After a line or a plane through the cells of the other classes, of the mean regret of three other seeds.
    """
    cells, names = pilot_cells(file), [f"{share:.0%}" for share in SHARES]
    for agent in primary_predictors():
        of_agent = cells[cells["agent"] == agent]
        y, classes = of_agent["others"].to_numpy(), np.unique(of_agent["environment"], return_inverse=True)[1]
        counts = np.ones((1, classes.max() + 1), int)
        for words, columns in (
            ("a pilot", [[name] for name in names]),
            ("a pilot and the measure", [[name, "predicted"] for name in names]),
            ("the measure alone", [["predicted"]]),
        ):
            yield agent, words, [float(held_out(of_agent[x].to_numpy(), y, classes, counts)[0][0]) for x in columns]


def pilots(file, write=False):
    """A pilot beside the measure on two sealed sets: one seed, cut after a share of its steps, for the others."""
    if write:
        cells = pilot_cells(file)
        kept = cells[[*CELL, "predicted", "others"]].assign(**{str(share): cells[f"{share:.0%}"] for share in PILOTS})
        kept.round(6).to_csv(PILOTS_FILE, index=False, lineterminator="\n")
    for agent, words, values in r_squared_of_pilots(file):
        texts = [f"{value:.2f}" for value in values] + [""] * (len(SHARES) - len(values))
        print(f"| {agent.upper()} | {words} | {' | '.join(texts)} |")


def draw(frame, picture):
    """Predicted against observed regret of cells, a panel for each agent."""
    from pharos.plots import save
    from pharos.plots.style import GRID_COLOR, LINE_COLORS, panels, styled

    @styled
    def by_agent():
        drawn, axes = panels(2, 3.4, 3.3)
        for axis, agent in zip(axes, primary_predictors(), strict=True):
            cells = frame[frame["agent"] == agent]
            most = 1.05 * cells[["predicted", "observed"]].to_numpy().max()
            axis.plot([0, most], [0, most], color=GRID_COLOR, zorder=0)
            for number, (name, some) in enumerate(cells.groupby(cells["observation"].str.split("[(,]").str[0])):
                label = name.replace("_", " ")
                axis.scatter(
                    some["predicted"], some["observed"], 14, LINE_COLORS[number], label=label, alpha=0.8, linewidth=0
                )
            axis.set(
                xlim=(0, most), ylim=(0, most), xlabel="predicted regret", title=f"{agent.upper()}, {len(cells)} cells"
            )
        axes[0].set_ylabel("observed regret")
        axes[0].legend(loc="upper left", handletextpad=0.2)
        return drawn

    print(save(by_agent(), picture))


SIDES = (4, 10, 18, 32, 64)
OBSERVATIONS = ("vector", "one_hot", "hash", "simple_image")
CELL_OF_A_GRID = """
import resource, sys, time
import pharos
agent, observation, side = sys.argv[1], sys.argv[2], int(sys.argv[3])
pharos.predict("simple_grid", observation, agent=agent, height=3, width=3)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
began = time.perf_counter()
pharos.predict("simple_grid", observation, agent=agent, height=side, width=side)
seconds = time.perf_counter() - began
print(f"{seconds:.1f} s, {(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024:.0f} MB")
"""


def cost():
    print(f"| agent | states | {' | '.join(OBSERVATIONS)} |")
    print("|---|---|" + "---|" * len(OBSERVATIONS))
    for agent in primary_predictors():
        for side in SIDES:
            with tempfile.TemporaryDirectory() as folder:
                environment = {**os.environ, "PHAROS_CACHE_DIR": folder}
                texts = [
                    subprocess.run(
                        [sys.executable, "-c", CELL_OF_A_GRID, agent, observation, str(side)],
                        env=environment, capture_output=True, text=True, check=True,
                    ).stdout.strip()
                    for observation in OBSERVATIONS
                ]  # fmt: skip
            print(f"| {agent.upper()} | {side * side:,} | {' | '.join(texts)} |", flush=True)


def of(cells):
    mdps = cells["study"] + " " + cells["instance"] + " " + cells["chance"]
    numbers = (cells[name].to_numpy(float) for name in NUMBER_COLUMNS)
    return Published(cells["environment"].to_numpy(str), mdps.to_numpy(str), *numbers)


def statistics(known, counts):
    """((R,) R2 of classes left out, (R,) rank correlation, (R,) R2 without a fit, (R,) share of pairs in order).

    Args:
        counts: (R, C) how often each class counts in each of R samples. A class is left out wherever it stands.
    """
    x, y, classes = known.predicted, known.observed, np.unique(known.classes, return_inverse=True)[1]
    number, pairs = counts.shape[1], known.pairs
    sizes, total = np.bincount(classes), counts.sum(axis=1)
    mean, squares, errors = (counts @ (np.bincount(classes, of) / sizes) / total for of in (y, y**2, (y - x) ** 2))
    right = np.bincount(classes[pairs.first], pairs.right(x), minlength=number)
    of_pairs = counts @ np.bincount(classes[pairs.first], minlength=number)
    rows = [np.repeat(np.arange(len(y)), count[classes]) for count in counts]
    return (
        held_out(x[:, None], y, classes, counts)[0],
        np.array([spearman(x[some], y[some]) for some in rows]),
        1 - errors / (squares - mean**2),
        np.divide(counts @ right, of_pairs, out=np.full(len(counts), np.nan), where=of_pairs > 0),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "task",
        choices=(
            *("compute", "judge", "orders", "held", "sealed", "collect", "third", "pilots", "draw", "cost"),
            *("other", "ablations", "walks", "units"),
        ),
    )
    parser.add_argument("--out", type=Path, default=CELLS_FILE)
    parser.add_argument("--cells", type=Path, default=CELLS_FILE)
    parser.add_argument("--block", action="append", choices=[*BLOCKS])
    parser.add_argument("--write", action="store_true", help="write what `pharos predict --pilot` rests on")
    parser.add_argument("--resamples", type=int, default=1000)
    parser.add_argument("--picture", type=Path, default=STUDIES.parent / "images" / "sealed.png")
    arguments = parser.parse_args()
    if arguments.task == "compute":
        compute(arguments.out, arguments.block or [*BLOCKS])
    elif arguments.task == "judge":
        judge(pd.read_csv(arguments.cells), arguments.resamples)
        judge(before(arguments.cells), arguments.resamples)
    elif arguments.task == "orders":
        orders(arguments.cells)
    elif arguments.task == "held":
        held(arguments.cells)
        widths_by_prediction(arguments.cells)
    elif arguments.task == "sealed":
        sealed(arguments.resamples)
    elif arguments.task == "collect":
        collect("sealed-3")
    elif arguments.task == "third":
        third(arguments.resamples)
        beside(arguments.cells, arguments.resamples)
        units(before(arguments.cells))
    elif arguments.task == "pilots":
        pilots(arguments.cells, arguments.write)
    elif arguments.task == "cost":
        cost()
    elif arguments.task == "other":
        if not (OTHER / "before.csv").exists():
            before_of_other()
        other(arguments.resamples)
        draw(other_cells(), STUDIES.parent / "images" / "other-classes.png")
    elif arguments.task == "units":
        units(pd.read_csv(arguments.cells))
        misses_of_second(pd.read_csv(arguments.cells))
    elif arguments.task == "walks":
        walks(arguments.cells, arguments.block or [*BLOCKS], arguments.resamples)
    elif arguments.task == "ablations":
        ablations(arguments.cells, arguments.resamples)
    else:
        frame = before(arguments.cells)
        draw(frame[frame["study"] == "sealed-3"], arguments.picture)


if __name__ == "__main__":
    main()
