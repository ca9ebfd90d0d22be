#pragma once

#include "gsim3d/raster/raster.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {

// Gradients of the images and what the forward pass kept of them, contiguous and checked.
struct ImageGradTensors {
  Optional color, alpha, depth, features;
  Tensor transmittance, last, state;

  ImageGradTensors(const char* op, const Optional& color_, const Optional& alpha_, const Optional& depth_,
                   const Optional& features_, const Tensor& transmittance_, const Tensor& last_, const Tensor& state_,
                   int64_t n_images, int64_t height, int64_t width, int64_t n_features, const Tensor& like)
      : color(rows_of(color_)),
        alpha(rows_of(alpha_)),
        depth(rows_of(depth_)),
        features(rows_of(features_)),
        transmittance(rows_of(transmittance_)),
        last(rows_of(last_)),
        state(rows_of(state_)) {
    check_like(op, "grad_color", color, {n_images, height, width, 3}, "[I, H, W, 3]", like);
    check_like(op, "grad_alpha", alpha, {n_images, height, width}, "[I, H, W]", like);
    check_like(op, "grad_depth", depth, {n_images, height, width}, "[I, H, W]", like);
    check_like(op, "grad_features", features, {n_images, height, width, n_features}, "[I, H, W, F]", like);
    check_like(op, "transmittance", transmittance, {n_images, height, width}, "[I, H, W]", like);
    check_shape(op, "last", last, {n_images, height, width}, "[I, H, W]");
    check_dtype(op, "last", last, ScalarType::Int);
    check_dtype(op, "state", state, ScalarType::Byte);
    for (const Tensor* tensor : {&last, &state}) check_device(op, "last and state", *tensor, like);
  }

  template <typename T>
  RasterImageGrads<T> grads() const {
    return {data_or_null<T>(color),    data_or_null<T>(alpha), data_or_null<T>(depth),
            data_or_null<T>(features), data<T>(transmittance), data<int32_t>(last)};
  }
};

}  // namespace gsim3d::binding
