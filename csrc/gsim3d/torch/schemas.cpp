// Every op of gsim3d on one page. Kernels are registered in <op>/<op>_torch.cpp; fakes, autograd and autocast rules in
// gsim3d/ops/<op>.py. Sizes: B scenes, Q clouds, I images, N rows, C channels, H W pixels, D depths, P patches, K taps.
#include <Python.h>
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY(gsim3d, m) {
  // curve: space-filling-curve codes, their order, and all geometry of a network call.
  m.def("curve_encode(Tensor grid, Tensor cloud, int[] curves, int depth, int shift) -> Tensor");
  m.def("curve_sort(Tensor codes) -> (Tensor order, Tensor inverse)");
  m.def(
      "build_pyramid(Tensor positions, Tensor cu_rows, Tensor cloud_scene, Tensor cloud_slot, Tensor origin, "
      "float grid_size, "
      "int slot_bits, int[] strides, int[] merge_windows, int[] patch_sizes, int[] curves, int[] kernel_sizes, "
      "int[] cu_kernels, bool release, int[] capacity, bool rounded=False, int depth=0) -> Tensor[]");

  // sparse_conv: submanifold convolution over voxels; weight [C_out, K, K, K, C_in]. A plan is the order of rows and
  // the sources of their taps on CUDA, made once for all convolutions with a map.
  m.def(
      "sparse_conv_plan(Tensor row_voxel, Tensor voxel_rows, Tensor cu_voxel_rows, Tensor tap_in, Tensor tap_out, "
      "Tensor cu_taps, int kernel_size) -> Tensor");
  m.def(
      "sparse_conv(Tensor x, Tensor weight, Tensor? bias, Tensor row_voxel, Tensor voxel_rows, Tensor cu_voxel_rows, "
      "Tensor tap_in, Tensor tap_out, Tensor cu_taps, bool first, Tensor? plan=None) -> Tensor");
  m.def(
      "sparse_conv_grad_input(Tensor grad, Tensor weight, Tensor row_voxel, Tensor voxel_rows, Tensor cu_voxel_rows, "
      "Tensor tap_in, Tensor tap_out, Tensor cu_taps, bool first, Tensor? plan=None) -> Tensor");
  m.def(
      "sparse_conv_grad_weight(Tensor grad, Tensor x, int kernel_size, Tensor row_voxel, Tensor voxel_rows, "
      "Tensor cu_voxel_rows, Tensor tap_in, Tensor tap_out, Tensor cu_taps, bool first, bool rounded=False) -> (Tensor "
      "weight, Tensor bias)");

  // patch_attn: attention inside patches of a serialized order, separate query and key tables; q, k, v [N, H, D].
  // Joint: to the keys of two tables, in one softmax.
  m.def(
      "patch_attention(Tensor q, Tensor k, Tensor v, Tensor q_rows, Tensor kv_rows, Tensor cu_q, Tensor cu_k, float "
      "scale) "
      "-> (Tensor out, Tensor stats)");
  m.def(
      "joint_attention(Tensor q, Tensor k, Tensor v, Tensor other_k, Tensor other_v, Tensor q_rows, Tensor kv_rows, "
      "Tensor cu_q, Tensor cu_k, Tensor other_q_rows, Tensor other_kv_rows, Tensor other_cu_q, Tensor other_cu_k, "
      "float scale) -> (Tensor out, Tensor stats)");
  m.def(
      "patch_attention_backward(Tensor grad, Tensor q, Tensor k, Tensor v, Tensor out, Tensor stats, Tensor q_rows, "
      "Tensor kv_rows, Tensor cu_q, Tensor cu_k, float scale) -> (Tensor q, Tensor k, Tensor v)");
  m.def(
      "patch_attention_backward_packed(Tensor grad, Tensor q, Tensor k, Tensor v, Tensor out, Tensor stats, Tensor "
      "q_rows, Tensor kv_rows, Tensor cu_q, Tensor cu_k, float scale) -> Tensor");

  // pool: segment max and mean over clusters, and unpooling.
  m.def("pool_max(Tensor x, Tensor rows, Tensor cu_rows) -> (Tensor out, Tensor argmax)");
  m.def("pool_max_backward(Tensor grad, Tensor argmax, SymInt n_rows) -> Tensor");
  m.def("pool_mean(Tensor x, Tensor rows, Tensor cu_rows) -> Tensor");
  m.def("pool_mean_backward(Tensor grad, Tensor rows, Tensor cu_rows, SymInt n_rows) -> Tensor");
  m.def("unpool(Tensor x, Tensor rows, Tensor cu_rows, SymInt n_rows) -> Tensor");
  m.def("unpool_backward(Tensor grad, Tensor rows, Tensor cu_rows) -> Tensor");

  // row_norm: layer normalisation of rows, and the residual sum behind it; stats [N, 2] are kept for the backward pass.
  m.def(
      "row_norm(Tensor x, Tensor weight, Tensor bias, Tensor? residual, float eps, ScalarType dtype) -> (Tensor out, "
      "Tensor stats)");
  m.def(
      "row_norm_backward(Tensor grad, Tensor x, Tensor weight, Tensor stats) -> (Tensor x, Tensor weight, Tensor "
      "bias)");

  // residual_norm: sum = x + keep * norm(branch), out = norm(sum) in the dtype of branch; a norm without weight is left
  // out. Of the gradient, branch_sum is that of a bias of the layer that made the branch.
  m.def(
      "residual_norm(Tensor x, Tensor branch, Tensor? keep, Tensor? branch_weight, Tensor? branch_bias, Tensor? "
      "weight, "
      "Tensor? bias, float eps) -> (Tensor sum, Tensor out, Tensor branch_stats, Tensor stats)");
  m.def(
      "residual_norm_backward(Tensor? grad_sum, Tensor? grad_out, Tensor branch, Tensor sum, Tensor? keep, "
      "Tensor? branch_weight, Tensor? weight, Tensor branch_stats, Tensor stats) -> (Tensor x, Tensor branch, "
      "Tensor branch_sum, Tensor branch_weight, Tensor branch_bias, Tensor weight, Tensor bias)");
  m.def("linear_grad_bias(Tensor grad) -> Tensor");

  // norm_gelu: gelu((x - mean) * scale + bias), one mean, scale and bias a channel; batch normalisation and its
  // activation.
  m.def("norm_gelu(Tensor x, Tensor mean, Tensor scale, Tensor bias, ScalarType dtype) -> Tensor");
  m.def(
      "norm_gelu_backward(Tensor grad, Tensor x, Tensor mean, Tensor scale, Tensor bias) -> (Tensor x, Tensor scale, "
      "Tensor bias)");

  // decode: what a network says about shapes and colours of Gaussians -> rotations, scales, harmonics in the world.
  m.def(
      "decode_gaussians(Tensor raw, Tensor readings, int degree, float scale_min, float scale_max) -> (Tensor quats, "
      "Tensor scales, Tensor sh)");
  m.def(
      "decode_gaussians_backward(Tensor grad_quats, Tensor grad_scales, Tensor grad_sh, Tensor raw, Tensor readings, "
      "int degree, float scale_min, float scale_max) -> Tensor");

  // validate_state: invalid rows, their replacements, and sums over clouds.
  m.def(
      "validate_state(Tensor[] fields, float[] low, float[] high, Tensor cu_rows, Tensor cloud_scene, Tensor origin, "
      "Tensor activity, Tensor[] previous, float grid_size, float max_step, float[] neutral, bool joined=True) -> "
      "(Tensor status, Tensor record, Tensor[] sanitized)");
  m.def("join_records(Tensor[] parts, Tensor[] cu_rows, int[] n_rows) -> Tensor");

  // background: where rows meet one that was computed before. Lists have an entry a stage; tables a row a curve.
  m.def(
      "row_scenes(Tensor cloud_scene, Tensor cu_input, Tensor[] rows, Tensor[] cu_rows) -> Tensor[]");
  m.def("find_cells(Tensor cells, Tensor scene, Tensor grid) -> Tensor");
  m.def("add_cells(Tensor x, Tensor field, Tensor places) -> Tensor");
  m.def(
      "overlapping_patches(Tensor first, Tensor kv_rows, Tensor cu_k, Tensor codes, Tensor order, Tensor cu_clouds, "
      "int patch_size) -> (Tensor q_rows, Tensor kv_rows, Tensor cu_q, Tensor cu_k)");

  // plane_sweep: multi-view stereo cost volume; features [I, C, h, w] -> cost [I, D, h, w].
  m.def(
      "plane_sweep(Tensor features, Tensor homographies, Tensor translations, Tensor inverse_depths, Tensor "
      "src_images, "
      "Tensor cu_src) -> Tensor");
  m.def(
      "plane_sweep_backward(Tensor grad, Tensor features, Tensor homographies, Tensor translations, Tensor "
      "inverse_depths, "
      "Tensor src_images, Tensor cu_src) -> Tensor");

  // springs: substeps of anchors on springs above a ground; state [2, N, 3]; kept [K, 2, N, 3] for the backward pass.
  m.def(
      "advance_springs(Tensor state, Tensor neighbors, Tensor cu_springs, Tensor sources, Tensor cu_sources, Tensor "
      "lengths, Tensor stiffness, Tensor damping, Tensor grip, Tensor external, float seconds, int substeps, float "
      "ground, float power) -> (Tensor state, Tensor kept)");
  m.def(
      "advance_springs_backward(Tensor grad, Tensor last, Tensor kept, Tensor state, Tensor neighbors, Tensor "
      "cu_springs, Tensor sources, Tensor cu_sources, Tensor lengths, Tensor stiffness, Tensor damping, Tensor grip, "
      "Tensor external, float seconds, int substeps, float ground, float power) -> (Tensor state, Tensor lengths, Tensor "
      "stiffness, Tensor damping, Tensor grip, Tensor external)");

  // projection: 3D Gaussians into images without blending them, P pairs of a row and an image; lens 0 pinhole, 1
  // orthographic, 2 opencv, 3 fisheye. Of the gradient, what is not wanted is empty.
  m.def(
      "project_gaussians(Tensor means, Tensor? quats, Tensor? scales, Tensor? covars, Tensor? opacities, Tensor "
      "viewmats, Tensor Ks, Tensor? distortion, Tensor? limits, Tensor image_cloud, Tensor cu_rows, Tensor cu_pairs, "
      "SymInt n_pairs, int width, int height, float near_plane, float far_plane, float radius_clip, float dilation, int "
      "lens, bool clamped, bool antialiased) -> (Tensor means2d, Tensor conics, Tensor depths, Tensor radii, Tensor "
      "compensations)");
  m.def(
      "project_gaussians_backward(Tensor? grad_means2d, Tensor? grad_conics, Tensor? grad_depths, Tensor? "
      "grad_compensations, Tensor radii, Tensor means, Tensor? quats, Tensor? scales, Tensor? covars, Tensor viewmats, "
      "Tensor Ks, Tensor? distortion, Tensor image_cloud, Tensor cu_rows, Tensor cu_pairs, SymInt n_pairs, int width, "
      "int height, float dilation, int lens, bool clamped, bool viewmats_grad, bool lens_grad) -> (Tensor means, Tensor "
      "quats, Tensor scales, Tensor covars, Tensor viewmats, Tensor Ks, Tensor distortion)");

  // sh_to_color: colours [B, V, N, D] of real spherical harmonics [B, N, K, D] seen along directions [B, V, N, 3].
  m.def("sh_to_color(Tensor directions, Tensor sh) -> Tensor");
  m.def("sh_to_color_backward(Tensor grad, Tensor directions, Tensor sh) -> (Tensor directions, Tensor sh)");

  // raster: 3D Gaussian projection and blending. color is [N, K, 3] SH coefficients or [N, 3]; cutoff 0 exact, 1
  // tile3sigma, 2 smooth; jacobian 0 exact, 1 clamped; transmittance, last and state are kept for the backward pass.
  // max_* (CUDA) size the state.
  // active: bool [I, tiles, tiles] of 16 x 16 pixels; the others show the background alone.
  // unusable [I, 2] counts the rows that were left out, [0, 2] unless `watch`.
  m.def(
      "rasterize_gaussians(Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor color, Tensor features, "
      "Tensor background, Tensor viewmats, Tensor Ks, Tensor image_cloud, Tensor cu_rows, int width, int height, "
      "float near_plane, int cutoff, int jacobian, SymInt max_pairs, SymInt max_entries, SymInt max_slots, bool watch, "
      "Tensor? active=None) -> (Tensor color, Tensor alpha, Tensor depth, Tensor features, Tensor transmittance, Tensor last, Tensor state, "
      "Tensor unusable)");
  m.def(
      "rasterize_gaussians_backward(Tensor grad_color, Tensor grad_alpha, Tensor grad_depth, Tensor grad_features, "
      "Tensor transmittance, Tensor last, Tensor state, Tensor means, Tensor quats, Tensor scales, Tensor opacities, "
      "Tensor color, Tensor features, Tensor background, Tensor viewmats, Tensor Ks, Tensor image_cloud, Tensor "
      "cu_rows, "
      "int width, int height, float near_plane, int cutoff, int jacobian, SymInt max_pairs, SymInt max_entries, SymInt "
      "max_slots, bool viewmats_grad, Tensor? active=None) -> (Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor color, "
      "Tensor features, Tensor background, Tensor viewmats)");

  // Derivatives of the four images along the tangents t_*.
  m.def(
      "rasterize_gaussians_tangent(Tensor t_means, Tensor t_quats, Tensor t_scales, Tensor t_opacities, Tensor "
      "t_color, Tensor t_features, Tensor t_background, Tensor t_viewmats, Tensor state, Tensor means, Tensor quats, Tensor "
      "scales, Tensor opacities, Tensor color, Tensor features, Tensor background, Tensor viewmats, Tensor Ks, Tensor "
      "image_cloud, Tensor cu_rows, int width, int height, float near_plane, int cutoff, int jacobian, SymInt "
      "max_pairs, SymInt max_entries, SymInt max_slots, Tensor? active=None) -> (Tensor color, Tensor alpha, Tensor "
      "depth, Tensor features)");
  // On the CPU also of all gradients that those of images give.
  m.def(
      "rasterize_gaussians_backward_tangent(Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor color, "
      "Tensor features, Tensor background, Tensor viewmats, Tensor Ks, Tensor image_cloud, Tensor cu_rows, Tensor "
      "t_means, Tensor t_quats, Tensor t_scales, Tensor t_opacities, Tensor t_color, Tensor t_features, Tensor "
      "t_background, Tensor t_viewmats, Tensor grad_color, Tensor grad_alpha, Tensor grad_depth, Tensor grad_features, "
      "int width, int height, float near_plane, int cutoff, int jacobian, Tensor? active=None) -> (Tensor color, Tensor "
      "alpha, Tensor depth, "
      "Tensor features, Tensor grad_means, Tensor grad_quats, Tensor grad_scales, Tensor grad_opacities, Tensor "
      "grad_in_color, Tensor grad_in_features, Tensor grad_background, Tensor grad_viewmats)");

  // The same blending of Gaussians that are projected already, each for one image. The gradient of `absolute` [P, 2] is
  // the sum over pixels of |gradient of means2d|; it takes no other part, and is two more columns of features.
  m.def(
      "rasterize_projected(Tensor means2d, Tensor conics, Tensor depths, Tensor opacities, Tensor color, Tensor "
      "features, Tensor background, Tensor? absolute, Tensor image_cloud, Tensor cu_rows, int width, int height, int "
      "cutoff, SymInt max_pairs, SymInt max_entries, SymInt max_slots) -> (Tensor color, Tensor alpha, Tensor depth, "
      "Tensor features, Tensor transmittance, Tensor last, Tensor state)");
  m.def(
      "rasterize_projected_backward(Tensor? grad_color, Tensor? grad_alpha, Tensor? grad_depth, Tensor? grad_features, "
      "Tensor transmittance, Tensor last, Tensor state, Tensor means2d, Tensor conics, Tensor depths, Tensor opacities, "
      "Tensor color, Tensor features, Tensor background, Tensor image_cloud, Tensor cu_rows, int width, int height, int "
      "cutoff, SymInt max_pairs, SymInt max_entries, SymInt max_slots, bool background_grad, bool absolute) -> (Tensor "
      "means2d, Tensor conics, Tensor depths, Tensor opacities, Tensor color, Tensor features, Tensor background)");
}

// The library is loaded by importing it; its contents are the registered ops.
PyMODINIT_FUNC PyInit__ops(void) {
  static PyModuleDef module = {PyModuleDef_HEAD_INIT, "_ops", nullptr, -1, nullptr, nullptr, nullptr, nullptr, nullptr};
  return PyModule_Create(&module);
}
