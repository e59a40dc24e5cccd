// One sim step of robots in MuJoCo. Functions and pointers come from Python (sim/engine/mujoco/mujoco_step.py), so this
// file compiles without MuJoCo.

#pragma once

#include "clearance.h"

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

// Robots in MuJoCo. Python fills in the fields (Mujoco in interface.py) and owns the memory behind the pointers.
struct Mujoco {
  MujocoStage step1, step2;                 // mj_step1, mj_step2
  LogHandler (*set_log_handler)(LogHandler);  // mju_setLogHandler
  Clock *clock;                             // mjcb_time
  void const *const *models;                // (robots,)
  void *const *data;                        // (robots,)
  double *const *qpos, *const *qvel;        // (robots,): arrays of their mjData
  double *const *applied, *const *bias;
  std::int64_t const *qpos_at, *qvel_at;    // (dof,): indices of the joints in these arrays
  double *qf;                               // (robots, dof): efforts last applied
  double *const *ctrl;                      // (robots,): arrays of their mjData, (dof,) each with drives
  double const *stiffness, *rate_gain;      // (robots, dof): gains of the drives, or null if no target changes
  Clearance const *clearance;               // or null: collision detection of all shapes in every sim step
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
  StoppedClock(StoppedClock const &) = delete;
  StoppedClock &operator=(StoppedClock const &) = delete;

 private:
  Clock *clock_;
  static inline std::mutex mutex_;
  static inline int threads_ = 0;
  static inline Clock before_ = nullptr;
};

// Advance one robot: mj_step2 of this sim step, then mj_step1 of the next one. A robot that has diverged keeps its
// state, without mj_step1. Return false, with a message, after an error of MuJoCo.
inline bool advance(Mujoco const &mujoco, std::int64_t row, std::int64_t dof, double farthest, char *message) {
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
  mujoco.step2(mujoco.models[row], mujoco.data[row]);
  for (std::int64_t i = 0; i < mujoco.sensor_size; ++i) {
    mujoco.sensed[row * mujoco.sensor_size + i] += mujoco.sensors[row][i];
  }
  bool finite = true;
  for (std::int64_t joint = 0; joint < dof; ++joint) {
    double const q = mujoco.qpos[row][mujoco.qpos_at[joint]];
    finite = finite && q <= farthest && q >= -farthest;
  }
  if (finite) {
    Looked looked = Looked::ALL;
    if (clearance != nullptr) {
      looked = looked_at(*clearance, row, dof, mujoco.data[row], mujoco.qpos[row], mujoco.qpos_at);
    }
    if (looked != Looked::ALL) set_shapes(*clearance, row, part_of(shapes, *clearance, row, looked));
    mujoco.step1(mujoco.models[row], mujoco.data[row]);
    if (looked != Looked::ALL) set_shapes(*clearance, row, shapes);
  }
  Messages::frame = nullptr;
  return true;
}

}  // namespace batchpid
