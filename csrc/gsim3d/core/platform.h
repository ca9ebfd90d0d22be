// The only place that knows which compiler reads the code.
#pragma once

#if defined(__CUDACC__)
#define GSIM3D_HD __host__ __device__ __forceinline__
#define GSIM3D_RESTRICT __restrict__
#else
#define GSIM3D_HD inline
#define GSIM3D_RESTRICT __restrict
#endif
