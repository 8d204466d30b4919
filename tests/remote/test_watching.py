"""What a worker on another host prints comes here, and a death there leaves its bundle here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from envhub_sandbox import errors
from tests.remote.listening import Listening
from tests.support.command_line import envhub
from tests.support.samples import sample
from tests.support.started import started


def test_output_and_bundle_of_a_death_on_another_host(server: Listening, tmp_path: Path) -> None:
    """The file has the last words; the replay, on this host, dies in the same way."""
    path, crashes = tmp_path / "worker.log", tmp_path / "crashes"
    with started(
        sample("faulty"),
        n_envs=2,
        env_kwargs={"moment": "step", "fault": "exit"},
        sandbox=server.sandbox(),
        policy={"output": str(path), "crash_folder": str(crashes)},
    ) as env:
        env.step(np.array([0, 0]))
        with pytest.raises(errors.WorkerDiedError) as caught:
            env.step(np.array([0, 1]))
    assert path.read_text() == "about to exit\n"
    done = envhub("replay", str(caught.value.bundle))
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("exit (exit code 7), at request 3 (step 2)") == 2
    assert "sandbox" in done.stderr
