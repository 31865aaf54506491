// SPDX-License-Identifier: MIT
//
// Section 4.3.2: a mass-consistent wind over the terrain carries a pollutant, which is deposited on
// it; its concentration is read off on the inserted layers. A host of the library: it needs
// meccano.hpp, insert.cpp and optimize.cpp, and nothing else.
//
//   1 mesh, 2 P1 elements, 3 wind [34, 35], 4 transport [36-38], 5 solver [39, 40], 6 table
//
// Metres, seconds, grams. Nodes are n, elements E; a Field is a number per node. Reading meshes and
// drawing pictures is in files.hpp.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <iostream>
#include <numeric>
#include <string>
#include <vector>

#include "files.hpp"

namespace pollutant {

using meccano::Mesh;
using meccano::SparseMatrix;

struct Settings {
  double wind = 4, from = 90, roughness = .1;    // m/s at 10 m; degrees, 90: from the east; z0, m
  std::array<double, 2> a{1, 1};                 // a_h, a_v of the wind's adjustment
  std::array<double, 2> K{10, 5};                // diffusion K = diag(K0, K0, K1), m^2/s
  double deposition = .5, decay = 0;             // V_d, m/s; 1/s
  double concentration = .5;                     // of the source, g/m^3
  std::array<double, 6> source{noValue};         // x0 x1 y0 y1 z0 z1; NaN: see Region
  double dt = 1e300, end = 3600;                 // s; the element Courant number stays <= 1 as well
  std::vector<double> outputs{300, 1800, 3600};  // s, as far as they are before the end
  bool limit = true;                             // see Transport::limit()
  double top = 8000, eps = 0, lc = 0;            // of a mesh made here, m
  std::array<double, 3> cells{0, 0, 0};  // its cubes; 0: near-cubic, 8 along the longer side
};

// ==== 1. The mesh ===============================================================================

/// The unit vector the wind blows along; `from` counts degrees from the north, y, to the east, x.
Vec3 windDirection(const Settings& s) {
  const double angle = s.from * (3.14159265358979323846 / 180);
  return {-std::sin(angle), -std::cos(angle), 0};
}

/// Where on the sides the pollutant enters: the box of the settings. [choice] Without one: the
/// middle third of the width the wind meets, up to midway between the two lowest layers (half above
/// a single one), so that the lower layer lies in the plume and the upper one above it.
struct Region {
  Vec3 e1{1, 0, 0}, e2{0, 1, 0};  // the first two coordinates
  bool aboveGround = false;       // the third is not z, but the height above ground
  Vec3 from, to;

  /// `level`: mean heights above ground of the layers, the lowest first.
  Region(const std::vector<Vec3>& x, const Field& level, const Settings& s) {
    if (const std::array<double, 6>& b = s.source; !std::isnan(b[0])) {
      from = {b[0], b[2], b[4]}, to = {b[1], b[3], b[5]};
      return;
    }
    constexpr double unbounded = 1e300;
    e2 = windDirection(s), e1 = {e2.y, -e2.x, 0}, aboveGround = true;
    double lo = unbounded, hi = -unbounded;
    for (Vec3 p : x) lo = std::min(lo, dot(e1, p)), hi = std::max(hi, dot(e1, p));
    from = {(2 * lo + hi) / 3, -unbounded, -unbounded};
    to = {(lo + 2 * hi) / 3, unbounded,
          level.size() > 1 ? (level[0] + level[1]) / 2 : 1.5 * level[0]};
  }
  Vec3 at(Vec3 p, double height) const {
    return {dot(e1, p), dot(e2, p), aboveGround ? height : p.z};
  }
  /// Whether it meets the box from a to b.
  bool meets(Vec3 a, Vec3 b) const {
    return a.x <= to.x && a.y <= to.y && a.z <= to.z && b.x >= from.x && b.y >= from.y &&
           b.z >= from.z;
  }
};

/// [choice] Bisects the sides' faces that meet the source, where the wind blows in, until their
/// edges are at most l_c: the cubes of the terrain's box may have no node between the ground and
/// the lower layer, and what the source lets in would depend on where its nodes happen to be.
void refineSource(Mesh& M, const meccano::Terrain& terrain, const Field& level, const Settings& s) {
  constexpr int bound = 60;  // rounds: three halve the edges, 2^20 to 1 is beyond any terrain
  const Region source(M.x, level, s);
  const Vec3 along = windDirection(s);
  std::vector<int> coarse{0};
  for (int round = 0; round < bound && !coarse.empty(); ++round) {
    coarse.clear();
    for (std::size_t E = 0; E < M.tets.size(); ++E)
      for (int i = 0; i < 4; ++i) {
        const int label = M.faceLabel[E][i];  // -1 .. -4: x-, x+, y-, y+
        if (label >= 0 || label < -4 ||
            (label % 2 != 0 ? 1 : -1) * (label >= -2 ? along.x : along.y) <= 0)
          continue;
        Vec3 a{1e300, 1e300, 1e300}, b = -a;
        double longest = 0;
        for (int j = 1; j < 4; ++j) {
          const Vec3 p = M.x[M.tets[E][(i + j) % 4]], next = M.x[M.tets[E][(i + j % 3 + 1) % 4]];
          const Vec3 q = source.at(p, p.z - heightAt(terrain, p.x, p.y));
          a = {std::min(a.x, q.x), std::min(a.y, q.y), std::min(a.z, q.z)};
          b = {std::max(b.x, q.x), std::max(b.y, q.y), std::max(b.z, q.z)};
          longest = std::max(longest, norm(next - p));
        }
        if (longest > s.lc && source.meets(a, b)) coarse.push_back(static_cast<int>(E));
      }
    std::sort(coarse.begin(), coarse.end());
    coarse.erase(std::unique(coarse.begin(), coarse.end()), coarse.end());
    meccano::bisect(M, coarse);
  }
}

/// [Section 4.3.1] The terrain's box by Algorithm 1, the layers inserted one after the other.
Nodes islandMesh(const std::vector<std::string>& files, const Settings& s, std::ostream& progress) {
  auto tell = [&](const std::string& line) { progress << line << std::endl; };
  meccano::Terrain terrain = readAsc(files[0]);
  terrain.top = s.top;
  for (int i = 0; i < 3; ++i) terrain.cells[i] = static_cast<int>(std::min(s.cells[i], 1e6));
  meccano::MesherOptions mesher;
  mesher.eps = s.eps > 0 ? s.eps : terrainEps(terrain);
  mesher.onProgress = tell;
  Mesh M;
  meccanoMesher(M, terrain, mesher);
  meccano::InsertOptions options;
  options.lc = s.lc;
  options.onProgress = tell;
  std::vector<meccano::TriangleSurface> layers;
  Field level;
  for (std::size_t i = 1; i < files.size(); ++i) {
    layers.push_back(readObj(files[i]));
    level.push_back(0);
    for (Vec3 p : layers.back().points)
      level.back() +=
          (p.z - heightAt(terrain, p.x, p.y)) / static_cast<double>(layers.back().points.size());
  }
  refineSource(M, terrain, level, s);
  insertSurfaces(M, layers, options);
  return nodesOf(M);
}

// ==== 2. P1 elements ============================================================================

/// The mesh with its elements' volumes and gradients, checked.
struct Domain : Nodes {
  std::vector<double> volume;             // [tets], m^3
  std::vector<std::array<Vec3, 4>> grad;  // [tets], ∇N of the four corners, 1/m
  std::vector<char> lateral, open;        // [nodes], on the sides; on the sides or the top
  Field height;                           // above the terrain, m
  int layers = 0;                         // inserted surfaces 1 .. layers

  explicit Domain(Nodes nodes);
};

Domain::Domain(Nodes nodes) : Nodes(std::move(nodes)), lateral(x.size(), 0), open(x.size(), 0) {
  if (!faces.count(terrainLabel))
    throw InputError("the mesh has no terrain: no triangle has the label -5 (patch z-)");
  while (faces.count(layers + 1)) ++layers;
  if (layers == 0)
    throw InputError("the mesh has no layers: insert one or two surfaces first (labels 1, 2)");
  for (int label = topLabel; label < 0; ++label)
    for (const Triangle& t : faces[label])
      for (int n : t) open[n] |= label != terrainLabel, lateral[n] |= label > terrainLabel;
  if (std::count(lateral.begin(), lateral.end(), 1) == 0)
    throw InputError("the mesh has no sides: no triangle has a label from -1 to -4");
  for (std::size_t E = 0; E < tets.size(); ++E) {
    const std::array<int, 4>& z = tets[E];
    const meccano::Mat3 J{x[z[1]] - x[z[0]], x[z[2]] - x[z[0]], x[z[3]] - x[z[0]]};
    const double six = det(J);
    volume.push_back(std::abs(six) / 6);
    if (!(volume[E] > 0))
      throw InputError("tetrahedron " + std::to_string(E) + " has no volume; optimize the mesh");
    const meccano::Mat3 g = (1 / six) * cofactor(J);  // columns: J^-T e_i
    grad.push_back({-(g.c0 + g.c1 + g.c2), g.c0, g.c1, g.c2});
  }
  height = heightsAbove(x, faces[terrainLabel]);
}

/// The zero matrix with an entry for each two nodes of a tetrahedron.
SparseMatrix pattern(const Domain& D) {
  std::vector<std::vector<int>> rows(D.x.size());
  for (const std::array<int, 4>& z : D.tets)
    for (int i : z) rows[i].insert(rows[i].end(), z.begin(), z.end());
  SparseMatrix A{{0}, {}, {}};
  for (std::vector<int>& row : rows) {
    std::sort(row.begin(), row.end());
    A.column.insert(A.column.end(), row.begin(), std::unique(row.begin(), row.end()));
    A.start.push_back(static_cast<int>(A.column.size()));
  }
  A.value.assign(A.column.size(), 0);
  return A;
}

double& entry(SparseMatrix& A, int i, int j) {
  const auto row = A.column.begin() + A.start[i], end = A.column.begin() + A.start[i + 1];
  return A.value[std::lower_bound(row, end, j) - A.column.begin()];
}

Field multiply(const SparseMatrix& A, const Field& x) {
  Field y(x.size(), 0);
  for (std::size_t i = 0; i < x.size(); ++i)
    for (int e = A.start[i]; e < A.start[i + 1]; ++e) y[i] += A.value[e] * x[A.column[e]];
  return y;
}

Vec3 scaled(Vec3 T, Vec3 g) { return {T.x * g.x, T.y * g.y, T.z * g.z}; }

/// D_ij = ∫ ∇N_i·T∇N_j
SparseMatrix stiffness(const Domain& D, Vec3 T) {
  SparseMatrix A = pattern(D);
  for (std::size_t E = 0; E < D.tets.size(); ++E)
    for (int i = 0; i < 4; ++i)
      for (int j = 0; j < 4; ++j)
        entry(A, D.tets[E][i], D.tets[E][j]) +=
            D.volume[E] * dot(D.grad[E][i], scaled(T, D.grad[E][j]));
  return A;
}

/// ∫ N_i: the volume that belongs to a node.
Field nodeVolumes(const Domain& D) {
  Field m(D.x.size(), 0);
  for (std::size_t E = 0; E < D.tets.size(); ++E)
    for (int n : D.tets[E]) m[n] += D.volume[E] / 4;
  return m;
}

// The solver, Section 5.

/// L of A ~ L L^T by columns: the diagonal, then the entries below it in ascending rows.
struct Factor {
  std::vector<int> start{0}, row;
  std::vector<double> value, diagonal;
  double shift = 0;  // A + shift diag(A) was factorized
};
Factor incompleteCholesky(const SparseMatrix& A, int fill = 0);
int solveCG(const SparseMatrix& A, const Factor& L, const Field& b, Field& x, double tolerance);
SparseMatrix constrained(const SparseMatrix& A, const std::vector<char>& fixed);
Field constrainedRightSide(const SparseMatrix& A, const std::vector<char>& fixed, const Field& b,
                           const Field& value);

// ==== 3. Mass-consistent wind [34, 35] ==========================================================

struct Wind {
  std::vector<Vec3> u;      // [tets], m/s
  std::vector<Vec3> nodal;  // [nodes], lumped average of u
  Field phi;
  Field flux;           // F_i = ∫ u·∇N_i, m^3/s: on the open boundary the outflow of node i
  double residual = 0;  // |F| / |F of u0| over the nodes where F has to vanish
  int iterations = 0;
};

/// u0 = u*/κ ln((z + z0)/z0) above ground, at the centroids. [choice] u* such that |u0| is the
/// given speed at 10 m, the height at which winds are measured.
std::vector<Vec3> logarithmicWind(const Domain& D, const Settings& s) {
  constexpr double anemometer = 10;  // m
  const Vec3 direction = windDirection(s);
  const double overKappa = s.wind / std::log((anemometer + s.roughness) / s.roughness);  // u*/κ
  std::vector<Vec3> u0;
  for (const std::array<int, 4>& z : D.tets) {
    const double h = (D.height[z[0]] + D.height[z[1]] + D.height[z[2]] + D.height[z[3]]) / 4;
    u0.push_back(overKappa * std::log((h + s.roughness) / s.roughness) * direction);
  }
  return u0;
}

/// F_i = ∫ u·∇N_i
Field fluxes(const Domain& D, const std::vector<Vec3>& u) {
  Field F(D.x.size(), 0);
  for (std::size_t E = 0; E < D.tets.size(); ++E)
    for (int i = 0; i < 4; ++i) F[D.tets[E][i]] += D.volume[E] * dot(u[E], D.grad[E][i]);
  return F;
}

/// The u = u0 + T∇φ nearest to u0 with ∫ u·∇w = 0 for every w that vanishes, like φ, on the sides
/// and the top: ∫ T∇φ·∇w = −∫ u0·∇w. The terrain is impermeable by itself, for w does not
/// vanish
/// there: ∫ u·∇w = ∮ w u·n.
Wind massConsistentWind(const Domain& D, const std::vector<Vec3>& u0, double ah, double av) {
  constexpr double tolerance = 1e-10;  // the transported mass is kept to this, so below the 1e-8
  constexpr int fill = 5;  // density type: 67 iterations, not 106; the transport gains nothing
  const Vec3 T{1 / (2 * ah * ah), 1 / (2 * ah * ah), 1 / (2 * av * av)};
  const SparseMatrix A = stiffness(D, T);
  const Field zero(D.x.size(), 0), F0 = fluxes(D, u0);
  Field minusF0 = F0;
  for (double& f : minusF0) f = -f;
  Wind W{u0, std::vector<Vec3>(D.x.size()), zero, {}};
  const SparseMatrix inner = constrained(A, D.open);
  W.iterations = solveCG(inner, incompleteCholesky(inner, fill),
                         constrainedRightSide(A, D.open, minusF0, zero), W.phi, tolerance);
  for (std::size_t E = 0; E < D.tets.size(); ++E)
    for (int i = 0; i < 4; ++i) W.u[E] += W.phi[D.tets[E][i]] * scaled(T, D.grad[E][i]);
  W.flux = fluxes(D, W.u);
  double rest = 0, start = 0;
  for (std::size_t n = 0; n < D.x.size(); ++n)
    if (!D.open[n]) rest += W.flux[n] * W.flux[n], start += F0[n] * F0[n];
  W.residual = start > 0 ? std::sqrt(rest / start) : 0;
  const Field m = nodeVolumes(D);
  for (std::size_t E = 0; E < D.tets.size(); ++E)
    for (int n : D.tets[E]) W.nodal[n] += (D.volume[E] / 4 / m[n]) * W.u[E];
  return W;
}

// ==== 4. Transport [36-38] ======================================================================

/// The nodes of the open boundary through which the wind enters.
std::vector<char> inflowNodes(const Domain& D, const Wind& W) {
  constexpr double rounding = 1e-9;  // of the largest flux: below it a sign means nothing
  double most = 0;
  for (double F : W.flux) most = std::max(most, std::abs(F));
  std::vector<char> inflow(D.open);
  for (std::size_t n = 0; n < inflow.size(); ++n) inflow[n] &= W.flux[n] < -rounding * most;
  return inflow;
}

/// Where the pollutant enters: the inflow nodes of the sides in the source's region.
std::vector<int> sourceNodes(const Domain& D, const Wind& W, const Settings& s) {
  Field level;
  for (int k = 1; k <= D.layers; ++k) {
    level.push_back(0);
    for (const Triangle& t : D.faces.at(k))
      level.back() += D.height[t[0]] / static_cast<double>(D.faces.at(k).size());
  }
  const Region region(D.x, level, s);
  const std::vector<char> inflow = inflowNodes(D, W);
  std::vector<int> inside, nodes;
  for (std::size_t n = 0; n < D.x.size(); ++n) {
    const Vec3 p = region.at(D.x[n], D.height[n]);
    if (!D.lateral[n] || !region.meets(p, p)) continue;
    inside.push_back(static_cast<int>(n));
    if (inflow[n]) nodes.push_back(static_cast<int>(n));
  }
  if (inside.empty())
    throw InputError("the source region holds no node of the sides of the domain; move --source");
  if (nodes.empty())
    throw InputError(
        "the wind blows out through the whole source region; move --source or turn --from");
  return nodes;
}

/// The largest dt with the element Courant number dt/2 Σ_i |u·∇N_i| <= 1: the time in which
/// the wind crosses an element.
double courantStep(const Domain& D, const std::vector<Vec3>& u) {
  double rate = 0;
  for (std::size_t E = 0; E < D.tets.size(); ++E) {
    double sum = 0;
    for (int i = 0; i < 4; ++i) sum += std::abs(dot(u[E], D.grad[E][i]));
    rate = std::max(rate, sum / 2);
  }
  return 1 / rate;
}

/// Mass balance in g: stored = in - out - deposited - decayed, but for the solver's residuals. In
/// is what enters through the inflow, out what leaves through the outflow.
struct Balance {
  double in = 0, out = 0, deposited = 0, decayed = 0, stored = 0;
  double error() const { return std::abs(stored - (in - out - deposited - decayed)) / in; }
};

/// One step of least squares [38] with Crank-Nicolson. With R = (c1 − c0)/dt + u·∇(c1 + c0)/2 the
/// functional ∫ (dt R)² is least where ∫ dt R (w + dt/2 u·∇w) = 0 for every w. Diffusion,
/// deposition and decay are added in weak form, tested with w alone and taken at c1:
///   [M + dt/2 (C + Cᵀ) + dt²/4 S + dt D + dt V_d M_G + dt decay M] c1
///                                                = [M − dt/2 (C − Cᵀ) − dt²/4 S] c0
/// M_ij = ∫ N_i N_j, C_ij = ∫ N_i u·∇N_j, S_ij = ∫ (u·∇N_i)(u·∇N_j),
/// D_ij = ∫ ∇N_i·K∇N_j, M_G the
/// mass of the terrain. Symmetric and positive definite: without the last three it is the Gram
/// matrix of w + dt/2 u·∇w.
/// [departure] [36, 37] print more than the paper does: Crank-Nicolson for diffusion too, chemistry
/// by operator splitting, the rise of plumes, a mesh that follows them. Here the terms beside the
/// wind are implicit, which damps them at any dt (V_d dt is not small against the elements on the
/// terrain), least squares sees the wind alone (second derivatives of P1 functions vanish), and the
/// one reaction is decay of first order.
struct Transport {
  const Domain& D;
  Field F;  // fluxes of the wind
  double dt;
  Settings s;
  std::vector<char> fixed;  // [nodes], 1 clean inflow, 2 source
  Field value;              // there
  Field m, mTerrain;        // ∫ N_i over the volume, over the terrain
  SparseMatrix mass, A, B;  // M, left and right side
  SparseMatrix inner;       // A with identity rows where fixed
  Factor L;

  Transport(const Domain& domain, const Wind& W, const std::vector<int>& source, double step,
            const Settings& settings);
  int step(Field& c, Balance& balance, double tolerance = 1e-8) const;
  void limit(Field& c, double most) const;
};

Transport::Transport(const Domain& domain, const Wind& W, const std::vector<int>& source,
                     double step, const Settings& settings)
    : D(domain),
      F(W.flux),
      dt(step),
      s(settings),
      fixed(inflowNodes(D, W)),
      value(D.x.size(), 0),
      m(nodeVolumes(D)),
      mTerrain(D.x.size(), 0),
      mass(pattern(D)),
      A(mass),
      B(mass) {
  for (int n : source) value[n] = s.concentration;
  for (std::size_t E = 0; E < D.tets.size(); ++E) {
    const double V = D.volume[E];
    std::array<double, 4> a;  // u·∇N_i
    for (int i = 0; i < 4; ++i) a[i] = dot(W.u[E], D.grad[E][i]);
    for (int i = 0; i < 4; ++i)
      for (int j = 0; j < 4; ++j) {
        const double M = V / 20 * (i == j ? 2 : 1), C = V / 4 * a[j], CT = V / 4 * a[i];
        const double S = V * a[i] * a[j];
        const double K = V * dot(D.grad[E][i], scaled({s.K[0], s.K[0], s.K[1]}, D.grad[E][j]));
        entry(mass, D.tets[E][i], D.tets[E][j]) += M;
        entry(A, D.tets[E][i], D.tets[E][j]) +=
            M * (1 + dt * s.decay) + dt / 2 * (C + CT) + dt * dt / 4 * S + dt * K;
        entry(B, D.tets[E][i], D.tets[E][j]) += M - dt / 2 * (C - CT) - dt * dt / 4 * S;
      }
  }
  for (const Triangle& t : D.faces.at(terrainLabel)) {
    const double area = areaOf(D, t);
    for (int i : t) mTerrain[i] += area / 3;
    for (int i : t)
      for (int j : t) entry(A, i, j) += dt * s.deposition * area / 12 * (i == j ? 2 : 1);
  }
  inner = constrained(A, fixed);
  L = incompleteCholesky(inner);
}

/// Sums of the rows give the balance: Σ_i (A c1 - B c0)_i is the change of the stored mass plus
/// dt Σ_j F_j (c0 + c1)_j / 2, what was deposited and what decayed; it vanishes at free nodes, so
/// the rows of fixed ones are what these let in beyond their advective F_j. F_j is 0 inside and on
/// the terrain: with the mass-consistent wind the scheme keeps mass to the solver's residual.
int Transport::step(Field& c, Balance& balance, double tolerance) const {
  const Field c0 = c, right = multiply(B, c0);
  for (std::size_t n = 0; n < c.size(); ++n)
    if (fixed[n]) c[n] = value[n];
  const int iterations =
      solveCG(inner, L, constrainedRightSide(A, fixed, right, value), c, tolerance);
  const Field left = multiply(A, c);
  balance.stored = 0;
  for (std::size_t n = 0; n < c.size(); ++n) {
    const double through = dt * F[n] * (c0[n] + c[n]) / 2;
    balance.stored += m[n] * c[n];
    balance.deposited += dt * s.deposition * mTerrain[n] * c[n];
    balance.decayed += dt * s.decay * m[n] * c[n];
    if (fixed[n]) balance.in += left[n] - right[n] - through;
    if (!fixed[n] && D.open[n]) balance.out += through;
  }
  if (s.limit) limit(c, std::max(s.concentration, *std::max_element(c0.begin(), c0.end())));
  return iterations;
}

/// [departure] Least squares damps little where the local Courant number is small, across the wind
/// and at the terrain: fronts there under- and overshoot by 10 to 30 % of the source. As in flux-
/// corrected transport (Zalesak 1979), c is split into its average by the mass matrix,
/// c_i - Σ_j f_ij / m_i, and the fluxes f_ij = M_ij (c_i - c_j) back to it, which are taken only
/// as far as they keep c in [0, most]. What one node gains another loses, so mass is kept; where c
/// is within the bounds nothing changes.
void Transport::limit(Field& c, double most) const {
  Field low = c, up(c.size(), 0), down(c.size(), 0);
  auto forPairs = [&](auto flux) {
    for (std::size_t i = 0; i < c.size(); ++i)
      for (int e = mass.start[i]; e < mass.start[i + 1] && !fixed[i]; ++e)
        if (!fixed[mass.column[e]])
          flux(i, mass.column[e], mass.value[e] * (c[i] - c[mass.column[e]]));
  };
  forPairs([&](std::size_t i, int, double f) { low[i] -= f / m[i], (f > 0 ? up : down)[i] += f; });
  for (std::size_t i = 0; i < c.size(); ++i) {  // parts of the fluxes that node i bears
    up[i] = up[i] > 0 ? std::clamp(m[i] * (most - low[i]) / up[i], 0., 1.) : 1;
    down[i] = down[i] < 0 ? std::clamp(m[i] * (0 - low[i]) / down[i], 0., 1.) : 1;
  }
  Field limited = c;
  forPairs([&](std::size_t i, int j, double f) {
    const double part = f > 0 ? std::min(up[i], down[j]) : std::min(down[i], up[j]);
    limited[i] -= (1 - part) * f / m[i];
  });
  c = limited;
}

// ==== 5. Conjugate gradients with incomplete Cholesky [39, 40] ==================================

/// A with identity rows and columns where fixed, so that it stays symmetric.
SparseMatrix constrained(const SparseMatrix& A, const std::vector<char>& fixed) {
  SparseMatrix inner = A;
  for (std::size_t i = 0; i < fixed.size(); ++i)
    for (int e = A.start[i]; e < A.start[i + 1]; ++e)
      if (fixed[i] || fixed[A.column[e]])
        inner.value[e] = A.column[e] == static_cast<int>(i) ? 1 : 0;
  return inner;
}

/// b - A value in the free rows, the value itself in the fixed ones; value is 0 at free nodes.
Field constrainedRightSide(const SparseMatrix& A, const std::vector<char>& fixed, const Field& b,
                           const Field& value) {
  const Field known = multiply(A, value);
  Field right = b;
  for (std::size_t i = 0; i < b.size(); ++i) right[i] = fixed[i] ? value[i] : b[i] - known[i];
  return right;
}

/// Column by column, left-looking. fill = 0: IC(0), the pattern of A. fill = p > 0: the density
/// type of Lin and More, the n_j + p largest entries of column j, n_j being those of A. False where
/// a pivot is not positive.
bool factorize(const SparseMatrix& A, int fill, double shift, Factor& L) {
  const int n = static_cast<int>(A.start.size()) - 1;
  L = Factor{};
  L.shift = shift;
  std::vector<int> first(n, -1), next(n), at(n), mark(n, -1), rows;  // first: columns met in row j
  std::vector<double> w(n, 0);
  for (int j = 0; j < n; ++j) {
    double pivot = 0, diagonal = 0;
    rows.clear();
    for (int e = A.start[j]; e < A.start[j + 1]; ++e) {
      const int i = A.column[e];
      if (i == j) diagonal = A.value[e], pivot = (1 + shift) * diagonal;
      if (i > j) w[i] = A.value[e], mark[i] = j, rows.push_back(i);
    }
    const std::size_t keep = rows.size() + fill;
    for (int k = first[j], after; k >= 0; k = after) {  // w -= L_jk L(:, k)
      after = next[k];
      const double Ljk = L.value[at[k]];
      pivot -= Ljk * Ljk;
      for (int e = ++at[k]; e < L.start[k + 1]; ++e) {
        const int i = L.row[e];
        if (mark[i] != j) {
          if (fill == 0) continue;
          w[i] = 0, mark[i] = j, rows.push_back(i);
        }
        w[i] -= Ljk * L.value[e];
      }
      if (at[k] < L.start[k + 1]) next[k] = first[L.row[at[k]]], first[L.row[at[k]]] = k;
    }
    constexpr double least = 1e-12;  // relative to the diagonal: below it the pivot is rounding
    if (!(pivot > least * diagonal)) return false;
    if (rows.size() > keep) {
      std::nth_element(rows.begin(), rows.begin() + keep, rows.end(),
                       [&](int a, int b) { return std::abs(w[a]) > std::abs(w[b]); });
      rows.resize(keep);
    }
    std::sort(rows.begin(), rows.end());
    L.diagonal.push_back(std::sqrt(pivot));
    at[j] = L.start[j];
    for (int i : rows) L.row.push_back(i), L.value.push_back(w[i] / L.diagonal[j]);
    L.start.push_back(static_cast<int>(L.row.size()));
    if (!rows.empty()) next[j] = first[rows[0]], first[rows[0]] = j;
  }
  return true;
}

Factor incompleteCholesky(const SparseMatrix& A, int fill) {
  Factor L;
  double shift = 0;
  for (int i = 0; i < 20; ++i, shift = std::max(1e-3, 2 * shift))  // 1e-3: the first of Lin, More
    if (factorize(A, fill, shift, L)) return L;
  throw meccano::SolverError(format("incompleteCholesky: no factor with a shift up to %g", shift));
}

/// z = (L L^T)^-1 r
Field precondition(const Factor& L, const Field& r) {
  Field z = r;
  const int n = static_cast<int>(r.size());
  for (int j = 0; j < n; ++j) {
    z[j] /= L.diagonal[j];
    for (int e = L.start[j]; e < L.start[j + 1]; ++e) z[L.row[e]] -= L.value[e] * z[j];
  }
  for (int j = n - 1; j >= 0; --j) {
    for (int e = L.start[j]; e < L.start[j + 1]; ++e) z[j] -= L.value[e] * z[L.row[e]];
    z[j] /= L.diagonal[j];
  }
  return z;
}

double dotProduct(const Field& a, const Field& b) {
  return std::inner_product(a.begin(), a.end(), b.begin(), 0.);
}

/// A x = b, from x, until |b - A x| <= tolerance |b|; returns the iterations.
int solveCG(const SparseMatrix& A, const Factor& L, const Field& b, Field& x, double tolerance) {
  constexpr int bound = 2000;  // ten times what 200k tetrahedra need
  Field r = multiply(A, x);
  for (std::size_t i = 0; i < b.size(); ++i) r[i] = b[i] - r[i];
  Field z = precondition(L, r), p = z;
  const double target = tolerance * std::sqrt(dotProduct(b, b));
  double rz = dotProduct(r, z);
  for (int iteration = 0; iteration < bound; ++iteration) {
    if (std::sqrt(dotProduct(r, r)) <= target) return iteration;
    const Field q = multiply(A, p);
    const double alpha = rz / dotProduct(p, q);
    for (std::size_t i = 0; i < b.size(); ++i) x[i] += alpha * p[i], r[i] -= alpha * q[i];
    z = precondition(L, r);
    const double rzNew = dotProduct(r, z), beta = rzNew / rz;
    rz = rzNew;
    for (std::size_t i = 0; i < b.size(); ++i) p[i] = z[i] + beta * p[i];
  }
  throw meccano::SolverError(format("solveCG: residual %g of %g after %d iterations",
                                    std::sqrt(dotProduct(r, r)), target, bound));
}

// ==== 6. Table ==================================================================================

/// A moment of the output.
struct Snapshot : Moment {
  Balance balance;
};

std::string table(const Domain& D, const Settings& s, const std::vector<Snapshot>& moments) {
  std::string out = "layer      min   mean g/m3    max g/m3  covered km2            front\n";
  for (int layer = 1; layer <= D.layers; ++layer)
    for (const Snapshot& at : moments)
      out += layerRow(D, layer, at, windDirection(s), s.concentration);
  out +=
      "\nmass (t)    min           in          out    deposited      decayed       stored  error\n";
  for (const Snapshot& at : moments) {
    const Balance& b = at.balance;
    out += format("%15.4g %12.6g %12.6g %12.6g %12.6g %12.6g %6.1g\n", at.time / 60, b.in / 1e6,
                  b.out / 1e6, b.deposited / 1e6, b.decayed / 1e6, b.stored / 1e6, b.error());
  }
  return out;
}

// ==== The program ===============================================================================

/// Steps to each moment of the output; each stretch has a dt of its own, so that steps end there.
/// `progress` gets a line every five minutes, `least` the lowest concentration met.
std::vector<Snapshot> simulate(const Domain& D, const Wind& W, const std::vector<int>& source,
                               const Settings& s, std::ostream& progress, double& least) {
  constexpr double report = 300;  // s
  Field c(D.x.size(), 0);
  Balance balance;
  const Field m = nodeVolumes(D);
  for (int n : source) c[n] = s.concentration, balance.in += m[n] * c[n];  // the release begins
  std::vector<double> stops;
  for (double t : s.outputs)
    if (t < s.end) stops.push_back(t);
  stops.push_back(s.end);
  const double courant = courantStep(D, W.u), longest = std::min(s.dt, courant);
  constexpr double mostSteps = 1e6;  // a day of computing
  if (!(s.end / longest < mostSteps))
    throw InputError(
        format("%g s in steps of %g s are too many; change --end or --dt", s.end, longest));
  std::vector<Snapshot> moments;
  double from = 0;
  int iterations = 0, since = 0;
  for (double to : stops) {
    const int steps = static_cast<int>(std::ceil((to - from) / longest));
    const Transport P(D, W, source, (to - from) / steps, s);
    progress << format("%d steps of %.4g s to %g min: element Courant number %.3f\n", steps, P.dt,
                       to / 60, P.dt / courant);
    for (int i = 1; i <= steps; ++i) {
      iterations += P.step(c, balance), ++since;
      least = std::min(least, *std::min_element(c.begin(), c.end()));
      const double t = from + i * P.dt;
      if (i < steps && std::floor(t / report) == std::floor((t - P.dt) / report)) continue;
      progress << format("%5.1f of %g min, %.1f iterations per step", t / 60, s.end / 60,
                         double(iterations) / since)
               << std::endl;
      iterations = since = 0;
    }
    moments.push_back({{to, c}, balance});
    from = to;
  }
  return moments;
}

std::vector<Option> optionsFor(Settings& s) {
  const Option::Range above = Option::above0, from0 = Option::from0, any = Option::any;
  return {{"--wind", "U", "wind 10 m above ground, m/s (4)", above, &s.wind},
          {"--from", "DEGREES", "where it comes from: 0 north, 90 east (90)", any, &s.from},
          {"--roughness", "Z0", "of its logarithmic profile, m (.1)", above, &s.roughness},
          {"--stability", "AH AV", "a_h, a_v of its adjustment (1 1)", above, s.a.data(), 2},
          {"--diffusion", "KH KV", "horizontal, vertical, m^2/s (10 5)", from0, s.K.data(), 2},
          {"--deposition", "VD", "dry deposition velocity, m/s (.5)", from0, &s.deposition},
          {"--decay", "RATE", "of first order, 1/s (0)", from0, &s.decay},
          {"--concentration", "C", "at the source, g/m^3 (.5)", above, &s.concentration},
          {"--source", "X0 X1 Y0 Y1 Z0 Z1", "box around it (a third of the sea's side)", any,
           s.source.data(), 6},
          {"--dt", "S", "longest time step, s (Courant number 1)", above, &s.dt},
          {"--end", "S", "time simulated, s (3600)", above, &s.end},
          {"--top", "Z", "top of the box above a terrain, m (8000)", any, &s.top},
          {"--cells", "NX NY NZ", "cubes of that box (8 along its longer side)", above,
           s.cells.data(), 3},
          {"--eps", "E", "distance from the terrain, m (.002 of the diagonal)", above, &s.eps},
          {"--lc", "L", "l_c of the layers, m", above, &s.lc}};
}

constexpr const char* usage =
    "usage: pollutant MESH.vtk [options]\n"
    "       pollutant TERRAIN.asc LAYER.obj ... --lc L [options]\n\n"
    "Wind over a terrain carries a pollutant for an hour; its concentration on the layers\n"
    "inserted in the mesh goes into a table, .vtk files and pictures (Section 4.3.2).\n\n"
    "  -o FOLDER                     where the files go (build/pollutant)\n"
    "  --no-limit                    least squares alone, with their under- and overshoots\n"
    "  --quiet                       no progress on standard error\n";

void runSimulation(const Settings& s, const Words& words, std::ostream& out,
                   std::ostream& progress) {
  const bool isMesh = words.operands.size() == 1;
  const Domain D(isMesh ? readVtk(words.operands[0]) : islandMesh(words.operands, s, progress));
  const Wind W = massConsistentWind(D, logarithmicWind(D, s), s.a[0], s.a[1]);
  const std::vector<int> source = sourceNodes(D, W, s);
  const std::string folder = checkFolder(words.folder);
  progress << format("%zu tetrahedra, %zu nodes, %d layers; wind: %d iterations\n", D.tets.size(),
                     D.x.size(), D.layers, W.iterations);
  double least = 0;
  const std::vector<Snapshot> snapshots = simulate(D, W, source, s, progress, least);
  const std::vector<Moment> moments(snapshots.begin(), snapshots.end());

  const Vec2 along{windDirection(s).x, windDirection(s).y};
  Vec2 middle;  // of the source
  for (int n : source)
    middle = middle + 1. / static_cast<double>(source.size()) * Vec2{D.x[n].x, D.x[n].y};
  std::vector<Output> files;
  files.push_back({folder + "/slice.svg", sliceSvg(D, middle, along, moments, s.concentration)});
  for (const Moment& at : moments)
    files.push_back(
        {folder + format("/pollutant-%gmin.vtk", at.time / 60), volumeVtk(D, W.nodal, at)});
  for (int k = 1; k <= D.layers; ++k) {
    files.push_back({folder + format("/layer-%d.vtk", k), layerVtk(D, k, moments)});
    files.push_back(
        {folder + format("/layer-%d.svg", k), layerSvg(D, k, moments, s.concentration)});
  }
  writeFiles(files);
  out << format("divergence of the wind: %.1e of that of the logarithmic profile\n", W.residual)
      << table(D, s, snapshots)
      << format("lowest concentration: %.2f %% of the source's\n", 100 * least / s.concentration);
}

int run(const std::vector<std::string>& arguments, std::ostream& out, std::ostream& err) {
  try {
    Settings s;
    const std::vector<Option> options = optionsFor(s);
    const Words words = parseWords(arguments, options);
    if (words.help) return out << helpText(usage, options), 0;
    s.limit = !words.noLimit;
    if (words.operands.empty()) throw UsageError("name a mesh, or a terrain and its layers");
    if (words.operands.size() > 1 && !(s.lc > 0)) throw UsageError("layers need --lc");
    std::ostream silence(nullptr);
    runSimulation(s, words, out, words.quiet ? silence : err);
    return 0;
  } catch (const UsageError& e) {
    err << "pollutant: " << e.what() << "; see --help\n";
    return 2;
  } catch (const std::exception& e) {
    err << "pollutant: " << e.what() << "\n";
    return 1;
  }
}

}  // namespace pollutant

#ifndef POLLUTANT_NO_MAIN
int main(int argc, char** argv) {
  return pollutant::run({argv + 1, argv + argc}, std::cout, std::cerr);
}
#endif
