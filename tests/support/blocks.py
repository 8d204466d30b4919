"""The blocks of code in the documents, and what tests them: none is left out by itself.

Those of a language are tested in one way, but Python and others as ``TABLE`` says of the document.
Whoever adds a block of these to a document that has none adds it there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
DOCUMENTS = tuple(
    path.relative_to(CHECKOUT).as_posix()
    for pattern in ("*.md", "docs/*.md", "benchmarks/*.md", "examples/*.md", "plugins/*/*.md")
    for path in sorted(CHECKOUT.glob(pattern))
)

RUN = "executed"
HELD = "each command, option and script in it is one that there is"
BOUND = "not executed: it parses, and its arguments are those of what it calls"
PARSED = "parsed, and held against what it is about"
SHOWN = "what is printed, or a drawing: its commands are ones that there are"
DRAWN = "the site's build takes it, and the browser draws it"

# Why a block of Python is not executed by tests of these documents.
REASONS = {
    "docs/deployment.md": "needs a container engine and a server: tests/containers, tests/remote",
    "docs/lerobot.md": "needs LeRobot, a GPU and a repository of the Hub: tests/lerobot",
}
# The first two of the README are run by .ci/steps/readme.sh as they stand there, authors.md's by
# tests/integration/test_cli_init.py and test_cli_push.py, those of docker by tests/containers.
_EVERYWHERE = {"sh": HELD, "": SHOWN, "text": SHOWN, "mermaid": DRAWN}
TABLE = {
    ("README.md", "python"): RUN,
    ("docs/authors.md", "python"): RUN,
    ("docs/ci.md", "yaml"): PARSED,
    ("docs/deployment.md", "python"): BOUND,
    ("docs/integrations.md", "python"): RUN,
    ("docs/lerobot.md", "python"): BOUND,
    ("docs/observing.md", "python"): RUN,
    ("docs/quickstart.md", "python"): RUN,
}


@dataclass(frozen=True)
class Block:
    """One block of code."""

    document: str
    language: str
    text: str

    @property
    def way(self) -> str | None:
        """How it is tested."""
        return _EVERYWHERE.get(self.language) or TABLE.get((self.document, self.language))


def blocks() -> Iterator[Block]:
    """Every block of every document."""
    for document in DOCUMENTS:
        text = (CHECKOUT / document).read_text()
        for language, code in re.findall(r"^```(\S*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
            yield Block(document, language, code)


def tested(way: str) -> list[Block]:
    """The blocks that are tested in this way."""
    return [block for block in blocks() if block.way == way]
