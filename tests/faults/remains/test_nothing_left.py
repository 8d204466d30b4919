"""However a client ends, nothing of ours remains on the machine; a fork of it ends nothing."""

import signal
from pathlib import Path

import pytest

from tests.faults.remains.clients import finish, left, line, start
from tests.faults.remains.traces import Traces
from tests.support.processes import eventually

ENDS = {
    "returns without close": "made()",
    "raises": "suites = made()\nraise KeyError('mine')",
    "sys.exit in a thread's presence": (
        "suites = made()\n"
        "threading.Thread(target=lambda: suites.env.step([0, 0])).start()\nsys.exit(3)"
    ),
    "never used it": "make_env(REPOSITORY)",
    "two shards, an env each": (
        "one = made(use_async_envs=True, num_workers=2)\n"
        "two = made(use_async_envs=True, num_workers=2, policy={'lane': 'frames'})\nos._exit(5)"
    ),
    "dies with daemons in the jail": (
        "suites = made('step', 'children')\nsuites.env.step([0, 1])\nos._exit(6)"
    ),
}


@pytest.mark.parametrize("body", [pytest.param(body, id=name) for name, body in ENDS.items()])
def test_nothing_remains_of_a_client_that(body: str, folder: Path) -> None:
    """Its server, zygote and jails, its sockets, folders and groups go with it."""
    said = finish(start(folder, body))
    assert "Exception ignored" not in said


@pytest.mark.short
@pytest.mark.parametrize(
    ("moment", "number"),
    [
        # a server sees the same, whatever ends its client: that its pipe has closed
        *((moment, signal.SIGKILL) for moment in ("idle", "step", "make")),
        *(("step", number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)),
        ("make", signal.SIGINT),
    ],
)
def test_nothing_remains_after(moment: str, number: signal.Signals, folder: Path) -> None:
    """A signal ends the client, whatever it was doing, and everything of ours with it."""
    client = start(
        folder,
        f"""
        moment = {moment!r}
        if moment == "make":
            say("there")
            made("make", "hang")
        suites = made("step", "hang")
        say("there")
        if moment == "step":
            suites.env.step([0, 1])
        time.sleep(600)
        """,
    )
    assert line(client) == "there"
    if moment == "make":
        assert eventually(lambda: len(Traces.of(folder).processes) >= 4)  # init and runner
    client.send_signal(number)
    finish(client)


@pytest.mark.short
def test_fork_refuses_and_ends_nothing(folder: Path) -> None:
    """In a fork old environments refuse and new ones work; the parent's go on throughout."""
    client = start(
        folder,
        """
        def in_a_fork(suites):
            code = 1
            try:
                env = suites.env
                for operation in (lambda: env.step_wait(), lambda: env.step([0, 0]), env.render):
                    try:
                        operation()
                    except errors.WorkerError as error:
                        assert "fork" in str(error), error
                env.close()
                suites.close()
                with make_env(REPOSITORY) as own:
                    own.env.reset()
                    assert own.env.step([0])[0].tolist() == [[1.0]]
                made()  # and one that is never closed
                code = 0
            finally:
                sys.exit(code)

        for lane in ("auto", "frames"):
            suites = made(policy={"lane": lane})
            suites.env.step_async([0, 0])  # a reply is under way while we fork
            child = os.fork()
            if child == 0:
                in_a_fork(suites)
            say(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
            say(suites.env.step_wait()[0].tolist())
            say(suites.env.step([0, 0])[0].tolist())
        """,
    )
    said = finish(client).splitlines()
    assert said[:6] == ["0", "[[2.0], [2.0]]", "[[3.0], [3.0]]"] * 2, said


def test_multiprocessing_fork_ends_nothing(folder: Path) -> None:
    """A pool of forks, as torch's DataLoader makes, comes and goes; the environment stays."""
    client = start(
        folder,
        """
        import multiprocessing
        suites = made()
        with multiprocessing.get_context("fork").Pool(2) as pool:
            say(pool.map(abs, [-1, -2]))
        say(suites.env.step([0, 0])[0].tolist())
        """,
    )
    assert finish(client).split("\n")[:2] == ["[1, 2]", "[[2.0], [2.0]]"]


def test_signal_handler_may_close_what_its_own_thread_waits_for(folder: Path) -> None:
    client = start(
        folder,
        """
        from gymnasium.error import ClosedEnvironmentError
        for lane in ("auto", "frames"):
            suites = made("step", "hang", policy={"lane": lane})
            signal.signal(signal.SIGALRM, lambda *_: suites.close())
            signal.setitimer(signal.ITIMER_REAL, 0.5)
            try:
                suites.env.step([0, 1])
            except ClosedEnvironmentError:
                say("closed")
        """,
    )
    assert finish(client).split() == ["closed", "closed"]


def test_proxy_that_nobody_holds_ends_its_processes(folder: Path) -> None:
    client = start(
        folder,
        """
        import gc
        keeper = made()
        for _ in range(3):
            suites = made()
            suites.env.reset(seed=1)
            suites.env.me = suites.env  # a cycle
            del suites
        gc.collect()
        say("collected")
        sys.stdin.readline()
        """,
    )
    said = line(client)
    assert said == "collected", said + finish(client)
    jails = 5  # the server, its zygote's two, and keeper's init and runner
    assert eventually(lambda: len(Traces.of(folder).processes) <= jails), left(folder)
    client.kill()
    finish(client)


def test_dead_server_is_told_and_replaced(folder: Path) -> None:
    """When the server itself is killed the step says so, and ``reset`` starts another."""
    client = start(
        folder,
        """
        from tests.support import inside
        for lane in ("auto", "frames"):
            suites = made(policy={"restart": "on_reset", "lane": lane})
            inside.server(suites.env).process.kill()
            try:
                while True:  # the jail may live a moment longer
                    suites.env.step([0, 0])
            except errors.WorkerDiedError as error:
                say(error.reason)
            suites.env.reset()
            say(suites.env.step([0, 0])[0].tolist())
            suites.close()
        """,
    )
    assert finish(client).splitlines() == ["server", "[[1.0], [1.0]]"] * 2


def test_many_clients_at_once_do_not_meet(folder: Path) -> None:
    """Each gets the results of its own steps."""
    body = "with made() as suites: say(suites.env.step([0, 0])[0].tolist())"
    clients = [start(folder, body) for _ in range(2)]
    assert [finish(client) for client in clients] == ["[[2.0], [2.0]]\n"] * 2


def test_close_under_a_starting_worker_returns(folder: Path) -> None:
    """``close`` does not wait for a constructor that hangs, and nor does the first ``reset``."""
    client = start(
        folder,
        """
        from gymnasium.error import ClosedEnvironmentError
        fails = {"moment": "init", "fault": "hang", "tasks": 2}
        suites = make_env(
            REPOSITORY, n_envs=2, env_kwargs=fails, timeouts={"server_idle_s": 0}
        )
        env = suites["suite"][0]
        threading.Timer(1.0, env.close).start()
        try:
            env.reset()
        except ClosedEnvironmentError:
            say("closed")
        time.sleep(600)
        """,
    )
    assert line(client) == "closed"
    assert eventually(lambda: not Traces.of(folder).processes), left(folder)
    client.kill()
    finish(client)


def test_sockets_that_a_cleaner_removed_cost_one_server(folder: Path) -> None:
    """Open environments go on with theirs; the next one gets a new server at once."""
    body = """
import pathlib, shutil
one = made(timeouts={"startup_s": 600})
shutil.rmtree(next(pathlib.Path(os.environ["TMPDIR"]).glob("envhub-*")))
two = made(timeouts={"startup_s": 600})
one.env.step([0, 0])
two.env.step([0, 0])
two.close()
one.env.step([0, 0])
one.close()
say("well")
"""
    assert finish(start(folder, body), 300.0).strip() == "well"
