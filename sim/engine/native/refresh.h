// Inertia of the friction model: `refresh` in batchpid/motors/friction.py, with the mass matrix that the joints show.

#pragma once

#include "model.h"

namespace batchpid {

// Constants of the friction model; Python fills in the fields.
struct FOR_PYTHON Refresh {
  Model const *model;
  double const *armature, *coulomb, *viscous, *damping, *stiffness;  // (robots, dof)
  Coupling coupling;
  double timestep;
  double share;        // SHARE
  std::int64_t steps;  // REFRESH_STEPS
};

// Write the factors of the model (robots, dof) at qpos, for robots with the age `steps`, which becomes 0; ages then
// grow by 1. Without ages, for all.
FOR_EACH_PROCESSOR static void refresh(Refresh const &of, std::int64_t robots, double const *qpos, double *gain,
                                       double *memory, std::int64_t *age) {
  std::int64_t const dof = of.model->dof;
  double const dt = of.timestep;
  auto const n = static_cast<std::size_t>(dof);
  Posed posed(dof);
  std::vector<Lanes> inverse(n * n), factor(n * n), implicit(n), scale(n), rubs(n);
  for (std::int64_t first = 0; first < robots; first += WIDTH) {
    bool due[WIDTH], any = false;
    for (int lane = 0; lane < WIDTH; ++lane) {
      due[lane] = first + lane < robots && (age == nullptr || age[first + lane] == of.steps);
      any = any || due[lane];
    }
    if (!any) continue;
    auto const at = [&](double const *table, std::int64_t j) { return gather(table, dof, j, first, robots); };
    joint_matrix(*of.model, first, robots, qpos, posed, inverse.data());
    for (std::int64_t j = 0; j < dof; ++j) inverse[j * dof + j] += at(of.armature, j);
    of.coupling.fold(n, inverse.data());
    for (std::int64_t j = 0; j < dof; ++j) {
      implicit[j] = at(of.viscous, j) + at(of.damping, j) + dt * at(of.stiffness, j);
      inverse[j * dof + j] += dt * implicit[j];
      rubs[j] = where_positive(at(of.coulomb, j), 1.0, 0.0);
    }
    invert(dof, inverse.data(), factor.data());
    for (std::int64_t j = 0; j < dof; ++j) scale[j] = root(inverse[j * dof + j]);
    for (std::int64_t j = 0; j < dof; ++j) {
      Lanes const mobility = inverse[j * dof + j];
      Lanes shared{};
      for (std::int64_t k = 0; k < dof; ++k) {
        shared += absolute(inverse[j * dof + k]) / (scale[j] * scale[k]) * rubs[k];
      }
      Lanes const k = where_positive(rubs[j], of.share / (dt * mobility * where_positive(rubs[j], shared, 1.0)), 0.0);
      Lanes const w = 1.0 - dt * implicit[j] * mobility;
      Lanes const gained = k * (1.0 + w - dt * dt * at(of.stiffness, j) * mobility), kept = k * w;
      for (int lane = 0; lane < WIDTH; ++lane) {
        if (!due[lane]) continue;
        gain[(first + lane) * dof + j] = gained.of[lane];
        memory[(first + lane) * dof + j] = kept.of[lane];
      }
    }
  }
  if (age == nullptr) return;
  for (std::int64_t row = 0; row < robots; ++row) age[row] = (age[row] == of.steps ? 0 : age[row]) + 1;
}

}  // namespace batchpid
