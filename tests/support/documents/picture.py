"""``docs/assets/run.svg``: the README's command in a terminal, beside the film that it wrote.

The command is run in a terminal of its own; what it prints and the frames of its film become one
picture that moves by itself and loads nothing. ``docs/assets/doctor.svg`` is what ``envhub doctor``
prints. ``python -m tests.support.documents.picture`` draws both again.
"""

from __future__ import annotations

import base64
import io
import itertools
import os
import pty
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from tests.support.documents.blocks import CHECKOUT
from tests.support.documents.written import DOCS

DOCUMENT = DOCS / "assets" / "run.svg"
DOCTOR = DOCS / "assets" / "doctor.svg"
MAX_BYTES = 300_000
COLUMNS = 88
_CELL, _LINE, _MARGIN, _TOP = 7.25, 19, 18, 44
_FILM = (300, 160)
_TYPED_S, _RAN_S, _BETWEEN_S = 2.0, 3.2, 0.08
_GRID, _EVERY, _COLORS = 10, 2, 32
"""The film is 10 x 10 of its frames, every second one, in 32 colours."""
_BOLD, _DIM = "#ffffff", "#8b93a7"
_COLOURS = {"(1)": "#ff8a80", "(2)": "#7ee0a3", "(3)": "#f2c14e"}
"""Of the numbers that a terminal's colours have: red, green, yellow."""
_STYLE = """
text{font:12px ui-monospace,SFMono-Regular,Menlo,Consolas,"DejaVu Sans Mono",monospace;fill:#d6dae4;
white-space:pre}
@media (prefers-reduced-motion:no-preference){
.late{opacity:0;animation:show .01s forwards}
#cover{animation:type TYPEDs steps(TYPED_COLUMNS) forwards}
#column{animation:across COLUMN_Ss steps(GRID) infinite}
#row{animation:down FILM_Ss steps(GRID) infinite}}
@keyframes show{to{opacity:1}}
@keyframes type{from{transform:none}to{transform:translateX(TYPED_WIDTHpx)}}
@keyframes across{to{transform:translateX(-SHEET_WIDTHpx)}}
@keyframes down{to{transform:translateY(-SHEET_HEIGHTpx)}}
"""


def command() -> str:
    """What the README says to run, without the folder of the program."""
    block = re.findall(r"^```sh\n(.*?)\n```$", (CHECKOUT / "README.md").read_text(), re.M | re.S)[0]
    return str(block.rpartition("/bin/")[2])


def played(words: list[str], folder: Path) -> tuple[str, Path]:
    """What the command prints in a terminal, once its progress bar is gone, and its film."""
    film = folder / words[-1]
    text = printed([*words[1:-1], str(film)])
    return text.replace(str(film), words[-1]), film


def printed(words: list[str]) -> str:
    """What a command prints on stdout, a terminal, without this machine's paths."""
    program = [sys.executable, "-I", "-m", "envhub_sandbox", *words]
    ours, theirs = pty.openpty()
    sized = {**os.environ, "COLUMNS": str(COLUMNS), "TERM": "xterm-256color"}
    with subprocess.Popen(
        program, cwd=CHECKOUT, env=sized, stdout=theirs, stderr=subprocess.DEVNULL
    ) as process:
        os.close(theirs)
        read = b""
        while part := _read(ours):
            read += part
    os.close(ours)
    assert process.returncode == 0, read.decode()
    text = read.decode().replace("\r\n", "\n")
    for path, name in ((sys.executable, ".venv/bin/python"), (CHECKOUT, "~/envhub-sandbox")):
        text = text.replace(str(path), name)
    return text.strip("\n")


def _read(end: int) -> bytes:
    try:
        return os.read(end, 1 << 16)
    except OSError:  # Linux's way to say that the other end is closed
        return b""


def sheet(film: Path) -> tuple[bytes, float]:
    """The film's frames on one PNG, row by row, and the frames a second that they are shown at."""
    import imageio_ffmpeg
    from PIL import Image

    reader = imageio_ffmpeg.read_frames(str(film))
    told: dict[str, Any] = next(reader)
    width, height = told["size"]
    frames = [np.frombuffer(one, np.uint8).reshape(height, width, 3) for one in reader][::_EVERY]
    assert len(frames) >= _GRID**2, f"{len(frames)} frames are too few: more --episodes"
    grid = np.stack(frames[: _GRID**2]).reshape(_GRID, _GRID, height, width, 3)
    image = Image.fromarray(np.concatenate(np.concatenate(grid, axis=1), axis=1))
    written = io.BytesIO()
    image.quantize(_COLORS, dither=Image.Dither.NONE).save(written, "PNG", optimize=True)
    return written.getvalue(), told["fps"] / _EVERY


def spans(line: str) -> Iterator[tuple[int, str, str]]:
    """The column, the text and the colour of each part of a line."""
    text = Text.from_ansi(line)
    marks = {span.start: str(span.style) for span in text.spans}
    edges = sorted(
        {0, len(text), *(edge for span in text.spans for edge in (span.start, span.end))}
    )
    for start, end in itertools.pairwise(edges):
        style = marks.get(start, "")
        colour = next((code for name, code in _COLOURS.items() if name in style), "")
        yield (
            start,
            text.plain[start:end],
            (colour or (_BOLD if "bold" in style else _DIM * ("dim" in style))),
        )


def _written(line: str, number: int) -> str:
    """One line of the terminal; its letters take their columns whatever the font is."""
    y, parts = _TOP + number * _LINE, []
    for column, text, color in spans(line):
        kept = text.rstrip()
        if not kept:
            continue
        start = column + len(kept) - len(kept.lstrip())
        kept = kept.lstrip()
        fill = f' fill="{color}" style="fill:{color}"' if color else ""
        parts.append(
            f'<text x="{_MARGIN + start * _CELL:.2f}" y="{y}" textLength="{len(kept) * _CELL:.2f}"'
            f' lengthAdjust="spacingAndGlyphs"{fill}>{escape(kept)}</text>'
        )
    return "".join(parts)


def drawn(said: str, shown: str, frames: bytes, fps: float) -> str:
    """The picture.

    Args:
        said: The command.
        shown: What it printed, with a terminal's colours.
        frames: A PNG of 10 x 10 frames.
        fps: How many of them are shown in a second.
    """
    lines = shown.splitlines()
    left = _MARGIN * 2 + COLUMNS * _CELL
    width, height = left + _FILM[0] + _MARGIN, _TOP + (len(lines) + 1) * _LINE + _MARGIN
    typed = (len(said) + 2) * _CELL
    of_style = {
        "TYPED_COLUMNS": len(said),
        "TYPED_WIDTH": f"{typed:.1f}",
        "TYPED": _TYPED_S,
        "COLUMN_S": _GRID / fps,
        "FILM_S": _GRID**2 / fps,
        "GRID": _GRID,
        "SHEET_WIDTH": _FILM[0] * _GRID,
        "SHEET_HEIGHT": _FILM[1] * _GRID,
    }
    style = _STYLE.strip()
    for name, value in of_style.items():
        style = style.replace(name, str(value))
    late = [
        f'<g class="late" style="animation-delay:{_RAN_S + number * _BETWEEN_S:.2f}s">'
        f"{_written(line, number + 2)}</g>"
        for number, line in enumerate(lines)
        if line
    ]
    x, y = left, (height - _FILM[1]) / 2 + 8
    image = base64.b64encode(frames).decode()
    film = words[-1] if (words := said.split()) else ""
    return f"""<svg xmlns="http://www.w3.org/2000/svg" role="img" \
viewBox="0 0 {width:.0f} {height}">
<title>{escape(said)}: what it prints, and the film that it writes</title>
<style>{style}</style>
<rect width="100%" height="100%" rx="10" fill="#171a23"/>
<g fill="#3b4256"><circle cx="20" cy="16" r="5"/><circle cx="36" cy="16" r="5"/>\
<circle cx="52" cy="16" r="5"/></g>
<text x="{_MARGIN}" y="{_TOP}" style="fill:#7ee0a3">$</text>{_written("  " + said, 0)}
<rect id="cover" x="{_MARGIN + 2 * _CELL}" y="{_TOP - 14}" width="{typed:.1f}" height="{_LINE}" \
fill="#171a23" transform="translate({typed:.1f})"/>
{chr(10).join(late)}
<g>
<text x="{x}" y="{y - 8}" style="fill:{_DIM}">{escape(film)}</text>
<svg x="{x}" y="{y}" width="{_FILM[0]}" height="{_FILM[1]}"><g id="row"><g id="column">\
<image width="{_FILM[0] * _GRID}" height="{_FILM[1] * _GRID}" preserveAspectRatio="none" \
href="data:image/png;base64,{image}"/></g></g></svg>
</g>
</svg>
"""


def still(said: str, shown: str) -> str:
    """A command and what it prints, without a film."""
    lines = [f"  {said}", "", *shown.splitlines()]
    width = _MARGIN * 2 + max(map(len, map(_plain, lines))) * _CELL
    height = _TOP + len(lines) * _LINE
    texts = "\n".join(_written(line, number) for number, line in enumerate(lines) if line)
    return f"""<svg xmlns="http://www.w3.org/2000/svg" role="img" \
viewBox="0 0 {width:.0f} {height}">
<title>{escape(said)}: what it prints</title>
<style>{_STYLE.strip().partition("@media")[0]}</style>
<rect width="100%" height="100%" rx="10" fill="#171a23"/>
<g fill="#3b4256"><circle cx="20" cy="16" r="5"/><circle cx="36" cy="16" r="5"/>\
<circle cx="52" cy="16" r="5"/></g>
<text x="{_MARGIN}" y="{_TOP}" style="fill:#7ee0a3">$</text>
{texts}
</svg>
"""


def _plain(line: str) -> str:
    return Text.from_ansi(line).plain


def main() -> None:
    said = command()
    with tempfile.TemporaryDirectory() as folder:
        shown, film = played(shlex.split(said), Path(folder))
        frames, fps = sheet(film)
    doctor = re.sub(r"Linux \S+", "Linux", printed(["doctor"]), count=1)
    pictures = {DOCUMENT: drawn(said, shown, frames, fps), DOCTOR: still("envhub doctor", doctor)}
    for document, text in pictures.items():
        assert len(text) < MAX_BYTES, len(text)
        document.write_text(text)
        print(f"{document}: {len(text) >> 10} KiB")


if __name__ == "__main__":
    main()
