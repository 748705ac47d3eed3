"""A newcomer's first minutes: what is compiled is told apart from work, kept, and done beforehand; shells complete."""

import json
import re
import time
from pathlib import Path

import gymnasium
import numba
import pytest

import pharos
from command_line import process
from pharos.cli.options import complete_target
from pharos.environments import list_environments
from pharos.environments.built_in import BUILT_IN
from pharos.mdp import ChanceSetting
from pharos.system import compiling


def completed(*words):
    line = {"COMP_WORDS": " ".join(("pharos", *words)), "COMP_CWORD": str(len(words))}
    return process(environment=line | {"_PHAROS_COMPLETE": "complete_bash"}).stdout.split()


def test_seconds_of_compiling_are_not_seconds_of_work():
    import pharos.kernels.gaps  # noqa: F401  (which listens)

    def slow_to_compile(x):
        for i in range(x):
            x += i
        return x

    function = numba.njit(slow_to_compile)
    began, watch = time.perf_counter(), compiling.Stopwatch()
    function(3)
    compiled, elapsed = watch.compiling, time.perf_counter() - began
    assert 0 < compiled <= elapsed
    assert watch.seconds + watch.compiling <= time.perf_counter() - began
    time.sleep(0.05)
    function(3)
    assert watch.compiling == compiled and watch.seconds >= 0.05


@pytest.mark.long
def test_what_warm_has_compiled_no_later_process_compiles(tmp_path):
    cache = {"PHAROS_CACHE_DIR": str(tmp_path / "cache")}
    warmed = json.loads(process("warm", "simple_grid/4x4-plain", "--json", environment=cache).stdout)
    assert warmed["compiling_seconds"] > 0 and len(warmed["environments"]) == 1
    for verb in ("build", "solve", "hardness"):
        words = ("simple_grid", "height=5", "width=4", "goal=[4,3]")  # another instance of the class
        answer = json.loads(process(verb, *words, "--json", environment=cache).stdout)
        assert answer["compiling_seconds"] == 0, verb


@pytest.mark.long
def test_the_first_listing_of_the_readme_is_what_is_printed(tmp_path):
    text = (Path(__file__).parents[2] / "README.md").read_text()
    command, shown = re.search(r"^```\n\$ pharos (.*)\n((?:.*\n)*?)```$", text, re.MULTILINE).groups()
    printed = process(*command.split(), environment={"PHAROS_CACHE_DIR": tmp_path}).stdout + "\n"
    printed = re.sub(r"^compiling: .*\n", "", printed, flags=re.MULTILINE)  # the first time

    def lines(listing):
        return [re.sub(r"(\d+\.\d\d|kept)$", "", line.rstrip()).rstrip() for line in listing.strip().splitlines()]

    assert len(lines(shown)) == 9 and lines(printed) == lines(shown)


def test_a_space_too_large_to_measure_is_compiled_for_all_the_same(tmp_path, monkeypatch):
    from pharos.cli import cache

    monkeypatch.setattr(cache, "LARGEST_WARMED", 5)
    cache._use(pharos.make("simple_grid/4x4-plain"), ChanceSetting())


@pytest.mark.long
def test_shells_complete_environments_instances_and_parameters():
    assert completed("hardness", "simple") == [name for name in list_environments() if name.startswith("simple_grid")]
    assert completed("build", "breakout", "h") == ["height="]
    assert completed("warm", "cat")[0] == "catch"
    assert complete_target("") == [entry.name for entry in BUILT_IN]


def test_registered_classes_have_a_gymnasium_id(monkeypatch):
    monkeypatch.setattr("pharos.environments.catalog._REGISTERED", {})

    class TwoRooms(pharos.environments.SimpleGrid):
        """A grid under another name."""

        name = "two_rooms_of_first_contact"

    assert pharos.register(TwoRooms) is TwoRooms
    env = gymnasium.make("pharos/TwoRooms-v0", height=2, width=2, goal=(1, 1))
    assert env.spec.max_episode_steps == env.unwrapped.environment.max_episode_steps
