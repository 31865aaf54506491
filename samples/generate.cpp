// SPDX-License-Identifier: MIT
//
// Writes the samples (`make samples`), and any surface of surfaces.hpp for use by hand.
#include <charconv>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <string>

#define MECCANO_NO_MAIN
#include "../main.cpp"
#include "../tests/solids.hpp"
#include "surfaces.hpp"

namespace {

using meccano::TriangleSurface;
using meccano::Vec3;
namespace samples = meccano::samples;

constexpr const char* help =
    "usage: generate DIR                                    writes DIR/cube_sine, /faults, "
    "/layers\n"
    "       generate --surface NAME [ARGS] FILE.obj         writes one surface\n"
    "       generate --island N FILE.asc                    a synthetic island of N x N heights\n"
    "       generate --layer DEM.asc HEIGHT MARGIN SMOOTH FILE.obj\n"
    "           the terrain, its heights averaged SMOOTH times over 3 x 3, lifted by HEIGHT, up\n"
    "           to MARGIN before its sides\n"
    "\n"
    "NAME [ARGS] (default)    all but fault, blob in the unit cube, formulas in surfaces.hpp\n"
    "  sine A (.1) N (64)     z = .5 + A sin(2 pi x), N x N x 2 triangles\n"
    "  sine2 A (.1)           z = .5 + A sin(2 pi x) sin(2 pi y)\n"
    "  plane AX (10) AY (0)   a square turned about x, then y; degrees\n"
    "  disc TILT (0)          a flat disc\n"
    "  cap ANGLE (120)        a spherical cap by its full opening angle; degrees, below 180\n"
    "  saddle A (.1)          z = .5 + A (s^2 - t^2)\n"
    "  helicoid TURNS (.5)\n"
    "  strip                  7:1, bent\n"
    "  threeLobed\n"
    "  raggedRim\n"
    "  ridge KIND (0)         0 mild, 1 knife\n"
    "  patch SEED (1)         a random patch of make stress\n"
    "  fault K (1)            west, east, ring, lobe of the sample, in a box of 4 x 3 x 2\n"
    "  blob N (40)            a closed surface, a sphere with bumps and dents; not in the cube\n";

/// The shortest text that reads back as the same double.
std::string shortest(double value) {
  char text[32];
  return {text, std::to_chars(text, text + sizeof text, value).ptr};
}

void checkWritten(std::ofstream& out, const std::string& file) {
  out.flush();
  if (!out) throw meccano::Error("generate: cannot write " + file);
}

std::string vertexLine(Vec3 p) {
  return "v " + shortest(p.x) + " " + shortest(p.y) + " " + shortest(p.z) + "\n";
}

void writeObj(const TriangleSurface& S, const std::string& file) {
  std::ofstream out(file);
  for (const Vec3& p : S.points) out << vertexLine(p);
  for (const auto& t : S.triangles)
    out << "f " << t[0] + 1 << " " << t[1] + 1 << " " << t[2] + 1 << "\n";
  checkWritten(out, file);
}

/// The sine of §4.1 below 200 kB: x and y to 1e-3, z = .5 + .1 sin(2 pi x) to 1e-6, and each cell's
/// two triangles right after its last vertex, so that OBJ's relative indices stay short.
void writeSineSample(const std::string& file) {
  constexpr int n = 64;
  const TriangleSurface S = samples::sine(.1, n);
  std::ofstream out(file);
  out << "# z = .5 + .1 sin(2 pi x) over [.15, .85]^2, 64 x 64 x 2 triangles; made by "
         "samples/generate.cpp\n";
  for (int i = 0; i <= n; ++i)
    for (int j = 0; j <= n; ++j) {
      const Vec3 p = S.points[i * (n + 1) + j];
      const double x = std::round(p.x * 1e3) / 1e3, y = std::round(p.y * 1e3) / 1e3;
      const double z = .5 + .1 * std::sin(2 * samples::pi * x);
      out << vertexLine({x, y, std::round(z * 1e6) / 1e6});
      if (i > 0 && j > 0) out << "f -67 -2 -1\nf -67 -1 -66\n";
    }
  checkWritten(out, file);
}

/// A GOCAD TSurf; coordinates to 1e-5.
void writeTs(const TriangleSurface& S, const std::string& file) {
  std::ofstream out(file);
  out << "GOCAD TSurf 1\nHEADER {\nname:" << S.name << "\n}\nTFACE\n";
  auto rounded = [](double value) { return shortest(std::round(value * 1e5) / 1e5); };
  for (std::size_t i = 0; i < S.points.size(); ++i) {
    const Vec3& p = S.points[i];
    out << "VRTX " << i + 1 << " " << rounded(p.x) << " " << rounded(p.y) << " " << rounded(p.z)
        << "\n";
  }
  for (const auto& t : S.triangles)
    out << "TRGL " << t[0] + 1 << " " << t[1] + 1 << " " << t[2] + 1 << "\n";
  out << "END\n";
  checkWritten(out, file);
}

void writeFaults(const std::string& folder) {
  std::filesystem::create_directories(folder);
  for (const TriangleSurface& S : samples::faults()) writeTs(S, folder + "/" + S.name + ".ts");
}

void writeAsc(const meccano::Terrain& T, const std::string& file) {
  std::ofstream out(file);
  out << "ncols " << T.nx << "\nnrows " << T.ny << "\nxllcenter " << shortest(T.origin.x)
      << "\nyllcenter " << shortest(T.origin.y) << "\ncellsize " << shortest(T.cell) << "\n";
  for (int j = T.ny - 1; j >= 0; --j)
    for (int i = 0; i < T.nx; ++i)
      out << shortest(T.z[j * T.nx + i]) << (i + 1 < T.nx ? " " : "\n");
  checkWritten(out, file);
}

/// A sheet of the generator with OBJ's relative indices, each cell after its last vertex.
void writeLayer(const TriangleSurface& S, const std::string& file) {
  const int n = S.triangles[0][1];  // points of a column
  std::ofstream out(file);
  for (int k = 0; k < static_cast<int>(S.points.size()); ++k) {
    out << vertexLine(S.points[k]);
    if (k > n && k % n > 0)
      out << "f " << -n - 2 << " -2 -1\nf " << -n - 2 << " -1 " << -n - 1 << "\n";
  }
  checkWritten(out, file);
}

/// §4.3.1 in small, below 200 kB: an island and two layers 1000 m and 2000 m above it.
void writeLayersSample(const std::string& folder) {
  constexpr int points = 51;
  constexpr double margin = 2048;
  const meccano::Terrain T = samples::island(points);
  writeAsc(T, folder + "/island.asc");
  for (int height : {1000, 2000})
    writeLayer(samples::layer(T, height, margin),
               folder + "/layer_" + std::to_string(height) + ".obj");
}

/// Argument i of the surface, a number, or its default.
double argument(const std::vector<std::string>& args, std::size_t i, double otherwise) {
  if (i >= args.size()) return otherwise;
  double value = 0;
  const char* const end = args[i].data() + args[i].size();
  const auto [stop, error] = std::from_chars(args[i].data(), end, value);
  if (error != std::errc() || stop != end || !std::isfinite(value))
    throw meccano::InputError("generate: '" + args[i] + "' is not a number");
  return value;
}

TriangleSurface surfaceByName(const std::string& name, const std::vector<std::string>& args) {
  auto arg = [&](std::size_t i, double otherwise) { return argument(args, i, otherwise); };
  if (name == "sine") return samples::sine(arg(0, .1), static_cast<int>(arg(1, 64)));
  if (name == "sine2") return samples::sine2(arg(0, .1));
  if (name == "plane") return samples::plane(arg(0, 10), arg(1, 0));
  if (name == "disc") return samples::disc(arg(0, 0));
  if (name == "cap") return samples::cap(arg(0, 120));
  if (name == "saddle") return samples::saddle(arg(0, .1));
  if (name == "helicoid") return samples::helicoid(arg(0, .5));
  if (name == "strip") return samples::strip();
  if (name == "threeLobed") return samples::threeLobed();
  if (name == "raggedRim") return samples::raggedRim();
  if (name == "ridge")
    return samples::ridge(arg(0, 0) > 0 ? samples::Ridge::knife : samples::Ridge::mild);
  if (name == "patch") return samples::randomPatch(static_cast<std::uint64_t>(arg(0, 1)));
  if (name == "fault") return samples::faults().at(static_cast<std::size_t>(arg(0, 1) - 1));
  if (name == "blob") return solids::blob(static_cast<int>(arg(0, 40)));
  throw meccano::InputError("generate: no surface '" + name + "'; see --help");
}

}  // namespace

int main(int argc, char** argv) {
  const std::vector<std::string> args(argv + 1, argv + argc);
  try {
    if (args.size() == 1 && (args[0] == "--help" || args[0] == "-h")) {
      std::cout << help;
    } else if (args.size() >= 3 && args[0] == "--surface") {
      writeObj(surfaceByName(args[1], {args.begin() + 2, args.end() - 1}), args.back());
    } else if (args.size() == 3 && args[0] == "--island") {
      writeAsc(samples::island(static_cast<int>(argument(args, 1, 0))), args[2]);
    } else if (args.size() == 6 && args[0] == "--layer") {
      const meccano::Terrain T = meccano::app::readTerrain(args[1]);
      const int times = static_cast<int>(argument(args, 4, 0));
      writeObj(
          samples::layer(samples::smoothed(T, times), argument(args, 2, 0), argument(args, 3, 0)),
          args[5]);
    } else if (args.size() == 1 && args[0][0] != '-') {
      std::filesystem::create_directories(args[0] + "/cube_sine");
      writeSineSample(args[0] + "/cube_sine/sine.obj");
      writeFaults(args[0] + "/faults");
      std::filesystem::create_directories(args[0] + "/layers");
      writeLayersSample(args[0] + "/layers");
    } else {
      std::cerr << help;
      return 2;
    }
  } catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 1;
  }
}
