"""Judges a repository that nobody trusts yet: what ``envhub check`` asks, and how it says it."""
