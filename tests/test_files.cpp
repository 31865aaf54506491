// SPDX-License-Identifier: MIT
//
// main.cpp: the OBJ reader, the .vtk file, atomic output, and the command line.
#include <doctest/doctest.h>

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
    struct Rule { std::string text, place, what; };
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
    struct Rule { std::string from, to, what; };
    const Rule rules[] = {
        {"# vtk DataFile", "solid", "no VTK legacy file"},
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
    // a triangle across the box is no face of it
    const std::string face = "\n3 ";
    const std::size_t at = text.find(face), end = text.find('\n', at + 1);
    std::string broken = text;
    broken.replace(at, end - at, "\n3 0 4 11");
    CHECK(vtkError(broken) != "");
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
    const Mesh M = parseVtk(
        "m.vtk",
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

TEST_SUITE("command line") {
  TEST_CASE("exit status: 0 done, 1 an error, 2 wrong usage") {
    Folder folder;
    const std::string mesh = folder / "m.vtk";
    CHECK(call({"box", "-o", mesh}).status == 0);
    CHECK(call({"stats", mesh}).status == 0);
    CHECK(call({"stats", folder / "none.vtk"}).status == 1);
    const std::vector<std::vector<std::string>> wrong{
        {}, {""}, {"bxo"}, {"--box"}, {"box"}, {"box", "-o"}, {"box", "-o", "--cells"},
        {"box", "-o", mesh, "--cells", "2", "2"}, {"box", "-o", mesh, "--cells", "2", "2", "2.5"},
        {"box", "-o", mesh, "--size", "1", "1", "1m"},
        {"box", "-o", mesh, "--size", "1", "1", "inf"},
        {"box", "-o", mesh, "extra"}, {"box", "-o", mesh, "--colour", "red"},
        {"box", "-o", mesh, "-o", mesh}, {"box", "-o", folder / "m.msh"}, {"stats"},
        {"stats", mesh, mesh}, {"insert", mesh, "-o", mesh, "--lc", "1"},
        {"insert", mesh, "s.obj", "--lc", "1"}, {"insert", mesh, "s.obj", "-o", mesh},
        {"insert", mesh, "s.obj", "-o", mesh, "--lc", "0.1x"}, {"optimize", mesh}};
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
    refused(S, S, "no VTK legacy file");
    CHECK(has(call({"insert", box, S, S, "-o", out, "--lc", ".1"}).err, "2 surfaces are given"));
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
    CHECK(call({"optimize", bad, "-o", folder / "x.vtk"}).status == 1);
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
}
