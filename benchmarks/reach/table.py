"""The outcomes as Markdown, and their place in ``docs/internals/packages-tried.md``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from benchmarks.reach.measure import EQUAL, Outcome

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "internals" / "packages-tried.md"
BEGIN = "<!-- python -m benchmarks.reach --write -->\n"
END = "<!-- end of what it writes -->\n"
HEAD = {
    "package": "| package | by its line alone | with one argument | cold, warm, offline, s | MiB "
    "| control |\n| --- | --- | --- | --- | --- | --- |",
    "repository": "| repository | by its reference alone | with one argument "
    "| cold, warm, offline, s | MiB | control |\n| --- | --- | --- | --- | --- | --- |",
}


def row(name: str, outcome: Outcome) -> str:
    """A line of the table."""
    about = f"{name}: {outcome.about}" if outcome.about else name
    alone = _first(outcome.alone) if outcome.alone else "yes"
    argument = ""
    if outcome.argument:
        given = json.loads(outcome.argument).items()
        words = ", ".join(f"{key}={json.dumps(value)}" for key, value in given)
        argument = f"`{words}`: {_first(outcome.helped) or 'yes'}"
    seconds = ", ".join(f"{one:.0f}" for one in outcome.seconds)
    cells = [about, alone, argument, seconds, str(outcome.mib or ""), _first(outcome.control)]
    return f"| {' | '.join(cells)} |"


def _first(text: str) -> str:
    """The first sentence, or uv's, which says what; the others say what to do."""
    says = text.partition("(cause: ")[2].partition(" and it is required")[0] or text
    return says.partition(". ")[0].replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")


def sums(outcomes: Mapping[str, Outcome]) -> str:
    """How many of each kind came how far."""
    lines = []
    for kind, plural in (("package", "packages"), ("repository", "repositories")):
        chosen = [one for one in outcomes.values() if one.kind == kind]
        ordinary = sum(one.runs or one.control == "runs" for one in chosen)
        alone = sum(not one.alone for one in chosen)
        helped = sum(bool(one.alone) and one.runs for one in chosen)
        equal = sum(one.control == EQUAL for one in chosen)
        lines.append(
            f"Of {len(chosen)} {plural}, {ordinary} run with a sandbox or without; {alone} run by "
            f"reference alone, {helped} more with one argument, {equal} of these bit for bit as "
            "without a sandbox."
        )
    return "\n".join(lines)


def tables(outcomes: Mapping[str, Outcome]) -> str:
    """All of it."""
    parts = [sums(outcomes)]
    for kind, head in HEAD.items():
        rows = [row(name, one) for name, one in outcomes.items() if one.kind == kind]
        if rows:
            parts.append("\n".join([head, *rows]))
    return "\n\n".join(parts) + "\n"


def write(outcomes: Mapping[str, Outcome]) -> None:
    """Put it into its place in the document."""
    text = DOCUMENT.read_text()
    before, _, rest = text.partition(BEGIN)
    DOCUMENT.write_text(
        before + BEGIN + "\n" + tables(outcomes) + "\n" + END + rest.partition(END)[2]
    )
