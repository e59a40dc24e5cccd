// Functions that a program of XLA can call, by its foreign function interface, on the CPU: the sim step, and the mass
// matrix.
//
// The types are those parts of XLA's C interface (xla/ffi/api/c_api.h, version 0.3, stable since 0.0) that are needed
// here, so that neither jaxlib nor its headers are needed to compile this file.

#pragma once

#include "sim_step.h"

namespace batchpid::xla {

enum Stage { EXECUTE = 3 };

struct Version {
  std::size_t struct_size;
  void *extension;
  int major, minor;
};

struct Metadata {
  std::size_t struct_size;
  Version version;
};

struct Extension {
  std::size_t struct_size;
  int type;  // 1: Metadata
  Extension *next;
  Metadata *metadata;
};

struct Array {
  std::size_t struct_size;
  void *extension;
  int dtype;
  void *data;
  std::int64_t rank;
  std::int64_t *dims;
};

struct Arrays {
  std::size_t struct_size;
  void *extension;
  std::int64_t size;
  int *types;
  Array **arrays;
};

struct CallFrame {
  std::size_t struct_size;
  Extension *extension;
  void const *api;
  void *context;
  int stage;
  Arrays arguments, results;
};

// Answer XLA's question for the version, and stages before the execution; return whether the call is one of these.
inline bool is_answered(CallFrame *frame) {
  if (frame->extension != nullptr && frame->extension->type == 1) {
    frame->extension->metadata->version.major = 0;
    frame->extension->metadata->version.minor = 3;
    return true;
  }
  return frame->stage != EXECUTE;
}

template <class T>
T *data(Array const *array) {
  return static_cast<T *>(array->data);
}

// (address of the Group as u32[2], number of the step, effort) -> qpos, qvel, passive force, Status: arrays of float64,
// with a row for each robot or more, as xla.py makes them. The number of the step is not used: no two calls have the same
// arguments, so that none can be merged or moved out of a loop.
extern "C" inline void *batchpid_sim_step(CallFrame *frame) {
  if (is_answered(frame)) return nullptr;
  Array **in = frame->arguments.arrays, **out = frame->results.arrays;
  Group *group;
  static_assert(sizeof(group) == 2 * sizeof(std::uint32_t));
  std::memcpy(&group, in[0]->data, sizeof(group));
  *data<std::int32_t>(out[3]) = try_sim_step(*group, in[2]->dims[0], data<double const>(in[2]), data<double>(out[0]),
                                             data<double>(out[1]), data<double>(out[2]));
  return nullptr;
}

// (tree (dof, 2) s32, bodies (dof, 25), qpos (rows, dof)) -> mass matrices (rows, dof, dof), all but the tree float64
extern "C" inline void *batchpid_mass_matrix(CallFrame *frame) {
  if (is_answered(frame)) return nullptr;
  Array **in = frame->arguments.arrays, *out = *frame->results.arrays;
  std::int64_t const rows = in[2]->dims[0], dof = in[2]->dims[1];
  write_mass_matrices({dof, data<std::int32_t const>(in[0]), data<double const>(in[1])}, rows, data<double const>(in[2]),
                      nullptr, 0.0, data<double>(out));
  return nullptr;
}

}  // namespace batchpid::xla
