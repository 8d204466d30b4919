"""Gives numpy's threads back to a runner.

The zygote loads OpenBLAS with ``OPENBLAS_NUM_THREADS=1``: its threads would neither survive the
fork nor allow a user namespace. OpenBLAS reads that variable once, when it is loaded, so a runner
must ask the library itself.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from envhub_worker.lockdown.mechanisms.environment import THREAD_TIMEOUT

# numpy's wheels bring an OpenBLAS whose symbols have a prefix and a suffix.
_SETTERS = (
    "scipy_openblas_set_num_threads64_",
    "openblas_set_num_threads64_",
    "scipy_openblas_set_num_threads",
    "openblas_set_num_threads",
)
_VARIABLES = ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS")
# Each thread counts as one of the jail's processes.
_MOST = 16


def find_setter() -> Callable[[int], None] | None:
    """Returns OpenBLAS's function that sets its threads; None if numpy has another BLAS."""
    with open("/proc/self/maps") as maps:
        paths = {line.split(maxsplit=5)[5].strip() for line in maps if "openblas" in line}
    for path in sorted(paths):
        try:
            library = ctypes.CDLL(path)
        except OSError:  # root's zygote is another user by now, who may not read it
            continue
        for name in _SETTERS:
            if hasattr(library, name):
                setter = getattr(library, name)
                setter.argtypes, setter.restype = [ctypes.c_int], None
                return setter  # type: ignore[no-any-return]
    return None


def _thread_count(runners: int) -> int:
    """Returns the number in OpenBLAS's variables; else an equal share of the cores per runner."""
    for name in _VARIABLES:
        value = os.environ.get(name, "")
        if value.isdigit() and int(value) > 0:
            return int(value)
    return max(1, min(len(os.sched_getaffinity(0)) // runners, _MOST))


@contextmanager
def threads_at_load(runners: int) -> Iterator[None]:
    """Set OpenBLAS's variables while a runner itself loads it, then remove them."""
    count = str(_thread_count(runners))
    variables = {"OPENBLAS_NUM_THREADS": count, "OPENBLAS_THREAD_TIMEOUT": THREAD_TIMEOUT}
    fresh = {name: value for name, value in variables.items() if name not in os.environ}
    os.environ.update(fresh)
    try:
        yield
    finally:
        for name in fresh:
            os.environ.pop(name, None)


def restore_threads(setter: Callable[[int], None] | None, runners: int) -> None:
    """Start the threads that a fresh interpreter would have; call it when confined."""
    count = _thread_count(runners)
    if setter is not None and count > 1:
        setter(count)
