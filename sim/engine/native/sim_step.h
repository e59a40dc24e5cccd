// One sim step of a group of robots in one call: apply efforts, step, read, and check whether a robot has failed.

#pragma once

#include "constraint.h"
#include "gateway.h"
#include "mujoco_step.h"

namespace batchpid {

// Largest position of a robot that has not failed [rad or m].
constexpr double FARTHEST = 1e6;

// Reasons for which a loop over sim steps has to stop, as bits: STATUS in interface.py.
enum Status : std::int32_t { NOT_FINITE = 1, TOO_FAST = 2, FAILED = 4, NO_NOISE = 8, SENSE = 16 };

// Group of robots; Python fills in the fields (Group in interface.py) and owns what they point to.
struct Group {
  Gateway *gateway;
  float *qf;                         // (robots, dof), constraint efforts included
  char const *skip;                  // (robots,): efforts are not applied
  double const *speed_limit;         // (dof,), or null
  Mujoco const *mujoco;              // robots in MuJoCo, or null; then there is no gateway
  Constraint const *constraint;      // of coupled joints, or null
  Joint *const *joints;              // (robots, dof): in SAPIEN, or null without targets of drives that move
  std::int64_t robots, dof;
  std::int32_t gravity, coriolis;    // parts of the passive force; without both it is zero
  std::int32_t senses;               // whether Python reads sensors after each sim step
  char message[256];                 // of an exception of the engine
};

inline void copy_row(VectorXf const &from, double *to, std::ptrdiff_t dof) {
  if (from.size != dof) throw std::bad_exception();
  for (std::ptrdiff_t joint = 0; joint < dof; ++joint) to[joint] = from.data[joint];
}

// Add the constraint efforts of a robot in SAPIEN to qf (dof).
inline void constrain_row(Group const &group, std::size_t row, float *qf) {
  Gateway const &gateway = *group.gateway;
  auto const at = static_cast<std::int64_t>(row), dof = group.dof;
  VectorXf const qpos = gateway.functions.get_qpos(gateway.robots[row]);
  VectorXf const qvel = gateway.functions.get_qvel(gateway.robots[row]);
  if (qpos.size != dof || qvel.size != dof) throw std::bad_exception();
  thread_local std::vector<double> effort;
  effort.assign(qf, qf + dof);
  std::copy(qf, qf + dof, group.constraint->asked + at * dof);
  constrain(
      *group.constraint, at, dof, effort.data(), [&](std::int64_t j) { return static_cast<double>(qpos.data[j]); },
      [&](std::int64_t j) { return static_cast<double>(qvel.data[j]); });
  for (std::int64_t j = 0; j < dof; ++j) qf[j] = static_cast<float>(effort[static_cast<std::size_t>(j)]);
}

// One sim step of the robots in SAPIEN: apply efforts and read (robots, dof) each, robot by robot, each while it is in the
// cache.
inline void step_in_sapien(Group const &group, double const *effort, double *qpos, double *qvel, double *passive) {
  Gateway const &gateway = *group.gateway;
  Functions const &call = gateway.functions;
  std::ptrdiff_t const dof = gateway.dof, all = group.robots * dof;
  bool const bears = group.gravity != 0 || group.coriolis != 0;
  for (std::size_t row = 0; row < gateway.robots.size(); ++row) {
    Articulation *robot = gateway.robots[row];
    std::ptrdiff_t const at = static_cast<std::ptrdiff_t>(row) * dof;
    float *qf = group.qf + at;
    for (std::ptrdiff_t joint = 0; joint < dof; ++joint) qf[joint] = static_cast<float>(effort[at + joint]);
    if (group.constraint != nullptr) constrain_row(group, row, qf);
    if (!group.skip[row]) apply(call, robot, qf, dof);
    call.step(gateway.systems[row]);
    copy_row(call.get_qpos(robot), qpos + at, dof);
    copy_row(call.get_qvel(robot), qvel + at, dof);
    if (bears) {
      copy_row(call.compute_passive_force(robot, group.gravity != 0, group.coriolis != 0), passive + at, dof);
    }
  }
  if (!bears) std::fill_n(passive, all, 0.0);
}

// Apply the efforts of a robot in MuJoCo, and those of its constraint.
inline void apply_efforts(Group const &group, std::int64_t row) {
  Mujoco const &mujoco = *group.mujoco;
  double const *qpos = mujoco.qpos[row], *qvel = mujoco.qvel[row];
  thread_local std::vector<double> effort;
  effort.assign(mujoco.qf + row * group.dof, mujoco.qf + (row + 1) * group.dof);
  if (group.constraint != nullptr) {
    constrain(
        *group.constraint, row, group.dof, effort.data(), [&](std::int64_t j) { return qpos[mujoco.qpos_at[j]]; },
        [&](std::int64_t j) { return qvel[mujoco.qvel_at[j]]; });
  }
  for (std::int64_t j = 0; j < group.dof; ++j) {
    mujoco.applied[row][mujoco.qvel_at[j]] = effort[static_cast<std::size_t>(j)];
  }
}

// The same in MuJoCo. Return false, with a message, after an error of it.
inline bool step_in_mujoco(Group &group, double const *effort, double *qpos, double *qvel, double *passive) {
  Mujoco const &mujoco = *group.mujoco;
  std::int64_t const dof = group.dof;
  bool good = true;
  StoppedClock const stopped(mujoco.clock);
  LogHandler const before = mujoco.set_log_handler(Messages::handle);
  if (before != Messages::handle) Messages::previous = before;
  for (std::int64_t row = 0; row < group.robots && good; ++row) {
    std::int64_t const at = row * dof;
    for (std::int64_t joint = 0; joint < dof; ++joint) mujoco.qf[at + joint] = static_cast<double>(effort[at + joint]);
    if (!group.skip[row]) apply_efforts(group, row);
    if (!group.skip[row]) good = advance(mujoco, row, dof, FARTHEST, group.message);
    for (std::int64_t joint = 0; joint < dof; ++joint) {
      std::int64_t const place = mujoco.qvel_at[joint];
      qpos[at + joint] = mujoco.qpos[row][mujoco.qpos_at[joint]];
      qvel[at + joint] = mujoco.qvel[row][place];
      passive[at + joint] = group.gravity ? mujoco.bias[row][place] : 0.0;
    }
  }
  mujoco.set_log_handler(before);
  return good;
}

// Do one sim step in the engine of the group; rows beyond its robots repeat the first one. Return the status.
inline std::int32_t try_sim_step(Group &group, std::int64_t rows, double const *effort, double *qpos, double *qvel,
                                 double *passive) {
  auto const in_sapien = [&] { step_in_sapien(group, effort, qpos, qvel, passive); };
  bool const good = group.mujoco != nullptr ? step_in_mujoco(group, effort, qpos, qvel, passive)
                                            : succeeds(group.message, in_sapien);
  if (!good) return FAILED;
  std::int64_t const dof = group.dof;
  std::int32_t status = group.senses != 0 ? SENSE : 0;
  for (std::int64_t at = 0; at < group.robots * dof; ++at) {
    if (!(std::fabs(qpos[at]) <= FARTHEST)) status |= NOT_FINITE;
    if (group.speed_limit && !(std::fabs(qvel[at]) <= group.speed_limit[at % dof])) status |= TOO_FAST;
  }
  for (std::int64_t row = group.robots; row < rows; ++row) {
    for (double *table : {qpos, qvel, passive}) std::copy_n(table, dof, table + row * dof);
  }
  return status;
}

// Set the targets of the drives (robots, dof): write_drive_target of the packs. Without `rate` it is 0.
inline void write_targets(Group const &group, double const *target, double const *rate) {
  std::int64_t const dof = group.dof;
  for (std::int64_t at = 0; at < group.robots * dof; ++at) {
    double const speed = rate == nullptr ? 0.0 : rate[at];
    if (group.mujoco == nullptr) {
      Functions const &call = group.gateway->functions;
      call.set_drive_position(group.joints[at], static_cast<float>(target[at]));
      call.set_drive_velocity(group.joints[at], static_cast<float>(speed));
      continue;
    }
    Mujoco const &mujoco = *group.mujoco;
    mujoco.ctrl[at / dof][at % dof] = mujoco.stiffness[at] * target[at] + mujoco.rate_gain[at] * speed;
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
      Functions const &call = group.gateway->functions;
      Articulation *robot = group.gateway->robots[static_cast<std::size_t>(row)];
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
  if (force != nullptr) write_force(group, *force, {true, true}, qpos, qvel, passive.data());
  for (std::int64_t row = 0; row < group.robots && force == nullptr; ++row) {
    double *own = passive.data() + row * dof;
    if (group.mujoco == nullptr) {
      Gateway const &gateway = *group.gateway;
      copy_row(gateway.functions.compute_passive_force(gateway.robots[static_cast<std::size_t>(row)], true, true), own,
               dof);
      continue;
    }
    for (std::int64_t j = 0; j < dof; ++j) own[j] = group.mujoco->bias[row][group.mujoco->qvel_at[j]];
  }
  update_constraint(*group.constraint, group.robots, qpos, passive.data(), nullptr);
}

}  // namespace batchpid
