// Ticks of a group of robots in one call, as long as nothing happens that Python has to handle.
//
// The stages of a sim step come from Python in their order (batchpid/stages). Those that are functions of arrays are
// Programs, traced from there; their state is in the arrays that they read and write. The others are here.

#pragma once

#include "batchpid/native/make_program.h"
#include "refresh.h"
#include "sim_step.h"

#pragma GCC visibility push(hidden)

namespace batchpid {

enum class StageKind : std::int32_t {
  PROGRAM, FORCE, INERTIA, MASS_MATRIX, CONTROLLER, TARGETS, CONSTRAINT, ENGINE
};

// Stage of a sim step.
struct FOR_PYTHON Stage {
  StageKind kind;
  std::int32_t program;   // number of a PROGRAM
  std::int32_t noise[2];  // its inputs that are noise of the sensors, or -1
  std::int64_t every;     // sim steps of a tick between two of this stage; 0: in the first one only
  double const *clock, *due;  // (robots, dof), equal in a row: a PROGRAM for robots whose clock is due in this sim step; or null
};

enum class TransferKind : std::int32_t { READ, WRITE_FLOATS, WRITE_BYTES };

// Copy between a row, which is the same in every tick, and a table with an entry for each tick.
struct FOR_PYTHON Transfer {
  char *table;          // double to READ, float to WRITE_FLOATS
  char *row;            // double, except to WRITE_BYTES
  std::int64_t stride;  // of the table's ticks [bytes]; 0: each tick overwrites the one before
  std::int64_t size;    // numbers of the table, or bytes
  std::int64_t step;    // of the row, from a number to WRITE_FLOATS to the next one [numbers]
  TransferKind kind;
};

// Place in ticks: a tick, and the sim steps of it that are done.
struct FOR_PYTHON Place {
  std::int64_t tick, step;
};

// Arrays (robots, dof) of double, which Python owns.
struct FOR_PYTHON Tick {
  Stage const *stages;
  Transfer const *transfers;      // of commands and observations
  double *qpos, *qvel, *passive;  // reading, before and after each sim step
  double *before;                 // positions before the last sim step
  double const *pose, *rate;      // state for the mass matrix and FORCE: the reading, or as the sensors measure it
  double const *qf;               // an output of a program
  std::int32_t const *tree;       // (dof, 2), of the description
  double const *bodies;           // (dof, 25)
  double const *armature;         // (dof,), or null
  double const *damping;          // (dof,), or null
  Coupling coupling;
  double *matrix;                 // (robots, dof, dof), or null
  Call const *control;            // native controller, whose effort is an input of a program, or null
  Model const *measured_force;    // of the passive force at the measured state, or null
  Model const *read_force;        // of the passive force at the reading after a sim step, or null
  Refresh const *refresh;         // of the friction model's inertia, or null
  double *gain, *memory;          // of the friction model
  std::int64_t *age;              // (robots,)
  double const *target, *target_rate;  // outputs of a program: targets of drives, or null; the rate may be null for 0
  double *base_pose, *base_twist;  // (robots, 7) and (robots, 6) in MuJoCo after a tick, or null
  double *left;                   // time from the moment of the law's setpoint to the end of the tick [s], or null
  double const *noise[2];         // (steps, robots, dof): noise of the sensors in the next steps, or null
  Group *group;                   // the robots
  double timestep;
  std::int64_t dof, stage_count, transfer_count;
  Place place;                    // where the ticks are
  std::int64_t drawn;             // sim steps that the noise is for; -1 without noise
  std::int64_t ran;               // sim steps that ran
  std::int32_t matrix_steps;
  std::int32_t gravity, coriolis;  // parts of the passive force
  std::int32_t late;              // the law takes its setpoint at the end of a sim step
  std::int32_t status;            // of the last sim step
};

// A program with its arrays.
struct BoundProgram {
  static constexpr char CAPSULE[] = "batchpid.bound_program";

  std::unique_ptr<Program> program;
  std::vector<Input> inputs;
  std::vector<Output> outputs;
};

// The programs and arrays of a group's ticks.
struct BoundTicks {
  static constexpr char CAPSULE[] = "batchpid.bound_ticks";

  std::vector<BoundProgram *> programs;
  Tick *tick;
};

// Write M + armature + dt B of each robot, at the pose half way through the next `steps` sim steps.
inline void write_matrices(Tick const &tick, std::int64_t robots, std::int64_t steps) {
  auto const n = static_cast<std::size_t>(tick.dof);
  double *found = tick.matrix;
  double const ahead = 0.5 * static_cast<double>(steps - 1) * tick.timestep;
  write_mass_matrices(tick.dof, tick.tree, tick.bodies, robots, tick.pose, tick.rate, ahead, found);
  for (std::int64_t row = 0; row < robots; ++row, found += n * n) {
    for (std::size_t j = 0; j < n; ++j) {
      double &entry = found[j * n + j];
      if (tick.armature != nullptr) entry += tick.armature[j];
      if (tick.damping != nullptr) entry += tick.timestep * tick.damping[j];
    }
    tick.coupling.fold(n, found);
  }
}

// Run a stage of sim step `step` in a tick of `end` steps, `at` steps after the first that tick.noise is for. Return the
// status of the engine.
inline std::int32_t run_stage(Stage const &stage, BoundProgram *const *programs, Tick const &tick, Group &group,
                              std::int64_t step, std::int64_t end, std::int64_t at) {
  auto const robots = group.robots;
  Parts const parts{tick.gravity != 0, tick.coriolis != 0};
  switch (stage.kind) {
    case StageKind::PROGRAM: {
      BoundProgram &bound = *programs[stage.program];
      for (int i = 0; i < 2; ++i) {
        if (stage.noise[i] < 0) continue;
        bound.inputs[static_cast<std::size_t>(stage.noise[i])].data = tick.noise[i] + at * robots * tick.dof;
      }
      auto const is_due = [&](std::int64_t row) {
        return stage.clock[row * tick.dof] + tick.timestep >= stage.due[row * tick.dof];
      };
      for (std::int64_t row = 0, end = robots; row < robots; row = end, end = robots) {
        if (stage.clock != nullptr) {
          while (row < robots && !is_due(row)) ++row;
          for (end = row; end < robots && is_due(end);) ++end;
        }
        if (row < end) run(*bound.program, bound.inputs.data(), bound.outputs.data(), row, end - row);
      }
      return 0;
    }
    case StageKind::FORCE:
      write_force(group, *tick.measured_force, parts, tick.pose, tick.rate, tick.passive);
      return 0;
    case StageKind::INERTIA:
      refresh(*tick.refresh, robots, tick.qpos, tick.gain, tick.memory, tick.age);
      return 0;
    case StageKind::MASS_MATRIX:
      write_matrices(tick, robots, std::min<std::int64_t>(tick.matrix_steps, end - step));
      return 0;
    case StageKind::CONTROLLER:
      tick.control->run(*tick.control);
      return 0;
    case StageKind::TARGETS:
      write_targets(group, tick.target, tick.target_rate);
      return 0;
    case StageKind::CONSTRAINT:
      if (group.constraint != nullptr) update_constraint(group, tick.qpos, tick.qvel);
      return 0;
    case StageKind::ENGINE: {
      std::memcpy(tick.before, tick.qpos, static_cast<std::size_t>(robots * tick.dof) * sizeof(double));
      std::int32_t const status = try_sim_step(group, tick.qf, tick.qpos, tick.qvel, tick.passive);
      if (tick.read_force != nullptr) write_force(group, *tick.read_force, parts, tick.qpos, tick.qvel, tick.passive);
      return status;
    }
  }
  return 0;
}

// Whether all are finite.
inline bool are_finite(double const *values, std::int64_t size) {
  double sum = 0.0;
  for (std::int64_t i = 0; i < size; ++i) sum += 0.0 * values[i];  // NaN for NaN and infinity
  return sum == 0.0;
}

// Read the commands of a tick. Return whether they are finite.
inline bool read_commands(Tick const &arrays, std::int64_t tick) {
  bool finite = true;
  for (Transfer const *each = arrays.transfers; each != arrays.transfers + arrays.transfer_count; ++each) {
    if (each->kind != TransferKind::READ) continue;
    std::memcpy(each->row, each->table + tick * each->stride, static_cast<std::size_t>(each->size) * sizeof(double));
    finite = finite && are_finite(reinterpret_cast<double const *>(each->row), each->size);
  }
  return finite;
}

// Write the observation of a tick.
inline void write_observation(Tick const &arrays, std::int64_t tick) {
  for (Transfer const *each = arrays.transfers; each != arrays.transfers + arrays.transfer_count; ++each) {
    char *table = each->table + tick * each->stride;
    if (each->kind == TransferKind::WRITE_BYTES) std::memcpy(table, each->row, static_cast<std::size_t>(each->size));
    if (each->kind != TransferKind::WRITE_FLOATS) continue;
    for (std::int64_t i = 0; i < each->size; ++i) {
      reinterpret_cast<float *>(table)[i] = static_cast<float>(reinterpret_cast<double const *>(each->row)[i * each->step]);
    }
  }
}

// Run sim steps in ticks of `steps` up to the tick `until`; return the status of the last one. Stop after a sim step whose
// status is not 0, or where the noise of the sensors is used up. With `whole`, commands and observations are those of the
// tables: stop also in a tick whose command is not finite, before its first step, and in one after which velocities are
// not finite. Without it, stop at the end of a tick.
inline std::int32_t run_ticks(BoundTicks const &bound, std::int64_t until, std::int64_t steps, bool whole) {
  Tick &tick = *bound.tick;
  Group &group = *tick.group;
  Place &place = tick.place;
  std::int64_t &done = tick.ran = 0;
  for (; place.tick < until; ++place.tick, place.step = 0) {
    if (whole && place.step == 0 && !read_commands(tick, place.tick)) return 0;
    for (std::int64_t const first = place.step; place.step < steps; ++done) {
      if (done == tick.drawn) return NO_NOISE;
      if (tick.left != nullptr) *tick.left = static_cast<double>(steps - place.step - tick.late) * tick.timestep;
      std::int32_t status = 0;
      for (Stage const *stage = tick.stages; stage != tick.stages + tick.stage_count; ++stage) {
        bool const due = stage->every > 0 ? place.step % stage->every == 0 : place.step == first;
        if (due) status |= run_stage(*stage, bound.programs.data(), tick, group, place.step, steps, done);
      }
      ++place.step;
      if (status != 0) return status;
    }
    if (!whole || !are_finite(tick.qvel, group.robots * group.dof)) return 0;
    if (tick.base_pose != nullptr && !write_base_states(group, tick.base_pose, tick.base_twist)) return 0;
    write_observation(tick, place.tick);
  }
  return 0;
}

}  // namespace batchpid

#pragma GCC visibility pop
