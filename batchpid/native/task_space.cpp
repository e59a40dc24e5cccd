// Kinematics, dynamics and operational space of many robots of one kind, row by row. The equations stand in
// batchpid/task_space: tree_kinematics.py, tree_dynamics.py, symmetric.py, projections.py and inverse_kinematics.py.

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <vector>

#include "batchpid/native/buffer.h"
#include "batchpid/native/call.h"
#include "batchpid/native/extension.h"
#include "batchpid/native/lanes.h"
#include "batchpid/native/pose_search.h"
#include "batchpid/native/rigid_body.h"
#include "batchpid/native/tables.h"
#include "batchpid/native/tool.h"

using namespace batchpid;

namespace {

constexpr Py_ssize_t COLUMNS = sizeof(BodyRow<double>) / sizeof(double);
constexpr int SWEEPS = 12;
constexpr double CLEAR = 1e-17;  // least entry off the diagonal that is turned away, as a share of the trace: below
                                 // the rounding of the matrix itself
char const *const TREE = "batchpid.KinematicTree";

enum Decoupling { FULL, PARTIAL, NONE };

Tree *tree_of(PyObject *capsule) { return static_cast<Tree *>(PyCapsule_GetPointer(capsule, TREE)); }

template <class T>
bool copy(PyObject *array, Py_ssize_t count, std::vector<T> &to) {
  Buffer from;
  if (!from.open(array, count, sizeof(T), PyBUF_C_CONTIGUOUS)) return false;
  to.assign(from.as<T>(), from.as<T>() + count);
  return true;
}

// tree(dof, tree, rows, armature, (gravity))
PyObject *make_tree(PyObject *, PyObject *arguments) {
  PyObject *tree, *rows, *armature;
  auto made = std::make_unique<Tree>();
  Py_ssize_t dof;
  double x, y, z;
  if (!PyArg_ParseTuple(arguments, "nOOO(ddd)", &dof, &tree, &rows, &armature, &x, &y, &z)) return nullptr;
  made->dof = dof;
  made->gravity = {x, y, z};
  if (!copy(tree, 2 * dof, made->tree) || !copy(rows, dof * COLUMNS, made->rows) ||
      !copy(armature, dof, made->armature)) {
    return nullptr;
  }
  return PyCapsule_New(made.release(), TREE, [](PyObject *capsule) { delete tree_of(capsule); });
}

// Arrays of `kinematics`: KINEMATICS in task_space_extension.py.
enum Kinematics { QPOS, QVEL, TOOL, TOOL_POSE, JACOBIAN, JACOBIAN_RATE, MASS_MATRIX, BIAS, KINEMATICS };

// Write results that are asked for; `body` is the body of the tool, or -1 for the base.
FOR_EACH_PROCESSOR void write_kinematics(Tree const &tree, std::int64_t body, std::int64_t rows, Tables const &table) {
  std::int64_t const dof = tree.dof;
  auto const size = static_cast<std::size_t>(dof);
  std::int32_t const *above = tree.tree.data();
  std::vector<Lanes> q(size), v(size), cosine(size), sine(size), effort(size), matrix(size * size);
  std::vector<Lanes> jacobian(AXES * size);  // 0 for joints that are not between base and tool
  std::vector<BodyState<Lanes>> bodies(size);
  std::vector<BodyMotion<Lanes>> motions(size);
  double const still[3] = {0.0, 0.0, 0.0};
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    table[QPOS].load(first, q.data());
    if (table[QVEL]) table[QVEL].load(first, v.data());
    write_cosines(dof, q.data(), cosine.data(), sine.data());
    place_bodies(dof, above, tree.bodies(), cosine.data(), sine.data(), q.data(), bodies.data());
    if (table[BIAS] || table[MASS_MATRIX]) weigh_bodies(dof, tree.bodies(), bodies.data());
    if (table[QVEL]) move_bodies(dof, above, bodies.data(), v.data(), still, motions.data());
    if (table[TOOL]) {
      Lanes frame[FRAME];
      table[TOOL].load(first, frame);
      Tool const tool(frame, body < 0 ? nullptr : &bodies[body]);
      Vector<Lanes> const place = tool.place();
      if (table[TOOL_POSE]) {
        for (int k = 0; k < WIDTH && first + k < rows; ++k) tool.write_pose(k, table[TOOL_POSE].row(first + k));
      }
      if (table[JACOBIAN]) {
        for (std::int64_t j = body; j >= 0; j = above[2 * j]) {
          write_column(bodies[j], above[2 * j + 1], place, &jacobian[j], dof);
        }
        table[JACOBIAN].store(first, jacobian.data());
      }
      if (table[JACOBIAN_RATE]) {
        write_rate(body < 0 ? BodyMotion<Lanes>{} : motions[body], place, frame);
        table[JACOBIAN_RATE].store(first, frame);
      }
    }
    if (table[BIAS]) {
      for (std::int64_t i = 0; i < dof; ++i) {
        motions[i].accelerate(bodies[i].inertia);
        Vector<Lanes> const weight = bodies[i].inertia.mass * tree.gravity;
        motions[i].force = motions[i].force + Lanes(-1.0) * weight;
        motions[i].torque = motions[i].torque + cross(tree.gravity, bodies[i].inertia.first);
      }
      efforts_of_wrenches(dof, above, bodies.data(), motions.data(), effort.data());
      table[BIAS].store(first, effort.data());
    }
    if (table[MASS_MATRIX]) {
      composite_mass_matrix(dof, above, bodies.data(), matrix.data());
      for (std::int64_t i = 0; i < dof; ++i) matrix[i * dof + i] += tree.armature[i];
      table[MASS_MATRIX].store(first, matrix.data());
    }
  }
}

bool open_kinematics(Tables &table, PyObject *const *arrays, std::int64_t rows, std::int64_t dof) {
  std::int64_t const sizes[KINEMATICS] = {dof, dof, FRAME, POSE, AXES * dof, AXES, dof * dof, dof};
  for (int i = 0; i < KINEMATICS; ++i) {
    if (!table.open(arrays[i], sizes[i], rows, i > TOOL)) return false;
  }
  return true;
}

// kinematics(tree, body, rows, *arrays)
PyObject *kinematics(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  Tree const *tree = tree_of(arguments[0]);
  if (tree == nullptr) return nullptr;
  std::int64_t const body = PyLong_AsLong(arguments[1]), rows = PyLong_AsLong(arguments[2]);
  Tables table;
  if (!open_kinematics(table, arguments + 3, rows, tree->dof)) return nullptr;
  write_kinematics(*tree, body, rows, table);
  Py_RETURN_NONE;
}

// Arrays of `law`: LAW in task_space_extension.py.
enum Law {
  TASK_POSE,
  TASK_JACOBIAN,
  TASK_RATE,
  TASK_MASS,
  TASK_BIAS,
  CHAIN,
  SETPOINT,
  LAW_QPOS,
  LAW_QVEL,
  TWIST,
  ACCELERATION,
  WRENCH,
  FEEDFORWARD,
  DAMPING,
  ADDED_INERTIA,
  POSTURE,
  INTEGRAL,
  KP,  // coefficients: fields of OSCCoefficients
  KD,
  C,
  ACCELERATION_SHARE,
  KI_DT,
  KI_DT2,
  POSTURE_KP,
  POSTURE_KD,
  LIMIT_KP,
  LIMIT_KD,
  LIMIT_MARGIN,
  LIMIT_LOW,
  LIMIT_HIGH,
  INTEGRAL_LIMIT,
  POSITION_LIMIT,
  ROTATION_LIMIT,
  SMALLEST,
  SELECTED,
  FORCE_AXES,
  EFFORT_MIN,
  EFFORT_MAX,
  EFFORT,  // results
  NEXT_INTEGRAL,
  TASK_ERROR,
  FORCE,
  TASK_EFFORT,
  POSTURE_EFFORT,
  UNSATURATED,
  TASK_SHARE,
  POSTURE_SHARE,
  NEAR_SINGULAR,
  LAW
};

// Write the eigenvalues (6,) and, as columns, the eigenvectors of symmetric matrices, of which the upper triangle is used
// and overwritten: Jacobi's method. A lane whose entry is clear is not turned, so that it ends at the same sweep in any
// company.
void eigen(Lanes (&a)[AXES][AXES], Lanes (&vectors)[AXES][AXES]) {
  for (int i = 0; i < AXES; ++i) {
    for (int j = 0; j < AXES; ++j) vectors[i][j] = i == j ? 1.0 : 0.0;
  }
  Lanes trace{};
  for (int i = 0; i < AXES; ++i) trace += absolute(a[i][i]);
  Lanes const clear = CLEAR * trace;
  for (int sweep = 0; sweep < SWEEPS; ++sweep) {
    bool turned = false;
    for (int p = 0; p < AXES; ++p) {
      for (int q = p + 1; q < AXES; ++q) {
        Lanes const off = a[p][q];
        Lanes const turns = absolute(off) - clear;
        if (!any_positive(turns)) continue;
        turned = true;
        Lanes const cot = (a[q][q] - a[p][p]) / where_positive(turns, 2.0 * off, 1.0);
        Lanes const sum = absolute(cot) + root(cot * cot + 1.0);
        Lanes const t = where_positive(turns, where_positive(-cot, -1.0, 1.0) / sum, 0.0);
        Lanes const c = 1.0 / root(t * t + 1.0), s = t * c;
        a[p][p] -= t * off;
        a[q][q] += t * off;
        a[p][q] = where_positive(turns, 0.0, off);
        for (int k = 0; k < AXES; ++k) {
          Lanes const v = vectors[k][p], w = vectors[k][q];
          vectors[k][p] = c * v - s * w;
          vectors[k][q] = s * v + c * w;
          if (k == p || k == q) continue;
          Lanes &to_p = k < p ? a[k][p] : a[p][k], &to_q = k < q ? a[k][q] : a[q][k];
          Lanes const x = to_p, y = to_q;
          to_p = c * x - s * y;
          to_q = s * x + c * y;
        }
      }
    }
    if (!turned) break;
  }
}

// Write the bounded inverses by eigenvalues in the lanes of `unsure`; `near` gets 1.0 where any is below s0.
void bound_inverses(Lanes const *matrix, Lanes s0, Lanes unsure, Lanes *out, Lanes &near) {
  Lanes a[AXES][AXES], vectors[AXES][AXES], scale[AXES], low{};
  for (int i = 0; i < AXES; ++i) {
    // The lanes that are left out are diagonal, and end at once.
    for (int j = 0; j < AXES; ++j) a[i][j] = where_positive(unsure, matrix[i * AXES + j], i == j ? 1.0 : 0.0);
  }
  eigen(a, vectors);
  for (int i = 0; i < AXES; ++i) {
    Lanes const s = a[i][i];
    Lanes const large = at_least_mask(s, s0);
    low = where_positive(large, low, 1.0);
    scale[i] = where_positive(large, 1.0 / s, at_least(s, 0.0) / (s0 * s0));
  }
  near = where_positive(unsure * low, 1.0, near);
  for (int i = 0; i < AXES; ++i) {
    for (int j = 0; j <= i; ++j) {
      Lanes sum{};
      for (int c = 0; c < AXES; ++c) sum += scale[c] * vectors[i][c] * vectors[j][c];
      Lanes const entry = where_positive(unsure, sum, out[i * AXES + j]);
      out[i * AXES + j] = out[j * AXES + i] = entry;
    }
  }
}

// Write the bounded inverse of A over the selected axes; `near` gets 1.0 in the lanes where it is bounded.
void selected_inverse(Lanes const (&mobility)[AXES * AXES], Lanes const *axes, Lanes s0, Lanes (&out)[AXES * AXES],
                      Lanes &near) {
  Lanes matrix[AXES * AXES], factor[AXES * AXES];
  for (int i = 0; i < AXES; ++i) {
    for (int j = 0; j < AXES; ++j) {
      Lanes &entry = matrix[i * AXES + j] = mobility[i * AXES + j];
      if (axes == nullptr) continue;
      Lanes const alone = i == j ? (1.0 - axes[i]) * at_least(s0, 1.0) : Lanes{};
      entry = where_positive(axes[i] * axes[j], entry, alone);
    }
  }
  std::copy(matrix, matrix + AXES * AXES, out);
  invert(AXES, out, factor);
  Lanes square{};
  for (Lanes const &entry : out) square += entry * entry;
  Lanes const sure = at_least_mask(1.0, root(square) * s0);  // no eigenvalue is below s0; 0.0 for nan
  if (sure.of[0] + sure.of[1] + sure.of[2] + sure.of[3] < WIDTH) {
    bound_inverses(matrix, s0, 1.0 - sure, out, near);
  }
  if (axes == nullptr) return;
  for (int i = 0; i < AXES; ++i) {
    for (int j = 0; j < AXES; ++j) {
      out[i * AXES + j] = where_positive(axes[i] * axes[j], out[i * AXES + j], Lanes{});
    }
  }
}

Lanes along(Lanes const *row, Lanes const *vector, std::int64_t size) {
  Lanes sum{};
  for (std::int64_t k = 0; k < size; ++k) sum += row[k] * vector[k];
  return sum;
}

// Inputs of a law for WIDTH rows. A row that stands for all is loaded once.
class Given {
 public:
  Given(Tables const &table, int count) : table_(table), count_(count) {
    std::size_t size = 0;
    for (int i = 0; i < count; ++i) size += table[i] ? static_cast<std::size_t>(table[i].columns) : 0;
    of_.resize(size);
    Lanes *next = of_.data();
    for (int i = 0; i < count; ++i) {
      if (!table[i]) continue;
      at_[i] = next;
      next += table[i].columns;
      if (table[i].rows == 1) table[i].load(0, at_[i]);
    }
  }
  void load(std::int64_t first) {
    for (int i = 0; i < count_; ++i) {
      if (table_[i] && table_[i].rows > 1) table_[i].load(first, at_[i]);
    }
  }
  // The columns of an array; null if it is left out.
  Lanes *operator[](int i) const { return at_[i]; }

 private:
  Tables const &table_;
  int count_;
  Lanes *at_[LAW] = {};
  std::vector<Lanes> of_;
};

// Return the share of an effort, added to efforts `at`, with which the joints within their limits stay there.
Lanes share_within(std::int64_t dof, Lanes const *effort, Lanes const *at, Lanes const *base, Lanes const *low,
                   Lanes const *high) {
  Lanes const infinite = std::numeric_limits<double>::infinity();
  Lanes share = 1.0;
  for (std::int64_t i = 0; i < dof; ++i) {
    Lanes const least = low == nullptr ? -infinite : low[i], most = high == nullptr ? infinite : high[i];
    Lanes const able = at_least_mask(base[i], least) * at_least_mask(most, base[i]);
    Lanes const room = at_least(where_positive(effort[i], most - at[i], at[i] - least), 0.0);
    Lanes const size = absolute(effort[i]);
    Lanes const limited = where_positive(size - room, able, Lanes{});
    if (!any_positive(limited)) continue;
    share = at_most(where_positive(limited, room / where_positive(limited, size, 1.0), 1.0), share);
  }
  return share;
}

FOR_EACH_PROCESSOR void write_law(std::int64_t rows, std::int64_t dof, Decoupling decoupling, bool in_tool_axes,
                                  Tables const &table) {
  auto const n = static_cast<std::size_t>(dof);
  std::vector<std::int64_t> chain, others;
  for (std::int64_t i = 0; i < dof; ++i) (table[CHAIN].data[i] > 0 ? chain : others).push_back(i);
  auto const links = static_cast<std::int64_t>(chain.size());
  Given given(table, EFFORT);
  enum { FACTOR, WHITE, BOTH, A_N, BASE, TASK, NULL_SPACE, OF_TASK, OF_NULL, SUM, WHOLE, WORK };
  std::vector<Lanes> storage(n * (n + AXES + 2 + WORK - A_N));  // 0 for joints that have no part in an effort
  Lanes *work[WORK] = {storage.data(), storage.data() + n * n, storage.data() + n * (n + AXES)};
  for (int i = A_N; i < WORK; ++i) work[i] = storage.data() + n * static_cast<std::size_t>(n + AXES + 2 + i - A_N);
  Lanes *factor = work[FACTOR], *white = work[WHITE], *both = work[BOTH], *a_n = work[A_N], *base = work[BASE];
  Lanes *task = work[TASK], *posture = work[NULL_SPACE], *of_task = work[OF_TASK], *of_posture = work[OF_NULL];
  Lanes *sum = work[SUM], *whole = work[WHOLE];
  Lanes mobility[AXES * AXES], task_inertia[AXES * AXES], null_inertia[AXES * AXES], allowed[AXES];
  Lanes error[AXES], near_error[AXES], twist[AXES], turned[2][AXES], a[AXES], moved[AXES], force[AXES], drop[AXES];
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    given.load(first);
    Lanes *jacobian = given[TASK_JACOBIAN], *rate = given[TASK_RATE];
    Lanes *mass = given[TASK_MASS];
    Lanes const *axes = given[SELECTED], *qpos = given[LAW_QPOS], *qvel = given[LAW_QVEL];
    Lanes const *target = given[TWIST], *target_rate = given[ACCELERATION];

    for (std::int64_t i = 0; i < dof && given[ADDED_INERTIA] != nullptr; ++i) mass[i * dof + i] += given[ADDED_INERTIA][i];
    for (int k = 0; k < WIDTH; ++k) {  // e
      std::int64_t const row = std::min(first + k, rows - 1);
      double e[AXES];
      write_error(table[SETPOINT].row(row), table[TASK_POSE].row(row), e);
      for (int axis = 0; axis < AXES; ++axis) error[axis].of[k] = e[axis];
    }
    for (int half = 0; half < AXES; half += 3) {
      Lanes const *e = error + half, length = root(e[0] * e[0] + e[1] * e[1] + e[2] * e[2]);
      Lanes const limit = *given[half == 0 ? POSITION_LIMIT : ROTATION_LIMIT];
      Lanes const scale = where_positive(length - limit, limit / length, 1.0);
      for (int k = 0; k < 3; ++k) near_error[half + k] = scale * e[k];
    }
    for (int axis = 0; axis < AXES; ++axis) twist[axis] = along(jacobian + axis * dof, qvel, dof);  // J q'
    if (in_tool_axes) {
      Turn const turn(given[TASK_POSE] + 3);
      if (target != nullptr) target = std::copy(target, target + AXES, turned[0]) - AXES;
      if (target_rate != nullptr) target_rate = std::copy(target_rate, target_rate + AXES, turned[1]) - AXES;
      for (Lanes *vector : {error, near_error, twist, rate, turned[0], turned[1]}) turn.reverse(vector, 1);
      for (std::int64_t j = 0; j < dof; ++j) turn.reverse(jacobian + j, dof);
    }

    Lanes const *kp = given[KP], *kd = given[KD], *integral = given[INTEGRAL];
    for (int axis = 0; axis < AXES; ++axis) {
      a[axis] = kp[axis] * near_error[axis] - kd[axis] * twist[axis];
      if (target != nullptr) a[axis] += given[C][axis] * target[axis];
      if (target_rate != nullptr) a[axis] += given[ACCELERATION_SHARE][axis] * target_rate[axis];
      if (integral != nullptr) a[axis] += integral[axis];
    }
    for (std::int64_t j = 0; j < dof; ++j) {
      a_n[j] = given[POSTURE_KP][j] * (given[POSTURE][j] - qpos[j]) - given[POSTURE_KD][j] * qvel[j];
      if (given[LIMIT_KP] == nullptr) continue;
      Lanes const low = given[LIMIT_LOW][j] - qpos[j], high = qpos[j] - given[LIMIT_HIGH][j];
      Lanes const depth = at_least(low, 0.0) - at_least(high, 0.0);
      Lanes const damped = given[LIMIT_KD][j] * qvel[j] * absolute(depth) / given[LIMIT_MARGIN][j];
      a_n[j] += given[CHAIN][j] * (given[LIMIT_KP][j] * depth - damped);
    }

    for (std::int64_t i = 0; i < links; ++i) {
      for (std::int64_t j = 0; j <= i; ++j) factor[i * links + j] = mass[chain[i] * dof + chain[j]];
      for (int axis = 0; axis < AXES; ++axis) white[i * AXES + axis] = jacobian[axis * dof + chain[i]];
    }
    cholesky(links, factor);
    solve_lower<AXES>(links, factor, white);  // L^-1 J^T
    std::fill(mobility, mobility + AXES * AXES, Lanes{});
    for (std::int64_t i = 0; i < links; ++i) {
      Lanes const *row = &white[i * AXES];
      for (int a = 0; a < AXES; ++a) {
        for (int b = 0; b <= a; ++b) mobility[a * AXES + b] += row[a] * row[b];
      }
    }
    for (int a = 0; a < AXES; ++a) {
      for (int b = 0; b < a; ++b) mobility[b * AXES + a] = mobility[a * AXES + b];
    }

    bool const force_too = axes != nullptr && given[FORCE_AXES] != nullptr;
    for (int axis = 0; axis < AXES && axes != nullptr; ++axis) {
      allowed[axis] = force_too ? at_least(axes[axis], given[FORCE_AXES][axis]) : axes[axis];
    }
    Lanes const s0 = *given[SMALLEST];
    Lanes near{};
    selected_inverse(mobility, axes == nullptr ? nullptr : allowed, s0, null_inertia, near);
    Lanes *inertia = null_inertia;
    if (decoupling == PARTIAL || (decoupling == FULL && force_too)) {
      if (decoupling == PARTIAL) {
        for (int i = 0; i < AXES; ++i) {
          for (int j = 0; j < AXES; ++j) {
            if ((i < 3) != (j < 3)) mobility[i * AXES + j] = mobility[i * AXES + j] * 0.0;
          }
        }
      }
      selected_inverse(mobility, axes, s0, task_inertia, near);
      inertia = task_inertia;
    }

    for (int axis = 0; axis < AXES; ++axis) moved[axis] = decoupling == NONE ? a[axis] : a[axis] - rate[axis];
    for (int axis = 0; axis < AXES; ++axis) {
      force[axis] = decoupling != NONE ? along(inertia + axis * AXES, moved, AXES)
                    : axes != nullptr  ? axes[axis] * moved[axis]
                                       : moved[axis];
      if (given[WRENCH] != nullptr) force[axis] += given[WRENCH][axis];
    }
    for (int axis = 0; axis < AXES; ++axis) {  // J a_n of the chain
      moved[axis] = {};
      for (std::int64_t i : chain) moved[axis] += jacobian[axis * dof + i] * a_n[i];
    }
    for (int axis = 0; axis < AXES; ++axis) drop[axis] = along(null_inertia + axis * AXES, moved, AXES);

    for (std::int64_t c = 0; c < links; ++c) {
      std::int64_t const i = chain[c];
      Lanes x{}, y{};
      for (int axis = 0; axis < AXES; ++axis) {
        x += jacobian[axis * dof + i] * force[axis];
        y -= jacobian[axis * dof + i] * drop[axis];
      }
      for (std::int64_t j : chain) y += mass[i * dof + j] * a_n[j];
      task[i] = both[2 * c] = x;
      posture[i] = both[2 * c + 1] = y;
    }
    for (std::int64_t i = 0; i < dof; ++i) {
      base[i] = given[TASK_BIAS][i];
      for (std::int64_t j : others) base[i] += mass[i * dof + j] * a_n[j];
      if (given[FEEDFORWARD] != nullptr) base[i] += given[FEEDFORWARD][i];
      if (given[DAMPING] != nullptr) base[i] += given[DAMPING][i] * qvel[i];
    }
    if (!others.empty()) {  // M_oc M_cc^-1 of task and posture
      solve_lower<2>(links, factor, both);
      solve_upper<2>(links, factor, both);
    }
    for (std::int64_t i : others) {
      of_task[i] = of_posture[i] = {};
      for (std::int64_t c = 0; c < links; ++c) {
        of_task[i] += mass[i * dof + chain[c]] * both[2 * c];
        of_posture[i] += mass[i * dof + chain[c]] * both[2 * c + 1];
      }
    }

    Lanes const *low = given[EFFORT_MIN], *high = given[EFFORT_MAX];
    Lanes const s1 = share_within(dof, task, base, base, low, high);
    for (std::int64_t i = 0; i < dof; ++i) sum[i] = base[i] + s1 * task[i];
    Lanes const s2 = share_within(dof, posture, sum, base, low, high);
    Lanes held = near;
    for (std::int64_t i = 0; i < dof; ++i) {
      Lanes const rest = s1 * of_task[i] + s2 * of_posture[i];
      whole[i] = base[i] + task[i] + posture[i] + rest;
      sum[i] = sum[i] + s2 * posture[i] + rest;
      if (low != nullptr) sum[i] = at_least(sum[i], low[i]);
      if (high != nullptr) sum[i] = at_most(sum[i], high[i]);
      held = where_positive(differs_mask(sum[i], whole[i]), 1.0, held);
    }
    table[EFFORT].store(first, sum);
    if (integral != nullptr) {
      Lanes next[AXES];
      for (int axis = 0; axis < AXES; ++axis) {
        next[axis] = integral[axis] + given[KI_DT][axis] * near_error[axis];
        if (given[KI_DT2] != nullptr && target != nullptr) next[axis] -= given[KI_DT2][axis] * target[axis];
        Lanes const limit = given[INTEGRAL_LIMIT][axis], grows = held * where_positive(a[axis] * near_error[axis], 1.0, 0.0);
        next[axis] = where_positive(grows, integral[axis], at_most(at_least(next[axis], -limit), limit));
      }
      table[NEXT_INTEGRAL].store(first, next);
    }
    table[TASK_ERROR].store(first, error);
    table[FORCE].store(first, force);
    table[TASK_EFFORT].store(first, task);
    table[POSTURE_EFFORT].store(first, posture);
    table[UNSATURATED].store(first, whole);
    table[TASK_SHARE].store(first, &s1);
    table[POSTURE_SHARE].store(first, &s2);
    table[NEAR_SINGULAR].store(first, &near);
  }
}

// Columns of an array of `law`.
std::int64_t law_columns(int array, std::int64_t dof) {
  switch (array) {
    case TASK_POSE:
    case SETPOINT:
      return POSE;
    case TASK_JACOBIAN:
      return AXES * dof;
    case TASK_MASS:
      return dof * dof;
    case POSITION_LIMIT:
    case ROTATION_LIMIT:
    case SMALLEST:
    case TASK_SHARE:
    case POSTURE_SHARE:
    case NEAR_SINGULAR:
      return 1;
    case TASK_RATE:
    case TWIST:
    case ACCELERATION:
    case WRENCH:
    case INTEGRAL:
    case KP:
    case KD:
    case C:
    case ACCELERATION_SHARE:
    case KI_DT:
    case KI_DT2:
    case INTEGRAL_LIMIT:
    case SELECTED:
    case FORCE_AXES:
    case NEXT_INTEGRAL:
    case TASK_ERROR:
    case FORCE:
      return AXES;
    default:
      return dof;
  }
}

bool open_law(Tables &table, PyObject *const *arrays, std::int64_t rows, std::int64_t dof) {
  for (int i = 0; i < LAW; ++i) {
    if (!table.open(arrays[i], law_columns(i, dof), i == CHAIN ? 1 : rows, i >= EFFORT)) return false;
  }
  return true;
}

// law(rows, dof, decoupling, in_tool_axes, *arrays)
PyObject *law(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  std::int64_t const rows = PyLong_AsLong(arguments[0]), dof = PyLong_AsLong(arguments[1]);
  long const decoupling = PyLong_AsLong(arguments[2]), in_tool_axes = PyLong_AsLong(arguments[3]);
  if (PyErr_Occurred()) return nullptr;
  Tables table;
  if (!open_law(table, arguments + 4, rows, dof)) return nullptr;
  write_law(rows, dof, static_cast<Decoupling>(decoupling), in_tool_axes != 0, table);
  Py_RETURN_NONE;
}

// Arrays of `friction`: FRICTION in task_space_extension.py.
enum Friction {
  AT_POSE,
  AT_JACOBIAN,
  ON_CHAIN,
  GOAL_POSE,
  GOAL_TWIST,
  OTHERS_GOAL,
  AT_QPOS,
  AT_QVEL,
  VISCOUS,
  COULOMB,
  BAND,
  RUBBING,
  FRICTION
};

// Write the efforts of damping and Coulomb friction on the way to the setpoint: OperationalSpace in osc_controller.py.
FOR_EACH_PROCESSOR void write_friction(std::int64_t rows, std::int64_t dof, Tables const &table) {
  constexpr double LOOKAHEAD = 0.1;  // of batchpid/motors/friction.py
  auto const n = static_cast<std::size_t>(dof);
  std::vector<Lanes> jacobian(AXES * n), chain(n), posture(n), qpos(n), qvel(n), damping(n), coulomb(n), band(n), out(n);
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    table[AT_JACOBIAN].load(first, jacobian.data());
    table[ON_CHAIN].load(first, chain.data());
    table[OTHERS_GOAL].load(first, posture.data());
    table[AT_QPOS].load(first, qpos.data());
    table[COULOMB].load(first, coulomb.data());
    table[BAND].load(first, band.data());
    Lanes ahead[AXES], twist[AXES], mobility[AXES * AXES];
    for (int k = 0; k < WIDTH; ++k) {
      std::int64_t const row = std::min(first + k, rows - 1);
      double e[AXES];
      write_error(table[GOAL_POSE].row(row), table[AT_POSE].row(row), e);
      for (int axis = 0; axis < AXES; ++axis) ahead[axis].of[k] = e[axis];
    }
    if (table[GOAL_TWIST]) {
      table[GOAL_TWIST].load(first, twist);
      for (int axis = 0; axis < AXES; ++axis) ahead[axis] += LOOKAHEAD * twist[axis];
    }
    for (int a = 0; a < AXES; ++a) {
      for (int b = 0; b <= a; ++b) {
        mobility[a * AXES + b] = along(&jacobian[a * dof], &jacobian[b * dof], dof);
        mobility[b * AXES + a] = mobility[a * AXES + b];
      }
      mobility[a * AXES + a] += 1e-4;
    }
    cholesky(AXES, mobility);
    solve_lower<1>(AXES, mobility, ahead);
    solve_upper<1>(AXES, mobility, ahead);
    for (std::int64_t j = 0; j < dof; ++j) {
      Lanes moved{};
      for (int axis = 0; axis < AXES; ++axis) moved += jacobian[axis * dof + j] * ahead[axis];
      Lanes const way = chain[j] * moved + (1.0 - chain[j]) * (posture[j] - qpos[j]);
      out[j] = at_most(at_least(way * (coulomb[j] / band[j]), -coulomb[j]), coulomb[j]);
    }
    if (table[VISCOUS]) {
      table[VISCOUS].load(first, damping.data());
      table[AT_QVEL].load(first, qvel.data());
      for (std::int64_t j = 0; j < dof; ++j) out[j] = damping[j] * qvel[j] + out[j];
    }
    table[RUBBING].store(first, out.data());
  }
}

bool open_friction(Tables &table, PyObject *const *arrays, std::int64_t rows, std::int64_t dof) {
  for (int i = 0; i < FRICTION; ++i) {
    std::int64_t const columns = i == AT_POSE || i == GOAL_POSE ? POSE : i == AT_JACOBIAN ? AXES * dof
                                 : i == GOAL_TWIST              ? AXES
                                                                : dof;
    if (!table.open(arrays[i], columns, i == ON_CHAIN ? 1 : rows, i == RUBBING)) return false;
  }
  return true;
}

// friction(rows, dof, *arrays)
PyObject *friction(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  std::int64_t const rows = PyLong_AsLong(arguments[0]), dof = PyLong_AsLong(arguments[1]);
  Tables table;
  if (PyErr_Occurred() || !open_friction(table, arguments + 2, rows, dof)) return nullptr;
  write_friction(rows, dof, table);
  Py_RETURN_NONE;
}

// Kinematics and law of some robots on fixed arrays, with friction where it has a result.
struct BoundLaw : Call {
  Tree tree;
  std::int64_t body, rows;
  Decoupling decoupling;
  bool in_tool_axes;
  Tables kinematics, law, friction;

  static void run_both(Call const &call) {
    auto const &bound = static_cast<BoundLaw const &>(call);
    write_kinematics(bound.tree, bound.body, bound.rows, bound.kinematics);
    if (bound.friction[RUBBING]) write_friction(bound.rows, bound.tree.dof, bound.friction);
    write_law(bound.rows, bound.tree.dof, bound.decoupling, bound.in_tool_axes, bound.law);
  }
};

char const *const BOUND = "batchpid.BoundLaw";

// bind(tree, body, rows, decoupling, in_tool_axes, *arrays of kinematics, *arrays of law, *arrays of friction)
//   -> (object, address of Call)
PyObject *bind(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  Tree const *tree = tree_of(arguments[0]);
  if (tree == nullptr) return nullptr;
  auto bound = std::make_unique<BoundLaw>();
  bound->run = BoundLaw::run_both;
  bound->tree = *tree;
  bound->body = PyLong_AsLong(arguments[1]);
  bound->rows = PyLong_AsLong(arguments[2]);
  bound->decoupling = static_cast<Decoupling>(PyLong_AsLong(arguments[3]));
  bound->in_tool_axes = PyLong_AsLong(arguments[4]) != 0;
  if (PyErr_Occurred() || !open_kinematics(bound->kinematics, arguments + 5, bound->rows, tree->dof) ||
      !open_law(bound->law, arguments + 5 + KINEMATICS, bound->rows, tree->dof) ||
      !open_friction(bound->friction, arguments + 5 + KINEMATICS + LAW, bound->rows, tree->dof)) {
    return nullptr;
  }
  PyObject *address = PyLong_FromVoidPtr(static_cast<Call *>(bound.get()));
  PyObject *capsule = PyCapsule_New(bound.release(), BOUND, [](PyObject *object) {
    delete static_cast<BoundLaw *>(PyCapsule_GetPointer(object, BOUND));
  });
  return Py_BuildValue("NN", capsule, address);
}

// search(tree, body, rows, iterations, *arrays)
PyObject *search(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  Tree const *tree = tree_of(arguments[0]);
  if (tree == nullptr) return nullptr;
  std::int64_t const body = PyLong_AsLong(arguments[1]), rows = PyLong_AsLong(arguments[2]);
  std::int64_t const iterations = PyLong_AsLong(arguments[3]), dof = tree->dof;
  if (PyErr_Occurred()) return nullptr;
  std::int64_t const sizes[SEARCH] = {POSE, FRAME, dof, dof, 2, dof, 2, 1};
  Tables table;
  for (int i = 0; i < SEARCH; ++i) {
    if (!table.open(arguments[4 + i], sizes[i], rows, i > LARGEST)) return nullptr;
  }
  search_poses(*tree, body, rows, iterations, table);
  Py_RETURN_NONE;
}

template <class Function>
PyCFunction method(Function function) {
  return reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(function));
}

PyMethodDef METHODS[] = {
    {"tree", make_tree, METH_VARARGS, nullptr},
    {"kinematics", method(kinematics), METH_FASTCALL, nullptr},
    {"law", method(law), METH_FASTCALL, nullptr},
    {"friction", method(friction), METH_FASTCALL, nullptr},
    {"bind", method(bind), METH_FASTCALL, nullptr},
    {"search", method(search), METH_FASTCALL, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_task_space", nullptr, -1, METHODS, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__task_space() { return batchpid::make_module(MODULE); }
