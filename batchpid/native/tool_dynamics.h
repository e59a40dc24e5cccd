// Kinematics and dynamics of WIDTH robots with a tool, reduced to the leaders of coupled joints. The equations stand in
// batchpid/task_space: tree_kinematics.py and tree_dynamics.py.

#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "batchpid/native/lanes.h"
#include "batchpid/native/rigid_body.h"
#include "batchpid/native/tool.h"

namespace batchpid {

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

  // Set the bodies at positions and velocities (dof,); without velocities, their frames alone.
  void place(Lanes const *qpos, Lanes const *qvel) {
    double const still[3] = {0.0, 0.0, 0.0};
    write_cosines(tree_.dof, qpos, cosine_.data(), sine_.data());
    place_bodies(tree_.dof, above(), tree_.bodies(), cosine_.data(), sine_.data(), qpos, bodies_.data());
    if (qvel != nullptr) move_bodies(tree_.dof, above(), bodies_.data(), qvel, still, motions_.data());
  }
  // Set the pose of a tool, its Jacobian, and J' q' where the bodies have velocities.
  void set_tool(Lanes const *frame, bool poses, bool columns, bool moves) {
    Tool const tool(frame, body_ < 0 ? nullptr : &bodies_[body_]);
    if (poses) tool.write_pose(pose);
    if (columns && tree_.coupled) std::fill(jacobian.begin(), jacobian.end(), Lanes{});  // leaders are added to
    for (std::int64_t j = columns ? body_ : -1; j >= 0; j = above()[2 * j]) {
      write_column(bodies_[j], above()[2 * j + 1], tool.place(), &jacobian[j], tree_.dof);
    }
    for (int axis = 0; axis < AXES && columns && tree_.coupled; ++axis) {
      Lanes *row = &jacobian[axis * tree_.dof];
      tree_.coupling().fold_vector(size(), row);
    }
    if (moves) write_rate(body_ < 0 ? BodyMotion<Lanes>{} : motions_[body_], tool.place(), rate);
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
  std::vector<Lanes> cosine_, sine_;
  std::vector<BodyState<Lanes>> bodies_;
  std::vector<BodyMotion<Lanes>> motions_;
};

}  // namespace batchpid
