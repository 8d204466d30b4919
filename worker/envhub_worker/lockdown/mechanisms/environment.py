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

# A jail has no display, sound card or terminal. With these variables libraries look for none.
_HEADLESS = {
    "MPLBACKEND": "Agg",
    "MUJOCO_GL": "egl",
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    "PYOPENGL_PLATFORM": "egl",
    "SDL_AUDIODRIVER": "dummy",
    "SDL_VIDEODRIVER": "dummy",
}

# A jail has no network. These variables stop libraries from retrying for some twenty seconds.
_OFFLINE = {"HF_HUB_OFFLINE": "1", "PIP_RETRIES": "0", "UV_OFFLINE": "1"}


def zygote_environment(
    host: Mapping[str, str], python: str, granted: Mapping[str, str]
) -> dict[str, str]:
    """Returns the zygote's environment. Only language and time zone come from ``host``.
    ``granted``: the result of ``start_variables.at_start``.
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
    """Returns the environment of a jail's runner.
    ``granted``: variables that the caller grants by name; these override others.
    """
    kept = {name: value for name, value in base.items() if name in _KEPT}
    return {
        **kept,
        **_HEADLESS,
        **({} if network == "host" else _OFFLINE),
        "HF_HOME": f"{home}/.cache/huggingface",
        "HOME": home,
        "LOGNAME": "sandbox",
        # Bytecode would fill each jail's scratch. Child processes inherit this variable.
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
