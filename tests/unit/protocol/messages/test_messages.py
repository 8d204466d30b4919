"""Messages: their bytes are kept, and only messages come out of bytes."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envhub_worker
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages import compression, server
from envhub_worker.protocol.messages.server import Busy
from tests.support.compare import assert_same

GOLDEN = Path(__file__).parents[2] / "golden" / "messages"
REQUEST_ID = 7
# One message of each class, with every kind of content that its fields may have.
SAMPLES: list[m.Message] = [
    m.Hello(m.VERSION, bytes(range(16)), ("lz4",)),
    m.Welcome(1, "0.1.0", 4242, "lz4", 120),
    m.Refusal("SandboxUnavailableError", "no user namespaces", "user-namespace", "sysctl ..."),
    m.OpenJail(
        *("org/repo@abc:env.py", "", "", "/s", "env.py", {"limits": {"processes": 5}}, 2),
        hub_copies=(("models--org--repo", "ab" * 20, ("main",), ""),),
    ),
    m.JailOpened(3, (1, 2), ({"layer": "seccomp", "enforced": True, "detail": "x"},)),
    m.StartRunners(3, 1),
    m.Relay(3, "step", ((1, 2), (2, 1)), stepped=True),
    m.RelayDone((2, 1), (1,)),
    m.Death(1, "signal", None, "SIGKILL", "", "last words", "step"),
    m.CloseJail(3), m.Done(), m.CheckJail(3, "call"), m.GetStatus(),
    m.Status(({"jail": 3, "name": "a", "pids": (9,), "busy_s": 0.5, "operation": "step"},)),
    m.Deposit(bytes(range(16)), 3, 1), m.OfferSnapshot((("env.py", 3, bytes(32)),)),
    m.MissingBlobs("sha256:00", (bytes(32),)), m.PutBlob(bytes(32), 4096), m.KeepAlive((3, 4)),
    m.CompressionHeader("lz4", (-1, 4096)),
    m.GetSessions(), m.KeepJail(3, True, 60_000),
    m.Sessions(({"client": "a", "session": "b", "heard_s": 0.5, "jails": ()},), {"pid": 7}),
    m.ShareSlabs(3, ((1, 2, 66_368, 256), (2, 2, 66_368, 128))),
    m.NeedPackages(
        (("scipy>=1.11", "line 1 of requirements.txt"),),
        *(">=3.10", "3.12", "", True),
        (("PyYAML", "env.py, line 1", "yaml", "pyyaml"),),
        (("numpy<3", "line 1 of held.txt"),),
        (("torch==2.5", "'torch==2.5' in dependencies"),),
        ("lerobot",),
        True,
    ),
    m.Packages("made", "00" * 20, {"lock": "sha256:00", "packages": ("scipy==1.11",)}, "made"),
    m.Load(4, True, {"task": "pick"}, {"seed": 1}, 150_000),
    m.LoadTask(4, True, {"task": "pick"}, {"seed": 1}, "suite", "task"),
    m.LoadDone({"envs": ()}),
    m.Build(1, "suite", "task", 0, 2),
    m.BuildDone({"num_envs": 2}),
    m.Reset(1, [5, None], {"key": "value"}, np.array([True, False])),
    m.ResetDone(np.zeros((2, 3), np.float32), {"a": np.array([1]), "_a": np.array([True])}),
    m.Step(1, np.array([0, 1])),
    m.StepDone(
        {"image": np.zeros((2, 1), np.uint8), "text": ("a", "b")},
        np.array([0.5, -1.0]),
        np.array([False, True]),
        np.array([False, False]),
        {},
    ),
    m.Call(1, "task", (1, "x"), {"flag": True}), m.SetAttr(1, "gravity", (9.81, None)),
    m.Render(1), m.Method(),
    m.GetRandom(1), m.SetRandom(1, (None, {"bit_generator": "PCG64"}), True),
    m.GetOne(1, 0, None, "task"), m.CallOne(1, None, 0, "add", (1, "x"), {"flag": True}),
    m.Close(1), m.Value((None, "a", 1.5)), m.Attach(1, 2, 8, 5), m.FetchInfos(1),
    m.ForgetEnds(1), m.TakeApart(1, True), m.Revive(1, [5, None], True), m.FollowOutput(3, 4096),
    m.OutputBytes(4096, b"caf\xc3\xa9\x1b"),
    m.RaisedException("KeyError", "mypkg.Oops", "gone", "Traceback ...", "step"),
    m.Warnings((("UserWarning", "slow"), ("mypkg.Own", "caf\u00e9"))),
    m.Watch(1, "task"),
    m.WatchDone(("reach", "lift"), True),
    m.Changes(((1, "task"), (2, "x"))),
]  # fmt: skip
BY_NAME = {type(message).__name__: message for message in SAMPLES}


def values_of(message: m.Message) -> dict[str, Any]:
    """The fields of a message, since arrays have no ``==`` that compares."""
    return {name: getattr(message, name) for name in message.FIELDS}


def test_every_message_has_a_sample_and_a_golden_file() -> None:
    assert set(BY_NAME) == {cls.__name__ for cls in m.KINDS.values()}
    assert {path.stem for path in GOLDEN.glob("*.hex")} == set(BY_NAME)


def test_bytes_are_golden() -> None:
    """The wire never changes by accident; ``ENVHUB_WRITE_GOLDEN=1`` writes it down anew."""
    for name, message in BY_NAME.items():
        text = "".join(bytes(frame).hex() + "\n" for frame in m.pack(message))
        path = GOLDEN / f"{name}.hex"
        if "ENVHUB_WRITE_GOLDEN" in os.environ:
            path.write_text(text)
        assert path.read_text() == text, name


def test_golden_bytes_are_read() -> None:
    for name, expected in BY_NAME.items():
        frames = [bytes.fromhex(line) for line in (GOLDEN / f"{name}.hex").read_text().split()]
        message = m.unpack(frames)
        assert type(message) is type(expected)
        assert_same(values_of(expected), values_of(message), name)


def test_a_header_is_golden() -> None:
    [frame] = m.pack_header(m.CloseJail(3), REQUEST_ID)
    assert bytes(frame).hex() == "000000000000000703000000920a03"
    assert m.id_of(memoryview(frame)) == REQUEST_ID


def test_the_id_of_a_header_that_cannot_be_read_is_known() -> None:
    [frame] = m.pack_header(m.CloseJail(3), REQUEST_ID)
    for spoiled in (bytes(frame[:8]), bytes(frame[:-1]), bytes(frame) + b"x"):
        assert m.id_of(spoiled) == REQUEST_ID
        with pytest.raises(RemoteProtocolError):
            m.unpack_header(spoiled)


@pytest.mark.parametrize(
    "start", [b"", b"\0\0\0", *(number.to_bytes(8, "big") for number in (0, 2**63))]
)
def test_an_impossible_id_is_refused(start: bytes) -> None:
    frame = start + bytes(m.pack(m.Done())[0]) if len(start) == 8 else start
    assert m.id_of(frame) is None
    with pytest.raises(RemoteProtocolError, match="not start with the id"):
        m.unpack_header(frame)


def test_a_small_payload_travels_in_the_frame_of_the_header() -> None:
    relayed, message = m.pack(m.RelayDone((1,)))[0], m.RelayDone((1,))
    [frame] = m.with_id(relayed, REQUEST_ID, [b"payload"])
    for read in (bytes(frame), memoryview(frame)):
        assert m.unpack_with_id([read]) == (REQUEST_ID, message, [b"payload"])
    [empty] = m.with_id(relayed, REQUEST_ID, [b""])
    assert m.unpack_with_id([empty]) == (REQUEST_ID, message, [b""])
    for apart in ([b"a", b"b"], [bytes(1 << 20)], []):
        assert len(frames := m.with_id(relayed, REQUEST_ID, apart)) == 1 + len(apart)
        assert m.unpack_with_id(frames) == (REQUEST_ID, message, apart)


@pytest.mark.parametrize(
    ("start", "end", "more"),
    [*((cut, b"", []) for cut in (8, 11, 12, 20)), (None, b"", [b"x"]), (None, bytes(8190), [])],
)
def test_a_joined_frame_that_is_cut_off_too_large_or_not_alone_is_refused(
    start: int | None, end: bytes, more: list[bytes]
) -> None:
    [frame] = m.with_id(m.pack(m.RelayDone((1,)))[0], REQUEST_ID, [bytes(2)])
    assert len(frame) > 20
    assert m.unpack_with_id([frame + end[1:]])[0] == REQUEST_ID
    changed = bytes(frame)[:start] + end
    assert m.id_of(changed) == REQUEST_ID, "its sender gets the refusal"
    with pytest.raises(RemoteProtocolError):
        m.unpack_with_id([changed, *more])


@pytest.mark.parametrize("number", [1, 148 + 25 * 256, 2**63 - 1])
def test_a_header_is_never_taken_for_packed(number: int) -> None:
    header = m.pack_header(m.Done(), number)
    assert compression.unpack_frames(header, DEFAULT_LIMITS) == header


@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        ({}, "is not a list"),
        ([], "is not a list"),
        ((11,), "is not a list"),
        ([999], "unknown message kind"),
        ([True], "unknown message kind"),
        ([11.0], "unknown message kind"),
        (["Done"], "unknown message kind"),
        ([11, None], "Done has 0 fields, the peer sent 1"),
        ([10], "CloseJail has 1 fields, the peer sent 0"),
        ([10, "3"], "CloseJail.jail cannot be of type str"),
        ([10, True], "CloseJail.jail cannot be of type bool"),
        ([10, np.int64(3)], "CloseJail.jail cannot be of type int64"),
        ([8, [1], ()], "RelayDone.parts cannot be of type list"),
        ([m.LoadDone.kind, None], "LoadDone.manifest cannot be of type NoneType"),
        ([9, 1, "exit", None, None, b"", "", ""], "Death.detail cannot be of type bytes"),
    ],
)
def test_what_is_no_message_is_refused(value: object, complaint: str) -> None:
    with pytest.raises(RemoteProtocolError, match=complaint):
        m.unpack(encode(value))


@given(st.binary(max_size=64), st.booleans())
def test_arbitrary_headers_raise_nothing_but_protocol_errors(noise: bytes, with_id: bool) -> None:
    frame = (7).to_bytes(8, "big") + noise if with_id else noise
    try:
        number, message = m.unpack_header(frame)
    except RemoteProtocolError:
        return
    assert type(message) in m.KINDS.values()
    assert number.bit_length() <= 63


def _refused(missing: str, fix: str) -> Busy | None:
    return m.Refusal(server.BUSY_ERROR, "no room", missing, fix).busy


def test_a_refusal_for_want_of_room_says_so() -> None:
    assert _refused("jails", Busy("jails", 3, 4, 2.5).words()) == Busy("jails", 3, 4, 2.5)
    assert _refused("jails", "3 4 9999") == Busy("jails", 3, 4, server.LONGEST_S)
    assert m.Refusal("SandboxUnavailableError", "no", "jails", "3 4 1").busy is None


@pytest.mark.parametrize(
    ("quota", "words"),
    [
        *(("jails", text) for text in ("", "3 4", "3 4 -1", "3 4 nan", "9" * 19 + " 1 1")),
        *((name, "3 4 1") for name in ("", "Jails", "a" * 33, "\x1b[2J")),
    ],
)
def test_anything_else_says_nothing(quota: str, words: str) -> None:
    assert _refused(quota, words) == Busy("", 0, 0, 1.0)


OF_A_SERVER = ("Hello", "OpenJail", "JailOpened", "Relay", "Death")
WITHOUT_NUMPY = """
import sys
sys.path.insert(0, sys.argv[1])
import envhub_worker.server.server
import envhub_worker
from envhub_worker.protocol import messages as m
for golden in sys.argv[2:-1]:
    for _ in range(3):
        said = m.unpack([bytes.fromhex(golden)])
        [frame] = m.pack(said)
        assert frame.hex() == golden
        [frame] = m.pack_header(said, 7)
        assert m.unpack_header(frame) == (7, said)
assert m.unpack(m.pack(m.Value({1, 2**70, 1j, "\\udc80"})))
assert "numpy" not in sys.modules
m.unpack([bytes.fromhex(sys.argv[-1])])
assert "numpy" in sys.modules
"""


def test_a_server_does_without_numpy_until_it_is_sent_an_array() -> None:
    folder = envhub_worker.__file__.rsplit("/envhub_worker/", 1)[0]
    golden = [(GOLDEN / f"{name}.hex").read_text().strip() for name in OF_A_SERVER]
    array = bytes(m.pack(m.Value(np.zeros(2)))[0]).hex()
    command = [sys.executable, "-I", "-c", WITHOUT_NUMPY, folder, *golden, array]
    subprocess.run(command, capture_output=True, text=True, check=True)
