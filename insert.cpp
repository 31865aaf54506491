// SPDX-License-Identifier: MIT
//
// Sections 2 to 3.6 of the paper: the box meccano and Kossaczký's bisection, volumetric
// approximation and its healing, surface extraction and its healing, surface projection; and
// insertSurface, which calls them in the paper's order. Section 3.7 is optimize.cpp.
#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <map>
#include <numeric>
#include <set>

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

/// Open-addressing hash from 64-bit keys (lattice points, node pairs) to an int, 0 where absent.
class KeyMap {
 public:
  explicit KeyMap(std::size_t expected = 8) {
    std::size_t size = 16;
    while (size < 2 * expected) size *= 2;
    keys_.assign(size, empty);
    values_.assign(size, 0);
  }
  int& operator[](std::uint64_t key) {
    if (2 * (count_ + 1) > keys_.size()) grow();
    const std::size_t i = slot(key);
    if (keys_[i] == empty) {
      keys_[i] = key;
      ++count_;
    }
    return values_[i];
  }
  int get(std::uint64_t key) const {
    const std::size_t i = slot(key);
    return keys_[i] == empty ? 0 : values_[i];
  }

 private:
  static constexpr std::uint64_t empty = ~std::uint64_t(0);
  std::size_t slot(std::uint64_t key) const {
    std::uint64_t z = key * 0x9E3779B97F4A7C15u;  // Fibonacci hashing
    std::size_t i = (z ^ (z >> 29)) & (keys_.size() - 1);
    while (keys_[i] != empty && keys_[i] != key) i = (i + 1) & (keys_.size() - 1);
    return i;
  }
  void grow() {
    KeyMap larger(keys_.size());
    for (std::size_t i = 0; i < keys_.size(); ++i)
      if (keys_[i] != empty) larger[keys_[i]] = values_[i];
    *this = std::move(larger);
  }
  std::vector<std::uint64_t> keys_;
  std::vector<int> values_;
  std::size_t count_ = 0;
};

std::uint64_t edgeKey(int a, int b) {
  const std::uint64_t lo = std::uint32_t(std::min(a, b)), hi = std::uint32_t(std::max(a, b));
  return lo << 32 | hi;
}

int localIndex(const std::array<int, 4>& tet, int n) {
  for (int i = 0; i < 4; ++i)
    if (tet[i] == n) return i;
  return -1;
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

/// Cell of the locator's grid along one axis.
int gridCell(double coordinate, int size) {
  return coordinate > 0 ? static_cast<int>(std::min(coordinate * size, size - 1.)) : 0;
}

/// Range of cells that the triangle's box meets, widened by rounding.
std::array<int, 4> gridRange(const Parametrization& P, const std::array<int, 3>& t) {
  constexpr double margin = 1e-9;  // in 𝓤: far above rounding, far below a cell
  const Vec2 a = P.u[t[0]], b = P.u[t[1]], c = P.u[t[2]];
  return {gridCell(std::min({a.x, b.x, c.x}) - margin, P.gridSize),
          gridCell(std::max({a.x, b.x, c.x}) + margin, P.gridSize),
          gridCell(std::min({a.y, b.y, c.y}) - margin, P.gridSize),
          gridCell(std::max({a.y, b.y, c.y}) + margin, P.gridSize)};
}

}  // namespace

void buildLocator(Parametrization& P) {
  const int count = static_cast<int>(P.triangles.size());
  P.gridSize = std::clamp(static_cast<int>(std::sqrt(count)), 1, 1024);
  P.gridStart.assign(P.gridSize * P.gridSize + 1, 0);
  auto forCells = [&](int t, auto visit) {
    const std::array<int, 4> r = gridRange(P, P.triangles[t]);
    for (int j = r[2]; j <= r[3]; ++j)
      for (int i = r[0]; i <= r[1]; ++i) visit(j * P.gridSize + i);
  };
  for (int t = 0; t < count; ++t) forCells(t, [&](int c) { ++P.gridStart[c + 1]; });
  std::partial_sum(P.gridStart.begin(), P.gridStart.end(), P.gridStart.begin());
  P.gridTriangles.resize(P.gridStart.back());
  std::vector<int> next(P.gridStart.begin(), P.gridStart.end() - 1);
  for (int t = 0; t < count; ++t) forCells(t, [&](int c) { P.gridTriangles[next[c]++] = t; });
}

Location locate(const Parametrization& P, Vec2 u) {
  constexpr double tolerance = 1e-9;  // barycentric: a point on the border of 𝓤 may round outside
  const int cell = gridCell(u.y, P.gridSize) * P.gridSize + gridCell(u.x, P.gridSize);
  Location best{-1, {0, 0, 0}};
  double bestInside = -tolerance;
  for (int i = P.gridStart[cell]; i < P.gridStart[cell + 1]; ++i) {
    const std::array<int, 3>& t = P.triangles[P.gridTriangles[i]];
    const Vec2 a = P.u[t[0]] - u, b = P.u[t[1]] - u, c = P.u[t[2]] - u;
    const double area = cross(b - a, c - a);
    const double w0 = cross(b, c) / area, w1 = cross(c, a) / area, w2 = 1 - w0 - w1;
    const double inside = std::min({w0, w1, w2});
    if (inside > bestInside) {
      bestInside = inside;
      best = {P.gridTriangles[i], {w0, w1, w2}};
    }
    if (inside >= 0) break;
  }
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

std::vector<std::array<int, 3>> surfaceFaces(const Mesh& M, int k) {
  std::vector<std::array<int, 3>> faces;
  for (std::size_t E = 0; E < M.faceLabel.size(); ++E)
    for (int i = 0; i < 4; ++i) {
      if (M.faceLabel[E][i] != k) continue;
      const std::array<int, 4>& z = M.tets[E];
      // outward for a positively oriented tetrahedron
      constexpr int outward[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};
      faces.push_back({z[outward[i][0]], z[outward[i][1]], z[outward[i][2]]});
    }
  if (k < 0) return faces;
  // An inserted face is seen from both of its tetrahedra: keep the first of each pair.
  std::vector<std::pair<std::array<int, 3>, int>> sorted;
  for (std::size_t i = 0; i < faces.size(); ++i) {
    std::array<int, 3> key = faces[i];
    std::sort(key.begin(), key.end());
    sorted.push_back({key, static_cast<int>(i)});
  }
  std::sort(sorted.begin(), sorted.end());
  std::vector<int> keep;
  for (std::size_t i = 0; i < sorted.size(); ++i)
    if (i == 0 || sorted[i].first != sorted[i - 1].first) keep.push_back(sorted[i].second);
  std::sort(keep.begin(), keep.end());
  std::vector<std::array<int, 3>> once;
  for (int i : keep) once.push_back(faces[i]);
  return once;
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
void addKuhnCell(Mesh& M, std::array<int, 3> i, std::array<int, 3> n) {
  auto node = [&](std::array<int, 3> p) { return (p[2] * (n[1] + 1) + p[1]) * (n[0] + 1) + p[0]; };
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
    std::array<int, 4> label{0, 0, 0, 0};
    if (i[path[0]] + 1 == n[path[0]]) label[0] = -boxPatch(path[0], 1);
    if (i[path[2]] == 0) label[1] = -boxPatch(path[2], 0);
    M.faceLabel.push_back(label);
  }
}

}  // namespace

Mesh boxMesh(Vec3 origin, Vec3 size, std::array<int, 3> cells) {
  if (!isFinite(origin) || !isFinite(size) || !(size.x > 0 && size.y > 0 && size.z > 0))
    throw InputError("boxMesh: origin and size must be finite and size above 0, not size = " +
                     number(size.x) + " " + number(size.y) + " " + number(size.z));
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
      for (int i = 0; i < cells[0]; ++i) addKuhnCell(M, {i, j, k}, cells);
  M.type.assign(M.tets.size(), 0);
  M.level.assign(M.tets.size(), 0);
  M.cube = {size.x / cells[0], size.y / cells[1], size.z / cells[2]};
  const QualityStatistics q = qualityStatistics(M);
  if (q.inverted > 0 || !(q.min > 0))
    throw InputError(
        "boxMesh: origin and size leave no digits for the cells; move or scale the box");
  return M;
}

// ==== 2. Kossaczký bisection [17] ================================================================

std::vector<std::array<int, 4>> faceNeighbours(const Mesh& M) {
  const int nodes = static_cast<int>(M.x.size()), count = static_cast<int>(M.tets.size());
  std::vector<std::array<int, 4>> neighbour(count, {-1, -1, -1, -1});
  // Faces grouped by their smallest node; within a group equal faces are found by comparing.
  auto face = [&](int E, int i) {
    const std::array<int, 4>& z = M.tets[E];
    std::array<int, 3> v{z[(i + 1) % 4], z[(i + 2) % 4], z[(i + 3) % 4]};
    std::sort(v.begin(), v.end());
    return v;
  };
  std::vector<int> start(nodes + 1, 0);
  for (int E = 0; E < count; ++E)
    for (int i = 0; i < 4; ++i) ++start[face(E, i)[0] + 1];
  std::partial_sum(start.begin(), start.end(), start.begin());
  struct Waiting {
    int v1, v2, E, i;
  };
  std::vector<Waiting> group(start.back());
  std::vector<int> filled(start.begin(), start.end() - 1);
  for (int E = 0; E < count; ++E)
    for (int i = 0; i < 4; ++i) {
      const std::array<int, 3> v = face(E, i);
      int g = start[v[0]];
      while (g < filled[v[0]] && (group[g].v1 != v[1] || group[g].v2 != v[2])) ++g;
      if (g == filled[v[0]]) {
        group[filled[v[0]]++] = {v[1], v[2], E, i};
        continue;
      }
      if (neighbour[group[g].E][group[g].i] >= 0)
        throw InputError("faceNeighbours: the face opposite to vertex " + std::to_string(i) +
                         " of tetrahedron " + std::to_string(E) + " has more than two tetrahedra");
      neighbour[group[g].E][group[g].i] = E;
      neighbour[E][i] = group[g].E;
    }
  return neighbour;
}

Bisection::Bisection(Mesh& mesh)
    : M(mesh), neighbour(faceNeighbours(mesh)), tetOf(mesh.x.size(), -1) {
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int n : M.tets[E]) tetOf[n] = static_cast<int>(E);
}

void Bisection::ring(int E, int a, int b, std::vector<int>& around) const {
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

void Bisection::star(int n, std::vector<int>& around) const {
  around.assign(1, tetOf[n]);
  for (std::size_t i = 0; i < around.size(); ++i) {
    const int t = around[i];
    for (int j = 0; j < 4; ++j) {
      const int next = neighbour[t][j];
      if (M.tets[t][j] == n || next < 0) continue;
      if (std::find(around.begin(), around.end(), next) == around.end()) around.push_back(next);
    }
  }
}

int Bisection::tetWithEdge(int a, int b) const {
  std::vector<int> around;
  star(a, around);
  for (int t : around)
    if (localIndex(M.tets[t], b) >= 0) return t;
  return -1;
}

bool parameterOn(const Mesh& M, int n, int label, Vec2& u) {
  if (M.dimension[n] == 2 && M.entity[n] == label) {
    u = M.parameter[n];
    return true;
  }
  auto onCurve = [&](int curve, double s) {
    const Curve& C = M.curves[curve - 1];
    for (const Curve::Side& side : C.sides)
      if (side.surface == label) {
        u = curveParameter(C, side, s);
        return true;
      }
    return false;
  };
  if (M.dimension[n] == 1) return onCurve(M.entity[n], M.parameter[n].x);
  if (M.dimension[n] == 0)
    for (const Corner::Place& place : M.corners[M.entity[n] - 1].on)
      if (onCurve(place.curve, place.s)) return true;
  return false;
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
        "by "
        "boxMesh or `meccano box`, or read a meccano .vtk");
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
  const int curves = counts[1];
  for (const Parametrization& P : M.surfaces)
    if (P.rim < 1 || P.rim > curves) refuse("surface '" + P.name + "' names no curve as its rim");
  for (const Corner& corner : M.corners)
    for (const Corner::Place& place : corner.on)
      if (place.curve < 1 || place.curve > curves)
        refuse("a corner lies on a curve that is not there");
}

/// s of node n on curve c.
bool parameterOnCurve(const Mesh& M, int n, int c, double& s) {
  if (M.dimension[n] == 1 && M.entity[n] == c) {
    s = M.parameter[n].x;
    return true;
  }
  if (M.dimension[n] == 0)
    for (const Corner::Place& place : M.corners[M.entity[n] - 1].on)
      if (place.curve == c) {
        s = place.s;
        return true;
      }
  return false;
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
  auto curvesOf = [&](int n) {
    std::vector<int> curves;
    if (M.dimension[n] == 1) curves.push_back(M.entity[n]);
    if (M.dimension[n] == 0)
      for (const Corner::Place& place : M.corners[M.entity[n] - 1].on)
        curves.push_back(place.curve);
    return curves;
  };
  const std::vector<int> ofB = curvesOf(b);
  for (int c : curvesOf(a)) {
    if (std::find(ofB.begin(), ofB.end(), c) == ofB.end()) continue;
    bool has0 = false, has1 = false;
    for (const Curve::Side& side : M.curves[c - 1].sides) {
      has0 |= side.surface == label0;
      has1 |= side.surface == label1;
    }
    if (has0 && has1) return c;
  }
  return 0;
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
      if (!isBridging(M.x[a], M.x[b], onS))
        x = onS;
      else
        x = nearestOn(surfaceOf(M, entity), x, parameter);
    }
  } else if (e.dimension == 1 && e.entity > 0) {
    double s0 = 0, s1 = 0;
    if (parameterOnCurve(M, a, e.entity, s0) && parameterOnCurve(M, b, e.entity, s1)) {
      const Curve& C = M.curves[e.entity - 1];
      dimension = 1, entity = e.entity, parameter = {curveMidpoint(C, s0, s1), 0};
      if (isBridging(M.x[a], M.x[b], gamma(C, parameter.x)))
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
    splits.push_back({t, t1});
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

void bisect(Mesh& M, const std::vector<int>& E) {
  checkMeccano(M, "bisect (§3.2)");
  Bisection B(M);
  std::vector<int> level;
  for (int t : E) {
    if (t < 0 || t >= static_cast<int>(M.tets.size()))
      throw InputError("bisect (§3.2): there is no tetrahedron " + std::to_string(t));
    level.push_back(M.level[t]);
  }
  for (std::size_t i = 0; i < E.size(); ++i)
    if (M.level[E[i]] == level[i]) B.bisect(E[i]);
}

// ==== 3.1 Problem statement =====================================================================

namespace {

/// Height over longest edge at and below which a triangle has zero area: coordinates are rounded by
/// 1e-16 of their size, so a smaller height says nothing.
constexpr double zeroHeight = 1e-14;

std::string placeText(Vec3 p) {
  char text[96];
  std::snprintf(text, sizeof text, "(%.9g, %.9g, %.9g)", p.x, p.y, p.z);
  return text;
}

std::string counted(std::size_t n, const std::string& one) {
  return std::to_string(n) + ' ' + one + (n == 1 ? "" : "s");
}

[[noreturn]] void refuseSurface(const std::string& what) {
  throw InputError("insertSurface (§3.1): " + what);
}

/// Refuses indices out of range and coordinates that are not finite.
void checkNumbers(const TriangleSurface& S) {
  const int points = static_cast<int>(S.points.size());
  for (int n = 0; n < points; ++n)
    if (!isFinite(S.points[n]))
      refuseSurface("point " + std::to_string(n) + " has the coordinates " +
                    placeText(S.points[n]) + "; all coordinates must be finite numbers");
  for (std::size_t t = 0; t < S.triangles.size(); ++t)
    for (int n : S.triangles[t])
      if (n < 0 || n >= points)
        refuseSurface("triangle " + std::to_string(t) + " names point " + std::to_string(n) +
                      ", but there are " + counted(points, "point") +
                      " (counted from 0); correct the index");
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

/// Corner of a triangle at point n: 0, 1, 2.
int cornerAt(const std::array<int, 3>& triangle, int n) {
  return static_cast<int>(std::find(triangle.begin(), triangle.end(), n) - triangle.begin());
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
  std::vector<std::pair<std::uint64_t, int>> uses;  // edge, 3 t + i of the triangle that uses it
  for (int c = 0; c < static_cast<int>(3 * S.triangles.size()); ++c) {
    const std::array<int, 3>& v = S.triangles[c / 3];
    uses.push_back({edgeKey(v[c % 3], v[(c + 1) % 3]), c});
  }
  std::sort(uses.begin(), uses.end());
  auto name = [&](int c) { return std::to_string(number.empty() ? c / 3 : number[c / 3]); };
  std::vector<std::array<int, 3>> neighbours(S.triangles.size(), {-1, -1, -1});
  for (std::size_t k = 0; k + 1 < uses.size(); ++k) {
    if (uses[k].first != uses[k + 1].first) continue;
    const int c = uses[k].second, d = uses[k + 1].second;
    if (k + 2 < uses.size() && uses[k].first == uses[k + 2].first)
      refuseSurface("the edge from " + placeText(S.points[uses[k].first >> 32]) + " to " +
                    placeText(S.points[uses[k].first & 0xffffffff]) +
                    " is non-manifold: triangles " + name(c) + ", " + name(d) + " and " +
                    name(uses[k + 2].second) + " share it; split the surface there into several");
    neighbours[c / 3][c % 3] = d / 3;
    neighbours[d / 3][d % 3] = c / 3;
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

TriangleSurface checkSurface(const TriangleSurface& S, std::vector<std::string>& warnings) {
  checkNumbers(S);
  CleanSurface C = weldAndDrop(S, warnings);
  if (S.triangles.empty()) refuseSurface("the surface is empty; give at least one triangle");
  if (C.S.triangles.empty())
    refuseSurface("the surface is empty: all its " + std::to_string(S.triangles.size()) +
                  " triangles have zero area; check its coordinates");
  const std::vector<std::array<int, 3>> neighbours = triangleNeighbours(C.S, C.origin);
  checkFans(C, neighbours);
  const std::vector<int> sizes = componentSizes(neighbours);
  if (sizes.size() > 1)
    refuseSurface("the surface has " + std::to_string(sizes.size()) +
                  " components (the largest of " + std::to_string(sizes[0]) + ", the smallest of " +
                  std::to_string(sizes.back()) + " triangles); insert them one by one, or by insertSurfaces");
  const int turned = orientConsistently(C.S, neighbours);
  if (turned < 0) refuseSurface("the surface is not orientable (a Moebius band); cut it open");
  if (turned > 0)
    warnings.push_back("§3.1: turned " + counted(turned, "triangle") +
                       " to give the surface a single orientation");
  checkDisk(C.S);
  return C.S;
}

// ==== Tools for 3.2 and 3.4: distance to S ======================================================

namespace {

constexpr double beyondAll = 1e300;  // beyond every coordinate; its square is not needed
constexpr int trianglesPerLeaf = 4;
/// A box is skipped where it is farther by more than this fraction: rounding of distances.
constexpr double boxMargin = 1e-12;

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

/// Distance of two boxes, 0 where they meet; a point is a box too.
double boxDistance(const TriangleTree::Box& a, const TriangleTree::Box& b) {
  return norm(Vec3{std::max({a.lo.x - b.hi.x, b.lo.x - a.hi.x, 0.0}),
                   std::max({a.lo.y - b.hi.y, b.lo.y - a.hi.y, 0.0}),
                   std::max({a.lo.z - b.hi.z, b.lo.z - a.hi.z, 0.0})});
}

void growBox(TriangleTree::Box& box, Vec3 p) {
  box.lo = {std::min(box.lo.x, p.x), std::min(box.lo.y, p.y), std::min(box.lo.z, p.z)};
  box.hi = {std::max(box.hi.x, p.x), std::max(box.hi.y, p.y), std::max(box.hi.z, p.z)};
}

/// Recursive median split of tree.triangle[first, last) along the longest side of the centres' box.
void buildTreeNode(TriangleTree& tree, const std::vector<std::array<Vec3, 3>>& corners,
                   const std::vector<Vec3>& centres, int first, int last) {
  const auto order = tree.triangle.begin();
  TriangleTree::Box box = boxOf(corners[order[first]]);
  TriangleTree::Box middle{centres[order[first]], centres[order[first]]};
  for (int i = first; i < last; ++i) {
    for (Vec3 p : corners[order[i]]) growBox(box, p);
    growBox(middle, centres[order[i]]);
  }
  const std::size_t self = tree.nodes.size();
  const bool isLeaf = last - first <= trianglesPerLeaf;
  tree.nodes.push_back({box, first, isLeaf ? last - first : 0, -1});
  if (isLeaf) return;
  const Vec3 d = middle.hi - middle.lo;
  double Vec3::*axis = d.x >= d.y && d.x >= d.z ? &Vec3::x : d.y >= d.z ? &Vec3::y : &Vec3::z;
  const int half = (first + last) / 2;
  std::nth_element(order + first, order + half, order + last, [&](int a, int b) {
    return std::make_pair(centres[a].*axis, a) < std::make_pair(centres[b].*axis, b);
  });
  buildTreeNode(tree, corners, centres, first, half);
  tree.nodes[self].right = static_cast<int>(tree.nodes.size());
  buildTreeNode(tree, corners, centres, half, last);
}

/// Calls visit(i) for the triangles (in tree order) of leaves not farther from `box` than `bound`,
/// which visit() lowers; the nearer child first. From node n at `distance` on.
template <class Visit>
void visitNearest(const TriangleTree& tree, int n, double distance, const TriangleTree::Box& box,
                  const double& bound, const Visit& visit) {
  if (distance > bound * (1 + boxMargin)) return;
  const TriangleTree::Node& node = tree.nodes[n];
  for (int i = node.first; i < node.first + node.count; ++i) visit(i);
  if (node.count > 0) return;
  int near = n + 1, far = node.right;
  double toNear = boxDistance(tree.nodes[near].box, box);
  double toFar = boxDistance(tree.nodes[far].box, box);
  if (toFar < toNear) {
    std::swap(near, far);
    std::swap(toNear, toFar);
  }
  visitNearest(tree, near, toNear, box, bound, visit);
  visitNearest(tree, far, toFar, box, bound, visit);
}

}  // namespace

TriangleTree::Box boxOf(const std::array<Vec3, 3>& corners) {
  TriangleTree::Box box{corners[0], corners[0]};
  growBox(box, corners[1]);
  growBox(box, corners[2]);
  return box;
}

ClosestPoint closestPointOnTriangle(Vec3 x, Vec3 a, Vec3 b, Vec3 c) {
  ClosestPoint best{beyondAll, a, 0, {1, 0, 0}, Feature::vertex, 0};
  for (int i = 0; i < 3; ++i) keepNearerOnEdge(x, {a, b, c}, i, best);

  // The foot of the perpendicular, where it is inside: w are the areas seen from it.
  const Vec3 n = cross(b - a, c - a);
  const double n2 = norm2(n);
  const double w1 = dot(cross(x - a, c - a), n) / n2, w2 = dot(cross(b - a, x - a), n) / n2;
  const double w0 = 1 - w1 - w2;
  if (!(w0 > 0 && w1 > 0 && w2 > 0)) return best;  // also where n = 0
  const Vec3 p = a + (w1 * (b - a) + w2 * (c - a));
  const double distance = norm(x - p);
  if (distance < best.distance) best = {distance, p, 0, {w0, w1, w2}, Feature::face, 0};
  return best;
}

TriangleTree::TriangleTree(const std::vector<Vec3>& points,
                           const std::vector<std::array<int, 3>>& triangles)
    : triangle(triangles.size()) {
  std::vector<std::array<Vec3, 3>> all;
  std::vector<Vec3> centres;
  for (const std::array<int, 3>& t : triangles) {
    all.push_back({points[t[0]], points[t[1]], points[t[2]]});
    const Box box = boxOf(all.back());
    centres.push_back(.5 * (box.lo + box.hi));
  }
  std::iota(triangle.begin(), triangle.end(), 0);
  if (!all.empty()) buildTreeNode(*this, all, centres, 0, static_cast<int>(all.size()));
  for (int t : triangle) corners.push_back(all[t]);
}

ClosestPoint TriangleTree::closest(Vec3 x, double within) const {
  ClosestPoint best{within, x, -1, {0, 0, 0}, Feature::face, 0};
  if (nodes.empty()) return best;
  visitNearest(*this, 0, boxDistance(nodes[0].box, {x, x}), {x, x}, best.distance, [&](int i) {
    ClosestPoint p = closestPointOnTriangle(x, corners[i][0], corners[i][1], corners[i][2]);
    p.triangle = triangle[i];
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

/// Largest distance of points of A, a lattice of m steps on each triangle, from B.
double sampledDistance(const TriangleTree& A, const TriangleTree& B, int m) {
  double largest = 0;
  for (const std::array<Vec3, 3>& c : A.corners)
    for (int i = 0; i <= m; ++i)
      for (int j = 0; i + j <= m; ++j) {
        const Vec3 p = (1. / m) * (double(m - i - j) * c[0] + double(i) * c[1] + double(j) * c[2]);
        largest = std::max(largest, B.closest(p).distance);
      }
  return largest;
}

}  // namespace

Gap smallestGap(const TriangleTree& tree, const std::vector<Vec3>& points,
                const std::vector<std::array<int, 3>>& triangles) {
  Gap gap{beyondAll, -1, -1, {}};
  for (std::size_t o = 0; o < triangles.size() && !tree.nodes.empty(); ++o) {
    const std::array<int, 3>& v = triangles[o];
    const std::array<Vec3, 3> other{points[v[0]], points[v[1]], points[v[2]]};
    const TriangleTree::Box box = boxOf(other);
    const double start = boxDistance(tree.nodes[0].box, box);
    visitNearest(tree, 0, start, box, gap.distance, [&](int i) {
      Vec3 on;
      const double d = trianglesDistance(tree.corners[i], other, on);
      if (d < gap.distance) gap = {d, tree.triangle[i], static_cast<int>(o), on};
    });
  }
  return gap;
}

double hausdorffDistance(const TriangleTree& A, const TriangleTree& B, int samplesPerEdge) {
  if (A.nodes.empty() || B.nodes.empty() || samplesPerEdge < 1)
    throw InputError("hausdorffDistance: give two surfaces with triangles and samplesPerEdge >= 1");
  return std::max(sampledDistance(A, B, samplesPerEdge), sampledDistance(B, A, samplesPerEdge));
}

// ==== Tools for 3.2: triangle–tetrahedron intersection ===========================================

bool intersects(const std::array<Vec3, 4>& tet, const std::array<Vec3, 3>& triangle) {
  constexpr double tolerance =
      1e-9;  // relative to the tetrahedron: closed, an extra hit is harmless
  constexpr int faces[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};
  Vec3 polygon[16],
      clipped[16];  // three corners, one more for each plane; rounding on needles: twice that
  int corners = 3;
  for (int i = 0; i < 3; ++i) polygon[i] = triangle[i];
  for (int i = 0; i < 4; ++i) {
    const Vec3 a = tet[faces[i][0]], b = tet[faces[i][1]], c = tet[faces[i][2]];
    Vec3 inward = cross(b - a, c - a);
    const double height = dot(inward, tet[i] - a);
    inward = (1 / height) * inward;  // 0 on the face, 1 at the opposite vertex
    int kept = 0;
    for (int j = 0; j < corners; ++j) {
      const Vec3 p = polygon[j], q = polygon[(j + 1) % corners];
      const double dp = dot(inward, p - a) + tolerance, dq = dot(inward, q - a) + tolerance;
      if (dp >= 0) clipped[kept++] = p;
      if ((dp > 0 && dq < 0) || (dp < 0 && dq > 0)) clipped[kept++] = p + dp / (dp - dq) * (q - p);
    }
    if (kept == 0) return false;
    corners = kept;
    std::copy(clipped, clipped + kept, polygon);
  }
  return true;
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

/// Whether S meets tetrahedron E: candidates by the tree, then by clipping.
bool meetsSurface(const Mesh& M, int E, const SurfaceDistance& S) {
  std::array<Vec3, 4> tet;
  for (int i = 0; i < 4; ++i) tet[i] = M.x[M.tets[E][i]];
  Vec3 lo = tet[0], hi = tet[0];
  for (const Vec3& p : tet) {
    lo = {std::min(lo.x, p.x), std::min(lo.y, p.y), std::min(lo.z, p.z)};
    hi = {std::max(hi.x, p.x), std::max(hi.y, p.y), std::max(hi.z, p.z)};
  }
  const Vec3 margin = 1e-9 * (hi - lo);
  bool hit = false;
  S.tree.visit(lo - margin, hi + margin, [&](int t) {
    const std::array<int, 3>& v = S.S.triangles[t];
    return hit = intersects(tet, {S.S.points[v[0]], S.S.points[v[1]], S.S.points[v[2]]});
  });
  return hit;
}

enum class Cut : char { unknown, yes, no };

/// Tells of each tetrahedron not yet known whether S cuts it.
void classify(const Bisection& B, const SurfaceDistance& S, std::vector<Cut>& cut) {
  cut.resize(B.M.tets.size(), Cut::unknown);
  for (std::size_t E = 0; E < cut.size(); ++E)
    if (cut[E] == Cut::unknown)
      cut[E] = meetsSurface(B.M, static_cast<int>(E), S) ? Cut::yes : Cut::no;
}

/// Refines the tetrahedra cut by S that `wanted` asks for until there is none.
template <class Wanted>
void refineCut(Bisection& B, const SurfaceDistance& S, std::vector<Cut>& cut, Wanted wanted) {
  constexpr int maxPasses = 250;  // one level a pass; levels fit in a byte
  for (int pass = 0; pass < maxPasses; ++pass) {
    classify(B, S, cut);
    std::vector<std::pair<int, int>> refine;  // tetrahedron, its level
    for (std::size_t E = 0; E < cut.size(); ++E)
      if (cut[E] == Cut::yes && wanted(static_cast<int>(E)))
        refine.push_back({static_cast<int>(E), B.M.level[E]});
    if (refine.empty()) return;
    B.splits.clear();
    for (const auto& [E, level] : refine)
      if (B.M.level[E] == level) B.bisect(E);
    cut.resize(B.M.tets.size(), Cut::unknown);
    for (const auto& [parent, child] : B.splits) cut[parent] = cut[child] = Cut::unknown;
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

Approximation volumetricApproximation(Bisection& B, const SurfaceDistance& S, double lc) {
  std::vector<Cut> cut;
  refineCut(B, S, cut, [&](int E) { return isTooLarge(B.M, E, lc); });  // eq. (1)
  Approximation A;
  A.level = cubeLevel(B.M, lc);
  // [choice] on to whole cubes, which §3.3 asks for: up to two bisections more than eq. (1)
  refineCut(B, S, cut, [&](int E) { return B.M.level[E] < A.level; });
  A.T.resize(cut.size());
  for (std::size_t E = 0; E < cut.size(); ++E) A.T[E] = cut[E] == Cut::yes;
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
  std::int64_t inside(double c) const { return 2 * std::int64_t(std::floor(c * scale)) + 1; }
  bool onPlane(double c) const { return c * scale == std::floor(c * scale); }
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

std::array<int, 3> faceOpposite(const std::array<int, 4>& z, int i) {
  return {z[(i + 1) % 4], z[(i + 2) % 4], z[(i + 3) % 4]};
}

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
  unsigned reached = cubes & -cubes;
  for (int round = 0; round < 8; ++round)
    for (int c = 0; c < 8; ++c)
      for (int axis = 0; axis < 3; ++axis)
        if ((reached >> c & 1) && (cubes >> (c ^ 1 << axis) & 1)) reached |= 1u << (c ^ 1 << axis);
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
      const int E = queue[at];
      if (lattice.squareOf(B.M, faceOpposite(B.M.tets[E], i), square)) continue;
      while (B.M.level[B.neighbour[E][i]] < A.level) B.bisect(B.neighbour[E][i]);
      A.T.resize(B.M.tets.size(), 0);
      const int next = B.neighbour[E][i];
      if (A.T[next]) continue;
      A.T[next] = 1;
      queue.push_back(next);
    }
}

std::vector<int> elementsOf(const std::vector<char>& T) {
  std::vector<int> elements;
  for (std::size_t E = 0; E < T.size(); ++E)
    if (T[E]) elements.push_back(static_cast<int>(E));
  return elements;
}

/// For each lattice node of T the cubes of T around it: bit 1 x+, bit 2 y+, bit 4 z+ of the cube's
/// place.
KeyMap cubesAtNodes(const Mesh& M, const Approximation& A, std::vector<std::uint64_t>& nodes) {
  const Lattice lattice(A.level);
  KeyMap cubes, at;
  for (int E : elementsOf(A.T)) {
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

/// Whether a node lies on ∂M. T may pass an earlier surface: its squares there are no candidates.
bool isOnBoundary(const Mesh& M, int n) {
  int curve = 0;
  if (M.dimension[n] == 2) return M.entity[n] < 0;
  if (M.dimension[n] == 1) curve = M.entity[n];
  if (M.dimension[n] == 0 && !M.corners[M.entity[n] - 1].on.empty())
    curve = M.corners[M.entity[n] - 1].on[0].curve;
  return curve > 0 && M.curves[curve - 1].sides[0].surface < 0;
}

/// The elements adjacent to the node, refined to T's level, join T.
void addElementsAt(Bisection& B, Approximation& A, int node) {
  std::vector<int> around, added;
  for (bool coarse = true; coarse;) {
    coarse = false;
    B.star(node, around);
    for (int E : around)
      if (B.M.level[E] < A.level) {
        B.bisect(E);
        coarse = true;
        break;
      }
  }
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
  completeCubes(B, A, elementsOf(A.T));
  const Lattice lattice(A.level);
  for (int round = 0; round < maxRounds; ++round) {
    std::vector<std::uint64_t> keys;
    const KeyMap cubes = cubesAtNodes(B.M, A, keys);
    KeyMap meshNode(keys.size());
    for (int E : elementsOf(A.T))
      for (int n : B.M.tets[E])
        if (lattice.isNode(B.M.xi[n])) meshNode[lattice.node(B.M.xi[n])] = n;
    std::vector<int> bad;
    for (std::uint64_t key : keys)
      if (!isLocalDisk(cubes.get(key))) bad.push_back(meshNode.get(key));
    if (bad.empty()) return;
    for (int n : bad) {
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
  const Lattice lattice(A.level);
  KeyMap inside;
  std::vector<std::uint64_t> cubes;
  for (int E : elementsOf(A.T)) {
    const std::uint64_t key = lattice.cubeOf(M, E);
    if (!inside[key]++) cubes.push_back(key);
  }
  for (std::uint64_t key : cubes) {
    const std::array<std::int64_t, 3> cube = Lattice::position(key);
    for (int axis = 0; axis < 3; ++axis)
      for (int side = -1; side <= 1; side += 2) {
        std::array<std::int64_t, 3> beyond = cube, centre = cube;
        beyond[axis] += 2 * side;
        centre[axis] += side;
        if (inside.get(Lattice::key(beyond))) continue;
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
  for (int E : elementsOf(A.T))
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

}  // namespace

SquareSurface boundarySquares(const Mesh& M, const Approximation& A) {
  const Lattice lattice(A.level);
  SquareSurface Q;
  Q.level = A.level;
  Q.h = std::cbrt(M.cube.x * M.cube.y * M.cube.z) / lattice.scale;
  KeyMap meshNode;
  for (int E : elementsOf(A.T))
    for (int n : M.tets[E])
      if (lattice.isNode(M.xi[n])) meshNode[lattice.node(M.xi[n])] = n + 1;
  addSquares(M, A, meshNode, Q);
  joinSquares(Q);
  findDiagonals(M, A, Q);
  collectNodes(Q, static_cast<int>(M.x.size()));

  // ∂T must be one sphere: V − E + F = 2 with E = 2 F, and connected.
  const int euler = static_cast<int>(Q.nodes.size()) - static_cast<int>(Q.squares.size());
  std::vector<int> part(1, 0);
  std::vector<char> seen(Q.squares.size(), 0);
  if (!seen.empty()) seen[0] = 1;
  for (std::size_t i = 0; i < part.size() && !seen.empty(); ++i)
    for (int next : Q.squares[part[i]].across)
      if (!seen[next]) seen[next] = 1, part.push_back(next);
  if (euler != 2 || part.size() != Q.squares.size())
    throw MethodError(
        "insertSurface (§3.3): the boundary of T is no sphere (chi = " + std::to_string(euler) +
        ", " + std::to_string(part.size()) + " of " + std::to_string(Q.squares.size()) +
        " squares connected): S comes close to itself within l_c; lower l_c");
  return Q;
}

namespace {

/// What the squares of ∂T know of S: sides of their nodes, distances of their quarters.
/// Quarter e of a square is the triangle of its corners e, e + 1 and its centre.
struct Survey {
  std::vector<signed char> side;  // [mesh nodes], +1 or −1, 0 off ∂T
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
  std::vector<std::array<int, 3>> faces;
  for (std::size_t k = 1; k <= M.surfaces.size(); ++k)
    for (const auto& face : surfaceFaces(M, static_cast<int>(k)))
      if (boxesMeet(boxOf({M.x[face[0]], M.x[face[1]], M.x[face[2]]}), lo, hi))
        faces.push_back(face);
  return faces;
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

Survey surveySquares(const Mesh& M, const SquareSurface& Q, const SurfaceDistance& S) {
  constexpr double reach = 4;  // of h: no square of ∂T is farther from S
  const std::vector<std::array<int, 3>> earlier = facesAround(M, S, reach * Q.h);
  const TriangleTree tree(M.x, earlier);
  Survey survey;
  survey.side.assign(M.x.size(), 0);
  survey.sharp.assign(M.x.size(), 0);
  for (int n : Q.nodes) survey.side[n] = S.query(M.x[n]).side >= 0 ? 1 : -1;
  const double perH = 1 / Q.h;
  for (const Square& s : Q.squares) {
    bool isFree = true;
    for (int n : s.node) isFree &= M.dimension[n] == 3;
    const SurfaceQuery middle = S.query(s.centre);
    isFree = isFree && !crossesAny(tree, M.x, earlier, s.centre, middle.point);
    survey.free.push_back(isFree);
    survey.excess.push_back(perH * middle.excess);
    std::array<double, 4> beyond{}, above{};
    for (int e = 0; e < 4; ++e) {
      const SurfaceQuery near =
          S.query((1. / 3) * (M.x[s.node[e]] + M.x[s.node[(e + 1) % 4]] + s.centre));
      beyond[e] = perH * near.excess;
      if (!near.onRim) above[e] = perH * S.rimDistance(near.point);
    }
    survey.beyond.push_back(beyond);
    survey.above.push_back(above);
  }
  return survey;
}

constexpr unsigned char emptySquare = 0, fullSquare = 15;

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

int largestPart(const std::vector<int>& sizes) {
  return static_cast<int>(std::max_element(sizes.begin(), sizes.end()) - sizes.begin());
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
  for (std::size_t i = 0; i < part.size(); ++i)
    if (part[i] > 0 && part[i] != outside && survey.free[i]) selected[i] = fullSquare;
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
  constexpr double maxExcess =
      .75;  // [choice] of h: squares farther beyond the rim are no candidates
  constexpr int maxRounds = 100;
  Selection selected(Q.squares.size(), emptySquare);
  for (std::size_t i = 0; i < Q.squares.size(); ++i) {
    bool oneSide = survey.free[i] && survey.excess[i] <= maxExcess;
    for (int n : Q.squares[i].node) oneSide &= survey.side[n] == side;
    if (oneSide) selected[i] = fullSquare;
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
    for (int sweep = 0; sweep < maxSweeps; ++sweep) {
      bool improved = false;
      for (int i = 0; i < static_cast<int>(Q_.squares.size()); ++i)
        if (isNearRim(i)) improved |= improve(i);
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
    if (state == emptySquare) return true;
    if (!survey_.free[i]) return false;
    for (int e = 0; e < 4; ++e) {
      const bool used = (state >> e & 1) || (state >> ((e + 3) % 4) & 1);
      if (used && survey_.side[Q_.squares[i].node[e]] != side_) return false;
    }
    return true;
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
      const auto& n = Q_.squares[i].node;
      if (survey_.side[n[e]] != side_ || survey_.side[n[(e + 1) % 4]] != side_) continue;
      const double distance = selected_[i] >> e & 1 ? survey_.beyond[i][e] : survey_.above[i][e];
      E += .25 * distance * distance;
    }
    return E;
  }

  int quarterAcross(int i, int e) const {
    const Square& s = Q_.squares[i];
    return selected_[s.across[e]] >> s.acrossEdge[e] & 1;
  }

  /// E and χ of what squares i and j (or i alone, j < 0) touch.
  struct Local {
    double E;
    int chi;
  };
  Local local(int i, int j) const {
    Local sum{0, 0};
    for (int square : {i, j}) {
      if (square < 0) continue;
      const Square& s = Q_.squares[square];
      sum.E += squareEnergy(square);
      sum.chi += selected_[square] != 0;  // the centre
      for (int e = 0; e < 4; ++e) {
        const int here = selected_[square] >> e & 1,
                  previous = selected_[square] >> ((e + 3) % 4) & 1;
        sum.chi += here - (here || previous);  // quarter and spoke
        if (square != j || s.across[e] != i) sum.chi -= here || quarterAcross(square, e);
        if (square == j && isCorner(i, s.node[e])) continue;
        sum.E += nodeEnergy(s.node[e]);
        sum.chi += nodeState(Q_, selected_, s.node[e]).quarters > 0;
      }
    }
    return sum;
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
    const Local before = local(i, j);
    double bestE = before.E - least;
    unsigned char bestI = oldI, bestJ = oldJ;
    const int count = halves_ ? 6 : 2;
    for (int a = 0; a < count; ++a) {
      if (!isAllowed(i, states_[a])) continue;
      for (int b = 0; b < (j < 0 ? 1 : count); ++b) {
        if (j >= 0 && !isAllowed(j, states_[b])) continue;
        selected_[i] = states_[a];
        if (j >= 0) selected_[j] = states_[b];
        const Local now = local(i, j);
        if (now.E < bestE && now.chi == before.chi && isClean(i) && (j < 0 || isClean(j)))
          bestE = now.E, bestI = states_[a], bestJ = states_[b];
      }
    }
    selected_[i] = bestI;
    if (j >= 0) selected_[j] = bestJ;
    return bestI != oldI || (j >= 0 && bestJ != oldJ);
  }

  const SquareSurface& Q_;
  const Survey& survey_;
  int side_;
  Selection& selected_;
  bool halves_ = false;
};

/// 5000 × the area mean over S of max(0, dist(S, S_M)/h − 1.1)²: S must be near its approximation.
double uncovered(const Mesh& M, const SquareSurface& Q, const SurfaceDistance& S,
                 const Selection& selected) {
  constexpr double weight = 5000, allowed = 1.1;
  std::vector<std::array<int, 3>> triangles;
  for (std::size_t i = 0; i < selected.size(); ++i)
    if (selected[i]) {
      const auto& n = Q.squares[i].node;
      triangles.push_back({n[0], n[1], n[2]});
      triangles.push_back({n[0], n[2], n[3]});
    }
  const TriangleTree tree(M.x, triangles);
  double sum = 0, area = 0;
  for (const std::array<int, 3>& t : S.S.triangles) {
    const Vec3 a = S.S.points[t[0]], b = S.S.points[t[1]], c = S.S.points[t[2]];
    const double part = .5 * norm(cross(b - a, c - a));
    const double far = tree.closest((1. / 3) * (a + b + c)).distance / Q.h - allowed;
    area += part;
    if (far > 0) sum += part * far * far;
  }
  return weight * sum / area;
}

/// Where S has no square beside it because another surface is in the way: the place; empty: nowhere.
std::string blockedPlace(const Mesh& M, const SquareSurface& Q, const SurfaceDistance& S,
                         const Survey& survey, int side, const Selection& selected) {
  constexpr double missed = 2;  // [choice] of h from S to S_M: at the rim one square may be missing
  std::vector<std::array<int, 3>> triangles;
  for (std::size_t i = 0; i < selected.size(); ++i) {
    if (!selected[i]) continue;
    const auto& n = Q.squares[i].node;
    triangles.push_back({n[0], n[1], n[2]});
    triangles.push_back({n[0], n[2], n[3]});
  }
  const TriangleTree tree(M.x, triangles);
  for (std::size_t i = 0; i < selected.size(); ++i) {
    bool isBlocked = !survey.free[i] && survey.excess[i] == 0;
    for (int n : Q.squares[i].node) isBlocked = isBlocked && survey.side[n] == side;
    if (!isBlocked) continue;
    const Vec3 onS = S.query(Q.squares[i].centre).point;
    if (tree.closest(onS, missed * Q.h).triangle < 0) return placeText(onS);
  }
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
      if (survey.side[n] == side &&
          (nearest < 0 || norm2(M.x[n] - point) < norm2(M.x[nearest] - point)))
        nearest = n;
    if (nearest >= 0) survey.sharp[nearest] = 1;
  }
}

}  // namespace

Extraction surfaceExtraction(const Mesh& M, const SquareSurface& Q, const SurfaceDistance& S,
                             int side, Outline outline) {
  constexpr int maxRounds = 50;
  Survey survey = surveySquares(M, Q, S);
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
  result.fault = diskFault(Q, result.selected);
  const std::string blocked = blockedPlace(M, Q, S, survey, side, result.selected);
  if (!blocked.empty()) {
    result.isBlocked = true;
    result.fault = "another surface is nearer to S than its squares, near " + blocked;
  }
  if (result.fault.empty()) result.energy = rim.energy() + uncovered(M, Q, S, result.selected);
  return result;
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
  for (int E : elementsOf(A.T))
    for (int i = 0; i < 4; ++i) {
      const int other = B.neighbour[E][i];
      if (other < 0 || A.T[other]) continue;
      if (!lattice.squareOf(M, faceOpposite(M.tets[E], i), half)) continue;
      const int square = squareAt.get(Lattice::key(half)) - 1;
      if (square < 0 || !selected[square]) continue;
      M.faceLabel[E][i] = k;
      auto& back = B.neighbour[other];
      M.faceLabel[other][std::find(back.begin(), back.end(), E) - back.begin()] = k;
    }
  // A half whose cut is not the mesh's diagonal: bisect that diagonal, the cut appears.
  for (std::size_t i = 0; i < selected.size(); ++i) {
    if (selected[i] == emptySquare || selected[i] == fullSquare) continue;
    const Square& s = Q.squares[i];
    // halves 3 and 12 (corners 0,1,2 / 2,3,0) are cut from corner 0 to 2, 6 and 9 from 1 to 3
    const int cut = selected[i] == 3 || selected[i] == 12 ? 0 : 1;
    if (s.diagonal != cut) B.bisectEdge(s.node[1 - cut], s.node[3 - cut]);
  }
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i) {
      if (M.faceLabel[E][i] != k) continue;
      const std::array<int, 3> face = faceOpposite(M.tets[E], i);
      lattice.squareOf(M, face, half);
      const int square = squareAt.get(Lattice::key(half)) - 1;
      if (!(selected[square] >> quarterOf(M, Q, square, face) & 1)) M.faceLabel[E][i] = 0;
    }
}

namespace {

/// S_M as a complex: its nodes, edges and rim, read off the labelled faces.
struct SurfaceComplex {
  std::vector<char> node;  // [mesh nodes], 0 off S_M, 1 inside, 2 on the rim
  KeyMap edges;            // edge → times seen (twice a face): 2 rim, 4 inside
  std::vector<std::pair<int, int>> edgeList;
  SurfaceComplex(const Mesh& M, int k) : node(M.x.size(), 0) {
    for (std::size_t E = 0; E < M.tets.size(); ++E)
      for (int i = 0; i < 4; ++i) {
        if (M.faceLabel[E][i] != k) continue;
        const std::array<int, 3> v = faceOpposite(M.tets[E], i);
        for (int e = 0; e < 3; ++e) {
          node[v[e]] = 1;
          if (edges[edgeKey(v[e], v[(e + 1) % 3])]++ == 0)
            edgeList.push_back({v[e], v[(e + 1) % 3]});
        }
      }
    for (const auto& [a, b] : edgeList)
      if (isRimEdge(a, b)) node[a] = node[b] = 2;
  }
  bool isEdge(int a, int b) const { return edges.get(edgeKey(a, b)) > 0; }
  bool isRimEdge(int a, int b) const { return edges.get(edgeKey(a, b)) == 2; }
};

constexpr int tetEdges[6][2] = {{0, 1}, {0, 2}, {0, 3}, {1, 2}, {1, 3}, {2, 3}};

/// Bisects the edges; true where there were any.
bool bisectEdges(Bisection& B, const std::vector<std::pair<int, int>>& edges) {
  for (const auto& [a, b] : edges) B.bisectEdge(a, b);
  return !edges.empty();
}

}  // namespace

bool refineTetrahedraWithTwoFaces(Bisection& B, int k) {
  std::vector<std::pair<int, int>> refine;  // tetrahedron, level
  for (std::size_t E = 0; E < B.M.tets.size(); ++E) {
    const std::array<int, 4>& label = B.M.faceLabel[E];
    if (std::count(label.begin(), label.end(), k) > 1)
      refine.push_back({static_cast<int>(E), B.M.level[E]});
  }
  for (const auto& [E, level] : refine)
    if (B.M.level[E] == level) B.bisect(E);
  return !refine.empty();
}

bool refineFacesWithTwoRimEdges(Bisection& B, int k) {
  const SurfaceComplex SM(B.M, k);
  std::vector<std::pair<int, int>> refine;
  for (const std::array<int, 4>& z : B.M.tets)
    for (int i = 0; i < 4; ++i) {
      const std::array<int, 3> v = faceOpposite(z, i);
      if (SM.node[v[0]] != 2 || SM.node[v[1]] != 2 || SM.node[v[2]] != 2) continue;
      int rimEdges = 0;
      for (int e = 0; e < 3; ++e) rimEdges += SM.isRimEdge(v[e], v[(e + 1) % 3]);
      if (rimEdges > 1) refine.push_back(refinementEdge(B.M, v));
    }
  return bisectEdges(B, refine);
}

bool refineEdgesAcrossTheRim(Bisection& B, int k) {
  const SurfaceComplex SM(B.M, k);
  std::vector<std::pair<int, int>> refine;
  for (const auto& [a, b] : SM.edgeList)
    if (SM.node[a] == 2 && SM.node[b] == 2 && !SM.isRimEdge(a, b)) refine.push_back({a, b});
  return bisectEdges(B, refine);
}

bool refineEdgesBetweenSurfaces(Bisection& B, int k) {
  const SurfaceComplex SM(B.M, k);
  std::vector<std::pair<int, int>> refine;
  for (const std::array<int, 4>& z : B.M.tets)
    for (const auto& e : tetEdges) {
      const int a = z[e[0]], b = z[e[1]];
      if ((SM.node[a] && B.M.dimension[b] < 3 && !SM.node[b]) ||
          (SM.node[b] && B.M.dimension[a] < 3 && !SM.node[a]))
        refine.push_back({a, b});
    }
  return bisectEdges(B, refine);
}

bool refineToFullSubcomplex(Bisection& B, int k) {
  const SurfaceComplex SM(B.M, k);
  std::vector<std::pair<int, int>> refine;
  for (std::size_t E = 0; E < B.M.tets.size(); ++E) {
    const std::array<int, 4>& z = B.M.tets[E];
    for (const auto& e : tetEdges)
      if (SM.node[z[e[0]]] && SM.node[z[e[1]]] && !SM.isEdge(z[e[0]], z[e[1]]))
        refine.push_back({z[e[0]], z[e[1]]});
    for (int i = 0; i < 4; ++i) {
      const std::array<int, 3> v = faceOpposite(z, i);
      if (B.M.faceLabel[E][i] != k && SM.isEdge(v[0], v[1]) && SM.isEdge(v[1], v[2]) &&
          SM.isEdge(v[2], v[0]))
        refine.push_back(refinementEdge(B.M, v));
    }
  }
  return bisectEdges(B, refine);
}

int surfaceHealing(Bisection& B, int k) {
  constexpr int maxRounds = 30;  // [choice] rounds end after 2 to 5 where they end
  for (int round = 1; round <= maxRounds; ++round) {
    bool changed = refineTetrahedraWithTwoFaces(B, k);
    changed |= refineFacesWithTwoRimEdges(B, k);
    changed |= refineEdgesAcrossTheRim(B, k);
    changed |= refineEdgesBetweenSurfaces(B, k);
    changed |= refineToFullSubcomplex(B, k);
    if (!changed) return round;
  }
  throw MethodError("insertSurface (§3.5): the rules of surface healing do not settle after " +
                    std::to_string(maxRounds) + " rounds; lower l_c");
}

// ==== Tools for 3.6: sparse iterative solver ====================================================

namespace {

using RealVector = std::vector<double>;

double innerProduct(const RealVector& a, const RealVector& b) {
  return std::inner_product(a.begin(), a.end(), b.begin(), 0.0);
}

double normOf(const RealVector& a) { return std::sqrt(innerProduct(a, a)); }

/// y += t a
void addMultiple(RealVector& y, double t, const RealVector& a) {
  for (std::size_t i = 0; i < y.size(); ++i) y[i] += t * a[i];
}

RealVector productOf(const SparseMatrix& A, const RealVector& x) {
  RealVector y(x.size(), 0.0);
  for (std::size_t i = 0; i < y.size(); ++i)
    for (int k = A.start[i]; k < A.start[i + 1]; ++k) y[i] += A.value[k] * x[A.column[k]];
  return y;
}

/// b − A x
RealVector residualOf(const SparseMatrix& A, const RealVector& b, const RealVector& x) {
  RealVector r = b;
  addMultiple(r, -1, productOf(A, x));
  return r;
}

/// [choice] ω of the preconditioner, in (0, 2): above 1 it reaches far across large surfaces.
constexpr double overRelaxation = 1.75;

/// Solves M z = r with M = (D + ωL) D⁻¹ (D + ωU), the symmetric successive over-relaxation (SSOR)
/// preconditioner of A = L + D + U; `diagonal` are the entries of D.
RealVector precondition(const SparseMatrix& A, const std::vector<int>& diagonal, RealVector z) {
  const int n = static_cast<int>(z.size());
  for (int i = 0; i < n; ++i) {  // (D + ωL) z = r
    double sum = 0;
    for (int k = A.start[i]; k < diagonal[i]; ++k) sum += A.value[k] * z[A.column[k]];
    z[i] = (z[i] - overRelaxation * sum) / A.value[diagonal[i]];
  }
  for (int i = n - 1; i >= 0; --i) {  // (D + ωU) z' = D z
    double sum = 0;
    for (int k = diagonal[i] + 1; k < A.start[i + 1]; ++k) sum += A.value[k] * z[A.column[k]];
    z[i] -= overRelaxation * sum / A.value[diagonal[i]];
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
int bicgstabRun(const SparseMatrix& A, const std::vector<int>& diagonal, const RealVector& b,
                RealVector& x, double goal, int maxIterations) {
  RealVector r = residualOf(A, b, x), p = r;
  const RealVector r0 = r;
  double rho = innerProduct(r0, r);
  for (int iteration = 1; iteration <= maxIterations; ++iteration) {
    const RealVector pHat = precondition(A, diagonal, p), v = productOf(A, pHat);
    const double alpha = rho / innerProduct(r0, v);
    if (!std::isfinite(alpha)) return iteration;
    addMultiple(x, alpha, pHat);
    addMultiple(r, -alpha, v);  // r is now s
    if (normOf(r) <= goal) return iteration;

    const RealVector sHat = precondition(A, diagonal, r), t = productOf(A, sHat);
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

int solveBiCGSTAB(const SparseMatrix& A, const std::vector<double>& b, std::vector<double>& x,
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
SparseMatrix compressRows(std::vector<Entry> entries, std::size_t rows) {
  std::stable_sort(entries.begin(), entries.end(), [](const Entry& a, const Entry& b) {
    return a.row != b.row ? a.row < b.row : a.column < b.column;
  });
  SparseMatrix A;
  A.start.assign(rows + 1, 0);
  for (std::size_t k = 0; k < entries.size(); ++k) {
    const Entry& e = entries[k];
    if (k > 0 && e.row == entries[k - 1].row && e.column == entries[k - 1].column) {
      A.value.back() += e.value;
    } else {
      A.column.push_back(e.column);
      A.value.push_back(e.value);
      ++A.start[e.row + 1];
    }
  }
  std::partial_sum(A.start.begin(), A.start.end(), A.start.begin());
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
  SparseMatrix lambda = compressRows(std::move(entries), points.size());
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
  std::array<RealVector, 2> b, x;  // in the two coordinates
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
    b[0].push_back(right.x);
    b[1].push_back(right.y);
    x[0].push_back(u[n].x);
    x[1].push_back(u[n].y);
  }
  const SparseMatrix A = compressRows(std::move(entries), point.size());
  for (int c = 0; c < 2; ++c) solveBiCGSTAB(A, b[c], x[c]);
  for (int n : point) u[n] = {x[0][row[n]], x[1][row[n]]};
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
  u = anchoredParametrization(lambda, isRim, u, RealVector(u.size(), 0.0), u);
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
  constexpr int maxRounds =
      64;  // a chord's new point is inside: one round, two where the rim had three points
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
  return Phi;
}

namespace {

/// S_M with its own numbers: a disk oriented like S.
struct ApproximatingSurface {
  TriangleSurface S;        // points are the nodes' positions
  std::vector<int> node;    // [points], number in M
  std::vector<int> rim;     // loop of points, S_M on its left
  std::vector<char> isRim;  // [points]
  double h = 0;             // mean length of its edges
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

ApproximatingSurface approximatingSurface(const Mesh& M, int k, const SurfaceDistance& S) {
  ApproximatingSurface SM = labelledSurface(M, k);
  // The side of S's normals: by the nearest points of S, weighted by area.
  double agreement = 0;
  for (const std::array<int, 3>& t : SM.S.triangles) {
    const Vec3 a = SM.S.points[t[0]], b = SM.S.points[t[1]], c = SM.S.points[t[2]];
    agreement += dot(cross(b - a, c - a), S.query((1. / 3) * (a + b + c)).normal);
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
std::array<int, 4> matchedCorners(const std::vector<Vec3>& rim, const RealVector& bonus,
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
  RealVector least(count + 1, beyondAll), before, stepCost;
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
RealVector cornerBonus(const ApproximatingSurface& SM) {
  RealVector turn(SM.S.points.size(), 180 * degree), bonus;
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
/// anchors go, in growing rings, until none folds.
///   u  set at the rim
std::vector<Vec2> anchoredMap(const ApproximatingSurface& SM, const SurfaceDistance& S,
                              const Parametrization& Phi, std::vector<Vec2> u) {
  const std::vector<Vec2>& uS = Phi.u;
  std::vector<double> mu(u.size(), 0.0);
  for (std::size_t i = 0; i < u.size(); ++i) {
    if (SM.isRim[i]) continue;
    const SurfaceQuery q = S.query(SM.S.points[i]);
    const std::array<int, 3>& t = S.S.triangles[q.triangle];
    u[i] = q.w[0] * uS[t[0]] + q.w[1] * uS[t[1]] + q.w[2] * uS[t[2]];
    mu[i] = q.onRim ? 0 : anchorMu;
  }
  const SparseMatrix lambda = meanValueWeights(SM.S.points, SM.S.triangles, SM.isRim);
  const std::vector<Vec2> anchor = u;
  const std::vector<char> bridges = bridgingTriangles(SM, Phi, anchor);
  const std::vector<char> held = holdBridges(SM, bridges, mu);
  for (int rings = 0; rings <= maxRings; rings = 2 * rings + 1) {
    u = anchoredParametrization(lambda, SM.isRim, u, mu, anchor);
    std::vector<int> flipped;
    for (int t : flippedTriangles(SM.S.triangles, u))
      if (!bridges[t]) flipped.push_back(t);
    if (flipped.empty()) return u;
    weakenAnchors(SM.S, flipped, rings, held, mu);
  }
  return floaterParametrization(SM.S.points, SM.S.triangles, SM.isRim, u);
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

}  // namespace

ProjectionReport surfaceProjection(Mesh& M, const TriangleSurface& cleaned, bool followRim) {
  const int k = static_cast<int>(M.surfaces.size()) + 1;
  TriangleSurface split = cleaned;
  splitChords(split);
  const SurfaceDistance S(split);
  SurfaceParametrization Phi = parametrizeSurface(S);  // ϕ, eq. (3)
  const ApproximatingSurface SM = approximatingSurface(M, k, S);
  const RimTargets targets = rimTargets(SM, Phi, followRim);
  std::vector<Vec2> u(SM.node.size());  // ϕ_M⁻¹, eq. (3)
  for (std::size_t i = 0; i < SM.rim.size(); ++i)
    u[SM.rim[i]] = rimParameter(Phi.cornerS, Phi.rim.s.back(), targets.s[i]);
  buildLocator(Phi.surface);
  u = followRim ? anchoredMap(SM, S, Phi.surface, u)
                : floaterParametrization(SM.S.points, SM.S.triangles, SM.isRim, u);

  Phi.surface.rim = static_cast<int>(M.curves.size()) + 1;
  Phi.rim.sides[0].surface = k;
  M.surfaces.push_back(Phi.surface);
  M.curves.push_back(Phi.rim);
  ProjectionReport report;
  report.cornerNodes = placeNodes(M, SM, u, targets, Phi.cornerS);  // x', eq. (4)
  for (std::size_t i = 0; i < SM.node.size(); ++i) {
    const Vec3 nearest = S.query(SM.S.points[i]).point;
    report.tangentialShift = std::max(report.tangentialShift, norm(M.x[SM.node[i]] - nearest));
  }
  return report;
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
  for (const std::array<int, 4>& z : M.tets) {
    bool in = true;
    for (int i = 0; i < 4 && in; ++i) {
      const std::array<int, 3> v = faceOpposite(z, i);
      const Vec3 normal = cross(M.x[v[1]] - M.x[v[0]], M.x[v[2]] - M.x[v[0]]);
      in = dot(normal, p - M.x[v[0]]) * dot(normal, M.x[z[i]] - M.x[v[0]]) >= 0;
    }
    if (in) return true;
  }
  return false;
}

void checkOptions(const InsertOptions& options, std::size_t nodes) {
  constexpr int mostTets = 500000000;  // indices of four faces each fit in an int
  if (!(options.lc > 0) || !std::isfinite(options.lc))
    throw InputError("insertSurface (§3.2): l_c = " + number(options.lc) + " must be above 0");
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

/// l_c against the distances of §3.1 and §3.2: S inside the domain, and clear of earlier surfaces.
void checkDistances(const Mesh& M, const SurfaceDistance& S, double lc) {
  std::vector<std::array<int, 3>> boundary;
  for (std::size_t p = 1; p <= M.patches.size(); ++p)
    for (const auto& face : surfaceFaces(M, -static_cast<int>(p))) boundary.push_back(face);
  const Gap gap = smallestGap(S.tree, M.x, boundary);
  if (gap.distance <= 0 || !contains(M, S.S.points[0]))
    throw InputError("insertSurface (§3.1): S touches or leaves the domain" +
                     (gap.distance <= 0 ? at(gap) : std::string()) + "; it must lie inside");
  if (!(lc < gap.distance))
    throw InputError("insertSurface (§3.2): l_c = " + number(lc) + " is not below dist(∂M, S) = " +
                     number(gap.distance) + at(gap) + "; lower l_c");
}

/// l_c against the size of what comes: not more tetrahedra than allowed, not smaller than S.
void checkSize(const Mesh& M, const SurfaceDistance& S, double lc, int maxTets) {
  constexpr double tetsPerSquare = 45;  // [choice] measured 36 to 55 per cube face of area of S
  constexpr int maxLevel = 57;          // 2^19 cubes along a unit of ξ: what a lattice key holds
  const int level = cubeLevel(M, lc);
  const double halving = std::exp2(-level / 3);
  const double h = halving * std::cbrt(M.cube.x * M.cube.y * M.cube.z);
  double area = 0, farthest = 0, extent = 0;
  for (const auto& t : S.S.triangles)
    area +=
        .5 * norm(cross(S.S.points[t[1]] - S.S.points[t[0]], S.S.points[t[2]] - S.S.points[t[0]]));
  for (const Vec3& p : S.S.points) extent = std::max(extent, norm(p - S.S.points[S.rim[0]]));
  for (const Vec3& xi : M.xi) farthest = std::max({farthest, xi.x, xi.y, xi.z});
  if (extent < 2 * h)
    throw InputError("insertSurface (§3.2): S, of extent " + number(extent) +
                     ", is smaller than two cubes of edge " + number(h) + " that l_c = " +
                     number(lc) + " gives; lower l_c to " + number(.5 * lc * extent / (2 * h)));
  const double predicted = static_cast<double>(M.tets.size()) + tetsPerSquare * area / (h * h);
  if (predicted > maxTets)
    throw InputError("insertSurface (§3.2): l_c = " + number(lc) + " asks for about " +
                     number(predicted) + " tetrahedra, above the limit of " +
                     std::to_string(maxTets) + "; raise l_c or the limit");
  if (level > maxLevel || farthest / halving > std::exp2(maxLevel / 3))
    throw InputError("insertSurface (§3.2): l_c = " + number(lc) +
                     " is below 1/500000 of the domain; raise l_c");
}

/// One way to insert S: a side, and how the outline of S_M is made.
struct Way {
  int side;
  Outline outline;
  Extraction extraction;
};

/// The state of an insertion, from the copy of the caller's mesh on.
struct Insertion {
  const SurfaceDistance& S;
  const InsertOptions& options;
  int k;        // number of the new surface
  Mesh M = {};  // refined by §3.2 and §3.3
  Approximation A = {};
  SquareSurface Q = {};
  int ways = 0;    // tried so far, over all l_c
  int faults = 0;  // and left; why the last one was, without prefix and advice
  std::string reason = {};
  bool isBlocked = false;  // at this l_c, by an earlier surface
  double lowest = 0;       // q of the best way so far

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

std::string describe(const Way& way) {
  return std::string(way.side > 0 ? "positive" : "negative") + " side, " +
         (way.outline == Outline::halfSquares ? "half squares" : "whole squares");
}

/// §3.4 on both sides: the ways to go on with this outline, best first.
std::vector<Way> extractWays(Insertion& I, Outline outline) {
  std::vector<Way> ways;
  for (int side : {1, -1}) {
    Way way{side, outline, surfaceExtraction(I.M, I.Q, I.S, side, outline)};
    if (way.extraction.fault.empty())
      ways.push_back(std::move(way));
    else
      I.leave(describe(way),
              MethodError("insertSurface (§3.4): " +
                          std::string(way.extraction.isBlocked ? "" : "S_M is no disk, ") +
                          way.extraction.fault));
    I.isBlocked = I.isBlocked || way.extraction.isBlocked;
  }
  if (ways.size() == 2 && ways[1].extraction.energy < ways[0].extraction.energy)
    std::swap(ways[0], ways[1]);
  return ways;
}

/// Nodes of S_M and their neighbours: where the optimization starts.
std::vector<int> nodesNear(const Mesh& M, int k) {
  std::vector<char> near(M.x.size(), 0), on(M.x.size(), 0);
  for (const auto& face : surfaceFaces(M, k))
    for (int n : face) on[n] = 1;
  for (const std::array<int, 4>& z : M.tets)
    if (on[z[0]] || on[z[1]] || on[z[2]] || on[z[3]])
      for (int n : z) near[n] = 1;
  std::vector<int> nodes;
  for (std::size_t n = 0; n < near.size(); ++n)
    if (near[n]) nodes.push_back(static_cast<int>(n));
  return nodes;
}

/// Lowest q of the elements at S_M and of their neighbours.
double lowestNear(const Mesh& M, int k) {
  std::vector<char> near(M.x.size(), 0);
  for (int n : nodesNear(M, k)) near[n] = 1;
  const std::vector<double> q = qualities(M);
  double lowest = 1;
  for (std::size_t E = 0; E < q.size(); ++E) {
    const std::array<int, 4>& z = M.tets[E];
    if (near[z[0]] || near[z[1]] || near[z[2]] || near[z[3]]) lowest = std::min(lowest, q[E]);
  }
  return lowest;
}

/// Lets a node fixed at a sharp corner of S slide along the rim.
void releaseCorner(Mesh& M, int n, int k) {
  if (M.dimension[n] != 0) return;
  for (const Corner::Place& place : M.corners[M.entity[n] - 1].on)
    if (place.curve == M.surfaces[k - 1].rim) {
      M.dimension[n] = 1, M.entity[n] = place.curve, M.parameter[n] = {place.s, 0};
      return;
    }
}

/// §3.7, and [departure] where a few elements stay inverted: their corners are released, they are
/// bisected for more freedom, as long as their number falls. No global descent here: other ways of
/// inserting S are cheaper.
void optimizeAround(Bisection& B, const Insertion& I, InsertReport& report) {
  constexpr int maxRounds = 4, fewInverted = 60;
  OptimizeOptions optimize = I.options.optimize;
  optimize.globalDescent = false;
  optimize.active = nodesNear(B.M, I.k);
  report.optimization = optimizeMesh(B.M, optimize);
  for (int round = 0; round < maxRounds; ++round) {
    const int inverted = report.optimization.inverted;
    if (inverted == 0 || inverted > fewInverted) return;
    const std::vector<double> q = qualities(B.M);
    for (std::size_t E = 0; E < q.size(); ++E)
      if (q[E] <= 0) {
        for (int n : B.M.tets[E]) releaseCorner(B.M, n, I.k);
        B.bisect(static_cast<int>(E));
      }
    surfaceHealing(B, I.k);
    optimize.active.clear();
    const int sweeps = report.optimization.sweeps;
    report.optimization = optimizeMesh(B.M, optimize);
    report.optimization.sweeps += sweeps;
    if (report.optimization.inverted >= inverted) return;
  }
}

/// §3.4's labels, 3.5, 3.6 and 3.7 on a copy of the refined mesh.
void insertOnWay(Insertion& I, const Way& way, Mesh& M, InsertReport& report) {
  Bisection B(M);
  labelSurface(B, I.Q, I.A, way.extraction.selected, I.k);
  report.way = ++I.ways;
  I.stage("extracted", M);
  const int rounds = surfaceHealing(B, I.k);
  if (surfaceFaces(M, I.k).empty())
    throw MethodError("insertSurface (§3.5): S_M vanished in healing; lower l_c");
  report.refined = qualityStatistics(M);
  I.stage("surfaceHealed", M);
  I.progress("3.5 surface healing: " + std::to_string(rounds) + " rounds, " +
             std::to_string(M.tets.size()) + " tetrahedra (" + describe(way) + ")");
  const ProjectionReport projection = surfaceProjection(M, I.S.S, I.options.followRim);
  report.tangentialShift = projection.tangentialShift;
  report.projected = qualityStatistics(M);
  I.stage("projected", M);
  I.progress("3.6 projection: " + std::to_string(report.projected.inverted) + " inverted");
  optimizeAround(B, I, report);
  report.smoothed = qualityStatistics(M);
  I.progress("3.7 optimization: " + std::to_string(report.optimization.sweeps) + " sweeps, " +
             std::to_string(report.smoothed.inverted) + " inverted, min " +
             number(report.smoothed.min) + ", mean " + number(report.smoothed.mean));
  if (report.smoothed.inverted > 0)
    throw MethodError("insertSurface (§3.7): " + std::to_string(report.smoothed.inverted) +
                      " elements stay inverted");
}

/// The measures of S_M that the report promises.
///   errors  MethodError: a node of it is off S
void measureSurface(const Mesh& M, const SurfaceDistance& S, InsertReport& report) {
  constexpr int samples = 4;
  const std::vector<std::array<int, 3>> faces = surfaceFaces(M, report.surface);
  std::vector<char> on(M.x.size(), 0);
  report.nodes = 0, report.maxNodeDistance = 0;
  for (const auto& face : faces)
    for (int n : face) {
      if (on[n]) continue;
      on[n] = 1;
      ++report.nodes;
      report.maxNodeDistance = std::max(report.maxNodeDistance, S.query(M.x[n]).distance);
    }
  // [choice] on S: 1e-12 of its diagonal, and the last digits of coordinates far from the origin
  const TriangleTree::Box& box = S.tree.nodes[0].box;
  const double allowed = 1e-12 * norm(box.hi - box.lo) + 1e-15 * (norm(box.hi) + norm(box.lo));
  if (report.maxNodeDistance > allowed)
    throw MethodError("insertSurface (§3.6): a node of S_M is " + number(report.maxNodeDistance) +
                      " away from S");
  report.triangles = static_cast<int>(faces.size());
  report.hausdorff = hausdorffDistance(TriangleTree(M.x, faces), S.tree, samples);
}

/// Refuses S_M where it is far from S, and warns where it is poor.
void judgeSurface(double h, InsertReport& report) {
  constexpr double poorHausdorff = .3, badHausdorff = .5;  // [choice] of l_c: warned of, refused
  constexpr double poorShift = 2;                          // [choice] of h: warned of
  if (report.hausdorff > badHausdorff * report.lc)
    throw MethodError("insertSurface (§3.6): the Hausdorff distance S_M - S is " +
                      number(report.hausdorff) +
                      ", above half of l_c: S has a part narrower than "
                      "the cubes");
  if (report.hausdorff > poorHausdorff * report.lc)
    report.warnings.push_back("the Hausdorff distance S_M - S, " + number(report.hausdorff) +
                              ", is above .3 l_c; lower l_c");
  if (report.tangentialShift > poorShift * h)
    report.warnings.push_back("the projection moved a node " + number(report.tangentialShift) +
                              " along S, more than 2 cube edges; lower l_c");
}

/// Follows one way; keeps its mesh and report where it is the best valid one so far.
void tryWay(Insertion& I, const Way& way, double lc, Mesh& result, InsertReport& report) {
  Mesh trial = I.M;
  InsertReport ofThisWay;
  ofThisWay.original = report.original;
  ofThisWay.surface = I.k, ofThisWay.lc = lc;
  try {
    insertOnWay(I, way, trial, ofThisWay);
    measureSurface(trial, I.S, ofThisWay);
    judgeSurface(I.Q.h, ofThisWay);
  } catch (const MethodError& error) {
    I.leave(describe(way), error);
    return;
  } catch (const SolverError& error) {
    I.leave(describe(way), error);
    return;
  }
  // beside earlier surfaces the lowest q may be theirs, on every way
  const double lowest = I.k > 1 ? lowestNear(trial, I.k) : ofThisWay.smoothed.min;
  if (report.surface == 0 || lowest > I.lowest)
    report = ofThisWay, result = std::move(trial), I.lowest = lowest;
}

/// S must not cross the faces of earlier surfaces, which deviate from these: refined with T they
/// come nearer.
void checkFacesApart(Insertion& I) {
  const Gap gap = smallestGap(I.S.tree, I.M.x, facesAround(I.M, I.S, 0));
  if (gap.triangle < 0 || gap.distance > 0) return;
  I.isBlocked = true;
  throw MethodError("insertSurface (§3.2): S crosses the faces of an earlier surface" + at(gap) +
                    "; lower l_c");
}

/// One l_c: 3.2 to 3.7, on all ways until one is good; the best valid one stays in result and
/// report.
void insertWithSize(Insertion& I, const Mesh& M, double lc, Mesh& result, InsertReport& report) {
  // [choice] min q below which the other ways are tried too: above 50k tetrahedra they cost too
  // much
  constexpr double goodQuality = .6, goodLargeQuality = .45;
  constexpr std::size_t large = 50000;
  I.M = M;
  Bisection B(I.M);
  I.A = volumetricApproximation(B, I.S, lc);
  I.stage("approximated", I.M);
  checkFacesApart(I);
  volumetricHealing(B, I.A);
  I.Q = boundarySquares(I.M, I.A);
  I.stage("healed", I.M);
  I.progress("3.2-3.3 approximation: " + std::to_string(I.M.tets.size()) + " tetrahedra, " +
             std::to_string(I.Q.squares.size()) + " squares around S, h = " + number(I.Q.h));
  const double good = I.M.tets.size() < large ? goodQuality : goodLargeQuality;
  auto isGood = [&] {
    return report.surface > 0 &&
           (I.lowest >= std::min(good, report.original.min) ||
            I.options.outline == Outline::paper);
  };
  std::vector<Outline> outlines{I.options.outline};
  if (I.options.outline == Outline::halfSquares) outlines.push_back(Outline::squares);
  std::vector<Selection> tried;
  for (Outline outline : outlines)
    if (!isGood())
      for (const Way& way : extractWays(I, outline)) {
        const Selection& selected = way.extraction.selected;
        if (isGood() || std::find(tried.begin(), tried.end(), selected) != tried.end()) continue;
        tried.push_back(selected);
        tryWay(I, way, lc, result, report);
      }
}

}  // namespace

namespace {

/// A surface of the call that has passed §3.1.
struct Candidate {
  SurfaceDistance S;
  std::string label;  // for messages
  std::vector<std::string> warnings;
};

Candidate candidateOf(const TriangleSurface& S, const std::string& label,
                      std::vector<std::string> warnings = {}) {
  TriangleSurface disk = checkSurface(S, warnings);
  splitChords(disk);
  return {SurfaceDistance(disk), label, std::move(warnings)};
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

std::string labelOf(const std::string& name, std::size_t number) {
  return name.empty() ? "surface " + std::to_string(number) : "surface '" + name + "'";
}

/// The surfaces of a call, each component one; labels only where there are several.
std::vector<Candidate> candidatesOf(const std::vector<TriangleSurface>& S) {
  std::vector<Candidate> all;
  for (std::size_t i = 0; i < S.size(); ++i) {
    const std::string given = S.size() > 1 ? labelOf(S[i].name, i + 1) : "";
    std::vector<std::string> warnings;
    const std::vector<TriangleSurface> components =
        labelled(given, [&] { return connectedComponents(S[i], warnings); });
    for (const TriangleSurface& one : components) {
      const std::string label = components.size() > 1 ? labelOf(one.name, i + 1) : given;
      all.push_back(labelled(label, [&] { return candidateOf(one, label, warnings); }));
      warnings.clear();
    }
  }
  return all;
}

/// [§3.1] Refuses two surfaces of the call, or one and an earlier one, that cross or touch.
void checkApart(const Mesh& M, const std::vector<Candidate>& all) {
  auto check = [](const Candidate& S, const std::string& other, const std::vector<Vec3>& points,
                  const std::vector<std::array<int, 3>>& triangles) {
    const Gap gap = smallestGap(S.S.tree, points, triangles);
    const TriangleTree::Box& box = S.S.tree.nodes[0].box;
    if (gap.distance <= touching * norm(box.hi - box.lo))
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

/// The earlier surface nearest to S, for messages: "'name', 12.5 away at triangle 3 near (1, 2, 3)".
struct Nearest {
  std::string text;
  double distance;
};
Nearest nearestEarlier(const Mesh& M, const SurfaceDistance& S) {
  Nearest nearest{"", beyondAll};
  for (std::size_t k = 0; k < M.surfaces.size(); ++k) {
    const Gap gap = smallestGap(S.tree, M.surfaces[k].points, M.surfaces[k].triangles);
    if (gap.distance < nearest.distance)
      nearest = {labelOf(M.surfaces[k].name, k + 1) + " is " + number(gap.distance) + " away" +
                     at(gap),
                 gap.distance};
  }
  return nearest;
}

/// 3.2 to 3.7 for one surface; with half of l_c where no way is valid, and again where another
/// surface is in the way.
InsertReport insertCandidate(Mesh& M, const Candidate& candidate, const InsertOptions& options) {
  constexpr int maxTries = 2;     // [choice] of l_c, with ways that were followed to the end
  constexpr int maxHalvings = 4;  // [choice] of l_c in all, while another surface is in the way
  const SurfaceDistance& cleaned = candidate.S;
  InsertReport report;
  report.original = qualityStatistics(M);
  checkDistances(M, cleaned, options.lc);
  checkSize(M, cleaned, options.lc, options.maxTets);

  Insertion I{cleaned, options, static_cast<int>(M.surfaces.size()) + 1};
  Mesh result;
  double lc = options.lc;
  bool wasBlocked = false;
  for (int tries = 0, halvings = 0; tries < maxTries && halvings <= maxHalvings; ++halvings) {
    const int waysBefore = I.ways;
    I.isBlocked = false;
    try {
      if (halvings > 0) checkSize(M, cleaned, lc, options.maxTets);
      insertWithSize(I, M, lc, result, report);
    } catch (const MethodError& error) {
      I.leave("l_c = " + number(lc), error);
    }
    if (report.surface > 0) break;
    wasBlocked = wasBlocked || I.isBlocked;
    if (I.ways > waysBefore || !I.isBlocked) ++tries;
    lc /= 2;
  }
  const Nearest nearest = wasBlocked ? nearestEarlier(M, cleaned) : Nearest{"", 0};
  if (report.surface == 0)
    throw MethodError("insertSurface (§3): no valid mesh at l_c = " + number(options.lc) +
                      " nor down to " + number(2 * lc) + ", after " + std::to_string(I.faults) +
                      " tries, the last because " + I.reason +
                      (wasBlocked ? "; " + nearest.text + ": lower l_c to " +
                                        number(.5 * nearest.distance)
                                  : "; lower l_c"));
  std::vector<std::string> warnings = candidate.warnings;
  if (report.lc < options.lc)
    warnings.push_back("l_c was lowered from " + number(options.lc) + " to " + number(report.lc) +
                       ", because " +
                       (wasBlocked ? nearest.text : "at " + number(options.lc) + " no way was valid"));
  report.warnings.insert(report.warnings.begin(), warnings.begin(), warnings.end());
  report.regular = qualityStatistics(result, Ideal::regular);
  I.stage("smoothed", result);
  M = std::move(result);
  return report;
}

/// What an insertion asks of the mesh and the options before it looks at a surface.
void checkStart(const Mesh& M, const InsertOptions& options) {
  checkMeccano(M, "insertSurface (§3.1)");
  checkOptions(options, M.x.size());
  const int inverted = qualityStatistics(M).inverted;
  if (inverted > 0)
    throw InputError("insertSurface (§3.1): the mesh has " + std::to_string(inverted) +
                     " inverted elements; untangle it first (optimizeMesh)");
}

}  // namespace

InsertReport insertSurface(Mesh& M, const TriangleSurface& S, const InsertOptions& options) {
  checkStart(M, options);
  const Candidate one = candidateOf(S, "");
  checkApart(M, {one});
  return insertCandidate(M, one, options);
}

std::vector<InsertReport> insertSurfaces(Mesh& M, const std::vector<TriangleSurface>& S,
                                         const InsertOptions& options) {
  checkStart(M, options);
  const std::vector<Candidate> all = candidatesOf(S);
  checkApart(M, all);
  Mesh result = M;
  std::vector<InsertReport> reports;
  for (const Candidate& one : all)
    reports.push_back(labelled(one.label, [&] { return insertCandidate(result, one, options); }));
  for (std::size_t i = 0; i < all.size(); ++i)  // later ones have refined and moved earlier ones
    labelled(all[i].label, [&] { measureSurface(result, all[i].S, reports[i]); });
  M = std::move(result);
  return reports;
}

}  // namespace meccano
