"""Bundles are untrusted: what is broken is refused, what is asked for is told, nothing is run."""

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

from envhub_sandbox.cli.shared.console import safe_line
from envhub_sandbox.errors import ActionError, BundleError, WorkerDiedError
from envhub_sandbox.extras.crash import bundle_reader, bundle_writer
from envhub_sandbox.extras.crash.bundle_reader import (
    MAX_DOCUMENT_BYTES,
    load_bundle,
    replayed_arguments,
    wishes,
)
from envhub_sandbox.extras.crash.history import History
from envhub_sandbox.extras.crash.replay import Verdict, replay
from envhub_sandbox.session.recorder import Crash
from envhub_worker.protocol import messages as m
from tests.support.wire import requested

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def bundle(folder: Path, **options: Any) -> Path:
    """A bundle of a reset and three steps, as ``bundle_writer`` writes it."""
    history = History(100)
    history.requested(requested(m.Reset(0, [1, 2], None, None)))
    for number in range(3):
        history.step(np.array([number, number]))
    crash = Crash(
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
        options=options,
        task={"suite": "s", "task": 0, "num_envs": 2, "shards": 1, "lane": "frames"},
    )
    return bundle_writer.write_bundle(folder, crash, history.recording())


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
    assert found.steps == 3
    assert [type(one).__name__ for one in found.requests()] == ["Reset", "Step", "Step", "Step"]
    assert found.load.env_kwargs["size"].tolist() == [0, 1, 2]
    arguments = replayed_arguments(found)
    assert arguments["policy"] == {"crash_history": 0, "lane": "frames"}
    assert arguments["num_workers"] == 1


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("format",), 1),
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
        (("label",), 5),
        (("task", "num_envs"), "2"),
        (("make_env",), []),
    ],
)
def test_a_broken_index_is_refused(tmp_path: Path, path: tuple[Any, ...], value: Any) -> None:
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
    (folder / "arguments.bin").write_bytes(bundle_writer.packet(frames))
    with pytest.raises(BundleError, match="cannot be read as a crash bundle"):
        load_bundle(folder)
    assert not canary.exists()
    m.unpack(frames, unpickler=pickle.loads)
    assert canary.exists()


@pytest.mark.parametrize("name", ["requests.bin", "arguments.bin"])
def test_requests_are_not_decoded_all_at_once(name: str, tmp_path: Path) -> None:
    """Each may have as many empty lists as a message may, which take seventy times their bytes."""
    folder, most = bundle(tmp_path), 10
    lists: list[list[int]] = [[] for _ in range(5_000)]
    frames = m.pack(m.Load(1, False, None, {"a": lists}))
    (folder / name).write_bytes(bundle_writer.packet(frames) * most)
    one = sum(map(sys.getsizeof, [lists, *lists]))
    tracemalloc.start()
    try:
        if name == "requests.bin":
            assert load_bundle(folder).count == most
        else:
            with pytest.raises(BundleError, match="not those of make_env"):
                load_bundle(folder)
        assert tracemalloc.get_traced_memory()[1] < 5 * one
    finally:
        tracemalloc.stop()


def test_what_a_replay_uses_is_told(tmp_path: Path) -> None:
    """All of it, or the bundle is refused; what the run of a bundle may not choose is not used."""
    limits = {"memory_bytes": 1 << 20}
    policy = {"profile": "no-userns", "environment": ["SECRET"], "limits": limits}
    own = {
        "timeouts": {"step_s": 60},
        "hub_cache_dir": "/tmp/cache",
        "endpoint": "https://evil.example",
        "python": "/tmp/python",
        "dependencies": {"extra": ["scipy"]},
        "lock": "/tmp/pylock.toml",
        "assets": ["me/private"],
    }
    ignored = {"sandbox": "tcp://evil.example:1", "trust_remote_code": True}
    restart = {"restart": "transparent", "crash_folder": "/etc"}
    found = load_bundle(bundle(tmp_path / "a", policy=policy | restart, **own, **ignored))
    told = {"repository": found.reference, **policy, **own}
    assert all(f"{name}={value!r}" in wishes(found) for name, value in told.items())
    arguments = replayed_arguments(found)
    assert arguments["policy"] == {**policy, "crash_history": 0, "lane": "frames"}
    assert {name: arguments[name] for name in own} == own
    assert not (ignored | restart).keys() & {*arguments, *arguments["policy"]}
    found = load_bundle(bundle(tmp_path / "b", assets=["org/x"] * 1000))
    with pytest.raises(BundleError, match="more than can be shown"):
        wishes(found)


def test_a_bundle_is_ours_if_only_we_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the cache's folder of bundles; a folder that others may write there is anybody's."""
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path))
    folder = bundle(tmp_path / "crashes")
    assert load_bundle(folder).is_ours
    assert not load_bundle(bundle(tmp_path / "elsewhere")).is_ours
    if os.name == "posix":
        folder.parent.chmod(0o777)
        assert not load_bundle(folder).is_ours


def test_a_bundle_says_nothing_in_lines_of_its_own(tmp_path: Path) -> None:
    """Whatever its names are: what is printed of it is one line each, and no terminal obeys it."""
    folder = bundle(tmp_path)
    forged = "memory_bytes\nError: run this as root\x1b[2J"
    edit(folder, "make_env", "policy", value={"profile": forged})
    edit(folder, "label", value=f"org/repo{forged}")
    for name in ("signal", "reason", "request", "message"):
        edit(folder, "death", name, value="\x1b]0;title\x07")
    found = load_bundle(folder)
    wish = wishes(found)
    assert "profile='memory_bytes" in wish
    assert wish.isprintable()
    assert found.label.isprintable()
    assert "\x1b" not in "".join(map(str, [found.label, *found.death.values()]))
    assert "\x1b" not in safe_line(found.label)
    with_login = bundle(tmp_path / "b", endpoint="https://me@there:hf_secret@hub.example/x")
    assert all(b"hf_secret" not in file.read_bytes() for file in with_login.iterdir())
    assert load_bundle(with_login).arguments["endpoint"] == "https://hub.example/x"


class Recorder:
    """An environment that writes down what it is asked, and dies at its fourth step."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.num_envs = 2
        self._requests = self.requests = Mock()

    def reset(self, **arguments: Any) -> None:
        self.asked.append(f"reset {arguments['seed']}")

    def step(self, actions: Any) -> None:
        self.asked.append(f"step {actions.tolist()}")
        if len(self.asked) == 4:
            raise WorkerDiedError("again", exit_code=7)

    def close(self) -> None:
        self.asked.append("close")


def test_a_replay_asks_the_same(tmp_path: Path) -> None:
    env = Recorder()
    found = replay(lambda: env, load_bundle(bundle(tmp_path)))
    assert env.asked == ["reset [1, 2]", "step [0, 0]", "step [1, 1]", "step [2, 2]"]
    assert (found.verdict, found.requests, found.steps) == (Verdict.SAME, 4, 3)


def test_a_bundle_cannot_call_the_proxy_itself(tmp_path: Path) -> None:
    """A name is the jail's business alone; so is a sub-environment, of those that there are. Nor is
    a name what is asked: a call of ``reset`` is no reset of all of them."""
    folder = bundle(tmp_path)
    calls: list[m.Message] = [
        m.GetOne(0, m.ITSELF, 0, "__dict__"),
        *(m.CallOne(0, index, 0, "close", (), {}) for index in (m.ITSELF, -2, 2, None)),
        m.CallOne(0, 1, 0, "__setattr__", ("asked", []), {}),
        m.Close(0),
    ]
    packets = b"".join(bundle_writer.packet(m.pack(call)) for call in calls)
    (folder / "requests.bin").write_bytes(packets)
    env = Recorder()
    asked = env.asked
    assert replay(lambda: env, load_bundle(folder)).verdict is Verdict.SURVIVED
    assert env.asked is asked
    assert asked == []
    each = [call.args for call in env.requests.ask_one.call_args_list]
    names = [("__dict__", m.ITSELF), ("close", m.ITSELF), ("__setattr__", 1)]
    assert [(name, index) for name, index, _ in each] == names
    *_, message_for = each[-1]
    assert message_for(7, 1) == m.CallOne(7, 1, 0, "__setattr__", ("asked", []), {})
    assert message_for(7, None) == m.CallOne(7, None, 0, "__setattr__", (), {})


def test_a_request_that_does_not_fit_is_said(tmp_path: Path) -> None:
    """An environment that has become another one takes other actions; also what was set before."""
    env: Any = Recorder()
    env.step = lambda actions: np.zeros(3).reshape(2)
    folder = bundle(tmp_path)
    found = replay(lambda: env, load_bundle(folder))
    assert found.verdict is Verdict.DIFFERENT
    assert "request 2 does not fit" in found.note
    setting = bundle_writer.packet(m.pack(m.SetAttr(0, "size", (1,))))
    (folder / "requests.bin").write_bytes(setting + (folder / "requests.bin").read_bytes())
    for error in (ValueError("one value each"), TypeError("no"), ActionError("no")):
        env.set_attr = Mock(side_effect=error)
        found = replay(lambda: env, load_bundle(folder))
        assert found.verdict is Verdict.DIFFERENT
        assert f"does not fit this environment: {error}" in found.note


def test_a_bundle_of_git_names_a_host(tmp_path: Path) -> None:
    """Which the user is told: a stranger chose it."""
    folder = bundle(tmp_path)

    def of(repository: str, kind: str) -> bundle_reader.Bundle:
        edit(folder, "provenance", "repository", value=repository)
        edit(folder, "provenance", "repo_type", value=kind)
        return load_bundle(folder)

    found = of("https://git.example/org/repo", "git")
    assert found.reference == f"git+https://git.example/org/repo@{COMMIT}"
    assert f"repository='{found.reference}'" in wishes(found)
    with pytest.raises(BundleError, match="not fetched by 'file'"):
        of("file:///etc", "git")
    found = of("x@1.0#Y-v0", "pypi")
    assert found.reference == "pypi:x@1.0#Y-v0"
    edit(folder, "provenance", "commit", value="main")
    with pytest.raises(BundleError, match="is not a commit"):
        of("x@1.0#Y-v0", "model")
