"""The table of faults, and a test of each of its rows."""
