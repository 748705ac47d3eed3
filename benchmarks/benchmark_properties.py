"""Properties of the tasks of v1, by which the report groups them.

python benchmarks/benchmark_properties.py        # seconds; writes src/pharos/benchmark/data/task_properties.csv
"""

import csv
from dataclasses import asdict, fields

from pharos.benchmark import load_suite
from pharos.benchmark.properties import PROPERTIES_FILE, TaskProperties, properties_of


def main() -> None:
    suite = load_suite("v1")
    with open(PROPERTIES_FILE, "w", encoding="utf-8", newline="") as file:
        rows = csv.DictWriter(file, ["name", *(each.name for each in fields(TaskProperties))], lineterminator="\n")
        rows.writeheader()
        rows.writerows({"name": task.name, **asdict(properties_of(task, suite.protocol))} for task in suite.tasks)


if __name__ == "__main__":
    main()
