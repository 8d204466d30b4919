"""Who may import whom: the arrows of docs/architecture.md, read off the source itself."""

import ast
import importlib.util
import shutil
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import envhub_sandbox
from tests.support.command_line import python
from tests.support.samples import sample

WORKERS_OWN = {"cloudpickle", "envhub_worker", "gymnasium", "msgpack", "numpy", "zmq"}
CLIENTS_OWN = {
    *("cloudpickle", "envhub_sandbox", "envhub_worker", "gymnasium", "huggingface_hub", "msgpack"),
    *("numpy", "packaging", "platformdirs", "psutil", "pyproject_hooks", "rich", "tomli"),
    *("tomllib", "typer", "uv", "yaml", "zmq"),
}
# used where they are installed, and only there
OPTIONAL = {
    "envhub_worker.protocol.messages.compression": {"lz4"},
    "envhub_sandbox.integrations.sb3": {"stable_baselines3"},
    "envhub_sandbox.integrations.lerobot.config": {"draccus", "lerobot"},
    "envhub_sandbox.integrations.lerobot.features": {"lerobot"},
    "envhub_sandbox.integrations.lerobot.install": {"lerobot"},
    "envhub_sandbox.integrations.lerobot_eval": {"lerobot"},
    "envhub_worker.protocol.messages.message": {"typing_extensions"},  # for type checkers alone
    "envhub_sandbox.integrations.metrics": {"prometheus_client"},
    "envhub_worker.extras.access.commands.metrics": {"prometheus_client"},
    "envhub_sandbox.extras.ray.actor": {"ray"},
    "envhub_sandbox.extras.ray.cluster": {"ray"},
    "envhub_sandbox.transport.values": {"torch"},
    "envhub_sandbox.play.video": {"imageio_ffmpeg"},
    "envhub_sandbox.integrations.pytest_plugin": {"pytest"},
}
DESERIALISERS = {"_pickle", "copyreg", "dill", "joblib", "marshal", "pickle", "shelve"}
# Which package may import which; a package is a folder or a module right below one of the two, or
# an extra. What an extra imports of others is little: the two tests of the table see to that.
# Every package may import the lowest ones, LOWEST, as far as these stand below it.
LOWEST = {
    *("envhub_sandbox.errors", "envhub_sandbox.settings"),
    *("envhub_sandbox.system", "envhub_worker.protocol"),
}
MAY_IMPORT = {
    "envhub_sandbox": {
        *("factory", "hub", "integrations", "vector"),
        # for type checkers alone; otherwise these public names are looked up when they are used
        *("extras.docker", "extras.fleet", "extras.ray", "extras.remote"),
    },
    "envhub_sandbox.__main__": {"cli"},
    "envhub_sandbox.cli": {"", "factory", "hub", "play", "sandboxes"},
    "envhub_sandbox.factory": {*("hub", "sandboxes", "session", "transport", "vector")},
    "envhub_sandbox.integrations": {"factory", "hub", "session", "vector"},
    "envhub_sandbox.play": {"vector"},
    "envhub_sandbox.vector": {"session", "transport"},
    "envhub_sandbox.session": {"hub", "sandboxes", "transport"},
    "envhub_sandbox.sandboxes": {"hub", "transport"},
    "envhub_sandbox.transport": set(),
    "envhub_sandbox.hub": set(),
    "envhub_sandbox.errors": set(),
    "envhub_sandbox.settings": set(),
    "envhub_sandbox.system": set(),
    "envhub_sandbox.extras": set(),
    "envhub_sandbox.extras.crash": {"cli", "factory", "hub", "session", "transport"},
    "envhub_sandbox.extras.docker": {
        *("cli", "extras.packages", "extras.remote", "hub", "sandboxes", "transport")
    },
    "envhub_sandbox.extras.fleet": {
        *("extras.packages", "extras.remote", "sandboxes", "transport")
    },
    "envhub_sandbox.extras.judge": {
        *("", "cli", "extras.packages", "extras.sources", "factory", "hub", "play", "vector")
    },
    "envhub_sandbox.extras.packages": {"cli", "extras.sources", "factory", "hub"},
    "envhub_sandbox.extras.ray": {"extras.packages", "extras.remote", "sandboxes", "transport"},
    "envhub_sandbox.extras.remote": {"cli", "extras.packages", "hub", "sandboxes", "transport"},
    "envhub_sandbox.extras.restart": {"session", "transport"},
    "envhub_sandbox.extras.several_workers": {"session", "transport", "vector"},
    "envhub_sandbox.extras.sources": {"hub"},
    "envhub_sandbox.extras.starter": {"cli"},
    "envhub_sandbox.extras.wheel_builder": {"factory", "hub", "sandboxes", "session"},
    "envhub_worker.__main__": {"find_extra", "server"},
    "envhub_worker.server": {"", "find_extra", "lockdown", "loop", "spawn", "supervisor"},
    "envhub_worker.supervisor": {"lockdown", "loop", "spawn"},
    "envhub_worker.spawn": {"bootstrap", "find_extra", "lockdown"},
    "envhub_worker.lockdown": {""},
    "envhub_worker.runner": {"file_access", "find_extra", "lockdown"},
    "envhub_worker.bootstrap": set(),
    "envhub_worker.loop": set(),
    "envhub_worker.file_access": set(),
    "envhub_worker.find_extra": set(),
    "envhub_worker.protocol": set(),
    "envhub_worker": set(),
    "envhub_worker.extras": set(),
    "envhub_worker.extras.access": {
        *("", "extras.surroundings", "lockdown", "loop", "server", "supervisor")
    },
    "envhub_worker.extras.bytecode": {"lockdown"},
    "envhub_worker.extras.denials": {"lockdown"},
    "envhub_worker.extras.display": {"lockdown"},
    "envhub_worker.extras.lerobot_stub": set(),
    "envhub_worker.extras.old_gym": {"runner"},
    "envhub_worker.extras.surroundings": {"", "lockdown"},
}
# beyond the table: what a module or a package must know nothing of
IGNORANT = {
    "envhub_sandbox.vector": {"socket", "subprocess", "envhub_sandbox.transport.connection"},
    "envhub_sandbox.transport": {"gymnasium.vector", "envhub_sandbox.settings.policy"},
    "envhub_sandbox.settings": {"gymnasium", "subprocess"},
    "envhub_sandbox.hub": {"gymnasium", "runpy", "envhub_sandbox.settings.policy"},
    "envhub_sandbox.extras.packages": {"envhub_sandbox.settings.policy"},
    "envhub_sandbox.system": {"envhub_sandbox.settings"},
    "envhub_sandbox.hub.reference": {"huggingface_hub"},
    "envhub_sandbox.hub.snapshot": {"importlib"},
    "envhub_worker.lockdown": {"numpy", "gymnasium"},
}
# where ZeroMQ is spoken; everything else speaks in messages
ZEROMQ = {
    *("envhub_sandbox.extras.remote", "envhub_sandbox.transport"),
    *("envhub_worker.extras.access", "envhub_worker.loop", "envhub_worker.server"),
}
# what makes the memory and the doorbells of the fast lane, which client and server both do
MAKES_SLABS = "envhub_worker.protocol.shared_memory.descriptors"
WITHOUT_IO = {"asyncio", "multiprocessing", "os", "select", "socket", "subprocess", "zmq"}
# who runs code by a name that is not written in its source, and whose code that is
IMPORTERS = {
    "envhub_sandbox": "our own public names",
    "envhub_sandbox.system.extras": "our own extras",
    "envhub_sandbox.sandboxes.inprocess": "the repository's, where sandbox=None trusts it",
    "envhub_worker.bootstrap": "our own programs",
    "envhub_worker.extras.lerobot_stub": "LeRobot's, where it is installed in a jail",
    "envhub_worker.find_extra": "our own extras",
    "envhub_worker.runner.loader": "the repository's",
    "envhub_worker.runner.returned": "nothing but 'raise error', in the place of a line",
    "envhub_worker.spawn.runner_entry": "the program of a runner, which the server names",
    "envhub_worker.spawn.zygote": "a list of our own",
}


def folder(package: str) -> Path:
    spec = importlib.util.find_spec(package)
    return Path(spec.origin).parent


@cache
def modules() -> dict[str, ast.Module]:
    found = {}
    for package in ("envhub_sandbox", "envhub_worker"):
        root = folder(package)
        for path in sorted(root.rglob("*.py")):
            parts = [package, *path.relative_to(root).with_suffix("").parts]
            name = ".".join(part for part in parts if part != "__init__")
            found[name] = ast.parse(path.read_text(), str(path))
    return found


@cache
def imported(name: str) -> frozenset[str]:
    """What a module imports anywhere in it, with full names; of ours, the modules."""
    found: set[str] = set()
    for node in ast.walk(modules()[name]):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} has a relative import"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full in modules() else str(node.module))
    return frozenset(found)


def arrows(package: str) -> Iterator[tuple[str, str]]:
    """Every import of a module of ``package``."""
    for name in modules():
        if name.split(".")[0] == package:
            for target in imported(name):
                yield name, target


def below(target: str, package: str) -> bool:
    return target == package or target.startswith(f"{package}.")


def foreign(package: str, own: set[str]) -> list[tuple[str, str]]:
    return [
        (name, target)
        for name, target in arrows(package)
        if (top := target.split(".")[0]) not in sys.stdlib_module_names
        and top not in own | OPTIONAL.get(name, set())
    ]


@pytest.mark.parametrize(
    ("package", "own"), [("envhub_worker", WORKERS_OWN), ("envhub_sandbox", CLIENTS_OWN)]
)
def test_a_package_needs_what_it_declares(package: str, own: set[str]) -> None:
    """The worker's one folder can be put in front of any interpreter that has five packages."""
    assert foreign(package, own) == []


def test_protocol_does_no_io() -> None:
    """The wire is pure functions over values; one module makes what memory is shared by."""
    wrong = [
        (name, target)
        for name, target in arrows("envhub_worker")
        if below(name, "envhub_worker.protocol") and name != MAKES_SLABS
        if target.split(".")[0] in WITHOUT_IO
    ]
    assert wrong == []


def package_of(module: str) -> str:
    parts = module.split(".")
    return ".".join(parts[: 3 if "extras" in parts[1:2] else 2])


def may_import(package: str) -> set[str]:
    top = package.split(".")[0]
    return LOWEST | {f"{top}.{name}".rstrip(".") for name in MAY_IMPORT[package]}


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_packages_import_only_what_the_table_permits(package: str) -> None:
    """An arrow that is not in the table is a decision, to be made there."""
    found = {
        (name, target)
        for name in modules()
        if package_of(name) == package
        for target in imported(name)
        if target in modules() and package_of(target) not in (package, *may_import(package))
    }
    assert found == set()


def test_the_table_has_every_package_and_nothing_else() -> None:
    """What is new has to say whom it imports; what is gone is taken out."""
    assert set(MAY_IMPORT) == {package_of(name) for name in modules()} - {"envhub_sandbox.__init__"}


def test_the_table_permits_no_arrow_that_nobody_uses() -> None:
    """It is a picture of the house, not of what might be; and it has a direction: no cycle."""
    used = {
        (package_of(name), package_of(target))
        for name in modules()
        for target in imported(name)
        if target in modules()
    }
    permitted = {
        (source, target) for source in MAY_IMPORT for target in may_import(source) - LOWEST
    }
    assert permitted - used == set()
    graph = {package: may_import(package) - {package} for package in MAY_IMPORT}
    graph["envhub_sandbox"] = set()  # public names are looked up when they are used
    for lowest in LOWEST:
        graph[lowest] = {target for target in graph[lowest] if target < lowest} - LOWEST
    list(TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("name", IGNORANT)
def test_modules_know_nothing_of_what_is_not_their_business(name: str) -> None:
    """The Gymnasium face knows no sockets, the transport no vector environment, and so on."""
    known = [
        (module, target)
        for module in modules()
        if below(module, name)
        for target in imported(module)
        for thing in IGNORANT[name]
        if below(target, thing)
    ]
    assert known == []


def test_zeromq_is_spoken_in_a_few_packages() -> None:
    users = {
        package_of(name)
        for package in ("envhub_sandbox", "envhub_worker")
        for name, target in arrows(package)
        if target == "zmq"
    }
    assert users == ZEROMQ


def test_nothing_unpickles_but_the_jail() -> None:
    """There is one ``loads`` of anything but JSON and TOML in the tree, and it is in the jail.
    Neither package has a deserialiser at hand; cloudpickle is the client's way out, the jail's
    in."""
    assert list(loaders()) == [("envhub_worker.runner.runner", "cloudpickle.loads")]
    every = [*arrows("envhub_sandbox"), *arrows("envhub_worker")]
    assert [one for one in every if one[1].split(".")[0] in DESERIALISERS] == []
    users = {name for name in modules() if "cloudpickle" in imported(name)}
    assert users == {"envhub_sandbox.transport.values", "envhub_worker.runner.runner"}


_LOADERS = ("load", "loads", "Unpickler")


def loaders() -> Iterator[tuple[str, str]]:
    for name, tree in modules().items():
        aliases = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    aliases[alias.asname or alias.name.split(".")[0]] = alias.name
            elif isinstance(node, ast.ImportFrom):
                top = str(node.module).split(".")[0]
                for alias in node.names:
                    if alias.name in _LOADERS and top not in ("envhub_sandbox", "envhub_worker"):
                        yield name, f"{node.module}.{alias.name}"
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and node.attr in _LOADERS:
                base = ast.unparse(node.value)
                if aliases.get(base, "") not in ("", "json", "tomli", "tomllib"):
                    yield name, f"{aliases[base]}.{node.attr}"


def test_only_the_loader_imports_by_computed_names() -> None:
    """Nobody else could import a repository; each exception is listed with its reason."""
    assert {name for name, tree in modules().items() if computes_imports(tree)} == set(IMPORTERS)


def computes_imports(tree: ast.Module) -> bool:
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        function = ast.unparse(node.func).rpartition(".")[2]
        literal = bool(node.args) and isinstance(node.args[0], ast.Constant)
        if function in ("import_module", "__import__") and not literal:
            return True
        if function in ("exec", "eval", "compile", "exec_module", "run_path", "run_module"):
            base = ast.unparse(node.func)
            if base not in ("re.compile",):
                return True
    return False


def loaded_by(source: str) -> set[str]:
    """The modules in a fresh interpreter that has run ``source``, and what ``source`` prints."""
    names = python("-c", f"{source}\nimport sys; print(*sys.modules)").stdout.split()
    return {*names, *(name.split(".")[0] for name in names)}


def test_the_package_imports_nothing_heavy() -> None:
    heavy = CLIENTS_OWN - {"envhub_sandbox"} | {"torch"}
    assert not loaded_by("import envhub_sandbox") & heavy


def test_the_pytest_plugin_costs_nothing_until_it_is_used(checkout: Path) -> None:
    loaded = loaded_by("import envhub_sandbox.integrations.pytest_plugin")
    assert "pytest" in loaded
    assert not loaded & (CLIENTS_OWN - {"envhub_sandbox"} | {"torch"}) - loaded_by("import pytest")
    declared = (checkout / "pyproject.toml").read_text()
    table = declared.partition("[project.entry-points.pytest11]\n")[2].partition("\n[")[0]
    assert table.strip() == 'envhub = "envhub_sandbox.integrations.pytest_plugin"'


def test_every_public_name_is_there() -> None:
    """What ``__all__`` promises can be had, and ``dir()`` shows it."""
    for name in envhub_sandbox.__all__:
        assert getattr(envhub_sandbox, name) is not None
        assert name in dir(envhub_sandbox)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        envhub_sandbox.nothing  # noqa: B018


def test_the_protocol_loads_neither_zeromq_nor_the_hub() -> None:
    names = [name for name in modules() if below(name, "envhub_worker.protocol")]
    loaded = loaded_by("import " + ", ".join(names))
    assert "numpy" in loaded
    assert not loaded & {"zmq", "huggingface_hub", "envhub_sandbox", "torch", "psutil"}


@pytest.mark.usefixtures("snapshot_store")
def test_what_speaks_with_a_server_is_imported_while_that_starts(tmp_path: Path) -> None:
    """It costs nothing then. A known manifest, ``make_env`` and the start need none of it, nor what
    reads requirements, though the repository imports a module that none is known to bring.
    """
    repository = shutil.copytree(sample("marker"), tmp_path / "repository")
    with (repository / "env.py").open("a") as entry:
        entry.write("\n\nif HERE is None:\n    import known_to_nobody\n")
    made = f"""
import subprocess, sys
from envhub_sandbox import make_env
suites = make_env({str(repository)!r})
"""
    start = """
starts = subprocess.Popen.__init__
def watched(*arguments, **options):
    print(*sys.modules)
    starts(*arguments, **options)
subprocess.Popen.__init__ = watched
suites.env.reset()
sys.exit()
"""
    late = {"cloudpickle", "huggingface_hub", "packaging", "tomllib", "zmq"}
    loaded_by(made)  # from here on the manifest is known
    when_it_starts = loaded_by(made + start)
    assert "envhub_sandbox" in when_it_starts
    assert not when_it_starts & late
    played = """
suites.env.reset()
for _ in range(64):
    suites.env.step(suites.env.action_space.sample())
suites.close()
"""
    when_it_ends = loaded_by(made + played)
    assert "zmq" in when_it_ends
    assert "numpy.ma" not in when_it_ends  # nor does what follows a step import anything large
