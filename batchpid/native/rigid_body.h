// Rigid-body dynamics of a tree on a fixed base: mass matrix by the composite-rigid-body algorithm, passive forces by
// the recursive Newton-Euler algorithm. The equations stand in sim/engine/rigid_body.py and sim/engine/batch_dynamics.py.
//
// A number N is a double, or a vector of them: one for each of several robots.

#pragma once

#include <cmath>
#include <cstdint>

#pragma GCC visibility push(hidden)

namespace batchpid {

template <class N>
struct Vector {
  N x, y, z;
};

template <class N>
Vector<N> operator+(Vector<N> a, Vector<N> b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
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

// Constants of one body and its joint, a row of 25 numbers: BODY in task_space_extension.py.
template <class T>
struct BodyRow {
  T rotation[3][3], position[3];
  BodyInertia<T> inertia;
};

// Mass, first moment and inertia tensor (its rows), in the axes of the base and about its origin.
template <class N>
struct Inertia {
  N mass;
  Vector<N> first;
  Vector<N> tensor[3];

  void add(Inertia const &other) {
    mass += other.mass;
    first = first + other.first;
    for (int k = 0; k < 3; ++k) tensor[k] = tensor[k] + other.tensor[k];
  }
  Vector<N> linear(Vector<N> turning, Vector<N> moving) const { return mass * moving + cross(turning, first); }
  Vector<N> angular(Vector<N> turning, Vector<N> moving) const {
    Vector<N> const turned{dot(tensor[0], turning), dot(tensor[1], turning), dot(tensor[2], turning)};
    return turned + cross(first, moving);
  }
};

template <class N>
Inertia<N> point_mass(N mass, Vector<N> place) {
  Inertia<N> made{mass, mass * place, {}};
  N const square = dot(place, made.first);
  made.tensor[0] = {square, N{}, N{}};
  made.tensor[1] = {N{}, square, N{}};
  made.tensor[2] = {N{}, N{}, square};
  N const places[3] = {place.x, place.y, place.z};
  for (int k = 0; k < 3; ++k) made.tensor[k] = made.tensor[k] + -places[k] * made.first;
  return made;
}

// Body at a pose: axes and origin of its frame, and the inertia of it, or of all that its joint moves.
template <class N>
struct BodyState {
  Vector<N> axes[3], origin;
  Inertia<N> inertia;
};

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
template <class N>
Vector<N> moving(BodyState<N> const &body, bool slides) {
  return slides ? body.axes[0] : cross(body.origin, body.axes[0]);
}

// Write the frames of the bodies at a pose. tree (dof, 2): the joint above, or -1; whether it slides.
template <class N, class T>
void place_bodies(std::int64_t dof, std::int32_t const *tree, BodyRow<T> const *rows, N const *cosine, N const *sine,
                  N const *qpos, BodyState<N> *body) {
  BodyState<N> base{};
  base.axes[0].x = base.axes[1].y = base.axes[2].z = N(1.0);
  for (std::int64_t j = 0; j < dof; ++j) {
    BodyState<N> const &above = tree[2 * j] < 0 ? base : body[tree[2 * j]];
    BodyRow<T> const &row = rows[j];
    BodyState<N> &at = body[j];
    for (int k = 0; k < 3; ++k) {
      double const column[3] = {double(row.rotation[0][k]), double(row.rotation[1][k]), double(row.rotation[2][k])};
      at.axes[k] = along_axes(above.axes, column);
    }
    at.origin = above.origin + along_axes(above.axes, row.position);
    if (tree[2 * j + 1]) {
      at.origin = at.origin + qpos[j] * at.axes[0];
    } else {
      Vector<N> const y = at.axes[1], z = at.axes[2];
      at.axes[1] = cosine[j] * y + sine[j] * z;
      at.axes[2] = cosine[j] * z + -sine[j] * y;
    }
  }
}

// Write the inertia of a body, from its frame.
template <class N, class T>
void weigh(BodyInertia<T> const &row, BodyState<N> &at) {
  at.inertia = point_mass(N(row.mass), at.origin + along_axes(at.axes, row.center));
  for (int k = 0; k < 3; ++k) {  // R T R^T: the sum of (T column k in the base's axes) times axis k
    Vector<N> const turned = along_axes(at.axes, row.tensor[k]);
    Vector<N> *tensor = at.inertia.tensor;
    tensor[0] = tensor[0] + turned.x * at.axes[k];
    tensor[1] = tensor[1] + turned.y * at.axes[k];
    tensor[2] = tensor[2] + turned.z * at.axes[k];
  }
}

template <class N, class T>
void weigh_bodies(std::int64_t dof, BodyRow<T> const *rows, BodyState<N> *body) {
  for (std::int64_t j = 0; j < dof; ++j) weigh(rows[j].inertia, body[j]);
}

// Write the mass matrix (dof, dof) of the bodies; each then has the inertia of all that its joint moves.
template <class N>
void composite_mass_matrix(std::int64_t dof, std::int32_t const *tree, BodyState<N> *body, N *matrix) {
  for (std::int64_t at = 0; at < dof * dof; ++at) matrix[at] = N{};
  for (std::int64_t j = dof - 1; j >= 0; --j) {
    Inertia<N> const &moved = body[j].inertia;
    if (tree[2 * j] >= 0) body[tree[2 * j]].inertia.add(moved);
    Vector<N> const w = turning(body[j], tree[2 * j + 1]), v = moving(body[j], tree[2 * j + 1]);
    Vector<N> const linear = moved.linear(w, v), angular = moved.angular(w, v);
    for (std::int64_t i = j; i >= 0; i = tree[2 * i]) {
      Vector<N> const a = body[i].axes[0];
      N const product = tree[2 * i + 1] ? dot(a, linear) : dot(a, angular) + dot(cross(body[i].origin, a), linear);
      matrix[i * dof + j] = matrix[j * dof + i] = product;
    }
  }
}

// Velocity and acceleration of a body, and the wrench on it, about the origin.
template <class N>
struct BodyMotion {
  Vector<N> turning, moving, turning_change, moving_change;
  Vector<N> torque, force;

  // Add the wrench that moves an inertia with the body.
  void accelerate(Inertia<N> const &inertia) {
    Vector<N> const linear = inertia.linear(turning, moving), angular = inertia.angular(turning, moving);
    force = force + inertia.linear(turning_change, moving_change) + cross(turning, linear);
    torque = torque + inertia.angular(turning_change, moving_change) + cross(turning, angular) + cross(moving, linear);
  }
};

// Write the efforts (dof,) of the wrenches of all bodies; each body above gets those of the bodies below, too.
template <class N>
void efforts_of_wrenches(std::int64_t dof, std::int32_t const *tree, BodyState<N> const *body, BodyMotion<N> *motion,
                         N *effort) {
  for (std::int64_t j = dof - 1; j >= 0; --j) {
    BodyMotion<N> const &at = motion[j];
    effort[j] = dot(turning(body[j], tree[2 * j + 1]), at.torque) + dot(moving(body[j], tree[2 * j + 1]), at.force);
    if (tree[2 * j] < 0) continue;
    BodyMotion<N> &above = motion[tree[2 * j]];
    above.torque = above.torque + at.torque;
    above.force = above.force + at.force;
  }
}

// Write the motions of the bodies on a base with a given motion, without acceleration of the joints.
template <class N>
void move_bodies(std::int64_t dof, std::int32_t const *tree, BodyState<N> const *body, N const *qvel,
                 BodyMotion<N> const &base, BodyMotion<N> *motion) {
  for (std::int64_t j = 0; j < dof; ++j) {
    BodyMotion<N> const &above = tree[2 * j] < 0 ? base : motion[tree[2 * j]];
    Vector<N> const w = qvel[j] * turning(body[j], tree[2 * j + 1]), v = qvel[j] * moving(body[j], tree[2 * j + 1]);
    BodyMotion<N> &at = motion[j];
    at = BodyMotion<N>{above.turning + w, above.moving + v, above.turning_change, above.moving_change, {}, {}};
    at.turning_change = at.turning_change + cross(at.turning, w);
    at.moving_change = at.moving_change + cross(at.turning, v) + cross(at.moving, w);
  }
}

// The same on a base at rest; gravity (3,) is an acceleration of the base.
template <class N>
void move_bodies(std::int64_t dof, std::int32_t const *tree, BodyState<N> const *body, N const *qvel,
                 double const *gravity, BodyMotion<N> *motion) {
  BodyMotion<N> base{};
  base.moving_change = {N(-gravity[0]), N(-gravity[1]), N(-gravity[2])};
  move_bodies(dof, tree, body, qvel, base, motion);
}

}  // namespace batchpid

#pragma GCC visibility pop
