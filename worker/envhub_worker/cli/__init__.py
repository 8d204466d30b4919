"""The commands of ``envhub-worker``, one file each."""
