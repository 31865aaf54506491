// SPDX-License-Identifier: MIT
//
// meccano: insertion of triangulated surfaces into a meccano tetrahedral mesh by bisection,
// extraction, Floater projection, and node-by-node untangling and smoothing. The method of
//
//   "Insertion of Triangulated Surfaces Into a Meccano Tetrahedral Discretization by Means of
//    Mesh Refinement and Optimization Procedures"            (the paper; §, eq. and cases are its)
//
// Vendoring: copy meccano.hpp, insert.cpp, optimize.cpp (C++17, no dependency, no flag needed),
//            compile the two .cpp with your code, call meccano::insertSurface,
//            catch meccano::Error (your mesh is then what it was).
//
// Limits: at most 2^31 - 1 nodes or tetrahedra; surfaces are disks with a rim, and touch neither
// each other nor the boundary. The library never prints, opens a file, reads the clock, draws random
// numbers or keeps global state: the same input gives the same bytes.
//
// Tags:   [§…, eq. (…)] what the code implements · [choice] the paper is silent · [departure] we differ
#ifndef MECCANO_HPP
#define MECCANO_HPP

#include <array>
#include <cmath>
#include <functional>
#include <stdexcept>
#include <string>
#include <vector>

namespace meccano {

inline constexpr const char* version = "0.1.0";

// ==== Errors ====================================================================================
// The message says what, where and what to do. One catch of Error gets all.

struct Error : std::runtime_error { using std::runtime_error::runtime_error; };
struct InputError : Error { using Error::Error; };   // the data break §3.1, or a file is malformed
struct MethodError : Error { using Error::Error; };  // a step cannot reach what it promises
struct SolverError : Error { using Error::Error; };  // a linear solve did not converge

// ==== Algebra ===================================================================================

struct Vec2 { double x = 0, y = 0; };
struct Vec3 { double x = 0, y = 0, z = 0; };
struct Mat3 { Vec3 c0, c1, c2; };  // by columns

inline Vec2 operator+(Vec2 a, Vec2 b) { return {a.x + b.x, a.y + b.y}; }
inline Vec2 operator-(Vec2 a, Vec2 b) { return {a.x - b.x, a.y - b.y}; }
inline Vec2 operator*(double t, Vec2 a) { return {t * a.x, t * a.y}; }
inline double dot(Vec2 a, Vec2 b) { return a.x * b.x + a.y * b.y; }
inline double cross(Vec2 a, Vec2 b) { return a.x * b.y - a.y * b.x; }
inline double norm(Vec2 a) { return std::sqrt(dot(a, a)); }

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator-(Vec3 a) { return {-a.x, -a.y, -a.z}; }
inline Vec3 operator*(double t, Vec3 a) { return {t * a.x, t * a.y, t * a.z}; }
inline Vec3& operator+=(Vec3& a, Vec3 b) { return a = a + b; }
inline bool operator==(Vec3 a, Vec3 b) { return a.x == b.x && a.y == b.y && a.z == b.z; }
inline double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline double norm2(Vec3 a) { return dot(a, a); }
inline double norm(Vec3 a) { return std::sqrt(norm2(a)); }
inline bool isFinite(Vec3 a) { return std::isfinite(a.x) && std::isfinite(a.y) && std::isfinite(a.z); }

inline Vec3 operator*(const Mat3& A, Vec3 v) { return v.x * A.c0 + v.y * A.c1 + v.z * A.c2; }
inline Mat3 operator*(const Mat3& A, const Mat3& B) { return {A * B.c0, A * B.c1, A * B.c2}; }
inline Mat3 operator*(double t, const Mat3& A) { return {t * A.c0, t * A.c1, t * A.c2}; }
inline Mat3 operator+(const Mat3& A, const Mat3& B) { return {A.c0 + B.c0, A.c1 + B.c1, A.c2 + B.c2}; }
inline Mat3 outer(Vec3 a, Vec3 b) { return {b.x * a, b.y * a, b.z * a}; }  // a bᵀ
inline Mat3 transpose(const Mat3& A) {
  return {{A.c0.x, A.c1.x, A.c2.x}, {A.c0.y, A.c1.y, A.c2.y}, {A.c0.z, A.c1.z, A.c2.z}};
}
inline double det(const Mat3& A) { return dot(A.c0, cross(A.c1, A.c2)); }
inline double norm2(const Mat3& A) { return norm2(A.c0) + norm2(A.c1) + norm2(A.c2); }  // ‖A‖²
/// Cofactors: ∂ det A / ∂A, so A⁻¹ = cof(A)ᵀ / det A.
inline Mat3 cofactor(const Mat3& A) {
  return {cross(A.c1, A.c2), cross(A.c2, A.c0), cross(A.c0, A.c1)};
}
inline Mat3 inverse(const Mat3& A) { return (1 / det(A)) * transpose(cofactor(A)); }
/// Solves A p = b for symmetric A by Cholesky; false where A is not positive definite.
bool solveCholesky(const Mat3& A, Vec3 b, Vec3& p);

// ==== Data ======================================================================================

/// The immersed triangulated surface 𝓢 of §3.1, or any triangle soup a reader gives.
struct TriangleSurface {
  std::vector<Vec3> points;                   // [points], length unit of the input
  std::vector<std::array<int, 3>> triangles;  // [triangles], indices into points, one orientation
  std::string name = {};                      // label for messages and files; may be empty
};

/// [§3.6, eq. (3)] A surface with its parameterization ϕ: 𝓤 → 𝓢, affine on each triangle.
/// Inserted surfaces and the patches of the boundary ∂𝓜 are both of this kind.
struct Parametrization {
  std::vector<Vec3> points;                   // [points], length unit of the input
  std::vector<std::array<int, 3>> triangles;  // [triangles], counter-clockwise in 𝓤
  std::vector<Vec2> u;                        // [points], in 𝓤 (the unit square)
  std::string name = {};
  int rim = 0;                                // number of its rim among Mesh::curves; 0: a boundary patch
  // Uniform grid over 𝓤 for the point location; derived data, made by buildLocator().
  int gridSize = 0;
  std::vector<int> gridStart, gridTriangles;  // triangles of cell c: gridTriangles[gridStart[c] .. gridStart[c+1])
};

/// [§3.7.3] A curve γ(s) by arc length: the rim of an inserted surface, or an edge of the boundary.
struct Curve {
  std::vector<Vec3> points;  // [points], along the curve
  std::vector<double> s;     // [points], arc length; a closed curve has one more entry, its length
  bool closed = false;       // true: points.back() is joined to points.front(), s is periodic
  struct Side { int surface; std::vector<Vec2> u; };
  std::vector<Side> sides;   // each surface (label as in Mesh::faceLabel) the curve bounds, with u at the points
};

/// A fixed point of the geometry: a corner of the domain, or a sharp corner of a rim.
struct Corner {
  Vec3 x;
  struct Place { int curve; double s; };
  std::vector<Place> on;  // the curves through it (numbers as in Mesh::entity)
};

/// The tetrahedral mesh 𝓜 with its computational counterpart and its geometry.
/// Numbers of surfaces, patches, curves and corners start at 1, as in the file. A mesh that is only
/// to be optimized needs x and tets; it then counts as one without geometry (boundary fixed).
struct Mesh {
  std::vector<Vec3> x;                   // physical nodes, [nodes], length unit of the input
  std::vector<Vec3> xi;                  // computational nodes, [nodes], cubes of edge 1; empty: none
  std::vector<std::array<int, 4>> tets;  // [tets], bisection order: z0 z1 is the refinement edge
  std::vector<unsigned char> type;       // [tets], 0 1 2 of Kossaczký's method
  std::vector<unsigned char> level;      // [tets], bisections since the cube; level mod 3 = type
  // [tets], label of the face opposite to each vertex: 0 none, k > 0 inserted surface k, -p boundary patch p
  std::vector<std::array<int, 4>> faceLabel;
  std::vector<unsigned char> dimension;  // [nodes], 3 inside, 2 on a surface, 1 on a curve, 0 a corner
  std::vector<int> entity;               // [nodes], 0; label k or -p; number of the curve; of the corner
  std::vector<Vec2> parameter;           // [nodes], (0,0); u; (s,0); (0,0)
  std::vector<Parametrization> surfaces; // inserted surface k is surfaces[k-1]
  std::vector<Parametrization> patches;  // boundary patch p is patches[p-1]
  std::vector<Curve> curves;             // curve c is curves[c-1]
  std::vector<Corner> corners;           // corner c is corners[c-1]
  Vec3 cube{1, 1, 1};                    // physical edge lengths of an undeformed cube of level 0
};

/// Table I: the number of inverted elements and the statistics of q over all.
/// [choice] q = 0 where σ ≤ 0, and these elements are the inverted ones: eq. (5) takes |σ|.
struct QualityStatistics {
  int tetrahedra = 0, inverted = 0;
  double min = 0, max = 0, mean = 0, stdDev = 0;
  std::array<int, 20> histogram{};  // elements with q in [i/20, (i+1)/20), q = 1 in the last
};

// ==== Options and reports =======================================================================

/// One sweep of Algorithm 2, for a progress display.
struct Sweep { int number, inverted; double minQ, disp; };

struct OptimizeOptions {
  double maxDisp = 1e-2;   // Algorithm 2's maxDisp, relative to the node's shortest edge; > 0
  int maxSweeps = 300;     // bound of Algorithm 2's loop; >= 1
  double power = 6;        // exponent of the sweeps on Σ η^power for the worst elements; 1: none, see optimizeMesh
  bool numericalDerivatives = false;  // §3.7.3: derivatives in u and s by differences, as printed
  double mu = 8e-3;        // h(σ_min) that δ gives, relative to the mean σ; (0, 1)
  std::vector<int> fixed = {};   // nodes that stay where they are, besides the corners
  std::vector<int> active = {};  // nodes visited in the first sweep; empty: all
  std::function<void(const Sweep&)> onSweep = nullptr;  // called after each sweep

  static OptimizeOptions paper();  // Algorithm 2 to the letter: Σ η alone, numerical derivatives
};

struct OptimizeReport {
  int sweeps = 0;         // of all phases
  double disp = 0;        // last sweep's largest displacement, relative to the node's shortest edge
  bool converged = false; // disp <= maxDisp before maxSweeps
  int inverted = 0;       // elements with σ <= 0 left
  double minQ = 0, meanQ = 0;
};

struct InsertOptions {
  double lc = 0;              // [eq. (1)] l_c, length unit of the input; > 0 and below dist(∂M, S)
  bool halfSquares = true;    // [§3.5 departure] rim regularization
  bool followRim = true;      // [§3.6 departure] rim correspondence and anchored equations
  int maxTets = 20000000;     // refuse where more tetrahedra are predicted
  OptimizeOptions optimize;   // §3.7
  // Called after each stage ("refined", "projected", "smoothed") with the mesh as it is then.
  std::function<void(const char* stage, const Mesh&)> onStage = nullptr;
  std::function<void(const std::string& line)> onProgress = nullptr;  // a line per step

  static InsertOptions paper();  // the paper to the letter, but for the full subcomplex of §3.5
};

struct InsertReport {
  int surface = 0;             // its number k: M.surfaces[k-1], faces labelled k
  double lc = 0;               // as used
  int nodes = 0, triangles = 0;// of S_M
  double maxNodeDistance = 0;  // largest |x_i - S| of the nodes of S_M
  double hausdorff = 0;        // two-sided, S_M - S, sampled
  double tangentialShift = 0;  // largest distance a node was moved along S by the projection and the smoothing
  QualityStatistics original, refined, projected, smoothed;  // against the computational elements
  QualityStatistics regular;                                 // smoothed, against the regular tetrahedron
  OptimizeReport optimization;
  std::vector<std::string> warnings;  // valid but poor: what and where
};

// ==== 2. Meccano: boxes and Kossaczký bisection [17] ============================================

/// [§2, §3.1] A box of near-cubic cells, each cell six Kuhn tetrahedra of type 0; its meccano is the
/// lattice of unit cubes. Six patches (x-, x+, y-, y+, z-, z+ are 1 .. 6), twelve curves, eight corners.
///   origin, size  length unit of the input, size > 0
///   cells         >= 1 each
///   errors        InputError
Mesh boxMesh(Vec3 origin, Vec3 size, std::array<int, 3> cells);

/// [§3.2, after 17] Bisects each tetrahedron of E once, after its neighbours where conformity asks for it.
/// Child 0 keeps the parent's index, child 1 is appended; new nodes are midpoints, on surfaces and curves
/// the parametric ones [choice]. Lists of tetrahedra stay valid, but name half of what they named.
///   errors  MethodError where the mesh is not a bisection of Kuhn cubes
void bisect(Mesh& M, const std::vector<int>& E);

/// Neighbour across the face opposite to each vertex, -1 on the boundary. [tets]
std::vector<std::array<int, 4>> faceNeighbours(const Mesh& M);

/// γ(s) of eq. (11): the point of a curve at arc length s (periodic where closed, else clamped).
Vec3 gamma(const Curve& C, double s);

/// Where u lies in ϕ's triangulation of 𝓤.
struct Location { int triangle; double w[3]; };  // triangle -1: outside; w >= 0, sum 1
void buildLocator(Parametrization& P);
Location locate(const Parametrization& P, Vec2 u);
/// [§3.6, eq. (3)] ϕ(u): affine on each triangle of 𝓤; errors: MethodError where u is outside.
Vec3 varphi(const Parametrization& P, Vec2 u);
Vec3 varphi(const Parametrization& P, const Location& at);

/// The surface or patch with a label as in Mesh::faceLabel.
const Parametrization& surfaceOf(const Mesh& M, int label);
/// Faces labelled k (S_M of inserted surface k, or boundary patch -k), each once. [faces], node indices
std::vector<std::array<int, 3>> surfaceFaces(const Mesh& M, int k);

// ==== 3.7 Mesh optimization (optimize.cpp) ======================================================
// J = Jφ: ideal (computational) element → physical element, both with the vertices in the same order.

/// [§3.7.1, eq. (5)] η = ‖J‖² / (3 |σ|^⅔): 1 for similarities, ∞ (σ = 0) for a degenerate element.
double eta(const Mat3& J);
/// [§3.7.1, eq. (6)] J of the affine map from the ideal tetrahedron to the physical one.
Mat3 jacobian(const std::array<Vec3, 4>& ideal, const std::array<Vec3, 4>& physical);
/// [§3.7.1, eq. (7)] q = 1/η. [choice] 0 where σ <= 0.
double quality(const Mat3& J);
/// [§3.7.1, eq. (8)] h(σ) = ½(σ + √(σ² + 4δ²)): the determinant made positive.
///   sigma   det Jφ, any sign;  delta >= 0, unit of sigma, see chooseDelta()
///   returns h > 0, tending to max(σ, 0) as δ → 0
///   [departure] for σ < 0 computed as 2δ²/(√(σ²+4δ²) − σ): as printed, σ = −1, δ = 1e-9 gives 0
double h(double sigma, double delta);
/// η with h(σ) for |σ|; finite for δ > 0, ∞ for δ = 0 and σ <= 0.
double etaRegularized(const Mat3& J, double delta);
/// [§3.7.1, δ after 23, 30] δ with h(σ_min) = mu: δ² = mu (mu − σ_min); 0 where σ_min > 0 and no regularization is needed.
double chooseDelta(double sigmaMin, double mu);

/// An objective with its derivatives at one point.
struct Objective { double f; Vec3 gradient; Mat3 hessian; };

/// The star of a node: what eq. (9) needs of the elements adjacent to it, in closed form.
struct StarElement {
  Mat3 J0;    // J with the node at `origin`
  Vec3 g;     // gradient, in the ideal element, of the node's barycentric function: J(x) = J0 + (x − origin) gᵀ
};
struct Star {
  Vec3 origin;                        // the node's position when the star was built
  std::vector<StarElement> elements;  // the m adjacent tetrahedra
};
/// The star of node n; `around` are the tetrahedra adjacent to it.
Star starOf(const Mesh& M, int n, const std::vector<int>& around);

/// [§3.7.2, eq. (9)] f(x) = Σ_j η_j^power over the star, with analytic gradient and Hessian.
double f(const Star& star, Vec3 x, double delta, double power = 1);
Objective fDerivatives(const Star& star, Vec3 x, double delta, double power = 1);
/// [§3.7.3, eq. (10)] f_ϕ(u) = f ∘ ϕ(u); ∞ where u is outside 𝓤.
double fVarphi(const Star& star, const Parametrization& P, Vec2 u, double delta, double power = 1);
/// [§3.7.3, eq. (11)] f_γ(s) = f ∘ γ(s).
double fGamma(const Star& star, const Curve& C, double s, double delta, double power = 1);

/// [§3.7.4, strong Wolfe conditions, 33] A step length t with F(t) <= F(0) + c1 t F'(0) and |F'(t)| <= c2 |F'(0)|.
struct LinePoint { double F, slope; };
struct WolfeStep { double t; bool armijo, curvature; int evaluations; };  // t = 0 where no step was found
/// Bracketing and zoom with safeguarded cubic steps, at most 20; F may be ∞.
WolfeStep strongWolfe(const std::function<LinePoint(double t)>& F, double tFirst, double tMax);

/// [§3.7.4, Algorithm 2] Untangles and smooths M node by node; boundary, surface and curve nodes slide on
/// their entities, corners stay. Works on any tetrahedral mesh: without M.xi the ideal elements are regular,
/// without M.dimension the boundary is fixed. Indices and entities keep; M.x and M.parameter change.
///   errors  InputError: options out of range, a malformed mesh.
///           No exception for an unfinished optimization: see the report.
OptimizeReport optimizeMesh(Mesh& M, const OptimizeOptions& options = {});

/// [§4, Table I] Statistics of q against the computational elements, or against the regular tetrahedron
/// (where M has no computational coordinates, always).
enum class Ideal { computational, regular };
QualityStatistics qualityStatistics(const Mesh& M, Ideal ideal = Ideal::computational);
/// q of each tetrahedron. [tets]
std::vector<double> qualities(const Mesh& M, Ideal ideal = Ideal::computational);

//@insert

// ==== 3. Surface insertion ======================================================================

/// [§3] Inserts S into M: 3.2 approximation, 3.3 healing, 3.4 extraction, 3.5 surface healing,
/// 3.6 projection, 3.7 optimization. Afterwards 0 elements are inverted and every node of S_M lies on S.
///   errors  InputError: S, M or the options break §3.1; MethodError: a step cannot reach what it promises;
///           SolverError: a linear solve failed. M is unchanged when it throws.
InsertReport insertSurface(Mesh& M, const TriangleSurface& S, const InsertOptions& options);

}  // namespace meccano
#endif
