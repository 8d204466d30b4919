"""Reads a list of references, one per line, and reports all its errors before anything runs."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

from envhub_sandbox.errors import EnvHubError, HubReferenceError
from envhub_sandbox.hub.grammar import FILE, FOLDER, has_control_characters, local_reference
from envhub_sandbox.hub.local import split_local
from envhub_sandbox.hub.reference import HubRef
from envhub_sandbox.hub.snapshot import is_here
from envhub_worker.protocol.text import first_of, printable, size_text

MOST_BYTES = 1 << 20
MOST = 2_000
"""References: people can still read a page with so many rows."""
_LONGEST = 4_096
_SHOWN = 20


@dataclass(frozen=True)
class ListEntry:
    """One reference of a list.
    ``reference``: the text to run and to show.
    ``meaning``: the normal form, equal for every spelling of the reference.
    """

    reference: str
    meaning: str
    line: int


def read_entries(file: IO[bytes], title: str) -> list[ListEntry]:
    """Reads the references of a list. Skips empty lines and those that begin with ``#``.
    ``file``: the list, in UTF-8. Folders in it are relative to the current folder.
    Raises ``HubReferenceError``: a line is no reference, names no existing folder, or repeats
    another line; or the list is too long or empty.
    """
    data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise HubReferenceError(f"{title} is larger than {size_text(MOST_BYTES)}; divide it")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise HubReferenceError(f"{title}:{line}: this is not UTF-8") from None
    entries: dict[str, ListEntry] = {}
    wrong = list(_read_into(entries, text))
    if wrong:
        faults = [f"{title}:{line}: {fault}" for line, fault in wrong]
        lines = "\n".join(first_of(faults, _SHOWN))
        raise HubReferenceError(f"nothing was run, because the list cannot be read:\n{lines}")
    if not entries:
        raise HubReferenceError(f"{title} has no reference; write one on each line")
    if len(entries) > MOST:
        raise HubReferenceError(f"{title} has more than {MOST} references; divide it")
    return list(entries.values())


def _read_into(entries: dict[str, ListEntry], text: str) -> Iterator[tuple[int, str]]:
    """Parse every line; yield the number and the text of each error."""
    for number, line in enumerate(re.split("\r\n|\r|\n", text), 1):
        written = line.strip()
        if not written or written.startswith("#"):
            continue
        try:
            reference, meaning = _meaning(written)
        except (EnvHubError, OSError, ValueError) as error:
            hint = "; put a comment on its own line" if " #" in written else ""
            yield number, printable(f"{error}{hint}", _LONGEST)
            continue
        first = entries.setdefault(meaning, ListEntry(reference, meaning, number))
        if first.line != number:
            yield number, f"{reference} is already in line {first.line}, as {first.reference}"


def _meaning(reference: str) -> tuple[str, str]:
    if len(reference) > _LONGEST or has_control_characters(reference):
        raise HubReferenceError(
            "this is not a reference: it is too long, or has control characters"
        )
    if is_here(reference):
        folder, path, is_file = split_local(reference)
        if path == os.pardir or path.startswith(f"{os.pardir}/") or os.path.isabs(path):
            raise HubReferenceError(f"{reference}: its entry file is outside its folder")
        kind = FILE if is_file else FOLDER
        return reference, local_reference(kind, str(folder.resolve()), path)
    ref = HubRef.parse(reference)
    return str(ref), ref.meaning
