"""``envhub version``."""

from __future__ import annotations

import platform

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import out, print_json

_PACKAGES = ("gymnasium", "numpy", "huggingface_hub", "pyzmq", "msgpack", "imageio-ffmpeg")


@opt.with_options()
def version(
    json: opt.Json = False,
) -> None:
    """Print versions: ours, the protocol's, Python's and of the packages that matter."""
    found = versions()
    if json:
        print_json(found)
    else:
        for name, text in found.items():
            out(f"{name:<16} {text or 'not installed'}")


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
