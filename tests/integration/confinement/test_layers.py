"""Each layer denies what it is there for; the same source succeeds without a jail.
What an environment can try is in ``tests/attacks``: files, sockets and processes outside."""

import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

import envhub_sandbox
import envhub_worker
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.spawn.jail import JailFailed
from tests.support import inside
from tests.support.command_line import python
from tests.support.confinement_kit import (
    KIT,
    Cell,
    RunnerStarted,
    cell_in,
    make_snapshot,
    new_cell,
    open_folder,
    spawner_in,
    unconfined,
)
from tests.support.interpreter import can_run, needs, profiles, ways_to_it
from tests.support.repositories import STILL


@pytest.fixture(scope="module")
def cells() -> Iterator[dict[str, Cell]]:
    with ExitStack() as stack:
        yield {
            profile: stack.enter_context(
                cell_in(stack.enter_context(open_folder()), Confinement(profile=profile))
            )
            for profile in ("strict", "no-userns", "container")
            if can_run(profile)
        }


@pytest.fixture(params=profiles("strict", "no-userns", "container"))
def cell(request: pytest.FixtureRequest, cells: dict[str, Cell]) -> Cell:
    return cells[request.param]


def test_no_secret_of_another_jail_is_in_memory() -> None:
    """What one jail is granted never passes through the zygote that forks the next one; whose
    snapshot may be named through a link."""
    secret = "hf_" + "Q7w" * 9
    search = """
import re
parts = [{first!r}, {rest!r}]
needle = "".join(parts).encode()
found = 0
with open("/proc/self/maps") as maps, open("/proc/self/mem", "rb", 0) as memory:
    for line in maps:
        low, high = (int(part, 16) for part in line.split()[0].split("-"))
        if "r" in line.split()[1] and "[v" not in line:
            memory.seek(low)
            try:
                found += memory.read(high - low).count(needle)
            except OSError:
                pass
result = found
"""
    # The source itself must not hold the needle in one piece.
    source = search.format(first=secret[:5], rest=secret[5:])
    confinement = Confinement()
    granted = replace(confinement, environment={"TOKEN": secret})
    with open_folder() as folder, spawner_in(folder, confinement) as spawner:
        snapshot = make_snapshot(folder)
        rich = new_cell(spawner, snapshot, granted)
        rich.start()
        assert rich.run("import os; result = len(os.environ['TOKEN'])") == {"result": len(secret)}
        assert rich.run(source)["result"] > 1  # the control: it is in this one
        (folder / "alias").symlink_to(folder, target_is_directory=True)
        poor = new_cell(spawner, str(folder / "alias" / "snapshot"), confinement)
        poor.start()
        assert poor.run("result = open('env.py').read()") == {"result": "VALUE = 7\n"}
        # One copy is the needle that the search itself built.
        assert poor.run(source)["result"] <= 1


def test_init_is_out_of_reach(cell: Cell) -> None:
    """The runner's parent cannot be ended, stopped, traced, limited or read."""
    source = """
import os, resource, signal
init, held = os.getppid(), []
def attempt(name, action):
    try:
        action()
    except (OSError, ValueError):
        held.append(name)
attempt("limit", lambda: resource.prlimit(init, resource.RLIMIT_NOFILE, (3, 3)))
attempt("memory", lambda: open(f"/proc/{init}/mem", "rb"))
attempt("environ", lambda: open(f"/proc/{init}/environ", "rb").read(1))
attempt("descriptors", lambda: os.listdir(f"/proc/{init}/fd"))
for signum in (signal.SIGSTOP, signal.SIGKILL, signal.SIGTERM):
    attempt("signal", lambda: os.kill(init, signum))
result = held
"""
    held = cell.run(source)["result"]
    assert held == ["limit", "memory", "environ", "descriptors", "signal", "signal", "signal"]
    runner = cell.start()
    assert cell.run("result = 'init lives'", runner) == {"result": "init lives"}
    cell.hang_up(runner)


# What lies in the host's own folders and is not on the way to what the jail is granted.
STRANGE = """
import os
def strange(path):
    below = [grant for grant in GRANTS if grant.startswith(path + "/")]
    if path in GRANTS or not os.path.lexists(path):
        return []
    if not below and path not in TOPS:
        return [path]
    try:
        return [found for name in os.listdir(path) for found in strange(path + "/" + name)]
    except PermissionError:
        return []
result = [found for top in TOPS for found in strange(top)]
"""


@pytest.mark.short
def test_strict_root_shows_of_homes_the_way_to_the_interpreter(cells: dict[str, Cell]) -> None:
    """Wherever that lies, below /root or in a home: its neighbours are not there."""
    tops = ["/home", "/root", "/run", "/var", "/boot", "/mnt", "/opt", "/srv"]
    granted = [*map(str, ways_to_it()), KIT, cells["strict"].jail.spec.snapshot]
    source = f"GRANTS, TOPS = {granted!r}, {tops!r}\n{STRANGE}"
    assert unconfined(source)["result"] != []
    assert cells["strict"].run(source) == {"result": []}


@pytest.mark.short
def test_strict_root_holds_nothing_of_the_host(cells: dict[str, Cell]) -> None:
    """No secret, mount or process; a loopback device, which is down, and harmless other ones. What
    the kernel counts for the user is forbidden, should the filter let it by, such as watches."""
    source = """
import os
result = {
    "etc": sorted(os.listdir("/etc")),
    "dev": sorted(os.listdir("/dev")),
    "net": [line.split(":")[0].strip() for line in open("/proc/net/dev").readlines()[2:]],
    "pids": [int(name) for name in os.listdir("/proc") if name.isdigit()],
    "there": [p for p in ("/.scratch/home", "/etc/shadow", "/etc/machine-id", "/sys/kernel")
              if os.path.exists(p)],
    "writable": [p for p in ("/", "/usr", "/usr/bin", "/etc", "/dev", "/proc", "/sandbox", "/sys")
                 if os.access(p, os.W_OK)],
    "told": [p for p in ("cmdline", "kallsyms", "interrupts", "partitions", "keys", "diskstats",
                         "sys/kernel/random/boot_id") if open("/proc/" + p).read()],
    "group": open("/proc/self/cgroup").read(),
    "counted": {open("/proc/sys/user/" + name).read() for name in os.listdir("/proc/sys/user")}
               == {"0\\n"},
}
"""
    seen = cells["strict"].run(source)["result"]
    assert {"passwd", "group", "hosts"} <= set(seen["etc"])
    assert not {"shadow", "ssh", "sudoers", "machine-id"} & set(seen["etc"])
    nodes = {"null", "full", "random", "urandom", "tty"}
    assert set(seen["dev"]) == nodes | {"fd", "stdin", "stdout", "stderr", "shm", "pts", "ptmx"}
    assert seen["net"] == ["lo"]
    assert max(seen["pids"]) < 100
    assert (seen["there"], seen["writable"], seen["told"], seen["counted"]) == ([], [], [], True)
    outside = unconfined(source)["result"]
    assert os.getpid() in outside["pids"]
    assert "sys/kernel/random/boot_id" in outside["told"], "the control failed"
    assert not outside["counted"]
    assert not re.findall(rf"\b{os.getpid()}\b|\b_{os.getpid()}_", seen["group"])


LINKED = """
import os, sys
sys.path[:0] = [sys.argv[1] + "/worker", sys.argv[1] + "/client"]
import envhub_sandbox, envhub_worker
assert envhub_worker.__file__.startswith(sys.argv[1]), envhub_worker.__file__
with envhub_sandbox.make_env(sys.argv[2], policy={"profile": sys.argv[3]}) as suites:
    suites.env.reset(seed=0)
    print(suites.env.call("own_path")[0].startswith(sys.argv[1]))
    print(suites.env.call("late")[0])
    try:
        print(suites.env.call("unsendable"))
    except Exception as error:
        print(error)
"""
LATE = f"""{STILL}
import sys
class Late(Still):
    def own_path(self):
        return sys.modules["envhub_worker"].__file__
    def late(self):
        import envhub_worker.extras.access.commands.health
        return "imported"
    def unsendable(self):
        endless = []
        endless.append(endless)
        return endless
"""


@pytest.mark.parametrize("strict", profiles("strict"))
def test_a_link_below_tmp_leads_to_the_worker_all_the_time(tmp_path: Path, strict: str) -> None:
    """A jail has a /tmp of its own, with the links in it that its interpreter is reached by: what
    is imported late is found, and with it the answer that needed it."""
    (tmp_path / "env.py").write_text(LATE)
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        os.chmod(folder, 0o755)
        for name, package in (("worker", envhub_worker), ("client", envhub_sandbox)):
            os.symlink(Path(str(package.__file__)).resolve().parents[1], f"{folder}/{name}")
        done = python("-c", LINKED, folder, tmp_path, strict)
    below, late, answer = done.stdout.splitlines()[:3]
    assert (below, late) == ("True", "imported")
    assert "cannot be sent: it contains itself" in answer


@pytest.mark.short
def test_strict_store_shows_one_snapshot_and_no_mount_permits_more_than_it_must() -> None:
    """Where the store does not lie below /tmp, which each jail covers anyway."""
    with open_folder("/var/tmp") as folder, cell_in(folder, Confinement()) as cell:
        (folder / "other").mkdir()
        source = f"import os; result = os.path.exists({str(folder / 'other')!r})"
        assert (unconfined(source), cell.run(source)) == ({"result": True}, {"result": False})
        lines = Path(f"/proc/{cell.wait_for(RunnerStarted).pid}/mountinfo").read_text().splitlines()
    # of several at one place the last one is seen
    options = {line.split()[4]: set(line.split()[5].split(",")) for line in lines}
    nodes = {path for path in options if "nodev" not in options[path]}
    assert all(path.startswith(("/dev/", "/proc/")) for path in nodes)
    assert all("noexec" in options[path] for path in nodes)
    assert all("nosuid" in one for one in options.values())
    own = {"/sandbox/home", "/sandbox/work", "/tmp", "/dev/shm", "/proc", cell.jail.spec.snapshot}
    assert {path for path in options if "ro" not in options[path]} - nodes <= own


@pytest.mark.short
def test_strict_jails_of_one_zygote_share_no_namespace(cells: dict[str, Cell]) -> None:
    """Nor with the host; the name of the host, which none can change, is their zygote's."""
    first = cells["strict"]
    second = new_cell(first.spawner, first.jail.spec.snapshot, Confinement())
    second.start()
    pids = [cell.wait_for(RunnerStarted).pid for cell in (first, second)]
    for name in ("cgroup", "ipc", "mnt", "net", "pid", "user", "uts"):
        found = {os.readlink(f"/proc/{pid}/ns/{name}") for pid in (*pids, os.getpid())}
        assert len(found) == (2 if name == "uts" else 3), name
    second.jail.kill()


@pytest.mark.short
def test_capabilities_and_privileges_are_gone(cell: Cell) -> None:
    """As the kernel says it of the runner; an exec brings nothing back. Init has none either.
    As root, the jail runs as a user that owns and runs nothing; never as uid 0. Where the host
    itself has no memory left, the kernel ends a jail first. The zygote's configuration, with the
    paths of the server, is not in a runner's command line; outside, its pid is the one that was
    said."""
    source = """
import os, subprocess
with open("/proc/self/status") as status:
    text = subprocess.check_output(["/bin/cat"], stdin=status, text=True)
result = {line.split(":")[0]: line.split()[-1] for line in text.splitlines() if line.split()[1:]}
result["uid"] = os.getuid()
"""
    status = cell.run(source)["result"]
    sets = ["CapInh", "CapPrm", "CapEff", "CapAmb"]
    if os.geteuid() == 0 or cell.jail.spec.confinement.profile == "strict":
        sets.append("CapBnd")
    assert {int(status[name], 16) for name in sets} == {0}
    assert (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2")
    assert status["uid"] != 0
    init = psutil.Process(cell.wait_for(RunnerStarted).pid).ppid()
    held = Path(f"/proc/{init}/status").read_text().split()
    assert {held[held.index(f"{name}:") + 1] for name in sets} == {"0" * 16}
    assert held[held.index("NoNewPrivs:") + 1] == "1"
    runner = Path(f"/proc/{cell.wait_for(RunnerStarted).pid}")
    if os.geteuid() == 0:
        assert runner.stat().st_uid > 60000
    assert (runner / "oom_score_adj").read_text() == "1000\n"
    arguments = cell.run("result = open('/proc/self/cmdline').read().split(chr(0))")["result"]
    assert (arguments[1], arguments[3], arguments[5:]) == ("-s", "zygote", [""])
    assert arguments[4].isdigit()
    assert "zygote" in (runner / "cmdline").read_text()


@pytest.mark.short
@pytest.mark.parametrize("profile", profiles("strict", "no-userns"))
def test_denial_that_does_not_hold_aborts(profile: str) -> None:
    """The self-test finds that the canary can be read, and nothing of the repository runs."""
    with open_folder() as folder:
        # Grants the server's own runtime folder, where the canary lies.
        confinement = Confinement(profile=profile, readable=(str(folder),))
        with spawner_in(folder, confinement) as spawner:
            inside.runtime_folder(spawner).chmod(0o755)  # under root, the jail is another user
            cell = new_cell(spawner, make_snapshot(folder), confinement)
            cell.start()
            failed = cell.wait_for(JailFailed)
            assert failed.layer == "self-test"
            assert "files outside cannot be read" in failed.reason
            assert not [event for event in cell.events if isinstance(event, RunnerStarted)]


RESTRICTED = """
import os, sys
sys.path.insert(0, {kit!r})
from pathlib import Path
from confinement_kit import *
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.spawn.jail import JailFailed
from envhub_worker.lockdown.seccomp import bpf, filter as seccomp
from envhub_worker.lockdown.mechanisms import namespaces, process
from envhub_worker.lockdown.seccomp.bpf import LOAD, RETURN, JUMP_EQUAL, Branch, Do, Label
from envhub_worker.lockdown.seccomp.syscalls import syscall_number
{restrict}
with open_folder() as folder, cell_in(folder, Confinement(profile={profile!r})) as cell:
    while not any(isinstance(event, (JailFailed, RunnerStarted)) for event in cell.events):
        cell.pump()
    for event in cell.events:
        if isinstance(event, JailFailed):
            print(event.layer, "|", event.reason, "|", event.fix)
        elif isinstance(event, RunnerStarted):
            print("started", [l["layer"] for l in event.report if not l["enforced"]])
"""
NO_USER_NAMESPACES = """
namespaces.enter_user_namespace(os.getuid(), os.getgid())
namespaces.forbid_what_is_counted()
"""
NO_LANDLOCK = """
process.set_no_new_privileges()
seccomp.install(bpf.to_bytes(bpf.assemble([
    Do(LOAD, 0),
    Branch(JUMP_EQUAL, syscall_number("landlock_create_ruleset"), "hide", None),
    Do(RETURN, 0x7FFF0000), Label("hide"), Do(RETURN, 0x00050000 | 38)])))
"""


def on_restricted_host(restrict: str, profile: str) -> str:
    """What a jail says in a process that the host has restricted."""
    kit = os.path.dirname(KIT)
    source = RESTRICTED.format(kit=kit, restrict=restrict, profile=profile)
    return python("-c", source).stdout


USER_NAMESPACE = (
    "user-namespace | user.max_user_namespaces is 0 | Run: sudo sysctl",
    'by its name: profile "no-userns"',
)
WITHOUT = ["pid-namespace", "mount-namespace", "landlock"]
RESTRICTED_HOSTS: list[tuple[str, str, Sequence[str]]] = [
    ("strict", "NO_USER_NAMESPACES", USER_NAMESPACE),
    (
        "no-userns",
        "NO_USER_NAMESPACES",
        ["started ['pid-namespace', 'mount-namespace', 'user-quotas']"],
    ),
    ("strict", "NO_LANDLOCK", ["landlock | the profile strict needs Landlock ABI"]),
    ("no-userns", "NO_LANDLOCK", ["landlock | the profile no-userns needs Landlock ABI"]),
    ("container", "NO_LANDLOCK", [f"started {WITHOUT}"[:-1]]),
]


@pytest.mark.short("no-userns-NO_LANDLOCK")
@pytest.mark.parametrize(
    ("profile", "restrict", "says"),
    [pytest.param(*row, marks=needs(row[0])) for row in RESTRICTED_HOSTS],
)
def test_a_restricted_host_is_refused_or_said_to_be_one(
    profile: str, restrict: str, says: Sequence[str]
) -> None:
    """Nothing degrades: the layer, the reason, the fix, the weaker profile by name. A profile that
    does without a layer says so."""
    said = on_restricted_host(globals()[restrict], profile)
    assert said.startswith(says[0])
    assert all(part in said for part in says)


SIGNALS = """
import os, signal, subprocess, threading, time
got = []
signal.signal(signal.SIGUSR1, lambda *_: got.append("usr1"))
os.kill(os.getpid(), signal.SIGUSR1)
signal.raise_signal(signal.SIGUSR1)
signal.pthread_kill(threading.main_thread().ident, signal.SIGUSR1)
child = subprocess.Popen(["sleep", "1000"])
child.terminate()
group = subprocess.Popen(["sleep", "1000"], start_new_session=True)
os.killpg(group.pid, signal.SIGKILL)
denied = []
for target in (victim, -1, os.getppid()):
    try:
        os.kill(target, signal.SIGTERM)
    except OSError as error:
        denied.append(error.errno)
signal.signal(signal.SIGTERM, lambda *_: got.append("group"))
os.kill(0, signal.SIGTERM)
try:
    os.kill(2**22 + 7, 0)
except OSError as error:
    denied.append(error.errno)
result = [len(got), got[-1], child.wait(), group.wait(), denied]
"""
BROKERED = (
    NO_LANDLOCK
    + """
import subprocess
victim = subprocess.Popen(["sleep", "1000"])
with open_folder() as folder, cell_in(
    folder, Confinement(profile="container", record_denials=RECORDED)
) as cell:
    print(cell.run(f"victim = {victim.pid}" + SOURCE))
    print(cell.run("import os; os.abort()"))
    print(cell.wait_for(RunnerExited).signal)
    runner = cell.start()
    print(cell.run("result = 'again'", runner))
    report = cell.wait_for(RunnerStarted).report
    print([layer["enforced"] for layer in report if layer["layer"] == "signals"])
print(victim.poll())
victim.kill()
victim.wait()
"""
)


@needs("container")
@pytest.mark.parametrize("recorded", [False, True])
def test_init_sends_signals_where_landlock_does_not_keep_them_inside(recorded: bool) -> None:
    """To the jail's own processes in every way, and to none outside; also where it is seen."""
    kit = os.path.dirname(KIT)
    head = RESTRICTED.partition("with open_folder")[0]
    source = head.format(kit=kit, restrict=BROKERED.replace("SOURCE", repr(SIGNALS)))
    source = source.replace("RECORDED", str(recorded))
    done = python("-c", source)
    assert done.stderr == ""
    assert done.stdout.splitlines() == [
        "{'result': [4, 'group', -15, -9, [1, 1, 1, 3]]}",
        "{'error': 'the runner has gone'}",
        "6",
        "{'result': 'again'}",
        "[True]",
        "None",
    ]
