// SPDX-License-Identifier: MIT
//
// Section 4.3.2: samples/pollutant, its wind, transport, solver, files and messages.
#include <doctest/doctest.h>
#include <unistd.h>

#include <set>
#include <sstream>

#define POLLUTANT_NO_MAIN
#include "../samples/pollutant/pollutant.cpp"

using namespace pollutant;

namespace {

double flat(double, double) { return 0; }
double dome(double x, double y) { return 900 * std::exp(-(x * x + y * y) / 16e6); }
double island(double x, double y) {
  return 900 * std::exp(-(x * x + y * y) / 9e6) * (1 + .2 * std::sin(x / 700 + y / 900));
}

/// A box of 12 x 12 x 4 km over a terrain, its inner nodes moved off the lattice by up to `shake`
/// of a cell; the lattice planes 1/4 and 1/2 of the height are layers 1 and 2.
Mesh sheared(double (*terrain)(double, double), std::array<int, 3> cells, double shake = .15) {
  Mesh M = meccano::boxMesh({-6000, -6000, 0}, {12000, 12000, 4000}, cells);
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i)
      for (int k = 1; k <= 2 && M.faceLabel[E][i] == 0; ++k) {
        bool on = true;
        for (int j = 0; j < 4; ++j) on &= j == i || M.xi[M.tets[E][j]].z == k * cells[2] / 4;
        if (on) M.faceLabel[E][i] = k;
      }
  for (std::size_t n = 0; n < M.x.size(); ++n) {
    Vec3& p = M.x[n];
    auto random = [&](int salt) { return std::sin(12.9898 * double(n) + 78.233 * salt); };
    if (M.dimension[n] == 3) {
      p.x += shake * random(1) * 12000 / cells[0], p.y += shake * random(2) * 12000 / cells[1];
      if (M.xi[n].z != cells[2] / 4 && M.xi[n].z != cells[2] / 2)
        p.z += shake * random(3) * 4000 / cells[2];
    }
    p.z += (1 - p.z / 4000) * terrain(p.x, p.y);
  }
  return M;
}

Domain domain(double (*terrain)(double, double), std::array<int, 3> cells, double shake = .15) {
  return Domain(nodesOf(sheared(terrain, cells, shake)));
}

double largest(const Field& f) {
  double most = 0;
  for (double v : f) most = std::max(most, std::abs(v));
  return most;
}

double mass(const Domain& D, const Field& c) { return dotProduct(nodeVolumes(D), c); }

/// A wind without divergence or flux through the boundary: the curl of a P1 field (0, 0, psi) that
/// vanishes there.
Wind swirl(const Domain& D) {
  Wind W{std::vector<Vec3>(D.tets.size()), std::vector<Vec3>(D.x.size()), {}, {}};
  for (std::size_t E = 0; E < D.tets.size(); ++E)
    for (int i = 0; i < 4; ++i) {
      const Vec3 p = 1. / 6000 * D.x[D.tets[E][i]];
      const double psi = 12000 * std::max(0., 1 - p.x * p.x) * std::max(0., 1 - p.y * p.y);
      W.u[E] += psi * cross(D.grad[E][i], {0, 0, 1});
    }
  CHECK(largest(fluxes(D, W.u)) < 1e-6);  // of 1e7 through a node's cell
  W.flux.assign(D.x.size(), 0);
  return W;
}

Wind still(const Domain& D) {
  return {
      std::vector<Vec3>(D.tets.size()), std::vector<Vec3>(D.x.size()), {}, Field(D.x.size(), 0)};
}

Field hill(const Domain& D) {
  Field c;
  for (Vec3 p : D.x) {
    const double r = norm(p - Vec3{2000, 0, 2000}) / 2500;
    c.push_back(r < 1 ? std::pow(std::cos(1.5707963267948966 * r), 4) : 0);
  }
  return c;
}

/// Nothing but advection.
Settings advection() {
  Settings s;
  s.K = {0, 0}, s.deposition = 0;
  s.limit = false;
  return s;
}

/// A folder of its own, gone at the end.
struct Folder {
  std::filesystem::path path =
      std::filesystem::temp_directory_path() / ("pollutant-test-" + std::to_string(::getpid()));
  Folder() { std::filesystem::create_directories(path); }
  ~Folder() { std::filesystem::remove_all(path); }
  std::string operator/(const std::string& name) const { return (path / name).string(); }
  int files() const {
    int count = 0;
    for (const auto& entry : std::filesystem::recursive_directory_iterator(path))
      count += entry.is_regular_file();
    return count;
  }
};

struct Outcome {
  int status;
  std::string out, err;
};

Outcome call(std::vector<std::string> words) {
  std::ostringstream out, err;
  const int status = run(words, out, err);
  return {status, out.str(), err.str()};
}

std::string write(const Folder& folder, const std::string& name, const Nodes& G) {
  writeFiles(
      {{folder / name, volumeVtk(G, std::vector<Vec3>(G.x.size()), {0, Field(G.x.size())})}});
  return folder / name;
}

bool has(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

}  // namespace

TEST_SUITE("4.3.2") {
  TEST_CASE("source: the sides are refined where it is, on the side the wind meets, nowhere else") {
    meccano::Terrain sea;
    sea.nx = sea.ny = 2, sea.cell = 12000, sea.z = {0, 0, 0, 0};
    Settings s;
    s.lc = 700;
    for (double from : {90., 270., 45.}) {
      CAPTURE(from);
      s.from = from;
      Mesh M = meccano::boxMesh({0, 0, 0}, {12000, 12000, 9000}, {4, 4, 3});
      refineSource(M, sea, {1000, 2000}, s);
      const Region region(M.x, {1000, 2000}, s);
      for (int k = 1; k <= 4; ++k) {
        const bool met = from == 90 ? k == 2 : from == 270 ? k == 1 : k == 2 || k == 4;
        double longestIn = 0, longest = 0;
        for (const Triangle& t : meccano::surfaceFaces(M, -k))
          for (int i = 0; i < 3; ++i) {
            const Vec3 p = M.x[t[i]], q = M.x[t[(i + 1) % 3]];
            const Vec3 at = region.at(p, p.z);
            if (region.meets(at, at)) longestIn = std::max(longestIn, norm(p - q));
            longest = std::max(longest, norm(p - q));
          }
        CAPTURE(k);
        if (met) CHECK(longestIn <= 700);
        if (!met) CHECK(longest == doctest::Approx(std::sqrt(2.) * 3000));
      }
      std::set<double> rows;  // of nodes on the east or west side, in the source
      for (Vec3 p : M.x)
        if (const Vec3 at = region.at(p, p.z);
            region.meets(at, at) && p.x == (from == 270 ? 0 : 12000))
          rows.insert(p.z);
      CHECK(rows.size() >= 3);
      CHECK(*rows.rbegin() > 1500 - 700);
      CHECK(M.tets.size() < 6 * 4 * 4 * 3 * 40);
    }
  }

  TEST_CASE("wind: a constant u0 over flat terrain needs no adjustment") {
    const Domain D = domain(flat, {6, 6, 4});
    const Wind W = massConsistentWind(D, std::vector<Vec3>(D.tets.size(), {-7, 0, 0}), 1, 1);
    CHECK(largest(W.phi) < 1e-9 * 7 * 12000);
    const Domain box = domain(flat, {6, 8, 4}, 0);  // a step takes the wind through one element
    CHECK(courantStep(box, std::vector<Vec3>(box.tets.size(), {-7, 0, 0})) ==
          doctest::Approx(2000. / 7));
    for (Vec3 u : W.nodal) CHECK(norm(u - Vec3{-7, 0, 0}) < 1e-9);
  }

  TEST_CASE("wind: the discrete divergence over the island is the solver's residual") {
    const Domain D = domain(island, {12, 12, 8});
    Settings s;
    s.from = 70;
    for (double av : {1., .3}) {
      CAPTURE(av);
      const std::vector<Vec3> u0 = logarithmicWind(D, s);
      const Wind W = massConsistentWind(D, u0, 1, av);
      const Field before = fluxes(D, u0), after = fluxes(D, W.u);
      double rest = 0, start = 0, ends = 0, size = 0;
      for (std::size_t n = 0; n < D.x.size(); ++n) {
        if (!D.open[n]) rest += after[n] * after[n], start += before[n] * before[n];
        ends += after[n], size += std::abs(after[n]);
      }
      CHECK(std::sqrt(rest / start) <= 1e-8);
      CHECK(W.residual == doctest::Approx(std::sqrt(rest / start)));
      CHECK(std::abs(ends) < 1e-9 * size);  // what blows in blows out
    }
  }

  TEST_CASE("wind: the logarithmic profile has its speed at 10 m and its direction") {
    Nodes G;  // one tetrahedron with its centroid 10 m above ground, one ten times as high
    G.x = {{0, 0, 0}, {90, 0, 0}, {0, 90, 0}, {30, 30, 40}, {0, 0, 90}, {30, 30, 310}};
    G.tets = {{0, 1, 2, 3}};
    G.faces = {{-5, {{0, 1, 2}}}, {-1, {{0, 2, 4}}}, {1, {{0, 1, 3}}}};
    Settings s;
    s.wind = 6, s.from = 0;
    const Domain D(G);
    CHECK(D.height[3] == doctest::Approx(40));
    CHECK(norm(logarithmicWind(D, s)[0] - Vec3{0, -6, 0}) < 1e-12);
    s.from = 90;
    CHECK(norm(logarithmicWind(D, s)[0] - Vec3{-6, 0, 0}) < 1e-12);
  }

  TEST_CASE("P1 elements: a manufactured Poisson solution converges with order 2") {
    double before = 0;
    for (int n : {5, 10, 20}) {
      const Domain D = domain(dome, {n, n, n});
      const Vec3 T{.5, .5, .25};
      auto exact = [](Vec3 p) {
        return std::sin(p.x / 3000) * std::cos(p.y / 2500) * std::sin(p.z / 2000);
      };
      const SparseMatrix A = stiffness(D, T);
      std::vector<char> fixed(D.open);
      for (const Triangle& t : D.faces.at(terrainLabel))
        for (int i : t) fixed[i] = 1;
      const Field m = nodeVolumes(D);
      Field b = m, value(D.x.size(), 0), x = value;
      for (std::size_t i = 0; i < b.size(); ++i) {  // -div T grad u, lumped
        b[i] *= exact(D.x[i]) * (T.x / 9e6 + T.y / 6.25e6 + T.z / 4e6);
        if (fixed[i]) value[i] = exact(D.x[i]);
      }
      const SparseMatrix inner = constrained(A, fixed);
      solveCG(inner, incompleteCholesky(inner), constrainedRightSide(A, fixed, b, value), x, 1e-12);
      double error = 0;
      for (std::size_t i = 0; i < b.size(); ++i)
        error += m[i] * (x[i] - exact(D.x[i])) * (x[i] - exact(D.x[i]));
      error = std::sqrt(error);
      CAPTURE(n);
      if (n > 5) CHECK(before / error > 3.5);  // 2^1.8
      before = error;
    }
  }

  TEST_CASE("transport: the matrix is symmetric, constants stay, and so does the mass of a swirl") {
    const Domain D = domain(flat, {10, 10, 8});
    const Wind W = swirl(D);
    const Transport P(D, W, {}, .5 * courantStep(D, W.u), advection());
    double asymmetry = 0;
    SparseMatrix A = P.A;
    for (std::size_t i = 0; i < D.x.size(); ++i)
      for (int e = A.start[i]; e < A.start[i + 1]; ++e)
        asymmetry = std::max(asymmetry, std::abs(A.value[e] - entry(A, A.column[e], int(i))));
    CHECK(asymmetry < 1e-12 * largest(A.value));
    Balance balance;
    Field c = hill(D);
    auto moment = [&](const Field& of, std::vector<Vec3>& wind) {  // mean x, and mean wind, of c
      const double total = mass(D, of);
      Vec3 x;
      wind.push_back({});
      for (std::size_t E = 0; E < D.tets.size(); ++E)
        for (int n : D.tets[E]) wind.back() += D.volume[E] / 4 * of[n] / total * W.u[E];
      const Field m = nodeVolumes(D);
      for (std::size_t n = 0; n < of.size(); ++n) x += m[n] * of[n] / total * D.x[n];
      return x;
    };
    std::vector<Vec3> drift, centre{moment(c, drift)};
    for (int step = 0; step < 5; ++step) {
      const double before = mass(D, c);
      P.step(c, balance, 1e-13);
      CHECK(std::abs(mass(D, c) / before - 1) < 1e-10);
      centre.push_back(moment(c, drift));
    }
    Vec3 way;  // of the hill's centre: by the wind at it, trapezoidal in time
    for (std::size_t i = 1; i < drift.size(); ++i) way += P.dt / 2 * (drift[i - 1] + drift[i]);
    CHECK(norm(way) > 100);
    // but for least squares' share, dt/2 ∫ R u of the residual R on these coarse elements
    CHECK(norm(centre.back() - centre.front() - way) < .05 * norm(way));
    Field one(D.x.size(), .3);
    P.step(one, balance, 1e-13);
    for (double v : one) CHECK(std::abs(v - .3) < 1e-10);
  }

  TEST_CASE("transport: order 1 in time at least") {
    const Domain D = domain(flat, {8, 8, 8});
    const Wind W = swirl(D);
    Settings s = advection();
    s.K = {50, 50}, s.decay = 1e-4;
    const double time = 4 * courantStep(D, W.u);
    auto after = [&](int steps) {
      const Transport P(D, W, {}, time / steps, s);
      Field c = hill(D);
      Balance balance;
      for (int i = 0; i < steps; ++i) P.step(c, balance, 1e-11);
      return c;
    };
    const Field reference = after(256);
    Field coarse = after(16), fine = after(32);
    for (std::size_t n = 0; n < D.x.size(); ++n) coarse[n] -= reference[n], fine[n] -= reference[n];
    CHECK(std::sqrt(dotProduct(coarse, coarse) / dotProduct(fine, fine)) > 2);
  }

  TEST_CASE("transport: deposition and decay alone follow their exponentials") {
    const Domain D = domain(flat, {2, 2, 4}, 0);
    Settings s = advection();
    s.K = {1e7, 1e7};  // well mixed
    s.deposition = .5;
    const double dt = 20, H = 4000;
    Balance balance;
    Field c(D.x.size(), 1);
    const Transport deposition(D, still(D), {}, dt, s);
    for (int i = 0; i < 200; ++i) deposition.step(c, balance, 1e-12);
    CHECK(mass(D, c) / (1.2e4 * 1.2e4 * H) ==
          doctest::Approx(std::exp(-.5 * 200 * dt / H)).epsilon(2e-3));
    CHECK(balance.deposited + mass(D, c) == doctest::Approx(1.2e4 * 1.2e4 * H).epsilon(1e-9));
    s.deposition = 0, s.decay = 1e-4;
    const Transport decay(D, still(D), {}, dt, s);
    Field d(D.x.size(), 1);
    for (int i = 0; i < 200; ++i) decay.step(d, balance, 1e-12);
    for (double v : d) CHECK(v == doctest::Approx(std::exp(-1e-4 * 200 * dt)).epsilon(1e-3));
  }

  TEST_CASE("transport over the island: balance, undershoot, lower layer before upper") {
    const Domain D = domain(island, {14, 14, 12});
    Settings s;
    s.end = 1800;
    const Wind W = massConsistentWind(D, logarithmicWind(D, s), s.a[0], s.a[1]);
    const std::vector<int> source = sourceNodes(D, W, s);
    double least = 0, plainLeast = 0, flow = 0;
    std::ostringstream progress;
    const std::vector<Snapshot> at = simulate(D, W, source, s, progress, least);
    REQUIRE(at.size() == 2);
    CHECK(has(progress.str(), "element Courant number"));
    CHECK(has(progress.str(), " 30.0 of 30 min"));
    CHECK(least > -.05 * s.concentration);
    for (const Snapshot& moment : at) {
      CHECK(moment.balance.error() < 1e-5);
      CHECK(moment.balance.stored == doctest::Approx(mass(D, moment.c)).epsilon(1e-9));
      double mean[2] = {0, 0};
      for (int k = 1; k <= 2; ++k)
        for (const Triangle& t : D.faces.at(k))
          for (int n : t) mean[k - 1] += moment.c[n];
      CHECK(mean[1] < mean[0]);
    }
    // what enters is c u . n through the sides around the source, seen from their elements
    const Transport P(D, W, source, 1, s);
    for (std::size_t E = 0; E < D.tets.size(); ++E)
      for (int i = 0; i < 4; ++i) {
        double c = 0;
        bool side = true;
        for (int j = 0; j < 4; ++j)
          if (j != i) {
            const int n = D.tets[E][j];
            side &= D.x[n].x == 6000;
            c += P.value[n] / 3;
          }
        if (side) flow += 3 * D.volume[E] * dot(W.u[E], D.grad[E][i]) * c;
      }
    CHECK(at[1].balance.in == doctest::Approx(flow * 1800).epsilon(.1));
    s.limit = false;
    const std::vector<Snapshot> plain = simulate(D, W, source, s, progress, plainLeast);
    CHECK(plainLeast < least);
    CHECK(plain[1].balance.error() < 1e-5);
  }

  TEST_CASE("limit: keeps mass to rounding, brings c within its bounds, leaves what is within") {
    const Domain D = domain(island, {6, 6, 6});
    Settings s = advection();
    const Transport P(D, still(D), {}, 1, s);
    Field c = hill(D), within = c;
    P.limit(within, 1);
    for (std::size_t n = 0; n < c.size(); ++n)
      CHECK(within[n] == doctest::Approx(c[n]).epsilon(1e-12));
    for (std::size_t n = 0; n < c.size(); ++n) c[n] = .3 + .45 * std::sin(12.9898 * double(n * n));
    REQUIRE(*std::min_element(c.begin(), c.end()) < -.1);
    const double before = mass(D, c);
    Field average = multiply(P.mass, c);
    P.limit(c, .5);
    CHECK(mass(D, c) == doctest::Approx(before).epsilon(1e-12));
    int within0 = 0;
    for (std::size_t n = 0; n < c.size(); ++n) {  // within the bounds wherever the average is
      average[n] /= P.m[n];
      CHECK(c[n] > std::min(0., average[n]) - 1e-12);
      CHECK(c[n] < std::max(.5, average[n]) + 1e-12);
      within0 += average[n] > 0 && average[n] < .5;
    }
    CHECK(within0 > .9 * double(c.size()));
  }

  TEST_CASE("solver: incomplete Cholesky and conjugate gradients against a dense solution") {
    const Domain D = domain(island, {3, 3, 4});
    const int n = static_cast<int>(D.x.size());
    SparseMatrix A = constrained(stiffness(D, {.5, .5, 2}), D.open);
    Field b(n), x(n, 0);
    for (int i = 0; i < n; ++i) b[i] = std::sin(3. * i);
    std::vector<Field> rows(n, Field(n + 1, 0));
    for (int i = 0; i < n; ++i) {
      for (int e = A.start[i]; e < A.start[i + 1]; ++e) rows[i][A.column[e]] = A.value[e];
      rows[i][n] = b[i];
    }
    for (int k = 0; k < n; ++k)  // Gauss and Jordan; positive definite: no pivoting
      for (int i = 0; i < n; ++i)
        if (const double part = rows[i][k] / rows[k][k]; i != k && part != 0)
          for (int j = k; j <= n; ++j) rows[i][j] -= part * rows[k][j];
    for (int fill : {0, 3, n}) {
      CAPTURE(fill);
      Field y(n, 0);
      const int iterations = solveCG(A, incompleteCholesky(A, fill), b, y, 1e-12);
      for (int i = 0; i < n; ++i) CHECK(std::abs(y[i] - rows[i][n] / rows[i][i]) < 1e-9);
      if (fill == n) CHECK(iterations <= 2);  // the complete factor
    }
    // IC(0): L L^T has the entries of A where A has any
    const Factor L = incompleteCholesky(A, 0);
    std::vector<Field> dense(n, Field(n, 0));
    for (int j = 0; j < n; ++j) {
      dense[j][j] = L.diagonal[j];
      for (int e = L.start[j]; e < L.start[j + 1]; ++e) dense[L.row[e]][j] = L.value[e];
    }
    for (int i = 0; i < n; ++i)
      for (int e = A.start[i]; e < A.start[i + 1]; ++e)
        CHECK(std::abs(dotProduct(dense[i], dense[A.column[e]]) - A.value[e]) <
              1e-9 * largest(A.value));
  }

  TEST_CASE("solver: an indefinite matrix is shifted, or refused") {
    SparseMatrix A{{0, 2, 4}, {0, 1, 0, 1}, {1, 1.2, 1.2, 1}};
    CHECK(incompleteCholesky(A).shift > 0);
    A.value = {-1, 0, 0, -1};
    CHECK_THROWS_AS(incompleteCholesky(A), meccano::SolverError);
  }

  TEST_CASE("table: the part of a triangle above a level, against sampling") {
    for (double level : {-.1, .1, .35, .6, .9, 1.1}) {
      CAPTURE(level);
      int above = 0, all = 0;
      const int n = 400;
      for (int i = 0; i < n; ++i)
        for (int j = 0; i + j < n; ++j, ++all) {
          const double s = (i + 1. / 3) / n, t = (j + 1. / 3) / n;
          above += .2 * (1 - s - t) + 1 * s + .5 * t >= level;
        }
      CHECK(std::abs(partAbove({.2, 1, .5}, level) - double(above) / all) < 5e-3);
    }
  }

  TEST_CASE("pictures: the level set of a cone is a circle, with a hole where it is cut out") {
    Samples S{81, 81, Field(81 * 81)};
    for (int j = 0; j < 81; ++j)
      for (int i = 0; i < 81; ++i) {
        const double r = std::hypot(i - 40, j - 40);
        S.v[j * 81 + i] = r < 10 ? noValue : -r;
      }
    const std::string path = levelSet(S, -30);
    double area = 0;  // of the loops, by the shoelace formula; the hole turns the other way
    int loops = 0;
    std::istringstream in(path);
    std::vector<Vec2> p;
    for (char command; in >> command;) {
      if (command == 'Z') {
        for (std::size_t k = 0; k < p.size(); ++k) area += cross(p[k], p[(k + 1) % p.size()]) / 2;
        p.clear(), ++loops;
      } else {
        Vec2 q;
        in >> q.x >> q.y;
        p.push_back(q);
      }
    }
    CHECK(loops == 2);
    CHECK(std::abs(area) == doctest::Approx(3.14159265 * (900 - 106)).epsilon(.02));
  }

  TEST_CASE("program: files and table, twice the same bytes; its .vtk is read again") {
    const Folder folder;
    const Mesh M = sheared(island, {8, 8, 8});
    const std::string mesh = write(folder, "mesh.vtk", nodesOf(M));
    const Nodes again = readVtk(mesh);
    CHECK(again.tets == M.tets);
    CHECK(again.faces.at(-5) == meccano::surfaceFaces(M, -5));
    CHECK(norm(again.x[200] - M.x[200]) < 1e-5);
    const std::vector<std::string> words{mesh, "--end", "600", "-o"};
    auto in = [&](const char* name) {
      std::vector<std::string> all = words;
      all.push_back(folder / name);
      return call(all);
    };
    const Outcome a = in("a"), b = in("b");
    CHECK(a.status == 0);
    CHECK(a.out == b.out);
    CHECK(has(a.out, "lowest concentration"));
    CHECK(folder.files() == 1 + 2 * 7);
    for (const char* name : {"slice.svg", "layer-1.svg", "layer-2.svg", "layer-1.vtk",
                             "layer-2.vtk", "pollutant-5min.vtk", "pollutant-10min.vtk"}) {
      CAPTURE(name);
      const std::string text = readText(folder / ("a/" + std::string(name)));
      CHECK(text == readText(folder / ("b/" + std::string(name))));
      CHECK(!has(text, "nan"));
      if (has(name, "svg")) CHECK(text.size() < 300000);
    }
    CHECK(has(readText(folder / "a/layer-1.vtk"), "concentration_300s"));
    CHECK(readVtk(folder / "a/pollutant-5min.vtk").tets == M.tets);
  }

  TEST_CASE("program: terrain and layers from files, meshed by the library") {
    const Folder folder;
    std::string asc = "ncols 9\nnrows 9\nxllcorner 0\nyllcorner 0\ncellsize 1000\n", obj;
    for (int j = 8; j >= 0; --j)
      for (int i = 0; i < 9; ++i)
        asc += format("%g ", 300 * std::exp(-.2 * ((i - 4) * (i - 4) + (j - 4) * (j - 4))));
    for (int j = 0; j < 2; ++j)
      for (int i = 0; i < 2; ++i) obj += format("v %d %d 2100\n", 3500 + 2000 * i, 3500 + 2000 * j);
    writeFiles({{folder / "t.asc", asc}, {folder / "l.obj", obj + "f -4 -3 -1\nf 1/1 4/4 3/3\n"}});
    const Outcome o = call({folder / "t.asc", folder / "l.obj", "--lc", "1500", "--top", "4000",
                            "--end", "60", "-o", folder / "o", "--quiet"});
    CHECK(o.err == "");
    CHECK(o.status == 0);
    CHECK(folder.files() == 2 + 4);
  }

  TEST_CASE("program: one clear sentence for each bad input, exit status 1, nothing written") {
    const Folder folder;
    const Nodes good = nodesOf(sheared(island, {4, 4, 4}));
    Nodes noLayers = good, noTerrain = good, noSides = good, flatTet = good;
    noLayers.faces.erase(1), noLayers.faces.erase(2);
    noTerrain.faces.erase(-5);
    for (int side = -4; side < 0; ++side) noSides.faces.erase(side);
    flatTet.x[flatTet.tets[0][0]] = flatTet.x[flatTet.tets[0][1]];
    const std::string mesh = write(folder, "mesh.vtk", good);
    writeFiles({{folder / "text.vtk", "not a mesh"},
                {folder / "cut.vtk", readText(mesh).substr(0, 5000)}});
    const struct {
      std::vector<std::string> words;
      const char* sentence;
    } cases[] = {
        {{write(folder, "a.vtk", noLayers)}, "no layers"},
        {{write(folder, "b.vtk", noTerrain)}, "no terrain"},
        {{write(folder, "c.vtk", noSides)}, "no sides"},
        {{write(folder, "d.vtk", flatTet)}, "no volume"},
        {{folder / "none.vtk"}, "cannot be read"},
        {{folder / "text.vtk"}, "not a meccano .vtk"},
        {{folder / "cut.vtk"}, "truncated"},
        {{mesh, "--dt", "0"}, "--dt is 0, and must be above 0"},
        {{mesh, "--dt", "-1"}, "--dt is -1"},
        {{mesh, "--wind", "0"}, "--wind is 0, and must be above 0"},
        {{mesh, "--end", "0"}, "--end is 0"},
        {{mesh, "--decay", "-1"}, "--decay is -1, and must not be negative"},
        {{mesh, "--source", "0", "1", "0", "1", "0", "1"}, "source region"},
        {{mesh, "--source", "-6000", "-6000", "-2000", "2000", "0", "3000"}, "blows out"},
        {{mesh, "--end", "60", "-o", mesh + "/sub"}, "choose another folder"},
    };
    const int before = folder.files();
    for (const auto& c : cases) {
      CAPTURE(c.sentence);
      std::vector<std::string> words = c.words;
      if (std::find(words.begin(), words.end(), "-o") == words.end())
        words.insert(words.end(), {"-o", folder / "out"});
      const Outcome o = call(words);
      CHECK(o.status == 1);
      CHECK(o.out == "");
      CHECK(has(o.err, c.sentence));
      CHECK(std::count(o.err.begin(), o.err.end(), '\n') == 1);
      CHECK(folder.files() == before);
    }
  }

  TEST_CASE("program: wrong usage is exit status 2, --help 0") {
    CHECK(call({}).status == 2);
    CHECK(call({"a.vtk", "--nonsense"}).status == 2);
    CHECK(call({"a.vtk", "--wind"}).status == 2);
    CHECK(call({"a.vtk", "--wind", "strong"}).status == 2);
    CHECK(call({"a.asc", "b.obj"}).status == 2);
    const Outcome help = call({"--help"});
    CHECK(help.status == 0);
    for (const char* option : {"--wind", "--from", "--diffusion", "--deposition", "--decay",
                               "--source", "--dt", "--end"})
      CHECK(has(help.out, option));
  }
}
