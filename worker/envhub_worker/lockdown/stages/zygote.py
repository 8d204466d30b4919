"""The zygote's stage of lockdown: applies once the confinement that all its jails share.

Under ``strict`` the zygote becomes the first process of its own namespaces with a private root. A
jail then takes only a few cheap mounts, and every jail ends with its zygote. A root zygote first
becomes a user that owns nothing; it builds the private root before, while it can still cross
folders like /root.
"""

from __future__ import annotations

import contextlib
import importlib.machinery
import itertools
import os
import pwd
import signal
import sys
from collections.abc import Iterator
from functools import partial

import envhub_worker
from envhub_worker.lockdown import gpus, root_plan
from envhub_worker.lockdown.context import Common, ZygoteConfig
from envhub_worker.lockdown.layers import LayerUnavailableError
from envhub_worker.lockdown.mechanisms import kernel, landlock, mounts, namespaces, process, user
from envhub_worker.lockdown.plan import needs_broker
from envhub_worker.lockdown.seccomp.filter import compile_filter
from envhub_worker.lockdown.seccomp.policy import policy_table, watched_calls
from envhub_worker.protocol.runtime import mapped_modules

_STRICT = "__editable__."
"""The folder of links that setuptools makes in its strict mode, and puts on the path."""


def enter(config: ZygoteConfig) -> Common:
    """Apply to this process the confinement that its jails share.

    Under ``strict`` it returns in a child of the calling process, which only waits for the child.
    Raises ``LayerUnavailableError``: the host lacks a layer that the profile names.
    """
    # In this order. The root is planned while the host's files are still in sight. Under ``strict``
    # the namespaces come next, and with them the change of user (``_enter_namespaces``). Elsewhere
    # only the user changes, and what the new user may read is tried after that. The skeleton of the
    # packages is mounted before the first fork, so that all jails share it. The filters are
    # compiled last, once, and installed by none but the runners: an init must mount.
    if config.refusal is not None:
        raise LayerUnavailableError(**config.refusal)
    namespaced = config.profile == "strict"
    plan = _plan_root(config)
    if namespaced:
        _enter_namespaces(config, plan)
        covered = mounts.proc_to_cover()
    else:
        if config.user is not None:
            # SIGTERM, not SIGKILL: without a pid namespace the zygote must end its jails itself.
            _become(config, signal.SIGTERM)
            _check_interpreter()
        covered = ([], [])
    if config.packages:
        _check_packages(config.packages)
        if namespaced:
            mounts.mount_skeleton(config.packages)
    abi = landlock.version()
    brokered = needs_broker(namespaced=namespaced, landlock_abi=abi)
    # A driver can allocate memory that neither init sees nor a filter denies.
    programs = tuple(
        compile_filter(
            namespaced=namespaced,
            network=config.network,
            brokered=brokered,
            measured=measured and not config.gpu,
            scoped=landlock.scopes(abi),
            record=config.record,
        )
        for measured in (False, True)
    )
    seen: frozenset[str] = frozenset()
    if config.record:  # the same for both filters: memory makes no difference to files and signals
        seen = watched_calls(
            policy_table(namespaced=namespaced, network=config.network, brokered=brokered)
        )
    return Common(
        config=config,
        pid=0 if namespaced else os.getpid(),
        namespaced=namespaced,
        root=plan,
        covered=covered,
        landlock_abi=abi,
        brokered=brokered,
        watched=seen,
        programs=programs,
    )


def _plan_root(config: ZygoteConfig) -> root_plan.RootPlan:
    host = root_plan.real_host()
    gpu = gpus.granted(config.gpu, host)
    homes = []
    with contextlib.suppress(KeyError):  # HOME is not ours to ask: our environment is built
        homes = [pwd.getpwuid(os.getuid()).pw_dir]
    return root_plan.plan_root(
        interpreter_paths(),
        (*config.readable, *gpu.folders, *([config.packages] if config.packages else [])),
        config.roots,
        private=[*homes, config.place],
        devices=gpu.devices,
        network=config.network,
        host=host,
    )


def interpreter_paths() -> list[str]:
    """Returns the paths that this interpreter and this package are loaded from."""
    package = os.path.dirname(os.path.abspath(envhub_worker.__file__))
    prefixes = [sys.prefix, sys.base_prefix, sys.exec_prefix, sys.base_exec_prefix]
    binaries = [os.path.dirname(sys.executable), os.path.dirname(os.path.realpath(sys.executable))]
    folders = [*filter(os.path.isabs, sys.path), *_editable_paths()]
    # folders of loaded shared libraries: nix and conda interpreters bring theirs
    with open("/proc/self/maps") as maps:
        mapped = {line.split(maxsplit=5)[5].rstrip("\n") for line in maps if "/" in line}
    libraries = {os.path.dirname(path) for path in mapped if path[:1] == "/" and ".so" in path}
    return [*prefixes, *binaries, *folders, package, *libraries]


def _editable_paths() -> Iterator[str]:
    """Returns paths of modules that finders and links point to, as after ``pip install -e``."""
    suffixes = tuple(importlib.machinery.all_suffixes())
    for path in itertools.chain(*mapped_modules(sys.meta_path).values()):
        folder, name = os.path.split(path)
        bases = [folder] if name.startswith("__init__.") else [path, *(path + e for e in suffixes)]
        yield from filter(os.path.isabs, bases)
    for folder in filter(os.path.isabs, sys.path):
        if os.path.basename(folder).startswith(_STRICT):
            yield from {*_linked(folder)}
        with contextlib.suppress(OSError), os.scandir(folder) as items:
            for item in filter(os.DirEntry.is_symlink, items):
                if item.name.endswith(suffixes) or os.path.isfile(f"{item.path}/__init__.py"):
                    yield item.path


def _linked(folder: str) -> Iterator[str]:
    """Returns what the links in a folder lead to: modules, and the folders of packages' files."""
    for parent, _, names in os.walk(folder):
        for link in filter(os.path.islink, (os.path.join(parent, name) for name in names)):
            target = os.path.realpath(link)
            yield target if parent == folder else os.path.dirname(target)


def _enter_namespaces(config: ZygoteConfig, plan: root_plan.RootPlan) -> None:
    copied = [*plan.roots, *([config.packages] if config.packages else [])]
    enter_root = partial(mounts.enter_root, plan, config.place, copied, config.user)
    # In this order. Root enters the private root while it may still cross folders like /root, which
    # needs no user namespace, and then changes its user. A plain user begins with the user
    # namespace, which gives the right to all others. The fork makes us the first process of the new
    # pid namespace; its /proc can be mounted only from inside, while the old one is in sight.
    try:
        if config.user is not None:
            kernel.unshare(kernel.CLONE_NEWNS)
            enter_root()
            _become(config, signal.SIGKILL)
        namespaces.enter_user_namespace(os.getuid(), os.getgid())
        namespaces.unshare_for_zygote(config.network)
        if config.user is None:
            enter_root()
        _be_the_first_process()
        mounts.mount_proc()
    except OSError as error:
        position = f"mounting at {error.filename}: " if error.filename else ""
        cause = namespaces.user_namespace_unavailable(error)
        why = LayerUnavailableError("mount-namespace", position + cause.reason, cause.fix)
        raise why from error


def _become(config: ZygoteConfig, at_parents_death: int) -> None:
    assert config.user is not None
    user.become(config.user)
    process.die_with_parent(config.parent, at_parents_death)


def _check_interpreter() -> None:
    """Check that the new user may read the interpreter, since there is no private root."""
    for path in (os.__file__, sys.prefix, __file__):
        if not os.access(path, os.R_OK):
            raise LayerUnavailableError(
                "unprivileged-user",
                f"root's jails run as another user, who may not read {path}",
                "Use an interpreter that all users may read (with umask 077, run 'umask 022' "
                'before you install it), profile "strict", or start as a plain user.',
            )


def _check_packages(folder: str) -> None:
    """Check that the top level is readable. An import names a deeper file that is not."""
    why = ""
    try:
        for name in os.listdir(folder):
            path = os.path.join(folder, name)
            if not os.access(path, os.R_OK | os.X_OK if os.path.isdir(path) else os.R_OK):
                why = f"holds {name}, which the jails may not read"
    except OSError as error:
        why = f"cannot be read: {error.strerror}"
    if why:
        raise LayerUnavailableError(
            "packages",
            f"the folder of packages {folder} {why}",
            f"The jails run as uid {os.getuid()} here. Make it again, or readable for all users: "
            f"chmod -R a+rX {folder}",
        )


def _be_the_first_process() -> None:
    """Fork: the child continues as pid 1 of the new pid namespace; the parent waits for its end."""
    child = os.fork()
    if child:
        # This parent only waits. If it held the channel, the server would not see the channel's
        # end.
        process.close_all_but({2})
        _, status = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(status)
        os._exit(code if code >= 0 else 128 - code)
    # The parent lives outside the pid namespace, where we see it as pid 0.
    process.die_with_parent(0, signal.SIGKILL)
