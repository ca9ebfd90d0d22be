"""Switches for behaviour of the published model that this one corrects."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass


@dataclass(frozen=True)
class Quirks:
    """One switch for each published oddity; all off is the corrected model. Each is read in one line of code.

    Encoder:
        tiled_shift_mask: with three or more views the mask of shifted windows is repeated along keys that are ordered
            position by position, so it hides the wrong ones.
        integer_pixel_centers: the plane sweep puts feature pixel 0 at pixel coordinate 0 instead of its centre.
        reference_intrinsics: the plane sweep projects into a source view with the intrinsics of the reference view.
        ray_depth: depth means distance along the ray when particles are placed (the plane sweep means z).
        corner_aligned_upsampling: coarse disparity and features are stretched from corner to corner instead of laid where
            the strided convolutions took them.
        world_moments: moments of viewing rays are taken about the world's origin instead of the scene's.
        released_harmonics: the explicit variant's harmonics are turned into the world in a basis other than the renderer's.
    """

    tiled_shift_mask: bool = False
    integer_pixel_centers: bool = False
    reference_intrinsics: bool = False
    ray_depth: bool = False
    corner_aligned_upsampling: bool = False
    world_moments: bool = False
    released_harmonics: bool = False

    @classmethod
    def release(cls) -> Quirks:
        """The model as published: every switch on."""
        return cls(**{field.name: True for field in dataclasses.fields(cls)})
