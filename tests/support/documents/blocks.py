"""The blocks of code in the documents, and what executes them.
Shell and Python are executed with the others of their document, but for what ``APART`` and
``NOT_EXECUTED`` name by its beginning."""

import re
from collections.abc import Collection, Iterator
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
OTHER = "neither shell nor Python"

# What executes blocks of shell and Python that the tests in tests/integration/documents do not: by
# document and beginning.
_CONTAINERS, _LEROBOT = "tests/containers/test_documents.py", "tests/lerobot/test_pages.py"
_RAY = "tests/remote/ray/test_documents.py"
APART = {
    ("README.md", "python3 -m venv .venv"): ".ci/steps/readme.sh",
    ("README.md", "./test"): ".ci/steps/readme.sh",
    ("README.md", "docker build"): _CONTAINERS,
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
# Others are not executed as they stand there: they install, need servers, or take hours.
NOT_EXECUTED = {
    ("CONTRIBUTING.md", "python3 -m venv .venv"),
    ("CONTRIBUTING.md", ".venv/bin/ruff"),
    ("docs/internals/tests.md", ".venv/bin/python -m"),
    ("benchmarks/README.md", "python -m"),
    ("docs/deployment.md", "envhub image build"),
    ("docs/lerobot.md", "pip install"),
    ("docs/ray.md", "pip install"),
    ("docs/benchmarks.md", "python -m benchmarks"),
    ("docs/scaling.md", "envhub run org"),
}


@dataclass(frozen=True)
class Block:
    """One block of code."""

    document: str
    language: str
    text: str

    @property
    def way(self) -> str:
        if self.language not in ("sh", "python"):
            return OTHER
        if self.named_in(APART):
            return OWN
        return HELD if self.named_in(NOT_EXECUTED) else RUN

    @property
    def apart(self) -> str:
        """The file that executes it."""
        return APART[self.named_in(APART)[0]]

    def named_in(self, table: Collection[tuple[str, str]]) -> list[tuple[str, str]]:
        """The document and the beginning by which a table names it."""
        return [
            (document, beginning)
            for document, beginning in table
            if document == self.document and self.text.startswith(beginning)
        ]


def blocks() -> Iterator[Block]:
    for document in DOCUMENTS:
        text = (CHECKOUT / document).read_text()
        for language, code in re.findall(r"^```(\S*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
            yield Block(document, language, code)


def tested(way: str) -> list[Block]:
    return [block for block in blocks() if block.way == way]
