#include "gsim3d/background/background.h"

#include <string>
#include <type_traits>
#include <vector>

#include "gsim3d/core/half.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

// Contiguous int64 on the device of `like`.
Tensor integers(const char* op, const char* name, const Tensor& x, const Tensor& like) {
  check_dtype(op, name, x, ScalarType::Long);
  check_device(op, name, x, like);
  return rows_of(x);
}

std::vector<Tensor> row_scenes(const Tensor& cloud_scene, const Tensor& cu_input, std::vector<Tensor> rows,
                               std::vector<Tensor> cu_rows) {
  const char* op = "row_scenes";
  const auto n_stages = static_cast<int64_t>(rows.size());
  check(n_stages <= kMaxChain, op, ": stages must be at most ", kMaxChain, "; got ", n_stages);
  check(rows.size() == cu_rows.size(), op, ": cu_rows must have one entry a stage; got ", cu_rows.size(), " for ",
        n_stages);
  const Tensor scenes = integers(op, "cloud_scene", cloud_scene, cloud_scene);
  const Tensor offsets = integers(op, "cu_input", cu_input, cloud_scene);
  check_shape(op, "cloud_scene", scenes, {-1}, "[Q]");
  check_shape(op, "cu_input", offsets, {scenes.size(0) + 1}, "[Q + 1]");
  RowChain chain{data<int64_t>(scenes), data<int64_t>(offsets), scenes.size(0)};
  chain.n_stages = n_stages;
  std::vector<Tensor> found;
  for (int64_t s = 0; s < n_stages; ++s) {
    const std::string stage = "stages[" + std::to_string(s) + "]", listed = stage + ".rows", cu = stage + ".cu_rows";
    rows[s] = integers(op, listed.c_str(), rows[s], cloud_scene);
    cu_rows[s] = integers(op, cu.c_str(), cu_rows[s], cloud_scene);
    check_shape(op, listed.c_str(), rows[s], {-1}, "[R]");
    check(cu_rows[s].dim() == 1 && cu_rows[s].size(0) >= 1, op, ": ", cu, " must be [M + 1]; got ",
          shape_of(cu_rows[s]));
    chain.rows[s] = data<int64_t>(rows[s]), chain.cu_rows[s] = data<int64_t>(cu_rows[s]);
    chain.n_listed[s] = rows[s].size(0), chain.n_rows[s] = cu_rows[s].size(0) - 1;
    found.push_back(empty(cloud_scene, {chain.n_rows[s]}));
    chain.scene[s] = mutable_data<int64_t>(found.back());
  }
  if constexpr (kWithCuda)
    if (cloud_scene.is_cuda()) {
      cuda::row_scenes(chain, current_stream(cloud_scene));
      return found;
    }
  cpu::row_scenes(chain, torch_parallel());
  return found;
}

Tensor find_cells(const Tensor& cells_, const Tensor& scene_, const Tensor& grid_) {
  const char* op = "find_cells";
  const Tensor cells = integers(op, "cells", cells_, cells_), scene = integers(op, "scene", scene_, cells_);
  const Tensor grid = integers(op, "grid", grid_, cells_);
  check(cells.dim() == 1 && cells.size(0) >= 1, op, ": cells must be [D], D at least 1; got ", shape_of(cells));
  check_shape(op, "scene", scene, {-1}, "[N]");
  const int64_t n = scene.size(0);
  check_shape(op, "grid", grid, {n, 3}, "[N, 3]");
  Tensor places = empty(cells, {n});
  auto* to = mutable_data<int64_t>(places);
  if constexpr (kWithCuda)
    if (cells.is_cuda()) {
      cuda::find_cells(data<int64_t>(cells), cells.size(0), data<int64_t>(scene), data<int64_t>(grid), n, to,
                       current_stream(cells));
      return places;
    }
  cpu::find_cells(data<int64_t>(cells), cells.size(0), data<int64_t>(scene), data<int64_t>(grid), n, to,
                  torch_parallel());
  return places;
}

Tensor add_cells(const Tensor& x_, const Tensor& field_, const Tensor& places_) {
  const char* op = "add_cells";
  check_shape(op, "x", x_, {-1, -1}, "[N, C]");
  check_shape(op, "field", field_, {-1, x_.size(1)}, "[D, C]");
  check_shape(op, "places", places_, {x_.size(0)}, "[N]");
  check_dtype(op, "field", field_, x_.scalar_type());
  check_device(op, "field", field_, x_);
  const Tensor x = rows_of(x_), field = rows_of(field_), places = integers(op, "places", places_, x_);
  const int64_t n = x.size(0), n_cells = field.size(0), channels = x.size(1);
  Tensor out = empty(x, {n, channels});
  const auto run = [&]<typename T>() {
    if constexpr (kWithCuda)
      if (x.is_cuda())
        return cuda::add_cells(data<T>(x), data<T>(field), data<int64_t>(places), n, n_cells, channels,
                               mutable_data<T>(out), current_stream(x));
    if constexpr (std::is_floating_point_v<T>)
      cpu::add_cells(data<T>(x), data<T>(field), data<int64_t>(places), n, n_cells, channels, mutable_data<T>(out),
                     torch_parallel());
  };
  if constexpr (kWithCuda) {
    if (x.is_cuda() && x.scalar_type() == ScalarType::Half) return run.template operator()<Float16>(), out;
    if (x.is_cuda() && x.scalar_type() == ScalarType::BFloat16) return run.template operator()<BFloat16>(), out;
  }
  dispatch_float(op, "x", x, run);
  return out;
}

std::tuple<Tensor, Tensor, Tensor, Tensor> overlapping_patches(const Tensor& first_, const Tensor& kv_rows_,
                                                               const Tensor& cu_k_, const Tensor& codes_,
                                                               const Tensor& order_, const Tensor& cu_clouds_,
                                                               int64_t patch_size) {
  const char* op = "overlapping_patches";
  const Tensor first = integers(op, "first", first_, first_), kv_rows = integers(op, "kv_rows", kv_rows_, first_);
  const Tensor cu_k = integers(op, "cu_k", cu_k_, first_), codes = integers(op, "codes", codes_, first_);
  const Tensor order = integers(op, "order", order_, first_);
  const Tensor cu_clouds = integers(op, "cu_clouds", cu_clouds_, first_);
  check_shape(op, "first", first, {-1, -1}, "[R, P]");
  const int64_t n_curves = first.size(0);
  check_shape(op, "kv_rows", kv_rows, {n_curves, -1}, "[R, M]");
  check_shape(op, "cu_k", cu_k, {first.size(1) + 1}, "[P + 1]");
  check_shape(op, "codes", codes, {n_curves, -1}, "[R, N]");
  check_shape(op, "order", order, {n_curves, codes.size(1)}, "[R, N]");
  check(cu_clouds.dim() == 1 && cu_clouds.size(0) >= 1, op, ": cu_clouds must be [C + 1]; got ", shape_of(cu_clouds));
  check(patch_size >= 1, op, ": patch_size must be at least 1; got ", patch_size);
  const Overlap overlap{data<int64_t>(first), data<int64_t>(kv_rows), data<int64_t>(cu_k), n_curves,
                        first.size(1),        kv_rows.size(1),        patch_size,          data<int64_t>(codes),
                        data<int64_t>(order), data<int64_t>(cu_clouds), codes.size(1),     cu_clouds.size(0) - 1};
  const int64_t n_parts = overlap.n_parts();
  Tensor q_rows = empty(first, {n_curves, overlap.n_rows}), keys = empty(first, {n_curves, overlap.n_listed()});
  Tensor cu_q = empty(first, {n_curves, n_parts + 1}), cu_keys = empty(first, {n_curves, n_parts + 1});
  const QueryParts parts{mutable_data<int64_t>(q_rows), mutable_data<int64_t>(keys), mutable_data<int64_t>(cu_q),
                    mutable_data<int64_t>(cu_keys)};
  TensorWorkspace workspace(first);
  if constexpr (kWithCuda)
    if (first.is_cuda()) {
      cuda::overlapping_patches(overlap, parts, workspace, current_stream(first));
      return {q_rows, keys, cu_q, cu_keys};
    }
  cpu::overlapping_patches(overlap, parts, workspace, torch_parallel());
  return {q_rows, keys, cu_q, cu_keys};
}

void kernels(auto& m) {
  m.impl("row_scenes", TORCH_BOX(&row_scenes));
  m.impl("find_cells", TORCH_BOX(&find_cells));
  m.impl("add_cells", TORCH_BOX(&add_cells));
  m.impl("overlapping_patches", TORCH_BOX(&overlapping_patches));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
