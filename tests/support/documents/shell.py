"""Executes the blocks of a document as its reader does: in one shell, one after the other.
The reader's home, caches and temporary folder are the test's, and so is the Hub, which has what the
documents name. ``_READ_AS`` is what a reader puts in place of what is written, ``_PRELUDE`` what he
does between the lines; other than that, the shell gets the text."""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

from envhub_sandbox.extras.starter.command import starter
from tests.hub.stub_hub import StubHub
from tests.support.documents.blocks import CHECKOUT, RUN, Block, tested

NEW, APPROVED = "c0ffee" + "0" * 34, "decade" + "0" * 34
_READ_AS = {
    " && ": "\n",  # the first of them that fails ends the shell
    "OWNER/my-env@<commit>": "OWNER/my-env@main",  # what was just uploaded
    "<commit>": NEW,
    "<new>": NEW,
    "<approved>": APPROVED,
    "tcp://10.0.0.5:5555": "tcp://$ADDRESS:5555",
    "--metrics 9090 ...": "--metrics 9090",
    "--metrics 9090": "--metrics $ADDRESS:9090",
    "/etc/envhub-worker/clients": "clients",
    "/var/lib/envhub-worker": "$XDG_STATE_HOME/envhub-worker",
    ' KEY"': ' $(cat "$XDG_STATE_HOME/envhub-worker/server.pub")"',
    '"tcp://$ADDRESS:5555 <what the server printed>"': 'f"tcp://{ADDRESS}:5555 {PRINTED}"',
}
# What Python has from the blocks before it, and from what was printed.
_IMPORTED = """
import os
from pathlib import Path
from envhub_sandbox import make_env
ADDRESS = os.environ["ADDRESS"]
KEY = Path(os.environ["XDG_STATE_HOME"], "envhub-worker", "server.pub")
PRINTED = KEY.read_text() if KEY.exists() else ""
"""
_PRELUDE = r"""
set -euo pipefail
trap 'kill $(jobs -p) 2>/dev/null || true; wait' EXIT

# Two commits are different, which is what diff exits with. A check plays less than by default.
envhub() {
  [ "$1" != check ] || set -- "$@" --steps 20 --resets 1
  command envhub "$@" || [ "$1 $?" = "diff 7" ]
}

# A server goes on beside the rest, on an address that no other test has; one that is not told where
# is another one. Its operator has put the client's key on the list.
envhub-worker() {
  [ "$1" = listen ] || { command envhub-worker "$@"; return; }
  local log=$TMPDIR/listen.$RANDOM
  case "$*" in
    *--authorized-clients*) sed 's/$/ alice/' ~/.config/envhub-sandbox/client.pub >clients ;;
  esac
  case "$*" in
    *--bind*) ;;
    *) set -- "$@" --bind "tcp://$ADDRESS:5556" --state-dir "$XDG_STATE_HOME/another" ;;
  esac
  command envhub-worker "$@" >"$log" 2>&1 &
  until grep -q listening "$log"; do
    kill -0 $! || { cat "$log"; return 1; }
    sleep 0.1
  done
}

# A virtual environment is made; the package is installed already: where from has to be one.
python3() {
  [ "$*" = "-m venv .venv" ] && command python3 "$@" --without-pip
}
pip() {
  [ "$*" = "install ." ] && [ -f pyproject.toml ]
}

# The Hub has OWNER/my-env already.
hf() {
  [ "$1 $2" = "upload OWNER/my-env" ] && [ -f "$3/env.py" ]
}
"""
# An engine that has no containers.
_DOCKER = """#!/bin/sh
case "$*" in
  --version) echo 'Docker version 28' ;;
  "info --format {{json .}}") echo '{"ServerVersion": "28"}' ;;
  ps*"--filter label=dev.envhub."*) ;;
  *) echo "docker $*: nobody does this here" >&2; exit 64 ;;
esac
"""

# The Python of these goes with their shell; that of others is run without a Hub, in one process.
_WITH_PYTHON = {"docs/deployment.md"}


def executed(document: str) -> list[Block]:
    languages = {"sh", "python"} if document in _WITH_PYTHON else {"sh"}
    there = [one for one in tested(RUN) if one.document == document]
    return [one for one in there if one.language in languages]


def execute(
    blocks: Iterable[Block], hub: StubHub, folder: Path, within: str = "", docker: str = _DOCKER
) -> str:
    """Execute blocks of shell and Python; returns what they print."""
    clone = folder / "clone"
    shutil.copytree(CHECKOUT / "examples", clone / "examples")
    shutil.copy(CHECKOUT / "pyproject.toml", clone)
    texts = starter("my-env", 2026)
    new = {path: text.encode() for path, text in texts.items()}
    for path, content in new.items() if within else ():
        (clone / within / path).parent.mkdir(parents=True, exist_ok=True)
        (clone / within / path).write_bytes(content)
    repository = hub.add("org/repo", texts)
    hub.add("OWNER/my-env", texts)
    repository.earlier[APPROVED] = {**new, "env.py": new["env.py"].replace(b"0.05", b"0.1")}
    (clone / within / "references.txt").write_text(f"org/repo@{NEW}\n")
    return _bash(_script(blocks), clone / within, _environment(folder, hub, docker))


def _script(blocks: Iterable[Block]) -> str:
    parts = [_PRELUDE]
    for block in blocks:
        text = block.text
        for written, read in _READ_AS.items():
            text = text.replace(written, read)
        begins = block.text.splitlines()[0].replace("'", "")
        parts.append(f"echo '== {begins}' >&2")
        python = f"python - <<'END'\n{_IMPORTED}{text}END"
        parts.append(python if block.language == "python" else text)
    return "\n".join(parts)


def _environment(folder: Path, hub: StubHub, docker: str) -> dict[str, str]:
    theirs = ("ENVHUB_", "HF_", "HUGGING", "PYTEST_", "XDG_")
    kept = {name: text for name, text in os.environ.items() if not name.startswith(theirs)}
    programs = folder / "bin"
    for name in ("bin", "home", "tmp"):
        (folder / name).mkdir()
    (programs / "docker").write_text(docker)
    (programs / "docker").chmod(0o755)
    path = [str(programs), str(Path(sys.executable).parent), kept["PATH"]]
    numbers = random.SystemRandom()
    return {
        **kept,
        "PATH": os.pathsep.join(path),
        "HOME": str(folder / "home"),
        "TMPDIR": str(folder / "tmp"),
        "ENVHUB_CACHE": str(folder / "cache"),
        "HF_HOME": str(folder / "hf"),
        "HF_ENDPOINT": hub.endpoint,
        "HF_TOKEN": "hf_of_the_author",
        "XDG_STATE_HOME": str(folder / "state"),
        "ADDRESS": ".".join(["127", *(str(numbers.randint(1, 254)) for _ in range(3))]),
    }


def _bash(script: str, folder: Path, environment: dict[str, str]) -> str:
    process = subprocess.Popen(
        ["bash", "-c", script],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        printed, _ = process.communicate(timeout=280)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0, printed
    return printed
