// Kinematics, dynamics and operational space of many robots of one kind, row by row. The equations stand in
// batchpid/task_space: tree_kinematics.py, tree_dynamics.py, symmetric.py, projections.py and inverse_kinematics.py.

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "batchpid/native/buffer.h"
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

// kinematics(tree, body, rows, *arrays)
PyObject *kinematics(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  Tree const *tree = tree_of(arguments[0]);
  if (tree == nullptr) return nullptr;
  std::int64_t const body = PyLong_AsLong(arguments[1]), rows = PyLong_AsLong(arguments[2]), dof = tree->dof;
  std::int64_t const sizes[KINEMATICS] = {dof, dof, FRAME, POSE, AXES * dof, AXES, dof * dof, dof};
  Tables table;
  for (int i = 0; i < KINEMATICS; ++i) {
    if (!table.open(arguments[3 + i], sizes[i], rows, i > TOOL)) return nullptr;
  }
  write_kinematics(*tree, body, rows, table);
  Py_RETURN_NONE;
}

// Arrays of `projections`: PROJECTIONS in task_space_extension.py.
enum Projections {
  CHAIN,
  TASK_JACOBIAN,
  TASK_RATE,
  TASK_MASS,
  TASK_BIAS,
  ACCELERATION,
  POSTURE_ACCELERATION,
  WRENCH,
  FEEDFORWARD,
  SELECTED,
  FORCE_AXES,
  SMALLEST,
  FORCE,
  TASK,
  POSTURE,
  BASE,
  TASK_OF_OTHERS,
  POSTURE_OF_OTHERS,
  NEAR_SINGULAR,
  PROJECTIONS
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
        Lanes const cot = (a[q][q] - a[p][p]) / where_positive(turns, 2.0 * off, 1.0);
        Lanes const sum = absolute(cot) + root(cot * cot + 1.0);
        Lanes const t = where_positive(turns, where_positive(-cot, -1.0, 1.0) / sum, 0.0);
        for (int k = 0; k < WIDTH; ++k) turned = turned || turns.of[k] > 0;
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

FOR_EACH_PROCESSOR void write_projections(std::int64_t rows, std::int64_t dof, Decoupling decoupling,
                                          Tables const &table) {
  auto const n = static_cast<std::size_t>(dof);
  std::vector<std::int64_t> chain, others;
  for (std::int64_t i = 0; i < dof; ++i) (table[CHAIN].data[i] > 0 ? chain : others).push_back(i);
  auto const links = static_cast<std::int64_t>(chain.size());
  std::vector<Lanes> jacobian(AXES * n), mass(n * n), factor(n * n), white(AXES * n), a_n(n), both(2 * n);
  std::vector<Lanes> base(n), feedforward(n), task(n), posture(n), of_task(n), of_posture(n);  // 0 for joints that have no part in it
  Lanes mobility[AXES * AXES], task_inertia[AXES * AXES], null_inertia[AXES * AXES], axes[AXES], allowed[AXES];
  Lanes acceleration[AXES], force[AXES], drop[AXES], added[AXES];
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    table[TASK_JACOBIAN].load(first, jacobian.data());
    table[TASK_MASS].load(first, mass.data());
    for (std::int64_t i = 0; i < links; ++i) {
      for (std::int64_t j = 0; j <= i; ++j) factor[i * links + j] = mass[chain[i] * dof + chain[j]];
      for (int axis = 0; axis < AXES; ++axis) white[i * AXES + axis] = jacobian[axis * dof + chain[i]];
    }
    cholesky(links, factor.data());
    solve_lower<AXES>(links, factor.data(), white.data());  // L^-1 J^T
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

    Table const &selected = table[SELECTED], &force_axes = table[FORCE_AXES];
    bool const select = bool(selected), force_too = select && force_axes;
    if (select) selected.load(first, axes);
    if (force_too) force_axes.load(first, added);
    for (int axis = 0; axis < AXES; ++axis) allowed[axis] = force_too ? at_least(axes[axis], added[axis]) : axes[axis];
    Lanes s0, near{};
    table[SMALLEST].load(first, &s0);
    selected_inverse(mobility, select ? allowed : nullptr, s0, null_inertia, near);
    Lanes *inertia = null_inertia;
    if (decoupling == PARTIAL || (decoupling == FULL && force_too)) {
      if (decoupling == PARTIAL) {
        for (int i = 0; i < AXES; ++i) {
          for (int j = 0; j < AXES; ++j) {
            if ((i < 3) != (j < 3)) mobility[i * AXES + j] = mobility[i * AXES + j] * 0.0;
          }
        }
      }
      selected_inverse(mobility, select ? axes : nullptr, s0, task_inertia, near);
      inertia = task_inertia;
    }

    table[ACCELERATION].load(first, acceleration);
    if (decoupling != NONE) {
      table[TASK_RATE].load(first, added);
      for (int axis = 0; axis < AXES; ++axis) acceleration[axis] -= added[axis];
    }
    if (table[WRENCH]) table[WRENCH].load(first, added);
    for (int axis = 0; axis < AXES; ++axis) {
      force[axis] = decoupling != NONE ? along(inertia + axis * AXES, acceleration, AXES)
                    : select           ? axes[axis] * acceleration[axis]
                                       : acceleration[axis];
      if (table[WRENCH]) force[axis] += added[axis];
    }
    table[FORCE].store(first, force);

    table[POSTURE_ACCELERATION].load(first, a_n.data());
    for (int axis = 0; axis < AXES; ++axis) {  // J a_n of the chain
      acceleration[axis] = {};
      for (std::int64_t i : chain) acceleration[axis] += jacobian[axis * dof + i] * a_n[i];
    }
    for (int axis = 0; axis < AXES; ++axis) drop[axis] = along(null_inertia + axis * AXES, acceleration, AXES);

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
    table[TASK].store(first, task.data());
    table[POSTURE].store(first, posture.data());
    table[TASK_BIAS].load(first, base.data());
    if (table[FEEDFORWARD]) table[FEEDFORWARD].load(first, feedforward.data());
    for (std::int64_t i = 0; i < dof; ++i) {
      for (std::int64_t j : others) base[i] += mass[i * dof + j] * a_n[j];
      if (table[FEEDFORWARD]) base[i] += feedforward[i];
    }
    table[BASE].store(first, base.data());
    if (!others.empty()) {  // M_oc M_cc^-1 of task and posture
      solve_lower<2>(links, factor.data(), both.data());
      solve_upper<2>(links, factor.data(), both.data());
    }
    for (std::int64_t i : others) {
      of_task[i] = of_posture[i] = {};
      for (std::int64_t c = 0; c < links; ++c) {
        of_task[i] += mass[i * dof + chain[c]] * both[2 * c];
        of_posture[i] += mass[i * dof + chain[c]] * both[2 * c + 1];
      }
    }
    table[TASK_OF_OTHERS].store(first, of_task.data());
    table[POSTURE_OF_OTHERS].store(first, of_posture.data());
    table[NEAR_SINGULAR].store(first, &near);
  }
}

// projections(rows, dof, decoupling, *arrays)
PyObject *projections(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  std::int64_t const rows = PyLong_AsLong(arguments[0]), dof = PyLong_AsLong(arguments[1]);
  long const decoupling = PyLong_AsLong(arguments[2]);
  if (PyErr_Occurred()) return nullptr;
  std::int64_t const sizes[PROJECTIONS] = {dof, AXES * dof, AXES, dof * dof, dof, AXES, dof, AXES, dof, AXES,
                                           AXES, 1, AXES, dof, dof, dof, dof, dof, 1};
  Tables table;
  for (int i = 0; i < PROJECTIONS; ++i) {
    if (!table.open(arguments[3 + i], sizes[i], i == CHAIN ? 1 : rows, i > SMALLEST)) return nullptr;
  }
  write_projections(rows, dof, static_cast<Decoupling>(decoupling), table);
  Py_RETURN_NONE;
}

// errors(rows, dof, goal, pose, position_limit, rotation_limit, jacobian, qvel, error, near, twist)
PyObject *errors(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  std::int64_t const rows = PyLong_AsLong(arguments[0]), dof = PyLong_AsLong(arguments[1]);
  if (PyErr_Occurred()) return nullptr;
  std::int64_t const sizes[9] = {POSE, POSE, 1, 1, AXES * dof, dof, AXES, AXES, AXES};
  Tables table;
  for (int i = 0; i < 9; ++i) {
    if (!table.open(arguments[2 + i], sizes[i], rows, i > 5)) return nullptr;
  }
  for (std::int64_t row = 0; row < rows; ++row) {
    double *error = table[6].row(row), *near = table[7].row(row), *twist = table[8].row(row);
    write_error(table[0].row(row), table[1].row(row), error);
    for (int half = 0; half < 2; ++half) {
      double const length = length_of(error + 3 * half), limit = *table[2 + half].row(row);
      double const scale = length > limit ? limit / length : 1.0;
      for (int k = 3 * half; k < 3 * half + 3; ++k) near[k] = scale * error[k];
    }
    double const *jacobian = table[4].row(row), *qvel = table[5].row(row);
    for (int axis = 0; axis < AXES; ++axis) {
      double sum = 0.0;
      for (std::int64_t j = 0; j < dof; ++j) sum += jacobian[axis * dof + j] * qvel[j];
      twist[axis] = sum;
    }
  }
  Py_RETURN_NONE;
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
    {"projections", method(projections), METH_FASTCALL, nullptr},
    {"errors", method(errors), METH_FASTCALL, nullptr},
    {"search", method(search), METH_FASTCALL, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_task_space", nullptr, -1, METHODS, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__task_space() { return batchpid::make_module(MODULE); }
