"""The attacks that are not stopped, where, and why. Asserted: a change is noticed.
``docs/threat-model.md`` lists every one of them; a test compares the two."""

from collections.abc import Collection

MEASURED = "memory measured by init"
"""The condition of a host that lets us make no control group: a plain user without delegation."""
PLAIN = "a plain user"
"""The condition of a jail that runs as the user who also runs the caller's other programs."""
_LOCKS = "no control group counts them, and no limit of the kernel's bounds them"
_FLOCK = "flock takes no more than a descriptor; programs need it on their own files"

# attack: {a profile, or a condition of the host: why}
NOT_STOPPED: dict[str, dict[str, str]] = {
    "learn that a file exists, its size, and where a link leads": {
        "no-userns": "Landlock restricts neither; hiding names takes a mount namespace"
    },
    "hold a readable file: flock": {"strict": _FLOCK, "no-userns": _FLOCK},
    "use up the user's descriptors in flight": {
        PLAIN: "the kernel counts them per user, and compares with each sender's own limit"
    },
    "use up the user's pages of pipes": {
        PLAIN: "the kernel counts them per user; new pipes of the others hold 8 KiB"
    },
    "memory bomb: file locks": {"strict": _LOCKS, "no-userns": _LOCKS},
    "memory bomb: epoll watches": {
        MEASURED: "no process's account shows them; the kernel limits a user to 4% of the memory"
    },
    "memory bomb: sockets in flight": {
        f"no-userns, {MEASURED}": "only a network namespace counts what waits in another socket"
    },
    "with gpu, on a real one: read what another process offers on it, by its handle": {
        "strict": "the driver maps what was exported (cudaIpcGetMemHandle) by its 64 bytes alone"
    },
}
MEASURED_ATTACKS = frozenset({"fork bomb", "thread bomb"})
"""What init measures now and then under ``no-userns`` without a control group: a burst between two
looks gets through on a busy machine and is stopped on a quiet one, so neither is asserted there."""
SHARED = {
    "stdin: /dev/null": {"init", "zygote"},
    "stdout: pipe": {"init"},
    "stderr: pipe": {"init"},
    "stream: socket": set(),
    "slab: request": {"client"},
    "slab: reply": {"client"},
    "slab: observations": {"client"},
    "what it hears: socket": set(),
    "what it rings: eventfd": {"client"},
}
"""Every descriptor of a jail, and who else holds its open file description.

``docs/threat-model.md`` says of each what a jail can do to them with it.
"""


def depends_on_load(attack: str, conditions: Collection[str]) -> bool:
    """Whether an attack is stopped here only if init looks in time."""
    needed = {"no-userns", MEASURED}
    return attack in MEASURED_ATTACKS and needed <= set(conditions)


def not_stopped(attack: str, conditions: Collection[str]) -> str | None:
    reasons = NOT_STOPPED.get(attack, {})
    return next((reasons[name] for name in conditions if name in reasons), None)
