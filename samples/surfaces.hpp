// SPDX-License-Identifier: MIT
//
// Analytic test surfaces, used by the samples, the tests and `make stress`. All but the faults, at
// the end, lie in the unit cube, at least .13 from its sides; edges are .01 to .02 long; triangles
// are counter-clockwise in the plane of the formula's parameters. c = (.5, .5, .5) is the cube's
// centre.
#ifndef MECCANO_SAMPLES_SURFACES_HPP
#define MECCANO_SAMPLES_SURFACES_HPP

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <limits>

#include "../meccano.hpp"

namespace meccano::samples {

constexpr double pi = 3.14159265358979323846;
constexpr double edgeLength = .0125;  // aimed at
constexpr Vec3 centre{.5, .5, .5};

// ==== Tools =====================================================================================

/// splitmix64 (Steele, Lea, Flood 2014): the same numbers on every platform, as std's distributions
/// are not.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  /// Uniform in [low, high).
  double between(double low, double high) {
    std::uint64_t z = state_ += 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    z ^= z >> 31;
    return low + (high - low) * (static_cast<double>(z >> 11) * 0x1p-53);
  }

 private:
  std::uint64_t state_;
};

/// How many edges of about edgeLength a curve of this length takes.
inline int steps(double length) {
  return std::max(2, static_cast<int>(std::lround(length / edgeLength)));
}

/// A grid of nx x ny cells, two triangles each, mapped from (s, t) in [-1, 1]^2.
inline TriangleSurface sheet(int nx, int ny, const std::function<Vec3(double s, double t)>& map) {
  TriangleSurface S;
  for (int i = 0; i <= nx; ++i)
    for (int j = 0; j <= ny; ++j) S.points.push_back(map(2. * i / nx - 1, 2. * j / ny - 1));
  for (int i = 0; i < nx; ++i)
    for (int j = 0; j < ny; ++j) {
      const int a = i * (ny + 1) + j, b = a + ny + 1;
      S.triangles.push_back({a, b, b + 1});
      S.triangles.push_back({a, b + 1, a + 1});
    }
  return S;
}

/// A disk of n rings mapped from (r, theta), r in [0, 1]: ring i has 6 i points, so that the
/// triangles stay near-equilateral.
inline TriangleSurface polarSheet(int n, const std::function<Vec3(double r, double theta)>& map) {
  TriangleSurface S;
  auto at = [](int ring, int j) {
    return ring == 0 ? 0 : 1 + 3 * ring * (ring - 1) + j % (6 * ring);
  };
  for (int ring = 0; ring <= n; ++ring)
    for (int j = 0; j < std::max(1, 6 * ring); ++j)
      S.points.push_back(map(double(ring) / n, ring == 0 ? 0 : 2 * pi * j / (6 * ring)));
  for (int ring = 1; ring <= n; ++ring)
    for (int sector = 0; sector < 6; ++sector)
      for (int j = 0; j < ring; ++j) {
        const int outer = sector * ring + j, inner = sector * (ring - 1) + j;
        S.triangles.push_back({at(ring - 1, inner), at(ring, outer), at(ring, outer + 1)});
        if (j + 1 < ring)
          S.triangles.push_back(
              {at(ring - 1, inner), at(ring, outer + 1), at(ring - 1, inner + 1)});
      }
  return S;
}

/// Turned by `degrees` about coordinate axis 0, 1 or 2 through the origin.
inline Vec3 turned(Vec3 p, int axis, double degrees) {
  const double c = std::cos(degrees * pi / 180), s = std::sin(degrees * pi / 180);
  if (axis == 0) return {p.x, c * p.y - s * p.z, s * p.y + c * p.z};
  if (axis == 1) return {c * p.x + s * p.z, p.y, c * p.z - s * p.x};
  return {c * p.x - s * p.y, s * p.x + c * p.y, p.z};
}

inline TriangleSurface named(TriangleSurface S, std::string name) {
  S.name = std::move(name);
  return S;
}

// ==== Surfaces of one formula ===================================================================

constexpr double halfSide = .35;  // of the square [.15, .85]^2

/// z = .5 + A sin(2 pi x) over [.15, .85]^2, n x n x 2 triangles (§4.1, Figure 8).
inline TriangleSurface sine(double A, int n = 64) {
  return named(sheet(n, n,
                     [A](double s, double t) {
                       const double x = .5 + halfSide * s, y = .5 + halfSide * t;
                       return Vec3{x, y, .5 + A * std::sin(2 * pi * x)};
                     }),
               "sine");
}

/// z = .5 + A sin(2 pi x) sin(2 pi y) over [.15, .85]^2, 64 x 64 x 2 triangles.
inline TriangleSurface sine2(double A) {
  return named(sheet(64, 64,
                     [A](double s, double t) {
                       const double x = .5 + halfSide * s, y = .5 + halfSide * t;
                       return Vec3{x, y, .5 + A * std::sin(2 * pi * x) * std::sin(2 * pi * y)};
                     }),
               "sine2");
}

/// A square of side .5 about c, normal to z, turned by angleX degrees about x, then by angleY about
/// y.
inline TriangleSurface plane(double angleX, double angleY) {
  return named(sheet(40, 40,
                     [=](double s, double t) {
                       return centre + turned(turned({.25 * s, .25 * t, 0}, 0, angleX), 1, angleY);
                     }),
               "plane");
}

/// A flat disc of radius .34 about c, turned by `tilt` degrees about x; 0: in the plane z = .5.
inline TriangleSurface disc(double tilt = 0) {
  constexpr double radius = .34;
  return named(
      polarSheet(steps(radius),
                 [=](double r, double theta) {
                   const Vec3 p{radius * r * std::cos(theta), radius * r * std::sin(theta), 0};
                   return centre + turned(p, 0, tilt);
                 }),
      "disc");
}

/// The part of a sphere within degrees / 2 of its pole, seen from its centre: the full opening
/// angle (180: a hemisphere). The rim's radius is .34, the sphere's .34 / sin(degrees / 2); centred
/// in height.
inline TriangleSurface cap(double degrees) {
  const double half = degrees * pi / 360, radius = .34 / std::sin(half);
  const double middle = .5 * radius * (1 + std::cos(half));
  return named(polarSheet(steps(radius * half),
                          [=](double r, double theta) {
                            const double in = radius * std::sin(r * half);
                            return centre + Vec3{in * std::cos(theta), in * std::sin(theta),
                                                 radius * std::cos(r * half) - middle};
                          }),
               "cap");
}

/// z = .5 + A ((x - .5)^2 - (y - .5)^2) / .35^2 over [.15, .85]^2.
inline TriangleSurface saddle(double A) {
  return named(sheet(64, 64,
                     [A](double s, double t) {
                       return centre + Vec3{halfSide * s, halfSide * t, A * (s * s - t * t)};
                     }),
               "saddle");
}

/// (r cos a, r sin a, .28 t) + c, a = turns pi t, for r in [-.33, .33], t in [-1, 1].
inline TriangleSurface helicoid(double turns) {
  constexpr double radius = .33, halfHeight = .28;
  const double rimLength = 2 * std::hypot(halfHeight, turns * pi * radius);
  return named(sheet(steps(2 * radius), steps(rimLength),
                     [=](double s, double t) {
                       const double r = radius * s, a = turns * pi * t;
                       return centre + Vec3{r * std::cos(a), r * std::sin(a), halfHeight * t};
                     }),
               "helicoid");
}

/// .7 x .1 (7:1), z = .05 sin(2 pi s) along it, turned by 30 degrees about z.
inline TriangleSurface strip() {
  return named(sheet(56, 8,
                     [](double s, double t) {
                       return centre + turned({.35 * s, .05 * t, .05 * std::sin(pi * s)}, 2, 30);
                     }),
               "strip");
}

/// Outline r = .26 (1 + .25 cos 3 theta), z = .5 + (x - .5)^2 - (y - .5)^2.
inline TriangleSurface threeLobed() {
  return named(polarSheet(steps(.26),
                          [](double r, double theta) {
                            const double R = .26 * r * (1 + .25 * std::cos(3 * theta) * r * r);
                            const double x = R * std::cos(theta), y = R * std::sin(theta);
                            return centre + Vec3{x, y, x * x - y * y};
                          }),
               "threeLobed");
}

/// Outline r = .28 + sum over k = 3 .. 24 of (.02 / sqrt k) sin(k theta + phase), each rim point
/// moved by up to .003 more; z = .5 + .05 sin(2 pi x). A digitized outline.
inline TriangleSurface raggedRim() {
  constexpr int lowest = 3, highest = 24;
  Random random(7);
  std::vector<double> phase;
  for (int k = lowest; k <= highest; ++k) phase.push_back(random.between(0, 2 * pi));
  return named(polarSheet(steps(.28),
                          [&](double r, double theta) {
                            double noise = r == 1 ? random.between(-.003, .003) : 0;
                            for (int k = lowest; k <= highest; ++k)
                              noise += .02 / std::sqrt(k) * std::sin(k * theta + phase[k - lowest]);
                            const double R = r * .28 + noise * r * r * r * r;
                            const double x = R * std::cos(theta), y = R * std::sin(theta);
                            return centre + Vec3{x, y, .05 * std::sin(2 * pi * (x + .5))};
                          }),
               "raggedRim");
}

/// A roof z = const - slope sqrt((x - .5)^2 + w^2), crest along y with radius of curvature w /
/// slope. Mild: slope 1.2, radius .05, |x - .5| <= .3. Knife: slope 3, radius .0005, |x - .5| <=
/// .2: no l_c that is affordable resolves it, insertSurface must refuse.
enum class Ridge { mild, knife };
inline TriangleSurface ridge(Ridge kind) {
  const double slope = kind == Ridge::mild ? 1.2 : 3, half = kind == Ridge::mild ? .3 : .2;
  const double w = slope * (kind == Ridge::mild ? .05 : .0005);
  const double height = slope * (std::hypot(half, w) - w);
  return named(
      sheet(2 * steps(std::hypot(half, height)), steps(.6),
            [=](double s, double t) {
              const double x = half * s;
              return centre + Vec3{x, .3 * t, .5 * height - slope * (std::hypot(x, w) - w)};
            }),
      kind == Ridge::mild ? "ridge mild" : "ridge knife");
}

// ==== Random patches ============================================================================

namespace patch {

/// A rotation drawn uniformly: the quaternion of three uniform numbers (Shoemake 1992).
inline Mat3 randomRotation(Random& random) {
  const double u = random.between(0, 1), v = 2 * pi * random.between(0, 1),
               w = 2 * pi * random.between(0, 1);
  const double a = std::sqrt(1 - u) * std::sin(v), b = std::sqrt(1 - u) * std::cos(v);
  const double c = std::sqrt(u) * std::sin(w), d = std::sqrt(u) * std::cos(w);
  return {{1 - 2 * (b * b + c * c), 2 * (a * b + c * d), 2 * (a * c - b * d)},
          {2 * (a * b - c * d), 1 - 2 * (a * a + c * c), 2 * (b * c + a * d)},
          {2 * (a * c + b * d), 2 * (b * c - a * d), 1 - 2 * (a * a + b * b)}};
}

/// A smooth bump: height exp(-|p - at|^2 / (2 width^2)).
struct Bump {
  Vec2 at;
  double height, width;
};

inline double heightAt(const std::vector<Bump>& bumps, Vec2 p) {
  double z = 0;
  for (const Bump& b : bumps)
    z += b.height * std::exp(-dot(p - b.at, p - b.at) / (2 * b.width * b.width));
  return z;
}

/// Moves the box of S into the cube, by a random shift, and shrinks it where it is too large.
inline void fitIntoCube(TriangleSurface& S, Random& random) {
  constexpr double room = .36;  // half side of the box that keeps .14 from the sides
  constexpr double far = std::numeric_limits<double>::max();
  Vec3 low{far, far, far}, high{-far, -far, -far};
  for (Vec3 p : S.points) {
    low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
    high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
  }
  const Vec3 half = .5 * (high - low), middle = .5 * (high + low);
  const double scale = std::min(1., room / std::max({half.x, half.y, half.z}));
  auto shift = [&](double h) { return (room - scale * h) * random.between(-1, 1); };
  const double dx = shift(half.x), dy = shift(half.y), dz = shift(half.z);
  for (Vec3& p : S.points) p = centre + Vec3{dx, dy, dz} + scale * (p - middle);
}

}  // namespace patch

/// The graph of a sum of four random bumps (heights up to .1, widths .14 to .3) over a square (seed
/// mod 3 = 0), a disc (1) or a lobed disc of 3 or 4 lobes (2) of radius about .3, turned at random
/// in space.
inline TriangleSurface randomPatch(std::uint64_t seed) {
  Random random(seed);
  std::vector<patch::Bump> bumps;
  for (int i = 0; i < 4; ++i) {
    const double x = random.between(-.25, .25), y = random.between(-.25, .25);
    const double height = random.between(-.1, .1);
    bumps.push_back({{x, y}, height, random.between(.14, .3)});
  }
  const Mat3 Q = patch::randomRotation(random);
  const double size = random.between(.24, .32), lobe = random.between(.12, .22);
  const int lobes = random.between(0, 1) < .5 ? 3 : 4;
  auto lift = [&](double x, double y) { return Q * Vec3{x, y, patch::heightAt(bumps, {x, y})}; };
  TriangleSurface S;
  if (seed % 3 == 0) {
    const double half = .85 * size;
    S = sheet(steps(2 * half), steps(2 * half),
              [&](double s, double t) { return lift(half * s, half * t); });
  } else {
    const double depth = seed % 3 == 1 ? 0 : lobe;
    S = polarSheet(steps(size), [&](double r, double theta) {
      const double R = size * r * (1 + depth * r * r * std::cos(lobes * theta));
      return lift(R * std::cos(theta), R * std::sin(theta));
    });
  }
  patch::fitIntoCube(S, random);
  constexpr const char* outlines[3] = {"square", "disc", "lobed"};
  return named(S, outlines[seed % 3]);
}

// ==== Faults ====================================================================================

/// A plane through `at` for a fault (angles in degrees): `strike` turns it about z, x towards y;
/// then `dip` is its angle with the horizontal plane. s runs along strike, t up the dip.
struct FaultPlane {
  Vec3 at;
  double strike, dip;
  Vec3 point(double s, double t, double off) const {
    return at + turned(turned({s, t, off}, 0, dip), 2, strike);
  }
};

/// Four faults in the box [0, 4] x [0, 3] x [0, 2], edges near .08 (`samples/faults`). `west` and
/// `east`: quads of 1.9 x 1.1, dipping towards each other, steeper upwards (listric) and waved
/// along strike; `ring`: a bent disc; `lobe`: an outline of three lobes. At least .27 apart and .3
/// from the box.
inline std::vector<TriangleSurface> faults() {
  auto quad = [](FaultPlane P, double length, double width, double listric, double wave) {
    return sheet(24, 14, [=](double s, double t) {
      return P.point(.5 * length * s, .5 * width * t,
                     listric * (t * t - 1. / 3) + wave * std::sin(.75 * pi * s));
    });
  };
  const TriangleSurface west = quad({{.9, 1.5, 1}, 84, 62}, 1.9, 1.1, .07, .06);
  const TriangleSurface east = quad({{2.08, 1.55, 1}, 276, 58}, 1.9, 1.1, .05, -.07);
  const FaultPlane ringPlane{{3.14, .84, 1.05}, 40, 50};
  const TriangleSurface ring = polarSheet(6, [=](double r, double theta) {
    return ringPlane.point(.48 * r * std::cos(theta), .48 * r * std::sin(theta), .08 * r * r);
  });
  const FaultPlane lobePlane{{3.05, 2.1, .95}, 100, 65};
  const TriangleSurface lobe = polarSheet(7, [=](double r, double theta) {
    const double R = .5 * r * (1 + .18 * r * r * std::cos(3 * theta));
    const double s = R * std::cos(theta), t = R * std::sin(theta);
    return lobePlane.point(s, t, .25 * (s * s - t * t));
  });
  return {named(west, "west"), named(east, "east"), named(ring, "ring"), named(lobe, "lobe")};
}

// ==== Terrain and layers ========================================================================

/// An island of 25.6 km by 25.6 km in the sea (height 0), n x n grid points: a cone of 1800 m with
/// six ridges and their valleys, two side craters, and waves of a few kilometres on its slopes.
inline Terrain island(int n) {
  constexpr double side = 25600;
  Terrain T;
  T.name = "island";
  T.nx = T.ny = n;
  T.cell = side / (n - 1);
  for (int j = 0; j < n; ++j)
    for (int i = 0; i < n; ++i) {
      const double x = double(i) / (n - 1) - .48, y = double(j) / (n - 1) - .53;
      const double r = std::hypot(x, y), a = std::atan2(y, x);
      const double coast = .36 + .04 * std::sin(3 * a + .5) + .02 * std::sin(5 * a);
      const double cone = 1800 * std::max(0., 1 - r / coast);
      const double ridges = 1 + .22 * std::sin(6 * a + 8 * r) * std::min(1., 4 * r);
      const double waves = 60 * std::sin(19 * x + 3 * y) * std::sin(23 * y - 2 * x);
      auto crater = [&](double u, double v) {
        const double d = (x - u) * (x - u) + (y - v) * (y - v);
        return 260 * (std::exp(-d / .0025) - 1.2 * std::exp(-d / .0005));
      };
      const double z =
          cone * ridges + std::min(1., cone / 300) * (waves + crater(.17, .05) + crater(-.1, -.16));
      T.z.push_back(std::round(std::max(0., z)));
    }
  return T;
}

/// Each height the mean of the 3 x 3 around it, so many times.
inline Terrain smoothed(Terrain T, int times) {
  for (; times > 0; --times) {
    const std::vector<double> z = T.z;
    for (int j = 0; j < T.ny; ++j)
      for (int i = 0; i < T.nx; ++i) {
        double sum = 0;
        int count = 0;
        for (int b = std::max(0, j - 1); b <= std::min(T.ny - 1, j + 1); ++b)
          for (int a = std::max(0, i - 1); a <= std::min(T.nx - 1, i + 1); ++a, ++count)
            sum += z[b * T.nx + a];
        T.z[j * T.nx + i] = sum / count;
      }
  }
  return T;
}

/// The terrain lifted by `height`, ending `margin` before its sides (§4.3.1).
inline TriangleSurface layer(const Terrain& T, double height, double margin) {
  const int rim = static_cast<int>(std::ceil(margin / T.cell));
  if (2 * rim + 1 >= std::min(T.nx, T.ny)) throw InputError("layer: no terrain within the margin");
  return named(sheet(T.nx - 1 - 2 * rim, T.ny - 1 - 2 * rim,
                     [&](double s, double t) {
                       const double i = .5 * (T.nx - 1) + s * (.5 * (T.nx - 1) - rim);
                       const double j = .5 * (T.ny - 1) + t * (.5 * (T.ny - 1) - rim);
                       const int a = static_cast<int>(std::lround(i)),
                                 b = static_cast<int>(std::lround(j));
                       return Vec3{T.origin.x + T.cell * a, T.origin.y + T.cell * b,
                                   T.z[b * T.nx + a] + height};
                     }),
               "layer");
}

}  // namespace meccano::samples
#endif
