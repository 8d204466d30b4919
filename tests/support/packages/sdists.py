"""Source distributions that are made here, with a build backend of their own."""

import hashlib
import io
import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from envhub_sandbox.extras.packages.declared import Source

BACKEND = """
import base64, hashlib, zipfile
NAME, VERSION, REQUIRES = {name!r}, {version!r}, {requires!r}

def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    info = f"{{NAME}}-{{VERSION}}.dist-info"
    lines = ["Metadata-Version: 2.1", f"Name: {{NAME}}", f"Version: {{VERSION}}"]
    lines += [f"Requires-Dist: {{one}}" for one in REQUIRES]
    files = {{
        f"{{NAME}}/__init__.py": "FROM = 'a source'\\n",
        f"{{info}}/METADATA": "\\n".join([*lines, "", ""]),
        f"{{info}}/WHEEL": "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n",
    }}
    files |= further()
    rows = []
    wheel = f"{{NAME}}-{{VERSION}}-py3-none-any.whl"
    with zipfile.ZipFile(f"{{wheel_directory}}/{{wheel}}", "w") as archive:
        for path, text in files.items():
            archive.writestr(zipfile.ZipInfo(path), text)
            digest = base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest())
            rows.append(f"{{path}},sha256={{digest.decode().rstrip('=')}},{{len(text)}}")
        record = f"{{info}}/RECORD"
        archive.writestr(zipfile.ZipInfo(record), "\\n".join([*rows, f"{{record}},,", ""]))
    return wheel

def further():
    return {{}}
"""
"""What builds a wheel with the standard library alone; ``further`` may be written after it."""
PYPROJECT = (
    '[build-system]\nrequires = [{needs}]\nbuild-backend = "backend"\nbackend-path = ["."]\n'
)


def backend(
    name: str,
    version: str = "1.0",
    requires: Sequence[str] = (),
    needs: Sequence[str] = (),
    further: str = "",
) -> dict[str, str]:
    """The files of sources that build themselves."""
    text = BACKEND.format(name=name, version=version, requires=list(requires))
    needed = ", ".join(map(repr, needs))
    return {"backend.py": text + further, "pyproject.toml": PYPROJECT.format(needs=needed)}


def make_sdist(
    folder: Path, name: str, version: str = "1.0", files: Mapping[str, str] | None = None
) -> Source:
    """Write one, by default one that builds itself."""
    top = f"{name}-{version}"
    path = folder / f"{top}.tar.gz"
    given = backend(name, version) if files is None else files
    with tarfile.open(path, "w:gz") as archive:
        info = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
        for file, text in {"PKG-INFO": info, **given}.items():
            add(archive, f"{top}/{file}", text.encode())
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return Source(name.replace("_", "-"), version, path.as_uri(), digest, where="line 1 of x.txt")


def add(archive: tarfile.TarFile, name: str, data: bytes = b"", kind: bytes = b"0") -> None:
    """A member of any kind; a link leads to /etc/passwd."""
    member = tarfile.TarInfo(name)
    member.size, member.type = len(data), kind
    member.linkname = "/etc/passwd" if kind != b"0" else ""
    archive.addfile(member, io.BytesIO(data))
