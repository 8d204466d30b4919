"""A server that a program starts for one client, and that ends with that program."""

import contextlib
import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import RemoteSandbox, make_env
from envhub_sandbox.errors import SandboxUnavailableError
from envhub_sandbox.extras.docker import attestation
from envhub_sandbox.extras.remote.tcp import new_keys
from envhub_worker.protocol.keys import key_text
from tests.remote.listening import WORKER, worker
from tests.support.ports import lasting_port
from tests.support.samples import sample


@contextlib.contextmanager
def announcing(public: str, state: Path) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    words = ("--bind", f"tcp://127.0.0.1:{lasting_port()}", "--state-dir", str(state))
    process = subprocess.Popen(
        [*WORKER, "listen", *words, "--only-client", public, "--announce", "--until-eof"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    with process:
        try:
            yield process, {**json.loads(process.stdout.readline()), "endpoint": words[1]}
        finally:
            process.terminate()


def test_the_one_client_comes_in_and_no_other(tmp_path: Path) -> None:
    """By its key alone; the server has no secret of the client's, and prints none of its own. It
    ends with its stdin, as when the program that started it is killed."""
    public, secret = map(key_text, new_keys())
    with announcing(public, tmp_path / "state") as (process, said):
        assert attestation.parse(json.dumps(said).encode()).profiles
        for key, comes_in in ((secret, True), (key_text(new_keys()[1]), False)):
            place = RemoteSandbox(said["endpoint"], server_key=said["server_key"], client_key=key)
            refused = pytest.raises(SandboxUnavailableError, match="does not know our key")
            expected = contextlib.nullcontext() if comes_in else refused
            with expected, make_env(sample("counter"), sandbox=place) as suites:
                suites.env.reset(seed=0)
        assert process.poll() is None
        process.stdin.close()
        assert process.wait(60) == 0
    assert not list((tmp_path / "state").glob("client*"))


def test_the_files_of_two_clients_are_apart(tmp_path: Path) -> None:
    """Of two servers with the same state folder: who knows a hash has not brought that file."""
    state = tmp_path / "state"
    brought = set()
    for _ in range(2):
        public, secret = map(key_text, new_keys())
        with announcing(public, state) as (_, said):
            given = {"server_key": said["server_key"], "client_key": secret}
            sandbox = RemoteSandbox(said["endpoint"], **given)
            with make_env(sample("counter"), sandbox=sandbox) as suites:
                suites.env.reset(seed=0)
        brought.add(public[:32])
        assert {path.name for path in (state / "store").iterdir() if path.is_dir()} == brought


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--only-client", "nonsense"), "hexadecimal"),
        (("--only-client", "00" * 32, "--authorized-clients", "file"), "leave one out"),
        (("--only-client", "00" * 32, "--insecure-loopback"), "has no keys"),
        (("--authorized-clients", "/nope"), "there is no file /nope. It has a client on each line"),
    ],
)
def test_contradictions_are_refused(tmp_path: Path, words: tuple[str, ...], text: str) -> None:
    done = worker(
        "listen", "--bind", "tcp://127.0.0.1:*", "--state-dir", tmp_path / "state", *words
    )
    assert done.returncode == 2
    assert text in done.stderr
