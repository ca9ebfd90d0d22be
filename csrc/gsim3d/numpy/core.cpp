// gsim3d._core: the CPU core on numpy arrays, for callers without torch.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <initializer_list>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "gsim3d/core/check.h"
#include "gsim3d/core/parallel.h"
#include "gsim3d/core/version.h"
#include "gsim3d/core/workspace.h"
#include "gsim3d/curve/curve.h"
#include "gsim3d/patch_attn/patch_attn.h"
#include "gsim3d/plane_sweep/plane_sweep.h"
#include "gsim3d/plane_sweep/plane_sweep_math.h"
#include "gsim3d/pool/pool.h"
#include "gsim3d/raster/raster.h"
#include "gsim3d/raster/raster_math.h"
#include "gsim3d/validate_state/validate_state.h"
#include "gsim3d/sparse_conv/sparse_conv.h"

namespace py = pybind11;

namespace {

template <typename T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
using Indices = Array<int64_t>;

// check_shape("plane_sweep", "features", features, {-1, -1, -1, -1}): -1 accepts any size.
void check_shape(const char* op, const char* name, const py::array& array, std::initializer_list<int64_t> sizes) {
  bool ok = array.ndim() == static_cast<int64_t>(sizes.size());
  std::string wanted, got;
  int64_t axis = 0;
  for (int64_t size : sizes) {
    ok = ok && (size < 0 || array.shape(axis) == size);
    wanted += (axis++ ? ", " : "") + (size < 0 ? std::string("*") : std::to_string(size));
  }
  for (int64_t i = 0; i < array.ndim(); ++i) got += (i ? ", " : "") + std::to_string(array.shape(i));
  gsim3d::check(ok, op, ": ", name, " must be [", wanted, "]; got [", got, "]");
}

gsim3d::Segments segments_of(const char* op, const Indices& rows, const Indices& cu_rows, int64_t n_rows) {
  check_shape(op, "rows", rows, {-1});
  check_shape(op, "cu_rows", cu_rows, {-1});
  gsim3d::check(cu_rows.size() >= 1, op, ": cu_rows must be [M + 1]; got []");
  const gsim3d::Segments segments{rows.data(), cu_rows.data(), cu_rows.size() - 1, rows.size(), n_rows};
  gsim3d::cpu::check_segments(op, segments);
  return segments;
}

template <typename T>
std::tuple<py::array_t<T>, py::array_t<int64_t>> pool_max(const Array<T>& x, const Indices& rows,
                                                          const Indices& cu_rows) {
  check_shape("pool_max", "x", x, {-1, -1});
  const auto segments = segments_of("pool_max", rows, cu_rows, x.shape(0));
  py::array_t<T> out({segments.n_segments, x.shape(1)});
  py::array_t<int64_t> argmax({segments.n_segments, x.shape(1)});
  gsim3d::cpu::pool_max(x.data(), segments, x.shape(1), out.mutable_data(), argmax.mutable_data(),
                        gsim3d::thread_pool());
  return {out, argmax};
}

template <typename T>
py::array_t<T> pool_mean(const Array<T>& x, const Indices& rows, const Indices& cu_rows) {
  check_shape("pool_mean", "x", x, {-1, -1});
  const auto segments = segments_of("pool_mean", rows, cu_rows, x.shape(0));
  py::array_t<T> out({segments.n_segments, x.shape(1)});
  gsim3d::cpu::pool_mean(x.data(), segments, x.shape(1), out.mutable_data(), gsim3d::thread_pool());
  return out;
}

Indices curve_encode(const Indices& grid, const Indices& cloud, int64_t curve, int64_t depth) {
  check_shape("curve_encode", "grid", grid, {-1, 3});
  check_shape("curve_encode", "cloud", cloud, {grid.shape(0)});
  Indices codes(grid.shape(0));
  gsim3d::cpu::curve_encode(grid.data(), cloud.data(), grid.shape(0), curve, depth, 3 * depth, codes.mutable_data(),
                            gsim3d::thread_pool());
  return codes;
}

std::tuple<Indices, Indices> curve_sort(const Indices& codes) {
  check_shape("curve_sort", "codes", codes, {-1, -1});
  Indices order({codes.shape(0), codes.shape(1)}), inverse({codes.shape(0), codes.shape(1)});
  gsim3d::HeapWorkspace workspace;
  gsim3d::cpu::curve_sort(codes.data(), codes.shape(0), codes.shape(1), order.mutable_data(), inverse.mutable_data(),
                          workspace, gsim3d::thread_pool());
  return {order, inverse};
}

template <typename T>
py::array_t<T> plane_sweep(const Array<T>& features, const Array<T>& homographies, const Array<T>& translations,
                           const Array<T>& inverse_depths, const Indices& src_images, const Indices& cu_src) {
  const char* op = "plane_sweep";
  check_shape(op, "features", features, {-1, -1, -1, -1});
  check_shape(op, "src_images", src_images, {-1});
  check_shape(op, "homographies", homographies, {src_images.size(), 3, 3});
  check_shape(op, "translations", translations, {src_images.size(), 3});
  check_shape(op, "inverse_depths", inverse_depths, {features.shape(0), -1});
  check_shape(op, "cu_src", cu_src, {features.shape(0) + 1});
  const gsim3d::PlaneSweep<T> sweep{homographies.data(),  translations.data(),     inverse_depths.data(),
                                    src_images.data(),    cu_src.data(),           features.shape(0),
                                    src_images.size(),    inverse_depths.shape(1), features.shape(1),
                                    features.shape(2),    features.shape(3)};
  gsim3d::cpu::check_plane_sweep(op, sweep);
  py::array_t<T> cost({sweep.n_images, sweep.n_depths, sweep.height, sweep.width});
  gsim3d::HeapWorkspace workspace;
  gsim3d::cpu::plane_sweep(features.data(), sweep, cost.mutable_data(), workspace, gsim3d::thread_pool());
  return cost;
}

template <typename T>
py::array_t<T> sparse_conv(const Array<T>& x, const Array<T>& weight, const std::optional<Array<T>>& bias,
                           const Indices& row_voxel, const Indices& voxel_rows, const Indices& cu_voxel_rows,
                           const Indices& tap_in, const Indices& tap_out, const Indices& cu_taps, bool first) {
  const char* op = "sparse_conv";
  check_shape(op, "x", x, {-1, -1});
  gsim3d::check(weight.ndim() == 5, op, ": weight must be [C_out, K, K, K, C_in]; got ", weight.ndim(), " dimensions");
  const int64_t kernel_size = weight.shape(1);
  gsim3d::cpu::check_sparse_conv_kernel(op, kernel_size);
  check_shape(op, "weight", weight, {-1, kernel_size, kernel_size, kernel_size, x.shape(1)});
  if (bias) check_shape(op, "bias", *bias, {weight.shape(0)});
  check_shape(op, "row_voxel", row_voxel, {x.shape(0)});
  check_shape(op, "voxel_rows", voxel_rows, {x.shape(0)});
  check_shape(op, "cu_voxel_rows", cu_voxel_rows, {-1});
  gsim3d::check(cu_voxel_rows.size() >= 1, op, ": cu_voxel_rows must be [V + 1]; got [0]");
  check_shape(op, "tap_in", tap_in, {-1});
  check_shape(op, "tap_out", tap_out, {tap_in.size()});
  check_shape(op, "cu_taps", cu_taps, {kernel_size * kernel_size * kernel_size + 1});
  const gsim3d::SparseConvMap map{row_voxel.data(), voxel_rows.data(), cu_voxel_rows.data(),
                                  tap_in.data(),    tap_out.data(),    cu_taps.data(),
                                  x.shape(0),       cu_voxel_rows.size() - 1,
                                  tap_in.size(),    kernel_size,       first};
  gsim3d::cpu::check_sparse_conv_map(op, map, gsim3d::thread_pool());
  py::array_t<T> out({x.shape(0), weight.shape(0)});
  gsim3d::HeapWorkspace workspace;
  gsim3d::cpu::sparse_conv(x.data(), weight.data(), bias ? bias->data() : nullptr, map, x.shape(1), weight.shape(0),
                           out.mutable_data(), workspace, gsim3d::thread_pool());
  return out;
}

template <typename T>
py::array_t<T> patch_attention(const Array<T>& q, const Array<T>& k, const Array<T>& v, const Indices& q_rows,
                               const Indices& kv_rows, const Indices& cu_q, const Indices& cu_k, double scale) {
  const char* op = "patch_attention";
  check_shape(op, "q", q, {-1, -1, -1});
  check_shape(op, "k", k, {-1, q.shape(1), q.shape(2)});
  check_shape(op, "v", v, {k.shape(0), q.shape(1), q.shape(2)});
  check_shape(op, "q_rows", q_rows, {-1});
  check_shape(op, "kv_rows", kv_rows, {-1});
  check_shape(op, "cu_q", cu_q, {-1});
  gsim3d::check(cu_q.size() >= 1, op, ": cu_q must be [P + 1]; got [0]");
  check_shape(op, "cu_k", cu_k, {cu_q.size()});
  const gsim3d::PatchTable table{q_rows.data(),   kv_rows.data(),  cu_q.data(),   cu_k.data(),  cu_q.size() - 1,
                                 q_rows.size(), kv_rows.size(), q.shape(0), k.shape(0)};
  const gsim3d::AttentionSize size{q.shape(1), q.shape(2), scale};
  gsim3d::cpu::check_attention_size(op, size);
  gsim3d::cpu::check_patch_table(op, table);
  const auto heads = [&](const Array<T>& x) {
    return gsim3d::HeadRows<T>{x.data(), x.shape(1) * x.shape(2), x.shape(2)};
  };
  py::array_t<T> out({q.shape(0), q.shape(1), q.shape(2)}), stats({q.shape(0), q.shape(1), py::ssize_t{2}});
  gsim3d::cpu::patch_attention(heads(q), heads(k), heads(v), table, size, false, out.mutable_data(),
                               stats.mutable_data(), gsim3d::thread_pool());
  return out;
}

// One cloud of Gaussians seen by I cameras.
template <typename T>
py::dict rasterize_gaussians(const Array<T>& means, const Array<T>& quats, const Array<T>& scales,
                             const Array<T>& opacities, const Array<T>& colors, const Array<T>& viewmats,
                             const Array<T>& Ks, int64_t width, int64_t height, const Array<T>& background,
                             T near_plane) {
  const char* op = "rasterize_gaussians";
  check_shape(op, "means", means, {-1, 3});
  const int64_t n = means.shape(0);
  check_shape(op, "quats", quats, {n, 4});
  check_shape(op, "scales", scales, {n, 3});
  check_shape(op, "opacities", opacities, {n});
  check_shape(op, "colors", colors, {n, 3});
  check_shape(op, "viewmats", viewmats, {-1, 4, 4});
  const int64_t n_images = viewmats.shape(0);
  check_shape(op, "Ks", Ks, {n_images, 3, 3});
  check_shape(op, "background", background, {3});
  gsim3d::check(width > 0 && height > 0 && width <= (1 << 16) && height <= (1 << 16), op,
                ": width and height must be in [1, 65536]; got ", width, " x ", height);
  std::vector<T> backgrounds;
  for (int64_t i = 0; i < n_images; ++i)
    backgrounds.insert(backgrounds.end(), background.data(), background.data() + 3);
  const std::vector<int64_t> image_cloud(static_cast<size_t>(n_images), 0);
  const int64_t cu_rows[2] = {0, n};
  const gsim3d::RasterScene<T> scene{means.data(), quats.data(), scales.data(), opacities.data(), colors.data(),
                                     nullptr, backgrounds.data(), viewmats.data(), Ks.data(), image_cloud.data(),
                                     cu_rows, n, 1, n_images, 0, 0, width, height, near_plane,
                                     gsim3d::RasterCutoff::kExact};
  py::array_t<T> color({n_images, height, width, int64_t{3}}), alpha({n_images, height, width}),
      depth({n_images, height, width});
  gsim3d::HeapWorkspace scratch;
  const gsim3d::Workspace workspace = scratch;
  const gsim3d::RasterImages<T> images{color.mutable_data(),
                                       alpha.mutable_data(),
                                       depth.mutable_data(),
                                       nullptr,
                                       workspace.take<T>(n_images * height * width),
                                       workspace.take<int32_t>(n_images * height * width),
                                       workspace.take<int64_t>(n_images * 2)};
  gsim3d::cpu::raster_forward(scene, images, workspace, gsim3d::thread_pool());
  for (int64_t i = 0; i < n_images; ++i)
    gsim3d::check(images.unusable[2 * i] == 0, op, ": ", images.unusable[2 * i], " rows of image ", i,
                  " are not finite or out of range, the first is ", images.unusable[2 * i + 1] >> gsim3d::kFaultBits);
  py::dict result;
  result["color"] = color;
  result["alpha"] = alpha;
  result["depth"] = depth;
  return result;
}

py::dict build_info() {
  py::dict info;
  info["version"] = GSIM3D_VERSION;
  info["compiler"] = __VERSION__;
  info["cplusplus"] = static_cast<int64_t>(__cplusplus);
#if defined(__AVX2__) && defined(__FMA__)
  info["baseline"] = "x86-64-v3 (AVX2, FMA)";
#elif defined(__aarch64__)
  info["baseline"] = "aarch64";
#else
  info["baseline"] = "generic";
#endif
  return info;
}

py::tuple tuple_of(const char* const* texts, int n) {
  py::tuple values(n);
  for (int i = 0; i < n; ++i) values[i] = texts[i];
  return values;
}

py::dict constants() {
  py::dict values;
  values["raster_min_alpha"] = gsim3d::raster::kMinAlpha;
  values["raster_max_alpha"] = gsim3d::raster::kMaxAlpha;
  values["raster_min_transmittance"] = gsim3d::raster::kMinTransmittance;
  values["raster_dilation"] = gsim3d::raster::kDilation;
  values["plane_sweep_min_depth"] = gsim3d::plane_sweep_math::kMinDepth<double>;
  values["patch_attn_max_head_dim"] = gsim3d::cpu::kMaxHeadDim;
  values["curve_max_depth"] = gsim3d::kMaxDepth;
  // What gsim3d.ops says of calls and their faults.
  using gsim3d::RasterCutoff, gsim3d::RasterJacobian;
  values["raster_largest"] = gsim3d::raster::kLargest;
  values["raster_faults"] = tuple_of(gsim3d::kFaultTexts, gsim3d::kFaultBits);
  values["raster_row_faults"] = gsim3d::kRowFaults;
  values["raster_cutoffs"] = py::dict(py::arg("exact") = static_cast<int64_t>(RasterCutoff::kExact),
                                      py::arg("tile3sigma") = static_cast<int64_t>(RasterCutoff::kTile3Sigma),
                                      py::arg("smooth") = static_cast<int64_t>(RasterCutoff::kSmooth));
  values["raster_jacobians"] = py::dict(py::arg("exact") = static_cast<int64_t>(RasterJacobian::kExact),
                                        py::arg("clamped") = static_cast<int64_t>(RasterJacobian::kClamped));
  values["validate_cells"] = static_cast<int64_t>(gsim3d::kWorkspaceCells);
  values["validate_outside"] = gsim3d::kOutside;
  values["validate_fast"] = gsim3d::kFast;
  values["validate_max_fields"] = gsim3d::kMaxStateFields;
  values["validate_sums"] = tuple_of(gsim3d::kStateSumNames, gsim3d::kStateSums);
  values["validate_rows_a_part"] = py::dict(py::arg("cpu") = gsim3d::cpu::kStatePiece,
                                            py::arg("cuda") = gsim3d::cuda::kStatePiece);
  return values;
}

}  // namespace

PYBIND11_MODULE(_core, m) {
  m.doc() = "The CPU core of gsim3d on numpy arrays; needs no torch.";
  m.def("build_info", &build_info, "Version, compiler and instruction baseline of the compiled core.");
  // float64 overloads first: pybind11 takes the first that needs no conversion.
  m.def("pool_max", &pool_max<double>, py::arg("x").noconvert(), py::arg("rows"), py::arg("cu_rows"));
  m.def("pool_max", &pool_max<float>, py::arg("x"), py::arg("rows"), py::arg("cu_rows"),
        "Channelwise maximum over segments of rows: (out [M, C], argmax [M, C]).");
  m.def("pool_mean", &pool_mean<double>, py::arg("x").noconvert(), py::arg("rows"), py::arg("cu_rows"));
  m.def("pool_mean", &pool_mean<float>, py::arg("x"), py::arg("rows"), py::arg("cu_rows"),
        "Mean over segments of rows: [M, C].");
  m.attr("constants") = constants();
  m.def("sparse_conv", &sparse_conv<double>, py::arg("x").noconvert(), py::arg("weight"), py::arg("bias"),
        py::arg("row_voxel"), py::arg("voxel_rows"), py::arg("cu_voxel_rows"), py::arg("tap_in"), py::arg("tap_out"),
        py::arg("cu_taps"), py::arg("first") = false);
  m.def("sparse_conv", &sparse_conv<float>, py::arg("x"), py::arg("weight"), py::arg("bias"), py::arg("row_voxel"),
        py::arg("voxel_rows"), py::arg("cu_voxel_rows"), py::arg("tap_in"), py::arg("tap_out"), py::arg("cu_taps"),
        py::arg("first") = false,
        "Submanifold convolution [N, C_out] with weight [C_out, K, K, K, C_in]; duplicate rows: mean, or the first.");
  m.def("patch_attention", &patch_attention<double>, py::arg("q").noconvert(), py::arg("k"), py::arg("v"),
        py::arg("q_rows"), py::arg("kv_rows"), py::arg("cu_q"), py::arg("cu_k"), py::arg("scale"));
  m.def("patch_attention", &patch_attention<float>, py::arg("q"), py::arg("k"), py::arg("v"), py::arg("q_rows"),
        py::arg("kv_rows"), py::arg("cu_q"), py::arg("cu_k"), py::arg("scale"),
        "Attention [Nq, H, D] of query rows to the key rows of their patch.");
  m.def("rasterize_gaussians", &rasterize_gaussians<double>, py::arg("means").noconvert(), py::arg("quats"),
        py::arg("scales"), py::arg("opacities"), py::arg("colors"), py::arg("viewmats"), py::arg("Ks"),
        py::arg("width"), py::arg("height"), py::arg("background"), py::arg("near_plane") = 0.01);
  m.def("rasterize_gaussians", &rasterize_gaussians<float>, py::arg("means"), py::arg("quats"), py::arg("scales"),
        py::arg("opacities"), py::arg("colors"), py::arg("viewmats"), py::arg("Ks"), py::arg("width"),
        py::arg("height"), py::arg("background"), py::arg("near_plane") = 0.01f,
        "One cloud of Gaussians seen by I cameras: {color [I, H, W, 3], alpha [I, H, W], depth [I, H, W]}.");
  m.def(
      "curve_encode", &curve_encode, py::arg("grid"), py::arg("cloud"), py::arg("curve"), py::arg("depth") = 16,
      "Codes [N] of cells [N, 3] along curve 0 z, 1 z-trans, 2 hilbert, 3 hilbert-trans; cloud << 3 depth above them.");
  m.def("curve_sort", &curve_sort, py::arg("codes"), "Stable order and inverse, [R, N] each, of codes [R, N].");
  m.def("plane_sweep", &plane_sweep<double>, py::arg("features").noconvert(), py::arg("homographies"),
        py::arg("translations"), py::arg("inverse_depths"), py::arg("src_images"), py::arg("cu_src"));
  m.def("plane_sweep", &plane_sweep<float>, py::arg("features"), py::arg("homographies"), py::arg("translations"),
        py::arg("inverse_depths"), py::arg("src_images"), py::arg("cu_src"),
        "Cost volume [I, D, h, w] of features [I, C, h, w].");
}
