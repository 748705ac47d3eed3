"""The Pharos Benchmark: frozen tasks that are known to the last state, agents on them, and scores with units.

A file is loaded when something in it is first used.
"""

from typing import TYPE_CHECKING

from pharos.system import lazy

if TYPE_CHECKING:
    from pharos.benchmark.agent_diagnosis import Diagnosis, diagnose
    from pharos.benchmark.check import AgentCheck, check_agent
    from pharos.benchmark.comparison import AxisComparison, Comparison, Difference, Power, compare, power
    from pharos.benchmark.entry import Claim, Entry
    from pharos.benchmark.execution import run
    from pharos.benchmark.limits import Limits
    from pharos.benchmark.loop import LoopRun, TaskEnv, task
    from pharos.benchmark.page import report
    from pharos.benchmark.ranking import Board, board, reason
    from pharos.benchmark.results import AgentResults, baselines, read_results
    from pharos.benchmark.scores import AxisScore, BenchmarkScore, ConfidenceInterval, score
    from pharos.benchmark.submission import Submission, read, submit
    from pharos.benchmark.suite import BenchmarkTask, Ladder, Protocol, Suite, frozen, load_suite, write_suite
    from pharos.benchmark.verification import EntryVerdict, SubmissionVerdict, verify
    from pharos.training import BudgetSpent

__all__ = [
    "AgentCheck",
    "AgentResults",
    "AxisScore",
    "BenchmarkScore",
    "BenchmarkTask",
    "BudgetSpent",
    "Comparison",
    "Diagnosis",
    "Ladder",
    "LoopRun",
    "Power",
    "Protocol",
    "Submission",
    "Suite",
    "TaskEnv",
    "baselines",
    "board",
    "check_agent",
    "compare",
    "diagnose",
    "frozen",
    "load_suite",
    "power",
    "read",
    "read_results",
    "report",
    "run",
    "score",
    "submit",
    "task",
    "verify",
    "write_suite",
]

__getattr__ = lazy.attributes(__name__)
