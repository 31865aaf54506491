// SPDX-License-Identifier: MIT
//
// `make bench`: seconds of each stage of insertSurface, tetrahedra per second, sweeps, visits per
// node, the process's peak memory per tetrahedron, and the exponent of the growth from one size to
// the next. Then what the seventh of seven surfaces costs.
// The surface is §4.1's sine, A = .1, of 8192 triangles at each size.
#include <sys/resource.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <map>
#include <vector>

#include "../samples/surfaces.hpp"

namespace {

using namespace meccano;

/// cells and l_c: the elements at S have cubes of h = 1/16, 1/32, 1/80, 1/160, 1/320.
struct Size {
  int cells;
  double lc;
};
constexpr Size sizes[] = {{2, .12}, {2, .06}, {5, .024}, {5, .012}, {5, .006}};
constexpr int sizeCount = 5;
constexpr int fine = 64;  // squares of S along an edge, whatever the size
constexpr const char* stages[] = {"approximated", "healed",    "extracted", "surfaceHealed",
                                  "projected",    "optimized", "smoothed"};

/// CPU seconds of one thread, which other jobs on the machine hardly change; of more threads the
/// seconds of the wall.
class Clock {
 public:
  explicit Clock(bool wall) : wall_(wall) {}
  /// Seconds since the last call.
  double lap() {
    const double before = last_;
    last_ = now();
    return last_ - before;
  }

 private:
  double now() const {
    if (!wall_) return static_cast<double>(std::clock()) / CLOCKS_PER_SEC;
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch())
        .count();
  }
  bool wall_;
  double last_ = now();
};

double peakBytes() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  return 1024. * static_cast<double>(usage.ru_maxrss);
}

/// What one run takes.
struct Run {
  double tets = 0, seconds = 0, optimizing = 0;
};

Run benchOne(const Size& size, int squares, bool paper, int threads, const Run& smaller) {
  const TriangleSurface S = samples::sine(.1, squares);
  Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {size.cells, size.cells, size.cells});
  InsertOptions options = paper ? InsertOptions::paper() : InsertOptions{};
  options.lc = size.lc;
  options.optimize.threads = threads;
  Run run;
  std::map<std::string, double> seconds;
  Clock clock(threads > 1);
  options.onStage = [&](const char* stage, const Mesh&) { seconds[stage] += clock.lap(); };
  options.onProgress = [&](const std::string& line) {
    if (line.rfind("3.7 optimization", 0) != 0) return;
    seconds["optimized"] += clock.lap();
  };
  try {
    const InsertReport report = insertSurface(M, S, options);
    seconds["smoothed"] += clock.lap();
    run.tets = static_cast<double>(M.tets.size()), run.optimizing = seconds["optimized"];
    std::printf("%8d %6g %9d %3d ", static_cast<int>(M.tets.size()), size.lc,
                static_cast<int>(S.triangles.size()), threads);
    for (const char* stage : stages) {
      std::printf("%9.3f", seconds[stage]);
      run.seconds += seconds[stage];
    }
    const double visits = static_cast<double>(report.optimization.visits);
    std::printf(" %9.0f %7.0f %6.0f %% %6d %6.1f %6.0f %6.3f %6.3f", run.tets / run.seconds,
                1e9 * run.seconds / run.tets, 100 * (1 - run.optimizing / run.seconds),
                report.optimization.sweeps, visits / static_cast<double>(M.x.size()),
                peakBytes() / run.tets, report.smoothed.min, report.smoothed.mean);
    if (smaller.tets > 0)
      std::printf(" %6.2f",
                  std::log(run.seconds / smaller.seconds) / std::log(run.tets / smaller.tets));
    std::printf("\n");
  } catch (const Error& error) {
    std::printf("l_c = %g: %s\n", size.lc, error.what());
  }
  std::fflush(stdout);
  return run;
}

/// Seven sheets beside each other, .3 apart, one after the other: the CPU seconds of the seventh
/// against those of the same sheet alone in the same box.
void benchSeventh() {
  constexpr int cells = 5, repeats = 9;
  const Mesh box = boxMesh({0, 0, 0}, {4, 2, 1}, {4 * cells, 2 * cells, cells});
  InsertOptions options;
  options.lc = .045, options.optimize.threads = 1;
  const auto sheetAt = [](int place) {
    TriangleSurface S = samples::sine(.1, 64);
    for (Vec3& p : S.points) p = p + Vec3{double(place / 2), double(place % 2), 0};
    return S;
  };
  Mesh six = box, M;
  for (int place = 0; place < 6; ++place) insertSurface(six, sheetAt(place), options);
  std::vector<double> alone, seventh;
  for (int k = 0; k < repeats; ++k)
    for (std::vector<double>* seconds : {&alone, &seventh}) {
      M = seconds == &alone ? box : six;
      Clock clock(false);
      insertSurface(M, sheetAt(6), options);
      seconds->push_back(clock.lap());
    }
  std::sort(alone.begin(), alone.end()), std::sort(seventh.begin(), seventh.end());
  const double one = alone[repeats / 2], last = seventh[repeats / 2];
  std::printf(
      "seven sheets, l_c = .045, %d tetrahedra, medians of %d: the seventh %.3f s, alone %.3f s, "
      "ratio %.2f\n",
      static_cast<int>(M.tets.size()), repeats, last, one, last / one);
}

}  // namespace

/// bench [--paper] [COUNT]: the first COUNT sizes, 4 without; 5: 1.6 million tetrahedra.
int main(int argc, char** argv) {
  bool paper = false;
  int count = 4;
  for (int i = 1; i < argc; ++i)
    if (argv[i] == std::string("--paper"))
      paper = true;
    else
      count = std::atoi(argv[i]);
  std::printf(
      "sine, A = .1%s; seconds of each stage (measure: distances of S_M, the report); CPU seconds "
      "of one thread, the wall's of two\n",
      paper ? ", paper()" : "");
  std::printf(
      "    tets    l_c      of S thr   refine     heal  extract s.healing project optimize  "
      "measure    "
      "tets/s "
      "ns/tet  not opt. sweeps visits B/tet    min   mean growth\n");
  Run last;
  for (int i = 0; i < count && i < sizeCount; ++i) {
    benchOne(sizes[i], static_cast<int>(std::lround(1 / sizes[i].lc)), paper, 1, {});
    const Run one = benchOne(sizes[i], fine, paper, 1, last);
    const Run two = benchOne(sizes[i], fine, paper, 2, {});
    std::printf(
        "%18s on 2 threads (where nothing else runs): optimizer %.2f times, all %.2f times\n", "",
        one.optimizing / two.optimizing, one.seconds / two.seconds);
    last = one;
  }
  if (!paper) benchSeventh();
}
