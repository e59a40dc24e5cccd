// One sim step of robots in MuJoCo. Functions and pointers come from Python (sim/engine/mujoco/mujoco_step.py), so this
// file compiles without MuJoCo.

#pragma once

#include "clearance.h"
#include "free_motion.h"

#include <atomic>
#include <csetjmp>
#include <mutex>

namespace batchpid {

// Beginning of mjLogMessage (mjtype.h).
struct LogMessage {
  int level, topic;
  char subject[1024];
};
constexpr int LOG_ERROR = 3;

using LogHandler = void (*)(LogMessage const *);
using MujocoStage = void (*)(void const *model, void *data);
using Clock = double (*)();

// Robots in MuJoCo. Python fills in the fields and owns the memory behind the pointers.
struct FOR_PYTHON Mujoco {
  MujocoStage step1, step2;                 // mj_step1, mj_step2
  LogHandler (*set_log_handler)(LogHandler);  // mju_setLogHandler
  Clock *clock;                             // mjcb_time
  void const *const *models;                // (robots,)
  void *const *data;                        // (robots,)
  double *const *qpos, *const *qvel;        // (robots,): arrays of their mjData
  double *const *applied, *const *bias;
  double *const *warm;                      // (robots,): accelerations at which the solver starts, in their mjData
  int const *const *contacts;               // (robots,): numbers of contacts, in their mjData
  std::int64_t const *qpos_at, *qvel_at;    // (dof,): indices of the joints in these arrays
  double *qf;                               // (robots, dof): efforts last applied
  double *const *ctrl;                      // (robots,): arrays of their mjData, (dof,) each with drives
  double const *stiffness, *rate_gain;      // (robots, dof): gains of the drives, or null if no target changes
  Clearance const *clearance;               // or null: collision detection of all shapes in every sim step
  FreeMotion const *free;                   // of robots without contact, or null: all steps are MuJoCo's
  double const *const *sensors;             // (robots,): arrays of their mjData, (sensor_size,) each
  double *sensed;                           // (robots, sensor_size): sums of the sensors over sim steps
  std::int64_t sensor_size;
  std::int64_t base_qpos, base_qvel;        // indices of that base
};

// Handler of MuJoCo's messages while this thread steps. After an error MuJoCo would end the process: the handler jumps
// out of the step instead.
struct Messages {
  static inline thread_local std::jmp_buf *frame = nullptr;
  static inline thread_local char *text = nullptr;  // (256,)
  static inline std::atomic<LogHandler> previous{nullptr};

  static void handle(LogMessage const *message) {
    if (frame == nullptr) {
      LogHandler const other = previous;
      if (other != nullptr) other(message);
      return;
    }
    if (message->level < LOG_ERROR) return;  // warnings of bad states: the loop itself checks that states are finite
    std::size_t const size = strnlen(message->subject, 255);
    std::memcpy(text, message->subject, size);
    text[size] = '\0';
    std::longjmp(*frame, 1);
  }
};

// Stop MuJoCo's clock while any thread steps. A step would read it forty times, a tenth of its time, for durations in
// mjData that are not used here. A constant clock replaces it, and not null: another thread may be about to call it.
class StoppedClock {
 public:
  explicit StoppedClock(Clock *clock) : clock_(clock) {
    std::lock_guard const lock(mutex_);
    if (threads_++ == 0) {
      before_ = *clock_;
      *clock_ = [] { return 0.0; };
    }
  }
  ~StoppedClock() {
    std::lock_guard const lock(mutex_);
    if (--threads_ == 0) *clock_ = before_;
  }

 private:
  Clock *clock_;
  static inline std::mutex mutex_;
  static inline int threads_ = 0;
  static inline Clock before_ = nullptr;
};

// Call functions of MuJoCo for a robot. Return false, with a message, after an error of it.
template <class Calls>
bool succeeds_in_mujoco(Mujoco const &mujoco, std::int64_t row, char *message, Calls calls) {
  std::jmp_buf frame;
  Clearance const *clearance = mujoco.clearance;
  Shapes const shapes = clearance == nullptr ? Shapes{} : get_shapes(*clearance, row);
  Messages::text = message;
  Messages::frame = &frame;
  if (setjmp(frame) != 0) {
    if (clearance != nullptr) set_shapes(*clearance, row, shapes);
    Messages::frame = nullptr;
    return false;
  }
  calls();
  Messages::frame = nullptr;
  return true;
}

// Do mj_step1 of a robot with a part of its shapes.
inline bool prepare(Mujoco const &mujoco, std::int64_t row, Looked looked, char *message) {
  return succeeds_in_mujoco(mujoco, row, message, [&] {
    if (looked == Looked::ALL) return mujoco.step1(mujoco.models[row], mujoco.data[row]);
    Shapes const shapes = get_shapes(*mujoco.clearance, row);
    set_shapes(*mujoco.clearance, row, part_of(shapes, *mujoco.clearance, row, looked));
    mujoco.step1(mujoco.models[row], mujoco.data[row]);
    set_shapes(*mujoco.clearance, row, shapes);
  });
}

// Do mj_step2 of a robot, and add its sensors.
inline bool advance(Mujoco const &mujoco, std::int64_t row, char *message) {
  bool const good = succeeds_in_mujoco(
      mujoco, row, message, [&] { mujoco.step2(mujoco.models[row], mujoco.data[row]); });
  for (std::int64_t i = 0; good && i < mujoco.sensor_size; ++i) {
    mujoco.sensed[row * mujoco.sensor_size + i] += mujoco.sensors[row][i];
  }
  return good;
}

// Copy the state of a robot to its mjData, or from there.
inline void write_to_mujoco(Mujoco const &mujoco, std::int64_t row) {
  FreeMotion const &free = *mujoco.free;
  std::int64_t const dof = free.model->dof, at = row / WIDTH * dof, k = row % WIDTH;
  for (std::int64_t j = 0; j < dof; ++j) {
    mujoco.qpos[row][mujoco.qpos_at[j]] = free.qpos[at + j].of[k];
    mujoco.qvel[row][mujoco.qvel_at[j]] = free.qvel[at + j].of[k];
    mujoco.warm[row][mujoco.qvel_at[j]] = free.acceleration[at + j].of[k];
    if (free.ctrl != nullptr) mujoco.ctrl[row][j] = free.ctrl[row * dof + j];
  }
}
inline void read_from_mujoco(Mujoco const &mujoco, std::int64_t row) {
  FreeMotion const &free = *mujoco.free;
  std::int64_t const dof = free.model->dof, at = row / WIDTH * dof, k = row % WIDTH;
  for (std::int64_t j = 0; j < dof; ++j) {
    free.qpos[at + j].of[k] = mujoco.qpos[row][mujoco.qpos_at[j]];
    free.qvel[at + j].of[k] = mujoco.qvel[row][mujoco.qvel_at[j]];
    free.acceleration[at + j].of[k] = mujoco.warm[row][mujoco.qvel_at[j]];
  }
}

}  // namespace batchpid
