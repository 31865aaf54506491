// SPDX-License-Identifier: MIT
//
// Section 3.7, mesh optimization, and the statistics of Table I.
//
//   3.7.1  shape distortion η, quality q, regularized determinant h          eq. (5)–(8)
//   3.7.2  objective function of a node: closed form, gradient, Hessian      eq. (9)
//   3.7.3  objective function of surface and curve nodes                     eq. (10), (11)
//   3.7.4  Newton, strong Wolfe, Algorithm 2; the global descent, the worst elements
//   4      Table I
//
// The time goes into smoothNode(): one pass over the elements of a star for f, its gradient and its
// Hessian (a cube root each), one more for the trial step where one is needed.
#include <atomic>
#include <cfloat>
#include <condition_variable>
#include <cstddef>
#include <cstdio>
#include <cstring>
#include <exception>
#include <limits>
#include <map>
#include <mutex>
#include <numeric>
#include <system_error>
#include <thread>
#include <tuple>

#include "meccano.hpp"

// Compiled by g++ twice, for every x86-64 and for AVX2: the program takes what the machine has.
// Both give the same bytes, for AVX2 has no fused operations and nothing is reordered. (The choice
// is made before the thread sanitizer starts, which would crash in it.)
#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__UCLIBC__) && defined(__GNUC__) && \
    !defined(__clang__) && !defined(__INTEL_COMPILER) && !defined(__NVCOMPILER) &&            \
    !defined(__SANITIZE_THREAD__)
#define MECCANO_AVX2_TOO [[gnu::target_clones("avx2", "default")]]
#else
#define MECCANO_AVX2_TOO
#endif

namespace meccano {
namespace {

constexpr double unbounded = std::numeric_limits<double>::infinity();  // η of an inverted element

}  // namespace

// ==== 3.7.1 Regularized shape distortion measure ================================================

double eta(const Mat3& J) {
  const double sigma = std::abs(det(J));
  return sigma > 0 ? norm2(J) / (3 * std::cbrt(sigma * sigma)) : unbounded;  // eq. (5)
}

Mat3 jacobian(const std::array<Vec3, 4>& ideal, const std::array<Vec3, 4>& physical) {
  const Mat3 I{ideal[1] - ideal[0], ideal[2] - ideal[0], ideal[3] - ideal[0]};
  const Mat3 P{physical[1] - physical[0], physical[2] - physical[0], physical[3] - physical[0]};
  return P * inverse(I);  // eq. (6): the affine map takes each edge of E^I to its edge of E^P
}

double quality(const Mat3& J) {
  const double q = det(J) > 0 ? 1 / eta(J) : 0;  // eq. (7)
  return q > 0 ? q : 0;                          // no number where det(J) overflows
}

double h(double sigma, double delta) {
  const double R = std::sqrt(sigma * sigma + 4 * delta * delta);
  if (sigma >= 0) return (sigma + R) / 2;  // eq. (8)
  return 2 * delta * delta / (R - sigma);  // eq. (8) times (R − σ)/(R − σ)
}

double etaRegularized(const Mat3& J, double delta) {
  const double hs = h(det(J), delta);
  return hs > 0 ? norm2(J) / (3 * std::cbrt(hs * hs)) : unbounded;
}

double chooseDelta(double sigmaMin, double mu) {
  return sigmaMin > 0 ? 0 : std::sqrt(mu * (mu - sigmaMin));  // h(σ_min) = μ
}

// ==== Tools for 3.7.2: ideal elements ===========================================================

namespace {

double signedVolume6(const std::array<Vec3, 4>& z) {
  return dot(z[1] - z[0], cross(z[2] - z[0], z[3] - z[0]));
}

std::array<Vec3, 4> cornersOf(const std::vector<Vec3>& x, const std::array<int, 4>& tet) {
  return {x[tet[0]], x[tet[1]], x[tet[2]], x[tet[3]]};
}

/// The ideal elements of a mesh. [choice] A regular one is oriented as the computational element,
/// where there is none as most of the mesh.
struct IdealElements {
  const Mesh& M;
  bool computational;
  double orientation = 0;  // of the mesh, where it has no computational elements

  IdealElements(const Mesh& mesh, Ideal ideal)
      : M(mesh), computational(ideal == Ideal::computational && !mesh.xi.empty()) {
    if (!M.xi.empty()) return;
    for (const std::array<int, 4>& tet : M.tets) orientation += signedVolume6(cornersOf(M.x, tet));
  }
  std::array<Vec3, 4> of(std::size_t E) const {
    const std::array<int, 4>& tet = M.tets[E];
    if (computational) return cornersOf(M.xi, tet);
    std::array<Vec3, 4> regular{{{0, 0, 0}, {0, 1, 1}, {1, 0, 1}, {1, 1, 0}}};
    const double sign = M.xi.empty() ? orientation : signedVolume6(cornersOf(M.xi, tet));
    if (sign < 0) std::swap(regular[2], regular[3]);
    return regular;
  }
};

/// The vertices of a tetrahedron opposite to each one, in the order that keeps the orientation.
constexpr int opposite[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};

/// An ideal element seen from one of its vertices (0), the others 1, 2, 3 in the order of
/// `opposite`; g_i are the gradients of the barycentric functions.
struct IdealCorner {
  double K01, K02, K03, K12, K13, K23;  // K_ij = −g_i·g_j
  double perVolume, gg;                 // 1/det of the edges from vertex 0; |g_0|²
};

/// g_1, g_2, g_3 by columns; g_0 = −(g_1 + g_2 + g_3).
Mat3 barycentricGradients(const std::array<Vec3, 4>& z, std::size_t k, double scale = 1) {
  const int* o = opposite[k];
  return transpose(inverse(scale * Mat3{z[o[0]] - z[k], z[o[1]] - z[k], z[o[2]] - z[k]}));
}

IdealCorner idealCorner(const std::array<Vec3, 4>& z, std::size_t k, double scale = 1) {
  const Mat3 g = barycentricGradients(z, k, scale);
  const Vec3 g0 = -(g.c0 + g.c1 + g.c2);
  return {-dot(g0, g.c0),   -dot(g0, g.c1),   -dot(g0, g.c2), -dot(g.c0, g.c1),
          -dot(g.c0, g.c2), -dot(g.c1, g.c2), det(g),         norm2(g0)};
}

// ==== 3.7.2 Objective function ==================================================================
//
// Let the node of an element move by d, and g be the gradient, in the ideal element, of the node's
// barycentric function. Then J becomes J + d gᵀ, and exactly
//   N = ‖J‖²      → N + 2 v·d + |g|²|d|²,    v = J g       → v + |g|² d,
//   σ = det J     → σ + s·d,                 s = cof(J) g  → s.
// From the edges a, b, c of the node to the other three vertices, with K_ij = −g_i·g_j:
//   N = Σ_{i<j} K_ij |x_i − x_j|²,           v = −(K_01 a + K_02 b + K_03 c),
//   σ = a·(b × c)/det I = −a·s,              s = −(b − a) × (c − a)/det I.
// With e = 1/(3 h^⅔), η = e N, R = √(σ² + 4δ²), r = 1/R and ∂h/∂σ = h r:
//   ∇η = 2 e v − ⅔ η r s,
//   Hess η = 2 e |g|² I − 4/3 e r (v sᵀ + s vᵀ) + η r² [4/9 + ⅔ σ r] s sᵀ.
// The sum is that of φ(η) = linear η + (scale η)^power, φ = η in eq. (9) as printed. Neither N nor
// η is divided by, but for φ″:
//   ∇φ = φ′ ∇η,   Hess φ = φ′ Hess η + φ″ ∇η ∇ηᵀ
//                        = α I + β (v sᵀ + s vᵀ) + κ v vᵀ + ρ s sᵀ,
//   α = 2 φ′ e |g|²,   β = −4/3 (φ′ + φ″η) e r,   κ = 4 φ″ e²,
//   ρ = η r² [4/9 (φ′ + φ″η) + ⅔ φ′ σ r].
//
// Elements are taken `lanes` at a time: loops of fixed length over arrays, without branches, that
// compilers turn into vector instructions by themselves (1.7 times faster on SSE2 alone). Each
// lane has its own sums, so that the result does not depend on the instructions.

constexpr int lanes = 8;
using Lanes = double[lanes];

double sumOf(const Lanes& a) {
  double sum = 0;
  for (double part : a) sum += part;
  return sum;
}

/// Elements of a star side by side. In one struct, so that compilers see that what is written is
/// not what is read.
struct StarBlock {
  Lanes ax, ay, az, bx, by, bz, cx, cy, cz;           // edges a, b, c from the node
  Lanes K01, K02, K03, K12, K13, K23, perVolume, gg;  // the fields of IdealCorner
  Lanes N, sigma, vx, vy, vz, sx, sy, sz;             // and with gg those of StarElement

  void set(int i, const IdealCorner& k, Vec3 a, Vec3 b, Vec3 c) {
    ax[i] = a.x, ay[i] = a.y, az[i] = a.z;
    bx[i] = b.x, by[i] = b.y, bz[i] = b.z;
    cx[i] = c.x, cy[i] = c.y, cz[i] = c.z;
    K01[i] = k.K01, K02[i] = k.K02, K03[i] = k.K03;
    K12[i] = k.K12, K13[i] = k.K13, K23[i] = k.K23;
    perVolume[i] = k.perVolume, gg[i] = k.gg;
  }
  void set(int i, const StarElement& e) {
    N[i] = e.N, sigma[i] = e.sigma, gg[i] = e.gg;
    vx[i] = e.v.x, vy[i] = e.v.y, vz[i] = e.v.z;
    sx[i] = e.s.x, sy[i] = e.s.y, sz[i] = e.s.z;
  }
  StarElement element(int i) const {
    return {N[i], sigma[i], gg[i], {vx[i], vy[i], vz[i]}, {sx[i], sy[i], sz[i]}};
  }
  /// No element from lane i on: η = 0, with derivatives 0.
  void clearFrom(int i) {
    for (; i < lanes; ++i) set(i, {0, 1, 0, {}, {}});
  }
};

/// N, σ, v, s from the edges and the ideal elements.
MECCANO_AVX2_TOO void closedForm(StarBlock& e) {
  for (int i = 0; i < lanes; ++i) {
    const Vec3 a{e.ax[i], e.ay[i], e.az[i]}, b{e.bx[i], e.by[i], e.bz[i]};
    const Vec3 c{e.cx[i], e.cy[i], e.cz[i]}, ab = b - a, ac = c - a, bc = c - b;
    const Vec3 v = -(e.K01[i] * a + e.K02[i] * b + e.K03[i] * c);
    const Vec3 s = -e.perVolume[i] * cross(ab, ac);
    e.N[i] = e.K01[i] * norm2(a) + e.K02[i] * norm2(b) + e.K03[i] * norm2(c) +
             e.K12[i] * norm2(ab) + e.K13[i] * norm2(ac) + e.K23[i] * norm2(bc);
    e.sigma[i] = -dot(a, s);
    e.vx[i] = v.x, e.vy[i] = v.y, e.vz[i] = v.z;
    e.sx[i] = s.x, e.sy[i] = s.y, e.sz[i] = s.z;
  }
}

struct Penalty {
  double linear, scale, power;
};
constexpr Penalty plainEta{1, 0, 1};  // scale 0: no second term

/// a^power; integer powers, the rule here, by repeated squaring, 5 times faster than pow.
inline void raise(Lanes& a, double power) {
  int n = static_cast<int>(power);
  Lanes square;
  for (int i = 0; i < lanes; ++i) square[i] = a[i];
  for (int i = 0; i < lanes; ++i) a[i] = power > n ? std::pow(square[i], power - n) : 1;
  for (; n > 0; n >>= 1) {
    for (int i = 0; i < lanes; ++i) a[i] *= n & 1 ? square[i] : 1;
    for (int i = 0; i < lanes; ++i) square[i] *= square[i];
  }
}

/// h^(-1/3) by Newton's iteration y ← y (4 − h y³)/3, free of divisions: 3 times faster than pow.
/// The start, from the exponent's bits, is good to 6 %; the error e becomes 2 e² each time: 7e-16
/// after four. For h in [leastH, 1/leastH].
inline void inverseCubeRoots(const Lanes& h, Lanes& y) {
  Lanes z, third;
  for (int i = 0; i < lanes; ++i) {
    std::uint64_t bits;
    std::memcpy(&bits, &h[i], sizeof bits);
    bits = (bits >> 2) + (bits >> 4);  // a third of it: 1/4 + 1/16 + 1/64 ...
    bits += bits >> 4;
    bits += bits >> 8;
    bits = 0x553EF0FF289DD796u - (bits + (bits >> 16));
    std::memcpy(&z[i], &bits, sizeof bits);
    third[i] = 1. / 3 * h[i];
  }
  for (int k = 0; k < 4; ++k)
    for (int i = 0; i < lanes; ++i) z[i] *= 4. / 3 - third[i] * (z[i] * z[i] * z[i]);
  for (int i = 0; i < lanes; ++i) y[i] = z[i];
}

/// Below it (σ relative to its mean over the mesh) an element counts as flat. Coordinates alone
/// round σ by 1e-16.
constexpr double leastH = 1e-100;

/// [eq. (8)] 1/(3 h^⅔) and 1/√(σ² + 4δ²); ∞ for δ = 0 and σ <= 0.
inline void regularize(const Lanes& sigma, double delta, Lanes& e, Lanes& r) {
  Lanes hs, y;
  if (delta == 0) {
    for (int i = 0; i < lanes; ++i) hs[i] = sigma[i];
  } else {
    Lanes R;
    for (int i = 0; i < lanes; ++i) R[i] = std::sqrt(sigma[i] * sigma[i] + 4 * delta * delta);
    for (int i = 0; i < lanes; ++i) {
      const double larger = (std::abs(sigma[i]) + R[i]) / 2;  // root of h² − |σ| h = δ²
      const double smaller = delta * delta / larger;
      hs[i] = sigma[i] >= 0 ? larger : smaller;
      r[i] = 1 / R[i];
    }
  }
  inverseCubeRoots(hs, y);
  for (int i = 0; i < lanes; ++i) {
    const double positive = 1. / 3 * (y[i] * y[i]);
    e[i] = hs[i] > leastH ? positive : unbounded;
  }
  if (delta == 0)
    for (int i = 0; i < lanes; ++i) r[i] = y[i] * y[i] * y[i];
}

/// η, φ, φ′, φ″ of elements, and e and r above.
struct Distortions {
  Lanes eta, phi, first, second, e, r;
};

template <class Block>  // with N and sigma
inline Distortions distortionsOf(const Block& block, double delta, const Penalty& P) {
  Distortions at;
  regularize(block.sigma, delta, at.e, at.r);
  for (int i = 0; i < lanes; ++i) {
    at.eta[i] = at.phi[i] = block.N[i] * at.e[i];
    at.first[i] = 1;
    at.second[i] = 0;
  }
  if (P.scale == 0) return at;
  Lanes w;
  for (int i = 0; i < lanes; ++i) w[i] = P.scale * at.eta[i];
  raise(w, P.power);
  for (int i = 0; i < lanes; ++i) {
    const double perEta = 1 / std::max(at.eta[i], DBL_MIN);
    at.phi[i] = P.linear == 0 ? w[i] : P.linear * at.eta[i] + w[i];
    at.first[i] = P.linear + P.power * w[i] * perEta;
    at.second[i] = P.power * (P.power - 1) * w[i] * perEta * perEta;
  }
  return at;
}

using StarBlocks = std::vector<StarBlock>;

/// [§3.7.2, eq. (9)] Σ φ(η) over a star, its gradient and its Hessian.
///   leastSlope  bound of σ/R from below. 2/3 makes each term positive definite
///   source      derivatives after [32]
MECCANO_AVX2_TOO Objective objectiveOf(const StarBlocks& star, double delta, const Penalty& P,
                                       double leastSlope = -1) {
  Lanes f{}, gx{}, gy{}, gz{}, xx{}, xy{}, xz{}, yy{}, yz{}, zz{};
  for (const StarBlock& block : star) {
    const Distortions at = distortionsOf(block, delta, P);
    for (int i = 0; i < lanes; ++i) {
      const double e = at.e[i], r = at.r[i], first = at.first[i];
      const double both = first + at.second[i] * at.eta[i];
      const double slope = std::max(block.sigma[i] * r, leastSlope);
      const double onV = 2 * first * e, onS = -2. / 3 * first * at.eta[i] * r;
      const double alpha = onV * block.gg[i], beta = -4. / 3 * both * e * r;
      const double kappa = 4 * at.second[i] * e * e;
      const double rho = at.eta[i] * r * r * (4. / 9 * both + 2. / 3 * first * slope);
      const Vec3 v{block.vx[i], block.vy[i], block.vz[i]}, s{block.sx[i], block.sy[i], block.sz[i]};
      const Vec3 g = onV * v + onS * s, a = kappa * v + beta * s, b = beta * v + rho * s;
      f[i] += at.phi[i];
      gx[i] += g.x, gy[i] += g.y, gz[i] += g.z;
      xx[i] += alpha + (a.x * v.x + b.x * s.x), xy[i] += a.x * v.y + b.x * s.y;
      yy[i] += alpha + (a.y * v.y + b.y * s.y), xz[i] += a.x * v.z + b.x * s.z;
      zz[i] += alpha + (a.z * v.z + b.z * s.z), yz[i] += a.y * v.z + b.y * s.z;
    }
  }
  const double Hxy = sumOf(xy), Hxz = sumOf(xz), Hyz = sumOf(yz);
  return {sumOf(f),
          {sumOf(gx), sumOf(gy), sumOf(gz)},
          {{sumOf(xx), Hxy, Hxz}, {Hxy, sumOf(yy), Hyz}, {Hxz, Hyz, sumOf(zz)}}};
}

/// Σ φ(η) with the node displaced by d.
MECCANO_AVX2_TOO double valueAt(const StarBlocks& star, Vec3 d, double delta, const Penalty& P) {
  Lanes f{};
  const double dd = norm2(d);
  for (const StarBlock& block : star) {
    struct {
      Lanes N, sigma;
    } moved;
    for (int i = 0; i < lanes; ++i) {
      const double vd = block.vx[i] * d.x + block.vy[i] * d.y + block.vz[i] * d.z;
      const double sd = block.sx[i] * d.x + block.sy[i] * d.y + block.sz[i] * d.z;
      moved.N[i] = block.N[i] + 2 * vd + block.gg[i] * dd;
      moved.sigma[i] = block.sigma[i] + sd;
    }
    const Distortions at = distortionsOf(moved, delta, P);
    for (int i = 0; i < lanes; ++i) f[i] += at.phi[i];
  }
  return sumOf(f);
}

/// isSmallStep(). With u = s·d/σ and w = |g||d|/√N, |β| <= 1, η becomes
///   η (1 + 2βw + w²)/(1 + u)^⅔.
/// For |u|, w <= .15, and all β, what is left of it after η + ∇η·d is at most 1.16/2 dᵀ Hess η d.
/// Summed, with Newton's direction p and d = t p: f(d) − f <= (t − .58 t²) ∇f·p.
MECCANO_AVX2_TOO bool allSmall(const StarBlocks& star, Vec3 d) {
  constexpr double small = .15;
  Lanes above{};
  const double dd = norm2(d);
  for (const StarBlock& e : star)
    for (int i = 0; i < lanes; ++i) {
      const double sd = e.sx[i] * d.x + e.sy[i] * d.y + e.sz[i] * d.z;
      const double onSigma = small * e.sigma[i] - std::abs(sd);
      const double onN = small * small * e.N[i] - e.gg[i] * dd;
      const bool isIn = (onSigma >= 0) & (onN >= 0) & (e.sigma[i] > 0);  // false for no number
      above[i] += isIn ? 0 : 1;
    }
  return sumOf(above) == 0;
}

/// The star with the node displaced by d.
StarBlocks displaced(StarBlocks star, Vec3 d) {
  for (StarBlock& b : star)
    for (int i = 0; i < lanes; ++i) {
      const Vec3 v{b.vx[i], b.vy[i], b.vz[i]}, s{b.sx[i], b.sy[i], b.sz[i]}, w = v + b.gg[i] * d;
      b.set(i, {b.N[i] + dot(v + w, d), b.sigma[i] + dot(s, d), b.gg[i], w, s});
    }
  return star;
}

StarBlocks blocksOf(const Star& star) {
  StarBlocks blocks((star.elements.size() + lanes - 1) / lanes);
  if (!blocks.empty()) blocks.back().clearFrom(0);
  for (std::size_t j = 0; j < star.elements.size(); ++j)
    blocks[j / lanes].set(static_cast<int>(j % lanes), star.elements[j]);
  return blocks;
}

}  // namespace

Star starOf(const Mesh& M, int n, const std::vector<int>& around) {
  const IdealElements ideals(M, Ideal::computational);
  Star star{M.x[n], {}};
  for (int E : around) {
    const std::array<int, 4>& tet = M.tets[E];
    const auto k = std::find(tet.begin(), tet.end(), n) - tet.begin();
    const int* o = opposite[k];
    const Vec3 a = M.x[tet[o[0]]] - M.x[n], b = M.x[tet[o[1]]] - M.x[n];
    StarBlock block{};
    block.set(0, idealCorner(ideals.of(E), k), a, b, M.x[tet[o[2]]] - M.x[n]);
    closedForm(block);
    star.elements.push_back(block.element(0));
  }
  return star;
}

double f(const Star& star, Vec3 x, double delta, double power) {
  return valueAt(blocksOf(star), x - star.origin, delta, {0, 1, power});
}

Objective fDerivatives(const Star& star, Vec3 x, double delta, double power) {
  return objectiveOf(displaced(blocksOf(star), x - star.origin), delta, {0, 1, power});
}

bool isSmallStep(const Star& star, Vec3 d) { return allSmall(blocksOf(star), d); }

// ==== 3.7.3 Objective function for surface and edge nodes =======================================

double fVarphi(const Star& star, const Parametrization& P, Vec2 u, double delta, double power) {
  const Location at = locate(P, u);
  return at.triangle < 0 ? unbounded : f(star, varphi(P, at), delta, power);  // eq. (10)
}

double fGamma(const Star& star, const Curve& C, double s, double delta, double power) {
  return f(star, gamma(C, s), delta, power);  // eq. (11)
}

namespace {

/// ∂ϕ/∂u in a triangle of 𝓤, by columns: exact, since ϕ is affine there.
Mat3 surfaceDerivative(const Parametrization& P, int triangle) {
  const std::array<int, 3>& t = P.triangles[triangle];
  const Vec2 a = P.u[t[1]] - P.u[t[0]], b = P.u[t[2]] - P.u[t[0]];
  const Vec3 A = P.points[t[1]] - P.points[t[0]], B = P.points[t[2]] - P.points[t[0]];
  const double d = cross(a, b);
  return {(b.y / d) * A - (a.y / d) * B, (a.x / d) * B - (b.x / d) * A, {}};
}

/// dγ/ds on the segment that holds s.
Mat3 curveDerivative(const Curve& C, double s) {
  const std::ptrdiff_t last = static_cast<std::ptrdiff_t>(C.s.size()) - 2;
  const std::ptrdiff_t after = std::upper_bound(C.s.begin(), C.s.end(), s) - C.s.begin();
  const std::size_t k = std::clamp<std::ptrdiff_t>(after - 1, 0, last);
  const Vec3 edge = C.points[(k + 1) % C.points.size()] - C.points[k];
  return {(1 / (C.s[k + 1] - C.s[k])) * edge, {}, {}};
}

/// A place on the surface or curve of a sliding node.
struct Place {
  bool inside;  // false: no such place, the parameter is outside
  Vec2 parameter;
  Vec3 x;
  Mat3 derivative;  // ∂x/∂parameter, the columns that count first
};

Place placeOf(const Mesh& M, int n, Vec2 u) {
  if (M.dimension[n] == 1) {
    const Curve& C = M.curves[M.entity[n] - 1];
    const double s = C.closed ? u.x - C.s.back() * std::floor(u.x / C.s.back()) : u.x;
    const bool inside = s >= C.s.front() && s <= C.s.back();
    return {inside, {s, 0}, gamma(C, s), curveDerivative(C, s)};
  }
  const Parametrization& P = surfaceOf(M, M.entity[n]);
  const Location at = locate(P, u);
  if (at.triangle < 0) return {false, u, {}, {}};
  return {true, u, varphi(P, at), surfaceDerivative(P, at.triangle)};
}

/// f_ϕ or f_γ by the chain rule: gradient Dᵀ∇f and Hessian Dᵀ(Hess f)D, padded by 1 to three
/// parameters.
Objective inParameters(const Objective& o, const Mat3& D, int count) {
  const Mat3 T = transpose(D);
  Objective r{o.f, T * o.gradient, T * (o.hessian * D)};
  if (count < 2) r.hessian.c1.y = 1;
  r.hessian.c2.z = 1;
  return r;
}

/// [§3.7.3] The paper's derivatives of f_ϕ and f_γ: central differences with step e in each
/// parameter. F takes the change of the parameters.
template <class Function>
Objective byDifferences(const Function& F, int count, Vec2 e) {
  Objective o{F({0, 0}), {}, {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
  const double right = F({e.x, 0}), left = F({-e.x, 0});
  o.gradient.x = (right - left) / (2 * e.x);
  o.hessian.c0.x = (right - 2 * o.f + left) / (e.x * e.x);
  if (count < 2) return o;
  const double up = F({0, e.y}), down = F({0, -e.y});
  const double mixed = F({e.x, e.y}) - F({e.x, -e.y}) - F({-e.x, e.y}) + F({-e.x, -e.y});
  o.gradient.y = (up - down) / (2 * e.y);
  o.hessian.c1.y = (up - 2 * o.f + down) / (e.y * e.y);
  o.hessian.c0.y = o.hessian.c1.x = mixed / (4 * e.x * e.y);
  return o;
}

// ==== 3.7.4 Optimization approach: direction and step length ====================================

constexpr double wolfeC1 = 1e-4, wolfeC2 = .9;  // [33]'s values for Newton's direction
constexpr int wolfeEvaluations = 20;

struct LineSample {
  double t;
  LinePoint at;
};

/// Between two samples: the minimum of the cubic through both, kept off the ends by a tenth; the
/// middle where there is none or F is infinite.
double cubicStep(const LineSample& lo, const LineSample& hi) {
  const double width = hi.t - lo.t, g0 = lo.at.slope, g1 = hi.at.slope;
  const double d1 = g0 + g1 - 3 * (hi.at.F - lo.at.F) / width;
  const double d2 = std::copysign(std::sqrt(d1 * d1 - g0 * g1), width);
  const double part = 1 - (g1 + d2 - d1) / (g1 - g0 + 2 * d2);
  return lo.t + width * (std::isfinite(part) ? std::clamp(part, .1, .9) : .5);
}

/// [§3.7.4, strong Wolfe conditions, 33] Bracketing and zoom in one loop: `lo` is the best point
/// that meets the first condition; once a minimum lies between `lo` and `hi` the interval only
/// shrinks.
template <class Line>
WolfeStep wolfeSearch(const Line& F, LinePoint atZero, double tFirst, double tMax) {
  LineSample lo{0, atZero}, hi{0, atZero};
  bool bracketed = false;
  double t = std::min(tFirst, tMax);
  int evaluations = 0;
  while (evaluations < wolfeEvaluations) {
    const LineSample trial{t, F(t)};
    ++evaluations;
    const bool decrease = trial.at.F <= atZero.F + wolfeC1 * t * atZero.slope;
    if (!decrease || trial.at.F >= lo.at.F) {
      hi = trial;
      bracketed = true;
    } else {
      if (std::abs(trial.at.slope) <= wolfeC2 * std::abs(atZero.slope))
        return {t, true, true, evaluations};
      if (bracketed ? trial.at.slope * (hi.t - lo.t) >= 0 : trial.at.slope >= 0) {
        hi = lo;
        bracketed = true;
      }
      lo = trial;
      if (!bracketed && t >= tMax) break;
    }
    t = bracketed ? cubicStep(lo, hi) : std::min(2 * t, tMax);
  }
  return {lo.t, lo.t > 0, false, evaluations};
}

/// [departure] The first Wolfe condition alone, by halving: a step that starts at `relaxation`
/// Newton steps is not too short, and the derivative in each trial costs as much as F. 0: no step.
template <class Function>
double armijoSearch(const Function& F, LinePoint atZero, double t) {
  for (int k = 0; k < wolfeEvaluations; ++k, t /= 2)
    if (F(t) <= atZero.F + wolfeC1 * t * atZero.slope) return t;
  return 0;
}

/// A direction in the node's parameters; tMax is the step of the local edge length.
struct Direction {
  Vec3 p;
  double slope, tMax;
  bool newton;
};

constexpr double definiteSlope = 2. / 3;  // σ/R from which an element's Hessian is definite

/// [§3.7.4] Newton's direction. Where the Hessian is not positive definite (1 visit in 10^4), with
/// σ/R clamped so that it is; else down the gradient by a tenth of the local edge.
template <class Derivatives>
Direction descentDirection(const Objective& o, const Derivatives& derivatives, const Mat3& D,
                           double edge) {
  Vec3 p;
  const bool newton = solveCholesky(o.hessian, -o.gradient, p);
  if (!newton && !solveCholesky(derivatives(definiteSlope).hessian, -o.gradient, p))
    p = (-.1 * edge / norm(D * o.gradient)) * o.gradient;
  return {p, dot(p, o.gradient), edge / norm(D * p), newton};
}

}  // namespace

bool solveCholesky(const Mat3& A, Vec3 b, Vec3& p) {
  // A = L Lᵀ by rows, then L y = b, Lᵀ p = y. A pivot must keep this part of its diagonal entry: 16
  // roundings.
  constexpr double pivotTolerance = 16 * DBL_EPSILON;
  const double d0 = A.c0.x;
  if (!(d0 > 0)) return false;
  const double l10 = A.c0.y / d0, l20 = A.c0.z / d0;
  const double d1 = A.c1.y - l10 * A.c0.y;
  if (!(d1 > pivotTolerance * A.c1.y)) return false;
  const double m21 = A.c1.z - l20 * A.c0.y, l21 = m21 / d1;
  const double d2 = A.c2.z - l20 * A.c0.z - l21 * m21;
  if (!(d2 > pivotTolerance * A.c2.z)) return false;
  const double y1 = b.y - l10 * b.x, y2 = b.z - l20 * b.x - l21 * y1;
  p.z = y2 / d2;
  p.y = y1 / d1 - l21 * p.z;
  p.x = b.x / d0 - l10 * p.y - l20 * p.z;
  return isFinite(p);
}

WolfeStep strongWolfe(const std::function<LinePoint(double t)>& F, double tFirst, double tMax) {
  return wolfeSearch(F, F(0), tFirst, tMax);
}

// ==== Tools: threads ============================================================================

constexpr int patience = 200;  // [choice] looks before a thread sleeps: some 100 μs

struct Crew::Threads {
  explicit Threads(int threads) : wanted(threads) {}
  ~Threads();
  void start(int threads);
  void serve();
  /// job() here and in those of the others that come before it ends here.
  void run(int pieces, const std::function<void()>& job);

  const int wanted;  // the caller's among them
  std::vector<std::thread> others;
  std::mutex mutex;
  std::condition_variable begin, end;
  const std::function<void()>* job = nullptr;  // null: none; guarded by mutex, as what follows
  std::atomic<int> inside{0};                  // others at the job
  bool leaves = false;
  std::atomic<unsigned> round{0};  // of jobs
};

Crew::Threads::~Threads() {
  {
    const std::lock_guard<std::mutex> lock(mutex);
    leaves = true;
    ++round;
  }
  begin.notify_all();
  for (std::thread& other : others) other.join();
}

void Crew::Threads::start(int threads) {
  try {
    while (static_cast<int>(others.size()) + 1 < threads) others.emplace_back([this] { serve(); });
  } catch (const std::system_error&) {
    // no more threads to be had: those there are do it all
  }
}

void Crew::Threads::serve() {
  unsigned seen = 0;
  for (;;) {
    for (int k = 0; k < patience && round == seen; ++k) std::this_thread::yield();
    std::unique_lock<std::mutex> lock(mutex);
    begin.wait(lock, [&] { return round != seen; });
    seen = round;
    if (leaves) return;
    if (job == nullptr) continue;
    const std::function<void()>& mine = *job;
    ++inside;
    lock.unlock();
    mine();
    lock.lock();
    if (--inside == 0) end.notify_one();
  }
}

void Crew::Threads::run(int pieces, const std::function<void()>& shared) {
  start(std::min(wanted, pieces));
  {
    const std::lock_guard<std::mutex> lock(mutex);
    job = &shared;
    ++round;
  }
  begin.notify_all();
  shared();
  {
    const std::lock_guard<std::mutex> lock(mutex);
    job = nullptr;
  }
  for (int k = 0; k < patience && inside > 0; ++k) std::this_thread::yield();
  std::unique_lock<std::mutex> lock(mutex);
  end.wait(lock, [this] { return inside == 0; });
}

namespace {

/// How many threads to start where so many are asked for (0: all cores).
int usefulThreads(int wanted) {
  constexpr int few = 16;  // [choice] are taken on any machine; more of them than cores never
  const int cores = static_cast<int>(std::thread::hardware_concurrency());
  return wanted > 0 ? std::min(wanted, std::max(few, cores)) : std::max(1, cores);
}

}  // namespace

Crew::Crew(int threads) : threads_(std::make_unique<Threads>(usefulThreads(threads))) {}
Crew& Crew::operator=(Crew&&) noexcept = default;
Crew::~Crew() = default;

void Crew::forPieces(int begin, int end, int size, const Task& task) const {
  const int pieces = (end - begin + size - 1) / size;
  std::atomic<int> next{0};
  std::mutex mutex;
  std::exception_ptr failure;
  int failed = pieces;
  const auto work = [&] {
    int k = 0;
    try {
      for (k = next++; k < pieces; k = next++)
        task(k, begin + k * size, std::min(end, begin + (k + 1) * size));
    } catch (...) {
      next = pieces;
      const std::lock_guard<std::mutex> lock(mutex);
      if (k < failed) failed = k, failure = std::current_exception();
    }
  };
  if (pieces > 1 && threads_->wanted > 1)
    threads_->run(pieces, work);
  else
    work();
  if (failure) std::rethrow_exception(failure);
}

// ==== 3.7.4 Optimization approach: Algorithm 2 ==================================================

namespace {

/// The sum of task(from, to) over the pieces, in their order.
template <class Sum, class Task>
Sum sumOfPieces(const Crew& crew, int begin, int end, int size, const Task& task) {
  std::vector<Sum> parts((end - begin + size - 1) / size);
  crew.forPieces(begin, end, size, [&](int k, int from, int to) { parts[k] = task(from, to); });
  Sum sum{};
  for (const Sum& part : parts) sum += part;
  return sum;
}

/// An element of a node's star: the places of the other three nodes among its neighbours, the index
/// of its IdealCorner.
struct StarEntry {
  std::uint16_t a, b, c;
  int corner;
};

/// [choice] Elements at a node that moves, at most: no node has as many but the hub of a fan. Its
/// neighbours fit into 16 bits.
constexpr int mostElements = 20000;

/// A surface triangle of a sliding node, the node first, counter-clockwise in 𝓤 of its surface.
struct SheetTriangle {
  int a, b, label;
};

/// Gauss–Seidel over the free nodes: all that Algorithm 2 keeps between visits.
struct Smoother {
  Mesh& M;
  const OptimizeOptions& options;
  OptimizeReport report = {};
  Crew crew = Crew();

  std::vector<int> elements = {};         // those that may change, ascending
  std::vector<IdealCorner> corners = {};  // 4 for each ideal element; few on a meccano mesh
  std::vector<std::array<Vec3, 4>> gradients = {};  // g_0 ... g_3 of each ideal element
  std::vector<int> shapeOf = {};  // [tets] corners of E: corners[4 shapeOf[E] + vertex]; -1: none
  std::vector<unsigned char> freedom = {};  // [nodes] 3 inner, 2 surface, 1 curve, 0 fixed

  std::vector<int> order = {};        // [rows] the free nodes, colour by colour
  std::vector<int> colourStart = {};  // [colours + 1] rows of each colour
  std::vector<int> starStart = {};    // [rows + 1] of row r: star[starStart[r] .. starStart[r + 1])
  std::vector<StarEntry> star = {};   // the elements at free nodes
  std::vector<int> nearStart = {};    // [rows + 1] of row r: near[nearStart[r] .. nearStart[r + 1])
  std::vector<int> near = {};         // the neighbours of free nodes
  std::vector<int> sheetStart = {};   // [nodes + 1] surface triangles at n, rows of sheet
  std::vector<SheetTriangle> sheet = {};

  std::vector<int> rowOf = {};   // [nodes] -1: not free
  std::vector<float> edge = {};  // [rows] shortest edge at the last visit
  // [nodes] whether a node of the star has moved since the last visit. Atomic, for nodes of one
  // colour share neighbours; all write 1.
  std::vector<std::atomic<unsigned char>> awake = {};
  std::vector<unsigned char> reached = {};  // [nodes] moved by more than `wake` before the lift
  std::vector<unsigned char> moved = {};    // [nodes] since the qualities of the lift are known
  double wake = 0;  // displacement, relative to the shortest edge, from which neighbours awake

  double delta = 0;      // of the sweep, relative to the mean σ
  bool flat = false;     // elements that are as good as flat count as inverted
  bool tangled = false;  // of the mesh, and the rung of the schedule for μ
  bool stuck = false;    // still, after some sweeps
  int rung = 0;
  double relaxation = 1;
  Penalty penalty = plainEta;
};

/// The scale that makes the mean of σ 1 (of a wildly tangled mesh .1 of the mean |σ|), so that μ
/// and δ are relative.
struct IdealScale {
  double sum = 0, absolute = 0;

  void add(double sigma) {
    sum += sigma;
    absolute += std::abs(sigma);
  }
  double of(std::size_t elements) const {
    const double mean = std::max(sum, .1 * absolute) / static_cast<double>(elements);
    return mean > 0 ? std::cbrt(mean) : 1;
  }
};

/// Numbers of shapes of ideal elements. Neighbours in a list are mostly of few shapes: the shapes
/// that the last ones had are looked up first, by a hash of their edges.
class ShapeTable {
 public:
  std::size_t size() const { return known_.size(); }
  int numberOf(const std::array<Vec3, 4>& z) {
    Key key;
    std::uint64_t hash = 0;
    for (int k = 0; k < 3; ++k) {
      const Vec3 e = z[k + 1] - z[0];
      key[3 * k] = static_cast<float>(e.x) + 0.f;  // −0 becomes 0
      key[3 * k + 1] = static_cast<float>(e.y) + 0.f;
      key[3 * k + 2] = static_cast<float>(e.z) + 0.f;
    }
    for (float f : key) {
      std::uint32_t bits;
      std::memcpy(&bits, &f, sizeof bits);
      hash = (hash ^ bits) * 0x9E3779B97F4A7C15u;
    }
    Recent& recent = recent_[hash >> 58];
    if (recent.number < 0 || recent.key != key)
      recent = {key, known_.emplace(key, static_cast<int>(known_.size())).first->second};
    return recent.number;
  }

 private:
  using Key = std::array<float, 9>;
  struct Recent {
    Key key{};
    int number = -1;
  };
  std::map<Key, int> known_;
  std::array<Recent, 64> recent_;
};

/// Corners of the ideal elements; [choice] those whose edges agree as floats are one shape.
void buildCorners(Smoother& S) {
  const IdealElements ideals(S.M, Ideal::computational);
  IdealScale sigmas;
  ShapeTable known;
  std::vector<std::array<Vec3, 4>> shapes;
  S.shapeOf.assign(S.M.tets.size(), -1);
  for (int E : S.elements) {
    const std::array<Vec3, 4> z = ideals.of(E);
    sigmas.add(signedVolume6(cornersOf(S.M.x, S.M.tets[E])) / signedVolume6(z));
    S.shapeOf[E] = known.numberOf(z);
    if (known.size() > shapes.size()) shapes.push_back(z);
  }
  const double scale = sigmas.of(S.elements.size());
  for (const std::array<Vec3, 4>& z : shapes) {
    S.gradients.emplace_back();
    for (std::size_t k = 0; k < 4; ++k) {
      const Mat3 g = barycentricGradients(z, k, scale);
      S.corners.push_back(idealCorner(z, k, scale));
      S.gradients.back()[k] = -(g.c0 + g.c1 + g.c2);
    }
  }
}

/// What each node may do; without geometry the boundary is fixed.
void buildFreedom(Smoother& S) {
  const Mesh& M = S.M;
  S.freedom = M.dimension;
  if (M.dimension.empty()) {
    S.freedom.assign(M.x.size(), 3);
    const std::vector<std::array<int, 4>> neighbour = faceNeighbours(M);
    for (std::size_t E = 0; E < M.tets.size(); ++E)
      for (int k = 0; k < 4; ++k)
        if (neighbour[E][k] < 0)
          for (int i : opposite[k]) S.freedom[M.tets[E][i]] = 0;
  }
  for (int n : S.options.fixed) S.freedom[n] = 0;
}

bool isAtAny(const std::vector<unsigned char>& marked, const std::array<int, 4>& z) {
  return marked[z[0]] || marked[z[1]] || marked[z[2]] || marked[z[3]];
}

/// [choice] Edges from the active nodes to the farthest ones that move.
constexpr int activeReach = 4;

/// The elements that may change: all, or where the active nodes are given those near them; the
/// nodes beyond stay.
void buildElements(Smoother& S) {
  const std::vector<std::array<int, 4>>& tets = S.M.tets;
  if (S.options.active.empty()) {
    S.elements.resize(tets.size());
    std::iota(S.elements.begin(), S.elements.end(), 0);
    return;
  }
  std::vector<unsigned char> near(S.M.x.size(), 0), next;
  for (int n : S.options.active) near[n] = 1;
  for (int edge = 0; edge < activeReach; ++edge) {
    next = near;
    for (const std::array<int, 4>& tet : tets)
      if (isAtAny(near, tet))
        for (int n : tet) next[n] = 1;
    near.swap(next);
  }
  for (std::size_t n = 0; n < near.size(); ++n)
    if (!near[n]) S.freedom[n] = 0;
  for (std::size_t E = 0; E < tets.size(); ++E)
    if (isAtAny(S.freedom, tets[E])) S.elements.push_back(static_cast<int>(E));
}

/// Rows of items at nodes: items of n are item[start[n] .. start[n + 1]).
struct Incidence {
  std::vector<int> start, item;
};
Incidence tetsAtFreeNodes(Smoother& S) {
  Incidence at{std::vector<int>(S.M.x.size() + 1, 0), {}};
  for (int E : S.elements)
    for (int n : S.M.tets[E]) at.start[n + 1] += S.freedom[n] > 0;
  for (std::size_t n = 0; n < S.M.x.size(); ++n)
    if (at.start[n + 1] > mostElements) S.freedom[n] = 0, at.start[n + 1] = 0;
  std::partial_sum(at.start.begin(), at.start.end(), at.start.begin());
  std::vector<int> next(at.start.begin(), at.start.end() - 1);
  at.item.resize(at.start.back());
  for (int E : S.elements)
    for (int n : S.M.tets[E])
      if (S.freedom[n] > 0) at.item[next[n]++] = E;
  return at;
}

/// Greedy colours of the free nodes, -1 for others: no two nodes of one element have the same. A
/// visit reads and moves nothing that another one of its colour moves, so that the result does not
/// depend on how many threads share a colour.
std::vector<int> colourNodes(const Smoother& S, const Incidence& at) {
  std::vector<int> colour(S.M.x.size(), -1), usedBy;
  for (int n = 0; n < static_cast<int>(colour.size()); ++n) {
    if (at.start[n] == at.start[n + 1]) continue;
    for (int k = at.start[n]; k < at.start[n + 1]; ++k)
      for (int i : S.M.tets[at.item[k]]) {
        if (colour[i] < 0) continue;
        if (colour[i] >= static_cast<int>(usedBy.size())) usedBy.resize(colour[i] + 1, -1);
        usedBy[colour[i]] = n;
      }
    colour[n] = static_cast<int>(
        std::find_if(usedBy.begin(), usedBy.end(), [n](int by) { return by != n; }) -
        usedBy.begin());
  }
  return colour;
}

constexpr int piece = 4096;  // elements or rows of a light task

/// The rows: free nodes by colour.
void buildRows(Smoother& S, const Incidence& at) {
  const std::vector<int> colour = colourNodes(S, at);
  for (std::size_t n = 0; n < colour.size(); ++n)
    if (colour[n] >= 0) S.order.push_back(static_cast<int>(n));
  std::stable_sort(S.order.begin(), S.order.end(),
                   [&](int a, int b) { return colour[a] < colour[b]; });
  S.rowOf.assign(S.M.x.size(), -1);
  S.starStart.assign(1, 0);
  for (std::size_t row = 0; row < S.order.size(); ++row) {
    const int n = S.order[row];
    if (row == 0 || colour[n] != colour[S.order[row - 1]])
      S.colourStart.push_back(static_cast<int>(row));
    S.rowOf[n] = static_cast<int>(row);
    S.starStart.push_back(S.starStart.back() + at.start[n + 1] - at.start[n]);
  }
  S.colourStart.push_back(static_cast<int>(S.order.size()));
  S.edge.assign(S.order.size(), 0);
}

/// The star of each row, and its neighbours in the order in which the star names them.
void fillStars(Smoother& S, const Incidence& at) {
  const int rows = static_cast<int>(S.order.size());
  S.star.resize(at.item.size());
  S.nearStart.assign(rows + 1, 0);
  std::vector<std::vector<int>> nearOf(rows / piece + 1);
  S.crew.forPieces(0, rows, piece, [&](int number, int from, int to) {
    std::vector<int>& near = nearOf[number];
    for (int row = from; row < to; ++row) {
      const int n = S.order[row];
      const std::ptrdiff_t first = static_cast<std::ptrdiff_t>(near.size());
      const bool isHub = at.start[n + 1] - at.start[n] > 100;
      std::map<int, std::ptrdiff_t> ofHub;  // its neighbours are too many to look through
      const auto place = [&](int i) {
        const std::ptrdiff_t end = static_cast<std::ptrdiff_t>(near.size());
        const std::ptrdiff_t k =
            isHub ? ofHub.emplace(i, end).first->second
                  : std::find(near.begin() + first, near.end(), i) - near.begin();
        if (k == end) near.push_back(i);
        return static_cast<std::uint16_t>(k - first);
      };
      StarEntry* entry = &S.star[S.starStart[row]];
      for (int j = at.start[n]; j < at.start[n + 1]; ++j, ++entry) {
        const std::array<int, 4>& tet = S.M.tets[at.item[j]];
        const int k = static_cast<int>(std::find(tet.begin(), tet.end(), n) - tet.begin());
        const int* o = opposite[k];
        entry->a = place(tet[o[0]]), entry->b = place(tet[o[1]]), entry->c = place(tet[o[2]]);
        entry->corner = 4 * S.shapeOf[at.item[j]] + k;
      }
      S.nearStart[row + 1] = static_cast<int>(near.size()) - static_cast<int>(first);
    }
  });
  std::partial_sum(S.nearStart.begin(), S.nearStart.end(), S.nearStart.begin());
  S.near.reserve(S.nearStart.back());
  for (const std::vector<int>& near : nearOf) S.near.insert(S.near.end(), near.begin(), near.end());
}

struct SheetFace {
  int label;
  std::array<int, 3> v;
  double area;             // twice, in 𝓤; 0: a parameter is not known
  std::array<int, 4> key;  // label and sorted nodes
};

std::array<int, 4> sheetKey(int label, std::array<int, 3> v) {
  std::sort(v.begin(), v.end());
  return {label, v[0], v[1], v[2]};
}

/// The labelled faces of these elements, each once.
std::vector<SheetFace> sheetFaces(const Mesh& M, const std::vector<int>& elements) {
  std::vector<SheetFace> faces;
  if (M.faceLabel.empty() || M.dimension.empty()) return faces;
  for (int E : elements)
    for (int k = 0; k < 4; ++k) {
      SheetFace f{M.faceLabel[E][k], {}, 0, {}};
      if (f.label == 0) continue;
      Vec2 u[3];
      bool known = true;
      for (int i = 0; i < 3; ++i) {
        f.v[i] = M.tets[E][opposite[k][i]];
        known = known && parameterOn(M, f.v[i], f.label, u[i]);
      }
      if (known) f.area = cross(u[1] - u[0], u[2] - u[0]);
      f.key = sheetKey(f.label, f.v);
      faces.push_back(f);
    }
  std::sort(faces.begin(), faces.end(),
            [](const SheetFace& a, const SheetFace& b) { return a.key < b.key; });
  const auto same = [](const SheetFace& a, const SheetFace& b) { return a.key == b.key; };
  faces.erase(std::unique(faces.begin(), faces.end(), same), faces.end());
  return faces;
}

void turn(SheetFace& f) {
  std::swap(f.v[1], f.v[2]);
  f.area = -f.area;
}

/// Orients each sheet's faces alike, and so that most of its area in 𝓤 is counter-clockwise: a
/// folded face is then known as one. Of a sheet that reaches beyond S.elements, the part in them.
void orientSheets(std::vector<SheetFace>& faces) {
  struct Edge {
    int label, lo, hi;
    std::size_t face;
    bool forward;
    bool operator<(const Edge& e) const {
      return std::tie(label, lo, hi, face) < std::tie(e.label, e.lo, e.hi, e.face);
    }
  };
  std::vector<Edge> edges;
  for (std::size_t f = 0; f < faces.size(); ++f)
    for (int i = 0; i < 3; ++i) {
      const int a = faces[f].v[i], b = faces[f].v[(i + 1) % 3];
      edges.push_back({faces[f].label, std::min(a, b), std::max(a, b), f, a < b});
    }
  std::sort(edges.begin(), edges.end());
  std::vector<std::vector<std::pair<std::size_t, bool>>> beside(faces.size());  // face, turned
  for (std::size_t e = 0; e + 1 < edges.size(); ++e) {
    const Edge &a = edges[e], &b = edges[e + 1];
    if (std::tie(a.label, a.lo, a.hi) != std::tie(b.label, b.lo, b.hi)) continue;
    beside[a.face].push_back({b.face, a.forward == b.forward});
    beside[b.face].push_back({a.face, a.forward == b.forward});
  }
  std::vector<char> turned(faces.size(), 0), seen(faces.size(), 0);
  for (std::size_t start = 0; start < faces.size(); ++start) {
    if (seen[start]) continue;
    std::vector<std::size_t> sheet{start};
    seen[start] = 1;
    double area = 0;
    for (std::size_t i = 0; i < sheet.size(); ++i) {
      const std::size_t f = sheet[i];
      area += turned[f] ? -faces[f].area : faces[f].area;
      for (const auto& [next, isTurned] : beside[f]) {
        if (seen[next]) continue;
        seen[next] = 1;
        turned[next] = turned[f] != isTurned;
        sheet.push_back(next);
      }
    }
    for (std::size_t f : sheet)
      if (turned[f] != (area < 0)) turn(faces[f]);
  }
}

/// Whether a face passes over a slit or an overlap of an inserted surface: in 𝓤 the middle of an
/// edge belongs to a place farther from it than it is long. Patches have no slits.
bool isBridge(const Mesh& M, const SheetFace& f) {
  if (f.label < 0) return false;
  for (int i = 0; i < 3; ++i) {
    const int a = f.v[i], b = f.v[(i + 1) % 3];
    Vec2 u, v;
    if (!parameterOn(M, a, f.label, u) || !parameterOn(M, b, f.label, v)) return false;
    const Parametrization& P = surfaceOf(M, f.label);
    const Location at = locate(P, .5 * (u + v));
    if (at.triangle < 0) continue;
    const Vec3 middle = .5 * (M.x[a] + M.x[b]);
    if (norm(varphi(P, at) - middle) > norm(M.x[a] - M.x[b])) return true;
  }
  return false;
}

/// The triangles of 𝓤 at each sliding node, of these faces. Without bridges, which are not where 𝓤
/// has them: to keep them unfolded would only hold their nodes.
void fillSheets(Smoother& S, const std::vector<SheetFace>& faces) {
  if (faces.empty()) return;
  const Mesh& M = S.M;
  std::vector<char> counts(faces.size(), 0);
  S.crew.forPieces(0, static_cast<int>(faces.size()), piece, [&](int, int from, int to) {
    for (int i = from; i < to; ++i) counts[i] = faces[i].area != 0 && !isBridge(M, faces[i]);
  });
  std::vector<std::pair<int, SheetTriangle>> entries;
  for (std::size_t face = 0; face < faces.size(); ++face) {
    if (!counts[face]) continue;
    const SheetFace& f = faces[face];
    for (int i = 0; i < 3; ++i)
      if (S.freedom[f.v[i]] == 1 || S.freedom[f.v[i]] == 2)
        entries.push_back({f.v[i], {f.v[(i + 1) % 3], f.v[(i + 2) % 3], f.label}});
  }
  S.sheetStart.assign(M.x.size() + 1, 0);
  for (const auto& entry : entries) ++S.sheetStart[entry.first + 1];
  for (std::size_t n = 0; n < M.x.size(); ++n) S.sheetStart[n + 1] += S.sheetStart[n];
  S.sheet.resize(entries.size());
  std::vector<int> next = S.sheetStart;
  for (const auto& entry : entries) S.sheet[next[entry.first]++] = entry.second;
}

/// As many threads as are wanted, and as have something to do.
void hireCrew(Smoother& S) {
  constexpr int elementsPerThread = 500;  // fewer are not worth one
  const int useful = 1 + static_cast<int>(S.elements.size()) / elementsPerThread;
  S.crew = Crew(std::min(usefulThreads(S.options.threads), useful));
}

/// All that is known of the elements before the first sweep.
void build(Smoother& S) {
  buildFreedom(S);
  buildElements(S);
  hireCrew(S);
  Incidence at;
  std::vector<SheetFace> faces;
  S.crew.forPieces(0, 3, 1, [&](int part, int, int) {
    if (part == 0) buildCorners(S);
    if (part == 1) at = tetsAtFreeNodes(S), buildRows(S, at);
    if (part == 2) faces = sheetFaces(S.M, S.elements), orientSheets(faces);
  });
  fillStars(S, at);
  fillSheets(S, faces);
}

double sigmaOf(const Smoother& S, int E) {
  return signedVolume6(cornersOf(S.M.x, S.M.tets[E])) * S.corners[4 * S.shapeOf[E]].perVolume;
}

/// q of these elements, from the closed form at their first vertex.
std::vector<double> qualitiesOf(const Smoother& S, const std::vector<int>& elements) {
  std::vector<double> q(elements.size());
  const auto ofPiece = [&](int, int from, int to) {
    for (int k = from; k < to; k += lanes) {
      StarBlock block{};
      for (int i = 0; i < std::min(lanes, to - k); ++i) {
        const int E = elements[k + i];
        const std::array<Vec3, 4> x = cornersOf(S.M.x, S.M.tets[E]);
        block.set(i, S.corners[4 * S.shapeOf[E]], x[1] - x[0], x[2] - x[0], x[3] - x[0]);
      }
      closedForm(block);
      const Distortions at = distortionsOf(block, 0, plainEta);
      for (int i = 0; i < std::min(lanes, to - k); ++i) q[k + i] = 1 / at.eta[i];
    }
  };
  S.crew.forPieces(0, static_cast<int>(q.size()), piece, ofPiece);
  return q;
}

// ---- one visit ---------------------------------------------------------------------------------

struct Edges {
  double shortest, longest;
};

/// The star under visit; kept to save allocations.
struct Visit {
  int count = 0;                 // of elements
  std::vector<Vec3> edges = {};  // to the neighbours
  StarBlocks star = {};
  double delta = 0;
};

/// Fills the star of a row; returns the edges at its node. In two passes: a vector load right after
/// the scalar stores it reads would wait for them.
Edges gatherStar(const Smoother& S, int row, Visit& visit) {
  const Vec3 x = S.M.x[S.order[row]];
  double shortest = unbounded, longest = 0;
  visit.edges.clear();
  for (int k = S.nearStart[row]; k < S.nearStart[row + 1]; ++k) {
    const Vec3 edge = S.M.x[S.near[k]] - x;
    shortest = std::min(shortest, norm2(edge));
    longest = std::max(longest, norm2(edge));
    visit.edges.push_back(edge);
  }
  const int begin = S.starStart[row], count = S.starStart[row + 1] - begin;
  const int blocks = (count + lanes - 1) / lanes;
  visit.count = count;
  visit.star.resize(blocks);
  for (int j = 0; j < lanes * blocks; ++j) {
    const StarEntry& e = S.star[begin + std::min(j, count - 1)];
    visit.star[j / lanes].set(j % lanes, S.corners[e.corner], visit.edges[e.a], visit.edges[e.b],
                              visit.edges[e.c]);
  }
  for (StarBlock& block : visit.star) closedForm(block);
  visit.star.back().clearFrom(count - lanes * (blocks - 1));
  return {std::sqrt(shortest), std::sqrt(longest)};
}

constexpr double roundingOfF = 1e-14;  // relative: a smaller decrease of f is lost in its sum

constexpr double mostNewtonSteps = 1.7;  // (t − .58 t²) > c1 t

/// [departure] Whether t meets the first Wolfe condition for certain: f is not tried then.
bool isSure(const Smoother& S, const Visit& visit, const Direction& d, double t) {
  return d.newton && t <= mostNewtonSteps && visit.delta == 0 && S.penalty.scale == 0 &&
         allSmall(visit.star, t * d.p);
}

/// [§3.7.4] An inner node: one Newton step. Returns the displacement.
double visitInner(Smoother& S, int n, const Visit& visit, const Edges& edges) {
  const StarBlocks& star = visit.star;
  constexpr Mat3 unit{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  const auto derivatives = [&](double leastSlope) {
    return objectiveOf(star, visit.delta, S.penalty, leastSlope);
  };
  const Objective o = derivatives(-1);
  const Direction d = descentDirection(o, derivatives, unit, edges.longest);
  if (!(-d.slope > roundingOfF * o.f)) return 0;
  const auto value = [&](double t) { return valueAt(star, t * d.p, visit.delta, S.penalty); };
  const auto line = [&](double t) {
    const Objective at = objectiveOf(displaced(star, t * d.p), visit.delta, S.penalty);
    return LinePoint{at.f, dot(at.gradient, d.p)};
  };
  const LinePoint atZero{o.f, d.slope};
  double t = std::min(S.relaxation, d.tMax);
  if (S.options.strongWolfe)
    t = wolfeSearch(line, atZero, S.relaxation, d.tMax).t;
  else if (!isSure(S, visit, d, t))
    t = armijoSearch(value, atZero, t);
  S.M.x[n] += t * d.p;
  return t * norm(d.p);
}

/// [departure] Whether the surface triangles at n stay counter-clockwise in 𝓤 with n at this
/// parameter, and folded ones come nearer to it. While elements are inverted f alone lets a node
/// slide past its neighbours, or a rim node round a corner, from where no descent brings it back.
bool staysUnfolded(Smoother& S, int n, Vec2 parameter) {
  if (S.sheetStart.empty()) return true;
  const Vec2 before = S.M.parameter[n];
  const auto twiceArea = [&](const SheetTriangle& t, Vec2 at) {
    Vec2 u, a, b;
    S.M.parameter[n] = at;
    const bool known = parameterOn(S.M, n, t.label, u) && parameterOn(S.M, t.a, t.label, a) &&
                       parameterOn(S.M, t.b, t.label, b);
    return known ? cross(a - u, b - u) : -unbounded;
  };
  bool unfolded = true;
  for (int k = S.sheetStart[n]; k < S.sheetStart[n + 1] && unfolded; ++k) {
    const double area = twiceArea(S.sheet[k], parameter);
    unfolded = area > 0 || area > twiceArea(S.sheet[k], before);
  }
  S.M.parameter[n] = before;
  return unfolded;
}

/// [departure] Nodes that press against each other's triangles end in ones without area in 𝓤, whose
/// edges stop every step (`staysUnfolded`) although there is a way along them. So while the mesh
/// stays tangled each triangle of an inner surface node adds the mean of them over its own area to
/// f, by a small weight: a node slides along what it cannot pass.
class SheetBarrier {
 public:
  SheetBarrier(const Smoother& S, int n);
  /// Its value with the node's parameter changed by p.
  double value(Vec2 p) const {
    double sum = 0;
    for (const Term& t : terms_) {
      const double area = t.area + t.slope.x * p.x + t.slope.y * p.y;
      sum += area > 0 ? scale_ / area : unbounded;
    }
    return sum;
  }
  void addTo(Objective& o) const;

 private:
  struct Term {
    double area;  // twice, in 𝓤
    Vec2 slope;   // of area, in the node's parameter
  };
  std::vector<Term> terms_;
  double scale_ = 0;
};

SheetBarrier::SheetBarrier(const Smoother& S, int n) {
  constexpr double weight = .03;  // [choice] of .003 to 1; all help alike
  if (!S.stuck || S.sheetStart.empty() || S.M.dimension[n] != 2) return;
  const Vec2 u = S.M.parameter[n];
  double sum = 0;
  for (int k = S.sheetStart[n]; k < S.sheetStart[n + 1]; ++k) {
    const SheetTriangle& t = S.sheet[k];
    Vec2 a, b;
    if (!parameterOn(S.M, t.a, t.label, a) || !parameterOn(S.M, t.b, t.label, b)) continue;
    const double area = cross(a - u, b - u);
    sum += std::abs(area);
    if (area > 0) terms_.push_back({area, {a.y - b.y, b.x - a.x}});
  }
  scale_ = weight * sum / std::max(1, S.sheetStart[n + 1] - S.sheetStart[n]);
}

void SheetBarrier::addTo(Objective& o) const {
  for (const Term& t : terms_) {
    const double f = scale_ / t.area, x = t.slope.x / t.area, y = t.slope.y / t.area;
    o.f += f;
    o.gradient += Vec3{-f * x, -f * y, 0};
    o.hessian =
        o.hessian + Mat3{{2 * f * x * x, 2 * f * x * y, 0}, {2 * f * x * y, 2 * f * y * y, 0}, {}};
  }
}

/// Step of the paper's differences, relative to the shortest edge. Second derivatives have errors
/// of 1e-8 by truncation and by cancellation.
constexpr double differenceStep = 1e-4;

/// OptimizeOptions::accept is asked for so many steps, each half the last.
constexpr int rejectedSteps = 3;

/// [§3.7.3, eq. (10), (11)] A surface or curve node: a Newton step in its parameters. Returns the
/// displacement.
///   [departure] Armijo's condition alone: at the kinks of ϕ and γ the curvature condition may hold
///   nowhere
double visitSliding(Smoother& S, int n, const Visit& visit, const Edges& edges) {
  const StarBlocks& star = visit.star;
  const Vec2 u = S.M.parameter[n];
  const Vec3 x = S.M.x[n];
  const Place here = placeOf(S.M, n, u);
  if (!here.inside) return 0;
  const Mat3& D = here.derivative;
  const int count = S.M.dimension[n];
  Place at = here;
  const SheetBarrier barrier(S, n);
  const auto F = [&](Vec2 change) {
    at = placeOf(S.M, n, u + change);
    if (!at.inside) return unbounded;
    return valueAt(star, at.x - x, visit.delta, S.penalty) + barrier.value(change);
  };
  const double e = differenceStep * edges.shortest;
  const auto derivatives = [&](double leastSlope) {
    if (S.options.numericalDerivatives)
      return byDifferences(F, count, {e / norm(D.c0), e / norm(D.c1)});
    Objective o = inParameters(objectiveOf(star, visit.delta, S.penalty, leastSlope), D, count);
    barrier.addTo(o);
    return o;
  };
  const Objective o = derivatives(-1);
  const Direction d = descentDirection(o, derivatives, D, edges.longest);
  if (!(-d.slope > roundingOfF * o.f)) return 0;
  const auto unfolded = [&](double t) {
    const double value = F({t * d.p.x, t * d.p.y});
    return std::isfinite(value) && staysUnfolded(S, n, at.parameter) ? value : unbounded;
  };
  double t = std::min(S.relaxation, d.tMax);
  for (int rejected = 0;; t /= 2) {
    t = armijoSearch(unfolded, {o.f, d.slope}, t);
    if (t == 0) return 0;
    if (!S.options.accept || S.options.accept(n, at.x, at.parameter)) break;
    if (++rejected == rejectedSteps) return 0;
  }
  S.M.x[n] = at.x;
  S.M.parameter[n] = at.parameter;
  return norm(at.x - x);
}

constexpr double starLadder[3] = {1e-2, 1e-4, 1e-6};  // μ of the star's mean |σ|

/// [§2 choice] δ of the star under visit: 0 where it is valid.
double starDelta(const Smoother& S, const Visit& visit) {
  double least = unbounded, mean = 0;
  for (int j = 0; j < visit.count; ++j) {
    const double sigma = visit.star[j / lanes].sigma[j % lanes];
    least = std::min(least, sigma);
    mean += std::abs(sigma) / visit.count;
  }
  return mean > 0 ? mean * chooseDelta(least / mean, starLadder[S.rung]) : S.delta;
}

/// [§3.7.4, Algorithm 2] smoothNode: returns the displacement relative to the node's shortest edge.
double smoothNode(Smoother& S, int row, Visit& visit) {
  const int n = S.order[row];
  const Edges edges = gatherStar(S, row, visit);
  if (!(edges.longest > 0)) return 0;
  visit.delta = S.options.starDelta && S.tangled ? starDelta(S, visit) : S.delta;
  const double moved =
      S.freedom[n] == 3 ? visitInner(S, n, visit, edges) : visitSliding(S, n, visit, edges);
  const double edge = std::max(edges.shortest, DBL_EPSILON * edges.longest);
  S.edge[row] = static_cast<float>(edge);
  return moved / edge;
}

// ---- sweeps ------------------------------------------------------------------------------------

bool sweepsLeft(const Smoother& S) { return S.report.sweeps < S.options.maxSweeps; }

void countSweep(Smoother& S, double disp) {
  ++S.report.sweeps;
  if (!S.options.onSweep) return;
  const std::vector<double> q = qualitiesOf(S, S.elements);
  const double least = q.empty() ? 1 : *std::min_element(q.begin(), q.end());
  const int inverted = least > 0 ? 0 : static_cast<int>(std::count(q.begin(), q.end(), 0.));
  S.options.onSweep({S.report.sweeps, inverted, least, disp});
}

void wakeNode(Smoother& S, int n) { S.awake[n].store(1, std::memory_order_relaxed); }

void wakeNeighbours(Smoother& S, int row) {
  for (int k = S.nearStart[row]; k < S.nearStart[row + 1]; ++k) wakeNode(S, S.near[k]);
}

/// Visits nodes of one colour, given by their rows. Returns the largest displacement.
double visitRows(Smoother& S, const int* rows, int count) {
  Visit visit;
  double disp = 0;
  for (int k = 0; k < count; ++k) {
    const int row = rows[k], n = S.order[row];
    const double moved = smoothNode(S, row, visit);
    disp = std::max(disp, moved);
    S.moved[n] |= moved > 0;
    S.awake[n].store(moved > S.wake, std::memory_order_relaxed);
    if (moved <= S.wake) continue;
    wakeNeighbours(S, row);
    if (S.penalty.scale == 0) S.reached[n] = 1;
  }
  return disp;
}

constexpr int rowsPerTask = 32;  // some 30 μs

/// [§3.7.4, Algorithm 2] The body of its while loop over the nodes whose star has moved: returns
/// disp.
double sweepNodes(Smoother& S) {
  std::vector<double> moved(S.order.size() / rowsPerTask + 1, 0);  // of the k-th piece of a colour
  std::vector<int> rows;
  for (std::size_t c = 0; c + 1 < S.colourStart.size(); ++c) {
    rows.clear();
    for (int row = S.colourStart[c]; row < S.colourStart[c + 1]; ++row)
      if (S.awake[S.order[row]].load(std::memory_order_relaxed)) rows.push_back(row);
    S.report.visits += static_cast<std::int64_t>(rows.size());
    S.crew.forPieces(0, static_cast<int>(rows.size()), rowsPerTask, [&](int k, int from, int to) {
      moved[k] = std::max(moved[k], visitRows(S, &rows[from], to - from));
    });
  }
  const double disp = *std::max_element(moved.begin(), moved.end());
  countSweep(S, disp);
  return disp;
}

// ---- acceleration ------------------------------------------------------------------------------

constexpr int mostMixed = 8;  // sweeps

/// Aᵀ A and Aᵀ r of a least squares problem with few columns, and rᵀ r.
struct NormalEquations {
  double AA[mostMixed][mostMixed] = {}, Ar[mostMixed] = {}, rr = 0;

  void operator+=(const NormalEquations& other) {
    for (int i = 0; i < mostMixed; ++i) {
      for (int j = 0; j < mostMixed; ++j) AA[i][j] += other.AA[i][j];
      Ar[i] += other.Ar[i];
    }
    rr += other.rr;
  }
  /// By elimination; `ridge` (of the trace) keeps columns apart that floats cannot tell apart.
  std::array<double, mostMixed> solve(int m) {
    constexpr double ridge = 1e-10;
    std::array<double, mostMixed> gamma{};
    double trace = DBL_MIN;
    for (int i = 0; i < m; ++i) trace += AA[i][i];
    for (int i = 0; i < m; ++i) AA[i][i] += ridge * trace;
    for (int i = 0; i < m; ++i)
      for (int j = i + 1; j < m; ++j) {
        const double factor = AA[j][i] / AA[i][i];
        for (int k = i; k < m; ++k) AA[j][k] -= factor * AA[i][k];
        Ar[j] -= factor * Ar[i];
      }
    for (int i = m - 1; i >= 0; --i) {
      for (int k = i + 1; k < m; ++k) Ar[i] -= AA[i][k] * gamma[k];
      gamma[i] = Ar[i] / AA[i][i];
    }
    return gamma;
  }
};

/// [§3.7.4 departure] Anderson's acceleration: sweeps hardly move long waves, but all in nearly the
/// same way. From the last changes ΔR of a sweep's displacements r = G(x) − x and ΔG of its results
/// G(x) the next start is x = G − Σ γ_j ΔG_j, where γ makes |r − Σ γ_j ΔR_j| least, in local
/// edges.
/// Mixed are the positions of inner nodes and u of surface nodes (which do not count in γ); s of
/// curve nodes is left to the sweeps.
///   source  Anderson 1965; Walker and Ni 2011
class Anderson {
 public:
  explicit Anderson(Smoother& smoother) : S(smoother) {}
  void beforeSweep() { start_ = states(); }
  void afterSweep();
  /// Root mean square of the inner nodes' displacements in the last sweep, in local edges.
  double meanDisp() const { return std::sqrt(last_ / std::max(1, rows())); }

 private:
  using Change = std::array<float, 3>;  // a trial only: few digits will do
  int memory() const { return S.options.acceleration; }
  int rows() const { return static_cast<int>(S.order.size()); }
  std::vector<Vec3> states() const;
  void setState(int row, Vec3 state);
  void record();
  void recordSigma();
  NormalEquations normalEquations() const;
  void mix(const std::array<double, mostMixed>& gamma);
  bool undoInvalid();

  Smoother& S;
  std::vector<float> sigma_;                     // [elements] after the sweep
  int recorded_ = 0;                             // sweeps since the last restart
  double last_ = 0;                              // |r|² of the last sweep
  std::vector<Vec3> start_, plain_, lastPlain_;  // [rows] x, G(x), and that before
  std::vector<Change> r_, lastR_, dR_[mostMixed], dG_[mostMixed];  // [rows]
};

std::vector<Vec3> Anderson::states() const {
  std::vector<Vec3> x(S.order.size());
  S.crew.forPieces(0, rows(), piece, [&](int, int from, int to) {
    for (int row = from; row < to; ++row) {
      const int n = S.order[row];
      if (S.freedom[n] == 3) x[row] = S.M.x[n];
      if (S.freedom[n] == 2 && !S.options.accept)
        x[row] = {S.M.parameter[n].x, S.M.parameter[n].y, 0};
    }
  });
  return x;
}

void Anderson::setState(int row, Vec3 state) {
  const int n = S.order[row];
  if (S.freedom[n] == 3) S.M.x[n] = state;
  if (S.freedom[n] != 2 || S.options.accept) return;
  const Place at = placeOf(S.M, n, {state.x, state.y});
  if (!at.inside) return;
  S.M.x[n] = at.x;
  S.M.parameter[n] = at.parameter;
}

std::array<float, 3> difference(Vec3 a, Vec3 b) {
  const Vec3 d = a - b;
  return {static_cast<float>(d.x), static_cast<float>(d.y), static_cast<float>(d.z)};
}

/// σ after the sweep.
void Anderson::recordSigma() {
  sigma_.resize(S.elements.size());
  S.crew.forPieces(0, static_cast<int>(sigma_.size()), piece, [&](int, int from, int to) {
    for (int i = from; i < to; ++i) sigma_[i] = static_cast<float>(sigmaOf(S, S.elements[i]));
  });
}

/// r, and from the second sweep on ΔR and ΔG in place of the oldest.
void Anderson::record() {
  plain_ = states();
  r_.resize(plain_.size());
  const bool hasLast = recorded_ > 0;
  const int place = hasLast ? (recorded_ - 1) % memory() : 0;
  if (hasLast) dR_[place].resize(r_.size()), dG_[place].resize(r_.size());
  S.crew.forPieces(0, rows(), piece, [&](int, int from, int to) {
    for (int row = from; row < to; ++row) {
      r_[row] = difference(plain_[row], start_[row]);
      if (!hasLast) continue;
      for (int k = 0; k < 3; ++k) dR_[place][row][k] = r_[row][k] - lastR_[row][k];
      dG_[place][row] = difference(plain_[row], lastPlain_[row]);
    }
  });
}

NormalEquations Anderson::normalEquations() const {
  const int m = std::min(recorded_, memory());
  const auto ofPiece = [&](int from, int to) {
    NormalEquations sum;
    const auto dot3 = [](const Change& a, const Change& b) {
      return double(a[0]) * b[0] + double(a[1]) * b[1] + double(a[2]) * b[2];
    };
    for (int row = from; row < to; ++row) {
      const double edge = S.edge[row];
      if (S.freedom[S.order[row]] != 3 || edge == 0) continue;
      const double weight = 1 / (edge * edge);
      sum.rr += weight * dot3(r_[row], r_[row]);
      for (int i = 0; i < m; ++i) {
        sum.Ar[i] += weight * dot3(dR_[i][row], r_[row]);
        for (int j = 0; j < m; ++j) sum.AA[i][j] += weight * dot3(dR_[i][row], dR_[j][row]);
      }
    }
    return sum;
  };
  return sumOfPieces<NormalEquations>(S.crew, 0, rows(), piece, ofPiece);
}

/// Moves the nodes by −Σ γ_j ΔG_j, but for those that it would move too little to be visited.
void Anderson::mix(const std::array<double, mostMixed>& gamma) {
  const int m = std::min(recorded_, memory());
  S.crew.forPieces(0, rows(), piece, [&](int, int from, int to) {
    for (int row = from; row < to; ++row) {
      Vec3 d;
      for (int j = 0; j < m; ++j)
        d += gamma[j] * Vec3{dG_[j][row][0], dG_[j][row][1], dG_[j][row][2]};
      const double least = S.freedom[S.order[row]] == 3 ? S.wake * S.edge[row] : 0;
      if (!(norm2(d) > least * least)) continue;
      setState(row, plain_[row] - d);
      wakeNode(S, S.order[row]);
      wakeNeighbours(S, row);
    }
  });
}

/// Below this part of an element's σ after the sweep the mixture went astray: near an inverted
/// state sweeps move little as well.
constexpr double keptSigma = .5;

/// Puts the nodes of elements that lost σ and of folded sheets back to G(x). Returns whether there
/// were any.
bool Anderson::undoInvalid() {
  const int count = static_cast<int>(S.elements.size());
  std::vector<std::vector<int>> lost(count / piece + 1);
  S.crew.forPieces(0, count, piece, [&](int k, int from, int to) {
    for (int i = from; i < to; ++i)
      if (!(sigmaOf(S, S.elements[i]) > keptSigma * sigma_[i])) lost[k].push_back(S.elements[i]);
  });
  std::vector<int> undone;
  for (const std::vector<int>& ofPiece : lost)
    for (int E : ofPiece) undone.insert(undone.end(), S.M.tets[E].begin(), S.M.tets[E].end());
  for (int n : S.order)
    if (S.freedom[n] == 2 && !staysUnfolded(S, n, S.M.parameter[n])) {
      undone.push_back(n);
      for (int k = S.sheetStart[n]; k < S.sheetStart[n + 1]; ++k)
        undone.insert(undone.end(), {S.sheet[k].a, S.sheet[k].b});
    }
  for (int n : undone)
    if (S.rowOf[n] >= 0) setState(S.rowOf[n], plain_[S.rowOf[n]]);
  return !undone.empty();
}

constexpr double growth = 2;   // of |r|: the last changes say nothing about this sweep
constexpr int undoRounds = 4;  // then all nodes go back

void Anderson::afterSweep() {
  record();
  NormalEquations equations = normalEquations();
  if (equations.rr > growth * growth * last_) recorded_ = 0;
  last_ = equations.rr;
  if (recorded_ > 0) {
    recordSigma();
    mix(equations.solve(std::min(recorded_, memory())));
    int rounds = 0;
    while (undoInvalid())
      if (++rounds == undoRounds) {
        for (int row = 0; row < rows(); ++row) setState(row, plain_[row]);
        recorded_ = 0;
        break;
      }
  }
  lastR_.swap(r_);
  lastPlain_.swap(plain_);
  ++recorded_;
}

// ---- global descent: all inner nodes at once ---------------------------------------------------

struct Functional {
  double F, sigmaMin;
};

/// Weight of (1 + σ²)/(2h) beside η. Without it elements shrink to points, since η with h(σ) tends
/// to 0 there; with 1/8 the cube turned by 3 rad stays tangled.
constexpr double volumeWeight = 1;

Mat3 jacobianOf(const Smoother& S, int E) {
  const std::array<int, 4>& tet = S.M.tets[E];
  const std::array<Vec3, 4>& g = S.gradients[S.shapeOf[E]];
  const Vec3 x = S.M.x[tet[0]];
  Mat3 J{};
  for (int k = 1; k < 4; ++k) J = J + outer(S.M.x[tet[k]] - x, g[k]);
  return J;
}

/// Σ η + (1 + σ²)/(2h) over the mesh, with its gradient at the free inner nodes, σ_min, and the
/// diagonal of the Hessian's part 2 η |g|²/N.
///   source  Garanzha et al., Foldover-free maps in 50 lines of code
Functional meshFunctional(const Smoother& S, double delta, std::vector<Vec3>& gradient,
                          std::vector<double>& diagonal) {
  Functional sum{0, unbounded};
  gradient.assign(S.M.x.size(), {});
  diagonal.assign(S.M.x.size(), 0);
  for (std::size_t first = 0; first < S.elements.size(); first += lanes) {
    const int count = static_cast<int>(std::min<std::size_t>(lanes, S.elements.size() - first));
    Mat3 J[lanes];
    Lanes sigma, e, r;
    std::fill(sigma, sigma + lanes, 1.);
    for (int i = 0; i < count; ++i) {
      J[i] = jacobianOf(S, S.elements[first + i]);
      sigma[i] = det(J[i]);
    }
    regularize(sigma, delta, e, r);
    for (int i = 0; i < count; ++i) {
      const int E = S.elements[first + i];
      const std::array<int, 4>& tet = S.M.tets[E];
      const std::array<Vec3, 4>& g = S.gradients[S.shapeOf[E]];
      const double eta = e[i] * norm2(J[i]), square = 1 + sigma[i] * sigma[i];
      const double volume =
          volumeWeight / 2 * (3 * e[i]) * std::sqrt(3 * e[i]);  // 1/h = (3e)^(3/2)
      const double slope = volume * (2 * sigma[i] - square * r[i]) - 2. / 3 * eta * r[i];  // ∂/∂σ
      const Mat3 D = (2 * e[i]) * J[i] + slope * cofactor(J[i]);  // ∂/∂J
      sum.F += eta + volume * square;
      sum.sigmaMin = std::min(sum.sigmaMin, sigma[i]);
      for (int k = 0; k < 4; ++k)
        if (S.freedom[tet[k]] == 3) {
          gradient[tet[k]] += D * g[k];
          diagonal[tet[k]] += 2 * e[i] * norm2(g[k]);
        }
    }
  }
  return sum;
}

double product(const std::vector<Vec3>& a, const std::vector<Vec3>& b) {
  double sum = 0;
  for (std::size_t n = 0; n < a.size(); ++n) sum += dot(a[n], b[n]);
  return sum;
}

void addMultiple(std::vector<Vec3>& a, double t, const std::vector<Vec3>& b) {
  for (std::size_t n = 0; n < a.size(); ++n) a[n] += t * b[n];
}

/// A displacement d, the change y of the gradient by it, and d·y.
struct LbfgsPair {
  std::vector<Vec3> d, y;
  double dy;
};

/// What the inverse of the diagonal is to be multiplied by to measure y of the last pair as that of
/// the Hessian does: a first step of 1 is then mostly the right one (1.3 trials a step, not 4.3).
double inverseScale(const LbfgsPair& pair, const std::vector<double>& diagonal) {
  double yy = 0;
  for (std::size_t n = 0; n < diagonal.size(); ++n)
    if (diagonal[n] > 0) yy += norm2(pair.y[n]) / diagonal[n];
  return pair.dy / yy;
}

/// L-BFGS direction from the last pairs and the diagonal, by the two-loop recursion. [33]
std::vector<Vec3> lbfgsDirection(const std::vector<LbfgsPair>& pairs,
                                 const std::vector<Vec3>& gradient,
                                 const std::vector<double>& diagonal) {
  std::vector<Vec3> p(gradient.size());
  std::vector<double> alpha(pairs.size());
  addMultiple(p, -1, gradient);
  for (std::size_t k = pairs.size(); k-- > 0;) {
    alpha[k] = product(pairs[k].d, p) / pairs[k].dy;
    addMultiple(p, -alpha[k], pairs[k].y);
  }
  const double scale = pairs.empty() ? 1 : inverseScale(pairs.back(), diagonal);
  for (std::size_t n = 0; n < p.size(); ++n)
    if (diagonal[n] > 0) p[n] = (scale / diagonal[n]) * p[n];
  for (std::size_t k = 0; k < pairs.size(); ++k)
    addMultiple(p, alpha[k] - product(pairs[k].y, p) / pairs[k].dy, pairs[k].d);
  return p;
}

constexpr std::size_t lbfgsPairs = 8;
constexpr int lbfgsIterations = 150;    // per δ
constexpr double lbfgsDecrease = 1e-4;  // of F in one step, relative: below it δ is chosen anew

/// L-BFGS on the functional at one δ, from the pairs of the last one. Returns its last value.
Functional descend(Smoother& S, double delta, std::vector<LbfgsPair>& pairs) {
  std::vector<Vec3> gradient, newGradient;
  std::vector<double> diagonal;
  Functional at = meshFunctional(S, delta, gradient, diagonal);
  for (int k = 0; k < lbfgsIterations; ++k) {
    std::vector<Vec3> p = lbfgsDirection(pairs, gradient, diagonal);
    const std::vector<Vec3> start = S.M.x;
    const double slope = product(p, gradient);
    Functional trial{};
    const auto goTo = [&](double t) {
      S.M.x = start;
      addMultiple(S.M.x, t, p);
      trial = meshFunctional(S, delta, newGradient, diagonal);
      return LinePoint{trial.F, product(newGradient, p)};
    };
    const WolfeStep step = wolfeSearch(goTo, {at.F, slope}, 1, unbounded);
    if (!step.curvature) {
      S.M.x = start;
      pairs.clear();  // of another δ they may mislead
      return at;
    }
    const bool little = at.F - trial.F < lbfgsDecrease * at.F;
    at = trial;
    if (little) return at;
    for (Vec3& v : p) v = step.t * v;
    std::vector<Vec3> y = newGradient;
    addMultiple(y, -1, gradient);
    const double dy = product(p, y);  // > 0 by the curvature condition
    if (pairs.size() == lbfgsPairs) pairs.erase(pairs.begin());
    pairs.push_back({std::move(p), std::move(y), dy});
    gradient.swap(newGradient);
  }
  return at;
}

constexpr int descentRounds = 80;     // choices of δ
constexpr double firstDelta = .5;     // of the mean σ
constexpr double leastDecrease = .1;  // of h(σ_min) from one δ to the next, relative
constexpr double validDelta = 1e-10;  // where no element is inverted: below any σ that matters

/// [choice] Descends on all inner nodes together, for tangled states that one node at a time cannot
/// leave (an inner cube turned by 3 rad inside a fixed hull).
///   source  δ from the last decrease of F: Garanzha et al.
void globalDescent(Smoother& S) {
  double delta = firstDelta, last = 0;
  std::vector<LbfgsPair> pairs;
  for (int round = 0; round < descentRounds && sweepsLeft(S); ++round) {
    const Functional at = descend(S, delta, pairs);
    countSweep(S, 1);
    if (at.sigmaMin > 0) return;
    const double decrease = round == 0 ? leastDecrease : std::max(1 - at.F / last, leastDecrease);
    const double mu = (1 - decrease) * h(at.sigmaMin, delta);
    delta = at.sigmaMin < mu ? std::sqrt(mu * (mu - at.sigmaMin)) : validDelta;
    last = at.F;
  }
}

// ---- Algorithm 2 -------------------------------------------------------------------------------

constexpr double acceleratedRelaxation = 1.5;  // of sweeps that are mixed
constexpr double wakeFraction = .1;  // of maxDisp: a star that moved less is not visited again
/// [departure] Of maxDisp, in the place of wakeFraction where the worst elements are lifted
/// afterwards, which smooths all others too; and the sweeps end where the root mean square of the
/// displacements is as small. To sweep on until no node moves takes 2 to 10 times the visits for
/// the same qualities in the end.
constexpr double settledFraction = 2.5;
/// [departure] Displacement, relative to the shortest edge, that wakes the neighbours while a whole
/// mesh is tangled; nodes of inverted elements are always visited, and all once the mesh is valid.
/// Saves a fifth of the visits of a surface projected far. A heuristic: what it might leave tangled
/// the global descent untangles. Not around active nodes, which are near, nor with a δ of each
/// star.
constexpr double tangledWake = .1;
constexpr int sweepsWithoutProgress = 3;       // that μ is given before the next
constexpr double muLadder[3] = {2.5, 1, .25};  // of options.mu, in turn while the mesh is tangled

/// [choice] Where no descent may follow, a tangled mesh is given up after so many sweeps if more
/// than a tenth of its inverted or flat elements, and not just a few, are left. Measured on
/// projected surfaces: below 1 % in what becomes valid; above 30 %, even after 60 sweeps, in what
/// does not.
constexpr int hopelessSweeps = 10, hopelessCount = 60;
constexpr double hopelessPart = .1;

/// [choice] Most meshes are valid after so many; then the nodes of sheets keep apart.
constexpr int easySweeps = 10;

/// [choice] For so many sweeps elements that are as good as flat count as inverted: where rounding
/// alone makes them valid, a node's way out of them is shorter than the last digit of its
/// coordinates, and no sweep without δ changes them. (Without it 148 of 372 meshes with inner
/// nodes moved to the end of what is valid keep elements with q below .05; with it none does.) Not
/// with a δ of each star, which is 0 there all the same.
constexpr int flatSweeps = 20;

/// [choice] Of lower q a valid element counts as flat while `Smoother::flat`.
constexpr double flatQuality = 1e-4;

/// Whether q = 3 σ^(2/3)/‖J‖² is below flatQuality.
bool isFlat(const Smoother& S, int E) {
  constexpr double third = flatQuality / 3;
  const Mat3 J = jacobianOf(S, E);
  const double sigma = det(J), size2 = third * norm2(J);
  return sigma * sigma < size2 * size2 * size2;
}

struct Validity {
  int inverted = 0, flat = 0;
  double sigmaMin = unbounded;  // 0 at most where an element is flat

  void operator+=(const Validity& other) {
    inverted += other.inverted;
    flat += other.flat;
    sigmaMin = std::min(sigmaMin, other.sigmaMin);
  }
};
/// Of all elements that may change.
///   wakes  the nodes of those inverted or flat, for δ may have changed where nothing has moved
Validity validity(Smoother& S, bool wakes) {
  const auto ofPiece = [&S, wakes](int from, int to) {
    Validity v;
    for (int i = from; i < to; ++i) {
      const int E = S.elements[i];
      const double sigma = sigmaOf(S, E);
      const bool inverted = !(sigma > 0), flat = !inverted && S.flat && isFlat(S, E);
      v += {inverted, flat, flat ? 0 : sigma};
      if (wakes && (inverted || flat))
        for (int n : S.M.tets[E]) wakeNode(S, n);
    }
    return v;
  };
  return sumOfPieces<Validity>(S.crew, 0, static_cast<int>(S.elements.size()), piece, ofPiece);
}

/// μ of the sweep: the next rung where the number of inverted, or flat, elements does not fall.
struct MuSchedule {
  int rung = 0, fewest = std::numeric_limits<int>::max(), waited = 0, tangledSweeps = 0;
  int atFirst = 0;

  bool isHopeless(int bad) const {
    return tangledSweeps == hopelessSweeps && bad > hopelessCount && bad > hopelessPart * atFirst;
  }
  double next(double mu, int bad) {
    if (++tangledSweeps == 1) atFirst = bad;
    if (bad >= fewest && ++waited < sweepsWithoutProgress) return mu * muLadder[rung];
    if (bad >= fewest) rung = (rung + 1) % 3;
    fewest = bad;
    waited = 0;
    return mu * muLadder[rung];
  }
};

/// The nodes' places, and those of sliding ones on their surfaces and curves.
struct Positions {
  std::vector<Vec3> x;
  std::vector<Vec2> parameter;
};

void takeBack(Smoother& S, Positions& places) {
  S.M.x = std::move(places.x), S.M.parameter = std::move(places.parameter);
  places = {};
}

/// [§3.7.4, Algorithm 2] optimizeMesh's loop. While elements are inverted δ comes from the σ_min of
/// all elements that may change and holds for all nodes; afterwards it is 0, and a move that would
/// invert an element has f = ∞. Keeps the last places where a mesh with a δ, for elements that are
/// as good as flat, is valid, and goes on from there rather than give up. Returns whether it
/// converged on a valid mesh.
bool sweepUntilSettled(Smoother& S, Positions& lastValid) {
  MuSchedule schedule;
  bool tangled = true;
  const double settled = S.options.power > 1 ? settledFraction * S.options.maxDisp : 0;
  const double wake = std::max(wakeFraction * S.options.maxDisp, settled);
  const OptimizeOptions& o = S.options;
  const bool wakesLess = o.acceleration > 0 && o.active.empty() && !o.starDelta;
  int flatUntil = o.starDelta ? 0 : std::min(flatSweeps, o.maxTangledSweeps);
  Anderson acceleration(S);
  while (sweepsLeft(S)) {
    S.flat = tangled && S.report.sweeps < flatUntil;
    const Validity v = tangled ? validity(S, wakesLess) : Validity{0, 0, 1};
    const int bad = v.inverted + v.flat;
    tangled = bad > 0;
    if (tangled && v.inverted == 0) lastValid = {S.M.x, S.M.parameter};
    if (tangled && (schedule.tangledSweeps >= o.maxTangledSweeps ||
                    (!o.globalDescent && schedule.isHopeless(bad)))) {
      if (!lastValid.x.empty()) {  // what flat elements cost is taken back; on without them
        takeBack(S, lastValid);
        flatUntil = 0;
      } else if (o.globalDescent) {
        globalDescent(S);
        schedule = {};
      } else {
        return false;
      }
      for (int n : S.order) wakeNode(S, n);
      continue;
    }
    if (wakesLess && S.tangled && !tangled)
      for (int n : S.order) wakeNode(S, n);
    S.wake = tangled && wakesLess ? tangledWake : wake;
    S.delta = tangled ? chooseDelta(v.sigmaMin, schedule.next(S.options.mu, bad)) : 0;
    S.tangled = tangled;
    S.stuck = tangled && schedule.tangledSweeps > easySweeps;
    S.rung = schedule.rung;
    const bool accelerated = !tangled && S.options.acceleration > 0;
    if (accelerated) acceleration.beforeSweep();
    S.relaxation = accelerated ? acceleratedRelaxation : S.options.relaxation;
    S.report.disp = sweepNodes(S);
    if (!tangled && S.report.disp <= S.options.maxDisp) return true;
    if (accelerated) acceleration.afterSweep();
    if (accelerated && acceleration.meanDisp() <= settled) return true;
  }
  return false;
}

/// The loop; a mesh that was valid stays so, also where it ends before flat elements are cured.
bool untangleAndSmooth(Smoother& S) {
  Positions lastValid;
  const bool converged = sweepUntilSettled(S, lastValid);
  if (!converged && !lastValid.x.empty() && validity(S, false).inverted > 0) takeBack(S, lastValid);
  return converged;
}

// ---- the worst elements ------------------------------------------------------------------------

constexpr double worstFraction = .004;  // of the elements count as the worst ones,
constexpr std::size_t worstCount = 10;  // but at least so many
constexpr int liftRounds = 40;          // each a sweep
constexpr double liftMeanLoss = .015;  // of mean q: the rounds end there (the last sweeps win back)
constexpr double liftMinGain = .002;   // or where the lowest q rises by less
constexpr int idleRounds = 2;          // in so many rounds,
constexpr double liftStill = .001;     // or at once where neither it nor q_w rises by this
constexpr double perfect = .9995;      // a lowest q that is not lifted
constexpr double lowQuality = .45;     // below it the lift has patience,
constexpr double lowGuarded = .7;      // below this where moves may be refused:
constexpr int patientRounds = 60, patientIdleRounds = 8;
constexpr double liftWake = .05;  // unrest for a visit: only what happens near the worst counts
constexpr int lastSweeps = 4, lastGuarded = 8;
constexpr double lastWake = .01;      // unrest in the last sweeps, and the displacement relative to
constexpr double lastMaxDisp = 1e-3;  // the shortest edge where they end
constexpr double liftReach = .03;  // change of (η/η_w)^power from one round to the next: below it
                                   // an element's nodes are not visited again
/// η_w at least: of η of the worst. 1.3^64 = 2e7: these outweigh all others; with less of them the
/// others would be lifted farther than what is lowest, with more (1.07) sets of faults end lower.
constexpr double liftRatio = 1.3;

/// The elements that the sweeps have reached (the others, as those at earlier surfaces, were lifted
/// before), their q, the lowest, the mean, and what bounds the worst of them from above.
struct WorstElements {
  std::vector<int> element;
  std::vector<double> q;  // [element]
  double lowest = 1, mean = 1, bound = 1;
};

WorstElements reachedElements(Smoother& S) {
  WorstElements worst;
  for (int E : S.elements)
    if (isAtAny(S.reached, S.M.tets[E])) worst.element.push_back(E);
  worst.q = qualitiesOf(S, worst.element);
  S.moved.assign(S.moved.size(), 0);
  return worst;
}

/// What is asked of all q: the lowest, the sum, and those up to a bound.
struct LowQualities {
  double lowest = unbounded, sum = 0;
  std::vector<double> low = {};

  void operator+=(const LowQualities& other) {
    lowest = std::min(lowest, other.lowest);
    sum += other.sum;
    low.insert(low.end(), other.low.begin(), other.low.end());
  }
};

/// Anew after sweeps: q of the elements at nodes that have moved since, and what follows from them.
void updateWorst(Smoother& S, WorstElements& worst) {
  constexpr double wide = 1.1;  // the bound rises little from one round to the next
  const int count = static_cast<int>(worst.q.size());
  if (count == 0) return;
  const auto ofPiece = [&](int from, int to) {
    std::vector<int> places, elements;
    for (int i = from; i < to; ++i)
      if (isAtAny(S.moved, S.M.tets[worst.element[i]]))
        places.push_back(i), elements.push_back(worst.element[i]);
    const std::vector<double> now = qualitiesOf(S, elements);  // one piece: no loop within a loop
    for (std::size_t i = 0; i < places.size(); ++i) worst.q[places[i]] = now[i];
    LowQualities part;
    for (int i = from; i < to; ++i) {
      part.lowest = std::min(part.lowest, worst.q[i]);
      part.sum += worst.q[i];
      if (worst.q[i] <= wide * worst.bound) part.low.push_back(worst.q[i]);
    }
    return part;
  };
  LowQualities all = sumOfPieces<LowQualities>(S.crew, 0, count, piece, ofPiece);
  S.moved.assign(S.moved.size(), 0);
  const std::size_t part = static_cast<std::size_t>(worstFraction * count);
  const std::size_t wanted = std::min(worst.q.size(), std::max(worstCount, part));
  if (all.low.size() < wanted) all.low = worst.q;
  const auto last = all.low.begin() + static_cast<std::ptrdiff_t>(wanted - 1);
  std::nth_element(all.low.begin(), last, all.low.end());
  worst.bound = *last;
  worst.lowest = all.lowest;
  worst.mean = all.sum / count;
}

/// The next sweeps are on Σ η + (η/η_w)^power, q_w = 1/η_w, from the nodes on at whose elements the
/// second term has changed since the last ones. By how much: with the larger and the smaller of
/// both q_w, |Δ| = (larger/q)^power c, c = 1 − (smaller/larger)^power. So |Δ| > liftReach where q <
/// larger (c/liftReach)^(1/power).
void aimLift(Smoother& S, const WorstElements& worst, double qw, double wake) {
  const double power = S.options.power, larger = std::max(qw, S.penalty.scale);
  const double c = 1 - std::pow(std::min(qw, S.penalty.scale) / larger, power);
  const double reach = larger * std::pow(c / liftReach, 1 / power);
  S.penalty = {1, qw, power};
  S.relaxation = S.options.relaxation;
  S.wake = wake;
  S.crew.forPieces(0, static_cast<int>(worst.q.size()), piece, [&](int, int from, int to) {
    for (int i = from; i < to; ++i)
      if (worst.q[i] < reach)
        for (int n : S.M.tets[worst.element[i]]) wakeNode(S, n);
  });
}

/// [§3.7.4 departure] Raises the worst elements of a valid, settled mesh: Σ η + (η/η_w)^power, with
/// η_w the distortion that the worst .4 % exceed, anew for each sweep; the others keep Σ η. Ends
/// where the lowest q rises no more. Last sweeps with η_w that of the worst element let all the
/// others relax and win the mean back.
void liftWorst(Smoother& S) {
  WorstElements worst = reachedElements(S);
  updateWorst(S, worst);
  const double meanAtStart = worst.mean;
  if (worst.lowest > perfect) return;
  const bool guarded = S.options.accept != nullptr;
  double highest = worst.lowest;
  for (int round = 0, idle = 0; sweepsLeft(S); ++round) {
    const bool low = worst.lowest < (guarded ? lowGuarded : lowQuality);
    if (round >= (low ? patientRounds : liftRounds)) break;
    if (idle >= (low ? patientIdleRounds : idleRounds)) break;
    const double bound = worst.bound, lowest = worst.lowest;
    aimLift(S, worst, std::min(bound, liftRatio * lowest), liftWake);
    sweepNodes(S);
    updateWorst(S, worst);
    if (worst.mean < meanAtStart - liftMeanLoss) break;
    const bool still = worst.bound < bound + liftStill && worst.lowest < lowest + liftStill;
    if (still && !low) break;
    const bool rises = worst.lowest >= highest + liftMinGain;
    idle = rises ? 0 : idle + 1;
    if (rises) highest = worst.lowest;
  }
  aimLift(S, worst, worst.lowest, lastWake);
  for (int k = 0; k < (guarded ? lastGuarded : lastSweeps) && sweepsLeft(S); ++k)
    if (sweepNodes(S) <= lastMaxDisp) return;
}

// ---- input -------------------------------------------------------------------------------------

[[noreturn]] void refuse(const std::string& what) {
  throw InputError("optimizeMesh (§3.7): " + what);
}

/// Empty, or what makes the parameterization unfit for locate() and varphi().
std::string faultOf(const Parametrization& P) {
  if (P.points.empty() || P.u.size() != P.points.size())
    return "needs points, and as many parameters u";
  for (const std::array<int, 3>& t : P.triangles)
    for (int n : t)
      if (n < 0 || n >= static_cast<int>(P.points.size())) return "has a triangle out of range";
  return P.gridSize < 1 ? "has no locator; call buildLocator() first" : "";
}

/// Empty, or what makes the curve of the mesh unfit for gamma() and curveParameter().
std::string faultOf(const Curve& C, const Mesh& M) {
  if (C.points.size() < 2 || C.s.size() != C.points.size() + C.closed)
    return "needs two points at least, and their arc lengths";
  if (C.s[0] != 0 || !std::is_sorted(C.s.begin(), C.s.end()) || !(C.s.back() > 0))
    return "has arc lengths that do not grow from 0";
  for (const Curve::Side& side : C.sides) {
    const std::size_t count = side.surface > 0 ? M.surfaces.size() : M.patches.size();
    const std::size_t index = std::abs(side.surface);
    if (index < 1 || index > count || side.u.size() != C.points.size())
      return "has a side without a surface, or without u of each point";
  }
  return "";
}

}  // namespace

void checkGeometry(const Mesh& M, const std::string& who) {
  const auto refuseAny = [&](const std::string& what, std::size_t i, const std::string& fault) {
    if (!fault.empty()) throw InputError(who + ": " + what + std::to_string(i + 1) + ' ' + fault);
  };
  for (std::size_t k = 0; k < M.surfaces.size(); ++k)
    refuseAny("surface ", k, faultOf(M.surfaces[k]));
  for (std::size_t p = 0; p < M.patches.size(); ++p) refuseAny("patch ", p, faultOf(M.patches[p]));
  for (std::size_t c = 0; c < M.curves.size(); ++c) refuseAny("curve ", c, faultOf(M.curves[c], M));
}

void checkOptions(const OptimizeOptions& o, std::size_t nodes) {
  const auto demand = [](bool holds, const char* name, double value, const char* range) {
    char text[100];
    std::snprintf(text, sizeof text, "%s = %g must be %s", name, value, range);
    if (!holds) refuse(text);
  };
  demand(o.maxDisp > 0, "maxDisp", o.maxDisp, "> 0");
  demand(o.maxTangledSweeps >= 1, "maxTangledSweeps", o.maxTangledSweeps, ">= 1");
  demand(o.maxSweeps >= 1, "maxSweeps", o.maxSweeps, ">= 1");
  demand(o.power >= 1 && o.power <= 64, "power", o.power, "in [1, 64]");
  demand(o.mu > 0 && o.mu < 1, "mu", o.mu, "in (0, 1)");
  demand(o.acceleration >= 0 && o.acceleration <= 8, "acceleration", o.acceleration, "in [0, 8]");
  demand(o.threads >= 0, "threads", o.threads, ">= 0");
  demand(o.relaxation >= 1 && o.relaxation < 2, "relaxation", o.relaxation, "in [1, 2)");
  for (const std::vector<int>* list : {&o.fixed, &o.active})
    for (int n : *list)
      if (n < 0 || static_cast<std::size_t>(n) >= nodes)
        refuse((list == &o.fixed ? "fixed node " : "active node ") + std::to_string(n) +
               " must be a node: 0 to " + std::to_string(static_cast<long>(nodes) - 1));
}

namespace {

void checkEntity(const Mesh& M, std::size_t n) {
  const std::string at = "node " + std::to_string(n) + ": ";
  const int entity = M.entity[n], dimension = M.dimension[n];
  const std::size_t index = std::abs(entity);
  if (dimension > 3)
    refuse(at + "dimension " + std::to_string(dimension) + " must be 0, 1, 2 or 3");
  if (dimension == 1 && (entity < 1 || index > M.curves.size()))
    refuse(at + "no curve " + std::to_string(entity) + " of " + std::to_string(M.curves.size()) +
           "; correct Mesh::entity");
  if (dimension != 2) return;
  const std::size_t count = entity > 0 ? M.surfaces.size() : M.patches.size();
  if (entity == 0 || index > count)
    refuse(at + "no surface or patch " + std::to_string(entity) + " of " + std::to_string(count) +
           "; correct Mesh::entity");
}

/// [choice] Length units: σ² of a mesh as small does not underflow, nor overflow of one as large.
constexpr double smallestExtent = 1e-40;

void checkNodes(const Mesh& M) {
  const std::size_t nodes = M.x.size();
  const auto demandSize = [nodes](const char* name, std::size_t size) {
    if (size != nodes)
      refuse(name + (" has " + std::to_string(size)) + " entries, expected " +
             std::to_string(nodes) + ", one per node");
  };
  if (!M.xi.empty()) demandSize("M.xi", M.xi.size());
  Vec3 lo{0, 0, 0}, hi{0, 0, 0};
  for (std::size_t n = 0; n < nodes; ++n) {
    const Vec3 x = M.x[n];
    if (!isFinite(x))
      refuse("node " + std::to_string(n) + " has a coordinate that is not finite; correct M.x");
    if (n == 0) lo = hi = x;
    lo = {std::min(lo.x, x.x), std::min(lo.y, x.y), std::min(lo.z, x.z)};
    hi = {std::max(hi.x, x.x), std::max(hi.y, x.y), std::max(hi.z, x.z)};
    if (!M.xi.empty() && !isFinite(M.xi[n]))
      refuse("node " + std::to_string(n) +
             " has a computational coordinate that is not finite; correct M.xi");
  }
  const double extent = std::max({hi.x - lo.x, hi.y - lo.y, hi.z - lo.z});
  if (!M.tets.empty() && !(extent > smallestExtent && extent < 1 / smallestExtent)) {
    char text[120];
    std::snprintf(text, sizeof text, "the mesh's extent %g must be from %g to %g; scale M.x",
                  extent, smallestExtent, 1 / smallestExtent);
    refuse(text);
  }
  if (M.dimension.empty()) return;
  demandSize("M.dimension", M.dimension.size());
  demandSize("M.entity", M.entity.size());
  demandSize("M.parameter", M.parameter.size());
  for (std::size_t n = 0; n < nodes; ++n) checkEntity(M, n);
  checkGeometry(M, "optimizeMesh (§3.7)");
}

/// Relative to the cube of its longest edge: below it the inverse of its edges has no correct
/// digit.
constexpr double degenerateIdeal = 1e-13;

void checkIndices(const Mesh& M, const std::string& who) {
  const int nodes = static_cast<int>(M.x.size());
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int n : M.tets[E])
      if (n < 0 || n >= nodes)
        throw InputError(who + ": tetrahedron " + std::to_string(E) + " names node " +
                         std::to_string(n) + ", but nodes are 0 to " + std::to_string(nodes - 1));
}

void checkElements(const Mesh& M) {
  checkIndices(M, "optimizeMesh (§3.7)");
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    for (int i = 1; i < 4; ++i)
      for (int j = 0; j < i; ++j)
        if (M.tets[E][i] == M.tets[E][j])
          refuse("tetrahedron " + std::to_string(E) + " names node " +
                 std::to_string(M.tets[E][i]) + " twice");
    if (M.xi.empty()) continue;
    const std::array<Vec3, 4> z = cornersOf(M.xi, M.tets[E]);
    double longest2 = 0;
    for (int i = 1; i < 4; ++i)
      for (int j = 0; j < i; ++j) longest2 = std::max(longest2, norm2(z[i] - z[j]));
    const double longest = std::sqrt(longest2);
    if (!(std::abs(signedVolume6(z)) > degenerateIdeal * longest * longest * longest))
      refuse("tetrahedron " + std::to_string(E) +
             ": its ideal element is degenerate; correct M.xi");
  }
}

}  // namespace

OptimizeOptions OptimizeOptions::paper() {
  OptimizeOptions options;
  options.power = 1;
  options.numericalDerivatives = options.strongWolfe = true;
  options.relaxation = 1;
  options.acceleration = 0;
  options.globalDescent = false;
  return options;
}

OptimizeReport optimizeMesh(Mesh& M, const OptimizeOptions& options) {
  checkOptions(options, M.x.size());
  checkNodes(M);
  checkElements(M);
  Smoother S{M, options};
  S.report.converged = true;
  if (M.tets.empty()) return S.report;
  build(S);
  S.awake = std::vector<std::atomic<unsigned char>>(M.x.size());
  S.reached.assign(M.x.size(), options.active.empty());
  S.moved.assign(M.x.size(), 0);
  for (int n : options.active.empty() ? S.order : options.active) wakeNode(S, n);

  S.report.converged = untangleAndSmooth(S);
  if (S.report.converged && options.power > 1) liftWorst(S);
  S.report.quality = qualityStatistics(M);
  S.report.inverted = S.report.quality.inverted;
  S.report.converged = S.report.converged && S.report.inverted == 0;
  S.report.minQ = S.report.quality.min;
  S.report.meanQ = S.report.quality.mean;
  return S.report;
}

// ==== Table I ===================================================================================

namespace {

/// Elements side by side: their edges from vertex 0, by coordinates.
struct EdgeBlock {
  Lanes e[9];

  void set(int i, const std::array<Vec3, 4>& z) {
    for (int k = 0; k < 3; ++k) {
      const Vec3 edge = z[k + 1] - z[0];
      e[3 * k][i] = edge.x, e[3 * k + 1][i] = edge.y, e[3 * k + 2][i] = edge.z;
    }
  }
  Vec3 edge(int k, int i) const { return {e[3 * k][i], e[3 * k + 1][i], e[3 * k + 2][i]}; }
};

struct Jacobians {
  Lanes N, sigma;  // ‖J‖², det J
};

/// From the edges a, b, c of E^I and p_k of E^P: J = Σ p_k g_kᵀ with the gradients g_0 = b × c/det
/// I and so on.
MECCANO_AVX2_TOO Jacobians jacobiansOf(const EdgeBlock& ideal, const EdgeBlock& physical) {
  Jacobians J;
  for (int i = 0; i < lanes; ++i) {
    const Vec3 a = ideal.edge(0, i), b = ideal.edge(1, i), c = ideal.edge(2, i), bc = cross(b, c);
    const double perVolume = 1 / dot(a, bc);
    const Vec3 g0 = perVolume * bc, g1 = perVolume * cross(c, a), g2 = perVolume * cross(a, b);
    const Vec3 p0 = physical.edge(0, i), p1 = physical.edge(1, i), p2 = physical.edge(2, i);
    J.N[i] = norm2(g0.x * p0 + g1.x * p1 + g2.x * p2) + norm2(g0.y * p0 + g1.y * p1 + g2.y * p2) +
             norm2(g0.z * p0 + g1.z * p1 + g2.z * p2);
    J.sigma[i] = perVolume * dot(p0, cross(p1, p2));
  }
  return J;
}

/// use(E, q) for each of `count` elements E = element(0), element(1), ... in turn. [eq. (7)]
template <class Element, class Use>
void forQualities(const Mesh& M, Ideal ideal, std::size_t count, const Element& element,
                  const Use& use) {
  const IdealElements ideals(M, ideal);
  EdgeBlock I{}, P{};
  for (std::size_t first = 0; first < count; first += lanes) {
    const int inBlock = static_cast<int>(std::min<std::size_t>(lanes, count - first));
    for (int i = 0; i < inBlock; ++i) {
      const int E = element(first + i);
      I.set(i, ideals.of(E));
      P.set(i, cornersOf(M.x, M.tets[E]));
    }
    const Jacobians J = jacobiansOf(I, P);
    const Distortions at = distortionsOf(J, 0, plainEta);
    for (int i = 0; i < inBlock; ++i) {
      const int E = element(first + i);
      const bool inRange = J.sigma[i] > leastH && J.sigma[i] < 1 / leastH && J.N[i] < 1 / leastH;
      use(E, inRange ? 1 / at.eta[i] : quality(jacobian(ideals.of(E), cornersOf(M.x, M.tets[E]))));
    }
  }
}

}  // namespace

std::vector<double> qualities(const Mesh& M, Ideal ideal) {
  checkIndices(M, "qualities (Table I)");
  std::vector<double> all(M.tets.size());
  const auto each = [](std::size_t E) { return static_cast<int>(E); };
  forQualities(M, ideal, all.size(), each, [&all](int E, double q) { all[E] = q; });
  return all;
}

std::vector<double> qualities(const Mesh& M, const std::vector<Vec3>& before,
                              std::vector<double> all) {
  std::vector<char> isOld(M.x.size(), 0);
  for (std::size_t n = 0; n < std::min(M.x.size(), before.size()); ++n)
    isOld[n] = M.x[n] == before[n];
  std::vector<int> changed;
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    const std::array<int, 4>& z = M.tets[E];
    const bool isSame = isOld[z[0]] && isOld[z[1]] && isOld[z[2]] && isOld[z[3]];
    if (!isSame || E >= all.size()) changed.push_back(static_cast<int>(E));
  }
  all.resize(M.tets.size());
  forQualities(
      M, Ideal::computational, changed.size(), [&](std::size_t i) { return changed[i]; },
      [&all](int E, double q) { all[E] = q; });
  return all;
}

QualityStatistics qualityStatistics(const std::vector<double>& all) {
  QualityStatistics table;
  if (all.empty()) return table;
  const int last = static_cast<int>(table.histogram.size()) - 1;
  const double count = static_cast<double>(all.size());
  table.tetrahedra = static_cast<int>(all.size());
  table.min = *std::min_element(all.begin(), all.end());
  table.max = *std::max_element(all.begin(), all.end());
  table.mean = std::accumulate(all.begin(), all.end(), 0.) / count;
  for (double q : all) {
    if (q == 0) ++table.inverted;
    table.stdDev += (q - table.mean) * (q - table.mean) / count;
    ++table.histogram[std::clamp(static_cast<int>((last + 1) * q), 0, last)];
  }
  table.stdDev = std::sqrt(table.stdDev);
  return table;
}

QualityStatistics qualityStatistics(const Mesh& M, Ideal ideal) {
  return qualityStatistics(qualities(M, ideal));
}

}  // namespace meccano
