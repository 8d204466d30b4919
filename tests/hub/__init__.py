"""Hubs for tests: olah with real git repositories, and a stub that lies and fails."""
