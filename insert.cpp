// SPDX-License-Identifier: MIT
//
// Sections 2 to 3.6 of the paper. 2: the meccano (boxes, polycubes), its boundary mapping Π,
// Kossaczký's bisection, terrain, and Algorithm 1 for solids. 3: volumetric approximation and its
// healing, surface extraction and its healing, surface projection; and insertSurface, which calls
// them in the paper's order. Section 3.7 is optimize.cpp.
#include <algorithm>
#include <cfloat>
#include <cstdint>
#include <cstdio>
#include <map>
#include <numeric>
#include <queue>
#include <set>
#include <tuple>

#include "meccano.hpp"

namespace meccano {

// ==== Tools: numbers and keys ===================================================================

namespace {

/// A double as messages print it.
std::string number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.6g", value);
  return text;
}

void growBox(TriangleTree::Box& box, Vec3 p) {
  box.lo = {std::min(box.lo.x, p.x), std::min(box.lo.y, p.y), std::min(box.lo.z, p.z)};
  box.hi = {std::max(box.hi.x, p.x), std::max(box.hi.y, p.y), std::max(box.hi.z, p.z)};
}

/// The numbers of what is marked, ascending.
std::vector<int> markedOf(const std::vector<char>& mark) {
  std::vector<int> marked;
  marked.reserve(mark.size() - std::count(mark.begin(), mark.end(), 0));
  for (std::size_t i = 0; i < mark.size(); ++i)
    if (mark[i]) marked.push_back(static_cast<int>(i));
  return marked;
}

/// Open-addressing hash from 64-bit keys (lattice points, node pairs) to an int, 0 where absent.
class KeyMap {
 public:
  explicit KeyMap(std::size_t expected = 8) {
    std::size_t size = 16;
    while (size < 2 * expected) size *= 2;
    slots_.assign(size, {empty, 0});
  }
  int& operator[](std::uint64_t key) {
    if (2 * (count_ + 1) > slots_.size()) grow();
    Slot& s = slots_[slot(key)];
    if (s.key == empty) {
      s.key = key;
      ++count_;
    }
    return s.value;
  }
  int get(std::uint64_t key) const { return slots_[slot(key)].value; }

 private:
  static constexpr std::uint64_t empty = ~std::uint64_t(0);
  struct Slot {
    std::uint64_t key;
    int value;  // 0 where empty
  };
  std::size_t slot(std::uint64_t key) const {
    std::uint64_t z = key * 0x9E3779B97F4A7C15u;  // Fibonacci hashing
    std::size_t i = (z ^ (z >> 29)) & (slots_.size() - 1);
    while (slots_[i].key != empty && slots_[i].key != key) i = (i + 1) & (slots_.size() - 1);
    return i;
  }
  void grow() {
    KeyMap larger(slots_.size());
    for (const Slot& s : slots_)
      if (s.key != empty) larger[s.key] = s.value;
    *this = std::move(larger);
  }
  std::vector<Slot> slots_;
  std::size_t count_ = 0;
};

std::uint64_t edgeKey(int a, int b) {
  const std::uint64_t lo = std::uint32_t(std::min(a, b)), hi = std::uint32_t(std::max(a, b));
  return lo << 32 | hi;
}

std::array<int, 3> faceOpposite(const std::array<int, 4>& z, int i) {
  return {z[(i + 1) % 4], z[(i + 2) % 4], z[(i + 3) % 4]};
}

int localIndex(const std::array<int, 4>& tet, int n) {
  for (int i = 0; i < 4; ++i)
    if (tet[i] == n) return i;
  return -1;
}

std::string placeText(Vec3 p) {
  char text[96];
  std::snprintf(text, sizeof text, "(%.9g, %.9g, %.9g)", p.x, p.y, p.z);
  return text;
}

std::string counted(std::size_t n, const std::string& one) {
  return std::to_string(n) + ' ' + one + (n == 1 ? "" : "s");
}

/// Disjoint sets of 0 .. n - 1, each named after its lowest member.
struct Parts {
  std::vector<int> parent;
  explicit Parts(std::size_t n) : parent(n) { std::iota(parent.begin(), parent.end(), 0); }
  int of(int i) {
    while (parent[i] != i) i = parent[i] = parent[parent[i]];
    return i;
  }
  void join(int i, int j) {
    i = of(i);
    j = of(j);
    parent[std::max(i, j)] = std::min(i, j);
  }
};

/// Corner of a triangle at point n: 0, 1, 2; 3: it has none.
int cornerAt(const std::array<int, 3>& triangle, int n) {
  return triangle[0] == n ? 0 : triangle[1] == n ? 1 : triangle[2] == n ? 2 : 3;
}

}  // namespace

// ==== Tools: curves, and the point location in 𝓤 ================================================

namespace {

/// The segment of a curve from point i to the next, and the part t of it, at arc length s.
struct CurvePlace {
  int i, next;
  double t;
};
CurvePlace placeOn(const Curve& C, double s) {
  const double length = C.s.back();
  s = C.closed ? s - length * std::floor(s / length) : std::clamp(s, 0., length);
  const int last = static_cast<int>(C.s.size()) - 2;
  const auto after = std::upper_bound(C.s.begin(), C.s.end(), s);
  const int i = std::clamp(static_cast<int>(after - C.s.begin()) - 1, 0, last);
  const double step = C.s[i + 1] - C.s[i];
  return {i, (i + 1) % static_cast<int>(C.points.size()), step > 0 ? (s - C.s[i]) / step : 0};
}

/// u of a surface along a curve that bounds it: as gamma, in 𝓤.
Vec2 curveParameter(const Curve& C, const Curve::Side& side, double s) {
  const CurvePlace at = placeOn(C, s);
  return side.u[at.i] + at.t * (side.u[at.next] - side.u[at.i]);
}

}  // namespace

Vec3 gamma(const Curve& C, double s) {
  const CurvePlace at = placeOn(C, s);
  const Vec3 a = C.points[at.i], b = C.points[at.next];
  return at.t < .5 ? a + at.t * (b - a) : b + (1 - at.t) * (a - b);  // exact at both ends
}

namespace {

/// Cell of the grid along one axis.
int gridCell(double x, int size) {
  return x > 0 ? static_cast<int>(std::min(x * size, size - 1.)) : 0;
}

/// Whether a line along one of the triangle's edges has the triangle on one side and the whole cell
/// on the other: slivers across a grid meet few of the cells that their boxes meet.
bool separated(const std::array<Vec2, 3>& t, Vec2 low, double cell) {
  const Vec2 high = low + Vec2{cell, cell};
  for (int i = 0; i < 3; ++i) {
    const Vec2 a = t[i], d = t[(i + 1) % 3] - a;
    const double third = cross(d, t[(i + 2) % 3] - a);
    const double x[2] = {d.x * (low.y - a.y), d.x * (high.y - a.y)};
    const double y[2] = {d.y * (low.x - a.x), d.y * (high.x - a.x)};
    const double least = std::min(x[0], x[1]) - std::max(y[0], y[1]);
    const double most = std::max(x[0], x[1]) - std::min(y[0], y[1]);
    constexpr double rounding = 1e-14, part = 1e-6;  // of the products, of a cell: far above it
    const double margin =
        rounding * (std::abs(x[0]) + std::abs(x[1]) + std::abs(y[0]) + std::abs(y[1])) +
        part * cell * norm(d) + rounding * std::abs(third);
    if (most < std::min(third, 0.) - margin || least > std::max(third, 0.) + margin) return true;
  }
  return false;
}

/// The triangles of each cell of a grid over 𝓤.
std::vector<std::vector<int>> cellsOf(const Parametrization& P) {
  const int size = P.gridSize;
  const double cell = 1. / size, margin = 1e-6 * cell;  // far above rounding
  std::vector<std::vector<int>> cells(std::size_t(size) * size);
  for (int t = 0; t < static_cast<int>(P.triangles.size()); ++t) {
    const std::array<int, 3>& n = P.triangles[t];
    const std::array<Vec2, 3> u{P.u[n[0]], P.u[n[1]], P.u[n[2]]};
    const int left = gridCell(std::min({u[0].x, u[1].x, u[2].x}) - margin, size);
    const int right = gridCell(std::max({u[0].x, u[1].x, u[2].x}) + margin, size);
    const int bottom = gridCell(std::min({u[0].y, u[1].y, u[2].y}) - margin, size);
    const int top = gridCell(std::max({u[0].y, u[1].y, u[2].y}) + margin, size);
    const bool oneCell = left == right && bottom == top;
    for (int j = bottom; j <= top; ++j)
      for (int i = left; i <= right; ++i)
        if (oneCell || !separated(u, cell * Vec2{double(i), double(j)}, cell))
          cells[std::size_t(j) * size + i].push_back(t);
  }
  return cells;
}

constexpr int crowded = 6;  // triangles in a box that is halved; a vertex may well have 12

/// Halves a run of P.gridTriangles, across the longer side of its box, down to few in a box.
/// Returns the number of its box. The recursion is as deep as the logarithm of the run's length.
int addBoxes(Parametrization& P, int first, int last) {
  const int number = static_cast<int>(P.boxes.size());
  Parametrization::Box box{{1e300, 1e300}, {-1e300, -1e300}, first, last, 0};
  for (int i = first; i < last; ++i)
    for (int n : P.triangles[P.gridTriangles[i]]) {
      const Vec2 u = P.u[n];
      box.low = {std::min(box.low.x, u.x), std::min(box.low.y, u.y)};
      box.high = {std::max(box.high.x, u.x), std::max(box.high.y, u.y)};
    }
  P.boxes.push_back(box);
  if (last - first <= crowded) return number;
  const bool alongX = box.high.x - box.low.x > box.high.y - box.low.y;
  auto place = [&](int t) {
    double sum = 0;
    for (int n : P.triangles[t]) sum += alongX ? P.u[n].x : P.u[n].y;
    return sum;
  };
  const int middle = first + (last - first) / 2;
  const auto at = [&](int i) { return P.gridTriangles.begin() + i; };
  std::nth_element(at(first), at(middle), at(last), [&](int s, int t) {
    return std::make_pair(place(s), s) < std::make_pair(place(t), t);
  });
  addBoxes(P, first, middle);
  const int right = addBoxes(P, middle, last);
  P.boxes[number].right = right;
  return number;
}

constexpr double farOutside = -1e-8;  // barycentric: well below the tolerance of locate

/// Looks for u among a run of P.gridTriangles. Returns whether it is inside one of them.
bool locateIn(const Parametrization& P, Vec2 u, int first, int last, Location& best,
              double& bestInside) {
  for (int i = first; i < last; ++i) {
    const std::array<int, 3>& t = P.triangles[P.gridTriangles[i]];
    const Vec2 a = P.u[t[0]] - u, b = P.u[t[1]] - u, c = P.u[t[2]] - u;
    const double area = cross(b - a, c - a), ofA = cross(b, c), ofB = cross(c, a);
    // most triangles are left here: clearly outside, without a division
    const double outside = farOutside * std::abs(area), side = area < 0 ? -1 : 1;
    if (side * ofA < outside || side * ofB < outside || side * (area - ofA - ofB) < outside)
      continue;
    const double w0 = ofA / area, w1 = ofB / area, w2 = 1 - w0 - w1;
    const double inside = std::min({w0, w1, w2});
    if (inside > bestInside) {
      bestInside = inside;
      best = {P.gridTriangles[i], {w0, w1, w2}};
    }
    if (inside >= 0) return true;
  }
  return false;
}

/// As locateIn, among the triangles of a tree of boxes.
bool locateInBoxes(const Parametrization& P, Vec2 u, int root, Location& best, double& bestInside) {
  constexpr double part = 1e-9;  // of the box: as the tolerance of triangles
  int waiting[64] = {root};      // the tree is less deep
  for (int count = 1; count > 0;) {
    const int b = waiting[--count];
    const Parametrization::Box& box = P.boxes[b];
    const Vec2 m = part * (box.high - box.low);
    if (u.x < box.low.x - m.x || u.x > box.high.x + m.x || u.y < box.low.y - m.y ||
        u.y > box.high.y + m.y)
      continue;
    if (box.right > 0)
      waiting[count++] = box.right, waiting[count++] = b + 1;
    else if (locateIn(P, u, box.first, box.last, best, bestInside))
      return true;
  }
  return false;
}

}  // namespace

void buildLocator(Parametrization& P) {
  const int count = static_cast<int>(P.triangles.size());
  P.gridSize = std::clamp(static_cast<int>(std::sqrt(count)), 1, 1024);
  P.gridTriangles.clear();
  P.gridStart.assign(1, 0);
  P.boxes.clear();
  P.boxOf.clear();
  for (const std::vector<int>& cell : cellsOf(P)) {
    const int first = P.gridStart.back(), last = first + static_cast<int>(cell.size());
    P.gridTriangles.insert(P.gridTriangles.end(), cell.begin(), cell.end());
    P.gridStart.push_back(last);
    P.boxOf.push_back(last - first > crowded ? addBoxes(P, first, last) : -1);
  }
}

Location locate(const Parametrization& P, Vec2 u) {
  constexpr double tolerance = 1e-9;  // barycentric: a point on the border of 𝓤 may round outside
  const int cell = gridCell(u.y, P.gridSize) * P.gridSize + gridCell(u.x, P.gridSize);
  Location best{-1, {0, 0, 0}};
  double bestInside = -tolerance;
  if (P.boxOf[cell] < 0)
    locateIn(P, u, P.gridStart[cell], P.gridStart[cell + 1], best, bestInside);
  else
    locateInBoxes(P, u, P.boxOf[cell], best, bestInside);
  if (best.triangle >= 0 && bestInside < 0) {
    double sum = 0;
    for (double& w : best.w) sum += w = std::max(w, 0.0);
    for (double& w : best.w) w /= sum;
  }
  return best;
}

Vec3 varphi(const Parametrization& P, const Location& at) {
  const std::array<int, 3>& t = P.triangles[at.triangle];
  // From the nearest vertex: exact at the vertices and in coordinate planes.
  const int i = static_cast<int>(std::max_element(at.w, at.w + 3) - at.w);
  const int j = (i + 1) % 3, k = (i + 2) % 3;
  const Vec3 a = P.points[t[i]];
  return a + (at.w[j] * (P.points[t[j]] - a) + at.w[k] * (P.points[t[k]] - a));
}

Vec3 varphi(const Parametrization& P, Vec2 u) {
  const Location at = locate(P, u);
  if (at.triangle < 0)
    throw MethodError("varphi (§3.6, eq. (3)): u = (" + number(u.x) + ", " + number(u.y) +
                      ") is outside the parametric square of surface '" + P.name + "'");
  return varphi(P, at);
}

const Parametrization& surfaceOf(const Mesh& M, int label) {
  return label > 0 ? M.surfaces[label - 1] : M.patches[-label - 1];
}

namespace {

/// The faces for which wanted(label, nodes) holds; one of an inserted surface, which is seen from
/// both of its tetrahedra, once. Outward for a positively oriented tetrahedron.
template <class Wanted>
std::vector<std::array<int, 3>> labelledFaces(const Mesh& M, Wanted wanted) {
  constexpr int outward[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};
  std::vector<std::array<int, 3>> faces, sorted;  // as seen; by node numbers
  // chains of the faces of each lowest node, latest first
  std::vector<int> latest(M.x.size(), -1), earlier;
  for (std::size_t E = 0; E < M.faceLabel.size(); ++E) {
    const std::array<int, 4>&labels = M.faceLabel[E], &z = M.tets[E];
    if ((labels[0] | labels[1] | labels[2] | labels[3]) == 0) continue;  // most are inside
    for (int i = 0; i < 4; ++i) {
      const std::array<int, 3> face{z[outward[i][0]], z[outward[i][1]], z[outward[i][2]]};
      if (labels[i] == 0 || !wanted(labels[i], face)) continue;
      std::array<int, 3> key = face;
      std::sort(key.begin(), key.end());
      int same = labels[i] > 0 ? latest[key[0]] : -1;
      while (same >= 0 && sorted[same] != key) same = earlier[same];
      if (same >= 0) continue;
      earlier.push_back(latest[key[0]]);
      latest[key[0]] = static_cast<int>(faces.size());
      sorted.push_back(key), faces.push_back(face);
    }
  }
  return faces;
}

}  // namespace

std::vector<std::array<int, 3>> surfaceFaces(const Mesh& M, int k) {
  return labelledFaces(M, [k](int label, const auto&) { return label == k; });
}

// ==== 2. Meccano: the box ========================================================================

namespace {

/// Patch number of the box side with outward normal -e_axis (side 0) or +e_axis (side 1).
int boxPatch(int axis, int side) { return 2 * axis + side + 1; }

double component(Vec3 v, int axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }

Vec3 boxPoint(Vec3 origin, Vec3 size, std::array<int, 3> i, std::array<int, 3> n) {
  auto at = [](double o, double l, int k, int m) { return k == m ? o + l : o + l * k / m; };
  return {at(origin.x, size.x, i[0], n[0]), at(origin.y, size.y, i[1], n[1]),
          at(origin.z, size.z, i[2], n[2])};
}

/// The six sides as parametrizations of two triangles: u runs along the two other axes.
void addBoxPatches(Mesh& M, Vec3 origin, Vec3 size) {
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side) {
      Parametrization P;
      P.name = std::string(1, "xyz"[axis]) + (side ? "+" : "-");
      for (int v = 0; v < 2; ++v)
        for (int u = 0; u < 2; ++u) {
          std::array<int, 3> corner;
          corner[axis] = side, corner[(axis + 1) % 3] = u, corner[(axis + 2) % 3] = v;
          P.points.push_back(boxPoint(origin, size, corner, {1, 1, 1}));
          P.u.push_back({double(u), double(v)});
        }
      P.triangles = {{0, 1, 3}, {0, 3, 2}};
      buildLocator(P);
      M.patches.push_back(P);
    }
}

/// The twelve edges: along `axis`, at side b of the next axis and side c of the one after.
void addBoxCurves(Mesh& M, Vec3 origin, Vec3 size) {
  for (int axis = 0; axis < 3; ++axis)
    for (int c = 0; c < 2; ++c)
      for (int b = 0; b < 2; ++b) {
        Curve C;
        for (int end = 0; end < 2; ++end) {
          std::array<int, 3> corner;
          corner[axis] = end, corner[(axis + 1) % 3] = b, corner[(axis + 2) % 3] = c;
          C.points.push_back(boxPoint(origin, size, corner, {1, 1, 1}));
        }
        C.s = {0, component(size, axis)};
        // on the side normal to axis + 1, u = (axis + 2, axis); on the one normal to axis + 2,
        // (axis, axis + 1)
        C.sides = {{-boxPatch((axis + 1) % 3, b), {{double(c), 0}, {double(c), 1}}},
                   {-boxPatch((axis + 2) % 3, c), {{0, double(b)}, {1, double(b)}}}};
        M.curves.push_back(C);
      }
}

int boxCurve(int axis, int b, int c) { return 4 * axis + 2 * c + b + 1; }

/// Corner number 1 + i + 2 j + 4 k with i, j, k the sides.
void addBoxCorners(Mesh& M, Vec3 origin, Vec3 size) {
  for (int number = 0; number < 8; ++number) {
    const std::array<int, 3> at{number & 1, number >> 1 & 1, number >> 2 & 1};
    Corner corner{boxPoint(origin, size, at, {1, 1, 1}), {}};
    for (int axis = 0; axis < 3; ++axis)
      corner.on.push_back({boxCurve(axis, at[(axis + 1) % 3], at[(axis + 2) % 3]),
                           at[axis] * component(size, axis)});
    M.corners.push_back(corner);
  }
}

/// Dimension, entity and parameter of the lattice node i of a box with n cells.
void addBoxNode(Mesh& M, std::array<int, 3> i, std::array<int, 3> n, Vec3 size) {
  std::array<int, 3> side;  // 0, 1 on the sides, -1 between
  int between = 0, axis = 0;
  for (int a = 0; a < 3; ++a) {
    side[a] = i[a] == 0 ? 0 : i[a] == n[a] ? 1 : -1;
    between += side[a] < 0;
  }
  auto part = [&](int a) { return double(i[a]) / n[a]; };
  int entity = 0;
  Vec2 parameter;
  if (between == 0) entity = 1 + side[0] + 2 * side[1] + 4 * side[2];
  if (between == 1) {
    while (side[axis] >= 0) ++axis;
    entity = boxCurve(axis, side[(axis + 1) % 3], side[(axis + 2) % 3]);
    parameter = {component(size, axis) * part(axis), 0};
  }
  if (between == 2) {
    while (side[axis] < 0) ++axis;
    entity = -boxPatch(axis, side[axis]);
    parameter = {part((axis + 1) % 3), part((axis + 2) % 3)};
  }
  M.dimension.push_back(static_cast<unsigned char>(between));
  M.entity.push_back(entity);
  M.parameter.push_back(parameter);
}

/// Six Kuhn tetrahedra of the cell at i: one for each path x0 x1 x2 x3 along the axes.
///   node   number of a lattice point;  label  of the cell's side (axis, 0 or 1)
template <class Node, class Label>
void addKuhnCell(Mesh& M, std::array<int, 3> i, Node node, Label label) {
  constexpr int paths[6][3] = {{0, 1, 2}, {0, 2, 1}, {1, 0, 2}, {1, 2, 0}, {2, 0, 1}, {2, 1, 0}};
  for (const auto& path : paths) {
    std::array<int, 3> p = i;
    std::array<int, 4> x;
    x[0] = node(p);
    for (int step = 0; step < 3; ++step) {
      ++p[path[step]];
      x[step + 1] = node(p);
    }
    M.tets.push_back({x[0], x[3], x[2], x[1]});
    // x0 lies on the lower sides, x3 on the upper ones: the faces without x3 or without x0
    M.faceLabel.push_back({label(path[0], 1), label(path[2], 0), 0, 0});
  }
}

}  // namespace

Mesh boxMesh(Vec3 origin, Vec3 size, std::array<int, 3> cells) {
  if (!isFinite(origin) || !isFinite(size) || !(size.x > 0 && size.y > 0 && size.z > 0))
    throw InputError("boxMesh: origin and size must be finite and size above 0, not " +
                     placeText(origin) + " and " + placeText(size));
  for (int n : cells)
    if (n < 1 || n > 1000)
      throw InputError("boxMesh: each number of cells must be from 1 to 1000, not " +
                       std::to_string(n));
  Mesh M;
  addBoxPatches(M, origin, size);
  addBoxCurves(M, origin, size);
  addBoxCorners(M, origin, size);
  for (int k = 0; k <= cells[2]; ++k)
    for (int j = 0; j <= cells[1]; ++j)
      for (int i = 0; i <= cells[0]; ++i) {
        M.x.push_back(boxPoint(origin, size, {i, j, k}, cells));
        M.xi.push_back({double(i), double(j), double(k)});
        addBoxNode(M, {i, j, k}, cells, size);
      }
  for (int k = 0; k < cells[2]; ++k)
    for (int j = 0; j < cells[1]; ++j)
      for (int i = 0; i < cells[0]; ++i)
        addKuhnCell(
            M, {i, j, k},
            [&](std::array<int, 3> p) {
              return (p[2] * (cells[1] + 1) + p[1]) * (cells[0] + 1) + p[0];
            },
            [&](int axis, int side) {
              const int at = std::array<int, 3>{i, j, k}[axis];
              return at == side * (cells[axis] - 1) ? -boxPatch(axis, side) : 0;
            });
  M.type.assign(M.tets.size(), 0);
  M.level.assign(M.tets.size(), 0);
  M.cube = {size.x / cells[0], size.y / cells[1], size.z / cells[2]};
  const QualityStatistics q = qualityStatistics(M);
  if (q.inverted > 0 || !(q.min > 0))
    throw InputError(
        "boxMesh: origin and size leave no digits for the cells; move or scale the box");
  return M;
}

// ==== 2. Meccano: the boundary of a polycube =====================================================

namespace {

using LatticePoint = std::array<int, 3>;

LatticePoint moved(LatticePoint p, int axis, int by) {
  p[axis] += by;
  return p;
}

/// Lattice points in the order of boxMesh's nodes.
bool precedes(const LatticePoint& a, const LatticePoint& b) {
  return std::tie(a[2], a[1], a[0]) < std::tie(b[2], b[1], b[0]);
}

Vec3 latticeVector(const LatticePoint& p) { return {double(p[0]), double(p[1]), double(p[2])}; }

std::string latticeText(const LatticePoint& p) {
  return "(" + std::to_string(p[0]) + " " + std::to_string(p[1]) + " " + std::to_string(p[2]) + ")";
}

/// A unit square of the meccano's boundary with outward normal -e_axis (side 0) or +e_axis (1).
struct UnitSquare {
  LatticePoint lo;
  int axis, side;
  int region = -1, rectangle = -1;
  /// Corner e of four, counter-clockwise from outside.
  LatticePoint corner(int e) const {
    const int u = (axis + 1) % 3, v = (axis + 2) % 3;
    LatticePoint p = lo;
    if (e == 2 || e == (side == 1 ? 1 : 3)) ++p[u];
    if (e == 2 || e == (side == 1 ? 3 : 1)) ++p[v];
    return p;
  }
};

/// A straight edge between two nodes of the net on the meccano's boundary. Half-chain 2 c runs
/// along chain c, half-chain 2 c + 1 against it.
struct Chain {
  LatticePoint end[2];
  int node[2];
  bool cut;  // inside a flat region
  int length() const {
    return std::abs(end[1][0] - end[0][0]) + std::abs(end[1][1] - end[0][1]) +
           std::abs(end[1][2] - end[0][2]);
  }
};

/// A rectangle of unit squares; a flat region's bounding rectangle.
struct LatticeRectangle {
  LatticePoint lo, hi;
  int axis, side;
  int region;
  std::vector<int> rim;  // half-chains, counter-clockwise from outside
};

/// The meccano's boundary: flat regions, cut into rectangles where they are none, and the net of
/// chains around the rectangles.
struct MeccanoSurface {
  std::vector<UnitSquare> squares;
  std::map<std::pair<LatticePoint, LatticePoint>, int> half;  // unit edge -> 4 square + edge
  std::vector<LatticeRectangle> regions, rectangles;
  std::vector<LatticePoint> nodes;
  std::vector<char> isCorner;  // [nodes], of the polycube; else where a cut ends
  std::vector<Chain> chains;
  std::vector<std::vector<int>> around;  // [nodes], half-chains that leave it, counter-clockwise
  int genus = 0;

  explicit MeccanoSurface(const Meccano& C);
  int squareLeftOf(const LatticePoint& p, const LatticePoint& q) const {
    return half.at({p, q}) / 4;
  }
  LatticePoint start(int h) const { return chains[h / 2].end[h % 2]; }
  int startNode(int h) const { return chains[h / 2].node[h % 2]; }
  /// The lattice point after its start.
  LatticePoint second(int h) const {
    const LatticePoint &a = start(h), &b = start(h ^ 1);
    LatticePoint p;
    for (int i = 0; i < 3; ++i) p[i] = a[i] + (b[i] > a[i]) - (b[i] < a[i]);
    return p;
  }
  int rectangleLeftOf(int h) const { return squares[squareLeftOf(start(h), second(h))].rectangle; }

 private:
  using UnitEdges = std::set<std::pair<LatticePoint, LatticePoint>>;  // in both directions
  UnitEdges net_;
  void addSquares(const Meccano& C);
  void checkManifold();
  void join(bool regions);
  std::vector<LatticePoint> spokes(const LatticePoint& p) const;
  void cutRegions();
  void addNodes();
  void addChains();
  void addRims();
};

[[noreturn]] void refuseMeccano(const std::string& what) {
  throw InputError("getBoundaryMapping (§2): " + what);
}

void MeccanoSurface::addSquares(const Meccano& C) {
  constexpr int largest = 1000;  // of the lattice, as boxMesh
  if (C.cubes.empty()) refuseMeccano("the polycube has no cubes; give at least one");
  LatticePoint lo = C.cubes[0], hi = lo;
  for (const LatticePoint& c : C.cubes)
    for (int a = 0; a < 3; ++a) lo[a] = std::min(lo[a], c[a]), hi[a] = std::max(hi[a], c[a]);
  for (int a = 0; a < 3; ++a)
    if (std::int64_t(hi[a]) - lo[a] >= largest)
      refuseMeccano("the polycube is longer than 1000 cubes along axis " + std::to_string(a) +
                    "; use fewer, larger cubes");
  const std::set<LatticePoint> cubes(C.cubes.begin(), C.cubes.end());
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side)
      for (const LatticePoint& c : cubes)
        if (cubes.count(moved(c, axis, side ? 1 : -1)) == 0)
          squares.push_back({moved(c, axis, side), axis, side});
}

/// Each unit edge in two squares, each point with one fan of squares, one component.
void MeccanoSurface::checkManifold() {
  std::map<LatticePoint, int> squaresAt;
  for (int s = 0; s < static_cast<int>(squares.size()); ++s)
    for (int e = 0; e < 4; ++e) {
      const LatticePoint p = squares[s].corner(e), q = squares[s].corner((e + 1) % 4);
      ++squaresAt[p];
      if (!half.insert({{p, q}, 4 * s + e}).second)
        refuseMeccano("the polycube's boundary is no manifold at the edge from " + latticeText(p) +
                      " to " + latticeText(q) +
                      ": two cubes touch only there; add a cube beside them or remove one");
    }
  for (const auto& [edge, square] : half)
    if (static_cast<int>(spokes(edge.first).size()) != squaresAt[edge.first])
      refuseMeccano("the polycube's boundary is no manifold at the point " +
                    latticeText(edge.first) +
                    ": cubes touch only there; add a cube beside them or remove one");
  Parts parts(squares.size());
  for (const auto& [edge, square] : half)
    parts.join(square / 4, squareLeftOf(edge.second, edge.first));
  int components = 0;
  for (int s = 0; s < static_cast<int>(squares.size()); ++s) components += parts.of(s) == s;
  if (components > 1)
    refuseMeccano("the polycube's boundary has " + std::to_string(components) +
                  " components; its cubes must hang together by faces, without an inner hollow");
  const int euler = static_cast<int>(squaresAt.size()) - static_cast<int>(half.size() / 2) +
                    static_cast<int>(squares.size());
  genus = (2 - euler) / 2;
}

/// The neighbours of a boundary point, counter-clockwise from outside.
std::vector<LatticePoint> MeccanoSurface::spokes(const LatticePoint& p) const {
  constexpr std::size_t most = 8;  // at a manifold point there are six
  std::vector<LatticePoint> ring;
  const auto first = half.lower_bound({p, LatticePoint{-(1 << 30), 0, 0}});
  LatticePoint q = first->first.second;
  do {
    ring.push_back(q);
    const int at = half.at({p, q});
    q = squares[at / 4].corner((at + 3) % 4);
  } while (q != first->first.second && ring.size() < most);
  return ring;
}

/// Groups squares: into flat regions, or into rectangles between the edges of the net.
void MeccanoSurface::join(bool flat) {
  Parts parts(squares.size());
  for (const auto& [edge, at] : half) {
    const int s = at / 4, other = squareLeftOf(edge.second, edge.first);
    const UnitSquare &a = squares[s], &b = squares[other];
    if (flat ? a.axis == b.axis && a.side == b.side : net_.count(edge) == 0) parts.join(s, other);
  }
  std::vector<LatticeRectangle>& groups = flat ? regions : rectangles;
  std::vector<int> group(squares.size(), -1);
  for (int s = 0; s < static_cast<int>(squares.size()); ++s) {
    UnitSquare& q = squares[s];
    const int first = parts.of(s);
    if (first == s) {
      group[s] = static_cast<int>(groups.size());
      groups.push_back({q.lo, q.lo, q.axis, q.side, flat ? group[s] : q.region, {}});
    }
    LatticeRectangle& R = groups[group[first]];
    for (int a = 0; a < 3; ++a) {
      R.lo[a] = std::min(R.lo[a], q.lo[a]);
      R.hi[a] = std::max(R.hi[a], q.lo[a] + (a == q.axis ? 0 : 1));
    }
    (flat ? q.region : q.rectangle) = group[first];
  }
}

/// The net starts with the edges between flat regions. [choice] From each point where a region has
/// an inner angle of 270° a cut runs to the net, the shorter way: what is left are rectangles.
void MeccanoSurface::cutRegions() {
  auto regionAt = [&](const LatticePoint& p, const LatticePoint& q) {
    return squares[squareLeftOf(p, q)].region;
  };
  std::map<std::pair<LatticePoint, int>, int> squaresAt;  // of each region, at each point
  for (const auto& [edge, at] : half) {
    ++squaresAt[{edge.first, squares[at / 4].region}];
    if (squares[at / 4].region != regionAt(edge.second, edge.first)) net_.insert(edge);
  }
  auto onNet = [&](const LatticePoint& p) {
    const std::vector<LatticePoint> ring = spokes(p);
    return std::any_of(ring.begin(), ring.end(), [&](const LatticePoint& q) {
      return net_.count({p, q}) > 0;
    });
  };
  for (const auto& [at, count] : squaresAt) {
    if (count != 3) continue;
    const LatticePoint p = at.first;
    std::vector<LatticePoint> best;
    bool isCut = false;
    for (const LatticePoint& q : spokes(p)) {
      if (regionAt(p, q) != at.second || regionAt(q, p) != at.second) continue;
      isCut |= net_.count({p, q}) > 0;
      std::vector<LatticePoint> way{p, q};
      while (!onNet(way.back())) {
        LatticePoint next = way.back();
        for (int a = 0; a < 3; ++a) next[a] += q[a] - p[a];
        way.push_back(next);
      }
      if (best.empty() || way.size() < best.size()) best = way;
    }
    for (std::size_t i = 0; i + 1 < best.size() && !isCut; ++i) {
      net_.insert({best[i], best[i + 1]});
      net_.insert({best[i + 1], best[i]});
    }
  }
}

/// Where three or more edges of the net meet.
void MeccanoSurface::addNodes() {
  std::map<LatticePoint, std::array<int, 2>> degree;  // of the net; without cuts
  for (const auto& [p, q] : net_) {
    ++degree[p][0];
    degree[p][1] += squares[squareLeftOf(p, q)].region != squares[squareLeftOf(q, p)].region;
  }
  for (const auto& [p, d] : degree)
    if (d[0] > 2) nodes.push_back(p);
  std::sort(nodes.begin(), nodes.end(), precedes);
  for (const LatticePoint& p : nodes) isCorner.push_back(degree[p][1] > 2);
}

void MeccanoSurface::addChains() {
  std::map<LatticePoint, int> nodeAt;
  for (int n = 0; n < static_cast<int>(nodes.size()); ++n) nodeAt[nodes[n]] = n;
  for (int axis = 0; axis < 3; ++axis) {
    const std::size_t first = chains.size();
    for (const auto& [p, n] : nodeAt) {
      LatticePoint q = moved(p, axis, 1);
      if (net_.count({p, q}) == 0) continue;
      const bool cut = squares[squareLeftOf(p, q)].region == squares[squareLeftOf(q, p)].region;
      while (nodeAt.count(q) == 0) ++q[axis];
      chains.push_back({{p, q}, {n, nodeAt[q]}, cut});
    }
    std::sort(chains.begin() + first, chains.end(), [axis](const Chain& a, const Chain& b) {
      const int v = (axis + 2) % 3, u = (axis + 1) % 3;
      return std::tie(a.end[0][v], a.end[0][u], a.end[0][axis]) <
             std::tie(b.end[0][v], b.end[0][u], b.end[0][axis]);
    });
  }
  around.resize(nodes.size());
  for (int n = 0; n < static_cast<int>(nodes.size()); ++n)
    for (const LatticePoint& q : spokes(nodes[n]))
      for (int h = 0; h < static_cast<int>(2 * chains.size()); ++h)
        if (start(h) == nodes[n] && second(h) == q) around[n].push_back(h);
}

/// Around each rectangle: after half-chain h comes the one before its reverse, seen around the
/// node.
void MeccanoSurface::addRims() {
  std::vector<char> seen(2 * chains.size(), 0);
  for (int first = 0; first < static_cast<int>(seen.size()); ++first) {
    std::vector<int> rim;
    for (int h = first; !seen[h];) {
      seen[h] = 1;
      rim.push_back(h);
      const std::vector<int>& spokesThere = around[startNode(h ^ 1)];
      const auto back = std::find(spokesThere.begin(), spokesThere.end(), h ^ 1);
      h = back == spokesThere.begin() ? spokesThere.back() : *(back - 1);
    }
    if (!rim.empty()) rectangles[rectangleLeftOf(first)].rim = rim;
  }
}

MeccanoSurface::MeccanoSurface(const Meccano& C) {
  addSquares(C);
  checkManifold();
  join(true);
  cutRegions();
  addNodes();
  addChains();
  join(false);
  addRims();
}

}  // namespace

// ==== Tools for 2: Floater's equations solved by elimination ==================================

namespace {

/// Elimination order of the points not fixed: halves along the longest side of their box, then the
/// points of the lower half that have a neighbour in the upper one (nested dissection, George
/// 1973).
void appendDissection(const std::vector<Vec3>& points, const SparseMatrix& lambda,
                      std::vector<int> part, std::vector<char>& upper, std::vector<int>& order) {
  constexpr std::size_t leaf = 8;  // [choice] points that are not divided further
  if (part.size() <= leaf) {
    order.insert(order.end(), part.begin(), part.end());
    return;
  }
  TriangleTree::Box box{points[part[0]], points[part[0]]};
  for (int n : part) growBox(box, points[n]);
  const Vec3 l = box.hi - box.lo;
  const int axis = l.x >= l.y && l.x >= l.z ? 0 : l.y >= l.z ? 1 : 2;
  const auto middle = part.begin() + part.size() / 2;
  std::nth_element(part.begin(), middle, part.end(), [&](int a, int b) {
    const double ca = component(points[a], axis), cb = component(points[b], axis);
    return ca != cb ? ca < cb : a < b;
  });
  std::vector<int> low, high(middle, part.end()), separator;
  for (int n : high) upper[n] = 1;
  for (auto n = part.begin(); n != middle; ++n) {
    bool touches = false;
    for (int k = lambda.start[*n]; k < lambda.start[*n + 1]; ++k)
      touches |= upper[lambda.column[k]] != 0;
    (touches ? separator : low).push_back(*n);
  }
  for (int n : high) upper[n] = 0;
  appendDissection(points, lambda, low, upper, order);
  appendDissection(points, lambda, high, upper, order);
  order.insert(order.end(), separator.begin(), separator.end());
}

/// The weights left in each row when the earlier ones are eliminated, in elimination order.
struct Elimination {
  std::vector<int> point, row;          // point of each row; row of each point, -1 where fixed
  std::vector<std::vector<int>> later;  // columns after the diagonal, ascending
  std::vector<std::vector<double>> weight;
  std::vector<double> rim;  // weight that leads to fixed points
  std::vector<Vec2> pull;   // Σ weight u of these
};

/// Where the eliminated rows have entries: those of the row itself, and of the rows whose first
/// entry it is.
Elimination eliminationPattern(const std::vector<Vec3>& points, const SparseMatrix& lambda,
                               const std::vector<char>& fixed) {
  Elimination L;
  std::vector<int> inner;
  for (int n = 0; n < static_cast<int>(points.size()); ++n)
    if (!fixed[n]) inner.push_back(n);
  std::vector<char> upper(points.size(), 0);
  appendDissection(points, lambda, inner, upper, L.point);
  L.row.assign(points.size(), -1);
  const int rows = static_cast<int>(L.point.size());
  for (int i = 0; i < rows; ++i) L.row[L.point[i]] = i;
  L.later.resize(rows);
  std::vector<int> seen(rows, -1);
  std::vector<std::vector<int>> children(rows);
  for (int i = 0; i < rows; ++i) {
    std::vector<int>& columns = L.later[i];
    auto add = [&](int j) {
      if (j <= i || seen[j] == i) return;
      seen[j] = i;
      columns.push_back(j);
    };
    for (int k = lambda.start[L.point[i]]; k < lambda.start[L.point[i] + 1]; ++k)
      add(L.row[lambda.column[k]]);
    for (int child : children[i])
      for (int j : L.later[child]) add(j);
    std::sort(columns.begin(), columns.end());
    if (!columns.empty()) children[columns[0]].push_back(i);
  }
  return L;
}

/// u_i = Σ λ_ij u_j at the points not fixed. Rows are eliminated without any subtraction
/// (Grassmann, Taksar, Heyman 1985): the diagonal is the sum of what is left in the row, so that
/// every weight is exact to rounding, however far a point is from the rim.
void solveConvexCombinations(const std::vector<Vec3>& points, const SparseMatrix& lambda,
                             const std::vector<char>& fixed, std::vector<Vec2>& u) {
  Elimination L = eliminationPattern(points, lambda, fixed);
  const int rows = static_cast<int>(L.point.size());
  L.weight.resize(rows);
  L.rim.assign(rows, 0);
  L.pull.assign(rows, {});
  std::vector<std::vector<int>> earlier(rows);  // rows k with an entry in column i, ascending
  for (int k = 0; k < rows; ++k)
    for (int j : L.later[k]) earlier[j].push_back(k);
  std::vector<double> diagonal(rows), w(rows, 0.0);
  for (int i = 0; i < rows; ++i) {
    for (int k = lambda.start[L.point[i]]; k < lambda.start[L.point[i] + 1]; ++k) {
      const int n = lambda.column[k];
      if (!fixed[n]) {
        w[L.row[n]] += lambda.value[k];
        continue;
      }
      L.rim[i] += lambda.value[k];
      L.pull[i] = L.pull[i] + lambda.value[k] * u[n];
    }
    for (int k : earlier[i]) {  // row i takes row k's weights in the place of its own on k
      const double part = std::exchange(w[k], 0.0) / diagonal[k];
      const std::vector<int>& columns = L.later[k];
      for (std::size_t c = 0; c < columns.size(); ++c) w[columns[c]] += part * L.weight[k][c];
      L.rim[i] += part * L.rim[k];
      L.pull[i] = L.pull[i] + part * L.pull[k];
    }
    w[i] = 0;  // the way back to i itself only scales the row
    diagonal[i] = L.rim[i];
    for (int j : L.later[i]) {
      diagonal[i] += w[j];
      L.weight[i].push_back(std::exchange(w[j], 0.0));
    }
  }
  for (int i = rows - 1; i >= 0; --i) {
    Vec2 sum = L.pull[i];
    for (std::size_t c = 0; c < L.later[i].size(); ++c)
      sum = sum + L.weight[i][c] * u[L.point[L.later[i][c]]];
    u[L.point[i]] = (1 / diagonal[i]) * sum;
  }
}

}  // namespace

// ==== 2. Algorithm 1: Π on the boundary =======================================================

namespace {

/// The solid's boundary while it is cut along the chains of the meccano: split edges only, so its
/// geometry stays.
struct CutSolid {
  std::vector<Vec3> points;
  std::vector<std::array<int, 3>> triangles;
  std::vector<std::array<int, 3>> neighbours;  // across edge i, from vertex i to i + 1
  std::vector<std::array<int, 3>> halfChain;   // 1 + half-chain along edge i, 0 none
  std::vector<int> triangleOf;                 // [points], a triangle at it
  std::vector<char> onPath;                    // [points], on a chain or at a node
  std::vector<int> node;                       // [nodes], point of each
  std::vector<std::vector<int>> path;  // [chains], points from end 0 to end 1; empty: none yet

  explicit CutSolid(const TriangleSurface& D)
      : points(D.points),
        triangles(D.triangles),
        neighbours(triangleNeighbours(D)),
        halfChain(D.triangles.size(), {0, 0, 0}),
        triangleOf(D.points.size(), -1),
        onPath(D.points.size(), 0) {
    for (int t = 0; t < static_cast<int>(triangles.size()); ++t)
      for (int n : triangles[t]) triangleOf[n] = t;
  }
  /// Calls visit(t, i) for the triangles around point n counter-clockwise: n is vertex i of t.
  template <class Visit>
  void aroundPoint(int n, Visit visit) const {
    int t = triangleOf[n];
    do {
      const int i = cornerAt(triangles[t], n);
      visit(t, i);
      t = neighbours[t][(i + 2) % 3];
    } while (t != triangleOf[n]);
  }
  int splitEdge(int t, int i, double part);
  void separatePaths();
  void markPath(int c, bool on);
  void clearPath(int c);
};

/// A new point at this part of edge i of triangle t, counted from vertex i.
int CutSolid::splitEdge(int t, int i, double part) {
  const int s = neighbours[t][i], a = triangles[t][i], b = triangles[t][(i + 1) % 3];
  const int j = cornerAt(triangles[s], b);  // s is (b, a, d) from vertex j
  const int c = triangles[t][(i + 2) % 3], d = triangles[s][(j + 2) % 3];
  const int m = static_cast<int>(points.size()), t1 = static_cast<int>(triangles.size());
  const int s1 = t1 + 1;
  auto rotated = [](std::array<int, 3> v, int by) {
    std::rotate(v.begin(), v.begin() + by, v.end());
    return v;
  };
  const std::array<int, 3> nt = rotated(neighbours[t], i), ns = rotated(neighbours[s], j);
  const std::array<int, 3> ht = rotated(halfChain[t], i), hs = rotated(halfChain[s], j);
  points.push_back(points[a] + part * (points[b] - points[a]));
  triangles[t] = {a, m, c}, neighbours[t] = {s1, t1, nt[2]}, halfChain[t] = {ht[0], 0, ht[2]};
  triangles[s] = {b, m, d}, neighbours[s] = {t1, s1, ns[2]}, halfChain[s] = {hs[0], 0, hs[2]};
  triangles.push_back({m, b, c}), neighbours.push_back({s, nt[1], t});
  halfChain.push_back({ht[0], ht[1], 0});
  triangles.push_back({m, a, d}), neighbours.push_back({t, ns[1], s});
  halfChain.push_back({hs[0], hs[1], 0});
  auto redirect = [&](int from, int to, int x) {  // the triangle beyond the edge from x
    if (from != t && from != s) neighbours[from][(cornerAt(triangles[from], x) + 2) % 3] = to;
  };
  redirect(nt[1], t1, b);
  redirect(ns[1], s1, a);
  triangleOf.push_back(t);
  onPath.push_back(0);
  triangleOf[a] = t;
  triangleOf[b] = s;
  triangleOf[c] = t;
  triangleOf[d] = s;
  return m;
}

/// Splits each edge of no path that joins two points of paths: afterwards a path finds its way
/// between others, and no triangle of a patch is flat in 𝓤.
void CutSolid::separatePaths() {
  for (int t = 0; t < static_cast<int>(triangles.size()); ++t)
    for (int i = 0; i < 3; ++i) {
      const int a = triangles[t][i], b = triangles[t][(i + 1) % 3];
      if (onPath[a] && onPath[b] && halfChain[t][i] == 0) splitEdge(t, i, .5);
    }
}

/// Marks the edges of path c, from both sides, or wipes the marks.
void CutSolid::markPath(int c, bool on) {
  for (std::size_t k = 0; k + 1 < path[c].size(); ++k) {
    const int a = path[c][k], b = path[c][k + 1];
    aroundPoint(a, [&](int t, int i) {
      if (triangles[t][(i + 1) % 3] == b) halfChain[t][i] = on ? 2 * c + 1 : 0;
      if (triangles[t][(i + 2) % 3] == b) halfChain[t][(i + 2) % 3] = on ? 2 * c + 2 : 0;
    });
    if (k > 0) onPath[a] = on;
  }
}

void CutSolid::clearPath(int c) {
  markPath(c, false);
  path[c].clear();
}

/// The points next to the start of half-chain h where its path may leave: between the traced paths
/// before and after it in the order around the node.
std::vector<int> allowedSector(const MeccanoSurface& B, const CutSolid& D, int h) {
  const std::vector<int>& spokes = B.around[B.startNode(h)];
  const int count = static_cast<int>(spokes.size());
  const int at = static_cast<int>(std::find(spokes.begin(), spokes.end(), h) - spokes.begin());
  auto tracedFrom = [&](int step) {  // half-chain + 1
    for (int k = 1; k < count; ++k) {
      const int other = spokes[(at + k * step + count * count) % count];
      if (!D.path[other / 2].empty()) return other + 1;
    }
    return 0;
  };
  const int before = tracedFrom(-1), after = tracedFrom(1);
  std::vector<int> ring, leaves;  // points around, and the half-chain + 1 that leaves towards each
  D.aroundPoint(D.node[B.startNode(h)], [&](int t, int i) {
    ring.push_back(D.triangles[t][(i + 1) % 3]);
    leaves.push_back(D.halfChain[t][i]);
  });
  if (before == 0) return ring;
  std::vector<int> allowed;
  const int size = static_cast<int>(ring.size());
  const int first =
      static_cast<int>(std::find(leaves.begin(), leaves.end(), before) - leaves.begin());
  for (int k = 1; k < size && leaves[(first + k) % size] != after; ++k)
    allowed.push_back(ring[(first + k) % size]);
  return allowed;
}

/// Dijkstra: the shortest way along edges from A to Z through points that are on no path and, where
/// given, usable; it starts at one of `first`, ends after one of `last`. Empty: there is none.
std::vector<int> shortestPath(const CutSolid& D, int A, int Z, const std::vector<int>& first,
                              const std::vector<int>& last, const std::vector<char>& usable) {
  std::vector<double> distance(D.points.size(), 1e300);
  std::vector<int> from(D.points.size(), -1);
  std::vector<char> isLast(D.points.size(), 0);
  for (int n : last) isLast[n] = 1;
  using Entry = std::pair<double, int>;
  std::priority_queue<Entry, std::vector<Entry>, std::greater<Entry>> queue;
  auto reach = [&](int a, int n, double d) {
    if (d >= distance[n] || (n != Z && (D.onPath[n] || (!usable.empty() && !usable[n])))) return;
    distance[n] = d;
    from[n] = a;
    queue.push({d, n});
  };
  for (int n : first)
    if (n != Z) reach(A, n, norm(D.points[n] - D.points[A]));
  while (!queue.empty() && queue.top().second != Z) {
    const double d = queue.top().first;
    const int n = queue.top().second;
    queue.pop();
    if (d > distance[n]) continue;
    D.aroundPoint(n, [&](int t, int i) {
      const int next = D.triangles[t][(i + 1) % 3];
      if (next != Z || isLast[n]) reach(n, next, d + norm(D.points[next] - D.points[n]));
    });
  }
  if (from[Z] < 0) return {};
  std::vector<int> path{Z};
  while (path.back() != A) path.push_back(from[path.back()]);
  std::reverse(path.begin(), path.end());
  return path;
}

/// The shortest path for chain c in the order around its nodes. False: there is none.
bool tracePath(const MeccanoSurface& B, CutSolid& D, int c, const std::vector<char>& usable = {}) {
  const int A = D.node[B.chains[c].node[0]], Z = D.node[B.chains[c].node[1]];
  D.path[c] =
      shortestPath(D, A, Z, allowedSector(B, D, 2 * c), allowedSector(B, D, 2 * c + 1), usable);
  D.markPath(c, true);
  return !D.path[c].empty();
}

/// Traces these chains, none of which has a path; one that is blocked goes first and all start
/// again.
void tracePaths(const MeccanoSurface& B, CutSolid& D, std::vector<int> order) {
  const std::size_t maxStarts = 4 * order.size() + 4;  // each chain a few times first
  for (std::size_t start = 0; start < maxStarts; ++start) {
    std::size_t k = 0;
    for (; k < order.size(); ++k) {
      D.separatePaths();
      if (!tracePath(B, D, order[k])) break;
    }
    if (k == order.size()) return;
    for (std::size_t j = 0; j < k; ++j) D.clearPath(order[j]);
    std::rotate(order.begin(), order.begin() + k, order.begin() + k + 1);
  }
  const Chain& c = B.chains[order[0]];
  throw MethodError("getBoundaryMapping (§2): no path on the solid from the corner at " +
                    placeText(D.points[D.node[c.node[0]]]) + " to the one at " +
                    placeText(D.points[D.node[c.node[1]]]) + ", meccano edge " +
                    latticeText(c.end[0]) + " to " + latticeText(c.end[1]) +
                    ", that does not cross the others; place the corners in the order of the "
                    "polycube's, or add cubes");
}

/// A disk cut out of the solid along chains.
struct Disk {
  std::vector<Vec3> points;                   // [points]
  std::vector<std::array<int, 3>> triangles;  // of these
  std::vector<int> vertex, triangle;          // their numbers in the CutSolid
  struct RimPoint {
    int point, half;  // half-chain along which the rim leaves it
    double part;      // of the half-chain, by arc length
  };
  std::vector<RimPoint> rim;  // counter-clockwise, from the start of a half-chain
  std::vector<char> isRim;
  std::vector<Vec2> u;
};

/// Cuts open at the chains: numbers of the disk's points, one for each fan of triangles around a
/// point between chains.
void openAtChains(const CutSolid& D, const std::vector<int>& localOf, Disk& P) {
  P.triangles.assign(P.triangle.size(), {-1, -1, -1});
  for (std::size_t l = 0; l < P.triangle.size(); ++l)
    for (int i = 0; i < 3; ++i) {
      if (P.triangles[l][i] >= 0) continue;
      const int n = D.triangles[P.triangle[l]][i], number = static_cast<int>(P.vertex.size());
      P.vertex.push_back(n);
      P.points.push_back(D.points[n]);
      for (int direction :
           {2, 0}) {  // counter-clockwise across edge i + 2, clockwise across edge i
        for (int t = P.triangle[l];;) {
          const int k = cornerAt(D.triangles[t], n), e = (k + direction) % 3;
          P.triangles[localOf[t]][k] = number;
          if (D.halfChain[t][e] != 0) break;
          t = D.neighbours[t][e];
          if (t == P.triangle[l]) break;
        }
      }
    }
}

/// The rim as one loop, with its parts by arc length.
void walkRim(const CutSolid& D, Disk& P) {
  std::vector<int> next(P.points.size(), -1), half(P.points.size(), 0);
  std::size_t edges = 0;
  for (std::size_t l = 0; l < P.triangle.size(); ++l)
    for (int i = 0; i < 3; ++i)
      if (const int h = D.halfChain[P.triangle[l]][i]; h != 0) {
        next[P.triangles[l][i]] = P.triangles[l][(i + 1) % 3];
        half[P.triangles[l][i]] = h - 1;
        ++edges;
      }
  P.isRim.assign(P.points.size(), 0);
  int first = -1;  // a node: the half-chain changes there
  for (int n = 0; n < static_cast<int>(next.size()) && first < 0; ++n)
    if (next[n] >= 0 && half[n] != half[next[n]]) first = next[n];
  for (int n = first; n >= 0 && P.rim.size() <= edges && !P.isRim[n]; n = next[n]) {
    P.isRim[n] = 1;
    const bool starts = P.rim.empty() || P.rim.back().half != half[n];
    const double before = starts ? 0 : P.rim.back().part;
    const double step = starts ? 0 : norm(P.points[n] - P.points[P.rim.back().point]);
    P.rim.push_back({n, half[n], before + step});
  }
  const int euler = static_cast<int>(P.points.size()) -
                    static_cast<int>(3 * P.triangles.size() + edges) / 2 +
                    static_cast<int>(P.triangles.size());
  if (first < 0 || P.rim.size() != edges || euler != 1)
    throw MethodError("getBoundaryMapping (§2): a patch of the solid at " + placeText(P.points[0]) +
                      " is no disk; place the corners in the order of the polycube's, or add "
                      "cubes");
  for (std::size_t k = P.rim.size(); k-- > 0;) {  // lengths to parts
    const std::size_t after = (k + 1) % P.rim.size();
    std::size_t from = k;
    if (P.rim[after].half == P.rim[k].half) continue;
    while (from > 0 && P.rim[from - 1].half == P.rim[k].half) --from;
    const double length =
        P.rim[k].part + norm(P.points[P.rim[after].point] - P.points[P.rim[k].point]);
    for (std::size_t j = from; j <= k; ++j) P.rim[j].part /= length;
  }
}

/// The disk of triangles around triangle t up to chains.
Disk diskAt(const CutSolid& D, int t) {
  Disk P;
  std::vector<int> localOf(D.triangles.size(), -1);
  P.triangle.push_back(t);
  localOf[t] = 0;
  for (std::size_t q = 0; q < P.triangle.size(); ++q)
    for (int i = 0; i < 3; ++i) {
      const int s = D.neighbours[P.triangle[q]][i];
      if (D.halfChain[P.triangle[q]][i] != 0 || localOf[s] >= 0) continue;
      localOf[s] = static_cast<int>(P.triangle.size());
      P.triangle.push_back(s);
    }
  openAtChains(D, localOf, P);
  walkRim(D, P);
  return P;
}

/// The points next to point n.
std::vector<int> pointsAround(const CutSolid& D, int n) {
  std::vector<int> around;
  D.aroundPoint(n, [&](int t, int i) { around.push_back(D.triangles[t][(i + 1) % 3]); });
  return around;
}

/// Arc length at each point of a path.
std::vector<double> arcLengths(const CutSolid& D, const std::vector<int>& path) {
  std::vector<double> s{0};
  for (std::size_t k = 1; k < path.size(); ++k)
    s.push_back(s.back() + norm(D.points[path[k]] - D.points[path[k - 1]]));
  return s;
}

/// A triangle to the left of the path of half-chain h.
int triangleLeftOf(const CutSolid& D, int h) {
  const std::vector<int>& path = D.path[h / 2];
  int found = -1;
  D.aroundPoint(path[0], [&](int t, int i) {
    if (D.triangles[t][(i + 1) % 3] == path[1] && h % 2 == 0) found = t;
    if (D.triangles[t][(i + 2) % 3] == path[1] && h % 2 == 1) found = t;
  });
  return found;
}

/// [§2, after 18] Floater's map of a disk, its rim where rimU(half-chain, part) says.
template <class RimU>
void flatten(Disk& P, RimU rimU) {
  P.u.assign(P.points.size(), {});
  for (const Disk::RimPoint& r : P.rim) P.u[r.point] = rimU(r.half, r.part);
  const SparseMatrix lambda = meanValueWeights(P.points, P.triangles, P.isRim);
  solveConvexCombinations(P.points, lambda, P.isRim, P.u);
}

/// Where the half-chains of a rim go on a polygon: the perimeter coordinate at the start and at the
/// end of each, whole numbers at the polygon's corners.
struct PolygonRim {
  std::map<int, std::array<double, 2>> at;  // of half-chains
  std::vector<Vec2> corners;
  Vec2 operator()(int half, double part) const {
    const std::array<double, 2>& ends = at.find(half)->second;
    const double tau = ends[0] + part * (ends[1] - ends[0]);
    const int n = static_cast<int>(corners.size());
    const int i = std::min(static_cast<int>(tau), n - 1);
    return corners[i] + (tau - i) * (corners[(i + 1) % n] - corners[i]);
  }
  /// Puts a run of half-chains from corner `first` on along polygon sides: run[breaks[k]] starts at
  /// corner first + k + 1. On a side by lattice length.
  void put(const MeccanoSurface& B, const std::vector<int>& run, const std::vector<int>& breaks,
           int first) {
    std::vector<int> ends{0};
    ends.insert(ends.end(), breaks.begin(), breaks.end());
    ends.push_back(static_cast<int>(run.size()));
    for (std::size_t side = 0; side + 1 < ends.size(); ++side) {
      double total = 0, before = 0;
      for (int k = ends[side]; k < ends[side + 1]; ++k) total += B.chains[run[k] / 2].length();
      for (int k = ends[side]; k < ends[side + 1]; ++k) {
        const double corner = first + static_cast<int>(side), start = corner + before / total;
        before += B.chains[run[k] / 2].length();
        at[run[k]] = {start, corner + before / total};
      }
    }
  }
};

/// The half-chains of a rectangle's rim after `leave`, up to `stop`.
std::vector<int> rimBetween(const LatticeRectangle& R, int leave, int stop) {
  std::vector<int> run = R.rim;
  std::rotate(run.begin(), std::find(run.begin(), run.end(), leave) + 1, run.end());
  run.erase(std::find(run.begin(), run.end(), stop), run.end());
  return run;
}

/// [choice] Moves a node to the middle of the patches around it: their fan is mapped onto a regular
/// polygon, two sides for each patch, and the spokes are traced again from its centre.
void relaxNode(const MeccanoSurface& B, CutSolid& D, int node) {
  constexpr double pi = 3.14159265358979323846;
  const std::vector<int>& spokes = B.around[node];
  const int count = static_cast<int>(spokes.size());
  PolygonRim rim;
  for (int k = 0; k < count; ++k) {
    const int out = spokes[k], back = spokes[(k + 1) % count] ^ 1;
    const std::vector<int> run = rimBetween(B.rectangles[B.rectangleLeftOf(out)], out, back);
    int total = 0, before = 0, at = 1, best = 1 << 30;
    for (int h : run) total += B.chains[h / 2].length();
    for (int i = 1; i < static_cast<int>(run.size()); ++i) {
      before += B.chains[run[i - 1] / 2].length();
      if (std::abs(2 * before - total) < best) best = std::abs(2 * before - total), at = i;
    }
    if (run.size() < 2) return;
    rim.put(B, run, {at}, 2 * k);
  }
  // Where three patches meet, each is a parallelogram with the meccano's lengths.
  for (int k = 0; k < count; ++k) {
    auto spoke = [&](int i) {
      const double length = count == 3 ? B.chains[spokes[i % count] / 2].length() : 1;
      return length * Vec2{std::cos(2 * pi * i / count), std::sin(2 * pi * i / count)};
    };
    const Vec2 between{std::cos(pi * (2 * k + 1) / count), std::sin(pi * (2 * k + 1) / count)};
    rim.corners.push_back(spoke(k));
    rim.corners.push_back(count == 3 ? spoke(k) + spoke(k + 1) : between);
  }

  D.separatePaths();
  const int seed = triangleLeftOf(D, spokes[0]);
  for (int h : spokes) D.clearPath(h / 2);
  D.onPath[D.node[node]] = 0;
  Disk P = diskAt(D, seed);
  flatten(P, rim);
  int best = -1;
  for (int n = 0; n < static_cast<int>(P.u.size()); ++n)
    if (!P.isRim[n] && (best < 0 || norm(P.u[n]) < norm(P.u[best]))) best = n;
  D.node[node] = P.vertex[best];
  D.onPath[D.node[node]] = 1;
  std::vector<int> chains;
  for (int h : spokes) chains.push_back(h / 2);
  tracePaths(B, D, chains);
}

/// Cuts a flattened disk along the line u.x = 0: near points are taken for it, other edges that
/// cross it are split.
///   returns the points on the line, 1 for each; points of D that are not: 0
std::vector<char> splitAlongMiddle(CutSolid& D, const Disk& P) {
  constexpr double snap = .1;      // [choice] part of an edge within which its end is taken
  constexpr double onLine = 1e-9;  // of a cube's edge: rounding
  std::vector<double> x;
  for (const Vec2& u : P.u) x.push_back(std::abs(u.x) < onLine ? 0 : u.x);
  auto crossing = [&](int a, int b) { return x[a] * x[b] < 0 ? x[a] / (x[a] - x[b]) : -1; };
  for (const std::array<int, 3>& t : P.triangles)
    for (int i = 0; i < 3; ++i) {
      const int a = t[i], b = t[(i + 1) % 3];
      const double part = crossing(a, b);
      if (part >= 0 && part < snap && !P.isRim[a]) x[a] = 0;
      if (part > 1 - snap && !P.isRim[b]) x[b] = 0;
    }
  std::vector<char> onMiddle(D.points.size(), 0);
  for (std::size_t n = 0; n < x.size(); ++n)
    if (x[n] == 0) onMiddle[P.vertex[n]] = 1;
  for (std::size_t l = 0; l < P.triangles.size(); ++l)
    for (int i = 0; i < 3; ++i) {
      const int a = P.triangles[l][i], b = P.triangles[l][(i + 1) % 3];
      const double part = crossing(a, b);
      if (part < 0 || P.vertex[a] > P.vertex[b]) continue;  // each inner edge once
      int t0 = -1, i0 = -1;
      D.aroundPoint(P.vertex[a], [&](int t, int j) {
        if (D.triangles[t][(j + 1) % 3] == P.vertex[b] && D.halfChain[t][j] == 0) t0 = t, i0 = j;
      });
      if (t0 < 0) continue;  // along the rim
      D.splitEdge(t0, i0, std::clamp(part, snap, 1 - snap));
      onMiddle.push_back(1);
    }
  return onMiddle;
}

/// [choice] Draws a chain straight: the two patches beside it are mapped onto a 2 x 1 rectangle and
/// cut again along its middle line through the triangles.
void straightenChain(const MeccanoSurface& B, CutSolid& D, int c) {
  PolygonRim rim;
  const double length = B.chains[c].length();
  for (int side = 0; side < 2; ++side) {  // the patch on the left of the chain, that on the right
    const int h = 2 * c + side;
    const std::vector<int> run = rimBetween(B.rectangles[B.rectangleLeftOf(h)], h, h);
    auto step = [&](int half) {
      Vec3 d = latticeVector(B.start(half ^ 1)) - latticeVector(B.start(half));
      return (1 / norm(d)) * d;
    };
    std::vector<int> opposite;
    for (int k = 0; k < static_cast<int>(run.size()); ++k)
      if (dot(step(run[k]), step(h)) < -.5) opposite.push_back(k);
    rim.put(B, run, {opposite.front(), opposite.back() + 1}, 3 * side);
    double width = 0;
    for (int k = 0; k < opposite.front(); ++k)
      if (std::abs(dot(step(run[k]), step(h))) < .5) width += B.chains[run[k] / 2].length();
    const double x = side == 0 ? -width : width, y = side == 0 ? length : 0;
    rim.corners.insert(rim.corners.end(), {{0, y}, {x, y}, {x, length - y}});
  }
  D.separatePaths();
  const int seed = triangleLeftOf(D, 2 * c);
  D.clearPath(c);
  Disk P = diskAt(D, seed);
  flatten(P, rim);

  if (tracePath(B, D, c, splitAlongMiddle(D, P))) return;
  tracePaths(B, D, {c});
}

/// Directions that the meccano's axes take in space, with the solid's extents along them.
struct Frame {
  std::array<Vec3, 3> axis;
  TriangleTree::Box box;
  Vec3 coordinates(Vec3 x) const { return {dot(axis[0], x), dot(axis[1], x), dot(axis[2], x)}; }
  Vec3 size() const { return box.hi - box.lo; }
};

Frame frameAlong(const std::array<Vec3, 3>& axis, const TriangleSurface& D) {
  Frame F{axis, {}};
  F.box.lo = F.box.hi = F.coordinates(D.points[0]);
  for (const Vec3& p : D.points) growBox(F.box, F.coordinates(p));
  return F;
}

Frame coordinateFrame(const TriangleSurface& D) {
  return frameAlong({{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}, D);
}

/// Eigenvectors of a symmetric matrix by cyclic Jacobi rotations, as columns.
std::array<Vec3, 3> eigenvectors(std::array<std::array<double, 3>, 3> A) {
  constexpr int sweeps = 30;  // quadratic convergence: 6 reach rounding
  std::array<std::array<double, 3>, 3> V{{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
  for (int sweep = 0; sweep < sweeps; ++sweep)
    for (int p = 0; p < 2; ++p)
      for (int q = p + 1; q < 3; ++q) {
        if (A[p][q] == 0) continue;
        const double theta = (A[q][q] - A[p][p]) / (2 * A[p][q]);
        const double t = (theta < 0 ? -1 : 1) / (std::abs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (int k = 0; k < 3; ++k) {
          const double kp = A[k][p], kq = A[k][q];
          A[k][p] = c * kp - s * kq, A[k][q] = s * kp + c * kq;
        }
        for (int k = 0; k < 3; ++k) {
          const double pk = A[p][k], qk = A[q][k];
          A[p][k] = c * pk - s * qk, A[q][k] = s * pk + c * qk;
          const double vp = V[k][p], vq = V[k][q];
          V[k][p] = c * vp - s * vq, V[k][q] = s * vp + c * vq;
        }
      }
  std::array<Vec3, 3> columns;
  for (int i = 0; i < 3; ++i) columns[i] = {V[0][i], V[1][i], V[2][i]};
  return columns;
}

/// Principal axes of the surface's area, each near the coordinate axis of its number.
Frame principalFrame(const TriangleSurface& D) {
  double area = 0;
  Vec3 centre;
  for (const std::array<int, 3>& t : D.triangles) {
    const Vec3 a = D.points[t[0]], b = D.points[t[1]], c = D.points[t[2]];
    const double A = norm(cross(b - a, c - a));
    area += A;
    centre += (A / 3) * (a + b + c);
  }
  centre = (1 / area) * centre;
  std::array<std::array<double, 3>, 3> moments{};
  for (const std::array<int, 3>& t : D.triangles) {
    const Vec3 a = D.points[t[0]], b = D.points[t[1]], c = D.points[t[2]];
    const double A = norm(cross(b - a, c - a)) / area;
    for (const Vec3& p : {.5 * (a + b), .5 * (b + c), .5 * (c + a)})  // exact for squares
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          moments[i][j] += A / 3 * component(p - centre, i) * component(p - centre, j);
  }
  const std::array<Vec3, 3> e = eigenvectors(moments);
  std::array<int, 3> order{0, 1, 2}, best = order;
  double fit = -1;
  do {
    double sum = 0;
    for (int a = 0; a < 3; ++a) sum += std::abs(component(e[order[a]], a));
    if (sum > fit + 1e-9) fit = sum, best = order;  // rounding decides nothing
  } while (std::next_permutation(order.begin(), order.end()));
  std::array<Vec3, 3> axis;
  for (int a = 0; a < 3; ++a) axis[a] = component(e[best[a]], a) < 0 ? -e[best[a]] : e[best[a]];
  if (dot(cross(axis[0], axis[1]), axis[2]) < 0) axis[2] = -axis[2];
  return frameAlong(axis, D);
}

double volumeOf(Vec3 size) { return size.x * size.y * size.z; }

/// [choice] The coordinate axes, unless the box along the principal ones is clearly smaller.
Frame preferredFrame(const TriangleSurface& D) {
  constexpr double clearly = .8;  // of the volume
  const Frame F = coordinateFrame(D), G = principalFrame(D);
  return volumeOf(G.size()) < clearly * volumeOf(F.size()) ? G : F;
}

}  // namespace

Meccano getMeccano(const TriangleSurface& D) {
  if (const int genus = genusOf(D); genus > 0)
    throw InputError("getMeccano (§2): the solid has " + counted(genus, "handle") +
                     ", and only solids without handles get their meccano automatically; give a "
                     "polycube of the same genus with its corners (--polycube FILE)");
  constexpr double mostCubes = 12;  // along an axis: thinner solids get longer cubes
  const Vec3 size = preferredFrame(D).size();
  const double shortest = std::min({size.x, size.y, size.z});
  const double unit = std::max(shortest, std::max({size.x, size.y, size.z}) / mostCubes);
  std::array<int, 3> n;
  for (int a = 0; a < 3; ++a)
    n[a] = std::max(1, static_cast<int>(std::lround(component(size, a) / unit)));
  Meccano C;
  for (int k = 0; k < n[2]; ++k)
    for (int j = 0; j < n[1]; ++j)
      for (int i = 0; i < n[0]; ++i) C.cubes.push_back({i, j, k});
  C.cube = {size.x / n[0], size.y / n[1], size.z / n[2]};
  return C;
}

namespace {

/// How the corners of an automatic meccano find their points of the solid.
enum class Start { boxCorners, extremes };

/// The point of D not yet taken that has the lowest cost.
template <class Cost>
int cheapestPoint(const CutSolid& D, Cost cost) {
  int best = -1;
  double lowest = 1e300;
  for (int n = 0; n < static_cast<int>(D.points.size()); ++n) {
    if (D.onPath[n]) continue;
    const double c = cost(D.points[n]);
    if (c < lowest) lowest = c, best = n;
  }
  if (best < 0)
    throw MethodError(
        "getBoundaryMapping (§2): the solid has fewer points than the meccano has corners; refine "
        "its surface");
  return best;
}

void placeCorners(const MeccanoSurface& B, const Frame& F, Start start, CutSolid& D) {
  constexpr double shrink = .9;  // [choice] of the box: its corners then look at the solid
  LatticePoint lo = B.nodes[0], hi = lo;
  for (const LatticePoint& p : B.nodes)
    for (int a = 0; a < 3; ++a) lo[a] = std::min(lo[a], p[a]), hi[a] = std::max(hi[a], p[a]);
  for (std::size_t n = 0; n < B.nodes.size(); ++n) {
    if (!B.isCorner[n]) continue;
    double f[3];  // place in the box, from -1 to 1
    for (int a = 0; a < 3; ++a) f[a] = 2. * (B.nodes[n][a] - lo[a]) / (hi[a] - lo[a]) - 1;
    const Vec3 size = F.size(), middle = .5 * (F.box.lo + F.box.hi);
    const Vec3 target = middle + .5 * shrink * Vec3{f[0] * size.x, f[1] * size.y, f[2] * size.z};
    D.node[n] = cheapestPoint(D, [&](Vec3 x) {
      const Vec3 c = F.coordinates(x);
      if (start == Start::boxCorners) return norm2(c - target);
      const Vec3 d = c - middle;
      return -(f[0] * d.x / size.x + f[1] * d.y / size.y + f[2] * d.z / size.z);
    });
    D.onPath[D.node[n]] = 1;
  }
}

/// The user's corners at the nearest points of the solid.
void placeCorners(const MeccanoSurface& B, const Meccano& C, CutSolid& D) {
  constexpr double farthest = .25;  // [choice] of the diagonal: farther is another place
  const Vec3 size = coordinateFrame({D.points, {}, {}}).size();
  std::map<LatticePoint, int> nodeAt;
  for (std::size_t n = 0; n < B.nodes.size(); ++n)
    if (B.isCorner[n]) nodeAt[B.nodes[n]] = static_cast<int>(n);
  std::vector<int> placedBy(D.points.size(), -1);
  for (std::size_t k = 0; k < C.corners.size(); ++k) {
    const LatticePoint at = C.corners[k].at;
    const Vec3 x = C.corners[k].x;
    const std::string what = "corner " + latticeText(at);
    if (!isFinite(x)) refuseMeccano(what + " has a place that is not finite");
    if (nodeAt.count(at) == 0)
      refuseMeccano(what +
                    " is no corner of the polycube: three or more of its edges must meet "
                    "there; remove it or correct its numbers");
    int best = 0;
    for (int n = 0; n < static_cast<int>(D.points.size()); ++n)
      if (norm2(D.points[n] - x) < norm2(D.points[best] - x)) best = n;
    if (!(norm(D.points[best] - x) <= farthest * norm(size)))
      refuseMeccano(what + " is placed at " + placeText(x) + ", " +
                    number(norm(D.points[best] - x)) + " from the solid, more than " +
                    number(farthest) + " of its diagonal; place it near the solid");
    int& node = D.node[nodeAt[at]];
    if (node >= 0) refuseMeccano(what + " is placed twice; keep one place");
    if (placedBy[best] >= 0)
      refuseMeccano(what + " and corner " + latticeText(C.corners[placedBy[best]].at) +
                    " are both placed at the solid's vertex " + placeText(D.points[best]) +
                    "; place them farther apart, or refine the solid's surface there");
    node = best;
    placedBy[best] = static_cast<int>(k);
    D.onPath[best] = 1;
  }
  for (const auto& [at, n] : nodeAt)
    if (D.node[n] < 0)
      refuseMeccano("corner " + latticeText(at) +
                    " of the polycube has no place on the solid; add a line `corner " +
                    std::to_string(at[0]) + " " + std::to_string(at[1]) + " " +
                    std::to_string(at[2]) + " x y z`");
}

/// The half-chain that goes on straight from the end of h; -1 where a corner is there.
int straightOn(const MeccanoSurface& B, int h) {
  const int node = B.startNode(h ^ 1);
  if (B.isCorner[node]) return -1;
  for (int g : B.around[node])
    if (g != (h ^ 1) && !B.chains[g / 2].cut == !B.chains[h / 2].cut) return g;
  return -1;
}

/// Ends of cuts go on the shortest way between the corners of their meccano edge, by length.
void placeCutEnds(const MeccanoSurface& B, CutSolid& D) {
  for (int h = 0; h < static_cast<int>(2 * B.chains.size()); h += 2) {
    if (B.chains[h / 2].cut || !B.isCorner[B.startNode(h)]) continue;
    std::vector<int> run{h};
    double total = B.chains[h / 2].length();
    while (straightOn(B, run.back()) >= 0) {
      run.push_back(straightOn(B, run.back()));
      total += B.chains[run.back() / 2].length();
    }
    if (run.size() < 2) continue;
    const int A = D.node[B.startNode(h)], Z = D.node[B.startNode(run.back() ^ 1)];
    const std::vector<int> path = shortestPath(D, A, Z, pointsAround(D, A), pointsAround(D, Z), {});
    const std::vector<double> s = arcLengths(D, path);
    if (path.size() < run.size() + 1)
      throw MethodError("getBoundaryMapping (§2): the solid's surface is too coarse between " +
                        placeText(D.points[A]) + " and " + placeText(D.points[Z]) +
                        "; refine it there");
    double before = 0;
    std::size_t k = 0;
    for (std::size_t r = 0; r + 1 < run.size(); ++r) {
      before += B.chains[run[r] / 2].length();
      const std::size_t mostLeft = path.size() - (run.size() - r);  // one point for each later end
      ++k;
      while (k < mostLeft && s[k] < before / total * s.back()) ++k;
      D.node[B.startNode(run[r + 1])] = path[k];
      D.onPath[path[k]] = 1;
    }
  }
}

Vec2 inRectangle(const BoundaryMapping::Rectangle& R, Vec3 p) {
  const int u = (R.axis + 1) % 3, v = (R.axis + 2) % 3;
  return {(component(p, u) - R.lo[u]) / (R.hi[u] - R.lo[u]),
          (component(p, v) - R.lo[v]) / (R.hi[v] - R.lo[v])};
}

/// u at this part of a half-chain.
Vec2 inRectangle(const BoundaryMapping::Rectangle& R, const MeccanoSurface& B, int h, double part) {
  const Vec2 a = inRectangle(R, latticeVector(B.start(h)));
  return a + part * (inRectangle(R, latticeVector(B.start(h ^ 1))) - a);
}

/// Each rectangle by Floater onto its place; those of one flat region are one patch.
void addPatches(const MeccanoSurface& B, const CutSolid& D, BoundaryMapping& Pi) {
  std::map<std::tuple<int, int>, int> sides;  // regions with the same normal
  for (const LatticeRectangle& R : B.regions) {
    const int number = ++sides[{R.axis, R.side}];
    Parametrization P;
    P.name = std::string(1, "xyz"[R.axis]) + (R.side ? "+" : "-");
    if (number > 1) P.name += std::to_string(number);
    Pi.rectangles.push_back({R.lo, R.hi, R.axis, R.side});
    Pi.patches.push_back(P);
  }
  std::vector<int> pointOf(D.points.size()), patchOf(D.points.size(), -1);
  std::vector<int> byRegion(B.rectangles.size());
  std::iota(byRegion.begin(), byRegion.end(), 0);
  std::stable_sort(byRegion.begin(), byRegion.end(),
                   [&](int a, int b) { return B.rectangles[a].region < B.rectangles[b].region; });
  for (int r : byRegion) {
    const LatticeRectangle& R = B.rectangles[r];
    Parametrization& P = Pi.patches[R.region];
    const BoundaryMapping::Rectangle& place = Pi.rectangles[R.region];
    Disk disk = diskAt(D, triangleLeftOf(D, R.rim[0]));
    flatten(disk, [&](int h, double part) { return inRectangle(place, B, h, part); });
    for (std::array<int, 3> t : disk.triangles) {
      for (int& n : t) {
        const int vertex = disk.vertex[n];
        if (std::exchange(patchOf[vertex], R.region) != R.region) {
          pointOf[vertex] = static_cast<int>(P.points.size());
          P.points.push_back(disk.points[n]);
          P.u.push_back(disk.u[n]);
        }
        n = pointOf[vertex];
      }
      if (R.side == 0) std::swap(t[1], t[2]);
      P.triangles.push_back(t);
    }
  }
  for (Parametrization& P : Pi.patches) {
    const std::vector<int> flipped = flippedTriangles(P.triangles, P.u);
    if (!flipped.empty())
      throw MethodError("getBoundaryMapping (§2): Floater's map of patch '" + P.name +
                        "' folds: " + counted(flipped.size(), "parametric triangle") +
                        ", the first at " + placeText(P.points[P.triangles[flipped[0]][0]]) +
                        "; place the corners so that no part of the solid is squashed, or remesh "
                        "its surface there");
    buildLocator(P);
  }
}

/// The meccano's edges as curves, its corners.
void addCurves(const MeccanoSurface& B, const CutSolid& D, BoundaryMapping& Pi) {
  std::map<int, int> cornerOf;  // of nodes
  for (int n = 0; n < static_cast<int>(B.nodes.size()); ++n) {
    if (!B.isCorner[n]) continue;
    cornerOf[n] = static_cast<int>(Pi.corners.size());
    Pi.corners.push_back({D.points[D.node[n]], {}});
    Pi.cornersAt.push_back(B.nodes[n]);
  }
  for (int h = 0; h < static_cast<int>(2 * B.chains.size()); h += 2) {
    if (B.chains[h / 2].cut || !B.isCorner[B.startNode(h)]) continue;
    Curve C;
    int regions[2] = {B.rectangles[B.rectangleLeftOf(h)].region,
                      B.rectangles[B.rectangleLeftOf(h ^ 1)].region};
    int axis = 0;
    while (B.start(h)[axis] == B.start(h ^ 1)[axis]) ++axis;
    if (B.regions[regions[0]].axis != (axis + 1) % 3) std::swap(regions[0], regions[1]);
    for (int r : regions) C.sides.push_back({-(r + 1), {}});
    auto add = [&](int point, int g, double part) {
      const double step = C.points.empty() ? 0 : norm(D.points[point] - C.points.back());
      C.s.push_back(C.s.empty() ? 0 : C.s.back() + step);
      C.points.push_back(D.points[point]);
      for (int i = 0; i < 2; ++i)
        C.sides[i].u.push_back(inRectangle(Pi.rectangles[regions[i]], B, g, part));
    };
    int last = h;
    for (int g = h; g >= 0; last = g, g = straightOn(B, g)) {
      const std::vector<int>& path = D.path[g / 2];
      const std::vector<double> s = arcLengths(D, path);
      for (std::size_t k = 0; k + 1 < path.size(); ++k) add(path[k], g, s[k] / s.back());
    }
    add(D.node[B.startNode(last ^ 1)], last ^ 1, 0);
    Pi.curves.push_back(C);
    Pi.segments.push_back({B.start(h), B.start(last ^ 1)});
    const int number = static_cast<int>(Pi.curves.size());
    Pi.corners[cornerOf[B.startNode(h)]].on.push_back({number, 0});
    Pi.corners[cornerOf[B.startNode(last ^ 1)]].on.push_back({number, C.s.back()});
  }
}

BoundaryMapping mappingOf(const MeccanoSurface& B, const CutSolid& D) {
  BoundaryMapping Pi;
  addPatches(B, D, Pi);
  addCurves(B, D, Pi);
  return Pi;
}

/// A way to cut the solid, and how good its mapping is.
struct Attempt {
  CutSolid D;
  BoundaryMapping Pi;
  double mean;  // of q; -1: none yet
};

/// Mean q after the first placement of the interior, on the meccano's mesh refined a few times.
/// [choice] An inverted element counts 0: fewest inverted elements alone, on a mesh as coarse as
/// this, chose maps that ended with lower quality.
double meanQuality(const Meccano& C, const BoundaryMapping& Pi, std::string& text) {
  constexpr std::size_t enough = 2500;  // [choice] elements that tell mappings apart
  Mesh M = getInitialMesh(C, Pi);
  while (M.tets.size() < enough) {
    std::vector<int> all(M.tets.size());
    std::iota(all.begin(), all.end(), 0);
    bisect(M, all);
  }
  placeInterior(M);
  const QualityStatistics q = qualityStatistics(M);
  text = std::to_string(q.inverted) + " of " + std::to_string(q.tetrahedra) +
         " elements inverted, mean q " + number(q.mean);
  return q.mean;
}

/// Keeps the better of the best attempt and of this one.
///   returns mean q of this one
double keepBetter(const MeccanoSurface& B, const Meccano& C, CutSolid D, const std::string& way,
                  Attempt& best) {
  D.separatePaths();
  BoundaryMapping Pi = mappingOf(B, D);
  std::string text;
  const double mean = meanQuality(C, Pi, text);
  Pi.notes = std::move(best.Pi.notes);
  Pi.notes.push_back("§2: " + way + ": " + text);
  if (mean > best.mean)
    best = {std::move(D), std::move(Pi), mean};
  else
    best.Pi.notes = std::move(Pi.notes);
  return mean;
}

/// [choice] Mean q of shortest paths from which a meccano fits the solid: its corners stay. And of
/// any mapping from which no further start is tried.
constexpr double goodFit = .8;

/// From corners that are placed: the shortest paths, and where the meccano does not fit so, with
/// the corners relaxed.
void tryStart(const MeccanoSurface& B, const Meccano& C, CutSolid D, const std::string& way,
              Attempt& best) {
  placeCutEnds(B, D);
  std::vector<int> chains(B.chains.size());
  std::iota(chains.begin(), chains.end(), 0);
  tracePaths(B, D, chains);
  if (keepBetter(B, C, D, way, best) > goodFit) return;
  for (int n = 0; n < static_cast<int>(B.nodes.size()); ++n) relaxNode(B, D, n);
  keepBetter(B, C, std::move(D), way + ", relaxed", best);
}

/// All starts until one fits well.
void tryStarts(const MeccanoSurface& B, const Meccano& C, const TriangleSurface& D,
               const CutSolid& uncut, Attempt& best) {
  std::string fault;
  std::set<std::vector<int>> tried;  // places of the corners
  for (int k = 0; k < 4 && best.mean < goodFit; ++k) {
    CutSolid S = uncut;
    const bool principal = k >= 2;
    const Start start = k % 2 == 0 ? Start::extremes : Start::boxCorners;
    const std::string way =
        std::string(start == Start::extremes ? "extreme vertices" : "box corners") +
        (principal ? " along principal axes" : "");
    try {
      placeCorners(B, principal ? principalFrame(D) : coordinateFrame(D), start, S);
      if (tried.insert(S.node).second) tryStart(B, C, std::move(S), way, best);
    } catch (const MethodError& e) {
      fault = e.what();
      best.Pi.notes.push_back("§2: " + way + ": " + fault);
    }
  }
  if (best.mean < 0) throw MethodError(fault);
}

/// The best cuts, drawn straight, if that is better still.
void straighten(const MeccanoSurface& B, const Meccano& C, Attempt& best) {
  try {
    CutSolid D = best.D;
    for (int c = 0; c < static_cast<int>(B.chains.size()); ++c) straightenChain(B, D, c);
    keepBetter(B, C, std::move(D), "straightened", best);
  } catch (const MethodError& e) {
    best.Pi.notes.push_back(std::string("§2: straightened: ") + e.what());
  }
}

}  // namespace

BoundaryMapping getBoundaryMapping(const Meccano& C, const TriangleSurface& D) {
  const MeccanoSurface B(C);
  const int genus = genusOf(D);
  if (genus != B.genus)
    refuseMeccano("the solid has " + counted(genus, "handle") + " and the polycube " +
                  std::to_string(B.genus) + "; give a polycube of the same genus");
  if (genus > 0 && C.corners.empty())
    refuseMeccano(
        "the solid has " + counted(genus, "handle") +
        ", which needs the places of the polycube's corners; add a line `corner i j k x y "
        "z` for each");
  CutSolid uncut(D);
  uncut.node.assign(B.nodes.size(), -1);
  uncut.path.resize(B.chains.size());
  Attempt best{uncut, {}, -1};
  if (C.corners.empty()) {
    tryStarts(B, C, D, uncut, best);
  } else {
    placeCorners(B, C, uncut);
    tryStart(B, C, uncut, "placed corners", best);
  }
  straighten(B, C, best);
  return best.Pi;
}

BoundaryPoint boundaryPoint(const BoundaryMapping& Pi, Vec3 xi) {
  for (std::size_t c = 0; c < Pi.corners.size(); ++c)
    if (latticeVector(Pi.cornersAt[c]) == xi)
      return {0, static_cast<int>(c) + 1, {}, Pi.corners[c].x};
  for (std::size_t c = 0; c < Pi.curves.size(); ++c) {
    const Vec3 from = latticeVector(Pi.segments[c].from), to = latticeVector(Pi.segments[c].to);
    const Vec3 along = to - from;
    const double part = dot(xi - from, along) / norm2(along);
    if (part < 0 || part > 1 || norm2(cross(xi - from, along)) > 0) continue;
    // s by the sides' u, which runs along the segment
    const Curve& C = Pi.curves[c];
    const BoundaryMapping::Rectangle& R = Pi.rectangles[-C.sides[0].surface - 1];
    const Vec2 u = inRectangle(R, xi), u0 = C.sides[0].u.front(), d = C.sides[0].u.back() - u0;
    auto partAt = [&](std::size_t k) { return dot(C.sides[0].u[k] - u0, d) / dot(d, d); };
    const double wanted = dot(u - u0, d) / dot(d, d);
    std::size_t k = 0;
    while (k + 2 < C.points.size() && partAt(k + 1) <= wanted) ++k;
    const double t = (wanted - partAt(k)) / (partAt(k + 1) - partAt(k));
    const double s = C.s[k] + t * (C.s[k + 1] - C.s[k]);
    return {1, static_cast<int>(c) + 1, {s, 0}, gamma(C, s)};
  }
  for (std::size_t p = 0; p < Pi.patches.size(); ++p) {
    const BoundaryMapping::Rectangle& R = Pi.rectangles[p];
    if (component(xi, R.axis) != R.lo[R.axis]) continue;
    const Vec2 u = inRectangle(R, xi);
    if (std::min(u.x, u.y) < 0 || std::max(u.x, u.y) > 1) continue;
    const Location at = locate(Pi.patches[p], u);
    if (at.triangle >= 0) return {2, -static_cast<int>(p) - 1, u, varphi(Pi.patches[p], at)};
  }
  throw MethodError("boundaryPoint (§2): " + placeText(xi) +
                    " does not lie on the meccano's boundary");
}

Mesh getInitialMesh(const Meccano& C, const BoundaryMapping& Pi) {
  const std::set<LatticePoint> present(C.cubes.begin(), C.cubes.end());
  std::vector<LatticePoint> cubes(present.begin(), present.end()), nodes;
  std::sort(cubes.begin(), cubes.end(), precedes);
  std::map<LatticePoint, int> cubesAt, nodeAt;
  LatticePoint lo = cubes.at(0);
  for (const LatticePoint& c : cubes) {
    for (int a = 0; a < 3; ++a) lo[a] = std::min(lo[a], c[a]);
    for (int i = 0; i < 8; ++i) ++cubesAt[{c[0] + (i & 1), c[1] + (i >> 1 & 1), c[2] + (i >> 2)}];
  }
  for (const auto& [p, count] : cubesAt) nodes.push_back(p);
  std::sort(nodes.begin(), nodes.end(), precedes);
  Mesh M;
  M.patches = Pi.patches;
  M.curves = Pi.curves;
  M.corners = Pi.corners;
  M.cube = C.cube;
  Vec3 centre;
  for (const Corner& corner : Pi.corners)
    centre += (1. / static_cast<double>(Pi.corners.size())) * corner.x;
  for (const LatticePoint& p : nodes) {
    nodeAt[p] = static_cast<int>(M.x.size());
    const bool inside = cubesAt[p] == 8;
    const BoundaryPoint at =
        inside ? BoundaryPoint{3, 0, {}, centre} : boundaryPoint(Pi, latticeVector(p));
    M.x.push_back(at.x);
    M.xi.push_back(latticeVector(p) - latticeVector(lo));
    M.dimension.push_back(static_cast<unsigned char>(at.dimension));
    M.entity.push_back(at.entity);
    M.parameter.push_back(at.parameter);
  }
  auto label = [&](const LatticePoint& c, int axis, int side) {  // of a cube's face
    if (present.count(moved(c, axis, side ? 1 : -1)) > 0) return 0;
    Vec3 middle = latticeVector(c) + Vec3{.5, .5, .5};
    (axis == 0 ? middle.x : axis == 1 ? middle.y : middle.z) += side - .5;
    return boundaryPoint(Pi, middle).entity;
  };
  for (const LatticePoint& c : cubes)
    addKuhnCell(
        M, c, [&](const LatticePoint& p) { return nodeAt.at(p); },
        [&](int axis, int side) { return label(c, axis, side); });
  M.type.assign(M.tets.size(), 0);
  M.level.assign(M.tets.size(), 0);
  placeInterior(M);
  return M;
}

namespace {

/// Stiffness of linear elements in ξ, ∫ ∇λ_i · ∇λ_j, at the inner nodes of a mesh.
struct Stiffness {
  struct Element {
    std::array<int, 4> z;
    double k[4][4];
  };
  std::vector<Element> elements;
  std::vector<char> isInner;
  std::vector<double> diagonal;

  explicit Stiffness(const Mesh& M) : isInner(M.x.size()), diagonal(M.x.size(), 0) {
    for (std::size_t n = 0; n < M.x.size(); ++n) isInner[n] = M.dimension[n] == 3;
    for (const std::array<int, 4>& z : M.tets) {
      if (!(isInner[z[0]] || isInner[z[1]] || isInner[z[2]] || isInner[z[3]])) continue;
      Element E{z, {}};
      const Mat3 edges{M.xi[z[1]] - M.xi[z[0]], M.xi[z[2]] - M.xi[z[0]], M.xi[z[3]] - M.xi[z[0]]};
      const Mat3 cof = cofactor(edges);
      const Vec3 g[4] = {-(cof.c0 + cof.c1 + cof.c2), cof.c0, cof.c1, cof.c2};
      for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j) {
          if (i == j) continue;
          E.k[i][j] = dot(g[i], g[j]) / (6 * std::abs(det(edges)));
          diagonal[z[i]] -= E.k[i][j];  // rows sum to 0
        }
      elements.push_back(E);
    }
  }
  /// Of the stiffness matrix with a field; 0 at the other nodes.
  std::vector<Vec3> product(const std::vector<Vec3>& p) const {
    std::vector<Vec3> y(p.size());
    for (const Element& E : elements)
      for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j)
          if (i != j && isInner[E.z[i]]) y[E.z[i]] += E.k[i][j] * (p[E.z[j]] - p[E.z[i]]);
    return y;
  }
};

double innerProduct(const std::vector<Vec3>& a, const std::vector<Vec3>& b) {
  double sum = 0;
  for (std::size_t n = 0; n < a.size(); ++n) sum += dot(a[n], b[n]);
  return sum;
}

}  // namespace

void placeInterior(Mesh& M) {
  constexpr double tolerance = 1e-10;  // of the first residual's norm: far below any element
  constexpr int maxIterations = 5000;
  const Stiffness K(M);
  auto scaled = [&](std::vector<Vec3> r) {
    for (std::size_t n = 0; n < r.size(); ++n)
      if (K.isInner[n]) r[n] = (1 / K.diagonal[n]) * r[n];
    return r;
  };
  // Conjugate gradients with the diagonal as preconditioner, for the three coordinates at once.
  std::vector<Vec3> r = K.product(M.x);
  for (Vec3& v : r) v = -v;
  std::vector<Vec3> z = scaled(r), p = z;
  double rz = innerProduct(r, z);
  const double goal = tolerance * tolerance * rz;
  for (int iteration = 0; rz > goal; ++iteration) {
    if (iteration == maxIterations)
      throw SolverError("placeInterior (§2): conjugate gradients did not reach " +
                        number(tolerance) + " in " + std::to_string(maxIterations) +
                        " iterations; the mesh's computational elements are degenerate");
    const std::vector<Vec3> Kp = K.product(p);
    const double alpha = rz / innerProduct(p, Kp);
    for (std::size_t n = 0; n < p.size(); ++n) {
      M.x[n] += alpha * p[n];
      r[n] += -alpha * Kp[n];
    }
    z = scaled(r);
    const double next = innerProduct(r, z);
    for (std::size_t n = 0; n < p.size(); ++n) p[n] = z[n] + (next / rz) * p[n];
    rz = next;
  }
}

// ==== 2. Kossaczký bisection [17] ================================================================

namespace {

/// The corners 0 to 3 of an element by the numbers of their nodes.
std::array<int, 4> sortedCorners(const std::array<int, 4>& z) {
  std::array<int, 4> o{0, 1, 2, 3};
  for (const auto& [a, b] : {std::pair{0, 1}, {2, 3}, {0, 2}, {1, 3}, {1, 2}})  // sorts any four
    if (z[o[b]] < z[o[a]]) std::swap(o[a], o[b]);
  return o;
}

}  // namespace

std::vector<std::array<int, 4>> faceNeighbours(const Mesh& M) {
  const int nodes = static_cast<int>(M.x.size()), count = static_cast<int>(M.tets.size());
  std::vector<std::array<int, 4>> neighbour(count, {-1, -1, -1, -1});
  // Faces grouped by their largest node, of a bisected mesh the youngest one, at which few elements
  // meet; within a group equal faces are found by comparing the other two. Of the sorted nodes of
  // an element three faces end with the last, one with the second to last.
  std::vector<int> start(nodes + 1, 0);
  for (const std::array<int, 4>& z : M.tets) {
    const std::array<int, 4> o = sortedCorners(z);
    start[z[o[3]] + 1] += 3;
    ++start[z[o[2]] + 1];
  }
  std::partial_sum(start.begin(), start.end(), start.begin());
  struct Waiting {
    int v1, v2, E, i;
  };
  std::vector<Waiting> group(start.back());
  std::vector<int> filled(start.begin(), start.end() - 1);
  for (int E = 0; E < count; ++E) {
    const std::array<int, 4>& z = M.tets[E];
    const std::array<int, 4> o = sortedCorners(z);
    for (int k = 0; k < 4; ++k) {
      const int v0 = z[o[k < 3 ? 3 : 2]], v1 = z[o[k < 2 ? 2 : 1]], v2 = z[o[k < 1 ? 1 : 0]];
      const int i = o[k];
      int g = start[v0];
      while (g < filled[v0] && (group[g].v1 != v1 || group[g].v2 != v2)) ++g;
      if (g == filled[v0]) {
        group[filled[v0]++] = {v1, v2, E, i};
        continue;
      }
      if (neighbour[group[g].E][group[g].i] >= 0)
        throw InputError("faceNeighbours: the face opposite to vertex " + std::to_string(i) +
                         " of tetrahedron " + std::to_string(E) +
                         " has more than two tetrahedra; correct the mesh");
      neighbour[group[g].E][group[g].i] = E;
      neighbour[E][i] = group[g].E;
    }
  }
  return neighbour;
}

constexpr std::size_t usualStar = 32;  // elements: room that is seldom left

Bisection::Bisection(Mesh& mesh) : Bisection(mesh, faceNeighbours(mesh)) {}

Bisection::Bisection(Mesh& mesh, std::vector<std::array<int, 4>> known)
    : M(mesh), neighbour(std::move(known)), tetOf(mesh.x.size(), -1) {
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int n : M.tets[E]) tetOf[n] = static_cast<int>(E);
}

void Bisection::ring(int E, int a, int b, std::vector<int>& around) const {
  around.reserve(usualStar);
  around.assign(1, E);
  int others[2], found = 0;
  for (int n : M.tets[E])
    if (n != a && n != b) others[found++] = n;
  for (int direction = 0; direction < 2; ++direction) {
    int t = E, leave = others[direction], keep = others[1 - direction];
    for (;;) {  // across the face (a, b, keep); ends at E again or at the boundary
      const int next = neighbour[t][localIndex(M.tets[t], leave)];
      if (next < 0) break;
      if (next == E) return;
      around.push_back(next);
      int fourth = -1;
      for (int n : M.tets[next])
        if (n != a && n != b && n != keep) fourth = n;
      t = next, leave = keep, keep = fourth;
    }
  }
}

template <class Wanted>
int Bisection::walkStar(int n, std::vector<int>& around, const Wanted& wanted) const {
  walkedBy.resize(M.tets.size(), 0);
  ++walk;
  around.reserve(usualStar);
  around.assign(1, tetOf[n]);
  walkedBy[tetOf[n]] = walk;
  for (std::size_t i = 0; i < around.size(); ++i) {
    const int t = around[i];
    if (wanted(t)) return t;
    for (int j = 0; j < 4; ++j) {
      const int next = neighbour[t][j];
      if (M.tets[t][j] == n || next < 0 || walkedBy[next] == walk) continue;
      walkedBy[next] = walk;
      around.push_back(next);
    }
  }
  return -1;
}

void Bisection::star(int n, std::vector<int>& around) const {
  walkStar(n, around, [](int) { return false; });
}

int Bisection::coarserAt(int n, int level, std::vector<int>& around) const {
  return walkStar(n, around, [&](int t) { return M.level[t] < level; });
}

int Bisection::tetWithEdge(int a, int b) const {
  std::vector<int> around;
  return walkStar(a, around, [&](int t) { return localIndex(M.tets[t], b) >= 0; });
}

namespace {

/// Calls found(curve, s) for the curves on which node n lies, until it is true.
template <class Found>
bool anyCurveAt(const Mesh& M, int n, Found found) {
  if (M.dimension[n] == 1) return found(M.entity[n], M.parameter[n].x);
  if (M.dimension[n] == 0)
    for (const Corner::Place& place : M.corners[M.entity[n] - 1].on)
      if (found(place.curve, place.s)) return true;
  return false;
}

}  // namespace

bool parameterOn(const Mesh& M, int n, int label, Vec2& u) {
  if (M.dimension[n] == 2 && M.entity[n] == label) {
    u = M.parameter[n];
    return true;
  }
  return anyCurveAt(M, n, [&](int curve, double s) {
    const Curve& C = M.curves[curve - 1];
    for (const Curve::Side& side : C.sides)
      if (side.surface == label) {
        u = curveParameter(C, side, s);
        return true;
      }
    return false;
  });
}

namespace {

/// Refuses a mesh whose arrays do not fit together, before anything indexes them.
void checkMeccano(const Mesh& M, const std::string& who) {
  const std::size_t nodes = M.x.size(), tets = M.tets.size();
  auto refuse = [&](const std::string& what) { throw InputError(who + ": " + what); };
  if (tets == 0) refuse("the mesh has no tetrahedra");
  if (M.xi.size() != nodes)
    refuse(
        "the mesh has no computational coordinates, which bisection and projection need; make it "
        "by boxMesh or `meccano box`, or read a meccano .vtk");
  if (M.type.size() != tets || M.level.size() != tets || M.faceLabel.size() != tets ||
      M.dimension.size() != nodes || M.entity.size() != nodes || M.parameter.size() != nodes)
    refuse(
        "the mesh lacks types, levels, labels or entities of some elements; make it by boxMesh, or "
        "read a meccano .vtk");
  if (!(M.cube.x > 0 && M.cube.y > 0 && M.cube.z > 0) || !std::isfinite(norm(M.cube)))
    refuse("the edges of the mesh's cubes (Mesh::cube) must be finite and above 0");
  const int patches = static_cast<int>(M.patches.size()),
            surfaces = static_cast<int>(M.surfaces.size());
  for (std::size_t E = 0; E < tets; ++E)
    for (int i = 0; i < 4; ++i) {
      const int n = M.tets[E][i], label = M.faceLabel[E][i];
      if (n < 0 || n >= static_cast<int>(nodes) || M.type[E] > 2 || M.level[E] % 3 != M.type[E] ||
          label < -patches || label > surfaces)
        refuse("tetrahedron " + std::to_string(E) +
               " has a node, type, level or label out of range");
    }
  const int counts[3] = {static_cast<int>(M.corners.size()), static_cast<int>(M.curves.size()),
                         surfaces};
  for (std::size_t n = 0; n < nodes; ++n) {
    const int dimension = M.dimension[n], entity = M.entity[n];
    const bool known = dimension == 3 || (dimension == 2 && entity < 0 && entity >= -patches) ||
                       (dimension < 3 && entity > 0 && entity <= counts[dimension]);
    if (!known || !isFinite(M.x[n]) || !isFinite(M.xi[n]) ||
        std::min({M.xi[n].x, M.xi[n].y, M.xi[n].z}) < 0)
      refuse("node " + std::to_string(n) + " has an entity or a coordinate out of range");
  }
  checkGeometry(M, who);
  const int curves = counts[1];
  for (const Parametrization& P : M.surfaces)
    if (P.rim < 1 || P.rim > curves) refuse("surface '" + P.name + "' names no curve as its rim");
  for (const Corner& corner : M.corners)
    for (const Corner::Place& place : corner.on)
      if (place.curve < 1 || place.curve > curves)
        refuse("a corner lies on a curve that is not there");
  for (std::size_t E = 0; E < tets; ++E)  // as where a host has reordered the elements alone
    for (int i = 0; i < 4; ++i)
      for (int n : faceOpposite(M.tets[E], i)) {
        Vec2 u;
        if (M.faceLabel[E][i] != 0 && !parameterOn(M, n, M.faceLabel[E][i], u))
          refuse("the face of tetrahedron " + std::to_string(E) + " opposite to its vertex " +
                 std::to_string(i) + " has label " + std::to_string(M.faceLabel[E][i]) +
                 ", which its nodes do not lie on; keep faceLabel, type and level in the order of "
                 "the tetrahedra");
      }
}

/// s of node n on curve c.
bool parameterOnCurve(const Mesh& M, int n, int c, double& s) {
  return anyCurveAt(M, n, [&](int curve, double there) {
    if (curve == c) s = there;
    return curve == c;
  });
}

/// Midpoint in s, on a closed curve the shorter way round.
double curveMidpoint(const Curve& C, double s0, double s1) {
  const double length = C.s.back();
  double middle = .5 * (s0 + s1);
  if (C.closed && std::abs(s1 - s0) > .5 * length) middle += .5 * length;
  return middle < length ? middle : middle - (C.closed ? length : 0);
}

/// The curve between the two labels on which both nodes lie; 0 if there is none.
int commonCurve(const Mesh& M, int a, int b, int label0, int label1) {
  int common = 0;
  anyCurveAt(M, a, [&](int c, double) {
    bool has0 = false, has1 = false;
    for (const Curve::Side& side : M.curves[c - 1].sides) {
      has0 |= side.surface == label0;
      has1 |= side.surface == label1;
    }
    double s;
    if (has0 && has1 && parameterOnCurve(M, b, c, s)) common = c;
    return common > 0;
  });
  return common;
}

}  // namespace

/// The entity of the edge (a, b), told by the labels of the faces around it: two faces of one
/// surface (inside it), one face of S_M (its rim), two of different patches (an edge of the
/// boundary).
Bisection::EdgeEntity Bisection::entityOf(int a, int b, const std::vector<int>& around) const {
  int patch[2] = {0, 0}, patches = 0, surface = 0, seen = 0;
  for (int t : around)
    for (int i = 0; i < 4; ++i) {
      const int label = M.faceLabel[t][i], n = M.tets[t][i];
      if (label == 0 || n == a || n == b) continue;
      if (label < 0 && patches < 2) patch[patches++] = label;
      if (label > 0) surface = label, ++seen;
    }
  if (patches == 2 && patch[0] == patch[1]) return {2, patch[0]};
  if (patches == 2) return {1, commonCurve(M, a, b, patch[0], patch[1])};
  if (surface == 0 || surface > static_cast<int>(M.surfaces.size())) return {3, 0};
  // each face of S_M is seen from both of its tetrahedra
  return seen >= 4 ? EdgeEntity{2, surface} : EdgeEntity{1, M.surfaces[surface - 1].rim};
}

namespace {

/// [§3.6 departure] Whether the edge ab of a surface passes over a slit or an overlap of it: its
/// parametric midpoint is far from it (farther than the edge is long).
bool isBridging(Vec3 a, Vec3 b, Vec3 parametricMidpoint) {
  return norm2(parametricMidpoint - .5 * (a + b)) > norm2(b - a);
}

/// The point of a surface nearest to x, and its parameter.
Vec3 nearestOn(const Parametrization& P, Vec3 x, Vec2& u) {
  ClosestPoint best{1e300, {}, -1, {}, Feature::face, 0};
  for (const std::array<int, 3>& t : P.triangles) {
    const ClosestPoint p =
        closestPointOnTriangle(x, P.points[t[0]], P.points[t[1]], P.points[t[2]]);
    if (p.distance >= best.distance) continue;
    best = p;
    u = p.w[0] * P.u[t[0]] + p.w[1] * P.u[t[1]] + p.w[2] * P.u[t[2]];
  }
  return best.point;
}

/// On a curve that an edge of this length bridges: half of it along the curve from one of its ends,
/// the one that is nearer to x.
double besideBridge(const Curve& C, double s0, double s1, double length, Vec3 x) {
  const double L = C.s.back();
  double forward = s1 - s0;  // from s0 to s1, the short way
  if (C.closed && forward > L / 2) forward -= L;
  if (C.closed && forward < -L / 2) forward += L;
  const double step = std::copysign(length / 2, forward);
  double near = s0 + step, far = s1 - step;
  if (norm2(gamma(C, far) - x) < norm2(gamma(C, near) - x)) near = far;
  return C.closed ? near - L * std::floor(near / L) : near;
}

}  // namespace

int Bisection::addMidpoint(int a, int b, const std::vector<int>& around) {
  const EdgeEntity e = entityOf(a, b, around);
  Vec3 x = .5 * (M.x[a] + M.x[b]);
  Vec2 parameter;
  unsigned char dimension = 3;
  int entity = 0;
  if (e.dimension == 2) {
    Vec2 u0, u1;
    if (parameterOn(M, a, e.entity, u0) && parameterOn(M, b, e.entity, u1)) {
      dimension = 2, entity = e.entity, parameter = .5 * (u0 + u1);
      const Vec3 onS = varphi(surfaceOf(M, entity), parameter);
      const bool inserted = entity > 0;  // a patch of ∂𝓜 has no slits, and Π may squash it
      if (inserted && isBridging(M.x[a], M.x[b], onS))
        x = nearestOn(surfaceOf(M, entity), x, parameter);
      else
        x = onS;
    }
  } else if (e.dimension == 1 && e.entity > 0) {
    double s0 = 0, s1 = 0;
    if (parameterOnCurve(M, a, e.entity, s0) && parameterOnCurve(M, b, e.entity, s1)) {
      const Curve& C = M.curves[e.entity - 1];
      dimension = 1, entity = e.entity, parameter = {curveMidpoint(C, s0, s1), 0};
      const bool rim = !C.sides.empty() && C.sides[0].surface > 0;
      if (rim && isBridging(M.x[a], M.x[b], gamma(C, parameter.x)))
        parameter.x = besideBridge(C, s0, s1, norm(M.x[b] - M.x[a]), x);
      x = gamma(C, parameter.x);
    }
  }
  if (e.dimension < 3 && dimension == 3)
    throw MethodError("bisect (§3.2): the edge of nodes " + std::to_string(a) + " and " +
                      std::to_string(b) +
                      " lies on a surface, its ends do not; the mesh's entities "
                      "are inconsistent");
  M.x.push_back(x);
  M.xi.push_back(.5 * (M.xi[a] + M.xi[b]));
  M.dimension.push_back(dimension);
  M.entity.push_back(entity);
  M.parameter.push_back(parameter);
  tetOf.push_back(around[0]);
  return static_cast<int>(M.x.size()) - 1;
}

void Bisection::bisectRing(const std::vector<int>& around) {
  const int a = M.tets[around[0]][0], b = M.tets[around[0]][1];
  const int m = addMidpoint(a, b, around), first = static_cast<int>(M.tets.size());
  // The child of ring tetrahedron t at end node `end`: child 0 keeps the index, child 1 is
  // appended.
  auto child = [&](int t, int end) {
    if (t < 0 || M.tets[t][0] == end) return t;
    return first + static_cast<int>(std::find(around.begin(), around.end(), t) - around.begin());
  };
  struct Half {
    std::array<int, 4> z, neighbour, label;
  };
  std::vector<Half> halves;
  halves.reserve(2 * around.size());
  for (int t : around) {
    const std::array<int, 4> z = M.tets[t], N = neighbour[t], L = M.faceLabel[t];
    const int t1 = child(t, z[1]);
    halves.push_back({{z[0], z[2], z[3], m},
                      {t1, child(N[2], z[0]), child(N[3], z[0]), N[1]},
                      {0, L[2], L[3], L[1]}});
    Half one{{z[1], z[2], z[3], m},
             {t, child(N[2], z[1]), child(N[3], z[1]), N[0]},
             {0, L[2], L[3], L[0]}};
    if (M.type[t] == 0) {
      std::swap(one.z[1], one.z[2]);
      std::swap(one.neighbour[1], one.neighbour[2]);
      std::swap(one.label[1], one.label[2]);
    }
    halves.push_back(one);
  }
  for (std::size_t i = 0; i < around.size(); ++i) {
    const int t = around[i], t1 = first + static_cast<int>(i),
              beyond = halves[2 * i + 1].neighbour[3];
    if (beyond >= 0) *std::find(neighbour[beyond].begin(), neighbour[beyond].end(), t) = t1;
    tetOf[M.tets[t][1]] = t1;
    M.type[t] = static_cast<unsigned char>((M.type[t] + 1) % 3);
    ++M.level[t];
    M.type.push_back(M.type[t]);
    M.level.push_back(M.level[t]);
    M.tets.push_back(halves[2 * i + 1].z);
    neighbour.push_back(halves[2 * i + 1].neighbour);
    M.faceLabel.push_back(halves[2 * i + 1].label);
    splits.push_back({t, t1, m});
  }
  for (std::size_t i = 0; i < around.size(); ++i) {
    const int t = around[i];
    M.tets[t] = halves[2 * i].z;
    neighbour[t] = halves[2 * i].neighbour;
    M.faceLabel[t] = halves[2 * i].label;
  }
}

void Bisection::bisect(int E, int depth) {
  constexpr int maxDepth = 100;  // the recursion descends a level at least every third call
  if (depth > maxDepth || M.level[E] > 250)
    throw MethodError("bisect (§3.2): the closure at tetrahedron " + std::to_string(E) +
                      " does not end; the mesh is no bisection of Kuhn cubes");
  const int level = M.level[E];
  std::vector<int> around;
  while (M.level[E] == level) {
    const int a = M.tets[E][0], b = M.tets[E][1];
    ring(E, a, b, around);
    int coarser = -1;
    for (int t : around) {
      const std::array<int, 4>& z = M.tets[t];
      if (!((z[0] == a && z[1] == b) || (z[0] == b && z[1] == a))) coarser = t;
    }
    if (coarser < 0)
      bisectRing(around);
    else
      bisect(coarser, depth + 1);
  }
}

void Bisection::bisectEdge(int a, int b) {
  constexpr int maxRounds = 64;  // two bisections for each tetrahedron around the edge are enough
  for (int round = 0; round < maxRounds; ++round) {
    const int E = tetWithEdge(a, b);
    if (E < 0) return;
    bisect(E);
  }
  throw MethodError("bisectEdge (§3.5): the edge of nodes " + std::to_string(a) + " and " +
                    std::to_string(b) + " is not split; the mesh is no bisection of Kuhn cubes");
}

namespace {

/// Bisects these tetrahedra, each once: not one that the closure of another has bisected.
void bisectOnce(Bisection& B, const std::vector<int>& E) {
  std::vector<unsigned char> level;
  for (int t : E) level.push_back(B.M.level[t]);
  for (std::size_t i = 0; i < E.size(); ++i)
    if (B.M.level[E[i]] == level[i]) B.bisect(E[i]);
}

}  // namespace

void bisect(Mesh& M, const std::vector<int>& E) {
  checkMeccano(M, "bisect (§3.2)");
  for (int t : E)
    if (t < 0 || t >= static_cast<int>(M.tets.size()))
      throw InputError("bisect (§3.2): there is no tetrahedron " + std::to_string(t));
  Bisection B(M);
  bisectOnce(B, E);
}

// ==== 2. Terrain =================================================================================

namespace {

void checkTerrain(const Terrain& T) {
  constexpr double farTop = 1e6;  // [choice] of the terrain's extent: no atmosphere is as high
  const auto refuse = [](const std::string& what) {
    throw InputError("meccanoMesher (§2): " + what);
  };
  if (T.nx < 2 || T.ny < 2 || T.z.size() != std::size_t(T.nx) * T.ny)
    refuse("a terrain needs 2 x 2 grid points or more, and a height for each; given are " +
           std::to_string(T.nx) + " x " + std::to_string(T.ny) + " points, " +
           std::to_string(T.z.size()) + " heights");
  if (!(T.cell > 0) || !std::isfinite(T.cell)) refuse("the terrain's cell must be above 0");
  const double highest = farTop * T.cell * std::max(T.nx, T.ny);
  for (std::size_t k = 0; k < T.z.size(); ++k) {
    const std::string where =
        " at grid point (" + std::to_string(k % T.nx) + ", " + std::to_string(k / T.nx) + ")";
    if (!std::isfinite(T.z[k])) refuse("the height" + where + " is not finite");
    if (!(T.z[k] < T.top))
      refuse("the height " + number(T.z[k]) + where + " is not below the top " + number(T.top) +
             "; raise the top");
    if (!(T.top - T.z[k] < highest))
      refuse("the top " + number(T.top) + " is farther above the height " + number(T.z[k]) + where +
             " than a million times the terrain's extent; lower the top");
  }
}

double meanHeight(const Terrain& T) {
  return std::accumulate(T.z.begin(), T.z.end(), 0.) / static_cast<double>(T.z.size());
}

/// The bilinear surface is straight along grid lines; inside a cell two triangles miss it by a
/// quarter of this.
double twist(const Terrain& T, int i, int j) {
  const double* z = &T.z[j * T.nx + i];
  return z[0] - z[1] - z[T.nx] + z[T.nx + 1];
}

constexpr double bilinearPart = .1;  // [choice] of ε is left to the triangles of the patch
constexpr int mostPieces = 8;        // of a grid cell along each axis

/// k x k pieces of a grid cell leave twist / (4 k²).
int piecesOf(const Terrain& T, int i, int j, double allowed) {
  const double k = std::sqrt(std::abs(twist(T, i, j)) / (4 * allowed));
  return std::clamp(static_cast<int>(std::ceil(k)), 1, mostPieces);
}

/// The bottom patch: ϕ(u) has its x and y affine in u, its z on the bilinear terrain at the points.
/// [choice] A cell is cut into as many pieces as leave `allowed`; its neighbours need not match,
/// since the terrain is straight between them.
Parametrization terrainPatch(const Terrain& T, double allowed) {
  Parametrization P;
  P.name = "terrain";
  KeyMap known(T.z.size());    // by position on the grid, in pieces of all sizes; number + 1
  constexpr int common = 840;  // divisible by 1 .. 8
  auto point = [&](int i, int j, int a, int b, int k) {
    const std::uint64_t x = std::uint64_t(i) * common + a * common / k;
    const std::uint64_t y = std::uint64_t(j) * common + b * common / k;
    int& n = known[x << 32 | y];
    if (n == 0) {
      const double s = i + double(a) / k, t = j + double(b) / k;
      const double px = T.origin.x + T.cell * s, py = T.origin.y + T.cell * t;
      P.points.push_back({px, py, heightAt(T, px, py)});
      P.u.push_back({s / (T.nx - 1), t / (T.ny - 1)});
      n = static_cast<int>(P.points.size());
    }
    return n - 1;
  };
  for (int j = 0; j + 1 < T.ny; ++j)
    for (int i = 0; i + 1 < T.nx; ++i) {
      const int k = piecesOf(T, i, j, allowed);
      for (int b = 0; b < k; ++b)
        for (int a = 0; a < k; ++a) {
          const int p = point(i, j, a, b, k), q = point(i, j, a + 1, b, k);
          const int r = point(i, j, a + 1, b + 1, k), s = point(i, j, a, b + 1, k);
          P.triangles.push_back({p, q, r});
          P.triangles.push_back({p, r, s});
        }
    }
  buildLocator(P);
  return P;
}

/// The largest distance, measured upright, of that patch from the bilinear terrain.
double terrainDeviation(const Terrain& T, double allowed) {
  double most = 0;
  for (int j = 0; j + 1 < T.ny; ++j)
    for (int i = 0; i + 1 < T.nx; ++i) {
      const int k = piecesOf(T, i, j, allowed);
      most = std::max(most, std::abs(twist(T, i, j)) / (4. * k * k));
    }
  return most;
}

/// The curve through points, with u on both patches beside it.
Curve openCurve(const std::vector<Vec3>& points, std::vector<Curve::Side> sides) {
  Curve C;
  C.points = points;
  C.s.push_back(0);
  for (std::size_t i = 1; i < points.size(); ++i)
    C.s.push_back(C.s.back() + norm(points[i] - points[i - 1]));
  C.sides = std::move(sides);
  return C;
}

/// The box over the terrain, low and size its extent.
struct TerrainBox {
  const Terrain& T;
  Vec3 low, size;

  /// u of a point on the box side normal to `axis`.
  Vec2 onSide(int axis, Vec3 x) const {
    auto part = [&](int a) { return (component(x, a) - component(low, a)) / component(size, a); };
    return {part((axis + 1) % 3), part((axis + 2) % 3)};
  }
  Vec3 ground(double x, double y) const { return {x, y, heightAt(T, x, y)}; }
};

TerrainBox terrainBox(const Terrain& T) {
  const double zLow = *std::min_element(T.z.begin(), T.z.end());
  return {
      T, {T.origin.x, T.origin.y, zLow}, {T.cell * (T.nx - 1), T.cell * (T.ny - 1), T.top - zLow}};
}

/// A bottom edge or an upright edge of the box, on the ground.
Curve groundCurve(const TerrainBox& B, int axis, int b, int c) {
  const Vec3 far = B.low + B.size;
  std::vector<Vec3> points;
  const int first = (axis + 1) % 3, second = (axis + 2) % 3;
  std::array<int, 3> side{0, 0, 0};
  side[first] = b, side[second] = c;
  const double x = side[0] ? far.x : B.low.x, y = side[1] ? far.y : B.low.y;
  if (axis == 0)
    for (int i = 0; i < B.T.nx; ++i) points.push_back(B.ground(B.low.x + B.T.cell * i, y));
  if (axis == 1)
    for (int j = 0; j < B.T.ny; ++j) points.push_back(B.ground(x, B.low.y + B.T.cell * j));
  if (axis == 2) points = {B.ground(x, y), {x, y, far.z}};
  std::vector<Curve::Side> sides{{-boxPatch(first, b), {}}, {-boxPatch(second, c), {}}};
  for (Vec3 p : points) {
    sides[0].u.push_back(B.onSide(first, p));
    sides[1].u.push_back(B.onSide(second, p));
  }
  return openCurve(points, sides);
}

/// s of a curve where its coordinate along the axis is x.
double arcLengthAt(const Curve& C, int axis, double x) {
  std::size_t i = 1;
  while (i + 1 < C.points.size() && component(C.points[i], axis) < x) ++i;
  const double a = component(C.points[i - 1], axis), b = component(C.points[i], axis);
  return C.s[i - 1] + (x - a) / (b - a) * (C.s[i] - C.s[i - 1]);
}

/// Moves a node of the box upright to its place between terrain and top, and gives it its
/// parameter there.
void raiseNode(Mesh& M, const TerrainBox& B, int n) {
  Vec3& x = M.x[n];
  const double ground = heightAt(B.T, x.x, x.y), part = (x.z - B.low.z) / B.size.z;
  if (part < 1) x.z = ground + part * (B.T.top - ground);
  const int entity = M.entity[n];
  if (M.dimension[n] == 0) x = M.corners[entity - 1].x;
  if (M.dimension[n] == 1) {
    const int axis = (entity - 1) / 4;
    M.parameter[n].x = arcLengthAt(M.curves[entity - 1], axis, component(x, axis));
    x = gamma(M.curves[entity - 1], M.parameter[n].x);
  }
  if (M.dimension[n] == 2) {
    M.parameter[n] = B.onSide((-entity - 1) / 2, x);
    x = varphi(M.patches[-entity - 1], M.parameter[n]);
  }
}

/// [§2, Algorithm 1, lines 2 to 4] The initial mesh: near-cubic cells, its columns between terrain
/// and top; Π is the box's, its bottom on the terrain. [choice] The upright sides are whole
/// rectangles, down to the lowest ground: a midpoint of parameters is that of the points.
Mesh terrainMesh(const Terrain& T, double allowed) {
  const std::array<int, 3> cells = terrainCells(T);
  const TerrainBox B = terrainBox(T);
  Mesh M = boxMesh(B.low, B.size, cells);
  M.patches[boxPatch(2, 0) - 1] = terrainPatch(T, allowed);
  for (int c = 0; c < 2; ++c)
    for (int b = 0; b < 2; ++b) {
      if (b == 0) M.curves[boxCurve(0, c, 0) - 1] = groundCurve(B, 0, c, 0);
      if (b == 0) M.curves[boxCurve(1, 0, c) - 1] = groundCurve(B, 1, 0, c);
      M.curves[boxCurve(2, b, c) - 1] = groundCurve(B, 2, b, c);
    }
  for (Corner& corner : M.corners)
    for (Corner::Place& place : corner.on) {
      const Curve& C = M.curves[place.curve - 1];
      place.s = place.s > 0 ? C.s.back() : 0;
      corner.x = place.s > 0 ? C.points.back() : C.points.front();
    }
  for (int n = 0; n < static_cast<int>(M.x.size()); ++n) raiseNode(M, B, n);
  M.cube.z = (T.top - meanHeight(T)) / cells[2];
  return M;
}

}  // namespace

double heightAt(const Terrain& T, double x, double y) {
  const double s = std::clamp((x - T.origin.x) / T.cell, 0., T.nx - 1.);
  const double t = std::clamp((y - T.origin.y) / T.cell, 0., T.ny - 1.);
  const int i = std::min(static_cast<int>(s), T.nx - 2),
            j = std::min(static_cast<int>(t), T.ny - 2);
  const double a = s - i, b = t - j;
  const double* z = &T.z[j * T.nx + i];
  return (1 - b) * ((1 - a) * z[0] + a * z[1]) + b * ((1 - a) * z[T.nx] + a * z[T.nx + 1]);
}

std::array<int, 3> terrainCells(const Terrain& T) {
  constexpr double alongLonger = 8;  // [choice] cells, where the height allows
  checkTerrain(T);
  const Vec3 size{T.cell * (T.nx - 1), T.cell * (T.ny - 1), T.top - meanHeight(T)};
  double h = std::min(std::max(size.x, size.y) / alongLonger, size.z);
  h = size.z / std::round(size.z / h);
  std::array<int, 3> cells = T.cells;
  for (int a = 0; a < 3; ++a)
    if (cells[a] == 0)
      cells[a] = std::max(1, static_cast<int>(std::lround(component(size, a) / h)));
  return cells;
}

double terrainEps(const Terrain& T) {
  constexpr double partOfDiagonal = .002;
  checkTerrain(T);
  return partOfDiagonal * norm(terrainBox(T).size);
}

// ==== 2. Algorithm 1: distance ===================================================================

namespace {

/// A triangle of ∂M with its nodes' parameters on its patch.
struct BoundaryFace {
  BoundaryTriangle at;
  int label;
  std::array<int, 3> n;
  std::array<Vec2, 3> u;
};

BoundaryFace boundaryFace(const Mesh& M, BoundaryTriangle at) {
  BoundaryFace face{at, M.faceLabel[at.E][at.i], {}, {}};
  for (int j = 0; j < 3; ++j) {
    face.n[j] = M.tets[at.E][(at.i + 1 + j) % 4];
    if (!parameterOn(M, face.n[j], face.label, face.u[j]))
      throw MethodError("distance (§2): node " + std::to_string(face.n[j]) +
                        " does not lie on its boundary patch " + std::to_string(-face.label) +
                        "; the mesh's entities are inconsistent");
  }
  if (cross(face.u[1] - face.u[0], face.u[2] - face.u[0]) < 0) {
    std::swap(face.n[1], face.n[2]);
    std::swap(face.u[1], face.u[2]);
  }
  return face;
}

/// Whether a patch is planar: relative to its extent, with room for the rounding of its points.
bool isPlanar(const Parametrization& P) {
  constexpr double tolerance = 1e-12;
  Vec3 a = P.points[0], b = a, normal{};
  for (Vec3 p : P.points)
    if (norm2(p - a) > norm2(b - a)) b = p;
  for (Vec3 p : P.points)
    if (norm2(cross(b - a, p - a)) > norm2(normal)) normal = cross(b - a, p - a);
  const double size = norm(normal) * norm(b - a);
  for (Vec3 p : P.points)
    if (std::abs(dot(normal, p - a)) > tolerance * size) return false;
  return true;
}

/// ∂Ω: the curved patches, which must be approximated, and a tree over them.
struct CurvedBoundary {
  std::vector<char> curved;  // [patches]
  TriangleTree tree;
  bool isFixed = false;  // nodes cannot slide
};

CurvedBoundary curvedBoundary(const Mesh& M) {
  CurvedBoundary B;
  std::vector<Vec3> points;
  std::vector<std::array<int, 3>> triangles;
  for (const Parametrization& P : M.patches) {
    B.curved.push_back(!isPlanar(P));
    if (!B.curved.back()) continue;
    const int first = static_cast<int>(points.size());
    points.insert(points.end(), P.points.begin(), P.points.end());
    for (const std::array<int, 3>& t : P.triangles)
      triangles.push_back({t[0] + first, t[1] + first, t[2] + first});
  }
  B.tree = TriangleTree(points, triangles);
  return B;
}

/// Calls sample(w0, w1, w2) on a lattice of the triangle without its vertices.
template <class Sample>
void forSamples(int steps, Sample sample) {
  for (int a = 0; a <= steps; ++a)
    for (int b = 0; a + b <= steps; ++b) {
      const int c = steps - a - b;
      if (a == steps || b == steps || c == steps) continue;
      sample(double(a) / steps, double(b) / steps, double(c) / steps);
    }
}

/// A point of Π and the point of the flat face with the same barycentric coordinates.
struct Sampled {
  Vec3 onSolid, onFace;
};
Sampled sampled(const Parametrization& P, const std::array<Vec3, 3>& x,
                const std::array<Vec2, 3>& u, double a, double b, double c) {
  return {varphi(P, a * u[0] + b * u[1] + c * u[2]), a * x[0] + b * x[1] + c * x[2]};
}

std::array<Vec3, 3> placesOf(const Mesh& M, const std::array<int, 3>& n) {
  return {M.x[n[0]], M.x[n[1]], M.x[n[2]]};
}

/// Both distances of a face at its sample points.
struct FaceDistance {
  double toSolid = 0, toFace = 0;
};

/// [choice] Where the distance comes as near to the largest so far, or to what is enough, it is
/// sampled more densely: what lies between the first samples has been up to 8 % farther.
constexpr double nearLargest = .75;

/// Adds the samples of one lattice to d.
void sampleFace(const Mesh& M, const BoundaryFace& face, const CurvedBoundary& Omega, double enough,
                int steps, FaceDistance& d) {
  const std::array<Vec3, 3> x = placesOf(M, face.n);
  const Parametrization& P = surfaceOf(M, face.label);
  forSamples(steps, [&](double a, double b, double c) {
    const Sampled at = sampled(P, x, face.u, a, b, c);
    const double bound = norm(at.onSolid - at.onFace);
    if (bound <= std::max(enough, std::min(d.toSolid, d.toFace))) {
      d.toSolid = std::max(d.toSolid, bound), d.toFace = std::max(d.toFace, bound);
      return;
    }
    d.toSolid = std::max(d.toSolid, Omega.tree.closest(at.onFace, bound * (1 + 1e-9)).distance);
    d.toFace = std::max(d.toFace, closestPointOnTriangle(at.onSolid, x[0], x[1], x[2]).distance);
  });
}

FaceDistance sampledFace(const Mesh& M, const BoundaryFace& face, const CurvedBoundary& Omega,
                         double enough, double largest) {
  constexpr int steps = 5, finer = 11, most = 64;  // [choice] 18 points of each face, 93, 2142
  constexpr int middles = 2;  // [choice] of edges, too, where Π is fixed and bends most there
  FaceDistance d;
  if (Omega.isFixed) sampleFace(M, face, Omega, enough, middles, d);
  sampleFace(M, face, Omega, enough, steps, d);
  const double so = std::max(d.toSolid, d.toFace);
  if (enough > 0 && so > enough) return d;
  int wanted = so > nearLargest * std::max(enough, largest) ? finer : steps;
  if (enough > 0) {  // points on a large face no farther from each other than what is enough
    double longest = 0;
    for (int i = 0; i < 3; ++i)
      longest = std::max(longest, norm(M.x[face.n[i]] - M.x[face.n[(i + 1) % 3]]));
    const double spacing = wanted > steps ? enough / 3 : enough;
    wanted = std::max(wanted, static_cast<int>(std::min<double>(most, longest / spacing)));
  }
  if (wanted > steps) sampleFace(M, face, Omega, enough, wanted, d);
  return d;
}

/// ∂M over the 𝓤 of a patch.
struct FlatPatch {
  Parametrization flat;
  std::vector<const BoundaryFace*> of;  // [triangles]

  FlatPatch(const Mesh& M, const std::vector<BoundaryFace>& faces, int label) {
    for (const BoundaryFace& face : faces) {
      if (face.label != label) continue;
      const int first = static_cast<int>(flat.points.size());
      for (int j = 0; j < 3; ++j) {
        flat.points.push_back(M.x[face.n[j]]);
        flat.u.push_back(face.u[j]);
      }
      flat.triangles.push_back({first, first + 1, first + 2});
      of.push_back(&face);
    }
    buildLocator(flat);
  }
};

/// The distance of each point of a patch from the face that holds its parameter; of points on the
/// edges between them where that is large.
void measurePatch(const Mesh& M, const std::vector<BoundaryFace>& faces, int label, double enough,
                  BoundaryDistance& result) {
  constexpr int pieces = 4;  // [choice] of such an edge
  const Parametrization& P = surfaceOf(M, label);
  const FlatPatch F(M, faces, label);
  auto measure = [&](Vec3 x, Vec2 u) {
    const Location at = locate(F.flat, u);
    if (at.triangle < 0) return 0.;  // on the border of 𝓤, within rounding: a neighbour has it
    double d = norm(x - varphi(F.flat, at));
    const std::array<Vec3, 3> y = placesOf(M, F.of[at.triangle]->n);
    if (d > enough) d = closestPointOnTriangle(x, y[0], y[1], y[2]).distance;
    const BoundaryTriangle face = F.of[at.triangle]->at;
    double& ofFace = result.ofFace[face.E][face.i];
    ofFace = std::max(ofFace, d);
    result.toMesh = std::max(result.toMesh, d);
    return d;
  };
  std::vector<double> d(P.points.size());
  for (std::size_t k = 0; k < P.points.size(); ++k) d[k] = measure(P.points[k], P.u[k]);
  const double nearby = nearLargest * std::max(enough, result.toMesh);
  for (const std::array<int, 3>& t : P.triangles)
    for (int i = 0; i < 3; ++i) {
      const int a = t[i], b = t[(i + 1) % 3];
      if (a > b || std::max(d[a], d[b]) <= nearby) continue;  // an edge of two triangles once
      for (int k = 1; k < pieces; ++k) {
        const double part = double(k) / pieces;
        measure(P.points[a] + part * (P.points[b] - P.points[a]),
                P.u[a] + part * (P.u[b] - P.u[a]));
      }
    }
}

/// The distance of the faces of elements before a refinement; those that are left keep it.
struct KnownDistance {
  std::vector<std::array<int, 4>> tets;
  BoundaryDistance d;
};

/// distance(∂M, ∂Ω) with ∂Ω prepared.
BoundaryDistance distanceTo(const Mesh& M, const CurvedBoundary& Omega, double enough,
                            const KnownDistance& known = {}) {
  BoundaryDistance result;
  result.ofFace.assign(M.tets.size(), {0, 0, 0, 0});
  std::vector<BoundaryFace> faces;
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    const bool isKnown = E < known.tets.size() && known.tets[E] == M.tets[E];
    if (isKnown) result.ofFace[E] = known.d.ofFace[E];
    for (int i = 0; i < 4; ++i) {
      if (M.faceLabel[E][i] >= 0 || !Omega.curved[-M.faceLabel[E][i] - 1]) continue;
      if (!isKnown) faces.push_back(boundaryFace(M, {static_cast<int>(E), i}));
      if (isKnown) result.toSolid = std::max(result.toSolid, known.d.ofFace[E][i]);
    }
  }
  for (const BoundaryFace& face : faces) {
    const FaceDistance d =
        sampledFace(M, face, Omega, enough, std::max(result.toSolid, result.toMesh));
    result.ofFace[face.at.E][face.at.i] = std::max(d.toSolid, d.toFace);
    result.toSolid = std::max(result.toSolid, d.toSolid);
    result.toMesh = std::max(result.toMesh, d.toFace);
  }
  for (std::size_t p = 0; p < M.patches.size(); ++p)
    if (Omega.curved[p]) measurePatch(M, faces, -static_cast<int>(p) - 1, enough, result);
  return result;
}

}  // namespace

BoundaryDistance distance(const Mesh& M, double enough) {
  checkMeccano(M, "distance (§2)");
  return distanceTo(M, curvedBoundary(M), enough);
}

// ==== 2. Algorithm 1: refinement =================================================================

TriangleList getTrianglesToRefine(const Mesh& M, const BoundaryDistance& d, double eps) {
  TriangleList tau;
  if (d.ofFace.size() != M.tets.size())
    throw InputError("getTrianglesToRefine (§2): the distance is of " +
                     std::to_string(d.ofFace.size()) + " tetrahedra, the mesh has " +
                     std::to_string(M.tets.size()) + "; measure the distance of this mesh");
  for (int E = 0; E < static_cast<int>(M.tets.size()); ++E)
    for (int i = 0; i < 4; ++i)
      if (d.ofFace[E][i] > eps) tau.push_back({E, i});
  return tau;
}

TriangleList refineTriangles(Bisection& B, const TriangleList& tau) {
  const int nodes = static_cast<int>(B.M.x.size());
  std::vector<int> refine;
  for (const BoundaryTriangle& t : tau) refine.push_back(t.E);
  bisectOnce(B, refine);
  TriangleList tauNew;
  for (int E = 0; E < static_cast<int>(B.M.tets.size()); ++E)
    for (int i = 0; i < 4; ++i) {
      if (B.M.faceLabel[E][i] >= 0) continue;
      bool isNew = false;
      for (int n : B.M.tets[E]) isNew |= n >= nodes && n != B.M.tets[E][i];
      if (isNew) tauNew.push_back({E, i});
    }
  return tauNew;
}

void projectNewNodesToBoundary(Mesh& M, const TriangleList& tauNew) {
  for (const BoundaryTriangle& t : tauNew)
    for (int j = 1; j < 4; ++j) {
      const int n = M.tets[t.E][(t.i + j) % 4];
      if (M.dimension[n] == 2) M.x[n] = varphi(surfaceOf(M, M.entity[n]), M.parameter[n]);
      if (M.dimension[n] == 1) M.x[n] = gamma(M.curves[M.entity[n] - 1], M.parameter[n].x);
    }
}

// ==== 2. Algorithm 1: quality optimization =======================================================

namespace {

/// Nodes on the boundary.
std::vector<int> boundaryNodes(const Mesh& M) {
  std::vector<char> on(M.x.size(), 0);
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i)
      if (M.faceLabel[E][i] < 0)
        for (int j = 1; j < 4; ++j) on[M.tets[E][(i + j) % 4]] = 1;
  return markedOf(on);
}

/// [departure] A tetrahedron with two faces on ∂M flattens where Π makes its patch edge smooth, and
/// no position of its nodes helps. Its edge across is split, where the faces meet at a larger angle
/// than this.
constexpr double flatAngle = 120;  // degrees

/// Splits these edges; returns how many there were.
int splitFlatCorners(Bisection& B) {
  const Mesh& M = B.M;
  const double leastCosine = std::cos(flatAngle * std::acos(-1.) / 180);
  std::vector<std::pair<int, int>> across;
  for (const std::array<int, 4>& z : M.tets) {
    const std::array<int, 4>& label = M.faceLabel[&z - M.tets.data()];
    for (int i = 0; i < 4; ++i)
      for (int j = 0; j < i; ++j) {
        if (label[i] >= 0 || label[j] >= 0) continue;
        int edge[2], found = 0;
        for (int k = 0; k < 4; ++k)
          if (k != i && k != j) edge[found++] = z[k];
        const Vec3 a = M.x[edge[0]], axis = M.x[edge[1]] - a;
        const Vec3 u = cross(axis, M.x[z[i]] - a), v = cross(axis, M.x[z[j]] - a);
        if (dot(u, v) < leastCosine * norm(u) * norm(v)) across.push_back({z[i], z[j]});
      }
  }
  for (const auto& [a, b] : across) B.bisectEdge(a, b);
  return static_cast<int>(across.size());
}

/// What the mesher keeps while it works.
struct Mesher {
  Mesh& M;
  const MesherOptions& options;
  MesherReport& report;
  CurvedBoundary Omega;

  void progress(const std::string& line) const {
    if (options.onProgress) options.onProgress(line);
  }
  void stage(const char* name) const {
    if (options.onStage) options.onStage(name, M);
  }
};

constexpr double sampledEps = .97;  // [choice] of ε is held where it is sampled: 3 % for between

std::string sizeText(const Mesh& M) { return std::to_string(M.tets.size()) + " tetrahedra"; }

[[noreturn]] void refuseSize(const MesherOptions& options, double predicted) {
  throw InputError("meccanoMesher (§2): eps = " + number(options.eps) + " asks for about " +
                   number(predicted) + " tetrahedra, above the limit of " +
                   std::to_string(options.maxTets) + "; raise eps or maxTets");
}

/// The sum over a closed surface's edges of length × angle between the normals beside it. Sharp
/// edges, which a patch edge may follow at no cost, do not count.
double bendOf(const TriangleSurface& D) {
  constexpr double sharp = .6;                   // [choice] rad
  std::map<std::pair<int, int>, Vec3> normalAt;  // of the triangle to the left of an edge
  for (const std::array<int, 3>& t : D.triangles) {
    const Vec3 n = cross(D.points[t[1]] - D.points[t[0]], D.points[t[2]] - D.points[t[0]]);
    for (int e = 0; e < 3; ++e) normalAt[{t[e], t[(e + 1) % 3]}] = n;
  }
  double bend = 0;
  for (const auto& [edge, n] : normalAt) {
    const auto other = normalAt.find({edge.second, edge.first});
    if (edge.first > edge.second || other == normalAt.end()) continue;
    const double angle = std::atan2(norm(cross(n, other->second)), dot(n, other->second));
    if (angle < sharp) bend += norm(D.points[edge.second] - D.points[edge.first]) * angle;
  }
  return bend;
}

/// [choice] Tetrahedra of a solid's mesh, before any work: a face as long as s misses a bend by
/// s × bend / 8, so that their number goes with N = Σ length × bend / ε. Measured on spheres, bumps
/// and scans .97 N (N = 836), 1.4 (2500), 1.7 to 2.6 (8000 to 21000), 3 to 4.6 (25000 to 63000).
double predictedTets(const TriangleSurface& D, double eps) {
  constexpr double least = .9, reference = 836, power = .25, most = 5;
  const double N = bendOf(D) / eps;
  return N * std::min(most, least * std::max(1., std::pow(N / reference, power)));
}

/// The error of a face falls with its area: so many tetrahedra will be there at eps.
double predictedTets(const Mesh& M, const BoundaryDistance& d, double eps) {
  double faces = 0, wanted = 0;
  for (std::size_t E = 0; E < d.ofFace.size(); ++E)
    for (int i = 0; i < 4; ++i)
      if (M.faceLabel[E][i] < 0) ++faces, wanted += std::max(1., d.ofFace[E][i] / eps);
  return static_cast<double>(M.tets.size()) * wanted / std::max(faces, 1.);
}

/// [§2, Algorithm 1, lines 5 to 9] Refines and projects until the distance is at most eps. Returns
/// the number of passes.
int refineToDistance(Mesher& W, double eps) {
  constexpr int mostLevels = 90;             // [choice] 2^30 edges along one of a cube
  constexpr int maxPasses = 3 * mostLevels;  // a bisection need not split the face itself
  Bisection B(W.M);
  KnownDistance known;
  for (int pass = 0; pass < maxPasses; ++pass) {
    known.d = distanceTo(W.M, W.Omega, eps, known);
    known.tets = W.M.tets;
    const BoundaryDistance& d = known.d;
    if (d.largest() <= eps) return pass;
    const double predicted = predictedTets(W.M, d, eps);
    if (predicted > W.options.maxTets) refuseSize(W.options, predicted);
    const TriangleList tau = getTrianglesToRefine(W.M, d, eps);
    for (const BoundaryTriangle& t : tau)
      if (W.M.level[t.E] >= mostLevels)
        throw MethodError("meccanoMesher (§2): the boundary is still " + number(d.largest()) +
                          " from the solid after " + std::to_string(mostLevels) +
                          " bisections near " + placeText(W.M.x[W.M.tets[t.E][(t.i + 1) % 4]]) +
                          ", eps = " + number(W.options.eps) + "; raise eps");
    projectNewNodesToBoundary(W.M, refineTriangles(B, tau));
  }
  throw MethodError("meccanoMesher (§2): distance(∂M, ∂Ω) is above eps = " + number(W.options.eps) +
                    " after " + std::to_string(maxPasses) + " passes; raise eps");
}

/// Untangles with the boundary fixed, [departure] and where a few elements stay inverted, bisects
/// them for more freedom. Returns the number of inverted elements left.
int untangleFixed(Mesher& W, bool smooth) {
  constexpr int maxRounds = 10, patience = 2;  // rounds without fewer inverted elements
  OptimizeOptions optimize = W.options.optimize;
  optimize.starDelta = true;
  optimize.globalDescent = false;
  if (!smooth) optimize.power = 1;
  int fewest = static_cast<int>(W.M.tets.size()) + 1, waited = 0;
  for (int k = 0; k < maxRounds; ++k) {
    Bisection B(W.M);
    if (splitFlatCorners(B) == 0) break;
  }
  Mesh best;
  for (int round = 0;; ++round) {
    optimize.fixed = boundaryNodes(W.M);
    const int inverted = optimizeMesh(W.M, optimize).inverted;
    W.progress("fixed boundary: " + sizeText(W.M) + ", " + std::to_string(inverted) + " inverted");
    if (inverted == 0) return 0;
    if (inverted >= fewest)
      ++waited;
    else
      fewest = inverted, best = W.M;
    if (waited == patience || round == maxRounds) break;
    Bisection B(W.M);
    const std::vector<double> q = qualities(W.M);
    for (std::size_t E = 0; E < q.size(); ++E)
      if (q[E] <= 0) B.bisect(static_cast<int>(E));
  }
  W.M = std::move(best);
  return fewest;
}

/// The largest distance of Π from a flat face with one of its nodes at another place.
double movedFaceDistance(const Mesh& M, const BoundaryFace& face, double enough) {
  constexpr int steps = 4;  // [choice] 12 points
  const std::array<Vec3, 3> x = placesOf(M, face.n);
  const Parametrization& P = surfaceOf(M, face.label);
  double most = 0;
  forSamples(steps, [&](double a, double b, double c) {
    const Sampled at = sampled(P, x, face.u, a, b, c);
    double d = norm(at.onSolid - at.onFace);
    if (d > enough) d = closestPointOnTriangle(at.onSolid, x[0], x[1], x[2]).distance;
    most = std::max(most, d);
  });
  return most;
}

/// Keeps the curved faces of ∂M near Π while their nodes slide.
struct SlideGuard {
  Mesh& M;
  double allowed;
  std::vector<BoundaryTriangle> faces;
  std::vector<double> bound;              // [faces] of the distance, as far as it is known
  std::vector<std::vector<int>> facesAt;  // [nodes]

  SlideGuard(Mesher& W, double most) : M(W.M), allowed(most), facesAt(W.M.x.size()) {
    for (int E = 0; E < static_cast<int>(M.tets.size()); ++E)
      for (int i = 0; i < 4; ++i)
        if (M.faceLabel[E][i] < 0 && W.Omega.curved[-M.faceLabel[E][i] - 1]) {
          for (int j = 1; j < 4; ++j)
            facesAt[M.tets[E][(i + j) % 4]].push_back(static_cast<int>(faces.size()));
          faces.push_back({E, i});
        }
    bound.assign(faces.size(), 1e300);
  }
  /// Whether node n may move there: no face beside it gets farther than allowed and worse. Threads
  /// may ask at the same time for nodes that share no element, hence no face.
  bool accept(int n, Vec3 x, Vec2 parameter);
};

bool SlideGuard::accept(int n, Vec3 x, Vec2 parameter) {
  // [choice] A face's distance grows by this part of a node's step at most; by 2 were Π isometric.
  constexpr double growth = 3;
  const double step = growth * norm(x - M.x[n]);
  std::vector<double> after;
  for (int f : facesAt[n]) {
    after.push_back(bound[f] + step);
    if (after.back() <= allowed) continue;
    std::swap(M.x[n], x), std::swap(M.parameter[n], parameter);
    after.back() = movedFaceDistance(M, boundaryFace(M, faces[f]), allowed);
    std::swap(M.x[n], x), std::swap(M.parameter[n], parameter);
    if (after.back() > allowed &&
        after.back() >= movedFaceDistance(M, boundaryFace(M, faces[f]), allowed))
      return false;
  }
  for (std::size_t k = 0; k < after.size(); ++k) bound[facesAt[n][k]] = after[k];
  return true;
}

constexpr double stuckQuality = .3, stuckPart = 1.2;

/// A boundary that slides between refinements, at last, and once more where a few faces had to be
/// refined again.
enum class Slide { between, atLast, again };

/// Algorithm 2 on the nodes near the active ones (none given: on all); a boundary node is not
/// moved where a face beside it gets farther than allowed and worse. At last the worst elements are
/// lifted, and again where the lowest quality has fallen below that before.
OptimizeReport slideWithin(Mesher& W, double allowed, Slide slide,
                           const std::vector<int>& active = {}, double before = 0) {
  // [choice] Sweeps: what is left to do after these goes on for hundreds, at the kinks of Π.
  constexpr int sweepsBetween = 30, sweepsAtLast = 60, sweepsOfLift = 300;
  constexpr double restOfLift = .2;  // maxDisp before it: new nodes come to their places
  constexpr double keptPart = .95;   // of the lowest quality before: it need not be lifted again
  SlideGuard guard(W, allowed);
  OptimizeOptions optimize = W.options.optimize;
  optimize.globalDescent = false;
  optimize.starDelta = true;
  optimize.accept = [&](int n, Vec3 x, Vec2 parameter) { return guard.accept(n, x, parameter); };
  if (slide != Slide::again) {
    optimize.power = 1;
    optimize.maxSweeps = slide == Slide::between ? sweepsBetween : sweepsAtLast;
    const OptimizeReport report = optimizeMesh(W.M, optimize);
    if (slide == Slide::between || report.inverted > 0) return report;
  }
  optimize.active = active;
  optimize.maxDisp = restOfLift;
  optimize.maxSweeps = sweepsOfLift;
  if (slide == Slide::again) {
    optimize.power = 1;
    const OptimizeReport report = optimizeMesh(W.M, optimize);
    if (report.minQ > stuckQuality && report.minQ > keptPart * before) return report;
  }
  optimize.active.clear();  // the lift looks at all elements
  optimize.power = W.options.optimize.power;
  return optimizeMesh(W.M, optimize);
}

/// [choice] Inverted elements that a sliding boundary may free.
constexpr int fewTangled = 60;

/// [departure] Of ε, one after the other where the mesh refined to ε at once is tangled: each
/// starts from the valid mesh of the one before, whose boundary has slid into place, so that few
/// elements turn over at a time and long ways are gone on coarse meshes.
constexpr double approach[] = {16, 8, 4, 2, 1};

/// From the initial mesh to ε in these steps. Returns the number of inverted elements left.
int approachGradually(Mesher& W, const Mesh& initial) {
  int left = 0;
  W.M = initial;
  for (double factor : approach) {
    const double eps = factor * sampledEps * W.options.eps;
    refineToDistance(W, eps);
    const Mesh refined = W.M;
    left = untangleFixed(W, false);
    if (left > fewTangled) {
      W.M = refined;
      placeInterior(W.M);
      left = untangleFixed(W, false);
    }
    if (factor == 1 || W.options.fixedBoundary) continue;
    if (left <= fewTangled) left = slideWithin(W, eps, Slide::between).inverted;
    if (left > fewTangled) W.M = refined;
  }
  return left;
}

/// The first valid mesh, within eps but where its boundary has slid. Returns whether it has.
bool untangleWithin(Mesher& W, const Mesh& initial, double eps) {
  constexpr int maxRounds = 10;  // the last refinement may turn elements over again
  const bool fixed = W.options.fixedBoundary;
  placeInterior(W.M);
  const Mesh refined = W.M;
  if (!fixed && qualityStatistics(refined).inverted > 0 && approachGradually(W, initial) == 0)
    return true;
  const Mesh approached = W.M;
  W.M = refined;
  int left = untangleFixed(W, fixed);
  if (left > 0 && fixed) left = approachGradually(W, initial);
  if (left > 0 && !fixed) {
    W.M = approached;
    left = slideWithin(W, eps, Slide::between).inverted;
    if (left == 0) return true;
  }
  for (int round = 0; left == 0 && refineToDistance(W, eps) > 0 && round < maxRounds; ++round)
    left = untangleFixed(W, fixed);
  if (left > 0)
    throw MethodError("meccanoMesher (§2): " + std::to_string(left) +
                      " elements stay inverted with the boundary fixed; lower eps, or give a "
                      "polycube that fits the solid better");
  return false;
}

/// [choice] Of ε, in each round: farther faces must not get worse by sliding. First nodes slide
/// far, and what they leave is refined; in the end hardly any face exceeds ε.
constexpr double guards[] = {3, 2, .8, .8, .8, .8, .8, .8, .8};
constexpr int firstIfSlid = 1, firstOfLast = 2;  // the rounds from here on may be the last

/// [departure] Elements of lower quality that sweeps do not raise, most of them between boundary
/// nodes that the guard holds, are bisected: more nodes free them. But only those near the lowest.
/// Returns the number of these.
int bisectStuck(Mesher& W, double lowest) {
  if (lowest >= stuckQuality) return 0;
  Bisection B(W.M);
  const std::vector<double> q = qualities(W.M);
  int stuck = 0;
  for (std::size_t E = 0; E < q.size(); ++E) {
    bool held = false;
    for (int label : W.M.faceLabel[E]) held |= label < 0;
    if (held && q[E] < std::min(stuckQuality, stuckPart * lowest))
      B.bisect(static_cast<int>(E)), ++stuck;
  }
  return stuck;
}

/// Nodes of the tetrahedra at nodes from `first` on: where a refinement has been.
std::vector<int> nodesNearNew(const Mesh& M, std::size_t first) {
  std::vector<char> near(M.x.size(), 0);
  for (const std::array<int, 4>& z : M.tets)
    if (std::size_t(*std::max_element(z.begin(), z.end())) >= first)
      for (int n : z) near[n] = 1;
  return markedOf(near);
}

/// The valid mesh within eps of highest lowest quality so far; before the last rounds any.
struct BestMesh {
  Mesh M;
  double lowest = -1;     // none yet
  bool isSmooth = false;  // not refined since

  void keep(Mesher& W, double distance, double eps, int round, bool smooth) {
    const QualityStatistics q = qualityStatistics(W.M);
    const double reached = round > firstOfLast ? q.min : 0;
    if (q.inverted > 0 || reached < lowest || distance > eps) return;
    M = W.M, lowest = reached, isSmooth = smooth, W.report.rounds = round;
  }
};

/// Smooths the interior of a mesh that was refined at last; the boundary, which would leave eps
/// again, stays.
void smoothInterior(Mesher& W, double eps) {
  const Mesh refined = W.M;
  const double lowest = qualityStatistics(W.M).min;
  const int inverted = untangleFixed(W, true);
  if (inverted > 0 || qualityStatistics(W.M).min < lowest ||
      distanceTo(W.M, W.Omega, eps).largest() > eps)
    W.M = refined;
}

/// qualityOptimization with ∂Ω prepared; `initial` is the mesh before its refinement.
void optimizeQuality(Mesher& W, const Mesh& initial) {
  const double eps = sampledEps * W.options.eps;
  const bool slid = untangleWithin(W, initial, eps);
  W.report.untangled = qualityStatistics(W.M);
  W.stage("untangled");
  if (W.options.fixedBoundary) return;
  BestMesh best;
  best.keep(W, distanceTo(W.M, W.Omega, eps).largest(), eps, 0, false);
  std::vector<int> active;  // none: all
  Slide slide = Slide::between;
  double lowest = 0;
  const int rounds = static_cast<int>(std::size(guards));
  for (int round = slid ? firstIfSlid : 0; round < rounds; ++round) {
    const bool last = round >= firstOfLast;
    if (last && slide == Slide::between) slide = Slide::atLast;
    const OptimizeReport o = slideWithin(W, guards[round] * eps, slide, active, lowest);
    const double d = distanceTo(W.M, W.Omega, eps).largest();
    W.progress("round " + std::to_string(round + 1) + ": " + sizeText(W.M) + ", min " +
               number(o.minQ) + ", mean " + number(o.meanQ) + ", distance " + number(d) + ", " +
               std::to_string(o.inverted) + " inverted");
    best.keep(W, d, eps, round + 1, true);
    lowest = o.minQ;
    const std::size_t nodes = W.M.x.size();
    const int stuck = last && o.inverted == 0 ? bisectStuck(W, o.minQ) : 0;
    if (last && d <= eps && o.inverted == 0 && stuck == 0) break;
    refineToDistance(W, eps);
    // a few that stay are left to the next round, whose boundary slides
    const int inverted = untangleFixed(W, false);
    if (inverted > fewTangled) break;
    best.keep(W, distanceTo(W.M, W.Omega, eps).largest(), eps, round + 1, false);
    if (last) slide = stuck == 0 && inverted == 0 ? Slide::again : Slide::atLast;
    active = slide == Slide::again ? nodesNearNew(W.M, nodes) : std::vector<int>{};
  }
  if (best.lowest < 0)
    throw MethodError("meccanoMesher (§2): no mesh is valid and within eps = " +
                      number(W.options.eps) + " after " + std::to_string(rounds) +
                      " rounds; lower eps, or give a polycube that fits the solid better");
  W.M = std::move(best.M);
  if (!best.isSmooth) smoothInterior(W, eps);
}

void checkOptions(const MesherOptions& options) {
  constexpr int mostTets = 500000000;  // indices of four faces each fit in an int
  if (!(options.eps > 0) || !std::isfinite(options.eps))
    throw InputError("meccanoMesher (§2): eps = " + number(options.eps) + " must be above 0");
  if (options.maxTets < 1 || options.maxTets > mostTets)
    throw InputError("meccanoMesher (§2): maxTets = " + std::to_string(options.maxTets) +
                     " must be from 1 to " + std::to_string(mostTets));
  OptimizeOptions numbers = options.optimize;
  numbers.fixed.clear(), numbers.active.clear();  // of nodes that are not there yet
  checkOptions(numbers, 0);
}

}  // namespace

void qualityOptimization(Mesh& M, const MesherOptions& options, MesherReport& report) {
  checkMeccano(M, "qualityOptimization (§2)");
  checkOptions(options);
  Mesh work = M;
  Mesher W{work, options, report, curvedBoundary(M)};
  W.Omega.isFixed = options.fixedBoundary;
  optimizeQuality(W, M);
  M = std::move(work);
}

// ==== 2. Algorithm 1 =============================================================================

MesherReport meccanoMesher(Mesh& M, const MesherOptions& options) {
  checkMeccano(M, "meccanoMesher (§2)");
  checkOptions(options);
  MesherReport report;
  report.eps = options.eps;
  Mesh work = M;
  Mesher W{work, options, report, curvedBoundary(M)};
  W.Omega.isFixed = options.fixedBoundary;
  W.stage("initial");
  report.passes = refineToDistance(W, sampledEps * options.eps);
  report.refined = qualityStatistics(work);
  W.stage("refined");
  W.progress("refined: " + sizeText(work) + " after " + std::to_string(report.passes) +
             " passes, " + std::to_string(report.refined.inverted) + " inverted");
  optimizeQuality(W, M);
  report.distance = distanceTo(work, W.Omega, 0);
  report.smoothed = qualityStatistics(work);
  report.regular = qualityStatistics(work, Ideal::regular);
  for (unsigned char level : work.level) report.depth = std::max<int>(report.depth, level);
  W.stage("smoothed");
  M = std::move(work);
  return report;
}

MesherReport meccanoMesher(Mesh& M, const TriangleSurface& Omega, const MesherOptions& options) {
  checkOptions(options);
  std::vector<std::string> warnings;
  const TriangleSurface solid = checkSolid(Omega, warnings);
  const double predicted = predictedTets(solid, options.eps);
  if (predicted > options.maxTets) refuseSize(options, predicted);
  const Meccano D = options.meccano.cubes.empty() ? getMeccano(solid) : options.meccano;
  const BoundaryMapping Pi = getBoundaryMapping(D, solid);
  if (options.onProgress) {
    options.onProgress("meccano: " + counted(D.cubes.size(), "cube") + ", " +
                       std::to_string(Pi.patches.size()) + " patches, " +
                       counted(Pi.curves.size(), "patch edge"));
    for (const std::string& note : Pi.notes) options.onProgress(note);
  }
  Mesh work = getInitialMesh(D, Pi);
  MesherReport report = meccanoMesher(work, options);
  report.warnings.insert(report.warnings.begin(), warnings.begin(), warnings.end());
  M = std::move(work);
  return report;
}

MesherReport meccanoMesher(Mesh& M, const Terrain& Omega, const MesherOptions& options) {
  checkTerrain(Omega);
  checkOptions(options);
  const double allowed = bilinearPart * options.eps, missed = terrainDeviation(Omega, allowed);
  if (missed > .5 * options.eps)
    throw InputError("meccanoMesher (§2): eps = " + number(options.eps) +
                     " is too small for the terrain's grid, whose cells are twisted by " +
                     number(missed) + "; raise eps or refine the grid");
  MesherOptions rest = options;
  rest.eps = options.eps - missed;
  Mesh work = terrainMesh(Omega, allowed);
  MesherReport report = meccanoMesher(work, rest);
  report.eps = options.eps;
  M = std::move(work);
  return report;
}

// ==== 3.1 Problem statement =====================================================================

namespace {

/// Height over longest edge at and below which a triangle has zero area: coordinates are rounded by
/// 1e-16 of their size, so a smaller height says nothing.
constexpr double zeroHeight = 1e-14;

[[noreturn]] void refuseSurface(const std::string& what) {
  throw InputError("insertSurface (§3.1): " + what);
}

/// Refuses indices out of range, and coordinates that are not finite or no places.
void checkNumbers(const TriangleSurface& S) {
  constexpr double farthest = 1e20;  // [choice] length units: no-data values are larger
  const int points = static_cast<int>(S.points.size());
  const auto refusePoint = [&S](int n, const std::string& wanted) {
    refuseSurface("point " + std::to_string(n) + " has the coordinates " + placeText(S.points[n]) +
                  "; all coordinates must be " + wanted);
  };
  for (int n = 0; n < points; ++n)
    if (!isFinite(S.points[n])) refusePoint(n, "finite numbers");
  for (std::size_t t = 0; t < S.triangles.size(); ++t)
    for (int n : S.triangles[t]) {
      if (n < 0 || n >= points)
        refuseSurface("triangle " + std::to_string(t) + " names point " + std::to_string(n) +
                      ", but there are " + counted(points, "point") +
                      " (counted from 0); correct the index");
      const Vec3 p = S.points[n];
      if (std::max({std::abs(p.x), std::abs(p.y), std::abs(p.z)}) > farthest)
        refusePoint(n, "below 1e20, and no-data values left out");
    }
}

bool hasZeroArea(Vec3 a, Vec3 b, Vec3 c) {
  const double longest2 = std::max({norm2(b - a), norm2(c - b), norm2(a - c)});
  return norm(cross(b - a, c - a)) <= zeroHeight * longest2;
}

/// A surface while it is cleaned, and the number of each of its triangles in the user's data.
struct CleanSurface {
  TriangleSurface S;
  std::vector<int> origin;
};

/// Welds coincident points, drops duplicate and zero-area triangles, then the points nobody uses.
CleanSurface weldAndDrop(const TriangleSurface& S, std::vector<std::string>& warnings) {
  const int points = static_cast<int>(S.points.size());
  std::map<std::array<double, 3>, int> atPlace;
  std::vector<int> first(points), number(points, -1);  // first point at the place; number in C
  for (int n = 0; n < points; ++n) {
    const Vec3 p = S.points[n];
    first[n] = atPlace.insert({{p.x, p.y, p.z}, n}).first->second;
  }
  CleanSurface C{{{}, {}, S.name}, {}};
  std::set<std::array<int, 3>> seen;
  int duplicates = 0, flat = 0;
  for (std::size_t t = 0; t < S.triangles.size(); ++t) {
    std::array<int, 3> v = S.triangles[t];
    for (int& n : v) n = first[n];
    std::array<int, 3> key = v;
    std::sort(key.begin(), key.end());
    if (hasZeroArea(S.points[v[0]], S.points[v[1]], S.points[v[2]])) {
      ++flat;
    } else if (!seen.insert(key).second) {
      ++duplicates;
    } else {
      for (int n : v) number[n] = 0;
      C.S.triangles.push_back(v);
      C.origin.push_back(static_cast<int>(t));
    }
  }
  for (int n = 0; n < points; ++n) {
    if (number[n] < 0) continue;
    number[n] = static_cast<int>(C.S.points.size());
    C.S.points.push_back(S.points[n]);
  }
  for (std::array<int, 3>& v : C.S.triangles)
    for (int& n : v) n = number[n];
  const std::size_t unused = atPlace.size() - C.S.points.size();
  if (duplicates + flat + unused > 0)
    warnings.push_back("§3.1: dropped " + counted(duplicates, "duplicate triangle") + ", " +
                       counted(flat, "zero-area triangle") + " and " +
                       counted(unused, "unused point"));
  return C;
}

/// Refuses points where two fans of triangles meet only there. Corners 3 t + i of triangles that
/// share an edge belong to one fan.
void checkFans(const CleanSurface& C, const std::vector<std::array<int, 3>>& neighbours) {
  const std::vector<std::array<int, 3>>& triangles = C.S.triangles;
  Parts fans(3 * triangles.size());
  for (int t = 0; t < static_cast<int>(triangles.size()); ++t)
    for (int i = 0; i < 3; ++i) {
      const int s = neighbours[t][i];
      if (s < 0) continue;
      for (int j : {i, (i + 1) % 3})
        fans.join(3 * t + j, 3 * s + cornerAt(triangles[s], triangles[t][j]));
    }
  std::vector<int> fan(C.S.points.size(), -1);
  for (int c = 0; c < static_cast<int>(3 * triangles.size()); ++c) {
    const int n = triangles[c / 3][c % 3];
    if (fan[n] < 0) fan[n] = fans.of(c);
    if (fan[n] != fans.of(c))
      refuseSurface("the point " + placeText(C.S.points[n]) + " is non-manifold: triangles " +
                    std::to_string(C.origin[fan[n] / 3]) + " and " +
                    std::to_string(C.origin[c / 3]) +
                    " meet only there; separate or join the two parts");
  }
}

/// The number of triangles of each edge-connected component, descending.
std::vector<int> componentSizes(const std::vector<std::array<int, 3>>& neighbours) {
  Parts parts(neighbours.size());
  for (int t = 0; t < static_cast<int>(neighbours.size()); ++t)
    for (int s : neighbours[t])
      if (s >= 0) parts.join(t, s);
  std::vector<int> sizes(neighbours.size(), 0);
  for (int t = 0; t < static_cast<int>(neighbours.size()); ++t) ++sizes[parts.of(t)];
  std::sort(sizes.rbegin(), sizes.rend());
  sizes.erase(std::find(sizes.begin(), sizes.end(), 0), sizes.end());
  return sizes;
}

void checkOnePart(const std::vector<std::array<int, 3>>& neighbours, const std::string& advice) {
  const std::vector<int> sizes = componentSizes(neighbours);
  if (sizes.size() > 1)
    refuseSurface("the surface has " + std::to_string(sizes.size()) +
                  " components (the largest of " + std::to_string(sizes[0]) + ", the smallest of " +
                  std::to_string(sizes.back()) + " triangles); " + advice);
}

/// Turns triangles until all agree, the minority if there is one; S is connected.
///   returns how many were turned, or -1 at a Möbius band
int orientConsistently(TriangleSurface& S, const std::vector<std::array<int, 3>>& neighbours) {
  const int N = static_cast<int>(S.triangles.size());
  std::vector<int> turn(N, -1), queue{0};
  turn[0] = 0;
  for (std::size_t q = 0; q < queue.size(); ++q) {
    const int t = queue[q];
    for (int i = 0; i < 3; ++i) {
      const int s = neighbours[t][i];
      if (s < 0) continue;
      const int a = S.triangles[t][i], b = S.triangles[t][(i + 1) % 3];
      const bool agree = S.triangles[s][(cornerAt(S.triangles[s], b) + 1) % 3] == a;
      const int wanted = agree ? turn[t] : 1 - turn[t];
      if (turn[s] < 0) queue.push_back(s);
      if (turn[s] == 1 - wanted) return -1;
      turn[s] = wanted;
    }
  }
  const int ones = static_cast<int>(std::count(turn.begin(), turn.end(), 1));
  const int minority = ones > N / 2 ? 0 : 1;
  for (int t = 0; t < N; ++t)
    if (turn[t] == minority) std::swap(S.triangles[t][1], S.triangles[t][2]);
  return std::min(ones, N - ones);
}

/// The same with a warning of the section that asks for it. False at a Möbius band.
bool orient(TriangleSurface& S, const std::vector<std::array<int, 3>>& neighbours,
            const std::string& section, std::vector<std::string>& warnings) {
  const int turned = orientConsistently(S, neighbours);
  if (turned > 0)
    warnings.push_back(section + ": turned " + counted(turned, "triangle") +
                       " to give the surface a single orientation");
  return turned >= 0;
}

/// Refuses what is no disk: S is connected, manifold and oriented.
void checkDisk(const TriangleSurface& S) {
  const std::vector<std::vector<int>> rims = rimLoops(S);
  if (rims.empty())
    refuseSurface("the surface is closed (" + counted(S.triangles.size(), "triangle") +
                  ", no rim); cut it open or insert a part of it");
  if (rims.size() > 1) {
    const auto shortest = std::min_element(
        rims.begin(), rims.end(), [](const auto& a, const auto& b) { return a.size() < b.size(); });
    refuseSurface("the surface has holes: " + std::to_string(rims.size()) +
                  " rims, the shortest of " + std::to_string(shortest->size()) + " edges at " +
                  placeText(S.points[shortest->front()]) + "; fill the holes, one rim must remain");
  }
  const int edges = static_cast<int>(3 * S.triangles.size() + rims[0].size()) / 2;
  const int euler = static_cast<int>(S.points.size() + S.triangles.size()) - edges;
  if (euler != 1)
    refuseSurface("the surface has " + counted((1 - euler) / 2, "handle") +
                  " (Euler characteristic " + std::to_string(euler) +
                  ", a disk has 1); cut it into disks");
}

}  // namespace

std::vector<std::array<int, 3>> triangleNeighbours(const TriangleSurface& S,
                                                   const std::vector<int>& number) {
  // The edges by the end at which fewer triangles meet: the other end, 3 t + i of those that use
  // it. The sum of these smaller degrees is linear on every surface.
  struct Edge {
    int far, first, second;
  };
  std::vector<int> degree(S.points.size(), 0), start(S.points.size() + 1, 0);
  for (const std::array<int, 3>& t : S.triangles)
    for (int n : t) ++degree[n];
  auto ends = [&](int c) {
    const int a = S.triangles[c / 3][c % 3], b = S.triangles[c / 3][(c + 1) % 3];
    const bool fromA = std::tie(degree[a], a) < std::tie(degree[b], b);
    return fromA ? std::pair(a, b) : std::pair(b, a);
  };
  const int uses = static_cast<int>(3 * S.triangles.size());
  for (int c = 0; c < uses; ++c) ++start[ends(c).first + 1];
  std::partial_sum(start.begin(), start.end(), start.begin());
  std::vector<Edge> edges(uses);
  std::vector<int> filled(start.begin(), start.end() - 1);
  auto name = [&](int c) { return std::to_string(number.empty() ? c / 3 : number[c / 3]); };
  std::vector<std::array<int, 3>> neighbours(S.triangles.size(), {-1, -1, -1});
  for (int c = 0; c < uses; ++c) {
    const auto [near, far] = ends(c);
    int e = start[near];
    while (e < filled[near] && edges[e].far != far) ++e;
    if (e == filled[near]) {
      edges[filled[near]++] = {far, c, -1};
      continue;
    }
    const int first = edges[e].first, second = std::exchange(edges[e].second, c);
    if (second >= 0)
      refuseSurface("the edge from " + placeText(S.points[std::min(near, far)]) + " to " +
                    placeText(S.points[std::max(near, far)]) + " is non-manifold: triangles " +
                    name(first) + ", " + name(second) + " and " + name(c) +
                    " share it; split the surface there into several");
    neighbours[first / 3][first % 3] = c / 3;
    neighbours[c / 3][c % 3] = first / 3;
  }
  return neighbours;
}

std::vector<std::vector<int>> rimLoops(const TriangleSurface& S) {
  const std::vector<std::array<int, 3>> neighbours = triangleNeighbours(S);
  std::vector<int> next(S.points.size(), -1);
  for (std::size_t t = 0; t < S.triangles.size(); ++t)
    for (int i = 0; i < 3; ++i)
      if (neighbours[t][i] < 0) next[S.triangles[t][i]] = S.triangles[t][(i + 1) % 3];
  std::vector<std::vector<int>> loops;
  for (int start = 0; start < static_cast<int>(next.size()); ++start) {
    if (next[start] < 0) continue;
    loops.emplace_back();
    for (int n = start; next[n] >= 0;) {
      loops.back().push_back(n);
      n = std::exchange(next[n], -1);
    }
  }
  return loops;
}

std::vector<TriangleSurface> connectedComponents(const TriangleSurface& S,
                                                 std::vector<std::string>& warnings) {
  checkNumbers(S);
  std::vector<std::string> repairs;
  const TriangleSurface welded = weldAndDrop(S, repairs).S;
  Parts parts(welded.points.size());
  for (const std::array<int, 3>& t : welded.triangles) {
    parts.join(t[0], t[1]);
    parts.join(t[1], t[2]);
  }
  std::vector<TriangleSurface> components;
  std::vector<int> componentOf(welded.points.size(), -1), numberOf(welded.points.size(), -1);
  for (const std::array<int, 3>& t : welded.triangles) {
    int& c = componentOf[parts.of(t[0])];
    if (c < 0) {
      c = static_cast<int>(components.size());
      const std::string number = std::to_string(c + 1);
      components.push_back({{}, {}, S.name.empty() ? number : S.name + '.' + number});
    }
    TriangleSurface& C = components[c];
    std::array<int, 3> v = t;
    for (int& n : v) {
      int& number = numberOf[n];
      if (number < 0) {
        number = static_cast<int>(C.points.size());
        C.points.push_back(welded.points[n]);
      }
      n = number;
    }
    C.triangles.push_back(v);
  }
  if (components.size() < 2) return {S};
  warnings = repairs;
  warnings.push_back("§3.1: '" + S.name + "' has " + std::to_string(components.size()) +
                     " components; each becomes a surface: " + components.front().name + " to " +
                     components.back().name);
  return components;
}

TriangleSurface weldSurface(const TriangleSurface& S, std::vector<std::string>& warnings) {
  checkNumbers(S);
  return weldAndDrop(S, warnings).S;
}

TriangleSurface checkSurface(const TriangleSurface& S, std::vector<std::string>& warnings) {
  checkNumbers(S);
  CleanSurface C = weldAndDrop(S, warnings);
  if (S.triangles.empty()) refuseSurface("the surface is empty; give at least one triangle");
  if (C.S.triangles.empty())
    refuseSurface("the surface is empty: all its " + std::to_string(S.triangles.size()) +
                  " triangles have zero area; check its coordinates");
  const std::vector<std::array<int, 3>> neighbours = triangleNeighbours(C.S, C.origin);
  checkFans(C, neighbours);
  checkOnePart(neighbours, "insert them one by one, or by insertSurfaces");
  if (!orient(C.S, neighbours, "§3.1", warnings))
    refuseSurface("the surface is not orientable (a Moebius band); cut it open");
  checkDisk(C.S);
  return C.S;
}

namespace {

/// Refuses open edges, several components and surfaces that cannot be oriented; orients the rest
/// outward.
void checkClosed(CleanSurface& C, std::vector<std::string>& warnings) {
  TriangleSurface& S = C.S;
  const std::vector<std::array<int, 3>> neighbours = triangleNeighbours(S, C.origin);
  for (std::size_t t = 0; t < neighbours.size(); ++t)
    for (int i = 0; i < 3; ++i)
      if (neighbours[t][i] < 0)
        refuseSurface("the surface is open: only triangle " + std::to_string(C.origin[t]) +
                      " has the edge from " + placeText(S.points[S.triangles[t][i]]) + " to " +
                      placeText(S.points[S.triangles[t][(i + 1) % 3]]) + "; close it");
  checkFans(C, neighbours);
  checkOnePart(neighbours, "mesh them one by one");
  if (!orient(S, neighbours, "§2", warnings))
    refuseSurface("the surface is not orientable; it bounds no solid");
  double volume = 0, area = 0;
  for (const std::array<int, 3>& t : S.triangles) {
    const Vec3 a = S.points[t[0]] - S.points[0], b = S.points[t[1]] - S.points[0],
               c = S.points[t[2]] - S.points[0];
    volume += dot(a, cross(b, c)) / 6;
    area += norm(cross(b - a, c - a)) / 2;
  }
  constexpr double thinnest = 1e-10;  // volume over area^1.5: rounding below
  if (std::abs(volume) <= thinnest * area * std::sqrt(area))
    refuseSurface("the surface encloses no volume; check its coordinates");
  if (volume > 0) return;
  for (std::array<int, 3>& t : S.triangles) std::swap(t[1], t[2]);
}

}  // namespace

TriangleSurface checkSolid(const TriangleSurface& D, std::vector<std::string>& warnings) {
  try {
    checkNumbers(D);
    CleanSurface C = weldAndDrop(D, warnings);
    if (C.S.triangles.empty())
      refuseSurface(D.triangles.empty() ? "the surface is empty; give the triangles of a solid"
                                        : "the surface is empty: all its triangles have zero area; "
                                          "check its coordinates");
    checkClosed(C, warnings);
    const std::vector<Crossing> crossings = selfCrossings(C.S);
    if (!crossings.empty())
      warnings.push_back(
          "§2: the surface crosses itself: " + counted(static_cast<int>(crossings.size()), "pair") +
          " of triangles, the first at " + placeText(crossings[0].point) +
          "; the mesh may overlap there");
    return C.S;
  } catch (const InputError& e) {  // the tools of §3.1 speak of an insertion
    const std::string text = e.what(), prefix = "insertSurface (§3.1): ";
    throw InputError("checkSolid (§2): " +
                     (text.rfind(prefix, 0) == 0 ? text.substr(prefix.size()) : text));
  }
}

int genusOf(const TriangleSurface& D) {
  return (2 - static_cast<int>(D.points.size()) + static_cast<int>(D.triangles.size()) / 2) / 2;
}

// ==== Tools for 3.2 and 3.4: distance to S ======================================================

namespace {

constexpr double beyondAll = 1e300;  // beyond every coordinate; its square is infinite
constexpr int queryPiece = 512;      // queries of a task for one thread: some 300 μs
constexpr int trianglesPerLeaf = 2;
/// Whether a box is farther than the bound, by more than rounding; a negative bound: always.
bool isFarther(double distance2, double bound) {
  constexpr double rounding = 2e-12;  // relative, of squared distances
  return distance2 > bound * std::abs(bound) * (1 + rounding);
}

/// Takes the nearest point of the edge from corner i to the next over into best if it is nearer.
void keepNearerOnEdge(Vec3 x, const std::array<Vec3, 3>& corner, int i, ClosestPoint& best) {
  const int j = (i + 1) % 3;
  const Vec3 a = corner[i], b = corner[j], d = b - a;
  const double length2 = norm2(d);
  const double t = length2 > 0 ? std::clamp(dot(x - a, d) / length2, 0.0, 1.0) : 0;
  const Vec3 p = t < .5 ? a + t * d : b - (1 - t) * d;  // exact at both ends
  const double distance = norm(x - p);
  if (distance >= best.distance) return;
  const bool inside = t > 0 && t < 1;
  best = {distance, p, 0, {0, 0, 0}, inside ? Feature::edge : Feature::vertex, t < 1 ? i : j};
  best.w[i] = 1 - t;
  best.w[j] = t;
}

/// Distance of two boxes, squared, 0 where they meet; a point is a box too.
inline double boxDistance2(const TriangleTree::Box& a, const TriangleTree::Box& b) {
  const Vec3 after = a.lo - b.hi, before = b.lo - a.hi;
  return norm2(Vec3{std::max(std::max(after.x, before.x), 0.),
                    std::max(std::max(after.y, before.y), 0.),
                    std::max(std::max(after.z, before.z), 0.)});
}

/// A triangle's number and the centre of its box.
struct Centre {
  Vec3 at;
  int triangle;
};

/// Recursive median split of centres[first, last) along the longest side of their box.
void buildTreeNode(TriangleTree& tree, const std::vector<TriangleTree::Box>& boxes,
                   std::vector<Centre>& centres, int first, int last) {
  const int self = static_cast<int>(tree.nodes.size());
  if (last - first <= trianglesPerLeaf) {
    TriangleTree::Box box = boxes[centres[first].triangle];
    for (int i = first; i < last; ++i) {
      growBox(box, boxes[centres[i].triangle].lo);
      growBox(box, boxes[centres[i].triangle].hi);
    }
    tree.nodes.push_back({box, first, last - first, -1});
    return;
  }
  TriangleTree::Box middle{centres[first].at, centres[first].at};
  for (int i = first; i < last; ++i) growBox(middle, centres[i].at);
  const Vec3 d = middle.hi - middle.lo;
  double Vec3::*axis = d.x >= d.y && d.x >= d.z ? &Vec3::x : d.y >= d.z ? &Vec3::y : &Vec3::z;
  const int half = (first + last) / 2;
  std::nth_element(centres.begin() + first, centres.begin() + half, centres.begin() + last,
                   [axis](const Centre& a, const Centre& b) {
                     return std::make_pair(a.at.*axis, a.triangle) <
                            std::make_pair(b.at.*axis, b.triangle);
                   });
  tree.nodes.push_back({});
  buildTreeNode(tree, boxes, centres, first, half);
  const int right = static_cast<int>(tree.nodes.size());
  buildTreeNode(tree, boxes, centres, half, last);
  TriangleTree::Box box = tree.nodes[self + 1].box;
  growBox(box, tree.nodes[right].box.lo);
  growBox(box, tree.nodes[right].box.hi);
  tree.nodes[self] = {box, first, 0, right};
}

/// Calls visit(i) for the triangles (in tree order) of leaves not farther from `box` than `bound`,
/// which visit() lowers; the nearer child first.
template <class Visit>
void visitNearest(const TriangleTree& tree, const TriangleTree::Box& box, const double& bound,
                  const Visit& visit) {
  struct Pending {
    int node;
    double distance2;
  };
  Pending pending[64];  // each level halves the triangles: 32 levels at most
  int count = 0;
  if (!tree.nodes.empty()) pending[count++] = {0, boxDistance2(tree.nodes[0].box, box)};
  while (count > 0) {
    Pending at = pending[--count];
    while (!isFarther(at.distance2, bound)) {
      const TriangleTree::Node& node = tree.nodes[at.node];
      for (int i = node.first; i < node.first + node.count; ++i) visit(i);
      if (node.count > 0) break;
      Pending far{node.right, boxDistance2(tree.nodes[node.right].box, box)};
      at = {at.node + 1, boxDistance2(tree.nodes[at.node + 1].box, box)};
      if (far.distance2 < at.distance2) std::swap(at, far);
      if (!isFarther(far.distance2, bound)) pending[count++] = far;
    }
  }
}

}  // namespace

TriangleTree::Box boxOf(const std::array<Vec3, 3>& corners) {
  TriangleTree::Box box{corners[0], corners[0]};
  growBox(box, corners[1]);
  growBox(box, corners[2]);
  return box;
}

ClosestPoint closestPointOnTriangle(Vec3 x, Vec3 a, Vec3 b, Vec3 c) {
  // The foot of the perpendicular: w are the areas seen from it. The nearest point lies on an edge
  // only if the foot is beyond it (or so near that rounding decides; n = 0 gives no number).
  constexpr double nearEdge = 1e-6;
  const Vec3 n = cross(b - a, c - a);
  const double n2 = norm2(n);
  const double w1 = dot(cross(x - a, c - a), n) / n2, w2 = dot(cross(b - a, x - a), n) / n2;
  const double w0 = 1 - w1 - w2;
  ClosestPoint best{beyondAll, a, 0, {1, 0, 0}, Feature::vertex, 0};
  if (!(w2 > nearEdge)) keepNearerOnEdge(x, {a, b, c}, 0, best);
  if (!(w0 > nearEdge)) keepNearerOnEdge(x, {a, b, c}, 1, best);
  if (!(w1 > nearEdge)) keepNearerOnEdge(x, {a, b, c}, 2, best);
  if (!(w0 > 0 && w1 > 0 && w2 > 0)) return best;
  const Vec3 p = a + (w1 * (b - a) + w2 * (c - a));
  const double distance = norm(x - p);
  if (distance < best.distance) best = {distance, p, 0, {w0, w1, w2}, Feature::face, 0};
  return best;
}

TriangleTree::TriangleTree(const std::vector<Vec3>& x, const std::vector<std::array<int, 3>>& all) {
  const auto cornersAt = [&](int t) {
    return std::array<Vec3, 3>{x[all[t][0]], x[all[t][1]], x[all[t][2]]};
  };
  const int count = static_cast<int>(all.size());
  std::vector<Box> boxes;
  std::vector<Centre> centres;
  for (int t = 0; t < count; ++t) {
    boxes.push_back(boxOf(cornersAt(t)));
    centres.push_back({.5 * (boxes[t].lo + boxes[t].hi), t});
  }
  if (count > 0) buildTreeNode(*this, boxes, centres, 0, count);
  triangles.reserve(all.size());
  for (const Centre& centre : centres)
    triangles.emplace_back(centre.triangle, all[centre.triangle], cornersAt(centre.triangle));
}

TreeTriangle::TreeTriangle(int inputNumber, const std::array<int, 3>& numbers,
                           const std::array<Vec3, 3>& c)
    : corners(c),
      number(inputNumber),
      points(numbers),
      n_(cross(c[0] - c[2], c[1] - c[0])),
      inward0_(cross(n_, c[1] - c[0])),
      inward2_(cross(n_, c[0] - c[2])),
      n2_(norm2(n_)),
      length2_{norm2(c[1] - c[0]), norm2(c[2] - c[1]), norm2(c[0] - c[2])} {
  constexpr double needleSine = 1e-3;  // of the angle at corner 0
  isNeedle_ = !(n2_ > needleSine * needleSine * length2_[0] * length2_[2]);
}

bool TreeTriangle::isWithin(Vec3 x, double distance) const {
  constexpr double rounding = 1e-9;  // of n and what follows, with room
  const std::array<Vec3, 3>& c = corners;
  if (isNeedle_) return closestPointOnTriangle(x, c[0], c[1], c[2]).distance <= distance;
  const Vec3 p = x - c[0];
  const double height = dot(p, n_), allowed2 = distance * distance * n2_;
  // what the distance to the triangle's plane leaves in it, squared, times n2_
  const double beside2 = (1 + rounding) * allowed2 - height * height;
  if (beside2 < 0) return false;
  // the foot's barycentric coordinates, times n2_: those that are 0 on edges 0, 1, 2
  const double w0 = dot(p, inward0_), w2 = dot(p, inward2_);
  const std::array<double, 3> w{w0, n2_ - w0 - w2, w2};
  for (int k = 0; k < 3; ++k)
    if (w[k] < 0 && w[k] * w[k] > beside2 * length2_[k]) return false;  // of the edge's line
  if (w[0] > 0 && w[1] > 0 && w[2] > 0 && height * height <= allowed2) return true;
  for (int k = 0; k < 3; ++k) {
    const Vec3 q = x - c[k], edge = c[(k + 1) % 3] - c[k];
    const double along = dot(q, edge);
    const double t = along <= 0 ? 0 : along >= length2_[k] ? 1 : along / length2_[k];
    if (norm2(q - t * edge) <= distance * distance) return true;
  }
  return false;
}

ClosestPoint TriangleTree::closest(Vec3 x, double within) const {
  ClosestPoint best{within, x, -1, {0, 0, 0}, Feature::face, 0};
  if (nodes.empty()) return best;
  // so much nearer isWithin() sees for certain, and equal distances go to the lowest triangle
  constexpr double ofDistance = 1e-9, ofDiagonal = 1e-12, ofCoordinates = 1e-15;
  const Box& box = nodes[0].box;
  const double rounding =
      ofDiagonal * norm(box.hi - box.lo) + ofCoordinates * (norm(box.hi) + norm(box.lo));
  visitNearest(*this, {x, x}, best.distance, [&](int i) {
    if (!triangles[i].isWithin(x, (1 + ofDistance) * best.distance + rounding)) return;
    const std::array<Vec3, 3>& c = triangles[i].corners;
    ClosestPoint p = closestPointOnTriangle(x, c[0], c[1], c[2]);
    p.triangle = triangles[i].number;
    const bool lower = p.distance == best.distance && p.triangle < best.triangle;
    if (p.distance < best.distance || lower) best = p;
  });
  return best;
}

namespace {

Vec3 unitVector(Vec3 v) {
  const double length = norm(v);
  return length > 0 ? (1 / length) * v : v;
}

}  // namespace

SurfaceDistance::SurfaceDistance(const TriangleSurface& cleaned)
    : S(cleaned),
      tree(S.points, S.triangles),
      faceNormal(S.triangles.size()),
      edgeNormal(S.triangles.size()),
      vertexNormal(S.points.size()),
      neighbours(triangleNeighbours(S)),
      isRimPoint(S.points.size(), 0) {
  const std::vector<std::vector<int>> rims = rimLoops(S);
  if (rims.size() != 1)
    throw InputError("SurfaceDistance: the surface has " + std::to_string(rims.size()) +
                     " rims; call checkSurface() first");
  rim = rims[0];
  std::vector<std::array<int, 3>> segments;  // as triangles with a double corner
  for (std::size_t i = 0; i < rim.size(); ++i) {
    const int b = rim[(i + 1) % rim.size()];
    segments.push_back({rim[i], b, b});
    isRimPoint[rim[i]] = 1;
  }
  rimTree = TriangleTree(S.points, segments);

  // Angle-weighted pseudo-normals: their side is right at every nearest point (Baerentzen and
  // Aanaes 2005).
  for (std::size_t t = 0; t < S.triangles.size(); ++t) {
    const std::array<int, 3>& v = S.triangles[t];
    for (int i = 0; i < 3; ++i) {
      const Vec3 a = S.points[v[(i + 1) % 3]] - S.points[v[i]];
      const Vec3 b = S.points[v[(i + 2) % 3]] - S.points[v[i]], n = cross(a, b);
      if (i == 0) faceNormal[t] = unitVector(n);
      vertexNormal[v[i]] += std::atan2(norm(n), dot(a, b)) * faceNormal[t];
    }
  }
  for (std::size_t t = 0; t < S.triangles.size(); ++t)
    for (int i = 0; i < 3; ++i) {
      const int s = neighbours[t][i];
      edgeNormal[t][i] = s < 0 ? faceNormal[t] : unitVector(faceNormal[t] + faceNormal[s]);
    }
  for (Vec3& n : vertexNormal) n = unitVector(n);
}

SurfaceQuery SurfaceDistance::query(Vec3 x) const {
  const ClosestPoint p = tree.closest(x);
  SurfaceQuery q{p, faceNormal[p.triangle], 0, false, 0};
  if (p.feature == Feature::edge) {
    q.normal = edgeNormal[p.triangle][p.which];
    q.onRim = neighbours[p.triangle][p.which] < 0;
  } else if (p.feature == Feature::vertex) {
    const int n = S.triangles[p.triangle][p.which];
    q.normal = vertexNormal[n];
    q.onRim = isRimPoint[n] != 0;
  }
  const Vec3 d = x - p.point;
  q.side = dot(d, q.normal);
  if (q.onRim) q.excess = norm(d - q.side * q.normal);
  return q;
}

double SurfaceDistance::rimDistance(Vec3 x) const { return rimTree.closest(x).distance; }

namespace {

/// The points a + s (b − a) and c + t (d − c) where two lines are nearest, if both are inside the
/// segments: false elsewhere, where an end is nearest.
bool nearestInside(Vec3 a, Vec3 b, Vec3 c, Vec3 d, Vec3& onAB, Vec3& onCD) {
  const Vec3 u = b - a, v = d - c, r = a - c;
  const double uu = norm2(u), vv = norm2(v), uv = dot(u, v), D = uu * vv - uv * uv;
  const double s = (uv * dot(v, r) - vv * dot(u, r)) / D;
  const double t = (uu * dot(v, r) - uv * dot(u, r)) / D;
  onAB = a + s * u;
  onCD = c + t * v;
  return D > 0 && s >= 0 && s <= 1 && t >= 0 && t <= 1;
}

/// Whether the segment pq crosses the triangle; `at` is where.
bool segmentCrosses(Vec3 p, Vec3 q, const std::array<Vec3, 3>& t, Vec3& at) {
  const Vec3 n = cross(t[1] - t[0], t[2] - t[0]);
  const double dp = dot(p - t[0], n), dq = dot(q - t[0], n);
  if ((dp > 0 && dq > 0) || (dp < 0 && dq < 0) || dp == dq) return false;
  at = p + (dp / (dp - dq)) * (q - p);
  for (int i = 0; i < 3; ++i)
    if (dot(cross(t[(i + 1) % 3] - t[i], at - t[i]), n) < 0) return false;
  return true;
}

/// Distance of two triangles and the nearest point of A: 0 at a crossing, else corners to triangles
/// and insides of edges to each other.
double trianglesDistance(const std::array<Vec3, 3>& A, const std::array<Vec3, 3>& B, Vec3& onA) {
  double best = beyondAll;
  auto keep = [&](double distance, Vec3 p) {
    if (distance >= best) return;
    best = distance;
    onA = p;
  };
  for (int i = 0; i < 3; ++i) {
    const Vec3 a = A[i], aNext = A[(i + 1) % 3];
    Vec3 p, q;
    if (segmentCrosses(a, aNext, B, p) || segmentCrosses(B[i], B[(i + 1) % 3], A, p)) keep(0, p);
    const ClosestPoint nearest = closestPointOnTriangle(B[i], A[0], A[1], A[2]);
    keep(nearest.distance, nearest.point);
    keep(closestPointOnTriangle(a, B[0], B[1], B[2]).distance, a);
    for (int j = 0; j < 3; ++j)
      if (nearestInside(a, aNext, B[j], B[(j + 1) % 3], p, q)) keep(norm(p - q), p);
  }
  return best;
}

std::array<Vec3, 3> cornersOf(const TriangleSurface& S, int t) {
  const std::array<int, 3>& v = S.triangles[t];
  return {S.points[v[0]], S.points[v[1]], S.points[v[2]]};
}

double areaOf(const TriangleSurface& S, int t) {
  const std::array<Vec3, 3> c = cornersOf(S, t);
  return .5 * norm(cross(c[1] - c[0], c[2] - c[0]));
}

double areaOf(const TriangleSurface& S) {
  double area = 0;
  for (int t = 0; t < static_cast<int>(S.triangles.size()); ++t) area += areaOf(S, t);
  return area;
}

/// Whether two triangles cross or touch beyond what they share: an edge of one, without a point of
/// the other, meets the other. Those with a common edge do not.
bool trianglesCross(const TriangleSurface& S, int t, int s, Vec3& at) {
  const std::array<int, 3>&T = S.triangles[t], &U = S.triangles[s];
  const auto isShared = [](const std::array<int, 3>& v, int n) { return cornerAt(v, n) < 3; };
  if (isShared(U, T[0]) + isShared(U, T[1]) + isShared(U, T[2]) > 1) return false;
  for (int i = 0; i < 3; ++i)
    for (const auto& [A, B, b] : {std::tuple(T, U, s), std::tuple(U, T, t)}) {
      const int m = A[i], n = A[(i + 1) % 3];
      if (!isShared(B, m) && !isShared(B, n) &&
          segmentCrosses(S.points[m], S.points[n], cornersOf(S, b), at))
        return true;
    }
  return false;
}

/// A triangle (in tree order) that is not farther than this from x, the first one found; -1: none.
int triangleWithin(const TriangleTree& tree, Vec3 x, double distance) {
  double bound = distance;  // −1 ends the search
  int found = -1;
  visitNearest(tree, {x, x}, bound, [&](int i) {
    if (found < 0 && tree.triangles[i].isWithin(x, distance)) found = i, bound = -1;
  });
  return found;
}

/// Largest distance of points of the triangles [from, to) of A, in tree order, a lattice of `least`
/// steps on each or of more that are no longer than `spacing`, from B, and the point, where it is
/// above `largest`.
Width sampledDistance(const TriangleTree& A, const TriangleTree& B, int least, double spacing,
                      Width largest, int from, int to) {
  constexpr double mostSteps = 1000;
  std::array<int, 4> recent{};  // triangles of B that were near last: neighbours in A are so too
  const auto isNear = [&](Vec3 p, int b) { return B.triangles[b].isWithin(p, largest.distance); };
  const auto isNearRecent = [&](Vec3 p) {
    for (int& b : recent)
      if (isNear(p, b)) {
        std::swap(b, recent[0]);
        return true;
      }
    return false;
  };
  const auto findNear = [&](Vec3 p) {
    if (isNearRecent(p)) return true;
    const int near = triangleWithin(B, p, largest.distance);
    if (near >= 0) {
      std::rotate(recent.begin(), recent.end() - 1, recent.end());
      recent[0] = near;
    }
    return near >= 0;
  };
  KeyMap had(3 * (to - from) / 2);  // edge → steps of the lattice whose points on it were looked at
  for (int t = from; t < to; ++t) {
    const std::array<Vec3, 3>& c = A.triangles[t].corners;
    // the distance from one triangle is a convex function: on another one largest at a corner
    findNear((1. / 3) * (c[0] + c[1] + c[2]));
    const int b = recent[0];
    if (isNear(c[0], b) && isNear(c[1], b) && isNear(c[2], b)) continue;
    const double longest = std::max({norm(c[1] - c[0]), norm(c[2] - c[1]), norm(c[0] - c[2])});
    const int m = std::max(least, int(std::min(mostSteps, std::ceil(longest / spacing))));
    const auto look = [&](int i, int j) {
      const Vec3 p = (1. / m) * (double(m - i - j) * c[0] + double(i) * c[1] + double(j) * c[2]);
      if (!findNear(p)) largest = {B.closest(p).distance, p};
    };
    for (int i = 1; i < m; ++i)
      for (int j = 1; i + j < m; ++j) look(i, j);
    // of edge e from corner e on; those of the triangle beyond it are the same
    for (int e = 0; e < 3; ++e) {
      int& steps = had[edgeKey(A.triangles[t].points[e], A.triangles[t].points[(e + 1) % 3])];
      for (int i = steps >= m ? m + 1 : 0; i <= m; ++i)
        look(e == 0 ? i : e == 1 ? m - i : 0, e == 1 ? i : e == 2 ? m - i : 0);
      steps = std::max(steps, m);
    }
  }
  return largest;
}

/// The same over all triangles: from what a few of them tell, which spares most of the search.
Width sampledDistance(const TriangleTree& A, const TriangleTree& B, int least, double spacing,
                      Width largest, const Crew& crew) {
  constexpr int few = 32;
  const int count = static_cast<int>(A.triangles.size());
  const auto keepLarger = [&largest](const Width& other) {
    if (other.distance > largest.distance) largest = other;
  };
  for (int t = 0; t < count; t += std::max(1, count / few))
    keepLarger(sampledDistance(A, B, least, spacing, largest, t, t + 1));
  const Width start = largest;
  std::vector<Width> ofPiece(count / queryPiece + 1, start);
  crew.forPieces(0, count, queryPiece, [&](int k, int from, int to) {
    ofPiece[k] = sampledDistance(A, B, least, spacing, start, from, to);
  });
  for (const Width& piece : ofPiece) keepLarger(piece);
  return largest;
}

/// smallestGap() where it is below `within`; else no triangle, and that distance. Other triangles
/// are then passed over by their boxes.
Gap gapWithin(const TriangleTree& tree, const std::vector<Vec3>& points,
              const std::vector<std::array<int, 3>>& triangles, double within) {
  Gap gap{within, -1, -1, {}};
  for (std::size_t o = 0; o < triangles.size(); ++o) {
    const std::array<int, 3>& v = triangles[o];
    const std::array<Vec3, 3> other{points[v[0]], points[v[1]], points[v[2]]};
    const TriangleTree::Box box = boxOf(other);
    visitNearest(tree, box, gap.distance, [&](int i) {
      Vec3 on;
      const double d = trianglesDistance(tree.triangles[i].corners, other, on);
      if (d < gap.distance) gap = {d, tree.triangles[i].number, static_cast<int>(o), on};
    });
  }
  return gap;
}

}  // namespace

Gap smallestGap(const TriangleTree& tree, const std::vector<Vec3>& points,
                const std::vector<std::array<int, 3>>& triangles) {
  return gapWithin(tree, points, triangles, beyondAll);
}

std::vector<Crossing> selfCrossings(const TriangleSurface& S, const TriangleTree& tree,
                                    const Crew& crew) {
  const int count = static_cast<int>(S.triangles.size());
  std::vector<std::vector<Crossing>> ofPiece(count / queryPiece + 1);
  crew.forPieces(0, count, queryPiece, [&](int k, int from, int to) {
    for (int t = from; t < to; ++t) {
      const TriangleTree::Box box = boxOf(cornersOf(S, t));
      tree.visit(box.lo, box.hi, [&](int s) {
        Crossing found{t, s, {}};
        if (s > t && trianglesCross(S, t, s, found.point)) ofPiece[k].push_back(found);
        return false;
      });
    }
  });
  std::vector<Crossing> crossings;
  for (const std::vector<Crossing>& found : ofPiece)
    crossings.insert(crossings.end(), found.begin(), found.end());
  return crossings;
}

std::vector<Crossing> selfCrossings(const TriangleSurface& S) {
  return selfCrossings(S, TriangleTree(S.points, S.triangles));
}

namespace {

/// What faces S at p, a point of triangle t, along its normal on both sides: the distance of the
/// nearest triangle that is roughly parallel (60 degrees), beyondAll where none is within reach.
double facingDistance(const SurfaceDistance& S, Vec3 p, int t, double reach) {
  constexpr double parallel = .5;
  double nearest = beyondAll;
  for (double direction : {1., -1.}) {
    const Vec3 q = p + direction * reach * S.faceNormal[t];
    const TriangleTree::Box box = boxOf({p, q, q});
    S.tree.visit(box.lo, box.hi, [&](int s) {
      Vec3 at;
      if (s == t || std::fabs(dot(S.faceNormal[s], S.faceNormal[t])) < parallel) return false;
      for (int n : S.S.triangles[s])
        if (cornerAt(S.S.triangles[t], n) < 3) return false;
      if (segmentCrosses(p, q, cornersOf(S.S, s), at)) nearest = std::min(nearest, norm(at - p));
      return false;
    });
  }
  return nearest;
}

/// The 5 % quantile of measured widths; of equal ones the first.
Width lowQuantile(std::vector<Width> widths) {
  constexpr double fraction = .05;
  if (widths.empty()) return {beyondAll, {}};
  const auto at = widths.begin() + static_cast<std::ptrdiff_t>(fraction * double(widths.size()));
  std::stable_sort(widths.begin(), widths.end(),
                   [](const Width& a, const Width& b) { return a.distance < b.distance; });
  return *at;
}

}  // namespace

Width facingSheets(const SurfaceDistance& S, double reach) {
  constexpr int samples = 4000;  // [choice] spread evenly over the area
  const double area = areaOf(S.S);
  double passed = 0;
  std::vector<Width> widths;
  for (int t = 0; t < static_cast<int>(S.S.triangles.size()); ++t) {
    const std::array<Vec3, 3> c = cornersOf(S.S, t);
    passed += areaOf(S.S, t);
    while (double(widths.size()) + .5 < samples * (passed / area)) {
      // the plastic sequence: points without gaps or clusters in the unit square, then the triangle
      const double k = double(widths.size()) + 1;
      double v = std::fmod(k * .7548776662466927, 1), w = std::fmod(k * .5698402909980532, 1);
      if (v + w > 1) v = 1 - v, w = 1 - w;
      const Vec3 p = c[0] + (v * (c[1] - c[0]) + w * (c[2] - c[0]));
      widths.push_back({facingDistance(S, p, t, reach), p});
    }
  }
  return lowQuantile(std::move(widths));
}

Width rimWidth(const SurfaceDistance& S, double apart) {
  constexpr int samples = 600;  // [choice] along the rim
  constexpr double detour = 3;  // [choice] rim between two points of a narrow part, per width
  std::vector<int> closed = S.rim;
  closed.push_back(S.rim[0]);
  std::vector<Vec3> p;  // [samples], evenly along the rim
  double length = 0, passed = 0;
  for (std::size_t i = 0; i + 1 < closed.size(); ++i)
    length += norm(S.S.points[closed[i + 1]] - S.S.points[closed[i]]);
  for (std::size_t i = 0; i + 1 < closed.size(); ++i) {
    const Vec3 a = S.S.points[closed[i]], b = S.S.points[closed[i + 1]];
    const double edge = norm(b - a), step = length / samples;
    for (; double(p.size()) * step < passed + edge && p.size() < samples;)
      p.push_back(a + ((double(p.size()) * step - passed) / edge) * (b - a));
    passed += edge;
  }
  std::vector<Width> widths;
  const int n = static_cast<int>(p.size());
  for (int i = 0; i < n; ++i) {
    Width width{beyondAll, p[i]};
    for (int j = 0; j < n; ++j) {
      const double distance = norm(p[j] - p[i]);
      const double along = std::min(std::abs(i - j), n - std::abs(i - j)) * (length / samples);
      if (along >= detour * distance && along >= apart)
        width.distance = std::min(width.distance, distance);
    }
    widths.push_back(width);
  }
  return lowQuantile(std::move(widths));
}

Width farthestPoint(const TriangleTree& A, const TriangleTree& B, int samplesPerEdge,
                    double spacing, const Crew& crew) {
  if (A.nodes.empty() || B.nodes.empty() || samplesPerEdge < 1 || !(spacing > 0))
    throw InputError("hausdorffDistance: give two surfaces with triangles and samplesPerEdge >= 1");
  const Width ofA = sampledDistance(A, B, samplesPerEdge, spacing, {0, {}}, crew);
  return sampledDistance(B, A, samplesPerEdge, spacing, ofA, crew);
}

double hausdorffDistance(const TriangleTree& A, const TriangleTree& B, int samplesPerEdge,
                         double spacing) {
  return farthestPoint(A, B, samplesPerEdge, spacing).distance;
}

// ==== Tools for 3.2: triangle–tetrahedron intersection ===========================================

namespace {

/// The faces of a tetrahedron: height(i, x) is 0 on the plane opposite to vertex i, 1 at i.
class FacePlanes {
 public:
  explicit FacePlanes(const std::array<Vec3, 4>& tet) {
    constexpr int faces[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};
    for (int i = 0; i < 4; ++i) {
      on_[i] = tet[faces[i][0]];
      const Vec3 n = cross(tet[faces[i][1]] - on_[i], tet[faces[i][2]] - on_[i]);
      inward_[i] = (1 / dot(n, tet[i] - on_[i])) * n;
    }
  }
  double height(int i, Vec3 x) const { return dot(inward_[i], x - on_[i]); }

 private:
  Vec3 on_[4], inward_[4];
};

/// Whether a triangle meets the tetrahedron: what is left of it when clipped by the four planes.
bool meets(const FacePlanes& planes, const std::array<Vec3, 3>& triangle) {
  // relative to the tetrahedron: closed, an extra hit is harmless
  constexpr double tolerance = 1e-9;
  // mostly the corners tell: one inside all planes, or all three beyond one
  bool inside[3] = {true, true, true};
  for (int i = 0; i < 4; ++i) {
    bool beyond = true;
    for (int j = 0; j < 3; ++j) {
      const bool in = planes.height(i, triangle[j]) + tolerance >= 0;
      inside[j] = inside[j] && in;
      beyond = beyond && !in;
    }
    if (beyond) return false;
  }
  if (inside[0] || inside[1] || inside[2]) return true;

  Vec3 polygon[16],
      clipped[16];  // three corners, one more for each plane; rounding on needles: twice that
  int corners = 3;
  for (int i = 0; i < 3; ++i) polygon[i] = triangle[i];
  for (int i = 0; i < 4; ++i) {
    int kept = 0;
    for (int j = 0; j < corners; ++j) {
      const Vec3 p = polygon[j], q = polygon[(j + 1) % corners];
      const double dp = planes.height(i, p) + tolerance, dq = planes.height(i, q) + tolerance;
      if (dp >= 0) clipped[kept++] = p;
      if ((dp > 0 && dq < 0) || (dp < 0 && dq > 0)) clipped[kept++] = p + dp / (dp - dq) * (q - p);
    }
    if (kept == 0) return false;
    corners = kept;
    std::copy(clipped, clipped + kept, polygon);
  }
  return true;
}

}  // namespace

bool intersects(const std::array<Vec3, 4>& tet, const std::array<Vec3, 3>& triangle) {
  return meets(FacePlanes(tet), triangle);
}

// ==== 3.2 Volumetric approximation ===============================================================

double longestEdge(const Mesh& M, int E) {
  double longest = 0;
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < i; ++j) {
      const Vec3 d = M.xi[M.tets[E][i]] - M.xi[M.tets[E][j]];
      longest = std::max(longest, norm(Vec3{d.x * M.cube.x, d.y * M.cube.y, d.z * M.cube.z}));
    }
  return longest;
}

bool isTooLarge(const Mesh& M, int E, double lc) { return longestEdge(M, E) >= lc; }

namespace {

/// Whether a tetrahedron is cut by S.
struct Cut {
  enum { unknown, yes, no } is = unknown;
  int triangle = -1;  // of S, which meets it or met its parent; -1: none is known
};

/// On which sides of a box a point is beyond it, six bits.
unsigned sidesBeyond(const TriangleTree::Box& box, Vec3 p) {
  return unsigned(p.x < box.lo.x) | unsigned(p.y < box.lo.y) << 1 | unsigned(p.z < box.lo.z) << 2 |
         unsigned(p.x > box.hi.x) << 3 | unsigned(p.y > box.hi.y) << 4 |
         unsigned(p.z > box.hi.z) << 5;
}

/// What is known at once: an element whose nodes are all beyond one side of the box of S is not
/// cut.
std::vector<Cut> cutsBeforeSearch(const Mesh& M, const SurfaceDistance& S) {
  const TriangleTree::Box& box = S.tree.nodes[0].box;
  const double wide = 1e-6 * norm(box.hi - box.lo);
  const Vec3 margin{wide, wide, wide};
  std::vector<unsigned char> beyond(M.x.size());
  for (std::size_t n = 0; n < M.x.size(); ++n)
    beyond[n] = static_cast<unsigned char>(sidesBeyond({box.lo - margin, box.hi + margin}, M.x[n]));
  std::vector<Cut> cut(M.tets.size());
  for (std::size_t E = 0; E < cut.size(); ++E) {
    const std::array<int, 4>& z = M.tets[E];
    if (beyond[z[0]] & beyond[z[1]] & beyond[z[2]] & beyond[z[3]]) cut[E].is = Cut::no;
  }
  return cut;
}

/// Whether S meets tetrahedron E: the triangle that is known, else candidates by the tree; by
/// clipping.
Cut cutBySurface(const Mesh& M, int E, const SurfaceDistance& S, int known) {
  std::array<Vec3, 4> tet;
  for (int i = 0; i < 4; ++i) tet[i] = M.x[M.tets[E][i]];
  TriangleTree::Box box{tet[0], tet[0]};
  for (const Vec3& p : tet) growBox(box, p);
  const Vec3 margin = 1e-9 * (box.hi - box.lo), lo = box.lo - margin, hi = box.hi + margin;
  if (!boxesMeet(S.tree.nodes[0].box, lo, hi)) return {Cut::no};
  const FacePlanes planes(tet);
  if (known >= 0 && meets(planes, cornersOf(S.S, known))) return {Cut::yes, known};
  Cut cut{Cut::no};
  S.tree.visit(lo, hi, [&](int t) {
    if (meets(planes, cornersOf(S.S, t))) cut = {Cut::yes, t};
    return cut.is == Cut::yes;
  });
  return cut;
}

/// Refines the tetrahedra cut by S that `wanted` asks for until there is none.
template <class Wanted>
void refineCut(Bisection& B, const SurfaceDistance& S, std::vector<Cut>& cut, const Crew& crew,
               Wanted wanted) {
  constexpr int maxPasses = 250;  // one level a pass; levels fit in a byte
  for (int pass = 0; pass < maxPasses; ++pass) {
    std::vector<int> unknown;
    for (std::size_t E = 0; E < cut.size(); ++E)
      if (cut[E].is == Cut::unknown) unknown.push_back(static_cast<int>(E));
    crew.forPieces(0, static_cast<int>(unknown.size()), queryPiece, [&](int, int from, int to) {
      for (int i = from; i < to; ++i)
        cut[unknown[i]] = cutBySurface(B.M, unknown[i], S, cut[unknown[i]].triangle);
    });
    std::vector<int> refine;
    for (int E = 0; E < static_cast<int>(cut.size()); ++E)
      if (cut[E].is == Cut::yes && wanted(E)) refine.push_back(E);
    if (refine.empty()) return;
    B.splits.clear();
    bisectOnce(B, refine);
    cut.resize(B.M.tets.size());
    // what is not cut has no parts that are, but where a midpoint was moved onto a surface
    for (const Bisection::Split& split : B.splits) {
      const bool isPart = B.M.dimension[split.midpoint] == 3;
      const Cut whole = cut[split.parent];
      const Cut part = isPart && whole.is == Cut::no ? whole : Cut{Cut::unknown, whole.triangle};
      cut[split.parent] = cut[split.child] = part;
    }
  }
}

}  // namespace

int cubeLevel(const Mesh& M, double lc) {
  constexpr int maxLevel = 240;  // levels fit in a byte
  int level = 0;
  for (double diagonal = norm(M.cube); diagonal >= lc && level < maxLevel; diagonal /= 2)
    level += 3;
  return level;
}

namespace {

/// Physical edge of the cubes of a level.
double cubeEdge(const Mesh& M, int level) {
  return std::ldexp(std::cbrt(M.cube.x * M.cube.y * M.cube.z), -level / 3);
}

/// The faces of ∂𝓜, of all patches.
std::vector<std::array<int, 3>> patchFaces(const Mesh& M) {
  return labelledFaces(M, [](int label, const auto&) { return label < 0; });
}

constexpr double aboveDiagonal = 1 + 1e-9;  // eq. (1) refines where r^E >= l_c

/// [choice] Tetrahedra that S adds at cubes of edge h: measured 36 to 55 per face of a cube.
double predictedTets(double area, double h) {
  constexpr double tetsPerSquare = 45;
  return tetsPerSquare * area / (h * h);
}

double extentOf(const SurfaceDistance& S) {
  const TriangleTree::Box& box = S.tree.nodes[0].box;
  return norm(box.hi - box.lo);
}

}  // namespace

SizeChoice chooseSize(const Mesh& M, const SurfaceDistance& S) {
  constexpr double rimApart = 4;    // [choice] least length of rim between two parts, of h
  constexpr double perExtent = 20;  // [choice] l_c of the extent, of which at least 1/8 is kept
  constexpr double lowest = 1. / 8, mostTets = 1e6;
  constexpr double perBoundary = 2.5, perSurface = 1.75, perRim = 1.5, perSheet = 2;  // of h
  const double root3 = std::sqrt(3.);
  const double extent = extentOf(S), largest = extent / perExtent;
  const double finest = root3 * std::sqrt(predictedTets(areaOf(S.S), 1) / mostTets);
  SizeChoice size{largest, "the extent of S", extent, S.S.points[S.rim[0]], largest, 0};
  size.finest = std::min(largest, std::max(lowest * largest, finest));
  auto limit = [&](const std::string& feature, double measure, double perH, Vec3 place) {
    const double lc = root3 * measure / perH;
    if (lc < size.lc) size = {lc, feature, measure, place, lc, size.finest};
  };
  const Width sheets = facingSheets(S, perSheet * largest / root3);
  limit("the distance of sheets of S that face each other", sheets.distance, perSheet,
        sheets.place);
  const Width rim = rimWidth(S, rimApart * largest / root3);
  limit("the width between parts of the rim of S", rim.distance, perRim, rim.place);
  size.lc = std::max(size.lc, size.finest);
  // [choice] of a surface that crosses itself no more than these: l_c just below the diagonal of a
  // cube has four times as many, and the diagonal has to do
  const int level = cubeLevel(M, size.lc);
  const double diagonal = norm(M.cube) * std::exp2(-level / 3);
  if (predictedTets(areaOf(S.S), diagonal / root3) > mostTets && 2 * diagonal < largest &&
      !selfCrossings(S.S, S.tree).empty())
    size.lc = size.finest = 2 * diagonal * aboveDiagonal;

  const double near = perBoundary * size.lc / root3;  // farther ones do not limit l_c
  const Gap boundary = gapWithin(S.tree, M.x, patchFaces(M), near);
  if (boundary.triangle >= 0)
    limit("the distance of S to the boundary", boundary.distance, perBoundary, boundary.point);
  for (const Parametrization& earlier : M.surfaces) {
    const Gap gap = gapWithin(S.tree, earlier.points, earlier.triangles, near);
    if (gap.triangle >= 0)
      limit("the distance of S to the surface '" + earlier.name + "'", gap.distance, perSurface,
            gap.point);
  }
  return size;
}

Approximation volumetricApproximation(Bisection& B, const SurfaceDistance& S, double lc,
                                      const Crew& crew) {
  std::vector<Cut> cut = cutsBeforeSearch(B.M, S);
  refineCut(B, S, cut, crew, [&](int E) { return isTooLarge(B.M, E, lc); });  // eq. (1)
  Approximation A;
  A.level = cubeLevel(B.M, lc);
  // [choice] on to whole cubes, which §3.3 asks for: up to two bisections more than eq. (1)
  refineCut(B, S, cut, crew, [&](int E) { return B.M.level[E] < A.level; });
  A.T.resize(cut.size());
  for (std::size_t E = 0; E < cut.size(); ++E) A.T[E] = cut[E].is == Cut::yes;
  return A;
}

// ==== Tools for 3.3: the lattice of cubes ========================================================

namespace {

/// The cubes of one level in the computational space. Keys are positions in half cubes: odd, odd,
/// odd is a cube's centre; even, odd, odd a square's; even, even, even a node.
struct Lattice {
  double scale;  // cubes per unit of ξ
  explicit Lattice(int level) : scale(std::ldexp(1., level / 3)) {}
  static std::uint64_t key(std::array<std::int64_t, 3> half) {
    return std::uint64_t(half[0]) << 42 | std::uint64_t(half[1]) << 21 | std::uint64_t(half[2]);
  }
  static std::array<std::int64_t, 3> position(std::uint64_t key) {
    constexpr std::uint64_t mask = (1u << 21) - 1;
    return {std::int64_t(key >> 42), std::int64_t(key >> 21 & mask), std::int64_t(key & mask)};
  }
  Vec3 xiOf(std::uint64_t key) const {
    const std::array<std::int64_t, 3> p = position(key);
    return (.5 / scale) * Vec3{double(p[0]), double(p[1]), double(p[2])};
  }
  // ξ >= 0: the integer part is the floor, without a call
  std::int64_t inside(double c) const { return 2 * std::int64_t(c * scale) + 1; }
  bool onPlane(double c) const { return c * scale == double(std::int64_t(c * scale)); }
  std::uint64_t cubeOf(const Mesh& M, int E) const {
    const std::array<int, 4>& z = M.tets[E];
    const Vec3 c = .25 * (M.xi[z[0]] + M.xi[z[1]] + M.xi[z[2]] + M.xi[z[3]]);
    return key({inside(c.x), inside(c.y), inside(c.z)});
  }
  bool isNode(Vec3 xi) const { return onPlane(xi.x) && onPlane(xi.y) && onPlane(xi.z); }
  std::uint64_t node(Vec3 xi) const {
    return key({std::int64_t(2 * xi.x * scale), std::int64_t(2 * xi.y * scale),
                std::int64_t(2 * xi.z * scale)});
  }
  /// The square that holds the face; false where the face is inside a cube.
  bool squareOf(const Mesh& M, std::array<int, 3> face, std::array<std::int64_t, 3>& half) const {
    const Vec3 a = M.xi[face[0]], b = M.xi[face[1]], c = M.xi[face[2]];
    const Vec3 middle = (1. / 3) * (a + b + c);
    half = {inside(middle.x), inside(middle.y), inside(middle.z)};
    if (a.x == b.x && a.x == c.x && onPlane(a.x))
      return half[0] = std::int64_t(2 * a.x * scale), true;
    if (a.y == b.y && a.y == c.y && onPlane(a.y))
      return half[1] = std::int64_t(2 * a.y * scale), true;
    if (a.z == b.z && a.z == c.z && onPlane(a.z))
      return half[2] = std::int64_t(2 * a.z * scale), true;
    return false;
  }
};

}  // namespace

// ==== 3.3 Volumetric approximation healing =======================================================

int chi(int nE, int nF, int nC) { return nE - nF + nC; }

int chi(unsigned cubes) {
  int nE = 0, nF = 0, nC = 0;
  for (int c = 0; c < 8; ++c) nC += cubes >> c & 1;
  // edges: the half axes; faces: the quarter planes; each belongs to T with any cube that has it
  for (int axis = 0; axis < 3; ++axis)
    for (int side = 0; side < 2; ++side) {
      bool edge = false;
      for (int c = 0; c < 8; ++c) edge |= (c >> axis & 1) == side && (cubes >> c & 1);
      nE += edge;
      for (int other = 0; other < 2; ++other) {
        const int axis2 = (axis + 1) % 3;
        bool face = false;
        for (int c = 0; c < 8; ++c)
          face |= (c >> axis & 1) == side && (c >> axis2 & 1) == other && (cubes >> c & 1);
        nF += face;
      }
    }
  return chi(nE, nF, nC);
}

bool isFaceConnected(unsigned cubes) {
  const auto acrossFaces = [](unsigned c) {  // x, y and z flip bits 0, 1 and 2 of a cube's place
    return (c & 0x55) << 1 | (c & 0xaa) >> 1 | (c & 0x33) << 2 | (c & 0xcc) >> 2 | (c & 0x0f) << 4 |
           (c & 0xf0) >> 4;
  };
  unsigned reached = cubes & -cubes;
  for (unsigned last = 0; last != reached;) {
    last = reached;
    reached |= acrossFaces(reached) & cubes;
  }
  return reached == cubes;
}

bool isLocalDisk(unsigned cubes) {
  return cubes == 255 || cubes == 0 ||
         (chi(cubes) == 1 && isFaceConnected(cubes) && isFaceConnected(255u & ~cubes));
}

namespace {

/// Whole cubes: the neighbour across each boundary face of T that is not on the lattice's planes is
/// refined to the same level and added. (There is one: ∂M lies on the lattice's planes.)
void completeCubes(Bisection& B, Approximation& A, std::vector<int> queue) {
  const Lattice lattice(A.level);
  std::array<std::int64_t, 3> square;
  for (std::size_t at = 0; at < queue.size(); ++at)
    for (int i = 0; i < 4; ++i) {
      const int E = queue[at], across = B.neighbour[E][i];
      if (across < 0 || A.T[across]) continue;
      if (lattice.squareOf(B.M, faceOpposite(B.M.tets[E], i), square)) continue;
      while (B.M.level[B.neighbour[E][i]] < A.level) B.bisect(B.neighbour[E][i]);
      A.T.resize(B.M.tets.size(), 0);
      const int next = B.neighbour[E][i];
      A.T[next] = 1;
      queue.push_back(next);
    }
}

constexpr int tetsPerCube = 6;  // at least

/// For each lattice node of T the cubes of T around it: bit 1 x+, bit 2 y+, bit 4 z+ of the cube's
/// place.
KeyMap cubesAtNodes(const Mesh& M, const Approximation& A, std::vector<std::uint64_t>& nodes) {
  const Lattice lattice(A.level);
  const std::vector<int> elements = markedOf(A.T);
  KeyMap cubes(elements.size() / tetsPerCube), at(elements.size() / 3);
  for (int E : elements) {
    const std::uint64_t key = lattice.cubeOf(M, E);
    if (cubes[key]++) continue;
    const std::array<std::int64_t, 3> p = Lattice::position(key);
    for (int c = 0; c < 8; ++c) {
      // seen from its corner at side c the cube lies on the other side
      const std::uint64_t node =
          Lattice::key({p[0] + (c & 1 ? 1 : -1), p[1] + (c & 2 ? 1 : -1), p[2] + (c & 4 ? 1 : -1)});
      int& mask = at[node];
      if (mask == 0) nodes.push_back(node);
      mask |= 1 << (7 - c);
    }
  }
  return at;
}

/// Which nodes are of elements of 𝓣.
std::vector<char> nodesOf(const Mesh& M, const Approximation& A) {
  std::vector<char> isOfT(M.x.size(), 0);
  for (int E : markedOf(A.T))
    for (int n : M.tets[E]) isOfT[n] = 1;
  return isOfT;
}

/// The lattice nodes of 𝓣: place → 1 + mesh node.
KeyMap latticeNodesOf(const Mesh& M, const Approximation& A) {
  const Lattice lattice(A.level);
  const std::vector<int> nodes = markedOf(nodesOf(M, A));
  KeyMap meshNode(nodes.size());
  for (int n : nodes)
    if (lattice.isNode(M.xi[n])) meshNode[lattice.node(M.xi[n])] = n + 1;
  return meshNode;
}

/// Whether a node lies on ∂M. T may pass an earlier surface: its squares there are no candidates.
bool isOnBoundary(const Mesh& M, int n) {
  if (M.dimension[n] == 2) return M.entity[n] < 0;
  int first = 0;
  anyCurveAt(M, n, [&](int curve, double) { return (first = curve) > 0; });
  return first > 0 && M.curves[first - 1].sides[0].surface < 0;
}

/// The elements adjacent to the node, refined to T's level, join T.
void addElementsAt(Bisection& B, Approximation& A, int node) {
  std::vector<int> around, added;
  for (int E; (E = B.coarserAt(node, A.level, around)) >= 0;) B.bisect(E);
  A.T.resize(B.M.tets.size(), 0);
  for (int E : around)
    if (!A.T[E]) {
      A.T[E] = 1;
      added.push_back(E);
    }
  completeCubes(B, A, added);
}

}  // namespace

void volumetricHealing(Bisection& B, Approximation& A) {
  constexpr int maxRounds = 200;
  std::array<bool, 256> isDisk;
  for (unsigned mask = 0; mask < isDisk.size(); ++mask) isDisk[mask] = isLocalDisk(mask);
  completeCubes(B, A, markedOf(A.T));
  for (int round = 0; round < maxRounds; ++round) {
    std::vector<std::uint64_t> keys;
    const KeyMap cubes = cubesAtNodes(B.M, A, keys);
    std::vector<std::uint64_t> bad;
    for (std::uint64_t key : keys)
      if (!isDisk[cubes.get(key)]) bad.push_back(key);
    if (bad.empty()) return;
    const KeyMap meshNode = latticeNodesOf(B.M, A);
    for (std::uint64_t key : bad) {
      const int n = meshNode.get(key) - 1;
      if (isOnBoundary(B.M, n))
        throw MethodError("insertSurface (§3.3): T reaches the boundary at node " +
                          std::to_string(n) + "; lower l_c");
      addElementsAt(B, A, n);
    }
  }
  throw MethodError("insertSurface (§3.3): T has no boundary that is a surface after " +
                    std::to_string(maxRounds) + " rounds; lower l_c");
}

// ==== 3.4 Surface extraction =====================================================================

namespace {

/// The cubes of T.
struct Cubes {
  KeyMap number;                    // cube → 1 + its place in the others
  std::vector<std::uint64_t> keys;  // in the lattice
  std::vector<Vec3> sums;           // of points
  std::vector<int> points;          // how many

  Cubes(const Mesh& M, const Approximation& A) {
    const Lattice lattice(A.level);
    const std::vector<int> ofT = markedOf(A.T);
    number = KeyMap(ofT.size() / tetsPerCube);
    for (int E : ofT) {
      const std::array<int, 4>& z = M.tets[E];
      add(lattice.cubeOf(M, E), .25 * (M.x[z[0]] + M.x[z[1]] + M.x[z[2]] + M.x[z[3]]));
    }
  }
  void add(std::uint64_t cube, Vec3 point) {
    int& n = number[cube];
    if (n == 0) {
      keys.push_back(cube), sums.push_back({0, 0, 0}), points.push_back(0);
      n = static_cast<int>(keys.size());
    }
    sums[n - 1] += point, ++points[n - 1];
  }
  /// Physical: the mean of the elements', or of where they expect it.
  Vec3 centre(std::size_t c) const { return (1. / points[c]) * sums[c]; }
};

/// A lattice node of the cube, corner 0 to 7; of a node, a cube around it.
std::uint64_t cornerOf(std::uint64_t cube, int corner) {
  const std::array<std::int64_t, 3> p = Lattice::position(cube);
  return Lattice::key(
      {p[0] + (corner & 1 ? 1 : -1), p[1] + (corner & 2 ? 1 : -1), p[2] + (corner & 4 ? 1 : -1)});
}

/// At its node i an element spans a cone: where that has the centre of a cube, the element's affine
/// map tells its place.
void addCubesInCone(const Mesh& M, std::array<int, 4> z, int i, const Lattice& lattice,
                    Cubes& cubes) {
  std::swap(z[0], z[i]);
  const Vec3 at = M.xi[z[0]], x = M.x[z[0]];
  const Mat3 edges{M.xi[z[1]] - at, M.xi[z[2]] - at, M.xi[z[3]] - at};
  const Mat3 images{M.x[z[1]] - x, M.x[z[2]] - x, M.x[z[3]] - x};
  const Mat3 toEdges = inverse(edges);
  const double half = .5 / lattice.scale;
  const Vec3 a = half * toEdges.c0, b = half * toEdges.c1, c = half * toEdges.c2;
  for (int corner = 0; corner < 4; ++corner) {  // the centre is at (±half, ±half, ±half)
    const Vec3 w = (corner & 1 ? a : -a) + (corner & 2 ? b : -b) - c;
    if (w.x >= 0 && w.y >= 0 && w.z >= 0)
      cubes.add(cornerOf(lattice.node(at), corner), x + images * w);
    if (w.x <= 0 && w.y <= 0 && w.z <= 0)  // the opposite corner
      cubes.add(cornerOf(lattice.node(at), 7 - corner), x - images * w);
  }
}

/// The cubes of 𝓣 and those that touch it, where the mesh may be coarser.
Cubes cubesAround(const Mesh& M, const Approximation& A) {
  const Lattice lattice(A.level);
  Cubes cubes(M, A);
  std::vector<char> touches = nodesOf(M, A);  // the nodes around which all cubes are taken
  for (int n : markedOf(touches)) touches[n] = lattice.isNode(M.xi[n]) && !isOnBoundary(M, n);
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4 && !A.T[E]; ++i)
      if (touches[M.tets[E][i]]) addCubesInCone(M, M.tets[E], i, lattice, cubes);
  return cubes;
}

/// A weighted graph on cubes, for minimumCut(). Directions: −x, +x, −y, +y, −z, +z.
struct CubeGraph {
  using Weight = std::int64_t;                // whole numbers: no rounding
  std::vector<std::array<int, 6>> next;       // [cubes], the neighbours; −1: none
  std::vector<std::array<Weight, 6>> weight;  // [cubes], of the faces: what a cut there costs
  /// [cubes] > 0: what it costs not to be above S_M; < 0: minus what it costs not to be below.
  std::vector<Weight> above;
};

/// Sends as much as a path of the graph takes from the cube to one that wants to be below; the path
/// goes from level to level. False where there is no path any more.
bool sendAlongPath(CubeGraph& G, int source, const std::vector<int>& level,
                   std::vector<int>& direction) {
  std::vector<std::pair<int, int>> path;
  int c = source;
  while (G.above[c] >= 0) {
    int& d = direction[c];
    while (d < 6 && (G.weight[c][d] == 0 || level[G.next[c][d]] != level[c] + 1)) ++d;
    if (d == 6 && path.empty()) return false;
    if (d < 6) {
      path.push_back({c, d});
      c = G.next[c][d];
    } else {
      c = path.back().first, path.pop_back();
      ++direction[c];
    }
  }
  CubeGraph::Weight amount = std::min(G.above[source], -G.above[c]);
  for (const auto& [from, d] : path) amount = std::min(amount, G.weight[from][d]);
  for (const auto& [from, d] : path)
    G.weight[from][d] -= amount, G.weight[G.next[from][d]][d ^ 1] += amount;
  G.above[source] -= amount, G.above[c] += amount;
  return true;
}

/// The cut of least weight: which cubes are above it. By Dinic's algorithm: flow from those that
/// want to be above to those that want to be below, on shortest paths until there is none.
std::vector<char> minimumCut(CubeGraph G) {
  const int cubes = static_cast<int>(G.next.size());
  std::vector<int> level, queue;
  for (bool reaches = true; reaches;) {  // each round's paths are longer: at most as many as cubes
    level.assign(cubes, -1), queue.clear();
    for (int c = 0; c < cubes; ++c)
      if (G.above[c] > 0) level[c] = 0, queue.push_back(c);
    reaches = false;
    for (std::size_t i = 0; i < queue.size(); ++i) {
      const int c = queue[i];
      reaches = reaches || G.above[c] < 0;
      for (int d = 0; d < 6; ++d)
        if (G.weight[c][d] > 0 && level[G.next[c][d]] < 0)
          level[G.next[c][d]] = level[c] + 1, queue.push_back(G.next[c][d]);
    }
    std::vector<int> direction(cubes, 0);
    for (int c = 0; reaches && c < cubes; ++c)
      while (G.above[c] > 0 && sendAlongPath(G, c, level, direction)) {
      }
  }
  std::vector<char> isAbove(cubes);
  for (int c = 0; c < cubes; ++c) isAbove[c] = level[c] >= 0;
  return isAbove;
}

/// The cubes of a layer around S, and what a cut between those above S_M and those below costs:
/// each square 1, and each cube on the wrong side of S perDistance times its distance from S, in h.
/// What lies beyond the layer is on its own side, and so are the cubes that touch an earlier
/// surface or the boundary: S_M must not pass there.
CubeGraph graphOf(const Mesh& M, const Cubes& cubes, int level, const SurfaceDistance& S,
                  double perDistance, const Crew& crew) {
  constexpr CubeGraph::Weight perSquare = 1000, firm = 1000000 * perSquare;
  const Lattice lattice(level);
  const double perH = 1 / cubeEdge(M, level);
  CubeGraph G;
  const int count = static_cast<int>(cubes.keys.size());
  G.above.resize(count), G.next.resize(count), G.weight.resize(count);
  crew.forPieces(0, count, queryPiece, [&](int, int from, int to) {
    for (int c = from; c < to; ++c) {
      const SurfaceQuery at = S.query(cubes.centre(c));
      G.above[c] = std::llround(perDistance * perSquare * perH * at.side);
      for (int d = 0; d < 6; ++d) {
        std::array<std::int64_t, 3> beyond = Lattice::position(cubes.keys[c]);
        beyond[d / 2] += d % 2 ? 2 : -2;
        G.next[c][d] = cubes.number.get(Lattice::key(beyond)) - 1;
        G.weight[c][d] = G.next[c][d] < 0 ? 0 : perSquare;
        if (G.next[c][d] < 0 && !at.onRim) G.above[c] += at.side >= 0 ? perSquare : -perSquare;
      }
    }
  });
  for (std::size_t n = 0; n < M.x.size(); ++n)
    for (int corner = 0; corner < 8 && M.dimension[n] < 3 && lattice.isNode(M.xi[n]); ++corner)
      if (const int c = cubes.number.get(cornerOf(lattice.node(M.xi[n]), corner)))
        G.above[c - 1] = S.query(M.x[n]).side >= 0 ? firm : -firm;
  return G;
}

/// Whether the element with these nodes has the point p; exact where all numbers are dyadic, as in
/// the computational space.
bool holds(const std::vector<Vec3>& x, const std::array<int, 4>& z, Vec3 p) {
  for (int i = 0; i < 4; ++i) {
    const std::array<int, 3> v = faceOpposite(z, i);
    const Vec3 normal = cross(x[v[1]] - x[v[0]], x[v[2]] - x[v[0]]);
    if (dot(normal, p - x[v[0]]) * dot(normal, x[z[i]] - x[v[0]]) < 0) return false;
  }
  return true;
}

/// Refines the cube of 𝓣's lattice that has this mesh node: all elements that meet it hold its
/// centre.
void refineCube(Bisection& B, int level, std::uint64_t cube, int node) {
  const Vec3 centre = Lattice(level).xiOf(cube);
  std::vector<int> around;
  for (bool coarse = true; coarse;) {  // one level a round at least
    coarse = false;
    B.star(node, around);
    for (std::size_t i = 0; i < around.size() && !coarse; ++i)
      if (B.M.level[around[i]] < level && holds(B.M.xi, B.M.tets[around[i]], centre))
        B.bisect(around[i]), coarse = true;
  }
}

/// The cubes of 𝓣 and all around it, as S_M divides them; their elements may be coarser.
struct DividedCubes {
  std::vector<std::uint64_t> above, below;  // sorted
  std::vector<std::uint64_t> touching;      // of those below, the ones that touch one above
};
DividedCubes divideCubes(const Mesh& M, const Approximation& A, const SurfaceDistance& S,
                         double perDistance, const Crew& crew) {
  const Cubes cubes = cubesAround(M, A);
  const std::vector<char> isAbove = minimumCut(graphOf(M, cubes, A.level, S, perDistance, crew));
  DividedCubes divided;
  KeyMap cornersAbove(isAbove.size());
  for (std::size_t c = 0; c < isAbove.size(); ++c) {
    if (isAbove[c]) divided.above.push_back(cubes.keys[c]);
    for (int k = 0; k < 8 && isAbove[c]; ++k) cornersAbove[cornerOf(cubes.keys[c], k)] = 1;
  }
  for (std::size_t c = 0; c < isAbove.size(); ++c) {
    bool touches = false;
    for (int k = 0; k < 8; ++k) touches |= cornersAbove.get(cornerOf(cubes.keys[c], k)) > 0;
    if (!isAbove[c]) divided.below.push_back(cubes.keys[c]);
    if (!isAbove[c] && touches) divided.touching.push_back(cubes.keys[c]);
  }
  for (std::vector<std::uint64_t>* part : {&divided.above, &divided.below, &divided.touching})
    std::sort(part->begin(), part->end());
  return divided;
}

/// [choice] Elements at faces of earlier surfaces that touch 𝓣 are refined to its level: coarse
/// faces are off their surface, which S may be nearer to.
void refineSurfacesAround(Bisection& B, Approximation& A) {
  std::vector<char> isOfT = nodesOf(B.M, A);
  const auto isCoarse = [&](int E) {
    const std::array<int, 4>&z = B.M.tets[E], &label = B.M.faceLabel[E];
    const bool isAtSurface = *std::max_element(label.begin(), label.end()) > 0;
    isOfT.resize(B.M.x.size(), 0);
    return isAtSurface && B.M.level[E] < A.level &&
           (isOfT[z[0]] || isOfT[z[1]] || isOfT[z[2]] || isOfT[z[3]]);
  };
  for (int E = 0; E < static_cast<int>(B.M.tets.size()); ++E)
    while (isCoarse(E)) B.bisect(E);
  A.T.resize(B.M.tets.size(), 0);
}

}  // namespace

Approximation middleApproximation(Bisection& B, Approximation A, const SurfaceDistance& S,
                                  double perDistance, const Crew& crew) {
  refineSurfacesAround(B, A);
  const DividedCubes cubes = divideCubes(B.M, A, S, perDistance, crew);
  const KeyMap meshNode = latticeNodesOf(B.M, A);
  for (std::uint64_t cube : cubes.touching) {
    int node = 0;
    for (int k = 0; k < 8 && node == 0; ++k) node = meshNode.get(cornerOf(cube, k));
    if (node > 0) refineCube(B, A.level, cube, node - 1);
  }
  Approximation middle;
  middle.level = A.level, middle.isMiddle = true, middle.above = cubes.above,
  middle.below = cubes.below;
  const Lattice lattice(A.level);
  KeyMap isTouching(cubes.touching.size());
  TriangleTree::Box around{{beyondAll, beyondAll, beyondAll}, {-beyondAll, -beyondAll, -beyondAll}};
  for (std::uint64_t cube : cubes.touching) {
    isTouching[cube] = 1;
    for (int k : {0, 7}) growBox(around, lattice.xiOf(cornerOf(cube, k)));
  }
  middle.T.assign(B.M.tets.size(), 0);
  for (std::size_t E = 0; E < middle.T.size(); ++E) {
    const Vec3 corner = B.M.xi[B.M.tets[E][0]];
    if (B.M.level[E] >= A.level && boxesMeet(around, corner, corner))  // most are elsewhere
      middle.T[E] = isTouching.get(lattice.cubeOf(B.M, static_cast<int>(E))) > 0;
  }
  return middle;
}

namespace {

/// The longest edge of a face in the computational space: the one that bisection splits first.
std::pair<int, int> refinementEdge(const Mesh& M, std::array<int, 3> face) {
  std::pair<int, int> longest{face[0], face[1]};
  double length = 0;
  for (int e = 0; e < 3; ++e) {
    const double l = norm2(M.xi[face[(e + 1) % 3]] - M.xi[face[e]]);
    if (l > length) length = l, longest = {face[e], face[(e + 1) % 3]};
  }
  return longest;
}

/// The squares of ∂T: faces of cubes in T whose other cube is not, counter-clockwise from outside.
void addSquares(const Mesh& M, const Approximation& A, const KeyMap& meshNode, SquareSurface& Q) {
  const Cubes cubes(M, A);
  for (std::size_t c = 0; c < cubes.keys.size(); ++c) {
    const std::array<std::int64_t, 3> cube = Lattice::position(cubes.keys[c]);
    for (int axis = 0; axis < 3; ++axis)
      for (int side = -1; side <= 1; side += 2) {
        std::array<std::int64_t, 3> beyond = cube, centre = cube;
        beyond[axis] += 2 * side;
        centre[axis] += side;
        if (cubes.number.get(Lattice::key(beyond))) continue;
        const int a1 = (axis + (side > 0 ? 1 : 2)) % 3, a2 = (axis + (side > 0 ? 2 : 1)) % 3;
        constexpr int around[4][2] = {{-1, -1}, {1, -1}, {1, 1}, {-1, 1}};
        Square s;
        for (int e = 0; e < 4; ++e) {
          std::array<std::int64_t, 3> corner = centre;
          corner[a1] += around[e][0];
          corner[a2] += around[e][1];
          s.node[e] = meshNode.get(Lattice::key(corner)) - 1;
        }
        s.centre = .25 * (M.x[s.node[0]] + M.x[s.node[1]] + M.x[s.node[2]] + M.x[s.node[3]]);
        s.beyond = 2 * s.centre - cubes.centre(c);
        s.facesAbove = std::binary_search(A.above.begin(), A.above.end(), Lattice::key(beyond));
        s.facesBelow = std::binary_search(A.below.begin(), A.below.end(), Lattice::key(beyond));
        Q.squares.push_back(s);
        Q.keys.push_back(Lattice::key(centre));
      }
  }
}

/// Joins the squares along their edges; each edge of ∂T has two.
void joinSquares(SquareSurface& Q) {
  KeyMap first(2 * Q.squares.size());  // edge → 1 + 4 square + side of the first square that has it
  for (std::size_t i = 0; i < Q.squares.size(); ++i)
    for (int e = 0; e < 4; ++e) {
      Square& s = Q.squares[i];
      int& other = first[edgeKey(s.node[e], s.node[(e + 1) % 4])];
      if (other == 0) {
        other = 1 + 4 * static_cast<int>(i) + e;
        continue;
      }
      const int j = (other - 1) / 4, g = (other - 1) % 4;
      s.across[e] = j, s.acrossEdge[e] = g;
      Q.squares[j].across[g] = static_cast<int>(i), Q.squares[j].acrossEdge[g] = e;
    }
}

/// Place in the lattice → 1 + number of the square.
KeyMap squareNumbers(const SquareSurface& Q) {
  KeyMap numbers(Q.keys.size());
  for (std::size_t i = 0; i < Q.keys.size(); ++i) numbers[Q.keys[i]] = static_cast<int>(i) + 1;
  return numbers;
}

/// Which diagonal of each square is an edge of the mesh: the longest edge of its faces. (Bisection
/// reflects the cubes: it is not Kuhn's lowest to highest corner.)
void findDiagonals(const Mesh& M, const Approximation& A, SquareSurface& Q) {
  const Lattice lattice(A.level);
  const KeyMap squareAt = squareNumbers(Q);
  std::array<std::int64_t, 3> half;
  for (int E : markedOf(A.T))
    for (int i = 0; i < 4; ++i) {
      const std::array<int, 3> face = faceOpposite(M.tets[E], i);
      if (!lattice.squareOf(M, face, half)) continue;
      const int square = squareAt.get(Lattice::key(half)) - 1;
      if (square < 0) continue;
      Square& s = Q.squares[square];
      const std::pair<int, int> edge = refinementEdge(M, face);
      for (int d = 0; d < 2; ++d)
        if (edgeKey(edge.first, edge.second) == edgeKey(s.node[d], s.node[d + 2])) s.diagonal = d;
    }
}

/// Squares around each node: (square, corner) in compressed rows over the nodes of ∂T.
void collectNodes(SquareSurface& Q, int meshNodes) {
  Q.start.assign(meshNodes + 1, 0);
  for (const Square& s : Q.squares)
    for (int n : s.node) ++Q.start[n + 1];
  for (int n = 0; n < meshNodes; ++n)
    if (Q.start[n + 1] > 0) Q.nodes.push_back(n);
  std::partial_sum(Q.start.begin(), Q.start.end(), Q.start.begin());
  Q.around.resize(Q.start.back());
  std::vector<int> next(Q.start.begin(), Q.start.end() - 1);
  for (std::size_t i = 0; i < Q.squares.size(); ++i)
    for (int e = 0; e < 4; ++e) Q.around[next[Q.squares[i].node[e]]++] = {static_cast<int>(i), e};
}

/// The edge-connected parts of the squares for which in(square), numbered from 1; sizes by number.
template <class In>
std::vector<int> connectedParts(const SquareSurface& Q, In in, std::vector<int>& sizes) {
  std::vector<int> part(Q.squares.size(), 0), queue;
  sizes.assign(1, 0);
  for (int first = 0; first < static_cast<int>(part.size()); ++first) {
    if (part[first] || !in(first)) continue;
    queue.assign(1, first);
    part[first] = static_cast<int>(sizes.size());
    for (std::size_t i = 0; i < queue.size(); ++i)
      for (int next : Q.squares[queue[i]].across)
        if (!part[next] && in(next)) part[next] = part[first], queue.push_back(next);
    sizes.push_back(static_cast<int>(queue.size()));
  }
  return part;
}

}  // namespace

SquareSurface boundarySquares(const Mesh& M, const Approximation& A) {
  SquareSurface Q;
  Q.level = A.level, Q.isMiddle = A.isMiddle;
  Q.h = cubeEdge(M, A.level);
  addSquares(M, A, latticeNodesOf(M, A), Q);
  joinSquares(Q);
  findDiagonals(M, A, Q);
  collectNodes(Q, static_cast<int>(M.x.size()));

  // ∂T must be one sphere: V − E + F = 2 with E = 2 F, and connected.
  const int euler = static_cast<int>(Q.nodes.size()) - static_cast<int>(Q.squares.size());
  std::vector<int> sizes;
  connectedParts(
      Q, [](int) { return true; }, sizes);
  if (euler != 2 || sizes.size() != 2)
    Q.fault = "the boundary of T is no sphere (chi = " + std::to_string(euler) + ", " +
              std::to_string(sizes.size() > 1 ? sizes[1] : 0) + " of " +
              std::to_string(Q.squares.size()) +
              " squares connected): S comes close to itself within l_c";
  return Q;
}

namespace {

/// What the squares of ∂T know of S: sides of their nodes, distances of their quarters.
/// Quarter e of a square is the triangle of its corners e, e + 1 and its centre.
struct Survey {
  std::vector<signed char> side;  // [mesh nodes], +1 or −1, 0 off ∂T; none of a middle layer
  std::vector<char> facesUp;      // [squares] of a middle layer, 1: the cube beyond is above S
  std::vector<char> free;         // [squares], 0: touches another surface, or lies beyond it
  std::vector<double> excess;     // [squares], tangential excess of the centre beyond the rim, in h
  std::vector<std::array<double, 4>> beyond;  // [squares], the same of the quarters
  std::vector<std::array<double, 4>>
      above;                // [squares], distance from the rim of those above S, in h
  std::vector<char> sharp;  // [mesh nodes], 1: the node nearest to a sharp corner of S
};

/// The faces of all inserted surfaces that meet the box of S, widened by `margin`.
std::vector<std::array<int, 3>> facesAround(const Mesh& M, const SurfaceDistance& S,
                                            double margin) {
  const Vec3 wide = margin * Vec3{1, 1, 1};
  const Vec3 lo = S.tree.nodes[0].box.lo - wide, hi = S.tree.nodes[0].box.hi + wide;
  return labelledFaces(M, [&](int label, const std::array<int, 3>& v) {
    return label > 0 && boxesMeet(boxOf({M.x[v[0]], M.x[v[1]], M.x[v[2]]}), lo, hi);
  });
}

/// Whether the segment pq crosses a triangle of the tree.
bool crossesAny(const TriangleTree& tree, const std::vector<Vec3>& x,
                const std::vector<std::array<int, 3>>& triangles, Vec3 p, Vec3 q) {
  const TriangleTree::Box box = boxOf({p, q, q});
  bool crosses = false;
  tree.visit(box.lo, box.hi, [&](int t) {
    Vec3 where;
    const std::array<int, 3>& v = triangles[t];
    return crosses = segmentCrosses(p, q, {x[v[0]], x[v[1]], x[v[2]]}, where);
  });
  return crosses;
}

Survey surveySquares(const Mesh& M, const SquareSurface& Q, const SurfaceDistance& S,
                     const Crew& crew) {
  constexpr double reach = 4;   // of h: hardly a square of ∂T is farther from S
  constexpr double beside = 2;  // of h: and few are that far
  constexpr double deep = 4;    // of h, from the rim of S: no square there is ever removed
  const std::vector<std::array<int, 3>> earlier = facesAround(M, S, reach * Q.h);
  const TriangleTree tree(M.x, earlier);
  const std::size_t squares = Q.squares.size();
  Survey survey;
  survey.side.assign(Q.isMiddle ? 0 : M.x.size(), 0);
  survey.sharp.assign(M.x.size(), 0);
  survey.free.resize(squares), survey.excess.assign(squares, 0);
  survey.beyond.assign(squares, {}), survey.above.assign(squares, {deep, deep, deep, deep});
  if (Q.isMiddle) survey.facesUp.resize(squares);
  const double perH = 1 / Q.h;
  // whether a square's nearest point of S is deep inside of S, and nothing is in between
  const auto isDeep = [&](Vec3 x) {
    return triangleWithin(S.rimTree, x, (deep + beside) * Q.h) < 0 &&
           triangleWithin(tree, x, beside * Q.h) < 0 &&
           triangleWithin(S.tree, x, beside * Q.h) >= 0;
  };
  const auto surveySquare = [&](int i) {
    const Square& s = Q.squares[i];
    if (Q.isMiddle)
      survey.facesUp[i] = s.facesAbove || (!s.facesBelow && S.query(s.beyond).side >= 0);
    survey.free[i] = true;
    for (int n : s.node) survey.free[i] &= M.dimension[n] == 3;
    const bool onlyInHoles = Q.isMiddle && !survey.facesUp[i];  // which may be filled
    if ((onlyInHoles && earlier.empty()) || isDeep(s.centre)) return;
    const SurfaceQuery middle = S.query(s.centre);
    survey.free[i] = survey.free[i] && !crossesAny(tree, M.x, earlier, s.centre, middle.point);
    survey.excess[i] = perH * middle.excess;
    if (onlyInHoles) return;
    if (triangleWithin(S.rimTree, middle.point, deep * Q.h) < 0) return;
    for (int e = 0; e < 4; ++e) {
      const SurfaceQuery near =
          S.query((1. / 3) * (M.x[s.node[e]] + M.x[s.node[(e + 1) % 4]] + s.centre));
      survey.beyond[i][e] = perH * near.excess;
      survey.above[i][e] = near.onRim ? 0 : perH * S.rimDistance(near.point);
    }
  };
  crew.forPieces(0, static_cast<int>(squares), queryPiece, [&](int, int from, int to) {
    for (int i = from; i < to; ++i) surveySquare(i);
  });
  if (Q.isMiddle) return survey;
  crew.forPieces(0, static_cast<int>(Q.nodes.size()), queryPiece, [&](int, int from, int to) {
    for (int j = from; j < to; ++j)
      survey.side[Q.nodes[j]] = S.query(M.x[Q.nodes[j]]).side >= 0 ? 1 : -1;
  });
  return survey;
}

constexpr unsigned char emptySquare = 0, fullSquare = 15;

int largestPart(const std::vector<int>& sizes) {
  return static_cast<int>(std::max_element(sizes.begin(), sizes.end()) - sizes.begin());
}

/// Whether a square is between S and the other side of it: the corners that the selected quarters
/// use are on this side. [departure] Of a middle layer: the cube beyond it is above S.
bool isOnSide(const SquareSurface& Q, const Survey& survey, int i, int side,
              unsigned char quarters) {
  if (Q.isMiddle) return survey.facesUp[i];
  for (int e = 0; e < 4; ++e) {
    const bool used = (quarters >> e & 1) || (quarters >> ((e + 3) % 4) & 1);
    if (used && survey.side[Q.squares[i].node[e]] != side) return false;
  }
  return true;
}

/// [choice] Keeps the largest edge-connected part of the selection and fills its holes.
void keepLargestPart(const SquareSurface& Q, const Survey& survey, Selection& selected) {
  std::vector<int> sizes;
  std::vector<int> part = connectedParts(
      Q, [&](int i) { return selected[i] != 0; }, sizes);
  const int kept = largestPart(sizes);
  for (std::size_t i = 0; i < part.size(); ++i)
    if (part[i] != kept) selected[i] = emptySquare;
  part = connectedParts(
      Q, [&](int i) { return selected[i] == 0; }, sizes);
  const int outside = largestPart(sizes);
  std::vector<char> isHole(sizes.size(), 0);  // no other part of ∂T, which may have several
  for (std::size_t i = 0; i < part.size(); ++i)
    for (int next : Q.squares[i].across)
      if (part[i] > 0 && part[i] != outside && selected[next]) isHole[part[i]] = 1;
  for (std::size_t i = 0; i < part.size(); ++i)
    if (isHole[part[i]] && survey.free[i]) selected[i] = fullSquare;
}

/// The number of selected quarters at node n, and of rim edges there.
struct NodeState {
  int quarters, rimEdges;
};
NodeState nodeState(const SquareSurface& Q, const Selection& selected, int n) {
  NodeState state{0, 0};
  for (int i = Q.start[n]; i < Q.start[n + 1]; ++i) {
    const auto [square, corner] = Q.around[i];
    const Square& s = Q.squares[square];
    const int next = selected[square] >> corner & 1;
    const int previous = selected[square] >> ((corner + 3) % 4) & 1;
    const int beyond = selected[s.across[corner]] >> s.acrossEdge[corner] & 1;
    state.quarters += next + previous;
    state.rimEdges += (next != previous) + (next != beyond);
  }
  return state;
}

/// [choice] At a pinch, a node with more than two rim edges, the square with the fewest selected
/// neighbours goes.
bool cutPinches(const SquareSurface& Q, Selection& selected) {
  bool any = false;
  for (int n : Q.nodes) {
    if (nodeState(Q, selected, n).rimEdges <= 2) continue;
    int least = -1, leastCount = 5;
    for (int i = Q.start[n]; i < Q.start[n + 1]; ++i) {
      const int square = Q.around[i].first;
      if (!selected[square]) continue;
      int neighbours = 0;
      for (int next : Q.squares[square].across) neighbours += selected[next] != 0;
      if (neighbours < leastCount) leastCount = neighbours, least = square;
    }
    selected[least] = emptySquare;
    any = true;
  }
  return any;
}

/// [§3.4] The squares with all nodes on one side of S; one disk. [departure] Whole squares, where
/// the paper selects triangles: S_M is then bounded by lattice edges, as §3.5 takes for granted.
Selection selectSquares(const SquareSurface& Q, const Survey& survey, int side) {
  constexpr double maxExcess = .75;  // [choice] of h: squares farther beyond the rim are out
  constexpr int maxRounds = 100;
  Selection selected(Q.squares.size(), emptySquare);
  for (std::size_t i = 0; i < Q.squares.size(); ++i) {
    if (survey.free[i] && survey.excess[i] <= maxExcess &&
        isOnSide(Q, survey, static_cast<int>(i), side, fullSquare))
      selected[i] = fullSquare;
  }
  for (int round = 0; round < maxRounds; ++round) {
    keepLargestPart(Q, survey, selected);
    if (!cutPinches(Q, selected)) break;
  }
  return selected;
}

/// χ of the selection's closure: 1 for a disk (it is connected by construction).
int chiOf(const SquareSurface& Q, const Selection& selected) {
  int vertices = 0, edges = 0, faces = 0;
  for (int n : Q.nodes) vertices += nodeState(Q, selected, n).quarters > 0;
  for (std::size_t i = 0; i < Q.squares.size(); ++i) {
    const Square& s = Q.squares[i];
    vertices += selected[i] != 0;
    for (int e = 0; e < 4; ++e) {
      const int here = selected[i] >> e & 1, previous = selected[i] >> ((e + 3) % 4) & 1;
      const int there = selected[s.across[e]] >> s.acrossEdge[e] & 1;
      faces += here;
      edges += here || previous;                                       // the spoke at corner e
      edges += here && (!there || static_cast<int>(i) < s.across[e]);  // counted once
    }
  }
  return vertices - edges + faces;
}

/// Empty where S_M is one disk; else what is wrong, for the message.
std::string diskFault(const SquareSurface& Q, const Selection& selected) {
  std::vector<int> sizes;
  connectedParts(
      Q, [&](int i) { return selected[i] != 0; }, sizes);
  if (sizes.size() == 1) return "it is empty";
  if (sizes.size() > 2) return "it has " + std::to_string(sizes.size() - 1) + " parts";
  for (int n : Q.nodes)
    if (nodeState(Q, selected, n).rimEdges > 2) return "it is pinched at node " + std::to_string(n);
  const int euler = chiOf(Q, selected);
  return euler == 1 ? "" : "chi = " + std::to_string(euler);
}

}  // namespace

// ==== 3.5 Surface healing ========================================================================

bool removeThinProtrusions(const SquareSurface& Q, Selection& selected) {
  bool any = false;
  for (bool again = true; again;) {
    again = false;
    for (std::size_t i = 0; i < Q.squares.size(); ++i) {
      if (selected[i] != fullSquare) continue;
      int rimEdges = 0;
      for (int next : Q.squares[i].across) rimEdges += selected[next] == emptySquare;
      if (rimEdges >= 3) selected[i] = emptySquare, any = again = true;
    }
  }
  return any;
}

bool fillHighConnectivityNodes(const Mesh& M, const SquareSurface& Q, Selection& selected) {
  bool any = false;
  for (int n : Q.nodes) {
    // triangles of S_M at n: two of a square whose diagonal ends at n, else one
    int triangles = 0, fill = -1;
    for (int i = Q.start[n]; i < Q.start[n + 1]; ++i) {
      const auto [square, corner] = Q.around[i];
      const Square& s = Q.squares[square];
      if (selected[square])
        triangles += corner % 2 == s.diagonal ? 2 : 1;
      else if (selected[s.across[corner]] && selected[s.across[(corner + 3) % 4]])
        fill = square;  // both rim edges at n are sides of this square: it is in their plane
    }
    if (triangles < 5 || fill < 0 || nodeState(Q, selected, n).rimEdges != 2) continue;
    bool isFree = true;
    for (int corner : Q.squares[fill].node) isFree &= M.dimension[corner] == 3;
    if (isFree) selected[fill] = fullSquare, any = true;
  }
  return any;
}

namespace {

/// [§3.5 departure] Rim regularization: squares, whole or halved along a diagonal, are added and
/// removed one or two at a time while the rim energy falls:
///   E = Σ over rim nodes (1/16)(k − t)² + Σ over quarters ¼ (distance/h)²
/// with k selected quarters at the node (of 45° each), t = 4 or at a sharp corner of S 2; the
/// distance is the tangential excess of a selected quarter beyond the rim of S, or the distance
/// from the rim of an unselected one above S.
class RimRegularization {
 public:
  RimRegularization(const SquareSurface& Q, const Survey& survey, int side, Selection& selected)
      : Q_(Q), survey_(survey), side_(side), selected_(selected) {}

  void run(bool halves) {
    constexpr int maxSweeps = 60;  // E falls in each: only a guard
    halves_ = halves;
    awake_.assign(Q_.squares.size(), 1);
    for (int sweep = 0; sweep < maxSweeps; ++sweep) {
      bool improved = false;
      for (int i = 0; i < static_cast<int>(Q_.squares.size()); ++i) {
        if (!awake_[i]) continue;
        awake_[i] = 0;
        if (isNearRim(i)) improved |= improve(i);
      }
      if (!improved) return;
    }
  }

  /// E over the whole surface.
  double energy() const {
    double E = 0;
    for (int n : Q_.nodes) E += nodeEnergy(n);
    for (std::size_t i = 0; i < Q_.squares.size(); ++i) E += squareEnergy(static_cast<int>(i));
    return E;
  }

 private:
  static constexpr unsigned char states_[6] = {0, 15, 3, 6, 12, 9};  // empty, full, four halves

  bool isNearRim(int i) const {
    const bool here = selected_[i] != 0;
    if (selected_[i] != emptySquare && selected_[i] != fullSquare) return true;
    for (int n : Q_.squares[i].node)
      for (int j = Q_.start[n]; j < Q_.start[n + 1]; ++j)
        if ((selected_[Q_.around[j].first] != 0) != here) return true;
    return false;
  }

  /// Full needs all nodes on the side, a half its three corners.
  bool isAllowed(int i, unsigned char state) const {
    return state == emptySquare || (survey_.free[i] && isOnSide(Q_, survey_, i, side_, state));
  }

  double nodeEnergy(int n) const {
    constexpr double weight = .25 / 4;
    const NodeState state = nodeState(Q_, selected_, n);
    if (state.rimEdges == 0) return 0;
    const double target = survey_.sharp[n] ? 2 : 4;
    return weight * (state.quarters - target) * (state.quarters - target);
  }
  double squareEnergy(int i) const {
    double E = 0;
    for (int e = 0; e < 4; ++e) {
      if (!isOnSide(Q_, survey_, i, side_, static_cast<unsigned char>(1 << e))) continue;
      const double distance = selected_[i] >> e & 1 ? survey_.beyond[i][e] : survey_.above[i][e];
      E += .25 * distance * distance;
    }
    return E;
  }

  int quarterAcross(int i, int e) const {
    const Square& s = Q_.squares[i];
    return selected_[s.across[e]] >> s.acrossEdge[e] & 1;
  }

  /// E of what squares i and j (or i alone, j < 0) touch, or a part of it that reaches `enough`.
  double localEnergy(int i, int j, double enough) const {
    double E = 0;
    for (int square : {i, j}) {
      if (square < 0) continue;
      E += squareEnergy(square);
      for (int n : Q_.squares[square].node) {
        if (E >= enough) return E;
        if (square != j || !isCorner(i, n)) E += nodeEnergy(n);
      }
    }
    return E;
  }
  /// χ of the same.
  int localChi(int i, int j) const {
    int chi = 0;
    for (int square : {i, j}) {
      if (square < 0) continue;
      const Square& s = Q_.squares[square];
      chi += selected_[square] != 0;  // the centre
      for (int e = 0; e < 4; ++e) {
        const int here = selected_[square] >> e & 1,
                  previous = selected_[square] >> ((e + 3) % 4) & 1;
        chi += here - (here || previous);  // quarter and spoke
        if (square != j || s.across[e] != i) chi -= here || quarterAcross(square, e);
        if (square == j && isCorner(i, s.node[e])) continue;
        chi += nodeState(Q_, selected_, s.node[e]).quarters > 0;
      }
    }
    return chi;
  }
  bool isCorner(int i, int n) const {
    const auto& nodes = Q_.squares[i].node;
    return std::find(nodes.begin(), nodes.end(), n) != nodes.end();
  }

  /// Rules (a), (c), (d) at square i: two rim edges at a node at most, no tip and no notch of 45°.
  bool isClean(int i) const {
    const Square& s = Q_.squares[i];
    for (int n : s.node) {
      const NodeState state = nodeState(Q_, selected_, n);
      if (state.rimEdges > 2 || state.quarters == 1) return false;
    }
    if (hasNotch(i)) return false;
    for (int next : s.across)
      if (hasNotch(next)) return false;
    return true;
  }
  /// A removed quarter of a half square beside a selected quarter.
  bool hasNotch(int i) const {
    if (selected_[i] == emptySquare || selected_[i] == fullSquare) return false;
    for (int e = 0; e < 4; ++e)
      if (!(selected_[i] >> e & 1) && quarterAcross(i, e)) return true;
    return false;
  }

  /// Tries the states of square i alone, then with each of its neighbours; keeps the best that is
  /// better.
  bool improve(int i) {
    if (tryStates(i, -1)) return true;
    bool improved = false;
    for (int j : Q_.squares[i].across)
      if (survey_.free[j]) improved |= tryStates(i, j);
    return improved;
  }

  bool tryStates(int i, int j) {
    constexpr double least = 1e-9;  // a fall of E below rounding is none
    const unsigned char oldI = selected_[i], oldJ = j < 0 ? emptySquare : selected_[j];
    const int chi = localChi(i, j);
    double bestE = localEnergy(i, j, beyondAll) - least;
    unsigned char bestI = oldI, bestJ = oldJ;
    const int count = halves_ ? 6 : 2;
    for (int a = 0; a < count; ++a) {
      if (!isAllowed(i, states_[a])) continue;
      for (int b = 0; b < (j < 0 ? 1 : count); ++b) {
        if (j >= 0 && !isAllowed(j, states_[b])) continue;
        selected_[i] = states_[a];
        if (j >= 0) selected_[j] = states_[b];
        const double E = localEnergy(i, j, bestE);
        if (E < bestE && localChi(i, j) == chi && isClean(i) && (j < 0 || isClean(j)))
          bestE = E, bestI = states_[a], bestJ = states_[b];
      }
    }
    selected_[i] = bestI;
    if (j >= 0) selected_[j] = bestJ;
    if (bestI != oldI) wakeAround(i);
    if (j >= 0 && bestJ != oldJ) wakeAround(j);
    return bestI != oldI || (j >= 0 && bestJ != oldJ);
  }

  /// improve() looks at a square, a neighbour across its edge, that one's neighbours and theirs:
  /// what three rings of squares around i decide may change with i.
  void wakeAround(int i) {
    std::vector<int> near{i};
    for (int ring = 0; ring < 3; ++ring) {
      std::vector<int> wider;
      for (int square : near)
        for (int n : Q_.squares[square].node)
          for (int k = Q_.start[n]; k < Q_.start[n + 1]; ++k) wider.push_back(Q_.around[k].first);
      std::sort(wider.begin(), wider.end());
      wider.erase(std::unique(wider.begin(), wider.end()), wider.end());
      near = std::move(wider);
    }
    for (int square : near) awake_[square] = 1;
  }

  const SquareSurface& Q_;
  const Survey& survey_;
  int side_;
  Selection& selected_;
  std::vector<char> awake_ = {};  // [squares] 1: something near has changed since the last try
  bool halves_ = false;
};

/// The selected squares, each as two triangles.
TriangleTree treeOf(const Mesh& M, const SquareSurface& Q, const Selection& selected) {
  std::vector<std::array<int, 3>> triangles;
  for (std::size_t i = 0; i < selected.size(); ++i) {
    const std::array<int, 4>& n = Q.squares[i].node;
    if (!selected[i]) continue;
    triangles.push_back({n[0], n[1], n[2]});
    triangles.push_back({n[0], n[2], n[3]});
  }
  return {M.x, triangles};
}

/// 5000 × the area mean over S of max(0, dist(S, S_M)/h − 1.1)²: S must be near its approximation.
double uncovered(const TriangleTree& tree, double h, const SurfaceDistance& S) {
  constexpr double weight = 5000, allowed = 1.1;
  double sum = 0, area = 0;
  for (int t = 0; t < static_cast<int>(S.S.triangles.size()); ++t) {
    const std::array<Vec3, 3> c = cornersOf(S.S, t);
    const Vec3 middle = (1. / 3) * (c[0] + c[1] + c[2]);
    const double part = areaOf(S.S, t);
    area += part;
    if (triangleWithin(tree, middle, allowed * h) >= 0) continue;
    const double far = tree.closest(middle).distance / h - allowed;
    sum += part * far * far;
  }
  return weight * sum / area;
}

/// Where S has no square beside it because another surface is in the way: the place; empty:
/// nowhere.
///   tree  of the selected squares
std::string blockedPlace(const SquareSurface& Q, const SurfaceDistance& S, const Survey& survey,
                         int side, const TriangleTree& tree) {
  constexpr double missed = 2;  // [choice] of h from S to S_M: at the rim one square may be missing
  for (int i = 0; i < static_cast<int>(Q.squares.size()); ++i) {
    if (survey.free[i] || survey.excess[i] > 0 || !isOnSide(Q, survey, i, side, fullSquare))
      continue;
    const Vec3 onS = S.query(Q.squares[i].centre).point;
    if (triangleWithin(tree, onS, missed * Q.h) < 0) return placeText(onS);
  }
  return "";
}

/// [choice] Where S_M leaves a part of S out, as a finger whose squares are hidden in T: no
/// projection covers that. The place; empty: nowhere.
///   tree  of the selected squares
std::string leftOut(const TriangleTree& tree, double h, const SurfaceDistance& S) {
  constexpr double farthest = 4;  // of h, from a point of S to S_M
  for (const Vec3& p : S.S.points)
    if (triangleWithin(tree, p, farthest * h) < 0) return placeText(p);
  return "";
}

/// Marks for each sharp corner of S the nearest node of this side.
void markSharpCorners(const Mesh& M, const SquareSurface& Q, const SurfaceDistance& S, int side,
                      Survey& survey) {
  const RimCorners corners = rimCorners(S);
  for (int c = 0; c < 4; ++c) {
    if (!corners.sharp[c]) continue;
    const Vec3 point = S.S.points[S.rim[corners.at[c]]];
    int nearest = -1;
    for (int n : Q.nodes)
      if ((Q.isMiddle || survey.side[n] == side) &&
          (nearest < 0 || norm2(M.x[n] - point) < norm2(M.x[nearest] - point)))
        nearest = n;
    if (nearest >= 0) survey.sharp[nearest] = 1;
  }
}

/// surfaceExtraction() with the survey, which is the same for all ways.
Extraction extractSurface(const Mesh& M, const SquareSurface& Q, const SurfaceDistance& S,
                          Survey survey, int side, Outline outline) {
  constexpr int maxRounds = 50;
  markSharpCorners(M, Q, S, side, survey);
  Extraction result;
  result.selected = selectSquares(Q, survey, side);
  RimRegularization rim(Q, survey, side, result.selected);
  if (outline == Outline::paper) {
    for (int round = 0; round < maxRounds; ++round) {
      bool changed = removeThinProtrusions(Q, result.selected);
      changed |= fillHighConnectivityNodes(M, Q, result.selected);
      if (!changed) break;
    }
    keepLargestPart(Q, survey, result.selected);
  } else {
    rim.run(false);
    if (outline == Outline::halfSquares) rim.run(true);
  }
  const TriangleTree tree = treeOf(M, Q, result.selected);
  if (const std::string place = blockedPlace(Q, S, survey, side, tree); !place.empty()) {
    result.isBlocked = true;
    result.fault = "another surface is nearer to S than its squares, near " + place;
  } else if (const std::string noDisk = diskFault(Q, result.selected); !noDisk.empty())
    result.fault = "S_M is no disk, " + noDisk;
  else if (const std::string missing = leftOut(tree, Q.h, S); !missing.empty())
    result.fault = "S_M leaves out the part of S near " + missing;
  else
    result.energy = rim.energy() + uncovered(tree, Q.h, S);
  return result;
}

}  // namespace

Extraction surfaceExtraction(const Mesh& M, const SquareSurface& Q, const SurfaceDistance& S,
                             int side, Outline outline) {
  return extractSurface(M, Q, S, surveySquares(M, Q, S, Crew()), side, outline);
}

namespace {

/// The quarter of a square of ∂T in which a face lies.
int quarterOf(const Mesh& M, const SquareSurface& Q, int square, std::array<int, 3> face) {
  const Vec3 middle = (1. / 3) * (M.xi[face[0]] + M.xi[face[1]] + M.xi[face[2]]);
  const std::array<int, 4>& n = Q.squares[square].node;
  const Vec3 a = M.xi[n[0]], e1 = M.xi[n[1]] - a, e2 = M.xi[n[3]] - a;
  const double s = dot(middle - a, e1) / norm2(e1), t = dot(middle - a, e2) / norm2(e2);
  // the diagonals s = t and s + t = 1 part the square
  return t < s ? (s + t < 1 ? 0 : 1) : (s + t < 1 ? 3 : 2);
}

}  // namespace

void labelSurface(Bisection& B, const SquareSurface& Q, const Approximation& A,
                  const Selection& selected, int k) {
  Mesh& M = B.M;
  const Lattice lattice(Q.level);
  const KeyMap squareAt = squareNumbers(Q);
  std::array<std::int64_t, 3> half;
  std::vector<int> labelled;
  for (int E : markedOf(A.T))
    for (int i = 0; i < 4; ++i) {
      const int other = B.neighbour[E][i];
      if (other < 0 || A.T[other]) continue;
      if (!lattice.squareOf(M, faceOpposite(M.tets[E], i), half)) continue;
      const int square = squareAt.get(Lattice::key(half)) - 1;
      if (square < 0 || !selected[square]) continue;
      M.faceLabel[E][i] = k;
      auto& back = B.neighbour[other];
      M.faceLabel[other][std::find(back.begin(), back.end(), E) - back.begin()] = k;
      labelled.push_back(E), labelled.push_back(other);
    }
  // A half whose cut is not the mesh's diagonal: bisect that diagonal, the cut appears.
  const std::size_t firstSplit = B.splits.size();
  for (std::size_t i = 0; i < selected.size(); ++i) {
    if (selected[i] == emptySquare || selected[i] == fullSquare) continue;
    const Square& s = Q.squares[i];
    // halves 3 and 12 (corners 0,1,2 / 2,3,0) are cut from corner 0 to 2, 6 and 9 from 1 to 3
    const int cut = selected[i] == 3 || selected[i] == 12 ? 0 : 1;
    if (s.diagonal != cut) B.bisectEdge(s.node[1 - cut], s.node[3 - cut]);
  }
  for (std::size_t i = firstSplit; i < B.splits.size(); ++i) labelled.push_back(B.splits[i].child);
  for (int E : labelled)
    for (int i = 0; i < 4; ++i) {
      if (M.faceLabel[E][i] != k) continue;
      const std::array<int, 3> face = faceOpposite(M.tets[E], i);
      lattice.squareOf(M, face, half);
      const int square = squareAt.get(Lattice::key(half)) - 1;
      if (!(selected[square] >> quarterOf(M, Q, square, face) & 1)) M.faceLabel[E][i] = 0;
    }
}

SurfaceComplex::SurfaceComplex(const Bisection& B, int k)
    : surface(k), isNear_(B.M.tets.size(), 0) {
  const Mesh& M = B.M;
  std::vector<char> on(M.x.size(), 0);
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i)
      if (M.faceLabel[E][i] == k)
        for (int n : faceOpposite(M.tets[E], i)) on[n] = 1;
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    const std::array<int, 4>& z = M.tets[E];
    if (!on[z[0]] && !on[z[1]] && !on[z[2]] && !on[z[3]]) continue;
    isNear_[E] = 1, elements.push_back(static_cast<int>(E));
  }
  readEdges(B);
}

void SurfaceComplex::update(const Bisection& B, std::size_t firstSplit) {
  if (firstSplit == B.splits.size()) return;
  isNear_.resize(B.M.tets.size(), 0);
  // a new node of S_M lies on an edge of it: the elements there are parts of near ones
  for (std::size_t i = firstSplit; i < B.splits.size(); ++i)
    if (isNear_[B.splits[i].parent])
      isNear_[B.splits[i].child] = 1, elements.push_back(B.splits[i].child);
  readEdges(B);
}

void SurfaceComplex::readEdges(const Bisection& B) {
  node.assign(B.M.x.size(), 0), firstEdge_.assign(B.M.x.size(), -1);
  edges.clear();
  for (int E : elements)
    for (int i = 0; i < 4; ++i) {
      if (B.M.faceLabel[E][i] != surface || B.neighbour[E][i] < E) continue;  // once a face
      const std::array<int, 3> v = faceOpposite(B.M.tets[E], i);
      for (int e = 0; e < 3; ++e) {
        const auto [a, b] = std::minmax(v[e], v[(e + 1) % 3]);
        int at = edgeBetween(a, b);
        if (at < 0) {
          at = static_cast<int>(edges.size());
          edges.push_back({a, b, 0, firstEdge_[a]});
          firstEdge_[a] = at;
        }
        ++edges[at].faces;
        node[v[e]] = 1;
      }
    }
  for (const Edge& e : edges)
    if (e.faces == 1) node[e.a] = node[e.b] = 2;
}

int SurfaceComplex::edgeBetween(int a, int b) const {
  int at = firstEdge_[std::min(a, b)];
  while (at >= 0 && edges[at].b != std::max(a, b)) at = edges[at].next;
  return at;
}

namespace {

/// The vertices of a tetrahedron on S_M.
int nodesOn(const SurfaceComplex& SM, const std::array<int, 4>& z) {
  return (SM.node[z[0]] > 0) + (SM.node[z[1]] > 0) + (SM.node[z[2]] > 0) + (SM.node[z[3]] > 0);
}

constexpr int tetEdges[6][2] = {{0, 1}, {0, 2}, {0, 3}, {1, 2}, {1, 3}, {2, 3}};

/// Bisects the edges; true where there were any.
bool bisectEdges(Bisection& B, SurfaceComplex& SM, const std::vector<std::pair<int, int>>& edges) {
  const std::size_t splits = B.splits.size();
  for (const auto& [a, b] : edges) B.bisectEdge(a, b);
  SM.update(B, splits);
  return !edges.empty();
}

}  // namespace

bool refineTetrahedraWithTwoFaces(Bisection& B, SurfaceComplex& SM) {
  std::vector<int> refine;
  for (int E : SM.elements) {
    const std::array<int, 4>& label = B.M.faceLabel[E];
    if (std::count(label.begin(), label.end(), SM.surface) > 1) refine.push_back(E);
  }
  const std::size_t splits = B.splits.size();
  bisectOnce(B, refine);
  SM.update(B, splits);
  return !refine.empty();
}

bool refineFacesWithTwoRimEdges(Bisection& B, SurfaceComplex& SM) {
  std::vector<std::pair<int, int>> refine;
  for (int E : SM.elements)
    for (int i = 0; i < 4 && nodesOn(SM, B.M.tets[E]) > 2; ++i) {
      const std::array<int, 3> v = faceOpposite(B.M.tets[E], i);
      if (SM.node[v[0]] != 2 || SM.node[v[1]] != 2 || SM.node[v[2]] != 2) continue;
      int rimEdges = 0;
      for (int e = 0; e < 3; ++e) rimEdges += SM.isRimEdge(v[e], v[(e + 1) % 3]);
      if (rimEdges > 1) refine.push_back(refinementEdge(B.M, v));
    }
  return bisectEdges(B, SM, refine);
}

bool refineEdgesAcrossTheRim(Bisection& B, SurfaceComplex& SM) {
  std::vector<std::pair<int, int>> refine;
  for (const SurfaceComplex::Edge& e : SM.edges)
    if (e.faces > 1 && SM.node[e.a] == 2 && SM.node[e.b] == 2) refine.push_back({e.a, e.b});
  return bisectEdges(B, SM, refine);
}

bool refineEdgesBetweenSurfaces(Bisection& B, SurfaceComplex& SM) {
  std::vector<std::pair<int, int>> refine;
  for (int E : SM.elements)
    for (const auto& e : tetEdges) {
      const int a = B.M.tets[E][e[0]], b = B.M.tets[E][e[1]];
      if ((SM.node[a] && B.M.dimension[b] < 3 && !SM.node[b]) ||
          (SM.node[b] && B.M.dimension[a] < 3 && !SM.node[a]))
        refine.push_back({a, b});
    }
  return bisectEdges(B, SM, refine);
}

bool refineToFullSubcomplex(Bisection& B, SurfaceComplex& SM) {
  std::vector<std::pair<int, int>> refine;
  for (int E : SM.elements) {
    const std::array<int, 4>& z = B.M.tets[E];
    if (nodesOn(SM, z) < 2) continue;
    for (const auto& e : tetEdges)
      if (SM.node[z[e[0]]] && SM.node[z[e[1]]] && !SM.isEdge(z[e[0]], z[e[1]]))
        refine.push_back({z[e[0]], z[e[1]]});
    for (int i = 0; i < 4; ++i) {
      const std::array<int, 3> v = faceOpposite(z, i);
      if (B.M.faceLabel[E][i] != SM.surface && SM.isEdge(v[0], v[1]) && SM.isEdge(v[1], v[2]) &&
          SM.isEdge(v[2], v[0]))
        refine.push_back(refinementEdge(B.M, v));
    }
  }
  return bisectEdges(B, SM, refine);
}

int surfaceHealing(Bisection& B, int k) {
  constexpr int maxRounds = 30;  // [choice] rounds end after 2 to 5 where they end
  SurfaceComplex SM(B, k);
  for (int round = 1; round <= maxRounds; ++round) {
    bool changed = false;
    for (auto rule : {refineTetrahedraWithTwoFaces, refineFacesWithTwoRimEdges,
                      refineEdgesAcrossTheRim, refineEdgesBetweenSurfaces, refineToFullSubcomplex})
      changed |= rule(B, SM);
    if (!changed) return round;
  }
  throw MethodError("insertSurface (§3.5): the rules of surface healing do not settle after " +
                    std::to_string(maxRounds) + " rounds; lower l_c");
}

// ==== Tools for 3.6: sparse iterative solver ====================================================

namespace {

double innerProduct(const std::vector<Vec2>& a, const std::vector<Vec2>& b) {
  double sum = 0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += a[i].x * b[i].x + a[i].y * b[i].y;
  return sum;
}

double normOf(const std::vector<Vec2>& a) { return std::sqrt(innerProduct(a, a)); }

/// y += t a
void addMultiple(std::vector<Vec2>& y, double t, const std::vector<Vec2>& a) {
  for (std::size_t i = 0; i < y.size(); ++i) y[i] = y[i] + t * a[i];
}

/// Σ A_ij x_j over the entries [from, to) of row i.
Vec2 partOfRow(const SparseMatrix& A, int from, int to, const std::vector<Vec2>& x) {
  Vec2 sum;
  for (int k = from; k < to; ++k) sum = sum + A.value[k] * x[A.column[k]];
  return sum;
}

std::vector<Vec2> productOf(const SparseMatrix& A, const std::vector<Vec2>& x) {
  std::vector<Vec2> y(x.size());
  for (std::size_t i = 0; i < y.size(); ++i) y[i] = partOfRow(A, A.start[i], A.start[i + 1], x);
  return y;
}

/// b − A x
std::vector<Vec2> residualOf(const SparseMatrix& A, const std::vector<Vec2>& b,
                             const std::vector<Vec2>& x) {
  std::vector<Vec2> r = b;
  addMultiple(r, -1, productOf(A, x));
  return r;
}

/// [choice] ω of the preconditioner, in (0, 2): above 1 it reaches far across large surfaces.
constexpr double overRelaxation = 1.75;

/// Solves M z = r with M = (D + ωL) D⁻¹ (D + ωU), the symmetric successive over-relaxation (SSOR)
/// preconditioner of A = L + D + U; `diagonal` are the entries of D.
std::vector<Vec2> precondition(const SparseMatrix& A, const std::vector<int>& diagonal,
                               std::vector<Vec2> z) {
  const int n = static_cast<int>(z.size());
  for (int i = 0; i < n; ++i) {  // (D + ωL) z = r
    const Vec2 sum = partOfRow(A, A.start[i], diagonal[i], z);
    z[i] = (1 / A.value[diagonal[i]]) * (z[i] - overRelaxation * sum);
  }
  for (int i = n - 1; i >= 0; --i) {  // (D + ωU) z' = D z
    const Vec2 sum = partOfRow(A, diagonal[i] + 1, A.start[i + 1], z);
    z[i] = z[i] - (overRelaxation / A.value[diagonal[i]]) * sum;
  }
  return z;
}

/// The entry of each row's diagonal.
std::vector<int> diagonalOf(const SparseMatrix& A) {
  std::vector<int> diagonal;
  for (int i = 0; i + 1 < static_cast<int>(A.start.size()); ++i) {
    const auto row = A.column.begin() + A.start[i], end = A.column.begin() + A.start[i + 1];
    const auto at = std::lower_bound(row, end, i);
    diagonal.push_back(static_cast<int>(at - A.column.begin()));
    if (at == end || *at != i || A.value[diagonal[i]] == 0)
      throw SolverError("solveBiCGSTAB (§3.6): row " + std::to_string(i) +
                        " has no diagonal entry");
  }
  return diagonal;
}

/// BiCGSTAB from x until |r| <= goal, the bound or a breakdown (van der Vorst 1992).
///   returns the iterations
int bicgstabRun(const SparseMatrix& A, const std::vector<int>& diagonal, const std::vector<Vec2>& b,
                std::vector<Vec2>& x, double goal, int maxIterations) {
  std::vector<Vec2> r = residualOf(A, b, x), p = r;
  const std::vector<Vec2> r0 = r;
  double rho = innerProduct(r0, r);
  for (int iteration = 1; iteration <= maxIterations; ++iteration) {
    const std::vector<Vec2> pHat = precondition(A, diagonal, p), v = productOf(A, pHat);
    const double alpha = rho / innerProduct(r0, v);
    if (!std::isfinite(alpha)) return iteration;
    addMultiple(x, alpha, pHat);
    addMultiple(r, -alpha, v);  // r is now s
    if (normOf(r) <= goal) return iteration;

    const std::vector<Vec2> sHat = precondition(A, diagonal, r), t = productOf(A, sHat);
    const double omega = innerProduct(t, r) / innerProduct(t, t);
    if (!std::isfinite(omega)) return iteration;
    addMultiple(x, omega, sHat);
    addMultiple(r, -omega, t);
    if (normOf(r) <= goal) return iteration;

    const double rhoNew = innerProduct(r0, r), beta = rhoNew / rho * (alpha / omega);
    if (!std::isfinite(beta) || rhoNew == 0) return iteration;
    rho = rhoNew;
    addMultiple(p, -omega, v);
    for (std::size_t i = 0; i < p.size(); ++i) p[i] = r[i] + beta * p[i];
  }
  return maxIterations;
}

}  // namespace

int solveBiCGSTAB(const SparseMatrix& A, const std::vector<Vec2>& b, std::vector<Vec2>& x,
                  double tolerance, int maxIterations) {
  const std::vector<int> diagonal = diagonalOf(A);
  const double goal = tolerance * normOf(b);
  // The recurrence for r drifts from b − A x: a further run starts from the true one, also after a
  // breakdown.
  constexpr int maxRuns = 20;
  int iterations = 0;
  for (int run = 0; run < maxRuns && iterations < maxIterations; ++run) {
    if (normOf(residualOf(A, b, x)) <= goal) return iterations;
    iterations += bicgstabRun(A, diagonal, b, x, goal, maxIterations - iterations);
  }
  const double left = normOf(residualOf(A, b, x));
  if (left <= goal) return iterations;
  char text[160];
  std::snprintf(text, sizeof text,
                "solveBiCGSTAB (§3.6): relative residual %.3g after %d iterations, wanted %.3g",
                left / normOf(b), iterations, tolerance);
  throw SolverError(text);
}

// ==== 3.6 Surface projection ====================================================================

double tanHalfAngle(Vec3 a, Vec3 b) {
  constexpr double largestTan = 2e8;  // α within 1e-8 of π, where |a×b| is rounding
  const double sine = norm(cross(a, b)), cosine = dot(a, b), both = norm(a) * norm(b);
  return cosine >= 0 ? sine / (both + cosine) : std::min((both - cosine) / sine, largestTan);
}

namespace {

/// Compressed rows from entries; those of the same place are added.
struct Entry {
  int row, column;
  double value;
};
SparseMatrix compressRows(const std::vector<Entry>& entries, std::size_t rows) {
  std::vector<std::size_t> first(rows + 1, 0);  // of a row's entries in byRow
  for (const Entry& e : entries) ++first[e.row + 1];
  std::partial_sum(first.begin(), first.end(), first.begin());
  std::vector<Entry> byRow(entries.size());
  std::vector<std::size_t> next = first;
  for (const Entry& e : entries) byRow[next[e.row]++] = e;

  SparseMatrix A;
  A.start.push_back(0);
  for (std::size_t i = 0; i < rows; ++i) {
    const auto row = byRow.begin() + first[i], end = byRow.begin() + first[i + 1];
    std::stable_sort(row, end, [](const Entry& a, const Entry& b) { return a.column < b.column; });
    for (auto e = row; e != end; ++e)
      if (e != row && e->column == e[-1].column)
        A.value.back() += e->value;
      else
        A.column.push_back(e->column), A.value.push_back(e->value);
    A.start.push_back(static_cast<int>(A.column.size()));
  }
  return A;
}

[[noreturn]] void refuseSM(const std::string& what) {
  throw MethodError("insertSurface (§3.6): S_M " + what + "; lower l_c");
}

}  // namespace

SparseMatrix meanValueWeights(const std::vector<Vec3>& points,
                              const std::vector<std::array<int, 3>>& triangles,
                              const std::vector<char>& fixed) {
  std::vector<Entry> entries;
  for (const std::array<int, 3>& t : triangles)
    for (int c = 0; c < 3; ++c) {
      const int i = t[c], j = t[(c + 1) % 3], k = t[(c + 2) % 3];
      if (fixed[i]) continue;
      const Vec3 a = points[j] - points[i], b = points[k] - points[i];
      const double tangent = tanHalfAngle(a, b);  // tan(α/2) of the angle jik, for both its sides
      entries.push_back({i, j, tangent / norm(a)});
      entries.push_back({i, k, tangent / norm(b)});
    }
  SparseMatrix lambda = compressRows(entries, points.size());
  for (std::size_t i = 0; i < points.size(); ++i) {
    const auto from = lambda.value.begin() + lambda.start[i];
    const auto to = lambda.value.begin() + lambda.start[i + 1];
    const double sum = std::accumulate(from, to, 0.0);
    std::for_each(from, to, [sum](double& w) { w /= sum; });  // Σ_j λ_ij = 1
  }
  return lambda;
}

std::vector<Vec2> anchoredParametrization(const SparseMatrix& lambda,
                                          const std::vector<char>& isRim, std::vector<Vec2> u,
                                          const std::vector<double>& mu,
                                          const std::vector<Vec2>& anchor) {
  // Rows are the inner points, ring by ring from the rim: an order that suits the preconditioner.
  std::vector<int> row(u.size(), -1), point;
  auto add = [&](int n) {
    if (isRim[n] || row[n] >= 0) return;
    row[n] = static_cast<int>(point.size());
    point.push_back(n);
  };
  for (int n = 0; n < static_cast<int>(u.size()); ++n)
    for (int k = lambda.start[n]; k < lambda.start[n + 1]; ++k)
      if (isRim[lambda.column[k]]) add(n);
  for (std::size_t q = 0; q < point.size(); ++q)
    for (int k = lambda.start[point[q]]; k < lambda.start[point[q] + 1]; ++k) add(lambda.column[k]);
  std::vector<Entry> entries;
  std::vector<Vec2> b, x;
  for (int n : point) {
    entries.push_back({row[n], row[n], 1 + mu[n]});
    Vec2 right = mu[n] * anchor[n];
    for (int k = lambda.start[n]; k < lambda.start[n + 1]; ++k) {
      const int j = lambda.column[k];
      if (isRim[j])
        right = right + lambda.value[k] * u[j];
      else
        entries.push_back({row[n], row[j], -lambda.value[k]});
    }
    b.push_back(right);
    x.push_back(u[n]);
  }
  solveBiCGSTAB(compressRows(entries, point.size()), b, x);
  for (int n : point) u[n] = x[row[n]];
  return u;
}

std::vector<int> flippedTriangles(const std::vector<std::array<int, 3>>& triangles,
                                  const std::vector<Vec2>& u) {
  std::vector<int> flipped;
  for (int t = 0; t < static_cast<int>(triangles.size()); ++t) {
    const std::array<int, 3>& v = triangles[t];
    if (!(cross(u[v[1]] - u[v[0]], u[v[2]] - u[v[0]]) > 0)) flipped.push_back(t);
  }
  return flipped;
}

std::vector<Vec2> floaterParametrization(const std::vector<Vec3>& points,
                                         const std::vector<std::array<int, 3>>& triangles,
                                         const std::vector<char>& isRim, std::vector<Vec2> u) {
  const SparseMatrix lambda = meanValueWeights(points, triangles, isRim);
  for (std::size_t i = 0; i < u.size(); ++i)
    if (!isRim[i]) u[i] = {.5, .5};
  u = anchoredParametrization(lambda, isRim, u, std::vector<double>(u.size(), 0.0), u);
  const std::vector<int> flipped = flippedTriangles(triangles, u);
  if (!flipped.empty())
    throw MethodError("insertSurface (§3.6): Floater's map is self-folding in parameter space: " +
                      std::to_string(flipped.size()) +
                      " parametric triangles are not counter-clockwise, the first at " +
                      placeText(points[triangles[flipped[0]][0]]) +
                      "; remesh the surface there with better triangles, or lower l_c");
  return u;
}

namespace {

/// Bisects edge i of triangle t, and of its neighbour s (-1: none): the halves keep the
/// orientation.
void splitSurfaceEdge(TriangleSurface& S, int t, int i, int s) {
  const std::array<int, 3> T = S.triangles[t];
  const int a = T[i], b = T[(i + 1) % 3], c = T[(i + 2) % 3];
  const int m = static_cast<int>(S.points.size());
  S.points.push_back(.5 * (S.points[a] + S.points[b]));
  S.triangles[t] = {a, m, c};
  S.triangles.push_back({m, b, c});
  if (s < 0) return;
  const int d = S.triangles[s][(cornerAt(S.triangles[s], a) + 1) % 3];  // s is (b, a, d)
  S.triangles[s] = {b, m, d};
  S.triangles.push_back({m, a, d});
}

/// Bisects chords, or rim edges of a rim of three points, no two of them in one triangle.
///   returns how many
int splitChordsOnce(TriangleSurface& S) {
  const std::vector<std::array<int, 3>> neighbours = triangleNeighbours(S);
  const int N = static_cast<int>(S.triangles.size());
  std::vector<char> isRim(S.points.size(), 0), touched(N, 0);
  int rimEdges = 0, split = 0;
  for (int t = 0; t < N; ++t)
    for (int i = 0; i < 3; ++i) {
      if (neighbours[t][i] >= 0) continue;
      isRim[S.triangles[t][i]] = isRim[S.triangles[t][(i + 1) % 3]] = 1;
      ++rimEdges;
    }
  for (int t = 0; t < N; ++t)
    for (int i = 0; i < 3 && !touched[t]; ++i) {
      const int s = neighbours[t][i], a = S.triangles[t][i], b = S.triangles[t][(i + 1) % 3];
      const bool isChord = s >= 0 && isRim[a] && isRim[b];
      if (isChord ? touched[s] : s >= 0 || rimEdges > 3) continue;
      touched[t] = 1;
      if (s >= 0) touched[s] = 1;
      splitSurfaceEdge(S, t, i, s);
      ++split;
    }
  return split;
}

/// [choice] Window on either side of a rim point over which the rim's turning is measured, of the
/// rim's length: wider than the noise of real rims, narrower than the sides of all but very thin
/// surfaces. A second look over a third of it tells a sharp corner from a strong curve.
constexpr double cornerWindow = .03, narrowWindow = .01;
/// [choice] Least distance of two corners along the rim, of its length; for turns that are not
/// sharp the second, lest a rounded corner counts twice.
constexpr double cornerSpacing = .02, weakSpacing = .08;
constexpr double degree = 3.14159265358979323846 / 180;
/// [choice] Turns that make a corner of 𝓤, and a sharp corner of the geometry (over both windows).
constexpr double cornerTurn = 30 * degree, sharpTurn = 45 * degree, sharpTurnNarrow = 35 * degree;

/// A closed curve through these points of x.
Curve closedCurve(const std::vector<Vec3>& x, const std::vector<int>& loop) {
  Curve C;
  C.closed = true;
  C.s = {0};
  for (std::size_t i = 0; i < loop.size(); ++i) {
    C.points.push_back(x[loop[i]]);
    C.s.push_back(C.s.back() + norm(x[loop[(i + 1) % loop.size()]] - x[loop[i]]));
  }
  return C;
}

/// Distance along a closed curve of length L from arc length a to b > a, in (0, L]; then whichever
/// way is shorter.
double arcFrom(double a, double b, double L) { return b > a ? b - a : b - a + L; }
double arcBetween(double a, double b, double L) {
  return std::min(std::fabs(b - a), L - std::fabs(b - a));
}

/// Turn of the rim at arc length s between chords of length w, about `normal`; > 0 where S is
/// convex.
double rimTurn(const Curve& rim, double s, double w, Vec3 normal) {
  const Vec3 p = gamma(rim, s);
  Vec3 in = p - gamma(rim, s - w), out = gamma(rim, s + w) - p;
  in = in - dot(in, normal) * normal;
  out = out - dot(out, normal) * normal;
  return std::atan2(dot(cross(in, out), normal), dot(in, out));
}

/// The point of the rim nearest to the middle of the longest arc without a corner.
int middleOfLongestArc(const std::vector<double>& s, std::vector<int> chosen) {
  std::sort(chosen.begin(), chosen.end());
  const double L = s.back();
  double middle = 0, longest = -1;
  for (std::size_t c = 0; c < chosen.size(); ++c) {
    const double from = s[chosen[c]];
    const double arc = arcFrom(from, s[chosen[(c + 1) % chosen.size()]], L);
    if (arc <= longest) continue;
    longest = arc;
    middle = std::fmod(from + arc / 2, L);
  }
  int best = -1;
  for (int i = 0; i + 1 < static_cast<int>(s.size()); ++i) {
    if (std::find(chosen.begin(), chosen.end(), i) != chosen.end()) continue;
    if (best < 0 || arcBetween(middle, s[i], L) < arcBetween(middle, s[best], L)) best = i;
  }
  return best;
}

}  // namespace

void splitChords(TriangleSurface& S) {
  // a chord's new point is inside: one round, two where the rim had three points
  constexpr int maxRounds = 64;
  for (int round = 0; round < maxRounds && splitChordsOnce(S) > 0; ++round) {
  }
}

RimCorners rimCorners(const SurfaceDistance& S) {
  const int n = static_cast<int>(S.rim.size());
  if (n < 4)
    throw MethodError(
        "rimCorners (§3.6): the rim has fewer than four points; call splitChords() first");
  const Curve rim = closedCurve(S.S.points, S.rim);
  const double L = rim.s.back();
  auto turnAt = [&](int i, double window) {
    return rimTurn(rim, rim.s[i], window * L, S.vertexNormal[S.rim[i]]);
  };
  std::vector<std::pair<double, int>> byTurn;  // strongest first
  for (int i = 0; i < n; ++i) byTurn.push_back({-turnAt(i, cornerWindow), i});
  std::sort(byTurn.begin(), byTurn.end());
  std::vector<int> stronger, chosen;  // a corner is far from all points that turn more
  auto isFar = [&](const std::vector<int>& points, int i, double spacing) {
    return std::all_of(points.begin(), points.end(),
                       [&](int j) { return arcBetween(rim.s[j], rim.s[i], L) >= spacing * L; });
  };
  for (const auto& [minusTurn, i] : byTurn) {
    if (-minusTurn < cornerTurn || chosen.size() == 4) break;
    const bool isStrong = -minusTurn > sharpTurn || isFar(chosen, i, weakSpacing);
    if (isStrong && isFar(stronger, i, cornerSpacing)) chosen.push_back(i);
    stronger.push_back(i);
  }
  if (chosen.empty()) chosen.push_back(byTurn[0].second);
  while (chosen.size() < 4) chosen.push_back(middleOfLongestArc(rim.s, chosen));
  std::sort(chosen.begin(), chosen.end());

  RimCorners corners{};
  for (int c = 0; c < 4; ++c) {
    const int i = corners.at[c] = chosen[c];
    corners.sharp[c] =
        turnAt(i, cornerWindow) > sharpTurn && turnAt(i, narrowWindow) > sharpTurnNarrow;
  }
  return corners;
}

namespace {

/// Arcs of a closed curve from corner to corner go to the sides of 𝓤 by arc length; s in [0, L).
Vec2 rimParameter(const std::array<double, 4>& cornerS, double L, double s) {
  const int side = s < cornerS[1] ? 0 : s < cornerS[2] ? 1 : s < cornerS[3] ? 2 : 3;
  const double from = cornerS[side], to = side < 3 ? cornerS[side + 1] : L;
  const double t = std::clamp((s - from) / (to - from), 0.0, 1.0);
  return std::array<Vec2, 4>{{{t, 0}, {1, t}, {1 - t, 1}, {0, 1 - t}}}[side];
}

}  // namespace

SurfaceParametrization parametrizeSurface(const SurfaceDistance& S) {
  const RimCorners corners = rimCorners(S);
  std::vector<int> loop = S.rim;
  std::rotate(loop.begin(), loop.begin() + corners.at[0], loop.end());
  SurfaceParametrization Phi;
  Phi.rim = closedCurve(S.S.points, loop);
  Phi.sharp = corners.sharp;
  for (int c = 0; c < 4; ++c) Phi.cornerS[c] = Phi.rim.s[corners.at[c] - corners.at[0]];

  std::vector<Vec2> u(S.S.points.size()), uRim;
  for (std::size_t i = 0; i < loop.size(); ++i) {
    uRim.push_back(rimParameter(Phi.cornerS, Phi.rim.s.back(), Phi.rim.s[i]));
    u[loop[i]] = uRim.back();
  }
  Phi.rim.sides.push_back({0, uRim});
  Phi.surface.points = S.S.points;
  Phi.surface.triangles = S.S.triangles;
  Phi.surface.name = S.S.name;
  Phi.surface.u = floaterParametrization(S.S.points, S.S.triangles, S.isRimPoint, u);
  buildLocator(Phi.surface);
  return Phi;
}

namespace {

/// S_M with its own numbers: a disk oriented like S.
struct ApproximatingSurface {
  TriangleSurface S;                  // points are the nodes' positions
  std::vector<int> node;              // [points], number in M
  std::vector<int> rim;               // loop of points, S_M on its left
  std::vector<char> isRim;            // [points]
  double h = 0;                       // mean length of its edges
  std::vector<SurfaceQuery> nearest;  // [points], on the surface that is inserted
};

/// The faces labelled k with their own numbers, oriented consistently.
ApproximatingSurface labelledSurface(const Mesh& M, int k) {
  ApproximatingSurface SM;
  std::vector<int> number(M.x.size(), -1);
  for (std::array<int, 3> f : surfaceFaces(M, k)) {
    for (int& n : f) {
      if (number[n] < 0) {
        number[n] = static_cast<int>(SM.node.size());
        SM.node.push_back(n);
        SM.S.points.push_back(M.x[n]);
      }
      n = number[n];
    }
    SM.S.triangles.push_back(f);
  }
  if (SM.S.triangles.empty()) refuseSM("of surface " + std::to_string(k) + " has no face");
  const std::vector<std::array<int, 3>> neighbours = triangleNeighbours(SM.S);
  if (componentSizes(neighbours).size() != 1 || orientConsistently(SM.S, neighbours) < 0)
    refuseSM("is not one orientable piece");
  return SM;
}

ApproximatingSurface approximatingSurface(const Mesh& M, int k, const SurfaceDistance& S,
                                          const Crew& crew) {
  ApproximatingSurface SM = labelledSurface(M, k);
  const int points = static_cast<int>(SM.node.size());
  SM.nearest.resize(points);
  crew.forPieces(0, points, queryPiece, [&](int, int from, int to) {
    for (int i = from; i < to; ++i) SM.nearest[i] = S.query(SM.S.points[i]);
  });
  // The side of S's normals: by the nearest points of S, weighted by area.
  double agreement = 0;
  for (const std::array<int, 3>& t : SM.S.triangles) {
    const Vec3 a = SM.S.points[t[0]], b = SM.S.points[t[1]], c = SM.S.points[t[2]];
    for (int i : t) agreement += dot(cross(b - a, c - a), SM.nearest[i].normal);
    SM.h += (norm(b - a) + norm(c - b) + norm(a - c)) / (3 * double(SM.S.triangles.size()));
  }
  if (agreement < 0)
    for (std::array<int, 3>& t : SM.S.triangles) std::swap(t[1], t[2]);
  const std::vector<std::vector<int>> rims = rimLoops(SM.S);
  if (rims.size() != 1) refuseSM("has " + std::to_string(rims.size()) + " rims instead of one");
  if (rims[0].size() < 4) refuseSM("has only " + std::to_string(rims[0].size()) + " rim nodes");
  SM.rim = rims[0];
  SM.isRim.assign(SM.node.size(), 0);
  for (int n : SM.rim) SM.isRim[n] = 1;
  return SM;
}

/// The rim nodes of S_M matched to the four corners of S in cyclic order, with the least sum of
/// squared distances less bonus: for each partner of the first, dynamic programming over the
/// others.
std::array<int, 4> matchedCorners(const std::vector<Vec3>& rim, const std::vector<double>& bonus,
                                  const std::array<Vec3, 4>& corners) {
  const int m = static_cast<int>(rim.size());
  auto cost = [&](int i, int c) { return norm2(rim[i] - corners[c]) - bonus[i]; };
  std::array<int, 4> best{};
  double least = beyondAll;
  for (int first = 0; first < m; ++first) {
    // sum[c] is the least cost of corners 0 .. c placed so far, at[c] are their places
    std::array<double, 4> sum{cost(first, 0), beyondAll, beyondAll, beyondAll};
    std::array<std::array<int, 4>, 4> at{};
    at[0][0] = first;
    for (int i = (first + 1) % m; i != first; i = (i + 1) % m)
      for (int c = 3; c >= 1; --c) {
        const double with = sum[c - 1] + cost(i, c);
        if (with >= sum[c] || sum[c - 1] >= beyondAll) continue;
        sum[c] = with;
        at[c] = at[c - 1];
        at[c][c] = i;
      }
    if (sum[3] >= least) continue;
    least = sum[3];
    best = at[3];
  }
  return best;
}

/// [choice] What a convex rim node of S_M (a turn above 45 degrees) is worth as partner of a corner
/// of S, against squared distances over h².
constexpr double convexBonus = 1;
/// [choice] A corner holds no node that is farther away than this, in h: it would only trap
/// inverted elements.
constexpr double cornerReach = 2;
/// [choice] Weights of the correspondence of the rims, against squared distances over h²: 1 −
/// cosine of the two tangents, and (step on S / wanted step − 1)². Least and longest step, of the
/// wanted.
constexpr double tangentWeight = .5, stepWeight = .25, leastStep = .25, longestStep = 4;
/// [choice] Cost of one step over a slit, whose rim is near S_M all along: 4 steps twice as long as
/// wanted cost 1. Near: this far from S_M, in h.
constexpr double slitCost = 4, slitReach = 1.5;
/// [choice] Samples of S's rim per h, and per rim node of S_M at least: leastStep needs 3.
constexpr int samplesPerH = 6, samplesPerNode = 3;

/// A stretch of both rims between two pinned nodes.
struct RimArc {
  int first;                   // position in S_M's rim
  double from, length;         // on S's rim
  std::vector<double> wanted;  // [edges of S_M], their lengths, scaled to the sum `length`
};

/// [§3.6 departure] The samples of S's rim, of `count` on the arc, that the nodes at the ends of
/// the arc's edges go to: dynamic programming from edge to edge; the last node goes to the last
/// sample.
///   treeM  the triangles of S_M; where the rim of S stays near them, a step may pass over it: S_M
///          bridges a slit or an overlap of S that is narrower than its squares
std::vector<int> followArc(const Curve& rim, const Curve& rimM, const TriangleTree& treeM, double h,
                           const RimArc& arc, int count) {
  const int edges = static_cast<int>(arc.wanted.size()), m = static_cast<int>(rimM.points.size());
  const double ds = arc.length / count;
  std::vector<Vec3> at, tangent;  // [samples + 1]
  for (int k = 0; k <= count; ++k) {
    const double s = arc.from + k * ds;
    at.push_back(gamma(rim, s));
    tangent.push_back(unitVector(gamma(rim, s + h / 2) - gamma(rim, s - h / 2)));
  }
  std::vector<int> nearFrom(count + 1, 0);  // the first sample from which on to k all are near S_M
  for (int k = 1; k <= count; ++k)
    nearFrom[k] = treeM.closest(at[k], slitReach * h).triangle < 0 ? k : nearFrom[k - 1];
  // least[k]: cost of the nodes so far with the last at sample k; step[e][k]: its step, 0: none
  std::vector<double> least(count + 1, beyondAll), before, stepCost;
  std::vector<std::vector<int>> step(edges, std::vector<int>(count + 1, 0));
  least[0] = 0;
  for (int e = 0; e < edges; ++e) {
    const double wanted = arc.wanted[e] / ds;  // in samples
    const int lo = std::max(1, static_cast<int>(leastStep * wanted));
    const int hi = static_cast<int>(longestStep * wanted + 1);
    stepCost.assign(hi + 1, 0);
    for (int g = lo; g <= hi; ++g) stepCost[g] = stepWeight * (g / wanted - 1) * (g / wanted - 1);
    before.assign(count + 1, beyondAll);
    before.swap(least);
    const int i = (arc.first + e + 1) % m;
    const Vec3 x = rimM.points[i];
    const Vec3 tangentM = unitVector(rimM.points[(i + 1) % m] - rimM.points[(i + m - 1) % m]);
    int slit = -1;
    for (int k = lo; k <= count; ++k) {
      for (int g = lo; g <= std::min(hi, k); ++g)
        if (before[k - g] + stepCost[g] < least[k]) {
          least[k] = before[k - g] + stepCost[g];
          step[e][k] = g;
        }
      // over a slit: from the best sample since S's rim came near S_M
      if (k - hi - 1 >= nearFrom[k]) {
        if (slit < nearFrom[k] || before[k - hi - 1] < before[slit]) slit = k - hi - 1;
      }
      if (slit >= nearFrom[k] && slit >= 0 && before[slit] + slitCost < least[k]) {
        least[k] = before[slit] + slitCost;
        step[e][k] = k - slit;
      }
      if (least[k] < beyondAll)
        least[k] += norm2(x - at[k]) / (h * h) + tangentWeight * (1 - dot(tangentM, tangent[k]));
    }
  }
  std::vector<int> sample(edges, count);
  for (int e = edges - 1; e > 0; --e) sample[e - 1] = sample[e] - step[e][sample[e]];
  return sample;
}

/// Where the rim nodes of S_M go: arc length on S's rim, and the corner held (-1: none). [rim]
struct RimTargets {
  std::vector<double> s;
  std::vector<int> corner;
};

/// The pair of a rim node of S_M and a point of S's rim that are nearest.
std::pair<int, double> nearestPair(const std::vector<Vec3>& rimM, const Curve& rim, double h) {
  std::pair<int, double> best{0, 0};
  double least = beyondAll;
  for (double s = 0; s < rim.s.back(); s += h / samplesPerH) {
    const Vec3 p = gamma(rim, s);
    for (std::size_t i = 0; i < rimM.size(); ++i) {
      if (norm2(rimM[i] - p) >= least) continue;
      least = norm2(rimM[i] - p);
      best = {static_cast<int>(i), s};
    }
  }
  return best;
}

/// The bonus of S_M's rim nodes as partners of corners, squared length unit. Their turn is π less
/// the angles of their triangles, so that a fold of S_M is no turn. [rim]
std::vector<double> cornerBonus(const ApproximatingSurface& SM) {
  std::vector<double> turn(SM.S.points.size(), 180 * degree), bonus;
  for (const std::array<int, 3>& t : SM.S.triangles)
    for (int i = 0; i < 3; ++i) {
      const Vec3 p = SM.S.points[t[i]];
      const Vec3 a = SM.S.points[t[(i + 1) % 3]] - p, b = SM.S.points[t[(i + 2) % 3]] - p;
      turn[t[i]] -= std::atan2(norm(cross(a, b)), dot(a, b));
    }
  for (int n : SM.rim) bonus.push_back(turn[n] > sharpTurn ? convexBonus * SM.h * SM.h : 0);
  return bonus;
}

/// Where the rim goes between pinned nodes, the corners: by arc length, or [§3.6 departure]
/// following the nearest rim of S, pinned at sharp corners in reach only (where there is none, at
/// one node).
RimTargets rimTargets(const ApproximatingSurface& SM, const SurfaceParametrization& Phi,
                      bool followRim) {
  const int m = static_cast<int>(SM.rim.size());
  const double L = Phi.rim.s.back();
  const Curve rimM = closedCurve(SM.S.points, SM.rim);
  const TriangleTree treeM(SM.S.points, SM.S.triangles);
  std::array<Vec3, 4> corners;
  for (int c = 0; c < 4; ++c) corners[c] = gamma(Phi.rim, Phi.cornerS[c]);
  const std::array<int, 4> at = matchedCorners(rimM.points, cornerBonus(SM), corners);

  RimTargets targets{std::vector<double>(m), std::vector<int>(m, -1)};
  std::vector<std::pair<int, double>> pins;  // position in S_M's rim, arc length on S's
  for (int c = 0; c < 4; ++c) {
    const bool isHeld = Phi.sharp[c] && norm(rimM.points[at[c]] - corners[c]) <= cornerReach * SM.h;
    if (isHeld) targets.corner[at[c]] = c;
    if (isHeld || !followRim) pins.push_back({at[c], Phi.cornerS[c]});
  }
  if (pins.empty()) pins.push_back(nearestPair(rimM.points, Phi.rim, SM.h));
  for (std::size_t j = 0; j < pins.size(); ++j) {
    const auto [first, from] = pins[j];
    const auto [last, to] = pins[(j + 1) % pins.size()];
    RimArc arc{first, from, arcFrom(from, to, L), {}};
    const double scale = arc.length / arcFrom(rimM.s[first], rimM.s[last], rimM.s.back());
    for (int i = first; i != last || arc.wanted.empty(); i = (i + 1) % m)
      arc.wanted.push_back(scale * (rimM.s[i + 1] - rimM.s[i]));
    const int edges = static_cast<int>(arc.wanted.size());
    const int count =
        std::max(samplesPerNode * edges, static_cast<int>(samplesPerH * arc.length / SM.h));
    std::vector<int> sample;
    if (followRim) sample = followArc(Phi.rim, rimM, treeM, SM.h, arc, count);
    double s = from;
    for (int e = 0; e < edges; ++e) {
      targets.s[(first + e) % m] = s < L ? s : s - L;
      s = followRim ? from + sample[e] * (arc.length / count) : s + arc.wanted[e];
    }
  }
  return targets;
}

/// [choice] μ of the anchored equations, and its factor where a triangle folds.
constexpr double anchorMu = .3, foldedFactor = .2;
/// Rings of triangles around folded ones that lose their anchors: 0, 1, 3, 7 ... up to this.
constexpr int maxRings = 63;

/// Takes the anchors of the points of the triangles and of `rings` rings of triangles around away.
void weakenAnchors(const TriangleSurface& S, const std::vector<int>& triangles, int rings,
                   const std::vector<char>& held, std::vector<double>& mu) {
  std::vector<char> marked(S.points.size(), 0);
  for (int t : triangles)
    for (int n : S.triangles[t]) marked[n] = 1;
  for (int ring = 0; ring < rings; ++ring) {
    const std::vector<char> before = marked;
    for (const std::array<int, 3>& t : S.triangles)
      if (before[t[0]] || before[t[1]] || before[t[2]])
        for (int n : t) marked[n] = 1;
  }
  for (std::size_t i = 0; i < mu.size(); ++i)
    if (marked[i] && !held[i]) mu[i] *= foldedFactor;
}

/// The triangles of S_M that pass over a slit or an overlap of S: in 𝓤 the middle of an edge, from
/// anchor to anchor, belongs to a place of S far from it.
std::vector<char> bridgingTriangles(const ApproximatingSurface& SM, const Parametrization& Phi,
                                    const std::vector<Vec2>& anchor) {
  constexpr double far = 3;  // [choice] of h; a distorted map or a bent S stay below
  std::vector<char> bridges(SM.S.triangles.size(), 0);
  for (std::size_t t = 0; t < bridges.size(); ++t)
    for (int e = 0; e < 3; ++e) {
      const int a = SM.S.triangles[t][e], b = SM.S.triangles[t][(e + 1) % 3];
      const Vec3 middle = varphi(Phi, .5 * (anchor[a] + anchor[b]));
      if (norm(middle - .5 * (SM.S.points[a] + SM.S.points[b])) > far * SM.h) bridges[t] = 1;
    }
  return bridges;
}

/// [§3.6 departure] Nodes of bridging triangles keep their anchors, ϕ⁻¹ of the nearest point: the
/// map of one disk to the other cannot cross a slit that S_M does not have.
///   returns  the nodes that are held
std::vector<char> holdBridges(const ApproximatingSurface& SM, const std::vector<char>& bridges,
                              std::vector<double>& mu) {
  constexpr double heldMu = 1e6;  // of the sum of the λ: they no longer matter
  std::vector<char> held(mu.size(), 0);
  for (std::size_t t = 0; t < bridges.size(); ++t)
    for (int n : SM.S.triangles[t])
      if (bridges[t] && !SM.isRim[n]) held[n] = 1;
  for (std::size_t i = 0; i < mu.size(); ++i)
    if (held[i]) mu[i] = heldMu;
  return held;
}

/// [§3.6 departure] ϕ_M⁻¹ anchored at ϕ⁻¹ of the nearest points of S; where triangles fold the
/// anchors go, in growing rings, until none folds. Where some always do, as beside a bridge, the
/// map with the fewest: without anchors the limbs of S_M move along S by many h.
///   u  set at the rim
std::vector<Vec2> anchoredMap(const ApproximatingSurface& SM, const Parametrization& Phi,
                              std::vector<Vec2> u) {
  const std::vector<Vec2>& uS = Phi.u;
  std::vector<double> mu(u.size(), 0.0);
  for (std::size_t i = 0; i < u.size(); ++i) {
    if (SM.isRim[i]) continue;
    const SurfaceQuery& q = SM.nearest[i];
    const std::array<int, 3>& t = Phi.triangles[q.triangle];
    u[i] = q.w[0] * uS[t[0]] + q.w[1] * uS[t[1]] + q.w[2] * uS[t[2]];
    mu[i] = q.onRim ? 0 : anchorMu;
  }
  const SparseMatrix lambda = meanValueWeights(SM.S.points, SM.S.triangles, SM.isRim);
  const std::vector<Vec2> anchor = u;
  const std::vector<char> bridges = bridgingTriangles(SM, Phi, anchor);
  const std::vector<char> held = holdBridges(SM, bridges, mu);
  std::vector<Vec2> best;
  std::size_t fewest = SM.S.triangles.size() + 1;
  for (int rings = 0; rings <= maxRings; rings = 2 * rings + 1) {
    u = anchoredParametrization(lambda, SM.isRim, u, mu, anchor);
    std::vector<int> flipped;
    for (int t : flippedTriangles(SM.S.triangles, u))
      if (!bridges[t]) flipped.push_back(t);
    if (flipped.size() < fewest) fewest = flipped.size(), best = u;
    if (flipped.empty()) break;
    weakenAnchors(SM.S, flipped, rings, held, mu);
  }
  return best;
}

/// Places one node on the entity of this dimension.
void placeNode(Mesh& M, int n, int dimension, int entity, Vec2 parameter, Vec3 x) {
  M.dimension[n] = static_cast<unsigned char>(dimension);
  M.entity[n] = entity;
  M.parameter[n] = parameter;
  M.x[n] = x;
}

/// [§3.6, eq. (4)] x' = ϕ(ϕ_M⁻¹(x)) inside, γ(s) on the rim, the corner itself where one is held.
///   u, targets  ϕ_M⁻¹ of S_M's points, and of its rim along S's rim, the last curve of M
///   returns     the nodes held at corners
std::vector<int> placeNodes(Mesh& M, const ApproximatingSurface& SM, const std::vector<Vec2>& u,
                            const RimTargets& targets, const std::array<double, 4>& cornerS) {
  const int k = static_cast<int>(M.surfaces.size()), curve = static_cast<int>(M.curves.size());
  for (std::size_t i = 0; i < u.size(); ++i)
    if (!SM.isRim[i]) placeNode(M, SM.node[i], 2, k, u[i], varphi(M.surfaces[k - 1], u[i]));
  std::vector<int> held;
  for (std::size_t j = 0; j < SM.rim.size(); ++j) {
    const int n = SM.node[SM.rim[j]], c = targets.corner[j];
    const double s = targets.s[j];
    placeNode(M, n, 1, curve, {s, 0}, gamma(M.curves[curve - 1], s));
    if (c < 0) continue;
    M.corners.push_back({gamma(M.curves[curve - 1], cornerS[c]), {{curve, cornerS[c]}}});
    placeNode(M, n, 0, static_cast<int>(M.corners.size()), {0, 0}, M.corners.back().x);
    held.push_back(n);
  }
  return held;
}

/// [§3.6] surfaceProjection() with ϕ, which is the same for all ways and sizes.
ProjectionReport projectTo(Mesh& M, const SurfaceDistance& S, SurfaceParametrization Phi,
                           bool followRim, const Crew& crew) {
  const int k = static_cast<int>(M.surfaces.size()) + 1;
  const ApproximatingSurface SM = approximatingSurface(M, k, S, crew);
  const RimTargets targets = rimTargets(SM, Phi, followRim);
  std::vector<Vec2> u(SM.node.size());  // ϕ_M⁻¹, eq. (3)
  for (std::size_t i = 0; i < SM.rim.size(); ++i)
    u[SM.rim[i]] = rimParameter(Phi.cornerS, Phi.rim.s.back(), targets.s[i]);
  u = followRim ? anchoredMap(SM, Phi.surface, u)
                : floaterParametrization(SM.S.points, SM.S.triangles, SM.isRim, u);

  Phi.surface.rim = static_cast<int>(M.curves.size()) + 1;
  Phi.rim.sides[0].surface = k;
  M.surfaces.push_back(Phi.surface);
  M.curves.push_back(Phi.rim);
  ProjectionReport report;
  report.cornerNodes = placeNodes(M, SM, u, targets, Phi.cornerS);  // x', eq. (4)
  for (std::size_t i = 0; i < SM.node.size(); ++i) {
    const double shift = norm(M.x[SM.node[i]] - SM.nearest[i].point);
    report.tangentialShift = std::max(report.tangentialShift, shift);
  }
  return report;
}

}  // namespace

ProjectionReport surfaceProjection(Mesh& M, const TriangleSurface& cleaned, bool followRim) {
  TriangleSurface split = cleaned;
  splitChords(split);
  const SurfaceDistance S(split);
  const Crew alone;
  return projectTo(M, S, parametrizeSurface(S), followRim, alone);
}

// ==== 3. Surface insertion =======================================================================

InsertOptions InsertOptions::paper() {
  InsertOptions options;
  options.outline = Outline::paper;
  options.followRim = false;
  options.optimize = OptimizeOptions::paper();
  return options;
}

namespace {

/// Whether p lies in one of the tetrahedra.
bool contains(const Mesh& M, Vec3 p) {
  return std::any_of(M.tets.begin(), M.tets.end(),
                     [&](const std::array<int, 4>& z) { return holds(M.x, z, p); });
}

void checkOptions(const InsertOptions& options, std::size_t nodes) {
  constexpr int mostTets = 500000000;  // indices of four faces each fit in an int
  if (!(options.lc >= 0) || !std::isfinite(options.lc))
    throw InputError("insertSurface (§3.2): l_c = " + number(options.lc) +
                     " must be above 0, or 0 to be chosen");
  if (!(options.tolerance >= 0) || !std::isfinite(options.tolerance))
    throw InputError("insertSurface (§3.2): the tolerance " + number(options.tolerance) +
                     " must be above 0, or 0 for none");
  if (options.lc > 0 && options.tolerance > 0)
    throw InputError("insertSurface (§3.2): give l_c or a tolerance, not both");
  if (options.maxTets < 1 || options.maxTets > mostTets)
    throw InputError("insertSurface (§3.2): maxTets = " + std::to_string(options.maxTets) +
                     " must be from 1 to " + std::to_string(mostTets));
  checkOptions(options.optimize, nodes);
}

/// [choice] Of a surface's diagonal: what is as near as this touches. Coordinates far from their
/// origin (UTM) are good to 1e-10 of it.
constexpr double touching = 1e-9;

std::string at(const Gap& gap) {
  return " at triangle " + std::to_string(gap.triangle) + " near " + placeText(gap.point);
}

[[noreturn]] void refuseOutside(const std::string& where) {
  throw InputError("insertSurface (§3.1): S touches or leaves the domain" + where +
                   "; it must lie inside");
}

/// What the box of the domain tells of S as it is given, before needles that leave it are dropped
/// and anything is computed with coordinates far beyond it.
void checkInBox(const Mesh& M, const TriangleSurface& S) {
  checkNumbers(S);
  TriangleTree::Box box{M.x[0], M.x[0]};
  for (Vec3 x : M.x) growBox(box, x);
  for (const std::array<int, 3>& triangle : S.triangles)
    for (int n : triangle)
      if (const Vec3 p = S.points[n]; !boxesMeet(box, p, p))
        refuseOutside(" near " + placeText(p) + ": the domain is within " + placeText(box.lo) +
                      " to " + placeText(box.hi));
}

/// l_c against the distances of §3.1 and §3.2: S inside the domain, and clear of earlier surfaces.
void checkDistances(const Mesh& M, const SurfaceDistance& S, double lc) {
  const Gap gap = gapWithin(S.tree, M.x, patchFaces(M), aboveDiagonal * lc);
  if (gap.distance <= 0) refuseOutside(at(gap));
  if (!contains(M, S.S.points[0])) refuseOutside(" near " + placeText(S.S.points[0]));
  if (!(lc < gap.distance))
    throw InputError("insertSurface (§3.2): l_c = " + number(lc) + " is not below dist(∂M, S) = " +
                     number(gap.distance) + at(gap) + "; lower l_c");
}

/// l_c against the size of what comes: not more tetrahedra than allowed, not smaller than S.
void checkSize(const Mesh& M, const SurfaceDistance& S, double lc, int maxTets) {
  constexpr int maxLevel = 57;  // 2^19 cubes along a unit of ξ: what a lattice key holds
  const int level = cubeLevel(M, lc);
  const double h = cubeEdge(M, level);
  double farthest = 0, extent = 0;
  for (const Vec3& p : S.S.points) extent = std::max(extent, norm(p - S.S.points[S.rim[0]]));
  for (const Vec3& xi : M.xi) farthest = std::max({farthest, xi.x, xi.y, xi.z});
  if (extent < 2 * h)
    throw InputError("insertSurface (§3.2): S, of extent " + number(extent) +
                     ", is smaller than two cubes of edge " + number(h) + " that l_c = " +
                     number(lc) + " gives; lower l_c to " + number(.5 * lc * extent / (2 * h)));
  const double predicted = static_cast<double>(M.tets.size()) + predictedTets(areaOf(S.S), h);
  if (predicted > maxTets)
    throw InputError("insertSurface (§3.2): l_c = " + number(lc) + " asks for about " +
                     number(predicted) + " tetrahedra, above the limit of " +
                     std::to_string(maxTets) + "; raise l_c or maxTets");
  if (level > maxLevel || farthest > std::exp2((maxLevel - level) / 3))
    throw InputError("insertSurface (§3.2): l_c = " + number(lc) +
                     " is below 1/500000 of the domain; raise l_c");
}

/// One way to insert S: a side, and how the outline of S_M is made.
struct Way {
  int side;
  Outline outline;
  Extraction extraction;
};

/// Where S_M runs: [departure] on the cheapest cut through 𝓣 and what is around it, on a side of 𝓣,
/// or [departure] between the cubes whose centres are above S and those below.
enum class Course { cheapest, sides, centres };

/// The mesh refined by §3.2 and §3.3, 𝓣 or its middle, and its squares.
struct Layer {
  Mesh M = {};                                     // empty where a way has taken it
  std::vector<std::array<int, 4>> neighbour = {};  // of M, as faceNeighbours
  double lc = 0;
  Course course = Course::sides;
  Approximation A = {};
  SquareSurface Q = {};
  Survey survey = {};
};

/// The state of an insertion. The caller's mesh stays as it is.
struct Insertion {
  const Mesh& original;          // the caller's
  const std::vector<double>& q;  // of its elements
  const SurfaceDistance& S;
  const InsertOptions& options;
  const Crew& crew;
  int k;         // number of the new surface
  bool crosses;  // S itself
  Layer layer = {};
  SurfaceParametrization Phi = {};  // of S, once the first way needs it
  int ways = 0;                     // tried so far, over all l_c
  int faults = 0;                   // of which left,
  std::string reason = {};          // the last one why, without prefix and advice
  bool isBlocked = false;           // at this l_c, by an earlier surface
  bool wasBlocked = false;          // at some l_c
  double lowest = 0;                // q of the best way so far
  double worth = 0;                 // and that with its mean

  void stage(const char* name, const Mesh& mesh) const {
    if (options.onStage) options.onStage(name, mesh);
  }
  void progress(const std::string& line) const {
    if (options.onProgress) options.onProgress(line);
  }
  void leave(const std::string& what, const Error& error) {
    const std::string message = error.what();
    const std::size_t start = message.find("): ");
    reason = message.substr(start == std::string::npos ? 0 : start + 3);
    reason = reason.substr(0, reason.find("; "));
    ++faults;
    progress(what + " left: " + reason);
  }
};

std::string describe(const std::vector<Crossing>& crossings) {
  const std::string pairs = crossings.size() == 1 ? " pair" : " pairs";
  return "S crosses or touches itself in " + std::to_string(crossings.size()) + pairs +
         " of triangles, the first near " + placeText(crossings[0].point);
}

std::string describe(const Way& way) {
  return std::string(way.side > 0   ? "positive side"
                     : way.side < 0 ? "negative side"
                                    : "middle") +
         ", " + (way.outline == Outline::halfSquares ? "half squares" : "whole squares");
}

/// [choice] Sides whose rim energies differ by no more are as good as mirrored, and end alike (to
/// .004 in the lowest q): one is enough.
constexpr double mirrored = .01;

/// A copy with room for more: vectors that double are copied again and again.
Mesh roomyCopy(const Mesh& M, double moreTets) {
  constexpr double nodesPerTet = .22;  // of fine meshes
  const std::size_t tets = M.tets.size() + static_cast<std::size_t>(moreTets);
  const std::size_t nodes = M.x.size() + static_cast<std::size_t>(nodesPerTet * moreTets);
  Mesh copy;
  copy.x.reserve(nodes), copy.xi.reserve(nodes), copy.parameter.reserve(nodes);
  copy.dimension.reserve(nodes), copy.entity.reserve(nodes);
  copy.tets.reserve(tets), copy.faceLabel.reserve(tets);
  copy.type.reserve(tets), copy.level.reserve(tets);
  copy = M;
  return copy;
}

/// S must not cross the faces of earlier surfaces, which deviate from these: refined with T they
/// come nearer.
void checkFacesApart(Insertion& I) {
  const Gap gap = gapWithin(I.S.tree, I.layer.M.x, facesAround(I.layer.M, I.S, 0), DBL_MIN);
  if (gap.triangle < 0) return;
  I.isBlocked = true;
  throw MethodError("insertSurface (§3.2): S crosses the faces of an earlier surface" + at(gap) +
                    "; lower l_c");
}

/// §3.2 and §3.3 on a copy of the caller's mesh: 𝓣, or its middle. isAgain: to the same bytes,
/// without stages and checks.
void refineLayer(Insertion& I, bool isAgain) {
  constexpr double cheapest = 1.5, centres = 1000;  // [choice] of middleApproximation()
  Layer& layer = I.layer;
  layer.A = {};
  const double h = cubeEdge(I.original, cubeLevel(I.original, layer.lc));
  layer.M = roomyCopy(I.original, predictedTets(areaOf(I.S.S), h));
  Bisection B(layer.M);
  layer.A = volumetricApproximation(B, I.S, layer.lc, I.crew);
  if (!isAgain) I.stage("approximated", layer.M);
  if (!isAgain) checkFacesApart(I);
  volumetricHealing(B, layer.A);
  if (layer.course != Course::sides) {
    const double perDistance = layer.course == Course::cheapest ? cheapest : centres;
    layer.A = middleApproximation(B, layer.A, I.S, perDistance, I.crew);
    volumetricHealing(B, layer.A);
  }
  layer.neighbour = std::move(B.neighbour);
}

/// The same again where the mesh was taken.
void restoreLayer(Insertion& I) {
  if (I.layer.M.tets.empty()) refineLayer(I, true);
}

/// §3.4 on both sides, or in the middle: the ways to go on with this outline, best first.
std::vector<Way> extractWays(Insertion& I, Outline outline) {
  restoreLayer(I);
  std::vector<Way> ways;
  for (int side : I.layer.Q.isMiddle ? std::vector<int>{0} : std::vector<int>{1, -1}) {
    Way way{side, outline,
            extractSurface(I.layer.M, I.layer.Q, I.S, I.layer.survey, side, outline)};
    I.isBlocked = I.isBlocked || way.extraction.isBlocked;
    if (way.extraction.fault.empty())
      ways.push_back(std::move(way));
    else
      I.leave(describe(way), MethodError("insertSurface (§3.4): " + way.extraction.fault));
  }
  if (ways.size() < 2) return ways;
  const double first = ways[0].extraction.energy, second = ways[1].extraction.energy;
  if (second < first) std::swap(ways[0], ways[1]);
  if (std::abs(first - second) < mirrored * std::max(first, second)) ways.pop_back();
  return ways;
}

/// Nodes of S_M and their neighbours: where the optimization starts.
std::vector<int> nodesNearSurface(const Mesh& M, int k) {
  std::vector<char> near(M.x.size(), 0), on(M.x.size(), 0);
  for (const auto& face : surfaceFaces(M, k))
    for (int n : face) on[n] = 1;
  for (const std::array<int, 4>& z : M.tets)
    if (on[z[0]] || on[z[1]] || on[z[2]] || on[z[3]])
      for (int n : z) near[n] = 1;
  return markedOf(near);
}

/// Lowest q of the elements at S_M and of their neighbours.
double lowestNear(const Mesh& M, int k) {
  std::vector<char> near(M.x.size(), 0);
  for (int n : nodesNearSurface(M, k)) near[n] = 1;
  double lowest = 1;
  for (const std::array<int, 4>& z : M.tets)
    if (near[z[0]] || near[z[1]] || near[z[2]] || near[z[3]])
      lowest = std::min(lowest, quality(jacobian({M.xi[z[0]], M.xi[z[1]], M.xi[z[2]], M.xi[z[3]]},
                                                 {M.x[z[0]], M.x[z[1]], M.x[z[2]], M.x[z[3]]})));
  return lowest;
}

/// Lets a node fixed at a sharp corner of S slide along the rim.
void releaseCorner(Mesh& M, int n, int k) {
  const int rim = M.surfaces[k - 1].rim;
  double s;
  if (M.dimension[n] == 0 && parameterOnCurve(M, n, rim, s))
    M.dimension[n] = 1, M.entity[n] = rim, M.parameter[n] = {s, 0};
}

/// Releases the corners of these elements and bisects them: more freedom. Returns the nodes around.
std::vector<int> loosen(Mesh& M, const std::vector<int>& elements, int k) {
  std::vector<int> nodes;
  const std::size_t before = M.x.size();
  Bisection B(M);
  for (int E : elements) {
    for (int n : M.tets[E]) {
      releaseCorner(M, n, k);
      nodes.push_back(n);
    }
    B.bisect(E);
  }
  surfaceHealing(B, k);
  for (std::size_t n = before; n < M.x.size(); ++n) nodes.push_back(static_cast<int>(n));
  return nodes;
}

/// A global descent of the nodes around these elements, for what no single node can leave.
OptimizeReport descendAround(Mesh& M, const std::vector<int>& elements, OptimizeOptions optimize) {
  optimize.globalDescent = true, optimize.maxTangledSweeps = 1, optimize.active.clear();
  for (int E : elements)
    optimize.active.insert(optimize.active.end(), M.tets[E].begin(), M.tets[E].end());
  return optimizeMesh(M, optimize);
}

/// [choice] Tangled sweeps after which a way is put aside while there are others: most are valid
/// after 1 to 4, and those that need more are seldom better in the end (by .01 in the lowest q).
constexpr int impatientSweeps = 12;

/// §3.7, and [departure] where a few elements stay inverted, or poor as where S_M bridges a slit:
/// these are loosened, as long as there are fewer inverted ones, or the lowest q rises; where that
/// does not help inverted ones, the nodes around them descend together. No global descent of all:
/// other ways of inserting S are cheaper.
///   patient  false: a mesh that is still tangled after a few sweeps is left as it is
///   active   the nodes to start from
void optimizeAround(Mesh& M, const Insertion& I, bool patient, const std::vector<int>& active,
                    InsertReport& report) {
  constexpr int maxRounds = 8;
  constexpr int patientSweeps = 150;  // while tangled, of a loosened mesh: few elements are left
  constexpr std::size_t few = 60;
  constexpr double leastDescended = .1;  // what a descent has to reach: half of l_c is better then
  constexpr double poorQuality = .55;    // below it the worst are loosened: those below
  constexpr double factors[] = {1.1, 1.3, 1.7, 2.2};  // of the lowest q, in turn while it stays
  OptimizeOptions optimize = I.options.optimize;
  optimize.globalDescent = false;
  if (I.options.outline != Outline::paper) optimize.active = active;  // the paper: all nodes
  if (!patient) optimize.maxTangledSweeps = std::min(optimize.maxTangledSweeps, impatientSweeps);
  OptimizeReport& best = report.optimization;
  best = optimizeMesh(M, optimize);
  if (!patient && best.inverted > 0) return;
  optimize.maxTangledSweeps = I.options.optimize.maxTangledSweeps;  // loosened it may need them
  const double* factor = std::begin(factors);
  for (int round = 0; round < maxRounds; ++round) {
    const bool valid = best.inverted == 0;
    if (valid && (optimize.power == 1 || best.minQ >= poorQuality)) return;
    const std::vector<double> q = qualities(M);
    std::vector<int> bad;
    for (std::size_t E = 0; E < q.size(); ++E)
      if (q[E] <= *factor * best.minQ) bad.push_back(static_cast<int>(E));
    if (bad.size() > few) return;
    Mesh trial = M;
    optimize.active = loosen(trial, bad, I.k);
    if (!valid) optimize.active.clear(), optimize.maxTangledSweeps = patientSweeps;
    OptimizeReport after = optimizeMesh(trial, optimize);
    bool better =
        valid ? after.inverted == 0 && after.minQ > best.minQ : after.inverted < best.inverted;
    if (!valid && !better && I.options.optimize.globalDescent) {
      trial = M;
      after = descendAround(trial, bad, optimize);
      better = after.minQ >= leastDescended;
    }
    after.sweeps += best.sweeps;
    after.visits += best.visits;
    if (!better && (!valid || ++factor == std::end(factors))) return;
    if (better) M = std::move(trial), best = after;
  }
}

/// A corner of the first inverted element.
Vec3 firstInverted(const Mesh& M) {
  const std::vector<double> q = qualities(M);
  return M.x[M.tets[std::min_element(q.begin(), q.end()) - q.begin()][0]];
}

/// [choice] From so many elements on a way takes the refined mesh for itself instead of a copy, a
/// fifth of all memory; a second way refines anew.
constexpr std::size_t tooLargeToCopy = 200000;

/// §3.4's labels and 3.5 on the refined mesh. Returns the rounds of healing.
int labelAndHeal(Insertion& I, const Way& way, Mesh& M) {
  restoreLayer(I);
  Layer& layer = I.layer;
  const bool take = layer.M.tets.size() >= tooLargeToCopy;
  M = take ? std::move(layer.M) : layer.M;
  Bisection B(M, take ? std::move(layer.neighbour) : layer.neighbour);
  if (take) layer.M = {}, layer.neighbour = {};
  labelSurface(B, layer.Q, layer.A, way.extraction.selected, I.k);
  ++I.ways;
  I.stage("extracted", M);
  return surfaceHealing(B, I.k);
}

/// §3.6 on the healed mesh, with Table I's columns before and after it.
void project(Insertion& I, Mesh& M, InsertReport& report) {
  const std::vector<double> healed = qualities(M, I.original.x, I.q);
  const std::vector<Vec3> before = M.x;
  report.refined = qualityStatistics(healed);
  if (I.Phi.surface.u.empty()) I.Phi = parametrizeSurface(I.S);
  const ProjectionReport projection = projectTo(M, I.S, I.Phi, I.options.followRim, I.crew);
  report.tangentialShift = projection.tangentialShift;
  report.projected = qualityStatistics(qualities(M, before, healed));
}

/// §3.4's labels, 3.5, 3.6 and 3.7 on the refined mesh, which becomes M.
///   returns  false: put aside, still tangled
bool insertOnWay(Insertion& I, const Way& way, bool patient, Mesh& M, InsertReport& report) {
  const int rounds = labelAndHeal(I, way, M);
  report.way = I.ways;
  I.stage("surfaceHealed", M);
  I.progress("3.5 surface healing: " + std::to_string(rounds) + " rounds, " +
             std::to_string(M.tets.size()) + " tetrahedra (" + describe(way) + ")");
  project(I, M, report);
  I.stage("projected", M);
  I.progress("3.6 projection: " + std::to_string(report.projected.inverted) + " inverted");
  optimizeAround(M, I, patient, nodesNearSurface(M, I.k), report);
  report.smoothed = report.optimization.quality;
  I.progress("3.7 optimization: " + std::to_string(report.optimization.sweeps) + " sweeps, " +
             std::to_string(report.smoothed.inverted) + " inverted, min " +
             number(report.smoothed.min) + ", mean " + number(report.smoothed.mean));
  if (report.smoothed.inverted == 0) return true;
  if (patient)
    throw MethodError("insertSurface (§3.7): " + std::to_string(report.smoothed.inverted) +
                      " elements stay inverted, of " + std::to_string(report.projected.inverted) +
                      " after the projection, the first near " + placeText(firstInverted(M)));
  I.progress(describe(way) + " put aside: other ways first");
  return false;
}

constexpr int distanceSamples = 4;     // along the edges of triangles, for the Hausdorff distance
constexpr double distancePerLc = .25;  // [choice] of l_c, between samples of large triangles of S

/// The measures of S_M that the report promises.
///   errors  MethodError: a node of it is off S
void measureSurface(const Mesh& M, const SurfaceDistance& S, InsertReport& report,
                    const Crew& crew) {
  const std::vector<std::array<int, 3>> faces = surfaceFaces(M, report.surface);
  std::vector<char> on(M.x.size(), 0);
  for (const auto& face : faces)
    for (int n : face) on[n] = 1;
  const std::vector<int> nodes = markedOf(on);
  report.nodes = static_cast<int>(nodes.size());
  std::vector<double> distance(nodes.size());
  crew.forPieces(0, report.nodes, queryPiece, [&](int, int from, int to) {
    for (int i = from; i < to; ++i) distance[i] = S.query(M.x[nodes[i]]).distance;
  });
  report.maxNodeDistance = 0;
  for (double d : distance) report.maxNodeDistance = std::max(report.maxNodeDistance, d);
  // [choice] on S: 1e-12 of its diagonal, and the last digits of coordinates far from the origin
  const TriangleTree::Box& box = S.tree.nodes[0].box;
  const double allowed = 1e-12 * norm(box.hi - box.lo) + 1e-15 * (norm(box.hi) + norm(box.lo));
  if (report.maxNodeDistance > allowed)
    throw MethodError("insertSurface (§3.6): a node of S_M is " + number(report.maxNodeDistance) +
                      " away from S");
  report.triangles = static_cast<int>(faces.size());
  const Width farthest = farthestPoint(TriangleTree(M.x, faces), S.tree, distanceSamples,
                                       distancePerLc * report.lc, crew);
  report.hausdorff = farthest.distance, report.hausdorffPlace = farthest.place;
}

/// [choice] Of l_c: a Hausdorff distance S_M - S that is warned of; and what such a way's lowest q
/// counts when ways are compared.
constexpr double poorHausdorff = .3, poorWorth = .6;

constexpr double badHausdorff = .45;  // [choice] of l_c: refused

/// [choice] A way is better than another one where its lowest q and its mean together are higher by
/// more.
constexpr double betterBy = .01;

/// What the lowest q of a way counts; beside earlier surfaces, of which it may be on every way, the
/// lowest near S.
double countedQuality(const Insertion& I, const Mesh& M, const InsertReport& report) {
  const double lowest = I.k > 1 ? lowestNear(M, I.k) : report.smoothed.min;
  return report.hausdorff > poorHausdorff * report.lc ? poorWorth * lowest : lowest;
}

/// Refuses S_M where it is far from S, and warns where it is poor.
void judgeSurface(double h, InsertReport& report) {
  constexpr double poorShift = 2;  // [choice] of h: warned of
  const std::string found = "the Hausdorff distance S_M - S is " + number(report.hausdorff) +
                            " near " + placeText(report.hausdorffPlace);
  if (report.hausdorff > badHausdorff * report.lc)
    throw MethodError("insertSurface (§3.6): " + found +
                      ", above .45 l_c: S has a part narrower than the cubes");
  if (report.hausdorff > poorHausdorff * report.lc)
    report.warnings.push_back(found + ", above .3 l_c: S bends or narrows there within the cubes" +
                              "; lower l_c");
  if (report.tangentialShift > poorShift * h)
    report.warnings.push_back("the projection moved a node " + number(report.tangentialShift) +
                              " along S, more than 2 cube edges; lower l_c");
}

/// Calls visit(w) for the points of a lattice on a triangle, `steps` along its edges: w are their
/// barycentric coordinates.
template <class Visit>
void forLattice(int steps, Visit visit) {
  for (int i = 0; i <= steps; ++i)
    for (int j = 0; i + j <= steps; ++j)
      visit((1. / steps) * Vec3{double(steps - i - j), double(i), double(j)});
}

Vec3 at(const std::array<Vec3, 3>& c, Vec3 w) { return w.x * c[0] + w.y * c[1] + w.z * c[2]; }

/// The faces of S_M that are farther than `allowed` from S somewhere, or whose part of 𝓤 belongs
/// to points of S that are as far from S_M.
std::vector<std::array<int, 3>> farFaces(const Mesh& M, const SurfaceDistance& S, int k,
                                         double allowed, double spacing) {
  const Parametrization& P = M.surfaces[k - 1];
  const ApproximatingSurface SM = labelledSurface(M, k);
  Parametrization PM;
  PM.points = SM.S.points, PM.triangles = SM.S.triangles, PM.u.resize(SM.node.size());
  for (std::size_t i = 0; i < SM.node.size(); ++i) parameterOn(M, SM.node[i], k, PM.u[i]);
  buildLocator(PM);
  const TriangleTree tree(PM.points, PM.triangles);
  std::vector<char> isFar(PM.triangles.size(), 0);
  for (std::size_t t = 0; t < isFar.size(); ++t) {
    const std::array<Vec3, 3> c = cornersOf(SM.S, static_cast<int>(t));
    forLattice(distanceSamples, [&](Vec3 w) {
      if (!isFar[t]) isFar[t] = triangleWithin(S.tree, at(c, w), allowed) < 0;
    });
  }
  for (const std::array<int, 3>& t : P.triangles) {
    const std::array<Vec3, 3> c{P.points[t[0]], P.points[t[1]], P.points[t[2]]};
    const double longest = std::max({norm(c[1] - c[0]), norm(c[2] - c[1]), norm(c[0] - c[2])});
    const int steps = std::max(distanceSamples, static_cast<int>(std::ceil(longest / spacing)));
    forLattice(steps, [&](Vec3 w) {
      if (triangleWithin(tree, at(c, w), allowed) >= 0) return;
      const int inU = locate(PM, w.x * P.u[t[0]] + w.y * P.u[t[1]] + w.z * P.u[t[2]]).triangle;
      isFar[inU >= 0 ? inU : tree.closest(at(c, w)).triangle] = 1;  // beyond the rim the nearest
    });
  }
  std::vector<std::array<int, 3>> faces;
  for (std::size_t t = 0; t < isFar.size(); ++t) {
    const std::array<int, 3>& v = PM.triangles[t];
    if (isFar[t]) faces.push_back({SM.node[v[0]], SM.node[v[1]], SM.node[v[2]]});
  }
  return faces;
}

/// [departure] Where S_M passes over a pit of S, or a fin, that is narrower than the cubes, so that
/// it would be warned of or refused: the edges of its faces there are bisected, and the mesh is
/// smoothed again, as long as the distance falls. Finer cubes there alone, that is.
void refineFarFaces(const Insertion& I, Mesh& M, InsertReport& report) {
  constexpr int maxRounds = 6;
  constexpr double wanted = .25;  // [choice] of l_c: with room to what is warned of
  const double lc = report.lc;
  if (report.hausdorff <= poorHausdorff * lc) return;
  for (int round = 0; round < maxRounds && report.hausdorff > wanted * lc; ++round) {
    Mesh trial = M;
    Bisection B(trial);
    std::vector<int> active;
    for (const auto& face : farFaces(M, I.S, I.k, wanted * lc, distancePerLc * lc))
      for (int e = 0; e < 3; ++e) {
        active.push_back(face[e]);
        B.bisectEdge(face[e], face[(e + 1) % 3]);
      }
    surfaceHealing(B, I.k);
    for (std::size_t n = M.x.size(); n < trial.x.size(); ++n) active.push_back(static_cast<int>(n));
    InsertReport after = report;
    optimizeAround(trial, I, true, active, after);
    if (after.optimization.inverted > 0) return;
    after.smoothed = after.optimization.quality;
    measureSurface(trial, I.S, after, I.crew);
    I.progress("3.7 refined where S_M is far from S: " + number(after.hausdorff / lc) + " l_c, " +
               std::to_string(trial.tets.size()) + " tetrahedra, min " +
               number(after.smoothed.min));
    const bool enough = report.hausdorff <= badHausdorff * lc;  // then what q counts may not fall
    if (after.hausdorff >= report.hausdorff) return;
    if (enough && countedQuality(I, trial, after) < countedQuality(I, M, report) - betterBy) return;
    after.optimization.sweeps += report.optimization.sweeps;
    after.optimization.visits += report.optimization.visits;
    M = std::move(trial), report = after;
  }
}

/// Follows one way; keeps its mesh and report where it is the best valid one so far.
///   returns  false: put aside
bool tryWay(Insertion& I, const Way& way, bool patient, Mesh& result, InsertReport& report) {
  const double lc = I.layer.lc;
  Mesh trial;
  InsertReport ofThisWay;
  ofThisWay.original = report.original;
  ofThisWay.surface = I.k, ofThisWay.lc = lc;
  try {
    if (!insertOnWay(I, way, patient, trial, ofThisWay)) return false;
    measureSurface(trial, I.S, ofThisWay, I.crew);
    I.progress("S_M: Hausdorff distance " + number(ofThisWay.hausdorff) + ", " +
               number(ofThisWay.hausdorff / lc) + " l_c");
    refineFarFaces(I, trial, ofThisWay);
    judgeSurface(I.layer.Q.h, ofThisWay);
  } catch (const MethodError& error) {
    I.leave(describe(way), error);
    return true;
  } catch (const SolverError& error) {
    I.leave(describe(way), error);
    return true;
  }
  const double lowest = countedQuality(I, trial, ofThisWay);
  const double worth = lowest + ofThisWay.smoothed.mean;
  if (report.surface == 0 || worth > I.worth + betterBy)
    report = ofThisWay, result = std::move(trial), I.lowest = lowest, I.worth = worth;
  return true;
}

/// The squares of 𝓣, or of its middle, and what they know of S.
void survey(Insertion& I) {
  Layer& layer = I.layer;
  layer.Q = boundarySquares(layer.M, layer.A);
  if (!layer.Q.fault.empty() && I.options.outline == Outline::paper)
    throw MethodError("insertSurface (§3.3): " + layer.Q.fault + "; lower l_c");
  if (!layer.Q.fault.empty())
    I.progress("3.3 healing: " + layer.Q.fault + "; S_M may still be a disk");
  layer.survey = surveySquares(layer.M, layer.Q, I.S, I.crew);
  I.stage("healed", layer.M);
  I.progress((layer.Q.isMiddle ? "3.3 middle: " : "3.2-3.3 approximation: ") +
             std::to_string(layer.M.tets.size()) + " tetrahedra, " +
             std::to_string(layer.Q.squares.size()) +
             " squares around S, h = " + number(layer.Q.h));
}

constexpr double goodQuality = .6;  // [choice] the lowest q at which no other way is tried

/// Whether no other way is to be tried.
bool isGood(const Insertion& I, const InsertReport& report) {
  const double good = std::min(goodQuality, report.original.min);
  return report.surface > 0 && (I.lowest >= good || I.options.outline == Outline::paper);
}

/// The ways of a layer until one is good; those put aside because they stay tangled are returned.
std::vector<Way> tryWays(Insertion& I, Mesh& result, InsertReport& report) {
  const bool isPaper = I.options.outline == Outline::paper;
  std::vector<Outline> outlines{I.options.outline};
  if (I.options.outline == Outline::halfSquares) outlines.push_back(Outline::squares);
  std::vector<Selection> tried;
  std::vector<Way> aside;
  for (Outline outline : outlines)
    if (!isGood(I, report))
      for (const Way& way : extractWays(I, outline)) {
        const Selection& selected = way.extraction.selected;
        if (isGood(I, report) || std::find(tried.begin(), tried.end(), selected) != tried.end())
          continue;
        tried.push_back(selected);
        if (!tryWay(I, way, isPaper, result, report)) aside.push_back(way);
      }
  return aside;
}

/// §3.2 and §3.3 for this course.
void prepare(Insertion& I, double lc, Course course) {
  I.layer.lc = lc, I.layer.course = course;
  refineLayer(I, false);
  survey(I);
}

/// One l_c: 3.2 to 3.7, on the courses in turn and all ways of each until one is good; the best
/// valid one stays in result and report.
void insertWithSize(Insertion& I, double lc, Mesh& result, InsertReport& report) {
  std::vector<std::pair<Course, std::vector<Way>>> aside;
  // [choice] below this lowest q the centres' course is tried, and the ways that were put aside
  const double enough = std::min(.45, report.original.min);
  auto isEnough = [&] { return report.surface > 0 && I.lowest >= enough; };
  for (Course course : {Course::cheapest, Course::sides, Course::centres}) {
    const bool isSides = course == Course::sides;
    if (!isSides && I.options.outline == Outline::paper) continue;
    if (course == Course::centres ? isEnough() : isGood(I, report)) continue;
    try {
      prepare(I, lc, course);
      aside.push_back({course, tryWays(I, result, report)});
    } catch (const MethodError& error) {
      if (report.surface == 0 && !I.layer.A.isMiddle) throw;  // 𝓣 itself fails, on every course
      I.leave(isSides ? "sides" : "middle", error);
    }
  }
  for (const auto& [course, ways] : aside) {
    if (ways.empty() || isEnough()) continue;
    prepare(I, lc, course);
    for (const Way& way : ways)
      if (!isEnough()) tryWay(I, way, true, result, report);
  }
}

/// [§3.2] The sizes to try one after the other: l_c as given and [choice] its halves; for a
/// tolerance one for each level of the bisection, the coarsest first; else l_c as chosen, and its
/// halves.
std::vector<double> sizesToTry(const Mesh& M, const SurfaceDistance& S,
                               const InsertOptions& options, const SizeChoice& chosen) {
  constexpr int maxHalvings = 4;  // of l_c as given, while another surface is in the way
  constexpr int maxLevels = 19;   // checkSize() refuses more
  std::vector<double> sizes;
  if (options.lc > 0)
    for (int halving = 0; halving <= maxHalvings; ++halving)
      sizes.push_back(std::ldexp(options.lc, -halving));
  if (options.lc > 0) return sizes;
  if (options.tolerance == 0) {
    for (double lc = chosen.lc; lc >= chosen.finest || sizes.empty(); lc /= 2) sizes.push_back(lc);
    return sizes;
  }
  // l_c below the distances of §3.1 and, so that two cubes fit along S, below √3/2 of its extent
  double below = smallestGap(S.tree, M.x, patchFaces(M)).distance;
  for (const Parametrization& earlier : M.surfaces)
    below = std::min(below, smallestGap(S.tree, earlier.points, earlier.triangles).distance);
  double extent = 0;
  for (const Vec3& p : S.S.points) extent = std::max(extent, norm(p - S.S.points[S.rim[0]]));
  below = std::min(below, .5 * std::sqrt(3.) * extent);
  double diagonal = norm(M.cube);
  for (int level = 0; level <= maxLevels; ++level, diagonal /= 2)
    if (diagonal * aboveDiagonal < below) sizes.push_back(diagonal * aboveDiagonal);
  return sizes.empty() ? std::vector<double>{below} : sizes;
}

std::string describe(const SizeChoice& size) {
  return size.feature + " is " + number(size.measure) + " near " + placeText(size.place);
}

std::string labelOf(const std::string& name, std::size_t number) {
  return name.empty() ? "surface " + std::to_string(number) : "surface '" + name + "'";
}

/// The earlier surface nearest to S, for messages: "'name', 12.5 away at triangle 3 near (1, 2,
/// 3)".
struct Nearest {
  std::string text;
  double distance;
};
Nearest nearestEarlier(const Mesh& M, const SurfaceDistance& S) {
  Nearest nearest{"", beyondAll};
  for (std::size_t k = 0; k < M.surfaces.size(); ++k) {
    const Gap gap = smallestGap(S.tree, M.surfaces[k].points, M.surfaces[k].triangles);
    if (gap.distance < nearest.distance)
      nearest = {
          labelOf(M.surfaces[k].name, k + 1) + " is " + number(gap.distance) + " away" + at(gap),
          gap.distance};
  }
  return nearest;
}

/// Why no mesh is valid as far as S and its neighbours tell, and what to do.
std::string advice(const Insertion& I, const Mesh& M, double largest, double lc) {
  const SurfaceDistance& S = I.S;
  const Nearest nearest = nearestEarlier(M, S);
  if (nearest.distance < largest)
    return nearest.text + ": lower l_c to " + number(.5 * nearest.distance);
  const std::vector<Crossing> crossings = selfCrossings(S.S, S.tree);
  if (!crossings.empty()) return describe(crossings) + ": mend S there";
  const SizeChoice size = chooseSize(M, S);
  const bool isExtent = size.measure == extentOf(S);
  return (!isExtent ? describe(size) : "S bends or narrows there within the cubes") +
         ": lower l_c to " + number(std::min(size.resolving, .5 * lc));
}

/// The search for l_c: the first of the sizes with a valid mesh, within the tolerance where one is
/// wanted. A size after the first that asks for too many tetrahedra ends it.
void searchSize(Insertion& I, const std::vector<double>& sizes, Mesh& result,
                InsertReport& report) {
  const Mesh& M = I.original;
  constexpr int maxTries = 2;  // [choice] of a given l_c, with ways that were followed to the end
  const double E = I.options.tolerance;
  const InsertReport start = report;
  double last = sizes[0], nearest = beyondAll;
  // [choice] no l_c resolves a crossing: one that is small enough to vanish does so at the first
  const int most = I.crosses ? 1 : I.options.lc > 0 ? maxTries : static_cast<int>(sizes.size());
  int tries = 0;
  for (std::size_t i = 0; i < sizes.size() && tries < most; ++i) {
    const int waysBefore = I.ways;
    I.isBlocked = false;
    try {
      checkSize(M, I.S, sizes[i], I.options.maxTets);
      last = sizes[i];
      report = start;
      insertWithSize(I, last, result, report);
      if (report.surface > 0 && (E == 0 || report.hausdorff <= E)) return;
      if (report.surface > 0) {
        I.leave("l_c = " + number(last),
                MethodError("the Hausdorff distance S_M - S is " + number(report.hausdorff)));
        nearest = std::min(nearest, report.hausdorff);
      }
    } catch (const MethodError& error) {
      I.leave("l_c = " + number(last), error);
    } catch (const InputError& error) {
      if (i == 0) throw;
      I.leave("l_c = " + number(sizes[i]), error);
      break;
    }
    I.wasBlocked = I.wasBlocked || I.isBlocked;
    if (I.ways > waysBefore || !I.isBlocked) ++tries;
  }
  if (nearest < beyondAll)
    throw MethodError("insertSurface (§3.2): no mesh within the tolerance " + number(E) +
                      " at l_c = " + number(sizes[0]) + " to " + number(last) +
                      ": the nearest has the Hausdorff distance " + number(nearest) +
                      ", and the next was left because " + I.reason +
                      "; raise the tolerance or maxTets");
  const std::string wanted = E > 0 ? " within the tolerance " + number(E) : "";
  throw MethodError("insertSurface (§3): no valid mesh" + wanted + " at l_c = " + number(sizes[0]) +
                    (last < sizes[0] ? " nor down to " + number(last) : "") + ", after " +
                    std::to_string(I.faults) + " tries, the last because " + I.reason + "; " +
                    advice(I, M, sizes[0], last));
}

/// [choice] Beside earlier surfaces only nodes near S are smoothed (`optimizeAround`). Where the
/// lowest q has become poor, all are once more: it rises by .03 to .07 in the real sets.
void smoothTogether(Insertion& I, Mesh& M, InsertReport& report) {
  constexpr double poor = .6;
  const double lowest = report.smoothed.min, farthest = poorHausdorff * report.lc;
  if (I.k == 1 || I.options.outline == Outline::paper || report.hausdorff > farthest) return;
  if (lowest >= poor || lowest > report.original.min - betterBy) return;
  Mesh trial = M;
  InsertReport after = report;
  try {
    optimizeAround(trial, I, true, {}, after);
    after.smoothed = after.optimization.quality;
    if (after.smoothed.inverted > 0 || after.smoothed.min <= lowest) return;
    measureSurface(trial, I.S, after, I.crew);
  } catch (const MethodError& error) {
    return I.progress(std::string("3.7 all nodes once more left: ") + error.what());
  }
  if (after.hausdorff > farthest) return;
  if (I.options.tolerance > 0 && after.hausdorff > I.options.tolerance) return;
  after.optimization.sweeps += report.optimization.sweeps;
  after.optimization.visits += report.optimization.visits;
  I.progress("3.7 all nodes once more: min " + number(after.smoothed.min));
  M = std::move(trial), report = after;
}

/// A surface of the call that has passed §3.1.
struct Candidate {
  SurfaceDistance S;
  std::string label;  // for messages
  std::vector<std::string> warnings;
  bool crosses;  // itself
};

Candidate candidateOf(const TriangleSurface& S, const std::string& label,
                      std::vector<std::string> warnings, const Crew& crew) {
  TriangleSurface disk = checkSurface(S, warnings);
  splitChords(disk);
  SurfaceDistance distance(disk);
  const std::vector<Crossing> crossings = selfCrossings(disk, distance.tree, crew);
  if (!crossings.empty())
    warnings.push_back(describe(crossings) + "; mend it there if the insertion fails");
  return {std::move(distance), label, std::move(warnings), !crossings.empty()};
}

/// Does what step() does; its errors begin with the label of the surface.
template <class Step>
auto labelled(const std::string& label, Step step) -> decltype(step()) {
  const std::string prefix = label.empty() ? "" : label + ": ";
  try {
    return step();
  } catch (const InputError& error) {
    throw InputError(prefix + error.what());
  } catch (const MethodError& error) {
    throw MethodError(prefix + error.what());
  } catch (const SolverError& error) {
    throw SolverError(prefix + error.what());
  }
}

/// The surfaces of a call, each component one; labels only where there are several.
std::vector<Candidate> candidatesOf(const Mesh& M, const std::vector<TriangleSurface>& S,
                                    const Crew& crew) {
  std::vector<Candidate> all;
  for (std::size_t i = 0; i < S.size(); ++i) {
    const std::string given = S.size() > 1 ? labelOf(S[i].name, i + 1) : "";
    std::vector<std::string> warnings;
    const std::vector<TriangleSurface> components = labelled(given, [&] {
      checkInBox(M, S[i]);
      return connectedComponents(S[i], warnings);
    });
    for (const TriangleSurface& one : components) {
      const std::string label = components.size() > 1 ? labelOf(one.name, i + 1) : given;
      all.push_back(labelled(label, [&] { return candidateOf(one, label, warnings, crew); }));
      warnings.clear();
    }
  }
  return all;
}

/// [§3.1] Refuses two surfaces of the call, or one and an earlier one, that cross or touch.
void checkApart(const Mesh& M, const std::vector<Candidate>& all) {
  auto check = [](const Candidate& S, const std::string& other, const std::vector<Vec3>& points,
                  const std::vector<std::array<int, 3>>& triangles) {
    const TriangleTree::Box& box = S.S.tree.nodes[0].box;
    const Gap gap = gapWithin(S.S.tree, points, triangles, touching * norm(box.hi - box.lo));
    if (gap.triangle >= 0)
      throw InputError("insertSurfaces (§3.1): " + (S.label.empty() ? "S" : S.label) + " and " +
                       other + " cross or touch" + at(gap) +
                       "; surfaces must not meet: cut one back, or leave one out");
  };
  for (std::size_t i = 0; i < all.size(); ++i) {
    for (std::size_t k = 0; k < M.surfaces.size(); ++k)
      check(all[i], "the inserted " + labelOf(M.surfaces[k].name, k + 1), M.surfaces[k].points,
            M.surfaces[k].triangles);
    for (std::size_t j = 0; j < i; ++j)
      check(all[i], all[j].label, all[j].S.S.points, all[j].S.S.triangles);
  }
}

/// 3.2 to 3.7 for one surface, at the sizes that are to be tried.
///   q  of M's elements
InsertReport insertCandidate(Mesh& M, const Candidate& candidate, const InsertOptions& options,
                             const std::vector<double>& q, const Crew& crew) {
  const SurfaceDistance& cleaned = candidate.S;
  InsertReport report;
  report.original = qualityStatistics(q);

  SizeChoice chosen;
  const int k = static_cast<int>(M.surfaces.size()) + 1;
  Insertion I{M, q, cleaned, options, crew, k, candidate.crosses};
  if (options.lc == 0 && options.tolerance == 0) {
    chosen = chooseSize(M, cleaned);
    I.progress("3.2 l_c = " + number(chosen.lc) + " chosen: " + describe(chosen));
  }
  const std::vector<double> sizes = sizesToTry(M, cleaned, options, chosen);
  checkDistances(M, cleaned, sizes[0]);
  Mesh result;
  searchSize(I, sizes, result, report);
  smoothTogether(I, result, report);
  report.size = chosen;
  std::vector<std::string> warnings = candidate.warnings;
  if (options.tolerance == 0 && report.lc < sizes[0])
    warnings.push_back("l_c was lowered from " + number(sizes[0]) + " to " + number(report.lc) +
                       ", because " +
                       (I.wasBlocked ? nearestEarlier(M, cleaned).text
                                     : "at " + number(2 * report.lc) + " " + I.reason));
  report.warnings.insert(report.warnings.begin(), warnings.begin(), warnings.end());
  report.regular = qualityStatistics(result, Ideal::regular);
  I.stage("smoothed", result);
  M = std::move(result);
  return report;
}

/// [choice] `largestFirst`: these leave each other more room than the smaller leave them; of equal
/// area (to 7 digits) the lowest. The order of the caller's list decides nothing.
void largestFirst(std::vector<Candidate>& all) {
  auto key = [](const Candidate& one) {
    const Vec3 lo = one.S.tree.nodes[0].box.lo;
    return std::make_tuple(-static_cast<float>(areaOf(one.S.S)), lo.z, lo.y, lo.x);
  };
  std::stable_sort(all.begin(), all.end(),
                   [&](const Candidate& a, const Candidate& b) { return key(a) < key(b); });
}

/// What an insertion asks of the mesh and the options before it looks at a surface. Returns q of
/// the elements.
std::vector<double> checkStart(const Mesh& M, const InsertOptions& options) {
  checkMeccano(M, "insertSurface (§3.1)");
  checkOptions(options, M.x.size());
  const std::vector<double> q = qualities(M);
  const auto inverted = std::count(q.begin(), q.end(), 0.);
  if (inverted > 0)
    throw InputError("insertSurface (§3.1): the mesh has " + std::to_string(inverted) +
                     " inverted elements; untangle it first (optimizeMesh)");
  return q;
}

}  // namespace

InsertReport insertSurface(Mesh& M, const TriangleSurface& S, const InsertOptions& options) {
  const std::vector<double> q = checkStart(M, options);
  const Crew crew(options.optimize.threads);
  checkInBox(M, S);
  const Candidate one = candidateOf(S, "", {}, crew);
  checkApart(M, {one});
  return insertCandidate(M, one, options, q, crew);
}

std::vector<InsertReport> insertSurfaces(Mesh& M, const std::vector<TriangleSurface>& S,
                                         const InsertOptions& options) {
  std::vector<double> q = checkStart(M, options);
  const Crew crew(options.optimize.threads);
  std::vector<Candidate> all = candidatesOf(M, S, crew);
  checkApart(M, all);
  largestFirst(all);
  Mesh result = M;
  std::vector<InsertReport> reports;
  for (const Candidate& one : all) {
    reports.push_back(
        labelled(one.label, [&] { return insertCandidate(result, one, options, q, crew); }));
    q = qualities(result);
  }
  for (std::size_t i = 0; i + 1 < all.size();
       ++i)  // later ones have refined and moved earlier ones
    labelled(all[i].label, [&] { measureSurface(result, all[i].S, reports[i], crew); });
  M = std::move(result);
  return reports;
}

}  // namespace meccano
