"""``envhub doctor tcp://HOST:PORT``: what a server on another host says, if it lets us in."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from envhub_sandbox.cli.shared.console import out, print_json, safe_line
from envhub_sandbox.cli.shared.exits import Exit
from envhub_sandbox.sandboxes.remote import RemoteSandbox
from envhub_sandbox.sandboxes.server_facts import ServerFacts, ask
from envhub_worker.protocol.text import size_text

_USED = {
    "sessions": "sessions",
    "jails": "jails",
    "runners": "runners",
    "memory_bytes": "memory_limit_bytes",
    "upload_bytes": "upload_bytes",
    "inflight_bytes": "inflight_bytes",
}
"""Quotas, and what is used of them, by their names in the figures."""


def examine(server: RemoteSandbox, profile: str, *, json: bool) -> Exit:
    """Ask a server and print what it says; the exit code is that of the profile.
    Raises ``EnvHubError``: it is not reached, or does not let us in.
    """
    facts = ask(server)
    code, problem = _verdict(facts, profile)
    if json:
        server_facts = {**asdict(facts), "endpoint": server.endpoint}
        print_json({"server": server_facts, "profile": profile, "problem": problem, "code": code})
    else:
        print_facts(server, facts, problem)
    return code


def _verdict(facts: ServerFacts, profile: str) -> tuple[Exit, str | None]:
    if facts.draining:
        return Exit.WORKER, "it is about to end, and lets nothing new in"
    if not facts.detailed or facts.enforces(profile):
        return Exit.OK, None
    return Exit.SANDBOX, (
        f"no jail with the profile {profile!r} there: {facts.profile!r} is the strongest that it "
        f"can have, and {facts.weakest_profile!r} the weakest that its operator permits"
    )


def print_facts(server: RemoteSandbox, facts: ServerFacts, problem: str | None) -> None:
    """Print what a server says, and what keeps it from having a jail. Trust: the server's word."""
    let_in = "asks for no key" if server.insecure_loopback else "knows our key"
    out(
        f"{safe_line(server.endpoint)}: envhub-worker {facts.version}, protocol {facts.protocol}; "
        f"it {let_in}, and answered after {facts.answered_s:.2f} s"
    )
    if not facts.detailed:
        out("It is older than this client, and does not say what it can enforce.")
    else:
        granted = [name for name in ("network", "gpu") if getattr(facts, name)]
        out(
            f"Python {facts.python}; jails there can have the profile {facts.profile} at most, and "
            f"a policy may ask for {facts.weakest_profile} at least"
            + (f", and for: {', '.join(granted)}" if granted else "")
            + ("; it installs what repositories declare" if facts.dependencies else "")
        )
    for line in _quotas(facts):
        out(f"  {line}")
    if problem is not None:
        out(problem, "bold red")


def _quotas(facts: ServerFacts) -> list[str]:
    used: dict[str, Any] = facts.used
    return [
        f"{_name(name)}: {_amount(name, used.get(_USED[name], 0))} of {_amount(name, limit)}"
        if name in _USED
        else f"{_name(name)}: at most {_amount(name, limit)}"
        for name, limit in facts.quotas.items()
    ]


def _name(quota: str) -> str:
    return safe_line(quota.removesuffix("_bytes").replace("_", " "))


def _amount(quota: str, amount: Any) -> str:
    return size_text(amount) if quota.endswith("_bytes") else f"{amount:,}"
