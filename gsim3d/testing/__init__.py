"""Invariances, stress tests and approximation errors of a simulator."""
