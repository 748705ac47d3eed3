"""Experiments: an agent trained on a task, its policies evaluated exactly, and the result written down."""

from pharos.experiments._evaluation import Evaluation, evaluate_agent
from pharos.experiments._task import Task

__all__ = ["Evaluation", "Task", "evaluate_agent"]
