"""The jail's own cache of the Hub, so that downloads of what is here find it without a network.

It has huggingface_hub's layout: for each repository a folder with ``refs/main``, which names the
commit, and ``snapshots/COMMIT``, which is a link to the files. ``HF_HUB_OFFLINE`` (see
``lockdown.mechanisms.environment``) makes ``snapshot_download`` and ``hf_hub_download`` look there
and nowhere else.
"""

from __future__ import annotations

import contextlib
import os

from envhub_worker.lockdown.spec import JailSpec

_GRANTED = ("HF_HOME", "HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE")
"""Variables by which a caller gives another cache to the jail."""


def make_hub_cache(spec: JailSpec) -> None:
    """Lay out the cache in the jail's home. All runners of a jail make the same there."""
    if any(name in spec.confinement.environment for name in _GRANTED):
        return
    for copy in spec.hub_copies:
        folder = f"{os.environ['HF_HOME']}/hub/{copy.folder}"
        for revision in copy.revisions:
            _write(f"{folder}/refs/{revision}", copy.commit)
        os.makedirs(f"{folder}/snapshots", exist_ok=True)
        with contextlib.suppress(FileExistsError):
            os.symlink(copy.tree or spec.snapshot, f"{folder}/snapshots/{copy.commit}")


def _write(path: str, text: str) -> None:
    os.makedirs(os.path.dirname(path), exist_ok=True)
    draft = f"{path}.{os.getpid()}.draft"
    with open(draft, "w") as file:
        file.write(text)
    os.replace(draft, path)
