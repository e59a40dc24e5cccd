// Mass matrix of a tree of rigid bodies by the composite-rigid-body algorithm; the equations stand in
// sim/engine/rigid_body.py.

#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#pragma GCC visibility push(hidden)

namespace batchpid {

struct Vector {
  double x, y, z;
};

inline Vector operator+(Vector a, Vector b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vector operator*(double s, Vector a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector cross(Vector a, Vector b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// Constants of one body and its joint, a row of 25 numbers.
template <class T>
struct BodyRow {
  T rotation[3][3], position[3], mass, center[3], tensor[3][3];
};

// Body at a pose: axes and origin of its frame; then, of all that its joint moves, mass, first moment and inertia tensor.
struct BodyState {
  Vector axes[3], origin;
  double mass;
  Vector first;
  Vector tensor[3];  // rows
};

template <class T>
Vector in_axes(Vector const (&axes)[3], T x, T y, T z) {
  return double(x) * axes[0] + double(y) * axes[1] + double(z) * axes[2];
}

// Write the mass matrix (dof, dof) at the pose qpos (dof,). tree (dof, 2): the joint above, or -1; whether it slides.
template <class T>
void mass_matrix(std::int64_t dof, std::int32_t const *tree, BodyRow<T> const *rows, T const *qpos, T *matrix,
                 std::vector<BodyState> &bodies) {
  bodies.resize(static_cast<std::size_t>(dof));
  BodyState *body = bodies.data();
  for (std::int64_t j = 0; j < dof; ++j) {
    BodyState base{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, {0, 0, 0}, 0, {0, 0, 0}, {}};
    BodyState const &above = tree[2 * j] < 0 ? base : body[tree[2 * j]];
    BodyRow<T> const &row = rows[j];
    BodyState &at = body[j];
    for (int k = 0; k < 3; ++k) {
      at.axes[k] = in_axes(above.axes, row.rotation[0][k], row.rotation[1][k], row.rotation[2][k]);
    }
    at.origin = above.origin + in_axes(above.axes, row.position[0], row.position[1], row.position[2]);
    if (tree[2 * j + 1]) {
      at.origin = at.origin + double(qpos[j]) * at.axes[0];
    } else {
      double const c = std::cos(double(qpos[j])), s = std::sin(double(qpos[j]));
      Vector const y = at.axes[1], z = at.axes[2];
      at.axes[1] = c * y + s * z;
      at.axes[2] = c * z + -s * y;
    }
    Vector const center = at.origin + in_axes(at.axes, row.center[0], row.center[1], row.center[2]);
    at.mass = row.mass;
    at.first = at.mass * center;
    double const square = dot(center, at.first);
    at.tensor[0] = {square, 0, 0};
    at.tensor[1] = {0, square, 0};
    at.tensor[2] = {0, 0, square};
    double const centers[3] = {center.x, center.y, center.z};
    for (int k = 0; k < 3; ++k) at.tensor[k] = at.tensor[k] + -centers[k] * at.first;
    for (int k = 0; k < 3; ++k) {  // R T R^T: the sum of (T column k in the base's axes) times axis k
      Vector const turned = in_axes(at.axes, row.tensor[0][k], row.tensor[1][k], row.tensor[2][k]);
      at.tensor[0] = at.tensor[0] + turned.x * at.axes[k];
      at.tensor[1] = at.tensor[1] + turned.y * at.axes[k];
      at.tensor[2] = at.tensor[2] + turned.z * at.axes[k];
    }
  }
  for (std::int64_t at = 0; at < dof * dof; ++at) matrix[at] = 0;
  for (std::int64_t j = dof - 1; j >= 0; --j) {
    BodyState const &moved = body[j];
    if (tree[2 * j] >= 0) {
      BodyState &above = body[tree[2 * j]];
      above.mass += moved.mass;
      above.first = above.first + moved.first;
      for (int k = 0; k < 3; ++k) above.tensor[k] = above.tensor[k] + moved.tensor[k];
    }
    Vector const zero{0, 0, 0}, axis = moved.axes[0];
    Vector const w = tree[2 * j + 1] ? zero : axis, v = tree[2 * j + 1] ? axis : cross(moved.origin, axis);
    Vector const linear = moved.mass * v + cross(w, moved.first);
    Vector const turned{dot(moved.tensor[0], w), dot(moved.tensor[1], w), dot(moved.tensor[2], w)};
    Vector const angular = turned + cross(moved.first, v);
    for (std::int64_t i = j; i >= 0; i = tree[2 * i]) {
      Vector const a = body[i].axes[0];
      double const product = tree[2 * i + 1] ? dot(a, linear) : dot(a, angular) + dot(cross(body[i].origin, a), linear);
      matrix[i * dof + j] = matrix[j * dof + i] = static_cast<T>(product);
    }
  }
}

}  // namespace batchpid

#pragma GCC visibility pop
