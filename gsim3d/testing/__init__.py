"""Invariances and stress tests of a simulator."""
