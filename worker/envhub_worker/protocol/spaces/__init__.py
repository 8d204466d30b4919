"""Gymnasium spaces as plain values, read back with every claim checked."""
