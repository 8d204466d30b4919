"""The packages that a repository declares: resolved, built, locked."""
