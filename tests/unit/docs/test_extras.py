"""The core imports no extra. Which others an extra may import is in the table of test_imports.py.
The core is what a newcomer reads: processes as the sandbox, the Hub and folders, both lanes,
Gymnasium's interface, the confinement. Each extra is a feature that the core could do without."""

from tests.unit.docs.test_imports import below, imported, modules

# The last is one whose place is its name: users import other libraries' interfaces from there.
EXTRAS = ("envhub_sandbox.extras", "envhub_worker.extras", "envhub_sandbox.integrations")


def is_extra(module: str) -> bool:
    return any(below(module, extras) for extras in EXTRAS)


def test_the_core_imports_no_extra() -> None:
    """It finds one by its name, and does without or says what is missing. Without the package's
    public names: it finds these when they are used."""
    assert set(EXTRAS) <= modules().keys()
    core = {name for name in modules().keys() - {"envhub_sandbox"} if not is_extra(name)}
    assert [(name, target) for name in core for target in imported(name) if is_extra(target)] == []
