"""Classifies a repository's files, and finds suspicious contents in Python source.

The name and the first and last bytes decide whether a file is text, Python, machine code, a pickle
or an archive; no file is opened by its format. Reads are bounded per file and in all. The search in
source finds only what an author writes plainly: the jail protects from the rest.
"""

from __future__ import annotations

import codecs
import re
import sys
import unicodedata
from collections.abc import Iterator, Sequence
from pathlib import Path

from envhub_sandbox.extras.judge.findings import Finding
from envhub_sandbox.extras.sources.parsing import ImportStatement, ParsedFile

BEGINNING = 8192
"""First bytes, which decide the kind of a file."""
ENDING = (1 << 16) + 22
"""Last bytes, in which Python looks for the end of a zip archive; anything may precede it."""
LARGE = 10 << 20
_MACHINE_CODE = (
    *(b"\x7fELF", b"MZ", b"!<arch>\n", b"\0asm", b"\xca\xfe\xba\xbe"),
    *(b"\xfe\xed\xfa\xce", b"\xfe\xed\xfa\xcf", b"\xce\xfa\xed\xfe", b"\xcf\xfa\xed\xfe"),
)
_LFS = tuple(
    b"version " + url
    for url in (
        *(b"https://git-lfs.github.com/spec/", b"https://hawser.github.com/spec/"),
        b"http://git-media.io/v/",
    )
)
_ARCHIVES = (b"PK\x03\x04", b"\x1f\x8b", b"\xfd7zXZ\0", b"BZh", b"\x28\xb5\x2f\xfd", b"7z\xbc\xaf")
_ZIP_END = b"PK\x05\x06"
_SUFFIXES = {
    **dict.fromkeys((".so", ".dylib", ".dll", ".pyd", ".o", ".a"), "machine code"),
    ".py": "Python",
    **dict.fromkeys((".pyc", ".pyo"), "compiled Python"),
    **dict.fromkeys((".pkl", ".pickle", ".joblib", ".pt", ".pth", ".ckpt"), "pickle"),
}
_PICKLE = re.compile(rb"\x80[\x02-\x05][\x95c}\](K\x8c]")
_NO_ARCHIVES = (".npz", ".keras")
"""Files that hold arrays, though their first bytes are those of archives."""
_SAID = {
    "machine code": ("source-native", "a file of machine code"),
    "compiled Python": ("source-compiled", "compiled Python"),
    "pickle": ("source-pickle", "a file that is or may contain a pickle"),
    "archive": ("source-unread", "an archive: nothing in it has been read"),
    "LFS pointer": ("source-unread", "a pointer of git LFS, without the file that it means"),
}
_BIDI = "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"
_INVISIBLE = (
    "\u00ad\u115f\u1160\u180e\u200b\u2060-\u2064\u3164\ufeff\uffa0"
    "\U000e0001\U000e0020-\U000e007f\U000e0100-\U000e01ef"
)
_CONTROL = "\0-\x08\x0b\x0e-\x1f\x7f-\x9f\u2028\u2029"
_HIDDEN = re.compile(rf"[{_BIDI}{_INVISIBLE}{_CONTROL}]|\r(?!\n)")
_OTHERS = "\u0400-\u052f\u0531-\u0587"
_HIDDEN_IN_CODE = re.compile(
    rf"{_HIDDEN.pattern}|[A-Za-z][{_OTHERS}]\w{{0,40}}|[{_OTHERS}][A-Za-z]\w{{0,40}}"
)
_MOST_HIDDEN = 20
"""Hidden characters to report for one file."""


def kind_of_contents(name: str, beginning: bytes, ending: bytes = b"") -> str:
    """Names a kind in few words: ``"Python"``, ``"text"``, ``"binary"``, or a suspicious kind."""
    suffix = Path(name).suffix.lower()
    if beginning.lstrip().startswith(_LFS):
        return "LFS pointer"
    if suffix in _SUFFIXES:  # before the first bytes: "MZ = 1" is Python
        return _SUFFIXES[suffix]
    if beginning.startswith(_MACHINE_CODE):
        return "machine code"
    if _PICKLE.match(beginning):
        return "pickle"
    of_a_kind = beginning.startswith(_ARCHIVES) or beginning[257:262] == b"ustar"
    if (of_a_kind or _ZIP_END in ending) and (suffix not in _NO_ARCHIVES or _may_hold_code(ending)):
        return "archive"
    return "text" if _is_text(beginning) else "binary"


def _may_hold_code(ending: bytes) -> bool:
    """Tells whether a zip's directory lists modules, or is too large to search."""
    end = ending.rfind(_ZIP_END)
    begin = end - int.from_bytes(ending[end + 12 : end + 16], "little")
    return end >= 0 and (begin < 0 or re.search(rb"\.(pyc?|so)", ending[begin:end]) is not None)


def _is_text(beginning: bytes) -> bool:
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        decoder.decode(beginning, final=len(beginning) < BEGINNING)
    except UnicodeDecodeError:
        return False
    return b"\0" not in beginning


def of_kind(name: str, kind: str, *, is_folder: bool) -> Iterator[Finding]:
    """Yields the findings of a file's kind alone, in a repository or a local folder."""
    if kind == "LFS pointer" and is_folder:
        message = "a pointer of git LFS: the file that its commit has has not been judged"
        yield Finding("source-uncommitted", message, file=name)
    elif kind in _SAID:
        check, message = _SAID[kind]
        yield Finding(check, message, file=name)


def hidden(name: str, text: str, *, is_code: bool) -> Iterator[Finding]:
    """Finds characters that are invisible, change the order of text, or imitate other letters."""
    pattern = _HIDDEN_IN_CODE if is_code else _HIDDEN
    line, counted, seen = 1, 0, set()
    for match in pattern.finditer(text):
        line += text.count("\n", counted, match.start())
        counted = match.start()
        if (line, match[0]) not in seen:
            seen.add((line, match[0]))
            yield Finding("source-hidden", _called(match[0]), file=name, line=line)
        if len(seen) >= _MOST_HIDDEN:
            return


def _called(character: str) -> str:
    if len(character) > 1:
        return f"holds {character!r}, which mixes Latin letters with others that look like them"
    words = unicodedata.name(character, "a control character").lower()
    return f"holds U+{ord(character):04X}, {words}"


# --- modules, calls and texts in source, each with its line --------------------------------------

_NETWORK, _PROCESS, _DYNAMIC, _UNPICKLING, _NATIVE, _OUTSIDE, _OBSCURE = (
    f"source-{kind}"
    for kind in ("network", "process", "dynamic", "pickle", "native", "outside", "obscure")
)


def _each(check: str, *names: str) -> dict[str, str]:
    return dict.fromkeys(" ".join(names).split(), check)


_MODULES = {
    **_each(
        _NETWORK,
        "socket ssl http urllib requests httpx aiohttp ftplib smtplib urllib3 websocket websockets",
        "paramiko xmlrpc socketserver telnetlib poplib imaplib nntplib asyncore asynchat wsgiref",
        "pycurl zmq grpc tornado twisted trio anyio gevent eventlet httplib2 httpcore boto3",
    ),
    **_each(_PROCESS, "subprocess pty posix nt posixsubprocess winapi webbrowser antigravity"),
    **_each(_PROCESS, "pexpect ptyprocess sh plumbum fabric"),
    **_each(_UNPICKLING, "pickle dill joblib cloudpickle marshal shelve jsonpickle cPickle"),
    **_each(_NATIVE, "ctypes cffi cffi_backend"),
    **_each(_DYNAMIC, "builtins runpy zipimport imp code codeop frozen_importlib interpreters"),
    **_each(_DYNAMIC, "frozen_importlib_external xxsubinterpreters"),
}
"""Keys are first names; a private module, such as ``_socket``, counts as its public twin."""
_NAMES = {
    **_each(_DYNAMIC, "eval exec compile __import__ builtins __loader__"),
    **_each(
        _PROCESS,
        "os.system os.popen os.fork os.forkpty os.posix_spawn os.posix_spawnp os.startfile",
        "os.execl os.execle os.execlp os.execlpe os.execv os.execve os.execvp os.execvpe os.spawnl",
        "os.spawnle os.spawnlp os.spawnlpe os.spawnv os.spawnve os.spawnvp os.spawnvpe",
        "util.spawnv_passfds psutil.Popen .create_subprocess_exec .create_subprocess_shell",
        ".subprocess_exec .subprocess_shell",
    ),
    **_each(
        _NETWORK,
        ".open_connection .open_unix_connection .start_server .start_unix_server .sock_connect",
        ".create_connection .create_server .create_unix_connection .create_unix_server",
        ".create_datagram_endpoint multiprocessing.connection.Client hub.load_state_dict_from_url",
        "multiprocessing.connection.Listener logging.handlers.SocketHandler",
        "logging.handlers.DatagramHandler logging.handlers.HTTPHandler",
        "logging.handlers.SMTPHandler hub.download_url_to_file",
    ),
    **_each(
        _DYNAMIC,
        "importlib.import_module importlib.__import__ importlib.util.spec_from_file_location",
        "importlib.util.spec_from_loader importlib.machinery.SourceFileLoader codecs.register",
        "importlib.machinery.SourcelessFileLoader importlib.metadata.EntryPoint site.addsitedir",
        "site.addpackage sys.meta_path sys.path_hooks types.CodeType types.FunctionType",
        "pkgutil.resolve_name pkgutil.find_loader pkgutil.get_loader pydoc.importfile pydoc.locate",
        "pydoc.safeimport logging.config.dictConfig logging.config.fileConfig",
        "logging.config.DictConfigurator logging.config.listen timeit.timeit timeit.repeat",
        "timeit.Timer cProfile.run cProfile.runctx pdb.run pdb.runeval torch.hub.load",
        "hydra.utils.instantiate hydra.utils.get_class concurrent.interpreters",
        ".exec_module .load_module .__globals__ .__builtins__ .f_globals .f_builtins",
    ),
    **_each(
        _NATIVE,
        "importlib.machinery.ExtensionFileLoader ctypeslib.load_library .enable_load_extension",
        "ops.load_library classes.load_library cpp_extension.load cpp_extension.load_inline",
    ),
    **_each(
        _UNPICKLING,
        "torch.load torch.serialization.load .read_pickle reduction.ForkingPickler yaml.Loader",
        "allow_pickle=True yaml.unsafe_load yaml.unsafe_load_all yaml.UnsafeLoader yaml.CLoader",
        "yaml.CUnsafeLoader yaml.loader.Loader yaml.loader.UnsafeLoader",
    ),
    "yaml.load without a Loader": _UNPICKLING,
    **_each(_OUTSIDE, "os.path.expanduser pathlib.Path.home"),
}
"""Whole names, or ends of dotted names; a leading dot matches an attribute of any object."""
_REFLECTED = {"os", "sys", "builtins", "importlib", "subprocess", "socket", "ctypes"}
"""Modules with dangerous attributes, which an author may hide behind a computed name."""
_LONG_LINE = re.compile(r"^[^\n]{2000,}", re.MULTILINE)


def constructs(file: str, parsed: ParsedFile) -> Iterator[Finding]:
    """Yields the suspicious constructs of a file, each once per line."""
    rows = (*_imported(parsed), *_used(parsed), *_said(parsed))
    for line, check, message in sorted(set(rows)):
        yield Finding(check, message, file=file, line=line)


def long_lines(file: str, text: str) -> Iterator[Finding]:
    """Finds lines that are too long to read to the end, where code may hide."""
    for match in _LONG_LINE.finditer(text):
        line = 1 + text.count("\n", 0, match.start())
        message = f"a line of {len(match[0])} characters"
        yield Finding(_OBSCURE, message, file=file, line=line)


def _imported(parsed: ParsedFile) -> Iterator[tuple[int, str, str]]:
    for statement in parsed.imports:
        for name in dict.fromkeys(module.partition(".")[0] for module in _absolute(statement)):
            public = _bare(name) if name in sys.stdlib_module_names else name  # _socket: socket
            if check := _MODULES.get(public):
                yield statement.line, check, f"imports {name}"


def _absolute(statement: ImportStatement) -> Sequence[str]:
    # below 0: names of modules; 0: names from a module; above: relative
    return (
        statement.names if statement.level < 0 else () if statement.level else (statement.module,)
    )


def _bare(name: str) -> str:
    """Strips leading underscores: ``random._os`` becomes ``os``. ``__dict__`` stays unchanged."""
    return name if name.startswith("__") else name.lstrip("_")


def _used(parsed: ParsedFile) -> Iterator[tuple[int, str, str]]:
    imported = {
        name.partition(".")[0] for statement in parsed.imports for name in _absolute(statement)
    }
    through = imported - _MODULES.keys()
    for name, line in parsed.uses:
        parts = name.split(".")
        for found, meant in _meant(parts):
            yield line, found, f"uses {meant}"
        if parts[-1] in ("[computed]", "__dict__") and parts[-2] in _REFLECTED:
            yield line, _DYNAMIC, f"gets something of {parts[-2]} by a computed name"
        for part in map(_bare, parts[1:] if parts[0] in through else ()):
            if part in sys.stdlib_module_names and (check := _MODULES.get(part)):
                yield line, check, f"reaches {part} through {parts[0]}"


def _meant(parts: list[str]) -> Iterator[tuple[str, str]]:
    """Yields table entries that a dotted name ends with: their check and their name there."""
    bare = [*map(_bare, parts)]
    ends = [".".join(bare[start:]) for start in range(len(parts) - 1)] or parts
    if len(parts) != 2 or parts[0] not in ("self", "cls"):
        ends.append(f".{parts[-1]}")
    yield from ((check, end.strip(".")) for end in ends if (check := _NAMES.get(end)))


def _said(parsed: ParsedFile) -> Iterator[tuple[int, str, str]]:
    for kind, text, length, line in parsed.texts:
        if kind == "outside":
            yield line, _OUTSIDE, f"names {text!r}"
        else:
            yield line, _OBSCURE, f"a text of {length} characters without a word"
