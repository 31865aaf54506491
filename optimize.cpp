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
// Hessian (a cube root each), one more for the trial step.
#include <cfloat>
#include <cstddef>
#include <cstdio>
#include <cstring>
#include <limits>
#include <map>
#include <numeric>

#include "meccano.hpp"

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
  double volume;                        // det of the edges from vertex 0
  Vec3 g;                               // g_0
};

IdealCorner idealCorner(const std::array<Vec3, 4>& z, std::size_t k, double scale = 1) {
  const int* o = opposite[k];
  const Mat3 I = scale * Mat3{z[o[0]] - z[k], z[o[1]] - z[k], z[o[2]] - z[k]};
  const Mat3 g = transpose(inverse(I));  // columns g_1, g_2, g_3
  const Vec3 g0 = -(g.c0 + g.c1 + g.c2);
  return {-dot(g0, g.c0),   -dot(g0, g.c1),   -dot(g0, g.c2), -dot(g.c0, g.c1),
          -dot(g.c0, g.c2), -dot(g.c1, g.c2), det(I),         g0};
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
// With η = N/(3 h^⅔), R = √(σ² + 4δ²) and ∂h/∂σ = h/R:
//   ∇η = η [2 v/N − 2 s/(3R)],
//   Hess η = η { (2|g|²/N) I − 4/(3NR) (v sᵀ + s vᵀ) + [4/9 + ⅔ σ/R] s sᵀ/R² }.
// The sum is that of φ(η) = linear η + (scale η)^power, φ = η in eq. (9) as printed:
//   ∇φ = φ′ ∇η,   Hess φ = φ′ Hess η + φ″ ∇η ∇ηᵀ = α I + β (v sᵀ + s vᵀ) + κ v vᵀ + ρ s sᵀ.

inline StarElement starElement(const IdealCorner& k, Vec3 a, Vec3 b, Vec3 c) {
  const Vec3 ab = b - a, ac = c - a, bc = c - b;
  const double N = k.K01 * norm2(a) + k.K02 * norm2(b) + k.K03 * norm2(c) + k.K12 * norm2(ab) +
                   k.K13 * norm2(ac) + k.K23 * norm2(bc);
  const Vec3 v = -(k.K01 * a + k.K02 * b + k.K03 * c);
  const Vec3 s = (-1 / k.volume) * cross(ab, ac);
  return {N, -dot(a, s), norm2(k.g), v, s};
}

struct Penalty {
  double linear, scale, power;
};
constexpr Penalty plainEta{1, 0, 1};  // scale 0: no second term

/// base^power; integer powers, the rule here, by repeated squaring, 5 times faster than pow.
double raise(double base, double power) {
  int n = static_cast<int>(power);
  double result = power > n ? std::pow(base, power - n) : 1;
  for (; n > 0; n >>= 1, base *= base)
    if (n & 1) result *= base;
  return result;
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

/// φ, φ′ η, φ″ η² and R of an element, ∞ for δ = 0 and σ <= 0.
struct Distortion {
  double phi, first, second, R;
};

Distortion penalized(double eta, double R, const Penalty& P) {
  const double w = raise(P.scale * eta, P.power);
  return {P.linear * eta + w, P.linear * eta + P.power * w, P.power * (P.power - 1) * w, R};
}

inline Distortion distortion(double N, double sigma, double delta, const Penalty& P) {
  const double R = delta == 0 ? std::abs(sigma) : std::sqrt(sigma * sigma + 4 * delta * delta);
  const double hs = sigma >= 0 ? (sigma + R) / 2 : 2 * delta * delta / (R - sigma);
  if (hs == 0) return {unbounded, unbounded, unbounded, R};
  const double y = inverseCubeRoot(hs), eta = N * y * y / 3;
  if (P.scale == 0) return {eta, eta, 0, R};
  return penalized(eta, R, P);
}

/// [§3.7.2, eq. (9)] Σ φ(η) over a star, its gradient and its Hessian.
///   source  derivatives after [32]
Objective objectiveOf(const std::vector<StarElement>& star, double delta, const Penalty& P) {
  Objective o{0, {}, {}};
  Mat3& H = o.hessian;
  double trace = 0;
  for (const StarElement& e : star) {
    const Distortion at = distortion(e.N, e.sigma, delta, P);
    const double n = 1 / std::max(e.N, DBL_MIN), r = 1 / at.R;
    o.f += at.phi;
    o.gradient += (2 * at.first * n) * e.v + (-2. / 3 * at.first * r) * e.s;
    const double beta = -4. / 3 * (at.first + at.second) * n * r;
    const double kappa = 4 * at.second * n * n;
    const double rho = (4. / 9 * (at.first + at.second) + 2. / 3 * at.first * e.sigma * r) * r * r;
    const Vec3 a = kappa * e.v + beta * e.s, b = beta * e.v + rho * e.s;
    trace += 2 * at.first * e.gg * n;  // α
    H = H + outer(a, e.v) + outer(b, e.s);
  }
  H.c0.x += trace;
  H.c1.y += trace;
  H.c2.z += trace;
  return o;
}

/// Σ φ(η) with the node displaced by d, and its slope along p.
LinePoint valueAt(const std::vector<StarElement>& star, Vec3 d, Vec3 p, double delta,
                  const Penalty& P) {
  LinePoint sum{0, 0};
  const double dd = norm2(d), dp = dot(d, p);
  for (const StarElement& e : star) {
    const double N = e.N + 2 * dot(e.v, d) + e.gg * dd;
    const Distortion at = distortion(N, e.sigma + dot(e.s, d), delta, P);
    const double vp = dot(e.v, p) + e.gg * dp;
    sum.F += at.phi;
    sum.slope += 2 * at.first * (vp / std::max(N, DBL_MIN) - dot(e.s, p) / (3 * at.R));
  }
  return sum;
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
    star.elements.push_back(
        starElement(idealCorner(ideals.of(E), k), a, b, M.x[tet[o[2]]] - M.x[n]));
  }
  return star;
}

double f(const Star& star, Vec3 x, double delta, double power) {
  return valueAt(star.elements, x - star.origin, {}, delta, {0, 1, power}).F;
}

Objective fDerivatives(const Star& star, Vec3 x, double delta, double power) {
  const Vec3 d = x - star.origin;
  std::vector<StarElement> elements = star.elements;
  for (StarElement& e : elements)
    e = {e.N + 2 * dot(e.v, d) + e.gg * norm2(d), e.sigma + dot(e.s, d), e.gg, e.v + e.gg * d, e.s};
  return objectiveOf(elements, delta, {0, 1, power});
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

/// A direction in the node's parameters; tMax is the step of the local edge length.
struct Direction {
  Vec3 p;
  double slope, tMax;
};

/// [§3.7.4] Newton's direction. Where the Hessian is not positive definite (1 visit in 10^4), down
/// the gradient by a tenth of the local edge.
Direction descentDirection(const Objective& o, const Mat3& derivative, double edge) {
  Vec3 p;
  if (!solveCholesky(o.hessian, -o.gradient, p))
    p = (-.1 * edge / norm(derivative * o.gradient)) * o.gradient;
  return {p, dot(p, o.gradient), edge / norm(derivative * p)};
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

// ==== 3.7.4 Optimization approach: Algorithm 2 ==================================================

namespace {

/// An element of a node's star: the other three nodes, the index of its IdealCorner.
struct StarEntry {
  int a, b, c, corner;
};

/// Gauss–Seidel over the nodes: all that Algorithm 2 keeps between visits.
struct Smoother {
  Mesh& M;
  const OptimizeOptions& options;
  OptimizeReport report = {};

  std::vector<IdealCorner> corners = {};  // 4 for each ideal element; few on a meccano mesh
  std::vector<int> shapeOf = {};          // [tets] corners of E: corners[4 shapeOf[E] + vertex]
  std::vector<int> starStart = {};        // [nodes + 1] of n: star[starStart[n] .. starStart[n+1])
  std::vector<StarEntry> star = {};       // [4 tets]
  std::vector<unsigned char> freedom = {};  // [nodes] 3 inner, 2 surface, 1 curve, 0 fixed
  std::vector<double> unrest =
      {};  // [nodes] largest move in its star since its last visit, relative

  struct SheetTriangle {
    int a, b, label;
  };                                 // with its node counter-clockwise in 𝓤 of the surface
  std::vector<int> sheetStart = {};  // [nodes + 1] surface triangles at n, rows of sheet
  std::vector<SheetTriangle> sheet = {};

  double delta = 0;      // of the sweep, relative to the mean σ
  bool tangled = false;  // of the mesh, and the rung of the schedule for μ
  int rung = 0;
  Penalty penalty = plainEta;
  double wake = 0;                       // unrest from which a node is visited
  std::vector<StarElement> around = {};  // the star under visit; kept to save allocations
};

/// The scale that makes the mean of σ 1 (of a wildly tangled mesh .1 of the mean |σ|), so that μ
/// and δ are relative.
double idealScale(const Mesh& M, const IdealElements& ideals) {
  double sum = 0, absolute = 0;
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    const double sigma = signedVolume6(cornersOf(M.x, M.tets[E])) / signedVolume6(ideals.of(E));
    sum += sigma;
    absolute += std::abs(sigma);
  }
  const double mean = std::max(sum, .1 * absolute) / static_cast<double>(M.tets.size());
  return mean > 0 ? std::cbrt(mean) : 1;
}

/// Corners of the ideal elements; [choice] those whose edges agree as floats are one shape.
void buildCorners(Smoother& S) {
  const IdealElements ideals(S.M, Ideal::computational);
  const double scale = idealScale(S.M, ideals);
  std::map<std::array<float, 9>, int> known;
  for (std::size_t E = 0; E < S.M.tets.size(); ++E) {
    const std::array<Vec3, 4> z = ideals.of(E);
    std::array<float, 9> key;
    for (int k = 0; k < 3; ++k) {
      const Vec3 e = z[k + 1] - z[0];
      key[3 * k] = static_cast<float>(e.x);
      key[3 * k + 1] = static_cast<float>(e.y);
      key[3 * k + 2] = static_cast<float>(e.z);
    }
    const auto [place, isNew] = known.emplace(key, static_cast<int>(known.size()));
    S.shapeOf.push_back(place->second);
    for (int k = 0; k < 4 && isNew; ++k) S.corners.push_back(idealCorner(z, k, scale));
  }
}

void buildStars(Smoother& S) {
  S.starStart.assign(S.M.x.size() + 1, 0);
  for (const std::array<int, 4>& tet : S.M.tets)
    for (int n : tet) ++S.starStart[n + 1];
  std::partial_sum(S.starStart.begin(), S.starStart.end(), S.starStart.begin());
  std::vector<int> next = S.starStart;
  S.star.resize(4 * S.M.tets.size());
  for (std::size_t E = 0; E < S.M.tets.size(); ++E) {
    const std::array<int, 4>& tet = S.M.tets[E];
    for (int k = 0; k < 4; ++k) {
      const int* o = opposite[k];
      S.star[next[tet[k]]++] = {tet[o[0]], tet[o[1]], tet[o[2]], 4 * S.shapeOf[E] + k};
    }
  }
}

/// What each node may do; without geometry the boundary is fixed. Nodes that start active.
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
  for (std::size_t n = 0; n < M.x.size(); ++n)
    if (S.starStart[n] == S.starStart[n + 1]) S.freedom[n] = 0;
  S.unrest.assign(M.x.size(), S.options.active.empty() ? unbounded : 0);
  for (int n : S.options.active) S.unrest[n] = unbounded;
}

/// The labelled faces at each sliding node, as triangles of 𝓤.
void buildSheets(Smoother& S) {
  const Mesh& M = S.M;
  if (M.faceLabel.empty() || M.dimension.empty()) return;
  std::vector<std::pair<int, Smoother::SheetTriangle>> entries;
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int k = 0; k < 4; ++k) {
      const int label = M.faceLabel[E][k];
      if (label == 0) continue;
      int v[3];
      Vec2 u[3];
      bool known = true;
      for (int i = 0; i < 3; ++i) {
        v[i] = M.tets[E][opposite[k][i]];
        known = known && parameterOn(M, v[i], label, u[i]);
      }
      const double area = known ? cross(u[1] - u[0], u[2] - u[0]) : 0;
      if (area < 0) std::swap(v[1], v[2]);
      for (int i = 0; i < 3 && area != 0; ++i)
        if (S.freedom[v[i]] == 1 || S.freedom[v[i]] == 2)
          entries.push_back({v[i], {v[(i + 1) % 3], v[(i + 2) % 3], label}});
    }
  S.sheetStart.assign(M.x.size() + 1, 0);
  for (const auto& entry : entries) ++S.sheetStart[entry.first + 1];
  for (std::size_t n = 0; n < M.x.size(); ++n) S.sheetStart[n + 1] += S.sheetStart[n];
  S.sheet.resize(entries.size());
  std::vector<int> next = S.sheetStart;
  for (const auto& entry : entries) S.sheet[next[entry.first]++] = entry.second;
}

struct Validity {
  int inverted;
  double sigmaMin;
};
Validity validity(const Smoother& S) {
  Validity v{0, unbounded};
  for (std::size_t E = 0; E < S.M.tets.size(); ++E) {
    const std::array<Vec3, 4> x = cornersOf(S.M.x, S.M.tets[E]);
    const double sigma = signedVolume6(x) / S.corners[4 * S.shapeOf[E]].volume;
    if (!(sigma > 0)) ++v.inverted;
    v.sigmaMin = std::min(v.sigmaMin, sigma);
  }
  return v;
}

// ---- one visit ---------------------------------------------------------------------------------

struct Edges {
  double shortest, longest;
};

/// Fills S.around with the star of n; the edges at n.
Edges gatherStar(Smoother& S, int n) {
  const Vec3 x = S.M.x[n];
  double shortest = unbounded, longest = 0;
  S.around.clear();
  for (int k = S.starStart[n]; k < S.starStart[n + 1]; ++k) {
    const StarEntry& e = S.star[k];
    const Vec3 a = S.M.x[e.a] - x, b = S.M.x[e.b] - x, c = S.M.x[e.c] - x;
    S.around.push_back(starElement(S.corners[e.corner], a, b, c));
    const double aa = norm2(a), bb = norm2(b), cc = norm2(c);
    shortest = std::min(shortest, std::min(aa, std::min(bb, cc)));
    longest = std::max(longest, std::max(aa, std::max(bb, cc)));
  }
  return {std::sqrt(shortest), std::sqrt(longest)};
}

constexpr double roundingOfF = 1e-14;  // relative: a smaller decrease of f is lost in its sum

/// [§3.7.4] An inner node: one Newton step with the strong Wolfe conditions. Returns the
/// displacement.
double visitInner(Smoother& S, int n, const Edges& edges) {
  constexpr Mat3 unit{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  const Objective o = objectiveOf(S.around, S.delta, S.penalty);
  const Direction d = descentDirection(o, unit, edges.longest);
  if (!(-d.slope > roundingOfF * o.f)) return 0;
  const auto line = [&](double t) { return valueAt(S.around, t * d.p, d.p, S.delta, S.penalty); };
  const WolfeStep step = wolfeSearch(line, {o.f, d.slope}, S.options.relaxation, d.tMax);
  S.M.x[n] += step.t * d.p;
  return step.t * norm(d.p);
}

/// [departure] Whether the surface triangles at n stay counter-clockwise in 𝓤 with n at this
/// parameter. While elements are inverted f alone lets a node slide past its neighbours, or a rim
/// node round a corner, from where no descent brings it back.
bool staysUnfolded(Smoother& S, int n, Vec2 parameter) {
  if (S.sheetStart.empty()) return true;
  const Vec2 before = S.M.parameter[n];
  S.M.parameter[n] = parameter;
  bool unfolded = true;
  Vec2 u, a, b;
  for (int k = S.sheetStart[n]; k < S.sheetStart[n + 1] && unfolded; ++k) {
    const Smoother::SheetTriangle& t = S.sheet[k];
    unfolded = parameterOn(S.M, n, t.label, u) && parameterOn(S.M, t.a, t.label, a) &&
               parameterOn(S.M, t.b, t.label, b) && cross(a - u, b - u) > 0;
  }
  S.M.parameter[n] = before;
  return unfolded;
}

/// Step of the paper's differences, relative to the shortest edge. Second derivatives have errors
/// of 1e-8 by truncation and by cancellation.
constexpr double differenceStep = 1e-4;

constexpr int rejectedSteps =
    3;  // OptimizeOptions::accept is asked for so many, each half the last

/// [§3.7.3, eq. (10), (11)] A surface or curve node: a Newton step in its parameters. Returns the
/// displacement.
///   [departure] Armijo's condition alone: at the kinks of ϕ and γ the curvature condition may hold
///   nowhere
double visitSliding(Smoother& S, int n, const Edges& edges) {
  const Vec2 u = S.M.parameter[n];
  const Vec3 x = S.M.x[n];
  const Place here = placeOf(S.M, n, u);
  if (!here.inside) return 0;
  const Mat3& D = here.derivative;
  const int count = S.M.dimension[n];
  const auto F = [&](Vec2 change) {
    const Place at = placeOf(S.M, n, u + change);
    return at.inside ? valueAt(S.around, at.x - x, {}, S.delta, S.penalty).F : unbounded;
  };
  const double e = differenceStep * edges.shortest;
  const Objective o = S.options.numericalDerivatives
                          ? byDifferences(F, count, {e / norm(D.c0), e / norm(D.c1)})
                          : inParameters(objectiveOf(S.around, S.delta, S.penalty), D, count);
  const Direction d = descentDirection(o, D, edges.longest);
  if (!(-d.slope > roundingOfF * o.f)) return 0;
  const Vec2 p{d.p.x, d.p.y};
  double t = std::min(S.options.relaxation, d.tMax);
  const auto isStep = [&](double length) {
    return F(length * p) <= o.f + wolfeC1 * length * d.slope &&
           staysUnfolded(S, n, placeOf(S.M, n, u + length * p).parameter);
  };
  const auto isAccepted = [&](const Place& at) {
    return !S.options.accept || S.options.accept(n, at.x, at.parameter);
  };
  for (int k = 0, rejected = 0;; t /= 2) {
    if (isStep(t)) {
      if (isAccepted(placeOf(S.M, n, u + t * p))) break;
      if (++rejected == rejectedSteps) return 0;
    }
    if (++k == wolfeEvaluations) return 0;
  }
  const Place at = placeOf(S.M, n, u + t * p);
  S.M.x[n] = at.x;
  S.M.parameter[n] = at.parameter;
  return norm(at.x - x);
}

constexpr double starLadder[3] = {1e-2, 1e-4, 1e-6};  // μ of the star's mean |σ|

/// [§2 choice] δ of the star under visit: 0 where it is valid.
double starDelta(const Smoother& S) {
  double least = unbounded, mean = 0;
  for (const StarElement& e : S.around) {
    least = std::min(least, e.sigma);
    mean += std::abs(e.sigma) / static_cast<double>(S.around.size());
  }
  return mean > 0 ? mean * chooseDelta(least / mean, starLadder[S.rung]) : S.delta;
}

/// [§3.7.4, Algorithm 2] smoothNode: returns the displacement relative to the node's shortest edge.
double smoothNode(Smoother& S, int n) {
  const Edges edges = gatherStar(S, n);
  if (!(edges.longest > 0)) return 0;
  if (S.options.starDelta && S.tangled) S.delta = starDelta(S);
  const double moved = S.freedom[n] == 3 ? visitInner(S, n, edges) : visitSliding(S, n, edges);
  return moved / std::max(edges.shortest, DBL_EPSILON * edges.longest);
}

// ---- sweeps ------------------------------------------------------------------------------------

bool sweepsLeft(const Smoother& S) { return S.report.sweeps < S.options.maxSweeps; }

void countSweep(Smoother& S, double disp) {
  ++S.report.sweeps;
  if (!S.options.onSweep) return;
  const QualityStatistics q = qualityStatistics(S.M);
  S.options.onSweep({S.report.sweeps, q.inverted, q.min, disp});
}

/// [§3.7.4, Algorithm 2] The body of its while loop over the nodes whose star has moved: returns
/// disp.
double sweepNodes(Smoother& S) {
  double disp = 0;
  for (int n = 0; n < static_cast<int>(S.M.x.size()); ++n) {
    if (S.freedom[n] == 0 || !(S.unrest[n] > S.wake)) continue;
    const double moved = smoothNode(S, n);
    disp = std::max(disp, moved);
    S.unrest[n] = moved;
    if (moved == 0) continue;
    for (int k = S.starStart[n]; k < S.starStart[n + 1]; ++k)
      for (int i : {S.star[k].a, S.star[k].b, S.star[k].c})
        S.unrest[i] = std::max(S.unrest[i], moved);
  }
  countSweep(S, disp);
  return disp;
}

// ---- global descent: all inner nodes at once ---------------------------------------------------

struct Functional {
  double F, sigmaMin;
};

/// Weight of (1 + σ²)/(2h) beside η. Without it elements shrink to points, since η with h(σ) tends
/// to 0 there; with 1/8 the cube turned by 3 rad stays tangled.
constexpr double volumeWeight = 1;

/// Σ η + (1 + σ²)/(2h) over the mesh, with its gradient at the free inner nodes, σ_min, and the
/// diagonal of the Hessian's part 2 η |g|²/N.
///   source  Garanzha et al., Foldover-free maps in 50 lines of code
Functional meshFunctional(const Smoother& S, double delta, std::vector<Vec3>& gradient,
                          std::vector<double>& diagonal) {
  Functional sum{0, unbounded};
  gradient.assign(S.M.x.size(), {});
  diagonal.assign(S.M.x.size(), 0);
  for (std::size_t E = 0; E < S.M.tets.size(); ++E) {
    const std::array<int, 4>& tet = S.M.tets[E];
    const IdealCorner* corner = &S.corners[4 * S.shapeOf[E]];
    const Vec3 x = S.M.x[tet[0]];
    Mat3 J{};
    for (int k = 1; k < 4; ++k) J = J + outer(S.M.x[tet[k]] - x, corner[k].g);
    const double N = std::max(norm2(J), DBL_MIN), sigma = det(J), square = 1 + sigma * sigma;
    const Distortion at = distortion(N, sigma, delta, plainEta);
    const double volume = volumeWeight / (2 * h(sigma, delta)), stiffness = 2 * at.phi / N;
    const double slope = volume * (2 * sigma - square / at.R) - 2. / 3 * at.phi / at.R;  // ∂/∂σ
    const Mat3 D = stiffness * J + slope * cofactor(J);                                  // ∂/∂J
    sum.F += at.phi + volume * square;
    sum.sigmaMin = std::min(sum.sigmaMin, sigma);
    for (int k = 0; k < 4; ++k)
      if (S.freedom[tet[k]] == 3) {
        gradient[tet[k]] += D * corner[k].g;
        diagonal[tet[k]] += stiffness * norm2(corner[k].g);
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
  for (std::size_t n = 0; n < p.size(); ++n)
    if (diagonal[n] > 0) p[n] = (1 / diagonal[n]) * p[n];
  for (std::size_t k = 0; k < pairs.size(); ++k)
    addMultiple(p, alpha[k] - product(pairs[k].y, p) / pairs[k].dy, pairs[k].d);
  return p;
}

constexpr std::size_t lbfgsPairs = 8;
constexpr int lbfgsIterations = 150;    // per δ
constexpr double lbfgsDecrease = 1e-4;  // of F in one step, relative: below it δ is chosen anew

/// L-BFGS on the functional at one δ. Returns its last value.
Functional descend(Smoother& S, double delta) {
  std::vector<Vec3> gradient, newGradient;
  std::vector<double> diagonal;
  std::vector<LbfgsPair> pairs;
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
  for (int round = 0; round < descentRounds && sweepsLeft(S); ++round) {
    const Functional at = descend(S, delta);
    countSweep(S, 1);
    if (at.sigmaMin > 0) return;
    const double decrease = round == 0 ? leastDecrease : std::max(1 - at.F / last, leastDecrease);
    const double mu = (1 - decrease) * h(at.sigmaMin, delta);
    delta = at.sigmaMin < mu ? std::sqrt(mu * (mu - at.sigmaMin)) : validDelta;
    last = at.F;
  }
}

// ---- Algorithm 2 -------------------------------------------------------------------------------

constexpr double wakeFraction = .1;       // of maxDisp: a star that moved less is not visited again
constexpr int sweepsWithoutProgress = 3;  // that μ is given before the next
constexpr double muLadder[3] = {2.5, 1, .25};  // of options.mu, in turn while the mesh is tangled

/// μ of the sweep: the next rung where the number of inverted elements does not fall.
struct MuSchedule {
  int rung = 0, fewest = std::numeric_limits<int>::max(), waited = 0, tangledSweeps = 0;

  double next(double mu, int inverted) {
    ++tangledSweeps;
    if (inverted >= fewest && ++waited < sweepsWithoutProgress) return mu * muLadder[rung];
    if (inverted >= fewest) rung = (rung + 1) % 3;
    fewest = inverted;
    waited = 0;
    return mu * muLadder[rung];
  }
};

/// [§3.7.4, Algorithm 2] optimizeMesh's loop. While elements are inverted δ comes from the σ_min of
/// the whole mesh and holds for all nodes; afterwards it is 0, and a move that would invert an
/// element has f = ∞. Returns whether it converged on a valid mesh.
bool untangleAndSmooth(Smoother& S) {
  MuSchedule schedule;
  bool tangled = true;
  S.wake = wakeFraction * S.options.maxDisp;
  while (sweepsLeft(S)) {
    const Validity v = tangled ? validity(S) : Validity{0, 1};
    tangled = v.inverted > 0;
    if (tangled && schedule.tangledSweeps >= S.options.maxTangledSweeps) {
      if (!S.options.globalDescent) return false;
      globalDescent(S);
      schedule = {};
      S.unrest.assign(S.M.x.size(), unbounded);
      continue;
    }
    S.delta = tangled ? chooseDelta(v.sigmaMin, schedule.next(S.options.mu, v.inverted)) : 0;
    S.tangled = tangled;
    S.rung = schedule.rung;
    S.report.disp = sweepNodes(S);
    if (!tangled && S.report.disp <= S.options.maxDisp) return true;
  }
  return false;
}

// ---- the worst elements ------------------------------------------------------------------------

constexpr double worstFraction = .01;   // of the elements count as the worst ones,
constexpr std::size_t worstCount = 10;  // but at least so many
constexpr int liftRounds = 15, liftSweeps = 8;
constexpr double liftMeanLoss =
    .015;  // of mean q: the rounds end there (the last one wins most back),
constexpr double liftMinGain = .002;  // or where the lowest q rises by less
constexpr double liftMaxDisp = 1e-3;  // relative to the shortest edge: a round's sweeps end there
constexpr double liftWake = .015;     // unrest for a visit: only what happens near the worst counts
constexpr double liftReach = .85;     // (η/η_w)^48 below it is nothing
constexpr double liftRatio =
    1.6;  // η/η_w at most: 1.6^48 = 6e9, and a Newton step lowers it e-fold

/// q of the elements, the lowest, the mean, and what bounds the worst elements from above.
struct WorstElements {
  std::vector<double> q;
  double lowest, mean, bound;
};

WorstElements worstElements(const Mesh& M) {
  WorstElements worst{qualities(M), 0, 0, 0};
  std::vector<double> q = worst.q;
  const double count = static_cast<double>(q.size());
  const std::size_t wanted = std::max(worstCount, static_cast<std::size_t>(worstFraction * count));
  const auto bound = q.begin() + static_cast<std::ptrdiff_t>(std::min(q.size(), wanted)) - 1;
  std::nth_element(q.begin(), bound, q.end());
  worst.lowest = *std::min_element(q.begin(), bound + 1);
  worst.mean = std::accumulate(q.begin(), q.end(), 0.) / count;
  worst.bound = *bound;
  return worst;
}

/// One round: sweeps on Σ η + (η/η_w)^power, q_w = 1/η_w, from the nodes of the worst elements on.
void liftRound(Smoother& S, const WorstElements& worst, double qw) {
  S.penalty = {1, qw, S.options.power};
  S.wake = liftWake;
  for (std::size_t E = 0; E < S.M.tets.size(); ++E)
    if (worst.q[E] <= worst.bound / liftReach)
      for (int n : S.M.tets[E]) S.unrest[n] = unbounded;
  for (int k = 0; k < liftSweeps && sweepsLeft(S); ++k)
    if (sweepNodes(S) <= liftMaxDisp) return;
}

/// [§3.7.4 departure] Raises the worst elements of a valid, converged mesh: Σ η + (η/η_w)^power,
/// with η_w the distortion that the worst 1 % exceed, anew in each round; the others keep Σ η. Ends
/// where the lowest q rises no more. A last round with η_w that of the worst element lets all the
/// others relax and wins the mean back.
void liftWorst(Smoother& S) {
  WorstElements worst = worstElements(S.M);
  const double meanAtStart = worst.mean;
  if (worst.lowest > 1 - liftMinGain) return;
  for (int round = 0; round < liftRounds && sweepsLeft(S); ++round) {
    const double before = worst.lowest;
    liftRound(S, worst, std::min(worst.bound, liftRatio * worst.lowest));
    worst = worstElements(S.M);
    if (worst.mean < meanAtStart - liftMeanLoss || worst.lowest < before + liftMinGain) break;
  }
  liftRound(S, worst, worst.lowest);
}

// ---- input -------------------------------------------------------------------------------------

[[noreturn]] void refuse(const std::string& what) {
  throw InputError("optimizeMesh (§3.7): " + what);
}

}  // namespace

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
  if (surfaceOf(M, entity).gridSize < 1)
    refuse(at + "its surface " + std::to_string(entity) +
           " has no locator; call buildLocator() first");
}

void checkNodes(const Mesh& M) {
  const std::size_t nodes = M.x.size();
  const auto demandSize = [nodes](const char* name, std::size_t size) {
    if (size != nodes)
      refuse(name + (" has " + std::to_string(size)) + " entries, expected " +
             std::to_string(nodes) + ", one per node");
  };
  if (!M.xi.empty()) demandSize("M.xi", M.xi.size());
  for (std::size_t n = 0; n < nodes; ++n) {
    if (!isFinite(M.x[n]))
      refuse("node " + std::to_string(n) + " has a coordinate that is not finite; correct M.x");
    if (!M.xi.empty() && !isFinite(M.xi[n]))
      refuse("node " + std::to_string(n) +
             " has a computational coordinate that is not finite; correct M.xi");
  }
  if (M.dimension.empty()) return;
  demandSize("M.dimension", M.dimension.size());
  demandSize("M.entity", M.entity.size());
  demandSize("M.parameter", M.parameter.size());
  for (std::size_t n = 0; n < nodes; ++n) checkEntity(M, n);
}

/// Relative to the cube of its longest edge: below it the inverse of its edges has no correct
/// digit.
constexpr double degenerateIdeal = 1e-13;

void checkElements(const Mesh& M) {
  const int nodes = static_cast<int>(M.x.size());
  for (std::size_t E = 0; E < M.tets.size(); ++E) {
    for (int n : M.tets[E])
      if (n < 0 || n >= nodes)
        refuse("tetrahedron " + std::to_string(E) + " names node " + std::to_string(n) +
               ", but nodes are 0 to " + std::to_string(nodes - 1));
    if (M.xi.empty()) continue;
    const std::array<Vec3, 4> z = cornersOf(M.xi, M.tets[E]);
    double longest = 0;
    for (const Vec3& a : z)
      for (const Vec3& b : z) longest = std::max(longest, norm(a - b));
    if (!(std::abs(signedVolume6(z)) > degenerateIdeal * longest * longest * longest))
      refuse("tetrahedron " + std::to_string(E) +
             ": its ideal element is degenerate; correct M.xi");
  }
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
  checkNodes(M);
  checkElements(M);
  Smoother S{M, options};
  if (M.tets.empty()) return {0, 0, true, 0, 0, 0};
  buildCorners(S);
  buildStars(S);
  buildFreedom(S);
  buildSheets(S);

  S.report.converged = untangleAndSmooth(S);
  if (S.report.converged && options.power > 1) liftWorst(S);
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
  for (std::size_t E = 0; E < M.tets.size(); ++E)
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
