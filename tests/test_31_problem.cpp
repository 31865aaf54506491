// SPDX-License-Identifier: MIT
// §3.1: what a surface must be, and the distance tools of §3.2 and §3.4.
#include <doctest/doctest.h>

#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "../meccano.hpp"
#include "../samples/surfaces.hpp"
#include "shapes.hpp"

using namespace meccano;

namespace {

/// The text of the InputError that checkSurface throws; empty if it throws none.
std::string refusal(const TriangleSurface& S) {
  std::vector<std::string> warnings;
  try {
    checkSurface(S, warnings);
  } catch (const InputError& error) {
    return error.what();
  }
  return "";
}

bool contains(const std::string& text, const std::string& part) {
  CAPTURE(text);
  CAPTURE(part);
  bool found = text.find(part) != std::string::npos;
  CHECK(found);
  return found;
}

/// A bent grid of n x m cells without symmetry, two triangles per cell, normals upwards.
TriangleSurface bentGrid(int n, int m) {
  TriangleSurface S;
  for (int j = 0; j <= m; ++j)
    for (int i = 0; i <= n; ++i) {
      double x = 1.1 * i / n, y = .9 * j / m;
      S.points.push_back({x, y, .3 * std::sin(2.5 * x + .4) * std::cos(1.7 * y)});
    }
  for (int j = 0; j < m; ++j)
    for (int i = 0; i < n; ++i) {
      int a = j * (n + 1) + i, b = a + 1, c = b + n + 1, d = a + n + 1;
      shapes::addCell(S, (i + j) % 2 == 0, a, b, c, d);
    }
  return S;
}

/// A ring of n quadrilaterals, its ends joined with a half turn (Möbius) or without (annulus).
TriangleSurface band(int n, bool halfTurn) {
  TriangleSurface S;
  for (int i = 0; i < n; ++i) {
    double t = 2 * 3.14159265358979 * i / n, tilt = halfTurn ? t / 2 : .3;
    for (int side : {-1, 1}) {
      double r = 1 + .3 * side * std::cos(tilt);
      S.points.push_back({r * std::cos(t), r * std::sin(t), .3 * side * std::sin(tilt)});
    }
  }
  for (int i = 0; i < n; ++i) {
    int a = 2 * i, b = a + 1, c = 2 * ((i + 1) % n), d = c + 1;
    if (halfTurn && i == n - 1) std::swap(c, d);
    S.triangles.push_back({a, b, c});
    S.triangles.push_back({b, d, c});
  }
  return S;
}

/// A torus of n x m quadrilaterals, with the last one cut out: one rim, one handle.
TriangleSurface cutTorus(int n, int m) {
  TriangleSurface S;
  for (int j = 0; j < m; ++j)
    for (int i = 0; i < n; ++i) {
      double s = 6.283185307 * i / n, t = 6.283185307 * j / m, r = 2 + .7 * std::cos(t);
      S.points.push_back({r * std::cos(s), r * std::sin(s), .7 * std::sin(t)});
    }
  for (int j = 0; j < m; ++j)
    for (int i = 0; i < n; ++i) {
      if (i == n - 1 && j == m - 1) continue;
      int a = j * n + i, b = j * n + (i + 1) % n, d = (j + 1) % m * n + i;
      int c = (j + 1) % m * n + (i + 1) % n;
      S.triangles.push_back({a, b, c});
      S.triangles.push_back({a, c, d});
    }
  return S;
}

TriangleSurface tetrahedronHull() {
  return {{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}},
          {{0, 2, 1}, {0, 1, 3}, {1, 2, 3}, {0, 3, 2}}};
}

/// Points in and around the unit box, the same in every run.
std::vector<Vec3> scatteredPoints(int count) {
  std::vector<Vec3> points;
  unsigned state = 7;
  auto next = [&] {
    state = state * 1664525u + 1013904223u;
    return 2 * ((state >> 8) / double(1 << 24)) - .5;
  };
  for (int i = 0; i < count; ++i) {
    double x = next(), y = next();
    points.push_back({x, y, next()});
  }
  return points;
}

/// Distance to a triangle by ternary search over its barycentric coordinates: slow, needs no cases.
double searchedDistance(Vec3 x, Vec3 a, Vec3 b, Vec3 c) {
  auto along = [&](double s) {
    Vec3 p = a + s * (b - a), q = a + s * (c - a);
    double lo = 0, hi = 1;
    for (int i = 0; i < 100; ++i) {
      double t1 = lo + (hi - lo) / 3, t2 = hi - (hi - lo) / 3;
      if (norm(x - (p + t1 * (q - p))) < norm(x - (p + t2 * (q - p))))
        hi = t2;
      else
        lo = t1;
    }
    return norm(x - (p + lo * (q - p)));
  };
  double lo = 0, hi = 1;
  for (int i = 0; i < 100; ++i) {
    double s1 = lo + (hi - lo) / 3, s2 = hi - (hi - lo) / 3;
    if (along(s1) < along(s2))
      hi = s2;
    else
      lo = s1;
  }
  return along(lo);
}

}  // namespace

TEST_SUITE("3.1") {
  TEST_CASE("a disk passes unchanged and without warnings") {
    TriangleSurface S = bentGrid(4, 3);
    S.name = "bent";
    std::vector<std::string> warnings;
    TriangleSurface C = checkSurface(S, warnings);
    CHECK(warnings.empty());
    CHECK(C.name == "bent");
    CHECK(C.points.size() == S.points.size());
    CHECK(C.triangles == S.triangles);
  }

  TEST_CASE("coincident points are welded, so a triangle soup is a disk") {
    TriangleSurface S = bentGrid(4, 3), soup;
    for (const std::array<int, 3>& t : S.triangles) {
      int n = static_cast<int>(soup.points.size());
      for (int i : t) soup.points.push_back(S.points[i]);
      soup.triangles.push_back({n, n + 1, n + 2});
    }
    std::vector<std::string> warnings;
    TriangleSurface C = checkSurface(soup, warnings);
    CHECK(C.points.size() == S.points.size());
    CHECK(C.triangles.size() == S.triangles.size());
    CHECK(warnings.empty());
  }

  TEST_CASE("minus zero and zero are one point") {
    TriangleSurface S{{{0., 0, 0}, {1, 0, 0}, {0, 1, 0}, {-0., 0, 0}, {-1, .5, 0}},
                      {{0, 1, 2}, {3, 2, 4}}};
    std::vector<std::string> warnings;
    CHECK(checkSurface(S, warnings).points.size() == 4);
  }

  TEST_CASE("duplicate and zero-area triangles and unused points are dropped and counted") {
    TriangleSurface S = bentGrid(4, 3);
    S.triangles.push_back(S.triangles[5]);
    S.triangles.push_back({S.triangles[2][1], S.triangles[2][0], S.triangles[2][2]});
    S.triangles.push_back({0, 1, 1});
    S.points.push_back({9, 9, 9});
    std::vector<std::string> warnings;
    TriangleSurface C = checkSurface(S, warnings);
    CHECK(C.triangles.size() == S.triangles.size() - 3);
    CHECK(C.points.size() == S.points.size() - 1);
    REQUIRE(warnings.size() == 1);
    contains(warnings[0], "2 duplicate triangles, 1 zero-area triangle and 1 unused point");
  }

  TEST_CASE("triangles that disagree are turned, the minority of them") {
    TriangleSurface S = bentGrid(4, 3), mixed = S;
    for (int t : {0, 7, 8}) std::swap(mixed.triangles[t][0], mixed.triangles[t][1]);
    std::vector<std::string> warnings;
    TriangleSurface C = checkSurface(mixed, warnings);
    REQUIRE(warnings.size() == 1);
    contains(warnings[0], "turned 3 triangles");
    for (const std::array<int, 3>& t : C.triangles)
      CHECK(cross(C.points[t[1]] - C.points[t[0]], C.points[t[2]] - C.points[t[0]]).z > 0);
  }

  TEST_CASE("refused: empty, or nothing but zero areas") {
    contains(refusal({}), "insertSurface (§3.1): the surface is empty; give at least one triangle");
    contains(refusal({{{0, 0, 0}, {1, 1, 1}, {2, 2, 2}}, {{0, 1, 2}}}),
             "all its 1 triangles have zero area");
  }

  TEST_CASE("refused: an index out of range") {
    TriangleSurface S = bentGrid(2, 2);
    S.triangles[3][1] = 9;
    contains(refusal(S), "triangle 3 names point 9, but there are 9 points");
    S.triangles[3][1] = -1;
    contains(refusal(S), "triangle 3 names point -1");
  }

  TEST_CASE("refused: a coordinate that is not finite") {
    for (double bad :
         {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
      TriangleSurface S = bentGrid(2, 2);
      S.points[4].y = bad;
      contains(refusal(S), "point 4 has the coordinates");
    }
  }

  TEST_CASE("refused: a non-manifold edge, with its three triangles") {
    TriangleSurface S = bentGrid(2, 2);
    S.points.push_back({.5, .5, 2});
    S.triangles.push_back({0, 4, 9});
    std::string text = refusal(S);
    contains(text, "is non-manifold: triangles 0, 1 and 8 share it");
    contains(text, "the edge from (0, 0, ");
  }

  TEST_CASE("refused: a non-manifold vertex") {
    TriangleSurface S{{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {-1, 0, 0}, {0, -1, 0}},
                      {{0, 1, 2}, {0, 3, 4}}};
    contains(refusal(S), "the point (0, 0, 0) is non-manifold: triangles 0 and 1 meet only there");
  }

  TEST_CASE("refused: several components") {
    TriangleSurface S = bentGrid(2, 2);
    for (Vec3 p : {Vec3{5, 0, 0}, Vec3{6, 0, 0}, Vec3{5, 1, 0}}) S.points.push_back(p);
    S.triangles.push_back({9, 10, 11});
    contains(refusal(S), "2 components (the largest of 8, the smallest of 1 triangles)");
  }

  TEST_CASE("refused: closed") {
    contains(refusal(tetrahedronHull()), "the surface is closed (4 triangles, no rim)");
  }

  TEST_CASE("refused: holes") {
    TriangleSurface S = bentGrid(6, 6);
    S.triangles.erase(S.triangles.begin() + 28);
    contains(refusal(S), "the surface has holes: 2 rims, the shortest of 3 edges at (");
    contains(refusal(band(9, false)), "2 rims");
  }

  TEST_CASE("refused: not orientable") {
    contains(refusal(band(9, true)), "not orientable (a Moebius band)");
  }

  TEST_CASE("refused: a handle") {
    contains(refusal(cutTorus(7, 5)), "1 handle (Euler characteristic -1, a disk has 1)");
  }

  TEST_CASE("rimLoops: one loop with S on its left") {
    TriangleSurface S = bentGrid(4, 3);
    std::vector<std::vector<int>> rims = rimLoops(S);
    REQUIRE(rims.size() == 1);
    CHECK(rims[0].size() == 14);
    double area = 0;  // of the shadow on z = 0
    for (size_t i = 0; i < rims[0].size(); ++i)
      area += .5 * cross(S.points[rims[0][i]], S.points[rims[0][(i + 1) % rims[0].size()]]).z;
    CHECK(area == doctest::Approx(1.1 * .9));
  }
}

TEST_SUITE("3.2") {
  TEST_CASE("the nearest point of the tree is that of brute force, among needles too") {
    TriangleSurface S = bentGrid(9, 7);
    const size_t triangles = S.triangles.size();
    double apart = 1e-3;  // of the needles' third corner from the line of the two others
    for (size_t i = 0; i < triangles; i += 2, apart = apart < 1e-14 ? 1e-3 : .1 * apart) {
      const std::array<int, 3> t = S.triangles[i];
      const Vec3 a = S.points[t[0]], b = S.points[t[1]], c = S.points[t[2]];
      S.triangles[i] = {t[0], t[1], static_cast<int>(S.points.size())};
      S.points.push_back(.4 * a + .6 * b + apart * (c - a));
      S.triangles.push_back({t[1], t[2], S.triangles[i][2]});
      S.triangles.push_back({t[2], t[0], S.triangles[i][2]});
    }
    TriangleTree tree(S.points, S.triangles);
    std::vector<Vec3> places = scatteredPoints(300);
    for (const std::array<int, 3>& t : S.triangles) {  // on and just off S as well
      const std::array<Vec3, 3> x{S.points[t[0]], S.points[t[1]], S.points[t[2]]};
      const Vec3 inside = .5 * x[0] + .2 * x[1] + .3 * x[2];
      for (double off : {0., 1e-9, 1e-4})
        for (Vec3 p : {x[0], .5 * (x[1] + x[2]), inside}) places.push_back(p + Vec3{0, 0, off});
    }
    for (Vec3 x : places) {
      double least = 1e9;
      for (const std::array<int, 3>& t : S.triangles)
        least = std::min(
            least,
            closestPointOnTriangle(x, S.points[t[0]], S.points[t[1]], S.points[t[2]]).distance);
      ClosestPoint p = tree.closest(x);
      CHECK(p.distance == least);
      const std::array<int, 3>& t = S.triangles[p.triangle];
      Vec3 fromWeights =
          p.w[0] * S.points[t[0]] + p.w[1] * S.points[t[1]] + p.w[2] * S.points[t[2]];
      CHECK(norm(fromWeights - p.point) < 1e-14);
      if (least > 0) CHECK(tree.closest(x, .5 * least).triangle == -1);
    }
  }

  TEST_CASE("a tree's triangle tells whether a point is within a distance, needles too") {
    const std::vector<Vec3> random = scatteredPoints(400);
    for (double width : {1., 1e-2, 1e-5, 1e-9, 0.})
      for (std::size_t i = 0; i + 3 < random.size(); ++i) {
        const Vec3 a = random[i], b = random[i + 1], c = b + width * (random[i + 2] - b);
        const TriangleTree tree({a, b, c}, {{0, 1, 2}});
        const Vec3 x = random[i + 3];
        const double distance = closestPointOnTriangle(x, a, b, c).distance;
        CHECK(tree.triangles[0].isWithin(x, distance * (1 + 1e-6)));
        CHECK(!tree.triangles[0].isWithin(x, distance * (1 - 1e-6)));
      }
  }

  TEST_CASE("the nearer one of two needles") {  // of whose normals few digits are right
    const std::vector<Vec3> random = scatteredPoints(300);
    for (double width : {1e-3, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-12})
      for (double height : {.1, 10 * width, width, .1 * width})
        for (double gap : {1e-2, 1e-3, 1e-8})
          for (std::size_t i = 0; i < random.size(); i += 3) {
            const Vec3 a = random[i], along = random[i + 1], across = width * random[i + 2];
            const Vec3 n = cross(along, random[i + 2]), up = (height / norm(n)) * n;
            const Vec3 x = a + .7 * along + .3 * across + up;  // above the first one
            std::vector<Vec3> points{a, a + along, a + .6 * along + across};
            for (int k = 0; k < 3; ++k) points.push_back(points[k] + (2 + gap) * up);
            const int first = static_cast<int>(i) % 2 * 3, turn = static_cast<int>(i / 3) % 3;
            const TriangleTree tree(points,
                                    {{first + turn, first + (turn + 1) % 3, first + (turn + 2) % 3},
                                     {3 - first, 4 - first, 5 - first}});
            double least = 1e9;
            for (const TreeTriangle& t : tree.triangles) {
              const std::array<Vec3, 3>& c = t.corners;
              least = std::min(least, closestPointOnTriangle(x, c[0], c[1], c[2]).distance);
            }
            CHECK(tree.closest(x).distance == least);
          }
  }

  TEST_CASE("of equally near triangles the lowest one, far from the origin too") {
    const std::vector<Vec3> random = scatteredPoints(400);
    for (double width : {1., 1e-2, 1e-4})
      for (double apart : {1e-9, 1e-8, 1e-7})
        for (std::size_t i = 0; i + 4 < random.size(); i += 4) {
          // some 10 m large; rounding tells the copies apart or not
          const Vec3 a = Vec3{4e6, 2.8e6, 1.2e6} + 10 * random[i];
          const Vec3 along = 10 * random[i + 1], across = width * random[i + 2];
          std::vector<Vec3> points;
          std::vector<std::array<int, 3>> triangles;
          for (int k = 0; k < 6; ++k) {
            for (const Vec3& p : {a, a + along, a + .5 * along + across})
              points.push_back(p + ((5 - k) * apart) * random[i + 3]);
            triangles.push_back({3 * k, 3 * k + 1, 3 * k + 2});
          }
          const TriangleTree tree(points, triangles);
          for (const std::array<int, 3>& t : triangles) {
            const Vec3 x = .5 * points[t[0]] + .3 * points[t[1]] + .2 * points[t[2]];
            ClosestPoint least{1e300, x, -1, {0, 0, 0}, Feature::face, 0};
            for (int k = 0; k < 6; ++k) {
              const ClosestPoint p =
                  closestPointOnTriangle(x, points[3 * k], points[3 * k + 1], points[3 * k + 2]);
              if (p.distance < least.distance) least = p, least.triangle = k;
            }
            CHECK(tree.closest(x).distance == least.distance);
            CHECK(tree.closest(x).triangle == least.triangle);
          }
        }
  }

  TEST_CASE("the nearest point of a triangle is that of a search, for needles too") {
    for (double height : {.7, 1e-3, 1e-9}) {
      CAPTURE(height);
      Vec3 a{.1, .2, .3}, b{1.2, .1, .4}, c = .4 * a + .6 * b + Vec3{0, height, 0};
      for (Vec3 x : scatteredPoints(10))
        CHECK(closestPointOnTriangle(x, a, b, c).distance ==
              doctest::Approx(searchedDistance(x, a, b, c)).epsilon(1e-9));
    }
  }

  TEST_CASE("visit finds every triangle whose box meets a box, and stops when told") {
    TriangleSurface S = bentGrid(9, 7);
    TriangleTree tree(S.points, S.triangles);
    Vec3 lo{.3, .2, -1}, hi{.5, .6, 1};
    std::vector<int> found, expected;
    tree.visit(lo, hi, [&](int t) {
      found.push_back(t);
      return false;
    });
    std::sort(found.begin(), found.end());
    for (int t = 0; t < static_cast<int>(S.triangles.size()); ++t) {
      TriangleTree::Box box{{1e9, 1e9, 1e9}, {-1e9, -1e9, -1e9}};
      for (int n : S.triangles[t]) {
        Vec3 p = S.points[n];
        box.lo = {std::min(box.lo.x, p.x), std::min(box.lo.y, p.y), std::min(box.lo.z, p.z)};
        box.hi = {std::max(box.hi.x, p.x), std::max(box.hi.y, p.y), std::max(box.hi.z, p.z)};
      }
      if (boxesMeet(box, lo, hi)) expected.push_back(t);
    }
    CHECK(found == expected);
    int visited = 0;
    tree.visit(lo, hi, [&](int) { return ++visited == 3; });
    CHECK(visited == 3);
  }

  TEST_CASE("dist(dM, S): smallestGap of two triangle sets") {
    TriangleSurface S = bentGrid(9, 7);
    TriangleTree tree(S.points, S.triangles);
    TriangleSurface above = S;
    for (Vec3& p : above.points) p = {p.x, p.y, p.z + 5};
    above.points[17].z =
        S.points[17].z + .25;  // the tip of a spike, nearest to S's vertex 17 or a face beside it
    Gap gap = smallestGap(tree, above.points, above.triangles);
    CHECK(gap.distance <= .25);
    CHECK(gap.distance == doctest::Approx(tree.closest(above.points[17]).distance).epsilon(1e-12));
    CHECK(tree.triangles.size() == S.triangles.size());
    CHECK(gap.triangle >= 0);
    CHECK(gap.other >= 0);
  }

  TEST_CASE("smallestGap of crossing edges, and 0 where a triangle pierces another") {
    TriangleTree tree({{-1, 0, 0}, {1, 0, 0}, {0, -1, -2}}, {{0, 1, 2}});
    CHECK(smallestGap(tree, {{0, -1, .5}, {0, 1, .5}, {0, 0, 3}}, {{0, 1, 2}}).distance ==
          doctest::Approx(.5));
    CHECK(smallestGap(tree, {{0, -5, -1}, {0, 5, -1}, {0, 1, 3}}, {{0, 1, 2}}).distance == 0);
  }

  TEST_CASE("Hausdorff distance is the largest of all samples, though few are searched for") {
    const TriangleSurface A = bentGrid(9, 7), B = bentGrid(23, 17);
    const TriangleTree treeA(A.points, A.triangles), treeB(B.points, B.triangles);
    constexpr int m = 4;
    double largest = 0;
    for (const auto& [from, to] : {std::make_pair(&treeA, &treeB), std::make_pair(&treeB, &treeA)})
      for (const TreeTriangle& t : from->triangles)
        for (int i = 0; i <= m; ++i)
          for (int j = 0; i + j <= m; ++j) {
            const std::array<Vec3, 3>& c = t.corners;
            const Vec3 p =
                (1. / m) * (double(m - i - j) * c[0] + double(i) * c[1] + double(j) * c[2]);
            largest = std::max(largest, to->closest(p).distance);
          }
    CHECK(largest > 1e-3);
    CHECK(hausdorffDistance(treeA, treeB, m) == doctest::Approx(largest).epsilon(1e-12));
  }

  TEST_CASE("Hausdorff distance is two-sided") {
    TriangleTree small({{0, 0, 0}, {1, 0, 0}, {0, 1, 0}}, {{0, 1, 2}});
    TriangleTree large({{0, 0, .5}, {3, 0, .5}, {0, 3, .5}}, {{0, 1, 2}});
    CHECK(hausdorffDistance(small, small, 4) == 0);
    CHECK(hausdorffDistance(small, large, 4) == doctest::Approx(std::sqrt(4 + .25)));
    CHECK(hausdorffDistance(large, small, 4) == hausdorffDistance(small, large, 4));
    const Width place = farthestPoint(small, large, 4);
    CHECK(place.distance == hausdorffDistance(small, large, 4));
    CHECK(std::min(std::abs(small.closest(place.place).distance - place.distance),
                   std::abs(large.closest(place.place).distance - place.distance)) < 1e-12);
    CHECK_THROWS_AS(hausdorffDistance(small, large, 0), InputError);
    CHECK_THROWS_AS(hausdorffDistance(small, large, 4, 0), InputError);
    // a large triangle over a small bump: found where the lattice is finer than it
    const TriangleTree flat({{-9, -9, 0}, {9, -9, 0}, {0, 9, 0}}, {{0, 1, 2}});
    const std::vector<Vec3> bumped{{-9, -9, 0}, {9, -9, 0}, {0, 9, 0}, {.1, .2, 1}};
    const TriangleTree bump(bumped, {{0, 1, 3}, {1, 2, 3}, {2, 0, 3}});
    CHECK(hausdorffDistance(flat, bump, 1, .1) > .9 * hausdorffDistance(bump, flat, 1, .1));
  }
}

TEST_SUITE("3.1") {
  TEST_CASE(
      "selfCrossings: none on embedded surfaces, pairs and place where a strip passes through "
      "itself") {
    for (const TriangleSurface& S :
         {samples::sine(.2, 24), samples::helicoid(.5), samples::raggedRim(), samples::disc()})
      CHECK(selfCrossings(S).empty());
    // a loop like the letter alpha: its ends cross on the line x = 0, z = 1
    const TriangleSurface alpha = samples::sheet(41, 4, [](double s, double t) {
      const double a = 1.5 * s;
      return Vec3{a * (a * a - 1), t, a * a};
    });
    const std::vector<Crossing> crossings = selfCrossings(alpha);
    CHECK(crossings.size() >= 4);
    for (const Crossing& c : crossings) {
      CHECK(c.triangle < c.other);
      CHECK(std::abs(c.point.x) <= .02);
      CHECK(c.point.z == doctest::Approx(1).epsilon(.02));
    }
    // at one l_c, with the place; the mesh stays as it was
    TriangleSurface loop = alpha;
    for (Vec3& p : loop.points) p = {.5 + .1 * p.x, .35 + .15 * p.y, .2 + .25 * p.z};
    const Mesh before = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
    Mesh M = before;
    InsertOptions options;
    options.lc = .1;
    try {
      insertSurface(M, loop, options);
      FAIL("a surface through itself was inserted");
    } catch (const MethodError& error) {
      const std::string text = error.what();
      CHECK(text.find("crosses or touches itself") != std::string::npos);
      CHECK(text.find("mend S there") != std::string::npos);
      CHECK(text.find("nor down to") == std::string::npos);
      CHECK(shapes::sameMesh(M, before));
    }
    // two triangles with a common point, one edge through the other
    CHECK(selfCrossings(
              {{{0, 0, 0}, {2, 0, 0}, {0, 2, 0}, {1, .5, -1}, {.5, 1, 1}}, {{0, 1, 2}, {0, 3, 4}}})
              .size() == 1);
    CHECK(selfCrossings({{{0, 0, 0}, {2, 0, 0}, {0, 2, 0}, {-1, -.5, -1}, {-.5, -1, 1}},
                         {{0, 1, 2}, {0, 3, 4}}})
              .empty());
  }
}

TEST_SUITE("3.4") {
  TEST_CASE("side: the sign of the shift, on faces, edges and vertices of a sharply bent surface") {
    // A roof: ridge and vertices would get the wrong side from the normal of any one triangle.
    TriangleSurface S{{{0, 0, 0}, {2, 0, 0}, {2, .2, 2}, {0, .2, 2}, {2, .4, 0}, {0, .4, 0}},
                      {{0, 1, 2}, {0, 2, 3}, {3, 2, 4}, {3, 4, 5}}};
    SurfaceDistance D(S);
    auto outside = [&](Vec3 x) { return D.query(x).side > 0; };
    for (double x : {.3, 1., 1.9}) {
      CHECK(outside({x, .2, 2.3}));
      CHECK(outside({x, -.2, 2.05}));
      CHECK(outside({x, .6, 2.05}));
      CHECK_FALSE(outside({x, .2, 1.5}));
      CHECK(std::fabs(D.query({x, .2, 2.3}).side) == doctest::Approx(.3));
      CHECK_FALSE(D.query({x, .2, 2.3}).onRim);
    }
  }

  TEST_CASE("beyond the rim the surface goes on tangentially") {
    TriangleSurface S{{{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}}, {{0, 1, 2}, {0, 2, 3}}};
    SurfaceDistance D(S);
    SurfaceQuery beside = D.query({1.5, .4, .25}), beyondCorner = D.query({-3, -4, -.5});
    CHECK(beside.onRim);
    CHECK(beside.side == doctest::Approx(.25));
    CHECK(beside.excess == doctest::Approx(.5));
    CHECK(beyondCorner.side == doctest::Approx(-.5));
    CHECK(beyondCorner.excess == doctest::Approx(5));
    SurfaceQuery above = D.query({.5, .25, .125});
    CHECK_FALSE(above.onRim);
    CHECK(above.excess == 0);
    CHECK(D.rimDistance({.5, .25, 0}) == doctest::Approx(.25));
    CHECK(D.rimDistance({.5, .5, 2}) == doctest::Approx(std::sqrt(4.25)));
  }

  TEST_CASE("SurfaceDistance refuses what has not one rim") {
    CHECK_THROWS_AS(SurfaceDistance{tetrahedronHull()}, InputError);
  }
}
