"""CURVE key pairs on disk, and the file of authorized clients."""

from __future__ import annotations

import os
from dataclasses import field
from pathlib import Path

import zmq
from zmq.utils import z85

from envhub_worker.protocol.keys import key_text, parse_key
from envhub_worker.protocol.records import dataclass

_SECRET_MODE = 0o600
_MAX_FILE_BYTES = 1 << 20


@dataclass(frozen=True)
class KeyPair:
    """A CURVE key pair: 32 bytes each."""

    public: bytes
    secret: bytes = field(repr=False)


def generate() -> KeyPair:
    """Makes a new key pair."""
    public, secret = zmq.curve_keypair()
    return KeyPair(z85.decode(public), z85.decode(secret))


def from_secret(secret: bytes) -> KeyPair:
    """Returns the pair of a secret key."""
    return KeyPair(z85.decode(zmq.curve_public(z85.encode(secret))), secret)


def load(path: Path) -> KeyPair:
    """Reads a secret key's file; returns the pair. Raises ``OSError`` or ``ValueError``."""
    return from_secret(parse_key(_read(path)))


def save(pair: KeyPair, folder: Path, name: str) -> tuple[Path, Path]:
    """Write ``name.key`` (secret, 0600) and ``name.pub``; never replaces a file.
    Raises ``OSError``: the files cannot be written, or exist.
    """
    folder.mkdir(parents=True, exist_ok=True)
    secret, public = folder / f"{name}.key", folder / f"{name}.pub"
    _write(secret, key_text(pair.secret), _SECRET_MODE)
    try:
        _write(public, key_text(pair.public), 0o644)
    except OSError:
        secret.unlink()  # or it would look like that one's
        raise
    return secret, public


def _write(path: Path, text: str, mode: int) -> None:
    # created with its mode: it is never readable in between
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w") as file:
        file.write(f"{text}\n")


def _read(path: Path) -> str:
    # names have umlauts, and some editors begin with a mark
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return file.read(_MAX_FILE_BYTES)


class AuthorizedClients:
    """The public keys of authorized clients, with names.

    The file has one client per line: its public key and, after a blank, a name. ``#`` and a blank
    begin a comment. The server reads the file again when it changes, so that an operator can remove
    a client.

    Args:
        known: Keys that are authorized without the file.
        most: Maximum number of clients in the file; None for no limit.
    """

    def __init__(self, path: Path | None, known: dict[bytes, str], most: int | None = None) -> None:
        self._path = path
        self._most = most
        self._known = known
        self._stamp: tuple[int, ...] | None = None
        self._wrong = ""
        self._names = dict(known)
        self.refresh()

    def refresh(self) -> bool:
        """Read the file if it has changed; returns whether it was read.
        Raises ``OSError``: it cannot be read; ``ValueError``: a line is malformed, or there are too
        many clients. The text is the same until the file changes again.
        """
        if self._path is None:
            return False
        status = self._path.stat()
        stamp = status.st_ino, status.st_mtime_ns, status.st_size
        if stamp == self._stamp:
            if self._wrong:
                raise ValueError(self._wrong)
            return False
        text = _read(self._path)
        self._stamp = stamp  # from here on it has been read: not every second anew, if it is wrong
        try:
            self._names = self._checked(text, self._path)
        except ValueError as error:
            self._wrong = str(error)
            raise
        self._wrong = ""
        return True

    def _checked(self, text: str, path: Path) -> dict[bytes, str]:
        names = {**_parse(text, path), **self._known}
        if self._most is not None and len(names) > self._most:
            raise ValueError(
                f"{path}: {len(names)} clients are listed, and without Landlock a jail of the "
                "profile 'container' could read the files of all: leave one on the list (one "
                "server for each), or use --weakest-profile no-userns or strict"
            )
        return names

    @property
    def count(self) -> int:
        """The number of authorized keys."""
        return len(self._names)

    def name_of(self, key: bytes) -> str | None:
        """Returns the name of a key's owner, or None if the key is not authorized."""
        return self._names.get(key)


def _parse(text: str, path: Path) -> dict[bytes, str]:
    names = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split(None, 1)
        # a key in Z85 may itself begin with '#'
        if not words or words[0] == "#" or (len(words[0]) < 40 and words[0].startswith("#")):
            continue
        try:
            key = parse_key(words[0])
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from None
        names[key] = words[1].strip() if len(words) > 1 else key_text(key)[:8]
    return names
