// SPDX-License-Identifier: MIT
//
// §3.7.2: the objective function of a node and its analytic derivatives.
#include <doctest/doctest.h>

#include "../samples/surfaces.hpp"
#include "shapes.hpp"

using namespace meccano;

namespace {

const std::vector<int> allEight{0, 1, 2, 3, 4, 5, 6, 7};
constexpr int inner = 6;

/// Eq. (9) element by element from the mesh, without a star.
double slowF(Mesh M, Vec3 x, double delta, double power,
             const std::vector<int>& elements = allEight) {
  M.x[inner] = x;
  double sum = 0;
  for (int E : elements) {
    const std::array<int, 4>& t = M.tets[E];
    const Mat3 J = jacobian({M.xi[t[0]], M.xi[t[1]], M.xi[t[2]], M.xi[t[3]]},
                            {M.x[t[0]], M.x[t[1]], M.x[t[2]], M.x[t[3]]});
    sum += std::pow(etaRegularized(J, delta), power);
  }
  return sum;
}

Vec3 randomVector(samples::Random& random) {
  return {random.between(-1, 1), random.between(-1, 1), random.between(-1, 1)};
}

/// Any N, σ, g, v, s that an element may have: |v| <= |g| √N.
StarElement randomElement(samples::Random& random) {
  const double N = random.between(3, 30), gg = random.between(.1, 10);
  const Vec3 v = randomVector(random);
  const double part = std::min(1., random.between(0, 2)) * std::sqrt(gg * N / dot(v, v));
  return {N, random.between(.1, 1), gg, part * v, random.between(0, 5) * randomVector(random)};
}

/// Orders of the Taylor remainders of f, without and with the Hessian, from step to step/2.
struct Rates {
  double gradient, hessian;
};
Rates taylorRates(const Star& star, Vec3 x, double delta, double power, double step) {
  const Objective o = fDerivatives(star, x, delta, power);
  const Vec3 d = (1 / std::sqrt(3.)) * Vec3{1, -1, 1};
  double first[2], second[2];
  for (int k = 0; k < 2; ++k) {
    const double t = k == 0 ? step : step / 2;
    const double change = f(star, x + t * d, delta, power) - o.f;
    first[k] = std::abs(change - t * dot(o.gradient, d));
    second[k] = std::abs(change - t * dot(o.gradient, d) - t * t / 2 * dot(d, o.hessian * d));
  }
  return {std::log2(first[0] / first[1]), std::log2(second[0] / second[1])};
}

}  // namespace

TEST_SUITE("3.7.2") {
  TEST_CASE("eq. (9): the star's closed form agrees with the sum over the elements") {
    const Mesh M = shapes::unsymmetricStar();
    const Star star = starOf(M, inner, allEight);
    REQUIRE(star.elements.size() == 8);
    for (Vec3 x : {M.x[inner], Vec3{.3, -.2, .4}, Vec3{2, .5, -1}})
      for (double delta : {.05, 1.})
        for (double power : {1., 3., 6., 2.5, 24.}) {
          CAPTURE(power);
          CAPTURE(delta);
          CHECK(f(star, x, delta, power) ==
                doctest::Approx(slowF(M, x, delta, power)).epsilon(1e-11));
          CHECK(fDerivatives(star, x, delta, power).f ==
                doctest::Approx(f(star, x, delta, power)).epsilon(1e-13));
        }
    CHECK(f(star, M.x[inner], 0) == doctest::Approx(slowF(M, M.x[inner], 0, 1)).epsilon(1e-13));
  }

  TEST_CASE("eq. (9): stars of any number of elements, though taken eight at a time") {
    const Mesh M = shapes::unsymmetricStar();
    std::vector<int> around;
    for (int count = 1; count <= 19; ++count) {
      around.push_back(count % 8);
      const Star star = starOf(M, inner, around);
      for (Vec3 x : {M.x[inner], Vec3{2, .5, -1}})
        CHECK(f(star, x, .1, 3) == doctest::Approx(slowF(M, x, .1, 3, around)).epsilon(1e-12));
    }
  }

  TEST_CASE("eq. (9): sigma over 200 orders of magnitude") {
    const Mesh M = shapes::unsymmetricStar();
    for (double scale : {1e-30, 1e-5, 1e8, 1e30}) {
      Mesh scaled = M;
      for (Vec3& x : scaled.x) x = scale * x;
      const Star star = starOf(scaled, inner, allEight);
      CHECK(f(star, scaled.x[inner], 0) ==
            doctest::Approx(slowF(M, M.x[inner], 0, 1)).epsilon(1e-13));
    }
  }

  TEST_CASE("eq. (9): f is infinite without regularization where an element is inverted") {
    const Star star = starOf(shapes::unsymmetricStar(), inner, allEight);
    CHECK(std::isinf(f(star, {2, 0, 0}, 0)));
    CHECK(std::isfinite(f(star, {2, 0, 0}, 1e-3)));
  }

  TEST_CASE("eq. (9): gradient and Hessian by the rate of the Taylor remainder") {
    const Mesh M = shapes::unsymmetricStar();
    const Star star = starOf(M, inner, allEight);
    for (double power : {1., 6., 24., 2.5}) {
      CAPTURE(power);
      for (double delta : {0., .1}) {
        CAPTURE(delta);
        const Rates r = taylorRates(star, {.2, .15, .1}, delta, power, power > 10 ? 2e-4 : 1e-3);
        CHECK(r.gradient == doctest::Approx(2).epsilon(.05));
        CHECK(r.hessian == doctest::Approx(3).epsilon(.08));
      }
      const Rates inverted = taylorRates(star, {2, .3, -.2}, .3, power, power > 10 ? 2e-4 : 1e-3);
      CHECK(inverted.gradient == doctest::Approx(2).epsilon(.05));
      CHECK(inverted.hessian == doctest::Approx(3).epsilon(.08));
    }
  }

  TEST_CASE("eq. (9): the gradient agrees with central differences to 1e-7") {
    const Mesh M = shapes::unsymmetricStar();
    const Star star = starOf(M, inner, allEight);
    const double e = 1e-5;
    for (Vec3 x : {Vec3{.2, .15, .1}, Vec3{2, .3, -.2}}) {
      const Objective o = fDerivatives(star, x, .2);
      const Vec3 g{(f(star, x + Vec3{e, 0, 0}, .2) - f(star, x - Vec3{e, 0, 0}, .2)) / (2 * e),
                   (f(star, x + Vec3{0, e, 0}, .2) - f(star, x - Vec3{0, e, 0}, .2)) / (2 * e),
                   (f(star, x + Vec3{0, 0, e}, .2) - f(star, x - Vec3{0, 0, e}, .2)) / (2 * e)};
      CHECK(norm(g - o.gradient) < 1e-7 * norm(g));
    }
  }

  TEST_CASE("isSmallStep: what Taylor's series leaves out is at most 1.16/2 of the second term") {
    samples::Random random(7);
    int small = 0;
    for (int k = 0; k < 20000; ++k) {
      const StarElement e = randomElement(random);
      const Star star{{}, {e}};
      const Vec3 d = randomVector(random);
      const double u = std::abs(dot(e.s, d)) / e.sigma, w = std::sqrt(e.gg * dot(d, d) / e.N);
      const Vec3 to = (random.between(.01, .2) / std::max(u, w)) * d;
      const double larger = std::max(u, w) * std::sqrt(dot(to, to) / dot(d, d));
      CHECK(isSmallStep(star, to) == (larger <= .15));
      if (!isSmallStep(star, to)) continue;
      ++small;
      const Objective o = fDerivatives(star, {}, 0);
      const double rest = f(star, to, 0) - o.f - dot(o.gradient, to);
      CHECK(rest <= .58 * dot(to, o.hessian * to) + 1e-14 * o.f);
    }
    CHECK(small > 1000);
  }

  TEST_CASE("isSmallStep: nothing is certain of flat, inverted or undefined elements and steps") {
    const double none = std::numeric_limits<double>::quiet_NaN();
    const auto isSmall = [](double sigma, Vec3 d) {
      return isSmallStep({{}, {{3, sigma, 1, {0, 0, .1}, {.1, 0, 0}}}}, d);
    };
    CHECK(isSmall(1, {.01, .01, .01}));
    CHECK_FALSE(isSmall(0, {0, .01, .01}));
    CHECK_FALSE(isSmall(-1, {0, 0, 0}));
    CHECK_FALSE(isSmall(none, {.01, .01, .01}));
    CHECK_FALSE(isSmall(1, {none, 0, 0}));
  }

  TEST_CASE("isSmallStep: 1.7 Newton steps meet the first Wolfe condition") {
    samples::Random random(8);
    int small = 0;
    for (int k = 0; k < 2000; ++k) {
      Star star;
      for (int i = 0; i < 5; ++i) {  // pairs nearly in balance, so that the Newton step is short
        StarElement e = randomElement(random);
        star.elements.push_back(e);
        e.v = -1 * e.v + .05 * randomVector(random), e.s = -1 * e.s;
        star.elements.push_back(e);
      }
      const Objective o = fDerivatives(star, {}, 0);
      Vec3 p;
      if (!solveCholesky(o.hessian, -o.gradient, p)) continue;
      for (double t : {1., 1.5, 1.7}) {
        if (!isSmallStep(star, t * p)) continue;
        ++small;
        CHECK(f(star, t * p, 0) <= o.f + 1e-4 * t * dot(o.gradient, p));
      }
    }
    CHECK(small > 1000);
  }

  TEST_CASE("eq. (9): the Hessian of a valid star is positive definite at delta = 0") {
    const Mesh M = shapes::unsymmetricStar();
    const Star star = starOf(M, inner, allEight);
    for (Vec3 x : {M.x[inner], Vec3{.2, .15, .1}, Vec3{-.2, 0, .2}}) {
      REQUIRE(std::isfinite(f(star, x, 0)));
      Vec3 p;
      const Objective o = fDerivatives(star, x, 0, 6);
      REQUIRE(solveCholesky(o.hessian, -o.gradient, p));
      CHECK(dot(p, o.gradient) < 0);
    }
  }

  TEST_CASE("solveCholesky solves a definite system and refuses an indefinite one") {
    const Mat3 A{{4, 1, -.5}, {1, 3, .7}, {-.5, .7, 2}};
    const Vec3 b{1, -2, 3};
    Vec3 p;
    REQUIRE(solveCholesky(A, b, p));
    CHECK(norm(A * p - b) < 1e-14);
    CHECK_FALSE(solveCholesky({{4, 1, 0}, {1, -3, 0}, {0, 0, 2}}, b, p));
    CHECK_FALSE(solveCholesky({{1, 1, 0}, {1, 1, 0}, {0, 0, 2}}, b, p));  // singular
    CHECK_FALSE(solveCholesky({{-1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, b, p));
    CHECK_FALSE(solveCholesky({{std::nan(""), 0, 0}, {0, 1, 0}, {0, 0, 1}}, b, p));
  }
}
