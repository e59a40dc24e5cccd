"""Vectors of robots have the same bits with each instruction set of the processor."""

import platform
import shutil
import subprocess
from pathlib import Path

import pytest

from batchpid.native.extensions import ROOT
from batchpid.sim.engine.native import EXTENSIONS

SETS = {"SSE2": ("sse2", "-msse2"), "AVX2": ("avx2", "-mavx2"), "AVX-512": ("avx512f", "-mavx512f")}
"""Flag of the processor, and of the compiler."""
PROGRAM = """
#include "batchpid/sim/engine/native/free_motion.h"
#include <cstdio>
using namespace batchpid;

std::uint64_t seed = 1;
double drawn(double low, double high) {
  seed = seed * 6364136223846793005u + 1442695040888963407u;
  return low + (high - low) * static_cast<double>(seed >> 11) * 0x1p-53;
}
std::vector<Lanes> lanes(std::size_t size, double low, double high) {
  std::vector<Lanes> out(size);
  for (Lanes &each : out) for (int k = 0; k < WIDTH; ++k) each.of[k] = drawn(low, high);
  return out;
}

// Random joints, of which some strike their limits, with drives, for 100 sim steps.
int main() {
  constexpr std::int64_t DOF = 7;
  std::int32_t tree[2 * DOF];
  double rows[25 * DOF] = {}, inertias[13 * (DOF + 1)] = {}, low[DOF], high[DOF];
  double ctrl[DOF * WIDTH], efforts[DOF * WIDTH];
  for (int j = 0; j < DOF; ++j) {
    tree[2 * j] = j == 4 ? 1 : j - 1;
    tree[2 * j + 1] = j == 5;
    double const angle = drawn(-3, 3);
    double const turn[9] = {std::cos(angle), -std::sin(angle), 0, 0, 0, -1, std::sin(angle), std::cos(angle), 0};
    std::copy(turn, turn + 9, rows + 25 * j);
    for (int k = 9; k < 12; ++k) rows[25 * j + k] = drawn(-0.5, 0.5);
    low[j] = drawn(-0.3, -0.1), high[j] = drawn(0.1, 0.3);
  }
  for (int j = 0; j <= DOF; ++j) {
    double *own = inertias + 13 * j;
    own[0] = drawn(0.5, 2);
    for (int k = 1; k < 4; ++k) own[k] = drawn(-0.1, 0.1);
    for (int k = 4; k < 13; k += 4) own[k] = drawn(0.1, 0.2);
  }
  for (double &each : ctrl) each = drawn(-5, 5);
  Model const model{tree, rows, inertias, {0, 0, -9.81}, DOF, 0, Base::FIXED};
  auto qpos = lanes(DOF, -0.3, 0.3), qvel = lanes(DOF, -3, 3), zero = lanes(DOF, 0, 0), bias = zero;
  auto gains = lanes(DOF, -9, -1), armature = lanes(DOF, 0.01, 0.1), weight = lanes(DOF, 0.1, 5);
  auto mass = lanes(DOF * DOF, 0, 0), limit = lanes(DOF, 1, 50);
  auto gravity = lanes(3, -9, 9);
  FreeMotion of{};
  of.model = &model;
  of.qpos = qpos.data(), of.qvel = qvel.data(), of.acceleration = zero.data(), of.bias = bias.data();
  of.mass = mass.data(), of.armature = armature.data(), of.weight = weight.data(), of.gravity = gravity.data();
  of.low = low, of.high = high, of.robots = WIDTH;
  of.ctrl = ctrl, of.position_gain = of.drive_rate_gain = gains.data(), of.drive_limit = limit.data();
  of.stiffness = 1e6, of.rate_gain = 2e3, of.least = 0.99, of.most = 0.999, of.width = 1e-4, of.timestep = 5e-4;
  FreeRoom room(DOF);
  int limited = 0;
  for (int step = 0; step < 100; ++step) {
    for (double &each : efforts) each = drawn(-20, 20);
    evaluate(of, 0, room);
    for (int j = 0; j < DOF; ++j) limited += any_positive(below_mask(qpos[j], low[j]) + below_mask(high[j], qpos[j]));
    Lanes free = 1.0;
    if (!advance_freely(of, 0, {efforts, 0, WIDTH}, room, free)) return 1;
  }
  for (Lanes const &each : qpos) for (int k = 0; k < WIDTH; ++k) std::printf("%a\\n", each.of[k]);
  return limited > 50 ? 0 : 2;
}
"""


@pytest.mark.skipif(
    platform.machine() != "x86_64" or shutil.which("g++") is None, reason="needs g++ on x86-64"
)
def test_a_motion_has_the_same_bits_with_each_set(tmp_path):
    (tmp_path / "motion.cpp").write_text(PROGRAM)
    available = Path("/proc/cpuinfo").read_text().split()
    flags = [flag for flag in EXTENSIONS["_gateway"].flags if not flag.startswith("-O")]
    motions = {}
    for name, (feature, option) in SETS.items():
        if feature not in available:
            continue
        program = tmp_path / name
        fixed = "-DFOR_EACH_PROCESSOR=", "-DBATCHPID_WIDTH=8", f"-I{ROOT}", "-O1", option
        subprocess.run(["g++", *flags, *fixed, tmp_path / "motion.cpp", "-o", program], check=True)
        done = subprocess.run([program], check=True, capture_output=True, text=True)
        motions[name] = done.stdout
    assert "nan" not in motions["SSE2"]
    assert len({*motions.values()}) == 1, "the bits differ"
    if "AVX-512" not in motions:
        pytest.skip("SSE2 and AVX2 agree; the processor has no AVX-512")
