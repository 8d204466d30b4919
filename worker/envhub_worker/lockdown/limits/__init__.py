"""How much a jail may use: by the kernel where it counts, measured elsewhere."""
