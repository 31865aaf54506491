// SPDX-License-Identifier: MIT
// §3.2: the tetrahedra that S cuts, eq. (1), and the limits of l_c.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "../meccano.hpp"
#include "../samples/surfaces.hpp"
#include "shapes.hpp"

using namespace meccano;
using samples::Random;
using shapes::Steps;

namespace {

using Tetrahedron = std::array<Vec3, 4>;
using Triangle = std::array<Vec3, 3>;

/// Separating axes, which share no step with clipping: the widest gap between the projections of
/// both on the normals of either and on the cross products of their edges; at most 0 where they
/// meet.
double separation(const Tetrahedron& tet, const Triangle& triangle) {
  std::vector<Vec3> axes, edges;
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < i; ++j) edges.push_back(tet[i] - tet[j]);
  const Vec3 a = triangle[1] - triangle[0], b = triangle[2] - triangle[1],
             c = triangle[0] - triangle[2];
  const Vec3 normal = cross(a, c);
  for (int i = 0; i < 4; ++i) {
    const Vec3 p = tet[(i + 1) % 4], q = tet[(i + 2) % 4], r = tet[(i + 3) % 4];
    axes.push_back(cross(q - p, r - p));
  }
  axes.push_back(normal);
  for (Vec3 side : {a, b, c}) {
    axes.push_back(cross(side, normal));
    for (Vec3 edge : edges) axes.push_back(cross(side, edge));
  }
  double widest = -std::numeric_limits<double>::infinity();
  for (Vec3 axis : axes) {
    if (norm(axis) < 1e-12) continue;
    axis = (1 / norm(axis)) * axis;
    double tetLow = 1e300, tetHigh = -1e300, triangleLow = 1e300, triangleHigh = -1e300;
    for (Vec3 p : tet)
      tetLow = std::min(tetLow, dot(axis, p)), tetHigh = std::max(tetHigh, dot(axis, p));
    for (Vec3 p : triangle)
      triangleLow = std::min(triangleLow, dot(axis, p)),
      triangleHigh = std::max(triangleHigh, dot(axis, p));
    widest = std::max({widest, triangleLow - tetHigh, tetLow - triangleHigh});
  }
  return widest;
}

Vec3 randomPoint(Random& random) {
  const double x = random.between(-1, 1), y = random.between(-1, 1);
  return {x, y, random.between(-1, 1)};
}

/// A point in the interior of the convex hull of the first `count` corners.
template <std::size_t N>
Vec3 randomPointOf(const std::array<Vec3, N>& corners, std::size_t count, Random& random) {
  double sum = 0;
  Vec3 p;
  for (std::size_t i = 0; i < count; ++i) {
    const double w = random.between(.01, 1);
    p += w * corners[i];
    sum += w;
  }
  return (1 / sum) * p;
}

Tetrahedron randomTetrahedron(Random& random) {
  Tetrahedron tet;
  do {
    for (Vec3& p : tet) p = randomPoint(random);
  } while (dot(tet[1] - tet[0], cross(tet[2] - tet[0], tet[3] - tet[0])) < .05);
  return tet;
}

/// Points of S: each triangle at a lattice with n steps per edge.
std::vector<Vec3> sampled(const TriangleSurface& S, int n) {
  std::vector<Vec3> points;
  for (const auto& t : S.triangles)
    for (int i = 0; i <= n; ++i)
      for (int j = 0; i + j <= n; ++j) {
        const double v = double(i) / n, w = double(j) / n;
        points.push_back((1 - v - w) * S.points[t[0]] + v * S.points[t[1]] + w * S.points[t[2]]);
      }
  return points;
}

/// The tetrahedra that hold p (closed), by trying all.
std::vector<int> holders(const Mesh& M, Vec3 p) {
  std::vector<int> found;
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    const auto& z = M.tets[E];
    const Vec3 a = M.x[z[0]];
    const Mat3 edges{M.x[z[1]] - a, M.x[z[2]] - a, M.x[z[3]] - a};
    const double reach = norm2(edges);  // at least the square of each edge at a
    if (norm2(p - a) > reach) continue;
    const Vec3 w = inverse(edges) * (p - a);
    if (std::min({w.x, w.y, w.z, 1 - w.x - w.y - w.z}) >= 0) found.push_back(static_cast<int>(E));
  }
  return found;
}

/// The longest edge of element E, by all its edges.
double literalLongestEdge(const std::vector<Vec3>& x, const std::array<int, 4>& z) {
  double longest = 0;
  for (int a : z)
    for (int b : z) longest = std::max(longest, norm(x[a] - x[b]));
  return longest;
}

/// A box whose inner nodes are moved along a smooth field: a mesh as smoothing leaves it.
Mesh bentBox() {
  Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {4, 4, 4});
  for (std::size_t n = 0; n < M.x.size(); ++n) {
    const Vec3 p = M.x[n];
    const double bump =
        std::sin(samples::pi * p.x) * std::sin(samples::pi * p.y) * std::sin(samples::pi * p.z);
    if (M.dimension[n] == 3) M.x[n] = p + bump * Vec3{.06, -.04, .05};
  }
  return M;
}

/// A small flat sheet about c.
TriangleSurface sheetAt(Vec3 c, double half) {
  return samples::sheet(4, 4, [=](double s, double t) {
    return c + Vec3{half * s, half * t, .1 * half * s * t};
  });
}

/// The text of the InputError that refuses S and options; M must be untouched, no stage reached.
std::string refusal(Mesh& M, const TriangleSurface& S, InsertOptions options) {
  const Mesh before = M;
  int stages = 0;
  options.onStage = [&](const char*, const Mesh&) { ++stages; };
  std::string text;
  try {
    insertSurface(M, S, options);
  } catch (const InputError& error) {
    text = error.what();
  }
  CHECK(shapes::sameMesh(M, before));
  CHECK(stages == 0);
  return text;
}

std::string refusal(const TriangleSurface& S, double lc) {
  Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
  InsertOptions options;
  options.lc = lc;
  return refusal(M, S, options);
}

bool has(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

/// A gutter: two parallel planes of height 1 and length 2 with this distance, joined by half a
/// cylinder.
TriangleSurface gutter(double distance) {
  const double R = distance / 2, length = 2 + samples::pi * R;
  return samples::sheet(60, 20, [=](double s, double t) {
    const double a = .5 * length * s, bent = samples::pi * R / 2, over = std::abs(a) - bent;
    const double angle = std::clamp(a, -bent, bent) / R, side = a > 0 ? 1 : -1;
    return Vec3{R * std::sin(angle), t, -R * std::cos(angle)} + Vec3{0, 0, over > 0 ? over : 0} +
           (over > 0 ? Vec3{side * R, 0, 0} - Vec3{R * std::sin(angle), 0, -R * std::cos(angle)}
                     : Vec3{});
  });
}

/// A flat strip of this width and length 2 about c.
TriangleSurface flatStrip(double width, Vec3 c = {}) {
  return samples::sheet(40, 4, [=](double s, double t) { return c + Vec3{s, .5 * width * t, 0}; });
}

/// What chooseSize() says of S in a box that is far away, or this mesh.
SizeChoice sizeOf(const TriangleSurface& S,
                  const Mesh& M = boxMesh({-9, -9, -9}, {18, 18, 18}, {2, 2, 2})) {
  return chooseSize(M, SurfaceDistance(S));
}

}  // namespace

TEST_SUITE("3.2") {
  TEST_CASE("eq. (1): r^E is the longest edge of the undeformed element") {
    Mesh M = boxMesh({-1, 2, 5}, {1.5, 2, .7}, {2, 3, 2});
    Random random(1);
    for (int round = 0; round < 40; ++round)
      bisect(M, {static_cast<int>(random.between(0, double(M.tets.size())))});
    for (std::size_t E = 0; E < M.tets.size(); ++E) {
      const int e = static_cast<int>(E);
      const double literal = literalLongestEdge(M.x, M.tets[E]);
      CHECK(longestEdge(M, e) == doctest::Approx(literal).epsilon(1e-12));
      CHECK(isTooLarge(M, e, .8) == (longestEdge(M, e) >= .8));
    }
    const double before = longestEdge(M, 0);
    for (Vec3& p : M.x) p = 3 * p;  // [choice] measured on the cubes, whatever smoothing did
    CHECK(longestEdge(M, 0) == before);
  }

  TEST_CASE("eq. (1): an element with r^E = l_c is refined") {
    const Mesh M = shapes::kuhnCube();
    const double r = longestEdge(M, 0);
    CHECK(r == doctest::Approx(std::sqrt(3.)));
    CHECK(isTooLarge(M, 0, r));
    CHECK(isTooLarge(M, 0, std::nextafter(r, 0)));
    CHECK_FALSE(isTooLarge(M, 0, std::nextafter(r, 2)));
  }

  TEST_CASE("eq. (1): no tetrahedron that meets S has r^E >= l_c, and T covers S") {
    struct Try {
      Mesh M;
      TriangleSurface S;
      double lc;
    };
    const std::vector<Try> tries = {
        {boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), samples::sine(.1, 10), .2},
        {boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), sheetAt({.45, .5, .55}, .22), .2},
        {boxMesh({0, 0, 0}, {1, 1, 1}, {3, 1, 2}), samples::sine(.15, 10), .25},
        {bentBox(), samples::sine(.1, 10), .2}};
    for (std::size_t i = 0; i < tries.size(); ++i) {
      CAPTURE(i);
      Steps steps(tries[i].M, tries[i].S);
      const double volume = shapes::totalVolume(steps.M);
      steps.approximate(tries[i].lc);
      const Mesh& M = steps.M;
      const std::vector<char>& T = steps.A.T;
      REQUIRE(T.size() == M.tets.size());
      CHECK(shapes::conformityFault(M) == "");
      CHECK(shapes::countInverted(M) == 0);
      CHECK(shapes::totalVolume(M) == doctest::Approx(volume).epsilon(1e-13));
      CHECK(M.tets.size() > tries[i].M.tets.size());
      int uncovered = 0, outside = 0, large = 0;
      for (Vec3 p : sampled(tries[i].S, 2)) {
        const std::vector<int> at = holders(M, p);
        uncovered += at.empty();
        for (int E : at) {
          outside += !T[E];
          large +=
              literalLongestEdge(M.xi, M.tets[E]) * M.cube.x >= tries[i].lc && M.cube.x == M.cube.y;
          large += longestEdge(M, E) >= tries[i].lc;
        }
      }
      CHECK(uncovered == 0);
      CHECK(outside == 0);
      CHECK(large == 0);
      // every element of T meets S, and every other one is off it
      int wrong = 0, level = 0;
      for (std::size_t E = 0; E < M.tets.size(); ++E) {
        double nearest = 1e300;
        const Tetrahedron tet{M.x[M.tets[E][0]], M.x[M.tets[E][1]], M.x[M.tets[E][2]],
                              M.x[M.tets[E][3]]};
        if (!T[E] && E % 7 != 0) continue;  // of the others a sample
        for (const auto& t : tries[i].S.triangles) {
          const auto& p = tries[i].S.points;
          if (norm(p[t[0]] - tet[0]) > .35) continue;  // elements and triangles are far smaller
          nearest = std::min(nearest, separation(tet, {p[t[0]], p[t[1]], p[t[2]]}));
          if (nearest < 0) break;
        }
        wrong += T[E] ? nearest > 1e-8 : nearest < -1e-12;
        if (T[E]) level += M.level[E] < steps.A.level;
      }
      CHECK(wrong == 0);
      CHECK(level == 0);
      CHECK(steps.A.level % 3 == 0);
    }
  }

  TEST_CASE("eq. (1): a surface below the size of one tetrahedron is found") {
    for (Vec3 c : {Vec3{.31, .42, .53}, Vec3{.5, .5, .5}, Vec3{.25, .5, .5}}) {
      Steps steps(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), sheetAt(c, 1e-5));
      steps.approximate(.2);
      CHECK(std::count(steps.A.T.begin(), steps.A.T.end(), 1) >= 1);
      for (int E : holders(steps.M, c)) CHECK(steps.A.T[E]);
    }
  }

  TEST_CASE("intersects: agrees with the separating axes on random pairs") {
    Random random(2);
    int hits = 0, misses = 0, missed = 0, invented = 0;
    for (int round = 0; round < 20000; ++round) {
      const Tetrahedron tet = randomTetrahedron(random);
      const double size = round % 3 == 0 ? 3 : round % 3 == 1 ? 1 : .2;
      const Vec3 c = randomPoint(random);
      Triangle triangle;
      for (Vec3& p : triangle) p = c + size * randomPoint(random);
      if (round % 5 == 0) triangle[2] = triangle[1] + 1e-7 * randomPoint(random);  // a needle
      const double gap = separation(tet, triangle);
      const bool found = intersects(tet, triangle);
      if (gap <= 0) ++hits, missed += !found;
      if (gap > 1e-6) ++misses, invented += found;
    }
    CHECK(hits > 2000);
    CHECK(misses > 3000);
    CHECK(missed == 0);
    CHECK(invented == 0);
  }

  TEST_CASE("intersects: a triangle that touches a vertex, an edge or a face is never missed") {
    Random random(3);
    int missed = 0, mirrored = 0;
    for (int round = 0; round < 20000; ++round) {
      Tetrahedron tet = randomTetrahedron(random);
      // a point of the closed tetrahedron: a vertex, of an edge, of a face, or inside
      const Vec3 at = randomPointOf(tet, 1 + round % 4, random);
      Triangle triangle{randomPoint(random), randomPoint(random), randomPoint(random)};
      // held by the triangle at a vertex, on an edge, or inside
      const int held = round / 4 % 3;
      if (held == 0) triangle[0] = at;
      if (held == 1) triangle[1] = triangle[0] + random.between(1.2, 3) * (at - triangle[0]);
      if (held == 2) triangle[2] = at - (triangle[0] + triangle[1] - 2 * at);
      if (round % 7 == 0) triangle[2] = triangle[1] + 1e-9 * (triangle[2] - triangle[1]);
      if (round % 7 == 0 && held == 2) triangle[0] = at;
      missed += !intersects(tet, triangle);
      std::swap(tet[0], tet[1]);  // negative orientation: the same set
      mirrored += !intersects(tet, triangle);
    }
    CHECK(missed == 0);
    CHECK(mirrored == 0);
  }

  TEST_CASE("intersects: a face in common, a tetrahedron around or across the triangle") {
    const Tetrahedron tet{{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
    CHECK(intersects(tet, {tet[0], tet[1], tet[2]}));                      // its face
    CHECK(intersects(tet, {{{-5, -5, 0}, {5, -5, 0}, {0, 9, 0}}}));        // covers the face
    CHECK(intersects(tet, {{{-5, -5, .3}, {5, -5, .3}, {0, 9, .3}}}));     // cuts through
    CHECK(intersects(tet, {{{.1, .1, .1}, {.2, .1, .1}, {.1, .2, .2}}}));  // inside
    CHECK(intersects(tet, {{{1, 0, 0}, {2, 0, 0}, {2, 1, 0}}}));           // a vertex
    CHECK_FALSE(intersects(tet, {{{1.001, 0, 0}, {2, 0, 0}, {2, 1, 0}}}));
    CHECK_FALSE(intersects(tet, {{{-5, -5, -.001}, {5, -5, -.001}, {0, 9, -.001}}}));
    CHECK_FALSE(intersects(
        tet, {{{.34, .34, .34}, {2, .34, .34}, {.34, 2, .34}}}));  // beyond the skew face
  }

  TEST_CASE("limits: l_c must be above 0 and finite") {
    const double nan = std::numeric_limits<double>::quiet_NaN(),
                 infinite = std::numeric_limits<double>::infinity();
    for (double lc : {-1., nan, infinite, -infinite}) {
      CAPTURE(lc);
      const std::string text = refusal(samples::sine(.1, 8), lc);
      CHECK(has(text, "l_c"));
      CHECK(has(text, "above 0"));
    }
  }

  TEST_CASE(
      "limits: l_c must be below dist(dM, S); the message has both numbers and the triangle") {
    const TriangleSurface S = sheetAt({.5, .5, .3}, .2);  // .28 .. .32 in z: .28 from the bottom
    for (double lc : {.281, .5, 1e6}) {
      const std::string text = refusal(S, lc);
      CAPTURE(text);
      CHECK(has(text, "dist("));
      CHECK(has(text, "0.28"));
      CHECK(has(text, "triangle "));
      CHECK(has(text, "lower l_c"));
    }
    CHECK(has(refusal(S, .5), "l_c = 0.5 "));
    CHECK(has(refusal(sheetAt({.5, .5, .3}, 0.1), .29), "not below"));  // equal is not below
  }

  TEST_CASE("limits: S that touches, leaves or misses the domain is refused") {
    const struct {
      const char* what;
      TriangleSurface S;
    } tries[] = {{"touches a side", sheetAt({.8, .5, .5}, .2)},
                 {"leaves", sheetAt({.9, .5, .5}, .2)},
                 {"outside", sheetAt({3, .5, .5}, .2)},
                 {"outside, near", sheetAt({1.3, .5, .5}, .2)},
                 {"around", sheetAt({.5, .5, .5}, 4)},
                 {"below", sheetAt({.5, .5, -.5}, .2)}};
    for (const auto& t : tries) {
      CAPTURE(t.what);
      const std::string text = refusal(t.S, .05);
      CAPTURE(text);
      CHECK(has(text, "domain"));
    }
  }

  TEST_CASE("limits: a predicted size above maxTets is refused with the estimate") {
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
    InsertOptions options;
    options.lc = .12;
    options.maxTets = 500;
    std::string text = refusal(M, samples::sine(.1, 16), options);
    CAPTURE(text);
    CHECK(has(text, "500"));
    CHECK(has(text, "tetrahedra"));
    options.maxTets = InsertOptions().maxTets;
    for (double lc : {1e-4, 1e-9, 1e-300}) {
      options.lc = lc;
      CAPTURE(lc);
      text = refusal(M, samples::sine(.1, 16), options);
      CHECK(has(text, "l_c"));
      CHECK(has(text, "limit"));
    }
  }

  TEST_CASE("chooseSize: a square is limited by its extent, a twentieth of it") {
    const TriangleSurface S = sheetAt({0, 0, 0}, 1);
    const SizeChoice size = sizeOf(S);
    CHECK(has(size.feature, "extent"));
    CHECK(size.lc == doctest::Approx(shapes::diagonal(S) / 20));
    CHECK(size.measure == doctest::Approx(shapes::diagonal(S)));
    CHECK(size.resolving == size.lc);
    CHECK(size.finest >= size.lc / 8);  // or what about a million tetrahedra allow
    CHECK(size.finest <= size.lc / 4);
  }

  TEST_CASE(
      "chooseSize: two facing sheets get two cubes between them, the place is on one of them") {
    for (double distance : {.02, .04, .08}) {
      CAPTURE(distance);
      const TriangleSurface S = gutter(distance);
      const Width sheets = facingSheets(SurfaceDistance(S), .2);
      CHECK(sheets.distance == doctest::Approx(distance).epsilon(.01));
      CHECK(facingSheets(SurfaceDistance(S), .9 * distance).distance == 1e300);
      const SizeChoice size = sizeOf(S);
      CHECK(has(size.feature, "sheets"));
      CHECK(size.lc == doctest::Approx(std::sqrt(3.) * distance / 2).epsilon(.01));
      CHECK(std::abs(std::abs(size.place.x) - distance / 2) <= .05 * distance);
    }
  }

  TEST_CASE("chooseSize: a strip gets one and a half cubes across, a square none for its width") {
    for (double width : {.05, .08}) {
      CAPTURE(width);
      CHECK(rimWidth(SurfaceDistance(flatStrip(width)), .4).distance ==
            doctest::Approx(width).epsilon(.02));
      const SizeChoice size = sizeOf(flatStrip(width));
      CHECK(has(size.feature, "rim"));
      CHECK(size.lc == doctest::Approx(std::sqrt(3.) * width / 1.5).epsilon(.02));
      CHECK(std::abs(std::abs(size.place.y) - width / 2) <= 1e-12);
    }
    CHECK(rimWidth(SurfaceDistance(sheetAt({0, 0, 0}, 1)), .4).distance == 1e300);
    CHECK(rimWidth(SurfaceDistance(samples::raggedRim()), .2).distance > .1);  // noise is no width
  }

  TEST_CASE(
      "chooseSize: features too fine are not followed below 1/8, and the l_c that resolves them is "
      "told") {
    const SizeChoice strip = sizeOf(flatStrip(.002)), sheets = sizeOf(gutter(.002));
    CHECK(strip.lc == doctest::Approx(strip.finest));
    CHECK(strip.resolving == doctest::Approx(std::sqrt(3.) * .002 / 1.5).epsilon(.02));
    CHECK(sheets.lc == doctest::Approx(sheets.finest));
    CHECK(sheets.resolving < .5 * sheets.lc);
  }

  TEST_CASE(
      "chooseSize: near the boundary and near an earlier surface l_c stays below the distance") {
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {4, 4, 4});
    const SizeChoice low = sizeOf(sheetAt({.5, .5, .041}, .3), M);
    CHECK(has(low.feature, "boundary"));
    CHECK(low.measure == doctest::Approx(.011).epsilon(.001));
    CHECK(low.lc == doctest::Approx(std::sqrt(3.) * low.measure / 2.5));
    InsertOptions options;
    options.lc = .12;
    insertSurface(M, samples::named(sheetAt({.5, .5, .5}, .2), "first"), options);
    const SizeChoice near = sizeOf(sheetAt({.5, .5, .515}, .2), M);
    CHECK(has(near.feature, "'first'"));
    CHECK(near.lc < near.measure);
    CHECK(near.measure == doctest::Approx(.015).epsilon(.1));
  }
}
