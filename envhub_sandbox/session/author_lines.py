"""The author's own line in a worker's traceback.

A worker names the files of its repository relative to it. Here they get the name that their author
knows: the path in the local folder, or the name in the repository at that commit; never the copy
in the store. The verified snapshot decides which names these are, and not the worker.
"""

from __future__ import annotations

import re

from envhub_sandbox.errors import EnvHubError, RemoteEnvError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.text import printable, quoted

_FRAME = re.compile(
    r'^(?P<margin>[ |+-]*)File "(?P<file>[^"\n]{1,4096})", line (?P<line>[0-9]{1,9})'
    r"(?:, in (?P<function>[^\n]*))?(?:\n(?P<source>[ |]{4}[^\n]*)(?:\n(?P<caret>[ |\t]*\^+))?)?",
    re.MULTILINE,
)
_TRACEBACK_CHARS = 32_768
_FUNCTION_CHARS, _SOURCE_CHARS = 100, 200


def add_author_line(error: EnvHubError, snapshot: Snapshot) -> None:
    """Add the repository's own line to what it raised, once. Trust: text from the worker."""
    remote = error if isinstance(error, RemoteEnvError) else error.__cause__
    if not isinstance(remote, RemoteEnvError) or "__notes__" in vars(error):
        return
    frames = [found for found in _FRAME.finditer(remote.traceback) if _place(found, snapshot)]
    where = _line(frames[-1], snapshot) if frames else ""
    named = _FRAME.sub(lambda found: _named(found, snapshot), remote.traceback)
    remote.traceback = printable(named, _TRACEBACK_CHARS)
    remote.where = where
    if where:
        error.args = (f"{error.args[0]}\n{where}", *error.args[1:])
    if remote.traceback:
        note = f"In the environment:\n{quoted(remote.traceback.rstrip())}"
        # before Python 3.11 only some shells and test runners show it
        vars(error)["__notes__"] = [note]


def _place(found: re.Match[str], snapshot: Snapshot) -> str | None:
    name = found["file"].removeprefix(f"{snapshot.root}/")  # older workers give the whole path
    return snapshot.known_as(name)


def _named(found: re.Match[str], snapshot: Snapshot) -> str:
    place, rest = _place(found, snapshot), found[0].partition('"')[2].partition('"')[2]
    return found[0] if place is None else f"{found['margin']}File {place}{rest}"


def _line(found: re.Match[str], snapshot: Snapshot) -> str:
    place = printable(str(_place(found, snapshot)))
    function = found["function"]
    inside = f", in {one_line(function, _FUNCTION_CHARS)}" if function else ""
    lines = [f"  File {place}, line {found['line']}{inside}", *_source(found)]
    return "\n    ".join(lines)


def _source(found: re.Match[str]) -> list[str]:
    """The line, and below it the caret of a syntax error, whose line alone says little.

    Python indents both alike, by blanks and by the tabs of the line itself.
    """
    source = (found["source"] or "").replace("\t", " ")
    text = source.lstrip(" |")
    shown = one_line(text.rstrip(" |"), _SOURCE_CHARS)
    caret = (found["caret"] or "")[len(source) - len(text) :].replace("\t", " ")
    aligned = text.startswith(shown) and len(caret) <= _SOURCE_CHARS
    return [line for line in (shown, caret if aligned and not found["function"] else "") if line]
