"""Plays a repository for a verdict, and records what it does."""
