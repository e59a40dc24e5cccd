// Functions that a program of XLA can call, by its foreign function interface, on the CPU: the sim step, and the mass
// matrix.
//
// The types are those parts of XLA's C interface (xla/ffi/api/c_api.h, version 0.3, stable since 0.0) that are needed
// here, so that neither jaxlib nor its headers are needed to compile this file.

#pragma once

#include "model.h"
#include "sim_step.h"

namespace batchpid::xla {

enum DataType { S32 = 4, U32 = 8, F32 = 11, F64 = 12 };
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

// (address of the Group as u32[2], number of the step, effort) -> qpos, qvel, passive force, Status. The number of the
// step is not used: no two calls have the same arguments, so that none can be merged or moved out of a loop.
extern "C" inline Error *batchpid_sim_step(CallFrame *frame) {
  if (is_answered(frame)) return nullptr;
  if (frame->arguments.size != 3 || frame->results.size != 4) return invalid(frame->api, "wrong number of arrays");
  Array **in = frame->arguments.arrays, **out = frame->results.arrays;
  Group *group;
  static_assert(sizeof(group) == 2 * sizeof(std::uint32_t));
  if (in[0]->dtype != U32 || in[0]->rank != 1 || in[0]->dims[0] != 2) return invalid(frame->api, "no address");
  std::memcpy(&group, in[0]->data, sizeof(group));
  auto const robots = group->robots;
  for (Array const *array : {in[2], out[0], out[1], out[2]}) {
    if (array->dtype != F64 || array->rank != 2 || array->dims[0] != in[2]->dims[0] ||
        array->dims[1] != group->dof || array->dims[0] < robots || robots == 0) {
      return invalid(frame->api, "an array has a wrong shape or type");
    }
  }
  if (out[3]->dtype != S32) return invalid(frame->api, "the status is no int32");
  *data<std::int32_t>(out[3]) = try_sim_step(*group, in[2]->dims[0], data<double const>(in[2]), data<double>(out[0]),
                                             data<double>(out[1]), data<double>(out[2]));
  return nullptr;
}

// (tree (dof, 2) s32, bodies (dof, 25), qpos (..., dof)) -> mass matrices (..., dof, dof)
extern "C" inline Error *batchpid_mass_matrix(CallFrame *frame) {
  if (is_answered(frame)) return nullptr;
  Array **in = frame->arguments.arrays, *out = *frame->results.arrays;
  if (frame->arguments.size != 3 || frame->results.size != 1 || in[2]->rank < 1) {
    return invalid(frame->api, "wrong number of arrays");
  }
  std::int64_t const dof = in[2]->dims[in[2]->rank - 1];
  std::int64_t count = 1;
  for (std::int64_t axis = 0; axis + 1 < in[2]->rank; ++axis) count *= in[2]->dims[axis];
  bool const fits = in[0]->dtype == S32 && in[0]->rank == 2 && in[0]->dims[0] == dof && in[0]->dims[1] == 2 &&
                    in[1]->rank == 2 && in[1]->dims[0] == dof && in[1]->dims[1] == 25 && out->rank == in[2]->rank + 1;
  if (!fits || in[1]->dtype != in[2]->dtype || out->dtype != in[2]->dtype) {
    return invalid(frame->api, "an array has a wrong shape or type");
  }
  auto const *tree = data<std::int32_t const>(in[0]);
  if (out->dtype == F64) {
    write_mass_matrices({dof, tree, data<double const>(in[1])}, count, data<double const>(in[2]), nullptr, 0.0,
                        data<double>(out));
  } else if (out->dtype == F32) {
    write_float_mass_matrices({dof, tree, data<float const>(in[1])}, count, data<float const>(in[2]), data<float>(out));
  } else {
    return invalid(frame->api, "the arrays are neither float32 nor float64");
  }
  return nullptr;
}

}  // namespace batchpid::xla
