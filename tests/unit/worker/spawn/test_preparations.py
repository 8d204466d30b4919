"""The layout of a jail's cache of the Hub, as huggingface_hub reads it. The stub of LeRobot: the
names of its contract, and only where it is not installed."""

import dataclasses
import importlib
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from huggingface_hub import snapshot_download

from envhub_worker.extras import lerobot_stub
from envhub_worker.lockdown.spec import JailSpec
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.messages import CONFIG_CLASS
from envhub_worker.protocol.runtime import HubCopy
from envhub_worker.runner.loader import config_of
from envhub_worker.spawn.runner_entry import make_hub_cache

COMMIT = "ab" * 20


def spec_of(snapshot: Path, *copies: HubCopy, **environment: str) -> JailSpec:
    confinement = Confinement(environment=environment)
    return JailSpec(
        snapshot=str(snapshot), entry="env.py", confinement=confinement, hub_copies=copies
    )


def test_the_snapshot_is_a_link_to_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every runner of a jail makes the same, and huggingface_hub finds it without a network."""
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    other = tmp_path / "other"
    own = HubCopy("models--org--repo", COMMIT, ("main", "refs/pr/3"), "")
    spec = spec_of(tmp_path, own, HubCopy("datasets--org--data", COMMIT, ("main",), str(other)))
    for _ in range(2):
        make_hub_cache(spec)
    hub = tmp_path / "hf/hub"
    assert (hub / "models--org--repo/refs/refs/pr/3").read_text() == COMMIT
    assert (hub / "models--org--repo/snapshots" / COMMIT).readlink() == tmp_path
    assert (hub / "datasets--org--data/snapshots" / COMMIT).readlink() == other
    found = snapshot_download("org/repo", cache_dir=hub, local_files_only=True)
    assert Path(found).resolve() == tmp_path.resolve()


def test_the_callers_cache_stays_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HOME", str(tmp_path / "theirs"))
    copy = HubCopy("models--org--repo", COMMIT, ("main",), "")
    make_hub_cache(spec_of(tmp_path, copy, HF_HOME=str(tmp_path / "theirs")))
    assert not (tmp_path / "theirs").exists()


@pytest.fixture(autouse=True)
def stub(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = list(sys.meta_path)
    for name in [one for one in sys.modules if one.partition(".")[0] == "lerobot"]:
        monkeypatch.delitem(sys.modules, name)
    lerobot_stub.install()
    yield
    sys.meta_path[:] = before
    for name in [one for one in sys.modules if one.partition(".")[0] == "lerobot"]:
        del sys.modules[name]


def test_the_contract_is_there_and_it_warns_once() -> None:
    with pytest.warns(UserWarning, match="lerobot is not installed in the jail"):
        importlib.import_module("lerobot")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        configs = importlib.import_module("lerobot.envs.configs")
    types = importlib.import_module("lerobot.configs.types")
    constants = importlib.import_module("lerobot.utils.constants")
    assert importlib.import_module("lerobot.constants").ACTION == constants.ACTION
    assert issubclass(configs.HubEnvConfig, configs.EnvConfig)
    made = configs.HubEnvConfig(hub_path="org/repo", fps=10)
    assert dataclasses.asdict(made)["hub_path"] == "org/repo"
    own = configs.EnvConfig.register_subclass("own")(type("Own", (configs.EnvConfig,), {}))
    assert own().gym_kwargs == {}
    assert types.PolicyFeature(type=types.FeatureType.ACTION, shape=(2,)).type == "ACTION"
    assert constants.OBS_IMAGES == "observation.images"


@pytest.mark.filterwarnings("ignore:lerobot is not installed")
def test_the_rest_is_missing_as_before() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"lerobot\.policies"):
        importlib.import_module("lerobot.policies")
    with pytest.raises(ImportError, match="AlohaEnv"):
        exec("from lerobot.envs.configs import AlohaEnv")


def test_lerobot_has_what_the_stub_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither for the stub's names nor for a caller's configuration, which counts as what it is in
    LeRobot once that is there; and without a warning, since LeRobot is installed."""
    for package in ("lerobot", "lerobot/envs"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("__version__ = '9'\n")
    (tmp_path / "lerobot" / "envs" / "configs.py").write_text(
        "class EnvConfig: pass\nclass HubEnvConfig(EnvConfig): pass\n"
        "class Arena(HubEnvConfig): pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    names = tuple(("lerobot.envs.configs", kind) for kind in ("Arena", "HubEnvConfig"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        stub = importlib.import_module("lerobot.envs.configs")
        root = importlib.import_module("lerobot")
    cfg = config_of({"hub_path": "org/repo", CONFIG_CLASS: (names, ("hub_path",), {})})
    assert isinstance(cfg, stub.HubEnvConfig)
    assert not hasattr(sys.modules["lerobot"], "__file__")
    assert "Arena" not in vars(sys.modules["lerobot.envs.configs"]), "LeRobot itself was imported"
    from lerobot.envs.configs import Arena

    assert Arena is vars(importlib.import_module("lerobot.envs.configs"))["Arena"]
    assert isinstance(cfg, Arena)
    assert isinstance(Arena(), stub.EnvConfig)
    assert root.__version__ == "9"
    assert not isinstance(tmp_path, stub.EnvConfig)
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("lerobot.policies")
