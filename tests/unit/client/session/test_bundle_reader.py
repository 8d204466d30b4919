"""Bundles are untrusted: what is broken is refused, what is asked for is told, nothing is run."""

from __future__ import annotations

import json
import os
import pickle
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.cli.shared.console import safe_line
from envhub_sandbox.errors import ActionError, BundleError, WorkerDiedError
from envhub_sandbox.session.crash import bundle_reader, bundle_writer
from envhub_sandbox.session.crash.bundle_reader import (
    MAX_DOCUMENT_BYTES,
    load_bundle,
    replayed_arguments,
    wishes,
)
from envhub_sandbox.session.crash.history import History
from envhub_sandbox.session.crash.replay import Verdict, replay
from envhub_sandbox.settings.policy import Limits, Policy, Timeouts
from envhub_worker.protocol import messages as m
from tests.support import inside
from tests.support.wire import env_manifest, requested

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def bundle(folder: Path, **options: Any) -> Path:
    """A bundle of a reset and three steps, as ``bundle_writer`` writes it."""
    history = History(env_manifest(spaces.Discrete(2), spaces.Discrete(5), 2), 100)
    history.requested(requested(m.Reset(0, [1, 2], None, None)))
    for number in range(3):
        history.step(np.array([number, number]))
    given = {"policy": Policy(), "timeouts": Timeouts(), "python": None, "endpoint": None}
    crash = bundle_writer.Crash(
        error=WorkerDiedError("it died", exit_code=7, request="step"),
        label="org/repo",
        provenance={
            "repository": "org/repo",
            "repo_type": "model",
            "commit": COMMIT,
            "path": "env.py",
            "files": {"env.py": "git-sha1:00"},
        },
        load=m.Load(2, False, None, {"size": np.arange(3)}),
        options=given | options,
        task={"suite": "s", "task": 0, "num_envs": 2, "shards": 1, "lane": "frames"},
        shared=False,
        recording=history.recording(),
    )
    return bundle_writer.write_bundle(folder, crash)


def edit(folder: Path, *path: Any, value: Any) -> None:
    """Change one member of ``bundle.json``."""
    file = folder / "bundle.json"
    document = json.loads(file.read_text())
    place = document
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    file.write_text(json.dumps(document))


def test_a_bundle_comes_back(tmp_path: Path) -> None:
    found = load_bundle(bundle(tmp_path))
    assert found.reference == f"models/org/repo@{COMMIT}"
    assert found.doubts == ()
    assert found.steps == 3
    assert [type(one).__name__ for one in found.requests] == ["Reset", "Step", "Step", "Step"]
    assert found.load.env_kwargs["size"].tolist() == [0, 1, 2]  # type: ignore[attr-defined]
    assert wishes(found) == []
    arguments = replayed_arguments(found, granted=False)
    assert arguments["policy"]["crash_history"] == 0
    assert (arguments["num_workers"], arguments["lane"]) == (1, "frames")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("format",), 2),
        (("provenance",), []),
        (("provenance", "commit"), "main"),
        (("provenance", "repository"), "../.."),
        (("provenance", "repo_type"), "trap"),
        (("provenance", "path"), "/etc/passwd"),
        (("provenance", "files"), {"env.py": 5}),
        (
            ("provenance",),
            {"repository": "x", "repo_type": "local", "commit": "", "path": "env.py", "files": {}},
        ),
        (("death", "reason"), None),
        (("task", "task"), 1.5),
        (("history", "requests", 0), "reset"),
        (("history", "requests", 1, "steps"), [0, 3]),
        (("history", "requests", 1, "steps"), -1),
        (("history", "requests", 1, "steps"), 10**9),
        (("history", "requests", 0, "steps"), 3),
        (("history", "requests"), [{"operation": "reset"}] * 3),
        (("label",), 5),
        (("task", "num_envs"), "2"),
        (("history", "requests", 1, "steps"), 4),
        (("history", "requests"), []),
        (("history", "dropped"), True),
    ],
)
def test_a_broken_index_is_refused(tmp_path: Path, path: tuple[Any, ...], value: Any) -> None:
    """Types, bounds, names of files: everything is checked before it is used."""
    folder = bundle(tmp_path)
    edit(folder, *path, value=value)
    with pytest.raises(BundleError, match="cannot be read as a crash bundle"):
        load_bundle(folder)


def _link(folder: Path) -> None:
    (folder / "bundle.json").rename(folder.parent / "elsewhere.json")
    (folder / "bundle.json").symlink_to(folder.parent / "elsewhere.json")


HARM: dict[str, Callable[[Path], object]] = {
    "a link": _link,
    "nested": lambda folder: (folder / "bundle.json").write_text("[" * 200_000),
    "lists": lambda folder: (folder / "bundle.json").write_text(
        "[" + "[]," * (MAX_DOCUMENT_BYTES // 3) + "[]]"
    ),
    "noise": lambda folder: (folder / "requests.bin").write_bytes(bytes(range(256))),
}


@pytest.mark.parametrize("harm", HARM.values(), ids=HARM)
def test_a_hostile_file_is_refused(tmp_path: Path, harm: Callable[[Path], object]) -> None:
    folder = bundle(tmp_path)
    harm(folder)
    with pytest.raises(BundleError):
        load_bundle(folder)


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("bundle.json", MAX_DOCUMENT_BYTES),
        ("arguments.bin", bundle_reader.MAX_FILE_BYTES),
        ("requests.bin", bundle_reader.MAX_FILE_BYTES),
    ],
)
def test_a_huge_file_is_not_read(tmp_path: Path, name: str, most: int) -> None:
    folder = bundle(tmp_path)
    os.truncate(folder / name, most + 1)
    with pytest.raises(BundleError, match=f"at most {most} are read"):
        load_bundle(folder)


class Bomb:
    """Touches a file when it is unpickled."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.canary,)


def test_nothing_in_a_bundle_is_executed(tmp_path: Path) -> None:
    """Control: whoever unpickles it, executes it."""
    canary = tmp_path / "canary"
    folder = bundle(tmp_path)
    load = m.Load(1, False, None, {"a": Bomb(canary)})
    frames = m.pack(load, pickler=pickle.dumps)
    (folder / "arguments.bin").write_bytes(inside.packet(frames))
    with pytest.raises(BundleError, match="cannot be read as a crash bundle"):
        load_bundle(folder)
    assert not canary.exists()
    m.unpack(frames, unpickler=pickle.loads)
    assert canary.exists()


@pytest.mark.parametrize("shape", [(101, 2), (101, 0), (10**9, 0)])
def test_the_number_of_steps_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]
) -> None:
    """Also of steps that take no bytes; the control is one step less than too many."""
    monkeypatch.setattr(bundle_reader, "MAX_REQUESTS", 100)
    folder = bundle(tmp_path)
    for actions in (np.zeros((100, 2)), np.empty(shape)):
        (folder / "requests.bin").write_bytes(inside.packet(m.pack(m.Step(0, actions))))
        edit(folder, "history", "requests", value=[{"steps": len(actions)}])
        if len(actions) == 100:
            assert load_bundle(folder).steps == 100
    with pytest.raises(BundleError, match="more than 100 requests"):
        load_bundle(folder)


@pytest.mark.parametrize("name", ["requests.bin", "arguments.bin"])
def test_requests_are_not_decoded_all_at_once(name: str, tmp_path: Path) -> None:
    """Each may have as many empty lists as a message may, which take seventy times their bytes."""
    folder, most = bundle(tmp_path), 10
    lists: list[list[int]] = [[] for _ in range(5_000)]
    frames = m.pack(m.Load(1, False, None, {"a": lists}))
    (folder / name).write_bytes(inside.packet(frames) * most)
    edit(folder, "history", "requests", value=[{"operation": "load"}] * most)
    one = sum(map(sys.getsizeof, [lists, *lists]))
    tracemalloc.start()
    try:
        if name == "requests.bin":
            assert len(load_bundle(folder).requests) == most
        else:
            with pytest.raises(BundleError, match="not those of make_env"):
                load_bundle(folder)
        assert tracemalloc.get_traced_memory()[1] < 5 * one
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "given", "nothing"),
    [
        ("dependencies", {"extra": ["scipy"], "python": "/tmp/python"}, "auto"),
        ("dependencies", "host", "auto"),
        ("assets", ["me/private"], []),
        ("lock", "/tmp/pylock.toml", None),
        ("hub_cache_dir", "/tmp/cache", None),
    ],
)
def test_what_a_bundle_chooses_is_a_wish(
    tmp_path: Path, name: str, given: Any, nothing: Any
) -> None:
    """Packages could be any, and assets what only the caller's token reads."""
    found = load_bundle(bundle(tmp_path / "a", **{name: given}))
    [wish] = wishes(found)
    assert wish.startswith(f"{name}=")
    assert name not in replayed_arguments(found, granted=False)
    assert replayed_arguments(found, granted=True)[name] == given
    assert wishes(load_bundle(bundle(tmp_path / "b", **{name: nothing}))) == []


@pytest.mark.parametrize("limit", ["999G", [1 << 60], {}, 1 << 60, 1e30, None])
def test_a_limit_that_is_no_small_number_is_a_wish(tmp_path: Path, limit: object) -> None:
    """``Limits`` reads texts as well: what cannot be compared here is asked for."""
    folder = bundle(tmp_path)
    edit(folder, "make_env", "policy", value={"limits": {"memory_bytes": limit}})
    found = load_bundle(folder)
    assert wishes(found) == [f"limits.memory_bytes={limit!r}"]
    assert replayed_arguments(found, granted=False)["policy"]["limits"] == {}


def test_the_whole_of_a_wish_is_shown(tmp_path: Path) -> None:
    """What stands behind many others is granted with them; where all cannot be shown, none is."""
    many = [f"org/{'x' * 80}{number}" for number in range(15)] + ["me/private"]
    [wish] = wishes(load_bundle(bundle(tmp_path / "a", assets=many)))
    assert wish.endswith("'me/private']")
    found = load_bundle(bundle(tmp_path / "b", assets=[*many * 4, "me/private"]))
    with pytest.raises(BundleError, match="more than can be shown"):
        wishes(found)


def test_wishes_beyond_an_ordinary_run_are_told(tmp_path: Path) -> None:
    policy = Policy(
        profile="no-userns",
        network="host",
        display="virtual",
        readable=("/data",),
        gpu=True,
        environment=("SECRET",),
        limits=Limits(memory_bytes=64 << 30, processes=7, cpu_time_s=5),
    )
    found = load_bundle(
        bundle(tmp_path, policy=policy, python="/tmp/python", endpoint="https://evil.example")
    )
    assert [wish.partition("=")[0] for wish in wishes(found)] == [
        *("profile", "network", "display", "readable", "gpu", "environment"),
        *("limits.memory_bytes", "endpoint", "python"),
    ]
    refused = replayed_arguments(found, granted=False)
    assert set(refused["policy"]) == {"limits", "crash_history"}
    assert refused["policy"]["limits"]["processes"] == 7
    assert refused["policy"]["limits"]["cpu_time_s"] == 5
    assert "memory_bytes" not in refused["policy"]["limits"]
    assert not {"python", "endpoint"} & set(refused)
    granted = replayed_arguments(found, granted=True)
    assert granted["policy"]["network"] == "host"
    assert granted["policy"]["limits"]["memory_bytes"] == 64 << 30
    assert granted["python"] == "/tmp/python"
    assert Policy(**{**granted["policy"], "limits": Limits(**granted["policy"]["limits"])})


def test_a_replay_is_not_waited_for_without_end(tmp_path: Path) -> None:
    folder = bundle(tmp_path)
    for endless in (float("inf"), 10.0**9):
        said = {"reset_s": None, "step_s": endless, "startup_s": "1", "call_s": 5}
        edit(folder, "make_env", "timeouts", value=said)
        made = replayed_arguments(load_bundle(folder), granted=True)
        assert made["timeouts"] == {"call_s": 5}


def test_a_bundle_says_nothing_in_lines_of_its_own(tmp_path: Path) -> None:
    """Whatever its names are: what is printed of it is one line each, and no terminal obeys it."""
    folder = bundle(tmp_path)
    forged = "memory_bytes\nError: run this as root\x1b[2J"
    edit(folder, "make_env", "policy", value={"limits": {forged: 1 << 60}})
    edit(folder, "label", value=f"org/repo{forged}")
    for name in ("signal", "reason", "request", "message"):
        edit(folder, "death", name, value="\x1b]0;title\x07")
    found = load_bundle(folder)
    [wish] = wishes(found)
    assert wish.startswith("limits.memory_bytes")
    assert wish.isprintable()
    assert found.label.isprintable()
    assert "\x1b" not in found.label + "".join(map(str, found.death.values())) + safe_line(
        found.label
    )
    with_login = bundle(tmp_path / "b", endpoint="https://me@there:hf_secret@hub.example/x")
    assert all(b"hf_secret" not in file.read_bytes() for file in with_login.iterdir())
    assert load_bundle(with_login).arguments["endpoint"] == "https://hub.example/x"


class Recorder:
    """An environment that writes down what it is asked, and dies at its fourth step."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.num_envs = 2

    def reset(self, **arguments: Any) -> None:
        self.asked.append(f"reset {arguments['seed']}")

    def step(self, actions: Any) -> None:
        self.asked.append(f"step {actions.tolist()}")
        if len(self.asked) == 4:
            raise WorkerDiedError("again", exit_code=7)

    def close(self) -> None:
        self.asked.append("close")


class Open(Recorder):
    """One that has whatever it is asked for, and so have its sub-environments."""

    @property
    def envs(self) -> list[Open]:
        return [self, self]

    def __getattr__(self, name: str) -> Callable[[], None]:
        return lambda: self.asked.append(name)


def test_a_replay_asks_the_same(tmp_path: Path) -> None:
    env = Recorder()
    found = replay(lambda: env, load_bundle(bundle(tmp_path)))
    assert env.asked == ["reset [1, 2]", "step [0, 0]", "step [1, 1]", "step [2, 2]"]
    assert (found.verdict, found.requests, found.steps) == (Verdict.SAME, 4, 3)


def test_a_bundle_cannot_call_the_proxy_itself(tmp_path: Path) -> None:
    """Only names that the repository's environment has beyond ours, of those that there are."""
    folder = bundle(tmp_path)
    calls: list[m.Message] = [
        *(m.CallOwn(0, "close", (), {}), m.GetOwn(0, "__dict__"), m.CallOwn(0, "_own", (), {})),
        *(m.CallOne(0, index, 0, "close", (), {}) for index in (-1, 2)),
        m.CallOne(0, 0, 0, "_own", (), {}),
        m.CallOne(0, 0, 0, "__setattr__", ("asked", []), {}),
        m.CallOne(0, 0, 0, "__setattr__", ("further", 1), {}),  # a control
        m.CallOne(0, 0, 0, "allowed", (), {}),  # another
    ]
    packets = b"".join(inside.packet(m.pack(call)) for call in calls)
    (folder / "requests.bin").write_bytes(packets)
    edit(folder, "history", "requests", value=[{"operation": "call"}] * len(calls))
    env = Open()
    asked = env.asked
    assert replay(lambda: env, load_bundle(folder)).verdict is Verdict.SURVIVED
    assert env.asked is asked
    assert asked == ["allowed"]
    assert vars(env)["further"] == 1


def test_a_request_that_does_not_fit_is_said(tmp_path: Path) -> None:
    """An environment that has become another one takes other actions; also what was set before."""
    env: Any = Recorder()
    env.step = lambda actions: np.zeros(3).reshape(2)
    folder = bundle(tmp_path)
    found = replay(lambda: env, load_bundle(folder))
    assert found.verdict is Verdict.DIFFERENT
    assert "request 2 does not fit" in found.note
    setting = inside.packet(m.pack(m.SetAttr(0, "size", (1,))))
    (folder / "requests.bin").write_bytes(setting + (folder / "requests.bin").read_bytes())
    index = json.loads((folder / "bundle.json").read_text())["history"]["requests"]
    edit(folder, "history", "requests", value=[{"operation": "set_attr"}, *index])
    for error in (ValueError("one value each"), TypeError("no"), ActionError("no")):
        env.set_attr = Mock(side_effect=error)
        found = replay(lambda: env, load_bundle(folder))
        assert found.verdict is Verdict.DIFFERENT
        assert f"does not fit this environment: {error}" in found.note


def test_a_bundle_of_git_names_a_host(tmp_path: Path) -> None:
    """Which the user grants: a stranger chose it. A package is the index's, as for any other."""
    folder = bundle(tmp_path)

    def of(repository: str, kind: str) -> bundle_reader.Bundle:
        edit(folder, "provenance", "repository", value=repository)
        edit(folder, "provenance", "repo_type", value=kind)
        return load_bundle(folder)

    found = of("https://git.example/org/repo", "git")
    assert found.reference == f"git+https://git.example/org/repo@{COMMIT}"
    assert wishes(found) == [f"repository='{found.reference}'"]
    with pytest.raises(BundleError, match="not fetched by 'file'"):
        of("file:///etc", "git")
    found = of("x@1.0#Y-v0", "pypi")
    assert (found.reference, wishes(found)) == ("pypi:x@1.0#Y-v0", [])
    edit(folder, "provenance", "commit", value="main")
    with pytest.raises(BundleError, match="is not a commit"):
        of("x@1.0#Y-v0", "model")
