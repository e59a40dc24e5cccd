// One sim step of robots in MuJoCo. Functions and pointers come from Python (sim/engine/mujoco/mujoco_step.py), so that
// nothing of MuJoCo is needed to compile this file.

#pragma once

#include "clearance.h"

#include <atomic>
#include <csetjmp>
#include <cstdint>
#include <cstring>
#include <mutex>

#pragma GCC visibility push(hidden)

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

// Robots in MuJoCo; Python fills in the fields (Mujoco in interface.py) and owns what they point to.
struct Mujoco {
  MujocoStage step1, step2;                 // mj_step1, mj_step2
  LogHandler (*set_log_handler)(LogHandler);  // mju_setLogHandler
  Clock *clock;                             // mjcb_time
  void const *const *models;                // (robots,)
  void *const *data;                        // (robots,)
  double *const *qpos, *const *qvel;        // (robots,): arrays of their mjData
  double *const *applied, *const *bias;
  std::int64_t const *qpos_at, *qvel_at;    // (dof,): places of the joints in these arrays
  double *qf;                               // (robots, dof): efforts last applied
  double *const *ctrl;                      // (robots,): arrays of their mjData, (dof,) each with drives
  double const *stiffness, *rate_gain;      // (robots, dof): of the drives, or null without targets that move
  char const *continuous;                   // (dof,): joints whose targets may be whole turns away
  Clearance const *clearance;               // or null: MuJoCo looks for contacts in every sim step
};

// Handler of MuJoCo's messages while this thread steps: an error, which would end the process, leaves the step.
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
    if (message->level < LOG_ERROR) return;  // the loop finds states that are not finite
    std::size_t const size = strnlen(message->subject, 255);
    std::memcpy(text, message->subject, size);
    text[size] = '\0';
    std::longjmp(*frame, 1);
  }
};

// Stop MuJoCo's clock while any thread steps: a step would read it forty times, a tenth of its cost, for the durations in
// mjData, which nothing here uses. A constant takes the clock's place, since another thread may be about to call it.
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

// Advance one robot: from velocities to the next velocities. The state of a robot that diverges stays as it is then.
// Return false after an error of MuJoCo, with its message.
inline bool advance(Mujoco const &mujoco, std::int64_t row, std::int64_t dof, double farthest, char *message) {
  std::jmp_buf frame;
  Clearance const *clearance = mujoco.clearance;
  Messages::text = message;
  Messages::frame = &frame;
  if (setjmp(frame) != 0) {
    if (clearance != nullptr) switch_contacts(*clearance, row, Looked::ALL);
    Messages::frame = nullptr;
    return false;
  }
  mujoco.step2(mujoco.models[row], mujoco.data[row]);
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
    if (looked != Looked::ALL) switch_contacts(*clearance, row, looked);
    mujoco.step1(mujoco.models[row], mujoco.data[row]);
    if (looked != Looked::ALL) switch_contacts(*clearance, row, Looked::ALL);
  }
  Messages::frame = nullptr;
  return true;
}

}  // namespace batchpid

#pragma GCC visibility pop
