"""Files of 3D Gaussians that other tools open, by suffix: ``read_splats`` and ``write_splats``."""

from gsim3d.io.formats import FORMATS, format_of, read_splats, write_splats

__all__ = ["FORMATS", "format_of", "read_splats", "write_splats"]
