"""What environments really do keeps working in a jail."""

import os
from collections.abc import Iterator

import pytest

from envhub_worker.protocol.confinement import Confinement, Limits
from tests.support.confinement_kit import Cell, cell_in, open_folder
from tests.support.interpreter import needs, profiles

STRICT = Confinement(limits=Limits(processes=256))


@pytest.fixture(scope="module")
def strict() -> Iterator[Cell]:
    with open_folder() as folder, cell_in(folder, STRICT) as cell:
        yield cell


@pytest.fixture(scope="module")
def bare() -> Iterator[Cell]:
    confinement = Confinement(profile="no-userns")
    with open_folder() as folder, cell_in(folder, confinement) as cell:
        yield cell


@pytest.fixture(params=profiles("strict", "no-userns"))
def cell(request: pytest.FixtureRequest) -> Cell:
    name = "strict" if request.param == "strict" else "bare"
    return request.getfixturevalue(name)


def outcome(cell: Cell, source: str, runner: int = 1) -> object:
    """What ``source`` leaves in ``result``; its error fails the test with the jail's output."""
    answer = cell.run(source, runner)
    cell.pump()
    assert "result" in answer, (answer, cell.output[-3000:].decode())
    return answer["result"]


def in_fresh_runner(cell: Cell, source: str) -> object:
    """Like ``outcome``, in a runner of its own: for what can be set once per process."""
    runner = cell.start()
    result = outcome(cell, source, runner)
    cell.hang_up(runner)
    return result


def test_numpy_uses_blas_threads(cell: Cell) -> None:
    """The zygote is single-threaded; a runner has the threads that its cores allow."""
    source = """
import os, numpy
a = numpy.random.rand(400, 400)
result = [float(numpy.abs(a @ numpy.linalg.inv(a) - numpy.eye(400)).max()) < 1e-6,
          len(os.listdir('/proc/self/task')), len(os.sched_getaffinity(0))]
"""
    right, threads, cores = in_fresh_runner(cell, source)
    assert right
    if cores > 2:
        assert threads > 1


def test_only_runner_of_a_jail_has_all_blas_threads() -> None:
    with open_folder() as folder, cell_in(folder, STRICT) as cell:
        threads = outcome(cell, "import os; result = len(os.listdir('/proc/self/task'))")
        assert threads == min(len(os.sched_getaffinity(0)), 16)


def test_threads_and_asyncio(cell: Cell) -> None:
    source = """
import asyncio, concurrent.futures as futures, threading
async def main():
    process = await asyncio.create_subprocess_exec(
        "/bin/echo", "hello", stdout=asyncio.subprocess.PIPE)
    out, _ = await process.communicate()
    return [await asyncio.to_thread(sum, [1, 2]), out.decode()]
with futures.ThreadPoolExecutor(4) as pool:
    squares = list(pool.map(lambda n: n * n, range(5)))
event = threading.Event()
threading.Timer(0.01, event.set).start()
result = [squares, event.wait(20), asyncio.run(main())]
"""
    assert outcome(cell, source) == [[0, 1, 4, 9, 16], True, [3, "hello\n"]]


def test_subprocesses(cell: Cell) -> None:
    source = """
import subprocess, sys
result = [
    subprocess.check_output(["sh", "-c", "echo a | tr a b"], text=True),
    subprocess.check_output([sys.executable, "-c", "import numpy; print(numpy.ones(2).sum())"],
                            text=True),
]
try:
    subprocess.run(["sleep", "1000"], timeout=0.05)
except subprocess.TimeoutExpired:
    result.append("killed")
"""
    assert outcome(cell, source) == ["b\n", "2.0\n", "killed"]


MULTIPROCESSING = """
import multiprocessing as mp, sys
import work
context = mp.get_context({method!r})
with context.Pool(2) as pool:
    squares = pool.map(work.square, range(4))
queue, lock = context.Queue(), context.Lock()
child = context.Process(target=work.put, args=(queue, lock))
child.start(); got = queue.get(timeout=50); child.join()
array = context.Array("d", 3)
with array.get_lock():
    array[1] = 2.5
result = [squares, got, child.exitcode, list(array)]
"""
WORK = """
import sys
open("work.py", "w").write('''
def square(n): return n * n
def put(queue, lock):
    with lock:
        queue.put("from the child")
''')
sys.path.insert(0, ".")
"""


@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_multiprocessing(strict: Cell, method: str) -> None:
    """Pools, queues, locks (SemLock) and shared arrays, by every start method."""
    source = WORK + MULTIPROCESSING.format(method=method)
    expected = [[0, 1, 4, 9], "from the child", 0, [0.0, 2.5, 0.0]]
    assert in_fresh_runner(strict, source) == expected


def test_shared_memory_and_managers(strict: Cell) -> None:
    """Named shared memory lies in the jail's own /dev/shm; a manager listens on a local socket."""
    source = (
        WORK
        + """
import multiprocessing as mp
from multiprocessing import shared_memory
memory = shared_memory.SharedMemory(create=True, size=1000)
memory.buf[3] = 7
other = shared_memory.SharedMemory(memory.name)
value = other.buf[3]
other.close(); memory.close(); memory.unlink()
with mp.get_context("fork").Manager() as manager:
    shared = manager.dict(a=1)
    shared["b"] = 2
    result = [value, dict(shared)]
"""
    )
    assert in_fresh_runner(strict, source) == [7, {"a": 1, "b": 2}]


@needs("no-userns")
def test_pipes_to_forked_children_without_namespaces(bare: Cell) -> None:
    """There no shared semaphore can be made; processes and pipes work."""
    source = """
import multiprocessing as mp
ours, theirs = mp.Pipe()
child = mp.get_context("fork").Process(target=lambda: theirs.send("hello"))
child.start(); got = ours.recv(); child.join()
result = [got, child.exitcode]
"""
    assert in_fresh_runner(bare, source) == ["hello", 0]


def test_gymnasium_async_vector_env(strict: Cell) -> None:
    source = """
import gymnasium
envs = gymnasium.make_vec("CartPole-v1", num_envs=3, vectorization_mode="async")
observations, _ = envs.reset(seed=1)
for _ in range(20):
    observations, *_ = envs.step(envs.action_space.sample())
envs.close()
result = list(observations.shape)
"""
    assert in_fresh_runner(strict, source) == [3, 4]


def test_files_of_every_kind(cell: Cell) -> None:
    """Home, temporary files, the working directory; renames, links, sockets, locks, copies."""
    source = """
import fcntl, os, pathlib, shutil, tempfile
home = pathlib.Path.home()
(home / ".cache" / "deep").mkdir(parents=True, exist_ok=True)
(home / ".cache" / "deep" / "file").write_text("cached")
with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder, "a")
    path.write_text("text")
    path.rename(path.with_name("b"))
    shutil.copy2(path.with_name("b"), path)
    os.link(path, path.with_name("c"))
    os.symlink("a", path.with_name("d"))
    with open(path) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
    os.mkfifo(path.with_name("e"))
    path.with_name("f").touch()
    path.with_name("f").touch()
    os.utime(path, (1, 2))
    names = sorted(os.listdir(folder))
with tempfile.NamedTemporaryFile() as file:
    file.write(b"x")
pathlib.Path("cwd-file").write_text("here")
shutil.copytree("assets", "copy", dirs_exist_ok=True)
result = [names, (home / ".cache/deep/file").read_text(), pathlib.Path("copy/a.txt").read_text()]
"""
    assert outcome(cell, source) == [["a", "b", "c", "d", "e", "f"], "cached", "asset"]


def test_programs_built_in_scratch_run(strict: Cell) -> None:
    source = """
import os, subprocess, tempfile
path = os.path.join(tempfile.mkdtemp(), "script")
open(path, "w").write("#!/bin/sh\\necho ran\\n")
os.chmod(path, 0o755)
result = subprocess.check_output([path], text=True)
"""
    assert outcome(strict, source) == "ran\n"


def test_a_program_has_a_terminal_of_the_jails_own(strict: Cell) -> None:
    """``pty.fork``: it leads a session there. Nobody else's terminal can be seen."""
    theirs, ours = os.openpty()
    source = """
import os, pty
before = sorted(os.listdir("/dev/pts"))
pid, fd = pty.fork()
if not pid: os.execv("/bin/sh", ["sh", "-c", "tty; test -t 1 && echo to it >/dev/tty"])
said = b""
try:
    while piece := os.read(fd, 100): said += piece
except OSError: pass
result = [before, said.decode(), os.waitpid(pid, 0)[1]]
"""
    assert os.path.basename(os.ttyname(ours)) in os.listdir("/dev/pts")
    assert outcome(strict, source) == [["ptmx"], "/dev/pts/0\r\nto it\r\n", 0]
    os.close(theirs)
    os.close(ours)


def test_identity_and_host_questions_are_answered(cell: Cell) -> None:
    """Who am I, how many cores, how much memory: libraries ask at import."""
    source = """
import getpass, multiprocessing, os, platform, psutil, socket, time
result = [getpass.getuser(), multiprocessing.cpu_count() >= 1, psutil.virtual_memory().total > 0,
          psutil.Process().memory_info().rss > 0, bool(platform.platform()), time.tzname != (),
          os.path.exists("/proc/cpuinfo"), bool(socket.gethostname())]
"""
    answers = outcome(cell, source)
    assert answers[0] == "sandbox"
    assert all(answers[1:])


def test_pygame_draws_without_a_display(cell: Cell) -> None:
    pytest.importorskip("pygame")
    source = """
import pygame
pygame.init()
screen = pygame.display.set_mode((20, 10))
screen.fill((255, 0, 0))
result = [list(pygame.surfarray.array3d(screen).shape), pygame.display.get_driver()]
pygame.quit()
"""
    assert in_fresh_runner(cell, source) == [[20, 10, 3], "dummy"]


def test_torch_computes_and_trains(strict: Cell) -> None:
    pytest.importorskip("torch")
    source = """
import torch
layer = torch.nn.Linear(8, 1)
loss = layer(torch.rand(64, 8)).pow(2).mean()
loss.backward()
data = torch.utils.data.TensorDataset(torch.arange(8.0))
batches = [batch[0].sum().item() for batch in
           torch.utils.data.DataLoader(data, batch_size=4, num_workers=2)]
path = "model.pt"
torch.save(layer.state_dict(), path)
torch.load(path)
result = [bool(layer.weight.grad.abs().sum() > 0), batches]
"""
    assert in_fresh_runner(strict, source) == [True, [6.0, 22.0]]


def test_imageio_writes_a_video_with_ffmpeg(strict: Cell) -> None:
    pytest.importorskip("imageio_ffmpeg")
    source = """
import imageio, numpy, os
frames = [numpy.full((64, 64, 3), n, numpy.uint8) for n in range(0, 100, 10)]
imageio.mimsave("video.mp4", frames, fps=10)
result = os.path.getsize("video.mp4") > 100
"""
    assert in_fresh_runner(strict, source) is True


def test_loopback_network_is_the_jails_own() -> None:
    """A server and its client in one jail; nothing else is there."""
    source = """
import socket, threading
server = socket.create_server(("127.0.0.1", 0))
threading.Thread(target=lambda: server.accept()[0].sendall(b"hello")).start()
result = socket.create_connection(server.getsockname()).recv(10).decode()
"""
    with open_folder() as folder, cell_in(folder, Confinement(network="loopback")) as cell:
        assert outcome(cell, source) == "hello"
