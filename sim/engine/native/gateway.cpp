// Gateway to the robots of a pack, in SAPIEN or MuJoCo: one call from Python for all of them, instead of one for each.
//
// It calls functions that SAPIEN's shared library exports. Their addresses and the objects' pointers come from Python
// (sim/engine/sapien/calls.py), so that nothing of SAPIEN, PhysX or Eigen is needed to compile this file.

#define BATCHPID_WIDTH 8  // WIDTH in __init__.py: the doubles of an instruction of AVX-512
#include "tick.h"

#include "passes.h"
#include "structures.h"

using namespace batchpid;

namespace {

// type_info("robot" | "system" | "joint"): capsule with the C++ type, as pybind11's conduit expects it.
PyObject *type_info(PyObject *, PyObject *argument) {
  Py_ssize_t size = 0;
  char const *kind = PyUnicode_AsUTF8AndSize(argument, &size);
  if (kind == nullptr) return nullptr;
  auto const *info = std::strcmp(kind, "robot") == 0    ? &typeid(Articulation)
                     : std::strcmp(kind, "system") == 0 ? &typeid(System)
                                                        : &typeid(Joint);
  return PyCapsule_New(const_cast<std::type_info *>(info), typeid(std::type_info).name(), nullptr);
}

// Return the structure of Python at an address, or null with an exception.
template <class T>
T *structure(PyObject *address) {
  return static_cast<T *>(PyLong_AsVoidPtr(address));
}

// sim_step(address of a Group, effort, qpos, qvel, passive) -> Status, on arrays (rows, dof) of double.
PyObject *step_group(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  auto *group = structure<Group>(arguments[0]);
  if (group == nullptr) return nullptr;
  Py_ssize_t const count = group->robots * group->dof;
  std::int32_t status = 0;
  auto const step = [&](auto const &of) { status = try_sim_step(*group, of[0], of[1], of[2], of[3]); };
  return on_doubles(arguments + 1, {count, count, count, count}, 1, step, [&] { return PyLong_FromLong(status); });
}

// bind(arguments of make_program, inputs, outputs): pairs of an array (contiguous, kept alive by the caller) and the
// numbers in each row of a table (0: it is (rows, columns), -1: one number), and arrays.
PyObject *bind(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  auto bound = std::make_unique<BoundProgram>();
  bound->program = make_program(arguments[0], PASSES, std::size(PASSES));
  if (bound->program == nullptr) return nullptr;
  Program const &program = *bound->program;
  Index const numbers = program.rows * program.columns;
  if (program.single || PyTuple_Size(arguments[1]) != program.inputs ||
      PyTuple_Size(arguments[2]) != static_cast<Py_ssize_t>(program.results.size())) {
    return misfit();
  }
  for (Py_ssize_t i = 0; i < program.inputs; ++i) {
    PyObject *pair = PyTuple_GetItem(arguments[1], i);
    Index const size = PyLong_AsSsize_t(PyTuple_GetItem(pair, 1));
    Index const count = size < 0 ? 1 : size ? program.rows * size : numbers;
    Shape const shape = size < 0 ? Shape::NUMBER : size ? Shape::TABLE : Shape::FULL;
    Buffer array;
    int const flags = PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE;
    if (!array.open(PyTuple_GetItem(pair, 0), count, sizeof(double), flags)) return nullptr;
    bound->inputs.push_back({array.as<void>(), shape, std::max<Index>(size, 0), true});
  }
  for (Py_ssize_t i = 0; i < PyTuple_Size(arguments[2]); ++i) {
    Buffer array;
    if (!array.open(PyTuple_GetItem(arguments[2], i), numbers, 0, PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE)) return nullptr;
    bound->outputs.push_back({array.as<void>(), array.itemsize() == 1});
  }
  if (!tables_fit(program, bound->inputs)) return misfit();
  return capsule_of(std::move(bound));
}

// bind_ticks(bound programs, address of a Tick): the caller keeps both alive.
PyObject *bind_ticks(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  auto bound = std::make_unique<BoundTicks>();
  bound->tick = structure<Tick>(arguments[1]);
  if (bound->tick == nullptr) return nullptr;
  for (Py_ssize_t i = 0; i < PyTuple_Size(arguments[0]); ++i) {
    auto *program = held<BoundProgram>(PyTuple_GetItem(arguments[0], i));
    if (program == nullptr) return nullptr;
    bound->programs.push_back(program);
  }
  return capsule_of(std::move(bound));
}

// ticks(bound ticks of groups, until, steps, whole): see run_ticks; place and status are in the structures.
PyObject *ticks(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  std::vector<BoundTicks *> groups;
  for (Py_ssize_t i = 0; i < PyTuple_Size(arguments[0]); ++i) {
    groups.push_back(held<BoundTicks>(PyTuple_GetItem(arguments[0], i)));
    if (groups.back() == nullptr) return nullptr;
    Tick const &tick = *groups.back()->tick;
    for (BoundProgram const *bound : groups.back()->programs) {
      if (bound->program->rows != tick.group->robots || bound->program->columns != tick.group->dof) return misfit();
    }
  }
  std::int64_t const until = PyLong_AsLongLong(arguments[1]), steps = PyLong_AsLongLong(arguments[2]);
  bool const whole = PyObject_IsTrue(arguments[3]) == 1;
  if (PyErr_Occurred()) return nullptr;
  return without_gil([&] {
    for (BoundTicks *bound : groups) bound->tick->status = run_ticks(*bound, until, steps, whole);
  });
}

// joint_matrices(address of a Model, qpos, out, rows): the mass matrices that the joints show.
PyObject *joint_matrices(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  auto const *model = structure<Model>(arguments[0]);
  if (model == nullptr) return nullptr;
  Py_ssize_t const rows = PyLong_AsSsize_t(arguments[3]), dof = model->dof;
  return on_doubles(arguments + 1, {rows * dof, rows * dof * dof}, 1,
                    [&](auto const &of) { write_joint_matrices(*model, rows, of[0], of[1]); });
}

// forces(address of a Model, gravity, coriolis, qpos, qvel, base or None, out, rows)
PyObject *forces(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  auto const *model = structure<Model>(arguments[0]);
  if (model == nullptr) return nullptr;
  Parts const parts{PyObject_IsTrue(arguments[1]) == 1, PyObject_IsTrue(arguments[2]) == 1};
  Py_ssize_t const rows = PyLong_AsSsize_t(arguments[7]), count = rows * model->dof;
  Py_ssize_t const base = arguments[5] == Py_None ? 0 : BASE_SIZE * rows;
  return on_doubles(arguments + 3, {count, count, base, count}, 3,
                    [&](auto const &at) { write_forces(*model, parts, rows, at[0], at[1], at[2], at[3]); });
}

// refresh(address of a Refresh, qpos, gain, memory, rows)
PyObject *refresh_friction(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  auto const *of = structure<Refresh>(arguments[0]);
  if (of == nullptr) return nullptr;
  Py_ssize_t const rows = PyLong_AsSsize_t(arguments[4]), count = rows * of->model->dof;
  return on_doubles(arguments + 1, {count, count, count}, 1,
                    [&](auto const &at) { refresh(*of, rows, at[0], at[1], at[2], nullptr); });
}

// update_constraint(address of a Constraint, qpos, passive, mask of robots, rows)
PyObject *update(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  auto const *of = structure<Constraint>(arguments[0]);
  if (of == nullptr) return nullptr;
  Py_ssize_t const rows = PyLong_AsSsize_t(arguments[4]), count = rows * of->model->dof;
  Buffer wanted;
  if (!wanted.open(arguments[3], rows, 1, PyBUF_C_CONTIGUOUS)) return nullptr;
  return on_doubles(arguments + 1, {count, count}, 2,
                    [&](auto const &at) { update_constraint(*of, rows, at[0], at[1], wanted.as<char>(), nullptr); });
}

// Add (structure, field, letter of its type, count, offset, size of the structure) to a list.
template <class T>
bool add_field(PyObject *list, char const *structure, char const *path, std::size_t offset, std::size_t size) {
  using Entry = std::remove_all_extents_t<T>;
  char letter = 'c';
  if (std::is_pointer_v<Entry>) {
    letter = 'P';
  } else if (std::is_floating_point_v<Entry>) {
    letter = 'd';
  } else if (sizeof(Entry) > 1) {
    letter = sizeof(Entry) == sizeof(std::int64_t) ? 'q' : 'i';
  }
  char const *dot = std::strrchr(path, '.');
  auto const count = static_cast<Py_ssize_t>(sizeof(T) / sizeof(Entry));
  PyObject *row = Py_BuildValue("(ssCnnn)", structure, dot == nullptr ? path : dot + 1, letter, count,
                                static_cast<Py_ssize_t>(offset), static_cast<Py_ssize_t>(size));
  bool const good = row != nullptr && PyList_Append(list, row) == 0;
  Py_XDECREF(row);
  return good;
}

bool add_number(PyObject *numbers, char const *name, long value) {
  PyObject *number = PyLong_FromLong(value);
  bool const good = number != nullptr && PyDict_SetItemString(numbers, name, number) == 0;
  Py_XDECREF(number);
  return good;
}

PyMethodDef METHODS[] = {
    {"type_info", type_info, METH_O, nullptr},
    {"sim_step", method(step_group), METH_FASTCALL, nullptr},
    {"bind", method(bind), METH_FASTCALL, nullptr},
    {"bind_ticks", method(bind_ticks), METH_FASTCALL, nullptr},
    {"ticks", method(ticks), METH_FASTCALL, nullptr},
    {"joint_matrices", method(joint_matrices), METH_FASTCALL, nullptr},
    {"forces", method(forces), METH_FASTCALL, nullptr},
    {"refresh", method(refresh_friction), METH_FASTCALL, nullptr},
    {"update_constraint", method(update), METH_FASTCALL, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_gateway", nullptr, -1, METHODS, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__gateway() {
  PyObject *module = batchpid::make_module(MODULE);
  PyObject *fields = PyList_New(0), *numbers = PyDict_New();
  bool good = module != nullptr && fields != nullptr && numbers != nullptr;
#define FIELD(T, path)                                                                                              \
  good = good && add_field<decltype(std::declval<T>().path)>(fields, #T, #path, offsetof(T, path), sizeof(T));
#define NUMBER(T, name) good = good && add_number(numbers, #T "." #name, static_cast<long>(T::name));
  FOR_ALL
#undef FIELD
#undef NUMBER
  good = good && PyModule_AddObjectRef(module, "fields", fields) == 0;
  good = good && PyModule_AddObjectRef(module, "numbers", numbers) == 0;
  Py_XDECREF(fields);
  Py_XDECREF(numbers);
  if (!good) Py_CLEAR(module);
  return module;
}
