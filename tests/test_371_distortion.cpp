// SPDX-License-Identifier: MIT
//
// §3.7.1: distortion, quality, the regularized determinant.
#include <doctest/doctest.h>

#include "shapes.hpp"

using namespace meccano;

namespace {

Mat3 diagonal(double a, double b, double c) { return {{a, 0, 0}, {0, b, 0}, {0, 0, c}}; }

/// A rotation about a skew axis by Rodrigues' formula.
Mat3 rotation(double angle) {
  const Vec3 k = (1 / std::sqrt(14.)) * Vec3{1, 2, 3};
  const Mat3 K{{0, k.z, -k.y}, {-k.z, 0, k.x}, {k.y, -k.x, 0}};
  return diagonal(1, 1, 1) + std::sin(angle) * K + (1 - std::cos(angle)) * (K * K);
}

const Mat3 someJ{{1.1, .2, -.3}, {.1, .8, .4}, {-.2, .3, 1.4}};

}  // namespace

TEST_SUITE("3.7.1") {
  TEST_CASE("eq. (5): known distortions") {
    CHECK(eta(diagonal(1, 1, 1)) == doctest::Approx(1).epsilon(1e-15));
    CHECK(eta(diagonal(1, 1, 2)) == doctest::Approx(std::cbrt(2.)).epsilon(1e-14));
    CHECK(eta(diagonal(1, 1, 3)) == doctest::Approx(1.7627495).epsilon(1e-7));
    CHECK(eta(diagonal(1, 1, .5)) == doctest::Approx(1.1905507).epsilon(1e-7));
    for (double g : {-2., .3, 1.})  // unit shear
      CHECK(eta({{1, 0, 0}, {g, 1, 0}, {0, 0, 1}}) ==
            doctest::Approx(1 + g * g / 3).epsilon(1e-14));
  }

  TEST_CASE("eq. (5): a transcription of the printed formula agrees") {
    const Mat3 A = someJ;
    const double square = A.c0.x * A.c0.x + A.c0.y * A.c0.y + A.c0.z * A.c0.z + A.c1.x * A.c1.x +
                          A.c1.y * A.c1.y + A.c1.z * A.c1.z + A.c2.x * A.c2.x + A.c2.y * A.c2.y +
                          A.c2.z * A.c2.z;
    const double sigma = A.c0.x * (A.c1.y * A.c2.z - A.c1.z * A.c2.y) -
                         A.c1.x * (A.c0.y * A.c2.z - A.c0.z * A.c2.y) +
                         A.c2.x * (A.c0.y * A.c1.z - A.c0.z * A.c1.y);
    CHECK(eta(A) ==
          doctest::Approx(square / (3 * std::pow(std::abs(sigma), 2. / 3))).epsilon(1e-13));
  }

  TEST_CASE("eq. (5): eta >= 1, and rotation, scale and reflection leave it unchanged") {
    for (double angle : {.3, 2., 3.1})
      for (double scale : {1e-6, 1., 1e7}) {
        CAPTURE(angle);
        CAPTURE(scale);
        const Mat3 Q = rotation(angle);
        CHECK(eta(scale * Q) == doctest::Approx(1).epsilon(1e-13));
        CHECK(eta(scale * (Q * someJ)) == doctest::Approx(eta(someJ)).epsilon(1e-13));
        CHECK(eta(someJ * (scale * Q)) == doctest::Approx(eta(someJ)).epsilon(1e-13));
      }
    CHECK(eta(someJ) > 1.01);
    CHECK(eta(diagonal(1, 1, -1) * someJ) == doctest::Approx(eta(someJ)).epsilon(1e-14));
  }

  TEST_CASE("eq. (5): a flat element has infinite distortion and quality 0") {
    CHECK(std::isinf(eta(diagonal(1, 1, 0))));
    CHECK(quality(diagonal(1, 1, 0)) == 0);
  }

  TEST_CASE("eq. (6): the affine map takes ideal corners to physical ones") {
    const std::array<Vec3, 4> z{{{0, 0, 0}, {2, .1, 0}, {.3, 1, .2}, {.1, -.4, 1.5}}};
    const std::array<Vec3, 4> x{{{5, 1, 2}, {5.5, 1.4, 2}, {4, 3, 1}, {5, 1, 4}}};
    const Mat3 J = jacobian(z, x);
    for (int k = 1; k < 4; ++k) CHECK(norm(J * (z[k] - z[0]) - (x[k] - x[0])) < 1e-14);
    std::array<Vec3, 4> moved = x;
    for (Vec3& p : moved) p = p + Vec3{100, -50, 3};
    CHECK(eta(jacobian(z, moved)) == doctest::Approx(eta(J)).epsilon(1e-12));
  }

  TEST_CASE("eq. (7): q = 1 / eta, and 0 for inverted elements") {
    CHECK(quality(someJ) == doctest::Approx(1 / eta(someJ)).epsilon(1e-15));
    CHECK(quality(diagonal(1, 1, 1)) == doctest::Approx(1).epsilon(1e-15));
    CHECK(quality(diagonal(1, 1, -1)) == 0);
  }

  TEST_CASE("eq. (7): corner tetrahedron and Kuhn tetrahedron against the regular one") {
    const std::array<Vec3, 4> regular{{{0, 0, 0}, {0, 1, 1}, {1, 0, 1}, {1, 1, 0}}};
    const std::array<Vec3, 4> corner{{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
    const std::array<Vec3, 4> kuhn{{{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {1, 1, 1}}};
    const Mat3 mirror = diagonal(-1, 1, 1);
    const Mat3 J = jacobian(regular, corner), K = jacobian(regular, kuhn);
    CHECK(quality(det(J) > 0 ? J : mirror * J) == doctest::Approx(.8399474).epsilon(1e-6));
    CHECK(quality(det(K) > 0 ? K : mirror * K) == doctest::Approx(.7559526).epsilon(1e-6));
  }

  TEST_CASE("eq. (7): the corner tetrahedron of a cube against the Kuhn one is .6") {
    const std::array<Vec3, 4> corner{{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
    const std::array<Vec3, 4> kuhn{{{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {1, 1, 1}}};
    CHECK(quality(jacobian(kuhn, corner)) == doctest::Approx(.6).epsilon(1e-12));
  }

  TEST_CASE("eq. (8): known values, h(0) = delta, limits") {
    CHECK(h(0, .1) == doctest::Approx(.1).epsilon(1e-15));
    CHECK(h(-1, .1) == doctest::Approx(.00990195).epsilon(1e-6));
    CHECK(h(2, 0) == 2);
    CHECK(h(-2, 0) == 0);
    double last = 0;
    for (double sigma = -3; sigma <= 3; sigma += .05) {
      const double printed = .5 * (sigma + std::sqrt(sigma * sigma + 4 * .01));
      CHECK(h(sigma, .1) == doctest::Approx(printed).epsilon(1e-12));
      CHECK(h(sigma, .1) > last);  // increasing, positive
      last = h(sigma, .1);
    }
  }

  TEST_CASE("eq. (8): departure, sigma = -1 and delta = 1e-9 give 1e-18, not 0") {
    CHECK(.5 * (-1 + std::sqrt(1 + 4e-18)) == 0);  // as printed
    CHECK(h(-1, 1e-9) == doctest::Approx(1e-18).epsilon(1e-12));
    CHECK(std::isfinite(etaRegularized(diagonal(1, 1, -1), 1e-9)));
  }

  TEST_CASE("eq. (8): chooseDelta gives h(sigma_min) = mu") {
    for (double sigma : {-10., -1., -1e-3, 0.})
      for (double mu : {1e-6, 8e-3, .5}) {
        CAPTURE(sigma);
        CAPTURE(mu);
        CHECK(h(sigma, chooseDelta(sigma, mu)) == doctest::Approx(mu).epsilon(1e-12));
      }
    CHECK(chooseDelta(.1, 8e-3) == 0);
  }

  TEST_CASE("eq. (8): the regularized distortion tends to eq. (5) on valid elements") {
    CHECK(etaRegularized(someJ, 0) == doctest::Approx(eta(someJ)).epsilon(1e-14));
    CHECK(etaRegularized(someJ, .1) < eta(someJ));
    CHECK(std::isinf(etaRegularized(diagonal(1, 1, -1), 0)));
    CHECK(std::isinf(etaRegularized(diagonal(1, 1, 0), 0)));
  }
}
