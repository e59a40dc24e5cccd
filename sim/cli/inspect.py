"""``batchpid inspect``: the findings of a robot's preflight, its joints and the masses of its links."""

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


@dataclass(frozen=True)
class InspectCommand:
    """List findings about a robot and gains, its joints in the order of qpos, and the masses of its links."""

    robot: flags.RobotName = "panda"
    gains: flags.Gains = None
    all: flags.Switch = False
    """List fixed joints, light links, and pairs of links that do not collide, too."""
    strict: flags.Switch = False
    """Exit with status 1 if a finding is worse than a note."""
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    engine: Annotated[Literal["sapien", "mujoco"] | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """Print the kind of the calls into this physics engine too, and the reason if they are not native."""
    json: flags.Json = None
    force: flags.Force = False

    imports = ("batchpid.sim.robot.robot_model",)

    def run(self) -> int:
        """Run the command and return its exit status."""
        json = OutputFiles(self).path("json", self.json, (".json",))
        robot = Robot.load(self.robot, **vars(self.meshes))
        mass = sum(link.mass for link in robot.link_masses.values())
        size = f"{robot.dof} degrees of freedom, {len(robot.links)} links, {mass:.4g} kg"
        setpoint = None if robot.settings is None else robot.settings.target
        findings = robot.check(setpoint=setpoint, control="drive")  # without gains
        asked = self.gains is not None or robot.has_tuned  # designed gains keep the stability bound
        gains = gain_set(robot, self.gains) if asked else None
        calls = _calls(self.engine) if self.engine else None
        print(f"{robot.name}: {size}, {robot.path}\n")
        print(sentences(findings) or "Nothing odd about it.")
        if gains is not None:
            with_gains = robot.check(params=gains.params, setpoint=setpoint, control=gains.control)
            of_gains = [finding for finding in with_gains if finding not in findings]
            print(f"\nUnder gains {gains.name}:")
            print(sentences(of_gains) or "Nothing odd.")
            findings += of_gains
        print("\n" + joint_table(robot, fixed_too=self.all))
        print("\n" + mass_table(robot, light_too=self.all))
        print("\n" + contact_lines(robot, pairs_too=self.all))
        if calls is not None:
            print(f"\nEngine: {calls}.")
        if json is not None:
            names = ("type", "unit", "lower", "upper", "effort_limit", "velocity_limit", "damping", "friction")
            figures = {
                **{"robot": robot.name, "mass": mass, "findings": [asdict(each) for each in findings]},
                "joints": {each.name: {name: getattr(each, name) for name in names} for each in robot.joints},
                "links": {name: {"mass": link.mass, "source": link.source} for name, link in robot.link_masses.items()},
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


def joint_table(robot: Robot, *, fixed_too: bool) -> str:
    """Return a table of the moving joints, numbered as in qpos, and the fixed ones."""
    from batchpid.sim.cli.report import table

    fixed = [joint for joint in robot.all_joints if fixed_too and not joint.moves]
    rows = list(joint_rows([*robot.joints, *fixed]))
    return table(rows, HEADERS, "lllrrrrrl")


def mass_table(robot: Robot, *, light_too: bool) -> str:
    """Return a table of the masses of links and their sources, without light links, and the total."""
    from batchpid.sim.cli.report import table

    masses = robot.link_masses
    total = sum(link.mass for link in masses.values())
    shown = {name: link for name, link in masses.items() if light_too or link.mass > LIGHT * total}
    rows = [
        [name, f"{link.mass:.4g} kg" if link.mass else "none", SOURCES[link.source]] for name, link in shown.items()
    ]
    shares = {source: sum(link.mass for link in masses.values() if link.source == source) for source in SOURCES}
    parts = [f"{share:.4g} kg from {SOURCES[source]}" for source, share in shares.items() if share]
    lines = f"Total {total:.4g} kg" + f": {'; '.join(parts)}" * (len(parts) > 1) + "."
    if hidden := len(masses) - len(shown):
        lines += f" Not shown: {_count(hidden, 'link')} with little mass or none (--all)."
    return table(rows, ("link", "mass", "from"), "lrl") + "\n" + _fill(lines)


def contact_lines(robot: Robot, *, pairs_too: bool) -> str:
    """Return whether the robot's scenes have a ground, and the pairs of links that do not collide, by reason."""
    contact = robot.self_contact
    ground = "Ground at height 0." if robot.has_ground else NO_GROUND
    if not contact.pairs:
        return f"{ground} All links collide."
    reasons = Counter(pair.reason for pair in contact.pairs)
    counts = ", ".join(f"{count} {reason!r}" for reason, count in reasons.items())
    count = _count(len(contact.pairs), "pair")
    lines = [_fill(f"{ground} {count} of links excluded from collision: {counts}{'' if pairs_too else ' (--all)'}.")]
    if not pairs_too:
        return lines[0]
    for title, pairs in (
        *((f"Do not collide, {reason!r}", [p for p in contact.pairs if p.reason == reason]) for reason in reasons),
        ("Collide, since PhysX's filter cannot hold them", contact.left_over),
    ):
        if pairs:
            lines.append(_fill(f"{title}: {', '.join(f'{pair.first} - {pair.second}' for pair in pairs)}"))
    return "\n".join(lines)


def sentences(findings: Sequence[Finding]) -> str:
    """Return one sentence for each cause."""
    return "\n".join(map(_fill, summary(findings)))


def _fill(text: str) -> str:
    wrapper = textwrap.TextWrapper(120, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    return wrapper.fill(text.replace("N m", "N\xa0m")).replace("\xa0", " ")


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
