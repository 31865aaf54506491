// SPDX-License-Identifier: MIT
// Closed surfaces for the tests of Section 2.
#ifndef MECCANO_SOLIDS_HPP
#define MECCANO_SOLIDS_HPP

#include <array>
#include <cmath>
#include <functional>
#include <map>
#include <set>
#include <utility>
#include <vector>

#include "shapes.hpp"

namespace solids {

using meccano::TriangleSurface;
using meccano::Vec3;
using Cube = std::array<int, 3>;

constexpr double pi = 3.14159265358979323846;

/// A sphere of radius 1: an octahedron, each edge divided n times, mapped from the unit sphere.
inline TriangleSurface ball(int n, const std::function<Vec3(Vec3)>& map) {
  TriangleSurface S;
  std::map<std::array<int, 3>, int> number;
  auto point = [&](int i, int j, int k) {
    const auto [it, isNew] = number.insert({{i, j, k}, int(S.points.size())});
    if (isNew) {
      const Vec3 p{double(i), double(j), double(k)};
      S.points.push_back(map((1 / norm(p)) * p));
    }
    return it->second;
  };
  for (int sx : {-1, 1})
    for (int sy : {-1, 1})
      for (int sz : {-1, 1})
        for (int i = 0; i < n; ++i)
          for (int j = 0; i + j < n; ++j) {
            auto at = [&](int a, int b) { return point(sx * a, sy * b, sz * (n - a - b)); };
            const bool out = sx * sy * sz > 0;
            auto add = [&](int a, int b, int c) {
              S.triangles.push_back(out ? std::array<int, 3>{a, b, c}
                                        : std::array<int, 3>{a, c, b});
            };
            add(at(i, j), at(i + 1, j), at(i, j + 1));
            if (i + j + 2 <= n) add(at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
          }
  return S;
}

inline TriangleSurface sphere(int n) {
  return ball(n, [](Vec3 p) { return p; });
}
inline TriangleSurface ellipsoid(int n, Vec3 half) {
  return ball(n, [half](Vec3 p) { return Vec3{half.x * p.x, half.y * p.y, half.z * p.z}; });
}
/// A sphere with smooth bumps and dents.
inline TriangleSurface blob(int n) {
  return ball(n, [](Vec3 p) {
    const double r =
        1 + .25 * std::sin(3 * p.x + 1) * std::cos(4 * p.y) + .15 * std::sin(5 * p.z + 2 * p.x);
    return r * p;
  });
}

/// The boundary of a union of unit cubes, n x n cells for each square, mapped.
inline TriangleSurface polycube(const std::vector<Cube>& cubes, int n,
                                const std::function<Vec3(Vec3)>& map) {
  TriangleSurface S;
  const std::set<Cube> all(cubes.begin(), cubes.end());
  std::map<Cube, int> number;
  auto point = [&](Cube p) {
    const auto [it, isNew] = number.insert({p, int(S.points.size())});
    if (isNew) S.points.push_back(map((1. / n) * Vec3{double(p[0]), double(p[1]), double(p[2])}));
    return it->second;
  };
  for (const Cube& c : all)
    for (int axis = 0; axis < 3; ++axis)
      for (int side = 0; side < 2; ++side) {
        Cube beside = c;
        beside[axis] += side ? 1 : -1;
        if (all.count(beside)) continue;
        for (int i = 0; i < n; ++i)
          for (int j = 0; j < n; ++j) {
            auto at = [&](int a, int b) {
              Cube p{n * c[0], n * c[1], n * c[2]};
              p[axis] += side * n, p[(axis + 1) % 3] += a, p[(axis + 2) % 3] += b;
              return point(p);
            };
            int q[4] = {at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)};
            if (side == 0) std::swap(q[1], q[3]);
            if ((i + 2 * j + axis) % 3 == 0) {
              S.triangles.push_back({q[0], q[1], q[3]});
              S.triangles.push_back({q[1], q[2], q[3]});
            } else {
              S.triangles.push_back({q[0], q[1], q[2]});
              S.triangles.push_back({q[0], q[2], q[3]});
            }
          }
      }
  return S;
}

inline std::vector<Cube> box(int nx, int ny, int nz) {
  std::vector<Cube> cubes;
  for (int k = 0; k < nz; ++k)
    for (int j = 0; j < ny; ++j)
      for (int i = 0; i < nx; ++i) cubes.push_back({i, j, k});
  return cubes;
}
inline std::vector<Cube> without(std::vector<Cube> cubes, const std::vector<Cube>& holes) {
  std::vector<Cube> left;
  for (const Cube& c : cubes) {
    bool isHole = false;
    for (const Cube& h : holes) isHole |= c == h;
    if (!isHole) left.push_back(c);
  }
  return left;
}
inline std::vector<Cube> ell() { return {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}}; }
inline std::vector<Cube> ring() { return without(box(3, 3, 1), {{1, 1, 0}}); }
inline std::vector<Cube> twoHandles() { return without(box(5, 3, 1), {{1, 1, 0}, {3, 1, 0}}); }

/// A torus about the z axis, n steps around the tube, a ring of eight cubes' turn.
inline TriangleSurface torus(double R, double r, int n) {
  TriangleSurface S;
  const int m = int(std::lround(n * R / r));
  for (int i = 0; i < m; ++i)
    for (int j = 0; j < n; ++j) {
      const double a = 2 * pi * (i + .3) / m, b = 2 * pi * (j + .4) / n;
      const double d = R + r * std::cos(b);
      S.points.push_back({d * std::cos(a), d * std::sin(a), r * std::sin(b)});
    }
  auto at = [&](int i, int j) { return i % m * n + j % n; };
  for (int i = 0; i < m; ++i)
    for (int j = 0; j < n; ++j) {
      S.triangles.push_back({at(i, j), at(i + 1, j), at(i + 1, j + 1)});
      S.triangles.push_back({at(i, j), at(i + 1, j + 1), at(i, j + 1)});
    }
  return S;
}

/// A meccano of these cubes whose corners (three or more edges of the polycube meet) are placed by
/// a map of the lattice.
inline meccano::Meccano placed(const std::vector<Cube>& cubes,
                               const std::function<Vec3(Vec3)>& map) {
  meccano::Meccano C;
  C.cubes = cubes;
  std::map<Cube, int> around;  // bit x + 2 y + 4 z for the cube on the sides x, y, z
  for (const Cube& c : cubes)
    for (int i = 0; i < 8; ++i)
      around[{c[0] + (i & 1), c[1] + (i >> 1 & 1), c[2] + (i >> 2)}] |= 1 << (7 - i);
  for (const auto& [p, bits] : around) {
    int bends = 0;  // directions along which the pattern of cubes changes, for a corner all three
    for (int axis = 0; axis < 3; ++axis) {
      bool changes = false;
      for (int i = 0; i < 8; ++i) changes |= (bits >> i & 1) != (bits >> (i ^ 1 << axis) & 1);
      bends += changes;
    }
    if (bends == 3) C.corners.push_back({p, map({double(p[0]), double(p[1]), double(p[2])})});
  }
  return C;
}

/// A smooth map without symmetry that leaves a polycube's shape recognizable.
inline Vec3 warped(Vec3 p) {
  return {p.x + .15 * std::sin(2 * p.y + 1), p.y + .12 * std::sin(1.7 * p.x),
          p.z * (1 + .2 * std::cos(p.x + p.y))};
}
/// Places of its corners that miss them.
inline Vec3 roughly(Vec3 p) { return warped(p) + Vec3{.13, -.1, .12}; }
/// From the lattice of ring() to a torus of radius 1 with a tube of .4.
inline Vec3 aroundTorus(Vec3 p) { return {.9 * (p.x - 1.5), .9 * (p.y - 1.5), .8 * (p.z - .5)}; }

/// The boundary faces of a mesh.
inline std::vector<std::array<int, 3>> boundaryOf(const meccano::Mesh& M) {
  std::vector<std::array<int, 3>> all;
  for (std::size_t p = 1; p <= M.patches.size(); ++p)
    for (const auto& face : meccano::surfaceFaces(M, -static_cast<int>(p))) all.push_back(face);
  return all;
}

/// The largest distance of points sampled on the triangles from the surface: the nearest by a tree
/// of the library, measured again by the tests' own distance.
inline double sampledDistance(const std::vector<Vec3>& x,
                              const std::vector<std::array<int, 3>>& faces,
                              const TriangleSurface& S, int steps) {
  const meccano::TriangleTree tree(S.points, S.triangles);
  double most = 0;
  for (const auto& f : faces)
    for (int a = 0; a <= steps; ++a)
      for (int b = 0; a + b <= steps; ++b) {
        const double s = double(a) / steps, t = double(b) / steps;
        const Vec3 p = s * x[f[0]] + t * x[f[1]] + (1 - s - t) * x[f[2]];
        const std::array<int, 3> v = S.triangles[tree.closest(p).triangle];
        most = std::max(
            most, shapes::distanceToTriangle(p, S.points[v[0]], S.points[v[1]], S.points[v[2]]));
      }
  return most;
}

}  // namespace solids
#endif
