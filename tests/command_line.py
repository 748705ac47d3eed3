"""The command line: in this process, and as a process of its own."""

import json
import os
import subprocess
import sys

from typer.testing import CliRunner

from patience import PATIENCE
from pharos.cli import app


def run(*words, **options):
    """What a command does in this process: `exit_code`, `stdout`, `stderr`."""
    return CliRunner().invoke(app, [*map(str, words)], **options)


def answer(*words):
    """The object that a command prints with --json, which is all it prints."""
    done = run(*words, "--json")
    assert (done.exit_code, done.stderr) == (0, ""), done.output
    assert done.stdout.count("\n") == 1
    return json.loads(done.stdout)


def usage_error(*words):
    """The one line with which a command is refused as bad usage."""
    done = run(*words)
    assert (done.exit_code, done.stdout) == (2, ""), done.output
    assert done.stderr.count("\n") == 1
    return done.stderr


def process(*words, environment=None, **options):
    """What a command does as a process of its own, with more variables in its environment: `returncode`, `stdout`,
    `stderr`."""
    line = [sys.executable, "-m", "pharos", *map(str, words)]
    environment = {**os.environ, **{name: str(value) for name, value in (environment or {}).items()}}
    return subprocess.run(
        line, **{"capture_output": True, "text": True, "timeout": PATIENCE, "env": environment} | options
    )
