// SPDX-License-Identifier: MIT
//
// §4, Table I: statistics of the quality.
#include <doctest/doctest.h>

#include <numeric>

#include "shapes.hpp"

using namespace meccano;

TEST_SUITE("Table I") {
  TEST_CASE("Table I: an undeformed meccano has q = 1 everywhere, before and after bisection") {
    Mesh M = boxMesh({3, 4, 5}, {2, 2, 2}, {2, 2, 2});
    const double regular[3] = {.7559526, .7619525, .8};
    for (int level = 0; level < 3; ++level) {
      CAPTURE(level);
      const QualityStatistics q = qualityStatistics(M), r = qualityStatistics(M, Ideal::regular);
      CHECK(q.tetrahedra == static_cast<int>(M.tets.size()));
      CHECK(q.inverted == 0);
      CHECK(q.min == doctest::Approx(1).epsilon(1e-13));
      CHECK(q.max == doctest::Approx(1).epsilon(1e-13));
      CHECK(q.stdDev < 1e-13);
      CHECK(r.inverted == 0);
      CHECK(r.min == doctest::Approx(regular[level]).epsilon(1e-6));
      CHECK(r.mean == doctest::Approx(regular[level]).epsilon(1e-6));
      std::vector<int> all(M.tets.size());
      std::iota(all.begin(), all.end(), 0);
      bisect(M, all);
    }
  }

  TEST_CASE("Table I: inverted elements count with q = 0") {
    Mesh M = shapes::unsymmetricStar();
    M.x[6] = {2, .1, .1};  // outside the octahedron
    const std::vector<double> q = qualities(M);
    const QualityStatistics table = qualityStatistics(M);
    int zeros = 0;
    for (std::size_t E = 0; E < q.size(); ++E) {
      zeros += q[E] == 0;
      CHECK((q[E] == 0) ==
            (shapes::orientation(M.x, M.tets[E]) != shapes::orientation(M.xi, M.tets[E])));
    }
    CHECK(zeros > 0);
    CHECK(table.inverted == zeros);
    CHECK(table.min == 0);
  }

  TEST_CASE("Table I: departure, q of many elements at once is eq. (7) of eq. (6)") {
    Mesh M = boxMesh({0, 0, 0}, {1, 2, 1}, {2, 4, 2});
    for (std::size_t n = 0; n < M.x.size(); ++n)
      M.x[n] += .3 * Vec3{std::sin(7. * double(n)), std::sin(5. * double(n)), std::cos(double(n))};
    for (double scale : {1., 1e-45, 1e45}) {  // the last two: σ beyond what the fast form takes
      Mesh scaled = M;
      for (Vec3& p : scaled.x) p = scale * p;
      const std::vector<double> q = qualities(scaled);
      int inverted = 0;
      for (std::size_t E = 0; E < q.size(); ++E) {
        std::array<Vec3, 4> ideal, physical;
        for (int i = 0; i < 4; ++i)
          ideal[i] = M.xi[M.tets[E][i]], physical[i] = scaled.x[M.tets[E][i]];
        const double literal = quality(jacobian(ideal, physical));
        CHECK(q[E] == doctest::Approx(literal).epsilon(1e-13));
        inverted += literal == 0;
      }
      CHECK(inverted > 0);
      CHECK(inverted < static_cast<int>(q.size()));
    }
  }

  TEST_CASE("Table I: departure, flat ideal elements, and both of extreme scale") {
    for (double scale : {1., 1e53, 1e-53, 1e-60})
      for (double height : {1., 1e-5, 1e-9, 1e-11}) {
        Mesh M;
        M.xi = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {.3, .3, height}};
        for (Vec3& p : M.xi) {
          p = scale * p;
          M.x.push_back({p.y, p.z, p.x});
        }
        M.tets = {{0, 1, 2, 3}};
        CHECK(qualities(M)[0] == doctest::Approx(1).epsilon(1e-4 * 1e-11 / height + 1e-13));
        CHECK(qualityStatistics(M).inverted == 0);
      }
  }

  TEST_CASE("Table I: min, max, mean, standard deviation, histogram") {
    Mesh M = shapes::unsymmetricStar();
    const std::vector<double> q = qualities(M);
    const QualityStatistics table = qualityStatistics(M);
    double mean = 0, square = 0;
    std::array<int, 20> histogram{};
    for (double value : q) {
      mean += value / 8;
      square += value * value / 8;
      for (int i = 0; i < 20; ++i)
        if (value >= i / 20. && (value < (i + 1) / 20. || i == 19)) ++histogram[i];
    }
    CHECK(table.mean == doctest::Approx(mean).epsilon(1e-14));
    CHECK(table.stdDev == doctest::Approx(std::sqrt(square - mean * mean)).epsilon(1e-9));
    CHECK(table.min == *std::min_element(q.begin(), q.end()));
    CHECK(table.max == *std::max_element(q.begin(), q.end()));
    CHECK(table.min < table.max);
    CHECK(table.histogram == histogram);
  }

  TEST_CASE("Table I: of a list of q, those of 0 are inverted, 1 counts in the last bar") {
    const QualityStatistics table = qualityStatistics(std::vector<double>{1, .95, .5, 0, .049});
    CHECK(table.tetrahedra == 5);
    CHECK(table.inverted == 1);
    CHECK(table.min == 0);
    CHECK(table.max == 1);
    std::array<int, 20> histogram{};
    histogram[0] = histogram[19] = 2, histogram[10] = 1;
    CHECK(table.histogram == histogram);
    CHECK(qualityStatistics(std::vector<double>{}).tetrahedra == 0);
    CHECK(qualityStatistics(std::vector<double>(7, .6)).stdDev == doctest::Approx(0));
  }

  TEST_CASE(
      "Table I: without computational coordinates the ideal is regular, in either orientation") {
    Mesh M = shapes::twoTetrahedra();
    const QualityStatistics table = qualityStatistics(M);
    CHECK(table.mean == qualityStatistics(M, Ideal::regular).mean);
    CHECK(table.min > 0);
    for (auto& t : M.tets) std::swap(t[0], t[1]);
    CHECK(qualityStatistics(M).min == doctest::Approx(table.min).epsilon(1e-13));
  }

  TEST_CASE("Table I: q of a bisected and moved mesh from those before") {
    const Mesh before = boxMesh({0, 0, 0}, {1, 1, 1}, {3, 3, 3});
    const std::vector<double> q = qualities(before);
    Mesh M = before;
    bisect(M, {5, 80});
    M.x[21] += {.05, -.02, .04};
    std::size_t other = 0;  // whose q is anew
    const std::vector<double> after = qualities(M, before.x, q);
    REQUIRE(after.size() == M.tets.size());
    for (std::size_t E = 0; E < q.size(); ++E) other += after[E] != q[E];
    CHECK(M.tets.size() > before.tets.size());
    CHECK(other > 10);
    CHECK(other < 40);
    CHECK(after == qualities(M));
    CHECK(qualityStatistics(after).mean == qualityStatistics(M).mean);
    // what has the nodes and places of before is not computed
    CHECK(qualities(M, M.x, std::vector<double>(M.tets.size(), .25)) ==
          std::vector<double>(M.tets.size(), .25));
  }

  TEST_CASE("Table I: a node that is not there is refused") {
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {1, 1, 1});
    for (int n : {8, -1}) {
      M.tets[2][3] = n;
      CHECK_THROWS_AS(qualityStatistics(M), InputError);
      CHECK_THROWS_AS(qualities(M, Ideal::regular), InputError);
    }
  }

  TEST_CASE("Table I: no elements, all zero") {
    const QualityStatistics table = qualityStatistics(Mesh{});
    CHECK(table.tetrahedra == 0);
    CHECK(table.mean == 0);
  }
}
