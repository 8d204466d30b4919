"""Resolves and installs a repository's declared packages without running any of its code."""
