// SPDX-License-Identifier: MIT
// §3.5: cases 1 to 6 and the full subcomplex, each on a small mesh that shows it; and all of them
// on surfaces as extraction leaves them. The searches here count on the faces of S_M, edge by edge.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <functional>
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
using shapes::SurfaceSets;

namespace {

// ---- what the cases forbid, counted ------------------------------------------------------------

/// Case 3: tetrahedra with more than one face on S_M.
int tetrahedraWithTwoFaces(const Mesh& M, int k) {
  const SurfaceSets SM(M, k);
  int found = 0;
  for (const auto& z : M.tets) {
    int faces = 0;
    for (int i = 0; i < 4; ++i) faces += static_cast<int>(SM.faces.count(shapes::faceOf(z, i)));
    found += faces > 1;
  }
  return found;
}

/// Case 4: faces of the mesh with more than one edge on the rim of S_M.
int facesWithTwoRimEdges(const Mesh& M, int k) {
  const SurfaceSets SM(M, k);
  std::set<Face> found;
  for (const auto& z : M.tets)
    for (int i = 0; i < 4; ++i) {
      const Face f = shapes::faceOf(z, i);
      const int rim =
          SM.isRimEdge(f[0], f[1]) + SM.isRimEdge(f[1], f[2]) + SM.isRimEdge(f[2], f[0]);
      if (rim > 1) found.insert(f);
    }
  return static_cast<int>(found.size());
}

/// Case 5: inner edges of S_M with both ends on its rim.
int edgesAcrossTheRim(const Mesh& M, int k) {
  const SurfaceSets SM(M, k);
  int found = 0;
  for (const auto& [edge, count] : SM.edges)
    found += count == 2 && SM.nodes.at(edge[0]) == 2 && SM.nodes.at(edge[1]) == 2;
  return found;
}

/// Case 6: edges from a node of S_M to a node of another surface or the boundary.
int edgesBetweenSurfaces(const Mesh& M, int k) {
  const SurfaceSets SM(M, k);
  std::set<Edge> found;
  for (const auto& z : M.tets)
    for (int a : z)
      for (int b : z)
        if (SM.nodes.count(a) && !SM.nodes.count(b) && M.dimension[b] < 3)
          found.insert(shapes::sortedEdge(a, b));
  return static_cast<int>(found.size());
}

/// Full subcomplex: edges with both ends on S_M that are none of its, and faces with all nodes on
/// S_M that are none of its.
int chords(const Mesh& M, int k) {
  const SurfaceSets SM(M, k);
  std::set<Edge> edges;
  std::set<Face> faces;
  for (const auto& z : M.tets)
    for (int i = 0; i < 4; ++i) {
      for (int j = 0; j < i; ++j)
        if (SM.nodes.count(z[i]) && SM.nodes.count(z[j]) &&
            !SM.edges.count(shapes::sortedEdge(z[i], z[j])))
          edges.insert(shapes::sortedEdge(z[i], z[j]));
      const Face f = shapes::faceOf(z, i);
      if (SM.nodes.count(f[0]) && SM.nodes.count(f[1]) && SM.nodes.count(f[2]) &&
          !SM.faces.count(f))
        faces.insert(f);
    }
  return static_cast<int>(edges.size() + faces.size());
}

// ---- small meshes ------------------------------------------------------------------------------

/// A box of unit cubes whose middle is far from its sides.
Mesh cubes(int n) { return boxMesh({0, 0, 0}, {double(n), double(n), double(n)}, {n, n, n}); }

/// Labels the faces in a flat box of the computational space as surface 1.
void label(Mesh& M, Vec3 low, Vec3 high) {
  shapes::labelFaces(
      M, 1, [&](Vec3 a, Vec3 b, Vec3 c) { return shapes::facesInBox(a, b, c, low, high); });
}

/// Three squares around the node (2, 2, 2) in the plane z = 2; the missing one is where x > 2, and
/// y > 2 or < 2.
Mesh threeSquares(bool missingAbove) {
  Mesh M = cubes(4);
  label(M, {1, 1, 2}, {2, 3, 2});
  label(M, {2, missingAbove ? 1. : 2., 2}, {3, missingAbove ? 2. : 3., 2});
  return M;
}

using Rule = bool (*)(Bisection&, SurfaceComplex&);

/// Applies a rule to surface k as the mesh has it.
bool apply(Rule rule, Bisection& B, int k) {
  SurfaceComplex SM(B, k);
  return rule(B, SM);
}

/// What a complex says of its surface, in no order of its own.
std::set<std::array<int, 4>> described(const SurfaceComplex& SM) {
  std::set<std::array<int, 4>> all;
  for (const SurfaceComplex::Edge& e : SM.edges) {
    CHECK(SM.isEdge(e.b, e.a));
    CHECK(SM.isRimEdge(e.a, e.b) == (e.faces == 1));
    all.insert({e.a, e.b, e.faces, 0});
  }
  for (int n = 0; n < static_cast<int>(SM.node.size()); ++n)
    if (SM.node[n]) all.insert({n, n, SM.node[n], 1});
  return all;
}

/// Applies a case to M; it must change something, keep the mesh sound and S_M's area and topology,
/// and do nothing the second time.
void applyCase(Mesh& M, Rule rule) {
  const double area = shapes::computationalArea(M, 1), volume = shapes::totalVolume(M);
  const bool disk = shapes::isDisk(surfaceFaces(M, 1));
  Bisection B(M);
  SurfaceComplex SM(B, 1);
  CHECK(rule(B, SM));
  CHECK(described(SM) == described(SurfaceComplex(B, 1)));
  CHECK(shapes::conformityFault(M) == "");
  CHECK(shapes::totalVolume(M) == doctest::Approx(volume).epsilon(1e-13));
  CHECK(shapes::computationalArea(M, 1) == doctest::Approx(area).epsilon(1e-13));
  CHECK(shapes::isDisk(surfaceFaces(M, 1)) == disk);
  const Mesh once = M;
  CHECK_FALSE(rule(B, SM));
  CHECK_FALSE(apply(rule, B, 1));
  CHECK(shapes::sameMesh(M, once));
}

// ---- squares of a small T ----------------------------------------------------------------------

/// dT of T = the cells with 1 <= i, j <= n, k = 1 of a box: its top is n x n squares.
struct Slab {
  Mesh M;
  Approximation A;
  SquareSurface Q;
  explicit Slab(int n) : M(boxMesh({0, 0, 0}, {1, 1, 1}, {n + 2, n + 2, 3})), A(), Q() {
    for (const auto& z : M.tets) {
      const Vec3 c = .25 * (M.xi[z[0]] + M.xi[z[1]] + M.xi[z[2]] + M.xi[z[3]]);
      const bool in = c.x > 1 && c.x < n + 1 && c.y > 1 && c.y < n + 1 && c.z > 1 && c.z < 2;
      A.T.push_back(in ? 1 : 0);
    }
    Q = boundarySquares(M, A);
  }
  /// The square of the top at column i, row j, from 0.
  int top(int i, int j) const {
    for (std::size_t q = 0; q < Q.squares.size(); ++q) {
      Vec3 c;
      for (int n : Q.squares[q].node) c += .25 * M.xi[n];
      if (c == Vec3{i + 1.5, j + 1.5, 2}) return static_cast<int>(q);
    }
    return -1;
  }
  /// From rows of '#' and '.', the first row at the highest j.
  Selection select(const std::vector<std::string>& rows) const {
    Selection selected(Q.squares.size(), 0);
    const int height = static_cast<int>(rows.size());
    for (int j = 0; j < height; ++j)
      for (std::size_t i = 0; i < rows[j].size(); ++i)
        if (rows[j][i] == '#') selected[top(static_cast<int>(i), height - 1 - j)] = 15;
    return selected;
  }
};

/// Triangles of S_M at node n, counted on the mesh's faces.
int trianglesAt(const Slab& slab, const Selection& selected, int n) {
  Mesh M = slab.M;
  for (std::size_t q = 0; q < selected.size(); ++q) {
    if (!selected[q]) continue;
    Vec3 low = M.xi[slab.Q.squares[q].node[0]], high = low;
    for (int v : slab.Q.squares[q].node) {
      const Vec3 p = M.xi[v];
      low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
      high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
    }
    label(M, low, high);
  }
  int count = 0;
  for (const Face& f : surfaceFaces(M, 1)) count += f[0] == n || f[1] == n || f[2] == n;
  return count;
}

int nodeAt(const Mesh& M, Vec3 xi) {
  return static_cast<int>(std::find(M.xi.begin(), M.xi.end(), xi) - M.xi.begin());
}

/// S_M of an extraction, labelled, before cases 3 to 6.
void extract(Steps& I, double lc, Outline outline) {
  I.approximate(lc);
  I.heal();
  const Extraction X = surfaceExtraction(I.M, I.Q, I.S, 1, outline);
  REQUIRE(X.fault == "");
  labelSurface(I.B, I.Q, I.A, X.selected, 1);
}

}  // namespace

TEST_SUITE("3.5") {
  TEST_CASE("case 1: a pair of triangles with three edges on the rim goes") {
    const Slab slab(4);
    Selection selected = slab.select({"..#.", ".##.", ".##.", "...."});
    CHECK(removeThinProtrusions(slab.Q, selected));
    CHECK(selected == slab.select({"....", ".##.", ".##.", "...."}));
    CHECK_FALSE(removeThinProtrusions(slab.Q, selected));
    CHECK(selected == slab.select({"....", ".##.", ".##.", "...."}));
  }

  TEST_CASE("case 1: recursively, a strip one square wide goes whole; corners and two wide stay") {
    const Slab slab(5);
    Selection selected = slab.select({"..#..", "..###", "....#", ".####", ".##.."});
    CHECK(removeThinProtrusions(slab.Q, selected));
    CHECK(selected == slab.select({".....", ".....", ".....", ".##..", ".##.."}));
    CHECK_FALSE(removeThinProtrusions(slab.Q, selected));
    selected = slab.select({".....", "#####", ".....", ".....", "....."});
    CHECK(removeThinProtrusions(slab.Q, selected));  // as printed: the whole strip
    CHECK(std::count(selected.begin(), selected.end(), 0) == static_cast<long>(selected.size()));
    const Selection wide = slab.select({"##...", "###..", ".###.", "..###", "...##"});
    selected = wide;
    CHECK_FALSE(removeThinProtrusions(slab.Q, selected));
    CHECK(selected == wide);
  }

  TEST_CASE("case 2: the square between the two rim edges at a rim node with five triangles") {
    const Slab slab(4);
    const int n = nodeAt(slab.M, {3, 3, 2});  // the middle of the top
    // Kuhn's diagonals end at n in the squares at (+,+) and (-,-): without one of the others five
    // triangles
    Selection selected = slab.select({"....", ".##.", ".#..", "...."});
    CHECK(trianglesAt(slab, selected, n) == 5);
    CHECK(fillHighConnectivityNodes(slab.M, slab.Q, selected));
    CHECK(selected == slab.select({"....", ".##.", ".##.", "...."}));
    CHECK_FALSE(fillHighConnectivityNodes(slab.M, slab.Q, selected));
    // four triangles: nothing
    const Selection four = slab.select({"....", ".#..", ".##.", "...."});
    selected = four;
    CHECK(trianglesAt(slab, selected, n) == 4);
    CHECK_FALSE(fillHighConnectivityNodes(slab.M, slab.Q, selected));
    CHECK(selected == four);
    // six triangles, at a node inside S_M: nothing
    const Selection whole = slab.select({"####", "####", "####", "####"});
    selected = whole;
    CHECK(trianglesAt(slab, selected, n) == 6);
    CHECK_FALSE(fillHighConnectivityNodes(slab.M, slab.Q, selected));
    CHECK(selected == whole);
  }

  TEST_CASE("case 2: no rim node with five triangles whose missing square is free is left") {
    const Slab slab(5);
    for (unsigned seed = 1; seed <= 40; ++seed) {
      samples::Random random(seed);
      std::vector<std::string> rows(5, ".....");
      for (auto& row : rows)
        for (char& c : row) c = random.between(0, 1) < .7 ? '#' : '.';
      Selection selected = slab.select(rows);
      for (int round = 0; round < 30 && fillHighConnectivityNodes(slab.M, slab.Q, selected);
           ++round) {
      }
      CHECK_FALSE(fillHighConnectivityNodes(slab.M, slab.Q, selected));
      for (int x = 2; x <= 5; ++x)
        for (int y = 2; y <= 5; ++y) {
          const int chosen[4] = {slab.top(x - 2, y - 2), slab.top(x - 1, y - 2),
                                 slab.top(x - 1, y - 1), slab.top(x - 2, y - 1)};
          int count = 0;
          for (int q : chosen) count += selected[q] != 0;
          if (count == 3)
            CHECK(trianglesAt(slab, selected, nodeAt(slab.M, {double(x), double(y), 2})) < 5);
        }
    }
  }

  TEST_CASE("case 2: a square that touches the boundary or another surface is not added") {
    Slab slab(4);
    slab.M.dimension[nodeAt(slab.M, {4, 2, 2})] = 2;  // the far corner of the missing square
    Selection selected = slab.select({"....", ".##.", ".#..", "...."});
    const Selection before = selected;
    CHECK_FALSE(fillHighConnectivityNodes(slab.M, slab.Q, selected));
    CHECK(selected == before);
  }

  TEST_CASE("case 3: a tetrahedron with two faces on S_M") {
    Mesh M = cubes(3);
    label(M, {1, 1, 1}, {2, 2, 1});  // two sides of the middle cube, at the edge x = 2, z = 1
    label(M, {2, 1, 1}, {2, 2, 2});
    CHECK(tetrahedraWithTwoFaces(M, 1) > 0);
    applyCase(M, refineTetrahedraWithTwoFaces);
    CHECK(tetrahedraWithTwoFaces(M, 1) == 0);
  }

  TEST_CASE("case 3: nothing where S_M is flat") {
    Mesh M = cubes(3);
    label(M, {1, 1, 1}, {2, 2, 1});
    Bisection B(M);
    CHECK_FALSE(apply(refineTetrahedraWithTwoFaces, B, 1));
    CHECK_FALSE(apply(refineTetrahedraWithTwoFaces, B, 2));  // no such surface
  }

  TEST_CASE("case 4: a face of S_M with two edges on the rim") {
    Mesh M = cubes(3);
    label(M, {1, 1, 1}, {2, 2, 1});  // one square: both of its triangles
    CHECK(facesWithTwoRimEdges(M, 1) == 2);
    applyCase(M, refineFacesWithTwoRimEdges);
    CHECK(facesWithTwoRimEdges(M, 1) == 0);
    CHECK(surfaceFaces(M, 1).size() == 4);
  }

  TEST_CASE("case 4: a face off S_M with two edges on the rim, in its reflex corner") {
    for (bool above : {false, true}) {
      Mesh M = threeSquares(above);
      const int found = facesWithTwoRimEdges(M, 1);
      CAPTURE(above);
      CHECK(found > 0);
      applyCase(M, refineFacesWithTwoRimEdges);
      CHECK(facesWithTwoRimEdges(M, 1) == 0);
    }
  }

  TEST_CASE("case 5: an inner edge of S_M with both ends on the rim") {
    Mesh M = cubes(5);
    label(M, {1, 1, 2}, {4, 2, 2});  // a strip one square wide: two cross edges, three diagonals
    CHECK(edgesAcrossTheRim(M, 1) == 5);
    applyCase(M, refineEdgesAcrossTheRim);
    CHECK(edgesAcrossTheRim(M, 1) == 0);
    Mesh wide = cubes(5);
    label(wide, {1, 1, 2}, {4, 4, 2});
    Bisection B(wide);
    CHECK(edgesAcrossTheRim(wide, 1) == 2);  // diagonals that cut a corner off
    CHECK(apply(refineEdgesAcrossTheRim, B, 1));
    CHECK(edgesAcrossTheRim(wide, 1) == 0);
  }

  TEST_CASE("case 6: an edge from S_M to the boundary") {
    Mesh M = cubes(3);
    label(M, {1, 1, 1}, {2, 2, 1});  // one cube from the boundary on five sides
    CHECK(edgesBetweenSurfaces(M, 1) > 0);
    applyCase(M, refineEdgesBetweenSurfaces);
    CHECK(edgesBetweenSurfaces(M, 1) == 0);
  }

  TEST_CASE("case 6: an edge from S_M to another surface") {
    Mesh M = cubes(6);
    label(M, {2, 2, 3}, {4, 4, 3});
    Bisection none(M);
    CHECK(edgesBetweenSurfaces(M, 1) == 0);
    CHECK_FALSE(apply(refineEdgesBetweenSurfaces, none, 1));
    // surface 2, one cube above, its nodes as projection leaves them: of dimension 2 on its own
    // plane
    Parametrization plane;
    plane.points = {{1, 1, 4}, {5, 1, 4}, {5, 5, 4}, {1, 5, 4}};
    plane.triangles = {{0, 1, 2}, {0, 2, 3}};
    plane.u = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
    buildLocator(plane);
    M.surfaces = {plane, plane};
    shapes::labelFaces(M, 2, [](Vec3 a, Vec3 b, Vec3 c) {
      return shapes::facesInBox(a, b, c, {2, 2, 4}, {4, 4, 4});
    });
    for (const Face& f : surfaceFaces(M, 2))
      for (int n : f) {
        M.dimension[n] = 2, M.entity[n] = 2;
        M.parameter[n] = {(M.x[n].x - 1) / 4, (M.x[n].y - 1) / 4};
      }
    CHECK(edgesBetweenSurfaces(M, 1) > 0);
    applyCase(M, refineEdgesBetweenSurfaces);
    CHECK(edgesBetweenSurfaces(M, 1) == 0);
  }

  TEST_CASE("full subcomplex: an edge with both ends on S_M that is no edge of it") {
    Mesh corner = cubes(3);
    label(corner, {1, 1, 1}, {2, 2, 1});
    label(corner, {2, 1, 1}, {2, 2, 2});
    CHECK(chords(corner, 1) > 0);
    applyCase(corner, refineToFullSubcomplex);
    CHECK(chords(corner, 1) == 0);
    Mesh flat = threeSquares(false);
    CHECK(chords(flat, 1) > 0);
    applyCase(flat, refineToFullSubcomplex);
    CHECK(chords(flat, 1) == 0);
  }

  TEST_CASE("full subcomplex: a face with three edges on S_M that is no face of it") {
    Mesh M = cubes(4);
    label(M, {1, 1, 2}, {3, 3, 2});
    const Face hole = surfaceFaces(M, 1)[3];
    for (std::size_t E = 0; E < M.tets.size(); ++E)  // one triangle out of the sheet
      for (int i = 0; i < 4; ++i)
        if (shapes::faceOf(M.tets[E], i) == shapes::sortedFace(hole[0], hole[1], hole[2]))
          M.faceLabel[E][i] = 0;
    CHECK(surfaceFaces(M, 1).size() == 7);
    const Face face = shapes::sortedFace(hole[0], hole[1], hole[2]);
    auto isFace = [&] {
      for (const auto& z : M.tets)
        for (int i = 0; i < 4; ++i)
          if (shapes::faceOf(z, i) == face) return true;
      return false;
    };
    CHECK(chords(M, 1) == 1);  // all of its edges are S_M's
    CHECK(isFace());
    Bisection B(M);
    CHECK(apply(refineToFullSubcomplex, B, 1));
    CHECK_FALSE(isFace());
    CHECK(shapes::conformityFault(M) == "");
  }

  TEST_CASE(
      "healing: a hole with corners of 45 degrees is split for ever: refused after 30 rounds") {
    Mesh M = cubes(4);
    label(M, {1, 1, 2}, {3, 3, 2});
    const Face hole = surfaceFaces(M, 1)[3];
    for (std::size_t E = 0; E < M.tets.size(); ++E)
      for (int i = 0; i < 4; ++i)
        if (shapes::faceOf(M.tets[E], i) == shapes::sortedFace(hole[0], hole[1], hole[2]))
          M.faceLabel[E][i] = 0;
    Bisection B(M);
    CHECK_THROWS_AS(surfaceHealing(B, 1), MethodError);
  }

  TEST_CASE("full subcomplex: nothing where it is one") {
    Mesh M = cubes(4);
    label(M, {1, 1, 2}, {3, 3, 2});
    Bisection B(M);
    CHECK(chords(M, 1) == 0);
    CHECK_FALSE(apply(refineToFullSubcomplex, B, 1));
  }

  TEST_CASE(
      "healing: cases 3 to 6 and the full subcomplex on extracted surfaces, and nothing the second "
      "time") {
    const TriangleSurface surfaces[] = {samples::sine(.1, 32), samples::randomPatch(1),
                                        samples::randomPatch(2), samples::randomPatch(3),
                                        samples::plane(45, 45)};
    for (const TriangleSurface& S : surfaces)
      for (Outline outline : {Outline::paper, Outline::halfSquares}) {
        CAPTURE(S.name);
        CAPTURE(static_cast<int>(outline));
        Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), S);
        extract(I, .12, outline);
        const double area = shapes::computationalArea(I.M, 1);
        CHECK(shapes::isDisk(surfaceFaces(I.M, 1)));
        CHECK(chords(I.M, 1) > 0);
        const int rounds = surfaceHealing(I.B, 1);
        CHECK(rounds >= 2);
        CHECK(rounds <= 8);
        CHECK(tetrahedraWithTwoFaces(I.M, 1) == 0);
        CHECK(facesWithTwoRimEdges(I.M, 1) == 0);
        CHECK(edgesAcrossTheRim(I.M, 1) == 0);
        CHECK(edgesBetweenSurfaces(I.M, 1) == 0);
        CHECK(chords(I.M, 1) == 0);
        CHECK(shapes::isDisk(surfaceFaces(I.M, 1)));
        CHECK(shapes::computationalArea(I.M, 1) == doctest::Approx(area).epsilon(1e-12));
        CHECK(shapes::conformityFault(I.M) == "");
        CHECK(shapes::countInverted(I.M) == 0);
        const Mesh healed = I.M;
        CHECK(surfaceHealing(I.B, 1) == 1);
        CHECK(shapes::sameMesh(I.M, healed));
      }
  }

  TEST_CASE(
      "healing: each case alone on extracted surfaces leaves none, and does nothing the second "
      "time") {
    const struct {
      const char* what;
      Rule rule;
      int (*count)(const Mesh&, int);
    } cases[] = {{"case 3", refineTetrahedraWithTwoFaces, tetrahedraWithTwoFaces},
                 {"case 4", refineFacesWithTwoRimEdges, facesWithTwoRimEdges},
                 {"case 5", refineEdgesAcrossTheRim, edgesAcrossTheRim},
                 {"case 6", refineEdgesBetweenSurfaces, edgesBetweenSurfaces},
                 {"full subcomplex", refineToFullSubcomplex, chords}};
    for (int seed : {1, 2, 3, 5})
      for (Outline outline : {Outline::paper, Outline::halfSquares}) {
        Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), samples::randomPatch(seed));
        extract(I, .12, outline);
        for (const auto& c : cases) {
          CAPTURE(seed);
          CAPTURE(c.what);
          CAPTURE(static_cast<int>(outline));
          Mesh M = I.M;
          Bisection B(M);
          const bool found = c.count(M, 1) > 0;
          CHECK(apply(c.rule, B, 1) == found);
          CHECK(c.count(M, 1) == 0);
          CHECK_FALSE(apply(c.rule, B, 1));
        }
      }
  }
}
