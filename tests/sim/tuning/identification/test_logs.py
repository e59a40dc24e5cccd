import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import batchpid as bp
from batchpid.sim import Robot, Rollout, Runner, read_recording, write_recording
from batchpid.sim.identification import Log, LogWarning, identify, logs_of_rollout, read_logs
from batchpid.sim.identification.log_checks import divided

ROWS = 60


def text(columns: dict, delimiter: str = ",") -> str:
    rows = zip(*columns.values(), strict=True)
    lines = [delimiter.join(columns), *(delimiter.join(str(value) for value in row) for row in rows)]
    return "\n".join(lines) + "\n"


@pytest.fixture
def columns() -> dict:
    time = np.arange(ROWS) / 200 + np.random.default_rng(0).uniform(0, 1e-3, ROWS)  # irregular
    wave = 0.1 * np.sin(time)
    names = ("panda_joint6", "panda_joint2")  # in another order than the robot's
    return {
        "time": time,
        **{f"setpoint:{name}": 1.0 + wave for name in names},
        **{f"qpos:{name}": 1.0 + k * wave for k, name in enumerate(names)},
    }


def read(panda: Robot, folder, content: str, **options):
    path = folder / "log.csv"
    path.write_text(content)
    return read_logs(panda, [path], **options)[0]


def test_columns_are_found_by_name_in_the_order_of_the_robot(panda, tmp_path, columns):
    log = read(panda, tmp_path, text(columns))
    assert log.joints == (1, 5)
    assert log.kind == "setpoint"
    assert np.array_equal(log.time, columns["time"])
    assert np.array_equal(log.qpos[:, 0], columns["qpos:panda_joint2"])
    assert np.array_equal(log.command[:, 1], columns["setpoint:panda_joint6"])
    assert log.qvel is None


@pytest.mark.parametrize("delimiter", [";", "\t", ", "])
def test_delimiters_comments_blank_lines_and_other_columns_do_not_matter(panda, tmp_path, columns, delimiter):
    plain = read(panda, tmp_path, text(columns))
    decorated = "\ufeff# from the robot\n\n" + text({**columns, "mode": ["idle"] * ROWS}, delimiter).replace(
        "\n", "\r\n"
    )
    log = read(panda, tmp_path, decorated)
    assert np.array_equal(log.qpos, plain.qpos)
    assert np.array_equal(log.command, plain.command)


def test_hdf5_columns_read_as_those_of_a_csv_file(panda, tmp_path, columns):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values in columns.items():
            file[name] = values
    (log,) = read_logs(panda, [tmp_path / "log.h5"])
    plain = read(panda, tmp_path, text(columns))
    assert np.array_equal(log.qpos, plain.qpos)
    assert np.array_equal(log.command, plain.command)


def test_commands_are_interpolated_or_held(panda, tmp_path, columns):
    linear, held = (read(panda, tmp_path, text(columns), hold=hold) for hold in (False, True))
    middle = (columns["time"][3:5]).mean(keepdims=True)
    rows = linear.command[3:5]
    np.testing.assert_allclose(linear.commands_at(middle)[0], rows.mean(0))
    assert np.array_equal(held.commands_at(middle)[0], rows[0])
    assert np.array_equal(held.commands_at(linear.time), linear.commands_at(linear.time))


def damaged(columns: dict, change: str) -> str:
    columns = {name: list(values) for name, values in columns.items()}
    if change == "no time":
        del columns["time"]
    elif change == "no position":
        del columns["qpos:panda_joint2"]
    elif change == "no setpoint":
        del columns["setpoint:panda_joint2"]
    elif change == "unknown joint":
        columns["qpos:elbow"] = columns.pop("qpos:panda_joint2")
    elif change == "text":
        columns["qpos:panda_joint2"][3] = "1,0"
    elif change == "word":
        columns["qpos:panda_joint2"][3] = "off"
    elif change == "nan":
        columns["qpos:panda_joint2"][3] = "nan"
    elif change == "backwards":
        columns["time"][3] = columns["time"][1]
    elif change == "degrees":
        columns["qpos:panda_joint2"] = [57.3 * q for q in columns["qpos:panda_joint2"]]
    elif change == "milliseconds":
        columns["time"] = [1e3 * t for t in columns["time"]]
    elif change == "short":
        columns = {name: values[:20] for name, values in columns.items()}
    return text(columns)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("no time", r"no column 'time'"),
        ("no position", r"column qpos:panda_joint2.*is missing"),
        ("no setpoint", r"column setpoint:panda_joint2.*is missing"),
        ("unknown joint", r"'qpos:elbow'.*unknown.*panda_joint1"),
        ("text", r"line 5 has 6 cells, the header 5"),
        ("word", r"line 5, column 'qpos:panda_joint2' is not a number \(got 'off'\)"),
        ("nan", r"line 5, column 'qpos:panda_joint2' is empty or not finite"),
        ("backwards", r"line 5: time does not increase"),
        ("degrees", r"line 2, column 'qpos:panda_joint2' is far beyond.*positions are in rad"),
        ("milliseconds", r"time is in seconds"),
        ("short", r"has 20 rows"),
    ],
)
def test_what_is_wrong_with_a_file_is_named_by_line_and_column(panda, tmp_path, columns, change, message):
    with pytest.raises(bp.InvalidArgumentError, match=message):
        read(panda, tmp_path, damaged(columns, change))


def test_files_of_other_kinds_are_refused(panda, tmp_path, columns):
    with pytest.raises(bp.InvalidArgumentError, match="unknown file format"):
        read_logs(panda, [tmp_path / "log.mat"])
    with pytest.raises(FileNotFoundError):
        read_logs(panda, [tmp_path / "none.csv"])
    with pytest.raises(bp.InvalidArgumentError, match="name one file"):
        read_logs(panda, [])
    with pytest.raises(bp.InvalidArgumentError, match="no column effort:JOINT"):
        read(panda, tmp_path, text(columns), kind="effort")
    with pytest.raises(bp.InvalidArgumentError, match="has no rows"):
        read(panda, tmp_path, "time,qpos:panda_joint1\n")


def test_a_recording_is_a_log_of_each_env(panda, tmp_path):
    setpoints = panda.sample(1)[0] + 0.01 * np.sin(np.arange(60) / 9)[:, None, None] * np.ones((60, 2, panda.dof))
    with Runner(panda, 2, workers=0, substeps=10) as runner:
        runner.reset(setpoints[0])
        rollout = runner.rollout(np.clip(panda.coupled(setpoints), panda.lower, panda.upper))
    first, second = read_logs(panda, [write_recording(rollout, tmp_path / "run.h5")])
    assert second.source.endswith("env 1")
    assert np.array_equal(first.qpos, rollout.qpos[:, 0, first.joints].astype(float))
    # The setpoint of a row acts during the tick that ends at its time.
    within = rollout.time[[7]] - 0.3 * rollout.tick
    assert np.array_equal(first.commands_at(within)[0], rollout.setpoint[7, 0, first.joints])
    with pytest.raises(bp.InvalidArgumentError, match="fit its setpoints"):
        logs_of_rollout(panda, rollout, "effort")


def test_a_damaged_hdf5_log_is_refused(panda, tmp_path, columns):
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for name, rows in columns.items():
            file[name] = rows
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(bp.BatchPIDError, match="cannot be read as a log"):
        read_logs(panda, [path])


def test_a_joint_at_its_limit_is_told(panda):
    rows = np.arange(400) / 1000
    setpoints = np.clip(panda.start, panda.lower + 0.01, panda.upper - 0.01) * np.ones((400, 1))
    setpoints[:, 0] += 0.1 * np.sin(20 * rows)
    free = Log("free.csv", tuple(range(panda.dof)), "setpoint", rows, setpoints, rows, setpoints, False)
    setpoints[:100, 3] = panda.upper[3] + 1e-3
    said = r"free.csv: joint 'panda_joint4' is at its limit in 0.25 of the rows"
    with pytest.raises(LogWarning, match=said):  # an error here, which ends the fit
        identify(panda, free, params=panda.designed("effort"), evaluations=1, workers=0, payload=False)


def stretched(columns: dict, shifts: dict[int, float]) -> dict:
    """Return columns whose times are later from some rows on."""
    time = columns["time"].copy()
    for row, shift in shifts.items():
        time[row:] += shift
    return {**columns, "time": time}


@pytest.fixture
def many(columns) -> dict:
    rows = 300
    time = np.arange(rows) / 200
    return {name: time if name == "time" else 1.0 + 0.1 * np.sin(3 * time) for name in columns}


def test_stretches_between_gaps_are_logs_of_their_own(panda, tmp_path, many):
    (tmp_path / "log.csv").write_text(text(stretched(many, {100: 30.0, 200: 0.2})))
    logs = read_logs(panda, [tmp_path / "log.csv"])
    assert [len(log.time) for log in logs] == [100, 100, 100]
    assert max(log.seconds for log in logs) < 0.5
    for number, log in enumerate(logs):
        own = slice(100 * number, 100 * (number + 1))
        assert np.array_equal(log.qpos[:, 0], many["qpos:panda_joint2"][own])
        assert np.array_equal(log.command[:, 0], many["setpoint:panda_joint2"][own])
        assert np.array_equal(log.command_time, log.time)
    assert logs[1].source.endswith("log.csv, line 102 to line 201")
    (whole,) = read_logs(panda, [_written(tmp_path / "even.csv", stretched(many, {100: 0.09}))])
    assert len(whole.time) == 300


def _written(path, columns: dict):
    path.write_text(text(columns))
    return path


def test_commands_that_act_across_a_gap_are_kept():
    time = np.r_[np.arange(100), np.arange(1000, 1100)] / 100
    command_time = np.array([-1.0, 0.5, 3.0, 10.4])  # sparse
    for held in (True, False):
        log = Log("log", (0,), "setpoint", time, np.zeros((200, 1)), command_time, np.arange(4.0)[:, None], held)
        parts = divided(log, str)
        assert [part.source for part in parts] == ["log, 0 to 99", "log, 100 to 199"]
        for part in parts:
            assert np.array_equal(part.commands_at(part.time), log.commands_at(part.time))


@pytest.mark.parametrize(
    ("shifts", "message"),
    [
        (
            {1: 1.7e9},
            r"line 3: time jumps by 1.7e\+09 s, to 1700000000.0.*the 1 row before.*correct the times",
        ),
        ({299: 1.7e9}, r"line 301: time jumps by 1.7e\+09 s.*and the 1 row from there on"),
        ({20: 60.0}, r"line 22: time jumps by 60.01 s.*and the 20 rows before span 0.095 s"),
        ({row: 0.5 for row in range(40, 300, 40)}, r"gaps of more than 0.1 s in time, the first at line 42; all"),
        ({100: 1e18}, r"line 103: time does not increase"),
    ],
)
def test_a_time_span_that_the_rows_cannot_fill_is_refused(panda, tmp_path, many, shifts, message):
    with pytest.raises(bp.InvalidArgumentError, match=message):
        read(panda, tmp_path, text(stretched(many, shifts)))


def test_short_stretches_between_dropouts_are_left_out_and_named(panda, tmp_path, many):
    with pytest.warns(LogWarning, match=r"1 stretches.*left out: line 102 to line 111"):
        log = read(panda, tmp_path, text(stretched(many, {100: 0.5, 110: 0.5})))
    assert len(log.time) == 100


def test_identify_divides_logs_that_are_given_as_such(panda, many):
    time = stretched(many, {1: 1.7e9})["time"]
    table = np.ones((300, 1))
    log = Log("mine", (1,), "setpoint", time, table, time, table, False)
    with pytest.raises(bp.InvalidArgumentError, match="mine: row 2: time jumps"):
        identify(panda, log, params=panda.designed("effort"), workers=0)


def test_columns_that_differ_by_blanks_are_one_twice(panda, tmp_path, columns):
    for other in ("qpos: panda_joint2", "qpos :panda_joint2"):
        doubled = {**columns, other: columns["qpos:panda_joint2"] + 1.0}
        with pytest.raises(bp.InvalidArgumentError, match=r"column 'qpos:panda_joint2' twice"):
            read(panda, tmp_path, text(doubled))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("qpos:panda_joint6", lambda rows: np.stack([rows, rows], 1), r"'qpos:panda_joint6' of shape \(60, 2\)"),
        ("qvel:panda_joint2", lambda rows: rows[:-3], "different lengths"),
        ("qpos:panda_joint2", lambda rows: np.array([b"x"] * len(rows)), "not a column of numbers"),
    ],
)
def test_datasets_that_are_no_columns_are_named(panda, tmp_path, columns, name, change, message):
    columns = {**columns, "qvel:panda_joint2": columns["time"], "qvel:panda_joint6": columns["time"]}
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for each, rows in columns.items():
            file[each] = change(rows) if each == name else rows
        file["mode:gripper"] = np.array([b"idle"])  # another quantity does not matter
    with pytest.raises(bp.BatchPIDError, match=message):
        read_logs(panda, [tmp_path / "log.h5"])


PENDULUM = """<robot name="pendulum"><link name="base"/>
<link name="bob"><inertial><origin xyz="0 0 -0.3"/><mass value="2"/>
<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.005"/></inertial></link>
<joint name="hinge" type="TYPE"><parent link="base"/><child link="bob"/>
<axis xyz="0 1 0"/><limit lower="-3.14159" upper="3.14159" effort="40" velocity="60"/></joint></robot>"""


def pendulum(folder, kind: str) -> Robot:
    (folder / f"{kind}.urdf").write_text(PENDULUM.replace("TYPE", kind))
    return Robot.load(folder / f"{kind}.urdf")


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.floats(-8, 8), st.floats(0, 20), st.sampled_from([-np.pi, 0.0]), st.sampled_from(["both", "qpos", "setpoint"])
)
def test_wrapped_columns_are_unwrapped_with_the_turns_of_each_other(tmp_path, start, speed, low, wrapped):
    robot, time = pendulum(tmp_path, "continuous"), np.r_[0:1:0.005, 1.5:2.5:0.005]
    qpos = start + speed * np.sin(3 * time)
    setpoint = qpos + 0.2

    def wrap(values):
        return (values - low) % (2 * np.pi) + low

    table = {
        "time": time,
        "setpoint:hinge": setpoint if wrapped == "qpos" else wrap(setpoint),
        "qpos:hinge": qpos if wrapped == "setpoint" else wrap(qpos),
    }
    (tmp_path / "turns.csv").write_text(text(table))
    logs = read_logs(robot, [tmp_path / "turns.csv"])
    assert len(logs) == 2
    for log in logs:
        np.testing.assert_allclose(log.command - log.qpos, 0.2, atol=1e-9)
        assert np.abs(np.diff(log.qpos[:, 0])).max() < 1.0


def test_wraps_of_other_joints_and_uncertain_turns_are_told(tmp_path):
    time = np.arange(0, 1, 0.01)
    wrapped = (6 * time + np.pi) % (2 * np.pi) - np.pi
    path = tmp_path / "turns.csv"
    path.write_text(text({"time": time, "effort:hinge": 0 * time, "qpos:hinge": wrapped}))
    with pytest.warns(LogWarning, match="of hinge jump by whole turns, and were unwrapped; .*not continuous"):
        (log,) = read_logs(pendulum(tmp_path, "revolute"), [path])
    np.testing.assert_allclose(np.diff(log.qpos[:, 0]), 0.06)
    path.write_text(text({"time": time, "effort:hinge": 0 * time, "qpos:hinge": np.where(time < 0.5, 0.0, 4.0)}))
    with pytest.raises(bp.InvalidArgumentError, match=r"line 52: joint 'hinge' jumps by 4 rad .*turns is not certain"):
        read_logs(pendulum(tmp_path, "continuous"), [path])


@pytest.mark.parametrize("quote", ['"', "'"])
def test_cells_in_quotes_are_read(panda, tmp_path, columns, quote):
    plain = read(panda, tmp_path, text(columns))
    header, *rows = text(columns).splitlines()
    quoted = "\n".join([header, *(",".join(f"{quote}{cell}{quote}" for cell in row.split(",")) for row in rows)])
    assert np.array_equal(read(panda, tmp_path, quoted).qpos, plain.qpos)
    for cell, remedy in (('"1,5"', "decimal point"), ('"1.5 deg"', "without its unit"), ('"off"', "give the number")):
        broken = {**columns, "qpos:panda_joint2": [cell, *columns["qpos:panda_joint2"][1:]]}
        with pytest.raises(bp.InvalidArgumentError, match=remedy):
            read(panda, tmp_path, text(broken))


def test_a_recording_says_its_time_step_compensation_and_control(tmp_path):
    robot, setpoints = pendulum(tmp_path, "continuous"), 0.3 * np.sin(np.arange(200) / 20)[:, None, None]
    gains = robot.designed("effort")
    paths = {}
    for control in ("pid", "drive"):
        options = {"params": gains} if control == "pid" else {}
        with Runner(robot, 1, workers=0, timestep=1 / 500, substeps=1, control=control, **options) as runner:
            runner.reset(setpoints[0])
            paths[control] = write_recording(runner.rollout(setpoints), tmp_path / f"{control}.h5")
    (log,) = read_logs(robot, [paths["pid"]])
    assert (log.timestep, log.compensate) == (1 / 500, "gravity+coriolis+friction")
    with pytest.raises(bp.InvalidArgumentError, match="made under control 'drive'"):
        read_logs(robot, [paths["drive"]])
    for option in ({"timestep": 1 / 2000}, {"compensate": "none"}):
        with pytest.raises(bp.InvalidArgumentError, match=f"{next(iter(option))}: contradicts .*pid.h5"):
            identify(robot, [paths["pid"]], params=gains, workers=0, **option)


def test_a_recording_with_setpoint_rates_is_refused(panda, tmp_path):
    """The model has the law without rates, and would take its lag for that of the motors."""
    setpoints = np.tile(panda.start, (3, 1))
    with Runner(panda, 1, workers=0) as runner:
        without = runner.rollout(setpoints)
        rated = runner.rollout(setpoints, setpoint_rates=0 * setpoints)
    assert (without.info.rates, rated.info.rates, Rollout.join([without, rated]).info.rates) == (False, True, True)
    path = write_recording(rated, tmp_path / "run.h5")
    assert read_recording(path).info.rates
    with pytest.raises(bp.InvalidArgumentError, match=r"was made with setpoint rates.*record one without"):
        read_logs(panda, [path])
