// SPDX-License-Identifier: MIT
//
// `make bench`: seconds of each stage of insertSurface, and tetrahedra per second, at four sizes.
// The surface is §4.1's sine, A = .1, finer than the mesh at each size.
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <map>

#include "../samples/surfaces.hpp"

namespace {

using namespace meccano;

/// cells and l_c: the elements at S have cubes of h = 1/16, 1/32, 1/64 (or 1/80), 1/160.
struct Size {
  int cells;
  double lc;
};
constexpr Size sizes[] = {{2, .12}, {2, .06}, {5, .024}, {5, .012}};
constexpr const char* stages[] = {"approximated",       "healed",    "extracted",
                                  "surfaceHealed", "projected", "smoothed"};

class Clock {
 public:
  /// Seconds since the last call.
  double lap() {
    const auto now = std::chrono::steady_clock::now();
    const double seconds = std::chrono::duration<double>(now - last_).count();
    last_ = now;
    return seconds;
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

void benchOne(const Size& size, bool paper) {
  const TriangleSurface S = samples::sine(.1, size.lc < .03 ? 160 : 64);
  Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {size.cells, size.cells, size.cells});
  InsertOptions options = paper ? InsertOptions::paper() : InsertOptions{};
  options.lc = size.lc;
  std::map<std::string, double> seconds;
  Clock clock;
  options.onStage = [&](const char* stage, const Mesh&) { seconds[stage] += clock.lap(); };
  try {
    const InsertReport report = insertSurface(M, S, options);
    const double tail = clock.lap();  // the checks and figures of the report
    double before = 0;                // all stages but the optimization
    std::printf("%8d %6g ", static_cast<int>(M.tets.size()), size.lc);
    for (const char* stage : stages) {
      std::printf("%10.3f", seconds[stage]);
      if (stage != std::string("smoothed")) before += seconds[stage];
    }
    const double count = static_cast<double>(M.tets.size());
    std::printf("%8.3f %12.0f %12.0f %9d %7.3f %7.3f\n", tail, count / before,
                count / (before + seconds["smoothed"] + tail), report.projected.inverted,
                report.smoothed.min, report.smoothed.mean);
  } catch (const Error& error) {
    std::printf("l_c = %g: %s\n", size.lc, error.what());
  }
  std::fflush(stdout);
}

}  // namespace

/// bench [--paper] [COUNT]: the first COUNT sizes, 4 without.
int main(int argc, char** argv) {
  bool paper = false;
  int count = 4;
  for (int i = 1; i < argc; ++i)
    if (argv[i] == std::string("--paper"))
      paper = true;
    else
      count = std::atoi(argv[i]);
  std::printf(
      "sine, A = .1%s; seconds of each stage, then tetrahedra per second without and with the "
      "optimization\n",
      paper ? ", paper()" : "");
  std::printf(
      "    tets    l_c     refine      heal   extract s.healing   project  optimize  report     "
      "t/s before      t/s all  inverted     min    mean\n");
  for (int i = 0; i < count && i < 4; ++i) benchOne(sizes[i], paper);
}
