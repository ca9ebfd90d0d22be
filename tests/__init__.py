"""Tests; helpers are imported as tests.asserts, tests.oracle.*, ..."""
