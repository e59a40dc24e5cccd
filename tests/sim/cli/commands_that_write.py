"""Commands that write files, with words that make them short and their flags for outputs."""

from batchpid.sim.cli.commands import COMMANDS

SHORT = ("--num-envs", 1, "--seconds", 0.02)
WORDS = {
    "demo": ("demo", *SHORT),
    "rollout": ("rollout", *SHORT, "--workers", 0),
    "tune": ("tune", "arm.urdf"),
    "compare": ("compare", "arm.urdf"),
    "excite": ("excite", "arm.urdf"),
    "export": ("export", "arm.urdf"),
    "identify": ("identify", "arm.urdf", "run.h5"),
    "plot": ("plot", "run.h5"),
}
"""Words of each command that writes, without its outputs."""
SUFFIXES = {"picture": ".png", "out": ".yaml"}
OUT = {"rollout": ".h5", "excite": ".csv", "export": ".h"}


def output_flags():
    """Return every flag of every command that names an output file."""
    return [
        (name, flag)
        for name, command in COMMANDS.items()
        for flag in SUFFIXES
        if flag in command.outputs
    ]


def output(command, flag, stem="new"):
    """Return a name that a command may write at a flag."""
    return stem + (OUT.get(command, SUFFIXES[flag]) if flag == "out" else SUFFIXES[flag])
