"""Perceptual metrics LPIPS and FVD, and their weights."""
