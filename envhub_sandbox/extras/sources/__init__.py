"""Snapshots of git, of the index and of assets; checkouts; Python source that is only read."""
