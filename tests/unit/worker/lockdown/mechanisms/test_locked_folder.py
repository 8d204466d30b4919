"""What servers that were killed have left is removed, and nothing else."""

import os
from pathlib import Path

from envhub_worker.lockdown.mechanisms.locked_folder import LockedFolder, remove_deserted


def test_only_folders_of_ours_that_nobody_holds_are_removed(tmp_path: Path) -> None:
    held = LockedFolder("envhub-", tmp_path)
    for name in ("envhub-deserted", "envhub-noguards", "another", "envhub-foreign1"):
        (tmp_path / name).mkdir()
        if name != "envhub-noguards":
            (tmp_path / name / "lock").touch()
    (tmp_path / "envhub-alinked1").symlink_to("another")
    foreign = {"envhub-foreign1"} if os.geteuid() == 0 else set()
    for name in foreign:
        os.chown(tmp_path / name, 65534, 65534)
    remove_deserted(tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {held.path.name, "envhub-noguards", "another", "envhub-alinked1", *foreign}
    assert (tmp_path / "another" / "lock").exists()
    held.remove()
    assert not held.path.exists()
