"""Switches for behaviour of the published model that this one corrects."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass


@dataclass(frozen=True)
class Quirks:
    """One switch for each published oddity that weights were trained with; all off is the corrected model.

    Each is read in one line of code. docs/differences.md has what else differs.

    Encoder:
        tiled_shift_mask: with three or more views the mask of shifted windows is repeated along keys that are ordered
            position by position, so it hides the wrong ones.
        integer_pixel_centers: the plane sweep puts feature pixel 0 at pixel coordinate 0 instead of its centre.
        reference_intrinsics: the plane sweep projects into a source view with the intrinsics of the reference view.
        ray_depth: depth means distance along the ray when particles are placed (the plane sweep means z).
        corner_aligned_upsampling: coarse disparity and features are stretched from corner to corner instead of laid
            where the strided convolutions took them.
        world_moments: moments of viewing rays are taken about the world's origin instead of the scene's.
    Dynamics:
        half_attention: queries, keys, values and results of attention are rounded to half precision (beyond its range
            to its largest number, where the published model has infinity).
        stale_decoder_conv: the first convolution of each decoder stage reads the skip branch before the features from
            below are added to it.
        first_of_voxel: where rows share a cell, a convolution reads the lowest row of a neighbour cell, not the mean.
        anchor_at_minimum: cells are counted from the smallest position of the call, and curves are as deep as its
            clouds are large, so clouds change each other.
        slots_from_first: time slots count from the first step and their number follows the history's length.
        unbounded_opacity: opacities have no upper limit.
        frozen_rows_turn: frozen particles keep their place but not their orientation (with one step a call).
    Harmonics (encoder of the explicit variant, renderer's head):
        unpaired_harmonics: predicted coefficients are in the published basis (the polar axis is y) and turn with
            matrices of another sign convention, so colours do not turn with the particle.
        clamped_polar_axis: they turn by a rotation that keeps 1e-3 rad away from turns about the y axis.
    Renderer:
        three_sigma_tiles: a Gaussian ends at the tiles that its three-sigma square touches.
        far_near_plane: Gaussians nearer than a fifth of the camera's near bound are culled.
        centered_principal_point: cameras keep their opening angles but look through the image's centre.
        z_in_harmonic_14: the value, not the gradient, of harmonic 14 has z where the harmonic has y (published axes).
    """

    tiled_shift_mask: bool = False
    integer_pixel_centers: bool = False
    reference_intrinsics: bool = False
    ray_depth: bool = False
    corner_aligned_upsampling: bool = False
    world_moments: bool = False
    half_attention: bool = False
    stale_decoder_conv: bool = False
    first_of_voxel: bool = False
    anchor_at_minimum: bool = False
    slots_from_first: bool = False
    unbounded_opacity: bool = False
    frozen_rows_turn: bool = False
    unpaired_harmonics: bool = False
    clamped_polar_axis: bool = False
    three_sigma_tiles: bool = False
    far_near_plane: bool = False
    centered_principal_point: bool = False
    z_in_harmonic_14: bool = False

    @classmethod
    def release(cls) -> Quirks:
        """The model as published: every switch on."""
        return cls(**{field.name: True for field in dataclasses.fields(cls)})
