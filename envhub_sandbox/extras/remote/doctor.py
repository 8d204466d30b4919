"""``envhub doctor tcp://HOST:PORT``: asks a server for its facts and prints them."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from envhub_sandbox.cli.shared.console import BAD, out, print_json, safe_line, show, show_rows
from envhub_sandbox.cli.shared.exits import Exit
from envhub_sandbox.extras.remote.sandbox import RemoteSandbox, ServerFacts, ask_facts
from envhub_worker.protocol.text import size_text

_USED = {
    "sessions": "sessions",
    "jails": "jails",
    "runners": "runners",
    "memory_bytes": "memory_limit_bytes",
    "upload_bytes": "upload_bytes",
    "inflight_bytes": "inflight_bytes",
}
"""For each quota the name of its use in the server's figures."""


def examine_server(server: RemoteSandbox, profile: str, *, json: bool) -> Exit:
    """Print a server's facts. The exit code says whether the server can enforce the profile.
    Raises ``EnvHubError``: the server cannot be reached, or rejects this client.
    """
    facts = ask_facts(server)
    code, problem = _verdict(facts, profile)
    if json:
        server_facts = {**asdict(facts), "endpoint": server.endpoint}
        print_json({"server": server_facts, "profile": profile, "problem": problem, "code": code})
    else:
        print_facts(server, facts, problem)
    return code


def _verdict(facts: ServerFacts, profile: str) -> tuple[Exit, str | None]:
    if facts.draining:
        return Exit.WORKER, "it drains: it accepts nothing new"
    if facts.enforces(profile):
        return Exit.OK, None
    return Exit.SANDBOX, (
        f"no jail with the profile {profile!r} there: {facts.profile!r} is the strongest that it "
        f"can have, and {facts.weakest_profile!r} the weakest that its operator permits"
    )


def print_facts(server: RemoteSandbox, facts: ServerFacts, problem: str | None) -> None:
    """Print a server's facts, and why it can open no jail. Trust: the facts are unverified."""
    release = f"envhub-worker {facts.version}, protocol {facts.protocol}"
    out(f"{safe_line(server.endpoint)}: {release}", "bold")
    let_in = "asks for no key" if server.insecure_loopback else "knows our key"
    show("answered", f"after {facts.answered_s:.2f} s; it {let_in}")
    granted = {"network": facts.network, "gpu": facts.gpu, "dependencies": facts.dependencies}
    show("python", facts.python)
    show("profiles", f"{facts.profile} at most; policies may ask for {facts.weakest_profile}")
    show("permits", ", ".join(name for name, is_on in granted.items() if is_on) or "no more")
    if facts.quotas:
        out()
        show_rows([("quota", "used", "limit"), *_quotas(facts)], right=(1, 2))
    if problem is not None:
        out()
        out(problem, BAD)


def _quotas(facts: ServerFacts) -> list[tuple[str, str, str]]:
    used: dict[str, Any] = facts.used
    return [
        (
            safe_line(name.removesuffix("_bytes").replace("_", " ")),
            _amount(name, used.get(_USED[name], 0)) if name in _USED else "",
            _amount(name, limit),
        )
        for name, limit in facts.quotas.items()
    ]


def _amount(quota: str, amount: Any) -> str:
    return size_text(amount) if quota.endswith("_bytes") else f"{amount:,}"
