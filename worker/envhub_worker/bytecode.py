"""Makes the bytecode of a folder of packages: ``bootstrap.py bytecode FOLDER NUMBER COUNT``, by one
of several processes that share it.

A compiler runs nothing of what it reads, but what it reads is a stranger's, and compilers have
faults. So this process is confined before it opens any of it: it may read the standard library and
the folder, and write into the folder, and that is all: no capabilities, no network, no other file,
no system call that a jail has not. What a fault would give somebody is the folder, which is theirs
anyway. Where this host has not all of these layers, nothing is compiled: jails then start slower.
"""

from __future__ import annotations

import compileall
import os
import py_compile
import re
import resource
from collections.abc import Sequence

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.mechanisms import landlock, process
from envhub_worker.lockdown.mechanisms.landlock import READ, WRITE, LandlockRule
from envhub_worker.lockdown.seccomp import filter

_LIMITS = {
    resource.RLIMIT_AS: 8 << 30,
    resource.RLIMIT_CPU: 1800,
    resource.RLIMIT_FSIZE: 1 << 30,
    resource.RLIMIT_CORE: 0,
}


def confine_to_bytecode_folder(folder: str) -> None:
    """Bind this single-threaded process to a folder, for good.
    Raises ``LayerUnavailableError``: a layer cannot be had.
    """
    process.apply_limits({limit: (value, value) for limit, value in _LIMITS.items()})
    library = os.path.realpath(os.path.dirname(os.__file__))
    abi = landlock.version()
    program = filter.compile_filter(namespaced=False, network="none", scoped=landlock.scopes(abi))
    process.drop_capabilities()
    process.set_no_new_privileges()
    # without an ABI it raises: no layer is left out
    landlock.restrict(
        landlock.ruleset(abi, "none"), [LandlockRule(library, READ), LandlockRule(folder, WRITE)]
    )
    filter.install(program)


def main(argv: Sequence[str]) -> int:
    """Compile a share of the folders below one, but for tests, which are not imported."""
    folder, number, count = argv[0], int(argv[1]), int(argv[2])
    try:
        confine_to_bytecode_folder(folder)
    except LayerUnavailableError:
        return 1
    left_out = re.compile(re.escape(folder) + r"(/.*)?/tests?/", re.DOTALL)
    # never held against its source again: both are read-only by then
    mode = py_compile.PycInvalidationMode.UNCHECKED_HASH
    # but those that the others make meanwhile: each has the same list
    below = sorted(top for top, _, _ in os.walk(folder) if not top.endswith("/__pycache__"))
    for place in below[number::count]:
        compileall.compile_dir(
            place, quiet=2, stripdir=folder, rx=left_out, maxlevels=0, invalidation_mode=mode
        )
    return 0
