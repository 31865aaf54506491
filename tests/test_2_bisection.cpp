// SPDX-License-Identifier: MIT
//
// §2: the box meccano and Kossaczky's bisection [17].
#include <doctest/doctest.h>

#include <set>

#include "shapes.hpp"

using namespace meccano;

namespace {

/// splitmix64: an int below `count`.
class Dice {
 public:
  explicit Dice(std::uint64_t seed) : state_(seed) {}
  int below(std::size_t count) {
    std::uint64_t z = state_ += 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return static_cast<int>((z ^ (z >> 31)) % count);
  }

 private:
  std::uint64_t state_;
};

std::vector<int> allOf(const Mesh& M) {
  std::vector<int> E(M.tets.size());
  for (std::size_t i = 0; i < E.size(); ++i) E[i] = static_cast<int>(i);
  return E;
}

bool has(const std::array<int, 4>& tet, std::size_t n) {
  return std::count(tet.begin(), tet.end(), static_cast<int>(n)) == 1;
}

/// Hundreds of refinements of one tetrahedron each, half of them near one point.
Mesh locallyRefined(Mesh M, std::uint64_t seed, int times) {
  Dice dice(seed);
  for (int i = 0; i < times; ++i) {
    int E = dice.below(M.tets.size());
    if (i % 2 == 0)
      for (int tries = 0; tries < 20; ++tries) {
        const int other = dice.below(M.tets.size());
        const Vec3 p{.7, .3, .6};
        if (norm(M.xi[M.tets[other][0]] - p) < norm(M.xi[M.tets[E][0]] - p)) E = other;
      }
    if (M.level[E] < 15) bisect(M, {E});
  }
  return M;
}

// ---- Maubach's bisection, literally, on computational coordinates ----

using Point = std::array<double, 3>;
using Simplex = std::array<Point, 4>;

Point middleOf(const Point& a, const Point& b) {
  return {(a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2};
}

Simplex sortedSimplex(Simplex s) {
  std::sort(s.begin(), s.end());
  return s;
}

/// Bisects x0 x_d; the children have tag d - 1, after 1 again 3.
std::array<Simplex, 2> maubach(const Simplex& x, int d) {
  const Point m = middleOf(x[0], x[d]);
  Simplex child0 = x, child1 = x;
  child0[d] = m;                                     // x0 .. x_{d-1}, m, x_{d+1} ..
  for (int i = 0; i < d; ++i) child1[i] = x[i + 1];  // x1 .. x_d
  child1[d] = m;                                     // m, x_{d+1} ..
  return {child0, child1};
}
int nextTag(int d) { return d > 1 ? d - 1 : 3; }

/// The six paths x0 x1 x2 x3 of each cube of the box.
std::vector<Simplex> kuhnPaths(std::array<int, 3> cells) {
  std::vector<Simplex> paths;
  for (int i = 0; i < cells[0]; ++i)
    for (int j = 0; j < cells[1]; ++j)
      for (int k = 0; k < cells[2]; ++k) {
        std::array<int, 3> axes{0, 1, 2};
        do {
          Simplex x;
          x[0] = {double(i), double(j), double(k)};
          for (int s = 0; s < 3; ++s) {
            x[s + 1] = x[s];
            x[s + 1][axes[s]] += 1;
          }
          paths.push_back(x);
        } while (std::next_permutation(axes.begin(), axes.end()));
      }
  return paths;
}

std::set<Simplex> simplicesOf(const Mesh& M) {
  std::set<Simplex> all;
  for (const auto& z : M.tets) {
    Simplex s;
    for (int i = 0; i < 4; ++i) s[i] = {M.xi[z[i]].x, M.xi[z[i]].y, M.xi[z[i]].z};
    all.insert(sortedSimplex(s));
  }
  return all;
}

/// Takes the leaves below x, d out of the set; true if they fill it.
bool takeLeaves(std::set<Simplex>& leaves, const Simplex& x, int d, int depth) {
  if (leaves.erase(sortedSimplex(x)) == 1) return true;
  if (depth == 0) return false;
  const std::array<Simplex, 2> children = maubach(x, d);
  return takeLeaves(leaves, children[0], nextTag(d), depth - 1) &&
         takeLeaves(leaves, children[1], nextTag(d), depth - 1);
}

/// The shape of a tetrahedron up to similarity and mirroring: the six squared lengths over the
/// largest, the smallest sequence of all vertex orders. Exact: dyadic numbers.
std::array<double, 6> shapeOf(const std::array<Vec3, 4>& p) {
  std::array<double, 6> least;
  least.fill(2);
  std::array<int, 4> order{0, 1, 2, 3};
  double longest = 0;
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < i; ++j) longest = std::max(longest, norm2(p[i] - p[j]));
  do {
    std::array<double, 6> lengths;
    int count = 0;
    for (int i = 0; i < 4; ++i)
      for (int j = 0; j < i; ++j) lengths[count++] = norm2(p[order[i]] - p[order[j]]) / longest;
    least = std::min(least, lengths);
  } while (std::next_permutation(order.begin(), order.end()));
  return least;
}

std::array<Vec3, 4> placesOf(const std::vector<Vec3>& x, const std::array<int, 4>& z) {
  return {x[z[0]], x[z[1]], x[z[2]], x[z[3]]};
}

double at(Vec3 p, int axis) { return axis == 0 ? p.x : axis == 1 ? p.y : p.z; }

/// The sides of the box with n cells on which a point with these computational coordinates lies:
/// patch numbers 1 .. 6 (x-, x+, y-, y+, z-, z+).
std::set<int> sidesOf(Vec3 xi, std::array<int, 3> n) {
  std::set<int> sides;
  for (int axis = 0; axis < 3; ++axis) {
    if (at(xi, axis) == 0) sides.insert(2 * axis + 1);
    if (at(xi, axis) == n[axis]) sides.insert(2 * axis + 2);
  }
  return sides;
}

template <class Error, class Call>
std::string messageOf(Call call) {
  try {
    call();
  } catch (const Error& error) {
    return error.what();
  }
  return "nothing thrown";
}

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

}  // namespace

TEST_SUITE("2") {
  TEST_CASE("box: nodes, tetrahedra and volume") {
    const Mesh M = boxMesh({-1, 2, .5}, {3, 1, 2}, {3, 1, 2});
    CHECK(M.x.size() == 4 * 2 * 3);
    CHECK(M.tets.size() == 6 * 3 * 1 * 2);
    CHECK(shapes::totalVolume(M) == doctest::Approx(6).epsilon(1e-14));
    CHECK(shapes::countInverted(M) == 0);
    CHECK(shapes::conformityFault(M) == "");
    CHECK(M.patches.size() == 6);
    CHECK(M.curves.size() == 12);
    CHECK(M.corners.size() == 8);
    CHECK(M.cube == Vec3{1, 1, 1});
    CHECK(M.x.front() == Vec3{-1, 2, .5});
    CHECK(M.x.back() == Vec3{2, 3, 2.5});
  }

  TEST_CASE("box: refused sizes and cells") {
    const double nan = std::nan(""), infinite = std::numeric_limits<double>::infinity();
    auto box = [](Vec3 origin, Vec3 size, std::array<int, 3> cells) {
      return messageOf<InputError>([&] { boxMesh(origin, size, cells); });
    };
    CHECK(contains(box({0, 0, 0}, {1, 1, 1}, {2, 0, 2}), "number of cells"));
    CHECK(contains(box({0, 0, 0}, {1, 1, 1}, {2, 2, -1}), "number of cells"));
    for (double bad : {0., -3.})
      for (Vec3 size : {Vec3{bad, 1, 1}, Vec3{1, bad, 1}, Vec3{1, 1, bad}})
        CHECK(contains(box({0, 0, 0}, size, {2, 2, 2}), "size"));
    CHECK(contains(box({0, nan, 0}, {1, 1, 1}, {2, 2, 2}), "origin"));
    CHECK(contains(box({0, 0, 0}, {1, 1, nan}, {2, 2, 2}), "size"));
    CHECK(contains(box({0, 0, 0}, {infinite, 1, 1}, {2, 2, 2}), "finite"));
  }

  TEST_CASE("box: nodes lie on their entities") {
    const std::array<int, 3> cells{2, 3, 1};
    const Mesh M = boxMesh({-1, 2, .5}, {1, 2, 3}, cells);
    for (std::size_t n = 0; n < M.x.size(); ++n) {
      const std::size_t sides = sidesOf(M.xi[n], cells).size();
      REQUIRE(M.dimension[n] == 3 - sides);
      Vec3 x = M.x[n];
      if (sides == 1) x = varphi(surfaceOf(M, M.entity[n]), M.parameter[n]);
      if (sides == 2) x = gamma(M.curves[M.entity[n] - 1], M.parameter[n].x);
      if (sides == 3) x = M.corners[M.entity[n] - 1].x;
      CHECK(norm(x - M.x[n]) <= 1e-15);
    }
  }

  TEST_CASE("bisection: 6, 12, 24, 48 tetrahedra per cube, each level of the mesh alike") {
    Mesh M = shapes::kuhnCube();
    for (std::size_t expected : {6, 12, 24, 48, 96}) {
      CHECK(M.tets.size() == expected);
      CHECK(std::set<int>(M.level.begin(), M.level.end()).size() == 1);
      for (std::size_t E = 0; E < M.tets.size(); ++E) CHECK(M.type[E] == M.level[E] % 3);
      bisect(M, allOf(M));
    }
  }

  TEST_CASE("bisection: Maubach's form gives identical meshes, level by level") {
    const std::array<int, 3> cells{2, 1, 1};
    Mesh M = boxMesh({0, 0, 0}, {2, 1, 1}, cells);
    std::vector<Simplex> maubachs = kuhnPaths(cells);
    int tag = 3;
    for (int level = 0; level <= 6; ++level, tag = nextTag(tag)) {
      CAPTURE(level);
      std::set<Simplex> expected;
      for (const Simplex& x : maubachs) expected.insert(sortedSimplex(x));
      CHECK(simplicesOf(M) == expected);
      std::vector<Simplex> next;
      for (const Simplex& x : maubachs)
        for (const Simplex& child : maubach(x, tag)) next.push_back(child);
      maubachs = next;
      bisect(M, allOf(M));
    }
  }

  TEST_CASE("bisection: local refinements are leaves of Maubach's trees") {
    const std::array<int, 3> cells{2, 2, 1};
    for (std::uint64_t seed : {1, 2, 3}) {
      CAPTURE(seed);
      const Mesh M = locallyRefined(boxMesh({0, 0, 0}, {1, 1, 1}, cells), seed, 300);
      std::set<Simplex> leaves = simplicesOf(M);
      REQUIRE(leaves.size() == M.tets.size());
      bool filled = true;
      for (const Simplex& x : kuhnPaths(cells)) filled = filled && takeLeaves(leaves, x, 3, 20);
      CHECK(filled);
      CHECK(leaves.empty());
    }
  }

  TEST_CASE("bisection: exactly three similarity classes, one for each type") {
    const Mesh M = locallyRefined(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), 4, 400);
    std::array<std::set<std::array<double, 6>>, 3> classes;
    std::set<std::array<double, 6>> all;
    for (std::size_t E = 0; E < M.tets.size(); ++E) {
      const auto shape = shapeOf(placesOf(M.xi, M.tets[E]));
      classes[M.level[E] % 3].insert(shape);
      all.insert(shape);
    }
    for (const auto& oneType : classes) CHECK(oneType.size() == 1);
    CHECK(all.size() == 3);
  }

  TEST_CASE(
      "bisection: the refinement edge is the unique longest edge, sqrt 3, sqrt 2, 1 times the "
      "cube's") {
    const Mesh M = locallyRefined(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), 5, 300);
    for (std::size_t E = 0; E < M.tets.size(); ++E) {
      const auto p = placesOf(M.xi, M.tets[E]);
      const double cube = std::ldexp(1., -(M.level[E] / 3)), longest = norm2(p[1] - p[0]);
      CHECK(longest == (3 - M.level[E] % 3) * cube * cube);
      for (int i = 0; i < 4; ++i)
        for (int j = std::max(2, i + 1); j < 4; ++j) CHECK(norm2(p[j] - p[i]) < longest);
    }
  }

  TEST_CASE(
      "bisection: q = 1 against the own computational counterpart, .7559526 .7619525 .8 against "
      "the regular one") {
    Mesh M = boxMesh({1, 2, 3}, {2, 2, 2}, {2, 2, 2});
    for (int level = 0; level < 6; ++level) {
      CAPTURE(level);
      for (double q : qualities(M)) CHECK(q == doctest::Approx(1).epsilon(1e-14));
      const double expected[3] = {.7559526, .7619525, .8};
      for (double q : qualities(M, Ideal::regular)) CHECK(std::abs(q - expected[level % 3]) < 1e-7);
      bisect(M, allOf(M));
    }
    const Mesh local = locallyRefined(boxMesh({1, 2, 3}, {2, 2, 2}, {2, 2, 2}), 6, 200);
    for (double q : qualities(local)) CHECK(q == doctest::Approx(1).epsilon(1e-14));
  }

  TEST_CASE("bisection: volume and conformity are kept in hundreds of random local refinements") {
    for (std::uint64_t seed : {11, 12, 13}) {
      CAPTURE(seed);
      const Mesh M = locallyRefined(boxMesh({0, 0, 0}, {1, 2, 1.5}, {2, 2, 3}), seed, 400);
      CHECK(M.tets.size() > 1000);
      CHECK(shapes::totalVolume(M) == doctest::Approx(3).epsilon(1e-13));
      CHECK(shapes::countInverted(M) == 0);
      CHECK(shapes::conformityFault(M) == "");
    }
  }

  TEST_CASE(
      "bisection: the requested tetrahedra are bisected, the index kept by child 0, child 1 "
      "appended") {
    Mesh M = locallyRefined(shapes::kuhnCube(), 14, 60);
    const Mesh before = M;
    const std::vector<int> E{3, 17, 40};
    bisect(M, E);
    for (int t : E) {
      CHECK(M.level[t] > before.level[t]);
      CHECK(M.tets[t] != before.tets[t]);
      CHECK(M.tets[t][0] == before.tets[t][0]);  // child 0 holds z0
    }
    for (std::size_t n = 0; n < before.x.size(); ++n) CHECK(M.x[n] == before.x[n]);
    CHECK(M.tets.size() > before.tets.size());
  }

  TEST_CASE(
      "bisection: a new node is the exact midpoint of its edge, also in a box off the origin") {
    Mesh M = boxMesh({.1, -.3, 7}, {.7, 1.1, .9}, {1, 1, 1});
    Dice dice(15);
    // new nodes on edges of the mesh before; the closure splits edges of its own, too
    int found = 0;
    for (int i = 0; i < 200; ++i) {
      const Mesh before = M;
      bisect(M, {dice.below(M.tets.size())});
      for (std::size_t n = before.x.size(); n < M.x.size(); ++n)
        for (const auto& z : before.tets) {
          if (!(.5 * (M.xi[z[0]] + M.xi[z[1]]) == M.xi[n])) continue;
          ++found;
          const Vec3 middle = .5 * (M.x[z[0]] + M.x[z[1]]);
          CHECK(norm(M.x[n] - middle) <=
                (M.dimension[n] == 3 ? 0 : 4e-15));  // rounding of varphi and gamma
          break;
        }
    }
    CHECK(found > 200);
  }

  TEST_CASE("bisection: boundary labels, dimensions, entities and parameters are inherited") {
    const std::array<int, 3> cells{2, 1, 2};
    const Mesh M = locallyRefined(boxMesh({-1, 2, .5}, {1, 2, 3}, cells), 16, 400);
    for (std::size_t E = 0; E < M.tets.size(); ++E)
      for (int i = 0; i < 4; ++i) {
        std::set<int> common{1, 2, 3, 4, 5, 6};
        for (int n : shapes::faceOf(M.tets[E], i)) {
          const std::set<int> sides = sidesOf(M.xi[n], cells);
          for (int side = 1; side <= 6; ++side)
            if (!sides.count(side)) common.erase(side);
        }
        CHECK(M.faceLabel[E][i] == (common.empty() ? 0 : -*common.begin()));
      }
    for (std::size_t n = 0; n < M.x.size(); ++n) {
      const std::set<int> sides = sidesOf(M.xi[n], cells);
      REQUIRE(M.dimension[n] == 3 - sides.size());
      Vec3 x = M.x[n];
      if (sides.empty()) CHECK(M.entity[n] == 0);
      if (sides.size() == 1) {
        CHECK(M.entity[n] == -*sides.begin());
        x = varphi(surfaceOf(M, M.entity[n]), M.parameter[n]);
      }
      if (sides.size() == 2) {
        const Curve& C = M.curves[M.entity[n] - 1];
        std::set<int> patches;
        for (const Curve::Side& side : C.sides) patches.insert(-side.surface);
        CHECK(patches == sides);
        x = gamma(C, M.parameter[n].x);
      }
      if (sides.size() == 3) x = M.corners[M.entity[n] - 1].x;
      CHECK(norm(x - M.x[n]) <= 1e-14);
    }
  }

  TEST_CASE("bisection: boundary patches keep their area") {
    const Mesh M = locallyRefined(boxMesh({0, 0, 0}, {1, 2, 3}, {1, 1, 2}), 17, 200);
    const double expected[6] = {6, 6, 3, 3, 2, 2};
    for (int p = 1; p <= 6; ++p) {
      double area = 0;
      for (const auto& f : surfaceFaces(M, -p))
        area += .5 * norm(cross(M.x[f[1]] - M.x[f[0]], M.x[f[2]] - M.x[f[0]]));
      CHECK(area == doctest::Approx(expected[p - 1]).epsilon(1e-13));
    }
  }

  TEST_CASE("bisection: the adjacency kept up is the one computed afresh") {
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {1, 2, 1});
    Bisection bisection(M);
    Dice dice(18);
    for (int i = 0; i < 200; ++i) bisection.bisect(dice.below(M.tets.size()));
    CHECK(bisection.neighbour == faceNeighbours(M));
    CHECK(bisection.splits.size() == M.tets.size() - 12);
    for (std::size_t n = 0; n < M.x.size(); ++n) CHECK(has(M.tets[bisection.tetOf[n]], n));
    for (int n : {0, 5, 40}) {
      std::vector<int> around;
      bisection.star(n, around);
      std::set<int> expected;
      for (std::size_t E = 0; E < M.tets.size(); ++E)
        if (std::count(M.tets[E].begin(), M.tets[E].end(), n)) expected.insert(static_cast<int>(E));
      CHECK(std::set<int>(around.begin(), around.end()) == expected);
    }
  }

  TEST_CASE("bisection: bisectEdge splits the edge asked for and no other way than by closure") {
    Mesh M = locallyRefined(boxMesh({0, 0, 0}, {1, 1, 1}, {1, 1, 1}), 19, 40);
    Dice dice(20);
    for (int i = 0; i < 60; ++i) {
      const auto z = M.tets[dice.below(M.tets.size())];
      const int a = z[dice.below(4)], b = z[dice.below(4)];
      if (a == b) continue;
      const Vec3 middle = .5 * (M.xi[a] + M.xi[b]);
      Bisection bisection(M);
      bisection.bisectEdge(a, b);
      CHECK(bisection.tetWithEdge(a, b) == -1);
      CHECK(std::count(M.xi.begin(), M.xi.end(), middle) == 1);
      REQUIRE(shapes::conformityFault(M) == "");
    }
  }

  TEST_CASE("bisection: a mesh that is no bisection of Kuhn cubes is refused, the closure ends") {
    // three tetrahedra around the edge 0 1, each waiting for the next one's refinement edge
    Mesh M;
    M.xi = {{1, 1, 0}, {1, 1, 1}, {2, 1, 0}, {.5, 1.8, 0}, {.5, .2, 0}};
    M.x = M.xi;
    M.tets = {{0, 2, 3, 1}, {0, 3, 4, 1}, {0, 4, 2, 1}};
    M.type.assign(3, 0);
    M.level.assign(3, 0);
    M.faceLabel.assign(3, {0, 0, 0, 0});
    M.dimension.assign(5, 3);
    M.entity.assign(5, 0);
    M.parameter.assign(5, {});
    const std::string message = messageOf<MethodError>([&] { bisect(M, {0}); });
    CHECK(contains(message, "no bisection of Kuhn cubes"));
  }

  TEST_CASE("box: sizes that leave no digits for the cells are refused") {
    CHECK(contains(messageOf<InputError>([] {
                     boxMesh({1e20, 0, 0}, {1, 1, 1}, {2, 2, 2});
                   }),
                   "digits"));
    CHECK(contains(messageOf<InputError>([] {
                     boxMesh({0, 0, 0}, {1e300, 1, 1}, {1, 1, 1});
                   }),
                   "digits"));
  }

  TEST_CASE("neighbours: two tetrahedra see each other across their common face") {
    const Mesh M = shapes::twoTetrahedra();
    const auto neighbour = faceNeighbours(M);
    CHECK(neighbour[0] == std::array<int, 4>{1, -1, -1, -1});
    CHECK(neighbour[1] == std::array<int, 4>{-1, -1, -1, 0});
  }

  TEST_CASE("neighbours: a face with three tetrahedra is refused") {
    Mesh M = shapes::twoTetrahedra();
    M.x.push_back({2, 2, 2});
    M.tets.push_back({1, 2, 3, 5});
    CHECK(contains(messageOf<InputError>([&] { faceNeighbours(M); }), "more than two tetrahedra"));
  }

  TEST_CASE("checks of the tests: exact signs, shapes and disks") {
    // a point one unit in the last place off a plane through inexact thirds
    const Vec3 a{1. / 3, .1, .7}, b{2. / 3, .2, .7}, c{.9, .4, .7},
        d{.5, .5, std::nextafter(.7, 1.)};
    CHECK(shapes::orientation(a, b, c, d) == 1);
    CHECK(shapes::orientation(a, c, b, d) == -1);
    CHECK(shapes::orientation(a, b, c, {.5, .5, .7}) == 0);
    for (const Mesh& M :
         {shapes::oneTetrahedron(), shapes::twoTetrahedra(), shapes::unsymmetricStar()}) {
      CHECK(shapes::countInverted(M) == 0);
      CHECK(shapes::totalVolume(M) > 0);
      CHECK(shapes::conformityFault(M) == "");
    }
    CHECK(shapes::isDisk({{0, 1, 2}, {0, 2, 3}}));
    CHECK_FALSE(shapes::isDisk({{0, 1, 2}, {2, 3, 4}}));                        // a pinch
    CHECK_FALSE(shapes::isDisk({{0, 1, 2}, {0, 3, 1}, {1, 3, 2}, {0, 2, 3}}));  // closed
    CHECK(shapes::maxDistanceToSurface({{.2, .2, 3}, {-4, 0, 0}},
                                       {{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}}, {{0, 1, 2}}, ""}) == 4);
  }
}
