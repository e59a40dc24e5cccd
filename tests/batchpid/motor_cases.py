"""Options of motors that tests share: every effect at once, and random ones."""

ALL = {
    "command_delay": 0.0017,
    "sensor_delay": [[0.0008, 0.002, 0.0, 0.0013]],
    "lag": 0.003,
    "strength": 0.9,
    "bias": 0.1,
    "saturation_effort": 8.0,
    "no_load_speed": 4.0,
    "effort_limit": 6.0,
    "position_offset": 0.03,
    "backlash": 0.01,
    "position_noise": 1e-3,
    "velocity_noise": 1e-2,
    "continuous": [True, False, False, True],
    "seed": 3,
}
