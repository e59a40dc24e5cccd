// Sim steps of robots without contact on fixed bases, WIDTH robots at once: MuJoCo's step, without its constraint solver.
//
// Velocities follow from M a = effort - bias by the factor of the mass matrix along the tree (R. Featherstone, Rigid Body
// Dynamics Algorithms, Springer, 2008, section 6.5), and positions from the new velocities. MuJoCo makes joint limits
// soft: it minimizes the sum of (a - a_free)^T M (a - a_free) / 2 and D_j min(0, s_j a_j - r_j)^2 / 2 over the joints
// beyond a limit ("Computation" in MuJoCo's documentation). The Hessian is M plus a diagonal, so Newton steps on the set
// of active limits find the minimum. Drives then act at the new velocities, as in MuJoCo's integrator "implicitfast": a
// solves (M + dt D) a = f for the sum f of all forces, where D has the rate gains of the drives within their limits.

#pragma once

#include "model.h"

#include <memory>

namespace batchpid {

// What is known about the contacts of a robot at its present state. UNKNOWN: its state was written from outside.
enum class Contact : char { NONE, SOME, UNKNOWN };

// Robots of a group. Python fills in the fields and owns the memory behind the pointers.
// The state is the truth for every robot, also for one in contact; mjData is working memory.
struct FOR_PYTHON FreeMotion {
  Model const *model;
  Lanes *qpos, *qvel, *acceleration;  // (blocks, dof)
  Lanes *bias;                        // (blocks, dof): gravity, Coriolis and centrifugal forces
  Lanes *mass;                        // (blocks, dof (dof + 1) / 2): lower triangles of the mass matrices
  Lanes const *armature, *weight;     // (blocks, dof): inertia of the motors, dof_invweight0 of MuJoCo
  Lanes const *gravity;               // (blocks, 3)
  double const *low, *high;           // (dof,): limits
  Contact *contact;                   // (robots,)
  double *time;                       // (robots,) [s]
  double *ctrl;                       // (robots, dof): inputs of the drives, or null without drives
  Lanes const *position_gain, *drive_rate_gain, *drive_limit;  // (blocks, dof): effort = ctrl + gains (q, q'), limited
  std::int64_t robots;
  double stiffness, rate_gain;        // of a limit's reference acceleration
  // Links whose wrenches are measured: the joint whose body carries each, or -1; (wrenches, dof): 1 for joints that hang
  // on it; (wrenches, 12): axes and position of its frame on that body; (robots, wrenches, 13): BodyInertia, there, of all
  // that moves with it; and (robots, sensed): sums of sensors over sim steps, which end with force and torque of each.
  std::int32_t const *carriers, *hanging;
  double const *frames, *carried;
  double *sums;
  std::int64_t wrenches, sensed;
  double least, most, width;          // impedance of limits: MuJoCo's solimp
  double timestep;
  std::int32_t has_pairs;             // whether shapes may touch
};

// Working memory for one block of robots.
struct FreeRoom {
  Posed posed;
  std::vector<BodyMotion<Lanes>> motions;
  std::vector<Lanes> effort, acceleration, inverse, factor, cost, push, sign, active, damping, rate;
  std::vector<double> efforts;  // (WIDTH, dof)

  explicit FreeRoom(std::int64_t dof) : posed(dof), motions(static_cast<std::size_t>(dof)) {
    auto const n = static_cast<std::size_t>(dof);
    for (auto *each : {&effort, &acceleration, &inverse, &cost, &push, &sign, &active, &damping, &rate}) each->resize(n);
    factor.resize(n * (n + 1) / 2);
    efforts.resize(WIDTH * n);
  }
  // Return the memory of this thread.
  static FreeRoom &of(std::int64_t dof) {
    static thread_local std::unique_ptr<FreeRoom> room;
    if (room == nullptr || static_cast<std::int64_t>(room->effort.size()) != dof) room = std::make_unique<FreeRoom>(dof);
    return *room;
  }
};

// Solve M x = x in place for a packed lower triangle, which becomes the factor L^T D L along the tree.
inline __attribute__((always_inline)) void solve_along_tree(Model const &model, Lanes *m, Lanes *inverse, Lanes *x) {
  std::int32_t const *tree = model.tree;
  auto const row = [&](std::int64_t i) { return m + i * (i + 1) / 2; };
  for (std::int64_t k = model.dof - 1; k >= 0; --k) {
    Lanes *own = row(k);
    inverse[k] = 1.0 / own[k];
    for (std::int64_t i = tree[2 * k]; i >= 0; i = tree[2 * i]) {
      Lanes const factor = own[i] * inverse[k];
      for (std::int64_t j = i; j >= 0; j = tree[2 * j]) row(i)[j] -= factor * own[j];
      own[i] = factor;
      x[i] -= factor * x[k];
    }
  }
  for (std::int64_t k = 0; k < model.dof; ++k) {
    x[k] = x[k] * inverse[k];
    for (std::int64_t i = tree[2 * k]; i >= 0; i = tree[2 * i]) x[k] -= row(k)[i] * x[i];
  }
}

// Set the motions of the bodies of a block at its state, with the wrenches that move them, for accelerations (dof,) of
// the joints, or null for none; return the motion of the base.
inline __attribute__((always_inline)) BodyMotion<Lanes> move(FreeMotion const &of, std::int64_t block, FreeRoom &room,
                                                             Lanes const *acceleration) {
  Model const &model = *of.model;
  std::int64_t const dof = model.dof;
  Lanes const *qpos = of.qpos + block * dof, *qvel = of.qvel + block * dof, *gravity = of.gravity + 3 * block;
  BodyMotion<Lanes> root{};
  root.moving_change = {-gravity[0], -gravity[1], -gravity[2]};
  room.posed.place(dof, model.tree, model.rows, qpos, [&](std::int64_t j, BodyState<Lanes> &body) {
    std::int32_t const above = model.tree[2 * j];
    bool const slides = model.tree[2 * j + 1] != 0;
    model.weigh(j, block * WIDTH, of.robots, body);
    BodyMotion<Lanes> motion = move_body(above < 0 ? root : room.motions[above], body, slides, qvel[j]);
    if (acceleration != nullptr) {
      motion.turning_change = motion.turning_change + acceleration[j] * turning(body, slides);
      motion.moving_change = motion.moving_change + acceleration[j] * body.moving;
    }
    motion.accelerate(body.inertia);
    room.motions[j] = motion;
  });
  return root;
}

// Write mass matrix and bias of a block at its state.
FOR_EACH_PROCESSOR static void evaluate(FreeMotion const &of, std::int64_t block, FreeRoom &room) {
  Model const &model = *of.model;
  std::int64_t const dof = model.dof;
  Lanes const *armature = of.armature + block * dof;
  Lanes *bias = of.bias + block * dof, *mass = of.mass + block * (dof * (dof + 1) / 2);
  Posed &posed = room.posed;
  move(of, block, room, nullptr);
  efforts_of_wrenches(dof, model.tree, posed.bodies.data(), room.motions.data(), bias);
  composite_mass_matrix(dof, model.tree, posed.bodies.data(), [&](std::int64_t i, std::int64_t j, Lanes product) {
    mass[j * (j + 1) / 2 + i] = product;
  });
  for (std::int64_t j = 0; j < dof; ++j) mass[j * (j + 3) / 2] += armature[j];
}

// Evaluate the blocks with a state that was written from outside.
inline void evaluate_written(FreeMotion const &of) {
  for (std::int64_t row = 0; row < of.robots; ++row) {
    if (of.contact[row] != Contact::UNKNOWN) continue;
    std::int64_t const block = row / WIDTH;
    evaluate(of, block, FreeRoom::of(of.model->dof));
    row = block * WIDTH + WIDTH - 1;
  }
}

// Replace the efforts of room.acceleration by accelerations, with the limits beyond which joints are. Return a mask of
// the robots whose active limits were not found.
inline __attribute__((always_inline)) Lanes solve_with_limits(FreeMotion const &of, std::int64_t block, FreeRoom &room) {
  constexpr int MOST_TURNS = 20;
  constexpr double LEAST_REGULARIZER = 1e-15;  // mjMINVAL
  Model const &model = *of.model;
  std::int64_t const dof = model.dof, size = dof * (dof + 1) / 2;
  Lanes const *qpos = of.qpos + block * dof, *qvel = of.qvel + block * dof, *weight = of.weight + block * dof;
  Lanes const *mass = of.mass + block * size;
  Lanes *a = room.acceleration.data(), *effort = room.effort.data(), *m = room.factor.data();
  for (std::int64_t j = 0; j < dof; ++j) {
    Lanes const below = qpos[j] - of.low[j], above = of.high[j] - qpos[j];
    Lanes const sign = room.sign[j] = below_mask(below, 0.0) - below_mask(above, 0.0);
    room.active[j] = sign * sign;
    effort[j] = a[j];
    if (!any_positive(room.active[j])) {
      room.cost[j] = room.push[j] = Lanes{};
      continue;
    }
    Lanes const distance = where_positive(sign, below, above), x = absolute(distance) * (1.0 / of.width);
    Lanes const late = 1.0 - x, curve = where_positive(x - 0.5, 1.0 - 2.0 * late * late, 2.0 * x * x);
    Lanes const impedance = where_positive(below_mask(x, 1.0), of.least + curve * (of.most - of.least), of.most);
    Lanes const regularizer = at_least((1.0 - impedance) / impedance * weight[j], LEAST_REGULARIZER);
    room.cost[j] = 1.0 / regularizer;
    room.push[j] = sign * (-of.rate_gain * sign * qvel[j] - of.stiffness * impedance * distance);
  }
  Lanes changed{};
  for (int turn = 0; turn < MOST_TURNS; ++turn) {
    std::copy(mass, mass + size, m);
    for (std::int64_t j = 0; j < dof; ++j) {
      Lanes const active = room.active[j];
      Lanes &diagonal = m[j * (j + 3) / 2];
      diagonal = where_positive(active, diagonal + room.cost[j], diagonal);
      a[j] = where_positive(active, effort[j] + room.cost[j] * room.push[j], effort[j]);
    }
    solve_along_tree(model, m, room.inverse.data(), a);
    changed = Lanes{};
    for (std::int64_t j = 0; j < dof; ++j) {
      Lanes const active = below_mask(room.sign[j] * (a[j] - room.push[j]), 0.0);
      changed += differs_mask(active, room.active[j]);
      room.active[j] = active;
    }
    if (!any_positive(changed)) break;
  }
  return changed;
}

// Efforts of WIDTH robots, from row `first` of a table (rows, dof) on.
struct Efforts {
  double const *table;
  std::int64_t first, rows;
};

// Return accelerations with drives at the new velocities, for the efforts room.rate and the forces of active limits.
inline __attribute__((always_inline)) Lanes const *solve_with_drives(FreeMotion const &of, std::int64_t block, FreeRoom &room,
                                                                     bool limited) {
  std::int64_t const dof = of.model->dof, size = dof * (dof + 1) / 2;
  std::copy_n(of.mass + block * size, size, room.factor.data());
  for (std::int64_t j = 0; j < dof; ++j) {
    room.factor[j * (j + 3) / 2] += room.damping[j];
    if (limited) room.rate[j] += room.active[j] * room.cost[j] * (room.push[j] - room.acceleration[j]);
  }
  solve_along_tree(*of.model, room.factor.data(), room.inverse.data(), room.rate.data());
  return room.rate.data();
}

// Add the wrenches on links of the robots of the mask `free`, under accelerations (dof,), to the sums.
FOR_EACH_PROCESSOR static void add_wrenches(FreeMotion const &of, std::int64_t block, FreeRoom &room, Lanes const *acceleration,
                                            Lanes free) {
  constexpr std::int64_t FRAME = 12, INERTIA = sizeof(BodyInertia<double>) / sizeof(double);
  std::int64_t const dof = of.model->dof, first = block * WIDTH;
  BodyMotion<Lanes> const root = move(of, block, room, acceleration);
  efforts_of_wrenches(dof, of.model->tree, room.posed.bodies.data(), room.motions.data(), room.inverse.data());
  for (std::int64_t i = 0; i < of.wrenches; ++i) {
    std::int32_t const carrier = of.carriers[i];
    double const *frame = of.frames + FRAME * i;
    BodyState<Lanes> body = carrier < 0 ? body_of_base<Lanes>() : room.posed.bodies[carrier];
    BodyMotion<Lanes> const &of_body = carrier < 0 ? root : room.motions[carrier];
    BodyMotion<Lanes> own{of_body.turning, of_body.moving, of_body.turning_change, of_body.moving_change, {}, {}};
    BodyInertia<Lanes> inertia;
    for (std::int64_t k = 0; k < INERTIA; ++k) {
      reinterpret_cast<Lanes *>(&inertia)[k] = gather(of.carried, of.wrenches * INERTIA, i * INERTIA + k, first, of.robots);
    }
    weigh(inertia, body);
    own.accelerate(body.inertia);
    for (std::int64_t j = 0; j < dof; ++j) {
      if (of.hanging[i * dof + j] == 0) continue;
      own.force = own.force + room.motions[j].force;
      own.torque = own.torque + room.motions[j].torque;
    }
    own.torque = own.torque - cross(body.origin + in_axes(body.axes, frame[9], frame[10], frame[11]), own.force);
    for (int axis = 0; axis < 3; ++axis) {
      Vector<Lanes> const along = in_axes(body.axes, frame[3 * axis], frame[3 * axis + 1], frame[3 * axis + 2]);
      Lanes const values[2] = {dot(along, own.force), dot(along, own.torque)};
      for (std::int64_t at = 0; at < 2 * WIDTH; ++at) {
        std::int64_t const k = at % WIDTH;
        if (!(free.of[k] > 0.0)) continue;
        of.sums[(first + k + 1) * of.sensed - 6 * (of.wrenches - i) + at / WIDTH * 3 + axis] += values[at / WIDTH].of[k];
      }
    }
  }
}

// Advance the robots of the mask `free`, which loses those whose limits were not solved. Return whether all were.
FOR_EACH_PROCESSOR static bool advance_freely(FreeMotion const &of, std::int64_t block, Efforts const &efforts,
                                              FreeRoom &room, Lanes &free) {
  std::int64_t const dof = of.model->dof;
  Lanes *qpos = of.qpos + block * dof, *qvel = of.qvel + block * dof, *before = of.acceleration + block * dof;
  Lanes const *bias = of.bias + block * dof;
  Lanes *a = room.acceleration.data(), beyond{};
  for (std::int64_t j = 0; j < dof; ++j) {
    a[j] = gather(efforts.table, dof, j, efforts.first, efforts.rows) - bias[j];
    beyond += below_mask(qpos[j], of.low[j]) + below_mask(of.high[j], qpos[j]);
    if (of.ctrl == nullptr) continue;
    std::int64_t const at = block * dof + j;
    Lanes const drive = of.position_gain[at] * qpos[j] + of.drive_rate_gain[at] * qvel[j], limit = of.drive_limit[at];
    Lanes const asked = gather(of.ctrl, dof, j, block * WIDTH, of.robots) + drive;
    room.damping[j] = where_positive(below_mask(absolute(asked), limit), -of.timestep * of.drive_rate_gain[at], 0.0);
    a[j] += at_most(at_least(asked, -limit), limit);
    room.rate[j] = a[j];
  }
  bool solved = true;
  Lanes const *change = a;
  if (any_positive(beyond)) {
    Lanes const unsolved = solve_with_limits(of, block, room);
    if (any_positive(free * unsolved)) solved = false, free = where_positive(unsolved, 0.0, free);
  } else {
    std::int64_t const size = dof * (dof + 1) / 2;
    Lanes *mass = of.mass + block * size;
    if (of.ctrl != nullptr) mass = std::copy_n(mass, size, room.factor.data()) - size;
    solve_along_tree(*of.model, mass, room.inverse.data(), a);
  }
  if (of.ctrl != nullptr) change = solve_with_drives(of, block, room, any_positive(beyond));
  if (of.wrenches > 0) add_wrenches(of, block, room, a, free);
  for (std::int64_t j = 0; j < dof; ++j) {
    Lanes const rate = qvel[j] + of.timestep * change[j], place = qpos[j] + of.timestep * rate;
    before[j] = where_positive(free, a[j], before[j]);
    qvel[j] = where_positive(free, rate, qvel[j]);
    qpos[j] = where_positive(free, place, qpos[j]);
  }
  return solved;
}

}  // namespace batchpid
