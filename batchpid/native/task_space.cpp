// Kinematics, dynamics, inverse kinematics and operational-space control of many robots of one kind, for Python.

#include <iterator>

#include "batchpid/native/osc_law.h"
#include "batchpid/native/pose_search.h"

using namespace batchpid;

namespace {

constexpr Py_ssize_t COLUMNS = sizeof(BodyRow<double>) / sizeof(double);

// tree(dof, tree, rows, armature, (gravity), leader, multiplier, offset)
PyObject *make_tree(PyObject *, PyObject *arguments) {
  PyObject *tree, *rows, *armature, *leader, *multiplier, *offset;
  auto made = std::make_unique<Tree>();
  Py_ssize_t dof;
  double x, y, z;
  if (!PyArg_ParseTuple(arguments, "nOOO(ddd)OOO", &dof, &tree, &rows, &armature, &x, &y, &z, &leader, &multiplier,
                        &offset)) {
    return nullptr;
  }
  made->dof = dof;
  made->gravity = {x, y, z};
  if (!copy(tree, 2 * dof, made->tree) || !copy(rows, dof * COLUMNS, made->rows) ||
      !copy(armature, dof, made->armature) || !copy(leader, dof, made->leader) ||
      !copy(multiplier, dof, made->multiplier) || !copy(offset, dof, made->offset)) {
    return nullptr;
  }
  for (Py_ssize_t j = 0; j < dof; ++j) made->coupled = made->coupled || made->leader[j] != j;
  return capsule_of(std::move(made));
}

// Write results that are asked for; `body` is the body of the tool, or -1 for the base.
FOR_EACH_PROCESSOR void write_kinematics(Tree const &tree, std::int64_t body, std::int64_t rows, Tables const &table) {
  auto const size = static_cast<std::size_t>(tree.dof);
  std::vector<Lanes> qpos(size), qvel(size);
  Lanes frame[FRAME];
  ToolDynamics at(tree, body);
  for (std::int64_t first = 0; first < rows; first += WIDTH) {
    table[KINEMATICS_QPOS].load(first, qpos.data());
    if (table[KINEMATICS_QVEL]) table[KINEMATICS_QVEL].load(first, qvel.data());
    at.place(qpos.data());
    if (table[KINEMATICS_QVEL]) at.move(qvel.data());
    table[KINEMATICS_TOOL].load(first, frame);
    at.set_tool(frame);
    table[KINEMATICS_POSE].store(first, at.pose);
    if (table[KINEMATICS_JACOBIAN]) at.set_jacobian();
    table[KINEMATICS_JACOBIAN].store(first, at.jacobian.data());
    if (table[KINEMATICS_JACOBIAN_RATE]) at.set_rate();
    table[KINEMATICS_JACOBIAN_RATE].store(first, at.rate);
    if (table[KINEMATICS_BIAS] || table[KINEMATICS_MASS_MATRIX]) at.weigh();
    if (table[KINEMATICS_BIAS]) at.set_bias();
    table[KINEMATICS_BIAS].store(first, at.bias.data());
    if (table[KINEMATICS_MASS_MATRIX]) at.set_mass();
    table[KINEMATICS_MASS_MATRIX].store(first, at.mass.data());
  }
}

// kinematics(tree, body, rows, *arrays)
PyObject *kinematics(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  Tree const *tree = held<Tree>(arguments[0]);
  if (tree == nullptr) return nullptr;
  std::int64_t const body = PyLong_AsLong(arguments[1]), rows = PyLong_AsLong(arguments[2]), dof = tree->dof;
  Tables table;
  std::int64_t const columns[KINEMATICS] = {dof, dof, FRAME, POSE, AXES * dof, AXES, dof * dof, dof};
  if (!table.open_all(arguments + 3, columns, rows, KINEMATICS_POSE)) return nullptr;
  write_kinematics(*tree, body, rows, table);
  Py_RETURN_NONE;
}

// Columns of an array of `law`.
std::int64_t law_columns(int array, std::int64_t dof) {
  constexpr int ONE[] = {LAW_LEFT, LAW_POSITION_ERROR_LIMIT, LAW_ROTATION_ERROR_LIMIT, LAW_SMALLEST_EIGENVALUE,
                         LAW_TASK_SHARE, LAW_POSTURE_SHARE, LAW_NEAR_SINGULAR};
  constexpr int SIX[] = {LAW_JACOBIAN_RATE, LAW_TWIST, LAW_ACCELERATION, LAW_WRENCH, LAW_INTEGRAL, LAW_KP, LAW_KD, LAW_C,
                         LAW_ACCELERATION_SHARE, LAW_KI_DT, LAW_KI_DT2,
                         LAW_INTEGRAL_LIMIT, LAW_AXES, LAW_NEXT_INTEGRAL, LAW_ERROR, LAW_FORCE};
  if (array == LAW_POSE || array == LAW_SETPOINT) return POSE;
  if (array == LAW_JACOBIAN) return AXES * dof;
  if (array == LAW_MASS_MATRIX) return dof * dof;
  if (std::count(std::begin(ONE), std::end(ONE), array)) return 1;
  return std::count(std::begin(SIX), std::end(SIX), array) ? AXES : dof;
}

// Law of some robots on given arrays, with dynamics of a tree where it has a tool, and its room. A bound step keeps it:
// to make it takes longer than to step four robots.
struct Step : Call {
  static constexpr char CAPSULE[] = "batchpid.Step";

  // Arguments: rows, dof, tree, body and tool (None, any and None without them), *arrays of Law.
  bool open(PyObject *const *arguments) {
    rows = PyLong_AsLong(arguments[0]);
    std::int64_t const dof = PyLong_AsLong(arguments[1]), body = PyLong_AsLong(arguments[3]);
    if (!PyErr_Occurred() && arguments[2] != Py_None) {
      if (Tree const *given = held<Tree>(arguments[2])) tree = *given;
    }
    if (PyErr_Occurred() || !tool.open(arguments[4], FRAME, rows, false)) return false;
    for (int i = 0; i < LAW; ++i) {
      if (!table.open(arguments[5 + i], law_columns(i, dof), i == LAW_CHAIN ? 1 : rows, i >= LAW_EFFORT)) return false;
    }
    if (tool[0]) dynamics = std::make_unique<ToolDynamics>(tree, body);
    law = std::make_unique<OSCLaw>(dof, table, dynamics.get());
    return true;
  }

  Tree tree{};
  std::int64_t rows;
  Tables table, tool;
  std::unique_ptr<ToolDynamics> dynamics;
  std::unique_ptr<OSCLaw> law;
};

FOR_EACH_PROCESSOR void write_step(Call const &call) {
  auto const &step = static_cast<Step const &>(call);
  Lanes tool[FRAME];
  for (std::int64_t first = 0; first < step.rows; first += WIDTH) {
    step.law->load(first);
    if (step.dynamics) {
      step.tool[0].load(first, tool);
      step.dynamics->place(step.law->qpos());
      step.dynamics->move(step.law->qvel());
      step.dynamics->set_tool(tool);
      step.dynamics->set_jacobian();
      step.dynamics->set_rate();
      step.dynamics->weigh();
      if (!step.table[LAW_BIAS]) step.dynamics->set_bias();
      step.dynamics->set_mass();
    }
    step.law->advance(first);
  }
}

// law(*arguments of Step::open)
PyObject *law(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  Step once;
  if (!once.open(arguments)) return nullptr;
  write_step(once);
  Py_RETURN_NONE;
}

// bind(*arguments of Step::open) -> (object, address of Call)
PyObject *bind(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  auto bound = std::make_unique<Step>();
  bound->run = write_step;
  if (!bound->open(arguments)) return nullptr;
  PyObject *address = PyLong_FromVoidPtr(static_cast<Call *>(bound.get()));
  return Py_BuildValue("NN", capsule_of(std::move(bound)), address);
}

// search(tree, body, rows, iterations, *arrays)
PyObject *search(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  Tree const *tree = held<Tree>(arguments[0]);
  if (tree == nullptr) return nullptr;
  std::int64_t const body = PyLong_AsLong(arguments[1]), rows = PyLong_AsLong(arguments[2]);
  std::int64_t const iterations = PyLong_AsLong(arguments[3]), dof = tree->dof;
  if (PyErr_Occurred()) return nullptr;
  Tables table;
  std::int64_t const columns[SEARCH] = {POSE, FRAME, dof, dof, 2, dof, 2, 1};
  if (!table.open_all(arguments + 4, columns, rows, FOUND)) return nullptr;
  search_poses(*tree, body, rows, iterations, table);
  Py_RETURN_NONE;
}

PyMethodDef METHODS[] = {
    {"tree", make_tree, METH_VARARGS, nullptr},
    {"kinematics", method(kinematics), METH_FASTCALL, nullptr},
    {"law", method(law), METH_FASTCALL, nullptr},
    {"bind", method(bind), METH_FASTCALL, nullptr},
    {"search", method(search), METH_FASTCALL, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_task_space", nullptr, -1, METHODS, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__task_space() { return batchpid::make_module(MODULE); }
