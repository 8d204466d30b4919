"""The command line of the worker: sizes with units, and commands that are misspelt."""

from __future__ import annotations

import argparse

import pytest

from envhub_worker.__main__ import main
from envhub_worker.access.quotas import Quotas
from envhub_worker.cli import listen_options


def parsed(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    listen_options.add_options(parser)
    return parser.parse_args(arguments)


@pytest.mark.parametrize(
    ("text", "size"),
    [("16G", 16 << 30), ("16 GiB", 16 << 30), ("1.5T", 3 << 39), ("512m", 512 << 20), ("16", None)],
)
def test_sizes_have_units(text: str, size: int | None) -> None:
    told = parsed("--max-memory", text, "--max-upload", text)
    assert told.max_memory == (size or 16 << 30)
    assert told.max_upload == (size or 16 << 20)


@pytest.mark.parametrize("text", ["16X", "much", "0", "-1G", ""])
def test_what_is_no_size_is_told_with_the_units(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        parsed(f"--max-memory={text}")
    said = capsys.readouterr().err
    assert "--max-memory" in said
    assert "size" in said


def test_sizes_are_those_of_the_quotas() -> None:
    told, quotas = parsed(), Quotas()
    assert (told.max_memory, told.max_upload) == (quotas.memory_bytes, quotas.upload_bytes)
    assert (told.max_packages, told.max_inflight) == (quotas.packages_bytes, quotas.inflight_bytes)


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        ("lisen", "did you mean 'listen'?"),
        ("keygn", "did you mean 'keygen'?"),
        ("frobnicate", "invalid choice: 'frobnicate'"),
    ],
)
def test_a_command_that_is_misspelt_is_told(
    typed: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([typed])
    assert says in capsys.readouterr().err
