"""Own videos: cameras from a board or structure from motion, checks, preparation, and training of a simulator."""
