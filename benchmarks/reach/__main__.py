"""How many environments of strangers run by their reference alone, or by an error's advice.

Those of ``references.txt``, each in a folder with caches of its own. Where one fails, the first
argument that its error names is taken literally, once more if need be. The control is the same
environment in an ordinary virtual environment. It needs an index, and downloads some gigabytes.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uv

from benchmarks.reach.play import STEPS
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.resolution import index
from envhub_sandbox.extras.sources import registered
from envhub_sandbox.system.folders import remove_tree

HERE = Path(__file__).resolve().parent
_PLAY = HERE / "play.py"
_TRIES = 3
_LINES = STEPS + 2
UNSEEDED = "differs from itself"
_RUNS = ("equal", "differs", "runs", UNSEEDED)
_SHOWN = 160
_PAGE = HERE.parents[1] / "docs" / "internals" / "packages-tried.md"
_HEAD = "| reference | runs | control |\n| --- | --- | --- |\n"


@dataclass(frozen=True)
class Outcome:
    """What became of a reference.

    Attributes:
        reference: The reference.
        tried: The arguments of each try, the first without any.
        error: Of the last try; empty if it ran.
        control: How it compares with itself without a sandbox, or why it fails there.
    """

    reference: str
    tried: Sequence[Mapping[str, Any]]
    error: str
    control: str

    @property
    def row(self) -> str:
        """Of the table."""
        advice = ", ".join(f"`{name}={value!r}`" for name, value in self.tried[-1].items())
        runs = self.error or (f"with {advice}" if advice else "alone")
        cells = (f"`{self.reference}`", runs, self.control)
        return f"| {' | '.join(one.replace('|', '/') for one in cells)} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Try each and print the table; the exit code says if all ran that run without a sandbox, and
    of the few all.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks reach", description=__doc__)
    parser.add_argument("--only", nargs="+", metavar="REF", help="these, instead of all")
    parser.add_argument("--quick", action="store_true", help="the few that CI tries")
    parser.add_argument("--write", action="store_true", help=f"write the table into {_PAGE.name}")
    parser.add_argument("--client", default=sys.executable, help="an interpreter that has us")
    parser.add_argument("--deadline", type=float, default=600.0, help="seconds of each process")
    options = parser.parse_args(arguments)
    rows = []
    for reference in options.only or references(quick=options.quick):
        rows.append(outcome(reference, options.client, options.deadline))
        print(rows[-1].row, flush=True)
    print(sums(rows))
    if options.write:
        text = _PAGE.read_text("utf-8")
        table = _HEAD + "".join(f"{one.row}\n" for one in rows)
        _PAGE.write_text(f"{text.partition(_HEAD)[0]}{table}\n{sums(rows)}\n", "utf-8")
    return int(any(one.error for one in rows if options.quick or one.control in _RUNS))


def references(*, quick: bool) -> list[str]:
    """The lines of the file; a star marks those for CI."""
    lines = (HERE / "references.txt").read_text("utf-8").splitlines()
    found = [line.split() for line in lines if line and not line.startswith("#")]
    return [words[0] for words in found if not quick or "*" in words]


def sums(rows: Sequence[Outcome]) -> str:
    """How many ran, of those that run without a sandbox."""
    known = [one for one in rows if one.control in _RUNS]
    alone = sum(not one.error and len(one.tried) == 1 for one in known)
    advised = sum(not one.error and len(one.tried) > 1 for one in known)
    equal = sum(not one.error and one.control == "equal" for one in known)
    return (
        f"Of {len(rows)} environments, {len(known)} run without a sandbox. Of these, {alone} run "
        f"by their reference alone, and {advised} more by the advice of their errors; {equal} give "
        "results that are equal to the last bit."
    )


def outcome(reference: str, client: str, deadline_s: float) -> Outcome:
    """Run it, follow what its errors say, and compare it with the control."""
    folder = Path(tempfile.mkdtemp(prefix="envhub-reach-"))
    folder.chmod(0o755)  # a jail of root is another user
    own = {"ENVHUB_CACHE": str(folder / "cache"), "UV_CACHE_DIR": str(folder / "uv"), "CI": "1"}
    tried: list[dict[str, Any]] = [{}]
    try:
        while True:
            words = [client, str(_PLAY), reference, json.dumps(tried[-1])]
            lines, error = run(words, own, folder, deadline_s)
            advice = advised(error)
            if not error or len(tried) == _TRIES or not advice or advice in tried:
                break
            # what was advised before still holds
            before = {name: {**tried[-1].get(name, {}), **advice[name]} for name in advice}
            tried.append({**tried[-1], **before})
        verdict = control(reference, own, folder, deadline_s, lines)
        return Outcome(reference, tried, shown(error), verdict)
    finally:
        remove_tree(folder)


def control(
    reference: str, own: Mapping[str, str], folder: Path, deadline_s: float, ours: Sequence[str]
) -> str:
    """How results compare with what a user without a sandbox gets: the package installed by uv,
    and the same entry file.
    """
    parts, python = registered.read(reference), str(folder / "venv" / "bin" / "python")
    package = parts.repo_id.partition("#")[0]
    base = interpreters.find(ours[0].split()[1] if ours else "").path
    play = [python, str(_PLAY), str(folder / "env.py")]
    made = [
        [uv.find_uv_bin(), "venv", "--quiet", "--python", base, str(folder / "venv")],
        [uv.find_uv_bin(), "pip", "install", "--quiet", "--python", python, package, "gymnasium"],
    ]
    (folder / "env.py").write_bytes(registered.entry(parts))
    theirs: list[list[str]] = []
    for words in (*made, play, play):
        lines, failure = run(words, {**index.environment(), **own}, folder, deadline_s)
        if failure:
            return f"fails, too: {shown(failure)}"
        theirs.append(lines)
    if theirs[-1] != theirs[-2]:
        return UNSEEDED
    return "equal" if ours == theirs[-1] else "runs" if len(ours) < _LINES else "differs"


def run(
    words: Sequence[str], variables: Mapping[str, str], folder: Path, deadline_s: float
) -> tuple[list[str], str]:
    """The lines that it prints, and the end of what it says where it fails."""
    with tempfile.TemporaryFile("w+", errors="replace") as said:
        try:
            done = subprocess.run(
                words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said, text=True,
                env={**os.environ, **variables}, cwd=folder, timeout=deadline_s, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return [], f"not done after {deadline_s:.0f} s"
        said.seek(0)
        text = said.read()
    failed = text[-8000:] or f"exit code {done.returncode}"
    # a package may print what it likes before
    return done.stdout.splitlines()[-_LINES:], failed if done.returncode else ""


def advised(error: str) -> dict[str, Any]:
    """The arguments that the last error names, as they stand there."""
    for name, value in reversed(list(literals(error))):
        return {name: value}
    return {}


def literals(text: str) -> Iterator[tuple[str, Any]]:
    """Each ``NAME={...}`` that is Python."""
    for found in re.finditer(r"\b(dependencies|policy)=(?=\{)", text):
        for end in re.finditer(r"\}", text[found.end() : found.end() + 400]):
            with suppress(ValueError, SyntaxError):
                yield found[1], ast.literal_eval(text[found.end() : found.end() + end.end()])
                break


def shown(error: str) -> str:
    """The line of an error that says what it is."""
    lines = [line.strip() for line in error.splitlines() if re.match(r"\S*(Error|Exit)\b.*:", line)]
    return (lines or error.strip().splitlines() or [""])[-1][:_SHOWN]


if __name__ == "__main__":
    raise SystemExit(main())
