// Mass matrices of many robots of one kind, on a fixed base: sim/engine/rigid_body.py, which has the equations.

#pragma once

#include "batchpid/native/lanes.h"
#include "batchpid/native/rigid_body.h"

#include <vector>

#pragma GCC visibility push(hidden)

namespace batchpid {

// Robots of one kind: the joint above each, or -1, and whether it slides (dof, 2); and rows of BodyRow (dof, 25).
template <class T>
struct Bodies {
  std::int64_t dof;
  std::int32_t const *tree;
  T const *rows;
};

// Write the mass matrices (rows, dof, dof) at qpos + ahead * qvel, both (rows, dof); qvel may be null for zero.
template <class T>
inline __attribute__((always_inline)) void write_lanes(Bodies<T> const &of, std::int64_t rows, T const *qpos,
                                                       T const *qvel, double ahead, T *out) {
  static_assert(sizeof(BodyRow<T>) == 25 * sizeof(T));
  auto const n = static_cast<std::size_t>(of.dof);
  thread_local std::vector<Lanes> pose, cosine, sine, matrix;
  thread_local std::vector<BodyState<Lanes>> bodies;
  for (auto *leaf : {&pose, &cosine, &sine}) leaf->resize(n);
  matrix.resize(n * n);
  bodies.resize(n);
  auto const *body = reinterpret_cast<BodyRow<T> const *>(of.rows);
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    for (std::int64_t j = 0; j < of.dof; ++j) {
      Lanes q = gather(qpos, of.dof, j, first, rows);
      if (qvel != nullptr) q += ahead * gather(qvel, of.dof, j, first, rows);
      pose[j] = q;
      sine_and_cosine(q, sine[j], cosine[j]);
    }
    place_bodies(of.dof, of.tree, body, cosine.data(), sine.data(), pose.data(), bodies.data());
    weigh_bodies(of.dof, body, bodies.data());
    composite_mass_matrix(of.dof, of.tree, bodies.data(), matrix.data());
    for (std::int64_t k = 0; k < of.dof * of.dof; ++k) scatter(matrix[k], out, of.dof * of.dof, k, first, rows);
  }
}

FOR_EACH_PROCESSOR static void write_mass_matrices(Bodies<double> const &of, std::int64_t rows, double const *qpos,
                                                   double const *qvel, double ahead, double *out) {
  write_lanes(of, rows, qpos, qvel, ahead, out);
}

FOR_EACH_PROCESSOR static void write_float_mass_matrices(Bodies<float> const &of, std::int64_t rows, float const *qpos,
                                                         float *out) {
  write_lanes(of, rows, qpos, static_cast<float const *>(nullptr), 0.0, out);
}

}  // namespace batchpid

#pragma GCC visibility pop
