// gsim3d._core: the CPU core on numpy arrays, for callers without torch.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <string>
#include <tuple>

#include "gsim3d/core/check.h"
#include "gsim3d/core/parallel.h"
#include "gsim3d/core/version.h"
#include "gsim3d/pool/pool.h"

namespace py = pybind11;

namespace {

template <typename T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
using Indices = Array<int64_t>;

gsim3d::Segments segments_of(const char* op, const Indices& rows, const Indices& cu_rows, int64_t n_rows) {
  gsim3d::check(rows.ndim() == 1 && cu_rows.ndim() == 1 && cu_rows.size() >= 1, op,
                ": rows must be [R] and cu_rows [M + 1]");
  const gsim3d::Segments segments{rows.data(), cu_rows.data(), cu_rows.size() - 1, rows.size(), n_rows};
  gsim3d::cpu::check_segments(op, segments);
  return segments;
}

template <typename T>
std::tuple<py::array_t<T>, py::array_t<int64_t>> pool_max(const Array<T>& x, const Indices& rows,
                                                          const Indices& cu_rows) {
  gsim3d::check(x.ndim() == 2, "pool_max: x must be [N, C]; got ", x.ndim(), " dimensions");
  const auto segments = segments_of("pool_max", rows, cu_rows, x.shape(0));
  py::array_t<T> out({segments.n_segments, x.shape(1)});
  py::array_t<int64_t> argmax({segments.n_segments, x.shape(1)});
  gsim3d::cpu::pool_max(x.data(), segments, x.shape(1), out.mutable_data(), argmax.mutable_data(),
                        gsim3d::thread_pool());
  return {out, argmax};
}

template <typename T>
py::array_t<T> pool_mean(const Array<T>& x, const Indices& rows, const Indices& cu_rows) {
  gsim3d::check(x.ndim() == 2, "pool_mean: x must be [N, C]; got ", x.ndim(), " dimensions");
  const auto segments = segments_of("pool_mean", rows, cu_rows, x.shape(0));
  py::array_t<T> out({segments.n_segments, x.shape(1)});
  gsim3d::cpu::pool_mean(x.data(), segments, x.shape(1), out.mutable_data(), gsim3d::thread_pool());
  return out;
}

py::dict build_info() {
  py::dict info;
  info["version"] = GSIM3D_VERSION;
  info["compiler"] = __VERSION__;
  info["cplusplus"] = static_cast<int64_t>(__cplusplus);
#if defined(__AVX2__) && defined(__FMA__)
  info["baseline"] = "x86-64-v3 (AVX2, FMA)";
#elif defined(__aarch64__)
  info["baseline"] = "aarch64";
#else
  info["baseline"] = "generic";
#endif
  return info;
}

}  // namespace

PYBIND11_MODULE(_core, m) {
  m.doc() = "The CPU core of gsim3d on numpy arrays; needs no torch.";
  m.def("build_info", &build_info, "Version, compiler and instruction baseline of the compiled core.");
  // float64 overloads first: pybind11 takes the first that needs no conversion.
  m.def("pool_max", &pool_max<double>, py::arg("x").noconvert(), py::arg("rows"), py::arg("cu_rows"));
  m.def("pool_max", &pool_max<float>, py::arg("x"), py::arg("rows"), py::arg("cu_rows"),
        "Channelwise maximum over segments of rows: (out [M, C], argmax [M, C]).");
  m.def("pool_mean", &pool_mean<double>, py::arg("x").noconvert(), py::arg("rows"), py::arg("cu_rows"));
  m.def("pool_mean", &pool_mean<float>, py::arg("x"), py::arg("rows"), py::arg("cu_rows"),
        "Mean over segments of rows: [M, C].");
}
