"""The system call filter: a policy as a table, compiled to BPF and installed."""
