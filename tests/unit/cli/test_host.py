"""Memory that may still be taken, in folders as the kernel shows them."""

from pathlib import Path

import pytest

from envhub_sandbox.cli.shared.host import free_memory_bytes

_MIB = 1 << 20
_NO_LIMIT = str((1 << 63) - 4096)


def host(folder: Path, own: str, mounts: dict[str, str], **groups: dict[str, int | str]) -> Path:
    """A ``/proc`` of 1000 MiB, and the control groups that it tells of. For each folder, ``mounts``
    has the group that is mounted there, with the kind and its options; ``groups`` the files of each
    group, below ``folder``, with ``__`` for a slash."""
    proc = folder / "proc"
    (proc / "self").mkdir(parents=True)
    (proc / "meminfo").write_text("MemTotal: 2048000 kB\nMemAvailable: 1024000 kB\n")
    (proc / "self" / "cgroup").write_text(own)
    lines = ["31 23 0:28 / /sys rw,relatime - tmpfs tmpfs rw", "nonsense"]
    for name, what in mounts.items():
        root, kind, options = what.split(" ")
        point = str(folder / name).replace(" ", "\\040")
        lines.append(f"35 31 0:32 {root} {point} rw,relatime shared:1 - {kind} cgroup {options}")
    (proc / "self" / "mountinfo").write_text("\n".join(lines) + "\n")
    for name, files in groups.items():
        place = folder / name.replace("__", "/")
        place.mkdir(parents=True, exist_ok=True)
        for file, text in files.items():
            (place / file).write_text(f"{text}\n")
    return proc


def v2(limit: int | str, used: int = 0, idle: int = 0) -> dict[str, int | str]:
    return {
        "memory.max": limit,
        "memory.current": used,
        "memory.stat": f"anon 1\ninactive_file {idle}",
    }


def v1(limit: int | str, used: int = 0, idle: int = 0) -> dict[str, int | str]:
    return {
        "memory.limit_in_bytes": limit,
        "memory.usage_in_bytes": used,
        "memory.stat": f"inactive_file 0\ntotal_inactive_file {idle}",
    }


_V2 = {"g": "/ cgroup2 rw"}
_V1 = {"c": "/ cgroup rw,cpu", "g": "/ cgroup rw,memory"}


@pytest.mark.parametrize(
    ("own", "mounts", "groups", "free"),
    [
        ("", {}, {}, 1000),
        ("0::/\n", _V2, {"g": {}}, 1000),
        ("0::/a/b\n", _V2, {"g__a__b": v2(300 * _MIB)}, 300),
        ("0::/a/b\n", _V2, {"g__a__b": v2(300 * _MIB), "g__a": v2(200 * _MIB)}, 200),
        ("0::/a/b\n", _V2, {"g__a__b": v2("max"), "g": v2(100 * _MIB)}, 100),
        ("0::/a\n", _V2, {"g__a": v2(300 * _MIB, 200 * _MIB, 50 * _MIB)}, 150),
        ("0::/a\n", _V2, {"g__a": v2(300 * _MIB, 400 * _MIB)}, 0),
        ("0::/a\n", _V2, {"g__other": v2(3 * _MIB)}, 1000),
        # a container: its group is the mount's, or out of sight
        ("0::/docker/x\n", {"g": "/docker/x cgroup2 rw"}, {"g": v2(300 * _MIB)}, 300),
        ("0::/docker/x/in\n", {"g": "/docker/x cgroup2 rw"}, {"g__in": v2(9 * _MIB)}, 9),
        ("0::/docker/x\n", _V2, {"g": v2(300 * _MIB)}, 300),
        ("0::/../../y\n", _V2, {"g": v2(300 * _MIB), "y": v2(1)}, 300),
        # moved out of the group that its namespace begins with, which the mount is above
        ("0::/../y\n", {"g": "/.. cgroup2 rw"}, {"g": v2(300 * _MIB), "g__y": v2(9 * _MIB)}, 9),
        ("0::/a\n", {"with space": "/ cgroup2 rw"}, {"with space__a": v2(7 * _MIB)}, 7),
        # the first version
        ("4:memory:/a\n1:cpu:/b\n0::/\n", _V1, {"g__a": v1(_NO_LIMIT), "g": v1(_NO_LIMIT)}, 1000),
        ("4:cpu,memory:/a:b\n", _V1, {"g__a:b": v1(_NO_LIMIT), "g": v1(9 * _MIB, 5, 5)}, 9),
        ("4:memory:/a\n1:cpu:/b\n", _V1, {"c__a": v1(_MIB), "g__b": v1(_MIB)}, 1000),
        # what nobody expects
        ("0::/a\n", _V2, {"g__a": v2("-1")}, 1000),
        ("0::/a\nx\n", _V2, {"g__a": {"memory.max": 5 * _MIB}}, 5),
    ],
)
def test_the_least_that_is_left_counts(
    own: str,
    mounts: dict[str, str],
    groups: dict[str, dict[str, int | str]],
    free: int,
    tmp_path: Path,
) -> None:
    """Of the machine, of our group, and of each around it; what the kernel gives back is free."""
    assert free_memory_bytes(host(tmp_path, own, mounts, **groups)) == free * _MIB


def test_where_the_kernel_tells_nothing(tmp_path: Path) -> None:
    assert free_memory_bytes(tmp_path) is None
    assert (free_memory_bytes() or 0) > 0
