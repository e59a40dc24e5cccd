// Gateway to the robots of a pack: one call from Python for all of them, instead of one call for each.
//
// It calls functions that SAPIEN's shared library exports. Their addresses and the objects' pointers come from Python
// (sim/engine/native/__init__.py), so that nothing of SAPIEN, PhysX or Eigen is needed to compile this file.

#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <typeinfo>
#include <vector>

namespace sapien::physx {
class PhysxArticulation {};  // never defined here; their type_info, which pybind11 compares by name, is all that is used
class PhysxSystemCpu {};
}  // namespace sapien::physx

namespace {

using Articulation = sapien::physx::PhysxArticulation;
using System = sapien::physx::PhysxSystemCpu;

// Layout of Eigen::VectorXf. Its destructor makes the compiler return it as it returns Eigen's.
struct VectorXf {
  float *data;
  std::ptrdiff_t size;
  ~VectorXf() { std::free(data); }
};

// Exported functions, in the order in which Python passes their addresses.
struct Functions {
  VectorXf (*get_qpos)(Articulation *);
  VectorXf (*get_qvel)(Articulation *);
  VectorXf (*compute_passive_force)(Articulation *, bool gravity, bool coriolis);
  void (*set_qf)(Articulation *, VectorXf const &);
  void (*step)(System *);
};

struct Gateway {
  Functions functions;
  std::vector<Articulation *> robots;
  std::vector<System *> systems;
  std::ptrdiff_t dof;
};

constexpr char GATEWAY[] = "batchpid.gateway";

// Contiguous buffer of a Python object, released at the end of the scope.
class Buffer {
 public:
  bool open(PyObject *object, Py_ssize_t count, Py_ssize_t size, int flags) {
    if (PyObject_GetBuffer(object, &view_, flags) != 0) return false;
    held_ = true;
    if ((size == 0 || view_.itemsize == size) && view_.len == count * view_.itemsize) return true;
    PyErr_SetString(PyExc_ValueError, "an array of the gateway has a wrong size or type");
    return false;
  }
  ~Buffer() {
    if (held_) PyBuffer_Release(&view_);
  }
  template <class T>
  T *as() const {
    return static_cast<T *>(view_.buf);
  }
  Py_ssize_t itemsize() const { return view_.itemsize; }

 private:
  Py_buffer view_{};
  bool held_ = false;
};

Gateway *gateway_of(PyObject *capsule) {
  return static_cast<Gateway *>(PyCapsule_GetPointer(capsule, GATEWAY));
}

// Run `work` without the GIL; a C++ exception becomes a RuntimeError.
template <class Work>
PyObject *without_gil(Work work) {
  char message[512] = "";
  Py_BEGIN_ALLOW_THREADS
  try {
    work();
  } catch (std::exception const &error) {
    std::strncpy(message, error.what(), sizeof(message) - 1);
    if (message[0] == 0) std::strcpy(message, "SAPIEN raised an exception");
  } catch (...) {
    std::strcpy(message, "SAPIEN raised an exception");
  }
  Py_END_ALLOW_THREADS
  if (message[0] == 0) Py_RETURN_NONE;
  PyErr_SetString(PyExc_RuntimeError, message);
  return nullptr;
}

template <class T>
bool pointers(PyObject *sequence, std::vector<T *> &out) {
  Py_ssize_t const count = PySequence_Size(sequence);
  if (count < 0) return false;
  for (Py_ssize_t i = 0; i < count; ++i) {
    PyObject *item = PySequence_GetItem(sequence, i);
    if (item == nullptr) return false;
    void *pointer = PyLong_AsVoidPtr(item);
    Py_DECREF(item);
    if (pointer == nullptr) {
      if (!PyErr_Occurred()) PyErr_SetString(PyExc_ValueError, "a null pointer");
      return false;
    }
    out.push_back(static_cast<T *>(pointer));
  }
  return true;
}

// type_info("robot" | "system"): capsule with the C++ type, as pybind11's conduit expects it.
PyObject *type_info(PyObject *, PyObject *argument) {
  Py_ssize_t size = 0;
  char const *kind = PyUnicode_AsUTF8AndSize(argument, &size);
  if (kind == nullptr) return nullptr;
  auto const &info = std::strcmp(kind, "robot") == 0 ? typeid(Articulation) : typeid(System);
  return PyCapsule_New(const_cast<std::type_info *>(&info), typeid(std::type_info).name(), nullptr);
}

// gateway(functions, robots, systems, dof): addresses and pointers as integers; the caller keeps the objects alive.
PyObject *make_gateway(PyObject *, PyObject *arguments) {
  PyObject *functions, *robots, *systems;
  Py_ssize_t dof;
  if (!PyArg_ParseTuple(arguments, "OOOn", &functions, &robots, &systems, &dof)) return nullptr;
  std::vector<char *> addresses;
  auto *gateway = new Gateway{};
  gateway->dof = dof;
  if (!pointers(functions, addresses) || !pointers(robots, gateway->robots) || !pointers(systems, gateway->systems)) {
    delete gateway;
    return nullptr;
  }
  static_assert(sizeof(Functions) == 5 * sizeof(void *));
  if (addresses.size() != 5) {
    delete gateway;
    PyErr_SetString(PyExc_ValueError, "needs five functions");
    return nullptr;
  }
  std::memcpy(&gateway->functions, addresses.data(), sizeof(Functions));
  return PyCapsule_New(gateway, GATEWAY, [](PyObject *capsule) { delete gateway_of(capsule); });
}

// Copy one vector of each robot into the rows of an array of float or double.
template <class Get>
PyObject *read_rows(PyObject *capsule, PyObject *array, Get get) {
  Gateway *gateway = gateway_of(capsule);
  if (gateway == nullptr) return nullptr;
  auto const count = static_cast<Py_ssize_t>(gateway->robots.size()) * gateway->dof;
  Buffer out;
  if (!out.open(array, count, 0, PyBUF_WRITABLE | PyBUF_C_CONTIGUOUS)) return nullptr;
  bool const wide = out.itemsize() == sizeof(double);
  return without_gil([&] {
    Py_ssize_t at = 0;
    for (Articulation *robot : gateway->robots) {
      VectorXf const row = get(gateway->functions, robot);
      if (row.size != gateway->dof) throw std::bad_exception();
      for (std::ptrdiff_t i = 0; i < row.size; ++i, ++at) {
        if (wide) {
          out.as<double>()[at] = row.data[i];
        } else {
          out.as<float>()[at] = row.data[i];
        }
      }
    }
  });
}

PyObject *read_qpos(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  return read_rows(arguments[0], arguments[1], [](Functions const &f, Articulation *robot) { return f.get_qpos(robot); });
}

PyObject *read_qvel(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  return read_rows(arguments[0], arguments[1], [](Functions const &f, Articulation *robot) { return f.get_qvel(robot); });
}

// passive_force(gateway, out, gravity, coriolis)
PyObject *passive_force(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  bool const gravity = PyObject_IsTrue(arguments[2]) == 1, coriolis = PyObject_IsTrue(arguments[3]) == 1;
  return read_rows(arguments[0], arguments[1], [=](Functions const &f, Articulation *robot) {
    return f.compute_passive_force(robot, gravity, coriolis);
  });
}

// write_qf(gateway, qf, skip): qf (robots, dof) of float; robots of the mask `skip` keep what they have.
PyObject *write_qf(PyObject *, PyObject *const *arguments, Py_ssize_t) {
  Gateway *gateway = gateway_of(arguments[0]);
  if (gateway == nullptr) return nullptr;
  auto const count = static_cast<Py_ssize_t>(gateway->robots.size());
  Buffer qf, skip;
  if (!qf.open(arguments[1], count * gateway->dof, sizeof(float), PyBUF_C_CONTIGUOUS)) return nullptr;
  if (!skip.open(arguments[2], count, 1, PyBUF_C_CONTIGUOUS)) return nullptr;
  return without_gil([&] {
    for (Py_ssize_t row = 0; row < count; ++row) {
      if (skip.as<char>()[row]) continue;
      VectorXf const *view;
      struct {
        float *data;
        std::ptrdiff_t size;
      } borrowed{qf.as<float>() + row * gateway->dof, gateway->dof};
      static_assert(sizeof(borrowed) == sizeof(VectorXf));
      view = reinterpret_cast<VectorXf const *>(&borrowed);
      gateway->functions.set_qf(gateway->robots[row], *view);
    }
  });
}

PyObject *step(PyObject *, PyObject *capsule) {
  Gateway *gateway = gateway_of(capsule);
  if (gateway == nullptr) return nullptr;
  return without_gil([&] {
    for (System *system : gateway->systems) gateway->functions.step(system);
  });
}

template <class Function>
PyCFunction method(Function function) {
  return reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(function));
}

PyMethodDef METHODS[] = {
    {"type_info", type_info, METH_O, nullptr},
    {"gateway", make_gateway, METH_VARARGS, nullptr},
    {"read_qpos", method(read_qpos), METH_FASTCALL, nullptr},
    {"read_qvel", method(read_qvel), METH_FASTCALL, nullptr},
    {"passive_force", method(passive_force), METH_FASTCALL, nullptr},
    {"write_qf", method(write_qf), METH_FASTCALL, nullptr},
    {"step", step, METH_O, nullptr},
    {nullptr, nullptr, 0, nullptr},
};

PyModuleDef MODULE = {PyModuleDef_HEAD_INIT, "_gateway", nullptr, -1, METHODS, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__gateway() { return PyModule_Create(&MODULE); }
