"""The only module that writes to stdout and stderr; it prints strangers' texts as plain text.

It escapes control characters and reads no markup of rich. It wraps long lines only in a terminal,
so that a log has each on one line. CI systems execute commands that they find in a log: GitHub
``::name::`` at the beginning of a line, GitHub and Azure ``##[name]`` and ``##vso[name]`` anywhere,
GitLab ``section_start:``. ``guarded`` breaks all of these, also in warnings and in errors of the
option parser; only ``command`` writes one. ``ProgressBar`` writes to stderr if that is a terminal.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shutil
import sys
import textwrap
import threading
import time
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from envhub_sandbox.system.log import progress_shown_by, told_by
from envhub_worker.protocol.text import duration_text, printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

    from envhub_sandbox.play.episodes import EpisodeCounter

_PLAIN_WIDTH = 120
"""The columns of progress bars and boxes without a terminal."""
_LINE, _LONGEST = 200, 2_000
_WORD = 12
"""The columns of a line's first word: the kind of a fact, or the severity of a finding."""
_NARROWEST = 20
"""The fewest columns into which the last cell of a table is wrapped."""
GOOD, DOUBTFUL, BAD = "bold green", "bold yellow", "bold red"
"""The styles of a command's conclusions."""
_MOST = 1 << 20
"""The most characters of one text."""
_BREAK = "\n\r\v\f\x1c-\x1e\x85\u2028\u2029"
_SPACE = rf"(?:[^\S{_BREAK}]|\x1b\[[0-9;?]*[A-Za-z])*"
"""The text that a CI system skips before a command, including terminal colours."""
_COMMAND = re.compile(
    rf"(?:\A|(?<=[{_BREAK}])){_SPACE}:(?P<colon>:)"
    r"|##\w{0,16}(?P<bracket>\[)|section_(?:start|end)(?P<section>:)"
)
_TAIL = 32
"""The last characters of a line that the next write may complete to a command."""


def neutralised(text: str, after: str = "") -> str:
    """Escape one character of each command in a text, so that no CI system obeys it.
    ``after``: the text before it on the same line, which the result does not include.
    """

    def broken(match: re.Match[str]) -> str:
        char = match[match.lastgroup or 0]
        return f"{match[0][:-1]}\\x{ord(char):02x}"

    return _COMMAND.sub(broken, after + text)[len(after) :]


class _SafeStream:
    """A text stream on which CI systems find no commands, however many writes one is made of."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._line = ""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text that no CI system obeys."""
        written = neutralised(text, self._line)
        self._stream.write(written)
        # the end of the last line, which the next write may complete to a command
        line = re.split(f"[{_BREAK}]", self._line + written)[-1]
        start = re.sub(rf"\A{_SPACE}", "", line)
        self._line = start if start in ("", ":") else f"x{start[-_TAIL:]}"
        return len(text)

    def writelines(self, lines: Sequence[str]) -> None:
        """Write lines one after the other."""
        for line in lines:
            self.write(line)

    def command(self, line: str) -> None:
        """Write a command of ours on a line of its own."""
        begin = "\n" if self._line else ""
        self._stream.write(f"{begin}{line[:2]}{neutralised(line[2:], 'x')}\n")
        self._line = ""


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """Within this context, CI systems find no commands on stdout and stderr. A Python warning is a
    line without the file and line that raised it.
    """
    before, warnings.showwarning = warnings.showwarning, _show_warning
    try:
        with (
            contextlib.redirect_stdout(_SafeStream(sys.stdout)),
            contextlib.redirect_stderr(_SafeStream(sys.stderr)),
        ):
            yield
    finally:
        warnings.showwarning = before


def _show_warning(message: Warning | str, *_place: object, **_further: object) -> None:
    say(f"Warning: {message}", "yellow")


def console(*, stderr: bool = False) -> Console:
    """Make a console on stdout or stderr, without markup: texts may be a stranger's."""
    from rich.console import Console

    class PipeConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # rich itself would exit, with another code

    stream = sys.stderr if stderr else sys.stdout
    return PipeConsole(
        file=stream,
        markup=False,
        highlight=False,
        emoji=False,
        width=None if stream.isatty() else _PLAIN_WIDTH,
    )


def out(text: str = "", style: str | None = None) -> None:
    """Print a result on stdout."""
    console().print(safe_text(text, _MOST), style=style, soft_wrap=True)


def say(text: str, style: str | None = None) -> None:
    """Print a message on stderr."""
    console(stderr=True).print(safe_text(text, _MOST), style=style, soft_wrap=True)


def show(word: str, text: object = "", style: str | None = None, *, stderr: bool = False) -> None:
    """Print a line: a word of ours, and a text that may be a stranger's."""
    line = _hanging(f"{word:{_WORD}} ", safe_line(text, _LONGEST), stderr=stderr)
    say(line, style) if stderr else out(line, style)


def show_below(text: str, margin: str = "  ") -> None:
    """Print a text below its title, each line after a margin."""
    for line in safe_text(text).splitlines():
        out(_hanging(margin, line))


def _hanging(begin: str, text: str, *, stderr: bool = False) -> str:
    """Return ``begin`` with ``text``; in a terminal, wrapped lines are indented below ``text``."""
    stream = sys.stderr if stderr else sys.stdout
    # without a terminal, more columns than any line has
    columns = shutil.get_terminal_size().columns if stream.isatty() else _MOST
    room = columns - len(begin)
    if len(text) > room >= _NARROWEST:
        # keep a path or a command in one piece, so that a user can copy it
        lines = textwrap.wrap(text, room, break_on_hyphens=False, break_long_words=False)
        text = f"\n{' ' * len(begin)}".join(lines)
    return f"{begin}{text}".rstrip()


def show_rows(
    rows: Sequence[Sequence[str]],
    *,
    right: Collection[int] = (),
    styles: Mapping[int, str] | None = None,
) -> None:
    """Print a table on stdout. The first row has the names of the columns. In a terminal the last
    cell is wrapped. Cells may be a stranger's texts. ``right``: the indices of right-aligned
    columns; ``styles``: the style of a row by its index.
    """
    lines = [[*map(safe_line, row[:-1]), safe_line(row[-1], _LONGEST)] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for number, line in enumerate(lines):
        cells = [
            cell.rjust(width) if column in right else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        text = _hanging("".join(f"{cell}  " for cell in cells[:-1]), cells[-1].rstrip())
        out(text, (styles or {}).get(number, None if number else "bold"))


def command(line: str) -> None:
    """Print one of GitHub's workflow commands, which begins with ``::``, on stdout."""
    stream: Any = sys.stdout
    stream.command(line)


def safe_text(text: object, limit: int = 16_384) -> str:
    """Return a text that is safe in a terminal: control characters escaped, length bounded."""
    return printable(str(text), limit)


def safe_line(text: object, limit: int = _LINE) -> str:
    """Return ``safe_text`` on one line, cut to ``limit`` characters."""
    line = printable(str(text), limit=10 * limit).replace("\n", " ").replace("\t", " ")
    return line if len(line) <= limit else f"{line[: limit - 1]}…"


_json_left: ContextVar[bool] = ContextVar("_json_left", default=False)
"""Whether the user wants a JSON document that has not been printed yet."""


@contextlib.contextmanager
def expects_json(arguments: Sequence[str]) -> Iterator[None]:
    """Within this context, know if arguments have ``--json``, also if their parser rejects them."""
    token = _json_left.set("--json" in arguments)
    try:
        yield
    finally:
        _json_left.reset(token)


def print_json_error(kind: str, message: str, code: int) -> None:
    """Print an error as JSON, if the user wants JSON and no document has been printed yet."""
    if _json_left.get():
        print_json({"error": {"type": kind, "message": message, "exit_code": code}})


def print_json(document: Mapping[str, Any]) -> None:
    """Print a document on stdout, as JSON that every parser accepts."""
    _json_left.set(False)
    text = json.dumps(plain(document), indent=2, allow_nan=False, ensure_ascii=True)
    # commands of CI systems in the middle of a line are within strings, where JSON has escapes
    text = re.sub(r"#(?=#\w{0,16}\[)|_(?=(?:start|end):)", _escaped, text)
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _escaped(match: re.Match[str]) -> str:
    return f"\\u{ord(match[0]):04x}"


def plain(value: Any) -> Any:
    """Convert a value for JSON: arrays become lists, infinite numbers and NaN null, others text."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # arrays and numpy's scalars
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else safe_text(value)


@contextlib.contextmanager
def prints_on_stderr() -> Iterator[None]:
    """Within this context, send prints of Python and of libraries to stderr, not to stdout."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


@contextlib.contextmanager
def says_what_is_seen() -> Iterator[None]:
    """Within this context, print on stderr which files of this machine the code can see."""
    with told_by(lambda line: say(safe_line(line, _LONGEST))):
        yield


_EVERY_S = 0.1


class ProgressBar:
    """A progress bar; shows nothing if stderr is no terminal. A context manager.
    ``quiet``: show nothing at all.
    ``long_s``: if stderr is no terminal, print a line about an activity after so many seconds, and
    again each time the seconds have doubled; 0 prints none.
    """

    def __init__(self, *, quiet: bool, long_s: float = 0.0) -> None:
        terminal = sys.stderr.isatty()
        self._progress = None if quiet or not terminal else _progress()
        self._long_s = self._next_s = 0.0 if terminal else long_s
        self._task: TaskID | None = None
        self._what, self._total = "", 0
        self._begun = self._shown = time.monotonic()
        self._ended = threading.Event()
        self._entered = contextlib.ExitStack()

    def begin(self, title: str, total: int | None = None) -> None:
        """Show an activity that begins; ``total``: its episodes, None if unknown."""
        self._what, self._total, self._next_s = title, total or 0, self._long_s
        self._begun = self._shown = time.monotonic()
        if self._progress is None:
            return
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._task = self._progress.add_task(safe_line(title, 60), total=total, detail="")

    def update(self, counter: EpisodeCounter) -> None:
        """Show the progress; draws at most every ``_EVERY_S`` seconds."""
        now = time.monotonic()
        if self._progress is None or self._task is None or now - self._shown < _EVERY_S:
            return
        self._shown = now
        speed = counter.steps / (now - self._begun)
        done = len(counter.counted)
        detail = f"{done}/{self._total} episodes, {counter.steps} steps, {speed:,.0f} steps/s"
        self._progress.update(self._task, completed=done, detail=detail)

    def __enter__(self) -> ProgressBar:
        if self._progress is not None:
            self._entered.enter_context(self._progress)
        if self._long_s:
            thread = threading.Thread(target=self._watch, name="envhub-progress", daemon=True)
            thread.start()
            self._entered.callback(thread.join)
            self._entered.callback(self._ended.set)
        self._entered.enter_context(progress_shown_by(self.begin))
        return self

    def __exit__(self, *_: object) -> None:
        self._entered.close()

    def _watch(self) -> None:
        while not self._ended.wait(self._long_s / 10):
            spent = time.monotonic() - self._begun
            if self._what and spent >= self._next_s:
                self._next_s *= 2
                say(f"{safe_line(self._what)}: {duration_text(round(spent))} so far", "dim")


def _progress() -> Progress:
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[detail]}", markup=False),
        TimeElapsedColumn(),
        console=console(stderr=True),
        transient=True,
    )
