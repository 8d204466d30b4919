"""Wheels of packages that have none: sources are data here, and built in a jail."""
