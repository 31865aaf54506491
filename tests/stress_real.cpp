// SPDX-License-Identifier: MIT
//
// Real surfaces (`make stress-real`): the fault sets, single faults and scans of ../shared/data,
// each row inserted by the library and held against its figures. Where that directory is absent it
// says so and passes: the files are not ours to give.
#include <ctime>
#include <filesystem>
#include <iostream>

#define MECCANO_NO_MAIN
#include "../main.cpp"
#include "shapes.hpp"
#include "stress_rows.hpp"

namespace {

using namespace meccano;
using app::format, app::readSurfaces, app::vtkText, app::writeFiles;
namespace fs = std::filesystem;

constexpr const char* help =
    "usage: stress_real [TEXT ...] [--data DIR] [--list] [--exact] [--write PREFIX] [--verbose]\n"
    "  TEXT            rows whose name contains one of the texts; default all that are not slow\n"
    "  --data DIR      default ../shared/data\n"
    "  --list          names the rows, and runs nothing\n"
    "  --exact         TEXT is the whole name\n"
    "  --write PREFIX  writes each mesh to PREFIX<name>.vtk\n"
    "  --verbose       progress on standard error\n"
    "Exit status: 0 all figures met, 1 not, 2 wrong usage.\n";

/// One call, which inserts the largest first; or a call for each surface, in this order.
enum class Order { together, asListed, reversed };

/// What a row must reach; 0 asks for nothing but a valid mesh.
struct Figures {
  double min = 0, mean = 0;
  double hausdorff = 0;  // at most, of the row's l_c
  double shift = 0;      // tangential, at most, of h
};

/// An insertion: data, box, options and what must come of it.
struct Row {
  std::string name;
  std::vector<std::string> files;  // in the data directory; a directory stands for all its .obj
  double lc = 0;                   // InsertOptions::lc
  double lcOfDiagonal = 0;         // or this part of the diagonal of the surfaces' box
  double marginOfLc = 2;           // the domain's margin around that box, of l_c
  double marginOfDiagonal = 0;     // or of its diagonal
  Figures figures = {};
  std::vector<std::string> refused = {};  // not empty: must be refused, the message has all these
  Order order = Order::together;
  bool slow = false;    // run only where named
  bool sample = false;  // the files are the project's own, of the box of samples/faults
  bool valid = true;    // false: either outcome will do
};

/// Single surfaces: faults at 1200 m, scans with the l_c that is chosen and at diagonal / 40, and
/// those that must be refused.
void addSingleRows(std::vector<Row>& all) {
  for (const char* file :
       {"fault_red_mountain.obj", "fault_red_mountain_native.obj", "fault_northridge_frew_utm.obj",
        "WTRA-ORFZ-SFNV-Northridge_Frew_fault-CFM2.ts"}) {
    Row fault{file + std::string(" 1200"), {file}, 1200};
    fault.figures = {.45, 0, 0, 2};
    all.push_back(fault);
  }
  const std::pair<const char*, Figures> chosen[] = {{"claudius_SmallFault.ts", {.45, 0, 0, 2}},
                                                    {"open_lilium.obj", {.4, 0, 0, 0}},
                                                    {"open_woody_planar.obj", {.5, 0, 0, 0}},
                                                    {"open_hand_lowres.obj", {}},
                                                    {"open_demosthenes.obj", {}},
                                                    {"open_camelhead.obj", {}}};
  for (const auto& [file, figures] : chosen)
    for (double part : {0., 1. / 40}) {
      Row scan{file + std::string(part > 0 ? " diagonal/40" : " chosen"), {file}};
      scan.lcOfDiagonal = part, scan.marginOfDiagonal = .25, scan.figures = figures;
      // refused, or valid: fingers and sheets near each other; it crosses itself
      scan.valid = figures.min > 0;
      scan.slow = !scan.valid;
      all.push_back(scan);
    }
  const std::pair<const char*, const char*> refused[] = {
      {"neg_torus_genus1.obj", "closed"},
      {"neg_white_wolf_nonmanifold.obj", "non-manifold"},
      {"neg_42400-IDGH.stl", "holes"},
      {"neg_footbones_26components.ply", "closed"}};
  for (const auto& [file, reason] : refused) {
    Row row{file, {file}};
    row.marginOfDiagonal = .25, row.refused = {reason};
    all.push_back(row);
  }
}

std::vector<Row> rows() {
  std::vector<Row> all;
  const Figures set{.35, .89, .2, 0};
  const std::pair<const char*, Order> orders[] = {
      {"", Order::together}, {" as listed", Order::asListed}, {" reversed", Order::reversed}};
  for (const char* files : {"cfm_mojave", "cfm_puente_hills", "cfm_san_bernardino"})
    for (const auto& [suffix, order] : orders) {
      Row row{files + std::string(" 1200") + suffix, {files}, 1200};
      row.figures = set, row.order = order;
      all.push_back(row);
      row.name = files + std::string(" 2400") + suffix, row.lc = 2400, row.figures = {};
      all.push_back(row);
    }
  for (const auto& [suffix, order] : orders)
    for (double lc : {.12, .06}) {
      Row row{(lc == .12 ? "samples/faults .12" : "samples/faults .06") + std::string(suffix),
              {"samples/faults/west.ts", "samples/faults/east.ts", "samples/faults/ring.ts",
               "samples/faults/lobe.ts"},
              lc};
      row.figures = {lc == .12 ? .45 : .42, .9, .2, 0};
      row.order = order, row.sample = true;
      all.push_back(row);
    }
  Row crossing{"cfm_neg_crossing_pair", {"cfm_neg_crossing_pair"}, 1200};
  crossing.refused = {"East_Shoreline", "Southern_San_Andreas", "near ("};
  all.push_back(crossing);
  for (double lc : {1200., 600., 300.}) {
    Row coyote{"coyote " + std::to_string(static_cast<int>(lc)),
               {"cfm_puente_hills/WTRA-PHTS-COYT-Puente_Hills_Thrust_fault-CFM2.obj"},
               lc};
    coyote.slow = true;
    all.push_back(coyote);
  }
  Row fine{"cfm_mojave 500", {"cfm_mojave"}, 500};
  fine.figures = {.25, 0, 0, 0}, fine.slow = true;
  all.push_back(fine);
  addSingleRows(all);
  return all;
}

std::vector<TriangleSurface> surfacesOf(const Row& row, std::string data) {
  if (row.sample) data = ".";
  std::vector<std::string> files;
  for (const std::string& file : row.files) {
    if (!fs::is_directory(data + "/" + file)) {
      files.push_back(data + "/" + file);
      continue;
    }
    std::vector<std::string> found;
    for (const fs::directory_entry& entry : fs::directory_iterator(data + "/" + file))
      if (entry.path().extension() == ".obj") found.push_back(entry.path().string());
    std::sort(found.begin(), found.end());
    files.insert(files.end(), found.begin(), found.end());
  }
  std::vector<TriangleSurface> surfaces;
  std::vector<std::string> notes;
  for (const std::string& file : files)
    for (const TriangleSurface& S : readSurfaces(file, notes)) surfaces.push_back(S);
  if (row.order == Order::reversed) std::reverse(surfaces.begin(), surfaces.end());
  return surfaces;
}

/// A box of cubic cells, 8 h wide where l_c is given, with the row's margin at least.
Mesh boxAround(const std::vector<TriangleSurface>& surfaces, Row& row) {
  if (row.sample) return boxMesh({0, 0, 0}, {4, 3, 2}, {4, 3, 2});
  Vec3 lo{1e300, 1e300, 1e300}, hi{-1e300, -1e300, -1e300};
  for (const TriangleSurface& S : surfaces)
    for (Vec3 p : S.points) {
      lo = {std::min(lo.x, p.x), std::min(lo.y, p.y), std::min(lo.z, p.z)};
      hi = {std::max(hi.x, p.x), std::max(hi.y, p.y), std::max(hi.z, p.z)};
    }
  const double diagonal = norm(hi - lo);
  if (row.lcOfDiagonal > 0) row.lc = row.lcOfDiagonal * diagonal;
  const double margin =
      row.marginOfDiagonal > 0 ? row.marginOfDiagonal * diagonal : row.marginOfLc * row.lc;
  const Vec3 extent = hi - lo + 2 * margin * Vec3{1, 1, 1};
  const double edge =
      row.lc > 0 ? 8 * .98 * row.lc / std::sqrt(3.) : std::max({extent.x, extent.y, extent.z}) / 6;
  const std::array<int, 3> cells{static_cast<int>(std::ceil(extent.x / edge)),
                                 static_cast<int>(std::ceil(extent.y / edge)),
                                 static_cast<int>(std::ceil(extent.z / edge))};
  const Vec3 size{edge * cells[0], edge * cells[1], edge * cells[2]};
  return boxMesh(.5 * (lo + hi) - .5 * size, size, cells);
}

/// What of the figures is not met; empty: all is.
std::string missed(const Row& row, const Mesh& M, const std::vector<InsertReport>& reports) {
  std::string text;
  auto demand = [&](bool holds, const std::string& what) {
    if (!holds) text += (text.empty() ? "" : ", ") + what;
  };
  const QualityStatistics& q = reports.back().smoothed;
  demand(row.refused.empty(), "was to be refused");
  demand(shapes::countInverted(M) == 0, "inverted");
  demand(q.min >= row.figures.min, format("min < %.2f", row.figures.min));
  demand(q.mean >= row.figures.mean, format("mean < %.2f", row.figures.mean));
  for (const InsertReport& r : reports) {
    const double h = std::cbrt(M.cube.x * M.cube.y * M.cube.z) * std::exp2(-cubeLevel(M, r.lc) / 3);
    const bool isCoyote = M.surfaces[r.surface - 1].name.find("PHTS-COYT") != std::string::npos;
    const double hausdorff = isCoyote ? .3 : row.figures.hausdorff;  // its lobes overlap
    if (row.figures.hausdorff > 0)
      demand(r.hausdorff <= hausdorff * row.lc, format("H/lc %.2f", r.hausdorff / row.lc));
    if (row.figures.shift > 0)
      demand(r.tangentialShift <= row.figures.shift * h,
             format("shift/h %.2f", r.tangentialShift / h));
  }
  return text;
}

/// The last line of a row with a mesh.
std::string resultLine(const Mesh& M, const std::vector<InsertReport>& reports) {
  double hausdorff = 0, shift = 0, least = 1e300;
  for (const InsertReport& r : reports) {
    const double h = std::cbrt(M.cube.x * M.cube.y * M.cube.z) * std::exp2(-cubeLevel(M, r.lc) / 3);
    hausdorff = std::max(hausdorff, r.hausdorff / r.lc);
    shift = std::max(shift, r.tangentialShift / h);
    least = std::min(least, r.lc);
  }
  const QualityStatistics& q = reports.back().smoothed;
  return format(
      "%d surfaces, %7d tets, inverted %d, min %.3f mean %.3f, l_c from %.4g, H/lc %.2f, "
      "shift/h %.2f",
      static_cast<int>(reports.size()), q.tetrahedra, q.inverted, q.min, q.mean, least, hausdorff,
      shift);
}

bool run(Row row, const stress::Arguments& a) {
  const std::clock_t start = std::clock();
  std::string text, fault;
  Mesh M;
  try {
    const std::vector<TriangleSurface> surfaces = surfacesOf(row, a.data);
    M = boxAround(surfaces, row);
    InsertOptions options;
    options.lc = row.lc;
    if (a.verbose)
      options.onProgress = [](const std::string& line) { std::cerr << line << std::endl; };
    std::vector<InsertReport> reports;
    if (row.order == Order::together)
      reports = insertSurfaces(M, surfaces, options);
    else
      for (const TriangleSurface& S : surfaces) reports.push_back(insertSurface(M, S, options));
    text = resultLine(M, reports);
    fault = missed(row, M, reports);
    for (const InsertReport& r : reports) {
      if (a.verbose)
        std::cout << format("  %-60s tets %7d min %.3f -> %.3f mean %.3f H/lc %.2f way %d\n",
                            M.surfaces[r.surface - 1].name.c_str(), r.smoothed.tetrahedra,
                            r.original.min, r.smoothed.min, r.smoothed.mean, r.hausdorff / r.lc,
                            r.way);
      for (const std::string& w : r.warnings)
        std::cout << "  " << M.surfaces[r.surface - 1].name << ": " << w << "\n";
    }
    if (!a.write.empty()) {
      std::replace(row.name.begin(), row.name.end(), '/', '_');
      writeFiles({{a.write + row.name + ".vtk", vtkText(M)}});
    }
  } catch (const Error& error) {
    text = std::string("refused: ") + error.what();
    if (row.refused.empty() && row.valid) fault = "was to be inserted";
    for (const std::string& part : row.refused)
      if (text.find(part) == std::string::npos) fault += " no '" + part + "' in the message";
  }
  const double seconds = static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
  std::cout << format("%-50s", row.name.c_str()) << text << format(", %.0f s  ", seconds)
            << (fault.empty() ? "ok" : "BAD: " + fault) << std::endl;
  return fault.empty();
}

}  // namespace

int main(int argc, char** argv) {
  const stress::Arguments a = stress::parse(argc, argv);
  if (a.usage) {
    std::cerr << help;
    return 2;
  }
  if (!fs::is_directory(a.data)) {
    std::cout << "stress-real skipped: there is no " << a.data << std::endl;
    return 0;
  }
  int selected = 0, met = 0;
  for (const Row& row : rows()) {
    if (!stress::isSelected(row.name, row.slow, a)) continue;
    ++selected;
    if (a.list)
      std::cout << row.name << (row.slow ? " (slow)" : "") << std::endl;
    else
      met += run(row, a);
  }
  if (a.list) return 0;
  std::cout << met << " of " << selected << " rows met" << std::endl;
  return met == selected ? 0 : 1;
}
