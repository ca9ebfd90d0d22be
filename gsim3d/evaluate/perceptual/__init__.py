"""Perceptual distances of images (LPIPS) and of sets of clips (FVD), and the weights they need."""
