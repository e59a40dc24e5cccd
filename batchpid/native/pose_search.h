// Inverse kinematics: searches of many robots for poses of a tool. The equations stand in
// batchpid/task_space/inverse_kinematics.py.

#pragma once

#include "batchpid/native/tables.h"
#include "batchpid/native/tool.h"

namespace batchpid {

// Arrays of `search`; those from FOUND on are results, and begin with the starts.
enum Search { GOAL, TOOL_FRAME, LOWER, UPPER, LARGEST, FOUND, ERRORS, STEPS, SEARCH };

// Searches of WIDTH robots. Each lane takes the next row when its search has ended.
class PoseSearch {
 public:
  PoseSearch(Tree const &tree, std::int64_t body, Table const &lower, Table const &upper) {
    for (std::int64_t j = body; j >= 0; j = tree.tree[2 * j]) joints_.insert(joints_.begin(), j);
    for (std::int64_t const joint : joints_) {  // each on the body of the one before
      chain_.push_back(static_cast<std::int32_t>(rows_.size()) - 1);
      chain_.push_back(tree.tree[2 * joint + 1]);
      rows_.push_back(tree.bodies()[joint]);
      std::int64_t const leader = tree.leader[joint];
      auto const found = std::find(leaders_.begin(), leaders_.end(), leader);
      of_.push_back(found - leaders_.begin());
      multiplier_.push_back(tree.multiplier[joint]);
      offset_.push_back(tree.offset[joint]);
      if (found != leaders_.end()) continue;
      leaders_.push_back(leader);
      lower_.push_back(lower.data[leader]);
      upper_.push_back(upper.data[leader]);
    }
    std::size_t const size = joints_.size(), moving = leaders_.size();
    for (auto *leaf : {&cosine_, &sine_, &angle_}) leaf->resize(size);
    for (auto *leaf : {&qpos_, &free_, &move_, &change_}) leaf->resize(moving);
    for (auto *leaf : {&jacobian_, &part_}) leaf->resize(AXES * moving);
    bodies_.resize(size);
    motions_.resize(size);
  }

  void set_qpos(int lane, double const *qpos) {
    for (std::size_t j = 0; j < leaders_.size(); ++j) qpos_[j].of[lane] = qpos[leaders_[j]];
  }
  void write_qpos(int lane, double *qpos) const {
    for (std::size_t j = 0; j < leaders_.size(); ++j) qpos[leaders_[j]] = qpos_[j].of[lane];
  }

  // Return the tool at present positions, and set the Jacobian of its place.
  Tool place(Lanes const *frame) {
    auto const size = static_cast<std::int64_t>(joints_.size());
    for (std::size_t j = 0; j < joints_.size(); ++j) angle_[j] = multiplier_[j] * qpos_[of_[j]] + offset_[j];
    write_cosines(size, angle_.data(), cosine_.data(), sine_.data());
    place_bodies(size, chain_.data(), rows_.data(), cosine_.data(), sine_.data(), angle_.data(), bodies_.data());
    Tool const tool(frame, size == 0 ? nullptr : &bodies_.back());
    std::fill(jacobian_.begin(), jacobian_.end(), Lanes{});
    for (std::size_t j = 0; j < joints_.size(); ++j) {
      Lanes column[AXES];
      write_column(bodies_[j], chain_[2 * j + 1], tool.place(), column);
      for (int axis = 0; axis < AXES; ++axis) jacobian_[of_[j] * AXES + axis] += multiplier_[j] * column[axis];
    }
    return tool;
  }

  // Set the positions after a step within the limits, from the error (6,) of the tool at `place`.
  void step(Lanes const *error, Vector<Lanes> const &place) {
    std::int64_t const size = count();
    if (size == 0) return;
    Lanes const damping = DAMPING + DAMPING_PER_ERROR * (along(error, error, AXES) / 2.0);
    std::fill(free_.begin(), free_.end(), Lanes(1.0));
    std::fill(move_.begin(), move_.end(), Lanes{});
    for (int pass = 0; pass < PASSES; ++pass) {
      Lanes rest[AXES];
      std::copy(error, error + AXES, rest);
      set_factor(damping, rest);
      solve(rest);
      Lanes stopped{};
      for (std::int64_t j = 0; j < size; ++j) {
        Lanes const move = where_positive(free_[j], change_[j], move_[j]), target = qpos_[j] + move;
        Lanes const within = at_most(at_least(target, lower_[j]), upper_[j]);
        Lanes const beyond = where_positive(free_[j], absolute(target - within), Lanes{});
        move_[j] = where_positive(beyond, within - qpos_[j], move);
        free_[j] = where_positive(beyond, Lanes{}, free_[j]);
        stopped += beyond;
      }
      if (!any_positive(stopped)) break;
    }
    accelerate(place);
    for (std::int64_t j = 0; j < size; ++j) {
      qpos_[j] = at_most(at_least(qpos_[j] + move_[j], lower_[j]), upper_[j]);
    }
  }

 private:
  static constexpr double DAMPING = 1e-8, DAMPING_PER_ERROR = 0.1, LARGEST_ACCELERATION = 0.75;
  static constexpr int PASSES = 4;

  std::int64_t count() const { return static_cast<std::int64_t>(leaders_.size()); }

  // Set the columns of the free joints and the factor of their damped J J^T; take the moves of the others off `rest`.
  void set_factor(Lanes damping, Lanes *rest) {
    for (int a = 0; a < AXES; ++a) {
      for (int b = 0; b <= a; ++b) factor_[a * AXES + b] = Lanes{};
    }
    for (std::int64_t j = 0; j < count(); ++j) {
      Lanes *part = &part_[j * AXES];
      for (int a = 0; a < AXES; ++a) {
        Lanes const entry = jacobian_[j * AXES + a];
        part[a] = where_positive(free_[j], entry, Lanes{});
        rest[a] -= where_positive(free_[j], Lanes{}, entry * move_[j]);
        for (int b = 0; b <= a; ++b) factor_[a * AXES + b] += part[a] * part[b];
      }
    }
    for (int a = 0; a < AXES; ++a) factor_[a * AXES + a] += damping;
    factorize(AXES, factor_);
  }

  // Set the changes J^T (J J^T + damping 1)^-1 v of the free joints; v is overwritten.
  void solve(Lanes *v) {
    solve_both<1>(AXES, factor_, v);
    for (std::int64_t j = 0; j < count(); ++j) change_[j] = along(&part_[j * AXES], v, AXES);
  }

  // Add half the acceleration along the step to the moves of free joints.
  void accelerate(Vector<Lanes> const &place) {
    Lanes rate[AXES];
    for (std::size_t j = 0; j < joints_.size(); ++j) angle_[j] = multiplier_[j] * move_[of_[j]];
    move_bodies(static_cast<std::int64_t>(joints_.size()), chain_.data(), bodies_.data(), angle_.data(), {},
                motions_.data());
    write_rate(motions_.back(), place, rate);
    solve(rate);
    Lanes const velocity = root(along(move_.data(), move_.data(), count()));
    Lanes const acceleration = root(along(change_.data(), change_.data(), count()));
    Lanes const most = LARGEST_ACCELERATION * velocity;
    Lanes const share = 0.5 * where_positive(acceleration - most, most / acceleration, 1.0);
    for (std::int64_t j = 0; j < count(); ++j) {
      move_[j] -= where_positive(free_[j], share * change_[j], Lanes{});
    }
  }

  std::vector<std::int64_t> joints_, leaders_, of_;  // of_: place of each joint's leader in leaders_
  std::vector<std::int32_t> chain_;
  std::vector<BodyRow<double>> rows_;
  std::vector<double> multiplier_, offset_, lower_, upper_;
  std::vector<Lanes> angle_, cosine_, sine_;  // positions, or rates, of all joints
  std::vector<Lanes> qpos_, free_, move_, change_;  // of the leaders
  std::vector<Lanes> jacobian_, part_;  // a row of AXES for each leader
  std::vector<BodyState<Lanes>> bodies_;
  std::vector<BodyMotion<Lanes>> motions_;
  Lanes factor_[AXES * AXES];
};

// Write the nearest positions of searches that start at FOUND, their errors [m, rad] and their numbers of steps.
FOR_EACH_PROCESSOR static void search_poses(Tree const &tree, std::int64_t body, std::int64_t rows,
                                            std::int64_t iterations, Tables const &table) {
  PoseSearch search(tree, body, table[LOWER], table[UPPER]);
  double const *largest = table[LARGEST].data;
  std::int64_t row[WIDTH], step[WIDTH], next = 0, running = 0;
  double smallest[WIDTH];
  Lanes frame[FRAME], goal[POSE], pose[POSE], error[AXES];
  table[TOOL_FRAME].load(0, frame);
  auto const start = [&](int lane) {
    row[lane] = next < rows ? next++ : -1;
    if (row[lane] < 0) return;
    ++running;
    step[lane] = 0;
    smallest[lane] = std::numeric_limits<double>::infinity();
    search.set_qpos(lane, table[FOUND].row(row[lane]));
    for (int k = 0; k < POSE; ++k) goal[k].of[lane] = table[GOAL].row(row[lane])[k];
  };
  for (int lane = 0; lane < WIDTH; ++lane) start(lane);
  while (running > 0) {
    Tool const tool = search.place(frame);
    tool.write_pose(pose);
    write_error(goal, pose, error);
    Lanes const away = length_of(error), turned = length_of(error + 3);
    bool ended[WIDTH];
    for (int lane = 0; lane < WIDTH; ++lane) {
      ended[lane] = row[lane] < 0;
      if (ended[lane]) continue;
      double const lengths[2] = {away.of[lane], turned.of[lane]};
      double const size = std::max(lengths[0] / largest[0], lengths[1] / largest[1]);
      bool reached = false;
      if (size < smallest[lane]) {
        smallest[lane] = size;
        search.write_qpos(lane, table[FOUND].row(row[lane]));
        std::copy(lengths, lengths + 2, table[ERRORS].row(row[lane]));
        *table[STEPS].row(row[lane]) = static_cast<double>(step[lane]);
        reached = lengths[0] <= largest[0] && lengths[1] <= largest[1];
      }
      ended[lane] = reached || step[lane]++ == iterations;
    }
    search.step(error, tool.place());
    for (int lane = 0; lane < WIDTH; ++lane) {
      if (!ended[lane] || row[lane] < 0) continue;
      --running;
      start(lane);
    }
  }
}

}  // namespace batchpid
