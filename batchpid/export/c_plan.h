/* A plan: chunks of actions are added when they come, and sampled at any time. As in c_rigid_body.h, a header of
 * batchpid.to_c has the statements of its plan in place of the comments in brackets. */

/* Memory of a plan. */
typedef struct {
  double knots[BATCHPID_JOINTS][BATCHPID_KNOTS], rates[BATCHPID_JOINTS][BATCHPID_KNOTS], weights[BATCHPID_JOINTS][BATCHPID_KNOTS];
  double segment[4][BATCHPID_JOINTS]; /* position and rate at its end, coefficients of the square and the cube */
  double begin, last, end, now; /* of the first and last row, end of the segment, time of the last sample [s] */
  double starved; /* samples later than the last row */
  /* [fields] */
} batchpid_plan;

/* Start at rest at a time [s]. */
static inline void batchpid_plan_init(batchpid_plan *state, const double qpos[BATCHPID_JOINTS], double time) {
  state->begin = state->last = state->end = state->now = time;
  state->starved = 0.0;
  for (int j = 0; j < BATCHPID_JOINTS; ++j) {
    /* [starts] */
    state->segment[0][j] = qpos[j];
    state->segment[1][j] = state->segment[2][j] = state->segment[3][j] = 0.0;
    for (int k = 0; k < BATCHPID_KNOTS; ++k) {
      state->knots[j][k] = qpos[j];
      state->rates[j][k] = state->weights[j][k] = 0.0;
    }
  }
}

/* Setpoint [rad or m] and rate at t [s], not before the last sample; M(q) r'' belongs to the feedforward. */
static inline void batchpid_sample(batchpid_plan *state, double t, double setpoint[BATCHPID_JOINTS], double rate[BATCHPID_JOINTS]) {
  /* [step] */
  if (t >= state->end)
    /* [renewed] */
  /* [sampled] */
  if (t > state->last) state->starved += 1.0;
  state->now = t;
  (void)dt;
}

/* Add a chunk of n rows, at most BATCHPID_HORIZON: setpoints at the times time + k period [s]. */
static inline void batchpid_add_chunk(batchpid_plan *state, const double *chunk, int n, double time) {
  /* [period] */
  const double rows = (double)(n < BATCHPID_HORIZON ? n : BATCHPID_HORIZON);
  const double ahead = batchpid_max(ceil((now - time) / period + 0.5), 0.0);
  const double first = batchpid_min(ahead, rows - 1.0);
  const double begin = ahead > first ? now + (1.0 - first) * period : time;
  const double joined = begin + first * period, length = joined - now;
  const int end = (int)rows, f = (int)first, low = f > 0 ? f - 1 : 0, high = f + 1 < end ? f + 1 : end - 1;
  double blended[BATCHPID_HORIZON][BATCHPID_JOINTS], weights[BATCHPID_HORIZON][BATCHPID_JOINTS], offset[BATCHPID_JOINTS], slope[BATCHPID_JOINTS];
  double position[BATCHPID_JOINTS], speed[BATCHPID_JOINTS];
  if (end < 1) return;
  /* [present] */
  /* [later] */
  for (int j = 0; j < BATCHPID_JOINTS; ++j) {
    const double rise = chunk[high * BATCHPID_JOINTS + j] - chunk[low * BATCHPID_JOINTS + j];
    offset[j] = end > 1 ? offset[j] - chunk[f * BATCHPID_JOINTS + j] : 0.0;
    slope[j] = end > 1 ? slope[j] - rise / ((double)(high - low) * period) : 0.0;
  }
  for (int k = 0; k < end; ++k) {
    const double step = (double)k;
    /* [blended] */
    (void)step;
  }
  for (int j = 0; j < BATCHPID_JOINTS; ++j) {
    for (int i = 0; i < BATCHPID_KNOTS; ++i) {
      const int k = i < end ? i : end - 1;
      const double before = blended[k][j] - (k > 0 ? blended[k - 1][j] : position[j]);
      const double after = k + 1 < end ? blended[k + 1][j] - blended[k][j] : before;
      const int inner = k > 0 && k + 1 < end;
      state->knots[j][i] = blended[k][j];
      state->rates[j][i] = i < end ? (inner ? 0.5 * (after + before) : after) / period : 0.0;
      state->weights[j][i] = i < end ? weights[k][j] : 0.0;
    }
  }
  /* [joined] */
  state->begin = begin;
  state->end = joined;
  state->last = begin + (rows - 1.0) * period;
}
