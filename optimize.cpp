// SPDX-License-Identifier: MIT
//
// Section 3.7, mesh optimization, and the statistics of Table I.
//
//   3.7.1  shape distortion η, quality q, regularized determinant h          eq. (5)–(8)
//   3.7.2  objective function of a node                                      eq. (9)
//   3.7.3  objective function of surface and curve nodes                     eq. (10), (11)
//   3.7.4  Newton, strong Wolfe, Algorithm 2; untangling, the worst elements
//   4      Table I
//
// The time goes into visitNode(): one pass over the elements of a star for f, its gradient and its
// Hessian (a cube root each), one more for the trial step.
#include <algorithm>
#include <cfloat>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <map>
#include <utility>

#include "meccano.hpp"

namespace meccano {
namespace {

constexpr double unbounded = std::numeric_limits<double>::infinity();  // f of an inverted element

// ==== Tools for 3.7: one element as a function of one of its nodes ==============================

// Along a displacement d of the node, ‖J‖² = N + 2 v·d + gg |d|² and σ = σ₀ + s·d, exactly.
struct Moving {
  double N, sigma, gg;  // ‖J‖², det J, |g|² with g the node's gradient in the ideal element
  Vec3 v, s;            // J g = ½ ∂N/∂x,  cof(J) g = ∂σ/∂x
};

// What replaces η in the sum of eq. (9): φ(η) = linear η + (scale η)^power.
struct Penalty {
  double linear, scale, power;
  int integer;  // power, where it is an integer; else -1
};

constexpr Penalty plainEta{1, 0, 1, 1};  // φ = η: eq. (9) as printed

Penalty powerPenalty(double power) {
  if (power == 1) return plainEta;
  const bool whole = power == std::floor(power) && power <= 64;
  return {0, 1, power, whole ? static_cast<int>(power) : -1};
}

double raise(double base, const Penalty& phi) {
  if (phi.integer < 0) return std::pow(base, phi.power);
  double result = 1;
  for (int n = phi.integer; n > 0; n >>= 1, base *= base)
    if (n & 1) result *= base;
  return result;
}

// φ, φ′ η and φ″ η² at η.
struct PenaltyTerms {
  double value, first, second;
};
inline PenaltyTerms penaltyTerms(double eta, const Penalty& phi) {
  if (phi.scale == 0) return {phi.linear * eta, phi.linear * eta, 0};
  const double w = raise(phi.scale * eta, phi), p = phi.power;
  return {phi.linear * eta + w, phi.linear * eta + p * w, p * (p - 1) * w};
}

/// h^(-1/3) by Newton's iteration y ← y (4 − h y³)/3, free of divisions: 3 times faster than pow.
/// The start, from the exponent's bits, is good to 6 %; the error e becomes 2 e² each time: 7e-16
/// after four.
inline double inverseCubeRoot(double h) {
  if (!(h > 1e-290 && h < 1e290)) return 1 / std::cbrt(h);
  std::uint64_t bits;
  std::memcpy(&bits, &h, sizeof bits);
  bits = 0x553EF0FF289DD796u - bits / 3;
  double y;
  std::memcpy(&y, &bits, sizeof y);
  const double third = h / 3;
  for (int k = 0; k < 4; ++k) y *= 4. / 3 - third * (y * y * y);
  return y;
}

// η with h(σ) for |σ|, and R = √(σ² + 4δ²) = ∂σ/∂(ln h).
struct Regularized {
  double eta, R;
};
inline Regularized regularized(double N, double sigma, double delta) {
  if (delta == 0) {
    if (!(sigma > 0)) return {unbounded, 0};
    const double y = inverseCubeRoot(sigma);
    return {N * y * y / 3, sigma};
  }
  const double R = std::sqrt(sigma * sigma + 4 * delta * delta);
  const double hs = sigma >= 0 ? (sigma + R) / 2 : 2 * delta * delta / (R - sigma);
  const double y = inverseCubeRoot(hs);
  return {N * y * y / 3, R};
}

inline Moving displaced(const Moving& e, Vec3 d) {
  return {e.N + 2 * dot(e.v, d) + e.gg * norm2(d), e.sigma + dot(e.s, d), e.gg, e.v + e.gg * d,
          e.s};
}

// Symmetric 3×3, upper half.
struct Symmetric {
  double xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
  Mat3 full() const { return {{xx, xy, xz}, {xy, yy, yz}, {xz, yz, zz}}; }
};

constexpr double convexRatio =
    2. / 3;  // an element's Hessian of η is positive definite from σ/R here on

/// [§3.7.2, eq. (9)] Adds φ(η) of one element, its gradient and its Hessian. With a = ∇η/η = 2v/N −
/// 2s/(3R):
///   Hess η = η { (2 gg/N) I − 4/(3NR) (v sᵀ + s vᵀ) + [4/9 + ⅔ σ/R] s sᵀ/R² }
///   ∇φ(η) = φ′ ∇η,   Hess φ(η) = φ′ Hess η + φ″ ∇η ∇ηᵀ,
/// which is α I + β (v sᵀ + s vᵀ) + κ v vᵀ + ρ s sᵀ.
/// source: derivatives after [32]; minRatio clamps σ/R from below (−1: exact)
inline void addElement(const Moving& e, double delta, const Penalty& phi, double minRatio,
                       double& f, Vec3& gradient, Symmetric& H) {
  const Regularized at = regularized(e.N, e.sigma, delta);
  if (at.eta == unbounded) {
    f = unbounded;
    return;
  }
  const PenaltyTerms p = penaltyTerms(at.eta, phi);
  const double n = 1 / std::max(e.N, DBL_MIN), r = 1 / at.R;
  const double ratio = std::max(e.sigma * r, minRatio);
  f += p.value;
  gradient += (2 * p.first * n) * e.v + (-2. / 3 * p.first * r) * e.s;

  const double alpha = 2 * p.first * e.gg * n;
  const double beta = -4. / 3 * (p.first + p.second) * n * r;
  const double kappa = 4 * p.second * n * n;
  const double rho = (p.first * (4. / 9 + 2. / 3 * ratio) + p.second * (4. / 9)) * r * r;
  const Vec3 a = kappa * e.v + beta * e.s, b = beta * e.v + rho * e.s;  // H += α I + v aᵀ + s bᵀ
  H.xx += alpha + e.v.x * a.x + e.s.x * b.x;
  H.xy += e.v.x * a.y + e.s.x * b.y;
  H.xz += e.v.x * a.z + e.s.x * b.z;
  H.yy += alpha + e.v.y * a.y + e.s.y * b.y;
  H.yz += e.v.y * a.z + e.s.y * b.z;
  H.zz += alpha + e.v.z * a.z + e.s.z * b.z;
}

Objective objectiveOf(const std::vector<Moving>& star, double delta, const Penalty& phi,
                      double minRatio = -1) {
  double f = 0;
  Vec3 gradient;
  Symmetric H;
  for (const Moving& e : star) addElement(e, delta, phi, minRatio, f, gradient, H);
  return {f, gradient, H.full()};
}

double valueOf(const std::vector<Moving>& star, Vec3 d, double delta, const Penalty& phi) {
  double sum = 0;
  for (const Moving& e : star) {
    const double N = e.N + 2 * dot(e.v, d) + e.gg * norm2(d);
    const double distortion = regularized(N, e.sigma + dot(e.s, d), delta).eta;
    if (distortion == unbounded) return unbounded;
    sum += penaltyTerms(distortion, phi).value;
  }
  return sum;
}

// f and its slope at x + t p.
LinePoint alongLine(const std::vector<Moving>& star, Vec3 p, double t, double delta,
                    const Penalty& phi) {
  LinePoint at{0, 0};
  const double pp = norm2(p);
  for (const Moving& e : star) {
    const double vp = dot(e.v, p), sp = dot(e.s, p);
    const double N = e.N + t * (2 * vp + t * e.gg * pp);
    const Regularized r = regularized(N, e.sigma + t * sp, delta);
    if (r.eta == unbounded) return {unbounded, 0};
    const PenaltyTerms terms = penaltyTerms(r.eta, phi);
    at.F += terms.value;
    at.slope += 2 * terms.first * ((vp + t * e.gg * pp) / std::max(N, DBL_MIN) - sp / (3 * r.R));
  }
  return at;
}

Moving movingOf(const StarElement& e, Vec3 d) {
  const Moving atOrigin{norm2(e.J0), det(e.J0), norm2(e.g), e.J0 * e.g, cofactor(e.J0) * e.g};
  return displaced(atOrigin, d);
}

std::vector<Moving> movingStar(const Star& star, Vec3 x) {
  std::vector<Moving> result;
  for (const StarElement& e : star.elements) result.push_back(movingOf(e, x - star.origin));
  return result;
}

// The regular tetrahedron of edge √2, positively oriented.
constexpr std::array<Vec3, 4> regularTetrahedron{{{0, 0, 0}, {0, 1, 1}, {1, 0, 1}, {1, 1, 0}}};

double signedVolume6(const std::array<Vec3, 4>& z) {
  return dot(z[1] - z[0], cross(z[2] - z[0], z[3] - z[0]));
}

std::array<Vec3, 4> cornersOf(const std::vector<Vec3>& x, const std::array<int, 4>& tet) {
  return {x[tet[0]], x[tet[1]], x[tet[2]], x[tet[3]]};
}

// The ideal elements of a mesh. [choice] A regular one is oriented as the computational element,
// where there is none as most of the mesh.
struct IdealElements {
  const Mesh& M;
  bool computational;
  double sign = 1;

  IdealElements(const Mesh& mesh, Ideal ideal)
      : M(mesh), computational(ideal == Ideal::computational && !mesh.xi.empty()) {
    if (!M.xi.empty()) return;
    double volume = 0;
    for (const std::array<int, 4>& tet : M.tets) volume += signedVolume6(cornersOf(M.x, tet));
    if (volume < 0) sign = -1;
  }
  std::array<Vec3, 4> of(int E) const {
    const std::array<int, 4>& tet = M.tets[E];
    if (computational) return cornersOf(M.xi, tet);
    std::array<Vec3, 4> z = regularTetrahedron;
    if ((M.xi.empty() ? sign : signedVolume6(cornersOf(M.xi, tet))) < 0) std::swap(z[2], z[3]);
    return z;
  }
};

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

double quality(const Mat3& J) { return det(J) > 0 ? 1 / eta(J) : 0; }  // eq. (7)

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

// ==== 3.7.2 Objective function ==================================================================

Star starOf(const Mesh& M, int n, const std::vector<int>& around) {
  const IdealElements ideals(M, Ideal::computational);
  Star star{M.x[n], {}};
  for (int E : around) {
    const std::array<Vec3, 4> z = ideals.of(E);
    const Mat3 edges{z[1] - z[0], z[2] - z[0], z[3] - z[0]};
    const Mat3 G =
        transpose(inverse(edges));  // columns: gradients of the barycentric functions 1, 2, 3
    const std::array<Vec3, 4> g{-(G.c0 + G.c1 + G.c2), G.c0, G.c1, G.c2};
    const auto local = std::find(M.tets[E].begin(), M.tets[E].end(), n) - M.tets[E].begin();
    star.elements.push_back({jacobian(z, cornersOf(M.x, M.tets[E])), g[local]});
  }
  return star;
}

double f(const Star& star, Vec3 x, double delta, double power) {
  return valueOf(movingStar(star, x), {}, delta, powerPenalty(power));
}

Objective fDerivatives(const Star& star, Vec3 x, double delta, double power) {
  return objectiveOf(movingStar(star, x), delta, powerPenalty(power));
}

// ==== 3.7.3 Objective function for surface and edge nodes =======================================

double fVarphi(const Star& star, const Parametrization& P, Vec2 u, double delta, double power) {
  const Location at = locate(P, u);
  return at.triangle < 0 ? unbounded : f(star, varphi(P, at), delta, power);  // eq. (10)
}

double fGamma(const Star& star, const Curve& C, double s, double delta, double power) {
  return f(star, gamma(C, s), delta, power);  // eq. (11)
}

namespace {

// Directions in which x moves with the parameters: the columns of ∂x/∂(parameters); `count` of them
// count.
struct Frame {
  Mat3 columns;
  int count;
};

// ∂ϕ/∂u in the triangle that holds u: exact, since ϕ is affine there.
Frame surfaceFrame(const Parametrization& P, int triangle) {
  const std::array<int, 3>& t = P.triangles[triangle];
  const Vec2 a = P.u[t[1]] - P.u[t[0]], b = P.u[t[2]] - P.u[t[0]];
  const Vec3 A = P.points[t[1]] - P.points[t[0]], B = P.points[t[2]] - P.points[t[0]];
  const double d = cross(a, b);
  return {{(b.y / d) * A - (a.y / d) * B, (a.x / d) * B - (b.x / d) * A, {}}, 2};
}

// dγ/ds on the segment that holds s.
Frame curveFrame(const Curve& C, double s) {
  const int points = static_cast<int>(C.points.size());
  if (C.closed) s -= C.s.back() * std::floor(s / C.s.back());
  const auto next = std::upper_bound(C.s.begin(), C.s.end(), s) - C.s.begin();
  const int last = static_cast<int>(C.s.size()) - 2;
  const int k = std::clamp(static_cast<int>(next) - 1, 0, last);
  const Vec3 edge = C.points[(k + 1) % points] - C.points[k];
  return {{(1 / (C.s[k + 1] - C.s[k])) * edge, {}, {}}, 1};
}

// Gradient Pᵀ∇f and Hessian Pᵀ(Hess f)P in the parameters, padded by 1 to three of them.
Objective inParameters(const Objective& o, const Frame& frame) {
  if (frame.count == 3) return o;
  const Mat3 T = transpose(frame.columns);
  Objective r{o.f, T * o.gradient, T * (o.hessian * frame.columns)};
  if (frame.count < 2) r.hessian.c1.y = 1;
  r.hessian.c2.z = 1;
  return r;
}

/// [§3.7.3] The paper's derivatives of f_ϕ and f_γ: central differences with step e in each
/// parameter.
///   F  parameters (Vec3, the first `count` count) → f_ϕ or f_γ
template <class Function>
Objective byDifferences(const Function& F, int count, Vec3 e) {
  Objective o{F(Vec3{}), {}, {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};
  const double right = F({e.x, 0, 0}), left = F({-e.x, 0, 0});
  o.gradient.x = (right - left) / (2 * e.x);
  o.hessian.c0.x = (right - 2 * o.f + left) / (e.x * e.x);
  if (count < 2) return o;
  const double up = F({0, e.y, 0}), down = F({0, -e.y, 0});
  const double mixed =
      F({e.x, e.y, 0}) - F({e.x, -e.y, 0}) - F({-e.x, e.y, 0}) + F({-e.x, -e.y, 0});
  o.gradient.y = (up - down) / (2 * e.y);
  o.hessian.c1.y = (up - 2 * o.f + down) / (e.y * e.y);
  o.hessian.c0.y = o.hessian.c1.x = mixed / (4 * e.x * e.y);
  return o;
}

// ==== 3.7.4 Optimization approach: line search ==================================================

constexpr double wolfeC1 = 1e-4, wolfeC2 = .9;  // [33]'s values for Newton's direction
constexpr int wolfeEvaluations = 20;

struct LineSample {
  double t;
  LinePoint at;
};

// Between two samples: the minimum of the cubic through both, kept off the ends by a tenth; the
// middle where an end is infinite.
double cubicStep(const LineSample& lo, const LineSample& hi) {
  const double width = hi.t - lo.t, middle = lo.t + width / 2;
  if (!std::isfinite(hi.at.F) || !std::isfinite(hi.at.slope)) return middle;
  const double d1 = lo.at.slope + hi.at.slope - 3 * (lo.at.F - hi.at.F) / (lo.t - hi.t);
  const double root = d1 * d1 - lo.at.slope * hi.at.slope;
  if (!(root >= 0)) return middle;
  const double d2 = (width > 0 ? 1 : -1) * std::sqrt(root);
  const double part = 1 - (hi.at.slope + d2 - d1) / (hi.at.slope - lo.at.slope + 2 * d2);
  return std::isfinite(part) ? lo.t + std::clamp(part, .1, .9) * width : middle;
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

}  // namespace

WolfeStep strongWolfe(const std::function<LinePoint(double t)>& F, double tFirst, double tMax) {
  return wolfeSearch(F, F(0), tFirst, tMax);
}

// ==== 3.7.4 Optimization approach: the smoother's state =========================================

namespace {

// The vertices of a tetrahedron opposite to each one, in the order that keeps the orientation.
constexpr int opposite[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};

// An ideal element, scaled so that the mesh's mean σ is 1.
struct IdealShape {
  std::array<Vec3, 4> g;  // gradients of the barycentric functions
  double volumeFactor;    // 1 / det of its edges
};

// The same seen from one of its vertices (0), the others 1, 2, 3 in the order of `opposite`.
struct CornerShape {
  double K01, K02, K03, K12, K13, K23, gg, volumeFactor;  // −g_i·g_j; |g_0|²; 1/det
};

struct StarEntry {
  int a, b, c, corner;
};  // the other three nodes; index of the CornerShape

CornerShape cornerShape(const IdealShape& shape, int k) {
  const Vec3 g0 = shape.g[k], g1 = shape.g[opposite[k][0]], g2 = shape.g[opposite[k][1]],
             g3 = shape.g[opposite[k][2]];
  return {-dot(g0, g1), -dot(g0, g2), -dot(g0, g3), -dot(g1, g2),
          -dot(g1, g3), -dot(g2, g3), norm2(g0),    shape.volumeFactor};
}

/// The element as a function of its node, from a = x_1 − x, b, c and K_ij = −g_i·g_j:
///   J = Σ d_k g_kᵀ,   N = Σ_{i<j} K_ij |x_i − x_j|²,   v = J g_0 = −Σ K_0k d_k,
///   σ = a·(b × c)/det,   s = ∂σ/∂x = −(b − a) × (c − a)/det
inline Moving movingElement(const CornerShape& k, Vec3 a, Vec3 b, Vec3 c) {
  const Vec3 ab = b - a, ac = c - a, bc = c - b;
  const Vec3 s = (-k.volumeFactor) * cross(ab, ac);
  const double N = k.K01 * norm2(a) + k.K02 * norm2(b) + k.K03 * norm2(c) + k.K12 * norm2(ab) +
                   k.K13 * norm2(ac) + k.K23 * norm2(bc);
  const Vec3 v = -(k.K01 * a + k.K02 * b + k.K03 * c);
  return {N, -dot(a, s), k.gg, v, s};
}

constexpr int shapeBits = 40;  // ideal elements whose edges agree in so many bits are one shape

// The key of an ideal element: its edges, rounded relative to the longest coordinate.
std::array<double, 9> shapeKey(const std::array<Vec3, 4>& z) {
  std::array<double, 9> key;
  double largest = 0;
  for (int k = 0; k < 3; ++k) {
    const Vec3 e = z[k + 1] - z[0];
    key[3 * k] = e.x, key[3 * k + 1] = e.y, key[3 * k + 2] = e.z;
    largest = std::max({largest, std::abs(e.x), std::abs(e.y), std::abs(e.z)});
  }
  int exponent;
  std::frexp(largest, &exponent);
  const double unit = std::ldexp(1, exponent - shapeBits);
  for (double& x : key) x = std::round(x / unit) * unit + 0.;
  return key;
}

// Gauss–Seidel over the nodes: all that Algorithm 2 keeps between visits.
struct Smoother {
  Mesh& M;
  const OptimizeOptions& options;
  OptimizeReport report = {};

  std::vector<IdealShape> shapes = {};    // few on a meccano mesh
  std::vector<CornerShape> corners = {};  // [4 shapes]
  std::vector<int> shapeOf = {};          // [tets]
  std::vector<int> starStart = {};  // [nodes + 1] star of n: star[starStart[n] .. starStart[n+1])
  std::vector<StarEntry> star = {};
  std::vector<int> ringStart = {}, ring = {};  // [nodes + 1] the same for its neighbour nodes
  std::vector<unsigned char> freedom = {};     // [nodes] 3 inner, 2 surface, 1 curve, 0 fixed
  std::vector<double> unrest =
      {};  // [nodes] displacement of its star since its last visit, relative

  double delta = 0;  // of the sweep, relative to the mean σ
  Penalty phi = plainEta;
  double relaxation = 1;            // first trial step, in Newton steps
  double wake = 0;                  // unrest from which a node is visited
  std::vector<Moving> around = {};  // the star under visit; kept to save allocations
};

// ---- preparation -------------------------------------------------------------------------------

// The scale that makes the mean of σ 1, so that μ and δ are relative.
double meanSigma(const Mesh& M, const IdealElements& ideals) {
  double sum = 0, absolute = 0;
  for (int E = 0; E < static_cast<int>(M.tets.size()); ++E) {
    const double sigma = signedVolume6(cornersOf(M.x, M.tets[E])) / signedVolume6(ideals.of(E));
    sum += sigma;
    absolute += std::abs(sigma);
  }
  const double mean = (sum > .1 * absolute ? sum : absolute) / static_cast<double>(M.tets.size());
  return mean > 0 ? mean : 1;
}

void buildShapes(Smoother& S) {
  const IdealElements ideals(S.M, Ideal::computational);
  const double scale = std::cbrt(meanSigma(S.M, ideals));
  std::map<std::array<double, 9>, int> known;
  for (int E = 0; E < static_cast<int>(S.M.tets.size()); ++E) {
    const std::array<Vec3, 4> z = ideals.of(E);
    const auto [place, isNew] = known.emplace(shapeKey(z), static_cast<int>(S.shapes.size()));
    S.shapeOf.push_back(place->second);
    if (!isNew) continue;
    const Mat3 edges{scale * (z[1] - z[0]), scale * (z[2] - z[0]), scale * (z[3] - z[0])};
    const Mat3 G = transpose(inverse(edges));
    S.shapes.push_back({{-(G.c0 + G.c1 + G.c2), G.c0, G.c1, G.c2}, 1 / det(edges)});
    for (int k = 0; k < 4; ++k) S.corners.push_back(cornerShape(S.shapes.back(), k));
  }
}

void buildStars(Smoother& S) {
  const int nodes = static_cast<int>(S.M.x.size()), tets = static_cast<int>(S.M.tets.size());
  S.starStart.assign(nodes + 1, 0);
  for (const std::array<int, 4>& tet : S.M.tets)
    for (int n : tet) ++S.starStart[n + 1];
  for (int n = 0; n < nodes; ++n) S.starStart[n + 1] += S.starStart[n];
  std::vector<int> next(S.starStart.begin(), S.starStart.end() - 1);
  S.star.resize(4 * S.M.tets.size());
  for (int E = 0; E < tets; ++E) {
    const std::array<int, 4>& tet = S.M.tets[E];
    for (int k = 0; k < 4; ++k) {
      const int* o = opposite[k];
      S.star[next[tet[k]]++] = {tet[o[0]], tet[o[1]], tet[o[2]], 4 * S.shapeOf[E] + k};
    }
  }
  S.ringStart.assign(1, 0);
  std::vector<int> neighbours;
  for (int n = 0; n < nodes; ++n) {
    neighbours.clear();
    for (int k = S.starStart[n]; k < S.starStart[n + 1]; ++k)
      neighbours.insert(neighbours.end(), {S.star[k].a, S.star[k].b, S.star[k].c});
    std::sort(neighbours.begin(), neighbours.end());
    const auto end = std::unique(neighbours.begin(), neighbours.end());
    S.ring.insert(S.ring.end(), neighbours.begin(), end);
    S.ringStart.push_back(static_cast<int>(S.ring.size()));
  }
}

// Fixes the nodes of faces with one tetrahedron: a mesh without geometry.
void fixBoundary(const Mesh& M, std::vector<unsigned char>& freedom) {
  std::vector<std::array<int, 3>> faces;
  faces.reserve(4 * M.tets.size());
  for (const std::array<int, 4>& tet : M.tets)
    for (const auto& o : opposite) {
      std::array<int, 3> face{tet[o[0]], tet[o[1]], tet[o[2]]};
      std::sort(face.begin(), face.end());
      faces.push_back(face);
    }
  std::sort(faces.begin(), faces.end());
  for (std::size_t k = 0; k < faces.size();) {
    std::size_t end = k + 1;
    while (end < faces.size() && faces[end] == faces[k]) ++end;
    if (end == k + 1)
      for (int n : faces[k]) freedom[n] = 0;
    k = end;
  }
}

void buildFreedom(Smoother& S) {
  const std::size_t nodes = S.M.x.size();
  S.freedom.assign(nodes, 3);
  if (S.M.dimension.empty())
    fixBoundary(S.M, S.freedom);
  else
    S.freedom = S.M.dimension;
  for (int n : S.options.fixed) S.freedom[n] = 0;
  for (std::size_t n = 0; n < nodes; ++n)
    if (S.starStart[n] == S.starStart[n + 1]) S.freedom[n] = 0;
  S.unrest.assign(nodes, S.options.active.empty() ? unbounded : 0);
  for (int n : S.options.active) S.unrest[n] = unbounded;
}

// ---- measures ----------------------------------------------------------------------------------

Moving elementFromItsFirst(const Smoother& S, int E) {
  const std::array<int, 4>& tet = S.M.tets[E];
  const Vec3 x = S.M.x[tet[0]];
  return movingElement(S.corners[4 * S.shapeOf[E]], S.M.x[tet[1]] - x, S.M.x[tet[2]] - x,
                       S.M.x[tet[3]] - x);
}

double elementQuality(const Smoother& S, int E) {
  const Moving e = elementFromItsFirst(S, E);
  return 1 / regularized(e.N, e.sigma, 0).eta;
}

struct Validity {
  int inverted;
  double sigmaMin;
};
Validity validity(const Smoother& S) {
  Validity v{0, unbounded};
  for (int E = 0; E < static_cast<int>(S.M.tets.size()); ++E) {
    const double sigma = elementFromItsFirst(S, E).sigma;
    if (!(sigma > 0)) ++v.inverted;
    v.sigmaMin = std::min(v.sigmaMin, sigma);
  }
  return v;
}

double lowestQuality(const Smoother& S) {
  double q = 1;
  for (int E = 0; E < static_cast<int>(S.M.tets.size()); ++E) q = std::min(q, elementQuality(S, E));
  return q;
}

// ---- one visit ---------------------------------------------------------------------------------

struct Edges {
  double shortest, longest;
};

// Fills S.around with the star of n.
Edges gatherStar(Smoother& S, int n) {
  const Vec3 x = S.M.x[n];
  Edges edges{unbounded, 0};
  S.around.clear();
  for (int k = S.starStart[n]; k < S.starStart[n + 1]; ++k) {
    const StarEntry& e = S.star[k];
    const Vec3 a = S.M.x[e.a] - x, b = S.M.x[e.b] - x, c = S.M.x[e.c] - x;
    S.around.push_back(movingElement(S.corners[e.corner], a, b, c));
    const double aa = norm2(a), bb = norm2(b), cc = norm2(c);
    edges.shortest = std::min(edges.shortest, std::min(aa, std::min(bb, cc)));
    edges.longest = std::max(edges.longest, std::max(aa, std::max(bb, cc)));
  }
  return {std::sqrt(edges.shortest), std::sqrt(edges.longest)};
}

// Newton's direction of an objective in `count` parameters; false where the Hessian is not positive
// definite.
bool newtonDirection(const Objective& o, Vec3& p) {
  return solveCholesky(o.hessian, -o.gradient, p) && dot(p, o.gradient) < 0;
}

// Last resort: down the gradient, by a tenth of the local edge.
Vec3 gradientDirection(const Objective& o, const Frame& frame, double edge) {
  const double length = norm(frame.columns * o.gradient);
  return length > 0 ? (-.1 * edge / length) * o.gradient : Vec3{};
}

constexpr Mat3 unitMatrix{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
constexpr double roundingOfF = 1e-14;  // relative: a smaller decrease of f is lost in its sum

// A direction in the node's parameters, with the step at most the local edge length.
struct Direction {
  Vec3 p;
  double slope, tMax;
};

Direction chooseDirection(const Smoother& S, const Objective& exact, const Frame& frame,
                          double edge) {
  Objective o = exact;
  Vec3 p;
  if (!newtonDirection(o, p)) {
    if (!S.options.numericalDerivatives || frame.count == 3)
      o = inParameters(objectiveOf(S.around, S.delta, S.phi, convexRatio), frame);
    if (!newtonDirection(o, p)) p = gradientDirection(o, frame, edge);
  }
  const double length = norm(frame.columns * p);
  return {p, dot(p, exact.gradient), length > 0 ? edge / length : 0};
}

/// [§3.7.4] An inner node: one Newton step with the strong Wolfe conditions. Returns the
/// displacement.
double visitInner(Smoother& S, int n, const Edges& edges) {
  const Objective o = objectiveOf(S.around, S.delta, S.phi);
  if (!std::isfinite(o.f)) return 0;
  const Direction d = chooseDirection(S, o, {unitMatrix, 3}, edges.longest);
  if (!(-d.slope > roundingOfF * o.f)) return 0;
  const auto line = [&](double t) { return alongLine(S.around, d.p, t, S.delta, S.phi); };
  const WolfeStep step = wolfeSearch(line, {o.f, d.slope}, S.relaxation, d.tMax);
  S.M.x[n] += step.t * d.p;
  return step.t * norm(d.p);
}

// Armijo's condition alone, t halved. [departure] At the kinks of ϕ and γ the curvature condition
// may hold nowhere.
template <class Function>
double armijoStep(const Function& F, double f0, double slope, double tFirst) {
  double t = tFirst;
  for (int k = 0; k < wolfeEvaluations; ++k, t /= 2)
    if (F(t) <= f0 + wolfeC1 * t * slope) return t;
  return 0;
}

// Where a sliding node comes to lie with its parameters moved by p; `inside` false: outside 𝓤.
struct Slid {
  Vec2 parameter;
  Vec3 x;
  bool inside;
};

Slid slide(const Mesh& M, int n, Vec3 p) {
  const Vec2 old = M.parameter[n];
  if (M.dimension[n] == 1) {
    const Curve& C = M.curves[M.entity[n] - 1];
    double s = old.x + p.x;
    if (C.closed) s -= C.s.back() * std::floor(s / C.s.back());
    const bool inside = C.closed || (s >= C.s.front() && s <= C.s.back());
    return {{s, 0}, inside ? gamma(C, s) : Vec3{}, inside};
  }
  const Parametrization& P = surfaceOf(M, M.entity[n]);
  const Vec2 u = old + Vec2{p.x, p.y};
  const Location at = locate(P, u);
  return {u, at.triangle < 0 ? Vec3{} : varphi(P, at), at.triangle >= 0};
}

// The directions of a surface or curve node; count 0 where its parameter is off the surface.
Frame slidingFrame(const Mesh& M, int n) {
  if (M.dimension[n] == 1) return curveFrame(M.curves[M.entity[n] - 1], M.parameter[n].x);
  const Parametrization& P = surfaceOf(M, M.entity[n]);
  const Location at = locate(P, M.parameter[n]);
  return at.triangle < 0 ? Frame{{}, 0} : surfaceFrame(P, at.triangle);
}

// Step of the paper's differences, relative to the shortest edge. Second derivatives have errors of
// 1e-8 by truncation and by cancellation.
constexpr double differenceStep = 1e-4;

/// [§3.7.3, eq. (10), (11)] A surface or curve node: a Newton step in its parameters. Returns the
/// displacement.
double visitSliding(Smoother& S, int n, const Edges& edges) {
  const Frame frame = slidingFrame(S.M, n);
  const Vec3 x = S.M.x[n];
  const auto F = [&](Vec3 p) {
    const Slid at = slide(S.M, n, p);
    return at.inside ? valueOf(S.around, at.x - x, S.delta, S.phi) : unbounded;
  };
  Objective o = inParameters(objectiveOf(S.around, S.delta, S.phi), frame);
  if (frame.count == 0 || !std::isfinite(o.f)) return 0;
  if (S.options.numericalDerivatives) {
    const double e = differenceStep * edges.shortest;
    const Vec3 steps{e / norm(frame.columns.c0), e / std::max(norm(frame.columns.c1), DBL_MIN), 0};
    const Objective differences = byDifferences(F, frame.count, steps);
    const bool finite = isFinite(differences.gradient) && std::isfinite(norm2(differences.hessian));
    if (finite) o = differences;  // else the stencil leaves 𝓤: exact ones
  }
  const Direction d = chooseDirection(S, o, frame, edges.longest);
  if (!(-d.slope > roundingOfF * o.f)) return 0;
  const double t = armijoStep([&](double a) { return F(a * d.p); }, o.f, d.slope,
                              std::min(S.relaxation, d.tMax));
  if (t == 0) return 0;
  const Slid at = slide(S.M, n, t * d.p);
  S.M.x[n] = at.x;
  S.M.parameter[n] = at.parameter;
  return norm(at.x - x);
}

/// [§3.7.4, Algorithm 2] smoothNode: returns the displacement relative to the node's shortest edge.
double smoothNode(Smoother& S, int n) {
  const Edges edges = gatherStar(S, n);
  if (!(edges.longest > 0)) return 0;
  const double moved = S.freedom[n] == 3 ? visitInner(S, n, edges) : visitSliding(S, n, edges);
  return moved / std::max(edges.shortest, DBL_EPSILON * edges.longest);
}

// ---- sweeps ------------------------------------------------------------------------------------

/// [§3.7.4, Algorithm 2] The body of its while loop over the nodes whose star has moved: returns
/// disp.
double sweepNodes(Smoother& S) {
  double disp = 0;
  for (int n = 0; n < static_cast<int>(S.M.x.size()); ++n) {
    if (S.freedom[n] == 0 || !(S.unrest[n] > S.wake)) continue;
    S.unrest[n] = 0;
    const double moved = smoothNode(S, n);
    disp = std::max(disp, moved);
    if (moved == 0) continue;
    S.unrest[n] += moved;
    for (int k = S.ringStart[n]; k < S.ringStart[n + 1]; ++k) S.unrest[S.ring[k]] += moved;
  }
  return disp;
}

void endSweep(Smoother& S, double disp) {
  ++S.report.sweeps;
  S.report.disp = disp;
  if (!S.options.onSweep) return;
  S.options.onSweep({S.report.sweeps, validity(S).inverted, lowestQuality(S), disp});
}

bool sweepsLeft(const Smoother& S) { return S.report.sweeps < S.options.maxSweeps; }

// ---- global descent: all inner nodes at once ---------------------------------------------------

struct Functional {
  double F, sigmaMin;
};

// Weight of (1 + σ²)/(2h) beside η. Without it elements shrink to points, since η with h(σ) tends
// to 0 there; with 1/8 the cube turned by 3 rad stays tangled.
constexpr double volumeWeight = 1;

/// Σ η + (1 + σ²)/(2h) over the mesh, with its gradient at the free inner nodes, σ_min, and the
/// diagonal of the Hessian's part 2 η |g|²/N.
///   source  Garanzha et al., Foldover-free maps in 50 lines of code
Functional meshFunctional(const Smoother& S, double delta, std::vector<Vec3>& gradient,
                          std::vector<double>& diagonal) {
  Functional sum{0, unbounded};
  std::fill(gradient.begin(), gradient.end(), Vec3{});
  std::fill(diagonal.begin(), diagonal.end(), 0);
  for (std::size_t E = 0; E < S.M.tets.size(); ++E) {
    const std::array<int, 4>& tet = S.M.tets[E];
    const IdealShape& shape = S.shapes[S.shapeOf[E]];
    const Vec3 x = S.M.x[tet[0]];
    const Vec3 a = S.M.x[tet[1]] - x, b = S.M.x[tet[2]] - x, c = S.M.x[tet[3]] - x;
    const Mat3 J = outer(a, shape.g[1]) + outer(b, shape.g[2]) + outer(c, shape.g[3]);
    const double N = std::max(norm2(J), DBL_MIN), sigma = det(J);
    const Regularized r = regularized(N, sigma, delta);
    const double hs = h(sigma, delta);
    sum.F += r.eta + volumeWeight * (1 + sigma * sigma) / (2 * hs);
    sum.sigmaMin = std::min(sum.sigmaMin, sigma);
    if (r.eta == unbounded) continue;
    const double volumeSlope = volumeWeight * (2 * sigma - (1 + sigma * sigma) / r.R) / (2 * hs);
    const Mat3 D =
        (2 * r.eta / N) * J + (volumeSlope - 2. / 3 * r.eta / r.R) * cofactor(J);  // ∂/∂J
    for (int k = 0; k < 4; ++k) {
      if (S.freedom[tet[k]] != 3) continue;
      gradient[tet[k]] += D * shape.g[k];
      diagonal[tet[k]] += 2 * r.eta / N * norm2(shape.g[k]);
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

// The last pairs of displacement and change of the gradient.
struct LbfgsMemory {
  struct Pair {
    std::vector<Vec3> d, y;
    double rho;
  };
  static constexpr std::size_t length = 8;
  std::vector<Pair> pairs = {};

  void add(std::vector<Vec3> d, std::vector<Vec3> y) {
    const double curvature = product(d, y);
    if (!(curvature > 0)) return;
    if (pairs.size() == length) pairs.erase(pairs.begin());
    pairs.push_back({std::move(d), std::move(y), 1 / curvature});
  }
  // Two-loop recursion from the diagonal. [33]
  std::vector<Vec3> direction(const std::vector<Vec3>& gradient,
                              const std::vector<double>& diagonal) const {
    std::vector<Vec3> p = gradient;
    std::vector<double> alpha(pairs.size());
    for (std::size_t k = pairs.size(); k-- > 0;) {
      alpha[k] = pairs[k].rho * product(pairs[k].d, p);
      addMultiple(p, -alpha[k], pairs[k].y);
    }
    for (std::size_t n = 0; n < p.size(); ++n)
      p[n] = diagonal[n] > 0 ? (1 / diagonal[n]) * p[n] : Vec3{};
    for (std::size_t k = 0; k < pairs.size(); ++k)
      addMultiple(p, alpha[k] - pairs[k].rho * product(pairs[k].y, p), pairs[k].d);
    for (Vec3& v : p) v = -v;
    return p;
  }
};

constexpr int lbfgsIterations = 150;    // per δ
constexpr double lbfgsDecrease = 1e-4;  // of F in one step, relative: below it δ is chosen anew

/// L-BFGS on the functional at one δ. Returns its last value.
Functional descend(Smoother& S, double delta) {
  const std::size_t nodes = S.M.x.size();
  std::vector<Vec3> gradient(nodes), trialGradient(nodes), start(nodes);
  std::vector<double> diagonal(nodes), trialDiagonal(nodes);
  LbfgsMemory memory;
  Functional at = meshFunctional(S, delta, gradient, diagonal);
  for (int k = 0; k < lbfgsIterations; ++k) {
    const std::vector<Vec3> p = memory.direction(gradient, diagonal);
    const double slope = product(p, gradient);
    if (!(slope < 0)) break;
    start = S.M.x;
    Functional trial{};
    const auto goTo = [&](double t) {
      S.M.x = start;
      addMultiple(S.M.x, t, p);
      trial = meshFunctional(S, delta, trialGradient, trialDiagonal);
      return LinePoint{trial.F, product(trialGradient, p)};
    };
    const WolfeStep step = wolfeSearch(goTo, {at.F, slope}, 1, unbounded);
    if (step.t == 0 || !step.curvature) goTo(step.t);
    const bool little = at.F - trial.F < lbfgsDecrease * at.F;
    std::vector<Vec3> y = trialGradient, d = p;
    addMultiple(y, -1, gradient);
    for (Vec3& v : d) v = step.t * v;
    memory.add(std::move(d), std::move(y));
    at = trial;
    std::swap(gradient, trialGradient);
    std::swap(diagonal, trialDiagonal);
    if (little) break;
  }
  return at;
}

constexpr int descentRounds = 40;     // choices of δ
constexpr double firstDelta = .5;     // of the mean σ
constexpr double leastDecrease = .1;  // of h(σ_min) from one δ to the next, relative
constexpr double validDelta = 1e-10;  // where no element is inverted: below any σ that matters

/// [choice] Descends on all inner nodes together, for tangled states that one node at a time cannot
/// leave (an inner cube turned by 3 rad inside a fixed hull).
///   source  δ from the last decrease of F: Garanzha et al.
void globalDescent(Smoother& S) {
  Validity v = validity(S);
  double delta = firstDelta, last = 0;
  for (int round = 0; round < descentRounds && v.inverted > 0 && sweepsLeft(S); ++round) {
    const Functional at = descend(S, delta);
    const double decrease = round == 0 ? leastDecrease : std::max(1 - at.F / last, leastDecrease);
    const double mu = (1 - decrease) * h(at.sigmaMin, delta);
    delta = at.sigmaMin < mu ? std::sqrt(mu * (mu - at.sigmaMin)) : validDelta;
    last = at.F;
    v = validity(S);
    endSweep(S, 1);
  }
}

// ---- Algorithm 2 -------------------------------------------------------------------------------

constexpr double wakeFraction = .1;  // of maxDisp: a star that moved less is not visited again
constexpr int sweepsWithoutProgress = 3;       // that μ is given before the next
constexpr double muLadder[3] = {2.5, 1, .25};  // of options.mu, in turn while the mesh is tangled

// μ of the sweep: the next rung where the number of inverted elements does not fall.
struct MuSchedule {
  int rung = 0, best = std::numeric_limits<int>::max(), waited = 0, tangledSweeps = 0;

  double next(double mu, int inverted) {
    ++tangledSweeps;
    if (inverted < best) {
      best = inverted;
      waited = 0;
    } else if (++waited >= sweepsWithoutProgress) {
      rung = (rung + 1) % 3;
      waited = 0;
      best = inverted;
    }
    return mu * muLadder[rung];
  }
};

/// [§3.7.4, Algorithm 2] optimizeMesh's loop. While elements are inverted δ comes from the σ_min of
/// the whole mesh and holds for all nodes; afterwards it is 0, and a move that would invert an
/// element has f = ∞. Returns whether it converged on a valid mesh.
bool untangleAndSmooth(Smoother& S) {
  MuSchedule schedule;
  bool tangled = true;
  const std::vector<Vec3> initialX = S.M.x;
  const std::vector<Vec2> initialParameter = S.M.parameter;
  S.wake = wakeFraction * S.options.maxDisp;
  while (sweepsLeft(S)) {
    if (tangled) {
      const Validity v = validity(S);
      tangled = v.inverted > 0;
      if (tangled && schedule.tangledSweeps >= S.options.maxTangledSweeps) {
        if (!S.options.globalDescent) return false;
        S.M.x = initialX;  // sweeps may have tangled it more
        S.M.parameter = initialParameter;
        globalDescent(S);
        schedule = {};
        std::fill(S.unrest.begin(), S.unrest.end(), unbounded);
        continue;
      }
      S.delta = tangled ? chooseDelta(v.sigmaMin, schedule.next(S.options.mu, v.inverted)) : 0;
    }
    S.relaxation = S.options.relaxation;
    const double disp = sweepNodes(S);
    endSweep(S, disp);
    if (!tangled && disp <= S.options.maxDisp) return true;
  }
  return false;
}

// ---- the worst elements ------------------------------------------------------------------------

constexpr double worstFraction = .01;   // of the elements count as the worst ones,
constexpr std::size_t worstCount = 10;  // but at least so many
constexpr int liftRounds = 15, liftSweeps = 8;
constexpr double liftMeanLoss = .015;  // of mean q: the rounds end there (the last one wins most back),
constexpr double liftMinGain = .002;   // or where the lowest q rises by less
constexpr double liftMaxDisp = 1e-3;   // relative to the shortest edge: a round's sweeps end there
constexpr double liftWake = .05;       // unrest for a visit: only what happens near the worst counts
constexpr double liftReach = .85;      // (η/η_w)^48 below it is nothing
constexpr double liftRatio = 1.6;      // η/η_w at most: 1.6^48 = 6e9, and a Newton step lowers it e-fold

std::vector<double> elementQualities(const Smoother& S) {
  std::vector<double> q;
  for (int E = 0; E < static_cast<int>(S.M.tets.size()); ++E) q.push_back(elementQuality(S, E));
  return q;
}

// The lowest and the mean q, and the one that bounds the worst elements from above.
struct WorstElements {
  double lowest, mean, bound;
};

WorstElements worstElements(std::vector<double> q) {
  const double count = static_cast<double>(q.size());
  double sum = 0;
  for (double value : q) sum += value;
  const std::size_t wanted = std::max(worstCount, static_cast<std::size_t>(worstFraction * count));
  const std::size_t k = std::min(q.size(), wanted) - 1;
  std::nth_element(q.begin(), q.begin() + static_cast<std::ptrdiff_t>(k), q.end());
  return {*std::min_element(q.begin(), q.end()), sum / count, q[k]};
}

// One round: sweeps on Σ η + (η/η_w)^power, q_w = 1/η_w, from the nodes of the worst elements on.
void liftRound(Smoother& S, const WorstElements& worst, double qw) {
  S.phi = powerPenalty(S.options.power);
  S.phi.linear = 1;
  S.phi.scale = qw;
  S.wake = liftWake;
  for (std::size_t E = 0; E < S.M.tets.size(); ++E)
    if (elementQuality(S, static_cast<int>(E)) <= worst.bound / liftReach)
      for (int n : S.M.tets[E]) S.unrest[n] = unbounded;
  for (int k = 0; k < liftSweeps && sweepsLeft(S); ++k) {
    const double disp = sweepNodes(S);
    endSweep(S, disp);
    if (disp <= liftMaxDisp) return;
  }
}

/// [§3.7.4 departure] Raises the worst elements of a valid, converged mesh: Σ η + (η/η_w)^power,
/// with η_w the distortion that the worst 1 % exceed, anew in each round; the others keep Σ η. Ends
/// where the lowest q rises no more. A last round with η_w that of the worst element lets all the
/// others relax and wins the mean back.
void liftWorst(Smoother& S) {
  WorstElements worst = worstElements(elementQualities(S));
  const double meanAtStart = worst.mean;
  for (int round = 0; round < liftRounds && sweepsLeft(S); ++round) {
    const double before = worst.lowest;
    if (before > 1 - liftMinGain) return;
    liftRound(S, worst, std::min(worst.bound, liftRatio * worst.lowest));
    worst = worstElements(elementQualities(S));
    if (worst.mean < meanAtStart - liftMeanLoss || worst.lowest < before + liftMinGain) break;
  }
  liftRound(S, worst, worst.lowest);
}

// ---- input -------------------------------------------------------------------------------------

[[noreturn]] void refuse(const std::string& what) {
  throw InputError("optimizeMesh (§3.7): " + what);
}

void checkOptions(const OptimizeOptions& o, std::size_t nodes) {
  const auto number = [](double x) { return std::to_string(x); };
  if (!(o.maxDisp > 0)) refuse("maxDisp = " + number(o.maxDisp) + " must be > 0");
  if (o.maxTangledSweeps < 1)
    refuse("maxTangledSweeps = " + std::to_string(o.maxTangledSweeps) + " must be >= 1");
  if (o.maxSweeps < 1) refuse("maxSweeps = " + std::to_string(o.maxSweeps) + " must be >= 1");
  if (!(o.power >= 1 && o.power <= 64))
    refuse("power = " + number(o.power) + " must be in [1, 64]");
  if (!(o.mu > 0 && o.mu < 1)) refuse("mu = " + number(o.mu) + " must be in (0, 1)");
  if (!(o.relaxation >= 1 && o.relaxation < 2))
    refuse("relaxation = " + number(o.relaxation) + " must be in [1, 2)");
  const std::string range = " must be a node: 0 to " + std::to_string(static_cast<long>(nodes) - 1);
  for (int n : o.fixed)
    if (n < 0 || static_cast<std::size_t>(n) >= nodes)
      refuse("fixed node " + std::to_string(n) + range);
  for (int n : o.active)
    if (n < 0 || static_cast<std::size_t>(n) >= nodes)
      refuse("active node " + std::to_string(n) + range);
}

void checkEntity(const Mesh& M, std::size_t n) {
  const std::string at = "node " + std::to_string(n) + ": ";
  const int entity = M.entity[n], dimension = M.dimension[n];
  const auto upTo = [](std::size_t count) { return " of " + std::to_string(count); };
  if (dimension > 3)
    refuse(at + "dimension " + std::to_string(dimension) + " must be 0, 1, 2 or 3");
  if (dimension == 1 && (entity < 1 || static_cast<std::size_t>(entity) > M.curves.size()))
    refuse(at + "no curve " + std::to_string(entity) + upTo(M.curves.size()) +
           "; correct Mesh::entity");
  if (dimension != 2) return;
  const std::size_t count = entity > 0 ? M.surfaces.size() : M.patches.size();
  if (entity == 0 || static_cast<std::size_t>(std::abs(entity)) > count)
    refuse(at + "no surface or patch " + std::to_string(entity) + upTo(count) +
           "; correct Mesh::entity");
  if (surfaceOf(M, entity).gridSize < 1)
    refuse(at + "its surface " + std::to_string(entity) +
           " has no locator; call buildLocator() first");
}

void checkNodes(const Mesh& M) {
  const std::size_t nodes = M.x.size();
  const std::string expected = " entries, expected " + std::to_string(nodes) + ", one per node";
  const auto size = [](std::size_t n) { return std::to_string(n); };
  if (!M.xi.empty() && M.xi.size() != nodes) refuse("M.xi has " + size(M.xi.size()) + expected);
  for (std::size_t n = 0; n < nodes; ++n) {
    if (!isFinite(M.x[n]))
      refuse("node " + size(n) + " has a coordinate that is not finite; correct M.x");
    if (!M.xi.empty() && !isFinite(M.xi[n]))
      refuse("node " + size(n) +
             " has a computational coordinate that is not finite; correct M.xi");
  }
  if (M.dimension.empty()) return;
  if (M.dimension.size() != nodes) refuse("M.dimension has " + size(M.dimension.size()) + expected);
  if (M.entity.size() != nodes) refuse("M.entity has " + size(M.entity.size()) + expected);
  if (M.parameter.size() != nodes) refuse("M.parameter has " + size(M.parameter.size()) + expected);
  for (std::size_t n = 0; n < nodes; ++n) checkEntity(M, n);
}

// Relative to the cube of its longest edge: below it the inverse of its edges has no correct digit.
constexpr double degenerateIdeal = 1e-13;

void checkElements(const Mesh& M, const IdealElements& ideals) {
  const int nodes = static_cast<int>(M.x.size());
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    const std::array<int, 4>& tet = M.tets[E];
    const std::string at = "tetrahedron " + std::to_string(E);
    for (int n : tet)
      if (n < 0 || n >= nodes)
        refuse(at + " names node " + std::to_string(n) + ", but nodes are 0 to " +
               std::to_string(nodes - 1));
    if (!ideals.computational) continue;
    const std::array<Vec3, 4> z = ideals.of(static_cast<int>(E));
    double longest = 0;
    for (const Vec3& a : z)
      for (const Vec3& b : z) longest = std::max(longest, norm(a - b));
    if (!(std::abs(signedVolume6(z)) > degenerateIdeal * longest * longest * longest))
      refuse(at + ": its ideal element is degenerate; correct M.xi");
  }
}

void checkOptimizable(const Mesh& M) {
  checkNodes(M);
  checkElements(M, {M, Ideal::computational});
}

}  // namespace

OptimizeOptions OptimizeOptions::paper() {
  OptimizeOptions options;
  options.power = 1;
  options.numericalDerivatives = true;
  options.relaxation = 1;
  return options;
}

OptimizeReport optimizeMesh(Mesh& M, const OptimizeOptions& options) {
  checkOptions(options, M.x.size());
  checkOptimizable(M);
  Smoother S{M, options};
  if (M.tets.empty()) return {0, 0, true, 0, 0, 0};
  buildShapes(S);
  buildStars(S);
  buildFreedom(S);

  S.report.converged = untangleAndSmooth(S);
  const double disp = S.report.disp;
  if (S.report.converged && options.power > 1) liftWorst(S);
  S.report.disp = disp;
  const QualityStatistics q = qualityStatistics(M);
  S.report.inverted = q.inverted;
  S.report.minQ = q.min;
  S.report.meanQ = q.mean;
  return S.report;
}

// ==== Table I ===================================================================================

std::vector<double> qualities(const Mesh& M, Ideal ideal) {
  const IdealElements ideals(M, ideal);
  std::vector<double> q;
  q.reserve(M.tets.size());
  for (int E = 0; E < static_cast<int>(M.tets.size()); ++E)
    q.push_back(quality(jacobian(ideals.of(E), cornersOf(M.x, M.tets[E]))));
  return q;
}

QualityStatistics qualityStatistics(const Mesh& M, Ideal ideal) {
  QualityStatistics table;
  const std::vector<double> q = qualities(M, ideal);
  table.tetrahedra = static_cast<int>(q.size());
  if (q.empty()) return table;
  const int last = static_cast<int>(table.histogram.size()) - 1;
  table.min = table.max = q[0];
  for (double value : q) {
    if (value == 0) ++table.inverted;
    table.min = std::min(table.min, value);
    table.max = std::max(table.max, value);
    table.mean += value;
    ++table.histogram[std::clamp(static_cast<int>(20 * value), 0, last)];
  }
  const double count = static_cast<double>(q.size());
  table.mean /= count;
  for (double value : q) table.stdDev += (value - table.mean) * (value - table.mean);
  table.stdDev = std::sqrt(table.stdDev / count);
  return table;
}

}  // namespace meccano
