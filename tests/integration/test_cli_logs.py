"""``envhub run --worker-output`` and ``--verbose``."""

from __future__ import annotations

from pathlib import Path

from tests.integration.test_cli_run import document, envhub
from tests.support.samples import EXAMPLES, sample

_DIES = ("--env-kwargs", "moment=step", "--env-kwargs", "fault=exit")


def test_worker_output_goes_where_it_is_wanted(tmp_path: Path) -> None:
    """To a file, or to stderr, which has nothing of it otherwise but the end."""
    path = tmp_path / "worker.log"
    done = envhub("run", sample("faulty"), *_DIES, "--worker-output", path)
    assert done.returncode == 5
    assert path.read_text() == "about to exit\n"
    done = envhub("run", sample("noisy"), "--worker-output", "-", "--steps", "1")
    assert "\x1b" not in done.stderr
    assert "\\x1b" in done.stderr


def test_verbose_tells_of_jails() -> None:
    """And stdout has only the results."""
    done = envhub("run", EXAMPLES / "cartpole", "--episodes", "1", "--verbose")
    assert done.returncode == 0
    assert "opened" in done.stderr
    assert "closes" in done.stderr
    assert "opened" not in done.stdout


def test_json_names_the_bundle() -> None:
    """For whoever goes on from there by program."""
    found = document("run", sample("faulty"), *_DIES, code=5)
    assert (Path(found["error"]["bundle"]) / "bundle.json").exists()
    found = document("run", sample("faulty"), "--env-kwargs", "moment=step", *_RAISES, code=1)
    assert found["error"]["bundle"] is None


_RAISES = ("--env-kwargs", "fault=raise")
