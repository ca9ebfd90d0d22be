#include <initializer_list>
#include <optional>
#include <tuple>
#include <utility>

#include "gsim3d/projection/projection.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {
namespace {

// The arguments that forward and backward share, contiguous and checked against each other.
struct GaussianTensors {
  const char* op;
  Tensor means;
  Optional quats, scales, covars, opacities;
  Tensor viewmats, Ks;
  Optional distortion, limits;
  Tensor image_cloud, cu_rows, cu_pairs;
  int64_t n_pairs, width, height;
  double near_plane, far_plane, radius_clip, dilation;
  int64_t lens;
  bool clamped, antialiased;

  GaussianTensors contiguous() const {
    GaussianTensors copy = *this;
    for (Tensor* tensor : {&copy.means, &copy.viewmats, &copy.Ks, &copy.image_cloud, &copy.cu_rows, &copy.cu_pairs})
      *tensor = rows_of(*tensor);
    for (Optional* tensor : {&copy.quats, &copy.scales, &copy.covars, &copy.opacities, &copy.distortion, &copy.limits})
      *tensor = rows_of(*tensor);
    return copy;
  }

  int64_t n_rows() const { return means.size(0); }
  int64_t n_images() const { return viewmats.size(0); }

  void check_all() const {
    check_shape(op, "means", means, {-1, 3}, "[N, 3]");
    check_shape(op, "viewmats", viewmats, {-1, 4, 4}, "[I, 4, 4]");
    const int64_t n = n_rows(), images = n_images();
    check(covars.has_value() != (quats.has_value() && scales.has_value()), op, ": give quats and scales, or covars");
    check_like(op, "quats", quats, {n, 4}, "[N, 4]", means);
    check_like(op, "scales", scales, {n, 3}, "[N, 3]", means);
    check_like(op, "covars", covars, {n, 3, 3}, "[N, 3, 3]", means);
    check_like(op, "opacities", opacities, {n}, "[N]", means);
    check_like(op, "viewmats", viewmats, {images, 4, 4}, "[I, 4, 4]", means);
    check_like(op, "Ks", Ks, {images, 3, 3}, "[I, 3, 3]", means);
    check_like(op, "distortion", distortion, {images, kDistortion}, "[I, 8]", means);
    check_like(op, "limits", limits, {images}, "[I]", means);
    check_shape(op, "image_cloud", image_cloud, {images}, "[I]");
    check_shape(op, "cu_pairs", cu_pairs, {images + 1}, "[I + 1]");
    check(cu_rows.dim() == 1 && cu_rows.size(0) >= 1, op, ": cu_rows must be [Q + 1]; got ", shape_of(cu_rows));
    check(n_pairs >= 0, op, ": n_pairs must not be negative; got ", n_pairs);
    for (const auto& [name, tensor] : std::initializer_list<std::pair<const char*, const Tensor&>>{
             {"image_cloud", image_cloud}, {"cu_rows", cu_rows}, {"cu_pairs", cu_pairs}}) {
      check_dtype(op, name, tensor, ScalarType::Long);
      check_device(op, name, tensor, means);
    }
  }

  template <typename T>
  ProjectionScene<T> scene() const {
    return {.means = data<T>(means),
            .quats = data_or_null<T>(quats),
            .scales = data_or_null<T>(scales),
            .covars = data_or_null<T>(covars),
            .opacities = data_or_null<T>(opacities),
            .viewmats = data<T>(viewmats),
            .Ks = data<T>(Ks),
            .distortion = data_or_null<T>(distortion),
            .limits = data_or_null<T>(limits),
            .image_cloud = data<int64_t>(image_cloud),
            .cu_rows = data<int64_t>(cu_rows),
            .cu_pairs = data<int64_t>(cu_pairs),
            .n_rows = n_rows(),
            .n_clouds = cu_rows.size(0) - 1,
            .n_images = n_images(),
            .n_pairs = n_pairs,
            .width = width,
            .height = height,
            .near_plane = static_cast<T>(near_plane),
            .far_plane = static_cast<T>(far_plane),
            .radius_clip = static_cast<T>(radius_clip),
            .dilation = static_cast<T>(dilation),
            .lens = static_cast<Lens>(lens),
            .clamped = clamped,
            .antialiased = antialiased};
  }
};

using Pairs = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;

Pairs project_gaussians(const Tensor& means, const Optional& quats, const Optional& scales, const Optional& covars,
                        const Optional& opacities, const Tensor& viewmats, const Tensor& Ks,
                        const Optional& distortion, const Optional& limits, const Tensor& image_cloud,
                        const Tensor& cu_rows, const Tensor& cu_pairs, int64_t n_pairs, int64_t width, int64_t height,
                        double near_plane, double far_plane, double radius_clip, double dilation, int64_t lens,
                        bool clamped, bool antialiased) {
  const GaussianTensors given{"project_gaussians", means,    quats,  scales,     covars,    opacities,
                              viewmats,            Ks,       distortion, limits, image_cloud, cu_rows,
                              cu_pairs,            n_pairs,  width,  height,     near_plane, far_plane,
                              radius_clip,         dilation, lens,   clamped,    antialiased};
  given.check_all();
  const GaussianTensors in = given.contiguous();
  Tensor means2d = empty(in.means, {n_pairs, 2}), conics = empty(in.means, {n_pairs, 3});
  Tensor depths = empty(in.means, {n_pairs}), radii = empty(in.means, {n_pairs, 2}, ScalarType::Int);
  Tensor compensations = empty(in.means, {n_pairs});
  dispatch_float(given.op, "means", in.means, [&]<typename T>() {
    const ProjectionPairs<T> pairs{mutable_data<T>(means2d), mutable_data<T>(conics), mutable_data<T>(depths),
                                   mutable_data<int32_t>(radii), mutable_data<T>(compensations)};
    if constexpr (kWithCuda)
      if (in.means.is_cuda())
        return cuda::project_forward<T>(in.scene<T>(), pairs, current_stream(in.means));
    cpu::project_forward<T>(in.scene<T>(), pairs, torch_parallel());
  });
  return {means2d, conics, depths, radii, compensations};
}

// Gradients of means, quats, scales, covars, viewmats, Ks and distortion; empty where there is none.
using GaussianGrads = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

GaussianGrads project_gaussians_backward(
    const Optional& grad_means2d_, const Optional& grad_conics_, const Optional& grad_depths_,
    const Optional& grad_compensations_, const Tensor& radii_, const Tensor& means, const Optional& quats,
    const Optional& scales, const Optional& covars, const Tensor& viewmats, const Tensor& Ks,
    const Optional& distortion, const Tensor& image_cloud, const Tensor& cu_rows, const Tensor& cu_pairs,
    int64_t n_pairs, int64_t width, int64_t height, double dilation, int64_t lens, bool clamped, bool viewmats_grad,
    bool lens_grad) {
  const char* op = "project_gaussians_backward";
  const GaussianTensors given{op,       means,    quats,  scales, covars, std::nullopt, viewmats, Ks,
                              distortion, std::nullopt, image_cloud, cu_rows, cu_pairs, n_pairs, width, height,
                              0.0,      1.0,      0.0,    dilation, lens, clamped,      false};
  given.check_all();
  const GaussianTensors in = given.contiguous();
  const Optional grad_means2d = rows_of(grad_means2d_), grad_conics = rows_of(grad_conics_);
  const Optional grad_depths = rows_of(grad_depths_), grad_compensations = rows_of(grad_compensations_);
  const Tensor radii = rows_of(radii_);
  check_shape(op, "radii", radii, {n_pairs, 2}, "[P, 2]");
  check_dtype(op, "radii", radii, ScalarType::Int);
  check_device(op, "radii", radii, in.means);
  check_like(op, "grad_means2d", grad_means2d, {n_pairs, 2}, "[P, 2]", in.means);
  check_like(op, "grad_conics", grad_conics, {n_pairs, 3}, "[P, 3]", in.means);
  check_like(op, "grad_depths", grad_depths, {n_pairs}, "[P]", in.means);
  check_like(op, "grad_compensations", grad_compensations, {n_pairs}, "[P]", in.means);

  const int64_t n = in.n_rows(), images = in.n_images(), by_axes = in.quats ? n : 0;
  Tensor grad_means = empty(in.means, {n, 3}), grad_quats = empty(in.means, {by_axes, 4});
  Tensor grad_scales = empty(in.means, {by_axes, 3}), grad_covars = empty(in.means, {in.covars ? n : 0, 3, 3});
  Tensor grad_viewmats = empty(in.means, {viewmats_grad ? images : 0, 4, 4});
  Tensor grad_Ks = empty(in.means, {lens_grad ? images : 0, 3, 3});
  Tensor grad_distortion = empty(in.means, {lens_grad && in.distortion ? images : 0, kDistortion});
  TensorWorkspace workspace(in.means);
  dispatch_float(op, "means", in.means, [&]<typename T>() {
    const ProjectionPairGrads<T> pair_grads{
        data_or_null<T>(grad_means2d), data_or_null<T>(grad_conics), data_or_null<T>(grad_depths), data<int32_t>(radii),
        data_or_null<T>(grad_compensations)};
    const auto wanted = [](bool is, Tensor& tensor) { return is ? mutable_data<T>(tensor) : nullptr; };
    const ProjectionSceneGrads<T> grads{mutable_data<T>(grad_means),
                                        wanted(in.quats.has_value(), grad_quats),
                                        wanted(in.quats.has_value(), grad_scales),
                                        wanted(in.covars.has_value(), grad_covars),
                                        wanted(viewmats_grad, grad_viewmats),
                                        wanted(lens_grad, grad_Ks),
                                        wanted(lens_grad && in.distortion, grad_distortion)};
    if constexpr (kWithCuda)
      if (in.means.is_cuda())
        return cuda::project_backward<T>(in.scene<T>(), pair_grads, grads, workspace, current_stream(in.means));
    cpu::project_backward<T>(in.scene<T>(), pair_grads, grads, workspace, torch_parallel());
  });
  return {grad_means, grad_quats, grad_scales, grad_covars, grad_viewmats, grad_Ks, grad_distortion};
}

ShSizes check_sh(const char* op, const Tensor& directions, const Tensor& sh) {
  check_shape(op, "directions", directions, {-1, -1, -1, 3}, "[B, V, N, 3]");
  check_shape(op, "sh", sh, {directions.size(0), directions.size(2), -1, -1}, "[B, N, K, D]");
  check_dtype(op, "sh", sh, directions.scalar_type());
  check_device(op, "sh", sh, directions);
  return {directions.size(0), directions.size(1), directions.size(2), sh.size(2), sh.size(3)};
}

Tensor sh_to_color(const Tensor& directions_, const Tensor& sh_) {
  const char* op = "sh_to_color";
  const ShSizes sizes = check_sh(op, directions_, sh_);
  const Tensor directions = rows_of(directions_), sh = rows_of(sh_);
  Tensor color = empty(directions, {sizes.n_batches, sizes.n_views, sizes.n_rows, sizes.n_channels});
  dispatch_float(op, "directions", directions, [&]<typename T>() {
    if constexpr (kWithCuda)
      if (directions.is_cuda())
        return cuda::sh_forward<T>(data<T>(directions), data<T>(sh), mutable_data<T>(color), sizes,
                                   current_stream(directions));
    cpu::sh_forward<T>(data<T>(directions), data<T>(sh), mutable_data<T>(color), sizes, torch_parallel());
  });
  return color;
}

std::tuple<Tensor, Tensor> sh_to_color_backward(const Tensor& grad_, const Tensor& directions_, const Tensor& sh_) {
  const char* op = "sh_to_color_backward";
  const ShSizes sizes = check_sh(op, directions_, sh_);
  const Tensor grad = rows_of(grad_), directions = rows_of(directions_), sh = rows_of(sh_);
  check_shape(op, "grad", grad, {sizes.n_batches, sizes.n_views, sizes.n_rows, sizes.n_channels}, "[B, V, N, D]");
  check_dtype(op, "grad", grad, directions.scalar_type());
  check_device(op, "grad", grad, directions);
  Tensor grad_directions = empty(directions, directions.sizes()), grad_sh = empty(sh, sh.sizes());
  dispatch_float(op, "directions", directions, [&]<typename T>() {
    if constexpr (kWithCuda)
      if (directions.is_cuda())
        return cuda::sh_backward<T>(data<T>(grad), data<T>(directions), data<T>(sh), mutable_data<T>(grad_directions),
                                    mutable_data<T>(grad_sh), sizes, current_stream(directions));
    cpu::sh_backward<T>(data<T>(grad), data<T>(directions), data<T>(sh), mutable_data<T>(grad_directions),
                        mutable_data<T>(grad_sh), sizes, torch_parallel());
  });
  return {grad_directions, grad_sh};
}

void kernels(auto& m) {
  m.impl("project_gaussians", TORCH_BOX(&project_gaussians));
  m.impl("project_gaussians_backward", TORCH_BOX(&project_gaussians_backward));
  m.impl("sh_to_color", TORCH_BOX(&sh_to_color));
  m.impl("sh_to_color_backward", TORCH_BOX(&sh_to_color_backward));
}

}  // namespace

GSIM3D_REGISTER(kernels)

}  // namespace gsim3d::binding
