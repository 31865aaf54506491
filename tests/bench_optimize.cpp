// SPDX-License-Identifier: MIT
//
// `make bench-optimize`: optimizeMesh on the cases of a folder (MEDIT files, `make_cases.py` there
// writes them): shaken cubes, projected sheets, turned inner cubes. Seconds are CPU time of the
// optimizer alone; E = mean η − 1.
#define MECCANO_NO_MAIN
#include <ctime>
#include <filesystem>

#include "../main.cpp"

namespace {

using namespace meccano;
using namespace meccano::app;

struct Case {
  const char *name, *ideal;
  double reachedE;  // known to be near the minimum; 0: not asked for
};
constexpr Case cases[] = {{"t030", "kuhn26", 0},          {"t050", "kuhn26", 0},
                          {"t100", "kuhn26", 0},          {"proj_A01", "kuhn32", .01568},
                          {"proj_A02", "kuhn32", .06343}, {"turn_2.2", "turn8", 0},
                          {"turn_3.0", "turn10", 0}};

double cpuSeconds() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

void benchCase(const std::string& folder, const Case& c, double power, int threads) {
  MeshFile file = readMeshFile(folder + "/" + c.name + ".mesh");
  file.M.xi = readMesh(folder + "/" + c.ideal + ".mesh").x;
  OptimizeOptions options;
  options.fixed = file.required;
  options.power = power;
  options.threads = threads;
  const double start = cpuSeconds();
  const OptimizeReport r = optimizeMesh(file.M, options);
  const double seconds = cpuSeconds() - start;
  double E = -1;
  for (double q : qualities(file.M)) E += 1 / q / static_cast<double>(file.M.tets.size());
  const QualityStatistics q = qualityStatistics(file.M);
  std::printf("%-9s %7g %8d %8d %6d %10.7f %7.4f %7.4f %7.4f %8.3f %10.0f%s\n", c.name, power,
              q.tetrahedra, q.inverted, r.sweeps, E, q.min, q.mean, q.stdDev, seconds,
              q.tetrahedra / seconds,
              power == 1 && c.reachedE > 0 && E > c.reachedE ? "  E is above its figure" : "");
  std::fflush(stdout);
}

}  // namespace

/// bench_optimize FOLDER [THREADS]
int main(int argc, char** argv) try {
  const std::string folder = argc > 1 ? argv[1] : ".";
  const int threads = argc > 2 ? std::atoi(argv[2]) : 1;
  if (!std::filesystem::exists(folder + "/t030.mesh")) {
    std::printf("bench-optimize: skipped, no cases in %s\n", folder.c_str());
    return 0;
  }
  std::printf(
      "case        power     tets inverted sweeps          E     min    mean     std  CPU s     "
      "tets/s\n");
  for (double power : {1., 64.})
    for (const Case& c : cases) benchCase(folder, c, power, threads);
  return 0;
} catch (const std::exception& error) {
  std::printf("bench-optimize: %s\n", error.what());
  return 1;
}
