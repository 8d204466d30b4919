"""What the code wanted to reach when it failed, and which option brings that.

A sentence is added to the errors of downloads, sockets and windows: a jail has no network and no
display, and what libraries say then ("check your Internet connection") is of no help. Which
sentence, is read off the text. Trust: text from the worker, which chooses among ours and no more.
"""

from __future__ import annotations

import re

from envhub_sandbox.errors import EnvHubError, RemoteEnvError, WorkerDiedError
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import Policy

_HUB = re.compile(
    r"LocalEntryNotFoundError|OfflineModeIsEnabled|HF_HUB_OFFLINE|huggingface\.co|"
    r"[Oo]utgoing traffic has been disabled"
)
_INSTALL = re.compile(r"\b(pip|pip3|uv|conda)\b[^\n]{0,80}\b(install|add|sync)\b")
_NO_FAMILY = re.compile(r"\[Errno 97\]|[Aa]ddress family not supported")
_DOWNLOAD = re.compile(
    r"\bgit\b[^\n]{0,80}\b(clone|fetch|pull|submodule|lfs)\b|\b(wget|curl|aria2c)\b|"
    r"URLError|gaierror|ConnectionError|ConnectError|NewConnectionError|Max retries exceeded|"
    r"[Nn]ame resolution|Name or service not known|Could not resolve host|Network is unreachable"
)
_DISPLAY = re.compile(
    r"NoSuchDisplayException|no display name and no \$DISPLAY|DISPLAY environment variable|"
    r"(connect|open|find)[^\n]{0,20} (X server|[Xx]?[ -]?display)|Qt platform plugin|"
    r"No available video device|Failed to (initialize GLFW|create window)",
)
_TEXT_CHARS = 65_536


def add_reach_advice(error: EnvHubError, policy: Policy) -> None:
    """Add what to do to an error of a download, a socket or a window, once."""
    remote = error if isinstance(error, RemoteEnvError) else error.__cause__
    if "__notes__" in vars(error):
        return
    advice = ""
    if isinstance(remote, RemoteEnvError):
        advice = _advice(f"{remote.type_name}: {remote.message}"[:_TEXT_CHARS], policy)
    elif isinstance(error, WorkerDiedError) and error.signal in ("SIGABRT", "SIGSEGV", None):
        advice = _of_display(error.log_tail[-_TEXT_CHARS:], policy)
    if advice and not str(error).endswith(advice):
        error.args = (f"{error.args[0]}\n{advice}", *error.args[1:])


def _advice(text: str, policy: Policy) -> str:
    if policy.network != "host":
        if _HUB.search(text):
            return (
                "A jail has no network, and of the Hub it has its own repository and its assets "
                f"only: name this one with {option_name('assets', ['org/repo@COMMIT'])}"
            )
        if _INSTALL.search(text):
            return (
                "A jail has no network and cannot install packages: name the packages in the "
                "repository's requirements.txt, or with "
                f"{option_name('dependencies', {'extra': ['PACKAGE']})}"
            )
        if _NO_FAMILY.search(text) and policy.network == "none":
            return (
                "A jail has no network: for connections between its own processes give it a "
                f"loopback device of its own, with {option_name('network', 'loopback')}"
            )
        if _DOWNLOAD.search(text) or _NO_FAMILY.search(text):
            return (
                "A jail has no network: put what it downloads into the repository, or into one on "
                f"the Hub that {option_name('assets', ['org/repo@COMMIT'])} names"
            )
    return _of_display(text, policy)


def _of_display(text: str, policy: Policy) -> str:
    if not _DISPLAY.search(text) or policy.display != "none":
        return ""
    return (
        "It tried to open a window, and a jail has no display: have it render to arrays "
        "(render_mode='rgb_array'), or give the jail a display of its own, with "
        f"{option_name('display', 'virtual')}"
    )
