"""What a host has to confine with: its facts, its users, and what a jail sees of it."""

import json
import os
import pwd
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.lockdown import probe
from envhub_worker.lockdown.context import ZygoteConfig
from envhub_worker.lockdown.mechanisms import mounts, process, user
from envhub_worker.lockdown.stages import jail, zygote
from envhub_worker.protocol.confinement import Limits


@pytest.mark.parametrize("gpu", [False, True, (0, 2)])
def test_a_zygotes_configuration_survives_json(gpu: bool | tuple[int, ...]) -> None:
    values: dict[str, Any] = dict.fromkeys(ZygoteConfig.__dataclass_fields__, "text")
    lists = {"readable": ("/a", "/b"), "roots": ("/r",), "gpu": gpu}
    made = ZygoteConfig(**values | lists | {"parent": 1, "user": None, "record": False})
    assert ZygoteConfig.from_wire(json.loads(json.dumps(asdict(made)))) == made


def test_processes_are_counted_as_the_kernel_does() -> None:
    """In a user namespace of their own with init, else with all that the user runs already."""
    limits = Limits(processes=7)
    assert jail.process_limit(limits, namespaced=True) == 8
    assert jail.process_limit(limits, namespaced=False) > 7


def test_what_the_interpreter_is_loaded_from_is_there() -> None:
    paths = zygote.interpreter_paths()
    assert all(os.path.isabs(path) for path in paths)
    assert "/" not in paths
    for needed in (os.__file__, probe.__file__, os.path.realpath(sys.executable)):
        assert any(Path(os.path.realpath(needed)).is_relative_to(path) for path in paths), needed


def test_proc_is_covered_where_it_tells_of_the_host() -> None:
    files, folders = mounts.proc_to_cover()
    assert all(os.path.isdir(path) for path in folders)
    assert all(os.path.exists(path) and not os.path.isdir(path) for path in files)
    assert {"/proc/self", f"/proc/{os.getpid()}"}.isdisjoint([*files, *folders])


def test_roots_jails_get_a_user_that_nobody_is() -> None:
    chosen = user.choose()
    if os.geteuid() != 0:
        assert chosen is None
        return
    assert chosen is not None
    assert chosen != 0
    with pytest.raises(KeyError):
        pwd.getpwuid(chosen)
    owners = {os.stat(one).st_uid for one in Path("/proc").glob("[0-9]*") if one.exists()}
    assert user.unused_uid() not in owners

    def groups() -> str:
        os.setgroups([4, 27])
        user.become(chosen)
        return f"{os.getresuid()} {os.getresgid()} {os.getgroups()}"

    def without_rights() -> str:
        process.drop_capabilities()
        return str(user.choose())

    assert "no capability" in probe.try_layer("user", without_rights)["detail"]
    alone = (chosen, chosen, chosen)
    assert probe.try_layer("user", groups)["detail"] == f"{alone} {alone} []"


def test_a_layer_is_tried_in_a_child() -> None:
    def dies() -> str:
        os._exit(3)

    def fails() -> str:
        raise OSError(1, "not here")

    tried = probe.try_layer("one", lambda: "as it should")
    assert tried == {"layer": "one", "available": True, "detail": "as it should", "fix": ""}
    failed = probe.try_layer("two", fails)
    assert not failed["available"]
    assert "not here" in failed["detail"]
    assert not probe.try_layer("three", dies)["available"]


def test_facts_explain_the_host() -> None:
    facts = probe.host_facts()
    assert facts == json.loads(json.dumps(facts))
    assert facts["user"] == ("root" if os.geteuid() == 0 else "plain user")
    assert facts["machine"] == os.uname().machine
    assert "userns" in probe.apparmor_profile()
