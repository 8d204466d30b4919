"""Repositories of git on loopback, served by git's own program for that."""

import os
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from tests.support.ports import QuietHandler, serving

_SETTINGS = ("-c", "safe.directory=*", "-c", "uploadpack.allowFilter=true")  # as GitHub has it
_OURS = {
    "GIT_CONFIG_GLOBAL": os.devnull,
    "GIT_CONFIG_NOSYSTEM": "1",
    **{
        f"GIT_{who}_{what}": value
        for who in ("AUTHOR", "COMMITTER")
        for what, value in (
            ("NAME", "Test"),
            ("EMAIL", "test@example.org"),
            ("DATE", "2026-01-02T00:30:00+02:00"),
        )
    },
}


def git(folder: Path, *arguments: str, given: str | None = None) -> str:
    """Run git in a folder, without this user's settings, and return what it printed."""
    done = subprocess.run(
        ["git", *arguments],
        input=given,
        cwd=folder,
        env=os.environ | _OURS,
        check=True,
        capture_output=True,
        text=True,
    )
    return done.stdout.strip()


def make_repository(folder: Path, files: Mapping[str, str]) -> str:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    git(folder, "init", "--quiet", "--initial-branch=main", ".")
    return commit(folder)


def commit(folder: Path) -> str:
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message=x")
    return git(folder, "rev-parse", "HEAD")


@contextmanager
def git_served(
    root: Path, rewritten: Callable[[bytes], bytes] = lambda body: body
) -> Iterator[str]:
    """Serve the repositories in a folder; gives the URL that their names follow.
    ``rewritten`` is what a lying server makes of a request before it answers."""

    class Handler(QuietHandler):
        def do_GET(self) -> None:
            path, _, query = self.path.partition("?")
            body = rewritten(self.rfile.read(int(self.headers.get("Content-Length") or 0)))
            asked = {
                "GIT_PROJECT_ROOT": str(root),
                "GIT_HTTP_EXPORT_ALL": "1",
                "PATH_INFO": path,
                "QUERY_STRING": query,
                "REQUEST_METHOD": self.command,
                "CONTENT_TYPE": self.headers.get("Content-Type", ""),
                "CONTENT_LENGTH": str(len(body)),
                "HTTP_CONTENT_ENCODING": self.headers.get("Content-Encoding", ""),
                "GIT_PROTOCOL": self.headers.get("Git-Protocol", ""),
            }
            answer = subprocess.run(
                ["git", *_SETTINGS, "http-backend"],
                input=body,
                env=os.environ | _OURS | asked,
                stdout=subprocess.PIPE,
                check=True,
            ).stdout
            head, _, found = answer.partition(b"\r\n\r\n")
            fields = dict(line.split(": ", 1) for line in head.decode().splitlines())
            self.send_response(int(fields.pop("Status", "200")[:3]))
            for name, value in fields.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(found)))
            self.end_headers()
            self.wfile.write(found)

        do_POST = do_GET

    with serving(Handler) as where:
        yield where


def ran(program: Path) -> bool:
    """Whether a program that leaves a mark beside it has run, since this was asked last."""
    mark = program.parent / "ran"
    found = mark.exists()
    mark.unlink(missing_ok=True)
    return found
