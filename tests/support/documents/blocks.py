"""The blocks of code in the documents, and what executes them: none is left out by itself.

Shell and Python are executed, but for what ``APART`` and ``NOT_EXECUTED`` name by its beginning;
other languages as ``TABLE`` says of the document. Whoever adds a block that cannot be executed says
here why, or what executes it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[3]
DOCUMENTS = tuple(
    path.relative_to(CHECKOUT).as_posix()
    for pattern in (
        *("*.md", "docs/*.md", "docs/internals/tests.md", "benchmarks/*.md"),
        *("examples/*.md", "plugins/*/*.md"),
    )
    for path in sorted(CHECKOUT.glob(pattern))
)

RUN = "executed with the others of its document"
OWN = "executed by a test of its own"
HELD = "not executed: each command, option and script in it is one that there is"
PARSED = "parsed, and held against what it is about"
SHOWN = "what is printed, or a drawing: its commands are ones that there are"
DRAWN = "the site's build takes it, and the browser draws it"

# What executes blocks of shell and Python that the tests in tests/integration/documents do not: by
# document and beginning.
_CONTAINERS, _LEROBOT = "tests/containers/test_documents.py", "tests/lerobot/test_pages.py"
_RAY = "tests/remote/ray/test_documents.py"
APART = {
    ("README.md", "python3 -m venv .venv"): ".ci/steps/readme.sh",
    ("README.md", "./test"): ".ci/steps/readme.sh",
    ("docs/deployment.md", "docker build"): _CONTAINERS,
    ("docs/deployment.md", "from envhub_sandbox import DockerSandbox"): _CONTAINERS,
    ("docs/deployment.md", 'make_env("org/repo@<commit>", sandbox="docker")'): _CONTAINERS,
    ("docs/deployment.md", "docker run"): "tests/containers/test_deployment.py",
    ("docs/lerobot.md", "lerobot-"): _LEROBOT,
    ("docs/lerobot.md", "from lerobot"): _LEROBOT,
    ("docs/scaling.md", "sbatch"): "tests/integration/fleet/test_slurm.py",
    ("docs/ray.md", "import ray"): _RAY,
    ("docs/ray.md", "envhub run"): _RAY,
    ("plugins/lerobot_env_envhub_sandbox/README.md", "lerobot-"): _LEROBOT,
}
# Why others are not executed as they stand there.
_INSTALLS = "installs gigabytes, or into the reader's own interpreter"
_LONG = "is for minutes to hours; its arguments are taken by its own parser"
_DERIVED = (
    "needs an engine, Debian's mirror and minutes; tests/containers/test_image.py derives others"
)
NOT_EXECUTED = {
    ("CONTRIBUTING.md", "python3 -m venv .venv"): _INSTALLS,
    ("CONTRIBUTING.md", ".venv/bin/ruff"): "is what CI does: .ci/steps/lint.sh, .ci/steps/tests.sh",
    ("docs/internals/tests.md", ".venv/bin/python -m"): _LONG,
    ("benchmarks/README.md", "python -m"): _LONG,
    ("docs/deployment.md", "envhub image build"): _DERIVED,
    ("docs/lerobot.md", "pip install"): _INSTALLS,
    ("docs/ray.md", "pip install"): _INSTALLS,
    ("docs/benchmarks.md", "python -m benchmarks"): _LONG,
    (
        "docs/scaling.md",
        "envhub run org",
    ): "needs servers; tests/integration/fleet runs lists of them",
}
_EVERYWHERE = {"sh": RUN, "": SHOWN, "text": SHOWN, "mermaid": DRAWN}
TABLE = {
    ("docs/ci.md", "yaml"): PARSED,
    **{
        (document, "python"): RUN
        for document in (
            *("README.md", "docs/async.md", "docs/authors.md", "docs/concepts.md"),
            *("docs/deployment.md", "docs/integrations.md", "docs/observing.md"),
            *("docs/quickstart.md", "docs/scaling.md"),
        )
    },
}


@dataclass(frozen=True)
class Block:
    """One block of code."""

    document: str
    language: str
    text: str

    @property
    def way(self) -> str | None:
        if self.listed(APART):
            return OWN
        if self.listed(NOT_EXECUTED):
            return HELD
        return _EVERYWHERE.get(self.language) or TABLE.get((self.document, self.language))

    def listed(self, table: Mapping[tuple[str, str], str]) -> str | None:
        for (document, beginning), said in table.items():
            if document == self.document and self.text.startswith(beginning):
                return said
        return None


def blocks() -> Iterator[Block]:
    for document in DOCUMENTS:
        text = (CHECKOUT / document).read_text()
        for language, code in re.findall(r"^```(\S*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
            yield Block(document, language, code)


def tested(way: str) -> list[Block]:
    """The blocks that are tested in this way."""
    return [block for block in blocks() if block.way == way]
