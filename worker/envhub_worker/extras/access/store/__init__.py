"""Clients' uploaded snapshots, stored by content."""
