/* Rigid-body functions of a robot. A header of batchpid.to_c has them with the prefix and the type of its numbers, and
 * tables in place of the comments in brackets. Efforts come from the recursive Newton-Euler algorithm about the world's
 * origin (R. Featherstone, Rigid Body Dynamics Algorithms, Springer, 2008, section 5.3), those of a unit acceleration at
 * rest are a row of the mass matrix (section 6.1). */

/* Bodies at a pose, in the axes of the world. */
typedef struct {
  double turn[BATCHPID_JOINTS][9], place[BATCHPID_JOINTS][3];      /* axes (rows of a matrix) and origin */
  double linear[BATCHPID_JOINTS][3], angular[BATCHPID_JOINTS][3];  /* velocity at the world's origin per rate of the joint */
  double center[BATCHPID_JOINTS][3], tensor[BATCHPID_JOINTS][9];   /* center of mass, and inertia tensor about it */
} batchpid_bodies;

static inline double batchpid_dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* out += a x b */
static inline void batchpid_add_cross(const double *a, const double *b, double *out) {
  out[0] += a[1] * b[2] - a[2] * b[1];
  out[1] += a[2] * b[0] - a[0] * b[2];
  out[2] += a[0] * b[1] - a[1] * b[0];
}

static inline void batchpid_rotate(const double *turn, const double *a, double *out) {
  for (int i = 0; i < 3; ++i) out[i] = batchpid_dot(turn + 3 * i, a);
}

static inline void batchpid_place(const double *qpos, batchpid_bodies *b) {
  /* [poses] */
  for (int j = 0; j < BATCHPID_JOINTS; ++j) {
    const double sine = slides[j] ? 0.0 : sin(qpos[j]), cosine = slides[j] ? 1.0 : cos(qpos[j]);
    const int up = above[j];
    double turn[9], place[3], mixed[9];
    for (int i = 0; i < 3; ++i) {
      const double *row = k_turn[j] + 3 * i; /* the axis is the x axis of the body */
      turn[3 * i] = row[0];
      turn[3 * i + 1] = cosine * row[1] + sine * row[2];
      turn[3 * i + 2] = cosine * row[2] - sine * row[1];
      place[i] = k_place[j][i] + (slides[j] ? qpos[j] * row[0] : 0.0);
    }
    for (int i = 0; i < 3; ++i) {
      for (int k = 0; k < 3; ++k) {
        const double column[3] = {turn[k], turn[3 + k], turn[6 + k]};
        b->turn[j][3 * i + k] = up < 0 ? turn[3 * i + k] : batchpid_dot(b->turn[up] + 3 * i, column);
      }
      b->place[j][i] = up < 0 ? place[i] : batchpid_dot(b->turn[up] + 3 * i, place) + b->place[up][i];
      b->linear[j][i] = b->angular[j][i] = 0.0;
    }
    for (int i = 0; i < 3; ++i) (slides[j] ? b->linear[j] : b->angular[j])[i] = b->turn[j][3 * i];
    if (!slides[j]) batchpid_add_cross(b->place[j], b->angular[j], b->linear[j]);
    batchpid_rotate(b->turn[j], k_center[j], b->center[j]);
    for (int i = 0; i < 3; ++i) b->center[j][i] += b->place[j][i];
    for (int i = 0; i < 3; ++i) batchpid_rotate(b->turn[j], k_tensor[j] + 3 * i, mixed + 3 * i);
    for (int i = 0; i < 3; ++i) {
      for (int k = 0; k < 3; ++k) {
        const double column[3] = {mixed[i], mixed[3 + i], mixed[6 + i]};
        b->tensor[j][3 * i + k] = batchpid_dot(column, b->turn[j] + 3 * k);
      }
    }
  }
}

/* Efforts [N m or N] at velocities and accelerations of the joints, under a share of gravity, with the armature. */
static inline void batchpid_efforts(const batchpid_bodies *b, const double *qvel, const double *qacc, double share, double *effort) {
  /* [masses] */
  double v[BATCHPID_JOINTS][3], w[BATCHPID_JOINTS][3], dv[BATCHPID_JOINTS][3], dw[BATCHPID_JOINTS][3]; /* velocity and acceleration at the world's origin */
  double force[BATCHPID_JOINTS][3], torque[BATCHPID_JOINTS][3];
  for (int j = 0; j < BATCHPID_JOINTS; ++j) {
    const int up = above[j];
    const double *center = b->center[j];
    double linear[3], angular[3], spin[3], rate[3];
    for (int i = 0; i < 3; ++i) {
      linear[i] = b->linear[j][i] * qvel[j];
      angular[i] = b->angular[j][i] * qvel[j];
      v[j][i] = (up < 0 ? 0.0 : v[up][i]) + linear[i];
      w[j][i] = (up < 0 ? 0.0 : w[up][i]) + angular[i];
      dv[j][i] = (up < 0 ? 0.0 : dv[up][i]) + b->linear[j][i] * qacc[j];
      dw[j][i] = (up < 0 ? 0.0 : dw[up][i]) + b->angular[j][i] * qacc[j];
    }
    batchpid_add_cross(w[j], linear, dv[j]);
    batchpid_add_cross(v[j], angular, dv[j]);
    batchpid_add_cross(w[j], angular, dw[j]);
    for (int i = 0; i < 3; ++i) {
      rate[i] = v[j][i];
      force[j][i] = dv[j][i] - share * gravity[i];
    }
    batchpid_add_cross(w[j], center, rate);
    batchpid_add_cross(dw[j], center, force[j]);
    batchpid_add_cross(w[j], rate, force[j]);
    for (int i = 0; i < 3; ++i) force[j][i] *= k_mass[j];
    batchpid_rotate(b->tensor[j], dw[j], torque[j]);
    batchpid_rotate(b->tensor[j], w[j], spin);
    batchpid_add_cross(w[j], spin, torque[j]);
    batchpid_add_cross(center, force[j], torque[j]);
  }
  for (int j = BATCHPID_JOINTS - 1; j >= 0; --j) {
    effort[j] = batchpid_dot(b->linear[j], force[j]) + batchpid_dot(b->angular[j], torque[j]) + k_armature[j] * qacc[j];
    for (int i = 0; i < 3 && above[j] >= 0; ++i) {
      force[above[j]][i] += force[j][i];
      torque[above[j]][i] += torque[j][i];
    }
  }
  for (int j = 0; j < BATCHPID_JOINTS; ++j) { /* followers act through their leaders */
    if (leader[j] == j) continue;
    effort[leader[j]] += multiplier[j] * effort[j];
    effort[j] = 0.0;
  }
}

/* Mass matrix [kg m^2 or kg] at qpos [rad or m], by rows, with the armature of the motors. */
static inline void batchpid_mass_matrix(const double qpos[BATCHPID_JOINTS], double matrix[BATCHPID_JOINTS * BATCHPID_JOINTS]) {
  /* [coupling] */
  const double still[BATCHPID_JOINTS] = {0.0};
  batchpid_bodies b;
  batchpid_place(qpos, &b);
  for (int i = 0; i < BATCHPID_JOINTS; ++i) { /* a row is the effort of a unit acceleration; the matrix is symmetric */
    double unit[BATCHPID_JOINTS];
    for (int j = 0; j < BATCHPID_JOINTS; ++j) unit[j] = leader[j] == i ? multiplier[j] : 0.0;
    batchpid_efforts(&b, still, unit, 0.0, matrix + BATCHPID_JOINTS * i);
    if (leader[i] != i) matrix[BATCHPID_JOINTS * i + i] = 1.0;
  }
}

/* Efforts [N m or N] that cancel gravity and Coriolis and centrifugal forces, at qpos [rad or m] and qvel. */
static inline void batchpid_bias(const double qpos[BATCHPID_JOINTS], const double qvel[BATCHPID_JOINTS], double bias[BATCHPID_JOINTS]) {
  const double still[BATCHPID_JOINTS] = {0.0};
  batchpid_bodies b;
  batchpid_place(qpos, &b);
  batchpid_efforts(&b, qvel, still, 1.0, bias);
}

/* Efforts [N m or N] that hold the robot at qpos [rad or m]. */
static inline void batchpid_gravity(const double qpos[BATCHPID_JOINTS], double bias[BATCHPID_JOINTS]) {
  const double still[BATCHPID_JOINTS] = {0.0};
  batchpid_bias(qpos, still, bias);
}
