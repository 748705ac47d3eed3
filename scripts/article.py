"""The tables and figures of docs/article.md, from the packed runs in docs/studies.

    python scripts/article.py            # prints the tables
    python scripts/article.py --draw     # draws the figures into docs/images

Verdicts, effects and intervals are those of `study.findings`, predictions are judged by `study.validation`, as in the
report of a study. No agent is trained and no state space is built: hardness is read from hardness.csv beside the runs.
"""

import argparse
import json
import re
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from scipy import stats

from pharos import study
from pharos.prediction.pairs import Pairs
from pharos.statistics import holm, r_squared, spearman
from pharos.study.blocks import Run
from pharos.study.cross_validation import class_predictions, resampled_classes
from pharos.study.specification import parse
from pharos.study.tables import row_of
from pharos.training import CELL, RunConfig

ROOT = Path(__file__).parents[1]
STUDIES = ROOT / "docs" / "studies"
IMAGES = ROOT / "docs" / "images"
SEALED = STUDIES / "sealed-1"
SECOND = STUDIES / "sealed-2"
HALF_WIDTHS = {"dqn": 0.138714, "ppo": 0.20712}
"""Of the intervals that `pharos predict` had when the second set was run."""
WORST_GREEDY = 1.5  # of the idealised learner: what a policy counts at most
SMALL = ("simple_grid", "frozen_lake")
STUDY_NAMES = {"A": "classes", "B": "paper"}  # in the text, and of `runs`
RESAMPLES = 1000
NAMES = {"simple_grid": "grids", "frozen_lake": "lakes", "freeway": "Freeway", "breakout": "Breakout", "all": "all"}
SAME_HARD = "DQN and PPO find the same hard"
OBSERVED, LEARNER = "the harder observation of DQN", "the learner with more regret"
PRIMARY = {"dqn": "kernel_regret", "ppo": "clipped_regret_evaluated"}
ROWS = (  # of the table of findings: in words, the finding and its class as in `study.findings`
    ("images harder: grids", OBSERVED, "simple_grid"),
    ("images harder: lakes", OBSERVED, "frozen_lake"),
    ("vectors harder: Freeway", OBSERVED, "freeway"),
    ("vectors harder: Breakout", OBSERVED, "breakout"),
    ("table easier: grids", LEARNER, "simple_grid"),
    ("table easier: lakes", LEARNER, "frozen_lake"),
    ("table harder: Freeway", LEARNER, "freeway"),
    ("table harder: Breakout", LEARNER, "breakout"),
    ("one model explains nothing (0.09)", "one model explains next to nothing", "all"),
    ("models by observation beat one (0.48)", "models by representation explain more than one", "all"),
    ("models by class beat one (0.65)", "models by class explain more than one", "all"),
    ("measures explain vectors better (0.6, 0.3)", "hardness explains vectors better than images", "all"),
    ("DQN and PPO correlate (r = 0.81)", SAME_HARD, "all"),
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
        "paper": ("paper/runs.parquet", "paper/later-runs.parquet"),
        "one_hot": ("one_hot/runs.parquet", "small/runs.parquet"),
    }
    return pd.concat([packed(file)[0] for file in files[name]], ignore_index=True)


@cache
def found(name):
    """(finding, class) -> its row of `study.findings`, with the numbers of tasks and runs behind it.

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
                rows[row["finding"], row["of"]] = row | size(row, some)
    return rows


def size(row, done):
    agents = {LEARNER: ("dqn", "q_learning"), SAME_HARD: ("dqn", "ppo")}
    used = done[done["agent"].isin(agents.get(row["finding"], ("dqn",)))]
    if row["of"] != "all":
        used = used[used["environment"] == row["of"]]
    if row["finding"] == LEARNER:
        used = used[used["observation"] != "simple_image"]
    task = ["instance", "chance"]
    pairs = {  # cells that both agents have; tasks that have both agents, or both observations
        SAME_HARD: ([*task, "observation"], "agent"),
        LEARNER: (task, "agent"),
        OBSERVED: (task, "observation"),
    }
    if row["finding"] in pairs:
        keys, differs = pairs[row["finding"]]
        used = used[used.groupby(keys)[differs].transform("nunique") == 2]
    return {"runs": len(used), "tasks": used.groupby(task).ngroups}


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
        for name in STUDY_NAMES.values():
            one = found(name)[tuple(key)]
            if one["verdict"] == "no data":
                row += ["–", "–", "–"]
                continue
            digits = 3 if one["of"] != "all" else 2
            row += [f"{one['tasks']}/{one['runs']}", interval(one["effect"], one["lower"], one["upper"], digits)]
            row += [one["verdict"].removesuffix(", mostly by class")]
        rows.append(row)
    head = [(f"{name}: tasks/runs", "effect (95 %)", "verdict") for name in STUDY_NAMES]
    return markdown(["finding of the paper", *head[0], *head[1]], rows)


def parts_of_the_one_model():
    """R² of the one model for all classes, and of what it consists of."""
    table = study.cells(runs("classes"), pd.read_csv(STUDIES / "classes" / "hardness.csv"))
    predictors, rows = study.specification("classes").hardness.predictors, []
    for regret in ("cumulative_regret", "normalized_regret"):
        models = study.models(table, regret=regret, measures=predictors)
        values = (models.get("single", "all").r_squared, models.class_alone, models.leave_one_class_out)
        rows.append([*map(number, values)])
    (cumulative, unseen), (normalized, of_normalized) = [
        (f"{whole} with measures and {alone} without", left_out_r2) for whole, alone, left_out_r2 in rows
    ]
    return f"{cumulative} ({unseen} on classes left out), for normalised regret {normalized} ({of_normalized})"


def encodings_table():
    """PPO on the three grids with a decoy, by what it sees; intervals by Student's t over seeds within tasks."""
    done = runs("one_hot")
    done = done[(done["agent"] == "ppo") & done["instance"].str.contains("simple_grid/.*-decoy")]
    rows = []
    for name in ("one_hot", "simple_image", "vector"):
        some = done[done["observation"] == name]
        tasks = some.groupby(["instance", "chance"])["normalized_regret"].agg(["mean", "var", "size"])
        error = np.sqrt((tasks["var"] / tasks["size"]).sum()) / len(tasks)
        half = stats.t.ppf(0.975, (tasks["size"] - 1).sum()) * error
        mean = tasks["mean"].mean()
        rows.append([LABELS.get(name, name), len(some), interval(mean, mean - half, mean + half, 3)])
    return markdown(["observation", "runs", "normalised regret (95 %)"], rows)


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
    today = pd.read_csv(STUDIES / "sealed-3" / "sampled.csv")
    today = today[today["study"] == "sealed-1"]
    predictions = predictions.merge(today[[*CELL, "sampled_regret"]], on=CELL, how="left")
    return study.outcomes(done, pd.concat(points)), predictions, done


@cache
def second(cut=np.inf):
    """(cells, predictions, runs) of the second sealed test, blocks a to c; regret of an evaluation is at most `cut`."""
    rows, points, parts = [], [], []
    for entry in pq.read_table(SECOND / "curves.parquet").to_pylist():
        if entry["part"][0] in "abc":
            value, best, uniform = np.array(entry.pop("value")), entry["value_optimal"], entry["value_uniform"]
            regret = np.minimum((best - value) / (best - uniform), cut)
            points.append(pd.DataFrame({"step": entry.pop("step"), "normalized_regret": regret}).assign(id=entry["id"]))
            rows.append(entry)
    for name in sorted(file for part in "abc" for file in SECOND.glob(f"predictions-{part}-*.parquet")):
        table, about = study.read_predictions(name)
        parts.append(table.assign(date=about["date"]))
    done, predictions = pd.DataFrame(rows), pd.concat(parts, ignore_index=True)
    return study.outcomes(done, pd.concat(points)), predictions, done


TESTS = {"first": sealed, "second": second}


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
def judged(test="first"):
    """(agent, predictor) -> its row of `study.validation`, for greedy regret."""
    cells, predictions, _ = TESTS[test]()
    names = ["kernel_regret", "sampled_regret", "tabular_regret", "clipped_regret_evaluated", "policy_tabular_regret"]
    measures = pd.read_csv((SEALED if test == "first" else SECOND) / "hardness.csv")
    table = study.validation(predictions, cells, predictors=names, measures=measures, permutations=0)
    table = table[table["outcome"] == "greedy"]
    return {(row["agent"], row["predictor"]): row for row in table.to_dict("records")}


def sealed_table():
    rows = []
    for test, agent, predictor, words in (
        ("first", "ppo", "clipped_regret_evaluated", "`clipped_regret_evaluated`"),
        ("first", "dqn", "kernel_regret", "`kernel_regret`"),
        ("first", "ppo", "policy_tabular_regret", "learner on a table"),
        ("first", "dqn", "tabular_regret", "learner on a table"),
        ("first", "ppo", "tabular measures", "tabular measures"),
        ("first", "dqn", "tabular measures", "tabular measures"),
        ("second", "ppo", "clipped_regret_evaluated", "`clipped_regret_evaluated`"),
        ("second", "dqn", "sampled_regret", "`sampled_regret`"),
    ):
        row = judged(test)[agent, predictor]
        said = [interval(*(row[name + end] for end in ("", "_lower", "_upper"))) for name in ("r_squared", "rho")]
        without_line = "–"
        if predictor in (both := joined(agent, test)):
            left = variance_share(both["greedy"] - both[predictor], both)
            without_line = interval(1 - left[0], 1 - left[2], 1 - left[1])
        share = "0.50"  # of what is the same for all observations of an MDP
        if row["agreement_lower"] == row["agreement_lower"]:
            share = interval(*(row["agreement" + end] for end in ("", "_lower", "_upper")))
        rows.append([test, agent.upper(), words, *said, share, without_line])
    head = ["test", "agent", "predictor", "R², class left out", "rank correlation", "pairs in order", "R², no line"]
    return markdown(head, rows)


def joined(agent, test="first", **options):
    """Cells of a sealed test with their predictions."""
    cells, predictions, _ = TESTS[test](**options)
    return predictions[predictions["agent"] == agent].merge(cells, on=CELL)


def variance_share(part, cells):
    """The share of the variance of greedy regret that `part` of it has, and its 95 % interval over classes."""
    classes = np.unique(cells["environment"], return_inverse=True)[1]
    counts = np.vstack([np.ones(classes.max() + 1, int), resampled_classes(classes.max() + 1, RESAMPLES, 0)])
    regret = cells["greedy"].to_numpy(float)
    columns = (part.to_numpy(float) ** 2, regret**2, regret, np.ones(len(cells)))
    own, squares, total, number = (counts @ np.bincount(classes, column) for column in columns)
    shares = own / (squares - total**2 / number)
    return shares[0], *np.percentile(shares[1:], [2.5, 97.5])


def share_of_observations(cells):
    """`variance_share` of what differs between the observations of an MDP."""
    return variance_share(cells["greedy"] - cells.groupby("instance")["greedy"].transform("mean"), cells)


def left_out(cells, predictor):
    """(regret, prediction, class) of cells, each class predicted by a line through the others."""
    classes = np.unique(cells["environment"], return_inverse=True)[1]
    regret = cells["greedy"].to_numpy(float)
    return regret, class_predictions(cells[[predictor]].to_numpy(float), regret, classes, classes), classes


def left_out_r_squared(cells, predictor):
    """R2 of the predictions of `left_out`, classes weighing alike."""
    regret, prediction, classes = left_out(cells, predictor)
    return r_squared(regret, regret - prediction, classes)


def misses(predictor):
    """Class of the second test -> mean of observed less predicted regret of DQN."""
    cells = joined("dqn", "second")
    return (cells["greedy"] - cells[predictor]).groupby(cells["environment"]).mean().sort_values()


def without_one_class(agent):
    """Class -> R2 of the agent's measure on the sealed test without that class."""
    cells = joined(agent)
    names = sorted(cells["environment"].unique())
    return {name: left_out_r_squared(cells[cells["environment"] != name], PRIMARY[agent]) for name in names}


def facts():
    """Phrases of the text that hold numbers, each as the text has it."""
    of_study = (facts_of_findings, facts_of_the_sealed_test)
    of_development = (facts_of_the_second_test, facts_of_the_ten_classes)
    return [phrase for part in (*of_study, *of_development) for phrase in part()]


def facts_of_findings():
    small = [study.cells(done[done["environment"].isin(SMALL)]) for done in map(runs, STUDY_NAMES.values())]
    r = [f"{study.agreement(cells, name)[0]:.2f}" for name in ("return", "normalized_regret") for cells in small]
    said = ["r of returns is {} in A and {} in B, r of normalised regret {} and {}".format(*r)]
    for title, name in STUDY_NAMES.items():
        verdicts = [row["verdict"].split(",")[0] for row in found(name).values()]
        counts = [verdicts.count(each) for each in ("agrees", "disagrees", "undecided")]
        if title == "A":
            words = "of {} findings our first study agrees with {}, disagrees with {} and leaves {} undecided"
            said.append(words.format(sum(counts), *counts))
        else:
            said.append("our second {}, {} and {}".format(*counts))
        p = np.array([row["p"] for row in found(name).values() if row["p"] == row["p"]])
        said.append(f"{(holm(p) < 0.05).sum()} of {(p < 0.05).sum()} in {title}")
        done = runs(name)
        said.append(f"{(~done['exact']).sum()} of {len(done):,} runs")
    measures = pd.read_csv(STUDIES / "classes" / "hardness.csv")
    said.append(f"{measures['num_states'].min():,} to {measures['num_states'].max():,} states")
    powers = {key: row["power"] for key, row in found("classes").items() if key[0] in (OBSERVED, LEARNER)}
    low = ((OBSERVED, "frozen_lake"), (LEARNER, "frozen_lake"), (OBSERVED, "freeway"), (LEARNER, "simple_grid"))
    told = [powers.pop(key) for key in low]
    words = "is {:.2f} and {:.2f} on lakes (images, table), {:.2f} on Freeway (images), {:.2f} on grids (table)"
    said.append(f"{words.format(*told)}, elsewhere above {np.floor(100 * min(powers.values())) / 100:.2f}")
    said += [parts_of_the_one_model(), verdicts_by_instance()]
    regrets = regrets_of_ppo()
    is_less = (regrets["simple_image"] < regrets["vector"]).groupby("environment")
    of, less = is_less.size(), is_less.sum()
    said.append(
        f"PPO has less regret with images on {less['breakout']} of {of['breakout']} tasks of Breakout, more on "
        f"{of['freeway'] - less['freeway']} of {of['freeway']} of Freeway (by at most "
        f"{(regrets['simple_image'] - regrets['vector'])['freeway'].max():.3f})"
    )
    tables = packed("paper/runs.parquet")[1].query("agent == 'q_learning' and environment == 'freeway'")
    if tables.query("chance == 'plain'")["value"].any():  # staying is worth 0
        raise ValueError("a table leaves the kerb")
    return [*said, "every table stays on the kerb from step 0 on"]


def regrets_of_ppo():
    """Normalised regret of PPO on each task of study B, a column for each observation; tasks that have all."""
    task = ["environment", "instance", "chance", "observation"]
    return runs("paper").query("agent == 'ppo'").groupby(task)["normalized_regret"].mean().unstack().dropna()


def images_of_ppo():
    """Lines: PPO's regret with images less that with vectors, by class and kind of chance, and over all kinds."""
    regrets = regrets_of_ppo()
    differences = regrets["simple_image"] - regrets["vector"]
    groups = [((of, "all chance"), part) for of, part in differences.groupby("environment")]
    for (of, chance), part in [*groups, *differences.groupby(["environment", "chance"])]:
        values = part.to_numpy()
        first, second = np.triu_indices(len(values))
        middle, low, high = np.median((values[first] + values[second]) / 2), values.min(), values.max()
        yield (
            f"PPO, images less vectors, {NAMES[of]}, {chance}: more on {(values > 0).sum()} of {len(values)}, "
            f"median of averages {number(middle, 3)}, {number(low, 3)} to {number(high, 3)}, "
            f"p {stats.wilcoxon(values).pvalue:.3f}"
        )


def verdicts_by_instance():
    """The differences of Table 1 tested over instances, each the mean of its tasks; ValueError if others change."""
    pairs = {
        OBSERVED: (("dqn", "simple_image"), ("dqn", "vector")),
        LEARNER: (("q_learning", "index"), ("dqn", "vector")),
    }
    changed, p_of_grids = [], []
    for title, name in STUDY_NAMES.items():
        keys = ["agent", "observation", "environment", "instance", "chance"]
        means = runs(name).groupby(keys)["normalized_regret"].mean()
        for finding, (one, other) in pairs.items():
            for of in list(NAMES)[:4]:
                difference = means[(*one, of)] - means[(*other, of)]
                p = stats.wilcoxon(difference.dropna().groupby("instance").mean()).pvalue
                if (p < 0.05) != (found(name)[finding, of]["verdict"] in ("agrees", "disagrees")):
                    changed.append((title, finding, of))
                if (finding, of) == (OBSERVED, "simple_grid"):
                    p_of_grids.append(p)
    if changed != [("A", OBSERVED, "simple_grid")]:
        raise ValueError(f"by instance other verdicts change: {changed}")
    return f"A's images on grids are undecided (p = {p_of_grids[0]:.2f}, B's {p_of_grids[1]:.2f}), else verdicts stay"


def facts_of_the_sealed_test():
    cells, predictions, done = sealed()
    dates = done.merge(predictions, on=CELL)
    if len(dates) != len(done) or (dates["written"] < dates["date"]).any():
        raise ValueError("a run was finished before its prediction was written")
    states = pd.read_csv(SEALED / "hardness.csv")["num_states"]
    said = [
        f"{len(done)} runs",
        f"{len(cells)} cells, {len(cells) // 2} an agent",
        f"{len(states)} instances of {states.min()} to {states.max()} states",
    ]
    within, pairs, images = {}, {}, {}
    for agent, part in cells.groupby("agent"):
        within[agent] = interval(*share_of_observations(part))
        row, sizes = judged()[agent, PRIMARY[agent]], part.groupby("instance").size()
        pairs[agent] = f"{row['pairs']} of {(sizes * (sizes - 1) // 2).sum()}"
        images[agent] = f"{row['image_agreement'] * row['image_pairs']:g} of {row['image_pairs']}"
    said += [
        f"{within['dqn']} of the variance of DQN's regret and {within['ppo']} of PPO's",
        f"{pairs['dqn']} for DQN and {pairs['ppo']} for PPO",
        f"{images['dqn']} pairs for DQN and {images['ppo']} for PPO",
    ]
    spread = cells[cells["agent"] == "dqn"].groupby("instance")["greedy"].agg(np.ptp)
    said.append(f"by more than 0.2 on {(spread > 0.2).sum()} of {len(spread)} MDPs")
    dqn = joined("dqn")
    is_hanoi = (dqn["instance"] == "games.py:Hanoi(discs=3)") & (dqn["observation"].map(kind) == "simple_image")
    if dqn["greedy"].idxmax() != dqn.index[is_hanoi][0]:
        raise ValueError("another cell than Hanoi's image has the largest regret")
    said.append(f"without this cell R² is {left_out_r_squared(dqn[~is_hanoi], 'kernel_regret'):.2f} with a line")
    said.append(f"without one cell DQN's is {share_of_observations(dqn[~is_hanoi])[0]:.2f}")
    said.append(f"its R² ({judged()['dqn', 'kernel_regret']['r_squared']:.3f}) passes by one cell")
    return said


def facts_of_the_second_test():
    _, predictions, done = second()
    dates = done.merge(predictions, on=CELL)
    if len(dates) != len(done) or (dates["written"] < dates["date"]).any():
        raise ValueError("a run was finished before its prediction was written")
    states = pd.read_csv(SECOND / "hardness.csv")["num_states"]
    held = []
    for agent, predictor in (("ppo", "clipped_regret_evaluated"), ("dqn", "sampled_regret")):
        both = joined(agent, "second")
        inside = (both["greedy"] - both[predictor]).abs() <= HALF_WIDTHS[agent]
        held.append(number(inside.groupby(both["environment"]).mean().mean()))
    cut = joined("dqn", "second", cut=WORST_GREEDY)
    mean, rank = misses("sampled_regret"), spearman(left_out(cut, "sampled_regret")[1], cut["greedy"].to_numpy())
    hardest, easiest = (f"{name} by {number(abs(mean[name]))}" for name in (mean.index[-1], mean.index[0]))
    return [
        f"{len(states)} instances of {states.min()} to {states.max()} states, {len(done)} runs",
        f"80 % intervals covered {held[0]} of PPO's cells and {held[1]} of DQN's",
        f"Cut alike, the rank correlation is {number(rank)}",
        f"too little for {hardest}, too much for {easiest}",
    ]


def facts_of_the_ten_classes():
    sys.path.append(str(STUDIES.parents[1] / "benchmarks"))
    import prediction_cells

    frame, fits, numbers_met, missed = prediction_cells.other_cells(), [], [], []
    for agent, width in prediction_cells.OTHER_WIDTHS.items():
        cells = frame[frame["agent"] == agent]
        asked = prediction_cells.OTHER_ASKED
        rows = prediction_cells.verdicts(cells, "predicted", "observed", width, asked, 1000)
        numbers_met.append(sum(held for *_, held in rows))
        missed += [f"{value:.2f}" for _, _, value, held in rows if not held]
        said = re.match(r"(\S+) \((\S+) to (\S+)\)", prediction_cells.said_of(cells, 1000))
        fits.append("{} ({}, {})".format(*said.groups()))
    if numbers_met != [4, 4]:
        raise ValueError(f"criteria met: {numbers_met}")
    return [
        f"R² {fits[0]} and {fits[1]}",
        f"DQN's interval covered {missed[0]}, PPO's order was right in {missed[1]} of pairs",
    ]


@cache
def large(agent):
    """Cells of the six large instances with what was predicted of them before their runs."""
    folder = STUDIES / "hardness-dev"
    predictions, about = study.read_predictions(folder / f"large-{agent}-predictions.parquet")
    done, points = packed("hardness-dev/large-runs.parquet")
    if (done.merge(predictions, on=CELL)["began"] <= about["date"]).any():
        raise ValueError("a run had begun before its prediction was written")
    return predictions.merge(study.outcomes(done, points), on=CELL)


OF_LARGE = (  # primary, and the same learners without a kernel
    *(("dqn", "sampled_regret"), ("ppo", "clipped_regret_evaluated")),
    *(("dqn", "sampled_tabular"), ("ppo", "clipped_tabular_regret")),
)


def judged_large(agent, predictor):
    """(R² without a line, rank correlation, pairs in order, pairs) of the six large instances."""
    cells = large(agent)
    regret, predicted = cells["greedy"].to_numpy(float), cells[predictor].to_numpy(float)
    classes, instances = (np.unique(cells[name], return_inverse=True)[1] for name in ("environment", "instance"))
    pairs = Pairs.of(regret, instances)
    in_order = pairs.right(predicted).sum()
    return r_squared(regret, regret - predicted, classes), spearman(predicted, regret), in_order, len(pairs.first)


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
    """Regret of the policy of the moment over training: means over runs of a class, bands of two standard errors."""
    from matplotlib.figure import Figure

    from pharos.plots.style import legend_below

    points = pd.concat([packed(name)[1] for name in ("small/runs.parquet", "classes/large.parquet")])
    drawn = Figure(figsize=(3.4, 3.5), layout="constrained")
    axes = drawn.subplots(2, 2).ravel()
    for axis, (name, label) in zip(axes, list(NAMES.items())[:4], strict=True):
        for (agent, observation), some in points[points["environment"] == name].groupby(["agent", "observation"]):
            table = some.groupby("step")["normalized_regret"].agg(["mean", "sem"])
            curve, half = table["mean"], 2 * table["sem"]
            color = LOOKS.get(observation, ("#009E73",))[0]
            words = "table" if agent == "q_learning" else f"{agent.upper()}, {LABELS.get(observation, observation)}"
            axis.fill_between(curve.index / 1000, curve - half, curve + half, color=color, alpha=0.15, linewidth=0)
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


PREDICTED = {"first": PRIMARY, "second": PRIMARY | {"dqn": "sampled_regret"}}


def sealed_figure():
    """Regret that was predicted before the runs, against observed regret: a row of panels for each sealed test."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(3.4, 3.9), layout="constrained")
    axes = drawn.subplots(2, 2, sharex=True, sharey=True)
    for row, (test, predictors) in zip(axes, PREDICTED.items(), strict=True):
        for axis, (agent, predictor) in zip(row, predictors.items(), strict=True):
            both = joined(agent, test)
            axis.plot([0, 1.7], [0, 1.7], color="#999999", linewidth=0.9, zorder=0)
            for name, some in both.groupby(both["observation"].map(kind)):
                color, mark = LOOKS[name]
                axis.scatter(
                    some[predictor], some["greedy"], 10, color, marker=mark, label=LABELS.get(name, name), linewidth=0
                )
            axis.set(xlim=(0, 1.7), ylim=(0, 1.7), title=f"{agent.upper()}, {test} test", aspect="equal")
            axis.set(xticks=[0, 0.5, 1, 1.5], yticks=[0, 0.5, 1, 1.5])
        row[0].set_ylabel("observed regret")
    for axis in axes[1]:
        axis.set_xlabel("predicted regret")
    axes[0, 0].legend(loc="upper left", handletextpad=0, borderpad=0, labelspacing=0.2, fontsize=7)
    return drawn


def misses_figure():
    """Mean miss in each class of the second test, by the predictor that was named for it and by the one before."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(3.4, 2.9), layout="constrained")
    axis = drawn.subplots()
    primary, former = misses("sampled_regret"), misses("kernel_regret")
    for place, name in enumerate(primary.index):
        axis.plot([primary[name], former[name]], [place, place], color="#999999", linewidth=0.9, zorder=1)
    places = np.arange(len(primary))
    for values, fill, mark, label in (
        (primary, "#23262d", "D", "sampled_regret"),
        (former[primary.index], "#ffffff", "D", "kernel_regret"),
    ):
        axis.scatter(values, places, 18, fill, marker=mark, edgecolors="#23262d", label=label, zorder=2)
    axis.axvline(0, color="#23262d", linewidth=0.9)
    axis.set(yticks=places, yticklabels=[name.replace("_", " ") for name in primary.index])
    axis.set(xlabel="observed minus predicted regret of DQN")
    drawn.legend(loc="outside lower center", handletextpad=0.2)
    return drawn


TABLES = {"findings": findings_table, "encodings": encodings_table, "sealed": sealed_table}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", action="store_true")
    if parser.parse_args().draw:
        draw()
        return
    for name, table in TABLES.items():
        print(f"{name}\n\n{table()}\n")
    print("phrases\n", *facts(), sep="\n")
    print("", *images_of_ppo(), sep="\n")
    for agent, predictor in PRIMARY.items():
        told = ", ".join(f"{name} {value:.2f}" for name, value in without_one_class(agent).items())
        print(f"\nR² of {agent.upper()} by {predictor}, without one class: {told}")
    for agent, predictor in OF_LARGE:
        fit, rank, right, of = judged_large(agent, predictor)
        said = f"R² {number(fit)}, rank {number(rank)}, {right:g} of {of} pairs in order"
        print(f"\n{agent.upper()} on the six large instances by {predictor}: {said}")


if __name__ == "__main__":
    main()
