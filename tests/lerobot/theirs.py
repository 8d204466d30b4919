"""LeRobot's own tests of environments, in this process and with ours: ``python -m tests.lerobot``.
They lie in its repository and in no wheel, so that they run where ``--source`` names a clone of it.
"""

import os
import re
import subprocess
from pathlib import Path

import pytest

import envhub_sandbox
import envhub_worker
from tests.hub.olah_server import OlahServer
from tests.lerobot.kit import OWN, THEIRS
from tests.lerobot.repositories import CARTPOLE

DIFFERENT = {
    "test_make_env_from_hub_requires_trust_remote_code",  # nothing needs to be trusted
    "test_make_env_from_hub_async",  # asks for AsyncVectorEnv by isinstance
}
_PLUGIN = """
def pytest_configure(config):
    from envhub_sandbox.integrations.lerobot import install
    install()
"""


def failed(folder: Path, olah: OlahServer, home: Path, *options: str) -> tuple[set[str], int]:
    """The tests of ``tests/envs`` that fail, and how many pass."""
    python = os.environ[OWN]
    ours = [Path(str(one.__file__)).parents[1] for one in (envhub_sandbox, envhub_worker)]
    kept = {name: text for name, text in os.environ.items() if not name.startswith("HF_")}
    done = subprocess.run(
        [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options, "tests/envs"],
        cwd=folder,
        env={
            **kept,
            "PYTHONPATH": os.pathsep.join(map(str, [home, *ours])),
            "ENVHUB_CACHE": str(home / "store"),
            "HF_HOME": str(home / "hf"),
            "HF_ENDPOINT": olah.endpoint,
            "HF_HUB_DISABLE_XET": "1",
        },
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    names = set(re.findall(r"^(?:FAILED|ERROR) \S+::(\w+)", done.stdout, re.MULTILINE))
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed, done.stdout[-3000:] + done.stderr[-3000:]
    return names, int(passed.group(1))


def test_lerobots_own_tests_pass(olah: OlahServer, tmp_path: Path) -> None:
    """But for two, which ask for what the sandbox is there to replace."""
    folder = os.environ.get(THEIRS)
    if not folder:
        pytest.skip("needs a clone of LeRobot: --source")
    olah.repository("lerobot/cartpole-env").commit({"env.py": CARTPOLE})
    (tmp_path / "swapped_make_env.py").write_text(_PLUGIN)
    there, passed = failed(Path(folder), olah, tmp_path)
    here, passed_here = failed(Path(folder), olah, tmp_path, "-p", "swapped_make_env")
    print(f"in LeRobot's process {passed} pass and {len(there)} fail: {sorted(there)}")
    print(f"in the sandbox {passed_here} pass and {len(here)} fail: {sorted(here)}")
    assert here - there <= DIFFERENT
    assert here >= DIFFERENT, "these show that ours was asked"
