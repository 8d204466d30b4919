"""The parts that several commands share: options, output, exit codes."""
