// Proof that no two shapes of a robot touch, with which a sim step skips MuJoCo's collision detection.
//
// Two shapes d apart stay apart while the joints move by less than sum_j arm_j |dq_j| = d, where arm_j bounds the speed at
// which joint j closes them, at every pose. That is conservative advancement (B. Mirtich, Impulse-based Dynamic
// Simulation of Rigid Body Systems, PhD thesis, University of California, Berkeley, 1996, section 2.3). A proof uses
// the present state alone. Where there is none, MuJoCo runs its collision detection, with the same result.

#pragma once

#include "batchpid/native/rigid_body.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#pragma GCC visibility push(hidden)

namespace batchpid {

// Kinds of shapes: mjtGeom.
enum ShapeKind : std::int32_t { PLANE = 0, SPHERE = 2, CAPSULE = 3, CYLINDER = 5, BOX = 6, HULL = 7 };

// Shapes of a robot, and what is proved of the robots of a group. Python fills in the fields (Clearance in interface.py)
// and owns what they point to.
struct Clearance {
  void (*kinematics)(void const *model, void *data);  // mj_kinematics
  void *const *models;               // (robots,): mjModel, not shared with another group
  double *const *places, *const *turns;  // (robots,): places (shapes, 3) and rotations (shapes, 9), in mjData
  std::int32_t const *kinds;         // (shapes,)
  double const *sizes;               // (shapes, 3), as in mjModel
  double const *radii;               // (shapes,): of the ball around a shape's place, or 0 for a plane
  std::int32_t const *hulls;         // (shapes, 2): first vertex and number of vertices
  double const *vertices;            // (vertices, 3)
  std::int32_t const *pairs;         // (pairs, 2): shapes that may touch; a plane comes first
  double const *arms;                // (pairs, dof)
  double const *travel;              // (2, dof): least and largest position at which the arms hold
  double *last;                      // (robots, dof): positions after the last sim step
  double *moved;                     // (robots, dof): sum of |dq| since the last proof
  float *left;                       // (robots, pairs): clearances [m], rounded down
  double *rate;                      // (robots, dof): largest arm over clearance [1/rad or 1/m]
  std::int32_t *wait;                // (robots,): 0 while a proof holds; otherwise sim steps until the next attempt
  std::int32_t const *const *shapes;  // (robots,): numbers of shapes of their bodies, body_geomnum in mjModel
  std::int32_t const *no_shapes;     // (bodies,): zeros
  std::int64_t number;               // of pairs
  std::int64_t flags, counts;        // places of opt.disableflags and of the pointer body_geomnum in mjModel [bytes]
  std::int32_t contact, unused;      // mjDSBL_CONTACT
};

constexpr double MARGIN = 1e-4;        // [m], far above the rounding of places and of MuJoCo's own distances
constexpr double SHARE = 0.25;         // of a clearance; when more of it is used, it is computed anew
constexpr double TIGHT = 0.7;          // of the true distance, at which a bound is good enough to stop
constexpr int MOST_POINTS = 16;        // largest number of iterations of Gilbert's algorithm
constexpr std::int32_t RETRY_STEPS = 50;

using Point = Vector<double>;

// One shape of one robot.
struct PlacedShape {
  Clearance const &clearance;
  std::int64_t number;
  double const *place, *turn;

  Point center() const { return {place[0], place[1], place[2]}; }
  double radius() const { return clearance.radii[number]; }
  Point normal() const { return {turn[2], turn[5], turn[8]}; }  // of a plane: its z axis

  // Return the point of the shape that is farthest in direction d, which may have any length.
  Point farthest(Point d) const {
    Point const along[3] = {{turn[0], turn[3], turn[6]}, {turn[1], turn[4], turn[7]}, {turn[2], turn[5], turn[8]}};
    Point const p = local_farthest({dot(along[0], d), dot(along[1], d), dot(along[2], d)});
    return center() + (p.x * along[0] + (p.y * along[1] + p.z * along[2]));
  }

 private:
  Point local_farthest(Point d) const {
    double const *size = clearance.sizes + 3 * number;
    switch (clearance.kinds[number]) {
      case SPHERE:
      case CAPSULE: {
        double const length = std::sqrt(dot(d, d)), scale = length > 0.0 ? size[0] / length : 0.0;
        double const half = clearance.kinds[number] == CAPSULE ? std::copysign(size[1], d.z) : 0.0;
        return {scale * d.x, scale * d.y, scale * d.z + half};
      }
      case CYLINDER: {
        double const across = std::sqrt(d.x * d.x + d.y * d.y), scale = across > 0.0 ? size[0] / across : 0.0;
        return {scale * d.x, scale * d.y, std::copysign(size[1], d.z)};
      }
      case BOX:
        return {std::copysign(size[0], d.x), std::copysign(size[1], d.y), std::copysign(size[2], d.z)};
      default: {
        std::int32_t const *hull = clearance.hulls + 2 * number;
        double const *vertex = clearance.vertices + 3 * static_cast<std::int64_t>(hull[0]), *best = vertex;
        double most = -std::numeric_limits<double>::infinity();
        for (std::int32_t i = 0; i < hull[1]; ++i, vertex += 3) {
          double const along = vertex[0] * d.x + vertex[1] * d.y + vertex[2] * d.z;
          if (along > most) most = along, best = vertex;
        }
        return {best[0], best[1], best[2]};
      }
    }
  }
};

// Return a lower bound of the distance of two convex shapes, at least TIGHT of it where it is above zero and MOST_POINTS
// suffice: E. G. Gilbert, An iterative procedure for computing the minimum of a quadratic form on a convex set, SIAM
// Journal on Control 4 (1966). v is a point of the difference of the shapes, w the one farthest against it, and every
// point of the difference is at least v . w / |v| from the origin.
inline double distance_bound(PlacedShape const &a, PlacedShape const &b) {
  if (a.clearance.kinds[a.number] == PLANE) {
    Point const normal = a.normal();
    return dot(normal, b.farthest(-1.0 * normal) + -1.0 * a.center());
  }
  Point v = a.center() + -1.0 * b.center();
  double const apart = std::sqrt(dot(v, v)), balls = apart - a.radius() - b.radius();
  if (balls >= 0.5 * apart) return balls;
  double best = balls;
  for (int i = 0; i < MOST_POINTS; ++i) {
    double const length = std::sqrt(dot(v, v));
    if (!(length > 0.0)) break;
    Point const w = a.farthest(-1.0 * v) + -1.0 * b.farthest(v);
    best = std::max(best, dot(v, w) / length);
    if (i == 0) {  // the centers may lie outside of their shapes
      v = w;
      continue;
    }
    if (best >= TIGHT * length) break;
    Point const step = w + -1.0 * v;
    double const square = dot(step, step);
    if (!(square > 0.0)) break;
    v = v + std::clamp(-dot(v, step) / square, 0.0, 1.0) * step;
  }
  return best;
}

// Recompute the clearances of one robot that are used up in part. Return whether all are positive.
inline bool prove(Clearance const &clearance, std::int64_t row, std::int64_t dof) {
  double *moved = clearance.moved + row * dof, *rate = clearance.rate + row * dof;
  float *left = clearance.left + row * clearance.number;
  double const *places = clearance.places[row], *turns = clearance.turns[row];
  std::fill(rate, rate + dof, 0.0);
  for (std::int64_t pair = 0; pair < clearance.number; ++pair) {
    double const *arms = clearance.arms + pair * dof;
    double used = 0.0;
    for (std::int64_t joint = 0; joint < dof; ++joint) used += arms[joint] * moved[joint];
    double rest = left[pair] - used;
    if (!(used < SHARE * rest)) {
      std::int64_t const a = clearance.pairs[2 * pair], b = clearance.pairs[2 * pair + 1];
      rest = distance_bound({clearance, a, places + 3 * a, turns + 9 * a},
                            {clearance, b, places + 3 * b, turns + 9 * b}) - MARGIN;
    }
    left[pair] = std::nextafter(static_cast<float>(rest), -1.0f);
    if (!(left[pair] > 0.0f)) {
      std::fill(left, left + clearance.number, -1.0f);  // all are computed anew next time
      return false;
    }
    double const inverse = 1.0 / left[pair];
    for (std::int64_t joint = 0; joint < dof; ++joint) rate[joint] = std::max(rate[joint], arms[joint] * inverse);
  }
  std::fill(moved, moved + dof, 0.0);
  return true;
}

// Return whether no shapes of one robot touch, as far as is proved, at the positions `qpos` of the joints at `qpos_at`.
inline bool is_clear(Clearance const &clearance, std::int64_t row, std::int64_t dof, void *data, double const *qpos,
                     std::int64_t const *qpos_at) {
  double *last = clearance.last + row * dof, *moved = clearance.moved + row * dof;
  double const *rate = clearance.rate + row * dof, *least = clearance.travel, *largest = least + dof;
  double used = 0.0;
  bool inside = true;
  for (std::int64_t joint = 0; joint < dof; ++joint) {
    double const q = qpos[qpos_at[joint]];
    moved[joint] += std::fabs(q - last[joint]);
    last[joint] = q;
    used += rate[joint] * moved[joint];
    inside = inside && q >= least[joint] && q <= largest[joint];
  }
  std::int32_t &wait = clearance.wait[row];
  if (!inside) return false;
  if (wait == 0 && used < 1.0) return true;
  if (wait > 1) {
    --wait;
    return false;
  }
  clearance.kinematics(clearance.models[row], data);
  bool const clear = prove(clearance, row, dof);
  wait = clear ? 0 : RETRY_STEPS;
  return clear;
}

// Switch MuJoCo's contacts of one robot off or on. Without them no body has shapes either, so that MuJoCo does not place
// them: nothing but collision detection and proofs reads their places, and a proof places them first.
inline void switch_contacts(Clearance const &clearance, std::int64_t row, bool off) {
  char *model = static_cast<char *>(clearance.models[row]);
  auto &flags = *reinterpret_cast<std::int32_t *>(model + clearance.flags);
  flags = off ? flags | clearance.contact : flags & ~clearance.contact;
  *reinterpret_cast<std::int32_t const **>(model + clearance.counts) = off ? clearance.no_shapes : clearance.shapes[row];
}

}  // namespace batchpid

#pragma GCC visibility pop
