// Gateway to the robots of a pack, and what its calls share; see gateway.cpp.

#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <typeinfo>

#include "batchpid/native/extension.h"

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

// Exported functions of SAPIEN.
struct FOR_PYTHON Functions {
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

// Apply the efforts of one robot (dof,), which stay the caller's.
inline void apply(Functions const &call, Articulation *robot, float *qf, std::ptrdiff_t dof) {
  union Borrowed {
    VectorXf vector;
    ~Borrowed() {}
  } borrowed{{qf, dof}};
  call.set_qf(robot, borrowed.vector);
}

// Run `work`. Return whether it ended without a C++ exception, whose message is written otherwise.
template <std::size_t SIZE, class Work>
bool succeeds(char (&message)[SIZE], Work work) {
  try {
    work();
    return true;
  } catch (std::exception const &error) {
    std::strncpy(message, error.what(), SIZE - 1);
  } catch (...) {
    message[0] = 0;
  }
  if (message[0] == 0) std::strcpy(message, "SAPIEN raised an exception");
  return false;
}

inline PyObject *none() { Py_RETURN_NONE; }

// Run `work` without the GIL, and return the `result` after it; a C++ exception becomes a RuntimeError.
template <class Work, class Result = PyObject *(*)()>
PyObject *without_gil(Work work, Result result = none) {
  char message[512] = "";
  bool done = false;
  Py_BEGIN_ALLOW_THREADS
  done = succeeds(message, work);
  Py_END_ALLOW_THREADS
  if (done) return result();
  PyErr_SetString(PyExc_RuntimeError, message);
  return nullptr;
}

// The same with work on the data of arrays of double with these counts of numbers, of which those from `written` on are
// results. None is an array of no numbers, without data.
template <std::size_t N, class Work, class Result = PyObject *(*)()>
PyObject *on_doubles(PyObject *const *given, Py_ssize_t const (&counts)[N], std::size_t written, Work work,
                     Result result = none) {
  Buffer arrays[N];
  double *data[N] = {};
  for (std::size_t i = 0; i < N; ++i) {
    int const flags = PyBUF_C_CONTIGUOUS | (i < written ? 0 : PyBUF_WRITABLE);
    Buffer &array = arrays[i];
    if (counts[i] == 0 && given[i] == Py_None) continue;
    if (!array.open(given[i], counts[i], sizeof(double), flags)) return nullptr;
    data[i] = array.as<double>();
  }
  return without_gil([&] { work(data); }, result);
}

}  // namespace batchpid
