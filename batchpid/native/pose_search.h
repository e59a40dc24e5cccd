// Inverse kinematics: searches of many robots for poses of a tool. The equations stand in
// batchpid/task_space/inverse_kinematics.py.

#pragma once

#include "batchpid/native/tables.h"
#include "batchpid/native/tool.h"

namespace batchpid {

// Arrays of `search`; those from FOUND on are results, and begin with the starts.
enum Search { GOAL, TOOL_FRAME, LOWER, UPPER, LARGEST, FOUND, ERRORS, STEPS, SEARCH };

// Positions of WIDTH robots in a search. Joints that do not move the tool, and followers, have columns of zeros.
class PoseSearch {
 public:
  PoseSearch(Tree const &tree, std::int64_t body, double const *lower, double const *upper)
      : tool(tree, body), qpos(static_cast<std::size_t>(tree.dof)), tree_(tree), lower_(lower), upper_(upper) {
    for (auto *leaf : {&free_, &move_, &change_, &velocity_}) leaf->resize(qpos.size());
    part_.resize(AXES * qpos.size());
  }

  // Set the tool at the present positions, and its Jacobian.
  void place(Lanes const *frame) {
    tool.place(qpos.data());
    tool.set_tool(frame);
    tool.set_jacobian();
  }

  // Set the positions after a step within the limits, from the error (6,) of the tool.
  void step(Lanes const *error) {
    Lanes const damping = DAMPING + DAMPING_PER_ERROR * (along(error, error, AXES) / 2.0);
    std::fill(free_.begin(), free_.end(), Lanes(1.0));
    std::fill(move_.begin(), move_.end(), Lanes{});
    for (int pass = 0; pass < PASSES; ++pass) {
      Lanes rest[AXES];
      std::copy(error, error + AXES, rest);
      set_factor(damping, rest);
      solve(rest);
      Lanes stopped{};
      for (std::int64_t j = 0; j < dof(); ++j) {
        Lanes const move = where_positive(free_[j], change_[j], move_[j]), target = qpos[j] + move;
        Lanes const within = at_most(at_least(target, lower_[j]), upper_[j]);
        Lanes const beyond = where_positive(free_[j], absolute(target - within), Lanes{});
        move_[j] = where_positive(beyond, within - qpos[j], move);
        free_[j] = where_positive(beyond, Lanes{}, free_[j]);
        stopped += beyond;
      }
      if (!any_positive(stopped)) break;
    }
    accelerate();
    for (std::int64_t j = 0; j < dof(); ++j) qpos[j] = at_most(at_least(qpos[j] + move_[j], lower_[j]), upper_[j]);
    for (std::int64_t j = 0; j < dof(); ++j) qpos[j] = tree_.multiplier[j] * qpos[tree_.leader[j]] + tree_.offset[j];
  }

  ToolDynamics tool;
  std::vector<Lanes> qpos;

 private:
  static constexpr double DAMPING = 1e-8, DAMPING_PER_ERROR = 0.1, LARGEST_ACCELERATION = 0.75;
  static constexpr int PASSES = 4;

  std::int64_t dof() const { return tree_.dof; }

  // Set the columns of the free joints and the factor of their damped J J^T; take the moves of the others off `rest`.
  void set_factor(Lanes damping, Lanes *rest) {
    std::fill(factor_, factor_ + AXES * AXES, Lanes{});
    for (std::int64_t j = 0; j < dof(); ++j) {
      for (int a = 0; a < AXES; ++a) {
        Lanes const entry = tool.jacobian[a * dof() + j];
        part_[j * AXES + a] = where_positive(free_[j], entry, Lanes{});
        rest[a] -= where_positive(free_[j], Lanes{}, entry * move_[j]);
      }
      Lanes const *part = &part_[j * AXES];
      for (int a = 0; a < AXES; ++a) {
        for (int b = 0; b <= a; ++b) factor_[a * AXES + b] += part[a] * part[b];
      }
    }
    for (int a = 0; a < AXES; ++a) factor_[a * AXES + a] += damping;
    factorize(AXES, factor_);
  }

  // Set the changes J^T (J J^T + damping 1)^-1 v of the free joints; v is overwritten.
  void solve(Lanes *v) {
    solve_both<1>(AXES, factor_, v);
    for (std::int64_t j = 0; j < dof(); ++j) change_[j] = along(&part_[j * AXES], v, AXES);
  }

  // Add half the acceleration along the step to the moves of free joints.
  void accelerate() {
    for (std::int64_t j = 0; j < dof(); ++j) velocity_[j] = tree_.multiplier[j] * move_[tree_.leader[j]];
    tool.move(velocity_.data());
    tool.set_rate();
    solve(tool.rate);
    Lanes const velocity = root(along(move_.data(), move_.data(), dof()));
    Lanes const acceleration = root(along(change_.data(), change_.data(), dof()));
    Lanes const most = LARGEST_ACCELERATION * velocity;
    Lanes const share = 0.5 * where_positive(acceleration - most, most / acceleration, 1.0);
    for (std::int64_t j = 0; j < dof(); ++j) move_[j] -= where_positive(free_[j], share * change_[j], Lanes{});
  }

  Tree const &tree_;
  double const *lower_, *upper_;
  std::vector<Lanes> free_, move_, change_, velocity_, part_;  // part_: a row of AXES for each joint
  Lanes factor_[AXES * AXES];
};

// Write the nearest positions of searches that start at FOUND, their errors [m, rad] and their numbers of steps.
FOR_EACH_PROCESSOR static void search_poses(Tree const &tree, std::int64_t body, std::int64_t rows,
                                            std::int64_t iterations, Tables const &table) {
  PoseSearch search(tree, body, table[LOWER].data, table[UPPER].data);
  double const *largest = table[LARGEST].data;
  Lanes frame[FRAME], goal[POSE], error[AXES], nearest[2], steps;
  table[TOOL_FRAME].load(0, frame);
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    table[GOAL].load(first, goal);
    table[FOUND].load(first, search.qpos.data());
    std::vector<Lanes> qpos = search.qpos;
    Lanes smallest = nearest[0] = nearest[1] = std::numeric_limits<double>::infinity(), running = 1.0;
    steps = 0.0;
    for (std::int64_t step = 0; any_positive(running); ++step) {
      search.place(frame);
      write_error(goal, search.tool.pose, error);
      Lanes const away = length_of(error), turned = length_of(error + 3);
      Lanes const size = at_least(away / largest[0], turned / largest[1]);
      Lanes const nearer = running * below_mask(size, smallest);
      smallest = where_positive(nearer, size, smallest);
      nearest[0] = where_positive(nearer, away, nearest[0]);
      nearest[1] = where_positive(nearer, turned, nearest[1]);
      steps = where_positive(nearer, static_cast<double>(step), steps);
      for (std::size_t j = 0; j < qpos.size(); ++j) qpos[j] = where_positive(nearer, search.qpos[j], qpos[j]);
      Lanes const reached = at_least_mask(largest[0], away) * at_least_mask(largest[1], turned);
      running = where_positive(nearer * reached, 0.0, running);
      if (step == iterations) break;
      search.step(error);
    }
    table[FOUND].store(first, qpos.data());
    table[ERRORS].store(first, nearest);
    table[STEPS].store(first, &steps);
  }
}

}  // namespace batchpid
