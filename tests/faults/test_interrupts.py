"""Ctrl-C or ``close`` at the worst moment: everything is given back, and what is told is true."""

from __future__ import annotations

from typing import Any

import pytest

from envhub_sandbox import make_env, remote_env
from envhub_sandbox.remote_env import RemoteEnv
from envhub_worker.protocol.lifecycle import State
from tests.support.samples import sample

pytestmark = pytest.mark.usefixtures("neighbour")

lanes = pytest.mark.parametrize("lane", ["auto", "frames"])


def made(lane: str = "auto", **options: Any) -> Any:
    """Two sub-environments, of which the last hangs when it is told to; reset."""
    fails = options.pop("fails", {"moment": "step", "fault": "hang"})
    suites = make_env(sample("faulty"), n_envs=2, lane=lane, env_kwargs=fails, **options)
    suites.env.reset()
    return suites


def interrupted(*arguments: Any, **options: Any) -> Any:
    """In place of whatever takes so long that somebody loses patience."""
    raise KeyboardInterrupt


def released(remote: RemoteEnv) -> list[bool]:
    """Have the environment hold its server; what is returned says when it has let it go."""
    found: list[bool] = []
    give_back = remote.repository.hold()

    def release() -> None:
        give_back()
        found.append(True)

    remote._release_server = release
    return found


@lanes
def test_a_second_ctrl_c_in_recovery_leaves_a_usable_environment(
    lane: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The jail that was given up is given back, and the next reset has another."""
    monkeypatch.setattr(remote_env, "_GRACE_S", 0.05)
    with made(lane, timeouts={"step_s": 0.05}) as suites:
        env, remote = suites.env, suites.env._remote
        with pytest.raises(TimeoutError):
            env.step([0, 1])
        first = remote._loaded
        with monkeypatch.context() as patch:
            patch.setattr(remote._jails, "end", interrupted)
            with pytest.raises(KeyboardInterrupt):
                env.reset()
        assert first.closed
        assert remote.lifecycle.state is State.LATE
        env.reset()
        assert remote._loaded is not first
        assert env.render() is not None


@lanes
@pytest.mark.parametrize("owner", ["jail", "book"])
def test_ctrl_c_in_close_leaves_nothing(
    lane: str, owner: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the repository's ``close`` is waited for, or the pace noted; it can be repeated."""
    suites = made(lane)
    env, remote = suites.env, suites.env._remote
    loaded, release = remote._loaded, released(remote)
    if owner == "jail":
        monkeypatch.setattr(loaded.jail, "receive", interrupted)
    else:
        monkeypatch.setattr(remote, "_note_pace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        env.close()
    assert loaded.closed
    assert (remote._lane, release) == (None, [True])
    suites.close()
