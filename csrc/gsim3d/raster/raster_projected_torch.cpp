#include <optional>
#include <tuple>

#include "gsim3d/raster/raster.h"
#include "gsim3d/torch/raster_image_grads.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

// The arguments that forward and backward share, contiguous and checked against each other.
struct ProjectedTensors {
  const char* op;
  Tensor means2d, conics, depths, opacities, color, features, background, image_cloud, cu_rows;
  int64_t width, height, cutoff;

  ProjectedTensors contiguous() const {
    ProjectedTensors copy = *this;
    for (Tensor* tensor : {&copy.means2d, &copy.conics, &copy.depths, &copy.opacities, &copy.color, &copy.features,
                           &copy.background, &copy.image_cloud, &copy.cu_rows})
      *tensor = rows_of(*tensor);
    return copy;
  }

  int64_t n_rows() const { return means2d.size(0); }
  int64_t n_images() const { return background.size(0); }

  void check_all() const {
    check_shape(op, "means2d", means2d, {-1, 2}, "[P, 2]");
    const int64_t n = n_rows();
    check_like(op, "conics", conics, {n, 3}, "[P, 3]", means2d);
    check_like(op, "depths", depths, {n}, "[P]", means2d);
    check_like(op, "opacities", opacities, {n}, "[P]", means2d);
    check_like(op, "colors", color, {n, 3}, "[P, 3]", means2d);
    check_like(op, "features", features, {n, -1}, "[P, F]", means2d);
    check_like(op, "background", background, {-1, 3}, "[I, 3]", means2d);
    check_shape(op, "image_cloud", image_cloud, {n_images()}, "[I]");
    check_shape(op, "cu_rows", cu_rows, {n_images() + 1}, "[I + 1]");
    check_dtype(op, "cu_rows", cu_rows, ScalarType::Long);
    check_dtype(op, "image_cloud", image_cloud, ScalarType::Long);
    check(n_images() > 0 || n == 0, op, ": there must be an image; got none for ", n, " rows");
    check(width >= 0 && height >= 0, op, ": width and height must be positive; got ", width, " and ", height);
    check_device(op, "cu_rows", cu_rows, means2d);
    check_device(op, "image_cloud", image_cloud, means2d);
  }

  template <typename T>
  RasterScene<T> scene() const {
    return {.opacities = data<T>(opacities),
            .color = data<T>(color),
            .features = data<T>(features),
            .background = data<T>(background),
            .image_cloud = data<int64_t>(image_cloud),
            .cu_rows = data<int64_t>(cu_rows),
            .n_rows = n_rows(),
            .n_clouds = n_images(),
            .n_images = n_images(),
            .sh_terms = kProjected,
            .n_features = features.size(1),
            .width = width,
            .height = height,
            .near_plane = T(1),
            .cutoff = static_cast<RasterCutoff>(cutoff),
            .means2d = data<T>(means2d),
            .conics = data<T>(conics),
            .depths = data<T>(depths)};
  }
};

using Images = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// `absolute` takes no part: its gradient does.
Images rasterize_projected(const Tensor& means2d, const Tensor& conics, const Tensor& depths, const Tensor& opacities,
                           const Tensor& color, const Tensor& features, const Tensor& background,
                           const std::optional<Tensor>&, const Tensor& image_cloud, const Tensor& cu_rows,
                           int64_t width, int64_t height, int64_t cutoff, int64_t max_pairs, int64_t max_entries,
                           int64_t max_slots) {
  const ProjectedTensors given{"rasterize_projected", means2d, conics, depths, opacities, color, features, background,
                               image_cloud, cu_rows, width, height, cutoff};
  given.check_all();
  const ProjectedTensors in = given.contiguous();
  const int64_t n = in.n_images();
  const auto image = [&] { return empty(in.means2d, {n, height, width}); };
  Tensor out_color = empty(in.means2d, {n, height, width, 3}), alpha = image(), depth = image();
  Tensor out_features = empty(in.means2d, {n, height, width, in.features.size(1)}), transmittance = image();
  Tensor last = empty(in.means2d, {n, height, width}, ScalarType::Int);
  Tensor state;
  TensorWorkspace workspace(in.means2d);
  dispatch_float(given.op, "means2d", in.means2d, [&]<typename T>() {
    const RasterImages<T> images{mutable_data<T>(out_color),     mutable_data<T>(alpha),
                                 mutable_data<T>(depth),         mutable_data<T>(out_features),
                                 mutable_data<T>(transmittance), mutable_data<int32_t>(last),
                                 nullptr};
    if constexpr (kWithCuda)
      if (in.means2d.is_cuda()) {
        const RasterScene<T> scene = in.scene<T>();
        const cuda::RasterLimits limits{max_pairs, max_entries, max_slots};
        state = empty(in.means2d, {cuda::raster_state_bytes(scene, limits)}, ScalarType::Byte);
        return cuda::raster_forward<T>(scene, images, limits, state.data_ptr(), workspace, current_stream(in.means2d));
      }
    state = empty(in.means2d, {0}, ScalarType::Byte);
    cpu::raster_forward<T>(in.scene<T>(), images, workspace, torch_parallel());
  });
  return {out_color, alpha, depth, out_features, transmittance, last, state};
}

// Gradients of means2d, conics, depths, opacities, color, features with the columns of `absolute`, and background.
using ProjectedGrads = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

ProjectedGrads rasterize_projected_backward(
    const Optional& grad_color, const Optional& grad_alpha, const Optional& grad_depth, const Optional& grad_features,
    const Tensor& transmittance, const Tensor& last, const Tensor& state, const Tensor& means2d,
    const Tensor& conics, const Tensor& depths, const Tensor& opacities, const Tensor& color, const Tensor& features,
    const Tensor& background, const Tensor& image_cloud, const Tensor& cu_rows, int64_t width, int64_t height,
    int64_t cutoff, int64_t max_pairs, int64_t max_entries, int64_t max_slots, bool background_grad, bool absolute) {
  const char* op = "rasterize_projected_backward";
  const ProjectedTensors given{op, means2d, conics, depths, opacities, color, features, background, image_cloud,
                               cu_rows, width, height, cutoff};
  given.check_all();
  const ProjectedTensors in = given.contiguous();
  const ImageGradTensors image{op, grad_color, grad_alpha, grad_depth, grad_features, transmittance, last, state,
                               in.n_images(), height, width, in.features.size(1), in.means2d};

  const auto like = [](const Tensor& tensor) { return empty(tensor, tensor.sizes()); };
  Tensor grad_means2d = like(in.means2d), grad_conics = like(in.conics), grad_depths = like(in.depths);
  Tensor grad_opacities = like(in.opacities), grad_in_color = like(in.color);
  Tensor grad_background = empty(in.background, {background_grad ? in.n_images() : 0, 3});
  Tensor grad_in_features = empty(in.features, {in.n_rows(), in.features.size(1) + (absolute ? 2 : 0)});
  TensorWorkspace workspace(in.means2d);
  dispatch_float(op, "means2d", in.means2d, [&]<typename T>() {
    const RasterImageGrads<T> image_grads = image.grads<T>();
    RasterSceneGrads<T> grads{};
    grads.opacities = mutable_data<T>(grad_opacities), grads.color = mutable_data<T>(grad_in_color);
    grads.features = mutable_data<T>(grad_in_features);
    grads.background = background_grad ? mutable_data<T>(grad_background) : nullptr;
    grads.means2d = mutable_data<T>(grad_means2d), grads.conics = mutable_data<T>(grad_conics);
    grads.depths = mutable_data<T>(grad_depths), grads.absolute = absolute;
    if constexpr (kWithCuda)
      if (in.means2d.is_cuda()) {
        const RasterScene<T> scene = in.scene<T>();
        const cuda::RasterLimits limits{max_pairs, max_entries, max_slots};
        check_shape(op, "state", image.state, {cuda::raster_state_bytes(scene, limits)}, "[bytes]");
        return cuda::raster_backward<T>(scene, image_grads, grads, limits, image.state.data_ptr(), workspace,
                                        current_stream(in.means2d));
      }
    cpu::raster_backward<T>(in.scene<T>(), image_grads, grads, workspace, torch_parallel());
  });
  return {grad_means2d, grad_conics, grad_depths, grad_opacities, grad_in_color, grad_in_features, grad_background};
}

void kernels(auto& m) {
  m.impl("rasterize_projected", TORCH_BOX(&rasterize_projected));
  m.impl("rasterize_projected_backward", TORCH_BOX(&rasterize_projected_backward));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
