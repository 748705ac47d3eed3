"""The Pharos Benchmark: frozen tasks that are known to the last state, agents on them, and scores with units.

A file is loaded when something in it is first used.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.benchmark.budget import BudgetSpent
    from pharos.benchmark.comparison import AxisComparison, Comparison, Difference, Power, compare, power
    from pharos.benchmark.execution import run
    from pharos.benchmark.page import report
    from pharos.benchmark.results import AgentResults, baselines, read_results
    from pharos.benchmark.scores import AxisScore, BenchmarkScore, Interval, score
    from pharos.benchmark.sealed import sealed_copies, sealed_instances, season_seed, write_suite
    from pharos.benchmark.suite import BenchmarkTask, Ladder, Protocol, Suite, load_suite

__all__ = [
    "AgentResults",
    "AxisComparison",
    "AxisScore",
    "BenchmarkScore",
    "BenchmarkTask",
    "BudgetSpent",
    "Comparison",
    "Difference",
    "Interval",
    "Ladder",
    "Power",
    "Protocol",
    "Suite",
    "baselines",
    "compare",
    "load_suite",
    "power",
    "read_results",
    "report",
    "run",
    "score",
    "sealed_copies",
    "sealed_instances",
    "season_seed",
]
_shared = """
    write_suite
"""

__getattr__ = lazy.attributes(__name__)
