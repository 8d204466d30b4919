"""``envhub push``: what loads and steps is published as it was checked, and nothing else is."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from envhub_sandbox import make_env
from envhub_sandbox.cli.app import app
from envhub_sandbox.cli.init import starter
from tests.hub.stub_hub import StubHub

pytestmark = pytest.mark.same_for("users")

TOKEN = "hf_of_the_author"


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A folder as ``envhub init`` writes it."""
    folder = tmp_path / "my-env"
    for path, text in starter("my-env", 2026).items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    return folder


class Done(NamedTuple):
    """How the command ended."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def push(
    snapshot_store: Path,
    stub_hub: StubHub,
    mine: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., Done]:
    """Run the command here, to its end, on a folder that lies beside it."""
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.chdir(mine.parent)

    def run(*options: str) -> Done:
        arguments = ["push", mine.name, "org/my-env", "--endpoint", stub_hub.endpoint, *options]
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            app(arguments, prog_name="envhub")
        return Done(int(ended.value.code or 0), *capsys.readouterr())

    return run


Push = Callable[..., Done]


def writes(hub: StubHub) -> list[str]:
    """What was asked of the Hub that changes it."""
    return [request for request in hub.requests if request.startswith("POST")]


def test_what_was_checked_is_published_and_runs(
    push: Push, stub_hub: StubHub, mine: Path, hub_cache: Path
) -> None:
    """Every file, as it is, that git would commit; then by the pin that was printed. A dry run says
    what it would upload."""
    subprocess.run(["git", "init", "--quiet", str(mine)], check=True)
    (mine / "__pycache__").mkdir()
    (mine / "__pycache__/env.pyc").write_text("which git ignores")
    done = push("--dry-run")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == sorted(starter("my-env", 2026))
    assert stub_hub.requests == []
    done = push("--private", "--json")
    assert done.returncode == 0, done.stderr
    [made] = stub_hub.created
    assert made["name"] == "my-env"
    assert made.get("private") or made.get("visibility") == "private"
    repository = stub_hub.repositories["model", "org/my-env"]
    texts = {path: content.decode() for path, content in repository.files.items()}
    assert texts == starter("my-env", 2026)
    told = json.loads(done.stdout)
    assert told["reference"] == f"org/my-env@{repository.commit}"
    assert TOKEN not in done.stdout + done.stderr
    options = {"endpoint": stub_hub.endpoint, "hub_cache_dir": hub_cache}
    with make_env(told["reference"], **options) as suites:
        suites.env.reset(seed=0)


LIES = "return np.array([self.puck, 7], np.float32)"


@pytest.mark.parametrize(
    ("path", "change", "code", "said"),
    [
        ("env.py", ("import numpy as np", "import numpy as np\n1 / 0"), 4, "ZeroDivisionError"),
        ("env.py", ("return np.array([self.puck, self.goal], np.float32)", LIES), 1, "obs"),
        (".env", ("", "HF_TOKEN=x"), 2, "holds what looks like keys or passwords: .env"),
        ("lib/__pycache__/env.cpython-311.pyc", ("", "x"), 2, "is compiled Python"),
        ("lib/.cache/huggingface/x", ("", "x"), 2, "uploads nothing below .cache"),
    ],
)
def test_what_fails_is_not_published(
    push: Push,
    stub_hub: StubHub,
    mine: Path,
    path: str,
    change: tuple[str, str],
    code: int,
    said: str,
) -> None:
    """The Hub is not even asked; the text leads to the author's own line."""
    text = (mine / path).read_text() if (mine / path).exists() else ""
    (mine / path).parent.mkdir(parents=True, exist_ok=True)
    (mine / path).write_text(text.replace(*change))
    done = push()
    assert (done.returncode, done.stdout) == (code, "")
    assert said in done.stderr
    assert code != 4 or f'File "{mine}/env.py", line' in done.stderr
    assert stub_hub.requests == []


def test_files_that_the_repository_has_beside_are_named(push: Push, stub_hub: StubHub) -> None:
    """The pin that is printed has them, and nothing of them was checked."""
    stub_hub.add("org/my-env", {"old.py": "import os", "LICENSE": "MIT"})
    done = push()
    assert done.returncode == 0, done.stderr
    assert "1 more of the repository, which were not checked: old.py" in done.stderr
    beside = json.loads(push("--json").stdout)["not_checked"]
    assert beside == ["old.py"]


def test_a_hub_that_refuses_is_a_message(push: Push, stub_hub: StubHub) -> None:
    """With what to do, and without the token, which a careless server echoes."""
    stub_hub.fail("POST /api/repos", 403, headers={"X-Error-Message": f"no rights for {TOKEN}"})
    done = push()
    assert (done.returncode, done.stdout) == (3, "")
    for text in ("org/my-env", "nothing was published", "takes a token that may write"):
        assert text in done.stderr
    assert TOKEN not in done.stderr
    assert "Traceback" not in done.stderr
    assert len(writes(stub_hub)) == 1


def test_what_has_not_arrived_is_said(push: Push, stub_hub: StubHub) -> None:
    """No reference is printed for a commit that is not what was checked."""
    stub_hub.ignored = {"requirements.txt"}
    done = push()
    assert (done.returncode, done.stdout) == (3, "")
    assert "does not have requirements.txt as the folder has it" in done.stderr
