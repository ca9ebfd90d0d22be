#include "gsim3d/plane_sweep/plane_sweep.h"

#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

// Owns contiguous copies of the geometry tensors for as long as the core reads them.
struct Geometry {
  const char* op;
  Tensor homographies, translations, inverse_depths, src_images, cu_src;

  Geometry(const char* op_, const Tensor& features, const Tensor& homographies_, const Tensor& translations_,
           const Tensor& inverse_depths_, const Tensor& src_images_, const Tensor& cu_src_)
      : op(op_),
        homographies(rows_of(homographies_)),
        translations(rows_of(translations_)),
        inverse_depths(rows_of(inverse_depths_)),
        src_images(rows_of(src_images_)),
        cu_src(rows_of(cu_src_)) {
    check_shape(op, "features", features, {-1, -1, -1, -1}, "[I, C, h, w]");
    check_dtype(op, "src_images", src_images, ScalarType::Long);
    check_dtype(op, "cu_src", cu_src, ScalarType::Long);
    check_shape(op, "src_images", src_images, {-1}, "[P]");
    check_shape(op, "homographies", homographies, {src_images.size(0), 3, 3}, "[P, 3, 3]");
    check_shape(op, "translations", translations, {src_images.size(0), 3}, "[P, 3]");
    check_shape(op, "inverse_depths", inverse_depths, {features.size(0), -1}, "[I, D]");
    check_shape(op, "cu_src", cu_src, {features.size(0) + 1}, "[I + 1]");
    const ScalarType type = features.scalar_type();
    check_dtype(op, "homographies", homographies, type);
    check_dtype(op, "translations", translations, type);
    check_dtype(op, "inverse_depths", inverse_depths, type);
    check_device(op, "homographies", homographies, features);
    check_device(op, "translations", translations, features);
    check_device(op, "inverse_depths", inverse_depths, features);
    check_device(op, "src_images", src_images, features);
    check_device(op, "cu_src", cu_src, features);
  }

  // On a GPU the values stay where they are: kernels skip what is out of range.
  template <typename T>
  PlaneSweep<T> sweep(const Tensor& features) const {
    const PlaneSweep<T> sweep{data<T>(homographies),
                        data<T>(translations),
                        data<T>(inverse_depths),
                        data<int64_t>(src_images),
                        data<int64_t>(cu_src),
                        features.size(0),
                        src_images.size(0),
                        inverse_depths.size(1),
                        features.size(1),
                        features.size(2),
                        features.size(3)};
    if (!features.is_cuda()) cpu::check_plane_sweep(op, sweep);
    return sweep;
  }
};

Tensor plane_sweep(const Tensor& features_, const Tensor& homographies, const Tensor& translations,
                   const Tensor& inverse_depths, const Tensor& src_images, const Tensor& cu_src) {
  const char* op = "plane_sweep";
  const Tensor features = rows_of(features_);
  const Geometry geometry(op, features, homographies, translations, inverse_depths, src_images, cu_src);
  Tensor cost = empty(features, {features.size(0), inverse_depths.size(1), features.size(2), features.size(3)});
  TensorWorkspace workspace(features);
  dispatch_float(op, "features", features, [&]<typename T>() {
    const PlaneSweep<T> sweep = geometry.sweep<T>(features);
    if constexpr (kWithCuda)
      if (features.is_cuda())
        return cuda::plane_sweep(data<T>(features), sweep, mutable_data<T>(cost), workspace, current_stream(features));
    cpu::plane_sweep(data<T>(features), sweep, mutable_data<T>(cost), workspace,
                     torch_parallel());
  });
  return cost;
}

Tensor plane_sweep_backward(const Tensor& grad_, const Tensor& features_, const Tensor& homographies,
                            const Tensor& translations, const Tensor& inverse_depths, const Tensor& src_images,
                            const Tensor& cu_src) {
  const char* op = "plane_sweep_backward";
  const Tensor features = rows_of(features_), grad = rows_of(grad_);
  const Geometry geometry(op, features, homographies, translations, inverse_depths, src_images, cu_src);
  check_shape(op, "grad", grad, {features.size(0), inverse_depths.size(1), features.size(2), features.size(3)},
              "[I, D, h, w]");
  check_dtype(op, "grad", grad, features.scalar_type());
  check_device(op, "grad", grad, features);
  Tensor grad_features = empty(features, {features.size(0), features.size(1), features.size(2), features.size(3)});
  TensorWorkspace workspace(features);
  dispatch_float(op, "features", features, [&]<typename T>() {
    const PlaneSweep<T> sweep = geometry.sweep<T>(features);
    if constexpr (kWithCuda)
      if (features.is_cuda())
        return cuda::plane_sweep_vjp(data<T>(grad), data<T>(features), sweep, mutable_data<T>(grad_features), workspace,
                                     current_stream(features));
    cpu::plane_sweep_vjp(data<T>(grad), data<T>(features), sweep, mutable_data<T>(grad_features), workspace,
                         torch_parallel());
  });
  return grad_features;
}

void kernels(auto& m) {
  m.impl("plane_sweep", TORCH_BOX(&plane_sweep));
  m.impl("plane_sweep_backward", TORCH_BOX(&plane_sweep_backward));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
