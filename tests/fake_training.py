"""A runner that learns nothing: its curves are formulas of the config, so that a study over it takes no time.

The value approaches the optimal one exponentially, more slowly in large instances, from images and under chance. Every
finished execution leaves a line in the file PHAROS_FAKE_LOG; PHAROS_FAKE_SECONDS makes it last, and with
PHAROS_FAKE_LIMIT so many lines in the file none ends any more.
"""

import json
import math
import os
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from pharos import study
from pharos.study import run_id, worker

SIZES = {"simple_grid": 16, "frozen_lake": 30, "freeway": 400, "breakout": 900}
SLOWNESS = {"vector": 1.0, "simple_image": 1.7, "index": 0.5}


def train(config, folder):
    """Write run.json and curve.parquet; fails if the hyperparameter `target_update_interval` is the seed."""
    time.sleep(float(os.environ.get("PHAROS_FAKE_SECONDS", "0")))
    while (limit := os.environ.get("PHAROS_FAKE_LIMIT")) and number_of_lines() >= int(limit):
        time.sleep(0.01)
    hyperparameters = config["hyperparameters"]
    if config["seed"] == hyperparameters.get("target_update_interval"):
        raise ValueError("this seed\nfails on purpose")
    id = run_id(config)
    rng = np.random.default_rng(int(id, 16))
    interval = config["evaluation_interval"]
    steps = np.arange(interval, config["steps"] + 1, interval)
    size = SIZES[config["environment"]] * np.prod(
        [v for v in config["parameters"].values() if isinstance(v, int) and v > 0] or [1]
    )
    pace = 20 * math.sqrt(size) * SLOWNESS[config["observation"]] * (1 + 3 * sum(config["chance"].values()))
    pace *= {"ppo": 1.4}.get(config["agent"], 1.0) * math.exp(0.1 * rng.normal())
    optimal, uniform = 1.0, 0.1
    value = optimal - (optimal - uniform) * np.exp(-steps / pace)
    regret = np.cumsum((optimal - value) * interval)
    normalized = np.cumsum((optimal - value) / (optimal - uniform)) / np.arange(1, len(steps) + 1)
    curve = pd.DataFrame(
        {
            "step": steps,
            "episodes": steps // 10,
            "value": value,
            "expected_regret": optimal - value,
            "cumulative_expected_regret": regret,
            "normalized_regret": normalized,
            "mean_return": value,
            "realised_regret": optimal - value,
            "cumulative_realised_regret": regret,
            "exact": True,
            "seconds": 0.0,
        }
    )
    curve.to_parquet(folder / "curve.parquet")
    result = {
        "value_optimal": optimal,
        "value_uniform": uniform,
        "value_worst": 0.0,
        "final_value": value[-1],
        "final_regret": optimal - value[-1],
        "cumulative_regret": regret[-1],
        "normalized_regret": normalized[-1],
        "mean_return": float(value.mean()),
        "episodes": int(steps[-1] // 10),
    }
    record = {"format": 1, "id": id, "config": dict(config), "versions": {}, "status": "finished", "error": None}
    record |= {"seconds": 0.5, "result": {name: float(number) for name, number in result.items()}}
    (folder / "run.json").write_text(json.dumps(record))
    if log := os.environ.get("PHAROS_FAKE_LOG"):
        with open(log, "a") as file:
            file.write(f"{id}\n")


def number_of_lines():
    """Lines of PHAROS_FAKE_LOG: executions that have finished."""
    return len(Path(os.environ["PHAROS_FAKE_LOG"]).read_text().split())


def specification(name="fake", **given):
    """A study of one block: Q-learning on a lake, unless told otherwise; entries of the study or of its block."""
    whole = {
        key: given.pop(key) for key in ("steps", "evaluations", "hardness", "engine", "description") if key in given
    }
    block = {"environments": ["frozen_lake/4x4"], "agents": ["q_learning"], **given}
    return study.specification({"name": name, **whole, "blocks": [block]})


def attempt(run, folder):
    """Execute one run of a study in this process: how it ended."""
    runner = partial(worker.run_alone, train)
    (end,) = worker.attempt_run(runner, [run.config], [run.id], Path(folder))
    return end


def hold(config, folder):
    """Never end, and hold a semaphore, as Stable-Baselines3 does by way of tqdm."""
    import multiprocessing

    semaphore = multiprocessing.get_context("spawn").RLock()
    (folder / "held").write_text(str(semaphore))
    while True:
        time.sleep(0.1)


def results(folder):
    """The result of every run in a study's folder, by id."""
    return {file.parent.name: json.loads(file.read_text()) for file in Path(folder).glob("runs/*/run.json")}
