"""Everything that shares a process with the stranger. Zygote and runners load it, by name."""
