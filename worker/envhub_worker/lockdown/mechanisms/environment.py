"""The environment variables of the zygote and of a jail: built, never inherited."""

from __future__ import annotations

import os
from collections.abc import Mapping

from envhub_worker.protocol.start_variables import HASH_SEED

_PATH = "/usr/local/bin:/usr/bin:/bin:/usr/local/sbin:/usr/sbin:/sbin"
_INHERITED = ("LANG", "LC_ALL", "LC_CTYPE", "TZ")
_KEPT = ("PATH", HASH_SEED, *_INHERITED)
"""Variables that a jail, and an interpreter started in it, keeps of its zygote's."""

THREAD_TIMEOUT = "20"
"""For OpenBLAS, which reads it once: in cycles, a power of two. By default a runner's threads would
spin for a tenth of a second after their start and after each use, on the cores of its siblings and
of the client, and its page faults would wait for them."""

# A jail has no display, sound card or terminal; without these, libraries look for them.
_HEADLESS = {
    "MPLBACKEND": "Agg",
    "MUJOCO_GL": "egl",
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    "PYOPENGL_PLATFORM": "egl",
    "SDL_AUDIODRIVER": "dummy",
    "SDL_VIDEODRIVER": "dummy",
}

# A jail has no network: without these, such programs try again for some twenty seconds.
_OFFLINE = {"HF_HUB_OFFLINE": "1", "PIP_RETRIES": "0", "UV_OFFLINE": "1"}


def zygote_environment(
    host: Mapping[str, str], python: str, granted: Mapping[str, str]
) -> dict[str, str]:
    """What the zygote is executed with. ``host`` gives language and time zone, nothing else.
    ``granted``: what ``start_variables.at_start`` gives.
    """
    return {
        **{name: host[name] for name in _INHERITED if name in host},
        "PATH": f"{os.path.dirname(python)}:{_PATH}",
        "HOME": "/nonexistent",
        "OPENBLAS_THREAD_TIMEOUT": THREAD_TIMEOUT,
        **granted,
        # A thread in the zygote would make unshare(CLONE_NEWUSER) fail, and die in the fork.
        "OPENBLAS_NUM_THREADS": "1",
    }


def jail_environment(
    base: Mapping[str, str],
    granted: Mapping[str, str],
    home: str,
    temporary: str,
    network: str = "none",
) -> dict[str, str]:
    """What a runner of a jail sees.
    ``granted``: variables that the caller grants by name; they win.
    """
    kept = {name: value for name, value in base.items() if name in _KEPT}
    return {
        **kept,
        **_HEADLESS,
        **({} if network == "host" else _OFFLINE),
        "HF_HOME": f"{home}/.cache/huggingface",
        "HOME": home,
        "LOGNAME": "sandbox",
        # bytecode would be written to each jail's scratch; child processes inherit this
        "PYTHONDONTWRITEBYTECODE": "1",
        "TMPDIR": temporary,
        "USER": "sandbox",
        "XDG_CACHE_HOME": f"{home}/.cache",
        "XDG_CONFIG_HOME": f"{home}/.config",
        "XDG_DATA_HOME": f"{home}/.local/share",
        "XDG_RUNTIME_DIR": f"{temporary}/runtime",
        "XDG_STATE_HOME": f"{home}/.local/state",
        **granted,
    }
