"""Sources of snapshots beside the Hub and folders: git, the index, assets."""
