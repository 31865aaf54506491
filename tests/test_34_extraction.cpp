// SPDX-License-Identifier: MIT
// §3.4: the squares of dT on one side of S; and the half squares of DESIGN 3.5, whose rules (a) to
// (d) are checked here on the masks of the selection.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <iterator>
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

/// A quarter of a square: two corners and the centre. Corners are mesh nodes, centres -1 - square.
struct Quarter {
  int square, e, a, b;
};
std::vector<Quarter> quartersOf(const SquareSurface& Q, const Selection& selected, bool chosen) {
  std::vector<Quarter> quarters;
  for (std::size_t i = 0; i < Q.squares.size(); ++i)
    for (int e = 0; e < 4; ++e)
      if ((selected[i] >> e & 1) == (chosen ? 1 : 0))
        quarters.push_back(
            {static_cast<int>(i), e, Q.squares[i].node[e], Q.squares[i].node[(e + 1) % 4]});
  return quarters;
}

/// The chosen quarters as triangles, with the centres as nodes beyond those of the mesh.
std::vector<Face> asTriangles(const Mesh& M, const SquareSurface& Q, const Selection& selected) {
  std::vector<Face> faces;
  for (const Quarter& q : quartersOf(Q, selected, true))
    faces.push_back({q.a, q.b, static_cast<int>(M.x.size()) + q.square});
  return faces;
}

/// Corners that a chosen quarter touches.
std::set<int> cornersOf(const SquareSurface& Q, const Selection& selected) {
  std::set<int> corners;
  for (const Quarter& q : quartersOf(Q, selected, true)) corners.insert({q.a, q.b});
  return corners;
}

/// The side of x by the nearest triangle of S, all tried, where its foot is inside the triangle;
/// else 0.
int literalSide(const TriangleSurface& S, Vec3 x) {
  double nearest = 1e300;
  int side = 0;
  for (const auto& t : S.triangles) {
    const Vec3 a = S.points[t[0]], b = S.points[t[1]], c = S.points[t[2]];
    const double d = shapes::distanceToTriangle(x, a, b, c);
    if (d >= nearest) continue;
    nearest = d;
    const Vec3 n = cross(b - a, c - a);
    const double height = dot(x - a, n) / norm(n);
    side = std::abs(std::abs(height) - d) < 1e-12 ? (height > 0 ? 1 : -1) : 0;
  }
  return side;
}

/// The rules of DESIGN 3.5 on the masks: what breaks them, or nothing.
std::string ruleFault(const SquareSurface& Q, const Selection& selected) {
  std::map<Edge, std::vector<Quarter>> atEdge;  // of dT: the quarters on both sides
  std::map<int, int> rimEdges, quarters;
  std::map<int, std::set<int>> bits;
  for (bool chosen : {true, false})
    for (const Quarter& q : quartersOf(Q, selected, chosen)) {
      atEdge[shapes::sortedEdge(q.a, q.b)].push_back(q);
      if (chosen) ++quarters[q.a], ++quarters[q.b];
    }
  auto isChosen = [&](const Quarter& q) { return (selected[q.square] >> q.e & 1) == 1; };
  for (const auto& [edge, at] : atEdge)
    if (isChosen(at[0]) != isChosen(at[1])) ++rimEdges[edge[0]], ++rimEdges[edge[1]];
  for (std::size_t i = 0; i < Q.squares.size();
       ++i)  // spokes: corner e lies between quarters e - 1 and e
    for (int e = 0; e < 4; ++e)
      if ((selected[i] >> e & 1) != (selected[i] >> (e + 3) % 4 & 1))
        ++rimEdges[Q.squares[i].node[e]];
  for (std::size_t i = 0; i < Q.squares.size(); ++i) {
    const int mask = selected[i];
    if (mask != 0 && mask != 15 && mask != 3 && mask != 6 && mask != 12 && mask != 9)
      return "square " + std::to_string(i) + " is neither empty, full nor a half";
  }
  for (const auto& [n, count] : rimEdges)
    if (count != 0 && count != 2)
      return "(a) node " + std::to_string(n) + " has " + std::to_string(count) + " rim edges";
  for (const auto& [n, count] : quarters)
    if (count == 1) return "(c) node " + std::to_string(n) + " has one quarter";
  for (const auto& [edge, at] : atEdge)
    for (int k = 0; k < 2; ++k) {
      const int mask = selected[at[k].square];
      if (mask == 0 || mask == 15 || isChosen(at[k])) continue;
      if (isChosen(at[1 - k])) return "(d) square " + std::to_string(at[k].square) + " has a notch";
    }
  return "";
}

/// The rim energy of DESIGN 3.5, term by term.
double literalEnergy(const Steps& I, int side, const Selection& selected) {
  const SquareSurface& Q = I.Q;
  std::map<int, int> chosen, all;  // quarters at each corner
  for (bool in : {true, false})
    for (const Quarter& q : quartersOf(Q, selected, in))
      for (int n : {q.a, q.b}) chosen[n] += in, ++all[n];
  auto onSide = [&](int n) { return (I.S.query(I.M.x[n]).side >= 0 ? 1 : -1) == side; };
  std::set<int> sharp;
  const RimCorners corners = rimCorners(I.S);
  for (int c = 0; c < 4; ++c) {
    if (!corners.sharp[c]) continue;
    const Vec3 p = I.S.S.points[I.S.rim[corners.at[c]]];
    int nearest = -1;
    for (int n : Q.nodes)
      if (onSide(n) && (nearest < 0 || norm2(I.M.x[n] - p) < norm2(I.M.x[nearest] - p)))
        nearest = n;
    sharp.insert(nearest);
  }
  double energy = 0;
  for (const auto& [n, k] : chosen) {
    if (k == 0 || k == all[n]) continue;  // off the rim
    const double t = sharp.count(n) ? 2 : 4;
    energy += .25 / 4 * (k - t) * (k - t);
  }
  for (bool in : {true, false})
    for (const Quarter& q : quartersOf(Q, selected, in)) {
      if (!onSide(q.a) || !onSide(q.b)) continue;
      const Square& s = Q.squares[q.square];
      const SurfaceQuery at = I.S.query((1. / 3) * (I.M.x[q.a] + I.M.x[q.b] + s.centre));
      const double distance = in ? at.excess : at.onRim ? 0 : I.S.rimDistance(at.point);
      energy += distance * distance / (I.Q.h * I.Q.h) / 4;
    }
  return energy;
}

struct Try {
  TriangleSurface S;
  double lc;
};
std::vector<Try> tries() {
  return {{samples::sine(.1, 32), .12},   {samples::plane(10, 0), .12},
          {samples::plane(45, 45), .12},  {samples::disc(20), .12},
          {samples::randomPatch(3), .12}, {samples::randomPatch(5), .12},
          {samples::threeLobed(), .1}};
}

}  // namespace

TEST_SUITE("3.4") {
  TEST_CASE("extraction: above a plane the squares with all corners on one side") {
    // z = .53 is in no lattice plane: dT has a floor and a ceiling
    const TriangleSurface S = samples::sheet(8, 8, [](double s, double t) {
      return Vec3{.5 + .25 * s, .5 + .25 * t, .53};
    });
    Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), S);
    I.approximate(.12);
    I.heal();
    for (int side : {1, -1}) {
      const Extraction X = surfaceExtraction(I.M, I.Q, I.S, side, Outline::squares);
      CHECK(X.fault == "");
      int chosen = 0;
      for (std::size_t i = 0; i < I.Q.squares.size(); ++i) {
        const Square& s = I.Q.squares[i];
        bool oneSide = true, above = true;
        for (int n : s.node) {
          oneSide = oneSide && (I.M.x[n].z > .53) == (side > 0);
          above = above && std::abs(I.M.x[n].x - .5) < .25 && std::abs(I.M.x[n].y - .5) < .25;
        }
        CHECK((X.selected[i] == 0 || X.selected[i] == 15));
        if (X.selected[i]) CHECK(oneSide);
        if (oneSide && above) CHECK(X.selected[i] == 15);  // nothing above S is left out
        chosen += X.selected[i] != 0;
      }
      CHECK(chosen >= 16);  // a side of .5 at h = 1/16
      CHECK(chosen <= 100);
    }
  }

  TEST_CASE("extraction: both sides give a disk whose corners are on the right side of S") {
    for (const Try& t : tries()) {
      CAPTURE(t.S.name);
      Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), t.S);
      I.approximate(t.lc);
      I.heal();
      for (Outline outline : {Outline::paper, Outline::squares, Outline::halfSquares})
        for (int side : {1, -1}) {
          CAPTURE(static_cast<int>(outline));
          CAPTURE(side);
          const Extraction X = surfaceExtraction(I.M, I.Q, I.S, side, outline);
          CHECK(X.fault == "");
          CHECK(shapes::isDisk(asTriangles(I.M, I.Q, X.selected)));
          int wrong = 0, known = 0;
          if (outline != Outline::paper)  // case 2 adds squares without asking for their side
            for (int n : cornersOf(I.Q, X.selected)) {
              const int literal = literalSide(I.S.S, I.M.x[n]);
              known += literal != 0;
              wrong += literal == -side;
            }
          CHECK(wrong == 0);
          if (outline != Outline::paper) CHECK(known > 20);
          // S_M is the size of S
          const double area =
              .25 * I.Q.h * I.Q.h * static_cast<double>(quartersOf(I.Q, X.selected, true).size());
          double areaS = 0;
          for (const auto& f : I.S.S.triangles) {
            const auto& p = I.S.S.points;
            areaS += .5 * norm(cross(p[f[1]] - p[f[0]], p[f[2]] - p[f[0]]));
          }
          CHECK(area > .6 * areaS);
          CHECK(area < 2.2 * areaS);
        }
    }
  }

  TEST_CASE("extraction: the other side of a turned surface") {
    TriangleSurface S = samples::sine(.1, 32);
    Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), S);
    I.approximate(.12);
    I.heal();
    for (auto& t : S.triangles) std::swap(t[1], t[2]);
    const SurfaceDistance turned(Steps::cleaned(S));
    for (int side : {1, -1}) {
      const Extraction X = surfaceExtraction(I.M, I.Q, I.S, side, Outline::squares);
      const Extraction Y = surfaceExtraction(I.M, I.Q, turned, -side, Outline::squares);
      const std::set<int> a = cornersOf(I.Q, X.selected), b = cornersOf(I.Q, Y.selected);
      std::vector<int> common;
      std::set_intersection(a.begin(), a.end(), b.begin(), b.end(), std::back_inserter(common));
      CHECK(common.size() > .9 * static_cast<double>(a.size()));
    }
  }

  TEST_CASE("extraction: squares that touch another surface or the boundary are never chosen") {
    for (Outline outline : {Outline::paper, Outline::squares, Outline::halfSquares}) {
      Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), samples::sine(.1, 32));
      I.approximate(.12);
      I.heal();
      const Extraction before = surfaceExtraction(I.M, I.Q, I.S, 1, outline);
      int taken = 0;
      for (int n :
           cornersOf(I.Q, before.selected))  // as if another surface ran along x = const there
        if (I.M.x[n].x < .25) I.M.dimension[n] = 2, ++taken;
      REQUIRE(taken > 3);
      const Extraction after = surfaceExtraction(I.M, I.Q, I.S, 1, outline);
      CHECK(after.fault == "");
      int touching = 0;
      for (std::size_t i = 0; i < I.Q.squares.size(); ++i)
        for (int n : I.Q.squares[i].node) touching += after.selected[i] && I.M.dimension[n] < 3;
      CHECK(touching == 0);
    }
  }

  TEST_CASE(
      "extraction: squares beyond an earlier surface are never chosen, deep inside of S too") {
    const auto sheet = [](double z, double lo, double hi) {
      TriangleSurface S;
      S.points = {{lo, lo, z}, {hi, lo, z}, {hi, hi, z}, {lo, hi, z}};
      S.triangles = {{0, 1, 2}, {0, 2, 3}};
      return S;
    };
    Mesh M = boxMesh({0, 0, 0}, {22, 22, 4}, {22, 22, 4});
    InsertOptions options;
    options.lc = .9;
    insertSurface(M, sheet(2.45, 2, 20), options);
    Steps I(M, sheet(2.75, 3, 19));
    I.approximate(1.8);  // cubes from z = 2 to 3: the earlier surface is inside
    I.heal();
    const Extraction above = surfaceExtraction(I.M, I.Q, I.S, 1, Outline::squares);
    CHECK(above.fault == "");
    CHECK(std::count(above.selected.begin(), above.selected.end(), 15) > 200);
    const Extraction below = surfaceExtraction(I.M, I.Q, I.S, -1, Outline::squares);
    CHECK(below.isBlocked);
    CHECK(std::count(below.selected.begin(), below.selected.end(), 0) ==
          static_cast<int>(below.selected.size()));
  }

  TEST_CASE(
      "the middle: squares between cubes above and below, about half as far from S as the sides") {
    double ofMiddle = 0, ofSides = 0;  // mean distances, summed over the cases
    for (const Try& t : tries()) {
      Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), t.S);
      I.approximate(t.lc);
      I.heal();
      const auto meanDistance = [&](int side) {
        const Extraction X = surfaceExtraction(I.M, I.Q, I.S, side, Outline::squares);
        REQUIRE(X.fault == "");
        double sum = 0;
        const std::set<int> corners = cornersOf(I.Q, X.selected);
        for (int n : corners) sum += I.S.query(I.M.x[n]).distance;
        int wrong = 0;
        for (std::size_t i = 0; i < I.Q.squares.size(); ++i)
          if (X.selected[i] && side == 0) {
            const Vec3 beyond = I.Q.squares[i].beyond;
            wrong += I.S.query(beyond).side < -1e-12;
            wrong += I.S.query(2 * I.Q.squares[i].centre - beyond).side > 1e-12;
          }
        CHECK(wrong == 0);
        return sum / static_cast<double>(corners.size());
      };
      ofSides += std::min(meanDistance(1), meanDistance(-1));
      I.A = middleApproximation(I.B, I.A, I.S, 1000);
      I.heal();
      CHECK(I.Q.isMiddle);
      ofMiddle += meanDistance(0);
    }
    CHECK(ofMiddle < .6 * ofSides);
  }

  TEST_CASE("the middle: steps only where they pay, fewer squares than the centres give") {
    std::map<double, double> squares;  // of the cases together
    for (const Try& t : tries())
      for (double perDistance : {1.5, 1000.}) {
        Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), t.S);
        I.approximate(t.lc);
        I.heal();
        I.A = middleApproximation(I.B, I.A, I.S, perDistance);
        I.heal();
        const Extraction X = surfaceExtraction(I.M, I.Q, I.S, 0, Outline::squares);
        REQUIRE(X.fault == "");
        squares[perDistance] +=
            static_cast<double>(std::count(X.selected.begin(), X.selected.end(), 15));
      }
    CHECK(squares[1.5] < .97 * squares[1000.]);
  }

  TEST_CASE("the middle: a bump as high as a cube and two wide is passed under, in one plane") {
    const TriangleSurface S = samples::sheet(48, 48, [](double s, double t) {
      const double x = .3 * s, y = .3 * t;
      return Vec3{.5 + x, .5 + y, .51 + .06 * std::exp(-(x * x + y * y) / (.05 * .05))};
    });
    for (double perDistance : {1.5, 1000.}) {
      CAPTURE(perDistance);
      Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), S);
      I.approximate(.12);  // h = .0625
      I.heal();
      I.A = middleApproximation(I.B, I.A, I.S, perDistance);
      I.heal();
      const Extraction X = surfaceExtraction(I.M, I.Q, I.S, 0, Outline::squares);
      REQUIRE(X.fault == "");
      int off = 0;
      for (int n : cornersOf(I.Q, X.selected)) off += I.M.xi[n].z != 1;
      CHECK((off > 0) == (perDistance > 2));
    }
  }

  TEST_CASE("half squares: rules (a) to (d) on the masks, both sides") {
    int halves = 0;
    for (const Try& t : tries()) {
      Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), t.S);
      I.approximate(t.lc);
      I.heal();
      for (int side : {1, -1}) {
        CAPTURE(t.S.name);
        const Extraction X = surfaceExtraction(I.M, I.Q, I.S, side, Outline::halfSquares);
        CHECK(ruleFault(I.Q, X.selected) == "");
        CHECK(shapes::isDisk(asTriangles(I.M, I.Q, X.selected)));  // (b): chi = 1 was kept
        for (unsigned char mask : X.selected) halves += mask != 0 && mask != 15;
        // a half needs its three corners on the side, a square all four
        int wrong = 0;
        for (int n : cornersOf(I.Q, X.selected))
          wrong += (I.S.query(I.M.x[n]).side >= 0 ? 1 : -1) != side;
        CHECK(wrong == 0);
      }
    }
    CHECK(halves > 50);
  }

  TEST_CASE("half squares: the rules' check can fail") {
    Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), samples::plane(10, 0));
    I.approximate(.12);
    I.heal();
    const Selection good = surfaceExtraction(I.M, I.Q, I.S, 1, Outline::squares).selected;
    CHECK(ruleFault(I.Q, good) == "");
    int inner = -1;
    for (std::size_t i = 0; i < good.size() && inner < 0; ++i) {
      bool isInner = good[i] == 15;
      for (int next : I.Q.squares[i].across) isInner = isInner && good[next] == 15;
      if (isInner) inner = static_cast<int>(i);
    }
    REQUIRE(inner >= 0);
    Selection bad = good;
    bad[inner] = 3;
    CHECK(ruleFault(I.Q, bad).substr(0, 3) == "(d)");
    bad[inner] = 1;
    CHECK(ruleFault(I.Q, bad).find("neither") != std::string::npos);
    Selection tip(good.size(), 0);
    tip[inner] = 3;
    CHECK(ruleFault(I.Q, tip).substr(0, 3) == "(c)");
  }

  TEST_CASE("rim regularization: half squares never raise the rim energy of whole ones") {
    for (const Try& t : tries()) {
      Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), t.S);
      I.approximate(t.lc);
      I.heal();
      for (int side : {1, -1}) {
        CAPTURE(t.S.name);
        const Extraction whole = surfaceExtraction(I.M, I.Q, I.S, side, Outline::squares);
        const Extraction halves = surfaceExtraction(I.M, I.Q, I.S, side, Outline::halfSquares);
        const double E = literalEnergy(I, side, halves.selected),
                     W = literalEnergy(I, side, whole.selected);
        CHECK(E <= W + 1e-9);
        // what the sides are ranked by is this energy and the coverage, which is not negative
        CHECK(whole.energy >= W - 1e-9);
        CHECK(halves.energy >= E - 1e-9);
      }
    }
  }

  TEST_CASE("rim regularization: no single square can be added or removed to lower the energy") {
    Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), samples::randomPatch(5));
    I.approximate(.2);
    I.heal();
    const Extraction X = surfaceExtraction(I.M, I.Q, I.S, 1, Outline::squares);
    REQUIRE(X.fault == "");
    const double E = literalEnergy(I, 1, X.selected);
    int better = 0, tried = 0;
    for (std::size_t i = 0; i < X.selected.size(); ++i) {
      Selection flipped = X.selected;
      flipped[i] = flipped[i] ? 0 : 15;
      bool allowed = true;
      for (int n : I.Q.squares[i].node) allowed = allowed && I.S.query(I.M.x[n]).side >= 0;
      if (!allowed || !shapes::isDisk(asTriangles(I.M, I.Q, flipped))) continue;
      ++tried;
      better += literalEnergy(I, 1, flipped) < E - 1e-8;
    }
    CHECK(tried > 10);
    CHECK(better == 0);
  }

  TEST_CASE("labels: S_M are the chosen quarters, from both sides, a disk of the same area") {
    for (const Try& t : tries())
      for (Outline outline : {Outline::squares, Outline::halfSquares}) {
        CAPTURE(t.S.name);
        Steps I(boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2}), t.S);
        I.approximate(t.lc);
        I.heal();
        const Selection selected = surfaceExtraction(I.M, I.Q, I.S, 1, outline).selected;
        const double h = std::ldexp(1., -I.A.level / 3);
        labelSurface(I.B, I.Q, I.A, selected, 1);
        CHECK(shapes::isDisk(surfaceFaces(I.M, 1)));
        CHECK(shapes::conformityFault(I.M) == "");
        double area = .25 * h * h * static_cast<double>(quartersOf(I.Q, selected, true).size());
        CHECK(shapes::computationalArea(I.M, 1) == doctest::Approx(area).epsilon(1e-12));
        std::map<Face, int> sides;
        for (std::size_t E = 0; E < I.M.tets.size(); ++E)
          for (int i = 0; i < 4; ++i)
            if (I.M.faceLabel[E][i] == 1) ++sides[shapes::faceOf(I.M.tets[E], i)];
        int oneSided = 0;
        for (const auto& [f, count] : sides) oneSided += count != 2;
        CHECK(oneSided == 0);
        // each face lies in a chosen quarter: its middle is nearer to none
        int astray = 0;
        const std::vector<Quarter> chosen = quartersOf(I.Q, selected, true);
        for (const auto& [f, count] : sides) {
          const Vec3 middle = (1. / 3) * (I.M.xi[f[0]] + I.M.xi[f[1]] + I.M.xi[f[2]]);
          double nearest = 1e300;
          for (const Quarter& q : chosen) {
            const auto& n = I.Q.squares[q.square].node;
            const Vec3 centre = .5 * (I.M.xi[n[0]] + I.M.xi[n[2]]);
            nearest = std::min(
                nearest, shapes::distanceToTriangle(middle, I.M.xi[q.a], I.M.xi[q.b], centre));
          }
          astray += nearest > 1e-9;
        }
        CHECK(astray == 0);
      }
  }
}
