"""Wheels that were built here, by what they were built of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from envhub_sandbox.dependencies.builds import wheel_store
from envhub_sandbox.dependencies.builds.sources import Source
from envhub_sandbox.dependencies.interpreters import Interpreter

SOURCE = Source("toy", "1.0", "https://user:secret@index/toy-1.0.tar.gz", "a" * 64, where="line 3")
PYTHON = Interpreter("/usr/bin/python3", "cpython", "3.11.2", "x86_64", "2.36")
NAME = "toy-1.0-py3-none-any.whl"


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    """One that was built."""
    built = tmp_path / NAME
    built.write_bytes(b"a wheel")
    return built


def test_what_is_kept_is_found_again(wheel: Path) -> None:
    """For the same source and interpreter, with what it was built of; no login is kept."""
    assert wheel_store.recall(SOURCE, PYTHON) is None
    kept = wheel_store.keep(wheel, SOURCE, "e" * 64, PYTHON)
    assert kept == wheel_store.recall(SOURCE, PYTHON)
    assert kept.read_bytes() == b"a wheel"
    origin = wheel_store.describe(kept)
    assert origin is not None
    assert origin.source == replace(SOURCE, url="https://index/toy-1.0.tar.gz", where="")
    assert "secret" not in (kept.parent / "built.json").read_text()
    assert wheel_store.recall(replace(SOURCE, sha256="b" * 64), PYTHON) is None
    assert wheel_store.recall(SOURCE, replace(PYTHON, version="3.12.0")) is None


def test_a_changed_wheel_is_none_and_is_replaced(wheel: Path) -> None:
    """Its hash stands beside it; a record that cannot be read is none either."""
    kept = wheel_store.keep(wheel, SOURCE, "e" * 64, PYTHON)
    kept.chmod(0o644)
    kept.write_bytes(b"another")
    assert wheel_store.recall(SOURCE, PYTHON) is None
    again = wheel_store.keep(wheel, SOURCE, "e" * 64, PYTHON)
    assert again.read_bytes() == b"a wheel"
    (again.parent / "built.json").write_text("{}")
    assert wheel_store.recall(SOURCE, PYTHON) is None
    assert wheel_store.describe(again) is None


def test_a_store_that_others_may_write_is_not_read(wheel: Path) -> None:
    """What lies there would be installed."""
    wheel_store.keep(wheel, SOURCE, "e" * 64, PYTHON)
    wheel_store.root().chmod(0o777)
    assert wheel_store.recall(SOURCE, PYTHON) is None
    wheel_store.root().chmod(0o700)
    assert wheel_store.recall(SOURCE, PYTHON) is not None
