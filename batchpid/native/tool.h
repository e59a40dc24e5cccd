// A kinematic tree, and the pose of a tool: a frame on one of its bodies. The equations stand in
// batchpid/task_space: tree_kinematics.py and frames.py.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "batchpid/native/lanes.h"
#include "batchpid/native/rigid_body.h"

#pragma GCC visibility push(hidden)

namespace batchpid {

constexpr int AXES = 6, POSE = 7, FRAME = 12;

// Constants of a tree; the axes of joints are the x axes of their bodies.
struct Tree {
  BodyRow<double> const *bodies() const { return reinterpret_cast<BodyRow<double> const *>(rows.data()); }

  std::int64_t dof;
  std::vector<std::int32_t> tree;
  std::vector<double> rows, armature;
  Vector<Lanes> gravity;
};

// Write cosines and sines of angles.
inline void write_cosines(std::int64_t count, Lanes const *angle, Lanes *cosine, Lanes *sine) {
  for (std::int64_t i = 0; i < count; ++i) sine_and_cosine(angle[i], sine[i], cosine[i]);
}

// Axes and origin of a tool in the world: columns of its frame.
struct Tool {
  Vector<Lanes> columns[4];

  // frame (3, 4): the tool's in its body; without a body it is on the base.
  Tool(Lanes const *frame, BodyState<Lanes> const *body) {
    for (int k = 0; k < 4; ++k) {
      columns[k] = {frame[k], frame[4 + k], frame[8 + k]};
      if (body == nullptr) continue;
      columns[k] = in_axes(body->axes, columns[k].x, columns[k].y, columns[k].z);
      if (k == 3) columns[k] = body->origin + columns[k];
    }
  }
  Vector<Lanes> const &place() const { return columns[3]; }
  // Write the pose of a lane: position and quaternion.
  void write_pose(int lane, double *pose) const;
};

inline void put(Vector<Lanes> const &v, Lanes *out, std::int64_t stride = 1) {
  out[0] = v.x;
  out[stride] = v.y;
  out[2 * stride] = v.z;
}

// Write the column (6,) of the Jacobian of a place that belongs to the joint of a body.
inline void write_column(BodyState<Lanes> const &body, bool slides, Vector<Lanes> const &place, Lanes *out,
                         std::int64_t stride = 1) {
  Vector<Lanes> const w = turning(body, slides);
  put(moving(body, slides) + cross(w, place), out, stride);
  put(w, out + 3 * stride, stride);
}

// Write J' q' (6,) of a place on a body.
inline void write_rate(BodyMotion<Lanes> const &at, Vector<Lanes> const &place, Lanes *out) {
  Vector<Lanes> const inward = cross(at.turning, at.moving + cross(at.turning, place));
  put(at.moving_change + cross(at.turning_change, place) + inward, out);
  put(at.turning_change, out + 3);
}

// Rotation matrix of a quaternion (w, x, y, z): matrix_of in frames.py.
struct Turn {
  Lanes rows[3][3];

  explicit Turn(Lanes const *q) {
    Lanes const w = q[0], x = q[1], y = q[2], z = q[3];
    Lanes const s = 2.0 / (w * w + x * x + y * y + z * z);
    Lanes const found[3][3] = {{1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)},
                               {s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)},
                               {s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)}};
    for (int i = 0; i < 3; ++i) std::copy(found[i], found[i] + 3, rows[i]);
  }
  // Give both halves of a twist or wrench (6,) in the axes of this rotation.
  void reverse(Lanes *twist, std::int64_t stride) const {
    for (Lanes *half : {twist, twist + 3 * stride}) {
      Lanes const x = half[0], y = half[stride], z = half[2 * stride];
      for (int k = 0; k < 3; ++k) half[k * stride] = rows[0][k] * x + rows[1][k] * y + rows[2][k] * z;
    }
  }
};

// Write the unit quaternion (w, x, y, z), w >= 0, of a rotation with these columns: wxyz_of in frames.py.
inline void write_quaternion(double const (&x)[3], double const (&y)[3], double const (&z)[3], double *out) {
  double const squares[4] = {1 + x[0] + y[1] + z[2], 1 + x[0] - y[1] - z[2], 1 - x[0] + y[1] - z[2],
                             1 - x[0] - y[1] + z[2]};
  double const wx = y[2] - z[1], wy = z[0] - x[2], wz = x[1] - y[0];
  double const xy = x[1] + y[0], xz = x[2] + z[0], yz = y[2] + z[1];
  double const rows[4][4] = {
      {squares[0], wx, wy, wz}, {wx, squares[1], xy, xz}, {wy, xy, squares[2], yz}, {wz, xz, yz, squares[3]}};
  int best = 0;
  for (int k = 1; k < 4; ++k) best = squares[k] > squares[best] ? k : best;
  double const *q = rows[best];
  double const length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int k = 0; k < 4; ++k) out[k] = q[0] < 0 ? -q[k] / length : q[k] / length;
}

inline void Tool::write_pose(int lane, double *pose) const {
  double axes[4][3];
  for (int c = 0; c < 4; ++c) {
    axes[c][0] = columns[c].x.of[lane];
    axes[c][1] = columns[c].y.of[lane];
    axes[c][2] = columns[c].z.of[lane];
  }
  for (int k = 0; k < 3; ++k) pose[k] = axes[3][k];
  write_quaternion(axes[0], axes[1], axes[2], pose + 3);
}

inline double length_of(double const *v) { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// Write the error (6,) from a pose to a goal: pose_error in frames.py.
inline void write_error(double const *goal, double const *pose, double *out) {
  for (int k = 0; k < 3; ++k) out[k] = goal[k] - pose[k];
  double const *g = goal + 4, *q = pose + 4, gw = goal[3], qw = pose[3];
  double w = gw * qw + (g[0] * q[0] + g[1] * q[1] + g[2] * q[2]);
  double v[3];
  for (int k = 0; k < 3; ++k) {
    int const next = (k + 1) % 3, last = (k + 2) % 3;
    v[k] = qw * g[k] - gw * q[k] - (g[next] * q[last] - g[last] * q[next]);
  }
  double const sign = w < 0 ? -1.0 : 1.0;
  w = sign * w;
  double const length = length_of(v);
  double const scale = length < 1e-12 * w ? 2 / w : 2 * std::atan2(length, w) / length;
  for (int k = 0; k < 3; ++k) out[3 + k] = sign * v[k] * scale;
}

}  // namespace batchpid

#pragma GCC visibility pop
