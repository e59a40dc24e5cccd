// Gateway to the robots of a pack, and what its calls share; see gateway.cpp.

#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <typeinfo>
#include <vector>

#include "batchpid/native/buffer.h"

namespace sapien::physx {
// Never defined here: their type_info, which pybind11 compares by name, is all that is used.
class __attribute__((visibility("default"))) PhysxArticulation {};
class __attribute__((visibility("default"))) PhysxSystemCpu {};
class __attribute__((visibility("default"))) PhysxArticulationJoint {};
}  // namespace sapien::physx

namespace batchpid {

using Articulation = sapien::physx::PhysxArticulation;
using System = sapien::physx::PhysxSystemCpu;
using Joint = sapien::physx::PhysxArticulationJoint;

// Layout of Eigen::VectorXf. Its destructor makes the compiler return it as it returns Eigen's.
struct VectorXf {
  float *data;
  std::ptrdiff_t size;
  ~VectorXf() { std::free(data); }
};

// Pose of the root link, and an angular velocity, in the world.
struct RootPose {
  float wxyz[4], position[3];
};
struct Vec3 {
  float x, y, z;
};

// Exported functions: SYMBOLS in interface.py.
struct Functions {
  VectorXf (*get_qpos)(Articulation *);
  VectorXf (*get_qvel)(Articulation *);
  VectorXf (*compute_passive_force)(Articulation *, bool gravity, bool coriolis);
  void (*set_qf)(Articulation *, VectorXf const &);
  void (*step)(System *);
  void (*set_drive_position)(Joint *, float);
  void (*set_drive_velocity)(Joint *, float);
  RootPose (*get_root_pose)(Articulation *);
  Vec3 (*get_root_angular_velocity)(Articulation *);
};

struct Gateway {
  static constexpr char CAPSULE[] = "batchpid.gateway";

  Functions functions;
  std::vector<Articulation *> robots;
  std::vector<System *> systems;  // one for each robot
  std::ptrdiff_t dof;
};

// Apply the efforts of one robot (dof,), which stay the caller's.
inline void apply(Functions const &call, Articulation *robot, float *qf, std::ptrdiff_t dof) {
  union Borrowed {
    VectorXf vector;
    ~Borrowed() {}
  } borrowed{{qf, dof}};
  call.set_qf(robot, borrowed.vector);
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

}  // namespace batchpid
