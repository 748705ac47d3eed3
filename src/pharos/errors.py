"""Every exception that pharos raises on purpose.

    PharosError
    ├── ParameterError (ValueError)     a parameter, name or option is wrong: nothing was computed  (exit code 2)
    │   ├── UnknownName                 no such environment, measure, observation, agent ...: nearest match suggested
    │   └── UntrustedCode               a file names code of somebody else, which is executed only if it is trusted
    ├── RuleError                       an environment's rules broke their contract, for a named state and action
    ├── StateSpaceError                 something is wrong with a folder that holds a state space
    │   ├── StateSpaceTooLarge          more states than `max_states`
    │   ├── StateSpaceIncomplete        the build has not finished; the same command resumes it
    │   ├── StateSpaceCorrupted         truncated or tampered files
    │   ├── StateSpaceMismatch          the folder holds another environment, parameters or version of its rules
    │   ├── StateSpaceLocked            another process is building there (a FolderLocked as well)
    │   └── DiskFull                    no room; finished work is kept
    ├── FolderLocked                    another process is at work in a folder
    ├── FileFormatError (ValueError)    a file lacks something or holds nonsense
    │   └── ResultCorrupted             a result was cut short, or changed after it was written
    ├── TimeLimit                       work on what somebody else has sent takes longer than was allowed
    ├── AllRunsFailed                   every run of a study or of a batch failed; the message says why the first did
    ├── PrecisionError                  the requested precision is finer than the error bound allows
    ├── DivergenceError (ValueError)    the value asked for is infinite
    ├── UndefinedMeasure                the measure does not exist for this MDP; the message says what would define it
    │   └── MeasureUnfinished           its budget ended before anything was proven
    └── MissingExtra (ImportError)      an optional dependency is needed; the message names the extra

A message names the source, what was expected and found, and what to try, in one line.
"""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

LONGEST_MESSAGE = 2000
"""Characters of a message: one that quotes more is cut in the middle."""


class PharosError(Exception):
    """Base class: `except PharosError` catches everything that pharos raises on purpose."""

    def __init__(self, *args: object):
        super().__init__(*(_cut(each) if isinstance(each, str) else each for each in args))


def _cut(text: str) -> str:
    half = LONGEST_MESSAGE // 2
    return text if len(text) <= LONGEST_MESSAGE else f"{text[: half - 5]} ... {text[-half:]}"


class ParameterError(PharosError, ValueError):
    """A parameter, name or option is wrong, and nothing was computed."""


class UnknownName(ParameterError):
    """No such name. The message suggests the nearest one, or says what is known: all names, or `otherwise`."""

    def __init__(self, kind: str, found: object, known: Iterable[str], otherwise: str = ""):
        known = sorted(map(str, known))
        nearest = difflib.get_close_matches(str(found), known, n=1, cutoff=0.5)
        hint = f"did you mean {nearest[0]!r}?" if nearest else otherwise or f"known: {', '.join(known) or 'none'}"
        super().__init__(f"unknown {kind} {str(found)!r}; {hint}")


class UntrustedCode(ParameterError):
    """A file names code, a module or a Python file, which is executed only if it is trusted."""


class RuleError(PharosError):
    """An environment's rules broke their contract."""


class StateSpaceError(PharosError):
    """Something is wrong with a folder that holds a state space."""


class StateSpaceTooLarge(StateSpaceError):
    """The build passed `max_states`."""


class StateSpaceIncomplete(StateSpaceError):
    """The build has not finished. The same command resumes it."""


class StateSpaceCorrupted(StateSpaceError):
    """A file of the folder is truncated, missing or tampered with."""


class StateSpaceMismatch(StateSpaceError):
    """The folder holds another environment, other parameters or another version of its rules."""


class FolderLocked(PharosError):
    """Another process is at work in the folder."""


class StateSpaceLocked(StateSpaceError, FolderLocked):
    """Another process is building in the folder."""


class DiskFull(StateSpaceError):
    """The disk has no room left. What was committed is kept."""


class FileFormatError(PharosError, ValueError):
    """A file lacks something or holds nonsense."""


class ResultCorrupted(FileFormatError):
    """A file of a result was cut short, or changed after it was written."""


class TimeLimit(PharosError):
    """Work on what somebody else has sent takes longer than was allowed."""


class AllRunsFailed(PharosError):
    """Every run of a study, or of a batch, has failed.

    Attributes:
        errors: reason of each failure, by run.
        outcome: the value that is not returned: the Status of a study, the FailedRuns of a batch.
    """

    def __init__(self, where: object, errors: Mapping[Any, Any], outcome: Any):
        first, why = next(iter(errors.items()))
        super().__init__(f"{where}: all {len(errors):,} runs failed; the first, {first}: {why}")
        self.errors, self.outcome = errors, outcome


class PrecisionError(PharosError):
    """The requested precision is finer than the error bound of the solution allows."""


class DivergenceError(PharosError, ValueError):
    """The value asked for is infinite, or no policy has one. The message names the cycle."""


class UndefinedMeasure(PharosError):
    """The measure does not exist for this MDP. The message says what would define it."""


class MeasureUnfinished(UndefinedMeasure):
    """The budget of a measure ended before it had a value or proven bounds."""


class MissingExtra(PharosError, ImportError):
    """An optional dependency is missing. The message names the extra that brings it."""

    def __init__(self, purpose: str, package: str, extra: str):
        hint = f"pip install 'pharos-rl[{extra}]'"
        if extra == "agents":
            hint += (
                " (on Linux that brings PyTorch for CUDA, several GB; for the small one, of CPUs alone, first: "
                "pip install torch --index-url https://download.pytorch.org/whl/cpu)"
            )
        super().__init__(f"{purpose} needs {package}; install it with: {hint}")
