"""``envhub inspect``: the command, and what it prints of a repository that does not run."""
