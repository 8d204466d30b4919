"""Locks a repository's state, tells when it was written, and compares it with a lock."""
