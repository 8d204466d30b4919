"""Whose options those of ``lerobot-eval-sandboxed`` are."""

import sys
from importlib.util import find_spec

import pytest

from envhub_sandbox.integrations.lerobot_eval import main, split_eval_arguments


def test_ours_are_taken_out() -> None:
    ours = ['--sandbox.policy={"gpu": true}', "--sandbox.num-workers=2", "--sandbox.lock=l.toml"]
    theirs = ["--env.type=pusht", "--env.sandbox=process", "--seed", "1"]
    options, rest = split_eval_arguments([theirs[0], *ours, *theirs[1:]])
    assert options == {"policy": {"gpu": True}, "num_workers": 2, "lock": "l.toml"}
    assert rest == theirs


def test_an_option_without_a_value_is_refused() -> None:
    with pytest.raises(SystemExit, match=r"--sandbox\.policy takes a value"):
        split_eval_arguments(["--sandbox.policy", "{}"])


@pytest.mark.skipif(find_spec("lerobot") is not None, reason="there is LeRobot here")
def test_without_lerobot_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["lerobot-eval-sandboxed"])
    with pytest.raises(SystemExit, match="needs LeRobot"):
        main()
