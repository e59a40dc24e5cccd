// One sim step of a group of robots in one call: apply efforts, step, read, and check whether a robot has failed.

#pragma once

#include "constraint.h"
#include "gateway.h"
#include "mujoco_step.h"

namespace batchpid {

// Largest position of a robot that has not failed [rad or m].
constexpr double FARTHEST = 1e6;

// Reasons for which a loop over sim steps has to stop, as bits.
enum Status : std::int32_t { NOT_FINITE = 1, FAILED = 2, NO_NOISE = 4 };

// Group of robots; Python fills in the fields and owns what they point to.
struct FOR_PYTHON Group {
  Functions const *functions;        // of SAPIEN
  Articulation *const *articulations;  // (robots,): in SAPIEN
  System *const *systems;            // (robots,): of each robot
  float *qf;                         // (robots, dof), constraint efforts included
  char const *skip;                  // (robots,): efforts are not applied
  Mujoco const *mujoco;              // robots in MuJoCo, or null
  Constraint const *constraint;      // of coupled joints, or null
  Joint *const *joints;              // (robots, dof): in SAPIEN, or null without targets of drives that move
  FreeMotion const *lanes;           // robots without an engine, or null
  std::int64_t robots, dof;
  std::int32_t gravity, coriolis;    // parts of the passive force; without both it is zero
  char message[256];                 // of an exception of the engine
};

inline void copy_row(VectorXf const &from, double *to, std::ptrdiff_t dof) {
  if (from.size != dof) throw std::bad_exception();
  for (std::ptrdiff_t joint = 0; joint < dof; ++joint) to[joint] = from.data[joint];
}

// Add the constraint efforts of a robot in SAPIEN to qf (dof).
inline void constrain_row(Group const &group, std::int64_t row, float *qf) {
  std::int64_t const dof = group.dof;
  VectorXf const qpos = group.functions->get_qpos(group.articulations[row]);
  VectorXf const qvel = group.functions->get_qvel(group.articulations[row]);
  if (qpos.size != dof || qvel.size != dof) throw std::bad_exception();
  thread_local std::vector<double> effort;
  effort.assign(qf, qf + dof);
  std::copy(qf, qf + dof, group.constraint->asked + row * dof);
  constrain(
      *group.constraint, row, dof, effort.data(), [&](std::int64_t j) { return static_cast<double>(qpos.data[j]); },
      [&](std::int64_t j) { return static_cast<double>(qvel.data[j]); });
  for (std::int64_t j = 0; j < dof; ++j) qf[j] = static_cast<float>(effort[static_cast<std::size_t>(j)]);
}

// One sim step of the robots in SAPIEN: apply efforts and read (robots, dof) each, robot by robot, each while it is in the
// cache.
inline void step_in_sapien(Group const &group, double const *effort, double *qpos, double *qvel, double *passive) {
  Functions const &call = *group.functions;
  std::int64_t const dof = group.dof;
  bool const bears = group.gravity != 0 || group.coriolis != 0;
  for (std::int64_t row = 0; row < group.robots; ++row) {
    Articulation *robot = group.articulations[row];
    std::int64_t const at = row * dof;
    float *qf = group.qf + at;
    for (std::int64_t joint = 0; joint < dof; ++joint) qf[joint] = static_cast<float>(effort[at + joint]);
    if (group.constraint != nullptr) constrain_row(group, row, qf);
    if (!group.skip[row]) apply(call, robot, qf, dof);
    call.step(group.systems[row]);
    copy_row(call.get_qpos(robot), qpos + at, dof);
    copy_row(call.get_qvel(robot), qvel + at, dof);
    if (bears) {
      copy_row(call.compute_passive_force(robot, group.gravity != 0, group.coriolis != 0), passive + at, dof);
    }
  }
  if (!bears) std::fill_n(passive, group.robots * dof, 0.0);
}

// Robots of a block, and which of them a sim step moves.
struct Block {
  std::int64_t number, first, end;
  bool moves[WIDTH];

  Block(Group const &group, std::int64_t number)
      : number(number), first(number * WIDTH), end(std::min(first + WIDTH, group.robots)) {
    for (std::int64_t row = first; row < end; ++row) moves[row - first] = group.skip[row] == 0;
  }
};

// Return the efforts (dof,) of a robot in MuJoCo with those of its constraint.
inline double const *joint_efforts(Group const &group, std::int64_t row) {
  Mujoco const &mujoco = *group.mujoco;
  thread_local std::vector<double> effort;
  effort.assign(mujoco.qf + row * group.dof, mujoco.qf + (row + 1) * group.dof);
  if (group.constraint == nullptr) return effort.data();
  FreeMotion const *free = mujoco.free;
  std::int64_t const at = row / WIDTH * group.dof, k = row % WIDTH;
  auto const position = [&](std::int64_t j) {
    return free != nullptr ? free->qpos[at + j].of[k] : mujoco.qpos[row][mujoco.qpos_at[j]];
  };
  auto const velocity = [&](std::int64_t j) {
    return free != nullptr ? free->qvel[at + j].of[k] : mujoco.qvel[row][mujoco.qvel_at[j]];
  };
  constrain(*group.constraint, row, group.dof, effort.data(), position, velocity);
  return effort.data();
}

// Do mj_step2 of a robot under its efforts.
inline bool step_with_solver(Group &group, std::int64_t row) {
  Mujoco const &mujoco = *group.mujoco;
  double const *effort = joint_efforts(group, row);
  for (std::int64_t j = 0; j < group.dof; ++j) mujoco.applied[row][mujoco.qvel_at[j]] = effort[j];
  return advance(mujoco, row, group.message);
}

// Do mj_step1 of the robots of a block that need it at positions (dof,): all that may touch something, and without
// FreeMotion all. A robot that has diverged keeps its state, without mj_step1.
inline bool look_for_contacts(Group &group, Block const &block, Lanes const *qpos) {
  Mujoco const &mujoco = *group.mujoco;
  Clearance const *clearance = mujoco.clearance;
  FreeMotion const *free = mujoco.free;
  Holding holding;
  if (clearance != nullptr) {
    Lanes base[2];
    for (std::int64_t row = block.first; clearance->poses != nullptr && row < block.end; ++row) {
      double moved[2] = {};
      if (block.moves[row - block.first]) add_base_motion(mujoco.qpos[row], clearance->poses + 7 * row, moved);
      for (int i = 0; i < 2; ++i) base[i].of[row - block.first] = moved[i];
    }
    add_motion(*clearance, block.number, qpos, clearance->poses == nullptr ? nullptr : base, holding);
  }
  for (std::int64_t row = block.first; row < block.end; ++row) {
    std::int64_t const k = row - block.first;
    if (!block.moves[k]) continue;
    Looked looked = Looked::ALL;
    if (free != nullptr) {
      free->contact[row] = Contact::NONE;
      if (free->has_pairs == 0) continue;
    }
    if (clearance != nullptr) {
      looked = looked_at(*clearance, row, holding, [&] {
        if (free != nullptr) write_to_mujoco(mujoco, row);
        clearance->kinematics(clearance->models[row], mujoco.data[row]);
      });
    }
    if (free != nullptr && looked == Looked::NONE) continue;
    bool near = true;
    for (std::int64_t j = 0; j < group.dof; ++j) near = near && std::fabs(qpos[j].of[k]) <= FARTHEST;
    if (!near) continue;
    if (free != nullptr) write_to_mujoco(mujoco, row);
    if (!prepare(mujoco, row, looked, group.message)) return false;
    if (free != nullptr && *mujoco.contacts[row] > 0) free->contact[row] = Contact::SOME;
  }
  return true;
}

// Do a sim step of a block of robots in MuJoCo that has no FreeMotion.
inline bool step_block(Group &group, Block const &block, double *qpos, double *qvel, double *passive) {
  Mujoco const &mujoco = *group.mujoco;
  std::int64_t const dof = group.dof;
  thread_local std::vector<Lanes> places;
  places.resize(static_cast<std::size_t>(dof));
  bool good = true;
  for (std::int64_t row = block.first; row < block.end && good; ++row) {
    if (block.moves[row - block.first]) good = step_with_solver(group, row);
    for (std::int64_t j = 0; j < dof; ++j) {
      places[j].of[row - block.first] = qpos[row * dof + j] = mujoco.qpos[row][mujoco.qpos_at[j]];
      qvel[row * dof + j] = mujoco.qvel[row][mujoco.qvel_at[j]];
    }
  }
  good = good && look_for_contacts(group, block, places.data());
  for (std::int64_t row = block.first; row < block.end; ++row) {
    for (std::int64_t j = 0; j < dof; ++j) {
      passive[row * dof + j] = group.gravity ? mujoco.bias[row][mujoco.qvel_at[j]] : 0.0;
    }
  }
  return good;
}

// Do a sim step of a block of robots of which those without contact do not need MuJoCo.
inline bool step_block_freely(Group &group, FreeRoom &room, Block const &block, double *qpos, double *qvel,
                              double *passive) {
  Mujoco const &mujoco = *group.mujoco;
  FreeMotion const &free = *mujoco.free;
  std::int64_t const dof = group.dof, at = block.number * dof;
  Block unknown = block;
  bool written = false, is_free = false, good = true;
  for (std::int64_t row = block.first; row < block.end; ++row) {
    bool &own = unknown.moves[row - block.first];
    own = own && free.contact[row] == Contact::UNKNOWN;
    written = written || own;
  }
  if (written) {
    evaluate(free, block.number, room);
    if (!look_for_contacts(group, unknown, free.qpos + at)) return false;
  }
  Lanes mask{};
  for (std::int64_t row = block.first; row < block.end; ++row) {
    std::int64_t const k = row - block.first;
    if (!block.moves[k]) continue;
    free.time[row] += free.timestep;
    bool const own = free.contact[row] == Contact::NONE;
    is_free = is_free || own;
    mask.of[k] = own ? 1.0 : 0.0;
    if (own && group.constraint != nullptr) std::copy_n(joint_efforts(group, row), dof, room.efforts.data() + k * dof);
  }
  Lanes stepped = mask;
  bool const is_asked = group.constraint == nullptr;
  Efforts const efforts = is_asked ? Efforts{mujoco.qf, block.first, group.robots} : Efforts{room.efforts.data(), 0, WIDTH};
  bool const solved = !is_free || advance_freely(free, block.number, efforts, room, stepped);
  for (std::int64_t row = block.first; row < block.end && good; ++row) {
    std::int64_t const k = row - block.first;
    if (!block.moves[k] || stepped.of[k] > 0.0) continue;
    if (!solved && mask.of[k] > 0.0) {
      write_to_mujoco(mujoco, row);
      good = prepare(mujoco, row, Looked::ALL, group.message);
    }
    good = good && step_with_solver(group, row);
    if (good) read_from_mujoco(mujoco, row);
  }
  if (!good) return false;
  evaluate(free, block.number, room);
  good = look_for_contacts(group, block, free.qpos + at);
  for (std::int64_t row = block.first; row < block.end; ++row) {
    std::int64_t const k = row - block.first;
    for (std::int64_t j = 0; j < dof; ++j) qpos[row * dof + j] = free.qpos[at + j].of[k];
    for (std::int64_t j = 0; j < dof; ++j) qvel[row * dof + j] = free.qvel[at + j].of[k];
    for (std::int64_t j = 0; j < dof; ++j) passive[row * dof + j] = group.gravity ? free.bias[at + j].of[k] : 0.0;
  }
  return good;
}

// The same for the robots in MuJoCo. Return false, with a message, after an error of it.
inline bool step_in_mujoco(Group &group, double const *effort, double *qpos, double *qvel, double *passive) {
  Mujoco const &mujoco = *group.mujoco;
  FreeRoom *room = mujoco.free == nullptr ? nullptr : &FreeRoom::of(group.dof);
  bool good = true;
  StoppedClock const stopped(mujoco.clock);
  LogHandler const before = mujoco.set_log_handler(Messages::handle);
  if (before != Messages::handle) Messages::previous = before;
  std::copy(effort, effort + group.robots * group.dof, mujoco.qf);
  for (std::int64_t number = 0; number * WIDTH < group.robots && good; ++number) {
    Block const block(group, number);
    good = room != nullptr ? step_block_freely(group, *room, block, qpos, qvel, passive)
                           : step_block(group, block, qpos, qvel, passive);
  }
  mujoco.set_log_handler(before);
  return good;
}

// Do a sim step of robots that have no engine. A robot that has diverged rests where it is.
inline void step_in_lanes(FreeMotion const &lanes, double const *effort, double *qpos, double *qvel) {
  std::int64_t const dof = lanes.model->dof;
  FreeRoom &room = FreeRoom::of(dof);
  for (std::int64_t number = 0; number * WIDTH < lanes.robots; ++number) {
    std::int64_t const first = number * WIDTH;
    Lanes all = 1.0;
    evaluate(lanes, number, room);
    advance_freely(lanes, number, Efforts{effort, first, lanes.robots}, room, all);
    for (std::int64_t at = number * dof, j = 0; j < dof; ++j, ++at) {
      Lanes const near = below_mask(absolute(lanes.qpos[at]), FARTHEST);  // 0 for NaN
      lanes.qpos[at] = where_positive(near, lanes.qpos[at], FARTHEST);
      lanes.qvel[at] = where_positive(near, lanes.qvel[at], 0.0);
      scatter(lanes.qpos[at], qpos, dof, j, first, lanes.robots);
      scatter(lanes.qvel[at], qvel, dof, j, first, lanes.robots);
    }
  }
}

// Do one sim step in the engine of the group, on arrays (robots, dof). Return the status.
inline std::int32_t try_sim_step(Group &group, double const *effort, double *qpos, double *qvel, double *passive) {
  if (group.lanes != nullptr) {
    step_in_lanes(*group.lanes, effort, qpos, qvel);
    return 0;
  }
  auto const in_sapien = [&] { step_in_sapien(group, effort, qpos, qvel, passive); };
  bool const good = group.mujoco != nullptr ? step_in_mujoco(group, effort, qpos, qvel, passive)
                                            : succeeds(group.message, in_sapien);
  if (!good) return FAILED;
  std::int64_t const dof = group.dof;
  std::int32_t status = 0;
  std::int64_t far = 0;  // counted, since a loop without branches is of vectors
  for (std::int64_t at = 0; at < group.robots * dof; ++at) far += !(std::fabs(qpos[at]) <= FARTHEST);
  if (far != 0) status |= NOT_FINITE;
  return status;
}

// Set the targets of the drives (robots, dof): write_drive_target of the packs. Without `rate` it is 0.
inline void write_targets(Group const &group, double const *target, double const *rate) {
  std::int64_t const dof = group.dof;
  for (std::int64_t at = 0; at < group.robots * dof; ++at) {
    double const speed = rate == nullptr ? 0.0 : rate[at];
    if (group.mujoco == nullptr) {
      Functions const &call = *group.functions;
      call.set_drive_position(group.joints[at], static_cast<float>(target[at]));
      call.set_drive_velocity(group.joints[at], static_cast<float>(speed));
      continue;
    }
    Mujoco const &mujoco = *group.mujoco;
    double &ctrl = mujoco.free != nullptr ? mujoco.free->ctrl[at] : mujoco.ctrl[at / dof][at % dof];
    ctrl = mujoco.stiffness[at] * target[at] + mujoco.rate_gain[at] * speed;
  }
}

// Write R^T v for the rotation R of a quaternion (w, x, y, z), as unrotate in task_space/frames.py.
inline void turn_back(double const *q, double const *v, double *out) {
  double const w = q[0], x = q[1], y = q[2], z = q[3], s = 2 / (w * w + x * x + y * y + z * z);
  double const rows[3][3] = {{1 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)},
                             {s * (x * y - w * z), 1 - s * (x * x + z * z), s * (y * z + w * x)},
                             {s * (x * z + w * y), s * (y * z - w * x), 1 - s * (x * x + y * y)}};
  for (int i = 0; i < 3; ++i) out[i] = rows[i][0] * v[0] + rows[i][1] * v[1] + rows[i][2] * v[2];
}

// Write poses (robots, 7) and twists (robots, 6) of floating bases in MuJoCo, as read_base in mujoco_pack.py. Return
// whether all are finite, and not too far.
inline bool write_base_states(Group const &group, double *pose, double *twist) {
  bool near = true;
  for (std::int64_t row = 0; row < group.robots; ++row, pose += 7, twist += 6) {
    double const *qvel = group.mujoco->qvel[row] + group.mujoco->base_qvel;
    std::copy_n(group.mujoco->qpos[row] + group.mujoco->base_qpos, 7, pose);
    std::copy_n(qvel, 3, twist);
    double const back[4] = {pose[3], -pose[4], -pose[5], -pose[6]};
    turn_back(back, qvel + 3, twist + 3);
    for (int i = 0; i < 7; ++i) near = near && std::fabs(pose[i]) <= FARTHEST;
    for (int i = 0; i < 6; ++i) near = near && std::fabs(twist[i]) <= FARTHEST;
  }
  return near;
}

// Write gravity and the rates at which bases turn, in their own axes (robots, BASE_SIZE).
inline void write_bases(Group const &group, double const *gravity, double *out) {
  for (std::int64_t row = 0; row < group.robots; ++row, out += BASE_SIZE) {
    double q[4], turning[3];
    if (group.mujoco != nullptr) {
      std::copy_n(group.mujoco->qpos[row] + group.mujoco->base_qpos + 3, 4, q);
      std::copy_n(group.mujoco->qvel[row] + group.mujoco->base_qvel + 3, 3, turning);
    } else {
      Functions const &call = *group.functions;
      Articulation *robot = group.articulations[row];
      RootPose const pose = call.get_root_pose(robot);
      Vec3 const rate = call.get_root_angular_velocity(robot);
      std::copy_n(pose.wxyz, 4, q);
      double const world[3] = {rate.x, rate.y, rate.z};
      turn_back(q, world, turning);
    }
    turn_back(q, gravity, out);
    std::copy_n(turning, 3, out + 3);
  }
}

// Write a part of the passive force (robots, dof) of a model at a state of the robots.
inline void write_force(Group const &group, Model const &model, Parts parts, double const *qpos, double const *qvel,
                        double *out) {
  thread_local std::vector<double> bases;
  bases.resize(static_cast<std::size_t>(BASE_SIZE * group.robots));
  if (model.base != Base::FIXED) write_bases(group, model.gravity, bases.data());
  write_forces(model, parts, group.robots, qpos, qvel, bases.data(), out);
}

// Give the constraint efforts the present mass matrices and passive forces; qpos and qvel (robots, dof) are the present.
inline void update_constraint(Group const &group, double const *qpos, double const *qvel) {
  thread_local std::vector<double> passive;
  std::int64_t const dof = group.dof;
  passive.resize(static_cast<std::size_t>(group.robots * dof));
  Model const *force = group.constraint->force;
  FreeMotion const *free = group.mujoco != nullptr ? group.mujoco->free : nullptr;
  if (free != nullptr) evaluate_written(*free);
  if (force != nullptr) write_force(group, *force, {true, true}, qpos, qvel, passive.data());
  for (std::int64_t row = 0; row < group.robots && force == nullptr; ++row) {
    double *own = passive.data() + row * dof;
    if (group.mujoco == nullptr) {
      copy_row(group.functions->compute_passive_force(group.articulations[row], true, true), own, dof);
      continue;
    }
    for (std::int64_t j = 0; j < dof; ++j) {
      own[j] = free != nullptr ? free->bias[row / WIDTH * dof + j].of[row % WIDTH]
                               : group.mujoco->bias[row][group.mujoco->qvel_at[j]];
    }
  }
  update_constraint(*group.constraint, group.robots, qpos, passive.data(), nullptr, free == nullptr ? nullptr : free->mass);
}

}  // namespace batchpid
