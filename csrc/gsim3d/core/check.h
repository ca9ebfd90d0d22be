// Argument checks of the public C++ functions. One style of message: "op: argument must be X; got Y".
#pragma once

#include <sstream>
#include <stdexcept>
#include <string>

namespace gsim3d {

// An argument breaks the contract of an op. Python sees it as ValueError.
class ArgumentError : public std::invalid_argument {
 public:
  using std::invalid_argument::invalid_argument;
};

namespace detail {
template <typename... Parts>
[[noreturn]] void fail(const Parts&... parts) {
  std::ostringstream message;
  (message << ... << parts);
  throw ArgumentError(message.str());
}
}  // namespace detail

// check(rows >= 0, "pool_max: rows must be in [0, N) with N=", n, "; got ", rows);
template <typename... Parts>
inline void check(bool ok, const Parts&... parts) {
  if (!ok) [[unlikely]] detail::fail(parts...);
}

}  // namespace gsim3d
