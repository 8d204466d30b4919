"""Everything that shares a process with the stranger. Only a forked, confined child imports it."""
