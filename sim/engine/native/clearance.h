// Proof that shapes of a robot do not touch. A sim step skips MuJoCo's collision detection for these shapes.
//
// Two shapes at a distance d do not touch while sum_j arm_j |dq_j| < d. Here dq_j is the motion of joint j since the
// distance was computed, and arm_j bounds, at any pose, the closing speed of the shapes per unit speed of joint j. This
// is conservative advancement (B. Mirtich, Impulse-based Dynamic Simulation of Rigid Body Systems, PhD thesis,
// University of California, Berkeley, 1996, section 2.3). A new proof depends on the present state only. MuJoCo runs
// its collision detection for the bodies of all pairs without a proof, and the contacts are the same. A floating base
// counts as two more joints: its displacement with an arm of 1, and its rotation with the shapes' distance from it.

#pragma once

#include "batchpid/native/lanes.h"
#include "batchpid/native/rigid_body.h"

#include <cstring>
#include <vector>

namespace batchpid {

// Kinds of shapes: mjtGeom.
enum ShapeKind : std::int32_t { PLANE = 0, SPHERE = 2, CAPSULE = 3, CYLINDER = 5, BOX = 6, HULL = 7 };

// Shapes of a robot, and the proofs for the robots of a group. Python fills in the fields
// and owns the memory behind the pointers. A way is a joint, or the displacement or rotation angle of a floating base.
struct FOR_PYTHON Clearance {
  void (*kinematics)(void const *model, void *data);  // mj_kinematics
  void *const *models;               // (robots,): mjModel, not shared with another group
  double *const *places, *const *turns;  // (robots,): positions (shapes, 3) and rotations (shapes, 9), in mjData
  std::int32_t const *kinds;         // (shapes,)
  double const *sizes;               // (shapes, 3), as in mjModel
  double const *radii;               // (shapes,): of the ball around a shape's position, or 0 for a plane
  std::int32_t const *hulls;         // (shapes, 2): first vertex and number of vertices
  double const *vertices;            // (vertices, 3)
  std::int32_t const *pairs;         // (pairs, 2): shapes that may touch; a plane comes first
  std::int32_t const *bodies;        // (pairs, 2): bodies of these shapes
  Lanes const *arms;                 // (ways, pairs / WIDTH, rounded up), 0 beyond the last pair
  double const *travel;              // (2, dof): range of joint positions in which the arms are upper bounds
  Lanes *last;                       // (blocks, dof): positions after the last sim step
  double *poses;                     // (robots, 7): of floating bases, or null
  Lanes *moved;                      // (blocks, ways): sum of |dq| since the last proof
  std::uint16_t *left;               // (robots, pairs rounded up): clearances [m], as from `shortened`, or NOT_PROVED
  Lanes *rate;                       // (blocks, ways): largest arm over clearance of all pairs [1/rad, 1/m]
  // (blocks, 2): bound of the share that a clearance has lost since the last proof or check of all pairs, and the share
  // that it may lose until the next.
  Lanes *shares;
  std::int32_t *wait;                // (robots,): sim steps to the next attempt to prove the open pairs; 0 without any
  std::int32_t *age;                 // (robots,): sim steps since the last proof
  char *brief;                       // (robots,): whether the last proof held for BRIEF sim steps or less
  char *open;                        // (robots, all bodies): whether the body has a pair without a proof
  std::int32_t const *no_shapes;     // (all bodies,): zeros
  std::int32_t *some_types;          // (all bodies,): masks of bodies in pairs without a proof; work space
  std::int64_t number, ways, size;   // number of pairs, of ways, and of all bodies
  // Offsets in mjModel [bytes]: of opt.disableflags, body_geomnum, body_contype and body_conaffinity.
  std::int64_t flags, counts, types_at, affinities_at;
  std::int32_t contact;              // mjDSBL_CONTACT
};

constexpr double MARGIN = 1e-4;        // [m], far above the rounding of positions and of MuJoCo's own distances
constexpr double SHARE = 0.25;         // share of a clearance after whose use the clearance is computed again
constexpr double LARGEST_SHARE = 0.75;  // of a clearance that may be used before a new proof
constexpr double LEAST_CLEARANCE = 1e-30;  // [m], that has two bytes other than 0
constexpr double TIGHT = 0.7;          // share of the true distance at which a lower bound is good enough
constexpr int MOST_POINTS = 16;        // largest number of iterations of Gilbert's algorithm
constexpr std::int32_t RETRY_STEPS = 50;  // sim steps between attempts to prove the open pairs
constexpr std::int32_t NEVER = 1 << 30;   // age without a proof
constexpr std::int32_t BRIEF = 1, PAUSE = 24;  // after a proof that held for BRIEF sim steps, no proof for PAUSE
constexpr std::int32_t LEAST_STEPS = 4;   // least sim steps that a proof must last; nearer pairs are left to MuJoCo

// Shapes for which MuJoCo runs its collision detection in a sim step.
enum class Looked { NONE, SOME, ALL };

constexpr std::uint16_t NOT_PROVED = 0;

using Point = Vector<double>;

// Return a positive number as the upper two bytes of its float32, rounded down to three digits; NOT_PROVED for others.
// Two bytes, because a robot has many clearances.
inline std::uint16_t shortened(double value) {
  float const single = static_cast<float>(value);
  std::uint32_t bits = 0;
  std::memcpy(&bits, &single, sizeof bits);
  bits -= 1;  // the next number towards 0
  return single > 0.0f ? static_cast<std::uint16_t>(bits >> 16) : NOT_PROVED;
}

// The same for WIDTH numbers, and back.
typedef std::uint16_t Halves __attribute__((vector_size(WIDTH * sizeof(std::uint16_t))));
typedef std::uint32_t Bits __attribute__((vector_size(WIDTH * sizeof(std::uint32_t))));
typedef float Singles __attribute__((vector_size(WIDTH * sizeof(float))));
inline __attribute__((always_inline)) Lanes widened(std::uint16_t const *from) {
  Halves halves;
  std::memcpy(&halves, from, sizeof halves);
  Bits const bits = __builtin_convertvector(halves, Bits) << 16;
  Singles singles;
  std::memcpy(&singles, &bits, sizeof singles);
  return __builtin_convertvector(singles, Lanes::Packed);
}
inline __attribute__((always_inline)) void write_shortened(Lanes positive, std::uint16_t *to) {
  Singles const singles = __builtin_convertvector(positive.of, Singles);
  Bits bits;
  std::memcpy(&bits, &singles, sizeof bits);
  Halves const halves = __builtin_convertvector((bits - 1) >> 16, Halves);
  std::memcpy(to, &halves, sizeof halves);
}

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

// Return a lower bound of the distance of two convex shapes. It is at least TIGHT times a distance above zero, if
// MOST_POINTS iterations suffice: E. G. Gilbert, An iterative procedure for computing the minimum of a quadratic form
// on a convex set, SIAM Journal on Control 4 (1966). v is a point of the Minkowski difference of the shapes, and w its
// farthest point in direction -v, so every point of the difference is at least v . w / |v| from the origin.
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

// Return the largest share of a clearance that the motions of a robot have used.
FOR_EACH_PROCESSOR static double largest_share(Clearance const &clearance, std::int64_t row) {
  std::int64_t const ways = clearance.ways, blocks = (clearance.number + WIDTH - 1) / WIDTH;
  std::uint16_t const *left = clearance.left + row * blocks * WIDTH;
  Lanes most{};
  for (std::int64_t block = 0; block < blocks; ++block) {
    Lanes use{};
    for (std::int64_t way = 0; way < ways; ++way) {
      use += clearance.arms[way * blocks + block] * Lanes(clearance.moved[row / WIDTH * ways + way].of[row % WIDTH]);
    }
    Lanes const before = widened(left + block * WIDTH);
    most = at_least(most, where_positive(before, use / before, 0.0));
  }
  return largest(most);
}

// Recompute the clearances of one robot that are partly used up, and with `retry` also the clearances of open pairs.
// Return whether all pairs are proved.
FOR_EACH_PROCESSOR static bool prove(Clearance const &clearance, std::int64_t row, bool retry) {
  std::int64_t const ways = clearance.ways, at = row / WIDTH * ways, k = row % WIDTH;
  std::int64_t const blocks = (clearance.number + WIDTH - 1) / WIDTH;
  std::uint16_t *left = clearance.left + row * blocks * WIDTH;
  char *open = clearance.open + row * clearance.size;
  double const *places = clearance.places[row], *turns = clearance.turns[row];
  double const age = clearance.age[row];
  static thread_local std::vector<Lanes> room;
  room.assign(static_cast<std::size_t>(2 * blocks), Lanes{});
  Lanes *use = room.data(), *inverse = use + blocks;
  for (std::int64_t way = 0; way < ways; ++way) {
    Lanes const moved = clearance.moved[at + way].of[k];
    Lanes const *arms = clearance.arms + way * blocks;
    for (std::int64_t block = 0; block < blocks; ++block) use[block] += arms[block] * moved;
  }
  bool all = true;
  std::fill(open, open + clearance.size, char{0});
  for (std::int64_t block = 0; block < blocks; ++block) {
    std::uint16_t *own = left + block * WIDTH;
    Lanes const before = widened(own), rests = before - use[block];
    // Proofs that stay: most pairs.
    Lanes const stays = below_mask(use[block], SHARE * rests) * below_mask(LEAST_CLEARANCE, rests);
    write_shortened(at_least(rests, 0.0), own);
    if (any_positive(1.0 - stays)) {
      for (std::int64_t i = 0, pair = block * WIDTH; i < WIDTH && pair < clearance.number; ++i, ++pair) {
        if (stays.of[i] > 0.0) continue;
        bool const proved = before.of[i] > 0.0;
        bool fades = true;
        double rest = 0.0;
        if (proved || retry) {
          std::int64_t const a = clearance.pairs[2 * pair], b = clearance.pairs[2 * pair + 1];
          rest = distance_bound({clearance, a, places + 3 * a, turns + 9 * a},
                                {clearance, b, places + 3 * b, turns + 9 * b}) - MARGIN;
          fades = (!proved || age < LEAST_STEPS) && !(LEAST_STEPS * use[block].of[i] < age * rest);
        }
        own[i] = fades ? NOT_PROVED : shortened(rest);
        if (own[i] != NOT_PROVED) continue;
        open[clearance.bodies[2 * pair]] = open[clearance.bodies[2 * pair + 1]] = 1;
        all = false;
      }
    }
    Lanes const after = widened(own);
    inverse[block] = where_positive(after, 1.0 / after, 0.0);
  }
  for (std::int64_t way = 0; way < ways; ++way) {
    Lanes const *arms = clearance.arms + way * blocks;
    Lanes most{};
    for (std::int64_t block = 0; block < blocks; ++block) most = at_least(most, arms[block] * inverse[block]);
    clearance.rate[at + way].of[k] = largest(most);
    clearance.moved[at + way].of[k] = 0.0;
  }
  Lanes *shares = clearance.shares + row / WIDTH * 2;
  shares[0].of[k] = 0.0;
  shares[1].of[k] = 1.0;
  return all;
}

// Add the motion of a floating base to `moved`: its displacement and its rotation angle, from its pose (7,).
inline void add_base_motion(double const *now, double *last, double *moved) {
  double way = 0.0, with = 0.0, against = 0.0;
  for (int k = 0; k < 3; ++k) way += (now[k] - last[k]) * (now[k] - last[k]);
  for (int k = 3; k < 7; ++k) {
    with += (now[k] - last[k]) * (now[k] - last[k]);
    against += (now[k] + last[k]) * (now[k] + last[k]);
  }
  moved[0] += std::sqrt(way);
  moved[1] += 4.0 * std::asin(std::min(1.0, 0.5 * std::sqrt(std::min(with, against))));  // |q - q'| = 2 sin(angle / 4)
  std::copy(now, now + 7, last);
}

// Masks of WIDTH robots: whether they are in the range of the arms, and whether their proofs hold.
struct Holding {
  Lanes inside, proved;
};

// Add the motion of a block of robots since the last sim step: positions (dof,), and the ways of floating bases, or null.
FOR_EACH_PROCESSOR static void add_motion(Clearance const &clearance, std::int64_t block, Lanes const *qpos,
                                          Lanes const *base, Holding &holding) {
  std::int64_t const ways = clearance.ways, dof = base == nullptr ? ways : ways - 2, at = block * ways;
  Lanes *last = clearance.last + block * dof, *shares = clearance.shares + 2 * block;
  Lanes outside{}, used = shares[0];
  for (std::int64_t way = 0; way < ways; ++way) {
    Lanes moved;
    if (way < dof) {
      moved = absolute(qpos[way] - last[way]);
      last[way] = qpos[way];
      outside += 2.0 - at_least_mask(qpos[way], clearance.travel[way]);
      outside -= at_least_mask(clearance.travel[dof + way], qpos[way]);
    } else {
      moved = base[way - dof];
    }
    clearance.moved[at + way] += moved;
    used += clearance.rate[at + way] * moved;
  }
  shares[0] = used;
  holding = {1.0 - outside, below_mask(used, shares[1])};
}

// Return the shapes that MuJoCo has to check of a robot, after a new proof if one is due; `place` writes its positions to
// its mjData.
template <class Place>
inline __attribute__((always_inline)) Looked looked_at(Clearance const &clearance, std::int64_t row, Holding const &holding, Place place) {
  std::int64_t const k = row % WIDTH;
  if (!(holding.inside.of[k] > 0.0)) return Looked::ALL;
  std::int32_t &wait = clearance.wait[row], &age = clearance.age[row];
  bool const retry = wait > 0 && --wait == 0;
  age = std::min(age + 1, NEVER);
  if (!retry && age > BRIEF && age <= BRIEF + PAUSE && clearance.brief[row] != 0) return Looked::ALL;
  bool proved = holding.proved.of[k] > 0.0;
  if (!proved) {
    Lanes *shares = clearance.shares + row / WIDTH * 2;
    double const most = largest_share(clearance, row);
    proved = most < LARGEST_SHARE;
    shares[0].of[k] = 0.0;
    shares[1].of[k] = 1.0 - most;
  }
  if (retry || !proved) {
    if (!retry && age <= BRIEF) {
      clearance.brief[row] = 1;
      return Looked::ALL;
    }
    clearance.brief[row] = 0;
    place();
    if (!prove(clearance, row, retry) && wait == 0) wait = RETRY_STEPS;
    age = 0;
  }
  return wait == 0 ? Looked::NONE : Looked::SOME;
}

// Fields of an mjModel that select the shapes for MuJoCo's collision detection.
struct Shapes {
  std::int32_t flags;
  std::int32_t const *counts, *types, *affinities;
};

inline Shapes get_shapes(Clearance const &clearance, std::int64_t row) {
  char const *model = static_cast<char const *>(clearance.models[row]);
  auto const pointer = [&](std::int64_t place) { return *reinterpret_cast<std::int32_t const *const *>(model + place); };
  return {*reinterpret_cast<std::int32_t const *>(model + clearance.flags), pointer(clearance.counts),
          pointer(clearance.types_at), pointer(clearance.affinities_at)};
}

inline void set_shapes(Clearance const &clearance, std::int64_t row, Shapes const &shapes) {
  char *model = static_cast<char *>(clearance.models[row]);
  *reinterpret_cast<std::int32_t *>(model + clearance.flags) = shapes.flags;
  *reinterpret_cast<std::int32_t const **>(model + clearance.counts) = shapes.counts;
  *reinterpret_cast<std::int32_t const **>(model + clearance.types_at) = shapes.types;
  *reinterpret_cast<std::int32_t const **>(model + clearance.affinities_at) = shapes.affinities;
}

// Return the fields with which MuJoCo checks a part of the shapes `all` of one robot. With NONE the bodies also have no
// shapes, so that MuJoCo does not compute the shapes' positions: only collision detection and proofs read them, and a
// proof computes them first. With SOME the other bodies collide with nothing, but the positions of all shapes are
// computed, because MuJoCo derives from them the axes along which it sorts bodies. Types and affinities are equal.
inline Shapes part_of(Shapes const &all, Clearance const &clearance, std::int64_t row, Looked which) {
  if (which == Looked::NONE) {
    return {all.flags | clearance.contact, clearance.no_shapes, all.types, all.affinities};
  }
  for (std::int64_t body = 0; body < clearance.size; ++body) {
    clearance.some_types[body] = clearance.open[row * clearance.size + body] != 0 ? all.types[body] : 0;
  }
  return {all.flags, all.counts, clearance.some_types, clearance.some_types};
}

}  // namespace batchpid
