"""The operating system, for several packages: locks, files, folders, processes, threads."""
