// Bounded inverses of the mobilities of tools, symmetric matrices of AXES rows. The equations stand in
// batchpid/task_space: symmetric.py and operational_space.py.

#pragma once

#include "batchpid/native/tool.h"

namespace batchpid {

constexpr int SWEEPS = 12;
constexpr double SPRING_BOUND = 0.2;  // as in operational_space.py
constexpr double CLEAR = 1e-17;  // least entry off the diagonal that is turned away, as a share of the trace: below
                                 // the rounding of the matrix itself
constexpr int PAIRS = AXES / 2;
// Rounds of a tournament: the pairs of a round have no row in common, so that the processor works on all three at once.
constexpr int ROUNDS[AXES - 1][PAIRS][2] = {{{0, 5}, {1, 4}, {2, 3}},
                                            {{0, 4}, {3, 5}, {1, 2}},
                                            {{0, 3}, {2, 4}, {1, 5}},
                                            {{0, 2}, {1, 3}, {4, 5}},
                                            {{0, 1}, {2, 5}, {3, 4}}};

// Symmetric matrices, of which the upper triangle is used.
struct Symmetric {
  Lanes &operator()(int i, int j) { return i < j ? of[i][j] : of[j][i]; }

  Lanes of[AXES][AXES];
};

// Turn by an angle with this cosine and sine.
struct Givens {
  void turn(Lanes &x, Lanes &y) const {
    Lanes const before = x;
    x = cosine * before - sine * y;
    y = sine * before + cosine * y;
  }

  Lanes cosine, sine;
};

// Turn the entries of a round's pairs away. A lane whose entry is clear is not turned, so that it ends at the same sweep
// in any company. Return whether any was turned.
inline bool turn_away(int const (&pairs)[PAIRS][2], Lanes clear, Symmetric &a, Lanes (&vectors)[AXES][AXES]) {
  Givens turns[PAIRS];
  Lanes most{};
  for (auto const &[p, q] : pairs) most = at_least(most, absolute(a(p, q)) - clear);
  if (!any_positive(most)) return false;
  for (int i = 0; i < PAIRS; ++i) {
    auto const [p, q] = pairs[i];
    Lanes const off = a(p, q), turned = absolute(off) - clear, across = a(q, q) - a(p, p);
    Lanes const twice = 2.0 * where_positive(turned, off, 1.0), size = absolute(across);
    Lanes const whole = root(across * across + twice * twice), sum = size + whole;
    Lanes const t = where_positive(turned, where_positive(-across, -twice, twice) / sum, 0.0);
    Lanes const c = where_positive(turned, root(sum / (2.0 * whole)), 1.0);
    turns[i] = {c, t * c};
    a(p, p) -= t * off;
    a(q, q) += t * off;
    a(p, q) = where_positive(turned, 0.0, off);
  }
  for (int i = 0; i < PAIRS; ++i) {
    auto const [p, q] = pairs[i];
    for (int j = 0; j < i; ++j) {
      auto const [r, s] = pairs[j];
      turns[i].turn(a(p, r), a(q, r));
      turns[i].turn(a(p, s), a(q, s));
      turns[j].turn(a(p, r), a(p, s));
      turns[j].turn(a(q, r), a(q, s));
    }
    for (auto &row : vectors) turns[i].turn(row[p], row[q]);
  }
  return true;
}

// Write the eigenvalues to the diagonals of matrices and, as columns, their eigenvectors: Jacobi's method.
inline void eigen(Symmetric &a, Lanes (&vectors)[AXES][AXES]) {
  Lanes trace{};
  for (int i = 0; i < AXES; ++i) {
    for (int j = 0; j < AXES; ++j) vectors[i][j] = i == j ? 1.0 : 0.0;
    trace += absolute(a(i, i));
  }
  bool turned = true;
  for (int sweep = 0; turned && sweep < SWEEPS; ++sweep) {
    turned = false;
    for (auto const &pairs : ROUNDS) turned |= turn_away(pairs, CLEAR * trace, a, vectors);
  }
}

// Write the inverses with the bounds s0 and SPRING_BOUND * s0, by eigenvalues, in the lanes of `unsure`; `near` gets 1.0
// where any is below s0.
inline void bound_inverses(Lanes const *matrix, Lanes s0, Lanes unsure, Lanes *out, Lanes *springs, Lanes &near) {
  Symmetric a;
  Lanes vectors[AXES][AXES], scaled[AXES][AXES], smooth[AXES][AXES], low{};
  for (int i = 0; i < AXES; ++i) {
    // The lanes that are left out are diagonal, and end at once.
    for (int j = i; j < AXES; ++j) a(i, j) = where_positive(unsure, matrix[i * AXES + j], i == j ? 1.0 : 0.0);
  }
  eigen(a, vectors);
  Lanes const s1 = SPRING_BOUND * s0, steepest = 1.0 / (s0 * s0), steepest_of_springs = 1.0 / (s1 * s1);
  for (int c = 0; c < AXES; ++c) {
    Lanes const s = a(c, c), large = at_least_mask(s, s0), exact = 1.0 / s, least = at_least(s, 0.0);
    Lanes const scale = where_positive(large, exact, least * steepest);
    Lanes const below = least * (2.0 - least * least * steepest_of_springs) * steepest_of_springs;
    Lanes const scale_of_springs = where_positive(at_least_mask(s, s1), exact, below);
    low = where_positive(large, low, 1.0);
    for (int i = 0; i < AXES; ++i) {
      scaled[i][c] = scale * vectors[i][c];
      smooth[i][c] = scale_of_springs * vectors[i][c];
    }
  }
  near = where_positive(unsure * low, 1.0, near);
  for (int i = 0; i < AXES; ++i) {
    for (int j = 0; j <= i; ++j) {
      Lanes const first = along(scaled[i], vectors[j], AXES), second = along(smooth[i], vectors[j], AXES);
      out[i * AXES + j] = out[j * AXES + i] = where_positive(unsure, first, out[i * AXES + j]);
      springs[i * AXES + j] = springs[j * AXES + i] = where_positive(unsure, second, springs[i * AXES + j]);
    }
  }
}

// Write the inverses of mobilities over the selected axes with both bounds, with 0 for the other axes; `near` gets 1.0 in
// the lanes where they are bounded.
inline void selected_inverses(Lanes const *mobility, Lanes const *axes, Lanes s0, Lanes *out, Lanes *springs,
                              Lanes &near) {
  constexpr int SIZE = AXES * AXES;
  Lanes matrix[SIZE], room[SIZE];
  std::copy(mobility, mobility + SIZE, matrix);
  for (int i = 0; i < AXES && axes != nullptr; ++i) {
    for (int j = 0; j < AXES; ++j) {
      Lanes const alone = i == j ? (1.0 - axes[i]) * at_least(2.0 * s0, 1.0) : Lanes{};
      matrix[i * AXES + j] = where_positive(axes[i] * axes[j], matrix[i * AXES + j], alone);
    }
  }
  std::copy(matrix, matrix + SIZE, out);
  invert(AXES, out, room);
  std::copy(out, out + SIZE, springs);
  Lanes const sure = at_least_mask(1.0, root(along(out, out, SIZE)) * s0);  // no eigenvalue is below s0; 0.0 for nan
  if (any_positive(1.0 - sure)) bound_inverses(matrix, s0, 1.0 - sure, out, springs, near);
  for (int i = 0; i < AXES && axes != nullptr; ++i) {
    for (int j = 0; j < AXES; ++j) {
      for (Lanes *of : {out, springs}) of[i * AXES + j] = where_positive(axes[i] * axes[j], of[i * AXES + j], Lanes{});
    }
  }
}

}  // namespace batchpid
