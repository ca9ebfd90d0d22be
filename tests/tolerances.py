"""Every tolerance of the tests in one table: value, worst error seen, the machine, and the reason.

Unless the reason says otherwise a value is an absolute error over the largest absolute expected value.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerance:
    value: float
    worst: float  # the largest error seen when the value was chosen
    machine: str
    reason: str


EPYC = "AMD EPYC (Zen 4), torch 2.13 CPU"
H200 = "NVIDIA H200, torch 2.11"

TOLERANCES = {
    "decode_float32": Tolerance(
        3e-6, 1e-6, EPYC, "float32 products of up to 7 values, cubes of rotations, against float64"
    ),
    "decode_float64": Tolerance(1e-14, 1e-15, EPYC, "as decode_float32, in float64"),
    "generate_binding": Tolerance(1e-6, 1e-7, EPYC, "metres; MuJoCo stores the rest lattice in float32"),
    "generate_free_fall": Tolerance(
        1e-2, 4e-3, EPYC, "metres after 0.3 s: velocity is a step of 1/480 s ahead of position"
    ),
    "generate_machines": Tolerance(
        2e-3, 5e-6, EPYC, "metres; heights are recorded to 5 digits, contact amplifies the last bits of others"
    ),
    "law_float32": Tolerance(
        1e-5, 2.9e-6, EPYC, "an op on transformed input: sums in another order, positions rounded elsewhere"
    ),
    "law_float64": Tolerance(1e-12, 2.2e-14, EPYC, "as law_float32, in float64"),
    "patch_attn_float32": Tolerance(1e-6, 3.4e-7, EPYC, "float32 sums of up to 130 values against float64"),
    "patch_attn_float64": Tolerance(2e-15, 6.4e-16, EPYC, "as patch_attn_float32, in float64"),
    "patch_attn_grad_float32": Tolerance(3e-6, 1.1e-6, EPYC, "as patch_attn_float32"),
    "patch_attn_grad_float64": Tolerance(5e-15, 1.5e-15, EPYC, "as patch_attn_float32, in float64"),
    "patch_attn_scale_float32": Tolerance(5e-6, 1.7e-6, EPYC, "logits up to 60: their rounding shows"),
    "patch_attn_scale_float64": Tolerance(1e-14, 3.6e-15, EPYC, "as patch_attn_scale_float32, in float64"),
    "patch_attn_weight_float32": Tolerance(3e-6, 1.2e-6, EPYC, "a weight exp(-x), x up to 80: log2(e) is rounded"),
    "patch_attn_weight_float64": Tolerance(3e-14, 1e-14, EPYC, "as patch_attn_weight_float32 in float64, x up to 700"),
    "patch_attn_huge_logits": Tolerance(3e-6, 8.5e-7, EPYC, "exact dot products; scale and weights are rounded"),
    "patch_attn_golden": Tolerance(3e-6, 4.2e-7, EPYC, "float32 linear layers of the published block around the op"),
    "plane_sweep_float32": Tolerance(1e-5, 2e-6, EPYC, "sample places are float32"),
    "plane_sweep_float64": Tolerance(2e-14, 5.5e-15, EPYC, "as plane_sweep_float32, in float64"),
    "plane_sweep_grad_float32": Tolerance(1e-5, 1.2e-6, EPYC, "as plane_sweep_float32"),
    "plane_sweep_grad_float64": Tolerance(1e-14, 1.8e-15, EPYC, "as plane_sweep_float32, in float64"),
    "plane_sweep_large": Tolerance(
        1e-4, 3.2e-5, "NVIDIA H200, torch 2.11", "float32 places up to 256, CUDA rounds once in a product and sum"
    ),
    "plane_sweep_tiles_in_pieces": Tolerance(5e-4, 1.2e-4, EPYC, "float32 places up to 400, against float64"),
    "pool_float32": Tolerance(1e-6, 2e-7, EPYC, "float32 sums of up to 20 rows against float64"),
    "pool_float64": Tolerance(1e-14, 4e-16, EPYC, "float64 sums of up to 20 rows, another order of additions"),
    "row_norm_float32": Tolerance(3e-6, 1e-6, EPYC, "float32 means of up to 1,000 channels against float64"),
    "row_norm_float64": Tolerance(1e-14, 2e-15, EPYC, "as row_norm_float32, in float64"),
    "springs_float32": Tolerance(1e-5, 2.1e-6, EPYC, "17 substeps of float32 sums against float64"),
    "springs_float64": Tolerance(1e-14, 1.9e-15, EPYC, "as springs_float32, in float64"),
    "springs_grad_float32": Tolerance(2e-5, 3.4e-6, EPYC, "as springs_float32, and back"),
    "springs_grad_float64": Tolerance(1e-14, 1.6e-15, EPYC, "as springs_grad_float32, in float64"),
    "projection_float32": Tolerance(2e-5, 1e-6, EPYC, "float32 Jacobians and determinants against float64"),
    "projection_float64": Tolerance(1e-12, 1e-14, EPYC, "as projection_float32, in float64"),
    "projection_grad_float32": Tolerance(1e-4, 1e-5, EPYC, "as projection_float32"),
    "projection_grad_float64": Tolerance(1e-11, 1e-13, EPYC, "as projection_float32, in float64"),
    "raster_float32": Tolerance(
        1e-5, 2.2e-6, EPYC, "float32 exponents and products of up to 60 layers against float64"
    ),
    "raster_float64": Tolerance(2e-13, 1.5e-14, EPYC, "as raster_float32, in float64"),
    "raster_many_float32": Tolerance(1e-5, 2.1e-6, EPYC, "thousands of layers in one pixel"),
    "raster_many_float64": Tolerance(1e-13, 2e-14, EPYC, "thousands of layers in one pixel"),
    "raster_many_grad_float32": Tolerance(
        5e-4, 1.6e-4, H200, "as raster_many_float32; all of it comes from two of the layers"
    ),
    "raster_many_grad_float64": Tolerance(1e-12, 1.9e-13, EPYC, "as raster_many_grad_float32, in float64"),
    "raster_pixel_grad_float32": Tolerance(
        3e-3, 5.5e-4, H200, "one pixel beside all centres; moments are counted from the middle of 8 x 8 pixels"
    ),
    "raster_pixel_grad_float64": Tolerance(1e-12, 1e-15, EPYC, "as raster_pixel_grad_float32, in float64"),
    "raster_needle_float32": Tolerance(
        1e-5, 1.6e-6, EPYC, "long thin Gaussians: the projected covariance is nearly singular"
    ),
    "raster_needle_float64": Tolerance(1e-11, 1.9e-12, EPYC, "as raster_needle_float32, in float64"),
    "raster_needle_grad_float32": Tolerance(1e-2, 2e-3, EPYC, "30 m long, 1 um thick: the determinant is a difference"),
    "raster_needle_grad_float64": Tolerance(3e-11, 5.9e-12, EPYC, "as raster_needle_grad_float32, in float64"),
    "raster_grad_float32": Tolerance(3e-5, 1.1e-5, H200, "gradients of up to 60 layers, float32 against float64"),
    "raster_golden": Tolerance(1e-5, 7.0e-7, EPYC, "float64 on both sides, some published camera constants float32"),
    "raster_golden_float32": Tolerance(
        1e-4, 8.2e-6, EPYC, "float32 on both sides, advised by the notes of the tensors"
    ),
    "raster_grad_float64": Tolerance(2e-13, 1.1e-14, EPYC, "as raster_grad_float32, in float64"),
    "raster_tangent_float32": Tolerance(1e-4, 1.1e-5, EPYC, "forward mode, float32 against float64"),
    "raster_tangent_float64": Tolerance(5e-13, 1.4e-14, EPYC, "as raster_tangent_float32, in float64"),
    "raster_many_tangent_float32": Tolerance(5e-5, 4.7e-6, EPYC, "as raster_tangent_float32, thousands of layers"),
    "raster_many_tangent_float64": Tolerance(5e-13, 1.1e-14, EPYC, "as raster_many_tangent_float32, in float64"),
    "sparse_conv_float32": Tolerance(
        5e-6, 1.6e-6, EPYC, "float32 chains of up to 125 taps x 17 channels against float64"
    ),
    "sparse_conv_float64": Tolerance(2e-14, 3.3e-15, EPYC, "float64 chains in another order than the oracle's"),
    "sparse_conv_tf32": Tolerance(2e-3, 7.3e-7, H200, "as sparse_conv_float32, products of 11 bits"),
    "sparse_conv_bf16": Tolerance(2e-2, 4.8e-3, H200, "as sparse_conv_float32, numbers of 8 bits"),
    "attention_float64": Tolerance(1e-13, 9.2e-16, EPYC, "patches of up to 130 keys"),
    "attention_float32": Tolerance(1e-5, 4e-7, EPYC, "as attention_float64"),
    "attention_tf32": Tolerance(5e-3, 4e-7, H200, "as attention_float64"),
    "attention_bf16": Tolerance(5e-2, 1.1e-2, H200, "as attention_float64"),
    "attention_many_float64": Tolerance(1e-12, 3.1e-14, EPYC, "a patch of 100,000 keys"),
    "attention_many_float32": Tolerance(1e-4, 1.2e-5, EPYC, "as attention_many_float64"),
    "attention_many_tf32": Tolerance(5e-3, 1.2e-5, H200, "as attention_many_float64"),
    "attention_many_bf16": Tolerance(2e-2, 1e-2, H200, "as attention_many_float64"),
    "attention_huge_float64": Tolerance(1e-13, 1.2e-15, EPYC, "exact dot products up to a million"),
    "attention_huge_float32": Tolerance(1e-5, 5.8e-7, EPYC, "as attention_huge_float64"),
    "attention_huge_tf32": Tolerance(5e-3, 5.8e-7, H200, "as attention_huge_float64"),
    "attention_huge_bf16": Tolerance(5e-2, 8.4e-3, H200, "as attention_huge_float64"),
    "many_rows_float64": Tolerance(1e-13, 0.0, EPYC, "sums of 100,000 rows"),
    "many_rows_float32": Tolerance(3e-5, 6.6e-6, EPYC, "as many_rows_float64; pool_mean adds a segment in one chain"),
    "many_rows_tf32": Tolerance(1e-3, 1.4e-7, H200, "as many_rows_float64; numbers of 11 bits, sums of 24"),
    "many_rows_bf16": Tolerance(5e-3, 1.6e-3, H200, "as many_rows_float64; numbers of 8 bits, sums of 24"),
    "norm_many_rows_float64": Tolerance(1e-12, 1.2e-15, EPYC, "row_norm's gradients over 100,000 rows"),
    "norm_many_rows_float32": Tolerance(1e-5, 1.2e-6, EPYC, "as norm_many_rows_float64"),
    "norm_many_rows_tf32": Tolerance(1e-5, 7.2e-7, H200, "as norm_many_rows_float64"),
    "norm_many_rows_bf16": Tolerance(5e-3, 3e-3, H200, "as norm_many_rows_float64"),
    "geometry_float64": Tolerance(1e-14, 3.7e-16, EPYC, "inverses in float64"),
    "geometry_float32": Tolerance(1e-6, 1.6e-7, EPYC, "inverses in float64, cast"),
    "plane_sweep_behind_float32": Tolerance(
        1e-4, 1.2e-6, EPYC, "places up to 1e4 pixels away, in front of a source by millimetres"
    ),
    "plane_sweep_behind_float64": Tolerance(1e-12, 1.4e-15, EPYC, "as plane_sweep_behind_float32"),
    "encoder_float64": Tolerance(
        1e-12, 0.0, EPYC, "an encoder with random weights against the same on the CPU in float64"
    ),
    "encoder_float32": Tolerance(1e-4, 5e-6, EPYC, "as encoder_float64"),
    "encoder_tf32": Tolerance(1e-2, 8.3e-4, H200, "as encoder_float64"),
    "encoder_bf16": Tolerance(1e-1, 1.2e-2, H200, "as encoder_float64"),
    "encoder_constant_float64": Tolerance(1e-12, 0.0, EPYC, "as encoder_float64; instance norm divides by sqrt(1e-5)"),
    "encoder_constant_float32": Tolerance(1e-3, 7e-6, EPYC, "as encoder_constant_float64"),
    "encoder_constant_tf32": Tolerance(1e-2, 5e-4, H200, "as encoder_constant_float64"),
    "encoder_constant_bf16": Tolerance(2e-1, 0.0, H200, "as encoder_constant_float64"),
    "encoder_moved_float64": Tolerance(
        1e-9, 1.2e-13, EPYC, "moments of rays 10 km from zero: float64 keeps 11 digits of them"
    ),
    "encoder_moved_float32": Tolerance(2e-5, 0.0, EPYC, "as encoder_float32: nothing of the 10 km"),
    "encoder_moved_tf32": Tolerance(2e-2, 0.0, H200, "as encoder_tf32"),
    "encoder_moved_bf16": Tolerance(1e-1, 0.0, H200, "as encoder_bf16"),
    "rollout_2_float64": Tolerance(
        1e-12, 0.0, EPYC, "2 steps with random weights against the same on the CPU in float64"
    ),
    "rollout_2_float32": Tolerance(1e-4, 1.4e-7, EPYC, "as rollout_2_float64"),
    "rollout_2_tf32": Tolerance(1e-2, 1.3e-4, H200, "as rollout_2_float64"),
    "rollout_2_bf16": Tolerance(1e-1, 2.2e-3, H200, "as rollout_2_float64"),
    "rollout_12_float64": Tolerance(1e-9, 0.0, EPYC, "12 steps of a chaotic map: particles change cells"),
    "rollout_12_float32": Tolerance(1e-1, 2.7e-7, EPYC, "as rollout_12_float64"),
    "rollout_12_tf32": Tolerance(1e-1, 2.1e-4, H200, "as rollout_12_float64"),
    "rollout_12_bf16": Tolerance(5e-1, 3.4e-2, H200, "as rollout_12_float64"),
    "unit_float64": Tolerance(1e-15, 2.2e-16, EPYC, "lengths of quaternions"),
    "unit_float32": Tolerance(5e-7, 1.2e-7, EPYC, "lengths of quaternions"),
    "turns_float64": Tolerance(1e-13, 0.0, EPYC, "a thousand turns"),
    "turns_float32": Tolerance(1e-4, 8.8e-7, EPYC, "a thousand turns, each rounded once"),
    "other_rows_float64": Tolerance(1e-13, 1.1e-15, EPYC, "the same rows in calls of other sizes"),
    "other_rows_float32": Tolerance(1e-5, 4.5e-7, H200, "as other_rows_float64"),
    "other_rows_tf32": Tolerance(1e-2, 0.0, H200, "as other_rows_float64"),
    "other_rows_bf16": Tolerance(1e-1, 6e-3, H200, "as other_rows_float64"),
    "network_float64": Tolerance(
        1e-13, 3e-16, EPYC, "a step of the dynamics network against the same on the CPU in float64"
    ),
    "network_float32": Tolerance(1e-5, 4.3e-7, EPYC, "as network_float64"),
    "network_tf32": Tolerance(1e-2, 6.3e-4, H200, "as network_float64"),
    "network_bf16": Tolerance(5e-2, 1e-2, H200, "as network_float64"),
    "network_grad_float64": Tolerance(1e-13, 0.0, EPYC, "gradients of the same"),
    "network_grad_float32": Tolerance(1e-4, 4.4e-6, EPYC, "gradients of the same"),
    "network_grad_tf32": Tolerance(2e-1, 1.4e-1, H200, "as network_grad_bf16; 1e-3 with the maxima of float64"),
    "network_grad_bf16": Tolerance(
        5e-1, 7.7e-2, H200, "of rows as large as its rounding another one is a cell's maximum, and has the gradient"
    ),
    "golden_float32": Tolerance(
        1e-5, 1e-6, EPYC, "float32 against float32 of the published model, advised by its notes"
    ),
    "half_attention_golden": Tolerance(
        5e-4, 1.4e-4, EPYC, "half precision against float32 as advised; either way where a value lies between halves"
    ),
    "encoder_golden": Tolerance(
        1e-4, 9.2e-6, EPYC, "a deep float32 network; published runs differ by 1e-5 among themselves"
    ),
    "encoder_order": Tolerance(2e-5, 1.8e-6, EPYC, "float32 sums in another order through a deep network"),
    "film_golden": Tolerance(5e-6, 4.1e-7, EPYC, "float32 on both sides"),
    "fused_block_float64": Tolerance(2e-14, 3e-15, EPYC, "a block in float64, sums over rows in another order"),
    "fused_network_float32": Tolerance(
        2e-5, 1e-6, EPYC, "float32 gradients of a network, sums over rows in another order"
    ),
    "dynamics_order": Tolerance(1e-5, 1e-6, EPYC, "float32 sums over rows in another order through a network"),
    "dynamics_golden": Tolerance(1e-5, 5.7e-6, EPYC, "float32 networks of up to 14 blocks, another order of additions"),
}


def tolerance(name: str) -> float:
    return TOLERANCES[name].value
