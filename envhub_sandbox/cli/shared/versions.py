"""Versions of everything that matters: of ``envhub --version``, of reports and of kept results."""

from __future__ import annotations

import platform

_PACKAGES = ("gymnasium", "numpy", "huggingface_hub", "pyzmq", "msgpack", "imageio-ffmpeg")


def versions() -> dict[str, str | int | None]:
    """Ours, and of what we stand on; None for what is not installed."""
    from envhub_sandbox import __version__
    from envhub_worker.protocol.messages import VERSION

    own: dict[str, str | int | None] = {"envhub-sandbox": __version__, "protocol": VERSION}
    own |= {"python": platform.python_version(), "platform": platform.platform()}
    return own | {name: _installed(name) for name in _PACKAGES}


def _installed(name: str) -> str | None:
    from importlib import metadata  # brings the standard library's e-mail

    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
