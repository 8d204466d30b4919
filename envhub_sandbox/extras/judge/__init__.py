"""Judges a repository before it is trusted: what ``envhub check`` asks, and how it says it."""
