"""Documents and structure, held against the code."""
