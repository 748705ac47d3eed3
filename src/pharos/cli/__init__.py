"""The command line: one verb per step of the data flow, one file per verb. docs/cli.md describes it.

Every command takes `--json` (exactly one JSON object on standard output) and exits 0; 2 where the command or its
parameters are wrong; 1 where it failed; 130 where it was interrupted; with one line on standard error.
"""

from pharos.cli.app import app, main

__all__ = [
    "app",
    "main",
]
