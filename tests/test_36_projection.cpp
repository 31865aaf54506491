// SPDX-License-Identifier: MIT
// §3.6: the linear solver, Floater's parameterization, and the projection of S_M onto S.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "../meccano.hpp"
#include "shapes.hpp"

using namespace meccano;

namespace {

constexpr double pi36 = 3.14159265358979323846;

double bentHeight(double x, double y) { return .3 * std::sin(2.5 * x + .4) * std::cos(1.7 * y); }

/// Two triangles per cell of a grid over [0, w] x [0, h], cells kept where keep(i, j).
template <class Keep, class Height>
TriangleSurface cells(int n, int m, double w, double h, Keep keep, Height height) {
  TriangleSurface S;
  std::vector<int> number((n + 1) * (m + 1), -1);
  auto point = [&](int i, int j) {
    int& at = number[j * (n + 1) + i];
    if (at < 0) {
      at = static_cast<int>(S.points.size());
      double x = w * i / n, y = h * j / m;
      S.points.push_back({x, y, height(x, y)});
    }
    return at;
  };
  for (int j = 0; j < m; ++j)
    for (int i = 0; i < n; ++i) {
      if (!keep(i, j)) continue;
      int a = point(i, j), b = point(i + 1, j), c = point(i + 1, j + 1), d = point(i, j + 1);
      shapes::addCell(S, (i + j) % 2 == 0, a, b, c, d);
    }
  return S;
}

TriangleSurface bentSurface(int n, int m) {
  TriangleSurface S = cells(
      n, m, 1.1, .9, [](int, int) { return true; }, bentHeight);
  splitChords(S);
  return S;
}

/// A disk of radius 1: a point, then rings of 6, 12, 18 ... points; its rim is a regular polygon.
TriangleSurface roundSurface(int rings) {
  TriangleSurface S;
  S.points.push_back({0, 0, .2});
  for (int r = 1; r <= rings; ++r)
    for (int i = 0; i < 6 * r; ++i) {
      double t = 2 * pi36 * i / (6 * r), radius = double(r) / rings;
      S.points.push_back({radius * std::cos(t), radius * std::sin(t), .2 * std::cos(radius)});
    }
  auto point = [](int r, int i) {
    return r == 0 ? 0 : 1 + 3 * r * (r - 1) + (i + 6 * r) % (6 * r);
  };
  for (int r = 1; r <= rings; ++r)
    for (int side = 0; side < 6; ++side)
      for (int i = 0; i < r; ++i) {
        int a = side * r + i, b = side * (r - 1) + i;
        S.triangles.push_back({point(r, a), point(r, a + 1), point(r - 1, b)});
        if (i + 1 < r)
          S.triangles.push_back({point(r - 1, b), point(r, a + 1), point(r - 1, b + 1)});
      }
  splitChords(S);
  return S;
}

std::vector<char> rimFlags(const TriangleSurface& S) {
  std::vector<char> isRim(S.points.size(), 0);
  for (const std::vector<int>& rim : rimLoops(S))
    for (int n : rim) isRim[n] = 1;
  return isRim;
}

/// [18] λ_ij with angles and tan(), as Floater prints them: slow and literal.
double literalWeight(const TriangleSurface& S, int i, int j) {
  auto angle = [&](int a, int b) {
    Vec3 p = S.points[a] - S.points[i], q = S.points[b] - S.points[i];
    return std::acos(dot(p, q) / (norm(p) * norm(q)));
  };
  double wanted = 0, sum = 0;
  for (const std::array<int, 3>& t : S.triangles)
    for (int c = 0; c < 3; ++c) {
      if (t[c] != i) continue;
      int a = t[(c + 1) % 3], b = t[(c + 2) % 3];
      for (int end : {a, b}) {
        double w = std::tan(angle(a, b) / 2) / norm(S.points[end] - S.points[i]);
        sum += w;
        if (end == j) wanted += w;
      }
    }
  return wanted / sum;
}

/// Gaussian elimination with row pivoting.
std::vector<Vec2> denseSolve(const SparseMatrix& A, std::vector<Vec2> b) {
  const int n = static_cast<int>(b.size());
  std::vector<std::vector<double>> a(n, std::vector<double>(n, 0.0));
  for (int i = 0; i < n; ++i)
    for (int k = A.start[i]; k < A.start[i + 1]; ++k) a[i][A.column[k]] = A.value[k];
  for (int c = 0; c < n; ++c) {
    int pivot = c;
    for (int r = c; r < n; ++r)
      if (std::fabs(a[r][c]) > std::fabs(a[pivot][c])) pivot = r;
    std::swap(a[c], a[pivot]);
    std::swap(b[c], b[pivot]);
    for (int r = c + 1; r < n; ++r) {
      double factor = a[r][c] / a[c][c];
      for (int k = c; k < n; ++k) a[r][k] -= factor * a[c][k];
      b[r] = b[r] - factor * b[c];
    }
  }
  for (int r = n - 1; r >= 0; --r) {
    for (int k = r + 1; k < n; ++k) b[r] = b[r] - a[r][k] * b[k];
    b[r] = (1 / a[r][r]) * b[r];
  }
  return b;
}

/// n x n, a bandlike pattern without symmetry, diagonally dominant unless weak.
SparseMatrix someMatrix(int n, double diagonal) {
  SparseMatrix A;
  A.start.push_back(0);
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j < n; ++j) {
      bool there = i == j || (3 * i + 5 * j) % 7 == 0 || j == i + 1;
      if (!there) continue;
      A.column.push_back(j);
      A.value.push_back(i == j ? diagonal : std::sin(1 + 2.3 * i - 1.1 * j));
    }
    A.start.push_back(static_cast<int>(A.column.size()));
  }
  return A;
}

/// A mesh that has S_M as faces labelled k: a tetrahedron on either side of each triangle.
Mesh meshWithFaces(const TriangleSurface& SM, int k) {
  Mesh M;
  M.x = SM.points;
  for (const std::array<int, 3>& t : SM.triangles) {
    Vec3 a = SM.points[t[0]], b = SM.points[t[1]], c = SM.points[t[2]], n = cross(b - a, c - a);
    for (int side : {1, -1}) {
      int tip = static_cast<int>(M.x.size());
      M.x.push_back((1. / 3) * (a + b + c) + (side * .1 / std::sqrt(norm(n))) * n);
      M.tets.push_back(side > 0 ? std::array<int, 4>{t[0], t[1], t[2], tip}
                                : std::array<int, 4>{tip, t[1], t[0], t[2]});
      M.faceLabel.push_back(side > 0 ? std::array<int, 4>{0, 0, 0, k}
                                     : std::array<int, 4>{k, 0, 0, 0});
    }
  }
  M.dimension.assign(M.x.size(), 3);
  M.entity.assign(M.x.size(), 0);
  M.parameter.assign(M.x.size(), {0, 0});
  return M;
}

/// A staircase S_M beside the bent surface: squares of 1/10, some cut away at two corners, shifted
/// and wavy.
TriangleSurface staircase() {
  auto keep = [](int i, int j) { return !(i + j < 2) && !(i > 8 && j > 6) && !(i == 0 && j > 7); };
  auto height = [](double x, double y) { return bentHeight(x, y) + .04 * std::sin(9 * x + 5 * y); };
  TriangleSurface SM = cells(11, 9, 1.12, .93, keep, height);
  splitChords(SM);
  for (Vec3& p : SM.points) p = p + Vec3{-.013, -.017, .01};
  return SM;
}

struct Projected {
  Mesh M;
  ProjectionReport report;
  TriangleSurface S, SM;
  double diagonal = std::sqrt(1.1 * 1.1 + .9 * .9 + .1);
};
Projected project(bool followRim, bool reversed = false) {
  Projected P;
  P.S = cells(
      14, 12, 1.1, .9, [](int, int) { return true; }, bentHeight);
  P.SM = staircase();
  if (reversed)
    for (std::array<int, 3>& t : P.SM.triangles) std::swap(t[0], t[1]);
  P.M = meshWithFaces(P.SM, 1);
  P.report = surfaceProjection(P.M, P.S, followRim);
  return P;
}

/// Parameters in 𝓤 of a node of S_M.
Vec2 parametersOf(const Mesh& M, int n) {
  if (M.dimension[n] == 2) return M.parameter[n];
  double s = M.dimension[n] == 1 ? M.parameter[n].x : M.corners[M.entity[n] - 1].on[0].s;
  const Curve& C = M.curves[0];
  int i = static_cast<int>(std::upper_bound(C.s.begin(), C.s.end(), s) - C.s.begin()) - 1;
  i = std::min(i, static_cast<int>(C.points.size()) - 1);
  Vec2 a = C.sides[0].u[i], b = C.sides[0].u[(i + 1) % C.points.size()];
  return a + ((s - C.s[i]) / (C.s[i + 1] - C.s[i])) * (b - a);
}

}  // namespace

TEST_SUITE("3.6") {
  TEST_CASE("BiCGSTAB gives what dense elimination gives") {
    for (int n : {1, 2, 13, 60}) {
      CAPTURE(n);
      SparseMatrix A = someMatrix(n, 6.5);
      std::vector<Vec2> b(n), x(n);
      for (int i = 0; i < n; ++i) b[i] = {std::cos(1.0 * i * i), 1.0 * i};
      solveBiCGSTAB(A, b, x);
      const std::vector<Vec2> exact = denseSolve(A, b);
      for (int i = 0; i < n; ++i) {
        CHECK(x[i].x == doctest::Approx(exact[i].x).epsilon(1e-9));
        CHECK(x[i].y == doctest::Approx(exact[i].y).epsilon(1e-9));
      }
    }
  }

  TEST_CASE("BiCGSTAB solves a system whose elimination without pivoting breaks down") {
    // Elimination in the first column leaves 0 as second pivot; the third column saves the matrix
    // itself.
    SparseMatrix A{{0, 2, 5, 7}, {0, 1, 0, 1, 2, 1, 2}, {1, 1, 1, 1, 1, -1, 2}};
    std::vector<Vec2> b{{1, 3}, {2, 0}, {3, -1}}, x(3), exact = denseSolve(A, b);
    solveBiCGSTAB(A, b, x);
    for (int i = 0; i < 3; ++i) {
      CHECK(x[i].x == doctest::Approx(exact[i].x));
      CHECK(x[i].y == doctest::Approx(exact[i].y));
    }
  }

  TEST_CASE("BiCGSTAB reports the residual of a system without solution") {
    SparseMatrix A{{0, 2, 4}, {0, 1, 0, 1}, {1, 1, 1, 1}};
    std::vector<Vec2> b{{1, 1}, {2, 1}}, x(2);
    try {
      solveBiCGSTAB(A, b, x);
      FAIL("no exception");
    } catch (const SolverError& error) {
      CHECK(std::string(error.what()).find("solveBiCGSTAB (§3.6): relative residual") == 0);
    }
  }

  TEST_CASE("tan(alpha/2) without the angle") {
    for (double alpha : {1e-6, .3, 1.5, pi36 / 2, 1.7, 3., 3.1415}) {
      Vec3 a{1.3, 0, 0}, b{.7 * std::cos(alpha), 0, .7 * std::sin(alpha)};
      CHECK(tanHalfAngle(a, b) == doctest::Approx(std::tan(alpha / 2)).epsilon(1e-9));
    }
    CHECK(tanHalfAngle({1, 0, 0}, {2, 0, 0}) == 0);
    CHECK(std::isfinite(tanHalfAngle({1, 0, 0}, {-2, 0, 0})));
  }

  TEST_CASE("mean value weights are positive, sum to one, and agree with the literal formula") {
    TriangleSurface S = bentSurface(6, 5);
    std::vector<char> isRim = rimFlags(S);
    SparseMatrix lambda = meanValueWeights(S.points, S.triangles, isRim);
    for (int i = 0; i < static_cast<int>(S.points.size()); ++i) {
      double sum = 0;
      for (int k = lambda.start[i]; k < lambda.start[i + 1]; ++k) {
        CHECK(lambda.value[k] > 0);
        CHECK(lambda.value[k] ==
              doctest::Approx(literalWeight(S, i, lambda.column[k])).epsilon(1e-9));
        sum += lambda.value[k];
      }
      if (isRim[i])
        CHECK(lambda.start[i] == lambda.start[i + 1]);
      else
        CHECK(sum == doctest::Approx(1).epsilon(1e-14));
    }
  }

  TEST_CASE("eq. (3): the parameterization reproduces a planar mesh whose rim is its own") {
    TriangleSurface S = bentSurface(7, 6);
    std::vector<char> isRim = rimFlags(S);
    std::vector<Vec2> u(S.points.size());
    for (size_t n = 0; n < u.size(); ++n) {
      Vec3& p = S.points[n];
      if (!isRim[n]) p = p + Vec3{.03 * std::sin(40 * p.y), .03 * std::cos(50 * p.x), 0};
      p.z = .3 * p.x - .2 * p.y + 1;
    }
    // The plane's own coordinates: an isometry, so that weights and rim agree.
    Vec3 e1 = (1 / norm(Vec3{1, 0, .3})) * Vec3{1, 0, .3}, n = cross(e1, Vec3{0, 1, -.2}),
         e2 = (1 / norm(n)) * cross(n, e1);
    for (size_t i = 0; i < u.size(); ++i) u[i] = {dot(S.points[i], e1), dot(S.points[i], e2)};
    std::vector<Vec2> exact = u, result = floaterParametrization(S.points, S.triangles, isRim, u);
    for (size_t i = 0; i < u.size(); ++i) CHECK(norm(result[i] - exact[i]) < 1e-11);
  }

  TEST_CASE("a map that folds is refused") {
    TriangleSurface S = bentSurface(4, 4);
    std::vector<char> isRim = rimFlags(S);
    std::vector<Vec2> u(S.points.size());
    std::vector<int> rim = rimLoops(S)[0];
    for (size_t i = 0; i < rim.size(); ++i) {  // a star: far from convex
      double t = 2 * pi36 * double(i) / double(rim.size()), r = i % 4 == 0 ? 1 : .1;
      u[rim[i]] = {r * std::cos(t), r * std::sin(t)};
    }
    try {
      floaterParametrization(S.points, S.triangles, isRim, u);
      FAIL("no exception");
    } catch (const MethodError& error) {
      CHECK(std::string(error.what()).find("self-folding in parameter space") != std::string::npos);
    }
  }

  TEST_CASE("splitChords: no inner edge joins rim points, the geometry stays") {
    for (TriangleSurface S : {cells(
                                  5, 1, 1, .2, [](int, int) { return true; }, bentHeight),
                              TriangleSurface{{{0, 0, 0}, {1, 0, 0}, {0, 2, 0}}, {{0, 1, 2}}},
                              cells(
                                  1, 1, 1, 1, [](int, int) { return true; }, bentHeight)}) {
      auto area = [](const TriangleSurface& T) {
        double sum = 0;
        for (const std::array<int, 3>& t : T.triangles)
          sum += .5 * norm(cross(T.points[t[1]] - T.points[t[0]], T.points[t[2]] - T.points[t[0]]));
        return sum;
      };
      double before = area(S);
      splitChords(S);
      CHECK(area(S) == doctest::Approx(before).epsilon(1e-14));
      std::vector<char> isRim = rimFlags(S);
      std::vector<std::array<int, 3>> neighbours = triangleNeighbours(S);
      CHECK(rimLoops(S)[0].size() >= 4);
      for (size_t t = 0; t < S.triangles.size(); ++t)
        for (int i = 0; i < 3; ++i) {
          bool both = isRim[S.triangles[t][i]] && isRim[S.triangles[t][(i + 1) % 3]];
          CHECK((neighbours[t][i] < 0 || !both));
        }
      CHECK(parametrizeSurface(SurfaceDistance(S)).surface.u.size() == S.points.size());
    }
  }

  TEST_CASE(
      "corners: four sharp ones of a rectangle, four spread ones of a disk, noise makes none") {
    SurfaceDistance rectangle(bentSurface(20, 16));
    RimCorners corners = rimCorners(rectangle);
    for (int c = 0; c < 4; ++c) {
      Vec3 p = rectangle.S.points[rectangle.rim[corners.at[c]]];
      CHECK(corners.sharp[c]);
      CHECK(std::fabs(std::fabs(p.x - .55) - .55) + std::fabs(std::fabs(p.y - .45) - .45) < 1e-12);
    }
    TriangleSurface disk = roundSurface(16);
    std::vector<int> rim = rimLoops(disk)[0];
    for (size_t i = 0; i < rim.size(); i += 3) disk.points[rim[i]] = 1.01 * disk.points[rim[i]];
    SurfaceDistance D(disk);
    corners = rimCorners(D);
    for (int c = 0; c < 4; ++c) {
      CHECK_FALSE(corners.sharp[c]);
      int step = c < 3 ? corners.at[c + 1] - corners.at[c] : corners.at[0] + 96 - corners.at[3];
      CHECK(std::abs(step - 24) <= 1);
    }
  }

  TEST_CASE("eq. (3): phi is injective on bent surfaces, and phi(phi^-1(x)) = x") {
    for (const TriangleSurface& S : {bentSurface(12, 3), bentSurface(9, 11), roundSurface(7)}) {
      SurfaceParametrization Phi = parametrizeSurface(SurfaceDistance(S));
      CHECK(flippedTriangles(S.triangles, Phi.surface.u).empty());
      double area = 0;
      for (const std::array<int, 3>& t : S.triangles)
        area += .5 * cross(Phi.surface.u[t[1]] - Phi.surface.u[t[0]],
                           Phi.surface.u[t[2]] - Phi.surface.u[t[0]]);
      CHECK(area == doctest::Approx(1).epsilon(1e-12));  // all of the unit square
      for (size_t n = 0; n < S.points.size(); ++n)
        CHECK(norm(varphi(Phi.surface, Phi.surface.u[n]) - S.points[n]) < 1e-11);
      for (const std::array<int, 3>& t : S.triangles) {
        const std::vector<Vec2>& u = Phi.surface.u;
        Vec3 x = .2 * S.points[t[0]] + .5 * S.points[t[1]] + .3 * S.points[t[2]];
        CHECK(norm(varphi(Phi.surface, .2 * u[t[0]] + .5 * u[t[1]] + .3 * u[t[2]]) - x) < 1e-11);
      }
      for (size_t i = 0; i < Phi.rim.points.size(); ++i)  // the rim's two parameterizations agree
        CHECK(norm(varphi(Phi.surface, Phi.rim.sides[0].u[i]) - gamma(Phi.rim, Phi.rim.s[i])) <
              1e-11);
    }
  }

  TEST_CASE("eq. (4): after the projection every node of S_M is on S") {
    for (bool followRim : {false, true}) {
      CAPTURE(followRim);
      Projected P = project(followRim);
      SurfaceDistance S(P.S);
      std::vector<char> isRim = rimFlags(P.SM);
      REQUIRE(P.M.surfaces.size() == 1);
      REQUIRE(P.M.curves.size() == 1);
      CHECK(P.M.surfaces[0].rim == 1);
      CHECK(P.M.curves[0].sides[0].surface == 1);
      CHECK(P.M.curves[0].s.size() == P.M.curves[0].points.size() + 1);
      for (int n = 0; n < static_cast<int>(P.SM.points.size()); ++n) {
        CAPTURE(n);
        CHECK(S.query(P.M.x[n]).distance < 1e-12 * P.diagonal);
        if (isRim[n]) {
          CHECK(S.rimDistance(P.M.x[n]) < 1e-12 * P.diagonal);
          CHECK(P.M.dimension[n] <= 1);
        } else {
          CHECK(P.M.dimension[n] == 2);
          CHECK(P.M.entity[n] == 1);
          CHECK(P.M.x[n] == varphi(P.M.surfaces[0], P.M.parameter[n]));
        }
        if (P.M.dimension[n] == 1) CHECK(P.M.x[n] == gamma(P.M.curves[0], P.M.parameter[n].x));
        if (P.M.dimension[n] == 0) CHECK(P.M.x[n] == P.M.corners[P.M.entity[n] - 1].x);
      }
      for (size_t n = P.SM.points.size(); n < P.M.x.size(); ++n) CHECK(P.M.dimension[n] == 3);
    }
  }

  TEST_CASE("the rim of S_M runs once around the rim of S, all nodes apart") {
    for (bool followRim : {false, true}) {
      CAPTURE(followRim);
      Projected P = project(followRim);
      std::vector<int> rim = rimLoops(P.SM)[0];
      const double L = P.M.curves[0].s.back();
      std::vector<double> s;
      for (int n : rim)
        s.push_back(P.M.dimension[n] == 1 ? P.M.parameter[n].x
                                          : P.M.corners[P.M.entity[n] - 1].on[0].s);
      double around = 0;
      for (size_t i = 0; i < s.size(); ++i) {
        double step = s[(i + 1) % s.size()] - s[i];
        if (step < 0) step += L;
        CHECK(step > .02 * L / double(s.size()));
        around += step;
      }
      CHECK(around == doctest::Approx(L));
    }
  }

  TEST_CASE("phi_M is injective, either way") {
    for (bool followRim : {false, true}) {
      Projected P = project(followRim);
      std::vector<Vec2> u;
      for (int n = 0; n < static_cast<int>(P.SM.points.size()); ++n)
        u.push_back(parametersOf(P.M, n));
      CHECK(flippedTriangles(P.SM.triangles, u).empty());
    }
  }

  TEST_CASE("following the rim moves nodes less along S") {
    auto meanShift = [](const Projected& P) {
      SurfaceDistance S(P.S);
      double sum = 0;
      for (size_t n = 0; n < P.SM.points.size(); ++n)
        sum += norm(P.M.x[n] - S.query(P.SM.points[n]).point) / double(P.SM.points.size());
      return sum;
    };
    double paper = meanShift(project(false)), follow = meanShift(project(true));
    CAPTURE(paper);
    CAPTURE(follow);
    CHECK(follow < .6 * paper);
  }

  TEST_CASE("corners near a node of S_M's rim are held, one node each; far ones are not") {
    Projected P = project(true);
    CHECK(P.report.cornerNodes.size() == P.M.corners.size());
    CHECK(P.M.corners.size() >= 2);
    for (int n : P.report.cornerNodes) {
      CHECK(P.M.dimension[n] == 0);
      CHECK(norm(P.M.x[n] - P.SM.points[n]) < .25);
    }
    // S_M far smaller than S: all four corners are out of reach.
    TriangleSurface small = staircase();
    for (Vec3& p : small.points) p = Vec3{.55, .45, 0} + .3 * (p - Vec3{.55, .45, 0});
    Mesh M = meshWithFaces(small, 1);
    CHECK(surfaceProjection(M, P.S, true).cornerNodes.empty());
    CHECK(M.corners.empty());
  }

  TEST_CASE("the orientation of S_M's faces and of S does not matter") {
    for (bool followRim : {false, true}) {
      Projected P = project(followRim), R = project(followRim, true);
      for (size_t n = 0; n < P.SM.points.size(); ++n) CHECK(norm(P.M.x[n] - R.M.x[n]) < 1e-9);
      TriangleSurface turned = P.S;
      for (std::array<int, 3>& t : turned.triangles) std::swap(t[0], t[1]);
      Mesh M = meshWithFaces(P.SM, 1);
      CHECK(surfaceProjection(M, turned, followRim).tangentialShift <
            2 * P.report.tangentialShift + .1);
    }
  }

  TEST_CASE("a further surface gets the next numbers") {
    Projected P = project(true);
    Mesh M = meshWithFaces(P.SM, 2);
    M.surfaces = P.M.surfaces;
    M.curves = P.M.curves;
    M.corners = P.M.corners;
    ProjectionReport report = surfaceProjection(M, P.S, true);
    REQUIRE(M.surfaces.size() == 2);
    CHECK(M.surfaces[1].rim == 2);
    CHECK(M.curves[1].sides[0].surface == 2);
    for (int n : report.cornerNodes) {
      CHECK(M.entity[n] > static_cast<int>(P.M.corners.size()));
      CHECK(M.corners[M.entity[n] - 1].on[0].curve == 2);
    }
  }

  TEST_CASE("an S_M that is no disk is refused") {
    Projected P = project(true);
    TriangleSurface annulus = cells(
        8, 8, 1.1, .9, [](int i, int j) { return i != 4 || j != 4; }, bentHeight);
    Mesh M = meshWithFaces(annulus, 1), none = meshWithFaces(annulus, 7);
    try {
      surfaceProjection(M, P.S, true);
      FAIL("no exception");
    } catch (const MethodError& error) {
      CHECK(std::string(error.what()).find("S_M has 2 rims instead of one") != std::string::npos);
    }
    CHECK_THROWS_AS(surfaceProjection(none, P.S, true), MethodError);
  }
}
