"""Environments that a package registers with Gymnasium: ``pypi:NAME[EXTRA][@VERSION]#ID``.

``hub.reference`` knows the prefix. The repository's name is ``NAME[EXTRA]#ID``, its revision the
version. Its entry file is generated from ``registered_env.txt`` and the reference, and runs in a
jail like that of any repository: only there is the package imported.
"""

from __future__ import annotations

import re
from pathlib import Path

from envhub_sandbox.hub.grammar import Parts, Wrong, join

KIND = "pypi"
GRAMMAR = (
    "pypi:PACKAGE#ID or pypi:PACKAGE@VERSION#ID, such as 'pypi:minigrid#MiniGrid-Empty-5x5-v0'"
)
_PREFIX = "pypi:"
_NAME = r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,98}[A-Za-z0-9])?"
_PACKAGE = rf"(?a)({_NAME})(\[{_NAME}(?:,{_NAME}){{0,15}}\])?"
_VERSION = r"(?a)[0-9][A-Za-z0-9.!+_-]{0,99}"
_ID = r"(?a)[A-Za-z0-9_][A-Za-z0-9_.:/-]{0,199}"


def read(text: str) -> Parts:
    """Splits a reference into unchecked parts; ``==`` means ``@``."""
    wanted, hash_, env_id = text[len(_PREFIX) :].strip().partition("#")
    if not hash_:
        raise Wrong("the environment's id is missing", GRAMMAR)
    package, at, version = wanted.replace("==", "@", 1).partition("@")
    package = package.replace(" ", "")
    return Parts(f"{package}#{env_id}", version.strip() if at else None, repo_type=KIND)


def check(parts: Parts) -> None:
    """Raise ``Wrong`` unless an index and a registry could have the parts."""
    package, env_id = parts.repo_id.partition("#")[::2]
    if not re.fullmatch(_PACKAGE, package):
        raise Wrong(f"{package[:200]!r} is not the name of a package", GRAMMAR)
    if parts.revision is not None and not re.fullmatch(_VERSION, parts.revision):
        plain = repr(join(parts._replace(revision=None)))
        raise Wrong(f"{parts.revision[:200]!r} is not a version, such as '3.0.0'", plain)
    if not re.fullmatch(_ID, env_id):
        raise Wrong(f"{env_id[:200]!r} is not the id of an environment", GRAMMAR)


_TEMPLATE = Path(__file__).with_name("registered_env.txt")


def entry(parts: Parts) -> bytes:
    """Returns the bytes of the entry file; equal for equal references."""
    package, _, env_id = parts.repo_id.partition("#")
    requirement = package if parts.revision is None else f"{package}=={parts.revision}"
    text = _TEMPLATE.read_text("utf-8")
    filled = {
        "REQUIREMENT": ascii(requirement).replace("'", '"'),
        "DISTRIBUTION = None": f"DISTRIBUTION = {package.partition('[')[0]!r}",
        "ENV_ID = None": f"ENV_ID = {env_id!r}",
    }
    for place, value in filled.items():
        assert text.count(place) == 1
        text = text.replace(place, value)
    return text.encode()
