"""Rigid-body functions of a robot in C: mass matrix, bias and gravity, with the robot's constants
as tables.

The efforts of velocities and accelerations are computed by the recursive Newton-Euler algorithm, in
the axes of the world and about its origin (R. Featherstone, Rigid Body Dynamics Algorithms,
Springer, 2008, section 5.3). Without acceleration they are the bias. For a unit acceleration of one
joint, at rest and without gravity, they are a row of the mass matrix (section 6.1). The last bits
differ from NumPy's.
"""

from __future__ import annotations

import numpy as np

from batchpid.export.c_step import Dialect
from batchpid.task_space.rigid_tree import RigidTree


def rigid_body(c: Dialect, tree: RigidTree) -> str:
    """Return the functions ``PREFIX_mass_matrix``, ``PREFIX_bias`` and ``PREFIX_gravity`` of a
    tree.
    """
    bodies = tree.bodies
    p = c.prefix
    t = c.type
    n = c.size
    f = c.suffix
    zero = c.number(0.0)
    one = c.number(1.0)
    # A joint's rotation is linear in 1, sin q and 1 - cos q, so that three constant matrices a
    # joint are enough.
    rotations = {"turn": bodies.at_zero, "sine": bodies.sine, "cosine": bodies.cosine}
    poses = "".join(
        c.table(f"k_{name}", leaf[:, :, :3].reshape(-1, 9)) for name, leaf in rotations.items()
    )
    poses += c.table("k_place", bodies.at_zero[..., 3]) + c.table("k_slide", bodies.slide[..., 3])
    poses += c.table("k_center", bodies.center) + c.table("k_tensor", bodies.tensor.reshape(-1, 9))
    poses += _integers(c, "slides", bodies.slides[:, 0])
    above = _integers(c, "above", tree.body_parents)
    coupling = _integers(c, "leader", tree.coupling.leader)
    coupling += c.table("multiplier", tree.coupling.multiplier)
    fall = ", ".join(map(c.number, bodies.gravity.tolist()))
    tables = above + coupling + c.table("k_mass", bodies.mass[:, 0])
    tables += c.table("k_armature", np.asarray(tree.armature))
    tables += f"  static const {t} gravity[3] = {{{fall}}};\n"
    # Everything is about the world's origin: sums over bodies then need no shift from one to the
    # next.
    return f"""/* Bodies at a pose, in the axes of the world. */
typedef struct {{
  {t} turn[{n}][9], place[{n}][3];      /* axes (rows of a matrix) and origin */
  {t} linear[{n}][3], angular[{n}][3];  /* velocity at the world's origin per rate of the joint */
  {t} center[{n}][3], tensor[{n}][9];   /* center of mass, and inertia tensor about it */
}} {p}_bodies;

static inline {t} {p}_dot(const {t} *a, const {t} *b) {{ return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }}

/* out += a x b */
static inline void {p}_add_cross(const {t} *a, const {t} *b, {t} *out) {{
  out[0] += a[1] * b[2] - a[2] * b[1];
  out[1] += a[2] * b[0] - a[0] * b[2];
  out[2] += a[0] * b[1] - a[1] * b[0];
}}

static inline void {p}_rotate(const {t} *turn, const {t} *a, {t} *out) {{
  for (int i = 0; i < 3; ++i) out[i] = {p}_dot(turn + 3 * i, a);
}}

static inline void {p}_place(const {t} *qpos, {p}_bodies *b) {{
{above}{poses}  for (int j = 0; j < {n}; ++j) {{
    const {t} sine = sin{f}(qpos[j]), rest = {one} - cos{f}(qpos[j]);
    const int up = above[j];
    {t} turn[9], place[3], mixed[9];
    for (int i = 0; i < 9; ++i) turn[i] = k_turn[j][i] + sine * k_sine[j][i] + rest * k_cosine[j][i];
    for (int i = 0; i < 3; ++i) place[i] = k_place[j][i] + qpos[j] * k_slide[j][i];
    for (int i = 0; i < 3; ++i) {{
      for (int k = 0; k < 3; ++k) {{
        const {t} column[3] = {{turn[k], turn[3 + k], turn[6 + k]}};
        b->turn[j][3 * i + k] = up < 0 ? turn[3 * i + k] : {p}_dot(b->turn[up] + 3 * i, column);
      }}
      b->place[j][i] = up < 0 ? place[i] : {p}_dot(b->turn[up] + 3 * i, place) + b->place[up][i];
      b->linear[j][i] = b->angular[j][i] = {zero};
    }}
    for (int i = 0; i < 3; ++i) (slides[j] ? b->linear[j] : b->angular[j])[i] = b->turn[j][3 * i];
    if (!slides[j]) {p}_add_cross(b->place[j], b->angular[j], b->linear[j]);
    {p}_rotate(b->turn[j], k_center[j], b->center[j]);
    for (int i = 0; i < 3; ++i) b->center[j][i] += b->place[j][i];
    for (int i = 0; i < 3; ++i) {p}_rotate(b->turn[j], k_tensor[j] + 3 * i, mixed + 3 * i);
    for (int i = 0; i < 3; ++i) {{
      for (int k = 0; k < 3; ++k) {{
        const {t} column[3] = {{mixed[i], mixed[3 + i], mixed[6 + i]}};
        b->tensor[j][3 * i + k] = {p}_dot(column, b->turn[j] + 3 * k);
      }}
    }}
  }}
}}

/* Efforts [N m or N] at velocities and accelerations of the joints, under a share of gravity, with the armature. */
static inline void {p}_efforts(const {p}_bodies *b, const {t} *qvel, const {t} *qacc, {t} share, {t} *effort) {{
{tables}  {t} v[{n}][3], w[{n}][3], dv[{n}][3], dw[{n}][3]; /* velocity and acceleration at the world's origin */
  {t} force[{n}][3], torque[{n}][3];
  for (int j = 0; j < {n}; ++j) {{
    const int up = above[j];
    const {t} *center = b->center[j];
    {t} linear[3], angular[3], spin[3], rate[3];
    for (int i = 0; i < 3; ++i) {{
      linear[i] = b->linear[j][i] * qvel[j];
      angular[i] = b->angular[j][i] * qvel[j];
      v[j][i] = (up < 0 ? {zero} : v[up][i]) + linear[i];
      w[j][i] = (up < 0 ? {zero} : w[up][i]) + angular[i];
      dv[j][i] = (up < 0 ? {zero} : dv[up][i]) + b->linear[j][i] * qacc[j];
      dw[j][i] = (up < 0 ? {zero} : dw[up][i]) + b->angular[j][i] * qacc[j];
    }}
    {p}_add_cross(w[j], linear, dv[j]);
    {p}_add_cross(v[j], angular, dv[j]);
    {p}_add_cross(w[j], angular, dw[j]);
    for (int i = 0; i < 3; ++i) {{
      rate[i] = v[j][i];
      force[j][i] = dv[j][i] - share * gravity[i];
    }}
    {p}_add_cross(w[j], center, rate);
    {p}_add_cross(dw[j], center, force[j]);
    {p}_add_cross(w[j], rate, force[j]);
    for (int i = 0; i < 3; ++i) force[j][i] *= k_mass[j];
    {p}_rotate(b->tensor[j], dw[j], torque[j]);
    {p}_rotate(b->tensor[j], w[j], spin);
    {p}_add_cross(w[j], spin, torque[j]);
    {p}_add_cross(center, force[j], torque[j]);
  }}
  for (int j = {n} - 1; j >= 0; --j) {{
    effort[j] = {p}_dot(b->linear[j], force[j]) + {p}_dot(b->angular[j], torque[j]) + k_armature[j] * qacc[j];
    for (int i = 0; i < 3 && above[j] >= 0; ++i) {{
      force[above[j]][i] += force[j][i];
      torque[above[j]][i] += torque[j][i];
    }}
  }}
  for (int j = 0; j < {n}; ++j) {{ /* followers act through their leaders */
    if (leader[j] == j) continue;
    effort[leader[j]] += multiplier[j] * effort[j];
    effort[j] = {zero};
  }}
}}

/* Mass matrix [kg m^2 or kg] at qpos [rad or m], by rows, with the armature of the motors. */
static inline void {p}_mass_matrix(const {t} qpos[{n}], {t} matrix[{n} * {n}]) {{
{coupling}  const {t} still[{n}] = {{{zero}}};
  {p}_bodies b;
  {p}_place(qpos, &b);
  for (int i = 0; i < {n}; ++i) {{ /* a row is the effort of a unit acceleration; the matrix is symmetric */
    {t} unit[{n}];
    for (int j = 0; j < {n}; ++j) unit[j] = leader[j] == i ? multiplier[j] : {zero};
    {p}_efforts(&b, still, unit, {zero}, matrix + {n} * i);
    if (leader[i] != i) matrix[{n} * i + i] = {one};
  }}
}}

/* Efforts [N m or N] that cancel gravity and Coriolis and centrifugal forces, at qpos [rad or m] and qvel. */
static inline void {p}_bias(const {t} qpos[{n}], const {t} qvel[{n}], {t} bias[{n}]) {{
  const {t} still[{n}] = {{{zero}}};
  {p}_bodies b;
  {p}_place(qpos, &b);
  {p}_efforts(&b, qvel, still, {one}, bias);
}}

/* Efforts [N m or N] that hold the robot at qpos [rad or m]. */
static inline void {p}_gravity(const {t} qpos[{n}], {t} bias[{n}]) {{
  const {t} still[{n}] = {{{zero}}};
  {p}_bias(qpos, still, bias);
}}

"""


def _integers(c: Dialect, name: str, values: object) -> str:
    numbers = ", ".join(str(int(value)) for value in np.asarray(values))
    return f"  static const int {name}[{c.size}] = {{{numbers}}};\n"
