"""The commands of ``envhub-worker``: their options, what they write, and what they refuse."""

import argparse
import stat
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.__main__ import main
from envhub_worker.extras.access.commands import drain, keygen, status
from envhub_worker.protocol.keys import key_text, parse_key


def parsed(program: Any, *words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    program.add_arguments(parser)
    return parser.parse_args(words)


def test_a_key_pair_is_written_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = parsed(keygen, "--out", str(tmp_path), "--name", "mine")
    assert keygen.run(arguments) == 0
    secret, public = tmp_path / "mine.key", tmp_path / "mine.pub"
    assert stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert key_text(parse_key(public.read_text())) in capsys.readouterr().out
    before = secret.read_bytes()
    assert keygen.run(arguments) == 1
    assert "is not replaced" in capsys.readouterr().err
    assert secret.read_bytes() == before
    assert parse_key(secret.read_text()) != parse_key(public.read_text())


def test_an_unwritable_folder_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert keygen.run(parsed(keygen, "--out", str(tmp_path / "file" / "below"))) == 1
    assert "envhub-worker keygen: " in capsys.readouterr().err


def test_without_server_nothing_drains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert drain.run(parsed(drain, "--state-dir", str(tmp_path), "--no-wait")) == 1
    assert capsys.readouterr().err.startswith("envhub-worker drain: ")


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        ("lisen", "did you mean 'listen'?"),
        ("keygn", "did you mean 'keygen'?"),
        ("frobnicate", "invalid choice: 'frobnicate'"),
    ],
)
def test_misspelt_words_are_told(typed: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([typed])
    assert says in capsys.readouterr().err


def test_a_name_is_no_line_of_the_status() -> None:
    jail = {"name": "evil\n0 sessions", "states": ["idle"], "operation": "", "busy_s": 0.0}
    one = {"client": "a", "session": "1", "heard_s": 0.0, "connections": 1, "upload_bytes": 0}
    many = [{**jail, "name": "x" * 512} for _ in range(40)]
    sessions = [{**one, "jails": (jail, *many)}, {**one, "client": "bob", "jails": ()}]
    lines = status.table(sessions).splitlines()
    assert not [line for line in lines if line.startswith("0 sessions")]
    assert [line for line in lines if "bob" in line]
