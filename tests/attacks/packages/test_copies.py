"""What jails share is copied when it is written to: no change leaves the jail that makes it.
Nothing here is saved by its mode: everybody may write to all of it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_worker.protocol.runtime import Runtime
from tests.attacks.harness import Arena, OpenJail, control_run, run_in, token
from tests.attacks.hostile.payloads.change_tree import WAYS
from tests.attacks.packages import trapped_packages as traps
from tests.support.packages.environments import base_interpreter, running_on
from tests.support.trees import fingerprint

FAMILY = "Copies of what is shared"


def fill(place: Path) -> Path:
    for way in WAYS:
        for name in ("file", "deeper/file"):
            path = place / way / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("as it was")
    for path in [place, *place.rglob("*")]:
        path.chmod(0o777 if path.is_dir() else 0o666)
    return place


@pytest.fixture(scope="module", autouse=True)
def packages(open_ground: Path) -> Iterator[Path]:
    """Packages of the repository's own, shared by all jails here; what is attacked in them."""
    folder = open_ground / "packages"
    traps.real_packages(folder)
    folder.chmod(0o777)
    with running_on(Runtime(base_interpreter(), str(folder))):
        yield fill(folder / "robot")


def test_no_change_of_the_packages_gets_out(jail: OpenJail, home: Path, packages: Path) -> None:
    """Whatever is done to a file or a folder: content, modes, times, links and attributes stay."""
    control = fill(home / "control")
    before = {way: fingerprint(control / way) for way in WAYS}
    with control_run("change_tree", {"place": str(control)}) as run:
        same = [way for way in WAYS if fingerprint(control / way) == before[way]]
        assert not same, run.text
    before = {way: fingerprint(packages / way) for way in WAYS}
    with jail.inside("change_tree", {"place": str(packages)}) as run:
        after = {way: fingerprint(packages / way) for way in WAYS}
    for way in WAYS:
        title = f"change the packages that jails share: {way}"
        jail.judge(title, "succeeds", after[way] != before[way], run.text)


def test_no_other_jail_sees_a_change(arena: Arena, home: Path, packages: Path) -> None:
    secret, name = token(), f"planted-{token()}"
    outside = {"path": str(home / name)}
    with control_run("create_file", {**outside, "text": secret}):
        pass
    with control_run("read_file", outside) as run:
        assert secret in run.text
    with arena.environment() as first, arena.environment() as second:
        root = str(run_in(first, "where_am_i").value["root"])
        paths = {"packages": f"{packages}/{name}", "repository": f"{root}/{name}"}
        for path in paths.values():
            run_in(first, "create_file", path=path, text=secret)
        found = {what: run_in(second, "read_file", path=path).text for what, path in paths.items()}
    with arena.environment() as third:
        for what, path in paths.items():
            found[what] += run_in(third, "read_file", path=path).text
    for what, text in found.items():
        title = f"plant a file for the next jail: the {what}"
        arena.judge(title, "succeeds", secret in text, text)


def test_nothing_leads_below_a_view(jail: OpenJail, packages: Path) -> None:
    """Not a descriptor that was left open, not the layers of a mount, not the jail's init."""
    path = packages / "planted"
    jail.attack(
        "write below the view of the packages",
        "reach_below",
        lambda run: path.exists(),
        before=lambda: path.unlink(missing_ok=True),
        folder=str(packages.parent),
        name="robot/planted",
    )


def test_no_attribute_leads_out_of_a_view(jail: OpenJail, home: Path, packages: Path) -> None:
    """An overlay keeps notes on its upper folders, where to look for what is below: not ours."""
    secret = token()
    (home / "private").mkdir()
    (home / "private" / "file").write_text(secret)
    at = {"folder": str(packages), "path": str(home / "private" / "file")}
    jail.steal("read a file outside by an overlay's own attributes", "redirect", secret, **at)
