"""``batchpid inspect``: the findings of a robot's preflight, its joints and the masses of its
links.
"""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated, Literal

import tyro

from batchpid.io.versions import package_versions
from batchpid.sim import Finding, Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, write_figures
from batchpid.sim.robot.findings import summary
from batchpid.sim.robot.link_repair import DENSITY
from batchpid.sim.robot.parts import HEADERS, joint_rows
from batchpid.sim.tuning.gain_sets import gain_set

SOURCES = {
    "inertial": "<inertial>",
    "repaired": "<inertial>, repaired",
    "shapes": f"collision shapes at {DENSITY:g} kg/m^3",
    "none": "-",
}
"""Words for the sources of masses."""
LIGHT = 1e-4
"""Share of the total mass up to which a link is light."""
NO_GROUND = "No ground: links other than the fixed base reach it at the start pose."
IN_JSON = (
    "type",
    "unit",
    "lower",
    "upper",
    "effort_limit",
    "velocity_limit",
    "damping",
    "friction",
)
"""Figures of a joint for --json."""


@dataclass(frozen=True)
class InspectCommand:
    """List findings about a robot and gains, its joints in the order of qpos, and the masses of its
    links.
    """

    robot: flags.RobotName = "panda"
    gains: flags.Gains = None
    all: flags.Switch = False
    """List fixed joints, light links, and pairs of links that do not collide, too."""
    strict: flags.Switch = False
    """Exit with status 1 if a finding is worse than a note."""
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    engine: Annotated[
        Literal["sapien", "mujoco"] | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")
    ] = None
    """Print the kind of the calls into this physics engine too, and the reason if they are not
    native.
    """
    json: flags.Json = None
    force: flags.Force = False

    imports = ("batchpid.sim.robot.robot_model",)

    def run(self) -> int:
        """Run the command and return its exit status."""
        from batchpid.sim.cli.report import table

        json = OutputFiles(self).path("json", self.json, (".json",))
        robot = Robot.load(self.robot, **vars(self.meshes))
        masses = robot.link_masses
        total = sum(link.mass for link in masses.values())
        findings = robot.check(setpoint=robot.target, control="drive")  # without gains
        has_gains = (
            self.gains is not None or robot.has_tuned
        )  # designed gains keep the stability bound
        gains = gain_set(robot, self.gains) if has_gains else None
        calls = _calls(self.engine) if self.engine else None
        size = f"{robot.dof} degrees of freedom, {len(robot.links)} links, {total:.4g} kg"
        print(f"{robot.name}: {size}, {robot.path}\n")
        print(sentences(findings) or "Nothing odd about it.")
        if gains is not None:
            checked = robot.check(params=gains.params, setpoint=robot.target, control=gains.control)
            of_gains = [finding for finding in checked if finding not in findings]
            print(f"\nUnder gains {gains.name}:\n{sentences(of_gains) or 'Nothing odd.'}")
            findings += of_gains

        fixed = [joint for joint in robot.all_joints if self.all and not joint.moves]
        print("\n" + table(list(joint_rows([*robot.joints, *fixed])), HEADERS, "lllrrrrrl"))
        shown = {
            name: link for name, link in masses.items() if self.all or link.mass > LIGHT * total
        }
        rows = [
            [name, f"{link.mass:.4g} kg" if link.mass else "none", SOURCES[link.source]]
            for name, link in shown.items()
        ]
        print("\n" + table(rows, ("link", "mass", "from"), "lrl"))
        if len(shown) < len(masses):
            print(f"Not shown: {len(masses) - len(shown)} links with little mass or none (--all).")
        print("\n" + contact_lines(robot, pairs_too=self.all))
        if calls is not None:
            print(f"\nEngine: {calls}.")
        if json is not None:
            figures = {
                **{
                    "robot": robot.name,
                    "mass": total,
                    "findings": [asdict(finding) for finding in findings],
                },
                "joints": {
                    joint.name: {name: getattr(joint, name) for name in IN_JSON}
                    for joint in robot.joints
                },
                "links": {
                    name: {"mass": link.mass, "source": link.source}
                    for name, link in masses.items()
                },
            }
            write_figures(json, figures)
            print(f"\nfigures: {json}")
        return int(self.strict and any(finding.severity != "note" for finding in findings))


def _calls(name: str) -> str:
    """Return the kind of the calls into a physics engine."""
    from batchpid.sim.engine.native import describe_calls
    from batchpid.sim.engine.protocol import load_engine

    engine, version = load_engine(name), package_versions([name])[name]
    return describe_calls(f"{engine.title} {version}", engine.native_obstacle())


def contact_lines(robot: Robot, *, pairs_too: bool) -> str:
    """Return whether the robot's scenes have a ground, and the pairs of links that do not collide,
    by reason.
    """
    ground, pairs = (
        "Ground at height 0." if robot.has_ground else NO_GROUND,
        robot.self_contact.pairs,
    )
    if not pairs:
        return f"{ground} All links collide."
    reasons = Counter(pair.reason for pair in pairs)
    counts = ", ".join(f"{count} {reason!r}" for reason, count in reasons.items())
    lines = [
        f"{ground} {len(pairs)} pairs of links excluded from collision:"
        f" {counts}{'' if pairs_too else ' (--all)'}."
    ]
    for reason in reasons if pairs_too else ():
        names = ", ".join(
            f"{pair.first} - {pair.second}" for pair in pairs if pair.reason == reason
        )
        lines.append(f"Do not collide, {reason!r}: {names}")
    return "\n".join(map(_fill, lines))


def sentences(findings: Sequence[Finding]) -> str:
    """Return one sentence for each cause."""
    return "\n".join(map(_fill, summary(findings)))


def _fill(text: str) -> str:
    wrapper = textwrap.TextWrapper(
        120, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )
    return wrapper.fill(text.replace("N m", "N\xa0m")).replace("\xa0", " ")
