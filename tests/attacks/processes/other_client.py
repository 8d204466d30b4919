"""Another client with a server of its own: ``python -m tests.attacks.processes.other_client``.
argv: the user to be, a profile and a secret. Opens a jail of the hostile repository that holds the
secret, and prints one JSON object: what ``be_victim`` says, the jail's process, and the folders of
the server and the cache. For each line that it reads it prints how the jail is then."""

import json
import os
import sys

from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.system.folders import cache_root
from tests.attacks.harness import Arena, run_in


def become(user: int) -> None:
    """Leave root behind, if another user is asked for."""
    if user != os.geteuid():
        os.setgroups([])
        os.setresgid(user, user, user)
        os.setresuid(user, user, user)


def main(profile: str, secret: str) -> int:
    """Hold a jail open until there is nothing more to read."""
    cache = cache_root()
    use = PROCESS.acquire(cache / "snapshots")
    server = use.server
    with Arena(profile, "").environment() as env:
        run_in(env, "create_file", path=f"/dev/shm/envhub-{os.getpid()}", text=secret)
        run = run_in(env, "be_victim", secret=secret)
        [pid] = run.pids()
        folders = {"server": str(server.folder), "cache": str(cache)}
        print(json.dumps({"pid": pid, **run.value, **folders}), flush=True)
        for _ in sys.stdin:
            print(json.dumps(run_in(env, "be_victim", secret=None).value), flush=True)
    use.release()
    return 0


if __name__ == "__main__":
    become(int(sys.argv[1]))
    sys.exit(main(*sys.argv[2:]))
