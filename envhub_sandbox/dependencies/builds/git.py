"""The files of a commit of git as the source of a package."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from envhub_sandbox.dependencies import index
from envhub_sandbox.dependencies.builds.trees import Member, write_tree
from envhub_sandbox.errors import (
    DependencyError,
    HubReferenceError,
    IndexUnavailableError,
    PackagesTooLargeError,
    RequirementError,
    SnapshotError,
    SnapshotTooLargeError,
)
from envhub_sandbox.hub.failures import HubFailure
from envhub_sandbox.hub.git import commits
from envhub_worker.protocol.text import printable


def resolve(url: str, revision: str) -> str:
    """The full commit that a revision means now; raises ``DependencyError``."""
    with _as_of_a_package():
        return commits.resolve(url, revision, index.environment())


def check_out(url: str, commit: str, folder: Path, tell: Callable[[str], None]) -> None:
    """Write the files of a commit below a folder that is there and empty.

    Links and submodules are left out, and named to ``tell``. Raises ``DependencyError``.
    """
    title = f"{url}@{commit[:12]}"
    with _as_of_a_package(), commits.fetched(url, commit, index.environment()) as found:
        links = [blob.path for blob in found.blobs if blob.is_link]
        for path in (*links, *found.submodules):
            tell(f"{title}: {printable(path, 200)} is a link or a submodule, and is left out")
        files = [
            Member(blob.path, blob.size, blob.executable, partial(found.open, blob))
            for blob in found.blobs
            if not blob.is_link
        ]
        write_tree(files, folder, title)


@contextmanager
def _as_of_a_package() -> Iterator[None]:
    try:
        yield
    except HubReferenceError as error:
        raise RequirementError(str(error)) from error
    except HubFailure as failure:
        raise IndexUnavailableError(f"{failure.what}. {failure.advice}") from failure
    except SnapshotTooLargeError as error:
        raise PackagesTooLargeError(str(error)) from error
    except SnapshotError as error:
        raise DependencyError(str(error)) from error
