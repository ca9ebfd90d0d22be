// The few words a C++ test needs: expect(condition) says where it failed; the test's main returns failures().
#pragma once

#include <cmath>
#include <cstdio>

inline int& failures() {
  static int count = 0;
  return count;
}

#define EXPECT(condition)                                                      \
  do {                                                                         \
    if (!(condition)) {                                                        \
      std::printf("%s:%d: expected %s\n", __FILE__, __LINE__, #condition);     \
      ++failures();                                                            \
    }                                                                          \
  } while (0)

#define EXPECT_NEAR(value, wanted, tolerance)                                                                   \
  do {                                                                                                          \
    const double v = (value), w = (wanted);                                                                     \
    if (!(std::fabs(v - w) <= (tolerance))) {                                                                   \
      std::printf("%s:%d: expected %s = %.9g; got %.9g\n", __FILE__, __LINE__, #value, w, v);                   \
      ++failures();                                                                                             \
    }                                                                                                           \
  } while (0)
