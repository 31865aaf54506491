// SPDX-License-Identifier: MIT
//
// §3.7.4: line search, Algorithm 2, untangling, errors.
#include <doctest/doctest.h>

#include <algorithm>
#include <chrono>
#include <cstring>
#include <string>
#include <thread>
#include <vector>

#include "../samples/surfaces.hpp"
#include "shapes.hpp"

using namespace meccano;

namespace {

constexpr double inf = std::numeric_limits<double>::infinity();

bool onHull(Vec3 x) {
  const auto end = [](double t) { return t < 1e-12 || t > 1 - 1e-12; };
  return end(x.x) || end(x.y) || end(x.z);
}

/// A Kuhn cube without geometry, its inner nodes shaken by up to `amount` cell edges (splitmix64).
Mesh shakenCube(int n, double amount) {
  const Mesh box = boxMesh({0, 0, 0}, {1, 1, 1}, {n, n, n});
  Mesh M;
  M.x = box.x;
  M.xi = box.xi;
  M.tets = box.tets;
  std::uint64_t state = 1;
  const auto random = [&state]() {
    std::uint64_t z = state += 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return 2 * std::ldexp(static_cast<double>((z ^ (z >> 31)) >> 11), -53) - 1;
  };
  for (Vec3& x : M.x) {
    if (onHull(x)) continue;
    const double a = random(), b = random(), c = random();
    x += (amount / n) * Vec3{a, b, c};
  }
  return M;
}

/// A cube of 4x4x4 with the node at this place fixed as far out of it as no element is inverted:
/// some are as good as flat.
Mesh cubeWithFlatElements(Vec3 place, std::vector<int>& fixed) {
  Mesh M = shakenCube(4, 0);
  for (std::size_t n = 0; n < M.x.size(); ++n)
    if (norm(M.x[n] - place) < 1e-9) fixed = {static_cast<int>(n)};
  const Vec3 out{.3, .5, .81};
  double valid = 0, inverted = 1;
  for (int halving = 0; halving < 60; ++halving) {
    const double middle = .5 * (valid + inverted);
    M.x[fixed.at(0)] = place + middle * out;
    (shapes::countInverted(M) > 0 ? inverted : valid) = middle;
  }
  M.x[fixed[0]] = place + valid * out;
  return M;
}

/// Adds, beside the mesh, the star of a cube's middle with its other nodes moved at random as far
/// as the middle still finds a place: hardly any, so that some elements are as good as flat.
void addNarrowStar(Mesh& M, double scale) {
  Mesh star = shakenCube(2, 0);
  int middle = 0;
  while (!(star.x[middle] == Vec3{.5, .5, .5})) ++middle;
  const auto isElsewhere = [&](const std::array<int, 4>& z) {
    return std::find(z.begin(), z.end(), middle) == z.end();
  };
  star.tets.erase(std::remove_if(star.tets.begin(), star.tets.end(), isElsewhere), star.tets.end());
  samples::Random random(1);
  std::vector<Vec3> move(star.x.size());
  for (Vec3& d : move)
    for (double Vec3::*c : {&Vec3::x, &Vec3::y, &Vec3::z}) d.*c = random.between(-1, 1);
  OptimizeOptions options;
  options.globalDescent = false;
  Mesh last = star;
  double valid = 0, inverted = 1;
  for (int halving = 0; halving < 50; ++halving) {
    const double far = .5 * (valid + inverted);
    Mesh trial = star;
    for (std::size_t n = 0; n < move.size(); ++n) trial.x[n] += far * move[n];
    trial.x[middle] = last.x[middle];
    if (shapes::countInverted(trial) > 0) optimizeMesh(trial, options);
    const bool isValid = shapes::countInverted(trial) == 0;
    if (isValid) last = trial;
    (isValid ? valid : inverted) = far;
  }
  const int first = static_cast<int>(M.x.size());
  for (const Vec3& x : last.x) M.x.push_back(scale * x + Vec3{5, 0, 0});
  for (const Vec3& xi : star.xi) M.xi.push_back(xi + Vec3{50, 0, 0});
  for (std::array<int, 4> z : last.tets) {
    for (int& n : z) n += first;
    M.tets.push_back(z);
  }
}

/// An inner block of a Kuhn cube turned about a skew axis; the block's nodes are to be fixed.
Mesh turnedCube(int n, int lo, int hi, double angle, std::vector<int>& block) {
  Mesh M = shakenCube(n, 0);
  const Vec3 k = (1 / std::sqrt(14.)) * Vec3{1, 2, 3}, centre{.5, .5, .5};
  for (std::size_t i = 0; i < M.x.size(); ++i) {
    const Vec3 d = M.x[i] - centre;
    const double bottom = (lo - .5) / n - .5, top = (hi + .5) / n - .5;
    if (std::min({d.x, d.y, d.z}) < bottom || std::max({d.x, d.y, d.z}) > top) continue;
    block.push_back(static_cast<int>(i));
    M.x[i] = centre + std::cos(angle) * d + std::sin(angle) * cross(k, d) +
             ((1 - std::cos(angle)) * dot(k, d)) * k;
  }
  return M;
}

/// A Kuhn cube whose nodes of the plane z = .5 inside [.2, .8]² lie on a sine surface, and are to
/// be fixed.
Mesh raisedSheet(int n, double A, std::vector<int>& sheet) {
  Mesh M = shakenCube(n, 0);
  const double pi = std::acos(-1.);
  for (std::size_t i = 0; i < M.x.size(); ++i) {
    Vec3& x = M.x[i];
    if (std::abs(x.z - .5) > 1e-9 || std::max(std::abs(x.x - .5), std::abs(x.y - .5)) > .3)
      continue;
    x.z += A * std::sin(2 * pi * x.x) * std::sin(2 * pi * x.y);
    sheet.push_back(static_cast<int>(i));
  }
  return M;
}

double meanEta(const Mesh& M) {
  double sum = 0;
  for (double q : qualities(M)) sum += 1 / q;
  return sum / static_cast<double>(M.tets.size());
}

/// F with derivative for the line search; counts its calls.
struct LineCase {
  const char* name;
  LinePoint (*F)(double);
  double tFirst;
};
const LineCase lineCases[] = {
    {"parabola",
     [](double t) {
       return LinePoint{(t - 1) * (t - 1), 2 * (t - 1)};
     },
     1},
    {"far parabola",
     [](double t) {
       return LinePoint{(t - 30) * (t - 30), 2 * (t - 30)};
     },
     1},
    {"near parabola",
     [](double t) {
       return LinePoint{(t - .01) * (t - .01), 2 * (t - .01)};
     },
     1},
    {"pole at 1",
     [](double t) {
       return t < 1 ? LinePoint{1 / (1 - t) - 3 * t, 1 / ((1 - t) * (1 - t)) - 3}
                    : LinePoint{inf, 0};
     },
     1},
    {"barrier",
     [](double t) {
       return t < .1 ? LinePoint{-std::log(.1 - t) - 30 * t, 1 / (.1 - t) - 30} : LinePoint{inf, 0};
     },
     1},
    {"wave",
     [](double t) {
       return LinePoint{std::cos(3 * t) - .2 * std::sin(t) - 1,
                        -3 * std::sin(3 * t) - .2 * std::cos(t)};
     },
     1},
};

template <class E, class Call>
std::string messageOf(Call call) {
  try {
    call();
  } catch (const E& error) {
    return error.what();
  }
  return "";
}

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

/// A node inside the unit sphere, joined to each triangle of it.
Mesh ballAround(Vec3 centre, int rings, int sectors) {
  const double pi = std::acos(-1.);
  Mesh M;
  M.x = {centre, {0, 0, 1}, {0, 0, -1}};
  for (int i = 0; i < rings; ++i)
    for (int j = 0; j < sectors; ++j) {
      const double a = pi * (i + 1) / (rings + 1), b = 2 * pi * j / sectors;
      M.x.push_back({std::sin(a) * std::cos(b), std::sin(a) * std::sin(b), std::cos(a)});
    }
  const auto at = [&](int i, int j) { return 3 + i * sectors + j % sectors; };
  for (int j = 0; j < sectors; ++j) {
    M.tets.push_back({0, 1, at(0, j), at(0, j + 1)});
    M.tets.push_back({0, 2, at(rings - 1, j + 1), at(rings - 1, j)});
    for (int i = 0; i + 1 < rings; ++i) {
      M.tets.push_back({0, at(i, j), at(i + 1, j), at(i + 1, j + 1)});
      M.tets.push_back({0, at(i, j), at(i + 1, j + 1), at(i, j + 1)});
    }
  }
  return M;
}

}  // namespace

TEST_SUITE("3.7.4") {
  TEST_CASE("strong Wolfe: both inequalities hold at the accepted step") {
    for (const LineCase& c : lineCases) {
      CAPTURE(c.name);
      const WolfeStep step = strongWolfe(c.F, c.tFirst, inf);
      REQUIRE(step.t > 0);
      const LinePoint zero = c.F(0), at = c.F(step.t);
      CHECK(step.armijo);
      CHECK(step.curvature);
      CHECK(at.F <= zero.F + 1e-4 * step.t * zero.slope);
      CHECK(std::abs(at.slope) <= .9 * std::abs(zero.slope));
      CHECK(step.evaluations <= 20);
    }
  }

  TEST_CASE("strong Wolfe: a good first step costs one evaluation") {
    CHECK(strongWolfe(lineCases[0].F, 1, inf).evaluations == 1);
  }

  TEST_CASE("strong Wolfe: the step stays below tMax, and there Armijo suffices") {
    const WolfeStep step = strongWolfe(lineCases[1].F, 1, 2);
    CHECK(step.t == 2);
    CHECK(step.armijo);
  }

  TEST_CASE("strong Wolfe: t = 0 where F only grows") {
    const WolfeStep step = strongWolfe([](double t) { return LinePoint{t * t + t, -1}; }, 1, inf);
    CHECK(step.t == 0);
    CHECK_FALSE(step.armijo);
    CHECK(step.evaluations == 20);
  }

  TEST_CASE("Algorithm 2: a shaken cube becomes the ideal mesh, its boundary stays") {
    for (double amount : {.45, .9}) {
      CAPTURE(amount);
      Mesh M = shakenCube(8, amount);
      const Mesh before = M;
      REQUIRE(qualityStatistics(M).inverted > 0);
      const OptimizeReport report = optimizeMesh(M);
      CHECK(report.converged);
      CHECK(report.inverted == 0);
      CHECK(report.minQ > .999);
      for (std::size_t n = 0; n < M.x.size(); ++n)
        if (onHull(before.x[n])) CHECK(M.x[n] == before.x[n]);
      CHECK(report.minQ == qualityStatistics(M).min);
      CHECK(report.meanQ == qualityStatistics(M).mean);
    }
  }

  TEST_CASE("Algorithm 2: to the letter it reaches the same") {
    Mesh M = shakenCube(6, .5);
    const OptimizeReport report = optimizeMesh(M, OptimizeOptions::paper());
    CHECK(report.converged);
    CHECK(report.inverted == 0);
    CHECK(report.minQ > .99);
  }

  TEST_CASE("Algorithm 2: position and scale do not matter") {
    Mesh A = shakenCube(6, .5), B = A;
    for (Vec3& x : B.x) x = 1e3 * x + Vec3{4e5, 4e6, -1e3};
    const OptimizeReport a = optimizeMesh(A), b = optimizeMesh(B);
    CHECK(a.inverted == 0);
    CHECK(b.inverted == 0);
    CHECK(a.meanQ == doctest::Approx(b.meanQ).epsilon(1e-4));
  }

  TEST_CASE("Algorithm 2: an inner cube turned inside a fixed hull is untangled") {
    for (double angle : {1.2, 2.2, 3.}) {
      CAPTURE(angle);
      OptimizeOptions options;
      Mesh M = turnedCube(8, 3, 5, angle, options.fixed);
      const Mesh before = M;
      REQUIRE(qualityStatistics(M).inverted > 0);
      const OptimizeReport report = optimizeMesh(M, options);
      CHECK(report.inverted == 0);
      CHECK(report.minQ > 0);
      for (int n : options.fixed) CHECK(M.x[n] == before.x[n]);
    }
  }

  TEST_CASE("Algorithm 2: choice, elements that are as good as flat are untangled") {
    const Vec3 places[] = {{.25, .75, .5}, {.5, .75, .25}, {.75, .5, .5}};
    for (const Vec3& place : places) {
      CAPTURE(place.x);
      OptimizeOptions options;
      Mesh M = cubeWithFlatElements(place, options.fixed);
      REQUIRE(shapes::countInverted(M) == 0);
      REQUIRE(qualityStatistics(M).min < 1e-8);
      CHECK(optimizeMesh(M, options).minQ > .3);
    }
  }

  TEST_CASE(
      "Algorithm 2: a valid mesh stays valid where the sweeps end before flat ones are cured") {
    for (int sweeps : {1, 2, 5, 10}) {
      Mesh M = shakenCube(6, .25);
      for (Vec3& x : M.x) x.z *= 1e-4;  // sheared strongly as seen from the ideal elements
      for (Vec3& xi : M.xi) xi.z *= 1e-4;
      REQUIRE(shapes::countInverted(M) == 0);
      REQUIRE(qualityStatistics(M).min < 1e-5);
      OptimizeOptions options;
      options.maxSweeps = sweeps;
      int inverted = 0;
      options.onSweep = [&](const Sweep& sweep) { inverted = sweep.inverted; };
      CHECK(optimizeMesh(M, options).inverted == 0);
      CHECK(inverted > 0);  // of the sweeps' end, which is not kept
    }
  }

  TEST_CASE("Algorithm 2: choice, a flat star that cannot be cured does not hold up the others") {
    for (bool globalDescent : {true, false}) {
      OptimizeOptions options;
      options.globalDescent = globalDescent;
      Mesh M = shakenCube(6, .25);
      const std::size_t cube = M.tets.size();
      addNarrowStar(M, 1. / 3);
      REQUIRE(shapes::countInverted(M) == 0);
      REQUIRE(qualityStatistics(M).min < 1e-5);
      CHECK(optimizeMesh(M, options).converged);
      CHECK(shapes::countInverted(M) == 0);
      const std::vector<double> q = qualities(M);
      CHECK(*std::min_element(q.begin(), q.begin() + static_cast<std::ptrdiff_t>(cube)) > .9);
    }
  }

  TEST_CASE("Algorithm 2: choice, flat elements without a free node do not hold up the others") {
    for (bool globalDescent : {true, false}) {
      OptimizeOptions options;
      Mesh M = cubeWithFlatElements({.25, .75, .5}, options.fixed);
      const std::vector<double> q = qualities(M);
      for (std::size_t E = 0; E < M.tets.size(); ++E)
        if (q[E] < 1e-4)
          options.fixed.insert(options.fixed.end(), M.tets[E].begin(), M.tets[E].end());
      options.maxTangledSweeps = 12, options.globalDescent = globalDescent;
      const OptimizeReport report = optimizeMesh(M, options);
      CHECK(report.converged);
      CHECK(report.sweeps < 60);
    }
  }

  TEST_CASE("Algorithm 2: choice, elements whose ideal ones are as thin are not flat") {
    const auto sweepsOf = [](double thickness) {
      Mesh M = shakenCube(6, 0);
      const Mesh shaken = shakenCube(6, .25);
      for (std::size_t n = 0; n < M.x.size(); ++n) M.x[n].z = thickness * shaken.x[n].z;
      for (Vec3& xi : M.xi) xi.z *= thickness;
      const OptimizeReport report = optimizeMesh(M);
      CHECK(report.minQ > .999);
      return report.sweeps;
    };
    CHECK(sweepsOf(1e-8) <= sweepsOf(1e-3) + 2);
  }

  TEST_CASE("Algorithm 2: departure, while a mesh is tangled what moves little is not visited") {
    const auto visitsOf = [](int acceleration) {
      OptimizeOptions options;
      options.maxSweeps = 5, options.acceleration = acceleration;
      Mesh M = turnedCube(24, 10, 14, 2.2, options.fixed);
      const OptimizeReport report = optimizeMesh(M, options);
      CHECK(report.inverted > 0);
      return static_cast<double>(report.visits);
    };
    CHECK(visitsOf(4) < .9 * visitsOf(0));  // sweeps are mixed from the first valid one on
  }

  TEST_CASE(
      "Algorithm 2: without the descent a hopeless mesh is given up after ten sweeps, others are "
      "not") {
    OptimizeOptions options;
    options.globalDescent = false;
    Mesh M = turnedCube(8, 3, 5, 3, options.fixed);
    const OptimizeReport report = optimizeMesh(M, options);
    CHECK(report.sweeps == 10);
    CHECK(report.inverted > 60);
    CHECK_FALSE(report.converged);
    M = shakenCube(6, .6);
    options.fixed.clear();
    REQUIRE(qualityStatistics(M).inverted > 60);
    CHECK(optimizeMesh(M, options).inverted == 0);
  }

  TEST_CASE("Algorithm 2: f never grows in a visit, and a valid star stays valid") {
    // Only node 6 of the star is free: each sweep is one visit of it.
    Mesh M = shapes::unsymmetricStar();
    const Star star = starOf(M, 6, {0, 1, 2, 3, 4, 5, 6, 7});
    double last = f(star, M.x[6], 0);
    REQUIRE(std::isfinite(last));
    for (int k = 0; k < 20; ++k) {
      OptimizeOptions once;
      once.maxSweeps = 1;
      once.power = 1;
      CHECK(optimizeMesh(M, once).inverted == 0);
      const double now = f(star, M.x[6], 0);
      CHECK(now <= last * (1 + 1e-13));
      last = now;
    }
    CHECK(norm(fDerivatives(star, M.x[6], 0).gradient) < 1e-2);  // and ends at the minimum
  }

  TEST_CASE("Algorithm 2: a valid mesh is valid after every sweep") {
    Mesh M = shakenCube(6, .12);
    REQUIRE(qualityStatistics(M).inverted == 0);
    OptimizeOptions options;
    int sweeps = 0, inverted = 0;
    options.onSweep = [&](const Sweep& sweep) {
      CHECK(sweep.number == ++sweeps);
      inverted += sweep.inverted;
    };
    const OptimizeReport report = optimizeMesh(M, options);
    CHECK(report.sweeps == sweeps);
    CHECK(inverted == 0);
  }

  TEST_CASE(
      "Algorithm 2: departure, the lift leaves worst elements that the sweeps did not reach") {
    Mesh M = boxMesh({0, 0, 0}, {8, 2, 2}, {16, 4, 4});
    const auto nodeAt = [&M](Vec3 x) {
      return static_cast<int>(std::find(M.x.begin(), M.x.end(), x) - M.x.begin());
    };
    const int here = nodeAt({1, 1, 1}), there = nodeAt({7, 1, 1});
    M.x[here] += Vec3{.3, .2, .1}, M.x[there] += Vec3{.3, .2, .1};
    const Vec3 before = M.x[there];
    OptimizeOptions options;
    options.active = {here};
    optimizeMesh(M, options);
    CHECK(M.x[there] == before);
    CHECK(norm(M.x[here] - .5 * M.xi[here]) < .05);
    options.active.clear();
    optimizeMesh(M, options);
    CHECK_FALSE(M.x[there] == before);
  }

  TEST_CASE(
      "Algorithm 2: departure, the worst elements are lifted and the mean falls by at most .02") {
    std::vector<int> block;
    const Mesh start = turnedCube(8, 3, 5, .7, block);
    OptimizeOptions options, plain;
    options.fixed = plain.fixed = block;
    plain.power = 1;
    Mesh A = start, B = start;
    const OptimizeReport lifted = optimizeMesh(A, options), sum = optimizeMesh(B, plain);
    CHECK(lifted.minQ > sum.minQ + .02);
    CHECK(lifted.meanQ > sum.meanQ - .02);
  }

  TEST_CASE("Algorithm 2: maxSweeps bounds all phases") {
    for (int bound : {1, 5, 70}) {
      std::vector<int> block;
      Mesh M = turnedCube(8, 3, 5, 3, block);
      OptimizeOptions options;
      options.fixed = block;
      options.maxSweeps = bound;
      CHECK(optimizeMesh(M, options).sweeps <= bound);
    }
  }

  TEST_CASE("Algorithm 2: nodes whose stars rest are not visited") {
    Mesh M = shakenCube(6, 0);
    int moved = -1;
    for (std::size_t n = 0; n < M.x.size(); ++n)
      if (norm(M.x[n] - Vec3{.5, .5, .5}) < 1e-9) moved = static_cast<int>(n);
    REQUIRE(moved >= 0);
    M.x[moved].x += .05;
    const Mesh before = M;
    OptimizeOptions options;
    options.power = 1;
    options.active = {0};  // a corner: nothing wakes the others
    CHECK(optimizeMesh(M, options).converged);
    CHECK(std::memcmp(M.x.data(), before.x.data(), sizeof(Vec3) * M.x.size()) == 0);
    options.active = {moved};
    optimizeMesh(M, options);
    CHECK(norm(M.x[moved] - Vec3{.5, .5, .5}) < 1e-3);
  }

  TEST_CASE("Algorithm 2: choice, nodes farther than four edges from the active ones stay") {
    Mesh M = shakenCube(12, .2);
    const Mesh before = M;
    int middle = -1;
    for (std::size_t n = 0; n < M.x.size(); ++n)
      if (norm(M.xi[n] - Vec3{6, 6, 6}) < 1e-9) middle = static_cast<int>(n);
    REQUIRE(middle >= 0);
    OptimizeOptions options;
    options.active = {middle};
    CHECK(optimizeMesh(M, options).converged);
    int far = 0, near = 0;
    for (std::size_t n = 0; n < M.x.size(); ++n) {
      const Vec3 d = M.xi[n] - M.xi[middle];  // an edge changes each coordinate by at most 1
      const bool isFar = std::max({std::abs(d.x), std::abs(d.y), std::abs(d.z)}) > 4.5;
      far += isFar;
      near += !(M.x[n] == before.x[n]);
      if (isFar) CHECK(M.x[n] == before.x[n]);
    }
    CHECK(far > 100);
    CHECK(near > 100);
    M.x[0] = {.5, .5, .5};  // a corner of the cube: its elements are out of reach, and inverted
    const OptimizeReport report = optimizeMesh(M, options);
    CHECK(report.inverted == qualityStatistics(M).inverted);
    CHECK(report.inverted > 0);
    CHECK_FALSE(report.converged);
  }

  TEST_CASE("Algorithm 2: choice, the hub of more than 20000 elements stays") {
    const Vec3 beside{.3, .1, .2};
    const auto movedBy = [&](int rings) {
      Mesh M = ballAround(beside, rings, 100);  // 2 x 100 x rings elements
      optimizeMesh(M, {});
      return norm(M.x[0] - beside);
    };
    CHECK(movedBy(100) > .1);
    CHECK(movedBy(101) == 0);
  }

  TEST_CASE("Algorithm 2: two runs give the same bytes") {
    std::vector<int> block;
    Mesh A = turnedCube(8, 3, 5, 2.2, block), B = A;
    OptimizeOptions options;
    options.fixed = block;
    optimizeMesh(A, options);
    optimizeMesh(B, options);
    CHECK(std::memcmp(A.x.data(), B.x.data(), sizeof(Vec3) * A.x.size()) == 0);
  }

  TEST_CASE(
      "Algorithm 2: departure, accelerated sweeps reach the same minimum in two thirds of them") {
    std::vector<int> sheet;
    const Mesh start = raisedSheet(16, .1, sheet);
    REQUIRE(qualityStatistics(start).inverted > 0);
    OptimizeOptions plain, accelerated;
    plain.fixed = accelerated.fixed = sheet;
    plain.power = accelerated.power = 1;
    plain.relaxation = accelerated.relaxation = 1;
    plain.acceleration = 0;
    Mesh A = start, B = start;
    const OptimizeReport slow = optimizeMesh(A, plain), fast = optimizeMesh(B, accelerated);
    CHECK(slow.converged);
    CHECK(fast.converged);
    CHECK(fast.inverted == 0);
    CHECK(3 * fast.sweeps <= 2 * slow.sweeps);
    CHECK(meanEta(B) <= meanEta(A) + 1e-4);
  }

  TEST_CASE("Algorithm 2: departure, a mixture that goes astray towards a flat element is undone") {
    // One free node: the mixture after its fourth sweep would leave it at a face, where it rests.
    Mesh M = shakenCube(2, 0);
    M.xi.clear();
    for (std::array<int, 4>& t : M.tets) {
      const Vec3 o = M.x[t[0]];
      if (dot(M.x[t[1]] - o, cross(M.x[t[2]] - o, M.x[t[3]] - o)) < 0) std::swap(t[2], t[3]);
    }
    for (Vec3& x : M.x)
      if (norm(x - Vec3{.5, .5, .5}) < 1e-9) x = {.9, .8, .4};
    CHECK(optimizeMesh(M).minQ > .7);
  }

  TEST_CASE("Algorithm 2: departure, a mixture that inverts elements is undone") {
    // A coarse mesh that is hardly valid after the untangling: far steps leave the valid states.
    for (double angle : {2., 2.2}) {
      std::vector<int> block;
      Mesh M = turnedCube(8, 3, 5, angle, block);
      OptimizeOptions options;
      options.fixed = block;
      options.power = 1;
      bool valid = false;
      options.onSweep = [&](const Sweep& sweep) {
        if (valid) CHECK(sweep.inverted == 0);
        valid = valid || sweep.inverted == 0;
      };
      CHECK(optimizeMesh(M, options).inverted == 0);
    }
  }

  TEST_CASE("threads: every item of a loop once, and of what is thrown the first piece's") {
    for (int threads : {0, 1, 2, 7, 1000000}) {
      CAPTURE(threads);
      const Crew crew(threads);
      for (int end : {3, 4, 100, 1003}) {
        std::vector<int> times(end, 0);
        crew.forPieces(3, end, 10, [&](int k, int from, int to) {
          CHECK(from == 3 + 10 * k);
          CHECK(to <= std::min(end, from + 10));
          for (int i = from; i < to; ++i) ++times[i];
        });
        CHECK(std::count(times.begin(), times.end(), 1) == end - 3);
        CHECK(std::count(times.begin(), times.begin() + 3, 0) == 3);
      }
      for (int slow : {20, 21}) {  // the first to throw, and the last
        std::string thrown;
        try {
          crew.forPieces(0, 100, 1, [slow](int k, int, int) {
            if (k == slow) std::this_thread::sleep_for(std::chrono::milliseconds(2));
            if (k >= 20) throw MethodError(std::to_string(k));
          });
        } catch (const MethodError& error) {
          thrown = error.what();
        }
        CHECK(thrown == "20");
      }
      crew.forPieces(0, 0, 1, [](int, int, int) { CHECK(false); });
    }
  }

  TEST_CASE("Algorithm 2: the number of threads does not change a byte") {
    std::vector<int> block, sheet;
    const Mesh turned = turnedCube(8, 3, 5, 2.2, block);
    const Mesh raised = raisedSheet(12, .1, sheet);
    for (const auto& [mesh, fixed] : {std::pair(turned, block), std::pair(raised, sheet)}) {
      OptimizeOptions options;
      options.fixed = fixed;
      options.threads = 1;
      Mesh one = mesh;
      optimizeMesh(one, options);
      for (int threads : {2, 5}) {
        options.threads = threads;
        Mesh many = mesh;
        optimizeMesh(many, options);
        CHECK(std::memcmp(one.x.data(), many.x.data(), sizeof(Vec3) * one.x.size()) == 0);
      }
    }
  }

  TEST_CASE("Algorithm 2: a mesh without tetrahedra or without free nodes is left as it is") {
    Mesh none;
    CHECK(optimizeMesh(none).converged);
    Mesh one = shapes::oneTetrahedron();
    const std::vector<Vec3> before = one.x;
    const OptimizeReport report = optimizeMesh(one);
    CHECK(report.converged);
    CHECK(report.inverted == 0);
    CHECK(one.x == before);
  }

  TEST_CASE("errors: options out of range") {
    Mesh M = shakenCube(2, .1);
    const auto refuses = [&M](const char* part, void (*change)(OptimizeOptions&)) {
      CAPTURE(part);
      OptimizeOptions options;
      change(options);
      const Mesh before = M;
      const std::string text = messageOf<InputError>([&] { optimizeMesh(M, options); });
      CHECK(contains(text, "optimizeMesh (§3.7)"));
      CHECK(contains(text, part));
      CHECK(M.x == before.x);
    };
    refuses("maxDisp", [](OptimizeOptions& o) { o.maxDisp = 0; });
    refuses("maxDisp", [](OptimizeOptions& o) { o.maxDisp = std::nan(""); });
    refuses("maxSweeps = 0", [](OptimizeOptions& o) { o.maxSweeps = 0; });
    refuses("power", [](OptimizeOptions& o) { o.power = .5; });
    refuses("mu", [](OptimizeOptions& o) { o.mu = 1; });
    refuses("mu", [](OptimizeOptions& o) { o.mu = 0; });
    refuses("acceleration", [](OptimizeOptions& o) { o.acceleration = 9; });
    refuses("threads", [](OptimizeOptions& o) { o.threads = -1; });
    refuses("relaxation", [](OptimizeOptions& o) { o.relaxation = 2; });
    refuses("fixed node 27", [](OptimizeOptions& o) { o.fixed = {27}; });
    refuses("active node -1", [](OptimizeOptions& o) { o.active = {-1}; });
  }

  TEST_CASE("errors: malformed meshes") {
    const auto refuses = [](const char* part, void (*change)(Mesh&)) {
      CAPTURE(part);
      Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
      change(M);
      CHECK(contains(messageOf<InputError>([&] { optimizeMesh(M); }), part));
    };
    refuses("tetrahedron 3 names node 99", [](Mesh& M) { M.tets[3][1] = 99; });
    refuses("names node -1", [](Mesh& M) { M.tets[0][0] = -1; });
    refuses("tetrahedron 5 names node 1 twice", [](Mesh& M) { M.tets[5] = {1, 1, 1, 1}; });
    for (double factor : {0., 1e-150, 1e200}) {
      Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
      for (Vec3& p : M.x) p = factor * p;
      CHECK(contains(messageOf<InputError>([&] { optimizeMesh(M); }), "the mesh's extent "));
    }
    refuses("node 5 has a coordinate that is not finite", [](Mesh& M) { M.x[5].y = std::nan(""); });
    refuses("node 6 has a computational", [](Mesh& M) { M.xi[6].z = inf; });
    refuses("M.xi has 26 entries", [](Mesh& M) { M.xi.pop_back(); });
    refuses("M.dimension has", [](Mesh& M) { M.dimension.pop_back(); });
    refuses("M.entity has", [](Mesh& M) { M.entity.pop_back(); });
    refuses("M.parameter has", [](Mesh& M) { M.parameter.clear(); });
    refuses("dimension 4", [](Mesh& M) { M.dimension[13] = 4; });
    refuses("no surface or patch 7", [](Mesh& M) {
      M.dimension[13] = 2;
      M.entity[13] = 7;
    });
    refuses("no curve 40", [](Mesh& M) {
      M.dimension[13] = 1;
      M.entity[13] = 40;
    });
    refuses("call buildLocator()", [](Mesh& M) {
      for (auto& P : M.patches) P.gridSize = 0;
    });
    refuses("its ideal element is degenerate",
            [](Mesh& M) { M.xi[M.tets[2][0]] = M.xi[M.tets[2][1]]; });
  }
}
