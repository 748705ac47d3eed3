"""The tables and figures of docs/article.md, from the packed runs in docs/studies.

    python scripts/article.py            # prints the tables
    python scripts/article.py --draw     # draws the figures into docs/images

Verdicts, effects and intervals are those of `study.findings`, predictions are judged by `study.validation`, as in the
report of a study. No agent is trained and no state space is built: hardness is read from hardness.csv beside the runs.
"""

import argparse
import json
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from pharos import study
from pharos.study.blocks import Run
from pharos.study.specification import parse
from pharos.study.tables import row_of
from pharos.training import CELL, RunConfig
from pharos.validation.cross_validation import class_predictions
from pharos.validation.prediction import FILE

ROOT = Path(__file__).parents[1]
STUDIES = ROOT / "docs" / "studies"
IMAGES = ROOT / "docs" / "images"
SEALED = STUDIES / "sealed-1"
SMALL = ("simple_grid", "frozen_lake")
NAMES = {"simple_grid": "grids", "frozen_lake": "lakes", "freeway": "Freeway", "breakout": "Breakout", "all": "all"}
SAME_HARD = "DQN and PPO find the same hard"
PRIMARY = {"dqn": "kernel_regret", "ppo": "clipped_regret_evaluated"}
ROWS = (  # of the table of findings: in words, the finding and its class as in `study.findings`
    ("images harder for DQN: grids", "the harder observation of DQN", "simple_grid"),
    ("images harder for DQN: lakes", "the harder observation of DQN", "frozen_lake"),
    ("vectors harder for DQN: Freeway", "the harder observation of DQN", "freeway"),
    ("vectors harder for DQN: Breakout", "the harder observation of DQN", "breakout"),
    ("DQN worse than a table: grids", "the learner with more regret", "simple_grid"),
    ("DQN worse than a table: lakes", "the learner with more regret", "frozen_lake"),
    ("a table worse than DQN: Freeway", "the learner with more regret", "freeway"),
    ("a table worse than DQN: Breakout", "the learner with more regret", "breakout"),
    ("one model explains next to nothing (R² 0.09)", "one model explains next to nothing", "all"),
    (
        "one by representation explains more (0.48)",
        "models by representation explain more than one",
        "all",
    ),
    ("one by class explains more (0.65)", "models by class explain more than one", "all"),
    (
        "vectors are explained better than images (0.6, 0.3)",
        "hardness explains vectors better than images",
        "all",
    ),
    (f"{SAME_HARD} (r = 0.81)", SAME_HARD, "all"),
)


@cache
def packed(name):
    """(runs, evaluations) of a packed study: the rows of `study.table` and `study.curves`."""
    file = STUDIES / name
    table = pq.read_table(file)
    text = table.schema.metadata[b"pharos.study"].decode()
    described = parse(text, str(file), folder=file.parent)
    labels = {world(run.config): run.instance for run in described.runs}
    rows, points = [], []
    for entry in table.to_pylist():
        record, id = json.loads(entry.pop("record")), entry.pop("id")
        run = Run(RunConfig.from_dict(record["config"]), labels[world(record["config"])])
        curve = pd.DataFrame({column: values for column, values in entry.items() if values is not None})
        rows.append({"id": id} | row_of(run, record, curve, file))
        points.append(curve.assign(**{key: rows[-1][key] for key in ("id", *CELL)}))
    return pd.DataFrame(rows), pd.concat(points, ignore_index=True)


def world(config):
    return config["environment"], json.dumps(config["parameters"], sort_keys=True)


@cache
def runs(name):
    """The runs of a study: `classes` consists of two packed files, `paper` is the paper's grid as far as it was run."""
    files = {
        "classes": ("small/runs.parquet", "classes/large.parquet"),
        "paper": ("paper/runs.parquet",),
        "one_hot": ("one_hot/runs.parquet", "small/runs.parquet"),
    }
    return pd.concat([packed(file)[0] for file in files[name]], ignore_index=True)


@cache
def found(name):
    """(finding, class) -> its row of `study.findings`, with the number of runs behind it.

    Of `paper`, whose large instances lack images, models and agreement are those of grids and lakes.
    """
    measures = pd.read_csv(STUDIES / "classes" / "hardness.csv")
    predictors = study.specification("classes").hardness.predictors
    done, rows = runs(name), {}
    complete = done if name == "classes" else done[done["environment"].isin(SMALL)]
    for some, needs_all in ((done, False), (complete, True)):
        cells = study.cells(some, measures)
        for row in study.findings(cells, study.models(cells, measures=predictors)).to_dict("records"):
            if (row["of"] == "all" and row["finding"] != SAME_HARD) == needs_all:
                rows[row["finding"], row["of"]] = row | {"runs": number_of_runs(row, some)}
    return rows


def number_of_runs(row, done):
    agents = {"the learner with more regret": ("dqn", "q_learning"), SAME_HARD: ("dqn", "ppo")}
    used = done[done["agent"].isin(agents.get(row["finding"], ("dqn",)))]
    if row["of"] != "all":
        used = used[used["environment"] == row["of"]]
    if row["finding"] == "the learner with more regret":
        used = used[used["observation"] != "simple_image"]
    return len(used)


def number(value, digits=2):
    return f"{value:.{digits}f}".replace("-", "−")


def interval(middle, lower, upper, digits=2):
    return f"{number(middle, digits)} ({number(lower, digits)}, {number(upper, digits)})"


def markdown(head, rows):
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def findings_table():
    rows = []
    for words, *key in ROWS:
        row = [words]
        for name in ("classes", "paper"):
            one = found(name)[tuple(key)]
            if one["verdict"] == "no data":
                row += ["–", "–", "–"]
                continue
            digits = 3 if one["of"] != "all" else 2
            row += [one["runs"], interval(one["effect"], one["lower"], one["upper"], digits)]
            row += [one["verdict"].removesuffix(", mostly by class")]
        rows.append(row)
    head = [("`classes`, runs", "effect (95 %)", "verdict"), ("`paper`, runs", "effect (95 %)", "verdict")]
    return markdown(["finding of the paper", *head[0], *head[1]], rows)


def models_table():
    """R2 of the one model for all classes, and of what it consists of."""
    table = study.cells(runs("classes"), pd.read_csv(STUDIES / "classes" / "hardness.csv"))
    predictors, rows = study.specification("classes").hardness.predictors, []
    for regret in ("cumulative_regret", "normalized_regret"):
        models = study.models(table, regret=regret, measures=predictors)
        values = (models.get("single", "all").r_squared, models.class_alone, models.leave_one_class_out)
        rows.append([regret.split("_")[0].replace("z", "s"), *map(number, values)])
    return markdown(["regret", "with measures", "without", "classes left out"], rows)


def encodings_table():
    """PPO on the three grids with a decoy, by what it sees."""
    done = runs("one_hot")
    done = done[(done["agent"] == "ppo") & done["instance"].str.contains("simple_grid/.*-decoy")]
    table = done.groupby("observation")["normalized_regret"].agg(["mean", "size"])
    rows = [
        [f"`{name}`", table["size"][name], number(table["mean"][name], 3)]
        for name in ("one_hot", "simple_image", "vector")
    ]
    return markdown(["observation", "runs", "normalised regret"], rows)


@cache
def sealed():
    """(cells, predictions, runs) of the sealed test: outcomes of its runs, and what was predicted before them."""
    described = study.specification(SEALED / "report.yaml", trust=True)
    known = {identity(run.config): run for run in described.runs}
    rows, points = [], []
    for entry in pq.read_table(SEALED / "curves.parquet").to_pylist():
        config = entry | {name: json.loads(entry[name]) for name in ("parameters", "observation_options")}
        rows.append({"id": entry["id"], **known[identity(config)].cell, "written": entry["written"]})
        points.append(
            pd.DataFrame({name: entry[name] for name in ("step", "normalized_regret")}).assign(id=entry["id"])
        )
    done = pd.DataFrame(rows)
    parts = []
    for file in sorted(SEALED.glob("predictions-*.parquet")):
        table, about = study.read_predictions(file)
        parts.append(table.assign(date=about["date"]))
    predictions = pd.concat(parts, ignore_index=True)
    today = pd.read_csv(FILE)
    today = today[today["study"] == "sealed-1"].rename(columns={"predicted": "sampled_regret"})
    today.loc[today["agent"] != "dqn", "sampled_regret"] = np.nan
    predictions = predictions.merge(today[[*CELL, "sampled_regret"]], on=CELL, how="left")
    return study.outcomes(done, pd.concat(points)), predictions, done


def identity(config):
    parts = (config["parameters"], config["observation_options"])
    return (
        config["agent"],
        config["environment"],
        config["observation"],
        config["seed"],
        json.dumps(parts, sort_keys=True),
    )


@cache
def judged():
    """(agent, predictor) -> its row of `study.validation`, for greedy regret."""
    cells, predictions, _ = sealed()
    names = ["kernel_regret", "sampled_regret", "tabular_regret", "clipped_regret_evaluated", "policy_tabular_regret"]
    measures = pd.read_csv(SEALED / "hardness.csv")
    table = study.validation(predictions, cells, predictors=names, measures=measures, permutations=0)
    table = table[table["outcome"] == "greedy"]
    return {(row["agent"], row["predictor"]): row for row in table.to_dict("records")}


def sealed_table():
    rows = []
    for agent, predictor, words in (
        ("ppo", "clipped_regret_evaluated", "`clipped_regret_evaluated`, named before"),
        ("dqn", "kernel_regret", "`kernel_regret`, named before"),
        ("dqn", "sampled_regret", "`sampled_regret`, proposed after"),
        ("ppo", "policy_tabular_regret", "the same learner on a table"),
        ("dqn", "tabular_regret", "the same learner on a table"),
        ("ppo", "tabular measures", "tabular measures together"),
        ("dqn", "tabular measures", "tabular measures together"),
    ):
        row = judged()[agent, predictor]
        said = [interval(*(row[name + end] for end in ("", "_lower", "_upper"))) for name in ("r_squared", "rho")]
        share = "0.50"  # of what is the same for all observations of an MDP
        if row["agreement_lower"] == row["agreement_lower"]:
            share = interval(*(row["agreement" + end] for end in ("", "_lower", "_upper")))
        rows.append([agent.upper(), words, *said, share])
    return markdown(["agent", "predictor", "R², class left out", "rank correlation", "pairs in order"], rows)


def misses(agent, predictor):
    """Class -> mean of observed less predicted regret, each class predicted by a line through the others."""
    cells, predictions, _ = sealed()
    both = predictions[predictions["agent"] == agent].merge(cells, on=CELL)
    classes = np.unique(both["environment"], return_inverse=True)[1]
    observed = both["greedy"].to_numpy(float)
    told = class_predictions(both[[predictor]].to_numpy(float), observed, classes, classes)
    return pd.Series(observed - told).groupby(both["environment"]).mean().sort_values()


def facts():
    """Phrases of the text that hold numbers, each as the text has it."""
    measures = pd.read_csv(STUDIES / "classes" / "hardness.csv")
    cells, predictions, done = sealed()
    dates = done.merge(predictions, on=CELL)
    if len(dates) != len(done) or (dates["written"] < dates["date"]).any():
        raise ValueError("a run was finished before its prediction was written")
    said = [f"{len(done)} runs", f"{len(cells)} cells, {len(cells) // 2} an agent"]
    within, pairs, images = {}, {}, {}
    for agent, part in cells.groupby("agent"):
        regret, mdps = part["greedy"], part.groupby("instance")["greedy"]
        within[agent] = ((regret - mdps.transform("mean")) ** 2).sum() / ((regret - regret.mean()) ** 2).sum()
        row, sizes = judged()[agent, PRIMARY[agent]], mdps.size()
        pairs[agent] = f"{row['pairs']} of {(sizes * (sizes - 1) // 2).sum()}"
        images[agent] = f"{row['image_agreement'] * row['image_pairs']:g} of {row['image_pairs']}"
    said += [
        f"{within['dqn']:.2f} of the variance of DQN's regret and {within['ppo']:.2f} of PPO's",
        f"{pairs['dqn']} pairs for DQN and {pairs['ppo']} for PPO",
        f"{images['dqn']} for DQN and {images['ppo']} for PPO",
    ]
    spread = cells[cells["agent"] == "dqn"].groupby("instance")["greedy"].agg(np.ptp)
    said.append(f"by more than 0.2 on {(spread > 0.2).sum()} of {len(spread)} MDPs")
    hanoi = cells.merge(predictions, on=CELL).query("agent == 'dqn' and instance == 'games.py:Hanoi(discs=3)'")
    hanoi = hanoi.assign(kind=hanoi["observation"].map(kind)).set_index("kind")
    for column, verb in (("greedy", "was"), ("kernel_regret", "had been predicted as")):
        image, vector = (hanoi[column][name] for name in ("simple_image", "vector"))
        said.append(f"{verb} {image:.2f} by its image and {vector:.2f} by its vector")
    said.append(f"{measures['num_states'].min():,} to {measures['num_states'].max():,} states")
    done = runs("classes")
    said.append(f"{(~done['exact']).sum()} of {len(done)} runs")
    power = [found("classes")[finding, "frozen_lake"]["power"] for _, finding, of in ROWS if of == "frozen_lake"]
    said.append(f"a power of {power[0]:.2f} and {power[1]:.2f}")
    for name in ("classes", "paper"):
        small = study.cells(runs(name)[runs(name)["environment"].isin(SMALL)])
        r = [study.agreement(small, column)[0] for column in ("return", "normalized_regret")]
        said.append(f"{r[0]:.2f} for returns and {r[1]:.2f} for normalised regret in `{name}`")
    return said


# Figures -------------------------------------------------------------------------------------------------------------


def draw():
    from pharos.plots.style import file_of, styled

    for name, figure in (
        ("article-regret", regret_figure),
        ("article-observations", observations_figure),
        ("article-sealed", sealed_figure),
        ("article-misses", misses_figure),
    ):
        file = IMAGES / f"{name}.png"
        file.write_bytes(styled(lambda figure=figure: file_of(figure(), "png", PRINT_DPI))())
        print(file)


PRINT_DPI = 240
LOOKS = {
    "vector": ("#0072B2", "o"),
    "simple_image": ("#D55E00", "s"),
    "one_hot": ("#E69F00", "^"),
    "hash": ("#CC79A7", "v"),
}
LABELS = {"simple_image": "image", "one_hot": "one-hot"}


def regret_figure():
    """Regret of the policy of the moment over training, means over instances and seeds."""
    from matplotlib.figure import Figure

    from pharos.plots.style import legend_below

    points = pd.concat([packed(name)[1] for name in ("small/runs.parquet", "classes/large.parquet")])
    drawn = Figure(figsize=(3.4, 3.5), layout="constrained")
    axes = drawn.subplots(2, 2).ravel()
    for axis, (name, label) in zip(axes, list(NAMES.items())[:4], strict=True):
        for (agent, observation), some in points[points["environment"] == name].groupby(["agent", "observation"]):
            curve = some.groupby("step")["normalized_regret"].mean()
            color = LOOKS.get(observation, ("#009E73",))[0]
            words = "table" if agent == "q_learning" else f"{agent.upper()}, {LABELS.get(observation, observation)}"
            axis.plot(
                curve.index / 1000, curve, "--" if agent == "ppo" else "-", color=color, label=words, linewidth=1.4
            )
        axis.set(ylim=(0, None), title=label)
    for axis in axes[2:]:
        axis.set_xlabel("thousand steps")
    for axis in axes[::2]:
        axis.set_ylabel("regret")
    legend_below(drawn, axes, 2)
    return drawn


def kind(observation):
    return observation.split("(")[0].split(",")[0]


def observations_figure():
    """Observed regret of DQN on each MDP of the sealed test, a mark for each observation."""
    from matplotlib.figure import Figure

    cells = sealed()[0]
    cells = cells[cells["agent"] == "dqn"]
    drawn = Figure(figsize=(3.4, 2.7), layout="constrained")
    axis = drawn.subplots()
    order = cells.groupby("instance")["greedy"].mean().sort_values().index
    for place, name in enumerate(order):
        regret = cells.loc[cells["instance"] == name, "greedy"]
        axis.plot([place, place], [regret.min(), regret.max()], color="#999999", linewidth=0.9, zorder=1)
    places = {name: place for place, name in enumerate(order)}
    for name, some in cells.groupby(cells["observation"].map(kind)):
        color, mark = LOOKS[name]
        axis.scatter(
            some["instance"].map(places), some["greedy"], 13, color, marker=mark, label=LABELS.get(name, name), zorder=2
        )
    axis.set(xlabel=f"{len(order)} MDPs, by mean regret", ylabel="regret of DQN", xticks=[], ylim=(0, 1.7))
    axis.legend(loc="upper left", handletextpad=0.2)
    return drawn


def sealed_figure():
    """Regret that was predicted before the runs, against observed regret, on classes that nobody had used."""
    from matplotlib.figure import Figure

    cells, predictions, _ = sealed()
    drawn = Figure(figsize=(3.4, 2.2), layout="constrained")
    axes = drawn.subplots(1, 2, sharey=True)
    for axis, (agent, predictor) in zip(axes, PRIMARY.items(), strict=True):
        both = predictions[predictions["agent"] == agent].merge(cells, on=CELL)
        axis.plot([0, 1.7], [0, 1.7], color="#999999", linewidth=0.9, zorder=0)
        for name, some in both.groupby(both["observation"].map(kind)):
            color, mark = LOOKS[name]
            axis.scatter(
                some[predictor], some["greedy"], 10, color, marker=mark, label=LABELS.get(name, name), linewidth=0
            )
        axis.set(xlim=(0, 1.7), ylim=(0, 1.7), xlabel="predicted regret", title=agent.upper(), aspect="equal")
        axis.set(xticks=[0, 0.5, 1, 1.5], yticks=[0, 0.5, 1, 1.5])
    axes[0].set_ylabel("observed regret")
    axes[0].legend(loc="upper left", handletextpad=0, borderpad=0, labelspacing=0.2, fontsize=7)
    return drawn


def misses_figure():
    """Mean miss of each class that was left out, by the predictor named before and by the one proposed after."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(3.4, 2.9), layout="constrained")
    axis = drawn.subplots()
    before, after = misses("dqn", "kernel_regret"), misses("dqn", "sampled_regret")
    for place, name in enumerate(before.index):
        axis.plot([before[name], after[name]], [place, place], color="#999999", linewidth=0.9, zorder=1)
    places = np.arange(len(before))
    axis.scatter(before, places, 18, "#D55E00", marker="s", label="expectations (named before)", zorder=2)
    axis.scatter(after[before.index], places, 18, "#0072B2", marker="o", label="samples (proposed after)", zorder=2)
    axis.axvline(0, color="#23262d", linewidth=0.9)
    axis.set(yticks=places, yticklabels=[name.replace("_", " ") for name in before.index])
    axis.set(xlabel="observed less predicted regret of DQN")
    drawn.legend(loc="outside lower center", handletextpad=0.2)
    return drawn


TABLES = {"findings": findings_table, "models": models_table, "encodings": encodings_table, "sealed": sealed_table}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", action="store_true")
    if parser.parse_args().draw:
        draw()
        return
    for name, table in TABLES.items():
        print(f"{name}\n\n{table()}\n")
    print("phrases\n", *facts(), sep="\n")


if __name__ == "__main__":
    main()
