"""Makes the bytecode of a folder of packages: ``bootstrap.py bytecode FOLDER NUMBER COUNT``, by one
of several processes that share it.

A compiler does not run its input, but the input is a stranger's, and compilers have bugs. So this
process is confined before it opens a file of the folder. It may read the standard library and the
folder and write into the folder, and nothing else: it has no capabilities, no network, no other
files, and only a jail's system calls. A bug could then give an attacker the folder only, which is
his anyway. If this host lacks one of these layers, nothing is compiled, and jails start slower.
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
    Raises ``LayerUnavailableError``: the host lacks a layer.
    """
    process.apply_limits({limit: (value, value) for limit, value in _LIMITS.items()})
    library = os.path.realpath(os.path.dirname(os.__file__))
    abi = landlock.version()
    program = filter.compile_filter(namespaced=False, network="none", scoped=landlock.scopes(abi))
    process.drop_capabilities()
    process.set_no_new_privileges()
    # Raises if the kernel has no Landlock: no layer may be missing.
    landlock.restrict(
        landlock.ruleset(abi, "none"), [LandlockRule(library, READ), LandlockRule(folder, WRITE)]
    )
    filter.install(program)


def main(argv: Sequence[str]) -> int:
    """Compile this process's share of the folders, without tests, which nobody imports."""
    folder, number, count = argv[0], int(argv[1]), int(argv[2])
    try:
        confine_to_bytecode_folder(folder)
    except LayerUnavailableError:
        return 1
    left_out = re.compile(re.escape(folder) + r"(/.*)?/tests?/", re.DOTALL)
    # Never compared with its source again: both will be read-only.
    mode = py_compile.PycInvalidationMode.UNCHECKED_HASH
    # Other processes make __pycache__ folders meanwhile: without them all lists are the same.
    below = sorted(top for top, _, _ in os.walk(folder) if not top.endswith("/__pycache__"))
    for place in below[number::count]:
        compileall.compile_dir(
            place, quiet=2, stripdir=folder, rx=left_out, maxlevels=0, invalidation_mode=mode
        )
    return 0
