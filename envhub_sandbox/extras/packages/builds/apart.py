"""Fetches and reads a stranger's archives in a separate process, within one deadline:
``python -I -m envhub_sandbox.extras.packages.builds.apart OWNER``.

An archive may cost its reader hours or gigabytes. So the reader is a process that can be ended, and
its memory is limited. It reads its order as JSON from stdin, writes the answer or the error to
stdout, and ends with the process that started it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import DependencyError, EnvHubError, known_reason
from envhub_sandbox.extras.packages.builds import download, trees, wheels
from envhub_sandbox.extras.packages.interpreters import Interpreter
from envhub_sandbox.system.platform import end_with, pidfd, program
from envhub_worker.protocol.text import printable

if sys.platform == "linux":
    import resource

DEADLINE_S = 1800.0
"""For the download of a source and its unpacking together, or for the check of a wheel."""
_MEMORY_BYTES = 4 * 2**30
_SHOWN = 6000


def fetch(url: str, sha256: str, archive: Path, tree: Path, title: str) -> Path:
    """Downloads and unpacks a source distribution into an empty folder; returns its top folder.
    ``archive``: the temporary path of the download. Raises ``DependencyError``.
    """
    order = {"url": url, "sha256": sha256, "archive": str(archive), "tree": str(tree)}
    order, doing = order | {"title": title}, f"fetching and reading {title}"
    return Path(answer_of(__name__, order, DEADLINE_S, doing)["answer"])


def check_wheel(wheel: Path, name: str, version: str, interpreter: Interpreter) -> None:
    """Runs ``wheels.check`` in a separate process."""
    order: dict[str, Any] = {"wheel": str(wheel), "name": name, "version": version}
    order["interpreter"] = vars(interpreter)
    answer_of(__name__, order, DEADLINE_S, f"reading the wheel of {name}")


def answer_of(
    module: str, order: Mapping[str, Any], timeout_s: float, doing: str
) -> dict[str, Any]:
    """Has a program of ours carry out an order; returns its answer. Both are JSON.

    ``doing``: the order in words, for errors. The program ends with this process.
    Raises ``DependencyError``: the answer is an error, or there is none in time.
    """
    with pidfd() as ourselves:
        try:
            done = subprocess.run(
                [*program(module), str(ourselves)],
                input=json.dumps(order).encode(),
                capture_output=True,
                pass_fds=(ourselves,),
                start_new_session=True,
                timeout=timeout_s,
            )
        except subprocess.TimeoutExpired:
            text = f"{doing} took longer than {timeout_s:.0f} s, so it is not used"
            raise DependencyError(text, reason="integrity") from None
    try:
        answer: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        shown = printable(done.stderr.decode("utf-8", "replace")[-_SHOWN:], _SHOWN)
        text = f"{doing}: its process ended ({done.returncode}).\n{shown}"
        raise DependencyError(text) from None
    if "error" in answer:
        raise DependencyError(answer["error"], reason=known_reason(answer["reason"]))
    return answer


def main(owner: int) -> int:
    """Carry out the order on stdin."""
    end_with(owner, 0)
    if sys.platform == "linux":
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    order = json.load(sys.stdin)
    try:
        answer = {"answer": _carried_out(order)}
    except EnvHubError as error:
        answer = {"error": str(error), "reason": getattr(error, "reason", "")}
    print(json.dumps(answer))
    return 0


def _carried_out(order: dict[str, Any]) -> str:
    if "wheel" in order:
        interpreter = Interpreter(**order["interpreter"])
        wheels.check(Path(order["wheel"]), order["name"], order["version"], interpreter)
        return ""
    archive = Path(order["archive"])
    download.download(order["url"], order["sha256"], archive)
    top = trees.unpack_tree(archive, Path(order["tree"]), order["title"])
    archive.unlink()
    return str(top)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
