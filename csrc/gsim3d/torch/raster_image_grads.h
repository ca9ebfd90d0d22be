#pragma once

#include "gsim3d/raster/raster.h"
#include "gsim3d/torch/torch_utils.h"

namespace gsim3d::binding {

// Gradients of the images and what the forward pass kept of them, contiguous and checked.
struct ImageGradTensors {
  Tensor color, alpha, depth, features, transmittance, last, state;

  ImageGradTensors(const char* op, const Tensor& color_, const Tensor& alpha_, const Tensor& depth_,
                   const Tensor& features_, const Tensor& transmittance_, const Tensor& last_, const Tensor& state_,
                   int64_t n_images, int64_t height, int64_t width, int64_t n_features, const Tensor& like)
      : color(rows_of(color_)),
        alpha(rows_of(alpha_)),
        depth(rows_of(depth_)),
        features(rows_of(features_)),
        transmittance(rows_of(transmittance_)),
        last(rows_of(last_)),
        state(rows_of(state_)) {
    check_shape(op, "grad_color", color, {n_images, height, width, 3}, "[I, H, W, 3]");
    check_shape(op, "grad_alpha", alpha, {n_images, height, width}, "[I, H, W]");
    check_shape(op, "grad_depth", depth, {n_images, height, width}, "[I, H, W]");
    check_shape(op, "grad_features", features, {n_images, height, width, n_features}, "[I, H, W, F]");
    check_shape(op, "transmittance", transmittance, {n_images, height, width}, "[I, H, W]");
    check_shape(op, "last", last, {n_images, height, width}, "[I, H, W]");
    for (const Tensor* tensor : {&color, &alpha, &depth, &features, &transmittance})
      check_dtype(op, "image gradients", *tensor, like.scalar_type());
    check_dtype(op, "last", last, ScalarType::Int);
    check_dtype(op, "state", state, ScalarType::Byte);
    for (const Tensor* tensor : {&color, &alpha, &depth, &features, &transmittance, &last, &state})
      check_device(op, "image gradients", *tensor, like);
  }

  template <typename T>
  RasterImageGrads<T> grads() const {
    return {data<T>(color),    data<T>(alpha),         data<T>(depth),
            data<T>(features), data<T>(transmittance), data<int32_t>(last)};
  }
};

}  // namespace gsim3d::binding
