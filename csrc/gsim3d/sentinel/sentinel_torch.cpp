#include "gsim3d/sentinel/sentinel.h"

#include <optional>

#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

std::tuple<Tensor, Tensor> watch_rows(std::vector<Tensor> fields, std::vector<double> low, std::vector<double> high,
                                      const Tensor& cu_rows_, const Tensor& cloud_scene_, const Tensor& origin_,
                                      const Tensor& activity_, const std::optional<Tensor>& previous_,
                                      double grid_size, double max_step) {
  const char* op = "watch_rows";
  const auto n_fields = static_cast<int64_t>(fields.size());
  check(n_fields >= 2 && n_fields <= kMaxWatchedFields, op, ": fields must be 2 to ", kMaxWatchedFields,
        " tensors, positions and opacities first; got ", n_fields);
  check(low.size() == fields.size() && high.size() == fields.size(), op, ": low and high must have one bound a field");
  check_shape(op, "fields[0]", fields[0], {-1, 3}, "[N, 3]");
  const int64_t n = fields[0].size(0);
  check_shape(op, "fields[1]", fields[1], {n}, "[N]");
  for (Tensor& field : fields) {
    check(field.dim() >= 1 && field.size(0) == n, op, ": fields must have N=", n, " rows; got ", shape_of(field));
    check_dtype(op, "fields", field, fields[0].scalar_type());
    check_device(op, "fields", field, fields[0]);
    field = rows_of(field);
  }
  const Tensor cu_rows = rows_of(cu_rows_), cloud_scene = rows_of(cloud_scene_), origin = rows_of(origin_);
  const Tensor activity = rows_of(activity_);
  check(cu_rows.dim() == 1 && cu_rows.size(0) >= 1, op, ": cu_rows must be [Q + 1]; got ", shape_of(cu_rows));
  const int64_t n_clouds = cu_rows.size(0) - 1;
  check_shape(op, "cloud_scene", cloud_scene, {n_clouds}, "[Q]");
  check_shape(op, "origin", origin, {-1, 3}, "[B, 3]");
  check_shape(op, "activity", activity, {n}, "[N]");
  check_dtype(op, "cu_rows", cu_rows, ScalarType::Long);
  check_dtype(op, "cloud_scene", cloud_scene, ScalarType::Long);
  check_dtype(op, "origin", origin, ScalarType::Double);
  check_dtype(op, "activity", activity, ScalarType::Byte);
  for (const Tensor* tensor : {&cu_rows, &cloud_scene, &origin, &activity})
    check_device(op, "clouds and origin", *tensor, fields[0]);
  std::optional<Tensor> previous;
  if (previous_) {
    previous = rows_of(*previous_);
    check_shape(op, "previous", *previous, {n, 3}, "[N, 3]");
    check_dtype(op, "previous", *previous, fields[0].scalar_type());
    check_device(op, "previous", *previous, fields[0]);
  }
  Tensor status = empty(fields[0], {n}, ScalarType::Int);
  Tensor record = empty(fields[0], {n_clouds, watched_columns(static_cast<int>(n_fields))}, ScalarType::Double);
  TensorWorkspace workspace(fields[0]);
  dispatch_float(op, "fields", fields[0], [&]<typename T>() {
    WatchedRows<T> rows{};
    for (int64_t f = 0; f < n_fields; ++f) {
      rows.fields[f] = data<T>(fields[f]);
      rows.width[f] = 1;
      for (int64_t d = 1; d < fields[f].dim(); ++d) rows.width[f] *= fields[f].size(d);
      rows.low[f] = static_cast<T>(low[f]), rows.high[f] = static_cast<T>(high[f]);
    }
    rows.n_fields = static_cast<int>(n_fields);
    rows.previous = previous ? data<T>(*previous) : nullptr;
    rows.activity = data<uint8_t>(activity);
    rows.cu_rows = data<int64_t>(cu_rows), rows.cloud_scene = data<int64_t>(cloud_scene);
    rows.origin = data<double>(origin);
    rows.n_rows = n, rows.n_clouds = n_clouds, rows.n_scenes = origin.size(0);
    rows.grid_size = grid_size, rows.max_step = max_step;
    auto* out = mutable_data<double>(record);
    if constexpr (kWithCuda)
      if (fields[0].is_cuda())
        return cuda::watch_rows<T>(rows, mutable_data<int32_t>(status), out, workspace, current_stream(fields[0]));
    cpu::watch_rows<T>(rows, mutable_data<int32_t>(status), out, workspace, torch_parallel());
  });
  return {status, record};
}

void kernels(auto& m) { m.impl("watch_rows", TORCH_BOX(&watch_rows)); }

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
