// Functions that a program of XLA can call, by its foreign function interface, on the CPU: the sim step, and the mass
// matrix.
//
// The types are those parts of XLA's C interface (xla/ffi/api/c_api.h, version 0.3, stable since 0.0) that are needed
// here, so that neither jaxlib nor its headers are needed to compile this file.

#pragma once

#include "model.h"
#include "sim_step.h"

namespace batchpid::xla {

enum DataType { F32 = 11, F64 = 12 };
enum Stage { EXECUTE = 3 };

struct Error;

struct ErrorArguments {
  std::size_t struct_size;
  void *extension;
  char const *message;
  int code;
};

struct Version {
  std::size_t struct_size;
  void *extension;
  int major, minor;
};

struct Api {
  std::size_t struct_size;
  void *extension;
  Version version;
  void const *internal;
  Error *(*create_error)(ErrorArguments *);
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
  Api const *api;
  void *context;
  int stage;
  Arrays arguments, results;
};

inline Error *invalid(Api const *api, char const *message) {
  ErrorArguments arguments{sizeof(ErrorArguments), nullptr, message, 3};
  return api->create_error(&arguments);
}

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
extern "C" inline Error *batchpid_sim_step(CallFrame *frame) {
  if (is_answered(frame)) return nullptr;
  Array **in = frame->arguments.arrays, **out = frame->results.arrays;
  Group *group;
  static_assert(sizeof(group) == 2 * sizeof(std::uint32_t));
  std::memcpy(&group, in[0]->data, sizeof(group));
  *data<std::int32_t>(out[3]) = try_sim_step(*group, in[2]->dims[0], data<double const>(in[2]), data<double>(out[0]),
                                             data<double>(out[1]), data<double>(out[2]));
  return nullptr;
}

// (tree (dof, 2) s32, bodies (dof, 25), qpos (..., dof)) -> mass matrices (..., dof, dof)
extern "C" inline Error *batchpid_mass_matrix(CallFrame *frame) {
  if (is_answered(frame)) return nullptr;
  Array **in = frame->arguments.arrays, *out = *frame->results.arrays;
  std::int64_t const dof = in[2]->dims[in[2]->rank - 1];
  std::int64_t count = 1;
  for (std::int64_t axis = 0; axis + 1 < in[2]->rank; ++axis) count *= in[2]->dims[axis];
  if (in[0]->dims[0] != dof || (out->dtype != F64 && out->dtype != F32)) {
    return invalid(frame->api, "an array has a wrong shape or type");
  }
  auto const *tree = data<std::int32_t const>(in[0]);
  if (out->dtype == F64) {
    write_mass_matrices({dof, tree, data<double const>(in[1])}, count, data<double const>(in[2]), nullptr, 0.0,
                        data<double>(out));
  } else {
    write_float_mass_matrices({dof, tree, data<float const>(in[1])}, count, data<float const>(in[2]), data<float>(out));
  }
  return nullptr;
}

}  // namespace batchpid::xla
