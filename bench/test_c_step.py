"""Time of one step of the exported C header, compiled with -O2: a panda's seven joints, and all
nine.

It is processor time. "pid" has gains in effort units, "tuned" the bundled gains per mass matrix,
which is given; "mass matrix" and "bias" are the exported rigid-body functions. A round is a run of
the compiled program.
"""

import shutil
import subprocess

import pytest

from batchpid.export import to_c
from batchpid.io.files import write_atomically
from batchpid.sim import Robot

MAIN = """#include <stdio.h>
#include <time.h>
#include "pid.h"
#define N BATCHPID_JOINTS
int main(void) {
  static double x[3 * N], m[N * N], effort[N];
  batchpid_state state;
  double sum = 0, seconds;
  struct timespec a, b;
  for (int i = 0; i < 3 * N; ++i) x[i] = 0.1 * (i % 7);
  for (int i = 0; i < N; ++i) m[i * N + i] = 1 + i;
  batchpid_init(&state, x);
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &a);
  for (int i = 0; i < STEPS; ++i) {
    x[i % N] += 1e-9;
    CALL;
    sum += effort[i % N] + m[i % N];
  }
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &b);
  seconds = (double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec);
  printf("%.17g %g\\n", seconds / STEPS, sum);
  return 0;
}
"""
CALLS = {
    "pid": "batchpid_step(&state, x + N, x, x + 2 * N, x + N, effort)",
    "tuned": "batchpid_step(&state, x + N, x, x + 2 * N, x + N, m, effort)",
    "mass matrix": "batchpid_mass_matrix(x, m)",
    "bias": "batchpid_bias(x, x + 2 * N, effort)",
}


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler")
@pytest.mark.parametrize(
    ("call", "joints"), [("pid", 7), ("tuned", 9), ("mass matrix", 9), ("bias", 9)]
)
def test_step(benchmark, most, tmp_path, call, joints):
    robot = Robot.load("panda")
    tree = robot.kinematic_tree() if joints == robot.dof else None
    params = robot.tuned() if call == "tuned" else robot.designed("effort")
    params, names = params.for_joints(slice(joints)), robot.joint_names[:joints]
    if call == "pid":
        params = params.replace(
            effort_rate_limit=1000.0, derivative_filter_time=0.002, anti_windup="conditional"
        )
    params = params.replace(measurement_rate="measured")
    write_atomically(tmp_path / "pid.h", to_c(params, 1e-3, joint_names=names, tree=tree).text)
    write_atomically(tmp_path / "main.c", MAIN.replace("CALL", CALLS[call]))
    steps = 500_000 if most.floors else 1000
    words = [
        "cc",
        "-std=gnu99",
        "-O2",
        "-ffp-contract=off",
        f"-DSTEPS={steps}",
        "main.c",
        "-o",
        "main",
        "-lm",
    ]
    subprocess.run(words, cwd=tmp_path, check=True)
    times = []

    def run():
        ran = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True)
        times.append(float(ran.stdout.split()[0]))

    benchmark.pedantic(run, rounds=min(5, most.rounds))
    assert min(times) > 0
    benchmark.extra_info["nanoseconds_per_step"] = round(min(times) * 1e9, 1)
    print(f"{call}, {joints} joints: {min(times) * 1e9:.0f} ns")
