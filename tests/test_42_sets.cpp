// SPDX-License-Identifier: MIT
// §4.2: several surfaces in one call, one after the other, near each other, and refused together.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <string>
#include <vector>

#include "../meccano.hpp"
#include "../samples/surfaces.hpp"
#include "shapes.hpp"

using namespace meccano;

namespace {

/// A square sheet of this half width around c, a little bent.
TriangleSurface sheetAt(Vec3 c, double half, double bend, const std::string& name) {
  TriangleSurface S = samples::sheet(8, 8, [=](double s, double t) {
    return c + Vec3{half * s, half * t, bend * s * t + .5 * bend * s * s};
  });
  S.name = name;
  return S;
}

Mesh box() { return boxMesh({0, 0, 0}, {1, 1, 1}, {4, 4, 4}); }

InsertOptions withSize(double lc) {
  InsertOptions options;
  options.lc = lc;
  options.optimize.power = 1;  // speed: what is promised holds without
  return options;
}

const TriangleSurface& named(const std::vector<TriangleSurface>& S, const std::string& name) {
  for (const TriangleSurface& one : S)
    if (one.name == name) return one;
  FAIL("no surface " << name);
  return S[0];
}

/// A sheet around the middle of the unit cube, cut from there to its rim along x = .5. Its points
/// are moved by move(d, half): d from the middle, −1 the left half, 1 the right one.
TriangleSurface slitSheet(int n, const std::function<Vec3(Vec3 d, int half)>& move) {
  const Vec3 middle{.5, .5, .5};
  TriangleSurface S = samples::sheet(n, n, [&](double s, double t) {
    return middle + .3 * Vec3{s, t, 0};
  });
  const std::size_t count = S.points.size();
  std::vector<int> twin(count, -1);  // on the right side of the cut
  for (std::size_t i = 0; i < count; ++i)
    if (const Vec3 p = S.points[i]; std::abs(p.x - .5) < 1e-9 && p.y > .51)
      twin[i] = static_cast<int>(S.points.size()), S.points.push_back(p);
  for (auto& t : S.triangles) {
    const bool isRight = S.points[t[0]].x + S.points[t[1]].x + S.points[t[2]].x > 1.5;
    for (int& i : t)
      if (isRight && twin[i] >= 0) i = twin[i];
  }
  for (std::size_t i = 0; i < S.points.size(); ++i) {
    const Vec3 d = S.points[i] - middle;
    S.points[i] += move(d, i < count && d.x < 1e-9 ? -1 : 1);
  }
  return S;
}

/// Each surface of the call is a disk of the mesh on its own S, by its name.
void checkSurfaces(const Mesh& M, const std::vector<TriangleSurface>& S,
                   const std::vector<InsertReport>& reports) {
  CHECK(shapes::countInverted(M) == 0);
  CHECK(shapes::conformityFault(M) == "");
  CHECK(shapes::totalVolume(M) == doctest::Approx(1).epsilon(1e-10));
  REQUIRE(reports.size() == S.size());
  REQUIRE(M.surfaces.size() == S.size());
  std::vector<int> surfaceAt(M.x.size(), 0);
  int shared = 0;
  for (std::size_t i = 0; i < S.size(); ++i) {
    const int k = static_cast<int>(i) + 1;
    const TriangleSurface& one = named(S, M.surfaces[i].name);
    CHECK(reports[i].surface == k);
    const std::vector<shapes::Face> faces = surfaceFaces(M, k);
    CHECK(shapes::isDisk(faces));
    const double distance = shapes::maxDistanceToSurface(M, k, one);
    CHECK(distance <= 1e-12 * shapes::diagonal(one));
    CHECK(reports[i].triangles == static_cast<int>(faces.size()));  // as it is at the end
    CHECK(reports[i].hausdorff <= .3 * reports[i].lc);
    for (const shapes::Face& f : faces)
      for (int n : f) {
        shared += surfaceAt[n] != 0 && surfaceAt[n] != k;  // faces of two surfaces do not touch
        surfaceAt[n] = k;
      }
  }
  CHECK(shared == 0);
  CHECK(reports.back().smoothed.min == qualityStatistics(M).min);
}

std::string refusal(Mesh& M, const std::vector<TriangleSurface>& S, const InsertOptions& options) {
  const Mesh before = M;
  std::string text;
  try {
    insertSurfaces(M, S, options);
  } catch (const Error& error) {
    text = error.what();
  }
  CHECK(shapes::sameMesh(M, before));
  return text;
}

bool has(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

TriangleSurface together(const TriangleSurface& A, const TriangleSurface& B) {
  TriangleSurface S = A;
  const int n = static_cast<int>(A.points.size());
  S.points.insert(S.points.end(), B.points.begin(), B.points.end());
  for (const auto& t : B.triangles) S.triangles.push_back({t[0] + n, t[1] + n, t[2] + n});
  return S;
}

}  // namespace

TEST_SUITE("4.2") {
  TEST_CASE(
      "sets: three surfaces in one call: the largest first, in whichever order they are listed") {
    std::vector<TriangleSurface> S{sheetAt({.45, .5, .3}, .2, .03, "large"),
                                   sheetAt({.55, .5, .52}, .18, -.03, "middle"),
                                   sheetAt({.5, .5, .72}, .15, .02, "small")};
    const InsertOptions options = withSize(.16);
    Mesh M = box();
    const std::vector<InsertReport> reports = insertSurfaces(M, S, options);
    checkSurfaces(M, S, reports);
    Mesh oneByOne = box();
    for (const TriangleSurface& one : S) insertSurface(oneByOne, one, options);
    CHECK(shapes::sameMesh(M, oneByOne));
    std::reverse(S.begin(), S.end());
    Mesh reversed = box();
    insertSurfaces(reversed, S, options);
    CHECK(shapes::sameMesh(M, reversed));
    Mesh smallestFirst = box();
    for (const TriangleSurface& one : S) insertSurface(smallestFirst, one, options);
    CHECK(shapes::countInverted(smallestFirst) == 0);
  }

  TEST_CASE("sets: surfaces nearer than l_c, down to half a cube") {
    for (double gap : {.1, .05}) {
      CAPTURE(gap);
      const std::vector<TriangleSurface> S{sheetAt({.5, .5, .48}, .2, .03, "a"),
                                           sheetAt({.52, .48, .48 + gap}, .2, .03, "b")};
      Mesh M = box();
      const std::vector<InsertReport> reports = insertSurfaces(M, S, withSize(.16));
      checkSurfaces(M, S, reports);
      CHECK(reports[1].lc == .16);  // two surfaces leave each other a free side
    }
  }

  TEST_CASE("sets: a surface that lowers q is smoothed once more together with the earlier ones") {
    const auto tilted = [](Vec3 c, double half, double bend, double tilt) {
      return samples::sheet(8, 8, [=](double s, double t) {
        return c + Vec3{half * s, half * t, tilt * s + bend * s * t + .5 * bend * s * s};
      });
    };
    Mesh M = box();
    InsertOptions options;
    options.lc = .1;
    insertSurface(M, tilted({.5, .5, .4}, .3, .05, .05), options);
    bool together = false;
    options.onProgress = [&together](const std::string& line) {
      together = together || has(line, "all nodes once more");
    };
    const InsertReport report = insertSurface(M, tilted({.5, .5, .58}, .2, .02, .2), options);
    CHECK(together);
    CHECK(report.smoothed.min >= .6);  // .577 by the nodes near S alone
    CHECK(report.smoothed.min == qualityStatistics(M).min);
    CHECK(report.hausdorff <= .3 * report.lc);
  }

  TEST_CASE("sets: a surface between two near ones lowers l_c by itself, and says why") {
    const std::vector<TriangleSurface> S{sheetAt({.5, .5, .44}, .2, 0, "below"),
                                         sheetAt({.5, .5, .48}, .2, 0, "above"),
                                         sheetAt({.5, .5, .46}, .12, 0, "between")};
    Mesh M = box();
    const std::vector<InsertReport> reports = insertSurfaces(M, S, withSize(.16));
    checkSurfaces(M, S, reports);
    CHECK(reports[0].lc == .16);
    CHECK(reports[2].lc < .16);
    REQUIRE_FALSE(reports[2].warnings.empty());
    const std::string& text = reports[2].warnings[0];
    CAPTURE(text);
    CHECK(has(text, "lowered from 0.16"));
    CHECK(has(text, "is 0.02 away"));
  }

  TEST_CASE("sets: a gap that cannot be resolved is refused with the name, the distance and l_c") {
    const std::vector<TriangleSurface> S{sheetAt({.5, .5, .5}, .1, 0, "one"),
                                         sheetAt({.5, .5, .50001}, .1, 0, "too near")};
    Mesh M = box();
    InsertOptions options = withSize(.16);
    options.optimize.maxSweeps = 10;
    const std::string text = refusal(M, S, options);
    CAPTURE(text);
    CHECK(has(text, "surface 'too near'"));
    CHECK(has(text, "surface 'one' is 1e-05 away"));
    CHECK(has(text, "lower l_c to 5e-06"));
  }

  TEST_CASE("sets: coarse faces of an earlier surface that S crosses lower l_c, and are told") {
    const auto cap = [](double half, double below) {  // of a sphere of radius .45
      return samples::sheet(24, 24, [=](double s, double t) {
        const double x = half * s, y = half * t;
        return Vec3{.5 + x, .5 + y, .05 - below + std::sqrt(.45 * .45 - x * x - y * y)};
      });
    };
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
    insertSurface(M, cap(.28, 0), withSize(.2));
    InsertOptions options = withSize(.15);
    std::string lines;
    options.onProgress = [&](const std::string& line) { lines += line + "\n"; };
    const InsertReport report = insertSurface(M, cap(.1, .001), options);
    CAPTURE(lines);
    CHECK(has(lines, "l_c = 0.15 left: S crosses the faces of an earlier surface at triangle "));
    CHECK(report.lc == .075);
    REQUIRE_FALSE(report.warnings.empty());
    CHECK(has(report.warnings[0], "lowered from 0.15"));
    CHECK(shapes::countInverted(M) == 0);
  }

  TEST_CASE("sets: surfaces that cross or touch are refused with both names and the place") {
    const TriangleSurface a = sheetAt({.5, .5, .5}, .2, 0, "flat");
    TriangleSurface b = sheetAt({.5, .5, .5}, .15, 0, "upright");
    for (Vec3& p : b.points) p = {p.x, .5, p.y};
    TriangleSurface c = sheetAt({.5, .5, .5}, .1, 0, "edge");
    for (Vec3& p : c.points) p = {p.x, .5 + p.z - .5, .6 + p.y - .5};  // its rim lies in a
    for (const TriangleSurface& other : {b, c}) {
      Mesh M = box();
      const std::string text = refusal(M, {a, other}, withSize(.16));
      CAPTURE(text);
      CHECK(has(text, "'flat'"));
      CHECK(has(text, "'" + other.name + "'"));
      CHECK(has(text, "cross or touch"));
      CHECK(has(text, "near (0."));
    }
    Mesh M = box();
    insertSurface(M, a, withSize(.16));
    CHECK(has(refusal(M, {b}, withSize(.16)), "inserted surface 'flat' cross or touch"));
  }

  TEST_CASE("sets: all or none, and the message names the surface") {
    const TriangleSurface good = sheetAt({.5, .5, .4}, .2, .03, "good");
    const TriangleSurface outside = sheetAt({.5, .5, .95}, .2, 0, "near the lid");
    Mesh M = box();
    const std::string text = refusal(M, {good, outside}, withSize(.16));
    CHECK(has(text, "surface 'near the lid': insertSurface (§3.2)"));
    CHECK(has(text, "dist(∂M, S) = 0.05"));
    TriangleSurface holed = sheetAt({.5, .5, .7}, .2, 0, "");
    holed.triangles.erase(holed.triangles.begin() + 60);
    CHECK(has(refusal(M, {good, holed}, withSize(.16)), "surface 2: "));
    CHECK(has(refusal(M, {good}, withSize(-1)), "l_c"));
    CHECK(insertSurfaces(M, {}, withSize(.16)).empty());
  }

  TEST_CASE("sets: a surface of two components becomes two, each with its name") {
    const TriangleSurface a = sheetAt({.5, .5, .3}, .2, .03, "fault"),
                          b = sheetAt({.5, .5, .7}, .2, .03, "fault");
    Mesh M = box();
    const std::vector<InsertReport> reports = insertSurfaces(M, {together(a, b)}, withSize(.16));
    TriangleSurface first = a, second = b;
    first.name = "fault.1", second.name = "fault.2";
    checkSurfaces(M, {first, second}, reports);
    REQUIRE(reports[0].warnings.size() == 1);
    CHECK(has(reports[0].warnings[0], "2 components"));
    std::vector<std::string> warnings;
    CHECK(connectedComponents(a, warnings).size() == 1);
    CHECK(warnings.empty());
    TriangleSurface fan = together(a, b);  // parts that meet at a point stay one, to be refused
    fan.points[a.points.size()] = a.points[0];
    CHECK(connectedComponents(fan, warnings).size() == 1);
    CHECK(has(refusal(M, {fan}, withSize(.16)), "meet only there"));
  }

  TEST_CASE("sets: refinement splits earlier surfaces at parametric midpoints, labels hold") {
    const TriangleSurface a = sheetAt({.5, .5, .5}, .2, .05, "a");
    Mesh M = box();
    insertSurface(M, a, withSize(.2));
    const std::size_t coarse = surfaceFaces(M, 1).size(), nodes = M.x.size();
    std::vector<int> all(M.tets.size());
    for (std::size_t E = 0; E < all.size(); ++E) all[E] = static_cast<int>(E);
    for (int level = 0; level < 3; ++level) bisect(M, all);
    CHECK(surfaceFaces(M, 1).size() > coarse);
    CHECK(shapes::isDisk(surfaceFaces(M, 1)));
    CHECK(shapes::maxDistanceToSurface(M, 1, a) <= 1e-12 * shapes::diagonal(a));
    int onSurface = 0, onBoundary = 0;
    for (std::size_t n = nodes; n < M.x.size(); ++n) {
      onSurface += M.dimension[n] < 3 && M.entity[n] > 0;
      onBoundary += M.dimension[n] == 2 && M.entity[n] < 0;
    }
    CHECK(onSurface > 0);
    CHECK(onBoundary > 0);
  }

  TEST_CASE("sets: around a few elements that stay inverted the nodes descend together") {
    // a relay ramp: the halves overlap farther than they are apart
    const TriangleSurface S = slitSheet(8, [](Vec3 d, int half) {
      const double along = d.y > 0 ? std::pow(std::sin(d.y / .6 * std::acos(-1.)), 2) : 0;
      const double across = 1 - std::abs(d.x) / .3, bend = .07 * std::sin(3 * d.x + 2 * d.y);
      return half * along * across * Vec3{-.1, 0, .03} + Vec3{0, 0, bend};
    });
    InsertOptions options;
    options.lc = .13, options.outline = Outline::squares;
    Mesh M = box();
    const InsertReport report = insertSurface(M, S, options);
    CHECK(report.lc == options.lc);
    CHECK(shapes::countInverted(M) == 0);
    CHECK(shapes::isDisk(surfaceFaces(M, 1)));
    CHECK(shapes::maxDistanceToSurface(M, 1, S) <= 1e-12 * shapes::diagonal(S));
    CHECK(report.smoothed.min > .5);  // of the ways that are valid without it .35
    options.optimize.globalDescent = false;
    M = box();
    CHECK(insertSurface(M, S, options).smoothed.min < .5);
  }

  TEST_CASE("sets: a slit narrower than the cubes is bridged, its rims overlapping or not") {
    for (double overlap : {-.01, .02}) {
      CAPTURE(overlap);
      // along the cut the halves open or overlap
      const TriangleSurface S = slitSheet(24, [=](Vec3 d, int half) {
        const bool isCut = std::abs(d.x) < 1e-9 && d.y > .01;
        return isCut ? half * d.y / .3 * Vec3{-overlap, 0, .02} : Vec3{0, 0, 0};
      });
      Mesh M = box();
      InsertOptions options;
      options.lc = .12;
      const InsertReport report = insertSurface(M, S, options);
      CHECK(shapes::countInverted(M) == 0);
      CHECK(shapes::isDisk(surfaceFaces(M, 1)));
      CHECK(shapes::maxDistanceToSurface(M, 1, S) <= 1e-12 * shapes::diagonal(S));
      CHECK(report.hausdorff <= .3 * .12);
      CHECK(report.smoothed.min > .55);  // where bridges hold their nodes .33
      // the edges across the slit can be split: their new nodes stay beside them
      const std::size_t nodes = M.x.size();
      Bisection B(M);
      int astray = 0;
      for (const shapes::Face& f : surfaceFaces(M, 1))
        for (int e = 0; e < 3; ++e) {
          const int a = f[e], b = f[(e + 1) % 3], size = static_cast<int>(M.x.size());
          B.bisectEdge(a, b);
          const double length = norm(M.x[b] - M.x[a]);
          if (static_cast<int>(M.x.size()) > size)
            astray += norm(M.x.back() - .5 * (M.x[a] + M.x[b])) > 1.5 * length;
        }
      CHECK(M.x.size() > nodes);
      CHECK(astray == 0);
      CHECK(shapes::maxDistanceToSurface(M, 1, S) <= 1e-12 * shapes::diagonal(S));
    }
  }
}
