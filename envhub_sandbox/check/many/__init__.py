"""A list of repositories, each judged in a process of its own: ``envhub check --all``."""
