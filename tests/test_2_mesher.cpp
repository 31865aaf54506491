// SPDX-License-Identifier: MIT
//
// §2: Algorithm 1 on terrain and on solids. Distances are measured here anew, without the mesher's.
#include <doctest/doctest.h>

#include "../samples/surfaces.hpp"
#include "shapes.hpp"
#include "solids.hpp"

using namespace meccano;

namespace {

MesherOptions withEps(double eps) {
  MesherOptions options;
  options.eps = eps;
  return options;
}

/// A ball with a horn, as high as h, as wide as w.
TriangleSurface horn(int n, double h, double w) {
  return solids::ball(n, [h, w](Vec3 p) {
    return (1 + h * std::exp(-norm2(p - Vec3{.6, .48, .64}) / (w * w))) * p;
  });
}

/// The number after `what` in a line.
double numberAfter(const std::string& line, const std::string& what) {
  return std::stod(line.substr(line.find(what) + what.size()));
}

/// The lines of progress that begin so.
struct Lines {
  std::vector<std::string> all = {};
  MesherOptions listen(double eps, const std::string& begin) {
    MesherOptions options = withEps(eps);
    options.onProgress = [this, begin](const std::string& line) {
      if (line.rfind(begin, 0) == 0) all.push_back(line);
    };
    return options;
  }
};

/// A hill of a smooth formula, 24 x 20 points of 50 m, not symmetric.
Terrain hill() {
  Terrain T;
  T.nx = 24, T.ny = 20, T.cell = 50, T.origin = {300, -200}, T.top = 900;
  for (int j = 0; j < T.ny; ++j)
    for (int i = 0; i < T.nx; ++i)
      T.z.push_back(200 * std::exp(-.02 * ((i - 9) * (i - 9) + (j - 12) * (j - 12))) + 2 * i);
  T.cells = {4, 3, 3};
  return T;
}

template <class F>
std::string messageOf(F f) {
  try {
    f();
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
  TEST_CASE("Algorithm 1: a terrain box is valid, its bottom within eps of the bilinear heights") {
    const Terrain T = hill();
    Mesh M;
    const MesherReport r = meccanoMesher(M, T, withEps(4));
    CHECK(shapes::countInverted(M) == 0);
    CHECK(shapes::conformityFault(M) == "");
    CHECK(r.smoothed.min > .5);
    CHECK(r.distance.largest() <= 4);
    // upright distances bound the nearest ones: of the mesh from the terrain, and the other way
    const auto bottom = surfaceFaces(M, -5);
    double worst = 0;
    for (const auto& f : bottom)
      for (int a = 0; a <= 8; ++a)
        for (int b = 0; a + b <= 8; ++b) {
          const Vec3 p =
              (a / 8.) * M.x[f[0]] + (b / 8.) * M.x[f[1]] + ((8 - a - b) / 8.) * M.x[f[2]];
          worst = std::max(worst, std::abs(p.z - heightAt(T, p.x, p.y)));
        }
    CHECK(worst <= 4 * 1.2);  // upright on slopes up to 35 degrees
    TriangleSurface S;
    S.points = M.x, S.triangles = bottom;
    TriangleSurface fine;
    constexpr int n = 60;
    for (int j = 0; j <= n; ++j)
      for (int i = 0; i <= n; ++i) {
        const double x = 300 + 1150. * i / n, y = -200 + 950. * j / n;
        fine.points.push_back({x, y, heightAt(T, x, y)});
        if (i > 0 && j > 0) {
          const int k = j * (n + 1) + i;
          fine.triangles.push_back({k - n - 2, k - n - 1, k});
          fine.triangles.push_back({k - n - 2, k, k - 1});
        }
      }
    CHECK(solids::sampledDistance(fine.points, fine.triangles, S, 1) <= 4);
  }

  TEST_CASE("Algorithm 1: the sides of a terrain box stay in their planes, the top flat") {
    Mesh M;
    const Terrain T = hill();
    meccanoMesher(M, T, withEps(8));
    const double plane[6] = {300, 300 + 23 * 50., -200, -200 + 19 * 50., 0, 900};
    for (int p = 1; p <= 6; ++p) {
      CAPTURE(p);
      double worst = 0;
      for (const auto& f : surfaceFaces(M, -p))
        for (int n : f) {
          const double at[3] = {M.x[n].x, M.x[n].y, M.x[n].z};
          if (p != 5) worst = std::max(worst, std::abs(at[(p - 1) / 2] - plane[p - 1]));
          if (p == 5) worst = std::max(worst, std::abs(at[2] - heightAt(T, at[0], at[1])) - .8);
        }
      CHECK(worst < 1e-9);
    }
  }

  TEST_CASE("distance: that of a coarse mesh is what it is, and falls as eps is lowered") {
    Mesh coarse, fine;
    const MesherReport a = meccanoMesher(coarse, hill(), withEps(30));
    const MesherReport b = meccanoMesher(fine, hill(), withEps(3));
    CHECK(a.distance.largest() <= 30);
    CHECK(b.distance.largest() <= 3);
    CHECK(a.distance.largest() > 3);
    CHECK(fine.tets.size() > 2 * coarse.tets.size());
    CHECK(b.depth > a.depth);
    CHECK(b.depth < 30);
    CHECK(distance(coarse).largest() == doctest::Approx(a.distance.largest()));
    // a node of the bottom pulled away is found
    Mesh pulled = coarse;
    for (std::size_t n = 0; n < pulled.x.size(); ++n)
      if (pulled.dimension[n] == 2 && pulled.entity[n] == -5) {
        pulled.x[n].z += 200;
        break;
      }
    CHECK(distance(pulled).largest() > 60);
  }

  TEST_CASE("getTrianglesToRefine, refineTriangles: exactly the far triangles, conforming, on Pi") {
    Mesh M;
    meccanoMesher(M, hill(), withEps(60));
    const BoundaryDistance d = distance(M);
    CHECK(getTrianglesToRefine(M, d, 2 * d.largest()).empty());
    const TriangleList tau = getTrianglesToRefine(M, d, .5 * d.largest());
    REQUIRE(!tau.empty());
    for (const BoundaryTriangle& t : tau) CHECK(d.ofFace[t.E][t.i] > .5 * d.largest());
    const std::size_t nodes = M.x.size();
    Bisection B(M);
    const TriangleList tauNew = refineTriangles(B, tau);
    projectNewNodesToBoundary(M, tauNew);
    CHECK(M.x.size() > nodes);
    CHECK(shapes::conformityFault(M) == "");
    const Terrain T = hill();
    for (std::size_t n = nodes; n < M.x.size(); ++n)
      if (M.dimension[n] == 2 && M.entity[n] == -5)
        CHECK(std::abs(M.x[n].z - heightAt(T, M.x[n].x, M.x[n].y)) < 6);
  }

  TEST_CASE("Algorithm 1: a sphere, both distances within eps, sliding lifts the quality") {
    const TriangleSurface S = solids::sphere(12);
    const double eps = .03;
    Mesh M, fixed;
    const MesherReport r = meccanoMesher(M, S, withEps(eps));
    MesherOptions options = withEps(eps);
    options.fixedBoundary = true;
    const MesherReport f = meccanoMesher(fixed, S, options);
    for (const Mesh* m : {&M, &fixed}) {
      CHECK(shapes::countInverted(*m) == 0);
      CHECK(shapes::conformityFault(*m) == "");
      const auto faces = solids::boundaryOf(*m);
      TriangleSurface own;
      own.points = m->x, own.triangles = faces;
      CHECK(solids::sampledDistance(m->x, faces, S, 6) <= eps);
      CHECK(solids::sampledDistance(S.points, S.triangles, own, 4) <= eps);
    }
    CHECK(r.smoothed.min >= .5);
    CHECK(r.smoothed.mean >= f.smoothed.mean);
    CHECK(f.rounds == 0);
    CHECK(r.depth < 40);
    Mesh again;
    meccanoMesher(again, S, withEps(eps));
    CHECK(shapes::sameMesh(M, again));
  }

  TEST_CASE(
      "Algorithm 1: a surface is inserted into a solid, boundary nodes stay on their patches") {
    Mesh M;
    meccanoMesher(M, solids::sphere(8), withEps(.1));
    InsertOptions options;
    options.lc = .3;
    TriangleSurface S = samples::sheet(20, 20, [](double s, double t) {
      return Vec3{.35 * s, .35 * t, .1 * s * t};
    });
    const InsertReport r = insertSurface(M, S, options);
    CHECK(r.smoothed.inverted == 0);
    CHECK(shapes::countInverted(M) == 0);
    double worst = 0;
    for (std::size_t n = 0; n < M.x.size(); ++n)
      if (M.dimension[n] == 2 && M.entity[n] < 0)
        worst = std::max(worst, norm(M.x[n] - varphi(surfaceOf(M, M.entity[n]), M.parameter[n])));
    CHECK(worst < 1e-12);
  }

  TEST_CASE("meccanoMesher: what is refused, and the mesh then unchanged") {
    Mesh M = shapes::kuhnCube();
    const Mesh before = M;
    const auto refusal = [&](Terrain T, MesherOptions options) {
      return messageOf([&] { meccanoMesher(M, T, options); });
    };
    for (double eps : {0., -1., std::numeric_limits<double>::infinity()})
      CHECK(has(refusal(hill(), withEps(eps)), "must be above 0"));
    CHECK(has(refusal(hill(), withEps(1e-3)), "eps = 0.001 is too small for the terrain's grid, "));
    MesherOptions few = withEps(.5);
    few.maxTets = 2000;
    CHECK(has(refusal(hill(), few), "above the limit of 2000; raise eps or maxTets"));
    MesherOptions negative = withEps(.05);
    negative.optimize.threads = -1;
    int lines = 0;
    negative.onProgress = [&lines](const std::string&) { ++lines; };
    CHECK(has(messageOf([&] { meccanoMesher(M, solids::sphere(8), negative); }), "threads = -1"));
    CHECK(lines == 0);  // before any work
    Terrain high = hill();
    high.top = 150;
    CHECK(has(refusal(high, withEps(4)), "is not below the top 150; raise the top"));
    Terrain broken = hill();
    broken.z[7] = std::numeric_limits<double>::quiet_NaN();
    CHECK(has(refusal(broken, withEps(4)), "at grid point (7, 0) is not finite"));
    broken.z.pop_back();
    CHECK(has(refusal(broken, withEps(4)), "a height for each"));
    CHECK(shapes::sameMesh(M, before));
  }

  TEST_CASE("Algorithm 1: the number of threads does not change a byte, where the guard is asked") {
    Mesh one;
    for (int threads : {1, 3}) {
      MesherOptions options = withEps(.008);
      options.optimize.threads = threads;
      Mesh M;
      const MesherReport r = meccanoMesher(M, solids::sphere(16), options);
      REQUIRE(r.rounds > 0);
      if (threads == 1) one = M;
      CHECK(shapes::sameMesh(M, one));
    }
  }

  TEST_CASE("qualityOptimization: no face slides farther from the solid than the guard allows") {
    constexpr double eps = .04, guards[] = {3, 2, .8}, refined = 1;  // of eps: 1 before it slides
    Lines rounds;
    Mesh M;
    meccanoMesher(M, horn(16, 1, .3), rounds.listen(eps, "round"));
    REQUIRE(rounds.all.size() >= 3);
    for (int k = 0; k < 3; ++k) {
      CAPTURE(rounds.all[k]);
      CHECK(numberAfter(rounds.all[k], "distance ") <= 1.03 * eps * std::max(guards[k], refined));
    }
    CHECK(numberAfter(rounds.all[0], "distance ") > eps);  // it does slide
  }

  TEST_CASE("qualityOptimization: a solid that tangles at once is approached from coarse to fine") {
    Lines refined, sizes;
    Mesh M;
    meccanoMesher(M, solids::blob(16), refined.listen(.04, "refined"));
    meccanoMesher(M, solids::blob(16), sizes.listen(.04, "fixed boundary"));
    REQUIRE(refined.all.size() == 1);
    REQUIRE_FALSE(has(refined.all[0], ", 0 inverted"));
    REQUIRE(sizes.all.size() > 4);
    const double atOnce = numberAfter(refined.all[0], "refined: ");
    double before = 0;
    for (int k = 0; k < 4; ++k) {  // 16, 8, 4, 2 eps
      CAPTURE(sizes.all[k]);
      const double tets = numberAfter(sizes.all[k], "fixed boundary: ");
      CHECK(has(sizes.all[k], ", 0 inverted"));
      CHECK(tets > before);
      CHECK(tets < .8 * atOnce);
      before = tets;
    }
    CHECK(shapes::countInverted(M) == 0);
  }

  TEST_CASE("qualityOptimization: elements that the guard holds at low quality are bisected") {
    Lines rounds;
    Mesh M;
    const MesherReport r = meccanoMesher(M, horn(20, 3, .15), rounds.listen(.08, "round"));
    REQUIRE(rounds.all.size() > 3);
    const double third = numberAfter(rounds.all[2], "min ");
    REQUIRE(third < .3);
    CHECK(numberAfter(rounds.all[3], ": ") > numberAfter(rounds.all[2], ": "));  // tetrahedra
    CHECK(r.smoothed.min > 2 * third);
    CHECK(shapes::countInverted(M) == 0);
  }

  TEST_CASE(
      "meccanoMesher: an eps that the solid's bends tell to be far too small is refused first") {
    const TriangleSurface S = solids::sphere(12);
    Mesh M = shapes::kuhnCube();
    const Mesh before = M;
    MesherOptions options = withEps(1e-4);
    options.maxTets = 100000;
    int lines = 0;
    options.onProgress = [&](const std::string&) { ++lines; };
    const std::string text = messageOf([&] { meccanoMesher(M, S, options); });
    CAPTURE(text);
    CHECK(has(text, "above the limit of 100000; raise eps or maxTets"));
    CHECK(lines == 0);  // before any work
    CHECK(shapes::sameMesh(M, before));
    // a lower bound: what it asks for is there where the limit lets it be
    options = withEps(.03);
    meccanoMesher(M, S, options);
    options.maxTets = static_cast<int>(M.tets.size());
    Mesh again;
    meccanoMesher(again, S, options);
    CHECK(shapes::sameMesh(M, again));
    // sharp edges, which patch edges follow, ask for nothing
    options = withEps(1e-6);
    options.maxTets = 1000;
    meccanoMesher(again, solids::polycube({{0, 0, 0}}, 4, [](Vec3 p) { return p; }), options);
    CHECK(again.tets.size() < 1000);
  }

  TEST_CASE("qualityOptimization: --max-tets holds in the rounds of sliding, with the message") {
    const TriangleSurface S = solids::ellipsoid(8, {1, 1.6, 2.4});
    MesherOptions options = withEps(.03);
    int refined = 0, largest = 0;
    options.onStage = [&](const char* name, const Mesh& M) {
      if (std::string(name) == "refined") refined = static_cast<int>(M.tets.size());
      largest = std::max(largest, static_cast<int>(M.tets.size()));
    };
    Mesh M = shapes::kuhnCube();
    meccanoMesher(M, S, options);
    REQUIRE(largest > refined);
    const Mesh before = M;
    options.maxTets = refined + 1;
    largest = 0;
    const std::string text = messageOf([&] { meccanoMesher(M, S, options); });
    CHECK(has(text, "above the limit of " + std::to_string(options.maxTets)));
    CHECK(largest == refined);
    CHECK(shapes::sameMesh(M, before));
  }

  TEST_CASE("heightAt, terrainCells, terrainEps: bilinear, near-cubic, 1/500 of the diagonal") {
    Terrain T = hill();
    CHECK(heightAt(T, 300 + 50 * 3, -200 + 50 * 4) == doctest::Approx(T.z[4 * 24 + 3]));
    const double middle = .25 * (T.z[0] + T.z[1] + T.z[24] + T.z[25]);
    CHECK(heightAt(T, 325, -175) == doctest::Approx(middle));
    const Vec2 far{300 + 50. * (T.nx - 1), -200 + 50. * (T.ny - 1)};
    CHECK(heightAt(T, far.x, far.y) == T.z.back());
    CHECK(heightAt(T, far.x + 70, far.y + 90) == T.z.back());  // outside: as on the border
    CHECK(heightAt(T, 0, -900) == T.z.front());
    T.cells = {0, 0, 0};
    const std::array<int, 3> n = terrainCells(T);
    const double hx = 1150. / n[0], hy = 950. / n[1];
    CHECK(n[0] == 8);
    CHECK(std::abs(hx / hy - 1) < .2);
    CHECK(terrainEps(T) > 2);
    CHECK(terrainEps(T) < 4);
  }
}
