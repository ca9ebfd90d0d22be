#include "gsim3d/validate_state/validate_state.h"

#include <algorithm>
#include <string>
#include <vector>

#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

constexpr int64_t state_piece(bool is_cuda) { return is_cuda ? cuda::kStatePiece : cpu::kStatePiece; }

// Records of looks, one after another.
Tensor join_records(std::vector<Tensor> parts, std::vector<Tensor> cu_rows, std::vector<int64_t> n_rows) {
  const char* op = "join_records";
  check(!parts.empty() && parts.size() == cu_rows.size() && parts.size() == n_rows.size(), op,
        ": parts must be of one look at least, cu_rows and n_rows of as many; got ", parts.size(), ", ",
        cu_rows.size(), " and ", n_rows.size());
  std::vector<StatePartials> looks;
  int64_t total = 0;
  for (size_t i = 0; i < parts.size(); ++i) {
    parts[i] = rows_of(parts[i]), cu_rows[i] = rows_of(cu_rows[i]);
    check_dtype(op, "parts", parts[i], ScalarType::Double);
    check_dtype(op, "cu_rows", cu_rows[i], ScalarType::Long);
    check_device(op, "parts", parts[i], parts[0]);
    check_device(op, "cu_rows", cu_rows[i], parts[0]);
    check(cu_rows[i].dim() == 1 && cu_rows[i].size(0) >= 1, op, ": cu_rows must be [Q + 1]; got ",
          shape_of(cu_rows[i]));
    check(n_rows[i] >= 0, op, ": n_rows must not be negative; got ", n_rows[i]);
    const int64_t n_clouds = cu_rows[i].size(0) - 1;
    const int64_t n_parts = record_parts(n_rows[i], n_clouds, state_piece(parts[0].is_cuda()));
    const int64_t columns = parts[i].dim() == 2 ? parts[i].size(1) : 0;
    const int64_t n_fields = (columns - kStateSums) / 2 - 2;
    check(n_fields >= 2 && n_fields <= kMaxStateFields && columns == record_columns(static_cast<int>(n_fields)) &&
              parts[i].size(0) == n_parts,
          op, ": parts must be as validate_state left them, ", n_parts, " of ", n_rows[i], " rows; got ",
          shape_of(parts[i]));
    looks.push_back({data<double>(parts[i]), data<int64_t>(cu_rows[i]), nullptr, n_rows[i], n_clouds,
                     static_cast<int>(n_fields)});
    total += n_clouds * columns;
  }
  Tensor records = empty(parts[0], {total}, ScalarType::Double);
  double* record = mutable_data<double>(records);
  for (StatePartials& look : looks) {
    look.record = record;
    record += look.n_clouds * record_columns(look.n_fields);
  }
  if constexpr (kWithCuda)
    if (parts[0].is_cuda()) {
      cuda::join_records(looks.data(), static_cast<int64_t>(looks.size()), current_stream(parts[0]));
      return records;
    }
  for (const StatePartials& look : looks) cpu::join_records(look);
  return records;
}

// The sanitized activity and fields, or nothing where `neutral` holds no numbers.
std::tuple<Tensor, Tensor, std::vector<Tensor>> validate_state(
    std::vector<Tensor> fields, std::vector<double> low, std::vector<double> high, const Tensor& cu_rows_,
    const Tensor& cloud_scene_, const Tensor& origin_, const Tensor& activity_, std::vector<Tensor> previous,
    double grid_size, double max_step, std::vector<double> neutral, bool joined) {
  const char* op = "validate_state";
  const auto n_fields = static_cast<int64_t>(fields.size());
  check(n_fields >= 2 && n_fields <= kMaxStateFields, op, ": fields must be 2 to ", kMaxStateFields,
        " tensors, positions and opacities first; got ", n_fields);
  check(low.size() == fields.size() && high.size() == fields.size(), op, ": low and high must have one bound a field");
  check(previous.empty() || previous.size() == fields.size(), op, ": previous must have one tensor a field; got ",
        previous.size(), " for ", n_fields);
  check(neutral.empty() || neutral.size() == fields.size(), op, ": neutral must have one number a field; got ",
        neutral.size(), " for ", n_fields);
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
  for (size_t f = 0; f < previous.size(); ++f) {
    const std::string name = "previous[" + std::to_string(f) + "]";
    const auto own = previous[f].sizes(), wanted = fields[f].sizes();
    check(std::equal(own.begin(), own.end(), wanted.begin(), wanted.end()), op, ": ", name,
          " must have the shape of its field, ", shape_of(fields[f]), "; got ", shape_of(previous[f]));
    check_dtype(op, name.c_str(), previous[f], fields[0].scalar_type());
    check_device(op, name.c_str(), previous[f], fields[0]);
    previous[f] = rows_of(previous[f]);
  }
  Tensor status = empty(fields[0], {n}, ScalarType::Int);
  const int64_t columns = record_columns(static_cast<int>(n_fields));
  const int64_t n_parts = record_parts(n, n_clouds, state_piece(fields[0].is_cuda()));
  Tensor parts = empty(fields[0], {n_parts, columns}, ScalarType::Double);
  std::vector<Tensor> made;
  if (!neutral.empty()) {
    made.push_back(empty(activity, {n}));
    for (const Tensor& field : fields) made.push_back(empty(field, field.sizes()));
  }
  dispatch_float(op, "fields", fields[0], [&]<typename T>() {
    StateRows<T> rows{};
    SanitizedRows<T> sanitized{};
    for (int64_t f = 0; f < n_fields; ++f) {
      rows.fields[f] = data<T>(fields[f]);
      rows.width[f] = 1;
      for (int64_t d = 1; d < fields[f].dim(); ++d) rows.width[f] *= fields[f].size(d);
      rows.low[f] = static_cast<T>(low[f]), rows.high[f] = static_cast<T>(high[f]);
      rows.previous[f] = previous.empty() ? nullptr : data<T>(previous[f]);
      if (made.empty()) continue;
      sanitized.fields[f] = mutable_data<T>(made[f + 1]);
      sanitized.neutral[f] = static_cast<T>(neutral[f]);
    }
    sanitized.activity = made.empty() ? nullptr : mutable_data<uint8_t>(made[0]);
    rows.n_fields = static_cast<int>(n_fields);
    rows.activity = data<uint8_t>(activity);
    rows.cu_rows = data<int64_t>(cu_rows), rows.cloud_scene = data<int64_t>(cloud_scene);
    rows.origin = data<double>(origin);
    rows.n_rows = n, rows.n_clouds = n_clouds, rows.n_scenes = origin.size(0);
    rows.grid_size = grid_size, rows.max_step = max_step;
    auto* seen = mutable_data<int32_t>(status);
    auto* sums = mutable_data<double>(parts);
    if constexpr (kWithCuda)
      if (fields[0].is_cuda()) return cuda::validate_state<T>(rows, sanitized, seen, sums, current_stream(fields[0]));
    cpu::validate_state<T>(rows, sanitized, seen, sums, torch_parallel());
  });
  if (!joined) return {status, parts, made};
  Tensor record = empty(fields[0], {n_clouds, columns}, ScalarType::Double);
  const StatePartials look{data<double>(parts), data<int64_t>(cu_rows), mutable_data<double>(record), n, n_clouds,
                           static_cast<int>(n_fields)};
  if constexpr (kWithCuda)
    if (record.is_cuda()) {
      cuda::join_records(&look, 1, current_stream(record));
      return {status, record, made};
    }
  cpu::join_records(look);
  return {status, record, made};
}

void kernels(auto& m) {
  m.impl("validate_state", TORCH_BOX(&validate_state));
  m.impl("join_records", TORCH_BOX(&join_records));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
