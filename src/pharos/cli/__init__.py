"""The command line: one verb per step of the data flow, one file per verb. docs/cli.md describes it.

Every command takes `--json` (exactly one JSON object on standard output) and exits with

- 0 if it succeeds,
- 1 if it fails,
- 2 if the command or its parameters are wrong,
- 130 if it is interrupted.

All but the first write one line on standard error.
"""

from pharos.cli.app import app, main

__all__ = [
    "app",
    "main",
]
