"""Checks wheels that came out of a jail as any stranger's bytes, and keeps them.

A wheel must be the requested package, fit the interpreter, and contain exactly the files that its
RECORD lists with their hashes, no links, and no path that leaves its folder. The jail confines the
installed code, as for every wheel of an index. The cache sorts wheels by what they were built of::

    <cache>/wheels/<source and interpreter>/<build environment>/
        NAME-VERSION-TAGS.whl
        built.json      what it was built of, and its hash
"""

from __future__ import annotations

import base64
import contextlib
import csv
import hashlib
import io
import json
import os
import shutil
import zipfile
import zlib
from dataclasses import asdict, dataclass, replace
from operator import attrgetter
from pathlib import Path

from packaging import tags
from packaging.utils import InvalidWheelFilename, canonicalize_name, parse_wheel_filename
from packaging.version import InvalidVersion, Version

from envhub_sandbox.errors import DependencyError, SnapshotError
from envhub_sandbox.extras.packages.builds.trees import (
    MAX_TABLE,
    BoundedStream,
    check_zip,
    not_as_expected,
)
from envhub_sandbox.extras.packages.declared import Source, WheelOrigin
from envhub_sandbox.extras.packages.interpreters import Interpreter
from envhub_sandbox.hub.listing import (
    SHA256,
    FileRecord,
    HashMismatch,
    check_listing_names,
    copy_bounded,
    digest_of,
)
from envhub_sandbox.hub.logins import without_login
from envhub_sandbox.system import folders
from envhub_sandbox.system.folders import cache_root, draft, remove_tree
from envhub_worker.protocol.text import printable, size_text

MAX_BYTES = 512 * 2**20
MAX_UNPACKED = 4 * 2**30
MAX_FILES = 100_000
_UNREADABLE = (
    *(OSError, EOFError, ValueError, RuntimeError, NotImplementedError, KeyError),
    *(zipfile.BadZipFile, zlib.error, csv.Error),
)


def check(wheel: Path, name: str, version: str, interpreter: Interpreter) -> None:
    """Refuse a wheel, under the name from its builder, that is not the requested package.

    An empty version accepts any. Raises ``DependencyError``.
    """
    try:
        version_found = named(wheel.name, name, version)
        _fits(wheel.name, interpreter)
        if wheel.stat().st_size > MAX_BYTES:
            raise not_as_expected(f"it has more than {size_text(MAX_BYTES)}")
        with (
            wheel.open("rb") as file,
            zipfile.ZipFile(BoundedStream(file, "it", MAX_TABLE)) as archive,
        ):
            _files(archive)
            info = _info(archive, name, version_found)
            _record(archive, f"{info}/RECORD")
    except (*_UNREADABLE, SnapshotError, DependencyError) as error:
        said = printable(str(error), 300)
        raise not_as_expected(
            f"the wheel {printable(wheel.name, 200)!r} that was built for {name} is not taken: "
            f"{said}"
        ) from error


def named(file: str, name: str, version: str) -> Version:
    """Returns a wheel's version, by its file name. Raises ``DependencyError`` for another wheel."""
    try:
        distribution, number, _, _ = parse_wheel_filename(file)
        wanted = Version(version) if version else number
    except (InvalidWheelFilename, InvalidVersion) as error:
        raise not_as_expected(f"its file name is invalid: {error}") from error
    if distribution != canonicalize_name(name) or number != wanted:
        raise not_as_expected(f"it is {distribution} {number}, and not {name} {wanted}")
    return number


def _fits(file: str, interpreter: Interpreter) -> None:
    _, _, _, tags_found = parse_wheel_filename(file)
    major, minor = map(int, interpreter.version.split(".")[:2])
    platforms = list(tags.platform_tags())  # it was built on this machine
    short = f"cp{major}{minor}"
    fitting = {
        *tags.cpython_tags((major, minor), platforms=platforms),
        *tags.compatible_tags((major, minor), interpreter=short, platforms=platforms),
    }
    if fitting.isdisjoint(tags_found):
        raise not_as_expected(f"it does not fit Python {interpreter.version} on this machine")


def _files(archive: zipfile.ZipFile) -> None:
    members = archive.infolist()
    if len(members) > MAX_FILES or sum(member.file_size for member in members) > MAX_UNPACKED:
        raise not_as_expected(f"it holds more than {MAX_FILES} files or {size_text(MAX_UNPACKED)}")
    check_zip(members, "it")
    # a folder counts as a file in it, so that it collides with a file of the folder's name
    names = (member.filename + "_" * member.is_dir() for member in members)
    check_listing_names([FileRecord(name, 0, "") for name in names], "it")


def _info(archive: zipfile.ZipFile, name: str, version: Version) -> str:
    """Returns the wheel's only ``.dist-info`` folder; its name must match package and version."""
    tops = {name.partition("/")[0] for name in archive.namelist()}
    folders_found = [top for top in tops if top.endswith(".dist-info")]
    if len(folders_found) != 1:
        raise not_as_expected(f"it holds {len(folders_found)} folders .dist-info")
    stem, _, number = folders_found[0].removesuffix(".dist-info").rpartition("-")
    if canonicalize_name(stem) != canonicalize_name(name) or Version(number) != version:
        raise not_as_expected(f"its metadata are those of {folders_found[0]!r}")
    fields = _fields(_small(archive, f"{folders_found[0]}/METADATA"))
    if canonicalize_name(fields.get("name", "")) != canonicalize_name(name):
        raise not_as_expected(f"its metadata name the package {fields.get('name', '')!r}")
    if Version(fields.get("version", "")) != version:
        raise not_as_expected(f"its metadata name the version {fields.get('version', '')!r}")
    return folders_found[0]


def _fields(data: bytes) -> dict[str, str]:
    """Returns the headers of METADATA; of repeated names the first."""
    fields: dict[str, str] = {}
    for line in data.decode("utf-8", "replace").splitlines():
        if not line.strip():
            break
        key, colon, value = line.partition(":")
        if colon and not line[0].isspace():
            fields.setdefault(key.lower(), value.strip())
    return fields


def _small(archive: zipfile.ZipFile, path: str) -> bytes:
    with archive.open(path) as file:
        data = file.read(MAX_TABLE + 1)
    if len(data) > MAX_TABLE:
        raise not_as_expected(f"{path} in it has more than {size_text(MAX_TABLE)}")
    return data


def _record(archive: zipfile.ZipFile, path: str) -> None:
    """Require RECORD to list every file with its hash, and no other file."""
    rows = list(csv.reader(io.StringIO(_small(archive, path).decode())))
    digests = {row[0]: row[1] for row in rows if len(row) == 3}
    names = {member.filename for member in archive.infolist() if not member.is_dir()}
    signatures = {path, f"{path}.jws", f"{path}.p7s"}
    if names - digests.keys() - signatures or digests.keys() - names - signatures:
        raise not_as_expected("its RECORD lists other files than it has")
    for name in sorted(names - signatures):
        digest = hashlib.sha256()
        with archive.open(name) as file:  # it reads no more bytes than the size in the directory
            copy_bounded(file, None, archive.getinfo(name).file_size, digest)
        encoded = base64.urlsafe_b64encode(digest.digest()).rstrip(b"=").decode()
        if digests[name] != f"sha256={encoded}":
            raise not_as_expected(f"{name[:200]!r} is not the file that its RECORD says")


FORMAT = 2
"""The format of kept wheels and of their build; wheels of another format are built again."""


def root() -> Path:
    """Returns the folder of kept wheels; private to this user, since we install these wheels."""
    return cache_root() / "wheels"


def recall(source: Source, interpreter: Interpreter) -> Path | None:
    """Returns the latest kept wheel of a source for an interpreter; None if there is none."""
    folder = root() / _key(source, interpreter)
    if not folder.is_dir() or not folders.is_ours_alone(root()):
        return None
    records = sorted(folder.glob("[!.]*/built.json"), key=lambda record: -record.stat().st_mtime)
    return next(filter(None, map(_whole, records)), None)


def _whole(record: Path) -> Path | None:
    """Returns the wheel beside a record if its hash matches the record."""
    with contextlib.suppress(OSError, ValueError, HashMismatch):
        [wheel] = record.parent.glob("*.whl")
        built = describe(wheel)
        if built is not None and _hash(wheel) == f"sha256:{built.wheel}":
            with contextlib.suppress(OSError):
                os.utime(record)
            return wheel
    return None


@dataclass(frozen=True)
class KeptWheel:
    """A wheel that was built here; ``used``: Unix time (seconds) of its last use."""

    file: str
    size: int
    used: float
    home: Path

    def answers_to(self, name: str) -> bool:
        """Tells whether a name is the name of this wheel's file or of its package."""
        return name == self.file or canonicalize_name(name) == parse_wheel_filename(self.file)[0]

    def remove(self) -> None:
        """Remove the wheel; the next request builds it again."""
        remove_tree(self.home)
        with contextlib.suppress(OSError):  # it may hold a wheel of another build
            self.home.parent.rmdir()


def every() -> list[KeptWheel]:
    """Returns all kept wheels, the latest used first."""
    wheels = []
    for record in root().glob("*/[!.]*/built.json"):
        with contextlib.suppress(OSError, ValueError):
            [wheel] = record.parent.glob("*.whl")
            parse_wheel_filename(wheel.name)
            size, used = wheel.stat().st_size, record.stat().st_mtime
            wheels.append(KeptWheel(wheel.name, size, used, record.parent))
    return sorted(wheels, key=attrgetter("used"), reverse=True)


def describe(wheel: Path) -> WheelOrigin | None:
    """Returns the origin of a wheel; None for a wheel that was not built here."""
    with contextlib.suppress(OSError, ValueError, TypeError, LookupError):
        facts = json.loads((wheel.parent / "built.json").read_bytes())
        return WheelOrigin(Source(**facts["source"]), facts["environment"], facts["wheel"])
    return None


def keep(wheel: Path, source: Source, environment: str, interpreter: Interpreter) -> Path:
    """Keeps a checked wheel; returns its path. Raises ``DependencyError``."""
    folder = root() / _key(source, interpreter)
    public = replace(source, url=without_login(source.url), where="")
    built = WheelOrigin(public, environment, _hash(wheel).removeprefix("sha256:"))
    try:
        folders.make_private(root())
        folders.make(folder)
        with draft(folder) as building:
            shutil.copyfile(wheel, building / wheel.name)
            (building / "built.json").write_text(json.dumps(asdict(built)))
            home = folder / environment[:40]
            if home.exists() and _whole(home / "built.json") is None:
                remove_tree(home)
            with contextlib.suppress(OSError):  # a wheel of another process serves as well
                os.rename(building, home)
    except OSError as error:
        raise DependencyError(f"{root()} cannot be written: {error}") from error
    kept = recall(source, interpreter)
    assert kept is not None
    return kept


def _key(source: Source, interpreter: Interpreter) -> str:
    facts = json.dumps([FORMAT, source.identity, asdict(interpreter)])
    return hashlib.sha256(facts.encode()).hexdigest()[:40]


def _hash(wheel: Path) -> str:
    return digest_of(wheel, SHA256, wheel.stat().st_size)
