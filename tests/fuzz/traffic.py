"""What real workers say: recorded from runs of the samples, over both lanes.
``python -m tests.fuzz.traffic FILE`` makes the recording: the messages as they came in, each of
another outline, as a list of frames."""

import pickle
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.transport import jail
from envhub_sandbox.transport.shared_memory import client_slabs
from envhub_worker.protocol import messages as m
from tests.support.samples import SAMPLES

Frames = list[bytes]
_REPOSITORIES = ("counter", "exotic_spaces", "custom_vector", "many_tasks", "faulty")
_MOST = 400
_LARGEST = 1 << 16


@contextmanager
def recording(found: dict[tuple[object, ...], Frames]) -> Iterator[None]:
    unpack, unpack_with_id = jail.unpacked, m.unpack_with_id

    def listen(frames: Sequence[Any], **options: Any) -> Any:
        copied = [bytes(frame) for frame in frames]
        message = unpack(frames, **options)
        key = (message.kind, *map(len, copied))
        if len(found) < _MOST and sum(map(len, copied)) < _LARGEST:
            found.setdefault(key, copied)
        return message

    def listen_to_messages(frames: Any, **options: Any) -> Any:
        number, message, payload = unpack_with_id(frames, **options)
        listen(m.pack(message))
        return number, message, payload

    jail.unpacked = client_slabs.unpacked = listen
    m.unpack_with_id = listen_to_messages
    try:
        yield
    finally:
        jail.unpacked = client_slabs.unpacked = unpack
        m.unpack_with_id = unpack_with_id


def record() -> list[Frames]:
    found: dict[tuple[object, ...], Frames] = {}
    with recording(found):
        for name in _REPOSITORIES:
            for lane, workers in (("auto", 2), ("frames", 1)):
                with suppress(EnvHubError):
                    _run(name, lane, workers)
    return list(found.values())


def _run(name: str, lane: str, workers: int) -> None:
    options: dict[str, Any] = {"policy": {"lane": lane}, "num_workers": workers, "n_envs": 3}
    with make_env(str(SAMPLES / name), **options) as suites:
        env = next(iter(next(iter(suites.values())).values()))
        env.action_space.seed(0)
        asked: list[Callable[[], object]] = [
            lambda: env.reset(seed=1),
            *[lambda: env.step(env.action_space.sample())] * 8,
            lambda: env.call("spec"),
            lambda: env.get_attr("action_space"),
            lambda: env.get_attr("np_random"),
            lambda: env.envs[1].observation_space,
            env.render,
            lambda: env.np_random,
            lambda: env.call("nobody_has_this"),
            lambda: env.reset(options={"a": {(1, 2): "b"}}),
        ]
        for ask in asked:
            with suppress(EnvHubError, AttributeError):
                ask()


if __name__ == "__main__":
    Path(sys.argv[1]).write_bytes(pickle.dumps(record()))
