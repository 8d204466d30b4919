"""Has a jail build a wheel: ``python -I -m envhub_sandbox.extras.wheel_builder OWNER``.

``extras.packages.builds`` starts it, since packages know no sandboxes. It reads its order from
stdin and prints the result, both as JSON: ``wheel``, the name of the file in ``wheel/``;
``requires``, further requirements of the backend; ``failed``, the build's output; or
``unconfined``, why there is no jail. This process ends with the one that started it.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from envhub_sandbox.errors import (
    EnvHubError,
    SandboxUnavailableError,
    WorkerDiedError,
    WorkerTimeoutError,
)
from envhub_sandbox.extras.wheel_builder import entry as build_entry
from envhub_sandbox.factory.env_factory import EnvFactory
from envhub_sandbox.hub.snapshot import local
from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.session.launcher import Launcher
from envhub_sandbox.session.repository import Recipe, Repository
from envhub_sandbox.settings.policy import Limits, Policy, Timeouts
from envhub_sandbox.system.folders import CACHE_VARIABLE, cache_root
from envhub_sandbox.system.platform import end_with
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.runtime import Runtime

_PIECE = 16 * 2**20


def main(ended: int) -> int:
    """Carry out the order on stdin, and print the result; returns the exit code."""
    end_with(ended, 10.0)
    order = json.load(sys.stdin)
    folder = Path(order["folder"])
    os.environ[CACHE_VARIABLE] = str(folder / "cache")  # it goes with the folder
    try:
        reply = _built(folder, order)
    except WorkerTimeoutError:
        reply = {"failed": f"it was not done after {order['wall_s']:.0f} s, and was ended"}
    except WorkerDiedError as error:
        reply = {"failed": f"it was ended: {error}"}
    except SandboxUnavailableError as error:
        reply = {"unconfined": str(error)}
    except EnvHubError as error:
        reply = {"error": str(error), "reason": ""}
    print(json.dumps(reply))
    return 0


def _built(folder: Path, order: Mapping[str, Any]) -> dict[str, Any]:
    tools = folder / "tools"  # the interpreter's path
    spec = importlib.util.find_spec("pyproject_hooks")
    assert spec is not None
    assert spec.origin is not None
    shutil.copytree(Path(spec.origin).parent, tools / "pyproject_hooks")
    repository = _repository(folder, order)
    launcher = Launcher(repository, PROCESS, cache_root() / "snapshots")
    with EnvFactory([launcher], 1, 0, lambda manifest: None).make() as suites:
        env = suites.env
        names = ("packages", "python", "backend", "backend_path", "known", "environment")
        build_order = {name: order[name] for name in (*names, "source")}
        [reply] = env.call("build", {**build_order, "tools": str(tools)})
        if not isinstance(reply, dict):
            return {"failed": f"it answered {type(reply).__name__}"}
        if "wheel" not in reply:
            return {name: reply[name] for name in ("failed", "requires") if name in reply}
        return _received(env, reply, folder / "wheel", int(order["max_bytes"]))


def _received(env: Any, reply: Mapping[str, Any], target: Path, most: int) -> dict[str, Any]:
    """Receive the wheel piece by piece. Trust: input from the worker."""
    name, size = reply["wheel"], reply["size"]
    if type(name) is not str or type(size) is not int or not 0 < size <= most:
        return {"failed": f"the wheel has not 1 to {most} bytes"}
    if "/" in name or not name.endswith(".whl") or not name.isprintable() or len(name) > 200:
        return {"failed": f"the wheel is called {name[:200]!r}"}
    target.mkdir()
    with (target / name).open("xb") as file:
        while (got := file.tell()) < size:
            [piece] = env.call("read", got, min(_PIECE, size - got))
            if type(piece) is not bytes or not 0 < len(piece) <= size - got:
                return {"failed": "the wheel broke off"}
            file.write(piece)
    return {"wheel": name}


def _repository(folder: Path, order: Mapping[str, Any]) -> Repository:
    entry = folder / "repository"
    entry.mkdir()
    shutil.copyfile(build_entry.__file__, entry / "env.py")
    limits = Limits(**order["limits"])
    wall_s = float(order["wall_s"])
    policy = Policy(
        profile=order["profile"],
        readable=tuple(order["readable"]),
        limits=limits,
        crash_history=0,
        lane="frames",
    )
    timeouts = Timeouts(call_s=wall_s, server_idle_s=0)
    runtime = Runtime(*order["runtime"])
    snapshot = local(str(entry))
    return Repository(
        *(snapshot, m.Load(1, False, None, {}), policy, timeouts, runtime, True),
        recipe=Recipe(make_env=_built, reference=snapshot.reference, config=None),
        installed=None,
    )


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
