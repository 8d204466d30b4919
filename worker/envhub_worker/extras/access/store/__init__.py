"""Snapshots that clients bring along, by content."""
