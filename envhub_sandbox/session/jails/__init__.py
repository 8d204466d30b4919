"""The jails of a repository: opened, shared, built in; and what is held between two of them."""
