// SPDX-License-Identifier: MIT
// §3.3: eq. (2), the 2x2x2 rule, and what healing makes of T.
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <bitset>
#include <cmath>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "../meccano.hpp"
#include "../samples/surfaces.hpp"
#include "shapes.hpp"

using namespace meccano;
using shapes::Edge;
using shapes::Face;
using shapes::Steps;

namespace {

/// Eq. (2) with the real tetrahedra: edges, faces and cells of T at node n, counted one by one.
struct Counts {
  int nE, nF, nC;
};
Counts countAt(const Mesh& M, const std::vector<int>& T, int n) {
  std::set<Edge> edges;
  std::set<Face> faces;
  int cells = 0;
  for (int E : T) {
    const auto& z = M.tets[E];
    if (std::find(z.begin(), z.end(), n) == z.end()) continue;
    ++cells;
    for (int i = 0; i < 4; ++i) {
      if (z[i] != n) edges.insert(shapes::sortedEdge(n, z[i]));
      const Face f = shapes::faceOf(z, i);
      if (std::find(f.begin(), f.end(), n) != f.end()) faces.insert(f);
    }
  }
  return {static_cast<int>(edges.size()), static_cast<int>(faces.size()), cells};
}

/// Whether the faces of dT at node n are one fan: their outer edges make one closed ring. The
/// definition of a surface at n, without any Euler characteristic.
bool isOneFan(const Mesh& M, const std::vector<int>& T, int n) {
  std::map<Face, int> count;
  for (int E : T)
    for (int i = 0; i < 4; ++i) {
      const Face f = shapes::faceOf(M.tets[E], i);
      if (std::find(f.begin(), f.end(), n) != f.end()) ++count[f];
    }
  std::map<int, std::vector<int>> ring;  // neighbours along the ring
  for (const auto& [f, times] : count) {
    if (times != 1) continue;
    std::vector<int> others;
    for (int v : f)
      if (v != n) others.push_back(v);
    ring[others[0]].push_back(others[1]);
    ring[others[1]].push_back(others[0]);
  }
  if (ring.empty()) return true;  // inside T, or off it
  for (const auto& [v, next] : ring)
    if (next.size() != 2) return false;
  const int start = ring.begin()->first;
  std::size_t length = 0;
  for (int previous = -1, at = start;;) {
    const int next = ring[at][0] != previous ? ring[at][0] : ring[at][1];
    previous = at, at = next;
    ++length;
    if (at == start) break;
  }
  return length == ring.size();
}

/// Eight cubes around an inner node, as cells (level 0) or as eighths of one cell (level 3).
struct EightCubes {
  Mesh M;
  int node = -1;
  explicit EightCubes(bool refined) : M(boxMesh({0, 0, 0}, {2, 2, 2}, {2, 2, 2})) {
    if (refined) {
      M = boxMesh({0, 0, 0}, {2, 2, 2}, {1, 1, 1});
      for (int level = 0; level < 3; ++level) {
        std::vector<int> all;
        for (std::size_t E = 0; E < M.tets.size(); ++E)
          if (M.level[E] == level) all.push_back(static_cast<int>(E));
        bisect(M, all);
      }
    }
    for (std::size_t n = 0; n < M.x.size(); ++n)
      if (M.x[n] == Vec3{1, 1, 1}) node = static_cast<int>(n);
  }
  /// The tetrahedra of the cubes in the mask: bit x + 2 y + 4 z for the sides of the node.
  std::vector<int> elements(unsigned mask) const {
    std::vector<int> T;
    for (std::size_t E = 0; E < M.tets.size(); ++E) {
      const auto& z = M.tets[E];
      const Vec3 c = .25 * (M.x[z[0]] + M.x[z[1]] + M.x[z[2]] + M.x[z[3]]);
      const int cube = (c.x > 1) + 2 * (c.y > 1) + 4 * (c.z > 1);
      if (mask >> cube & 1) T.push_back(static_cast<int>(E));
    }
    return T;
  }
};

/// T of whole cells of a box: those for which wanted(i, j, k).
template <class Wanted>
Approximation cells(const Mesh& M, Wanted wanted) {
  Approximation A;
  for (const auto& z : M.tets) {
    const Vec3 c = .25 * (M.xi[z[0]] + M.xi[z[1]] + M.xi[z[2]] + M.xi[z[3]]);
    const bool in = wanted(static_cast<int>(c.x), static_cast<int>(c.y), static_cast<int>(c.z));
    A.T.push_back(in ? 1 : 0);
  }
  return A;
}

std::vector<int> elementsOf(const Approximation& A) {
  std::vector<int> T;
  for (std::size_t E = 0; E < A.T.size(); ++E)
    if (A.T[E]) T.push_back(static_cast<int>(E));
  return T;
}

/// The faces of dT: those of one element of T.
std::vector<Face> boundaryOf(const Mesh& M, const std::vector<int>& T) {
  std::map<Face, int> count;
  for (int E : T)
    for (int i = 0; i < 4; ++i) ++count[shapes::faceOf(M.tets[E], i)];
  std::vector<Face> faces;
  for (const auto& [f, times] : count)
    if (times == 1) faces.push_back(f);
  return faces;
}

/// What §3.3 promises of T, each by itself.
void checkHealed(const Mesh& M, const Approximation& A) {
  REQUIRE(A.T.size() == M.tets.size());
  CHECK(shapes::conformityFault(M) == "");
  const std::vector<int> T = elementsOf(A);
  const double scale = std::ldexp(1., A.level / 3);
  // whole cubes: their volume is that of the elements
  std::set<std::array<double, 3>> cubes;
  double volume = 0;
  int coarse = 0;
  for (int E : T) {
    const auto& z = M.tets[E];
    const Vec3 c = .25 * scale * (M.xi[z[0]] + M.xi[z[1]] + M.xi[z[2]] + M.xi[z[3]]);
    cubes.insert({std::floor(c.x), std::floor(c.y), std::floor(c.z)});
    const Vec3 a = M.xi[z[0]];
    volume += std::abs(dot(M.xi[z[1]] - a, cross(M.xi[z[2]] - a, M.xi[z[3]] - a))) / 6;
    coarse += M.level[E] < A.level;
  }
  CHECK(coarse == 0);
  CHECK(
      volume ==
      doctest::Approx(static_cast<double>(cubes.size()) / (scale * scale * scale)).epsilon(1e-12));
  // faces of dT: in lattice planes, parallel to a coordinate plane
  int skew = 0;
  std::set<int> nodes;
  for (const Face& f : boundaryOf(M, T)) {
    auto flat = [&](double a, double b, double c) {
      return a == b && a == c && a * scale == std::floor(a * scale);
    };
    const Vec3 a = M.xi[f[0]], b = M.xi[f[1]], c = M.xi[f[2]];
    skew += !flat(a.x, b.x, c.x) && !flat(a.y, b.y, c.y) && !flat(a.z, b.z, c.z);
    nodes.insert(f.begin(), f.end());
  }
  CHECK(skew == 0);
  int noDisk = 0, notOne = 0;
  for (int n : nodes) {
    std::vector<int> around;
    for (int E : T)
      if (std::find(M.tets[E].begin(), M.tets[E].end(), n) != M.tets[E].end()) around.push_back(E);
    const Counts c = countAt(M, around, n);
    notOne += chi(c.nE, c.nF, c.nC) != 1;
    noDisk += !isOneFan(M, around, n);
  }
  CHECK(notOne == 0);
  CHECK(noDisk == 0);
}

/// dT as squares: a sphere, each edge two squares that know each other, covering the faces of dT.
void checkSquares(const Mesh& M, const Approximation& A, const SquareSurface& Q) {
  std::map<Edge, std::vector<std::pair<int, int>>> uses;
  std::set<int> nodes;
  for (std::size_t i = 0; i < Q.squares.size(); ++i)
    for (int e = 0; e < 4; ++e) {
      const auto& n = Q.squares[i].node;
      uses[shapes::sortedEdge(n[e], n[(e + 1) % 4])].push_back({static_cast<int>(i), e});
      nodes.insert(n[e]);
    }
  int wrong = 0;
  for (const auto& [edge, at] : uses) {
    REQUIRE(at.size() == 2);
    for (int k = 0; k < 2; ++k) {
      const Square& s = Q.squares[at[k].first];
      wrong += s.across[at[k].second] != at[1 - k].first ||
               s.acrossEdge[at[k].second] != at[1 - k].second;
      const Square& t = Q.squares[at[1 - k].first];  // oriented: the edge runs the other way there
      wrong += s.node[at[k].second] != t.node[(at[1 - k].second + 1) % 4];
    }
  }
  CHECK(wrong == 0);
  CHECK(static_cast<int>(nodes.size()) - static_cast<int>(uses.size()) +
            static_cast<int>(Q.squares.size()) ==
        2);
  CHECK(std::vector<int>(nodes.begin(), nodes.end()) == Q.nodes);
  double area = 0, squares = 0;
  for (const Face& f : boundaryOf(M, elementsOf(A)))
    area += .5 * norm(cross(M.xi[f[1]] - M.xi[f[0]], M.xi[f[2]] - M.xi[f[0]]));
  double flux = 0;  // outward: the divergence theorem gives the volume of T
  for (const Square& s : Q.squares) {
    const Vec3 normal = cross(M.xi[s.node[1]] - M.xi[s.node[0]], M.xi[s.node[3]] - M.xi[s.node[0]]);
    squares += norm(normal);
    flux += dot(normal, M.xi[s.node[0]]) / 3;
  }
  CHECK(squares == doctest::Approx(area).epsilon(1e-12));
  CHECK(flux > 0);
  CHECK(Q.level == A.level);
}

TriangleSurface bumpySheet() { return samples::sine2(.1); }

}  // namespace

TEST_SUITE("3.3") {
  TEST_CASE("eq. (2): chi = n_E - n_F + n_C; a half ball around a node has chi = 1, a ball 2") {
    CHECK(chi(9, 16, 8) == 1);  // four cubes below a plane: 5 half axes, 8 quarter planes, 4 cubes
    for (unsigned half : {0x0Fu, 0xF0u, 0x33u, 0xCCu, 0x55u, 0xAAu}) {
      CHECK(chi(half) == 1);
      CHECK(chi(5, 8, 4) == 1);
      CHECK(isLocalDisk(half));
    }
    CHECK(chi(255u) == 2);  // inside T
    CHECK(chi(0u) == 0);
    for (int c = 0; c < 8; ++c) {
      CHECK(chi(1u << c) == 1);  // the corner of one cube
      CHECK(isLocalDisk(1u << c));
      CHECK(isLocalDisk(255u & ~(1u << c)));
    }
  }

  TEST_CASE(
      "eq. (2): agrees with edges, faces and cells counted on the tetrahedra, all 255 cases") {
    for (bool refined : {false, true}) {
      const EightCubes eight(refined);
      REQUIRE(eight.node >= 0);
      for (unsigned mask = 1; mask < 256; ++mask) {
        const Counts c = countAt(eight.M, eight.elements(mask), eight.node);
        CAPTURE(mask);
        CHECK(chi(mask) == chi(c.nE, c.nF, c.nC));
        CHECK(chi(c.nE, c.nF, c.nC) == c.nE - c.nF + c.nC);
      }
    }
  }

  TEST_CASE("eq. (2): two cubes that share an edge only have chi = 1 and are no disk") {
    const EightCubes eight(false);
    const unsigned mask = 1u << 0 | 1u << 3;  // at (-,-,-) and (+,+,-): the half axis z- in common
    CHECK(chi(5, 6, 2) == 1);
    CHECK(chi(mask) == 1);
    CHECK_FALSE(isOneFan(eight.M, eight.elements(mask), eight.node));
    CHECK_FALSE(isLocalDisk(mask));
    CHECK_FALSE(isLocalDisk(255u & ~mask));  // the same boundary seen from the other side
  }

  TEST_CASE("eq. (2): a disk plus an annulus has chi = 1 and is no disk") {
    // Eight cubes have no room for it, the tetrahedra around a node have.
    const EightCubes eight(true);
    std::vector<int> around;
    for (std::size_t E = 0; E < eight.M.tets.size(); ++E) {
      const auto& z = eight.M.tets[E];
      if (std::find(z.begin(), z.end(), eight.node) != z.end())
        around.push_back(static_cast<int>(E));
    }
    auto touch = [&](int E, int F) {  // share more than the node
      int common = 0;
      for (int n : eight.M.tets[E])
        common += std::count(eight.M.tets[F].begin(), eight.M.tets[F].end(), n) > 0;
      return common > 1;
    };
    int found = 0;
    for (int disk : around)
      for (int hole : around) {
        if (touch(disk, hole)) continue;
        std::vector<int> annulus, both{disk};
        for (int E : around)
          if (E != hole && !touch(E, disk)) annulus.push_back(E);
        const Counts ring = countAt(eight.M, annulus, eight.node);
        if (chi(ring.nE, ring.nF, ring.nC) != 0) continue;
        both.insert(both.end(), annulus.begin(), annulus.end());
        const Counts c = countAt(eight.M, both, eight.node);
        CHECK(chi(c.nE, c.nF, c.nC) == 1);
        CHECK_FALSE(isOneFan(eight.M, both, eight.node));
        ++found;
      }
    CHECK(found > 0);
  }

  TEST_CASE("eq. (2): isLocalDisk is true exactly where dT is one fan, all 256 cases") {
    const EightCubes eight(false);
    int fooled = 0, disks = 0;
    for (unsigned mask = 0; mask < 256; ++mask) {
      const bool fan = isOneFan(eight.M, eight.elements(mask), eight.node);
      CAPTURE(std::bitset<8>(mask).to_string());
      CHECK(isLocalDisk(mask) == fan);
      fooled += chi(mask) == 1 && !fan;
      disks += fan;
    }
    CHECK(fooled > 0);  // eq. (2) alone does not do
    CHECK(disks > 50);
  }

  TEST_CASE("isFaceConnected: agrees with a search through common faces") {
    for (unsigned mask = 1; mask < 256; ++mask) {
      shapes::Joined joined(8);
      for (int a = 0; a < 8; ++a)
        for (int b = 0; b < 8; ++b)
          if ((mask >> a & 1) && (mask >> b & 1) && std::bitset<3>(a ^ b).count() == 1)
            joined.join(a, b);
      std::set<int> roots;
      for (int a = 0; a < 8; ++a)
        if (mask >> a & 1) roots.insert(joined.root(a));
      CAPTURE(mask);
      CHECK(isFaceConnected(mask) == (roots.size() == 1));
    }
  }

  TEST_CASE("healing: whole cubes, faces on lattice planes, local disks, a sphere of squares") {
    const struct {
      TriangleSurface S;
      double lc;
    } tries[] = {{samples::sine(.1, 24), .12},
                 {samples::plane(45, 45), .12},
                 {bumpySheet(), .2},
                 {samples::randomPatch(4), .12},
                 {samples::threeLobed(), .1}};
    for (const auto& t : tries) {
      CAPTURE(t.S.name);
      Steps steps(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), t.S);
      steps.approximate(t.lc);
      // T only grows: the computational box of each element stays covered
      double before = 0;
      for (int E : elementsOf(steps.A)) before += std::ldexp(1., -steps.M.level[E]);
      steps.heal();
      double after = 0;
      for (int E : elementsOf(steps.A)) after += std::ldexp(1., -steps.M.level[E]);
      CHECK(after >= before);
      CHECK(shapes::totalVolume(steps.M) == doctest::Approx(1).epsilon(1e-13));
      checkHealed(steps.M, steps.A);
      checkSquares(steps.M, steps.A, steps.Q);
      // again: nothing
      const Mesh mesh = steps.M;
      const std::vector<char> T = steps.A.T;
      volumetricHealing(steps.B, steps.A);
      CHECK(shapes::sameMesh(mesh, steps.M));
      CHECK(T == steps.A.T);
    }
  }

  TEST_CASE("healing: cubes that share an edge or a node only are joined") {
    for (int shared : {0, 1}) {  // a node, an edge
      Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {4, 4, 4});
      Bisection B(M);
      Approximation A = cells(M, [&](int i, int j, int k) {
        return (i == 1 && j == 1 && k == 1) || (i == 2 && j == 2 && k == (shared ? 1 : 2));
      });
      const std::size_t cubes = elementsOf(A).size() / 6;
      CHECK(cubes == 2);
      volumetricHealing(B, A);
      checkHealed(M, A);
      checkSquares(M, A, boundarySquares(M, A));
      CHECK(elementsOf(A).size() > 12);
    }
  }

  TEST_CASE("healing: an element completes its cube, a coarser neighbour is refined first") {
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {3, 3, 3});
    Bisection B(M);
    for (int i = 0; i < 3; ++i) B.bisect(6 * 13);  // the middle cell, one element of level 3
    Approximation A;
    A.level = 3;
    A.T.assign(M.tets.size(), 0);
    A.T[6 * 13] = 1;
    volumetricHealing(B, A);
    checkHealed(M, A);
    const std::vector<int> T = elementsOf(A);
    CHECK(T.size() == 6);
    const SquareSurface Q = boundarySquares(M, A);
    CHECK(Q.squares.size() == 6);
    CHECK(Q.nodes.size() == 8);
    CHECK(Q.h == doctest::Approx(1. / 6));
    checkSquares(M, A, Q);
  }

  TEST_CASE("healing: T that has to grow into the boundary is refused") {
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
    Bisection B(M);
    Approximation A = cells(M, [](int i, int j, int k) { return i == j && k == 0; });
    CHECK_THROWS_AS(volumetricHealing(B, A), MethodError);
  }

  TEST_CASE("healing: a ring, two parts, or a hollow T is no sphere, and that is told") {
    const Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {5, 5, 5});
    auto inner = [](int i) { return i >= 1 && i <= 3; };
    const Approximation tries[] = {
        cells(M, [&](int i, int j,
                     int k) { return k == 2 && inner(i) && inner(j) && !(i == 2 && j == 2); }),
        cells(M, [](int i, int j, int k) { return j == 2 && k == 2 && (i == 1 || i == 3); }),
        cells(M, [&](int i, int j, int k) {
          return inner(i) && inner(j) && inner(k) && !(i == 2 && j == 2 && k == 2);
        })};
    for (const Approximation& A : tries) {
      const std::string text = boundarySquares(M, A).fault;
      CAPTURE(text);
      CHECK(text.find("no sphere") != std::string::npos);
    }
  }
}
