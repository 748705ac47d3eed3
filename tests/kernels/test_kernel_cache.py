"""Compiled kernels are found by whoever has the same texts, lie in the cache alone, and are announced when slow."""

import io
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.extending import overload

import pharos
from patience import PATIENCE
from pharos.kernels.kernel_cache import called_by_kernels, kernel
from pharos.system import compiling

PACKAGE = Path(pharos.__file__).parent
ONE_KERNEL = """
import json, sys
import numpy as np
from pharos.system import compiling
compiling.SMALL_STATES = 0
from pharos.kernels import bellman
v = np.zeros(3)
bellman.solve_chain(np.array([1, -1]), np.ones(2), 0.5, v, np.zeros(2, np.int64))
print(json.dumps([v.tolist(), compiling.seconds()]))
"""


def one_kernel(package, cache):
    """The values of one kernel of a package in a process of its own, and the seconds of compiling it."""
    there = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA", "PHAROS"))}
    there |= {"PYTHONPATH": str(package.parent), "PHAROS_CACHE_DIR": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run([sys.executable, "-c", ONE_KERNEL], env=there, stdout=subprocess.PIPE, check=True)
    values, seconds = json.loads(done.stdout)
    assert values == [1.5, 1.0, 0.0]
    return seconds


def folders_of(cache):
    return {path.name for path in (cache / "compiled").glob("kernels-*")}


@pytest.mark.slow
def test_kernels_are_kept_by_their_texts_in_the_cache_alone(tmp_path):
    cache, places = tmp_path / "cache", [tmp_path / name / "pharos" for name in ("here", "there")]
    for place in places:
        shutil.copytree(PACKAGE, place, ignore=shutil.ignore_patterns("__pycache__"))
    files = [{path.relative_to(place) for path in place.rglob("*")} for place in places]
    assert one_kernel(places[0], cache) > 0
    kept = folders_of(cache)
    assert len(kept) == 1
    # another checkout, whose files are younger
    assert one_kernel(places[1], cache) == 0 and folders_of(cache) == kept
    # other texts of any kernel; folders that nobody has asked for lately are deleted by whoever makes one
    for name, age in (("kernels-aged", 31), ("kernels-young", 29)):
        (cache / "compiled" / name).mkdir()
        os.utime(cache / "compiled" / name, (time.time() - age * 86400,) * 2)
    with (places[1] / "kernels" / "gaps.py").open("a") as file:
        file.write("# changed\n")
    assert one_kernel(places[1], cache) > 0
    assert len(folders_of(cache)) == 3 and folders_of(cache) > kept | {"kernels-young"}
    assert one_kernel(places[0], cache) == 0
    assert files == [{path.relative_to(place) for path in place.rglob("*")} for place in places]


OF_TEXTS = """
import sys
import numpy as np
from pharos.kernels.kernel_cache import cache_in, kernel
from pathlib import Path

@kernel
def total(x):
    return np.sort(x)[1:].sum()

@kernel
def place(text, part):
    return hash(text), text.index(part)

for each in (total, place):
    each._cache = cache_in(Path(sys.argv[1]), each.__name__)
print(total(np.array([3.0, 1.0, 2.0])), "numba.np.arraymath" in sys.modules, end=" ")
print(place("abc", "b") == (hash("abc"), 1), sum(map(len, (total.stats.cache_hits, place.stats.cache_hits))), end=" ")
try:
    place("abc", "z")
except ValueError as error:
    print(error)
"""


@pytest.mark.slow
def test_kernels_from_disk_do_the_same_without_the_parts_of_numba_that_compile(tmp_path):
    there = os.environ | {"PYTHONPATH": str(PACKAGE.parent), "PYTHONHASHSEED": "random"}
    words = [sys.executable, "-c", OF_TEXTS, str(tmp_path)]
    first, second = (subprocess.check_output(words, env=there, text=True) for _ in range(2))
    assert first == "5.0 True True 0 substring not found\n"
    assert second == "5.0 False True 2 substring not found\n"


def test_python_is_refused_by_a_function_of_kernels_alone():
    @called_by_kernels
    def twice(x):
        return 2 * x

    assert numba.njit(lambda x: twice(x) + 1)(3) == 7
    with pytest.raises(TypeError, match=r"^twice is called by kernels alone; expected a call of its text, `.py_func`$"):
        twice(3)
    assert twice.py_func(3) == 6


def test_what_kernels_alone_call_becomes_machine_code_within_them_unless_python_calls_it():
    @called_by_kernels
    def twice(x):
        return 2 * max(x, 1)

    @numba.njit
    def more(x):
        return twice(x) + 1

    @numba.njit
    def most(x):
        return more(x) * twice(x)

    assert most(3) == 42 and more(3) == 7 and twice.nopython_signatures
    (inner,), (outer,) = ([each.library for each in one.overloads.values()] for one in (twice, most))
    assert outer._is_translated and not inner._is_translated
    assert inner.get_pointer_to_function("nobody") == 0 and not inner._is_translated
    name = next(each.name for each in inner.get_defined_functions() if "twice" in each.name)
    assert inner.get_pointer_to_function(name) and inner._is_translated


CODE_OF_A_USER = """
import sys
import numpy as np
from numba import njit, objmode
if "pharos" in sys.argv:
    from pharos.kernels import graph

@njit
def is_even(n):
    return n == 0 or is_odd(n - 1)

@njit
def is_odd(n):
    return n != 0 and is_even(n - 1)

@njit
def refused(x):
    if x < 0:
        raise ValueError("less than nothing", x)
    return x + 1

@njit
def median(x):
    with objmode(y="float64"):
        y = float(np.median([x, 2.0, 9.0]))
    return y

@njit
def squares(n):
    for i in range(n):
        yield i * i

@njit
def everything(n):
    total = 0
    for each in squares(n):
        total += each
    return is_even(abs(n)), refused(n), median(n), total, sorted([3, 1, n]), str(n)

print(everything(6), median(3.0), refused(3), is_odd(3))
try:
    everything(-1)
except ValueError as error:
    print(error.args)
"""


@pytest.mark.slow
def test_what_users_compile_beside_pharos_does_the_same():
    words = [sys.executable, "-W", "ignore", "-c", CODE_OF_A_USER]
    there = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    answers = [subprocess.check_output([*words, name], env=there, text=True) for name in ("pharos", "alone")]
    assert answers[0] == answers[1]
    assert answers[0].startswith("(True, 7, 6.0, 55, [1, 3, 6], '6') 3.0 4 True") and "less than" in answers[0]


@pytest.mark.slow
def test_a_folder_that_the_user_names_for_numba_has_the_kernels(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "environ", os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "named")})
    code = "from pharos.kernels import kernel_cache; print(kernel_cache._folder().parent)"
    there = os.environ | {"PHAROS_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run([sys.executable, "-c", code], env=there, stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout == f"{tmp_path / 'named'}\n"


def test_a_kernel_that_makes_arrays_is_refused_without_their_counts():
    def makes_an_array(x):
        return np.zeros(len(x)) + 2 * x

    with pytest.raises(numba.errors.NumbaError, match="zeros"):
        kernel(makes_arrays=False)(makes_an_array)(np.ones(2))


class Said(io.StringIO):
    """A stream that tells when something was written to it."""

    def __init__(self):
        super().__init__()
        self.event = threading.Event()

    def write(self, text):
        super().write(text)
        self.event.set()
        return len(text)


def listening(monkeypatch):
    """Standard error of a process that has compiled for long enough to say so."""
    stream = Said()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(compiling, "announces", True)
    monkeypatch.setattr(compiling, "_next", 0.0)
    return stream


def toy(name, wait, module="pharos.kernels.toy"):
    """A kernel that is compiled as long as `wait()` lasts."""

    def waits_for(x):
        pass

    @overload(waits_for)
    def _waits_for(x):
        wait()
        return lambda x: x + 1

    def total(x):
        return waits_for(x)

    total.__module__, total.__name__, total.__qualname__ = module, name.rpartition(".")[2], name
    return numba.njit(total)


def test_long_compiling_says_what_it_compiles(monkeypatch):
    said = listening(monkeypatch)
    assert toy(f"breakout_{'0' * 20}.explore", lambda: said.event.wait(PATIENCE))(1) == 2
    words = said.getvalue()
    assert words.startswith("pharos: compiling explore for breakout, kernel ") and words.count("\n") == 1
    assert words.endswith(" s so far; kept for the next time\n")
    # the next line is due some seconds of compiling later
    assert compiling._next > compiling.NOTICE_EVERY
    assert toy("sweep", lambda: None)(1) == 2 and said.getvalue() == words
    said.event.clear()
    monkeypatch.setattr(compiling, "_next", 0.0)
    assert toy("sweep", lambda: said.event.wait(PATIENCE))(1) == 2
    assert "pharos: compiling sweep, kernel " in said.getvalue()


@pytest.mark.parametrize(("module", "announces"), [("somebody.elses", True), ("pharos.kernels.toy", False)])
def test_compiling_of_others_and_of_helpers_is_not_told(monkeypatch, module, announces):
    said, timers = listening(monkeypatch), []
    monkeypatch.setattr(compiling, "announces", announces)
    assert toy("sweep", lambda: timers.append(compiling._timer), module)(1) == 2
    assert timers and not any(timer and timer.is_alive() for timer in timers) and not said.getvalue()
