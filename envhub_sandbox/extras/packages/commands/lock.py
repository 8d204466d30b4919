"""``envhub lock``: records a repository's state, and with ``--check`` compares it."""

from __future__ import annotations

import os
import re
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import (
    GOOD,
    ProgressBar,
    out,
    print_json,
    safe_line,
    say,
    show,
)
from envhub_sandbox.cli.shared.exits import UsageError
from envhub_sandbox.errors import LockError, SandboxUnavailableError
from envhub_sandbox.system.platform import IS_LINUX, NAME

if TYPE_CHECKING:
    from envhub_sandbox.extras.packages.locks.lockfile import LockFile
    from envhub_sandbox.extras.packages.request import Choice
    from envhub_sandbox.hub.snapshot import Snapshot

Output = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="The file; by default pylock.NAME.toml in this folder, or beside what is locked if "
        "that is this folder.",
    ),
]
NoSpaces = Annotated[
    bool, typer.Option("--no-spaces", help="Run nothing, and leave the environments' spaces out.")
]


@opt.with_options("dependencies", "env_kwargs", "assets", *opt.SOURCE)
def lock(
    *,
    context: typer.Context,
    ref: Annotated[
        str | None,
        typer.Argument(
            metavar="REF",
            help="What to lock, a hub reference or a folder; with --check what to compare, by "
            "default the locked commit.",
        ),
    ] = None,
    check: Annotated[
        Path | None,
        typer.Option(
            "--check",
            metavar="FILE",
            help="Compare with this lock file instead; exit code 7 if something differs.",
        ),
    ] = None,
    no_index: Annotated[
        bool,
        typer.Option("--no-index", help="With --check: do not ask the package index for files."),
    ] = False,
    output: Output = None,
    upgrade: Annotated[
        bool,
        typer.Option(
            "--upgrade", help="Choose versions again, and show what differs from the file."
        ),
    ] = False,
    no_spaces: NoSpaces = False,
    json: opt.Json = False,
    make: opt.MakeOptions,
) -> None:
    """Record commit, file hashes, packages, Python and spaces in a file for make_env(lock=FILE);
    with --check, compare a repository with one.

    It installs the packages in a separate environment, and loads the repository in the sandbox to
    record its spaces. With --check it writes nothing, and compares files, the index's files of
    each package, Python and spaces; a branch as REF shows whether it has changed, and for a locked
    folder REF is required.

    [bold]envhub lock --check pylock.NAME.toml[/bold]
    """
    _check_platform()
    _check_options(context, is_check=check is not None)
    if check is not None:
        _verify(check, ref, make, no_spaces=no_spaces, no_index=no_index, json=json)
        return
    if ref is None:
        raise UsageError("name what to lock: envhub lock REF")
    with ProgressBar(quiet=json) as bar:
        bar.begin(f"locking {ref}")
        from envhub_sandbox.extras.packages.locks import lockfile, making

        snapshot = make.snapshot(ref)
        path = _path(output, snapshot)
        old = _old(path, upgrade)
        snapshot = make.snapshot_with_assets(ref, () if old is None else old.assets)
        choice = _choice(make["dependencies"], old)
        written = making.locked(snapshot, choice, upgrade=upgrade)
        if not no_spaces:
            kwargs = make["env_kwargs"]
            if not kwargs and old is not None and old.spaces is not None:
                kwargs = opt.read_env_kwargs([old.spaces.arguments])
            written = _with_spaces(written, snapshot, kwargs, make.source)
        changes = [] if old is None else making.differences(old, written)
        lockfile.write(written, path)
    _print(path, written, changes, old is not None, as_json=json)


def _verify(
    file: Path,
    ref: str | None,
    make: opt.MakeOptions,
    *,
    no_spaces: bool,
    no_index: bool,
    json: bool,
) -> None:
    """``--check``: compare files, the index's files of each package, Python and spaces."""
    with ProgressBar(quiet=json) as bar:
        bar.begin(f"verifying {file}")
        from envhub_sandbox.extras.packages import interpreters
        from envhub_sandbox.extras.packages.locks import lockfile, making

        locked = lockfile.read(file)
        reference = ref or lockfile.reference_of(locked)
        if reference is None:
            raise UsageError(f"{file} locks a folder; name it: envhub lock --check {file} ./FOLDER")
        if ref is None:  # the reference is the lock's, which may be a stranger's
            make.snapshot(reference, public=True)
        snapshot = make.snapshot_with_assets(reference, locked.assets)
        runner = lockfile.Runner.of(interpreters.find(locked.runner.python))
        now = replace(making.with_files(locked, snapshot), runner=runner)
        if not no_index:
            now = replace(now, packages=making.relisted(locked).packages)
        if not (no_spaces or locked.spaces is None or making.differences(locked, now)):
            kwargs = opt.read_env_kwargs([locked.spaces.arguments])
            now = _with_spaces(locked, snapshot, kwargs, make.source)
        differing = making.differences(locked, now)
    if json:
        print_json({"lock": str(file), "reference": snapshot.label, "drift": differing})
    making.refuse(differing, snapshot.label)
    if not json:
        say(f"{snapshot.label} is as it was locked in {file}.", GOOD)


def _check_options(context: typer.Context, *, is_check: bool) -> None:
    """Raise ``UsageError`` for an option that would have no effect."""
    of_a_new_lock = {"output", "upgrade", "dependencies", "env_kwargs", "assets"}
    idle = of_a_new_lock if is_check else {"no_index"}
    for parameter in context.command.params:
        if parameter.name in idle and opt.is_typed(context, parameter.name):
            why = "--check writes nothing" if is_check else "it needs --check FILE"
            raise UsageError(f"{parameter.opts[0]} means nothing here: {why}")


def _check_platform() -> None:
    """Raise ``SandboxUnavailableError``: no interpreter of this platform can be locked."""
    if not IS_LINUX:
        raise SandboxUnavailableError(
            f"envhub lock is for --sandbox process, which needs Linux, and this is {NAME}: run "
            "this on a Linux machine, or in a container of one. With --sandbox docker an image is "
            "locked by its digest, and with --sandbox tcp://HOST:PORT the server's operator "
            "chooses the packages"
        )


def _path(output: Path | None, snapshot: Snapshot) -> Path:
    if output is None:
        name = re.sub(r"[^A-Za-z0-9_-]+", "-", Path(snapshot.repo_id).name).strip("-") or "env"
        output = Path(f"pylock.{name}.toml")
        if _is_inside(Path.cwd(), snapshot):  # a lock file inside would be locked itself
            output = Path(snapshot.repo_id).parent / output
    path = Path(os.path.abspath(output))
    if _is_inside(path.parent, snapshot):
        raise UsageError(
            f"{path} would be inside the folder that it locks; name another place: --output FILE"
        )
    return path


def _is_inside(folder: Path, snapshot: Snapshot) -> bool:
    folder = folder.resolve()
    return snapshot.is_local and Path(snapshot.repo_id).resolve() in (folder, *folder.parents)


def _old(path: Path, upgrade: bool) -> LockFile | None:
    if not path.exists():
        return None
    if not upgrade:
        raise UsageError(
            f"{path} exists. 'envhub lock --upgrade REF' chooses versions again and shows what "
            "differs; 'envhub lock --check FILE' compares it with the repository"
        )
    from envhub_sandbox.extras.packages.locks import lockfile

    return lockfile.read(path)


def _choice(given: Any, old: LockFile | None) -> Choice:
    from envhub_sandbox.extras.packages.locks import making
    from envhub_sandbox.extras.packages.request import chosen

    if given == "auto":
        return chosen({}, None)[0] if old is None else making.again(old)
    if not isinstance(given, dict):
        raise UsageError(
            "a lock always has an environment of its own; --dependencies takes auto or a JSON "
            "object"
        )
    return chosen(given, None)[0]


def _with_spaces(
    made: LockFile, snapshot: Snapshot, env_kwargs: dict[str, Any], hub: dict[str, Any]
) -> LockFile:
    """Adds the spaces that the repository returns in the sandbox, with the packages of the lock."""
    from envhub_sandbox.extras.packages.locks import lockfile, making
    from envhub_sandbox.factory.make_env import make_env

    with tempfile.TemporaryDirectory(prefix="envhub-lock-") as folder:
        path = Path(folder, "pylock.toml")
        lockfile.write(replace(made, spaces=None), path)
        with make_env(snapshot.reference, env_kwargs=env_kwargs, lock=path, **hub) as suites:
            arguments = lockfile.arguments_text(env_kwargs)
            if arguments is None:
                raise LockError("env_kwargs have values that a lock cannot record")
            return replace(made, spaces=lockfile.Spaces(arguments, making.tasks_of(suites)))


def _print(
    path: Path, made: LockFile, changes: list[str], was_there: bool, *, as_json: bool
) -> None:
    from envhub_sandbox.extras.packages.locks import lockfile

    if as_json:
        document = {"lock": str(path), "reference": lockfile.reference_of(made)}
        document |= {"commit": made.commit, "python": str(made.runner)}
        packages = [f"{package.name}=={package.version}" for package in made.packages]
        print_json({**document, "packages": packages, "changes": changes})
        return
    for line in changes:
        out(safe_line(line, 500))
    if was_there and not changes:
        say("Nothing has changed.", GOOD)
    show("files", len(made.files))
    show("packages", f"{len(made.packages)}, for {made.runner}")
    out(f"wrote {safe_line(path)}")
