// Constraint efforts of coupled joints: sim/engine/coupled_joints.py, which has the equations.

#pragma once

#include "batchpid/native/program.h"

#include <cmath>
#include <cstdint>

#pragma GCC visibility push(hidden)

namespace batchpid {

// Python fills in the fields (Constraint in interface.py) and owns what they point to.
struct Constraint {
  double const *response;                  // (robots, followers, dof): J M^-1
  double const *push;                      // (robots, dof, followers): J^T (J M^-1 J^T)^-1
  double const *passive;                   // (robots, dof)
  std::int64_t const *followers, *leaders;  // (followers,)
  double const *multiplier, *offset;       // (followers,)
  char const *wraps;                       // (followers,): differences of positions lose their whole turns
  float *asked;                            // (robots, dof): efforts without the constraint's, or null
  double *wrong, *free;                    // (followers,), (dof,): work space
  double rate_gain, position_gain;
  std::int64_t size;                       // number of followers
};

// Add the constraint efforts of a robot to `effort` (dof); q(j) and v(j) are position and velocity of joint j.
template <class Position, class Velocity>
void constrain(Constraint const &of, std::int64_t row, std::int64_t dof, double *effort, Position q, Velocity v) {
  constexpr double TURN = 6.283185307179586;
  for (std::int64_t j = 0; j < dof; ++j) of.free[j] = effort[j] - of.passive[row * dof + j];
  for (std::int64_t i = 0; i < of.size; ++i) {
    std::int64_t const joint = of.followers[i], leader = of.leaders[i];
    double error = q(joint) - (of.multiplier[i] * q(leader) + of.offset[i]);
    if (of.wraps[i]) error -= TURN * std::nearbyint(error / TURN);
    double const rate = v(joint) - of.multiplier[i] * v(leader);
    of.wrong[i] = detail::sum_of_products(of.response + (row * of.size + i) * dof, of.free, dof);
    of.wrong[i] += of.rate_gain * rate + of.position_gain * error;
  }
  for (std::int64_t j = 0; j < dof; ++j) {
    effort[j] -= detail::sum_of_products(of.push + (row * dof + j) * of.size, of.wrong, of.size);
  }
}

}  // namespace batchpid

#pragma GCC visibility pop
