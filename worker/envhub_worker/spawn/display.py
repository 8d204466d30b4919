"""A display of a runner's own: Xvfb, inside the jail and as confined as what draws on it.

It listens on a socket file in the jail's own ``/tmp`` and nowhere else: neither TCP nor an abstract
socket, so that no other jail and no program of the host finds it, and no display of the host is
there in the jail.
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


def check_display(spec: JailSpec, environment: Mapping[str, str]) -> None:
    """Look for the program that a display needs, before anything is given up.

    Raises:
        LayerUnavailableError: The policy asks for a display, and it is not there.
    """
    wanted = spec.confinement.display == "virtual"
    if wanted and shutil.which(_PROGRAM, path=environment.get("PATH")) is None:
        raise LayerUnavailableError(
            "display",
            f"a virtual display needs {_PROGRAM}, which is not installed where the jail runs",
            "Install it there (on Debian and Ubuntu: apt-get install xvfb), or leave the display "
            "out and render to arrays.",
        )


def start_display(spec: JailSpec) -> None:
    """Start the display of this process, where it is to have one, and name it in its environment.

    Call it once confined: what is started then is as confined. It ends with this process's session.

    Raises:
        SystemExit: It did not come up; the text says so.
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
    """What Xvfb says in time: the number of its display, and the end of the line apart."""
    said = b""
    while b"\n" not in said and select.select([ready], [], [], _START_S)[0]:
        piece = os.read(ready, 16)
        if not piece:
            return b""
        said += piece
    return said.strip()
