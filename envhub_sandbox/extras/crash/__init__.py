"""Crash bundles: records requests, writes them after a death, reads and replays them."""
