"""Warnings of a hostile repository: a flood, giants, escape sequences; and a worker that lies."""

import contextlib
import importlib.util
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError, RemoteEnvWarning, RemoteProtocolError
from envhub_sandbox.transport.remote_warnings import MOST
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.messages.prefix import MAX_TEXT, WARNINGS
from tests.attacks.client.lying_server import (
    NUM_ENVS,
    Asked,
    Frames,
    LyingSandbox,
    lying,
    step_done,
)
from tests.attacks.output.painting import ESCAPES, paints
from tests.attacks.repositories import write_environment
from tests.support.repositories import write_repository

STEPS = 40
EACH = 25
GIANT = 1_000_000
_ENV = f"""
import warnings

EVIL = {ESCAPES!r}
Evil = type("Evil" + EVIL, (UserWarning,), {{}})

class Flooder(Plain):
    count = 0

    def step(self, action):
        for _ in range({EACH}):
            Flooder.count += 1
            text = str(Flooder.count) + EVIL + "x" * {GIANT} * (Flooder.count == 3)
            warnings.warn_explicit(text, Evil, "/etc/passwd", 1, "sys")
        return super().step(action)
"""


def told_by(make: Callable[[], Any]) -> list[warnings.WarningMessage]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        # of what earlier tests left open, whenever the collector comes upon it
        warnings.simplefilter("ignore", ResourceWarning)
        env = make()
        env.reset()
        for _ in range(STEPS):
            env.step(np.zeros(1, np.int64))
        env.close()
    return told


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_a_flood_of_warnings_is_small_plain_and_ours(home: Path, lane: str) -> None:
    """Here they flood, paint, and name a file, of which Python shows a line; there none does."""
    folder = write_environment(home / "flooder", _ENV)
    spec = importlib.util.spec_from_file_location("flooder", folder / "env.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    control = told_by(module.make_env)
    assert len(control) == STEPS * EACH
    assert all(paints(str(one.message)) for one in control)
    assert paints(control[0].category.__name__)
    assert max(len(str(one.message)) for one in control) > GIANT
    assert {one.filename for one in control} == {"/etc/passwd"}
    told = told_by(lambda: make_env(str(folder), policy={"lane": lane}).env)
    assert 0 < len(told) <= MOST + 1
    assert {one.category for one in told} == {RemoteEnvWarning}
    assert not [one for one in told if paints(str(one.message))]
    assert max(len(str(one.message)) for one in told) < 5000
    assert {one.filename for one in told} == {__file__}


LIES: dict[str, object] = {
    "too many": (("UserWarning", "x"),) * (WARNINGS.most + 1),
    "a giant": (("UserWarning", "x" * 4_000_000),),
    "a long one": (("UserWarning", "x" * (MAX_TEXT + 1)),),
    "no text": (("UserWarning", 1),),
    "an array": (("UserWarning", np.zeros(10_000)),),
    "no pairs": ("UserWarning",),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_worker_that_lies_about_warnings_is_given_up(tmp_path: Path, lie: str) -> None:
    """Its environment dies of it, as of any other lie; the control is told the truth."""
    folder = write_repository(tmp_path / "repository", f"# {tmp_path}")
    for said, breaks in ((LIES[lie], True), ((("UserWarning", "true"),), False)):
        with lying() as liar:
            liar.lies[m.Step] = _with(said)
            with (
                make_env(str(folder), sandbox=LyingSandbox(liar), n_envs=NUM_ENVS) as suites,
                contextlib.ExitStack() as expected,
            ):
                suites.env.reset()
                if breaks:
                    expected.enter_context(pytest.raises(RemoteProtocolError))
                else:
                    expected.enter_context(pytest.warns(RemoteEnvWarning, match="true"))
                suites.env.step([0] * NUM_ENVS)
            if breaks:
                assert suites.env.closed


def _with(said: Any) -> Callable[[Asked], list[Frames]]:
    frames = [*m.pack(m.Warnings(said)), *m.pack(step_done())]
    return lambda asked: [asked.answer(frames)]


def test_two_in_front_of_one_reply_are_refused(tmp_path: Path) -> None:
    folder = write_repository(tmp_path / "repository", f"# {tmp_path}")
    front = m.pack(m.Warnings((("UserWarning", "x"),)))
    with lying() as liar:
        liar.lies[m.Step] = lambda asked: [asked.answer([*front * 1000, *m.pack(step_done())])]
        with make_env(str(folder), sandbox=LyingSandbox(liar), n_envs=NUM_ENVS) as suites:
            suites.env.reset()
            # the first of them was right
            with pytest.raises(EnvHubError), pytest.warns(RemoteEnvWarning, match="x"):
                suites.env.step([0] * NUM_ENVS)
