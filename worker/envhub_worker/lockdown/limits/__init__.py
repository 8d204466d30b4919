"""Limits of a jail's resources: enforced by the kernel where it counts them, else by measuring."""
