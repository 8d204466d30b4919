"""The worker in a container: its command line, its proof, its monitor and its remains."""
