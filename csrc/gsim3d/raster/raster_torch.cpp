#include <optional>
#include <tuple>
#include <vector>

#include "gsim3d/raster/raster.h"
#include "gsim3d/raster/raster_math.h"
#include "gsim3d/torch/raster_image_grads.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

// The arguments that forward and backward share, contiguous and checked against each other.
struct SceneTensors {
  const char* op;
  Tensor means, quats, scales, opacities, color, features, background, viewmats, Ks, image_cloud, cu_rows;
  int64_t width, height;
  double near_plane;
  int64_t cutoff, jacobian;
  std::optional<Tensor> active;

  SceneTensors contiguous() const {
    SceneTensors copy = *this;
    for (Tensor* tensor : {&copy.means, &copy.quats, &copy.scales, &copy.opacities, &copy.color, &copy.features,
                           &copy.background, &copy.viewmats, &copy.Ks, &copy.image_cloud, &copy.cu_rows})
      *tensor = rows_of(*tensor);
    if (active) copy.active = rows_of(*active);
    return copy;
  }

  int64_t n_rows() const { return means.size(0); }
  int64_t n_images() const { return image_cloud.size(0); }

  void check_all() const {
    check_shape(op, "means", means, {-1, 3}, "[N, 3]");
    const int64_t n = n_rows();
    check_shape(op, "quats", quats, {n, 4}, "[N, 4]");
    check_shape(op, "scales", scales, {n, 3}, "[N, 3]");
    check_shape(op, "opacities", opacities, {n}, "[N]");
    if (color.dim() == 3)
      check_shape(op, "sh", color, {n, -1, 3}, "[N, K, 3]");
    else
      check_shape(op, "colors", color, {n, 3}, "[N, 3]");
    check_shape(op, "features", features, {n, -1}, "[N, F]");
    check_shape(op, "image_cloud", image_cloud, {-1}, "[I]");
    const int64_t images = n_images();
    check_shape(op, "background", background, {images, 3}, "[I, 3]");
    check_shape(op, "viewmats", viewmats, {images, 4, 4}, "[I, 4, 4]");
    check_shape(op, "Ks", Ks, {images, 3, 3}, "[I, 3, 3]");
    check_dtype(op, "image_cloud", image_cloud, ScalarType::Long);
    check_dtype(op, "cu_rows", cu_rows, ScalarType::Long);
    check(cu_rows.dim() == 1 && cu_rows.size(0) >= 1, op, ": cu_rows must be [Q + 1]; got ", shape_of(cu_rows));
    check(color.dim() != 3 || color.size(1) >= 1, op,
          ": sh must have 1, 4, 9 or 16 coefficients (degree 0 to 3); got 0");
    const auto type = means.scalar_type();
    check_dtype(op, "quats", quats, type);
    check_dtype(op, "scales", scales, type);
    check_dtype(op, "opacities", opacities, type);
    check_dtype(op, color.dim() == 3 ? "sh" : "colors", color, type);
    check_dtype(op, "features", features, type);
    check_dtype(op, "background", background, type);
    check_dtype(op, "viewmats", viewmats, type);
    check_dtype(op, "Ks", Ks, type);
    for (const auto& [name, tensor] : std::initializer_list<std::pair<const char*, const Tensor&>>{
             {"quats", quats}, {"scales", scales}, {"opacities", opacities}, {"color", color}, {"features", features},
             {"background", background}, {"viewmats", viewmats}, {"Ks", Ks}, {"image_cloud", image_cloud},
             {"cu_rows", cu_rows}})
      check_device(op, name, tensor, means);
    if (!active) return;
    using raster::kTile;
    check_shape(op, "active", *active, {images, (height + kTile - 1) / kTile, (width + kTile - 1) / kTile},
                "[I, tiles by column, tiles by row]");
    check_dtype(op, "active", *active, ScalarType::Bool);
    check_device(op, "active", *active, means);
  }

  template <typename T>
  RasterScene<T> scene() const {
    return {.means = data<T>(means),
            .quats = data<T>(quats),
            .scales = data<T>(scales),
            .opacities = data<T>(opacities),
            .color = data<T>(color),
            .features = data<T>(features),
            .background = data<T>(background),
            .viewmats = data<T>(viewmats),
            .Ks = data<T>(Ks),
            .image_cloud = data<int64_t>(image_cloud),
            .cu_rows = data<int64_t>(cu_rows),
            .n_rows = n_rows(),
            .n_clouds = cu_rows.size(0) - 1,
            .n_images = n_images(),
            .sh_terms = color.dim() == 3 ? color.size(1) : 0,
            .n_features = features.size(1),
            .width = width,
            .height = height,
            .near_plane = static_cast<T>(near_plane),
            .cutoff = static_cast<RasterCutoff>(cutoff),
            .jacobian = static_cast<RasterJacobian>(jacobian),
            .active = active ? data<bool>(*active) : nullptr};
  }
};

using Images = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

Images rasterize_gaussians(const Tensor& means, const Tensor& quats, const Tensor& scales, const Tensor& opacities,
                           const Tensor& color, const Tensor& features, const Tensor& background,
                           const Tensor& viewmats, const Tensor& Ks, const Tensor& image_cloud, const Tensor& cu_rows,
                           int64_t width, int64_t height, double near_plane, int64_t cutoff, int64_t jacobian,
                           int64_t max_pairs, int64_t max_entries, int64_t max_slots, bool watch,
                           const std::optional<Tensor>& active) {
  const SceneTensors given{"rasterize_gaussians", means, quats, scales, opacities, color, features, background,
                           viewmats, Ks, image_cloud, cu_rows, width, height, near_plane, cutoff, jacobian, active};
  given.check_all();
  const SceneTensors in = given.contiguous();
  const int64_t n = in.n_images();
  check(width >= 0 && height >= 0, given.op, ": width and height must be positive; got ", width, " and ", height);
  Tensor out_color = empty(in.means, {n, height, width, 3}), alpha = empty(in.means, {n, height, width});
  Tensor depth = empty(in.means, {n, height, width});
  Tensor out_features = empty(in.means, {n, height, width, in.features.size(1)});
  Tensor transmittance = empty(in.means, {n, height, width});
  Tensor last = empty(in.means, {n, height, width}, ScalarType::Int);
  Tensor state = empty(in.means, {0}, ScalarType::Byte);
  Tensor unusable = empty(in.means, {watch ? n : 0, 2}, ScalarType::Long);
  TensorWorkspace workspace(in.means);
  dispatch_float(given.op, "means", in.means, [&]<typename T>() {
    const RasterImages<T> images{mutable_data<T>(out_color),     mutable_data<T>(alpha),
                                 mutable_data<T>(depth),         mutable_data<T>(out_features),
                                 mutable_data<T>(transmittance), mutable_data<int32_t>(last),
                                 watch ? mutable_data<int64_t>(unusable) : nullptr};
    if constexpr (kWithCuda)
      if (in.means.is_cuda()) {
        const RasterScene<T> scene = in.scene<T>();
        const cuda::RasterLimits limits{max_pairs, max_entries, max_slots};
        state = empty(in.means, {cuda::raster_state_bytes(scene, limits)}, ScalarType::Byte);
        const CurrentStream stream = current_stream(in.means);
        cuda::raster_forward<T>(scene, images, limits, state.data_ptr(), workspace, stream);
        if (watch) cuda::raster_watch<T>(scene, images.unusable, stream);
        return;
      }
    cpu::raster_forward<T>(in.scene<T>(), images, workspace, torch_parallel());
  });
  return {out_color, alpha, depth, out_features, transmittance, last, state, unusable};
}

using SceneGrads = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

SceneGrads rasterize_gaussians_backward(const Tensor& grad_color, const Tensor& grad_alpha, const Tensor& grad_depth,
                                        const Tensor& grad_features, const Tensor& transmittance, const Tensor& last,
                                        const Tensor& state,
                                        const Tensor& means, const Tensor& quats, const Tensor& scales,
                                        const Tensor& opacities, const Tensor& color, const Tensor& features,
                                        const Tensor& background, const Tensor& viewmats, const Tensor& Ks,
                                        const Tensor& image_cloud, const Tensor& cu_rows, int64_t width, int64_t height,
                                        double near_plane, int64_t cutoff, int64_t jacobian, int64_t max_pairs,
                                        int64_t max_entries, int64_t max_slots, bool viewmats_grad,
                                        const std::optional<Tensor>& active) {
  const char* op = "rasterize_gaussians_backward";
  const SceneTensors given{op, means, quats, scales, opacities, color, features, background,
                           viewmats, Ks, image_cloud, cu_rows, width, height, near_plane, cutoff, jacobian, active};
  given.check_all();
  const SceneTensors in = given.contiguous();
  const int64_t n = in.n_images();
  const ImageGradTensors image{op, grad_color, grad_alpha, grad_depth, grad_features, transmittance, last, state,
                               n, height, width, in.features.size(1), in.means};

  const auto like = [](const Tensor& tensor) { return empty(tensor, tensor.sizes()); };
  Tensor grad_means = like(in.means), grad_quats = like(in.quats), grad_scales = like(in.scales);
  Tensor grad_opacities = like(in.opacities), grad_in_color = like(in.color), grad_in_features = like(in.features);
  Tensor grad_background = like(in.background);
  Tensor grad_viewmats = empty(in.viewmats, {viewmats_grad ? n : 0, 4, 4});
  TensorWorkspace workspace(in.means);
  dispatch_float(op, "means", in.means, [&]<typename T>() {
    const RasterImageGrads<T> image_grads = image.grads<T>();
    const RasterSceneGrads<T> grads{mutable_data<T>(grad_means),      mutable_data<T>(grad_quats),
                                    mutable_data<T>(grad_scales),     mutable_data<T>(grad_opacities),
                                    mutable_data<T>(grad_in_color),   mutable_data<T>(grad_in_features),
                                    mutable_data<T>(grad_background), viewmats_grad ? mutable_data<T>(grad_viewmats)
                                                                                    : nullptr};
    if constexpr (kWithCuda)
      if (in.means.is_cuda()) {
        const RasterScene<T> scene = in.scene<T>();
        const cuda::RasterLimits limits{max_pairs, max_entries, max_slots};
        check_shape(op, "state", image.state, {cuda::raster_state_bytes(scene, limits)}, "[bytes]");
        return cuda::raster_backward<T>(scene, image_grads, grads, limits, image.state.data_ptr(), workspace,
                                        current_stream(in.means));
      }
    cpu::raster_backward<T>(in.scene<T>(), image_grads, grads, workspace, torch_parallel());
  });
  return {grad_means,    grad_quats,       grad_scales,     grad_opacities,
          grad_in_color, grad_in_features, grad_background, grad_viewmats};
}

// A direction of the differentiable arguments of a scene, contiguous and checked against them.
struct TangentTensors {
  std::vector<Tensor> tensors;

  TangentTensors(const SceneTensors& in, std::initializer_list<const Tensor*> given) {
    const Tensor* values[] = {&in.means, &in.quats, &in.scales, &in.opacities, &in.color, &in.features, &in.background,
                              &in.viewmats};
    for (const Tensor* tangent : given) {
      const Tensor& t = tensors.emplace_back(rows_of(*tangent));
      check(t.sizes().equals(values[tensors.size() - 1]->sizes()), in.op,
            ": tangents must have the shapes of their tensors");
      check_dtype(in.op, "tangents", t, in.means.scalar_type());
      check_device(in.op, "tangents", t, in.means);
    }
  }

  template <typename T>
  RasterTangents<T> tangents() const {
    const auto& t = tensors;
    return {data<T>(t[0]), data<T>(t[1]), data<T>(t[2]), data<T>(t[3]),
            data<T>(t[4]), data<T>(t[5]), data<T>(t[6]), data<T>(t[7])};
  }
};

using TangentImages = std::tuple<Tensor, Tensor, Tensor, Tensor>;

TangentImages rasterize_gaussians_tangent(
    const Tensor& t_means, const Tensor& t_quats, const Tensor& t_scales, const Tensor& t_opacities,
    const Tensor& t_color, const Tensor& t_features, const Tensor& t_background, const Tensor& t_viewmats,
    const Tensor& state, const Tensor& means, const Tensor& quats, const Tensor& scales, const Tensor& opacities,
    const Tensor& color, const Tensor& features, const Tensor& background, const Tensor& viewmats, const Tensor& Ks,
    const Tensor& image_cloud, const Tensor& cu_rows, int64_t width, int64_t height, double near_plane, int64_t cutoff,
    int64_t jacobian, int64_t max_pairs, int64_t max_entries, int64_t max_slots, const std::optional<Tensor>& active) {
  const char* op = "rasterize_gaussians_tangent";
  const SceneTensors given{op, means, quats, scales, opacities, color, features, background,
                           viewmats, Ks, image_cloud, cu_rows, width, height, near_plane, cutoff, jacobian, active};
  given.check_all();
  const SceneTensors in = given.contiguous();
  const TangentTensors along(in, {&t_means, &t_quats, &t_scales, &t_opacities, &t_color, &t_features, &t_background,
                                  &t_viewmats});
  const Tensor kept = rows_of(state);
  check_dtype(op, "state", kept, ScalarType::Byte);
  check_device(op, "state", kept, in.means);
  const int64_t n = in.n_images();
  Tensor out_color = empty(in.means, {n, height, width, 3}), alpha = empty(in.means, {n, height, width});
  Tensor depth = empty(in.means, {n, height, width});
  Tensor out_features = empty(in.means, {n, height, width, in.features.size(1)});
  TensorWorkspace workspace(in.means);
  dispatch_float(op, "means", in.means, [&]<typename T>() {
    const RasterImages<T> images{mutable_data<T>(out_color), mutable_data<T>(alpha), mutable_data<T>(depth),
                                 mutable_data<T>(out_features), nullptr, nullptr, nullptr};
    if constexpr (kWithCuda)
      if (in.means.is_cuda()) {
        const RasterScene<T> scene = in.scene<T>();
        const cuda::RasterLimits limits{max_pairs, max_entries, max_slots};
        check_shape(op, "state", kept, {cuda::raster_state_bytes(scene, limits)}, "[bytes]");
        return cuda::raster_tangent<T>(scene, along.tangents<T>(), images, limits, kept.data_ptr(), workspace,
                                       current_stream(in.means));
      }
    cpu::raster_tangent<T>(in.scene<T>(), along.tangents<T>(), {}, images, nullptr, workspace, torch_parallel());
  });
  return {out_color, alpha, depth, out_features};
}

// Of the images and of every gradient, along the tangents.
using Tangents = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                            Tensor>;

Tangents rasterize_gaussians_backward_tangent(
    const Tensor& means, const Tensor& quats, const Tensor& scales, const Tensor& opacities, const Tensor& color,
    const Tensor& features, const Tensor& background, const Tensor& viewmats, const Tensor& Ks,
    const Tensor& image_cloud, const Tensor& cu_rows, const Tensor& t_means, const Tensor& t_quats,
    const Tensor& t_scales, const Tensor& t_opacities, const Tensor& t_color, const Tensor& t_features,
    const Tensor& t_background, const Tensor& t_viewmats, const Tensor& grad_color, const Tensor& grad_alpha,
    const Tensor& grad_depth, const Tensor& grad_features, int64_t width, int64_t height, double near_plane,
    int64_t cutoff, int64_t jacobian, const std::optional<Tensor>& active) {
  const char* op = "rasterize_gaussians_backward_tangent";
  const SceneTensors given{op, means, quats, scales, opacities, color, features, background,
                           viewmats, Ks, image_cloud, cu_rows, width, height, near_plane, cutoff, jacobian, active};
  const Tensor* image_grads_[] = {&grad_color, &grad_alpha, &grad_depth, &grad_features};
  given.check_all();
  const SceneTensors in = given.contiguous();
  check(!in.means.is_cuda(), op, ": the rasterizer has no derivative of this order on CUDA; use tensors on the CPU");
  const TangentTensors along(in, {&t_means, &t_quats, &t_scales, &t_opacities, &t_color, &t_features, &t_background,
                                  &t_viewmats});
  std::vector<Tensor> image_grads;
  const int64_t n = in.n_images(), n_features = in.features.size(1);
  std::vector<Tensor> out{empty(in.means, {n, height, width, 3}), empty(in.means, {n, height, width}),
                          empty(in.means, {n, height, width}), empty(in.means, {n, height, width, n_features})};
  for (size_t i = 0; i < 4; ++i) {
    image_grads.push_back(rows_of(*image_grads_[i]));
    check(image_grads[i].sizes().equals(out[i].sizes()), op, ": image_grads must have the shapes of the images");
    check_dtype(op, "image_grads", image_grads[i], in.means.scalar_type());
    check_device(op, "image_grads", image_grads[i], in.means);
  }
  for (const Tensor& tangent : along.tensors) out.push_back(empty(tangent, tangent.sizes()));
  TensorWorkspace workspace(in.means);
  dispatch_float(op, "means", in.means, [&]<typename T>() {
    const RasterImages<T> images{mutable_data<T>(out[0]), mutable_data<T>(out[1]), mutable_data<T>(out[2]),
                                 mutable_data<T>(out[3]), nullptr, nullptr, nullptr};
    const RasterImageGrads<T> of_images{data<T>(image_grads[0]), data<T>(image_grads[1]), data<T>(image_grads[2]),
                                        data<T>(image_grads[3]), nullptr,                 nullptr};
    const RasterSceneGrads<T> grads{mutable_data<T>(out[4]), mutable_data<T>(out[5]),  mutable_data<T>(out[6]),
                                    mutable_data<T>(out[7]), mutable_data<T>(out[8]),  mutable_data<T>(out[9]),
                                    mutable_data<T>(out[10]), mutable_data<T>(out[11])};
    cpu::raster_tangent<T>(in.scene<T>(), along.tangents<T>(), of_images, images, &grads, workspace, torch_parallel());
  });
  return {out[0], out[1], out[2], out[3], out[4], out[5], out[6], out[7], out[8], out[9], out[10], out[11]};
}

void kernels(auto& m) {
  m.impl("rasterize_gaussians", TORCH_BOX(&rasterize_gaussians));
  m.impl("rasterize_gaussians_backward", TORCH_BOX(&rasterize_gaussians_backward));
  m.impl("rasterize_gaussians_tangent", TORCH_BOX(&rasterize_gaussians_tangent));
  m.impl("rasterize_gaussians_backward_tangent", TORCH_BOX(&rasterize_gaussians_backward_tangent));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
