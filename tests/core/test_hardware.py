"""The memory and the cores that a process may use, with and without control groups."""

import pytest

from rejeu.core import hardware
from rejeu.replay.ring import check_memory

MIB = 2**20


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine with 8 cores, 4 GiB of memory, 3 GiB of it free; returns what writes its files."""
    monkeypatch.setattr("os.sysconf", lambda name: {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 2**20}[name])
    monkeypatch.setattr("os.sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.delenv(hardware.CORES, raising=False)
    for name in ("MEMINFO", "MEMBERSHIP", "CGROUPS"):
        monkeypatch.setattr(hardware, name, tmp_path / name.lower())

    def write(files):
        for name, text in {"meminfo": "MemTotal: 4194304 kB\nMemAvailable:  3145728 kB\n", **files}.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    return write


LIMITED = {
    "version 2": {
        "membership": "0::/slice/job\n",
        "cgroups/slice/memory.max": f"{1024 * MIB}\n",
        "cgroups/slice/memory.current": f"{700 * MIB}\n",
        "cgroups/slice/memory.stat": f"anon 1\ninactive_file {200 * MIB}\nactive_file 5\n",
        "cgroups/slice/job/memory.max": "max\n",
        "cgroups/slice/cpu.max": "150000 100000\n",
        "cgroups/slice/job/cpu.max": "max 100000\n",
    },
    "version 1": {
        "membership": "4:memory:/job\n3:cpu,cpuacct:/job\n",
        "cgroups/memory/memory.limit_in_bytes": "9223372036854771712\n",
        "cgroups/memory/job/memory.limit_in_bytes": f"{1024 * MIB}\n",
        "cgroups/memory/job/memory.usage_in_bytes": f"{700 * MIB}\n",
        "cgroups/memory/job/memory.stat": f"inactive_file 7\ntotal_inactive_file {200 * MIB}\n",
        "cgroups/cpu/cpu.cfs_quota_us": "-1\n",
        "cgroups/cpu/cpu.cfs_period_us": "100000\n",
        "cgroups/cpu/job/cpu.cfs_quota_us": "150000\n",
        "cgroups/cpu/job/cpu.cfs_period_us": "100000\n",
    },
    "in a container, without the path on the host": {
        "membership": "0::/docker/5f1c\n",
        "cgroups/memory.max": f"{1024 * MIB}\n",
        "cgroups/memory.current": f"{500 * MIB}\n",
        "cgroups/cpu.max": "200000 100000\n",
    },
}


@pytest.mark.parametrize("files", LIMITED.values(), ids=LIMITED)
def test_control_groups_limit_memory_and_cores(files, machine):
    machine(files)
    assert hardware.physical_memory() == 1024 * MIB
    assert hardware.free_memory() == 524 * MIB
    assert hardware.cores() == 2


def test_without_limits_the_machine_counts(machine):
    machine({"membership": "0::/\n", "cgroups/cpu.max": "max 100000\n", "cgroups/memory.max": "max\n"})
    assert (hardware.physical_memory(), hardware.free_memory()) == (4096 * MIB, 3072 * MIB)
    assert hardware.cores() == 8


def test_where_the_system_does_not_say_what_is_free_all_of_it_counts(machine):
    machine({"meminfo": ""})
    assert hardware.free_memory() == 4096 * MIB


def test_the_environment_limits_the_cores(monkeypatch):
    monkeypatch.setenv(hardware.CORES, "1")
    assert hardware.cores() == 1
    for text in ("", "many", "0"):
        monkeypatch.setenv(hardware.CORES, text)
        assert hardware.cores() >= 1


def test_a_buffer_for_which_too_little_memory_is_free_is_refused(machine):
    machine({})
    check_memory(3072 * MIB, 1000)
    with pytest.raises(MemoryError, match=r"buffer_size=1000 takes 3\.5 GiB .* 3\.0 GiB .*; try buffer_size=428"):
        check_memory(3584 * MIB, 1000)
