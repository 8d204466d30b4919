"""What packages of the field do in a jail: by command, for a change of the system call filter."""
