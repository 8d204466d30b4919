"""Deaths, what was printed before them, and idleness on another host: as here."""

from pathlib import Path

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.sandboxes.process import remove_stale, stale_folders
from tests.faults.mortal import EXIT, LIVE, comes_off
from tests.faults.remains.traces import temporary_root
from tests.remote.listening import Listening, listening
from tests.support.command_line import envhub
from tests.support.processes import eventually
from tests.support.repositories import write_repository
from tests.support.samples import sample
from tests.support.started import started


def test_what_dies_over_there_comes_back(server: Listening) -> None:
    """The rows of the dead are fresh and truncated; the others' results have crossed."""
    policy = {"restart": "transparent", "crash_history": 0}
    with started(
        sample("mortal"),
        n_envs=2,
        use_async_envs=True,
        num_workers=2,
        policy=policy,
        sandbox=server.sandbox(),
    ) as env:
        observation, _, _, truncated, info = env.step([LIVE, EXIT])
        assert (observation[:, 1].tolist(), truncated.tolist()) == ([1, 0], [False, True])
        assert np.array_equal(info["worker_restarted"], truncated)
        env.step([LIVE, LIVE])
        assert env.step([LIVE, LIVE])[0][:, 1].tolist() == [3, 1]
    assert eventually(lambda: server.jails() == 0)


def test_what_a_jail_was_denied_over_there_is_told(server: Listening, tmp_path: Path) -> None:
    """Where it is dead, too; the control is the same where nothing is recorded."""
    text = "import ctypes, os\nctypes.CDLL(None).socket(2, 1, 0)\nos.kill(os.getpid(), 9)\n"
    folder = write_repository(tmp_path / "walk", text)
    for recorded, denied in ((True, ("socket AF_INET",)), (False, None)):
        policy = {"record_denials": recorded, "crash_history": 0}
        with pytest.raises(WorkerDiedError, match="SIGKILL") as raised:
            make_env(str(folder), policy=policy, sandbox=server.sandbox())
        assert raised.value.denied == denied


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
        with pytest.raises(WorkerDiedError) as caught:
            env.step(np.array([0, 1]))
    assert path.read_text() == "about to exit\n"
    done = envhub("replay", "--grant", str(caught.value.bundle), code=0)
    assert done.stdout.count("request 3, step 2: exit (exit code 7)\n") == 2
    assert "sandbox" in done.stderr


def test_idle_jails_end_over_there(server: Listening) -> None:
    with started(sample("mortal"), timeouts={"idle_s": 0.5}, sandbox=server.sandbox()) as env:
        assert eventually(lambda: server.jails() == 0)
        with pytest.raises(WorkerDiedError, match="idle"):
            env.step([LIVE])

        def play() -> None:
            env.reset(seed=1)
            assert env.step([LIVE])[0][:, 1].tolist() == [1]

        # who is held up for longer than that between the two is idle again
        assert eventually(lambda: comes_off(play))


def test_a_killed_server_leaves_nothing_that_nobody_finds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its folder is told from a living one's by a lock; ``gc``, or the next server, removes it."""
    left = set[Path]()
    with temporary_root() as place:
        monkeypatch.setenv("TMPDIR", str(place))
        for _ in range(2):
            with listening(tmp_path / "server") as server:
                mine = set(place.iterdir())
                assert len(mine) == 1
                assert not mine & left
                assert list(stale_folders(place)) == []
                server.process.kill()
                server.process.wait()
                assert eventually(lambda: set(stale_folders(place)) == mine)  # noqa: B023
                left = mine
        assert set(remove_stale()) >= left
        assert list(place.iterdir()) == []
