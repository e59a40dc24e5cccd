// Mass matrices and passive forces of many robots of one kind: batchpid/task_space/tree_quantities.py,
// which have the equations.

#pragma once

#include "batchpid/native/lanes.h"
#include "batchpid/native/rigid_body.h"

#include <vector>

namespace batchpid {

// Base of robots: fixed at the origin of the world; free to move; or held where it is, at the rate at which it turns.
enum class Base : std::int32_t { FIXED, FREE, HELD };

// Numbers of a base that is not fixed, in its own axes: gravity, and the rate at which it turns.
constexpr std::int64_t BASE_SIZE = 6;

// Robots of one kind that may differ in their masses; Python fills in the fields.
struct FOR_PYTHON Model {
  std::int32_t const *tree;  // (dof, 2): the joint above, or -1, and whether it slides
  double const *rows;        // (dof, 25); the places of the joints are used
  double const *inertias;    // (robots or 1, dof + 1, 13), of BodyInertia; the last is the base's
  double gravity[3];
  std::int64_t dof;
  std::int32_t varies;       // each robot has its own inertias
  Base base;

  // Weigh body j of robots `first` to `first + WIDTH`, at its frame.
  inline __attribute__((always_inline)) void weigh(std::int64_t j, std::int64_t first, std::int64_t robots,
                                                   BodyState<Lanes> &at) const {
    if (!varies) return batchpid::weigh(reinterpret_cast<BodyInertia<double> const *>(inertias)[j], at);
    constexpr std::int64_t NUMBERS = sizeof(BodyInertia<double>) / sizeof(double);
    BodyInertia<Lanes> own;
    auto *leaf = reinterpret_cast<Lanes *>(&own);
    for (std::int64_t k = 0; k < NUMBERS; ++k) {
      leaf[k] = gather(inertias, (dof + 1) * NUMBERS, j * NUMBERS + k, first, robots);
    }
    batchpid::weigh(own, at);
  }
};

// WIDTH robots at a pose.
struct Posed {
  std::vector<Lanes> qpos, qvel, cosine, sine;
  std::vector<BodyState<Lanes>> bodies;

  explicit Posed(std::int64_t dof) {
    for (auto *leaf : {&qpos, &qvel, &cosine, &sine}) leaf->resize(static_cast<std::size_t>(dof));
    bodies.resize(static_cast<std::size_t>(dof));
  }
  // Place the bodies, of rows (dof, 25), and call finish(j, body) for each: all at once, while it is in registers.
  template <class Finish>
  inline __attribute__((always_inline)) void place(std::int64_t dof, std::int32_t const *tree, double const *rows,
                                                   Lanes const *at, Finish finish) {
    static_assert(sizeof(BodyRow<double>) == 25 * sizeof(double));
    write_cosines(dof, at, cosine.data(), sine.data());
    BodyState<Lanes> const base = body_of_base<Lanes>();
    for (std::int64_t j = 0; j < dof; ++j) {
      auto const &row = reinterpret_cast<BodyRow<double> const *>(rows)[j];
      BodyState<Lanes> const &above = tree[2 * j] < 0 ? base : bodies[static_cast<std::size_t>(tree[2 * j])];
      BodyState<Lanes> body = place_body(above, row, tree[2 * j + 1] != 0, cosine[j], sine[j], at[j]);
      finish(j, body);
      bodies[j] = body;
    }
  }
  // Place and weigh the bodies of robots `first` to `first + WIDTH` of a model; return the inertia of their base.
  inline __attribute__((always_inline)) Inertia<Lanes> pose(Model const &of, std::int64_t first, std::int64_t robots,
                                                            double const *at) {
    for (std::int64_t j = 0; j < of.dof; ++j) qpos[j] = gather(at, of.dof, j, first, robots);
    auto const weigh = [&](std::int64_t j, BodyState<Lanes> &body) { of.weigh(j, first, robots, body); };
    place(of.dof, of.tree, of.rows, qpos.data(), weigh);
    BodyState<Lanes> base = body_of_base<Lanes>();
    weigh(of.dof, base);
    return base.inertia;
  }
};

// Base that floats, of WIDTH robots whose bodies have the inertias of all that their joints move. The joints show the
// Schur complement M_jj - M_jb M_bb^-1 M_bj = M_jj - Y^T D^-1 Y with L D L^T = M_bb, Y = L^-1 M_bj.
struct Floating {
  Lanes factor[36];            // L and D^-1: angular and linear momenta under angular and linear velocities
  std::vector<Lanes> couples;  // Y, (dof, 6)

  inline __attribute__((always_inline)) Floating(Model const &of, Posed const &posed, Inertia<Lanes> all)
      : couples(static_cast<std::size_t>(6 * of.dof)) {
    for (std::int64_t j = 0; j < of.dof; ++j) {
      bool const slides = of.tree[2 * j + 1] != 0;
      BodyState<Lanes> const &body = posed.bodies[j];
      write(body.inertia, turning(body, slides), body.moving, &couples[static_cast<std::size_t>(6 * j)], 1);
      if (of.tree[2 * j] < 0) all.add(body.inertia);
    }
    for (int k = 0; k < 6; ++k) {
      Lanes unit[6];
      unit[k] = 1.0;
      write(all, {unit[0], unit[1], unit[2]}, {unit[3], unit[4], unit[5]}, factor + k, 6);
    }
    factorize(6, factor);
    for (std::int64_t j = 0; j < of.dof; ++j) solve_lower<1>(6, factor, &couples[static_cast<std::size_t>(6 * j)]);
  }
  Lanes product(std::int64_t j, Lanes const *column) const {
    Lanes sum{};
    for (std::int64_t k = 0; k < 6; ++k) sum += couples[static_cast<std::size_t>(6 * j + k)] * factor[7 * k] * column[k];
    return sum;
  }

 private:
  static inline __attribute__((always_inline)) void write(Inertia<Lanes> const &inertia, Vector<Lanes> w,
                                                          Vector<Lanes> v, Lanes *out, int stride) {
    Vector<Lanes> const angular = inertia.angular(w, v), linear = inertia.linear(w, v);
    Lanes const all[6] = {angular.x, angular.y, angular.z, linear.x, linear.y, linear.z};
    for (int k = 0; k < 6; ++k) out[k * stride] = all[k];
  }
};

// Write the mass matrices (dof, dof) that the joints of robots `first` to `first + WIDTH` show.
inline __attribute__((always_inline)) void joint_matrix(Model const &of, std::int64_t first, std::int64_t rows,
                                                        double const *qpos, Posed &posed, Lanes *matrix) {
  Inertia<Lanes> const base = posed.pose(of, first, rows, qpos);
  composite_mass_matrix(of.dof, of.tree, posed.bodies.data(), matrix);
  if (of.base != Base::FREE) return;
  Floating const floating(of, posed, base);
  for (std::int64_t i = 0; i < of.dof; ++i) {
    Lanes const *own = &floating.couples[static_cast<std::size_t>(6 * i)];
    for (std::int64_t j = 0; j <= i; ++j) {
      matrix[i * of.dof + j] -= floating.product(j, own);
      matrix[j * of.dof + i] = matrix[i * of.dof + j];
    }
  }
}

// Write the mass matrices (rows, dof, dof) that the joints show at qpos (rows, dof).
FOR_EACH_PROCESSOR static void write_joint_matrices(Model const &of, std::int64_t rows, double const *qpos,
                                                    double *out) {
  std::int64_t const size = of.dof * of.dof;
  Posed posed(of.dof);
  std::vector<Lanes> matrix(static_cast<std::size_t>(size));
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    joint_matrix(of, first, rows, qpos, posed, matrix.data());
    scatter_rows(matrix.data(), size, out, first, rows);
  }
}

// Parts of a passive force; without both it is zero.
struct Parts {
  bool gravity, coriolis;
};

// Write the efforts (rows, dof) that cancel gravity, and Coriolis and centrifugal forces, at qpos and qvel. `bases` (rows,
// BASE_SIZE) are those that are not fixed. On a free base gravity, a velocity and an acceleration of the base cancel.
FOR_EACH_PROCESSOR static void write_forces(Model const &of, Parts parts, std::int64_t rows, double const *qpos,
                                            double const *qvel, double const *bases, double *out) {
  std::int64_t const dof = of.dof;
  Posed posed(dof);
  std::vector<BodyMotion<Lanes>> motions(static_cast<std::size_t>(dof));
  std::vector<Lanes> effort(static_cast<std::size_t>(dof)), force(static_cast<std::size_t>(dof));
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    Inertia<Lanes> const base = posed.pose(of, first, rows, qpos);
    auto const add = [&](bool moves, double sign) {
      BodyMotion<Lanes> root{};
      auto const along = [&](int at) { return gather(bases, BASE_SIZE, at, first, rows); };
      if (of.base == Base::FIXED) root.moving_change = {Lanes(-of.gravity[0]), Lanes(-of.gravity[1]), Lanes(-of.gravity[2])};
      if (of.base == Base::HELD) root.moving_change = {-along(0), -along(1), -along(2)};
      if (of.base != Base::FIXED && moves) root.turning = {along(3), along(4), along(5)};
      for (std::int64_t j = 0; j < dof; ++j) posed.qvel[j] = moves ? gather(qvel, dof, j, first, rows) : Lanes{};
      move_bodies(dof, of.tree, posed.bodies.data(), posed.qvel.data(), root, motions.data());
      for (std::int64_t j = 0; j < dof; ++j) motions[j].accelerate(posed.bodies[j].inertia);
      efforts_of_wrenches(dof, of.tree, posed.bodies.data(), motions.data(), effort.data());
      if (of.base == Base::FREE) {
        root.accelerate(base);
        for (std::int64_t j = dof - 1; j >= 0; --j) {
          if (of.tree[2 * j] >= 0) {
            posed.bodies[of.tree[2 * j]].inertia.add(posed.bodies[j].inertia);
          } else {
            root.torque = root.torque + motions[j].torque;
            root.force = root.force + motions[j].force;
          }
        }
        Floating const floating(of, posed, base);
        Lanes wrench[6] = {root.torque.x, root.torque.y, root.torque.z, root.force.x, root.force.y, root.force.z};
        solve_lower<1>(6, floating.factor, wrench);
        for (std::int64_t j = 0; j < dof; ++j) effort[j] -= floating.product(j, wrench);
      }
      for (std::int64_t j = 0; j < dof; ++j) force[j] += sign * effort[j];
    };
    for (auto &each : force) each = Lanes{};
    bool const held = of.base != Base::FREE;
    if (parts.coriolis || (parts.gravity && held)) add(parts.coriolis, 1.0);
    if (parts.coriolis && !parts.gravity && held) add(false, -1.0);
    scatter_rows(force.data(), dof, out, first, rows);
  }
}

// Write the mass matrices (robots, dof, dof) of bodies (dof, 25) at qpos + ahead * qvel, both (robots, dof).
FOR_EACH_PROCESSOR static void write_mass_matrices(std::int64_t dof, std::int32_t const *tree, double const *bodies,
                                                   std::int64_t robots, double const *qpos, double const *qvel,
                                                   double ahead, double *out) {
  Posed posed(dof);
  std::vector<Lanes> matrix(static_cast<std::size_t>(dof * dof));
  for (std::int64_t first = 0; first < robots; first += WIDTH) {
    for (std::int64_t j = 0; j < dof; ++j) {
      posed.qpos[j] = gather(qpos, dof, j, first, robots) + ahead * gather(qvel, dof, j, first, robots);
    }
    posed.place(dof, tree, bodies, posed.qpos.data(), [&](std::int64_t j, BodyState<Lanes> &body) {
      weigh(reinterpret_cast<BodyRow<double> const *>(bodies)[j].inertia, body);
    });
    composite_mass_matrix(dof, tree, posed.bodies.data(), matrix.data());
    scatter_rows(matrix.data(), dof * dof, out, first, robots);
  }
}

}  // namespace batchpid
