"""Single probes: what episodes leave behind, what render gives, and what LeRobot needs."""

import itertools
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.extras.judge.denials import denial_findings
from envhub_sandbox.extras.judge.play import probes
from envhub_sandbox.extras.judge.play.probes import lerobot_lacks, other_modes, wrong_frames

_MIB = 1 << 20


def seen(*rows: tuple[int, int, int, int]) -> list[probes.Usage]:
    return [{"processes": p, "threads": t, "files": f, "memory_bytes": m} for p, t, f, m in rows]


_GROWTH: dict[str, tuple[list[probes.Usage], str | None]] = {
    "level": (seen(*[(1, 0, 9, 0)] * 4), None),
    "filled once": (seen((1, 0, 9, 0), *[(9, 8, 9, 90 * _MIB)] * 3), None),
    "jitter": (seen(*((1 + n, n, 9, 1000 * n) for n in range(4))), None),
    "processes": (seen(*((1 + 8 * n, 0, 9, 0) for n in range(4))), "leaks-processes"),
    "threads": (seen(*((1, 8 * n, 9, 0) for n in range(4))), "leaks-threads"),
    "files": (seen(*((1, 0, 3 + 6 * n, 0) for n in range(4))), "leaks-files"),
    "memory": (seen(*((1, 0, 9, 2 * n * _MIB) for n in range(4))), "leaks-memory"),
    "all": (seen(*((1 + 8 * n, 8 * n, 9, 100 * n * _MIB) for n in range(4))), "leaks-processes"),
    "uncounted": ([], None),
}


@pytest.mark.parametrize(("counts", "found"), _GROWTH.values(), ids=_GROWTH)
def test_what_grows_in_every_round_is_told(counts: list[probes.Usage], found: str | None) -> None:
    """And of what comes with it nothing: a process has threads and memory of its own."""
    grew = probes.leak(counts, 8)
    assert (grew[0] if grew else None) == found


def test_nobody_who_counts_is_no_count() -> None:
    """A server on another host may be an older one: then nothing is said, not that all is well."""
    numbers = itertools.count()
    assert probes.usage_per_round(lambda: next(numbers), dict, 2, lambda what: None) == []
    assert next(numbers) == 8


FRAME = np.zeros((4, 6, 3), np.uint8)


@pytest.mark.parametrize(
    ("mode", "rendered", "said"),
    [
        ("rgb_array", (FRAME, FRAME), ""),
        ("rgb_array_list", [[FRAME], ()], ""),
        ("ansi", ("a", ""), ""),
        ("human", None, ""),
        ("rgb_array", FRAME, r"uint8 \(4, 6, 3\), not one result for each"),
        ("rgb_array", (FRAME, FRAME.astype(float)), "sub-environment 1 gave float64"),
        ("rgb_array", (FRAME[:0], FRAME), "sub-environment 0"),
        ("rgb_array_list", [[FRAME], FRAME], "sub-environment 1"),
        ("ansi", ("a", b"b"), "sub-environment 1 gave bytes"),
    ],
)
def test_frames_fit_their_mode(mode: str, rendered: Any, said: str) -> None:
    env: Any = SimpleNamespace(render_mode=mode, num_envs=2, render=lambda: rendered)
    found = list(wrong_frames(env))
    assert len(found) == bool(said)
    assert all(re.search(said, text) for text in found), found


@pytest.mark.parametrize("declared", [["ansi", "human", 3, "rgb_array"], ("rgb_array", "ansi")])
def test_modes_that_need_no_window_are_tried(declared: Any) -> None:
    env: Any = SimpleNamespace(metadata={"render_modes": declared}, render_mode="rgb_array")
    assert other_modes(env) == ["ansi"]
    assert other_modes(SimpleNamespace(metadata={"render_modes": 3}, render_mode=None)) == []


PLAYABLE = spaces.Dict({"agent_pos": spaces.Box(-1, 1, (2,), np.float32)})
VECTOR = spaces.Box(-1, 1, (2,), np.float32)


def vector(
    observations: Any = PLAYABLE, actions: Any = VECTOR, *, limited: bool = True, fps: float = 30
) -> Any:
    def get_attr(name: str) -> tuple[int, ...]:
        if not limited:
            raise AttributeError(name)
        return (100,)

    return SimpleNamespace(
        single_observation_space=observations,
        single_action_space=actions,
        get_attr=get_attr,
        metadata={"render_fps": fps},
        render_mode="rgb_array",
    )


@pytest.mark.parametrize(
    ("env", "lacking"),
    [
        (vector(VECTOR), "observations with agent_pos, environment_state or pixels, not a"),
        (vector(spaces.Dict({"image": VECTOR})), "not a Dict of image"),
        (vector(actions=spaces.Discrete(3)), r"a vector \(Box\) as action, not Discrete\(3\)"),
        (vector(actions=spaces.Box(0, 1, (2, 2))), r"not a Box of shape \(2, 2\)"),
        (vector(limited=False), "_max_episode_steps"),
        (vector(fps=20.0), r"a whole number as metadata\['render_fps'\] for its videos, not 20.0"),
    ],
)
def test_what_it_lacks_is_one_text(env: Any, lacking: str) -> None:
    """The control has state in a mapping, a vector as action, and an end, and lacks nothing."""
    assert list(lerobot_lacks(vector())) == []
    [text] = lerobot_lacks(env)
    assert text.startswith("LeRobot cannot evaluate it, which needs ")
    assert re.search(lacking, text)


# --- What of a jail's denials is worth a finding


@pytest.mark.parametrize(
    ("denied", "network", "files", "kernel", "limits"),
    [
        ((), 0, 0, 0, 0),
        (("setpriority", "mbind", "socket AF_NETLINK"), 0, 0, 0, 0),
        (("socket AF_INET", "socket AF_NETLINK_OTHER", "socket AF_PACKET"), 3, 0, 0, 0),
        (("socket AF_UNIX", "ptrace", "mount"), 0, 0, 3, 0),
        (("setpriority OTHER_PROCESS", "kill OTHER_PROCESS"), 0, 0, 2, 0),
        (("ptrace", "ptrace"), 0, 0, 1, 0),
        (("read /etc/shadow", "unlink /socket AF_INET", "sendto /run/x"), 0, 3, 0, 0),
        (("limit PROCESSES", "limit DISK_BYTES"), 0, 0, 0, 2),
        (("unlink /a OTHER_PROCESS", "read /limit PROCESSES"), 0, 2, 0, 0),
    ],
    ids=["nothing", "harmless", "network", "kernel", "others", "once", "files", "limits", "names"],
)
def test_attempts_are_sorted(
    denied: tuple[str, ...], network: int, files: int, kernel: int, limits: int
) -> None:
    found = denial_findings(denied)
    assert {check: len(texts) for check, texts in found.items()} == {
        "denied-network": network,
        "denied-files": files,
        "denied-kernel": kernel,
        "limits-reached": limits,
    }
