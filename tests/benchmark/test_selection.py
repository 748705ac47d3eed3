"""The core of v1 follows from the predictions in the repository by its rule."""

import hashlib
import json

import numpy as np
import pytest
import yaml

from benchmark_modules import benchmark
from pharos.benchmark import load_suite


@pytest.fixture(scope="module")
def select():
    return benchmark("benchmark_select")


def test_the_file_is_reproduced_byte_by_byte(select):
    text = select.FILE.read_text()
    assert select.suite_text(yaml.safe_load(text)) == text
    assert f"SHA-256 {hashlib.sha256(select.CANDIDATES.read_bytes()).hexdigest()}" in text


def test_the_order_of_candidates_does_not_matter(select):
    rows = select.candidates()
    shuffled = [rows[i] for i in np.random.default_rng(0).permutation(len(rows))]
    assert select.selected(shuffled) == select.selected(rows)


def test_the_core_has_what_the_rule_says(select):
    core = load_suite().core
    rows = {row["name"]: row for row in select.candidates()}
    assert len(core) == select.TASKS
    classes = [task.environment.partition("/")[0] for task in core]
    assert max(map(classes.count, classes)) <= select.PER_CLASS
    instances = [(task.environment, json.dumps(task.parameters)) for task in core]
    assert len(set(instances)) == len(instances)
    for task in core:
        learners = rows[task.name]["dqn"], rows[task.name]["ppo"]
        assert max(learners) > select.SOLVED and min(learners) < select.FAILED


def test_features_are_ranks_with_ties_and_unknown_values(select):
    assert select.ranks([3.0, 1.0, None, 3.0]) == pytest.approx([1 / 6, -1 / 3, 0.0, 1 / 6])


def test_the_farthest_of_few_candidates_comes_next(select):
    def row(name, dqn, states):
        places = {"environment": name, "parameters": "{}", "chance": "{}", "exploration_time": 1.0, "table": 0.0}
        learners = {"dqn": dqn, "ppo": 0.5, "dqn_seconds": None, "ppo_seconds": None}
        return {**places, **learners, "name": name, "observation": "vector", "num_states": states}

    rows = [row("a", 0.1, 10), row("b", 0.2, 20), row("c", 0.3, 30), row("d", 0.4, 40), row("e", 0.5, 50)]
    rows.append(row("solved", 0.05, 10) | {"ppo": 0.05})
    assert [each["name"] for each in select.selected(rows, 3)] == ["c", "a", "e"]
