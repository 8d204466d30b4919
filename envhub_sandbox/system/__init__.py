"""What several packages ask of the operating system: locks, files, folders, processes."""
