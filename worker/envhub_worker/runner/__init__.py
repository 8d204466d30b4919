"""The code that shares a process with the repository's; zygote and runners import it by name."""
