"""Rotations and spherical harmonics."""
