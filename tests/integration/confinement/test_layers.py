"""Each layer denies what it is there for; the same source succeeds without a jail.

The verdict is read outside where it can be: a canary that was (not) written, a listener that was
(not) reached, a process that still runs.
"""

from __future__ import annotations

import os
import resource
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.protocol.confinement import Confinement
from envhub_worker.spawn.jail import JailFailed
from tests.support import inside
from tests.support.command_line import python
from tests.support.confinement_kit import (
    KIT,
    Cell,
    RunnerExited,
    RunnerStarted,
    cell_in,
    make_snapshot,
    new_cell,
    open_folder,
    spawner_in,
    unconfined,
    wait_until,
)
from tests.support.interpreter import can_run, needs, profiles, ways_to_it
from tests.support.processes import may_change_niceness, other_niceness
from tests.support.trees import fingerprint


@pytest.fixture(scope="module")
def cells() -> Iterator[dict[str, Cell]]:
    """A jail of each profile, kept for the module."""
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
    """Every profile."""
    return cells[request.param]


@pytest.fixture
def outside() -> Iterator[Path]:
    """A folder of the user's that every process may cross, and no jail was granted."""
    with open_folder() as folder:
        yield folder


@contextmanager
def victim() -> Iterator[subprocess.Popen[bytes]]:
    """A process of the same user, outside."""
    process = subprocess.Popen(["/bin/sleep", "1000"])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def denied(answer: dict[str, Any], *errors: str) -> bool:
    """Whether the source failed, with one of ``errors`` if any are named."""
    return "error" in answer and (not errors or answer["error"] in errors)


SECRETS = {
    "a file": ("open('{outside}/secret').read()", "s3cret"),
    "a folder": ("os.listdir('{outside}')", "secret"),
    "another snapshot": ("open('{store}/other/env.py').read()", "theirs"),
    "variables of the server": ("open('/proc/{server}/environ').read()", "PATH"),
    "a command line": ("open('/proc/{process}/cmdline').read()", "sleep"),
}
"""How each is read, and what is in it. Programs are given secrets as arguments."""


@pytest.mark.short
@pytest.mark.parametrize("secret", SECRETS)
def test_files_outside_are_out_of_reach(cell: Cell, outside: Path, secret: str) -> None:
    """What the same user could read, as the mode lets everybody, by path and through /proc."""
    store = Path(cell.jail.spec.snapshot).parent
    (store / "other").mkdir(exist_ok=True)
    (store / "other" / "env.py").write_text("theirs")
    (outside / "secret").write_text("s3cret")
    (outside / "secret").chmod(0o644)
    read, text = SECRETS[secret]
    with victim() as process:
        places = {"outside": outside, "store": store, "server": os.getpid()}
        source = f"import os; result = {read.format(process=process.pid, **places)}"
        assert text in unconfined(source)["result"]
        assert denied(cell.run(source), "PermissionError", "FileNotFoundError")


@pytest.mark.short
def test_files_outside_cannot_be_made_changed_or_removed(cell: Cell, outside: Path) -> None:
    """Every way to write: the canary folder stays as it is."""
    outside.chmod(0o777)
    (outside / "file").write_text("kept")
    (outside / "file").chmod(0o666)
    attempts = [
        "open('{}/new', 'w').close()",
        "open('{}/file', 'a').write('more')",
        "os.truncate('{}/file', 0)",
        "os.unlink('{}/file')",
        "os.mkdir('{}/folder')",
        "os.symlink('x', '{}/link')",
        "os.mkfifo('{}/fifo')",
        "os.rename('{}/file', '{}/other')",
        "os.link('{}/file', '{}/hard')",
    ]
    for attempt in attempts:
        source = "import os; " + attempt.replace("{}", str(outside))
        assert denied(cell.run(source)), attempt
    assert [entry.name for entry in outside.iterdir()] == ["file"]
    assert (outside / "file").read_text() == "kept"
    control = "import os; " + "; ".join(attempts[:2]).replace("{}", str(outside))
    assert unconfined(control) == {"result": None}
    assert (outside / "file").read_text() == "keptmore"


def test_modes_and_times_outside_stay(cell: Cell, outside: Path) -> None:
    """Landlock does not stop these; a mount namespace or the filter does."""
    file = outside / "file"
    file.write_text("x")
    file.chmod(0o600)
    os.utime(file, (1, 1))
    source = f"""
import os
for attempt in (lambda: os.chmod({str(file)!r}, 0o777), lambda: os.utime({str(file)!r}, (9, 9))):
    try:
        attempt()
    except OSError:
        pass
"""
    cell.run(source)
    assert (file.stat().st_mode & 0o777, file.stat().st_mtime) == (0o600, 1)
    unconfined(source)
    assert (file.stat().st_mode & 0o777, file.stat().st_mtime) == (0o777, 9)


@pytest.mark.parametrize("attempt", ["a{}/env.py", "w{}/new"])
def test_snapshot_stays_as_it_is(cell: Cell, outside: Path, attempt: str) -> None:
    """At its real path, whoever owns it: a jail changes its own view of it, or nothing."""
    source = "path = {!r}; open(path[1:], path[0]).write('# changed')"
    snapshot = cell.jail.spec.snapshot
    was = fingerprint(snapshot)
    cell.run(source.format(attempt.format(snapshot)))
    assert fingerprint(snapshot) == was
    was = fingerprint(outside)
    unconfined(source.format(attempt.format(outside)))
    assert fingerprint(outside) != was


@pytest.mark.parametrize("profile", profiles("strict", "no-userns"))
def test_link_in_a_snapshot_leads_nowhere(outside: Path, profile: str) -> None:
    """A symbolic link to a file outside shows nothing."""
    (outside / "secret").write_text("s3cret")
    with open_folder() as folder, spawner_in(folder, Confinement(profile=profile)) as spawner:
        snapshot = make_snapshot(folder, str(outside / "secret"))
        cell = new_cell(spawner, snapshot, Confinement(profile=profile))
        cell.start()
        source = f"result = open({snapshot!r} + '/link').read()"
        assert unconfined(source) == {"result": "s3cret"}
        assert denied(cell.run(source), "PermissionError", "FileNotFoundError")
        assert denied(cell.run("result = open('link').read()"))


def test_another_jails_scratch_is_out_of_reach(cells: dict[str, Cell]) -> None:
    """Jails of one zygote and one user do not share files, processes or sockets."""
    for profile, first in cells.items():
        confinement = Confinement(profile=profile)
        second = new_cell(first.spawner, first.jail.spec.snapshot, confinement)
        second.start()
        second.run("import os; open(os.path.expanduser('~/mine'), 'w').write('private')")
        home = second.run("import os; result = os.path.expanduser('~')")["result"]
        assert denied(first.run(f"result = open({home!r} + '/mine').read()"))
        pid = second.run("import os; result = os.getpid()")["result"]
        if profile != "strict":
            assert denied(first.run(f"import os; os.kill({pid}, 9)"), "PermissionError")
        assert second.run("result = 1") == {"result": 1}
        second.jail.kill()


def test_no_secret_of_another_jail_is_in_memory() -> None:
    """What one jail is granted never passes through the zygote that forks the next one."""
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
        rich, poor = new_cell(spawner, snapshot, granted), None
        rich.start()
        assert rich.run("import os; result = len(os.environ['TOKEN'])") == {"result": len(secret)}
        assert rich.run(source)["result"] > 1  # the control: it is in this one
        poor = new_cell(spawner, snapshot, confinement)
        poor.start()
        # One copy is the needle that the search itself built.
        assert poor.run(source)["result"] <= 1


LISTENERS = {
    "tcp": ("AF_INET", "SOCK_STREAM", ("127.0.0.1", 0)),
    "udp": ("AF_INET", "SOCK_DGRAM", ("127.0.0.1", 0)),
    "tcp6": ("AF_INET6", "SOCK_STREAM", ("::1", 0)),
    "abstract": ("AF_UNIX", "SOCK_STREAM", f"\0confinement-{os.getpid()}"),
    "file": ("AF_UNIX", "SOCK_STREAM", None),
    "file-datagram": ("AF_UNIX", "SOCK_DGRAM", None),
    "file-datagram-of-a-pair": ("AF_UNIX", "SOCK_DGRAM", None),
}
OF_A_PAIR = """
import socket
ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
theirs.close()
ours.sendto(b"hello", {name!r})
"""


@pytest.mark.short("strict")
@pytest.mark.parametrize("kind", LISTENERS)
def test_listener_outside_is_not_reached(cell: Cell, outside: Path, kind: str) -> None:
    """TCP, UDP, local sockets by name and by file; the listener says who came."""
    family, type_, address = LISTENERS[kind]
    name = str(outside / "socket") if address is None else address
    listener = socket.socket(getattr(socket, family), getattr(socket, type_))
    with closing(listener):
        listener.settimeout(0.3)
        listener.bind(name)
        if isinstance(name, str) and not name.startswith("\0"):
            os.chmod(name, 0o777)
        if type_ == "SOCK_STREAM":
            listener.listen()
        source = f"""
import socket
s = socket.socket(socket.{family}, socket.{type_})
s.connect({listener.getsockname()!r})
s.send(b"hello")
"""
        if kind.endswith("of-a-pair"):  # which may send to any address that it can name
            source = OF_A_PAIR.format(name=name)
        assert denied(cell.run(source))
        assert not reached(listener)
        assert unconfined(source) == {"result": None}
        assert reached(listener)


def reached(listener: socket.socket) -> bool:
    """Whether somebody connected or sent."""
    try:
        if listener.type == socket.SOCK_DGRAM:
            return listener.recv(10) == b"hello"
        connection, _ = listener.accept()
        with connection:
            return connection.recv(10) == b"hello"
    except TimeoutError:
        return False


def test_processes_outside_get_no_signal(cell: Cell) -> None:
    """By pid, by everything (-1), by descriptor."""
    with victim() as process:
        for attempt in (
            f"os.kill({process.pid}, signal.SIGTERM)",
            f"signal.pidfd_send_signal(os.pidfd_open({process.pid}), signal.SIGTERM)",
        ):
            assert denied(cell.run(f"import os, signal; {attempt}"))
        assert process.poll() is None
        assert unconfined(f"import os; os.kill({process.pid}, 15)") == {"result": None}
        assert process.wait(20) == -15


def test_kill_everything_reaches_nothing_outside(cell: Cell) -> None:
    """kill(-1) from a process of the jail: the victim, init and the server live on."""
    with victim() as process:
        source = """
import os, signal
pid = os.fork()
if not pid:
    os.setsid()
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    try:
        os.kill(-1, signal.SIGUSR1)
    except PermissionError:
        pass
    os._exit(0)
os.waitpid(pid, 0)
"""
        runner = cell.start()
        cell.run("import signal; signal.signal(signal.SIGUSR1, signal.SIG_IGN)", 1)
        cell.run("import signal; signal.signal(signal.SIGUSR1, signal.SIG_IGN)", runner)
        cell.run(source, runner)
        assert process.poll() is None
        assert cell.run("result = 1", runner) == {"result": 1}
        cell.hang_up(runner)


def test_processes_outside_keep_limits_and_priority(cell: Cell) -> None:
    """prlimit, setpriority and affinity of a process of the same user."""
    with victim() as process:
        before = settings_of(process.pid)
        nice = other_niceness()
        source = f"""
import os, resource
for attempt in (
    lambda: resource.prlimit({process.pid}, resource.RLIMIT_NOFILE, (5, 5)),
    lambda: os.setpriority(os.PRIO_PROCESS, {process.pid}, {nice}),
    lambda: os.setpriority(os.PRIO_USER, 0, {nice}),
    lambda: os.sched_setaffinity({process.pid}, {{0}}),
):
    try:
        attempt()
    except (OSError, ValueError):
        pass
"""
        cell.run(source)
        assert settings_of(process.pid) == before
        unconfined(source.replace(f"lambda: os.setpriority(os.PRIO_USER, 0, {nice}),", ""))
        assert settings_of(process.pid)[0] == (5, 5)
        assert settings_of(process.pid)[1] == nice or not may_change_niceness()


def settings_of(pid: int) -> tuple[tuple[int, int], int, set[int]]:
    """A process's limit of open files, its priority and its cores."""
    files = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    return files, os.getpriority(os.PRIO_PROCESS, pid), os.sched_getaffinity(pid)


CALL = """
import ctypes, os
libc = ctypes.CDLL(None, use_errno=True)
def call(number, *args):
    words = [ctypes.c_long(a) if isinstance(a, int) else a for a in args]
    if libc.syscall(ctypes.c_long(number), *words) < 0:
        raise OSError(ctypes.get_errno(), "denied")
"""


def test_processes_outside_cannot_be_traced_or_read(cell: Cell) -> None:
    """ptrace, process_vm_readv, /proc/<pid>/mem."""
    with victim() as process:
        pid = process.pid
        attach = CALL + f"call({{}}, 16, {pid}, 0, 0); call({{}}, 17, {pid}, 0, 0)"
        number = {"x86_64": 101, "aarch64": 117}[os.uname().machine]
        source = attach.format(number, number)
        assert denied(cell.run(source), "PermissionError")
        assert denied(cell.run(f"open('/proc/{pid}/mem', 'rb')"))
        assert denied(cell.run(f"result = open('/proc/{pid}/maps').read()"))
        assert unconfined(f"result = open('/proc/{pid}/maps').read()[:1]")["result"]


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


def test_jail_sees_only_its_own_processes(cells: dict[str, Cell]) -> None:
    """Under strict, /proc has init, the runner and what it starts."""
    source = "import os; result = [int(n) for n in os.listdir('/proc') if n.isdigit()]"
    assert os.getpid() in unconfined(source)["result"]
    assert max(cells["strict"].run(source)["result"]) < 100


@pytest.mark.short
def test_strict_jail_has_no_network_device(cells: dict[str, Cell]) -> None:
    """Only a loopback device, which is down."""
    source = "result = open('/proc/net/dev').read()"
    strict = cells["strict"].run(source)["result"]
    assert [line.split(":")[0].strip() for line in strict.splitlines()[2:]] == ["lo"]


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
    """No secret, no mounts; devices that are harmless; nothing of /proc that tells."""
    source = """
import os
result = {
    "etc": sorted(os.listdir("/etc")),
    "dev": sorted(os.listdir("/dev")),
    "there": [p for p in ("/.scratch/upper", "/etc/shadow", "/etc/machine-id", "/sys/kernel")
              if os.path.exists(p)],
    "writable": [p for p in ("/", "/usr", "/usr/bin", "/etc", "/dev", "/proc", "/sandbox", "/sys")
                 if os.access(p, os.W_OK)],
    "told": [p for p in ("cmdline", "kallsyms", "interrupts", "partitions", "keys", "diskstats")
             if open("/proc/" + p).read()],
}
"""
    seen = cells["strict"].run(source)["result"]
    assert {"passwd", "group", "hosts"} <= set(seen["etc"])
    assert not {"shadow", "ssh", "sudoers", "machine-id"} & set(seen["etc"])
    nodes = {"null", "full", "random", "urandom"}
    assert set(seen["dev"]) == nodes | {"fd", "stdin", "stdout", "stderr", "shm"}
    assert seen["there"] == []
    assert seen["writable"] == []
    assert seen["told"] == []


ESCAPES = {
    "user-namespace": "libc.unshare(0x10000000)",
    "mount-namespace": "libc.unshare(0x20000)",
    "mount": "libc.mount(b'none', b'/tmp', b'tmpfs', 0, None)",
    "remount": "libc.mount(b'none', b'/usr', None, 32 | 4096, None)",
    "unmount": "libc.umount2(b'/proc', 2)",
    "chroot": "libc.chroot(b'/tmp')",
    "setns": "libc.setns(3, 0)",
    "personality": "libc.personality(0x0040000)",
    "hostname": "libc.sethostname(b'x', 1)",
    "swap": "libc.swapon(b'/tmp/x', 0)",
    "reboot": "libc.reboot(0)",
}


@pytest.mark.parametrize("escape", ESCAPES)
def test_escape_is_denied(cell: Cell, escape: str) -> None:
    """Each answers -1 with EPERM."""
    source = f"{CALL}\nresult = [{ESCAPES[escape]}, ctypes.get_errno()]"
    assert cell.run(source) == {"result": [-1, 1]}


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="these ways in exist on x86-64 only")
@pytest.mark.parametrize("way", ["x32", "int80"])
def test_other_system_call_tables_end_the_runner(cell: Cell, way: str) -> None:
    """x32 numbers and int 0x80 mean other calls than the filter looked at: SIGSYS."""
    if way == "x32":
        source = CALL + "call(0x40000000 | 39)"
    else:
        source = """
import ctypes, mmap
code = bytes([0xB8, 20, 0, 0, 0, 0xCD, 0x80, 0xC3])  # mov eax, getpid; int 0x80; ret
page = mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
page.write(code)
ctypes.CFUNCTYPE(ctypes.c_int)(ctypes.addressof(ctypes.c_char.from_buffer(page)))()
result = "came back"
"""
    runner = cell.start()
    assert cell.run(source, runner) == {"error": "the runner has gone"}
    ended: list[RunnerExited] = []

    def gone() -> bool:
        cell.pump()
        ended[:] = [e for e in cell.events if isinstance(e, RunnerExited) and e.runner == runner]
        return bool(ended)

    wait_until(gone, "no exit event")
    assert (ended[0].signal, ended[0].reason) == (31, "signal")


@pytest.mark.short
def test_capabilities_and_privileges_are_gone(cell: Cell) -> None:
    """As the kernel says it of the runner; an exec brings nothing back."""
    source = """
import subprocess
with open("/proc/self/status") as status:
    text = subprocess.check_output(["/bin/cat"], stdin=status, text=True)
result = {line.split(":")[0]: line.split()[-1] for line in text.splitlines() if line.split()[1:]}
"""
    status = cell.run(source)["result"]
    sets = ["CapInh", "CapPrm", "CapEff", "CapAmb"]
    if os.geteuid() == 0 or cell.jail.spec.confinement.profile == "strict":
        sets.append("CapBnd")
    assert {int(status[name], 16) for name in sets} == {0}
    assert status["NoNewPrivs"] == "1"
    assert status["Seccomp"] == "2"


def test_root_becomes_nobody_it_knows(cell: Cell) -> None:
    """As root, the jail runs as a user that owns and runs nothing; never as uid 0."""
    assert cell.run("import os; result = os.getuid()")["result"] != 0
    if os.geteuid() == 0:
        pid = cell.wait_for(RunnerStarted).pid
        assert os.stat(f"/proc/{pid}").st_uid > 60000


def test_pid_of_a_runner_is_the_one_outside(cell: Cell) -> None:
    """For whoever watches the processes of this machine."""
    started = cell.wait_for(RunnerStarted)
    assert "zygote" in Path(f"/proc/{started.pid}/cmdline").read_text()


def test_command_line_of_a_runner_tells_nothing(cell: Cell) -> None:
    """The zygote's configuration, with the paths of the server, is not in it."""
    source = "result = open('/proc/self/cmdline').read().split(chr(0))"
    arguments = cell.run(source)["result"]
    assert arguments[1] == "-I"
    assert arguments[3] == "zygote"
    assert arguments[4].isdigit()
    assert arguments[5:] == [""]


def test_snapshot_may_be_named_through_a_link() -> None:
    """A home may be a symbolic link to another disk."""
    with open_folder() as folder, spawner_in(folder, Confinement()) as spawner:
        make_snapshot(folder)
        (folder / "alias").symlink_to(folder, target_is_directory=True)
        cell = new_cell(spawner, str(folder / "alias" / "snapshot"), Confinement())
        cell.start()
        assert cell.run("result = open('env.py').read()") == {"result": "VALUE = 7\n"}


@pytest.mark.parametrize("profile", profiles("strict", "no-userns"))
def test_grants_are_readable_and_no_more(outside: Path, profile: str) -> None:
    """A path that the policy names is there, read-only; its neighbour is not."""
    (outside / "granted").mkdir()
    (outside / "granted" / "file").write_text("yes")
    (outside / "other").write_text("no")
    confinement = Confinement(profile=profile, readable=(str(outside / "granted"),))
    with open_folder() as folder, cell_in(folder, confinement) as cell:
        granted = cell.run(f"result = open({str(outside / 'granted' / 'file')!r}).read()")
        assert granted == {"result": "yes"}
        assert denied(cell.run(f"open({str(outside / 'other')!r})"))
        assert denied(cell.run(f"open({str(outside / 'granted' / 'new')!r}, 'w')"))


@pytest.mark.parametrize("profile", profiles("strict", "no-userns"))
def test_host_network_is_there_by_explicit_choice(profile: str) -> None:
    """And is reported as a layer that is not enforced."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listener:
        listener.settimeout(60)
        source = f"""
import socket
socket.create_connection({listener.getsockname()!r}).sendall(b"hello")
"""
        confinement = Confinement(profile=profile, network="host")
        with open_folder() as folder, cell_in(folder, confinement) as cell:
            assert cell.run(source) == {"result": None}
            assert reached(listener)
            report = cell.wait_for(RunnerStarted).report
            missing = {layer["layer"] for layer in report if not layer["enforced"]}
            assert missing & {"network", "network-namespace"}
            assert denied(cell.run("import socket; socket.socket(socket.AF_NETLINK, 3)"))


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


def shared_quotas() -> list[str]:
    """What a jail of a plain user's goes without everywhere."""
    return [] if os.geteuid() == 0 else ["user-quotas"]


def test_host_without_user_namespaces_is_refused_with_a_fix() -> None:
    """Nothing degrades: the layer, the reason, the fix, the weaker profile by name."""
    said = on_restricted_host(NO_USER_NAMESPACES, "strict")
    assert said.startswith("user-namespace | user.max_user_namespaces is 0 | Run: sudo sysctl")
    assert 'by its name: profile "no-userns"' in said


def test_weaker_profile_runs_on_a_host_without_user_namespaces() -> None:
    """And says what it goes without."""
    said = on_restricted_host(NO_USER_NAMESPACES, "no-userns")
    assert said == "started ['pid-namespace', 'mount-namespace', 'user-quotas']\n"


@pytest.mark.short
@pytest.mark.parametrize("profile", profiles("strict", "no-userns"))
def test_host_without_landlock_is_refused(profile: str) -> None:
    """By every profile that promises files."""
    said = on_restricted_host(NO_LANDLOCK, profile)
    assert said.startswith(f"landlock | the profile {profile} needs Landlock ABI")


@needs("container")
def test_container_profile_runs_without_landlock() -> None:
    """Its outer layers hold; the report says that this one is missing."""
    said = on_restricted_host(NO_LANDLOCK, "container")
    assert said == f"started {['pid-namespace', 'mount-namespace', 'landlock', *shared_quotas()]}\n"


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
with open_folder() as folder, cell_in(folder, Confinement(profile="container")) as cell:
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
def test_init_sends_signals_where_landlock_does_not_keep_them_inside() -> None:
    """To the jail's own processes in every way, and to none outside."""
    kit = os.path.dirname(KIT)
    head = RESTRICTED.partition("with open_folder")[0]
    source = head.format(kit=kit, restrict=BROKERED.replace("SOURCE", repr(SIGNALS)))
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
