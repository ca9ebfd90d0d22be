#include "gsim3d/curve/curve.h"
#include "gsim3d/curve/pyramid.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

Tensor curve_encode(const Tensor& grid_, const Tensor& cloud_, std::vector<int64_t> curves, int64_t depth,
                    int64_t shift) {
  const char* op = "curve_encode";
  check_dtype(op, "grid", grid_, ScalarType::Long);
  check_dtype(op, "cloud", cloud_, ScalarType::Long);
  check_shape(op, "grid", grid_, {-1, 3}, "[N, 3]");
  check_shape(op, "cloud", cloud_, {grid_.size(0)}, "[N]");
  check_device(op, "cloud", cloud_, grid_);
  const Tensor grid = rows_of(grid_), cloud = rows_of(cloud_);
  const int64_t n = grid.size(0), n_curves = static_cast<int64_t>(curves.size());
  Tensor codes = empty(grid, {n_curves, n});
  if constexpr (kWithCuda) {
    if (grid.is_cuda()) {
      cuda::curve_encode(data<int64_t>(grid), data<int64_t>(cloud), n, curves.data(), n_curves, depth, shift,
                         mutable_data<int64_t>(codes), current_stream(grid));
      return codes;
    }
  }
  for (int64_t c = 0; c < n_curves; ++c)
    cpu::curve_encode(data<int64_t>(grid), data<int64_t>(cloud), n, curves[c], depth, shift,
                      mutable_data<int64_t>(codes) + c * n, torch_parallel());
  return codes;
}

std::tuple<Tensor, Tensor> curve_sort(const Tensor& codes_) {
  const char* op = "curve_sort";
  check_dtype(op, "codes", codes_, ScalarType::Long);
  check_shape(op, "codes", codes_, {-1, -1}, "[R, N]");
  const Tensor codes = rows_of(codes_);
  Tensor order = empty(codes, {codes.size(0), codes.size(1)});
  Tensor inverse = empty(codes, {codes.size(0), codes.size(1)});
  TensorWorkspace workspace(codes);
  if constexpr (kWithCuda) {
    if (codes.is_cuda()) {
      cuda::curve_sort(data<int64_t>(codes), codes.size(0), codes.size(1), mutable_data<int64_t>(order),
                       mutable_data<int64_t>(inverse), workspace, current_stream(codes));
      return {order, inverse};
    }
  }
  cpu::curve_sort(data<int64_t>(codes), codes.size(0), codes.size(1), mutable_data<int64_t>(order),
                  mutable_data<int64_t>(inverse), workspace, torch_parallel());
  return {order, inverse};
}

// Results of the core as tensors.
struct TensorArrays {
  Tensor like;
  std::vector<Tensor> made;

  static int64_t* append(void* raw, const int64_t* sizes, int64_t dims) {
    auto* self = static_cast<TensorArrays*>(raw);
    self->made.push_back(empty(self->like, Sizes(sizes, dims), ScalarType::Long));
    return mutable_data<int64_t>(self->made.back());
  }
};

std::vector<Tensor> build_pyramid(const Tensor& positions_, const Tensor& cu_rows_, const Tensor& cloud_scene_,
                                  const Tensor& cloud_slot_, const Tensor& origin_, double grid_size, int64_t slot_bits,
                                  std::vector<int64_t> strides, std::vector<int64_t> merge_windows,
                                  std::vector<int64_t> patch_sizes, std::vector<int64_t> curves,
                                  std::vector<int64_t> kernel_sizes, std::vector<int64_t> cu_kernels, bool release,
                                  std::vector<int64_t> capacity, bool rounded, int64_t depth) {
  const char* op = "build_pyramid";
  const int64_t n_stages = static_cast<int64_t>(patch_sizes.size());
  const auto check_length = [&](const char* name, const std::vector<int64_t>& list, int64_t length) {
    check(static_cast<int64_t>(list.size()) == length, op, ": ", name, " must have ", length, " entries for ", n_stages,
          " stages; got ", list.size());
  };
  check(n_stages >= 1, op, ": patch_sizes must have one entry for each stage; got none");
  check_length("strides", strides, n_stages - 1);
  check_length("merge_windows", merge_windows, n_stages - 1);
  check_length("curves", curves, 4 * n_stages);
  check_length("cu_kernels", cu_kernels, n_stages + 1);
  check(cu_kernels.front() == 0 && cu_kernels.back() == static_cast<int64_t>(kernel_sizes.size()) &&
            std::is_sorted(cu_kernels.begin(), cu_kernels.end()),
        op, ": cu_kernels must ascend from 0 to len(kernel_sizes)=", kernel_sizes.size());
  if (!capacity.empty()) check_length("capacity", capacity, capacity_of_pairs(n_stages, cu_kernels.back()));

  check(!rounded || capacity.empty(), op, ": rounded must be false where a capacity is given");
  check_shape(op, "positions", positions_, {-1, 3}, "[N, 3]");
  check_dtype(op, "cu_rows", cu_rows_, ScalarType::Long);
  check_dtype(op, "cloud_scene", cloud_scene_, ScalarType::Long);
  check_dtype(op, "cloud_slot", cloud_slot_, ScalarType::Long);
  check_dtype(op, "origin", origin_, ScalarType::Double);
  check(cu_rows_.dim() == 1 && cu_rows_.size(0) >= 1, op, ": cu_rows must be [Q + 1]; got ", shape_of(cu_rows_));
  const int64_t n_clouds = cu_rows_.size(0) - 1;
  check_shape(op, "cloud_scene", cloud_scene_, {n_clouds}, "[Q]");
  check_shape(op, "cloud_slot", cloud_slot_, {n_clouds}, "[Q]");
  check_shape(op, "origin", origin_, {-1, 3}, "[B, 3]");
  check_device(op, "cu_rows", cu_rows_, positions_);
  check_device(op, "cloud_scene", cloud_scene_, positions_);
  check_device(op, "cloud_slot", cloud_slot_, positions_);
  check_device(op, "origin", origin_, positions_);

  const Tensor positions = rows_of(positions_), cu_rows = rows_of(cu_rows_), cloud_scene = rows_of(cloud_scene_);
  const Tensor cloud_slot = rows_of(cloud_slot_), origin = rows_of(origin_);
  const PyramidSpec spec{grid_size,     slot_bits,           n_stages,          strides.data(), merge_windows.data(),
                         patch_sizes.data(), curves.data(), kernel_sizes.data(), cu_kernels.data(), release,
                         capacity.empty() ? nullptr : capacity.data(), rounded, depth};
  TensorArrays arrays{cu_rows, {}};
  TensorWorkspace workspace(cu_rows);
  dispatch_float(op, "positions", positions, [&]<typename T>() {
    const PyramidClouds<T> clouds{data<T>(positions),       data<int64_t>(cu_rows), data<int64_t>(cloud_scene),
                                  data<int64_t>(cloud_slot), data<double>(origin),   positions.size(0),
                                  n_clouds,                 origin.size(0)};
    if constexpr (kWithCuda)
      if (positions.is_cuda())
        return cuda::build_pyramid(clouds, spec, {&TensorArrays::append, &arrays}, workspace,
                                   current_stream(positions));
    cpu::build_pyramid(clouds, spec, {&TensorArrays::append, &arrays}, workspace, torch_parallel());
  });
  return std::move(arrays.made);
}

void kernels(auto& m) {
  m.impl("curve_encode", TORCH_BOX(&curve_encode));
  m.impl("curve_sort", TORCH_BOX(&curve_sort));
  m.impl("build_pyramid", TORCH_BOX(&build_pyramid));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
