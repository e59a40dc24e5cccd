// Friction on the way of a tool to its setpoint, for WIDTH robots. The equations stand in
// sim/tool_space/osc_controller.py.

#pragma once

#include <cstdint>
#include <vector>

#include "batchpid/native/lanes.h"
#include "batchpid/native/tool.h"

namespace batchpid {

// Arrays of `friction`: FRICTION in task_space_extension.py.
enum Friction {
  AT_POSE, AT_JACOBIAN, ON_CHAIN, GOAL_POSE, GOAL_TWIST, OTHERS_GOAL, AT_QPOS, AT_QVEL,
  VISCOUS, COULOMB, BAND, RUBBING,
  FRICTION
};

// Write the efforts of damping and Coulomb friction (dof,), from columns by their names in Friction. Without a twist the
// setpoint rests; without a viscous damping that part is left out.
inline void write_friction(std::int64_t dof, Lanes const *const (&of)[FRICTION], Lanes *out) {
  constexpr double LOOKAHEAD = 0.1;  // of batchpid/motors/friction.py
  Lanes const *jacobian = of[AT_JACOBIAN], *chain = of[ON_CHAIN];
  Lanes ahead[AXES], mobility[AXES * AXES];
  write_error(of[GOAL_POSE], of[AT_POSE], ahead);
  for (int a = 0; a < AXES; ++a) {
    if (of[GOAL_TWIST] != nullptr) ahead[a] += LOOKAHEAD * of[GOAL_TWIST][a];
    for (int b = 0; b <= a; ++b) {
      Lanes sum{};
      for (std::int64_t j = 0; j < dof; ++j) sum += jacobian[a * dof + j] * jacobian[b * dof + j];
      mobility[a * AXES + b] = mobility[b * AXES + a] = sum;
    }
    mobility[a * AXES + a] += 1e-4;
  }
  factorize(AXES, mobility);
  solve_both<1>(AXES, mobility, ahead);
  for (std::int64_t j = 0; j < dof; ++j) {
    Lanes moved{};
    for (int axis = 0; axis < AXES; ++axis) moved += jacobian[axis * dof + j] * ahead[axis];
    Lanes const way = chain[j] * moved + (1.0 - chain[j]) * (of[OTHERS_GOAL][j] - of[AT_QPOS][j]);
    out[j] = at_most(at_least(way * (of[COULOMB][j] / of[BAND][j]), -of[COULOMB][j]), of[COULOMB][j]);
    if (of[VISCOUS] != nullptr) out[j] = of[VISCOUS][j] * of[AT_QVEL][j] + out[j];
  }
}

}  // namespace batchpid
