"""Gymnasium's interface: vector environments, single environments and suites."""
