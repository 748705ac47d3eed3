"""The suite v1, by its rule: which tasks its core has, from predictions alone, and what is known of each task.

python benchmarks/benchmark_select.py                print the file of the suite
python benchmarks/benchmark_select.py --write        write it
python benchmarks/benchmark_select.py --freeze       the same, with levels, values and digests computed anew
python benchmarks/benchmark_select.py --foretell     the same, with the regret that is predicted for each task
python benchmarks/benchmark_select.py --candidates   predict candidates that the table of them lacks

The core: of CANDIDATES, a table of predictions that is in the repository, those in the WINDOW, where the idealised
DQN and PPO neither both solve a task nor both fail. First the one nearest to the middle of the features, ranked; then
again and again the one that is farthest from all chosen ones; at most PER_CLASS of a class and one of an instance; ties
by name; until there are TASKS. No result of any agent enters.

Candidates are cells of the study `hardness-dev` with its predictions, pictures where a run takes at most 6 s; and
INSTANCES with three observations, and with random and sticky actions behind one each. They have at most MOST_STATES
states, and what is seen tells the state.

Ladders are taken from the file: environment, parameters, observation and chance of each rung are written by hand, the
rest is filled in. Numbers of tasks that the file has are kept; new tasks are always frozen.
"""

import argparse
import csv
import hashlib
import json
import math
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import yaml

import pharos
from pharos.benchmark import BenchmarkTask, Ladder, Protocol, Suite
from pharos.benchmark.suite import CORE, FOLDER, digest_of_suite, digest_of_task
from pharos.mdp import ChanceSetting
from pharos.training import RunConfig, Task

CANDIDATES = Path(__file__).parent / "benchmark_candidates.csv"
FILE = FOLDER / "v1.yaml"
TASKS, PER_CLASS, MOST_STATES, STEPS = 24, 3, 2_000, 30_000
SOLVED, FAILED = 0.1, 0.9  # the window
TIE = 1e-6  # of values
OBSERVATIONS = {"hash": {"bits": 64}, "simple_image": {"motion": True}}
VIEWS = ("vector", "one_hot", "hash")
INSTANCES = [
    ("frozen_lake", {"size": 6, "seed": 0}),
    ("taxi", {"size": 3}),
    ("breakout", {"height": 5, "columns": 3, "brick_rows": 1}),
    ("mini_grid", {"kind": "lava_gap", "size": 5, "seed": 0}),
    ("sokoban/corner", {}),
    ("sliding_tiles/2x3", {}),
    ("corner_grid/8x8", {}),
    ("blackjack/sutton-barto", {}),
    ("catch", {"rows": 6, "columns": 6}),
    ("mini_grid_rooms/4x3", {}),
    ("freeway", {"num_cars": 4, "lane_length": 3}),
    ("discounting_chain/bonus-1", {}),
    ("endless_sea/10x10", {}),
    ("memory_chain", {"memory_length": 3, "num_bits": 3}),
    ("sokoban/corridor", {}),
    ("frozen_lake", {"size": 8, "seed": 0}),
    ("mini_grid/simple-crossing-s9n1", {}),
    ("mini_grid/multi-room-n2-s4", {}),
    ("taxi", {"size": 4}),
    ("deep_sea", {"size": 8}),
    ("sokoban/two-rooms", {}),
    ("sliding_tiles/2x2", {}),
    ("mini_grid_empty/8x8", {}),
    ("umbrella_chain", {"chain_length": 10}),
    ("simple_grid/8x8-decoy", {}),
    ("game_2048/2x2-to-32", {}),
]
COLUMNS = (
    *("name", "environment", "parameters", "observation", "chance"),
    *("num_states", "exploration_time", "dqn", "ppo", "table", "dqn_seconds", "ppo_seconds"),
)
HEAD = """\
# The suite {name} of `pharos benchmark`, by `python benchmarks/benchmark_select.py`: only rungs are written by hand.
# The core is selected from benchmarks/benchmark_candidates.csv of {date}, SHA-256 {sha256}.
"""
DATE = "2026-11-24"
TASK_KEYS = [each.name for each in fields(BenchmarkTask) if each.name != "axis"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--freeze", action="store_true")
    parser.add_argument("--foretell", action="store_true")
    parser.add_argument("--candidates", action="store_true")
    options = parser.parse_args()
    entry = yaml.safe_load(FILE.read_text())
    if options.candidates:
        add_candidates(entry["hyperparameters"])
        return
    text = suite_text(entry, freeze=options.freeze, foretell=options.foretell)
    if options.write or options.freeze or options.foretell:
        FILE.write_text(text)
    else:
        print(text, end="")


def suite_text(entry, *, freeze=False, foretell=False):
    """The file of the suite, from the one before, of which protocol, hyperparameters and ladders are taken."""
    protocol = Protocol(**entry["protocol"])
    known = {each["name"]: each for each in entry["core"]}
    core = [kept({**known.get(each["name"], {}), **each}, CORE, protocol, freeze) for each in selected()]
    settings = entry["hyperparameters"] if foretell else {}
    core = [predicted_entry(each, settings, protocol) for each in core]
    ladders = []
    for ladder in entry["ladders"]:
        tasks = [kept(each, ladder["axis"], protocol, freeze, LEVELS[ladder["measure"]]) for each in ladder["tasks"]]
        ladders.append({**ladder, "tasks": [predicted_entry(each, settings, protocol) for each in tasks]})
    made = {"name": entry["name"], "digest": "", "protocol": entry["protocol"]}
    made |= {"hyperparameters": entry["hyperparameters"], "core": core, "ladders": ladders}
    rungs = [
        Ladder(**{**each, "tasks": tuple(BenchmarkTask(**task, axis=each["axis"]) for task in each["tasks"])})
        for each in ladders
    ]
    first = tuple(BenchmarkTask(**each, axis=CORE) for each in core)
    suite = Suite(entry["name"], protocol, first, tuple(rungs), "", entry["hyperparameters"])
    return written({**made, "digest": digest_of_suite(suite)})


def kept(entry, axis, protocol, freeze, level=None):
    """The entry of a task, with its values and its digest, and its level where it is a rung."""
    if not freeze and entry.get("digest"):
        return entry
    task = BenchmarkTask(**{**entry, "axis": axis, "digest": ""})
    learnt = task.training_task(protocol)
    reference = learnt.reference
    print(f"# {task.name}: {learnt.space.num_states:,} states", flush=True)
    made = {**entry, "value_optimal": significant(reference.optimal), "value_uniform": significant(reference.uniform)}
    if level is not None:
        made["level"] = significant(level(task, learnt))
    return {**made, "digest": digest_of_task(learnt)}


def predicted_entry(entry, settings, protocol):
    """The entry of a task with its predicted regret: of idealised agents with these hyperparameters, and of a table."""
    from pharos.errors import PharosError
    from pharos.prediction import predict

    values = {}
    for agent, hyperparameters in settings.items():
        view = [(entry["observation"], entry.get("observation_options", {}))]
        options = {"steps": protocol.steps, "horizon": protocol.horizon, "hyperparameters": hyperparameters}
        chance = ChanceSetting.from_dict(entry.get("chance", {}))
        try:
            cell = predict(
                pharos.make(entry["environment"], **entry.get("parameters", {})),
                view,
                agent=agent,
                chance=chance,
                **options,
            )
        except PharosError as error:
            print(f"# {entry['name']}: {agent} is not predicted: {error}", flush=True)
            continue
        values[agent] = round(cell.cells[0].value, 4)
        if agent == "dqn":
            values["table"] = round(cell.cells[0].tabular, 4)
    return {**entry, "predicted": values} if settings else entry


# Levels of ladders: function(task, what an agent learns) -> number ----------------------------------------------


def exploration_bits(task, learnt):
    """log2 of the episodes that uniform play needs until it has met every transition of some optimal policy."""
    from pharos.hardness import report

    result = report(learnt.mdp, ["exploration_time"], horizon=learnt.time_limit)["exploration_time"]
    return math.log2(result.value["episodes"])


def noise_over_gap(task, learnt):
    """Standard deviation of the noise in rewards / the smallest loss of an action that loses something."""
    q = learnt.optimal.q
    gaps = q.max(axis=1, keepdims=True) - q
    return task.chance.get("reward_noise", 0.0) / gaps[gaps > TIE].min(initial=np.inf)


def log10_states(task, learnt):
    """Decimal logarithm of the number of states."""
    return math.log10(learnt.space.num_states)


def copies_bits(task, learnt):
    """log2 of the states that are not terminal / those of the smallest MDP that cannot be told from this one."""
    from pharos.bisimulation import minimize

    acts = ~np.asarray(learnt.mdp.terminal, bool)
    return math.log2(acts.sum() / len(np.unique(minimize(learnt.mdp).classes[acts])))


def unit_decades(task, learnt):
    """Powers of 10 by which the unit of rewards is away from 1."""
    return abs(math.log10(float(task.chance.get("scale_rewards", 1.0))))


def advantage_lag(task, learnt):
    """Longest mean delay, in steps, between an action that loses something and what it loses.

    The delay is a mean over the rewards that are lost, weighted by what is lost: the derivative of ln(V - Q) by the
    discount, at 1, where actions after the first are the same. With D = dQ / d discount of these actions,
    D(s, a) = sum over s' of P(s' | s, a) (V(s') + D(s', best)).
    """
    q = learnt.optimal.q
    best = (np.arange(len(q)), q.argmax(axis=1))
    v, slope = np.append(q[best], 0.0), np.zeros_like(q)
    for _ in range(learnt.time_limit):
        slope = learnt.mdp.dynamics.expected(v + np.append(slope[best], 0.0))
    gaps = q[best][:, None] - q
    loses = gaps > TIE
    return float(((slope[best][:, None] - slope)[loses] / gaps[loses]).max(initial=0.0))


def network_less_table(task, learnt):
    """Predicted regret of the idealised DQN with a network, less that of the same with a table."""
    predicted = task.predicted or predicted_regret(task)
    return predicted["dqn"] - predicted["table"]


def predicted_regret(task):
    """Predictions for the DQN of the suite, as an entry has them."""
    from pharos import predict

    protocol = Protocol()
    hyperparameters = yaml.safe_load(FILE.read_text())["hyperparameters"]["dqn"]
    [cell] = predict(
        task.environment,
        (task.observation, task.observation_options),
        steps=protocol.steps,
        horizon=protocol.horizon,
        hyperparameters=hyperparameters,
        **task.chance,
        **task.parameters,
    ).cells
    return {"dqn": cell.value, "table": cell.tabular}


def memory_steps(task, learnt):
    """Steps back to the observation that says which action is best; 0 where the present one does.

    Two states are alike for k steps if they share their observation, and after the same actions k steps long, as do
    states on the way. Counted are the steps until all that are alike have a best action in common. Worlds with one
    outcome only; infinite where no number of steps suffices.
    """
    from pharos.observations import observation_classes, observe

    space, q = learnt.space, learnt.optimal.q
    seen = observe(space.environment, task.observation, state_space=space, **task.observation_options)
    classes = observation_classes(space, seen)
    if len(np.unique(classes)) == len(classes):
        return 0.0
    best = q > q.max(axis=1, keepdims=True) - TIE
    is_same = (classes[:, None] == classes) & ~np.eye(len(classes), dtype=bool)
    is_same &= ~(learnt.mdp.terminal[:, None] | learnt.mdp.terminal)
    is_start = np.isin(np.arange(len(classes)), learnt.mdp.start_states)
    successors, alike = np.asarray(space.successors), is_same
    for steps in range(len(classes) ** 2):
        first, second = np.nonzero(alike)
        if (best[first] & best[second]).any(axis=1).all():
            return float(steps)
        after = is_start[:, None] & is_start  # nothing came before
        for action in range(q.shape[1]):
            after[successors[first, action], successors[second, action]] = True
        if (after & is_same == alike).all():
            return math.inf
        alike = after & is_same
    return math.inf


LEVELS = {
    "exploration_bits": exploration_bits,
    "noise_over_gap": noise_over_gap,
    "log10_states": log10_states,
    "copies_bits": copies_bits,
    "unit_decades": unit_decades,
    "advantage_lag": advantage_lag,
    "network_less_table": network_less_table,
    "memory_steps": memory_steps,
}


# The core -------------------------------------------------------------------------------------------------------


def cells():
    """(environment, parameters, observation, chance) of the candidates from INSTANCES."""
    for environment, parameters in INSTANCES:
        yield from ((environment, parameters, view, {}) for view in VIEWS)
    for i, (environment, parameters) in enumerate(INSTANCES):
        yield environment, parameters, VIEWS[i % 3], {"random": 0.1}
        yield environment, parameters, VIEWS[(i + 1) % 3], {"sticky": 0.25}


def add_candidates(settings):
    """Append rows to CANDIDATES: of the cells that it lacks. Cost: seconds each."""
    names = {row["name"] for row in candidates()}
    for cell in cells():
        name = name_of(*cell)
        if name not in names and pharos.build(pharos.make(cell[0], **cell[1])).num_states <= MOST_STATES:
            row = predicted_row(name, *cell, settings)
            if row is not None:
                with CANDIDATES.open("a", newline="") as file:
                    csv.DictWriter(file, COLUMNS, lineterminator="\n").writerow(row)


def name_of(environment, parameters, view, chance):
    values = [*parameters.values(), view, *(f"{kind}-{p}" for kind, p in chance.items())]
    return "-".join([environment.replace("/", "-"), *map(str, values)])


def predicted_row(name, environment, parameters, view, chance, settings):
    """The row of a candidate, of idealised learners; None where states are not told apart."""
    from pharos.prediction import predicted

    options = {"observation_options": OBSERVATIONS.get(view, {}), "chance": ChanceSetting(**chance)}
    learnt = Task(pharos.make(environment, **parameters), observation=view, **options)
    configs = (RunConfig.of_task(learnt, agent, steps=STEPS, hyperparameters=settings[agent]) for agent in settings)
    rows = {config.agent: predicted(config.to_dict()) for config in configs}
    if not rows["dqn"]["aliasing_floor"] <= 1e-6:
        return None
    numbers = {each: rows["dqn"][each] for each in ("exploration_time",)}
    numbers |= {"dqn": rows["dqn"]["kernel_regret"], "ppo": rows["ppo"]["policy_regret_played"]}
    numbers["table"] = rows["dqn"]["tabular_regret"]
    texts = {"parameters": json.dumps(parameters), "observation": view, "chance": json.dumps(chance)}
    row = {"name": name, "environment": environment, **texts, "num_states": learnt.mdp.num_states}
    return row | {key: "" if math.isnan(value) else f"{value:.9g}" for key, value in numbers.items()}


def candidates():
    """Rows of CANDIDATES; numbers where a column holds numbers, None where one is unknown."""
    with CANDIDATES.open(newline="") as file:
        rows = list(csv.DictReader(file))
    texts = ("name", "environment", "parameters", "observation", "chance")
    return [{key: text if key in texts else float(text) if text else None for key, text in row.items()} for row in rows]


def selected(rows=None, tasks=TASKS):
    """Entries of the core's tasks, in the order in which the rule takes them."""
    rows = sorted(candidates() if rows is None else rows, key=lambda row: row["name"])
    rows = [row for row in rows if is_in_window(row) and row["num_states"] <= MOST_STATES]
    places = features(rows)
    chosen = [int(np.argmin((places**2).sum(axis=1)))]
    while len(chosen) < tasks:
        distance = np.min([((places - places[each]) ** 2).sum(axis=1) for each in chosen], axis=0)
        for i, row in enumerate(rows):
            of_class = sum(class_of(rows[each]) == class_of(row) for each in chosen)
            if of_class >= PER_CLASS or any(instance(rows[each]) == instance(row) for each in chosen):
                distance[i] = -1
        farthest = int(np.argmax(np.round(distance, 12)))  # the first of equal ones, by name
        if distance[farthest] <= 0:
            break
        chosen.append(farthest)
    return [task_entry(rows[each]) for each in chosen]


def is_in_window(row):
    """Whether the idealised learners neither both solve it nor both fail."""
    learners = [row[name] for name in ("dqn", "ppo") if row[name] is not None]
    return bool(learners) and max(learners) > SOLVED and min(learners) < FAILED


def features(rows):
    """(N, 6) in [-1/2, 1/2]: ranks of exploration, table, representation, kind of learner, states; then chance."""
    ppo = [row["dqn"] if row["ppo"] is None else row["ppo"] for row in rows]
    columns = [
        [None if row["exploration_time"] is None else math.log2(max(1, row["exploration_time"])) for row in rows],
        [row["table"] for row in rows],
        [row["dqn"] - row["table"] for row in rows],
        [row["dqn"] - other for row, other in zip(rows, ppo, strict=True)],
        [math.log10(row["num_states"]) for row in rows],
    ]
    chance = [0.25 if row["chance"] != "{}" else -0.25 for row in rows]
    return np.column_stack([*(ranks(column) for column in columns), chance])


def ranks(values):
    """Mean ranks of a column in [-1/2, 1/2], to 9 digits; 0, the median, where a value is unknown."""
    known = np.array([value for value in values if value is not None])
    known = np.array([float(f"{value:.9g}") for value in known])
    below = {value: ((known < value).sum() + (known <= value).sum()) / 2 for value in known}
    return [0.0 if v is None else below[float(f"{v:.9g}")] / len(known) - 0.5 for v in values]


def class_of(row):
    return row["environment"].partition("/")[0]


def instance(row):
    return row["environment"], row["parameters"]


def task_entry(row):
    """The entry of a candidate in the file of a suite."""
    parts = {name: json.loads(row[name]) for name in ("parameters", "chance")}
    entry = {"name": row["name"], "environment": row["environment"], "parameters": parts["parameters"]}
    entry["observation"] = row["observation"]
    if row["observation"] in OBSERVATIONS:
        entry["observation_options"] = OBSERVATIONS[row["observation"]]
    if parts["chance"]:
        entry["chance"] = parts["chance"]
    seconds = {name: row[f"{name}_seconds"] for name in ("dqn", "ppo") if row[f"{name}_seconds"] is not None}
    return {**entry, "seconds": seconds}


# The file -------------------------------------------------------------------------------------------------------


def written(entry):
    """The text of a suite's file: an entry of a task on a line, but for its numbers."""
    sha256 = hashlib.sha256(CANDIDATES.read_bytes()).hexdigest()
    lines = [HEAD.format(name=entry["name"], date=DATE, sha256=sha256)]
    lines += [f"{name}: {flow(entry[name])}\n" for name in ("name", "digest", "protocol")]
    lines.append("hyperparameters:  # of the baselines, one setting for all tasks\n")
    lines += [f"  {agent}: {flow(setting)}\n" for agent, setting in entry["hyperparameters"].items()]
    lines += ["core:\n", *(task_text(task, "  ") for task in entry["core"]), "ladders:\n"]
    for ladder in entry["ladders"]:
        keys = [f"{name}: {flow(ladder[name])}\n" for name in ("axis", "unit", "quantity", "measure")]
        lines += ["  - " + "    ".join([*keys, "tasks:\n"]), *(task_text(task, "      ") for task in ladder["tasks"])]
    return "".join(lines)


def task_text(entry, indent):
    keys = [each for each in TASK_KEYS if entry.get(each) not in (None, {})]
    return f"{indent}- " + f"{indent}  ".join(f"{key}: {flow(entry[key])}\n" for key in keys)


def flow(value):
    """A value of YAML on one line: words bare where they may be, numbers as Python writes them, with a point."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow(each)}" for key, each in value.items()) + "}"
    if isinstance(value, float):
        text = repr(value)
        return text if "e" not in text or "." in text else text.replace("e", ".0e")
    if isinstance(value, str) and re.fullmatch(r"[A-Za-z_][\w ./*()-]*", value) and yaml.safe_load(value) == value:
        return value
    return json.dumps(value)


def significant(value):
    return float(f"{value:.12g}")


if __name__ == "__main__":
    main()
