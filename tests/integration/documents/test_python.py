"""The Python, the shell and the notebook of the documents run as they are written."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.hub.stub_hub import StubHub
from tests.support.command_line import python
from tests.support.documents import blocks
from tests.support.documents.blocks import Block
from tests.support.documents.notebook import DOCUMENT
from tests.support.documents.shell import execute, executed
from tests.support.samples import EXAMPLES

# No block may take a port that another program has.
_ANY_PORT = """
import prometheus_client
_start = prometheus_client.start_http_server
prometheus_client.start_http_server = lambda port: _start(0, addr="127.0.0.1")
"""
_IMPORTED = "from envhub_sandbox import make_env\n"
_TAKES_A_SIZE = """
import gymnasium as gym

def make_env(n_envs=1, use_async_envs=False, size=4):
    assert size == 8
    return gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * n_envs)
"""


def run(arguments: list[str], folder: Path) -> None:
    here = folder / "here"
    shutil.copytree(EXAMPLES / "cartpole", here, dirs_exist_ok=True)
    shutil.copytree(EXAMPLES / "cartpole", here / "my-env")
    (here / "examples").mkdir()
    shutil.copytree(EXAMPLES / "cartpole", here / "examples" / "cartpole")
    python(*arguments, cwd=here, ENVHUB_CACHE=str(folder / "cache"))


def python_of(document: str) -> list[str]:
    """Its blocks that are executed, without those that are tests for pytest."""
    there = [one for one in blocks.tested(blocks.RUN) if one.document == document]
    texts = [one.text for one in there if one.language == "python"]
    return [text for text in texts if "import pytest" not in text]


DOCUMENTS = (
    *("docs/async.md", "docs/authors.md", "docs/concepts.md"),
    *("docs/observing.md", "docs/quickstart.md"),
)
_RUN = f"""{_ANY_PORT}
import json, sys
for document, text in json.loads(sys.argv[1]).items():
    exec(compile(text, document, "exec"), {{"__name__": "__main__"}})
"""


def test_the_python_of_the_documents_runs(tmp_path: Path) -> None:
    """That of each with names of its own, one after the other in one process."""
    pytest.importorskip("prometheus_client")
    found = {name: python_of(name) for name in DOCUMENTS}
    assert all(found.values())
    texts = {name: _IMPORTED + "\n".join(blocks_of) for name, blocks_of in found.items()}
    run(["-c", _RUN, json.dumps(texts)], tmp_path)


def test_the_test_of_an_author_passes(tmp_path: Path) -> None:
    """The block of docs/authors.md that is one for pytest, as its next block runs it."""
    [text] = [one.text for one in blocks.tested(blocks.RUN) if "import pytest" in one.text]
    repository, test = tmp_path / "repository", tmp_path / "test_it.py"
    repository.mkdir()
    (repository / "env.py").write_text(_TAKES_A_SIZE)
    test.write_text(text)
    arguments = ["-p", "no:cacheprovider", "-c", os.devnull, "--rootdir", str(tmp_path)]
    arguments += ["--confcutdir", str(tmp_path)]  # or it lists all folders above
    run(["-m", "pytest", *arguments, "--envhub-ref", str(repository), str(test)], tmp_path)


_EXECUTE = "import json; from tests.support.documents.notebook import executed; "
_EXECUTE += "print(json.dumps(executed()))"


def shown(notebook: dict[str, Any]) -> list[list[str]]:
    """For each cell of code the kinds of what it displays."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [
        [kind for one in cell["outputs"] for kind in one.get("data", {"stdout": ""})]
        for cell in cells
    ]


def rewards(notebook: dict[str, Any]) -> list[str]:
    """The lines that it prints of them."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    lines = [line for cell in cells for one in cell["outputs"] for line in one.get("text", ())]
    return [line for line in lines if line.startswith("rewards of 20 steps: [")]


def test_the_notebook_shows_what_it_shows(checkout: Path, tmp_path: Path) -> None:
    """Tables of suites and environment, and a picture; the rewards are the same ones."""
    pytest.importorskip("PIL")
    done = python(
        "-c", _EXECUTE, cwd=checkout, ENVHUB_CACHE=str(tmp_path), IPYTHONDIR=str(tmp_path)
    )
    now, then = json.loads(done.stdout.splitlines()[-1]), json.loads(DOCUMENT.read_text())
    assert shown(now) == shown(then)
    assert {"text/html", "image/png", "stdout"} <= {one for kinds in shown(now) for one in kinds}
    assert rewards(now) == rewards(then) != []


# What is about a repository is run within one.
_WITHIN = {"docs/ci.md": "my-env"}
# What is in no plain installation.
_NEEDS = {"--video": "imageio_ffmpeg", "--metrics": "prometheus_client"}


@pytest.mark.parametrize("document", [one for one in blocks.DOCUMENTS if executed(one)])
def test_the_shell_of_a_document_runs(document: str, stub_hub: StubHub, tmp_path: Path) -> None:
    """All of its blocks, one after the other; each command ends well."""
    for option, needed in _NEEDS.items():
        if any(option in one.text for one in executed(document)):
            pytest.importorskip(needed)
    execute(executed(document), stub_hub, tmp_path, _WITHIN.get(document, ""))


@pytest.mark.parametrize(
    "wrong", ["false && true", "envhub-worker listen --frobnicate", "docker rm --force it"]
)
def test_a_block_that_fails_is_found(wrong: str, stub_hub: StubHub, tmp_path: Path) -> None:
    with pytest.raises(AssertionError):
        execute([Block("README.md", "sh", f"{wrong}\ntrue\n")], stub_hub, tmp_path)
