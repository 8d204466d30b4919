"""The wire, its decoder and shared memory: whatever comes decodes, or is refused."""
