"""Small URDFs for tests: links and joints, with the oddities that a test asks for."""

import numpy as np

INERTIAL = (
    '<inertial><mass value="1"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0"'
    ' izz="0.1"/></inertial>'
)
LIMIT = '<limit lower="-1" upper="1" effort="10" velocity="2"/>'


def link(name, inner=INERTIAL):
    return f'<link name="{name}">{inner}</link>'


def joint(
    name,
    parent,
    child,
    kind="revolute",
    inner=LIMIT,
    origin="0 0 1",
):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/><axis xyz="0 1 0"/>{inner}</joint>'
    )


def robot(*parts, head=""):
    return f'<?xml version="1.0"?>{head}<robot name="test">{"".join(parts)}</robot>'


def one_joint(inner=LIMIT, kind="revolute", arm=INERTIAL):
    return robot(link("base"), link("arm", arm), joint("hinge", "base", "arm", kind, inner))


def gripper(*parts):
    """Return a robot whose joint ``right`` follows its joint ``left``, with further parts."""
    follower = LIMIT + '<mimic joint="left" multiplier="-0.5"/>'
    fingers = (
        joint("right", "base", "r", inner=follower, origin="0 -1 1"),
        joint("left", "base", "l", origin="0 1 1"),
    )
    return robot(*map(link, ("base", "l", "r")), *fingers, *parts)


def random_tree(rng, links):
    """Return the parts of a robot with ``links`` links, named l0, l1, ..., random joints, half of
    them fixed.
    """

    def text(values):
        return " ".join(map(str, values))

    parts = [link("l0")]
    limit = '<limit lower="-9" upper="9" effort="10" velocity="2"/>'
    for number in range(1, links):
        a = rng.normal(size=(3, 3))
        tensor = 0.02 * (
            (np.trace(a @ a.T) + 1) * np.eye(3) - a @ a.T
        )  # of a body: each moment less than the others
        keys = zip(
            ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), tensor[np.triu_indices(3)], strict=True
        )
        inertia = " ".join(f'{key}="{value}"' for key, value in keys)
        origin = (
            f'<origin xyz="{text(rng.uniform(-0.2, 0.2, 3))}" rpy="{text(rng.uniform(-3, 3, 3))}"/>'
        )
        mass = f'<mass value="{rng.uniform(0.5, 2.0)}"/><inertia {inertia}/>'
        parts.append(link(f"l{number}", f"<inertial>{origin}{mass}</inertial>"))
        kind = rng.choice(["fixed", "fixed", "revolute", "prismatic"]) if number > 1 else "revolute"
        ends = f'<parent link="l{rng.integers(number)}"/><child link="l{number}"/>'
        origin = (
            f'<origin xyz="{text(rng.uniform(-1, 1, 3))}" rpy="{text(rng.uniform(-3, 3, 3))}"/>'
        )
        axis = f'<axis xyz="{text(rng.uniform(-1, 1, 3))}"/>'
        parts.append(f'<joint name="j{number}" type="{kind}">{ends}{origin}{axis}{limit}</joint>')
    return parts


def write(folder, text, name="test.urdf"):
    path = folder / name
    path.write_text(text)
    return path
