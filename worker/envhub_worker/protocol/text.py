"""Texts for people: a jail's output made safe for a terminal, sizes, times, a host's shortages."""

from __future__ import annotations

import errno
import re
import sys
from collections.abc import Sequence

_KEPT = "\n\t"
MARGIN = "  | "
"""Begins each line of a stranger's text among ours."""


def printable(text: str, limit: int = 16_384) -> str:
    """``text`` with control characters escaped and its middle cut where it is too long.

    Escape sequences, carriage returns, bidirectional overrides and the like become ``\\x1b``-style
    text: a terminal that prints the result does nothing but print.
    """
    if len(text) > limit:
        half = limit // 2
        text = (
            f"{text[:half]}\n[... {len(text) - 2 * half} characters left out ...]\n{text[-half:]}"
        )
    if text.replace("\n", "").replace("\t", "").isprintable():  # as most tracebacks are
        return text
    return "".join(
        char
        if char in _KEPT or char.isprintable()
        else char.encode("unicode_escape", "backslashreplace").decode("ascii")
        for char in text
    )


def counted(count: int, noun: str, plural: str = "") -> str:
    """``"1 finding"`` or ``"2 findings"``."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def first_of(texts: Sequence[str], most: int) -> list[str]:
    """The first texts, and ``"and 3 more"`` in place of the others."""
    more = len(texts) - most
    return [*texts[:most], *([f"and {more} more"] if more > 0 else [])]


def size_text(count: float) -> str:
    """Bytes in the unit that people read, such as ``"1.5 GiB"``; units are powers of 1024."""
    if count < 1024:
        return counted(round(count), "byte")
    for unit in ("KiB", "MiB", "GiB"):
        count /= 1024
        if count < 1024:
            return f"{count:.3g} {unit}" if count < 1000 else f"{count:.0f} {unit}"
    return f"{count / 1024:,.3g} TiB"


def duration_text(seconds: float) -> str:
    """A time as people say it, such as ``"3 ms"``, ``"2.5 s"`` or ``"5 min 20 s"``."""
    if seconds < 1e-3:
        return f"{seconds * 1e6:.0f} µs"
    if seconds < 1:
        return f"{seconds * 1e3:.3g} ms"
    if seconds < 60:
        return f"{seconds:.3g} s"
    if not seconds < 3.6e5:  # nor a number
        return f"{seconds / 3600:.3g} h"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


_SIZE = r"(?a)(\d+(?:\.\d+)?) *([kmgt]?)(i?b|bytes?)?"
_LEAST_BARE = 2**20
"""Least bytes without a unit: for a smaller number the unit was probably forgotten."""
SIZES = "a size such as 512M, 1.5GiB or 4G; units are powers of 1024"
"""What ``parse_size`` takes, for errors and help."""


def parse_size(text: str, unit: str = "") -> int:
    """Bytes of a size.

    Args:
        text: A number with or without a unit.
        unit: The unit of a bare number: ``""`` for bytes, ``"m"``, ``"g"``.

    Raises:
        ValueError: The text is no size or lacks a unit; the error gives an example.
    """
    match = re.fullmatch(_SIZE, text.strip().lower())
    if match is None:
        raise ValueError(f"it takes {SIZES}")
    number, prefix, rest = match.groups()
    size = int(float(number) * 1024 ** " kmgt".index(prefix or ("" if rest else unit) or " "))
    if not (prefix or rest or unit) and 0 < size < _LEAST_BARE:
        raise ValueError(
            f"that is {size_text(size)}: name a unit, {number}M, {number}G or {number}B"
        )
    return size


def continued(text: str) -> str:
    """Returns a stranger's text to put after our own on a line: its later lines get a margin.

    Without a margin they could pass for our own: the rest of an error, a log line, a traceback.
    """
    return text.replace("\n", f"\n{MARGIN}")


def quoted(text: str) -> str:
    """Returns a stranger's text to put below our own: every line gets the margin."""
    return MARGIN + continued(text)


_SPACE = "free space, or remove files if their number is used up (df -h; df -i)"
_CURES = {
    errno.EMFILE: "raise the limit{} on open files (ulimit -n; of a service LimitNOFILE=)",
    errno.ENFILE: "raise the machine's limit on open files (sysctl fs.file-max)",
    errno.ENOSPC: _SPACE,
    errno.EDQUOT: _SPACE,
    errno.EFBIG: "raise the limit on the size of a file (ulimit -f)",
    errno.ETOOMANYREFS: "this user's processes send each other more descriptors than may be on "
    "their way at once: try again, or raise the limit on open files (ulimit -n)",
    errno.ENOMEM: "free memory, or raise the limit on it",
}


def shortage(error: BaseException, where: str) -> str:
    """Says which resource is used up, where, and what to do; empty for an error of another kind.

    Args:
        error: An OSError, or ZeroMQ's error of the same form.
        where: ``"here"`` or ``"on the server"``.
    """
    cure = _CURES.get(getattr(error, "errno", None) or 0)
    if cure is None:
        return ""
    name = getattr(error, "filename", None)
    file = f" ({name})" if name else ""
    limit = ""
    if sys.platform != "win32":
        import resource  # which Windows has not, and few need

        limit = f" of {resource.getrlimit(resource.RLIMIT_NOFILE)[0]:,}"
    return f"{getattr(error, 'strerror', error)}{file} {where}: {cure.format(limit)}"
