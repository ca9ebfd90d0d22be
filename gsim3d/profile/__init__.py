"""Accuracy against time: errors and step times of a trained simulator under many settings."""
