"""A repository's Python files, read as data: each is parsed in a bounded child, and none is run."""
