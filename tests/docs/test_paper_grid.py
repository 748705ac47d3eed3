"""The tables of large instances in docs/evidence/paper-grid.md, digit by digit from the packed runs."""

import importlib
from pathlib import Path

import pytest

pytest.importorskip("pyarrow.parquet")
ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "evidence" / "paper-grid.md").read_text(encoding="utf-8")
WORDS = " ".join(PAGE.split())
RETURN = "return, mean ± deviation"
# How the text above a table begins -> packed runs, agent, observation, and its columns of (return ± deviation, policies
# at the end, normalised regret)
TABLES = {
    "**The large instances**": ("paper", "dqn", "vector", (1, 2, 4)),
    "**With the small Freeway's": ("crossing", "dqn", "vector", (1, 2, 4)),
    "**DQN with images**": ("paper", "dqn", "simple_image", (1, 2, 4)),
    "**PPO with vectors on": ("paper", "ppo", "vector", (1, 2, 3)),
    "**PPO with images**": ("paper", "ppo", "simple_image", (1, 2, 4)),
    "**Breakout with chance**, DQN": ("paper", "dqn", "vector", (2, 3, 4)),
    "**Breakout with chance**, DQN and PPO": ("paper", "ppo", "vector", (5, 6, 7)),
    "**Breakout with chance, PPO with": ("paper", "ppo", "simple_image", (2, 3, 4)),
}


def rows_below(words):
    """Cells of the rows of the first table with returns and deviations below a text."""
    text = PAGE[PAGE.index(words) :]
    table = text[text.index(RETURN) :].split("\n\n")[0]
    return [[cell.strip(" `") for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


def check(text, number):
    """The printed number is this one, rounded once to its digits."""
    digits = len(text.partition(".")[2])
    assert float(text) == float(f"{number:.{digits}f}"), f"{text} is {number}"


@pytest.mark.long
@pytest.mark.parametrize("words", TABLES)
def test_the_large_tables_are_those_of_the_packed_runs(words, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    study, agent, observation, (of_return, of_policies, of_regret) = TABLES[words]
    runs = importlib.import_module("article").packed(f"{study}/runs.parquet")[0]
    runs = runs[(runs["agent"] == agent) & (runs["observation"] == observation)]
    rows = [row for row in rows_below(words) if not row[0].startswith("ten Freeways")]
    assert len(rows) >= 10
    for row in rows:
        chance = row[1] if "with chance" in words else "plain"
        some = runs[(runs["instance"] == row[0]) & (runs["chance"] == chance)]
        mean, deviation = row[of_return].split(" ± ")
        check(mean, some["return"].mean())
        check(deviation, some["return"].std(ddof=1))
        for text, value in zip(row[of_policies].split(", "), sorted(some["final_value"]), strict=True):
            check(text, value)
        check(row[of_regret], some["normalized_regret"].mean())


@pytest.mark.long
def test_images_under_chance_are_those_of_the_later_runs(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    packed = importlib.import_module("article").packed
    runs = {"simple_image": packed("paper/later-runs.parquet")[0], "vector": packed("paper/runs.parquet")[0]}
    head, _, *lines = PAGE[PAGE.index("| instance | random 0.1, images") :].split("\n\n")[0].splitlines()
    assert head == "| instance | random 0.1, images | vectors | sticky 0.25, images | vectors |"
    columns = [(chance, observation) for chance in ("random 0.1", "sticky 0.25") for observation in runs]
    number = 0
    for line in lines:
        instance, *texts = (cell.strip(" `") for cell in line.strip("|").split("|"))
        for text, (chance, observation) in zip(texts, columns, strict=True):
            cells = runs[observation].groupby(["agent", "observation", "instance", "chance"])
            if text:
                some = cells.get_group(("dqn", observation, instance, chance))
                assert len(some) == 5
                check(text, some["normalized_regret"].mean())
                number += observation == "simple_image"
    assert 5 * number == len(runs["simple_image"])  # nothing is left out
    assert len(runs["simple_image"]) == 200 and "says that 2,100 of 2,100 runs are finished" in WORDS
    means = {
        observation: some[(some["agent"] == "dqn") & (some["observation"] == observation)]
        .groupby(["instance", "chance"])["normalized_regret"]
        .mean()
        for observation, some in runs.items()
    }
    is_less = means["simple_image"] < means["vector"].loc[means["simple_image"].index]
    by_class = is_less.groupby(is_less.index.get_level_values("instance").str.split("/").str[0]).sum()
    assert by_class.to_dict() == {"breakout": 20 - 18, "freeway": 20}
    assert (
        "less regret than vectors in all twenty cells of Freeway, and more in eighteen of twenty of Breakout" in WORDS
    )


@pytest.mark.long
def test_the_hours_of_the_whole_grid_are_those_of_its_records(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    packed = importlib.import_module("article").packed
    runs = pytest.importorskip("pandas").concat([packed(f"paper/{name}.parquet")[0] for name in ("runs", "later-runs")])
    hours = runs["seconds"] / 3600
    of_images = (runs["agent"] == "dqn") & (runs["observation"] == "simple_image")
    of_images &= runs["instance"].str.match("freeway|breakout")
    assert len(runs) == 2100 and f"add up to {hours.sum():.0f} hours" in WORDS
    assert hours[of_images].sum() / hours.sum() == pytest.approx(0.5, abs=0.02)
    assert "of which DQN with images on the large instances has half" in WORDS
