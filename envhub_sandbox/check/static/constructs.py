"""What in Python's source is worth a look: modules, calls and texts, each with its line.

This finds what is written plainly, by people who hide nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from envhub_sandbox.check.findings import Finding
from envhub_sandbox.hub.sources.parsing import ParsedFile

_NETWORK, _PROCESS, _DYNAMIC, _PICKLE, _NATIVE, _OUTSIDE, _OBSCURE = (
    f"source-{kind}"
    for kind in ("network", "process", "dynamic", "pickle", "native", "outside", "obscure")
)
_MODULES = {
    **dict.fromkeys(
        ("socket", "ssl", "http", "urllib", "requests", "httpx", "aiohttp", "ftplib", "smtplib"),
        _NETWORK,
    ),
    **dict.fromkeys(("urllib3", "websocket", "websockets", "paramiko", "xmlrpc"), _NETWORK),
    **dict.fromkeys(("socketserver", "telnetlib", "poplib", "imaplib"), _NETWORK),
    **dict.fromkeys(("subprocess", "pty"), _PROCESS),
    **dict.fromkeys(("pickle", "dill", "joblib", "cloudpickle", "marshal", "shelve"), _PICKLE),
    **dict.fromkeys(("ctypes", "cffi"), _NATIVE),
    **dict.fromkeys(("builtins", "runpy", "zipimport", "imp", "code", "codeop"), _DYNAMIC),
}
_CALLS = dict.fromkeys(("eval", "exec", "compile", "__import__"), _DYNAMIC)
"""Only where they are called: the first is a common name for an argument."""
_PROGRAMS = (
    *("system", "popen", "fork", "forkpty", "posix_spawn", "posix_spawnp", "execl", "execle"),
    *("execlp", "execlpe", "execv", "execve", "execvp", "execvpe", "spawnl", "spawnle", "spawnlp"),
    *("spawnlpe", "spawnv", "spawnve", "spawnvp", "spawnvpe"),
)
_NAMES = {
    **dict.fromkeys((f"os.{name}" for name in _PROGRAMS), _PROCESS),
    "asyncio.create_subprocess_exec": _PROCESS,
    "asyncio.create_subprocess_shell": _PROCESS,
    "asyncio.open_connection": _NETWORK,
    "importlib.import_module": _DYNAMIC,
    "importlib.util.spec_from_file_location": _DYNAMIC,
    "importlib.util.spec_from_loader": _DYNAMIC,
    "importlib.machinery.SourceFileLoader": _DYNAMIC,
    "importlib.machinery.SourcelessFileLoader": _DYNAMIC,
    "importlib.machinery.ExtensionFileLoader": _NATIVE,
    "codecs.register": _DYNAMIC,
    "site.addsitedir": _DYNAMIC,
    "sys.meta_path": _DYNAMIC,
    "sys.path_hooks": _DYNAMIC,
    "types.CodeType": _DYNAMIC,
    "torch.load": _PICKLE,
    "pandas.read_pickle": _PICKLE,
    "os.path.expanduser": _OUTSIDE,
    "pathlib.Path.home": _OUTSIDE,
}
_REFLECTED = ("os", "sys", "builtins", "importlib", "subprocess", "socket", "ctypes")
"""Modules of which getattr may fetch what an author does not want to write down."""
_LONG_LINE = re.compile(r"^[^\n]{2000,}", re.MULTILINE)


def constructs(file: str, parsed: ParsedFile) -> Iterator[Finding]:
    """What a file has of them, each once in a line."""
    found = (*_imported(parsed), *_named(parsed), *_fetched(parsed), *_said(parsed))
    for line, check, message in sorted(set(found)):
        yield Finding(check, message, file=file, line=line)


def long_lines(file: str, text: str) -> Iterator[Finding]:
    """Lines that are too long to be read to their end: what stands there need not be seen."""
    for found in _LONG_LINE.finditer(text):
        line = 1 + text.count("\n", 0, found.start())
        message = f"a line of {len(found[0])} characters"
        yield Finding(_OBSCURE, message, file=file, line=line)


def _imported(parsed: ParsedFile) -> Iterator[tuple[int, str, str]]:
    for one in parsed.imports:
        # below 0: names of modules; 0: names out of one; above: relative
        modules = one.names if one.level < 0 else () if one.level else (one.module,)
        for name in (module.partition(".")[0] for module in modules):
            if check := _MODULES.get(name):
                yield one.line, check, f"imports {name}"


def _named(parsed: ParsedFile) -> Iterator[tuple[int, str, str]]:
    for name, line in parsed.calls:
        if check := _CALLS.get(name):
            yield line, check, f"calls {name}"
    for name, line in parsed.uses:
        if check := _NAMES.get(name):
            yield line, check, f"uses {name}"


def _fetched(parsed: ParsedFile) -> Iterator[tuple[int, str, str]]:
    for module, name, line in parsed.fetches:
        if (module, name) == ("numpy.load", "allow_pickle"):
            yield line, _PICKLE, "calls numpy.load with allow_pickle"
        elif name is None and module in _REFLECTED:
            yield line, _DYNAMIC, f"gets something of {module} by a computed name"
        elif check := _NAMES.get(f"{module}.{name}"):
            yield line, check, f"gets {module}.{name} by its name"


def _said(parsed: ParsedFile) -> Iterator[tuple[int, str, str]]:
    for kind, text, length, line in parsed.texts:
        if kind == "outside":
            yield line, _OUTSIDE, f"names {text!r}"
        else:
            yield line, _OBSCURE, f"a text of {length} characters without a word"
