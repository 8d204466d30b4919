"""``envhub push``: publish a folder on the Hub, if it loads and steps in a sandbox."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import ProgressBar, out, print_json, safe_line, say
from envhub_sandbox.cli.shared.exits import UsageError
from envhub_worker.protocol.text import counted

if TYPE_CHECKING:
    from envhub_sandbox.hub.reference import HubRef
    from envhub_sandbox.hub.snapshot import Snapshot

_STEPS = 10
_SHOWN = 5
_COMPILED = (".pyc", ".pyo")
_OF_THE_HUB = ".gitattributes"
"""What it puts into a repository that it makes."""


@opt.with_options("env_kwargs", "dependencies", "token", "endpoint")
def push(
    *,
    folder: Annotated[str, typer.Argument(metavar="FOLDER", help="The folder, as in './my-env'.")],
    ref: Annotated[
        str,
        typer.Argument(
            metavar="REPO",
            help="The target: 'owner/name', 'spaces/owner/name' or 'owner/name@branch'.",
        ),
    ],
    message: Annotated[
        str, typer.Option("--message", "-m", help="The commit's message.")
    ] = "Publish the environment with envhub",
    private: Annotated[
        bool, typer.Option("--private", help="If the repository is new, make it private.")
    ] = False,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Check the folder, list its files, and upload nothing."),
    ] = False,
    json: opt.Json = False,
    make: opt.MakeOptions,
) -> None:
    """Publish a folder on the Hub as one commit, and print the pinned reference.

    First the folder is loaded, reset and stepped in a sandbox. If that fails, nothing is uploaded;
    otherwise exactly the checked copy is. Files of the repository that the folder lacks stay there.
    """
    from envhub_sandbox.hub.reference import HubRef
    from envhub_sandbox.hub.snapshot import local

    target = HubRef.parse(ref)
    if target.repo_type in ("git", "pypi"):
        raise UsageError(f"{target} is not on the Hub; a folder is published as owner/name")
    others: list[str] = []
    with ProgressBar(quiet=json) as bar:
        bar.begin(f"reading {folder}")
        snapshot = local(folder)
        _refuse_unfit(snapshot)
        bar.begin("checking it in a sandbox")
        _check(snapshot, {key: make[key] for key in ("env_kwargs", "dependencies")})
        if not dry_run:
            bar.begin(f"uploading to {ref}")
            target, others = _publish(snapshot, target, make, message, private)
    _tell(snapshot, target, others, dry_run, as_json=json)


def _refuse_unfit(snapshot: Snapshot) -> None:
    for file in snapshot.files:
        why = _unfit(file.path)
        if why:
            raise UsageError(f"{snapshot.repo_id} holds {file.path!r}, {why}")


def _unfit(path: str) -> str:
    *folders, name = path.split("/")
    if name.endswith(_COMPILED):
        return "which is compiled Python, and runs instead of its source; delete it"
    if ".cache" in folders:
        return "and huggingface_hub uploads nothing below .cache; delete that folder"
    return ""


def _check(snapshot: Snapshot, options: dict[str, Any]) -> None:
    """Load it and step it.
    Raises ``EnvHubError``: it does not load, or breaks a rule; ``UsageError``: the folder was
    changed meanwhile.
    """
    from envhub_sandbox.factory.make_env import make_env

    with make_env(snapshot.reference, n_envs=2, **options) as suites:
        for _, _, env in opt.select_envs(suites, None, None):
            env.reset(seed=0)
            env.action_space.seed(0)
            for _ in range(_STEPS):
                env.step(env.action_space.sample())
            env.close()
        commit = suites.provenance["commit"]
    if commit != snapshot.commit:
        raise UsageError(f"{snapshot.repo_id} was changed while it was checked; try again")


def _publish(
    snapshot: Snapshot,
    target: HubRef,
    make: opt.MakeOptions,
    message: str,
    private: bool,
) -> tuple[HubRef, list[str]]:
    """Upload the copy in the store, and see that it has arrived; gives the pinned reference, and
    the files of its commit that the folder does not have.
    Raises ``RepositoryUnavailableError``: the Hub refused; ``SnapshotIntegrityError``: it has other
    files now.
    """
    from dataclasses import replace

    from envhub_sandbox.errors import SnapshotIntegrityError
    from envhub_sandbox.hub.client import HubClient, checked_endpoint, checked_token
    from envhub_sandbox.hub.listing import (
        DEFAULT_LIMITS,
        Repository,
        differing,
        listing_within_limits,
    )

    hub = HubClient(checked_endpoint(make["endpoint"]), checked_token(make["token"]))
    repo = Repository(target.repo_type or "model", target.repo_id)
    where = f"{target} on {hub.public_endpoint}"
    to_write = ". To publish takes a token that may write"
    with _explained(f"{where}: nothing was published", to_write):
        hub.publish(repo, snapshot.root, target.revision, message, private=private)
    with _explained(f"{where}: it was published, and cannot be read back"):
        commit = hub.resolve(repo, target.revision)
        found = listing_within_limits(hub.listing(repo, commit), DEFAULT_LIMITS, where)
    missing = differing(snapshot.root, snapshot.files, found)
    if missing:
        raise SnapshotIntegrityError(
            f"{where}: commit {commit} does not have {', '.join(missing[:_SHOWN])} as the folder "
            "has it, so it differs from what was checked; does a .gitignore leave it out?"
        )
    mine = {file.path for file in snapshot.files} | {_OF_THE_HUB}
    others = [file.path for file in found if file.path not in mine]
    return replace(target, revision=commit, path=snapshot.path), others


@contextlib.contextmanager
def _explained(what: str, also: str = "") -> Iterator[None]:
    from envhub_sandbox.errors import RepositoryUnavailableError
    from envhub_sandbox.hub.answers import HubFailure

    try:
        yield
    except HubFailure as failure:
        text = f"{what}: {failure.what}. {failure.advice}{also}."
        raise RepositoryUnavailableError(text) from failure.__cause__


def _tell(
    snapshot: Snapshot, target: HubRef, others: list[str], dry_run: bool, *, as_json: bool
) -> None:
    files = [file.path for file in snapshot.files]
    if as_json:
        document: dict[str, Any] = {"reference": str(target), "published": not dry_run}
        print_json({**document, "files": files, "not_checked": others})
        return
    if dry_run:
        out("\n".join(map(safe_line, files)))
        say("It loads and steps. Nothing was uploaded.")
        return
    out(safe_line(str(target), 300))
    say(f"{counted(len(files), 'file')}. Use it: envhub run {safe_line(str(target), 300)}")
    if others:
        shown = ", ".join(map(safe_line, others[:_SHOWN]))
        say(f"{len(others)} more of the repository, which were not checked: {shown}")
