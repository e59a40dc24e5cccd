// Coupling of joints: batchpid/motors/coupling.py.

#pragma once

#include <cstddef>
#include <cstdint>

namespace batchpid {

// Leaders and multipliers of the joints; null for none.
struct Coupling {
  std::int32_t const *leader;  // (dof,)
  double const *multiplier;    // (dof,)

  // Write G^T M G of coupled joints in place of M (n, n): Coupling.mass_matrix.
  template <class N>
  void fold(std::size_t n, N *matrix) const {
    auto const above = [&](std::size_t i) { return static_cast<std::size_t>(leader[i]); };
    if (leader == nullptr) return;
    for (std::size_t i = 0; i < n; ++i) {
      if (above(i) == i) continue;
      for (std::size_t j = 0; j < n; ++j) matrix[above(i) * n + j] += multiplier[i] * matrix[i * n + j];
    }
    for (std::size_t i = 0; i < n; ++i) {
      if (above(i) == i) continue;
      for (std::size_t j = 0; j < n; ++j) matrix[j * n + above(i)] += multiplier[i] * matrix[j * n + i];
    }
    for (std::size_t i = 0; i < n; ++i) {
      if (above(i) == i) continue;
      for (std::size_t j = 0; j < n; ++j) matrix[i * n + j] = matrix[j * n + i] = 0.0;
      matrix[i * n + i] = 1.0;
    }
  }

  // Write G^T u in place of u, whose entry for a joint is at u[i]: Coupling.efforts.
  template <class N>
  void fold_vector(std::size_t n, N *u) const {
    for (std::size_t i = 0; i < n && leader != nullptr; ++i) {
      auto const above = static_cast<std::size_t>(leader[i]);
      if (above == i) continue;
      u[above] += multiplier[i] * u[i];
      u[i] = 0.0;
    }
  }
};

}  // namespace batchpid
