"""The attacks that a profile does not stop, each with the reason. Asserted: a change is noticed.

``docs/threat-model.md`` lists every one of them; a test compares the two.
"""

from __future__ import annotations

# attack: {profile: why}
NOT_STOPPED: dict[str, dict[str, str]] = {
    "learn that a file exists, and its size": {
        "no-userns": "Landlock does not restrict stat; hiding names takes a mount namespace",
    },
}


def not_stopped(attack: str, profile: str, user: str) -> str | None:
    """Why an attack gets through under a profile, or None if it must not.

    Args:
        attack: Its title.
        profile: The policy's profile.
        user: ``"root"`` or ``"user"``.
    """
    reasons = NOT_STOPPED.get(attack, {})
    return reasons.get(f"{profile}, {user}", reasons.get(profile))
