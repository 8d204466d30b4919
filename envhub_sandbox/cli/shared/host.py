"""Facts about this machine: the versions of programs and packages, and the free memory."""

from __future__ import annotations

import platform
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

_PACKAGES = ("gymnasium", "numpy", "huggingface_hub", "pyzmq", "msgpack", "imageio-ffmpeg")


def versions() -> dict[str, str | int | None]:
    """Return the versions of this package and its dependencies; None for a missing package."""
    from envhub_sandbox import __version__
    from envhub_worker.protocol.messages import VERSION

    own: dict[str, str | int | None] = {"envhub-sandbox": __version__, "protocol": VERSION}
    own |= {"python": platform.python_version(), "platform": platform.platform()}
    return own | {name: _installed(name) for name in _PACKAGES}


def _installed(name: str) -> str | None:
    from importlib import metadata  # late: it imports email

    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


_V1, _V2 = "memory", ""
_FILES = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)
"""For each version of control groups, the files of the limit, the usage and reclaimable memory."""
_UNLIMITED = 1 << 60
"""Version 1 writes "no limit" as the largest number of pages."""


def free_memory_bytes(proc: Path = Path("/proc")) -> int | None:
    """Return the bytes that are free or reclaimable; None if the kernel does not say.

    The control group of this process, or one around it, may have fewer bytes left than the machine,
    such as that of a container or of a service.
    """
    kilobytes = _fields(proc / "meminfo").get("MemAvailable:")
    of_machine = None if kilobytes is None else kilobytes * 1024
    free = [of_machine, *map(_of_group, _groups(proc / "self"))]
    return min((size for size in free if size is not None), default=None)


def _of_group(folder: Path) -> int | None:
    for limit, used, idle in _FILES:
        most = _number(folder / limit)
        if most is not None and most < _UNLIMITED:
            held = (_number(folder / used) or 0) - _fields(folder / "memory.stat").get(idle, 0)
            return max(0, most - max(0, held))
    return None


def _groups(process: Path) -> Iterator[Path]:
    """Yield the folders of the groups that count our memory, from our own to the top visible."""
    lines = [line.split(":", 2) for line in _text(process / "cgroup").splitlines()]
    own = {name: line[2] for line in lines if len(line) == 3 for name in line[1].split(",")}
    for kind, root, top in _mounts(process / "mountinfo"):
        group = PurePosixPath(own.get(kind, "/"))
        below = group.relative_to(root) if group.is_relative_to(root) else PurePosixPath("..")
        # our group may be outside of a container's mount; the paths of a moved group begin with ..
        folder = top / ("" if ".." in below.parts else below)
        yield from (group for group in (folder, *folder.parents) if group.is_relative_to(top))


def _mounts(mountinfo: Path) -> Iterator[tuple[str, str, Path]]:
    """Yield version, group and folder of each mount of groups that may count memory."""
    for line in _text(mountinfo).splitlines():
        left, _, right = line.partition(" - ")
        mount, source = left.split(" "), right.split(" ")
        if len(mount) < 5 or len(source) < 3:
            continue
        kind = {"cgroup2": _V2, "cgroup": _V1}.get(source[0])
        if kind == _V2 or (kind == _V1 and _V1 in source[2].split(",")):
            yield kind, _unescaped(mount[3]), Path(_unescaped(mount[4]))


def _unescaped(word: str) -> str:
    return re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), word)


def _fields(path: Path) -> dict[str, int]:
    lines = [line.split() for line in _text(path).splitlines()]
    return {line[0]: int(line[1]) for line in lines if len(line) > 1 and line[1].isdigit()}


def _number(path: Path) -> int | None:
    text = _text(path).strip()
    return int(text) if text.isdigit() else None


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
