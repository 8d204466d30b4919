"""What a repository is described as: the manifest, and which names and facts it may hold."""
