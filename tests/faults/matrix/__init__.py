"""The table of faults, the document that is written from it, and a test of each of its rows."""
