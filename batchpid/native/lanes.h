// Numbers of several robots at once, and linear algebra on small matrices of them.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

namespace batchpid {

#ifndef BATCHPID_WIDTH  // defined before this file is included
#define BATCHPID_WIDTH 4
#endif
constexpr int WIDTH = BATCHPID_WIDTH;

// Compile a function for processors with AVX-512, where vectors are as wide, with AVX2, and without; the results are the
// same, since no operation is fused.
#if defined(FOR_EACH_PROCESSOR)  // a test compiles for one of them
#elif !defined(__x86_64__) || !defined(__GLIBC__) || !defined(__GNUC__) || defined(__clang__)
#define FOR_EACH_PROCESSOR
#elif BATCHPID_WIDTH > 4
#define FOR_EACH_PROCESSOR __attribute__((target_clones("default", "avx2", "avx512f"), flatten))
#else
#define FOR_EACH_PROCESSOR __attribute__((target_clones("default", "avx2"), flatten))
#endif

// Numbers of WIDTH robots. Each is rounded as a double is, so that results do not depend on a robot's company.
struct alignas(WIDTH * sizeof(double)) Lanes {  // GCC aligns its vectors otherwise with AVX2 than without
  typedef double Packed __attribute__((vector_size(WIDTH * sizeof(double))));
  Packed of;

  Lanes() : of{} {}
  // Copies are of whole vectors: GCC copies plain structures by halves, and reading the whole then waits for both.
  Lanes(Lanes const &b) : of(b.of) {}
  Lanes &operator=(Lanes const &b) {
    of = b.of;
    return *this;
  }
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
  friend Lanes where_positive(Lanes mask, Lanes a, Lanes b) { return mask.of > 0.0 ? a.of : b.of; }
  friend double largest(Lanes a) {
    double most = a.of[0];
    for (int k = 1; k < WIDTH; ++k) most = std::max(most, a.of[k]);
    return most;
  }
  friend bool any_positive(Lanes a) {
    bool any = false;
    for (int k = 0; k < WIDTH; ++k) any |= a.of[k] > 0;
    return any;
  }
  // 1.0 where a >= b, else 0.0, also for nan.
  friend Lanes at_least_mask(Lanes a, Lanes b) { return a.of >= b.of ? Packed{} + 1.0 : Packed{}; }
  // 1.0 where a < b, else 0.0, also for nan.
  friend Lanes below_mask(Lanes a, Lanes b) { return a.of < b.of ? Packed{} + 1.0 : Packed{}; }
  // 1.0 where a and b differ, or are nan, else 0.0.
  friend Lanes differs_mask(Lanes a, Lanes b) { return a.of != b.of ? Packed{} + 1.0 : Packed{}; }
  friend Lanes absolute(Lanes a) { return a.of < 0.0 ? -a.of : a.of; }
  friend Lanes root(Lanes x) {
    for (int k = 0; k < WIDTH; ++k) x.of[k] = std::sqrt(x.of[k]);
    return x;
  }
};

// Write cosines and sines of angles [rad]: x = n pi / 2 + r with pi / 2 in three parts (W. J. Cody and W. Waite, Software
// Manual for the Elementary Functions, 1980), and the polynomials of FreeBSD's msun (k_sin.c, k_cos.c) for |r| <= pi / 4.
// The error is below 2e-16 (1.5e-16 on a million angles), and the bits are the same on every processor, other than those of the C library.
inline void write_cosines(std::int64_t count, Lanes const *angle, Lanes *cosine, Lanes *sine) {
  constexpr double FARTHEST_ANGLE = 1e6, SHIFT = 0x1.8p52;  // adding it rounds to integers
  constexpr double HALF_PI[3] = {1.57079632673412561417e+00, 6.07710050630396597660e-11, 2.02226624871116645580e-21};
  typedef Lanes::Packed Packed;
  Lanes far{};
  for (std::int64_t i = 0; i < count; ++i) {
    Packed const x = angle[i].of;
    far += 1.0 - at_least_mask(FARTHEST_ANGLE, absolute(angle[i]));
    Packed const n = (x * 6.36619772367581382433e-01 + SHIFT) - SHIFT;
    Packed const r = ((x - n * HALF_PI[0]) - n * HALF_PI[1]) - n * HALF_PI[2], z = r * r;
    Packed const s_tail = 2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10);
    Packed const s_head = 8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * s_tail);
    Packed const s = r + r * z * (-1.66666666666666324348e-01 + z * s_head);
    Packed const c_tail = -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11);
    Packed const c_head = -1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * c_tail);
    Packed const rest = 0.5 * z, w = 1.0 - rest;
    Packed const c = w + (((1.0 - w) - rest) + z * z * (4.16666666666666019037e-02 + z * c_head));
    // -2 to 2. Masks are numbers: GCC compares vectors of AVX-512 in scalar code unless it selects by the comparison.
    Packed const quarter = n - 4.0 * ((n * 0.25 + SHIFT) - SHIFT), square = quarter * quarter;
    Packed const a = square == 1.0 ? c : s, b = square == 1.0 ? s : c;
    sine[i].of = square - quarter > 1.0 ? -a : a;
    cosine[i].of = square + quarter > 1.0 ? -b : b;
  }
  for (std::int64_t at = 0; any_positive(far) && at < count * WIDTH; ++at) {
    double const x = angle[at / WIDTH].of[at % WIDTH];
    if (std::fabs(x) <= FARTHEST_ANGLE) continue;
    sine[at / WIDTH].of[at % WIDTH] = std::sin(x);
    cosine[at / WIDTH].of[at % WIDTH] = std::cos(x);
  }
}

// Return the angle atan2(y, x) of y, x >= 0 [rad]: atan(t) = atan(c) + atan((t - c) / (1 + t c)) with c = 0, 1/2 or 1, and
// the polynomial of FreeBSD's msun (s_atan.c). The error is below 4e-16, with the same bits on every processor.
inline Lanes angle_of(Lanes y, Lanes x) {
  constexpr double OF_HALF[2] = {4.63647609000806093515e-01, 2.26987774529616870924e-17};
  constexpr double OF_ONE[2] = {7.85398163397448278999e-01, 3.06161699786838301793e-17};
  typedef Lanes::Packed Packed;
  Packed const zero{}, half = zero + 0.5, one = zero + 1.0;
  auto const steep = y.of > x.of;
  Packed const a = steep ? x.of : y.of, b = steep ? y.of : x.of;
  auto const middle = a > 0.4375 * b, far = a > 0.6875 * b;
  Packed const c = far ? one : middle ? half : zero;
  Packed const high = far ? zero + OF_ONE[0] : middle ? zero + OF_HALF[0] : zero;
  Packed const low = far ? zero + OF_ONE[1] : middle ? zero + OF_HALF[1] : zero;
  Packed const t = (a - c * b) / (b + c * a), z = t * t, w = z * z;
  Packed const even_tail = 6.66107313738753120669e-02 + w * (4.97687799461593236017e-02 + w * 1.62858201153657823623e-02);
  Packed const even_head = 1.42857142725034663711e-01 + w * (9.09088713343650656196e-02 + w * even_tail);
  Packed const even = z * (3.33333333333329318027e-01 + w * even_head);
  Packed const odd_tail = -5.83357013379057348645e-02 - w * 3.65315727442169155270e-02;
  Packed const odd_head = -1.11111104054623557880e-01 + w * (-7.69187620504482999495e-02 + w * odd_tail);
  Packed const odd = w * (-1.99999999998764832476e-01 + w * odd_head);
  Packed const angle = high - ((t * (even + odd) - low) - t);
  return steep ? 2.0 * OF_ONE[0] - (angle - 2.0 * OF_ONE[1]) : angle;
}

// Copy a column of each of WIDTH rows, from row `first` on; the last row stands for those that there are not.
template <class T>
Lanes gather(T const *table, std::int64_t columns, std::int64_t column, std::int64_t first, std::int64_t rows) {
  Lanes out;
  for (int k = 0; k < WIDTH; ++k) out.of[k] = table[std::min(first + k, rows - 1) * columns + column];
  return out;
}

template <class T>
void scatter(Lanes value, T *table, std::int64_t columns, std::int64_t column, std::int64_t first, std::int64_t rows) {
  for (int k = 0; k < WIDTH && first + k < rows; ++k) table[(first + k) * columns + column] = static_cast<T>(value.of[k]);
}

// Write all columns of WIDTH rows, from row `first` on.
inline void scatter_rows(Lanes const *values, std::int64_t columns, double *table, std::int64_t first, std::int64_t rows) {
  for (std::int64_t row = first; row < rows && row < first + WIDTH; ++row) {
    for (std::int64_t j = 0; j < columns; ++j) table[row * columns + j] = values[j].of[row - first];
  }
}

// Return the product of a row, or of a column whose entries are `stride` apart, and a vector.
inline Lanes along(Lanes const *row, Lanes const *vector, std::int64_t size, std::int64_t stride = 1) {
  Lanes sum{};
  for (std::int64_t k = 0; k < size; ++k) sum += row[k * stride] * vector[k];
  return sum;
}

// Overwrite the lower triangle of symmetric matrices (n, n) by the factor L of L D L^T, without its diagonal of ones, and
// the diagonal by 1 / D; nan from the first row on that makes a matrix indefinite. Inner loops have independent sums: a
// chain of dependent ones takes four times as long.
inline void factorize(std::int64_t n, Lanes *a) {
  Lanes const none = std::numeric_limits<double>::quiet_NaN();
  for (std::int64_t j = 0; j < n; ++j) {
    Lanes const pivot = a[j * n + j], inverse = a[j * n + j] = where_positive(pivot, 1.0 / pivot, none);
    for (std::int64_t i = n - 1; i > j; --i) {
      Lanes const factor = a[i * n + j] * inverse;
      for (std::int64_t k = j + 1; k <= i; ++k) a[i * n + k] -= factor * a[k * n + j];
      a[i * n + j] = factor;
    }
  }
}

// Replace symmetric positive definite matrices (n, n), of which the lower triangle is used, by their inverses, with
// room `l` for another; nan if they are not definite.
inline void invert(std::int64_t n, Lanes *a, Lanes *l) {
  factorize(n, a);
  for (std::int64_t i = 1; i < n; ++i) {  // L^-1, without its diagonal
    Lanes *row = l + i * n;
    for (std::int64_t j = 0; j < i; ++j) row[j] = a[i * n + j];
    for (std::int64_t k = 1; k < i; ++k) {
      for (std::int64_t j = 0; j < k; ++j) row[j] += a[i * n + k] * l[k * n + j];
    }
    for (std::int64_t j = 0; j < i; ++j) row[j] = -row[j];
  }
  for (std::int64_t i = 0; i < n; ++i) {  // the sum over the rows of L^-1
    Lanes const inverse = a[i * n + i], *row = l + i * n;
    for (std::int64_t j = 0; j < i; ++j) {
      Lanes const part = inverse * row[j];
      for (std::int64_t k = 0; k <= j; ++k) a[j * n + k] += part * row[k];
      a[i * n + j] = part;
    }
  }
  for (std::int64_t i = 0; i < n; ++i) {
    for (std::int64_t j = 0; j < i; ++j) a[j * n + i] = a[i * n + j];
  }
}

// Solve L Y = X in place, with the factor of `factorize`, for X (n, columns).
template <int columns>
void solve_lower(std::int64_t n, Lanes const *l, Lanes *x) {
  for (std::int64_t i = 1; i < n; ++i) {
    for (std::int64_t k = 0; k < i; ++k) {
      for (int c = 0; c < columns; ++c) x[i * columns + c] -= l[i * n + k] * x[k * columns + c];
    }
  }
}

// Solve L D L^T Y = X in place.
template <int columns>
void solve_both(std::int64_t n, Lanes const *l, Lanes *x) {
  solve_lower<columns>(n, l, x);
  for (std::int64_t i = n - 1; i >= 0; --i) {
    for (int c = 0; c < columns; ++c) x[i * columns + c] = x[i * columns + c] * l[i * n + i];
    for (std::int64_t k = i + 1; k < n; ++k) {
      for (int c = 0; c < columns; ++c) x[i * columns + c] -= l[k * n + i] * x[k * columns + c];
    }
  }
}

}  // namespace batchpid
