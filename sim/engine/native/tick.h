// Sim steps of a tick of a group of robots in one call: mass matrices, control step, and the engine, in turn.
//
// The control step is a Program, traced from sim/loop/control_step.py. Its state is in the arrays that it reads and
// writes. The law's mass matrices are computed here, every `matrix_steps` sim steps, since a Program cannot.

#pragma once

#include "batchpid/native/call.h"
#include "batchpid/native/make_program.h"
#include "refresh.h"
#include "sim_step.h"

#pragma GCC visibility push(hidden)

namespace batchpid {

// Arrays (robots, dof) of double, which Python owns: Tick in interface.py.
struct Tick {
  double *qpos, *qvel, *passive;  // reading, before and after each sim step
  double *before;                 // positions before the last sim step
  double const *pose, *rate;      // state for the mass matrix: the reading, or as the sensors measure it
  double const *qf;               // an output of the program
  std::int32_t const *tree;       // (dof, 2), of the description
  double const *bodies;           // (dof, 25)
  double const *armature;         // (dof,), or null
  double const *damping;          // (dof,), or null
  Coupling coupling;
  double *matrix;                 // (robots, dof, dof), or its diagonal, or null
  Call const *control;            // native controller, whose effort is an input of the program, or null
  Model const *measured_force;    // of the passive force at the measured state, or null
  Model const *read_force;        // of the passive force at the reading after a sim step, or null
  Refresh const *refresh;         // of the friction model's inertia, or null
  double *gain, *memory;          // of the friction model
  std::int64_t *age;              // (robots,)
  double const *target, *target_rate;  // outputs of the program: targets of drives, or null
  double *left;                   // time from the moment of the law's setpoint to the end of the tick [s], or null
  double const *noise[2];         // (steps, robots, dof): last inputs of the sensors in the next steps, or null
  double timestep;
  std::int64_t dof;
  std::int32_t whole;             // the law takes the whole matrix
  std::int32_t matrix_steps;
  std::int32_t coupling_steps;    // sim steps for which constraint efforts keep their mass matrix
  std::int32_t gravity, coriolis;  // parts of the passive force
  std::int32_t late;              // the law takes its setpoint at the end of a sim step
};

// A program with its arrays.
struct BoundProgram {
  std::unique_ptr<Program> program;
  std::vector<Input> inputs;
  std::vector<Output> outputs;
};

// Write M + armature + dt B of each robot, at the pose half way through the next `steps` sim steps.
inline void write_matrices(Tick const &tick, std::int64_t robots, std::int64_t steps) {
  auto const n = static_cast<std::size_t>(tick.dof), all = static_cast<std::size_t>(robots) * n * n;
  thread_local std::vector<double> whole;
  if (!tick.whole) whole.resize(all);
  double *found = tick.whole ? tick.matrix : whole.data();
  double const ahead = 0.5 * static_cast<double>(steps - 1) * tick.timestep;
  write_mass_matrices({tick.dof, tick.tree, tick.bodies}, robots, tick.pose, tick.rate, ahead, found);
  for (std::int64_t row = 0; row < robots; ++row, found += n * n) {
    for (std::size_t j = 0; j < n; ++j) {
      double &entry = found[j * n + j];
      if (tick.armature != nullptr) entry += tick.armature[j];
      if (tick.damping != nullptr) entry += tick.timestep * tick.damping[j];
    }
    tick.coupling.fold(n, found);
    if (tick.whole) continue;
    for (std::size_t j = 0; j < n; ++j) tick.matrix[static_cast<std::size_t>(row) * n + j] = found[j * n + j];
  }
}

// Run the sensors' program, whose last inputs are the noise, in sim step `at` of those that tick.noise is for.
inline void measure(BoundProgram &sensors, Tick const &tick, std::int64_t robots, std::int64_t at) {
  auto *place = sensors.inputs.data() + sensors.inputs.size();
  for (int i = 1; i >= 0; --i) {
    if (tick.noise[i] != nullptr) (--place)->data = tick.noise[i] + at * robots * tick.dof;
  }
  run(*sensors.program, sensors.inputs.data(), sensors.outputs.data(), 0, robots);
}

// Programs of a tick: the control step, and sensors and the feedforward of a native controller, or null.
struct Programs {
  BoundProgram *step, *sensors, *forward;
};

// Run the sim steps from `step` to `until` of a tick of `end` steps. Advance `step`; return the status of the last.
inline std::int32_t run_tick(Programs const &programs, Tick const &tick, Group &group, std::int64_t &step,
                             std::int64_t until, std::int64_t end) {
  auto const robots = group.robots, begin = step;
  auto const bytes = static_cast<std::size_t>(robots * tick.dof) * sizeof(double);
  auto const run_bound = [&](BoundProgram const &bound) {
    run(*bound.program, bound.inputs.data(), bound.outputs.data(), 0, robots);
  };
  Parts const parts{tick.gravity != 0, tick.coriolis != 0};
  std::int32_t status = 0;
  while (step < until && status == 0) {
    if (programs.sensors != nullptr) measure(*programs.sensors, tick, robots, step - begin);
    if (tick.measured_force != nullptr) {
      write_forces(*tick.measured_force, parts, robots, tick.pose, tick.rate, nullptr, tick.passive);
    }
    if (tick.refresh != nullptr) refresh(*tick.refresh, robots, tick.qpos, tick.gain, tick.memory, tick.age);
    if (tick.matrix != nullptr && step % tick.matrix_steps == 0) {
      write_matrices(tick, robots, std::min<std::int64_t>(tick.matrix_steps, end - step));
    }
    if (tick.left != nullptr) *tick.left = static_cast<double>(end - step - tick.late) * tick.timestep;
    if (programs.forward != nullptr) run_bound(*programs.forward);
    if (tick.control != nullptr) tick.control->run(*tick.control);
    run_bound(*programs.step);
    if (tick.target != nullptr) write_targets(group, tick.target, tick.target_rate);
    if (group.constraint != nullptr && step % tick.coupling_steps == 0) {
      update_constraint(group, tick.qpos, tick.qvel);
    }
    std::memcpy(tick.before, tick.qpos, bytes);
    status = try_sim_step(group, robots, tick.qf, tick.qpos, tick.qvel, tick.passive);
    if (tick.read_force != nullptr) write_force(group, *tick.read_force, parts, tick.qpos, tick.qvel, tick.passive);
    ++step;
  }
  return status;
}

}  // namespace batchpid

#pragma GCC visibility pop
