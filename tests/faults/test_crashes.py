"""Crash bundles: what is in them, and that the same requests bring about the same death."""

import json
import shutil
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import errors, make_env
from envhub_sandbox.extras.crash import bundle_writer
from envhub_sandbox.extras.crash.bundle_reader import load_bundle
from envhub_sandbox.vector.single_env import SingleEnv
from tests.support.command_line import document, envhub
from tests.support.processes import eventually
from tests.support.repositories import write_repository
from tests.support.samples import sample
from tests.support.started import started

pytestmark = pytest.mark.usefixtures("neighbour")


def brittle(folder: Path, actions: str = "array", ending: str = "exit", **options: Any) -> Any:
    """An environment that dies of its seed and its actions, with bundles in a folder."""
    policy = {"crash_folder": str(folder), **options.pop("policy", {})}
    kwargs = {"ending": ending, "actions": actions}
    return make_env(sample("brittle"), env_kwargs=kwargs, policy=policy, **options)


def play(env: Any, steps: int = 2000) -> errors.WorkerDiedError:
    env.action_space.seed(5)
    try:
        for _ in range(steps):
            env.step(env.action_space.sample())
    except errors.WorkerDiedError as error:
        return error
    pytest.fail("it does not die")


@pytest.mark.parametrize(
    ("lane", "n_envs", "shards", "sandbox"),
    [
        ("auto", 1, 1, "process"),
        ("auto", 3, 2, "process"),
        ("frames", 3, 1, "process"),
        ("frames", 3, 2, ["process", "process"]),
    ],
)
def test_a_replay_dies_at_the_same_step(
    tmp_path: Path, lane: str, n_envs: int, shards: int, sandbox: Any
) -> None:
    """Over both lanes and in a fleet, with autoresets, masks, calls and attributes on the way; a
    single environment is not reset where the replayed one was not."""
    place = {
        "use_async_envs": True,
        "num_workers": shards,
        "policy": {"lane": lane},
        "sandbox": sandbox,
    }
    with brittle(tmp_path, n_envs=n_envs, **place) as suites:
        env = suites.env
        env.set_attr("weight", 0.5)
        env.reset(seed=3)
        env.step(np.zeros((n_envs, 2), np.float32))
        env.call("borrow", 2.5)
        mask = np.arange(n_envs) == n_envs - 1
        env.reset(options={"reset_mask": mask, "toll": 1.5})
        error = play(SingleEnv(env) if n_envs == 1 else env)
    assert f"envhub replay {error.bundle}" in str(error)
    found = document("replay", "--grant", str(error.bundle))
    assert (found["verdict"], found["changed_files"]) == ("same", [])
    assert found["replayed"]["requests"] == found["recorded"]["requests"] > 10
    # the luck that it died with, to the last digit: chance has gone the same way
    assert error.log_tail.startswith("no luck: -")
    assert error.log_tail in found["replayed"]["death"]["message"]


@pytest.mark.parametrize(("actions", "ending"), [("dict", "memory"), ("text", "segfault")])
def test_every_ending_and_action_comes_again(tmp_path: Path, actions: str, ending: str) -> None:
    """Signals and memory; actions in mappings, and such as have no fixed layout."""
    limits = {"memory_bytes": 400 << 20}
    with brittle(tmp_path, actions, ending, n_envs=2, policy={"limits": limits}) as suites:
        suites.env.reset(seed=11)
        error = play(suites.env)
    found = document("replay", "--grant", str(error.bundle))
    reason = "signal" if ending == "segfault" else "out-of-memory"
    assert (found["verdict"], found["recorded"]["reason"]) == ("same", error.reason)
    assert error.reason == reason


@pytest.mark.short
def test_a_bundle_holds_what_is_promised(tmp_path: Path) -> None:
    with brittle(tmp_path, n_envs=2) as suites:
        suites.env.reset(seed=[4, 5], options={"toll": 1})
        error = play(suites.env)
        provenance = suites.provenance
    folder = Path(str(error.bundle))
    assert [entry.name for entry in tmp_path.iterdir()] == [folder.name]
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert sorted(path.name for path in folder.iterdir()) == [
        *("README.txt", "arguments.bin", "bundle.json", "requests.bin")
    ]
    document = json.loads((folder / "bundle.json").read_text())
    assert document["provenance"] == json.loads(json.dumps(provenance))
    death = document["death"]
    assert (death["exit_code"], death["output"]) == (9, error.log_tail)
    assert document["make_env"]["policy"] == {"crash_folder": str(tmp_path)}
    words = (folder / "README.txt").read_text()
    for text in ("envhub replay", "exit code 9", "no luck", "seeds=[4, 5]", "Step(env=0"):
        assert text in words
    bundle = load_bundle(folder)
    first: Any = next(bundle.requests())
    assert (first.seeds, first.options) == ([4, 5], {"toll": 1})
    assert bundle.load.env_kwargs == {"ending": "exit", "actions": "array"}


def test_a_mended_repository_survives(tmp_path: Path) -> None:
    """The file is named that has changed, and the exit code says that nothing died."""
    repository = tmp_path / "repository"
    shutil.copytree(sample("brittle"), repository, ignore=shutil.ignore_patterns("__pycache__"))
    policy = {"crash_folder": str(tmp_path / "crashes")}
    with started(repository, policy=policy) as env:
        error = play(env)
    entry = repository / "env.py"
    entry.write_text(entry.read_text().replace("os._exit(9)", "None"))
    found = document("replay", "--grant", str(error.bundle), code=8)
    assert (found["verdict"], found["changed_files"]) == ("survived", ["env.py"])
    entry.write_text(entry.read_text().replace('"exit": lambda: None', '"exit": lambda: 1 / 0'))
    assert document("replay", "--grant", str(error.bundle), code=8)["replayed"]["death"] is None
    entry.write_text(entry.read_text().replace("lambda: 1 / 0", "lambda: os._exit(10)"))
    found = document("replay", "--grant", str(error.bundle), code=7)
    assert (found["verdict"], found["replayed"]["death"]["exit_code"]) == ("different", 10)


def test_a_death_in_make_env_is_repeated_too(tmp_path: Path) -> None:
    options: Any = {"env_kwargs": {"when": "make", "ending": "exit"}}
    with pytest.raises(errors.WorkerDiedError) as caught:
        make_env(sample("exits"), policy={"crash_folder": str(tmp_path)}, **options)
    found = document("replay", "--grant", str(caught.value.bundle))
    assert (found["verdict"], found["replayed"]["requests"]) == ("same", 0)


def test_a_process_that_was_given_up_leaves_a_bundle(tmp_path: Path) -> None:
    """The reset that gives up on a hanging step raises nothing, and writes down why."""
    options = {"policy": {"crash_folder": str(tmp_path)}, "timeouts": {"step_s": 0.5}}
    kwargs = {"moment": "step", "fault": "hang"}
    with started(sample("faulty"), env_kwargs=kwargs, **options) as env:
        with pytest.raises(errors.WorkerTimeoutError):
            env.step([1])
        env.reset(seed=1)
    [folder] = tmp_path.iterdir()
    assert load_bundle(folder).death["reason"] == "timeout"
    assert document("replay", "--grant", str(folder))["verdict"] == "same"


def test_the_last_requests_alone_end_in_another_way(tmp_path: Path) -> None:
    """A replay of half of the requests does not end like one of all."""
    with brittle(tmp_path, policy={"crash_history": 10}) as suites:
        suites.env.reset(seed=1)
        error = play(suites.env)
    found = document("replay", "--grant", str(error.bundle), code=7)
    assert found["replayed"]["requests"] < found["recorded"]["requests"]


def test_no_bundle_where_none_is_wanted(tmp_path: Path) -> None:
    """Nor where none can be written; the death is told all the same."""
    (tmp_path / "taken").write_text("a file")
    for folder, history in ((tmp_path, 0), (tmp_path / "taken", 100)):
        with brittle(folder, policy={"crash_history": history}) as suites:
            suites.env.reset(seed=1)
            error = play(suites.env)
        assert (error.exit_code, error.bundle, "envhub replay" in str(error)) == (9, None, False)
    with brittle(tmp_path) as suites:
        suites.env.reset(seed=1)
    assert list(tmp_path.iterdir()) == [tmp_path / "taken"]


def test_the_oldest_bundles_give_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is no bundle stays. An older reset is forgotten, and a new jail begins anew."""
    monkeypatch.setattr(bundle_writer, "KEPT", 2)
    (tmp_path / "mine").mkdir()
    policy = {"restart": "on_reset", "restart_backoff_s": 0}
    with brittle(tmp_path, policy=policy) as suites:
        suites.env.set_attr("weight", 3.0)
        bundles = []
        for seed in range(4):
            suites.env.reset(seed=seed)
            bundles.append(str(play(suites.env).bundle))
    assert len(set(bundles)) == 4
    requests = load_bundle(Path(bundles[-1])).requests()
    assert [type(one).__name__ for one in requests][:2] == ["Reset", "Step"]
    assert (tmp_path / "mine").is_dir()
    left = {str(path) for path in tmp_path.iterdir()} - {str(tmp_path / "mine")}
    assert (len(left), bundles[-1] in left, left <= set(bundles)) == (2, True, True)


def test_envhub_run_names_the_bundle() -> None:
    arguments = ("--env-kwargs", "moment=step", "--env-kwargs", "fault=kill", "--episodes", "1")
    done = envhub("run", sample("faulty"), *arguments, "--steps", "50", code=5)
    output, _, command = done.stderr.partition("To try the same again: envhub replay ")
    assert "about to kill" in output
    assert eventually(lambda: (Path(command.strip()) / "bundle.json").exists())


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_a_death_that_is_hidden_leaves_a_bundle_too(
    tmp_path: Path, lane: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "envhub_sandbox.crashes")
    place = {"n_envs": 3, "use_async_envs": True, "num_workers": 2}
    policy = {"restart": "transparent", "restart_backoff_s": 0, "lane": lane}
    with brittle(tmp_path, policy=policy, **place) as suites:
        env = suites.env
        env.action_space.seed(5)
        env.reset(seed=3)
        while not env.sandbox.stats()["restarts"]:
            env.step(env.action_space.sample())
        assert env.sandbox.stats()["restarts"] == 1
    [folder] = tmp_path.iterdir()
    assert str(folder) in caplog.text
    assert document("replay", "--grant", str(folder))["verdict"] == "same"


@pytest.mark.parametrize("secret", ["s3cr3t-value-of-it", "s3cr3t-line one\ns3cr3t-line two"])
def test_a_granted_secret_is_not_in_the_bundle(
    secret: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The environment prints it: the error shows it, and no file of the bundle has any of it.
    Nor where it has lines, of which each has a margin, or begins with another variable's value."""
    monkeypatch.setenv("SERVICE_KIND", secret[:6])
    monkeypatch.setenv("SERVICE_KEY", secret)
    code = "import os\nprint('key:', os.environ['SERVICE_KEY'], flush=True)\nos._exit(3)\n"
    granted = ["SERVICE_KIND", "SERVICE_KEY"]
    policy = {"environment": granted, "crash_folder": str(tmp_path / "crashes")}
    with pytest.raises(errors.WorkerDiedError) as caught:
        make_env(write_repository(tmp_path / "env", code), policy=policy)
    assert secret in caught.value.log_tail  # the control: it did print it
    bundle = Path(str(caught.value.bundle))
    files = [path for path in bundle.iterdir() if path.is_file()]
    assert files
    parts = [line[6:].encode() for line in secret.split("\n")]
    assert [path.name for path in files for one in parts if one in path.read_bytes()] == []
    assert b"<the value of SERVICE_KEY>" in (bundle / "README.txt").read_bytes()
