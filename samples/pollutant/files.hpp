// SPDX-License-Identifier: MIT
//
// What samples/pollutant reads and writes: meshes, terrains and layers in; .vtk, SVG and the rows
// of the table out; the words of the command line. Nothing here knows of the physics.
#ifndef POLLUTANT_FILES_HPP
#define POLLUTANT_FILES_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <limits>
#include <map>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "../../meccano.hpp"

namespace pollutant {

using meccano::InputError;
using meccano::Vec2;
using meccano::Vec3;
using Triangle = std::array<int, 3>;
using Field = std::vector<double>;  // a number per node

constexpr double noValue = std::numeric_limits<double>::quiet_NaN();
constexpr int terrainLabel = -5, topLabel = -6;  // patches z- and z+ of a box; -1 .. -4 its sides

/// printf into a string.
template <class... Values>
inline std::string format(const char* pattern, Values... values) {
  char text[512];
  const int n = std::snprintf(text, sizeof text, pattern, values...);
  return std::string(text, std::clamp(n, 0, static_cast<int>(sizeof text) - 1));
}

/// A mesh as the physics needs it.
struct Nodes {
  std::vector<Vec3> x;  // m
  std::vector<std::array<int, 4>> tets;
  std::map<int, std::vector<Triangle>>
      faces;  // by label: k > 0 inserted layer, -p boundary patch p
};

/// The concentration at a moment.
struct Moment {
  double time;  // s
  Field c;      // [nodes], g/m^3
};

// ==== In ========================================================================================

inline std::string readText(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  std::ostringstream text;
  if (in) text << in.rdbuf();
  if (!text || text.str().empty()) throw InputError(path + ": cannot be read, or is empty");
  return text.str();
}

/// An ESRI ASCII grid: rows from north to south; corners or centres of cells in the head.
inline meccano::Terrain readAsc(const std::string& path) {
  std::istringstream in(readText(path));
  std::map<std::string, double> head;
  std::string word;
  while (in >> std::ws && std::isalpha(in.peek()) && in >> word) {
    std::transform(word.begin(), word.end(), word.begin(),
                   [](unsigned char c) { return std::tolower(c); });
    in >> head[word];
  }
  meccano::Terrain T;
  T.nx = static_cast<int>(head["ncols"]), T.ny = static_cast<int>(head["nrows"]);
  T.cell = head["cellsize"];
  T.origin.x = head.count("xllcenter") ? head["xllcenter"] : head["xllcorner"] + T.cell / 2;
  T.origin.y = head.count("yllcenter") ? head["yllcenter"] : head["yllcorner"] + T.cell / 2;
  std::map<int, std::vector<double>> rows;
  for (int j = T.ny - 1; j >= 0; --j)
    for (int i = 0; i < T.nx; ++i) {
      double z = noValue;
      if (!(in >> z) || (head.count("nodata_value") && z == head["nodata_value"]))
        throw InputError(path + format(": no height in column %d of row %d", i + 1, T.ny - j));
      rows[j].push_back(z);
    }
  for (const auto& [j, row] : rows) T.z.insert(T.z.end(), row.begin(), row.end());
  return T;
}

/// The vertices and triangles of a Wavefront OBJ.
inline meccano::TriangleSurface readObj(const std::string& path) {
  meccano::TriangleSurface S;
  std::istringstream in(readText(path));
  for (std::string line, word; std::getline(in, line);) {
    std::istringstream words(line);
    words >> word;
    if (line.rfind("v ", 0) == 0) {
      Vec3 p;
      if (!(words >> p.x >> p.y >> p.z))
        throw InputError(path + ": a vertex is no vertex: " + line);
      S.points.push_back(p);
    } else if (line.rfind("f ", 0) == 0) {
      Triangle t;
      for (int& n : t) {
        if (!(words >> word)) throw InputError(path + ": a face is no triangle: " + line);
        n = std::atoi(word.c_str());  // up to the first /; relative where negative
        n += n < 0 ? static_cast<int>(S.points.size()) : -1;
      }
      S.triangles.push_back(t);
    }
  }
  return S;
}

/// A meccano .vtk: points, tetrahedra (type 10), triangles (type 5) with their cell data `surface`.
inline Nodes readVtk(const std::string& name) {
  std::istringstream in(readText(name));
  Nodes G;
  std::vector<std::vector<int>> cells;
  std::string word;
  auto read = [&](auto& value) {
    if (!(in >> value)) throw InputError(name + ": truncated, or not a meccano .vtk in ASCII");
    return value;
  };
  auto corner = [&](int& n) {
    if (read(n) < 0 || n >= static_cast<int>(G.x.size()))
      throw InputError(name + ": node " + std::to_string(n) + " of a cell does not exist");
  };
  for (int count = 0, size = 0; in >> word;) {
    if (word == "POINTS") {
      read(count), read(word);
      for (int n = 0; n < count; ++n) {
        Vec3 p;
        read(p.x), read(p.y), read(p.z);
        G.x.push_back(p);
      }
    } else if (word == "CELLS") {
      read(count), read(size);
      for (int i = 0; i < count; ++i) {
        cells.push_back(std::vector<int>(std::clamp(read(size), 0, 8)));
        for (int& n : cells.back()) corner(n);
      }
    } else if (word == "surface" && !cells.empty()) {
      for (int i = 0; i < 3; ++i) read(word);  // int LOOKUP_TABLE default, perhaps with a 1
      if (word == "LOOKUP_TABLE") read(word);
      for (const std::vector<int>& z : cells) {
        const int label = read(size);
        if (z.size() == 4) G.tets.push_back({z[0], z[1], z[2], z[3]});
        if (z.size() == 3) G.faces[label].push_back({z[0], z[1], z[2]});
      }
      return G;
    }
  }
  throw InputError(name + ": no cell data `surface`: this is not a meccano .vtk");
}

// ==== Meshes and their layers ====================================================================

inline Nodes nodesOf(const meccano::Mesh& M) {
  Nodes G{M.x, M.tets, {}};
  for (const std::array<int, 4>& labels : M.faceLabel)
    for (int k : labels)
      if (k != 0 && G.faces.count(k) == 0) G.faces[k] = meccano::surfaceFaces(M, k);
  return G;
}

/// Heights above the terrain: of its triangles the one below; beside the terrain its nearest point.
inline Field heightsAbove(const std::vector<Vec3>& x, const std::vector<Triangle>& terrain) {
  constexpr double slack = 1e-9, reach = 1e300;  // barycentric; the column above and below a node
  const meccano::TriangleTree tree(x, terrain);
  Field height(x.size());
  for (std::size_t n = 0; n < x.size(); ++n) {
    const Vec3 p = x[n];
    double ground = noValue;
    tree.visit({p.x, p.y, -reach}, {p.x, p.y, reach}, [&](int t) {
      const Vec3 a = x[terrain[t][0]], b = x[terrain[t][1]] - a, c = x[terrain[t][2]] - a;
      const Vec2 d{p.x - a.x, p.y - a.y};
      const double area = cross(Vec2{b.x, b.y}, Vec2{c.x, c.y});
      const double v = cross(d, Vec2{c.x, c.y}) / area, w = cross(Vec2{b.x, b.y}, d) / area;
      if (!(v >= -slack && w >= -slack && v + w <= 1 + slack)) return false;
      ground = a.z + v * b.z + w * c.z;
      return true;
    });
    height[n] = p.z - (std::isnan(ground) ? tree.closest(p).point.z : ground);
    height[n] = std::max(height[n], 0.);
  }
  for (const Triangle& t : terrain)
    for (int n : t) height[n] = 0;
  return height;
}

// ==== Out =======================================================================================

struct Output {
  std::string path, text;
};

/// Makes the folder and tries a file in it, before the long computation.
inline std::string checkFolder(const std::string& folder) {
  std::error_code error;
  std::filesystem::create_directories(folder, error);
  const std::string probe = folder + "/.pollutant.tmp";
  const bool works = !error && std::ofstream(probe).put(' ').flush();
  std::filesystem::remove(probe, error);
  if (!works)
    throw InputError(folder + ": no file can be written there; choose another folder with -o");
  return folder;
}

/// Writes all or none: each beside its target first, renamed when every one is complete.
inline void writeFiles(const std::vector<Output>& outputs) {
  std::error_code none;
  auto remove = [&] {
    for (const Output& o : outputs) std::filesystem::remove(o.path + ".tmp", none);
  };
  for (const Output& o : outputs) {
    std::ofstream file(o.path + ".tmp", std::ios::binary);
    file << o.text << std::flush;
    if (file) continue;
    remove();
    throw InputError(o.path + ": cannot be written; choose another folder with -o");
  }
  for (const Output& o : outputs) std::filesystem::rename(o.path + ".tmp", o.path, none);
}

inline std::string vtkHead(const std::string& title, const std::vector<Vec3>& x) {
  std::string out = "# vtk DataFile Version 3.0\n" + title + "\nASCII\nDATASET UNSTRUCTURED_GRID\n";
  out += format("POINTS %d double\n", static_cast<int>(x.size()));
  for (Vec3 p : x) out += format("%.10g %.10g %.10g\n", p.x, p.y, p.z);
  return out;
}

inline std::string vtkScalars(const std::string& name, const Field& c) {
  std::string out = "SCALARS " + name + " double\nLOOKUP_TABLE default\n";
  for (double value : c) out += format("%.6g\n", value);
  return out;
}

/// The whole mesh with concentration and wind, and its labelled faces as in the meccano .vtk.
inline std::string volumeVtk(const Nodes& D, const std::vector<Vec3>& wind, const Moment& at) {
  std::string out = vtkHead(format("pollutant after %g s", at.time), D.x), types, labels;
  int cells = static_cast<int>(D.tets.size()), size = 5 * cells;
  for (const auto& [label, list] : D.faces)
    cells += static_cast<int>(list.size()), size += 4 * static_cast<int>(list.size());
  out += format("CELLS %d %d\n", cells, size);
  for (const std::array<int, 4>& z : D.tets) {
    out += format("4 %d %d %d %d\n", z[0], z[1], z[2], z[3]);
    types += "10\n", labels += "0\n";
  }
  for (const auto& [label, list] : D.faces)
    for (const Triangle& t : list) {
      out += format("3 %d %d %d\n", t[0], t[1], t[2]);
      types += "5\n", labels += format("%d\n", label);
    }
  out += format("CELL_TYPES %d\n", cells) + types;
  out += format("CELL_DATA %d\nSCALARS surface int\nLOOKUP_TABLE default\n", cells) + labels;
  out += format("POINT_DATA %d\n", static_cast<int>(D.x.size()));
  out += vtkScalars("concentration", at.c) + "VECTORS wind double\n";
  for (Vec3 u : wind) out += format("%.6g %.6g %.6g\n", u.x, u.y, u.z);
  return out;
}

/// Figure 17: a layer with the concentration of each moment.
inline std::string layerVtk(const Nodes& D, int layer, const std::vector<Moment>& moments) {
  std::map<int, int> number;
  std::vector<int> nodes;
  std::string cells, types;
  for (const Triangle& t : D.faces.at(layer)) {
    for (int n : t)
      if (number.insert({n, static_cast<int>(nodes.size())}).second) nodes.push_back(n);
    cells += format("3 %d %d %d\n", number[t[0]], number[t[1]], number[t[2]]), types += "5\n";
  }
  std::vector<Vec3> x;
  for (int n : nodes) x.push_back(D.x[n]);
  const int count = static_cast<int>(D.faces.at(layer).size());
  std::string out = vtkHead(format("pollutant on layer %d", layer), x);
  out += format("CELLS %d %d\n", count, 4 * count) + cells;
  out += format("CELL_TYPES %d\n", count) + types;
  out += format("POINT_DATA %d\n", static_cast<int>(x.size()));
  for (const Moment& at : moments) {
    Field c;
    for (int n : nodes) c.push_back(at.c[n]);
    out += vtkScalars(format("concentration_%gs", at.time), c);
  }
  return out;
}

// ---- Pictures: triangles with a value at each corner, sampled on a grid, drawn as level sets ----

using Flat = std::vector<std::array<Vec3, 3>>;  // x, y in the picture plane, z the value
struct Box {
  double x0, x1, y0, y1;
};
struct Samples {
  int nx, ny;
  Field v;  // [nx * ny], NaN where there is no triangle
};

inline Samples sample(const Flat& triangles, Box b, int nx, int ny) {
  constexpr double slack = 1e-6;  // barycentric: no gaps between the triangles
  Samples S{nx, ny, Field(nx * ny, noValue)};
  const double dx = (b.x1 - b.x0) / (nx - 1), dy = (b.y1 - b.y0) / (ny - 1);
  for (const auto& [p, q, r] : triangles) {
    const auto [xlo, xhi] = std::minmax({p.x, q.x, r.x});
    const auto [ylo, yhi] = std::minmax({p.y, q.y, r.y});
    const double area = (q.x - p.x) * (r.y - p.y) - (q.y - p.y) * (r.x - p.x);
    const int i0 = std::max(0, static_cast<int>((xlo - b.x0) / dx - slack));
    const int i1 = std::min(nx - 1, static_cast<int>((xhi - b.x0) / dx + slack));
    const int j0 = std::max(0, static_cast<int>((ylo - b.y0) / dy - slack));
    const int j1 = std::min(ny - 1, static_cast<int>((yhi - b.y0) / dy + slack));
    for (int j = j0; j <= j1; ++j)
      for (int i = i0; i <= i1; ++i) {
        const double x = b.x0 + i * dx - p.x, y = b.y0 + j * dy - p.y;
        const double s = (x * (r.y - p.y) - y * (r.x - p.x)) / area;
        const double t = ((q.x - p.x) * y - (q.y - p.y) * x) / area;
        if (s >= -slack && t >= -slack && s + t <= 1 + slack)
          S.v[j * nx + i] = p.z + s * (q.z - p.z) + t * (r.z - p.z);
      }
  }
  return S;
}

/// {v >= level} as closed loops of an SVG path in grid units, by marching squares: each side of a
/// cell that the level crosses is left by one segment, with the set on the left.
inline std::string levelSet(const Samples& S, double level) {
  const int nx = S.nx + 2, ny = S.ny + 2;  // a border outside closes the loops
  auto at = [&](int i, int j) {
    const bool in = i > 0 && j > 0 && i <= S.nx && j <= S.ny;
    return in ? S.v[(j - 1) * S.nx + i - 1] : noValue;
  };
  auto crossing = [&](int side) {  // 2 n: from grid point n to the right, 2 n + 1: upwards
    const int i = side / 2 % nx, j = side / 2 / nx, right = side % 2 == 0, up = 1 - right;
    const double a = at(i, j), b = at(i + right, j + up);
    const double t = std::isnan(a) ? 1 : std::isnan(b) ? 0 : (level - a) / (b - a);
    return Vec2{i - 1 + right * t, S.ny - (j + up * t)};
  };
  std::vector<int> next(2 * nx * ny, -1);
  for (int j = 0; j + 1 < ny; ++j)
    for (int i = 0; i + 1 < nx; ++i) {
      const int n = j * nx + i, side[4] = {2 * n, 2 * (n + 1) + 1, 2 * (n + nx), 2 * n + 1};
      const bool in[4] = {at(i, j) >= level, at(i + 1, j) >= level, at(i + 1, j + 1) >= level,
                          at(i, j + 1) >= level};
      for (int k = 0; k < 4; ++k) {  // from where the border leaves the set to where it comes back
        if (!in[k] || in[(k + 1) % 4]) continue;
        int m = (k + 1) % 4;
        while (!(!in[m] && in[(m + 1) % 4])) m = (m + 1) % 4;
        next[side[m]] = side[k];
      }
    }
  std::string path;
  for (std::size_t first = 0; first < next.size(); ++first) {
    if (next[first] < 0) continue;
    char command = 'M';
    for (int side = static_cast<int>(first); next[side] >= 0; command = 'L') {
      const Vec2 p = crossing(side);
      path += format("%c%.4g %.4g", command, p.x, p.y);
      side = std::exchange(next[side], -1);
    }
    path += "Z";
  }
  return path;
}

inline constexpr std::array<double, 6> levels{.02, .1,  .25,
                                              .5,  .75, .95};  // parts of the source's c
inline constexpr std::array<const char*, 6> colours{"#fee8a8", "#fdbb5b", "#f58634",
                                                    "#dc3c27", "#a50f3c", "#5a0b4d"};

/// A cut by the vertical plane through `origin` along `along`: x along it, y height, z value.
inline Flat cut(const Nodes& D, Vec2 origin, Vec2 along, const Field& c) {
  Flat triangles;
  auto distance = [&](int n) { return cross(along, Vec2{D.x[n].x, D.x[n].y} - origin); };
  auto meet = [&](int a, int b) {  // the plane crosses the edge from below it (a) to above (b)
    const double t = distance(a) / (distance(a) - distance(b));
    const Vec3 p = D.x[a] + t * (D.x[b] - D.x[a]);
    return Vec3{dot(along, Vec2{p.x, p.y} - origin), p.z, c[a] + t * (c[b] - c[a])};
  };
  for (const std::array<int, 4>& z : D.tets) {
    std::vector<int> below, above;
    for (int n : z) (distance(n) < 0 ? below : above).push_back(n);
    std::vector<Vec3> p;
    for (int a : below)
      for (int b : above) p.push_back(meet(a, b));
    if (p.size() >= 3) triangles.push_back({p[0], p[1], p[2]});
    if (p.size() == 4) triangles.push_back({p[1], p[2], p[3]});
  }
  return triangles;
}

/// The areas of a soup's level sets, one above the other, with their outlines as isolines.
inline std::string plume(const Samples& S, double concentration) {
  std::string out;
  for (std::size_t k = 0; k < levels.size(); ++k)
    out += format("<path fill=\"%s\" d=\"", colours[k]) + levelSet(S, levels[k] * concentration) +
           "\"/>\n";
  return out;
}

inline std::string svgHead(double width, double height) {
  return format(
      "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%g\" height=\"%g\" "
      "font-family=\"sans-serif\" font-size=\"13\" fill=\"#222\">\n"
      "<rect width=\"100%%\" height=\"100%%\" fill=\"#fff\"/>\n",
      width, height);
}

/// The colours with the concentrations from which they hold, and a bar of `km` kilometres.
inline std::string legend(double x, double y, double concentration, double pixelsPerMetre) {
  std::string out;
  for (std::size_t k = 0; k < levels.size(); ++k)
    out += format(
        "<rect x=\"%g\" y=\"%g\" width=\"70\" height=\"12\" fill=\"%s\"/>"
        "<text x=\"%g\" y=\"%g\">%.3g</text>\n",
        x + 70. * static_cast<double>(k), y, colours[k], x + 70. * static_cast<double>(k), y + 27,
        levels[k] * concentration);
  out += format("<text x=\"%g\" y=\"%g\">g/m³ and above</text>\n", x + 428, y + 11);
  return out + format(
                   "<path d=\"M%g %gh%g\" stroke=\"#222\" stroke-width=\"3\"/>"
                   "<text x=\"%g\" y=\"%g\">5 km</text>\n",
                   x + 600, y + 6, 5000 * pixelsPerMetre, x + 606 + 5000 * pixelsPerMetre, y + 11);
}

/// The vertical slice through the source along the wind, a panel per moment.
inline std::string sliceSvg(const Nodes& D, Vec2 origin, Vec2 along,
                            const std::vector<Moment>& moments, double concentration) {
  constexpr int nx = 215, ny = 56, pixels = 4, pitch = 264, left = 20, top = 30;
  Box box{1e300, -1e300, 1e300, -1e300};
  for (Vec3 p : D.x) {
    const double at = dot(along, Vec2{p.x, p.y} - origin);
    box.x0 = std::min(box.x0, at), box.x1 = std::max(box.x1, at), box.y0 = std::min(box.y0, p.z);
  }
  for (const Triangle& t : D.faces.rbegin()->second)
    for (int n : t) box.y1 = std::max(box.y1, D.x[n].z + 500);
  const double sx = (nx - 1) / (box.x1 - box.x0), sy = (ny - 1) / (box.y1 - box.y0);
  auto line = [&](const std::vector<Triangle>& faces) {  // where the plane cuts a surface
    std::vector<std::pair<double, double>> points;
    auto distance = [&](int n) { return cross(along, Vec2{D.x[n].x, D.x[n].y} - origin); };
    for (const Triangle& t : faces)
      for (int i = 0; i < 3; ++i) {
        const int a = t[i], b = t[(i + 1) % 3];
        if ((distance(a) < 0) == (distance(b) < 0)) continue;
        const Vec3 p = D.x[a] + distance(a) / (distance(a) - distance(b)) * (D.x[b] - D.x[a]);
        points.push_back({dot(along, Vec2{p.x, p.y} - origin), p.z});
      }
    std::sort(points.begin(), points.end());
    std::string path;
    for (const auto& [x, z] : points)
      path += format("%c%.4g %.4g", path.empty() ? 'M' : 'L', (x - box.x0) * sx, (box.y1 - z) * sy);
    return path;
  };
  std::string frame = "<g id=\"frame\" fill=\"none\" stroke-width=\".3\">";
  for (const auto& [label, faces] : D.faces)
    if (label > 0) frame += "<path stroke=\"#1d4f91\" d=\"" + line(faces) + "\"/>";
  frame += "<path fill=\"#8d7d6b\" stroke=\"#4c4034\" d=\"" + line(D.faces.at(terrainLabel)) +
           format("L%d %dL0 %dZ\"/></g>\n", nx - 1, ny, ny);
  std::string out = svgHead(900, top + pitch * static_cast<double>(moments.size()) + 50);
  out += "<defs>" + frame + "</defs>\n";
  for (std::size_t i = 0; i < moments.size(); ++i) {
    const double y = top + pitch * static_cast<double>(i);
    Samples S = sample(cut(D, origin, along, moments[i].c), box, nx, ny);
    for (int j = ny - 2; j >= 0; --j)  // on below the terrain, which is drawn above it
      for (int k = 0; k < nx; ++k)
        if (std::isnan(S.v[j * nx + k])) S.v[j * nx + k] = S.v[(j + 1) * nx + k];
    out += format("<text x=\"%d\" y=\"%g\"><tspan font-weight=\"bold\">%g min</tspan>%s</text>\n",
                  left, y - 8, moments[i].time / 60,
                  i > 0 ? ""
                        : format("   wind \xe2\x86\x92   slice through the source, "
                                 "inserted layers in blue, heights \xc3\x97 %.1f",
                                 sy / sx)
                              .c_str());
    out += format(
               "<g transform=\"translate(%d %g) scale(%d)\" stroke=\"#000\" stroke-width=\".12\" "
               "stroke-opacity=\".6\"><rect width=\"%d\" height=\"%d\" fill=\"#e4eef5\"/>\n",
               left, y, pixels, nx - 1, ny - 1) +
           plume(S, concentration) + "<use href=\"#frame\" stroke-opacity=\"1\"/></g>\n";
  }
  return out +
         legend(left, top + pitch * static_cast<double>(moments.size()), concentration,
                sx * pixels) +
         "</svg>\n";
}

/// A layer seen from above, a panel per moment, over the terrain's contours.
inline std::string layerSvg(const Nodes& D, int layer, const std::vector<Moment>& moments,
                            double concentration) {
  constexpr int nx = 140, pixels = 2, pitch = 292, left = 14, top = 34;
  Box box{1e300, -1e300, 1e300, -1e300};
  Flat terrain;
  for (const Triangle& t : D.faces.at(terrainLabel)) {
    terrain.push_back({D.x[t[0]], D.x[t[1]], D.x[t[2]]});
    for (Vec3 p : terrain.back()) {
      box.x0 = std::min(box.x0, p.x), box.x1 = std::max(box.x1, p.x);
      box.y0 = std::min(box.y0, p.y), box.y1 = std::max(box.y1, p.y);
    }
  }
  const double scale = (nx - 1) / (box.x1 - box.x0);
  const int ny = 1 + static_cast<int>((box.y1 - box.y0) * scale + .5);
  const double height = pixels * ny + 10.;
  const Samples ground = sample(terrain, box, nx, ny);
  std::string contours = "<g id=\"contours\" fill=\"none\" stroke=\"#333\" stroke-width=\".25\">";
  for (double z : {50., 500., 1000., 1500.})
    contours += format("<path stroke-opacity=\"%g\" d=\"", z < 100 ? 1 : .45) +
                levelSet(ground, z) + "\"/>";
  const double width = std::max(900., 2. * left + pitch * static_cast<double>(moments.size()));
  std::string out = svgHead(width, top + height + 50) + "<defs>" + contours + "</g></defs>\n";
  for (std::size_t i = 0; i < moments.size(); ++i) {
    Flat flat;
    for (const Triangle& t : D.faces.at(layer)) {
      flat.push_back({D.x[t[0]], D.x[t[1]], D.x[t[2]]});
      for (int k = 0; k < 3; ++k) flat.back()[k].z = moments[i].c[t[k]];
    }
    const Samples S = sample(flat, box, nx, ny);
    const double x = left + pitch * static_cast<double>(i);
    out += format(
        "<text x=\"%g\" y=\"%d\"><tspan font-weight=\"bold\">layer %d, %g min</tspan></text>\n", x,
        top - 10, layer, moments[i].time / 60);
    out += format(
        "<g transform=\"translate(%g %d) scale(%d)\" stroke=\"#000\" stroke-width=\".2\" "
        "stroke-opacity=\".6\"><rect width=\"%d\" height=\"%d\" fill=\"#f4f4f2\" "
        "stroke=\"none\"/>\n",
        x, top, pixels, nx - 1, ny - 1);
    out += "<path fill=\"#e4eef5\" d=\"" + levelSet(S, -1e300) + "\"/>\n" +
           plume(S, concentration) + "<use href=\"#contours\"/></g>\n";
  }
  return out + legend(left, top + height, concentration, scale * pixels) + "</svg>\n";
}

/// Part of a triangle where a linear function with these corner values is at least the level.
inline double partAbove(std::array<double, 3> v, double level) {
  std::sort(v.begin(), v.end());
  if (level <= v[0]) return 1;
  if (level >= v[2]) return 0;
  const double low = level - v[0], high = v[2] - level, all = v[2] - v[0];
  return level <= v[1] ? 1 - low * low / (all * (v[1] - v[0]))
                       : high * high / (all * (v[2] - v[1]));
}

inline double areaOf(const Nodes& D, const Triangle& t) {
  return norm(cross(D.x[t[1]] - D.x[t[0]], D.x[t[2]] - D.x[t[0]])) / 2;
}

/// A line of the table: mean, maximum, the area with a tenth of the source's concentration or more,
/// and how far along the wind half of it has come on the layer.
inline std::string layerRow(const Nodes& D, int layer, const Moment& at, Vec3 along,
                            double concentration) {
  double mean = 0, most = 0, covered = 0, area = 0, from = 1e300, to = -1e300, front = -1e300;
  for (const Triangle& t : D.faces.at(layer)) {
    const double size = areaOf(D, t);
    const std::array<double, 3> v{at.c[t[0]], at.c[t[1]], at.c[t[2]]};
    mean += size * (v[0] + v[1] + v[2]) / 3, area += size;
    covered += size * partAbove(v, concentration / 10);
    for (int i = 0; i < 3; ++i) {
      const double place = dot(along, D.x[t[i]]);
      from = std::min(from, place), to = std::max(to, place), most = std::max(most, v[i]);
      if (v[i] >= concentration / 2) front = std::max(front, place);
    }
  }
  const std::string way =
      front > from ? format("%.0f %%", 100 * (front - from) / (to - from)) : "-";
  return format("%5d %8.4g %12.4g %12.4g %12.1f %8.1f %% %8s\n", layer, at.time / 60, mean / area,
                most, covered / 1e6, 100 * covered / area, way.c_str());
}

// ==== Command line ==============================================================================

struct UsageError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

/// An option that takes numbers: its place in --help, which numbers are allowed, where they go.
struct Option {
  enum Range { any, from0, above0 };
  std::string name, values, help;
  Range range;
  double* to;
  int count = 1;
};

struct Words {
  std::vector<std::string> operands;
  std::string folder = "build/pollutant";
  bool help = false, quiet = false, noLimit = false;
};

inline void parseNumber(const Option& option, const std::string& word, double& to) {
  char* end = nullptr;
  to = std::strtod(word.c_str(), &end);
  if (word.empty() || *end != 0 || !std::isfinite(to))
    throw UsageError(option.name + ": '" + word + "' is no number");
  if (option.range == Option::above0 ? !(to > 0) : option.range == Option::from0 && to < 0)
    throw InputError(option.name + " is " + word + ", and must " +
                     (to < 0 && option.range == Option::from0 ? "not be negative" : "be above 0"));
}

inline Words parseWords(const std::vector<std::string>& arguments,
                        const std::vector<Option>& options) {
  Words words;
  for (std::size_t i = 0; i < arguments.size(); ++i) {
    const std::string& word = arguments[i];
    auto next = [&]() -> const std::string& {
      if (++i == arguments.size()) throw UsageError(word + " lacks a value");
      return arguments[i];
    };
    const auto option = std::find_if(options.begin(), options.end(),
                                     [&](const Option& o) { return o.name == word; });
    if (option != options.end())
      for (int k = 0; k < option->count; ++k) parseNumber(*option, next(), option->to[k]);
    else if (word == "-o")
      words.folder = next();
    else if (word == "--no-limit")
      words.noLimit = true;
    else if (word == "--help" || word == "-h")
      words.help = true;
    else if (word == "--quiet")
      words.quiet = true;
    else if (word.rfind("-", 0) == 0)
      throw UsageError(word + " is no option");
    else
      words.operands.push_back(word);
  }
  return words;
}

inline std::string helpText(std::string text, const std::vector<Option>& options) {
  for (const Option& o : options)
    text += format("  %-29s %s\n", (o.name + " " + o.values).c_str(), o.help.c_str());
  return text + "\nExit status: 0 done, 1 an error and no file written, 2 wrong usage.\n";
}

}  // namespace pollutant
#endif
