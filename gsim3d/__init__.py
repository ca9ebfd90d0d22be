"""gsim3d learns 3D simulators from multi-view video."""
__version__ = "0.1.0"
