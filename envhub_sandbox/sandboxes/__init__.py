"""The sandboxes in which a worker can run, one file for each; extras have further ones."""
