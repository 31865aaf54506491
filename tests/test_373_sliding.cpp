// SPDX-License-Identifier: MIT
//
// §3.7.3: surface and curve nodes slide on their entities.
#include <doctest/doctest.h>

#include "shapes.hpp"

using namespace meccano;

namespace {

/// z = .5 + A sin(2πx) sin(2πy) over the unit square; u = (x, y).
Parametrization sineSurface(double A, int cells) {
  const double pi = std::acos(-1.);
  Parametrization P;
  for (int i = 0; i <= cells; ++i)
    for (int j = 0; j <= cells; ++j) {
      const Vec2 u{double(i) / cells, double(j) / cells};
      P.u.push_back(u);
      P.points.push_back({u.x, u.y, .5 + A * std::sin(2 * pi * u.x) * std::sin(2 * pi * u.y)});
    }
  for (int i = 0; i < cells; ++i)
    for (int j = 0; j < cells; ++j) {
      const int a = i * (cells + 1) + j, b = a + cells + 1;
      P.triangles.push_back({a, b, b + 1});
      P.triangles.push_back({a, b + 1, a + 1});
    }
  buildLocator(P);
  return P;
}

bool onFace(double t) { return t < 1e-12 || t > 1 - 1e-12; }

/// A box whose inner nodes of the plane z = .5 lie on the sine surface; all others are shaken a
/// little.
Mesh boxWithSurface(int n, double A) {
  Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {n, n, n});
  M.surfaces.push_back(sineSurface(A, 4 * n + 1));
  for (std::size_t i = 0; i < M.x.size(); ++i) {
    const Vec3 x = M.x[i];
    if (std::abs(x.z - .5) > 1e-12 || onFace(x.x) || onFace(x.y)) continue;
    M.dimension[i] = 2;
    M.entity[i] = 1;
    M.parameter[i] = {x.x + .2 / n * std::sin(40 * x.y), x.y + .2 / n * std::cos(50 * x.x)};
    M.x[i] = varphi(M.surfaces[0], M.parameter[i]);
  }
  return M;
}

std::vector<int> elementsAround(const Mesh& M, int n) {
  std::vector<int> E;
  for (std::size_t e = 0; e < M.tets.size(); ++e)
    if (std::find(M.tets[e].begin(), M.tets[e].end(), n) != M.tets[e].end())
      E.push_back(static_cast<int>(e));
  return E;
}

int nodeOfDimension(const Mesh& M, int dimension, int entity) {
  for (std::size_t n = 0; n < M.x.size(); ++n)
    if (M.dimension[n] == dimension && M.entity[n] == entity) return static_cast<int>(n);
  return -1;
}

/// The mesh before and after optimizeMesh.
struct Pair {
  Mesh before, after;
  OptimizeReport report;
};
Pair optimized(Mesh M, const OptimizeOptions& options) {
  Pair p{M, M, {}};
  p.report = optimizeMesh(p.after, options);
  return p;
}

}  // namespace

TEST_SUITE("3.7.3") {
  TEST_CASE("eq. (10): f_phi(u) is f at phi(u), infinite outside the unit square") {
    const Mesh M = boxWithSurface(4, .1);
    const int n = nodeOfDimension(M, 2, 1);
    const Star star = starOf(M, n, elementsAround(M, n));
    for (Vec2 u : {M.parameter[n], Vec2{.31, .27}, Vec2{.24, .26}})
      CHECK(fVarphi(star, M.surfaces[0], u, .1) == f(star, varphi(M.surfaces[0], u), .1));
    CHECK(std::isinf(fVarphi(star, M.surfaces[0], {1.2, .3}, .1)));
  }

  TEST_CASE("eq. (11): f_gamma(s) is f at gamma(s)") {
    const Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {3, 3, 3});
    const int n = nodeOfDimension(M, 1, 2);
    const Star star = starOf(M, n, elementsAround(M, n));
    const Curve& C = M.curves[1];
    for (double s : {.3, .4, .5}) CHECK(fGamma(star, C, s, .1) == f(star, gamma(C, s), .1));
  }

  TEST_CASE("eq. (10), (11): nodes lie on their entity at their parameter, corners stay") {
    for (bool letter : {false, true}) {
      CAPTURE(letter);
      const Pair p =
          optimized(boxWithSurface(6, .15), letter ? OptimizeOptions::paper() : OptimizeOptions{});
      const Mesh& M = p.after;
      CHECK(p.report.inverted == 0);
      CHECK(p.report.converged);
      int slid[4] = {0, 0, 0, 0};
      for (std::size_t n = 0; n < M.x.size(); ++n) {
        const bool moved = !(M.x[n] == p.before.x[n]);
        slid[M.dimension[n]] += moved;
        if (M.dimension[n] == 0) CHECK_FALSE(moved);
        if (M.dimension[n] == 1)
          CHECK(norm(M.x[n] - gamma(M.curves[M.entity[n] - 1], M.parameter[n].x)) == 0);
        if (M.dimension[n] == 2)
          CHECK(norm(M.x[n] - varphi(surfaceOf(M, M.entity[n]), M.parameter[n])) == 0);
      }
      for (int dimension : {1, 2, 3}) CHECK(slid[dimension] > 0);  // or nothing was tested
    }
  }

  TEST_CASE("eq. (10): nodes of the box sides stay in their planes, of its edges on their lines") {
    const Pair p = optimized(boxWithSurface(4, .15), {});
    const auto count = [](Vec3 x) {
      return int(onFace(x.x)) + int(onFace(x.y)) + int(onFace(x.z));
    };
    for (std::size_t n = 0; n < p.after.x.size(); ++n) {
      if (p.after.dimension[n] == 2 && p.after.entity[n] > 0) continue;
      CHECK(count(p.after.x[n]) == 3 - p.after.dimension[n]);
    }
  }

  TEST_CASE("eq. (10): sliding beats fixed surface nodes") {
    const Mesh M = boxWithSurface(6, .15);
    OptimizeOptions fixed;
    fixed.power = 1;
    for (std::size_t n = 0; n < M.x.size(); ++n)
      if (M.dimension[n] < 3) fixed.fixed.push_back(static_cast<int>(n));
    OptimizeOptions free;
    free.power = 1;
    CHECK(optimized(M, free).report.minQ > optimized(M, fixed).report.minQ + .02);
  }

  TEST_CASE("eq. (10), (11): numerical derivatives agree with the exact ones in the result") {
    OptimizeOptions exact = OptimizeOptions::paper();
    exact.numericalDerivatives = false;
    exact.maxDisp = 1e-4;
    OptimizeOptions numerical = exact;
    numerical.numericalDerivatives = true;
    const Mesh M = boxWithSurface(6, .12);
    const OptimizeReport a = optimized(M, exact).report, b = optimized(M, numerical).report;
    CHECK(a.minQ == doctest::Approx(b.minQ).epsilon(.01));
    CHECK(a.meanQ == doctest::Approx(b.meanQ).epsilon(1e-3));
  }

  TEST_CASE("eq. (10), (11): the sides of a tangled box stay unfolded in every sweep") {
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {4, 4, 4});
    unsigned random = 7;
    auto shake = [&] {
      return .9 * ((random = random * 1664525u + 1013904223u) / 4294967296. - .5);
    };
    for (std::size_t n = 0; n < M.x.size(); ++n)
      if (M.dimension[n] == 3)
        M.x[n] += Vec3{shake(), shake(), shake()};  // up to 1.8 cells: tangled
    CHECK(shapes::countInverted(M) > 0);
    OptimizeOptions options;
    options.onSweep = [&](const Sweep&) {
      for (int p = 1; p <= 6; ++p) {
        double area = 0;
        for (const auto& face : surfaceFaces(M, -p)) {
          Vec2 u[3];
          for (int i = 0; i < 3; ++i) REQUIRE(parameterOn(M, face[i], -p, u[i]));
          area += .5 * std::abs(cross(u[1] - u[0], u[2] - u[0]));
        }
        CHECK(area == doctest::Approx(1));  // more where triangles lie over each other
      }
    };
    CHECK(optimizeMesh(M, options).inverted == 0);
  }

  TEST_CASE("eq. (11): a node slides around a closed curve across s = 0") {
    // A ring of nodes of the plane z = .5 on a circle-like closed polygon, displaced along it.
    const int n = 6, points = 80;
    const double pi = std::acos(-1.);
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {n, n, n});
    Curve C;
    C.closed = true;
    for (int k = 0; k <= points; ++k) {
      const double a = 2 * pi * k / points;
      const Vec3 p{.5 + .17 * std::cos(a), .5 + .17 * std::sin(a), .5};
      C.s.push_back(k == 0 ? 0
                           : C.s.back() +
                                 norm(p - (k < points ? C.points.back() : C.points[points - 1])));
      if (k < points) C.points.push_back(p);
    }
    M.curves.push_back(C);
    const int number = static_cast<int>(M.curves.size());
    for (std::size_t i = 0; i < M.x.size(); ++i) {
      const Vec3 d = M.x[i] - Vec3{.5, .5, .5};
      if (std::abs(d.z) > 1e-9 || std::max(std::abs(d.x), std::abs(d.y)) > .17 || norm(d) < 1e-9)
        continue;
      double s = C.s.back() * std::atan2(d.y, d.x) / (2 * pi) - .02;
      if (s < 0) s += C.s.back();
      M.dimension[i] = 1;
      M.entity[i] = number;
      M.parameter[i] = {s, 0};
      M.x[i] = gamma(C, s);
    }
    const Pair p = optimized(M, {});
    CHECK(p.report.inverted == 0);
    bool crossed = false;
    for (std::size_t i = 0; i < M.x.size(); ++i) {
      if (M.dimension[i] != 1 || M.entity[i] != number) continue;
      const double s = p.after.parameter[i].x;
      CHECK(s >= 0);
      CHECK(s <= C.s.back());
      CHECK(p.after.x[i] == gamma(C, s));
      crossed = crossed || std::abs(s - M.parameter[i].x) > .5 * C.s.back();
    }
    CHECK(crossed);
  }
}
