"""Remembers what a pinned repository's ``make_env`` returned, so the next call starts no process.

An entry is the worker's own message, and is read as suspiciously as when it came: whatever cannot
be read is a miss. The key holds everything that the manifest may depend on.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
from pathlib import Path

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.settings.policy import Policy
from envhub_sandbox.system import folders
from envhub_sandbox.system.folders import write_whole_file
from envhub_sandbox.transport.shard_trials import ShardTrials
from envhub_sandbox.transport.values import pickles
from envhub_sandbox.transport.values.generators import generator
from envhub_worker import protocol
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import encode
from envhub_worker.protocol.manifest.manifest import Manifest, decode_manifest
from envhub_worker.protocol.runtime import Runtime
from envhub_worker.protocol.stream import StreamReader, pack_packet

_FORMAT = 1


class ManifestCache:
    """One entry of the cache; its ``key`` is None for what must not be remembered."""

    def __init__(self, folder: Path, key: str | None) -> None:
        self._path = None if key is None else folder / key

    def shard_trials(self, lane: str) -> ShardTrials:
        """What steps of the environments took by this lane, which lies beside the entry."""
        path = None if self._path is None else self._path.with_suffix(f".{lane}-shards")
        return ShardTrials(path)

    def load(self, *, max_elements: int) -> Manifest | None:
        """The remembered manifest, if there is one that can be read."""
        if self._path is None:
            return None
        try:
            if not folders.is_ours_alone(self._path.parent):
                return None
            [packet] = StreamReader().feed(self._path.read_bytes())
            message = m.unpack(packet.frames)
            if isinstance(message, m.LoadDone):
                return decode_manifest(
                    message.manifest, max_elements=max_elements, generator=generator
                )
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EnvHubError):
            self.forget()
        return None

    def save(self, value: dict[str, object]) -> None:
        """Remember a manifest. A cache that cannot be written is no error."""
        if self._path is None:
            return
        data = b"".join(map(bytes, pack_packet(1, m.pack(m.LoadDone(value)))))
        with contextlib.suppress(OSError):
            folders.make_private(self._path.parent)
            write_whole_file(self._path, data)

    def forget(self) -> None:
        """Drop the entry."""
        if self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)


def manifest_key(snapshot: Snapshot, load: m.Load, policy: Policy, runtime: Runtime) -> str | None:
    """The entry's name; None if an argument has no form that can be compared.

    Pickles of equal values may differ (the order of a set of texts does in each process): that is
    a miss, and no harm.
    """
    try:
        arguments = b"".join(map(bytes, m.pack(load, pickler=pickles.lasting)))
    except (EnvHubError, TypeError):
        return None
    facts = (
        *(_FORMAT, m.VERSION, _stamp(Path(protocol.__file__).parent.parent)),
        *(snapshot.repo_type, snapshot.repo_id, snapshot.commit, snapshot.path),
        [copy[:3] for copy in snapshot.hub_copies],
        *(policy.profile, policy.network, policy.readable, policy.gpu, policy.environment),
        policy.display,
        policy.record_denials,  # where it is refused nothing is remembered that says it is not
        *_facts_of(runtime.python or sys.executable, runtime.packages),
    )
    digest = hashlib.sha256(arguments)
    digest.update(repr(facts).encode())
    digest.update(b"".join(map(bytes, encode([os.environ.get(n) for n in policy.environment]))))
    return digest.hexdigest()


def _facts_of(python: str, packages: str) -> tuple[object, ...]:
    """The interpreter, and when packages were last installed into it."""
    prefix = Path(python).parent.parent
    own = sorted(prefix.glob("lib/python3*/site-packages"))
    folders = [Path(packages)] if packages else own
    return (python, _stamp(Path(python)), *((str(path), _stamp(path)) for path in folders))


def _stamp(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
