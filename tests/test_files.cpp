// SPDX-License-Identifier: MIT
//
// main.cpp: the readers and writers of all formats, atomic output, and the command line.
#include <doctest/doctest.h>

#include <csignal>
#include <fstream>
#include <numeric>
#include <set>
#include <sstream>

#define MECCANO_NO_MAIN
#include "../main.cpp"

using namespace meccano;
using namespace meccano::app;

namespace {

/// A folder of its own for the files of a case, gone at its end.
struct Folder {
  fs::path path;
  Folder() {
    static int count = 0;
    path = fs::temp_directory_path() /
           ("meccano-test-" + std::to_string(::getpid()) + "-" + std::to_string(count++));
    fs::create_directories(path);
  }
  ~Folder() {
    std::error_code none;
    fs::remove_all(path, none);
  }
  std::string operator/(const std::string& name) const { return (path / name).string(); }
  std::string file(const std::string& name, const std::string& text) const {
    std::ofstream(path / name, std::ios::binary) << text;
    return (path / name).string();
  }
  int files() const {
    return static_cast<int>(std::distance(fs::directory_iterator(path), fs::directory_iterator()));
  }
};

struct Outcome {
  int status;
  std::string out, err;
};

Outcome call(const std::vector<std::string>& words, bool terminal = false) {
  std::ostringstream out, err;
  const int status = run(words, {out, err, terminal});
  return {status, out.str(), err.str()};
}

/// The message of the error that f throws; "" where it throws none.
template <class F>
std::string messageOf(F f) {
  try {
    f();
  } catch (const InputError& e) {
    return e.what();
  }
  return "";
}

std::string objError(const std::string& text) {
  return messageOf([&] { parseObj("s.obj", text); });
}
std::string vtkError(const std::string& text) {
  return messageOf([&] { parseVtk("m.vtk", text); });
}

bool has(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

/// A box bisected at places that have nothing to do with its symmetries.
Mesh bisectedBox(int rounds = 60) {
  Mesh M = boxMesh({-1, 2, 10}, {2, 1, 3}, {2, 1, 3});
  unsigned random = 1;
  for (int i = 0; i < rounds; ++i) {
    random = random * 1664525u + 1013904223u;
    bisect(M, {static_cast<int>((random >> 8) % M.tets.size())});
  }
  return M;
}

/// The text with the first `from` replaced.
std::string with(std::string text, const std::string& from, const std::string& to) {
  const std::size_t at = text.find(from);
  REQUIRE(at != std::string::npos);
  return text.replace(at, from.size(), to);
}

std::set<std::set<std::array<double, 3>>> tetrahedraInSpace(const Mesh& M) {
  std::set<std::set<std::array<double, 3>>> all;
  for (const std::array<int, 4>& z : M.tets) {
    std::set<std::array<double, 3>> corners;
    for (int n : z) corners.insert({M.xi[n].x, M.xi[n].y, M.xi[n].z});
    all.insert(corners);
  }
  return all;
}

const char* const twoTets =  // the second is inverted
    "# vtk DataFile Version 2.0\nforeign\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 5 float\n"
    "0 0 0 1 0 0 0 1 0 0 0 1 1 1 1\nCELLS 3 14\n4 0 1 2 3\n4 2 1 3 4\n3 0 1 2\n"
    "CELL_TYPES 3\n10\n10\n5\n";

std::string sineObj(int n) {
  Text t;
  for (int j = 0; j <= n; ++j)
    for (int i = 0; i <= n; ++i) {
      const double x = .15 + .7 * i / n, y = .15 + .7 * j / n;
      t << "v " << x << " " << y << " " << .5 + .1 * std::sin(6.283185307179586 * x) << "\n";
    }
  for (int j = 0; j < n; ++j)
    for (int i = 0; i < n; ++i) {
      const int a = j * (n + 1) + i + 1, b = a + 1, c = a + n + 1, d = c + 1;
      t << "f " << a << " " << b << " " << d << "\nf " << a << " " << d << " " << c << "\n";
    }
  return t.take();
}

/// A box whose middle plane x = 0 is labelled as surface 1.
Mesh halvedBox() {
  Mesh M = boxMesh({-1, 0, 0}, {2, 1, 3}, {2, 2, 2});
  for (std::size_t E = 0; E < M.tets.size(); ++E)
    for (int i = 0; i < 4; ++i) {
      bool on = true;
      for (int j = 0; j < 4; ++j) on &= j == i || M.x[M.tets[E][j]].x == 0;
      if (on) M.faceLabel[E][i] = 1;
    }
  return M;
}

}  // namespace

TEST_SUITE("files") {
  TEST_CASE("OBJ: vertices, faces as fans, negative indices, other keywords ignored") {
    const TriangleSurface S = parseObj("folder/patch.obj",
                                       "# a comment\nmtllib x.mtl\nv 0 0 0\nv 1 0 0 # trailing\n"
                                       "v 1 1 +1e-3 1.0\nvt 0 0\nvn 0 0 1\nv 0 1 0 .5 .5 .5\n\n"
                                       "f 1/1 2/2 3/3 4/4\nf -4//1 -3//1 -1//1\n"
                                       "f 1/1/1 3/3/1 4/4/1");
    CHECK(S.name == "patch");
    REQUIRE(S.points.size() == 4);
    CHECK(S.points[2] == Vec3{1, 1, 1e-3});
    REQUIRE(S.triangles.size() == 4);
    CHECK(S.triangles[0] == std::array<int, 3>{0, 1, 2});
    CHECK(S.triangles[1] == std::array<int, 3>{0, 2, 3});
    CHECK(S.triangles[2] == std::array<int, 3>{0, 1, 3});
    CHECK(S.triangles[3] == std::array<int, 3>{0, 2, 3});
  }

  TEST_CASE("OBJ: CRLF, tabs, a byte order mark and a missing last newline") {
    const TriangleSurface S =
        parseObj("s.obj", "\xEF\xBB\xBFv 0 0 0\r\nv\t1 0 0\r\nv 0 1 0  \r\nf 1 2 3");
    CHECK(S.points.size() == 3);
    CHECK(S.triangles.size() == 1);
  }

  TEST_CASE("OBJ: one broken file per rule, each with its line") {
    const std::string three = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
    struct Rule {
      std::string text, place, what;
    };
    const Rule rules[] = {{"", "s.obj: ", "empty"},
                          {" \r\n\n", "s.obj: ", "empty"},
                          {"v 0 0\n", "s.obj:1: ", "three coordinates"},
                          {"v 0 0 0\nv 1 x 0\n", "s.obj:2: ", "'x' is no number"},
                          {"v 0 0 1.5abc\n", "s.obj:1: ", "'1.5abc' is no number"},
                          {"v 0 nan 0\n", "s.obj:1: ", "not finite"},
                          {"v 0 0 inf\n", "s.obj:1: ", "not finite"},
                          {"v 0 0 1e999\n", "s.obj:1: ", "not finite"},
                          {three + "f 1 2\n", "s.obj:4: ", "three corners"},
                          {three + "f 1 2 4\n", "s.obj:4: ", "vertex 4"},
                          {three + "\n# c\nf 1 2 -4\n", "s.obj:6: ", "vertex -4"},
                          {three + "f 0 1 2\n", "s.obj:4: ", "vertex 0"},
                          {three + "f 1 2 b\n", "s.obj:4: ", "'b' is no face corner"},
                          {three + "f 1 2 3/x\n", "s.obj:4: ", "'3/x' is no face corner"},
                          {three + "f 1 2 99999999999\n", "s.obj:4: ", "no face corner"},
                          {three, "s.obj: ", "no triangle"},
                          {"solid ascii\nfacet normal 0 0 1\n", "s.obj: ", "no triangle"}};
    for (const Rule& rule : rules) {
      CAPTURE(rule.text);
      const std::string message = objError(rule.text);
      CHECK_MESSAGE(message.compare(0, rule.place.size(), rule.place) == 0, message);
      CHECK_MESSAGE(has(message, rule.what), message);
    }
  }

  TEST_CASE("files: missing ones and folders are named") {
    Folder folder;
    CHECK(has(messageOf([&] { readFile(folder / "none.obj"); }), "none.obj: cannot be read"));
    CHECK(has(messageOf([&] { readFile(folder.path.string()); }), "this is a folder"));
    if (fs::exists("/proc/self/mem"))  // nothing is at its beginning
      CHECK(has(messageOf([&] { readFile("/proc/self/mem"); }), "reading broke off"));
  }

  TEST_CASE("VTK: a box is read back as it was, member by member") {
    const Mesh M = boxMesh({-1, 2, 10}, {2, 1, 3}, {2, 1, 3});
    const Mesh R = parseVtk("m.vtk", vtkText(M));
    CHECK(R.tets == M.tets);
    CHECK(R.type == M.type);
    CHECK(R.level == M.level);
    CHECK(R.faceLabel == M.faceLabel);
    CHECK(R.dimension == M.dimension);
    CHECK(R.entity == M.entity);
    CHECK(R.cube == M.cube);
    REQUIRE(R.patches.size() == 6);
    CHECK(R.patches[3].name == M.patches[3].name);
    CHECK(R.patches[3].triangles == M.patches[3].triangles);
    CHECK(R.patches[3].gridStart == M.patches[3].gridStart);
    REQUIRE(R.curves.size() == 12);
    CHECK(R.curves[7].s == M.curves[7].s);
    CHECK(R.curves[7].sides[1].surface == M.curves[7].sides[1].surface);
    REQUIRE(R.corners.size() == 8);
    CHECK(R.corners[5].on[2].curve == M.corners[5].on[2].curve);
  }

  TEST_CASE("VTK: writing what was read gives the same bytes, and every double the same bits") {
    Mesh M = bisectedBox();
    for (std::size_t n = 0; n < M.x.size(); ++n)  // digits that need all 17 places
      if (M.dimension[n] == 3) M.x[n] += Vec3{1e-3 / 3, 1e-17, -1e-5 / 7};
    const std::string text = vtkText(M);
    const Mesh R = parseVtk("m.vtk", text);
    CHECK(vtkText(R) == text);
    bool same = true;
    for (std::size_t n = 0; n < M.x.size(); ++n)
      same &= M.x[n] == R.x[n] && M.xi[n] == R.xi[n] && M.parameter[n].x == R.parameter[n].x;
    CHECK(same);
    CHECK(R.tets == M.tets);
    CHECK(R.faceLabel == M.faceLabel);
  }

  TEST_CASE("VTK: the tetrahedra in the file are positively oriented, the boundary faces outward") {
    const Mesh M = bisectedBox();
    const Cells C = cellsOf(M);
    int negative = 0;
    double volume = 0;
    for (std::size_t E = 0; E < C.tets.size(); ++E) {
      volume += sixVolumes(M.x, C.tets[E]) / 6;
      negative += sixVolumes(M.x, C.tets[E]) <= 0 || sixVolumes(M.xi, C.tets[E]) <= 0;
    }
    CHECK(negative == 0);
    CHECK(volume == doctest::Approx(6));
    double byBoundary = 0;  // Gauss
    for (const Face& f : C.faces)
      byBoundary += dot(M.x[f.nodes[0]], cross(M.x[f.nodes[1]], M.x[f.nodes[2]])) / 6;
    CHECK(byBoundary == doctest::Approx(6));
  }

  TEST_CASE("VTK: bisecting a mesh that was read goes on as in the mesh that was written") {
    Mesh M = bisectedBox(30);
    Mesh R = parseVtk("m.vtk", vtkText(M));
    // any order of the file's vertices that keeps the refinement edge first would do as well
    Mesh T = parseVtk("m.vtk", vtkText(M));
    for (std::size_t E = 0; E < T.tets.size(); ++E) {
      std::swap(T.tets[E][0], T.tets[E][1]);
      std::swap(T.faceLabel[E][0], T.faceLabel[E][1]);
      if (T.type[E] != 0) continue;  // the path backwards: z = (x3, x0, x1, x2)
      std::swap(T.tets[E][2], T.tets[E][3]);
      std::swap(T.faceLabel[E][2], T.faceLabel[E][3]);
    }
    for (int generation = 0; generation < 4; ++generation) {
      std::vector<int> all(M.tets.size());
      std::iota(all.begin(), all.end(), 0);
      for (Mesh* mesh : {&M, &R, &T}) bisect(*mesh, all);
      CHECK(R.tets == M.tets);
      CHECK(tetrahedraInSpace(R) == tetrahedraInSpace(M));
      CHECK(tetrahedraInSpace(T) == tetrahedraInSpace(M));
    }
    CHECK(vtkText(R) == vtkText(M));
  }

  TEST_CASE("VTK: a file cut anywhere is refused, with its line where there is one") {
    const std::string text = vtkText(boxMesh({0, 0, 0}, {1, 1, 1}, {1, 1, 1}));
    REQUIRE(vtkError(text) == "");
    int accepted = 0;
    for (std::size_t length = 0; length < text.size(); ++length)
      accepted += vtkError(text.substr(0, length)).compare(0, 6, "m.vtk:") != 0;
    CHECK(accepted == 0);
    CHECK(has(vtkError(text.substr(0, text.find("CELLS"))), "m.vtk: "));
    const std::string cut = text.substr(0, text.find("CELL_TYPES") - 5);
    const auto lines = std::count(cut.begin(), cut.end(), '\n') + 1;
    CHECK_MESSAGE(has(vtkError(cut), "m.vtk:" + std::to_string(lines) + ": "), vtkError(cut));
  }

  TEST_CASE("VTK: one broken file per rule") {
    const std::string text = vtkText(boxMesh({0, 0, 0}, {1, 1, 1}, {1, 1, 1}));
    struct Rule {
      std::string from, to, what;
    };
    const Rule rules[] = {
        {"# vtk DataFile", "solid", "no VTK legacy file"},
        {"ASCII", "TEXT", "'TEXT' is where ASCII should be"},
        {"CELL_TYPES 18", "CELLS 0 0\nCELL_TYPES 18", "a second CELLS section"},
        {"cube 3 1 double", "cube 1 3 double", "array 'cube' has 1 components, not 3"},
        {"cube 3 1 double", "cube 0 1 double", "array 'cube' has no components"},
        {"SCALARS level int\nLOOKUP_TABLE", "SCALARS level int\nTABLE",
         "'TABLE' is where LOOKUP_TABLE should be"},
        {"SCALARS level int", "SCALARS level int 12", "an attribute has 1 to 9 components"},
        {"SCALARS level int\nLOOKUP_TABLE default\n0",
         "SCALARS level int\nLOOKUP_TABLE default\n-1", "tetrahedron 0 has no level"},
        {"surface_u 2 24 double\n0 0", "surface_u 2 24 double\n0 2", "not in [0,1]^2"},
        {"curve_side 1 24 int\n-3", "curve_side 1 24 int\n0", "a side in 'curve_side' is 0"},
        {"curve_s 1 24 double\n0", "curve_s 1 24 double\nnan", "a number that is not finite"},
        {"ASCII", "BINARY", "binary"},
        {"UNSTRUCTURED_GRID", "POLYDATA", "no UNSTRUCTURED_GRID"},
        {"POINTS 8 double\n0 0 0", "POINTS 8 double\n0 nan 0", "not finite"},
        {"POINTS 8 double\n0 0 0", "POINTS 8 double\n0 0 zero", "'zero' is no number"},
        {"POINTS 8", "POINTS 2000000000", "more than the rest"},
        {"POINTS 8", "POINTS -8", "negative"},
        {"CELLS 18 78\n4 0", "CELLS 18 78\n4 8", "node 8 does not exist"},
        {"CELLS 18 78\n4 0", "CELLS 18 78\n4 -1", "node -1 does not exist"},
        {"CELLS 18 78", "CELLS 18 79", "promises 79"},
        {"CELLS 18 78\n4 0", "CELLS 18 78\n4 7", "names a node twice"},
        {"CELL_TYPES 18\n10", "CELL_TYPES 18\n12", "only tetrahedra"},
        {"CELL_DATA 18", "CELL_DATA 17", "the mesh has 18"},
        {"CELL_DATA", "CELL_DATUM", "no section"},
        {"FIELD meccano 15", "FIELD meccano 14", "no section"},
        {"FIELD meccano 15\ncube 3 1 double\n1 1 1", "FIELD meccano 14", "'cube' is too short"},
        {"surface_size 5 6", "surface_side 5 6", "'surface_points' is too long"},
        {"surface_size 5 6 int\n-1 4 2", "surface_size 5 6 int\n-1 4 3", "array 'surface_"},
        {"surface_size 5 6 int\n-1", "surface_size 5 6 int\n-3", "labels"},
        {"surface_size 5 6 int\n-1 4 2 0", "surface_size 5 6 int\n-1 4 2 99", "has rim 99"},
        {"curve_s 1 24 double\n0", "curve_s 1 24 double\n2", "do not grow"},
        {"corner_curve 1 24 int\n1", "corner_curve 1 24 int\n13", "from 1 to 12"},
        {"SCALARS level int\nLOOKUP_TABLE default\n0", "SCALARS level int\nLOOKUP_TABLE default\n1",
         "bisected cube"},
        {"SCALARS level", "SCALARS lever", "'level' is too short"},
        {"SCALARS surface", "SCALARS surfeit", "'surface' is too short"},
        {"VECTORS computational", "VECTORS compositional", "'computational' is too short"},
        {"VECTORS computational double\n0 0 0", "VECTORS computational double\n0 0 .25",
         "bisected cube"},
        {"SCALARS dimension int\nLOOKUP_TABLE default\n0",
         "SCALARS dimension int\nLOOKUP_TABLE default\n2", "integer from -6 to 0"},
        {"SCALARS entity int\nLOOKUP_TABLE default\n1",
         "SCALARS entity int\nLOOKUP_TABLE default\n9", "integer from 1 to 8"}};
    for (const Rule& rule : rules) {
      CAPTURE(rule.to);
      const std::string message = vtkError(with(text, rule.from, rule.to));
      CHECK_MESSAGE(has(message, rule.what), message);
      CHECK(message.compare(0, 6, "m.vtk:") == 0);
    }
  }

  TEST_CASE("VTK: faces and labels that do not belong together are refused") {
    const Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 1, 1});
    const std::string text = vtkText(M);
    const std::string tag = "SCALARS surface int\nLOOKUP_TABLE default\n";
    std::string zeros;
    for (std::size_t E = 0; E < M.tets.size(); ++E) zeros += "0\n";
    CHECK(has(vtkError(with(text, tag + zeros + "-1", tag + zeros + "0")), "no patch is named"));
    CHECK(has(vtkError(with(text, tag + zeros + "-1", tag + zeros + "1")), "no patch is named"));
    // one tetrahedron's face inside, named as one of the boundary
    const std::size_t cells = text.find("CELLS"), at = text.find("\n3 ", cells);
    std::string broken = text;
    broken.replace(at, text.find('\n', at + 1) - at, "\n3 0 1 11");
    CHECK_MESSAGE(has(vtkError(broken), "no patch is named"), vtkError(broken));
  }

  TEST_CASE("VTK: a triangle across a cube is no face; a node on no surface has no dimension 2") {
    std::string text = vtkText(boxMesh({0, 0, 0}, {1, 1, 1}, {1, 1, 1}));
    const std::string inPlane = with(text, "dimension int\nLOOKUP_TABLE default\n0",
                                     "dimension int\nLOOKUP_TABLE default\n2");
    CHECK(has(vtkError(with(inPlane, "entity int\nLOOKUP_TABLE default\n1",
                            "entity int\nLOOKUP_TABLE default\n0")),
              "node 0 is on no surface, its dimension is 2"));
    text = with(text, "CELLS 18 78\n", "CELLS 19 82\n3 1 2 4\n");
    text = with(text, "CELL_TYPES 18\n", "CELL_TYPES 19\n5\n");
    text = with(text, "CELL_DATA 18\n", "CELL_DATA 19\n");
    for (const char* name : {"surface int", "level int", "quality double"}) {
      const std::string head = name + std::string("\nLOOKUP_TABLE default\n");
      text = with(text, head, head + "0\n");
    }
    CHECK_MESSAGE(has(vtkError(text), "the triangle of nodes 1 2 4 is no face"), vtkError(text));
  }

  TEST_CASE("VTK: cells without types, offsets that fall, data of other length than the cells") {
    const std::string two = twoTets;
    CHECK(has(vtkError(two.substr(0, two.find("CELL_TYPES"))), "it has 3 cells and 0 cell types"));
    CHECK(has(vtkError("# vtk DataFile Version 5.1\nv5\nASCII\nDATASET UNSTRUCTURED_GRID\n"
                       "POINTS 4 float\n0 0 0 1 0 0 0 1 0 0 0 1\n"
                       "CELLS 2 4\nOFFSETS vtktypeint64\n4 0\n"),
              "the offsets do not grow from 0 to 4"));
    // a list named as the labels are, with one entry for three cells
    const Mesh M = parseVtk("m.vtk", two + "CELL_DATA 3\nFIELD FieldData 1\nsurface 1 1 int\n1\n");
    CHECK(M.faceLabel.empty());
  }

  TEST_CASE("VTK: tetrahedra from elsewhere are read as they are, inverted ones too") {
    const Mesh M = parseVtk("m.vtk", twoTets);
    REQUIRE(M.tets.size() == 2);
    CHECK(M.xi.empty());
    CHECK(M.tets[0] == std::array<int, 4>{0, 1, 2, 3});
    CHECK(M.tets[1] == std::array<int, 4>{2, 1, 3, 4});
    const std::string text = vtkText(M);
    CHECK(vtkText(parseVtk("m.vtk", text)) == text);
  }

  TEST_CASE("VTK: version 5 as ParaView writes it: offsets, attributes, strings, metadata") {
    const Mesh M =
        parseVtk("m.vtk",
                 "# vtk DataFile Version 5.1\nvtk output\nASCII\nDATASET UNSTRUCTURED_GRID\n"
                 "FIELD FieldData 1\nnotes 1 2 string\nfirst%20note with words\nPOINTS\n"
                 "POINTS 4 float\n0 0 0 1 0 0 0 1 0 \n0 0 1 \n"
                 "CELLS 2 4\nOFFSETS vtktypeint64\n0 4 \nCONNECTIVITY vtktypeint64\n0 1 2 3 \n\n"
                 "CELL_TYPES 1\n10\n\nPOINT_DATA 4\nSCALARS h float\nLOOKUP_TABLE t\n0 1 2 3 \n"
                 "LOOKUP_TABLE t 2\n0 0 0 1\n1 1 1 1\nNORMALS n float\n0 0 1 0 0 1 0 0 1 0 0 1\n"
                 "METADATA\nINFORMATION 0\n\nCELL_DATA 1\nCOLOR_SCALARS c 3\n.1 .2 .3\n"
                 "TEXTURE_COORDINATES t 2 float\n0 0\nFIELD FieldData 1\nq 1 1 double\n1\n");
    CHECK(M.x.size() == 4);
    CHECK(M.tets.size() == 1);
  }

  TEST_CASE("output: an interrupt waits while a file is written") {
    static volatile std::sig_atomic_t interrupts;
    interrupts = 0;
    const auto old = std::signal(SIGINT, [](int) { interrupts = interrupts + 1; });
    Folder folder;
    {
      const HoldInterrupts hold;
      std::raise(SIGINT);
      Temporary file(folder / "a.vtk");
      file.write("text");
      CHECK(interrupts == 0);
      file.putInPlace();
    }
    CHECK(interrupts == 1);
    CHECK(folder.files() == 1);
    std::signal(SIGINT, old);
  }

  TEST_CASE("output: a file is written whole or not at all, and nothing else is left") {
    Folder folder;
    const std::string path = folder / "a.vtk";
    writeFiles({{path, "first"}, {folder / "b.vtk", "second"}});
    CHECK(readFile(path) == "first");
    CHECK(folder.files() == 2);
    fs::permissions(path, fs::perms::owner_read | fs::perms::owner_write);
    writeFiles({{path, "again"}});
    CHECK(readFile(path) == "again");
    CHECK(fs::status(path).permissions() == (fs::perms::owner_read | fs::perms::owner_write));
    // one of two cannot be written: the other keeps what it had
    CHECK(messageOf([&] { writeFiles({{path, "new"}, {folder / "no/b.vtk", "x"}}); }) != "");
    CHECK(messageOf([&] { writeFiles({{path, "new"}, {"/dev/full", "x"}}); }) != "");
    CHECK(readFile(path) == "again");
    CHECK(folder.files() == 2);
    checkWritable(folder / "c.vtk");
    CHECK(folder.files() == 2);
  }

  TEST_CASE("output: through a symbolic link the file behind it is replaced") {
    Folder folder;
    const std::string path = folder.file("a.vtk", "old");
    fs::create_symlink("a.vtk", folder.path / "link.vtk");
    writeFiles({{folder / "link.vtk", "new"}});
    CHECK(fs::is_symlink(folder.path / "link.vtk"));
    CHECK(readFile(path) == "new");
  }

  TEST_CASE("output: what cannot be written is told beforehand, in a sentence") {
    Folder folder;
    CHECK(has(messageOf([&] { checkWritable(folder / "no/a.vtk"); }), "its folder does not exist"));
    CHECK(has(messageOf([&] { checkWritable(folder.path.string()); }), "it is a folder"));
    CHECK(folder.files() == 0);
  }
}

TEST_SUITE("formats") {
  TEST_CASE("broken files: each is refused with its place and its reason, and each is expected") {
    struct Rule {
      std::string place, what;
    };
    const std::map<std::string, Rule> rules{
        {"mesh_count.mesh",
         {":10: ", "the entries of a section (1000000) are more than the rest of the file holds"}},
        {"mesh_dimension.mesh", {":3: ", "the dimension is not 3"}},
        {"mesh_hexahedra.mesh", {":9: ", "Hexahedra are in it; only tetrahedra of four nodes"}},
        {"mesh_index.mesh", {":11: ", "node 5 does not exist, there are 4 vertices"}},
        {"mesh_no_tetrahedron.mesh", {": ", "no tetrahedron in it"}},
        {"mesh_node_twice.mesh", {":11: ", "tetrahedron 0 names a node twice"}},
        {"mesh_not_finite.mesh", {":6: ", "a coordinate is not finite"}},
        {"mesh_required.mesh", {":14: ", "node 0 does not exist"}},
        {"mesh_truncated.mesh", {": ", "the file has no End"}},
        {"mesh_unknown.mesh", {": ", "its content is of no known format; meshes are read from"}},
        {"msh_binary.msh",
         {":2: ", "this Gmsh file is binary version 2.2; save it as ASCII version 2.2"}},
        {"msh_count.msh", {":5: ", "the number of nodes is negative"}},
        {"msh_hexahedron.msh", {":13: ", "an element of type 5; only tetrahedra of four nodes"}},
        {"msh_index.msh", {":13: ", "node 5 does not exist"}},
        {"msh_name.msh", {":6: ", "a physical name is written in \"quotes\""}},
        {"msh_no_tetrahedron.msh", {": ", "no tetrahedron in it"}},
        {"msh_node_in_tetrahedron_twice.msh", {":13: ", "tetrahedron 0 names a node twice"}},
        {"msh_node_twice.msh", {":7: ", "node 1 is there twice"}},
        {"msh_not_finite.msh", {":7: ", "a coordinate is not finite"}},
        {"msh_section.msh", {":10: ", "'EndNodes' is where $EndNodes should be"}},
        {"msh_truncated.msh", {":13: ", "the file ends where a node should be"}},
        {"msh_version.msh",
         {":2: ", "this Gmsh file is ASCII version 4.1; save it as ASCII version 2.2"}},
        {"msh_word.msh", {":4: ", "'Nodes' is where a section ($...) should be"}},
        {"obj_corner.obj", {":4: ", "'3/x' is no face corner"}},
        {"obj_empty.obj", {": ", "the file is empty"}},
        {"obj_flat.obj",
         {": ", "surface 'obj_flat' is empty: none of its 1 triangles has an area"}},
        {"obj_index.obj", {":5: ", "the face names vertex 4, above are 3"}},
        {"obj_no_face.obj", {": ", "no triangle in it (3 vertices, no f line)"}},
        {"obj_not_finite.obj", {":1: ", "a coordinate is not finite"}},
        {"obj_two_coordinates.obj", {":1: ", "a vertex needs three coordinates, here are 2"}},
        {"obj_two_corners.obj", {":4: ", "a face needs three corners, here are 2"}},
        {"obj_word.obj", {":2: ", "'x' is no number"}},
        {"off_binary.off", {":1: ", "this OFF file is binary"}},
        {"off_corner_missing.off", {":6: ", "a corner of the face is missing"}},
        {"off_counts.off", {":2: ", "'many' is no number; correct the number of faces"}},
        {"off_index.off", {":6: ", "the face names vertex 3, the file has 3"}},
        {"off_no_counts.off",
         {": ", "the file ends where the numbers of vertices and faces should be"}},
        {"off_no_face.off", {":2: ", "no triangle in it (3 vertices, 0 faces)"}},
        {"off_one_count.off", {":2: ", "the number of faces is missing"}},
        {"off_truncated.off", {": ", "the file ends where a face should be"}},
        {"off_two_coordinates.off", {":3: ", "a vertex needs three coordinates, here are 2"}},
        {"off_two_corners.off", {":6: ", "a face needs three corners, here are 2"}},
        {"ply_big_endian.ply",
         {":2: ", "this PLY file is big-endian; save it as ASCII or binary little-endian"}},
        {"ply_binary_index.ply", {": byte 214: ", "-1 is the vertex of a face"}},
        {"ply_binary_truncated.ply",
         {": byte 214: ", "the file ends where the vertex of a face should be"}},
        {"ply_count.ply",
         {":9: ", "the vertex elements (2000000000) are more than the rest of the file holds"}},
        {"ply_format.ply", {":2: ", "'packed' is no format of a PLY file"}},
        {"ply_head.ply", {":3: ", "'property' cannot be read in the head of a PLY file"}},
        {"ply_index.ply",
         {":13: ", "3 is the vertex of a face, it must be an integer from 0 to 2"}},
        {"ply_negative.ply", {":3: ", "the number of elements is negative"}},
        {"ply_no_end.ply", {": ", "the head has no end_header"}},
        {"ply_no_face.ply", {": ", "no triangle in it (3 vertices, no face element)"}},
        {"ply_no_format.ply", {": ", "the head has no format"}},
        {"ply_no_x.ply", {": ", "its vertices have no property x; x, y and z are needed"}},
        {"ply_not_finite.ply", {":11: ", "a coordinate is not finite"}},
        {"ply_truncated.ply", {":14: ", "the file ends where the vertex of a face should be"}},
        {"ply_two_corners.ply", {":13: ", "a face needs three corners, here are 2"}},
        {"ply_type.ply", {":4: ", "'real' is no type of a PLY property"}},
        {"ply_word.ply", {":11: ", "'b' is no number where a value should be"}},
        {"stl_binary_empty.stl", {": byte 80: ", "no triangle in it"}},
        {"stl_binary_head.stl", {": byte 61: ", "the file ends in its head of 84 bytes"}},
        {"stl_binary_not_finite.stl", {": byte 158: ", "a coordinate is not finite"}},
        {"stl_binary_solid.stl", {": byte 80: ", "the head promises 2 triangles"}},
        {"stl_binary_truncated.stl",
         {": byte 80: ",
          "the head promises 2 triangles, which are 184 bytes, and the file has 134"}},
        {"stl_coordinate.stl", {":5: ", "a vertex needs three coordinates, here are 2"}},
        {"stl_flat.stl",
         {": ", "surface 'stl_flat' is empty: none of its 0 triangles has an area"}},
        {"stl_keyword.stl", {":3: ", "'inner' is no keyword of an ASCII STL file"}},
        {"stl_outside.stl", {":10: ", "'facet' is outside a solid"}},
        {"stl_solid_in_solid.stl", {":9: ", "a solid begins before the last one ended"}},
        {"stl_truncated.stl", {": ", "the file ends without endsolid"}},
        {"stl_two_corners.stl", {":7: ", "a face needs three corners, here are 2"}},
        {"ts_atom.ts", {":9: ", "vertex 7 is named"}},
        {"ts_coordinates.ts", {":6: ", "a vertex needs three coordinates, here are 2"}},
        {"ts_end_missing.ts", {":10: ", "an object begins before the last one had its END"}},
        {"ts_id.ts", {":6: ", "'one' is no number; correct the number of a vertex"}},
        {"ts_index.ts", {":9: ", "vertex 4 is named, and no VRTX or ATOM line above defines it"}},
        {"ts_no_surface.ts", {": ", "no TSurf object in it"}},
        {"ts_no_triangle.ts", {":9: ", "surface 'bad one' has no TRGL line"}},
        {"ts_truncated.ts", {": ", "the last object has no END"}},
        {"ts_twice.ts", {":9: ", "vertex 3 is there twice"}},
        {"ts_two_corners.ts", {":9: ", "a face needs three corners, here are 2"}},
        {"unknown.txt", {": ", "its content is of no known format"}},
        {"vtk_binary.vtk", {":3: ", "this VTK file is binary; save it as ASCII"}},
        {"vtk_index.vtk", {":11: ", "node 4 does not exist, there are 4 points"}}};
    const fs::path folder = fs::path(__FILE__).parent_path() / "data" / "bad";
    for (const fs::directory_entry& file : fs::directory_iterator(folder))
      CHECK_MESSAGE(rules.count(file.path().filename().string()) == 1, file.path().string());
    for (const auto& entry : rules) {
      const std::string& name = entry.first;
      const Rule& rule = entry.second;
      CAPTURE(name);
      const std::string path = (folder / name).string(), suffix = suffixOf(path);
      std::vector<std::string> warnings;
      const std::string message = messageOf([&] {
        if (isMeshSuffix(suffix))
          readMeshFile(path);
        else
          readSurfaces(path, warnings);
      });
      CHECK_MESSAGE(message.compare(0, path.size() + rule.place.size(), path + rule.place) == 0,
                    message);
      CHECK_MESSAGE(message.compare(std::min(message.size(), path.size() + rule.place.size()),
                                    rule.what.size(), rule.what) == 0,
                    message);
    }
  }

  TEST_CASE("a surface comes back from every format: the same doubles, STL the same floats") {
    Folder folder;
    TriangleSurface S = parseObj("s.obj", sineObj(4));
    for (Vec3& x : S.points) x = {1e3 + x.x / 3, x.y / 7, -1e-9 * x.z};
    S.name = "a fault";
    const auto nearest = [](double v) {
      return double(std::strtof(format("%.17g", v).c_str(), nullptr));
    };
    for (const char* suffix : {".obj", ".off", ".ply", ".ts", ".stl"}) {
      CAPTURE(suffix);
      std::vector<std::string> warnings;
      const std::string path = folder / (std::string("stem") + suffix);
      writeFiles({{path, surfaceText(path, {S}, warnings)}});
      const bool stl = std::string(suffix) == ".stl";
      CHECK(warnings.size() == (stl ? 1 : 0));
      warnings.clear();
      const std::vector<TriangleSurface> R = readSurfaces(path, warnings);
      REQUIRE(R.size() == 1);
      CHECK(warnings.empty());
      const bool named = std::string(suffix) == ".obj" || std::string(suffix) == ".ts";
      CHECK(R[0].name == (named ? "a fault" : "stem"));
      REQUIRE(R[0].triangles.size() == S.triangles.size());
      if (!stl) {
        CHECK(R[0].points == S.points);
        CHECK(R[0].triangles == S.triangles);
      }
      int different = 0;
      for (std::size_t t = 0; t < S.triangles.size(); ++t)
        for (int i = 0; i < 3; ++i) {
          const Vec3 x = S.points[S.triangles[t][i]], y = R[0].points[R[0].triangles[t][i]];
          const Vec3 rounded{nearest(x.x), nearest(x.y), nearest(x.z)};
          different += !(y == (stl ? rounded : x));
        }
      CHECK(different == 0);
    }
  }

  TEST_CASE("several surfaces: .ts keeps them apart and named, one-object formats join them") {
    TriangleSurface A = parseObj("a.obj", sineObj(2)), B = A;
    for (Vec3& x : B.points) x.z += 1;
    A.name = "north", B.name = "south wing";
    std::vector<std::string> warnings;
    const std::string ts = surfaceText("x.ts", {A, B}, warnings);
    CHECK(warnings.empty());
    const std::vector<TriangleSurface> R = parseSurfaces("x.ts", ts, warnings);
    REQUIRE(R.size() == 2);
    CHECK(R[0].name == "north");
    CHECK(R[1].name == "south wing");
    CHECK(R[1].points == B.points);
    const std::string off = surfaceText("x.off", {A, B}, warnings);
    REQUIRE(warnings.size() == 1);
    CHECK(has(warnings[0], "its 2 surfaces are written as one"));
    CHECK(parseOff("x.off", off).triangles.size() == 2 * A.triangles.size());
    const TriangleSurface O = parseObj("x.obj", surfaceText("x.obj", {A, B}, warnings));
    CHECK(O.name == "x");  // two names are no label
    CHECK(O.triangles.back()[0] >= static_cast<int>(A.points.size()));
  }

  TEST_CASE("the content decides the format, whatever the suffix says") {
    const std::string obj =
        "\xEF\xBB\xBF\r\n\n# c\r\no one name\r\nv 0 0 0\r\nv 1 0 0\r\nv 0 1 0\r\n"
        "f 1 2 3\r\n";
    const std::string off = "\n# c\nOFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    std::vector<std::string> warnings;
    for (const char* name : {"a.stl", "a.ply", "a.off", "a.ts", "a"}) {
      const std::vector<TriangleSurface> S = parseSurfaces(name, obj, warnings);
      CHECK(S[0].triangles.size() == 1);
      CHECK(S[0].name == "one name");
      CHECK(parseSurfaces(name, off, warnings)[0].name == "a");
    }
    CHECK(formatOf("a.obj", "$MeshFormat\n") == Format::msh);
    CHECK(formatOf("a.obj", "# c\nMeshVersionFormatted 1\n") == Format::medit);
    CHECK(formatOf("a.obj", "what") == Format::obj);
    CHECK(formatOf("a.x", "what") == Format::none);
  }

  TEST_CASE("OBJ: a line goes on behind a backslash") {
    CHECK(parseObj("s.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 \\\n 4 3\n")
              .triangles.size() == 2);
  }

  TEST_CASE("OFF: colours, comments, counts in the first line, polygons as fans") {
    const TriangleSurface S = parseOff("q.off",
                                       "COFF 4 2 5 # counts\n0 0 0 255 0 0 255\n1 0 0 1 1 1 1\n\n"
                                       "1 1 0 0 0 0 0 # last but one\n0 1 0 1 1 1 1\n"
                                       "4 0 1 2 3 0.5 0.5 0.5\n3 2 1 0\n");
    CHECK(S.points.size() == 4);
    REQUIRE(S.triangles.size() == 3);
    CHECK(S.triangles[1] == std::array<int, 3>{0, 2, 3});
  }

  TEST_CASE(
      "STL: ASCII names with blanks, several solids; corners that coincide become one point") {
    const std::string facet =
        "  FACET NORMAL 0 0 1\n OUTER LOOP\n VERTEX 0 0 0\n VERTEX 1 0 0\n"
        " VERTEX 0 1 0\n ENDLOOP\n ENDFACET\n";
    const std::string other = with(facet, "VERTEX 0 0 0", "VERTEX 1 1 -0");
    std::vector<std::string> warnings;
    const std::string one = "solid  exported by some program\n" + facet + other + "endsolid\n";
    const std::vector<TriangleSurface> S = parseSurfaces("a.stl", one, warnings);
    REQUIRE(S.size() == 1);
    CHECK(S[0].name == "a");
    CHECK(S[0].points.size() == 4);
    CHECK(warnings.empty());
    const std::string two =
        with(one, "ENDFACET\n  FACET", "ENDFACET\nendsolid x\nsolid the other\nFACET");
    const std::vector<TriangleSurface> T = parseSurfaces("a.stl", two, warnings);
    REQUIRE(T.size() == 2);
    CHECK(T[0].name == "exported by some program");
    CHECK(T[1].name == "the other");
  }

  TEST_CASE("STL: a binary file may begin with solid") {
    std::string text = stlText(parseObj("s.obj", sineObj(3)));
    text.replace(0, 12, "solid name x");
    std::vector<std::string> warnings;
    const std::vector<TriangleSurface> S = parseSurfaces("b.stl", text, warnings);
    CHECK(S[0].triangles.size() == 18);
    CHECK(S[0].points.size() == 16);
    CHECK(formatOf("b.stl", text + "x") == Format::stlBinary);  // refused for its size, not as text
    for (std::size_t length = 0; length < text.size(); ++length)
      CHECK(messageOf([&] { parseSurfaces("b.stl", text.substr(0, length), warnings); }) != "");
  }

  TEST_CASE("PLY: other properties, lists and elements are passed over, in both codings") {
    const std::string head =
        "comment x\nelement vertex 4\nproperty uchar red\nproperty double z\nproperty float x\n"
        "property list uint8 int16 tags\nproperty float y\nelement camera 1\nproperty int i\n"
        "property list ushort float64 view\nelement face 1\nproperty list char float uv\n"
        "property list uchar uint vertex_index\nproperty short s\nelement edge 1\n"
        "property int a\nend_header\n";
    const TriangleSurface A =
        parsePly("a.ply", "ply\r\nformat ascii 1.0\r\n" + head +
                              "255 .25 0 2 -7 7 0\n1 .5 1 0 0\n2 .75 1 1 300 1\n3 -1 0 0 1\n"
                              "9 2 1.5 2.5\n1 .5 4 0 1 2 3 -5\n0\n");
    std::string bytes = "ply\nformat binary_little_endian 1.0\n" + head;
    auto put = [&](auto value) {
      bytes.append(reinterpret_cast<const char*>(&value), sizeof value);
    };
    auto vertex = [&](int red, double z, float x, std::vector<int> tags, float y) {
      put(static_cast<std::uint8_t>(red)), put(z), put(x);
      put(static_cast<std::uint8_t>(tags.size()));
      for (int t : tags) put(static_cast<std::int16_t>(t));
      put(y);
    };
    vertex(255, .25, 0, {-7, 7}, 0), vertex(1, .5, 1, {}, 0), vertex(2, .75, 1, {300}, 1);
    vertex(3, -1, 0, {}, 1);
    put(std::int32_t(9)), put(std::uint16_t(2)), put(1.5), put(2.5);
    put(std::int8_t(1)), put(.5f), put(std::uint8_t(4));
    for (unsigned n : {0u, 1u, 2u, 3u}) put(n);
    put(std::int16_t(-5)), put(std::int32_t(0));
    const TriangleSurface B = parsePly("a.ply", bytes);
    for (const TriangleSurface* S : {&A, &B}) {
      CHECK(S->points == std::vector<Vec3>{{0, 0, .25}, {1, 0, .5}, {1, 1, .75}, {0, 1, -1}});
      CHECK(S->triangles == std::vector<std::array<int, 3>>{{0, 1, 2}, {0, 2, 3}});
    }
  }

  TEST_CASE("GOCAD: ids in any order, atoms, depth, several objects with their names") {
    const std::string text =
        "# comment\nGOCAD TSurf 1 \nHEADER {\n*visible:true\nname:North fault \n}\n"
        "PROPERTY_CLASS_HEADER X {\nname:no name\n}\nTFACE\nVRTX 30 0 0 5 CNXYZ\n"
        "PVRTX 7 1 0 6 .5 .5\nVRTX 9 0 1 7\nTRGL 7 9 30\nTFACE\nATOM 31 9\nPATOM 32 7 .5\n"
        "VRTX 33 1 1 8\nTRGL 31 32 33\nBSTONE 7\nBORDER 1 2 3\nEND\n"
        "GOCAD VSet 1\nVRTX 1 0 0 0\nEND\n"
        "GOCAD TSurf 1\nHEADER {\n}\nZPOSITIVE Depth\nVRTX 1 0 0 100\nVRTX 2 1 0 100\n"
        "VRTX 3 0 1 200\nTRGL 1 2 3\nEND\n";
    std::vector<std::string> warnings;
    const std::vector<TriangleSurface> S = parseSurfaces("f.ts", text, warnings);
    REQUIRE(S.size() == 2);
    CHECK(S[0].name == "North fault");
    CHECK(S[0].points == std::vector<Vec3>{{0, 0, 5}, {1, 0, 6}, {0, 1, 7}, {1, 1, 8}});
    CHECK(S[0].triangles == std::vector<std::array<int, 3>>{{1, 2, 0}, {2, 1, 3}});
    CHECK(S[1].name == "f");
    CHECK(S[1].points[2] == Vec3{0, 1, -200});
    REQUIRE(warnings.size() == 1);
    CHECK(has(warnings[0], "f.ts: surface 'f': ZPOSITIVE Depth, z is negated"));
  }

  TEST_CASE("double triangles and such without area are dropped, and counted in a warning") {
    std::vector<std::string> warnings;
    const std::vector<TriangleSurface> S =
        parseSurfaces("s.obj",
                      "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 0\nv 2 0 0\nv 9 9 9\nf 1 2 3\nf 3 4 2\nf 1 "
                      "2 5\nf 1 4 3\n",
                      warnings);
    CHECK(S[0].triangles.size() == 1);
    CHECK(S[0].points.size() == 3);
    REQUIRE(warnings.size() == 1);
    CHECK_MESSAGE(has(warnings[0], "1 duplicate triangle, 2 zero-area triangles"), warnings[0]);
  }

  TEST_CASE("Gmsh and MEDIT: a labelled mesh comes back, node by node and face by face") {
    const Mesh M = halvedBox();
    const Cells C = cellsOf(M);
    for (const char* suffix : {".msh", ".mesh"}) {
      CAPTURE(suffix);
      const std::string path = std::string("m") + suffix, text = meshText(path, M);
      const MeshFile R = parseMesh(path, text);
      CHECK(R.warnings.empty());
      CHECK(R.M.x == M.x);
      CHECK(R.M.tets == C.tets);
      CHECK(R.M.xi.empty());
      REQUIRE(R.M.surfaces.size() == 1);
      REQUIRE(R.M.patches.size() == 6);
      const bool named = std::string(suffix) == ".msh";  // MEDIT has no names
      CHECK(R.M.patches[1].name == (named ? "x+" : "patch 2"));
      std::map<std::array<int, 3>, int> faces[2];
      for (const Mesh* mesh : {&M, &R.M})
        for (int k = -6; k <= 1; ++k)
          for (std::array<int, 3> f : surfaceFaces(*mesh, k)) {
            std::sort(f.begin(), f.end());
            if (k != 0) faces[mesh == &M][f] = k;
          }
      CHECK(faces[1].size() > 10);
      CHECK(faces[0] == faces[1]);
      // without a meccano all three formats hold the same, and give it back
      for (const char* other : {"o.vtk", "o.msh", "o.mesh"}) {
        const Mesh again = parseMesh(other, meshText(other, R.M)).M;
        CHECK(again.x == R.M.x);
        CHECK(again.tets == R.M.tets);
        CHECK(again.faceLabel == R.M.faceLabel);
        CHECK(meshText(other, again) ==
              meshText(other, parseMesh(other, meshText(other, again)).M));
      }
    }
  }

  TEST_CASE("Gmsh and MEDIT: a file cut anywhere is refused") {
    for (const char* path : {"m.msh", "m.mesh"}) {
      const std::string text = meshText(path, boxMesh({0, 0, 0}, {1, 1, 1}, {1, 1, 1}));
      int accepted = 0;
      for (std::size_t length = 0; length + 1 < text.size(); ++length)
        accepted += messageOf([&] { parseMesh(path, text.substr(0, length)); }) == "";
      CHECK(accepted == 0);
    }
  }

  TEST_CASE("Gmsh: physical groups with names, unique ones; nodes of any numbers, other elements") {
    Mesh M = halvedBox();
    M.surfaces.resize(1);
    M.surfaces[0].name = "x+";  // as a patch is called
    const std::string text = mshText(M);
    CHECK(has(text, "$PhysicalNames\n8\n2 1 \"x+\"\n2 2 \"x-\"\n2 3 \"x+ (3)\"\n"));
    CHECK(has(text, "3 1 \"volume\"\n$EndPhysicalNames\n"));
    const MeshFile R = parseMsh(
        "g.msh",
        "$MeshFormat\r\n2.2 0 8\r\n$EndMeshFormat\r\n$PhysicalNames\r\n1\r\n2 40 \"top \"\r\n"
        "$EndPhysicalNames\r\n$Comments\nNodes and $Elements\n$EndComments\n$Nodes\n4\n"
        "5 0 0 0\n300 1 0 0\n7 0 1 0\n1000000 0 0 1\n$EndNodes\n$Elements\n6\n1 15 2 0 1 5\n"
        "2 1 2 0 1 5 7\n3 2 2 40 3 5 7 300\n4 2 2 0 8 5 300 1000000\n9 4 3 2 2 0 5 300 7 1000000\n"
        "10 2 2 40 3 300 5 7\n$EndElements\n");
    CHECK(R.M.x.size() == 4);
    CHECK(R.M.tets[0] == std::array<int, 4>{0, 1, 2, 3});
    REQUIRE(R.M.patches.size() == 2);
    CHECK(R.M.patches[0].name == "patch 1");  // no physical group: the geometric entity, 8
    CHECK(R.M.patches[1].name == "top ");
    CHECK(R.M.faceLabel[0] == std::array<int, 4>{0, 0, -1, -2});
    REQUIRE(R.warnings.size() == 1);
    CHECK(has(R.warnings[0], "1 triangles are no faces"));
  }

  TEST_CASE("MEDIT: comments, sections of other kinds, required vertices; regions become one") {
    const MeshFile R = parseMedit(
        "g.mesh",
        "# first\nMeshVersionFormatted 1\nDimension\n3 # space\nVertices 5\n0 0 0 0\n1 0 0 0\n"
        "0 1 0 0\n0 0 1 0\n1 1 1 0\nEdges\n1\n1 2 7\nRidges 1 1\nTetrahedra\n2\n1 2 3 4 1\n"
        "2 3 4 5 2\nRequiredVertices\n2\n3\n1\nNormals\n1\n0 0 -1e0\nTriangles\n1\n4 3 2 9\nEnd\n");
    CHECK(R.M.tets.size() == 2);
    CHECK(R.required == std::vector<int>{2, 0});
    REQUIRE(R.M.surfaces.size() == 1);
    CHECK(interfaceNodes(R.M) == std::vector<int>{1, 2, 3});
    REQUIRE(R.warnings.size() == 1);
    CHECK(has(R.warnings[0], "2 regions"));
    CHECK(parseMedit("h.mesh", meditText(R.M, R.required)).required == R.required);
  }

  TEST_CASE("convert: meshes and surfaces of all formats; what is lost is said") {
    Folder folder;
    const std::string box = folder / "m.vtk";
    REQUIRE(call({"box", "-o", box, "--cells", "1", "1", "2"}).status == 0);
    for (const char* name : {"a.msh", "a.mesh"}) {
      const Outcome o = call({"convert", box, folder / name});
      CHECK(o.status == 0);
      CHECK(has(o.err, "only .vtk keeps the meccano"));
      CHECK(readMesh(folder / name).tets.size() == 12);
      CHECK(has(call({"stats", folder / name}).out, "12 nodes, 12 tetrahedra"));
      const std::string S = folder.file("s.obj", sineObj(4));
      const Outcome refused =
          call({"insert", folder / name, S, "-o", folder / "x.vtk", "--lc", ".1"});
      CHECK(refused.status == 1);
      CHECK(has(refused.err, "only .vtk keeps the meccano"));
    }
    CHECK(call({"convert", box, folder / "b.vtk"}).err ==
          folder / "b.vtk" + ": 12 nodes, 12 tetrahedra\n");
    CHECK(readFile(folder / "b.vtk") == readFile(box));
    CHECK(call({"box", "-o", folder / "direct.msh", "--cells", "1", "1", "2"}).status == 0);
    CHECK(readFile(folder / "direct.msh") == readFile(folder / "a.msh"));
    const Outcome none = call({"convert", box, folder / "s.ts"});
    CHECK(none.status == 1);
    CHECK(has(none.err, "no surface is inserted"));
    CHECK(!fs::exists(folder / "s.ts"));
    const std::string half = folder.file("half.vtk", vtkText(halvedBox()));
    const Outcome sheet = call({"convert", half, folder / "s.ts"});
    REQUIRE_MESSAGE(sheet.status == 0, sheet.err);
    std::vector<std::string> warnings;
    const std::vector<TriangleSurface> S = readSurfaces(folder / "s.ts", warnings);
    REQUIRE(S.size() == 1);
    CHECK(S[0].name == "surface 1");
    for (Vec3 x : S[0].points) CHECK(x.x == 0);
    CHECK(call({"convert", folder / "s.ts", folder / "s.ply"}).status == 0);
    const Outcome mesh = call({"convert", folder / "s.ts", folder / "s.mesh"});
    CHECK(mesh.status == 1);
    CHECK(has(mesh.err, "this is a surface (TSurf)"));
    const Outcome unknown = call({"convert", box, folder / "s.xyz"});
    CHECK(unknown.status == 2);
    CHECK(has(unknown.err, ".vtk, .msh or .mesh"));
    CHECK(has(unknown.err, ".obj, .stl, .off, .ply or .ts"));
  }

  TEST_CASE("optimize: --ideal gives the ideal elements by a mesh of the same connectivity") {
    Folder folder;
    Mesh rest = boxMesh({0, 0, 0}, {3, 1, 2}, {2, 2, 2});
    Mesh bent;
    bent.x = rest.x;
    bent.tets = cellsOf(rest).tets;
    bent.x[13] = {1.2, .8, .4};
    const std::string in = folder.file("in.vtk", vtkText(bent)), out = folder / "out.msh";
    const std::string ideal = folder.file("rest.mesh", meditText(rest, {}));
    const Outcome o = call({"optimize", in, "-o", out, "--ideal", ideal, "--max-disp", "1e-6"});
    REQUIRE_MESSAGE(o.status == 0, o.err);
    CHECK(norm(readMesh(out).x[13] - Vec3{1.5, .5, 1}) < 1e-5);  // at rest again
    CHECK(has(o.out, "against the regular tetrahedron"));
    auto refused = [&](const std::string& mesh, const std::string& other, const char* what) {
      const Outcome r = call({"optimize", mesh, "-o", folder / "x.vtk", "--ideal", other});
      CHECK(r.status == 1);
      CHECK_MESSAGE(has(r.err, what), r.err);
    };
    const Mesh larger = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 3});
    refused(in, folder.file("l.vtk", vtkText(larger)), "needs a mesh of the same connectivity");
    Mesh other = bent;
    other.tets[5] = bent.tets[7];
    refused(in, folder.file("o.vtk", vtkText(other)), "tetrahedron 5 has other nodes");
    other = bent;
    for (int n : other.tets[5]) other.x[n].x = 0;
    refused(in, folder.file("f.vtk", vtkText(other)), "has no volume");
    other = bent;
    other.x[13] = {3.3, 1.9, 2.7};
    refused(in, folder.file("i.vtk", vtkText(other)), "tetrahedra are inverted");
    refused(folder.file("r.vtk", vtkText(rest)), in, "has computational elements");
    CHECK(!fs::exists(folder / "x.vtk"));
  }

  TEST_CASE("optimize: required vertices and labelled faces stay where they are") {
    Folder folder;
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
    Mesh plain;
    plain.x = M.x;
    plain.x[13] = {.6, .45, .52};
    plain.tets = cellsOf(M).tets;
    const std::string out = folder / "out.mesh";
    auto moved = [&](const std::string& text) {
      REQUIRE(call({"optimize", folder.file("in.mesh", text), "-o", out}).status == 0);
      return norm(readMesh(out).x[13] - plain.x[13]);
    };
    CHECK(moved(meditText(plain, {})) > .05);
    CHECK(moved(meditText(plain, {13})) == 0);
    CHECK(readMeshFile(out).required == std::vector<int>{13});
    Mesh halved = halvedBox();  // its node 13 is on the labelled plane
    plain.faceLabel.clear();
    std::string text = meditText(plain, {});
    std::string faces;
    int count = 0;
    for (const std::array<int, 3>& f : surfaceFaces(halved, 1)) {
      for (int n : f) faces += std::to_string(n + 1) + " ";
      faces += "5\n";
      ++count;
    }
    text = with(text, "\nEnd", "\nTriangles\n" + std::to_string(count) + "\n" + faces + "End");
    CHECK(moved(text) == 0);
  }
}

TEST_SUITE("command line") {
  TEST_CASE("exit status: 0 done, 1 an error, 2 wrong usage") {
    Folder folder;
    const std::string mesh = folder / "m.vtk";
    CHECK(call({"box", "-o", mesh}).status == 0);
    CHECK(call({"stats", mesh}).status == 0);
    CHECK(call({"stats", folder / "none.vtk"}).status == 1);
    const std::vector<std::vector<std::string>> wrong{
        {},
        {""},
        {"bxo"},
        {"--box"},
        {"box"},
        {"box", "-o"},
        {"box", "-o", "--cells"},
        {"box", "-o", mesh, "--cells", "2", "2"},
        {"box", "-o", mesh, "--cells", "2", "2", "2.5"},
        {"box", "-o", mesh, "--size", "1", "1", "1m"},
        {"box", "-o", mesh, "--size", "1", "1", "inf"},
        {"box", "-o", mesh, "extra"},
        {"box", "-o", mesh, "--colour", "red"},
        {"box", "-o", mesh, "-o", mesh},
        {"box", "-o", folder / "m.obj"},
        {"box", "-o", folder / "m"},
        {"stats"},
        {"convert", mesh},
        {"convert", mesh, folder / "m.txt"},
        {"optimize", mesh, "--ideal", mesh},
        {"stats", mesh, mesh},
        {"insert", mesh, "-o", mesh, "--lc", "1"},
        {"insert", mesh, "s.obj", "--lc", "1"},
        {"insert", mesh, "s.obj", "-o", mesh, "--lc", "1", "--tolerance", "1"},
        {"insert", mesh, "s.obj", "-o", mesh, "--lc", "0.1x"},
        {"optimize", mesh}};
    for (const std::vector<std::string>& words : wrong) {
      CAPTURE(words.size());
      const Outcome o = call(words);
      CHECK_MESSAGE(o.status == 2, o.err);
      CHECK(o.out == "");
      CHECK(o.err.compare(0, 9, "meccano: ") == 0);
      CHECK(has(o.err, "--help"));
      CHECK(std::count(o.err.begin(), o.err.end(), '\n') == 1);
    }
  }

  TEST_CASE("wrong usage: each message") {
    const std::pair<std::vector<std::string>, const char*> rules[] = {
        {{}, "a command is missing"},
        {{"bxo"}, "there is no command 'bxo'"},
        {{"box", "--colour"}, "there is no option --colour"},
        {{"box", "-o", "a.vtk", "-o", "b.vtk"}, "-o is given twice"},
        {{"box", "-o", "a.vtk", "--size", "1", "2"}, "--size needs X Y Z"},
        {{"box", "-o", "a.vtk", "--cells", "1", "2", "x"}, "'x' is no integer up to"},
        {{"box", "-o", "a.vtk", "--size", "1", "2", "x"}, "'x' is no number for --size"},
        {{"box", "-o", "a.vtk", "--size", "1", "2", "inf"}, "--size must be finite"},
        {{"box"}, "the output is missing: -o OUT"},
        {{"box", "-o", "a.stl"}, "'a.stl' does not end in .vtk, .msh or .mesh"},
        {{"box", "a.vtk", "-o", "a.vtk"}, "'a.vtk' is too much, no file is read"},
        {{"stats"}, "needed: MESH, given: 0 files"},
        {{"convert", "a.vtk"}, "given: 1 file;"},
        {{"box", "-o", "a.vtk", "--cells", "1", "2", "99999999999"},
         "'99999999999' is no integer up to 2147483647 for --cells"},
        {{"insert", "m.vtk", "s.obj", "-o", "a-refined.vtk", "--lc", "1", "--stages", "a"},
         "the mesh and a stage would both be written to a-refined.vtk"},
        {{"insert", "m.vtk", "s.obj", "-o", "./refined.vtk", "--lc", "1", "--stages", "./"},
         "the mesh and a stage would both be written to ./refined.vtk"},
        {{"insert", "m.vtk", "s.obj", "-o", "a-2-refined.vtk", "--lc", "1", "--stages", "./a"},
         "the mesh and a stage would both be written to a-2-refined.vtk"},
        {{"convert", "a.vtk", "a.doc"}, "'a.doc' ends neither in .vtk, .msh or .mesh (meshes)"}};
    for (const auto& [words, what] : rules) {
      const Outcome o = call(words);
      CHECK(o.status == 2);
      CHECK_MESSAGE(has(o.err, what), o.err);
    }
  }

  TEST_CASE("options out of range are told before a file is read") {
    const std::vector<std::pair<std::vector<std::string>, std::string>> wrong{
        {{"insert", "none.vtk", "none.obj", "-o", "a.vtk", "--lc", "-1"}, "--lc -1 must be above"},
        {{"insert", "none.vtk", "none.obj", "-o", "a.vtk", "--tolerance", "0"}, "--tolerance 0"},
        {{"insert", "none.vtk", "none.obj", "-o", "a.vtk", "--power", "65"}, "power = 65"},
        {{"solid", "none.obj", "-o", "a.vtk", "--eps", "0"}, "--eps 0 must be above 0"},
        {{"terrain", "none.asc", "-o", "a.vtk", "--top", "9", "--threads", "-1"}, "threads = -1"},
        {{"optimize", "none.vtk", "-o", "a.vtk", "--max-sweeps", "0"}, "maxSweeps = 0"}};
    for (const auto& [words, what] : wrong) {
      const Outcome o = call(words);
      CHECK(o.status == 1);
      CHECK_MESSAGE(has(o.err, what), o.err);
    }
  }

  TEST_CASE("what is read, but for the mesh that is changed, is not overwritten") {
    Folder folder;
    const std::string mesh = folder / "m.vtk", other = folder / "other.vtk";
    REQUIRE(call({"box", "-o", mesh}).status == 0);
    fs::copy_file(mesh, other);
    std::vector<std::vector<std::string>> wrong{
        {"insert", mesh, other, "-o", other},
        {"insert", mesh, other, "-o", folder / "./other.vtk"},
        {"solid", other, "--eps", "1", "-o", other},
        {"solid", mesh, "--eps", "1", "--polycube", other, "-o", other},
        {"terrain", other, "--top", "1", "-o", other},
        {"optimize", mesh, "--ideal", other, "-o", other}};
    const std::string prefix = folder / "s", out = folder / "out.vtk";
    for (const char* stage : {"s-original.vtk", "./s-12-projected.vtk", "s-3-smoothed.vtk"}) {
      const std::string read = folder / stage;
      wrong.push_back({"insert", read, other, "-o", out, "--stages", prefix});
    }
    for (const std::vector<std::string>& words : wrong) {
      const Outcome o = call(words);
      CHECK(o.status == 2);
      CHECK_MESSAGE(has(o.err, "would be read and overwritten"), o.err);
    }
    CHECK(call({"optimize", mesh, "-o", mesh}).status == 0);
  }

  TEST_CASE("messages send no control characters of a file to the terminal") {
    CHECK(printable("a\033[2Jb\n\177 \xe2\x88\x82M") == "a?[2Jb?? \xe2\x88\x82M");
  }

  TEST_CASE("--help and --version go to standard output") {
    for (const Command& c : commands()) {
      const Outcome o = call({c.name, "--help"});
      CHECK(o.status == 0);
      CHECK(o.err == "");
      for (const Option& option : c.options) CHECK(has(o.out, option.name));
      CHECK(has(call({"--help"}).out, c.name));
    }
    CHECK(call({"--version"}).out == std::string("meccano ") + version + "\n");
  }

  TEST_CASE("memory that does not suffice is an error like the others") {
    struct Full : std::streambuf {
      int overflow(int) override { throw std::bad_alloc(); }
    } full;
    std::ostream out(&full);
    out.exceptions(std::ios::badbit);
    std::ostringstream err;
    CHECK(run({"--version"}, {out, err, false}) == 1);
    CHECK(err.str() ==
          "meccano: the memory does not suffice; use a larger --lc or a coarser mesh\n");
  }

  TEST_CASE("a standard output that cannot be written is an error") {
    std::ofstream full("/dev/full");
    std::ostringstream err;
    CHECK(run({"--version"}, {full, err, false}) == 1);
    CHECK(has(err.str(), "standard output"));
  }

  TEST_CASE("box: origin, size and cells, negative numbers too") {
    Folder folder;
    const std::string path = folder / "m.vtk";
    const Outcome o = call({"box", "--origin", "-1", "-2", "3", "--size", "2", "4", "6", "--cells",
                            "1", "2", "3", "-o", path});
    CHECK(o.status == 0);
    CHECK(o.out == "");
    const Mesh M = readMesh(path);
    CHECK(M.tets.size() == 36);
    CHECK(M.x.front() == Vec3{-1, -2, 3});
    CHECK(M.x.back() == Vec3{1, 2, 9});
    CHECK(call({"box", "-o", path, "--size", "1", "0", "1"}).status == 1);
    CHECK(call({"box", "-o", path, "--cells", "0", "1", "1"}).status == 1);
    CHECK(readMesh(path).tets.size() == 36);
    CHECK(folder.files() == 1);
  }

  TEST_CASE("output errors: a sentence, status 1, nothing left behind") {
    Folder folder;
    for (const std::string& path : {folder / "no/m.vtk", std::string("/dev/full")}) {
      const Outcome o = call({"box", "-o", path});
      CHECK(o.status == 1);
      CHECK(o.err.compare(0, 10 + path.size(), "meccano: " + path + ":") == 0);
      CHECK(std::count(o.err.begin(), o.err.end(), '\n') == 1);
    }
    CHECK(fs::is_character_file("/dev/full"));
    CHECK(folder.files() == 0);
  }

  TEST_CASE("insert: refusals before any work, status 1, nothing written") {
    Folder folder;
    const std::string box = folder / "m.vtk", out = folder / "out.vtk";
    const std::string foreign = folder.file("foreign.vtk", twoTets);
    const std::string S = folder.file("s.obj", sineObj(8)), empty = folder.file("e.obj", "");
    REQUIRE(call({"box", "-o", box, "--cells", "2", "2", "2"}).status == 0);
    const std::string stage = folder.file("stage.vtk", [&] {
      Mesh M = readMesh(box);  // one inner face marked as in the stage "refined"
      const std::vector<std::array<int, 4>> neighbour = faceNeighbours(M);
      int i = 0;
      while (neighbour[0][i] < 0) ++i;
      const int E = neighbour[0][i];
      const auto back = std::find(neighbour[E].begin(), neighbour[E].end(), 0);
      M.faceLabel[0][i] = M.faceLabel[E][back - neighbour[E].begin()] = 1;
      return vtkText(M);
    }());
    const int files = folder.files();
    auto refused = [&](const std::string& mesh, const std::string& s, const std::string& what) {
      const Outcome o = call({"insert", mesh, s, "-o", out, "--lc", ".12", "--quiet"});
      CHECK(o.status == 1);
      CHECK(o.out == "");
      CHECK_MESSAGE(has(o.err, what), o.err);
      CHECK(std::count(o.err.begin(), o.err.end(), '\n') == 1);
      CHECK(folder.files() == files);
    };
    refused(foreign, S, "no computational coordinates");
    refused(stage, S, "without its geometry");
    refused(box, empty, "empty");
    refused(box, folder / "none.obj", "cannot be read");
    refused(S, S, "this is a surface (OBJ), and a mesh is needed");
    refused(box, box, "this is a mesh (VTK legacy), and a surface is needed");
    CHECK(call({"insert", box, S, S, "-o", out, "--lc", ".1", "--quiet"}).status == 1);
    CHECK(has(call({"insert", box, S, "-o", folder / "no/x.vtk", "--lc", ".1"}).err, "no/x.vtk"));
    CHECK(has(call({"insert", box, S, "-o", out, "--lc", ".1", "--stages", folder / "no/x"}).err,
              "no/x-original.vtk"));
    for (const char* lc : {"0", "-1", "1000"})
      CHECK(call({"insert", box, S, "-o", out, "--lc", lc, "--quiet"}).status == 1);
    CHECK(folder.files() == files);
  }

  TEST_CASE("insert: Table I, the stages, and a file that reads back to the same bytes") {
    Folder folder;
    const std::string box = folder / "m.vtk", out = folder / "out.vtk";
    const std::string S = folder.file("sine.obj", sineObj(24));
    REQUIRE(call({"box", "-o", box, "--cells", "2", "2", "2"}).status == 0);
    const std::string prefix = folder / "stage";
    const Outcome o = call({"insert", box, S, "-o", out, "--lc", ".12", "--stages", prefix}, true);
    REQUIRE_MESSAGE(o.status == 0, o.err);
    for (const char* word : {"Table I", "original", "refined", "projected", "smoothed", "inverted",
                             "std dev", "regular tetrahedron", "surface 1 (sine)", "Hausdorff"})
      CHECK_MESSAGE(has(o.out, word), std::string(word));
    CHECK(has(o.err, "\r\033[Ksweep "));
    const std::string text = readFile(out);
    const Mesh M = readMesh(out);
    CHECK(vtkText(M) == text);
    CHECK(M.surfaces.size() == 1);
    CHECK(surfaceFaces(M, 1).size() > 10);
    CHECK(qualityStatistics(M).inverted == 0);
    for (const char* stage : {"original", "refined", "projected", "smoothed"}) {
      const std::string path = folder / (std::string("stage-") + stage + ".vtk");
      CAPTURE(path);
      CHECK(vtkText(readMesh(path)) == readFile(path));
    }
    CHECK(readFile(folder / "stage-original.vtk") == readFile(box));
    CHECK(readFile(folder / "stage-smoothed.vtk") == text);
    // the triangles of S_M turn the way of S: upward here
    const Cells C = cellsOf(M);
    for (const Face& f : C.faces)
      if (f.label == 1) {
        const Vec3 a = M.x[f.nodes[0]], b = M.x[f.nodes[1]], c = M.x[f.nodes[2]];
        CHECK(cross(b - a, c - a).z > 0);
      }
    CHECK(has(call({"stats", out}).out, "surface 1 (sine)"));
    const Outcome quiet = call({"insert", box, S, "-o", out, "--lc", ".12", "--quiet"}, true);
    CHECK(quiet.err == "");
    CHECK(readFile(out) == text);
  }

  TEST_CASE("optimize: a mesh from elsewhere, valid afterwards or refused") {
    Folder folder;
    const std::string out = folder / "out.vtk";
    Mesh M = boxMesh({0, 0, 0}, {1, 1, 1}, {2, 2, 2});
    M.x[13] = {.9, .8, .4};  // the inner node
    Mesh plain;
    plain.x = M.x;
    plain.tets = cellsOf(M).tets;
    const std::string in = folder.file("in.vtk", vtkText(plain));
    const Outcome o = call({"optimize", in, "-o", out, "--max-sweeps", "50"});
    REQUIRE_MESSAGE(o.status == 0, o.err);
    CHECK(has(o.out, "smoothed"));
    const Mesh R = readMesh(out);
    CHECK(qualityStatistics(R).inverted == 0);
    CHECK(norm(R.x[13] - Vec3{.5, .5, .5}) < 1e-2);
    CHECK(R.tets == plain.tets);
    const std::string bad = folder.file("bad.vtk", twoTets);  // nothing can move in it
    const Outcome inverted = call({"optimize", bad, "-o", folder / "x.vtk"});
    CHECK(inverted.status == 1);
    CHECK_MESSAGE(has(inverted.err, "elements are still inverted after "), inverted.err);
    CHECK(!fs::exists(folder / "x.vtk"));
    CHECK(call({"optimize", in, "-o", out, "--max-sweeps", "0"}).status == 1);
    CHECK(call({"optimize", in, "-o", out, "--max-disp", "-1"}).status == 1);
  }

  TEST_CASE("stats: inverted elements are counted") {
    Folder folder;
    const Outcome o = call({"stats", folder.file("two.vtk", twoTets)});
    CHECK(o.status == 0);
    CHECK(has(o.out, "5 nodes, 2 tetrahedra"));
    CHECK(has(o.out, format("%-12s%14d", "inverted", 1)));
  }

  TEST_CASE("terrain: an ESRI ASCII grid, rows from the north, keys in any case and order") {
    const std::string text =
        "CELLSIZE 10\nnrows 2\nXLLCENTER 5\nncols 3\nyllcorner 100\nNODATA_value -9999\n"
        "1 2 3\n4 5 6.5\n";
    const Terrain T = parseAsc("dem.asc", text);
    CHECK(T.nx == 3);
    CHECK(T.ny == 2);
    CHECK(T.origin.x == 5);
    CHECK(T.origin.y == 105);
    CHECK(T.z == std::vector<double>{4, 5, 6.5, 1, 2, 3});
    CHECK(heightAt(T, 15, 110) == 3.5);
  }

  TEST_CASE("terrain: each broken grid is refused with its place") {
    const std::string head =
        "ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 10\n"
        "NODATA_value -9999\n";
    const auto error = [](const std::string& t) {
      return messageOf([&] { parseAsc("d.asc", t); });
    };
    CHECK(has(error(""), "d.asc: the file is empty"));
    CHECK(has(error(head + "1 2 3\n4 -9999 6\n"), "d.asc:8: row 2, column 2: no data"));
    CHECK(has(error(head + "1 2 3\n4 x 6\n"), "d.asc:8: row 2, column 2: 'x' is no number"));
    CHECK(has(error(head + "1 2\n4 5 6\n"), "d.asc:7: row 1 has 2 heights, ncols promises 3"));
    CHECK(has(error(head + "1 2 3 4\n5 6\n"), "row 1 has 4 heights"));
    CHECK(has(error(head + "1 2 3 4 5 6\n"), "row 1 has 6 heights"));
    CHECK(has(error(head + "111111 222222 333333\n"), "ends after 1 rows"));
    CHECK(has(error(head + "1 2 3\n4 5 6\n7 8 9\n"), "more than the 2 rows"));
    CHECK(has(error("ncols 3\ncolour 2\n"), "d.asc:2: 'colour' is no key"));
    CHECK(has(error("ncols 3\nnrows 2\ncellsize 10\n1 2 3\n4 5 6\n"), "xllcorner is missing"));
    CHECK(has(error("ncols 3\nncols 3\n"), "given twice"));
    CHECK(has(error("ncols 1\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1\n2\n"),
              "ncols = 1 must be"));
    CHECK(has(error("ncols 2\nnrows 2\nxllcorner -15.5\nyllcorner 28\ncellsize .001\n"
                    "100 200\n300 400\n"),
              "looks like degrees"));
  }

  TEST_CASE("terrain: the command writes a mesh that reads back, and refuses wrong usage") {
    Folder folder;
    std::string dem = "ncols 9\nnrows 8\nxllcorner 0\nyllcorner 0\ncellsize 10\n";
    for (int j = 0; j < 8; ++j)
      for (int i = 0; i < 9; ++i)
        dem += std::to_string(3 * i + 2 * j + i * j % 3) + (i < 8 ? " " : "\n");
    const std::string in = folder.file("d.asc", dem), out = folder / "d.vtk";
    CHECK(call({"terrain", in, "-o", out}).status == 2);
    CHECK(call({"terrain", in, "-o", out, "--top", "10"}).status == 1);
    CHECK(call({"terrain", in, "-o", out, "--top", "60", "--eps", "0"}).status == 1);
    CHECK(!fs::exists(out));
    const Outcome o = call({"terrain", in, "-o", out, "--top", "60", "--cells", "4", "4", "3"});
    REQUIRE_MESSAGE(o.status == 0, o.err);
    CHECK(has(o.err, "4 x 4 x 3 cells, eps "));
    CHECK(has(o.out, "smoothed"));
    const Mesh M = readMesh(out);
    CHECK(qualityStatistics(M).inverted == 0);
    CHECK(vtkText(M) == readFile(out));
  }

  TEST_CASE("solid: polycube files, and each broken line is refused with its place") {
    const Meccano D =
        parsePolycube("p", "# two\ncube 0 0 0\ncube -1 0 0\ncorner 0 1 2  1.5 -2 3e1 # there\n");
    CHECK(D.cubes == std::vector<std::array<int, 3>>{{0, 0, 0}, {-1, 0, 0}});
    REQUIRE(D.corners.size() == 1);
    CHECK(D.corners[0].at == std::array<int, 3>{0, 1, 2});
    CHECK(D.corners[0].x == Vec3{1.5, -2, 30});
    const auto error = [](const std::string& t) {
      return messageOf([&] { parsePolycube("p.txt", t); });
    };
    CHECK(has(error(""), "no `cube i j k` line"));
    CHECK(has(error("cube 0 0 0\ncube 0 0 0\n"), "p.txt:2: this cube is given twice"));
    CHECK(has(error("cube 0 0\n"), "p.txt:1: a cube is `cube i j k`, here are 2 numbers"));
    CHECK(has(error("cube 0 0 .5\n"), "'.5' is no integer"));
    CHECK(has(error("corner 0 0 0 1 2\n"), "a corner is `corner i j k  x y z`"));
    CHECK(has(error("corner 0 0 0 1 2 nan\n"), "'nan' is no coordinate"));
    CHECK(has(error("kube 0 0 0\n"), "'kube' is no line of a polycube"));
  }

  TEST_CASE("solid: the command refuses what is no solid, no eps, no fitting polycube") {
    Folder folder;
    std::string cube;
    for (const char* p : {"0 0 0", "1 0 0", "0 1 0", "1 1 0", "0 0 1", "1 0 1", "0 1 1", "1 1 1"})
      cube += format("v %s\n", p);
    const std::string open = "f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\n";
    const std::string in = folder.file("cube.obj", cube + open + "f 2 4 8 6\n");
    const std::string out = folder / "cube.vtk";
    std::string corners;
    for (int n = 0; n < 8; ++n)
      corners +=
          format("corner %d %d %d  %d %d %d\n", n % 2, n / 2 % 2, n / 4, n % 2, n / 2 % 2, n / 4);
    const auto refusal = [&](const std::string& file, const char* eps,
                             const std::string& polycube) {
      std::vector<std::string> words{"solid", file, "--eps", eps, "-o", out, "--max-tets", "9000"};
      if (!polycube.empty())
        words.insert(words.end(), {"--polycube", folder.file("p.txt", polycube)});
      const Outcome o = call(words);
      CHECK(o.status == 1);
      CHECK(!fs::exists(out));
      return o.err;
    };
    const std::string one = "cube 0 0 0\n";
    CHECK(has(refusal(folder.file("open.obj", cube + open), ".1", ""), "the surface is open"));
    // the zero-area triangle that closes it along an edge is dropped, and that is said
    const std::string flat = "v .5 0 0\nf 1 2 9\nf 1 9 6 5\nf 9 2 6\n";
    const std::string needle =
        refusal(folder.file("flat.obj", cube + flat +
                                            "f 1 3 4 2\nf 5 6 8 7\nf 3 7 8 4\nf 1 5 7 3\n"
                                            "f 2 4 8 6\n"),
                ".1", "");
    CHECK(has(needle, "1 zero-area triangle"));
    CHECK(has(needle, "the surface is open"));
    for (const char* eps : {"0", "-1"}) CHECK(has(refusal(in, eps, ""), "must be above 0"));
    CHECK(has(refusal(in, ".1", one + "cube 1 1 0\n"), "no manifold at the edge"));
    CHECK(has(refusal(in, ".1", one + corners + "corner 1 1 1  1 1 1\n"), "placed twice"));
    CHECK(has(refusal(in, ".1", one + "corner 0 0 0  9 9 9\n"), "of its diagonal"));
    CHECK(call({"solid", in, "-o", out}).status == 2);
    CHECK(folder.files() == 4);
  }
}
