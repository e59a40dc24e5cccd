// Dynamics of many robots of one kind, and steps of their joints with friction; the equations stand in
// sim/engine/batch_dynamics.py. Nothing of SAPIEN is needed.

#include <algorithm>
#include <memory>
#include <vector>

#include "batchpid/native/buffer.h"
#include "batchpid/native/extension.h"
#include "batchpid/native/lanes.h"
#include "batchpid/native/rigid_body.h"

using namespace batchpid;

namespace {

constexpr Py_ssize_t COLUMNS = sizeof(BodyRow<double>) / sizeof(double);

// Constants of a robot. Followers move with their leaders: q = rest + multiplier * q_leader.
struct Tree {
  static constexpr char CAPSULE[] = "batchpid.Tree";
  BodyRow<double> const *bodies() const { return reinterpret_cast<BodyRow<double> const *>(rows.data()); }

  std::int64_t dof, joints;
  std::vector<std::int32_t> tree;
  std::vector<double> rows;  // of BodyRow
  std::vector<std::int32_t> leader;  // of each of dof: a number below `joints`, or -1
  std::vector<double> multiplier, rest;
  std::int64_t carrier;  // body that carries the payload
  double point[3], gravity[3];
};

// Storage for WIDTH robots.
struct Workspace {
  std::vector<Lanes> qpos, qvel, cosine, sine, matrix, effort, loaded;
  std::vector<BodyState<Lanes>> bodies;
  std::vector<BodyMotion<Lanes>> motions;

  explicit Workspace(std::int64_t dof) {
    auto const n = static_cast<std::size_t>(dof);
    for (auto *leaf : {&qpos, &qvel, &cosine, &sine, &effort, &loaded}) leaf->resize(n);
    matrix.resize(n * n);
    bodies.resize(n);
    motions.resize(n);
  }
};

// tree(tree, rows, leader, multiplier, rest, joints, carrier, point, gravity)
PyObject *make_tree(PyObject *, PyObject *arguments) {
  PyObject *tree, *rows, *leader, *multiplier, *rest;
  auto made = std::make_unique<Tree>();
  Py_ssize_t dof, joints, carrier;
  if (!PyArg_ParseTuple(arguments, "OOOOOnnn(ddd)(ddd)", &tree, &rows, &leader, &multiplier, &rest, &dof, &joints,
                        &carrier, &made->point[0], &made->point[1], &made->point[2], &made->gravity[0],
                        &made->gravity[1], &made->gravity[2])) {
    return nullptr;
  }
  made->dof = dof;
  made->joints = joints;
  made->carrier = carrier;
  if (!copy(tree, 2 * dof, made->tree) || !copy(rows, dof * COLUMNS, made->rows) || !copy(leader, dof, made->leader) ||
      !copy(multiplier, dof, made->multiplier) || !copy(rest, dof, made->rest)) {
    return nullptr;
  }
  return capsule_of(std::move(made));
}

// Set positions and velocities of all joints from the given joints', and the bodies' frames, inertias and motions.
void set_bodies(Tree const &tree, Workspace &work, double const *qpos, double const *qvel, std::int64_t first,
               std::int64_t rows) {
  for (std::int64_t i = 0; i < tree.dof; ++i) {
    Lanes &q = work.qpos[i];
    q = tree.rest[i];
    work.qvel[i] = {};
    if (tree.leader[i] >= 0) {
      q += tree.multiplier[i] * gather(qpos, tree.joints, tree.leader[i], first, rows);
      work.qvel[i] = tree.multiplier[i] * gather(qvel, tree.joints, tree.leader[i], first, rows);
    }
    sine_and_cosine(q, work.sine[i], work.cosine[i]);
  }
  std::int32_t const *above = tree.tree.data();
  BodyState<Lanes> *bodies = work.bodies.data();
  place_bodies(tree.dof, above, tree.bodies(), work.cosine.data(), work.sine.data(), work.qpos.data(), bodies);
  weigh_bodies(tree.dof, tree.bodies(), bodies);
  move_bodies(tree.dof, above, bodies, work.qvel.data(), tree.gravity, work.motions.data());
}

// Write mass matrix, passive force without payload and passive force of the payload of rows of robots.
FOR_EACH_PROCESSOR void write_dynamics(Tree const &tree, std::int64_t rows, double const *qpos, double const *qvel,
                                       double const *payload, double *const (&out)[3]) {
  std::int64_t const joints = tree.joints, dof = tree.dof;
  std::int64_t const sizes[3] = {joints * joints, joints, joints};
  std::int32_t const *above = tree.tree.data();
  Workspace work(dof);
  std::vector<Lanes> matrix(static_cast<std::size_t>(joints * joints)), force(joints), loaded(joints);
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    BodyState<Lanes> *bodies = work.bodies.data();
    BodyMotion<Lanes> *motions = work.motions.data();
    set_bodies(tree, work, qpos, qvel, first, rows);
    BodyState<Lanes> &carrier = bodies[tree.carrier];
    Vector<Lanes> const place = carrier.origin + in_axes(carrier.axes, tree.point[0], tree.point[1], tree.point[2]);
    Inertia<Lanes> const load = point_mass(gather(payload, 1, 0, first, rows), place);
    motions[tree.carrier].accelerate(load);
    efforts_of_wrenches(dof, above, bodies, motions, work.loaded.data());
    for (std::int64_t i = 0; i < dof; ++i) {
      motions[i].torque = motions[i].force = Vector<Lanes>{};
      motions[i].accelerate(bodies[i].inertia);
    }
    efforts_of_wrenches(dof, above, bodies, motions, work.effort.data());
    carrier.inertia.add(load);
    composite_mass_matrix(dof, above, bodies, work.matrix.data());
    for (auto *leaf : {&matrix, &force, &loaded}) std::fill(leaf->begin(), leaf->end(), Lanes{});
    for (std::int64_t i = 0; i < dof; ++i) {
      std::int64_t const a = tree.leader[i];
      if (a < 0) continue;
      force[a] += tree.multiplier[i] * work.effort[i];
      loaded[a] += tree.multiplier[i] * work.loaded[i];
      for (std::int64_t j = 0; j < dof; ++j) {
        std::int64_t const b = tree.leader[j];
        if (b >= 0) matrix[a * joints + b] += tree.multiplier[i] * tree.multiplier[j] * work.matrix[i * dof + j];
      }
    }
    std::vector<Lanes> const *leaves[3] = {&matrix, &force, &loaded};
    for (int leaf = 0; leaf < 3; ++leaf) {
      for (std::int64_t k = 0; k < sizes[leaf]; ++k) scatter((*leaves[leaf])[k], out[leaf], sizes[leaf], k, first, rows);
    }
  }
}

// dynamics(tree, qpos, qvel, payload, matrix, force, payload_force): DYNAMICS in interface.py
PyObject *dynamics(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  Tree const *tree = held<Tree>(arguments[0]);
  if (tree == nullptr) return nullptr;
  std::int64_t const rows = PyObject_Size(arguments[1]), joints = tree->joints;
  std::int64_t const sizes[6] = {joints, joints, 1, joints * joints, joints, joints};
  Buffer arrays[6];
  for (int i = 0; i < 6; ++i) {
    int const flags = PyBUF_C_CONTIGUOUS | (i < 3 ? 0 : PyBUF_WRITABLE);
    if (!arrays[i].open(arguments[i + 1], rows * sizes[i], sizeof(double), flags)) return nullptr;
  }
  write_dynamics(*tree, rows, arrays[0].as<double>(), arrays[1].as<double>(), arrays[2].as<double>(),
                 {arrays[3].as<double>(), arrays[4].as<double>(), arrays[5].as<double>()});
  Py_RETURN_NONE;
}

// Arrays of `step`: STEP in interface.py.
enum Leaf { QPOS, QVEL, FRICTION, MATRIX, EFFORT, ADDED, LIMIT, KEEP, CREEP, LOW, HIGH, LEAVES };

// Step rows of robots: QPOS, QVEL and FRICTION are changed.
FOR_EACH_PROCESSOR void step_rows(std::int64_t rows, std::int64_t joints, double *const (&table)[LEAVES], double dt,
                                  long sweeps) {
  auto const n = static_cast<std::size_t>(joints);
  std::vector<Lanes> inverse(n * n), factor(n * n), free(n), kept(n), creep(n), weight(n), limit(n), f(n), effort(n);
  auto const along = [&](std::int64_t j, std::vector<Lanes> const &column) {
    Lanes sum{};
    for (std::int64_t k = 0; k < joints; ++k) sum += inverse[j * joints + k] * column[k];
    return dt * sum;
  };
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    auto const at = [&](Leaf leaf, std::int64_t j) { return gather(table[leaf], joints, j, first, rows); };
    for (std::int64_t k = 0; k < joints * joints; ++k) {
      inverse[k] = gather(table[MATRIX], joints * joints, k, first, rows);
    }
    for (std::int64_t j = 0; j < joints; ++j) inverse[j * joints + j] += at(ADDED, j);
    invert(joints, inverse.data(), factor.data());
    Lanes const keep = gather(table[KEEP], 1, 0, first, rows);
    for (std::int64_t j = 0; j < joints; ++j) effort[j] = at(EFFORT, j);
    for (std::int64_t j = 0; j < joints; ++j) {
      Lanes const v = at(QVEL, j);
      free[j] = v + along(j, effort);
      kept[j] = keep * v;
      creep[j] = at(CREEP, j);
      weight[j] = 1.0 / (dt * inverse[j * joints + j] + creep[j]);
      limit[j] = at(LIMIT, j);
      f[j] = at(FRICTION, j);
    }
    for (long sweep = 0; sweep < sweeps; ++sweep) {
      for (std::int64_t j = 0; j < joints; ++j) {
        effort[j] = f[j] + weight[j] * (free[j] - along(j, f) - kept[j] - creep[j] * f[j]);
        effort[j] = at_most(at_least(effort[j], -limit[j]), limit[j]);
      }
      std::swap(f, effort);
    }
    for (std::int64_t j = 0; j < joints; ++j) {
      Lanes const low = table[LOW][j], high = table[HIGH][j], v = free[j] - along(j, f), q = at(QPOS, j) + dt * v;
      scatter(at_most(at_least(q, low), high), table[QPOS], joints, j, first, rows);
      scatter(zero_outside(v, low, q, high), table[QVEL], joints, j, first, rows);
      scatter(f[j], table[FRICTION], joints, j, first, rows);
    }
  }
}

// step(qpos, qvel, friction, matrix, effort, added, limit, keep, creep, low, high, dt, sweeps)
PyObject *step(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  std::int64_t const rows = PyObject_Size(arguments[QPOS]), joints = PyObject_Size(arguments[LOW]);
  std::int64_t const own = rows * joints;
  std::int64_t const sizes[LEAVES] = {own, own, own, own * joints, own, own, own, rows, own, joints, joints};
  Buffer arrays[LEAVES];
  double *table[LEAVES];
  for (int i = 0; i < LEAVES; ++i) {
    int const flags = PyBUF_C_CONTIGUOUS | (i <= FRICTION ? PyBUF_WRITABLE : 0);
    if (!arrays[i].open(arguments[i], sizes[i], sizeof(double), flags)) return nullptr;
    table[i] = arrays[i].as<double>();
  }
  double const dt = PyFloat_AsDouble(arguments[LEAVES]);
  long const sweeps = PyLong_AsLong(arguments[LEAVES + 1]);
  if (PyErr_Occurred()) return nullptr;
  step_rows(rows, joints, table, dt, sweeps);
  Py_RETURN_NONE;
}

PyMethodDef METHODS[] = {
    {"tree", make_tree, METH_VARARGS, nullptr},
    {"dynamics", method(dynamics), METH_FASTCALL, nullptr},
    {"step", method(step), METH_FASTCALL, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_batch_dynamics", nullptr, -1, METHODS, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__batch_dynamics() { return batchpid::make_module(MODULE); }
