"""Attacks by kind: ``NAME(**arguments)`` of one of these returns what it got, or raises."""
