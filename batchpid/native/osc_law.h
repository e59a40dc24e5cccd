// Law of operational-space control for WIDTH robots, and its compensation of friction. The equations stand in
// batchpid/task_space: operational_space.py; and in sim/tool_space.py.

#pragma once

#include "batchpid/native/codes.h"
#include "batchpid/native/mobility.h"
#include "batchpid/native/tables.h"

namespace batchpid {

// Inputs of a law for WIDTH rows. Coefficients in one row are loaded once.
class Given {
 public:
  explicit Given(Tables const &table) : table_(table) {
    for (int i = 0; i < LAW_EFFORT; ++i) {
      if (!table[i]) continue;
      of_[i].resize(static_cast<std::size_t>(table[i].columns));
      at_[i] = of_[i].data();
      if (i >= LAW_KP && table[i].rows == 1) {
        table[i].load(0, at_[i]);
      } else {
        each_.push_back(i);
      }
    }
  }
  void load(std::int64_t first) {
    for (int const i : each_) table_[i].load(first, at_[i]);
  }
  void set(int i, Lanes *columns) { at_[i] = columns; }
  // The columns of an array; null if it is left out.
  Lanes *operator[](int i) const { return at_[i]; }

 private:
  Tables const &table_;
  Lanes *at_[LAW_EFFORT] = {};
  std::vector<int> each_;
  std::vector<Lanes> of_[LAW_EFFORT];
};

// Return the share of an effort, added to efforts `at`, with which the joints within their limits stay there.
inline Lanes share_within(std::int64_t dof, Lanes const *effort, Lanes const *at, Lanes const *base,
                          Lanes const *limit) {
  Lanes share = 1.0;
  for (std::int64_t i = 0; i < dof && limit != nullptr; ++i) {
    Lanes const able = at_least_mask(limit[i], absolute(base[i]));
    Lanes const room = at_least(where_positive(effort[i], limit[i] - at[i], at[i] + limit[i]), 0.0);
    Lanes const size = absolute(effort[i]);
    Lanes const limited = where_positive(size - room, able, Lanes{});
    if (!any_positive(limited)) continue;
    share = at_most(where_positive(limited, room / where_positive(limited, size, 1.0), 1.0), share);
  }
  return share;
}

// A law on arrays of some robots; `dynamics`, where it is given, has the arrays of the task that are left out.
class OSCLaw {
 public:
  OSCLaw(std::int64_t dof, Tables const &table, ToolDynamics *dynamics = nullptr)
      : dof_(dof), table_(table), given_(table) {
    for (std::int64_t i = 0; i < dof; ++i) (table[LAW_CHAIN].data[i] > 0 ? chain_ : others_).push_back(i);
    auto const n = static_cast<std::size_t>(dof), links = chain_.size();
    factor_.resize(links * links);
    white_.resize(links * AXES);
    moved_.resize(links);
    for (auto *leaf : {&a_n_, &a_s_, &base_, &task_, &posture_, &effort_, &whole_, &limited_, &friction_}) leaf->resize(n);
    if (table[LAW_COULOMB]) given_.set(LAW_FEEDFORWARD, friction_.data());
    if (dynamics == nullptr) return;
    given_.set(LAW_POSE, dynamics->pose);
    given_.set(LAW_JACOBIAN, dynamics->jacobian.data());
    given_.set(LAW_JACOBIAN_RATE, dynamics->rate);
    given_.set(LAW_MASS_MATRIX, dynamics->mass.data());
    if (!table[LAW_BIAS]) given_.set(LAW_BIAS, dynamics->bias.data());
  }

  // Load WIDTH rows, with setpoints at the present moment of the tick: `_carried` in sim/tool_space.py.
  void load(std::int64_t first) {
    given_.load(first);
    if (given_[LAW_LEFT] == nullptr) return;
    Lanes *twist = given_[LAW_TWIST], *pose = given_[LAW_SETPOINT], *q = pose + 3, step[AXES], cosine, sine;
    for (int axis = 0; axis < AXES; ++axis) {
      Lanes const change = given_[LAW_ACCELERATION] ? *given_[LAW_LEFT] * given_[LAW_ACCELERATION][axis] : Lanes{};
      step[axis] = -*given_[LAW_LEFT] * (twist[axis] - 0.5 * change);
      twist[axis] -= change;
    }
    Lanes const angle = length_of(step + 3), half = 0.5 * angle;
    write_cosines(1, &half, &cosine, &sine);
    sine = where_positive(angle, sine / angle, 0.5);
    Lanes const w = q[0], a = q[1], b = q[2], c = q[3];
    Lanes const x = sine * step[3], y = sine * step[4], z = sine * step[5];
    for (int k = 0; k < 3; ++k) pose[k] += step[k];
    q[0] = cosine * w - x * a - y * b - z * c;
    q[1] = cosine * a + x * w + y * c - z * b;
    q[2] = cosine * b - x * c + y * w + z * a;
    q[3] = cosine * c + x * b - y * a + z * w;
  }
  Lanes const *qpos() const { return given_[LAW_QPOS]; }
  Lanes const *qvel() const { return given_[LAW_QVEL]; }

  // Write the results of the rows loaded.
  void advance(std::int64_t first) {
    if (given_[LAW_COULOMB] != nullptr) set_friction();
    for (std::int64_t i = 0; i < dof_ && given_[LAW_ADDED_INERTIA] != nullptr; ++i) {
      given_[LAW_MASS_MATRIX][i * dof_ + i] += given_[LAW_ADDED_INERTIA][i];
    }
    set_accelerations();
    set_inertias();
    set_efforts();
    saturate(first);
  }

 private:
  static constexpr double TURN = 6.283185307179586;

  std::int64_t links() const { return static_cast<std::int64_t>(chain_.size()); }

  // Add J v of the chain.
  void add_moved(Lanes const *v, Lanes *out) const {
    for (std::int64_t const j : chain_) {
      for (int axis = 0; axis < AXES; ++axis) out[axis] += given_[LAW_JACOBIAN][axis * dof_ + j] * v[j];
    }
  }

  // Set the efforts of Coulomb friction on the way of the tool to its setpoint.
  void set_friction() {
    constexpr double LOOKAHEAD = 0.1;  // of batchpid/motors/friction.py
    Lanes const *jacobian = given_[LAW_JACOBIAN], *coulomb = given_[LAW_COULOMB];
    Lanes ahead[AXES], mobility[AXES * AXES];
    write_error(given_[LAW_SETPOINT], given_[LAW_POSE], ahead);
    for (int a = 0; a < AXES; ++a) {
      if (given_[LAW_TWIST] != nullptr) ahead[a] += LOOKAHEAD * given_[LAW_TWIST][a];
      for (int b = 0; b <= a; ++b) mobility[a * AXES + b] = along(jacobian + a * dof_, jacobian + b * dof_, dof_);
      mobility[a * AXES + a] += 1e-4;
    }
    factorize(AXES, mobility);
    solve_both<1>(AXES, mobility, ahead);
    for (std::int64_t j = 0; j < dof_; ++j) {
      Lanes const chain = given_[LAW_CHAIN][j], away = given_[LAW_POSTURE][j] - given_[LAW_QPOS][j];
      Lanes const way = chain * along(jacobian + j, ahead, AXES, dof_) + (1.0 - chain) * away;
      friction_[j] = at_most(at_least(way * (coulomb[j] / given_[LAW_BAND][j]), -coulomb[j]), coulomb[j]);
    }
  }

  // Set error, a, a_n and a_s.
  void set_accelerations() {
    Lanes const *qpos = given_[LAW_QPOS], *qvel = given_[LAW_QVEL];
    Lanes const *target = given_[LAW_TWIST], *target_rate = given_[LAW_ACCELERATION];
    Lanes twist[AXES];
    write_error(given_[LAW_SETPOINT], given_[LAW_POSE], error_);
    for (int half = 0; half < AXES; half += 3) {
      Lanes const *e = error_ + half, length = length_of(e);
      Lanes const limit = *given_[half == 0 ? LAW_POSITION_ERROR_LIMIT : LAW_ROTATION_ERROR_LIMIT];
      Lanes const scale = where_positive(length - limit, limit / length, 1.0);
      for (int k = 0; k < 3; ++k) near_error_[half + k] = scale * e[k];
    }
    add_moved(qvel, twist);
    for (int axis = 0; axis < AXES; ++axis) {
      a_[axis] = given_[LAW_KP][axis] * near_error_[axis] - given_[LAW_KD][axis] * twist[axis];
      if (target != nullptr) a_[axis] += given_[LAW_C][axis] * target[axis];
      if (target_rate != nullptr) a_[axis] += given_[LAW_ACCELERATION_SHARE][axis] * target_rate[axis];
      if (given_[LAW_INTEGRAL] != nullptr) a_[axis] += given_[LAW_INTEGRAL][axis];
    }
    for (std::int64_t j = 0; j < dof_; ++j) {
      Lanes away = given_[LAW_POSTURE][j] - qpos[j];
      for (int k = 0; k < WIDTH && given_[LAW_TURNS] != nullptr; ++k) {
        away.of[k] -= TURN * std::nearbyint(away.of[k] * given_[LAW_TURNS][j].of[k]);
      }
      a_s_[j] = given_[LAW_POSTURE_KP][j] * away;
      a_n_[j] = a_s_[j] - given_[LAW_POSTURE_KD][j] * qvel[j];
      if (given_[LAW_LIMIT_KP] == nullptr) continue;
      Lanes const low = given_[LAW_LIMIT_LOW][j] - qpos[j], high = qpos[j] - given_[LAW_LIMIT_HIGH][j];
      Lanes const depth = at_least(low, 0.0) - at_least(high, 0.0), within = absolute(depth);
      if (!any_positive(within)) continue;
      Lanes const damped = given_[LAW_LIMIT_KD][j] * qvel[j] * within;
      Lanes const pushed = given_[LAW_LIMIT_KP][j] * depth;
      a_s_[j] = where_positive(within, a_s_[j] + given_[LAW_CHAIN][j] * pushed, a_s_[j]);
      a_n_[j] = where_positive(within, a_n_[j] + given_[LAW_CHAIN][j] * (pushed - damped), a_n_[j]);
    }
  }

  // Set the factor of M_cc, L and L_s.
  void set_inertias() {
    Lanes const *jacobian = given_[LAW_JACOBIAN], *mass = given_[LAW_MASS_MATRIX];
    std::int64_t const size = links();
    for (std::int64_t i = 0; i < size; ++i) {
      for (std::int64_t j = 0; j <= i; ++j) factor_[i * size + j] = mass[chain_[i] * dof_ + chain_[j]];
      for (int axis = 0; axis < AXES; ++axis) white_[i * AXES + axis] = jacobian[axis * dof_ + chain_[i]];
    }
    factorize(size, factor_.data());
    solve_lower<AXES>(size, factor_.data(), white_.data());  // L^-1 J^T, with M_cc = L D L^T
    Lanes mobility[AXES * AXES];
    for (std::int64_t i = 0; i < size; ++i) {
      Lanes const *row = &white_[i * AXES], inverse = factor_[i * size + i];
      for (int a = 0; a < AXES; ++a) {
        Lanes const part = inverse * row[a];
        for (int b = 0; b <= a; ++b) mobility[a * AXES + b] += part * row[b];
      }
    }
    for (int a = 0; a < AXES; ++a) {
      for (int b = 0; b < a; ++b) mobility[b * AXES + a] = mobility[a * AXES + b];
    }
    near_ = {};
    selected_inverses(mobility, given_[LAW_AXES], *given_[LAW_SMALLEST_EIGENVALUE], inertia_, spring_inertia_, near_);
  }

  // Set the efforts of base, task and posture.
  void set_efforts() {
    Lanes const *jacobian = given_[LAW_JACOBIAN], *mass = given_[LAW_MASS_MATRIX];
    Lanes moved[AXES], pulled[AXES], sprung[AXES];
    add_moved(a_n_.data(), pulled);
    add_moved(a_s_.data(), sprung);
    for (int axis = 0; axis < AXES; ++axis) {
      moved[axis] = a_[axis] - given_[LAW_JACOBIAN_RATE][axis];
      pulled[axis] = sprung[axis] - pulled[axis];  // J a_d
    }
    Lanes drop[AXES];
    for (int axis = 0; axis < AXES; ++axis) {
      force_[axis] = along(inertia_ + axis * AXES, moved, AXES);
      if (given_[LAW_WRENCH] != nullptr) force_[axis] += given_[LAW_WRENCH][axis];
      drop[axis] = along(spring_inertia_ + axis * AXES, sprung, AXES) - along(inertia_ + axis * AXES, pulled, AXES);
    }
    for (std::int64_t const i : chain_) {
      task_[i] = along(jacobian + i, force_, AXES, dof_);
      posture_[i] = -along(jacobian + i, drop, AXES, dof_);
      for (std::int64_t const j : chain_) posture_[i] += mass[i * dof_ + j] * a_n_[j];
    }
    for (std::int64_t i = 0; i < dof_; ++i) {
      Lanes sum = given_[LAW_BIAS][i];
      for (std::int64_t const j : others_) sum += mass[i * dof_ + j] * a_n_[j];
      if (given_[LAW_FEEDFORWARD] != nullptr) sum += given_[LAW_FEEDFORWARD][i];
      if (given_[LAW_DAMPING] != nullptr) sum += given_[LAW_DAMPING][i] * given_[LAW_QVEL][i];
      base_[i] = sum;
    }
  }

  // Write the results: efforts within their limits, and the integral.
  void saturate(std::int64_t first) {
    Lanes const *limit = given_[LAW_EFFORT_LIMIT], *integral = given_[LAW_INTEGRAL], *target = given_[LAW_TWIST];
    Lanes const s1 = share_within(dof_, task_.data(), base_.data(), base_.data(), limit);
    for (std::int64_t i = 0; i < dof_; ++i) effort_[i] = base_[i] + s1 * task_[i];
    Lanes const s2 = share_within(dof_, posture_.data(), effort_.data(), base_.data(), limit);
    for (std::int64_t i = 0; i < dof_; ++i) {
      whole_[i] = base_[i] + task_[i] + posture_[i];
      effort_[i] += s2 * posture_[i];
    }
    // The other joints hold against the acceleration of the chain.
    for (std::size_t c = 0; c < chain_.size(); ++c) moved_[c] = s1 * task_[chain_[c]] + s2 * posture_[chain_[c]];
    if (!others_.empty()) solve_both<1>(links(), factor_.data(), moved_.data());
    for (std::int64_t const i : others_) {
      Lanes rest{};
      for (std::size_t c = 0; c < chain_.size(); ++c) rest += given_[LAW_MASS_MATRIX][i * dof_ + chain_[c]] * moved_[c];
      whole_[i] += rest;
      effort_[i] += rest;
    }
    Lanes held = near_;
    for (std::int64_t i = 0; i < dof_; ++i) {
      if (limit != nullptr) effort_[i] = at_most(at_least(effort_[i], -limit[i]), limit[i]);
      limited_[i] = differs_mask(effort_[i], whole_[i]);
      held = where_positive(limited_[i], 1.0, held);
    }
    table_[LAW_EFFORT].store(first, effort_.data());
    if (integral != nullptr) {
      Lanes next[AXES];
      for (int axis = 0; axis < AXES; ++axis) {
        next[axis] = integral[axis] + given_[LAW_KI_DT][axis] * near_error_[axis];
        if (target != nullptr) next[axis] -= given_[LAW_KI_DT2][axis] * target[axis];
        Lanes const most = given_[LAW_INTEGRAL_LIMIT][axis];
        Lanes const grows = held * where_positive(a_[axis] * near_error_[axis], 1.0, 0.0);
        next[axis] = where_positive(grows, integral[axis], at_most(at_least(next[axis], -most), most));
      }
      table_[LAW_NEXT_INTEGRAL].store(first, next);
    }
    table_[LAW_LIMITED].store(first, limited_.data());
    table_[LAW_ERROR].store(first, error_);
    table_[LAW_FORCE].store(first, force_);
    table_[LAW_TASK].store(first, task_.data());
    table_[LAW_POSTURE_EFFORT].store(first, posture_.data());
    table_[LAW_UNSATURATED].store(first, whole_.data());
    table_[LAW_TASK_SHARE].store(first, &s1);
    table_[LAW_POSTURE_SHARE].store(first, &s2);
    table_[LAW_NEAR_SINGULAR].store(first, &near_);
  }

  std::int64_t dof_;
  Tables const &table_;
  Given given_;
  std::vector<std::int64_t> chain_, others_;
  std::vector<Lanes> factor_, white_, moved_;
  std::vector<Lanes> a_n_, a_s_, base_, task_, posture_;  // 0 for joints without a part in an effort
  std::vector<Lanes> effort_, whole_, limited_, friction_;
  Lanes error_[AXES], near_error_[AXES], a_[AXES], force_[AXES], near_;
  Lanes inertia_[AXES * AXES], spring_inertia_[AXES * AXES];
};

}  // namespace batchpid
