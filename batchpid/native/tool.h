// A kinematic tree with a tool, a frame on one of its bodies: its pose, and the dynamics at it. The equations stand in
// batchpid/task_space: tree_kinematics.py, tree_quantities.py and frames.py.

#pragma once

#include <vector>

#include "batchpid/native/lanes.h"
#include "batchpid/native/rigid_body.h"

namespace batchpid {

constexpr int AXES = 6, POSE = 7, FRAME = 12;

// Constants of a tree; the axes of joints are the x axes of their bodies.
struct Tree {
  static constexpr char CAPSULE[] = "batchpid.RigidTree";
  BodyRow<double> const *bodies() const { return reinterpret_cast<BodyRow<double> const *>(rows.data()); }

  std::int64_t dof;
  std::vector<std::int32_t> tree;
  std::vector<double> rows, armature;
  Vector<Lanes> gravity;
  std::vector<std::int32_t> leader;  // of each joint: itself, if it is independent
  std::vector<double> multiplier, offset;
  bool coupled;                      // some joint is not independent

  Coupling coupling() const { return {coupled ? leader.data() : nullptr, multiplier.data()}; }
};

inline void put(Vector<Lanes> const &v, Lanes *out, std::int64_t stride = 1) {
  out[0] = v.x;
  out[stride] = v.y;
  out[2 * stride] = v.z;
}

// Write the unit quaternion (w, x, y, z), w >= 0, of the rotation with columns x, y, z: wxyz_of in frames.py.
inline void write_quaternion(Vector<Lanes> const &x, Vector<Lanes> const &y, Vector<Lanes> const &z, Lanes *out) {
  Lanes const same = 1.0 + x.x, other = 1.0 - x.x, sum = y.y + z.z, difference = y.y - z.z;
  Lanes const squares[4] = {same + sum, same - sum, other + difference, other - difference};
  Lanes const wx = y.z - z.y, wy = z.x - x.z, wz = x.y - y.x, xy = x.y + y.x, xz = x.z + z.x, yz = y.z + z.y;
  Lanes const rows[4][4] = {
      {squares[0], wx, wy, wz}, {wx, squares[1], xy, xz}, {wy, xy, squares[2], yz}, {wz, xz, yz, squares[3]}};
  Lanes q[4], most = squares[0];
  std::copy(rows[0], rows[0] + 4, q);
  for (int row = 1; row < 4; ++row) {
    Lanes const larger = squares[row] - most;
    most = where_positive(larger, squares[row], most);
    for (int k = 0; k < 4; ++k) q[k] = where_positive(larger, rows[row][k], q[k]);
  }
  Lanes const length = root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  Lanes const scale = where_positive(-q[0], -1.0, 1.0) / length;
  for (int k = 0; k < 4; ++k) out[k] = scale * q[k];
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
  // Write the pose (7,): position and quaternion.
  void write_pose(Lanes *pose) const {
    put(columns[3], pose);
    write_quaternion(columns[0], columns[1], columns[2], pose + 3);
  }
};

inline Lanes length_of(Lanes const *v) { return root(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

// Write the error (6,) from a pose to a goal: pose_error in frames.py.
inline void write_error(Lanes const *goal, Lanes const *pose, Lanes *out) {
  Lanes const *g = goal + 4, *q = pose + 4, gw = goal[3], qw = pose[3];
  Lanes const w = gw * qw + (g[0] * q[0] + g[1] * q[1] + g[2] * q[2]), sign = where_positive(-w, -1.0, 1.0);
  Lanes v[3];
  for (int k = 0; k < 3; ++k) {
    int const next = (k + 1) % 3, last = (k + 2) % 3;
    out[k] = goal[k] - pose[k];
    v[k] = sign * (qw * g[k] - gw * q[k] - (g[next] * q[last] - g[last] * q[next]));
  }
  Lanes const size = sign * w, length = length_of(v), large = at_least_mask(length, 1e-12 * size);
  Lanes const over = where_positive(large, length, size);  // small angles are 2 sin
  Lanes const scale = where_positive(large, angle_of(length, size), 1.0) / over;
  for (int k = 0; k < 3; ++k) out[3 + k] = 2.0 * scale * v[k];
}

// Kinematics and dynamics of WIDTH robots with a tool, reduced to the leaders of coupled joints.
class ToolDynamics {
 public:
  // `body` is the body of the tool, or -1 for the base.
  ToolDynamics(Tree const &tree, std::int64_t body) : tree_(tree), body_(body) {
    auto const size = static_cast<std::size_t>(tree.dof);
    for (auto *leaf : {&bias, &cosine_, &sine_}) leaf->resize(size);
    jacobian.resize(AXES * size);
    mass.resize(size * size);
    bodies_.resize(size);
    motions_.resize(size);
  }

  // Set the frames of the bodies at positions (dof,).
  void place(Lanes const *qpos) {
    write_cosines(tree_.dof, qpos, cosine_.data(), sine_.data());
    place_bodies(tree_.dof, above(), tree_.bodies(), cosine_.data(), sine_.data(), qpos, bodies_.data());
  }
  // Set the velocities of the bodies, from those of the joints (dof,).
  void move(Lanes const *qvel) { move_bodies(tree_.dof, above(), bodies_.data(), qvel, {}, motions_.data()); }
  // Set the pose of a tool; each of the next two needs it.
  void set_tool(Lanes const *frame) {
    Tool const tool(frame, body_ < 0 ? nullptr : &bodies_[body_]);
    place_ = tool.columns[3];
    tool.write_pose(pose);
  }
  void set_jacobian() {
    if (tree_.coupled) std::fill(jacobian.begin(), jacobian.end(), Lanes{});  // leaders are added to
    for (std::int64_t j = body_; j >= 0; j = above()[2 * j]) {
      Vector<Lanes> const w = turning(bodies_[j], above()[2 * j + 1]);
      put(bodies_[j].moving + cross(w, place_), &jacobian[j], tree_.dof);
      put(w, &jacobian[j + 3 * tree_.dof], tree_.dof);
    }
    for (int axis = 0; axis < AXES; ++axis) tree_.coupling().fold_vector(size(), &jacobian[axis * tree_.dof]);
  }
  void set_rate() {  // the bodies have velocities
    BodyMotion<Lanes> const at = body_ < 0 ? BodyMotion<Lanes>{} : motions_[body_];
    Vector<Lanes> const inward = cross(at.turning, at.moving + cross(at.turning, place_));
    put(at.moving_change + cross(at.turning_change, place_) + inward, rate);
    put(at.turning_change, rate + 3);
  }
  // Set the inertias of the bodies; each of the following needs them, and the first must come first.
  void weigh() { weigh_bodies(tree_.dof, tree_.bodies(), bodies_.data()); }
  void set_bias() {
    for (std::int64_t i = 0; i < tree_.dof; ++i) motions_[i].accelerate(bodies_[i].inertia, tree_.gravity);
    efforts_of_wrenches(tree_.dof, above(), bodies_.data(), motions_.data(), bias.data());
    tree_.coupling().fold_vector(size(), bias.data());
  }
  void set_mass() {
    composite_mass_matrix(tree_.dof, above(), bodies_.data(), mass.data());
    for (std::int64_t i = 0; i < tree_.dof; ++i) mass[i * tree_.dof + i] += tree_.armature[i];
    tree_.coupling().fold(size(), mass.data());
  }

  Lanes pose[POSE], rate[AXES];
  std::vector<Lanes> jacobian;  // J G: 0 for joints that do not move the tool, and for followers
  std::vector<Lanes> mass, bias;

 private:
  std::int32_t const *above() const { return tree_.tree.data(); }
  std::size_t size() const { return static_cast<std::size_t>(tree_.dof); }

  Tree const &tree_;
  std::int64_t body_;
  Vector<Lanes> place_;  // of the tool
  std::vector<Lanes> cosine_, sine_;
  std::vector<BodyState<Lanes>> bodies_;
  std::vector<BodyMotion<Lanes>> motions_;
};

}  // namespace batchpid
