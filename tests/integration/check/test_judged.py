"""Some of the hostile payloads and samples, judged; ``tests.support.judged`` has them all."""

from __future__ import annotations

import pytest

from tests.support import judged
from tests.support.samples import SAMPLES


def test_every_payload_and_every_sample_has_its_judgement() -> None:
    """Who adds one says what has to be told of it."""
    payloads = {path.stem for path in judged.PAYLOADS.glob("*.py")}
    assert {*judged.ATTACKS, *judged.NO_ATTACKS} == payloads
    samples = {path.name for path in SAMPLES.iterdir() if (path / "env.py").exists()}
    assert {*judged.HONEST, *judged.FAILING} == samples | {"sub_folder"}
    assert len(judged.HONEST) >= 20
    for attack in judged.ATTACKS.values():
        by_layers = ("denied-", "limits-", "survives", "leaks-")
        assert attack.check.startswith(by_layers) or attack.unseen


@pytest.mark.parametrize("payload", ["foreign_abi", "unix_stream"])
def test_a_hostile_payload_is_reported_with_what_it_tried(payload: str) -> None:
    attack = judged.ATTACKS[payload]
    found = judged.told_of(payload, attack)
    assert judged.is_told(found, attack), [one.text for one in found]


@pytest.mark.parametrize("name", ["exits", "src_layout"])
def test_a_sample_is_judged_as_it_is(name: str) -> None:
    """Honest ones pass, and of others what fails is what is wrong with them."""
    found = judged.failing(name)
    assert judged.is_as_it_stands(name, found), [one.text for one in found]
