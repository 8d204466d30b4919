"""What the runner hears of warnings: each text once, bounded, fit to be printed. What a runner
watches: plain values of plain attributes; and that nothing changes unnoticed."""

import io
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages.prefix import CHANGES, WARNINGS
from envhub_worker.runner.prefixes import WarningLog, Watches
from envhub_worker.runner.sync_envs import SubEnvs
from tests.support.command_line import python

REPLY = m.pack(m.Value(1))


@pytest.fixture
def heard() -> Iterator[WarningLog]:
    """Somebody who listens; afterwards nobody does."""
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        one = WarningLog()
        with pytest.MonkeyPatch.context() as patch:  # and shows nothing
            patch.setattr(warnings, "showwarning", lambda *_: None)
            one.listen()
            yield one


def test_each_text_is_heard_once(heard: WarningLog) -> None:
    for _ in range(3):
        warnings.warn("slow", stacklevel=1)
    other = threading.Thread(target=warnings.warn, args=("slow", RuntimeWarning))
    other.start()
    other.join()
    assert heard.pending == [("UserWarning", "slow"), ("RuntimeWarning", "slow")]


def test_what_is_shown_is_shown_still() -> None:
    """It stands in what the jail prints; what goes to a file of its own is nobody else's."""
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        shown: list[str] = []
        patch.setattr(warnings, "showwarning", lambda message, *_: shown.append(str(message)))
        heard = WarningLog()
        heard.listen()
        warnings.showwarning("printed", UserWarning, "env.py", 1)
        warnings.showwarning("elsewhere", UserWarning, "env.py", 1, io.StringIO())
    assert shown == ["printed", "elsewhere"]
    assert heard.pending == [("UserWarning", "printed")]


def test_what_has_no_text_is_not_heard(heard: WarningLog) -> None:
    class Mute(UserWarning):
        def __str__(self) -> str:
            raise ValueError("no")

    warnings.showwarning(Mute(), Mute, "env.py", 1)
    assert heard.pending == []


def test_a_flood_is_bounded(heard: WarningLog) -> None:
    for number in range(2000):
        warnings.showwarning(f"{number} " + "\x1b" * 5000, UserWarning, "env.py", 1)
    told = []
    while heard.pending:
        frames = heard.in_front(REPLY)
        assert frames[1:] == REPLY
        told.append(WARNINGS.read(frames)[0])
    assert {len(some) for some in told} == {WARNINGS.most}
    assert len(told) < 100
    assert all(text.isprintable() or "\n" in text for some in told for _, text in some)
    assert heard.in_front(REPLY) == REPLY


ENV = 7


class Told(gym.Env[Any, Any]):
    """Attributes of every kind."""

    observation_space = gym.spaces.Discrete(2)
    action_space = gym.spaces.Discrete(2)
    shared = "of the class"

    def __init__(self) -> None:
        self.task = "reach"
        self.number = 1000
        self.nothing = None
        self.weight = 0.5
        self.place = np.zeros(2)
        self.several = ("a", "b")
        self.looked = 0

    @property
    def counted(self) -> int:
        self.looked += 1
        return 1

    def method(self) -> str:
        return "called"


class Curious(gym.Wrapper[Any, Any, Any, Any]):
    """Has a say in what its attributes are."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(name)


class Answering(gym.Wrapper[Any, Any, Any, Any]):
    """Searches by itself."""

    def get_wrapper_attr(self, name: str) -> Any:
        return super().get_wrapper_attr(name)


def watching(*, alone: bool = True) -> Watches:
    """Whose process is alone: that of a test seldom is."""
    return Watches(lambda: alone)


def envs_of(make: Callable[[], Any] = Told) -> SubEnvs:
    return SubEnvs([make, make], "NextStep", sync=True)


def begun(envs: SubEnvs, name: str, watches: Watches | None = None) -> bool:
    return (watches or watching()).begin(ENV, envs, name, envs.call(name))


def noticed(watches: Watches) -> list[str]:
    watches.look()
    frames = watches.in_front(REPLY)
    if frames == REPLY:
        return []
    assert frames[1:] == REPLY
    return [name for number, name in CHANGES.read(frames)[0] if number == ENV]


@pytest.mark.parametrize("name", ["task", "number", "nothing", "shared"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_plain_values_are_watched(name: str, wrapped: bool) -> None:
    assert begun(envs_of(lambda: gym.wrappers.TimeLimit(Told(), 5) if wrapped else Told()), name)


@pytest.mark.parametrize("name", ["weight", "place", "several", "counted", "method", "np_random"])
def test_other_values_are_not(name: str) -> None:
    """Neither those that change from within, nor those whose reading runs something."""
    envs = envs_of()
    assert not begun(envs, name)
    looked = [env.unwrapped.looked for env in envs.envs]
    assert looked == [int(name == "counted")] * 2  # by the call alone


@pytest.mark.parametrize("wrapper", [Curious, Answering])
def test_who_has_a_say_is_not_watched(wrapper: Any) -> None:
    assert not begun(envs_of(lambda: wrapper(Told())), "task")
    assert not begun(envs_of(lambda: gym.Wrapper(wrapper(Told()))), "task")
    assert not watching().begin(ENV, envs_of(lambda: wrapper(Told())), "absent", None)
    assert watching().begin(ENV, envs_of(lambda: gym.Wrapper(Told())), "absent", None)
    assert not watching().begin(ENV, envs_of(lambda: gym.Wrapper(Told())), "counted", None)


_WITH_A_THREAD = """
import threading
from envhub_worker.runner.prefixes import is_alone
print(is_alone())
threading.Thread(target=threading.Event().wait, daemon=True).start()
print(is_alone())
"""


def test_threads_are_seen() -> None:
    """In a process of its own: that of a test has threads and handlers of signals."""
    assert python("-c", _WITH_A_THREAD).stdout.split() == ["True", "False"]


def test_a_process_with_threads_is_not_watched() -> None:
    assert not begun(envs_of(), "task", watching(alone=False))
    alone = [True]
    envs, watches = envs_of(), Watches(lambda: alone[0])
    assert begun(envs, "task", watches)
    alone[0] = False
    assert noticed(watches) == ["task"]


@pytest.mark.parametrize(
    "change",
    [
        lambda env: setattr(env, "number", 1000.0),
        lambda env: delattr(env.env, "number"),
        lambda env: setattr(env, "number", 5),
        lambda env: setattr(type(env.env), "number", property(lambda _: 3)),
    ],
    ids=["another type", "gone", "hidden by the wrapper", "a property now"],
)
def test_changes_of_other_kinds_are_noticed(change: Callable[[Any], None]) -> None:
    """Once: what has changed is watched no more."""

    class Own(Told):
        pass

    envs, watches = envs_of(lambda: gym.Wrapper(Own())), watching()
    assert begun(envs, "number", watches)
    assert noticed(watches) == []
    change(envs.envs[0])
    assert [noticed(watches) for _ in range(2)] == [["number"], []]


def test_watches_are_few() -> None:
    envs, watches = envs_of(), watching()
    for number in range(2 * CHANGES.most):
        assert watches.begin(number, envs, "task", envs.call("task")) == (number < CHANGES.most)
    envs.envs[0].task = "lift"
    watches.look()
    for number in range(2 * CHANGES.most):
        watches.forget(number)
    assert (watches.readings, watches.changed) == ({}, {})


def test_a_reply_without_room_takes_nothing_along() -> None:
    envs, watches = envs_of(), watching()
    assert begun(envs, "task", watches)
    envs.envs[0].task = "lift"
    watches.look()
    full = REPLY * DEFAULT_LIMITS.frames
    assert watches.in_front(full) == full
    assert noticed(watches) == ["task"]
