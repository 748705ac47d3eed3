"""The Pharos Benchmark: frozen tasks that are known to the last state, agents on them, and scores with units.

A file is loaded when something in it is first used.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.benchmark.budget import BudgetSpent
    from pharos.benchmark.execution import run
    from pharos.benchmark.results import AgentResults, baselines, read_results
    from pharos.benchmark.suite import BenchmarkTask, Ladder, Protocol, Suite, load_suite

__all__ = [
    "AgentResults",
    "BenchmarkTask",
    "BudgetSpent",
    "Ladder",
    "Protocol",
    "Suite",
    "baselines",
    "load_suite",
    "read_results",
    "run",
]
_shared = """
"""

__getattr__ = lazy.attributes(__name__)
