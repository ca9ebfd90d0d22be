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

TOLERANCES = {
    "generate_binding": Tolerance(1e-6, 1e-7, EPYC, "metres; MuJoCo stores the rest lattice in float32"),
    "generate_free_fall": Tolerance(1e-2, 4e-3, EPYC, "metres after 0.3 s: velocity is a step of 1/480 s ahead of position"),
    "generate_machines": Tolerance(2e-3, 5e-6, EPYC, "metres; heights are recorded to 5 digits, contact amplifies the last bits of others"),
    "law_float32": Tolerance(1e-5, 2.9e-6, EPYC, "an op on input told otherwise: sums in another order, places rounded elsewhere"),
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
    "plane_sweep_float64": Tolerance(2e-14, 4e-15, EPYC, "as plane_sweep_float32, in float64"),
    "plane_sweep_grad_float32": Tolerance(1e-5, 1.2e-6, EPYC, "as plane_sweep_float32"),
    "plane_sweep_grad_float64": Tolerance(1e-14, 1.8e-15, EPYC, "as plane_sweep_float32, in float64"),
    "plane_sweep_large": Tolerance(1e-4, 3.2e-5, "NVIDIA H200, torch 2.11", "float32 places up to 256, CUDA rounds once in a product and sum"),
    "pool_float32": Tolerance(1e-6, 2e-7, EPYC, "float32 sums of up to 20 rows against float64"),
    "pool_float64": Tolerance(1e-14, 4e-16, EPYC, "float64 sums of up to 20 rows, another order of additions"),
    "row_norm_float32": Tolerance(3e-6, 1e-6, EPYC, "float32 means of up to 1,000 channels against float64"),
    "row_norm_float64": Tolerance(1e-14, 2e-15, EPYC, "as row_norm_float32, in float64"),
    "raster_float32": Tolerance(1e-5, 2.2e-6, EPYC, "float32 exponents and products of up to 60 layers against float64"),
    "raster_float64": Tolerance(2e-13, 1.5e-14, EPYC, "as raster_float32, in float64"),
    "raster_many_float32": Tolerance(1e-5, 6.5e-7, EPYC, "thousands of layers in one pixel"),
    "raster_many_float64": Tolerance(1e-13, 1.7e-15, EPYC, "thousands of layers in one pixel"),
    "raster_needle_float32": Tolerance(1e-5, 1.6e-6, EPYC, "long thin Gaussians: the projected covariance is nearly singular"),
    "raster_grad_float32": Tolerance(3e-5, 6.3e-6, EPYC, "gradients of up to 60 layers, float32 against float64"),
    "raster_golden": Tolerance(1e-5, 7.0e-7, EPYC, "float64 on both sides, some published camera constants float32"),
    "raster_golden_float32": Tolerance(1e-4, 8.2e-6, EPYC, "float32 on both sides, advised by the notes of the tensors"),
    "raster_grad_float64": Tolerance(2e-13, 1.1e-14, EPYC, "as raster_grad_float32, in float64"),
    "sparse_conv_float32": Tolerance(5e-6, 1.6e-6, EPYC, "float32 chains of up to 125 taps x 17 channels against float64"),
    "sparse_conv_float64": Tolerance(2e-14, 3.3e-15, EPYC, "float64 chains in another order than the oracle's"),
    "golden_float32": Tolerance(1e-5, 1e-6, EPYC, "float32 against float32 of the published model, advised by its notes"),
    "half_attention_golden": Tolerance(5e-4, 1.4e-4, EPYC, "half precision against float32 as advised; either way where a value lies between halves"),
    "encoder_golden": Tolerance(1e-4, 9.2e-6, EPYC, "a deep float32 network; published runs differ by 1e-5 among themselves"),
    "encoder_order": Tolerance(2e-5, 1.8e-6, EPYC, "float32 sums in another order through a deep network"),
    "film_golden": Tolerance(5e-6, 4.1e-7, EPYC, "float32 on both sides"),
    "fused_block_float64": Tolerance(2e-14, 3e-15, EPYC, "a block in float64, sums over rows in another order"),
    "fused_network_float32": Tolerance(2e-5, 1e-6, EPYC, "float32 gradients of a network, sums over rows in another order"),
    "dynamics_order": Tolerance(1e-5, 1e-6, EPYC, "float32 sums over rows in another order through a network"),
    "dynamics_golden": Tolerance(1e-5, 5.7e-6, EPYC, "float32 networks of up to 14 blocks, another order of additions"),
}


def tolerance(name: str) -> float:
    return TOLERANCES[name].value
