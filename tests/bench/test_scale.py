"""The notes on large clusters show the output of its simulation, and the simulation agrees with simple cases."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scripts import ROOT, load_script

SCALE = vars(load_script("scale"))
FREE = {"send": 0.0, "send_rate": 1e30, "receive": 0.0, "receive_rate": 1e30, "round_trip": 0.0, "bandwidth": 1e30}
EVEN = {"jitter": 0.0, "slow": 0.0, "detection": -20.0, "restart": 0.0}


@pytest.mark.slow
def test_the_page_shows_what_the_script_prints():
    page = (ROOT / "docs/notes.md").read_text()
    shown = page.split("<!-- scale: printed by bench/scale.py -->\n")[1].split("<!-- end -->")[0]
    assert shown.strip() == SCALE["report"](SCALE["Costs"]()).strip()


def test_the_page_has_the_bytes_of_the_arrays():
    down, up = SCALE["traffic"](9)
    page = (ROOT / "docs/notes.md").read_text()
    assert f"| {down}: the setpoint | {up}: the observation ({up - 32}), the faults (32) |" in page
    assert f"| bytes of an env step | {down / SCALE['SUBSTEPS']:.1f} | {up / SCALE['SUBSTEPS']:.1f} |" in page


@given(arrivals=st.lists(st.floats(0, 10), min_size=1, max_size=20), service=st.floats(0.01, 2))
def test_departures_are_those_of_a_queue_served_in_turn(arrivals, service):
    arrivals, free, expected = np.sort(arrivals), 0.0, []
    for arrival in arrivals:
        free = max(free, arrival) + service
        expected.append(free)
    np.testing.assert_allclose(SCALE["departures"](arrivals, service), expected, rtol=1e-12)


def test_without_costs_a_cluster_is_as_fast_as_its_cores():
    result = SCALE["simulate"](100, 19, SCALE["Costs"](**FREE, **EVEN))
    assert result.efficiency == pytest.approx(1.0, rel=5e-3)  # a replay each hour


@pytest.mark.slow
def test_a_full_network_card_limits_the_rate():
    costs = SCALE["Costs"](**FREE | {"bandwidth": 1e9}, **EVEN)
    result = SCALE["simulate"](1000, 19, costs)
    bytes_back = SCALE["traffic"](9).up / SCALE["SUBSTEPS"]
    assert result.network > 0.8
    assert result.rate <= 1e9 / bytes_back
    assert result.bottleneck == "network"
