"""Attacks: each runs once without a sandbox, where it must succeed, and once inside of one."""
