"""Environment variables that are read once, when a process or a library of it starts.

The processes of a jail are forked from a zygote, which has started already, so most of these
variables would have no effect in a jail. The server therefore starts a zygote with them, one for
each set of values. That process is not confined yet and the client is a stranger: only names and
values that make a zygote open, load and import nothing are allowed; the others are refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

HASH_SEED = "PYTHONHASHSEED"
_MAX_HASH_SEED = 2**32 - 1

_FLAGS = (
    "ASYNCIODEBUG|COERCECLOCALE|DEVMODE|DONTWRITEBYTECODE|FAULTHANDLER|INTMAXSTRDIGITS|MALLOC|"
    "NODEBUGRANGES|OPTIMIZE|UNBUFFERED|UTF8|WARNDEFAULTENCODING|_CPU_COUNT|_GIL"
)
# The category of a filter is imported if it has a dot.
_FILTER = r"\w*(:[^:,]*(:\w*(:[^:,]*(:\d*)?)?)?)?"
_STARTED_WITH = {
    HASH_SEED: r"random|\d{1,10}",
    rf"PYTHON({_FLAGS})": r"\w*",
    "PYTHONTRACEMALLOC": r"\d?",
    "PYTHONIOENCODING": r"[\w-]*(:\w*)?",
    "PYTHONWARNINGS": rf"{_FILTER}(,{_FILTER})*",
    "LANG|LANGUAGE|LC_[A-Z]+": r"[\w.@:-]*",
    "TZ": r"(?!.*\.\.)([\w<][\w+,.:<>/-]*)?",
    "MALLOC_(ARENA_MAX|ARENA_TEST|MMAP_MAX_|MMAP_THRESHOLD_|PERTURB_|TOP_PAD_|TRIM_THRESHOLD_)": (
        r"\d*"
    ),
    r"(NPY|NUMPY)_\w+": r"[\w, ]*",
    r"OPENBLAS_(?!NUM_THREADS|DEFAULT_NUM_THREADS)\w+": r"\w*",
}
# Compiled by ``re`` at their first use: a server and its zygote start without.
_REFUSED = (
    "LD_(ASSUME_KERNEL|AUDIT|BIND_NOT|BIND_NOW|DEBUG|DEBUG_OUTPUT|DYNAMIC_WEAK|HWCAP_MASK|"
    "LIBRARY_PATH|ORIGIN_PATH|POINTER_GUARD|PREFER_MAP_32BIT_EXEC|PRELOAD|PROFILE|PROFILE_OUTPUT|"
    "SHOW_AUXV|TRACE_LOADED_OBJECTS|USE_LOAD_BIAS|VERBOSE|WARN)|GCONV_PATH|GLIBC_TUNABLES|LOCPATH|"
    "MALLOC_(CHECK_|TRACE)|NLSPATH|PYTHON(?!BREAKPOINT$)[A-Z0-9]+|"
    "PYTHON_(CONTEXT_AWARE_WARNINGS|FROZEN_MODULES|JIT|PERF_JIT_SUPPORT|PRESITE|"
    "THREAD_INHERIT_CONTEXT|TLBC)"
)


def _values_of(name: str) -> str | None:
    """Returns the pattern of a variable that is read at start; None for other variables."""
    allowed = _STARTED_WITH.items()
    return next((values for names, values in allowed if re.fullmatch(names, name, re.ASCII)), None)


def why_not(name: str, value: str = "") -> str:
    """Why a jail cannot have this variable with this value; empty if it can."""
    values = _values_of(name)
    if values is None:
        if not re.fullmatch(_REFUSED, name):
            return ""
        return (
            "is read when a process starts, and those of a jail are forked from one that has "
            "started: it would do nothing. Have env.py set it for the processes that it starts, or "
            "do there what it says"
        )
    if re.fullmatch(values, value, re.ASCII):
        return ""
    return (
        f"is {value!r}: a process that is not confined yet is started with it, which takes only "
        "values that name no file and no module"
    )


def at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables that a zygote is started with. The fixed hash seed makes sets of strings
    iterate in the same order in all jails.
    """
    own = {name: value for name, value in environment.items() if _values_of(name) is not None}
    return {HASH_SEED: "0", **own}


def fixed_hash_seed(environment: Mapping[str, str]) -> dict[str, str]:
    """Returns ``PYTHONHASHSEED`` of an environment if it is a number, else nothing."""
    seed = environment.get(HASH_SEED, "")
    fixed = seed.isascii() and seed.isdecimal() and int(seed) <= _MAX_HASH_SEED
    return {HASH_SEED: str(int(seed))} if fixed else {}
