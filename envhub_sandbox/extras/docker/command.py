"""``envhub image build``: builds a worker's image with a repository's packages."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import ProgressBar, out, print_json, safe_line, say
from envhub_worker.protocol.text import counted

if TYPE_CHECKING:
    from envhub_sandbox.hub.snapshot import Snapshot


@opt.with_options(*opt.SOURCE)
def build(
    *,
    ref: opt.Ref,
    base: Annotated[
        str, typer.Option(metavar="IMAGE", help="The image to derive from.")
    ] = "envhub-worker",
    engine: Annotated[
        str | None, typer.Option(metavar="docker|podman", help="Docker by default, if it answers.")
    ] = None,
    apt: Annotated[
        list[str] | None,
        typer.Option(metavar="PACKAGE", help="A Debian package to install (repeatable)."),
    ] = None,
    exclude_newer: Annotated[
        str | None,
        typer.Option(metavar="DATE", help="Ignore packages that were published after this date."),
    ] = None,
    build_network: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="The network of the build, as in 'docker build'."),
    ] = None,
    json: opt.Json = False,
    make: opt.MakeOptions,
) -> None:
    """Derive an image from envhub-worker with the packages that a repository declares.

    Packages are wheels, pinned by hash, and nothing of the repository runs. The image's tag is the
    hash of all inputs, so the same image is built once.
    """
    with ProgressBar(quiet=json) as bar:
        bar.begin(f"reading {ref}")
        snapshot = make.snapshot(ref)
        bar.begin("resolving and building")
        image = _build(snapshot, base, engine, apt or [], exclude_newer, build_network)
    if json:
        print_json(image)
        return
    out(safe_line(image["image"], 300))
    say(f"{counted(len(image['packages']), 'package')}, lock sha256:{image['lock']}")
    say(f"Use it: envhub run {safe_line(ref)} --sandbox docker:{image['image']}")


def _build(
    snapshot: Snapshot,
    base: str,
    engine_name: str | None,
    system: list[str],
    exclude_newer: str | None,
    network: str | None,
) -> dict[str, Any]:
    from envhub_sandbox.errors import DependencyError
    from envhub_sandbox.extras.docker import packages
    from envhub_sandbox.extras.docker.engines import find_engine
    from envhub_sandbox.extras.packages.request import Choice, request_of

    request = request_of(snapshot, Choice("own", exclude_newer=exclude_newer))
    assert request is not None
    if not (request.wanted or request.supports or request.guesses or system):
        raise DependencyError(
            f"{snapshot.repo_id} declares no packages, so it needs no image of its own. Use "
            f"--sandbox docker:{base}"
        )
    is_local = snapshot.is_local
    name = Path(snapshot.repo_id).name if is_local else snapshot.repo_id
    engine = find_engine(engine_name)
    derived = packages.derived(engine, base, request, name=name, system=system, network=network)
    lock = derived.lock
    return {
        "image": derived.tag,
        "built": derived.is_new,
        "lock": lock.digest,
        "packages": lock.packages,
    }
