"""A module named like one of ours; it is the repository's."""

WHO_AM_I = "the repository's own worker.py"


def tighten(settings):
    """Runs in a child process of the repository."""
    settings.size += 1
    return settings
