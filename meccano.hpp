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
// Limits: at most 5e8 tetrahedra; surfaces are disks with a rim, and touch neither
// each other nor the boundary. The library never prints, opens a file, reads the clock, draws
// random numbers or keeps global state: the same input gives the same bytes.
//
// Tags:   [§…, eq. (…)] what the code implements · [choice] the paper is silent · [departure] we
// differ
#ifndef MECCANO_HPP
#define MECCANO_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace meccano {

inline constexpr const char* version = "0.1.0";

// ==== Errors ====================================================================================
// The message says what, where and what to do. One catch of Error gets all.

struct Error : std::runtime_error {
  using std::runtime_error::runtime_error;
};
struct InputError : Error {
  using Error::Error;
};  // the data break §3.1, or a file is malformed
struct MethodError : Error {
  using Error::Error;
};  // a step cannot reach what it promises
struct SolverError : Error {
  using Error::Error;
};  // a linear solve did not converge

// ==== Algebra ===================================================================================

struct Vec2 {
  double x = 0, y = 0;
};
struct Vec3 {
  double x = 0, y = 0, z = 0;
};
struct Mat3 {
  Vec3 c0, c1, c2;
};  // by columns

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
inline bool isFinite(Vec3 a) {
  return std::isfinite(a.x) && std::isfinite(a.y) && std::isfinite(a.z);
}

inline Vec3 operator*(const Mat3& A, Vec3 v) { return v.x * A.c0 + v.y * A.c1 + v.z * A.c2; }
inline Mat3 operator*(const Mat3& A, const Mat3& B) { return {A * B.c0, A * B.c1, A * B.c2}; }
inline Mat3 operator*(double t, const Mat3& A) { return {t * A.c0, t * A.c1, t * A.c2}; }
inline Mat3 operator+(const Mat3& A, const Mat3& B) {
  return {A.c0 + B.c0, A.c1 + B.c1, A.c2 + B.c2};
}
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

// ==== Tools: threads ============================================================================

/// Threads that share the pieces of one loop after the other. They wait in between, for to start a
/// thread takes longer than most pieces do.
class Crew {
 public:
  /// Of so many threads, the caller's among them (at most 16, or the cores where these are more);
  /// 0: of all cores. They start with the first loop that has a piece for them.
  explicit Crew(int threads = 1);
  Crew& operator=(Crew&&) noexcept;
  ~Crew();

  /// task(k, from, to) for the pieces k of [begin, end), `size` long, which the threads take in
  /// turn: whatever the tasks do may not depend on who does it and when. One loop at a time, and
  /// none in a task.
  ///   errors  what a task throws ends the loop; of several the lowest piece's is thrown again
  using Task = std::function<void(int k, int from, int to)>;
  void forPieces(int begin, int end, int size, const Task& task) const;

 private:
  struct Threads;
  std::unique_ptr<Threads> threads_;
};

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
  int rim = 0;  // number of its rim among Mesh::curves; 0: a boundary patch
  // Grid for the point location over 𝓤, derived data made by buildLocator(). Where the map crowds
  // triangles into a cell, that cell has a tree of boxes, each of them halved in two.
  int gridSize = 0;  // cells along each axis; 0: not made
  // Triangles of cell c: gridTriangles[gridStart[c] .. gridStart[c+1]).
  std::vector<int> gridStart, gridTriangles;
  struct Box {
    Vec2 low, high;
    int first, last, right;  // a run of gridTriangles; its halves are the next box and `right`, 0:
                             // not halved
  };
  std::vector<Box> boxes;
  std::vector<int> boxOf;  // [cells], the box of its tree's root, -1: none
};

/// [§3.7.3] A curve γ(s) by arc length: the rim of an inserted surface, or an edge of the boundary.
struct Curve {
  std::vector<Vec3> points;  // [points], along the curve
  std::vector<double> s;     // [points], arc length; a closed curve has one more entry, its length
  bool closed = false;       // true: points.back() is joined to points.front(), s is periodic
  struct Side {
    int surface;
    std::vector<Vec2> u;
  };
  // each surface (label as in Mesh::faceLabel) the curve bounds, with u at the points
  std::vector<Side> sides;
};

/// A fixed point of the geometry: a corner of the domain, or a sharp corner of a rim.
struct Corner {
  Vec3 x;
  struct Place {
    int curve;
    double s;
  };
  std::vector<Place> on;  // the curves through it (numbers as in Mesh::entity)
};

/// The tetrahedral mesh 𝓜 with its computational counterpart and its geometry.
/// Numbers of surfaces, patches, curves and corners start at 1, as in the file. A mesh that is only
/// to be optimized needs x and tets; it then counts as one without geometry (boundary fixed).
struct Mesh {
  std::vector<Vec3> x;   // physical nodes, [nodes], length unit of the input
  std::vector<Vec3> xi;  // computational nodes, [nodes], cubes of edge 1; empty: none
  std::vector<std::array<int, 4>> tets;  // [tets], bisection order: z0 z1 is the refinement edge
  std::vector<unsigned char> type;       // [tets], 0 1 2 of Kossaczký's method
  std::vector<unsigned char> level;      // [tets], bisections since the cube; level mod 3 = type
  // [tets], label of the face opposite to each vertex: 0 none, k > 0 inserted surface k, -p
  // boundary patch p
  std::vector<std::array<int, 4>> faceLabel;
  // [nodes], 3 inside, 2 on a surface, 1 on a curve, 0 a corner
  std::vector<unsigned char> dimension;
  std::vector<int> entity;      // [nodes], 0; label k or -p; number of the curve; of the corner
  std::vector<Vec2> parameter;  // [nodes], (0,0); u; (s,0); (0,0)
  std::vector<Parametrization> surfaces;  // inserted surface k is surfaces[k-1]
  std::vector<Parametrization> patches;   // boundary patch p is patches[p-1]
  std::vector<Curve> curves;              // curve c is curves[c-1]
  std::vector<Corner> corners;            // corner c is corners[c-1]
  Vec3 cube{1, 1, 1};                     // physical edge lengths of an undeformed cube of level 0
};

/// Table I: the number of inverted elements and the statistics of q over all.
/// [choice] q = 0 where σ ≤ 0, and these elements are the inverted ones: eq. (5) takes |σ|.
struct QualityStatistics {
  int tetrahedra = 0, inverted = 0;
  double min = 0, max = 0, mean = 0, stdDev = 0;
  std::array<int, 20> histogram{};  // elements with q in [i/20, (i+1)/20), q = 1 in the last
};

// ==== Options and reports =======================================================================

/// One sweep of Algorithm 2, for a progress display: of the elements that may change.
struct Sweep {
  int number, inverted;  // a valid mesh may pass inverted ones, to cure flat elements
  double minQ, disp;
};

struct OptimizeOptions {
  double maxDisp = 1e-2;  // Algorithm 2's maxDisp, relative to the node's shortest edge; > 0
  int maxSweeps = 300;    // bound of Algorithm 2's loop; >= 1
  // [§3.7.4 departure] Once valid and settled, the worst elements are lifted by Σ η +
  // (η/η_w)^power.
  double power = 64;                  // [1, 64], 1: none
  bool numericalDerivatives = false;  // §3.7.3: derivatives in u and s by differences, as printed
  // most meshes are valid after 20; then [departure] the global descent, if wanted
  int maxTangledSweeps = 60;
  // [departure] all nodes at once, for states that no single node can leave; in an insertion only
  // those around a few inverted elements
  bool globalDescent = true;
  double mu = 8e-3;  // h(σ_min) that δ gives, relative to the mean σ; (0, 1)
  // [§3.7.4 departure] first trial step, in Newton steps; [1, 2), 1: as printed
  double relaxation = 1.6;
  // §3.7.4: both Wolfe conditions at inner nodes, as printed; [departure] false: the first alone
  bool strongWolfe = false;
  // Threads that share the loops, those of an insertion outside §3.7 too; 0: all cores. The result
  // is the same for every number. 1 here, for a host has threads of its own; the program takes all.
  int threads = 1;
  // [§3.7.4 departure] sweeps that Anderson's acceleration mixes; [0, 8], 0: none, and every move
  // wakes the neighbours while the mesh is tangled
  int acceleration = 4;
  std::vector<int> fixed = {};  // nodes that stay where they are, besides the corners
  // nodes visited in the first sweep: only these and nodes up to four edges away move; empty: all
  std::vector<int> active = {};
  // [§2 choice] δ from each star's own σ, for meshes whose σ spans orders of magnitude
  bool starDelta = false;
  // Asked before a sliding node n moves to x at this parameter; false: it stays. Of M it may read
  // what shares an element with n: other threads ask for other nodes at the same time.
  std::function<bool(int n, Vec3 x, Vec2 parameter)> accept = nullptr;
  std::function<void(const Sweep&)> onSweep = nullptr;  // called after each sweep

  // Algorithm 2 to the letter: Σ η alone, numerical derivatives, node by node only
  static OptimizeOptions paper();
};

struct OptimizeReport {
  int sweeps = 0;           // of all phases; a sweep visits the nodes whose stars have moved
  std::int64_t visits = 0;  // of nodes, in all sweeps
  double disp = 0;          // of Algorithm 2's last sweep (before the worst elements), as maxDisp
  // valid and disp <= maxDisp (where the worst elements are lifted next: its root mean square <=
  // 2.5 maxDisp) before maxSweeps
  bool converged = false;
  int inverted = 0;  // elements with σ <= 0 left
  double minQ = 0, meanQ = 0;
  QualityStatistics quality = {};  // of the mesh as it is left
};

/// [§3.5] How the outline of S_M is healed: by cases 1 and 2, or [departure] by rim regularization
/// with whole squares, or with half squares too.
enum class Outline { paper, squares, halfSquares };

/// [§3.2] How l_c was chosen: see chooseSize().
struct SizeChoice {
  double lc = 0;             // l_c, length unit of the input
  std::string feature = {};  // what limits it: "the extent of S", "the width of S between its rims"
                             // ...
  double measure = 0;        // its length
  Vec3 place;                // a point of S where it is that small
  double resolving = 0;      // the l_c that resolves the feature; below lc where that is too fine
  double finest = 0;         // the least l_c that is chosen for features of S itself
};

struct InsertOptions {
  double lc = 0;  // [eq. (1)] l_c, length unit of the input; below dist(∂M, S). 0: chooseSize()
  // [§3.2] > 0, and lc = 0: the coarsest l_c at which the measured two-sided Hausdorff distance of
  // S_M and S is at most this
  double tolerance = 0;
  Outline outline = Outline::halfSquares;  // [§3.5 departure]
  bool followRim = true;     // [§3.6 departure] rim correspondence and anchored equations
  int maxTets = 20000000;    // refuse where more tetrahedra are predicted
  OptimizeOptions optimize;  // §3.7; its active is set by the insertion
  // Called after each stage with the mesh as it is then: "approximated" (3.2) and "healed"
  // (3.3) for each course of S_M, through the middle or along a side of 𝓣, and in it for each way
  // that is tried "extracted" (3.4), "surfaceHealed" (3.5), "projected" (3.6); and at the end
  // "smoothed" (3.7).
  std::function<void(const char* stage, const Mesh&)> onStage = nullptr;
  std::function<void(const std::string& line)> onProgress = nullptr;  // a line per step
  // A callback may throw to stop, but no MethodError or SolverError: M is then unchanged.

  static InsertOptions paper();  // the paper to the letter, but for the full subcomplex of §3.5
};

struct InsertReport {
  int surface = 0;               // its number k: M.surfaces[k-1], faces labelled k
  double lc = 0;                 // as used
  SizeChoice size;               // how it was chosen, where options.lc = 0 and no tolerance
  int way = 0;                   // which of the tried ways (sides, outlines) was taken, from 1
  int nodes = 0, triangles = 0;  // of S_M
  double maxNodeDistance = 0;    // largest |x_i - S| of the nodes of S_M
  double hausdorff = 0;          // two-sided, S_M - S, sampled
  Vec3 hausdorffPlace;           // where it is
  // largest distance of a projected node from the point of S nearest to it before
  double tangentialShift = 0;
  // against the computational elements; refined: after 3.5
  QualityStatistics original, refined, projected, smoothed;
  QualityStatistics regular;  // smoothed, against the regular tetrahedron
  OptimizeReport optimization;
  std::vector<std::string> warnings;  // valid but poor: what and where
};

// ==== 2. Meccano: boxes and Kossaczký bisection [17] ============================================

/// [§2, §3.1] A box of near-cubic cells, each cell six Kuhn tetrahedra of type 0; its meccano is
/// the lattice of unit cubes. Six patches (x-, x+, y-, y+, z-, z+ are 1 .. 6), twelve curves, eight
/// corners.
///   origin, size  length unit of the input, size > 0
///   cells         >= 1 each
///   errors        InputError
Mesh boxMesh(Vec3 origin, Vec3 size, std::array<int, 3> cells);

/// [§2] The boundary of a solid Ω as Algorithm 1 needs it: closed, one component, outward. Welds
/// exactly coincident points, drops duplicate and zero-area triangles and unused points, turns
/// triangles that disagree.
///   D         any triangle soup; triangles and points are counted from 0 in the messages
///   warnings  gets one line per kind of repair, and one where the surface crosses itself
///   errors    InputError: nothing left; an index out of range; a coordinate not finite; open; a
///             non-manifold edge or vertex; not orientable; several components; no volume
TriangleSurface checkSolid(const TriangleSurface& D, std::vector<std::string>& warnings);
/// Handles of a closed surface with one component.
int genusOf(const TriangleSurface& D);

/// [§2, Algorithm 1 line 2] The meccano: a union of unit cubes of the lattice (a polycube), and
/// where its corners go.
struct Meccano {
  std::vector<std::array<int, 3>> cubes;  // lower corners, lattice
  struct Placed {
    std::array<int, 3> at;  // a corner of the polycube, lattice
    Vec3 x;                 // near its place on the solid, length unit of the input
  };
  std::vector<Placed> corners;  // all corners of the polycube; empty: found by getBoundaryMapping
  Vec3 cube{1, 1, 1};           // physical edge lengths of a cube, for sizes
};

/// [Algorithm 1, line 2] A box of cubes in the integer ratios of the solid's principal lengths.
///   D       has passed checkSolid()
///   errors  InputError: genus above zero, which needs the user's polycube and corners
Meccano getMeccano(const TriangleSurface& D);

/// [Algorithm 1, line 3] Π on the boundary: patches, curves and corners as in Mesh, and where each
/// lies on the meccano's boundary. [choice] A patch is a maximal flat part of it, so that nodes
/// slide freely where the meccano is flat; triangles are counter-clockwise in 𝓤.
struct BoundaryMapping {
  std::vector<Parametrization> patches;  // patch p is patches[p-1]; with locators
  std::vector<Curve> curves;             // curve c is curves[c-1]: a straight edge of the meccano
  std::vector<Corner> corners;           // corner c is corners[c-1]
  /// 𝓤 is the bounding rectangle of the patch: u runs along axis + 1, v along axis + 2 (modulo 3).
  struct Rectangle {
    std::array<int, 3> lo, hi;  // lattice, lo[axis] = hi[axis]
    int axis, side;             // outward normal -e_axis (side 0) or +e_axis (side 1)
  };
  struct Segment {
    std::array<int, 3> from, to;  // lattice, ascending
  };
  std::vector<Rectangle> rectangles;          // [patches]
  std::vector<Segment> segments;              // [curves], from s = 0
  std::vector<std::array<int, 3>> cornersAt;  // [corners], lattice
  std::vector<std::string> notes;             // what was chosen, for a progress display
};
/// Π on the boundary: a box without placed corners is cut into its sides automatically, a polycube
/// with placed corners along shortest paths between them.
///   C, D    D has passed checkSolid()
///   errors  InputError: the polycube's boundary is no connected manifold, or its genus is not the
///           solid's; corners missing, too far from the solid or twice at one vertex;
///           MethodError: paths or patches cannot be found; SolverError
BoundaryMapping getBoundaryMapping(const Meccano& C, const TriangleSurface& D);

/// Π at a point of the meccano's boundary, as the arrays of Mesh hold it.
struct BoundaryPoint {
  int dimension, entity;  // 2 and -p on a patch, 1 and c on a curve, 0 and c at a corner
  Vec2 parameter;
  Vec3 x;
};
/// Π(ξ). errors: MethodError where xi is not on the meccano's boundary
BoundaryPoint boundaryPoint(const BoundaryMapping& Pi, Vec3 xi);

/// [Algorithm 1, line 4] The six Kuhn tetrahedra of each cube, boundary nodes at Π, inner ones
/// placed by placeInterior(). The lattice is moved so that its lowest coordinates are 0.
Mesh getInitialMesh(const Meccano& C, const BoundaryMapping& Pi);
/// [§2 choice] Moves the inner nodes to the harmonic image of the computational mesh: linear finite
/// elements in xi, conjugate gradients. For any mesh with computational coordinates; no element is
/// promised to be valid.
///   errors  SolverError
void placeInterior(Mesh& M);

/// [§3.2, after 17] Bisects each tetrahedron of E once, after its neighbours where conformity asks
/// for it. Child 0 keeps the parent's index, child 1 is appended; new nodes are midpoints, on
/// surfaces and curves the parametric ones [choice]. Lists of tetrahedra stay valid, but name half
/// of what they named.
///   errors  MethodError where the mesh is not a bisection of Kuhn cubes
void bisect(Mesh& M, const std::vector<int>& E);

/// A mesh while it is refined: M with the adjacency that bisection needs, kept up by it.
struct Bisection {
  Mesh& M;
  std::vector<std::array<int, 4>> neighbour;  // [tets], as faceNeighbours
  std::vector<int> tetOf;                     // [nodes], a tetrahedron at the node
  struct Split {
    int parent, child, midpoint;  // the parent is now child 0; child 1; the new node
  };
  std::vector<Split> splits;  // log

  explicit Bisection(Mesh& M);
  Bisection(Mesh& M, std::vector<std::array<int, 4>> neighbour);  // where it is known
  /// Kossaczký's method: first neighbours with another refinement edge, then the whole ring at
  /// once.
  void bisect(int E, int depth = 0);
  /// Bisects tetrahedra at the edge (a, b) until it is split; nothing where there is no such edge.
  void bisectEdge(int a, int b);
  /// The tetrahedra around the edge (a, b) of E, E first; those at node n; the first of these below
  /// a level, or -1 (only then around is whole); one with the edge, or -1.
  void ring(int E, int a, int b, std::vector<int>& around) const;
  void star(int n, std::vector<int>& around) const;
  int coarserAt(int n, int level, std::vector<int>& around) const;
  int tetWithEdge(int a, int b) const;

  /// Dimension and number (as in Mesh::entity) of what the edge (a, b) lies on.
  struct EdgeEntity {
    int dimension, entity;
  };
  EdgeEntity entityOf(int a, int b, const std::vector<int>& around) const;

 private:
  mutable std::vector<int> walkedBy;  // [tets] the last walk that came by
  mutable int walk = 0;

  /// The star of n, face by face, up to the first tetrahedron that is wanted: returns it, or -1.
  template <class Wanted>
  int walkStar(int n, std::vector<int>& around, const Wanted& wanted) const;
  int addMidpoint(int a, int b, const std::vector<int>& around);
  void bisectRing(const std::vector<int>& around);
};

/// Neighbour across the face opposite to each vertex, -1 on the boundary. [tets]
std::vector<std::array<int, 4>> faceNeighbours(const Mesh& M);

/// γ(s) of eq. (11): the point of a curve at arc length s (periodic where closed, else clamped).
Vec3 gamma(const Curve& C, double s);

/// Where u lies in ϕ's triangulation of 𝓤.
struct Location {
  int triangle;
  double w[3];
};  // triangle -1: outside; w >= 0, sum 1
void buildLocator(Parametrization& P);
Location locate(const Parametrization& P, Vec2 u);
/// [§3.6, eq. (3)] ϕ(u): affine on each triangle of 𝓤; errors: MethodError where u is outside.
Vec3 varphi(const Parametrization& P, Vec2 u);
Vec3 varphi(const Parametrization& P, const Location& at);

/// u of node n on the surface with this label: its own, or that of its curve or corner there.
/// False: not on it.
bool parameterOn(const Mesh& M, int n, int label, Vec2& u);

/// Refuses surfaces, patches and curves whose arrays do not fit together, before they are followed.
///   who     the caller's name, for the message
///   errors  InputError: which one, and what it lacks
void checkGeometry(const Mesh& M, const std::string& who);

/// The surface or patch with a label as in Mesh::faceLabel.
const Parametrization& surfaceOf(const Mesh& M, int label);
/// Faces labelled k, not 0 (S_M of inserted surface k, or boundary patch -k), each once. [faces],
/// node indices
std::vector<std::array<int, 3>> surfaceFaces(const Mesh& M, int k);

// ==== 2. Algorithm 1: the meccano mesher ========================================================

/// A terrain: heights on a regular grid, bilinear between its points, under a flat top.
struct Terrain {
  int nx = 0, ny = 0;                 // grid points along x and along y, >= 2
  Vec2 origin;                        // of the point (0, 0), the south-west one
  double cell = 0;                    // distance of neighbouring grid points, length unit of z; > 0
  std::vector<double> z;              // [nx * ny], height of point (i, j) in z[j * nx + i]
  double top = 0;                     // height of the flat top, above all z
  std::array<int, 3> cells{0, 0, 0};  // cubes of the meccano along each axis; 0: near-cubic ones
  std::string name = {};
};
/// The bilinear height over (x, y), clamped to the grid.
double heightAt(const Terrain& T, double x, double y);
/// Its cells, or near-cubic ones: about eight along the longer side.
std::array<int, 3> terrainCells(const Terrain& T);
/// ε that fits: 1/500 of the diagonal of its box.
double terrainEps(const Terrain& T);

struct MesherOptions {
  double eps = 0;              // [Algorithm 1] ε, length unit of the input; > 0
  Meccano meccano = {};        // D; without cubes: getMeccano's
  bool fixedBoundary = false;  // boundary nodes stay where Π put them
  int maxTets = 20000000;      // refuse where more tetrahedra are predicted
  OptimizeOptions optimize;    // §3.7; its fixed, active, accept and starDelta are the mesher's
  // Called after each stage with the mesh as it is then: "initial" (line 4), "refined" (line 9),
  // "untangled", "smoothed" (line 10).
  std::function<void(const char* stage, const Mesh&)> onStage = nullptr;
  std::function<void(const std::string& line)> onProgress = nullptr;  // a line per step
};

/// distance(∂M, ∂Ω) of Algorithm 1, both ways.
struct BoundaryDistance {
  double toSolid = 0, toMesh = 0;  // largest distance of ∂M from ∂Ω, of ∂Ω from ∂M
  std::vector<std::array<double, 4>> ofFace;  // [tets], of each face on the boundary; 0 elsewhere
  double largest() const { return std::max(toSolid, toMesh); }
};

struct MesherReport {
  double eps = 0;             // as used
  BoundaryDistance distance;  // of the final mesh, at most eps
  int depth = 0;              // bisections since the cube, the most of all tetrahedra
  int passes = 0;             // of lines 5 to 9, before the optimization
  int rounds = 0;             // of qualityOptimization in which the boundary slid
  QualityStatistics refined, untangled, smoothed;  // against the computational elements
  QualityStatistics regular;                       // smoothed, against the regular tetrahedron
  std::vector<std::string> warnings;
};

/// A triangle of ∂M: the face of tetrahedron E opposite to its vertex i.
struct BoundaryTriangle {
  int E, i;
};
using TriangleList = std::vector<BoundaryTriangle>;

/// [§2, Algorithm 1] distance(∂M, ∂Ω), ∂Ω being the patches of M. [choice] Two-sided: Π at sample
/// points of each face against the face, and each point of a patch against the face that holds its
/// parameter. Planar patches are met exactly and are not measured.
///   enough  a distance in the parameters below it is taken for the distance (an upper bound)
BoundaryDistance distance(const Mesh& M, double enough = 0);
/// [§2, Algorithm 1, line 6] The triangles of ∂M farther than eps.
TriangleList getTrianglesToRefine(const Mesh& M, const BoundaryDistance& d, double eps);
/// [§2, Algorithm 1, line 7] Bisects the tetrahedron behind each; returns the triangles of ∂M that
/// are new.
TriangleList refineTriangles(Bisection& B, const TriangleList& tau);
/// [§2, Algorithm 1, line 8] Puts their nodes at Π of their parameters.
void projectNewNodesToBoundary(Mesh& M, const TriangleList& tauNew);
/// [§2, Algorithm 1, line 10] Untangles with a fixed boundary, then lets the boundary slide within
/// eps and refines where it is exceeded, until both hold.
///   errors  MethodError where elements stay inverted
void qualityOptimization(Mesh& M, const MesherOptions& options, MesherReport& report);

/// [§2, Algorithm 1] MeccanoMesher: the solid inside the closed surface Omega, within eps.
///   errors  InputError: the solid, the meccano or the options; MethodError, SolverError. M is
///           unchanged when it throws.
MesherReport meccanoMesher(Mesh& M, const TriangleSurface& Omega, const MesherOptions& options);
/// [§2, Algorithm 1] The box below `top`, its bottom within eps of the bilinear terrain, its sides
/// in their planes.
///   errors  InputError: the terrain or the options; MethodError. M is unchanged when it throws.
MesherReport meccanoMesher(Mesh& M, const Terrain& Omega, const MesherOptions& options);
/// [§2, Algorithm 1] Lines 5 to 10 from an initial mesh, with Π as its patches.
MesherReport meccanoMesher(Mesh& M, const MesherOptions& options);

// ==== 3.1 Problem statement =====================================================================

/// [§3.1] S as the method needs it: a disk, with one orientation and one rim. Welds exactly
/// coincident points, drops duplicate and zero-area triangles and unused points, turns triangles
/// that disagree.
///   S         any triangle soup; triangles and points are counted from 0 in the messages
///   warnings  gets one line per kind of repair
///   errors    InputError: nothing left; an index out of range; a coordinate not finite; a
///             non-manifold edge or vertex; not orientable; several components; closed; holes; a
///             handle (χ ≠ 1)
TriangleSurface checkSurface(const TriangleSurface& S, std::vector<std::string>& warnings);

/// [§3.1 choice] The parts of S that share no point, each a surface of its own named "name.1",
/// "name.2", ...; S itself where it is one. A warning tells of the parts.
///   errors    InputError: an index out of range; a coordinate not finite
std::vector<TriangleSurface> connectedComponents(const TriangleSurface& S,
                                                 std::vector<std::string>& warnings);

/// [§3.1] The first part of checkSurface() alone: exactly coincident points welded, duplicate and
/// zero-area triangles and unused points dropped.
///   warnings  gets one line, with the numbers
///   errors    InputError: an index out of range; a coordinate not finite
TriangleSurface weldSurface(const TriangleSurface& S, std::vector<std::string>& warnings);

/// Neighbour across edge i (from vertex i to i + 1) of each triangle, -1 on the rim. [triangles]
///   number  [triangles], what messages call them; empty: their index
///   errors  InputError where three triangles share an edge
std::vector<std::array<int, 3>> triangleNeighbours(const TriangleSurface& S,
                                                   const std::vector<int>& number = {});
/// The rims of a consistently oriented surface, each a closed loop of points with S on its left.
std::vector<std::vector<int>> rimLoops(const TriangleSurface& S);

// ==== Tools for 3.2 and 3.4: distance to S ======================================================

/// The point of a triangle nearest to a given one, and the feature it lies in the interior of.
enum class Feature { face, edge, vertex };
struct ClosestPoint {
  double distance;
  Vec3 point;
  int triangle;  // -1: there is none
  double w[3];   // barycentric coordinates of point, >= 0, sum 1
  Feature feature;
  int which;  // edge from vertex `which` to the next, or vertex; 0 for a face
};
/// Nearest point of the triangle abc. Exact to rounding for needles too: the foot inside the
/// triangle competes with the nearest points of the edges. A segment is a triangle with c = b.
ClosestPoint closestPointOnTriangle(Vec3 x, Vec3 a, Vec3 b, Vec3 c);

/// A triangle of a tree, with what the test of nearness takes.
struct TreeTriangle {
  std::array<Vec3, 3> corners;
  int number;                 // of the input
  std::array<int, 3> points;  // numbers of the corners

  TreeTriangle(int number, const std::array<int, 3>& points, const std::array<Vec3, 3>& corners);
  /// Whether x is not farther than this; without roots, and mostly without division. Of a needle,
  /// whose normal has few correct digits, by its nearest point.
  bool isWithin(Vec3 x, double distance) const;

 private:
  Vec3 n_, inward0_, inward2_;  // normal, and those of edges 0 and 2 in the plane
  double n2_;
  std::array<double, 3> length2_;  // of the edges, squared
  bool isNeedle_;
};

/// Bounding boxes in a binary tree over triangles. Owns copies; building it is O(N log N).
struct TriangleTree {
  struct Box {
    Vec3 lo, hi;
  };
  /// A leaf holds triangles first .. first + count; else count = 0, its children self + 1, right.
  struct Node {
    Box box;
    int first, count, right;
  };
  std::vector<Node> nodes;              // depth first
  std::vector<TreeTriangle> triangles;  // in tree order

  TriangleTree() = default;
  TriangleTree(const std::vector<Vec3>& points, const std::vector<std::array<int, 3>>& triangles);

  /// The nearest point of all triangles; of equally near triangles the one with the lowest number.
  /// Looks no farther than `within`: the triangle is -1 where nothing is as near.
  ClosestPoint closest(Vec3 x, double within = 1e300) const;
  /// Calls found(t) for each triangle whose box meets the closed box [lo, hi], until that is true.
  template <class Found>
  void visit(Vec3 lo, Vec3 hi, Found found) const;
};

inline bool boxesMeet(const TriangleTree::Box& a, Vec3 lo, Vec3 hi) {
  return a.lo.x <= hi.x && lo.x <= a.hi.x && a.lo.y <= hi.y && lo.y <= a.hi.y && a.lo.z <= hi.z &&
         lo.z <= a.hi.z;
}

TriangleTree::Box boxOf(const std::array<Vec3, 3>& corners);

template <class Found>
void TriangleTree::visit(Vec3 lo, Vec3 hi, Found found) const {
  int stack[64], height = 0;  // each level halves the triangles: 32 levels at most
  if (!nodes.empty()) stack[height++] = 0;
  while (height > 0) {
    const int n = stack[--height];
    const Node& node = nodes[n];
    if (!boxesMeet(node.box, lo, hi)) continue;
    if (node.count == 0) {
      stack[height++] = node.right;
      stack[height++] = n + 1;
    }
    for (int i = node.first; i < node.first + node.count; ++i) {
      if (boxesMeet(boxOf(triangles[i].corners), lo, hi) && found(triangles[i].number)) return;
    }
  }
}

/// What S says about a point x of space: its nearest point, and which side of S that is.
struct SurfaceQuery : ClosestPoint {
  Vec3 normal;    // unit angle-weighted pseudo-normal of the nearest face, edge or vertex
  double side;    // (x - point) · normal: its sign is the side of S [§3.4]; beyond the rim this
                  // extends S tangentially
  bool onRim;     // the nearest feature is an edge or vertex of the rim
  double excess;  // tangential distance beyond the rim, 0 where not onRim
};

/// [§3.4] A surface that has passed checkSurface(), ready for distances and sides.
struct SurfaceDistance {
  TriangleSurface S;
  TriangleTree tree;
  std::vector<int> rim;                         // the rim's points, S on its left
  TriangleTree rimTree;                         // triangle i is the segment from rim[i] to the next
  std::vector<Vec3> faceNormal;                 // [triangles]
  std::vector<std::array<Vec3, 3>> edgeNormal;  // [triangles]
  std::vector<Vec3> vertexNormal;               // [points]
  std::vector<std::array<int, 3>> neighbours;   // [triangles]
  std::vector<char> isRimPoint;                 // [points]

  explicit SurfaceDistance(const TriangleSurface& cleaned);
  SurfaceQuery query(Vec3 x) const;
  double rimDistance(Vec3 x) const;  // distance to the rim polyline
};

/// Smallest distance of two triangle sets (dist(∂M, S) of eq. (1)) and where; 0 where they cross.
struct Gap {
  double distance;
  int triangle, other;  // of the tree; of `triangles`
  Vec3 point;           // on the tree's
};
Gap smallestGap(const TriangleTree& tree, const std::vector<Vec3>& points,
                const std::vector<std::array<int, 3>>& triangles);

/// [§3.1] Pairs of triangles that cross or touch beyond their common points, and where. A pair with
/// a common edge is none.
struct Crossing {
  int triangle, other;
  Vec3 point;
};
std::vector<Crossing> selfCrossings(const TriangleSurface& S);
std::vector<Crossing> selfCrossings(const TriangleSurface& S, const TriangleTree& tree,
                                    const Crew& crew = Crew());

/// [§3.2] The distance of sheets of S that face each other: the 5 % quantile over S of the distance
/// along the normals; 1e300 where none is within `reach`.
struct Width {
  double distance;
  Vec3 place;
};
Width facingSheets(const SurfaceDistance& S, double reach);
/// [§3.2] The width of S, or of a notch, between parts of its rim: the 5 % quantile over the rim of
/// the distance to points at least three times as far along the rim, and at least `apart`.
Width rimWidth(const SurfaceDistance& S, double apart);

/// Two-sided Hausdorff distance and its place, sampled: each triangle at a lattice of
/// samplesPerEdge >= 1 steps, more where these would be longer than `spacing`.
Width farthestPoint(const TriangleTree& A, const TriangleTree& B, int samplesPerEdge,
                    double spacing = 1e300, const Crew& crew = Crew());
double hausdorffDistance(const TriangleTree& A, const TriangleTree& B, int samplesPerEdge,
                         double spacing = 1e300);

// ==== 3.2 Volumetric approximation ==============================================================

/// Whether the closed triangle meets the closed tetrahedron (relative tolerance 1e-9).
bool intersects(const std::array<Vec3, 4>& tet, const std::array<Vec3, 3>& triangle);

/// [§3.2] r^E: the longest edge of tetrahedron E, length unit of the input. [choice] measured on
/// the undeformed cubes: on a smoothed mesh one stretched element would ask for a level too many.
double longestEdge(const Mesh& M, int E);
/// [§3.2, §3.3] The level of whole cubes at which no element has r^E >= l_c: a multiple of 3.
int cubeLevel(const Mesh& M, double lc);
/// [§3.2, eq. (1)] r^E >= l_c: the element is to be refined.
bool isTooLarge(const Mesh& M, int E, double lc);

/// [§3.2 choice] l_c "determined by the geometric features of S": the largest with l_c <= extent /
/// 20 and cubes of edge h = l_c / √3 that resolve the distances to ∂M (h <= distance / 2.5) and to
/// the surfaces in M (/ 1.75), S between its rims (/ 1.5) and sheets that face each other (/ 2).
/// For the last two not below 1/8 of what the extent gives, nor more than about 10⁶ tetrahedra.
SizeChoice chooseSize(const Mesh& M, const SurfaceDistance& S);

/// 𝓣: the tetrahedra cut by S, and more; all of at least this level once §3.2 is done.
struct Approximation {
  std::vector<char> T;    // [tets], 1: in 𝓣
  int level = 0;          // a multiple of 3: whole cubes
  bool isMiddle = false;  // a middleApproximation()
  // Of a middle: the cubes above S_M and those below, in the lattice, sorted.
  std::vector<std::uint64_t> above = {}, below = {};
};
/// [§3.2, eq. (1)] Refines the tetrahedra cut by S until none has r^E >= l_c.
Approximation volumetricApproximation(Bisection& B, const SurfaceDistance& S, double lc,
                                      const Crew& crew = Crew());

// ==== 3.3 Volumetric approximation healing ======================================================

/// [§3.3, eq. (2)] χ = n_E − n_F + n_C of the edges, faces and cells of 𝓣 adjacent to a node: 1 for
/// a local disk.
int chi(int nE, int nF, int nC);
/// Eq. (2) at a lattice node with the cubes of 𝓣 around it: bit x + 2 y + 4 z for the cube on the
/// sides x, y, z.
int chi(unsigned cubes);
/// Whether these of the eight cubes are connected through faces.
bool isFaceConnected(unsigned cubes);
/// [§3.3, eq. (2)] [departure] Eq. (2) and the 2×2×2 rule: cubes inside and outside each
/// face-connected. Two cubes that share an edge only have χ = 1 at both of its ends and are no
/// manifold; so has a disk with an annulus.
bool isLocalDisk(unsigned cubes);

/// [§3.3] Adds elements until ∂𝓣 is a surface: whole cubes (faces parallel to the coordinate
/// planes), and all elements at nodes that are no local disk.
///   errors  MethodError: 𝓣 grows into the boundary, or does not settle
void volumetricHealing(Bisection& B, Approximation& A);

// ==== 3.4 Surface extraction ====================================================================

/// A square of ∂𝓣: a face of a cube of 𝓣.
struct Square {
  std::array<int, 4> node;        // mesh nodes, counter-clockwise from outside 𝓣
  std::array<int, 4> across;      // square across the edge from corner e to corner e + 1
  std::array<int, 4> acrossEdge;  // that edge's number there
  Vec3 centre;                    // physical
  Vec3 beyond;  // centre of the cube outside 𝓣, that of the cube inside mirrored
  bool facesAbove = false, facesBelow = false;  // of a middle: that cube is known to be above S_M,
                                                // or below
  int diagonal = 0;  // the mesh edge that halves it: 0 from corner 0 to 2, 1 from 1 to 3
};
/// ∂𝓣 as squares, a topological sphere but for `fault`.
struct SquareSurface {
  std::string fault = {};  // why it is no sphere; empty: it is one
  int level = 0;           // of 𝓣
  bool isMiddle = false;   // of a middleApproximation()
  double h = 0;            // physical edge of a cube
  std::vector<Square> squares;
  std::vector<std::uint64_t> keys;          // [squares], place in the computational lattice
  std::vector<int> nodes;                   // mesh nodes on ∂𝓣
  std::vector<int> start;                   // [mesh nodes + 1], rows of around
  std::vector<std::pair<int, int>> around;  // (square, corner) at each node
};
/// [§3.3, §3.4] [departure] Where ∂𝓣 is no sphere it says so in `fault`: a pocket in a finger two
/// cubes wide, or fingers that nearly touch, spoil one side of S and leave S_M a disk on the other.
SquareSurface boundarySquares(const Mesh& M, const Approximation& A);
/// [departure] The cubes below the cheapest S_M and beside it, of 𝓣 and the cubes around it,
/// refined where they are not: the part of their boundary that faces up. A square of S_M costs 1, a
/// cube on the wrong side of S `perDistance` times the distance of its centre from S, in h: S_M
/// makes a step where it pays, and keeps clear of earlier surfaces and the boundary. A large
/// perDistance lets the centres decide alone. To be healed by volumetricHealing().
///   source  the minimum cut of a graph; Dinic 1970
Approximation middleApproximation(Bisection& B, Approximation A, const SurfaceDistance& S,
                                  double perDistance, const Crew& crew = Crew());

/// What of each square is selected: bit e is its quarter, the triangle of corner e, corner e + 1
/// and the centre. 0 nothing, 15 the square; 3, 6, 12, 9 the halves along a diagonal.
using Selection = std::vector<unsigned char>;

/// S_M as squares, before and after 3.5's work on its outline.
struct Extraction {
  Selection selected;
  double energy = 0;       // what sides are ranked by: rim energy and interior coverage
  std::string fault;       // no disk, in another surface's way, or far from a part of S
  bool isBlocked = false;  // because another surface is in the way
};
/// [§3.4] The squares with all nodes on this side (±1) of S (of a middleApproximation(), side 0:
/// those whose cube outside is above S), one disk; then the outline's healing:
/// cases 1 and 2 of §3.5, or [departure] rim regularization, with half squares where asked for.
Extraction surfaceExtraction(const Mesh& M, const SquareSurface& Q, const SurfaceDistance& S,
                             int side, Outline outline);
/// Labels the faces of the selection with surface number k; bisects diagonals where halves need it.
void labelSurface(Bisection& B, const SquareSurface& Q, const Approximation& A,
                  const Selection& selected, int k);

// ==== 3.5 Surface healing =======================================================================
// Each returns whether it changed anything; done again it changes nothing.

/// [§3.5.1] Removes thin protrusions: squares (pairs of triangles) with three edges on the rim,
/// recursively.
bool removeThinProtrusions(const SquareSurface& Q, Selection& selected);
/// [§3.5.2] Adds the square in the plane of the two rim edges at rim nodes with five or more
/// triangles.
bool fillHighConnectivityNodes(const Mesh& M, const SquareSurface& Q, Selection& selected);
/// S_M, surface k, as a complex, with the elements at it: what the rules that follow look at.
class SurfaceComplex {
 public:
  struct Edge {
    int a, b;   // nodes, a < b
    int faces;  // of S_M at it: 1 on the rim, 2 inside
    int next;   // edge at a, -1: none
  };
  SurfaceComplex(const Bisection& B, int k);
  /// Follows the mesh after the bisections of B.splits[firstSplit], ...
  void update(const Bisection& B, std::size_t firstSplit);
  bool isEdge(int a, int b) const { return node[a] && node[b] && edgeBetween(a, b) >= 0; }
  bool isRimEdge(int a, int b) const {
    const int at = edgeBetween(a, b);
    return at >= 0 && edges[at].faces == 1;
  }

  const int surface;          // its number k
  std::vector<int> elements;  // with a node on S_M, at least
  std::vector<char> node;     // [nodes] 0 off S_M, 1 inside, 2 on the rim
  std::vector<Edge> edges;

 private:
  void readEdges(const Bisection& B);
  int edgeBetween(int a, int b) const;  // -1: none
  std::vector<char> isNear_;            // [tets] is one of `elements`
  std::vector<int> firstEdge_;          // [nodes] of which it is the lower one, -1: none
};
/// [§3.5.3] Refines tetrahedra with more than one face on S_M.
bool refineTetrahedraWithTwoFaces(Bisection& B, SurfaceComplex& SM);
/// [§3.5.4] Refines faces with more than one edge on the rim of S_M.
bool refineFacesWithTwoRimEdges(Bisection& B, SurfaceComplex& SM);
/// [§3.5.5] Refines inner edges of S_M with both ends on its rim.
bool refineEdgesAcrossTheRim(Bisection& B, SurfaceComplex& SM);
/// [§3.5.6] Refines edges that join S_M to another surface or to the boundary.
bool refineEdgesBetweenSurfaces(Bisection& B, SurfaceComplex& SM);
/// [§3.5] [departure] S_M must be a full subcomplex: bisects each edge with both ends on S_M that
/// is no edge of it, and splits each face with three nodes on S_M that is no face of it. Where S is
/// flat such a chord has zero length to give: the six cases alone left no random surface valid.
bool refineToFullSubcomplex(Bisection& B, SurfaceComplex& SM);
/// [§3.5] Cases 3 to 6 and the full subcomplex until nothing changes.
///   returns rounds;  errors  MethodError after 30
int surfaceHealing(Bisection& B, int k);

// ==== Tools for 3.6: sparse iterative solver ====================================================

/// A square matrix in compressed rows; columns ascend within a row.
struct SparseMatrix {
  std::vector<int> start;     // [rows + 1]
  std::vector<int> column;    // [entries]
  std::vector<double> value;  // [entries]
};

/// Solves A x = b by BiCGSTAB with the SSOR preconditioner, both coordinates at once: as one system
/// of twice the size.
///   x          start value on entry, the solution on return
///   tolerance  of |b - A x| / |b|
///   returns    the iterations
///   errors     SolverError: the residual reached; a row without diagonal entry
int solveBiCGSTAB(const SparseMatrix& A, const std::vector<Vec2>& b, std::vector<Vec2>& x,
                  double tolerance = 1e-12, int maxIterations = 5000);

// ==== 3.6 Surface projection ====================================================================

/// [§3.6, after 18] tan(α/2) of the angle between a and b: |a×b| / (|a||b| + a·b), or for
/// obtuse angles its twin (|a||b| − a·b) / |a×b|; finite: α within 1e-8 of π counts as that.
double tanHalfAngle(Vec3 a, Vec3 b);

/// [§3.6, after 18] Floater's mean value weights λ_ij, positive and of sum 1 in the row of an inner
/// point i: proportional to (tan(α_{j-1}/2) + tan(α_j/2)) / |x_j − x_i|. Rows of fixed points are
/// empty.
SparseMatrix meanValueWeights(const std::vector<Vec3>& points,
                              const std::vector<std::array<int, 3>>& triangles,
                              const std::vector<char>& fixed);

/// [§3.6, eq. (3)] Floater's parameterization: rim points keep u, inner ones get u_i = Σ λ_ij u_j.
///   u       [points], set at the rim (convex loop, counter-clockwise)
///   errors  SolverError; MethodError where a parametric triangle is not counter-clockwise
std::vector<Vec2> floaterParametrization(const std::vector<Vec3>& points,
                                         const std::vector<std::array<int, 3>>& triangles,
                                         const std::vector<char>& isRim, std::vector<Vec2> u);

/// [§3.6 departure] (1 + μ_i) u_i − Σ λ_ij u_j = μ_i a_i inside pulls u_i to its anchor a_i.
std::vector<Vec2> anchoredParametrization(const SparseMatrix& lambda,
                                          const std::vector<char>& isRim, std::vector<Vec2> u,
                                          const std::vector<double>& mu,
                                          const std::vector<Vec2>& anchor);

/// Triangles of 𝓤 that are not counter-clockwise.
std::vector<int> flippedTriangles(const std::vector<std::array<int, 3>>& triangles,
                                  const std::vector<Vec2>& u);

/// [§3.6, case 5 for S itself] Bisects inner edges that join two rim points (the third edge of an
/// ear is one), which would make ϕ degenerate. Adds points on edges: the geometry of S stays.
/// Afterwards there are at least four rim points.
void splitChords(TriangleSurface& S);

/// [§3.6 choice] The four rim points that go to the corners of 𝓤, in order along the rim.
struct RimCorners {
  std::array<int, 4> at;      // positions in the rim loop, ascending
  std::array<bool, 4> sharp;  // a corner of the geometry: its node will stay fixed
};
RimCorners rimCorners(const SurfaceDistance& S);

/// [§3.6, eq. (3)] ϕ: 𝓤 → S with its rim as a closed curve that starts at a corner; the four arcs
/// between the corners go to the four sides of 𝓤 by arc length.
struct SurfaceParametrization {
  Parametrization surface;        // S with chords split
  Curve rim;                      // sides[0].u at its points; its surface number is not yet set
  std::array<double, 4> cornerS;  // arc length of the four corners, the first is 0
  std::array<bool, 4> sharp;
};
SurfaceParametrization parametrizeSurface(const SurfaceDistance& S);

struct ProjectionReport {
  double tangentialShift = 0;    // largest distance of x' from the point of S nearest to x
  std::vector<int> cornerNodes;  // nodes fixed at sharp corners
};

/// [§3.6, eq. (3), (4)] Moves the nodes of S_M (faces labelled k = M.surfaces.size() + 1, a disk)
/// onto S: x' = ϕ(ϕ_M⁻¹(x)). Appends S to M.surfaces, its rim to M.curves, fixed sharp corners to
/// M.corners, and sets dimension, entity, parameter and x of the nodes.
///   S          has passed checkSurface()
///   followRim  [departure] S_M's rim follows the nearest rim of S, and its equations are anchored
///              (anchoredParametrization); false: plain, and both rims by arc length between four
///              corners [choice]
///   errors     MethodError: S_M is no disk or folds in 𝓤; SolverError. M may then be half changed:
///              work on a copy
ProjectionReport surfaceProjection(Mesh& M, const TriangleSurface& S, bool followRim);

// ==== 3.7 Mesh optimization (optimize.cpp) ======================================================
// J = Jφ: ideal (computational) element → physical element, both with the vertices in the same
// order.

/// [§3.7.1, eq. (5)] η = ‖J‖² / (3 |σ|^⅔): 1 for similarities, ∞ (σ = 0) for a degenerate
/// element.
double eta(const Mat3& J);
/// [§3.7.1, eq. (6)] J of the affine map from the ideal tetrahedron to the physical one.
Mat3 jacobian(const std::array<Vec3, 4>& ideal, const std::array<Vec3, 4>& physical);
/// [§3.7.1, eq. (7)] q = 1/η. [choice] 0 where σ <= 0.
double quality(const Mat3& J);
/// [§3.7.1, eq. (8)] h(σ) = ½(σ + √(σ² + 4δ²)): the determinant made positive.
///   sigma   det Jφ, any sign;  delta >= 0, unit of sigma, see chooseDelta()
///   returns h > 0, tending to max(σ, 0) as δ → 0
///   [departure] for σ < 0 computed as 2δ²/(√(σ²+4δ²) − σ): as printed, σ = −1 and δ = 1e-9
///   give 0
double h(double sigma, double delta);
/// η with h(σ) for |σ|; finite for δ > 0, ∞ for δ = 0 and σ <= 0.
double etaRegularized(const Mat3& J, double delta);
/// [§3.7.1, δ after 23, 30] δ with h(σ_min) = mu: δ² = mu (mu − σ_min); 0 where σ_min > 0 and no
/// regularization is needed.
double chooseDelta(double sigmaMin, double mu);

/// Refuses options out of range for a mesh of so many nodes: InputError.
void checkOptions(const OptimizeOptions& options, std::size_t nodes);

/// An objective with its derivatives at one point.
struct Objective {
  double f;
  Vec3 gradient;
  Mat3 hessian;
};

/// The star of a node: what eq. (9) needs of the elements adjacent to it, in closed form. With g
/// the gradient, in the ideal element, of the node's barycentric function, and d its displacement:
/// J = J₀ + d gᵀ, so that ‖J‖² = N + 2 v·d + |g|²|d|² and det J = σ + s·d, exactly.
struct StarElement {
  double N, sigma, gg;  // ‖J₀‖², det J₀, |g|²
  Vec3 v, s;            // J₀ g, cof(J₀) g
};
struct Star {
  Vec3 origin;                        // the node's position where d = 0
  std::vector<StarElement> elements;  // the m adjacent tetrahedra
};
/// The star of node n; `around` are the tetrahedra adjacent to it.
Star starOf(const Mesh& M, int n, const std::vector<int>& around);

/// [§3.7.2, eq. (9)] f(x) = Σ_j η_j^power over the star, with analytic gradient and Hessian.
double f(const Star& star, Vec3 x, double delta, double power = 1);
Objective fDerivatives(const Star& star, Vec3 x, double delta, double power = 1);
/// [§3.7.4 departure] Whether d, if it is at most 1.7 Newton steps from the origin, meets the first
/// Wolfe condition for certain (δ = 0, power 1), up to rounding: no element changes its curvature
/// much on the way. false where d or an element is no number, or σ <= 0.
bool isSmallStep(const Star& star, Vec3 d);
/// [§3.7.3, eq. (10)] f_ϕ(u) = f ∘ ϕ(u); ∞ where u is outside 𝓤.
double fVarphi(const Star& star, const Parametrization& P, Vec2 u, double delta, double power = 1);
/// [§3.7.3, eq. (11)] f_γ(s) = f ∘ γ(s).
double fGamma(const Star& star, const Curve& C, double s, double delta, double power = 1);

/// [§3.7.4, strong Wolfe conditions, 33] A step length t with F(t) <= F(0) + c1 t F'(0) and |F'(t)|
/// <= c2 |F'(0)|.
struct LinePoint {
  double F, slope;
};
struct WolfeStep {
  double t;
  bool armijo, curvature;
  int evaluations;
};  // t = 0 where no step was found
/// Bracketing and zoom with safeguarded cubic steps, at most 20; F may be ∞.
WolfeStep strongWolfe(const std::function<LinePoint(double t)>& F, double tFirst, double tMax);

/// [§3.7.4, Algorithm 2] Untangles and smooths M node by node; boundary, surface and curve nodes
/// slide on their entities, corners stay. Works on any tetrahedral mesh: without M.xi the ideal
/// elements are regular, without M.dimension the boundary is fixed. Indices and entities keep; M.x
/// and M.parameter change. A node of more than 20000 elements stays.
/// Tetrahedra without M.xi have to be positively oriented; half of those in bisection order are
/// not.
///   errors  InputError: options out of range, a malformed mesh.
///           No exception for an unfinished optimization: see the report. Where a callback throws
///           M is left as it is then.
OptimizeReport optimizeMesh(Mesh& M, const OptimizeOptions& options = {});

/// [§4, Table I] Statistics of q against the computational elements, or against the regular
/// tetrahedron (where M has no computational coordinates, always).
///   errors  InputError: a tetrahedron names a node that is not there.
enum class Ideal { computational, regular };
QualityStatistics qualityStatistics(const Mesh& M, Ideal ideal = Ideal::computational);
QualityStatistics qualityStatistics(const std::vector<double>& q);
/// q of each tetrahedron. [tets]
std::vector<double> qualities(const Mesh& M, Ideal ideal = Ideal::computational);
/// The same where M was made by bisection and moves of a mesh with the nodes `before`, whose q are
/// given: computed anew for tetrahedra with new or moved nodes only. (Each part of a bisected one
/// has a new node.)
std::vector<double> qualities(const Mesh& M, const std::vector<Vec3>& before,
                              std::vector<double> q);

// ==== 3. Surface insertion ======================================================================

/// [§3] Inserts S into M: 3.2 approximation, 3.3 healing, 3.4 extraction, 3.5 surface healing,
/// 3.6 projection, 3.7 optimization. Afterwards 0 elements are inverted and every node of S_M lies
/// on S.
/// [choice] Where no way is valid l_c is halved: once where options.lc gives it, else down to 1/8
/// of what the extent of S gives.
///   errors  InputError: S, M or the options break §3.1 (see checkSurface), l_c is not below
///   dist(∂M, S) or the
///           distance to an earlier surface, too many tetrahedra; MethodError: a step cannot reach
///           what it promises; SolverError: a linear solve failed. M is unchanged when it throws.
InsertReport insertSurface(Mesh& M, const TriangleSurface& S, const InsertOptions& options);

/// [§3, §4.2] Inserts several surfaces: all or none, the largest first, in whichever order they are
/// given. A surface of several components becomes several. Nodes of earlier surfaces slide on
/// theirs while later ones are inserted.
///   returns a report for each surface, in the order of their numbers in M; original and smoothed
///           are of the mesh before and after it
///   errors  as insertSurface, the message begins with the surface's name; InputError: two surfaces
///           cross or touch, or one and a surface of M. M is unchanged when it throws.
std::vector<InsertReport> insertSurfaces(Mesh& M, const std::vector<TriangleSurface>& S,
                                         const InsertOptions& options);

}  // namespace meccano
#endif
