"""What a client may write into a confinement: it comes from another host, perhaps."""

from dataclasses import asdict, replace
from typing import Any

import pytest

from envhub_worker.lockdown.spec import confinement_from_wire
from envhub_worker.protocol.confinement import Confinement, Limits
from envhub_worker.protocol.errors import RemoteProtocolError

UNCONFINED: tuple[dict[str, str], ...] = (
    *({"LD_PRELOAD": "/a.so"}, {"PYTHONPATH": "/a"}, {"GLIBC_TUNABLES": "a"}, {"TZ": ":/dev/zero"}),
    *({"TZ": "a/../b"}, {"LANG": "/a"}, {"PYTHONWARNINGS": "error:a:b.C"}, {"PYTHONHASHSEED": "a"}),
    *({"LD_AUDIT": ""}, {"PYTHONSTARTUP": ""}, {"PYTHONIOENCODING": "a.b"}),
)
"""What a process that is not confined yet would be started with."""


def wire(**changes: Any) -> dict[str, Any]:
    return {**asdict(Confinement()), **changes}


def test_an_ordinary_one_is_what_it_was() -> None:
    made = Confinement(
        readable=("/data",),
        environment={"A": "/b", "LD_SDK_KEY": "/c", "TZ": "EST5EDT,M3.2.0/2:00,M11.1.0"},
        limits=Limits(cpu_time_s=None, file_bytes=5),
    )
    assert confinement_from_wire({**asdict(made), "readable": ["/data"]}) == made
    assert confinement_from_wire({**asdict(made), "gpu": [0, 2]}) == replace(made, gpu=(0, 2))


@pytest.mark.parametrize(
    "changes",
    [
        *({"profile": "none"}, {"network": "anything"}, {"network": ["host"]}, {"surplus": 1}),
        *({"gpu": lie} for lie in (1, [], [True], [-1], "0", list(range(65)))),
        *({"readable": lie} for lie in ("/etc", [b"/etc"], ["/a"] * 65)),
        *({"environment": {"A": lie}} for lie in (b"b", "b" * (64 << 10), "b\0c")),
        *({"environment": item} for item in UNCONFINED),
        *({"environment": ["A"]}, {"record_denials": 1}, {"display": ":0"}),
        *({"limits": lie} for lie in (None, {"unknown": 1}, {"memory_bytes": None})),
        {"limits": {"output_bytes": 1 << 30}},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_what_there_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(RemoteProtocolError):
        confinement_from_wire(wire(**changes))


@pytest.mark.parametrize("name", list(asdict(Limits())))
@pytest.mark.parametrize("value", [0, -(10**15), True, 1.5, "1", 1 << 63])
def test_a_limit_is_a_number_above_zero(name: str, value: object) -> None:
    """A negative one would make room for others in a sum, and a text would end the server."""
    with pytest.raises(RemoteProtocolError):
        confinement_from_wire(wire(limits={**asdict(Limits()), name: value}))
