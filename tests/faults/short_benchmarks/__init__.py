"""Short forms of benchmarks that go on for hours."""
