// SPDX-License-Identifier: MIT
//
// Algorithm 1 at large (`make stress-solids`): generated solids, those and the terrains of
// ../shared/data, and the layers of §4.3.1, each held against its figures; both distances measured
// here anew. Where that directory is absent its rows are left out: the files are not ours to give.
#include <ctime>
#include <filesystem>
#include <iostream>

#define MECCANO_NO_MAIN
#include "../main.cpp"
#include "../samples/surfaces.hpp"
#include "solids.hpp"
#include "stress_rows.hpp"

namespace {

using namespace meccano;
using app::format, app::readSurfaces, app::readTerrain, app::vtkText, app::writeFiles;
namespace fs = std::filesystem;

constexpr const char* help =
    "usage: stress_solids [TEXT ...] [--data DIR] [--list] [--exact] [--write PREFIX] [--verbose]\n"
    "  TEXT            rows whose name contains one of the texts; default all\n"
    "  --data DIR      default ../shared/data\n"
    "  --list          names the rows, and runs nothing\n"
    "  --exact         TEXT is the whole name\n"
    "  --write PREFIX  writes each mesh to PREFIX<name>.vtk\n"
    "  --verbose       progress on standard error\n"
    "Exit status: 0 all figures met, 1 not, 2 wrong usage.\n";

/// What a row must reach: at least, at least, at most; 0 asks for nothing but a valid mesh.
struct Figures {
  double min = 0, mean = 0, stdDev = 0;
  double seconds = 0;
};

/// The layers of §4.3.1 over a row's terrain.
struct Layers {
  std::vector<double> heights = {};  // in the order of their insertion; empty: none
  int smoothed = 0;                  // times 3 x 3, the heights that are lifted
  std::array<int, 3> cells = {};     // of the terrain, that bisection takes to about 400 m
  double lc = 0;                     // below the layers' distance, on steep ground
};

/// One call of meccanoMesher, insertions, and what must come of it.
struct Row {
  std::string name;
  double part = 0;         // eps, of the diagonal of the box
  TriangleSurface D = {};  // generated, or
  std::string file = {};   // in the data directory; .asc is a terrain
  Meccano C = {};
  Figures figures = {};
  bool fixedBoundary = false;
  double top = 0;  // of a terrain; without a file it is the generated island
  Layers layers = {};
};

void addGenerated(std::vector<Row>& all) {
  constexpr int fine = 40;  // steps; their triangles are far within eps
  using namespace solids;
  all.push_back({"sphere", .005, sphere(fine), "", {}, {.55, .85}});
  all.push_back({"ellipsoid 1:2:4", .005, ellipsoid(fine, {1, 2, 4}), "", {}, {.5, .85}});
  all.push_back({"blob", .005, blob(fine), "", {}, {.42, .85}});
  all.push_back({"L of three cubes",
                 .005,
                 polycube(ell(), 12, warped),
                 "",
                 placed(ell(), warped),
                 {.65, .85}});
  all.push_back({"L of three cubes, rough corners",
                 .005,
                 polycube(ell(), 12, warped),
                 "",
                 placed(ell(), roughly),
                 {.5, .85}});
  all.push_back({"torus", .005, torus(1, .4, fine), "", placed(ring(), aroundTorus), {.55, .85}});
  for (const char* name : {"sphere", "torus"})
    for (std::size_t k = 0, n = all.size(); k < n; ++k)
      if (all[k].name == name) {
        all.push_back(all[k]);
        all.back().name += " fixed", all.back().fixedBoundary = true, all.back().figures = {};
      }
}

void addSolids(std::vector<Row>& all) {
  const std::pair<const char*, double> files[] = {
      {"solid_bunny.obj", .32}, {"solid_spot.obj", .45}, {"solid_goathead.obj", .3},
      {"solid_cat.obj", .3},    {"solid_hand.obj", .25}, {"fandisk.off", .25}};
  for (const auto& [file, min] : files) {
    Row row{file + std::string(" .005"), .005, {}, file, {}, {min, .84}};
    if (row.name == "solid_bunny.obj .005") row.figures.seconds = 15;
    all.push_back(row);
    row.name += " fixed", row.fixedBoundary = true, row.figures = {};
    all.push_back(row);
  }
  all.push_back({"solid_bunny.obj .002", .002, {}, "solid_bunny.obj", {}, {.32, .88}});
  all.push_back({"solid_spot.obj .002", .002, {}, "solid_spot.obj", {}, {.4, .88}});
}

void addTerrains(std::vector<Row>& all) {
  const std::pair<const char*, double> tops[] = {{"", 8000},
                                                 {"dem_gran_canaria_east.asc", 8000},
                                                 {"dem_el_hierro.asc", 8000},
                                                 {"dem_st_helens.asc", 6000}};
  for (const auto& [file, top] : tops) {
    Row row{*file ? file : "island 129", .002, {}, file, {}, {.58, .95}};
    row.top = top;
    all.push_back(row);
  }
  struct Region {
    const char* file;
    Figures figures;
    std::array<int, 3> cells;
    double lc;
  };
  const Region regions[] = {{"dem_gran_canaria_east.asc", {.32, .96, .06}, {8, 10, 3}, 660},
                            {"dem_el_hierro.asc", {.25, .95}, {22, 18, 5}, 650}};
  const std::pair<const char*, std::vector<double>> orders[] = {{"layers", {1000, 2000}},
                                                                {"layers downwards", {2000, 1000}}};
  for (const Region& r : regions)
    for (const auto& [order, heights] : orders)
      for (int smoothed : {0, 2}) {
        Row row{
            r.file + format(" %s smoothed %d", order, smoothed), .002, {}, r.file, {}, r.figures};
        if (smoothed > 0 && r.figures.stdDev > 0) row.figures.min = .42;
        row.top = 8000, row.layers = {heights, smoothed, r.cells, r.lc};
        all.push_back(row);
      }
}

std::vector<Row> rows() {
  std::vector<Row> all;
  addGenerated(all);
  addSolids(all);
  addTerrains(all);
  return all;
}

/// The bilinear ground, each cell cut so often that its triangles miss it by little.
TriangleSurface groundOf(const Terrain& T) {
  constexpr int pieces = 3;
  TriangleSurface S;
  const int nx = pieces * (T.nx - 1), ny = pieces * (T.ny - 1);
  for (int j = 0; j <= ny; ++j)
    for (int i = 0; i <= nx; ++i) {
      const double x = T.origin.x + T.cell * i / pieces, y = T.origin.y + T.cell * j / pieces;
      S.points.push_back({x, y, heightAt(T, x, y)});
      const int k = j * (nx + 1) + i;
      if (i > 0 && j > 0) shapes::addCell(S, true, k - nx - 2, k - nx - 1, k, k - 1);
    }
  return S;
}

/// What is measured of a row's mesh.
struct Measured {
  QualityStatistics q;
  int inverted = 0;
  double toSolid = 0, toMesh = 0;  // of eps
  double seconds = 0;              // of the processor
};

/// Both distances between the boundary, or the bottom of a terrain, and what it is to be.
void measureDistances(const Mesh& M, const TriangleSurface& D, bool terrain, double eps,
                      Measured& m) {
  TriangleSurface own;
  own.points = M.x, own.triangles = terrain ? surfaceFaces(M, -5) : solids::boundaryOf(M);
  m.toSolid = solids::sampledDistance(M.x, own.triangles, D, 6) / eps;
  m.toMesh = solids::sampledDistance(D.points, D.triangles, own, 2) / eps;
}

/// The layers of a row, one call of insertSurface each.
QualityStatistics insertLayers(const Row& row, const Terrain& T, const MesherOptions& mesher,
                               Mesh& M) {
  constexpr double margin = 2600;  // m, from the layers' rims to the sides
  InsertOptions options;
  options.lc = row.layers.lc, options.optimize.threads = 1, options.onProgress = mesher.onProgress;
  QualityStatistics q;
  for (double height : row.layers.heights)
    q = insertSurface(M, samples::layer(samples::smoothed(T, row.layers.smoothed), height, margin),
                      options)
            .smoothed;
  return q;
}

std::string missed(const Figures& figures, const Measured& m) {
  std::string text;
  auto demand = [&](bool holds, const std::string& what) {
    if (!holds) text += (text.empty() ? "" : ", ") + what;
  };
  demand(m.inverted == 0, "inverted");
  demand(m.toSolid <= 1 && m.toMesh <= 1, "distance");
  demand(m.q.min >= figures.min, format("min < %.2f", figures.min));
  demand(m.q.mean >= figures.mean, format("mean < %.2f", figures.mean));
  demand(figures.stdDev == 0 || m.q.stdDev <= figures.stdDev, format("std > %.2f", figures.stdDev));
  demand(figures.seconds == 0 || m.seconds <= figures.seconds,
         format("more than %.0f s", figures.seconds));
  return text;
}

/// The row's mesh, and what is measured of it.
Measured meshOf(Row& row, const stress::Arguments& a, Mesh& M) {
  MesherOptions options;
  options.meccano = row.C, options.fixedBoundary = row.fixedBoundary;
  options.optimize.threads = 1;
  if (a.verbose)
    options.onProgress = [](const std::string& line) { std::cerr << line << std::endl; };
  Terrain T;
  Measured m;
  const std::clock_t start = std::clock();
  if (row.top > 0) {
    T = row.file.empty() ? samples::island(129) : readTerrain(a.data + "/" + row.file);
    T.top = row.top;
    T.cells = row.layers.cells;
    options.eps = row.part / .002 * terrainEps(T);
    m.q = meccanoMesher(M, T, options).smoothed;
    row.D = groundOf(T);
  } else {
    std::vector<std::string> notes;
    if (!row.file.empty()) row.D = readSurfaces(a.data + "/" + row.file, notes).at(0);
    options.eps = row.part * shapes::diagonal(row.D);
    m.q = meccanoMesher(M, row.D, options).smoothed;
  }
  const Mesh before = M;  // an insertion lets the ground's nodes slide without a bound
  if (!row.layers.heights.empty()) m.q = insertLayers(row, T, options, M);
  m.seconds = static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
  m.inverted = shapes::countInverted(M);
  measureDistances(before, row.D, row.top > 0, options.eps, m);
  return m;
}

void writeRow(std::string name, const std::string& prefix, const Mesh& M) {
  for (char& c : name)
    if (std::string("/: ,").find(c) != std::string::npos) c = '_';
  writeFiles({{prefix + name + ".vtk", vtkText(M)}});
}

bool run(Row row, const stress::Arguments& a) {
  std::string text, fault;
  const std::clock_t start = std::clock();
  try {
    Mesh M;
    const Measured m = meshOf(row, a, M);
    fault = missed(row.figures, m);
    text = format("%7d tets, inverted %d, min %.3f mean %.3f std %.3f, of eps %.3f %.3f, %5.1f s",
                  m.q.tetrahedra, m.inverted, m.q.min, m.q.mean, m.q.stdDev, m.toSolid, m.toMesh,
                  m.seconds);
    if (!a.write.empty()) writeRow(row.name, a.write, M);
  } catch (const Error& error) {
    text = std::string("refused: ") + error.what() +
           format(", %5.1f s", static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC);
    fault = "refused";
  }
  std::cout << format("%-46s", row.name.c_str()) << text
            << (fault.empty() ? "  ok" : "  BAD: " + fault) << std::endl;
  return fault.empty();
}

}  // namespace

int main(int argc, char** argv) {
  const stress::Arguments a = stress::parse(argc, argv);
  if (a.usage) {
    std::cerr << help;
    return 2;
  }
  int selected = 0, met = 0;
  for (const Row& row : rows()) {
    if (!stress::isSelected(row.name, false, a)) continue;
    if (a.list) {
      std::cout << row.name << std::endl;
    } else if (!row.file.empty() && !fs::exists(a.data + "/" + row.file)) {
      std::cout << format("%-46s", row.name.c_str()) << "skipped: no " << a.data << std::endl;
    } else {
      ++selected;
      met += run(row, a);
    }
  }
  if (a.list) return 0;
  std::cout << met << " of " << selected << " rows met" << std::endl;
  return met == selected ? 0 : 1;
}
