// Numbers of several robots at once, and linear algebra on small matrices of them.

#pragma once

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <algorithm>
#include <cmath>
#include <cstdint>

#pragma GCC visibility push(hidden)

namespace batchpid {

// Compile a function twice, for processors with AVX2 and without; the results are the same, since no operation is fused.
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define FOR_EACH_PROCESSOR __attribute__((target_clones("default", "avx2"), flatten))
#else
#define FOR_EACH_PROCESSOR
#endif

constexpr int WIDTH = 4;

// Numbers of WIDTH robots. Each is rounded as a double is, so that results do not depend on a robot's company.
struct alignas(WIDTH * sizeof(double)) Lanes {  // GCC aligns its vectors otherwise with AVX2 than without
  typedef double Packed __attribute__((vector_size(WIDTH * sizeof(double))));
  Packed of;

  Lanes() : of{} {}
  Lanes(Packed packed) : of(packed) {}
  Lanes(double each) : of(Packed{} + each) {}
  void operator+=(Lanes b) { of += b.of; }
  void operator-=(Lanes b) { of -= b.of; }
  friend Lanes operator-(Lanes a) { return -a.of; }
  friend Lanes operator+(Lanes a, Lanes b) { return a.of + b.of; }
  friend Lanes operator-(Lanes a, Lanes b) { return a.of - b.of; }
  friend Lanes operator*(Lanes a, Lanes b) { return a.of * b.of; }
  friend Lanes operator/(Lanes a, Lanes b) { return a.of / b.of; }
  friend Lanes at_least(Lanes a, Lanes low) { return a.of < low.of ? low.of : a.of; }
  friend Lanes at_most(Lanes a, Lanes high) { return a.of > high.of ? high.of : a.of; }
  friend Lanes zero_outside(Lanes a, Lanes low, Lanes q, Lanes high) {
    return (q.of < low.of) | (q.of > high.of) ? Packed{} : a.of;
  }
  friend Lanes where_positive(Lanes mask, Lanes a, Lanes b) { return mask.of > 0.0 ? a.of : b.of; }
  friend Lanes root(Lanes x) {
    for (int k = 0; k < WIDTH; ++k) x.of[k] = std::sqrt(x.of[k]);
    return x;
  }
};

// Copy a column of each of WIDTH rows, from row `first` on; the last row stands for those that there are not.
inline Lanes gather(double const *table, std::int64_t columns, std::int64_t column, std::int64_t first,
                    std::int64_t rows) {
  Lanes out;
  for (int k = 0; k < WIDTH; ++k) out.of[k] = table[std::min(first + k, rows - 1) * columns + column];
  return out;
}

inline void scatter(Lanes value, double *table, std::int64_t columns, std::int64_t column, std::int64_t first,
                    std::int64_t rows) {
  for (int k = 0; k < WIDTH && first + k < rows; ++k) table[(first + k) * columns + column] = value.of[k];
}

// Write Cholesky's factor L (n, n) of a symmetric matrix, with the inverses of its diagonal; nan if it is not definite.
inline void cholesky(std::int64_t n, Lanes const *a, Lanes *l) {
  for (std::int64_t j = 0; j < n; ++j) {
    for (std::int64_t i = j; i < n; ++i) {
      Lanes sum = a[i * n + j];
      for (std::int64_t k = 0; k < j; ++k) sum -= l[i * n + k] * l[j * n + k];
      l[i * n + j] = i == j ? 1.0 / root(sum) : sum * l[j * n + j];
    }
  }
}

// Replace a symmetric positive definite matrix (n, n) by its inverse, by Cholesky's factor; nan if it is not definite.
inline void invert(std::int64_t n, Lanes *a, Lanes *l) {
  cholesky(n, a, l);
  for (std::int64_t j = 0; j < n; ++j) {  // L^-1, below the diagonal
    for (std::int64_t i = j + 1; i < n; ++i) {
      Lanes sum = l[i * n + j] * l[j * n + j];
      for (std::int64_t k = j + 1; k < i; ++k) sum += l[i * n + k] * l[k * n + j];
      l[i * n + j] = -sum * l[i * n + i];
    }
  }
  for (std::int64_t i = 0; i < n; ++i) {
    for (std::int64_t j = 0; j <= i; ++j) {
      Lanes sum{};
      for (std::int64_t k = i; k < n; ++k) sum += l[k * n + i] * l[k * n + j];
      a[i * n + j] = a[j * n + i] = sum;
    }
  }
}

// Solve L y = x in place, with the factor of `cholesky`.
inline void solve_lower(std::int64_t n, Lanes const *l, Lanes *x) {
  for (std::int64_t i = 0; i < n; ++i) {
    for (std::int64_t k = 0; k < i; ++k) x[i] -= l[i * n + k] * x[k];
    x[i] = x[i] * l[i * n + i];
  }
}

// Solve L^T y = x in place.
inline void solve_upper(std::int64_t n, Lanes const *l, Lanes *x) {
  for (std::int64_t i = n - 1; i >= 0; --i) {
    for (std::int64_t k = i + 1; k < n; ++k) x[i] -= l[k * n + i] * x[k];
    x[i] = x[i] * l[i * n + i];
  }
}

}  // namespace batchpid

#pragma GCC visibility pop
