// Ticks of a group of robots in one call, as long as nothing happens that Python has to handle.

#pragma once

#include "tick.h"

#include <cmath>
#include <cstring>

#pragma GCC visibility push(hidden)

namespace batchpid {

enum TransferKind : std::int32_t { READ, WRITE_FLOATS, WRITE_BYTES };

// Copy between a row, which is the same in every tick, and a table with an entry for each tick: Transfer in interface.py.
struct Transfer {
  char *table;          // double to READ, float to WRITE_FLOATS
  char *row;            // double, except to WRITE_BYTES
  std::int64_t stride;  // of the table's ticks [bytes]; 0: each tick overwrites the one before
  std::int64_t size;    // numbers, or bytes
  std::int32_t kind, unused;
};

// Whether all are finite.
inline bool are_finite(double const *values, std::int64_t size) {
  double sum = 0.0;
  for (std::int64_t i = 0; i < size; ++i) sum += 0.0 * values[i];  // NaN for NaN and infinity
  return sum == 0.0;
}

// Read the commands of a tick. Return whether they are finite.
inline bool read_commands(Transfer const *transfers, std::int64_t count, std::int64_t tick) {
  bool finite = true;
  for (Transfer const *each = transfers; each != transfers + count; ++each) {
    if (each->kind != READ) continue;
    std::memcpy(each->row, each->table + tick * each->stride, static_cast<std::size_t>(each->size) * sizeof(double));
    finite = finite && are_finite(reinterpret_cast<double const *>(each->row), each->size);
  }
  return finite;
}

// Write the observation of a tick.
inline void write_observation(Transfer const *transfers, std::int64_t count, std::int64_t tick) {
  for (Transfer const *each = transfers; each != transfers + count; ++each) {
    char *table = each->table + tick * each->stride;
    if (each->kind == WRITE_BYTES) std::memcpy(table, each->row, static_cast<std::size_t>(each->size));
    if (each->kind != WRITE_FLOATS) continue;
    for (std::int64_t i = 0; i < each->size; ++i) {
      reinterpret_cast<float *>(table)[i] = static_cast<float>(reinterpret_cast<double const *>(each->row)[i]);
    }
  }
}

// Run ticks of `steps` sim steps from `tick` to `until`. Stop in a tick whose command is not finite, after an event in it,
// or if velocities are not finite after it. Advance `tick` by the ticks completed; `step` is how many sim steps of the
// next one are done. Return the status of the last sim step.
inline std::int32_t run_ticks(Programs const &programs, Tick const &arrays, Group &group, Transfer const *transfers,
                              std::int64_t count, std::int64_t &tick, std::int64_t until, std::int64_t steps,
                              std::int64_t &step) {
  for (step = 0; tick < until; ++tick, step = 0) {
    if (!read_commands(transfers, count, tick)) return 0;
    std::int32_t const status = run_tick(programs, arrays, group, step, steps, steps);
    if (status != 0 || !are_finite(arrays.qvel, group.robots * group.dof)) return status;
    write_observation(transfers, count, tick);
  }
  return 0;
}

}  // namespace batchpid

#pragma GCC visibility pop
