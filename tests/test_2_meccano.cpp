// SPDX-License-Identifier: MIT
// Section 2: solids, meccanos and the boundary mapping of Algorithm 1.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "../meccano.hpp"
#include "shapes.hpp"
#include "solids.hpp"

using namespace meccano;

namespace {

TriangleSurface checked(const TriangleSurface& S) {
  std::vector<std::string> warnings;
  return checkSolid(S, warnings);
}

struct MappedSolid {
  std::string name;
  TriangleSurface D;
  Meccano C;
};

/// Small solids of each kind: boxes found automatically, polycubes with rough corners.
std::vector<MappedSolid> mappedSolids() {
  std::vector<MappedSolid> all{
      {"sphere", solids::sphere(10), {}},
      {"ellipsoid", solids::ellipsoid(8, {1, 2, 4}), {}},
      {"blob", solids::blob(10), {}},
  };
  for (MappedSolid& s : all) s.C = getMeccano(s.D);
  all.push_back({"L of three cubes", solids::polycube(solids::ell(), 6, solids::warped),
                 solids::placed(solids::ell(), solids::roughly)});
  all.push_back(
      {"torus", solids::torus(1, .4, 14), solids::placed(solids::ring(), solids::aroundTorus)});
  all.push_back({"two handles", solids::polycube(solids::twoHandles(), 4, solids::warped),
                 solids::placed(solids::twoHandles(), solids::roughly)});
  return all;
}

double areaOf(const std::vector<Vec3>& x, const std::vector<std::array<int, 3>>& triangles) {
  double area = 0;
  for (const auto& t : triangles) area += .5 * norm(cross(x[t[1]] - x[t[0]], x[t[2]] - x[t[0]]));
  return area;
}

double areaInU(const Parametrization& P) {
  double area = 0;
  for (const auto& t : P.triangles)
    area += .5 * cross(P.u[t[1]] - P.u[t[0]], P.u[t[2]] - P.u[t[0]]);
  return area;
}

int eulerOf(const std::vector<std::array<int, 3>>& triangles) {
  std::set<int> points;
  std::set<std::pair<int, int>> edges;
  for (const auto& t : triangles)
    for (int i = 0; i < 3; ++i) {
      points.insert(t[i]);
      edges.insert(std::minmax(t[i], t[(i + 1) % 3]));
    }
  return int(points.size()) - int(edges.size()) + int(triangles.size());
}

/// Unit squares of the meccano's boundary with this normal in this plane.
int squaresIn(const Meccano& C, const BoundaryMapping::Rectangle& R) {
  const std::set<solids::Cube> cubes(C.cubes.begin(), C.cubes.end());
  int count = 0;
  for (solids::Cube c : cubes) {
    solids::Cube beside = c;
    beside[R.axis] += R.side ? 1 : -1;
    count += !cubes.count(beside) && c[R.axis] + R.side == R.lo[R.axis];
  }
  return count;
}

Vec2 uAlong(const Curve& C, int side, std::size_t k, double t) {
  const std::vector<Vec2>& u = C.sides[side].u;
  return u[k] + t * (u[k + 1] - u[k]);
}

std::string messageOf(const std::function<void()>& run) {
  try {
    run();
  } catch (const Error& e) {
    return e.what();
  }
  return "";
}
bool has(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

}  // namespace

TEST_SUITE("2") {
  TEST_CASE("Algorithm 1: Pi of a box's own surface is the identity") {
    for (const std::array<int, 3>& n :
         {std::array<int, 3>{1, 1, 1}, std::array<int, 3>{1, 2, 3}, std::array<int, 3>{4, 1, 2}}) {
      CAPTURE(n[0]);
      const TriangleSurface D =
          solids::polycube(solids::box(n[0], n[1], n[2]), 4, [](Vec3 p) { return p; });
      const Meccano C = getMeccano(D);
      CHECK(C.cubes == solids::box(n[0], n[1], n[2]));
      CHECK(C.cube == Vec3{1, 1, 1});
      const BoundaryMapping Pi = getBoundaryMapping(C, D);
      const Mesh M = getInitialMesh(C, Pi);
      const Mesh box = boxMesh({0, 0, 0}, {double(n[0]), double(n[1]), double(n[2])}, n);
      CHECK(M.tets == box.tets);
      CHECK(M.faceLabel == box.faceLabel);
      CHECK(M.type == box.type);
      CHECK(M.dimension == box.dimension);
      CHECK(M.entity == box.entity);
      REQUIRE(M.x.size() == box.x.size());
      for (std::size_t i = 0; i < M.x.size(); ++i) {
        CHECK(M.xi[i] == box.xi[i]);
        CHECK(norm(M.x[i] - box.x[i]) < 1e-9);
        CHECK(std::hypot(M.parameter[i].x - box.parameter[i].x,
                         M.parameter[i].y - box.parameter[i].y) < 1e-9);
      }
      for (std::size_t p = 0; p < Pi.patches.size(); ++p) {
        CHECK(Pi.patches[p].name == box.patches[p].name);
        for (std::size_t i = 0; i < Pi.patches[p].u.size(); ++i)
          CHECK(norm(varphi(box.patches[p], Pi.patches[p].u[i]) - Pi.patches[p].points[i]) < 1e-9);
      }
    }
  }

  TEST_CASE(
      "Algorithm 1: Pi is bijective and covers the solid, patches are what the meccano says") {
    for (const MappedSolid& s : mappedSolids()) {
      CAPTURE(s.name);
      const BoundaryMapping Pi = getBoundaryMapping(s.C, s.D);
      double area = 0;
      int euler = 0;
      for (std::size_t p = 0; p < Pi.patches.size(); ++p) {
        const Parametrization& P = Pi.patches[p];
        const BoundaryMapping::Rectangle& R = Pi.rectangles[p];
        CHECK(flippedTriangles(P.triangles, P.u).empty());
        const int u = (R.axis + 1) % 3, v = (R.axis + 2) % 3;
        const double squares = (R.hi[u] - R.lo[u]) * (R.hi[v] - R.lo[v]) * areaInU(P);
        int samePlane = 0;
        for (const BoundaryMapping::Rectangle& other : Pi.rectangles)
          samePlane +=
              other.axis == R.axis && other.side == R.side && other.lo[R.axis] == R.lo[R.axis];
        if (samePlane == 1) CHECK(squares == doctest::Approx(squaresIn(s.C, R)));
        CHECK(squares == doctest::Approx(std::round(squares)));
        area += areaOf(P.points, P.triangles);
        const int chi = eulerOf(P.triangles);
        if (s.name != "torus" && s.name != "two handles") CHECK(chi == 1);
        if (squares > .999 * (R.hi[u] - R.lo[u]) * (R.hi[v] - R.lo[v])) CHECK(chi == 1);
        euler += chi;
      }
      CHECK(area == doctest::Approx(areaOf(s.D.points, s.D.triangles)));
      CHECK(euler - int(Pi.curves.size()) + int(Pi.corners.size()) == 2 - 2 * genusOf(s.D));
    }
  }

  TEST_CASE("the patches of a box meet as its sides do") {
    const TriangleSurface D = solids::blob(10);
    const BoundaryMapping Pi = getBoundaryMapping(getMeccano(D), D);
    CHECK(Pi.patches.size() == 6);
    CHECK(Pi.curves.size() == 12);
    CHECK(Pi.corners.size() == 8);
    std::set<std::pair<int, int>> meet;
    for (const Curve& C : Pi.curves) {
      REQUIRE(C.sides.size() == 2);
      meet.insert(std::minmax(-C.sides[0].surface, -C.sides[1].surface));
    }
    for (int p = 1; p <= 6; ++p)
      for (int q = p + 1; q <= 6; ++q) CHECK(meet.count({p, q}) == ((p - 1) / 2 != (q - 1) / 2));
    for (const Corner& corner : Pi.corners) {
      std::set<int> patches;
      for (const Corner::Place& place : corner.on) {
        const Curve& C = Pi.curves[place.curve - 1];
        CHECK(norm(gamma(C, place.s) - corner.x) == 0);
        for (const Curve::Side& side : C.sides) patches.insert((-side.surface - 1) / 2);
      }
      CHECK(corner.on.size() == 3);
      CHECK(patches.size() == 3);
    }
  }

  TEST_CASE("curves agree with the patches beside them, at points and between") {
    for (const MappedSolid& s : mappedSolids()) {
      CAPTURE(s.name);
      const BoundaryMapping Pi = getBoundaryMapping(s.C, s.D);
      const double unit = shapes::diagonal(s.D);
      double worst = 0, lowest = 1;
      for (const Curve& C : Pi.curves)
        for (std::size_t k = 0; k + 1 < C.points.size(); ++k)
          for (double t : {0., .37, 1.}) {
            const Vec3 x = gamma(C, C.s[k] + t * (C.s[k + 1] - C.s[k]));
            for (int side = 0; side < 2; ++side) {
              const Parametrization& P = Pi.patches[-C.sides[side].surface - 1];
              worst = std::max(worst, norm(varphi(P, uAlong(C, side, k, t)) - x) / unit);
              lowest = std::min(lowest, norm(uAlong(C, side, k, 1) - uAlong(C, side, k, 0)));
            }
          }
      CHECK(worst < 1e-9);
      CHECK(lowest > 0);
    }
  }

  TEST_CASE("Pi of the meccano's boundary lies on the solid, the same seen from both patches") {
    for (const MappedSolid& s : mappedSolids()) {
      CAPTURE(s.name);
      const BoundaryMapping Pi = getBoundaryMapping(s.C, s.D);
      const TriangleTree tree(s.D.points, s.D.triangles);
      const double unit = shapes::diagonal(s.D);
      double worst = 0;
      for (const BoundaryMapping::Rectangle& R : Pi.rectangles)
        for (int i = 0; i < 20; ++i) {
          Vec3 xi{double(R.lo[0]), double(R.lo[1]), double(R.lo[2])};
          double* c[3] = {&xi.x, &xi.y, &xi.z};
          const int u = (R.axis + 1) % 3, v = (R.axis + 2) % 3;
          *c[u] += (i % 5 + .25) / 5 * (R.hi[u] - R.lo[u]);
          *c[v] += (i / 5 + .5) / 4 * (R.hi[v] - R.lo[v]);
          const int inHole = messageOf([&] { boundaryPoint(Pi, xi); }).size() > 0;
          if (!inHole) worst = std::max(worst, tree.closest(boundaryPoint(Pi, xi).x).distance);
        }
      CHECK(worst < 1e-12 * unit);
      for (std::size_t c = 0; c < Pi.segments.size(); ++c) {
        const auto [from, to] = Pi.segments[c];
        const Vec3 middle{.25 * from[0] + .75 * to[0], .25 * from[1] + .75 * to[1],
                          .25 * from[2] + .75 * to[2]};
        const BoundaryPoint at = boundaryPoint(Pi, middle);
        CHECK(at.dimension == 1);
        CHECK(at.entity == int(c) + 1);
      }
      CHECK_THROWS_AS(boundaryPoint(Pi, {.5, .5, .31}), MethodError);
    }
  }

  TEST_CASE("Floater's equations hold on the patches to rounding") {
    const TriangleSurface D = solids::blob(12);
    const BoundaryMapping Pi = getBoundaryMapping(getMeccano(D), D);
    for (const Parametrization& P : Pi.patches) {
      std::map<std::pair<int, int>, int> uses;
      for (const auto& t : P.triangles)
        for (int i = 0; i < 3; ++i) ++uses[std::minmax(t[i], t[(i + 1) % 3])];
      std::vector<char> isRim(P.points.size(), 0);
      for (const auto& [edge, count] : uses)
        if (count == 1) isRim[edge.first] = isRim[edge.second] = 1;
      const SparseMatrix lambda = meanValueWeights(P.points, P.triangles, isRim);
      double worst = 0;
      for (std::size_t i = 0; i < P.points.size(); ++i) {
        Vec2 sum;
        for (int k = lambda.start[i]; k < lambda.start[i + 1]; ++k)
          sum = sum + lambda.value[k] * P.u[lambda.column[k]];
        if (!isRim[i]) worst = std::max(worst, norm(sum - P.u[i]));
      }
      CHECK(worst < 1e-14);
    }
  }

  TEST_CASE("the placed interior is harmonic: affine maps are kept, no node leaves the hull") {
    Mesh M = boxMesh({1, 2, 3}, {2, 1, 1}, {4, 2, 2});
    bisect(M, {0, 5, 17, 30, 31});
    bisect(M, {2, 9, 40});
    const std::vector<Vec3> wanted = M.x;
    for (std::size_t i = 0; i < M.x.size(); ++i)
      if (M.dimension[i] == 3) M.x[i] = {9, -3, double(i)};
    placeInterior(M);
    for (std::size_t i = 0; i < M.x.size(); ++i) CHECK(norm(M.x[i] - wanted[i]) < 1e-8);

    for (std::size_t i = 0; i < M.x.size(); ++i)
      if (M.dimension[i] < 3) M.x[i].z = std::sin(3 * M.x[i].x) * M.x[i].y;
    placeInterior(M);
    double lo = 1e300, hi = -1e300;
    for (std::size_t i = 0; i < M.x.size(); ++i)
      if (M.dimension[i] < 3) lo = std::min(lo, M.x[i].z), hi = std::max(hi, M.x[i].z);
    for (std::size_t i = 0; i < M.x.size(); ++i) {
      CHECK(M.x[i].z >= lo);
      CHECK(M.x[i].z <= hi);
    }
  }

  TEST_CASE("the first placement on refined meccanos is nearly valid") {
    const std::map<std::string, std::pair<int, double>> wanted{
        // most inverted, least mean q
        {"sphere", {0, .86}},           {"ellipsoid", {0, .86}}, {"blob", {100, .80}},
        {"L of three cubes", {12, .9}}, {"torus", {0, .83}},     {"two handles", {40, .9}}};
    for (const MappedSolid& s : mappedSolids()) {
      CAPTURE(s.name);
      Mesh M = getInitialMesh(s.C, getBoundaryMapping(s.C, s.D));
      for (int generation = 0; generation < 9; ++generation) {
        std::vector<int> all(M.tets.size());
        for (std::size_t E = 0; E < all.size(); ++E) all[E] = int(E);
        if (M.tets.size() < 3000) bisect(M, all);
      }
      placeInterior(M);
      const QualityStatistics q = qualityStatistics(M);
      if (q.inverted == 0) CHECK(shapes::conformityFault(M) == "");
      CHECK(q.inverted <= wanted.at(s.name).first);
      CHECK(q.mean >= wanted.at(s.name).second);
      CHECK(shapes::totalVolume(M) > 0);  // orientation: outward to outward
    }
  }

  TEST_CASE("placed corners go to the nearest vertices of the solid") {
    const std::vector<MappedSolid> all = mappedSolids();
    for (std::size_t k = 3; k < all.size(); ++k) {
      const BoundaryMapping Pi = getBoundaryMapping(all[k].C, all[k].D);
      CHECK(Pi.corners.size() == all[k].C.corners.size());
      for (const Meccano::Placed& placed : all[k].C.corners) {
        double nearest = 1e300;
        for (const Vec3& p : all[k].D.points) nearest = std::min(nearest, norm(p - placed.x));
        const BoundaryPoint at =
            boundaryPoint(Pi, {double(placed.at[0]), double(placed.at[1]), double(placed.at[2])});
        CHECK(at.dimension == 0);
        CHECK(norm(at.x - placed.x) == nearest);
      }
    }
  }

  TEST_CASE("cubes anywhere in the lattice, in any order, give the same mesh from 0 on") {
    const TriangleSurface D = solids::polycube(solids::ell(), 4, solids::warped);
    const Meccano C = solids::placed(solids::ell(), solids::roughly);
    Meccano far = C;
    std::reverse(far.cubes.begin(), far.cubes.end());
    std::reverse(far.corners.begin(), far.corners.end());
    for (auto& c : far.cubes) c = {c[0] - 7, c[1] + 5, c[2] + 100};
    for (auto& p : far.corners) p.at = {p.at[0] - 7, p.at[1] + 5, p.at[2] + 100};
    const Mesh A = getInitialMesh(C, getBoundaryMapping(C, D));
    const Mesh B = getInitialMesh(far, getBoundaryMapping(far, D));
    CHECK(shapes::sameBytes(A.x, B.x));
    CHECK(shapes::sameBytes(A.xi, B.xi));
    CHECK(shapes::sameBytes(A.tets, B.tets));
    CHECK(A.faceLabel == B.faceLabel);
  }

  TEST_CASE("the same solid gives the same bytes") {
    const TriangleSurface D = solids::blob(9);
    const Meccano C = getMeccano(D);
    const BoundaryMapping A = getBoundaryMapping(C, D), B = getBoundaryMapping(C, D);
    for (std::size_t p = 0; p < A.patches.size(); ++p) {
      CHECK(shapes::sameBytes(A.patches[p].points, B.patches[p].points));
      CHECK(shapes::sameBytes(A.patches[p].u, B.patches[p].u));
    }
    CHECK(A.notes == B.notes);
  }

  TEST_CASE("the box follows the principal lengths, whatever way the solid is turned") {
    TriangleSurface D = solids::ellipsoid(8, {1, 2, 4});
    CHECK(getMeccano(D).cubes == solids::box(1, 2, 4));
    for (Vec3& p : D.points)
      p = {.6 * p.x - .48 * p.y + .64 * p.z, .8 * p.x + .36 * p.y - .48 * p.z, .8 * p.y + .6 * p.z};
    CHECK(getMeccano(D).cubes.size() == 8);
    const Meccano C = getMeccano(D);
    Mesh M = getInitialMesh(C, getBoundaryMapping(C, D));
    CHECK(qualityStatistics(M).inverted == 0);
    CHECK(qualityStatistics(M).mean > .8);
  }

  TEST_CASE("solids are welded, turned outward and told of") {
    TriangleSurface D = solids::sphere(4), soup;
    for (const auto& t : D.triangles) {
      const int n = int(soup.points.size());
      for (int i : {0, 2, 1}) soup.points.push_back(D.points[t[i]]);
      soup.triangles.push_back({n, n + 1, n + 2});
    }
    std::swap(soup.triangles[5][0], soup.triangles[5][1]);
    soup.triangles.push_back(soup.triangles[9]);
    soup.triangles.push_back({0, 0, 1});
    std::vector<std::string> warnings;
    const TriangleSurface clean = checkSolid(soup, warnings);
    CHECK(clean.points.size() == D.points.size());
    CHECK(clean.triangles.size() == D.triangles.size());
    double volume = 0;
    for (const auto& t : clean.triangles)
      volume += dot(clean.points[t[0]], cross(clean.points[t[1]], clean.points[t[2]])) / 6;
    CHECK(volume > 0);
    REQUIRE(warnings.size() == 2);
    CHECK(has(warnings[0], "1 duplicate triangle, 1 zero-area"));
    CHECK(has(warnings[1], "turned 1 triangle"));

    // a tube bent back through itself
    TriangleSurface crossed = solids::ellipsoid(12, {.3, .3, 3});
    for (Vec3& p : crossed.points)
      p = {std::cos(2.2 * p.z) * (1.5 + p.x), std::sin(2.2 * p.z) * (1.5 + p.x), p.y};
    warnings.clear();
    checkSolid(crossed, warnings);
    REQUIRE(warnings.size() == 1);
    CHECK(has(warnings[0], "crosses itself"));
  }

  TEST_CASE("what is no solid is refused with its place") {
    auto refusal = [](const TriangleSurface& S) { return messageOf([&] { checked(S); }); };
    TriangleSurface D = solids::sphere(3), S = D;
    CHECK(refusal(D) == "");
    S.triangles.pop_back();
    CHECK(has(refusal(S), "checkSolid (§2): the surface is open"));
    S = D;
    const int n = int(S.points.size());
    for (int i = 0; i < n; ++i) S.points.push_back(S.points[i] + Vec3{5, 0, 0});
    for (const auto& t : D.triangles) S.triangles.push_back({t[0] + n, t[1] + n, t[2] + n});
    CHECK(has(refusal(S), "2 components"));
    S = D;
    S.points[3].y = std::numeric_limits<double>::quiet_NaN();
    CHECK(has(refusal(S), "finite"));
    S = D;
    S.triangles[2][1] = 1000;
    CHECK(has(refusal(S), "names point 1000"));
    CHECK(has(refusal({}), "empty"));
    S = D;
    for (Vec3& p : S.points) p.z = 0;
    CHECK(has(refusal(S), "checkSolid (§2)"));
    S.points = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};  // flat: two squares, back to back
    S.triangles = {{0, 1, 2}, {0, 2, 3}, {1, 0, 3}, {1, 3, 2}};
    CHECK(has(refusal(S), "the surface encloses no volume; check its coordinates"));
    S.points[2].z = .1;
    CHECK(refusal(S) == "");
    S = D;  // a fin
    S.points.push_back({3, 3, 3});
    S.triangles.push_back({D.triangles[0][0], D.triangles[0][1], n});
    CHECK(has(refusal(S), "non-manifold"));
    CHECK_THROWS_AS(getMeccano(solids::torus(1, .4, 8)), InputError);
    CHECK(has(messageOf([] { getMeccano(solids::torus(1, .4, 8)); }), "1 handle"));
  }

  TEST_CASE("polycubes and corners that do not fit are refused with the reason") {
    const TriangleSurface ball = solids::sphere(6), torus = solids::torus(1, .4, 10);
    auto refusal = [](const Meccano& C, const TriangleSurface& D) {
      CHECK_THROWS_AS(getBoundaryMapping(C, D), InputError);
      return messageOf([&] { getBoundaryMapping(C, D); });
    };
    Meccano C;
    CHECK(has(refusal(C, ball), "no cubes"));
    C.cubes = {{0, 0, 0}, {1, 1, 0}};
    CHECK(has(refusal(C, ball), "no manifold at the edge"));
    C.cubes = solids::without(solids::box(2, 2, 2), {{0, 0, 0}, {1, 1, 1}});
    CHECK(has(refusal(C, ball), "no manifold at the point"));
    C.cubes = {{0, 0, 0}, {0, 0, 2}};
    CHECK(has(refusal(C, ball), "2 components"));
    C.cubes = solids::without(solids::box(3, 3, 3), {{1, 1, 1}});
    CHECK(has(refusal(C, ball), "hollow"));
    C.cubes = {{0, 0, 0}, {5000, 0, 0}};
    CHECK(has(refusal(C, ball), "1000 cubes"));
    C.cubes = solids::ring();
    CHECK(has(refusal(C, ball), "the solid has 0 handles and the polycube 1"));
    CHECK(has(refusal(C, torus), "add a line `corner i j k x y z`"));

    auto place = [](Vec3 p) { return Vec3{.9 * (p.x - 1.5), .9 * (p.y - 1.5), .8 * (p.z - .5)}; };
    const Meccano good = solids::placed(solids::ring(), place);
    C = good;
    C.corners.pop_back();
    CHECK(has(refusal(C, torus), "has no place on the solid"));
    C = good;
    C.corners[4].x = {30, 0, 0};
    CHECK(has(refusal(C, torus), "of its diagonal"));
    C = good;
    C.corners[4].x = C.corners[5].x;
    CHECK(has(refusal(C, torus), "both placed at the solid's vertex"));
    C = good;
    C.corners.push_back(C.corners[0]);
    CHECK(has(refusal(C, torus), "placed twice"));
    C = good;
    C.corners[0].at = {1, 0, 0};
    CHECK(has(refusal(C, torus), "no corner of the polycube"));
    C = good;
    C.corners[0].x.z = std::numeric_limits<double>::infinity();
    CHECK(has(refusal(C, torus), "not finite"));
  }
}
