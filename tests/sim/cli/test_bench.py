import json

import pytest


@pytest.mark.slow
def test_bench_prints_cases_and_phases_and_writes_them(batchpid, tmp_path):
    path = tmp_path / "new" / "bench.json"
    flags = ["--num-envs", 1, "--workers", 0, "--ticks", 50, "--rounds", 1]
    status, out, err = batchpid("bench", *flags, "--out", path)
    assert status == 0, err
    assert "closed loop" in out
    assert "passive" in out
    figures = json.loads(path.read_text())
    closed, tutorial = (figures["cases"][case] for case in ("closed loop", "tutorial"))
    assert closed["closed_loop_over_case"] == 1.0
    assert tutorial["closed_loop_over_case"] == closed["median"] / tutorial["median"]
    assert figures["machine"]["sapien"]
    assert figures["setup"]["num_envs"] == 1


@pytest.mark.slow
def test_bench_refuses_too_short_a_run(batchpid):
    status, _, err = batchpid("bench", "--num-envs", 1, "--workers", 0, "--ticks", 1, "--rounds", 1)
    assert status == 2
    assert "run more ticks" in err
