"""Finds an interpreter for each peer: this one, or a virtual environment of the peer's own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from benchmarks.peers import Peer

PEER_VENVS = Path(__file__).parent / ".venvs"
_PROBE = (
    "import importlib.util, json, sys;"
    "print(json.dumps([n for n in sys.argv[1:] if importlib.util.find_spec(n) is None]))"
)


class Interpreters:
    """Looks in this interpreter first, then in ``folder/<peer>``.

    Args:
        folder: Of virtual environments named after peers.
    """

    def __init__(self, folder: Path = PEER_VENVS) -> None:
        self._folder = folder
        self._found: dict[str, str] = {}

    def of(self, peer: Peer) -> str:
        """An interpreter that has what it needs, or this one, which will say what is missing."""
        if peer.name not in self._found:
            own = self._folder / peer.module / "bin" / "python"
            choices = [sys.executable, *([str(own)] if own.exists() else [])]
            fitting = [python for python in choices if not _lacks(python, peer)]
            self._found[peer.name] = fitting[0] if fitting else sys.executable
        return self._found[peer.name]


def _lacks(python: str, peer: Peer) -> list[str]:
    # -I: the folder that we are in must not stand in for a package
    result = subprocess.run(
        [python, "-I", "-c", _PROBE, *peer.needs], capture_output=True, text=True, check=False
    )
    missing: list[str] = json.loads(result.stdout) if result.returncode == 0 else ["python"]
    return missing
