// Rigid-body dynamics of a tree on a fixed base: mass matrix by the composite-rigid-body algorithm, passive forces by
// the recursive Newton-Euler algorithm. The equations stand in batchpid/task_space/tree_quantities.py.
//
// A number N is a double, or a vector of them: one for each of several robots.

#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>

// Structure whose fields Python fills in: setup.py lists them for sim/engine/native/__init__.py.
#define FOR_PYTHON

namespace batchpid {

template <class N>
struct Vector {
  N x, y, z;
};

template <class N>
Vector<N> operator+(Vector<N> a, Vector<N> b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class N>
Vector<N> operator-(Vector<N> a, Vector<N> b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class S, class N>
Vector<N> operator*(S s, Vector<N> a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class N>
N dot(Vector<N> a, Vector<N> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class N>
Vector<N> cross(Vector<N> a, Vector<N> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// Mass, center and inertia tensor about it of one body, in the axes of its frame.
template <class T>
struct BodyInertia {
  T mass, center[3], tensor[3][3];
};

// Constants of one body and its joint, a row of 25 numbers.
template <class T>
struct BodyRow {
  T rotation[3][3], position[3];
  BodyInertia<T> inertia;
};

// Mass, first moment and inertia tensor, in the axes of the base and about its origin.
template <class N>
struct Inertia {
  N mass;
  Vector<N> first;
  Vector<N> diagonal, rest;  // of the tensor: xx, yy, zz, and yz, xz, xy

  void add(Inertia const &other) {
    mass += other.mass;
    first = first + other.first;
    diagonal = diagonal + other.diagonal;
    rest = rest + other.rest;
  }
  Vector<N> linear(Vector<N> turning, Vector<N> moving) const { return mass * moving + cross(turning, first); }
  Vector<N> angular(Vector<N> turning, Vector<N> moving) const {
    Vector<N> const turned{dot({diagonal.x, rest.z, rest.y}, turning), dot({rest.z, diagonal.y, rest.x}, turning),
                           dot({rest.y, rest.x, diagonal.z}, turning)};
    return turned + cross(first, moving);
  }
};

template <class N>
Inertia<N> point_mass(N mass, Vector<N> place) {
  Vector<N> const first = mass * place;
  N const x = place.x * first.x, y = place.y * first.y, z = place.z * first.z;
  return {mass, first, {y + z, x + z, x + y}, {-place.y * first.z, -place.x * first.z, -place.x * first.y}};
}

// Body at a pose: axes and origin of its frame, the velocity of the base's origin with the body per rate of its joint,
// and the inertia of it, or of all that its joint moves.
template <class N>
struct BodyState {
  Vector<N> axes[3], origin, moving;
  Inertia<N> inertia;
};

// Return the frame of a base at the origin.
template <class N>
BodyState<N> body_of_base() {
  BodyState<N> base{};
  base.axes[0].x = base.axes[1].y = base.axes[2].z = N(1.0);
  return base;
}

template <class N, class T>
Vector<N> in_axes(Vector<N> const (&axes)[3], T x, T y, T z) {
  return x * axes[0] + y * axes[1] + z * axes[2];
}

template <class N, class T>
Vector<N> along_axes(Vector<N> const (&axes)[3], T const (&v)[3]) {
  return in_axes(axes, v[0], v[1], v[2]);
}

template <class N>
Vector<N> turning(BodyState<N> const &body, bool slides) {
  return slides ? Vector<N>{} : body.axes[0];
}

// Return the frame of a body on the one above it, at a position of its joint [rad or m], with cosine and sine of an angle.
template <class N, class T>
BodyState<N> place_body(BodyState<N> const &above, BodyRow<T> const &row, bool slides, N cosine, N sine, N position) {
  BodyState<N> at;
  for (int k = 0; k < 3; ++k) {
    double const column[3] = {double(row.rotation[0][k]), double(row.rotation[1][k]), double(row.rotation[2][k])};
    at.axes[k] = along_axes(above.axes, column);
  }
  at.origin = above.origin + along_axes(above.axes, row.position);
  if (slides) {
    at.origin = at.origin + position * at.axes[0];
    at.moving = at.axes[0];
  } else {
    at.moving = cross(at.origin, at.axes[0]);
    Vector<N> const y = at.axes[1], z = at.axes[2];
    at.axes[1] = cosine * y + sine * z;
    at.axes[2] = cosine * z - sine * y;
  }
  return at;
}

// Write the frames of the bodies at a pose. tree (dof, 2): the joint above, or -1; whether it slides.
template <class N, class T>
void place_bodies(std::int64_t dof, std::int32_t const *tree, BodyRow<T> const *rows, N const *cosine, N const *sine,
                  N const *qpos, BodyState<N> *body) {
  BodyState<N> const base = body_of_base<N>();
  for (std::int64_t j = 0; j < dof; ++j) {
    BodyState<N> const &above = tree[2 * j] < 0 ? base : body[tree[2 * j]];
    body[j] = place_body(above, rows[j], tree[2 * j + 1] != 0, cosine[j], sine[j], qpos[j]);
  }
}

// Write the inertia of a body, from its frame.
template <class N, class T>
void weigh(BodyInertia<T> const &row, BodyState<N> &at) {
  Inertia<N> &to = at.inertia;
  to = point_mass(N(row.mass), at.origin + along_axes(at.axes, row.center));
  for (int k = 0; k < 3; ++k) {  // R T R^T: the sum of (T column k in the base's axes) times axis k
    Vector<N> const turned = along_axes(at.axes, row.tensor[k]), axis = at.axes[k];
    to.diagonal = to.diagonal + Vector<N>{turned.x * axis.x, turned.y * axis.y, turned.z * axis.z};
    to.rest = to.rest + Vector<N>{turned.y * axis.z, turned.x * axis.z, turned.x * axis.y};
  }
}

template <class N, class T>
void weigh_bodies(std::int64_t dof, BodyRow<T> const *rows, BodyState<N> *body) {
  for (std::int64_t j = 0; j < dof; ++j) weigh(rows[j].inertia, body[j]);
}

// Write the entries (i, j) of the mass matrix of the bodies for each joint j and those above it, i <= j, by a function;
// each body then has the inertia of all that its joint moves.
template <class N, class Write>
void composite_mass_matrix(std::int64_t dof, std::int32_t const *tree, BodyState<N> *body, Write write) {
  for (std::int64_t j = dof - 1; j >= 0; --j) {
    Inertia<N> const &moved = body[j].inertia;
    if (tree[2 * j] >= 0) body[tree[2 * j]].inertia.add(moved);
    Vector<N> const w = turning(body[j], tree[2 * j + 1]), v = body[j].moving;
    Vector<N> const linear = moved.linear(w, v), angular = moved.angular(w, v);
    for (std::int64_t i = j; i >= 0; i = tree[2 * i]) {
      N product = dot(body[i].moving, linear);
      if (!tree[2 * i + 1]) product += dot(body[i].axes[0], angular);
      write(i, j, product);
    }
  }
}

// Write the mass matrix (dof, dof) of the bodies.
template <class N>
void composite_mass_matrix(std::int64_t dof, std::int32_t const *tree, BodyState<N> *body, N *matrix) {
  for (std::int64_t at = 0; at < dof * dof; ++at) matrix[at] = N{};
  composite_mass_matrix(dof, tree, body, [&](std::int64_t i, std::int64_t j, N product) {
    matrix[i * dof + j] = matrix[j * dof + i] = product;
  });
}

// Velocity and acceleration of a body, and the wrench on it, about the origin.
template <class N>
struct BodyMotion {
  Vector<N> turning, moving, turning_change, moving_change;
  Vector<N> torque, force;

  // Add the wrench that moves an inertia with the body, with the base accelerated by -gravity in addition.
  void accelerate(Inertia<N> const &inertia, Vector<N> gravity = {}) {
    Vector<N> const change = moving_change - gravity;
    Vector<N> const linear = inertia.linear(turning, moving), angular = inertia.angular(turning, moving);
    force = force + inertia.linear(turning_change, change) + cross(turning, linear);
    torque = torque + inertia.angular(turning_change, change) + cross(turning, angular) + cross(moving, linear);
  }
};

// Write the efforts (dof,) of the wrenches of all bodies; each body above gets those of the bodies below, too.
template <class N>
void efforts_of_wrenches(std::int64_t dof, std::int32_t const *tree, BodyState<N> const *body, BodyMotion<N> *motion,
                         N *effort) {
  for (std::int64_t j = dof - 1; j >= 0; --j) {
    BodyMotion<N> const &at = motion[j];
    effort[j] = dot(body[j].moving, at.force);
    if (!tree[2 * j + 1]) effort[j] += dot(body[j].axes[0], at.torque);
    if (tree[2 * j] < 0) continue;
    BodyMotion<N> &above = motion[tree[2 * j]];
    above.torque = above.torque + at.torque;
    above.force = above.force + at.force;
  }
}

// Return the motion of a body on the one above it, at a rate of its joint, without its acceleration.
template <class N>
BodyMotion<N> move_body(BodyMotion<N> const &above, BodyState<N> const &body, bool slides, N rate) {
  Vector<N> const w = rate * turning(body, slides), v = rate * body.moving;
  BodyMotion<N> at{above.turning + w, above.moving + v, above.turning_change, above.moving_change, {}, {}};
  at.turning_change = at.turning_change + cross(at.turning, w);
  at.moving_change = at.moving_change + cross(at.turning, v) + cross(at.moving, w);
  return at;
}

// Write the motions of the bodies on a base with a given motion, without acceleration of the joints.
template <class N>
void move_bodies(std::int64_t dof, std::int32_t const *tree, BodyState<N> const *body, N const *qvel,
                 BodyMotion<N> const &base, BodyMotion<N> *motion) {
  for (std::int64_t j = 0; j < dof; ++j) {
    BodyMotion<N> const &above = tree[2 * j] < 0 ? base : motion[tree[2 * j]];
    motion[j] = move_body(above, body[j], tree[2 * j + 1] != 0, qvel[j]);
  }
}

// Leaders and multipliers of the joints, null for none: batchpid/motors/coupling.py.
struct FOR_PYTHON Coupling {
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
