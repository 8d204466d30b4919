"""Between client and worker server: jails are opened, asked, watched and closed."""

from __future__ import annotations

import re
from collections.abc import Mapping

from envhub_worker.protocol.confinement import Reason
from envhub_worker.protocol.messages.message import Message
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import HubCopy, Runtime, read_hub_copies


class Hello(Message, kind=1):
    """The first request on every connection. Reply: ``Welcome`` or ``Refusal``."""

    version: int
    session: bytes
    """Random bytes that join the connections of one client; jails belong to a session."""
    compressions: tuple[object, ...] = ()
    """Those that the client can read, best first."""


class Welcome(Message, kind=2):
    """The server's version of the protocol, its release, and its pid."""

    version: int
    worker: str
    pid: int
    compression: str = ""
    """The compression of all later messages, or ``""``."""
    idle_s: int = 0
    """The server ends the jails of a client that is silent for so many seconds; 0 means never."""


BUSY_ERROR = "ServerBusyError"
DRAINING = "draining"
"""Stands for a quota's name while the server drains."""
LONGEST_S = 60.0
_NUMBERS = r"(\d{1,18}) (\d{1,18}) (\d{1,4}(?:\.\d{1,3})?)"
_NAME = r"[a-z_]{1,32}"


@dataclass(frozen=True)
class Busy:
    """The details of a ``Refusal`` for lack of room, whose ``error`` is ``BUSY_ERROR``.

    A client that does not know that error raises a ``WorkerError`` with the text.

    Attributes:
        quota: The name of the quota; travels as ``missing``.
        used: How much of the quota the key's other sessions use.
        limit: The whole quota.
        retry_s: Seconds after which the client may try again.
    """

    quota: str
    used: int
    limit: int
    retry_s: float

    def words(self) -> str:
        """The numbers as text, which travels as ``fix``."""
        return f"{self.used} {self.limit} {self.retry_s:.3f}"


class Refusal(Message, kind=3):
    """The server refuses a request. ``error`` is a name in a table of the client; see ``Busy``."""

    error: str
    message: str
    missing: str
    fix: str

    @property
    def busy(self) -> Busy | None:
        """Returns the details if the server lacks room; an empty ``Busy`` if they are malformed.

        Trust: input from the worker.
        """
        if self.error != BUSY_ERROR:
            return None
        match = re.fullmatch(_NUMBERS, self.fix)
        if match is None or not re.fullmatch(_NAME, self.missing):
            return Busy("", 0, 0, 1.0)
        return Busy(self.missing, int(match[1]), int(match[2]), min(float(match[3]), LONGEST_S))


class OpenJail(Message, kind=4):
    """Fork a jail for a snapshot. Reply: ``JailOpened``, ``Refusal`` or ``Death``.

    ``confinement`` holds the fields of ``Confinement``, with ``limits`` as a nested mapping.
    """

    name: str
    python: str
    packages: str
    snapshot: str
    entry: str
    confinement: dict[str, object]
    runners: int
    hub_copies: tuple[object, ...] = ()

    @property
    def runtime(self) -> Runtime:
        """Returns the interpreter and the packages of the repository."""
        return Runtime(self.python, self.packages)

    @property
    def repositories(self) -> tuple[HubCopy, ...]:
        """Returns the contents of the jail's Hub cache. Raises ``RemoteProtocolError``."""
        return read_hub_copies(self.hub_copies)

    def with_trees(self, trees: Mapping[str, str]) -> tuple[object, ...]:
        """Returns ``hub_copies`` with paths in place of the names of trees."""
        repositories = self.repositories
        return tuple((*copy[:3], trees.get(copy.tree, copy.tree)) for copy in repositories)


class JailOpened(Message, kind=5):
    """The jail's number and its runners' numbers."""

    jail: int
    runners: tuple[int, ...]
    report: tuple[object, ...]
    """One mapping per layer: ``layer``, ``enforced``, ``detail``."""


class StartRunners(Message, kind=6):
    """Fork further runners in an open jail. Reply: ``JailOpened`` with just the new ones."""

    jail: int
    runners: int


class Relay(Message, kind=7):
    """Hand the frames that follow to runners: ``parts`` is ``((runner, frames), ...)``.

    Reply: ``RelayDone`` once every runner has answered, or ``Death``.
    """

    jail: int
    operation: str
    parts: tuple[object, ...]
    deposited: bool = False
    """Whether the descriptors of each runner's last ``Deposit`` go with its frames: ``Attach``."""
    stepped: bool = False
    """Whether each runner's one frame is for its request slab, which the server writes: the words
    from ``SPIN`` to the last dtype, and the actions. Its part of the reply is then the words
    ``OUTCOME`` and ``LENGTH``, the infos, and the observation slab: see ``ShareSlabs``."""


class RelayDone(Message, kind=8):
    """The runners' replies: ``parts`` is the number of frames of each, in the request's order.

    In a kept jail (``KeepJail``), ``dead`` holds the indices of runners that have died; the part at
    each is the server's own ``Death``, in one frame. A runner cannot forge one: a part outside
    ``dead`` never counts as a death.
    """

    parts: tuple[int, ...]
    dead: tuple[int, ...] = ()


class Death(Message, kind=9):
    """A process of the jail ended. Trust: ``tail`` is the jail's own output, escaped.

    ``runner`` is -1 if the whole jail ended.
    """

    runner: int
    reason: Reason
    exit_code: int | None = None
    signal: str | None = None
    detail: str = ""
    tail: str = ""
    operation: str = ""


class CloseJail(Message, kind=10):
    """End a jail and everything in it. Reply: ``Done``, once it is gone."""

    jail: int


class Done(Message, kind=11):
    """The request is done and has no result."""


class CheckJail(Message, kind=12):
    """Ask whether a jail lives. Reply: ``Done``, or ``Death``, which names the ``operation``."""

    jail: int
    operation: str


class GetStatus(Message, kind=14):
    """Ask for the server's jails. Reply: ``Status``."""


class Status(Message, kind=15):
    """One mapping per jail."""

    jails: tuple[object, ...]


class Deposit(Message, kind=16):
    """Over the descriptor socket: descriptors for a runner. Reply: ``TAKEN`` or ``NOT_YET``."""

    session: bytes
    jail: int
    runner: int


TAKEN, NOT_YET = b"k", b"w"


class KeepJail(Message, kind=17):
    """Say what a jail outlives. Reply: ``Done``, or ``Death``."""

    jail: int
    runners: bool
    """Whether a runner's death does not end it from now on."""
    idle_ms: int
    """It ends after so many milliseconds without a request; 0 means never."""


class OfferSnapshot(Message, kind=19):
    """A snapshot's files, each ``(path, size, sha256)``; an executable file has True as a fourth
    element. Reply: ``MissingBlobs`` or ``Refusal``.
    """

    files: tuple[object, ...]


class MissingBlobs(Message, kind=20):
    """The hashes that the server lacks. If it lacks none, ``OpenJail`` may name ``snapshot``."""

    snapshot: str
    hashes: tuple[object, ...]


class PutBlob(Message, kind=21):
    """One piece of a wanted file, in order; the frame that follows holds it. Reply: ``Done``.

    After the last piece the server compares the file with its hash.
    """

    sha256: bytes
    offset: int


class KeepAlive(Message, kind=22):
    """The client lives, and still holds these jails. Reply: ``Done``."""

    jails: tuple[int, ...]


class CompressionHeader(Message, kind=25):
    """In front of frames: each frame's unpacked size, or -1 for a frame without compression."""

    compression: str
    sizes: tuple[int, ...]


class GetSessions(Message, kind=26):
    """Ask who uses the server: the asker's own sessions, or all for the operator."""


class Sessions(Message, kind=27):
    """One mapping a session; ``server`` has figures of the server itself."""

    sessions: tuple[object, ...]
    server: dict[str, object]


class FollowOutput(Message, kind=28):
    """Ask for what a jail has printed from its ``offset``-th byte on. Reply: ``OutputBytes``."""

    jail: int
    offset: int


class OutputBytes(Message, kind=29):
    """Bytes that a jail printed. Trust: raw. The server has dropped the bytes before ``start``."""

    start: int
    data: bytes


class NeedPackages(Message, kind=31):
    """Ask a server on another host for a repository's packages. Reply: ``Packages`` or ``Refusal``.

    The server builds in the background and reports its progress at once: the client asks again.
    ``requirements`` has pairs: a requirement and the file that states it. ``supports`` are the
    versions of Python that the repository runs in, ``python`` is the version that the caller wants.
    Without ``always``, the server's own packages are used if they meet all requirements.
    ``guesses`` count only if nothing else brings the module: a requirement, the file that imports
    the module, the module, and the distributions that bring it, separated by spaces.
    ``constraints`` and ``override`` are pairs like ``requirements``, ``without`` names of packages.
    """

    requirements: tuple[object, ...]
    supports: str
    python: str
    exclude_newer: str
    always: bool
    guesses: tuple[object, ...] = ()
    constraints: tuple[object, ...] = ()
    override: tuple[object, ...] = ()
    without: tuple[object, ...] = ()
    gpu: bool = False


class Packages(Message, kind=32):
    """The state of packages: ``"making"``, ``"made"``, or ``"own"`` for the server's own packages.

    ``name`` is their name in ``OpenJail``, ``progress`` a line for people. ``facts`` are the lock's
    hash and the pins.
    """

    state: str
    name: str
    facts: dict[str, object]
    progress: str


class ShareSlabs(Message, kind=33):
    """Make slabs and doorbells for runners. Reply: ``Done``, or ``Refusal`` of too large slabs."""

    jail: int
    slabs: tuple[object, ...]
