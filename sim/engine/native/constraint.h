// Constraint efforts of coupled joints: sim/engine/coupled_joints.py, which has the equations.

#pragma once

#include "batchpid/native/program.h"
#include "model.h"

namespace batchpid {

// Python fills in the fields and owns what they point to.
struct FOR_PYTHON Constraint {
  double *response;                        // (robots, followers, dof): J M^-1
  double *push;                            // (robots, dof, followers): J^T (J M^-1 J^T)^-1
  double *passive;                         // (robots, dof)
  std::int64_t const *followers, *leaders;  // (followers,)
  double const *multiplier, *offset;       // (followers,)
  char const *wraps;                       // (dof,): joints whose positions jump by WRAP
  double *unwrapped;                       // (robots, dof): positions of the last step, without jumps
  float *asked;                            // (robots, dof): efforts without the constraint's, or null
  double *wrong, *free;                    // (followers,), (dof,): work space
  Model const *model;                      // of the joints' mass matrices
  double const *implicit;                  // (robots, dof): inertia on their diagonals besides the model's
  Model const *force;                      // of the passive force; null: the engine's own
  double rate_gain, position_gain;
  std::int64_t size;                       // number of followers
};

// Set mass matrix, if it is known that of FreeMotion, and passive force (robots, dof) of robots of a mask; null: of all.
FOR_EACH_PROCESSOR static void update_constraint(Constraint const &of, std::int64_t robots, double const *qpos,
                                                 double const *passive, char const *wanted, Lanes const *mass) {
  std::int64_t const dof = of.model->dof, size = of.size;
  Posed posed(dof);
  std::vector<Lanes> matrix(static_cast<std::size_t>(dof * dof)), work(matrix.size());
  std::vector<Lanes> response(static_cast<std::size_t>(size * dof)), small(static_cast<std::size_t>(size * size));
  std::vector<Lanes> column(static_cast<std::size_t>(dof));
  for (std::int64_t first = 0; first < robots; first += WIDTH) {
    auto const write = [&](Lanes value, double *table, std::int64_t columns, std::int64_t column) {
      for (int k = 0; k < WIDTH && first + k < robots; ++k) {
        if (wanted == nullptr || wanted[first + k]) table[(first + k) * columns + column] = value.of[k];
      }
    };
    Lanes nothing{};  // 0, or nan for a robot that has failed
    if (mass == nullptr) joint_matrix(*of.model, first, robots, qpos, posed, matrix.data());
    for (std::int64_t i = 0; i < dof; ++i) {
      if (mass == nullptr) matrix[i * dof + i] += gather(of.implicit, dof, i, first, robots);
      for (std::int64_t j = 0; j <= i && mass != nullptr; ++j) matrix[i * dof + j] = matrix[j * dof + i] = *mass++;
    }
    for (Lanes const &each : matrix) nothing += each - each;
    for (std::int64_t j = 0; j < dof; ++j) {
      Lanes const force = gather(passive, dof, j, first, robots);
      nothing += force - force;
    }
    Lanes const failed = differs_mask(nothing, Lanes{});
    for (std::int64_t k = 0; k < dof * dof; ++k) {
      matrix[k] = where_positive(failed, k % (dof + 1) == 0 ? 1.0 : 0.0, matrix[k]);
    }
    for (std::int64_t j = 0; j < dof; ++j) {
      write(where_positive(failed, 0.0, gather(passive, dof, j, first, robots)), of.passive, dof, j);
    }
    invert(dof, matrix.data(), work.data());
    for (std::int64_t i = 0; i < size; ++i) {
      Lanes const *own = &matrix[of.followers[i] * dof], *above = &matrix[of.leaders[i] * dof];
      for (std::int64_t j = 0; j < dof; ++j) {
        response[i * dof + j] = own[j] - of.multiplier[i] * above[j];
        write(response[i * dof + j], of.response, size * dof, i * dof + j);
      }
    }
    for (std::int64_t i = 0; i < size; ++i) {
      for (std::int64_t k = 0; k < size; ++k) {
        Lanes const *row = &response[i * dof];
        small[i * size + k] = row[of.followers[k]] - of.multiplier[k] * row[of.leaders[k]];
      }
    }
    invert(size, small.data(), work.data());
    for (std::int64_t k = 0; k < size; ++k) {
      for (Lanes &each : column) each = Lanes{};
      for (std::int64_t i = 0; i < size; ++i) {
        column[of.followers[i]] += small[i * size + k];
        column[of.leaders[i]] -= of.multiplier[i] * small[i * size + k];
      }
      for (std::int64_t j = 0; j < dof; ++j) write(column[j], of.push, dof * size, j * size + k);
    }
  }
}

// Add the constraint efforts of a robot to `effort` (dof); read(j) and v(j) are position and velocity of joint j.
template <class Position, class Velocity>
void constrain(Constraint const &of, std::int64_t row, std::int64_t dof, double *effort, Position read, Velocity v) {
  constexpr double WRAP = 12.566370614359172;
  auto const q = [&](std::int64_t j) {
    double const position = read(j);
    if (!of.wraps[j]) return position;
    double &last = of.unwrapped[row * dof + j];
    return last = position + WRAP * std::nearbyint((last - position) / WRAP);
  };
  for (std::int64_t j = 0; j < dof; ++j) of.free[j] = effort[j] - of.passive[row * dof + j];
  for (std::int64_t i = 0; i < of.size; ++i) {
    std::int64_t const joint = of.followers[i], leader = of.leaders[i];
    double const error = q(joint) - (of.multiplier[i] * q(leader) + of.offset[i]);
    double const rate = v(joint) - of.multiplier[i] * v(leader);
    of.wrong[i] = detail::sum_of_products(of.response + (row * of.size + i) * dof, of.free, dof);
    of.wrong[i] += of.rate_gain * rate + of.position_gain * error;
  }
  for (std::int64_t j = 0; j < dof; ++j) {
    effort[j] -= detail::sum_of_products(of.push + (row * dof + j) * of.size, of.wrong, of.size);
  }
}

}  // namespace batchpid
