"""The state that environments have: copied, read and set, and compared from step to step."""
