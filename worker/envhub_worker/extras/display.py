"""A virtual display for the programs of a jail.

It is Xvfb, as confined as the programs that draw on it. It listens only on a socket file in the
jail's own ``/tmp``, neither on TCP nor on an abstract socket, so no other jail and no program of
the host reaches it. The host's displays do not exist in the jail.
"""

from __future__ import annotations

import os
import select
import shutil
import subprocess
from collections.abc import Mapping

from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.spec import JailSpec

_PROGRAM = "Xvfb"
_SCREEN = "1280x1024x24"
_START_S = 60.0
_HEADLESS = ("PYOPENGL_PLATFORM", "SDL_VIDEODRIVER")
"""Variables of ``jail_environment`` that keep libraries from looking for a display."""
_running: list[subprocess.Popen[bytes]] = []


def check(spec: JailSpec, environment: Mapping[str, str]) -> None:
    """Check that Xvfb is installed, before this process gives up any right.
    Raises ``LayerUnavailableError``: the policy asks for a display, and Xvfb is missing.
    """
    is_virtual = spec.confinement.display == "virtual"
    if is_virtual and shutil.which(_PROGRAM, path=environment.get("PATH")) is None:
        raise LayerUnavailableError(
            "display",
            f"a virtual display needs {_PROGRAM}, which is not installed where the jail runs",
            "Install it there (on Debian and Ubuntu: apt-get install xvfb), or leave the display "
            "out and render to arrays.",
        )


def start(spec: JailSpec) -> None:
    """Start this process's display, if the policy has one, and set ``DISPLAY``.

    Call this function in the confined process: the display inherits the confinement. It ends with
    this process's session. Raises ``SystemExit``: the display did not start.
    """
    if spec.confinement.display != "virtual":
        return
    ready, theirs = os.pipe()
    words = [_PROGRAM, "-displayfd", str(theirs), "-screen", "0", _SCREEN]
    words += ["-nolisten", "tcp", "-nolisten", "local", "-noreset"]
    none = subprocess.DEVNULL
    _running.append(
        subprocess.Popen(words, pass_fds=[theirs], stdin=none, stdout=none, stderr=none)
    )
    os.close(theirs)
    number = _line(ready)
    os.close(ready)
    if not number.isdigit():
        raise SystemExit(f"the virtual display ({_PROGRAM}) did not come up in the jail")
    os.environ["DISPLAY"] = f":{number.decode()}"
    for name in _HEADLESS:
        if name not in spec.confinement.environment:
            os.environ.pop(name, None)


def _line(ready: int) -> bytes:
    """Reads the display's number from Xvfb; empty or incomplete if Xvfb ends or is too slow."""
    text = b""
    while b"\n" not in text and select.select([ready], [], [], _START_S)[0]:
        piece = os.read(ready, 16)
        if not piece:
            return b""
        text += piece
    return text.strip()
