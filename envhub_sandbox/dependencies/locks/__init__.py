"""Lock files: what a repository was when it was locked, and whether it still is."""
