// SPDX-License-Identifier: MIT
//
// Small meshes for the tests, and checks that share no code with the library: signs, volume,
// conformity, disks, distances. A check returns what it measures, or a sentence, empty where all is
// well.
#ifndef MECCANO_TESTS_SHAPES_HPP
#define MECCANO_TESTS_SHAPES_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <map>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "../meccano.hpp"

namespace shapes {

using meccano::Mesh;
using meccano::TriangleSurface;
using meccano::Vec3;

using Face = std::array<int, 3>;
using Edge = std::array<int, 2>;

inline Face sortedFace(int a, int b, int c) {
  Face f{a, b, c};
  std::sort(f.begin(), f.end());
  return f;
}
inline Edge sortedEdge(int a, int b) { return {std::min(a, b), std::max(a, b)}; }

/// The face of z opposite to its vertex i, sorted.
inline Face faceOf(const std::array<int, 4>& z, int i) {
  return sortedFace(z[(i + 1) % 4], z[(i + 2) % 4], z[(i + 3) % 4]);
}

// ==== Meshes ====================================================================================

/// One unit cube, six Kuhn tetrahedra.
inline Mesh kuhnCube() { return meccano::boxMesh({0, 0, 0}, {1, 1, 1}, {1, 1, 1}); }

/// One tetrahedron without symmetry, x and tets alone: its ideal is the regular one, its boundary
/// fixed.
inline Mesh oneTetrahedron() {
  Mesh M;
  M.x = {{.1, -.2, 0}, {1.3, .1, .2}, {.2, .9, -.1}, {.4, .3, 1.1}};
  M.tets = {{0, 1, 2, 3}};
  return M;
}

/// Two tetrahedra at the face 1 2 3, nodes 0 and 4 on its sides; no symmetry, both of positive
/// volume.
inline Mesh twoTetrahedra() {
  Mesh M = oneTetrahedron();
  M.x.push_back({1.2, 1.1, .9});
  M.tets.push_back({1, 2, 3, 4});
  return M;
}

/// An inner node (number 6) of eight tetrahedra in a distorted octahedron: all signs positive, no
/// two elements alike. With computational coordinates: another octahedron, its node 6 elsewhere.
inline Mesh unsymmetricStar() {
  Mesh M;
  M.x = {{1.1, .1, -.1}, {-.8, .2, .1},   {.1, 1.3, .2},  {.2, -.9, -.1},
         {-.1, .1, .9},  {.1, -.2, -1.2}, {.15, .1, -.05}};
  M.xi = {{1, 0, 0}, {-1, 0, 0}, {0, 1, 0}, {0, -1, 0}, {0, 0, 1}, {0, 0, -1}, {.05, -.1, .1}};
  M.tets = {{0, 2, 4, 6}, {2, 1, 4, 6}, {1, 3, 4, 6}, {3, 0, 4, 6},
            {2, 0, 5, 6}, {1, 2, 5, 6}, {3, 1, 5, 6}, {0, 3, 5, 6}};
  for (auto& z : M.tets)
    std::swap(z[0], z[1]);  // node 6 sees the outer faces from inside: positive
  return M;
}

// ==== Exact signs ===============================================================================

/// A number as a sum of doubles that do not overlap, smallest first (Shewchuk 1997); exact barring
/// underflow.
using Expansion = std::vector<double>;

inline void addTo(Expansion& e, double b) {
  Expansion sum;
  for (double a : e) {  // two-sum: b + a = s + error exactly
    const double s = b + a, part = s - b, error = (b - (s - part)) + (a - part);
    if (error != 0) sum.push_back(error);
    b = s;
  }
  if (b != 0) sum.push_back(b);
  e = sum;
}

inline Expansion sum(const Expansion& a, const Expansion& b, double sign = 1) {
  Expansion e = a;
  for (double term : b) addTo(e, sign * term);
  return e;
}

inline Expansion product(const Expansion& a, const Expansion& b) {
  Expansion e;
  for (double s : a)
    for (double t : b) {
      const double p = s * t;
      addTo(e, std::fma(s, t, -p));
      addTo(e, p);
    }
  return e;
}

/// Sign of det(b - a, c - a, d - a): 1, 0 or -1, exactly.
inline int orientation(Vec3 a, Vec3 b, Vec3 c, Vec3 d) {
  const Vec3 p = b - a, q = c - a, r = d - a;
  const double det = dot(p, cross(q, r));
  auto size = [](Vec3 v) { return std::abs(v.x) + std::abs(v.y) + std::abs(v.z); };
  // rounding of the differences included: 3 + 4 operations of 1.2e-16 per term, with a factor of
  // ten; differences of nearby doubles are as exact as their operands
  const double scale = std::max({size(a), size(b), size(c), size(d)});
  const double bound = 1e-14 * (size(p) * size(q) * size(r)) +
                       1e-15 * scale * (size(p) * size(q) + size(q) * size(r) + size(r) * size(p));
  if (std::abs(det) > bound) return det > 0 ? 1 : -1;
  auto difference = [](Vec3 v, Vec3 w) {
    return std::array<Expansion, 3>{sum({v.x}, {w.x}, -1), sum({v.y}, {w.y}, -1),
                                    sum({v.z}, {w.z}, -1)};
  };
  const auto P = difference(b, a), Q = difference(c, a), R = difference(d, a);
  Expansion exact;
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    exact = sum(exact, product(P[i], sum(product(Q[j], R[k]), product(Q[k], R[j]), -1)));
  }
  return exact.empty() ? 0 : exact.back() > 0 ? 1 : -1;
}

inline int orientation(const std::vector<Vec3>& x, const std::array<int, 4>& z) {
  return orientation(x[z[0]], x[z[1]], x[z[2]], x[z[3]]);
}

/// Tetrahedra that are flat, or whose sign is not that of their computational counterpart (without
/// one: +).
inline int countInverted(const Mesh& M) {
  int inverted = 0;
  for (const auto& z : M.tets) {
    const int ideal = M.xi.empty() ? 1 : orientation(M.xi, z), sign = orientation(M.x, z);
    inverted += sign == 0 || sign != ideal;
  }
  return inverted;
}

/// Sum of the volumes, a tetrahedron against its computational sign counted negative.
inline double totalVolume(const Mesh& M) {
  double volume = 0;
  for (const auto& z : M.tets) {
    const Vec3 a = M.x[z[0]];
    const double ideal = M.xi.empty() ? 1 : orientation(M.xi, z);
    volume += ideal * dot(M.x[z[1]] - a, cross(M.x[z[2]] - a, M.x[z[3]] - a)) / 6;
  }
  return volume;
}

// ==== Conformity ================================================================================

/// Conforming: each face has at most two tetrahedra and they lie on opposite sides of it, in x and
/// in xi; the faces of one tetrahedron close up; no node is unused; no node hangs at an edge's
/// midpoint in xi.
inline std::string conformityFault(const Mesh& M) {
  struct Side {
    Face face;
    int E, i;
  };
  std::vector<Side> sides;
  std::vector<char> used(M.x.size(), 0);
  for (int E = 0; E < static_cast<int>(M.tets.size()); ++E)
    for (int i = 0; i < 4; ++i) {
      sides.push_back({faceOf(M.tets[E], i), E, i});
      used[M.tets[E][i]] = 1;
    }
  if (std::count(used.begin(), used.end(), 0)) return "a node is unused";
  std::sort(sides.begin(), sides.end(),
            [](const Side& a, const Side& b) { return a.face < b.face; });
  std::map<Edge, int> hull;
  for (std::size_t i = 0, j; i < sides.size(); i = j) {
    for (j = i; j < sides.size() && sides[j].face == sides[i].face; ++j) {
    }
    const Face f = sides[i].face;
    if (j - i > 2) return "a face has " + std::to_string(j - i) + " tetrahedra";
    if (j - i == 1) {
      for (int k = 0; k < 3; ++k) ++hull[sortedEdge(f[k], f[(k + 1) % 3])];
      continue;
    }
    const int n0 = M.tets[sides[i].E][sides[i].i], n1 = M.tets[sides[i + 1].E][sides[i + 1].i];
    for (const std::vector<Vec3>* x : {&M.x, &M.xi}) {
      if (x->empty()) continue;
      auto side = [&](int n) { return orientation((*x)[f[0]], (*x)[f[1]], (*x)[f[2]], (*x)[n]); };
      if (side(n0) * side(n1) != -1)
        return "tetrahedra " + std::to_string(sides[i].E) + " and " +
               std::to_string(sides[i + 1].E) + " lie on one side of their face";
    }
  }
  for (const auto& [edge, count] : hull)
    if (count % 2 != 0) return "the boundary is open";
  if (M.xi.empty()) return "";
  auto key = [](Vec3 p) { return std::array<double, 3>{p.x, p.y, p.z}; };
  std::vector<std::array<double, 3>> nodes;
  for (Vec3 p : M.xi) nodes.push_back(key(p));
  std::sort(nodes.begin(), nodes.end());
  if (std::adjacent_find(nodes.begin(), nodes.end()) != nodes.end())
    return "two nodes coincide in xi";
  for (const auto& z : M.tets)
    for (int i = 0; i < 4; ++i)
      for (int j = i + 1; j < 4; ++j)
        if (std::binary_search(nodes.begin(), nodes.end(), key(.5 * (M.xi[z[i]] + M.xi[z[j]]))))
          return "a node hangs at the middle of the edge " + std::to_string(z[i]) + " " +
                 std::to_string(z[j]);
  return "";
}

// ==== Surfaces ==================================================================================

/// Joined sets with path halving.
class Joined {
 public:
  explicit Joined(std::size_t count) : parent_(count) {
    for (std::size_t i = 0; i < count; ++i) parent_[i] = static_cast<int>(i);
  }
  int root(int i) {
    while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
    return i;
  }
  void join(int a, int b) { parent_[root(a)] = root(b); }

 private:
  std::vector<int> parent_;
};

/// One disk: connected through edges, at most two faces at an edge, chi = 1, each rim node on two
/// rim edges.
inline bool isDisk(const std::vector<Face>& faces) {
  if (faces.empty()) return false;
  std::map<Edge, std::vector<int>> atEdge;
  std::map<int, int> rimEdges;  // of each node
  Joined joined(faces.size());
  for (int f = 0; f < static_cast<int>(faces.size()); ++f)
    for (int i = 0; i < 3; ++i) {
      atEdge[sortedEdge(faces[f][i], faces[f][(i + 1) % 3])].push_back(f);
      rimEdges[faces[f][i]] += 0;
    }
  for (const auto& [edge, at] : atEdge) {
    if (at.size() > 2) return false;
    if (at.size() == 2) joined.join(at[0], at[1]);
    if (at.size() == 1) ++rimEdges[edge[0]], ++rimEdges[edge[1]];
  }
  for (std::size_t f = 1; f < faces.size(); ++f)
    if (joined.root(static_cast<int>(f)) != joined.root(0)) return false;
  for (const auto& [node, count] : rimEdges)
    if (count != 0 && count != 2) return false;
  return static_cast<int>(rimEdges.size()) - static_cast<int>(atEdge.size()) +
             static_cast<int>(faces.size()) ==
         1;
}

/// Distance of p from the segment a b.
inline double distanceToSegment(Vec3 p, Vec3 a, Vec3 b) {
  const double length2 = norm2(b - a), t = length2 > 0 ? dot(p - a, b - a) / length2 : 0;
  return norm(p - (a + std::clamp(t, 0., 1.) * (b - a)));
}

/// Distance of p from the triangle a b c: of the plane where p's foot is inside, else of the edges.
inline double distanceToTriangle(Vec3 p, Vec3 a, Vec3 b, Vec3 c) {
  const Vec3 n = cross(b - a, c - a);
  auto inside = [&](Vec3 v, Vec3 w) { return dot(cross(w - v, p - v), n) >= 0; };
  if (norm2(n) > 0 && inside(a, b) && inside(b, c) && inside(c, a))
    return std::abs(dot(p - a, n)) / norm(n);
  return std::min(
      {distanceToSegment(p, a, b), distanceToSegment(p, b, c), distanceToSegment(p, c, a)});
}

/// Largest distance of the points from S: every triangle whose box is near enough is tried.
inline double maxDistanceToSurface(const std::vector<Vec3>& points, const TriangleSurface& S) {
  struct Ball {
    Vec3 middle;
    double radius;
  };
  std::vector<Ball> balls;
  for (const Face& t : S.triangles) {
    const Vec3 middle = (1. / 3) * (S.points[t[0]] + S.points[t[1]] + S.points[t[2]]);
    double radius = 0;
    for (int n : t) radius = std::max(radius, norm(S.points[n] - middle));
    balls.push_back({middle, radius});
  }
  double largest = 0;
  for (Vec3 p : points) {
    double nearest = std::numeric_limits<double>::infinity();
    for (std::size_t t = 0; t < S.triangles.size(); ++t) {
      const double reach = nearest + balls[t].radius;
      if (norm2(p - balls[t].middle) > reach * reach) continue;
      const Face& f = S.triangles[t];
      nearest =
          std::min(nearest, distanceToTriangle(p, S.points[f[0]], S.points[f[1]], S.points[f[2]]));
    }
    largest = std::max(largest, nearest);
  }
  return largest;
}

/// The same for the nodes of the faces with label k.
inline double maxDistanceToSurface(const Mesh& M, int k, const TriangleSurface& S) {
  std::vector<int> nodes;
  for (const Face& f : meccano::surfaceFaces(M, k)) nodes.insert(nodes.end(), f.begin(), f.end());
  std::sort(nodes.begin(), nodes.end());
  nodes.erase(std::unique(nodes.begin(), nodes.end()), nodes.end());
  std::vector<Vec3> points;
  for (int n : nodes) points.push_back(M.x[n]);
  return maxDistanceToSurface(points, S);
}

/// Diagonal of the box of S.
inline double diagonal(const TriangleSurface& S) {
  Vec3 low = S.points.at(0), high = low;
  for (Vec3 p : S.points) {
    low = {std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z)};
    high = {std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z)};
  }
  return norm(high - low);
}

// ==== The steps of §3, and what a mesh looks like after them
// ======================================

/// A mesh and a surface on their way through 3.2 to 3.5, step by step.
struct Steps {
  Mesh M;
  meccano::SurfaceDistance S;
  meccano::Bisection B;
  meccano::Approximation A;
  meccano::SquareSurface Q;

  Steps(Mesh mesh, const TriangleSurface& surface)
      : M(std::move(mesh)), S(cleaned(surface)), B(M), A(), Q() {}
  Steps(const Steps&) = delete;
  void approximate(double lc) { A = meccano::volumetricApproximation(B, S, lc); }
  void heal() {
    meccano::volumetricHealing(B, A);
    Q = meccano::boundarySquares(M, A);
  }
  static TriangleSurface cleaned(const TriangleSurface& surface) {
    std::vector<std::string> warnings;
    return meccano::checkSurface(surface, warnings);
  }
};

/// Whether two lists hold the same bytes.
template <class T>
bool sameBytes(const std::vector<T>& a, const std::vector<T>& b) {
  return a.size() == b.size() &&
         (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) == 0);
}

/// Whether two meshes are the same, byte for byte.
inline bool sameMesh(const Mesh& a, const Mesh& b) {
  bool same = sameBytes(a.x, b.x) && sameBytes(a.xi, b.xi) && sameBytes(a.tets, b.tets) &&
              sameBytes(a.type, b.type) && sameBytes(a.level, b.level) &&
              sameBytes(a.faceLabel, b.faceLabel) && sameBytes(a.dimension, b.dimension) &&
              sameBytes(a.entity, b.entity) && sameBytes(a.parameter, b.parameter) &&
              a.cube == b.cube && a.surfaces.size() == b.surfaces.size() &&
              a.patches.size() == b.patches.size() && a.curves.size() == b.curves.size() &&
              a.corners.size() == b.corners.size();
  if (!same) return false;
  auto sameSurface = [](const meccano::Parametrization& p, const meccano::Parametrization& q) {
    return sameBytes(p.points, q.points) && sameBytes(p.triangles, q.triangles) &&
           sameBytes(p.u, q.u) && p.name == q.name && p.rim == q.rim && p.gridSize == q.gridSize &&
           sameBytes(p.gridStart, q.gridStart) && sameBytes(p.gridTriangles, q.gridTriangles);
  };
  for (std::size_t i = 0; i < a.surfaces.size(); ++i)
    same = same && sameSurface(a.surfaces[i], b.surfaces[i]);
  for (std::size_t i = 0; i < a.patches.size(); ++i)
    same = same && sameSurface(a.patches[i], b.patches[i]);
  for (std::size_t i = 0; i < a.curves.size(); ++i) {
    const meccano::Curve &c = a.curves[i], &d = b.curves[i];
    same = same && sameBytes(c.points, d.points) && sameBytes(c.s, d.s) && c.closed == d.closed &&
           c.sides.size() == d.sides.size();
    for (std::size_t j = 0; same && j < c.sides.size(); ++j)
      same = c.sides[j].surface == d.sides[j].surface && sameBytes(c.sides[j].u, d.sides[j].u);
  }
  for (std::size_t i = 0; i < a.corners.size(); ++i) {
    const meccano::Corner &c = a.corners[i], &d = b.corners[i];
    same = same && c.x == d.x && c.on.size() == d.on.size();
    for (std::size_t j = 0; same && j < c.on.size(); ++j)
      same = c.on[j].curve == d.on[j].curve && c.on[j].s == d.on[j].s;
  }
  return same;
}

/// Labels, from both sides, each face for whose computational corners `wanted` holds.
template <class Wanted>
void labelFaces(Mesh& M, int k, Wanted wanted) {
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i) {
      const Face f = faceOf(M.tets[E], i);
      if (wanted(M.xi[f[0]], M.xi[f[1]], M.xi[f[2]])) M.faceLabel[E][i] = k;
    }
}

/// Whether a face lies in the box [low, high] of the computational space (a square: one side is 0).
inline bool facesInBox(Vec3 a, Vec3 b, Vec3 c, Vec3 low, Vec3 high) {
  for (Vec3 p : {a, b, c})
    if (p.x < low.x || p.x > high.x || p.y < low.y || p.y > high.y || p.z < low.z || p.z > high.z)
      return false;
  return true;
}

/// S_M as sets, counted from its faces: edges with their number of faces; nodes, 2 on the rim,
/// else 1.
struct SurfaceSets {
  std::set<Face> faces;
  std::map<Edge, int> edges;
  std::map<int, int> nodes;
  SurfaceSets(const Mesh& M, int k) : faces(), edges(), nodes() {
    for (const Face& f : meccano::surfaceFaces(M, k)) {
      faces.insert(sortedFace(f[0], f[1], f[2]));
      for (int i = 0; i < 3; ++i) {
        ++edges[sortedEdge(f[i], f[(i + 1) % 3])];
        nodes[f[i]] = 1;
      }
    }
    for (const auto& [edge, count] : edges)
      if (count == 1) nodes[edge[0]] = nodes[edge[1]] = 2;
  }
  bool isRimEdge(int a, int b) const {
    const auto at = edges.find(sortedEdge(a, b));
    return at != edges.end() && at->second == 1;
  }
};

/// Area of the faces labelled k in the computational space.
inline double computationalArea(const Mesh& M, int k) {
  double area = 0;
  for (const Face& f : meccano::surfaceFaces(M, k))
    area += .5 * norm(cross(M.xi[f[1]] - M.xi[f[0]], M.xi[f[2]] - M.xi[f[0]]));
  return area;
}

/// The quadrilateral a b c d as two triangles, cut from a to c or from b to d.
inline void addCell(TriangleSurface& S, bool fromA, int a, int b, int c, int d) {
  S.triangles.push_back(fromA ? std::array<int, 3>{a, b, c} : std::array<int, 3>{a, b, d});
  S.triangles.push_back(fromA ? std::array<int, 3>{a, c, d} : std::array<int, 3>{b, c, d});
}

}  // namespace shapes
#endif
