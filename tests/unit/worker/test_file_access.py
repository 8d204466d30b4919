"""What may not be read is not called missing."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_worker import file_access
from tests.support.interpreter import needs

_LOOK = """
import json, sys
sys.path.insert(0, sys.argv[1])
import file_access
found = {}
for name in sys.argv[3:]:
    sys.path[:] = [sys.argv[2], *sys.path]
    try:
        exec(f"from {name} import anything")
        found[name] = None
    except ImportError as error:
        found[name] = file_access.why_file_hidden(error.name or "")
print(json.dumps(found))
"""


@pytest.fixture
def packages() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for place in ("open", "closed", "half", "half/inner"):
            (root / place).mkdir()
            (root / place / "__init__.py").write_text("anything = 1\n")
        (root / "file_access.py").write_bytes(Path(file_access.__file__).read_bytes())
        for place in ("closed", "half/inner"):
            (root / place).chmod(0)
        root.chmod(0o755)
        yield root
        for place in ("closed", "half/inner"):
            (root / place).chmod(0o700)


needs_another_user = needs("no-userns")


def look(packages: Path, path: Path, *names: str) -> dict[str, str | None]:
    """Import these as a plain user, and what is said of the ones that are not found."""
    command = [sys.executable, "-I", "-S", "-c", _LOOK, packages, path, *names]
    user = {"user": 12345, "group": 12345, "extra_groups": []} if os.getuid() == 0 else {}
    done = subprocess.run(command, capture_output=True, check=True, cwd="/", **user)
    return dict(json.loads(done.stdout))


@needs_another_user
def test_closed_packages_are_told_from_missing_ones(packages: Path) -> None:
    """Each with its owner and mode; what is there is imported, what is not is just missing."""
    found = look(packages, packages, "open", "closed", "half.inner", "nowhere")
    assert found["open"] is None
    assert found["nowhere"] == ""
    uid = 12345 if os.getuid() == 0 else os.getuid()
    for name, place in (("closed", "closed"), ("half.inner", "half/inner")):
        assert f"{packages / place} may not be read by uid {uid}" in str(found[name])
        assert "mode 0000" in str(found[name])


@needs_another_user
def test_closed_folder_of_the_path_is_named(packages: Path) -> None:
    found = look(packages, packages / "closed", "numpy")
    assert str(found["numpy"]).startswith(f"{packages / 'closed'} may not be read")
