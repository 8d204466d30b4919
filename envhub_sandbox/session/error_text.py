"""Adds to the text of an error: the repository's own line, advice, and denials.

A worker names files relative to its repository. Here they get the names that the author knows: the
path in the local folder, or the file at that commit, never the copy in the store. The verified
snapshot determines these names, not the worker.

Errors of downloads, sockets and windows get advice: a jail has no network and no display, and the
texts of libraries ("check your Internet connection") do not help there. Trust: the worker's text
only selects one of our sentences.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator
from pathlib import Path

from envhub_sandbox.errors import DependencyError, EnvHubError, RemoteEnvError, WorkerDiedError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.settings.policy import Policy
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.text import printable, quoted

_FRAME = (
    r'(?m)^(?P<margin>[ |+-]*)File "(?P<file>[^"\n]{1,4096})", line (?P<line>[0-9]{1,9})'
    r"(?:, in (?P<function>[^\n]*))?(?:\n(?P<source>[ |]{4}[^\n]*)(?:\n(?P<caret>[ |\t]*\^+))?)?"
)
_TRACEBACK_CHARS = 32_768
_FUNCTION_CHARS, _SOURCE_CHARS = 100, 200


def add_author_line(error: EnvHubError, snapshot: Snapshot) -> None:
    """Add the repository's own line to its error, once. Trust: text from the worker."""
    remote = error if isinstance(error, RemoteEnvError) else error.__cause__
    if not isinstance(remote, RemoteEnvError) or "__notes__" in vars(error):
        return
    frames = [frame for frame in re.finditer(_FRAME, remote.traceback) if _place(frame, snapshot)]
    author_line = ""
    for last in frames[-1:]:
        author_line = _line(last, snapshot)
        remote.file, remote.line = _name(last, snapshot), int(last["line"])
    named = re.sub(_FRAME, lambda frame: _named(frame, snapshot), remote.traceback)
    remote.traceback = printable(named, _TRACEBACK_CHARS)
    remote.where = author_line
    if author_line:
        error.args = (f"{error.args[0]}\n{author_line}", *error.args[1:])
    if remote.traceback:
        note = f"In the environment:\n{quoted(remote.traceback.rstrip())}"
        # before Python 3.11 only some shells and test runners show it
        vars(error)["__notes__"] = [note]


def _place(frame: re.Match[str], snapshot: Snapshot) -> str | None:
    return snapshot.known_as(_name(frame, snapshot))


def _name(frame: re.Match[str], snapshot: Snapshot) -> str:
    """The path of a frame's file in the repository; absolute in the text of another process."""
    return frame["file"].removeprefix(f"{snapshot.root}/")


def _named(frame: re.Match[str], snapshot: Snapshot) -> str:
    path, rest = _place(frame, snapshot), frame[0].partition('"')[2].partition('"')[2]
    return frame[0] if path is None else f"{frame['margin']}File {path}{rest}"


def _line(frame: re.Match[str], snapshot: Snapshot) -> str:
    path = printable(str(_place(frame, snapshot)))
    function = frame["function"]
    inside = f", in {one_line(function, _FUNCTION_CHARS)}" if function else ""
    source = (frame["source"] or "").replace("\t", " ")
    text = source.lstrip(" |")
    shown = one_line(text.rstrip(" |"), _SOURCE_CHARS)
    caret = (frame["caret"] or "")[len(source) - len(text) :].replace("\t", " ")
    aligned = text.startswith(shown) and len(caret) <= _SOURCE_CHARS
    lines = [
        f"  File {path}, line {frame['line']}{inside}",
        *[line for line in (shown, caret if aligned and not frame["function"] else "") if line],
    ]
    return "\n    ".join(lines)


# --- advice on what a jail lacks -----------------------------------------------------------------

_HUB = (
    r"LocalEntryNotFoundError|OfflineModeIsEnabled|HF_HUB_OFFLINE|huggingface\.co|"
    r"[Oo]utgoing traffic has been disabled"
)
_INSTALL = r"\b(pip|pip3|uv|conda)\b[^\n]{0,80}\b(install|add|sync)\b"
_REQUIREMENT = (
    r"(?<![\w.-])[A-Za-z0-9](?:[\w.-]{0,98}[A-Za-z0-9])?(?:\[[\w.,-]{1,99}\])?"
    r"(?:[<>=!~][\w.*,<>=!~]{0,99}[\w*])?(?![\w+:/@])"
)  # unambiguous: with two ways to match, each item would double the time
_COMMAND = (
    r"(?P<quote>[`'\"]?)(?:python3? -m )?\b(?:pip3?|uv(?: pip)?|conda) (?:install|add) "
    rf"(?:(?:-U|-q|--upgrade|--quiet|--user|-y) )*['\"]?(?P<first>{_REQUIREMENT})['\"]?"
    rf"(?P<more>(?: ['\"]?{_REQUIREMENT}['\"]?)*(?P=quote))?"
)
_NO_FAMILY = r"\[Errno 97\]|[Aa]ddress family not supported"
_DOWNLOAD = (
    r"\bgit\b[^\n]{0,80}\b(clone|fetch|pull|submodule|lfs)\b|\b(wget|curl|aria2c)\b|"
    r"URLError|gaierror|ConnectionError|ConnectError|NewConnectionError|Max retries exceeded|"
    r"[Nn]ame resolution|Name or service not known|Could not resolve host|Network is unreachable"
)
_DISPLAY = (
    r"NoSuchDisplayException|no display name and no \$DISPLAY|DISPLAY environment variable|"
    r"(connect|open|find)[^\n]{0,20} (X server|[Xx]?[ -]?display)|Qt platform plugin|"
    r"No available video device|Failed to (initialize GLFW|create window)"
)
_NO_LIBRARY = r"(unable|fail|can ?not|could not|no such|not found|not available)"
_OSMESA = rf"(?i)osmesa[^\n]{{0,80}}{_NO_LIBRARY}|{_NO_LIBRARY}[^\n]{{0,80}}osmesa|glGetError"
_VARIABLE = (
    r"(?i:\b(declare|define|set|missing|need|requires?)\b[^\n]{0,40}\benvironment variable)\W{1,4}"
    r"(?P<variable>[A-Z][A-Z0-9_]{1,60}_(HOME|PATH|DIR|ROOT))\b"
)
"""Of a folder: a stranger's text shall not have us advise to pass on a token."""
_OFFLINE: dict[str, tuple[str, ...]] = {"network": ("none", "loopback")}
_ADVICE: tuple[tuple[str, dict[str, tuple[str, ...]], str], ...] = (
    (
        _HUB,
        _OFFLINE,
        "A jail has no network, and of the Hub it has its own repository and its assets only: "
        "name this one with {assets}",
    ),
    (
        _INSTALL,
        _OFFLINE,
        "A jail has no network and cannot install packages: name the packages in the "
        "repository's requirements.txt, or with {extra}",
    ),
    (
        _NO_FAMILY,
        {"network": ("none",)},
        "A jail has no network: for connections between its own processes give it a loopback "
        "device of its own, with {loopback}",
    ),
    (
        rf"{_DOWNLOAD}|{_NO_FAMILY}",
        _OFFLINE,
        "A jail has no network: put what it downloads into the repository, or into one on the "
        "Hub that {assets} names",
    ),
    (
        r"EOFError: EOF when reading a line",
        {},
        "It asked for input, and a jail has no terminal: its author puts the answer into a file "
        "or a variable that the program reads instead; you set the variable for this process, and "
        "pass it on with {variable}",
    ),
    (
        _OSMESA,
        {},
        "This machine lacks the library that it draws by: install it (on Debian and Ubuntu: "
        "apt-get install libosmesa6 for MUJOCO_GL=osmesa, libegl1 for egl), or have it draw by "
        "EGL: set MUJOCO_GL=egl for this process, and pass it on with {egl}",
    ),
    (
        _DISPLAY,
        {"display": ("none",)},
        "It tried to open a window, and a jail has no display: have it render to arrays "
        "(render_mode='rgb_array'), or give the jail a display of its own, with {display}",
    ),
    (
        _VARIABLE,
        {},
        "A jail has few variables of this process: set this one here, to a folder that the jail "
        "can see, and pass it on with {variable}",
    ),
    (
        r"No such file or directory: ['\"](?=/)[^'\"\n]{0,4096}/packages/",
        {},
        "An installed package lacks this file as it was published: no argument brings it, but "
        "another release may have it",
    ),
    (
        r"No such file or directory: ['\"](?![/~])[^'\"\n]{0,4096}[/.]",
        {},
        "A relative path begins in the repository, which lacks this file: put it there. "
        "For a package, make a folder of your own with the file and an env.py",
    ),
)
"""A pattern in an error's text, the policy's values that explain it, and the advice."""
_TEXT_CHARS = 65_536
_LACKS_ARGUMENTS = (
    r"\bgymnasium/envs/registration\.py\", line \d+, in make\n *env = env_creator\([^\n]*\n"
    r"(?:[ ~^]*\n)?TypeError: [^\n]{1,200} missing \d+ required [a-z -]{1,40}: ([^\n]{1,400})"
)
"""The last frame calls the environment itself; a frame below may be of a package that changed."""


def add_reach_advice(error: EnvHubError, policy: Policy) -> bool:
    """Add advice to an error that has a row in ``_ADVICE``, once; returns whether it has one."""
    remote = error if isinstance(error, RemoteEnvError) else error.__cause__
    if "__notes__" in vars(error):
        return False
    advice = ""
    if isinstance(remote, RemoteEnvError):
        advice = _advice(f"{remote.type_name}: {remote.message}"[:_TEXT_CHARS], policy)
        advice = advice or _lacking_arguments(remote.traceback[-_TEXT_CHARS:])
    elif isinstance(error, WorkerDiedError) and error.signal in ("SIGABRT", "SIGSEGV", None):
        advice = _advice(error.log_tail[-_TEXT_CHARS:], policy, (_DISPLAY,))
    if advice and not str(error).endswith(advice):
        error.args = (f"{error.args[0]}\n{advice}", *error.args[1:])
    return bool(advice)


def _advice(text: str, policy: Policy, patterns: Collection[str] = ()) -> str:
    """The first advice that fits a text; ``patterns``: only consider rows with these patterns."""
    named = re.search(_VARIABLE, text)
    for pattern, granted, sentence in _ADVICE:
        applies = all(getattr(policy, name) in values for name, values in granted.items())
        if applies and pattern in (patterns or (pattern,)) and re.search(pattern, text):
            return sentence.format(
                assets=option_name("assets", ["org/repo@COMMIT"]),
                display=option_name("display", "virtual"),
                egl=option_name("environment", ["MUJOCO_GL"]),
                extra=option_name("dependencies", {"extra": _to_install(text)}),
                loopback=option_name("network", "loopback"),
                variable=option_name("environment", [named["variable"] if named else "NAME"]),
            )
    return ""


def _lacking_arguments(traceback: str) -> str:
    """Advice if ``gymnasium.make`` lacks arguments for an environment; else empty."""
    if (lacks := re.search(_LACKS_ARGUMENTS, traceback)) is None:
        return ""
    values = dict.fromkeys(re.findall(r"'(\w{1,100})'", lacks[1]), "VALUE")
    return (
        "The environment does not start without arguments of its own: its author says which "
        f"values they take; give them with {option_name('env_kwargs', values)}"
    )


def _to_install(text: str) -> list[str]:
    """The packages in an install command that a text quotes."""
    command = re.search(_COMMAND, text.replace("', '", " "))
    if command is None:
        return ["PACKAGE"]
    is_quoted = command["quote"] and command["more"]
    return [command["first"], *(re.findall(_REQUIREMENT, command["more"]) if is_quoted else [])]


# --- files of a local folder that its code does not see ------------------------------------------

_QUOTED = r"'([^'\n]{1,1024})'|\"([^\"\n]{1,1024})\"|([^\s'\"]{0,512}[./][^\s'\"]{1,512})"
_NO_MODULE = r"No module named '([\w.]{1,200})'"
_NOT_FOUND = (
    r"(?i)not found|no such|no file|no module|does not exist|doesn't exist|unable to|error opening|"
    r"(can ?not|can't|could not|couldn't|failed to) (be )?(open|find|found|load|read|locate|access)"
)
_MOST_NAMES, _DEEPEST = 16, 16
_NAMED_CHARS = 4096
"""The characters of a worker's text to search for names, since the search takes time."""


def why_missing(error: EnvHubError, snapshot: Snapshot) -> str:
    """Advice if the code of a local folder lacks a file that the folder has but does not show.

    Trust: the names come from the worker's text, which only selects one of our sentences.
    """
    remote = error if isinstance(error, (RemoteEnvError, DependencyError)) else error.__cause__
    if not isinstance(remote, (RemoteEnvError, DependencyError)) or not snapshot.is_local:
        return ""
    from envhub_sandbox.hub.local import LocalFolder

    text = getattr(remote, "message", "") or str(remote)
    if not re.search(_NOT_FOUND, text):
        return ""
    shown = {record.path for record in snapshot.files}
    for path in _names(text[:_NAMED_CHARS].replace(f"{snapshot.root}/", ""), snapshot.repo_id):
        is_shown = path in shown or any(prefix.startswith(f"{path}/") for prefix in shown)
        if not is_shown and os.path.lexists(os.path.join(snapshot.repo_id, path)):
            return LocalFolder.of(snapshot).advice(path)
    return ""


def _names(text: str, folder: str) -> Iterator[str]:
    """Paths below a folder that a text may refer to, the likeliest first."""
    modules = [match[1].split(".")[0] for match in re.finditer(_NO_MODULE, text)]
    for module in modules[:_MOST_NAMES]:
        yield from (f"{module}.py", module)
        # the code may put a folder of the repository on sys.path
        for path in sorted(Path(folder).glob(f"*/{module}*")):
            if path.name in (module, f"{module}.py"):
                yield path.relative_to(folder).as_posix()
    for match in list(re.finditer(_QUOTED, text))[:_MOST_NAMES]:
        steps = (match[1] or match[2] or match[3]).rstrip(".,:;)").replace("\\", "/").split("/")
        steps = [step for step in steps if step not in ("", ".")]
        if steps and ".." not in steps and "\0" not in match[0]:
            # for an absolute path, or one on another host, try each of its ends
            yield from ("/".join(steps[first:]) for first in range(min(len(steps), _DEEPEST)))


# --- denials -------------------------------------------------------------------------------------

_DENIAL = r"[a-z0-9_]{1,40}( [A-Z0-9_]{1,40}| /.{0,400})?"
_MOST_DENIALS = 128
_NAMED_DENIALS, _SHOWN = 8, 200
"""The most denials in an error's text, and the most characters of each."""


def read_denials(reported: object) -> tuple[str, ...] | None:
    """The denials of a jail that its server has recorded; None if it does not record them.

    Trust: a server on another host may say anything, and a stranger chose the paths.
    """
    if not isinstance(reported, tuple):
        return None
    texts = (text for text in reported[:_MOST_DENIALS] if isinstance(text, str))
    return tuple(text for text in texts if text.isprintable() and re.fullmatch(_DENIAL, text))


def name_denied(error: WorkerDiedError) -> None:
    """Add to the error what was denied to a process before it ended: often the reason."""
    text = ""
    if error.denied:
        more = len(error.denied) - _NAMED_DENIALS
        named = [one_line(denial, _SHOWN) for denial in error.denied[:_NAMED_DENIALS]]
        text = f"Before that it was denied: {', '.join(named)}{f' and {more} more' * (more > 0)}"
    elif error.signal == "SIGSYS":  # nothing records it: the kernel ends the process at once
        text = "A jail ends 32-bit code so, and no policy permits it; or the code sent the signal"
    elif error.denied is None and error.signal not in (None, "SIGKILL"):
        recording = option_name("policy", {"record_denials": True})
        text = f"If something that it was denied is the reason, {recording} names it"
    if text and text not in str(error):  # may be called again if nothing is recorded
        error.args = (f"{error.args[0]}\n{text}", *error.args[1:])
