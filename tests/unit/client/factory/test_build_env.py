"""Metadata of years ago are written as they are read today; nothing else of a wheel is touched."""

from __future__ import annotations

import zipfile
from pathlib import Path

from envhub_sandbox.dependencies import interpreters
from envhub_sandbox.dependencies.builds import wheels
from envhub_sandbox.factory.build_env import mend
from tests.support.packages.wheels import make_wheel

OLD = ("opencv-python (>=3.) ; extra == 'all'", "b (>=1.,<2.)", "c>=4.", "d (==1.*)")
NEW = ("opencv-python (>=3) ; extra == 'all'", "b (>=1,<2)", "c>=4", "d (==1.*)")


def required(wheel: Path) -> list[str]:
    """What its metadata say that it needs."""
    with zipfile.ZipFile(wheel) as archive:
        text = archive.read("x-1.0.dist-info/METADATA").decode()
    return [line[15:] for line in text.splitlines() if line.startswith("Requires-Dist: ")]


def test_versions_that_end_in_a_dot(tmp_path: Path) -> None:
    wheel = make_wheel(tmp_path, "x", requires=OLD)
    mend(wheel)
    assert required(wheel) == list(NEW)
    wheels.check(wheel, "x", "1.0", interpreters.own())
    data = wheel.read_bytes()
    mend(wheel)
    assert wheel.read_bytes() == data, "what is well stays as it is"
