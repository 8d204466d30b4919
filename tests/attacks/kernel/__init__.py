"""The kernel: namespaces, mounts, rare calls, devices, and what its denials tell."""
