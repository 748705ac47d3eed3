"""Available memory: of a made-up machine, in made-up control groups."""

import pytest

from pharos.system import memory as _memory

GIB = 1 << 30


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine with 8 GiB free."""
    proc, groups = tmp_path / "proc", tmp_path / "cgroup"
    (proc / "self").mkdir(parents=True)
    (proc / "meminfo").write_text(f"MemTotal: 99 kB\nMemAvailable: {8 * GIB // 1024} kB\n")
    monkeypatch.setattr(_memory, "_PROC", proc)
    monkeypatch.setattr(_memory, "_GROUPS", groups)

    def group(line, path, **files):
        with open(proc / "self" / "cgroup", "a") as file:
            file.write(line + "\n")
        (groups / path).mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            (groups / path / name.replace("__", ".")).write_text(str(content))

    return group


def test_without_groups_it_is_what_the_machine_has(machine):
    assert _memory.available_memory() == 8 * GIB


def test_a_group_of_version_2_limits_what_it_holds(machine):
    machine("0::/job/step", "job/step", memory__max="max", memory__current=GIB)
    machine(
        "",
        "job",
        memory__max=3 * GIB,
        memory__current=2 * GIB,
        memory__stat=f"anon 5\ninactive_file {GIB // 2}\nactive_file 8\n",
    )
    assert _memory.available_memory() == GIB + GIB // 2 + 8  # the outer group's; what files left counts as free


def test_a_group_of_version_1_as_well(machine):
    machine("11:cpu,cpuacct:/elsewhere", "cpu/elsewhere", memory__limit_in_bytes=1)
    machine(
        "4:memory:/slurm/job_7",
        "memory/slurm/job_7",
        memory__limit_in_bytes=2 * GIB,
        memory__usage_in_bytes=2 * GIB,
        memory__stat=f"inactive_file 1\ntotal_inactive_file {GIB}\ntotal_active_file 0\n",
    )
    assert _memory.available_memory() == GIB


def test_the_root_counts_where_a_container_does_not_show_its_path(machine):
    machine("0::/not/shown", ".", memory__max=GIB, memory__current=2 * GIB)
    assert _memory.available_memory() == 0


def test_nothing_known_is_no_limit(machine, tmp_path):
    (tmp_path / "proc" / "meminfo").unlink()
    assert _memory.available_memory() > 1 << 50
