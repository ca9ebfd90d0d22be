"""Policies for invalid values, and the validation of frames and particles."""
