"""Looks at a wheel that came out of a jail: as at any stranger's bytes, before it is kept.

It is the package that was asked for, fits the interpreter, and holds what its RECORD says: files
with these hashes, no links, nothing that leads out of a folder. What it does once it is installed
is a jail's matter, as with every wheel of an index.
"""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import zipfile
import zlib
from pathlib import Path

from packaging import tags
from packaging.utils import InvalidWheelFilename, canonicalize_name, parse_wheel_filename
from packaging.version import InvalidVersion, Version

from envhub_sandbox.dependencies.builds.trees import MAX_TABLE, BoundedStream, check_zip_member
from envhub_sandbox.dependencies.interpreters import Interpreter
from envhub_sandbox.errors import DependencyError, PackageIntegrityError, SnapshotError
from envhub_sandbox.hub.listing import FileRecord, check_listing_names
from envhub_worker.protocol.text import printable, size_text

MAX_BYTES = 512 * 2**20
MAX_UNPACKED = 4 * 2**30
MAX_FILES = 100_000
_BLOCK = 1 << 20
_UNREADABLE = (
    *(OSError, EOFError, ValueError, RuntimeError, NotImplementedError, KeyError),
    *(zipfile.BadZipFile, zlib.error, csv.Error),
)


def check(wheel: Path, name: str, version: str, interpreter: Interpreter) -> None:
    """Refuse a wheel, under the name that its builder gave it, that is not what was asked for.

    An empty version stands for any. Raises ``PackageIntegrityError``.
    """
    try:
        found = named(wheel.name, name, version)
        _fits(wheel.name, interpreter)
        if wheel.stat().st_size > MAX_BYTES:
            raise PackageIntegrityError(f"it has more than {size_text(MAX_BYTES)}")
        with (
            wheel.open("rb") as file,
            zipfile.ZipFile(BoundedStream(file, "it", MAX_TABLE)) as archive,
        ):
            _files(archive)
            info = _info(archive, name, found)
            _record(archive, f"{info}/RECORD")
    except (*_UNREADABLE, SnapshotError, DependencyError) as error:
        said = printable(str(error), 300)
        raise PackageIntegrityError(
            f"the wheel {printable(wheel.name, 200)!r} that was built for {name} is not taken: "
            f"{said}"
        ) from error


def named(file: str, name: str, version: str) -> Version:
    """The version of a wheel, by the name of its file. Raises ``PackageIntegrityError``."""
    try:
        found, number, _, _ = parse_wheel_filename(file)
        wanted = Version(version) if version else number
    except (InvalidWheelFilename, InvalidVersion) as error:
        raise PackageIntegrityError(f"its name says nothing: {error}") from error
    if found != canonicalize_name(name) or number != wanted:
        raise PackageIntegrityError(f"it is {found} {number}, and not {name} {wanted}")
    return number


def _fits(file: str, interpreter: Interpreter) -> None:
    _, _, _, found = parse_wheel_filename(file)
    major, minor = map(int, interpreter.version.split(".")[:2])
    platforms = list(tags.platform_tags())  # it was built on this machine
    short = f"cp{major}{minor}"
    fitting = {
        *tags.cpython_tags((major, minor), platforms=platforms),
        *tags.compatible_tags((major, minor), interpreter=short, platforms=platforms),
    }
    if fitting.isdisjoint(found):
        raise PackageIntegrityError(f"it does not fit Python {interpreter.version} on this machine")


def _files(archive: zipfile.ZipFile) -> None:
    members = archive.infolist()
    if len(members) > MAX_FILES or sum(one.file_size for one in members) > MAX_UNPACKED:
        raise PackageIntegrityError(
            f"it holds more than {MAX_FILES} files or {size_text(MAX_UNPACKED)}"
        )
    for member in members:
        check_zip_member(member, "it")
    names = (one.filename + "_" * one.is_dir() for one in members)  # a folder as a file in it
    check_listing_names([FileRecord(name, 0, "") for name in names], "it")


def _info(archive: zipfile.ZipFile, name: str, version: Version) -> str:
    """Its one ``.dist-info``, which is that of the package and of the version."""
    tops = {one.partition("/")[0] for one in archive.namelist()}
    found = [top for top in tops if top.endswith(".dist-info")]
    if len(found) != 1:
        raise PackageIntegrityError(f"it holds {len(found)} folders .dist-info")
    stem, _, number = found[0].removesuffix(".dist-info").rpartition("-")
    if canonicalize_name(stem) != canonicalize_name(name) or Version(number) != version:
        raise PackageIntegrityError(f"its metadata are those of {found[0]!r}")
    fields = _fields(_small(archive, f"{found[0]}/METADATA"))
    if canonicalize_name(fields.get("name", "")) != canonicalize_name(name):
        raise PackageIntegrityError(f"its metadata name the package {fields.get('name', '')!r}")
    if Version(fields.get("version", "")) != version:
        raise PackageIntegrityError(f"its metadata name the version {fields.get('version', '')!r}")
    return found[0]


def _fields(data: bytes) -> dict[str, str]:
    """The headers of METADATA; of each name the first."""
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
        raise PackageIntegrityError(f"{path} in it has more than {size_text(MAX_TABLE)}")
    return data


def _record(archive: zipfile.ZipFile, path: str) -> None:
    """Every file is in RECORD with its hash, and RECORD names no other."""
    rows = list(csv.reader(io.StringIO(_small(archive, path).decode())))
    said = {row[0]: row[1] for row in rows if len(row) == 3}
    there = {one.filename for one in archive.infolist() if not one.is_dir()}
    signatures = {path, f"{path}.jws", f"{path}.p7s"}
    if there - said.keys() - signatures or said.keys() - there - signatures:
        raise PackageIntegrityError("its RECORD lists other files than it has")
    for name in sorted(there - signatures):
        if said[name] != _digest(archive, name):
            raise PackageIntegrityError(f"{name[:200]!r} is not the file that its RECORD says")


def _digest(archive: zipfile.ZipFile, name: str) -> str:
    digest = hashlib.sha256()
    left = archive.getinfo(name).file_size
    with archive.open(name) as file:
        while block := file.read(min(left + 1, _BLOCK)):
            left -= len(block)
            if left < 0:
                raise PackageIntegrityError(f"{name[:200]!r} is longer than it says")
            digest.update(block)
    return "sha256=" + base64.urlsafe_b64encode(digest.digest()).rstrip(b"=").decode()
