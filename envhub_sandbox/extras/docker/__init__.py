"""The worker in a container: command line, attestation, monitor, and removal of leftovers."""
