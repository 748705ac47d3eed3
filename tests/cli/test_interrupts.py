"""Ctrl-C at any moment of a command: one line and exit code 130.

Moments are events: the n-th module that begins to load, the n-th call of a function. They are the same on every
machine, however busy.
"""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from patience import PATIENCE
from pharos.cli.answers import termination
from pharos.system.interrupts import CommandInterrupts, is_importing
from pharos.system.workers import without_interrupts

SOURCE = Path(__file__).parents[2] / "src"
# Sends SIGINT when the n-th module after pharos begins to load, or at the n-th call of a function whose file and name
# match a pattern, from the load of pharos on or from `main` on; and says where. Not once the last of `atexit` is done.
SITE = """
import os, re, signal, sys

place, _, number = os.environ.pop("INTERRUPT_AT", "none 0").rpartition(" ")
pattern, number, seen, has_begun = re.compile(place.removeprefix("main ")), int(number), 0, place[:5] != "main "
signal.signal(signal.SIGINT, signal.default_int_handler)

def arrive(what):
    global seen
    seen += 1
    if seen == number and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        with open(os.environ["INTERRUPTED_AT"], "w") as file:
            file.write(what)
        signal.raise_signal(signal.SIGINT)

def on_event(frame, event, argument):
    global has_begun
    if event == "call":
        what = f"{frame.f_code.co_filename}:{frame.f_code.co_name}"
        has_begun = has_begun or what.endswith("pharos/cli/app.py:main")
        if has_begun and pattern.search(what):
            arrive(what)

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "pharos":
            self.is_loading = True
        elif place == "module" and hasattr(self, "is_loading"):
            arrive(name)
        elif self.__dict__.pop("is_loading", False):
            sys.setprofile(on_event)

sys.meta_path.insert(0, Finder())
"""


@pytest.fixture
def interrupted(tmp_path):
    """Runs a command that is interrupted at a place: whether it was; it has to say so in one line then."""
    site = tmp_path / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(SITE)
    mark = tmp_path / "interrupted"

    def run(place, number, *words, program=("-m", "pharos")):
        mark.unlink(missing_ok=True)
        path = os.pathsep.join([str(site), str(SOURCE), os.environ.get("PYTHONPATH", "")])
        own = {"PYTHONPATH": path, "INTERRUPT_AT": f"{place} {number}", "INTERRUPTED_AT": str(mark)}
        done = subprocess.run(
            [sys.executable, *program, *map(str, words)],
            **{"cwd": tmp_path, "env": {**os.environ, **own}, "capture_output": True, "text": True},
            timeout=PATIENCE,
        )
        if not mark.exists():
            assert (done.returncode, done.stderr) == (0, "")
            return False
        assert done.returncode == 130 and done.stderr.startswith("pharos: interrupted"), (mark.read_text(), done)
        assert done.stderr.count("\n") == 1 and done.stderr.endswith("\n"), (mark.read_text(), done.stderr)
        return True

    return run


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2, 50, 300])
def test_a_command_that_loads_ends_at_once(interrupted, number):
    assert interrupted("module", number, "list", "--json")


@pytest.mark.long
@pytest.mark.parametrize(
    "place",
    [
        "main <frozen importlib._bootstrap>:cb",  # a callback of a weak reference, in which exceptions are lost
        "main system/compiling",
        "cli/answers.py:print_json",
        "threading.py:_shutdown",
        "system/interrupts.py:_end",
    ],
)
def test_what_would_lose_an_interrupt_does_not(interrupted, place):
    assert interrupted(place, 1, "count", "simple_grid", "--json")


@pytest.mark.long
def test_the_script_that_is_installed_is_interrupted_like_the_module(interrupted, tmp_path):
    script = tmp_path / "bin" / "pharos"
    script.parent.mkdir()
    script.write_text("import sys\nfrom pharos.cli import main\nsys.exit(main())\n")
    assert interrupted("module", 5, "list", program=(script,))
    assert not interrupted("module", 10**9, "list", "--json", program=(script,))


@pytest.mark.long
@pytest.mark.parametrize("words", [["list", "--json"], ["train", "frozen_lake/4x4", "--steps", 400, "--json"]])
def test_a_command_is_interrupted_at_every_moment(interrupted, words):
    """At every 25th module, and at calls of functions, more and more apart."""
    number = 1
    while interrupted("module", number, *words):
        number += 25
    assert number > 300
    number, times = 1, 0
    while interrupted(".", number, *words):
        number, times = int(number * 1.7) + 1, times + 1
    assert times > 15
    number = 1
    while interrupted("main .", number, *words):
        number = number * 3


@pytest.mark.long
def test_a_command_is_interrupted_while_its_processes_start(interrupted):
    words = ["train", "frozen_lake/4x4", "--steps", 400, "--seeds", "0,1", "--workers", 2, "--out"]
    number = 1
    while interrupted("main multiprocessing/|system/workers.py", number, *words, f"out-{number}"):
        number += 3
    assert number > 15


def test_the_library_leaves_signals_alone(tmp_path):
    script = tmp_path / "uses_pharos.py"
    code = "import signal, sys\nbefore = signal.getsignal(signal.SIGINT), sys.unraisablehook\nimport pharos\n"
    script.write_text(code + "assert (signal.getsignal(signal.SIGINT), sys.unraisablehook) == before\n")
    path = os.pathsep.join([str(SOURCE), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run([sys.executable, script], env={**os.environ, "PYTHONPATH": path}, timeout=PATIENCE)
    assert done.returncode == 0


@pytest.fixture
def handler():
    """Interrupts raise KeyboardInterrupt, as in a terminal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("forks", [False, True])
@pytest.mark.parametrize("by_another_thread", [False, True])
def test_an_interrupt_while_processes_start_is_raised_when_they_have(handler, forks, by_another_thread):
    steps = []
    with pytest.raises(KeyboardInterrupt):
        with without_interrupts(forks=forks):
            if by_another_thread:  # which has begun before, say: one that takes the signal
                thread = threading.Thread(target=_take_an_interrupt)
                thread.start()
                thread.join()
            else:  # to the process, it would be taken by a thread that does not block it, some time later
                signal.pthread_kill(threading.get_ident(), signal.SIGINT)
            assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
            steps.append("started")
        steps.append("not interrupted")
    assert steps == ["started"]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def _take_an_interrupt():
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    signal.pthread_kill(threading.get_ident(), signal.SIGINT)


def test_an_import_is_not_interrupted_and_what_was_lost_comes_again(handler, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    monkeypatch.setattr("pharos.system.interrupts.IMPORT_SECONDS", PATIENCE)
    interrupts = CommandInterrupts()
    interrupts.begin()
    (tmp_path / "interrupted_module.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nend = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        import interrupted_module

        assert interrupted_module.end == 1
        threading.Event().wait(PATIENCE)
    assert not interrupts.is_pending

    class Lost:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGINT)
            is_importing(None)  # something that is interrupted

    with pytest.raises(KeyboardInterrupt):
        Lost()
        threading.Event().wait(PATIENCE)
    assert not interrupts.finish()


def test_a_termination_waits_for_the_end_of_an_import(monkeypatch, tmp_path, capsys):
    (tmp_path / "terminated_module.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\nend = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SystemExit, match="143"), termination():
        import terminated_module

        assert terminated_module.end == 1
        threading.Event().wait(PATIENCE)
    assert capsys.readouterr().err.startswith("pharos: interrupted")
