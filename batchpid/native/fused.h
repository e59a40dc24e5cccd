// Passes of the commonest laws. Written by setup.py: batchpid/native/fused.py.

#pragma once

#include "program.h"

namespace batchpid {
namespace detail {

constexpr std::int32_t CODE_0[] = {5, 1, 28, 0, 1, 2, 29, 5, 3, 4, 6};
template <class T>
BATCHPID_INLINE void run_0(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step;
    T *y0 = y[0] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = result_of<Code(28), T>(v0, v1, v2);
      T const v6 = result_of<Code(29), T>(v5, v3, v4);
      y0[i] = v6;
    }
  }
}
BATCHPID_CLONES static void single_0(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_0(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_0(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_0(x, y, n, chunk);
}


constexpr std::int32_t CODE_1[] = {6, 1, 28, 0, 1, 2, 0, 6, 3, 6, 29, 7, 4, 5, 8};
template <class T>
BATCHPID_INLINE void run_1(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step;
    T *y0 = y[0] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = result_of<Code(28), T>(v0, v1, v2);
      T const v7 = result_of<Code(0), T>(v6, v3, v6);
      T const v8 = result_of<Code(29), T>(v7, v4, v5);
      y0[i] = v8;
    }
  }
}
BATCHPID_CLONES static void single_1(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_1(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_1(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_1(x, y, n, chunk);
}


constexpr std::int32_t CODE_2[] = {7, 2, 1, 0, 1, 0, 26, 2, 7, 3, 26, 4, 7, 3, 29, 9, 5, 6, 8, 10};
template <class T>
BATCHPID_INLINE void run_2(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = result_of<Code(1), T>(v0, v1, v0);
      T const v8 = result_of<Code(26), T>(v2, v7, v3);
      T const v9 = result_of<Code(26), T>(v4, v7, v3);
      T const v10 = result_of<Code(29), T>(v9, v5, v6);
      y0[i] = v8;
      y1[i] = v10;
    }
  }
}
BATCHPID_CLONES static void single_2(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_2(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_2(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_2(x, y, n, chunk);
}


constexpr std::int32_t CODE_3[] = {8, 2, 1, 0, 1, 0, 26, 2, 8, 3, 26, 4, 8, 3, 0, 10, 5, 10, 29, 11, 6, 7, 9, 12};
template <class T>
BATCHPID_INLINE void run_3(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = result_of<Code(1), T>(v0, v1, v0);
      T const v9 = result_of<Code(26), T>(v2, v8, v3);
      T const v10 = result_of<Code(26), T>(v4, v8, v3);
      T const v11 = result_of<Code(0), T>(v10, v5, v10);
      T const v12 = result_of<Code(29), T>(v11, v6, v7);
      y0[i] = v9;
      y1[i] = v12;
    }
  }
}
BATCHPID_CLONES static void single_3(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_3(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_3(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_3(x, y, n, chunk);
}


constexpr std::int32_t CODE_4[] = {9, 2, 1, 0, 1, 0, 26, 2, 9, 3, 26, 4, 9, 3, 29, 11, 5, 6, 29, 10, 7, 8, 12, 13};
template <class T>
BATCHPID_INLINE void run_4(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = result_of<Code(1), T>(v0, v1, v0);
      T const v10 = result_of<Code(26), T>(v2, v9, v3);
      T const v11 = result_of<Code(26), T>(v4, v9, v3);
      T const v12 = result_of<Code(29), T>(v11, v5, v6);
      T const v13 = result_of<Code(29), T>(v10, v7, v8);
      y0[i] = v12;
      y1[i] = v13;
    }
  }
}
BATCHPID_CLONES static void single_4(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_4(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_4(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_4(x, y, n, chunk);
}


constexpr std::int32_t CODE_5[] = {10, 2, 1, 0, 1, 0, 26, 2, 10, 3, 26, 4, 10, 3, 0, 12, 5, 12, 29, 13, 6, 7, 29, 11, 8, 9, 14, 15};
template <class T>
BATCHPID_INLINE void run_5(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = result_of<Code(1), T>(v0, v1, v0);
      T const v11 = result_of<Code(26), T>(v2, v10, v3);
      T const v12 = result_of<Code(26), T>(v4, v10, v3);
      T const v13 = result_of<Code(0), T>(v12, v5, v12);
      T const v14 = result_of<Code(29), T>(v13, v6, v7);
      T const v15 = result_of<Code(29), T>(v11, v8, v9);
      y0[i] = v14;
      y1[i] = v15;
    }
  }
}
BATCHPID_CLONES static void single_5(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_5(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_5(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_5(x, y, n, chunk);
}


constexpr std::int32_t CODE_6[] = {8, 2, 1, 0, 1, 0, 26, 2, 8, 3, 26, 4, 8, 3, 29, 10, 5, 6, 28, 10, 11, 8, 6, 12, 7, 12, 23, 13, 3, 9, 11, 14};
template <class T>
BATCHPID_INLINE void run_6(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = result_of<Code(1), T>(v0, v1, v0);
      T const v9 = result_of<Code(26), T>(v2, v8, v3);
      T const v10 = result_of<Code(26), T>(v4, v8, v3);
      T const v11 = result_of<Code(29), T>(v10, v5, v6);
      T const v12 = result_of<Code(28), T>(v10, v11, v8);
      T const v13 = result_of<Code(6), T>(v12, v7, v12);
      T const v14 = result_of<Code(23), T>(v13, v3, v9);
      y0[i] = v11;
      y1[i] = v14;
    }
  }
}
BATCHPID_CLONES static void single_6(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_6(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_6(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_6(x, y, n, chunk);
}


constexpr std::int32_t CODE_7[] = {9, 2, 1, 0, 1, 0, 26, 2, 9, 3, 26, 4, 9, 3, 0, 11, 5, 11, 29, 12, 6, 7, 28, 12, 13, 9, 6, 14, 8, 14, 23, 15, 3, 10, 13, 16};
template <class T>
BATCHPID_INLINE void run_7(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = result_of<Code(1), T>(v0, v1, v0);
      T const v10 = result_of<Code(26), T>(v2, v9, v3);
      T const v11 = result_of<Code(26), T>(v4, v9, v3);
      T const v12 = result_of<Code(0), T>(v11, v5, v11);
      T const v13 = result_of<Code(29), T>(v12, v6, v7);
      T const v14 = result_of<Code(28), T>(v12, v13, v9);
      T const v15 = result_of<Code(6), T>(v14, v8, v14);
      T const v16 = result_of<Code(23), T>(v15, v3, v10);
      y0[i] = v13;
      y1[i] = v16;
    }
  }
}
BATCHPID_CLONES static void single_7(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_7(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_7(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_7(x, y, n, chunk);
}


constexpr std::int32_t CODE_8[] = {9, 2, 1, 0, 1, 0, 26, 2, 9, 3, 26, 4, 9, 3, 29, 11, 5, 6, 28, 12, 11, 7, 0, 10, 13, 10, 27, 14, 8, 8, 12, 15};
template <class T>
BATCHPID_INLINE void run_8(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = result_of<Code(1), T>(v0, v1, v0);
      T const v10 = result_of<Code(26), T>(v2, v9, v3);
      T const v11 = result_of<Code(26), T>(v4, v9, v3);
      T const v12 = result_of<Code(29), T>(v11, v5, v6);
      T const v13 = result_of<Code(28), T>(v12, v11, v7);
      T const v14 = result_of<Code(0), T>(v10, v13, v10);
      T const v15 = result_of<Code(27), T>(v14, v8, v8);
      y0[i] = v12;
      y1[i] = v15;
    }
  }
}
BATCHPID_CLONES static void single_8(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_8(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_8(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_8(x, y, n, chunk);
}


constexpr std::int32_t CODE_9[] = {10, 2, 1, 0, 1, 0, 26, 2, 10, 3, 26, 4, 10, 3, 0, 12, 5, 12, 29, 13, 6, 7, 28, 14, 13, 8, 0, 11, 15, 11, 27, 16, 9, 9, 14, 17};
template <class T>
BATCHPID_INLINE void run_9(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = result_of<Code(1), T>(v0, v1, v0);
      T const v11 = result_of<Code(26), T>(v2, v10, v3);
      T const v12 = result_of<Code(26), T>(v4, v10, v3);
      T const v13 = result_of<Code(0), T>(v12, v5, v12);
      T const v14 = result_of<Code(29), T>(v13, v6, v7);
      T const v15 = result_of<Code(28), T>(v14, v13, v8);
      T const v16 = result_of<Code(0), T>(v11, v15, v11);
      T const v17 = result_of<Code(27), T>(v16, v9, v9);
      y0[i] = v14;
      y1[i] = v17;
    }
  }
}
BATCHPID_CLONES static void single_9(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_9(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_9(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_9(x, y, n, chunk);
}


constexpr std::int32_t CODE_10[] = {8, 1, 28, 0, 1, 2, 28, 3, 1, 4, 26, 5, 9, 8, 29, 10, 6, 7, 11};
template <class T>
BATCHPID_INLINE void run_10(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step;
    T *y0 = y[0] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = result_of<Code(28), T>(v0, v1, v2);
      T const v9 = result_of<Code(28), T>(v3, v1, v4);
      T const v10 = result_of<Code(26), T>(v5, v9, v8);
      T const v11 = result_of<Code(29), T>(v10, v6, v7);
      y0[i] = v11;
    }
  }
}
BATCHPID_CLONES static void single_10(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_10(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_10(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_10(x, y, n, chunk);
}


constexpr std::int32_t CODE_11[] = {9, 1, 28, 0, 1, 2, 28, 3, 1, 4, 26, 5, 10, 9, 0, 11, 6, 11, 29, 12, 7, 8, 13};
template <class T>
BATCHPID_INLINE void run_11(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step;
    T *y0 = y[0] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = result_of<Code(28), T>(v0, v1, v2);
      T const v10 = result_of<Code(28), T>(v3, v1, v4);
      T const v11 = result_of<Code(26), T>(v5, v10, v9);
      T const v12 = result_of<Code(0), T>(v11, v6, v11);
      T const v13 = result_of<Code(29), T>(v12, v7, v8);
      y0[i] = v13;
    }
  }
}
BATCHPID_CLONES static void single_11(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_11(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_11(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_11(x, y, n, chunk);
}


constexpr std::int32_t CODE_12[] = {12, 2, 28, 0, 1, 2, 28, 3, 1, 4, 2, 5, 13, 5, 26, 6, 7, 14, 27, 15, 8, 8, 26, 9, 16, 12, 29, 17, 10, 11, 16, 18};
template <class T>
BATCHPID_INLINE void run_12(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = result_of<Code(28), T>(v0, v1, v2);
      T const v13 = result_of<Code(28), T>(v3, v1, v4);
      T const v14 = result_of<Code(2), T>(v5, v13, v5);
      T const v15 = result_of<Code(26), T>(v6, v7, v14);
      T const v16 = result_of<Code(27), T>(v15, v8, v8);
      T const v17 = result_of<Code(26), T>(v9, v16, v12);
      T const v18 = result_of<Code(29), T>(v17, v10, v11);
      y0[i] = v16;
      y1[i] = v18;
    }
  }
}
BATCHPID_CLONES static void single_12(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_12(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_12(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_12(x, y, n, chunk);
}


constexpr std::int32_t CODE_13[] = {13, 2, 28, 0, 1, 2, 28, 3, 1, 4, 2, 5, 14, 5, 26, 6, 7, 15, 27, 16, 8, 8, 26, 9, 17, 13, 0, 18, 10, 18, 29, 19, 11, 12, 17, 20};
template <class T>
BATCHPID_INLINE void run_13(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = result_of<Code(28), T>(v0, v1, v2);
      T const v14 = result_of<Code(28), T>(v3, v1, v4);
      T const v15 = result_of<Code(2), T>(v5, v14, v5);
      T const v16 = result_of<Code(26), T>(v6, v7, v15);
      T const v17 = result_of<Code(27), T>(v16, v8, v8);
      T const v18 = result_of<Code(26), T>(v9, v17, v13);
      T const v19 = result_of<Code(0), T>(v18, v10, v18);
      T const v20 = result_of<Code(29), T>(v19, v11, v12);
      y0[i] = v17;
      y1[i] = v20;
    }
  }
}
BATCHPID_CLONES static void single_13(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_13(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_13(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_13(x, y, n, chunk);
}


constexpr std::int32_t CODE_14[] = {10, 2, 1, 0, 1, 0, 26, 2, 10, 3, 26, 4, 10, 3, 28, 5, 1, 6, 26, 7, 13, 12, 29, 14, 8, 9, 11, 15};
template <class T>
BATCHPID_INLINE void run_14(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = result_of<Code(1), T>(v0, v1, v0);
      T const v11 = result_of<Code(26), T>(v2, v10, v3);
      T const v12 = result_of<Code(26), T>(v4, v10, v3);
      T const v13 = result_of<Code(28), T>(v5, v1, v6);
      T const v14 = result_of<Code(26), T>(v7, v13, v12);
      T const v15 = result_of<Code(29), T>(v14, v8, v9);
      y0[i] = v11;
      y1[i] = v15;
    }
  }
}
BATCHPID_CLONES static void single_14(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_14(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_14(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_14(x, y, n, chunk);
}


constexpr std::int32_t CODE_15[] = {11, 2, 1, 0, 1, 0, 26, 2, 11, 3, 26, 4, 11, 3, 28, 5, 1, 6, 26, 7, 14, 13, 0, 15, 8, 15, 29, 16, 9, 10, 12, 17};
template <class T>
BATCHPID_INLINE void run_15(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = result_of<Code(1), T>(v0, v1, v0);
      T const v12 = result_of<Code(26), T>(v2, v11, v3);
      T const v13 = result_of<Code(26), T>(v4, v11, v3);
      T const v14 = result_of<Code(28), T>(v5, v1, v6);
      T const v15 = result_of<Code(26), T>(v7, v14, v13);
      T const v16 = result_of<Code(0), T>(v15, v8, v15);
      T const v17 = result_of<Code(29), T>(v16, v9, v10);
      y0[i] = v12;
      y1[i] = v17;
    }
  }
}
BATCHPID_CLONES static void single_15(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_15(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_15(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_15(x, y, n, chunk);
}


constexpr std::int32_t CODE_16[] = {14, 3, 1, 0, 1, 0, 26, 2, 14, 3, 26, 4, 14, 3, 28, 5, 1, 6, 2, 7, 17, 7, 26, 8, 9, 18, 27, 19, 10, 10, 26, 11, 20, 16, 29, 21, 12, 13, 15, 20, 22};
template <class T>
BATCHPID_INLINE void run_16(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step, *x13 = x[13].data + at * x[13].step;
    T *y0 = y[0] + start, *y1 = y[1] + start, *y2 = y[2] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = x13[i];
      T const v14 = result_of<Code(1), T>(v0, v1, v0);
      T const v15 = result_of<Code(26), T>(v2, v14, v3);
      T const v16 = result_of<Code(26), T>(v4, v14, v3);
      T const v17 = result_of<Code(28), T>(v5, v1, v6);
      T const v18 = result_of<Code(2), T>(v7, v17, v7);
      T const v19 = result_of<Code(26), T>(v8, v9, v18);
      T const v20 = result_of<Code(27), T>(v19, v10, v10);
      T const v21 = result_of<Code(26), T>(v11, v20, v16);
      T const v22 = result_of<Code(29), T>(v21, v12, v13);
      y0[i] = v15;
      y1[i] = v20;
      y2[i] = v22;
    }
  }
}
BATCHPID_CLONES static void single_16(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_16(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_16(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_16(x, y, n, chunk);
}


constexpr std::int32_t CODE_17[] = {15, 3, 1, 0, 1, 0, 26, 2, 15, 3, 26, 4, 15, 3, 28, 5, 1, 6, 2, 7, 18, 7, 26, 8, 9, 19, 27, 20, 10, 10, 26, 11, 21, 17, 0, 22, 12, 22, 29, 23, 13, 14, 16, 21, 24};
template <class T>
BATCHPID_INLINE void run_17(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step, *x13 = x[13].data + at * x[13].step, *x14 = x[14].data + at * x[14].step;
    T *y0 = y[0] + start, *y1 = y[1] + start, *y2 = y[2] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = x13[i];
      T const v14 = x14[i];
      T const v15 = result_of<Code(1), T>(v0, v1, v0);
      T const v16 = result_of<Code(26), T>(v2, v15, v3);
      T const v17 = result_of<Code(26), T>(v4, v15, v3);
      T const v18 = result_of<Code(28), T>(v5, v1, v6);
      T const v19 = result_of<Code(2), T>(v7, v18, v7);
      T const v20 = result_of<Code(26), T>(v8, v9, v19);
      T const v21 = result_of<Code(27), T>(v20, v10, v10);
      T const v22 = result_of<Code(26), T>(v11, v21, v17);
      T const v23 = result_of<Code(0), T>(v22, v12, v22);
      T const v24 = result_of<Code(29), T>(v23, v13, v14);
      y0[i] = v16;
      y1[i] = v21;
      y2[i] = v24;
    }
  }
}
BATCHPID_CLONES static void single_17(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_17(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_17(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_17(x, y, n, chunk);
}


constexpr std::int32_t CODE_18[] = {12, 2, 1, 0, 1, 0, 26, 2, 12, 3, 26, 4, 12, 3, 28, 5, 1, 6, 26, 7, 15, 14, 29, 16, 8, 9, 29, 13, 10, 11, 17, 18};
template <class T>
BATCHPID_INLINE void run_18(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = result_of<Code(1), T>(v0, v1, v0);
      T const v13 = result_of<Code(26), T>(v2, v12, v3);
      T const v14 = result_of<Code(26), T>(v4, v12, v3);
      T const v15 = result_of<Code(28), T>(v5, v1, v6);
      T const v16 = result_of<Code(26), T>(v7, v15, v14);
      T const v17 = result_of<Code(29), T>(v16, v8, v9);
      T const v18 = result_of<Code(29), T>(v13, v10, v11);
      y0[i] = v17;
      y1[i] = v18;
    }
  }
}
BATCHPID_CLONES static void single_18(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_18(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_18(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_18(x, y, n, chunk);
}


constexpr std::int32_t CODE_19[] = {13, 2, 1, 0, 1, 0, 26, 2, 13, 3, 26, 4, 13, 3, 28, 5, 1, 6, 26, 7, 16, 15, 0, 17, 8, 17, 29, 18, 9, 10, 29, 14, 11, 12, 19, 20};
template <class T>
BATCHPID_INLINE void run_19(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = result_of<Code(1), T>(v0, v1, v0);
      T const v14 = result_of<Code(26), T>(v2, v13, v3);
      T const v15 = result_of<Code(26), T>(v4, v13, v3);
      T const v16 = result_of<Code(28), T>(v5, v1, v6);
      T const v17 = result_of<Code(26), T>(v7, v16, v15);
      T const v18 = result_of<Code(0), T>(v17, v8, v17);
      T const v19 = result_of<Code(29), T>(v18, v9, v10);
      T const v20 = result_of<Code(29), T>(v14, v11, v12);
      y0[i] = v19;
      y1[i] = v20;
    }
  }
}
BATCHPID_CLONES static void single_19(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_19(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_19(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_19(x, y, n, chunk);
}


constexpr std::int32_t CODE_20[] = {16, 3, 1, 0, 1, 0, 26, 2, 16, 3, 26, 4, 16, 3, 28, 5, 1, 6, 2, 7, 19, 7, 26, 8, 9, 20, 27, 21, 10, 10, 26, 11, 22, 18, 29, 23, 12, 13, 29, 17, 14, 15, 22, 24, 25};
template <class T>
BATCHPID_INLINE void run_20(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step, *x13 = x[13].data + at * x[13].step, *x14 = x[14].data + at * x[14].step, *x15 = x[15].data + at * x[15].step;
    T *y0 = y[0] + start, *y1 = y[1] + start, *y2 = y[2] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = x13[i];
      T const v14 = x14[i];
      T const v15 = x15[i];
      T const v16 = result_of<Code(1), T>(v0, v1, v0);
      T const v17 = result_of<Code(26), T>(v2, v16, v3);
      T const v18 = result_of<Code(26), T>(v4, v16, v3);
      T const v19 = result_of<Code(28), T>(v5, v1, v6);
      T const v20 = result_of<Code(2), T>(v7, v19, v7);
      T const v21 = result_of<Code(26), T>(v8, v9, v20);
      T const v22 = result_of<Code(27), T>(v21, v10, v10);
      T const v23 = result_of<Code(26), T>(v11, v22, v18);
      T const v24 = result_of<Code(29), T>(v23, v12, v13);
      T const v25 = result_of<Code(29), T>(v17, v14, v15);
      y0[i] = v22;
      y1[i] = v24;
      y2[i] = v25;
    }
  }
}
BATCHPID_CLONES static void single_20(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_20(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_20(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_20(x, y, n, chunk);
}


constexpr std::int32_t CODE_21[] = {17, 3, 1, 0, 1, 0, 26, 2, 17, 3, 26, 4, 17, 3, 28, 5, 1, 6, 2, 7, 20, 7, 26, 8, 9, 21, 27, 22, 10, 10, 26, 11, 23, 19, 0, 24, 12, 24, 29, 25, 13, 14, 29, 18, 15, 16, 23, 26, 27};
template <class T>
BATCHPID_INLINE void run_21(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step, *x13 = x[13].data + at * x[13].step, *x14 = x[14].data + at * x[14].step, *x15 = x[15].data + at * x[15].step, *x16 = x[16].data + at * x[16].step;
    T *y0 = y[0] + start, *y1 = y[1] + start, *y2 = y[2] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = x13[i];
      T const v14 = x14[i];
      T const v15 = x15[i];
      T const v16 = x16[i];
      T const v17 = result_of<Code(1), T>(v0, v1, v0);
      T const v18 = result_of<Code(26), T>(v2, v17, v3);
      T const v19 = result_of<Code(26), T>(v4, v17, v3);
      T const v20 = result_of<Code(28), T>(v5, v1, v6);
      T const v21 = result_of<Code(2), T>(v7, v20, v7);
      T const v22 = result_of<Code(26), T>(v8, v9, v21);
      T const v23 = result_of<Code(27), T>(v22, v10, v10);
      T const v24 = result_of<Code(26), T>(v11, v23, v19);
      T const v25 = result_of<Code(0), T>(v24, v12, v24);
      T const v26 = result_of<Code(29), T>(v25, v13, v14);
      T const v27 = result_of<Code(29), T>(v18, v15, v16);
      y0[i] = v23;
      y1[i] = v26;
      y2[i] = v27;
    }
  }
}
BATCHPID_CLONES static void single_21(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_21(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_21(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_21(x, y, n, chunk);
}


constexpr std::int32_t CODE_22[] = {11, 2, 1, 0, 1, 0, 26, 2, 11, 3, 26, 4, 11, 3, 28, 5, 1, 6, 26, 7, 14, 13, 29, 15, 8, 9, 28, 15, 16, 11, 6, 17, 10, 17, 23, 18, 3, 12, 16, 19};
template <class T>
BATCHPID_INLINE void run_22(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = result_of<Code(1), T>(v0, v1, v0);
      T const v12 = result_of<Code(26), T>(v2, v11, v3);
      T const v13 = result_of<Code(26), T>(v4, v11, v3);
      T const v14 = result_of<Code(28), T>(v5, v1, v6);
      T const v15 = result_of<Code(26), T>(v7, v14, v13);
      T const v16 = result_of<Code(29), T>(v15, v8, v9);
      T const v17 = result_of<Code(28), T>(v15, v16, v11);
      T const v18 = result_of<Code(6), T>(v17, v10, v17);
      T const v19 = result_of<Code(23), T>(v18, v3, v12);
      y0[i] = v16;
      y1[i] = v19;
    }
  }
}
BATCHPID_CLONES static void single_22(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_22(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_22(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_22(x, y, n, chunk);
}


constexpr std::int32_t CODE_23[] = {12, 2, 1, 0, 1, 0, 26, 2, 12, 3, 26, 4, 12, 3, 28, 5, 1, 6, 26, 7, 15, 14, 0, 16, 8, 16, 29, 17, 9, 10, 28, 17, 18, 12, 6, 19, 11, 19, 23, 20, 3, 13, 18, 21};
template <class T>
BATCHPID_INLINE void run_23(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = result_of<Code(1), T>(v0, v1, v0);
      T const v13 = result_of<Code(26), T>(v2, v12, v3);
      T const v14 = result_of<Code(26), T>(v4, v12, v3);
      T const v15 = result_of<Code(28), T>(v5, v1, v6);
      T const v16 = result_of<Code(26), T>(v7, v15, v14);
      T const v17 = result_of<Code(0), T>(v16, v8, v16);
      T const v18 = result_of<Code(29), T>(v17, v9, v10);
      T const v19 = result_of<Code(28), T>(v17, v18, v12);
      T const v20 = result_of<Code(6), T>(v19, v11, v19);
      T const v21 = result_of<Code(23), T>(v20, v3, v13);
      y0[i] = v18;
      y1[i] = v21;
    }
  }
}
BATCHPID_CLONES static void single_23(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_23(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_23(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_23(x, y, n, chunk);
}


constexpr std::int32_t CODE_24[] = {15, 3, 1, 0, 1, 0, 26, 2, 15, 3, 26, 4, 15, 3, 28, 5, 1, 6, 2, 7, 18, 7, 26, 8, 9, 19, 27, 20, 10, 10, 26, 11, 21, 17, 29, 22, 12, 13, 28, 22, 23, 15, 6, 24, 14, 24, 23, 25, 3, 16, 21, 23, 26};
template <class T>
BATCHPID_INLINE void run_24(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step, *x13 = x[13].data + at * x[13].step, *x14 = x[14].data + at * x[14].step;
    T *y0 = y[0] + start, *y1 = y[1] + start, *y2 = y[2] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = x13[i];
      T const v14 = x14[i];
      T const v15 = result_of<Code(1), T>(v0, v1, v0);
      T const v16 = result_of<Code(26), T>(v2, v15, v3);
      T const v17 = result_of<Code(26), T>(v4, v15, v3);
      T const v18 = result_of<Code(28), T>(v5, v1, v6);
      T const v19 = result_of<Code(2), T>(v7, v18, v7);
      T const v20 = result_of<Code(26), T>(v8, v9, v19);
      T const v21 = result_of<Code(27), T>(v20, v10, v10);
      T const v22 = result_of<Code(26), T>(v11, v21, v17);
      T const v23 = result_of<Code(29), T>(v22, v12, v13);
      T const v24 = result_of<Code(28), T>(v22, v23, v15);
      T const v25 = result_of<Code(6), T>(v24, v14, v24);
      T const v26 = result_of<Code(23), T>(v25, v3, v16);
      y0[i] = v21;
      y1[i] = v23;
      y2[i] = v26;
    }
  }
}
BATCHPID_CLONES static void single_24(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_24(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_24(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_24(x, y, n, chunk);
}


constexpr std::int32_t CODE_25[] = {16, 3, 1, 0, 1, 0, 26, 2, 16, 3, 26, 4, 16, 3, 28, 5, 1, 6, 2, 7, 19, 7, 26, 8, 9, 20, 27, 21, 10, 10, 26, 11, 22, 18, 0, 23, 12, 23, 29, 24, 13, 14, 28, 24, 25, 16, 6, 26, 15, 26, 23, 27, 3, 17, 22, 25, 28};
template <class T>
BATCHPID_INLINE void run_25(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step, *x13 = x[13].data + at * x[13].step, *x14 = x[14].data + at * x[14].step, *x15 = x[15].data + at * x[15].step;
    T *y0 = y[0] + start, *y1 = y[1] + start, *y2 = y[2] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = x13[i];
      T const v14 = x14[i];
      T const v15 = x15[i];
      T const v16 = result_of<Code(1), T>(v0, v1, v0);
      T const v17 = result_of<Code(26), T>(v2, v16, v3);
      T const v18 = result_of<Code(26), T>(v4, v16, v3);
      T const v19 = result_of<Code(28), T>(v5, v1, v6);
      T const v20 = result_of<Code(2), T>(v7, v19, v7);
      T const v21 = result_of<Code(26), T>(v8, v9, v20);
      T const v22 = result_of<Code(27), T>(v21, v10, v10);
      T const v23 = result_of<Code(26), T>(v11, v22, v18);
      T const v24 = result_of<Code(0), T>(v23, v12, v23);
      T const v25 = result_of<Code(29), T>(v24, v13, v14);
      T const v26 = result_of<Code(28), T>(v24, v25, v16);
      T const v27 = result_of<Code(6), T>(v26, v15, v26);
      T const v28 = result_of<Code(23), T>(v27, v3, v17);
      y0[i] = v22;
      y1[i] = v25;
      y2[i] = v28;
    }
  }
}
BATCHPID_CLONES static void single_25(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_25(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_25(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_25(x, y, n, chunk);
}


constexpr std::int32_t CODE_26[] = {12, 2, 1, 0, 1, 0, 26, 2, 12, 3, 26, 4, 12, 3, 28, 5, 1, 6, 26, 7, 15, 14, 29, 16, 8, 9, 28, 17, 16, 10, 0, 13, 18, 13, 27, 19, 11, 11, 17, 20};
template <class T>
BATCHPID_INLINE void run_26(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = result_of<Code(1), T>(v0, v1, v0);
      T const v13 = result_of<Code(26), T>(v2, v12, v3);
      T const v14 = result_of<Code(26), T>(v4, v12, v3);
      T const v15 = result_of<Code(28), T>(v5, v1, v6);
      T const v16 = result_of<Code(26), T>(v7, v15, v14);
      T const v17 = result_of<Code(29), T>(v16, v8, v9);
      T const v18 = result_of<Code(28), T>(v17, v16, v10);
      T const v19 = result_of<Code(0), T>(v13, v18, v13);
      T const v20 = result_of<Code(27), T>(v19, v11, v11);
      y0[i] = v17;
      y1[i] = v20;
    }
  }
}
BATCHPID_CLONES static void single_26(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_26(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_26(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_26(x, y, n, chunk);
}


constexpr std::int32_t CODE_27[] = {13, 2, 1, 0, 1, 0, 26, 2, 13, 3, 26, 4, 13, 3, 28, 5, 1, 6, 26, 7, 16, 15, 0, 17, 8, 17, 29, 18, 9, 10, 28, 19, 18, 11, 0, 14, 20, 14, 27, 21, 12, 12, 19, 22};
template <class T>
BATCHPID_INLINE void run_27(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step;
    T *y0 = y[0] + start, *y1 = y[1] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = result_of<Code(1), T>(v0, v1, v0);
      T const v14 = result_of<Code(26), T>(v2, v13, v3);
      T const v15 = result_of<Code(26), T>(v4, v13, v3);
      T const v16 = result_of<Code(28), T>(v5, v1, v6);
      T const v17 = result_of<Code(26), T>(v7, v16, v15);
      T const v18 = result_of<Code(0), T>(v17, v8, v17);
      T const v19 = result_of<Code(29), T>(v18, v9, v10);
      T const v20 = result_of<Code(28), T>(v19, v18, v11);
      T const v21 = result_of<Code(0), T>(v14, v20, v14);
      T const v22 = result_of<Code(27), T>(v21, v12, v12);
      y0[i] = v19;
      y1[i] = v22;
    }
  }
}
BATCHPID_CLONES static void single_27(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_27(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_27(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_27(x, y, n, chunk);
}


constexpr std::int32_t CODE_28[] = {15, 3, 1, 0, 1, 0, 26, 2, 15, 3, 26, 4, 15, 3, 28, 5, 1, 6, 2, 7, 18, 7, 26, 8, 9, 19, 27, 20, 10, 10, 26, 11, 21, 17, 29, 22, 12, 13, 28, 23, 22, 14, 0, 16, 24, 16, 27, 25, 10, 10, 21, 23, 26};
template <class T>
BATCHPID_INLINE void run_28(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step, *x13 = x[13].data + at * x[13].step, *x14 = x[14].data + at * x[14].step;
    T *y0 = y[0] + start, *y1 = y[1] + start, *y2 = y[2] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = x13[i];
      T const v14 = x14[i];
      T const v15 = result_of<Code(1), T>(v0, v1, v0);
      T const v16 = result_of<Code(26), T>(v2, v15, v3);
      T const v17 = result_of<Code(26), T>(v4, v15, v3);
      T const v18 = result_of<Code(28), T>(v5, v1, v6);
      T const v19 = result_of<Code(2), T>(v7, v18, v7);
      T const v20 = result_of<Code(26), T>(v8, v9, v19);
      T const v21 = result_of<Code(27), T>(v20, v10, v10);
      T const v22 = result_of<Code(26), T>(v11, v21, v17);
      T const v23 = result_of<Code(29), T>(v22, v12, v13);
      T const v24 = result_of<Code(28), T>(v23, v22, v14);
      T const v25 = result_of<Code(0), T>(v16, v24, v16);
      T const v26 = result_of<Code(27), T>(v25, v10, v10);
      y0[i] = v21;
      y1[i] = v23;
      y2[i] = v26;
    }
  }
}
BATCHPID_CLONES static void single_28(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_28(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_28(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_28(x, y, n, chunk);
}


constexpr std::int32_t CODE_29[] = {16, 3, 1, 0, 1, 0, 26, 2, 16, 3, 26, 4, 16, 3, 28, 5, 1, 6, 2, 7, 19, 7, 26, 8, 9, 20, 27, 21, 10, 10, 26, 11, 22, 18, 0, 23, 12, 23, 29, 24, 13, 14, 28, 25, 24, 15, 0, 17, 26, 17, 27, 27, 10, 10, 22, 25, 28};
template <class T>
BATCHPID_INLINE void run_29(Operand<T> const *x, T *const *y, Index n, Index chunk) {
  for (Index start = 0, at = 0; start < n; start += chunk, ++at) {
    T const *x0 = x[0].data + at * x[0].step, *x1 = x[1].data + at * x[1].step, *x2 = x[2].data + at * x[2].step, *x3 = x[3].data + at * x[3].step, *x4 = x[4].data + at * x[4].step, *x5 = x[5].data + at * x[5].step, *x6 = x[6].data + at * x[6].step, *x7 = x[7].data + at * x[7].step, *x8 = x[8].data + at * x[8].step, *x9 = x[9].data + at * x[9].step, *x10 = x[10].data + at * x[10].step, *x11 = x[11].data + at * x[11].step, *x12 = x[12].data + at * x[12].step, *x13 = x[13].data + at * x[13].step, *x14 = x[14].data + at * x[14].step, *x15 = x[15].data + at * x[15].step;
    T *y0 = y[0] + start, *y1 = y[1] + start, *y2 = y[2] + start;
    Index const count = std::min(chunk, n - start);
    _Pragma("GCC ivdep") for (Index i = 0; i < count; ++i) {
      T const v0 = x0[i];
      T const v1 = x1[i];
      T const v2 = x2[i];
      T const v3 = x3[i];
      T const v4 = x4[i];
      T const v5 = x5[i];
      T const v6 = x6[i];
      T const v7 = x7[i];
      T const v8 = x8[i];
      T const v9 = x9[i];
      T const v10 = x10[i];
      T const v11 = x11[i];
      T const v12 = x12[i];
      T const v13 = x13[i];
      T const v14 = x14[i];
      T const v15 = x15[i];
      T const v16 = result_of<Code(1), T>(v0, v1, v0);
      T const v17 = result_of<Code(26), T>(v2, v16, v3);
      T const v18 = result_of<Code(26), T>(v4, v16, v3);
      T const v19 = result_of<Code(28), T>(v5, v1, v6);
      T const v20 = result_of<Code(2), T>(v7, v19, v7);
      T const v21 = result_of<Code(26), T>(v8, v9, v20);
      T const v22 = result_of<Code(27), T>(v21, v10, v10);
      T const v23 = result_of<Code(26), T>(v11, v22, v18);
      T const v24 = result_of<Code(0), T>(v23, v12, v23);
      T const v25 = result_of<Code(29), T>(v24, v13, v14);
      T const v26 = result_of<Code(28), T>(v25, v24, v15);
      T const v27 = result_of<Code(0), T>(v17, v26, v17);
      T const v28 = result_of<Code(27), T>(v27, v10, v10);
      y0[i] = v22;
      y1[i] = v25;
      y2[i] = v28;
    }
  }
}
BATCHPID_CLONES static void single_29(Operand<float> const *x, float *const *y, Index n, Index chunk) {
  run_29(x, y, n, chunk);
}
BATCHPID_CLONES static void pass_29(Operand<double> const *x, double *const *y, Index n, Index chunk) {
  run_29(x, y, n, chunk);
}

}  // namespace detail

static Fused const FUSED[] = {
    {11, detail::CODE_0, detail::single_0, detail::pass_0},
    {15, detail::CODE_1, detail::single_1, detail::pass_1},
    {20, detail::CODE_2, detail::single_2, detail::pass_2},
    {24, detail::CODE_3, detail::single_3, detail::pass_3},
    {24, detail::CODE_4, detail::single_4, detail::pass_4},
    {28, detail::CODE_5, detail::single_5, detail::pass_5},
    {32, detail::CODE_6, detail::single_6, detail::pass_6},
    {36, detail::CODE_7, detail::single_7, detail::pass_7},
    {32, detail::CODE_8, detail::single_8, detail::pass_8},
    {36, detail::CODE_9, detail::single_9, detail::pass_9},
    {19, detail::CODE_10, detail::single_10, detail::pass_10},
    {23, detail::CODE_11, detail::single_11, detail::pass_11},
    {32, detail::CODE_12, detail::single_12, detail::pass_12},
    {36, detail::CODE_13, detail::single_13, detail::pass_13},
    {28, detail::CODE_14, detail::single_14, detail::pass_14},
    {32, detail::CODE_15, detail::single_15, detail::pass_15},
    {41, detail::CODE_16, detail::single_16, detail::pass_16},
    {45, detail::CODE_17, detail::single_17, detail::pass_17},
    {32, detail::CODE_18, detail::single_18, detail::pass_18},
    {36, detail::CODE_19, detail::single_19, detail::pass_19},
    {45, detail::CODE_20, detail::single_20, detail::pass_20},
    {49, detail::CODE_21, detail::single_21, detail::pass_21},
    {40, detail::CODE_22, detail::single_22, detail::pass_22},
    {44, detail::CODE_23, detail::single_23, detail::pass_23},
    {53, detail::CODE_24, detail::single_24, detail::pass_24},
    {57, detail::CODE_25, detail::single_25, detail::pass_25},
    {40, detail::CODE_26, detail::single_26, detail::pass_26},
    {44, detail::CODE_27, detail::single_27, detail::pass_27},
    {53, detail::CODE_28, detail::single_28, detail::pass_28},
    {57, detail::CODE_29, detail::single_29, detail::pass_29},
};

}  // namespace batchpid
