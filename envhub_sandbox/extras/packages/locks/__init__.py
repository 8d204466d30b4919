"""What a repository was when it was locked or written, and whether it still is."""
