"""A real Hub on loopback: git repositories of our own, served by olah to the real client.
olah serves branches without ``/``, tags, short and full commits, models, spaces, datasets and
LFS. It answers everything that it does not find with 401 RepoNotFound; errors of other kinds
are ``stub_hub``'s part."""

import hashlib
import re
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from tests.support.packages.git_server import git
from tests.support.ports import lasting_port

_CONFIG = """
[basic]
host = "127.0.0.1"
port = {port}
repos-path = "{home}/cache"
mirrors-path = ["{home}/mirrors"]

[accessibility]
offline = true
"""


class GitRepository:
    """A git repository with commits, branches, tags and LFS objects."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True)
        self.git("init", "--quiet", "--initial-branch=main")

    def git(self, *arguments: str) -> str:
        return git(self.folder, *arguments)

    def commit(
        self,
        files: Mapping[str, str | bytes],
        *,
        lfs: Mapping[str, bytes] | None = None,
        branch: str | None = None,
        tag: str | None = None,
    ) -> str:
        """Write files, commit them, and return the full commit; ``lfs`` ones as LFS objects."""
        if branch is not None:
            self.git("checkout", "--quiet", "-B", branch)
        pointers = {path: self._store_lfs(content) for path, content in (lfs or {}).items()}
        for path, content in {**files, **pointers}.items():
            target = self.folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content.encode() if isinstance(content, str) else content)
        self.git("add", "--all")
        self.git("commit", "--quiet", "--message", "a commit")
        if tag is not None:
            self.git("tag", tag)
        if branch is not None:
            commit = self.git("rev-parse", "HEAD")
            self.git("checkout", "--quiet", "main")
            return commit
        return self.git("rev-parse", "HEAD")

    def _store_lfs(self, content: bytes) -> str:
        oid = hashlib.sha256(content).hexdigest()
        target = self.folder / ".git" / "lfs" / "objects" / oid[:2] / oid[2:4] / oid
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
        return (
            f"version https://git-lfs.github.com/spec/v1\noid sha256:{oid}\nsize {len(content)}\n"
        )


class OlahServer:
    """An olah process. ``endpoint`` is what huggingface_hub takes."""

    def __init__(self, home: Path, python: str = sys.executable) -> None:
        self.home = home
        self._log = home / "requests.log"
        port = lasting_port()
        self.endpoint = f"http://127.0.0.1:{port}"
        config = home / "olah.toml"
        config.write_text(_CONFIG.format(port=port, home=home))
        command = [python, "-m", "olah.server", "--config", str(config)]
        command += ["--log-path", str(home / "logs")]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=home
            )
        self._wait_until_ready(port)

    def repository(self, repo_id: str, repo_type: str = "model") -> GitRepository:
        return GitRepository(self.home / "mirrors" / f"{repo_type}s" / repo_id)

    def requests(self) -> list[str]:
        """Every request so far, as ``"GET /path"``."""
        lines = self._log.read_text(errors="replace")
        return [" ".join(found) for found in re.findall(r'"(GET|HEAD|POST) (\S+) HTTP', lines)]

    def stop(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _wait_until_ready(self, port: int) -> None:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and self._process.poll() is None:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
            except OSError:
                time.sleep(0.1)
            else:
                return
        self.stop()
        raise RuntimeError(f"olah did not start:\n{self._log.read_text(errors='replace')}")
