// SPDX-License-Identifier: MIT
// §3 end to end: the promises of insertSurface, checked by tools that share no code with it.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <map>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "../meccano.hpp"
#include "../samples/surfaces.hpp"
#include "shapes.hpp"

using namespace meccano;
using shapes::Face;

namespace {

Mesh unitBox() { return boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}); }

InsertOptions withSize(double lc, InsertOptions options = {}) {
  options.lc = lc;
  return options;
}

/// Points of the triangles: each at a lattice with n steps per edge.
std::vector<Vec3> sampled(const std::vector<Vec3>& x, const std::vector<Face>& faces, int n) {
  std::vector<Vec3> points;
  for (const Face& f : faces)
    for (int i = 0; i <= n; ++i)
      for (int j = 0; i + j <= n; ++j) {
        const double v = double(i) / n, w = double(j) / n;
        points.push_back((1 - v - w) * x[f[0]] + v * x[f[1]] + w * x[f[2]]);
      }
  return points;
}

/// The two-sided Hausdorff distance of surface k and S, sampled, every triangle tried.
double literalHausdorff(const Mesh& M, int k, const TriangleSurface& S) {
  const std::vector<Face> faces = surfaceFaces(M, k);
  TriangleSurface SM;
  SM.points = M.x;
  SM.triangles = faces;
  return std::max(shapes::maxDistanceToSurface(sampled(M.x, faces, 3), S),
                  shapes::maxDistanceToSurface(sampled(S.points, S.triangles, 1), SM));
}

/// All that DESIGN 1 promises of a mesh after S became its surface k; `before` is what it was.
void checkPromises(const Mesh& before, const Mesh& M, const TriangleSurface& S, int k,
                   const InsertReport& report, double tolerance) {
  CHECK(shapes::countInverted(M) == 0);
  CHECK(shapes::conformityFault(M) == "");
  CHECK(shapes::totalVolume(M) == doctest::Approx(shapes::totalVolume(before)).epsilon(1e-10));
  const std::vector<Face> faces = surfaceFaces(M, k);
  CHECK(shapes::isDisk(faces));
  const double distance = shapes::maxDistanceToSurface(M, k, S);
  CHECK(distance <= tolerance);
  // old nodes keep their numbers and computational coordinates; what they lie on too, off S
  REQUIRE(M.x.size() > before.x.size());
  int moved = 0, renamed = 0;
  for (std::size_t n = 0; n < before.x.size(); ++n) {
    moved += !(M.xi[n] == before.xi[n]);
    renamed += before.dimension[n] < 3 &&
               (M.dimension[n] != before.dimension[n] || M.entity[n] != before.entity[n]);
  }
  CHECK(moved == 0);
  CHECK(renamed == 0);
  // computational coordinates of new nodes: the lattice, where Kuhn's tetrahedra have volume
  // 2^-level / 6
  int wrong = 0;
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    const auto& z = M.tets[E];
    const Vec3 a = M.xi[z[0]];
    const double volume = std::abs(dot(M.xi[z[1]] - a, cross(M.xi[z[2]] - a, M.xi[z[3]] - a)));
    wrong += volume != std::ldexp(1., -M.level[E]) || M.level[E] % 3 != M.type[E];
  }
  CHECK(wrong == 0);
  // every face of surface k is labelled from both sides, its nodes are on S or on S's rim
  std::map<Face, int> sides;
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i)
      if (M.faceLabel[E][i] == k) ++sides[shapes::faceOf(M.tets[E], i)];
  int oneSided = 0;
  for (const auto& [f, count] : sides) oneSided += count != 2;
  CHECK(oneSided == 0);
  const shapes::SurfaceSets SM(M, k);
  int misplaced = 0, offEntity = 0;
  for (const auto& [n, place] : SM.nodes) {
    misplaced += place == 1 ? M.dimension[n] != 2 || M.entity[n] != k : M.dimension[n] > 1;
    Vec3 p = M.x[n];
    if (M.dimension[n] == 2) p = varphi(surfaceOf(M, M.entity[n]), M.parameter[n]);
    if (M.dimension[n] == 1) p = gamma(M.curves[M.entity[n] - 1], M.parameter[n].x);
    if (M.dimension[n] == 0) p = M.corners[M.entity[n] - 1].x;
    offEntity += norm(p - M.x[n]) > tolerance;
  }
  CHECK(misplaced == 0);
  CHECK(offEntity == 0);
  // the report
  CHECK(report.surface == k);
  CHECK(static_cast<int>(M.surfaces.size()) == k);
  CHECK(report.triangles == static_cast<int>(faces.size()));
  CHECK(report.nodes == static_cast<int>(SM.nodes.size()));
  CHECK(report.maxNodeDistance <= tolerance);
  CHECK(std::abs(report.maxNodeDistance - distance) <= tolerance);
  const QualityStatistics q = qualityStatistics(M), r = qualityStatistics(M, Ideal::regular);
  CHECK(report.smoothed.tetrahedra == static_cast<int>(M.tets.size()));
  CHECK(report.smoothed.inverted == 0);
  CHECK(report.smoothed.min == q.min);
  CHECK(report.smoothed.mean == q.mean);
  CHECK(report.smoothed.stdDev == q.stdDev);
  CHECK(report.regular.min == r.min);
  CHECK(report.regular.mean == r.mean);
  CHECK(report.original.tetrahedra == static_cast<int>(before.tets.size()));
}

void insertAndCheck(const Mesh& before, const TriangleSurface& S, const InsertOptions& options) {
  Mesh M = before;
  const InsertReport report = insertSurface(M, S, options);
  checkPromises(before, M, S, static_cast<int>(before.surfaces.size()) + 1, report,
                1e-12 * shapes::diagonal(S));
}

/// What insertSurface throws; the mesh must be what it was, byte for byte.
std::string refusal(Mesh& M, const TriangleSurface& S, const InsertOptions& options, bool ofInput) {
  const Mesh before = M;
  std::string text;
  try {
    insertSurface(M, S, options);
  } catch (const InputError& error) {
    text = error.what();
    CHECK(ofInput);
  } catch (const MethodError& error) {
    text = error.what();
    CHECK_FALSE(ofInput);
  }
  CHECK(shapes::sameMesh(M, before));
  return text;
}

bool has(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

TriangleSurface sheetAt(Vec3 c, double half, double bend) {
  return samples::sheet(8, 8, [=](double s, double t) {
    return c + Vec3{half * s, half * t, bend * s * t + .5 * bend * s * s};
  });
}

/// S moved and scaled: from the unit cube to a box at `origin`.
TriangleSurface placed(TriangleSurface S, Vec3 origin, double size) {
  for (Vec3& p : S.points) p = origin + size * p;
  return S;
}

/// The faces of surface 1, seen from both sides of z = .5 + A sin 2 pi x: how many are clockwise in
/// U, and how many are not. A folded face turns the other way.
std::array<int, 2> turnsInU(const Mesh& M, double A) {
  constexpr int outward[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};
  std::array<int, 2> turns{0, 0};
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i) {
      if (M.faceLabel[E][i] != 1) continue;
      const std::array<int, 4>& z = M.tets[E];
      Vec2 u[3];
      for (int k = 0; k < 3; ++k) REQUIRE(parameterOn(M, z[outward[i][k]], 1, u[k]));
      const double volume =
          det(Mat3{M.xi[z[1]] - M.xi[z[0]], M.xi[z[2]] - M.xi[z[0]], M.xi[z[3]] - M.xi[z[0]]});
      const Vec3 middle = .25 * (M.x[z[0]] + M.x[z[1]] + M.x[z[2]] + M.x[z[3]]);
      const bool above = middle.z > .5 + A * std::sin(2 * std::acos(-1.) * middle.x);
      const double area = (volume > 0 ? 1 : -1) * cross(u[1] - u[0], u[2] - u[0]);
      ++turns[(area > 0) == above];  // all faces turn one way, seen from one side of S
    }
  return turns;
}

}  // namespace

TEST_SUITE("3") {
  TEST_CASE("insertion: the demo's row of Table I, default, with all promises") {
    const Mesh before = unitBox();
    const TriangleSurface S = samples::sine(.1);
    Mesh M = before;
    std::vector<std::string> stages;
    std::vector<QualityStatistics> at;
    InsertOptions options = withSize(.12);
    options.onStage = [&](const char* stage, const Mesh& mesh) {
      stages.push_back(stage);
      at.push_back(qualityStatistics(mesh));
    };
    const InsertReport report = insertSurface(M, S, options);
    checkPromises(before, M, S, 1, report, 1e-12 * shapes::diagonal(S));
    CHECK(report.smoothed.min >= .72);
    CHECK(report.smoothed.mean >= .92);
    CHECK(report.lc == .12);
    CHECK(M.tets.size() >= 4000);
    CHECK(M.tets.size() <= 8000);
    CHECK(report.warnings.empty());
    CHECK(stages == std::vector<std::string>{"approximated", "healed", "extracted", "surfaceHealed",
                                             "projected", "smoothed"});
    REQUIRE(at.size() == 6);
    CHECK(at[3].mean == report.refined.mean);
    CHECK(at[3].tetrahedra == report.refined.tetrahedra);
    CHECK(at[4].inverted == report.projected.inverted);
    CHECK(at[4].mean == report.projected.mean);
    CHECK(at[5].mean == report.smoothed.mean);
    CHECK(report.refined.inverted == 0);
    CHECK(report.refined.mean == doctest::Approx(1).epsilon(1e-12));  // bisection keeps q = 1
    CHECK(report.projected.tetrahedra == report.smoothed.tetrahedra);
    const double hausdorff = literalHausdorff(M, 1, S);
    CHECK(report.hausdorff == doctest::Approx(hausdorff).epsilon(.1));
    CHECK(report.hausdorff <= .1 * .12);
  }

  TEST_CASE("insertion: the demo's row of Table I, to the letter") {
    const Mesh before = unitBox();
    const TriangleSurface S = samples::sine(.1);
    Mesh M = before;
    const InsertReport report = insertSurface(M, S, withSize(.12, InsertOptions::paper()));
    checkPromises(before, M, S, 1, report, 1e-12 * shapes::diagonal(S));
    CHECK(report.smoothed.min >= .31);
    CHECK(report.smoothed.mean >= .92);
    CHECK(report.projected.inverted > 0);  // the optimization had something to untangle
    CHECK(report.hausdorff <= .1 * .12);
  }

  TEST_CASE("insertion: to the letter is without any departure that an option names") {
    const InsertOptions options = InsertOptions::paper();
    CHECK(options.outline == Outline::paper);
    CHECK_FALSE(options.followRim);
    const OptimizeOptions& o = options.optimize;
    CHECK(o.power == 1);
    CHECK(o.numericalDerivatives);
    CHECK(o.strongWolfe);
    CHECK(o.relaxation == 1);
    CHECK(o.acceleration == 0);
    CHECK_FALSE(o.globalDescent);
  }

  TEST_CASE("optimization: the lift raises the lowest q by .14 and takes .006 of the mean") {
    double gain = 0, loss = 0;  // the last sweeps win .0026 of the mean back
    constexpr int seeds[] = {3, 4, 5, 6};
    for (int seed : seeds)
      for (double power : {64., 1.}) {
        InsertOptions options = withSize(.12);
        options.optimize.power = power;
        Mesh M = unitBox();
        const QualityStatistics q = insertSurface(M, samples::randomPatch(seed), options).smoothed;
        gain += (power > 1 ? .25 : -.25) * q.min;
        loss += (power > 1 ? -.25 : .25) * q.mean;
      }
    CHECK(gain > .14);
    CHECK(loss < .007);
  }

  TEST_CASE("insertion: the same bytes in two runs") {
    for (const InsertOptions& options : {InsertOptions(), InsertOptions::paper()}) {
      Mesh A = unitBox(), B = unitBox();
      const InsertReport a = insertSurface(A, samples::sine(.15, 24), withSize(.14, options));
      const InsertReport b = insertSurface(B, samples::sine(.15, 24), withSize(.14, options));
      CHECK(shapes::sameMesh(A, B));
      CHECK(a.hausdorff == b.hausdorff);
      CHECK(a.tangentialShift == b.tangentialShift);
    }
  }

  TEST_CASE("insertion: the number of threads does not change a byte") {
    const TriangleSurface S = samples::sine(.1, 64);
    Mesh one;
    InsertReport report;
    for (int threads : {1, 2, 5}) {
      CAPTURE(threads);
      InsertOptions options = withSize(.06);
      options.optimize.threads = threads;
      Mesh M = unitBox();
      const InsertReport now = insertSurface(M, S, options);
      if (threads == 1) one = M, report = now;
      CHECK(shapes::sameMesh(M, one));
      CHECK(now.hausdorff == report.hausdorff);
      CHECK(now.hausdorffPlace == report.hausdorffPlace);
      CHECK(now.maxNodeDistance == report.maxNodeDistance);
      CHECK(now.tangentialShift == report.tangentialShift);
    }
  }

  TEST_CASE("insertion: random patches keep the promises, default and to the letter") {
    for (int seed : {1, 2, 3}) {
      CAPTURE(seed);
      insertAndCheck(unitBox(), samples::randomPatch(seed), withSize(.12));
    }
    insertAndCheck(unitBox(), samples::randomPatch(4), withSize(.12, InsertOptions::paper()));
  }

  TEST_CASE("insertion: S_M ends unfolded in U, no rim node round a corner") {
    for (double A : {.1, .2})
      for (const InsertOptions& options : {withSize(.12), withSize(.12, InsertOptions::paper())}) {
        Mesh M = unitBox();
        insertSurface(M, samples::sine(A, 24), options);
        const std::array<int, 2> turns = turnsInU(M, A);
        CHECK(std::min(turns[0], turns[1]) == 0);
        CHECK(std::max(turns[0], turns[1]) > 200);
      }
  }

  TEST_CASE("optimization: triangles of S_M that start folded in U come right") {
    Mesh M = unitBox();
    insertSurface(M, samples::sine(.1, 24), withSize(.12));
    // the inner nodes nearest to four places are moved past their neighbours along S
    for (const Vec2 middle : {Vec2{.3, .3}, Vec2{.3, .7}, Vec2{.7, .3}, Vec2{.7, .7}}) {
      int folded = -1;
      const auto away = [&](int n) { return norm(M.parameter[n] - middle); };
      for (int n = 0; n < static_cast<int>(M.x.size()); ++n)
        if (M.dimension[n] == 2 && M.entity[n] == 1 && (folded < 0 || away(n) < away(folded)))
          folded = n;
      REQUIRE(folded >= 0);
      M.parameter[folded] = M.parameter[folded] + Vec2{.25, .25};
      M.x[folded] = varphi(M.surfaces[0], M.parameter[folded]);
    }
    const std::array<int, 2> before = turnsInU(M, .1);
    REQUIRE(std::min(before[0], before[1]) > 0);
    REQUIRE(shapes::countInverted(M) > 0);
    CHECK(optimizeMesh(M).inverted == 0);
    const std::array<int, 2> after = turnsInU(M, .1);
    CHECK(std::min(after[0], after[1]) == 0);
  }

  TEST_CASE("insertion: a pit narrower than the cubes is followed by smaller faces") {
    const TriangleSurface S = samples::sheet(60, 60, [](double s, double t) {
      const double x = .3 * s, y = .3 * t;
      return Vec3{.5 + x, .5 + y, .5 - .2 * std::exp(-(x * x + y * y) / (.04 * .04))};
    });
    std::string told;
    InsertOptions options = withSize(.12);
    options.onProgress = [&](const std::string& line) {
      if (has(line, "refined where")) told = line;
    };
    const Mesh before = unitBox();
    Mesh M = before;
    const InsertReport report = insertSurface(M, S, options);
    checkPromises(before, M, S, 1, report, 1e-12 * shapes::diagonal(S));
    CHECK_FALSE(told.empty());
    CHECK(report.lc == .12);
    CHECK(report.hausdorff <= .45 * .12);  // .53 and more before
    CHECK(literalHausdorff(M, 1, S) <= .45 * .12);
    const double nodes = static_cast<double>(M.x.size());
    CHECK(report.optimization.visits > 20 * nodes);  // 34; of the last call alone 12
  }

  TEST_CASE("insertion: two fingers, whose sides end low, through the middle of T") {
    const TriangleSurface S = samples::sheet(48, 48, [](double s, double t) {
      const double x = .25 * s, y = .25 * t;
      const auto finger = [&](double at) {  // .28 high, .14 wide
        return .28 / (1 + std::pow(std::hypot(x - at, y) / .07, 6));
      };
      return Vec3{.5 + x, .5 + y, .35 + std::max(finger(-.12), finger(.12))};
    });
    Mesh M = unitBox();
    InsertOptions options = withSize(.12);
    std::string lines;
    options.onProgress = [&](const std::string& line) { lines += line + "\n"; };
    const InsertReport report = insertSurface(M, S, options);
    CHECK(lines.find("(middle, ") != std::string::npos);
    CHECK(report.lc == .12);
    CHECK(report.smoothed.inverted == 0);
    CHECK(report.smoothed.min > .6);
  }

  TEST_CASE("insertion: S turned over gives a valid mesh as well") {
    TriangleSurface S = samples::sine(.1, 24);
    for (auto& t : S.triangles) std::swap(t[0], t[1]);
    insertAndCheck(unitBox(), S, withSize(.14));
  }

  TEST_CASE("insertion: cells that are no cubes, many or one") {
    insertAndCheck(boxMesh({-1, 0, 0}, {3, 1, 1}, {6, 2, 2}), samples::sine(.1, 24), withSize(.14));
    insertAndCheck(boxMesh({0, 0, 0}, {1, 1, 1}, {1, 1, 1}), samples::sine(.1, 24), withSize(.14));
    insertAndCheck(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 3}), samples::sine(.1, 24), withSize(.14));
    insertAndCheck(boxMesh({0, 0, 0}, {1, 1, 1}, {3, 3, 3}), samples::disc(20), withSize(.14));
  }

  TEST_CASE("insertion: a surface of two triangles") {
    TriangleSurface S;
    S.points = {{.3, .3, .45}, {.7, .32, .5}, {.68, .7, .55}, {.31, .69, .5}};
    S.triangles = {{0, 1, 2}, {0, 2, 3}};
    insertAndCheck(unitBox(), S, withSize(.14));
  }

  TEST_CASE("insertion: a surface of a single triangle") {  // its rim has three points:
                                                            // splitChords() adds some
    TriangleSurface S;
    S.points = {{.3, .3, .45}, {.7, .32, .5}, {.68, .7, .55}};
    S.triangles = {{0, 1, 2}};
    insertAndCheck(unitBox(), S, withSize(.12));
  }

  TEST_CASE("insertion: a ribbon narrower than the cubes is covered by S_M, or refused") {
    const TriangleSurface S = samples::sheet(40, 6, [](double s, double t) {
      return samples::turned(Vec3{.3 * s, .01 * t, .03 * std::sin(4 * s)}, 1, 8) +
             Vec3{.47, .46, .52};
    });
    const Mesh before = unitBox();
    Mesh M = before;
    try {
      const InsertReport report = insertSurface(M, S, withSize(.12));
      CHECK(report.hausdorff <= .12);  // S_M of two squares for a ribbon of twenty is no insertion
      CHECK(literalHausdorff(M, 1, S) <= .12);
    } catch (const MethodError&) {
      CHECK(shapes::sameMesh(M, before));
    }
  }

  TEST_CASE(
      "insertion: far from the origin and in other units, nodes on S to the coordinates' last "
      "digits") {
    const Vec3 origin{4e6, -3e6, 2e6};
    const double size = 1000;
    const TriangleSurface S = placed(samples::sine(.1, 24), origin, size);
    const Mesh before = boxMesh(origin, {size, size, size}, {2, 2, 2});
    Mesh M = before;
    const InsertReport report = insertSurface(M, S, withSize(.14 * size));
    const double lastDigit = 4e6 * std::numeric_limits<double>::epsilon();
    checkPromises(before, M, S, 1, report, 4 * lastDigit);
    Mesh near = unitBox();
    const InsertReport unit = insertSurface(near, samples::sine(.1, 24), withSize(.14));
    CHECK(near.tets.size() == M.tets.size());
    CHECK(report.smoothed.min == doctest::Approx(unit.smoothed.min).epsilon(.02));
    for (double scale : {1e-6, 1e6}) {
      CAPTURE(scale);
      Mesh scaled = boxMesh({0, 0, 0}, {scale, scale, scale}, {2, 2, 2});
      const Mesh was = scaled;
      const TriangleSurface T = placed(samples::sine(.1, 24), {0, 0, 0}, scale);
      const InsertReport r = insertSurface(scaled, T, withSize(.14 * scale));
      checkPromises(was, scaled, T, 1, r, 1e-12 * shapes::diagonal(T));
      CHECK(r.smoothed.min == doctest::Approx(unit.smoothed.min).epsilon(.02));
    }
  }

  TEST_CASE("insertion: without l_c it is chosen, told, and the promises hold") {
    const Mesh before = unitBox();
    const TriangleSurface S = samples::sine(.1, 24);
    Mesh M = before;
    std::string told;
    InsertOptions options;
    options.onProgress = [&](const std::string& line) {
      if (has(line, "chosen")) told = line;
    };
    const InsertReport report = insertSurface(M, S, options);
    checkPromises(before, M, S, 1, report, 1e-12 * shapes::diagonal(S));
    CHECK(has(told, report.size.feature));
    CHECK(report.size.lc == report.lc);
    CHECK(report.lc < shapes::diagonal(S) / 19);
    CHECK(report.hausdorff <= .5 * report.lc);
  }

  TEST_CASE("insertion: a way that stays tangled waits, and a better one is taken") {
    const Mesh before = boxMesh({0, 0, 0}, {1, 1, 1}, {5, 5, 5});
    const TriangleSurface S = samples::sine2(.2);
    Mesh M = before;
    std::vector<std::string> aside;
    InsertOptions options = withSize(.1);
    options.onProgress = [&](const std::string& line) {
      if (has(line, "put aside")) aside.push_back(line);
    };
    const InsertReport report = insertSurface(M, S, options);
    checkPromises(before, M, S, 1, report, 1e-12 * shapes::diagonal(S));
    REQUIRE(aside.size() == 1);
    CHECK(has(aside[0], "half squares"));
    CHECK(report.way == 2);
    CHECK(report.smoothed.min > .5);
  }

  TEST_CASE("insertion: a tolerance is met by the coarsest level of the bisection that does it") {
    const TriangleSurface S = samples::sine(.1, 24);
    for (double E : {.03, .006}) {
      CAPTURE(E);
      const Mesh before = unitBox();
      Mesh M = before;
      InsertOptions options;
      options.tolerance = E;
      const InsertReport report = insertSurface(M, S, options);
      checkPromises(before, M, S, 1, report, 1e-12 * shapes::diagonal(S));
      CHECK(report.hausdorff <= E);
      CHECK(literalHausdorff(M, 1, S) <= E);
      // a level coarser: no valid mesh, or farther from S
      Mesh coarse = before;
      try {
        const InsertReport other = insertSurface(coarse, S, withSize(2 * report.lc));
        CHECK((other.lc < 1.5 * report.lc || other.hausdorff > E));
      } catch (const Error&) {
        CHECK(shapes::sameMesh(coarse, before));
      }
    }
  }

  TEST_CASE("insertion: wrong tolerances are refused, one out of reach with the distance reached") {
    Mesh M = unitBox();
    const TriangleSurface S = samples::sine(.1, 24);
    InsertOptions options;
    for (double E :
         {-1., std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
      options.tolerance = E;
      CHECK(has(refusal(M, S, options, true), "tolerance"));
    }
    options.tolerance = .01, options.lc = .1;
    CHECK(has(refusal(M, S, options, true), "not both"));
    options.tolerance = 1e-5, options.lc = 0, options.maxTets = 20000;
    const std::string text = refusal(M, S, options, false);
    CAPTURE(text);
    CHECK(has(text, "within the tolerance 1e-05"));
    CHECK(has(text, "limit of 20000"));
    CHECK(has(text, "nearest"));
  }

  TEST_CASE("insertion: a second surface far from the first") {
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {4, 4, 4});
    const TriangleSurface low = sheetAt({.5, .5, .25}, .2, .03),
                          high = sheetAt({.5, .5, .74}, .2, -.03);
    insertSurface(M, low, withSize(.12));
    const Mesh before = M;
    const InsertReport report = insertSurface(M, high, withSize(.12));
    checkPromises(before, M, high, 2, report, 1e-12 * shapes::diagonal(high));
    // the first one is still there: a disk on its own surface
    CHECK(shapes::isDisk(surfaceFaces(M, 1)));
    CHECK(shapes::maxDistanceToSurface(M, 1, low) <= 1e-12 * shapes::diagonal(low));
    CHECK(M.curves.size() == before.curves.size() + 1);
  }

  TEST_CASE(
      "insertion: a second surface through or close to the first is refused or keeps the "
      "promises") {
    for (double z : {.30, .25}) {
      CAPTURE(z);
      Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {4, 4, 4});
      const TriangleSurface low = sheetAt({.5, .5, .25}, .2, .03);
      insertSurface(M, low, withSize(.16));
      const Mesh before = M;
      const TriangleSurface next = sheetAt({.55, .5, z}, .2, .06);
      InsertOptions options = withSize(.16);
      options.optimize.maxSweeps = 20;  // a hopeless case need not take long here
      try {
        const InsertReport report = insertSurface(M, next, options);
        checkPromises(before, M, next, 2, report, 1e-12 * shapes::diagonal(next));
        CHECK(shapes::isDisk(surfaceFaces(M, 1)));
        CHECK(shapes::maxDistanceToSurface(M, 1, low) <= 1e-12 * shapes::diagonal(low));
      } catch (const Error&) {
        CHECK(shapes::sameMesh(M, before));
      }
    }
  }

  TEST_CASE("failure: every surface that checkSurface refuses leaves the mesh as it was") {
    const double nan = std::numeric_limits<double>::quiet_NaN();
    const TriangleSurface good = samples::sine(.1, 4);
    auto changed = [&](const std::function<void(TriangleSurface&)>& change) {
      TriangleSurface S = good;
      change(S);
      return S;
    };
    const std::size_t last = good.points.size();
    const struct {
      const char* what;
      TriangleSurface S;
    } tries[] = {{"empty", TriangleSurface()},
                 {"no triangles", changed([](TriangleSurface& S) { S.triangles.clear(); })},
                 {"only zero area", changed([](TriangleSurface& S) {
                    S.triangles = {{0, 1, 1}, {0, 1, 2}};
                  })},
                 {"index", changed([](TriangleSurface& S) { S.triangles[3][1] = 1000; })},
                 {"negative index", changed([](TriangleSurface& S) { S.triangles[3][1] = -1; })},
                 {"not a number", changed([&](TriangleSurface& S) { S.points[7].y = nan; })},
                 {"infinite", changed([](TriangleSurface& S) {
                    S.points[7].z = std::numeric_limits<double>::infinity();
                  })},
                 {"three at an edge", changed([&](TriangleSurface& S) {
                    S.points.push_back({.5, .5, .8});
                    S.triangles.push_back({6, 7, static_cast<int>(last)});
                    S.triangles.push_back({7, 12, static_cast<int>(last)});
                  })},
                 {"two parts", changed([&](TriangleSurface& S) {
                    const int n = static_cast<int>(last);
                    S.points.insert(S.points.end(), {{.4, .4, .8}, {.5, .4, .8}, {.4, .5, .8}});
                    S.triangles.push_back({n, n + 1, n + 2});
                  })},
                 {"a hole",
                  changed([](TriangleSurface& S) { S.triangles.erase(S.triangles.begin() + 11); })},
                 {"meet at a point", changed([&](TriangleSurface& S) {
                    const int n = static_cast<int>(last);
                    S.points.insert(S.points.end(), {{.1, .1, .5}, {.1, .2, .5}});
                    S.triangles.push_back({0, n, n + 1});
                  })},
                 {"closed",
                  [] {
                    TriangleSurface S;
                    S.points = {{.4, .4, .4}, {.6, .4, .4}, {.4, .6, .4}, {.4, .4, .6}};
                    S.triangles = {{0, 2, 1}, {0, 1, 3}, {1, 2, 3}, {0, 3, 2}};
                    return S;
                  }()},
                 {"a Moebius band", [] {
                    TriangleSurface S;
                    constexpr int n = 20;
                    for (int i = 0; i < n; ++i) {
                      const double a = 2 * samples::pi * i / n;
                      for (double r : {-.06, .06}) {
                        const double out = .25 + r * std::cos(a / 2);
                        S.points.push_back({.5 + out * std::cos(a), .5 + out * std::sin(a),
                                            .5 + r * std::sin(a / 2)});
                      }
                    }
                    for (int i = 0; i < n; ++i) {
                      const int a = 2 * i, b = a + 1, c = i + 1 < n ? a + 2 : 1,
                                d = i + 1 < n ? a + 3 : 0;
                      S.triangles.push_back({a, c, b});
                      S.triangles.push_back({b, c, d});
                    }
                    return S;
                  }()}};
    for (const auto& t : tries) {
      CAPTURE(t.what);
      Mesh M = unitBox();
      const std::string text = refusal(M, t.S, withSize(.14), true);
      CAPTURE(text);
      CHECK(text.size() > 20);
      CHECK(has(text, "3.1"));
    }
  }

  TEST_CASE("failure: a mesh that breaks 3.1 is refused and stays as it was") {
    const TriangleSurface S = samples::sine(.1, 8);
    Mesh inverted = unitBox();
    inverted.x[13] = {2, 2, 2};
    CHECK(shapes::countInverted(inverted) > 0);
    CHECK(has(refusal(inverted, S, withSize(.14), true), "inverted"));
    Mesh flat = unitBox();
    flat.x[13] = flat.x[12];
    CHECK(has(refusal(flat, S, withSize(.14), true), "inverted"));
    Mesh none = unitBox();
    none.xi.clear();
    CHECK(has(refusal(none, S, withSize(.14), true), "computational coordinates"));
    Mesh empty;
    CHECK(has(refusal(empty, S, withSize(.14), true), "no tetrahedra"));
    Mesh bare = shapes::oneTetrahedron();
    CHECK(has(refusal(bare, S, withSize(.14), true), "computational coordinates"));
    Mesh unlabelled = unitBox();
    unlabelled.faceLabel.clear();
    CHECK(has(refusal(unlabelled, S, withSize(.14), true), "labels"));
    Mesh nodeless = unitBox();
    nodeless.dimension.pop_back();
    CHECK(refusal(nodeless, S, withSize(.14), true) != "");
  }

  TEST_CASE(
      "failure: a host's mesh with indices or numbers out of range is refused, not followed") {
    const TriangleSurface S = samples::sine(.1, 8);
    auto refused = [&](const std::function<void(Mesh&)>& spoil, const char* word) {
      Mesh M = unitBox();
      spoil(M);
      const std::string text = refusal(M, S, withSize(.14), true);
      CHECK_MESSAGE(has(text, word), text);
    };
    refused([](Mesh& M) { M.tets[3][2] = 999; }, "tetrahedron 3");
    refused([](Mesh& M) { M.tets[3][2] = -1; }, "tetrahedron 3");
    refused([](Mesh& M) { M.type[5] = 2; }, "tetrahedron 5");
    refused([](Mesh& M) { M.faceLabel[7][0] = 1; }, "tetrahedron 7");
    refused([](Mesh& M) { std::reverse(M.tets.begin(), M.tets.end()); }, "in the order of the tet");
    refused([](Mesh& M) { M.entity[1] = 77; }, "node 1");
    refused([](Mesh& M) { M.dimension[13] = 9; }, "node 13");
    refused([](Mesh& M) { M.patches.clear(); }, "out of range");
    refused([](Mesh& M) { M.corners[0].on[0].curve = 13; }, "curve");
    refused([](Mesh& M) { M.curves[2].points.clear(); }, "curve 3 needs two points");
    refused([](Mesh& M) { M.curves[3].s.pop_back(); }, "curve 4 needs two points");
    refused([](Mesh& M) { M.curves[4].s[1] = -1; }, "curve 5 has arc lengths");
    refused([](Mesh& M) { M.curves[5].sides[0].surface = 1; }, "curve 6 has a side");
    refused([](Mesh& M) { M.curves[6].sides[1].u.pop_back(); }, "curve 7 has a side");
    refused([](Mesh& M) { M.patches[1].u.clear(); }, "patch 2 needs points");
    refused([](Mesh& M) { M.patches[2].triangles[0][1] = 4; }, "patch 3 has a triangle");
    refused([](Mesh& M) { M.patches[3].gridSize = 0; }, "call buildLocator() first");
    refused([](Mesh& M) { M.x[13].y = HUGE_VAL; }, "node 13");
    refused(
        [](Mesh& M) {
          for (Vec3& xi : M.xi) xi.z -= 1;
        },
        "out of range");
    for (double edge : {1e200, -.5, 0.}) refused([&](Mesh& M) { M.cube = {edge, .5, .5}; }, "cube");
  }

  TEST_CASE("failure: options out of range leave the mesh as it was") {
    const TriangleSurface S = samples::sine(.1, 16);
    Mesh M = unitBox();
    for (double lc : {-.1, .5, 1e-6, std::nan("")})
      CHECK(has(refusal(M, S, withSize(lc), true), "l_c"));
    InsertOptions small = withSize(.12);
    small.maxTets = 100;
    CHECK(has(refusal(M, S, small, true), "limit"));
    small.maxTets = -5;
    CHECK(has(refusal(M, S, small, true), "maxTets"));
    InsertOptions steep = withSize(.12);
    steep.optimize.power = 1000;
    CHECK(has(refusal(M, S, steep, true), "power"));
    CHECK(cubeLevel(M, 1e-300) <= 255);  // ends
  }

  TEST_CASE("failure: what is outside, too near, too small or too much is told with its numbers") {
    const TriangleSurface S = samples::sine(.1, 16);
    auto refused = [&](const TriangleSurface& of, const InsertOptions& options,
                       const std::vector<std::string>& words) {
      Mesh M = unitBox();
      const std::string text = refusal(M, of, options, true);
      for (const std::string& word : words) CHECK_MESSAGE(has(text, word), text);
    };
    const InsertOptions options = withSize(.14);
    refused(
        placed(S, {.5, 0, 0}, 1), options,
        {"S touches or leaves the domain near (", "is within (0, 0, 0) to (1, 1, 1); it must lie"});
    refused(placed(S, {2, 0, 0}, 1), options, {"S touches or leaves the domain near ("});
    double right = 0;
    for (Vec3 x : S.points) right = std::max(right, x.x);
    refused(placed(S, {1 - right, 0, 0}, 1), options,
            {"S touches or leaves the domain at triangle ", " near (1, ", "it must lie inside"});
    TriangleSurface far = S;
    for (double z : {-2., 1e9, 1e19}) {
      far.points[12].z = z;
      refused(far, options, {"S touches or leaves the domain near (", "it must lie inside"});
      refused(far, InsertOptions{}, {"S touches or leaves the domain near ("});
      Mesh M = unitBox();
      CHECK_THROWS_AS(insertSurfaces(M, {far}, options), InputError);
    }
    for (double z : {1e30, -1e100, 1e308}) {
      far.points[12].z = z;
      refused(far, options, {"point 12 has the coordinates (", "must be below 1e20"});
      std::vector<std::string> warnings;
      CHECK_THROWS_AS(weldSurface(far, warnings), InputError);
    }
    refused(S, withSize(.6), {"l_c = 0.6 is not below dist(∂M, S) = 0.", "near (", "lower l_c"});
    refused(placed(S, {.45, .45, .45}, .1), options,
            {"S, of extent 0.", "smaller than two cubes of edge", "lower l_c to 0."});
    InsertOptions few = options;
    few.maxTets = 100;
    refused(S, few, {"l_c = 0.14 asks for about", "above the limit of 100; raise l_c"});
    InsertOptions many = withSize(1e-6);
    many.maxTets = 500000000;
    refused(placed(S, {.5, .5, .5}, 2e-5), many, {"is below 1/500000 of the domain; raise l_c"});
  }

  TEST_CASE("failure: an optimization that may not end is refused, and the mesh stays as it was") {
    Mesh M = unitBox();
    InsertOptions options = withSize(.14, InsertOptions::paper());
    options.optimize.maxSweeps = 1;  // no time to untangle
    const std::string text = refusal(M, samples::sine(.2, 24), options, false);
    CAPTURE(text);
    CHECK(has(text, "inverted"));
    CHECK(has(text, "lower l_c"));
  }

  TEST_CASE("failure: a knife ridge below the cubes is refused, or keeps the promises") {
    const Mesh before = unitBox();
    const TriangleSurface S = samples::ridge(samples::Ridge::knife);
    Mesh M = before;
    InsertOptions options = withSize(.12);
    options.optimize.maxSweeps = 40;
    try {
      const InsertReport report = insertSurface(M, S, options);
      checkPromises(before, M, S, 1, report, 1e-12 * shapes::diagonal(S));
      CAPTURE(report.hausdorff / report.lc);
      CAPTURE(report.smoothed.min);
      CHECK(report.hausdorff <= .3 * report.lc);  // its faces there are made smaller
    } catch (const MethodError& error) {
      CHECK(has(error.what(), "no valid mesh at l_c"));
      CHECK(shapes::sameMesh(M, before));
    }
  }

  TEST_CASE("failure: sheets in layers, of which S_M sees the outer ones only, are refused") {
    const double half = .2, gap = .02;
    const int layers = 24;
    const TriangleSurface S = samples::sheet(10, 12 * layers, [=](double s, double t) {
      const double p = .5 * (t + 1) * layers;  // to and fro along x
      const int layer = std::min(static_cast<int>(p), layers - 1);
      const double along = p - layer, x = half * (2 * along - 1);
      const double z = gap * (layer + along * along * along - .5 * layers);
      return Vec3{.5 + (layer % 2 ? -x : x), .5 + half * s, .5 + z};
    });
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {3, 3, 3});
    const std::string text = refusal(M, S, withSize(.12), false);
    CAPTURE(text);
    CHECK(has(text, "S_M leaves out the part of S near ("));
    CHECK(has(text, "sheets of S that face each other is 0.00"));
    CHECK(has(text, "lower l_c to 0.00"));
  }

  TEST_CASE("failure: an exception of the host's own callback leaves the mesh as it was") {
    for (const char* name :
         {"approximated", "healed", "extracted", "surfaceHealed", "projected", "smoothed"}) {
      Mesh M = unitBox();
      const Mesh before = M;
      InsertOptions options = withSize(.14);
      options.onStage = [&](const char* stage, const Mesh&) {
        if (std::string(stage) == name) throw std::runtime_error("stop");
      };
      CHECK_THROWS_WITH(insertSurface(M, samples::sine(.1, 16), options), "stop");
      CHECK(shapes::sameMesh(M, before));
    }
  }
}
