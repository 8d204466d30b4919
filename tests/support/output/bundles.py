"""Crash bundles of an environment that dies as its sample says."""

from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import errors, make_env

_KWARGS = {"moment": "step", "fault": "exit"}


def crashed(folder: Path, reference: Any, **options: Any) -> Path:
    """The bundle of an environment that dies in its third step."""
    policy = {"crash_folder": str(folder), **options.pop("policy", {})}
    with make_env(reference, env_kwargs=_KWARGS, policy=policy, **options) as suites:
        env = next(iter(next(iter(suites.values())).values()))
        env.reset(seed=1)
        env.step([0])
        env.step([0])
        with pytest.raises(errors.WorkerDiedError) as caught:
            env.step([1])
    return Path(str(caught.value.bundle))
